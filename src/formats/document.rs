//! `registration.json` and its companion files: the full result of a registration, for people and machines.

use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;

use super::error::FormatError;
use super::registration::{DeviationRow, write_column, write_deviations, write_json_atomic};
use super::run_files::CycleFile;
use regrind_core::geometry::Pose;
use regrind_core::registration::{
    Deviation, Iteration, Loss, Method, PointStatus, Registration, RegistrationOptions, WeakDirection,
};
use regrind_core::surface::{DistanceModel, Side};

/// Content of `registration.json`. The names are a contract; lengths are in millimetres, angles in radians.
#[derive(Serialize)]
#[allow(missing_docs)]
pub struct RegistrationDocument<'a> {
    pub program: ProgramVersion,
    /// True if the points come from a simulated machine; absent if that is unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub simulation: Option<bool>,
    pub nominal: NominalInput<'a>,
    pub measured: MeasuredInput<'a>,
    pub method: Method,
    pub distance: DistanceModel,
    pub loss: Loss,
    pub probe_radius_mm: Option<f64>,
    pub locked: Vec<&'static str>,
    pub cmm_from_model: [[f64; 4]; 4],
    pub standard_uncertainty: StandardUncertainty,
    pub covariance: [[f64; 6]; 6],
    pub condition: f64,
    pub weak_directions: &'a [WeakDirection],
    pub alternatives: Vec<Alternative>,
    pub warnings: &'a [String],
    pub converged: bool,
    pub iterations: usize,
    /// Value of the objective function after each accepted step of the fit.
    pub objective_mm2: Vec<f64>,
    pub points: usize,
    pub used: usize,
    pub rms_mm: f64,
    pub pv_mm: f64,
    pub residual_sigma_mm: f64,
    pub coverage: f64,
    pub side: Side,
    /// Indices of the outliers among the measured points, from 0.
    pub outliers: Vec<usize>,
    pub off_part: Vec<usize>,
    /// Points that the fit did not use, each with the reason.
    pub left_out: Vec<LeftOut>,
    /// Figures including the outliers; absent if there are no outliers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_with_left_out_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pv_with_left_out_mm: Option<f64>,
    pub trace: &'a [Iteration],
}

/// Program that wrote the file.
#[derive(Serialize)]
#[allow(missing_docs)]
pub struct ProgramVersion {
    pub name: &'static str,
    pub version: &'static str,
}

impl ProgramVersion {
    /// Returns the name and the version of this program.
    pub(super) fn this() -> Self {
        Self { name: "regrind", version: env!("CARGO_PKG_VERSION") }
    }
}

/// Nominal surface of the registration.
#[derive(Serialize)]
#[allow(missing_docs)]
pub struct NominalInput<'a> {
    pub file: &'a Path,
    pub points: usize,
    /// Description in words.
    pub kind: String,
}

/// Registered points.
#[derive(Serialize)]
#[allow(missing_docs)]
pub struct MeasuredInput<'a> {
    pub file: &'a Path,
}

/// Point that did not take part in the fit.
#[derive(Serialize)]
#[allow(missing_docs)]
pub struct LeftOut {
    /// Index of the point among the measured points, from 0.
    pub index: usize,
    pub deviation_mm: f64,
    /// `alone`: far from the surface, and no neighbour has the same deviation. `off_part`: its projection is beyond the
    /// edge of the nominal surface.
    pub reason: &'static str,
}

/// Another pose that fits about equally well.
#[derive(Serialize)]
#[allow(missing_docs)]
pub struct Alternative {
    pub cmm_from_model: [[f64; 4]; 4],
    pub rms_mm: f64,
}

/// Standard uncertainties of the pose: the square roots of the diagonal of its covariance.
#[derive(Serialize)]
#[allow(missing_docs)]
pub struct StandardUncertainty {
    pub x_mm: f64,
    pub y_mm: f64,
    pub z_mm: f64,
    pub rx_rad: f64,
    pub ry_rad: f64,
    pub rz_rad: f64,
}

