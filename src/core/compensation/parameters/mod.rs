//! Parameters of the machine estimated from the deviations: wheel radius, setting of the wheel, tilt of the part,
//! wear along the path.
//!
//! ```text
//!  contacts --columns--> motions | slides | parameters --GLS--> value +- U --tolerance--> compensated --> next pass
//!                           (nuisance)     (with a field)                     \-- beyond it: a person decides
//! ```
//!
//! A parameter changes the surface in a known way (p and q are the slopes of the nominal surface, n its unit normal):
//!
//! ```text
//!  wheel radius   -dR (1/nz - 1)     dR the true radius minus the stated one: a larger wheel cuts deeper on slopes
//!  setting        ex p nz, ey q nz   offset of the wheel along x or y;  ez nz  the wheel is set too high
//!  tilt           -(r x n) a         the part tilted in the grinder by a, about x or y
//!  wear           w t                t the progress along the path, 0 to 1: the surface rises as the wheel wears
//! ```
//!
//! Registration has removed from the deviations every part that a motion of the part explains, so the free motions
//! are fitted too, as nuisance. This loses effects that look like a motion. A spherical wheel that is offset along x
//! leaves exactly the surface of a part that is offset along x. It is only visible where a datum locks the part, and
//! only as well as the position of the datum is known. Slides that are not straight are fitted too, with their second
//! and third order along either axis: on a shallow part a bent slide looks very similar to a wheel of another radius.
//!
//! **Uncertainty.** The residuals are form, not noise: neighbouring points deviate together, and the usual formula
//! would give far too small uncertainties. Generalised least squares estimates the values together with the field of
//! the model of the error ([`EffectEstimates`]). The points determine the strength and range of this field, whatever
//! the parameters are.
//!
//! **Compensation.** A value beyond its expanded uncertainty is compensated by its expectation, given its stated
//! tolerance: value (1 + s^2 / t^2)^-1 for one parameter with the standard uncertainty s and the tolerance 2 t. Any
//! other value is left to the map. More than the tolerance is not compensated without a person.

mod columns;
mod corrections;
mod texts;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::geometry::{Point, Vector};
use crate::model::{EffectEstimates, ModelError, Observations, Prior};
pub use columns::Extent;
use columns::{Column, OrthonormalBasis, candidates, dot, motions, rms, slides};
pub use corrections::{ExplainedDeviation, ParameterCorrections, explained_by_parameters};

/// Minimum number of points; fewer carry no information on a dozen unknowns.
const MIN_POINTS: usize = 30;
/// Minimum z component of a normal: the wheel comes from above.
const MIN_NZ: f64 = 0.05;
/// Minimum share of a column that is independent of the others; a column with less is not separable from them.
const MIN_OWN_SHARE: f64 = 0.02;
/// Coverage factor: ratio of the expanded to the standard uncertainty.
const COVERAGE_FACTOR: f64 = 2.0;
/// Mean square of the effect of a column, in mm², below which the column contains only rounding errors.
const MIN_EFFECT_MM2: f64 = 1e-18;
/// Number of trial strengths of the prior of values without a tolerance, from the rms of the deviations down to
/// [`MIN_STRENGTH_SHARE`] of it.
const PRIOR_STRENGTHS: i32 = 25;
/// Minimum trial strength, as a share of the rms of the deviations.
const MIN_STRENGTH_SHARE: f64 = 1e-3;

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
    fn lacks_locked_sigma(&self, k: usize) -> bool {
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
    fn motion(self) -> Option<usize> {
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

/// Estimated parameters, and the residuals without those that are offered.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterEstimation {
    /// Parameters in the order of [`ParameterKind::ALL`].
    pub estimates: Vec<EstimatedParameter>,
    /// Root mean square of the deviations without the part that the free motions explain, in millimetres.
    pub rms_mm: f64,
    /// Root mean square of `residuals_mm`, in millimetres: as `rms_mm`, but also without the offered parameters.
    pub residual_rms_mm: f64,
    /// Residual at every point after correction of the offered parameters and a new registration, in millimetres:
    /// form and noise.
    pub residuals_mm: Vec<f64>,
    /// Part of the deviations that parameters and slides explain together, however it divides between them.
    pub explained: ExplainedDeviation,
}

/// Reason why the parameters cannot be estimated.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ParameterError {
    #[error(
        "{points} points are too few to separate the machine parameters from the form of the part; measure at least \
         {MIN_POINTS} points"
    )]
    TooFew { points: usize },
    #[error(
        "point number {} has a coordinate, normal or deviation that is not a finite number; do not use this \
         measurement",
        index + 1
    )]
    NotFinite { index: usize },
    #[error(
        "the surface normal at point number {} has the z component {nz:.4}; this component must be at least {MIN_NZ}, \
         because the wheel comes from above; check the orientation of the part",
        index + 1
    )]
    Normal { index: usize, nz: f64 },
    #[error(
        "{found} values of the progress along the path are given for {points} points; give one value for each point"
    )]
    Progress { found: usize, points: usize },
    #[error("the wheel radius is {radius_mm} mm; it must be above 0")]
    WheelRadius { radius_mm: f64 },
    #[error("{what} is {value}; it must be finite and {limit}")]
    Stated { what: &'static str, value: f64, limit: &'static str },
    #[error("the machine parameters cannot be separated from the form of the part: {0}")]
    Field(#[from] ModelError),
}

