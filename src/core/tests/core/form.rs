//! The figures of what is left on a part, held against forms that were put on it.

use std::f64::consts::TAU;

use regrind_core::form::{
    DeviationFigures, FormError, FormOptions, PolynomialBasis, PolynomialFit, RemovedForm, RemovedParts,
    compute_figures, fit_determined_terms, fit_polynomials, iso_10110, label_figures,
};
use regrind_core::geometry::{Aperture, DeviationSample};
use regrind_core::surface::analytic::ZernikeNumbering;

const CENTRE: [f64; 2] = [3.0, -2.0];
const RADIUS: f64 = 20.0;

fn circle() -> Aperture {
    Aperture::Circle { centre_mm: CENTRE, radius_mm: RADIUS }
}

fn ring() -> Aperture {
    Aperture::Annulus { centre_mm: CENTRE, inner_radius_mm: 8.0, outer_radius_mm: RADIUS }
}

fn rectangle() -> Aperture {
    Aperture::Rectangle { centre_mm: [-4.0, 10.0], width_mm: 60.0, height_mm: 36.0 }
}

/// Samples of a function of the place on a grid over an aperture.
fn sampled(aperture: &Aperture, step: f64, f: impl Fn(f64, f64) -> f64) -> Vec<DeviationSample> {
    let [low, high] = aperture.bounds();
    let count = |k: usize| ((high[k] - low[k]) / step).round() as usize + 1;
    let places = (0..count(0) * count(1))
        .map(|k| [low[0] + (k % count(0)) as f64 * step, low[1] + (k / count(0)) as f64 * step]);
    let inside = places.filter(|[x, y]| aperture.contains(*x, *y));
    inside.map(|at_mm| DeviationSample { place_mm: at_mm, deviation_mm: f(at_mm[0], at_mm[1]) }).collect()
}

/// rho and theta about the middle of the disc.
fn polar(x: f64, y: f64) -> (f64, f64) {
    let (x, y) = (x - CENTRE[0], y - CENTRE[1]);
    (x.hypot(y) / RADIUS, y.atan2(x))
}

/// Astigmatism, coma, spherical and a trefoil, by hand: orthonormal Zernike polynomials.
fn planted(x: f64, y: f64) -> f64 {
    let (r, t) = polar(x, y);
    let astigmatism = 6f64.sqrt() * r * r * (2.0 * t).cos();
    let coma = 8f64.sqrt() * (3.0 * r * r * r - 2.0 * r) * t.sin();
    let spherical = 5f64.sqrt() * (6.0 * r.powi(4) - 6.0 * r * r + 1.0);
    let trefoil = 8f64.sqrt() * r.powi(3) * (3.0 * t).cos();
    3e-4 * astigmatism - 1e-4 * coma + 2e-4 * spherical + 5e-5 * trefoil
}

fn coefficient(fit: &PolynomialFit, term: &str) -> f64 {
    let k = (0..fit.coefficients_mm.len()).find(|k| fit.basis.term_name(*k) == term);
    fit.coefficients_mm[k.unwrap_or_else(|| panic!("no {term}"))]
}

fn is_about(found: f64, expected: f64, within: f64) -> bool {
    (found - expected).abs() <= within
}

#[test]
fn zernike_fit_on_disc_and_ring() {
    for aperture in [circle(), ring()] {
        let samples = sampled(&aperture, 1.0, planted);
        let fitted = fit_polynomials(&PolynomialBasis::for_aperture(&aperture), 36, &samples).unwrap();
        for (term, expected) in [
            ("Z5 (2, 2)", 3e-4),
            ("Z8 (3, -1)", -1e-4),
            ("Z9 (4, 0)", 2e-4),
            ("Z10 (3, 3)", 5e-5),
            ("Z1 (0, 0)", 0.0),
            ("Z36 (10, 0)", 0.0),
        ] {
            assert!(is_about(coefficient(&fitted, term), expected, 1e-13), "{term}: {}", coefficient(&fitted, term));
        }
        assert!(fitted.residual_rms_mm < 1e-15 && fitted.points == samples.len());
        // The same surface has other indices in other numberings.
        let PolynomialBasis::Zernike { centre_mm, radius_mm, .. } = fitted.basis else { panic!() };
        for (numbering, term) in [(ZernikeNumbering::Noll, "Z11 (4, 0)"), (ZernikeNumbering::Ansi, "Z12 (4, 0)")] {
            let other =
                fit_polynomials(&PolynomialBasis::Zernike { numbering, centre_mm, radius_mm }, 21, &samples).unwrap();
            assert!(is_about(coefficient(&other, term), 2e-4, 1e-13), "{numbering:?}");
        }
    }
}

