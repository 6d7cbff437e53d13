//! The two Modbus wires, for the table of drivers.

use super::drivers::{ModbusCmm, ModbusGrinder};
use super::link::Link;
use super::settings::{LineAddress, ModbusSettings, RtuWire, TcpWire};
use crate::driver_factory::{ConnectionCheck, DriverContext, DriverError, DriverFactory};
use crate::machine_table::MachineTable;
use regrind_document::Document;

macro_rules! modbus_wire {
    ($wire:ident) => {
        impl DriverFactory for $wire {
            type Cmm = ModbusCmm;
            type Grinder = ModbusGrinder;
            const CHECK: ConnectionCheck = ConnectionCheck::Registers;

            fn check(&self, place: &MachineTable<'_>, document: &mut Document) {
                self.check_address(place, document);
            }

            fn check_against_grinder(&self, grinder: &Self, document: &mut Document) {
                self.compare(grinder, document);
            }

            fn notes(&self) -> Vec<String> {
                self.missing().into_iter().collect()
            }

            fn create_cmm(&self, context: &DriverContext<'_>) -> Result<ModbusCmm, DriverError> {
                let (link, settings) = link(self.line(), self.unit, self.missing(), context)?;
                Ok(ModbusCmm::on(link, settings))
            }

            fn create_grinder(&self, context: &DriverContext<'_>) -> Result<ModbusGrinder, DriverError> {
                let (link, settings) = link(self.line(), self.unit, self.missing(), context)?;
                Ok(ModbusGrinder::on(link, settings))
            }

            fn link(cmm: &ModbusCmm) -> Option<&Link> {
                Some(cmm.link())
            }

            fn address(&self) -> Option<String> {
                Some(format!("{}, unit {}", self.line(), self.unit))
            }

            fn has_open_address(&self) -> bool {
                matches!(self.line(), LineAddress::Tcp { port: 0, .. })
            }

            fn modbus_line(&self) -> Option<(LineAddress, u8)> {
                Some((self.line(), self.unit))
            }
        }
    };
}

modbus_wire!(TcpWire);
modbus_wire!(RtuWire);

impl ModbusSettings {
    /// Returns the settings of the driver for the machine with the number `unit` on `line`. All other values, such as
    /// timeouts, register addresses and signals, come from `context`.
    pub fn from_context(line: LineAddress, unit: u8, context: &DriverContext<'_>) -> Self {
        let timing = context.timing;
        Self {
            unit,
            registers: *context.registers,
            request_timeout: timing.request_timeout,
            retries: u32::from(timing.retries),
            lost_after: timing.lost_after,
            quarantine: timing.quarantine,
            owner: context.owner,
            epoch: context.epoch,
            signals: context.signals.to_vec(),
            heartbeat_interval: timing.heartbeat,
            expected_name: context.expected_name.map(str::to_owned),
            simulation: Some(context.simulated),
            ..Self::new(line)
        }
    }
}

/// Returns the Modbus line of the machine with the number `unit`, and all settings of its driver. `line` is the address
/// of the line. `context` contains the settings from the cell file and the line of the other machine, if this machine
/// exists already. If both lines have the same address, both machines share one line. Otherwise a new line is created.
///
/// `missing` is a message that the serial port does not exist. It is `None` if no such problem was found.
///
/// # Errors
/// The serial port does not exist, or the line cannot be created.
fn link(
    line: LineAddress,
    unit: u8,
    missing: Option<String>,
    context: &DriverContext<'_>,
) -> Result<(Link, ModbusSettings), DriverError> {
    if let Some(missing) = missing {
        return Err(DriverError::NoPort { missing });
    }
    let settings = ModbusSettings::from_context(line, unit, context);
    let link = match context.shared_link.filter(|link| *link.line() == settings.line) {
        Some(link) => link.clone(),
        None => Link::new(settings.line.clone(), settings.request_timeout, settings.quarantine)
            .map_err(|source| DriverError::Line { line: settings.line.to_string(), source })?,
    };
    Ok((link, settings))
}
