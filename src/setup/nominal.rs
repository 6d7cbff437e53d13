//! Nominal surface of a part, from a file or from a formula.

use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::error::SetupError;
use crate::formats::{self, ChoiceError, NominalFile};
use crate::recipe::{NominalSource, Recipe, TableSettings};
use crate::surface::{DefinedSurface, Nominal, PlaneProjection, SurfaceSelection};

/// Reads the nominal surface that `recipe` names from a file, or samples it from the formula in `recipe`.
///
/// # Errors
/// Returns an error if the file cannot be read, or if no surface can be built from the file or the formula.
pub fn read_nominal(recipe: &Recipe) -> Result<Nominal, SetupError> {
    nominal_with_identity(recipe).map(|found| found.nominal)
}

/// Nominal surface and its source.
pub(super) struct IdentifiedNominal {
    pub nominal: Nominal,
    /// The file, or the recipe.
    pub path: PathBuf,
    /// Which of several surfaces of the file it is, in words.
    pub choice: Option<String>,
    /// SHA-256 that identifies the part.
    pub identity: [u8; 32],
}

/// Reads the nominal surface from a file, or samples it from a formula.
pub(super) fn nominal_with_identity(recipe: &Recipe) -> Result<IdentifiedNominal, SetupError> {
    match &recipe.nominal {
        NominalSource::Surface(surface) => {
            let nominal = sample_surface(recipe.path(), surface)?;
            let identity = surface_identity(&nominal);
            Ok(IdentifiedNominal { nominal, path: recipe.path().to_owned(), choice: None, identity })
        }
        NominalSource::File { path, table, projection, selection } => {
            let table = nominal_table_format(table).map_err(|(key, what)| SetupError::Table {
                path: recipe.path().to_owned(),
                key,
                what,
            })?;
            let (file, identity) = formats::read_nominal_with_identity(path, &table, selection)?;
            let choice = file.chosen_in_words(selection);
            let nominal = nominal_from_file(path, file, *projection, selection)?;
            Ok(IdentifiedNominal { nominal, path: path.clone(), choice, identity })
        }
    }
}

/// Converts the table settings of the nominal file from text into a table format: columns, unit, and unit of z. `words`
/// are the settings from the recipe.
///
/// # Errors
/// Returns the recipe key of a setting that is not valid, and the reason.
pub fn nominal_table_format(words: &TableSettings) -> Result<formats::Table, (&'static str, String)> {
    table_format(words, ["nominal.columns", "nominal.unit", "nominal.height_unit"])
}

/// Parses the recipe settings `words` for the file that lists the points to measure. Returns the table format of the
/// file: columns, unit, and unit of z.
///
/// # Errors
/// Returns the recipe key of a setting that is not valid, and the reason.
pub fn plan_table_format(words: &TableSettings) -> Result<formats::Table, (&'static str, String)> {
    table_format(words, ["measure.file_columns", "measure.file_unit", "measure.file_height_unit"])
}

fn table_format(words: &TableSettings, keys: [&'static str; 3]) -> Result<formats::Table, (&'static str, String)> {
    let unit = |word: &Option<String>, key| word.as_deref().map(str::parse).transpose().map_err(|what| (key, what));
    Ok(formats::Table {
        columns: words.columns.as_deref().map(str::parse).transpose().map_err(|what| (keys[0], what))?,
        unit: unit(&words.unit, keys[1])?,
        height_unit: unit(&words.height_unit, keys[2])?,
        sample_spacing_mm: None,
    })
}

/// Builds the nominal surface from `file`, the content of the file at `path`. The content is points, a mesh, faces of a
/// CAD model, or the definition of a surface by a formula. `projection` is used for points only: it selects the surface
/// onto which the points are projected for their triangulation. `selection` selects a face, and gives the outline.
///
/// # Errors
/// Returns an error with `path` if no surface can be built from the content, if a mesh encloses a solid, or if the
/// selection does not fit the content.
pub fn nominal_from_file(
    path: &Path,
    file: NominalFile,
    projection: PlaneProjection,
    selection: &SurfaceSelection,
) -> Result<Nominal, SetupError> {
    let of_surface = |source| SetupError::Nominal { path: path.to_owned(), source };
    if let Some(surface) = defined_from_file(path, &file, selection)? {
        let nominal = sample_surface(path, &surface)?;
        return Ok(with_outline(nominal, selection));
    }
    let nominal = match file {
        NominalFile::Points(points) => Nominal::from_points(points, projection).map_err(of_surface)?,
        NominalFile::Mesh { points, triangles } => {
            let nominal = Nominal::from_mesh(points, triangles).map_err(of_surface)?;
            nominal.check_is_open().map_err(of_surface)?;
            nominal
        }
        NominalFile::Definition(_) | NominalFile::Faces(_) | NominalFile::Lens(_) => {
            unreachable!("they define a surface")
        }
    };
    Ok(with_outline(nominal, selection))
}

/// Returns the surface of a definition or of a face in `file`, the content of the file at `path`. Returns `None` for
/// points and meshes.
///
/// # Errors
/// Returns an error with `path` if the selection does not fit the file, or if the surface is not valid.
pub fn defined_from_file(
    path: &Path,
    file: &NominalFile,
    selection: &SurfaceSelection,
) -> Result<Option<DefinedSurface>, SetupError> {
    file.defined_surface(selection).map_err(|source| match source {
        ChoiceError::Definition(source) => SetupError::Definition { path: path.to_owned(), source },
        source => SetupError::Choice { path: path.to_owned(), source },
    })
}

fn with_outline(nominal: Nominal, selection: &SurfaceSelection) -> Nominal {
    match &selection.aperture {
        Some(outline) => nominal.with_outline(outline.clone()),
        None => nominal,
    }
}

/// Returns the nominal surface that is sampled from a formula. The definition `surface` gives the node spacing, or an
/// accuracy from which the spacing is computed. The outline of `surface` limits the result. `path` is the file that
/// error messages name.
fn sample_surface(path: &Path, surface: &DefinedSurface) -> Result<Nominal, SetupError> {
    let grid = surface.spacing_mm().and_then(|spacing_mm| surface.sample(spacing_mm));
    let grid = grid.map_err(|source| SetupError::Definition { path: path.to_owned(), source })?;
    Nominal::from_grid_with_normals(grid.columns, grid.rows, grid.points, grid.normals)
        .map(|nominal| nominal.with_outline(surface.aperture().clone()))
        .map_err(|source| SetupError::Nominal { path: path.to_owned(), source })
}

/// Returns the SHA-256 of the coordinates of all points of a sampled surface. Thus two formulas that give exactly the
/// same points have the same SHA-256.
fn surface_identity(nominal: &Nominal) -> [u8; 32] {
    let mut hash = Sha256::new();
    for point in nominal.points() {
        for c in point.iter() {
            hash.update(c.to_le_bytes());
        }
    }
    hash.finalize().into()
}