#[test]
fn legendre_fit_on_rectangle() {
    let rectangle = rectangle();
    let p2 = |t: f64| 5f64.sqrt() * 0.5 * (3.0 * t * t - 1.0);
    let p3 = |t: f64| 7f64.sqrt() * 0.5 * (5.0 * t.powi(3) - 3.0 * t);
    let form = |x: f64, y: f64| {
        let [u, v] = [(x + 4.0) / 30.0, (y - 10.0) / 18.0];
        1e-3 * p2(u) * 3f64.sqrt() * v - 4e-4 * p3(v) + 2e-5
    };
    let fitted =
        fit_polynomials(&PolynomialBasis::for_aperture(&rectangle), 36, &sampled(&rectangle, 1.5, form)).unwrap();
    for (term, expected) in [("L2(x) L1(y)", 1e-3), ("L0(x) L3(y)", -4e-4), ("L0(x) L0(y)", 2e-5), ("L7(x) L0(y)", 0.0)]
    {
        assert!(is_about(coefficient(&fitted, term), expected, 1e-14), "{term}: {}", coefficient(&fitted, term));
    }
}

#[test]
fn orthogonal_terms_sum_to_mean_square() {
    let rough = |x: f64, y: f64| 1e-4 * ((0.7 * x).sin() + (0.4 * x * y).cos()) + planted(x, y);
    for aperture in [circle(), ring(), rectangle()] {
        let samples = sampled(&aperture, 1.0, rough);
        let basis = PolynomialBasis::for_aperture(&aperture);
        let (few, many) =
            (fit_polynomials(&basis, 15, &samples).unwrap(), fit_polynomials(&basis, 36, &samples).unwrap());
        for (a, b) in few.orthogonal_mm.iter().zip(&many.orthogonal_mm) {
            assert!(is_about(*a, *b, 1e-15), "{a} {b}");
        }
        let square = many.orthogonal_mm.iter().map(|c| c * c).sum::<f64>() + many.residual_rms_mm.powi(2);
        let rms2 = samples.iter().map(|s| s.deviation_mm.powi(2)).sum::<f64>() / samples.len() as f64;
        assert!(is_about(square / rms2, 1.0, 1e-12), "{square} {rms2}");
    }
}

fn figures_over(samples: &[DeviationSample], aperture: Aperture) -> DeviationFigures {
    compute_figures(samples, &FormOptions { aperture: Some(aperture), ..FormOptions::default() }).unwrap()
}

#[test]
fn pvr_ignores_single_spike() {
    for (aperture, basis) in [(circle(), "Zernike (Fringe)"), (rectangle(), "Legendre")] {
        let smooth = sampled(&aperture, 0.5, |x, y| 1e-3 * (x / 30.0).sin() + 5e-4 * (y / 20.0).cos());
        let clean = figures_over(&smooth, aperture.clone());
        assert!(is_about(clean.pvr.value_mm, clean.pv_mm, 1e-3 * clean.pv_mm), "{:?}", clean.pvr);
        let mut spiked = smooth.clone();
        let middle = spiked.len() / 2;
        spiked[middle].deviation_mm = 1e-2;
        let found = figures_over(&spiked, aperture);
        assert_eq!((found.pvr.basis, found.pvr.terms), (basis, 36));
        assert!(found.pv_mm > 5.0 * clean.pv_mm && found.pvr.value_mm < 2.0 * clean.pvr.value_mm, "{:?}", found.pvr);
        assert!(
            is_about(found.pv_998_mm, clean.pv_998_mm, 1e-2 * clean.pv_mm),
            "{} {}",
            found.pv_998_mm,
            clean.pv_998_mm
        );
        assert_eq!((found.highest.value_mm, found.highest.place_mm), (1e-2, smooth[middle].place_mm));
        assert_eq!(found.lowest, clean.lowest);
        // PVr by hand: three times the rms of the rest and the range of the fit.
        let rms = found.pvr.residual_rms_mm;
        assert!(is_about(rms, 1e-2 / (spiked.len() as f64).sqrt(), 0.15 * rms), "{rms}");
        assert_eq!(found.pvr.value_mm, found.pvr.fit_pv_mm + 3.0 * rms);
    }
}

