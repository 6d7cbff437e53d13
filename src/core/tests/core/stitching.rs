//! Stitching of sub-apertures with planted misplacements.

use std::collections::BTreeMap;

use nalgebra::{Matrix6, Vector6};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use regrind_core::geometry::{Point, Pose, Vector};
use regrind_core::registration::{Method, RegistrationOptions, register};
use regrind_core::stitching::{MeasuredMap, Stitching, StitchingError, StitchingOptions, stitch};
use regrind_core::surface::Nominal;

/// Side of a sub-aperture, and steps of the 3 x 3 of them: 40 % overlap.
const SIDE_MM: f64 = 20.0;
const STEP_MM: f64 = 12.0;
const NOISE_MM: f64 = 10e-6;

/// Height of the nominal surface: a freeform without symmetry.
fn height(x: f64, y: f64) -> f64 {
    let (a, b) = (x / 20.0, y / 20.0);
    2.0 * a * a + 1.4 * b * b + 1.2 * a * a * a - 0.8 * a * b * b + 0.25 * a * b + 0.7 * b * b * b + 0.1 * b * b * b * b
}

fn normal(x: f64, y: f64) -> Vector {
    let h = 1e-5;
    let gx = (height(x + h, y) - height(x - h, y)) / (2.0 * h);
    let gy = (height(x, y + h) - height(x, y - h)) / (2.0 * h);
    Vector::new(-gx, -gy, 1.0).normalize()
}

/// Form of the part in mm above the nominal surface: 0.4 µm of low order, and 50 nm of waviness.
fn form(x: f64, y: f64) -> f64 {
    let (a, b) = (x / 22.0, y / 22.0);
    4e-4 * (a * a - b * b + 0.6 * a * a * b) + 5e-5 * (x / 1.9).sin() * (y / 2.3).cos()
}

fn nominal() -> Nominal {
    let side = 141;
    let at = |k: usize| (k as f64 - 70.0) * 0.35;
    let places = || (0..side * side).map(|k| (at(k % side), at(k / side)));
    let points = places().map(|(x, y)| Point::new(x, y, height(x, y))).collect();
    let normals = places().map(|(x, y)| normal(x, y)).collect();
    Nominal::from_grid_with_normals(side, side, points, normals).unwrap()
}

/// Nine sub-apertures, each in a frame that differs from the common one.
struct Measurement {
    maps: Vec<Vec<Point>>,
    /// Poses that transform the frames of the maps to the frame of the part.
    truth: Vec<Pose>,
    places: Vec<Vec<[f64; 2]>>,
}

