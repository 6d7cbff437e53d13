//! Pose and map against least squares with the exact (Newton) foot on the exact surface.

use crate::common::{RADIUS_MM, centres, free_form, placed, points, pose, pose_error_mm};
use nalgebra::{Matrix6, Vector6};
use rand::RngExt;
use regrind_core::geometry::{Point, Pose, Vector};
use regrind_core::registration::{PointStatus, RegistrationOptions, Start, register};
use regrind_core::surface::{Nominal, PlaneProjection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise};
use regrind_sim::shape::{FreeForm, Shape};
use regrind_sim::{Rng, Vec3};

/// Moves one point in fifty by 0.05 mm to 5 mm in a random direction. Returns the indices of the moved points, in
/// ascending order.
fn add_outliers(rng: &mut Rng, points: &mut [Vec3]) -> Vec<usize> {
    let mut moved = Vec::new();
    for (index, point) in points.iter_mut().enumerate() {
        if rng.random::<f64>() < 0.02 {
            let mut direction = [[0.0; 3]];
            add_noise(rng, &mut direction, 1.0);
            let length = direction[0].iter().map(|c| c * c).sum::<f64>().sqrt();
            let by = rng.random_range(0.05..5.0);
            (0..3).for_each(|k| point[k] += by * direction[0][k] / length);
            moved.push(index);
        }
    }
    moved
}

/// Signed distance from the exact nominal surface and the unit normal at the foot, by Newton's method on (x, y).
fn exact_distance(shape: &dyn Shape, p: &Point) -> (f64, Vector) {
    let (mut x, mut y) = (p.x, p.y);
    let mut best = (0.0, Vector::z());
    for _ in 0..40 {
        let [a, b] = shape.gradient(x, y);
        let (tx, ty) = (Vector::new(1.0, 0.0, a), Vector::new(0.0, 1.0, b));
        let d = p.coords - Vector::from(shape.point(x, y));
        let h = 1e-5;
        let bend = |dx: f64, dy: f64| {
            let (f, g) = (shape.gradient(x + dx, y + dy), shape.gradient(x - dx, y - dy));
            [(f[0] - g[0]) / (2.0 * h), (f[1] - g[1]) / (2.0 * h)]
        };
        let ([zxx, zxy], [_, zyy]) = (bend(h, 0.0), bend(0.0, h));
        let (gx, gy) = (d.dot(&tx), d.dot(&ty));
        let (hxx, hxy, hyy) = (tx.dot(&tx) - d.z * zxx, tx.dot(&ty) - d.z * zxy, ty.dot(&ty) - d.z * zyy);
        let det = hxx * hyy - hxy * hxy;
        let (dx, dy) = ((hyy * gx - hxy * gy) / det, (hxx * gy - hxy * gx) / det);
        x += dx;
        y += dy;
        let n = Vector::from(shape.normal(x, y));
        best = ((p.coords - Vector::from(shape.point(x, y))).dot(&n), n);
        if dx.hypot(dy) < 1e-13 {
            break;
        }
    }
    best
}

/// Gauss-Newton on the exact distances from a pose near the answer; `keep` says which points count.
fn exact_least_squares(shape: &dyn Shape, measured: &[Point], keep: &[bool], start: Pose) -> (Pose, Vec<f64>) {
    let mut pose = start;
    let mut distances = Vec::new();
    for _ in 0..12 {
        let (mut gram, mut right) = (Matrix6::zeros(), Vector6::zeros());
        distances.clear();
        let inverse = pose.inverse();
        for (p, keep) in measured.iter().zip(keep) {
            let q = inverse.transform_point(p);
            let (d, n) = exact_distance(shape, &q);
            let d = d - RADIUS_MM;
            distances.push(d);
            if *keep {
                let arm = q.coords.cross(&n);
                let row = Vector6::new(n.x, n.y, n.z, arm.x, arm.y, arm.z);
                gram += row * row.transpose();
                right += row * d;
            }
        }
        let m = gram.cholesky().unwrap().solve(&right);
        pose = pose * Pose::exp(&m);
        if m.norm() < 1e-13 {
            break;
        }
    }
    (pose, distances)
}

/// Translation at the middle of the part in micrometres and rotation in microradians between two poses.
fn difference(a: &Pose, b: &Pose) -> (f64, f64) {
    let between = (a.inverse() * *b).log();
    (1e3 * between.fixed_rows::<3>(0).norm(), 1e6 * between.fixed_rows::<3>(3).norm())
}

