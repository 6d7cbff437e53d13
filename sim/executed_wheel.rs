//! Wheel along the path that a controller executes, position by position: that of a LinuxCNC elsewhere, servo cycle by
//! servo cycle ([`crate::wire::executed_path`]), or that of the simulated one ([`crate::rsh`]).
//!
//! This is one source of motion of the removal model ([`crate::removal`]). There are no pass registers and no map here.
//! Only the executed positions of the wheel's centre are known. Each position c, in the frame of the part, gives its
//! projection (foot) on the nominal surface, and the wanted height there:
//!
//! ```text
//!  wanted = (c' - foot) . n - R   R the true radius of the wheel
//!  c' = c + (R - stated) z - lag  touched off at its lowest place; the axes lag behind along the path
//! ```
//!
//! **Tracks.** A track begins when the wheel comes near the part, and ends when it lifts off or turns back in x. A
//! track grinds the strip half way to its neighbours, with the depth at its own y: the ridges between are the
//! [`Grooves`] of the part. A track is therefore ground only when the next one or [`Wheel::finish_waiting_track`]
//! comes. Beyond the outermost track, the wheel leaves its own curve. Tracks must run along x.
//!
//! **Passes.** A pass lasts from when the wheel comes to the part until the part is taken away; the wheel is dressed
//! before. A controller that knows its programs clamps the part for each of them ([`Wheel::clamp_part`]); then each
//! program is a pass, and keeps the part to its end.

use std::sync::{Arc, Mutex};

use crate::Vec3;
use crate::body::Kind;
use crate::part::{Grooves, HeightGrid, NODE_SPACING_MM};
use crate::removal::{add_random_error, begin_pass, cut, drift_mm, groove_bend, place_grooves, wheel_radius_mm};
use crate::shape::project_onto;
use crate::spec::SpecError;
use crate::truth::{ExecutedPass, WorldState, locked};

/// Maximum height over the nominal surface at which the wheel counts as being at the part, in mm.
const NEAR_MM: f64 = 1.0;
/// Depth beyond which the wheel has run into the part, in mm: no pass cuts so deep at once.
const TOO_DEEP_MM: f64 = 2.0;
/// Extension of a strip beyond a border without a neighbour, as a share of its half width.
const ON_BORDER: f64 = 0.05;
/// Width that the wheel grinds beyond its outermost track, in mm.
const OUTER_STRIP_MM: f64 = 1.5;

/// Projection of the wheel's centre onto the part.
#[derive(Clone, Copy, Debug)]
struct WheelProjection {
    position_mm: [f64; 2],
    /// Height over the nominal surface that the wheel would leave, in mm.
    height_mm: f64,
    seconds: f64,
}

/// Track over the part.
struct Track {
    projections: Vec<WheelProjection>,
    y_mm: f64,
}

/// Values that are fixed from the beginning of a pass.
struct PassState {
    /// Systematic and random error at every node, in mm.
    fixed_mm: Vec<f64>,
    /// Curvature of the grooves, if there are any.
    bend: Option<HeightGrid>,
    began_s: f64,
    heat_at_begin: f64,
    /// Number of nodes on the part. `visits` is the number of visits of the wheel to nodes, `in_air` the number of
    /// visits at which the wheel cut air.
    nodes: f64,
    visits: u64,
    in_air: u64,
    /// y of the first track, in mm.
    first_mm: Option<f64>,
}

/// Wheel of a grinder whose controller executes programs.
pub struct Wheel {
    world: Arc<Mutex<WorldState>>,
    stated_radius_mm: f64,
    last: Option<(Vec3, f64)>,
    guess_mm: [f64; 2],
    pass: Option<PassState>,
    projections: Vec<WheelProjection>,
    /// Last track that has ended. It is ground when the next track has ended, because its strip depends on the next
    /// track.
    waiting_track: Option<Track>,
    /// Half the spacing of the tracks, known after the second track. `side` is the direction in y in which the tracks
    /// follow each other, 1 or -1.
    half_mm: Option<f64>,
    side: f64,
    /// y of the border up to which strips are ground, in mm.
    reached_mm: Option<f64>,
    /// True if the grinder keeps the part although the wheel has lifted off.
    is_clamped: bool,
}

impl Wheel {
    pub(crate) fn new(world: Arc<Mutex<WorldState>>, stated_radius_mm: f64) -> Result<Self, SpecError> {
        if !(0.1..=1000.0).contains(&stated_radius_mm) {
            return Err(SpecError { key: "radius of the wheel", value: stated_radius_mm, limit: "0.1 to 1000 mm" });
        }
        Ok(Self {
            world,
            stated_radius_mm,
            last: None,
            guess_mm: [0.0; 2],
            pass: None,
            projections: Vec::new(),
            waiting_track: None,
            half_mm: None,
            side: 1.0,
            reached_mm: None,
            is_clamped: false,
        })
    }

