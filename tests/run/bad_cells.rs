//! Errors in a run folder, a wire, a cell file and a recipe, before and while a cell runs. Each gives a clear error,
//! the right exit code, a bounded time, and a journal that verifies.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use crate::program::{
    Running, changed, only_run, records_with, regrind, replaced, root, run, run_folders, small_recipe,
};
use regrind::journal::verify;

/// Upper bound of the time until a wrong input is reported, even on the busiest computer.
const BOUNDED: Duration = Duration::from_secs(60);

fn in_time(arguments: &[&str], home: &Path) -> (i32, String, String) {
    let began = Instant::now();
    let ended = run(arguments, home);
    println!("{arguments:?}: {} in {:.1} s\n{}", ended.0, began.elapsed().as_secs_f64(), ended.2);
    assert!(began.elapsed() < BOUNDED, "{arguments:?} took {:?}", began.elapsed());
    assert!(!ended.2.contains("panicked") && !ended.2.contains("fault of the program"), "{}", ended.2);
    ended
}

fn recipe(home: &Path, speed: f64) -> String {
    small_recipe(home, speed).to_str().unwrap().to_owned()
}

fn sim_cell() -> String {
    root().join("config/sim.toml").to_str().unwrap().to_owned()
}

#[test]
fn file_at_runs_folder_refused() {
    let home = tempfile::tempdir().unwrap();
    fs::write(home.path().join("runs"), "not a folder").unwrap();
    let (code, _, errors) = in_time(&["run", &recipe(home.path(), 1e4), "--cell", &sim_cell()], home.path());
    assert_eq!(code, 2, "{errors}");
    assert!(errors.contains("runs"), "{errors}");
    assert_eq!(fs::read_to_string(home.path().join("runs")).unwrap(), "not a folder");
}

#[test]
fn temperature_keys_need_reporting_cmm() {
    let home = tempfile::tempdir().unwrap();
    let cell = root().join("config/ippdme.toml").display().to_string();
    let part = ("[part]", "[part]\nexpansion_um_m_k = 7.1");
    let measure = ("[measure]", "[measure]\ntemperature_c = [19.0, 21.0]");
    for (key, change) in [("part.expansion_um_m_k", part), ("measure.temperature_c", measure)] {
        let recipe = home.path().join("warm.toml");
        fs::write(&recipe, changed("recipes/freeform-mirror.toml", &[change])).unwrap();
        let (code, _, errors) = in_time(&["check", recipe.to_str().unwrap(), &cell], home.path());
        let (run_code, _, run_errors) = in_time(&["run", recipe.to_str().unwrap(), "--cell", &cell], home.path());
        assert_eq!(run_code, 2, "{run_errors}");
        assert!(run_errors.contains(key) && run_errors.contains("reports none"), "{run_errors}");
        println!("check alone: {code} {errors}");
    }
}

#[test]
fn simultaneous_runs_get_own_folders() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 1e4);
    let mut both: Vec<Running> = (0..2)
        .map(|_| Running::new(regrind(&["run", &recipe, "--cell", &sim_cell(), "--runs", "runs"], home.path())))
        .collect();
    let codes: Vec<_> = both.iter_mut().map(Running::end).collect();
    for (code, errors) in codes {
        // The program that found its folder taken a moment before reports it and harms nothing.
        assert!(code == 0 || code == 2 && errors.contains("runs/"), "{code} {errors}");
    }
    for folder in run_folders(&home.path().join("runs")) {
        assert!(verify(folder).unwrap().closed);
    }
}

#[test]
#[ignore = "needs a user who may not write everywhere: not root"]
fn read_only_runs_folder_refused() {
    use std::os::unix::fs::PermissionsExt;
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 1e4);
    let locked = home.path().join("locked");
    fs::create_dir(&locked).unwrap();
    fs::set_permissions(&locked, fs::Permissions::from_mode(0o500)).unwrap();
    let (code, _, errors) = in_time(&["run", &recipe, "--cell", &sim_cell(), "--runs", "locked"], home.path());
    assert_eq!(code, 2, "{errors}");
    assert!(errors.contains("locked"), "{errors}");
}

