//! Content of `main.xml`.

use std::path::Path;

use roxmltree::{Document, Node, ParsingOptions};

use crate::error::{FormatError, excerpt};
use crate::height_map::{MAX_SAMPLES, check_size};
use crate::xml::{Beyond, beyond_bounds};

/// Maximum number of nodes of the document: three for each sample that it contains.
const MAX_NODES: u32 = 10_000_000;

/// Parts of `main.xml` that are used.
pub(super) struct Main {
    /// Axes x, y and z.
    pub(super) axes: [Axis; 3],
    pub(super) extent: Extent,
    /// True if the first row is the uppermost one.
    pub(super) rows_from_north: bool,
    /// Entry with the checksum of `main.xml`.
    pub(super) checksum_file: Option<String>,
    pub(super) notes: Vec<String>,
}

/// Coding of an axis: value in metres = offset + increment * (raw value, or index if the axis is not absolute).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Axis {
    pub(super) absolute: bool,
    pub(super) kind: Kind,
    pub(super) increment: f64,
    pub(super) offset_m: f64,
}

/// Type of a value: I, L, F and D of the standard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind {
    Int16,
    Int32,
    Float32,
    Float64,
}

impl Kind {
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::Int16 => 2,
            Self::Int32 | Self::Float32 => 4,
            Self::Float64 => 8,
        }
    }

    /// Parses one number of this X3P data type (16-bit or 32-bit integer, or 32-bit or 64-bit floating-point number)
    /// from the beginning of `at`. The bytes are in little-endian order. Returns NaN if `at` has too few bytes.
    pub(super) fn value(self, at: &[u8]) -> f64 {
        match self {
            Self::Int16 => at.first_chunk().map_or(f64::NAN, |b| i16::from_le_bytes(*b).into()),
            Self::Int32 => at.first_chunk().map_or(f64::NAN, |b| i32::from_le_bytes(*b).into()),
            Self::Float32 => at.first_chunk().map_or(f64::NAN, |b| f32::from_le_bytes(*b).into()),
            Self::Float64 => at.first_chunk().map_or(f64::NAN, |b| f64::from_le_bytes(*b)),
        }
    }
}

/// Number of samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Extent {
    Matrix([usize; 2]),
    List(usize),
}

impl Extent {
    /// Returns the number of samples in the map: columns times rows, or the length of the list. `path` only names the
    /// file in messages.
    ///
    /// # Errors
    /// The number is 0, or above the maximum for one map.
    pub(super) fn count(self, path: &Path) -> Result<usize, FormatError> {
        let [columns, rows] = match self {
            Self::Matrix(size) => size,
            Self::List(count) => [count, 1],
        };
        check_size(path, columns as u64, rows as u64)?;
        Ok(columns * rows)
    }
}

/// Entry of the container and its MD5 checksum, if one is recorded.
pub(super) struct Sealed {
    pub(super) entry: String,
    pub(super) md5: Option<String>,
}

/// Raw values of the absolute axes of a sample, 0 for the others; `None` if it was not measured.
pub(super) type Record = Option<[f64; 3]>;

/// Storage of the samples.
pub(super) enum Samples {
    Inline(Vec<Record>),
    Linked { data: Sealed, valid: Option<Sealed> },
}

/// Document and its origin, for messages.
struct Place<'a> {
    path: &'a Path,
    entry: &'a str,
}

