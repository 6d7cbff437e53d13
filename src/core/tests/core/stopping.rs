//! Where to touch next and whether to touch on, held against planted parts.

use rand::SeedableRng;
use rand::rngs::StdRng;
use regrind_testutils::sample::seeds;

use crate::common::{RADIUS_MM, free_form, normal, placed, points, pose};
use regrind_core::geometry::{Point, Vector};
use regrind_core::model::{
    FIRST_BATCH, Form, MAX_BATCHES, MIN_TOUCHES, ModelInputs, PartialMeasurement, Reason, StoppingCriteria,
    StoppingDecision, decide, farthest_points, short_tour,
};
use regrind_core::registration::{Registration, RegistrationOptions, Start, register};
use regrind_figures::{FormFigures, Interval};
use regrind_sim::form::FormError;
use regrind_sim::probe::Placement;
use regrind_sim::shape::{FreeForm, Shape};

const NOISE_MM: f64 = 3e-4;
const STRICT: StoppingCriteria = StoppingCriteria {
    pv_mm: f64::INFINITY,
    pv_998_mm: 1e-4,
    rms_mm: 1e-4,
    correction_sigma_mm: 5e-4,
    may_grind: true,
};
const LOOSE: StoppingCriteria = StoppingCriteria { pv_998_mm: 1.0, rms_mm: 1.0, ..STRICT };

/// A part with something on it that is no smooth form, and its pattern of 36 by 22 targets.
struct Part {
    form: FormError,
    extra: Box<dyn Fn(f64, f64) -> f64>,
    targets: Vec<(Point, Vector)>,
    seed: u64,
}

impl Part {
    fn new(seed: u64, rms_mm: f64, extra: impl Fn(f64, f64) -> f64 + 'static) -> Self {
        let shape = FreeForm::default();
        let places = (0..36 * 22).map(|k| [f64::from(k % 36) / 35.0, f64::from(k / 36) / 21.0]);
        let targets = places.map(|[u, v]| [96.0 * u - 48.0, 56.0 * v - 28.0]).map(|[x, y]| {
            let [p, q] = shape.gradient(x, y);
            (Point::new(x, y, shape.height(x, y)), Vector::new(-p, -q, 1.0).normalize())
        });
        let form = FormError::with_rms(&mut regrind_sim::rng(seed), 30.0, rms_mm);
        Self { form, extra: Box::new(extra), targets: targets.collect(), seed }
    }

    fn smooth(seed: u64, rms_mm: f64) -> Self {
        Self::new(seed, rms_mm, |_, _| 0.0)
    }

    fn height_mm(&self, target: usize) -> f64 {
        let at = self.targets[target].0;
        self.form.height(at.x, at.y) + (self.extra)(at.x, at.y)
    }

    /// Touches some targets; every touch of a target scatters alike, whichever batch it is in.
    fn measured(&self, touched: &[usize]) -> Registration {
        let placement = Placement::new([1.0, -2.0, 0.5], [0.3, -0.2, 0.5]);
        let centre = |&k: &usize| {
            let mut rng = StdRng::seed_from_u64(self.seed ^ ((k as u64) << 20));
            let (at, n) = self.targets[k];
            let c = at + (RADIUS_MM + self.height_mm(k)) * n;
            [c.x, c.y, c.z].map(|v| v + NOISE_MM * normal(&mut rng))
        };
        let centres: Vec<[f64; 3]> = touched.iter().map(centre).collect();
        let options =
            RegistrationOptions { start: Start::Pose(pose(&placement)), ..RegistrationOptions::new(RADIUS_MM) };
        register(&free_form(205, 125), &points(&placed(&placement, &centres)), &options).unwrap()
    }

