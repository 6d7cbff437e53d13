//! Tests of the model on registered parts with a planted form.
//! The intervals of the form, of the figures and of the
//! pose of the nominal frame must cover the true values.

use nalgebra::{DMatrix, DVector, Matrix6, Vector6};
use rand::SeedableRng;
use rand::rngs::StdRng;
use regrind_testutils::sample::seeds;

use crate::common::{RADIUS_MM, centres, free_form, normal, placed, points, pose};
use regrind_core::form::{IsoFits, IsoFormValues, SlopeOperator};
use regrind_core::geometry::Pose;
use regrind_core::model::{AngleInterval, BudgetEntry, Form, MachineUncertainty, ModelInputs, UncertaintySource};
use regrind_core::registration::{
    Coordinate, Deviation, PointStatus, Registration, RegistrationOptions, Start, register,
};
use regrind_figures::{FormFigures, Interval};
use regrind_sim::form::FormError;
use regrind_sim::probe::Placement;
use regrind_sim::shape::{FreeForm, Shape};

const NOISE_MM: f64 = 3e-4;

/// Returns the number of parts that each test of intervals draws.
fn parts() -> u64 {
    seeds(8)
}

/// Returns the number of parts whose intervals of 95 % may miss by chance, scaled from the number for sixteen parts.
fn allowed_misses(of_sixteen: u64) -> u64 {
    parts() * of_sixteen / 16
}

struct Part {
    form: FormError,
    truth: Pose,
    registration: Registration,
    model: Form,
}

/// Numbers of columns and rows of the points: the maximum number that the model uses one by one, and fewer for the
/// tests that draw many parts, because the computing time grows with the cube of this number.
const MANY: [usize; 2] = [30, 20];
const FEWER: [usize; 2] = [24, 16];

/// Returns a part with a form of this RMS and a length of 30 mm, registered from a start at its true pose.
fn part(seed: u64, rms_mm: f64) -> Part {
    drifting(seed, rms_mm, 0.0, MANY)
}

/// Returns the same part with fewer points.
fn drawn_part(seed: u64, rms_mm: f64) -> Part {
    drifting(seed, rms_mm, 0.0, FEWER)
}

/// Returns the same part, measured with probe noise whose autocorrelation along the path is `drift`.
fn drifting(seed: u64, rms_mm: f64, drift: f64, counts: [usize; 2]) -> Part {
    let mut rng = StdRng::seed_from_u64(seed);
    let form = FormError::with_rms(&mut regrind_sim::rng(seed), 30.0, rms_mm);
    let placement = Placement::new([1.0, -2.0, 0.5], [0.3, -0.2, 0.5]);
    let mut all = placed(&placement, &centres(&FreeForm::default(), &form, [[-48.0, -28.0], [48.0, 28.0]], counts));
    let (mut off_mm, fresh_mm) = ([0.0; 3], NOISE_MM * (1.0 - drift * drift).sqrt());
    for centre in &mut all {
        off_mm = off_mm.map(|off| drift * off + fresh_mm * normal(&mut rng));
        centre.iter_mut().zip(off_mm).for_each(|(v, off)| *v += off);
    }
    let truth = pose(&placement);
    let options = RegistrationOptions { start: Start::Pose(truth), ..RegistrationOptions::new(RADIUS_MM) };
    let found = register(&free_form(409, 249), &points(&all), &options).unwrap();
    let model = Form::estimate(&found, &ModelInputs::default()).unwrap();
    Part { form, truth, registration: found, model }
}

impl Part {
    /// Returns the true form at the points, after its own best fit.
    fn form(&self) -> Vec<f64> {
        after_best_fit(&self.registration, |d| self.form.height(d.point.x, d.point.y))
    }

    /// Returns the squared error of the pose in units of a covariance, divided by the degrees of freedom.
    /// The result is 1 if the covariance is correct.
    fn pose_error(&self, covariance: &Matrix6<f64>) -> f64 {
        let twist = (self.truth.inverse() * self.registration.cmm_from_model).log();
        let off = Vector6::from_iterator(twist.iter().copied());
        (off.transpose() * covariance.try_inverse().unwrap() * off)[0] / 6.0
    }
}

/// Returns heights at the points of a registration, after their own best fit.
fn after_best_fit(found: &Registration, height_mm: impl Fn(&Deviation) -> f64) -> Vec<f64> {
    let form = DVector::from_iterator(found.deviations.len(), found.deviations.iter().map(height_mm));
    let motions = DMatrix::from_fn(form.len(), 6, |r, c| {
        let d = &found.deviations[r];
        let arm = d.point.coords.cross(&d.normal) / 30.0;
        [d.normal.x, d.normal.y, d.normal.z, arm.x, arm.y, arm.z][c]
    });
    let base = motions.qr().q();
    let left = &form - &base * base.tr_mul(&form);
    left.iter().copied().collect()
}

