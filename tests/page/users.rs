//! People who sign in, from this computer and from others: who has access, which orders their roles allow, and what is
//! on record.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::Arc;

use regrind_testcell::http::{Visitor, raw_by_tls};
use rustls::pki_types::CertificateDer;
use rustls::{ClientConfig, RootCertStore};
use serde_json::json;

use crate::program::{Running, records_with, regrind, run, small_recipe};
use crate::{CellPage, serve_with};

/// Password that somebody who watched it being typed cannot guess.
pub const PASSWORD: &str = "grindstone 17 öl";

/// Adds a person as at a terminal, with the password from a pipe.
pub fn add(home: &Path, name: &str, role: &str, password: &str) -> (i32, String) {
    let mut command = regrind(&["users", "add", name, "--role", role], home);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    writeln!(child.stdin.take().unwrap(), "{password}").unwrap();
    let ended = child.wait_with_output().unwrap();
    (ended.status.code().unwrap(), String::from_utf8(ended.stderr).unwrap())
}

/// Returns a cell at work whose page has users, one for each role, named after the role.
fn shown_to_users(home: &Path) -> CellPage {
    for role in ["viewer", "quality", "operator", "engineer"] {
        assert_eq!(add(home, role, role, PASSWORD).0, 0, "{role}");
    }
    let recipe = small_recipe(home, 20.0).display().to_string();
    let mut run = Running::new(regrind(&["run", &recipe, "--cell", "sim", "--part", "SN-0042"], home));
    let folder = run.folder(home);
    let (page, url) = serve_with(home, &["--listen", "127.0.0.1:0", "--users", "users.toml"]);
    let id = folder.file_name().unwrap().to_string_lossy().into_owned();
    CellPage { run, page, url, folder, id }
}

#[test]
fn users_file_commands_and_errors() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("users.toml");
    assert_eq!(add(home.path(), "王 芳", "operator", PASSWORD).0, 0);
    assert_eq!(add(home.path(), "A. Smith", "engineer", PASSWORD).0, 0);
    let written = std::fs::read_to_string(&path).unwrap();
    assert!(written.contains("$argon2id$v=19$m=19456,t=2,p=1$") && !written.contains("grindstone"), "{written}");
    let (code, told, _) = run(&["users", "list"], home.path());
    assert_eq!((code, told.as_str()), (0, "engineer   A. Smith\noperator   王 芳\n"));
    // An invalid name or password changes nothing.
    for (name, password, expected) in [
        ("A. Smith", "short", "10 to 256"),
        ("", PASSWORD, "1 to 64"),
        ("A\u{202e}B", PASSWORD, "direction of the text"),
    ] {
        let (code, errors) = add(home.path(), name, "viewer", password);
        assert!(code == 2 && errors.contains(expected), "{name}: {errors}");
    }
    assert_eq!(std::fs::read_to_string(&path).unwrap(), written);
    let (code, _, errors) = run(&["users", "remove", "Nobody"], home.path());
    assert!(code == 2 && errors.contains("Nobody"), "{errors}");
    assert_eq!(run(&["users", "remove", "王 芳"], home.path()).0, 0);
    assert_eq!(run(&["users", "list"], home.path()).1, "engineer   A. Smith\n");
    // A damaged list of users keeps the page closed.
    for (text, expected) in [
        ("[[user]]\nname = \"a\"\nrole = \"king\"\nproof = \"\"", "unknown variant `king`"),
        ("[[user]]\nname = \"a\"\nrole = \"viewer\"\nproof = \"secret\"", "user 1 (\"a\")"),
        ("nonsense", "not a list of users"),
    ] {
        std::fs::write(&path, text).unwrap();
        let (code, _, errors) = run(&["serve", "--users", "users.toml", "--listen", "127.0.0.1:0"], home.path());
        assert!(code == 2 && errors.contains(expected), "{errors}");
    }
    let (code, _, errors) = run(&["serve", "--users", "nobody.toml", "--listen", "127.0.0.1:0"], home.path());
    assert!(code == 2 && errors.contains("regrind users add"), "{errors}");
}

