//! Lens files of Zemax and Code V, against the sag that their formulas and other readers give.

use std::path::{Path, PathBuf};

use regrind_core::geometry::Aperture;
use regrind_core::surface::SurfaceChoice;
use regrind_core::surface::analytic::Sampling;
use regrind_formats::{ChoiceError, FormatError, parse_lens, read_lens};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lens")
}

/// Types that are refused by their names, surfaces with a peak, and a file without a unit.
const REFUSED: [&str; 5] = ["CV-XTO", "CV-AAS", "ODDASPHE", "XOSPHERE", "unit-missing-is-mm"];

#[test]
fn sags_match_formulas() {
    let text = std::fs::read_to_string(folder().join("truth.csv")).unwrap();
    let (mut wrong, mut count) = (Vec::new(), 0);
    for line in text.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        let (file, number): (_, usize) = (cells[0], cells[1].parse().unwrap());
        if REFUSED.iter().any(|kind| file.starts_with(kind)) {
            continue;
        }
        let [x, y, z] = [2, 3, 4].map(|k| cells[k].parse::<f64>().unwrap());
        let lens = read_lens(folder().join(file)).unwrap_or_else(|error| panic!("{error}"));
        let found = match lens.choose(Some(&SurfaceChoice::Number(number))) {
            Ok(surface) => surface.surface.as_ref().unwrap().sag(x, y),
            Err(error) => {
                wrong.push(format!("{file}: {error}"));
                continue;
            }
        };
        count += 1;
        if found.is_none_or(|found| (found - z).abs() > 2e-12) {
            wrong.push(format!("{file} at {x}, {y}: {found:?} instead of {z}"));
        }
    }
    wrong.dedup_by_key(|line| line.split(' ').next().map(ToOwned::to_owned));
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(count > 400, "{count}");
}

/// Returns the only curved surface of the text of a lens, or why there is none.
fn only_surface(name: &str, text: &str) -> Result<f64, String> {
    let lens = parse_lens(Path::new(name), text.as_bytes()).map_err(|error| error.to_string())?;
    let surface = lens.choose(None).map_err(|error| error.to_string())?;
    Ok(surface.surface.as_ref().unwrap().sag(3.0, 4.0).unwrap())
}

/// Each of these would be read with a term, a unit or a change of the lens lost.
#[test]
fn statements_of_codev_that_would_be_lost_are_refused() {
    let lens = |statements: &str| format!("RDM;LEN\nDIM M\nSO 0 1e13\nS 85 5 BK7\n{statements}\nSI 0 0\nGO\n");
    let good = only_surface("a.seq", &lens("ASP; K -0.7; A 2e-6; B -1e-9")).unwrap();
    assert!(
        (good - (25.0 / 85.0 / (1.0 + (1.0 - 0.3 * 25.0 / 7225.0f64).sqrt()) + 2e-6 * 625.0 - 1e-9 * 15625.0)).abs()
            < 1e-12
    );
    for (statements, found) in [
        ("ASP; A 2e-6 B -1e-9", "line 5"),
        ("ASP; A 2e-6 &\n B -1e-9", "line 5"),
        ("SPS XYP; SCO C4 1e-4 C5 2e-4", "line 5"),
        ("SPS XYP; SCO C4 1e-4; C9 1e-5", "SCO before"),
        ("K -0.7 0", "line 5"),
        ("CON; RDY 85 100", "line 5"),
    ] {
        let refused = only_surface("a.seq", &lens(statements)).unwrap_err();
        assert!(refused.contains(found), "{statements}: {refused}");
    }
    for change in [
        "SCA 2",
        "DEL S1",
        "INS S1",
        "FLY S1..2",
        "INT S1 def.int",
        "ZOO RDY S1 85 90",
        "PIK RDY S1 S2 -1",
        "IN more.seq",
    ] {
        let text = lens("ASP; K -0.7").replace("GO\n", &format!("{change}\nGO\n"));
        let refused = only_surface("a.seq", &text).unwrap_err();
        assert!(refused.contains("changes surfaces afterwards"), "{change}: {refused}");
    }
    // A zoom of a field, and a pickup of a thickness, change no shape.
    for other in ["ZOO 2; ZOO YAN F1 0 1", "PIK THI S1 S2"] {
        let text = lens("ASP; K -0.7; A 2e-6; B -1e-9").replace("GO\n", &format!("{other}\nGO\n"));
        assert_eq!(only_surface("a.seq", &text), Ok(good), "{other}");
    }
    // RDM holds from where it stands, and a lens ends with its image surface.
    let late = lens("ASP; K -0.7; A 2e-6; B -1e-9").replace("GO\n", "RDM N\nGO\n");
    assert_eq!(only_surface("a.seq", &late), Ok(good));
    let cut = lens("ASP; K -0.7; A 2e-6").replace("SI 0 0\nGO\n", "");
    assert!(only_surface("a.seq", &(cut + &"! a remark\n".repeat(6000))).is_err());
}