    /// Clamps the part in the grinder at the start of a program, which begins a new pass. Returns true if the part is
    /// in the grinder, and false if the other machine has the part.
    pub fn clamp_part(&mut self) -> bool {
        let mut state = locked(&self.world);
        (self.pass, state.on_table) = (None, false);
        self.is_clamped = state.claim_part(Kind::Grinder);
        self.is_clamped
    }

    /// Moves the wheel away from the part, and grinds its last track. The other machine can then take the part.
    pub fn release_part(&mut self) {
        self.is_clamped = false;
        self.set_position_unknown();
        self.finish_waiting_track();
    }

    /// Moves the wheel's centre to `place_mm`, in the frame of the part, and simulates the grinding on the way.
    /// `seconds` is the time of the controller's clock at this position, in s. The first call only sets the start
    /// position, and so does the first call after [`Self::set_position_unknown`].
    pub fn move_to(&mut self, place_mm: Vec3, seconds: f64) {
        let Some((from_mm, then)) = self.last.replace((place_mm, seconds)) else { return };
        if from_mm == place_mm {
            return;
        }
        let world = Arc::clone(&self.world);
        let state = &mut *locked(&world);
        match self.project(state, [from_mm, place_mm], [then, seconds]) {
            Some(foot) => self.add_projection(state, foot),
            None => self.lift_off(state),
        }
    }

    /// Marks the position of the wheel as unknown, for example before homing or after power-off. From then on the wheel
    /// is treated as lifted off the part: the present track ends, and the grinder releases the part.
    pub fn set_position_unknown(&mut self) {
        self.last = None;
        let world = Arc::clone(&self.world);
        self.lift_off(&mut locked(&world));
    }

    /// Handles a gap in the path that the controller reports. The position of the wheel and the state of the part are
    /// unknown from then on. The wheel is treated as lifted off the part.
    pub fn path_lost(&mut self) {
        self.set_position_unknown();
        locked(&self.world).part_unknown = true;
    }

    /// Grinds the waiting track (the last track that has ended but is not yet ground) as the last track of the pass.
    /// Normally, a track waits until the next track has ended, because the width of its strip depends on the next
    /// track. Does nothing if no track waits, or if the wheel has already begun the next track on the part.
    pub fn finish_waiting_track(&mut self) {
        let world = Arc::clone(&self.world);
        let state = &mut *locked(&world);
        if self.projections.is_empty() {
            self.grind_waiting(state, None);
        }
    }

    /// Projects the true centre of the wheel onto the nominal surface. The true centre is the commanded centre,
    /// corrected for the lag of the axes and for the radius error of the wheel. `from_mm` and `place_mm` are the
    /// previous and the present commanded centre in mm. `then` and `seconds` are the times of these two positions in s.
    ///
    /// Returns the position (x, y) of the projection in mm, the height in mm over the nominal surface that the wheel
    /// would leave there, and the time `seconds`. Returns `None` if the wheel is 1 mm or more above the real surface,
    /// or if the projection fails.
    ///
    /// If the wheel is more than 2 mm below the real surface inside the aperture, also marks the state of the part as
    /// unknown.
    fn project(
        &mut self,
        state: &mut WorldState,
        [from_mm, place_mm]: [Vec3; 2],
        [then, seconds]: [f64; 2],
    ) -> Option<WheelProjection> {
        let stated_mm = self.stated_radius_mm;
        let radius_mm = wheel_radius_mm(state, stated_mm);
        state.true_wheel_radius_mm = Some(radius_mm);
        // The lag is specified at 1000 mm/min.
        let lag_s = 1e-3 * state.spec.grinder.following_um * 60.0 / 1000.0;
        let mut centre: Vec3 = std::array::from_fn(|k| {
            let speed = (place_mm[k] - from_mm[k]) / (seconds - then).max(1e-6);
            place_mm[k] - lag_s * speed
        });
        centre[2] += radius_mm - stated_mm;
        let near = [place_mm[0], place_mm[1]];
        let (at_mm, distance_mm) =
            [self.guess_mm, near].into_iter().find_map(|from| project_onto(state.part.shape.as_ref(), centre, from))?;
        self.guess_mm = at_mm;
        let height_mm = distance_mm - radius_mm;
        let over_mm = height_mm - state.part.height.at(at_mm[0], at_mm[1]).0;
        state.part_unknown |= over_mm < -TOO_DEEP_MM && state.part.aperture.contains(at_mm[0], at_mm[1]);
        (over_mm < NEAR_MM).then_some(WheelProjection { position_mm: at_mm, height_mm, seconds })
    }

