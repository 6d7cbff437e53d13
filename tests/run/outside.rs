//! Events from outside a run: a terminal that is closed, a service that is stopped, unknown clients at the control
//! socket, a second run.

use std::fs;
use std::io::Write;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use crate::program::{PATIENCE, Running, changed, records_with, regrind, root, run, small_recipe};
use regrind::journal::verify;

fn sim_cell() -> String {
    root().join("config/sim.toml").display().to_string()
}

/// Starts a run that grinds so slowly that it still grinds when the test ends.
fn grinding(home: &Path, command: impl Fn(&[&str]) -> Command) -> (Running, PathBuf) {
    let recipe = small_recipe(home, 100.0).display().to_string();
    let mut running = Running::new(command(&["run", &recipe, "--cell", &sim_cell(), "--runs", "runs"]));
    let folder = running.folder(home);
    running.line("grinding", |line| line.contains("grinding"));
    (running, folder)
}

fn orders(folder: &Path) -> Vec<(String, String)> {
    let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    let orders = records_with(folder, "event").into_iter().filter(|event| !event["reason"].is_null());
    orders.map(|event| (text(&event["event"]), text(&event["reason"]))).collect()
}

/// Returns the program as a terminal starts it, even if the person who runs the tests ignores SIGHUP.
fn heeding_hangup(arguments: &[&str], home: &Path) -> Command {
    let program = regrind(arguments, home);
    let mut command = Command::new("env");
    command.arg("--default-signal=HUP").arg(program.get_program()).args(program.get_args());
    for (name, value) in program.get_envs() {
        value.map(|value| command.env(name, value));
    }
    command.current_dir(home).stdin(Stdio::null());
    command
}

#[test]
fn simulated_cell_is_built_in() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e4).display().to_string();
    let (code, with_none, errors) = run(&["plan", &recipe], home.path());
    assert_eq!(code, 0, "{errors}");
    let (code, with_its_name, errors) = run(&["plan", &recipe, "--cell", "sim"], home.path());
    assert_eq!((code, with_its_name), (0, with_none), "{errors}");
    let (code, said, errors) = run(&["run", &recipe, "--cell", "sim", "--loaded"], home.path());
    assert_eq!(code, 0, "{said}{errors}");
    assert!(said.contains("SIMULATION  ACCEPTED"), "{said}");
}

#[test]
fn watch_and_runs_show_active_run() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path(), |arguments| regrind(arguments, home.path()));
    let name = folder.file_name().unwrap().to_string_lossy().into_owned();
    let mut watch = Running::new(regrind(&["watch"], home.path()));
    watch.line("the state", |line| line.starts_with("cycle 1: Execute (Grind"));
    let (code, said, errors) = run(&["runs"], home.path());
    assert!(code == 0 && said.contains(&name) && said.contains("on now"), "{said}{errors}");
    assert_eq!(run(&["stop"], home.path()).0, 0);
    assert_eq!(running.end().0, 1);
    assert_eq!(watch.end().0, 0, "{:?}", watch.output_lines);
    assert!(watch.output_lines.last().unwrap().starts_with("STOPPED"), "{:?}", watch.output_lines);
    let (code, said, _) = run(&["runs", "--json"], home.path());
    let listed: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!(
        (code, listed[0]["run"].as_str(), listed[0]["result"].as_str()),
        (0, Some(&*name), Some("Stopped")),
        "{said}"
    );
    assert!(run(&["runs", "--part", "another"], home.path()).1.contains("no run in"));
    let (code, _, errors) = run(&["runs", "--runs", "elsewhere"], home.path());
    assert!(code == 2 && errors.contains("elsewhere") && errors.contains("--runs"), "{errors}");
}