#[test]
fn lines_of_zemax_that_would_be_lost_are_refused() {
    let lens = |lines: &str| {
        format!(
            "UNIT MM\nSURF 0\n  TYPE STANDARD\n  CURV 0\nSURF 1\n{lines}\n  DIAM 5\nSURF 2\n  TYPE STANDARD\n  CURV 0\n"
        )
    };
    let asphere = "  TYPE EVENASPH\n  CURV 0.01\n  PARM 2 1e-6";
    let good = only_surface("a.zmx", &lens(asphere)).unwrap();
    let commented = asphere.replace("  PARM", "! a remark\n  PARM");
    assert_eq!(only_surface("a.zmx", &lens(&commented)), Ok(good), "a remark belongs to no surface");
    let polynomial = "  TYPE XPOLYNOM\n  CURV 0\n  XDAT 1 3\n  XDAT 2 1\n  XDAT 3 1e-3\n  XDAT 4 0\n  XDAT 5 1e-4";
    assert!(only_surface("a.zmx", &lens(polynomial)).is_ok());
    for (lines, found) in [
        (asphere.replace("  PARM", "  CURV 0.02\n  PARM"), "once"),
        (format!("{asphere}\n  PARM 2 0"), "once"),
        (format!("{asphere}\n  PARM 9 1e-9"), "parameter 9"),
        (format!("{asphere}\n  XDAT 1 1"), "extra data 1"),
        ("  TYPE BICONICX\n  CURV 0.01\n  PARM 3 1e-5".to_owned(), "parameter 3"),
        ("  TYPE STANDARD\n  RADI 100".to_owned(), "CURV"),
        (polynomial.replace("\n  XDAT 5 1e-4", ""), "extra data 5"),
        (asphere.replace("EVENASPH", "XYPOLY"), "XYPOLY"),
    ] {
        let refused = only_surface("a.zmx", &lens(&lines)).unwrap_err();
        assert!(refused.contains(found), "{lines}: {refused}");
    }
    let no_unit = only_surface("a.zmx", &lens(asphere).replace("UNIT MM\n", "VERS 1\n")).unwrap_err();
    assert!(no_unit.contains("no unit"), "{no_unit}");
    let cut = lens(asphere);
    let cut = cut.split("SURF 2").next().unwrap();
    assert!(only_surface("a.zmx", cut).unwrap_err().contains("ends with it"));
}

