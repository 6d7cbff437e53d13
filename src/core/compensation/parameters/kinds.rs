//! Kinds of machine parameters, with the options and the result of their estimation.

use serde::{Deserialize, Serialize};

use crate::geometry::{Point, Vector};

/// Minimum z component of a normal: the wheel comes from above.
pub(super) const MIN_NZ: f64 = 0.05;

/// Coverage factor: ratio of the expanded to the standard uncertainty.
pub(super) const COVERAGE_FACTOR: f64 = 2.0;

/// Mean square of the effect of a column, in mm², below which the column contains only rounding errors.
pub(super) const MIN_EFFECT_MM2: f64 = 1e-18;

/// Point of the surface and its deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Position in the model frame, in millimetres.
    pub point: Point,
    /// Outward unit normal of the nominal surface at the point.
    pub normal: Vector,
    /// Deviation, positive where material stands proud, in millimetres.
    pub deviation_mm: f64,
}

/// Effect of an error of the wheel's radius along the normal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum WheelTerm {
    /// 1/nz - 1: the wheel touches off on level ground and is guided in z.
    #[default]
    InHeight,
    /// 1 - nz: the path was offset along the normals, and the touch-off shifts it in z.
    AlongNormal,
}

/// Options of the parameter estimation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParameterOptions {
    /// Radius of the wheel as stated to the grinder, in millimetres.
    pub wheel_radius_mm: f64,
    /// Motions that registration has fitted: shifts along x, y, z, turns about x, y, z. A motion that a datum locks
    /// is not free.
    pub free_motions: [bool; 6],
    /// Standard uncertainty of the position of the part on its datum, in millimetres, and of its rotation, in
    /// radians; `None` if it is not stated, and then the datum separates no parameter.
    pub locked_sigmas: Option<[f64; 2]>,
    /// Effect of an error of the wheel's radius.
    pub wheel_term: WheelTerm,
    /// Tolerance of each parameter to compensate, in its unit, in the order of [`ParameterKind::ALL`]: the expanded
    /// uncertainty with which it is set. `None` for a parameter that is only reported.
    pub tolerances: [Option<f64>; ParameterKind::COUNT],
}

impl ParameterOptions {
    /// Returns default options in which registration fits all six motions of the part (three shifts, three rotations)
    /// and no parameter has a tolerance. So every parameter is only reported, and none is compensated.
    ///
    /// `wheel_radius_mm` is the radius of the wheel, in millimetres, as the operator states it to the grinder.
    pub fn new(wheel_radius_mm: f64) -> Self {
        Self {
            wheel_radius_mm,
            free_motions: [true; 6],
            locked_sigmas: None,
            wheel_term: WheelTerm::default(),
            tolerances: [None; ParameterKind::COUNT],
        }
    }

    /// Returns true if two conditions are met: the parameter with the index `k` in [`ParameterKind::ALL`] has the same
    /// effect as a motion of the part that a datum locks, and the uncertainty of the datum is not stated. Such a
    /// parameter cannot be separated from an error of the datum.
    pub(super) fn lacks_locked_sigma(&self, k: usize) -> bool {
        let held = |motion: usize| !self.free_motions[motion];
        ParameterKind::ALL[k].motion().is_some_and(held) && self.locked_sigmas.is_none()
    }
}

/// Kind of an estimated parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ParameterKind {
    /// True radius of the wheel minus the stated one.
    WheelRadius,
    /// Offset of the wheel along x.
    SettingX,
    /// Offset of the wheel along y.
    SettingY,
    /// Height by which the wheel is set too high.
    SettingZ,
    /// Tilt of the part in the grinder about x.
    TiltX,
    /// Tilt of the part in the grinder about y.
    TiltY,
    /// Rise of the surface over the whole path by wear; never compensated as a parameter, since the wheel wears again
    /// in the next pass.
    Wear,
}

impl ParameterKind {
    /// Number of kinds.
    pub const COUNT: usize = 7;
    /// All kinds in order: of two with the same effect the first is estimated.
    pub const ALL: [Self; Self::COUNT] =
        [Self::WheelRadius, Self::SettingX, Self::SettingY, Self::SettingZ, Self::TiltX, Self::TiltY, Self::Wear];

    /// Returns the index (0 to 5) of the motion of the part that changes the deviations in exactly the same way as this
    /// parameter, apart from the sign. Returns `None` if there is no such motion.
    pub(super) fn motion(self) -> Option<usize> {
        match self {
            Self::SettingX => Some(0),
            Self::SettingY => Some(1),
            Self::SettingZ => Some(2),
            Self::TiltX => Some(3),
            Self::TiltY => Some(4),
            Self::WheelRadius | Self::Wear => None,
        }
    }

    /// Returns true if the parameter is an angle, in radians, and false if it is a length, in millimetres.
    pub fn is_angle(self) -> bool {
        matches!(self, Self::TiltX | Self::TiltY)
    }
}

/// Estimate of one parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct EstimatedParameter {
    /// Kind of the parameter.
    pub kind: ParameterKind,
    /// Value in millimetres or radians; 0 if it is not separable.
    pub value: f64,
    /// Standard uncertainty of the value, in the same unit; 0 if it is not separable.
    pub sigma: f64,
    /// Share of its effect that nothing else in the fit explains, from 0 to 1.
    pub own_share: f64,
    /// Names of the effects that it is not separable from, for people; empty if it is separable.
    pub inseparable_from: Vec<String>,
    /// True if it should be corrected as a parameter: it is separable and beyond its expanded uncertainty.
    pub is_offered: bool,
    /// Value to compensate; 0 if it is not offered, or has no tolerance.
    pub compensated: f64,
    /// True if `compensated` exceeds the tolerance, so that a person must decide.
    pub exceeds_tolerance: bool,
    /// Reduction of the root mean square by its correction, together with the others that are offered, in
    /// millimetres; 0 if it is not offered.
    pub rms_reduction_mm: f64,
    /// Result and advice, for people.
    pub message: String,
}

/// Minimum number of points; fewer carry no information on a dozen unknowns.
pub(super) const MIN_POINTS: usize = 30;