#[test]
fn control_socket_limits_text_and_watchers() {
    use std::io::{BufRead, BufReader, Write};
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path(), |arguments| regrind(arguments, home.path()));
    let says = |line: &str| {
        let mut stream = UnixStream::connect(folder.join("control.sock")).unwrap();
        stream.write_all(line.as_bytes()).unwrap();
        let mut reader = BufReader::new(stream);
        let mut reply = String::new();
        reader.read_line(&mut reply).unwrap();
        (serde_json::from_str::<serde_json::Value>(&reply).unwrap(), reader)
    };
    for line in [
        "{\"order\":\"hold\",\"reason\":\"a\\u202eb\"}\n",
        "{\"order\":\"remark\",\"what\":\"a\\u0007\"}\n",
        "{\"order\":\"over\",\"device\":\"cmm\",\"evidence\":\"\u{200b}\"}\n",
        "{\"order\":\"abort\",\"by\":{\"name\":\"A\\u202e\",\"station\":\"page\"}}\n",
    ] {
        let (reply, _) = says(line);
        assert!(reply["taken"] == false && reply["words"].as_str().unwrap().contains("not an order"), "{line} {reply}");
        assert_eq!(reply["status"]["state"], "Execute", "{line}");
    }
    let watchers: Vec<_> = (0..17).map(|_| says("{\"order\":\"watch\"}\n")).collect();
    let taken = watchers.iter().filter(|(reply, _)| reply["taken"] == true).count();
    assert_eq!(taken, 16);
    assert_eq!(run(&["stop"], home.path()).0, 0);
    drop(watchers);
    assert_eq!(running.end().0, 1);
    assert_eq!(orders(&folder).len(), 1, "nothing else came through the door");
}

#[test]
fn order_help_has_example() {
    for order in ["hold", "stop", "abort", "status"] {
        let (code, said, _) = run(&[order, "--help"], Path::new("."));
        let example = said.split("Example:").nth(1).unwrap_or_else(|| panic!("{order} has no example: {said}"));
        assert!(code == 0 && example.trim_start().starts_with(&format!("regrind {order} ")), "{said}");
    }
}

#[test]
fn sigterm_and_hangup_stop_in_order() {
    for signal in ["TERM", "HUP"] {
        let home = tempfile::tempdir().unwrap();
        let (mut running, folder) = grinding(home.path(), |arguments| heeding_hangup(arguments, home.path()));
        running.signal(signal);
        let (code, errors) = running.end();
        assert!(code == 1 && !errors.contains("error"), "{signal}: {code} {errors}");
        let orders = orders(&folder);
        let name = format!("SIG{signal}");
        assert!(
            matches!(&orders[..], [(order, reason)] if order == "stop" && reason.starts_with(&name)),
            "{signal}: {orders:?}"
        );
        let verified = verify(&folder).unwrap();
        assert!(verified.closed, "{signal}: {verified:?}");
        assert!(folder.join("result.json").exists() && folder.join("report.html").exists(), "{signal}");
    }
}

#[test]
fn second_sigterm_aborts() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path(), |arguments| regrind(arguments, home.path()));
    // The operating system keeps the order of the two signals only if the first has been received.
    running.signal("TERM");
    let began = Instant::now();
    while orders(&folder).is_empty() {
        assert!(began.elapsed() < PATIENCE, "the first was not heard");
    }
    running.signal("TERM");
    let (code, errors) = running.end();
    assert!(code == 3 || code == 1 && orders(&folder).len() == 1, "{code} {errors}");
    assert!(verify(&folder).unwrap().closed);
    let reasons: Vec<_> = orders(&folder).into_iter().map(|(_, reason)| reason).collect();
    // The machine may have stopped before the second signal arrived.
    assert!(reasons == ["SIGTERM"] || reasons == ["SIGTERM", "SIGTERM, again"], "{reasons:?}");
}

#[test]
fn orders_after_descriptor_exhaustion() {
    let home = tempfile::tempdir().unwrap();
    let few = |arguments: &[&str]| {
        let mut shell = Command::new("sh");
        let program = env!("CARGO_BIN_EXE_regrind");
        shell.args(["-c", "ulimit -n 48; exec \"$0\" \"$@\"", program]).args(arguments);
        shell.current_dir(home.path()).stdin(Stdio::null());
        shell
    };
    let (mut running, folder) = grinding(home.path(), few);
    let clients: Vec<UnixStream> =
        (0..64).map_while(|_| UnixStream::connect(folder.join("control.sock")).ok()).collect();
    let open = || fs::read_dir(format!("/proc/{}/fd", running.id())).map_or(0, Iterator::count);
    let began = Instant::now();
    while open() < 48 {
        assert!(began.elapsed() < PATIENCE, "{} descriptors are open, {} clients", open(), clients.len());
        std::thread::yield_now();
    }
    drop(clients);
    let (code, out, errors) = run(&["abort", folder.to_str().unwrap(), "--reason", "enough"], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 3);
    assert_eq!(orders(&folder), [("abort".to_owned(), "enough".to_owned())]);
}