/// The term of the first power has a peak on the axis. Without it, odd aspheres are read.
#[test]
fn odd_aspheres_are_read_without_peak() {
    let text = std::fs::read_to_string(folder().join("truth.csv")).unwrap();
    for (file, line) in [("ODDASPHE-in-utf8.zmx", "PARM 1 "), ("XOSPHERE-mm-utf8.zmx", "XDAT 3 ")] {
        let lens = std::fs::read_to_string(folder().join(file)).unwrap();
        let first = lens.lines().find(|l| l.trim().starts_with(line)).unwrap();
        let slope: f64 = first.split_whitespace().nth(2).unwrap().parse().unwrap();
        let refused = parse_lens(Path::new(file), lens.as_bytes()).unwrap();
        assert!(matches!(refused.choose(None), Err(ChoiceError::Unreadable { number: 1, .. })), "{file}");

        let flat = lens.replace(first, &format!("  {line}0.0"));
        let flat = parse_lens(Path::new(file), flat.as_bytes()).unwrap();
        let surface = flat.choose(None).unwrap().surface.as_ref().unwrap();
        // The slope has no unit; a normalised coefficient is a length over the normalisation radius.
        let radius = lens
            .lines()
            .find_map(|l| l.trim().strip_prefix("XDAT 2 "))
            .map(|l| l.split_whitespace().next().unwrap().parse::<f64>().unwrap());
        let slope = slope / radius.unwrap_or(1.0);
        for row in text.lines().filter(|row| row.starts_with(file)) {
            let cells: Vec<f64> = row.split(',').skip(2).map(|cell| cell.parse().unwrap()).collect();
            let [x, y, z] = cells[..] else { panic!("{row}") };
            let found = surface.sag(x, y).unwrap() + slope * x.hypot(y);
            assert!((found - z).abs() < 2e-12, "{row}: {found}");
        }
    }
}

#[test]
fn semi_diameter_becomes_outline() {
    let lens = read_lens(folder().join("EVENASPH-in.zmx")).unwrap();
    let surface = lens.choose(None).unwrap();
    let sampling = Sampling::Spacing { spacing_mm: 1.0 };
    let Aperture::Circle { radius_mm, .. } = surface.defined(None, sampling).unwrap().aperture().clone() else {
        panic!("a circle")
    };
    assert!((radius_mm - 15.0).abs() < 1e-9, "{radius_mm}");
    // Code V has an aperture only if a statement gives one.
    let lens = read_lens(folder().join("CV-ASP-mm.seq")).unwrap();
    let surface = lens.choose(None).unwrap();
    assert_eq!(surface.defined(None, sampling), Err(ChoiceError::NoOutline { number: 1 }));
    let given = Aperture::Circle { centre_mm: [0.0; 2], radius_mm: 12.0 };
    assert_eq!(surface.defined(Some(given.clone()), sampling).unwrap().aperture(), &given);
}

#[test]
fn surface_of_lens_is_chosen() {
    let text = "UNIT MM\nSURF 0\n  TYPE STANDARD\n  CURV 0.0\nSURF 1\n  COMM front\n  TYPE STANDARD\n  CURV 0.01\n  DIAM 5\n\
                SURF 2\n  TYPE COORDBRK\n  PARM 3 5\nSURF 3\n  COMM back\n  TYPE STANDARD\n  CURV -0.02\n  DIAM 5\n\
                SURF 4\n  TYPE BINARY_2\n  CURV 0\n  PARM 1 3\n";
    let lens = parse_lens(Path::new("a.zmx"), text.as_bytes()).unwrap();
    assert_eq!(lens.choose(None), Err(ChoiceError::SeveralSurfaces { numbers: vec![1, 3, 4] }));
    assert_eq!(lens.choose(Some(&SurfaceChoice::Name("back".into()))).unwrap().number, 3);
    let coordinate_break = lens.choose(Some(&SurfaceChoice::Number(2)));
    assert!(matches!(coordinate_break, Err(ChoiceError::Unreadable { number: 2, .. })));
    let unknown = lens.choose(Some(&SurfaceChoice::Number(4)));
    assert!(matches!(unknown, Err(ChoiceError::Unreadable { number: 4, .. })));
    let missing = ChoiceError::NoSurface { number: 9, numbers: vec![0, 1, 2, 3, 4] };
    assert_eq!(lens.choose(Some(&SurfaceChoice::Number(9))), Err(missing));
}

