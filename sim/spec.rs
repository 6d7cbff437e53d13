//! Specification of a simulated world: its machines, its part and its faults, with the allowed range of each number.

use std::fmt;

use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Map, Value, json};

use crate::machine_class::MachineClass;
pub use crate::machine_spec::{CmmSpec, GrinderSpec};
use crate::part::{PartSpec, ShapeSpec};
use crate::point_surface::PointSurface;

/// Complete specification of a simulated world. In a table, the class of the machines gives the defaults of their keys.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(remote = "Self", default, deny_unknown_fields)]
pub struct WorldSpec {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Seconds of the machines' time per second of real time.
    pub speed: f64,
    /// Class of the machines: the errors that the tables `grinder` and `cmm` do not state.
    pub machines: MachineClass,
    /// The part.
    pub part: PartSpec,
    /// The grinder.
    pub grinder: GrinderSpec,
    /// The measuring machine.
    pub cmm: CmmSpec,
    /// Faults of the machines and of people, for trials.
    pub faults: WorldFaults,
}

impl Default for WorldSpec {
    fn default() -> Self {
        Self {
            seed: 1,
            speed: 1000.0,
            machines: MachineClass::default(),
            part: PartSpec::default(),
            grinder: GrinderSpec::default(),
            cmm: CmmSpec::default(),
            faults: WorldFaults::default(),
        }
    }
}

impl Serialize for WorldSpec {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        Self::serialize(self, serializer)
    }
}

impl<'de> Deserialize<'de> for WorldSpec {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut table = Map::deserialize(deserializer)?;
        let class = table.get("machines").map(MachineClass::deserialize).transpose().map_err(D::Error::custom)?;
        let class = class.unwrap_or_default();
        let defaults = [("grinder", json!(class.grinder())), ("cmm", json!(class.cmm()))];
        for (key, mut defaults) in defaults {
            match (&mut defaults, table.remove(key)) {
                (Value::Object(defaults), Some(Value::Object(own))) => defaults.extend(own),
                (_, Some(other)) => defaults = other,
                (_, None) => {}
            }
            table.insert(key.into(), defaults);
        }
        Self::deserialize(Value::Object(table)).map_err(D::Error::custom)
    }
}

/// Reflection or rotation that the grinder applies to a map by mistake.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
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
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
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

/// Faults of the machines and of people, for trials.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
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
    /// The part has another shape than the nominal surface: the stated one, which is then not compared.
    pub wrong_shape: bool,
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
        check_all("part.aperture", &self.part.aperture.half_mm(), 2.0, 1000.0, "2 to 1000 mm")?;
        check_all("part.aperture", &self.part.aperture.middle_mm(), -1000.0, 1000.0, "-1000 to 1000 mm")?;
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
    /// Returns an error if a point on the rim has no finite height, or if its slope is more than 10. Returns an error if
    /// the nominal surface has too few points.
    fn check_shape(&self) -> Result<(), SpecError> {
        if let ShapeSpec::Nominal { points } = &self.part.shape
            && PointSurface::through(points.to_vec()).is_none()
        {
            let limit = "at least 28 finite points that enclose an area";
            return Err(SpecError { key: "part.shape", value: points.len() as f64, limit });
        }
        let shape = self.part.shape.build();
        for [x, y] in (0..360).filter_map(|degrees| self.part.aperture.rim(f64::from(degrees).to_radians())) {
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
