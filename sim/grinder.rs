//! Grinder that carries out passes: the path of the wheel, its strokes, and the height that each stroke wants.
//!
//! The grinder is one source of motion of the removal model ([`crate::removal`]). At every node the wanted height is
//!
//! ```text
//!  wanted = level + u + R + F
//!
//!  level, u   commanded by the client: the level of the pass, and the map; or the height of a program that it reads
//!  R          error of the wheel's radius, on slopes
//!  F          following error: the axes lag, on alternate tracks to alternate sides
//! ```
//!
//! Spark-out repeats the stroke.
//!
//! **Depth of cut.** Roughing strokes first remove the material that is more than the depth of cut above cmd. Each
//! removes at most the depth of cut, with ten times the feed and a wheel of its own (no wear, no growth). They leave at
//! most the depth of cut for the finishing stroke, so a pass always ends with one finishing stroke. More than
//! [`MAX_STROKES`] are refused.
//!
//! **Time.** Tracks run along x, at the track spacing in y, alternately forth and back, with 1.5 mm of overtravel on
//! every side. A node is ground in the middle of its track's strip. `advance` grinds the nodes whose time has come, so
//! a pass that is broken off leaves a half-ground part. The wheel is dressed and touched off before it finishes: wear
//! and growth count from there. The heat stays in the spindle from pass to pass, and decays while the part is measured.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use data_encoding::HEXLOWER;

use crate::body::{Kind, Payload, Payloads, Physics, Progress, Refusal, ResultData};
use crate::followed_surface;
use crate::head::Head;
use crate::part::{HeightGrid, Part};
use crate::payload::{BROKEN, INTERLOCK, Map, Pass, PassRecord, outside};
use crate::program::{Control, Program};
use crate::removal::{
    add_random_error, begin_pass, cut, drift_mm, finite_or_zero, groove_bend, place_grooves, wheel_radius_mm,
};
use crate::spec::{Mirrored, Misreported};
use crate::truth::{GrindEntry, WorldState, empty_result, locked};

/// Maximum number of strokes of a pass, roughing and finishing together.
pub const MAX_STROKES: u32 = 400;
/// Overtravel of the wheel beyond the part on every side, in mm.
pub const OVERTRAVEL_MM: f64 = 1.5;
/// Ratio of the feed of a roughing stroke to that of a finishing stroke.
const ROUGHING_FEED: f64 = 10.0;

/// Stroke of the wheel over the whole part.
#[derive(Clone, Copy, Debug)]
struct Stroke {
    begin_s: f64,
    feed_mm_s: f64,
    /// Height of a roughing stroke above the finishing stroke, in mm; `None` for finishing and spark-out.
    above_mm: Option<f64>,
}

/// Prepared or running pass.
struct Run {
    job: u32,
    cycle: u16,
    map_identity: [u8; 32],
    max_map_mm: f64,
    pass: Pass,
    /// Positions along one stroke, in mm, each with the index of the node that is ground there, in order.
    order: Vec<(f64, u32)>,
    /// Error that does not change along the path, for every node, in mm.
    fixed_mm: Vec<f64>,
    /// Curvature of the grooves that the wheel leaves where it cuts, for every node in 1/mm.
    bend: Option<HeightGrid>,
    strokes: Vec<Stroke>,
    stroke_mm: f64,
    total_s: f64,
    finishing_s: f64,
    heat_at_begin: f64,
    before_mm: Vec<f64>,
    stroke: usize,
    next: usize,
    elapsed_s: f64,
    visits: u64,
    in_air: u64,
}

impl Run {
    fn roughing(&self) -> u32 {
        self.strokes.iter().filter(|s| s.above_mm.is_some()).count() as u32
    }

    fn finished(&self) -> bool {
        self.elapsed_s >= self.total_s
    }

    /// Grinds every node that the wheel has reached up to the present time of the job.
    fn grind(&mut self, state: &mut WorldState) {
        while let Some(stroke) = self.strokes.get(self.stroke).copied() {
            while let Some(&(place, node)) = self.order.get(self.next) {
                let moment = stroke.begin_s + place / stroke.feed_mm_s;
                if moment > self.elapsed_s {
                    return;
                }
                self.cut(state, stroke, moment, node as usize);
                self.next += 1;
            }
            (self.stroke, self.next) = (self.stroke + 1, 0);
        }
    }

