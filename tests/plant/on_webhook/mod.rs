//! Notifications of a cell by webhook, as an independent receiver and hostile ones see them.

use std::fs;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};

use regrind::journal::Reader;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::held::{ended_run, held_run, move_run};
use crate::peers::Peer;
use crate::program::{PATIENCE, Running, regrind, run, small_recipe};

const SECRET: &str = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw";
const ALL: &str =
    "[\"started\", \"held\", \"alarm\", \"accepted\", \"not_accepted\", \"stopped\", \"aborted\", \"interrupted\"]";

/// Writes a plant file with one webhook at a port of this computer, and the file of its secret.
fn write_plant(home: &Path, port: u16, more: &str) {
    let path = home.join("chat.secret");
    fs::write(&path, format!("{SECRET}\n")).unwrap();
    readable(&path, 0o600);
    let text = format!(
        "[plant]\ncell = \"cell-1\"\n\n[[notify.webhook]]\nname = \"chat\"\nurl = \"http://127.0.0.1:{port}/hook\"\nevents = {ALL}\n\
         secret_file = \"chat.secret\"\n{more}"
    );
    fs::write(home.join("plant.toml"), text).unwrap();
}

fn readable(path: &Path, mode: u32) {
    use std::os::unix::fs::PermissionsExt;
    fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
}

fn notify(home: &Path) -> Running {
    Running::new(regrind(&["notify", "--plant", "plant.toml", "--json"], home))
}

/// Returns the requests that a receiver accepted.
fn accepted(said: &[Value]) -> Vec<Value> {
    said.iter().filter(|line| line["answer"] == 200).map(|line| line["body"].clone()).collect()
}

/// Waits until the receiver has accepted a notification of an event.
fn until_event(peer: &mut Peer, event: &str) -> Value {
    peer.until(0, event, |said| accepted(said).into_iter().find(|body| body["event"] == event))
}

/// Returns the notifications that wait for the receiver on disk.
fn waiting(home: &Path) -> Vec<Value> {
    let text = fs::read_to_string(home.join("plant.notify/chat.queue")).unwrap_or_default();
    let lines = text.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    lines.filter(|line| !line["notification"].is_null()).map(|mut line| line["notification"].take()).collect()
}

fn ids(of: &[Value]) -> Vec<String> {
    of.iter().map(|one| one["id"].as_str().unwrap().to_owned()).collect()
}

/// Receiver that accepts connections and does with each what `hold` does. Returns its port, and a channel that has the
/// begin of each request.
fn hostile(hold: impl Fn(TcpStream) + Send + Clone + 'static) -> (u16, Receiver<String>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let (to, begun) = channel();
    std::thread::spawn(move || {
        while let Ok((mut stream, _)) = listener.accept() {
            let mut begin = [0; 4];
            let _ = stream.read_exact(&mut begin);
            if to.send(String::from_utf8_lossy(&begin).into_owned()).is_err() {
                return;
            }
            let hold = hold.clone();
            std::thread::spawn(move || hold(stream));
        }
    });
    (port, begun)
}

/// Lets a whole run go by whose receiver is hostile, with an order in its middle, and the notifications on disk
/// afterwards. No order may wait for the receiver: that is shown by the request that is still open.
fn run_beside(hold: impl Fn(TcpStream) + Send + Clone + 'static) -> (TempDir, Vec<Value>) {
    let home = TempDir::new().unwrap();
    let (port, begun) = hostile(hold);
    write_plant(home.path(), port, "");
    let mut notifier = notify(home.path());
    let (mut running, folder, held) = held_run(home.path(), 200.0);
    assert_eq!(begun.recv_timeout(PATIENCE).unwrap(), "POST");
    assert_eq!(held["state"], "Held");
    let (code, out, errors) = run(&["resume", &folder.display().to_string()], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 0);
    let waits = notifier.until("the end in the queue", |_| {
        Some(waiting(home.path())).filter(|waits| waits.iter().any(|one| one["event"] == "accepted"))
    });
    notifier.signal("KILL");
    notifier.end();
    (home, waits)
}

/// Asserts that `notifications` are those of one run that was held once and accepted, in the order of their records.
fn is_whole_run(notifications: &[Value]) {
    let events: Vec<_> = notifications.iter().map(|one| one["event"].as_str().unwrap()).collect();
    assert_eq!(events, ["started", "held", "accepted"], "{notifications:#?}");
    let records: Vec<_> = notifications.iter().map(|one| one["record"].as_u64().unwrap()).collect();
    assert!(records.is_sorted(), "{records:?}");
}

