//! Tests of the program from its arguments to its exit code, on good input and on every kind of bad input.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use regrind_sim::Vec3;
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise, centre};
use regrind_sim::shape::{FreeForm, Shape, Sphere};
use serde_json::Value;
use tempfile::TempDir;

const RADIUS_MM: f64 = 1.5;
const COLUMNS: usize = 181;
const ROWS: usize = 101;
/// Columns and rows of the measured pattern.
const SCAN: [usize; 2] = [50, 30];

/// Largest distance by which the form error of the part can shift the best fit from the true pose.
const FORM_SHIFT_MM: f64 = 0.02;

fn placement() -> Placement {
    Placement::new([20.0, 10.0, 20.0], [20.0, 20.0, 10.0])
}

fn nominal() -> &'static [Vec3] {
    static POINTS: OnceLock<Vec<Vec3>> = OnceLock::new();
    POINTS.get_or_init(|| FreeForm::default().grid(FreeForm::WIDTH_MM, FreeForm::DEPTH_MM, COLUMNS, ROWS))
}

/// 1,500 probe centres on a part with 6.657 um of form error, with 0.2 um of noise.
fn measured() -> &'static [Vec3] {
    static POINTS: OnceLock<Vec<Vec3>> = OnceLock::new();
    POINTS.get_or_init(|| {
        let form = FormError::new(1, 30.0, 6.657e-3, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
        let mut points = scan(&FreeForm::default(), &form, [98.0, 58.0], &placement());
        add_noise(&mut regrind_sim::rng(1), &mut points, 2e-4);
        points
    })
}

fn scan(shape: &dyn Shape, form: &FormError, size_mm: [f64; 2], place: &Placement) -> Vec<Vec3> {
    let at = |i: usize, k: usize| size_mm[k] * (i as f64 / (SCAN[k] - 1) as f64 - 0.5);
    (0..SCAN[0] * SCAN[1])
        .map(|k| place.apply(centre(shape, form, RADIUS_MM, at(k % SCAN[0], 0), at(k / SCAN[0], 1))))
        .collect()
}

fn rows(points: &[Vec3], separator: &str) -> String {
    points.iter().map(|p| format!("{}{separator}{}{separator}{}\n", p[0], p[1], p[2])).collect()
}

fn scaled(points: &[Vec3], by: f64) -> Vec<Vec3> {
    points.iter().map(|p| p.map(|c| c * by)).collect()
}

/// A folder with a nominal.csv and a measured.csv that register.
struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        let bench = Self { folder: tempfile::tempdir().unwrap() };
        bench.write("nominal.csv", format!("x_mm,y_mm,z_mm\n{}", rows(nominal(), ",")));
        bench.write("measured.csv", rows(measured(), ","));
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.path(name), content).unwrap();
    }

    fn run(&self, arguments: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_regrind")).args(arguments).current_dir(self.folder.path()).output().unwrap()
    }

    fn register(&self, nominal: &str, measured: &str, more: &[&str]) -> Output {
        let mut arguments = vec!["register", "--nominal", nominal, "--measured", measured, "--out", "out/here"];
        if !more.iter().any(|more| more.starts_with("--probe-radius")) && !more.contains(&"contact") {
            arguments.extend(["--probe-radius", "1.5"]);
        }
        arguments.extend(more);
        self.run(&arguments)
    }

    /// Registers and returns registration.json.
    fn registered(&self, nominal: &str, measured: &str, more: &[&str]) -> Value {
        let output = self.register(nominal, measured, more);
        assert_eq!(output.status.code(), Some(0), "{nominal} {measured} {more:?}: {}", text(&output.stderr));
        serde_json::from_slice(&fs::read(self.path("out/here/registration.json")).unwrap()).unwrap()
    }

    /// Asserts that a registration is refused, in one message with these words, and leaves no files.
    fn refused(&self, nominal: &str, measured: &str, more: &[&str], words: &[&str]) {
        self.assert_refused(&self.register(nominal, measured, more), words);
    }

    fn assert_refused(&self, output: &Output, words: &[&str]) {
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.starts_with("error: "), "{message}");
        assert!(!message.contains("panicked") && !message.contains("a fault of the program"), "{message}");
        for word in words {
            assert!(message.contains(word), "`{word}` is missing: {message}");
        }
        assert!(output.stdout.is_empty(), "{}", text(&output.stdout));
        assert!(!self.path("out").exists(), "something was left behind: {message}");
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(number).collect()
}

fn pose(document: &Value) -> Vec<Vec<f64>> {
    document["cmm_from_model"].as_array().unwrap().iter().map(numbers).collect()
}