#[test]
fn figures_scale_with_deviations() {
    let zero = figures_over(&sampled(&circle(), 1.0, |_, _| 0.0), circle());
    assert_eq!([zero.pv_mm, zero.pvr.value_mm, zero.pv_998_mm, zero.rms_mm, zero.mean_mm], [0.0; 5]);
    assert_eq!(zero.iso_10110.notation, "3/0(0/0) RMSt<0; RMSi<0; RMSa<0; lambda=632.8");
    let one = figures_over(&sampled(&circle(), 1.0, planted), circle());
    for scale in [1e-9, 1e9] {
        let other = figures_over(&sampled(&circle(), 1.0, |x, y| scale * planted(x, y)), circle());
        let pairs = [
            (one.pv_mm, other.pv_mm),
            (one.pvr.value_mm, other.pvr.value_mm),
            (one.pv_998_mm, other.pv_998_mm),
            (one.rms_mm, other.rms_mm),
            (one.iso_10110.irregularity_nm, other.iso_10110.irregularity_nm),
            (one.iso_10110.symmetric_nm, other.iso_10110.symmetric_nm),
        ];
        assert!(pairs.iter().all(|(a, b)| is_about(b / (a * scale), 1.0, 1e-9)), "{scale}: {pairs:?}");
    }
    // The order of the points says nothing.
    let mut turned = sampled(&circle(), 1.0, planted);
    turned.reverse();
    let turned = figures_over(&turned, circle());
    assert!(is_about(turned.pvr.value_mm, one.pvr.value_mm, 1e-15) && is_about(turned.rms_mm, one.rms_mm, 1e-16));
}

#[test]
fn removed_terms_are_recorded() {
    let form = |x: f64, y: f64| 1.0 + 0.2 * x - 0.1 * y + 1e-2 * (x * x + y * y) + 1e-3 * x * y;
    let samples = sampled(&rectangle(), 1.0, form);
    let of = |removed: Vec<RemovedForm>| {
        compute_figures(&samples, &FormOptions { removed, aperture: Some(rectangle()), ..FormOptions::default() })
            .unwrap()
    };
    use RemovedForm::{Astigmatism, Piston, Power, Tilt};
    let found = of(vec![Power, Tilt, Piston, Tilt]);
    assert_eq!(found.removed, [Piston, Tilt, Power]);
    // What stays of x y about the middle (-4, 10) is astigmatism alone.
    assert!(
        is_about(found.pv_mm, 2.0 * 1e-3 * 30.0 * 18.0, 1e-9) && is_about(found.mean_mm, 0.0, 1e-12),
        "{}",
        found.pv_mm
    );
    assert!(of(vec![Piston, Tilt, Power, Astigmatism]).pv_mm < 1e-11);
    let taken_out =
        RemovedParts { motion: "rigid motion but x (registration)".into(), filter: "waves below 3 mm".into() };
    let rows = label_figures(&found, &taken_out);
    assert!(rows.iter().all(|row| !row.removed.is_empty() && !row.direction.is_empty() && !row.cut_off.is_empty()));
    let pv = rows.iter().find(|row| row.name == "PV of the points").unwrap();
    assert_eq!((pv.unit, pv.removed.as_str()), ("um", "rigid motion but x (registration), piston, tilt, power"));
    assert!(is_about(pv.value, 1e3 * found.pv_mm, 1e-9));
}

#[test]
fn iso_10110_separates_known_forms() {
    let of = |f: &dyn Fn(f64, f64) -> f64| iso_10110(&sampled(&circle(), 0.5, f), &circle(), 546.1).unwrap();
    let tilted = |x: f64, y: f64| 1e-2 + 3e-4 * x - 2e-4 * y;
    // Power alone: 100 nm at the rim.
    let power = of(&|x, y| tilted(x, y) + 1e-4 * polar(x, y).0.powi(2));
    assert!(is_about(power.power_nm, 100.0, 1e-6) && is_about(power.power_rim_nm, 100.0, 1e-6), "{power:?}");
    assert!(power.irregularity_nm < 1e-6 && power.symmetric_nm < 1e-6 && power.rms_varying_nm < 1e-7);
    // A paraboloid over a disc: rms 1 / sqrt 12 of its height.
    assert!(is_about(power.rms_total_nm, 100.0 / 12f64.sqrt(), 0.1), "{power:?}");
    assert!(power.notation.starts_with("3/100(0/0) RMSt<29; RMSi<0"), "{}", power.notation);
    // Astigmatism alone: nothing symmetric, 100 nm from valley to peak, rms 1 / sqrt 6 of its amplitude.
    let astigmatism = of(&|x, y| tilted(x, y) + 5e-5 * polar(x, y).0.powi(2) * (2.0 * polar(x, y).1).cos());
    assert!(astigmatism.power_nm < 1e-6 && astigmatism.symmetric_nm < 1e-6);
    assert!(is_about(astigmatism.irregularity_nm, 100.0, 1e-6), "{astigmatism:?}");
    assert!(is_about(astigmatism.rms_varying_nm, 50.0 / 6f64.sqrt(), 0.2), "{astigmatism:?}");
    assert!(is_about(astigmatism.rms_irregularity_nm, astigmatism.rms_varying_nm, 1e-9));
    // Spherical alone: all irregularity is symmetric, and the balanced form has no power.
    let spherical = of(&|x, y| {
        let r = polar(x, y).0;
        1e-4 * (6.0 * r.powi(4) - 6.0 * r * r + 1.0)
    });
    assert!(is_about(spherical.symmetric_nm, spherical.irregularity_nm, 1e-6) && spherical.rms_varying_nm < 1e-6);
    assert!(is_about(spherical.irregularity_nm, 150.0, 1.5) && spherical.power_nm < 3.0, "{spherical:?}");
    assert!(spherical.notation.ends_with("lambda=546.1"));
    assert!(matches!(iso_10110(&sampled(&circle(), 2.0, tilted), &circle(), 0.0), Err(FormError::Wavelength { .. })));
}