impl Place<'_> {
    fn unexpected(&self, node: Node<'_, '_>, expected: &str, found: &str) -> FormatError {
        let line = node.document().text_pos_at(node.range().start).row;
        FormatError::Unexpected {
            path: self.path.to_owned(),
            place: format!("{}, line {line} ({})", self.entry, node.tag_name().name()),
            expected: expected.to_owned(),
            found: excerpt(found.as_bytes()),
        }
    }

    fn missing(&self, what: &str) -> FormatError {
        FormatError::Missing { path: self.path.to_owned(), expected: format!("{what} in {}", self.entry) }
    }

    fn child<'d>(&self, node: Node<'d, 'd>, name: &str) -> Result<Node<'d, 'd>, FormatError> {
        child(node, name).ok_or_else(|| self.missing(&format!("{}/{name}", node.tag_name().name())))
    }

    fn number(&self, node: Node<'_, '_>) -> Result<f64, FormatError> {
        let text = text(node);
        let number = fast_float2::parse::<f64, _>(text.as_bytes()).ok().filter(|v| v.is_finite());
        number.ok_or_else(|| self.unexpected(node, "a finite number", &text))
    }

    /// Returns the number in the child element `name` of the XML element `parent`. Returns `default` if this child does
    /// not exist or is empty.
    ///
    /// # Errors
    /// A text that is not a finite number.
    fn number_or(&self, parent: Node<'_, '_>, name: &str, default: f64) -> Result<f64, FormatError> {
        match child(parent, name).filter(|node| !text(*node).is_empty()) {
            Some(node) => self.number(node),
            None => Ok(default),
        }
    }

    fn count(&self, node: Node<'_, '_>) -> Result<usize, FormatError> {
        let text = text(node);
        text.parse().map_err(|_| self.unexpected(node, "a whole number", &text))
    }
}

/// Returns the first child element of `node` with the name `name`. The namespace is ignored, because programs write
/// different ones. Returns `None` if there is no such element.
fn child<'a, 'd>(node: Node<'a, 'd>, name: &str) -> Option<Node<'a, 'd>> {
    node.children().find(|c| c.is_element() && c.tag_name().name() == name)
}

fn text(node: Node<'_, '_>) -> String {
    node.text().unwrap_or_default().trim().to_owned()
}

impl Main {
    /// Parses `main.xml`, the XML document that describes the map in an X3P file. `bytes` is the content of `main.xml`.
    /// `entry` is the name of `main.xml` in the X3P container, and `path` is the name of the X3P file; both names are
    /// only used in messages.
    ///
    /// Returns two values. The first is the description of the map, such as its axes and its size. The second depends
    /// on where the samples are stored. If they are in `main.xml` itself, the second value has the samples. If they are
    /// in other entries of the container, the second value has the names of these entries.
    ///
    /// # Errors
    /// A document that is not valid, that describes a profile or several layers, or that has a rotated frame.
    pub(super) fn parse(path: &Path, entry: &str, bytes: &[u8]) -> Result<(Self, Samples), FormatError> {
        let place = Place { path, entry };
        let source = std::str::from_utf8(bytes).map_err(|error| {
            let at = error.valid_up_to();
            let line = 1 + bytes[..at].iter().filter(|&&b| b == b'\n').count() as u64;
            FormatError::NotText { path: path.to_owned(), line, value: bytes[at] }
        })?;
        if let Some(Beyond { line, allowed, found }) = beyond_bounds(source) {
            let place = format!("{entry}, line {line}");
            return Err(FormatError::Unexpected { path: path.to_owned(), place, expected: allowed, found });
        }
        let options = ParsingOptions { nodes_limit: MAX_NODES, ..ParsingOptions::default() };
        let document = Document::parse_with_options(source.trim_start_matches('\u{feff}'), options)
            .map_err(|source| FormatError::Xml { path: path.to_owned(), entry: entry.to_owned(), source })?;
        Self::from_root(&place, document.root_element())
    }

    fn from_root<'d>(place: &Place<'_>, root: Node<'d, 'd>) -> Result<(Self, Samples), FormatError> {
        if !root.tag_name().name().starts_with("ISO5436") {
            return Err(place.unexpected(root, "the root ISO5436_2", root.tag_name().name()));
        }
        let first = place.child(root, "Record1")?;
        let revision = child(first, "Revision").map(text).unwrap_or_default();
        let axes = place.child(first, "Axes")?;
        check_frame(place, axes)?;
        let mut notes = Vec::new();
        let rows_from_north = from_north(place, axes, &mut notes)?;
        let axes = [
            axis(place, place.child(axes, "CX")?, &revision)?,
            axis(place, place.child(axes, "CY")?, &revision)?,
            axis(place, place.child(axes, "CZ")?, &revision)?,
        ];
        let third = place.child(root, "Record3")?;
        let extent = extent(place, first, third, &axes)?;
        let samples = samples(place, third, &axes)?;
        let checksum_file = child(root, "Record4").and_then(|r| child(r, "ChecksumFile")).map(text);
        Ok((Self { axes, extent, rows_from_north, checksum_file, notes }, samples))
    }
}

