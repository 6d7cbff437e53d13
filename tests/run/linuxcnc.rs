//! LinuxCNC grinds a whole part: it runs the program of every pass, the simulated wheel follows the path that LinuxCNC
//! executed, and the simulated probe touches the resulting surface.
//!
//! Each test runs itself again in its own namespaces, where ports, shared memory, locks and processes are private and
//! end with it. LinuxCNC uses its own clock, so nothing here is judged by time.

use std::fs;
use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use regrind::cell::{AlarmId, StateName};
use regrind::drive::{Request, send_request};
use serde_json::Value;

use crate::namespaces::{ACCOUNT, in_namespaces};
use crate::program::{Running, changed, only_run, regrind, replaced, root, run, run_folders};

/// LinuxCNC does not run as root, and its account has its own home.
const AT_HOME: [&str; 2] = ["env", "HOME=/tmp/home"];
const FOLDER: &str = "/tmp/regrind-linuxcnc";

/// Runs a test with its own controller. It needs its own namespaces because every controller here has the same address.
/// `name` is the path of the test in this program.
fn beside_linuxcnc(name: &str, test: impl FnOnce(&Path)) {
    in_namespaces(name, |home| {
        let _controller = controller();
        test(home);
    });
}

/// Starts LinuxCNC with the shipped configuration, under its own account.
fn controller() -> Running {
    // A place that this account can read.
    let shipped = root().join("config/linuxcnc");
    let script = format!(
        "cp -r {} /tmp/linuxcnc; chmod -R a+rX /tmp/linuxcnc; mkdir /tmp/home {FOLDER}; chown 65534:65534 /tmp/home {FOLDER}",
        shipped.display()
    );
    assert!(Command::new("sh").args(["-euc", &script]).status().unwrap().success());
    let mut start = Command::new(ACCOUNT[0]);
    start.args(&ACCOUNT[1..]).args(AT_HOME).args(["/tmp/linuxcnc/start", FOLDER]).current_dir("/tmp");
    let mut controller = Running::new(start);
    controller.line("controller", |line| line.starts_with("LinuxCNC answers"));
    controller
}

/// Returns the middle of the shipped free-form mirror, in a fixture that is accurate to micrometres, with a feed at
/// which a pass takes seconds.
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
        ("start = \"search\"", "start = \"fixture\"\nlock = [\"x\", \"y\", \"rz\"]"),
        ("pv_um = 7.0", &limits.0),
        ("rms_um = 1.0\n", &format!("{}\n", limits.1)),
        ("feed_mm_min = 1000.0", "feed_mm_min = 20000.0\nchord_error_um = 0.5"),
        ("track_mm = 0.24", "track_mm = 0.5"),
        ("spark_out_passes = 1", "spark_out_passes = 0"),
        ("radius_mm = 12.5", "radius_mm = 25.0"),
        ("stock_um = 200.0", "stock_um = 60.0"),
        // The lag is proportional to the feed, which is twenty times the usual one.
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

/// Returns the shipped cell, whose programs another account runs here.
fn cell(home: &Path) -> String {
    let words: Vec<String> =
        ACCOUNT.iter().chain(&AT_HOME).chain(&["/tmp/linuxcnc/executed-path"]).map(|w| format!("{w:?}")).collect();
    let path = home.join("cell.toml");
    let by_account = [("[\"linuxcnc/executed-path\"]", format!("[{}]", words.join(", ")))];
    let changes: Vec<(&str, &str)> = by_account.iter().map(|(from, to)| (*from, to.as_str())).collect();
    fs::write(&path, changed("config/linuxcnc-simulated.toml", &changes)).unwrap();
    path.display().to_string()
}

/// Returns the shipped cell without LinuxCNC: its controller is simulated too.
fn simulated_cell(home: &Path) -> String {
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let programs = home.join("programs");
    fs::create_dir(&programs).unwrap();
    let changes = [
        ("executed_path = [\"linuxcnc/executed-path\"]", String::new()),
        ("port = 5007", format!("port = {free}")),
        ("/tmp/regrind-linuxcnc/programs", programs.display().to_string()),
    ];
    let changes: Vec<(&str, &str)> = changes.iter().map(|(from, to)| (*from, to.as_str())).collect();
    let path = home.join("cell.toml");
    fs::write(&path, changed("config/linuxcnc-simulated.toml", &changes)).unwrap();
    path.display().to_string()
}

#[test]
fn part_ground_by_simulated_controller() {
    let home = tempfile::tempdir().unwrap();
    let (recipe, cell) = (recipe(home.path(), [10.0, 1.2]), simulated_cell(home.path()));
    let (code, told, errors) = run(&["run", &recipe, "--cell", &cell, "--runs", "runs"], home.path());
    assert!(code == 0 && told.contains("SIMULATION  ACCEPTED"), "{code} {told}\n{errors}");
}

