//! What of the deviations a parameter of the machine explains: wheel radius, wheel setting, wear along the path.
//!
//! A parameter changes the surface in a way that is known beforehand (p and q are the slopes of the nominal surface, n its
//! unit normal):
//!
//! ```text
//!  wheel radius   -dR (1/nz - 1)     dR the true radius less the stated one: a larger wheel cuts deeper on slopes
//!  setting        ex p nz, ey q nz   the wheel off along x or y
//!  wear           w t                t the progress along the path, 0 to 1: the surface rises as the wheel wears
//! ```
//!
//! Registration has taken out of the deviations whatever a motion of the part can explain, so the six motions are fitted along, as nuisance.
//! That costs what looks like a motion: a spherical wheel that is off along x leaves exactly the surface of a part that is off along
//! x, and can only be seen where the part is held by a datum and that motion is not free.
//!
//! **Uncertainty.** What is left after the fit is form, not noise: neighbouring points are off together, and the usual formula would be
//! far too sure. The surface is cut into tiles and fitted again without each of them in turn; from how the values move the jackknife tells
//! how they would scatter from part to part, whatever happens within a tile. Tiles of several sizes are tried and the largest
//! uncertainty counts. Form as long as the part itself cannot be known from one part, and no formula brings it in.
//!
//! **What is offered.** Parameters below three times their uncertainty are dropped, the least clear first, and the others fitted
//! again without it, until all that are left are clear.

use nalgebra::{DMatrix, DVector};
use serde::Serialize;
use thiserror::Error;

use crate::geometry::{Point, Vector, bounds};

/// Fewer points than this say nothing about ten unknowns.
const LEAST_POINTS: usize = 30;
/// A normal must have so much of z: the wheel comes from above.
const LEAST_NZ: f64 = 0.05;
/// A column that keeps less than this share of itself beside the others cannot be told apart from them.
const LEAST_OWN: f64 = 0.02;
/// A parameter is offered where it is so many times its standard uncertainty.
const SIGNIFICANT: f64 = 3.0;
/// Another column is named where it makes up so much of one that cannot be told apart.
const NAMED: f64 = 0.2;
/// The larger side of the part is cut into so many tiles.
const TILES: [f64; 4] = [3.0, 4.0, 6.0, 9.0];
/// A dozen tiles know their scatter badly, and form longer than a tile makes them too sure: over simulated parts with form of 5 to 18 mm
/// correlation length the plain jackknife was off by factors of 0.7 to 1.9.
const FEW_TILES: f64 = 1.5;
/// A mean square effect below this is rounding.
const NOTHING: f64 = 1e-18;

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
    /// How the wheel's radius comes out.
    pub wheel_term: WheelTerm,
}

impl ParameterOptions {
    /// All six motions free.
    pub fn new(wheel_radius_mm: f64) -> Self {
        Self { wheel_radius_mm, free_motions: [true; 6], wheel_term: WheelTerm::default() }
    }
}

/// A parameter that is looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ParameterKind {
    /// True radius of the wheel less the stated one.
    WheelRadius,
    /// How far the wheel is off along x.
    SettingX,
    /// How far the wheel is off along y.
    SettingY,
    /// By how much the surface rises over the whole path.
    Wear,
}

/// What was found of one parameter.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Parameter {
    /// Which.
    pub kind: ParameterKind,
    /// Its value in millimetres; 0 where it cannot be told.
    pub value_mm: f64,
    /// Its standard uncertainty in millimetres; 0 where it cannot be told.
    pub sigma_mm: f64,
    /// Share of its effect that nothing else here could make, from 0 to 1.
    pub own_share: f64,
    /// What it cannot be told apart from, in words; empty where it can.
    pub alike: Vec<String>,
    /// Whether it should be corrected as a parameter: it can be told, and it is three times its uncertainty.
    pub offered: bool,
    /// By how much the root mean square falls when it is corrected beside the others that are offered, in millimetres; 0 where it is not offered.
    pub removes_rms_mm: f64,
    /// What to do, for people.
    #[serde(rename = "words")]
    pub message: String,
}

