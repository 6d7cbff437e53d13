//! Results as QIF 3.0 (ISO 23952) or QIF 2.1 (ANSI/DMSC): the measured points, or, if there are none, the locations of
//! measured point features.
//!
//! | | 3.0 | 2.1 |
//! |---|---|---|
//! | measured points | `MeasuredPointSets/MeasuredPointSet/Points` | `MeasuredFeatures/FeatureActuals/*/PointList/MeasurePoint/Point` |
//! | point features | `MeasuredFeatures/PointFeatureMeasurement/Location` | `MeasuredFeatures/FeatureActuals/PointFeatureActual/Location` |
//!
//! The unit is that of `FileUnits/PrimaryUnits/LinearUnit`, by its factor to the metre. `Compensated` of a point set, or
//! of a point, says if it is a contact (true) or a centre of the probe (false); `ProbeRadius` beside it gives the radius.
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
/// Largest difference of two radii of the same probe. Programs write the radius with different numbers of digits.
const SAME_RADIUS_MM: f64 = 1e-6;
/// Elements by which points state a frame other than that of the document. The schema of 3.0 has `TranformId`.
const FRAMES: [&str; 3] = ["CoordinateSystemId", "TranformId", "TransformId"];
/// Prefix of the names of Regrind's attributes.
const OURS: &str = "regrind ";

/// Version of QIF that is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Version {
    V2_1,
    V3_0,
}

impl Version {
    /// Returns the version of the document with the root element `root`. QIF 2.0 has the same namespace as QIF 2.1.
    ///
    /// # Errors
    /// A version other than 2.1 and 3.0.
    fn stated(path: &Path, root: Node<'_, '_>) -> Result<Self, FormatError> {
        let namespace = root.tag_name().namespace().unwrap_or_default();
        let stated = root.attribute("versionQIF").map(str::trim);
        let numbers = stated.map(|stated| {
            let mut numbers = stated.split('.');
            [numbers.next().unwrap_or_default(), numbers.next().unwrap_or_default()]
        });
        for version in [Self::V2_1, Self::V3_0] {
            let is_stated = match numbers {
                Some(numbers) => numbers == version.numbers(),
                None => version == Self::V3_0,
            };
            if namespace == version.namespace() && is_stated {
                return Ok(version);
            }
        }
        let version = |stated: &str| format!("versionQIF `{}`", excerpt(stated.as_bytes()));
        let said = stated.map_or("no versionQIF".to_owned(), version);
        Err(FormatError::Version {
            path: path.to_owned(),
            expected: "QIF 3.0 or QIF 2.1",
            found: format!("{said} in the namespace `{}`", excerpt(namespace.as_bytes())),
            remedy: "export the document as QIF 3.0 or 2.1",
        })
    }

    fn numbers(self) -> [&'static str; 2] {
        match self {
            Self::V2_1 => ["2", "1"],
            Self::V3_0 => ["3", "0"],
        }
    }

    fn namespace(self) -> &'static str {
        match self {
            Self::V2_1 => "http://qifstandards.org/xsd/qif2",
            Self::V3_0 => "http://qifstandards.org/xsd/qif3",
        }
    }

    /// Returns the names of the element that has the measured features, and of a measured point feature in it.
    fn features(self) -> [&'static str; 2] {
        match self {
            Self::V2_1 => ["FeatureActuals", "PointFeatureActual"],
            Self::V3_0 => ["MeasuredFeatures", "PointFeatureMeasurement"],
        }
    }
}

/// Returns true if `head`, the beginning of a file, is that of a QIF document.
pub(super) fn is_qif(head: &[u8]) -> bool {
    const ROOT: &[u8] = b"QIFDocument";
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    head.starts_with(b"<") && head.windows(ROOT.len()).any(|window| window == ROOT)
}

/// Returns true if `head`, the beginning of a file, begins like an XML document.
pub(super) fn is_xml(head: &[u8]) -> bool {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    head.starts_with(b"<?xml") || head.starts_with(b"<QIFDocument") || head.starts_with(b"<!--")
}

