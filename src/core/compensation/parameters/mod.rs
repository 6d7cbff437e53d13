//! What of the deviations a parameter of the machine explains: wheel radius, setting of the wheel, tilt of the part, wear along the path.
//!
//! ```text
//!  contacts --columns--> motions | slides | parameters --Effects--> told +- U --tolerance--> taken --> Set of the next pass
//!                          (nuisance)        (beside a field)                  \-- beyond it: a person is asked
//! ```
//!
//! A parameter changes the surface in a way that is known beforehand (p and q are the slopes of the nominal surface, n its
//! unit normal):
//!
//! ```text
//!  wheel radius   -dR (1/nz - 1)     dR the true radius less the stated one: a larger wheel cuts deeper on slopes
//!  setting        ex p nz, ey q nz   the wheel off along x or y;  ez nz  set too high
//!  tilt           -(r x n) a         the part tilted in the grinder by a, about x or y
//!  wear           w t                t the progress along the path, 0 to 1: the surface rises as the wheel wears
//! ```
//!
//! Registration has taken out of the deviations whatever a motion of the part can explain, so the motions that are free are fitted along, as
//! nuisance. That costs what looks like a motion: a spherical wheel that is off along x leaves exactly the surface of a part that is off along
//! x, and can only be seen where the part is held by a datum, as well as that is known. So do slides that are not straight, whose second and third order along either axis are
//! fitted along too: on a shallow part a bent slide is what a wheel of another radius looks most like.
//!
//! **Uncertainty.** What is left is form, not noise: neighbouring points are off together, and the usual formula would be far too
//! sure. The values are told by generalised least squares beside the field of the model of the error ([`Effects`]), whose strength and width the points
//! tell whatever the parameters are.
//!
//! **What is taken back.** What is told beyond its expanded uncertainty is taken back by its expectation, given the tolerance that is stated
//! of it: told (1 + s^2 / t^2)^-1 for one parameter with the standard uncertainty s and the tolerance 2 t. What is not is left to the map. More than
//! its tolerance is not taken without a person.

mod columns;
mod set;
mod words;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::geometry::{Point, Vector};
use crate::model::{EffectEstimates, ModelError, Observed, Prior};
pub use columns::Extent;
use columns::{Basis, Column, candidates, dot, motions, rms, slides};
pub use set::{Set, Smooth, smooth_of};

/// Fewer points than this say nothing about a dozen unknowns.
const LEAST_POINTS: usize = 30;
/// A normal must have so much of z: the wheel comes from above.
const LEAST_NZ: f64 = 0.05;
/// A column that keeps less than this share of itself beside the others cannot be told apart from them.
const LEAST_OWN: f64 = 0.02;
/// Expanded over standard uncertainty.
const EXPANDED: f64 = 2.0;
/// A mean square effect below this is rounding.
const NOTHING: f64 = 1e-18;
/// How strong slides may be, over all that is seen: so many strengths from as much of it down to this.
const STRENGTHS: i32 = 25;
const LEAST_STRENGTH: f64 = 1e-3;

/// A point of the surface and how far it is off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Where, in the model frame, in millimetres.
    pub point: Point,
    /// Outward unit normal of the nominal surface there.
    pub normal: Vector,
    /// Positive where material stands proud, in millimetres.
    pub deviation_mm: f64,
}

/// How an error of the wheel's radius comes out along the normal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum WheelTerm {
    /// 1/nz - 1: the wheel touches off on level ground and is guided in z.
    #[default]
    InHeight,
    /// 1 - nz: the path was offset along the normals, and the touch-off shifts it in z.
    AlongNormal,
}

/// What is asked of the separation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParameterOptions {
    /// Radius of the wheel as stated to the grinder, in millimetres.
    pub wheel_radius_mm: f64,
    /// Motions that registration has fitted: shifts along x, y, z, turns about x, y, z. What a datum holds is not free.
    pub free_motions: [bool; 6],
    /// Standard uncertainty of where the datum holds the part, in millimetres, and of how it is turned, in radians; `None` where nobody states
    /// it, and then a datum tells nothing.
    pub datum: Option<[f64; 2]>,
    /// How the wheel's radius comes out.
    pub wheel_term: WheelTerm,
    /// The tolerance of each parameter that is to be taken back, in its unit, in the order of [`ParameterKind::ALL`]: the expanded
    /// uncertainty with which it is set; `None` where it is only to be told.
    pub tolerances: [Option<f64>; ParameterKind::COUNT],
}