    fn add_projection(&mut self, state: &mut WorldState, foot: WheelProjection) {
        if !state.claim_part(Kind::Grinder) {
            // The probe is at the part.
            state.part_unknown = true;
            return;
        }
        if self.pass.is_none() || state.on_table {
            self.begin(state, foot.seconds);
        }
        if let [first, .., last] = &self.projections[..] {
            let forth = last.position_mm[0] - first.position_mm[0];
            if forth * (foot.position_mm[0] - last.position_mm[0]) < 0.0 {
                self.end_track(state);
            }
        }
        self.projections.push(foot);
    }

    fn lift_off(&mut self, state: &mut WorldState) {
        self.end_track(state);
        if !self.is_clamped {
            state.release(Kind::Grinder);
        }
    }

    fn begin(&mut self, state: &mut WorldState, seconds: f64) {
        (self.waiting_track, self.half_mm, self.reached_mm) = (None, None, None);
        begin_pass(state);
        let mut fixed_mm = state.systematic_mm.clone();
        add_random_error(state, state.passes_begun, &mut fixed_mm);
        let nodes = state.part.height.nodes().filter(|[x, y]| state.part.aperture.contains(*x, *y)).count() as f64;
        self.pass = Some(PassState {
            fixed_mm,
            bend: groove_bend(state, wheel_radius_mm(state, self.stated_radius_mm)),
            began_s: seconds,
            heat_at_begin: state.heat,
            nodes,
            visits: 0,
            in_air: 0,
            first_mm: None,
        });
        state.executed_passes.push(ExecutedPass::default());
    }

    /// Ends the present track after the wheel has lifted off or turned back. Grinds the waiting track (the track before
    /// the present one). The present track then waits until the next track ends, because the width of its strip depends
    /// on the next track. Ignores the present track if the wheel has not moved along x near the part.
    fn end_track(&mut self, state: &mut WorldState) {
        let feet = std::mem::take(&mut self.projections);
        let [[min_x, max_x], [min_y, max_y]] = state.part.aperture.bounds_mm();
        let on_part = |foot: &&WheelProjection| {
            (min_x..=max_x).contains(&foot.position_mm[0])
                && (min_y - OUTER_STRIP_MM..=max_y + OUTER_STRIP_MM).contains(&foot.position_mm[1])
        };
        // The mean is over the length, because the wheel can slow down and stop anywhere on the track.
        let on: Vec<&WheelProjection> = feet.iter().filter(on_part).collect();
        let (sum, length_mm) = on.windows(2).fold((0.0, 0.0), |(sum, length_mm), pair| {
            let [a, b] = [pair[0], pair[1]].map(|foot| foot.position_mm);
            let step_mm = (b[0] - a[0]).abs();
            (sum + step_mm * 0.5 * (a[1] + b[1]), length_mm + step_mm)
        });
        if length_mm > 0.0 {
            let track = Track { y_mm: sum / length_mm, projections: feet };
            self.grind_waiting(state, Some(track.y_mm));
            self.waiting_track = Some(track);
        }
    }

    /// Grinds a strip along the waiting track (the last track that has ended but is not yet ground). The strip reaches
    /// half way to the next track, at y = `next_mm` in mm. If `next_mm` is `None`, or its distance is not plausible for
    /// a neighbouring track, the strip ends about half a track distance from the waiting track. Does nothing if no
    /// track waits.
    fn grind_waiting(&mut self, state: &mut WorldState, next_mm: Option<f64>) {
        let Some(track) = self.waiting_track.take() else { return };
        let Some(mut pass) = self.pass.take() else { return };
        let step = next_mm.map(|next| next - track.y_mm).filter(|step| self.is_neighbour(*step));
        if let Some(step) = step {
            (self.half_mm, self.side) = (Some(0.5 * step.abs()), step.signum());
        }
        pass.first_mm.get_or_insert(track.y_mm);
        update_grooves(state, &pass, &track, self.half_mm);
        let half = self.half_mm.unwrap_or(0.5 * NODE_SPACING_MM);
        let (far, near) = (track.y_mm + self.side * half, track.y_mm - self.side * half);
        let joined = self.reached_mm.filter(|reached| (reached - near).abs() < 0.2 * half);
        // A border without a neighbour includes the row of nodes that is on it.
        let outwards = [-self.side, self.side].map(|side| ON_BORDER * half * side);
        let strip = [joined.unwrap_or(near + outwards[0]), if step.is_some() { far } else { far + outwards[1] }];
        let beside = [(joined.is_none(), -self.side), (step.is_none(), self.side)];
        let beside = beside.map(|(is_open, side)| is_open.then_some(side));
        self.reached_mm = Some(far);
        grind(state, &mut pass, &track, strip, beside.into_iter().flatten());
        self.pass = Some(pass);
    }

