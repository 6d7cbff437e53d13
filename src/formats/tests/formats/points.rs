//! Files in and out: every notation that is understood, every fault that is named, and nothing that panics.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use proptest::prelude::*;
use regrind_core::geometry::Point;
use regrind_formats::*;

type Outcome = Result<Vec<Point>, FormatError>;

fn text(content: impl AsRef<[u8]>) -> Outcome {
    parse_points(Path::new("measured.csv"), content.as_ref())
}

/// Returns the name of the variant of an error.
fn variant(error: &FormatError) -> String {
    format!("{error:?}").chars().take_while(char::is_ascii_alphanumeric).collect()
}

/// A small deterministic generator, so that a failure can be repeated.
struct Lcg(u64);

impl Lcg {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        self.0 >> 33
    }

    fn bytes(&mut self, count: usize) -> Vec<u8> {
        (0..count).map(|_| self.next() as u8).collect()
    }
}

fn two_points() -> Vec<Point> {
    vec![Point::new(1.5, -2.25, 3.0), Point::new(4.0, 5.5, -1200.125)]
}

#[test]
fn separators_and_headers() {
    let forms: &[&str] = &[
        "1.5,-2.25,3\n4,5.5,-1200.125\n",
        "1.5;-2.25;3\n4;5.5;-1200.125\n",
        "1.5\t-2.25\t3\n4\t5.5\t-1200.125",
        "  1.5  -2.25 \t 3 \n4 5.5 -1200.125\n",
        "1.5, -2.25, 3 \r\n4, 5.5,\t-1200.125\r\n",
        "\u{feff}x,y,z\r\n1.5,-2.25,3\r\n4,5.5,-1200.125",
        "x_mm;y_mm;z_mm\n1,5;-2,25;3\n4;5,5;-1200,125\n",
        "1,5 -2,25 3\n4 5,5 -1.200,125\n",
        "x;y;z\n1.5;-2.25;3\n4;5.5;-1,200.125\n",
        "1.5 -2.25 3 0 0 1\n4 5.5 -1200.125 0 0.6 0.8\n",
        "Part 12\nX_act,Z_act,Y_act\nmm,mm,mm\n1.5,3,-2.25\n4,-1200.125,5.5\n",
        "Measured on 2026-11-02, 20 degrees\nx_mm y_mm z_mm\n1.5 -2.25 3\n4 5.5 -1200.125\n",
        "# x, y, z of the centres\n1.5 -2.25 3\n4 5.5 -1200.125\n",
        "# Y_act Z_act X_act\n-2.25 3 1.5\n5.5 -1200.125 4\n",
        "# a comment\n\n// another, with, commas\nx y z\n1.5 -2.25 3\n# between\n\n4 5.5 -1200.125\n\n\n",
        "id,Z [mm],Y [mm],X [mm],note\na,3,-2.25,1.5,\"p, 1\"\nb,-1200.125,5.5,4,\n",
        "# id x y z\n1 1.5 -2.25 3\n2 4 5.5 -1200.125\n",
        "Enabled\tID \tx     \ty \tz\ti\nChecked\t1\t1.5\t-2.25\t3.0\t \nChecked\t2\t4.0\t5.5\t\"-1,200.1250\"\t \n",
        "x,y,z,x_res\n1.5,-2.25,3,nan\n4,5.5,-1200.125,\n",
        "x (mm) y (mm) z (mm)\n1.5 -2.25 3\n4 5.5 -1200.125\n",
        "x_mm,y_mm,z_mm,nx,ny,nz,deviation_mm,used\n1.5,-2.25,3,0,0,1,1e-3,1\n4,5.5,-1200.125,0,0,1,0,0\n",
        "+1.5,-225e-2,3.\n4e0,5.5,-1.200125E+3\n",
    ];
    for form in forms {
        assert_eq!(text(form).unwrap_or_else(|e| panic!("{e}\n{form}")), two_points(), "{form}");
    }
}

#[test]
fn spreadsheet_padding_is_ignored() {
    let forms: &[&str] = &[
        "sep=;\nX;Y;Z\n1,5;-2,25;3\n4;5,5;-1200,125\n",
        "x,y,z\r\n1.5,-2.25,3\r\n4,5.5,-1200.125\r\n,,\r\n,,\r\n",
        "x;y;z\n1.5;-2.25;3\n4;5.5;-1200.125\n;;\n\n\"\";\"\";\"\"\n",
        "1.5,-2.25,3\n4,5.5,-1200.125\n\x1a",
        "1.5 -2.25 3\r\n4 5.5 -1200.125\r\n\x1a\r\n",
    ];
    for form in forms {
        assert_eq!(text(form).unwrap_or_else(|e| panic!("{e}\n{form}")), two_points(), "{form}");
    }
    // A row of empty cells between points is a point that was lost.
    let between = "x,y,z\n1,2,3\n,,\n4,5,6\n";
    assert!(matches!(text(between), Err(FormatError::NotANumber { line: 3, column: 1, .. })), "{:?}", text(between));
    let far = format!("1,2,3\n,,\n{}4,5,6\n", ",,\n".repeat(2_000_000));
    assert!(matches!(text(far), Err(FormatError::NotANumber { line: 2, column: 1, .. })));
    assert!(matches!(text("1,2,3\r4,5,6\r"), Err(FormatError::WrongKind { .. })));
    let wide: Vec<u8> = "x\ty\tz\r\n1\t2\t3\r\n".bytes().flat_map(|b| [b, 0]).collect();
    assert!(matches!(text(wide), Err(FormatError::Utf16 { .. })));
}

