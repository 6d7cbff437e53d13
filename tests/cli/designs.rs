//! One surface as the designer sends it: a formula, STEP, IGES, a lens file and points give the same registration and
//! the same program.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;
use tempfile::TempDir;

/// Terms of the polynomial of the files `a-xy-*`: powers of x and y, coefficient in mm.
#[rustfmt::skip]
const TERMS: [(i32, i32, f64); 14] = [
    (2, 0, 0.0015), (0, 2, 0.0025), (1, 1, -0.00025), (3, 0, 2e-5), (2, 1, -3e-5), (1, 2, 2.5e-5), (0, 3, 4e-5),
    (4, 0, 3e-7), (2, 2, -7e-7), (0, 4, 2e-6), (3, 2, 1e-8), (5, 0, -2e-8), (1, 4, 3e-8), (0, 5, 4e-8),
];

/// Outline of all of them, smaller than the patch so that the test is fast.
const APERTURE: &str = "kind = \"rectangle\", width_mm = 24, height_mm = 20";

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src/formats/tests/fixtures/cad").join(name)
}

fn regrind(folder: &Path, arguments: &[&str]) -> Output {
    crate::program::regrind(arguments, folder).output().unwrap()
}

fn polynomial(x: f64, y: f64) -> (f64, [f64; 2]) {
    TERMS.iter().fold((0.0, [0.0; 2]), |(z, [gx, gy]), &(i, j, c)| {
        let (px, py) = (x.powi(i), y.powi(j));
        let by = |base: f64, power: i32| if power == 0 { 0.0 } else { f64::from(power) * base.powi(power - 1) };
        (z + c * px * py, [gx + c * by(x, i) * py, gy + c * px * by(y, j)])
    })
}

/// Writes the formula, the lens file and measured probe centres, which are turned and shifted.
fn write_inputs(folder: &Path) {
    let terms: Vec<String> = TERMS.iter().map(|(i, j, c)| format!("[{i}, {j}, {c:e}]")).collect();
    let formula = format!(
        "[surface]\nkind = \"xy-polynomial\"\nnormalisation_radius_mm = 1.0\nterms = [{}]\n[aperture]\n{}\n",
        terms.join(", "),
        APERTURE.replace(", ", "\n")
    );
    fs::write(folder.join("formula.toml"), formula).unwrap();
    // An extended polynomial: x, y, x^2, x y, y^2 ..., without a constant.
    let mut lens = "UNIT MM\nSURF 0\n  TYPE STANDARD\n  CURV 0\nSURF 1\n  TYPE XPOLYNOM\n  CURV 0\n  DIAM 40\n  XDAT 1 20 0 0\n  XDAT 2 1.0\n".to_owned();
    let order = (1..=5).flat_map(|degree| (0..=degree).map(move |j| (degree - j, j)));
    for (k, (i, j)) in (3..).zip(order) {
        let value = TERMS.iter().find(|term| (term.0, term.1) == (i, j)).map_or(0.0, |term| term.2);
        writeln!(lens, "  XDAT {k} {value:e}").unwrap();
    }
    lens += "SURF 2\n  TYPE STANDARD\n  CURV 0\n";
    fs::write(folder.join("lens.zmx"), lens).unwrap();
    let mut measured = "x_mm,y_mm,z_mm\n".to_owned();
    let (sine, cosine) = 0.02f64.sin_cos();
    for k in 0..200 {
        let place = |step: f64, size: f64| size * ((f64::from(k) * step).fract() - 0.5);
        let (x, y) = (place(0.754_877_666, 22.0), place(0.569_840_291, 18.0));
        let (z, [gx, gy]) = polynomial(x, y);
        let length = (1.0 + gx * gx + gy * gy).sqrt();
        let out = 1.5 + 0.002 * (x / 3.0).sin() * (y / 4.0).cos();
        let [x, y, z] = [x - out * gx / length, y - out * gy / length, z + out / length];
        let [y, z] = [cosine * y - sine * z, sine * y + cosine * z];
        writeln!(measured, "{},{},{}", x + 0.4, y - 0.3, z + 2.0).unwrap();
    }
    fs::write(folder.join("measured.csv"), measured).unwrap();
}

/// Writes points of the surface on 0.1 x 0.05 mm over the outline.
fn write_points(path: &Path) {
    let mut points = "x_mm,y_mm,z_mm\n".to_owned();
    for (i, j) in (-120..=120).flat_map(|i| (-200..=200).map(move |j| (i, j))) {
        let (x, y) = (f64::from(i) / 10.0, f64::from(j) / 20.0);
        writeln!(points, "{x},{y},{}", polynomial(x, y).0).unwrap();
    }
    fs::write(path, points).unwrap();
}

