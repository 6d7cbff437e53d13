//! Limits of a registration: edges, gaps, sides, locked poses and invalid points.
//! The registration reports each limit, or returns an error with the place.

use crate::common::{RADIUS_MM, centres, free_form, normal, placed, points, pose, pose_error_mm};
use rand::{RngExt, SeedableRng, rngs::StdRng};
use regrind_core::geometry::{Point, Pose, Vector};
use regrind_core::registration::{
    PointStatus, ProbeSide, Registration, RegistrationError, RegistrationOptions, Start, register,
};
use regrind_core::surface::accuracy::{NominalPoints, estimate_accuracy};
use regrind_core::surface::{Nominal, PlaneProjection, SurfaceError};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise};
use regrind_sim::shape::{FreeForm, Shape, Sphere};

const NOISE_MM: f64 = 3e-4;

fn placement() -> Placement {
    Placement::new([12.0, -8.0, 5.0], [4.0, -3.0, 20.0])
}

/// Returns probe centres over a rectangle of the free form, in the model frame.
fn model_centres(corners: [[f64; 2]; 2], counts: [usize; 2], noise_mm: f64) -> Vec<[f64; 3]> {
    let form = FormError::new(7, 30.0, 5e-4, 102.0, 62.0);
    let mut all = centres(&FreeForm::default(), &form, corners, counts);
    add_noise(&mut regrind_sim::rng(11), &mut all, noise_mm);
    all
}

fn cloud(corners: [[f64; 2]; 2], counts: [usize; 2]) -> Vec<Point> {
    points(&placed(&placement(), &model_centres(corners, counts, NOISE_MM)))
}

const WHOLE: [[f64; 2]; 2] = [[-50.0, -30.0], [50.0, 30.0]];

fn statuses(found: &Registration, status: PointStatus) -> Vec<usize> {
    (0..found.deviations.len()).filter(|&k| found.deviations[k].status == status).collect()
}

fn has_warning(found: &Registration, word: &str) -> bool {
    found.quality.warnings.iter().any(|warning| warning.contains(word))
}

/// Returns the part of the free form from its end at negative x to `to_x_mm`.
fn part_of_the_free_form(to_x_mm: f64) -> Nominal {
    let columns = ((to_x_mm + 51.0) / 0.5).round() as usize + 1;
    let shape = FreeForm::default();
    let node = |k: usize| {
        let [x, y] = [-51.0 + 0.5 * (k % columns) as f64, -31.0 + 0.5 * (k / columns) as f64];
        Point::new(x, y, shape.height(x, y))
    };
    Nominal::from_points((0..columns * 125).map(node).collect(), PlaneProjection::Auto).unwrap()
}

#[test]
fn points_beyond_edge_have_no_effect() {
    let measured = cloud(WHOLE, [80, 40]);
    let truth = pose(&placement());
    for to_x_mm in [36.0, 22.0, 12.0, 4.0] {
        let nominal = part_of_the_free_form(to_x_mm);
        for start in [Start::Search, Start::Pose(truth)] {
            let options = RegistrationOptions { start, ..RegistrationOptions::new(RADIUS_MM) };
            let found = register(&nominal, &measured, &options).unwrap();
            let off = statuses(&found, PointStatus::OffPart);
            // By hand: the truth tells on which side of the edge each touch is.
            let inside: Vec<usize> =
                (0..measured.len()).filter(|&k| -50.0 + 100.0 * (k % 80) as f64 / 79.0 <= to_x_mm).collect();
            let expected = measured.len() - inside.len();
            assert!(off.len().abs_diff(expected) <= 40, "{to_x_mm}: {} of {expected} off the part", off.len());
            let used = found.deviations.iter().filter(|d| d.status == PointStatus::Inlier);
            let farthest_mm = used.fold(f64::NEG_INFINITY, |most, d| most.max(d.point.x - to_x_mm));
            assert!(farthest_mm < 1e-3, "{to_x_mm}: a point {farthest_mm} mm beyond the edge");
            // The others alone give the same map.
            let alone: Vec<Point> = inside.iter().map(|&k| measured[k]).collect();
            let options = RegistrationOptions { start: Start::Pose(truth), ..options };
            let other = register(&nominal, &alone, &options).unwrap();
            let squares: Vec<f64> = inside
                .iter()
                .zip(&other.deviations)
                .filter(|(k, d)| found.deviations[**k].status == PointStatus::Inlier && d.status == PointStatus::Inlier)
                .map(|(k, d)| (found.deviations[*k].deviation_mm - d.deviation_mm).powi(2))
                .collect();
            let rms_mm = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
            println!("{to_x_mm}: {} off, the map differs by {rms_mm:.2e} mm rms", off.len());
            assert!(rms_mm < 5e-6, "{to_x_mm}: {rms_mm}");
            assert!(
                has_warning(&found, "beyond the edge") == (off.len() * 5 > measured.len()),
                "{:?}",
                found.quality.warnings
            );
        }
    }
}