impl ParameterOptions {
    /// All six motions free, nothing to be taken back.
    pub fn new(wheel_radius_mm: f64) -> Self {
        Self {
            wheel_radius_mm,
            free_motions: [true; 6],
            datum: None,
            wheel_term: WheelTerm::default(),
            tolerances: [None; ParameterKind::COUNT],
        }
    }

    /// Whether a parameter is told apart by a datum alone of which nobody states how well it holds.
    fn is_untold(&self, k: usize) -> bool {
        let held = |motion: usize| !self.free_motions[motion];
        ParameterKind::ALL[k].motion().is_some_and(held) && self.datum.is_none()
    }
}

/// A parameter that is looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ParameterKind {
    /// True radius of the wheel less the stated one.
    WheelRadius,
    /// How far the wheel is off along x.
    SettingX,
    /// How far the wheel is off along y.
    SettingY,
    /// By how much the wheel is set too high.
    SettingZ,
    /// By how much the part is tilted in the grinder about x.
    TiltX,
    /// The same about y.
    TiltY,
    /// By how much the surface rises over the whole path; never taken back as a parameter, as the next wheel wears anew.
    Wear,
}

impl ParameterKind {
    /// How many there are.
    pub const COUNT: usize = 7;
    /// All of them, in order: of two that look alike the first is told.
    pub const ALL: [Self; Self::COUNT] =
        [Self::WheelRadius, Self::SettingX, Self::SettingY, Self::SettingZ, Self::TiltX, Self::TiltY, Self::Wear];

    /// The motion of the part that looks exactly like it.
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

    /// Whether it is an angle, in radians; else a length, in millimetres.
    pub fn is_angle(self) -> bool {
        matches!(self, Self::TiltX | Self::TiltY)
    }
}

/// What was found of one parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// Which.
    pub kind: ParameterKind,
    /// Its value in millimetres or radians; 0 where it cannot be told.
    pub value: f64,
    /// Its standard uncertainty in the same unit; 0 where it cannot be told.
    pub sigma: f64,
    /// Share of its effect that nothing else here could make, from 0 to 1.
    pub own_share: f64,
    /// What it cannot be told apart from, in words; empty where it can.
    pub alike: Vec<String>,
    /// Whether it should be corrected as a parameter: it can be told, and it is beyond its expanded uncertainty.
    pub offered: bool,
    /// What is to be taken back of it; 0 where it is not offered, or nobody asks for it.
    pub taken: f64,
    /// Whether that is more than its tolerance, so that a person is to be asked.
    pub beyond: bool,
    /// By how much the root mean square falls when it is corrected beside the others that are offered, in millimetres; 0 where it is not offered.
    pub removes_rms_mm: f64,
    /// What to do, for people.
    pub message: String,
}

/// Parameters and what is left without those that are offered.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// In the order of [`ParameterKind::ALL`].
    pub found: Vec<Parameter>,
    /// Root mean square of the deviations without what the free motions explain, in millimetres.
    pub rms_mm: f64,
    /// The same without the parameters that are offered.
    pub rest_rms_mm: f64,
    /// What is left at every point once the offered parameters are corrected and the part is registered anew, in millimetres: form and noise.
    pub rest_mm: Vec<f64>,
    /// What of the deviations parameters and slides make together, whichever of them it is.
    pub smooth: Smooth,
}