    fn cut(&mut self, state: &mut WorldState, stroke: Stroke, moment: f64, node: usize) {
        let drift_mm = stroke.above_mm.unwrap_or_else(|| {
            let strokes = (moment - self.finishing_s) * stroke.feed_mm_s / self.stroke_mm;
            let heat_at = |seconds| state.spec.grinder.heat_after(self.heat_at_begin, seconds);
            drift_mm(state, strokes, [self.finishing_s, moment].map(heat_at))
        });
        let bend = self.bend.as_ref().map(|bend| bend.heights_mm[node]);
        self.visits += 1;
        if !cut(state, node, self.fixed_mm[node] + drift_mm, bend) {
            self.in_air += 1;
        }
    }

    /// Returns the length of the path that the wheel has travelled so far, in mm.
    fn path_mm(&self) -> f64 {
        let time = self.elapsed_s.min(self.total_s);
        self.strokes.iter().map(|s| ((time - s.begin_s).max(0.0) * s.feed_mm_s).min(self.stroke_mm)).sum()
    }

    fn record(&self, state: &WorldState, result: u16) -> PassRecord {
        let part = &state.part;
        let (mut volume_mm3, mut depth_mm) = (0.0, 0.0f64);
        for (k, [x, y]) in part.height.nodes().enumerate().filter(|(_, [x, y])| part.aperture.contains(*x, *y)) {
            let depth = self.before_mm[k] - part.height.heights_mm[k];
            let [p, q] = part.shape.gradient(x, y);
            volume_mm3 += finite_or_zero(depth * part.height.cell_mm2() * (1.0 + p * p + q * q).sqrt());
            depth_mm = depth_mm.max(depth);
        }
        let air_share = if self.visits == 0 { 1.0 } else { self.in_air as f64 / self.visits as f64 };
        let each_mm = depth_mm / (self.roughing() + 1) as f64;
        PassRecord {
            job: self.job,
            cycle: self.cycle,
            result,
            path_mm: self.path_mm(),
            volume_mm3,
            depth_mm,
            air_share,
            // Idling takes a tenth of the spindle load; a stroke at the full depth of cut everywhere takes seven
            // tenths.
            spindle_load: (0.1 + 0.6 * (1.0 - air_share) * (each_mm / self.pass.depth_of_cut_mm).min(1.0)).min(1.0),
            wheel_radius_mm: self.pass.wheel_radius_mm,
        }
    }
}

/// Returns `record` with one false value, to simulate a fault. `misreported` selects the value, for example the path
/// length. Returns `record` unchanged for `Misreported::Nothing`. Also returns `record` unchanged for
/// `Misreported::Duration`, because the duration is not part of a pass record.
fn misreporting(record: PassRecord, misreported: Misreported) -> PassRecord {
    match misreported {
        Misreported::Nothing | Misreported::Duration => record,
        Misreported::Job => PassRecord { job: record.job.wrapping_sub(1), ..record },
        Misreported::Result => PassRecord { result: 4, ..record },
        Misreported::Depth => PassRecord { depth_mm: 3.0, ..record },
        Misreported::Path => PassRecord { path_mm: -1.0, ..record },
        Misreported::Wheel => PassRecord { wheel_radius_mm: record.wheel_radius_mm * 0.875, ..record },
    }
}

/// Returns the grid nodes that the wheel passes on its raster path (parallel tracks, alternately forth and back), in
/// the order of the path. Each item has the position along the path in mm, and the index of the node. The second value
/// is the length of the path in mm.
fn raster(part: &Part, pass: &Pass) -> (Vec<(f64, u32)>, f64) {
    let [x0, x1, y0, y1] = grown(pass.extent_mm);
    let (length, spacing) = (x1 - x0, pass.track_spacing_mm);
    let last = ((y1 - y0) / spacing).ceil();
    let mut order: Vec<(f64, u32)> = Vec::new();
    for (k, [x, y]) in part.height.nodes().enumerate() {
        if (x0..=x1).contains(&x) && (y0..=y1).contains(&y) {
            let track = ((y - y0) / spacing).round().min(last);
            let along = if (track as u64).is_multiple_of(2) { x - x0 } else { x1 - x };
            order.push((track * (length + spacing) + along, k as u32));
        }
    }
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    (order, (last + 1.0) * length + last * spacing)
}

