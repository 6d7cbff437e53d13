//! STEP and IGES files of other programs, against what OpenCASCADE reads from them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use regrind_core::geometry::{Aperture, Point, Vector};
use regrind_core::surface::SurfaceChoice;
use regrind_core::surface::analytic::Sampling;
use regrind_core::surface::parametric::{Face, FaceError, FaceFrame, FacePlacement};
use regrind_formats::{CadModel, ChoiceError, FormatError, parse_cad, read_cad};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/cad")
}

fn model(name: &str) -> CadModel {
    read_cad(folder().join(name)).unwrap_or_else(|error| panic!("{error}"))
}

/// Place on a face: point, normal and principal curvatures.
type Place = (Point, Vector, [f64; 2]);

/// Returns the places of a table, by file and number of the face.
fn places() -> BTreeMap<(String, usize), Vec<Place>> {
    let text = std::fs::read_to_string(folder().join("points.csv")).unwrap();
    let mut places: BTreeMap<_, Vec<Place>> = BTreeMap::new();
    for line in text.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        let n: Vec<f64> = cells[2..].iter().map(|cell| cell.parse().unwrap()).collect();
        let place = (Point::new(n[0], n[1], n[2]), Vector::new(n[3], n[4], n[5]), [n[6], n[7]]);
        places.entry((cells[0].to_owned(), cells[1].parse().unwrap())).or_default().push(place);
    }
    places
}

fn face(name: &str, number: usize) -> Face {
    model(name).faces[number - 1].face.clone().unwrap_or_else(|reason| panic!("{name}: {reason}"))
}

fn placed(face: &Face, frame: FaceFrame) -> Result<FacePlacement, FaceError> {
    face.place(frame, None, Sampling::Spacing { spacing_mm: 1.0 })
}

/// Faces that are no surface over x and y, and why.
const NOT_PLACED: [(&str, usize, &str); 12] = [
    ("b-xy-circle-hole.stp", 1, "holes"),
    ("e-closed-tube-in-brep0.igs", 1, "overhang"),
    ("e-cylinder-full-in-brep1.igs", 1, "not a height"),
    ("e-lens-solid-ap242-inch.stp", 2, "not a height"),
    ("e-lens-solid-in-brep1.igs", 2, "not a height"),
    ("e-offset-of-patch-mm-brep1.igs", 1, "unreadable"),
    ("e-periodic-tube-mm-brep1.igs", 1, "overhang"),
    ("e-torus-full-ap242-mm.stp", 1, "no area"),
    ("q-iges-114-spline.igs", 1, "unreadable"),
    ("q-iges-natural-outer-hole.igs", 1, "holes"),
    ("q-iges-scale2.igs", 1, "unreadable"),
    ("q-inner-bound-first.stp", 1, "holes"),
];

