//! Simulated machines in one process and the run in another, over Modbus TCP and over Modbus RTU on pseudo-terminals.

use std::fs;
use std::path::Path;

use crate::program::{Running, SMALL_RECIPE_POINTS, changed, records_with, regrind, small_recipe};
use regrind::journal::verify;
use serde_json::Value;

/// Runs to the end in a process other than that of the machines. Returns the transfer time per point on the wire, in
/// ms.
fn run_against(home: &Path, recipe: &str, cell: &str, serving: &mut Running) -> f64 {
    let mut running = Running::new(regrind(&["run", recipe, "--cell", cell, "--runs", "runs", "--part", "SN-2"], home));
    let folder = running.folder(home);
    let line = running.line("time per point", |line| line.contains("ms per point"));
    println!("{line}");
    let (code, errors) = running.end();
    let said = running.output_lines.join("\n");
    assert_eq!(code, 0, "{said}\n{errors}");
    assert!(said.contains("SIMULATION  ACCEPTED") && errors.is_empty(), "{said}\n{errors}");
    let verified = verify(&folder).unwrap();
    assert!(verified.closed && verified.open_intents.is_empty(), "{verified:?}");
    let result: Value = serde_json::from_str(&fs::read_to_string(folder.join("result.json")).unwrap()).unwrap();
    assert_eq!(result["simulation"], true, "{result}");
    let transfers = records_with(&folder, "transfer");
    assert_eq!(transfers.len(), result["cycles"].as_array().unwrap().len(), "one for each measurement");
    // The points of the part and 25 of the reference sphere.
    assert!(transfers.iter().all(|t| t["transfer"]["points"] == SMALL_RECIPE_POINTS + 25), "{transfers:?}");
    serving.interrupt();
    assert_eq!(serving.end().0, 0, "a simulation that is ended by Ctrl-C ended well");
    transfers[0]["transfer"]["ms_per_point"].as_f64().unwrap()
}

#[test]
fn run_over_modbus_tcp() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 2000.0);
    let recipe = recipe.to_str().unwrap();
    let open = changed("config/modbus-tcp.toml", &[("15021", "0"), ("15022", "0")]);
    fs::write(home.path().join("open.toml"), open).unwrap();
    let mut serving = Running::new(regrind(&["simulate", recipe, "--cell", "open.toml", "--json"], home.path()));
    let wires: Value = serde_json::from_str(&serving.line("wires", |_| true)).unwrap();
    assert_eq!(wires["simulation"], true);
    let port = |machine: &str| wires[machine]["port"].to_string();
    let bound = changed("config/modbus-tcp.toml", &[("15021", &port("cmm")), ("15022", &port("grinder"))]);
    fs::write(home.path().join("cell.toml"), bound).unwrap();
    let ms = run_against(home.path(), recipe, "cell.toml", &mut serving);
    println!("Modbus TCP: {ms:.3} ms a point");
}

#[test]
fn run_over_modbus_rtu() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 2000.0);
    let recipe = recipe.to_str().unwrap();
    let devices = format!("device = \"{}/", home.path().display());
    let text = changed("config/serial-rtu.toml", &[("device = \"/tmp/regrind-", &devices)]);
    fs::write(home.path().join("cell.toml"), text).unwrap();
    let mut serving = Running::new(regrind(&["simulate", recipe, "--cell", "cell.toml"], home.path()));
    serving.line("its last word", |line| line.starts_with("Ctrl-C"));
    assert!(serving.output_lines.iter().any(|line| line.contains("115200 baud") && line.starts_with("SIMULATION")));
    let ms = run_against(home.path(), recipe, "cell.toml", &mut serving);
    println!("Modbus RTU, 115,200 baud: {ms:.3} ms a point");
    // The three coordinates alone are 24 bytes of 10 bits. A line of this speed cannot transfer them in less time.
    assert!(ms > 24.0 * 10.0 / 115.2, "{ms} ms a point is faster than the line");
    assert!(fs::symlink_metadata(home.path().join("cmm.tty")).is_err(), "the links go with the simulation");
}