fn gaussian(random: &mut StdRng) -> f64 {
    let (u, v): (f64, f64) = (random.random::<f64>().max(1e-300), random.random());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// Measures with misplacements of up to `shift_mm` and `tilt_rad`, on a grid of `side` x `side` places.
fn measure(random: &mut StdRng, side: usize, shift_mm: f64, tilt_rad: f64) -> Measurement {
    let mut found = Measurement { maps: Vec::new(), truth: Vec::new(), places: Vec::new() };
    for k in 0..9 {
        let centre = [STEP_MM * (f64::from(k % 3) - 1.0), STEP_MM * (f64::from(k / 3) - 1.0)];
        let motion = Vector6::from_fn(|i, _| random.random_range(-1.0..1.0) * if i < 3 { shift_mm } else { tilt_rad });
        let truth = Pose::exp(&motion);
        let at = |i: usize, k: usize| centre[k] + SIDE_MM * ((i as f64 + 0.5) / side as f64 - 0.5);
        let places: Vec<[f64; 2]> = (0..side * side).map(|i| [at(i % side, 0), at(i / side, 1)]).collect();
        let from_part = truth.inverse();
        let measured = places.iter().map(|&[x, y]| {
            let above = form(x, y) + NOISE_MM * gaussian(random);
            from_part.transform_point(&(Point::new(x, y, height(x, y)) + normal(x, y) * above))
        });
        found.maps.push(measured.collect());
        found.truth.push(truth);
        found.places.push(places);
    }
    found
}

fn options() -> StitchingOptions {
    let registration = RegistrationOptions { method: Method::Contact, ..RegistrationOptions::new(0.0) };
    StitchingOptions { registration, placement_sigma_mm: 1.0 }
}

fn stitched(nominal: &Nominal, measurement: &Measurement) -> Stitching {
    stitch(nominal, &maps(&measurement.maps), &options()).unwrap()
}

/// Returns the rms over cells of `cell_mm` of the mean deviation minus the form, without the motion of the whole.
fn form_error_mm(deviations: impl Iterator<Item = f64>, places: &[[f64; 2]], cell_mm: f64) -> f64 {
    let mut cells: BTreeMap<[i64; 2], (Vector6<f64>, f64, f64)> = BTreeMap::new();
    for (deviation, &[x, y]) in deviations.zip(places) {
        let (p, n) = (Vector::new(x, y, height(x, y)), normal(x, y));
        let turn = p.cross(&n) / 20.0;
        let jacobian = Vector6::new(n.x, n.y, n.z, turn.x, turn.y, turn.z);
        let cell = cells.entry([x, y].map(|c| (c / cell_mm).floor() as i64)).or_default();
        *cell = (cell.0 + jacobian, cell.1 + deviation - form(x, y), cell.2 + 1.0);
    }
    let rows: Vec<(Vector6<f64>, f64)> = cells.values().map(|(j, d, count)| (j / *count, d / count)).collect();
    let square: Matrix6<f64> = rows.iter().map(|(j, _)| j * j.transpose()).sum();
    let right: Vector6<f64> = rows.iter().map(|(j, d)| j * *d).sum();
    let motion = square.cholesky().unwrap().solve(&right);
    (rows.iter().map(|(j, d)| (d - j.dot(&motion)).powi(2)).sum::<f64>() / rows.len() as f64).sqrt()
}

/// Figures of one stitching against the truth.
struct Trial {
    /// Error of the form, stitched and with known misplacements, over cells of the distance of the points.
    form_mm: [f64; 2],
    /// Difference of the two forms, as found and as stated.
    difference_mm: [f64; 2],
    /// Seams whose true step is inside the stated 95 % interval, and all seams.
    seams: [usize; 2],
}

/// Stitches nine sub-apertures with misplacements of 50 µm and tilts, and compares with the truth.
fn trial(nominal: &Nominal, seed: u64) -> Trial {
    let mut random = StdRng::seed_from_u64(seed);
    let measurement = measure(&mut random, 41, 0.05, 3e-4);
    let found = stitched(nominal, &measurement);
    let places = measurement.places.concat();
    let pairs = measurement.maps.iter().zip(&measurement.truth);
    let known: Vec<Point> = pairs.flat_map(|(points, pose)| points.iter().map(|p| pose.transform_point(p))).collect();
    let best = register(nominal, &known, &options().registration).unwrap();
    let [ours, theirs] = [&found.whole, &best].map(|whole| whole.deviations.iter().map(|d| d.deviation_mm));
    let cell_mm = SIDE_MM / 41.0;
    let form_mm = [ours.clone(), theirs.clone()].map(|deviations| form_error_mm(deviations, &places, cell_mm));
    let differences = ours.zip(theirs).zip(&places).map(|((a, b), &[x, y])| a - b + form(x, y));
    let stated: f64 = found.placement_sigmas_mm.iter().map(|sigma| sigma * sigma).sum();
    let difference_mm = [form_error_mm(differences, &places, cell_mm), (stated / places.len() as f64).sqrt()];
    let part_frames: Vec<Pose> =
        found.common_from_map.iter().zip(&measurement.truth).map(|(pose, truth)| *pose * truth.inverse()).collect();
    let inside = found.seams.iter().filter(|seam| {
        let [k, l] = seam.maps.map(|map| part_frames[map]);
        let common = found.whole.cmm_from_model.transform_point(&seam.middle);
        let step = common - l.transform_point(&k.inverse().transform_point(&common));
        let normal = found.whole.cmm_from_model.transform_direction(&normal(seam.middle.x, seam.middle.y));
        step.dot(&normal).abs() <= 1.96 * seam.sigma_mm
    });
    let seams = [inside.count(), found.seams.len()];
    let nm = |mm: f64| 1e6 * mm;
    println!(
        "seed {seed}: {} rounds, noise {:.2} nm, correlation {:.2}, form {:.2} nm, with known misplacements {:.2} nm, \
         difference {:.2} nm, stated {:.2} nm, seams {seams:?}",
        found.rounds,
        nm(found.noise_sigmas_mm[0]),
        found.correlation_factors[4],
        nm(form_mm[0]),
        nm(form_mm[1]),
        nm(difference_mm[0]),
        nm(difference_mm[1])
    );
    assert!(found.noise_sigmas_mm.iter().all(|sigma| (sigma / NOISE_MM - 1.0).abs() < 0.2), "seed {seed}");
    Trial { form_mm, difference_mm, seams }
}

/// The form is as good as with known misplacements, its stated uncertainty is that which is found, and the steps at the
/// seams are inside their stated intervals.
fn check_trials(seeds: std::ops::RangeInclusive<u64>) {
    let nominal = nominal();
    let trials: Vec<Trial> = seeds.map(|seed| trial(&nominal, seed)).collect();
    let rms = |figure: &dyn Fn(&Trial) -> f64| {
        (trials.iter().map(|trial| figure(trial).powi(2)).sum::<f64>() / trials.len() as f64).sqrt()
    };
    let [stitched, known] = [0, 1].map(|k| rms(&|trial| trial.form_mm[k]));
    println!("form {:.2} nm, with known misplacements {:.2} nm", 1e6 * stitched, 1e6 * known);
    assert!(stitched <= 1.2 * known, "{stitched}, {known}");
    let ratio = rms(&|trial| trial.difference_mm[0]) / rms(&|trial| trial.difference_mm[1]);
    let [inside, all] = [0, 1].map(|k| trials.iter().map(|trial| trial.seams[k]).sum::<usize>());
    println!("difference / stated {ratio:.3}, seams inside {inside} of {all}");
    assert!((0.8..1.25).contains(&ratio), "{ratio}");
    assert!(100 * inside >= 91 * all, "{inside} of {all}");
}

#[test]
fn planted_misplacements_are_found() {
    check_trials(1..=6);
}

#[test]
#[ignore = "long: a hundred stitchings"]
fn hundred_stitchings_hold_their_intervals() {
    check_trials(1..=100);
}

fn maps(points: &[Vec<Point>]) -> Vec<MeasuredMap<'_>> {
    points.iter().map(|points| MeasuredMap { points, common_from_map: Pose::identity() }).collect()
}

