//! The two Modbus wires, for the table of drivers.

use super::settings::{Line, ModbusSettings, RtuWire, TcpWire};
use super::{Link, ModbusCmm, ModbusGrinder};
use crate::place::Place;
use crate::wiring::{Making, MakingError, Wired};
use regrind_document::Document;

macro_rules! modbus_wire {
    ($wire:ident) => {
        impl Wired for $wire {
            type Cmm = ModbusCmm;
            type Grinder = ModbusGrinder;
            const HAS_REGISTERS: bool = true;

            fn check(&self, place: &Place<'_>, document: &mut Document) {
                self.check_address(place, document);
            }

            fn check_beside(&self, grinder: &Self, document: &mut Document) {
                self.compare(grinder, document);
            }

            fn notes(&self) -> Vec<String> {
                self.missing().into_iter().collect()
            }

            fn cmm(&self, making: &Making<'_>) -> Result<ModbusCmm, MakingError> {
                let (link, settings) = link(self.line(), self.unit, self.missing(), making)?;
                Ok(ModbusCmm::on(link, settings))
            }

            fn grinder(&self, making: &Making<'_>) -> Result<ModbusGrinder, MakingError> {
                let (link, settings) = link(self.line(), self.unit, self.missing(), making)?;
                Ok(ModbusGrinder::on(link, settings))
            }

            fn link(cmm: &ModbusCmm) -> Option<&Link> {
                Some(cmm.link())
            }

            fn line(&self) -> Option<(Line, u8)> {
                Some((self.line(), self.unit))
            }
        }
    };
}

modbus_wire!(TcpWire);
modbus_wire!(RtuWire);

impl ModbusSettings {
    /// Returns the settings for a unit on a line, from the cell file.
    pub fn of(line: Line, unit: u8, making: &Making<'_>) -> Self {
        let timing = making.timing;
        Self {
            unit,
            registers: *making.registers,
            request_timeout: timing.request_timeout,
            retries: u32::from(timing.retries),
            lost_after: timing.lost_after,
            quarantine: timing.quarantine,
            owner: making.owner,
            epoch: making.epoch,
            signals: making.signals.to_vec(),
            beat_every: timing.heartbeat,
            expected_name: making.expected_name.map(str::to_owned),
            simulation: Some(making.simulated),
            ..Self::new(line)
        }
    }
}

/// Creates the line of a machine, or shares the line of the other machine, and returns it with all settings of the
/// driver.
fn link(
    line: Line,
    unit: u8,
    missing: Option<String>,
    making: &Making<'_>,
) -> Result<(Link, ModbusSettings), MakingError> {
    if let Some(missing) = missing {
        return Err(MakingError::NoPort { missing });
    }
    let settings = ModbusSettings::of(line, unit, making);
    let link = match making.beside.filter(|link| *link.line() == settings.line) {
        Some(link) => link.clone(),
        None => Link::new(settings.line.clone(), settings.request_timeout, settings.quarantine)
            .map_err(|source| MakingError::Line { line: settings.line.to_string(), source })?,
    };
    Ok((link, settings))
}
