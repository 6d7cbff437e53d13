//! Many cells and one database: a real PostgreSQL and the program itself, with its simulated machines and attackers;
//! and the live values of a cell, as independent programs see them.
//!
//! Each test names its requirement: PostgreSQL (Debian package postgresql), mosquitto, Python. Sockets in the file
//! system and file modes are Unix only.
#![cfg(unix)]

regrind_testcell::program!();

mod broker;
mod held;
mod network;
mod on_broker;
mod on_mail;
mod on_mtconnect;
mod on_opcua;
mod on_postgres;
mod on_webhook;
mod peers;
mod postgres;

use std::fs;
use std::path::{Path, PathBuf};

use postgres::{OWNER, Postgres};
use program::run;
use serde_json::Value;
use tempfile::TempDir;

/// Initialized plant, and a folder for its members.
struct Plant {
    postgres: Postgres,
    home: TempDir,
}

impl Plant {
    fn new() -> Self {
        let plant = Self { postgres: Postgres::start(), home: TempDir::new().unwrap() };
        plant.postgres.write_owner_password(&plant.path("owner.password"));
        plant.write_file("owner", OWNER, "");
        let said = plant.does(&["plant", "init", "--plant", "owner.toml"]);
        assert!(said.contains("layout") && said.contains("it had 0"), "{said}");
        plant
    }

    fn path(&self, name: &str) -> PathBuf {
        self.home.path().join(name)
    }

    /// Writes the plant file of a member, with the password in a file next to it.
    fn write_file(&self, name: &str, role: &str, more: &str) {
        let cell = if more.is_empty() { String::new() } else { format!("cell = \"{more}\"\n") };
        let socket = self.postgres.socket();
        let text = format!(
            "[plant]\n{cell}\n[database]\nhost = \"{}\"\nuser = \"{role}\"\npassword_file = \"{name}.password\"\n",
            socket.display()
        );
        fs::write(self.path(&format!("{name}.toml")), text).unwrap();
    }

    /// Enrols a cell; its plant file has its name.
    fn cell(&self, name: &str, more: &[&str]) {
        self.enrol(name, "cell", more);
        self.write_file(name, &name.replace('-', "_"), name);
    }

    /// Enrols a person, whose plant file has this name.
    fn somebody(&self, name: &str, what: &str) {
        self.enrol(name, what, &[]);
        self.write_file(name, &name.replace('-', "_"), "");
    }

    fn enrol(&self, name: &str, what: &str, more: &[&str]) {
        let password = format!("{name}.password");
        let arguments = ["plant", "enrol", name, "--as", what, "--plant", "owner.toml", "--password-file", &password];
        self.does(&[&arguments, more].concat());
    }

    fn password(&self, name: &str) -> String {
        fs::read_to_string(self.path(&format!("{name}.password"))).unwrap().trim_end().to_owned()
    }

    /// Runs a command that must succeed; returns its output.
    fn does(&self, arguments: &[&str]) -> String {
        self.ends(arguments, 0).0
    }

    /// Runs a command that must end with this exit code; returns its output and its error stream.
    fn ends(&self, arguments: &[&str], code: i32) -> (String, String) {
        let (found, out, errors) = run(arguments, self.home.path());
        assert_eq!(found, code, "{arguments:?}: {out}{errors}");
        (out, errors)
    }

    /// Returns the answer to a query of the superuser of the server.
    fn sql(&self, text: &str) -> String {
        self.postgres.sql("regrind", &format!("SET search_path = regrind; {text}"))
    }

    /// Returns the answer to a query by a cell or a person with its own rights.
    fn asked_by(&self, name: &str, text: &str) -> Result<String, String> {
        let role = name.replace('-', "_");
        self.postgres.ask_as(&role, &self.password(name), "regrind", &format!("SET search_path = regrind; {text}"))
    }

    /// Returns the recorded incidents, the newest last.
    fn incidents(&self) -> Vec<Value> {
        let told = self.does(&["plant", "incidents", "--json", "--plant", "owner.toml"]);
        let mut told: Vec<Value> = serde_json::from_str(&told).unwrap();
        told.reverse();
        told
    }
}

/// Returns the only run below a folder.
fn only_run(runs: &Path) -> (PathBuf, String) {
    let run = program::only_run(runs);
    let name = run.file_name().unwrap().to_string_lossy().into_owned();
    (run, name)
}
