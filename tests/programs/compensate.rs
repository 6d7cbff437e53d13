//! Tests of `regrind compensate`: existing programs, corrected by a map.

use std::fs;
use std::path::PathBuf;

use crate::path::{ProgramStep, correction, error_mm, part, read, with};
use crate::program::run;
use regrind::compensation::{Correction, ErrorMap};
use regrind::formats::{CorrectionIdentities, ErrorMapOrigin, write_correction, write_error_map};
use regrind::geometry::Grid;
use regrind_sim::motion::Waypoint;
use regrind_sim::program::Control;

const GRID: Grid = Grid { columns: 121, rows: 81, first_mm: [-30.0, -20.0], spacing_mm: [0.5, 0.5] };
const PART: [u8; 32] = [0xab; 32];

/// Folder with a map of the error over 60 x 40 mm and a program.
pub struct Shop {
    folder: tempfile::TempDir,
}

impl Shop {
    pub fn new(error: impl Fn(f64, f64) -> f64, program: &str) -> Self {
        let bench = Self { folder: tempfile::tempdir().unwrap() };
        bench.save_error(error, None);
        fs::write(bench.path("base.ngc"), program).unwrap();
        bench
    }

    /// Writes the map as a run does.
    fn save_error(&self, error: impl Fn(f64, f64) -> f64, ground_with: Option<[u8; 32]>) {
        let values_mm = (0..GRID.len()).map(|k| GRID.place_mm(k)).map(|[x, y]| error(x, y)).collect();
        let map = ErrorMap::exact(GRID, values_mm, vec![true; GRID.len()]);
        let origin = ErrorMapOrigin { part: PART, cycle: 1, ground_with };
        write_error_map(&self.path("map.csv"), &map, &origin, true).unwrap();
    }

    /// Writes a correction as a run does, with this map's identity.
    fn save_correction(&self, map: [u8; 32]) {
        let identities = CorrectionIdentities { part: PART, map, replaces: [1; 32] };
        write_correction(&self.path("map.csv"), &Correction::zero(GRID, 0.02), (&identities, &[]), true).unwrap();
    }