/// Estimates the machine parameters (wheel radius, wheel setting, tilt of the part, wear) from the deviations of the
/// part. The method is generalised least squares, with a Gaussian random field as the model of the form error.
///
/// Returns the value and the uncertainty of each parameter, and the residuals after correction of the significant
/// parameters.
///
/// `contacts` are the measured points with normal and deviation, in any order. `progress` is the progress along the
/// grinding path at each contact, from 0 (start) to 1 (end). With `None` the path is a raster whose tracks follow each
/// other along y.
///
/// Frame: the model frame. Units: millimetres, radians. Equation: deviation = motion of the part + bent guideways + sum
/// of (parameter times its effect) + random field + noise.
///
/// # Errors
/// Returns an error in each of these cases:
///
/// - There are fewer than 30 points.
/// - A coordinate, normal, deviation or progress is not finite.
/// - `progress` and `contacts` have different lengths.
/// - The z component of a normal is below 0.05.
/// - The wheel radius or a tolerance is not a finite number above 0.
/// - An uncertainty of the datum is negative or not finite.
/// - The points do not determine the random field.
pub fn estimate_parameters(
    contacts: &[SurfacePoint],
    progress: Option<&[f64]>,
    options: &ParameterOptions,
) -> Result<ParameterEstimation, ParameterError> {
    check(contacts, progress, options)?;
    let extent = Extent::from_places(contacts.iter().map(|c| [c.point.x, c.point.y]));
    let columns = Columns {
        motions: motions(contacts, options.free_motions),
        slides: slides(contacts, &extent),
        candidates: candidates(contacts, progress, options.wheel_term, &extent),
    };
    let deviations: Vec<f64> = contacts.iter().map(|c| c.deviation_mm).collect();
    let unseen = OrthonormalBasis::new(columns.motions.iter().map(|m| &m.values));
    let rms_mm = rms(&unseen.orthogonal_part(&deviations));
    let (told, own_shares) = columns.separability();
    let fitted = columns.fitted(contacts, &told, rms_mm, options)?;
    let alike = |k: usize| {
        if told[k] && !options.lacks_locked_sigma(k) { Vec::new() } else { columns.inseparable_from(k, options) }
    };
    let alike = (0..ParameterKind::COUNT).map(alike).collect();
    let mut found = fitted.parameters(alike, &own_shares, options);
    let left = |but: Option<usize>| {
        let mut rest = deviations.clone();
        for (k, parameter) in found.iter().enumerate().filter(|(k, p)| p.is_offered && Some(*k) != but) {
            rest.iter_mut().zip(&columns.candidates[k].values).for_each(|(r, c)| *r -= parameter.value * c);
        }
        unseen.orthogonal_part(&rest)
    };
    let rest_mm = left(None);
    let rest_rms_mm = rms(&rest_mm);
    let removes: Vec<f64> =
        (0..found.len()).map(|k| if found[k].is_offered { rms(&left(Some(k))) - rest_rms_mm } else { 0.0 }).collect();
    for (parameter, removes_rms_mm) in found.iter_mut().zip(removes) {
        parameter.rms_reduction_mm = removes_rms_mm;
        parameter.message = texts::message(parameter, rest_rms_mm, options);
    }
    let smooth = ExplainedDeviation::new(contacts, &extent, options, &fitted);
    Ok(ParameterEstimation {
        estimates: found,
        rms_mm,
        residual_rms_mm: rest_rms_mm,
        residuals_mm: rest_mm,
        explained: smooth,
    })
}