/// Checks that the frame of the map is not rotated. Returns an error if the element `axes` has a rotation matrix that
/// differs from the identity by more than 1e-9 in a number. Without a rotation matrix, the frame is accepted. `place`
/// only names the file and the document in messages.
fn check_frame<'d>(place: &Place<'_>, axes: Node<'d, 'd>) -> Result<(), FormatError> {
    let Some(rotation) = child(axes, "Rotation") else { return Ok(()) };
    for element in rotation.children().filter(Node::is_element) {
        let name = element.tag_name().name();
        let unit = if matches!(name, "r11" | "r22" | "r33") { 1.0 } else { 0.0 };
        let found = place.number(element)?;
        if (found - unit).abs() > 1e-9 {
            let expected = "a frame that is not rotated; export the map without rotation";
            return Err(place.unexpected(element, expected, &found.to_string()));
        }
    }
    Ok(())
}

/// Returns true if the first row of the data has the largest y, so that the rows must be reversed. This is the case if
/// the child element `Origin` of `axes` has the text `NW` (north-west). Then a message for the user is also added to
/// `notes`. Returns false if `Origin` is `SW` (south-west), empty or missing. The standard does not have the element
/// `Origin`, but some programs write it. `place` only names the document in messages.
///
/// # Errors
/// A text other than `SW` or `NW`.
fn from_north<'d>(place: &Place<'_>, axes: Node<'d, 'd>, notes: &mut Vec<String>) -> Result<bool, FormatError> {
    let Some(origin) = child(axes, "Origin") else { return Ok(false) };
    match text(origin).as_str() {
        "" | "SW" => Ok(false),
        "NW" => {
            notes.push(
                "the file states that its first sample is the north-western one: the order of the rows was reversed"
                    .into(),
            );
            Ok(true)
        }
        other => Err(place.unexpected(origin, "SW or NW", other)),
    }
}

fn axis<'d>(place: &Place<'_>, node: Node<'d, 'd>, revision: &str) -> Result<Axis, FormatError> {
    let name = node.tag_name().name();
    let absolute = match place.child(node, "AxisType").map(|n| (n, text(n)))? {
        (_, kind) if kind == "A" => true,
        (_, kind) if kind == "I" && name != "CZ" => false,
        (n, other) => {
            return Err(place.unexpected(n, if name == "CZ" { "A (absolute)" } else { "A or I" }, &other));
        }
    };
    let kind = match child(node, "DataType").map(|n| (n, text(n))) {
        Some((_, kind)) if kind == "I" => Kind::Int16,
        Some((_, kind)) if kind == "L" => Kind::Int32,
        Some((_, kind)) if kind == "F" => Kind::Float32,
        Some((_, kind)) if kind == "D" => Kind::Float64,
        Some((n, other)) => return Err(place.unexpected(n, "I, L, F or D", &other)),
        None if !absolute => Kind::Float64,
        None => return Err(place.missing(&format!("{name}/DataType"))),
    };
    let increment = place.number_or(node, "Increment", 1.0)?;
    let offset_m = place.number_or(node, "Offset", 0.0)?;
    if !absolute && increment <= 0.0 || increment == 0.0 {
        return Err(place.unexpected(node, "an increment above 0", &increment.to_string()));
    }
    // Before the amendment of 2020 the increment of floating-point values had no meaning, and some readers ignore it.
    let floating = matches!(kind, Kind::Float32 | Kind::Float64);
    if absolute && floating && increment != 1.0 && !revision.contains("25178") {
        let expected = "an increment of 1, because the file does not state whether it scales floating point values; \
                        export the values in metres";
        return Err(place.unexpected(node, expected, &increment.to_string()));
    }
    Ok(Axis { absolute, kind, increment, offset_m })
}

