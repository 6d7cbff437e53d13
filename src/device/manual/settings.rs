//! Settings of a machine operated by a person, in a cell file.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{ManualMachine, ManualSettings};
use crate::MachineKind;
use crate::driver_factory::{DriverContext, DriverError, DriverFactory};
use regrind_formats::result::{Content, Coordinates, DecimalMark};
use regrind_formats::{Columns, Unit};

/// A person, step by step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ManualWire {
    /// Meaning of the coordinates of measurements, if the files do not state it; coordinates without a stated meaning
    /// are refused.
    pub coordinates: Option<Coordinates>,
    /// Decimal mark of measurements.
    pub decimal: DecimalMark,
    /// Unit of length of measurements.
    pub unit: Unit,
    /// Unit of length of z in a table, if it differs from that of x and y.
    pub height_unit: Option<Unit>,
    /// Distance of the samples of a map of heights, if the map does not state it.
    #[schemars(range(min = 1e-6, max = 100.0))]
    pub sample_spacing_mm: Option<f64>,
    /// Columns of x, y and z in measurements, if their headers do not identify them: `x=NAME,y=NAME,z=NAME`, names or
    /// numbers from 1.
    #[schemars(length(min = 5, max = 200), example = &"x=X_act,y=Y_act,z=Z_act")]
    pub columns: Option<Columns>,
    /// Maximum difference between the probe radius in a file and that of the recipe.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub probe_tolerance_mm: f64,
}

impl Default for ManualWire {
    fn default() -> Self {
        Self {
            coordinates: None,
            decimal: DecimalMark::Auto,
            unit: Unit::Millimetre,
            height_unit: None,
            sample_spacing_mm: None,
            columns: None,
            probe_tolerance_mm: 0.001,
        }
    }
}

impl DriverFactory for ManualWire {
    type Cmm = ManualMachine;
    type Grinder = ManualMachine;
    const BY_PERSON: bool = true;
    const READS_RUN_FOLDER: bool = true;

    fn coordinates(&self) -> Option<Coordinates> {
        self.coordinates
    }

    fn create_cmm(&self, context: &DriverContext<'_>) -> Result<ManualMachine, DriverError> {
        Ok(ManualMachine::new(MachineKind::Cmm, self.settings(context)))
    }

    fn create_grinder(&self, context: &DriverContext<'_>) -> Result<ManualMachine, DriverError> {
        Ok(ManualMachine::new(MachineKind::Grinder, self.settings(context)))
    }
}

impl ManualWire {
    fn settings(&self, context: &DriverContext<'_>) -> ManualSettings {
        ManualSettings {
            part: context.part.to_owned(),
            run_folder: context.run_folder.to_owned(),
            content: Content {
                coordinates: self.coordinates,
                decimal: self.decimal,
                unit: self.unit,
                height_unit: self.height_unit,
                sample_spacing_mm: self.sample_spacing_mm,
                columns: self.columns.clone(),
            },
            min_free_points: context.min_free_points,
            min_coverage: context.min_coverage,
            rehearsal: context.rehearsal,
            probe_tolerance_mm: self.probe_tolerance_mm,
        }
    }
}
