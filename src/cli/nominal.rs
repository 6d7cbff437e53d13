//! Nominal surface of a command, from any supported file format.

use std::path::Path;

use clap::Args;
use regrind::formats::{Columns, NominalFile, Table, Unit, read_nominal_as};
use regrind::setup;
use regrind::surface::{DefinedSurface, Nominal, NominalKind, PlaneProjection, SampledSurface};

use super::failure::Failure;
use super::words::count;

/// Columns and unit of a nominal table, given by a person.
#[derive(Args, Clone, Debug, Default)]
pub(super) struct NominalTable {
    /// Columns of the nominal table, by name or by number from 1, if its header does not identify them
    #[arg(long, value_name = "x=X_nom,y=Y_nom,z=Z_nom")]
    nominal_columns: Option<Columns>,
    /// Unit of the nominal table: mm, um, nm, cm, m or inch
    #[arg(long, value_name = "UNIT")]
    nominal_unit: Option<Unit>,
    /// Unit of z in the nominal table, if it differs from that of x and y
    #[arg(long, value_name = "UNIT")]
    nominal_height_unit: Option<Unit>,
}

impl NominalTable {
    pub(super) fn table(&self) -> Table {
        Table { columns: self.nominal_columns.clone(), unit: self.nominal_unit, height_unit: self.nominal_height_unit }
    }
}

/// Reads the nominal file `path` (point cloud, mesh or definition of a surface). `projection` selects the projection of
/// a point cloud to two coordinates. `table` gives the columns and the units of a table of points whose header does not
/// state them.
///
/// # Errors
/// Returns an error if the file cannot be read or columns are missing. Also returns an error if `projection` is not
/// [`PlaneProjection::Auto`] and the file is not a point cloud.
pub(super) fn read(path: &Path, projection: PlaneProjection, table: &Table) -> Result<NominalFile, Failure> {
    let file = read_nominal_as(path, table)?;
    let what = match file {
        NominalFile::Points(_) => return Ok(file),
        NominalFile::Mesh { .. } => "a mesh",
        NominalFile::Definition(_) => "a definition",
    };
    if projection != PlaneProjection::Auto {
        return Err(Failure::Projection { path: path.to_owned(), what });
    }
    Ok(file)
}

/// Reads the nominal file `path` and builds the nominal surface. `projection` selects the projection of a point cloud
/// to two coordinates. `table` gives the columns and the units of a table of points whose header does not state them.
///
/// # Errors
/// Returns the errors of [`read`]. Also returns an error with the file name if no surface can be built from the
/// content.
pub(super) fn surface(path: &Path, projection: PlaneProjection, table: &Table) -> Result<Nominal, Failure> {
    setup::nominal_from_file(path, read(path, projection, table)?, projection).map_err(Failure::Setup)
}

/// Parses the definition of a surface in `text` and samples it at the spacing that the definition states. `path` is
/// used in errors.
///
/// # Errors
/// Returns all errors of the definition, with the file name.
pub(super) fn sampled(path: &Path, text: &str) -> Result<SampledSurface, Failure> {
    let sample = || {
        let defined = DefinedSurface::from_toml(text)?;
        defined.sample(defined.spacing_mm()?)
    };
    sample().map_err(|source| Failure::Definition { path: path.to_owned(), source })
}

/// Returns the kind of a nominal surface as text: grid with its size, scattered points with their projection, mesh, or
/// number of patches.
pub(super) fn kind_in_words(kind: NominalKind) -> String {
    match kind {
        NominalKind::Grid { columns, rows } => format!("grid of {} x {}", count(columns), count(rows)),
        NominalKind::Scattered { projection } => {
            let plane = match projection {
                PlaneProjection::Auto | PlaneProjection::Xy => "xy",
                PlaneProjection::BestFit => "best-fit",
                PlaneProjection::Spherical => "spherical",
            };
            format!("scattered, {plane} projection")
        }
        NominalKind::Mesh => "mesh".into(),
        NominalKind::Patches { count } => format!("{count} patches"),
    }
}