/// Exact maps of the nominal surface without misplacement stay where they are.
#[test]
fn exact_maps_stay_in_place() {
    let nominal = nominal();
    let at = |i: usize, first: f64| first + 0.5 * i as f64;
    let map = |first: f64| {
        (0..900).map(move |k| (at(k % 30, first), at(k / 30, -7.0))).map(|(x, y)| Point::new(x, y, height(x, y)))
    };
    let points = [map(-14.0).collect::<Vec<_>>(), map(-4.2).collect()];
    let found = stitch(&nominal, &maps(&points), &options()).unwrap();
    let apart = found.common_from_map[0].inverse() * found.common_from_map[1];
    // Along the surface the overlap holds them less than across it.
    assert!(apart.log().amax() < 2e-5, "{:?}", apart.log());
    assert_eq!((found.seams.len(), found.seams[0].maps), (1, [0, 1]));
    assert!(found.seams[0].rms_mm < 1e-6 && found.noise_sigmas_mm[0] < 1e-6);
}

/// The same maps in another common frame, or in another order, give the same form.
#[test]
fn form_does_not_depend_on_frame_or_order() {
    let nominal = nominal();
    let measurement = measure(&mut StdRng::seed_from_u64(7), 25, 0.05, 3e-4);
    let first = stitched(&nominal, &measurement);
    let moved = Pose::exp(&Vector6::new(120.0, -40.0, 15.0, 0.1, -0.2, 0.4));
    let turned: Vec<MeasuredMap> =
        measurement.maps.iter().rev().map(|points| MeasuredMap { points, common_from_map: moved }).collect();
    let start = regrind_core::registration::Start::Pose(moved);
    let registration = RegistrationOptions { start, ..options().registration };
    let second = stitch(&nominal, &turned, &StitchingOptions { registration, ..options() }).unwrap();
    let count = measurement.maps[0].len();
    for (k, deviation) in first.whole.deviations.iter().enumerate() {
        let other = &second.whole.deviations[(8 - k / count) * count + k % count];
        assert!((deviation.deviation_mm - other.deviation_mm).abs() < 2e-8, "{k}");
    }
    for (a, b) in first.noise_sigmas_mm.iter().zip(second.noise_sigmas_mm.iter().rev()) {
        assert!((a / b - 1.0).abs() < 1e-3);
    }
}

