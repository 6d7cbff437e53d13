//! Content of the pages, without a browser.

use std::io::{Read, Write};

use regrind_testcell::http::{Visitor, raw};
use serde_json::{Value, json};

use crate::program::{Running, SMALL_RECIPE_POINTS, regrind, replaced, run, run_folders, small_recipe};
use crate::{CellPage, serve};

#[test]
fn finished_run_pages() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5).display().to_string();
    for part in ["SN-<1>", "SN-0002"] {
        let (code, said, errors) = run(&["run", &recipe, "--cell", "sim", "--part", part], home.path());
        assert_eq!(code, 0, "{said}{errors}");
    }
    let folders = run_folders(&home.path().join("runs"));
    let ids: Vec<&str> = folders.iter().map(|folder| folder.file_name().unwrap().to_str().unwrap()).collect();
    let (_page, url) = serve(home.path());
    let mut visitor = Visitor::with_key(&url);

    let list = visitor.get("/runs").text();
    assert!(ids.iter().all(|id| list.contains(&format!("/runs/{id}\""))), "{list}");
    assert!(list.contains("SN-&lt;1&gt;") && !list.contains("SN-<1>"), "{list}");
    let narrowed = visitor.get("/runs?part=0002&result=Accepted").text();
    assert!(!narrowed.contains(ids[0]) && narrowed.contains(ids[1]), "{narrowed}");
    assert!(!visitor.get("/runs?result=Aborted").text().contains(ids[1]));
    let lists = |visitor: &mut Visitor, wanted: &str| {
        let text = visitor.get(&format!("/runs?{wanted}")).text();
        ids.iter().filter(|id| text.contains(&format!("/runs/{id}\""))).count()
    };
    assert_eq!(lists(&mut visitor, "since=2026-01-01&until=9999-01-01"), 2);
    assert_eq!(lists(&mut visitor, "since=9999-01-01"), 0);
    assert_eq!(lists(&mut visitor, "until=2026-01-01"), 0);

    let shown = visitor.get(&format!("/runs/{}", ids[0])).text();
    let result: serde_json::Value =
        serde_json::from_slice(&std::fs::read(home.path().join("runs").join(ids[0]).join("result.json")).unwrap())
            .unwrap();
    let last = result["cycles"].as_array().unwrap().last().unwrap();
    assert!(shown.contains(&format!("<strong>{:.3}</strong>", last["judged_rms_um"].as_f64().unwrap())), "{shown}");
    assert!(shown.contains("ACCEPTED") && shown.contains("SIMULATION") && shown.contains("<polyline"), "{shown}");
    visitor.language = "de-AT".into();
    assert!(visitor.get(&format!("/runs/{}", ids[0])).text().contains("ANGENOMMEN"));
    visitor.cookies += "; regrind_language=zh";
    assert!(visitor.get(&format!("/runs/{}", ids[0])).text().contains("合格"));

    let both = visitor.get(&format!("/compare?run={}&run={}", ids[0], ids[1]));
    assert!(
        both.status == 200 && ids.iter().all(|id| both.text().contains(&format!("data-compared=\"{id}\""))),
        "{both:?}"
    );
    assert_eq!(visitor.get(&format!("/compare?run={}", ids[0])).header("location"), ["/runs"]);
    assert!(visitor.get(&format!("/runs/{}/report", ids[0])).text().contains("<html lang=\"zh\">"));
    let report = Visitor::with_key(&url).get(&format!("/runs/{}/report", ids[0]));
    assert!(report.body == std::fs::read(home.path().join("runs").join(ids[0]).join("report.html")).unwrap());
    assert!(report.header("content-security-policy")[0].contains("default-src 'none'"));

    let map = visitor.get(&format!("/runs/{}/cycles/1/map", ids[0]));
    let count = |at: usize| u32::from_le_bytes(map.body[at..at + 4].try_into().unwrap()) as usize;
    // An error and its uncertainty per node.
    assert_eq!(map.body.len(), 40 + 8 * count(0) * count(4));
    let points = visitor.get(&format!("/runs/{}/cycles/1/points", ids[0]));
    assert_eq!(points.body.len(), SMALL_RECIPE_POINTS * 12);
    assert_eq!(visitor.get(&format!("/runs/{}/planned", ids[0])).body.len(), SMALL_RECIPE_POINTS * 8);
    assert_eq!(visitor.get(&format!("/runs/{}/cycles/9/map", ids[0])).status, 404);
    for file in ["error_map.png", "error_map.svg", "error_map.csv", "error_map.x3p", "deviations.csv"] {
        let saved = visitor.get(&format!("/runs/{}/cycles/1/files/{file}", ids[0]));
        assert_eq!(
            saved.body,
            std::fs::read(home.path().join("runs").join(ids[0]).join("cycle-1").join(file)).unwrap()
        );
        let name = format!("attachment; filename=\"{}-cycle-1-{file}\"", ids[0]);
        assert_eq!(saved.header("content-disposition"), [name.as_str()]);
    }
    for other in ["journal.sqlite", "..%2Frecipe.toml", "toolpath_z.csv", "none.csv"] {
        assert_eq!(visitor.get(&format!("/runs/{}/cycles/1/files/{other}", ids[0])).status, 404, "{other}");
    }
}