#[test]
fn stated_unit_other_than_mm_refused() {
    let stated = [
        "# all dimensions in inches\nx,y,z\n1,2,3\n",
        "// UNITS/INCH\n1,2,3\n",
        "# Einheit: Zoll\n1 2 3\n",
        "All dimensions in inches\nx,y,z\n1,2,3\n",
        "# units = um\n1,2,3\n",
    ];
    for content in stated {
        assert!(matches!(text(content), Err(FormatError::Unit { line: 1, .. })), "{content} {:?}", text(content));
    }
    let mesh = |comment: &str| {
        format!(
            "ply\nformat ascii 1.0\ncomment {comment}\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
        )
    };
    let ply = |comment: &str| parse_ply(Path::new("m.ply"), mesh(comment).as_bytes()).map(|file| file.points.len());
    assert!(matches!(ply("units inches"), Err(FormatError::Unit { line: 3, .. })));
    assert!(matches!((ply("units: mm"), ply("an inch"), ply("a part")), (Ok(1), Err(_), Ok(1))));
    let facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n";
    let stl =
        |name: &str| parse_stl(Path::new("m.stl"), format!("solid {name}\n{facet}endsolid\n").as_bytes()).map(|_| ());
    assert!(stl("UNITS=mm").is_ok() && matches!(stl("UNITS=in"), Err(FormatError::Unit { line: 1, .. })));
}

#[test]
fn foreign_file_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let step = folder.path().join("surface.csv");
    fs::write(&step, "ISO-10303-21;\nHEADER;\n").unwrap();
    // As the nominal it is read, by its content, and here it ends too early.
    assert!(matches!(read_nominal(&step), Err(FormatError::Cut { .. })));
    assert!(matches!(read_measured(&step), Err(FormatError::WrongKind { found: "a CAD model", .. })));
    assert!(matches!(read_points(&step), Err(FormatError::WrongKind { found: "a STEP file", .. })));
}

#[test]
fn errors_name_place_and_remedy() {
    let cases: &[(&str, &str, &[&str])] = &[
        ("", "Empty", &["points"]),
        ("\n# nothing\n\n", "Empty", &["points"]),
        ("x,y,z\n", "NoData", &["points"]),
        ("x,y,z\n1,2,3\n1,abc,3\n", "NotANumber", &["line 3, column 2:", "`abc`"]),
        ("1,2,3\n1,,3\n", "NotANumber", &["line 2, column 2:", "nothing"]),
        ("1,2,3\n1,2,nan\n", "NotFinite", &["line 2, column 3:", "`nan`"]),
        ("nan,nan,nan\n", "NotFinite", &["line 1, column 1:"]),
        ("1,-inf,3\n", "NotFinite", &["line 1, column 2:"]),
        ("1,2,1e300\n", "OutOfRange", &["line 1, column 3:", "1e7 mm", "`1e300`"]),
        ("1,2,1e999\n", "OutOfRange", &["`1e999`"]),
        ("1,2,3\n1,2\n1,2,3\n", "ColumnCount", &["line 2:", "3 columns", "comma", "line 1, found 2"]),
        ("1,2,3\n1,2,3,4\n", "ColumnCount", &["line 2:", "3 columns", "comma", "line 1, found 4"]),
        ("a x y z\n1 2 3 4\n1 2 3 \n", "ColumnCount", &["line 3:", "4 columns", "blank", "line 2, found 3"]),
        ("1;2;3\n1,2,3\n", "ColumnCount", &["line 2:", "3 columns", "semicolon", "line 1, found 1"]),
        ("1|2|3\n4|5|6\n", "TooFewColumns", &["line 2:", "found 1"]),
        ("1,2\n", "TooFewColumns", &["line 1:"]),
        ("words of prose\nmore words\n", "TooFewColumns", &["line 2:"]),
        ("a title 1\nfoo bar baz\n1 2 3\n", "NotANumber", &["line 1, column 1:", "`a`"]),
        ("1D0,2D0,3D0\n1,2,3\n", "HeaderNames", &["line 1:", "none of x, y and z"]),
        ("left;right;up\n1;2;3\n", "HeaderNames", &["line 1:", "none of x, y and z"]),
        ("x,y,height in um\n1,2,3\n", "Unit", &["line 1:", "in mm", "`um`"]),
        ("x,y,height\n1,2,3\n", "HeaderNames", &["line 1:", "0 columns z"]),
        ("X_nom,Y_nom,Z_nom\n1,2,3\n", "HeaderNames", &["line 1:", "only nominal"]),
        ("X_nom,Y_nom,Z_nom,X_act,Y_act,Z_act\n1,2,3,1,2,3\n", "HeaderNames", &["line 1:", "measured and nominal"]),
        ("x,y,z,x_act,y_act,z_act\n1,2,3,1,2,3\n", "HeaderNames", &["line 1:", "plain and measured"]),
        ("# X_nom Y_nom Z_nom X_act Y_act Z_act\n1 2 3 1 2 3\n", "HeaderNames", &["line 1:", "measured and nominal"]),
        ("# y, x, z, q\n1,2,3\n", "HeaderColumns", &["line 1:", "4 columns", "comma", "has 3"]),
        ("1,2,3,1,2,3\n", "UnnamedColumns", &["line 1:", "6 columns"]),
        ("7,1,2,3\n", "UnnamedColumns", &["line 1:", "4 columns"]),
        ("all dimensions in inches\nx,y,z\n1,2,3\n", "Unit", &["line 1:", "in mm", "`inches`"]),
        ("Part 7, Zoll\nx,y,z\n1,2,3\n", "Unit", &["line 1:", "in mm", "`zoll`"]),
        ("x,y,z\nmm,mm,um\n1,2,3\n", "Unit", &["line 2:", "in mm", "`um`"]),
        ("1,2,3\n0x10,2,3\n", "NotANumber", &["`0x10`"]),
        ("1,2,3\n1,2,3mm\n", "NotANumber", &["line 2, column 3:", "`3mm`"]),
        ("1,2,3\n4,5", "CutLine", &["line 2:", "`4,5`"]),
        ("1,2,3\n4,5,-", "CutLine", &["line 2:"]),
        ("x,y,z\n1;2;3\n", "HeaderColumns", &["line 1:", "1 columns", "semicolon", "has 3"]),
        ("id,x,y\n1,2,3\n", "HeaderNames", &["line 1:", "0 columns z"]),
        ("x,y,z,x\n1,2,3,4\n", "HeaderNames", &["line 1:", "2 columns x"]),
        ("x_m,y_m,z_m\n1,2,3\n", "Unit", &["line 1:", "in mm", "`m`"]),
        ("x [inch];y [inch];z [inch]\n1;2;3\n", "Unit", &["`inch`"]),
        ("x [mm];y [mm];z [\u{b5}m]\n1;2;3\n", "Unit", &["`\u{b5}m`"]),
        ("# units: inch\n1 2 3\n", "Unit", &["line 1:", "in mm", "`inch`"]),
        ("12,345;23,456;34,567\n", "AmbiguousComma", &["line 1, column 1:", "`12,345`"]),
        ("1.5;2.5;3.5\n1,5;2,5;3,5\n", "DecimalMark", &["line 2, column 1:", "decimal point like"]),
        ("1,5;2,5;3,5\n1.5;2.5;3.5\n", "DecimalMark", &["line 2, column 1:", "decimal comma like"]),
        ("1.5;2.5;3.5\n1.5;2,512;3.5\n", "AmbiguousComma", &["line 2, column 2:", "`2,512`"]),
        ("1,2,3\n1,\"2,3\n", "NotANumber", &["line 2"]),
        ("1,2,3\n1,2,3\0\n", "NotText", &["line 2:", "0x00"]),
    ];
    for (content, kind, pieces) in cases {
        let error = text(content).expect_err("an error");
        let message = error.to_string();
        assert_eq!(variant(&error), *kind, "{content:?}\n gave {message}");
        for piece in *pieces {
            assert!(message.contains(piece), "{content:?}\n gave {message}\n not {piece}");
        }
        assert!(message.starts_with("measured.csv") && !message.ends_with('.'), "{message}");
    }
    assert!(matches!(text(b"\xff\xfe1\0,\0"), Err(FormatError::Utf16 { .. })));
    assert!(matches!(text(b"PK\x03\x04binary"), Err(FormatError::NotText { line: 1, value: 3, .. })));
}