#[test]
fn maps_that_cannot_be_stitched_are_refused() {
    let nominal = nominal();
    let measurement = measure(&mut StdRng::seed_from_u64(7), 15, 0.0, 0.0);
    let all = maps(&measurement.maps);
    let refused = |maps: &[MeasuredMap], options: StitchingOptions| stitch(&nominal, maps, &options).unwrap_err();
    assert_eq!(refused(&all[..1], options()), StitchingError::TooFewMaps { maps: 1 });
    let few = [all[0], MeasuredMap { points: &all[1].points[..29], ..all[1] }];
    assert_eq!(refused(&few, options()), StitchingError::TooFewPoints { map: 1, points: 29, min_points: 30 });
    // The first and the last map have only a corner in common.
    let apart = refused(&[all[0], all[1], all[8]], options());
    assert!(matches!(apart, StitchingError::NoOverlap { map: 2, .. }), "{apart}");
    for sigma_mm in [0.0, -1.0, f64::INFINITY] {
        let bad = StitchingOptions { placement_sigma_mm: sigma_mm, ..options() };
        assert_eq!(refused(&all, bad), StitchingError::PlacementSigma { sigma_mm });
    }
    let method = Method::SubtractRadius;
    let registration = RegistrationOptions { method, ..RegistrationOptions::new(1.0) };
    assert_eq!(refused(&all, StitchingOptions { registration, ..options() }), StitchingError::Method);
}

/// Rounding of noise that a whole row of points shares: the covariance grows.
#[test]
fn correlated_noise_widens_the_intervals() {
    let nominal = nominal();
    let mut random = StdRng::seed_from_u64(11);
    let mut measurement = measure(&mut random, 41, 0.05, 3e-4);
    let independent = stitched(&nominal, &measurement).correlation_factors[4];
    for points in &mut measurement.maps {
        // Blocks of 4 x 4 points with one error of 30 nm.
        let errors: Vec<f64> = (0..11 * 11).map(|_| 30e-6 * gaussian(&mut random)).collect();
        points.iter_mut().enumerate().for_each(|(k, p)| p.z += errors[k % 41 / 4 + 11 * (k / 41 / 4)]);
    }
    let correlated = stitched(&nominal, &measurement).correlation_factors[4];
    assert!(independent < 1.5 && correlated > 3.0, "{independent}, {correlated}");
}