/// Parameters and what is left without those that are offered.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// In the order of [`ParameterKind`].
    pub found: Vec<Parameter>,
    /// Root mean square of the deviations without what the free motions explain, in millimetres.
    pub rms_mm: f64,
    /// The same without the parameters that are offered.
    pub rest_rms_mm: f64,
    /// What is left at every point once the offered parameters are corrected and the part is registered anew, in millimetres: form and noise.
    pub rest_mm: Vec<f64>,
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
}

/// Separates by least squares what parameters explain of deviations.
///
/// Shapes: contacts in any order; `progress` from 0 to 1 along the path at each, or `None` for a raster whose tracks follow each other
/// along y. Frames: the model frame. Units: millimetres. Equation: deviation = motion + sum of parameters times their columns + rest.
///
/// # Errors
/// Too few points, values that are not finite, normals that do not look up, a radius that is not above 0.
pub fn parameters(
    contacts: &[Contact],
    progress: Option<&[f64]>,
    options: &ParameterOptions,
) -> Result<Parameters, ParameterError> {
    check(contacts, progress, options)?;
    let motions = motions(contacts, options.free_motions);
    let candidates = candidates(contacts, progress, options.wheel_term);
    let deviations: Vec<f64> = contacts.iter().map(|c| c.deviation_mm).collect();
    let unseen = Basis::of(motions.iter().map(|m| &m.values));
    let rms_mm = rms(&unseen.without(&deviations));
    let (separable, own_shares) = separable(&motions, &candidates);
    let tilings = tilings(contacts);
    let estimator = Estimator { unseen: &unseen, candidates: &candidates, deviations: &deviations, tilings };
    let (estimates, offered) = estimator.backwards(&separable);
    let left = |but: Option<usize>| {
        let taken = (0..candidates.len()).filter(|&j| offered[j] && Some(j) != but);
        let rest = taken.fold(deviations.clone(), |rest, j| less(&rest, estimates[j][0], &candidates[j].values));
        unseen.without(&rest)
    };
    let rest_mm = left(None);
    let rest_rms_mm = rms(&rest_mm);
    let mut found = Vec::new();
    for (k, candidate) in candidates.iter().enumerate() {
        let [value_mm, sigma_mm] = estimates[k];
        let mut parameter = Parameter {
            kind: candidate.kind,
            value_mm,
            sigma_mm,
            own_share: own_shares[k],
            alike: if separable[k] { Vec::new() } else { alike(k, &motions, &candidates) },
            offered: offered[k],
            removes_rms_mm: if offered[k] { rms(&left(Some(k))) - rest_rms_mm } else { 0.0 },
            message: String::new(),
        };
        parameter.message = message(&parameter, rest_rms_mm, options.wheel_radius_mm);
        found.push(parameter);
    }
    Ok(Parameters { found, rms_mm, rest_rms_mm, rest_mm })
}

