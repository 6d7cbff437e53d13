//! Texts about parameters for process engineers.

use nalgebra::{DMatrix, DVector};

use super::columns::dot;
use super::kinds::{COVERAGE_FACTOR, EstimatedParameter, MIN_EFFECT_MM2, ParameterKind, ParameterOptions};

/// Minimum share of another column in an inseparable column, relative to the largest share, at which a message names
/// it.
const MIN_NAMED_SHARE: f64 = 0.2;
pub(super) const UNSTATED_LOCKED_SIGMA: &str =
    "the uncertainty of the datum, which is not stated (registration.lock_uncertainty_um)";

/// Returns the English name of a parameter for messages to people, for example "wheel radius".
pub fn name(kind: ParameterKind) -> &'static str {
    match kind {
        ParameterKind::WheelRadius => "wheel radius",
        ParameterKind::SettingX => "wheel setting along x",
        ParameterKind::SettingY => "wheel setting along y",
        ParameterKind::SettingZ => "wheel setting along z",
        ParameterKind::TiltX => "tilt of the part about x",
        ParameterKind::TiltY => "tilt of the part about y",
        ParameterKind::Wear => "wear along the path",
    }
}

impl ParameterKind {
    /// Returns the English name of this parameter for messages to people, for example "wheel radius".
    pub fn name(self) -> &'static str {
        name(self)
    }

    /// Returns the unit that messages to people use for the parameter: "urad" for an angle, "um" for a length.
    pub fn unit(self) -> &'static str {
        if self.is_angle() { "urad" } else { "um" }
    }

    /// Returns the factor that converts the value of the parameter from radians or millimetres into the unit of
    /// messages ([`Self::unit`]): 1e6 for an angle, 1e3 for a length.
    pub fn display_units_per_unit(self) -> f64 {
        if self.is_angle() { 1e6 } else { 1e3 }
    }

    /// Returns the key in the table `compensation.parameters` of the recipe that turns on the compensation of this
    /// parameter. Returns `None` for wear, which is never compensated as a parameter.
    pub fn recipe_key(self) -> Option<&'static str> {
        match self {
            Self::WheelRadius => Some("wheel_radius_um"),
            Self::SettingX => Some("wheel_x_um"),
            Self::SettingY => Some("wheel_y_um"),
            Self::SettingZ => Some("wheel_z_um"),
            Self::TiltX => Some("part_tilt_x_urad"),
            Self::TiltY => Some("part_tilt_y_urad"),
            Self::Wear => None,
        }
    }
}

/// Returns the names of at most three columns of `others` that together imitate the column `target` best (least
/// squares). The largest contribution is first. A column is the effect of a parameter, motion or guideway bend at every
/// point; `others` holds pairs of name and column.
///
/// If `target` is practically 0 at all points, returns one text that says that there is no effect.
pub(super) fn inseparable_names(target: &[f64], others: &[(String, &Vec<f64>)]) -> Vec<String> {
    let size = dot(target, target).sqrt();
    if size * size <= MIN_EFFECT_MM2 * target.len() as f64 {
        return vec!["zero, because it has no effect on a level surface".to_owned()];
    }
    let others: Vec<_> = others.iter().filter(|(_, c)| dot(c, c) > MIN_EFFECT_MM2 * c.len() as f64).collect();
    // Unit columns; the least-squares solution of minimum norm divides the share between columns with the same
    // effect.
    let sizes: Vec<f64> = others.iter().map(|(_, c)| dot(c, c).sqrt()).collect();
    let count = others.len();
    let gram = DMatrix::from_fn(count, count, |r, c| dot(others[r].1, others[c].1) / (sizes[r] * sizes[c]));
    let right = DVector::from_fn(count, |r, _| dot(others[r].1, target) / (sizes[r] * size));
    let parts = gram.symmetric_eigen();
    let mut shares = DVector::zeros(count);
    for (value, vector) in parts.eigenvalues.iter().zip(parts.eigenvectors.column_iter()) {
        if *value > 1e-6 {
            shares += vector * (vector.dot(&right) / value);
        }
    }
    let mut named: Vec<(f64, &String)> =
        others.iter().zip(shares.iter()).map(|((name, _), share)| (share.abs(), name)).collect();
    named.sort_by(|a, b| b.0.total_cmp(&a.0));
    let most = named.first().map_or(0.0, |(share, _)| *share);
    named
        .into_iter()
        .take(3)
        .filter(|(share, _)| *share > MIN_NAMED_SHARE * most)
        .map(|(_, name)| name.clone())
        .collect()
}

pub(super) fn message(parameter: &EstimatedParameter, rest_rms_mm: f64, options: &ParameterOptions) -> String {
    let EstimatedParameter { kind, value, sigma, compensated: taken, .. } = *parameter;
    let (name, unit, units) = (name(kind), kind.unit(), kind.display_units_per_unit());
    if !parameter.inseparable_from.is_empty() {
        let alike = parameter.inseparable_from.join(" and ");
        return format!("{name}: cannot be separated from {alike}; the map corrects it");
    }
    let found = format!("{:.2} \u{b1} {:.2} {unit}", units * value, COVERAGE_FACTOR * units * sigma);
    if !parameter.is_offered {
        return format!("{name}: off by {found}, which is not significant; the map corrects it");
    }
    let with_um = 1e3 * (rest_rms_mm + parameter.rms_reduction_mm);
    let gain = format!("{:.2} of {with_um:.2} um rms", 1e3 * parameter.rms_reduction_mm);
    let stated = match kind {
        ParameterKind::WheelRadius => {
            let (true_mm, stated_mm) = (options.wheel_radius_mm + value, options.wheel_radius_mm);
            format!("{true_mm:.4} mm instead of {stated_mm:.4} mm, ")
        }
        _ => String::new(),
    };
    let off = format!("{name}: {stated}off by {found}, which explains {gain}");
    let key = kind.recipe_key().map(|key| format!("compensation.parameters.{key}"));
    match (key, taken) {
        (Some(key), 0.0) => {
            format!("{off}; the map corrects it; to compensate the parameter itself, set {key} to its tolerance")
        }
        (Some(_), taken) => format!("{off}; {:.2} {unit} of it are compensated", units * taken),
        (None, _) => format!("{off}; the map corrects it, because the wheel wears again in the next pass"),
    }
}
