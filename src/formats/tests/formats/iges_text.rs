//! IGES files written by hand: units, subfigures, hidden entities and labels.

use std::fmt::Write as _;
use std::path::Path;

use regrind_formats::{CadModel, FormatError, parse_cad};

/// Entity: type, status number, label, and parameters after the type.
type Entity<'a> = (u64, &'a str, &'a str, &'a str);

/// A bilinear patch over 0..2 x 0..2, of one length unit each.
const PATCH: &str =
    "1,1,1,1,0,0,1,0,0,0.,0.,1.,1.,0.,0.,1.,1.,1.,1.,1.,1.,0.,0.,0.,2.,0.,0.,0.,2.,0.,2.,2.,0.,0.,1.,0.,1.";

/// Writes a file in the fixed form. `unit` has the flag and the name of the unit.
fn file(unit: &str, entities: &[Entity]) -> String {
    let global =
        format!("1H,,1H;,4Hpart,8Hpart.igs,4Hhand,4Hhand,32,38,6,308,15,4Hpart,1.,{unit},1,0.01,15H20260101.000000,");
    let global = global + "1e-06,100.,4Hhand,4Hhand,11,0;";
    let mut text = format!("{:<72}S      1\n", "hand");
    let section = |text: &mut String, letter: char, content: &str| {
        for (i, piece) in content.as_bytes().chunks(72).enumerate() {
            let piece = std::str::from_utf8(piece).unwrap();
            writeln!(text, "{piece:<72}{letter}{:>7}", i + 1).unwrap();
        }
    };
    section(&mut text, 'G', &global);
    let (mut directory, mut parameters, mut line) = (String::new(), String::new(), 1);
    for (i, (kind, status, label, values)) in entities.iter().enumerate() {
        let number = 2 * i + 1;
        let content = format!("{kind},{values};");
        let pieces: Vec<&[u8]> = content.as_bytes().chunks(64).collect();
        let first = format!("{kind:>8}{line:>8}{0:>8}{0:>8}{0:>8}{0:>8}{0:>8}{0:>8}{status:>8}", 0);
        writeln!(directory, "{first}D{number:>7}").unwrap();
        let second = format!("{kind:>8}{0:>8}{0:>8}{1:>8}{0:>8}{2:>8}{2:>8}{label:>8}{0:>8}", 0, pieces.len(), "");
        writeln!(directory, "{second}D{:>7}", number + 1).unwrap();
        for piece in pieces {
            let piece = std::str::from_utf8(piece).unwrap();
            writeln!(parameters, "{piece:<64}{number:>8}P{line:>7}").unwrap();
            line += 1;
        }
    }
    let counts = format!("S      1G{:>7}D{:>7}P{:>7}", global.len().div_ceil(72), 2 * entities.len(), line - 1);
    format!("{text}{directory}{parameters}{counts:<72}T      1\n")
}

fn parse(unit: &str, entities: &[Entity]) -> Result<CadModel, FormatError> {
    parse_cad(Path::new("hand.igs"), file(unit, entities).as_bytes())
}

#[test]
fn unit_is_that_of_flag_and_name() {
    let side = |unit: &str| {
        let model = parse(unit, &[(128, "00000000", "PATCH", PATCH)]).ok()?;
        let [low, high] = model.faces[0].face.as_ref().unwrap().bounds();
        // The weights round the last digit.
        Some((1e9 * (high.x - low.x)).round() / 1e9)
    };
    assert_eq!(side("2,2HMM"), Some(2.0));
    assert_eq!(side("1,2HIN"), Some(50.8));
    assert_eq!(side("1,4HINCH"), Some(50.8));
    assert_eq!(side("3,2HCM"), Some(20.0));
    assert_eq!(side("2,"), Some(2.0));
    assert_eq!(side("2,2HIN"), None);
    assert_eq!(side("1,2HMM"), None);
    assert_eq!(side("12,"), None);
}

#[test]
fn label_keeps_its_zeros() {
    let name = |label: &str| parse("2,2HMM", &[(128, "00000000", label, PATCH)]).unwrap().faces[0].name.clone();
    assert_eq!(name("FACE10"), "FACE10");
    assert_eq!(name("0AB0"), "0AB0");
    assert_eq!(name(""), "");
}

#[test]
fn hidden_surface_is_left_out() {
    let (shown, hidden) = ((128, "00000000", "SHOWN", PATCH), (128, "01000000", "HIDDEN", PATCH));
    let names = |entities: &[Entity]| {
        parse("2,2HMM", entities).unwrap().faces.iter().map(|face| face.name.clone()).collect::<Vec<_>>()
    };
    assert_eq!(names(&[hidden, shown]), ["SHOWN"]);
    // A file of hidden surfaces alone has nothing else.
    assert_eq!(names(&[hidden]), ["HIDDEN"]);
}

#[test]
fn face_in_moved_subfigure_is_refused() {
    let readable = |instance: &str| {
        let entities = [
            (128, "00000000", "PATCH", PATCH),
            (308, "00000000", "", "0,5Hpatch,1,1"),
            (408, "00000000", "", instance),
        ];
        parse("2,2HMM", &entities).unwrap().faces[0].face.is_ok()
    };
    assert!(readable("3,0.,0.,0.,1."));
    assert!(readable("3,0.,0.,0."));
    assert!(!readable("3,5.,0.,0.,1."));
    assert!(!readable("3,0.,0.,0.,2."));
}

/// Parameters of another entity are not taken.
#[test]
fn back_pointer_is_checked() {
    let text = file("2,2HMM", &[(128, "00000000", "A", PATCH), (128, "00000000", "B", PATCH)]);
    let turned = text.replacen("       1P      1", "       3P      1", 1);
    assert_ne!(turned, text);
    let model = parse_cad(Path::new("hand.igs"), turned.as_bytes()).unwrap();
    assert_eq!(model.faces.iter().map(|face| face.face.is_ok()).collect::<Vec<_>>(), [false, true]);
}