/// A page that is loaded again and again asks the cell for one connection, not for more than the cell allows.
#[test]
fn reloaded_page_stays_connected() {
    let home = tempfile::tempdir().unwrap();
    let mut cell = CellPage::begin(home.path(), 1.0);
    cell.run.line("grinding", |line| line.contains("grinding"));
    let visitor = cell.visitor();
    for load in 0..40 {
        let shown = visitor.get(&format!("/runs/{}", cell.id)).text();
        assert!(shown.contains("data-order=\"hold\"") && !shown.contains("banner lost"), "load {load}: {shown}");
    }
}

/// Returns the name of a run in an address, as a browser escapes it.
fn escaped(id: &str) -> String {
    id.bytes().map(|byte| format!("%{byte:02X}")).collect()
}

#[test]
fn run_name_is_url_escaped() {
    let home = tempfile::tempdir().unwrap();
    let recipe = home.path().join("lens #3 100%41? & <half>.toml");
    std::fs::rename(small_recipe(home.path(), 20.0), &recipe).unwrap();
    let mut shown = CellPage::start(home.path(), &recipe);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let visitor = shown.visitor();
    let list = visitor.get("/runs").text();
    let written: Vec<&str> = list.split("href=\"").skip(1).map(|rest| rest.split('"').next().unwrap()).collect();
    let address = written.iter().find(|address| address.starts_with("/runs/lens")).expect(&list);
    for path in [(*address).to_owned(), format!("/runs/{}", escaped(&shown.id))] {
        let answer = visitor.get(&path);
        assert!(answer.status == 200 && answer.text().contains("data-run=\"lens #3"), "{path}: {answer:?}");
    }
    assert_eq!(visitor.get("/").header("location"), [*address]);
    let held =
        visitor.order(address.trim_start_matches("/runs/"), &serde_json::json!({ "order": "hold", "reason": "" }));
    assert!(held.1, "{held:?}");
    let aborted = visitor.order(&escaped(&shown.id), &serde_json::json!({ "order": "abort", "reason": "" }));
    assert!(aborted.1, "{aborted:?}");
    assert_eq!(shown.run.end().0, 3);
}

#[test]
fn serve_refuses_public_or_used_address() {
    let home = tempfile::tempdir().unwrap();
    let (code, _, errors) = run(&["serve", "--listen", "0.0.0.0:0"], home.path());
    assert!(
        code == 2 && errors.contains("--certificate") && errors.contains("--users") && errors.contains("ssh -L"),
        "{errors}"
    );
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let (code, _, errors) = run(&["serve", "--listen", &taken.local_addr().unwrap().to_string()], home.path());
    assert!(code == 2 && errors.contains("--listen"), "{errors}");
}