    /// Touches in two batches, and looks.
    fn decide(&self, first: &[usize], last: &[usize], purpose: &StoppingCriteria) -> StoppingDecision {
        let touched = [first, last].concat();
        let mut tried = vec![None; self.targets.len()];
        first.iter().for_each(|&k| tried[k] = Some(0));
        last.iter().for_each(|&k| tried[k] = Some(1));
        let so_far = PartialMeasurement { targets: &self.targets, tried: &tried, touched: &touched };
        decide(&self.measured(&touched), &inputs(), &so_far, purpose, 1).unwrap()
    }

    fn form(&self, touched: &[usize]) -> Form {
        Form::estimate_at(&self.measured(touched), &inputs(), &self.targets).unwrap()
    }

    /// The true form at all targets after its own best fit: RMS and PV.
    fn truth(&self) -> [f64; 2] {
        let rows = nalgebra::DMatrix::from_fn(self.targets.len(), 6, |r, c| {
            let (at, n) = self.targets[r];
            let arm = at.coords.cross(&n) / 30.0;
            [n.x, n.y, n.z, arm.x, arm.y, arm.z][c]
        });
        let form = nalgebra::DVector::from_fn(self.targets.len(), |r, _| self.height_mm(r));
        let base = rows.qr().q();
        let left = &form - &base * base.tr_mul(&form);
        [(left.norm_squared() / left.len() as f64).sqrt(), left.max() - left.min()]
    }
}

fn inputs() -> ModelInputs {
    ModelInputs { probe_noise_mm: [NOISE_MM, 0.15], ..ModelInputs::default() }
}

/// Some targets, far apart, in two batches.
fn two_far_batches(part: &Part, count: usize) -> (Vec<usize>, Vec<usize>) {
    let mut all = farthest_points(&part.targets, count);
    let last = all.split_off(count / 2);
    (all, last)
}

fn contains(interval: Interval, value: f64) -> bool {
    (interval.low_mm..=interval.high_mm).contains(&value)
}

#[test]
fn form_between_points_covers_truth() {
    let parts = seeds(5);
    let touches = std::env::var("REGRIND_TOUCHES").map_or(70, |touches| touches.parse().unwrap());
    let (mut rms, mut pv, mut width) = (0, 0, [0.0; 2]);
    for seed in 0..parts {
        let part = Part::smooth(seed, 5e-3);
        let (first, last) = two_far_batches(&part, touches);
        let form = part.form(&[first, last].concat());
        let truth = part.truth();
        rms += u32::from(contains(form.figures.rms, truth[0]));
        pv += u32::from(contains(form.figures.pv, truth[1]));
        width[0] += (form.figures.rms.high_mm - form.figures.rms.low_mm) / truth[0] / parts as f64;
        width[1] += (form.figures.pv.high_mm - form.figures.pv.low_mm) / truth[1] / parts as f64;
        assert_eq!(form.points.len(), part.targets.len());
    }
    println!(
        "of {parts} parts with {touches} touches RMS held in {rms}, PV in {pv}; intervals are {width:.2?} of them wide"
    );
    let max_missed = 1 + parts as u32 / 7;
    assert!(rms + max_missed >= parts as u32 && pv + max_missed >= parts as u32, "{rms} {pv}");
    assert!(width[0] < 0.5 && width[1] < 0.6, "{width:?}");
}

