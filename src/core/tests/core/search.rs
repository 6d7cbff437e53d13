//! Registration without an initial guess.

use crate::common::{RADIUS_MM, centres, free_form, placed, points, pose, pose_error_mm};
use regrind_core::registration::{RegistrationOptions, register};
use regrind_sim::form::FormError;
use regrind_sim::probe::Placement;
use regrind_sim::shape::FreeForm;

/// Registers random poses of a patch without a start and returns the seeds, with their errors, that missed by more than
/// a limit.
fn missed_poses(
    corners: [[f64; 2]; 2],
    counts: [usize; 2],
    seeds: std::ops::Range<u64>,
    limit_mm: f64,
) -> Vec<(u64, String)> {
    let nominal = free_form(451, 251);
    let centres = centres(&FreeForm::default(), &FormError::none(), corners, counts);
    let error = |seed: u64| {
        let mut rng = regrind_sim::rng(seed);
        let placement = Placement::random(&mut rng, 500.0);
        let mut measured = placed(&placement, &centres);
        regrind_sim::probe::add_noise(&mut rng, &mut measured, 3e-4);
        match register(&nominal, &points(&measured), &RegistrationOptions::new(RADIUS_MM)) {
            Ok(found) => {
                let error_mm = pose_error_mm(&found.cmm_from_model, &pose(&placement));
                (error_mm > limit_mm).then(|| format!("{error_mm:.5} mm"))
            }
            Err(error) => Some(error.to_string()),
        }
    };
    seeds.filter_map(|seed| error(seed).map(|e| (seed, e))).collect()
}

// The limits are five times the scatter that 0.3 um of noise leaves at the worst corner.

#[test]
fn search_finds_whole_part() {
    let astray = missed_poses([[-50.5, -30.5], [50.5, 30.5]], [57, 35], 0..100, 5e-4);
    assert!(astray.is_empty(), "{astray:?}");
}

#[test]
fn search_finds_third_of_part() {
    let astray = missed_poses([[-15.0, -30.5], [18.5, 30.5]], [33, 60], 100..200, 4e-3);
    assert!(astray.is_empty(), "{astray:?}");
}