/// A line far down, past several batches and shares, is still named by its number.
#[test]
fn error_line_number_in_large_file() {
    let mut content = String::from("x,y,z\n");
    for line in 0..400_000 {
        content += if line % 7 == 0 { "1.5,2.5,3.5\n# note\n" } else { "1.23456789,2.3456789,3.456789\n" };
    }
    let good = text(&content).unwrap();
    assert_eq!(good.len(), 400_000);
    let line = content.lines().count() as u64 + 1;
    content += "1,2,oops\n1,2,nan\n";
    assert!(matches!(text(&content), Err(FormatError::NotANumber { line: l, column: 3, .. }) if l == line));
    content.insert(content.len() / 2, '\0');
    assert!(text(&content).is_err());
}

#[test]
fn order_preserved_across_batches() {
    let content: String = (0..300_000).map(|i| format!("{i},{}.5,-0.000{i}\n", i / 3)).collect();
    let points = text(content).unwrap();
    assert_eq!(points.len(), 300_000);
    assert!(points.iter().enumerate().all(|(i, p)| p.x == i as f64 && p.y == (i / 3) as f64 + 0.5));
}

/// An endless stream that repeats a piece; it counts what was taken from it.
struct Endless<'a> {
    piece: &'a [u8],
    at: usize,
    taken: &'a AtomicU64,
}

impl Read for Endless<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        for byte in buffer.iter_mut() {
            *byte = self.piece[self.at % self.piece.len()];
            self.at += 1;
        }
        self.taken.fetch_add(buffer.len() as u64, Ordering::Relaxed);
        Ok(buffer.len())
    }
}

#[test]
fn endless_garbage_fails_early() {
    let rubbish: [&[u8]; 6] = [b"\0", b"9", b" ", b"no end of words ", b"\x7f\xf0\xd3", b"1,2,3\nfoo\n"];
    for piece in rubbish {
        let taken = AtomicU64::new(0);
        let outcome = parse_points(Path::new("endless"), Endless { piece, at: 0, taken: &taken });
        assert!(outcome.is_err());
        assert!(taken.load(Ordering::Relaxed) < 10 << 20, "{piece:?} took {taken:?}");
    }
}

#[test]
fn sparse_gigabyte_files_refused() {
    let folder = tempfile::tempdir().unwrap();
    let begin: [(&str, &[u8]); 4] = [
        ("zeros.csv", b""),
        ("good-then-zeros.csv", b"x,y,z\n1,2,3\n"),
        ("cut.ply", b"ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n"),
        ("zeros.stl", b""),
    ];
    for (name, head) in begin {
        let path = folder.path().join(name);
        let mut file = File::create(&path).unwrap();
        file.write_all(head).unwrap();
        file.set_len((1 << 30) - 1).unwrap();
        let message = read_nominal(&path).expect_err(name).to_string();
        assert!(message.contains(name), "{message}");
    }
    let path = folder.path().join("large.csv");
    File::create(&path).unwrap().set_len(3 << 30).unwrap();
    assert!(matches!(read_points(&path), Err(FormatError::TooLarge { .. })));
}

fn ply_ascii() -> Vec<u8> {
    b"ply\nformat ascii 1.0\ncomment by hand\nelement camera 1\nproperty list uchar float values\nelement vertex 4\n\
      property uchar red\nproperty double z\nproperty float x\nproperty list uchar int tags\nproperty float y\n\
      element face 2\nproperty uchar flags\nproperty list uchar int vertex_indices\nend_header\n\
      2 0.5 nan\n1 0 0 0 0\n2 0 1 2 7 8 0\n3 0.5 1 0 1\n4 0 0 1 9 1\n9 4 0 1 2 3\n9 3 0 1 1\n"
        .to_vec()
}

