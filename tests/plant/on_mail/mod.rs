//! Notifications of a cell by mail, on a real mail server.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::held::held_run;
use crate::peers::Peer;
use crate::program::{Running, regrind, run};

/// Writes a certificate of `localhost` and its key to files of a folder.
fn certificate(folder: &Path, name: &str) {
    let made = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    fs::write(folder.join(format!("{name}.pem")), made.cert.pem()).unwrap();
    fs::write(folder.join(format!("{name}.key")), made.signing_key.serialize_pem()).unwrap();
}

fn write_plant(home: &Path, port: u16, more: &str) {
    let text = format!(
        "[plant]\ncell = \"cell-1\"\n\n[[notify.mail]]\nname = \"shift\"\nserver = \"localhost\"\nport = {port}\n\
         from = \"Cell 1 <cell-1@shop.example>\"\nto = [\"a@shop.example\", \"b@shop.example\"]\nevents = [\"held\", \"accepted\"]\n\
         user = \"cell-1\"\n{more}"
    );
    fs::write(home.join("plant.toml"), text).unwrap();
}

fn write_password(home: &Path, password: &str) {
    use std::os::unix::fs::PermissionsExt;
    fs::write(home.join("mail.password"), password).unwrap();
    fs::set_permissions(home.join("mail.password"), fs::Permissions::from_mode(0o600)).unwrap();
}

#[test]
#[ignore = "needs Python with venv, and aiosmtpd: see REGRIND_PYTHON"]
fn mail_is_encrypted_and_signed_in() {
    let home = TempDir::new().unwrap();
    for name in ["its", "foreign"] {
        certificate(home.path(), name);
    }
    let mut server = Peer::start("mail_server.py", &["its.pem", "its.key", "cell-1", "of-the-cell"], home.path());
    let port = server.port();
    let doctor = || {
        let (_, out, errors) = run(&["doctor", "--plant", "plant.toml", "--json"], home.path());
        let found: Vec<Value> = serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}{errors}"));
        found.into_iter().find(|one| one["what"] == "notifications to shift").unwrap()
    };
    let files = |certificates: &str| format!("password_file = \"mail.password\"\ncertificates = \"{certificates}\"\n");

    // A server that does not prove its identity gets no password, and a wrong password is told.
    write_password(home.path(), "wrong");
    write_plant(home.path(), port, &files("foreign.pem"));
    assert_eq!(doctor()["found"], "notice");
    assert!(server.said().iter().all(|line| line["refused"].is_null()), "{:?}", server.said());
    write_plant(home.path(), port, &files("its.pem"));
    assert_eq!(doctor()["found"], "notice");
    server.until(0, "a refused user", |said| said.iter().any(|line| line["refused"] == "cell-1").then_some(()));
    write_password(home.path(), "of-the-cell");
    assert_eq!(doctor()["found"], "good");

    let mut notifier = Running::new(regrind(&["notify", "--plant", "plant.toml", "--json"], home.path()));
    let (mut running, folder, _) = held_run(home.path(), 200.0);
    let mail = |event: &'static str| {
        move |said: &[Value]| {
            let has = |line: &&Value| line["body"].as_str().is_some_and(|body| body.contains(event));
            said.iter().find(has).cloned()
        }
    };
    let held = server.until(0, "the hold", mail(": held in"));
    let name = folder.file_name().unwrap().to_str().unwrap();
    assert_eq!((&held["encrypted"], &held["authenticated"]), (&json!(true), &json!(true)));
    assert_eq!(held["sender"], "cell-1@shop.example");
    assert_eq!(held["receivers"], json!(["a@shop.example", "b@shop.example"]));
    let subject = held["headers"]["Subject"].as_str().unwrap();
    assert!(subject.starts_with("SIMULATION cell-1") && subject.contains("looked at"), "{subject}");
    assert!(held["headers"]["Message-ID"].as_str().unwrap().starts_with(&format!("<{name}.")), "{held}");
    for word in [name, "SN-0042", "looked at"] {
        assert!(held["body"].as_str().unwrap().contains(word), "{held}");
    }
    let (code, out, errors) = run(&["resume", &folder.display().to_string()], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 0);
    let end = server.until(0, "the end", mail("ACCEPTED"));
    assert!(end["body"].as_str().unwrap().contains("PV"), "{end}");
    notifier.signal("TERM");
    assert_eq!(notifier.end().0, 0);
}
