//! Plausibility messages of registrations and of failed registrations.
//! Each implausible point cloud has a message with its cause. A good point cloud has no message.

use std::sync::OnceLock;

use crate::common::{RADIUS_MM, centres, placed, points};
use regrind_core::geometry::{Point, Pose};
use regrind_core::registration::{
    Method, ProbeSide, Registration, RegistrationError, RegistrationOptions, Start, register,
};
use regrind_core::surface::{Nominal, PlaneProjection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise};
use regrind_sim::shape::{Shape, XyPolynomial};

/// Returns the free-form mirror that is supplied as a recipe.
fn mirror() -> XyPolynomial {
    #[rustfmt::skip]
    let terms = vec![
        (1, 0, 2.1), (0, 1, -1.4), (2, 0, 10.5), (1, 1, 2.4), (0, 2, -13.3), (3, 0, 2.6), (2, 1, -3.5), (1, 2, 3.0), (0, 3, 1.6),
        (4, 0, -1.7), (3, 1, 1.2), (2, 2, 1.6), (1, 3, -1.4), (0, 4, 1.2),
    ];
    XyPolynomial { normalisation_radius_mm: 50.0, terms }
}

fn nominal() -> &'static Nominal {
    static NOMINAL: OnceLock<Nominal> = OnceLock::new();
    NOMINAL.get_or_init(|| {
        Nominal::from_points(points(&mirror().grid(102.0, 62.0, 205, 125)), PlaneProjection::Auto).unwrap()
    })
}

/// Returns 1,800 probe centres of a part with a form error of 20 micrometres, within a rectangle.
fn measured(seed: u64, half: [f64; 2]) -> Vec<Point> {
    let form = FormError::new(seed, 30.0, 0.02, 102.0, 62.0);
    let placement = Placement::new([12.0, -8.0, 5.0], [4.0, -3.0, 20.0]);
    let mut all = placed(&placement, &centres(&mirror(), &form, [[-half[0], -half[1]], half], [60, 30]));
    add_noise(&mut regrind_sim::rng(seed), &mut all, 2e-4);
    points(&all)
}

fn whole(seed: u64) -> Vec<Point> {
    measured(seed, [50.0, 30.0])
}

fn with_radius(radius_mm: f64, measured: &[Point]) -> Registration {
    register(nominal(), measured, &RegistrationOptions::new(radius_mm)).unwrap()
}

fn warnings(found: &Registration) -> String {
    found.quality.warnings.join("; ")
}

/// Returns the probe radius in mm that a message proposes; `None` if it proposes none.
fn proposed_radius(words: &str) -> Option<f64> {
    words.split_once("probe radius")?.1.split(' ').find_map(|word| word.parse().ok())
}

#[test]
fn plausibility_silent_on_ground_part() {
    for seed in 1..=4 {
        let found = with_radius(RADIUS_MM, &whole(seed));
        assert!(found.quality.rms_mm > 1e-3, "{}", found.quality.rms_mm);
        assert_eq!(warnings(&found), "", "seed {seed}");
    }
}

#[test]
fn plausibility_reports_wrong_radius() {
    for seed in 1..=4 {
        for factor in [0.5, 2.0] {
            let given_mm = factor * RADIUS_MM;
            let words = warnings(&with_radius(given_mm, &whole(seed)));
            let told = proposed_radius(&words).unwrap_or_else(|| panic!("{given_mm} mm, seed {seed}: {words:?}"));
            assert!((told / RADIUS_MM - 1.0).abs() < 0.2, "{words}");
            assert!(
                words.contains(&format!("the given {given_mm} mm")) && words.contains("not its diameter"),
                "{words}"
            );
        }
    }
}