#[cfg(unix)]
#[test]
#[cfg_attr(not(feature = "https"), ignore = "needs TLS: --features https")]
fn users_file_and_key_need_mode_600() {
    use std::os::unix::fs::PermissionsExt;
    let home = tempfile::tempdir().unwrap();
    assert_eq!(add(home.path(), "a", "viewer", PASSWORD).0, 0);
    let path = home.path().join("users.toml");
    assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    let (certificate, key, _) = certificate(home.path());
    let arguments =
        ["serve", "--listen", "127.0.0.1:0", "--users", "users.toml", "--certificate", &certificate, "--key", &key];
    for open in [&path, &PathBuf::from(&key)] {
        let permissions = |mode| std::fs::set_permissions(open, std::fs::Permissions::from_mode(mode)).unwrap();
        permissions(0o640);
        let (code, _, errors) = run(&arguments, home.path());
        assert!(code == 2 && errors.contains("mode 640") && errors.contains("chmod 600"), "{errors}");
        permissions(0o600);
    }
}

#[test]
fn roles_limit_orders_and_are_recorded() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = shown_to_users(home.path());
    shown.run.line("grinding", |line| line.contains("grinding"));
    let [viewer, quality, operator, engineer] = ["viewer", "quality", "operator", "engineer"]
        .map(|name| Visitor::signed_in(&shown.url, name, PASSWORD).unwrap_or_else(|| panic!("{name}")));
    let plain = |order: &str| json!({ "order": order, "reason": "" });
    for order in ["hold", "stop", "abort"] {
        let refused = viewer.order(&shown.id, &plain(order));
        assert!(refused.0 == 403 && refused.2.contains("viewer"), "{refused:?}");
    }
    assert_eq!(quality.order(&shown.id, &plain("abort")).0, 403);
    assert_eq!(quality.take_control(&shown.id).0, 403);
    assert!(quality.order(&shown.id, &plain("hold")).1);
    let number = |shown: &mut CellPage| {
        let CellPage { run, folder, .. } = shown;
        run.until("Held", |_| {
            let (_, said, _) = crate::program::run(&["status", ".", "--json"], folder);
            let status = serde_json::from_str::<serde_json::Value>(&said).ok()?["status"].clone();
            (status["state"] == "Held").then(|| status["number"].clone())
        })
    };
    let seen = number(&mut shown);
    let resume = json!({ "order": "resume", "reason": "", "seen": seen });
    assert_eq!(quality.order(&shown.id, &resume).0, 403);
    let resumed = operator.order(&shown.id, &resume);
    assert!(resumed.1, "{resumed:?}");
    assert!(engineer.order(&shown.id, &plain("abort")).1);
    assert_eq!(shown.run.end().0, 3);
    let remarks: Vec<String> = records_with(&shown.folder, "remark")
        .iter()
        .map(|record| record["remark"].as_str().unwrap_or_default().to_owned())
        .collect();
    for words in [["quality (quality)", "signed in"], ["viewer (viewer)", "refused the order stop"]] {
        assert!(remarks.iter().any(|remark| words.iter().all(|of| remark.contains(of))), "{words:?}: {remarks:?}");
    }
    let reader = regrind::journal::Reader::open(&shown.folder).unwrap();
    let operators: Vec<String> = reader.records(1).map(|record| record.unwrap().actor).collect();
    for pieces in [
        ["quality (quality), by", "by a program of"],
        ["operator (operator)", "(operator), by"],
        ["engineer (engineer)", "(engineer), by"],
    ] {
        let named = operators.iter().any(|operator| pieces.iter().all(|piece| operator.contains(piece)));
        assert!(named, "{pieces:?}: {operators:?}");
    }
}

