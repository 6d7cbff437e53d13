//! Nominal surface in a file: points, a mesh, the definition of a surface, or faces of a CAD model.

use std::path::Path;

use regrind_core::geometry::Point;
use regrind_core::surface::SurfaceSelection;
use regrind_core::surface::analytic::{DefinedSurface, Sampling};
use regrind_core::surface::parametric::FaceFrame;

use super::cad::{CadModel, read_cad};
use super::choice_error::ChoiceError;
use super::columns::Table;
use super::error::FormatError;
use super::grid_sag::read_grid_sag;
use super::lens::{LensModel, read_lens};
use super::ply::{PlyFile, read_ply};
use super::points::read_nominal_points;
use super::stl::{StlFile, read_stl};
use super::{Kind, check_is_table, kind, whole};

/// Largest surface definition that is read, in bytes.
const MAX_DEFINITION_BYTES: u64 = 1 << 20;

/// Largest error of a sampling that is not stated, in mm.
const DEFAULT_ACCURACY_MM: f64 = 1e-7;

/// Nominal surface in one of the forms that a file can have.
#[derive(Clone, Debug, PartialEq)]
pub enum NominalFile {
    /// Points on the surface, in millimetres, in the order of the file.
    Points(Vec<Point>),
    /// A triangle mesh.
    Mesh {
        /// The vertices in millimetres.
        points: Vec<Point>,
        /// Corner indices.
        triangles: Vec<[u32; 3]>,
    },
    /// The text of a TOML file that defines the surface by its equation; another module parses it.
    Definition(String),
    /// Faces of a CAD model.
    Faces(CadModel),
    /// Surfaces of a lens.
    Lens(LensModel),
}

impl NominalFile {
    /// Returns which surface of the file is chosen, in words. Returns `None` if the file has only one, or if none can be
    /// chosen.
    pub fn chosen_in_words(&self, selection: &SurfaceSelection) -> Option<String> {
        let choice = selection.choice.as_ref();
        let (what, number, name, kind, count) = match self {
            Self::Faces(model) => {
                let (number, _) = model.choose(choice).ok()?;
                let face = &model.faces[number - 1];
                ("face", number, &face.name, &face.kind, model.faces.len())
            }
            Self::Lens(lens) => {
                let surface = lens.choose(choice).ok()?;
                ("surface", surface.number, &surface.name, &surface.kind, lens.surfaces.len())
            }
            _ => return None,
        };
        let name = if name.is_empty() { String::new() } else { format!(" `{name}`") };
        (count > 1).then(|| format!("{what} {number}{name} of {count}, {kind}"))
    }

    /// Returns the surface of a definition or of a CAD model, as `selection` says. Returns `None` for points and meshes.
    ///
    /// # Errors
    /// Returns an error if the selection does not fit the file, or if the selected surface is not valid.
    pub fn defined_surface(&self, selection: &SurfaceSelection) -> Result<Option<DefinedSurface>, ChoiceError> {
        let sampling = selection.sampling.unwrap_or(Sampling::Accuracy { accuracy_mm: DEFAULT_ACCURACY_MM });
        if let Self::Faces(model) = self {
            let (number, face) = model.choose(selection.choice.as_ref())?;
            let placed = face.place(selection.frame, selection.aperture.clone(), sampling);
            let placed = placed.map_err(|source| ChoiceError::Face { number, source })?;
            return Ok(Some(placed.surface));
        }
        if let Self::Lens(lens) = self {
            if selection.frame != FaceFrame::File {
                return Err(ChoiceError::NoFrame);
            }
            let chosen = lens.choose(selection.choice.as_ref())?;
            return chosen.defined(selection.aperture.clone(), sampling).map(Some);
        }
        if selection.choice.is_some() {
            return Err(ChoiceError::NothingToChoose);
        }
        if selection.frame != FaceFrame::File {
            return Err(ChoiceError::NoFrame);
        }
        if selection.sampling.is_some() {
            return Err(ChoiceError::NoSampling);
        }
        let Self::Definition(text) = self else { return Ok(None) };
        Ok(Some(DefinedSurface::from_toml(text)?))
    }
}