/// Off-axis paraboloid of 44 x 44 mm: a turn about its parent's axis moves no deviation.
#[test]
fn undetermined_direction_stays_at_its_start() {
    let height = |x: f64, y: f64| ((x + 100.0) * (x + 100.0) + y * y) / 800.0 - 12.5 - 0.25 * x;
    let up = |x: f64, y: f64| Vector::new(-(x + 100.0) / 400.0 + 0.25, -y / 400.0, 1.0).normalize();
    let side = 181;
    let at = |k: usize| (k as f64 - 90.0) * 0.27;
    let places = || (0..side * side).map(|k| (at(k % side), at(k / side)));
    let points = places().map(|(x, y)| Point::new(x, y, height(x, y))).collect();
    let nominal =
        Nominal::from_grid_with_normals(side, side, points, places().map(|(x, y)| up(x, y)).collect()).unwrap();
    let mut random = StdRng::seed_from_u64(5);
    let points: Vec<Vec<Point>> = (0..9)
        .map(|k| {
            let centre = [STEP_MM * (f64::from(k % 3) - 1.0), STEP_MM * (f64::from(k / 3) - 1.0)];
            let at = |i: usize, c: usize| centre[c] + SIDE_MM * ((i as f64 + 0.5) / 31.0 - 0.5);
            (0..31 * 31)
                .map(|i| {
                    let (x, y) = (at(i % 31, 0), at(i / 31, 1));
                    Point::new(x, y, height(x, y)) + up(x, y) * (form(x, y) + NOISE_MM * gaussian(&mut random))
                })
                .collect()
        })
        .collect();
    let placed = StitchingOptions { placement_sigma_mm: 0.05, ..options() };
    let found = stitch(&nominal, &maps(&points), &placed).unwrap();
    assert!(found.noise_sigmas_mm.iter().all(|sigma| (sigma / NOISE_MM - 1.0).abs() < 0.2));
    assert!(found.seams.iter().all(|seam| seam.sigma_mm < 5e-6 && seam.sigma_mm > 1e-7));
    // The turn is known as well as the start poses only.
    let rotation = found.covariance[(5, 5)].sqrt() * 100.0;
    assert!(rotation > 0.005 && rotation < 0.5, "{rotation}");
}

/// Ten maps in a line, with errors of their places.
#[test]
fn chain_of_maps_settles() {
    let nominal = {
        let (columns, rows) = (421, 61);
        let at = |k: usize| ((k % columns) as f64 * 0.5 - 105.0, (k / columns) as f64 * 0.5 - 15.0);
        let places = || (0..columns * rows).map(at);
        let points = places().map(|(x, y)| Point::new(x, y, height(x / 4.0, y))).collect();
        let up = |(x, y): (f64, f64)| {
            let n = normal(x / 4.0, y);
            Vector::new(0.25 * n.x / n.z, n.y / n.z, 1.0).normalize()
        };
        Nominal::from_grid_with_normals(columns, rows, points, places().map(up).collect()).unwrap()
    };
    for (seed, noise_mm) in [(1, 10e-6), (2, 10e-6), (3, 100e-6)] {
        let mut random = StdRng::seed_from_u64(seed);
        let points: Vec<Vec<Point>> = (0..10)
            .map(|k| {
                let motion = Vector6::from_fn(|i, _| random.random_range(-1.0..1.0) * if i < 3 { 0.05 } else { 3e-4 });
                let truth = Pose::exp(&motion).inverse();
                let first = 19.0 * (f64::from(k) - 4.5);
                (0..41 * 21)
                    .map(|i| {
                        let (x, y) = (first + (i % 41) as f64 * 0.66 - 13.2, (i / 41) as f64 - 10.0);
                        let above = form(x / 4.0, y) + noise_mm * gaussian(&mut random);
                        let n = normal(x / 4.0, y);
                        let up = Vector::new(0.25 * n.x / n.z, n.y / n.z, 1.0).normalize();
                        truth.transform_point(&(Point::new(x, y, height(x / 4.0, y)) + up * above))
                    })
                    .collect()
            })
            .collect();
        let found = stitch(&nominal, &maps(&points), &options()).unwrap();
        assert_eq!(found.seams.len(), 9);
        assert!(found.noise_sigmas_mm.iter().all(|sigma| (sigma / noise_mm - 1.0).abs() < 0.35), "{seed}");
    }
}