fn rms_nm(a: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = a.fold((0.0, 0), |(s, n), d| (s + d * d, n + 1));
    1e6 * (sum / n as f64).sqrt()
}

const FULL: [[f64; 2]; 2] = [[-50.9, -30.9], [50.9, 30.9]];

fn realistic() -> (Placement, FormError, Vec<Point>) {
    let form = FormError::new(11, 30.0, 6.657e-3, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
    let placement = Placement::new([20.0, 10.0, 20.0], [20.0, 10.0, 20.0]);
    let measured = points(&placed(&placement, &centres(&FreeForm::default(), &form, FULL, [151, 95])));
    (placement, form, measured)
}

#[test]
fn register_matches_exact_least_squares() {
    let shape = FreeForm::default();
    let (placement, _, measured) = realistic();
    let keep = vec![true; measured.len()];
    let (exact, distances) = exact_least_squares(&shape, &measured, &keep, pose(&placement));
    let grid = points(&shape.grid(FreeForm::WIDTH_MM, FreeForm::DEPTH_MM, 901, 501));
    let shuffled: Vec<Point> = (0..grid.len()).map(|i| grid[(i * 196_613 + 7) % grid.len()]).collect();
    let triangles: Vec<[u32; 3]> = (0..500u32)
        .flat_map(|j| (0..900u32).map(move |i| j * 901 + i))
        .flat_map(|n| [[n, n + 1, n + 902], [n, n + 902, n + 901]])
        .collect();
    let scattered: Vec<Point> = (0..451_401)
        .map(|k| {
            let (u, v) = ((k as f64 + 0.5) / 451_401.0, (k as f64 * 0.618_033_988_749_894_9).fract());
            Point::from(shape.point(102.0 * (u - 0.5), 62.0 * (v - 0.5)))
        })
        .collect();
    let kinds = [
        ("grid", Nominal::from_points(grid.clone(), PlaneProjection::Auto)),
        ("shuffled", Nominal::from_points(shuffled.clone(), PlaneProjection::Auto)),
        ("triangulated", Nominal::from_triangulated_points(shuffled, PlaneProjection::Auto)),
        ("scattered", Nominal::from_points(scattered, PlaneProjection::Auto)),
        ("mesh", Nominal::from_mesh(grid, triangles)),
    ];
    for (name, nominal) in kinds {
        let found = register(&nominal.unwrap(), &measured, &RegistrationOptions::new(RADIUS_MM)).unwrap();
        let (um, urad) = difference(&found.cmm_from_model, &exact);
        let map = rms_nm(found.deviations.iter().zip(&distances).map(|(f, d)| f.deviation_mm - d));
        println!("{name}: {um:.5} um {urad:.5} urad {map:.5} nm used {}", found.quality.inliers);
        assert!(um < 1e-3 && urad < 0.01, "{name}: {um} um, {urad} urad");
        assert!(map < 0.05, "{name}: map off by {map} nm rms");
        assert_eq!(found.quality.inliers, measured.len(), "{name}");
    }
}

#[test]
fn register_with_noise_and_gross_outliers() {
    let shape = FreeForm::default();
    let nominal = free_form(451, 251);
    let (placement, form, _) = realistic();
    let mut clean = centres(&shape, &form, FULL, [121, 75]);
    clean.retain(|c| !(c[0] > 25.0 && c[1] > 10.0));
    for seed in 0..5 {
        let mut rng = regrind_sim::rng(seed);
        let mut measured = placed(&placement, &clean);
        add_noise(&mut rng, &mut measured, 3e-4);
        let gross = add_outliers(&mut rng, &mut measured);
        let measured = points(&measured);
        let mut keep = vec![true; measured.len()];
        for &k in &gross {
            keep[k] = false;
        }
        // Exact robust least squares: a gross outlier that slid along the surface may stay, as it would for anybody.
        let (first, distances) = exact_least_squares(&shape, &measured, &keep, pose(&placement));
        let mut sizes: Vec<f64> = distances.iter().map(|d| d.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        let limit = 6.0 * 1.4826 * sizes[sizes.len() / 2];
        let fits: Vec<bool> = distances.iter().map(|d| d.abs() <= limit).collect();
        let (exact, distances) = exact_least_squares(&shape, &measured, &fits, first);
        // An outlier is gross if it is far from the surface, not if it slid along it.
        let far: Vec<usize> = gross.iter().copied().filter(|&k| distances[k].abs() > 0.02).collect();
        let found = register(&nominal, &measured, &RegistrationOptions::new(RADIUS_MM)).unwrap();
        // Two of them side by side may pass for form, but no pose is fitted to either.
        let dropped = |k: usize| found.deviations[k].status != PointStatus::Inlier || !found.deviations[k].in_fit;
        assert!(far.iter().all(|&k| dropped(k)), "seed {seed}: an outlier was kept");
        let good_dropped = (0..measured.len()).filter(|&k| keep[k] && dropped(k)).count();
        assert!(good_dropped * 100 <= measured.len(), "seed {seed}: {good_dropped} good points dropped");
        let (um, urad) = difference(&found.cmm_from_model, &exact);
        let map =
            rms_nm((0..measured.len()).filter(|&k| keep[k]).map(|k| found.deviations[k].deviation_mm - distances[k]));
        println!(
            "seed {seed}: {um:.4} um {urad:.4} urad, map {map:.3} nm, {} far of {}, {good_dropped} good dropped",
            far.len(),
            gross.len()
        );
        assert!(um < 0.02 && urad < 0.2, "seed {seed}: {um} um, {urad} urad");
        assert!(map < 5.0, "seed {seed}: {map} nm");
        assert!(pose_error_mm(&found.cmm_from_model, &exact) < 1e-4, "seed {seed}");
    }
}

/// Over many draws of the noise the covariance that is stated is the scatter that is seen.
#[test]
fn pose_covariance_matches_observed() {
    let nominal = free_form(451, 251);
    let placement = Placement::new([3.0, -2.0, 1.0], [2.0, 1.0, -3.0]);
    let truth = pose(&placement);
    for (name, corners) in [("whole", FULL), ("narrow strip", [[-50.0, -4.0], [50.0, 4.0]])] {
        let clean = placed(&placement, &centres(&FreeForm::default(), &FormError::none(), corners, [60, 20]));
        let (mut observed, mut stated) = (Matrix6::zeros(), Matrix6::zeros());
        const DRAWS: u64 = 300;
        for seed in 0..DRAWS {
            let mut measured = clean.clone();
            add_noise(&mut regrind_sim::rng(seed), &mut measured, 3e-4);
            let mut options = RegistrationOptions::new(RADIUS_MM);
            options.start = regrind_core::registration::Start::Pose(truth);
            let found = register(&nominal, &points(&measured), &options).unwrap();
            let error = (truth.inverse() * found.cmm_from_model).log();
            observed += error * error.transpose() / DRAWS as f64;
            stated += found.quality.covariance / DRAWS as f64;
        }
        for k in 0..6 {
            let ratio = (observed[(k, k)] / stated[(k, k)]).sqrt();
            assert!((ratio - 1.0).abs() < 0.15, "{name}, axis {k}: observed {ratio:.3} times what is stated");
        }
        // The weakest direction of all, wherever it points.
        let weakest = stated.symmetric_eigen();
        let v = weakest.eigenvectors.column(weakest.eigenvalues.imax()).into_owned();
        let ratio = ((v.transpose() * observed * v)[0] / (v.transpose() * stated * v)[0]).sqrt();
        assert!((ratio - 1.0).abs() < 0.15, "{name}, weakest direction: {ratio:.3}");
    }
}

#[test]
fn register_starts_far_with_few_points() {
    let placement = Placement::new([20.0, 10.0, 20.0], [20.0, 20.0, 10.0]);
    let shape = FreeForm::default();
    let form = FormError::with_rms(&mut regrind_sim::rng(5), 30.0, 1e-3);
    for (columns, rows) in [(226, 126), (75, 40)] {
        let cloud =
            points(&placed(&placement, &centres(&shape, &form, [[-49.0, -29.0], [49.0, 29.0]], [columns, rows])));
        let found = register(
            &free_form(409, 249),
            &cloud,
            &RegistrationOptions { start: Start::Pose(Pose::identity()), ..RegistrationOptions::new(RADIUS_MM) },
        );
        let found = found.unwrap();
        assert!(pose_error_mm(&found.cmm_from_model, &pose(&placement)) < 0.02);
        let whole = found.trace.iter().filter(|turn| 2 * turn.points > cloud.len()).count();
        assert!(whole <= 3, "{} points: {whole} of {} turns are of all of them", cloud.len(), found.trace.len());
    }
}