fn figures(of: &[f64]) -> [f64; 2] {
    let (low, high) = of.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
    [(of.iter().map(|v| v * v).sum::<f64>() / of.len() as f64).sqrt(), high - low]
}

fn contains(interval: Interval, value: f64) -> bool {
    (interval.low_mm..=interval.high_mm).contains(&value)
}

#[test]
fn thousand_samples_have_mean_and_sigma_of_points() {
    let part = drawn_part(0, 5e-3);
    let samples = Form::sample(&part.registration, &ModelInputs::default(), 1000).unwrap();
    assert_eq!(samples.shape(), (part.model.points.len(), 1000));
    for (row, point) in samples.row_iter().zip(&part.model.points) {
        assert!((row.mean() - point.form.mean_mm).abs() < 1e-12);
        let sigma_mm = (row.variance() * 1000.0 / 999.0).sqrt();
        assert!((sigma_mm / point.form.sigma_mm - 1.0).abs() < 1e-9);
    }
    let few = Form::sample(&part.registration, &ModelInputs::default(), 3).unwrap();
    assert_eq!(few.ncols(), 3);
}

#[test]
fn form_and_frame_intervals_cover_truth() {
    let (mut rms, mut pv, mut areas) = (0, 0, [0; 9]);
    let (mut frame, mut repeated) = (0.0, 0.0);
    for seed in 0..parts() {
        let part = drawn_part(seed, 5e-3);
        areas.iter_mut().zip(covered_area_figures(&part)).for_each(|(held, one)| *held += u64::from(one));
        let truth = part.form();
        let [true_rms, true_pv] = figures(&truth);
        rms += u64::from(contains(part.model.figures.rms, true_rms));
        pv += u64::from(contains(part.model.figures.pv, true_pv));
        frame += part.pose_error(&part.model.frame_covariance) / parts() as f64;
        repeated += part.pose_error(&part.registration.quality.covariance) / parts() as f64;
        assert_eq!(part.model.points.len(), truth.len());
        assert!(
            (part.model.hyperparameters.noise_sigma_mm / NOISE_MM - 1.0).abs() < 0.25,
            "seed {seed}: {:?}",
            part.model.hyperparameters
        );
    }
    println!(
        "of {} parts RMS held in {rms}, PV in {pv}; pose: chi2/6 {frame:.2} by the model, {repeated:.0} by white residuals",
        parts()
    );
    println!("slopes and ISO 10110-5 held in {areas:?}");
    assert!(rms + allowed_misses(3) >= parts() && pv + allowed_misses(3) >= parts(), "{rms} {pv}");
    assert!(areas.iter().all(|held| held + allowed_misses(4) >= parts()), "{areas:?}");
    assert!((0.4..2.0).contains(&frame), "{frame}");
    assert!(repeated > 20.0, "{repeated}");
}

/// Returns a form of polynomials up to the fourth degree, as clamps, weight and figuring cause it.
/// Its RMS has the magnitude of `rms_mm`.
fn bent(seed: u64, rms_mm: f64) -> impl Fn(f64, f64) -> f64 {
    let mut rng = StdRng::seed_from_u64(seed);
    let of: Vec<[f64; 3]> = (2..=4_i32)
        .flat_map(|whole| (0..=whole).map(move |b| [f64::from(whole - b), f64::from(b)]))
        .map(|[a, b]| [a, b, normal(&mut rng) * (2.0 * a + 1.0).sqrt() * (2.0 * b + 1.0).sqrt()])
        .collect();
    move |x, y| rms_mm * of.iter().map(|[a, b, by]| by * (x / 48.0).powf(*a) * (y / 28.0).powf(*b)).sum::<f64>()
}

#[test]
fn many_points_bound_polynomial_corners() {
    let (mut held, mut width_mm, mut all_mm) = (0, 0.0, 0.0);
    for seed in 0..parts() {
        let mut rng = StdRng::seed_from_u64(1000 + seed);
        let (form, shape) = (bent(seed, 1.5e-3), FreeForm::default());
        let at = |k: usize, n: usize, half: f64| half * (2.0 * k as f64 / (n - 1) as f64 - 1.0);
        let touched: Vec<[f64; 3]> = (0..1040)
            .map(|k| {
                let [x, y] = [at(k % 40, 40, 48.0), at(k / 40, 26, 28.0)];
                let (on, up) = (shape.point(x, y), shape.normal(x, y));
                std::array::from_fn(|k| on[k] + (RADIUS_MM + form(x, y)) * up[k] + NOISE_MM * normal(&mut rng))
            })
            .collect();
        let options =
            RegistrationOptions { start: Start::Pose(Pose::identity()), ..RegistrationOptions::new(RADIUS_MM) };
        let found = register(&free_form(409, 249), &points(&touched), &options).unwrap();
        let [_, pv_mm] = figures(&after_best_fit(&found, |d| form(d.point.x, d.point.y)));
        let pv = Form::estimate(&found, &ModelInputs::default()).unwrap().figures.pv;
        width_mm += pv.high_mm - pv.low_mm;
        all_mm += pv_mm;
        held += u64::from(contains(pv, pv_mm));
    }
    assert!(held + allowed_misses(2) >= parts(), "{held} of {}", parts());
    // By cosines alone, which are level at the edge, it would be a twentieth.
    assert!(width_mm < 0.033 * all_mm, "{width_mm} {all_mm}");
}

