//! Documents of measuring machines that state their own unit, and whether their points are centres of the probe or points
//! of the surface: QIF and DMIS output.

use std::path::Path;

use super::error::FormatError;
use super::note::{NotedPoints, PointNote};
use super::result_content::Content;
use super::{dmis, qif};

/// Format of a document, detected by its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DocumentFormat {
    Qif,
    Dmis,
}

/// Returns the format of a document from `head`, its first bytes; `None` for another file.
pub(super) fn document_format(head: &[u8]) -> Option<DocumentFormat> {
    if qif::is_qif(head) {
        return Some(DocumentFormat::Qif);
    }
    dmis::is_dmis_file(head).then_some(DocumentFormat::Dmis)
}

/// Parses `bytes`, the content of a document. Returns its measured points in millimetres and in the order of the document.
/// A note says whether they are centres of the probe or points of the surface, if the document says so. `path` only names
/// the file in messages.
///
/// # Errors
/// A document that is not valid in its format, that has no measured points, or that contradicts itself.
pub(super) fn parse_document(path: &Path, bytes: &[u8], format: DocumentFormat) -> Result<NotedPoints, FormatError> {
    let read = match format {
        DocumentFormat::Qif => qif::parse(path, bytes, &Content::default())?,
        DocumentFormat::Dmis => dmis::parse(path, bytes, &Content::default())?,
    };
    let probe_radius_mm = read.probe_radius_mm;
    let note = |coordinates| PointNote::Coordinates { path: path.to_owned(), coordinates, probe_radius_mm };
    Ok(NotedPoints { points: read.points, notes: read.coordinates.map(note).into_iter().collect() })
}
