//! Another user of the computer interferes with the program, which runs as root, in namespaces where the folders of
//! locks are empty.

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::namespaces::{ACCOUNT, in_namespaces};
use crate::program::{Running, changed, records_with, regrind, run, small_recipe};

/// Folder of the machine locks.
const LOCKS: &str = "/run/lock/regrind-machines";

/// Cell whose machines are another process, a file that only root may change, and a program that everybody may run.
struct Cell {
    home: PathBuf,
    recipe: String,
    precious: PathBuf,
    program: PathBuf,
    _machines: Running,
}

impl Cell {
    /// Starts a cell whose machines take one second for `speed` seconds of a job.
    fn at(home: &Path, speed: f64) -> Self {
        fs::set_permissions(home, fs::Permissions::from_mode(0o755)).unwrap();
        let recipe = small_recipe(home, speed).display().to_string();
        let open = changed("config/modbus-tcp.toml", &[("15021", "0"), ("15022", "0")]);
        fs::write(home.join("open.toml"), open).unwrap();
        let mut machines = Running::new(regrind(&["simulate", &recipe, "--cell", "open.toml", "--json"], home));
        let wires: serde_json::Value = serde_json::from_str(&machines.line("wires", |_| true)).unwrap();
        let port = |machine: &str| wires[machine]["port"].to_string();
        let bound = changed("config/modbus-tcp.toml", &[("15021", &port("cmm")), ("15022", &port("grinder"))]);
        fs::write(home.join("cell.toml"), bound).unwrap();
        let (precious, program) = (home.join("precious"), home.join("regrind"));
        fs::write(&precious, "precious").unwrap();
        fs::set_permissions(&precious, fs::Permissions::from_mode(0o600)).unwrap();
        fs::copy(env!("CARGO_BIN_EXE_regrind"), &program).unwrap();
        Self { home: home.to_owned(), recipe, precious, program, _machines: machines }
    }

    fn arguments(&self) -> [&str; 6] {
        ["run", &self.recipe, "--cell", "cell.toml", "--runs", "runs"]
    }

    /// Runs a part to its end. Returns the exit code and all output.
    fn made(&self) -> (i32, String) {
        let (code, said, errors) = run(&self.arguments(), &self.home);
        self.nothing_happened();
        (code, said + &errors)
    }

    /// Checks that the file of root is unchanged.
    fn nothing_happened(&self) {
        let found = fs::metadata(&self.precious).unwrap();
        assert_eq!((found.uid(), found.mode() & 0o777, found.len()), (0, 0o600, 8));
        assert_eq!(fs::read_to_string(&self.precious).unwrap(), "precious");
    }
}

/// Returns true if another user can run a script successfully.
fn another_user(script: &str) -> bool {
    let mut command = Command::new(ACCOUNT[0]);
    command.args(&ACCOUNT[1..]).args(["sh", "-euc", script]).stdin(Stdio::null());
    command.output().unwrap().status.success()
}

/// Returns the locks that every user can create.
fn locks() -> Vec<PathBuf> {
    let mut locks: Vec<PathBuf> = fs::read_dir(LOCKS).unwrap().map(|entry| entry.unwrap().path()).collect();
    locks.retain(|lock| lock.extension().is_some_and(|ending| ending == "lock"));
    locks
}

#[test]
#[ignore = "needs root and namespaces"]
fn links_by_other_user_not_followed() {
    in_namespaces("local_users::links_by_other_user_not_followed", |home| {
        let cell = Cell::at(home, 2e4);
        // A folder that belongs to the other user, who could exchange every lock in it.
        assert!(another_user(&format!("mkdir -m 777 {LOCKS}")));
        let (code, said) = cell.made();
        assert!(code != 0 && said.contains(LOCKS) && said.contains("chown"), "{code} {said}");
        assert!(!home.join("runs").exists() || records_in(home).is_empty(), "{said}");
        // A folder as the remedy of the message creates it.
        fs::remove_dir_all(LOCKS).unwrap();
        fs::create_dir(LOCKS).unwrap();
        fs::set_permissions(LOCKS, fs::Permissions::from_mode(0o1777)).unwrap();
        let (code, said) = cell.made();
        assert_eq!(code, 0, "{said}");
        // Each lock in turn is a link to a file of root, then a pipe.
        let names = locks();
        assert!(names.len() >= 2, "{names:?}");
        for lay in ["ln -s", "mkfifo"] {
            for name in &names {
                let _ = fs::remove_file(name);
                let from = if lay == "ln -s" { cell.precious.display().to_string() } else { String::new() };
                another_user(&format!("{lay} {from} {}", name.display()));
            }
            let laid = names.iter().filter(|name| fs::symlink_metadata(name).is_ok_and(|is| is.uid() == 65534)).count();
            assert!(laid > 0, "{lay}");
            let (code, said) = cell.made();
            assert_eq!(code, 0, "{lay}: {said}");
        }
        // Root's own link is not followed either.
        names.iter().for_each(|name| drop(fs::remove_file(name)));
        names.iter().for_each(|name| symlink(&cell.precious, name).unwrap());
        cell.made();
    });
}

/// Returns all records of the runs below a home folder.
fn records_in(home: &Path) -> Vec<serde_json::Value> {
    let runs = crate::program::run_folders(&home.join("runs"));
    runs.iter().flat_map(|run| records_with(run, "event")).collect()
}

#[test]
#[ignore = "needs root and namespaces"]
fn other_user_cannot_interfere() {
    in_namespaces("local_users::other_user_cannot_interfere", |home| {
        let cell = Cell::at(home, 200.0);
        let mut running = Running::new(regrind(&cell.arguments(), home));
        let folder = running.folder(home);
        running.line("grinding", |line| line.contains("grinding"));
        let (run_folder, program) = (folder.display(), cell.program.display());
        assert!(another_user(&format!("ls {}", home.display())), "he is somebody");
        for tried in [
            format!("ls {run_folder}"),
            format!("head -c 1 {run_folder}/journal.sqlite"),
            format!("flock -n {run_folder}/journal.sqlite-shm true"),
            format!("{program} status {run_folder}"),
            format!("{program} hold {run_folder}"),
            format!("cd {} && {program} hold", home.display()),
            format!("cd {} && {program} abort", home.display()),
            format!("mv {run_folder} {run_folder}-away"),
            format!("rm -rf {run_folder} {}/runs", home.display()),
        ] {
            assert!(!another_user(&tried), "{tried}");
        }
        // The other user can remove no lock. Changes to the locks that all users share give no one else the machines.
        for lock in locks() {
            another_user(&format!("rm -f {0}; truncate -s 9999 {0}", lock.display()));
        }
        let (code, _, errors) = run(&cell.arguments(), home);
        assert!(code == 3 && errors.contains("uses this machine"), "{code} {errors}");
        let (code, errors) = running.end();
        assert_eq!(code, 0, "{}\n{errors}", running.output_lines.join("\n"));
        let states = records_with(&folder, "command");
        assert!(!states.iter().any(|record| ["hold", "abort"].iter().any(|order| record["command"] == *order)));
        assert!(regrind::journal::verify(&folder).unwrap().closed);
        cell.nothing_happened();
    });
}
