//! Readers and writers of files: point clouds, meshes, maps, programs, and the results of a registration.
//!
//! No file is trusted. A [`FormatError`] reports any fault of a file. It names the file and the place, gives the text
//! found and the text expected, and says what to do. Nothing here panics. The size of the file bounds time and memory.

mod cad;
mod choice_error;
mod columns;
mod dmis;
mod document;
mod error;
mod figures;
mod folder;
mod foreign;
mod form_document;
mod form_figures;
pub mod gcode;
mod grid_sag;
mod height_map;
mod jsonl_appender;
mod layout;
mod learned;
mod lens;
mod line_file;
mod map;
mod maps;
mod measured_document;
mod measured_map;
pub mod metropro;
mod nominal_file;
mod note;
mod number;
pub mod operator_step;
mod persistent_counter;
pub mod ply;
pub mod points;
mod qif;
pub mod recipe_folder;
pub mod references;
mod registration;
pub mod result;
mod result_content;
pub mod run_files;
mod scanner_cloud;
pub mod sdf;
pub mod simulation_folder;
mod stitching_document;
mod stl;
mod system;
mod unit;
mod uploaded_file;
mod whole;
pub mod x3p;
mod xml;

use std::path::Path;

pub use cad::{CadFace, CadModel, parse_cad, read_cad};
pub use choice_error::ChoiceError;
pub use columns::{Columns, Table};
pub use document::{
    Alternative, MeasuredInput, NominalInput, ProgramVersion, RegistrationDocument, StandardUncertainty,
    save_registration,
};
pub use error::FormatError;
pub use figures::write_figures;
pub use folder::{ResultFolder, ScratchFolder, finished_files, move_folder, remove_socket};
pub use form_document::save_form;
pub use height_map::HeightMap;
pub use jsonl_appender::JsonlAppender;
pub use learned::{CellRun, KnowledgeOrigin, Learned, LearnedError, SettingIdentity};
pub use lens::{LensModel, LensSurface, TermsDisc, parse_lens, read_lens};
pub use line_file::LineFile;
pub use map::{
    CorrectionIdentities, ErrorMapOrigin, MapNode, parse_error_map, read_error_map, write_correction, write_error_map,
};
pub use measured_map::{is_map, parse_map};
pub use metropro::{parse_metropro, read_metropro};
pub use nominal_file::{NominalFile, read_nominal, read_nominal_as, read_nominal_with_identity};
pub use note::{NotedPoints, PointNote};
pub use number::LIMIT_MM;
pub use persistent_counter::PersistentCounter;
pub use ply::{PlyFile, parse_ply, read_ply};
pub use points::{parse_points, read_nominal_points, read_points, read_points_with_notes};
pub use recipe_folder::{RecipeFolder, RecipeVersion};
pub use registration::{
    DeviationRow, PrivateDraft, read_deviations, sync_folder, try_writing, write_atomic, write_column,
    write_deviations, write_json_atomic, write_points, write_private,
};
pub use scanner_cloud::parse_scanner_cloud;
pub use sdf::{parse_sdf, read_sdf};
pub use simulation_folder::SimulationFolder;
pub use stitching_document::{STITCHED_POINTS, StitchingDocument, save_stitching};
pub use stl::{StlFile, parse_stl, read_stl};
pub use system::{OpenToOthers, is_same_file, readable_by_others, user_name};
pub use unit::Unit;
pub use uploaded_file::UploadedFile;
pub use whole::read_whole;
pub use x3p::{MapRecord, X3pFile, escaped, parse_x3p, read_x3p, write_error_map_x3p, write_x3p};
pub use xml::is_bounded_xml;

use cad::cad_format;
use grid_sag::is_grid_sag;
use height_map::MapFormat;
use layout::is_separator_line;
use lens::lens_format;
use measured_document::{DocumentFormat, document_format, parse_document};
use measured_map::map_format;
use regrind_core::geometry::Point;
use scanner_cloud::{CloudFormat, cloud_format, parse_cloud};

