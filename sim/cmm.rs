//! Measuring machine: the part has a placement of its own in it, and the ball touches the real surface exactly.
//!
//! A target gives a point and a normal in the machine's frame, where the client assumes the part to be. The ball moves
//! down that line, and stops where it touches the part with its real position and surface: misplaced, shifted a little
//! at every loading, expanded by its temperature, and with its ground form. The true radius of the ball is the stated
//! radius plus an error. The machine reports the centre of the ball at that moment, with
//!
//! * noise: Gaussian, independent on each axis of the machine,
//! * outliers: a share of the points, moved by up to the given size in any direction (dust, a false trigger) and
//!   reported as good,
//! * points not found: a share of the touches that the probe head misses.
//!
//! A ball that touches before the search begins backs off, and the machine reports "not reached". After too many of
//! these, the machine stops with fault 2, because the part is then far from its planned position. The part's rim is not
//! modelled: beyond the aperture, nothing is found. A target beyond the travel is refused before anything moves.

use std::sync::{Arc, Mutex};

use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};

use crate::body::{Kind, Payload, Payloads, Physics, Progress, Refusal, ResultData};
use crate::machine_spec::{CmmSpec, REFERENCE_C};
use crate::part::{Approach, Contact, touch_sphere};
use crate::payload::{BROKEN, Feature, INTERLOCK, Plan, PointRecord, Status, Target, encode_points, outside};
use crate::probe::Placement;
use crate::spec::WorldFaults;
use crate::truth::{Source, WorldState, empty_result, locked, stream};
use crate::vector::{distance, length};
use crate::{Rng, Vec3};

/// Millimetres per count of scaled points: a nanometre.
pub const COUNT_MM: f64 = 1e-6;

impl CmmSpec {
    /// Returns the thermal expansion of the part as a ratio without unit: the size of the part at its temperature,
    /// divided by its size at the reference temperature of the drawing.
    fn growth(&self) -> f64 {
        1.0 + self.cte_per_k * (self.part_temperature_c - REFERENCE_C)
    }

    /// Checks that the probe can reach every position of a plan.
    ///
    /// # Errors
    /// A position is outside the travel of the machine.
    fn check_travel(&self, plan: &Plan) -> Result<(), Refusal> {
        let highest = plan.targets.iter().map(|t| t.point_mm[2]).fold(f64::NEG_INFINITY, f64::max);
        let travel_mm = highest + plan.safe_height_mm;
        let (least, most) = (self.min_travel_mm, self.max_travel_mm);
        let check = |name: &str, value: f64, axis: usize| {
            if (least[axis]..=most[axis]).contains(&value) {
                return Ok(());
            }
            Err(outside(name, value, &format!("{} to {}", least[axis], most[axis])))
        };
        check("height of the travel in mm", travel_mm, 2)?;
        for target in &plan.targets {
            let way = approach_to(target, plan, plan.probe_radius_mm);
            for t in [way.from_mm, way.to_mm] {
                for axis in 0..3 {
                    let value = way.point_mm[axis] + t * way.direction[axis];
                    check(&format!("coordinate {axis} of the way to target {} in mm", target.index), value, axis)?;
                }
            }
        }
        Ok(())
    }
}

/// Returns the straight path on which the centre of the probe ball approaches `target`, in the machine's frame. The
/// path follows the normal of `target`, from the start of the search to its end. `radius_mm` is the true radius of the
/// ball.
///
/// The machine does not know the true radius. The distances of the start and the end from the target are therefore
/// computed with the radius stated in `plan`.
fn approach_to(target: &Target, plan: &Plan, radius_mm: f64) -> Approach {
    Approach {
        point_mm: target.point_mm,
        direction: target.normal,
        radius_mm,
        from_mm: plan.approach_mm + plan.probe_radius_mm,
        to_mm: plan.probe_radius_mm - plan.search_mm,
    }
}

/// Prepared or running measurement.
struct Run {
    plan: Plan,
    placement: Placement,
    records: Vec<PointRecord>,
    /// Number of unexpected touches so far.
    unexpected: u32,
    fault: u16,
    elapsed_s: f64,
    /// Time in s, from the begin of the job, at which the touch of each target is finished.
    due_s: Vec<f64>,
    noise: Rng,
    outliers: Rng,
    not_found: Rng,
}

