//! The main numbers of sections 3.2 and 4 of the paper, on the simulated free form; `examples/paper.rs` shows them all.

use crate::common::{RADIUS_MM, free_form, placed, points};
use regrind_core::geometry::{Point, Pose};
use regrind_core::registration::{Method, ProbeSide, RegistrationOptions, Start, register};
use regrind_core::surface::{DistanceModel, Nominal};
use regrind_sim::Vec3;
use regrind_sim::form::FormError;
use regrind_sim::probe::Placement;
use regrind_sim::shape::FreeForm;

fn nominal() -> Nominal {
    let (columns, rows) = FreeForm::PAPER_GRID;
    free_form(columns, rows)
}

/// Probe centres over 226 x 126 nodes of a rectangle, in the model frame.
fn centres(form: &FormError, [width, depth]: [f64; 2]) -> Vec<Vec3> {
    let corner = [0.5 * width, 0.5 * depth];
    crate::common::centres(&FreeForm::default(), form, [corner.map(|c| -c), corner], [226, 126])
}

/// The method as it stands in the paper: from the identity, on a known side, every point counted.
fn as_in_the_paper() -> RegistrationOptions {
    RegistrationOptions {
        start: Start::Pose(Pose::identity()),
        side: ProbeSide::Above,
        outlier_sigmas: f64::INFINITY,
        ..RegistrationOptions::new(RADIUS_MM)
    }
}

#[test]
fn register_undoes_large_displacement() {
    let nominal = nominal();
    let exact = centres(&FormError::none(), [FreeForm::WIDTH_MM, FreeForm::DEPTH_MM]);
    let cases = [
        ([20.0, 0.0, 0.0], [0.0; 3]),
        ([0.0, 10.0, 0.0], [0.0; 3]),
        ([0.0, 0.0, 20.0], [0.0; 3]),
        ([0.0; 3], [20.0, 0.0, 0.0]),
        ([0.0; 3], [0.0, 20.0, 0.0]),
        ([0.0; 3], [0.0, 0.0, 10.0]),
        ([20.0, 10.0, 20.0], [20.0, 20.0, 10.0]),
        ([-20.0, -10.0, -20.0], [-20.0, -20.0, -10.0]),
    ];
    for (shift_mm, degrees) in cases {
        let placement = Placement::new(shift_mm, degrees);
        let measured = points(&placed(&placement, &exact));
        for distance in [DistanceModel::Curved, DistanceModel::Triangle] {
            let case = format!("{shift_mm:?} mm, {degrees:?} degrees, {distance:?}");
            let found =
                register(&nominal, &measured, &RegistrationOptions { distance_model: distance, ..as_in_the_paper() })
                    .expect(&case);
            let pv_nm = 1e6 * found.quality.pv_mm;
            assert!(pv_nm <= 1e-6, "{case}: {pv_nm:e} nm");
            assert_eq!(found.quality.inliers, measured.len(), "{case}");
            assert!(found.quality.iterations <= 10, "{case}: {} iterations", found.quality.iterations);
            // Eq. (14), as long as the points are the same: those on the very edge come in when the pose is found.
            let taken: Vec<_> = found.trace.iter().filter(|turn| turn.accepted).collect();
            let falls = |w: &[&regrind_core::registration::Iteration]| {
                w[1].objective_mm2 <= w[0].objective_mm2 || w[1].points != w[0].points
            };
            assert!(taken.windows(2).all(falls), "{case}: {taken:?}");
        }
    }
}

#[test]
fn offset_centres_match_contacts() {
    let nominal = nominal();
    let form = FormError::new(12, 12.0, 6.9e-3, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
    let placement = Placement::new([-0.068_855, 0.065_762, 0.195_464], [-0.4587, 0.0646, -0.0095]); // eq. (17)
    let measured = points(&placed(&placement, &centres(&form, [101.9, 61.9])));
    let found = register(&nominal, &measured, &as_in_the_paper()).unwrap();

    let contacts: Vec<Point> = found.deviations.iter().map(|d| d.point).collect();
    let again =
        register(&nominal, &contacts, &RegistrationOptions { method: Method::Contact, ..as_in_the_paper() }).unwrap();
    let pose = again.cmm_from_model;
    // The largest entries of eq. (18).
    assert!(pose.translation_mm.amax() <= 3.69e-5, "{}", pose.translation_mm);
    assert!(pose.angle_rad() <= 2.34e-6, "{}", pose.angle_rad());
    for (a, b) in found.deviations.iter().zip(&again.deviations) {
        assert!((a.deviation_mm - b.deviation_mm).abs() < 1e-7, "{} against {}", a.deviation_mm, b.deviation_mm);
    }
}
