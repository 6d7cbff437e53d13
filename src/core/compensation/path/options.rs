//! Options of a tool path and their validation.

use serde::{Deserialize, Serialize};

use super::wheel::MIN_SPINDLE_ANGLE_SINE;
use super::{PathError, RotaryAxis, TiltMode, Wheel};

/// Pattern of the tracks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum TrackPattern {
    /// Along x, one after the other from the lowest y to the highest.
    #[default]
    Raster,
    /// On a spiral about the middle of the outline, from outside inwards, turning clockwise seen from +z.
    Spiral,
}

/// Distance between neighbouring tracks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TrackSpacing {
    /// Maximum distance, measured over x and y, in millimetres.
    Distance(f64),
    /// Largest distance at which the ridges (scallops) between tracks stay within a maximum height:
    /// h = s^2 / (8 r_eff), with 1 / r_eff the curvature of the wheel minus the curvature of the hollow surface, both
    /// across the track.
    Scallop {
        /// Maximum height of the scallops, in millimetres.
        max_height_mm: f64,
        /// Upper limit of the distance, in millimetres.
        max_track_mm: f64,
    },
}

/// Path mode: how exactly a controller follows the path that a program describes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum PathMode {
    /// G64: corners are rounded off within a tolerance.
    #[default]
    Blend,
    /// G61: the path passes through every point.
    ExactPath,
    /// G61.1: the machine stops at every point.
    ExactStop,
}

/// Options from which a [`super::ToolPath`] is laid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathOptions {
    /// Shape and size of the wheel, with the spindle upright.
    pub wheel: Wheel,
    /// Rotary axis of the machine's head, if it has one.
    pub rotary: Option<RotaryAxis>,
    /// Tilt of the wheel about this axis. With `None` the axis does not move, and programs do not contain it.
    pub tilt: Option<TiltMode>,
    /// True if the wheel comes from -z. The surface and the wheel (spindle, heights) are then given mirrored in z, as
    /// seen from that side. The moves of the path are in the model frame.
    pub from_below: bool,
    /// Pattern of the tracks.
    pub pattern: TrackPattern,
    /// True if every track of a raster runs towards +x. Otherwise the direction alternates.
    pub one_way: bool,
    /// Distance between neighbouring tracks.
    pub spacing: TrackSpacing,
    /// Maximum distance between the straight lines that join the points and the path of the wheel's centre, in
    /// millimetres.
    pub chord_error_mm: f64,
    /// Maximum distance between two successive points, over x and y, in millimetres.
    pub max_step_mm: f64,
    /// Length by which tracks continue beyond the edge of the part, on the tangent of the surface, in millimetres.
    pub overrun_mm: f64,
    /// Length of the lead-in and of the lead-out beyond the overrun, over x and y, in millimetres. In the leads the
    /// wheel comes down and lifts off.
    pub lead_mm: f64,
    /// Radius of the curve of the lead-in and of the lead-out, in millimetres.
    pub lead_radius_mm: f64,
    /// Height above the highest point of the path at which the wheel travels, in millimetres.
    pub safe_height_mm: f64,
    /// Feed of the wheel's centre along the path.
    pub feed_mm_min: f64,
    /// Acceleration limit on a spiral, in mm/s². The feed is lowered towards the middle to stay within it.
    pub spiral_acceleration_mm_s2: Option<f64>,
}

impl PathOptions {
    /// Returns the default options for a raster path with the wheel `wheel`, the distance `track_mm` between tracks in
    /// millimetres, and the feed `feed_mm_min` in mm/min. The default values are: chord error 0.1 µm, overrun 2 mm,
    /// lead-in and lead-out 2 mm, safe height 10 mm, no tilt.
    ///
    /// The overrun is the length by which a track continues beyond the edge of the part. In the lead-in the wheel comes
    /// down onto the surface, and in the lead-out it lifts off.
    pub fn new(wheel: Wheel, track_mm: f64, feed_mm_min: f64) -> Self {
        Self {
            wheel,
            rotary: None,
            tilt: None,
            from_below: false,
            pattern: TrackPattern::Raster,
            one_way: false,
            spacing: TrackSpacing::Distance(track_mm),
            chord_error_mm: 1e-4,
            max_step_mm: 1.0,
            overrun_mm: 2.0,
            lead_mm: 2.0,
            lead_radius_mm: 5.0,
            safe_height_mm: 10.0,
            feed_mm_min,
            spiral_acceleration_mm_s2: None,
        }
    }