#[test]
fn order_goes_to_active_run() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path(), |arguments| regrind(arguments, home.path()));
    fs::create_dir(home.path().join("runs/newer")).unwrap();
    let (code, out, errors) = run(&["hold", "--reason", "coffee"], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    let (code, _, errors) = run(&["abort"], home.path());
    assert_eq!(code, 0, "{errors}");
    assert_eq!(running.end().0, 3);
    assert_eq!(orders(&folder)[0], ("hold".to_owned(), "coffee".to_owned()));
}

#[test]
fn order_refused_with_two_active_runs() {
    let home = tempfile::tempdir().unwrap();
    let (mut first, _) = grinding(home.path(), |arguments| regrind(arguments, home.path()));
    let (mut second, _) = grinding(home.path(), |arguments| regrind(arguments, home.path()));
    let (code, _, errors) = run(&["abort"], home.path());
    assert_eq!(code, 2, "{errors}");
    assert!(errors.contains("2 runs are active") && errors.matches("SIMULATION").count() == 2, "{errors}");
    for running in [&mut first, &mut second] {
        running.signal("TERM");
        assert_eq!(running.end().0, 1);
    }
}

#[test]
fn second_run_refused_for_same_machines() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 100.0).display().to_string();
    let open = changed("config/modbus-tcp.toml", &[("15021", "0"), ("15022", "0")]);
    fs::write(home.path().join("open.toml"), open).unwrap();
    let mut serving = Running::new(regrind(&["simulate", &recipe, "--cell", "open.toml", "--json"], home.path()));
    let wires: serde_json::Value = serde_json::from_str(&serving.line("wires", |_| true)).unwrap();
    let port = |machine: &str| wires[machine]["port"].to_string();
    let bound = changed("config/modbus-tcp.toml", &[("15021", &port("cmm")), ("15022", &port("grinder"))]);
    fs::write(home.path().join("cell.toml"), bound).unwrap();
    let begin = ["run", &*recipe, "--cell", "cell.toml", "--runs", "runs"];
    let mut first = Running::new(regrind(&begin, home.path()));
    let folder = first.folder(home.path());
    first.line("grinding", |line| line.contains("grinding"));
    let (code, _, errors) = run(&begin, home.path());
    let name = folder.file_name().unwrap().to_str().unwrap();
    assert!(code == 3 && errors.contains("uses this machine") && errors.contains(name), "{code} {errors}");
    // The first run still decides when it ends.
    let (code, _, errors) = run(&["abort"], home.path());
    assert_eq!(code, 0, "{errors}");
    assert_eq!(first.end().0, 3);
    assert!(first.output_lines.iter().any(|line| line.contains("ABORTED")), "{}", first.output_lines.join("\n"));
    serving.interrupt();
    serving.end();
}

#[test]
fn init_readme_makes_a_part() {
    let home = tempfile::tempdir().unwrap();
    let (code, said, errors) = run(&["init", "shop", "--part", "plano \"X\" \\ 1"], home.path());
    assert_eq!(code, 0, "{said}{errors}");
    let shop = home.path().join("shop");
    let readme = fs::read_to_string(shop.join("README.md")).unwrap();
    let block = readme.split("```sh\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    let path = std::env::join_paths(
        std::iter::once(Path::new(env!("CARGO_BIN_EXE_regrind")).parent().unwrap().to_owned())
            .chain(std::env::split_paths(&std::env::var_os("PATH").unwrap())),
    );
    for line in block.lines() {
        let mut typed = Command::new("bash");
        typed.args(["-c", line]).current_dir(&shop).env("PATH", path.as_ref().unwrap()).env("REGRIND_KEY", "");
        let output = typed.output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{line}: {told}");
    }
    let (_, listed, _) = run(&["runs"], &shop);
    assert!(listed.contains("ACCEPTED  SN-0001"), "{listed}");
    let (code, _, errors) = run(&["init", "shop"], home.path());
    assert!(code == 2 && errors.contains("already exists"), "{errors}");
}

#[test]
fn init_files_valid_for_every_machine() {
    let home = tempfile::tempdir().unwrap();
    for machines in ["simulated", "modbus-tcp", "modbus-rtu", "files", "manual"] {
        let (code, said, errors) = run(&["init", machines, "--machines", machines], home.path());
        assert_eq!(code, 0, "{machines}: {said}{errors}");
        let shop = home.path().join(machines);
        let (code, said, errors) = run(&["check", "recipe.toml", "cell.toml"], &shop);
        assert_eq!(code, 0, "{machines}: {said}{errors}");
        let texts = ["recipe.toml", "cell.toml"].map(|file| fs::read_to_string(shop.join(file)).unwrap());
        for elsewhere in ["../", "recipes/", "config/"] {
            assert!(texts.iter().all(|text| !text.contains(elsewhere)), "{machines} names {elsewhere}");
        }
    }
}