    fn is_neighbour(&self, step: f64) -> bool {
        match self.half_mm {
            Some(half) => (0.4 * half..=6.0 * half).contains(&step.abs()),
            None => (1e-3..=10.0).contains(&step.abs()),
        }
    }
}

/// Updates the position and the spacing of the part's grooves after a track. The first groove is at the first track of
/// `pass`. The spacing is such that one of the grooves is at `track`. `half_mm` is half the distance between two
/// tracks, in mm. Does nothing if `half_mm` is `None`.
///
/// This function does not change the curvature of existing grooves. If the specification has no grooves, the part has
/// none afterwards.
fn update_grooves(state: &mut WorldState, pass: &PassState, track: &Track, half_mm: Option<f64>) {
    let (Some(half), Some(first_mm)) = (half_mm, pass.first_mm) else { return };
    let number = ((track.y_mm - first_mm) / (2.0 * half)).round();
    let spacing_mm = if number == 0.0 { 2.0 * half } else { (track.y_mm - first_mm) / number };
    if let Some(sweep) = state.executed_passes.last_mut() {
        sweep.spacing_mm = spacing_mm;
    }
    place_grooves(state, [first_mm, spacing_mm], state.true_wheel_radius_mm.unwrap_or_default());
}

/// Grinds the nodes along `track` whose y is within the two limits `strip`, in mm. `beside` lists the sides of the
/// strip without a neighbouring track: -1 is the side of smaller y, 1 the side of larger y. On these sides the wheel
/// also grinds nodes beyond the strip, up to 1.5 mm, with its curved profile.
fn grind(
    state: &mut WorldState,
    pass: &mut PassState,
    track: &Track,
    strip: [f64; 2],
    beside: impl Iterator<Item = f64>,
) {
    let seconds = track.projections.last().map_or(0.0, |foot| foot.seconds) - pass.began_s;
    let heat = state.spec.grinder.heat_after(pass.heat_at_begin, seconds);
    let drift_mm = drift_mm(state, pass.visits as f64 / pass.nodes.max(1.0), [pass.heat_at_begin, heat]);
    for (node, [x, y], height_mm) in nodes_in_strip(&state.part.height, track, strip) {
        let bend = pass.bend.as_ref().map(|bend| bend.heights_mm[node]);
        let has_cut = cut(state, node, height_mm + pass.fixed_mm[node] + drift_mm, bend);
        if state.part.aperture.contains(x, y) {
            pass.visits += 1;
            pass.in_air += u64::from(!has_cut);
        }
    }
    for side in beside {
        let edge = if (strip[1] - strip[0]) * side > 0.0 { strip[1] } else { strip[0] };
        for (node, [x, y], height_mm) in nodes_in_strip(&state.part.height, track, [edge, edge + side * OUTER_STRIP_MM])
        {
            let radius_mm = state.true_wheel_radius_mm.unwrap_or(f64::INFINITY);
            // A wheel without grooves is straight across its tracks.
            let across = pass.bend.as_ref().map(|_| Grooves::bend_at(state.part.shape.as_ref(), radius_mm, [x, y]));
            let rise_mm = 0.5 * across.unwrap_or(0.0) * (y - track.y_mm).powi(2);
            cut(state, node, height_mm + rise_mm + pass.fixed_mm[node] + drift_mm, None);
        }
    }
    state.heat = heat;
    if let Some(sweep) = state.executed_passes.last_mut() {
        let [strokes, strokes_in_air] = [pass.visits, pass.in_air].map(|n| n as f64 / pass.nodes.max(1.0));
        *sweep = ExecutedPass { strokes, strokes_in_air, tracks: sweep.tracks + 1, seconds, ..*sweep };
    }
}

/// Returns the grid nodes along `track` whose y is within the two limits `strip`, in mm. Each item has the index of the
/// node, its position (x, y) in mm, and the height in mm that the wheel leaves. The height is interpolated along the
/// centre line of the track at the x of the node.
fn nodes_in_strip(grid: &HeightGrid, track: &Track, strip: [f64; 2]) -> Vec<(usize, [f64; 2], f64)> {
    let mut nodes = Vec::new();
    for pair in track.projections.windows(2) {
        let [a, b] = [pair[0], pair[1]];
        let (from, to) = (a.position_mm[0], b.position_mm[0]);
        nodes.extend(grid.within([from, to], strip).map(|(node, [x, y])| {
            let share = (x - from) / (to - from);
            (node, [x, y], a.height_mm + share * (b.height_mm - a.height_mm))
        }));
    }
    nodes
}
