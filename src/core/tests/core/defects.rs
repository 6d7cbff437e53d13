//! Tests of defects. The figures include a defect of the part, whatever its height.
//! A single faulty point is rejected as an outlier and reported.

use std::f64::consts::TAU;
use std::sync::OnceLock;

use nalgebra::{DMatrix, DVector};

use crate::common::{RADIUS_MM, centres, placed, points};
use regrind_core::geometry::Point;
use regrind_core::model::{Form, ModelInputs};
use regrind_core::registration::{PointStatus, Registration, RegistrationOptions, register};
use regrind_core::surface::{Nominal, PlaneProjection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise};
use regrind_sim::shape::{FreeForm, Shape};

const NOISE_MM: f64 = 2e-4;
const HALF_MM: [f64; 2] = [50.0, 30.0];
const COUNTS: [usize; 2] = [60, 30];

fn nominal() -> &'static Nominal {
    static NOMINAL: OnceLock<Nominal> = OnceLock::new();
    NOMINAL.get_or_init(|| {
        let grid = FreeForm::default().grid(102.0, 62.0, 205, 125);
        Nominal::from_points(points(&grid), PlaneProjection::Auto).unwrap()
    })
}

/// Returns the measured points of a part with planted heights above the surface, given by place.
/// Without the planted heights, the form error of the part is a tenth of a micrometre.
fn touched([columns, rows]: [usize; 2], noise_mm: f64, planted_mm: impl Fn(f64, f64) -> f64) -> Vec<Point> {
    let shape = FreeForm::default();
    let form = FormError::new(7, 30.0, 1e-4, 102.0, 62.0);
    let mut all = centres(&shape, &form, [[-HALF_MM[0], -HALF_MM[1]], HALF_MM], [columns, rows]);
    for (k, centre) in all.iter_mut().enumerate() {
        let at = |k: usize, n: usize, half: f64| half * (2.0 * k as f64 / (n - 1) as f64 - 1.0);
        let (x, y) = (at(k % columns, columns, HALF_MM[0]), at(k / columns, rows, HALF_MM[1]));
        let (normal, height) = (shape.normal(x, y), planted_mm(x, y));
        (0..3).for_each(|c| centre[c] += height * normal[c]);
    }
    let mut all = placed(&Placement::new([12.0, -8.0, 5.0], [4.0, -3.0, 20.0]), &all);
    add_noise(&mut regrind_sim::rng(7), &mut all, noise_mm);
    points(&all)
}

fn registered(measured: &[Point]) -> Registration {
    register(nominal(), measured, &RegistrationOptions::new(RADIUS_MM)).unwrap()
}

fn left_out(found: &Registration) -> Vec<usize> {
    (0..found.deviations.len()).filter(|&k| found.deviations[k].status == PointStatus::Outlier).collect()
}

/// Returns a function of the place: a constant height inside a rectangle, and zero outside.
fn within(middle: [f64; 2], size: [f64; 2], height_mm: f64) -> impl Fn(f64, f64) -> f64 {
    move |x, y| {
        let inside = (x - middle[0]).abs() <= 0.5 * size[0] && (y - middle[1]).abs() <= 0.5 * size[1];
        if inside { height_mm } else { 0.0 }
    }
}

fn bump(middle: [f64; 2], width_mm: f64, height_mm: f64) -> impl Fn(f64, f64) -> f64 {
    move |x, y| {
        let r2 = ((x - middle[0]).powi(2) + (y - middle[1]).powi(2)) / (0.5 * width_mm).powi(2);
        if r2 < 1.0 { height_mm * (0.5 * std::f64::consts::PI * r2.sqrt()).cos().powi(2) } else { 0.0 }
    }
}

/// Asserts that every point of a defect is an inlier, and that PV is the height of the defect.
fn counts_whole(name: &str, height_mm: f64, planted: &dyn Fn(f64, f64) -> f64) {
    let found = registered(&touched(COUNTS, NOISE_MM, planted));
    let pv_mm = found.quality.pv_mm;
    println!("{name}, {} um: PV {:.2} um, left out {:?}", 1e3 * height_mm, 1e3 * pv_mm, left_out(&found));
    assert!(left_out(&found).is_empty(), "{name}, {height_mm} mm: left out {:?}", left_out(&found));
    assert!(pv_mm > 0.8 * height_mm.abs(), "{name}, {height_mm} mm: PV {pv_mm}");
    assert!(pv_mm < height_mm.abs() + 10.0 * NOISE_MM, "{name}, {height_mm} mm: PV {pv_mm}");
}

