//! Clouds that tell less than a pose: scan lines, narrow strips, few points.

use rand::SeedableRng;
use rand::rngs::StdRng;

use crate::common::{RADIUS_MM, centres, free_form, normal, placed, points, pose};
use regrind_core::geometry::{Point, Pose};
use regrind_core::registration::{Coordinate, Registration, RegistrationError, RegistrationOptions, Start, register};
use regrind_core::surface::{Nominal, PlaneProjection};
use regrind_sim::form::FormError;
use regrind_sim::probe::Placement;
use regrind_sim::shape::{FreeForm, Shape, XyPolynomial};

/// Centres over some places, with scatter and a form of some rms.
fn measured(places: &[[f64; 2]], form_rms_mm: f64, seed: u64) -> Vec<Point> {
    let shape = FreeForm::default();
    let form = FormError::with_rms(&mut regrind_sim::rng(seed), 30.0, form_rms_mm);
    let mut rng = StdRng::seed_from_u64(seed);
    let centre = |&[x, y]: &[f64; 2]| {
        let [p, q] = shape.gradient(x, y);
        let up = 1.0 / (1.0 + p * p + q * q).sqrt();
        let normal_at = [-p * up, -q * up, up];
        let off = RADIUS_MM + form.height(x, y) + 3e-4 * normal(&mut rng);
        let foot = [x, y, shape.height(x, y)];
        std::array::from_fn(|k| foot[k] + off * normal_at[k])
    };
    let centres: Vec<[f64; 3]> = places.iter().map(centre).collect();
    points(&placed(&placement(), &centres))
}

fn placement() -> Placement {
    Placement::new([1.0, -2.0, 0.5], [0.3, -0.2, 0.5])
}

/// Points on a line through a place, in a direction, some millimetres to either side.
fn line(count: u32, [x, y]: [f64; 2], degrees: f64, half_mm: f64) -> Vec<[f64; 2]> {
    let (sine, cosine) = degrees.to_radians().sin_cos();
    let along = |k: u32| half_mm * (2.0 * f64::from(k) / f64::from(count - 1) - 1.0);
    (0..count).map(along).map(|t| [x + t * cosine, y + t * sine]).collect()
}

fn registered(cloud: &[Point], options: &RegistrationOptions) -> Result<Registration, RegistrationError> {
    register(&free_form(205, 125), cloud, options)
}

fn free() -> RegistrationOptions {
    RegistrationOptions::new(RADIUS_MM)
}

#[test]
fn scan_line_is_degenerate() {
    for (degrees, half_mm) in [(0.0, 45.0), (90.0, 26.0), (35.0, 40.0)] {
        for (count, form_mm, seed) in [(30, 0.0, 1), (60, 0.0, 2), (60, 5e-3, 3), (400, 5e-3, 4)] {
            let cloud = measured(&line(count, [2.0, -3.0], degrees, half_mm), form_mm, seed);
            for start in [Start::Search, Start::Pose(pose(&placement()))] {
                let told = registered(&cloud, &RegistrationOptions { start, ..free() });
                let Err(RegistrationError::Narrow { width_mm, distance_mm, .. }) = told else {
                    panic!("{degrees} degrees, {count} points, seed {seed}: {told:?}")
                };
                assert!(width_mm < distance_mm, "{width_mm} {distance_mm}");
            }
        }
    }
}

#[test]
fn degenerate_line_and_valid_strip() {
    // 20 points 4.5 mm apart in each row, the rows `apart` of each other.
    let rows = |count: u32, apart_mm: f64| -> Vec<[f64; 2]> {
        (0..count).flat_map(|row| line(20, [0.0, apart_mm * f64::from(row)], 0.0, 43.0)).collect()
    };
    for (count, apart_mm) in [(2, 0.5), (2, 4.0), (3, 1.0), (3, 2.0)] {
        let told = registered(&measured(&rows(count, apart_mm), 5e-3, 5), &free());
        assert!(matches!(told, Err(RegistrationError::Narrow { .. })), "{count} rows {apart_mm} mm apart");
    }
    for (count, apart_mm) in [(2, 25.0), (4, 6.0), (10, 1.0)] {
        let told = registered(&measured(&rows(count, apart_mm), 0.0, 6), &free());
        assert!(told.is_ok(), "{count} rows {apart_mm} mm apart: {:?}", told.err());
    }
    // A cross is none, nor is a ring.
    let cross = [line(30, [0.0; 2], 0.0, 45.0), line(20, [0.0; 2], 90.0, 26.0)].concat();
    let ring: Vec<[f64; 2]> =
        (0..60).map(|k| f64::from(k) * 0.1047).map(|t| [25.0 * t.cos(), 25.0 * t.sin()]).collect();
    for places in [cross, ring] {
        let truth = pose(&placement());
        let found = registered(&measured(&places, 0.0, 7), &free()).unwrap();
        let off = (truth.inverse() * found.cmm_from_model).log();
        assert!(off.norm() < 0.05, "{off:?}");
    }
}