/// Checks a cell whose record can no longer be written: it reports this, holds, and can be aborted. The journal up to
/// then verifies.
fn fills_up(command: Command, home: &Path, named: &str, fill: impl FnOnce()) {
    let mut running = Running::new(command);
    let folder = running.folder(home);
    // Without its control socket, the run ends before it begins.
    running.until("control socket", |_| folder.join("control.sock").exists().then_some(()));
    fill();
    let words = running.line("what failed", |line| line.starts_with("RECORD"));
    assert!(words.contains(named), "{words}");
    // The cell raises an alarm, no matter which write failed.
    running.line("alarm", |line| line.starts_with("ALARM"));
    // An abort needs no disk. The program reports that the abort is not on record, unless there was just enough room
    // for it.
    let (code, _, errors) = run(&["abort", folder.to_str().unwrap()], home);
    let is_said = errors.contains("carried out") && errors.contains("not recorded");
    assert!(code == 0 || code == 3 && is_said, "{code} {errors}");
    let (code, words) = running.end();
    println!("{}\n{words}", running.output_lines.join("\n"));
    assert_eq!(code, 3, "{words}");
    let verified = verify(&folder).unwrap();
    assert!(verified.records > 1, "{verified:?}");
}

/// The shell's limit on the size of a file: a write beyond it fails.
#[test]
fn journal_at_size_limit_holds_cell() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 2000.0);
    let mut command = Command::new("bash");
    // The unit is blocks of 1,024 bytes. The signal SIGXFSZ is ignored, so that the write itself fails.
    command.args(["-c", "trap '' XFSZ; ulimit -f 120; exec \"$@\"", "regrind", env!("CARGO_BIN_EXE_regrind"), "run"]);
    command.args([&recipe, "--cell", &sim_cell(), "--runs", "runs"]).current_dir(home.path());
    fills_up(command, home.path(), "runs/small-", || ());
}

/// Mounted disk of a given size in kB.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn at(folder: PathBuf, kilobytes: u32) -> Self {
        fs::create_dir(&folder).unwrap();
        let size = format!("size={kilobytes}k");
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(&folder).output();
        assert!(mounted.is_ok_and(|done| done.status.success()), "a disk of {kilobytes} kB is mounted");
        Self(folder)
    }

    /// Fills the disk until `left` bytes are free, or fewer if another process writes meanwhile.
    fn fill_to(&self, left: u64) {
        let free = regrind::journal::free_bytes(&self.0).unwrap();
        let filled = fs::write(self.0.join("filler"), vec![0; free.saturating_sub(left) as usize]);
        assert!(filled.as_ref().map_or_else(|e| e.kind() == ErrorKind::StorageFull, |()| true), "{filled:?}");
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // If the unmount fails, the mount ends with the machine.
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[test]
#[ignore = "needs a user who may mount a small disk: root"]
fn disk_full_holds_cell() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 2000.0);
    let disk = SmallDisk::at(home.path().join("small"), 40_000);
    let command = regrind(&["run", &recipe, "--cell", &sim_cell(), "--runs", "small"], home.path());
    fills_up(command, home.path(), "disk", || disk.fill_to(100_000));
}