#[test]
fn figures_include_two_point_defects() {
    for height_mm in [-0.003, -0.01, -0.05, -0.5, 0.003, 0.01, 0.05, 0.5] {
        // Neighbours are 1.7 mm apart along x and 2.1 mm along y.
        counts_whole("chip", height_mm, &within([49.0, 3.0], [3.0, 2.1], height_mm));
        counts_whole("corner", height_mm, &within([50.0, 30.0], [7.0, 5.0], height_mm));
        counts_whole("pit", height_mm, &within([-20.3, 5.2], [5.0, 4.2], height_mm));
        counts_whole("scratch along x", height_mm, &within([0.0, 1.0], [60.0, 1.0], height_mm));
        counts_whole("scratch along y", height_mm, &within([0.8, 0.0], [1.0, 40.0], height_mm));
        counts_whole("bump", height_mm, &bump([11.0, -6.2], 8.0, height_mm));
    }
}

/// Checks a bump in a measurement without noise. The outlier limit of six noise sigmas is then almost zero.
/// The flanks of the bump exceed this limit too.
#[test]
fn bump_on_clean_map_is_inlier() {
    let found = registered(&touched([80, 45], 1e-6, bump([11.0, -6.2], 12.0, 1e-3)));
    assert!(left_out(&found).is_empty(), "{:?}", left_out(&found));
    assert!(found.quality.pv_mm > 0.9e-3, "{}", found.quality.pv_mm);
}

#[test]
fn lone_deviation_is_outlier() {
    for height_mm in [-0.5, -0.01, 0.003, 0.01, 0.05, 5.0] {
        for at in [[0, 0], [30, 0], [59, 29], [17, 11]] {
            let k = at[1] * COUNTS[0] + at[0];
            let place = [0, 1].map(|c| HALF_MM[c] * (2.0 * at[c] as f64 / (COUNTS[c] - 1) as f64 - 1.0));
            let found = registered(&touched(COUNTS, NOISE_MM, within(place, [0.1, 0.1], height_mm)));
            assert_eq!(left_out(&found), [k], "{height_mm} mm at {at:?}");
        }
    }
}

/// Checks a faulty point that was measured twice at one place.
/// The second point repeats the fault and confirms nothing.
#[test]
fn repeated_point_is_no_neighbour() {
    let mut measured = touched(COUNTS, NOISE_MM, within([0.847, 1.034], [0.5, 0.5], 0.05));
    let twice = registered(&measured);
    let [k] = left_out(&twice)[..] else { panic!("{:?}", left_out(&twice)) };
    measured.push(measured[k]);
    assert_eq!(left_out(&registered(&measured)), [k, COUNTS[0] * COUNTS[1]]);
}

#[test]
fn opposite_neighbours_are_outliers() {
    let (a, b) = (within([-0.847, 1.034], [0.5, 0.5], 0.05), within([0.847, 1.034], [0.5, 0.5], -0.05));
    let found = registered(&touched(COUNTS, NOISE_MM, move |x, y| a(x, y) + b(x, y)));
    assert_eq!(left_out(&found).len(), 2);
}

/// Checks that the form includes every defect that the deviations show.
/// The model must not smooth a defect away as noise.
#[test]
fn form_height_matches_deviations() {
    // Neighbours are 2.9 mm apart along x and 3.5 mm along y: two touches, six, and a dozen.
    for (name, planted) in [
        ("chip", Box::new(within([48.6, 1.8], [3.2, 1.0], -0.02)) as Box<dyn Fn(f64, f64) -> f64>),
        ("corner", Box::new(within([50.0, 30.0], [12.0, 8.0], -0.05))),
        ("bump", Box::new(bump([10.0, -5.3], 12.0, 0.02))),
    ] {
        let found = registered(&touched([36, 18], NOISE_MM, planted));
        let form = Form::estimate(&found, &ModelInputs::default()).unwrap();
        let (pv, rms) = (form.figures.pv, form.figures.rms);
        println!("{name}: PV {pv:.4?} of {:.4}, rms {rms:.4?} of {:.4}", found.quality.pv_mm, found.quality.rms_mm);
        assert_eq!(form.points.len(), found.quality.inliers, "{name}");
        // Two touches of a peak have the scatter of both in their distance.
        let of_two_mm = 3.0 * NOISE_MM * 2f64.sqrt();
        assert!((pv.median_mm - found.quality.pv_mm).abs() < of_two_mm.max(0.03 * pv.median_mm), "{name}: {pv:?}");
        assert!(pv.low_mm <= found.quality.pv_mm && pv.high_mm >= 0.97 * found.quality.pv_mm, "{name}: {pv:?}");
        assert!((rms.median_mm / found.quality.rms_mm - 1.0).abs() < 0.15, "{name}: {rms:?}");
        // Each point has its own place and height.
        let used = found.deviations.iter().filter(|d| d.status == PointStatus::Inlier);
        for (of, d) in form.points.iter().zip(used) {
            assert!((of.place_mm[0] - d.point.x).abs() < 1e-12 && (of.place_mm[1] - d.point.y).abs() < 1e-12, "{name}");
            // The form is after its own best fit, which the defect tilts, and the deviations are after one that it does
            // not.
            let off_mm = (of.form.mean_mm - d.deviation_mm).abs();
            assert!(off_mm < 6.0 * NOISE_MM + 0.1 * found.quality.pv_mm, "{name}: {of:?} of {d:?}");
        }
    }
}