/// Why parameters cannot be separated.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ParameterError {
    #[error("{points} points do not tell parameters from form; measure {LEAST_POINTS} at least")]
    TooFew { points: usize },
    #[error("point {} has a coordinate, normal or deviation that is not finite; the measurement must not be used", index + 1)]
    NotFinite { index: usize },
    #[error("the normal at point {} has nz = {nz:.4}; it must be {LEAST_NZ} at least, for the wheel comes from above", index + 1)]
    Normal { index: usize, nz: f64 },
    #[error("{found} values of progress are given for {points} points; there must be one for each")]
    Progress { found: usize, points: usize },
    #[error("a wheel radius of {radius_mm} mm is stated; it must be above 0")]
    WheelRadius { radius_mm: f64 },
    #[error("{what} of {value} is stated; it must be finite and {limit}")]
    Stated { what: &'static str, value: f64, limit: &'static str },
    #[error("parameters cannot be told from the form of the part: {0}")]
    Field(#[from] ModelError),
}

/// Separates what parameters explain of deviations, by generalised least squares beside a field.
///
/// Shapes: contacts in any order; `progress` from 0 to 1 along the path at each, or `None` for a raster whose tracks follow each other
/// along y. Frames: the model frame. Units: millimetres, radians. Equation: deviation = motion + slides + sum of parameters times their columns +
/// field + scatter.
///
/// # Errors
/// Too few points, values that are not finite, normals that do not look up, a radius or a tolerance that is not above 0, points that leave
/// no field to be told.
pub fn parameters(
    contacts: &[Contact],
    progress: Option<&[f64]>,
    options: &ParameterOptions,
) -> Result<Parameters, ParameterError> {
    check(contacts, progress, options)?;
    let extent = Extent::of(contacts.iter().map(|c| [c.point.x, c.point.y]));
    let columns = Columns {
        motions: motions(contacts, options.free_motions),
        slides: slides(contacts, &extent),
        candidates: candidates(contacts, progress, options.wheel_term, &extent),
    };
    let deviations: Vec<f64> = contacts.iter().map(|c| c.deviation_mm).collect();
    let unseen = Basis::of(columns.motions.iter().map(|m| &m.values));
    let rms_mm = rms(&unseen.without(&deviations));
    let (told, own_shares) = columns.told();
    let fitted = columns.fitted(contacts, &told, rms_mm, options)?;
    let alike = |k: usize| if told[k] && !options.is_untold(k) { Vec::new() } else { columns.alike(k, options) };
    let alike = (0..ParameterKind::COUNT).map(alike).collect();
    let mut found = fitted.parameters(alike, &own_shares, options);
    let left = |but: Option<usize>| {
        let mut rest = deviations.clone();
        for (k, parameter) in found.iter().enumerate().filter(|(k, p)| p.offered && Some(*k) != but) {
            rest.iter_mut().zip(&columns.candidates[k].values).for_each(|(r, c)| *r -= parameter.value * c);
        }
        unseen.without(&rest)
    };
    let rest_mm = left(None);
    let rest_rms_mm = rms(&rest_mm);
    let removes: Vec<f64> =
        (0..found.len()).map(|k| if found[k].offered { rms(&left(Some(k))) - rest_rms_mm } else { 0.0 }).collect();
    for (parameter, removes_rms_mm) in found.iter_mut().zip(removes) {
        parameter.removes_rms_mm = removes_rms_mm;
        parameter.message = words::message(parameter, rest_rms_mm, options);
    }
    let smooth = Smooth::of(contacts, &extent, options, &fitted);
    Ok(Parameters { found, rms_mm, rest_rms_mm, rest_mm, smooth })
}

fn check(contacts: &[Contact], progress: Option<&[f64]>, options: &ParameterOptions) -> Result<(), ParameterError> {
    let points = contacts.len();
    let radius_mm = options.wheel_radius_mm;
    if !(radius_mm > 0.0 && radius_mm.is_finite()) {
        return Err(ParameterError::WheelRadius { radius_mm });
    }
    if let Some(value) = options.tolerances.into_iter().flatten().find(|t| !(*t > 0.0 && t.is_finite())) {
        return Err(ParameterError::Stated { what: "a tolerance of a parameter", value, limit: "above 0" });
    }
    if let Some(value) = options.datum.into_iter().flatten().find(|u| !(*u >= 0.0 && u.is_finite())) {
        return Err(ParameterError::Stated { what: "an uncertainty of the datum", value, limit: "0 at least" });
    }
    if let Some(progress) = progress.filter(|p| p.len() != points) {
        return Err(ParameterError::Progress { found: progress.len(), points });
    }
    let finite = |k: usize| {
        let Contact { point, normal, deviation_mm } = contacts[k];
        let along = progress.map_or(0.0, |p| p[k]);
        (point.coords.sum() + normal.sum() + deviation_mm + along).is_finite()
    };
    if let Some(index) = (0..points).find(|&k| !finite(k)) {
        return Err(ParameterError::NotFinite { index });
    }
    if points < LEAST_POINTS {
        return Err(ParameterError::TooFew { points });
    }
    match contacts.iter().position(|c| c.normal.z < LEAST_NZ) {
        Some(index) => Err(ParameterError::Normal { index, nz: contacts[index].normal.z }),
        None => Ok(()),
    }
}