    fn folder(&self) -> &std::path::Path {
        self.folder.path()
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn compensate(&self, more: &[&str]) -> Result<String, String> {
        self.correct("base.ngc", "out.ngc", more)
    }

    fn correct(&self, base: &str, out: &str, more: &[&str]) -> Result<String, String> {
        let mut arguments = vec!["compensate", "--program", base, "--map", "map.csv", "--out", out];
        arguments.extend(more);
        let (code, _, said) = run(&arguments, self.folder.path());
        match code {
            0 => Ok(fs::read_to_string(self.path(out)).unwrap()),
            2 => Err(said),
            _ => panic!("exit code {code}: {said}"),
        }
    }
}

/// Returns the end points of the moves at feed.
fn feeds(text: &str) -> Vec<[f64; 3]> {
    read(text).into_iter().filter(|s| s.feed).map(|s| s.at).collect()
}

/// Returns the largest distance of a polyline from the corrected path above it: z minus the error, at every x and y on
/// the way.
fn worst_mm(points: &[[f64; 3]], z: f64, error: impl Fn(f64, f64) -> f64) -> f64 {
    let mut worst = 0.0f64;
    for pair in points.windows(2) {
        for k in 0..=20 {
            let t = f64::from(k) / 20.0;
            let [x, y, at] = [0, 1, 2].map(|c| pair[0][c] + t * (pair[1][c] - pair[0][c]));
            worst = worst.max((at - (z - error(x, y))).abs());
        }
    }
    worst
}

#[test]
fn compensate_splits_long_lines() {
    // Flat on the left, a wave on the right.
    let error = |x: f64, _: f64| if x > 0.0 { 5e-3 * (1.0 - (0.4 * x).cos()) } else { 0.0 };
    let bench = Shop::new(error, "G21 G90 G17\nG0 Z5\nG0 X-28 Y3\nG1 Z1 F500\nG1 X28 Y3\nG0 Z5\nM2\n");
    let text = bench.compensate(&[]).unwrap();
    let points = feeds(&text);
    assert!(points.len() > 20 && points.len() < 200, "{}", points.len());
    assert!(points.iter().filter(|p| p[0] < -2.0).count() <= 3, "the flat part is not divided");
    assert_eq!(points[0], [-28.0, 3.0, 1.0]);
    let worst = worst_mm(&points, 1.0, error);
    assert!(worst < 1.1e-4, "{worst}");
    assert!(
        text.contains("(base: sha256 ")
            && text.contains("(map: sha256 ")
            && text.contains("(SIMULATION)")
            && text.contains("F500")
    );
    // Half of the gain is half of the correction.
    let half = feeds(&bench.correct("base.ngc", "half.ngc", &["--gain", "0.5"]).unwrap());
    assert!((half.last().unwrap()[2] - (1.0 - 0.5 * error(28.0, 3.0))).abs() < 1e-6);
}

#[test]
fn compensate_leaves_rapids_and_g53() {
    let program = "%\n(head)\nN10 G21 G90 G54\nN20 G53 G0 Z0\nN30 G0 X0 Y0\nN40 G0 Z2.5 M8\nN50 G1 X10 Y5 F200 S3000\nN60 G53 G0 Z0\nN70 X1 Y1\nN80 M30\n%\n";
    let bench = Shop::new(error_mm, program);
    let text = bench.compensate(&[]).unwrap();
    assert!(text.starts_with("%\n(Regrind ") && text.trim_end().ends_with("%"));
    assert_eq!(text.matches("G53 G0 Z0").count(), 2);
    assert!(
        text.contains("G0 X0.000000 Y0.000000\n")
            && text.contains("M8\nG0 Z2.500000\n")
            && text.contains("F200 S3000\n")
    );
    // After the rapid move, the tool moves to the start of the corrected path.
    let points = feeds(&text);
    assert!((points[0][2] - (2.5 - error_mm(0.0, 0.0))).abs() < 1e-6 && points[0][0] == 0.0);
    assert!(worst_mm(&points, 2.5, error_mm) < 1.1e-4);
}

#[test]
fn arcs_remain_under_constant_correction() {
    let program = "G21 G90 G17\nG0 X10 Y0 Z1\nG1 Z0 F300\nG3 X0 Y10 I-10 J0\nG2 X10 Y0 R10\nG3 X10 Y0 I-10\nM2\n";
    let constant = Shop::new(|_, _| 0.004, program).compensate(&[]).unwrap();
    assert!(constant.contains("G3 X0.000000 Y10.000000 Z-0.004000 I-10.000000 J0.000000\n"), "{constant}");
    assert!(constant.contains("G2 X10.000000 Y0.000000 Z-0.004000 I0.000000 J-10.000000\n"), "{constant}");
    assert_eq!(constant.matches("\nG3 ").count(), 2);
    let bench = Shop::new(error_mm, program);
    let text = bench.compensate(&[]).unwrap();
    assert!(!text.contains("G3 X") && !text.contains("G2 X"));
    let points = feeds(&text);
    let off = points[1..].windows(2).map(|pair| {
        let middle = [0, 1].map(|k| 0.5 * (pair[0][k] + pair[1][k]));
        // The first and the last arc are about the origin, the other about the same place from outside.
        (middle[0].hypot(middle[1]) - 10.0).abs()
    });
    assert!(off.fold(0.0, f64::max) < 1e-4);
    assert!(points.iter().all(|p| (p[2] + error_mm(p[0], p[1])).abs() < 1e-6));
    let turned = points.last().unwrap();
    assert!((turned[0] - 10.0).abs() < 1e-6 && turned[1].abs() < 1e-6);
}

#[test]
fn compensate_planes_inches_and_relative() {
    let side = "G21 G90 G18\nG0 X0 Y2 Z10\nG1 X0.001 F100\nG2 X10 Z0 I-0.001 K-10\nM2\n";
    let text = Shop::new(|_, _| 0.003, side).compensate(&[]).unwrap();
    assert!(text.contains("G2 X10.000000 Y2.000000 Z-0.003000"), "{text}");
    let inches = "G20 G90\nG0 X0 Y0 Z0.1\nG1 Z0 F10\nG1 X1\nM2\n";
    let text = Shop::new(|_, _| 0.00254, inches).compensate(&[]).unwrap();
    assert!(text.contains("G1 X1.00000000 Y0.00000000 Z-0.00010000\n"), "{text}");
    let relative = "G21 G91\nG90 G0 X1 Y1 Z1\nG91 G1 X2 F100\nX3 Z-0.5\nG0 Z4\nM2\n";
    let text = Shop::new(|_, _| 0.002, relative).compensate(&[]).unwrap();
    assert!(text.contains("G1 X6.000000 Y1.000000 Z0.498000\n") && text.contains("G0 Z4.500000\n"), "{text}");
    assert!(!text.contains("G91"));
}

#[test]
fn compensate_refuses_unknown_motion() {
    for (line, words) in [
        ("G81 X1 Y1 Z-1 R2", "canned cycle"),
        ("O100 call", "O-word"),
        ("G1 X#1", "variable"),
        ("G1 X[1+1]", "variable"),
        ("G41 D1", "radius"),
        ("G92 X0", "zero"),
        ("G93", "time of a move"),
        ("G5.2 X1", "zero"),
        ("G1 X1 A5", "turns the part"),
        ("M98 P1", "subprogram"),
        ("/G1 X1", "slash"),
        ("G2 X1 Y1", "centre"),
        ("G2 X1 Y1 I9 J9", "radius"),
        ("G1 X1 X2", "twice"),
        ("G80\nX5", "no G0"),
        ("G53 G2 X1 Y1 I1", "G53"),
        ("G1 X1\nG55 G1 X1", "zero"),
        ("G53 G0 Z0\nG1 X2", "position of Z is unknown"),
        ("G91\nG53 G0 Z0", "G53"),
        ("G1 X1e3", "is unknown"),
        ("E5", "is unknown"),
        ("G91\nG0 X1000000000\nX1000000000", "the limit is"),
        ("G43 H1\nG1 X2", "position of Z is unknown"),
        ("G49\nG1 X2", "position of Z is unknown"),
        ("M6 T2\nG1 X2", "position of XYZ"),
        ("G91\nG28 Z0\nG1 X2", "position of Z is unknown"),
        ("G1 X1 R5", "R5 has no meaning"),
        ("G1 X1 I5", "I5 has no meaning"),
        ("I5 J5", "I5 has no meaning"),
        ("G4 X2.", "X2. has no meaning"),
        ("G1 X1 P2", "P2 has no meaning"),
        ("G1 X1 H2", "H2 has no meaning"),
        ("G0 G1 X2", "only one"),
        ("G1 X2 G90 G91", "only one"),
        ("G2 X9 I4 P2", "P lets"),
        ("M3 M5", "only one"),
        ("G1 X1 F100 F200", "F occurs twice"),
        ("G1 X1\nA0", "turns the part"),
        ("G0 A90", "turns the part"),
        ("G10 L2 P1 X5", "the tool or the zero"),
        ("G52 X1", "zero"),
    ] {
        let bench = Shop::new(error_mm, &format!("G21 G90\nG0 X0 Y0 Z1\nG1 Z0 F100\n{line}\nM2\n"));
        let said = bench.compensate(&[]).expect_err(line);
        let number = 3 + line.lines().count();
        assert!(said.contains(words) && said.contains(&format!("line {number}")), "{line}: {said}");
        assert!(!bench.path("out.ngc").exists(), "{line}");
    }
    let lost = Shop::new(error_mm, "G21 G90\nG1 X1 F100\nM2\n").compensate(&[]).unwrap_err();
    assert!(lost.contains("XYZ") && lost.contains("G0"), "{lost}");
}

#[test]
fn compensate_preserves_modal_state() {
    let kept = |program: &str, lines: &[&str]| {
        let text = Shop::new(|_, _| 0.004, program).compensate(&[]).unwrap_or_else(|said| panic!("{program}: {said}"));
        lines.iter().for_each(|line| assert!(text.lines().any(|of| of == *line), "{line}\n{text}"));
        text
    };
    let begin = "G21 G90\nG0 X10 Y0 Z1\nG1 Z0 F300\n";
    // Lines at the beginning of many programs that do not change the motion.
    kept(
        "\n%\nN10 G00G21G17G90G40G49G80\nG92.1\nX10Y10Z5\nG1Z0F100\nX20\n%\nnotes: &c.\n",
        &["G1 X20.000000 Y10.000000 Z-0.004000"],
    );
    let first = kept(&format!("\n%\n{begin}X20\n%\n"), &[]);
    assert!(first.starts_with("\n%\n(Regrind"), "{first}");
    // The same zero again, an output that is set, one turn, and a spindle that stops with the move.
    kept(
        &format!("G54\n{begin}G0 Z5\nG54 X30\nM67 E0 Q3\nG1 Z0\nG2 X30 I-5 P1\nG1 X40 M19 R90\nM2\n"),
        &["M67 E0 Q3", "M19 R90"],
    );
    // The remark of an older program.
    let old = Shop::new(|_, _| 0.004, "");
    fs::write(old.path("base.ngc"), [b"(T1 Fr\xe4ser)\n", begin.as_bytes(), b"X20\nM2\n"].concat()).unwrap();
    assert!(old.compensate(&[]).unwrap().contains("(T1 Fr\u{e4}ser)"));
    // A circle in a region where the map is almost zero ends at its start.
    let hardly = Shop::new(|_, _| 0.000_04, "G21 G90 G18\nG0 X10 Y10 Z5\nG0 X20 Y20 Z0\nG2 I5 K0 F100\nM2\n");
    assert_eq!(hardly.compensate(&[]).unwrap().matches("\nG2 ").count(), 1);
    // A whole circle under a G3 in force, without an axis.
    let circle = kept(
        &format!("{begin}G3 X0 Y10 I-10 J0\nJ-10\nM2\n"),
        &["G3 X0.000000 Y10.000000 Z-0.004000 I0.000000 J-10.000000"],
    );
    assert_eq!(circle.matches("\nG3 ").count(), 2);
    // The move before G53 does not make a rapid of a feed.
    kept(&format!("{begin}G0 Z5\nG1 F100\nG53 Z5\nM2\n"), &["G53 G1 Z5"]);
    kept(&format!("{begin}M19 R45\nG4 P2\nG64 P0.01\nM2\n"), &["M19 R45", "G4 P2", "G64 P0.01"]);
    kept(&format!("{begin}G91 G28 Z0\nG28 X0 Y0\nM2\n"), &["G91", "G28 Z0", "G28 X0 Y0", "G90"]);
    kept(&format!("G0 A0. B0.\n{begin}G0 X0 A0\nG1 X1 B0.\nM2\n"), &["G0 A0. B0.", "G0 X0.000000 A0"]);
    // The end of an arc in G18 and a centre in absolute places move with it.
    let side = kept("G21 G90 G18 G90.1\nG0 X10 Y0 Z0\nG1 X10 F100\nG2 X0 Z10 I0 K0\nM2\n", &[]);
    assert!(side.contains(" I0.000000 K-0.004000\n") || side.contains(" K-0.004000 I0.000000\n"), "{side}");
}

#[test]
fn rounded_arcs_remain_arcs() {
    // Ends that rounding moves half a micrometre off the circle.
    let mut program = String::from("G21 G90 G17\nG0 X14.142 Y0 Z1\nG1 Z0 F300\n");
    for k in 1..=8 {
        let (sine, cosine) = (f64::from(k) * std::f64::consts::FRAC_PI_4).sin_cos();
        let (from_sine, from_cosine) = (f64::from(k - 1) * std::f64::consts::FRAC_PI_4).sin_cos();
        program += &format!("G3 X{:.3} Y{:.3} ", 14.142 * cosine, 14.142 * sine);
        program += &format!("I{:.3} J{:.3}\n", -14.142 * from_cosine, -14.142 * from_sine);
    }
    let text = Shop::new(|_, _| 0.005, &(program + "M2\n")).compensate(&[]).unwrap();
    assert_eq!(text.matches("\nG3 ").count(), 8, "{text}");
}

#[test]
fn missing_unit_is_assumed_and_written() {
    let program = "G90 G54\nG0 X0.5 Y0\nG0 Z0.2\nG1 Z0 F20\nG1 X-0.5\nM30\n";
    let bench = Shop::new(|_, _| 0.005, program);
    let (code, told, _) =
        run(&["compensate", "--program", "base.ngc", "--map", "map.csv", "--out", "out.ngc", "--json"], bench.folder());
    let document: serde_json::Value = serde_json::from_str(&told).unwrap();
    assert_eq!((code, &document["unit_assumed"]), (0, &true.into()));
    let text = fs::read_to_string(bench.path("out.ngc")).unwrap();
    assert!(text.find("G21 ").unwrap() < text.find("G0 X").unwrap(), "{text}");
    let stated = Shop::new(|_, _| 0.005, &format!("G21\n{program}")).compensate(&[]).unwrap();
    assert_eq!(stated.matches("G21").count(), 1);
    // The first block of Klartext states the unit.
    let klartext = "0 BEGIN PGM A MM\n1 L Z+50 R0 FMAX\n2 L X+0 Y+0 R0 FMAX\n3 L Z+1 R0 F500\n4 L X+10\n5 L Z+50 R0 FMAX M30\n6 END PGM A MM\n";
    let bench = Shop::new(|_, _| 0.005, klartext);
    let arguments = ["compensate", "--program", "base.ngc", "--map", "map.csv", "--out", "out.ngc", "--json"];
    let (code, told, _) = run(&[&arguments[..], &["--dialect", "heidenhain"]].concat(), bench.folder());
    let document: serde_json::Value = serde_json::from_str(&told).unwrap();
    assert_eq!((code, &document["unit_assumed"]), (0, &false.into()));
}

#[test]
fn program_outside_map_refused() {
    let at = |x: i32| format!("G21 G90\nG0 X{x} Y0 Z1\nG1 Z0 F100\nG1 X{}\nM2\n", x + 20);
    let told = |program: &str| {
        let bench = Shop::new(|_, _| 0.005, program);
        let (code, told, said) = run(
            &["compensate", "--program", "base.ngc", "--map", "map.csv", "--out", "out.ngc", "--json"],
            bench.folder(),
        );
        assert_eq!(bench.path("out.ngc").exists(), code == 0);
        if code == 0 { Ok(serde_json::from_str::<serde_json::Value>(&told).unwrap()) } else { Err(said) }
    };
    let over = told(&at(-10)).unwrap();
    assert_eq!((over["beside_map_mm"].as_f64(), over["feed_mm"].as_f64()), (Some(0.0), Some(21.0)));
    let partly = told(&at(20)).unwrap()["beside_map_mm"].as_f64().unwrap();
    assert!((partly - 9.75).abs() < 0.2, "{partly}");
    assert!(told(&at(100)).unwrap_err().contains("over the map"));
    assert!(told(&at(-8000)).unwrap_err().contains("over the map"));
    assert!(told("G21 G90\nG0 X1\nM2\n").unwrap_err().contains("no move at feed"));
}

#[test]
fn map_validity_and_max_correction() {
    let bench = Shop::new(|_, _| 0.0, "G21 G90\nG0 X-4 Y0 Z1\nG1 Z0 F100\nG1 X4\nM2\n");
    let map = |value: &dyn Fn(i32) -> String| {
        let rows: String = (-3..=3)
            .flat_map(|j| (-6..=6).map(move |i| (i, j)))
            .map(|(i, j)| format!("{},{},{}\n", i, j, value(i)))
            .collect();
        fs::write(bench.path("map.csv"), format!("x_mm,y_mm,error_mm,valid\n{rows}")).unwrap();
    };
    // On the right nothing was measured, and the number there has no meaning.
    map(&|i| if i < 2 { "0.004,1".into() } else { "NaN,0".into() });
    let points = feeds(&bench.compensate(&[]).unwrap());
    assert!(points.iter().all(|point| (point[2] + 0.004).abs() < 1e-6 || point[2] > 0.5), "{points:?}");
    // The same holds for a map that names its part, with a byte order mark from Excel and other comments before it.
    let text =
        fs::read_to_string(bench.path("map.csv")).unwrap().replace(",valid\n", ",Valid\n").replace(",1\n", ",True\n");
    let named = format!("\u{feff}# part: sha256 {}\n{text}", "ab".repeat(32));
    fs::write(bench.path("map.csv"), named).unwrap();
    let points = feeds(&bench.compensate(&[]).unwrap());
    assert!(points.iter().all(|point| (point[2] + 0.004).abs() < 1e-6 || point[2] > 0.5), "{points:?}");
    map(&|_| "5.0,1".into());
    let said = bench.compensate(&[]).unwrap_err();
    assert!(said.contains("5000") && said.contains("--max-correction-um"), "{said}");
    bench.compensate(&["--max-correction-um", "6000"]).unwrap();
    // The name of earlier versions.
    bench.compensate(&["--largest-correction-um", "6000"]).unwrap();
    map(&|_| "0.004,0".into());
    assert!(bench.compensate(&[]).unwrap_err().contains("valid"));
    map(&|_| "0.004,x".into());
    assert!(bench.compensate(&[]).unwrap_err().contains("instead of 1 or 0"));
}

#[test]
fn compensate_overwrites_no_input() {
    let program = "G21 G90\nG0 X0 Y0 Z1\nG1 X5 F100\nM2\n";
    let bench = Shop::new(error_mm, program);
    for out in ["base.ngc", "./base.ngc", "map.csv"] {
        let said = bench.correct("base.ngc", out, &[]).unwrap_err();
        assert!(said.contains("overwrite"), "{out}: {said}");
    }
    assert_eq!(fs::read_to_string(bench.path("base.ngc")).unwrap(), program);
    #[cfg(unix)]
    {
        fs::hard_link(bench.path("base.ngc"), bench.path("other.ngc")).unwrap();
        assert!(bench.correct("base.ngc", "other.ngc", &[]).unwrap_err().contains("overwrite"));
        let said = bench.correct("base.ngc", "/dev/null", &[]).unwrap_err();
        assert!(said.contains("device"), "{said}");
    }
}

#[test]
fn compensate_names_other_control() {
    for (program, name) in [
        ("%\nO7001(PART)\nG21 G90\nG0 X0. Y0. Z1.\nG1 X5. F100\nM30\n%\n", "Fanuc"),
        ("0 BEGIN PGM PART MM\n1 L X+0 Y+0 R0 FMAX\n", "Klartext"),
        ("%_N_PART_MPF\nG71 G90\nG1 X5 F100\n", "Sinumerik"),
    ] {
        let said = Shop::new(error_mm, program).compensate(&[]).unwrap_err();
        assert!(said.contains(name), "{said}");
    }
}

#[test]
fn map_applied_once_to_its_part() {
    let program = "G21 G90\nG0 X0 Y0 Z1\nG1 X5 F100\nM2\n";
    let bench = Shop::new(error_mm, program);
    bench.compensate(&[]).unwrap();
    let again = bench.correct("out.ngc", "twice.ngc", &[]).unwrap_err();
    assert!(again.contains("already applied") && !bench.path("twice.ngc").exists(), "{again}");
    // A second map of the same part adds to the first.
    let first = fs::read_to_string(bench.path("map.csv")).unwrap();
    fs::write(bench.path("map.csv"), first.replacen(",1\n", ",0\n", 1)).unwrap();
    let both = bench.correct("out.ngc", "both.ngc", &[]).unwrap();
    assert_eq!(both.matches("(map: sha256 ").count(), 2);
    let other = Shop::new(error_mm, &format!("(part: sha256 {})\n{program}", "cd".repeat(32)));
    assert!(other.compensate(&[]).unwrap_err().contains("another part"));
}

#[test]
fn map_requires_its_base_program() {
    let program = |comments: &str| format!("{comments}G21 G90\nG0 X-20 Y0 Z5\nG1 Z0 F100\nG1 X20\nM2\n");
    let (one, other) = ("01".repeat(32), "02".repeat(32));
    let has = |map: &str| format!("(part: sha256 {})\n(map: sha256 {map})\n", "ab".repeat(32));
    let bench = Shop::new(|_, _| 0.001, &program(""));
    let after = |comments: &str| {
        fs::write(bench.path("base.ngc"), program(comments)).unwrap();
        bench.compensate(&[]).map(|_| ())
    };
    // An error measured after a pass with a correction applies to the program with that correction.
    bench.save_error(|_, _| 0.001, Some([1; 32]));
    after(&has(&one)).unwrap();
    for comments in [has(&other), String::new(), has(&one) + "(map: 0 everywhere)\n"] {
        let said = after(&comments).unwrap_err();
        assert!(said.contains("another correction"), "{said}");
    }
    // A correction is absolute: it does not add to another.
    bench.save_correction([3; 32]);
    after("").unwrap();
    after(&(has(&other) + "(map: 0 everywhere)\n")).unwrap();
    let said = after(&has(&other)).unwrap_err();
    assert!(said.contains("absolute") && said.contains("regrind plan --program"), "{said}");
    let said = after(&has(&"03".repeat(32))).unwrap_err();
    assert!(said.contains("already applied"), "{said}");
}

#[test]
fn compensate_refuses_malformed_maps() {
    let bench = Shop::new(error_mm, "G21 G90\nG0 X0 Y0 Z1\nG1 X5 F100\nM2\n");
    let whole = fs::read_to_string(bench.path("map.csv")).unwrap();
    let without = |n: usize| {
        whole.lines().enumerate().filter(|(k, _)| *k != n).map(|(_, l)| format!("{l}\n")).collect::<String>()
    };
    for (text, words) in [
        (String::new(), "empty"),
        (without(whole.lines().position(|line| line.starts_with("x_mm")).unwrap()), "columns"),
        (without(50), "not a complete grid"),
        (whole.replace("0.5,0.5,", "0.5,0.5,x"), "is not a node"),
        (whole.replace("0.5,0.5,", "0.5,0.5,NaN;"), "is not a node"),
    ] {
        fs::write(bench.path("map.csv"), text).unwrap();
        let said = bench.compensate(&[]).unwrap_err();
        assert!(said.contains(words) && said.contains("map.csv"), "{words}: {said}");
    }
}

#[test]
fn compensate_ball_along_normals() {
    // A dome z = -x^2 / 80 - y^2 / 120 and a ball of 5 mm whose tip the program moves.
    let height = |x: f64, y: f64| -x * x / 80.0 - y * y / 120.0;
    let normal = |x: f64, y: f64| {
        let n = [x / 40.0, y / 60.0, 1.0];
        let length = n.iter().map(|c| c * c).sum::<f64>().sqrt();
        n.map(|c| c / length)
    };
    let radius = 5.0;
    let mut program = String::from("G21 G90\nG0 Z20\n");
    for (k, y) in [-6.0, 0.0, 6.0].into_iter().enumerate() {
        for i in 0..=200 {
            let x = f64::from(i) * 0.1 - 10.0;
            let n = normal(x, y);
            let c = [x + radius * n[0], y + radius * n[1], height(x, y) + radius * n[2] - radius];
            let g = if i == 0 { format!("G0 X{:.6} Y{:.6}\nG1 F100 ", c[0], c[1]) } else { String::new() };
            program += &format!("{g}X{:.6} Y{:.6} Z{:.6}\n", c[0], c[1], c[2]);
        }
        program += if k < 2 { "G0 Z20\n" } else { "G0 Z20\nM2\n" };
    }
    let bench = Shop::new(error_mm, &program);
    let mut nominal = String::from("x_mm,y_mm,z_mm\n");
    for j in 0..=100 {
        for i in 0..=140 {
            let (x, y) = (f64::from(i) * 0.25 - 17.5, f64::from(j) * 0.25 - 12.5);
            nominal += &format!("{x},{y},{}\n", height(x, y));
        }
    }
    fs::write(bench.path("nominal.csv"), nominal).unwrap();
    let text = bench.compensate(&["--nominal", "nominal.csv", "--tip-of-radius", "5"]).unwrap();
    let steps: Vec<ProgramStep> = read(&text);
    let gap = |q: [f64; 3]| {
        let segments = steps.windows(2).filter(|pair| pair[1].feed && !pair[0].at[0].is_nan());
        let off = segments.map(|pair| {
            let (a, b) = (pair[0].at, pair[1].at);
            // The centre is above the tip by the radius.
            let from = [q[0] - a[0], q[1] - a[1], q[2] - a[2] - radius];
            let along = [0, 1, 2].map(|k| b[k] - a[k]);
            let length2 = along.iter().map(|c| c * c).sum::<f64>().max(1e-18);
            let t = ((0..3).map(|k| from[k] * along[k]).sum::<f64>() / length2).clamp(0.0, 1.0);
            (0..3).map(|k| (from[k] - t * along[k]).powi(2)).sum::<f64>().sqrt() - radius
        });
        off.fold(f64::INFINITY, f64::min)
    };
    for y in [-6.0, 0.0, 6.0] {
        for i in 0..60 {
            let x = f64::from(i) * 0.3 - 8.9;
            let (n, e) = (normal(x, y), -error_mm(x, y));
            let off = gap([x + e * n[0], y + e * n[1], height(x, y) + e * n[2]]);
            // The base program's own chords, 0.1 mm long, are off by 0.02 um.
            assert!(off.abs() < 2e-4, "{:.3} um at {x}, {y}", 1e3 * off);
        }
    }
}

#[test]
fn generated_arcs_remain_arcs() {
    let mut part = part("biconic");
    part.programs.options = with(&part.programs.options, part.programs.options.wheel, 6.0);
    (part.programs.arcs_within_mm, part.programs.part_identity) = (Some(1e-4), PART);
    let bench = Shop::new(|_, _| 0.0, "M2\n");
    part.programs.write(&bench.path("base.ngc"), &correction(part.half_mm), [9; 32]).unwrap();
    bench.save_error(|_, _| 0.004, Some([9; 32]));
    let corrected = Control::Linuxcnc.read(&bench.compensate(&[]).unwrap()).unwrap();
    let base = Control::Linuxcnc.read(&fs::read_to_string(bench.path("base.ngc")).unwrap()).unwrap();
    assert_eq!(base.waypoints.len(), corrected.waypoints.len());
    let mut turns = 0;
    for (pair, same) in base.waypoints.windows(2).zip(corrected.waypoints.windows(2)) {
        let Some(feed) = pair[1].feed_mm_min.filter(|_| pair[1].arc.is_some()) else { continue };
        assert_eq!(same[1].feed_mm_min, Some(feed));
        for share in [0.3, 1.0] {
            let [was, is] = [pair, same].map(|pair| pair[1].position_at(pair[0].at_mm, share));
            let off = [is[0] - was[0], is[1] - was[1], is[2] - was[2] + 0.004];
            assert!(off.iter().all(|v| v.abs() < 3e-6), "{off:?}");
        }
        turns += 1;
    }
    assert!(turns > 100, "{turns}");
}

/// Dialects with the name of their files, and the largest rounding of a coordinate in mm.
const DIALECTS: [(&str, f64); 4] = [("linuxcnc", 5e-7), ("fanuc", 5e-5), ("sinumerik", 5e-7), ("heidenhain", 5e-5)];

fn dialect(name: &str) -> regrind::formats::gcode::Dialect {
    regrind::config::read_named_dialect(name, std::path::Path::new("")).unwrap().dialect
}

/// A program of `plan` in each dialect comes back corrected by the map: each of its points is where the map moves it, by
/// readers that share no code with the correction. With four decimals within 0.1 µm, with six within 0.01 µm.
#[test]
fn planned_programs_come_back_in_their_dialect() {
    for (name, rounding_mm) in DIALECTS {
        for arcs_within_mm in [None, Some(1e-4)] {
            let mut part = part("biconic");
            part.programs.options = with(&part.programs.options, part.programs.options.wheel, 12.0);
            part.programs.dialect = dialect(name);
            part.programs.controller_tolerance_mm = Some(part.programs.path_tolerance_mm);
            (part.programs.arcs_within_mm, part.programs.part_identity) = (arcs_within_mm, PART);
            let bench = Shop::new(error_mm, "M2\n");
            part.programs.write(&bench.path("base"), &Correction::zero(GRID, 0.02), [9; 32]).unwrap();
            bench.save_error(error_mm, None);
            let text = bench.correct("base", "out", &["--dialect", name, "--tolerance-um", "0.01"]).unwrap();
            let control = Control::named(name).unwrap();
            let base = control.read(&fs::read_to_string(bench.path("base")).unwrap()).unwrap();
            let corrected = control.read(&text).unwrap_or_else(|why| panic!("{name}: {why}"));
            assert_eq!(corrected.tolerance_mm, base.tolerance_mm, "{name}");
            // Every point of the base is moved by the map, and is an end of a corrected move.
            let mut ends = corrected.waypoints.iter();
            let (mut worst, mut points) = (0.0f64, 0);
            let is_over_map = |[x, y, _]: [f64; 3]| x.abs() < 29.0 && y.abs() < 19.0;
            let on_map = |stop: &&Waypoint| stop.feed_mm_min.is_some() && is_over_map(stop.at_mm);
            for stop in base.waypoints.iter().filter(on_map) {
                let [x, y, z] = stop.at_mm;
                let wanted = [x, y, z - error_mm(x, y)];
                let off = |at: [f64; 3]| (0..3).map(|k| (at[k] - wanted[k]).powi(2)).sum::<f64>().sqrt();
                let limit_mm = rounding_mm * 3f64.sqrt() + 1e-6;
                let found = ends.find(|end| end.feed_mm_min == stop.feed_mm_min && off(end.at_mm) <= limit_mm);
                let found = found.unwrap_or_else(|| panic!("{name}: no move ends at {wanted:?}"));
                worst = worst.max(off(found.at_mm));
                points += 1;
            }
            assert!(points > 60 && worst <= if rounding_mm > 1e-6 { 1e-4 } else { 1e-5 }, "{name}: {points}, {worst}");
            let again = bench.correct("out", "again", &["--dialect", name]).unwrap_err();
            assert!(again.contains("already"), "{name}: {again}");
        }
    }
}

/// A dialect of the shop's own has other words for axes, feed and arcs.
#[test]
fn own_words_of_a_dialect_are_read_and_written() {
    let bench = Shop::new(|_, _| 0.004, "M2\n");
    let shipped = fs::read_to_string(regrind_testutils::root().join("config/dialects/fanuc.toml")).unwrap();
    let own = |name: &str, changes: &[(&str, &str)]| {
        let mut text = shipped.replace("#:schema", "# schema");
        for (from, to) in changes {
            assert!(text.contains(from), "{from}");
            text = text.replace(from, to);
        }
        fs::write(bench.path(name), text).unwrap();
        bench.path(name).display().to_string()
    };
    let words = "[words]\naxes = [\"U\", \"V\", \"W\"]\nfeed = \"E\"\n";
    let turned = own("turned.toml", &[("[words]\n", words)]);
    let centres =
        own("centres.toml", &[("centre_words = [\"I\", \"J\", \"K\"]", "centre_words = [\"P\", \"Q\", \"S\"]")]);
    let swapped = own("swapped.toml", &[("\"G02 \"", "\"G99 \""), ("\"G03 \"", "\"G02 \""), ("\"G99 \"", "\"G03 \"")]);
    let correct = |dialect: &str, program: &str| {
        fs::write(bench.path("own"), program).unwrap();
        bench.save_error(|_, _| 0.004, None);
        bench.correct("own", "out", &["--dialect", dialect])
    };
    let program = "%\nO1\nG21 G90 G54\nG00 U0. V0. W5.\nG01 W1. E500.\nU8. V2.\nM30\n%\n";
    let text = correct(&turned, program).unwrap();
    for line in ["G00 U0.0000 V0.0000 W5.0000", "E500.", "G01 U8.0000 V2.0000 W0.9960"] {
        assert!(text.lines().any(|found| found == line), "{line}: {text}");
    }
    let refused = correct(&turned, &program.replace("U8. V2.", "X8. V2.")).unwrap_err();
    assert!(refused.contains("X is no word"), "{refused}");
    // With the words of the two senses exchanged, an arc keeps the sense that the dialect gives its word.
    let arc = "%\nO1\nG21 G90 G54 G17\nG00 X0. Y0. Z5.\nG01 Z1. F500.\nG03 X5. Y5. I5. J0.\nM30\n%\n";
    let about = arc.replace("I5. J0.", "P5. Q0.").replace("G03", "G02");
    let text = correct(&centres, &about).unwrap();
    assert!(text.lines().any(|found| found == "G02 X5.0000 Y5.0000 Z0.9960 P5.0000 Q0.0000"), "{text}");
    let refused = correct(&centres, arc).unwrap_err();
    assert!(refused.contains("I is no word"), "{refused}");
    let text = correct(&swapped, arc).unwrap();
    assert!(text.lines().any(|found| found == "G03 X5.0000 Y5.0000 Z0.9960 I5.0000 J0.0000"), "{text}");
}

/// Arcs of a program stay arcs in each dialect while the map is constant.
#[test]
fn arcs_stay_arcs_in_their_dialect() {
    for (name, rounding_mm) in DIALECTS {
        let mut part = part("biconic");
        part.programs.options = with(&part.programs.options, part.programs.options.wheel, 6.0);
        part.programs.dialect = dialect(name);
        part.programs.controller_tolerance_mm = Some(part.programs.path_tolerance_mm);
        (part.programs.arcs_within_mm, part.programs.part_identity) = (Some(1e-4), PART);
        let bench = Shop::new(|_, _| 0.0, "M2\n");
        part.programs.write(&bench.path("base"), &Correction::zero(GRID, 0.02), [9; 32]).unwrap();
        bench.save_error(|_, _| 0.004, None);
        let text = bench.correct("base", "out", &["--dialect", name]).unwrap();
        let control = Control::named(name).unwrap();
        let base = control.read(&fs::read_to_string(bench.path("base")).unwrap()).unwrap();
        let corrected = control.read(&text).unwrap();
        assert_eq!(base.waypoints.len(), corrected.waypoints.len(), "{name}");
        let mut turns = 0;
        for (pair, same) in base.waypoints.windows(2).zip(corrected.waypoints.windows(2)) {
            if pair[1].feed_mm_min.is_none() || pair[1].arc.is_none() {
                continue;
            }
            let [was, is] = [pair, same].map(|pair| pair[1].position_at(pair[0].at_mm, 0.3));
            let off = [is[0] - was[0], is[1] - was[1], is[2] - was[2] + 0.004];
            assert!(off.iter().all(|v| v.abs() < 2.0 * rounding_mm + 2e-6), "{name}: {off:?}");
            turns += 1;
        }
        assert!(turns > 50, "{name}: {turns}");
    }
}

/// Programs as shops have them: each move is at the place that the control takes from its words.
#[test]
fn programs_of_shops_are_corrected_in_their_dialect() {
    let constant = |name: &str, program: &str| {
        let bench = Shop::new(|_, _| 0.004, program);
        bench.compensate(&["--dialect", name])
    };
    let lines = |text: &str| -> Vec<String> {
        let is_code = |line: &&str| !line.contains("REGRIND") && !line.contains("SHA256") && !line.contains("GAIN");
        text.lines().filter(is_code).map(str::to_owned).collect()
    };
    // Fanuc: a program number, increments of 0.1 µm without a point, modal words.
    let fanuc = "%\r\nO1234(MIRROR)\r\nN10 G21 G90 G54\r\nN20 G00 X0 Y0 Z50000\r\nG01 Z10000 F500.\r\nX100000 Y-2.5\r\nG02 X12.5 Y0. I0 J25000\r\nG00 Z5.\r\nM30\r\n%\r\n";
    let text = constant("fanuc", fanuc).unwrap();
    assert!(text.starts_with("%\r\nO1234(MIRROR)\r\n(REGRIND "), "{text}");
    let told = lines(&text);
    for line in [
        "G00 X0.0000 Y0.0000 Z5.0000",
        "F500.",
        "G01 X0.0000 Y0.0000 Z0.9960",
        "G01 X10.0000 Y-2.5000 Z0.9960",
        "G02 X12.5000 Y0.0000 Z0.9960 I0.0000 J2.5000",
        "M30",
    ] {
        assert!(told.iter().any(|found| found == line), "{line}: {told:#?}");
    }
    assert!(told.ends_with(&["%".to_owned()]));
    // Klartext: a centre before the arc, feeds within moves, a tool that is called.
    let heidenhain = "0 BEGIN PGM MIRROR MM\n1 BLK FORM 0.1 Z X-20 Y-20 Z-10\n2 TOOL CALL 1 Z S3000\n3 L Z+50 R0 FMAX M3\n4 L X+0 Y+0 R0 FMAX\n5 L Z+1 R0 F500\n6 L X+10 Y-2.5\n7 CC X+10 Y+0\n8 C X+12.5 Y+0 DR+ F300\n9 L Z+50 R0 FMAX M30\n10 END PGM MIRROR MM\n";
    let text = constant("heidenhain", heidenhain).unwrap();
    let told = lines(&text);
    let numbers: Vec<usize> = text.lines().map(|line| line.split(' ').next().unwrap().parse().unwrap()).collect();
    assert_eq!(numbers, (0..numbers.len()).collect::<Vec<_>>(), "{text}");
    for line in [
        "BLK FORM 0.1 Z X-20 Y-20 Z-10",
        "TOOL CALL 1 Z S3000",
        "L Z+50.0000 R0 FMAX",
        "L X+10.0000 Y-2.5000 Z+0.9960",
        "CC X+10.0000 Y+0.0000",
        "C X+12.5000 Y+0.0000 DR+ F300",
        "END PGM MIRROR MM",
    ] {
        assert!(told.iter().any(|found| found.split_once(' ').unwrap().1 == line), "{line}: {told:#?}");
    }
    // The header of Klartext has the unit, and a block may have a feed alone.
    assert!(!text.contains("G21") && text.starts_with("0 BEGIN PGM MIRROR MM"), "{text}");
    let inches = constant("heidenhain", &heidenhain.replace("MIRROR MM", "MIRROR INCH")).unwrap();
    assert!(inches.starts_with("0 BEGIN PGM MIRROR INCH"), "{inches}");
    let alone = heidenhain.replace("9 L Z+50 R0 FMAX M30", "9 L F700\n9 L Z+50 R0 FMAX M30");
    let told = lines(&constant("heidenhain", &alone).unwrap());
    assert!(told.iter().any(|found| found.ends_with("F700")), "{told:#?}");
    // Sinumerik: an assignment to an axis, and the radius of an arc.
    let sinumerik = "N10 G710 G90 G17\nN20 G0 X0 Y0 Z50 ; above\nN30 G1 Z=1 F500\nN40 G2 X10 Y0 CR=5\nN50 M30\n";
    let told = lines(&constant("sinumerik", sinumerik).unwrap());
    for line in ["G1 X0.000000 Y0.000000 Z0.996000", "G2 X10.000000 Y0.000000 Z0.996000 I5.000000 J0.000000", "M30"] {
        assert!(told.iter().any(|found| found.split_once(' ').is_some_and(|(_, rest)| rest == line)), "{told:#?}");
    }
    // Without a word for the unit, that of the dialect is added, and the header of an archive stays the first lines.
    let silent = constant("sinumerik", &sinumerik.replace("G710 ", "")).unwrap();
    assert!(silent.contains("N10 G710 G90") && !silent.contains("G21"), "{silent}");
    let archive = constant("sinumerik", &format!("%_N_MIRROR_MPF\n;$PATH=/_N_WKS_DIR\n{sinumerik}")).unwrap();
    assert!(archive.starts_with("%_N_MIRROR_MPF\n;$PATH=/_N_WKS_DIR\n; Regrind"), "{archive}");
    // G05.1 and G5.1 are one code, and a dwell has the letter of an axis.
    let fast = fanuc.replace("G01 Z10000", "G5.1 Q1\r\nG04 X2. (COOL)\r\nG01 Z10000");
    let told = lines(&constant("fanuc", &fast).unwrap());
    assert!(["G5.1 Q1", "G04 X2. (COOL)"].iter().all(|line| told.iter().any(|found| found == line)), "{told:#?}");
    let twice = fanuc.replace("M30\r\n%", "M30\r\nO1235\r\nG01 X1.\r\nM30\r\n%");
    assert!(constant("fanuc", &twice).unwrap_err().contains("another program"));
    let unknown = constant("sinumerik", &sinumerik.replace("N30 ", "N30 TRANS X1\nN31 ")).unwrap_err();
    assert!(unknown.contains("\"TRANS\" is not known"), "{unknown}");
    // An unknown line is refused with its number.
    for (name, program, line) in [
        ("fanuc", fanuc.replace("G02", "G65 P100"), 7),
        ("fanuc", fanuc.replace("G54", "G54 G43.4 H1"), 3),
        ("heidenhain", heidenhain.replace("L X+10 Y-2.5", "L IX+10 Y-2.5"), 7),
        ("heidenhain", heidenhain.replace("L X+10 Y-2.5", "L \u{c4}+10 Y-2.5"), 7),
        ("heidenhain", heidenhain.replace("CC X+10 Y+0", "CC \u{c4}+10 \u{d6}+0"), 8),
        ("heidenhain", heidenhain.replace("R0 F500", "RL F500"), 6),
        ("heidenhain", heidenhain.replace("6 L X+10 Y-2.5", "6 CALL LBL 1"), 7),
        ("heidenhain", heidenhain.replace("7 CC X+10 Y+0\n", ""), 8),
        ("sinumerik", sinumerik.replace("G1 Z=1", "G1 Z=IC(1)"), 3),
        ("sinumerik", sinumerik.replace("CR=5", "CR=R1"), 4),
    ] {
        let refused = constant(name, &program).unwrap_err();
        assert!(refused.contains(&format!("line {line}")) || refused.contains(&format!(":{line}")), "{refused}");
    }
    assert!(constant("linuxcnc", fanuc).unwrap_err().contains("--dialect"));
    assert!(constant("tng", fanuc).is_err());
}