/// The configured radius of the probe differs from that on the sphere: the cell is held. A person acknowledges the alarm,
/// makes an entry in the log of the shift, and ends the run.
#[test]
fn alarms_are_acknowledged_and_stay_after_stop() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5);
    let text = std::fs::read_to_string(&recipe).unwrap();
    let wrong = "[simulation.cmm]\nprobe_radius_error_um = 50.0\n\n[simulation.part]";
    let text = replaced(&text, "[simulation.part]", wrong);
    std::fs::write(&recipe, replaced(&text, "[cycle]\n", "[cycle]\nbegin_with = \"measure\"\n")).unwrap();
    let mut shown = CellPage::start(home.path(), &recipe);
    let visitor = shown.visitor();
    let path = format!("/runs/{}", shown.id);
    let piece = |text: String, id: &str| {
        text.split(&format!("id=\"{id}\"")).nth(1).unwrap().split("<h2").next().unwrap().to_owned()
    };
    let folder = shown.folder.clone();
    let state = || run(&["status", &folder.display().to_string()], home.path()).1;
    shown.run.until("a held cell", |_| state().contains("Held").then_some(()));
    let remark = |alarm: Value, what: &str| {
        visitor.order(&shown.id, &json!({ "order": "remark", "alarm": alarm, "what": what })).1
    };
    assert!(!remark(json!("link_lost"), ""), "this alarm is not active");
    assert!(!remark(Value::Null, " "), "an entry without a text");
    assert!(visitor.get(&path).text().contains("data-alarm=\"probe_radius\""));
    let seen = |alarm: &[&str]| run(&[&["confirm", "seen"], alarm].concat(), home.path());
    let unknown = seen(&["--alarm", "no_such_alarm"]);
    assert!(unknown.0 == 2 && unknown.2.contains("status --json"), "{unknown:?}");
    assert_eq!([seen(&[]).0, seen(&["--alarm", "link_lost"]).0], [2, 3]);
    assert_eq!(seen(&["--alarm", "probe_radius"]).0, 0);
    assert!(remark(json!("probe_radius"), "the ball is dirty"));
    assert!(remark(Value::Null, "coolant filled up"));
    let seen = shown.page.until("the acknowledgement", |_| {
        let alarms = piece(visitor.get(&path).text(), "alarms");
        alarms.contains("the ball is dirty").then_some(alarms)
    });
    assert!(seen.contains("Seen by") && !seen.contains("data-alarm"), "{seen}");
    assert_eq!(run(&["stop", &folder.display().to_string()], home.path()).0, 0);
    shown.run.end();
    let log = visitor.get(&format!("{path}/record?show=people")).text();
    assert!(
        log.contains("shift log: coolant filled up") && log.contains("alarm acknowledged, The radius of the probe"),
        "{log}"
    );
    assert!(log.contains("The record is as it was written") && !log.contains("grinder: connect"), "{log}");
    let alarms = shown.page.until("the alarms of the record", |_| {
        let alarms = piece(visitor.get(&path).text(), "alarms");
        alarms.contains("active at the end").then_some(alarms)
    });
    assert!(
        alarms.contains("radius of the probe") && alarms.contains("raised") && !alarms.contains("No alarm"),
        "{alarms}"
    );
}

