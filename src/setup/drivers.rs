//! Drivers of the machines, with the settings of their wires.

use std::path::Path;
use std::time::Duration;

use super::error::SetupError;
use super::measurement::min_found_share;
use crate::cell::Device;
use crate::config::{CellConfig, LinkConfig};
use crate::device::{AnyCmm, AnyGrinder, DriverContext, DriverError, ModbusSettings};
use crate::recipe::{MeasuringPattern, Recipe};

/// Minimum time between two polls during a slow transfer.
const MIN_MANUAL_POLL_INTERVAL: Duration = Duration::from_millis(250);

/// Creates the drivers of the CMM and the grinder. Sends nothing to a machine. `part` is the name of the part in files
/// and prompts. `folder` is the run folder. `owner` is the number of this client, and `epoch` increases with each start
/// of the client. A machine that several clients can reach uses these two numbers to distinguish the clients.
///
/// # Errors
/// Returns an error if a connection cannot be opened, if a folder does not exist, or if the file of reference points
/// (points with known positions, for a CMM that measures from several stations) cannot be read.
pub fn create_drivers(
    recipe: &Recipe,
    cell: &CellConfig,
    part: &str,
    folder: &Path,
    [owner, epoch]: [u32; 2],
) -> Result<(AnyCmm, AnyGrinder), SetupError> {
    let failed = |source| SetupError::Machine { cell: cell.path().to_owned(), source };
    let making = |link| DriverContext {
        part,
        cell_folder: cell.path().parent().unwrap_or(Path::new("")),
        run_folder: folder,
        min_free_points: match &recipe.pattern {
            MeasuringPattern::Free { min_points } => Some(usize::try_from(*min_points).unwrap_or(usize::MAX)),
            _ => None,
        },
        min_coverage: min_found_share(recipe),
        rehearsal: cell.rehearsal,
        volume_mm: probe_travel_mm(cell),
        ..driver_context(link, cell.simulated, [owner, epoch])
    };
    let cmm = cell.cmm.link.wire.create_cmm(&making(&cell.cmm.link)).map_err(failed)?;
    let beside = DriverContext { shared_link: cmm.link(), ..making(&cell.grinder.link) };
    let grinder = cell.grinder.link.wire.create_grinder(&beside).map_err(failed)?;
    Ok((cmm, grinder))
}

/// Returns the driver settings of a machine that is connected by Modbus. Returns `None` for a machine with another kind
/// of connection. `owner` is the number of this client, and `epoch` increases with each start of the client.
///
/// `simulated` is true if the cell file declares its machines as simulated. The driver refuses a real machine in a
/// simulated cell and a simulated machine in a real cell.
pub fn modbus_settings(link: &LinkConfig, simulated: bool, owner: u32, epoch: u32) -> Option<ModbusSettings> {
    let (line, unit) = link.wire.modbus_line()?;
    Some(ModbusSettings::from_context(line, unit, &driver_context(link, simulated, [owner, epoch])))
}

/// Checks that the resources of a machine exist, such as its exchange folders. For this check the driver of the machine
/// is created and dropped. Sends nothing to the machine.
///
/// # Errors
/// Returns an error if the connection cannot be opened, if a folder does not exist, or if the file of reference points
/// (points with known positions, for a CMM that measures from several stations) cannot be read.
pub fn check_machine(cell: &CellConfig, device: Device) -> Result<(), DriverError> {
    let link = match device {
        Device::Cmm => &cell.cmm.link,
        Device::Grinder => &cell.grinder.link,
    };
    let cell_folder = cell.path().parent().unwrap_or(Path::new(""));
    let making =
        DriverContext { cell_folder, volume_mm: probe_travel_mm(cell), ..driver_context(link, cell.simulated, [1, 1]) };
    match device {
        Device::Cmm => link.wire.create_cmm(&making).map(drop),
        Device::Grinder => link.wire.create_grinder(&making).map(drop),
    }
}

/// Creates the driver of the CMM without data of a part or a run. The driver can be used only to inspect the machine.
/// Sends nothing to the machine.
///
/// # Errors
/// Returns an error if the connection cannot be opened, if a folder does not exist, or if the file of reference points
/// (points with known positions, for a CMM that measures from several stations) cannot be read.
pub fn create_cmm(cell: &CellConfig) -> Result<AnyCmm, DriverError> {
    let cell_folder = cell.path().parent().unwrap_or(Path::new(""));
    let link = &cell.cmm.link;
    link.wire.create_cmm(&DriverContext {
        cell_folder,
        volume_mm: probe_travel_mm(cell),
        ..driver_context(link, cell.simulated, [1, 1])
    })
}

/// Creates the driver of the grinder without data of a part or a run. The driver can be used only to inspect the
/// machine. Sends nothing to the machine.
///
/// # Errors
/// Returns an error if the connection cannot be opened or a folder does not exist.
pub fn create_grinder(cell: &CellConfig) -> Result<AnyGrinder, DriverError> {
    let cell_folder = cell.path().parent().unwrap_or(Path::new(""));
    let link = &cell.grinder.link;
    link.wire.create_grinder(&DriverContext { cell_folder, ..driver_context(link, cell.simulated, [1, 1]) })
}

/// Returns the box of allowed positions of the probe's centre, as its minimum and maximum corner in mm. Returns `None`
/// if the cell file does not state it.
fn probe_travel_mm(cell: &CellConfig) -> Option<[[f64; 3]; 2]> {
    cell.cmm.travel.as_ref().map(|travel| [travel.min_mm, travel.max_mm])
}

/// Returns a driver context with the connection settings of one machine from `link`. The fields for the part, the run
/// and the folders are empty. A caller that needs these fields sets them afterwards. `simulated` is true if the
/// machines of the cell are simulations. `owner` is the number of this client, and `epoch` increases with each start of
/// the client.
fn driver_context(link: &LinkConfig, simulated: bool, [owner, epoch]: [u32; 2]) -> DriverContext<'_> {
    DriverContext {
        part: "",
        cell_folder: Path::new(""),
        run_folder: Path::new(""),
        simulated,
        owner,
        epoch,
        min_free_points: None,
        min_coverage: 0.0,
        rehearsal: false,
        timing: &link.timing,
        registers: &link.registers,
        signals: &link.signals,
        expected_name: link.expected_name.as_deref(),
        volume_mm: None,
        shared_link: None,
    }
}

/// Returns the time between two reads of the status of a machine. The cell file states it. For a machine that a person
/// operates, it is at least 250 ms.
pub fn poll_interval(link: &LinkConfig) -> Duration {
    if link.wire.is_by_person() { link.timing.poll.max(MIN_MANUAL_POLL_INTERVAL) } else { link.timing.poll }
}