fn check(contacts: &[Contact], progress: Option<&[f64]>, options: &ParameterOptions) -> Result<(), ParameterError> {
    let points = contacts.len();
    let radius_mm = options.wheel_radius_mm;
    if !(radius_mm > 0.0 && radius_mm.is_finite()) {
        return Err(ParameterError::WheelRadius { radius_mm });
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

/// The effect of one unit of something at every point.
struct Column<K> {
    kind: K,
    values: Vec<f64>,
}

const MOTIONS: [&str; 6] = [
    "a shift of the part along x",
    "a shift of the part along y",
    "a shift of the part along z",
    "a tilt of the part about x",
    "a tilt of the part about y",
    "a turn of the part about z",
];

fn motions(contacts: &[Contact], free: [bool; 6]) -> Vec<Column<&'static str>> {
    let middle = contacts.iter().fold(Vector::zeros(), |sum, c| sum + c.point.coords) / contacts.len() as f64;
    let effect = |c: &Contact, k: usize| match k {
        0..3 => c.normal[k],
        _ => (c.point.coords - middle).cross(&c.normal)[k - 3],
    };
    (0..6)
        .filter(|&k| free[k])
        .map(|k| Column { kind: MOTIONS[k], values: contacts.iter().map(|c| effect(c, k)).collect() })
        .collect()
}

fn candidates(contacts: &[Contact], progress: Option<&[f64]>, term: WheelTerm) -> Vec<Column<ParameterKind>> {
    let each = |f: &dyn Fn(&Contact) -> f64| contacts.iter().map(f).collect::<Vec<f64>>();
    let wheel = |c: &Contact| match term {
        WheelTerm::InHeight => 1.0 - 1.0 / c.normal.z,
        WheelTerm::AlongNormal => c.normal.z - 1.0,
    };
    let [[_, low], [_, high]] = over_xy(contacts);
    let along_y = |c: &Contact| (c.point.y - low) / (high - low).max(f64::MIN_POSITIVE);
    let wear = progress.map_or_else(|| each(&along_y), <[f64]>::to_vec);
    vec![
        Column { kind: ParameterKind::WheelRadius, values: each(&wheel) },
        // p nz = -nx
        Column { kind: ParameterKind::SettingX, values: each(&|c| -c.normal.x) },
        Column { kind: ParameterKind::SettingY, values: each(&|c| -c.normal.y) },
        Column { kind: ParameterKind::Wear, values: wear },
    ]
}

fn over_xy(contacts: &[Contact]) -> [[f64; 2]; 2] {
    bounds(contacts.iter().map(|c| [c.point.x, c.point.y]))
}

/// Orthonormal columns.
struct Basis {
    columns: Vec<Vec<f64>>,
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

fn less(values: &[f64], factor: f64, column: &[f64]) -> Vec<f64> {
    values.iter().zip(column).map(|(v, c)| v - factor * c).collect()
}

fn rms(values: &[f64]) -> f64 {
    (dot(values, values) / values.len() as f64).sqrt()
}

impl Basis {
    /// Gram-Schmidt, twice over; columns that add nothing are left out.
    fn of<'a>(columns: impl Iterator<Item = &'a Vec<f64>>) -> Self {
        let mut basis = Self { columns: Vec::new() };
        for column in columns {
            let size = dot(column, column).sqrt();
            let mut own = basis.without(column);
            let left = dot(&own, &own).sqrt();
            if left > 1e-7 * size {
                own.iter_mut().for_each(|v| *v /= left);
                basis.columns.push(own);
            }
        }
        basis
    }

    /// Returns what of a column none of these makes.
    fn without(&self, column: &[f64]) -> Vec<f64> {
        let mut own = column.to_vec();
        for _ in 0..2 {
            for unit in &self.columns {
                let share = dot(unit, &own);
                own.iter_mut().zip(unit).for_each(|(v, u)| *v -= share * u);
            }
        }
        own
    }
}

/// Returns which candidates can be told from the motions and from each other, and how much of each is its own.
fn separable(motions: &[Column<&'static str>], candidates: &[Column<ParameterKind>]) -> (Vec<bool>, Vec<f64>) {
    let all = 0..candidates.len();
    let share = |k: usize, others: &dyn Fn(usize) -> bool| {
        let others = (0..candidates.len()).filter(|&j| j != k && others(j)).map(|j| &candidates[j].values);
        own_share(&candidates[k].values, &Basis::of(motions.iter().map(|m| &m.values).chain(others)))
    };
    let from_motions: Vec<bool> = all.clone().map(|k| share(k, &|_| false) > LEAST_OWN).collect();
    let shares: Vec<f64> = all.clone().map(|k| share(k, &|j| from_motions[j])).collect();
    (all.map(|k| from_motions[k] && shares[k] > LEAST_OWN).collect(), shares)
}

fn own_share(column: &[f64], others: &Basis) -> f64 {
    let own = others.without(column);
    let size = dot(column, column);
    // A level surface shows nothing of the wheel's radius but rounding.
    if size > NOTHING * column.len() as f64 { (dot(&own, &own) / size).sqrt() } else { 0.0 }
}

/// Least squares of motions and candidates, with the jackknife over tiles.
struct Estimator<'a> {
    unseen: &'a Basis,
    candidates: &'a [Column<ParameterKind>],
    deviations: &'a [f64],
    tilings: Vec<Vec<u32>>,
}

impl Estimator<'_> {
    /// Returns value and standard uncertainty of every candidate, and whether it is offered.
    fn backwards(&self, separable: &[bool]) -> (Vec<[f64; 2]>, Vec<bool>) {
        let mut estimates = vec![[0.0; 2]; self.candidates.len()];
        let mut kept = separable.to_vec();
        while kept.contains(&true) {
            let chosen: Vec<usize> = (0..kept.len()).filter(|&k| kept[k]).collect();
            for (&k, estimate) in chosen.iter().zip(self.fit(&chosen)) {
                estimates[k] = estimate;
            }
            let clear = |k: usize| estimates[k][0].abs() / estimates[k][1].max(f64::MIN_POSITIVE);
            let least = chosen.into_iter().min_by(|a, b| clear(*a).total_cmp(&clear(*b)));
            match least.filter(|&k| clear(k) <= SIGNIFICANT) {
                Some(k) => kept[k] = false,
                None => break,
            }
        }
        (estimates, kept)
    }

    /// Fits the chosen candidates beside the motions.
    fn fit(&self, chosen: &[usize]) -> Vec<[f64; 2]> {
        // Unit columns; of a candidate only what motions do not make, which changes no value.
        let own: Vec<Vec<f64>> = chosen.iter().map(|&k| self.unseen.without(&self.candidates[k].values)).collect();
        let sizes: Vec<f64> = own.iter().map(|own| dot(own, own).sqrt()).collect();
        let unit = |(own, size): (&Vec<f64>, &f64)| own.iter().map(|v| v / size).collect::<Vec<f64>>();
        let columns: Vec<Vec<f64>> =
            self.unseen.columns.iter().cloned().chain(own.iter().zip(&sizes).map(unit)).collect();
        let first = columns.len() - chosen.len();
        let all = Sums::of(&columns, self.deviations);
        let Some(values) = all.solved() else { return vec![[0.0; 2]; chosen.len()] };
        let mut variances = self.white(&columns, &all, &values);
        for tiling in &self.tilings {
            let jackknifed = jackknife(&columns, self.deviations, &all, &values, tiling);
            variances.iter_mut().zip(&jackknifed).for_each(|(v, j)| *v = v.max(FEW_TILES * FEW_TILES * j));
        }
        (0..chosen.len()).map(|k| [values[first + k] / sizes[k], variances[first + k].sqrt() / sizes[k]]).collect()
    }

    /// Returns the variances that there would be if every point were off by itself.
    fn white(&self, columns: &[Vec<f64>], all: &Sums, values: &DVector<f64>) -> Vec<f64> {
        let mut rest = self.deviations.to_vec();
        columns.iter().zip(values.iter()).for_each(|(column, value)| rest = less(&rest, *value, column));
        let free = rest.len().saturating_sub(columns.len()).max(1) as f64;
        let inverse = all.inverse();
        (0..columns.len()).map(|k| dot(&rest, &rest) / free * inverse[(k, k)].max(0.0)).collect()
    }
}