/// Starts a run beside another active run, and opens its page in a browser. The page shows this run, and it is still
/// there after the run has ended. Ctrl-C then ends the program with the exit code of the run.
#[test]
fn page_of_run_stays_for_viewers() {
    let home = tempfile::tempdir().unwrap();
    let slow = small_recipe(home.path(), 20.0).display().to_string();
    let mut other = Running::new(regrind(&["run", &slow, "--cell", "sim", "--part", "SN-1"], home.path()));
    other.line("grinding", |line| line.contains("grinding"));
    let fast = small_recipe(home.path(), 2000.0).display().to_string();
    let begin = ["run", &fast, "--cell", "sim", "--part", "SN-2", "--serve", "127.0.0.1:0"];
    let mut run = Running::new(regrind(&begin, home.path()));
    let line = run.line("address of the page", |line| line.starts_with("page "));
    run.line("a record", |line| line.contains("grinding"));
    let visitor = Visitor::with_key(line.trim_start_matches("page").trim());
    let address = visitor.get("/").header("location")[0].to_owned();
    // An open page is a stream of events.
    let mut events = std::net::TcpStream::connect(&visitor.place).unwrap();
    let request =
        format!("GET {address}/events HTTP/1.1\r\nHost: {}\r\nCookie: {}\r\n\r\n", visitor.host(), visitor.cookies);
    events.write_all(request.as_bytes()).unwrap();
    let mut first = [0; 12];
    events.read_exact(&mut first).unwrap();
    assert_eq!(&first, b"HTTP/1.1 200");
    run.line("the page after the run", |line| line.starts_with("page     stays"));
    let shown = visitor.get(&address).text();
    assert!(shown.contains("SN-2") && !shown.contains("SN-1"), "{shown}");
    assert!(!run.is_over());
    run.interrupt();
    assert_eq!(run.end().0, 0);
}

/// The page of a run is sent as gzip to a browser that accepts it. Its events are not: each reaches the browser at once.
#[test]
fn page_is_compressed_and_its_events_are_not() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let visitor = shown.visitor();
    let request = |path: &str, version: &str| {
        let (host, cookies) = (visitor.host(), &visitor.cookies);
        format!("GET {path} HTTP/{version}\r\nHost: {host}\r\nCookie: {cookies}\r\nAccept-Encoding: gzip\r\n\r\n")
    };
    let address = format!("/runs/{}", shown.id);
    for path in [address.as_str(), "/assets/page.js"] {
        // By HTTP 1.0 a body without a length ends with the connection.
        let packed = raw(&visitor.place, request(path, "1.0").as_bytes());
        assert_eq!(packed.header("content-encoding"), ["gzip"], "{path}: {}", packed.head);
        let file = home.path().join("answer.gz");
        std::fs::write(&file, &packed.body).unwrap();
        let unpacked = std::process::Command::new("gzip").arg("-dc").arg(&file).output().unwrap();
        assert!(unpacked.status.success() && unpacked.stdout.len() > packed.body.len(), "{path}");
    }
    let mut events = std::net::TcpStream::connect(&visitor.place).unwrap();
    events.write_all(request(&format!("{address}/events"), "1.1").as_bytes()).unwrap();
    let (mut said, mut some) = (Vec::new(), [0; 4096]);
    // The stream is open: what has arrived was not held back to be compressed.
    while !said.windows(8).any(|of| of == b"\"pieces\"") {
        let read = events.read(&mut some).unwrap();
        assert!(read > 0, "{}", String::from_utf8_lossy(&said));
        said.extend_from_slice(&some[..read]);
    }
    let said = String::from_utf8_lossy(&said).to_ascii_lowercase();
    assert!(said.contains("text/event-stream") && !said.contains("content-encoding"), "{said}");
}

/// A person holds the cell without a reason. The page names this person, and takes the reason for the present state
/// only. The order that states it moves nothing.
#[test]
fn reason_of_hold_is_recorded_on_page() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let visitor = shown.visitor();
    let page = |visitor: &Visitor| visitor.get(&format!("/runs/{}", shown.id)).text();
    assert!(!page(&visitor).contains("id=\"hold-reason\""));
    let held = visitor.order(&shown.id, &json!({ "order": "hold", "reason": "" }));
    assert!(held.1, "{held:?}");
    let number = |status: &str| serde_json::from_str::<Value>(status).unwrap()["status"]["number"].as_u64().unwrap();
    let status = || run(&["status", &shown.folder.display().to_string(), "--json"], home.path()).1;
    shown.run.until("a held cell", |_| status().contains("\"Held\"").then_some(()));
    let asks = page(&visitor);
    assert!(asks.contains("Held by") && asks.contains("id=\"hold-reason\""), "{asks}");
    let reason =
        |seen: u64| visitor.order(&shown.id, &json!({ "order": "hold", "reason": "burnt smell", "seen": seen }));
    let now = number(&status());
    let (_, accepted, message) = reason(now - 1);
    assert!(!accepted && message.contains("the state of the cell changed"), "{message}");
    assert!(reason(now).1);
    shown.run.until("the reason on the page", |_| page(&visitor).contains("burnt smell").then_some(()));
    assert!(!page(&visitor).contains("id=\"hold-reason\""));
    assert_eq!(number(&status()), now, "the state is the same");
    shown.run.signal("KILL");
}

