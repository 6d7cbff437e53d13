//! A whole run with a measuring machine that is connected by I++ DME, and a machine that is only inspected.

use serde_json::Value;

use crate::program::{Running, changed, regrind, root, run, small_recipe};

#[test]
fn part_made_over_ippdme() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 2000.0);
    let cell = root().join("config/ippdme.toml");
    let typed = ["run", recipe.to_str().unwrap(), "--cell", cell.to_str().unwrap(), "--runs", "runs"];
    let (code, told, error) = run(&typed, home.path());
    assert_eq!(code, 0, "{told}\n{error}");
    for piece in ["travel between targets", "ACCEPTED"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
    let (code, told, _) = run(&["audit", "verify"], home.path());
    assert_eq!(code, 0, "{told}");
}

#[test]
fn doctor_inspects_ippdme_server() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 2000.0);
    let open = home.path().join("open.toml");
    std::fs::write(&open, changed("config/ippdme.toml", &[])).unwrap();
    let typed = ["simulate", recipe.to_str().unwrap(), "--cell", open.to_str().unwrap(), "--json"];
    let mut machines = Running::new(regrind(&typed, home.path()));
    let bound: Value = serde_json::from_str(&machines.line("its wires", |line| line.starts_with('{'))).unwrap();
    let port = |machine: &str| format!("port = {}", bound[machine]["port"]);
    let text = changed(
        "config/ippdme.toml",
        &[("host = \"127.0.0.1\"\nport = 0                    #", "host = \"127.0.0.1\"\nport = CMM #")],
    );
    let text = text.replace("port = CMM", &port("cmm")).replace("port = 0", &port("grinder"));
    let cell = home.path().join("cell.toml");
    std::fs::write(&cell, text).unwrap();
    for _ in 0..2 {
        let (code, told, error) = run(&["doctor", cell.to_str().unwrap()], home.path());
        assert_eq!(code, 0, "{told}\n{error}");
        for piece in ["CartCMM_Simulated", "I++ DME 1.4 is IDLE"] {
            assert!(told.contains(piece), "{piece}: {told}");
        }
    }
}