#[test]
fn plausibility_reports_contact_points() {
    for seed in 1..=4 {
        let right = with_radius(RADIUS_MM, &whole(seed));
        let contacts: Vec<Point> =
            right.deviations.iter().map(|d| right.cmm_from_model.transform_point(&d.point)).collect();
        let words = warnings(&with_radius(RADIUS_MM, &contacts));
        assert!(words.contains("look like contact points") && words.contains("`contact`"), "{words}");
        let found = register(
            nominal(),
            &contacts,
            &RegistrationOptions { method: Method::Contact, ..RegistrationOptions::new(0.0) },
        )
        .unwrap();
        assert_eq!(warnings(&found), "");
    }
}

#[test]
fn refused_fit_reports_radius() {
    let options = RegistrationOptions { rms_limit_mm: Some(0.01), ..RegistrationOptions::new(2.0 * RADIUS_MM) };
    let told = register(nominal(), &whole(1), &options).unwrap_err();
    let proposes_mm = |told: &RegistrationError| match told {
        RegistrationError::DoesNotFit { remedy, .. } => proposed_radius(remedy),
        _ => panic!("{told}"),
    };
    assert!(proposes_mm(&told).is_some_and(|radius_mm| (1.0..2.0).contains(&radius_mm)), "{told}");
    let told = register(
        nominal(),
        &whole(1),
        &RegistrationOptions { rms_limit_mm: Some(1e-4), ..RegistrationOptions::new(RADIUS_MM) },
    )
    .unwrap_err();
    assert_eq!(proposes_mm(&told), None, "{told}");
}

#[test]
fn plausibility_reports_low_coverage() {
    let told = |measured: &[Point], points: &str| {
        let found = with_radius(RADIUS_MM, measured);
        let (words, share) = (warnings(&found), format!("{:.0} %", 100.0 * found.quality.coverage));
        for piece in [points, &share, "cut short"] {
            assert!(words.contains(piece), "{piece}: {words}");
        }
        found.quality.coverage
    };
    let coverage = told(&measured(1, [25.0, 15.0]), "1800 points");
    assert!((0.2..0.3).contains(&coverage), "{coverage}");
    // The first rows of a file that was cut.
    told(&whole(1)[..180], "180 points");
}

#[test]
fn plausibility_reports_many_outliers() {
    // No two of them are neighbours in the pattern of 60 columns.
    let spoiled = |every: usize| {
        let mut cloud = whole(1);
        cloud.iter_mut().step_by(every).for_each(|p| p.z += 0.5);
        warnings(&with_radius(RADIUS_MM, &cloud))
    };
    let words = spoiled(31);
    assert!(words.starts_with("59 points") && !words.contains('%'), "{words}");
    for piece in ["point 0", "(-50.0, -30.0) mm", "54 more", "PV is 0."] {
        assert!(words.contains(piece), "{piece}: {words}");
    }
    let words = spoiled(13);
    for piece in ["139 of 1800 points (8 %)", "outliers"] {
        assert!(words.contains(piece), "{piece}: {words}");
    }
}

#[test]
fn register_refuses_mirror_image() {
    let as_it_is = whole(1);
    for axis in 0..3 {
        let mirrored: Vec<Point> = as_it_is
            .iter()
            .map(|p| {
                let mut p = *p;
                p[axis] = -p[axis];
                p
            })
            .collect();
        for side in [ProbeSide::Auto, ProbeSide::Above] {
            for start in [Start::Search, Start::Pose(Pose::identity())] {
                let told = register(
                    nominal(),
                    &mirrored,
                    &RegistrationOptions { side, start, ..RegistrationOptions::new(RADIUS_MM) },
                )
                .unwrap_err();
                assert!(matches!(told, RegistrationError::Mirrored { .. }), "axis {axis}, {side:?}, {start:?}: {told}");
            }
        }
    }
    // A cloud that lies elsewhere is no mirror image.
    let far = Pose { translation_mm: [400.0, 0.0, 0.0].into(), ..Pose::identity() };
    let told = register(
        nominal(),
        &as_it_is,
        &RegistrationOptions { start: Start::Pose(far), ..RegistrationOptions::new(RADIUS_MM) },
    );
    assert!(!matches!(told, Err(RegistrationError::Mirrored { .. })), "{told:?}");
}