/// Returns scattered nominal points over the free form. Their spacing is a function of x.
fn scattered(step_mm: impl Fn(f64) -> f64, noise_mm: f64) -> Vec<Point> {
    let (mut rng, shape) = (StdRng::seed_from_u64(5), FreeForm::default());
    let mut all = Vec::new();
    let mut x = -51.0;
    while x < 51.0 {
        let step = step_mm(x);
        let mut y = -31.0;
        while y < 31.0 {
            let [u, v] = [x, y].map(|c| c + 0.3 * step * (rng.random::<f64>() - 0.5));
            all.push(Point::new(u, v, shape.height(u, v) + noise_mm * normal(&mut rng)));
            y += step;
        }
        x += step;
    }
    all
}

#[test]
fn sparse_nominal_has_no_false_edge() {
    for ratio in [4.0, 10.0] {
        let nominal =
            Nominal::from_points(scattered(|x| if x < 0.0 { 0.25 } else { 0.25 * ratio }, 0.0), PlaneProjection::Xy)
                .unwrap();
        let found =
            register(&nominal, &cloud([[-48.0, -28.0], [48.0, 28.0]], [60, 30]), &RegistrationOptions::new(RADIUS_MM))
                .unwrap();
        assert_eq!(statuses(&found, PointStatus::OffPart), [0usize; 0], "{ratio}");
    }
}

#[test]
fn gap_of_nominal_is_reported() {
    let holed = scattered(|_| 0.5, 0.0).into_iter().filter(|p| p.x.hypot(p.y) > 8.0).collect();
    let nominal = Nominal::from_points(holed, PlaneProjection::Xy).unwrap();
    let found = register(&nominal, &cloud(WHOLE, [60, 30]), &RegistrationOptions::new(RADIUS_MM)).unwrap();
    let off = statuses(&found, PointStatus::OffPart);
    assert!(!off.is_empty() && off.iter().all(|&k| found.deviations[k].point.coords.xy().norm() < 8.5));
    assert!(
        has_warning(&found, "over a gap") && !has_warning(&found, "beyond the edge"),
        "{:?}",
        found.quality.warnings
    );
}

#[test]
fn projection_stays_on_gutter_wall() {
    const GUTTER_MM: f64 = 4.0;
    const BALL_MM: f64 = 2.0;
    // A cylinder about y that is open upwards, to a slope of 72 degrees; a little narrower at one end, which holds it
    // along y.
    let radius = |y: f64| GUTTER_MM + 0.01 * y;
    let height = |x: f64, y: f64| -(radius(y).powi(2) - x * x).sqrt();
    for as_grid in [true, false] {
        let mut rng = StdRng::seed_from_u64(3);
        let node = |k: usize| {
            let jitter = if as_grid { 0.0 } else { 0.02 };
            let x = 3.8 * (2.0 * (k % 121) as f64 / 120.0 - 1.0) + jitter * (rng.random::<f64>() - 0.5);
            let y = 15.0 * (2.0 * (k / 121) as f64 / 120.0 - 1.0);
            Point::new(x, y, height(x, y))
        };
        let nominal = Nominal::from_points((0..121 * 121).map(node).collect(), PlaneProjection::Xy).unwrap();
        let centre = |k: usize| {
            let angle = 1.15 * (2.0 * (k % 25) as f64 / 24.0 - 1.0);
            let y = 13.0 * (2.0 * (k / 25) as f64 / 24.0 - 1.0);
            let inner = radius(y) - BALL_MM;
            Point::new(inner * angle.sin(), y, -inner * angle.cos())
        };
        let truth = pose(&Placement::new([3.0, -2.0, 1.0], [2.0, -3.0, 5.0]));
        let measured: Vec<Point> = (0..625).map(|k| truth.transform_point(&centre(k))).collect();
        for start in [Start::Search, Start::Pose(truth)] {
            let options = RegistrationOptions { start, side: ProbeSide::Above, ..RegistrationOptions::new(BALL_MM) };
            let found = register(&nominal, &measured, &options).unwrap();
            let largest = found.deviations.iter().fold(0.0f64, |most, d| most.max(d.deviation_mm.abs()));
            assert!(largest < 0.01, "grid {as_grid}, {start:?}: {largest}");
        }
    }
}