#[test]
#[ignore = "worlds are drawn, for .ci/long"]
fn autocorrelated_noise_is_not_form() {
    let (mut rms, mut pv, mut seen) = (0, 0, 0);
    for seed in 100..100 + parts() {
        let part = drifting(seed, 5e-3, 0.7, MANY);
        let [true_rms, true_pv] = figures(&part.form());
        rms += u64::from(contains(part.model.figures.rms, true_rms));
        pv += u64::from(contains(part.model.figures.pv, true_pv));
        seen += u64::from(part.model.hyperparameters.noise_autocorrelation > 0.4);
        // Points that come in no order tell nothing of a path.
        if seed == 100 {
            let mut shuffled = part.registration.clone();
            let n = shuffled.deviations.len();
            shuffled.deviations = (0..n).map(|k| part.registration.deviations[(k * 271) % n]).collect();
            assert_eq!(
                Form::estimate(&shuffled, &ModelInputs::default()).unwrap().hyperparameters.noise_autocorrelation,
                0.0
            );
        }
    }
    println!("of {} parts RMS held in {rms}, PV in {pv}; a drift was seen in {seen}", parts());
    let held =
        rms + allowed_misses(3) >= parts() && pv + allowed_misses(4) >= parts() && seen + allowed_misses(4) >= parts();
    assert!(held, "{rms} {pv} {seen}");
}

#[test]
fn form_as_small_as_noise() {
    let (mut rms, mut pv) = (0, 0);
    let mut raw = [0.0; 2];
    for seed in 0..parts() {
        let part = drawn_part(seed, NOISE_MM);
        let truth = figures(&part.form());
        let figures = part.model.figures;
        rms += u64::from(contains(figures.rms, truth[0]));
        pv += u64::from(contains(figures.pv, truth[1]));
        let verdict = &part.registration.quality;
        raw[0] += verdict.rms_mm / truth[0] / parts() as f64;
        raw[1] += verdict.pv_mm / truth[1] / parts() as f64;
    }
    println!("of {} parts RMS held in {rms}, PV in {pv}; of the points both are {raw:.2?} times too large", parts());
    assert!(rms + allowed_misses(3) >= parts() && pv + allowed_misses(4) >= parts(), "{rms} {pv}");
    assert!(raw[0] > 1.3 && raw[1] > 1.5, "{raw:?}");
}

/// Returns a part that was measured with a wrong radius, by a machine with errors of its scales and angles.
/// The errors are drawn from the stated uncertainties.
fn measured_by_machine(seed: u64, machine: &MachineUncertainty, radius_sigma_mm: f64) -> (FormError, Registration) {
    let mut rng = StdRng::seed_from_u64(seed);
    let form = FormError::with_rms(&mut regrind_sim::rng(seed), 30.0, 2e-3);
    let mut all = centres(&FreeForm::default(), &form, [[-48.0, -28.0], [48.0, 28.0]], [20, 13]);
    let [sx, sy, sz] = machine.scale.map(|of| of * normal(&mut rng));
    let [xy, xz, yz] = machine.squareness_rad.map(|of| of * normal(&mut rng));
    for centre in &mut all {
        let [x, y, z] = *centre;
        *centre = [x + sx * x + xy * y + xz * z, y + sy * y + yz * z, z + sz * z];
        centre.iter_mut().for_each(|v| *v += NOISE_MM * normal(&mut rng));
    }
    let stated_mm = RADIUS_MM + radius_sigma_mm * normal(&mut rng);
    let options = RegistrationOptions { start: Start::Pose(Pose::identity()), ..RegistrationOptions::new(stated_mm) };
    (form, register(&free_form(409, 249), &points(&all), &options).unwrap())
}