#[test]
fn wrong_passwords_are_throttled() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = shown_to_users(home.path());
    shown.run.line("grinding", |line| line.contains("grinding"));
    let signed_in = Visitor::signed_in(&shown.url, "operator", PASSWORD).unwrap();
    let stranger = Visitor::stranger(&shown.url);
    // No part of the page is available without signing in, and no key replaces it.
    for path in ["/", "/runs", "/token", "/?key=0", &format!("/runs/{}/events", shown.id)] {
        let answer = stranger.get(path);
        assert!(answer.status == 401 && answer.text().contains("name=\"password\""), "{path}: {answer:?}");
    }
    // From another page.
    let form = ("Content-Type", "application/x-www-form-urlencoded");
    let body = format!("name=operator&password={}", PASSWORD.replace(' ', "+"));
    assert_eq!(stranger.post("/sign-in", &[form, ("Origin", "http://evil.example")], body.as_bytes()).status, 403);
    let tries: Vec<u16> =
        (0..1000).map(|guess| stranger.try_to_sign_in("operator", &format!("guess {guess}")).status).collect();
    assert!(tries[..10].iter().all(|status| *status == 401), "{:?}", &tries[..10]);
    assert!(tries[10..].iter().filter(|status| **status == 429).count() > 900, "{tries:?}");
    assert!(tries.iter().all(|status| [401, 429].contains(status)), "{tries:?}");
    // Other users at that place can sign in; the process that serves the page logs this.
    assert!(Visitor::signed_in(&shown.url, "engineer", PASSWORD).is_some());
    // A user who has signed in stays signed in, and gives orders.
    assert!(signed_in.order(&shown.id, &json!({ "order": "stop", "reason": "" })).1);
    assert_eq!(shown.run.end().0, 1);
    let remarks = records_with(&shown.folder, "remark");
    let wrong = remarks.iter().filter(|record| record["remark"].as_str().unwrap().contains("a wrong name or password"));
    assert!(wrong.count() > 0, "{remarks:?}");
    shown.page.interrupt();
    let (_, told) = shown.page.end();
    let lines_with = |pieces: &[&str]| {
        let lines = told.lines().filter(|line| line.starts_with("page: "));
        lines.filter(|line| pieces.iter().all(|piece| line.contains(piece))).count()
    };
    assert_eq!(lines_with(&["engineer (engineer)", "signed in"]), 1, "{told}");
    assert!(lines_with(&["refused", "password", "operator"]) > 0, "{told}");
    assert!(lines_with(&["too many requests"]) > 0, "{told}");
}

#[test]
fn removed_user_is_signed_out() {
    let home = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(home.path().join("runs")).unwrap();
    for name in ["stays", "goes", "changes"] {
        assert_eq!(add(home.path(), name, "operator", PASSWORD).0, 0);
    }
    let (_page, url) = serve_with(home.path(), &["--listen", "127.0.0.1:0", "--users", "users.toml"]);
    let [stays, goes, changes] =
        ["stays", "goes", "changes"].map(|name| Visitor::signed_in(&url, name, PASSWORD).unwrap());
    assert!([&stays, &goes, &changes].iter().all(|visitor| visitor.get("/runs").status == 200));
    assert_eq!(run(&["users", "remove", "goes"], home.path()).0, 0);
    assert_eq!(add(home.path(), "changes", "operator", "another 1234567").0, 0);
    assert_eq!([&stays, &goes, &changes].map(|visitor| visitor.get("/runs").status), [200, 401, 401]);
    assert!(Visitor::signed_in(&url, "goes", PASSWORD).is_none());
    let token = stays.token();
    let out = stays.post("/sign-out", &[("Origin", &stays.origin()), ("X-Regrind-Token", &token)], b"");
    assert_eq!((out.status, stays.get("/runs").status), (204, 401));
    // A change that keeps the length and the time of the file is seen too.
    let path = home.path().join("users.toml");
    let changes = Visitor::signed_in(&url, "changes", "another 1234567").unwrap();
    let written_at = std::fs::metadata(&path).unwrap().modified().unwrap();
    let listed = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, listed.replace("\"operator\"", "\"engineer\"")).unwrap();
    let file = std::fs::File::options().write(true).open(&path).unwrap();
    file.set_modified(written_at).unwrap();
    assert_eq!((changes.get("/runs").status, std::fs::metadata(&path).unwrap().len()), (401, listed.len() as u64));
    // If the list cannot be read, nobody has access.
    let stays = Visitor::signed_in(&url, "stays", PASSWORD).unwrap();
    std::fs::write(home.path().join("users.toml"), "broken").unwrap();
    assert_eq!(stays.get("/runs").status, 401);
}