/// Asserts that the pose carries the part's corners to where they are, within a distance.
fn assert_pose(document: &Value, within_mm: f64) {
    let pose = pose(document);
    for corner in [[-51.0, -31.0, 0.0], [51.0, -31.0, 5.0], [51.0, 31.0, 0.0], [0.0, 0.0, 10.0]] {
        let there = placement().apply(corner);
        for i in 0..3 {
            let found = pose[i][3] + (0..3).map(|k| pose[i][k] * corner[k]).sum::<f64>();
            assert!((found - there[i]).abs() < within_mm, "{pose:?}");
        }
    }
}

#[test]
fn register_writes_contract_files() {
    let bench = Bench::new();
    let document = bench.registered("nominal.csv", "measured.csv", &[]);
    assert_pose(&document, FORM_SHIFT_MM);
    assert_eq!(pose(&document).len(), 4);
    assert_eq!(pose(&document)[3], [0.0, 0.0, 0.0, 1.0]);
    assert_eq!(document["converged"], true);
    assert_eq!(document["points"], 1500);
    assert_eq!(document["nominal"]["points"], COLUMNS * ROWS);
    assert!(document["used"].as_u64().unwrap() > 1480);
    assert!((0.5e-3..3e-3).contains(&number(&document["rms_mm"])) && number(&document["pv_mm"]) < 10e-3);
    assert!(number(&document["coverage"]) > 0.9 && number(&document["condition"]) >= 1.0);
    assert!(document["weak_directions"].is_array() && document["alternatives"].is_array());
    let covariance: Vec<Vec<f64>> = document["covariance"].as_array().unwrap().iter().map(numbers).collect();
    assert!(covariance.len() == 6 && covariance.iter().all(|row| row.len() == 6));
    assert!((number(&document["standard_uncertainty"]["rz_rad"]).powi(2) - covariance[5][5]).abs() < 1e-18);
    for name in ["out/here/deviations.csv", "out/here/deviation_uncertainty.csv"] {
        assert_eq!(fs::read_to_string(bench.path(name)).unwrap().lines().count(), 1501, "{name}");
    }
    assert_eq!(fs::read_dir(bench.path("out/here")).unwrap().count(), 3);
}

#[test]
fn register_finds_exact_pose() {
    let bench = Bench::new();
    bench.write("exact.csv", rows(&scan(&FreeForm::default(), &FormError::none(), [98.0, 58.0], &placement()), ","));
    let document = bench.registered("nominal.csv", "exact.csv", &[]);
    assert_pose(&document, 2e-5);
    assert!(number(&document["rms_mm"]) < 5e-6 && document["used"] == 1500, "{}", document["rms_mm"]);
}

#[test]
fn trace_has_objective_of_each_step() {
    let bench = Bench::new();
    let document = bench.registered("nominal.csv", "measured.csv", &[]);
    let trace = document["trace"].as_array().unwrap();
    assert_eq!(document["iterations"], trace.len());
    let taken: Vec<&Value> = trace.iter().filter(|i| i["taken"] == true).collect();
    let objective = numbers(&document["objective_mm2"]);
    assert_eq!(objective, taken.iter().map(|i| number(&i["objective_mm2"])).collect::<Vec<_>>());
    for (k, pair) in objective.windows(2).enumerate() {
        // Dropped or restored points change the sum by themselves.
        assert!(pair[1] <= pair[0] || taken[k]["points"] != taken[k + 1]["points"], "{objective:?}");
    }
}

#[test]
fn deviations_in_input_order() {
    let bench = Bench::new();
    let order: Vec<usize> = (0..measured().len()).map(|k| (k * 7 + 3) % measured().len()).collect();
    let mixed: Vec<Vec3> = order.iter().map(|&k| measured()[k]).collect();
    bench.write("mixed.csv", rows(&mixed, ","));
    let document = bench.registered("nominal.csv", "mixed.csv", &[]);
    let table = fs::read_to_string(bench.path("out/here/deviations.csv")).unwrap();
    let mut lines = table.lines();
    assert_eq!(lines.next(), Some("x_mm,y_mm,z_mm,nx,ny,nz,deviation_mm,used"));
    let mut used = 0;
    for (line, &k) in lines.zip(&order) {
        let row: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        // The contact point lies where the ball was put on the part.
        let put = [k % SCAN[0], k / SCAN[0]];
        for (axis, size) in [98.0, 58.0].into_iter().enumerate() {
            let there = size * (put[axis] as f64 / (SCAN[axis] - 1) as f64 - 0.5);
            assert!((row[axis] - there).abs() < 0.01, "row for point {k}: {line}");
        }
        assert!((row[3].powi(2) + row[4].powi(2) + row[5].powi(2) - 1.0).abs() < 1e-9 && row[6].abs() < 0.01);
        used += usize::from(row[7] == 1.0);
    }
    assert_eq!(document["used"], used);
    assert_eq!(document["points"], used + lengths(&document, ["outliers", "off_part"]));
}