/// Returns RMS and PV of the planted heights after their own best fit, from the same points without noise.
fn true_figures_mm(counts: [usize; 2], planted_mm: impl Fn(f64, f64) -> f64) -> [f64; 2] {
    let exact = registered(&touched(counts, 0.0, planted_mm)).deviations;
    let heights = DVector::from_iterator(exact.len(), exact.iter().map(|d| d.deviation_mm));
    let motions = DMatrix::from_fn(exact.len(), 6, |r, c| {
        let (normal, arm) = (exact[r].normal, exact[r].point.coords.cross(&exact[r].normal) / HALF_MM[0]);
        [normal.x, normal.y, normal.z, arm.x, arm.y, arm.z][c]
    });
    let base = motions.qr().q();
    let left = &heights - &base * base.tr_mul(&heights);
    [(left.norm_squared() / left.len() as f64).sqrt(), left.max() - left.min()]
}

#[test]
fn figures_of_strong_corner_form() {
    const FEW: [usize; 2] = [25, 16];
    // High at the corners alone, by the fourth power of the distance from the middle.
    let planted = |x: f64, y: f64| 0.03 * ((x.powi(4) + y.powi(4) - 6.0 * x * x * y * y) / 3400f64.powi(2));
    let found = registered(&touched(FEW, NOISE_MM, planted));
    let beside = found.deviations.iter().filter(|d| d.status == PointStatus::Inlier && !d.in_fit).count();
    let told = Form::estimate(&found, &ModelInputs::default()).unwrap().figures;
    let [rms_mm, pv_mm] = true_figures_mm(FEW, planted);
    println!(
        "{beside} beside the fit; true RMS {rms_mm:.5} PV {pv_mm:.5}, told {:?}",
        [told.rms, told.pv].map(|of| [of.low_mm, of.high_mm])
    );
    assert!(beside > 0);
    assert!((told.rms.low_mm..told.rms.high_mm).contains(&rms_mm), "{rms_mm} {:?}", told.rms);
    assert!((told.pv.low_mm..told.pv.high_mm).contains(&pv_mm), "{pv_mm} {:?}", told.pv);
    assert!(told.rms.high_mm - told.rms.low_mm < 0.1 * rms_mm, "{:?}", told.rms);
}

#[test]
fn waves_across_path_are_form() {
    const FEW: [usize; 2] = [25, 16];
    for degrees in [60.0f64, 80.0, 90.0, 100.0] {
        // Five touches a wave, and so nearly the same height from one touch of a row to the next.
        let (c, s) = (degrees.to_radians().cos() * TAU / 20.0, degrees.to_radians().sin() * TAU / 20.0);
        let planted = move |x: f64, y: f64| 6e-4 * (c * x + s * y + 0.4).cos();
        let told = Form::estimate(&registered(&touched(FEW, NOISE_MM, planted)), &ModelInputs::default()).unwrap();
        let [rms_mm, _] = true_figures_mm(FEW, planted);
        println!(
            "{degrees}: true RMS {rms_mm:.6}, told {:.6} to {:.6}, {:?}",
            told.figures.rms.low_mm, told.figures.rms.high_mm, told.hyperparameters
        );
        assert_eq!(told.hyperparameters.noise_autocorrelation, 0.0, "{degrees}");
        assert!(told.figures.rms.high_mm > rms_mm, "{degrees}: {rms_mm} {:?}", told.figures.rms);
    }
}
