//! Detection, from the first bytes of a file, of formats of other programs that Regrind does not read, each with a
//! remedy.

use std::path::Path;

use super::error::FormatError;

/// File format that Regrind does not read, and the way to provide its content in another format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Foreign {
    /// Name of the format, with its article.
    pub found: &'static str,
    pub remedy: &'static str,
}

/// Formats that are read, for the message.
const EXPECTED: &str = "points as text or PLY, a mesh, or a map of heights of a known format";

const AS_TEXT: &str = "save the sheet with the points as CSV";
const UNPACK: &str = "unpack it and give the file that is in it";
const SAMPLE: &str = "give it as the nominal surface, or export points as text";
const DEFINE: &str = "write the equation of the surface into a definition (TOML), or export points as text";

/// First bytes that are unique to a format.
const BEGINNINGS: [(&[u8], &str, &str); 17] = [
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "a workbook of an old Excel, or another file of Office (xls)", AS_TEXT),
    (b"\x1f\x8b", "a file packed by gzip", UNPACK),
    (b"BZh", "a file packed by bzip2", UNPACK),
    (b"\xfd7zXZ\0", "a file packed by xz", UNPACK),
    (b"\x28\xb5\x2f\xfd", "a file packed by zstd", UNPACK),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive", UNPACK),
    (b"Rar!\x1a\x07", "a RAR archive", UNPACK),
    (b"%PDF", "a PDF", "export the points as text"),
    (b"\x89PNG", "a picture", "export the heights as X3P or SDF, or points as text"),
    (b"\xff\xd8\xff", "a picture", "export the heights as X3P or SDF, or points as text"),
    (b"II*\0", "a TIFF picture", "export the heights as X3P or SDF, or points as text"),
    (b"MM\0*", "a TIFF picture", "export the heights as X3P or SDF, or points as text"),
    (b"ISO-10303-21;", "a STEP file", SAMPLE),
    (b"DMISMN/", "a DMIS program", "give the results that it writes, as DMIS output or as points in a table"),
    (b"DMISMD/", "a DMIS program", "give the results that it writes, as DMIS output or as points in a table"),
    (b"Zygo ASCII Data File", "an ASCII map of Zygo", "save the map as .dat (MetroPro) or X3P"),
    (b"BEGIN PGM", "a program in Klartext", "give the measured points"),
];

/// Detects, from the first bytes of a file, a known format that this program does not read. Returns the name of the
/// format with a remedy; `None` if no such format is detected.
pub(super) fn foreign(head: &[u8]) -> Option<Foreign> {
    let plain = narrowed(head);
    let text = plain.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&plain).trim_ascii_start();
    let begins = BEGINNINGS.iter().find(|(bytes, ..)| text.starts_with(bytes) || head.starts_with(bytes));
    let begins = begins.map(|(_, found, remedy)| Foreign { found, remedy });
    begins.or_else(|| packed(head)).or_else(|| by_lines(text))
}

/// Rejects a file if its first bytes belong to a known format that this program does not read.
pub(super) fn check_is_ours(path: &Path, head: &[u8]) -> Result<(), FormatError> {
    let Some(Foreign { found, remedy }) = foreign(head) else { return Ok(()) };
    Err(FormatError::WrongKind { path: path.to_owned(), expected: EXPECTED, found, remedy })
}

/// Returns true if `head`, the beginning of a file, is text with two bytes per character (UTF-16), with or without a
/// byte order mark.
pub(super) fn is_utf16(head: &[u8]) -> bool {
    /// Number of characters that are checked.
    const LOOKED_AT: usize = 200;
    if head.starts_with(b"\xff\xfe") || head.starts_with(b"\xfe\xff") {
        return true;
    }
    let pairs = || head.chunks_exact(2).take(LOOKED_AT);
    // ASCII in two bytes: every second byte is 0. A truncated last byte is harmless.
    let is_wide = |zero: usize| pairs().all(|pair| pair[zero] == 0 && matches!(pair[1 - zero], b'\t'..=b'\r' | b' '..));
    head.len() > 3 && (is_wide(0) || is_wide(1))
}

/// Returns `head`, the beginning of a file, unchanged. For text with two bytes per character (UTF-16), returns only its
/// ASCII characters, one byte each.
fn narrowed(head: &[u8]) -> std::borrow::Cow<'_, [u8]> {
    if is_utf16(head) { head.iter().copied().filter(|b| (1..0x80).contains(b)).collect() } else { head.into() }
}

