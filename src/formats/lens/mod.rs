//! Nominal surfaces from programs that design lenses: Zemax OpticStudio (`.zmx`) and Code V (`.seq`).

mod build;
mod codev;
mod model;
mod zemax;

use std::path::Path;

pub use model::{LensModel, LensSurface, TermsDisc};

use super::error::{FormatError, excerpt};
use super::whole;

/// Largest lens file that is read, in bytes.
const MAX_BYTES: u64 = 32 << 20;

/// Format of a lens file, detected by the first lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LensFormat {
    Zemax,
    CodeV,
}

/// Returns the format of a lens file from its first bytes; `None` for another file.
pub(super) fn lens_format(head: &[u8]) -> Option<LensFormat> {
    let text = decoded(head);
    let lines =
        || text.split(['\n', '\r', ';']).map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('!'));
    let first_word = |line: &str| line.split_whitespace().next().unwrap_or_default().to_uppercase();
    let has = |keyword: &str| lines().take(200).any(|line| first_word(line) == keyword);
    let first = lines().next().map(first_word)?;
    if (first == "VERS" && (has("MODE") || has("SURF")))
        || (first == "MODE" && has("SURF"))
        || (first == "UNIT" && has("SURF"))
    {
        return Some(LensFormat::Zemax);
    }
    let begins = matches!(first.as_str(), "RDM" | "LEN" | "TITLE");
    (begins && has("SO") | has("S1") | has("S") && has("SI")).then_some(LensFormat::CodeV)
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
    match lens_format(&bytes[..bytes.len().min(1 << 16)]) {
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
