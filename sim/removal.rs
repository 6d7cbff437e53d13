//! Removal of material in a pass, the same for every grinder: why the surface that the wheel leaves differs from the
//! commanded surface.
//!
//! A source of motion brings the wheel to the nodes of the part's grid, and knows at each node the height that is
//! wanted there. There are three:
//!
//! ```text
//!  crate::grinder            strokes of a pass, at the level of the pass and the displacement of its map
//!  crate::followed_surface   strokes of a pass, at the heights of a program that the control reads
//!  crate::executed_wheel     positions of the wheel's centre, as a controller executes a program
//! ```
//!
//! At every node, at the moment when the wheel is there, a stiff machine would leave the surface at this height over
//! the nominal:
//!
//! ```text
//!  cmd = wanted + S + W(t) - T(t) + N
//!
//!  S          systematic error, the same in every pass: setting, tilt, straightness, screw, waviness
//!  W, T       wear of the wheel (leaves more) and growth of the spindle (leaves less), both along the path
//!  N          random error of each pass, which no compensation can remove
//! ```
//!
//! Machine and part deflect, so a share mu of the excess height remains: h becomes mu h + (1 - mu) cmd where h > cmd.
//! The wheel cuts air if h <= cmd.
//!
//! **Scallops.** The wheel is a ball. Where it cuts, it leaves a groove around each track: h is the bottom of the
//! grooves, and the ridges between them belong to the part that is measured ([`crate::part`]). Grooves lie at the
//! tracks of the last pass. Where that pass was broken off or cut air, the grooves of the pass before keep their
//! height.

use crate::form::FormError;
use crate::part::{Grooves, HeightGrid, Part};
use crate::spec::{GrinderSpec, WorldSpec};
use crate::truth::{Source, WorldState, stream};

/// Grinds the node with the index `node`. `cmd_mm` is the height in mm that an infinitely stiff machine would leave. A
/// real machine deflects: the fraction `error_copying` of the height above `cmd_mm` remains. `bend` is the curvature in
/// 1/mm of the groove that the wheel leaves, or `None` for a wheel without grooves. Returns true if the wheel removed
/// material. Returns false and changes nothing if the node is not higher than `cmd_mm`, or if the fault `no_part` is
/// configured.
pub(crate) fn cut(state: &mut WorldState, node: usize, cmd_mm: f64, bend: Option<f64>) -> bool {
    let h = &mut state.part.height.heights_mm[node];
    if state.spec.faults.no_part || *h <= cmd_mm {
        return false;
    }
    let mu = state.spec.grinder.error_copying;
    *h = mu * *h + (1.0 - mu) * cmd_mm;
    if let (Some(left), Some(bend)) = (&mut state.part.grooves, bend) {
        left.bend.heights_mm[node] = bend;
    }
    true
}

/// Returns the height in mm that wear and thermal growth add at a moment of a pass, W - T. `strokes` is the number of
/// finishing strokes since the beginning of the pass. `heats` are the warmth of the spindle when the wheel was touched
/// off, and its warmth now.
pub(crate) fn drift_mm(state: &WorldState, strokes: f64, heats: [f64; 2]) -> f64 {
    let spec = &state.spec.grinder;
    let worn_um = spec.wear_at_um(state.worn_strokes + strokes) - spec.wear_at_um(state.worn_strokes);
    1e-3 * (worn_um - spec.thermal_um * (heats[1] - heats[0]))
}

/// Adds the random error N of the pass number `pass`, from 1, to `heights_mm`, which has one value in mm for each node
/// of the part.
pub(crate) fn add_random_error(state: &WorldState, pass: u32, heights_mm: &mut [f64]) {
    let spec = &state.spec.grinder;
    let rng = &mut stream(state.spec.seed, Source::Repeatability, pass);
    state.part.height.add(&smooth(rng, spec.repeatability_correlation_mm, spec.repeatability_um), heights_mm);
}

/// Counts a new pass over the part in the grinder. The wheel is dressed if the specification requires this before each
/// pass.
pub(crate) fn begin_pass(state: &mut WorldState) {
    state.on_table = false;
    state.passes_begun += 1;
    state.passes_of_blank += 1;
    if state.spec.grinder.dressed_each_pass {
        state.worn_strokes = 0.0;
    }
}

/// Returns the true radius of the wheel in mm. If `state` already contains the true radius from an earlier pass,
/// returns this radius. Otherwise returns the radius `stated_mm` plus the radius error of the specification.
pub(crate) fn wheel_radius_mm(state: &WorldState, stated_mm: f64) -> f64 {
    state.true_wheel_radius_mm.unwrap_or(stated_mm + 1e-3 * state.spec.grinder.wheel_radius_error_um)
}

