//! Detection of unexpected defects by chosen touches: a step, a scratch, a chip and a lump, planted on good parts.
//!
//! ```text
//! cargo run --release --example surprises [WORLDS [FIRST [LIMITS]]]
//! ```
//! The program plants one defect on each of WORLDS (200) parts of the shipped free-form recipe, from seed FIRST (1) on,
//! with limits that are LIMITS (1.0) times those of the recipe. It measures batch by batch until the stopping rule ends
//! the measurement. A defect counts as found if the map has at least half of it, or if every target is touched because
//! of it.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use regrind::cell::{PvPoints, Tolerance};
use regrind::drive::AdaptiveOptions;
use regrind::geometry::{Point, Pose, Vector};
use regrind::model::{FIRST_BATCH, MIN_TOUCHES, ModelInputs, PartialMeasurement, Reason, decide, farthest_points};
use regrind::registration::{RegistrationOptions, Start, register};
use regrind::surface::{Nominal, PlaneProjection};
use regrind_sim::Rng;
use regrind_sim::form::FormError;
use regrind_sim::probe::add_noise;
use regrind_sim::shape::{FreeForm, Shape};

const RADIUS_MM: f64 = 1.5;
const SCATTER_MM: f64 = 3e-4;
/// RMS and correlation length of the form that a good pass of the recipe leaves, in mm.
const FORM_MM: [f64; 2] = [4e-4, 15.0];
const HALF_MM: [f64; 2] = [50.5, 30.5];
const PATTERN: [usize; 2] = [60, 30];

/// Narrow defect of a part, raised or missing: position, orientation, size and height.
struct Surprise {
    at_mm: [f64; 2],
    turned_rad: f64,
    half_mm: [f64; 2],
    height_mm: f64,
}

impl Surprise {
    fn covers(&self, x: f64, y: f64) -> bool {
        let (sin, cos) = self.turned_rad.sin_cos();
        let [dx, dy] = [x - self.at_mm[0], y - self.at_mm[1]];
        (cos * dx + sin * dy).abs() <= self.half_mm[0] && (cos * dy - sin * dx).abs() <= self.half_mm[1]
    }
}

/// Function that plants a kind of defect from four numbers from 0 to 1.
type Planted = fn([f64; 4]) -> Surprise;

const KINDS: [(&str, Planted); 4] = [
    ("a step of 2 um over a tenth", |[u, v, ..]| Surprise {
        at_mm: [70.0 * (u - 0.5), 41.0 * (v - 0.5)],
        turned_rad: 0.0,
        half_mm: [15.8, 10.0],
        height_mm: 2e-3,
    }),
    ("a scratch of 1 x 60 mm, 2 um deep", |[u, v, turn, _]| Surprise {
        at_mm: [40.0 * (u - 0.5), 30.0 * (v - 0.5)],
        turned_rad: 0.8 * (turn - 0.5),
        half_mm: [30.0, 0.5],
        height_mm: -2e-3,
    }),
    ("a chip of 3 x 3 mm at the edge, 20 um deep", |[u, _, side, _]| Surprise {
        at_mm: [98.0 * (u - 0.5), if side < 0.5 { -29.0 } else { 29.0 }],
        turned_rad: 0.0,
        half_mm: [1.5, 1.5],
        height_mm: -2e-2,
    }),
    ("a lump of 1 x 1 mm, 20 um high", |[u, v, ..]| Surprise {
        at_mm: [98.0 * (u - 0.5), 58.0 * (v - 0.5)],
        turned_rad: 0.0,
        half_mm: [0.5, 0.5],
        height_mm: 2e-2,
    }),
];

/// Result of the measurement of one part.
struct PartResult {
    touches: usize,
    /// Targets of the pattern that the defect covers, and touches of them.
    covered: usize,
    hit: usize,
    found: bool,
    /// True if the part with the defect is within its limits; true if it was accepted although it is not.
    conforms: bool,
    is_wrong: bool,
}