/// Normal equations.
struct Sums {
    gram: DMatrix<f64>,
    right: DVector<f64>,
}

impl Sums {
    fn of(columns: &[Vec<f64>], deviations: &[f64]) -> Self {
        let count = columns.len();
        let gram = DMatrix::from_fn(count, count, |r, c| dot(&columns[r], &columns[c]));
        Self { gram, right: DVector::from_fn(count, |r, _| dot(&columns[r], deviations)) }
    }

    fn solved(&self) -> Option<DVector<f64>> {
        let solved = self.gram.clone().cholesky()?.solve(&self.right);
        solved.iter().all(|v| v.is_finite()).then_some(solved)
    }

    fn inverse(&self) -> DMatrix<f64> {
        let count = self.right.len();
        self.gram.clone().cholesky().map_or_else(|| DMatrix::zeros(count, count), |solved| solved.inverse())
    }
}

/// Returns the variances of all values by leaving out each tile in turn: (g - 1) / g sum (value without it - value)^2.
fn jackknife(columns: &[Vec<f64>], deviations: &[f64], all: &Sums, values: &DVector<f64>, tiling: &[u32]) -> Vec<f64> {
    let tiles = tiling.iter().max().map_or(0, |most| *most as usize + 1);
    let mut of_tile = vec![Vec::new(); tiles];
    tiling.iter().enumerate().for_each(|(k, &t)| of_tile[t as usize].push(k));
    of_tile.retain(|points| !points.is_empty());
    let mut variances = vec![0.0; columns.len()];
    for points in &of_tile {
        let pick = |values: &[f64]| points.iter().map(|&k| values[k]).collect::<Vec<f64>>();
        let picked: Vec<Vec<f64>> = columns.iter().map(|c| pick(c)).collect();
        let tile = Sums::of(&picked, &pick(deviations));
        let without = Sums { gram: &all.gram - tile.gram, right: &all.right - tile.right };
        // Where a value hangs on one tile alone there is nothing to compare it with, and larger tiles say no more.
        let Some(other) = without.solved() else { continue };
        let moved = other - values;
        variances.iter_mut().zip(moved.iter()).for_each(|(sum, m)| *sum += m * m);
    }
    let share = (of_tile.len() as f64 - 1.0) / of_tile.len() as f64;
    variances.iter().map(|v| share * v).collect()
}