fn grown([x0, x1, y0, y1]: [f64; 4]) -> [f64; 4] {
    [x0 - OVERTRAVEL_MM, x1 + OVERTRAVEL_MM, y0 - OVERTRAVEL_MM, y1 + OVERTRAVEL_MM]
}

/// Returns one height in mm over the nominal surface for every node: the height that the pass commands, plus the errors
/// of the grinder that do not change with time. Wear and thermal growth are not included. The commanded height comes
/// from `program` if there is one, otherwise from `map`. The height is NaN at nodes that the program does not reach.
fn fixed_mm(state: &WorldState, map: &Map, pass: &Pass, program: Option<&Program>) -> Vec<f64> {
    let (spec, part) = (&state.spec.grinder, &state.part);
    let true_radius_mm = wheel_radius_mm(state, pass.wheel_radius_mm);
    let y0 = grown(pass.extent_mm)[2];
    let lag_mm = 1e-3 * spec.following_um * pass.feed_mm_min / 1000.0;
    let followed =
        program.map(|program| followed_surface::heights_mm(part, program, pass.wheel_radius_mm, pass.track_spacing_mm));
    let nodes = part.height.nodes().zip(&state.systematic_mm).enumerate();
    let steered = nodes.map(|(node, ([x, y], systematic))| {
        let [p, q] = part.shape.gradient(x, y);
        let slope2 = 1.0 + p * p + q * q;
        // A wheel larger than stated cuts deeper on slopes: what it leaves is lower by dR (1/nz - 1).
        let wheel = (pass.wheel_radius_mm - true_radius_mm) * (slope2.sqrt() - 1.0);
        let forth = if ((y - y0) / pass.track_spacing_mm).round() as i64 % 2 == 0 { 1.0 } else { -1.0 };
        let following = forth * lag_mm * p / slope2.sqrt();
        let wanted = match &followed {
            Some(followed) => followed[node],
            None => pass.level_mm + displaced(state, map, x, y),
        };
        wanted + systematic + finite_or_zero(wheel + following)
    });
    let mut steered: Vec<f64> = steered.collect();
    add_random_error(state, state.passes_begun + 1, &mut steered);
    steered
}

/// Returns the displacement in mm that the machine applies at (x, y). Without faults, this is the displacement of `map`
/// at (x, y). Configured faults can mirror or rotate the map, double it, ignore it, or reverse its sign.
fn displaced(state: &WorldState, map: &Map, x: f64, y: f64) -> f64 {
    let faults = &state.spec.faults;
    let (x, y) = match faults.map_mirrored {
        Mirrored::None => (x, y),
        Mirrored::X => (-x, y),
        Mirrored::Y => (x, -y),
        Mirrored::HalfTurn => (-x, -y),
        Mirrored::QuarterTurn => (-y, x),
    };
    let times = if faults.map_doubled { 2.0 } else { 1.0 };
    let u = if faults.map_ignored { 0.0 } else { times * map.displacement_at(x, y) };
    if faults.map_sign_flipped { -u } else { u }
}

/// Folder of the programs of a control, and the kind of control.
#[derive(Clone, Debug)]
pub struct Programs {
    /// Folder of the programs.
    pub folder: PathBuf,
    /// Control that reads them.
    pub control: Control,
    /// Head that the programs can turn.
    pub head: Option<Head>,
}

impl Programs {
    /// Finds and parses the program for a map. `identity` is the SHA-256 of the map. A program belongs to the map if
    /// its comment contains this SHA-256. If several programs match, the longest is used.
    ///
    /// # Errors
    /// Returns a message if the folder cannot be read, if no program matches, or if the machine cannot execute the
    /// program.
    fn read_for_map(&self, identity: &[u8; 32]) -> Result<Program, String> {
        let map = HEXLOWER.encode(identity);
        let files = std::fs::read_dir(&self.folder).map_err(|error| format!("{}: {error}", self.folder.display()))?;
        let is_of_map = |text: &String| {
            let words: Vec<String> = text.lines().map(str::to_ascii_lowercase).collect();
            // Long comments can be split over several lines.
            words.iter().any(|line| line.contains("map: sha256")) && words.iter().any(|line| line.contains(&map))
        };
        let texts = files.flatten().filter_map(|file| std::fs::read_to_string(file.path()).ok());
        let text = texts.filter(is_of_map).max_by_key(String::len);
        let text = text.ok_or_else(|| format!("{} has no program for the map {map}", self.folder.display()))?;
        self.control.read(&text)?.with_head(self.head)
    }
}

