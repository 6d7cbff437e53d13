//! Documents of measuring machines as measured points: QIF and DMIS output.

use std::fs;
use std::path::{Path, PathBuf};

use regrind_core::geometry::Point;
use regrind_formats::result::Coordinates;
use regrind_formats::*;
use tempfile::TempDir;

/// A document of QIF 2.1 with two centres of a probe with the radius 0.1 inch.
const QIF_2_1: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>
<QIFDocument xmlns=\"http://qifstandards.org/xsd/qif2\" idMax=\"9\" versionQIF=\"2.1.0\">
<FileUnits><PrimaryUnits><LinearUnit><SIUnitName>meter</SIUnitName><UnitName>inch</UnitName>
<UnitConversion><Factor>0.0254</Factor></UnitConversion></LinearUnit></PrimaryUnits></FileUnits>
<MeasurementsResults><MeasurementResultsSet n=\"1\"><MeasurementResults id=\"1\"><MeasuredFeatures><FeatureActuals n=\"1\">
<PlaneFeatureActual id=\"2\"><PointList n=\"2\">
<MeasurePoint id=\"3\"><Point>4 5 6</Point><Compensated>false</Compensated><ProbeRadius>0.1</ProbeRadius></MeasurePoint>
<MeasurePoint id=\"4\"><Point>1 2 3</Point><Compensated>false</Compensated><ProbeRadius>0.1</ProbeRadius></MeasurePoint>
</PointList><Location>0 0 0</Location></PlaneFeatureActual>
</FeatureActuals></MeasuredFeatures></MeasurementResults></MeasurementResultsSet></MeasurementsResults>
</QIFDocument>
";

fn file(name: &str, text: &str) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, text).unwrap();
    (folder, path)
}

/// Meaning of the points of a file, and the probe radius in mm, as a note says.
type Said = Option<(Coordinates, Option<f64>)>;

/// Returns the points of a file, and what a note says of them.
fn measured(path: &Path) -> Result<(Vec<Point>, Said), FormatError> {
    let read = read_measured_with_notes(path, &Table::default())?;
    let said = match &read.notes[..] {
        [] => None,
        [PointNote::Coordinates { coordinates, probe_radius_mm, .. }] => Some((*coordinates, *probe_radius_mm)),
        notes => panic!("{notes:?}"),
    };
    Ok((read.points, said))
}

fn assert_near(found: &[Point], expected: &[[f64; 3]]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert!((found - Point::from(*expected)).norm() < 1e-12, "{found} {expected:?}");
    }
}

#[test]
fn qif_is_measured() {
    // The content decides, not the extension.
    for name in ["part.qif", "part.xml", "part.txt"] {
        let (_folder, path) = file(name, QIF_2_1);
        let (points, said) = measured(&path).unwrap();
        assert_near(&points, &[[101.6, 127.0, 152.4], [25.4, 50.8, 76.2]]);
        let (coordinates, radius_mm) = said.unwrap();
        assert_eq!(coordinates, Coordinates::Centres);
        assert!((radius_mm.unwrap() - 2.54).abs() < 1e-12);
    }
    let set = "<Results><MeasuredPointSets n=\"1\"><MeasuredPointSet count=\"1\" id=\"5\"><Points>1 2 3</Points>\
               <Compensated>true</Compensated></MeasuredPointSet></MeasuredPointSets></Results></QIFDocument>";
    let newer = QIF_2_1.replace("xsd/qif2", "xsd/qif3").replace("2.1.0", "3.0.0");
    let newer = format!("{}{set}", newer.split_once("<MeasurementsResults>").unwrap().0);
    let (_folder, path) = file("part.qif", &newer);
    let (points, said) = measured(&path).unwrap();
    assert_near(&points, &[[25.4, 50.8, 76.2]]);
    assert_eq!(said, Some((Coordinates::Contacts, None)));
}

