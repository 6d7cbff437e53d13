//! Planted wheel and setting errors on known surfaces, under form and noise.

use crate::common::normal;
use rand::SeedableRng;
use rand::rngs::StdRng;
use regrind_core::compensation::{
    Contact, Parameter, ParameterError, ParameterKind, ParameterOptions, Parameters, WheelTerm, parameters,
};
use regrind_core::geometry::{Point, Vector};
use regrind_sim::form::FormError;
use regrind_sim::shape::{FreeForm, Shape, Sphere};

const WHEEL_MM: f64 = 12.5;
const DATUM: [bool; 6] = [false, false, true, true, true, true];

/// Contacts on a shape, 60 x 40 over 100 x 60 mm, off by a function of the contact and its progress along y.
fn on(shape: &dyn Shape, off: impl Fn(&Contact, f64) -> f64) -> Vec<Contact> {
    (0..60 * 40)
        .map(|k| {
            let (x, y) = (100.0 * ((k % 60) as f64 / 59.0 - 0.5), 60.0 * ((k / 60) as f64 / 39.0 - 0.5));
            let mut contact = Contact {
                point: Point::from(shape.point(x, y)),
                normal: Vector::from(shape.normal(x, y)),
                deviation_mm: 0.0,
            };
            contact.deviation_mm = off(&contact, (k / 60) as f64 / 39.0);
            contact
        })
        .collect()
}

fn find(contacts: &[Contact], free_motions: [bool; 6]) -> Parameters {
    parameters(contacts, None, &ParameterOptions { free_motions, ..ParameterOptions::new(WHEEL_MM) }).unwrap()
}

fn of(found: &Parameters, kind: ParameterKind) -> &Parameter {
    found.found.iter().find(|p| p.kind == kind).unwrap()
}

/// What the simulated grinder does with a wheel larger by dr, off by ex and ey.
fn planted(contact: &Contact, dr: f64, ex: f64, ey: f64) -> f64 {
    let n = contact.normal;
    -dr * (1.0 / n.z - 1.0) - ex * n.x - ey * n.y
}

#[test]
fn what_is_planted_is_found_exactly_without_form() {
    let contacts = on(&FreeForm::default(), |c, _| {
        // The datum leaves the height free.
        let moved = -0.02 * c.normal.z;
        planted(c, 0.09, 0.012, -0.009) + moved
    });
    let found = find(&contacts, DATUM);
    for (kind, value) in
        [(ParameterKind::WheelRadius, 0.09), (ParameterKind::SettingX, 0.012), (ParameterKind::SettingY, -0.009)]
    {
        let parameter = of(&found, kind);
        println!("{}: own share {}", parameter.message, parameter.own_share);
        assert!((parameter.value_mm - value).abs() < 1e-10 && parameter.offered, "{}", parameter.message);
    }
    assert!(found.rest_rms_mm < 1e-10 && found.rms_mm > 1e-3);
    let radius = &of(&found, ParameterKind::WheelRadius).message;
    assert!(radius.starts_with("wheel radius: 12.5900 mm instead of 12.5000 mm would remove "), "{radius}");
}

