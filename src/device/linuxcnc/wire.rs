//! Table of the cell file for LinuxCNC, and its driver factory.

use std::time::Duration;

use regrind_document::Document;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::machine::LinuxcncGrinder;
use super::settings::LinuxcncSettings;
use crate::MachineKind;
use crate::driver_factory::{ConnectionCheck, DriverContext, DriverError, DriverFactory};
use crate::machine_table::MachineTable;
use crate::network_address::{HostTexts, check_host, is_this_computer};
use crate::no_machine::NoMachine;

/// LinuxCNC by linuxcncrsh over TCP, for a grinder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LinuxcncWire {
    /// Name or address of the controller.
    #[schemars(length(min = 1, max = 253), extend("x-required" = true), example = "192.168.0.30")]
    pub host: String,
    /// Port of linuxcncrsh.
    #[schemars(range(min = 1, max = 65535))]
    pub port: u16,
    /// Password of `hello` (option -w of linuxcncrsh).
    #[schemars(length(min = 1, max = 80))]
    pub connect_password: String,
    /// Password of `set enable` (option -e of linuxcncrsh), with which a client takes control.
    #[schemars(length(min = 1, max = 80))]
    pub control_password: String,
    /// Folder of programs that the controller can also access; relative to this file.
    #[schemars(length(min = 1, max = 400), extend("x-required" = true), example = "/mnt/grinder/nc_files/regrind")]
    pub programs: String,
    /// Path of the same folder at the controller. Default: its path on this computer.
    #[schemars(length(min = 1, max = 200), example = "/home/cnc/linuxcnc/nc_files/regrind")]
    pub programs_at_controller: Option<String>,
    /// For a simulated cell: the program, with its arguments, that prints the path that the controller executes. The
    /// simulated wheel follows this path. The program is relative to this file if its name contains a slash. Default:
    /// the controller is simulated too.
    #[schemars(length(min = 1, max = 20), example = ["linuxcnc/executed-path"])]
    pub executed_path: Option<Vec<String>>,
    /// Joints that must be homed.
    #[schemars(range(min = 1, max = 6))]
    pub joints: u8,
    /// Timeout of the connection, and of the answer to a line; the controller needs 100 ms for an order.
    #[schemars(range(min = 500, max = 60000))]
    pub answer_timeout_ms: u32,
    /// Timeout for a mode, a program or a start to take effect after its order was acknowledged.
    #[schemars(range(min = 100, max = 600000))]
    pub settle_timeout_ms: u32,
    /// Timeout for the record that a program writes to appear in the folder after the program has stopped.
    #[schemars(range(min = 10, max = 600000))]
    pub record_timeout_ms: u32,
}

impl Default for LinuxcncWire {
    fn default() -> Self {
        Self {
            host: String::new(),
            port: 5007,
            connect_password: "EMC".to_owned(),
            control_password: "EMCTOO".to_owned(),
            programs: String::new(),
            programs_at_controller: None,
            executed_path: None,
            joints: 3,
            answer_timeout_ms: 2000,
            settle_timeout_ms: 5000,
            record_timeout_ms: 2000,
        }
    }
}

impl DriverFactory for LinuxcncWire {
    type Cmm = NoMachine;
    type Grinder = LinuxcncGrinder;
    const READS_RUN_FOLDER: bool = true;
    const CHECK: ConnectionCheck = ConnectionCheck::Session;
    const END_OF_JOB: &'static str =
        "the controller of this machine stores no job; if a program runs or is paused, end this program at the machine";

    fn check(&self, place: &MachineTable<'_>, document: &mut Document) {
        if place.table == "cmm" {
            let allowed = "LinuxCNC is for grinders";
            return document.report("cmm.wire.kind", "is \"linuxcnc\"", allowed, "name another wire");
        }
        self.check_path(place, document);
        let texts = HostTexts {
            allowed: "`host` must be only a name or an address, such as \"192.168.0.30\"",
            remedy: "write the port into the key `port`",
        };
        check_host(&self.host, &texts, place, document);
        for (key, password) in
            [("connect_password", &self.connect_password), ("control_password", &self.control_password)]
        {
            let plain = password.chars().all(|c| c.is_ascii_graphic()) && !password.eq_ignore_ascii_case("off");
            if !plain {
                let allowed = "the password must be one word of plain ASCII; \"off\" is not allowed";
                document.report(&place.key(&format!("wire.{key}")), "is not a valid password", allowed, "correct it");
            }
        }
        self.check_folder(place, document);
    }