impl Run {
    fn new(plan: Plan) -> Self {
        let rng = || crate::rng(0);
        let (noise, outliers, not_found) = (rng(), rng(), rng());
        let placement = Placement::IDENTITY;
        Self {
            plan,
            placement,
            records: Vec::new(),
            unexpected: 0,
            fault: 0,
            elapsed_s: 0.0,
            due_s: Vec::new(),
            noise,
            outliers,
            not_found,
        }
    }

    fn begin(&mut self, state: &mut WorldState) {
        state.measurements_begun += 1;
        self.placement = state.load_on_table();
        self.due_s = Self::due_s(&self.plan, &state.spec.cmm);
        let draw = |source| stream(state.spec.seed, source, state.measurements_begun);
        self.noise = draw(Source::Noise);
        self.outliers = draw(Source::Outliers);
        self.not_found = draw(Source::NotFound);
    }

    /// Returns, for each target of `plan`, the time in s from the start of the job to the end of the touch of this
    /// target. The times include the travel between targets.
    ///
    /// `plan.careful` can set a slower speed for a number of targets at the start of the plan. The duration of each of
    /// these touches is multiplied by the ratio of the normal speed to the slower speed.
    fn due_s(plan: &Plan, spec: &CmmSpec) -> Vec<f64> {
        let (slowly, speed_mm_s) = plan.careful;
        let each_s = |k: usize| {
            let slower = if k < slowly as usize { plan.speed_mm_s / speed_mm_s } else { 1.0 };
            slower * spec.seconds_per_point
        };
        let travel_mm = |k: usize| {
            let [from, to] = [k.max(1) - 1, k].map(|k| plan.targets[k].point_mm);
            distance(from, to)
        };
        let mut at_s = 0.0;
        let due = |k: usize| {
            at_s += each_s(k) + travel_mm(k) / spec.travel_mm_s;
            at_s
        };
        (0..plan.targets.len()).map(due).collect()
    }

    fn finished(&self) -> bool {
        self.records.len() == self.plan.targets.len()
    }

    /// Returns the points measured so far, as the result data that the machine sends.
    fn to_result(&self, state: &WorldState) -> ResultData {
        let (spec, faults) = (&state.spec.cmm, &state.spec.faults);
        let scale = spec.scaled_points.then_some(COUNT_MM);
        ResultData {
            kind: 4,
            format: if spec.scaled_points { 2 } else { 1 },
            bytes: encode_points(&self.records, scale),
            records: self.records.len() as u32,
            coordinates: if faults.returns_contact_points && faults.contact_points_declared { 2 } else { 1 },
            probe_radius_mm: self.plan.probe_radius_mm,
            scale_mm: scale.unwrap_or(1.0),
            temperature_c: spec.part_temperature_c,
            duration_s: self.elapsed_s.min(self.due_s.last().copied().unwrap_or(0.0)),
        }
    }

    /// Touches one target, and returns the record of the point with the position in mm. The position includes the
    /// noise, outliers and configured faults of the machine. If there is no contact, the status in the record gives the
    /// reason, and the position is zero.
    fn measure(&mut self, state: &WorldState, target: &Target) -> PointRecord {
        let spec = &state.spec.cmm;
        let shift = self.disturbance(spec);
        let missed = self.not_found.random::<f64>() < spec.not_found_share;
        let touched = match self.contact(state, target) {
            Contact::Unexpected => Err(Status::NotReached),
            Contact::Missed => Err(Status::NotFound),
            Contact::Touched { .. } if missed => Err(Status::NotFound),
            Contact::Touched { centre_mm, .. } => Ok(std::array::from_fn(|i| centre_mm[i] + shift[i])),
        };
        match touched {
            Ok(centre_mm) => {
                let position_mm = reported(&state.spec.faults, target, self.plan.probe_radius_mm, centre_mm);
                PointRecord { index: target.index, status: Status::Touched, quality: 0, position_mm }
            }
            Err(status) => {
                self.unexpected += u32::from(status == Status::NotReached);
                untouched(target, status)
            }
        }
    }