/// Returns the records that the programs wrote while LinuxCNC ran them, in order of their cycles.
fn records() -> Vec<String> {
    let entries = fs::read_dir(format!("{FOLDER}/programs")).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = entries.filter(|path| path.extension().is_some_and(|e| e == "log")).collect();
    files.sort();
    files.iter().map(|file| fs::read_to_string(file).unwrap()).collect()
}

/// Returns true if a program started and ended exactly once, after one preparation.
fn ran_once(record: &str) -> bool {
    let words: Vec<&str> = record.lines().collect();
    matches!(words[..], [prepared, "begin", "end"] if prepared.starts_with("prepared "))
}

/// Follows a run to its end and resumes it wherever it holds, as a person would. On a busy computer LinuxCNC may have
/// to wait until the cell holds before the step that it does not answer. Returns the output.
fn to_its_end(mut running: Running, home: &Path) -> String {
    let folder = || run_folders(&home.join("runs")).pop();
    while !running.is_over() {
        if let Some(folder) = folder()
            && let Ok(status) = send_request(&folder, &Request::Status)
            && status.status.state == StateName::Held
        {
            let resume = Request::Resume { reason: "seen".into(), state_number: Some(status.status.state_number) };
            // The run may have continued meanwhile.
            let _ = send_request(&folder, &resume);
        }
        std::thread::park_timeout(Duration::from_millis(50));
    }
    let (code, error) = running.end();
    let told = running.output_lines.join("\n");
    println!("{told}");
    assert_eq!(code, 0, "{told}\n{error}");
    told
}