/// Some programs remove the blanks in front of all lines. If only some lines lack them, the file is damaged.
#[test]
fn lines_of_zemax_without_blanks_are_read() {
    let path = Path::new("a.zmx");
    for name in ["EVENASPH-mm-utf8.zmx", "XPOLYNOM-in-utf8.zmx"] {
        let text = std::fs::read_to_string(folder().join(name)).unwrap();
        let stripped: String = text.lines().map(|line| format!("{}\n", line.trim_start())).collect();
        let [stripped, plain] = [&stripped, &text].map(|text| parse_lens(path, text.as_bytes()).unwrap());
        assert_eq!(stripped, plain, "{name}");
        let one = text.replacen("  CONI", "CONI", 1);
        let refused = parse_lens(path, one.as_bytes());
        assert!(matches!(refused, Err(FormatError::Unexpected { .. })), "{name}: {refused:?}");
    }
}

/// An elliptic aperture is an outline. One that the user drew is in another file: an aperture must be given.
#[test]
fn other_apertures_of_zemax_are_known() {
    let path = Path::new("a.zmx");
    let text = std::fs::read_to_string(folder().join("EVENASPH-mm-utf8.zmx")).unwrap();
    let aperture = |line: &str| {
        let lens = parse_lens(path, text.replacen("  CONI", &format!("  {line}\n  OBDC 1 -2\n  CONI"), 1).as_bytes());
        lens.unwrap().choose(None).unwrap().aperture.clone()
    };
    let ellipse = Aperture::Ellipse { centre_mm: [1.0, -2.0], semi_axes_mm: [4.0, 3.0] };
    assert_eq!(aperture("ELAP 4 3 0"), Some(ellipse));
    assert_eq!(aperture("USAP 4 3 0"), None);
}

/// Zernike terms that are not extrapolated end at the normalisation radius about their centre. The outline decides,
/// whether the file states it or an aperture is given.
#[test]
fn zernike_terms_end_at_their_disc() {
    let sampling = Sampling::Spacing { spacing_mm: 1.0 };
    let circle = |radius_mm: f64| Some(Aperture::Circle { centre_mm: [0.0; 2], radius_mm });
    let is_beyond = |text: &str, aperture: Option<Aperture>| {
        let lens = parse_lens(Path::new("a"), text.as_bytes()).unwrap();
        match lens.choose(Some(&SurfaceChoice::Number(1))).unwrap().defined(aperture, sampling) {
            Ok(_) => false,
            Err(ChoiceError::Unreadable { number: 1, .. }) => true,
            Err(other) => panic!("{other}"),
        }
    };
    // The terms have the radius 18 mm, and their centre is at (1.5, -2.25) mm, 2.704 mm from the axis.
    let text = std::fs::read_to_string(folder().join("SZERNSAG-decentred-mm-utf8.zmx")).unwrap();
    let zemax = |is_extrapolated: u8| {
        let kept: String =
            text.lines().filter(|line| !line.starts_with("  PARM 0 ")).map(|line| format!("{line}\n")).collect();
        kept.replacen("  CONI", &format!("  PARM 0 {is_extrapolated}\n  CONI"), 1)
    };
    assert!(!is_beyond(&zemax(0), None) && !is_beyond(&zemax(0), circle(15.29)));
    assert!(is_beyond(&zemax(0), circle(15.31)) && !is_beyond(&zemax(1), circle(15.31)));
    let rectangle = |width_mm: f64| Some(Aperture::Rectangle { centre_mm: [1.5, -2.25], width_mm, height_mm: 20.0 });
    // A corner is sqrt(14.966^2 + 10^2) = 18 mm away.
    assert!(!is_beyond(&zemax(0), rectangle(29.93)) && is_beyond(&zemax(0), rectangle(29.94)));
    let larger = zemax(0).replacen("  DIAM 1.5", "  DIAM 1.6", 1);
    assert!(is_beyond(&larger, None) && !is_beyond(&larger, circle(15.0)));
    // Terms without values, and terms of another surface, have no disc.
    let plain = zemax(0).replacen("  XDAT 1 2.2", "  XDAT 1 0.0", 1);
    assert!(!is_beyond(&plain, circle(20.0)));

    let codev = std::fs::read_to_string(folder().join("CV-ZFR-mm.seq")).unwrap();
    assert!(!is_beyond(&codev, circle(18.0)) && is_beyond(&codev, circle(18.1)));
}