#[test]
fn machine_uncertainty_widens_form() {
    let machines = seeds(8);
    let machine = MachineUncertainty { scale: [2e-5; 3], squareness_rad: [2e-5; 3], ..MachineUncertainty::default() };
    let radius_sigma_mm = 3e-4;
    let given = ModelInputs { machine, radius_sigma_mm, ..ModelInputs::default() };
    let (mut with, mut without, mut wider) = (0, 0, 0.0);
    // An interval of 95 % misses one of twenty; 60 machines had 4 misses, all among the first 20.
    let allowed = (machines / 5).max(1);
    for seed in 0..machines {
        let (form, found) = measured_by_machine(seed, &machine, radius_sigma_mm);
        let model = Form::estimate(&found, &given).unwrap();
        let blind = Form::estimate(&found, &ModelInputs::default()).unwrap();
        let part = Part { form, truth: Pose::identity(), registration: found, model };
        let [true_rms, _] = figures(&part.form());
        with += u64::from(contains(part.model.figures.rms, true_rms));
        without += u64::from(contains(blind.figures.rms, true_rms));
        let width = |form: &Form| form.figures.rms.high_mm - form.figures.rms.low_mm;
        wider += width(&part.model) / width(&blind) / machines as f64;
        let squares = |of: fn(&BudgetEntry) -> f64| part.model.budget.iter().map(|s| of(s).powi(2)).sum::<f64>().sqrt();
        assert!((squares(|s| s.rms_mm) / part.model.figures.rms.standard_uncertainty_mm() - 1.0).abs() < 1e-9);
        let stated = |source| part.model.budget.iter().find(|s| s.source == source).unwrap().is_stated;
        assert!(
            stated(UncertaintySource::Scales) && stated(UncertaintySource::Radius) && !stated(UncertaintySource::Probe)
        );
    }
    println!(
        "of {machines} RMS held in {with} where it is stated, in {without} where it is not; {wider:.1} times as wide"
    );
    assert!(with + allowed >= machines && with > without && wider > 1.5, "{with} {without} {wider}");
}

/// Returns a part that the fixture holds with an offset in x, y and about z, drawn from the standard uncertainties.
/// The registration locks these directions and ignores the offset.
fn held_with_offset(seed: u64, datum: [f64; 6]) -> (FormError, Registration) {
    let mut rng = StdRng::seed_from_u64(seed);
    let form = FormError::with_rms(&mut regrind_sim::rng(seed), 30.0, 2e-3);
    let mut all = centres(&FreeForm::default(), &form, [[-48.0, -28.0], [48.0, 28.0]], [20, 13]);
    let [x_mm, y_mm, .., turn_rad] = datum.map(|of| of * normal(&mut rng));
    for centre in &mut all {
        let [x, y, _] = *centre;
        let by_mm = [x_mm - turn_rad * y, y_mm + turn_rad * x, 0.0];
        centre.iter_mut().zip(by_mm).for_each(|(v, by)| *v += by + NOISE_MM * normal(&mut rng));
    }
    let locked = Coordinate::locked_flags(&[Coordinate::X, Coordinate::Y, Coordinate::Rz]);
    let options =
        RegistrationOptions { start: Start::Pose(Pose::identity()), locked, ..RegistrationOptions::new(RADIUS_MM) };
    (form, register(&free_form(409, 249), &points(&all), &options).unwrap())
}

#[test]
fn fixture_uncertainty_widens_form() {
    let drawn = seeds(5);
    let datum = [5e-3, 5e-3, 0.0, 0.0, 0.0, 1e-4];
    let given = ModelInputs { locked_sigmas: Some(datum), ..ModelInputs::default() };
    let (mut with, mut without, mut wider) = ([0; 2], [0; 2], 0.0);
    for seed in 0..drawn {
        let (form, found) = held_with_offset(seed, datum);
        // The form beside the motions that the fixture leaves.
        let rows = &found.deviations;
        let form = DVector::from_iterator(rows.len(), rows.iter().map(|d| form.height(d.point.x, d.point.y)));
        let motions = DMatrix::from_fn(rows.len(), 3, |r, c| {
            let arm = rows[r].point.coords.cross(&rows[r].normal) / 30.0;
            [rows[r].normal.z, arm.x, arm.y][c]
        });
        let base = motions.qr().q();
        let truth = figures((&form - &base * base.tr_mul(&form)).as_slice());
        let [sure, blind] = [given, ModelInputs { locked_sigmas: Some([0.0; 6]), ..given }]
            .map(|of| Form::estimate(&found, &of).unwrap());
        for (held, told) in [(&mut with, &sure), (&mut without, &blind)] {
            held[0] += u32::from(contains(told.figures.rms, truth[0]));
            held[1] += u32::from(contains(told.figures.pv, truth[1]));
        }
        let width = |form: &Form| form.figures.rms.high_mm - form.figures.rms.low_mm;
        wider += width(&sure) / width(&blind) / drawn as f64;
        let share = |form: &Form| *form.budget.iter().find(|s| s.source == UncertaintySource::Datum).unwrap();
        assert!(share(&sure).is_stated && share(&sure).rms_mm > 0.0);
        assert!(!share(&blind).is_stated && share(&blind).rms_mm == 0.0);
    }
    println!(
        "of {drawn} RMS and PV held in {with:?} where it is stated, in {without:?} where it is not; {wider:.1} times as wide"
    );
    assert!(
        with.iter().all(|held| held + 1 + drawn as u32 / 12 >= drawn as u32) && without[0] < with[0] && wider > 1.5,
        "{with:?} {without:?} {wider}"
    );
}

