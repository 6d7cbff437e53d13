//! Nominal surfaces from CAD systems: STEP and IGES.
//!
//! ```text
//!  bytes --step_text--> entities --step_geometry--> curves, surfaces --step--> faces with outlines
//!                          \--step_structure--> parts, placements, units --/
//!  bytes --iges_text--> entities ---------------------------------iges--> faces with outlines
//! ```
//!
//! The surfaces stay exact: [`regrind_core::surface::parametric`] evaluates them.

mod iges;
mod iges_text;
mod model;
mod outline;
mod step;
mod step_geometry;
mod step_structure;
mod step_text;

use std::path::Path;

pub use model::{CadFace, CadModel};

use super::error::{FormatError, excerpt};
use super::whole;

/// Largest CAD file that is read, in bytes.
const MAX_BYTES: u64 = 512 << 20;

/// CAD format, detected by the first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CadFormat {
    Step,
    Iges,
}

/// Returns the CAD format of a file from its first bytes; `None` for another file.
pub(super) fn cad_format(head: &[u8]) -> Option<CadFormat> {
    let text = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    if text.get(..12).is_some_and(|word| word.eq_ignore_ascii_case(b"ISO-10303-21")) {
        return Some(CadFormat::Step);
    }
    // Columns 73 to 80 of the first line: a letter and 1. Some programs leave out the blanks at its end.
    let line = head.split(|&b| b == b'\n').next().unwrap_or_default();
    let line = line.strip_suffix(b"\r").unwrap_or(line);
    let number = std::str::from_utf8(line.get(73..line.len().min(80))?).ok()?;
    (number.trim().parse() == Ok(1) && matches!(line[72], b'S' | b'C' | b'B')).then_some(CadFormat::Iges)
}

/// Reads the faces of a STEP or IGES file of at most 512 MiB.
///
/// # Errors
/// A file that is not readable, not STEP or IGES, malformed, of an unknown unit, or without faces.
pub fn read_cad(path: impl AsRef<Path>) -> Result<CadModel, FormatError> {
    let path = path.as_ref();
    parse_cad(path, &whole::read_whole(path, MAX_BYTES)?)
}

/// Parses the content of a STEP or IGES file. `path` only names the file in messages.
///
/// # Errors
/// The same as for [`read_cad`], except that the file is not readable.
pub fn parse_cad(path: &Path, bytes: &[u8]) -> Result<CadModel, FormatError> {
    match cad_format(bytes) {
        Some(CadFormat::Step) => step::parse_step(path, bytes),
        Some(CadFormat::Iges) => iges::parse_iges(path, bytes),
        None => Err(FormatError::Unexpected {
            path: path.to_owned(),
            place: "byte 0".to_owned(),
            expected: "a STEP or IGES file".to_owned(),
            found: excerpt(&bytes[..bytes.len().min(40)]),
        }),
    }
}