/// A map of ten times the noise counts less, and its seams have wider intervals.
#[test]
fn noisy_map_has_wider_intervals() {
    let nominal = nominal();
    let mut random = StdRng::seed_from_u64(3);
    let mut measurement = measure(&mut random, 41, 0.05, 3e-4);
    for (p, [x, y]) in measurement.maps[0].iter_mut().zip(&measurement.places[0]) {
        *p += normal(*x, *y) * (1e-4 * gaussian(&mut random));
    }
    let found = stitched(&nominal, &measurement);
    assert!((found.noise_sigmas_mm[0] / 1e-4 - 1.0).abs() < 0.1, "{:?}", found.noise_sigmas_mm);
    assert!(found.noise_sigmas_mm[1..].iter().all(|sigma| (sigma / NOISE_MM - 1.0).abs() < 0.4));
    let sigma = |of_first: bool| {
        let seams = found.seams.iter().filter(|seam| (seam.maps[0] == 0) == of_first);
        seams.map(|seam| seam.sigma_mm).fold(0.0, f64::max)
    };
    assert!(sigma(true) > 3.0 * sigma(false));
}

/// Spikes on one point of a hundred, and a raised area of a map, do not move the maps.
#[test]
fn disagreeing_places_are_left_out() {
    let nominal = nominal();
    let clean = measure(&mut StdRng::seed_from_u64(4), 41, 0.05, 3e-4);
    let expected = stitched(&nominal, &clean);
    let mut spikes = measure(&mut StdRng::seed_from_u64(4), 41, 0.05, 3e-4);
    spikes.maps.iter_mut().for_each(|map| map.iter_mut().step_by(101).for_each(|p| p.z += 5e-3));
    let mut dirt = measure(&mut StdRng::seed_from_u64(4), 41, 0.05, 3e-4);
    for (p, [x, y]) in dirt.maps[4].iter_mut().zip(&dirt.places[4]) {
        p.z += if *x > 2.0 && *y > 0.0 { 3e-3 } else { 0.0 };
    }
    for (name, spoiled) in [("spikes", spikes), ("dirt", dirt)] {
        let found = stitched(&nominal, &spoiled);
        assert!(
            found.noise_sigmas_mm.iter().all(|sigma| *sigma < 1.3 * NOISE_MM),
            "{name}: {:?}",
            found.noise_sigmas_mm
        );
        for (k, (a, b)) in found.common_from_map.iter().zip(&expected.common_from_map).enumerate() {
            let [k0, k9] = [&found.common_from_map[0], &expected.common_from_map[0]];
            let (p, n) = (Point::new(5.0, 5.0, height(5.0, 5.0)), normal(5.0, 5.0));
            let step = (a.inverse() * *k0).transform_point(&p) - (b.inverse() * *k9).transform_point(&p);
            assert!(step.dot(&n).abs() < 15e-6, "{name}, {k}: {}", step.dot(&n));
        }
        let left_out: usize = found.seams.iter().map(|seam| seam.left_out).sum();
        assert_eq!(name == "dirt", left_out > 500, "{name}: {left_out}");
        assert_eq!(name == "dirt", found.whole.quality.warnings.iter().any(|warning| warning.contains("left out")));
    }
}

/// Locked directions show where the maps lie together, as the registration of one cloud does.
#[test]
fn locked_directions_keep_error_of_datum() {
    let nominal = nominal();
    let mut measurement = measure(&mut StdRng::seed_from_u64(9), 31, 0.0, 0.0);
    measurement.maps.iter_mut().flatten().for_each(|p| p.z += 0.01);
    let registration = RegistrationOptions {
        locked: [true; 6],
        start: regrind_core::registration::Start::Pose(Pose::identity()),
        ..options().registration
    };
    let found = stitch(&nominal, &maps(&measurement.maps), &StitchingOptions { registration, ..options() }).unwrap();
    let one = register(&nominal, &measurement.maps.concat(), &registration).unwrap();
    let mean = |of: &regrind_core::registration::Registration| {
        of.deviations.iter().map(|d| d.deviation_mm).sum::<f64>() / of.deviations.len() as f64
    };
    assert!((mean(&found.whole) - mean(&one)).abs() < 2e-7, "{} {}", mean(&found.whole), mean(&one));
}
