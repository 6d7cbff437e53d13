//! State shared by both machines: the part and its history.
//!
//! Every random number has its own stream, selected by its purpose and its count. An additional source of error
//! therefore changes no other source, and neither does the size of the time steps.

use std::sync::{Mutex, MutexGuard, PoisonError};

use rand_distr::{Distribution, StandardNormal};

use crate::Vec3;
use crate::body::{Kind, ResultData};
use crate::part::Part;
use crate::probe::Placement;
use crate::spec::WorldSpec;

/// Pass that the grinder began.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GrindEntry {
    /// Run of the part.
    pub job: u32,
    /// Cycle of the run.
    pub cycle: u16,
    /// Commanded height, in mm.
    pub level_mm: f64,
    /// Largest value of the map of the pass, in mm.
    pub map_max_abs_mm: f64,
    /// Identity of the map.
    pub map: [u8; 32],
    /// Number of strokes that removed material higher than the depth of cut.
    pub roughing_strokes: u32,
    /// Result as in the pass record; 0 while the pass runs.
    pub result: u16,
    /// Removed volume, in mm³.
    pub volume_mm3: f64,
}

/// Pass along a path that a controller executed: from the first contact of wheel and part until the part was taken away.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ExecutedPass {
    /// Number of visits of the wheel to nodes, divided by the number of nodes: 1, plus 1 for every spark-out, if no
    /// node was omitted and none was visited again.
    pub strokes: f64,
    /// Part of `strokes` in which the wheel cut air, in strokes.
    pub strokes_in_air: f64,
    /// Number of tracks.
    pub tracks: u32,
    /// Spacing of the tracks, in mm; 0 before the second track.
    pub spacing_mm: f64,
    /// Time from the start of the first track to the end of the last, in s.
    pub seconds: f64,
}

/// Source of error that has its own stream of random numbers.
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

/// Creates the random number generator for one use of the noise source `source`. `number` is the number of this use.
/// Equal arguments give equal random numbers. The numbers of one source or use do not depend on the other sources and
/// uses.
pub(crate) fn stream(seed: u64, source: Source, number: u32) -> crate::Rng {
    let mut rng = crate::rng(seed);
    rng.set_stream((source as u64) << 32 | u64::from(number));
    rng
}

/// State shared by both machines.
pub(crate) struct WorldState {
    pub spec: WorldSpec,
    pub part: Part,
    /// Systematic error of the grinder at every node, in mm, without the effect of the wheel's radius.
    pub systematic_mm: Vec<f64>,
    /// Number of the blank in the grinder, from 1.
    pub blanks: u32,
    /// Job of the blank.
    pub job: Option<u32>,
    /// Identity of the part in the grinder.
    pub part_identity: Option<[u8; 32]>,
    pub true_wheel_radius_mm: Option<f64>,
    pub passes_begun: u32,
    /// Number of passes over the blank at the time when damage was last applied.
    pub damaged_after: Option<u32>,
    /// Number of passes over the blank in the grinder.
    pub passes_of_blank: u32,
    pub measurements_begun: u32,
    pub loadings: u32,
    /// True if the part has stayed on the CMM since the last measurement.
    pub on_table: bool,
    /// Placement that maps the model frame to the CMM's.
    pub placement: Placement,
    /// Warmth of the spindle, 0 to 1.
    pub heat: f64,
    /// Number of finishing strokes since the wheel was dressed.
    pub worn_strokes: f64,
    /// Machine whose job has the part.
    pub holder: Option<Kind>,
    /// Machine whose wheel or probe is not clear of the part.
    pub engaged: Option<Kind>,
    pub history: Vec<GrindEntry>,
    /// Passes along executed paths, in order.
    pub executed_passes: Vec<ExecutedPass>,
    /// True if part of an executed path was lost, or if the wheel ran into a probe: the state of the part is unknown.
    pub part_unknown: bool,
}

impl WorldState {
    /// Creates the initial state of the simulated cell from the specification `spec`, with the first blank. The
    /// function `systematic_mm` returns the systematic error of the grinder at each node of the part's height grid, in
    /// mm.
    pub fn new(spec: WorldSpec, systematic_mm: impl FnOnce(&WorldSpec, &Part) -> Vec<f64>) -> Self {
        let part = Part::blank(&spec.part, blank_seed(spec.seed, 1));
        let systematic_mm = systematic_mm(&spec, &part);
        let placement = placement(&spec, 0);
        Self {
            spec,
            part,
            systematic_mm,
            blanks: 1,
            job: None,
            part_identity: None,
            true_wheel_radius_mm: None,
            passes_begun: 0,
            damaged_after: None,
            passes_of_blank: 0,
            measurements_begun: 0,
            loadings: 0,
            on_table: false,
            placement,
            heat: 0.0,
            worn_strokes: 0.0,
            holder: None,
            engaged: None,
            history: Vec::new(),
            executed_passes: Vec::new(),
            part_unknown: false,
        }
    }