/// A label in quotes can look like the name of a surface, a keyword or a number.
#[test]
fn label_of_code_v_in_quotes_is_text() {
    let text = std::fs::read_to_string(folder().join("CV-SPH-mm.seq")).unwrap();
    for label in ["S0", "S99", "K", "1.5", "front & back; no. 1"] {
        let text = text.replacen("  STO", &format!("  STO\n  SLB '{label}'"), 1);
        let lens = parse_lens(Path::new("a.seq"), text.as_bytes()).unwrap();
        assert_eq!(lens.choose(Some(&SurfaceChoice::Name(label.into()))).unwrap().number, 1, "{label}");
    }
}

fn codev_sag(text: &str) -> Option<f64> {
    let lens = parse_lens(Path::new("a.seq"), text.as_bytes()).unwrap();
    lens.choose(Some(&SurfaceChoice::Number(1))).unwrap().surface.as_ref().unwrap().sag(1.0, 2.0)
}

/// The last statement about a curvature holds, whether it is a radius, a curvature or that of `S`.
#[test]
fn last_curvature_of_code_v_holds() {
    let text = std::fs::read_to_string(folder().join("CV-SPH-mm.seq")).unwrap();
    let with = |statements: &str| text.replacen("  STO", &format!("  STO; {statements}"), 1);
    let sag = |radius: &str| codev_sag(&with(&format!("RDY {radius}")));
    assert_eq!(codev_sag(&with("CUY 0.02; RDY 80")), sag("80"));
    assert_eq!(codev_sag(&with("RDY 80; CUY 0.02")), sag("50"));
    assert_eq!(codev_sag(&with("CUY 0.02; RDY 0")), sag("0"));
    assert_eq!(codev_sag(&with("CUY 0.02; S1 80")), sag("80"));
    let toroid = std::fs::read_to_string(folder().join("CV-YTO-mm.seq")).unwrap();
    let with = |statements: &str| codev_sag(&toroid.replacen("  RDX -52", &format!("  {statements}"), 1));
    assert_eq!(with("CUX 0.02; RDX -52"), codev_sag(&toroid));
    assert_eq!(with("RDX -52; CUX 0.02"), with("RDX 50"));
    assert_eq!(with("CUX 0.02; RDX 0"), with("RDX 0"));
}

/// A surface is named when it is there: neither a gap in the numbers nor a statement ahead of its surface is read.
#[test]
fn missing_surfaces_of_code_v_are_refused() {
    let text = std::fs::read_to_string(folder().join("CV-addressed.seq")).unwrap();
    let is_refused = |text: &str| match parse_lens(Path::new("a.seq"), text.as_bytes()) {
        Ok(_) => false,
        Err(FormatError::Unexpected { .. }) => true,
        Err(other) => panic!("{other}"),
    };
    assert!(!is_refused(&text));
    for (from, to) in [
        ("S2 0 0", "S3 0 0"),
        ("S2 0 0", "S2 0 0\nS4 0 0"),
        ("K S1", "K S4"),
        ("A S1", "A S9"),
        ("ASP S1", "ASP S1..2"),
        ("S1 0 5", "K -1\nS1 0 5"),
    ] {
        assert!(is_refused(&text.replacen(from, to, 1)), "{to}");
    }
    // Statements that are not read can name any word.
    assert!(!is_refused(&text.replacen("STO S1", "STO S9\nTIT S99", 1)));
}