#[test]
#[ignore = "needs a user who may mount a small disk: root"]
fn disk_full_starts_no_cycle() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 200.0);
    let disk = SmallDisk::at(home.path().join("small"), 400);
    let arguments = ["run", &recipe, "--cell", &sim_cell(), "--runs", "small"];
    let (code, _, errors) = in_time(&arguments, home.path());
    let full = ["small: ", "0 MB free", "--runs"];
    assert!(code == 2 && full.iter().all(|piece| errors.contains(piece)), "{errors}");
    drop(disk);
    // A disk that fills up while the first part is ground holds the cell before the measurement. The record still fits.
    let disk = SmallDisk::at(home.path().join("other"), 40_000);
    let arguments = ["run", &recipe, "--cell", &sim_cell(), "--runs", "other"];
    let mut running = Running::new(regrind(&arguments, home.path()));
    let folder = running.folder(home.path());
    disk.fill_to(4 << 20);
    let alarm = running.line("alarm", |line| line.starts_with("ALARM"));
    assert!(alarm.contains("disk") && alarm.contains("MB free"), "{alarm}");
    fs::remove_file(home.path().join("other/filler")).unwrap();
    running.until("held", |_| {
        let (_, said, _) = run(&["status", folder.to_str().unwrap()], home.path());
        said.contains("Held").then_some(())
    });
    assert_eq!(run(&["resume", folder.to_str().unwrap()], home.path()).0, 0);
    assert_eq!(running.end().0, 0, "{:#?}", running.output_lines);
    assert!(verify(&folder).unwrap().closed);
}

/// Separate file system in a file. The kernel turns it read-only at its first error, as it does with a disk that fails.
struct BrokenDisk {
    folder: PathBuf,
    device: String,
}

impl BrokenDisk {
    fn at(folder: PathBuf) -> Self {
        let (image, options) = (folder.with_extension("image"), "loop,errors=remount-ro");
        fs::create_dir(&folder).unwrap();
        fs::File::create(&image).unwrap().set_len(40 << 20).unwrap();
        let done = |command: &mut Command| command.status().is_ok_and(|status| status.success());
        assert!(done(Command::new("mkfs.ext4").arg("-q").arg(&image)), "a file system is made");
        assert!(done(Command::new("mount").args(["-o", options]).args([&image, &folder])), "it is mounted");
        let found = Command::new("findmnt").args(["-no", "SOURCE"]).arg(&folder).output().unwrap();
        Self { folder, device: String::from_utf8(found.stdout).unwrap().trim().replace("/dev/", "") }
    }

    fn turn_read_only(&self) {
        fs::write(format!("/sys/fs/ext4/{}/trigger_fs_error", self.device), "1").unwrap();
    }
}

impl Drop for BrokenDisk {
    fn drop(&mut self) {
        // If the unmount fails, the mount ends with the machine.
        let _ = Command::new("umount").arg("-l").arg(&self.folder).status();
    }
}

#[test]
#[ignore = "needs a user who may mount a disk that breaks: root"]
fn disk_read_only_holds_cell() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 2000.0);
    let disk = BrokenDisk::at(home.path().join("broken"));
    let command = regrind(&["run", &recipe, "--cell", &sim_cell(), "--runs", "broken"], home.path());
    fills_up(command, home.path(), "broken/small-", || disk.turn_read_only());
}

#[test]
fn simulate_refuses_used_port() {
    let home = tempfile::tempdir().unwrap();
    let taken = std::net::TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let cell = changed("config/modbus-tcp.toml", &[("15021", &port), ("15022", "0")]);
    fs::write(home.path().join("cell.toml"), cell).unwrap();
    let (code, _, errors) = in_time(&["simulate", &recipe(home.path(), 1e4), "--cell", "cell.toml"], home.path());
    assert!(code == 2 || code == 3, "{code} {errors}");
    assert!(errors.contains(&format!("127.0.0.1:{port}")) && errors.contains("choose another port"), "{errors}");
}

