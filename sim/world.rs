//! A grinding cell's truth: one table says what is wrong with everything in it, one seed draws the rest.
//!
//! [`World`] hands out the two machines as [`Body`](crate::body::Body) and answers, to tests alone, what no controller may ask: where the
//! part really lies, how far its surface really stands from the nominal, and what the grinder really did.
//!
//! Grinder and measuring machine share the part. From the beginning of a job to its end (`outcome`) the part is with
//! that machine, and the other one finds its clamp empty (interlock bit 2) and refuses to prepare with answer 9. A machine is
//! clear (bit 1) while it has not begun, has finished, or has been retracted.
//!
//! Every random number has a stream of its own, by what it is for and how often that has been drawn, so that one more
//! source of error changes no other, and neither do the steps in which time goes on.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use crate::body::Kind;
use crate::cmm::{Cmm, CmmSpec};
use crate::part::{Part, PartSpec};
use crate::probe::Placement;
use crate::process::{GrindEntry, Grinder, GrinderSpec, systematic_mm};

/// The whole truth in one table.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct WorldSpec {
    /// What everything random is drawn from.
    pub seed: u64,
    /// Seconds of the machines' time in a second of ours.
    pub speed: f64,
    /// The part.
    pub part: PartSpec,
    /// The grinder.
    pub grinder: GrinderSpec,
    /// The measuring machine.
    pub cmm: CmmSpec,
    /// What is broken, for tests.
    pub faults: Faults,
}

impl Default for WorldSpec {
    fn default() -> Self {
        Self {
            seed: 1,
            speed: 1000.0,
            part: PartSpec::default(),
            grinder: GrinderSpec::default(),
            cmm: CmmSpec::default(),
            faults: Faults::default(),
        }
    }
}

/// How the grinder turns a map over or round.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mirrored {
    /// Not at all.
    #[default]
    None,
    /// x for -x.
    X,
    /// y for -y.
    Y,
    /// By half a turn.
    HalfTurn,
    /// By a quarter of a turn: -y for x, and x for y.
    QuarterTurn,
}

/// What is broken, for tests.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Faults {
    /// The grinder displaces to the wrong side.
    pub map_sign_flipped: bool,
    /// The grinder turns the map over.
    pub map_mirrored: Mirrored,
    /// The grinder displaces by the map twice over.
    pub map_doubled: bool,
    /// The grinder grinds as if the map were zero.
    pub map_ignored: bool,
    /// The CMM reports contact points (centre less stated radius along the target's normal).
    pub returns_contact_points: bool,
    /// And says so in the header of the outbox; else the header says centres.
    pub contact_points_declared: bool,
    /// The CMM reports inches, and the header says millimetres.
    pub inches: bool,
    /// The part lies on the CMM turned by half a turn about z.
    pub part_turned_180: bool,
    /// There is no part in either machine.
    pub no_part: bool,
    /// The grinder holds a part of another identity than any payload names.
    pub wrong_part: bool,
    /// One record of the points holds a NaN (format 1 only).
    pub non_finite_point: bool,
    /// So many records are missing at the end of the points.
    pub missing_records: u32,
}

/// Why a table cannot be a world.
#[derive(Clone, Debug, PartialEq)]
pub struct SpecError {
    /// The key, as a path in the table.
    pub key: &'static str,
    /// Its value.
    pub value: f64,
    /// What is allowed.
    pub limit: &'static str,
}