    pub fn load_blank(&mut self) {
        self.blanks += 1;
        self.part = Part::blank(&self.spec.part, blank_seed(self.spec.seed, self.blanks));
        (self.part_identity, self.job, self.on_table) = (None, None, false);
        (self.passes_of_blank, self.damaged_after) = (0, None);
    }

    /// Assigns the part in the grinder to a job. Loads a new blank first if the last job was another one and the
    /// specification requires a fresh part for each job.
    pub fn blank_for(&mut self, job: u32) {
        if self.spec.part.fresh_per_job && self.job.is_some_and(|other| other != job) {
            self.load_blank();
        }
        self.job = Some(job);
    }

    /// Loads the part on the CMM, and returns the placement of the part for a measurement. If the part has stayed on
    /// the CMM since the last measurement, the placement does not change. Otherwise, draws a new placement with a
    /// random loading error. In this case, also adds the defects that the specification requires after the present
    /// number of passes.
    pub fn load_on_table(&mut self) -> Placement {
        if !self.on_table {
            self.damage();
            self.on_table = true;
            self.loadings += 1;
            self.placement = placement(&self.spec, self.loadings);
        }
        self.placement
    }

    /// Adds the defects that are specified to appear after the present number of passes. Does nothing if they were
    /// added already.
    fn damage(&mut self) {
        if self.damaged_after.replace(self.passes_of_blank) == Some(self.passes_of_blank) {
            return;
        }
        let due = self.spec.part.defects.iter().filter(|defect| defect.after_pass == self.passes_of_blank);
        for defect in due {
            let nodes: Vec<[f64; 2]> = self.part.height.nodes().collect();
            let heights = self.part.height.heights_mm.iter_mut().zip(nodes);
            heights.for_each(|(height_mm, place)| *height_mm += defect.height_mm(place));
        }
    }

    pub fn is_held_by_other(&self, kind: Kind) -> bool {
        self.holder.is_some_and(|other| other != kind)
    }

    /// Gives the part to the machine `kind` and marks this machine as not clear of the part. Returns true if this is
    /// done. Returns false, and changes nothing, if the other machine has the part.
    pub fn claim_part(&mut self, kind: Kind) -> bool {
        if self.is_held_by_other(kind) {
            return false;
        }
        (self.holder, self.engaged) = (Some(kind), Some(kind));
        true
    }

    pub fn disengage(&mut self, kind: Kind) {
        if self.engaged == Some(kind) {
            self.engaged = None;
        }
    }

    pub fn release(&mut self, kind: Kind) {
        self.disengage(kind);
        if self.holder == Some(kind) {
            self.holder = None;
        }
    }

    pub fn interlocks(&self, kind: Kind) -> u16 {
        let (guards, supplies) = (1, 1 << 3);
        let clear = if self.engaged == Some(kind) { 0 } else { 1 << 1 };
        let clamped = if self.is_held_by_other(kind) { 0 } else { 1 << 2 };
        guards | clear | clamped | supplies
    }
}

/// Returns the placement of the part on the measuring machine at loading number `loading`. Loading 0 is the placement
/// of the specification, without random error.
fn placement(spec: &WorldSpec, loading: u32) -> Placement {
    let mut rng = stream(spec.seed, Source::Loading, loading);
    let mut about = |middle: Vec3, sigma: f64| -> Vec3 {
        middle.map(|c| {
            let z: f64 = StandardNormal.sample(&mut rng);
            if loading == 0 { c } else { c + sigma * z }
        })
    };
    let shift = about(spec.cmm.translation_mm, 1e-3 * spec.cmm.loading_shift_um);
    let turn = about(spec.cmm.rotation_deg, spec.cmm.loading_turn_deg);
    let mut placement = Placement::new(shift, turn);
    if spec.faults.part_turned_180 {
        for row in &mut placement.rotation {
            (row[0], row[1]) = (-row[0], -row[1]);
        }
    }
    placement
}

fn blank_seed(seed: u64, number: u32) -> u64 {
    use rand::RngExt;
    stream(seed, Source::Blank, number).random()
}

/// Locks the state and returns the lock guard. If another thread panicked while it held the lock, the mutex is
/// poisoned. This is ignored, because the state still describes the true part.
pub(crate) fn locked(state: &Mutex<WorldState>) -> MutexGuard<'_, WorldState> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the result data of a job that never began: no points and no record.
pub(crate) fn empty_result(temperature_c: f64) -> ResultData {
    ResultData {
        kind: 0,
        format: 1,
        bytes: Vec::new(),
        records: 0,
        coordinates: 0,
        probe_radius_mm: 0.0,
        scale_mm: 1.0,
        temperature_c,
        duration_s: 0.0,
    }
}