/// All that is fitted.
struct Columns {
    motions: Vec<Column<&'static str>>,
    slides: Vec<Column<&'static str>>,
    candidates: Vec<Column<ParameterKind>>,
}

/// What was fitted, of the columns that are not those of others again.
struct Fitted {
    /// Of each slide and of each candidate behind them: its value; 0 where it was not fitted.
    values: DVector<f64>,
    covariance: DMatrix<f64>,
    /// Root mean square of a unit of each.
    sizes: Vec<f64>,
    rms_mm: f64,
    slides: usize,
}

impl Columns {
    fn nuisance(&self) -> impl Iterator<Item = &Vec<f64>> {
        self.motions.iter().chain(&self.slides).map(|c| &c.values)
    }

    /// Returns which candidates can be told from motions, slides and those before them, and how much of each is its own beside all of these.
    fn told(&self) -> (Vec<bool>, Vec<f64>) {
        let mut told: Vec<bool> = Vec::new();
        for k in 0..self.candidates.len() {
            let before = (0..k).filter(|&j| told[j]).map(|j| &self.candidates[j].values);
            told.push(own_share(&self.candidates[k].values, &Basis::of(self.nuisance().chain(before))) > LEAST_OWN);
        }
        let share = |k: usize| {
            let others = (0..told.len()).filter(|&j| j != k && told[j]).map(|j| &self.candidates[j].values);
            own_share(&self.candidates[k].values, &Basis::of(self.nuisance().chain(others)))
        };
        let shares: Vec<f64> = (0..told.len()).map(share).collect();
        // Who can no longer be told once those behind are there goes to those.
        (told.iter().zip(&shares).map(|(told, share)| *told && *share > LEAST_OWN).collect(), shares)
    }

    /// Fits slides and candidates beside the motions and a field.
    fn fitted(
        &self,
        contacts: &[Contact],
        told: &[bool],
        rms_mm: f64,
        options: &ParameterOptions,
    ) -> Result<Fitted, ParameterError> {
        let slides = self.slides.len();
        let all: Vec<&Vec<f64>> =
            self.slides.iter().map(|c| &c.values).chain(self.candidates.iter().map(|c| &c.values)).collect();
        let unseen = Basis::of(self.motions.iter().map(|m| &m.values));
        let mut basis = Basis::of(self.motions.iter().map(|m| &m.values));
        let mut chosen = Vec::new();
        for k in (0..all.len()).filter(|&k| k < slides || told[k - slides]) {
            if own_share(all[k], &basis) > LEAST_OWN {
                chosen.push(k);
                basis = Basis::of(basis.columns.iter().chain([all[k]]));
            }
        }
        let (mut values, mut covariance) = (DVector::zeros(all.len()), DMatrix::zeros(all.len(), all.len()));
        if rms_mm * rms_mm > NOTHING {
            let found = self.effects(contacts, &unseen, &chosen.iter().map(|&k| all[k]).collect::<Vec<_>>())?;
            let first = unseen.columns.len();
            for (a, &r) in chosen.iter().enumerate() {
                values[r] = found.values[first + a];
                for (b, &c) in chosen.iter().enumerate() {
                    covariance[(r, c)] = found.covariance[(first + a, first + b)];
                }
            }
        }
        // What a datum holds badly comes out as the setting that looks like it.
        for (k, kind) in ParameterKind::ALL.into_iter().enumerate().filter(|(k, _)| told[*k]) {
            let held = kind.motion().filter(|&motion| !options.free_motions[motion]);
            if let Some((motion, [shift, turn])) = held.zip(options.datum) {
                covariance[(slides + k, slides + k)] += if motion < 3 { shift * shift } else { turn * turn };
            }
        }
        let sizes = all.iter().map(|column| rms(column)).collect();
        Ok(Fitted { values, covariance, sizes, rms_mm, slides })
    }

