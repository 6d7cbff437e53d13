//! Sources of the nominal surface and of the points to measure.

use std::path::PathBuf;

use crate::measuring::Layout;
use crate::surface::{DefinedSurface, PlaneProjection, SurfaceSelection};

/// Format of a table of points, as text from the recipe, for files that do not state their format themselves.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TableSettings {
    /// Columns of x, y and z.
    pub columns: Option<String>,
    /// Unit. The default is mm.
    pub unit: Option<String>,
    /// Unit of z, if it differs from that of x and y.
    pub height_unit: Option<String>,
}

/// Source of the nominal surface.
#[derive(Clone, Debug, PartialEq)]
pub enum NominalSource {
    /// File of points, a mesh or a surface definition.
    File {
        /// Path of the file. Relative paths of a recipe are relative to the recipe.
        path: PathBuf,
        /// Format of a table of points.
        table: TableSettings,
        /// Surface onto which scattered points are projected.
        projection: PlaneProjection,
        /// Face of a CAD model and its frame, and the outline of the part, if it is smaller than the surface.
        selection: SurfaceSelection,
    },
    /// Formula.
    Surface(Box<DefinedSurface>),
}

/// Pattern of the measured points.
#[derive(Clone, Debug, PartialEq)]
pub enum MeasuringPattern {
    /// Points that Regrind lays out.
    Generated(Layout),
    /// Points of a file, in the model frame.
    File {
        /// Path of the file. Relative paths of a recipe are relative to the recipe.
        path: PathBuf,
        /// Format of a table of points.
        table: TableSettings,
    },
    /// Points that the operator chooses. The machine receives no plan.
    Free {
        /// Minimum number of points.
        min_points: u32,
    },
}