fn check(
    contacts: &[SurfacePoint],
    progress: Option<&[f64]>,
    options: &ParameterOptions,
) -> Result<(), ParameterError> {
    let points = contacts.len();
    let radius_mm = options.wheel_radius_mm;
    if !(radius_mm > 0.0 && radius_mm.is_finite()) {
        return Err(ParameterError::WheelRadius { radius_mm });
    }
    if let Some(value) = options.tolerances.into_iter().flatten().find(|t| !(*t > 0.0 && t.is_finite())) {
        return Err(ParameterError::Stated { what: "a tolerance of a parameter", value, limit: "above 0" });
    }
    if let Some(value) = options.locked_sigmas.into_iter().flatten().find(|u| !(*u >= 0.0 && u.is_finite())) {
        return Err(ParameterError::Stated { what: "an uncertainty of the datum", value, limit: "at least 0" });
    }
    if let Some(progress) = progress.filter(|p| p.len() != points) {
        return Err(ParameterError::Progress { found: progress.len(), points });
    }
    let finite = |k: usize| {
        let SurfacePoint { point, normal, deviation_mm } = contacts[k];
        let along = progress.map_or(0.0, |p| p[k]);
        (point.coords.sum() + normal.sum() + deviation_mm + along).is_finite()
    };
    if let Some(index) = (0..points).find(|&k| !finite(k)) {
        return Err(ParameterError::NotFinite { index });
    }
    if points < MIN_POINTS {
        return Err(ParameterError::TooFew { points });
    }
    match contacts.iter().position(|c| c.normal.z < MIN_NZ) {
        Some(index) => Err(ParameterError::Normal { index, nz: contacts[index].normal.z }),
        None => Ok(()),
    }
}

/// All columns of the fit.
struct Columns {
    motions: Vec<Column<&'static str>>,
    slides: Vec<Column<&'static str>>,
    candidates: Vec<Column<ParameterKind>>,
}

/// Fitted values of slides and candidates.
struct ColumnFit {
    /// Value of each slide and, after them, of each candidate; 0 if it was not fitted.
    values: DVector<f64>,
    covariance: DMatrix<f64>,
    /// Root mean square over the points of the effect of one unit of each column, in the order of `values`.
    sizes: Vec<f64>,
    rms_mm: f64,
    slides: usize,
}

impl Columns {
    fn nuisance(&self) -> impl Iterator<Item = &Vec<f64>> {
        self.motions.iter().chain(&self.slides).map(|c| &c.values)
    }

    /// Tests which candidate parameters can be separated from other effects. A candidate is a machine parameter that
    /// may be estimated, with its effect on the deviation at each contact. The other effects are the motions of the
    /// part, the bent guideways, and the other separable candidates.
    ///
    /// Returns two lists with one entry for each candidate. An entry of the first list is true if the candidate is
    /// separable: its independent share is above 0.02. An entry of the second list is the independent share, from 0 to
    /// 1: the part of the effect of the candidate that the other effects cannot imitate.
    ///
    /// If two candidates have the same effect, at most the first is separable.
    fn separability(&self) -> (Vec<bool>, Vec<f64>) {
        let mut told: Vec<bool> = Vec::new();
        for k in 0..self.candidates.len() {
            let before = (0..k).filter(|&j| told[j]).map(|j| &self.candidates[j].values);
            told.push(
                own_share(&self.candidates[k].values, &OrthonormalBasis::new(self.nuisance().chain(before)))
                    > MIN_OWN_SHARE,
            );
        }
        let share = |k: usize| {
            let others = (0..told.len()).filter(|&j| j != k && told[j]).map(|j| &self.candidates[j].values);
            own_share(&self.candidates[k].values, &OrthonormalBasis::new(self.nuisance().chain(others)))
        };
        let shares: Vec<f64> = (0..told.len()).map(share).collect();
        // A candidate that is no longer separable once later ones are included is dropped in their favour.
        (told.iter().zip(&shares).map(|(told, share)| *told && *share > MIN_OWN_SHARE).collect(), shares)
    }