/// Two runs of one part: its page has the maps of both. A part that was never made has no page.
#[test]
fn runs_of_part_are_shown_together() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5).display().to_string();
    let make = |part: &str| run(&["run", &recipe, "--cell", "sim", "--part", part], home.path()).0;
    assert_eq!(["SN 7/A", "SN 7/A", "SN-8"].map(make), [0; 3]);
    let (_serving, url) = serve(home.path());
    let visitor = Visitor::with_key(&url);
    let parts = visitor.get("/parts").text();
    assert_eq!(parts.matches("href=\"/parts/").count(), 2, "{parts}");
    let address =
        parts.split("href=\"").find(|rest| rest.starts_with("/parts/SN%207")).unwrap().split('"').next().unwrap();
    let page = visitor.get(address).text();
    assert_eq!(page.matches("part-run").count(), 2, "{page}");
    let map =
        page.split("src=\"").find(|rest| rest.starts_with("/runs/")).and_then(|rest| rest.split('"').next()).unwrap();
    let map = visitor.get(map);
    // A browser shows no picture of another type.
    assert_eq!((map.status, map.header("content-type")), (200, vec!["image/svg+xml"]));
    assert_eq!(visitor.get("/parts/none").status, 404);
}

/// The record of a run is read in pages from the newest record to the oldest. A changed record is told of.
#[test]
fn record_is_shown_and_verified() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 1e5);
    assert_eq!(shown.run.end().0, 0);
    let visitor = shown.visitor();
    let path = format!("/runs/{}/record", shown.id);
    let numbers = |text: &str| -> Vec<u64> {
        text.split("<tr><td class=\"n\">").skip(1).map(|row| row.split('<').next().unwrap().parse().unwrap()).collect()
    };
    let (mut address, mut all) = (path.clone(), Vec::new());
    loop {
        let text = visitor.get(&address).text();
        assert!(text.contains("The record is as it was written"), "{text}");
        all.extend(numbers(&text));
        let Some(older) = text.split("record?show=all&amp;before=").nth(1) else { break };
        address = format!("{path}?show=all&before={}", older.split('"').next().unwrap());
    }
    assert!(all.len() > 100 && all.iter().copied().eq((1..=all.len() as u64).rev()), "{all:?}");
    let events = visitor.get(&format!("{path}?show=events")).text();
    assert!(events.contains("grinder: started") && !events.contains("<td>intent</td>"));
    assert_eq!(visitor.get("/runs/none/record").status, 404);
    let recipe = shown.folder.join("recipe.toml");
    std::fs::write(&recipe, "# another recipe\n").unwrap();
    assert!(visitor.get(&path).text().contains("The record is not as it was written"));
}

/// A held cell shows the last answers of its machines. After its program is killed, the record and the cell file are
/// left, and no value counts as live.
#[test]
fn machines_show_live_values_and_record() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 20.0).display().to_string();
    let cell = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/config/sim.toml")).unwrap();
    let due = "[cmm]\ncalibration_due = \"2001-02-28\"\n\n[cmm.wire]\n";
    std::fs::write(home.path().join("cell.toml"), replaced(&cell, "[cmm.wire]\n", due)).unwrap();
    let mut shown = CellPage::start_in(home.path(), &recipe, "cell.toml");
    let (code, said, _) = run(&["check", "cell.toml"], home.path());
    assert!(code == 0 && said.contains("calibration") && said.contains("2001-02-28"), "{said}");
    shown.run.line("grinding", |line| line.contains("grinding"));
    let visitor = shown.visitor();
    assert_eq!(visitor.get("/machines").header("location"), [format!("/runs/{}/machines", shown.id)]);
    let page = || visitor.get(&format!("/runs/{}/machines", shown.id)).text();
    shown.run.until("temperatures", |_| (page().matches("Temperature").count() >= 2).then_some(()));
    let live = page();
    for piece in ["data-refresh-ms=\"2000\"", "IDLE", "EXECUTE", "unit 1", "unit 2", "class=\"chart\"", "12.5000 mm"] {
        assert!(live.contains(piece), "{piece}: {live}");
    }
    assert!(live.contains("2001-02-28") && live.contains("overdue"), "{live}");
    shown.run.signal("KILL");
    shown.run.until("no live values", |_| page().contains("No live values").then_some(()));
    let left = page();
    assert!(!left.contains("data-refresh-ms") && !left.contains("EXECUTE") && left.contains("2001-02-28"), "{left}");
}