#[test]
fn simulate_refuses_file_at_device_link() {
    let home = tempfile::tempdir().unwrap();
    let devices = format!("device = \"{}/", home.path().display());
    let text = changed("config/serial-rtu.toml", &[("device = \"/tmp/regrind-", &devices)]);
    fs::write(home.path().join("cell.toml"), text).unwrap();
    fs::write(home.path().join("grinder.tty"), "mine").unwrap();
    let (code, _, errors) = in_time(&["simulate", &recipe(home.path(), 1e4), "--cell", "cell.toml"], home.path());
    assert!(code == 2 || code == 3, "{code} {errors}");
    assert!(errors.contains("grinder.tty") && errors.contains("remove the file"), "{errors}");
    assert_eq!(fs::read_to_string(home.path().join("grinder.tty")).unwrap(), "mine");
    assert!(fs::symlink_metadata(home.path().join("cmm.tty")).is_err(), "what was linked before is taken back");
}

#[test]
fn unreachable_machines_end_run() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 1e4);
    // A port that is bound but does not listen.
    let taken = tokio::net::TcpSocket::new_v4().unwrap();
    taken.bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let free = taken.local_addr().unwrap().port().to_string();
    let nobody = changed("config/modbus-tcp.toml", &[("15021", &free), ("15022", &free)]);
    let nowhere = nobody
        .replace("host = \"127.0.0.1\"", "host = \"no-such-host.invalid\"")
        .replace("simulated = true", "simulated = false");
    for (name, cell, named) in
        [("nobody", nobody, format!("127.0.0.1:{free}")), ("nowhere", nowhere, "no-such-host.invalid".to_owned())]
    {
        let cell_file = format!("{name}.toml");
        fs::write(home.path().join(&cell_file), cell).unwrap();
        let (code, said, errors) = in_time(&["run", &recipe, "--cell", &cell_file, "--runs", name], home.path());
        assert_eq!(code, 3, "{said}\n{errors}");
        assert!(errors.contains(&named) && said.contains("ALARM"), "{name}: {said}\n{errors}");
        let folder = only_run(&home.path().join(name));
        assert!(verify(&folder).unwrap().closed, "{name}");
        assert!(!records_with(&folder, "event").is_empty());
    }
}

/// A missing serial port is reported at once, with the list of existing ports. Nothing has started.
#[test]
fn missing_serial_port_lists_ports() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 1e4);
    let devices = format!("device = \"{}/absent-", home.path().display());
    let cell = changed("config/serial-rtu.toml", &[("device = \"/tmp/regrind-", &devices)]);
    fs::write(home.path().join("cell.toml"), cell).unwrap();
    let (code, said, errors) = in_time(&["run", &recipe, "--cell", "cell.toml", "--runs", "runs"], home.path());
    assert_eq!(code, 3, "{said}\n{errors}");
    assert!(errors.contains("absent-") && errors.contains("the serial ports here: "), "{errors}");
    assert!(!home.path().join("runs").exists());
}

#[test]
fn recipe_beyond_cell_limits_refused() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 1e4);
    let cells = [
        ("depth", "config/modbus-tcp.toml", "max_depth_mm = 0.5", "max_depth_mm = 0.001", "depth_of_cut"),
        ("feed", "config/modbus-tcp.toml", "max_feed_mm_min = 20000.0", "max_feed_mm_min = 100.0", "feed"),
        ("wheel", "config/modbus-tcp.toml", "min_wheel_radius_mm = 1.0", "min_wheel_radius_mm = 100.0", "wheel"),
        (
            "travel",
            "config/modbus-tcp.toml",
            "max_mm = [500.0, 500.0, 400.0]",
            "max_mm = [20.0, 500.0, 400.0]",
            "travel",
        ),
        (
            "travel-of-the-grinder",
            "config/modbus-tcp.toml",
            "[grinder.limits]",
            "[grinder.travel]\nmin_mm = [-10.0, -500.0, -400.0]\nmax_mm = [10.0, 500.0, 400.0]\n\n[grinder.limits]",
            "-10 to 10 mm",
        ),
    ];
    for (name, file, from, to, named) in cells {
        let cell = format!("{name}.toml");
        fs::write(home.path().join(&cell), changed(file, &[(from, to)])).unwrap();
        for command in ["plan", "run"] {
            let (code, _, errors) = in_time(&[command, &recipe, "--cell", &cell], home.path());
            assert_eq!(code, 2, "{errors}");
            assert!(errors.contains(named) && errors.contains(&cell), "{command} {name}: {errors}");
        }
    }
    assert!(!home.path().join("runs").exists(), "nothing was begun");
}

