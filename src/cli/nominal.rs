//! Nominal surface of a command, from any supported file format.

use std::path::Path;

use clap::Args;
use regrind::formats::{Columns, NominalFile, Table, Unit, read_nominal_as};
use regrind::geometry::Aperture;
use regrind::setup;
use regrind::surface::analytic::Sampling;
use regrind::surface::parametric::FaceFrame;
use regrind::surface::{
    DefinedSurface, Nominal, NominalKind, PlaneProjection, SampledSurface, SurfaceChoice, SurfaceSelection,
};

use super::choice::word_of;
use super::failure::Failure;
use super::finite_above_zero;
use super::words::count;

/// Columns and unit of a nominal table, and the face of a CAD model, given by a person.
#[derive(Args, Clone, Debug)]
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
    /// Face of a CAD model: its number, its name, or `largest`; `regrind accuracy` lists them. `number:3` and `name:3`
    /// tell a number from a name
    #[arg(long, value_name = "FACE")]
    face: Option<SurfaceChoice>,
    /// Frame of the face: that of the file, or one in its middle with z along its outward normal
    #[arg(long, value_name = "FRAME", value_parser = word_of::<FaceFrame>(), default_value = "file")]
    face_frame: FaceFrame,
    /// Outline of the part in x and y, as in [aperture] of a definition
    #[arg(long, value_name = "kind=\"circle\",radius_mm=18", value_parser = aperture)]
    aperture: Option<Aperture>,
    /// Largest error of the sampling of a face, in nm, if it cannot be 0.1
    #[arg(long, value_name = "NM", value_parser = finite_above_zero)]
    face_accuracy: Option<f64>,
}

impl NominalTable {
    pub(super) fn table(&self) -> Table {
        let (unit, height_unit) = (self.nominal_unit, self.nominal_height_unit);
        Table { columns: self.nominal_columns.clone(), unit, height_unit, sample_spacing_mm: None }
    }

    pub(super) fn selection(&self) -> SurfaceSelection {
        SurfaceSelection {
            choice: self.face.clone(),
            frame: self.face_frame,
            aperture: self.aperture.clone(),
            sampling: self.face_accuracy.map(|nm| Sampling::Accuracy { accuracy_mm: 1e-6 * nm }),
        }
    }
}

/// Parses an outline as the inline table of a definition, with or without braces.
fn aperture(text: &str) -> Result<Aperture, String> {
    let inner = text.trim().trim_start_matches('{').trim_end_matches('}');
    let table: toml::Table =
        toml::from_str(&format!("aperture = {{ {inner} }}")).map_err(|error| error.message().to_owned())?;
    let aperture =
        table["aperture"].clone().try_into::<Aperture>().map_err(|error| error.message().trim().to_owned())?;
    aperture.validate().map_err(|error| error.to_string())?;
    Ok(aperture)
}

/// Reads the nominal file `path` (point cloud, mesh, CAD model or definition of a surface). `projection` selects the
/// projection of a point cloud to two coordinates. `table` gives the columns and the units of a table of points whose
/// header does not state them.
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
        NominalFile::Faces(_) => "a CAD model",
        NominalFile::Lens(_) => "a lens",
    };
    if projection != PlaneProjection::Auto {
        return Err(Failure::Projection { path: path.to_owned(), what });
    }
    Ok(file)
}

/// Reads the nominal file `path` and builds the nominal surface. `projection` selects the projection of a point cloud
/// to two coordinates. `given` has the columns and the units of a table of points whose header does not state them, and
/// the face of a CAD model. Returns which of several surfaces it is too, in words.
///
/// # Errors
/// Returns the errors of [`read`]. Also returns an error with the file name if no surface can be built from the
/// content.
pub(super) fn surface(
    path: &Path,
    projection: PlaneProjection,
    given: &NominalTable,
) -> Result<(Nominal, Option<String>), Failure> {
    let file = read(path, projection, &given.table())?;
    let choice = file.chosen_in_words(&given.selection());
    let nominal = setup::nominal_from_file(path, file, projection, &given.selection()).map_err(Failure::Setup)?;
    Ok((nominal, choice))
}

/// Samples a surface at the spacing that its definition states. `path` is used in errors.
///
/// # Errors
/// Returns all errors of the sampling, with the file name.
pub(super) fn sampled(path: &Path, surface: &DefinedSurface) -> Result<SampledSurface, Failure> {
    let sampled = surface.spacing_mm().and_then(|spacing_mm| surface.sample(spacing_mm));
    sampled.map_err(|source| Failure::Definition { path: path.to_owned(), source })
}

/// Returns the kind of a nominal surface as text: grid with its size, scattered points with their projection, mesh, or
/// number of patches. `choice` says which of several surfaces of the file it is.
pub(super) fn kind_in_words(kind: NominalKind, choice: Option<String>) -> String {
    let kind = match kind {
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
    };
    match choice {
        Some(choice) => format!("{choice}; {kind}"),
        None => kind,
    }
}
