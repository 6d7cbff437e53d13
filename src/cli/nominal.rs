//! The nominal surface of a command: whatever form its file has.

use std::path::Path;

use regrind::formats::{NominalFile, Table, read_nominal_as};
use regrind::setup;
use regrind::surface::{DefinedSurface, Nominal, NominalKind, Projection, SampledSurface};

use super::failure::Failure;
use super::words::count;

/// Reads a nominal file.
///
/// # Errors
/// A file that cannot be read, and a projection for what is no cloud of points.
pub(super) fn read(path: &Path, projection: Projection) -> Result<NominalFile, Failure> {
    read_as(path, projection, &Table::default())
}

fn read_as(path: &Path, projection: Projection, table: &Table) -> Result<NominalFile, Failure> {
    let file = read_nominal_as(path, table)?;
    let what = match file {
        NominalFile::Points(_) => return Ok(file),
        NominalFile::Mesh { .. } => "a mesh",
        NominalFile::Definition(_) => "a definition",
    };
    if projection != Projection::Auto {
        return Err(Failure::Projection { path: path.to_owned(), what });
    }
    Ok(file)
}

/// Reads a nominal file and makes the surface of it.
///
/// # Errors
/// Those of [`read`], and what makes no surface, by file name.
pub(super) fn surface(path: &Path, projection: Projection) -> Result<Nominal, Failure> {
    surface_as(path, projection, &Table::default())
}

/// The same; of a table of points `table` says what it does not say of itself.
///
/// # Errors
/// Those of [`surface`], and columns that are not there.
pub(super) fn surface_as(path: &Path, projection: Projection, table: &Table) -> Result<Nominal, Failure> {
    setup::surface(path, read_as(path, projection, table)?, projection).map_err(Failure::Setup)
}

/// Samples a defined surface at its spacing.
///
/// # Errors
/// Whatever is wrong with the definition, by file name.
pub(super) fn sampled(path: &Path, text: &str) -> Result<SampledSurface, Failure> {
    let sample = || {
        let defined = DefinedSurface::from_toml(text)?;
        defined.sample(defined.spacing_mm()?)
    };
    sample().map_err(|source| Failure::Definition { path: path.to_owned(), source })
}

/// Tells in words what a nominal surface was made from.
pub(super) fn kind_in_words(kind: NominalKind) -> String {
    match kind {
        NominalKind::Grid { columns, rows } => format!("grid of {} x {}", count(columns), count(rows)),
        NominalKind::Scattered { projection } => {
            let plane = match projection {
                Projection::Auto | Projection::Xy => "xy",
                Projection::BestFit => "best-fit",
                Projection::Spherical => "spherical",
            };
            format!("scattered, {plane} projection")
        }
        NominalKind::Mesh => "mesh".into(),
        NominalKind::Patches { count } => format!("{count} patches"),
    }
}