    /// Fits the bends of the guideways and the separable candidate parameters, together with the motions of the part
    /// and a random field for the form error. Returns values and covariance of guideway bends and candidates.
    ///
    /// `told[k]` is true if candidate `k` is separable. The value of any other candidate stays 0. `rms_mm` is the root
    /// mean square of the deviations without the part that motions explain, in millimetres. If `rms_mm` is practically
    /// 0, all values are 0.
    ///
    /// # Errors
    /// Returns an error if the points do not determine the random field.
    fn fitted(
        &self,
        contacts: &[SurfacePoint],
        told: &[bool],
        rms_mm: f64,
        options: &ParameterOptions,
    ) -> Result<ColumnFit, ParameterError> {
        let slides = self.slides.len();
        let all: Vec<&Vec<f64>> =
            self.slides.iter().map(|c| &c.values).chain(self.candidates.iter().map(|c| &c.values)).collect();
        let unseen = OrthonormalBasis::new(self.motions.iter().map(|m| &m.values));
        let mut basis = OrthonormalBasis::new(self.motions.iter().map(|m| &m.values));
        let mut chosen = Vec::new();
        for k in (0..all.len()).filter(|&k| k < slides || told[k - slides]) {
            if own_share(all[k], &basis) > MIN_OWN_SHARE {
                chosen.push(k);
                basis = OrthonormalBasis::new(basis.columns.iter().chain([all[k]]));
            }
        }
        let (mut values, mut covariance) = (DVector::zeros(all.len()), DMatrix::zeros(all.len(), all.len()));
        if rms_mm * rms_mm > MIN_EFFECT_MM2 {
            let found = self.effects(contacts, &unseen, &chosen.iter().map(|&k| all[k]).collect::<Vec<_>>())?;
            let first = unseen.columns.len();
            for (a, &r) in chosen.iter().enumerate() {
                values[r] = found.values[first + a];
                for (b, &c) in chosen.iter().enumerate() {
                    covariance[(r, c)] = found.covariance[(first + a, first + b)];
                }
            }
        }
        // An error of the datum looks like the setting with the same effect, so its variance adds to that of the
        // setting.
        for (k, kind) in ParameterKind::ALL.into_iter().enumerate().filter(|(k, _)| told[*k]) {
            let held = kind.motion().filter(|&motion| !options.free_motions[motion]);
            if let Some((motion, [shift, turn])) = held.zip(options.locked_sigmas) {
                covariance[(slides + k, slides + k)] += if motion < 3 { shift * shift } else { turn * turn };
            }
        }
        let sizes = all.iter().map(|column| rms(column)).collect();
        Ok(ColumnFit { values, covariance, sizes, rms_mm, slides })
    }

    /// Estimates the coefficients of the `chosen` columns and of the motions of the part, with their covariance, by
    /// generalised least squares. A column is the effect of one unit of a parameter or guideway bend at every contact.
    ///
    /// `unseen` is an orthonormal basis of the effects of the motions. The result lists the motions first and then the
    /// chosen columns, in the given order. The coefficient of a column is the value of its parameter or bend, in
    /// millimetres or radians.
    ///
    /// # Errors
    /// Returns an error if the points do not determine the random field of the form error.
    fn effects(
        &self,
        contacts: &[SurfacePoint],
        unseen: &OrthonormalBasis,
        chosen: &[&Vec<f64>],
    ) -> Result<EffectEstimates, ModelError> {
        let n = contacts.len();
        // Scale the columns to one size, since their units differ. Their overlap with the motions changes no value.
        let sizes: Vec<f64> = chosen.iter().map(|column| rms(column)).collect();
        let of = unseen.columns.len();
        let scale = (n as f64).sqrt();
        let effects = DMatrix::from_fn(n, of + chosen.len(), |r, c| match c.checked_sub(of) {
            None => scale * unseen.columns[c][r],
            Some(c) => chosen[c][r] / sizes[c],
        });
        let places: Vec<[f64; 2]> = contacts.iter().map(|c| [c.point.x, c.point.y]).collect();
        let size_mm = Extent::from_places(places.iter().copied()).size_mm();
        let deviations_mm = contacts.iter().map(|c| c.deviation_mm).collect();
        let observed = Observations { fixed_effects: effects, ..Observations::without_effects(places, deviations_mm) };
        let mut found = EffectEstimates::estimate(&observed, &Prior::for_size(size_mm))?;
        for (c, size) in (of..).zip(&sizes) {
            found.values[c] /= size;
            found.covariance.row_mut(c).scale_mut(size.recip());
            found.covariance.column_mut(c).scale_mut(size.recip());
        }
        Ok(found)
    }