    /// Computes where the probe ball touches `target`, without noise. The returned ball centre is in the machine's
    /// frame, in mm. Returns `Contact::Missed` if there is no contact, and `Contact::Unexpected` if the ball touches
    /// before the search begins.
    fn contact(&self, state: &WorldState, target: &Target) -> Contact {
        let spec = &state.spec.cmm;
        let in_machine = approach_to(target, &self.plan, self.plan.probe_radius_mm + 1e-3 * spec.probe_radius_error_um);
        if target.feature == Feature::ReferenceSphere {
            return touch_sphere(spec.sphere_centre_mm, spec.sphere_radius_mm, &in_machine);
        }
        if state.spec.faults.no_part {
            return Contact::Missed;
        }
        // Contact of the expanded part with the ball equals contact of the part at drawing size with a ball reduced by
        // the same ratio.
        let growth = spec.growth();
        let in_part = Approach {
            point_mm: self.placement.apply_inverse(in_machine.point_mm).map(|c| c / growth),
            direction: self.placement.turned_back(in_machine.direction),
            radius_mm: in_machine.radius_mm / growth,
            from_mm: in_machine.from_mm / growth,
            to_mm: in_machine.to_mm / growth,
        };
        match state.part.touch(&in_part) {
            Contact::Touched { centre_mm, contact_mm: foot_mm } => {
                Contact::Touched { centre_mm: self.placement.apply(centre_mm.map(|c| c * growth)), contact_mm: foot_mm }
            }
            other => other,
        }
    }

    /// Draws the random error of one touch, as a vector in mm. The error is Gaussian noise, and in some touches also an
    /// outlier (a large error in a random direction). Every call draws the same number of random numbers, so an outlier
    /// does not change the errors of later touches.
    fn disturbance(&mut self, spec: &CmmSpec) -> Vec3 {
        let normal = |rng: &mut Rng| -> f64 { StandardNormal.sample(rng) };
        let noise: Vec3 = std::array::from_fn(|_| 1e-3 * spec.noise_um * normal(&mut self.noise));
        let is_outlier = self.outliers.random::<f64>() < spec.outlier_share;
        let size_mm = 1e-3 * spec.outlier_um * self.outliers.random::<f64>();
        let direction: Vec3 = std::array::from_fn(|_| normal(&mut self.outliers));
        let norm = length(direction);
        if !is_outlier || norm == 0.0 {
            return noise;
        }
        std::array::from_fn(|i| noise[i] + size_mm * direction[i] / norm)
    }
}

fn untouched(target: &Target, status: Status) -> PointRecord {
    PointRecord { index: target.index, status, quality: 100, position_mm: [0.0; 3] }
}

/// Returns the position that the machine reports for a touch of `target` with the ball's centre at `centre_mm`. Without
/// faults, this is `centre_mm`. Configured `faults` change the position in three ways:
///
/// - The contact point is reported instead of the centre. This point is `stated_radius_mm` below the centre, along the
///   normal of `target`.
/// - The unit is the inch instead of the millimetre.
/// - The sign of y is reversed.
fn reported(faults: &WorldFaults, target: &Target, stated_radius_mm: f64, centre_mm: Vec3) -> Vec3 {
    let back = if faults.returns_contact_points { stated_radius_mm } else { 0.0 };
    let unit = if faults.inches { 25.4 } else { 1.0 };
    let sign = if faults.cmm_mirrored { [1.0, -1.0, 1.0] } else { [1.0; 3] };
    std::array::from_fn(|i| sign[i] * (centre_mm[i] - back * target.normal[i]) / unit)
}

/// Measuring machine of a world.
pub struct Cmm {
    world: Arc<Mutex<WorldState>>,
    ready: Option<Run>,
    running: Option<Run>,
}

impl Cmm {
    pub(crate) fn new(world: Arc<Mutex<WorldState>>) -> Self {
        Self { world, ready: None, running: None }
    }
}

