//! Wheel that a controller without knowledge of part or pass moves from position to position, and the surface that the
//! wheel leaves.
//!
//! The wheel is a ball. With its centre at C, its height over the nominal surface is the distance of C from the surface
//! minus its radius, at the projection of C. Between two tracks, a stiff machine would leave the heights of both
//! tracks, interpolated linearly. Machine and part deflect as in [`crate::grinder`], which defines `S` and `mu`: h
//! becomes mu h + (1 - mu) cmd where h > cmd. The grooves of single tracks, wear and growth are not modelled here.

use std::sync::{Arc, Mutex};

use crate::Vec3;
use crate::body::Kind;
use crate::shape::project_onto;
use crate::truth::{WorldState, locked};

/// Height over the nominal surface above which there is no material, in mm.
const AIR_MM: f64 = 1.0;
/// Distance in y within which places belong to the same track, in mm.
const SAME_TRACK_MM: f64 = 0.2;

/// Samples of the wheel along a track: x, and the height over the nominal surface.
#[derive(Clone, Debug, Default)]
struct Track {
    y_mm: f64,
    places: Vec<[f64; 2]>,
}

impl Track {
    /// Returns the height of the track over the nominal surface at the coordinate `x`, in mm. The height is
    /// interpolated linearly between the neighbouring samples of the track. Beyond an end of the track, it is the
    /// height of the sample at this end. Returns `None` if the track has no samples.
    fn height_at(&self, x: f64) -> Option<f64> {
        let near = |a: &&[f64; 2], b: &&[f64; 2]| (a[0] - x).abs().total_cmp(&(b[0] - x).abs());
        let below = self.places.iter().filter(|place| place[0] <= x).min_by(near);
        let above = self.places.iter().filter(|place| place[0] > x).min_by(near);
        match (below, above) {
            (Some([x0, u0]), Some([x1, u1])) => Some(u0 + (u1 - u0) * (x - x0) / (x1 - x0)),
            (one, other) => one.or(other).map(|place| place[1]),
        }
    }
}

/// Wheel of a world's grinder.
pub struct PlainWheel {
    world: Arc<Mutex<WorldState>>,
    radius_mm: f64,
    first_track: Option<Track>,
    previous_track: Option<Track>,
    current_track: Option<Track>,
}

impl PlainWheel {
    /// Creates the wheel of the grinder in `world`. `stated_mm` is the wheel radius that the controller assumes, in mm.
    /// The true radius is `stated_mm` plus the radius error in the specification.
    pub(crate) fn new(world: Arc<Mutex<WorldState>>, stated_mm: f64) -> Self {
        let radius_mm = stated_mm + 1e-3 * locked(&world).spec.grinder.wheel_radius_error_um;
        Self { world, radius_mm, first_track: None, previous_track: None, current_track: None }
    }

    /// Clamps the part in the grinder at the start of a program, and forgets the tracks of the previous program.
    /// Returns true if the part is in the grinder, and false if the other machine has the part.
    pub fn claim_part(&mut self) -> bool {
        let mut state = locked(&self.world);
        (self.first_track, self.previous_track, self.current_track) = (None, None, None);
        state.on_table = false;
        state.claim_part(Kind::Grinder)
    }

    /// Moves the wheel away from the part, so that the other machine can take the part.
    pub fn release_part(&mut self) {
        locked(&self.world).release(Kind::Grinder);
    }

    /// Moves the centre of the wheel to `centre_mm`, a position in the model frame. A track is a series of wheel
    /// positions whose y differs from that of the first one by at most 0.2 mm. A position with another y begins a new
    /// track.
    ///
    /// If there is a previous track, grinds the part between the previous track and the present one, from the last x to
    /// the new x. If the wheel is more than 1 mm above the nominal surface, it grinds nothing and the present track
    /// ends. Does nothing if the position cannot be projected onto the surface.
    pub fn move_to(&mut self, centre_mm: Vec3) {
        let world = Arc::clone(&self.world);
        let mut state = locked(&world);
        let near = [centre_mm[0], centre_mm[1]];
        let Some(([x, y], height_mm)) = project_onto(state.part.shape.as_ref(), centre_mm, near) else { return };
        let over_mm = height_mm - self.radius_mm;
        if over_mm > AIR_MM {
            return self.next_track();
        }
        if self.current_track.as_ref().is_some_and(|track| (track.y_mm - y).abs() > SAME_TRACK_MM) {
            self.next_track();
        }
        let track = self.current_track.get_or_insert_with(|| Track { y_mm: y, places: Vec::new() });
        let last = track.places.last().map_or(x, |place| place[0]);
        track.places.push([x, over_mm]);
        if let (Some(before), Some(now)) = (&self.previous_track, &self.current_track) {
            let along = [last.min(x), last.max(x)];
            let across = [before.y_mm.min(now.y_mm), before.y_mm.max(now.y_mm)];
            grind(&mut state, (along, across), |[x, y]| {
                let [from, to] = [before.height_at(x)?, now.height_at(x)?];
                Some(from + (to - from) * (y - before.y_mm) / (now.y_mm - before.y_mm))
            });
        }
    }

    fn next_track(&mut self) {
        if let Some(track) = self.current_track.take() {
            self.first_track.get_or_insert_with(|| track.clone());
            self.previous_track = Some(track);
        }
    }

    /// Ends a complete sweep over the part. Grinds the two strips outside the first and the last track, up to the edges
    /// of the part. Each strip gets the height of the track next to it. Does nothing if the sweep has no track.
    pub fn finish_sweep(&mut self) {
        self.next_track();
        let world = Arc::clone(&self.world);
        let mut state = locked(&world);
        let (first, last) = (self.first_track.take(), self.previous_track.take());
        let Some((first, last)) = first.zip(last) else { return };
        let (low, high) = if first.y_mm <= last.y_mm { (&first, &last) } else { (&last, &first) };
        let all = [f64::NEG_INFINITY, f64::INFINITY];
        grind(&mut state, (all, [f64::NEG_INFINITY, low.y_mm]), |[x, _]| low.height_at(x));
        grind(&mut state, (all, [high.y_mm, f64::INFINITY]), |[x, _]| high.height_at(x));
    }
}

/// Grinds all nodes of the part within a rectangle. `along` are the limits of x and `across` the limits of y, each as
/// minimum and maximum in mm. The function `wanted` receives (x, y) of a node, and returns the commanded height of the
/// surface over the nominal surface, in mm. If `wanted` returns `None`, the node does not change. The target is this
/// height plus the systematic error of the grinder. A node that is already lower than the target does not change. A
/// higher node keeps the fraction `error_copying` of its excess over the target.
fn grind(state: &mut WorldState, (along, across): ([f64; 2], [f64; 2]), wanted: impl Fn([f64; 2]) -> Option<f64>) {
    let mu = state.spec.grinder.error_copying;
    let within = |[least, most]: [f64; 2], value: f64| (least..=most).contains(&value);
    let nodes: Vec<(usize, [f64; 2])> = state.part.height.nodes().enumerate().collect();
    for (k, [x, y]) in nodes {
        if !within(along, x) || !within(across, y) {
            continue;
        }
        let Some(over_mm) = wanted([x, y]) else { continue };
        let cmd = over_mm + state.systematic_mm[k];
        let h = &mut state.part.height.heights_mm[k];
        if *h > cmd {
            *h = mu * *h + (1.0 - mu) * cmd;
        }
    }
}