#[test]
fn pass_beyond_travel_is_not_started() {
    let home = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(recipe(home.path(), 1e4)).unwrap();
    assert!(text.contains("[cycle]\n"));
    fs::write(home.path().join("first.toml"), text.replace("[cycle]\n", "[cycle]\nbegin_with = \"measure\"\n"))
        .unwrap();
    let narrow =
        "[grinder.travel]\nmin_mm = [-10.0, -500.0, -400.0]\nmax_mm = [10.0, 500.0, 400.0]\n\n[grinder.limits]";
    fs::write(home.path().join("narrow.toml"), changed("config/sim.toml", &[("[grinder.limits]", narrow)])).unwrap();
    let (code, said, errors) = in_time(&["run", "first.toml", "--cell", "narrow.toml"], home.path());
    assert_eq!(code, 1, "{said}\n{errors}");
    for piece in ["ALARM", "travel", "-10 to 10 mm"] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    let cycle = only_run(&home.path().join("runs")).join("cycle-1");
    assert!(cycle.join("error_map.csv").is_file());
    for file in ["correction.csv", "toolpath.ngc", "toolpath_z.csv"] {
        assert!(!cycle.join(file).exists(), "{file} of a pass that is not begun");
    }
}

#[test]
fn commands_refuse_broken_files() {
    let home = tempfile::tempdir().unwrap();
    let good = recipe(home.path(), 1e4);
    let text = fs::read_to_string(&good).unwrap();
    let replaced = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        text.replacen(from, to, 1)
    };
    let files: Vec<(&str, String)> = vec![
        ("empty", String::new()),
        ("syntax", replaced("[measure]", "[measure")),
        ("unknown", replaced("probe_radius_mm", "probe_radius_um")),
        ("type", replaced("columns = 16", "columns = \"twenty\"")),
        ("range", replaced("removal_budget_um = 400.0", "removal_budget_um = 4e9")),
        ("nan", replaced("pv_um = 7.0", "pv_um = nan")),
        ("binary", "\u{0}\u{1}\u{2}".to_owned()),
        ("contradiction", replaced("columns = 16", "columns = 0")),
    ];
    for (name, content) in &files {
        let file = format!("{name}.toml");
        fs::write(home.path().join(&file), content).unwrap();
        for command in ["run", "plan", "simulate", "check"] {
            let (code, _, errors) = in_time(&[command, &file], home.path());
            assert_eq!(code, 2, "{command} {name}: {errors}");
            assert!(errors.contains(&file) || errors.contains("listed above"), "{command} {name}: {errors}");
        }
        let (code, _, errors) = in_time(&["run", &good, "--cell", &file], home.path());
        assert_eq!(code, 2, "a recipe as a cell, {name}: {errors}");
    }
    let (code, _, errors) = in_time(&["run", "absent.toml"], home.path());
    assert_eq!(code, 2, "{errors}");
    assert!(errors.contains("absent.toml"), "{errors}");
    assert!(!home.path().join("runs").exists(), "nothing was begun");
}

#[test]
fn recipe_without_simulation_uses_nominal() {
    let home = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(recipe(home.path(), 1e4)).unwrap();
    let cut = text.split("# The truth of a simulated cell").next().unwrap();
    fs::write(home.path().join("real.toml"), cut).unwrap();
    let (code, shown, errors) = in_time(&["run", "real.toml", "--cell", &sim_cell(), "--runs", "runs"], home.path());
    assert_eq!(code, 0, "{shown}{errors}");
}