#[test]
fn line_registers_with_locked_directions() {
    let cloud = measured(&line(60, [2.0, -3.0], 0.0, 45.0), 0.0, 8);
    let start = Start::Pose(pose(&placement()));
    let hold = |held: &[Coordinate]| RegistrationOptions { start, locked: Coordinate::locked_flags(held), ..free() };
    assert!(matches!(registered(&cloud, &hold(&[Coordinate::Y])), Err(RegistrationError::Narrow { .. })));
    let said = registered(&cloud, &free()).unwrap_err().to_string();
    assert!(said.contains("lock y and rx") && said.contains("measure a strip at least"), "{said}");
    let registration = registered(&cloud, &hold(&[Coordinate::Y, Coordinate::Rx])).unwrap();
    assert!(registration.quality.rms_mm < 1e-3);
}

#[test]
fn coverage_of_line_is_its_strip() {
    let cover = |places: &[[f64; 2]]| {
        let start = Start::Pose(pose(&placement()));
        let held = Coordinate::locked_flags(&[Coordinate::Y, Coordinate::Rx]);
        registered(&measured(places, 0.0, 9), &RegistrationOptions { start, locked: held, ..free() })
            .unwrap()
            .quality
            .coverage
    };
    let grid = |columns: u32, rows: u32, [x0, x1]: [f64; 2]| -> Vec<[f64; 2]> {
        let at = |k: u32, count: u32, [a, b]: [f64; 2]| a + (b - a) * (f64::from(k) + 0.5) / f64::from(count);
        (0..columns * rows)
            .map(|k| [at(k % columns, columns, [x0, x1]), at(k / columns, rows, [-30.0, 30.0])])
            .collect()
    };
    let single = cover(&line(120, [0.0, 0.0], 0.0, 49.0));
    let half = cover(&grid(10, 10, [-50.0, 0.0]));
    let full = [[6, 4], [10, 6], [15, 8], [40, 25], [120, 70]].map(|[c, r]| cover(&grid(c, r, [-50.0, 50.0])));
    println!("a line {single:.2}, a half {half:.2}, full patterns {full:.3?}");
    assert!(single < 0.3 && (0.5..0.62).contains(&half), "{single} {half}");
    assert!(full.iter().all(|share| *share > 0.97), "{full:?}");
}

/// A cap that any turn about z leaves as it is, sampled on a grid: what the grid adds turns with nothing.
#[test]
fn rotation_from_sampling_is_locked() {
    for (columns, rows, seed) in [(41, 25, 1), (103, 63, 2), (205, 125, 3), (409, 249, 4)] {
        let r4 = [(4, 0, 1.5), (2, 2, 3.0), (0, 4, 1.5)];
        let shape = XyPolynomial {
            normalisation_radius_mm: 50.0,
            terms: [(2, 0, 12.0), (0, 2, 12.0)].into_iter().chain(r4).collect(),
        };
        let nominal =
            Nominal::from_points(points(&shape.grid(102.0, 62.0, columns, rows)), PlaneProjection::Auto).unwrap();
        let mut rng = StdRng::seed_from_u64(seed);
        let mut cloud =
            placed(&placement(), &centres(&shape, &FormError::none(), [[-48.0, -28.0], [48.0, 28.0]], [47, 31]));
        cloud.iter_mut().flatten().for_each(|v| *v += 3e-4 * normal(&mut rng));
        let options = RegistrationOptions { start: Start::Pose(pose(&placement())), ..free() };
        let found = register(&nominal, &points(&cloud), &options).unwrap();
        let weak: Vec<&str> = found.quality.weak_directions.iter().map(|weak| weak.description.as_str()).collect();
        assert!(
            found.quality.weak_directions.iter().any(|weak| weak.is_undetermined)
                && weak[0].contains("rotation about z"),
            "{columns} x {rows}: {weak:?}, condition {:.1e}",
            found.quality.condition
        );
        let held = found.quality.weak_directions.iter().filter(|weak| weak.is_undetermined).count();
        assert_eq!(held, 1, "{columns} x {rows}: {weak:?}");
    }
}

#[test]
fn points_required_by_free_directions() {
    let places = [[-30.0, -20.0], [30.0, -18.0], [2.0, 25.0], [-10.0, 5.0], [20.0, 10.0], [-25.0, 15.0], [10.0, -10.0]];
    let cloud = measured(&places, 0.0, 10);
    let start = Start::Pose(pose(&placement()));
    let held = Coordinate::locked_flags(&[Coordinate::X, Coordinate::Y, Coordinate::Rz]);
    let options = RegistrationOptions { start, locked: held, ..free() };
    for (count, options, is_enough) in [(7, free(), true), (6, free(), false), (4, options, true), (3, options, false)]
    {
        let start = RegistrationOptions { start, ..options };
        let told = registered(&cloud[..count], &start);
        assert_eq!(told.is_ok(), is_enough, "{count} points: {told:?}");
    }
    let truth = pose(&placement());
    let exact: Pose = registered(&cloud[..4], &options).unwrap().cmm_from_model;
    assert!((truth.inverse() * exact).log().norm() < 1e-2);
    let said = registered(&cloud[..3], &options).unwrap_err().to_string();
    assert!(said.contains("at least 4 are required"), "{said}");
}