/// Format of a file, detected by its content.
enum Kind {
    Text,
    Ply,
    Stl,
    Toml,
    Cad,
    Lens,
    GridSag,
    Cloud(CloudFormat),
    Document(DocumentFormat),
    Map(&'static MapFormat),
}

/// Reads measured points, in millimetres and in the order of the file. The file is text, PLY (its vertices are the
/// points), QIF or DMIS output (its measured points), or a map of heights (its measured samples are the points).
///
/// The points of a map lie on the surface. The points of another file can lie on the surface or can be the centres of a
/// spherical probe. Text and PLY do not show which; QIF and DMIS can state it, and a note of [`read_measured_with_notes`] then
/// repeats it.
///
/// # Errors
/// A file that cannot be read, or that is not valid in its format; an STL or TOML file; a format that this program does
/// not read.
pub fn read_measured(path: impl AsRef<Path>) -> Result<Vec<Point>, FormatError> {
    read_measured_with_notes(path, &Table::default()).map(|read| read.points)
}

/// Reads measured points from a text file, a PLY file, QIF, DMIS output or a map, as [`read_measured`] does. Returns the points in
/// millimetres, with notes on the content of the file that is ambiguous. If the file is a table, `table` gives the
/// columns and units that the file does not state.
///
/// # Errors
/// The same as for [`read_measured`]; columns that do not exist; columns or a unit in `table` for a file that is not a
/// table; a distance of the samples for a file that is not a map, or that states its own.
pub fn read_measured_with_notes(path: impl AsRef<Path>, table: &Table) -> Result<NotedPoints, FormatError> {
    let path = path.as_ref();
    let wrong = |found, remedy| {
        let expected = "measured points as text, PLY, QIF or DMIS output, or a map of heights of a known format";
        Err(FormatError::WrongKind { path: path.to_owned(), expected, found, remedy })
    };
    let kind = kind(path)?;
    check_is_table(path, &kind, table)?;
    match kind {
        Kind::Text => read_points_with_notes(path, table),
        Kind::Ply => read_ply(path).map(|file| file.points.into()),
        Kind::Stl => wrong("an STL mesh", "export the points, or give the mesh as the nominal"),
        Kind::Toml => wrong("a TOML file", "give the definition as the nominal"),
        Kind::Cad => wrong("a CAD model", "give the model as the nominal"),
        Kind::Lens => wrong("a lens", "give the lens as the nominal"),
        Kind::GridSag => wrong("a grid of sags of a lens", "give the grid as the nominal"),
        Kind::Cloud(format) => {
            let bytes = whole::open(path)?.read_all(path, whole::MAX_BYTES)?;
            parse_cloud(path, &bytes, format, table.unit)
        }
        Kind::Document(format) => parse_document(path, &whole::open(path)?.read_all(path, result::MAX_BYTES)?, format),
        Kind::Map(format) => format.read_points(path, table.sample_spacing_mm).map(|map| {
            let note = |note| PointNote::Map { path: path.to_owned(), note };
            NotedPoints { points: map.points, notes: map.notes.into_iter().map(note).collect() }
        }),
    }
}

/// Reads the positions of a measuring plan, in millimetres and in the order of the file. The same formats are accepted
/// as in [`read_measured`]. In a table of text, the names of the columns can state that the points are nominal (such as
/// `X_nom`). `table` gives the columns and units that the file does not state.
///
/// # Errors
/// The same as for [`read_measured_with_notes`].
pub fn read_plan(path: impl AsRef<Path>, table: &Table) -> Result<Vec<Point>, FormatError> {
    let path = path.as_ref();
    match kind(path)? {
        Kind::Text => read_nominal_points(path, table),
        _ => read_measured_with_notes(path, table).map(|read| read.points),
    }
}

/// Rejects a file of the format `kind` if `table` gives columns or a unit and the format is not a table of text, or the
/// distance of the samples and the format is not a map. Other formats state their coordinates themselves.
fn check_is_table(path: &Path, kind: &Kind, table: &Table) -> Result<(), FormatError> {
    if table.sample_spacing_mm.is_some() && !matches!(kind, Kind::Map(_)) {
        return Err(FormatError::NotAMap { path: path.to_owned() });
    }
    let table = &Table { sample_spacing_mm: None, ..table.clone() };
    // A cloud tells by itself whether it needs a unit.
    let of_cloud = matches!(kind, Kind::Cloud(_)) && table.columns.is_none() && table.height_unit.is_none();
    if matches!(kind, Kind::Text) || of_cloud || *table == Table::default() {
        return Ok(());
    }
    Err(FormatError::WrongKind {
        path: path.to_owned(),
        expected: "a table of points, for which columns and a unit can be given",
        found: "a file that states both itself",
        remedy: "remove columns and units",
    })
}

/// Determines the format of the file `path` from its first 64 KiB and its length. If they are ambiguous, the extension
/// decides. A file of no detected format is read as text.
///
/// # Errors
/// A file that cannot be read; a known format that this program does not read.
fn kind(path: &Path) -> Result<Kind, FormatError> {
    let opened = whole::open(path)?;
    let (head, length) = (&opened.head[..], opened.length);
    // Some maps begin with a line of text, which other readers refuse by name.
    if let Some(format) = map_format(head) {
        return Ok(Kind::Map(format));
    }
    if let Some(format) = cloud_format(head) {
        return Ok(Kind::Cloud(format));
    }
    if let Some(format) = document_format(head) {
        return Ok(Kind::Document(format));
    }
    if cad_format(head).is_some() {
        return Ok(Kind::Cad);
    }
    if lens_format(head).is_some() {
        return Ok(Kind::Lens);
    }
    if is_grid_sag(head) {
        return Ok(Kind::GridSag);
    }
    foreign::check_is_ours(path, head)?;
    if ply::is_ply(head) {
        return Ok(Kind::Ply);
    }
    if stl::is_stl(head, length) {
        return Ok(Kind::Stl);
    }
    if is_toml(head) {
        return Ok(Kind::Toml);
    }
    let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    let is_data = first_words(head).is_some_and(|line| line.first().is_some_and(|b| b"+-.0123456789".contains(b)));
    Ok(match extension.as_deref() {
        // A file of numbers is read as points even if its extension is wrong.
        _ if is_data && !head.contains(&0) => Kind::Text,
        Some("ply") => Kind::Ply,
        Some("stl") => Kind::Stl,
        Some("toml") => Kind::Toml,
        _ => Kind::Text,
    })
}

/// Returns the first line in `head`, the beginning of a file, that is neither blank nor a comment (`#`). Blanks at both
/// ends of the line are removed. Returns `None` if there is no such line.
fn first_words(head: &[u8]) -> Option<&[u8]> {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head);
    head.split(|&b| b == b'\n').map(<[u8]>::trim_ascii).find(|line| !line.is_empty() && !line.starts_with(b"#"))
}

/// Returns true if `head`, the beginning of a file, is TOML. The first line that is neither blank nor a comment
/// decides: it must be `[table]` or `key = value`.
fn is_toml(head: &[u8]) -> bool {
    let Some(line) = first_words(head) else { return false };
    let is_key = |b: &u8| b.is_ascii_alphanumeric() || b"_-.".contains(b);
    let table = line.strip_prefix(b"[").and_then(|rest| rest.split(|&b| b == b']').next());
    // `sep=;` begins a table written by Excel.
    let key =
        line.iter().position(|&b| b == b'=').map(|at| line[..at].trim_ascii()).filter(|_| !is_separator_line(line));
    let opens_table = line.contains(&b']')
        && table.is_some_and(|name| !name.is_empty() && name.iter().all(|b| is_key(b) || b"[\"' ".contains(b)));
    let is_quoted = |key: &[u8]| key.starts_with(b"\"") && key.len() > 1 && key.ends_with(b"\"");
    opens_table || key.is_some_and(|key| !key.is_empty() && (key.iter().all(is_key) || is_quoted(key)))
}