/// Grinder of a world.
pub struct Grinder {
    world: Arc<Mutex<WorldState>>,
    programs: Option<Programs>,
    ready: Option<Run>,
    running: Option<Run>,
}

impl Grinder {
    pub(crate) fn new(world: Arc<Mutex<WorldState>>) -> Self {
        Self { world, programs: None, ready: None, running: None }
    }

    /// Makes the grinder follow machine programs instead of correction maps. For each pass, the grinder then reads the
    /// program whose comment contains the SHA-256 of the pass's map. `programs` states the folder of the programs, the
    /// numerical control that reads them, and the rotary head of the machine. Without this call, the grinder applies
    /// the map directly. Returns the changed grinder.
    #[must_use]
    pub fn by_programs(mut self, programs: Programs) -> Self {
        self.programs = Some(programs);
        self
    }

    /// Checks a pass against the limits of this machine.
    ///
    /// # Errors
    /// The feed, the travel or the number of tracks is above its limit.
    fn check_pass(state: &WorldState, pass: &Pass) -> Result<(), Refusal> {
        let spec = &state.spec.grinder;
        if pass.feed_mm_min > spec.max_feed_mm_min {
            return Err(outside("feed in mm/min", pass.feed_mm_min, &format!("up to {}", spec.max_feed_mm_min)));
        }
        let [x0, x1, y0, y1] = grown(pass.extent_mm);
        for (name, value, most) in [("x", x0.abs().max(x1.abs()), 0), ("y", y0.abs().max(y1.abs()), 1)] {
            let most = spec.travel_mm[most];
            if value > most {
                return Err(outside(&format!("travel along {name} in mm"), value, &format!("up to {most}")));
            }
        }
        let tracks = (y1 - y0) / pass.track_spacing_mm;
        if tracks > 20_000.0 {
            return Err(outside("number of tracks", tracks, "up to 20000"));
        }
        Ok(())
    }

    fn check_map(state: &WorldState, map: &Map) -> Result<(), Refusal> {
        let most = state.spec.grinder.max_map_um;
        if map.max_abs_mm() * 1e3 > most {
            return Err(outside("largest value of the map in um", map.max_abs_mm() * 1e3, &format!("up to {most}")));
        }
        Ok(())
    }

    fn check_part_identity(state: &WorldState, nominal: &[u8; 32], job: Option<u32>) -> Result<(), Refusal> {
        let same_part = !state.spec.part.fresh_per_job || (job.is_some() && state.job == job);
        let other = match state.part_identity {
            Some(held) => same_part && held != *nominal,
            None => false,
        };
        if state.spec.faults.wrong_part || other {
            let reason = "the payload is for another part than the grinder holds".to_owned();
            return Err(Refusal { answer: BROKEN, reason });
        }
        Ok(())
    }
}

/// Returns the strokes of a pass and their total duration in s. A stroke is one run of the wheel along the whole path.
/// The order is: `roughing` roughing strokes, one finishing stroke, then the spark-out strokes. `stroke_mm` is the
/// length of the path of one stroke.
fn strokes(roughing: u32, pass: &Pass, stroke_mm: f64) -> (Vec<Stroke>, f64) {
    let feed_mm_s = pass.feed_mm_min / 60.0;
    let above = (1..=roughing).rev().map(|k| Some(f64::from(k) * pass.depth_of_cut_mm));
    let finishing = (0..=pass.spark_out).map(|_| None);
    let mut begin_s = 0.0;
    let each = above.chain(finishing).map(|above_mm| {
        let feed_mm_s = if above_mm.is_some() { ROUGHING_FEED * feed_mm_s } else { feed_mm_s };
        let stroke = Stroke { begin_s, feed_mm_s, above_mm };
        begin_s += stroke_mm / feed_mm_s;
        stroke
    });
    let strokes = each.collect();
    (strokes, begin_s)
}