#[test]
#[ignore = "needs Python with venv, and standardwebhooks: see REGRIND_PYTHON"]
fn webhook_gets_signed_notifications_in_order() {
    let home = TempDir::new().unwrap();
    let mut peer = Peer::start("webhook_receiver.py", &["0", SECRET], home.path());
    let port = peer.port();
    write_plant(home.path(), port, "");
    // The first notification is refused, cut off and redirected before it is accepted.
    peer.does(&json!({ "answers": [503, 0, 307] }));
    peer.until(0, "the answers", |said| said.iter().any(|line| !line["answers"].is_null()).then_some(()));
    let mut notifier = notify(home.path());
    let (mut running, folder, held) = held_run(home.path(), 200.0);
    let told = until_event(&mut peer, "held");
    let name = folder.file_name().unwrap().to_str().unwrap().to_owned();
    let phase = held["phase"].as_object().map_or(held["phase"].clone(), |of| json!(of.keys().next().unwrap()));
    for (key, wanted) in [
        ("version", json!(1)),
        ("cell", json!("cell-1")),
        ("simulation", json!(true)),
        ("run", json!(name)),
        ("serial", json!("SN-0042")),
        ("part", held["part"].clone()),
        ("cycle", held["cycle"].clone()),
        ("reason", json!("looked at")),
        ("alarm", Value::Null),
        ("figures", Value::Null),
    ] {
        assert_eq!(told[key], wanted, "{key}: {told}");
    }
    assert_eq!(told["phase"].as_str().unwrap().to_lowercase(), phase.as_str().unwrap(), "{told}");
    assert!(told["text"].as_str().unwrap().starts_with("SIMULATION cell-1"), "{told}");
    assert!(!told["by"].is_null(), "{told}");
    // The event is the record that it names.
    let record = Reader::open(&folder).unwrap().records(told["record"].as_u64().unwrap()).next().unwrap().unwrap();
    assert_eq!(told["time"], json!(record.utc));

    let (code, out, errors) = run(&["resume", &folder.display().to_string()], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 0);
    let end = until_event(&mut peer, "accepted");
    let summary = regrind::report::run_summary(&folder).unwrap();
    let [[pv_um, _], [rms_um, _]] = summary.cycles.last().unwrap().figures.unwrap();
    assert_eq!((&end["figures"]["pv_um"], &end["figures"]["rms_um"]), (&json!(pv_um), &json!(rms_um)));
    notifier.line("that the end is delivered", |line| {
        line.contains("delivered") && line.contains(end["id"].as_str().unwrap())
    });
    notifier.signal("TERM");
    assert_eq!(notifier.end().0, 0);

    let said = peer.said();
    let requests: Vec<_> = said.iter().filter(|line| !line["body"].is_null()).collect();
    assert!(requests.iter().all(|line| line["verified"] == true && line["path"] == "/hook"), "{requests:#?}");
    assert!(requests.iter().all(|line| line["headers"]["webhook-id"] == line["body"]["id"]), "{requests:#?}");
    let answers: Vec<_> = requests.iter().map(|line| line["answer"].as_u64().unwrap()).collect();
    assert_eq!(
        answers,
        [503, 0, 307, 200, 200, 200],
        "each is repeated until it is accepted, and no other comes before"
    );
    assert!(requests[..4].iter().all(|line| line["body"] == requests[0]["body"]), "{requests:#?}");
    is_whole_run(&accepted(&said));

    // A further program does not repeat what was delivered.
    let before = peer.place();
    let mut again = notify(home.path());
    let other = TempDir::new().unwrap();
    let name = ended_run(other.path(), "accepted");
    move_run(other.path(), &name, home.path());
    peer.until(before, "the end of the other run", |said| {
        accepted(said).into_iter().find(|body| body["event"] == "accepted" && body["run"] == json!(name))
    });
    assert!(accepted(&peer.said()[before..]).iter().all(|body| body["run"] == json!(name)));
    again.signal("TERM");
    assert_eq!(again.end().0, 0);

    // Neither the secret nor the receiver is on record.
    for path in files(&home.path().join("runs")) {
        let bytes = fs::read(&path).unwrap();
        for word in [SECRET.as_bytes(), b"/hook"] {
            assert!(!bytes.windows(word.len()).any(|window| window == word), "{}", path.display());
        }
    }
}

/// Returns all files below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries
        .flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] })
        .filter(|path| path.is_file())
        .collect()
}

#[test]
#[ignore = "needs Python with venv, and standardwebhooks: see REGRIND_PYTHON"]
fn webhook_without_answer_delays_no_order_and_loses_nothing() {
    let (home, waits) = run_beside(|mut stream| {
        // It reads the request and answers nothing until the other end gives up.
        let _ = stream.read_to_end(&mut Vec::new());
    });
    is_whole_run(&waits);
    // A receiver that answers gets all of them, from a further program.
    let mut peer = Peer::start("webhook_receiver.py", &["0", SECRET], home.path());
    let port = peer.port();
    write_plant(home.path(), port, "");
    let mut notifier = notify(home.path());
    until_event(&mut peer, "accepted");
    assert_eq!(ids(&accepted(&peer.said())), ids(&waits));
    notifier.signal("TERM");
    assert_eq!(notifier.end().0, 0);
    assert!(waiting(home.path()).is_empty());
}

