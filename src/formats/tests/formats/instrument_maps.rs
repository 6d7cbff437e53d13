//! Maps that other programs wrote, of one surface: z = (10 i + 4 j) nm with two samples that were not measured.

use std::path::{Path, PathBuf};

use regrind_core::geometry::Point;
use regrind_formats::result::{Content, parse_result};
use regrind_formats::{FormatError, NotedPoints, Table, parse_map, read_measured_with_notes};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/maps")
}

fn read(path: &Path) -> Result<NotedPoints, FormatError> {
    read_measured_with_notes(path, &Table::default())
}

/// Files that are refused, and for what.
const REFUSED: [(&str, &str); 6] = [
    ("datx-nounits-not-a-height.datx", "unexpected"),
    ("datx-lateral-0-not-calibrated.datx", "scale"),
    ("datx-unit-conflict.datx", "unexpected"),
    // 4D writes no distance of the samples on the part.
    ("4d-4sight.h5", "scale"),
    ("4d-4sight-latest-gzip.h5", "scale"),
    ("4d-4sightfocus.4D", "scale"),
];

/// Returns the largest difference from the surface in mm; a constant is taken off if `is_shifted`.
fn difference(points: &[Point], pitch_y_mm: f64, is_shifted: bool) -> f64 {
    let expected = |p: &Point| 1e-6 * (10.0 * (p.x / 0.5).round() + 4.0 * (p.y / pitch_y_mm).round());
    let offs: Vec<f64> = points.iter().map(|p| p.z - expected(p)).collect();
    let mean = if is_shifted { offs.iter().sum::<f64>() / offs.len() as f64 } else { 0.0 };
    offs.iter().map(|off| (off - mean).abs()).fold(0.0, f64::max)
}

