//! Predicted error of the distance, estimated from the nominal points alone, compared with the true error.

use crate::common::points;
use regrind_core::geometry::Point;
use regrind_core::surface::accuracy::{Accuracy, NominalPoints, Reliability, estimate_accuracy};
use regrind_core::surface::{DistanceModel, FacetIndex, Nominal, OffsetSurface, PlaneProjection, Side, SurfaceError};
use regrind_sim::shape::{FreeForm, Shape};

fn free_form(columns: usize, rows: usize) -> Vec<Point> {
    points(&FreeForm::default().grid(FreeForm::WIDTH_MM, FreeForm::DEPTH_MM, columns, rows))
}

/// Returns points of a deterministic scatter: the nodes of a grid, each moved by up to 0.4 of a spacing.
fn scattered(columns: usize, rows: usize) -> Vec<Point> {
    let shape = FreeForm::default();
    let at =
        |k: usize, n: usize, size: f64, jitter: f64| size * ((k as f64 + 0.5 + 0.8 * (jitter - 0.5)) / n as f64 - 0.5);
    let random = |k: usize| ((k as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as f64 / (1u64 << 24) as f64;
    (0..columns * rows)
        .map(|k| {
            let x = at(k % columns, columns, FreeForm::WIDTH_MM, random(2 * k + 1));
            let y = at(k / columns, rows, FreeForm::DEPTH_MM, random(2 * k + 7777));
            Point::from(shape.point(x, y))
        })
        .collect()
}

/// Returns PV and RMS of the true error in nanometres, at exact probe centres well inside the part.
fn true_error_nm(points: Vec<Point>, distance: DistanceModel, step_mm: f64) -> [f64; 2] {
    let shape = FreeForm::default();
    let nominal = Nominal::from_points(points, PlaneProjection::Auto).unwrap();
    let surface = OffsetSurface::new(&nominal, 1.5, Side::Normal).unwrap().with_distance_model(distance);
    let at = |i: usize, n: usize, size: f64| (size - 6.0 * step_mm) * ((i as f64 + 0.37) / n as f64 - 0.5);
    let (mut low, mut high, mut sum) = (f64::INFINITY, f64::NEG_INFINITY, 0.0);
    const COUNT: [usize; 2] = [517, 331];
    for k in 0..COUNT[0] * COUNT[1] {
        let (x, y) = (at(k % COUNT[0], COUNT[0], 102.0), at(k / COUNT[0], COUNT[1], 62.0));
        let (s, n) = (shape.point(x, y), shape.normal(x, y));
        let centre = Point::from(std::array::from_fn::<f64, 3, _>(|k| s[k] + 1.5 * n[k]));
        let error = surface.project(&centre, FacetIndex::UNKNOWN).distance_mm * 1e6;
        (low, high, sum) = (low.min(error), high.max(error), sum + error * error);
    }
    [high - low, (sum / (COUNT[0] * COUNT[1]) as f64).sqrt()]
}

fn predicted(points: &[Point]) -> Accuracy {
    estimate_accuracy(NominalPoints::Points { points, projection: PlaneProjection::Auto }).unwrap()
}

/// Asserts that the predicted PV and rms agree with the true ones within a factor of two.
fn assert_agrees(points: Vec<Point>) {
    const FACTOR: f64 = 2.0;
    let found = predicted(&points);
    for (distance, estimate) in [(DistanceModel::Triangle, &found.flat), (DistanceModel::Curved, &found.curved)] {
        let truth = true_error_nm(points.clone(), distance, found.spacing_mm);
        let inside = [estimate.inside.pv_mm, estimate.inside.rms_mm].map(|mm| 1e6 * mm);
        for (predicted, truth) in inside.into_iter().zip(truth) {
            assert!(
                predicted < FACTOR * truth && truth < FACTOR * predicted,
                "{distance:?}: {predicted} against {truth} nm"
            );
        }
        assert_eq!(estimate.reliability, Reliability::Extrapolated, "{distance:?}");
    }
}

#[test]
fn accuracy_of_grid_within_factor_two() {
    for (columns, rows) in [(128, 156), (181, 101), (451, 251)] {
        assert_agrees(free_form(columns, rows));
    }
}

#[test]
fn accuracy_of_scattered_points() {
    assert_agrees(scattered(300, 180));
}

#[test]
fn accuracy_detects_rounding() {
    let mut points = free_form(451, 251);
    points.iter_mut().for_each(|p| p.z = (p.z * 1e5).round() / 1e5);
    let found = predicted(&points);
    assert_eq!(found.curved.reliability, Reliability::Rounding);
    assert!((3e-6..3e-5).contains(&found.curved.inside.pv_mm), "{:?}", found.curved.inside);
    assert_eq!(found.curved.spacing_for(1e-7), None);
    assert_eq!(found.flat.reliability, Reliability::Extrapolated);
    let ripple = |p: &Point| Point::new(p.x, p.y, p.z + 0.05 * (2.0 * p.x).sin() * (2.1 * p.y).cos());
    let rippled: Vec<Point> = free_form(128, 156).iter().map(ripple).collect();
    assert_eq!(predicted(&rippled).curved.reliability, Reliability::TooCoarse);
}

#[test]
fn accuracy_spacing_for_target() {
    let found = predicted(&free_form(181, 101));
    for (estimate, distance) in [(&found.flat, DistanceModel::Triangle), (&found.curved, DistanceModel::Curved)] {
        let wanted_mm = estimate.inside.pv_mm / 10.0;
        let spacing_mm = estimate.spacing_for(wanted_mm).unwrap();
        let nodes = |size: f64| (size / spacing_mm).ceil() as usize + 1;
        let [pv_nm, _] = true_error_nm(free_form(nodes(102.0), nodes(62.0)), distance, spacing_mm);
        assert!((0.3..3.0).contains(&(pv_nm / (1e6 * wanted_mm))), "{distance:?}: {pv_nm} nm for {wanted_mm} mm");
    }
}

#[test]
fn accuracy_of_plane_is_exact() {
    let points: Vec<Point> = free_form(61, 41).iter().map(|p| Point::new(p.x, p.y, 0.1 * p.x)).collect();
    let found = predicted(&points);
    for estimate in [&found.flat, &found.curved] {
        assert_eq!(estimate.reliability, Reliability::Extrapolated);
        let spacing_mm = estimate.spacing_for(1e-6).unwrap();
        assert!((spacing_mm / found.spacing_mm - 6.0).abs() < 1e-6, "{spacing_mm}");
    }
}

#[test]
fn accuracy_refuses_degenerate_points() {
    let of = |points: &[Point]| {
        estimate_accuracy(NominalPoints::Points { points, projection: PlaneProjection::Auto }).unwrap_err()
    };
    assert!(matches!(of(&[]), SurfaceError::TooFewPoints { .. }));
    // The coarser samplings have too few nodes, or lie on one line. The error is that of the whole list.
    assert_eq!(of(&free_form(9, 9)), SurfaceError::TooFewPoints { points: 81, min_points: 324 });
    assert_eq!(of(&free_form(5, 100)), SurfaceError::TooFewPoints { points: 500, min_points: 2000 });
    let line: Vec<Point> = (0..100).map(|k| Point::new(f64::from(k), 0.0, 0.0)).collect();
    assert!(matches!(of(&line), SurfaceError::Collinear { .. }));
    let mut points = free_form(61, 41);
    points[7].z = f64::NAN;
    assert!(matches!(of(&points), SurfaceError::NotFinite { index: 7 }));
    // Each of them is in a coarser sampling of 200 points, whichever points are kept there.
    let mut points = scattered(20, 10);
    points.extend_from_within(..);
    let SurfaceError::DuplicatePoints { first, second, at } = of(&points) else { panic!("not duplicates") };
    assert_eq!((second - first, [points[first].x, points[first].y, points[first].z]), (200, at));
}