    /// The effects of motions and of chosen columns, in units of these.
    fn effects(
        &self,
        contacts: &[Contact],
        unseen: &Basis,
        chosen: &[&Vec<f64>],
    ) -> Result<EffectEstimates, ModelError> {
        let n = contacts.len();
        // Columns of one size: they have units of their own. What motions make of them changes no value.
        let sizes: Vec<f64> = chosen.iter().map(|column| rms(column)).collect();
        let of = unseen.columns.len();
        let scale = (n as f64).sqrt();
        let effects = DMatrix::from_fn(n, of + chosen.len(), |r, c| match c.checked_sub(of) {
            None => scale * unseen.columns[c][r],
            Some(c) => chosen[c][r] / sizes[c],
        });
        let places: Vec<[f64; 2]> = contacts.iter().map(|c| [c.point.x, c.point.y]).collect();
        let size_mm = Extent::of(places.iter().copied()).size_mm();
        let deviations_mm = contacts.iter().map(|c| c.deviation_mm).collect();
        let observed = Observed { fixed_effects: effects, ..Observed::without_effects(places, deviations_mm) };
        let mut found = EffectEstimates::estimate(&observed, &Prior::for_size(size_mm))?;
        for (c, size) in (of..).zip(&sizes) {
            found.values[c] /= size;
            found.covariance.row_mut(c).scale_mut(size.recip());
            found.covariance.column_mut(c).scale_mut(size.recip());
        }
        Ok(found)
    }

    /// Returns in words what a candidate cannot be told apart from.
    fn alike(&self, k: usize, options: &ParameterOptions) -> Vec<String> {
        let before = self.candidates.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, c)| (c.kind, &c.values));
        let others = self.motions.iter().chain(&self.slides).map(|c| (c.kind.to_owned(), &c.values));
        let others: Vec<_> = others.chain(before.map(|(kind, of)| (words::name(kind).to_owned(), of))).collect();
        let of = &self.candidates[k];
        match of.kind.motion() {
            _ if options.is_untold(k) => vec![words::NO_DATUM.to_owned()],
            Some(motion) if options.free_motions[motion] => vec![columns::MOTIONS[motion].to_owned()],
            _ => words::alike(&of.values, &others),
        }
    }
}

impl Fitted {
    /// Returns what was found of each parameter, without its message and what it removes.
    fn parameters(&self, alike: Vec<Vec<String>>, own_shares: &[f64], options: &ParameterOptions) -> Vec<Parameter> {
        let parameter = |(k, alike): (usize, Vec<String>)| {
            let is_told = alike.is_empty();
            let variance = self.covariance[(self.slides + k, self.slides + k)].max(0.0);
            let [value, sigma] = if is_told { [self.values[self.slides + k], variance.sqrt()] } else { [0.0; 2] };
            Parameter {
                kind: ParameterKind::ALL[k],
                value,
                sigma,
                own_share: own_shares[k],
                offered: is_told && value.abs() > EXPANDED * sigma,
                alike,
                taken: 0.0,
                beyond: false,
                removes_rms_mm: 0.0,
                message: String::new(),
            }
        };
        let mut found: Vec<Parameter> = alike.into_iter().enumerate().map(parameter).collect();
        let wanted = |k: &usize| {
            let tolerance_2 = options.tolerances[*k].map(|tolerance| (tolerance / EXPANDED).powi(2));
            tolerance_2.filter(|_| found[*k].offered && found[*k].kind != ParameterKind::Wear).map(|t2| (*k, t2))
        };
        let chosen: Vec<(usize, f64)> = (0..found.len()).filter_map(|k| wanted(&k)).collect();
        for ((k, _), taken) in chosen.iter().zip(self.expected(&chosen).iter()) {
            found[*k].taken = *taken;
            found[*k].beyond = options.tolerances[*k].is_some_and(|tolerance| taken.abs() > tolerance);
        }
        found
    }