#[test]
fn maps_of_other_writers_match_surface() {
    let mut wrong = Vec::new();
    let mut count = 0;
    for entry in std::fs::read_dir(folder()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if name == "README.md" || name.contains("no-wavelength") || REFUSED.iter().any(|(file, _)| *file == name) {
            continue;
        }
        count += 1;
        let read = match read(&path) {
            Ok(read) => read,
            Err(error) => {
                wrong.push(error.to_string());
                continue;
            }
        };
        let pitch_y_mm = if name.starts_with("zygo") { 0.5 } else { 0.25 };
        let points = read.points;
        let is_on_grid = |p: &Point| {
            let off = |c: f64, pitch: f64| (c / pitch - (c / pitch).round()).abs();
            off(p.x, 0.5) < 1e-6 && off(p.y, pitch_y_mm) < 1e-6
        };
        let missing = [[1.0, pitch_y_mm], [2.5, 3.0 * pitch_y_mm]];
        let has_missing = points.iter().any(|p| missing.iter().any(|m| (p.x - m[0]).hypot(p.y - m[1]) < 1e-6));
        // Heights of eight and sixteen bits, and of 32 bits as real numbers, are rounded by their writers.
        let resolution_mm = match name.as_str() {
            "opd-int16.opd" => 8e-8,
            name if name.contains("int8") => 3e-7,
            name if name.contains("int16") => 2e-9,
            _ => 1e-11,
        };
        let off = difference(&points, pitch_y_mm, name.starts_with("rsciio"));
        if points.len() != 33 || has_missing || !points.iter().all(is_on_grid) || off > resolution_mm {
            wrong.push(format!("{name}: {} points, missing ones {has_missing}, off by {off:e} mm", points.len()));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(count > 50, "{count}");
}

#[test]
fn maps_without_scale_or_unit_are_refused() {
    for (name, why) in REFUSED {
        let refused = read(&folder().join(name)).unwrap_err();
        let is_expected = match why {
            "scale" => matches!(refused, FormatError::NoLateralScale { .. }),
            _ => matches!(refused, FormatError::Unexpected { .. }),
        };
        assert!(is_expected, "{name}: {refused}");
    }
    let refused = read(&folder().join("4d-4sight-no-wavelength.h5")).unwrap_err();
    assert!(matches!(refused, FormatError::Unexpected { .. }), "{refused}");
}

#[test]
fn maps_without_scale_take_given_spacing() {
    let table = Table { sample_spacing_mm: Some(0.5), ..Table::default() };
    let of_scale: Vec<&str> = REFUSED.iter().filter(|(_, why)| *why == "scale").map(|(name, _)| *name).collect();
    assert_eq!(of_scale.len(), 4);
    for name in of_scale {
        let read = read_measured_with_notes(folder().join(name), &table).unwrap();
        assert_eq!(read.points.len(), 33, "{name}");
        let off = difference(&read.points, 0.5, false);
        assert!(off < 1e-11, "{name}: {off:e} mm");
        assert_eq!(read.notes.len(), usize::from(name.starts_with("4d")), "{name}");
        let content = Content { sample_spacing_mm: Some(0.5), ..Content::default() };
        let bytes = std::fs::read(folder().join(name)).unwrap();
        assert_eq!(parse_result(Path::new(name), &bytes, &content).unwrap().points, read.points, "{name}");
    }
}

#[test]
fn given_spacing_is_refused_where_it_has_no_use() {
    let table = Table { sample_spacing_mm: Some(0.5), ..Table::default() };
    let content = Content { sample_spacing_mm: Some(0.5), ..Content::default() };
    for entry in std::fs::read_dir(folder()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if read(&path).is_err() || name == "README.md" {
            continue;
        }
        let bytes = std::fs::read(&path).unwrap();
        for refused in
            [read_measured_with_notes(&path, &table).unwrap_err(), parse_result(&path, &bytes, &content).unwrap_err()]
        {
            assert!(matches!(refused, FormatError::LateralScaleStated { given: 0.5, .. }), "{name}: {refused}");
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let text = folder.path().join("points.csv");
    std::fs::write(&text, "x_mm,y_mm,z_mm\n1,2,3\n").unwrap();
    for refused in [
        read_measured_with_notes(&text, &table).unwrap_err(),
        parse_result(&text, &std::fs::read(&text).unwrap(), &content).unwrap_err(),
    ] {
        assert!(matches!(refused, FormatError::NotAMap { .. }), "{refused}");
    }
}

/// Returns the bytes of a fixture, in which the only occurrence of `from` is replaced by `to`.
fn changed(name: &str, from: &[u8], to: &[u8]) -> Vec<u8> {
    let bytes = std::fs::read(folder().join(name)).unwrap();
    let places: Vec<usize> = (0..bytes.len()).filter(|at| bytes[*at..].starts_with(from)).collect();
    assert_eq!(places.len(), 1, "{name}: {from:x?}");
    [&bytes[..places[0]], to, &bytes[places[0] + from.len()..]].concat()
}

/// Returns the bytes with each `from` replaced by a `to` of the same length.
fn replaced(bytes: &[u8], from: &[u8], to: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for at in 0..bytes.len() {
        if bytes[at..].starts_with(from) {
            bytes[at..at + to.len()].copy_from_slice(to);
        }
    }
    bytes
}

#[test]
fn units_and_wavelengths_of_maps_are_checked() {
    let parse = |name: &str, bytes: &[u8]| parse_map(Path::new(name), bytes, None);
    let name = "datx-latest-contiguous-nm.datx";
    let plain = std::fs::read(folder().join(name)).unwrap();
    assert!(parse(name, &plain).is_ok());
    let inches = replaced(&plain, b"Pixels", b"Inches");
    assert!(inches != plain && matches!(parse(name, &inches), Err(FormatError::Unexpected { .. })));
    let table = Table { sample_spacing_mm: Some(0.5), ..Table::default() };
    let scratch = tempfile::tempdir().unwrap();
    for (name, wavelength) in [("4d-4sight.h5", b"632.8"), ("4d-4sight.h5", b"6.328")] {
        let bytes = std::fs::read(folder().join(name)).unwrap();
        let changed = replaced(&bytes, b"632.8", wavelength);
        let path = scratch.path().join(name);
        std::fs::write(&path, &changed).unwrap();
        assert_eq!(read_measured_with_notes(&path, &table).is_ok(), changed == bytes);
    }
}

/// 1e38 in 32 bits is 9.9999997e37, and marks a sample as well as the next larger number does.
#[test]
fn mark_in_32_bits_is_no_height() {
    let name = "opd-float32.opd";
    let plain = std::fs::read(folder().join(name)).unwrap();
    let marked = replaced(&plain, &1.000_000_1e38f32.to_le_bytes(), &1e38f32.to_le_bytes());
    assert_ne!(marked, plain);
    let parse = |bytes: &[u8]| parse_map(Path::new(name), bytes, None).unwrap();
    assert_eq!(parse(&marked), parse(&plain));
}

#[test]
fn unknown_flags_and_contradicting_fields_are_refused() {
    let text = |name: &str| std::fs::read_to_string(folder().join(name)).unwrap();
    let wyko = text("wyko-waves.asc");
    for (from, to, is_read) in [("Format 0\t0\t1", "Format 0\t0\t1", true), ("Format 0\t0\t1", "Format 0\t2\t1", false)]
    {
        let parsed = parse_map(Path::new("a.asc"), wyko.replace(from, to).as_bytes(), None);
        assert_eq!(parsed.is_ok(), is_read, "{to}");
    }
    let sdf = text("surfalize-iso1-text.sdf");
    for (again, is_read) in [("Zscale = 1e-08", true), ("Zscale = 1e-07", false)] {
        let twice = sdf.replace("Zscale = 1e-08", &format!("Zscale = 1e-08\n{again}"));
        assert_ne!(twice, sdf);
        assert_eq!(parse_map(Path::new("a.sdf"), twice.as_bytes(), None).is_ok(), is_read, "{again}");
    }
}

/// A grid of Code V by hand: a wave of 0.5 µm has 1000 counts, and one sample was not measured.
#[test]
fn grid_of_codev_by_hand() {
    let text = "! a remark\nA mirror\nGRD 3 3 SUR WVL 0.5 SSZ 1000 NDA -9\n10 20 30\n-40 -9 0\n1 2\n! another\n3\n";
    let parse = |text: &str, given_mm| parse_map(Path::new("a.int"), text.as_bytes(), given_mm);
    let points = parse(text, Some(0.25)).unwrap();
    let at =
        |x: f64, y: f64| points.iter().find(|p| (p.x - x).hypot(p.y - y) < 1e-12).map(|p| (p.z * 1e9).round() / 1e3);
    // 10 counts are 5 nm; the first row is the top one.
    assert_eq!([at(0.0, 0.5), at(0.5, 0.5), at(0.0, 0.25), at(0.5, 0.0)], [5.0, 15.0, -20.0, 1.5].map(Some));
    assert_eq!((points.len(), at(0.25, 0.25)), (8, None));
    assert!(matches!(parse(text, None), Err(FormatError::NoLateralScale { .. })));
    // Without NDA the mark is 32767; a title can be missing.
    let silent = text.replace(" NDA -9", "").replace("-9", "32767").replace("A mirror\n", "");
    assert_eq!(parse(&silent, Some(0.25)).unwrap(), points);
    for (from, to) in [
        ("GRD 3 3", "GRD 3 2"),
        ("SUR", "WFR"),
        ("SUR", "FIL"),
        ("SUR", ""),
        ("WVL 0.5", "WVL 500"),
        ("WVL 0.5 ", ""),
        ("SSZ 1000", "SSZ 0"),
        ("SSZ", "XSC"),
        ("30\n", "30.5\n"),
        ("\n3\n", "\n"),
        ("\n3\n", "\n3 4\n"),
    ] {
        assert!(parse(&text.replace(from, to), Some(0.25)).is_err(), "{from} {to}");
    }
}

/// Returns the place in the file that the error names.
#[track_caller]
fn refused_place(name: &str, bytes: &[u8]) -> String {
    match parse_map(Path::new(name), bytes, None) {
        Err(FormatError::Unexpected { place, .. }) => place,
        other => panic!("{name}: {other:?}"),
    }
}

/// Factors of heights and distances that are zero, negative, infinite or NaN.
#[test]
fn maps_with_impossible_factors_are_refused() {
    const WRONG: [f64; 4] = [0.0, -0.5, f64::INFINITY, f64::NAN];
    for wrong in WRONG {
        let single = (wrong as f32).to_le_bytes();
        for (at, place) in [(120, "step of x (byte 120)"), (124, "step of y (byte 124)"), (128, "step of z (byte 128)")]
        {
            let mut bytes = std::fs::read(folder().join("surfalize-uncompressed.sur")).unwrap();
            bytes[at..at + 4].copy_from_slice(&single);
            assert_eq!(refused_place("a.sur", &bytes), place, "{wrong}");
        }
        let bytes = changed(
            "opdx-2d-matrix.opdx",
            b"\0\0\0\0\0\0\xf0\x3f\x09\0\0\0",
            &[&wrong.to_le_bytes()[..], b"\x09\0\0\0"].concat(),
        );
        assert_eq!(refused_place("a.opdx", &bytes), "/2D_Data/Raw/DataScale", "{wrong}");
        for (at, place) in [(0xda, "Wavelength"), (0xe0, "Aspect"), (0xe4, "Pixel_size")] {
            let mut bytes = std::fs::read(folder().join("opd-float32.opd")).unwrap();
            bytes[at..at + 4].copy_from_slice(&single);
            assert_eq!(refused_place("a.opd", &bytes), place, "{wrong}");
        }
        for (line, place) in [
            ("Wavelength\t7\t4\t632.800", "Wavelength"),
            ("Aspect\t7\t4\t0.5", "Aspect"),
            ("Pixel_size\t7\t4\t0.5", "Pixel_size"),
        ] {
            let bytes = changed("wyko-waves.asc", line.as_bytes(), format!("{place}\t7\t4\t{wrong}").as_bytes());
            assert_eq!(refused_place("a.asc", &bytes), place, "{wrong}");
        }
    }
    let name = "datx-earliest-contiguous-fringes.datx";
    for wrong in WRONG {
        let bytes =
            replaced(&std::fs::read(folder().join(name)).unwrap(), &6.328e-7f64.to_le_bytes(), &wrong.to_le_bytes());
        let place = refused_place(name, &bytes);
        assert!(place.starts_with("/Data/Surface/") && place.ends_with(", Wavelength"), "{wrong}: {place}");
    }
    for wrong in [0i16, -2] {
        let mut bytes = std::fs::read(folder().join("opd-float32.opd")).unwrap();
        bytes[0xde..0xe0].copy_from_slice(&wrong.to_le_bytes());
        assert_eq!(refused_place("a.opd", &bytes), "Mult", "{wrong}");
    }
}

#[test]
fn missing_obliquity_is_noted() {
    let name = "datx-earliest-contiguous-fringes.datx";
    let bytes = std::fs::read(folder().join(name)).unwrap();
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join(name);
    std::fs::write(&path, replaced(&bytes, b"Obliquity Factor", b"Obliquity Farbe ")).unwrap();
    let (noted, stated) = (read(&path).unwrap(), read(&folder().join(name)).unwrap());
    assert_eq!((noted.notes.len(), stated.notes.len()), (1, 0));
}

/// The value of a block is in the fourth cell: the length before it, and remarks after it, are no values.
#[test]
fn value_of_wyko_ascii_is_in_its_cell() {
    let (name, block) = ("wyko-waves.asc", "Pixel_size\t7\t4\t0.5");
    for line in ["Pixel_size\t7\t4\t", "Pixel_size\t7\t4", "Pixel_size\t7\t4\t\t0.5", "Pixel_size\t0.5"] {
        let bytes = changed(name, block.as_bytes(), line.as_bytes());
        assert_eq!(refused_place(name, &bytes), "line 7", "{line:?}");
    }
    let remark = changed(name, block.as_bytes(), b"Pixel_size\t7\t4\t0.5\t7");
    let plain = std::fs::read(folder().join(name)).unwrap();
    assert_eq!(parse_map(Path::new(name), &remark, None).unwrap(), parse_map(Path::new(name), &plain, None).unwrap());
    for size in ["-5", "5.5", "NaN", ""] {
        let bytes = changed(name, b"Y Size\t5", format!("Y Size\t{size}").as_bytes());
        assert_eq!(refused_place(name, &bytes), "line 3", "{size:?}");
    }
}

/// A file of Alicona without an image of depths has the offset 0. A damaged number of tags can be any.
#[test]
fn alicona_without_depths_is_refused() {
    let name = "surfalize.al3d";
    let tag = |key: &str, value: &str| {
        let mut tag = vec![0; 50];
        tag[..key.len()].copy_from_slice(key.as_bytes());
        tag[20..20 + value.len()].copy_from_slice(value.as_bytes());
        tag
    };
    let cases = [
        ("DepthImageOffset", "845", "0"),
        ("DepthImageOffset", "845", "-845"),
        ("DepthImageOffset", "845", "588"),
        ("TagCount", "9", "18446744073709551615"),
        ("TagCount", "9", "1001"),
        ("TagCount", "9", "nine"),
        ("Cols", "7", "6.5"),
        ("Rows", "5", "-5"),
    ];
    for (key, stated, wrong) in cases {
        let bytes = changed(name, &tag(key, stated), &tag(key, wrong));
        assert_eq!(refused_place(name, &bytes), format!("tag {key}"), "{wrong}");
    }
}

/// Columns and rows of a matrix must make up its bytes, and be those that stand beside it.
#[test]
fn matrix_of_other_size_is_refused() {
    let name = "opdx-2d-matrix.opdx";
    let sizes = |rows: u32, columns: u32| [b"\x94", &rows.to_le_bytes()[..], &columns.to_le_bytes()].concat();
    for (rows, columns) in [(5, 6), (4, 7), (1, 7)] {
        let bytes = changed(name, &sizes(5, 7), &sizes(rows, columns));
        assert_eq!(refused_place(name, &bytes), "/2D_Data/Raw/Matrix", "{rows} x {columns}");
    }
    let turned = changed(name, &sizes(5, 7), &sizes(7, 5));
    assert_eq!(refused_place(name, &turned), "/2D_Data/Raw/Dimension1Points");
    let points = changed(name, b"Dimension2Points\x07\x07", b"Dimension2Points\x07\x09");
    assert_eq!(refused_place(name, &points), "/2D_Data/Raw/Dimension2Points");
}

/// The path of an item repeats the names around it: long names and many items would need much more memory than the file.
#[test]
fn long_names_and_many_items_are_refused() {
    let named = |name: &str| [&(name.len() as u32).to_le_bytes()[..], name.as_bytes()].concat();
    let container = |name: &str, content: &[u8]| {
        [&named(name), &b"\x7d\x04"[..], &(content.len() as u32).to_le_bytes(), content].concat()
    };
    let file = |content: &[u8]| [b"VCA DATA\x01\x00\x00\x55", &container("2D_Data", content)[..]].concat();
    let item = [&named("DataKind")[..], b"\x12\x01\x00"].concat();
    let many = file(&container("Raw", &item.repeat(20_000)));
    assert_eq!(refused_place("a.opdx", &many), "/2D_Data/Raw/DataKind");
    let long = file(&container(&"x".repeat(257), &item));
    assert_eq!(refused_place("a.opdx", &long), format!("byte {}", b"VCA DATA1234".len() + named("2D_Data").len() + 6));
}

/// The lengths of all blocks add up to the file. A wrong one shifts the blocks behind it.
#[test]
fn blocks_of_wyko_make_up_file() {
    let name = "opd-float32.opd";
    let plain = std::fs::read(folder().join(name)).unwrap();
    assert_eq!(refused_place(name, &[&plain[..], b"\0\0\0\0"].concat()), "directory");
    let cut = parse_map(Path::new(name), &plain[..plain.len() - 1], None);
    assert!(matches!(cut, Err(FormatError::Cut { .. })), "{cut:?}");
    let title = |name: &str, kind: u8, length: u8| {
        let mut entry = name.as_bytes().to_vec();
        entry.resize(16, 0);
        [&entry[..], &[kind, 0, length, 0, 0, 0]].concat()
    };
    let longer = changed(name, &title("Title", 5, 9), &title("Title", 5, 5));
    assert_eq!(refused_place(name, &longer), "directory");

    // Some versions state 40 bytes for a block of four.
    let mut misstated = changed(name, &title("Title", 5, 9), &title("ImageModificat~0", 7, 40));
    let content = misstated.windows(7).position(|part| part == b"fixture").expect("the title");
    misstated.drain(content + 4..content + 9);
    assert_eq!(
        parse_map(Path::new(name), &misstated, None).unwrap(),
        parse_map(Path::new(name), &plain, None).unwrap()
    );
}

/// A size in the header is held against the bytes of the file before memory is reserved for it.
#[test]
fn size_beyond_file_is_refused() {
    let name = "zygo-format1.xyz";
    let refused = parse_map(Path::new(name), &changed(name, b"10 20 7 5", b"10 20 7000 7000"), None);
    assert!(matches!(&refused, Err(FormatError::Cut { place, .. }) if place == "byte 700"), "{refused:?}");
}

/// A converter of Zygo Mx with one parameter has no distance of the samples.
#[test]
fn short_converter_is_refused() {
    let name = "datx-earliest-contiguous-fringes.datx";
    let bytes = std::fs::read(folder().join(name)).unwrap();
    let heap = bytes.windows(4).position(|part| part == b"GCOL").expect("the heap of the texts and lists") as u64;
    let list = |count: u32| [&count.to_le_bytes()[..], &heap.to_le_bytes()].concat();
    let place = refused_place(name, &replaced(&bytes, &list(4), &list(1)));
    assert!(place.ends_with(", X Converter"), "{place}");
}

/// Scanner points of the same surface, in metres.
#[test]
fn scanner_points_match_surface() {
    let unit = Table { unit: Some("m".parse().unwrap()), ..Table::default() };
    let cases: [(&str, &Table, usize); 4] = [
        ("pye57-identity.e57", &Table::default(), 33),
        ("pye57-invalid-state.e57", &Table::default(), 33),
        ("laspy.las", &unit, 33),
        // The first point is withheld.
        ("laspy-14-withheld.las", &unit, 32),
    ];
    for (name, table, count) in cases {
        let read =
            read_measured_with_notes(scanner_folder().join(name), table).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(read.points.len(), count, "{name}");
        let off = difference(&read.points, 0.25, false);
        // LAS has integers of 0.1 nm.
        assert!(off < 1e-7, "{name}: {off:e}");
    }
    // The pose of a scan: a quarter turn about z, and a shift by 1, 2 and 3 m.
    let identity = read(&scanner_folder().join("pye57-identity.e57")).unwrap().points;
    let posed = read(&scanner_folder().join("pye57-pose.e57")).unwrap().points;
    for (p, q) in identity.iter().zip(&posed) {
        let expected = Point::new(1000.0 - p.y, 2000.0 + p.x, 3000.0 + p.z);
        assert!((expected - q).norm() < 1e-9, "{q} instead of {expected}");
    }
    let refused = read(&scanner_folder().join("laspy.las"));
    assert!(matches!(refused, Err(FormatError::Unexpected { .. })), "LAS has no unit");
    let packed = read_measured_with_notes(scanner_folder().join("laspy.laz"), &unit);
    assert!(matches!(packed, Err(FormatError::Unexpected { .. })), "LAZ is not read");
    let refused = read_measured_with_notes(scanner_folder().join("pye57-identity.e57"), &unit);
    assert!(matches!(refused, Err(FormatError::Unexpected { .. })), "E57 has one");
}

fn scanner_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/scanner")
}