#[test]
fn qif_is_no_nominal_and_no_table() {
    let (_folder, path) = file("part.qif", QIF_2_1);
    assert!(matches!(read_nominal(&path), Err(FormatError::WrongKind { .. })));
    let inch = Table { unit: Some(Unit::Inch), ..Table::default() };
    assert!(matches!(read_measured_with_notes(&path, &inch), Err(FormatError::WrongKind { .. })));
    let (_folder, path) = file("part.qif", &QIF_2_1.replace("2.1.0", "2.0.0"));
    assert!(matches!(read_measured(&path), Err(FormatError::Version { .. })));
    let (_folder, path) = file("part.xml", "<?xml version=\"1.0\"?>\n<points>1 2 3</points>\n");
    assert!(matches!(read_measured(&path), Err(FormatError::WrongKind { found: "an XML file", .. })));
}

const DMIS: &str = "FILNAM/'SN-7'\nUNITS/MM, ANGDEC\nPRCOMP/OFF\nF(P9)=FEAT/POINT,CART,91,92,93,0,0,1\nOUTPUT/FA(P9)\n\
                    FA(P9)=FEAT/POINT,CART,4,5,6.5,0,0,1\nFA(P7) = FEAT/POINT,CART, $\n  1.5,-2.25,3,0,0,1\nENDFIL\n";

#[test]
fn dmis_output_is_measured() {
    for name in ["part.res", "part.dmo", "part.txt", "part.csv"] {
        let (_folder, path) = file(name, DMIS);
        let (points, said) = measured(&path).unwrap();
        assert_eq!(points, [Point::new(4.0, 5.0, 6.5), Point::new(1.5, -2.25, 3.0)]);
        assert_eq!(said, Some((Coordinates::Centres, None)));
    }
    let (_folder, path) = file("part.res", &DMIS.replace("PRCOMP/OFF", "PRCOMP/ON").replace("UNITS/MM", "UNITS/INCH"));
    let (points, said) = measured(&path).unwrap();
    assert_near(&points, &[[101.6, 127.0, 165.1], [38.1, -57.15, 76.2]]);
    assert_eq!(said, Some((Coordinates::Contacts, None)));
    let (_folder, path) = file("part.res", &DMIS.replace("PRCOMP/OFF\n", ""));
    assert_eq!(measured(&path).unwrap().1, None);
}

#[test]
fn dmis_without_actual_points_is_refused() {
    let (nominal, _) = DMIS.split_once("FA(P9)=").unwrap();
    let (_folder, path) = file("part.res", &format!("{nominal}ENDFIL\n"));
    assert!(matches!(read_measured(&path), Err(FormatError::WrongKind { .. })));
    let program =
        DMIS.replace("FILNAM/'SN-7'", "DMISMN/'SN-7', 05.2").replace("FA(P9)=", "F(A)=").replace("FA(P7) =", "F(B)=");
    let (_folder, path) = file("part.dmi", &program);
    assert!(matches!(read_measured(&path), Err(FormatError::WrongKind { .. })));
    assert!(matches!(read_nominal(&path), Err(FormatError::WrongKind { .. })));
    let (_folder, path) = file("part.res", &DMIS.replace("ENDFIL\n", ""));
    assert!(matches!(read_measured(&path), Err(FormatError::Cut { .. })));
    let (_folder, path) = file("part.res", &DMIS.replace("UNITS/MM, ANGDEC\n", ""));
    assert!(matches!(read_measured(&path), Err(FormatError::Unexpected { .. })));
}

/// A table with a unit of DMIS above it stays a table.
#[test]
fn table_under_line_of_dmis_is_a_table() {
    let (_folder, path) = file("part.txt", "UNITS/MM\nx,y,z\n1,2,3\n");
    assert_eq!(measured(&path).unwrap(), (vec![Point::new(1.0, 2.0, 3.0)], None));
    let (_folder, path) = file("part.txt", "UNITS/INCH\nx,y,z\n1,2,3\n");
    assert!(matches!(read_measured(&path), Err(FormatError::Unit { .. })));
}