fn ply_binary(big: bool) -> Vec<u8> {
    let order = if big { "big" } else { "little" };
    let mut bytes = format!(
        "ply\nformat binary_{order}_endian 1.0\nelement vertex 3\nproperty short x\nproperty float ny\nproperty double y\n\
         property list uint8 uint16 tags\nproperty float z\nproperty float nx\nproperty float nz\nelement face 1\n\
         property list uchar uint vertex_index\nend_header\n"
    )
    .into_bytes();
    let mut put = |little: &[u8]| {
        let value: Vec<u8> = if big { little.iter().rev().copied().collect() } else { little.to_vec() };
        bytes.extend(value);
    };
    for (x, y, z) in [(-1i16, 0.5f64, 2.0f32), (1, 0.25, -3.5), (300, 1e-3, 0.0)] {
        put(&x.to_le_bytes());
        put(&0f32.to_le_bytes());
        put(&y.to_le_bytes());
        put(&[2]);
        put(&7u16.to_le_bytes());
        put(&8u16.to_le_bytes());
        put(&z.to_le_bytes());
        put(&0f32.to_le_bytes());
        put(&2f32.to_le_bytes());
    }
    put(&[3]);
    [2u32, 0, 1].iter().for_each(|index| put(&index.to_le_bytes()));
    bytes
}

#[test]
fn ply_is_read_in_all_encodings() {
    let path = Path::new("part.ply");
    let file = parse_ply(path, &ply_ascii()).unwrap();
    assert_eq!(file.points[2], Point::new(1.0, 1.0, 0.5));
    assert_eq!(file.triangles, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!((file.degenerate, file.normals), (1, None));
    for big in [false, true] {
        let file = parse_ply(path, &ply_binary(big)).unwrap();
        assert_eq!(
            file.points,
            [Point::new(-1.0, 0.5, 2.0), Point::new(1.0, 0.25, -3.5), Point::new(300.0, 1e-3, 0.0)]
        );
        assert_eq!(file.triangles, [[2, 0, 1]]);
        assert_eq!(file.normals.unwrap()[1].z, 1.0);
    }
}

#[test]
fn ply_errors_name_their_line() {
    let good = String::from_utf8(ply_ascii()).unwrap();
    let cases: &[(&str, &str, &str, &[&str])] = &[
        ("ply\n", "plywood\n", "Unexpected", &["line 1:", "`plywood`"]),
        ("format ascii 1.0\n", "", "Unexpected", &["line 3:", "`format ascii 1.0` or"]),
        ("format ascii 1.0", "format ascii 2.0", "Unexpected", &["line 2:", "`format ascii 1.0`"]),
        ("format ascii", "format utf", "Unexpected", &["line 2:", "binary_little_endian"]),
        ("vertex 4", "vertex -4", "Unexpected", &["line 6:", "with a count"]),
        ("vertex 4", "vertex 99999999999999999999", "Unexpected", &["line 6:", "with a count"]),
        ("vertex 4", "vertex 99999999999", "TooLarge", &["99999999999 vertices", "4294967295"]),
        ("vertex 4", "vertex 0", "NoData", &["no vertices"]),
        ("vertex 4", "vertex 5", "Cut", &["line 22:", "face 2 of 2"]),
        ("vertex 4", "points 4", "Unexpected", &["one element vertex", "`0 of them`"]),
        ("double z", "real z", "Unexpected", &["line 8:", "a type such as"]),
        ("double z", "double w", "Unexpected", &["properties x, y and z"]),
        ("double z", "double x", "Unexpected", &["line 9:", "of another name"]),
        ("list uchar int vertex", "list float int vertex", "Unexpected", &["line 14:", "integer length"]),
        ("list uchar int vertex", "list uchar float vertex", "Unexpected", &["vertex indices", "integer type"]),
        ("element camera 1\n", "", "Unexpected", &["line 4:", "before its properties"]),
        ("comment by hand", "remark by hand", "Unexpected", &["line 3:", "comment, element"]),
        ("9 4 0 1 2 3", "9 4 0 1 2 4", "IndexOutOfRange", &["line 21:", "vertex 4,", "4 vertices"]),
        ("9 4 0 1 2 3", "9 4 0 1 2 -1", "IndexOutOfRange", &["line 21:", "vertex -1,"]),
        ("9 4 0 1 2 3", "9 2 0 1", "Unexpected", &["line 21:", "3 corners of face 1", "`2`"]),
        ("9 4 0 1 2 3", "9 4.5 0 1 2 3", "Unexpected", &["line 21:", "face 1 of 2", "`4.5`"]),
        ("9 4 0 1 2 3", "9 -4 0 1 2 3", "Unexpected", &["line 21:", "length of", "face 1 of 2", "`-4`"]),
        ("3 0.5 1", "3 nan 1", "BadCoordinate", &["line 19:", "expected z", "NaN"]),
        ("3 0.5 1", "3 1e9 1", "BadCoordinate", &["line 19:", "expected z", "1e7 mm", "1000000000"]),
        ("3 0.5 1", "3 half 1", "Unexpected", &["line 19:", "vertex 3 of 4", "`half`"]),
        ("3 0.5 1 0 1", "3 0.5 1 0 1 5", "Unexpected", &["line 19:", "vertex 3 of 4", "`5`"]),
        ("9 3 0 1 1\n", "", "Cut", &["face 2 of 2"]),
        ("9 3 0 1 1\n", "9 3 0 1 1\nmore\n", "Unexpected", &["line 23:", "the end of the file", "`more`"]),
    ];
    for (from, to, kind, pieces) in cases {
        let bad = good.replacen(from, to, 1);
        assert_ne!(bad, good);
        let error = parse_ply(Path::new("part.ply"), bad.as_bytes()).expect_err(to);
        let message = error.to_string();
        assert_eq!(variant(&error), *kind, "{to}\n gave {message}");
        assert!(message.starts_with("part.ply"), "{message}");
        for piece in *pieces {
            assert!(message.contains(piece), "{to}\n gave {message}\n not {piece}");
        }
    }
}

fn stl_ascii() -> Vec<u8> {
    let facet = |a: &str, b: &str, c: &str| {
        format!(
            " facet normal 0 0 1\n  outer loop\n   vertex {a}\n   vertex {b}\n   vertex {c}\n  endloop\n endfacet\n"
        )
    };
    let facets =
        facet("0 0 0", "1 0 0", "0 1 0.5") + &facet("1 0 -0", "1 1 0", "0 1 0.5") + &facet("0 0 0", "1 0 0", "2 0 0");
    format!("solid a part\n{facets}endsolid a part\n").into_bytes()
}

fn stl_binary(points: &[[f32; 3]]) -> Vec<u8> {
    let mut bytes = b"solid, but binary all the same".to_vec();
    bytes.resize(80, b' ');
    bytes.extend((points.len() as u32 / 3).to_le_bytes());
    for facet in points.chunks_exact(3) {
        bytes.extend([0; 12]);
        facet.iter().flatten().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend([0; 2]);
    }
    bytes
}

const TWO_FACETS: [[f32; 3]; 6] =
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5], [1.0, -0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.5]];

