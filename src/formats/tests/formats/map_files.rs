//! Maps of interferometers and profilometers as they are found, and what is wrong with them.
//!
//! Real files stand outside of the project, in the folder that REGRIND_DATA names; without it the tests that need them
//! say so and leave themselves out.

use std::fs;
use std::io::{Cursor, Write};
use std::path::Path;

use md5::{Digest, Md5};
use proptest::prelude::*;
use regrind_core::compensation::ErrorMap;
use regrind_core::geometry::Grid;
use regrind_formats::{
    FormatError, HeightMap, MapRecord, X3pFile, parse_metropro, parse_sdf, parse_x3p, read_measured, read_x3p,
    write_error_map_x3p, write_x3p,
};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

fn is_about(found: f64, expected: f64) -> bool {
    (found - expected).abs() <= 1e-12 * expected.abs()
}

// ---- X3P by hand --------------------------------------------------------------------------------------------------------------------

fn sum(bytes: &[u8]) -> String {
    Md5::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

/// A container of entries.
fn container(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
    for (name, bytes) in entries {
        zip.start_file(*name, options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// `main.xml` of a map of 3 by 2 samples in `bindata/data.bin`.
fn main_xml(kind: &str, increment: f64, more: &str) -> String {
    let axis = |name: &str| {
        format!(
            "<{name}><AxisType>I</AxisType><DataType>D</DataType><Increment>1e-3</Increment><Offset>0</Offset></{name}>"
        )
    };
    format!(
        "<p:ISO5436_2 xmlns:p=\"http://www.opengps.eu/2008/ISO5436_2\"><Record1><Revision>ISO5436 \u{2013} \
         2000</Revision><FeatureType>SUR</FeatureType><Axes>{}{}<CZ><AxisType>A</AxisType><DataType>{kind}</DataType>\
         <Increment>{increment}</Increment><Offset>0.5</Offset></CZ></Axes></Record1><Record3><MatrixDimension><SizeX>3\
         </SizeX><SizeY>2</SizeY><SizeZ>1</SizeZ></MatrixDimension><DataLink><PointDataLink>bindata/data.bin\
         </PointDataLink>{more}</DataLink></Record3></p:ISO5436_2>",
        axis("CX"),
        axis("CY")
    )
}

fn parsed(xml: &str, data: &[u8]) -> Result<X3pFile, FormatError> {
    parse_x3p(Path::new("m.x3p"), &container(&[("main.xml", xml.as_bytes()), ("bindata/data.bin", data)]))
}

fn map(parsed: Result<X3pFile, FormatError>) -> HeightMap {
    match parsed.unwrap_or_else(|error| panic!("{error}")) {
        X3pFile::Map(map) => map,
        X3pFile::Points(points) => panic!("{} points", points.len()),
    }
}

#[test]
fn x3p_data_types_and_nan() {
    let heights = [500.0, 501.0, 502.0, 503.0, 504.0, 505.0];
    let steps: [i16; 6] = [0, 1, 2, 3, 4, 5];
    let shorts: Vec<u8> = steps.iter().flat_map(|v| v.to_le_bytes()).collect();
    let longs: Vec<u8> = steps.iter().flat_map(|v| i32::from(*v).to_le_bytes()).collect();
    let singles: Vec<u8> = steps.iter().flat_map(|v| (f32::from(*v) * 0.25).to_le_bytes()).collect();
    for (kind, increment, data) in [("I", 1e-3, &shorts), ("L", 1e-3, &longs)] {
        let map = map(parsed(&main_xml(kind, increment, ""), data));
        assert!(
            map.heights.values_mm.iter().zip(&heights).all(|(a, b)| is_about(*a, *b)),
            "{kind}: {:?}",
            map.heights.values_mm
        );
        assert_eq!(
            (map.heights.grid.spacing_mm, map.heights.grid.first_mm, map.measured_count()),
            ([1.0, 1.0], [0.0, 0.0], 6)
        );
    }
    assert_eq!(map(parsed(&main_xml("F", 1.0, ""), &singles)).heights.values_mm[5], 1750.0);
    let bad = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.25, 0.0, 1.0];
    let doubles: Vec<u8> = bad.iter().flat_map(|v| v.to_le_bytes()).collect();
    let read = map(parsed(&main_xml("D", 1.0, ""), &doubles));
    assert_eq!(read.heights.valid, [false, false, false, true, true, true]);
    assert_eq!(read.heights.values_mm, [0.0, 0.0, 0.0, 750.0, 500.0, 1500.0]);
    // The mask says more: bits from the least significant one.
    let mask = "<ValidPointsLink>./bindata/valid.bin</ValidPointsLink>";
    let xml = main_xml("D", 1.0, mask);
    let entries =
        [("main.xml", xml.as_bytes()), ("bindata/data.bin", &doubles), ("bindata/valid.bin", &[0b0010_1111][..])];
    let read = map(parse_x3p(Path::new("m"), &container(&entries)));
    assert_eq!(read.heights.valid, [false, false, false, true, false, true]);
}

#[test]
fn x3p_subfolder_and_checksums() {
    let data = vec![0u8; 48];
    let sealed = format!("<MD5ChecksumPointData>{}</MD5ChecksumPointData>", sum(&data).to_uppercase());
    let xml = main_xml("D", 1.0, &sealed);
    let seal = format!("{} *main.xml", sum(xml.as_bytes()).to_uppercase());
    let entries: [(&str, &[u8]); 6] = [
        ("__MACOSX/land/._main.xml", b"\x00\x05\x16\x07"),
        ("__MACOSX/main.xml", b"junk"),
        ("land/.DS_Store", b"junk"),
        ("land/main.xml", xml.as_bytes()),
        ("land/md5checksum.hex", seal.as_bytes()),
        ("land/bindata/data.bin", &data),
    ];
    assert_eq!(map(parse_x3p(Path::new("m"), &container(&entries))).measured_count(), 6);
    for (entry, changed, expected) in
        [(5, vec![1u8; 48], "bindata/data.bin"), (3, xml.replace("0.5", "0.6").into_bytes(), "main.xml")]
    {
        let mut other = entries;
        other[entry].1 = &changed;
        let error = parse_x3p(Path::new("m"), &container(&other)).unwrap_err();
        assert!(matches!(&error, FormatError::Checksum { entry, .. } if entry.ends_with(expected)), "{error}");
    }
    let two = container(&[("a/main.xml", xml.as_bytes()), ("b/main.xml", xml.as_bytes())]);
    let error = parse_x3p(Path::new("m"), &two).unwrap_err();
    let is_about_two = |expected: &str, found: &str| expected.contains("main.xml") && found.starts_with('2');
    assert!(
        matches!(&error, FormatError::Unexpected { expected, found, .. } if is_about_two(expected, found)),
        "{error}"
    );
}

#[test]
fn x3p_refuses_unsupported_content() {
    let xml = main_xml("D", 1.0, "");
    let turned = "<Rotation><r11>0</r11><r12>-1</r12></Rotation></Axes>";
    let cases: &[(&str, &str, &[&str])] = &[
        ("SUR", "PRF", &["found `PRF, a profile`"]),
        ("<SizeZ>1", "<SizeZ>2", &["expected one layer"]),
        ("</Axes>", turned, &["not rotated"]),
        ("</Axes>", "<Origin>SE</Origin></Axes>", &["expected SW or NW"]),
        ("<Increment>1<", "<Increment>1e-6<", &["an increment of 1"]),
        ("<DataType>D</DataType><Increment>1<", "<DataType>Q</DataType><Increment>1<", &["expected I, L, F or D"]),
        ("<AxisType>A", "<AxisType>I", &["expected A (absolute)"]),
        ("<Increment>1e-3<", "<Increment>0<", &["an increment above 0"]),
        ("<Increment>1e-3<", "<Increment>-1e-3<", &["an increment above 0"]),
        ("<Offset>0.5<", "<Offset>NaN<", &["a finite number"]),
        ("<SizeX>3", "<SizeX>-3", &["a whole number"]),
        ("<SizeX>3", "<SizeX>0", &["a side of the map is 0"]),
        ("<SizeX>3", "<SizeX>4", &["expected 64 bytes", "`48`"]),
        ("<SizeX>3", "<SizeX>2", &["bytes unpacked", "limit of 32"]),
        ("<SizeX>3", "<SizeX>4000000000000", &["samples of a map"]),
        ("bindata/data.bin", "../data.bin", &["of this container"]),
        ("bindata/data.bin", "bindata/none.bin", &["no bindata/none.bin"]),
        ("<PointDataLink>", "<None>", &["not readable as XML"]),
        ("p:ISO5436_2 ", "!DOCTYPE x [<!ENTITY a \"b\">]><p:ISO5436_2 ", &["not readable as XML"]),
        ("ISO5436_2", "other", &["the root ISO5436_2"]),
    ];
    for (from, to, expected) in cases {
        assert!(xml.contains(from), "{from}");
        let told = parsed(&xml.replace(from, to), &[0; 48]).unwrap_err().to_string();
        assert!(expected.iter().all(|piece| told.contains(piece)), "{to}: {told}");
    }
    assert!(matches!(parsed(&xml, &f64::NAN.to_le_bytes().repeat(6)), Err(FormatError::NoData { .. })));
    let other = parse_x3p(Path::new("m"), &container(&[("other.xml", b"")]));
    assert!(matches!(other, Err(FormatError::WrongKind { .. })), "{other:?}");
    // The amendment of 2020 says what the increment of floating point values means.
    let new =
        xml.replace("ISO5436 \u{2013} 2000", "ISO25178-72:2017/DAM1:2020").replace("<Increment>1<", "<Increment>1e-6<");
    let ones: Vec<u8> = 1e3f64.to_le_bytes().repeat(6);
    assert!(is_about(map(parsed(&new, &ones)).heights.values_mm[0], 501.0));
}

#[test]
fn x3p_refuses_zip_bomb() {
    // 65 MiB of zeros in 66 kB.
    let zeros = vec![0u8; 65 << 20];
    let xml = main_xml("D", 1.0, "");
    let bytes = container(&[("main.xml", xml.as_bytes()), ("bindata/data.bin", &zeros)]);
    assert!(bytes.len() < 1 << 20);
    assert!(matches!(parse_x3p(Path::new("m"), &bytes), Err(FormatError::TooLarge { limit: 48, .. })));
    let bytes = container(&[("main.xml", &zeros)]);
    assert!(matches!(parse_x3p(Path::new("m"), &bytes), Err(FormatError::TooLarge { .. })));
}

// ---- X3P written --------------------------------------------------------------------------------------------------------------------

fn error_map() -> ErrorMap {
    let grid = Grid { columns: 7, rows: 5, first_mm: [-51.0, -31.0], spacing_mm: [17.0, 15.5] };
    let values_mm = (0..35).map(|k| 1e-3 * f64::from(k).sin()).collect();
    ErrorMap::exact(grid, values_mm, (0..35).map(|k| k % 6 != 2).collect())
}

#[test]
fn x3p_write_round_trip() {
    let home = tempfile::tempdir().unwrap();
    let (path, again) = (home.path().join("error_map.x3p"), home.path().join("again.x3p"));
    let written = error_map();
    for to in [&path, &again] {
        write_error_map_x3p(to, &written, "2026-03-01T12:00:00Z", true).unwrap();
    }
    assert_eq!(fs::read(&path).unwrap(), fs::read(&again).unwrap());
    let X3pFile::Map(read) = read_x3p(&path).unwrap() else { panic!("a map") };
    assert_eq!((read.heights.grid.columns, read.heights.grid.rows, &read.heights.valid), (7, 5, &written.nodes.valid));
    assert!((0..2).all(|k| is_about(read.heights.grid.first_mm[k], written.nodes.grid.first_mm[k])));
    assert!((0..2).all(|k| is_about(read.heights.grid.spacing_mm[k], written.nodes.grid.spacing_mm[k])));
    for (k, valid) in read.heights.valid.iter().enumerate() {
        let expected = if *valid { written.nodes.values_mm[k] } else { 0.0 };
        assert!(is_about(read.heights.values_mm[k], expected), "{k}");
    }
    let mut zip = zip::ZipArchive::new(fs::File::open(&path).unwrap()).unwrap();
    let xml = std::io::read_to_string(zip.by_name("main.xml").unwrap()).unwrap();
    assert!(xml.contains("<Comment>SIMULATION") && xml.contains("<Date>2026-03-01T12:00:00Z<"));
    assert_eq!(fs::read_dir(home.path()).unwrap().count(), 2, "no draft is left");
    let mut broken = written.clone();
    broken.nodes.values_mm[0] = f64::NAN;
    assert!(write_error_map_x3p(&home.path().join("no.x3p"), &broken, "", false).is_err());
    assert!(!home.path().join("no.x3p").exists());
}

#[test]
fn x3p_write_escapes_text() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("m.x3p");
    let map = HeightMap::new(
        &path,
        Grid { columns: 2, rows: 2, first_mm: [0.0; 2], spacing_mm: [1.0; 2] },
        [Some(1.0), None, Some(0.5), Some(-1e-9)],
    )
    .unwrap();
    let odd = "a < b & \"c\" ]]> \u{1}\u{ffff} µm".to_owned();
    let record = MapRecord { date: odd.clone(), creator: odd.clone(), instrument: odd.clone(), comment: odd };
    write_x3p(&path, &map, &record).unwrap();
    assert_eq!(read_measured(&path).unwrap().len(), 3);
}

// ---- SDF and MetroPro by hand -------------------------------------------------------------------------------------------------------

const SDF: &str = "aISO-1.0\r\nManufacID = x\r\nCreateDate = 010120260000\r\nNumPoints = 3\r\nNumProfiles = 2\r\nXscale = 1e-3\r\n\
                   Yscale = 2e-3\r\nZscale = 1e-6\r\nZresolution = 1e-9\r\nCompression = 0\r\nDataType = 3\r\nCheckType = 0\r\n*\r\n\
                   1 2.5 BAD\r\n-4 5 6e1\r\n*\r\n<trailer>\r\n";

#[test]
fn sdf_text_read_and_errors() {
    let read = parse_sdf(Path::new("s"), SDF.as_bytes()).unwrap();
    assert_eq!((read.heights.grid.columns, read.heights.grid.rows, read.heights.grid.spacing_mm), (3, 2, [1.0, 2.0]));
    assert_eq!((read.heights.valid[2], read.measured_count()), (false, 5));
    assert!(is_about(read.heights.values_mm[1], 2.5e-3) && is_about(read.heights.values_mm[5], 0.06));
    let cases: &[(&str, &str, &[&str])] = &[
        ("NumPoints = 3", "NumPoints = 4", &["expected 8 heights"]),
        ("NumPoints = 3", "NumPoints = 2", &["found `more`"]),
        ("NumPoints = 3", "NumPoints = 1e15", &["whole number"]),
        ("NumPoints = 3", "NumPoints = 4000000000", &["samples of a map"]),
        ("NumPoints = 3", "Points = 3", &["expected a line", "`NumPoints"]),
        ("Xscale = 1e-3", "Xscale = 0", &["metres per step"]),
        ("Zscale = 1e-6", "Zscale = nan", &["expected a number", "`nan`"]),
        ("Compression = 0", "Compression = 1", &["compressed heights"]),
        ("DataType = 3", "DataType = 9", &["data type from 0 to 7"]),
        ("5 6e1", "5 six", &["line 15", "`BAD`", "`six`"]),
        ("1 2.5 BAD", "1e15 2.5 BAD", &["sample 1 of row 1"]),
        ("*\r\n1 2.5", "1 2.5", &["expected 6 heights"]),
        ("aISO-1.0", "cISO-1.0", &["aISO-1.0 or bISO-1.0"]),
    ];
    for (from, to, expected) in cases {
        assert!(SDF.contains(from), "{from}");
        let told = parse_sdf(Path::new("s"), SDF.replacen(from, to, 1).as_bytes()).unwrap_err().to_string();
        assert!(expected.iter().all(|piece| told.contains(piece)), "{to}: {told}");
    }
}

/// One surface in each version; in BCR the first profile is at the largest y, and the largest number is a mark.
#[test]
fn sdf_versions_give_same_surface() {
    let head =
        "NumPoints = 3\nNumProfiles = 2\nXscale = 1e-3\nYscale = 1e-3\nZscale = 1e-6\nCompression = 0\nCheckType = 0\n";
    let read = |text: String| parse_sdf(Path::new("m.sdf"), text.as_bytes()).unwrap();
    let iso = read(format!("aISO-1.0\n{head}DataType = 5\n*\n1 2 BAD\n4 5 6\n*\n"));
    let iso_2 = read(format!("aISO-2.0\n{head}DataType = 5\n*\n1 2 BAD\n4 5 6\n*\n"));
    let bcr = read(format!("ABCR-1.0 ; old\n; {head}{head}DataType = INTEGER\n*\n4 5 6 ; top\n1 2 32767\n*\n"));
    assert_eq!(iso.heights, iso_2.heights);
    assert_eq!(iso.heights, bcr.heights);
    assert_eq!((iso.notes.len(), bcr.notes.len()), (0, 1));
    assert!(parse_sdf(Path::new("m.sdf"), b"aISO-3.0\nNumPoints = 6\n").is_err());
}

/// A binary SDF of 3 by 2 samples.
fn binary_sdf(kind: u8, heights: &[u8], extra: &[u8]) -> Vec<u8> {
    let mut bytes = b"bISO-1.0 a maker  010120260000010120260000".to_vec();
    assert_eq!(bytes.len(), 42);
    [3u16, 2].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    [1e-3, 2e-3, 1e-6, 1e-9].iter().for_each(|v: &f64| bytes.extend(v.to_le_bytes()));
    bytes.extend([0, kind, 0]);
    [&bytes, extra, heights].concat()
}

#[test]
fn sdf_binary_data_types() {
    fn bytes<T, const N: usize>(values: [T; 6], le: impl Fn(T) -> [u8; N]) -> Vec<u8> {
        values.into_iter().flat_map(le).collect()
    }
    let cases: [(u8, Vec<u8>, usize); 8] = [
        (0, vec![0, 1, 2, 3, 4, 255], 6),
        (1, bytes([0, 1, 2, 3, 4, u16::MAX], u16::to_le_bytes), 5),
        (2, bytes([0, 1, 2, 3, 4, u32::MAX], u32::to_le_bytes), 5),
        (3, bytes([0.0, 1.0, 2.0, 3.0, 4.0, f32::NAN], f32::to_le_bytes), 5),
        (4, vec![0, 1, 2, 3, 4, 0x80], 6),
        (5, bytes([0, 1, 2, 3, 4, i16::MIN], i16::to_le_bytes), 5),
        (6, bytes([0, 1, 2, 3, 4, i32::MIN], i32::to_le_bytes), 5),
        (7, bytes([0.0, 1.0, 2.0, 3.0, 4.0, f64::INFINITY], f64::to_le_bytes), 5),
    ];
    for (kind, heights, measured) in cases {
        for extra in [&[][..], &[5, 0, 0, 0, 1, 0, 0, 0]] {
            let read = parse_sdf(Path::new("s"), &binary_sdf(kind, &heights, extra)).unwrap();
            assert_eq!((read.measured_count(), read.heights.grid.spacing_mm), (measured, [1.0, 2.0]), "type {kind}");
            assert!(
                (0..5).all(|k| is_about(read.heights.values_mm[k], 1e-3 * k as f64)),
                "type {kind}: {:?}",
                read.heights.values_mm
            );
        }
        let cut = parse_sdf(Path::new("s"), &binary_sdf(kind, &heights[..heights.len() - 1], &[]));
        assert!(cut.as_ref().is_err_and(FormatError::is_cut), "type {kind}: {cut:?}");
    }
}

/// A MetroPro file of 2 by 2 phases without intensities.
fn metropro() -> Vec<u8> {
    let mut bytes = vec![0u8; 834];
    let mut put = |at: usize, with: &[u8]| bytes[at..at + with.len()].copy_from_slice(with);
    put(0, &0x881b_036fu32.to_be_bytes());
    put(4, &[0, 1, 0, 0, 3, 66]);
    put(68, &[0, 2, 0, 2, 0, 0, 0, 16]);
    for (at, value) in [(164, 0.5f32), (168, 6.25e-7), (176, 1.0), (184, 1e-3)] {
        put(at, &value.to_be_bytes());
    }
    put(218, &[0, 1]);
    [1i32, 2_147_483_640, -32_768, 65_536].iter().for_each(|v| bytes.extend(v.to_be_bytes()));
    bytes
}

#[test]
fn metropro_read_and_errors() {
    let good = metropro();
    let read = parse_metropro(Path::new("z"), &good).unwrap();
    assert_eq!((read.heights.valid.clone(), read.heights.grid.first_mm), (vec![true, true, true, false], [0.0; 2]));
    // Half a wave of 625 nm is 32768 steps; the lower row comes last in the file.
    let wave_mm = f64::from(6.25e-7f32) * 1e3;
    for (found, waves) in read.heights.values_mm.iter().zip([-0.5, 1.0, 0.5 / 32768.0, 0.0]) {
        assert!(is_about(*found, waves * wave_mm), "{found}");
    }
    for (at, with, expected) in [
        (0, &[0x12u8][..], "magic number"),
        (5, &[2], "magic number"),
        (68, &[0, 3], "24 bytes of phases"),
        (68, &[0, 0], "a side of the map is 0"),
        (72, &[0, 0, 0, 0], "no phases"),
        (63, &[200], "the file ends too early"),
        (60, &[0xff; 4], "the file ends too early"),
        (164, &[0; 4], "interferometric scale"),
        (168, &[0x7f, 0xc0, 0, 0], "wavelength in metres"),
        (219, &[7], "phase resolution"),
        (184, &[0; 4], "no lateral scale"),
    ] {
        let mut bad = good.clone();
        bad[at..at + with.len()].copy_from_slice(with);
        let told = parse_metropro(Path::new("z"), &bad).unwrap_err().to_string();
        assert!(told.contains(expected), "{at}: {told}");
    }
    for length in [0, 3, 833, 834, 849] {
        assert!(parse_metropro(Path::new("z"), &good[..length]).is_err_and(|e| e.is_cut()), "{length}");
    }
}

proptest! {
    /// Whatever a few bytes are changed to, the answer is a map or an error.
    #[test]
    fn damaged_map_files_never_panic(changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6), cut in any::<prop::sample::Index>()) {
        let xml = main_xml("D", 1.0, "");
        let x3p = container(&[("main.xml", xml.as_bytes()), ("bindata/data.bin", &[0; 48])]);
        let sdf = binary_sdf(7, &[0; 48], &[]);
        for good in [x3p, xml.into_bytes(), SDF.as_bytes().to_vec(), sdf, metropro()] {
            let mut bad = good.clone();
            for (at, with) in &changes {
                bad[at.index(good.len())] = *with;
            }
            for bytes in [&bad[..], &bad[..cut.index(bad.len())]] {
                let _ = parse_x3p(Path::new("p"), bytes);
                let _ = parse_x3p(Path::new("p"), &container(&[("main.xml", bytes), ("bindata/data.bin", &[0; 48])]));
                let _ = parse_sdf(Path::new("p"), bytes);
                let _ = parse_metropro(Path::new("p"), bytes);
            }
        }
    }
}