#[test]
fn near_duplicates_and_far_off_refused() {
    for apart_mm in [1e-7, 1e-6, 1e-5] {
        let mut nominal = scattered(|_| 0.5, 0.0);
        let twin = nominal[700] + Vector::new(apart_mm, 0.0, 0.0);
        nominal.push(twin);
        match Nominal::from_points(nominal.clone(), PlaneProjection::Xy) {
            Err(SurfaceError::NearDuplicates { first: 700, second, .. }) => assert_eq!(second, nominal.len() - 1),
            other => panic!("{apart_mm}: {:?}", other.err()),
        }
    }
    let mut nominal = scattered(|_| 0.5, 0.0);
    nominal[300] = Point::new(1e6, 0.0, 0.0);
    let refused = Nominal::from_points(nominal, PlaneProjection::Xy).err();
    assert!(matches!(refused, Some(SurfaceError::FarOff { index: 300, .. })), "{refused:?}");
    let mut measured = cloud(WHOLE, [40, 20]);
    measured[17] = Point::new(0.0, -1e6, 0.0);
    let refused = register(&free_form(205, 125), &measured, &RegistrationOptions::new(RADIUS_MM)).err();
    assert!(matches!(refused, Some(RegistrationError::FarOff { index: 17, .. })), "{refused:?}");
}

#[test]
fn noisy_nominal_is_reported() {
    let measured = cloud([[-48.0, -28.0], [48.0, 28.0]], [60, 30]);
    for (noise_mm, is_told) in [(0.0, false), (1e-3, true)] {
        let nominal = Nominal::from_points(scattered(|_| 0.5, noise_mm), PlaneProjection::Xy).unwrap();
        let found = register(&nominal, &measured, &RegistrationOptions::new(RADIUS_MM)).unwrap();
        assert_eq!(
            has_warning(&found, "nominal points have a noise"),
            is_told,
            "{noise_mm}: {:?}",
            found.quality.warnings
        );
    }
}

#[test]
fn wrong_lock_is_not_mirror_image() {
    let nominal = free_form(205, 125);
    let measured = cloud(WHOLE, [40, 20]);
    // Held 3 mm and 2 degrees beside the truth.
    let beside = Pose::exp(&regrind_core::geometry::Twist::new(3.0, 0.0, 0.0, 0.0, 0.0, 0.035));
    let start = Start::Pose(pose(&placement()) * beside);
    let locked = [true, true, false, false, false, true];
    let refused =
        register(&nominal, &measured, &RegistrationOptions { start, locked, ..RegistrationOptions::new(RADIUS_MM) })
            .unwrap_err();
    let RegistrationError::DoesNotFit { remedy, .. } = &refused else { panic!("{refused:?}") };
    assert!(remedy.contains("locked pose"), "{remedy}");
    // A mirror image is one all the same.
    let mirrored: Vec<Point> = measured.iter().map(|p| Point::new(-p.x, p.y, p.z)).collect();
    let refused =
        register(&nominal, &mirrored, &RegistrationOptions { start, locked, ..RegistrationOptions::new(RADIUS_MM) })
            .unwrap_err();
    assert!(matches!(refused, RegistrationError::Mirrored { .. }), "{refused:?}");
}