#[test]
fn stl_welding_and_errors() {
    let path = Path::new("part.stl");
    for (bytes, degenerate) in [(stl_ascii(), 1), (stl_binary(&TWO_FACETS), 0)] {
        let mesh = parse_stl(path, &bytes).unwrap();
        assert_eq!(mesh.points.len(), 4);
        assert_eq!(mesh.points[2], Point::new(0.0, 1.0, 0.5));
        assert_eq!((mesh.triangles, mesh.degenerate), (vec![[0, 1, 2], [1, 3, 2]], degenerate));
    }
    let good = String::from_utf8(stl_ascii()).unwrap();
    let cases: &[(&str, &str, &str, &[&str])] = &[
        ("facet normal", "facette normal", "Unexpected", &["line 2:", "`endsolid`", "`facette`"]),
        ("outer loop", "inner loop", "Unexpected", &["line 3:", "`outer`", "`inner`"]),
        ("vertex 1 0 0", "vertex 1 0", "Unexpected", &["line 6:", "coordinate z", "`vertex`"]),
        ("vertex 1 0 0", "vertex 1 nan 0", "BadCoordinate", &["line 5:", "expected y"]),
        ("vertex 1 0 0", "vertex 1 0 1e8", "BadCoordinate", &["line 5:", "expected z"]),
        ("vertex 1 0 0", "vertex 1,5 0 0", "Unexpected", &["line 5:", "coordinate x", "`1,5`"]),
        ("endsolid a part\n", "", "Cut", &["line 23:", "facet"]),
    ];
    for (from, to, kind, pieces) in cases {
        let error = parse_stl(path, good.replacen(from, to, 1).as_bytes()).expect_err(to);
        let message = error.to_string();
        assert_eq!(variant(&error), *kind, "{to}\n gave {message}");
        assert!(message.starts_with("part.stl"), "{message}");
        for piece in *pieces {
            assert!(message.contains(piece), "{to}\n gave {message}\n not {piece}");
        }
    }
    let mut bad = stl_binary(&TWO_FACETS);
    bad[84 + 12 + 4..84 + 12 + 8].copy_from_slice(&f32::NAN.to_le_bytes());
    let error = parse_stl(path, &bad).unwrap_err();
    assert!(matches!(&error, FormatError::BadCoordinate { place, what: "y", .. } if place == "byte 100"), "{error}");
    assert!(error.to_string().starts_with("part.stl, byte 100:"), "{error}");
    assert!(matches!(parse_stl(path, &stl_binary(&[])), Err(FormatError::NoData { .. })));
    let flat = stl_binary(&[[1.0, 2.0, 3.0]; 3]);
    assert!(matches!(parse_stl(path, &flat), Err(FormatError::NoData { .. })));
}

#[test]
fn cut_file_is_error_or_whole_prefix() {
    let cloud = b"x_mm,y_mm,z_mm\n1.5,-2.25,3.125\n4.5,5.5,-6.5\n7,8,9\n";
    for end in 0..cloud.len() {
        match text(&cloud[..end]) {
            Ok(points) => {
                let lines = cloud[..end].iter().filter(|&&b| b == b'\n').count();
                assert!(points.len() + 1 == lines || points.len() == lines, "{end}");
            }
            Err(error) => assert!(error.to_string().starts_with("measured.csv"), "{error}"),
        }
    }
    let path = Path::new("part");
    for bytes in [ply_ascii(), ply_binary(false), ply_binary(true)] {
        // Without its last newline a text file is whole; without its last digit it may be too.
        for end in 0..bytes.len() - 2 {
            let error = parse_ply(path, &bytes[..end]).expect_err("cut");
            assert!(error.is_cut() || end > bytes.len() - 14, "{end}: {error}");
        }
    }
    for bytes in [stl_ascii(), stl_binary(&TWO_FACETS)] {
        let last_word = bytes.len() - if bytes[6] == b'a' { 8 } else { 0 };
        for end in 0..last_word {
            let error = parse_stl(path, &bytes[..end]).expect_err("cut");
            assert!(error.is_cut(), "{end}: {error}");
        }
    }
}