#[test]
fn figures_include_fine_ridges() {
    // Ridges of 0.5 um that no touch can tell from the scatter of a probe, and a probe that scatters by as much by
    // itself.
    let rough = Part::new(3, 1e-9, |x, y| 5e-4 * (f64::sin(9.1 * x) * f64::cos(7.7 * y)).signum());
    let (first, last) = two_far_batches(&rough, 120);
    let told = rough.form(&[first.clone(), last.clone()].concat()).figures;
    // PV 99.8 % leaves out the outermost one at either end of a thousand places that were not touched.
    let many = rough.targets.repeat(1500_usize.div_ceil(rough.targets.len()));
    let FormFigures { pv, pv_998: pv_most_points, .. } =
        Form::estimate_at(&rough.measured(&[first.clone(), last.clone()].concat()), &inputs(), &many).unwrap().figures;
    assert!(
        pv_most_points.median_mm < pv.median_mm && pv_most_points.high_mm < pv.high_mm,
        "{pv_most_points:?} {pv:?}"
    );
    assert_eq!(told.pv_998, told.pv);
    let [rms, _] = rough.truth();
    assert!(told.rms.high_mm > rms && told.rms.median_mm > 0.7 * rms, "{told:?} {rms}");
    // Also where every target is touched, and what is narrow is left of the touches themselves.
    let all: Vec<usize> = (0..rough.targets.len()).collect();
    let whole = rough.measured(&all);
    let of_whole = Form::estimate(&whole, &inputs()).unwrap().figures.rms;
    assert!(contains(of_whole, rms), "{of_whole:?} {rms}");
    let smooth = Part::smooth(3, 1e-9);
    let of_smooth = smooth.form(&[first, last].concat()).figures;
    assert!(of_smooth.rms.median_mm < 0.4 * told.rms.median_mm, "{of_smooth:?}");
}

#[test]
fn stopping_gives_each_reason() {
    let part = Part::smooth(5, 5e-3);
    let (first, last) = two_far_batches(&part, 30);
    let few = part.decide(&first, &last, &LOOSE);
    assert_eq!((few.reason, few.next.len()), (Reason::TooFewTouches, MIN_TOUCHES - 30));
    let (first, last) = two_far_batches(&part, 60);
    let within = part.decide(&first, &last, &LOOSE);
    assert!(within.reason == Reason::WithinLimits && within.next.is_empty(), "{:?}", within.reason);
    let known = part.decide(&first, &last, &StoppingCriteria { correction_sigma_mm: 0.1, ..STRICT });
    assert!(known.reason == Reason::FormKnown && known.next.is_empty(), "{:?}", known.reason);
    let unknown = part.decide(&first, &last, &StoppingCriteria { correction_sigma_mm: 1e-7, ..STRICT });
    assert_eq!((unknown.reason, unknown.next.len()), (Reason::FormUnknown, 30));
    let between = StoppingCriteria { rms_mm: unknown.form.figures.rms.median_mm, pv_998_mm: 1.0, ..STRICT };
    assert_eq!(part.decide(&first, &last, &between).reason, Reason::Undecided);
    let all: Vec<usize> = (0..part.targets.len()).collect();
    assert_eq!(part.decide(&all[..400], &all[400..], &STRICT).reason, Reason::AllTargetsTried);
}

#[test]
fn stopping_beyond_without_pass_left() {
    let part = Part::smooth(5, 5e-3);
    let (first, last) = two_far_batches(&part, 60);
    let over = part.decide(&first, &last, &StoppingCriteria { correction_sigma_mm: 1e-7, may_grind: false, ..STRICT });
    assert!(over.reason == Reason::BeyondLimit && over.next.is_empty(), "{:?}", over.reason);
}

#[test]
fn stopping_risk_of_repeated_tests() {
    let part = Part::smooth(5, 5e-3);
    let (first, last) = two_far_batches(&part, 150);
    let form = part.decide(&first, &last, &LOOSE).form;
    let (rms, bounds) = (form.figures.rms, form.bounds.rms);
    let between = |rms_mm| StoppingCriteria { rms_mm, correction_sigma_mm: 0.1, ..LOOSE };
    // Within with 97.5 %, by which a run judges, and not with 99.5 %, by which it looks.
    assert_eq!(part.decide(&first, &last, &between(0.5 * (rms.high_mm + bounds.high_mm))).reason, Reason::Undecided);
    assert_eq!(part.decide(&first, &last, &between(0.5 * (rms.median_mm + rms.high_mm))).reason, Reason::FormKnown);
    assert_eq!(part.decide(&first, &last, &between(1.001 * bounds.high_mm)).reason, Reason::WithinLimits);
}

