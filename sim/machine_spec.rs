//! Errors of the machines of a simulated world. The defaults are those of the class `shipped`.

use serde::{Deserialize, Serialize};

use crate::Vec3;

/// Reference temperature, at which lengths equal those of the drawing, in °C.
pub(crate) const REFERENCE_C: f64 = 20.0;

/// Errors of the grinder.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct GrinderSpec {
    /// True radius of the wheel minus the radius stated in the first pass. Later statements do not change the true
    /// radius.
    pub wheel_radius_error_um: f64,
    /// Offset of the wheel in x and y.
    pub setting_error_um: [f64; 2],
    /// Height by which the wheel is set too high.
    pub setting_error_z_um: f64,
    /// Tilt of the part in the grinder about x and y of its own frame.
    pub part_tilt_urad: [f64; 2],
    /// Straightness along x: amplitudes of the second and third Legendre polynomial over the part.
    pub straightness_x_um: [f64; 2],
    /// Straightness along y: amplitudes of the same polynomials.
    pub straightness_y_um: [f64; 2],
    /// Amplitude of the periodic error of the screw along x.
    pub periodic_um: f64,
    /// Pitch of the screw.
    pub periodic_pitch_mm: f64,
    /// RMS of a fixed random waviness.
    pub waviness_um: f64,
    /// Correlation length of the waviness.
    pub waviness_correlation_mm: f64,
    /// Lag along the path at 1000 mm/min, proportional to the feed.
    pub following_um: f64,
    /// Growth of the surface left by the wearing wheel, over one finishing stroke.
    pub wear_um: f64,
    /// Fast wear of the freshly dressed wheel.
    pub break_in_um: f64,
    /// Number of finishing strokes after which 1/e of the fast wear is still to come; 0 for no fast wear.
    pub break_in_share: f64,
    /// The wheel is dressed before every pass; otherwise its fast wear is over after the first.
    pub dressed_each_pass: bool,
    /// Growth of the spindle at its steady temperature.
    pub thermal_um: f64,
    /// Time constant of the growth of the spindle.
    pub thermal_tau_s: f64,
    /// Share of the excess height that remains after a pass, mu.
    pub error_copying: f64,
    /// The wheel is a ball of the radius that the pass states, and leaves grooves around its tracks; otherwise it is
    /// straight across them.
    pub scallops: bool,
    /// RMS of the random part drawn for every pass.
    pub repeatability_um: f64,
    /// Correlation length of the random part.
    pub repeatability_correlation_mm: f64,
    /// Travel of the wheel from the middle of the machine in x and y.
    pub travel_mm: [f64; 2],
    /// Maximum feed.
    pub max_feed_mm_min: f64,
    /// Maximum displacement of a map.
    pub max_map_um: f64,
}

impl Default for GrinderSpec {
    fn default() -> Self {
        Self {
            wheel_radius_error_um: 90.0,
            setting_error_um: [12.0, -9.0],
            setting_error_z_um: 0.0,
            part_tilt_urad: [0.0; 2],
            straightness_x_um: [-6.0, -4.5],
            straightness_y_um: [-4.5, -3.0],
            periodic_um: 0.4,
            periodic_pitch_mm: 20.0,
            waviness_um: 0.8,
            waviness_correlation_mm: 18.0,
            following_um: 0.1,
            wear_um: 4.0,
            break_in_um: 2.0,
            break_in_share: 0.08,
            dressed_each_pass: true,
            thermal_um: 4.0,
            thermal_tau_s: 1200.0,
            error_copying: 0.15,
            scallops: true,
            repeatability_um: 0.4,
            repeatability_correlation_mm: 14.0,
            travel_mm: [250.0, 250.0],
            max_feed_mm_min: 20_000.0,
            max_map_um: 500.0,
        }
    }
}

/// Pose of the part on the measuring machine, and errors of the machine.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct CmmSpec {
    /// Origin of the model frame in the machine's frame.
    pub translation_mm: Vec3,
    /// Rotation of the part about x, then y, then z.
    pub rotation_deg: Vec3,
    /// Standard deviation of the part's position from loading to loading, along each axis.
    pub loading_shift_um: f64,
    /// Standard deviation of the part's angles from loading to loading.
    pub loading_turn_deg: f64,
    /// Standard deviation of a reported coordinate, on each axis.
    pub noise_um: f64,
    /// Share of the touches that are outliers.
    pub outlier_share: f64,
    /// Largest shift of an outlier.
    pub outlier_um: f64,
    /// Share of the touches that are missed.
    pub not_found_share: f64,
    /// True radius of the ball minus the radius that the plan states.
    pub probe_radius_error_um: f64,
    /// Temperature of the part while it is measured.
    pub part_temperature_c: f64,
    /// Thermal expansion of the part per kelvin.
    pub cte_per_k: f64,
    /// Radius of the reference sphere on the table.
    pub sphere_radius_mm: f64,
    /// Centre of the reference sphere in the machine's frame.
    pub sphere_centre_mm: Vec3,
    /// Minimum coordinates of the ball's centre.
    pub min_travel_mm: Vec3,
    /// Maximum coordinates of the ball's centre.
    pub max_travel_mm: Vec3,
    /// Time for the touch of one point.
    pub seconds_per_point: f64,
    /// Speed of the travel from one point to the next.
    pub travel_mm_s: f64,
    /// Maximum number of touches before the search begins in one measurement.
    pub max_unexpected_touches: u32,
    /// Points are sent as 32-bit counts of a nanometre (format 2) instead of floats (format 1).
    pub scaled_points: bool,
}

impl Default for CmmSpec {
    fn default() -> Self {
        Self {
            translation_mm: [0.25, -0.2, 0.15],
            rotation_deg: [0.1, -0.08, 0.08],
            loading_shift_um: 20.0,
            loading_turn_deg: 0.005,
            noise_um: 0.3,
            outlier_share: 0.0,
            outlier_um: 200.0,
            not_found_share: 0.0,
            probe_radius_error_um: 0.0,
            part_temperature_c: REFERENCE_C,
            cte_per_k: 0.55e-6,
            sphere_radius_mm: 12.5,
            sphere_centre_mm: [0.0, 120.0, 20.0],
            min_travel_mm: [-500.0, -500.0, -300.0],
            max_travel_mm: [500.0, 500.0, 400.0],
            seconds_per_point: 1.0,
            travel_mm_s: 100.0,
            max_unexpected_touches: 20,
            scaled_points: false,
        }
    }
}