/// Returns two registrations of a part.
/// A machine with errors corrected the part until its own measurement was good.
/// The first registration is the measurement of this machine, the second is the true part.
fn corrected_by_machine(seed: u64, machine: &MachineUncertainty, datum: [f64; 6]) -> (Registration, Registration) {
    let mut rng = StdRng::seed_from_u64(seed);
    let seen = FormError::with_rms(&mut regrind_sim::rng(seed), 30.0, 1e-3);
    let looks = centres(&FreeForm::default(), &seen, [[-48.0, -28.0], [48.0, 28.0]], [20, 13]);
    let scale = machine.scale.map(|of| of * normal(&mut rng));
    let [x_mm, y_mm, .., turn_rad] = datum.map(|of| of * normal(&mut rng));
    let is = looks.iter().map(|&[x, y, z]| {
        let [x, y, z] = [x * (1.0 - scale[0]), y * (1.0 - scale[1]), z * (1.0 - scale[2])];
        [x - x_mm + turn_rad * y, y - y_mm - turn_rad * x, z]
    });
    let is: Vec<[f64; 3]> = is.collect();
    let looks: Vec<[f64; 3]> = looks.iter().map(|of| of.map(|v| v + NOISE_MM * normal(&mut rng))).collect();
    let held = if datum == [0.0; 6] {
        [false; 6]
    } else {
        Coordinate::locked_flags(&[Coordinate::X, Coordinate::Y, Coordinate::Rz])
    };
    let options = RegistrationOptions {
        start: Start::Pose(Pose::identity()),
        locked: held,
        ..RegistrationOptions::new(RADIUS_MM)
    };
    let [looks, is] = [looks, is].map(|all| register(&free_form(409, 249), &points(&all), &options).unwrap());
    (looks, is)
}

#[test]
#[ignore = "worlds are drawn, for .ci/long"]
fn corrected_part_includes_machine_error() {
    let drawn = seeds(4);
    let scaled = MachineUncertainty { scale: [5e-5; 3], ..MachineUncertainty::default() };
    for (machine, datum) in [(scaled, [0.0; 6]), (MachineUncertainty::default(), [5e-3, 5e-3, 0.0, 0.0, 0.0, 1e-4])] {
        let (mut with, mut without) = ([0; 2], [0; 2]);
        for seed in 0..drawn {
            let (looks, is) = corrected_by_machine(seed, &machine, datum);
            let truth = figures(&is.deviations.iter().map(|d| d.deviation_mm).collect::<Vec<_>>());
            let first = ModelInputs { machine, locked_sigmas: Some(datum), ..ModelInputs::default() };
            let [sure, blind] =
                [ModelInputs { is_corrected: true, ..first }, first].map(|of| Form::estimate(&looks, &of).unwrap());
            for (held, told) in [(&mut with, &sure), (&mut without, &blind)] {
                held[0] += u32::from(contains(told.figures.rms, truth[0]));
                held[1] += u32::from(contains(told.figures.pv, truth[1]));
            }
            let squares = |of: fn(&BudgetEntry) -> f64| sure.budget.iter().map(|s| of(s).powi(2)).sum::<f64>().sqrt();
            assert!((squares(|s| s.rms_mm) / sure.figures.rms.standard_uncertainty_mm() - 1.0).abs() < 1e-9);
        }
        println!(
            "of {drawn} RMS and PV held in {with:?} of the corrected part, in {without:?} as if it were the first look"
        );
        assert!(
            with.iter().all(|held| held + 1 + drawn as u32 / 6 >= drawn as u32) && without[0] < with[0],
            "{with:?} {without:?}"
        );
    }
}

#[test]
fn no_fixture_entry_without_lock() {
    let part = part(3, 5e-3);
    assert!(part.model.budget.iter().all(|share| share.source != UncertaintySource::Datum));
    assert_eq!(part.model.budget.len(), UncertaintySource::ALL.len() - 1);
}

