//! Specification of a simulated world: all errors of its machines and its part, with the allowed range of each number.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Vec3;
use crate::part::{Aperture, PartSpec};

/// Reference temperature, at which lengths equal those of the drawing, in °C.
pub(crate) const REFERENCE_C: f64 = 20.0;

/// Errors of the grinder.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
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

/// Complete specification of a simulated world.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct WorldSpec {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Seconds of the machines' time per second of real time.
    pub speed: f64,
    /// The part.
    pub part: PartSpec,
    /// The grinder.
    pub grinder: GrinderSpec,
    /// The measuring machine.
    pub cmm: CmmSpec,
    /// Faults, for tests.
    pub faults: WorldFaults,
}

impl Default for WorldSpec {
    fn default() -> Self {
        Self {
            seed: 1,
            speed: 1000.0,
            part: PartSpec::default(),
            grinder: GrinderSpec::default(),
            cmm: CmmSpec::default(),
            faults: WorldFaults::default(),
        }
    }
}

/// Reflection or rotation that the grinder applies to a map by mistake.
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

/// False statement of the grinder about its passes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Misreported {
    /// Nothing.
    #[default]
    Nothing,
    /// The record has the number of the previous job.
    Job,
    /// The record states a failure, although the status says that the pass is complete.
    Result,
    /// The record states 3 mm as the largest depth.
    Depth,
    /// The record states a path of -1 mm.
    Path,
    /// The record states a wheel radius that is smaller by an eighth.
    Wheel,
    /// The duration is 0.
    Duration,
}

/// Faults, for tests.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct WorldFaults {
    /// The grinder displaces to the wrong side.
    pub map_sign_flipped: bool,
    /// The grinder reflects or rotates the map.
    pub map_mirrored: Mirrored,
    /// The grinder displaces by twice the map.
    pub map_doubled: bool,
    /// The grinder grinds as if the map were zero.
    pub map_ignored: bool,
    /// The record of a pass is wrong.
    pub misreported: Misreported,
    /// The CMM reports contact points (centre less stated radius along the target's normal).
    pub returns_contact_points: bool,
    /// The header of the outbox states contact points; otherwise it states centres.
    pub contact_points_declared: bool,
    /// The CMM reports inches, and the header says millimetres.
    pub inches: bool,
    /// An axis of the CMM has the wrong sign: the reported points are mirrored in y.
    pub cmm_mirrored: bool,
    /// The part lies on the CMM turned by half a turn about z.
    pub part_turned_180: bool,
    /// There is no part in either machine.
    pub no_part: bool,
    /// The grinder holds a part of another identity than any payload names.
    pub wrong_part: bool,
    /// One record of the points holds a NaN (format 1 only).
    pub non_finite_point: bool,
    /// Number of records that are missing at the end of the points.
    pub missing_records: u32,
}

/// Value in a specification that is outside its range.
#[derive(Clone, Debug, PartialEq)]
pub struct SpecError {
    /// Key, as a path in the table.
    pub key: &'static str,
    /// Value of the key.
    pub value: f64,
    /// Allowed values.
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
    /// Checks every number of the specification.
    ///
    /// # Errors
    /// Returns the first number that is outside the range for which the simulation is valid.
    pub fn check(&self) -> Result<(), SpecError> {
        check_all("speed", &[self.speed], 1e-3, 1e6, "0.001 to 1e6")?;
        let [half_x, half_y] = self.part.aperture.half_mm();
        check_all("part.aperture", &[half_x, half_y], 2.0, 1000.0, "2 to 1000 mm")?;
        check_all("part.stock_um", &[self.part.stock_um], 0.0, 10_000.0, SIZE)?;
        check_all("part.form_error_um", &[self.part.form_error_um], 0.0, 10_000.0, SIZE)?;
        let length = self.part.form_error_correlation_mm;
        check_all("part.form_error_correlation_mm", &[length], 0.5, 10_000.0, LENGTH)?;
        for defect in &self.part.defects {
            check_all("part.defects.at_mm", &defect.at_mm, -1e3, 1e3, "-1000 to 1000 mm")?;
            check_all("part.defects.size_mm", &defect.size_mm, 0.5, 1e3, "0.5 to 1000 mm")?;
            check_all("part.defects.height_um", &[defect.height_um], -1e3, 1e3, "-1000 to 1000 um")?;
        }
        self.check_grinder()?;
        self.check_cmm()?;
        self.check_shape()
    }

    fn check_grinder(&self) -> Result<(), SpecError> {
        let g = &self.grinder;
        let signed = [
            ("grinder.wheel_radius_error_um", &[g.wheel_radius_error_um][..]),
            ("grinder.setting_error_um", &g.setting_error_um),
            ("grinder.setting_error_z_um", &[g.setting_error_z_um]),
            ("grinder.part_tilt_urad", &g.part_tilt_urad),
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
        check_all("grinder.max_feed_mm_min", &[g.max_feed_mm_min], 1.0, 5e4, "1 to 50000 mm/min")?;
        check_all("grinder.max_map_um", &[g.max_map_um], 0.0, 1e4, SIZE)
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
        check_all("cmm.min_travel_mm", &c.min_travel_mm, -2e3, 2e3, "-2000 to 2000 mm")?;
        check_all("cmm.max_travel_mm", &c.max_travel_mm, -2e3, 2e3, "-2000 to 2000 mm")?;
        check_all("cmm.seconds_per_point", &[c.seconds_per_point], 1e-3, 1e3, "0.001 to 1000 s")?;
        check_all("cmm.travel_mm_s", &[c.travel_mm_s], 0.1, 1e6, "0.1 to 1000000 mm/s")
    }

    /// Checks that the surface has a finite height and a slope of at most 10 everywhere on the part. The domain of each
    /// shape is convex, so only points on the rim of the part are checked.
    ///
    /// # Errors
    /// Returns an error if a point on the rim has no finite height, or if its slope is more than 10.
    fn check_shape(&self) -> Result<(), SpecError> {
        let (shape, [half_x, half_y]) = (self.part.shape.build(), self.part.aperture.half_mm());
        for k in 0..360 {
            let (sine, cosine) = f64::from(k).to_radians().sin_cos();
            let stretch = match self.part.aperture {
                Aperture::Circle { .. } => 1.0,
                Aperture::Rectangle { .. } => 1.0 / sine.abs().max(cosine.abs()),
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