fn lengths(document: &Value, keys: [&str; 2]) -> usize {
    keys.iter().map(|key| document[*key].as_array().unwrap().len()).sum()
}

#[test]
fn every_input_format_gives_same_pose() {
    let bench = Bench::new();
    let mut ply = format!("ply\nformat ascii 1.0\nelement vertex {}\n", nominal().len());
    ply += "property double x\nproperty double y\nproperty double z\nend_header\n";
    bench.write("nominal.ply", ply + &rows(nominal(), " "));
    bench.write("nominal.stl", stl(nominal()));
    for (name, separator) in [("semicolon.csv", ";"), ("tab.txt", "\t"), ("blank.xyz", " ")] {
        bench.write(name, rows(measured(), separator));
        assert_pose(&bench.registered("nominal.csv", name, &[]), FORM_SHIFT_MM);
    }
    for name in ["nominal.ply", "nominal.stl"] {
        assert_pose(&bench.registered(name, "measured.csv", &[]), FORM_SHIFT_MM);
    }
    bench.write("measured.ply", fs::read(bench.path("nominal.ply")).unwrap());
    let contact = bench.registered("nominal.csv", "measured.ply", &["--method", "contact"]);
    assert!(number(&contact["rms_mm"]) < 1e-6 && contact["probe_radius_mm"].is_null());
}

/// The nominal grid as a mesh of text.
fn stl(points: &[Vec3]) -> String {
    let mut text = String::from("solid part\n");
    for j in 0..ROWS - 1 {
        for i in 0..COLUMNS - 1 {
            let node = |di: usize, dj: usize| points[(j + dj) * COLUMNS + i + di];
            for corners in [[node(0, 0), node(1, 0), node(1, 1)], [node(0, 0), node(1, 1), node(0, 1)]] {
                text += "facet normal 0 0 1\nouter loop\n";
                for [x, y, z] in corners {
                    text += &format!("vertex {x} {y} {z}\n");
                }
                text += "endloop\nendfacet\n";
            }
        }
    }
    text + "endsolid part\n"
}

const LENS: &str = "[surface]\nkind = \"biconic\"\nradius_x_mm = 90.0\nradius_y_mm = 140.0\nconic_x = 0.0\n\
                                conic_y = 0.0\n\n[aperture]\nkind = \"circle\"\nradius_mm = 25.0\n\n[sampling]\nspacing_mm = 0.5\n";

#[test]
fn register_uses_definition_aperture() {
    let bench = Bench::new();
    bench.write("lens.toml", LENS);
    let shape = regrind_sim::shape::Biconic { radius_mm: [90.0, 140.0], conic: [0.0, 0.0] };
    bench.write("lens.csv", rows(&scan(&shape, &FormError::none(), [40.0, 40.0], &placement()), ","));
    let document = bench.registered("lens.toml", "lens.csv", &[]);
    assert!(number(&document["rms_mm"]) < 1e-6, "{}", document["rms_mm"]);
    let outside = (0..SCAN[0] * SCAN[1])
        .filter(|k| {
            let at = |i: usize, k: usize| 40.0 * (i as f64 / (SCAN[k] - 1) as f64 - 0.5);
            at(k % SCAN[0], 0).hypot(at(k / SCAN[0], 1)) > 25.0
        })
        .count();
    assert_eq!(document["off_part"].as_array().unwrap().len(), outside);
    assert_eq!(document["used"], 1500 - outside);
    bench.write("broken.toml", LENS.replace("radius_mm = 25.0", "radius_mm = -25.0"));
    let output = bench.register("broken.toml", "lens.csv", &["--out", "out2"]);
    assert_eq!(output.status.code(), Some(2));
    fs::remove_dir_all(bench.path("out")).unwrap();
    bench.refused("broken.toml", "lens.csv", &[], &["broken.toml", "radius_mm"]);
    bench.refused("lens.toml", "lens.csv", &["--projection", "xy"], &["lens.toml", "--projection"]);
}

#[test]
fn initial_pose_from_json_or_text() {
    let bench = Bench::new();
    let first = bench.registered("nominal.csv", "measured.csv", &[]);
    fs::rename(bench.path("out/here/registration.json"), bench.path("earlier.json")).unwrap();
    bench.write("rows.json", first["cmm_from_model"].to_string());
    bench.write("rows.txt", pose(&first).concat().iter().map(|v| format!("{v} ")).collect::<String>());
    for name in ["earlier.json", "rows.json", "rows.txt"] {
        let again = bench.registered("nominal.csv", "measured.csv", &["--initial", name]);
        assert_pose(&again, FORM_SHIFT_MM);
        assert!(again["iterations"].as_u64() <= first["iterations"].as_u64());
    }
}