/// Returns, for every node of the part, the curvature in 1/mm of the grooves that a wheel of radius `radius_mm` leaves
/// where it cuts. Returns `None` if the specification has no grooves (`scallops` is false).
pub(crate) fn groove_bend(state: &WorldState, radius_mm: f64) -> Option<HeightGrid> {
    state.spec.grinder.scallops.then(|| {
        let mut bend = HeightGrid::over(&state.part.aperture, 0.0);
        bend.heights_mm = bend.nodes().map(|at| Grooves::bend_at(state.part.shape.as_ref(), radius_mm, at)).collect();
        bend
    })
}

/// Sets the position and the spacing of the part's grooves, in mm: y of a track, and the distance of the tracks.
/// `wheel_radius_mm` is the radius of the wheel. Does not change the curvature of existing grooves. If the
/// specification has no grooves, the part has none afterwards.
pub(crate) fn place_grooves(state: &mut WorldState, [first_mm, spacing_mm]: [f64; 2], wheel_radius_mm: f64) {
    let before = state.part.grooves.take().map(|grooves| grooves.bend);
    if state.spec.grinder.scallops {
        let bend = before.unwrap_or_else(|| HeightGrid::over(&state.part.aperture, 0.0));
        state.part.grooves = Some(Grooves { first_mm, spacing_mm, wheel_radius_mm, bend });
    }
}

/// Returns the systematic error S of the grinder at every node of `part`, in mm. The error contains the errors of
/// setting, tilt, straightness and screw pitch, and the random waviness that is the same in every pass. It does not
/// contain the error of the wheel's radius.
pub(crate) fn systematic_mm(spec: &WorldSpec, part: &Part) -> Vec<f64> {
    let (seed, spec) = (spec.seed, &spec.grinder);
    let waves = smooth(&mut stream(seed, Source::Waviness, 0), spec.waviness_correlation_mm, spec.waviness_um);
    let mut error_mm: Vec<f64> = part.height.nodes().map(|place| 1e-3 * spec.systematic_um(part, place)).collect();
    part.height.add(&waves, &mut error_mm);
    error_mm
}

fn smooth(rng: &mut crate::Rng, correlation_mm: f64, rms_um: f64) -> FormError {
    if rms_um > 0.0 { FormError::with_rms(rng, correlation_mm, rms_um * 1e-3) } else { FormError::none() }
}

impl GrinderSpec {
    /// Returns the systematic error of the grinder at (x, y) of a part, in µm: setting, tilt, straightness and screw
    /// errors. The error of the wheel's radius is not included.
    fn systematic_um(&self, part: &Part, [x, y]: [f64; 2]) -> f64 {
        let ([half_x, half_y], [middle_x, middle_y]) = (part.aperture.half_mm(), part.aperture.middle_mm());
        let [p, q] = part.shape.gradient(x, y);
        let nz = 1.0 / (1.0 + p * p + q * q).sqrt();
        let [ex, ey] = self.setting_error_um;
        let setting = nz * (p * ex + q * ey + self.setting_error_z_um);
        // Grinding a part tilted by a about a point of its frame leaves the opposite tilt: -a . (r x n), n = nz (-p,
        // -q, 1).
        let z = part.shape.height(x, y);
        let [about_x, about_y] = self.part_tilt_urad.map(|tilt| 1e-3 * tilt);
        let tilt = -nz * (about_x * (y + q * z) - about_y * (x + p * z));
        let straight =
            |t: f64, [second, third]: [f64; 2]| second * (1.5 * t * t - 0.5) + third * (2.5 * t * t * t - 1.5 * t);
        let straightness = straight((x - middle_x) / half_x, self.straightness_x_um)
            + straight((y - middle_y) / half_y, self.straightness_y_um);
        let screw = self.periodic_um * (std::f64::consts::TAU * x / self.periodic_pitch_mm + 0.7).sin();
        finite_or_zero(setting + tilt + straightness + screw)
    }

    /// Returns the wear of the wheel after a number of finishing strokes since it was dressed, in µm.
    fn wear_at_um(&self, strokes: f64) -> f64 {
        let fast = if self.break_in_share > 0.0 { 1.0 - (-strokes / self.break_in_share).exp() } else { 0.0 };
        self.wear_um * strokes + self.break_in_um * fast
    }

    /// Returns the warmth of the spindle, 0 to 1, after it has run for `seconds`. `before` is its warmth before.
    pub(crate) fn heat_after(&self, before: f64, seconds: f64) -> f64 {
        1.0 - (1.0 - before) * (-seconds / self.thermal_tau_s).exp()
    }
}

/// Returns the value, or 0 if it is infinite or NaN. The formulas of the surface can give such values at the corners of
/// the grid of a round part.
pub(crate) fn finite_or_zero(value: f64) -> f64 {
    if value.is_finite() { value } else { 0.0 }
}