#[test]
fn flooding_webhook_is_cut_off_and_loses_nothing() {
    let (_home, waits) = run_beside(|mut stream| {
        let _ = stream.write_all(b"HTTP/1.1 200 OK\r\n");
        while stream.write_all(&[b'x'; 1 << 16]).is_ok() {}
    });
    is_whole_run(&waits);
}

#[test]
fn gone_program_is_notified_once() {
    let home = TempDir::new().unwrap();
    let (port, _begun) = hostile(drop);
    write_plant(home.path(), port, "");
    let (mut running, _, _) = held_run(home.path(), 200.0);
    running.signal("KILL");
    running.end();
    let gone = |waits: &[Value]| waits.iter().filter(|one| one["event"] == "interrupted").count();
    for _ in 0..2 {
        let mut notifier = notify(home.path());
        // A program that has tried once has also read the record.
        notifier.until("the interruption", |said| {
            let has_tried = said.iter().any(|line| line.contains("\"waits\""));
            (has_tried && gone(&waiting(home.path())) > 0).then_some(())
        });
        notifier.signal("TERM");
        assert_eq!(notifier.end().0, 0);
    }
    let waits = waiting(home.path());
    assert_eq!(gone(&waits), 1, "{waits:#?}");
    let last = waits.last().unwrap();
    assert!(last["id"].as_str().unwrap().ends_with(":interrupted"), "{last}");
}

#[test]
fn run_starts_notifications_of_its_plant() {
    let home = TempDir::new().unwrap();
    let (port, begun) = hostile(|stream| {
        let mut stream = stream;
        let _ = stream.write_all(b"HTTP/1.1 204 No Content\r\n\r\n");
    });
    write_plant(home.path(), port, "");
    let recipe = small_recipe(home.path(), 1000.0).display().to_string();
    let (code, out, errors) = run(&["run", &recipe, "--cell", "sim", "--plant", "plant.toml"], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(begun.recv_timeout(PATIENCE).unwrap(), "POST");
}

#[test]
fn bad_receivers_are_refused_at_their_place() {
    let home = TempDir::new().unwrap();
    write_plant(home.path(), 1, "");
    let good = fs::read_to_string(home.path().join("plant.toml")).unwrap();
    let check = |text: &str| {
        fs::write(home.path().join("plant.toml"), text).unwrap();
        let (code, out, errors) = run(&["check", "plant.toml", "--json"], home.path());
        let found: Value = serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}{errors}"));
        (code, found[0].clone())
    };
    let (code, found) = check(&good);
    assert_eq!((code, &found["kind"], &found["notes"]), (0, &json!("plant file"), &json!([])));
    for (from, to, key) in [
        ("http://127.0.0.1:1/hook", "http://plant.example/hook", "notify.webhook[0].url"),
        ("http://127.0.0.1:1/hook", "ftp://plant.example/hook", "notify.webhook[0].url"),
        ("http://127.0.0.1:1/hook", "https://a:b@plant.example/hook", "notify.webhook[0].url"),
        ("\"held\"", "\"heard\"", "notify.webhook[0].events[1]"),
        ("name = \"chat\"", "name = \"../chat\"", "notify.webhook[0].name"),
    ] {
        let (code, found) = check(&good.replace(from, to));
        assert_eq!((code, &found["problems"][0]["key"]), (2, &json!(key)), "{found}");
        assert!(found["problems"][0]["line"].as_u64() > Some(3), "{found}");
    }
    // A secret that others can read is refused, and told as a note on a computer that only checks the file.
    readable(&home.path().join("chat.secret"), 0o644);
    let (code, found) = check(&good);
    assert_eq!((code, found["notes"].as_array().unwrap().len()), (0, 1), "{found}");
    let (code, _, errors) = run(&["notify", "--plant", "plant.toml"], home.path());
    assert!(code == 2 && errors.contains("chmod") && !errors.contains(SECRET), "{code} {errors}");
}

#[test]
fn doctor_tries_receivers_without_a_notification() {
    let home = TempDir::new().unwrap();
    let (port, begun) = hostile(drop);
    write_plant(home.path(), port, "");
    let doctor = || {
        let (code, out, errors) = run(&["doctor", "--plant", "plant.toml", "--json"], home.path());
        let found: Vec<Value> = serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}{errors}"));
        let of = found.into_iter().find(|one| one["what"] == "notifications to chat").unwrap();
        (code, of["found"].as_str().unwrap().to_owned())
    };
    assert_eq!(doctor(), (0, "good".to_owned()));
    assert_ne!(begun.recv_timeout(PATIENCE).unwrap(), "POST");
    // Nobody listens at a port that was just given back.
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    write_plant(home.path(), free, "");
    assert_eq!(doctor(), (0, "notice".to_owned()), "a run does not need it");
}