#[test]
fn few_points_reduce_terms() {
    let samples = sampled(&circle(), 1.0, planted);
    let basis = PolynomialBasis::for_aperture(&circle());
    for (points, terms) in [(4, 1), (15, 1), (16, 4), (100, 25), (143, 25), (144, 36)] {
        let spread: Vec<DeviationSample> = (0..points).map(|k| samples[k * 997 % samples.len()]).collect();
        assert_eq!(fit_determined_terms(&basis, 36, &spread).unwrap().coefficients_mm.len(), terms, "{points}");
        assert_eq!(figures_over(&spread, circle()).pvr.terms, terms);
    }
    let three = &samples[..3];
    let told = compute_figures(three, &FormOptions::default()).unwrap_err();
    assert_eq!(told, FormError::TooFewPoints { points: 3, min_points: 4 });
    assert!(told.to_string().contains("measure more"));
    assert!(matches!(
        fit_polynomials(&basis, 36, &samples[..35]),
        Err(FormError::TooFewPoints { points: 35, min_points: 36 })
    ));
    // Five columns tell no sixth power of x, however many points they hold.
    let columns: Vec<DeviationSample> = (0..2000)
        .map(|k| [f64::from(k % 5) - 2.0, f64::from(k / 5) * 0.01])
        .map(|at_mm| DeviationSample { place_mm: at_mm, deviation_mm: at_mm[0].powi(3) })
        .collect();
    let rectangle = PolynomialBasis::legendre([[-2.0, 0.0], [2.0, 4.0]]);
    let told = fit_polynomials(&rectangle, 36, &columns).unwrap_err().to_string();
    assert!(told.contains("L5(x) L0(y)") && told.contains("more densely"), "{told}");
    assert_eq!(fit_determined_terms(&rectangle, 36, &columns).unwrap().coefficients_mm.len(), 15);
}

#[test]
fn figures_refuse_no_area_or_nan() {
    let line: Vec<DeviationSample> =
        (0..50).map(|k| DeviationSample { place_mm: [f64::from(k), 2.0], deviation_mm: 1e-3 }).collect();
    assert_eq!(compute_figures(&line, &FormOptions::default()), Err(FormError::NoArea));
    let slant: Vec<DeviationSample> =
        (0..50).map(|k| DeviationSample { place_mm: [f64::from(k); 2], deviation_mm: 1e-3 }).collect();
    assert!(matches!(compute_figures(&slant, &FormOptions::default()), Err(FormError::Undetermined { .. })));
    let place = vec![DeviationSample { place_mm: [1.0, 1.0], deviation_mm: 0.0 }; 9];
    assert_eq!(compute_figures(&place, &FormOptions::default()), Err(FormError::NoArea));
    let mut bad = sampled(&circle(), 2.0, planted);
    bad[7].deviation_mm = f64::NAN;
    assert_eq!(compute_figures(&bad, &FormOptions::default()), Err(FormError::NotFinite { index: 7 }));
    let mut far = sampled(&circle(), 2.0, planted);
    far[5].place_mm = [500.0, 0.0];
    let options = FormOptions { aperture: Some(circle()), ..FormOptions::default() };
    assert!(matches!(compute_figures(&far, &options), Err(FormError::FarOut { index: 5, .. })));
}

#[test]
fn coverage_of_aperture_by_points() {
    let full = figures_over(&sampled(&circle(), 0.5, planted), circle());
    assert!(full.coverage.share > 0.99, "{:?}", full.coverage);
    let half: Vec<DeviationSample> =
        sampled(&circle(), 0.5, planted).into_iter().filter(|s| s.place_mm[0] > CENTRE[0]).collect();
    let half = figures_over(&half, circle());
    assert!(is_about(half.coverage.share, 0.5, 0.06), "{:?}", half.coverage);
    // Without an aperture there is nothing beyond the points.
    let free = compute_figures(&sampled(&ring(), 0.5, |x, _| (x * TAU / 9.0).sin()), &FormOptions::default()).unwrap();
    assert!(is_about(free.coverage.share, 0.785 * (1.0 - 0.16), 0.05), "{:?}", free.coverage);
}