/// Result of a touch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TouchResult {
    /// The ball touched; its centre.
    Centre(Vec3),
    /// The ball met nothing.
    Missed,
    /// The ball touched before the search began, or the part is not there.
    Unexpected,
}

/// Probe of the measuring machine, controlled touch by touch by a server that has no plan.
pub struct TouchProbe {
    world: Arc<Mutex<WorldState>>,
    run: Option<Run>,
}

impl TouchProbe {
    pub(crate) fn new(world: Arc<Mutex<WorldState>>) -> Self {
        Self { world, run: None }
    }

    /// Returns the two opposite corners of the travel volume, in mm in the machine's frame: first the minimum x, y, z,
    /// then the maximum x, y, z.
    pub fn volume_mm(&self) -> [Vec3; 2] {
        let spec = &locked(&self.world).spec.cmm;
        [spec.min_travel_mm, spec.max_travel_mm]
    }

    /// Returns the speed of travel, in mm/s.
    pub fn travel_mm_s(&self) -> f64 {
        locked(&self.world).spec.cmm.travel_mm_s
    }

    /// Returns the duration of a touch, in s.
    pub fn seconds_per_point(&self) -> f64 {
        locked(&self.world).spec.cmm.seconds_per_point
    }

    /// Touches the part or the reference sphere at the target `point_mm` with the outward unit normal `normal`, both in
    /// the machine's frame. The ball moves against the normal. The array holds the radius of the probe, the approach
    /// distance and the search distance, in mm.
    ///
    /// Returns `TouchResult::Centre` with the centre of the ball in mm. Returns `TouchResult::Missed` if the ball finds
    /// no surface. Returns `TouchResult::Unexpected` if the ball touches before the search begins, if the part is in
    /// the grinder, or if the state of the part is unknown.
    ///
    /// If the part has left the CMM since the last touch, this touch begins a new measurement with a new random
    /// placement.
    pub fn touch(
        &mut self,
        point_mm: Vec3,
        normal: Vec3,
        [probe_radius_mm, approach_mm, search_mm]: [f64; 3],
    ) -> TouchResult {
        let mut state = locked(&self.world);
        if state.part_unknown || !state.claim_part(Kind::Cmm) {
            return TouchResult::Unexpected;
        }
        let feature = feature(&state.spec.cmm, point_mm);
        let target = Target { index: 0, feature, point_mm, normal };
        let (speed_mm_s, safe_height_mm, careful) = (1.0, 0.0, (0, 0.0));
        let plan = Plan {
            probe_radius_mm,
            approach_mm,
            search_mm,
            speed_mm_s,
            safe_height_mm,
            careful,
            targets: vec![target],
        };
        let goes_on = state.on_table;
        let mut run = match self.run.take() {
            Some(run) if goes_on => Run { plan, ..run },
            _ => {
                let mut run = Run::new(plan);
                run.begin(&mut state);
                run
            }
        };
        let record = run.measure(&state, &target);
        self.run = Some(run);
        match record.status {
            Status::Touched => TouchResult::Centre(record.position_mm),
            Status::NotFound => TouchResult::Missed,
            Status::NotReached => TouchResult::Unexpected,
        }
    }

    /// Moves the probe clear of the part, so that the grinder can take the part.
    pub fn release_part(&mut self) {
        locked(&self.world).release(Kind::Cmm);
    }
}

/// Returns the feature to which the point `point_mm` belongs. The feature is the reference sphere if the point is less
/// than half a sphere radius from the sphere's surface. Otherwise the feature is the part.
fn feature(spec: &CmmSpec, point_mm: Vec3) -> Feature {
    let away_mm = distance(point_mm, spec.sphere_centre_mm);
    if (away_mm - spec.sphere_radius_mm).abs() < 0.5 * spec.sphere_radius_mm {
        Feature::ReferenceSphere
    } else {
        Feature::Part
    }
}

fn progress(run: &Run) -> Progress {
    Progress {
        done: run.records.len() as u32,
        total: run.plan.targets.len() as u32,
        finished: run.finished(),
        fault: run.fault,
    }
}