/// Prepares a pass without motion: computes the commanded heights, the path and the strokes from the present state of
/// the part. `map` is decoded from `map_payload`. The pass follows `program` if there is one, otherwise `map`.
///
/// # Errors
/// Returns a refusal if the pass needs more strokes than the machine allows.
fn run(
    state: &WorldState,
    (job, cycle): (u32, u16),
    map_payload: &Payload,
    map: &Map,
    (pass, program): (Pass, Option<&Program>),
) -> Result<Run, Refusal> {
    let fixed_mm = fixed_mm(state, map, &pass, program);
    let bend = groove_bend(state, wheel_radius_mm(state, pass.wheel_radius_mm));
    let (mut order, stroke_mm) = raster(&state.part, &pass);
    // Nodes that the program does not reach are not ground.
    order.retain(|&(_, node)| fixed_mm[node as usize].is_finite());
    let within = |&(_, node): &(f64, u32)| state.part.height.heights_mm[node as usize] - fixed_mm[node as usize];
    let proud_mm = order.iter().map(within).fold(0.0, f64::max);
    let needed = (proud_mm / pass.depth_of_cut_mm).ceil().max(1.0);
    if needed + f64::from(pass.spark_out) > f64::from(MAX_STROKES) {
        let limit = format!("up to {MAX_STROKES}; the part is {proud_mm:.4} mm above the commanded height");
        return Err(outside("number of strokes", needed + f64::from(pass.spark_out), &limit));
    }
    let (strokes, total_s) = strokes(needed as u32 - 1, &pass, stroke_mm);
    let finishing_s = strokes.iter().find(|s| s.above_mm.is_none()).map_or(total_s, |s| s.begin_s);
    Ok(Run {
        job,
        cycle,
        map_identity: map_payload.identity,
        max_map_mm: map.max_abs_mm(),
        pass,
        order,
        fixed_mm,
        bend,
        strokes,
        stroke_mm,
        total_s,
        finishing_s,
        heat_at_begin: state.heat,
        before_mm: Vec::new(),
        stroke: 0,
        next: 0,
        elapsed_s: 0.0,
        visits: 0,
        in_air: 0,
    })
}

/// Returns the progress of a job in thousandths of its duration.
fn progress(run: &Run) -> Progress {
    let finished = run.finished();
    let done = if finished { 1000 } else { ((1000.0 * run.elapsed_s / run.total_s) as u32).min(999) };
    Progress { done, total: 1000, finished, fault: 0 }
}

impl Physics for Grinder {
    fn kind(&self) -> Kind {
        Kind::Grinder
    }

    fn name(&self) -> String {
        "SIMULATED GRINDER 1".to_owned()
    }

    fn check(&self, kind: u16, payload: &Payload) -> Result<(), Refusal> {
        let state = locked(&self.world);
        match kind {
            2 => {
                let map = Map::decode(&payload.bytes)?;
                Self::check_map(&state, &map)?;
                Self::check_part_identity(&state, &map.nominal, None)
            }
            3 => {
                let pass = Pass::decode(&payload.bytes)?;
                Self::check_pass(&state, &pass)?;
                Self::check_part_identity(&state, &pass.nominal, None)
            }
            other => {
                Err(Refusal { answer: BROKEN, reason: format!("a grinder does not accept payloads of kind {other}") })
            }
        }
    }