fn extent<'d>(
    place: &Place<'_>,
    first: Node<'d, 'd>,
    third: Node<'d, 'd>,
    axes: &[Axis; 3],
) -> Result<Extent, FormatError> {
    let feature = place.child(first, "FeatureType")?;
    match text(feature).as_str() {
        "SUR" | "PCL" => {}
        "PRF" => return Err(place.unexpected(feature, "a surface (SUR) or points (PCL)", "PRF, a profile")),
        other => return Err(place.unexpected(feature, "SUR or PCL", other)),
    }
    if let Some(list) = child(third, "ListDimension") {
        if axes.iter().any(|axis| !axis.absolute) {
            return Err(place.unexpected(list, "a list only where all axes are absolute", &text(list)));
        }
        return Ok(Extent::List(place.count(list)?));
    }
    let matrix = place.child(third, "MatrixDimension")?;
    let layers = place.child(matrix, "SizeZ")?;
    if place.count(layers)? != 1 {
        return Err(place.unexpected(layers, "one layer", &text(layers)));
    }
    Ok(Extent::Matrix([place.count(place.child(matrix, "SizeX")?)?, place.count(place.child(matrix, "SizeY")?)?]))
}

fn samples<'d>(place: &Place<'_>, third: Node<'d, 'd>, axes: &[Axis; 3]) -> Result<Samples, FormatError> {
    if let Some(link) = child(third, "DataLink") {
        let sealed = |name, sum| -> Result<Option<Sealed>, FormatError> {
            let Some(node) = child(link, name) else { return Ok(None) };
            let entry = text(node);
            if entry.starts_with('/') || entry.contains(':') || entry.split(['/', '\\']).any(|part| part == "..") {
                return Err(place.unexpected(node, "an entry of this container", &entry));
            }
            let md5 = child(link, sum).map(text).filter(|sum| is_sum(sum));
            Ok(Some(Sealed { entry, md5 }))
        };
        let data = sealed("PointDataLink", "MD5ChecksumPointData")?;
        let data = data.ok_or_else(|| place.missing("DataLink/PointDataLink"))?;
        return Ok(Samples::Linked { data, valid: sealed("ValidPointsLink", "MD5ChecksumValidPoints")? });
    }
    let list = child(third, "DataList").ok_or_else(|| place.missing("DataLink or DataList"))?;
    let mut records = Vec::new();
    for datum in list.children().filter(|n| n.is_element() && n.tag_name().name() == "Datum") {
        if records.len() as u64 >= MAX_SAMPLES {
            let (found, limit) = (records.len() as u64 + 1, MAX_SAMPLES);
            return Err(FormatError::TooLarge { path: place.path.to_owned(), found, limit, unit: "samples of a map" });
        }
        records.push(record(place, datum, axes)?);
    }
    Ok(Samples::Inline(records))
}

/// Parses the XML element `datum`, which contains one sample. `axes` describes the axes x, y and z. The text of `datum`
/// has one number for each absolute axis (an axis whose values are stored), separated by semicolons. Returns the three
/// numbers x, y and z as stored; the number of an axis that is not absolute is 0. Returns `None` if the sample was not
/// measured: the text is empty, or a number is not finite. `place` only names the document in messages.
///
/// # Errors
/// A text with a wrong count of numbers, or with a word that is not a number.
fn record<'d>(place: &Place<'_>, datum: Node<'d, 'd>, axes: &[Axis; 3]) -> Result<Record, FormatError> {
    let text = text(datum);
    if text.is_empty() {
        return Ok(None);
    }
    let absolute = axes.iter().filter(|axis| axis.absolute).count();
    let wrong = || place.unexpected(datum, &format!("{absolute} numbers separated by semicolons"), &text);
    let mut words = text.split(';');
    let mut values = [0.0; 3];
    for value in values.iter_mut().zip(axes).filter(|(_, axis)| axis.absolute).map(|(value, _)| value) {
        let word = words.next().ok_or_else(wrong)?.trim();
        *value = fast_float2::parse::<f64, _>(word.as_bytes()).map_err(|_| wrong())?;
    }
    if words.next().is_some() {
        return Err(wrong());
    }
    Ok(values.iter().all(|v| v.is_finite()).then_some(values))
}

/// Returns true if a word can be an MD5 checksum: 32 hexadecimal digits.
pub(super) fn is_sum(word: &str) -> bool {
    word.len() == 32 && word.bytes().all(|b| b.is_ascii_hexdigit())
}