    /// Returns names, for messages to people, of the effects from which the candidate parameter with the index `k`
    /// cannot be separated.
    ///
    /// Returns one name if the cause is a datum without a stated uncertainty, or a free motion with the same effect.
    /// Otherwise returns at most three names of the motions, guideway bends and parameters that imitate the candidate
    /// best.
    fn inseparable_from(&self, k: usize, options: &ParameterOptions) -> Vec<String> {
        let before = self.candidates.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, c)| (c.kind, &c.values));
        let others = self.motions.iter().chain(&self.slides).map(|c| (c.kind.to_owned(), &c.values));
        let others: Vec<_> = others.chain(before.map(|(kind, of)| (texts::name(kind).to_owned(), of))).collect();
        let of = &self.candidates[k];
        match of.kind.motion() {
            _ if options.lacks_locked_sigma(k) => vec![texts::UNSTATED_LOCKED_SIGMA.to_owned()],
            Some(motion) if options.free_motions[motion] => vec![columns::MOTIONS[motion].to_owned()],
            _ => texts::inseparable_names(&of.values, &others),
        }
    }
}

impl ColumnFit {
    /// Returns the estimate of each parameter, in the order of [`ParameterKind::ALL`].
    ///
    /// For each parameter, `alike` holds the names of the effects from which the parameter is not separable. If this
    /// list is empty, the parameter is separable; otherwise its value and uncertainty are 0. `own_shares` holds the
    /// independent share of the effect of each parameter, from 0 to 1.
    ///
    /// In the returned estimates `message` is empty and `rms_reduction_mm` is 0. The caller sets both.
    fn parameters(
        &self,
        alike: Vec<Vec<String>>,
        own_shares: &[f64],
        options: &ParameterOptions,
    ) -> Vec<EstimatedParameter> {
        let parameter = |(k, alike): (usize, Vec<String>)| {
            let is_told = alike.is_empty();
            let variance = self.covariance[(self.slides + k, self.slides + k)].max(0.0);
            let [value, sigma] = if is_told { [self.values[self.slides + k], variance.sqrt()] } else { [0.0; 2] };
            EstimatedParameter {
                kind: ParameterKind::ALL[k],
                value,
                sigma,
                own_share: own_shares[k],
                is_offered: is_told && value.abs() > COVERAGE_FACTOR * sigma,
                inseparable_from: alike,
                compensated: 0.0,
                exceeds_tolerance: false,
                rms_reduction_mm: 0.0,
                message: String::new(),
            }
        };
        let mut found: Vec<EstimatedParameter> = alike.into_iter().enumerate().map(parameter).collect();
        let wanted = |k: &usize| {
            let tolerance_2 = options.tolerances[*k].map(|tolerance| (tolerance / COVERAGE_FACTOR).powi(2));
            tolerance_2.filter(|_| found[*k].is_offered && found[*k].kind != ParameterKind::Wear).map(|t2| (*k, t2))
        };
        let chosen: Vec<(usize, f64)> = (0..found.len()).filter_map(|k| wanted(&k)).collect();
        for ((k, _), taken) in chosen.iter().zip(self.expected(&chosen).iter()) {
            found[*k].compensated = *taken;
            found[*k].exceeds_tolerance = options.tolerances[*k].is_some_and(|tolerance| taken.abs() > tolerance);
        }
        found
    }

    /// Returns the posterior mean of the parameters in `chosen`, in the same order. `chosen` holds the index of each
    /// parameter and its prior variance.
    ///
    /// Equation: T (T + S)^-1 b. Here b is the vector of the fitted values, S is the covariance of b, and T is the
    /// diagonal matrix of the prior variances. Returns zeros if T + S is not positive definite.
    fn expected(&self, chosen: &[(usize, f64)]) -> DVector<f64> {
        let at = |k: usize| self.slides + chosen[k].0;
        let n = chosen.len();
        let told = DVector::from_fn(n, |k, _| self.values[at(k)]);
        let both = |r: usize, c: usize| self.covariance[(at(r), at(c))] + if r == c { chosen[r].1 } else { 0.0 };
        let solved = DMatrix::from_fn(n, n, both).cholesky().map(|both| both.solve(&told));
        solved.map_or_else(|| DVector::zeros(n), |solved| DVector::from_fn(n, |k, _| chosen[k].1 * solved[k]))
    }