#[test]
fn stopping_prefers_pass_after_a_sixth() {
    let part = Part::smooth(5, 5e-3);
    let never = StoppingCriteria { correction_sigma_mm: 1e-7, ..STRICT };
    let reason = |count, purpose: &StoppingCriteria| {
        let (first, last) = two_far_batches(&part, count);
        part.decide(&first, &last, purpose).reason
    };
    assert_eq!(reason(part.targets.len() / 6 - 2, &never), Reason::FormUnknown);
    assert_eq!(reason(part.targets.len() / 6, &never), Reason::CorrectionPreferred);
    assert_eq!(reason(part.targets.len() / 6, &StoppingCriteria { may_grind: false, ..never }), Reason::BeyondLimit);
}

#[test]
fn stopping_after_max_batches() {
    let part = Part::smooth(6, 5e-3);
    let touched = farthest_points(&part.targets, 60);
    let looked = |last: u32| {
        let mut tried = vec![None; part.targets.len()];
        touched.iter().for_each(|&k| tried[k] = Some(0));
        tried[touched[0]] = Some(last);
        let so_far = PartialMeasurement { targets: &part.targets, tried: &tried, touched: &touched };
        decide(
            &part.measured(&touched),
            &inputs(),
            &so_far,
            &StoppingCriteria { correction_sigma_mm: 1e-7, ..STRICT },
            1,
        )
        .unwrap()
    };
    assert_ne!(looked(MAX_BATCHES - 2).reason, Reason::MaxBatchesReached);
    let late = looked(MAX_BATCHES - 1);
    assert_eq!((late.reason, late.next.len()), (Reason::MaxBatchesReached, part.targets.len() - 60));
}

#[test]
fn next_batch_lowers_variance() {
    let part = Part::smooth(6, 5e-3);
    // All touches in one half.
    let half: Vec<usize> = (0..part.targets.len()).filter(|k| part.targets[*k].0.x < 0.0).collect();
    let left: Vec<(Point, Vector)> = half.iter().map(|&k| part.targets[k]).collect();
    let touched: Vec<usize> = farthest_points(&left, 60).into_iter().map(|k| half[k]).collect();
    let decision = part.decide(&touched[..30], &touched[30..], &STRICT);
    assert!(decision.next.iter().all(|k| !touched.contains(k)), "{:?}", decision.next);
    let right = decision.next.iter().filter(|&&k| part.targets[k].0.x > 0.0).count();
    assert!(5 * right > 4 * decision.next.len(), "{right} of {}", decision.next.len());
    let known = |next: &[usize]| part.form(&[&touched, next].concat()).rms_smooth_sigma_mm;
    let anywhere: Vec<usize> =
        (0..part.targets.len()).filter(|k| !touched.contains(k)).step_by(25).take(decision.next.len()).collect();
    let [chosen_mm, anywhere_mm] = [known(&decision.next), known(&anywhere)];
    println!("known to {:.2} um, and to {:.2} um by as many anywhere", 1e3 * chosen_mm, 1e3 * anywhere_mm);
    assert!(chosen_mm < anywhere_mm, "{chosen_mm} {anywhere_mm}");
    // The same is asked for again.
    assert_eq!(part.decide(&touched[..30], &touched[30..], &STRICT).next, decision.next);
}

#[test]
fn dust_is_outlier_after_neighbours() {
    let at = Part::smooth(7, 1e-3).targets[300].0;
    let part = Part::new(7, 1e-3, move |x, y| if (x - at.x).hypot(y - at.y) < 1.0 { 0.03 } else { 0.0 });
    let (mut first, last) = two_far_batches(&part, 80);
    first.push(300);
    let seen = part.decide(&first, &last, &LOOSE);
    assert_eq!(seen.reason, Reason::UnconfirmedOutlier);
    let near = |k: &&usize| (part.targets[**k].0 - at).norm() < 6.0;
    let around: Vec<usize> = seen.next.iter().filter(near).copied().collect();
    assert!(around.len() >= 4, "{around:?}");
    let again = part.decide(&[&first[..], &last].concat(), &seen.next, &LOOSE);
    assert_eq!(again.reason, Reason::WithinLimits, "alone among its neighbours it is dust");
}