impl<'a> RegistrationDocument<'a> {
    /// Builds the content of `registration.json` from a registration. `options` are the options with which it was
    /// computed, `nominal` and `measured_file` its inputs.
    pub fn new(
        registration: &'a Registration,
        options: &RegistrationOptions,
        nominal: NominalInput<'a>,
        measured_file: &'a Path,
    ) -> Self {
        let verdict = &registration.quality;
        let covariance: [[f64; 6]; 6] = std::array::from_fn(|i| std::array::from_fn(|j| verdict.covariance[(i, j)]));
        let [x_mm, y_mm, z_mm, rx_rad, ry_rad, rz_rad] = std::array::from_fn(|k| covariance[k][k].max(0.0).sqrt());
        let with = |status| {
            let deviations = registration.deviations.iter().enumerate();
            deviations.filter(|(_, d)| d.status == status).map(|(k, _)| k).collect()
        };
        let alternative =
            |(pose, rms_mm): &(Pose, f64)| Alternative { cmm_from_model: pose.to_rows(), rms_mm: *rms_mm };
        let names = ["x", "y", "z", "rx", "ry", "rz"];
        Self {
            program: ProgramVersion::this(),
            simulation: None,
            nominal,
            measured: MeasuredInput { file: measured_file },
            method: options.method,
            distance: options.distance_model,
            loss: options.loss,
            probe_radius_mm: (options.probe_radius_mm > 0.0).then_some(options.probe_radius_mm),
            locked: names.into_iter().zip(options.locked).filter(|(_, locked)| *locked).map(|(name, _)| name).collect(),
            cmm_from_model: registration.cmm_from_model.to_rows(),
            standard_uncertainty: StandardUncertainty { x_mm, y_mm, z_mm, rx_rad, ry_rad, rz_rad },
            covariance,
            condition: verdict.condition,
            weak_directions: &verdict.weak_directions,
            alternatives: verdict.alternatives.iter().map(alternative).collect(),
            warnings: &verdict.warnings,
            converged: verdict.converged,
            iterations: verdict.iterations,
            objective_mm2: registration.trace.iter().filter(|i| i.accepted).map(|i| i.objective_mm2).collect(),
            points: registration.deviations.len(),
            used: verdict.inliers,
            rms_mm: verdict.rms_mm,
            pv_mm: verdict.pv_mm,
            residual_sigma_mm: verdict.residual_sigma_mm,
            coverage: verdict.coverage,
            side: registration.side,
            outliers: with(PointStatus::Outlier),
            off_part: with(PointStatus::OffPart),
            left_out: registration.deviations.iter().enumerate().filter_map(left_out).collect(),
            rms_with_left_out_mm: registration.figures_with_outliers().map(|with| with.rms_mm),
            pv_with_left_out_mm: registration.figures_with_outliers().map(|with| with.pv_mm),
            trace: &registration.trace,
        }
    }

    /// Checks that every number of the document is finite, because JSON has neither NaN nor infinity.
    ///
    /// # Errors
    /// The description of the first value that is not finite, such as "the pose".
    pub fn check(&self) -> Result<(), &'static str> {
        let finite = |numbers: &[f64]| numbers.iter().all(|v| v.is_finite());
        let step = |i: &Iteration| finite(&[i.objective_mm2, i.step, i.ball_radius]);
        let checks = [
            ("the pose", finite(self.cmm_from_model.as_flattened())),
            ("the covariance", finite(self.covariance.as_flattened())),
            ("the condition", self.condition.is_finite()),
            ("a figure of the deviations", finite(&[self.rms_mm, self.pv_mm, self.residual_sigma_mm, self.coverage])),
            ("the deviation of an outlier", self.left_out.iter().all(|of| of.deviation_mm.is_finite())),
            ("the trace", self.trace.iter().all(step)),
            ("a weak direction", self.weak_directions.iter().all(|w| w.sigma_mm.is_none_or(f64::is_finite))),
            (
                "an alternative pose",
                self.alternatives.iter().all(|a| finite(a.cmm_from_model.as_flattened()) && a.rms_mm.is_finite()),
            ),
        ];
        checks.into_iter().find(|(_, finite)| !finite).map_or(Ok(()), |(what, _)| Err(what))
    }
}

fn left_out((index, deviation): (usize, &Deviation)) -> Option<LeftOut> {
    let reason = match deviation.status {
        PointStatus::Outlier => "alone",
        PointStatus::OffPart => "off_part",
        _ => return None,
    };
    Some(LeftOut { index, deviation_mm: deviation.deviation_mm, reason })
}

/// Writes three files into `folder`. `deviations.csv` receives the `deviations` of the points,
/// `deviation_uncertainty.csv` receives their uncertainties in mm, and `registration.json` receives `document`. The
/// JSON file is written last. If it exists, the two CSV files are complete.
///
/// # Errors
/// A file that cannot be written; a deviation that is not finite.
pub fn save_registration(
    folder: &Path,
    document: &RegistrationDocument,
    deviations: &[Deviation],
) -> Result<(), FormatError> {
    let (rows, column) = rayon::join(
        || {
            let rows: Vec<DeviationRow> = deviations.par_iter().map(DeviationRow::from).collect();
            write_deviations(folder.join(CycleFile::Deviations.name()), &rows)
        },
        || {
            let column: Vec<f64> = deviations.iter().map(|d| d.uncertainty_mm).collect();
            write_column(folder.join(CycleFile::DeviationUncertainty.name()), "uncertainty_mm", &column)
        },
    );
    rows.and(column)?;
    write_json_atomic(folder.join(CycleFile::Registration.name()), document)
}

impl From<&Deviation> for DeviationRow {
    fn from(deviation: &Deviation) -> Self {
        Self {
            point_mm: deviation.point.into(),
            normal: deviation.normal.into(),
            deviation_mm: deviation.deviation_mm,
            used: deviation.status == PointStatus::Inlier,
        }
    }
}
