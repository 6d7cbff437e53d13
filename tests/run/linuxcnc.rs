//! A whole part that LinuxCNC itself grinds: it runs the program of every pass, the simulated wheel follows the path that it executed, and the
//! simulated probe touches what that left.
//!
//! Each test runs itself again in namespaces of its own, where ports, shared memory, locks and processes are nobody else's and end with it.
//! LinuxCNC goes by its own clock: nothing here is judged by time.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use regrind::cell::StateName;
use regrind::drive::{Request, ask};
use serde_json::Value;

use crate::program::{Running, changed, regrind, replaced, root, run};

/// Set for the test that runs within.
const WITHIN: &str = "REGRIND_WITHIN_LINUXCNC";
/// LinuxCNC does not run as root.
const ACCOUNT: [&str; 6] = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "env", "HOME=/tmp/home"];
const FOLDER: &str = "/tmp/regrind-linuxcnc";

/// Runs a test beside a controller of its own; `name` is its path in this program.
fn beside_linuxcnc(name: &str, test: impl FnOnce(&Path)) {
    if std::env::var_os(WITHIN).is_some() {
        let home = tempfile::tempdir().unwrap();
        let _controller = controller();
        return test(home.path());
    }
    // Locks of machines are kept outside /tmp too, and every controller here has the same address.
    let prepare = "for folder in /tmp /run/lock /var/lock /var/tmp; do
        [ ! -d $folder ] || { mount -t tmpfs tmpfs $folder; chmod 1777 $folder; }
    done; ip link set lo up; exec \"$@\"";
    let mut command = Command::new("unshare");
    command.args(["--ipc", "--net", "--pid", "--mount", "--fork", "--mount-proc", "--kill-child"]);
    command.args(["sh", "-euc", prepare, "sh"]).arg(std::env::current_exe().unwrap());
    command.args(["--exact", name, "--include-ignored", "--nocapture"]);
    command.env(WITHIN, "1").env_remove("TMPDIR").env_remove("DISPLAY");
    let output = command.output().expect("unshare starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (told, errors) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success() && told.contains("1 passed"), "{told}\n{errors}");
    println!("{told}");
}

/// Starts LinuxCNC as it is shipped, by an account of its own.
fn controller() -> Running {
    // Where that account finds it.
    let shipped = root().join("config/linuxcnc");
    let script = format!(
        "cp -r {} /tmp/linuxcnc; chmod -R a+rX /tmp/linuxcnc; mkdir /tmp/home {FOLDER}; chown 65534:65534 /tmp/home {FOLDER}",
        shipped.display()
    );
    assert!(Command::new("sh").args(["-euc", &script]).status().unwrap().success());
    let mut start = Command::new(ACCOUNT[0]);
    start.args(&ACCOUNT[1..]).args(["/tmp/linuxcnc/start", FOLDER]).current_dir("/tmp");
    let mut controller = Running::new(start);
    controller.line("controller", |line| line.starts_with("LinuxCNC answers"));
    controller
}

/// The middle of the shipped free-form mirror, in a fixture that holds it to microns, with a feed at which a pass takes seconds.
fn recipe(home: &Path, [pv_um, rms_um]: [f64; 2]) -> String {
    let limits = (format!("pv_um = {pv_um:.1}"), format!("rms_um = {rms_um:.1}"));
    let changes = [
        ("width_mm = 102.0", "width_mm = 40.0"),
        ("height_mm = 62.0", "height_mm = 24.0"),
        ("half_x_mm = 51.0", "half_x_mm = 20.0"),
        ("half_y_mm = 31.0", "half_y_mm = 12.0"),
        ("columns = 60", "columns = 24"),
        ("rows = 30", "rows = 15"),
        ("accuracy_nm = 0.5", "spacing_mm = 0.5"),
        ("cutoff_mm = 5.0", "cutoff_mm = 6.0"),
        ("start = \"search\"", "start = \"fixture\"\nhold = [\"x\", \"y\", \"rz\"]"),
        ("pv_um = 7.0", &limits.0),
        ("rms_um = 1.0\n", &format!("{}\n", limits.1)),
        ("feed_mm_min = 1000.0", "feed_mm_min = 20000.0\nchord_error_um = 0.5"),
        ("track_mm = 0.24", "track_mm = 0.5"),
        ("spark_out_passes = 1", "spark_out_passes = 0"),
        ("radius_mm = 12.5", "radius_mm = 25.0"),
        ("stock_um = 200.0", "stock_um = 60.0"),
        // The lag goes with the feed, which is twenty times the usual one.
        ("[simulation]\nseed = 1", &format!("[simulation]\nseed = 1\nspeed = 2000.0\n\n{SIMULATION}")),
    ];
    let path = home.join("part.toml");
    fs::write(&path, changed("recipes/freeform-mirror.toml", &changes)).unwrap();
    path.display().to_string()
}

const SIMULATION: &str = "[simulation.grinder]
following_um = 0.005

[simulation.cmm]
noise_um = 0.1
translation_mm = [0.0, 0.0, 0.15]
rotation_deg = [0.05, -0.04, 0.0]
loading_shift_um = 1.0
loading_turn_deg = 0.0005
";

/// The shipped cell, whose programs are run by another account here.
fn cell(home: &Path) -> String {
    let words: Vec<String> = ACCOUNT.iter().chain(&["/tmp/linuxcnc/executed-path"]).map(|w| format!("{w:?}")).collect();
    let path = home.join("cell.toml");
    let by_account = [("[\"linuxcnc/executed-path\"]", format!("[{}]", words.join(", ")))];
    let changes: Vec<(&str, &str)> = by_account.iter().map(|(from, to)| (*from, to.as_str())).collect();
    fs::write(&path, changed("config/linuxcnc-simulated.toml", &changes)).unwrap();
    path.display().to_string()
}

/// What the programs wrote of themselves while LinuxCNC ran them, in the order of their cycles.
fn records() -> Vec<String> {
    let entries = fs::read_dir(format!("{FOLDER}/programs")).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = entries.filter(|path| path.extension().is_some_and(|e| e == "log")).collect();
    files.sort();
    files.iter().map(|file| fs::read_to_string(file).unwrap()).collect()
}

/// Whether a program began and ended once, after one preparation.
fn ran_once(record: &str) -> bool {
    let words: Vec<&str> = record.lines().collect();
    matches!(words[..], [prepared, "begin", "end"] if prepared.starts_with("prepared "))
}

/// Lets a run go to its end, with a person beside it who lets it go on where it holds: LinuxCNC may be kept waiting on a busy computer until the
/// cell holds before the step that it does not answer. Returns what was said.
fn to_its_end(mut running: Running, home: &Path) -> String {
    let folder = || fs::read_dir(home.join("runs")).ok()?.next()?.ok().map(|entry| entry.path());
    while !running.is_over() {
        if let Some(folder) = folder()
            && let Ok(status) = ask(&folder, &Request::Status)
            && status.status.state == StateName::Held
        {
            let resume = Request::Resume { reason: "seen".into(), seen: Some(status.status.number) };
            // It may have gone on meanwhile.
            let _ = ask(&folder, &resume);
        }
        std::thread::park_timeout(Duration::from_millis(50));
    }
    let (code, error) = running.end();
    let told = running.said.join("\n");
    println!("{told}");
    assert_eq!(code, 0, "{told}\n{error}");
    told
}

#[test]
#[ignore = "needs LinuxCNC: Debian package linuxcnc-uspace, and root for namespaces"]
fn a_part_is_ground_along_the_path_that_linuxcnc_executed_until_it_is_accepted() {
    let name = "linuxcnc::a_part_is_ground_along_the_path_that_linuxcnc_executed_until_it_is_accepted";
    beside_linuxcnc(name, |home| {
        let (recipe, cell) = (recipe(home, [7.0, 1.2]), cell(home));
        let running = Running::new(regrind(&["run", &recipe, "--cell", &cell, "--runs", "runs"], home));
        let told = to_its_end(running, home);
        assert!(told.contains("SIMULATION  ACCEPTED"), "{told}");
        let records = records();
        assert!(records.len() >= 3 && records.iter().all(|record| ran_once(record)), "{records:?}\n{told}");
        let (code, told, _) = run(&["audit", "verify"], home);
        assert_eq!(code, 0, "{told}");
    });
}

#[test]
#[ignore = "needs LinuxCNC: Debian package linuxcnc-uspace, and root for namespaces"]
fn a_run_that_is_killed_while_linuxcnc_grinds_goes_on_with_the_same_pass() {
    let name = "linuxcnc::a_run_that_is_killed_while_linuxcnc_grinds_goes_on_with_the_same_pass";
    beside_linuxcnc(name, |home| {
        // One pass will do, and the world outlives the run.
        let (recipe, cell) = (recipe(home, [60.0, 12.0]), cell(home));
        let mut world = Running::new(regrind(&["simulate", &recipe, "--cell", &cell, "--json"], home));
        let bound: Value = serde_json::from_str(&world.line("its wires", |line| line.starts_with('{'))).unwrap();
        let text = fs::read_to_string(&cell).unwrap();
        fs::write(&cell, replaced(&text, "port = 0 ", &format!("port = {} ", bound["cmm"]["port"]))).unwrap();
        let mut first = Running::new(regrind(&["run", &recipe, "--cell", &cell, "--runs", "runs"], home));
        first.line("grinding", |line| line.starts_with("cycle 1: grinding"));
        // Some seconds before its end, and where this computer was too slow for that, after it: it runs once all the same.
        first.signal("KILL");
        first.end();
        // It waits for a person who has looked at the machines.
        let folder = fs::read_dir(home.join("runs")).unwrap().next().unwrap().unwrap().path();
        let resumed = Running::new(regrind(&["resume", folder.to_str().unwrap()], home));
        let told = to_its_end(resumed, home);
        assert!(told.contains("ACCEPTED"), "{told}");
        let records = records();
        assert!(records.len() == 1 && ran_once(&records[0]), "{records:?}");
    });
}