/// Height and normal within 1e-9 mm of OpenCASCADE's, each face in a frame of its own.
#[test]
fn faces_match_open_cascade() {
    let mut wrong = Vec::new();
    for ((file, number), places) in places() {
        if file == "q-iges-matrix-nested.igs" || NOT_PLACED.iter().any(|(name, n, _)| *name == file && *n == number) {
            continue;
        }
        let placement = match placed(&face(&file, number), FaceFrame::Face) {
            Ok(placement) => placement,
            Err(error) => {
                wrong.push(format!("{file} {number}: {error}"));
                continue;
            }
        };
        let own = placement.file_from_surface.inverse();
        let scale = places.iter().fold(1.0, |scale: f64, (p, ..)| scale.max(p.coords.amax()));
        for (point, normal, _) in places {
            let (p, n) = (own.transform_point(&point), own.transform_direction(&normal));
            let found = placement.surface.formula().sag_and_gradient(p.x, p.y);
            let Some((z, [gx, gy])) = found else {
                wrong.push(format!("{file} {number}: nothing at {point}"));
                continue;
            };
            let normal = Vector::new(-gx, -gy, 1.0).normalize();
            let off = ((z - p.z) * normal.z).abs() / scale;
            let turned = (normal - n).norm().min((normal + n).norm());
            // An inch file of IGES has its coordinates to some 1e-8 mm, and OpenCASCADE its own rounding.
            if off > 3e-9 || turned > 1e-8 {
                wrong.push(format!("{file} {number}: {off:e}, {turned:e}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Places between those of the table, against OpenCASCADE itself: within 1e-8 mm, also for files in inches.
#[test]
#[ignore = "needs OpenCASCADE: REGRIND_OCP_PYTHON is a Python with cadquery-ocp"]
fn places_match_open_cascade_live() {
    let python = std::env::var("REGRIND_OCP_PYTHON").expect("REGRIND_OCP_PYTHON is a Python with cadquery-ocp");
    let (mut asked, mut normals) = (String::new(), Vec::new());
    let files: Vec<(String, usize)> = places().into_keys().collect();
    for (file, number) in files {
        if file == "q-iges-matrix-nested.igs" || NOT_PLACED.iter().any(|(name, n, _)| *name == file && *n == number) {
            continue;
        }
        let placement = placed(&face(&file, number), FaceFrame::Face).unwrap();
        let [low, high] = placement.surface.aperture().bounds();
        for (s, t) in [(0.5, 0.5), (0.31, 0.42), (0.67, 0.35), (0.44, 0.71), (0.6, 0.6)] {
            let (x, y) = (low[0] + s * (high[0] - low[0]), low[1] + t * (high[1] - low[1]));
            let found = placement.surface.formula().sag_and_gradient(x, y);
            let Some((z, [gx, gy])) = found.filter(|_| placement.surface.aperture().distance_mm(x, y) == 0.0) else {
                continue;
            };
            let point = placement.file_from_surface.transform_point(&Point::new(x, y, z));
            asked += &format!("{file},{:?},{:?},{:?}\n", point.x, point.y, point.z);
            let normal = Vector::new(-gx, -gy, 1.0).normalize();
            normals.push((file.clone(), point, placement.file_from_surface.transform_direction(&normal)));
        }
    }
    let mut child = std::process::Command::new(python)
        .args([folder().join("opencascade.py"), folder()])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    std::io::Write::write_all(&mut child.stdin.take().unwrap(), asked.as_bytes()).unwrap();
    let told = String::from_utf8(child.wait_with_output().unwrap().stdout).unwrap();
    // Messages of OpenCASCADE stand between the lines.
    let rows: Vec<Vec<f64>> = told
        .lines()
        .filter_map(|line| line.split(',').map(|cell| cell.trim().parse().ok()).collect::<Option<Vec<f64>>>())
        .filter(|row| row.len() == 4)
        .collect();
    assert_eq!(rows.len(), normals.len());
    assert!(rows.len() > 150, "{}", rows.len());
    let mut wrong = Vec::new();
    for ((file, point, normal), row) in normals.iter().zip(&rows) {
        let other = Vector::new(row[1], row[2], row[3]);
        let turned = (normal - other).norm().min((normal + other).norm());
        let scale = point.coords.amax().max(1.0);
        if row[0] > 1e-8 * scale || turned > 1e-7 {
            wrong.push(format!("{file} at {point}: {:e} mm, {turned:e}", row[0]));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn areas_match_open_cascade() {
    let text = std::fs::read_to_string(folder().join("faces.csv")).unwrap();
    let mut wrong = Vec::new();
    for line in text.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        let (file, number, area): (_, usize, f64) = (cells[0], cells[1].parse().unwrap(), cells[2].parse().unwrap());
        if NOT_PLACED.contains(&(file, number, "unreadable")) {
            continue;
        }
        let found = face(file, number).area_mm2();
        if (found / area - 1.0).abs() > 0.01 {
            wrong.push(format!("{file} {number}: {found} instead of {area}"));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn curvatures_match_open_cascade() {
    let mut wrong = Vec::new();
    for ((file, number), places) in places() {
        let is_unreadable = NOT_PLACED.iter().any(|(name, _, why)| *name == file && *why == "unreadable");
        if is_unreadable || file == "q-iges-matrix-nested.igs" {
            continue;
        }
        let face = face(&file, number);
        for (point, _, curvatures) in places.into_iter().take(2) {
            let found = face.nearest_point(&point);
            // The sign is that of the normal du x dv, whose sense depends on the parameters.
            let mut both = found.principal_curvatures().unwrap().map(f64::abs);
            let mut expected = curvatures.map(f64::abs);
            both.sort_by(f64::total_cmp);
            expected.sort_by(f64::total_cmp);
            let off = (0..2).map(|k| (both[k] - expected[k]).abs()).fold(0.0, f64::max);
            if off > 1e-6 * expected[1].max(1e-3) {
                wrong.push(format!("{file} {number}: {both:?} instead of {expected:?}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn faces_without_height_are_refused() {
    for (file, number, why) in NOT_PLACED {
        if why == "unreadable" {
            let read = read_cad(folder().join(file));
            assert!(read.is_err() || read.unwrap().faces[number - 1].face.is_err(), "{file}");
            continue;
        }
        let Err(refused) = placed(&face(file, number), FaceFrame::Face) else { panic!("{file}") };
        let is_expected = match why {
            "holes" => matches!(refused, FaceError::Holes { .. }),
            "overhang" => matches!(refused, FaceError::Overhang { .. }),
            "no area" => matches!(refused, FaceError::NoArea),
            _ => matches!(refused, FaceError::NotAHeight | FaceError::Overhang { .. } | FaceError::FacesAway { .. }),
        };
        assert!(is_expected, "{file}: {refused}");
    }
}

/// The polynomial of the files `a`, `b` and so on.
fn polynomial(x: f64, y: f64) -> f64 {
    #[rustfmt::skip]
    const TERMS: [(i32, i32, f64); 14] = [
        (2, 0, 0.0015), (0, 2, 0.0025), (1, 1, -0.00025), (3, 0, 2e-5), (2, 1, -3e-5), (1, 2, 2.5e-5), (0, 3, 4e-5),
        (4, 0, 3e-7), (2, 2, -7e-7), (0, 4, 2e-6), (3, 2, 1e-8), (5, 0, -2e-8), (1, 4, 3e-8), (0, 5, 4e-8),
    ];
    TERMS.iter().map(|(i, j, c)| c * x.powi(*i) * y.powi(*j)).sum()
}

#[test]
fn polynomial_patch_is_exact_in_frame_of_file() {
    for (file, limit_mm) in [
        ("a-xy-ap203-inch.stp", 1e-11),
        ("a-xy-ap214-mm.stp", 1e-14),
        ("a-xy-ap242-inch.stp", 1e-11),
        ("a-xy-mm-brep0.igs", 1e-14),
        // Written with eight decimals of an inch.
        ("a-xy-in-brep0.igs", 1e-7),
        ("q-bezier-surface.stp", 1e-13),
        ("q-bezier-rational-complex.stp", 1e-13),
        ("q-quasi-uniform.stp", 1e-13),
        ("q-geometric-set.stp", 1e-13),
        ("q-iges-weights2.igs", 1e-13),
        ("q-iges-delims.igs", 1e-13),
        ("q-iges-dexp.igs", 1e-13),
    ] {
        let surface = placed(&face(file, 1), FaceFrame::File).unwrap().surface;
        let Aperture::Rectangle { centre_mm, width_mm, height_mm } = surface.aperture() else { panic!("{file}") };
        let is_near = |found: f64, expected: f64| (found - expected).abs() < 2e-7;
        assert!(is_near(centre_mm[0], 0.0) && is_near(*width_mm, 60.0) && is_near(*height_mm, 40.0), "{file}");
        let mut worst = 0.0f64;
        for i in -10..=10 {
            for j in -10..=10 {
                // A little beyond the patch too, where its polynomial goes on.
                let (x, y) = (3.3 * f64::from(i), 2.2 * f64::from(j));
                let (z, _) = surface.formula().sag_and_gradient(x, y).unwrap();
                worst = worst.max((z - polynomial(x, y)).abs());
            }
        }
        assert!(worst < limit_mm, "{file}: {worst:e}");
    }
}

#[test]
fn circular_outline_becomes_circle() {
    for file in ["b-xy-circle-ap242-mm.stp", "b-xy-circle-mm-brep0.igs", "q-comments-crlf.stp", "q-two-data.stp"] {
        let surface = placed(&face(file, 1), FaceFrame::File).unwrap().surface;
        let Aperture::Circle { centre_mm, radius_mm } = surface.aperture() else { panic!("{file}") };
        assert!(centre_mm[0].hypot(centre_mm[1]) < 1e-6 && (radius_mm - 18.0).abs() < 1e-6, "{file}");
    }
}

#[test]
fn parts_occur_where_assembly_puts_them() {
    let assembly = model("c-assembly-ap214-mm.stp");
    assert_eq!(assembly.faces.iter().map(|face| face.name.as_str()).collect::<Vec<_>>(), ["OPTIC", "OPTIC"]);
    let twice = assembly.choose(Some(&SurfaceChoice::Name("OPTIC".into())));
    assert_eq!(twice.unwrap_err(), ChoiceError::SeveralOfName { name: "OPTIC".into(), numbers: vec![1, 2] });
    // An inch part in a millimetre assembly: the same face, 25.4 times as large.
    let mixed = model("q-assembly-mixed-units.stp");
    let [small, large] = [&assembly, &mixed].map(|model| model.faces[0].face.as_ref().unwrap().area_mm2());
    assert!((large / small / (25.4 * 25.4) - 1.0).abs() < 1e-6);
}

#[test]
fn nested_transformations_of_iges_apply_in_turn() {
    let nested = face("q-iges-matrix-nested.igs", 1);
    let surface = nested.surface;
    // OpenCASCADE leaves the outer one out.
    let shift = Vector::new(7.0, 8.0, 9.0);
    for (point, ..) in &places()[&("q-iges-matrix-nested.igs".to_owned(), 1)] {
        let expected = point + shift;
        let nearest = (0..=400).flat_map(|i| (0..=400).map(move |j| (f64::from(i) / 400.0, f64::from(j) / 400.0)));
        let distance = nearest.map(|(u, v)| (surface.evaluate(u, v).point - expected).norm()).fold(f64::MAX, f64::min);
        assert!(distance < 0.2, "{distance}");
    }
}

#[test]
fn face_is_chosen_by_number_name_or_size() {
    let lens = model("e-lens-solid-ap242-inch.stp");
    assert_eq!(lens.choose(None).unwrap().0, 1, "the sphere is larger than the plane below it");
    assert_eq!(lens.choose(Some(&SurfaceChoice::Number(3))).unwrap().0, 3);
    assert_eq!(lens.choose(Some(&SurfaceChoice::Number(4))), Err(ChoiceError::NoNumber { number: 4, count: 3 }));
    assert_eq!(lens.choose(Some(&SurfaceChoice::Number(0))), Err(ChoiceError::NoNumber { number: 0, count: 3 }));
    let nothing = ChoiceError::NoName { name: "A".into(), names: vec![] };
    assert_eq!(lens.choose(Some(&SurfaceChoice::Name("A".into()))), Err(nothing));
    let offset = model("e-offset-of-patch-mm-brep1.igs");
    assert!(matches!(offset.choose(None), Err(ChoiceError::Unreadable { number: 1, .. })));
}

#[test]
fn underside_of_solid_is_refused_in_frame_of_file() {
    let sphere = face("e-lens-solid-ap242-inch.stp", 1);
    let refused = placed(&sphere, FaceFrame::File).unwrap_err();
    assert!(matches!(refused, FaceError::FacesAway { normal } if normal[2] < -0.999), "{refused}");
    let own = placed(&sphere, FaceFrame::Face).unwrap();
    assert!((own.file_from_surface.rotation[(2, 2)] + 1.0).abs() < 1e-12, "z along the outward normal");
}

#[test]
fn damaged_cad_is_refused() {
    let path = Path::new("a.stp");
    let step = std::fs::read_to_string(folder().join("a-xy-ap214-mm.stp")).unwrap();
    let parse = |text: &str| parse_cad(path, text.as_bytes());
    assert_eq!(parse(&step).unwrap().faces.len(), 1);
    assert!(matches!(parse(&step[..step.len() / 2]), Err(FormatError::Cut { .. } | FormatError::Unexpected { .. })));
    for (from, to) in [
        ("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT(.MILLI.,.SECOND.)"),
        ("ISO-10303-21;", "ISO-10303-22;"),
        ("ADVANCED_FACE(", "ADVANCED_FACE(7,"),
    ] {
        assert!(step.contains(from), "{from}");
        let damaged = parse(&step.replace(from, to));
        assert!(damaged.is_err() || damaged.unwrap().faces[0].face.is_err(), "{to}");
    }
    // Two weights or knots too few, a degree that is none: the face is there, with the reason.
    for (from, to) in [("(6,6),(6,6)", "(6,5),(6,6)"), ("'',5,5,(", "'',5,7,("), ("'',5,5,(", "'',99,5,(")] {
        let refused = parse(&step.replace(from, to)).unwrap();
        assert!(refused.faces[0].face.is_err(), "{to}");
        assert!(matches!(refused.choose(None), Err(ChoiceError::Unreadable { number: 1, .. })));
    }
}