/// Cuts the surface into tiles of several sizes: for each the tile of every point.
fn tilings(contacts: &[Contact]) -> Vec<Vec<u32>> {
    let [low, high] = over_xy(contacts);
    let size = (high[0] - low[0]).max(high[1] - low[1]).max(f64::MIN_POSITIVE);
    let cut = |tiles: f64| {
        let counts = [0, 1].map(|k| ((high[k] - low[k]) / size * tiles).ceil().max(1.0));
        let along = |at: f64, k: usize| {
            let share = (at - low[k]) / (high[k] - low[k]).max(f64::MIN_POSITIVE);
            (share * counts[k]).floor().min(counts[k] - 1.0) as u32
        };
        contacts.iter().map(|c| along(c.point.y, 1) * counts[0] as u32 + along(c.point.x, 0)).collect()
    };
    TILES.iter().map(|tiles| cut(*tiles)).collect()
}

/// Returns in words what a candidate cannot be told apart from.
fn alike(k: usize, motions: &[Column<&'static str>], candidates: &[Column<ParameterKind>]) -> Vec<String> {
    let target = &candidates[k].values;
    let size = dot(target, target).sqrt();
    if size * size <= NOTHING * target.len() as f64 {
        return vec!["nothing at all, for it has no effect on a level surface".to_owned()];
    }
    let others: Vec<(String, &Vec<f64>)> = motions
        .iter()
        .map(|m| (m.kind.to_owned(), &m.values))
        .chain(
            candidates.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, c)| (name(c.kind).to_owned(), &c.values)),
        )
        .filter(|(_, column)| dot(column, column) > NOTHING * column.len() as f64)
        .collect();
    // Unit columns; the least-squares solution of least size shares out what several could make alike.
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
    let mut named: Vec<(f64, String)> =
        others.into_iter().zip(shares.iter()).map(|((name, _), share)| (share.abs(), name)).collect();
    named.sort_by(|a, b| b.0.total_cmp(&a.0));
    let most = named.first().map_or(0.0, |(share, _)| *share);
    named.into_iter().take(3).filter(|(share, _)| *share > NAMED * most).map(|(_, name)| name).collect()
}

fn name(kind: ParameterKind) -> &'static str {
    match kind {
        ParameterKind::WheelRadius => "wheel radius",
        ParameterKind::SettingX => "wheel setting along x",
        ParameterKind::SettingY => "wheel setting along y",
        ParameterKind::Wear => "wear along the path",
    }
}

fn message(parameter: &Parameter, rest_rms_mm: f64, wheel_radius_mm: f64) -> String {
    let (name, value_um, sigma_um) = (name(parameter.kind), 1e3 * parameter.value_mm, 1e3 * parameter.sigma_mm);
    if !parameter.alike.is_empty() {
        let alike = parameter.alike.join(" and ");
        return format!("{name}: cannot be told apart from {alike}; it is left alone");
    }
    let found = format!("{value_um:.2} um with a standard uncertainty of {sigma_um:.2} um");
    if !parameter.offered {
        return format!("{name}: {found} is no clear error; it is left alone");
    }
    let with_um = 1e3 * (rest_rms_mm + parameter.removes_rms_mm);
    let gain = format!("would remove {:.2} of {with_um:.2} um rms", 1e3 * parameter.removes_rms_mm);
    match parameter.kind {
        ParameterKind::WheelRadius => {
            let true_mm = wheel_radius_mm + parameter.value_mm;
            format!("{name}: {true_mm:.4} mm instead of {wheel_radius_mm:.4} mm {gain} (off by {found})")
        }
        ParameterKind::SettingX | ParameterKind::SettingY => {
            format!("{name}: set back by {value_um:.2} um {gain} (off by {found})")
        }
        ParameterKind::Wear => format!("{name}: allowing for {value_um:.2} um over the path {gain} (it is {found})"),
    }
}