/// Reads the properties of the measurement (such as the plan and the cycle) from the attributes of a QIF document whose
/// names begin with `regrind`. `text` is the document, and `path` only names the file in messages.
///
/// # Errors
/// A file that is not a QIF document of version 3.0 or 2.1; a property with an impossible value.
pub(super) fn read_statements(path: &Path, text: &[u8]) -> Result<Statements, FormatError> {
    with_root(path, text, |qif| qif.statements())
}

/// Reads the points of a QIF document, in millimetres. `text` is the document. The points are probe centres or contacts
/// (points on the surface). If the document does not state which, `content` decides. `path` only names the file in
/// messages.
///
/// # Errors
/// A file that is not a QIF document of version 3.0 or 2.1; a document without a unit or without points, or with results
/// of several measurements; text in place of a number; statements that contradict each other or `content`.
pub(super) fn parse(path: &Path, text: &[u8], content: &Content) -> Result<ResultFile, FormatError> {
    with_root(path, text, |qif| qif.points(content))
}

fn with_root<T>(
    path: &Path,
    text: &[u8],
    read: impl FnOnce(Qif<'_, '_, '_>) -> Result<T, FormatError>,
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
    if root.tag_name().name() != "QIFDocument" {
        return Err(unexpected(path, root, "a QIFDocument", root.tag_name().name()));
    }
    read(Qif { path, version: Version::stated(path, root)?, root })
}

struct Qif<'p, 'a, 'i> {
    path: &'p Path,
    version: Version,
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
        let measured = match self.version {
            Version::V3_0 => self.named("MeasuredPointSet").collect(),
            Version::V2_1 => self.lists(),
        };
        let found = match self.version {
            _ if measured.is_empty() => self.features(unit_mm)?,
            Version::V3_0 => self.sets(&measured, unit_mm)?,
            Version::V2_1 => self.point_lists(&measured, unit_mm)?,
        };
        if found.points.is_empty() {
            let expected = match self.version {
                Version::V3_0 => "MeasuredPointSet, and no PointFeatureMeasurement with a Location",
                Version::V2_1 => "MeasurePoint of a FeatureActual, and no PointFeatureActual with a Location",
            };
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
        self.root.descendants().filter(move |node| node.has_tag_name((self.version.namespace(), name)))
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

    /// Returns the lists of measured points of QIF 2.1, in the order of the document.
    fn lists(&self) -> Vec<Node<'_, '_>> {
        let [features, _] = self.version.features();
        let is_measured = |list: &Node<'_, '_>| {
            let all = list.ancestors().nth(2);
            all.is_some_and(|all| all.has_tag_name((self.version.namespace(), features)))
        };
        self.named("PointList").filter(is_measured).collect()
    }

    /// Reads the points of lists of measured points, in millimetres. If each list has one point, the name of the point is
    /// that of its feature. `unit_mm` is the length of one unit of the document, in millimetres.
    ///
    /// # Errors
    /// A point that is not three numbers; a list with another number of points than it states; points in a frame of their
    /// own; points that differ in the compensation or in the probe.
    fn point_lists(&self, lists: &[Node<'_, '_>], unit_mm: f64) -> Result<QifPoints, FormatError> {
        self.check_is_one_measurement(lists)?;
        let (mut found, mut names, items) = (QifPoints::default(), Vec::new(), self.item_names());
        for list in lists {
            self.check_frame(*list)?;
            let there = found.points.len();
            for measured in list.children().filter(|node| node.tag_name().name() == "MeasurePoint") {
                self.check_frame(measured)?;
                let missing = || unexpected(self.path, measured, "a Point", "none");
                self.one_point(child(measured, "Point").ok_or_else(missing)?, unit_mm, &mut found.points)?;
                self.what_they_are(measured, unit_mm, &mut found)?;
            }
            let read = found.points.len() - there;
            self.check_count(*list, "n", read)?;
            if read == 1 {
                names.push(list.parent().map(|feature| name_of_feature(feature, &items)).unwrap_or_default());
            }
        }
        let is_each_named = names.len() == lists.len();
        Ok(QifPoints { names: is_each_named.then_some(names), ..found })
    }

    /// Checks that all of `nodes`, elements with measured points, belong to one `MeasurementResults`: another one has
    /// another part, or a repeated measurement.
    fn check_is_one_measurement(&self, nodes: &[Node<'_, '_>]) -> Result<(), FormatError> {
        let results = |node: &Node<'_, '_>| {
            node.ancestors().find(|node| node.tag_name().name() == "MeasurementResults").map(|node| node.id())
        };
        let first = nodes.first().and_then(results);
        match nodes.iter().find(|node| results(node) != first) {
            Some(other) => {
                let expected = "the points of one MeasurementResults; export each measurement in a file of its own";
                Err(unexpected(self.path, *other, expected, "points of another MeasurementResults"))
            }
            None => Ok(()),
        }
    }

    fn check_frame(&self, points: Node<'_, '_>) -> Result<(), FormatError> {
        if FRAMES.iter().any(|name| child(points, name).is_some()) {
            let expected = "points in the frame of the document, which is the machine's";
            return Err(unexpected(self.path, points, expected, "a coordinate system of their own"));
        }
        self.check_unit(points)
    }

    /// Checks that `node` does not state another unit of length than the document by its attribute `linearUnit`.
    fn check_unit(&self, node: Node<'_, '_>) -> Result<(), FormatError> {
        let Some(stated) = node.attribute("linearUnit") else { return Ok(()) };
        let unit = self.named("PrimaryUnits").next().and_then(|primary| child(primary, "LinearUnit"));
        let name = unit.and_then(|unit| child(unit, "UnitName")).and_then(|name| name.text()).unwrap_or_default();
        if stated.trim() == name.trim() {
            return Ok(());
        }
        Err(unexpected(self.path, node, &format!("the unit of the document, `{}`", name.trim()), stated))
    }

    /// Checks the attribute `key` of `node`, the number of its points, if there is one. `read` points were read.
    fn check_count(&self, node: Node<'_, '_>, key: &str, read: usize) -> Result<(), FormatError> {
        match node.attribute(key) {
            Some(count) if count.trim().parse() != Ok(read) => {
                Err(unexpected(self.path, node, &format!("a count of {read}, the number of points"), count))
            }
            _ => Ok(()),
        }
    }

    fn sets(&self, sets: &[Node<'_, '_>], unit_mm: f64) -> Result<QifPoints, FormatError> {
        self.check_is_one_measurement(sets)?;
        let mut found = QifPoints::default();
        for set in sets {
            self.check_frame(*set)?;
            if let Some(units) = child(*set, "Units") {
                return Err(unexpected(self.path, units, "points in the unit of the document", "units of their own"));
            }
            let points = child(*set, "Points");
            let points =
                points.ok_or_else(|| unexpected(self.path, *set, "Points as text", "no points, or binary points"))?;
            let there = found.points.len();
            self.list(points, unit_mm, &mut found.points)?;
            let read = found.points.len() - there;
            self.check_count(*set, "count", read)?;
            self.what_they_are(*set, unit_mm, &mut found)?;
        }
        Ok(found)
    }

    fn list(&self, node: Node<'_, '_>, unit_mm: f64, points: &mut Vec<Point>) -> Result<(), FormatError> {
        self.check_unit(node)?;
        let there = points.len();
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
        self.check_count(node, "count", points.len() - there)
    }

    fn one_point(&self, node: Node<'_, '_>, unit_mm: f64, points: &mut Vec<Point>) -> Result<(), FormatError> {
        let there = points.len();
        self.list(node, unit_mm, points)?;
        if points.len() != there + 1 {
            return Err(unexpected(self.path, node, "one point", "another number of points"));
        }
        Ok(())
    }

    /// Reads from `set`, a set of measured points or one measured point, whether its points are contacts (points on the surface) or centres
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
                return Err(unexpected(self.path, compensated, "the same value for all points", "another value"));
            }
            found.coordinates = Some(says);
        } else if let Some(each) = child(set, "Compensations").or(child(set, "BinaryCompensated")) {
            return Err(unexpected(self.path, each, "one Compensated for all points of a set", "one for each point"));
        }
        if let Some(radius) = child(set, "ProbeRadius") {
            self.check_unit(radius)?;
            let text = radius.text().unwrap_or_default().trim();
            let radius_mm = text.parse::<f64>().ok().map(|r| r * unit_mm).filter(|r| (1e-3..=1e3).contains(r));
            let radius_mm = radius_mm.ok_or_else(|| unexpected(self.path, radius, "a radius of a probe", text))?;
            if found.probe_radius_mm.is_some_and(|before| (before - radius_mm).abs() > SAME_RADIUS_MM) {
                return Err(unexpected(self.path, radius, "one probe for all points", text));
            }
            found.probe_radius_mm.get_or_insert(radius_mm);
        }
        Ok(())
    }

    /// Reads the locations of all measured point features of the document, in millimetres. The name of each point is that
    /// of its `PointFeatureItem`, or empty if there is none. `unit_mm` is the length of one unit of the document, in
    /// millimetres.
    ///
    /// # Errors
    /// A feature with a location that is not one point of three numbers.
    fn features(&self, unit_mm: f64) -> Result<QifPoints, FormatError> {
        let [all, feature] = self.version.features();
        let is_in_all = |node: &Node<'_, '_>| {
            node.parent().is_some_and(|parent| parent.has_tag_name((self.version.namespace(), all)))
        };
        let locations: Vec<_> =
            self.named(feature).filter(is_in_all).filter_map(|feature| child(feature, "Location")).collect();
        self.check_is_one_measurement(&locations)?;
        let (mut found, mut names, items) = (QifPoints::default(), Vec::new(), self.item_names());
        for location in locations {
            self.one_point(location, unit_mm, &mut found.points)?;
            names.push(location.parent().map(|feature| name_of_feature(feature, &items)).unwrap_or_default());
        }
        Ok(QifPoints { names: Some(names), ..found })
    }

    /// Returns the names of the point features by the id of their items.
    fn item_names(&self) -> HashMap<String, String> {
        let name = |node: Node<'_, '_>| child(node, "FeatureName").and_then(|name| name.text()).map(str::to_owned);
        self.named("PointFeatureItem")
            .filter_map(|item| Some((item.attribute("id")?.to_owned(), name(item)?)))
            .collect()
    }
}