    /// Returns the posterior mean of all guideway bends and all parameters, estimated together. The result lists the
    /// guideway bends first; a value that was not fitted is 0.
    ///
    /// The prior standard deviation of a parameter with a tolerance is half of this tolerance. All other values share
    /// one prior strength: the prior rms, in millimetres, of the effect of a value. This strength is estimated from the
    /// fitted values (empirical Bayes, Morris 1983).
    ///
    /// Equation: T (T + S)^-1 b, with the fitted values b, their covariance S and the diagonal matrix T of the prior
    /// variances. The equation is evaluated for several trial strengths, from 0.1 % to 100 % of the rms of the
    /// deviations. The result is the weighted mean over the trial strengths. The weight is the marginal likelihood of
    /// b.
    fn joint_expectation(&self, options: &ParameterOptions) -> DVector<f64> {
        let chosen: Vec<usize> = (0..self.values.len()).filter(|&k| self.covariance[(k, k)] > 0.0).collect();
        let told = DVector::from_fn(chosen.len(), |k, _| self.values[chosen[k]]);
        let stated = |k: usize| k.checked_sub(self.slides).and_then(|k| options.tolerances[k]);
        let variance = |k: usize, strength_mm: f64| match stated(k) {
            Some(tolerance) => (tolerance / COVERAGE_FACTOR).powi(2),
            None => (strength_mm / self.sizes[k]).powi(2),
        };
        let by = |strength_mm: f64| {
            let prior = DVector::from_fn(chosen.len(), |k, _| variance(chosen[k], strength_mm));
            let both = DMatrix::from_fn(chosen.len(), chosen.len(), |r, c| {
                self.covariance[(chosen[r], chosen[c])] + if r == c { prior[r] } else { 0.0 }
            });
            let factor = both.cholesky()?;
            let solved = factor.solve(&told);
            Some((prior.component_mul(&solved), -0.5 * told.dot(&solved) - 0.5 * factor.ln_determinant()))
        };
        let strengths = (0..PRIOR_STRENGTHS)
            .map(|k| self.rms_mm * MIN_STRENGTH_SHARE.powf(f64::from(k) / f64::from(PRIOR_STRENGTHS - 1)));
        let seen: Vec<_> = strengths.filter_map(by).collect();
        let top = seen.iter().map(|(_, likely)| *likely).fold(f64::NEG_INFINITY, f64::max);
        let weight = |likely: f64| (likely - top).exp();
        let whole: f64 = seen.iter().map(|(_, likely)| weight(*likely)).sum();
        let mut believed = DVector::zeros(self.values.len());
        for (values, likely) in &seen {
            for (k, value) in chosen.iter().zip(values.iter()) {
                believed[*k] += weight(*likely) / whole * value;
            }
        }
        believed
    }
}

fn own_share(column: &[f64], others: &OrthonormalBasis) -> f64 {
    let own = others.orthogonal_part(column);
    let size = dot(column, column);
    // On a level surface the effect of the wheel's radius is only rounding.
    if size > MIN_EFFECT_MM2 * column.len() as f64 { (dot(&own, &own) / size).sqrt() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fit with a slide of 2 mm rms per unit and a radius of 1 mm rms per unit, each with a standard uncertainty of
    /// 1 um, and a setting that was not fitted.
    fn fitted(values_um: [f64; 2]) -> ColumnFit {
        let [slide, radius] = values_um.map(|value| 1e-3 * value);
        ColumnFit {
            values: DVector::from_column_slice(&[slide, radius, 0.0]),
            covariance: DMatrix::from_diagonal(&DVector::from_column_slice(&[1e-6, 1e-6, 0.0])),
            sizes: vec![2.0, 1.0, 1.0],
            rms_mm: 1.0,
            slides: 1,
        }
    }

    #[test]
    fn parameter_shrinkage_uses_tolerance() {
        let mut options = ParameterOptions::new(12.5);
        options.tolerances[0] = Some(2e-3);
        let believed = |values_um: [f64; 2]| {
            let of = fitted(values_um).joint_expectation(&options);
            assert_eq!(of[2], 0.0, "what was not fitted");
            [1e3 * of[0], 1e3 * of[1]]
        };
        // A tolerance of 2 um is a standard uncertainty of 1 um, equal to that of the value: half of any value
        // remains.
        for radius_um in [0.0, 3.0, -40.0] {
            let [slide, radius] = believed([0.0, radius_um]);
            assert!((radius - 0.5 * radius_um).abs() < 1e-12 && slide == 0.0, "{slide} {radius}");
        }
        // A slide has no tolerance: far above its uncertainty all of it remains, within its uncertainty less than two
        // thirds.
        assert!((believed([100.0, 0.0])[0] - 100.0).abs() < 0.1, "{:?}", believed([100.0, 0.0]));
        assert!(believed([0.5, 0.0])[0].abs() < 0.33, "{:?}", believed([0.5, 0.0]));
        // The same with the other sign, and in another unit.
        assert_eq!(believed([-0.5, 1.0])[0], -believed([0.5, -1.0])[0]);
    }
}