/// Returns a certificate for `cell-2.example` and its key, as files, and a configuration that trusts only this
/// certificate.
pub fn certificate(home: &Path) -> (String, String, Arc<ClientConfig>) {
    let made = rcgen::generate_simple_self_signed(["cell-2.example".to_owned(), "127.0.0.1".to_owned()]).unwrap();
    let [certificate, key] = ["cell.pem", "cell.key"].map(|name| home.join(name).display().to_string());
    std::fs::write(&certificate, made.cert.pem()).unwrap();
    std::fs::write(&key, made.signing_key.serialize_pem()).unwrap();
    #[cfg(unix)]
    std::fs::set_permissions(&key, std::os::unix::fs::PermissionsExt::from_mode(0o600)).unwrap();
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from(made.cert)).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let trusting = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    (certificate, key, Arc::new(trusting))
}

#[test]
#[cfg_attr(not(feature = "https"), ignore = "needs TLS: --features https")]
fn tls_accepts_certificate_names_only() {
    let home = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(home.path().join("runs")).unwrap();
    assert_eq!(add(home.path(), "A. Smith", "operator", PASSWORD).0, 0);
    let (certificate, key, tls) = certificate(home.path());
    let (_page, url) = serve_with(
        home.path(),
        &["--listen", "0.0.0.0:0", "--certificate", &certificate, "--key", &key, "--users", "users.toml"],
    );
    let port = url.trim_end_matches('/').rsplit(':').next().unwrap();
    assert_eq!(url, format!("https://cell-2.example:{port}/"));
    let at = |name: &str| {
        let mut visitor = Visitor::stranger(&format!("http://127.0.0.1:{port}"));
        visitor.tls = Some((Arc::clone(&tls), name.to_owned()));
        visitor
    };
    let visitor = at("cell-2.example").sign_in("A. Smith", PASSWORD).expect("signed in");
    assert_eq!(visitor.get("/runs").status, 200);
    assert!(visitor.get("/runs").text().contains("A. Smith"));
    assert_eq!(at("127.0.0.1").get("/").status, 401, "the address that the certificate names too");
    let cookie = at("cell-2.example").try_to_sign_in("A. Smith", PASSWORD);
    assert!(cookie.header("set-cookie")[0].contains("; Secure"), "{cookie:?}");
    assert_eq!(cookie.header("strict-transport-security"), ["max-age=31536000"]);
    // A name that leads here but is not in the certificate; another port; no encryption.
    for host in [format!("evil.example:{port}"), "cell-2.example:1".into(), format!("localhost:{port}")] {
        let request = format!("GET / HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
        let answer = raw_by_tls(&visitor.place, &tls, "cell-2.example", request.as_bytes());
        assert_eq!(answer.status, 421, "{host}");
    }
    assert_eq!(Visitor::stranger(&format!("http://127.0.0.1:{port}")).get("/").status, 0);
    // A certificate that does not match its key, and files that are not certificates or keys.
    let other = home.path().join("other");
    std::fs::create_dir(&other).unwrap();
    let (_, other_key, _) = self::certificate(&other);
    for (certificate, key, expected) in [
        (&certificate, &other_key, "cannot be used"),
        (&key, &key, "no certificate in PEM"),
        (&certificate, &certificate, "no private key in PEM"),
    ] {
        std::fs::set_permissions(key, std::os::unix::fs::PermissionsExt::from_mode(0o600)).unwrap();
        let arguments = ["serve", "--certificate", certificate, "--key", key, "--users", "users.toml"];
        let (code, _, errors) = run(&arguments, home.path());
        assert!(code == 2 && errors.contains(expected), "{errors}");
    }
}