/// A coefficient with two names is taken once; one without a meaning for its type is refused.
#[test]
fn coefficients_of_code_v_are_taken_once() {
    let base = |name: &str| std::fs::read_to_string(folder().join(name)).unwrap();
    let read = |name: &str, statements: &str| -> Option<f64> {
        let text = base(name).replacen("\nS     0.0", &format!("\n  {statements}\nS     0.0"), 1);
        assert!(text.contains(statements));
        let lens = parse_lens(Path::new("a.seq"), text.as_bytes()).unwrap();
        match lens.choose(Some(&SurfaceChoice::Number(1))) {
            Ok(surface) => surface.surface.as_ref().unwrap().sag(1.0, 2.0),
            Err(ChoiceError::Unreadable { number: 1, .. }) => None,
            Err(other) => panic!("{other}"),
        }
    };
    // Each file has K or C1 of -0.7, and the normalisation radii 15 (XYP), 18 (ZFR) and 16 (QBF, QCN).
    for (name, same, refused) in [
        (
            "CV-XYP-nrad-mm.seq",
            "SCO C1 -0.7",
            &["SCO C1 -0.5", "K -0.5", "SCO C67 20", "SCO C01 1", "A 1e-9", "SPS XYP 14"][..],
        ),
        ("CV-XYP-mm.seq", "K -0.7; SCO C66 0", &["SPS XYP 15", "SCO NRADIUS 0", "SCO NRADIUS -1", "SCO QB4 1"]),
        ("CV-ZFR-mm.seq", "SCO K -0.7; SCO C3 18; SPS ZFR 18", &["K -0.6", "SCO C3 17", "SCO C2 1", "SCO C41 1"]),
        (
            "CV-QBF-mm.seq",
            "SCO C1 16; SCO C3 5.00000000000000028e-02",
            &["SCO C3 0.01", "SCO C1 17", "SCO QB5 1", "SCO C2 1"],
        ),
        ("CV-QCN-mm.seq", "SCO C17 -0.7; SCO C1 16", &["SCO C17 -0.5", "SCO C18 1", "SCO C3 1", "SPS QCN 15"]),
        ("CV-ASP-mm.seq", "SCO C4 0", &["SCO C4 1"]),
        ("CV-SPH-mm.seq", "A 0", &["SCO K 1", "A 1e-9"]),
    ] {
        let plain = read(name, "! nothing");
        assert!(plain.is_some() && read(name, same) == plain, "{name}");
        for statements in refused {
            assert_eq!(read(name, statements), None, "{name}: {statements}");
        }
    }
}

/// Names of private glasses can be any word.
#[test]
fn private_glasses_of_code_v_are_left_out() {
    let text = std::fs::read_to_string(folder().join("CV-ASP-mm.seq")).unwrap();
    let glasses = "  STO\n  PRV\n  PWL 656.3 587.6\n    K 1.5 1.6\n    'S' 1.5 1.6\n    S 1.5 1.6\n  ";
    let with = text.replacen("  STO", &format!("{glasses}END"), 1);
    assert!(with.contains("PRV"));
    assert_eq!(codev_sag(&with), codev_sag(&text));
    let open = parse_lens(Path::new("a.seq"), text.replacen("  STO", glasses, 1).as_bytes());
    assert!(matches!(open, Err(FormatError::Unexpected { .. })), "{open:?}");
}

/// Surfaces need more memory than their lines have bytes.
#[test]
fn too_many_surfaces_are_refused() {
    let path = Path::new("a.zmx");
    let zemax = format!("UNIT MM\n{}", "SURF 1\nCURV 0\n".repeat(10_001));
    assert!(matches!(parse_lens(path, zemax.as_bytes()), Err(FormatError::Unexpected { .. })));
    let codev = format!("RDM;SO;SI;{}", "S;".repeat(10_001));
    assert!(matches!(parse_lens(path, codev.as_bytes()), Err(FormatError::Unexpected { .. })));
}