/// Returns the pose, its standard uncertainties and the deviations of a registration.
fn registered(folder: &Path, nominal: &Path, aperture: &[&str]) -> (Vec<f64>, [f64; 6], Vec<f64>) {
    let nominal = nominal.to_str().unwrap();
    let out = "out";
    let arguments = ["register", "--nominal", nominal, "--measured", "measured.csv", "--probe-radius", "1.5"];
    let output = regrind(folder, &[&arguments[..], aperture, &["--out", out]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let document: Value =
        serde_json::from_slice(&fs::read(folder.join(out).join("registration.json")).unwrap()).unwrap();
    let rows = document["cmm_from_model"].as_array().unwrap();
    let pose = rows.iter().flat_map(|row| row.as_array().unwrap()).map(|value| value.as_f64().unwrap()).collect();
    let table = fs::read_to_string(folder.join(out).join("deviations.csv")).unwrap();
    let deviations = table.lines().skip(1).map(|line| line.split(',').nth(6).unwrap().parse().unwrap()).collect();
    fs::remove_dir_all(folder.join(out)).unwrap();
    let sigmas = std::array::from_fn(|k| document["covariance"][k][k].as_f64().unwrap().sqrt());
    (pose, sigmas, deviations)
}

#[test]
fn formula_and_designs_give_same_registration() {
    let folder = TempDir::new().unwrap();
    write_inputs(folder.path());
    let aperture = ["--aperture", APERTURE];
    let (pose, _, deviations) = registered(folder.path(), Path::new("formula.toml"), &aperture);
    for (nominal, limit_mm) in [
        (fixture("a-xy-ap214-mm.stp"), 1e-11),
        (fixture("a-xy-ap242-inch.stp"), 1e-8),
        (fixture("a-xy-mm-brep0.igs"), 1e-11),
        (PathBuf::from("lens.zmx"), 1e-11),
    ] {
        let (other_pose, _, other_deviations) = registered(folder.path(), &nominal, &aperture);
        let (poses, points) = (apart(&pose, &other_pose), apart(&deviations, &other_deviations));
        assert!(poses <= limit_mm && points <= limit_mm, "{}: {poses:e}, {points:e}", nominal.display());
    }
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// The shape determines x, y and the rotation about z only to 30 µm and 1 mrad, so the pose is compared in shares of its
/// uncertainty.
#[test]
fn points_give_registration_of_formula() {
    let folder = TempDir::new().unwrap();
    write_inputs(folder.path());
    write_points(&folder.path().join("points.csv"));
    let (pose, sigmas, deviations) = registered(folder.path(), Path::new("formula.toml"), &["--aperture", APERTURE]);
    let (other_pose, _, other_deviations) = registered(folder.path(), Path::new("points.csv"), &[]);
    let off_mm = apart(&deviations, &other_deviations);
    assert!(off_mm <= 1e-7, "{off_mm:e}");
    for k in 0..3 {
        let off_mm = (pose[4 * k + 3] - other_pose[4 * k + 3]).abs();
        assert!(off_mm <= 1e-7 + 1e-3 * sigmas[k], "axis {k}: {off_mm:e}");
    }
}

/// Returns the recipe of a part with this nominal surface.
fn recipe(nominal: &str) -> String {
    let recipe =
        fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("recipes/freeform-mirror.toml")).unwrap();
    let (head, rest) = recipe.split_once("[nominal.surface]").unwrap();
    let (_, rest) = rest.split_once("[measure]").unwrap();
    let rest = rest.replace("columns = 60 ", "columns = 20 ").replace("rows = 30", "rows = 16");
    format!("{}{nominal}\n[measure]{rest}", head.replace("#:schema", "# schema"))
}

/// Returns the tracks of the planned program: the positions in mm between two rapid moves, with rising x.
fn planned_tracks(folder: &Path, name: &str, nominal: &str) -> Vec<Vec<[f64; 3]>> {
    fs::write(folder.join(name).with_extension("toml"), recipe(nominal)).unwrap();
    let output = regrind(folder, &["plan", &format!("{name}.toml"), "--program", &format!("{name}.ngc")]);
    assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    let program = fs::read_to_string(folder.join(name).with_extension("ngc")).unwrap();
    let mut position = [f64::NAN; 3];
    let mut tracks = vec![Vec::new()];
    for line in program.lines().map(|line| line.split('(').next().unwrap()) {
        let starts: Vec<usize> =
            line.char_indices().filter(|(_, c)| c.is_ascii_uppercase()).map(|(at, _)| at).collect();
        for (k, &at) in starts.iter().enumerate() {
            let Some(axis) = "XYZ".find(&line[at..=at]) else { continue };
            let end = starts.get(k + 1).copied().unwrap_or(line.len());
            position[axis] = line[at + 1..end].trim().parse().unwrap();
        }
        if line.starts_with("G0 ") {
            tracks.push(Vec::new());
        }
        tracks.last_mut().unwrap().push(position);
    }
    tracks.retain(|track| track.len() > 100);
    for track in &mut tracks {
        // The first positions are above the track.
        track.retain(|position| position.iter().all(|x| x.is_finite()));
        track.dedup_by_key(|position| [position[0], position[1]]);
        if track[0][0] > track[1][0] {
            track.reverse();
        }
    }
    tracks
}

/// Returns a coordinate of a track at `x`, by the polynomial through the six positions around it.
fn interpolated(track: &[[f64; 3]], x: f64, axis: usize) -> f64 {
    let behind = track.partition_point(|position| position[0] < x);
    let around = &track[behind - 3..behind + 3];
    let weight = |k: usize| {
        let others = around.iter().enumerate().filter(|(other, _)| *other != k);
        others.map(|(_, other)| (x - other[0]) / (around[k][0] - other[0])).product::<f64>()
    };
    (0..6).map(|k| weight(k) * around[k][axis]).sum()
}

#[test]
fn formula_and_designs_give_same_program() {
    let folder = TempDir::new().unwrap();
    write_inputs(folder.path());
    write_points(&folder.path().join("points.csv"));
    let aperture = format!("[nominal.aperture]\n{}\n", APERTURE.replace(", ", "\n"));
    let formula = fs::read_to_string(folder.path().join("formula.toml")).unwrap();
    let formula = formula.split("[aperture]").next().unwrap().replace("[surface]", "[nominal.surface]");
    let of_formula = planned_tracks(folder.path(), "program", &format!("{formula}{aperture}"));
    assert!(of_formula.len() > 80, "{}", of_formula.len());
    for file in [
        fixture("a-xy-ap214-mm.stp"),
        fixture("a-xy-ap242-inch.stp"),
        fixture("a-xy-mm-brep0.igs"),
        PathBuf::from("lens.zmx"),
    ] {
        let nominal = format!("[nominal]\nfile = {:?}\n{aperture}", file.to_str().unwrap());
        let tracks = planned_tracks(folder.path(), "program", &nominal);
        let off_mm = apart(&tracks.concat().concat(), &of_formula.concat().concat());
        // One step of the last digit.
        assert!(off_mm < 1.001e-6, "{}: {off_mm:e}", file.display());
    }
    // The program from points has other positions along the same tracks, and beyond the points the surface is not known.
    let tracks = planned_tracks(folder.path(), "program", "[nominal]\nfile = \"points.csv\"\n");
    assert_eq!(tracks.len(), of_formula.len());
    let mut off_mm: f64 = 0.0;
    for (track, expected) in tracks.iter().zip(&of_formula) {
        let inside: Vec<_> = expected.iter().filter(|position| position[0].abs() <= 10.0).collect();
        assert!(inside.len() > 50, "{}", inside.len());
        for position in inside {
            let off = |axis: usize| (interpolated(track, position[0], axis) - position[axis]).abs();
            off_mm = off_mm.max(off(1)).max(off(2));
        }
    }
    // The last digits of seven positions take some of this nanometre and a half.
    assert!(off_mm < 1.5e-6, "{off_mm:e}");
}

#[test]
fn faces_are_listed_and_chosen() {
    let folder = TempDir::new().unwrap();
    let lens = fixture("e-lens-solid-ap242-inch.stp");
    let lens = lens.to_str().unwrap();
    let listed =
        regrind(folder.path(), &["accuracy", "--nominal", lens, "--face", "3", "--face-frame", "face", "--json"]);
    assert!(listed.status.success(), "{}", String::from_utf8_lossy(&listed.stderr));
    let document: Value = serde_json::from_slice(&listed.stdout).unwrap();
    let faces = document["faces"].as_array().unwrap();
    let chosen: Vec<bool> = faces.iter().map(|face| face["chosen"].as_bool().unwrap()).collect();
    assert_eq!(chosen, [false, false, true]);
    assert_eq!(faces[2]["kind"], "plane");
    for arguments in [&["--face", "9"][..], &["--face", "nothing"], &["--face", "2"], &["--aperture", "kind = 1"]] {
        let refused = regrind(folder.path(), &[&["accuracy", "--nominal", lens][..], arguments].concat());
        assert_eq!(refused.status.code(), Some(2), "{arguments:?}");
    }
    // Points have no faces.
    fs::write(folder.path().join("points.csv"), "0,0,0\n1,0,0\n0,1,0\n").unwrap();
    let refused = regrind(folder.path(), &["accuracy", "--nominal", "points.csv", "--face", "1"]);
    assert_eq!(refused.status.code(), Some(2));
}