/// Sixty worlds: how far values are off in units of their stated uncertainty, and how often by more than three.
fn coverage(
    free: [bool; 6],
    kinds: &[ParameterKind],
    [form_um, length_mm, noise_um]: [f64; 3],
) -> Vec<(f64, usize, f64)> {
    let mut sums = vec![(0.0, 0, 0.0); kinds.len()];
    const WORLDS: u64 = 60;
    for seed in 0..WORLDS {
        let mut rng = regrind_sim::rng(seed);
        let form = FormError::with_rms(&mut rng, length_mm, 1e-3 * form_um);
        let noise = std::cell::RefCell::new(StdRng::seed_from_u64(seed));
        let contacts = on(&FreeForm::default(), |c, _| {
            planted(c, 0.09, 0.012, -0.009)
                + form.height(c.point.x, c.point.y)
                + 1e-3 * noise_um * normal(&mut noise.borrow_mut())
        });
        let found = find(&contacts, free);
        for (sum, kind) in sums.iter_mut().zip(kinds) {
            let truth = match kind {
                ParameterKind::WheelRadius => 0.09,
                ParameterKind::SettingX => 0.012,
                ParameterKind::SettingY => -0.009,
                _ => 0.0,
            };
            let parameter = of(&found, *kind);
            let z = (parameter.value_mm - truth) / parameter.sigma_mm;
            sum.0 += z * z / WORLDS as f64;
            sum.1 += usize::from(z.abs() > 3.0);
            sum.2 += parameter.sigma_mm / WORLDS as f64;
        }
    }
    sums.into_iter().map(|(z2, far, sigma)| (z2.sqrt(), far, sigma)).collect()
}

#[test]
fn values_are_within_what_is_stated_of_them() {
    use ParameterKind::{SettingX, SettingY, WheelRadius};
    for (free, world) in [
        (DATUM, [0.9, 18.0, 0.3]),
        (DATUM, [0.9, 10.0, 0.3]),
        (DATUM, [0.9, 5.0, 0.3]),
        (DATUM, [0.0, 18.0, 0.5]),
        ([true; 6], [0.9, 18.0, 0.3]),
    ] {
        let kinds: &[ParameterKind] = if free[0] { &[WheelRadius] } else { &[WheelRadius, SettingX, SettingY] };
        for (kind, (z, far, sigma)) in kinds.iter().zip(coverage(free, kinds, world)) {
            println!(
                "{world:?} {kind:?}: off by {z:.2} sigma (rms), {far} of 60 beyond three, sigma {:.3} um",
                1e3 * sigma
            );
            assert!(z < 1.5 && far <= 3, "{kind:?}: {z} {far}");
            assert!(z > 0.3, "{kind:?}: stated far too uncertain, {z}");
        }
    }
}

#[test]
fn form_is_not_taken_for_a_parameter() {
    let mut offered = 0;
    for seed in 0..40 {
        let form = FormError::with_rms(&mut regrind_sim::rng(seed), 25.0, 1.5e-3);
        let found = find(&on(&FreeForm::default(), |c, _| form.height(c.point.x, c.point.y)), DATUM);
        offered += found.found.iter().filter(|p| p.offered).count();
        assert!(found.rest_rms_mm <= found.rms_mm + 1e-15);
    }
    println!("{offered} of 160 offered");
    assert!(offered <= 8, "{offered} of 160");
}

#[test]
fn what_looks_alike_is_said() {
    let noise = std::cell::RefCell::new(StdRng::seed_from_u64(1));
    let scatter = |_: &Contact, _: f64| 1e-4 * normal(&mut noise.borrow_mut());
    // A setting error of a round wheel is a shift of the part.
    let free = find(&on(&FreeForm::default(), scatter), [true; 6]);
    let setting = of(&free, ParameterKind::SettingX);
    assert_eq!(setting.alike, ["a shift of the part along x"], "{}", setting.message);
    assert!(!setting.offered && setting.value_mm == 0.0);
    // On a sphere a shift is also a tilt.
    let sphere = find(&on(&Sphere { radius_mm: 120.0 }, scatter), DATUM);
    for kind in [ParameterKind::SettingX, ParameterKind::SettingY] {
        let setting = of(&sphere, kind);
        assert!(!setting.offered && setting.alike[0].starts_with("a tilt of the part about"), "{}", setting.message);
    }
    let plane = find(&on(&FreeForm { scale: 0.0 }, scatter), [true; 6]);
    let radius = of(&plane, ParameterKind::WheelRadius);
    assert!(radius.message.contains("no effect on a level surface"), "{}", radius.message);
    let wear = of(&plane, ParameterKind::Wear);
    assert!(wear.alike.contains(&"a tilt of the part about x".to_owned()), "{}", wear.message);
    assert!(plane.found.iter().all(|p| !p.offered && !p.alike.is_empty()));
    assert_eq!(plane.rest_rms_mm, plane.rms_mm);
    // A plane that leans: 1/nz - 1 is a constant there, which is a shift along z.
    let tilted = Vector::new(0.3, 0.0, 1.0).normalize();
    let leaning: Vec<Contact> = on(&FreeForm { scale: 0.0 }, scatter)
        .into_iter()
        .map(|c| Contact { normal: tilted, point: Point::new(c.point.x, c.point.y, -0.3 * c.point.x), ..c })
        .collect();
    let radius = of(&find(&leaning, [true; 6]), ParameterKind::WheelRadius).clone();
    assert!(!radius.offered && radius.alike.iter().any(|a| a.starts_with("a shift")), "{}", radius.message);
}