    /// Returns what is expected of some of them, given the variance that is stated of each: T (T + S)^-1 b.
    fn expected(&self, chosen: &[(usize, f64)]) -> DVector<f64> {
        let at = |k: usize| self.slides + chosen[k].0;
        let n = chosen.len();
        let told = DVector::from_fn(n, |k, _| self.values[at(k)]);
        let both = |r: usize, c: usize| self.covariance[(at(r), at(c))] + if r == c { chosen[r].1 } else { 0.0 };
        let solved = DMatrix::from_fn(n, n, both).cholesky().map(|both| both.solve(&told));
        solved.map_or_else(|| DVector::zeros(n), |solved| DVector::from_fn(n, |k, _| chosen[k].1 * solved[k]))
    }

    /// Returns what is expected of all of them together: of a parameter with a tolerance by that, of what nobody states anything of by how strong all of
    /// these are, which their values tell.
    ///
    /// Equation: T (T + S)^-1 b, the mean over strengths from next to nothing up to all that is seen, each as likely as it makes b (empirical Bayes,
    /// Morris 1983).
    fn believed(&self, options: &ParameterOptions) -> DVector<f64> {
        let chosen: Vec<usize> = (0..self.values.len()).filter(|&k| self.covariance[(k, k)] > 0.0).collect();
        let told = DVector::from_fn(chosen.len(), |k, _| self.values[chosen[k]]);
        let stated = |k: usize| k.checked_sub(self.slides).and_then(|k| options.tolerances[k]);
        let variance = |k: usize, strength_mm: f64| match stated(k) {
            Some(tolerance) => (tolerance / EXPANDED).powi(2),
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
        let strengths =
            (0..STRENGTHS).map(|k| self.rms_mm * LEAST_STRENGTH.powf(f64::from(k) / f64::from(STRENGTHS - 1)));
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

fn own_share(column: &[f64], others: &Basis) -> f64 {
    let own = others.without(column);
    let size = dot(column, column);
    // A level surface shows nothing of the wheel's radius but rounding.
    if size > NOTHING * column.len() as f64 { (dot(&own, &own) / size).sqrt() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slide of 2 mm rms a unit, a radius of 1 mm and a setting that was not fitted, each known to 1 um.
    fn fitted(values_um: [f64; 2]) -> Fitted {
        let [slide, radius] = values_um.map(|value| 1e-3 * value);
        Fitted {
            values: DVector::from_column_slice(&[slide, radius, 0.0]),
            covariance: DMatrix::from_diagonal(&DVector::from_column_slice(&[1e-6, 1e-6, 0.0])),
            sizes: vec![2.0, 1.0, 1.0],
            rms_mm: 1.0,
            slides: 1,
        }
    }

    #[test]
    fn a_tolerance_and_what_is_seen_say_how_much_is_believed() {
        let mut options = ParameterOptions::new(12.5);
        options.tolerances[0] = Some(2e-3);
        let believed = |values_um: [f64; 2]| {
            let of = fitted(values_um).believed(&options);
            assert_eq!(of[2], 0.0, "what was not fitted");
            [1e3 * of[0], 1e3 * of[1]]
        };
        // A tolerance of 2 um expands a standard uncertainty of 1 um, as large as that of what was told: half of it, however much.
        for radius_um in [0.0, 3.0, -40.0] {
            let [slide, radius] = believed([0.0, radius_um]);
            assert!((radius - 0.5 * radius_um).abs() < 1e-12 && slide == 0.0, "{slide} {radius}");
        }
        // Of a slide nobody states anything: far above its uncertainty it is believed, within it less than two thirds.
        assert!((believed([100.0, 0.0])[0] - 100.0).abs() < 0.1, "{:?}", believed([100.0, 0.0]));
        assert!(believed([0.5, 0.0])[0].abs() < 0.33, "{:?}", believed([0.5, 0.0]));
        // The same by the other sign, and in another unit.
        assert_eq!(believed([-0.5, 1.0])[0], -believed([0.5, -1.0])[0]);
    }
}