#[test]
fn random_bytes_never_panic() {
    let mut random = Lcg(7);
    let path = Path::new("noise");
    let seeds = [ply_ascii(), ply_binary(false), ply_binary(true), stl_ascii(), stl_binary(&TWO_FACETS)];
    let cloud = b"# c\nx;y;z\n1,5;\"2.000,5\";3\n4;5,5;6e1\n".to_vec();
    for round in 0..2000 {
        let length = random.next() as usize % 300;
        let noise = random.bytes(length);
        let digits: Vec<u8> = noise.iter().map(|b| b"0123456789.,;-+eE# \t\r\n\"xyznaif"[*b as usize % 30]).collect();
        let mut damaged = if round % 6 == 5 { cloud.clone() } else { seeds[round % 6].clone() };
        for _ in 0..1 + random.next() % 4 {
            let at = random.next() as usize % damaged.len();
            damaged[at] = random.next() as u8;
        }
        for bytes in [&noise, &digits, &damaged] {
            if let Ok(points) = parse_points(path, &bytes[..]) {
                assert!(points.iter().all(|p| p.iter().all(|v| v.abs() <= LIMIT_MM)));
            }
            if let Ok(file) = parse_ply(path, bytes) {
                assert!(file.triangles.iter().flatten().all(|&i| (i as usize) < file.points.len()));
            }
            let _ = parse_stl(path, bytes);
        }
    }
}

/// A generous list of the same lines in quick and careful form gives the same numbers.
#[test]
fn quick_and_careful_parsers_agree() {
    let mut random = Lcg(3);
    let value = |random: &mut Lcg| (random.next() as f64 - 1e9) / 10f64.powi((random.next() % 12) as i32);
    let rows: Vec<[f64; 3]> = (0..5000).map(|_| [(); 3].map(|()| value(&mut random) / 1e3)).collect();
    let plain: String = rows.iter().map(|[x, y, z]| format!("{x},{y},{z}\n")).collect();
    let quoted: String = rows.iter().map(|[x, y, z]| format!("\"{x}\",\"{y}\",\"{z}\"\n")).collect();
    let comma = plain.replace(',', ";").replace('.', ",");
    let expected: Vec<Point> = rows.iter().map(|&row| Point::from(row)).collect();
    for form in [plain, quoted, comma] {
        assert_eq!(text(form).unwrap(), expected);
    }
}

#[test]
fn content_overrides_extension() {
    let folder = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        path
    };
    let is = |name: &str, bytes: &[u8]| read_nominal(put(name, bytes));
    assert!(matches!(is("a.txt", &ply_ascii()), Ok(NominalFile::Mesh { points, .. }) if points.len() == 4));
    assert!(matches!(is("a.csv", &stl_binary(&TWO_FACETS)), Ok(NominalFile::Mesh { .. })));
    assert!(matches!(is("a.dat", &stl_ascii()), Ok(NominalFile::Mesh { .. })));
    assert!(matches!(is("a.stl", b"1,2,3\n"), Ok(NominalFile::Points(points)) if points.len() == 1));
    assert!(matches!(is("a", b"# sphere\n[surface]\nkind = \"sphere\"\n"), Ok(NominalFile::Definition(_))));
    assert!(matches!(is("b", b"kind = \"sphere\"\n"), Ok(NominalFile::Definition(_))));
    assert!(matches!(is("empty.toml", b""), Err(FormatError::Empty { .. })));
    assert!(matches!(is("rubbish.ply", b"\x01\x02"), Err(FormatError::Unexpected { .. })));
    assert!(matches!(is("rubbish.stl", b"\x01\x02"), Err(FormatError::Cut { .. })));
    assert!(matches!(is("rubbish.xyz", b"\x01\x02"), Err(FormatError::NotText { .. })));
    assert!(matches!(is("latin.toml", b"a = 1\nb = \"\xb5\"\n"), Err(FormatError::NotText { line: 2, .. })));

    assert_eq!(read_measured(put("m.ply", &ply_ascii())).unwrap().len(), 4);
    assert_eq!(read_measured(put("m.csv", b"1 2 3\n")).unwrap().len(), 1);
    assert!(matches!(read_measured(put("m.stl", &stl_ascii())), Err(FormatError::WrongKind { .. })));
    assert!(matches!(read_measured(put("m.toml", b"[a]\n")), Err(FormatError::WrongKind { .. })));
    assert!(matches!(read_measured(folder.path().join("none")), Err(FormatError::Unreadable { .. })));
    assert!(matches!(read_measured(folder.path()), Err(FormatError::Unreadable { .. })));
}

#[test]
fn results_written_atomically() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("deviations.csv");
    let row = |i: usize| DeviationRow {
        point_mm: [i as f64 / 3.0, -1.0, 1e-9],
        normal: [0.0, 0.0, 1.0],
        deviation_mm: -1.25e-4,
        used: i.is_multiple_of(2),
    };
    let rows: Vec<DeviationRow> = (0..70_000).map(row).collect();
    write_deviations(&path, &rows).unwrap();
    let written = fs::read_to_string(&path).unwrap();
    let mut lines = written.lines();
    assert_eq!(lines.next(), Some("x_mm,y_mm,z_mm,nx,ny,nz,deviation_mm,used"));
    for (line, row) in lines.by_ref().zip(&rows) {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        assert_eq!(cells[..3], row.point_mm);
        assert_eq!(cells[6..], [row.deviation_mm, f64::from(u8::from(row.used))]);
    }
    assert_eq!(read_points(&path).unwrap().len(), rows.len());

    let mut bad = rows.clone();
    bad[41].deviation_mm = f64::NAN;
    assert!(matches!(write_deviations(&path, &bad), Err(FormatError::RowNotFinite { row: 42, .. })));
    assert_eq!(fs::read_to_string(&path).unwrap(), written);

    write_json_atomic(folder.path().join("r.json"), &vec![1.5, 0.1]).unwrap();
    assert_eq!(fs::read_to_string(folder.path().join("r.json")).unwrap(), "[\n  1.5,\n  0.1\n]\n");
    for target in [folder.path().to_owned(), folder.path().join("none/r.json"), PathBuf::from("/")] {
        let error = write_json_atomic(&target, &1).expect_err("unwritable");
        assert!(matches!(error, FormatError::Unwritable { .. }), "{error}");
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2, "no temporary file is left");
}