/// The path of the wheel begins a track with a point that is not finite, and its shares rise from 0 to 1.
#[test]
fn path_of_wheel_is_served() {
    let home = tempfile::tempdir().unwrap();
    let shown = CellPage::begin(home.path(), 20.0);
    let answer = shown.visitor().get(&format!("/runs/{}/path", shown.id));
    assert_eq!(answer.status, 200);
    let values: Vec<f32> = answer.body.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    let points: Vec<[f32; 3]> = values.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    assert!(points[0][0].is_nan() && points.len() > 100, "{}", points.len());
    let shares: Vec<f32> = points.iter().map(|p| p[2]).filter(|share| !share.is_nan()).collect();
    assert!(shares[0] == 0.0 && (shares[shares.len() - 1] - 1.0).abs() < 1e-6, "{shares:?}");
    assert!(shares.windows(2).all(|pair| pair[0] <= pair[1]), "{shares:?}");
    // The wheel runs over the edges of a part of 102 x 62 mm, but not far beyond.
    let within = |k: usize, most: f32| points.iter().filter(|p| !p[k].is_nan()).all(|p| p[k].abs() < most);
    assert!(within(0, 80.0) && within(1, 60.0));
    shown.run.signal("KILL");
}

#[test]
fn settings_and_components_are_shown() {
    let home = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(home.path().join("runs")).unwrap();
    for role in ["viewer", "engineer"] {
        assert_eq!(crate::users::add(home.path(), role, role, crate::users::PASSWORD).0, 0);
    }
    let (_page, url) = crate::serve_with(home.path(), &["--listen", "127.0.0.1:0", "--users", "users.toml"]);
    let settings = |name: &str| Visitor::signed_in(&url, name, crate::users::PASSWORD).unwrap().get("/settings").text();
    // Who else can sign in is for engineers only.
    let users = |text: &str| text.matches("<td>").count();
    let [viewer, engineer] = ["viewer", "engineer"].map(settings);
    assert!(users(&viewer) == 0 && users(&engineer) == 4, "{viewer}{engineer}");
    assert!(viewer.contains(env!("CARGO_PKG_VERSION")) && viewer.contains("data-language=\"zh\""), "{viewer}");
    let components = Visitor::signed_in(&url, "viewer", crate::users::PASSWORD).unwrap().get("/components").text();
    for class in ["swatch", "gauge pv", "class=\"chart\"", "banner lost", "alarm past", "broken"] {
        assert!(components.contains(class), "{class}: {components}");
    }
}

/// The page that a run has started ends at once when a service is stopped, without waiting for its browsers.
#[test]
fn page_of_a_run_ends_by_a_signal() {
    let home = tempfile::tempdir().unwrap();
    std::fs::create_dir(home.path().join("runs")).unwrap();
    let mut command = regrind(&["serve", "--while-stdin", "--listen", "127.0.0.1:0", "--runs", "runs"], home.path());
    command.stdin(std::process::Stdio::piped());
    let mut page = Running::new(command);
    page.line("address of the page", |line| line.starts_with("page "));
    page.signal("TERM");
    // The signal itself ends it, so there is no exit code.
    assert_eq!(page.end().0, -1);
}