#[test]
#[ignore = "needs LinuxCNC: Debian package linuxcnc-uspace, and root for namespaces"]
fn part_ground_along_executed_path() {
    let name = "linuxcnc::part_ground_along_executed_path";
    beside_linuxcnc(name, |home| {
        // 360 points leave larger gaps in the aperture than the shipped recipe does, and the PV is judged there too.
        let (recipe, cell) = (recipe(home, [10.0, 1.2]), cell(home));
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
fn run_killed_while_linuxcnc_grinds() {
    let name = "linuxcnc::run_killed_while_linuxcnc_grinds";
    beside_linuxcnc(name, |home| {
        // One pass is enough, and the world outlives the run.
        let (recipe, cell) = (recipe(home, [60.0, 12.0]), cell(home));
        let mut world = Running::new(regrind(&["simulate", &recipe, "--cell", &cell, "--json"], home));
        let bound: Value = serde_json::from_str(&world.line("its wires", |line| line.starts_with('{'))).unwrap();
        let text = fs::read_to_string(&cell).unwrap();
        fs::write(&cell, replaced(&text, "port = 0 ", &format!("port = {} ", bound["cmm"]["port"]))).unwrap();
        let mut first = Running::new(regrind(&["run", &recipe, "--cell", &cell, "--runs", "runs"], home));
        first.line("grinding", |line| line.starts_with("cycle 1: grinding"));
        // The kill comes some seconds before the end of the pass, or after it if this computer is too slow. In both
        // cases the pass runs once.
        first.signal("KILL");
        first.end();
        // The program waits for a person who has checked the machines.
        let folder = only_run(&home.join("runs"));
        let resumed = Running::new(regrind(&["resume", folder.to_str().unwrap()], home));
        let told = to_its_end(resumed, home);
        assert!(told.contains("ACCEPTED"), "{told}");
        let records = records();
        assert!(records.len() == 1 && ran_once(&records[0]), "{records:?}");
    });
}

/// Starts a run and causes a fault while LinuxCNC grinds. Returns the state and the alarms that the cell shows once it
/// has stopped.
fn stands_after(home: &Path, go_wrong: impl FnOnce()) -> (StateName, Vec<AlarmId>) {
    let (recipe, cell) = (recipe(home, [60.0, 12.0]), cell(home));
    let mut running = Running::new(regrind(&["run", &recipe, "--cell", &cell, "--runs", "runs"], home));
    running.line("grinding", |line| line.starts_with("cycle 1: grinding"));
    // The pass has started when its program has written so.
    while !records().iter().any(|record| record.contains("begin")) {
        std::thread::park_timeout(Duration::from_millis(20));
    }
    go_wrong();
    let folder = only_run(&home.join("runs"));
    let mut seen = (StateName::Execute, Vec::new());
    let stands =
        |state| matches!(state, StateName::Held | StateName::Suspended | StateName::Aborted | StateName::Stopped);
    while !running.is_over() {
        if let Ok(status) = send_request(&folder, &Request::Status) {
            seen = (status.status.state, status.status.alarms.iter().map(|alarm| alarm.id).collect());
            if stands(seen.0) && !seen.1.is_empty() {
                break;
            }
        }
        std::thread::park_timeout(Duration::from_millis(20));
    }
    let (_, told, error) = run(&["abort", folder.to_str().unwrap(), "--reason", "seen"], home);
    let (code, errors) = running.end();
    println!("{seen:?}\n{}\n{errors}\n{code} {told}{error}\n{:?}", running.output_lines.join("\n"), records());
    seen
}

fn begun(record: &str) -> usize {
    record.lines().filter(|line| *line == "begin").count()
}

#[test]
#[ignore = "needs LinuxCNC: Debian package linuxcnc-uspace, and root for namespaces"]
fn controller_killed_while_linuxcnc_grinds() {
    let name = "linuxcnc::controller_killed_while_linuxcnc_grinds";
    beside_linuxcnc(name, |home| {
        let (state, alarms) = stands_after(home, || {
            for name in ["linuxcncrsh", "milltask", "io", "linuxcncsvr", "rtapi_app"] {
                let _ = Command::new("pkill").args(["-KILL", "-x", name]).status();
            }
        });
        assert!(alarms.contains(&AlarmId::LinkLost), "{state:?} {alarms:?}");
        assert!(matches!(state, StateName::Suspended | StateName::Held), "{state:?} {alarms:?}");
        assert_eq!(records().iter().map(|record| begun(record)).sum::<usize>(), 1);
    });
}

#[test]
#[ignore = "needs LinuxCNC: Debian package linuxcnc-uspace, and root for namespaces"]
fn stop_circuit_while_linuxcnc_grinds() {
    let name = "linuxcnc::stop_circuit_while_linuxcnc_grinds";
    beside_linuxcnc(name, |home| {
        let (state, alarms) = stands_after(home, || {
            for words in [&["unlinkp", "iocontrol.0.emc-enable-in"][..], &["setp", "iocontrol.0.emc-enable-in", "0"]] {
                let mut command = Command::new(ACCOUNT[0]);
                command.args(&ACCOUNT[1..]).args(AT_HOME).arg("halcmd").args(words);
                assert!(command.status().unwrap().success(), "{words:?}");
            }
        });
        assert!(alarms.contains(&AlarmId::MachineFault), "{state:?} {alarms:?}");
        assert_eq!(records().iter().map(|record| begun(record)).sum::<usize>(), 1);
    });
}

#[test]
#[ignore = "needs LinuxCNC: Debian package linuxcnc-uspace, and root for namespaces"]
fn other_client_while_linuxcnc_grinds() {
    let name = "linuxcnc::other_client_while_linuxcnc_grinds";
    beside_linuxcnc(name, |home| {
        let mut other = None;
        let (state, alarms) = stands_after(home, || {
            let mut stream = TcpStream::connect(("127.0.0.1", 5007)).unwrap();
            stream.write_all(b"hello EMC other 1.0\r\nset verbose on\r\nset enable EMCTOO\r\nset abort\r\n").unwrap();
            other = Some(stream);
        });
        assert!(!alarms.is_empty(), "{state:?}");
        assert_eq!(records().iter().map(|record| begun(record)).sum::<usize>(), 1);
    });
}

#[test]
#[ignore = "needs LinuxCNC: Debian package linuxcnc-uspace, and root for namespaces"]
fn unreadable_program_never_starts() {
    let name = "linuxcnc::unreadable_program_never_starts";
    beside_linuxcnc(name, |home| {
        let (recipe, cell) = (recipe(home, [60.0, 12.0]), cell(home));
        let text = fs::read_to_string(&cell).unwrap();
        let named = "programs_at_controller = \"/tmp/nowhere\"\nexecuted_path";
        let text = replaced(&text, "settle_timeout_ms = 60000", "settle_timeout_ms = 2000");
        fs::write(&cell, replaced(&text, "executed_path", named)).unwrap();
        let mut running = Running::new(regrind(&["run", &recipe, "--cell", &cell, "--runs", "runs"], home));
        // The cell holds, and waits for a person to correct the fault.
        running.line("an alarm that names the folder", |line| line.contains("/tmp/nowhere"));
        let folder = only_run(&home.join("runs"));
        run(&["abort", folder.to_str().unwrap(), "--reason", "seen"], home);
        let (code, errors) = running.end();
        println!("{code} {}\n{errors}", running.output_lines.join("\n"));
        assert_ne!(code, 0);
        assert_eq!(records().iter().map(|record| begun(record)).sum::<usize>(), 0);
    });
}