#[test]
fn damaged_lens_files_are_refused() {
    let path = Path::new("a.zmx");
    let text = std::fs::read_to_string(folder().join("EVENASPH-mm-utf8.zmx")).unwrap();
    assert!(parse_lens(path, text.replace("UNIT MM", "UNIT FT").as_bytes()).is_err());
    assert!(parse_lens(path, text.replace("  CURV ", "  CURV x").as_bytes()).is_err());
    assert!(parse_lens(path, text.replace("SURF 1", "SURF one").as_bytes()).is_err());
    assert!(parse_lens(path, b"x,y,z\n1,2,3\n").is_err());
    // A number of S without RDM can be a radius or a curvature.
    let codev = std::fs::read_to_string(folder().join("CV-SPH-mm.seq")).unwrap();
    let silent = parse_lens(path, codev.replace("RDM", "TITLE 'x'").as_bytes()).unwrap();
    assert!(matches!(silent.choose(Some(&SurfaceChoice::Number(1))), Err(ChoiceError::Unreadable { .. })));
    assert!(parse_lens(path, codev.replace("RDM", "RDM MAYBE").as_bytes()).is_err());
    let unitless = parse_lens(path, codev.replace("DIM", "DUM").as_bytes()).unwrap();
    assert!(matches!(unitless.choose(Some(&SurfaceChoice::Number(1))), Err(ChoiceError::Unreadable { .. })));
    assert!(parse_lens(path, codev.replace("DIM   M", "DIM   F").as_bytes()).is_err());
}

/// `RDM N` and `RDM NO` say that the numbers of S are curvatures, as lens files of others are written.
#[test]
fn short_words_of_code_v_are_read() {
    let text = std::fs::read_to_string(folder().join("CV-SPH-mm.seq")).unwrap();
    let sag = |text: &str| {
        let lens = parse_lens(Path::new("a.seq"), text.as_bytes()).unwrap();
        lens.choose(Some(&SurfaceChoice::Number(1))).map(|found| found.surface.as_ref().unwrap().sag(1.0, 2.0))
    };
    let radius: f64 = {
        let line = text.lines().find(|line| line.starts_with("S ")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse().unwrap()
    };
    let curvature = text.replace(&format!("S     {radius}"), &format!("S {:e}", 1.0 / radius));
    let expected = sag(&text).unwrap().unwrap();
    for word in ["N", "NO", "n"] {
        let found = sag(&curvature.replacen("RDM", &format!("RDM {word}"), 1)).unwrap().unwrap();
        assert!((found - expected).abs() < 1e-13, "{word}: {found} instead of {expected}");
    }
    assert_eq!(sag(&text.replacen("RDM", "RDM Y", 1)).unwrap(), Some(expected));
}

/// `ADX` and `ADY` move the aperture of a surface; an outline that is turned or an ellipse is not known.
#[test]
fn aperture_of_code_v_is_moved() {
    let text = std::fs::read_to_string(folder().join("CV-SPH-mm.seq")).unwrap();
    let with = |statements: &str| text.replacen("  STO", &format!("  STO\n  {statements}"), 1);
    let aperture = |statements: &str| {
        let lens = parse_lens(Path::new("a.seq"), with(statements).as_bytes()).unwrap();
        lens.choose(Some(&SurfaceChoice::Number(1))).map(|found| found.aperture.clone()).ok()
    };
    let moved = Aperture::Rectangle { centre_mm: [0.0, 9.5], width_mm: 6.0, height_mm: 8.0 };
    assert_eq!(aperture("REX 3; REY 4; ADY 9.5; ARO 0"), Some(Some(moved)));
    let moved = Aperture::Circle { centre_mm: [-2.0, 0.0], radius_mm: 3.0 };
    assert_eq!(aperture("CIR 3; ADX -2"), Some(Some(moved)));
    assert_eq!(aperture("REX 3; REY 4; ARO 30"), None);
    assert_eq!(aperture("ELX 3; ELY 4"), None);
}