fn coordinates(most: f64) -> impl Strategy<Value = Vec<[f64; 3]>> {
    proptest::collection::vec([-most..most, -most..most, -1e-3..1e-3], 1..60)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn points_round_trip_text_and_ply(rows in coordinates(LIMIT_MM)) {
        let points: Vec<Point> = rows.iter().map(|&row| Point::from(row)).collect();
        let folder = tempfile::tempdir().unwrap();
        for header in ["", "x_mm,y_mm,z_mm"] {
            let path = folder.path().join("points.csv");
            write_points(&path, header, &points).unwrap();
            prop_assert_eq!(&read_measured(&path).unwrap(), &points);
        }
        let head = |format: &str| {
            format!(
                "ply\nformat {format} 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
                 end_header\n",
                rows.len()
            )
            .into_bytes()
        };
        let mut ascii = head("ascii");
        rows.iter().for_each(|[x, y, z]| ascii.extend(format!("{x} {y} {z}\n").into_bytes()));
        let mut little = head("binary_little_endian");
        rows.iter().flatten().for_each(|v| little.extend(v.to_le_bytes()));
        let mut big = head("binary_big_endian");
        rows.iter().flatten().for_each(|v| big.extend(v.to_be_bytes()));
        for bytes in [ascii, little, big] {
            prop_assert_eq!(&parse_ply(Path::new("p"), &bytes).unwrap().points, &points);
        }
    }

    #[test]
    fn stl_corners_round_trip(rows in coordinates(1e3)) {
        let corners: Vec<[f32; 3]> = rows.iter().map(|row| row.map(|v| v as f32)).collect();
        let corners = &corners[..corners.len() / 3 * 3];
        prop_assume!(!corners.is_empty());
        let mesh = parse_stl(Path::new("p"), &stl_binary(corners)).unwrap();
        let back: Vec<Point> = mesh.triangles.iter().flatten().map(|&i| mesh.points[i as usize]).collect();
        let expected: Vec<Point> = corners.iter().map(|c| Point::from(c.map(f64::from))).collect();
        prop_assert_eq!(back, expected);
    }
}

/// Reads a file and returns what was noted, each note without the name of the file.
fn notes(content: &str) -> Vec<String> {
    noted(content).into_iter().map(|(_, words)| words).collect()
}

/// Reads a file and returns its notes, each also in words without the name of the file.
fn noted(content: &str) -> Vec<(PointNote, String)> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("measured.csv");
    fs::write(&path, content).unwrap();
    let read = read_measured_with_notes(&path, &Table::default()).unwrap();
    assert_eq!(read.points, read_points(&path).unwrap());
    let name = path.display().to_string();
    let words = |note: &PointNote| note.to_string().strip_prefix(&name).expect("names the file").to_owned();
    read.notes.iter().map(|note| (note.clone(), words(note))).collect()
}

#[test]
fn note_on_missing_line_end() {
    let lines = "1.125,2.250,3.375\n4.125,5.250,6.375\n-7.125,8.250,9.375\n";
    assert_eq!(notes(&format!("{lines}1.500,2.500,3.500\n")), [""; 0]);
    for whole in ["1.500,2.500,3.500 ", "# end", "   "] {
        assert_eq!(notes(&format!("{lines}{whole}")), [""; 0], "{whole:?}");
    }
    let told = notes(&format!("x,y,z\n{lines}1.500,2.500,-13.500"));
    assert_eq!(told.len(), 1);
    for words in [", line 5: ", "no line end", "`-13.500`", "(1.5, 2.5, -13.5) mm", "may be cut"] {
        assert!(told[0].contains(words), "{told:?}");
    }
    for (cut, digits) in [("3.50", 2), ("3.5", 1), ("3.", 0), ("13", 0)] {
        let told = noted(&format!("{lines}1.500,2.500,{cut}"));
        let [(PointNote::NoLineEnd { line: 4, fewer_digits, .. }, words)] = &told[..] else { panic!("{told:?}") };
        assert_eq!(*fewer_digits, Some([digits, 3]), "{words}");
        for piece in [&format!("{digits} digits"), "3 or more", "line 4: ", "cut"] {
            assert!(words.contains(piece), "{piece}: {words}");
        }
    }
    let exponents = "1e-05 2e-05 3.5e-05\n".repeat(4);
    let told = notes(&format!("{exponents}1e-05 2e-05 3.5e-0"));
    for piece in ["`3.5e-0` has 1 digits", "have 2 or more"] {
        assert!(told[0].contains(piece), "{piece}: {told:?}");
    }
    // Numbers that are written as short as they are show nothing.
    let told = notes("1.125,2,3\n1,2,3.25\n1,2,3.125\n1,2,3");
    assert!(told.len() == 1 && told[0].contains("may be cut"), "{told:?}");
}

#[test]
fn note_line_number_in_large_file() {
    let mut content = "1.12345678;2.12345678;3.12345678\n".repeat(200_000);
    content += "1.12345678;2.12345678;3.1234";
    let told = notes(&content);
    assert!(told.len() == 1 && told[0].contains(", line 200001: "), "{told:?}");
}

#[test]
fn note_on_lone_thousands_mark() {
    let rows = "1,5;2,5;3,5\n".repeat(40_000);
    assert_eq!(notes(&rows), [""; 0]);
    let told = notes(&format!("{rows}1,5;1.234,5;3,5\n{rows}"));
    assert!(told.len() == 1, "{told:?}");
    for piece in [", line 40001: `1.234,5`", "1234.5 mm", "no other"] {
        assert!(told[0].contains(piece), "{piece}: {told:?}");
    }
    assert_eq!(notes(&format!("{rows}1,5;1.234,5;3,5\n{rows}1,5;1.234,5;3,5\n")), [""; 0]);
    assert_eq!(notes("1.5;2.5;3.5\n1.5;1,234.5;3.5\n1.5;2.5;3.5\n").len(), 1);
    assert_eq!(notes("1.5,2.5,3.5\n1.5,2,3.5\n"), [""; 0]);
}