#[test]
fn form_refuses_bad_uncertainty() {
    let part = part(3, 5e-3);
    for wrong in [-1e-3, f64::NAN, 1e9] {
        for machine in [
            MachineUncertainty { probe_mm: wrong, ..MachineUncertainty::default() },
            MachineUncertainty { squareness_rad: [0.0, wrong, 0.0], ..MachineUncertainty::default() },
        ] {
            let error = Form::estimate(&part.registration, &ModelInputs { machine, ..ModelInputs::default() })
                .unwrap_err()
                .to_string();
            assert!(error.contains("standard uncertainty") && error.contains(&wrong.to_string()), "{error}");
        }
        let given = ModelInputs { locked_sigmas: Some([0.0, wrong, 0.0, 0.0, 0.0, 0.0]), ..ModelInputs::default() };
        let error = Form::estimate(&part.registration, &given).unwrap_err().to_string();
        assert!(error.contains("pose of the fixture") && error.contains(&wrong.to_string()), "{error}");
    }
}

#[test]
fn radius_uncertainty_widens_form() {
    let (part, with_form) = (part(3, 1e-9), part(3, 5e-3));
    let given = ModelInputs { radius_sigma_mm: 2e-2, ..ModelInputs::default() };
    let doubted = Form::estimate(&part.registration, &given).unwrap();
    let [z, z_doubted] = [&part.model, &doubted].map(|form| form.frame_covariance[(2, 2)].sqrt());
    assert!((z_doubted / 2e-2 - 1.0).abs() < 0.2 && z < 3e-4, "{z} {z_doubted}");
    // A wrong radius would show in points that have no form; in a form it may hide.
    let [sure, doubted] = [ModelInputs::default(), given]
        .map(|given| Form::estimate(&with_form.registration, &given).unwrap().figures.rms);
    let width = |of: Interval| of.high_mm - of.low_mm;
    println!("RMS {:.2} times as wide beside an unknown radius", width(doubted) / width(sure));
    assert!(width(doubted) > 2.0 * width(sure), "{sure:?} {doubted:?}");
}

#[test]
fn figures_of_formless_part_exclude_noise() {
    let part = part(1, 1e-9);
    let raw = figures(&part.registration.deviations.iter().map(|d| d.deviation_mm).collect::<Vec<_>>());
    let told = part.model.figures;
    println!("raw rms {:.2e} pv {:.2e}; {told:?}", raw[0], raw[1]);
    assert!(told.rms.high_mm < 0.6 * raw[0] && told.pv.high_mm < 0.6 * raw[1], "{told:?} {raw:?}");
    assert!(!part.model.is_detected && told.rms.low_mm == 0.0 && told.pv.low_mm == 0.0, "{told:?}");
}

/// Returns the true figures of an area: the figures of the planted form at the points.
fn area_figures(part: &Part) -> (IsoFormValues, [f64; 2]) {
    let places: Vec<[f64; 2]> = part.registration.deviations.iter().map(|d| [d.point.x, d.point.y]).collect();
    let slope = part.model.slope.unwrap();
    let slopes = SlopeOperator::new(&places, Some(slope.integration_mm)).unwrap();
    assert_eq!((slopes.integration_mm, slopes.nodes), (slope.integration_mm, slope.places));
    (IsoFits::new(&places, None).unwrap().evaluate(&part.form()), slopes.evaluate(&part.form()))
}

/// Returns for each figure of an area whether its interval covers the truth: ISO 10110-5 from the power on, and slopes.
fn covered_area_figures(part: &Part) -> [bool; 9] {
    let (iso, slopes) = area_figures(part);
    let (told, slope) = (part.model.iso.unwrap(), part.model.slope.unwrap());
    [
        contains(told.power, iso.power_mm),
        contains(told.power_rim, iso.power_rim_mm),
        contains(told.irregularity, iso.irregularity_mm),
        contains(told.symmetric, iso.symmetric_mm),
        contains(told.rms_total, iso.rms_total_mm),
        contains(told.rms_irregularity, iso.rms_irregularity_mm),
        contains(told.rms_varying, iso.rms_varying_mm),
        contains_angle(slope.rms, slopes[0]),
        contains_angle(slope.max, slopes[1]),
    ]
}

fn contains_angle(of: AngleInterval, value: f64) -> bool {
    (of.low_rad..=of.high_rad).contains(&value)
}