impl fmt::Display for SpecError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}` of the simulated world is {}, allowed is {}", self.key, self.value, self.limit)
    }
}

impl std::error::Error for SpecError {}

const SIZE: &str = "0 to 10000";
const SIGNED: &str = "-10000 to 10000";
const LENGTH: &str = "0.5 to 10000 mm";
const SHARE: &str = "0 to 1";

impl WorldSpec {
    /// Checks every number.
    ///
    /// # Errors
    /// The first one that is outside what the simulation holds for.
    pub fn check(&self) -> Result<(), SpecError> {
        check_all("speed", &[self.speed], 1e-3, 1e6, "0.001 to 1e6")?;
        let [half_x, half_y] = self.part.aperture.half_mm();
        check_all("part.aperture", &[half_x, half_y], 2.0, 1000.0, "2 to 1000 mm")?;
        check_all("part.stock_um", &[self.part.stock_um], 0.0, 10_000.0, SIZE)?;
        check_all("part.form_error_um", &[self.part.form_error_um], 0.0, 10_000.0, SIZE)?;
        let length = self.part.form_error_correlation_mm;
        check_all("part.form_error_correlation_mm", &[length], 0.5, 10_000.0, LENGTH)?;
        self.check_grinder()?;
        self.check_cmm()?;
        self.check_shape()
    }

    fn check_grinder(&self) -> Result<(), SpecError> {
        let g = &self.grinder;
        let signed = [
            ("grinder.wheel_radius_error_um", &[g.wheel_radius_error_um][..]),
            ("grinder.setting_error_um", &g.setting_error_um),
            ("grinder.straightness_x_um", &g.straightness_x_um),
            ("grinder.straightness_y_um", &g.straightness_y_um),
            ("grinder.periodic_um", &[g.periodic_um]),
            ("grinder.following_um", &[g.following_um]),
            ("grinder.wear_um", &[g.wear_um]),
            ("grinder.break_in_um", &[g.break_in_um]),
            ("grinder.thermal_um", &[g.thermal_um]),
        ];
        signed.iter().try_for_each(|(key, values)| check_all(key, values, -1e4, 1e4, SIGNED))?;
        check_all("grinder.waviness_um", &[g.waviness_um], 0.0, 1e4, SIZE)?;
        check_all("grinder.repeatability_um", &[g.repeatability_um], 0.0, 1e4, SIZE)?;
        check_all("grinder.periodic_pitch_mm", &[g.periodic_pitch_mm], 0.5, 1e4, LENGTH)?;
        check_all("grinder.waviness_correlation_mm", &[g.waviness_correlation_mm], 0.5, 1e4, LENGTH)?;
        check_all("grinder.repeatability_correlation_mm", &[g.repeatability_correlation_mm], 0.5, 1e4, LENGTH)?;
        check_all("grinder.break_in_share", &[g.break_in_share], 0.0, 1.0, SHARE)?;
        check_all("grinder.thermal_tau_s", &[g.thermal_tau_s], 1.0, 1e6, "1 to 1e6 s")?;
        check_all("grinder.error_copying", &[g.error_copying], 0.0, 0.95, "0 to 0.95")?;
        check_all("grinder.travel_mm", &g.travel_mm, 1.0, 1e4, "1 to 10000 mm")?;
        check_all("grinder.feed_most_mm_min", &[g.feed_most_mm_min], 1.0, 5e4, "1 to 50000 mm/min")?;
        check_all("grinder.map_most_um", &[g.map_most_um], 0.0, 1e4, SIZE)
    }

    fn check_cmm(&self) -> Result<(), SpecError> {
        let c = &self.cmm;
        check_all("cmm.translation_mm", &c.translation_mm, -1e3, 1e3, "-1000 to 1000 mm")?;
        check_all("cmm.rotation_deg", &c.rotation_deg, -360.0, 360.0, "-360 to 360 degrees")?;
        check_all("cmm.loading_shift_um", &[c.loading_shift_um], 0.0, 1e4, SIZE)?;
        check_all("cmm.loading_turn_deg", &[c.loading_turn_deg], 0.0, 10.0, "0 to 10 degrees")?;
        check_all("cmm.noise_um", &[c.noise_um], 0.0, 1e4, SIZE)?;
        check_all("cmm.outlier_share", &[c.outlier_share], 0.0, 1.0, SHARE)?;
        check_all("cmm.outlier_um", &[c.outlier_um], 0.0, 1e4, SIZE)?;
        check_all("cmm.not_found_share", &[c.not_found_share], 0.0, 1.0, SHARE)?;
        check_all("cmm.probe_radius_error_um", &[c.probe_radius_error_um], -1e4, 1e4, SIGNED)?;
        check_all("cmm.part_temperature_c", &[c.part_temperature_c], -50.0, 100.0, "-50 to 100 degrees Celsius")?;
        check_all("cmm.cte_per_k", &[c.cte_per_k], -1e-4, 1e-4, "-1e-4 to 1e-4 per kelvin")?;
        check_all("cmm.sphere_radius_mm", &[c.sphere_radius_mm], 0.5, 200.0, "0.5 to 200 mm")?;
        check_all("cmm.sphere_centre_mm", &c.sphere_centre_mm, -2e3, 2e3, "-2000 to 2000 mm")?;
        check_all("cmm.travel_least_mm", &c.travel_least_mm, -2e3, 2e3, "-2000 to 2000 mm")?;
        check_all("cmm.travel_most_mm", &c.travel_most_mm, -2e3, 2e3, "-2000 to 2000 mm")?;
        check_all("cmm.seconds_per_point", &[c.seconds_per_point], 1e-3, 1e3, "0.001 to 1000 s")
    }

    /// The surface must have a height everywhere on the part; domains of these shapes are convex, so the rim tells.
    fn check_shape(&self) -> Result<(), SpecError> {
        let (shape, [half_x, half_y]) = (self.part.shape.build(), self.part.aperture.half_mm());
        for k in 0..360 {
            let (sine, cosine) = f64::from(k).to_radians().sin_cos();
            let stretch = match self.part.aperture {
                crate::part::Aperture::Circle { .. } => 1.0,
                crate::part::Aperture::Rectangle { .. } => 1.0 / sine.abs().max(cosine.abs()),
            };
            let (x, y) = (half_x * cosine * stretch, half_y * sine * stretch);
            let [p, q] = shape.gradient(x, y);
            let slope = p.hypot(q);
            if !shape.height(x, y).is_finite() || !(0.0..=10.0).contains(&slope) {
                return Err(SpecError {
                    key: "part.shape",
                    value: slope,
                    limit: "a slope up to 10 all over the aperture",
                });
            }
        }
        Ok(())
    }
}

fn check_all(key: &'static str, values: &[f64], least: f64, most: f64, limit: &'static str) -> Result<(), SpecError> {
    match values.iter().find(|value| !(least..=most).contains(*value)) {
        Some(&value) => Err(SpecError { key, value, limit }),
        None => Ok(()),
    }
}

/// What a stream of random numbers is for.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Source {
    Blank = 1,
    Waviness = 2,
    Repeatability = 3,
    Loading = 4,
    Noise = 5,
    Outliers = 6,
    NotFound = 7,
}

/// Returns the stream of a source for its n-th use.
pub(crate) fn stream(seed: u64, source: Source, number: u32) -> crate::Rng {
    let mut rng = crate::rng(seed);
    rng.set_stream((source as u64) << 32 | u64::from(number));
    rng
}

/// What both machines share.
pub(crate) struct State {
    pub spec: WorldSpec,
    pub part: Part,
    /// Systematic error of the grinder at every node but the wheel's radius, in millimetres.
    pub systematic_mm: Vec<f64>,
    /// Number of the blank in the grinder, from 1.
    pub blanks: u32,
    /// The job that the blank belongs to.
    pub job: Option<u32>,
    /// Identity of the part in the grinder.
    pub held: Option<[u8; 32]>,
    pub true_wheel_radius_mm: Option<f64>,
    pub passes_begun: u32,
    pub measurements_begun: u32,
    pub loadings: u32,
    /// The part has not left the CMM since it was measured last.
    pub on_table: bool,
    /// Takes the model frame to the CMM's.
    pub placement: Placement,
    /// How warm the spindle is, 0 to 1.
    pub heat: f64,
    /// Finishing strokes since the wheel was dressed.
    pub worn_strokes: f64,
    /// The machine whose job has the part.
    pub busy: Option<Kind>,
    /// The machine whose wheel or probe is at the part.
    pub engaged: Option<Kind>,
    pub history: Vec<GrindEntry>,
}

impl State {
    fn new(spec: WorldSpec) -> Self {
        let part = Part::blank(&spec.part, blank_seed(spec.seed, 1));
        let systematic_mm = systematic_mm(&spec.grinder, &part, spec.seed);
        let placement = spec.cmm.placement(&spec.faults, spec.seed, 0);
        Self {
            spec,
            part,
            systematic_mm,
            blanks: 1,
            job: None,
            held: None,
            true_wheel_radius_mm: None,
            passes_begun: 0,
            measurements_begun: 0,
            loadings: 0,
            on_table: false,
            placement,
            heat: 0.0,
            worn_strokes: 0.0,
            busy: None,
            engaged: None,
            history: Vec::new(),
        }
    }

    pub fn load_blank(&mut self) {
        self.blanks += 1;
        self.part = Part::blank(&self.spec.part, blank_seed(self.spec.seed, self.blanks));
        (self.held, self.job, self.on_table) = (None, None, false);
    }

    /// Sees to it that the part in the grinder is that of the job.
    pub fn blank_for(&mut self, job: u32) {
        if self.spec.part.fresh_per_job && self.job.is_some_and(|other| other != job) {
            self.load_blank();
        }
        self.job = Some(job);
    }

    /// Returns the placement for a measurement: the last one if the part has lain still, else one of a fresh loading.
    pub fn load_on_table(&mut self) -> Placement {
        if !self.on_table {
            self.on_table = true;
            self.loadings += 1;
            self.placement = self.spec.cmm.placement(&self.spec.faults, self.spec.seed, self.loadings);
        }
        self.placement
    }

    pub fn taken_by_other(&self, kind: Kind) -> bool {
        self.busy.is_some_and(|other| other != kind)
    }

    /// Gives the part to a machine, unless the other has it.
    pub fn take(&mut self, kind: Kind) -> bool {
        if self.taken_by_other(kind) {
            return false;
        }
        (self.busy, self.engaged) = (Some(kind), Some(kind));
        true
    }

    pub fn clear(&mut self, kind: Kind) {
        if self.engaged == Some(kind) {
            self.engaged = None;
        }
    }

    pub fn release(&mut self, kind: Kind) {
        self.clear(kind);
        if self.busy == Some(kind) {
            self.busy = None;
        }
    }

    pub fn interlocks(&self, kind: Kind) -> u16 {
        let (guards, supplies) = (1, 1 << 3);
        let clear = if self.engaged == Some(kind) { 0 } else { 1 << 1 };
        let clamped = if self.taken_by_other(kind) { 0 } else { 1 << 2 };
        guards | clear | clamped | supplies
    }
}

fn blank_seed(seed: u64, number: u32) -> u64 {
    use rand::RngExt;
    stream(seed, Source::Blank, number).random()
}

/// A panic elsewhere leaves a state that still tells the truth about the part.
pub(crate) fn locked(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A simulated cell. Clones share one truth.
#[derive(Clone)]
pub struct World {
    state: Arc<Mutex<State>>,
}

impl fmt::Debug for World {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = locked(&self.state);
        f.debug_struct("World").field("spec", &state.spec).field("history", &state.history).finish_non_exhaustive()
    }
}

impl World {
    /// Makes the world of a table.
    ///
    /// # Errors
    /// A number that the simulation does not hold for.
    pub fn new(spec: WorldSpec) -> Result<Self, SpecError> {
        spec.check()?;
        Ok(Self { state: Arc::new(Mutex::new(State::new(spec))) })
    }

    /// Returns the grinder; there is one, so hand it to one wire.
    pub fn grinder(&self) -> Grinder {
        Grinder::new(self.state.clone())
    }

    /// Returns the measuring machine; there is one, so hand it to one wire.
    pub fn cmm(&self) -> Cmm {
        Cmm::new(self.state.clone())
    }

    /// Puts a new blank in, as an operator would.
    pub fn load_blank(&self) {
        locked(&self.state).load_blank();
    }

    /// Changes what is broken, from the next job on.
    pub fn set_faults(&self, faults: Faults) {
        let mut state = locked(&self.state);
        state.spec.faults = faults;
        state.on_table = false;
    }

    /// Returns the table.
    pub fn spec(&self) -> WorldSpec {
        locked(&self.state).spec.clone()
    }

    /// Truth: how far the real surface stands over the nominal at (x, y) of the model frame, along the normal, in millimetres.
    pub fn deviation_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        locked(&self.state).part.height.at(x_mm, y_mm).0
    }

    /// Truth: the same at many places, at one moment.
    pub fn deviations_mm(&self, places_mm: &[[f64; 2]]) -> Vec<f64> {
        let state = locked(&self.state);
        places_mm.iter().map(|&[x, y]| state.part.height.at(x, y).0).collect()
    }

    /// Truth: the point of the nominal surface over (x, y) and its unit normal.
    pub fn nominal(&self, x_mm: f64, y_mm: f64) -> (crate::Vec3, crate::Vec3) {
        let state = locked(&self.state);
        (state.part.shape.point(x_mm, y_mm), state.part.shape.normal(x_mm, y_mm))
    }

    /// Truth: where the part lay in the last measurement (before the first: where it will, but for the loading), half a turn included.
    /// Takes the model frame to the CMM's at 20 degrees Celsius.
    pub fn placement(&self) -> Placement {
        locked(&self.state).placement
    }

    /// Truth: mean of the deviation over the part, in millimetres.
    pub fn level_mm(&self) -> f64 {
        let state = locked(&self.state);
        let part = &state.part;
        let on_part: Vec<f64> = part
            .height
            .nodes()
            .zip(&part.height.heights_mm)
            .filter(|([x, y], _)| part.aperture.contains(*x, *y))
            .map(|(_, h)| *h)
            .collect();
        on_part.iter().sum::<f64>() / on_part.len() as f64
    }

    /// Truth: RMS of what a pass draws afresh, which no compensation can take away, in millimetres.
    pub fn floor_mm(&self) -> f64 {
        locked(&self.state).spec.grinder.repeatability_um * 1e-3
    }

    /// Truth: every pass that was begun, in order.
    pub fn history(&self) -> Vec<GrindEntry> {
        locked(&self.state).history.clone()
    }

    /// Truth: how often a pass was begun for a job and cycle.
    pub fn grinds_begun(&self, job: u32, cycle: u16) -> usize {
        locked(&self.state).history.iter().filter(|entry| (entry.job, entry.cycle) == (job, cycle)).count()
    }

    /// Truth: how many measurements were begun.
    pub fn measurements_begun(&self) -> u32 {
        locked(&self.state).measurements_begun
    }

    /// Truth: which blank is in the grinder, counted from 1.
    pub fn blank(&self) -> u32 {
        locked(&self.state).blanks
    }
}
