//! One surface as the designer sends it: a formula, STEP, IGES and a lens file give the same registration.

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

/// Returns the pose and the deviations of a registration.
fn registered(folder: &Path, nominal: &Path) -> (Vec<f64>, Vec<f64>) {
    let nominal = nominal.to_str().unwrap();
    let out = "out";
    let arguments = ["register", "--nominal", nominal, "--measured", "measured.csv", "--probe-radius", "1.5"];
    let output = regrind(folder, &[&arguments[..], &["--aperture", APERTURE, "--out", out]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let document: Value =
        serde_json::from_slice(&fs::read(folder.join(out).join("registration.json")).unwrap()).unwrap();
    let rows = document["cmm_from_model"].as_array().unwrap();
    let pose = rows.iter().flat_map(|row| row.as_array().unwrap()).map(|value| value.as_f64().unwrap()).collect();
    let table = fs::read_to_string(folder.join(out).join("deviations.csv")).unwrap();
    let deviations = table.lines().skip(1).map(|line| line.split(',').nth(6).unwrap().parse().unwrap()).collect();
    fs::remove_dir_all(folder.join(out)).unwrap();
    (pose, deviations)
}

#[test]
fn formula_and_designs_give_same_registration() {
    let folder = TempDir::new().unwrap();
    write_inputs(folder.path());
    let (pose, deviations) = registered(folder.path(), Path::new("formula.toml"));
    for (nominal, limit_mm) in [
        (fixture("a-xy-ap214-mm.stp"), 1e-11),
        (fixture("a-xy-ap242-inch.stp"), 1e-8),
        (fixture("a-xy-mm-brep0.igs"), 1e-11),
        (PathBuf::from("lens.zmx"), 1e-11),
    ] {
        let (other_pose, other_deviations) = registered(folder.path(), &nominal);
        let apart = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let (poses, points) = (apart(&pose, &other_pose), apart(&deviations, &other_deviations));
        assert!(poses <= limit_mm && points <= limit_mm, "{}: {poses:e}, {points:e}", nominal.display());
        assert_eq!(deviations.len(), other_deviations.len());
    }
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