#[test]
fn formless_part_has_upper_bounds_only() {
    let part = part(1, 1e-9);
    let (told, slope) = (part.model.iso.unwrap(), part.model.slope.unwrap());
    let (iso, slopes) = area_figures(&part);
    for (of, truth_mm) in [
        (told.power, iso.power_mm),
        (told.irregularity, iso.irregularity_mm),
        (told.symmetric, iso.symmetric_mm),
        (told.rms_total, iso.rms_total_mm),
        (told.rms_irregularity, iso.rms_irregularity_mm),
        (told.rms_varying, iso.rms_varying_mm),
    ] {
        assert!(of.low_mm == 0.0 && of.high_mm > truth_mm, "{of:?} {truth_mm}");
    }
    assert!(slope.rms.low_rad == 0.0 && slope.max.low_rad == 0.0 && slope.rms.high_rad > slopes[0], "{slope:?}");
    // The scatter of the probe is off them.
    let raw: Vec<f64> = part.registration.deviations.iter().map(|d| d.deviation_mm).collect();
    let places: Vec<[f64; 2]> = part.registration.deviations.iter().map(|d| [d.point.x, d.point.y]).collect();
    let raw_iso = IsoFits::new(&places, None).unwrap().evaluate(&raw);
    let raw_slopes = SlopeOperator::new(&places, Some(slope.integration_mm)).unwrap().evaluate(&raw);
    assert!(told.irregularity.high_mm < 0.6 * raw_iso.irregularity_mm, "{told:?} {raw_iso:?}");
    assert!(slope.rms.high_rad < 0.8 * raw_slopes[0], "{slope:?} {raw_slopes:?}");
}

#[test]
fn few_points_give_no_area_figures() {
    let mut part = part(2, 5e-3);
    for (k, deviation) in part.registration.deviations.iter_mut().enumerate() {
        if k % 43 != 0 {
            deviation.status = PointStatus::Outlier;
        }
    }
    let told = Form::estimate(&part.registration, &ModelInputs::default()).unwrap();
    assert_eq!(told.points.len(), 14);
    assert!(told.slope.is_none() && told.iso.is_some());
    for (k, deviation) in part.registration.deviations.iter_mut().enumerate() {
        deviation.status = if k % 60 == 7 { PointStatus::Inlier } else { PointStatus::Outlier };
    }
    let told = Form::estimate(&part.registration, &ModelInputs::default()).unwrap();
    assert!(told.slope.is_none() && told.iso.is_none());
}

/// Checks a probe with less noise than the deviations show. The remainder is form.
/// Between the points, the form is no larger than at the points.
#[test]
fn no_extra_form_between_points() {
    let given = ModelInputs { probe_noise_mm: [0.5 * NOISE_MM, 0.1], ..ModelInputs::default() };
    for seed in 0..2 {
        let part = part(seed, 5e-3);
        let FormFigures { pv, pv_998: pv_most_points, .. } =
            Form::estimate(&part.registration, &given).unwrap().figures;
        println!("seed {seed}: touched up to {:.2e}, the aperture up to {:.2e} mm", pv.high_mm, pv_most_points.high_mm);
        assert!(pv_most_points.high_mm < 1.2 * pv.high_mm && pv_most_points.low_mm >= pv.low_mm, "{pv_most_points:?}");
    }
}

/// Checks a probe noise that is one fifth too small by chance, because a sphere has only about twenty points.
/// This difference is not sufficient evidence of form.
#[test]
fn sphere_noise_by_chance_is_not_form() {
    let low_mm = |part: &Part, share: f64| {
        let given = ModelInputs { probe_noise_mm: [share * NOISE_MM, 0.15], ..ModelInputs::default() };
        Form::estimate(&part.registration, &given).unwrap().figures.rms.low_mm
    };
    let (parts, mut told) = (seeds(3), 0.0);
    for seed in 0..parts {
        let part = drawn_part(seed, 1e-3);
        let [unstated_mm, chance_mm, form_mm] = [part.model.figures.rms.low_mm, low_mm(&part, 0.8), low_mm(&part, 0.4)];
        println!("seed {seed}: from below {unstated_mm:.3e}, {chance_mm:.3e}, {form_mm:.3e} mm");
        // A probe is known to scatter far less: the rest is form.
        assert!(form_mm > 1.04 * unstated_mm, "{form_mm} {unstated_mm}");
        told += (chance_mm - unstated_mm) / (form_mm - unstated_mm) / parts as f64;
    }
    assert!(told < 0.09, "{told}");
}

