//! Results as QIF 3.0 (ISO 23952): the points of `MeasuredPointSets`, or, if there are none, those of measured point
//! features.
//!
//! The unit is that of `FileUnits/PrimaryUnits/LinearUnit`, by its factor to the metre. `Compensated` of a point set
//! says if its points are contacts (true) or centres of the probe (false); the set can also give its `ProbeRadius`.
//! Attributes anywhere in the file state what it belongs to: `<AttributeStr name="regrind plan" value="5f3c..."/>`, and
//! likewise `regrind part` and `regrind cycle`. Features named `P17` belong to target 17.

use std::collections::HashMap;
use std::path::Path;

use regrind_core::geometry::Point;
use roxmltree::{Document, Node, ParsingOptions};

use super::dmis::index_of;
use super::error::{FormatError, excerpt};
use super::number::is_believable;
use super::result_content::{Content, Coordinates, ResultFile, Statements};
use super::xml::{Beyond, beyond_bounds};

/// Maximum number of nodes of a document.
const MAX_NODES: u32 = 10_000_000;
/// Namespace of QIF 3.
const NAMESPACE: &str = "http://qifstandards.org/xsd/qif3";
/// Prefix of the names of Regrind's attributes.
const OURS: &str = "regrind ";

/// Returns true if `head`, the beginning of a file, begins like an XML document.
pub(super) fn is_xml(head: &[u8]) -> bool {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    head.starts_with(b"<?xml") || head.starts_with(b"<QIFDocument") || head.starts_with(b"<!--")
}

/// Reads the properties of the measurement (such as the plan and the cycle) from the attributes of a QIF document whose
/// names begin with `regrind`. `text` is the document, and `path` only names the file in messages.
///
/// # Errors
/// A file that is not a QIF 3 document; a property with an impossible value.
pub(super) fn read_statements(path: &Path, text: &[u8]) -> Result<Statements, FormatError> {
    with_root(path, text, |root| Qif { path, root }.statements())
}

/// Reads the points of a QIF document, in millimetres. `text` is the document. The points are probe centres or contacts
/// (points on the surface). If the document does not state which, `content` decides. `path` only names the file in
/// messages.
///
/// # Errors
/// A file that is not a QIF 3 document; a document without a unit or without points; text in place of a number;
/// statements that contradict each other or `content`.
pub(super) fn parse(path: &Path, text: &[u8], content: &Content) -> Result<ResultFile, FormatError> {
    with_root(path, text, |root| Qif { path, root }.points(content))
}

fn with_root<T>(
    path: &Path,
    text: &[u8],
    read: impl FnOnce(Node<'_, '_>) -> Result<T, FormatError>,
) -> Result<T, FormatError> {
    let text = std::str::from_utf8(text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text)).map_err(|error| {
        let line = text[..error.valid_up_to()].iter().filter(|b| **b == b'\n').count() as u64 + 1;
        FormatError::NotText { path: path.to_owned(), line, value: text.get(error.valid_up_to()).copied().unwrap_or(0) }
    })?;
    if let Some(Beyond { line, allowed, found }) = beyond_bounds(text) {
        let place = format!("line {line}");
        return Err(FormatError::Unexpected { path: path.to_owned(), place, expected: allowed, found });
    }
    let options = ParsingOptions { allow_dtd: false, nodes_limit: MAX_NODES, ..ParsingOptions::default() };
    let document = Document::parse_with_options(text, options).map_err(|source| FormatError::Xml {
        path: path.to_owned(),
        entry: "the document".to_owned(),
        source,
    })?;
    let root = document.root_element();
    if !root.has_tag_name((NAMESPACE, "QIFDocument")) {
        return Err(unexpected(path, root, "a QIFDocument of QIF 3", root.tag_name().name()));
    }
    read(root)
}

struct Qif<'p, 'a, 'i> {
    path: &'p Path,
    root: Node<'a, 'i>,
}

/// Points, and what the document states about them.
#[derive(Default)]
struct QifPoints {
    points: Vec<Point>,
    names: Option<Vec<String>>,
    coordinates: Option<Coordinates>,
    probe_radius_mm: Option<f64>,
}