/// Returns the name of a measured feature by the names of the items; empty if it has none.
fn name_of_feature(feature: Node<'_, '_>, items: &HashMap<String, String>) -> String {
    let item = child(feature, "FeatureItemId").and_then(|item| item.text()).unwrap_or_default().trim();
    items.get(item).cloned().unwrap_or_default()
}

/// Returns the first child of this name in the namespace of `node`.
fn child<'a, 'i>(node: Node<'a, 'i>, name: &str) -> Option<Node<'a, 'i>> {
    let namespace = node.tag_name().namespace();
    node.children().find(|node| node.tag_name().name() == name && node.tag_name().namespace() == namespace)
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
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<QIFDocument xmlns=\"http://qifstandards.org/xsd/qif3\" versionQIF=\"3.0.0\" idMax=\"9\">\n\
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

    /// Returns a document of QIF 2.1 after its schema, in millimetres. The points of the nominal plane are not measured.
    fn document_2_1(actuals: &str) -> String {
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
             <QIFDocument xmlns=\"http://qifstandards.org/xsd/qif2\" idMax=\"40\" versionQIF=\"2.1.0\">\n\
             <QPId>175819bb-4961-4ad0-8939-e06475685c4d</QPId>\n\
             <FileUnits><PrimaryUnits><LinearUnit><SIUnitName>meter</SIUnitName><UnitName>mm</UnitName>\
             <UnitConversion><Factor>0.001</Factor></UnitConversion></LinearUnit></PrimaryUnits></FileUnits>\n\
             <Features><FeatureNominals n=\"1\"><PlaneFeatureNominal id=\"2\"><PointList n=\"1\">\
             <MeasurePoint id=\"3\"><Point>91 92 93</Point></MeasurePoint></PointList>\
             <FeatureDefinitionId>1</FeatureDefinitionId><Location>91 92 93</Location><Normal>0 0 1</Normal>\
             </PlaneFeatureNominal></FeatureNominals>\
             <FeatureItems n=\"2\">\
             <PointFeatureItem id=\"4\"><FeatureNominalId>2</FeatureNominalId><FeatureName>P17</FeatureName></PointFeatureItem>\
             <PointFeatureItem id=\"5\"><FeatureNominalId>2</FeatureNominalId><FeatureName>P9</FeatureName></PointFeatureItem>\
             </FeatureItems></Features>\n\
             <MeasurementsResults><MeasurementResultsSet n=\"1\"><MeasurementResults id=\"20\">\n\
             <MeasuredFeatures><FeatureActuals n=\"2\">\n{actuals}\n</FeatureActuals></MeasuredFeatures>\n\
             </MeasurementResults></MeasurementResultsSet></MeasurementsResults>\n</QIFDocument>"
        )
    }

    const LISTS_2_1: &str = "<PlaneFeatureActual id=\"21\"><PointList n=\"2\">\n\
        <MeasurePoint id=\"22\"><Point>1.5 -2.25 3</Point><Compensated>false</Compensated><ProbeRadius>2.49978271104</ProbeRadius></MeasurePoint>\n\
        <MeasurePoint id=\"23\"><Point>4 5 6</Point><Compensated>false</Compensated><ProbeRadius>2.49978271104</ProbeRadius></MeasurePoint>\n\
        </PointList><FeatureItemId>4</FeatureItemId><Location>0 0 0</Location></PlaneFeatureActual>\n\
        <PointFeatureActual id=\"24\"><PointList n=\"1\"><MeasurePoint id=\"25\"><Point>7 8 9</Point>\
        <Compensated>false</Compensated><ProbeRadius>2.499782711044</ProbeRadius></MeasurePoint></PointList>\
        <FeatureItemId>5</FeatureItemId><Location>7 8 9</Location></PointFeatureActual>";

    const FEATURES_2_1: &str = "<PointFeatureActual id=\"21\"><FeatureItemId>4</FeatureItemId><Location>1 2 3</Location></PointFeatureActual>\n\
        <PointFeatureActual id=\"22\"><FeatureItemId>5</FeatureItemId><Location>4 5 6</Location></PointFeatureActual>";

    #[test]
    fn qif_2_1_reads_point_lists() {
        let found = parsed(&document_2_1(LISTS_2_1)).unwrap();
        assert_eq!(found.points, [Point::new(1.5, -2.25, 3.0), Point::new(4.0, 5.0, 6.0), Point::new(7.0, 8.0, 9.0)]);
        assert_eq!(found.coordinates, Some(Coordinates::Centres));
        assert_eq!((found.probe_radius_mm, found.names, found.indices), (Some(2.49978271104), None, None));
        let contacts = parsed(&document_2_1(LISTS_2_1).replace("false", "true")).unwrap();
        assert_eq!(contacts.coordinates, Some(Coordinates::Contacts));
        let inches = parsed(&document_2_1(LISTS_2_1).replace("0.001", "0.0254")).unwrap();
        assert!((inches.points[1] - Point::new(101.6, 127.0, 152.4)).norm() < 1e-12, "{:?}", inches.points[1]);
        let conversion = "<UnitConversion><Factor>0.001</Factor></UnitConversion>";
        let metres = document_2_1(LISTS_2_1).replace(conversion, "").replace("2.49978", "0.00249978");
        let metres = parsed(&metres).unwrap();
        assert_eq!(metres.points[1], Point::new(4e3, 5e3, 6e3));
        // The name of the unit of the document says nothing new.
        let named = document_2_1(LISTS_2_1).replace("<Point>", "<Point linearUnit=\"mm\">");
        assert_eq!(parsed(&named).unwrap().points, found.points);
    }

    #[test]
    fn qif_2_1_features_name_targets() {
        let found = parsed(&document_2_1(FEATURES_2_1)).unwrap();
        assert_eq!(found.points, [Point::new(1.0, 2.0, 3.0), Point::new(4.0, 5.0, 6.0)]);
        assert_eq!((found.indices, found.coordinates), (Some(vec![17, 9]), None));
        // So do lists of one point each.
        let listed = LISTS_2_1.split_once("<PointFeatureActual").unwrap().1;
        let listed = parsed(&document_2_1(&format!("<PointFeatureActual{listed}"))).unwrap();
        assert_eq!((listed.points, listed.indices), (vec![Point::new(7.0, 8.0, 9.0)], Some(vec![9])));
    }

    #[test]
    fn qif_2_1_refuses_what_is_not_one_measurement() {
        let sound = document_2_1(LISTS_2_1);
        let place = |with: &str| match parsed(with).unwrap_err() {
            FormatError::Unexpected { place, .. } => place,
            other => panic!("{other:?}"),
        };
        let between = "</FeatureActuals></MeasuredFeatures></MeasurementResults><MeasurementResults id=\"30\">\
                       <MeasuredFeatures><FeatureActuals n=\"1\"><PointFeatureActual";
        for (of, with, element) in [
            (
                "<Compensated>false</Compensated><ProbeRadius>2.499782711044",
                "<Compensated>true</Compensated>\
             <ProbeRadius>2.499782711044",
                "Compensated",
            ),
            ("2.499782711044", "2.4999", "ProbeRadius"),
            ("<Point>4 5 6", "<Point linearUnit=\"inch\">4 5 6", "Point"),
            ("<Point>4 5 6", "<CoordinateSystemId>7</CoordinateSystemId><Point>4 5 6", "MeasurePoint"),
            ("<Point>4 5 6", "<Point>4 5 6 7 8 9", "Point"),
            ("<PointList n=\"2\">", "<PointList n=\"3\">", "PointList"),
            ("<PointFeatureActual", between, "PointList"),
            ("<SIUnitName>meter", "<SIUnitName>foot", "LinearUnit"),
        ] {
            let changed = sound.replacen(of, with, 1);
            assert_ne!(changed, sound);
            let place = place(&changed);
            assert!(place.ends_with(&format!("element {element}")), "{with}: {place}");
        }
        let no_unit = sound.replace("LinearUnit", "AngularUnit");
        assert!(matches!(parsed(&no_unit), Err(FormatError::Missing { .. })));
        assert!(matches!(parsed(&document_2_1("")), Err(FormatError::NoData { .. })));
    }

    #[test]
    fn other_versions_of_qif_are_refused() {
        let of_3_0 = document(SET);
        for (text, stated) in [
            (document_2_1(LISTS_2_1).replace("2.1.0", "2.0.0"), "2.0.0"),
            (document_2_1(LISTS_2_1).replace("2.1.0", "2.10.0"), "2.10.0"),
            (document_2_1(LISTS_2_1).replace(" versionQIF=\"2.1.0\"", ""), "no versionQIF"),
            (document_2_1(LISTS_2_1).replace("2.1.0", "3.0.0"), "3.0.0"),
            (of_3_0.replace("3.0.0", "4.0.0"), "4.0.0"),
            (of_3_0.replace("xsd/qif3", "xsd/qif4"), "qif4"),
        ] {
            let error = parsed(&text).unwrap_err();
            assert!(
                matches!(&error, FormatError::Version { found, .. } if found.contains(stated)),
                "{stated}: {error}"
            );
        }
        assert!(parsed(&of_3_0.replace(" versionQIF=\"3.0.0\"", "")).is_ok());
        assert!(parsed(&of_3_0.replace("3.0.0", "3.0.1")).is_ok());
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
            (
                "<Points>",
                "<Points count=\"3\">",
                "element Points: expected a count of 2, the number of points, found `3`",
            ),
            (">false<", ">perhaps<", "expected true or false"),
            ("<FileUnits>", "<FileUnits><!-- ", "not readable as XML"),
            ("SIUnitName>meter", "SIUnitName>feet", "expected the meter as SIUnitName, found `feet`"),
            ("0.001", "0", "expected the unit in metres, found `0`"),
            (
                "QIFDocument xmlns=\"http://qifstandards.org/xsd/qif3",
                "QIFDocument xmlns=\"http://qifstandards.org/xsd/qif2",
                "expected QIF 3.0 or QIF 2.1",
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