#[test]
fn stated_columns_and_unit_are_used() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.csv");
    let read = |content: &str, columns: Option<&str>, unit: Option<Unit>| {
        std::fs::write(&path, content).unwrap();
        let table = Table { columns: columns.map(|columns| columns.parse().unwrap()), unit, ..Table::default() };
        read_measured_with_notes(&path, &table).map(|read| read.points)
    };
    let both = "Nr,X_nom,Y_nom,Z_nom,X_act,Y_act,Z_act\n1,9,9,9,1.5,-2.25,3\n2,9,9,9,4,5.5,-1200.125\n";
    let headless = "1.5 -2.25 3 0.1\n4 5.5 -1200.125 0.1\n";
    for (content, columns) in [
        (both, "x=X_act,y=Y_act,z=Z_act"),
        (both, "x=5,y=6,z=7"),
        (both, "x=x_act,y=6,z=Z_ACT"),
        (headless, "x=1,y=2,z=3"),
        ("left;right;up\n1.5;-2.25;3\n4;5.5;-1200.125\n", "x=left,y=right,z=up"),
        ("made by hand, 20 degrees\nup;right [mm];left\n3;-2.25;1.5\n-1200.125;5.5;4\n", "x=left,y=right,z=up"),
    ] {
        assert_eq!(read(content, Some(columns), None).unwrap(), two_points(), "{content} {columns}");
    }
    let inches = |content: &str| read(content, None, Some(Unit::Inch));
    let one = [Point::new(25.4, -50.8, 12.7)];
    for content in [
        "x,y,z\n1,-2,0.5\n",
        "x [in],y [in],z [inch]\n1,-2,0.5\n",
        "# units: inch\n1,-2,0.5\n",
        "x,y,z\nZoll,Zoll,Zoll\n1,-2,0.5\n",
    ] {
        assert_eq!(inches(content).unwrap(), one, "{content}");
    }
    for content in ["x_mm,y_mm,z_mm\n1,-2,0.5\n", "# unit: mm\n1,-2,0.5\n"] {
        assert!(matches!(inches(content), Err(FormatError::Unit { line: 1, unit: Unit::Inch, .. })), "{content}");
    }
    // Numbers say nothing of the unit that the header states.
    let metres = read("a [m],b [m],c [m]\n1,2,3\n", Some("x=1,y=2,z=3"), None);
    assert!(matches!(metres, Err(FormatError::Unit { line: 1, .. })), "{metres:?}");
    for (content, columns) in [(both, "x=X,y=Y_act,z=Z_act"), (headless, "x=1,y=2,z=5"), (headless, "x=a,y=b,z=c")] {
        let refused = read(content, Some(columns), None);
        assert!(matches!(refused, Err(FormatError::HeaderNames { .. })), "{columns}: {refused:?}");
    }
    // A file that says both itself.
    let ply = "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\nend_header\n1 2 3\n";
    assert!(matches!(read(ply, None, Some(Unit::Inch)), Err(FormatError::WrongKind { .. })));
}

#[test]
fn stated_height_unit_is_used() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.csv");
    let read = |content: &[u8], unit: Option<Unit>, height_unit: Option<Unit>| {
        std::fs::write(&path, content).unwrap();
        read_measured_with_notes(&path, &Table { unit, height_unit, ..Table::default() }).map(|read| read.points)
    };
    let one = [Point::new(1.0, -2.0, 0.5)];
    let forms: &[&[u8]] = &[
        b"x [mm],y [mm],z [um]\n1,-2,500\n",
        // The sign of micro in Latin-1, and its two in UTF-8.
        b"X (mm);Y (mm);Z (\xb5m)\n1;-2;500\n",
        "X (mm);Y (mm);Z (\u{b5}m)\n1;-2;500\n".as_bytes(),
        "z [\u{3bc}m]\tx\ty\n500\t1\t-2\n".as_bytes(),
        b"x,y,z\nmm,mm,um\n1,-2,500\n",
        b"# height in um\nx,y,z\n1,-2,500\n",
        b"heights: microns\nx,y,z\n1,-2,500\n",
        b"x,y,z\n1,-2,500\n",
    ];
    for (k, form) in forms.iter().enumerate() {
        let text = String::from_utf8_lossy(form);
        assert_eq!(read(form, None, Some(Unit::Micrometre)).expect(&text), one, "{text}");
        // One that nothing but a person can tell is in mm.
        let is_silent = k + 1 == forms.len();
        let refused = matches!(read(form, None, None), Err(FormatError::Unit { .. }));
        assert_eq!(refused, !is_silent, "{text} {:?}", read(form, None, None));
    }
    let centimetres = read(b"x [cm],y [cm],z [um]\n0.1,-0.2,500\n", Some(Unit::Centimetre), Some(Unit::Micrometre));
    assert_eq!(centimetres.unwrap(), one);
    for (form, height_unit) in [
        (&b"x [um],y [mm],z [um]\n1,-2,500\n"[..], Unit::Micrometre),
        (b"x,y,z\num,um,um\n1,-2,500\n", Unit::Micrometre),
        (b"x_mm,y_mm,z_mm\n1,-2,0.5\n", Unit::Micrometre),
        (b"# height in nm\nx,y,z\n1,-2,0.5\n", Unit::Micrometre),
        (b"# units: um\nx,y,z\n1,-2,0.5\n", Unit::Micrometre),
        // The unit of the heights says nothing of the others.
        (b"All dimensions in inches\nx,y,z\n1,-2,500\n", Unit::Micrometre),
    ] {
        let found = read(form, None, Some(height_unit));
        assert!(matches!(found, Err(FormatError::Unit { .. })), "{} {found:?}", String::from_utf8_lossy(form));
    }
    for waves in ["x,y,z (waves)\n1,-2,0.5\n", "x,y,z [waves]\n1,-2,0.5\n", "# height in waves\nx,y,z\n1,-2,0.5\n"] {
        assert!(read(waves.as_bytes(), None, None).is_err(), "{waves}");
    }
}