/// Progress along a spiral from the middle: as the area within.
fn spiral(contact: &Contact) -> f64 {
    (contact.point.x.powi(2) + contact.point.y.powi(2)) / 3400.0
}

#[test]
fn the_other_term_of_the_wheel_and_a_given_progress_are_followed() {
    let contacts = on(&FreeForm::default(), |c, _| -0.05 * (1.0 - c.normal.z) + 0.004 * spiral(c));
    let progress: Vec<f64> = contacts.iter().map(spiral).collect();
    let options = ParameterOptions { wheel_term: WheelTerm::AlongNormal, ..ParameterOptions::new(WHEEL_MM) };
    let found = parameters(&contacts, Some(&progress), &options).unwrap();
    assert!((of(&found, ParameterKind::WheelRadius).value_mm - 0.05).abs() < 1e-10);
    assert!((of(&found, ParameterKind::Wear).value_mm - 0.004).abs() < 1e-10);
}

#[test]
fn what_cannot_be_separated_is_refused() {
    let contacts = on(&FreeForm::default(), |_, _| 1e-3);
    let options = ParameterOptions::new(WHEEL_MM);
    let error = |contacts: &[Contact]| parameters(contacts, None, &options).unwrap_err();
    assert_eq!(error(&contacts[..5]), ParameterError::TooFew { points: 5 });
    assert_eq!(error(&[]), ParameterError::TooFew { points: 0 });
    let mut broken = contacts.clone();
    broken[9].deviation_mm = f64::NAN;
    assert_eq!(error(&broken), ParameterError::NotFinite { index: 9 });
    let mut hanging = contacts.clone();
    hanging[3].normal.z = -1.0;
    assert_eq!(error(&hanging), ParameterError::Normal { index: 3, nz: -1.0 });
    assert!(matches!(parameters(&contacts, Some(&[0.5]), &options), Err(ParameterError::Progress { found: 1, .. })));
    let flat = ParameterOptions::new(0.0);
    assert!(matches!(parameters(&contacts, None, &flat), Err(ParameterError::WheelRadius { .. })));
    // All at one place, on a line, no deviation at all, huge and tiny ones: figures, no panic, nothing offered of nothing.
    for shape in [vec![contacts[7]; 40], contacts[..60].to_vec()] {
        let found = parameters(&shape, None, &options).unwrap();
        assert!(found.found.iter().all(|p| p.value_mm.is_finite() && p.sigma_mm.is_finite()));
    }
    let still: Vec<Contact> = contacts.iter().map(|c| Contact { deviation_mm: 0.0, ..*c }).collect();
    let found = parameters(&still, None, &options).unwrap();
    assert!(found.found.iter().all(|p| !p.offered) && found.rest_rms_mm == 0.0);
    for factor in [1e-9, 1e3] {
        let sized = on(&FreeForm::default(), |c, _| factor * planted(c, 1.0, 0.0, 0.0));
        let found = find(&sized, DATUM);
        assert!((of(&found, ParameterKind::WheelRadius).value_mm / factor - 1.0).abs() < 1e-9);
    }
}
