//! Refused requests: who is refused, with which answer, and that the cell is not affected.

use std::io::Write;
use std::net::TcpStream;
use std::path::Path;

use regrind_testcell::http::{Visitor, raw};
use serde_json::{Value, json};

use crate::program::{records_with, run};
use crate::users::{PASSWORD, add};
use crate::{CellPage, serve, serve_with};

fn remarks(shown: &CellPage) -> Vec<String> {
    let all = records_with(&shown.folder, "remark");
    all.iter().map(|record| record["remark"].as_str().unwrap_or_default().to_owned()).collect()
}

fn status(folder: &Path) -> Value {
    let (code, said, errors) = run(&["status", ".", "--json"], folder);
    assert_eq!(code, 0, "{errors}");
    serde_json::from_str::<Value>(&said).unwrap()["status"].clone()
}

#[test]
fn foreign_orders_refused_and_recorded() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let (visitor, stranger) = (shown.visitor(), Visitor::stranger(&shown.url));
    let path = format!("/runs/{}/orders", shown.id);
    let (token, origin) = (visitor.token(), visitor.origin());
    let stop = br#"{"order":"stop","reason":""}"#;
    let with = |origin: &'static str, token: &str| {
        [("Origin", origin), ("X-Regrind-Token", token)].map(|(n, v)| (n, v.to_owned()))
    };
    let post = |who: &Visitor, headers: &[(&str, String)], body: &[u8]| {
        let headers: Vec<_> = headers.iter().map(|(name, value)| (*name, value.as_str())).collect();
        who.post(&path, &headers, body).status
    };
    let own = [("Origin", origin.clone()), ("X-Regrind-Token", token.clone())];
    // Refuse a request without the key, the origin or the token. A token belongs to one browser.
    assert_eq!(post(&stranger, &own, stop), 401);
    assert_eq!(post(&visitor, &[], stop), 403);
    assert_eq!(post(&visitor, &with("http://evil.example", &token), stop), 403);
    assert_eq!(post(&visitor, &with("null", &token), stop), 403);
    assert_eq!(post(&visitor, &[("Origin", origin.clone())], stop), 403);
    let other = shown.visitor().token();
    assert_eq!(post(&visitor, &[("Origin", origin.clone()), ("X-Regrind-Token", other)], stop), 403);
    // A replay of an order that was seen on the network, identical to the last byte.
    let again = br#"{"order":"clear","device":"cmm"}"#;
    assert_eq!(post(&visitor, &own, again), 200, "for the first time");
    assert_eq!(post(&visitor, &own, again), 403, "for the second");
    let own = || [("Origin", origin.clone()), ("X-Regrind-Token", visitor.token())];
    // The address with the key, opened again in the same browser, does not invalidate the token of its other tabs.
    let again = visitor.get(&shown.url[shown.url.find("/?").unwrap()..]);
    let same =
        again.header("set-cookie").iter().all(|cookie| visitor.cookies.contains(cookie.split(';').next().unwrap()));
    assert!(again.status == 303 && same, "{again:?}");
    // Requests that are not orders of the page: those of programs, one that names no state, one too long, nonsense.
    for body in
        [&br#"{"order":"touches","from":0}"#[..], br#"{"order":"status"}"#, br#"{"order":"watch"}"#, b"{}", b"\xff\0"]
    {
        assert_eq!(post(&visitor, &own(), body), 400, "{}", String::from_utf8_lossy(body));
    }
    assert_eq!(post(&visitor, &own(), br#"{"order":"resume","reason":""}"#), 400, "meant for no state");
    assert_eq!(post(&visitor, &own(), &[b' '; 5000]), 413);
    let told = remarks(&shown);
    for pieces in [["origin", "http://evil.example"], ["order", "token"], ["a request", "order"]] {
        let recorded = told.iter().any(|remark| pieces.iter().all(|piece| remark.contains(piece)));
        assert!(recorded, "{pieces:?}: {told:?}");
    }
    let now = status(&shown.folder);
    assert_eq!((now["state"].as_str(), now["cycle"].as_u64()), (Some("Execute"), Some(1)), "{now}");
    assert!(now["alarms"].is_null(), "{now}");
    let taken = visitor.order(&shown.id, &json!({ "order": "stop", "reason": "" }));
    assert!(taken.1, "{taken:?}");
    assert_eq!(shown.run.end().0, 1);
}

#[test]
fn wrong_keys_refused_and_throttled() {
    let home = tempfile::tempdir().unwrap();
    let (page, url) = serve(home.path());
    let stranger = Visitor::stranger(&url);
    for path in [
        "/",
        "/runs",
        "/runs/some",
        "/runs/some/events",
        "/runs/some/cycles/1/map",
        "/runs/some/report",
        "/compare",
        "/nothing",
    ] {
        let answer = stranger.get(path);
        assert_eq!(answer.status, 401, "{path}");
        assert!(answer.text().contains("needs its key"), "{path}");
    }
    let guesses: Vec<u16> = (0..1000).map(|guess| stranger.get(&format!("/?key={guess:032x}")).status).collect();
    assert!(guesses[..20].iter().all(|status| *status == 401), "{:?}", &guesses[..20]);
    assert!(guesses[20..].contains(&429) && guesses.iter().all(|status| [401, 429].contains(status)));
    assert_eq!(Visitor::with_key(&url).get("/runs").status, 200);
    drop(page);
}

#[test]
fn cookies_of_two_cells_do_not_clash() {
    let [one, other] = [(), ()].map(|()| tempfile::tempdir().unwrap());
    let ((_one, one), (_other, other)) = (serve(one.path()), serve(other.path()));
    // A browser stores cookies by the host name, independent of the port.
    let (mut first, second) = (Visitor::with_key(&one), Visitor::with_key(&other));
    let names = |visitor: &Visitor| -> Vec<String> {
        visitor.cookies.split("; ").map(|cookie| cookie.split('=').next().unwrap().to_owned()).collect()
    };
    assert!(names(&first).iter().all(|name| !names(&second).contains(name)), "{first:?} {second:?}");
    first.cookies = format!("{}; {}", second.cookies, first.cookies);
    assert_eq!(first.get("/runs").status, 200);
}

#[test]
fn foreign_host_and_outside_path_refused() {
    let home = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(home.path().join("runs")).unwrap();
    std::fs::write(home.path().join("secret.html"), "secret").unwrap();
    let (_page, url) = serve(home.path());
    let visitor = Visitor::with_key(&url);
    let cookies = &visitor.cookies;
    let port = visitor.place.rsplit(':').next().unwrap();
    for host in [
        "evil.example",
        "evil.example:80",
        "127.0.0.1",
        "",
        &format!("127.0.0.1:+{port}"),
        &format!("127.0.0.1:0{port}0"),
    ] {
        let request = format!("GET /runs HTTP/1.1\r\nHost: {host}\r\nCookie: {cookies}\r\nConnection: close\r\n\r\n");
        assert_eq!(raw(&visitor.place, request.as_bytes()).status, 421, "{host}");
    }
    // A request with two hosts counts as one without.
    let request = format!(
        "GET /runs HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nHost: 127.0.0.1:{port}\r\nCookie: {cookies}\r\nConnection: close\r\n\r\n"
    );
    assert_ne!(raw(&visitor.place, request.as_bytes()).status, 200);
    let shown = visitor.get("/runs");
    assert_eq!(shown.header("cache-control"), ["no-store"], "{shown:?}");
    let request =
        format!("GET /runs HTTP/1.1\r\nHost: LocalHost:{port}\r\nCookie: {cookies}\r\nConnection: close\r\n\r\n");
    assert_eq!(raw(&visitor.place, request.as_bytes()).status, 200);
    for path in [
        "/runs/..",
        "/runs/../secret.html",
        "/runs/%2e%2e/report",
        "/runs/..%2fsecret.html/report",
        "/runs/%00/report",
        "/assets/..%2fpage.js",
        "/assets/Cargo.toml",
    ] {
        let answer = visitor.get(path);
        assert!(answer.status == 404 || answer.status == 400, "{path}: {answer:?}");
        assert!(!answer.text().contains("secret"), "{path}");
    }
}

#[test]
fn unfinished_requests_block_nobody() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = serve(home.path());
    let visitor = Visitor::with_key(&url);
    let mut slow: Vec<_> = (0..200).map(|_| TcpStream::connect(&visitor.place).unwrap()).collect();
    for stream in &mut slow {
        stream.write_all(b"GET /runs HTTP/1.1\r\nHost: ").unwrap();
    }
    assert_eq!(visitor.get("/runs").status, 200);
    drop(slow);
}

/// Opens as many connections as the page once had room for, each with a complete header and an unfinished body.
#[test]
fn unfinished_bodies_block_nobody() {
    let home = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(home.path().join("runs")).unwrap();
    assert_eq!(add(home.path(), "operator", "operator", PASSWORD).0, 0);
    let (_page, url) = serve_with(home.path(), &["--listen", "127.0.0.1:0", "--users", "users.toml"]);
    let before = Visitor::signed_in(&url, "operator", PASSWORD).expect("signed in");
    let unfinished = format!(
        "POST /sign-in HTTP/1.1\r\nHost: {0}\r\nOrigin: http://{0}\r\nContent-Type: application/x-www-form-urlencoded\r\n\
         Content-Length: 100\r\n\r\nname=",
        before.place
    );
    let slow: Vec<_> = (0..512)
        .map(|_| {
            let mut stream = TcpStream::connect(&before.place).unwrap();
            // The page has possibly closed the connection already.
            let _ = stream.write_all(unfinished.as_bytes());
            stream
        })
        .collect();
    assert_eq!(before.get("/runs").status, 200);
    let after = Visitor::signed_in(&url, "operator", PASSWORD).expect("signed in beside them");
    assert_eq!(after.get("/runs").status, 200);
    drop(slow);
}

#[test]
fn one_screen_has_control_any_can_hold() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let (one, other) = (shown.visitor(), shown.visitor());
    let resume = |folder: &Path| json!({ "order": "resume", "reason": "", "seen": status(folder)["number"] });
    let comes_to = |shown: &mut CellPage, state: &str| {
        let CellPage { run, folder, .. } = shown;
        run.until(state, |_| (status(folder)["state"] == state).then_some(()));
    };
    assert!(one.order(&shown.id, &json!({ "order": "hold", "reason": "" })).1);
    comes_to(&mut shown, "Held");
    assert!(one.order(&shown.id, &resume(&shown.folder)).1, "nobody had control");
    comes_to(&mut shown, "Execute");
    // The other screen can bring the cell to a safe state, but cannot make anything move.
    assert!(other.order(&shown.id, &json!({ "order": "hold", "reason": "" })).1);
    comes_to(&mut shown, "Held");
    let refused = other.order(&shown.id, &resume(&shown.folder));
    assert!(refused.0 == 409 && !refused.1 && refused.2.contains("control"), "{refused:?}");
    assert!(other.take_control(&shown.id).1);
    assert_eq!(one.order(&shown.id, &resume(&shown.folder)).0, 409);
    assert!(other.order(&shown.id, &resume(&shown.folder)).1);
    assert!(one.order(&shown.id, &json!({ "order": "abort", "reason": "" })).1);
    assert_eq!(shown.run.end().0, 3);
    let told = remarks(&shown);
    let pieces = ["another screen", "took control"];
    assert!(told.iter().any(|remark| pieces.iter().all(|piece| remark.contains(piece))), "{told:?}");
    let reader = regrind::journal::Reader::open(&shown.folder).unwrap();
    let stations: Vec<String> = reader.records(1).map(|record| record.unwrap().station).collect();
    assert!(stations.iter().any(|station| station.starts_with("page, screen ")), "{stations:?}");
}