    fn notes(&self) -> Vec<String> {
        let default = Self::default();
        let known = self.control_password == default.control_password;
        let note = "linuxcncrsh has its default password and listens on every address: allow only this \
                    computer to connect to the port of linuxcncrsh";
        (known && !is_this_computer(&self.host)).then(|| note.to_owned()).into_iter().collect()
    }

    fn create_cmm(&self, _: &DriverContext<'_>) -> Result<NoMachine, DriverError> {
        Err(DriverError::NoDriver { table: "cmm", kind: "linuxcnc" })
    }

    fn create_grinder(&self, context: &DriverContext<'_>) -> Result<LinuxcncGrinder, DriverError> {
        let programs = context.cell_folder.join(&self.programs);
        let programs = std::path::absolute(&programs).unwrap_or(programs);
        if !programs.is_dir() {
            let (key, machine) = ("grinder.wire.programs".to_owned(), MachineKind::Grinder);
            return Err(DriverError::Folder { key, path: programs, machine });
        }
        let ms = |ms: u32| Duration::from_millis(ms.into());
        let at_controller = self.programs_at_controller.clone();
        Ok(LinuxcncGrinder::new(LinuxcncSettings {
            host: self.host.clone(),
            port: self.port,
            connect_password: self.connect_password.clone(),
            control_password: self.control_password.clone(),
            run_folder: context.run_folder.to_owned(),
            programs_at_controller: at_controller.unwrap_or_else(|| programs.display().to_string()),
            programs,
            simulated: context.simulated,
            joints: self.joints.into(),
            answer_timeout: ms(self.answer_timeout_ms),
            settle_timeout: ms(self.settle_timeout_ms),
            record_timeout: ms(self.record_timeout_ms),
            expected_name: context.expected_name.map(str::to_owned),
        }))
    }

    fn address(&self) -> Option<String> {
        Some(format!("{}:{}", self.host, self.port))
    }
}

impl LinuxcncWire {
    /// Checks the key `executed_path` of the cell file and reports errors to `document`. This key contains a helper
    /// program and its arguments; the program prints the path that the controller executes. `place` gives the table of
    /// the machine for the messages.
    ///
    /// These cases are errors:
    ///
    /// - The key exists in a cell that is not simulated.
    /// - The program or an argument in the key is an empty text.
    fn check_path(&self, place: &MachineTable<'_>, document: &mut Document) {
        let key = place.key("wire.executed_path");
        match (place.simulated, &self.executed_path) {
            (Some(false), Some(_)) => {
                let allowed = "only a simulated wheel requires it";
                document.report(&key, "is set in a cell that is not simulated", allowed, "remove it");
            }
            (_, Some(words)) if words.iter().any(String::is_empty) => {
                let allowed = "the value must be a program and its arguments";
                document.report(&key, "has an empty word", allowed, "remove the word");
            }
            _ => {}
        }
    }

    /// Checks the path of the folder in which the controller finds its programs, and reports errors to `document`. This
    /// is the key `programs_at_controller` or, without this key, the key `programs`. `place` gives the table of the
    /// machine for the messages.
    ///
    /// A path with blanks, parentheses, commas, semicolons, `%`, `#` or characters outside ASCII is an error: it cannot
    /// be part of a command to the controller or of a comment in a program. A relative path in `programs_at_controller`
    /// is also an error.
    fn check_folder(&self, place: &MachineTable<'_>, document: &mut Document) {
        let (key, folder) = match &self.programs_at_controller {
            Some(folder) => ("wire.programs_at_controller", folder),
            None => ("wire.programs", &self.programs),
        };
        let plain = |c: char| c.is_ascii_graphic() && !matches!(c, '(' | ')' | ';' | ',' | '%' | '#');
        if !folder.chars().all(plain) {
            let allowed =
                "the controller accepts paths of plain ASCII, without blanks, brackets, commas and semicolons";
            document.report(&place.key(key), format!("is {folder:?}"), allowed, "name another folder");
        } else if self.programs_at_controller.is_some() && !folder.starts_with('/') {
            let allowed = "the controller requires the full path";
            document.report(&place.key(key), format!("is {folder:?}"), allowed, "begin it with /");
        }
    }
}