#[test]
fn init_without_folder_refused() {
    let home = tempfile::tempdir().unwrap();
    let (code, _, errors) = run(&["init"], home.path());
    assert!(code == 2 && ["folder", "missing"].iter().all(|piece| errors.contains(piece)), "{errors}");
    assert_eq!(fs::read_dir(home.path()).unwrap().count(), 0);
}

#[test]
fn init_prompts_at_terminal() {
    let home = tempfile::tempdir().unwrap();
    // `script` gives the program its own terminal.
    let typed = format!("{} init", env!("CARGO_BIN_EXE_regrind"));
    let mut command = Command::new("script");
    command.args(["-qec", &typed, "/dev/null"]).current_dir(home.path()).stdin(Stdio::piped());
    let mut running = Running::new(command);
    let mut keys = running.keys();
    keys.write_all(b"shop\nseven\n2\nlens 7\n").unwrap();
    let code = running.end().0;
    let said = running.output_lines.join("\n");
    assert!(code == 0 && said.contains("created shop:"), "{said}");
    let texts =
        ["recipe.toml", "cell.toml"].map(|file| fs::read_to_string(home.path().join("shop").join(file)).unwrap());
    assert!(texts[0].contains("name = \"lens 7\"") && texts[1].contains("modbus-tcp"), "{texts:?}");
}

#[test]
fn doctor_finds_missing_exchange_folders() {
    let home = tempfile::tempdir().unwrap();
    let (code, _, errors) = run(&["init", "shop", "--machines", "files"], home.path());
    assert_eq!(code, 0, "{errors}");
    let shop = home.path().join("shop");
    let (code, said, _) = run(&["doctor", "cell.toml"], &shop);
    assert_eq!(code, 1, "{said}");
    assert_eq!(said.matches("OBSTACLE").count(), 2, "{said}");
    for piece in ["folder", "does not exist", "measuring machine"] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    for folder in ["cmm/in", "cmm/out", "grinder/in", "grinder/out"] {
        fs::create_dir_all(shop.join("exchange").join(folder)).unwrap();
    }
    let (code, said, _) = run(&["doctor", "cell.toml"], &shop);
    assert!(code == 0 && !said.contains("OBSTACLE"), "{said}");
}

#[test]
fn run_serves_its_page() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5).display().to_string();
    let (code, said, errors) = run(&["run", &recipe, "--cell", "sim", "--serve", "127.0.0.1:0"], home.path());
    let page = said.lines().any(|line| line.starts_with("page ") && line.contains("http://127.0.0.1:"));
    assert!(code == 0 && page, "{said}{errors}");
}

#[test]
fn doctor_lists_obstacles() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e4).display().to_string();
    let (code, said, errors) = run(&["doctor", "--recipe", &recipe], home.path());
    assert!(code == 0 && !said.contains("OBSTACLE"), "{said}{errors}");
    for piece in ["simulated within", "reference sphere", "not signed"] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    assert!(!home.path().join("runs").exists(), "it leaves nothing behind");

    let cell = home.path().join("cell.toml");
    let at = |ports: [String; 2]| {
        let [cmm, grinder] = ports.map(|port| format!("port = {port}"));
        fs::write(&cell, changed("config/modbus-tcp.toml", &[("port = 15021", &cmm), ("port = 15022", &grinder)]))
            .unwrap();
    };
    at(["0".into(), "0".into()]);
    let path = cell.display().to_string();
    let mut simulated = Running::new(regrind(&["simulate", &recipe, "--cell", &path, "--json"], home.path()));
    let wires: serde_json::Value =
        serde_json::from_str(&simulated.line("the wires", |line| line.starts_with('{'))).unwrap();
    at(["cmm", "grinder"].map(|machine| wires[machine]["port"].to_string()));
    let cell = path;
    let (code, said, errors) = run(&["doctor", &cell], home.path());
    assert!(code == 0 && said.contains("unit 1 is IDLE") && said.contains("unit 2 is IDLE"), "{said}{errors}");
    drop(simulated);
    let (code, said, _) = run(&["doctor", &cell, "--json"], home.path());
    let found: serde_json::Value = serde_json::from_str(&said).unwrap();
    let obstacles = found.as_array().unwrap().iter().filter(|finding| finding["found"] == "obstacle").count();
    assert_eq!((code, obstacles), (1, 2), "{said}");
}
