//! Content of a result file of a CMM: what it states, and what the cell states of it.

use regrind_core::geometry::Point;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::columns::Columns;
use super::unit::Unit;

/// Meaning of measured coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Coordinates {
    /// Centres of the probe.
    Centres,
    /// Points of the surface.
    Contacts,
}

impl Coordinates {
    pub(super) fn words(self) -> &'static str {
        match self {
            Self::Centres => "centres",
            Self::Contacts => "contacts",
        }
    }
}

/// The decimal mark of a file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum DecimalMark {
    /// Detected from the file.
    #[default]
    Auto,
    /// A point; commas group thousands.
    Point,
    /// A comma; points group thousands.
    Comma,
}

/// Properties of the result files that the cell states.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Content {
    /// Meaning of the coordinates, if the cell states it.
    pub coordinates: Option<Coordinates>,
    /// The decimal mark.
    pub decimal: DecimalMark,
    /// Unit of length of the files: mm, except for a machine that is known to write another one.
    pub unit: Unit,
    /// Unit of z, if it differs.
    pub height_unit: Option<Unit>,
    /// Columns x, y and z of the files, if their headers do not name them.
    pub columns: Option<Columns>,
    /// Distance of the samples of maps, in mm, if they do not state it.
    pub sample_spacing_mm: Option<f64>,
}

/// Properties of a measurement that a result file states; `None` for a property that it does not state.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Statements {
    /// Part that the file belongs to.
    pub part: Option<String>,
    /// Cycle that the file belongs to.
    pub cycle: Option<u16>,
    /// Identity of the plan, 64 hexadecimal digits in lower case.
    pub plan: Option<String>,
    /// Meaning of the coordinates.
    pub coordinates: Option<Coordinates>,
    /// Unit of length.
    pub unit: Option<Unit>,
    /// Radius of the probe.
    pub probe_radius_mm: Option<f64>,
    /// Temperature of the part.
    pub temperature_c: Option<f64>,
}

/// Content of a result file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResultFile {
    /// The points in millimetres, in the order of the file, without rows that are switched off.
    pub points: Vec<Point>,
    /// Number of the target of each point, if the file has a column `index`.
    pub indices: Option<Vec<u32>>,
    /// Name of each point, if the file has a column `name`, `point` or `feature`.
    pub names: Option<Vec<String>>,
    /// Meaning of the coordinates, as stated by the file or else by the cell.
    pub coordinates: Option<Coordinates>,
    /// Radius of the probe in mm, from a statement or a column.
    pub probe_radius_mm: Option<f64>,
    /// Number of rows that were skipped because they are switched off.
    pub switched_off: usize,
    /// Notes on ambiguous content of the file and how it was read, in words.
    pub notes: Vec<String>,
    /// Properties of the measurement that the file states.
    pub statements: Statements,
}