#[test]
fn chip_at_edge_is_not_dust() {
    let corner = Part::smooth(8, 1e-3).targets[0].0;
    let part = Part::new(8, 1e-3, move |x, y| if (x - corner.x).hypot(y - corner.y) < 6.0 { -0.05 } else { 0.0 });
    // The corner is among those that lie farthest apart; its neighbours come next.
    let (first, last) = two_far_batches(&part, 80);
    let seen = part.decide(&first, &last, &LOOSE);
    assert_eq!(seen.reason, Reason::UnconfirmedOutlier);
    let again = part.decide(&[&first[..], &last].concat(), &seen.next, &LOOSE);
    let told = again.form.figures.pv;
    println!("{:?}: {told:?}", again.reason);
    // Touches that agree with each other are form, however deep; those that do not are a feature of which nobody knows
    // the edge.
    assert!(
        again.reason == Reason::NarrowFeature && again.next.len() + 80 + seen.next.len() == part.targets.len()
            || told.low_mm > 0.03
    );
    let deep = StoppingCriteria { pv_998_mm: 0.02, rms_mm: 1.0, ..STRICT };
    assert_ne!(part.decide(&[&first[..], &last].concat(), &seen.next, &deep).reason, Reason::WithinLimits);
}

#[test]
fn surprising_batch_adds_another() {
    // Smooth where the first touches are, and a wave of 4 um where the last are.
    let part = Part::new(9, 1e-3, |x, y| if x > 10.0 { 4e-3 * (0.9 * x).sin() * (0.8 * y).cos() } else { 0.0 });
    let [left, right]: [Vec<usize>; 2] = [false, true]
        .map(|on_right| (0..part.targets.len()).filter(|&k| (part.targets[k].0.x > 10.0) == on_right).collect());
    let some = |of: &[usize], count: usize| -> Vec<usize> { of.iter().step_by(of.len() / count).copied().collect() };
    let decision = part.decide(&some(&left, 100), &some(&right, 30), &LOOSE);
    assert!(
        matches!(decision.reason, Reason::LargeInnovations | Reason::UnconfirmedOutlier | Reason::NarrowFeature),
        "{:?}",
        decision.reason
    );
    assert!(!decision.next.is_empty());
}

#[test]
fn first_batch_is_spread_with_short_tour() {
    let part = Part::smooth(1, 1e-3);
    let chosen = farthest_points(&part.targets, FIRST_BATCH);
    let least = |of: &[usize]| {
        let pairs = of.iter().flat_map(|a| of.iter().map(move |b| (*a, *b))).filter(|(a, b)| a < b);
        pairs.map(|(a, b)| (part.targets[a].0 - part.targets[b].0).norm()).fold(f64::INFINITY, f64::min)
    };
    assert!(least(&chosen) > 20.0, "{}", least(&chosen));
    let many = farthest_points(&part.targets, 60);
    let way = short_tour(&part.targets, many.clone());
    let long = |of: &[usize]| of.windows(2).map(|p| (part.targets[p[0]].0 - part.targets[p[1]].0).norm()).sum::<f64>();
    let [mut sorted, mut wanted] = [way.clone(), many.clone()];
    sorted.sort_unstable();
    wanted.sort_unstable();
    assert!(sorted == wanted && long(&way) < 0.4 * long(&many), "{} of {}", long(&way), long(&many));
    assert!(short_tour(&part.targets, Vec::new()).is_empty() && farthest_points(&[], 4).is_empty());
    assert_eq!((short_tour(&part.targets, vec![7]), farthest_points(&part.targets[..3], 10).len()), (vec![7], 3));
}