fn main() {
    let number = |k: usize, otherwise: u64| std::env::args().nth(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let (worlds, first) = (number(1, 200), number(2, 1));
    let limits: f64 = std::env::args().nth(3).map_or(1.0, |times| times.parse().expect("a number"));
    let shape = FreeForm::default();
    let grid = shape.grid(2.0 * HALF_MM[0] + 6.0, 2.0 * HALF_MM[1] + 6.0, 409, 249);
    let nominal =
        Nominal::from_points(grid.into_iter().map(Point::from).collect(), PlaneProjection::Auto).expect("a surface");
    println!(
        "| planted | covers targets | touches | touched | found | found where touched | in tolerance with it | accepted wrongly |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for (name, planted) in KINDS {
        let of = |seed| measured(&shape, &nominal, planted, limits, seed);
        let all: Vec<PartResult> = (first..first + worlds).into_par_iter().map(of).collect();
        let share = |of: &dyn Fn(&PartResult) -> bool| {
            all.iter().filter(|seen| of(seen)).count() as f64 * 100.0 / worlds as f64
        };
        let mean =
            |of: &dyn Fn(&PartResult) -> usize| all.iter().map(|seen| of(seen) as f64).sum::<f64>() / worlds as f64;
        let (hit, found) = (share(&|seen| seen.hit > 0), share(&|seen| seen.found));
        let both = share(&|seen| seen.found && seen.hit > 0);
        println!(
            "| {name} | {:.1} | {:.0} | {hit:.1} % | {found:.1} % | {:.1} % | {:.1} % | {:.1} % |",
            mean(&|seen| seen.covered),
            mean(&|seen| seen.touches),
            100.0 * both / hit.max(f64::MIN_POSITIVE),
            share(&|seen| seen.conforms),
            share(&|seen| seen.is_wrong),
        );
    }
}

fn targets(shape: &FreeForm) -> Vec<(Point, Vector)> {
    let [columns, rows] = PATTERN;
    let at = |k: usize, count: usize, half: f64| half * (2.0 * k as f64 / (count - 1) as f64 - 1.0);
    let place = |k: usize| [at(k % columns, columns, HALF_MM[0]), at(k / columns, rows, HALF_MM[1])];
    let target = |[x, y]: [f64; 2]| {
        let [p, q] = shape.gradient(x, y);
        (Point::new(x, y, shape.height(x, y)), Vector::new(-p, -q, 1.0).normalize())
    };
    (0..columns * rows).map(place).map(target).collect()
}

/// Plants a defect, and measures batch by batch until the stopping rule ends the measurement.
fn measured(shape: &FreeForm, nominal: &Nominal, planted: Planted, limits: f64, seed: u64) -> PartResult {
    let mut rng = regrind_sim::rng(seed);
    let form = FormError::with_rms(&mut rng, FORM_MM[1], FORM_MM[0]);
    let surprise = planted(std::array::from_fn(|_| uniform(&mut rng)));
    let targets = targets(shape);
    let covers = |k: usize| surprise.covers(targets[k].0.x, targets[k].0.y);
    let centres: Vec<Point> = (0..targets.len())
        .map(|k| {
            let (at, normal) = targets[k];
            let extra_mm = if covers(k) { surprise.height_mm } else { 0.0 };
            let mut centre = [(at + (RADIUS_MM + form.height(at.x, at.y) + extra_mm) * normal).into()];
            add_noise(&mut rng, &mut centre, SCATTER_MM);
            Point::from(centre[0])
        })
        .collect();
    let tolerance = Tolerance {
        pv_mm: 7e-3 * limits,
        rms_mm: 1e-3 * limits,
        with_uncertainty: true,
        probability: Tolerance::DEFAULT_PROBABILITY,
        pv_points: PvPoints::MostPoints,
    };
    let adaptive = AdaptiveOptions { tolerance, accepted_risk: 0.025, max_measurements: 5 };
    let given = ModelInputs {
        decision_risk: adaptive.decision_risk(),
        probe_noise_mm: [SCATTER_MM, 0.15],
        ..ModelInputs::default()
    };
    let mut tried = vec![None; targets.len()];
    let mut touched: Vec<usize> = Vec::new();
    // As in a run: ten for the gates, then enough for a first stopping decision.
    let fewest = farthest_points(&targets, MIN_TOUCHES);
    let mut next = fewest[FIRST_BATCH..].to_vec();
    fewest[..FIRST_BATCH].iter().for_each(|&k| tried[k] = Some(0));
    touched.extend(&fewest[..FIRST_BATCH]);
    for batch in 1.. {
        next.iter().for_each(|&k| tried[k] = Some(batch));
        touched.extend(&next);
        let cloud: Vec<Point> = touched.iter().map(|&k| centres[k]).collect();
        let options =
            RegistrationOptions { start: Start::Pose(Pose::identity()), ..RegistrationOptions::new(RADIUS_MM) };
        let found = register(nominal, &cloud, &options).expect("a registration");
        let so_far = PartialMeasurement { targets: &targets, tried: &tried, touched: &touched };
        let decision = decide(&found, &given, &so_far, &adaptive.stopping_criteria(true), seed).expect("a model");
        if decision.next.is_empty() {
            let all: Vec<usize> = (0..targets.len()).filter(|&k| covers(k)).collect();
            let hit = touched.iter().filter(|&&k| covers(k)).count();
            // The defect as the whole pattern without noise would show it, and the part without it.
            let planted = after_best_fit(&targets, |k| if covers(k) { surprise.height_mm } else { 0.0 });
            let without = after_best_fit(&targets, |k| form.height(targets[k].0.x, targets[k].0.y));
            let mean = |of: &dyn Fn(usize) -> f64| all.iter().map(|&k| of(k)).sum::<f64>() / all.len().max(1) as f64;
            let told = mean(&|k| decision.form.points[k].form.mean_mm - without[k]) / mean(&|k| planted[k]);
            let whole = planted + without;
            let (rms_mm, pv_mm) = figures_mm(&whole);
            let conforms = rms_mm <= adaptive.tolerance.rms_mm && pv_mm <= adaptive.tolerance.pv_mm;
            let is_accepted = decision.reason == Reason::WithinLimits;
            return PartResult {
                touches: touched.len(),
                covered: all.len(),
                hit,
                found: decision.reason == Reason::AllTargetsTried || told > 0.5,
                conforms,
                is_wrong: is_accepted && !conforms,
            };
        }
        next = decision.next;
    }
    unreachable!()
}

/// Returns the RMS, and the PV without the outermost 0.1 % at either end.
fn figures_mm(form: &DVector<f64>) -> (f64, f64) {
    let mut sorted: Vec<f64> = form.iter().copied().collect();
    sorted.sort_by(f64::total_cmp);
    let (n, left_out) = (sorted.len(), sorted.len() / 1000);
    ((form.norm_squared() / n as f64).sqrt(), sorted[n - 1 - left_out] - sorted[left_out])
}

/// Returns the heights at all targets after their own best fit.
fn after_best_fit(targets: &[(Point, Vector)], height_mm: impl Fn(usize) -> f64) -> DVector<f64> {
    let motions = DMatrix::from_fn(targets.len(), 6, |r, c| {
        let (at, n) = targets[r];
        let arm = at.coords.cross(&n) / 50.0;
        [n.x, n.y, n.z, arm.x, arm.y, arm.z][c]
    });
    let base = motions.qr().q();
    let heights = DVector::from_fn(targets.len(), |k, _| height_mm(k));
    &heights - &base * base.tr_mul(&heights)
}

fn uniform(rng: &mut Rng) -> f64 {
    use rand::RngExt as _;
    rng.random::<f64>()
}