/// A truth of another part is refused before anything moves, with its place.
#[test]
fn truth_of_other_part_refused() {
    let home = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(recipe(home.path(), 1e4)).unwrap();
    let cases = [
        ("value_mm = 10.5", "value_mm = 10.4", "simulation.part.shape"),
        ("half_x_mm = 51.0", "half_x_mm = 40.0", "simulation.part.aperture"),
    ];
    let mut texts: Vec<(String, &str)> =
        cases.map(|(is, other, key)| (replaced(&text, is, other), key)).into_iter().collect();
    // A wrong shape that nobody states, and points too far apart to tell the surface between them.
    let real = text.split("# The truth of a simulated cell").next().unwrap();
    let wrong = format!("{real}\n[simulation.faults]\nwrong_shape = true\n");
    texts.push((wrong, "simulation.faults.wrong_shape"));
    let coarse = replaced(real, "spacing_mm = 0.5", "spacing_mm = 8.0");
    texts.push((format!("{coarse}\n[simulation]\nseed = 1\n"), "simulation.part.shape"));
    for (text, key) in texts {
        fs::write(home.path().join("other.toml"), text).unwrap();
        for command in [&["check", "other.toml"][..], &["run", "other.toml", "--cell", &sim_cell()]] {
            let (code, _, errors) = in_time(command, home.path());
            assert_eq!(code, 2, "{errors}");
            assert!(errors.contains(key) && errors.contains("other.toml:"), "{errors}");
        }
    }
}

#[test]
fn ctrl_c_holds_then_aborts() {
    let home = tempfile::tempdir().unwrap();
    // Slow enough that the machine still grinds.
    let recipe = recipe(home.path(), 100.0);
    let mut running = Running::new(regrind(&["run", &recipe, "--cell", &sim_cell(), "--runs", "runs"], home.path()));
    let folder = running.folder(home.path());
    running.line("grinding", |line| line.contains("grinding"));
    running.interrupt();
    let words = running.line("hold", |line| line.starts_with("HOLD"));
    assert!(words.contains("next safe place") && words.contains("regrind resume"), "{words}");
    let held = |home: &Path| run(&["status", folder.to_str().unwrap()], home).1.contains("Held");
    let began = Instant::now();
    while !held(home.path()) {
        assert!(began.elapsed() < BOUNDED, "it does not come to hold");
    }
    let (_, said, _) = run(&["status", folder.to_str().unwrap()], home.path());
    for part in ["SIMULATION", "Held (Grind, Run)", "cycle 1 of", "grinding, ", "regrind resume", ", run "] {
        assert!(said.contains(part), "{part:?}: {said}");
    }
    let (_, said, _) = run(&["status", folder.to_str().unwrap(), "--json"], home.path());
    let status = serde_json::from_str::<serde_json::Value>(&said).unwrap()["status"].clone();
    let progress = &status["progress"];
    assert_eq!((&progress["device"], status["part"].is_string()), (&serde_json::json!("grinder"), true), "{said}");
    assert!(progress["done"].as_u64() < progress["total"].as_u64(), "{said}");
    assert!(progress["left_s"].is_null(), "a job that stands has no pace: {said}");
    assert!(status["tolerance"].is_object() && status["next"].as_str().unwrap().contains("regrind resume"), "{said}");
    running.interrupt();
    running.line("abort", |line| line.starts_with("ABORT"));
    let (code, errors) = running.end();
    assert_eq!(code, 3, "{errors}");
    assert!(running.output_lines.iter().any(|line| line.contains("ABORTED")), "{}", running.output_lines.join("\n"));
    let verified = verify(&folder).unwrap();
    assert!(verified.closed, "{verified:?}");
    let causes = records_with(&folder, "event");
    let reasons: Vec<_> = causes.iter().filter_map(|e| e["reason"].as_str()).collect();
    assert_eq!(reasons, ["Ctrl-C", "Ctrl-C, twice"]);
}