/// Detects a format in a zip container, such as an Excel workbook, by the names of the first entries. Returns `None` if
/// `head` is not a zip container, if its content is unknown, or if it is X3P, which this program reads.
fn packed(head: &[u8]) -> Option<Foreign> {
    const LOCAL: &[u8] = b"PK\x03\x04";
    /// Offsets in the local header of an entry: of the length of the name, and of the name itself.
    const LENGTH: usize = 26;
    const NAME: usize = 30;
    if !head.starts_with(LOCAL) {
        return None;
    }
    let entries = head.windows(LOCAL.len()).enumerate().filter(|(_, window)| *window == LOCAL).map(|(at, _)| at);
    let names: Vec<&[u8]> = entries
        .filter_map(|at| {
            let length = u16::from_le_bytes([*head.get(at + LENGTH)?, *head.get(at + LENGTH + 1)?]);
            head.get(at + NAME..at + NAME + usize::from(length))
        })
        .collect();
    let has = |begin: &str| names.iter().any(|name| name.starts_with(begin.as_bytes()));
    let office = [
        ("main.xml", None),
        ("3D/", Some(("a 3MF mesh", "export the mesh as STL or PLY"))),
        ("word/", Some(("a Word document", "export the points as text"))),
        ("xl/", Some(("an Excel workbook (xlsx)", AS_TEXT))),
        ("[Content_Types].xml", Some(("an Excel workbook (xlsx), or another file of Office", AS_TEXT))),
        ("mimetype", Some(("a spreadsheet (ODS), or another open document", AS_TEXT))),
    ];
    let (_, found) = office.into_iter().find(|(begin, _)| has(begin))?;
    found.map(|(found, remedy)| Foreign { found, remedy })
}

/// Detects a text format that this program does not read by the first lines of the text, such as IGES; `None` if no
/// such format is detected.
fn by_lines(text: &[u8]) -> Option<Foreign> {
    /// Column of the section letter in a line of IGES.
    const SECTION: usize = 72;
    let mut lines = text.split(|&b| b == b'\n').map(<[u8]>::trim_ascii_end);
    let (first, second) = (lines.next()?, lines.next().unwrap_or_default());
    let tail = first.get(SECTION..).unwrap_or_default();
    let is_iges = tail.first() == Some(&b'S') && tail[1..].iter().all(|b| b.is_ascii_digit() || *b == b' ');
    let words = |line: &'static str| first.starts_with(line.as_bytes());
    let numbers = |line: &[u8]| -> Option<Vec<f64>> {
        let fields = line.split(u8::is_ascii_whitespace).filter(|field| !field.is_empty());
        fields.map(|field| fast_float2::parse(field).ok()).collect()
    };
    // Seven numbers of a grid, then rows of a height, its slopes and its twist.
    let is_sag = numbers(first).zip(numbers(second)).is_some_and(|(grid, row)| {
        grid.len() == 7 && grid[..2].iter().all(|n| n.fract() == 0.0 && *n > 1.0) && matches!(row.len(), 4 | 5)
    });
    let has = |word: &[u8]| text.windows(word.len()).any(|window| window == word);
    let (found, remedy) = if is_iges {
        ("an IGES file", SAMPLE)
    } else if words("VERS ") && has(b"SURF 0") {
        ("a lens file of Zemax (.zmx)", DEFINE)
    } else if is_sag {
        ("a grid of sags of Zemax (.dat)", "write x, y and the height of each node as a table of three columns")
    } else if words("DIM ") && first.contains(&b'=') {
        ("a report of PC-DMIS", "export the measured points as a table of x, y and z")
    } else if first.starts_with(b"<") && has(b"<QIFDocument") {
        ("a QIF document", "export the measured points as a table of x, y and z")
    } else if words("<?xml") {
        ("an XML file", "export the points as text, one point a line")
    } else {
        return None;
    };
    Some(Foreign { found, remedy })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn foreign_recognizes_formats() {
        let step = b"ISO-10303-21;\nHEADER;\n";
        let iges = format!("{:72}S      1\n1H,,1H;\n", "case");
        let wide: Vec<u8> = b"VERS 1\nMODE SEQ\nSURF 0\n".iter().flat_map(|b| [*b, 0]).collect();
        let marked: Vec<u8> = [b"\xff\xfe".to_vec(), wide.clone()].concat();
        let sheet = |name: &str| {
            let length = (name.len() as u16).to_le_bytes();
            [b"PK\x03\x04".to_vec(), vec![0; 22], length.to_vec(), vec![0; 2], name.as_bytes().to_vec()].concat()
        };
        let cases: [(&[u8], &str); 10] = [
            (step, "STEP"),
            (iges.as_bytes(), "IGES"),
            (&wide, "Zemax"),
            (&marked, "Zemax"),
            (&sheet("xl/workbook.xml"), "xlsx"),
            (&sheet("[Content_Types].xml"), "xlsx"),
            (b"\x1f\x8b\x08", "gzip"),
            (b"5 5 5.0 5.0 0 0.0 0.0\n2.0e-03 0 0 0\n", "sags"),
            (b"DIM LOC1= LOCATION OF POINT PNT1\n", "PC-DMIS"),
            (b"<?xml version=\"1.0\"?>\n<QIFDocument>", "QIF"),
        ];
        for (head, name) in cases {
            assert!(foreign(head).is_some_and(|foreign| foreign.found.contains(name)), "{name}: {:?}", foreign(head));
        }
    }

    #[test]
    fn foreign_ignores_supported_files() {
        let x3p = b"PK\x03\x04\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x08\0\0\0main.xml";
        let dense = b"5 5 5 5 0 0 0\n5 5 5 5 0 0 0\n";
        for head in [&x3p[..], b"1,2,3\n", b"aISO-1.0\n", b"x,y,z\n1,2,3\n", b"ply\n", dense, b"", b"DIM x y\n", b"S"] {
            assert_eq!(foreign(head), None, "{head:?}");
        }
        assert!(!is_utf16(b"1,2,3\n") && !is_utf16(b"\0\0\0\0\0\0") && is_utf16(b"x\0\t\0y\0"));
    }
}
