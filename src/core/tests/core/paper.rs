//! The main numbers of sections 3.2 and 4 of the paper, on the simulated free form; `examples/paper.rs` shows them all.

use regrind_core::geometry::{Point, Pose};
use regrind_core::registration::{Method, Options, ProbeSide, Registration, Start, register};
use regrind_core::surface::{Distance, Nominal, Projection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, centre};
use regrind_sim::shape::{FreeForm, Shape};

const PROBE_RADIUS_MM: f64 = 1.5;

fn nominal() -> Nominal {
    let (columns, rows) = FreeForm::PAPER_GRID;
    let points = FreeForm::default().grid(FreeForm::WIDTH_MM, FreeForm::DEPTH_MM, columns, rows);
    Nominal::from_points(points.into_iter().map(Point::from).collect(), Projection::Auto).unwrap()
}

/// Probe centres over 226 x 126 nodes of a rectangle, moved to the machine.
fn centres(form: &FormError, [width, depth]: [f64; 2], placement: &Placement) -> Vec<Point> {
    let at = |i: i32, last: i32, size: f64| size * (f64::from(i) / f64::from(last) - 0.5);
    let probe = |x, y| Point::from(placement.apply(centre(&FreeForm::default(), form, PROBE_RADIUS_MM, x, y)));
    (0..126)
        .flat_map(|j| (0..226).map(move |i| (i, j)))
        .map(|(i, j)| probe(at(i, 225, width), at(j, 125, depth)))
        .collect()
}

/// The method as it stands in the paper: from the identity, on a known side, every point counted.
fn as_in_the_paper() -> Options {
    Options {
        start: Start::Pose(Pose::identity()),
        side: ProbeSide::Above,
        outlier_sigmas: f64::INFINITY,
        ..Options::new(PROBE_RADIUS_MM)
    }
}

fn taken(found: &Registration) -> Vec<f64> {
    found.trace.iter().filter(|i| i.taken).map(|i| i.objective_mm2).collect()
}

#[test]
fn tens_of_millimetres_and_degrees_are_undone_to_rounding() {
    let nominal = nominal();
    let exact = centres(&FormError::none(), [FreeForm::WIDTH_MM, FreeForm::DEPTH_MM], &Placement::IDENTITY);
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
        let measured: Vec<Point> = exact.iter().map(|p| Point::from(placement.apply((*p).into()))).collect();
        for distance in [Distance::Curved, Distance::Triangle] {
            let case = format!("{shift_mm:?} mm, {degrees:?} degrees, {distance:?}");
            let found = register(&nominal, &measured, &Options { distance, ..as_in_the_paper() }).expect(&case);
            let pv_nm = 1e6 * found.verdict.pv_mm;
            assert!(pv_nm <= 1e-6, "{case}: {pv_nm:e} nm");
            assert_eq!(found.verdict.used, measured.len(), "{case}");
            assert!(found.verdict.iterations <= 10, "{case}: {} iterations", found.verdict.iterations);
            let objectives = taken(&found);
            assert!(objectives.windows(2).all(|w| w[1] <= w[0]), "{case}: {objectives:?}"); // eq. (14)
        }
    }
}

#[test]
fn centres_on_the_offset_are_contacts_on_the_nominal() {
    let nominal = nominal();
    let form = FormError::new(12, 12.0, 6.9e-3, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
    let placement = Placement::new([-0.068_855, 0.065_762, 0.195_464], [-0.4587, 0.0646, -0.0095]); // eq. (17)
    let measured = centres(&form, [101.9, 61.9], &placement);
    let found = register(&nominal, &measured, &as_in_the_paper()).unwrap();

    let contacts: Vec<Point> = found.deviations.iter().map(|d| d.point).collect();
    let again = register(&nominal, &contacts, &Options { method: Method::Contact, ..as_in_the_paper() }).unwrap();
    let pose = again.cmm_from_model;
    // The largest entries of eq. (18).
    assert!(pose.translation_mm.amax() <= 3.69e-5, "{}", pose.translation_mm);
    assert!(pose.angle_rad() <= 2.34e-6, "{}", pose.angle_rad());
    for (a, b) in found.deviations.iter().zip(&again.deviations) {
        assert!((a.deviation_mm - b.deviation_mm).abs() < 1e-7, "{} against {}", a.deviation_mm, b.deviation_mm);
    }
}
