//! What a cell file says of a machine that a person serves.

use schemars::JsonSchema;
use serde::Deserialize;

use super::{ManualMachine, ManualSettings};
use crate::MachineKind;
use crate::wiring::{Making, MakingError, Wired};
use regrind_formats::result::{Content, Coordinates, DecimalMark, LengthUnit};

/// A person, step by step.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ManualWire {
    /// What the coordinates of measurements are, where the files do not say so themselves; said nowhere, they are refused.
    pub what: Option<Coordinates>,
    /// Decimal mark of measurements.
    pub decimal: DecimalMark,
    /// Unit of length of measurements.
    pub unit: LengthUnit,
    /// By how much the probe radius that a file states may differ from the recipe's.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub probe_tolerance_mm: f64,
}

impl Default for ManualWire {
    fn default() -> Self {
        Self { what: None, decimal: DecimalMark::Auto, unit: LengthUnit::Mm, probe_tolerance_mm: 0.001 }
    }
}

impl Wired for ManualWire {
    type Cmm = ManualMachine;
    type Grinder = ManualMachine;
    const BY_PERSON: bool = true;
    const WORKS_FROM_RUN: bool = true;

    fn coordinates(&self) -> Option<Coordinates> {
        self.what
    }

    fn cmm(&self, making: &Making<'_>) -> Result<ManualMachine, MakingError> {
        Ok(ManualMachine::new(MachineKind::Cmm, self.settings(making)))
    }

    fn grinder(&self, making: &Making<'_>) -> Result<ManualMachine, MakingError> {
        Ok(ManualMachine::new(MachineKind::Grinder, self.settings(making)))
    }
}

impl ManualWire {
    fn settings(&self, making: &Making<'_>) -> ManualSettings {
        ManualSettings {
            part: making.part.to_owned(),
            folder: making.run_folder.to_owned(),
            content: Content { coordinates: self.what, decimal: self.decimal, unit_mm: self.unit.mm() },
            free_points: making.free_points,
            probe_tolerance_mm: self.probe_tolerance_mm,
        }
    }
}