impl Qif<'_, '_, '_> {
    fn statements(&self) -> Result<Statements, FormatError> {
        let mut says = Statements::default();
        for node in self.root.descendants().filter(|node| node.is_element()) {
            let name = node.attribute("name").map(|name| name.replace(['_', '-'], " ").to_lowercase());
            let ours = name.as_deref().and_then(|name| name.strip_prefix(OURS));
            if let (Some(key), Some(value)) = (ours, node.attribute("value")) {
                says.read_statement(self.path, line(node), key, value.trim())?;
            }
        }
        Ok(says)
    }

    fn points(&self, content: &Content) -> Result<ResultFile, FormatError> {
        let statements = self.statements()?;
        let unit_mm = self.unit_mm()?;
        let sets: Vec<_> = self.named("MeasuredPointSet").collect();
        let found = if sets.is_empty() { self.features(unit_mm)? } else { self.sets(&sets, unit_mm)? };
        if found.points.is_empty() {
            let expected = "MeasuredPointSet, and no PointFeatureMeasurement with a Location";
            return Err(FormatError::NoData { path: self.path.to_owned(), expected });
        }
        let says = found.coordinates.or(statements.coordinates);
        if let (Some(says), Some(cell)) = (says, content.coordinates)
            && says != cell
        {
            return Err(FormatError::Contradiction {
                path: self.path.to_owned(),
                key: "coordinates",
                found: format!("{says:?}").to_lowercase(),
                by: "cell file",
                expected: format!("{cell:?}").to_lowercase(),
            });
        }
        let indices = found.names.as_ref().and_then(|names| names.iter().map(|name| index_of(name)).collect());
        Ok(ResultFile {
            points: found.points,
            indices,
            names: found.names,
            coordinates: says.or(content.coordinates),
            probe_radius_mm: found.probe_radius_mm.or(statements.probe_radius_mm),
            statements,
            ..ResultFile::default()
        })
    }

    fn named<'s>(&'s self, name: &'static str) -> impl Iterator<Item = Node<'s, 's>> {
        self.root.descendants().filter(move |node| node.has_tag_name((NAMESPACE, name)))
    }

    /// Returns the length of one unit of the document, in millimetres, such as 25.4 for inches.
    ///
    /// # Errors
    /// A document without a unit of length; a unit that is not the metre, with or without a factor.
    fn unit_mm(&self) -> Result<f64, FormatError> {
        let missing = || FormatError::Missing {
            path: self.path.to_owned(),
            expected: "FileUnits/PrimaryUnits/LinearUnit, which lengths require".to_owned(),
        };
        let primary = self.named("PrimaryUnits").next().ok_or_else(missing)?;
        let unit = child(primary, "LinearUnit").ok_or_else(missing)?;
        let name = child(unit, "SIUnitName").and_then(|node| node.text()).unwrap_or_default().trim();
        if !matches!(name, "meter" | "metre") {
            return Err(unexpected(self.path, unit, "the meter as SIUnitName", name));
        }
        let Some(conversion) = child(unit, "UnitConversion") else { return Ok(1000.0) };
        let factor = child(conversion, "Factor");
        let offset = child(conversion, "Offset").and_then(|node| node.text()).map_or("0", str::trim);
        let factor_text = factor.and_then(|node| node.text()).unwrap_or_default().trim();
        let unit_mm =
            factor_text.parse::<f64>().ok().map(|factor| 1000.0 * factor).filter(|mm| (1e-6..=1e6).contains(mm));
        match offset.parse() {
            Ok(0.0) => unit_mm.ok_or_else(|| unexpected(self.path, conversion, "the unit in metres", factor_text)),
            _ => Err(unexpected(self.path, conversion, "a unit of length without an offset", offset)),
        }
    }

    fn sets(&self, sets: &[Node<'_, '_>], unit_mm: f64) -> Result<QifPoints, FormatError> {
        let mut found = QifPoints::default();
        for set in sets {
            if child(*set, "CoordinateSystemId").or(child(*set, "TranformId")).is_some() {
                let expected = "points in the frame of the document, which is the machine's";
                return Err(unexpected(self.path, *set, expected, "a coordinate system of their own"));
            }
            if let Some(units) = child(*set, "Units") {
                return Err(unexpected(self.path, units, "points in the unit of the document", "units of their own"));
            }
            let points = child(*set, "Points");
            let points =
                points.ok_or_else(|| unexpected(self.path, *set, "Points as text", "no points, or binary points"))?;
            let there = found.points.len();
            self.list(points, unit_mm, &mut found.points)?;
            let read = found.points.len() - there;
            if set.attribute("count").is_some_and(|count| count.trim().parse() != Ok(read)) {
                let count = set.attribute("count").unwrap_or_default();
                return Err(unexpected(self.path, *set, &format!("a count of {read}, the number of points"), count));
            }
            self.what_they_are(*set, unit_mm, &mut found)?;
        }
        Ok(found)
    }

    fn list(&self, node: Node<'_, '_>, unit_mm: f64, points: &mut Vec<Point>) -> Result<(), FormatError> {
        let mut numbers = node.text().unwrap_or_default().split_ascii_whitespace();
        while let Some(first) = numbers.next() {
            let mut at_mm = [0.0; 3];
            for (k, value) in at_mm.iter_mut().enumerate() {
                let text = if k == 0 { Some(first) } else { numbers.next() };
                let text = text.ok_or_else(|| {
                    unexpected(self.path, node, "three numbers for each point", "an incomplete point")
                })?;
                let number = text.parse::<f64>().ok().map(|number| number * unit_mm).filter(|n| is_believable(*n));
                *value = number.ok_or_else(|| unexpected(self.path, node, "a coordinate", text))?;
            }
            points.push(Point::from(at_mm));
        }
        Ok(())
    }

    /// Reads from `set`, a set of measured points, whether its points are contacts (points on the surface) or centres
    /// of the probe, and the radius of the probe. Stores both in `found`. A property that `set` does not state stays
    /// unchanged. `unit_mm` is the length of one unit of the document, in millimetres.
    ///
    /// # Errors
    /// A set that differs from the sets before it; a value that is not valid.
    fn what_they_are(&self, set: Node<'_, '_>, unit_mm: f64, found: &mut QifPoints) -> Result<(), FormatError> {
        if let Some(compensated) = child(set, "Compensated") {
            let says = match compensated.text().unwrap_or_default().trim() {
                "true" | "1" => Coordinates::Contacts,
                "false" | "0" => Coordinates::Centres,
                other => return Err(unexpected(self.path, compensated, "true or false", other)),
            };
            if found.coordinates.is_some_and(|before| before != says) {
                return Err(unexpected(self.path, compensated, "the same value for all point sets", "another value"));
            }
            found.coordinates = Some(says);
        } else if let Some(each) = child(set, "Compensations").or(child(set, "BinaryCompensated")) {
            return Err(unexpected(self.path, each, "one Compensated for all points of a set", "one for each point"));
        }
        if let Some(radius) = child(set, "ProbeRadius") {
            let text = radius.text().unwrap_or_default().trim();
            let radius_mm = text.parse::<f64>().ok().map(|r| r * unit_mm).filter(|r| (1e-3..=1e3).contains(r));
            let radius_mm = radius_mm.ok_or_else(|| unexpected(self.path, radius, "a radius of a probe", text))?;
            if found.probe_radius_mm.is_some_and(|before| before != radius_mm) {
                return Err(unexpected(self.path, radius, "one probe for all points", text));
            }
            found.probe_radius_mm = Some(radius_mm);
        }
        Ok(())
    }

    /// Reads the points of all `PointFeatureMeasurement` elements of the document, in millimetres. The name of each
    /// point is that of its `PointFeatureItem`, or empty if there is none. `unit_mm` is the length of one unit of the
    /// document, in millimetres.
    ///
    /// # Errors
    /// An element with a location that is not one point of three numbers.
    fn features(&self, unit_mm: f64) -> Result<QifPoints, FormatError> {
        let name = |node: Node<'_, '_>| child(node, "FeatureName").and_then(|name| name.text()).map(str::to_owned);
        let items = self.named("PointFeatureItem");
        let items: HashMap<_, _> =
            items.filter_map(|item| Some((item.attribute("id")?.to_owned(), name(item)?))).collect();
        let (mut found, mut names) = (QifPoints::default(), Vec::new());
        for feature in self.named("PointFeatureMeasurement") {
            let Some(location) = child(feature, "Location") else { continue };
            let there = found.points.len();
            self.list(location, unit_mm, &mut found.points)?;
            if found.points.len() != there + 1 {
                return Err(unexpected(self.path, location, "one point", "another number of points"));
            }
            let item = child(feature, "FeatureItemId").and_then(|item| item.text()).unwrap_or_default().trim();
            names.push(items.get(item).cloned().unwrap_or_default());
        }
        Ok(QifPoints { names: Some(names), ..found })
    }
}