#[test]
fn better_probe_side_is_certain() {
    let measured = cloud(WHOLE, [80, 40]);
    for to_x_mm in [51.0, 12.0] {
        let found = register(&part_of_the_free_form(to_x_mm), &measured, &RegistrationOptions::new(RADIUS_MM)).unwrap();
        assert!(!has_warning(&found, "the side of the probe"), "{to_x_mm}: {:?}", found.quality.warnings);
    }
}

#[test]
fn free_directions_start_at_file_frame() {
    let flat = |k: usize| Point::new((k % 61) as f64 - 30.0, (k / 61) as f64 - 20.0, 0.0);
    let nominal = Nominal::from_points((0..61 * 41).map(flat).collect(), PlaneProjection::Xy).unwrap();
    let tilt = pose(&Placement::new([4.0, -3.0, 7.0], [1.0, -2.0, 0.0]));
    let centre = |k: usize| Point::new(2.0 * (k % 25) as f64 - 24.0, 2.0 * (k / 25) as f64 - 16.0, RADIUS_MM);
    let measured: Vec<Point> = (0..25 * 17).map(|k| tilt.transform_point(&centre(k))).collect();
    let found = register(&nominal, &measured, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    let turned = found.cmm_from_model.angle_rad().to_degrees();
    assert!(turned < 3.0, "a flat is turned by {turned} degrees");
    // A bump on a twentieth of the touches is a defect: a flat is its own mirror image.
    let bump = |p: &Point| {
        let away = (p.x - 9.0).hypot(p.y + 5.0);
        Point::new(p.x, p.y, RADIUS_MM + 1e-3 * (1.0 - away / 6.0).max(0.0))
    };
    let bumped: Vec<Point> = (0..25 * 17).map(|k| bump(&centre(k))).collect();
    let found = register(&nominal, &bumped, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    assert!(found.quality.pv_mm > 6e-4 && found.cmm_from_model.angle_rad() < 1e-3, "{}", found.quality.pv_mm);

    let sphere = Sphere { radius_mm: 80.0 };
    let cap = |k: usize| {
        let [x, y] = [(k % 61) as f64 - 30.0, (k / 61) as f64 - 30.0];
        Point::new(x, y, sphere.height(x, y))
    };
    let nominal = Nominal::from_points((0..61 * 61).map(cap).collect(), PlaneProjection::Xy).unwrap();
    let form = FormError::new(7, 30.0, 0.0, 60.0, 60.0);
    let all = centres(&sphere, &form, [[-27.0, -27.0], [27.0, 27.0]], [21, 21]);
    let shifted: Vec<Point> = points(&all).iter().map(|p| p + Vector::new(5.0, -4.0, 9.0)).collect();
    let found = register(&nominal, &shifted, &RegistrationOptions::new(RADIUS_MM)).unwrap();
    let turned = found.cmm_from_model.angle_rad().to_degrees();
    assert!(turned < 8.0, "a sphere is turned by {turned} degrees");
}

#[test]
fn locked_pose_gives_deviations() {
    let nominal = free_form(205, 125);
    let truth = pose(&placement());
    let raised = truth * Pose { translation_mm: Vector::new(0.0, 0.0, 0.005), ..Pose::identity() };
    for counts in [[40, 20], [2, 1], [1, 1]] {
        let corners = if counts == [1, 1] { [[0.0, 0.0], [1.0, 1.0]] } else { [[-5.0, 0.0], [5.0, 1.0]] };
        let all = if counts == [40, 20] { WHOLE } else { corners };
        let centres: Vec<Point> = points(&placed(&placement(), &model_centres(all, counts.map(|n| n.max(2)), 0.0)))
            .into_iter()
            .take(counts[0] * counts[1])
            .collect();
        let options = RegistrationOptions {
            start: Start::Pose(raised),
            locked: [true; 6],
            ..RegistrationOptions::new(RADIUS_MM)
        };
        let found = register(&nominal, &centres, &options).unwrap();
        assert_eq!(pose_error_mm(&found.cmm_from_model, &raised), 0.0);
        let at_truth = RegistrationOptions { start: Start::Pose(truth), ..options };
        let from_truth = register(&nominal, &centres, &at_truth).unwrap();
        for (raised, truth) in found.deviations.iter().zip(&from_truth.deviations) {
            // By hand: raised by 5 um along z, the surface is nearer by that times the normal's z.
            let by_hand = truth.deviation_mm - 0.005 * truth.normal.z;
            assert!((raised.deviation_mm - by_hand).abs() < 1e-6, "{} {by_hand}", raised.deviation_mm);
        }
        assert_eq!(found.quality.covariance.amax(), 0.0);
    }
    let searched = RegistrationOptions { locked: [true; 6], ..RegistrationOptions::new(RADIUS_MM) };
    assert_eq!(register(&nominal, &cloud(WHOLE, [9, 5]), &searched).unwrap_err(), RegistrationError::Undetermined);
}

#[test]
fn trace_ends_with_reported_result() {
    let nominal = free_form(205, 125);
    let truth = pose(&placement());
    let clean = cloud(WHOLE, [40, 20]);
    let mut bad = clean.clone();
    // One touch gone wrong, and a chip that two touches agree on.
    for (k, height) in [(205, 0.4), (410, -0.1), (411, -0.1)] {
        bad[k] += truth.transform_direction(&Vector::z()) * height;
    }
    let held =
        RegistrationOptions { start: Start::Pose(truth), locked: [true; 6], ..RegistrationOptions::new(RADIUS_MM) };
    let at_truth = RegistrationOptions { start: Start::Pose(truth), ..RegistrationOptions::new(RADIUS_MM) };
    for (name, measured, options) in [
        ("searched", &clean, RegistrationOptions::new(RADIUS_MM)),
        ("begun at the truth", &clean, at_truth),
        ("with outliers", &bad, RegistrationOptions::new(RADIUS_MM)),
        ("held", &clean, held),
        (
            "robust",
            &bad,
            RegistrationOptions {
                loss: regrind_core::registration::Loss::Tukey,
                ..RegistrationOptions::new(RADIUS_MM)
            },
        ),
    ] {
        let found = register(&nominal, measured, &options).unwrap();
        let used = found.deviations.iter().filter(|d| d.status == PointStatus::Inlier);
        let (count, squares) = used.fold((0, 0.0), |(n, sum), d| (n + 1, sum + d.deviation_mm * d.deviation_mm));
        assert_eq!(found.quality.inliers, count, "{name}");
        let last = found.trace.last().expect(name);
        assert!(last.accepted && last.points == count, "{name}: {last:?}");
        assert!((last.objective_mm2 / squares - 1.0).abs() < 1e-6, "{name}: {last:?} {squares}");
        assert!((found.quality.objective_mm2 / squares - 1.0).abs() < 1e-6, "{name}");
    }
}

#[test]
fn no_verdict_when_points_contradict() {
    let nominal = free_form(205, 125);
    for (share, is_judged) in [(0.02, true), (0.3, false)] {
        let (mut rng, truth) = (StdRng::seed_from_u64(9), pose(&placement()));
        let mut measured = cloud(WHOLE, [60, 30]);
        for p in &mut measured {
            if rng.random::<f64>() < share {
                *p += truth.transform_direction(&Vector::z()) * (0.02 + 0.03 * rng.random::<f64>());
            }
        }
        let found = register(&nominal, &measured, &RegistrationOptions::new(RADIUS_MM)).unwrap();
        let reason = found.unjudgeable_reason();
        assert_eq!(reason.is_none(), is_judged, "{share}: {reason:?}");
        assert_eq!(has_warning(&found, "contradict their neighbours"), !is_judged);
    }
}

#[test]
fn accuracy_of_121_scattered_points() {
    let (mut rng, shape) = (StdRng::seed_from_u64(4), FreeForm::default());
    let points: Vec<Point> = (0..121)
        .map(|k| {
            let [x, y] = [(k % 11) as f64, (k / 11) as f64].map(|c| 4.0 * c - 20.0 + 1.6 * (rng.random::<f64>() - 0.5));
            Point::new(x, y, shape.height(x, y))
        })
        .collect();
    let told = estimate_accuracy(NominalPoints::Points { points: &points, projection: PlaneProjection::Auto }).unwrap();
    assert!(told.curved.inside.rms_mm > 0.0 && told.curved.inside.rms_mm.is_finite());
}