/// Reads a nominal surface from a file, and returns it with its SHA-256. `table` gives the columns and units that a
/// table of points does not state. The hash is computed from the bytes of the file, from the columns and units in
/// `table`, and from the choice of a face in `selection`, because another choice gives another surface.
///
/// # Errors
/// The same as for [`read_nominal_as`].
pub fn read_nominal_with_identity(
    path: impl AsRef<Path>,
    table: &Table,
    selection: &SurfaceSelection,
) -> Result<(NominalFile, [u8; 32]), FormatError> {
    use sha2::Digest;
    let path = path.as_ref();
    let nominal = read_nominal_as(path, table)?;
    let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
    let mut hash = sha2::Sha256::new();
    let mut file = std::fs::File::open(path).map_err(unreadable)?;
    let mut chunk = vec![0; 1 << 16];
    loop {
        match std::io::Read::read(&mut file, &mut chunk).map_err(unreadable)? {
            0 => {
                let columns = table.columns.as_ref().map(ToString::to_string);
                let unit = table.unit.map(|unit| unit.to_string());
                let height_unit = table.height_unit.map(|unit| format!("height {unit}"));
                let face = selection.choice.as_ref().map(|choice| format!("face {choice}"));
                let frame = (selection.frame != FaceFrame::File).then(|| "in the frame of the face".to_owned());
                let sampling = selection.sampling.map(|sampling| format!("{sampling:?}"));
                for said in [columns, unit, height_unit, face, frame, sampling].into_iter().flatten() {
                    hash.update(said);
                }
                return Ok((nominal, hash.finalize().into()));
            }
            n => hash.update(&chunk[..n]),
        }
    }
}

/// Reads a nominal surface from a file: points (text, PLY), a mesh (PLY, STL), faces (STEP, IGES), a lens
/// (Zemax, Code V), or the text of a TOML definition. Points and vertices are in millimetres.
///
/// The content decides the format. The extension decides only if the content is ambiguous.
///
/// # Errors
/// A file that cannot be read, or that is not valid in its format; a measured map; a format that this program does not
/// read.
pub fn read_nominal(path: impl AsRef<Path>) -> Result<NominalFile, FormatError> {
    read_nominal_as(path, &Table::default())
}

/// Reads a nominal surface from a file: points, a mesh, faces or the text of a TOML definition, as [`read_nominal`] does. If
/// the file is a table of points, `table` gives the columns and units that the file does not state.
///
/// # Errors
/// The same as for [`read_nominal`]; columns that do not exist; columns or a unit in `table` for a file that is not a
/// table.
pub fn read_nominal_as(path: impl AsRef<Path>, table: &Table) -> Result<NominalFile, FormatError> {
    let path = path.as_ref();
    let kind = kind(path)?;
    check_is_table(path, &kind, table)?;
    Ok(match kind {
        Kind::Text => NominalFile::Points(read_nominal_points(path, table)?),
        Kind::Toml => NominalFile::Definition(read_definition(path)?),
        Kind::Stl => {
            let StlFile { points, triangles, .. } = read_stl(path)?;
            NominalFile::Mesh { points, triangles }
        }
        Kind::Ply => {
            let PlyFile { points, triangles, .. } = read_ply(path)?;
            if triangles.is_empty() { NominalFile::Points(points) } else { NominalFile::Mesh { points, triangles } }
        }
        Kind::Cad => NominalFile::Faces(read_cad(path)?),
        Kind::Lens => NominalFile::Lens(read_lens(path)?),
        Kind::GridSag => NominalFile::Points(read_grid_sag(path)?),
        Kind::Cloud(_) => {
            return Err(FormatError::WrongKind {
                path: path.to_owned(),
                expected: "a nominal surface as points, mesh or definition",
                found: "the points of a scanner",
                remedy: "give them as the measurement",
            });
        }
        Kind::Document(_) => {
            return Err(FormatError::WrongKind {
                path: path.to_owned(),
                expected: "a nominal surface as points, mesh or definition",
                found: "the results of a measuring machine",
                remedy: "give them as the measurement",
            });
        }
        Kind::Map(_) => {
            return Err(FormatError::WrongKind {
                path: path.to_owned(),
                expected: "a nominal surface as points, mesh or definition",
                found: "a measured map of heights",
                remedy: "give the map as the measurement",
            });
        }
    })
}

fn read_definition(path: &Path) -> Result<String, FormatError> {
    let bytes = whole::open(path)?.read_all(path, MAX_DEFINITION_BYTES)?;
    if bytes.trim_ascii().is_empty() {
        return Err(FormatError::Empty { path: path.to_owned(), expected: "a surface definition" });
    }
    String::from_utf8(bytes).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        let bytes = error.as_bytes();
        let line = 1 + bytes[..at].iter().filter(|&&b| b == b'\n').count() as u64;
        FormatError::NotText { path: path.to_owned(), line, value: bytes[at] }
    })
}