impl Physics for Cmm {
    fn kind(&self) -> Kind {
        Kind::Cmm
    }

    fn name(&self) -> String {
        "SIMULATED CMM 1".to_owned()
    }

    fn check(&self, kind: u16, payload: &Payload) -> Result<(), Refusal> {
        if kind != 1 {
            return Err(Refusal { answer: BROKEN, reason: format!("a CMM does not accept payloads of kind {kind}") });
        }
        let plan = Plan::decode(&payload.bytes)?;
        locked(&self.world).spec.cmm.check_travel(&plan)
    }

    fn prepare(&mut self, _job: u32, _cycle: u16, payloads: &Payloads) -> Result<Progress, Refusal> {
        self.ready = None;
        let missing = || Refusal { answer: BROKEN, reason: "there is no plan".to_owned() };
        let plan = Plan::decode(&payloads.plan.as_ref().ok_or_else(missing)?.bytes)?;
        let state = locked(&self.world);
        state.spec.cmm.check_travel(&plan)?;
        if state.is_held_by_other(Kind::Cmm) {
            return Err(Refusal { answer: INTERLOCK, reason: "the part is in the grinder".to_owned() });
        }
        let run = Run::new(plan);
        let first = progress(&run);
        self.ready = Some(run);
        Ok(first)
    }

    fn begin(&mut self) {
        let Some(mut run) = self.ready.take() else { return };
        let mut state = locked(&self.world);
        if state.claim_part(Kind::Cmm) {
            run.begin(&mut state);
            self.running = Some(run);
        }
    }

    fn advance(&mut self, seconds: f64) -> Progress {
        let mut state = locked(&self.world);
        let Some(run) = self.running.as_mut() else {
            // Nothing was begun: the other machine has the part.
            return Progress { done: 0, total: 0, finished: false, fault: 1 };
        };
        if seconds > 0.0 && seconds.is_finite() {
            run.elapsed_s += seconds;
        }
        state.engaged = Some(Kind::Cmm);
        let most = state.spec.cmm.max_unexpected_touches;
        while run.fault == 0 && run.due_s.get(run.records.len()).is_some_and(|due_s| *due_s <= run.elapsed_s) {
            let target = run.plan.targets[run.records.len()];
            let record = run.measure(&state, &target);
            run.records.push(record);
            if run.unexpected > most {
                run.fault = 2;
            }
        }
        if run.finished() || run.fault != 0 {
            state.disengage(Kind::Cmm);
        }
        progress(run)
    }

    fn retract(&mut self) {
        locked(&self.world).disengage(Kind::Cmm);
    }

    fn has_partial_result(&self) -> bool {
        true
    }

    fn partial_result(&self) -> Option<ResultData> {
        let run = self.running.as_ref()?;
        Some(run.to_result(&locked(&self.world)))
    }

    fn end_job(&mut self, _result: u16) -> ResultData {
        let mut state = locked(&self.world);
        self.ready = None;
        let Some(mut run) = self.running.take() else { return empty_result(state.spec.cmm.part_temperature_c) };
        state.release(Kind::Cmm);
        let faults = &state.spec.faults;
        let rest = run.plan.targets[run.records.len()..].iter();
        run.records.extend(rest.map(|target| untouched(target, Status::NotReached)));
        let kept = run.records.len().saturating_sub(faults.missing_records as usize);
        run.records.truncate(kept);
        if let (true, Some(record)) = (faults.non_finite_point, run.records.get_mut(kept / 2)) {
            record.position_mm[0] = f64::NAN;
        }
        let outcome = run.to_result(&state);
        state.heat *= (-outcome.duration_s / state.spec.grinder.thermal_tau_s).exp();
        outcome
    }

    fn interlocks(&self) -> u16 {
        locked(&self.world).interlocks(Kind::Cmm)
    }

    fn temperature_c(&self) -> f64 {
        locked(&self.world).spec.cmm.part_temperature_c
    }
}

impl Drop for Cmm {
    /// Releases the part when this CMM object is destroyed. The grinder can then take the part.
    fn drop(&mut self) {
        locked(&self.world).release(Kind::Cmm);
    }
}