fn child<'a, 'i>(node: Node<'a, 'i>, name: &str) -> Option<Node<'a, 'i>> {
    node.children().find(|node| node.has_tag_name((NAMESPACE, name)))
}

fn line(node: Node<'_, '_>) -> u64 {
    node.document().text_pos_at(node.range().start).row.into()
}

fn unexpected(path: &Path, node: Node<'_, '_>, expected: &str, found: &str) -> FormatError {
    FormatError::Unexpected {
        path: path.to_owned(),
        place: format!("line {}, element {}", line(node), node.tag_name().name()),
        expected: expected.to_owned(),
        found: excerpt(found.as_bytes()),
    }
}

#[cfg(test)]
mod tests {
    use super::super::result::parse_result;
    use super::*;

    const PLAN: &str = "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff";

    fn parsed(text: &str) -> Result<ResultFile, FormatError> {
        parse_result(Path::new("SN-7_c2.qif"), text.as_bytes(), &Content::default())
    }

    fn document(results: &str) -> String {
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<QIFDocument xmlns=\"{NAMESPACE}\" versionQIF=\"3.0.0\" idMax=\"9\">\n\
             <Attributes n=\"3\"><AttributeStr name=\"regrind part\" value=\"SN-7\"/>\
             <AttributeStr name=\"regrind cycle\" value=\"2\"/><AttributeStr name=\"regrind plan\" value=\"{PLAN}\"/></Attributes>\n\
             <FileUnits><PrimaryUnits><LinearUnit><SIUnitName>meter</SIUnitName><UnitName>mm</UnitName>\
             <UnitConversion><Factor>0.001</Factor></UnitConversion></LinearUnit></PrimaryUnits></FileUnits>\n{results}\n</QIFDocument>"
        )
    }

    const SET: &str = "<MeasuredPointSet count=\"2\" id=\"5\">\n<Points>1.5 -2.25 3\n4 5 6</Points>\
                       <Compensated>false</Compensated><ProbeRadius>1.5</ProbeRadius></MeasuredPointSet>";

    #[test]
    fn qif_reads_point_set() {
        let found = parsed(&document(SET)).unwrap();
        assert_eq!(found.points, [Point::new(1.5, -2.25, 3.0), Point::new(4.0, 5.0, 6.0)]);
        assert_eq!(
            (found.indices, found.coordinates, found.probe_radius_mm),
            (None, Some(Coordinates::Centres), Some(1.5))
        );
        let says = found.statements;
        assert_eq!((says.part.as_deref(), says.cycle, says.plan.as_deref()), (Some("SN-7"), Some(2), Some(PLAN)));
        let inches = parsed(&document(SET).replace("0.001", "0.0254").replace(">1.5<", ">0.1<")).unwrap();
        assert!((inches.points[1].x - 101.6).abs() < 1e-12 && (inches.probe_radius_mm.unwrap() - 2.54).abs() < 1e-12);
        let contacts = parsed(&document(SET).replace("false", "true")).unwrap();
        assert_eq!(contacts.coordinates, Some(Coordinates::Contacts));
    }

    #[test]
    fn qif_point_features_name_targets() {
        let features = "<FeatureItems><PointFeatureItem id=\"3\"><FeatureName>P17</FeatureName></PointFeatureItem></FeatureItems>\
            <MeasuredFeatures n=\"1\"><PointFeatureMeasurement id=\"4\"><FeatureItemId>3</FeatureItemId>\
            <Location>1 2 3</Location></PointFeatureMeasurement></MeasuredFeatures>";
        let found = parsed(&document(features)).unwrap();
        assert_eq!((found.points, found.indices), (vec![Point::new(1.0, 2.0, 3.0)], Some(vec![17])));
        // The file does not say if these points are compensated: the caller takes that from the cell file.
        assert_eq!(found.coordinates, None);
    }

    #[test]
    fn qif_errors_name_line_and_element() {
        for (of, with, reason) in [
            ("4 5 6", "4 5", "line 6, element Points: expected three numbers for each point"),
            ("4 5 6", "4 five 6", "line 6, element Points: expected a coordinate, found `five`"),
            ("4 5 6", "4 INF 6", "expected a coordinate, found `INF`"),
            (
                "count=\"2\"",
                "count=\"3\"",
                "element MeasuredPointSet: expected a count of 2, the number of points, found `3`",
            ),
            (">false<", ">perhaps<", "expected true or false"),
            ("<FileUnits>", "<FileUnits><!-- ", "not readable as XML"),
            ("SIUnitName>meter", "SIUnitName>feet", "expected the meter as SIUnitName, found `feet`"),
            ("0.001", "0", "expected the unit in metres, found `0`"),
            (
                "QIFDocument xmlns=\"http://qifstandards.org/xsd/qif3",
                "QIFDocument xmlns=\"http://qifstandards.org/xsd/qif2",
                "a QIFDocument of QIF 3",
            ),
            (SET, "", "no data"),
        ] {
            let text = document(SET).replace(of, with);
            assert_ne!(text, document(SET));
            let error = parsed(&text).unwrap_err().to_string();
            assert!(
                error.contains(reason) || reason == "no data" && error.contains("MeasuredPointSet"),
                "{with:?}: {error}"
            );
        }
        let cell = Content { coordinates: Some(Coordinates::Contacts), ..Content::default() };
        let error = parse_result(Path::new("x.qif"), document(SET).as_bytes(), &cell).unwrap_err();
        assert!(matches!(error, FormatError::Contradiction { key: "coordinates", .. }), "{error}");
    }
}