/// Checks 16 points with 10 degrees of freedom, which cannot separate form from noise.
/// The upper bound then covers the form of the whole part, and the planted form before the pose absorbs a share of it.
#[test]
fn few_points_upper_bound_covers_form() {
    let (mut held, parts) = (0, parts());
    for seed in 0..parts {
        let mut part = drawn_part(seed, 1e-3);
        let planted: Vec<f64> =
            part.registration.deviations.iter().map(|d| part.form.height(d.point.x, d.point.y)).collect();
        let [true_mm, planted_mm] = [figures(&part.form()), figures(&planted)].map(|[rms_mm, _]| rms_mm);
        for (k, deviation) in part.registration.deviations.iter_mut().enumerate() {
            deviation.status = if k % 24 == 11 { PointStatus::Inlier } else { PointStatus::Outlier };
        }
        let few = Form::estimate(&part.registration, &ModelInputs::default()).unwrap();
        assert!(few.is_underdetermined && few.degrees_of_freedom == 10.0, "{}", few.degrees_of_freedom);
        let sphere = ModelInputs { probe_noise_mm: [NOISE_MM, 0.15], ..ModelInputs::default() };
        let by_sphere = Form::estimate(&part.registration, &sphere).unwrap();
        assert!(!by_sphere.is_underdetermined && by_sphere.figures.rms.high_mm < few.figures.rms.high_mm);
        println!(
            "seed {seed}: {:.2e} mm, in truth {true_mm:.2e} over the part, {planted_mm:.2e} planted",
            few.figures.rms.high_mm
        );
        held += u64::from(few.figures.rms.high_mm >= true_mm.max(planted_mm));
        assert!(!part.model.is_underdetermined);
    }
    assert!(held + allowed_misses(2) >= parts, "{held} of {parts}");
}

/// Checks registrations that leave the pose no free direction, or deviations of exactly 0, or both. The form then has
/// figures, and the frame has no variance and no value that is not a number.
#[test]
fn form_without_free_motions() {
    const ALL: [Coordinate; 6] =
        [Coordinate::X, Coordinate::Y, Coordinate::Z, Coordinate::Rx, Coordinate::Ry, Coordinate::Rz];
    let form = FormError::with_rms(&mut regrind_sim::rng(3), 30.0, 1e-3);
    let nominal = free_form(109, 69);
    for counts in [[4, 4], [12, 8]] {
        let measured = points(&centres(&FreeForm::default(), &form, [[-40.0, -25.0], [40.0, 25.0]], counts));
        for locks in [&ALL[..], &ALL[1..], &ALL[..1]] {
            let locked = Coordinate::locked_flags(locks);
            let options = RegistrationOptions {
                start: Start::Pose(Pose::identity()),
                locked,
                ..RegistrationOptions::new(RADIUS_MM)
            };
            let found = register(&nominal, &measured, &options).unwrap();
            let mut zero = found.clone();
            zero.deviations.iter_mut().for_each(|deviation| deviation.deviation_mm = 0.0);
            let mut settled = zero.clone();
            settled.quality.covariance = Matrix6::zeros();
            for (is_zero, registration) in [(false, found), (true, zero), (true, settled)] {
                let form = Form::estimate(&registration, &ModelInputs::default()).unwrap();
                let places: Vec<_> = registration.deviations.iter().map(|d| (d.point, d.normal)).collect();
                let at_places = Form::estimate_at(&registration, &ModelInputs::default(), &places).unwrap();
                let figures = [form.figures, at_places.figures];
                for of in figures.iter().flat_map(|FormFigures { rms, pv, pv_998, .. }| [rms, pv, pv_998]) {
                    assert!(0.0 <= of.low_mm && of.low_mm <= of.median_mm && of.median_mm <= of.high_mm, "{of:?}");
                    assert!(!is_zero || of.high_mm < 1e-12, "{of:?}");
                }
                let variances = form.frame_covariance.diagonal();
                assert!(variances.iter().all(|variance| *variance >= 0.0), "{locks:?}: {variances}");
                assert!(locks.len() < 6 || variances.iter().all(|variance| *variance == 0.0), "{variances}");
            }
        }
    }
}

#[test]
fn figures_independent_of_threads() {
    let form = FormError::with_rms(&mut regrind_sim::rng(7), 30.0, 1e-3);
    let placement = Placement::new([1.0, -2.0, 0.5], [0.3, -0.2, 0.5]);
    // Enough points that the sums are made of several blocks.
    let centres = centres(&FreeForm::default(), &form, [[-48.0, -28.0], [48.0, 28.0]], [80, 65]);
    let options = RegistrationOptions { start: Start::Pose(pose(&placement)), ..RegistrationOptions::new(RADIUS_MM) };
    let found = register(&free_form(409, 249), &points(&placed(&placement, &centres)), &options).unwrap();
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| Form::estimate(&found, &ModelInputs::default()).unwrap())
    };
    let bits = |form: &Form| {
        let FormFigures { rms, pv, pv_998: pv_most_points, .. } = form.figures;
        [rms, pv, pv_most_points].map(|of| [of.low_mm, of.median_mm, of.high_mm].map(f64::to_bits))
    };
    let [one, three] = [1, 3].map(|threads| bits(&on(threads)));
    assert_eq!(one, three);
}