#[test]
fn locked_coordinates_stay_fixed() {
    let bench = Bench::new();
    let shape = FreeForm::default();
    let place = Placement::new([0.02, 0.01, 0.05], [0.0; 3]);
    bench.write("near.csv", rows(&scan(&shape, &FormError::none(), [98.0, 58.0], &place), ","));
    bench.write("identity.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
    let lock = ["--lock", "rx,ry,rz"];
    for more in [&lock[..], &[&lock[..], &["--initial", "identity.txt"]].concat()] {
        let found = pose(&bench.registered("nominal.csv", "near.csv", more));
        for i in 0..3 {
            assert!((found[i][3] - place.translation_mm[i]).abs() < 1e-5, "{found:?}");
            assert!((0..3).all(|k| (found[i][k] - f64::from(i == k)).abs() < 1e-12), "{found:?}");
        }
    }
}

#[test]
fn register_prints_json_or_text() {
    let bench = Bench::new();
    let output = bench.register("nominal.csv", "measured.csv", &["--json"]);
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    let written: Value = serde_json::from_slice(&fs::read(bench.path("out/here/registration.json")).unwrap()).unwrap();
    assert_eq!(printed, written);
    assert!(output.stderr.is_empty());
    let words = text(&bench.register("nominal.csv", "measured.csv", &[]).stdout);
    for word in ["18,281 points", "1,500 points", " µm", "iterations", "out/here"] {
        assert!(words.contains(word), "`{word}` is missing:\n{words}");
    }
}

/// Two halves of a cloud, one of them in a frame of its own, are stitched.
#[test]
fn stitch_writes_poses_and_seams() {
    let bench = Bench::new();
    let points = nominal();
    let half = |keep: &dyn Fn(f64) -> bool, step: usize, shift_mm: f64| {
        let kept = points.iter().filter(|p| keep(p[0])).step_by(step);
        let moved: Vec<Vec3> = kept.map(|[x, y, z]| [x + shift_mm, y - shift_mm, z + shift_mm]).collect();
        rows(&moved, ",")
    };
    bench.write("left.csv", half(&|x| x < 8.0, 3, 0.0));
    bench.write("right.csv", half(&|x| x > -8.0, 5, 0.05));
    bench.write("same.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1");
    let stitch = |more: &[&str]| {
        let mut arguments = vec!["stitch", "--nominal", "nominal.csv", "--method", "contact", "--out", "out/here"];
        arguments.extend(["--measured", "left.csv", "--measured", "right.csv"]);
        arguments.extend(more);
        bench.run(&arguments)
    };
    bench.assert_refused(&stitch(&["--place", "same.txt"]), &["--place"]);
    bench.assert_refused(&stitch(&["--measured", "left.csv"]), &["repeat"]);
    let output = stitch(&["--place", "same.txt", "--place", "same.txt", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    let written: Value = serde_json::from_slice(&fs::read(bench.path("out/here/stitching.json")).unwrap()).unwrap();
    assert_eq!(printed, written);
    let shift = |map: usize, k: usize| number(&written["maps"][map]["common_from_map"][k][3]);
    for (k, expected) in [-0.05, 0.05, -0.05].into_iter().enumerate() {
        assert!((shift(1, k) - shift(0, k) - expected).abs() < 1e-3, "{k}: {}", shift(1, k) - shift(0, k));
    }
    assert_eq!(written["covariance"].as_array().unwrap().len(), 12);
    assert_eq!(written["seams"].as_array().unwrap().len(), 1);
    assert_eq!(numbers(&written["seams"][0]["maps"]), [1.0, 2.0]);
    let lines = |name: &str| text(&fs::read(bench.path(&format!("out/here/{name}"))).unwrap()).lines().count();
    assert_eq!(lines("stitched.csv"), lines("deviations.csv"));
}

#[test]
fn register_accepts_every_option() {
    let bench = Bench::new();
    for more in [
        ["--distance", "triangle"],
        ["--loss", "huber"],
        ["--loss", "tukey"],
        ["--projection", "best-fit"],
        ["--side", "normal"],
        ["--max-rms", "0.01"],
        ["--outlier-sigmas", "inf"],
    ] {
        assert_pose(&bench.registered("nominal.csv", "measured.csv", &more), FORM_SHIFT_MM);
    }
    let output = bench.register("nominal.csv", "measured.csv", &["--method", "subtract-radius"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    fs::remove_dir_all(bench.path("out")).unwrap();
    bench.refused("nominal.csv", "measured.csv", &["--max-rms", "0.0001"], &["measured.csv", "rms", "--max-rms"]);
    bench.refused("nominal.csv", "measured.csv", &["--side", "opposite"], &["measured.csv", "side"]);
}

#[test]
fn help_has_an_example() {
    let bench = Bench::new();
    for command in ["register", "accuracy"] {
        let help = text(&bench.run(&[command, "--help"]).stdout);
        assert!(help.contains(&format!("regrind {command} --nominal")), "{help}");
        assert!(help.contains("Exit codes"), "{help}");
    }
    assert_eq!(bench.run(&["--help"]).status.code(), Some(0));
    assert_eq!(bench.run(&[]).status.code(), Some(2));
    assert_eq!(bench.run(&["polish"]).status.code(), Some(2));
}

#[test]
fn register_refuses_malformed_files() {
    let bench = Bench::new();
    let good = rows(measured(), ",");
    let broken = |at: usize, line: &str| -> String {
        good.lines().enumerate().map(|(k, l)| format!("{}\n", if k == at { line } else { l })).collect()
    };
    let cases: [(&str, Vec<u8>, &[&str]); 9] = [
        ("empty.csv", vec![], &["empty"]),
        ("header.csv", b"x,y,z\n".to_vec(), &["header", "export"]),
        ("nan.csv", broken(700, "1.0,NaN,2.0").into_bytes(), &["line 701", "NaN", "remove"]),
        ("word.csv", broken(3, "1.0,two,3.0").into_bytes(), &["line 4", "two"]),
        ("huge.csv", broken(8, "1e300,0.0,1.0").into_bytes(), &["line 9", "1e300"]),
        ("cut.csv", good.as_bytes()[..good.len() - 40].to_vec(), &["line"]),
        ("comma-in-one.csv", broken(9, "1.0;2.0;3.0").into_bytes(), &["line 10"]),
        ("bar.csv", rows(measured(), "|").into_bytes(), &["separated"]),
        ("nul.csv", [&good.as_bytes()[..5000], &[0; 3000], &good.as_bytes()[5000..]].concat(), &["0x00"]),
    ];
    for (name, content, words) in cases {
        bench.write(name, &content);
        let words: Vec<&str> = words.iter().copied().chain([name]).collect();
        bench.refused("nominal.csv", name, &[], &words);
        bench.refused(name, "measured.csv", &[], &words);
    }
}

#[test]
fn register_refuses_missing_or_sparse_file() {
    let bench = Bench::new();
    fs::create_dir(bench.path("folder")).unwrap();
    let mut sparse = fs::File::create(bench.path("sparse.csv")).unwrap();
    sparse.write_all(b"garbage \x00\x01\x02").unwrap();
    sparse.set_len(1 << 30).unwrap();
    for name in ["missing.csv", "folder", "sparse.csv"] {
        bench.refused("nominal.csv", name, &[], &[name]);
        bench.refused(name, "measured.csv", &[], &[name]);
    }
}

#[test]
fn register_refuses_degenerate_clouds() {
    let bench = Bench::new();
    let line: Vec<Vec3> = (0..200).map(|k| [f64::from(k), 2.0 * f64::from(k), 1.0]).collect();
    bench.write("one.csv", "1.0,2.0,3.0\n");
    bench.write("line.csv", rows(&line, ","));
    bench.write("twice.csv", rows(&[nominal(), nominal()].concat(), ","));
    bench.write("joined.csv", rows(&[measured(), measured()].concat(), ","));
    bench.refused("nominal.csv", "one.csv", &[], &["one.csv", "1 measured point", "measure more"]);
    bench.refused("one.csv", "measured.csv", &[], &["one.csv", "at least"]);
    bench.refused("nominal.csv", "line.csv", &[], &["line.csv", "on one line"]);
    bench.refused("line.csv", "measured.csv", &[], &["line.csv", "on one line"]);
    bench.refused("twice.csv", "measured.csv", &[], &["twice.csv", "remove one of them"]);
    bench.refused("nominal.csv", "joined.csv", &[], &["joined.csv", "joined to itself"]);
}

#[test]
fn register_refuses_wrong_units() {
    let bench = Bench::new();
    for (name, factor, unit) in [("metres", 1e-3, "metres"), ("inches", 1.0 / 25.4, "inches")] {
        bench.write(&format!("nominal-{name}.csv"), rows(&scaled(nominal(), factor), ","));
        bench.write(&format!("measured-{name}.csv"), rows(&scaled(measured(), factor), ","));
        let (nominal, measured) = (format!("nominal-{name}.csv"), format!("measured-{name}.csv"));
        bench.refused(&nominal, "measured.csv", &[], &[&nominal, unit, "millimetres"]);
        bench.refused("nominal.csv", &measured, &[], &[&measured, unit, "millimetres"]);
    }
}

#[test]
fn register_refuses_wrong_probe_radius() {
    let bench = Bench::new();
    for radius in ["-1.5", "NaN", "inf", "1,5", "1e3"] {
        bench.refused("nominal.csv", "measured.csv", &["--probe-radius", radius], &["--probe-radius", "above 0"]);
    }
    let arguments = ["register", "--nominal", "nominal.csv", "--measured", "measured.csv", "--out", "out"];
    bench.assert_refused(&bench.run(&arguments), &["--probe-radius", "--method contact"]);
}

#[test]
fn zero_probe_radius_means_contact() {
    let bench = Bench::new();
    bench.write("contacts.csv", rows(nominal(), ","));
    for (name, radius) in [("--probe-radius", "0"), ("--probe-radius-mm", "0.0")] {
        let document = bench.registered("nominal.csv", "contacts.csv", &[name, radius]);
        assert_eq!(document["method"], "contact");
        assert!(number(&document["rms_mm"]) < 1e-6 && document["probe_radius_mm"].is_null(), "{document}");
    }
}

#[test]
fn register_warns_of_doubtful_input() {
    let bench = Bench::new();
    let warned = |measured: &str, more: &[&str]| {
        let words = text(&bench.register("nominal.csv", measured, more).stdout);
        let shown: Vec<String> =
            words.lines().filter_map(|line| line.strip_prefix("warning")).map(|line| line.trim().to_owned()).collect();
        let document = bench.registered("nominal.csv", measured, more);
        assert_eq!(document["warnings"], Value::from(shown.clone()), "{words}");
        shown
    };
    assert_eq!(warned("measured.csv", &[]), [""; 0]);
    let told = warned("measured.csv", &["--probe-radius", "3"]);
    let radius = ["probe radius", "about 1.", "given 3 mm", "diameter"];
    assert!(told.len() == 1 && radius.iter().all(|piece| told[0].contains(piece)), "{told:?}");
    let lines: String = measured().iter().map(|p| format!("{:.6},{:.6},{:.6}\n", p[0], p[1], p[2])).collect();
    bench.write("unended.csv", lines.trim_end());
    let told = warned("unended.csv", &[]);
    assert!(
        told.len() == 1 && told[0].starts_with("unended.csv, line 1500: ") && told[0].contains("check that"),
        "{told:?}"
    );
    bench.write("cut.csv", &lines[..lines.len() - 3]);
    let told = warned("cut.csv", &[]);
    let cut = ["cut.csv, line 1500", "4 digits", "6 or more"];
    assert!(told.len() == 1 && cut.iter().all(|piece| told[0].contains(piece)), "{told:?}");
}

#[test]
fn register_refuses_other_part() {
    let bench = Bench::new();
    let sphere = scan(&Sphere { radius_mm: -80.0 }, &FormError::none(), [98.0, 58.0], &placement());
    bench.write("sphere.csv", rows(&sphere, ","));
    bench.refused("nominal.csv", "sphere.csv", &[], &["sphere.csv", "nominal.csv"]);
}

#[test]
fn register_refuses_mirror_image() {
    let bench = Bench::new();
    for axis in 0..3 {
        let mirrored: Vec<Vec3> =
            measured().iter().map(|p| std::array::from_fn(|k| if k == axis { -p[k] } else { p[k] })).collect();
        bench.write("mirrored.csv", rows(&mirrored, ","));
        bench.refused("nominal.csv", "mirrored.csv", &[], &["mirrored.csv", "mirror image", "reversed"]);
    }
}

#[test]
fn register_refuses_bad_arguments() {
    let bench = Bench::new();
    let refused = |more: &[&str], words: &[&str]| bench.refused("nominal.csv", "measured.csv", more, words);
    refused(&["--lock", "x,yaw"], &["yaw", "--lock", "rx"]);
    refused(&["--distance", "round"], &["--distance", "curved"]);
    refused(&["--outlier-sigmas", "-1"], &["--outlier-sigmas", "above 0"]);
    refused(&["--max-rms", "0"], &["--max-rms", "above 0"]);
    for (name, content) in [
        ("broken.json", "{\"cmm_from_model\": [[1, 0"),
        ("other.json", "{\"pose\": 1}"),
        ("short.txt", "1 0 0 0 1 0"),
        ("scaled.txt", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"),
        ("nan.txt", "NaN 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"),
        ("empty.txt", ""),
    ] {
        bench.write(name, content);
        refused(&["--initial", name], &[name, "16 numbers"]);
    }
    refused(&["--initial", "missing.json"], &["missing.json"]);
}

#[test]
fn out_folder_checked_before_input() {
    let bench = Bench::new();
    bench.write("file", "in the way");
    for out in ["file", "file/below"] {
        // The input does not exist: if the program read it, the message would name it.
        let arguments =
            ["register", "--nominal", "no.csv", "--measured", "no.csv", "--probe-radius", "1.5", "--out", out];
        bench.assert_refused(&bench.run(&arguments), &[out, "failed", "permissions"]);
    }
    assert_eq!(fs::read_to_string(bench.path("file")).unwrap(), "in the way");
}

#[test]
fn accuracy_reports_error_and_spacing() {
    let bench = Bench::new();
    let output = bench.run(&["accuracy", "--nominal", "nominal.csv", "--want", "1", "--json"]);
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    let document: Value = serde_json::from_slice(&output.stdout).unwrap();
    let (curved, triangle) = (&document["curved"], &document["triangle"]);
    assert!(number(&curved["pv_nm"]) * 100.0 < number(&triangle["pv_nm"]), "{document}");
    assert!(number(&curved["wanted_spacing_mm"]) > 5.0 * number(&triangle["wanted_spacing_mm"]), "{document}");
    let coarse = bench.run(&["accuracy", "--nominal", "nominal.csv", "--want", "100"]);
    assert_eq!(coarse.status.code(), Some(0));
    for word in ["curved", "triangle", "spacing", "nm", "worst"] {
        assert!(text(&coarse.stdout).contains(word), "`{word}` is missing");
    }
    bench.write("lens.toml", LENS);
    assert_eq!(bench.run(&["accuracy", "--nominal", "lens.toml"]).status.code(), Some(0));
    bench.write("nominal.stl", stl(nominal()));
    assert_eq!(bench.run(&["accuracy", "--nominal", "nominal.stl"]).status.code(), Some(0));
}

#[test]
fn accuracy_refuses_bad_nominal() {
    let bench = Bench::new();
    bench.write("few.csv", rows(&nominal()[..50], ","));
    bench.write("empty.csv", "");
    for name in ["few.csv", "empty.csv", "missing.csv"] {
        bench.assert_refused(&bench.run(&["accuracy", "--nominal", name]), &[name]);
    }
    let output = bench.run(&["accuracy", "--nominal", "nominal.csv", "--want", "0"]);
    bench.assert_refused(&output, &["--want", "above 0"]);
}

#[test]
fn register_overwrites_its_result() {
    let bench = Bench::new();
    let first = bench.registered("nominal.csv", "measured.csv", &[]);
    assert!(Path::new(&bench.path("out/here/registration.json")).exists());
    assert_eq!(first, bench.registered("nominal.csv", "measured.csv", &[]), "the same input gives the same bits");
}

#[test]
fn model_reports_form_intervals() {
    let bench = Bench::new();
    bench.registered("nominal.csv", "measured.csv", &["--model"]);
    let model: Value = serde_json::from_slice(&fs::read(bench.path("out/here/model.json")).unwrap()).unwrap();
    for figure in ["rms", "pv", "pv_99_8"] {
        let [low, median, high] = ["low_mm", "median_mm", "high_mm"].map(|key| model[figure][key].as_f64().unwrap());
        assert!(0.0 < low && low <= median && median <= high, "{figure}: {model}");
    }
    assert!(model["rms"]["high_mm"].as_f64() < model["raw_rms_mm"].as_f64(), "{model}");
    let rows = |file: &str| fs::read_to_string(bench.path(file)).unwrap().lines().count();
    assert_eq!(rows("out/here/form.csv"), rows("out/here/deviations.csv"));
    let told = text(&bench.register("nominal.csv", "measured.csv", &["--model"]).stdout);
    for label in ["form        RMS ", "frame       "] {
        assert!(told.lines().any(|line| line.starts_with(label)), "{label}: {told}");
    }
}

#[test]
fn plan_reports_time_and_slow_pass() {
    let bench = Bench::new();
    let shipped = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/recipes/shallow-wave.toml")).unwrap();
    let feed = shipped.lines().find(|line| line.starts_with("feed_mm_min")).unwrap();
    bench.write("good.toml", &shipped);
    bench.write("slow.toml", shipped.replace(feed, "feed_mm_min = 16.7"));
    let plan = |recipe: &str| text(&bench.run(&["plan", recipe]).stdout);
    let good = plan("good.toml");
    for words in ["5 passes", "5 measurements", "at least 13.5 minutes", " h or more"] {
        assert!(good.contains(words), "`{words}` is missing: {good}");
    }
    assert!(!good.contains("warning"), "{good}");
    let document =
        |recipe: &str| -> Value { serde_json::from_slice(&bench.run(&["plan", recipe, "--json"]).stdout).unwrap() };
    let told = document("good.toml");
    assert!(told["removed_mm3_a_pass"].is_number() && told["wheel_loss_mm3_a_pass"].is_null(), "{told}");
    assert!(good.contains("mm3 a pass") && good.contains("grinding.grinding_ratio"), "{good}");
    bench.write("worn.toml", shipped.replace(feed, &format!("{feed}\ngrinding_ratio = 200.0")));
    let told = document("worn.toml");
    let [removed, lost] = ["removed_mm3_a_pass", "wheel_loss_mm3_a_pass"].map(|key| told[key].as_f64().unwrap());
    assert!(removed > 0.0 && (removed / lost - 200.0).abs() < 1e-9, "{told}");
    let slow = plan("slow.toml");
    for piece in ["warning  ", "a pass takes", "a shift of 8 h", "at 16.7 mm/min", "grinding.feed_mm_min"] {
        assert!(slow.contains(piece), "{piece}: {slow}");
    }
}

#[test]
fn names_with_hidden_characters_refused() {
    let home = tempfile::tempdir().unwrap();
    let shipped =
        std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/recipes/freeform-mirror.toml")).unwrap();
    let program = || Command::new(env!("CARGO_BIN_EXE_regrind"));
    let check = |from: &str, to: &str| {
        assert!(shipped.contains(from));
        let path = home.path().join("recipe.toml");
        std::fs::write(&path, shipped.replace(from, to)).unwrap();
        let output = program().args(["check", path.to_str().unwrap()]).output().unwrap();
        assert_eq!(output.status.code(), Some(2));
        String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap()
    };
    for name in ["\"free\u{202e}form\"", "\"free\\u202eform\"", "\"free\u{200b}form\""] {
        let said = check("\"free-form mirror\"", name);
        assert!(said.contains("part.name") && said.contains("U+20"), "{said}");
    }
    let feed = shipped.lines().find(|line| line.starts_with("feed_mm_min")).unwrap();
    let said = check(feed, "feed_mm_min = 1e300");
    assert!(said.contains("is 1e300") && !said.contains("0000000000000000"), "{said}");
    for option in ["--part", "--operator"] {
        let output = program().args(["run", "none.toml", option, "A\u{202e}B"]).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && said.contains("U+202E") && said.contains(option), "{said}");
    }
}

#[test]
fn completions_and_man_pages() {
    let bench = Bench::new();
    for (shell, words) in [
        ("bash", "-F _clap_complete_regrind regrind"),
        ("zsh", "#compdef regrind"),
        ("fish", "--command regrind"),
        ("powershell", "Register-ArgumentCompleter"),
    ] {
        let output = bench.run(&["completions", shell]);
        let script = text(&output.stdout);
        assert_eq!(output.status.code(), Some(0));
        assert!(script.contains(words) && script.contains("REGRIND_COMPLETE"), "{shell}: {script}");
    }
    assert_eq!(bench.run(&["man", "--out", "man"]).status.code(), Some(0));
    for (page, words) in [
        ("regrind.1", "Closed\\-loop grinding"),
        ("regrind-run.1", "\\-\\-part"),
        ("regrind-audit-verify.1", "Exit codes"),
    ] {
        let text = fs::read_to_string(bench.path("man").join(page)).unwrap();
        assert!(text.contains(words), "{page}: {text}");
    }
}

/// Checks a file with nominal and measured points side by side, as most machines write it: a person says which columns
/// are measured.
#[test]
fn columns_option_selects_measured() {
    let bench = Bench::new();
    let plain = bench.registered("nominal.csv", "measured.csv", &[]);
    let beside = |separator: &str| -> String {
        let planned = nominal().iter().cycle().zip(measured());
        let row =
            |(n, m): (&Vec3, &Vec3)| n.iter().chain(m).map(f64::to_string).collect::<Vec<_>>().join(separator) + "\n";
        planned.map(row).collect()
    };
    let by_name = "x=X_act,y=Y_act,z=Z_act";
    fs::remove_dir_all(bench.path("out")).unwrap();
    for (name, header) in [
        ("both.csv", "X_nom,Y_nom,Z_nom,X_act,Y_act,Z_act\n"),
        ("words.csv", "Nominal X,Nominal Y,Nominal Z,Measured X,Measured Y,Measured Z\n"),
        ("remark.csv", "# X_nom,Y_nom,Z_nom,X_act,Y_act,Z_act\n"),
        ("none.csv", ""),
    ] {
        bench.write(name, format!("{header}{}", beside(",")));
        bench.refused("nominal.csv", name, &[], &["line 1", "--columns"]);
        let told = if name == "both.csv" { by_name } else { "x=4,y=5,z=6" };
        let found = bench.registered("nominal.csv", name, &["--columns", told]);
        assert_eq!(pose(&found), pose(&plain), "{name}");
        fs::remove_dir_all(bench.path("out")).unwrap();
    }
    bench.refused("nominal.csv", "both.csv", &["--columns", "x=X_ist,y=Y_act,z=Z_act"], &["x_ist"]);
    // A table in inches without a unit in it.
    bench.write("inches.csv", rows(&scaled(measured(), 1.0 / 25.4), ","));
    bench.write("nominal_inches.csv", format!("X_nom,Y_nom,Z_nom\n{}", rows(&scaled(nominal(), 1.0 / 25.4), ",")));
    let found = bench.registered("nominal_inches.csv", "inches.csv", &["--unit", "inch", "--nominal-unit", "inch"]);
    assert!((number(&found["rms_mm"]) / number(&plain["rms_mm"]) - 1.0).abs() < 1e-6, "{found}");
}
