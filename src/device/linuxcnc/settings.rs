//! Settings of a LinuxCNC grinder in a cell file, and the machine created from them.

use std::path::PathBuf;
use std::time::Duration;

/// Settings that drive a controller.
#[derive(Clone, Debug)]
pub struct LinuxcncSettings {
    /// Name or address of the controller.
    pub host: String,
    /// Port of linuxcncrsh.
    pub port: u16,
    /// Password of `hello`.
    pub connect_password: String,
    /// Password of `set enable`.
    pub control_password: String,
    /// Folder of the run, the source of programs.
    pub run_folder: PathBuf,
    /// Folder of programs, as this computer sees it.
    pub programs: PathBuf,
    /// Folder of programs, as the controller sees it.
    pub programs_at_controller: String,
    /// True if the controller drives a simulated machine; the controller does not know this itself.
    pub simulated: bool,
    /// Joints that must be homed.
    pub joints: usize,
    /// Timeout of an answer.
    pub answer_timeout: Duration,
    /// Timeout of the effect of an order.
    pub settle_timeout: Duration,
    /// Timeout until a record is visible after its program has stopped running.
    pub record_timeout: Duration,
    /// Expected name of the machine: its ini file, or the name of its server.
    pub expected_name: Option<String>,
}
