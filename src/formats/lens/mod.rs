//! Nominal surfaces from programs that design lenses: Zemax OpticStudio (`.zmx`) and Code V (`.seq`).

mod build;
mod codev;
mod model;
mod zemax;

use std::collections::HashSet;
use std::path::Path;

pub use model::{LensModel, LensSurface, TermsDisc};

use super::error::{FormatError, excerpt};
use super::whole;

/// Largest lens file that is read, in bytes.
const MAX_BYTES: u64 = 32 << 20;

/// Number of first bytes by which a lens file is detected.
const HEAD_BYTES: usize = 64 << 10;

/// Format of a lens file, detected by the first lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LensFormat {
    Zemax,
    CodeV,
}

/// Returns the format of a lens file from its first bytes; `None` for another file.
///
/// The first keyword alone is not enough: other texts begin with words such as `TITLE` and `UNIT` too.
pub(super) fn lens_format(head: &[u8]) -> Option<LensFormat> {
    let text = decoded(head);
    if is_zemax(&text) {
        return Some(LensFormat::Zemax);
    }
    is_codev(&text, head.len() >= HEAD_BYTES).then_some(LensFormat::CodeV)
}

/// Returns true if the first lines are those of Zemax: the first one is of a header, and others are of surfaces.
fn is_zemax(text: &str) -> bool {
    let mut keywords = text.split(['\n', '\r']).filter_map(|line| line.split_whitespace().next());
    let first = keywords.find(|keyword| !keyword.starts_with('!')).unwrap_or_default();
    if !matches!(first, "VERS" | "MODE" | "UNIT") {
        return false;
    }
    let keywords: HashSet<&str> = keywords.collect();
    let has_surfaces = keywords.contains("SURF") && ["TYPE", "CURV", "DISZ"].iter().any(|key| keywords.contains(key));
    has_surfaces || (first == "VERS" && keywords.contains("MODE"))
}

/// Returns true if the first statements are those of Code V: the first one is of a header, and others begin the object,
/// and the image if the text is not cut off.
fn is_codev(text: &str, is_cut: bool) -> bool {
    let mut keywords = codev::Statements::new(text).map(|(_, words)| words[0].keyword());
    let first = keywords.next().unwrap_or_default();
    let is_title = matches!(&first[..], "RDM" | "LEN" | "TIT" | "TITL" | "TITLE");
    if !is_title && !matches!(&first[..], "EPD" | "FNO" | "DIM" | "WL" | "SO") {
        return false;
    }
    let mut keywords: HashSet<String> = keywords.collect();
    keywords.insert(first);
    let has = |keyword: &str| keywords.contains(keyword);
    let has_object = has("SO") || (is_title && (has("S1") || has("S")));
    has_object && (is_cut || has("SI"))
}

/// Reads the surfaces of a lens file of at most 32 MiB.
///
/// # Errors
/// A file that is not readable, not a lens file, or malformed.
pub fn read_lens(path: impl AsRef<Path>) -> Result<LensModel, FormatError> {
    let path = path.as_ref();
    parse_lens(path, &whole::read_whole(path, MAX_BYTES)?)
}

/// Parses the content of a lens file. `path` only names the file in messages.
///
/// # Errors
/// The same as for [`read_lens`], except that the file is not readable.
pub fn parse_lens(path: &Path, bytes: &[u8]) -> Result<LensModel, FormatError> {
    match lens_format(&bytes[..bytes.len().min(HEAD_BYTES)]) {
        Some(LensFormat::Zemax) => zemax::parse_zemax(path, &decoded(bytes)),
        Some(LensFormat::CodeV) => codev::parse_codev(path, &decoded(bytes)),
        None => Err(FormatError::Unexpected {
            path: path.to_owned(),
            place: "byte 0".to_owned(),
            expected: "a lens file of Zemax or Code V".to_owned(),
            found: excerpt(&bytes[..bytes.len().min(40)]),
        }),
    }
}

/// Decodes UTF-16 with or without a mark, UTF-8, or Latin-1.
fn decoded(bytes: &[u8]) -> String {
    let wide = |bytes: &[u8], is_little: bool| -> String {
        let unit = |pair: &[u8]| {
            if is_little { u16::from_le_bytes([pair[0], pair[1]]) } else { u16::from_be_bytes([pair[0], pair[1]]) }
        };
        let units: Vec<u16> = bytes.chunks_exact(2).map(unit).collect();
        String::from_utf16_lossy(&units)
    };
    let zeros = |parity: usize| bytes.iter().take(200).skip(parity).step_by(2).filter(|b| **b == 0).count();
    match bytes {
        [0xff, 0xfe, rest @ ..] => wide(rest, true),
        [0xfe, 0xff, rest @ ..] => wide(rest, false),
        [0xef, 0xbb, 0xbf, rest @ ..] => String::from_utf8_lossy(rest).into_owned(),
        _ if bytes.len() >= 16 && zeros(1) > 6 && zeros(0) == 0 => wide(bytes, true),
        _ if bytes.len() >= 16 && zeros(0) > 6 && zeros(1) == 0 => wide(bytes, false),
        _ => std::str::from_utf8(bytes).map_or_else(|_| bytes.iter().map(|&b| b as char).collect(), ToOwned::to_owned),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lens_files_are_detected() {
        let zemax = Some(LensFormat::Zemax);
        let codev = Some(LensFormat::CodeV);
        let long = format!("RDM\nSO 0 1\n{}SI\n", "S 1 2\nASP\nK 0\n".repeat(200));
        let cut = format!("RDM\nSO 0 1\n{}", "S 1 2\n".repeat(11_000));
        for (text, expected) in [
            ("VERS 1\nMODE SEQ\n", zemax),
            ("! a remark\nUNIT MM\nSURF 0\n  TYPE STANDARD\n", zemax),
            ("tit 'three; mirrors'\nrdm y\nSO 0 1\ns 1 2\nSI\n", codev),
            ("! a remark\nFNO 4\nSO 0 1\nS 1 2\nSI\n", codev),
            ("rdm;len;title 'a';so 0 1;s 1 2;si", codev),
            ("LEN NEW\nS1 0 5\nSI 0 0\n", codev),
            (&long, codev),
            (&cut, codev),
            // Texts of others.
            ("TITLE 'a; SO; SI'\n1 2 3\n", None),
            ("TITLE = \"points\"\nVARIABLES = X, Y, Z\n1 2 3\n", None),
            ("UNIT MM\nSURF 1 2 3\nSURF 4 5 6\n", None),
            ("MODE 3D\nx y z\n", None),
            ("DIM LOC1= LOCATION OF POINT PNT1\nS 1\nSI 2\n", None),
            ("LEN 5\nS 1\n", None),
            ("S,SI\n1,2\n", None),
            ("", None),
        ] {
            assert_eq!(lens_format(text.as_bytes()), expected, "{text:.60}");
        }
    }
}