    /// Checks the options that do not depend on the surface.
    ///
    /// # Errors
    /// Returns [`PathError::Option`] for a number outside its range, and an error for a tilt that is not possible.
    pub(super) fn check(&self) -> Result<(), PathError> {
        let (spacing, height) = match self.spacing {
            TrackSpacing::Distance(mm) => (mm, 1.0),
            TrackSpacing::Scallop { max_height_mm: height_mm, max_track_mm: widest_mm } => (widest_mm, height_mm),
        };
        let (radius, tube) = match self.wheel {
            Wheel::Sphere { radius_mm } => (radius_mm, radius_mm),
            Wheel::Torus { ring_mm, tube_mm, .. } | Wheel::Cup { ring_mm, tube_mm, .. } => (ring_mm, tube_mm),
        };
        let above_zero = [
            ("track spacing (mm)", spacing),
            ("scallop height (mm)", height),
            ("wheel radius (mm)", radius),
            ("radius of the rim's curve (mm)", tube),
            ("chord error (mm)", self.chord_error_mm),
            ("longest step (mm)", self.max_step_mm),
            ("lead radius (mm)", self.lead_radius_mm),
            ("feed (mm/min)", self.feed_mm_min),
            ("acceleration on a spiral (mm/s2)", self.spiral_acceleration_mm_s2.unwrap_or(1.0)),
        ];
        for (key, found) in above_zero {
            if !(found > 0.0 && found.is_finite()) {
                return Err(PathError::Option { key, found, allowed: "a finite number above 0" });
            }
        }
        for (key, found) in
            [("overrun (mm)", self.overrun_mm), ("lead (mm)", self.lead_mm), ("safe height (mm)", self.safe_height_mm)]
        {
            if !(found >= 0.0 && found.is_finite()) {
                return Err(PathError::Option { key, found, allowed: "a finite number, 0 or above" });
            }
        }
        self.check_tilt()
    }

    /// Checks if the tilt of the wheel in these options is possible. Returns `Ok` if the options contain no tilt.
    ///
    /// # Errors
    /// Returns an error in each of these cases:
    ///
    /// - The machine has no rotary axis.
    /// - The wheel grinds the part from below (from -z).
    /// - The tilt angle is not finite.
    /// - The wheel is a ball, the tilt follows the surface normal, and the angle between the normal and the axis of the
    ///   head is below 2°. The ball would then touch with its pole, which has no cutting speed.
    fn check_tilt(&self) -> Result<(), PathError> {
        let Some(lean) = self.tilt else { return Ok(()) };
        if self.rotary.is_none() {
            return Err(PathError::NoRotary);
        }
        if self.from_below {
            return Err(PathError::TiltBelow);
        }
        let (TiltMode::Constant { angle_rad: found } | TiltMode::Following { lead_rad: found }) = lean;
        if !found.is_finite() {
            return Err(PathError::Option { key: "tilt (rad)", found, allowed: "a finite number" });
        }
        let is_ball = matches!(self.wheel, Wheel::Sphere { .. });
        if is_ball && matches!(lean, TiltMode::Following { .. }) && found.abs() < MIN_SPINDLE_ANGLE_SINE {
            let allowed = "at least 2° to either side: the pole of a sphere has no cutting speed";
            return Err(PathError::Option { key: "lead of a ball (rad)", found, allowed });
        }
        Ok(())
    }
}