    fn prepare(&mut self, job: u32, cycle: u16, payloads: &Payloads) -> Result<Progress, Refusal> {
        self.ready = None;
        let mut state = locked(&self.world);
        let missing = |what: &str| Refusal { answer: BROKEN, reason: format!("there is no {what}") };
        let map_payload = payloads.map.as_ref().ok_or_else(|| missing("map"))?;
        let map = Map::decode(&map_payload.bytes)?;
        let pass = Pass::decode(&payloads.pass.as_ref().ok_or_else(|| missing("pass"))?.bytes)?;
        if map.nominal != pass.nominal {
            return Err(Refusal { answer: BROKEN, reason: "map and pass are for different parts".to_owned() });
        }
        Self::check_map(&state, &map)?;
        Self::check_pass(&state, &pass)?;
        Self::check_part_identity(&state, &pass.nominal, Some(job))?;
        if state.is_held_by_other(Kind::Grinder) {
            return Err(Refusal { answer: INTERLOCK, reason: "the part is on the measuring machine".to_owned() });
        }
        state.blank_for(job);
        let program = match &self.programs {
            None => None,
            Some(programs) => {
                let refused = |reason| Refusal { answer: BROKEN, reason };
                Some(programs.read_for_map(&map_payload.identity).map_err(refused)?)
            }
        };
        let run = run(&state, (job, cycle), map_payload, &map, (pass, program.as_ref()))?;
        let first = progress(&run);
        self.ready = Some(run);
        Ok(first)
    }

    fn begin(&mut self) {
        let Some(mut run) = self.ready.take() else { return };
        let mut state = locked(&self.world);
        if !state.claim_part(Kind::Grinder) {
            return;
        }
        state.part_identity = Some(run.pass.nominal);
        begin_pass(&mut state);
        let radius_mm = wheel_radius_mm(&state, run.pass.wheel_radius_mm);
        state.true_wheel_radius_mm = Some(radius_mm);
        let entry = GrindEntry {
            job: run.job,
            cycle: run.cycle,
            level_mm: run.pass.level_mm,
            map_max_abs_mm: run.max_map_mm,
            map: run.map_identity,
            roughing_strokes: run.roughing(),
            result: 0,
            volume_mm3: 0.0,
        };
        state.history.push(entry);
        run.before_mm = state.part.height.heights_mm.clone();
        place_grooves(&mut state, [grown(run.pass.extent_mm)[2], run.pass.track_spacing_mm], radius_mm);
        self.running = Some(run);
    }

    fn advance(&mut self, seconds: f64) -> Progress {
        let mut state = locked(&self.world);
        let Some(run) = self.running.as_mut() else {
            // Nothing was begun: the other machine has the part.
            return Progress { done: 0, total: 1000, finished: false, fault: 1 };
        };
        if seconds > 0.0 && seconds.is_finite() {
            run.elapsed_s += seconds;
        }
        state.engaged = Some(Kind::Grinder);
        run.grind(&mut state);
        if run.finished() {
            state.disengage(Kind::Grinder);
        }
        progress(run)
    }

    fn retract(&mut self) {
        locked(&self.world).disengage(Kind::Grinder);
    }

    fn end_job(&mut self, result: u16) -> ResultData {
        let mut state = locked(&self.world);
        self.ready = None;
        let Some(run) = self.running.take() else { return empty_result(state.spec.cmm.part_temperature_c) };
        let record = run.record(&state, result);
        let duration_s = run.elapsed_s.min(run.total_s);
        let misreported = state.spec.faults.misreported;
        let spec = &state.spec.grinder;
        state.heat = spec.heat_after(run.heat_at_begin, duration_s);
        state.worn_strokes += (duration_s - run.finishing_s).max(0.0) * run.pass.feed_mm_min / 60.0 / run.stroke_mm;
        if let Some(entry) = state.history.last_mut() {
            (entry.result, entry.volume_mm3) = (result, record.volume_mm3);
        }
        state.release(Kind::Grinder);
        ResultData {
            kind: 5,
            format: 1,
            bytes: misreporting(record, misreported).encode(),
            records: 1,
            coordinates: 0,
            probe_radius_mm: 0.0,
            scale_mm: 1.0,
            temperature_c: state.spec.cmm.part_temperature_c,
            duration_s: if misreported == Misreported::Duration { 0.0 } else { duration_s },
        }
    }

    fn interlocks(&self) -> u16 {
        locked(&self.world).interlocks(Kind::Grinder)
    }

    fn temperature_c(&self) -> f64 {
        locked(&self.world).spec.cmm.part_temperature_c
    }
}

impl Drop for Grinder {
    /// Releases the part when this grinder object is destroyed. The CMM can then take the part.
    fn drop(&mut self) {
        locked(&self.world).release(Kind::Grinder);
    }
}
