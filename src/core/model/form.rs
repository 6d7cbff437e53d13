//! What a registered measurement says of the form of a part, and of where its nominal frame is.
//!
//! The registration put the part where the deviations are smallest. What the part's own form did to that is told by the model: the motions
//! that the registration was free to make are its effects, the form is its field. The figures are those of the form after its own
//! best fit, over fields drawn from what the measurement leaves possible; so the scatter of the probe is taken off them, and the pose is
//! in their uncertainty.

use nalgebra::{DMatrix, Matrix3, Matrix6, SymmetricEigen, Vector6};

use rayon::prelude::*;

use super::normals::Normals;
use super::{Dense, Hyper, Lattice, ModelError, Observed, Predicted, Priors, Sparse};
use crate::geometry::{Point, Vector};
use crate::registration::{PointStatus, Registration};

/// What a registered measurement says of the form of a part.
#[derive(Clone, Debug)]
pub struct Form {
    /// How strong and how wide the form is, and how far the probe scatters.
    pub hyper: Hyper,
    /// Covariance of the pose as the place of the nominal frame: of the twist [v; omega] in the model frame, as that of the registration,
    /// which is how well the same pose would be found again. Units mm^2, mm rad, rad^2. Directions that were held have no variance.
    pub frame_covariance: Matrix6<f64>,
    /// The form after its own best fit, at every point that was used, in the order given; of a scan with more than 6,000 points at as many of
    /// them.
    pub points: Vec<FormPoint>,
    /// The figures of the form.
    pub figures: FormFigures,
    /// Whether the points show a form at all. Where they do not, the figures are known from above alone, and their intervals begin at 0.
    pub is_seen: bool,
}

/// The form at a measured point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FormPoint {
    /// Where, in the model frame.
    pub at_mm: [f64; 2],
    /// The form there and its standard uncertainty.
    pub form: Predicted,
}

/// Figures with what the measurement leaves possible of each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FormFigures {
    /// Root mean square.
    pub rms: Interval,
    /// Largest less least.
    pub pv: Interval,
    /// The same without the outermost 0.1 % at either end.
    pub pv_most_points: Interval,
}

/// A median, and the interval that holds the value with a probability of 95 %.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Interval {
    /// As probably above as below.
    pub median_mm: f64,
    /// Below it with a probability of 2.5 %.
    pub low_mm: f64,
    /// Above it with a probability of 2.5 %.
    pub high_mm: f64,
}

/// Fields that are drawn, and places at which they are looked at, at most.
const SAMPLES: usize = 1000;
const MOST_PLACES: usize = 6000;
/// Fewer tell nothing.
const FEWEST_SAMPLES: usize = 30;
/// Points whose every pair is worked with, at most; of more the grid is faster.
const MOST_DENSE: usize = 700;
/// By how much more a form has to be spoken for than none, in the logarithm of the likelihood: by chance it is so in one part of twenty.
const EVIDENCE: f64 = 2.6;
/// Points of which every pair is looked at, at most.
const MOST_PAIRED: usize = 1500;
/// A direction whose variance is less than this share of the largest was held.
const HELD: f64 = 1e-13;

impl Form {
    /// Fits the model to a registration: its deviations over x and y of the model frame.
    ///
    /// # Errors
    /// Too few points, and points that leave nothing to tell the form by.
    pub fn of(registration: &Registration, given: &Given) -> Result<Self, ModelError> {
        let used: Vec<_> = registration.deviations.iter().filter(|d| d.status == PointStatus::Used).collect();
        if used.is_empty() {
            return Err(ModelError::TooFewPoints { points: 0, least: 7 });
        }
        let motions = Motions::of(registration, used.iter().map(|d| d.point));
        let place = |point: &Point| [point.x, point.y];
        let observed = Observed {
            places: used.iter().map(|d| place(&d.point)).collect(),
            deviations_mm: used.iter().map(|d| d.deviation_mm).collect(),
            effects: motions.rows(used.iter().map(|d| (d.point, d.normal))),
        };
        // What a standard uncertainty of each adds to every point.
        let alike = DMatrix::from_fn(used.len(), 2, |r, c| match c {
            0 => given.radius_sigma_mm,
            _ => given.scale_sigma * (used[r].point - motions.centre).dot(&used[r].normal),
        });
        let priors = given.priors.unwrap_or_else(|| Priors::of_size(motions.size_mm));
        let mut told = Hyper::told(&observed, &priors)?;
        let hyper = told.likely[0].0;
        let is_seen = hyper.evidence(&observed) > EVIDENCE;
        if !is_seen {
            // What is spoken for by next to nothing is as good as what is spoken for by a little more.
            told.likely.push((told.wide, 1.0));
            told.likely.iter_mut().for_each(|(_, weight)| *weight = 1.0);
        }
        let frame_covariance = motions.to_twist(&of_the_fit(&observed, told.wide, &alike));
        let drawn = Drawn::of(&observed, &told.likely)?;
        let drawn = drawn.with_the_unknown(told.scatter_u, &alike).after_best_fit();
        Ok(Self { hyper, frame_covariance, points: drawn.points(), figures: drawn.figures(is_seen), is_seen })
    }
}

/// What the points cannot tell of themselves.
#[derive(Clone, Copy, Debug, Default)]
pub struct Given {
    /// What is known of form and scatter beforehand; without it what every part of its size is like.
    pub priors: Option<Priors>,
    /// Standard uncertainty of the radius of the probe: it moves every point along its normal alike.
    pub radius_sigma_mm: f64,
    /// Standard uncertainty of all lengths, as a share of them: that of temperature and expansion.
    pub scale_sigma: f64,
}

/// The covariance of the motions as the registration finds them, by least squares of deviations that a form makes alike: A+ (K + s^2) A+'
/// with A+ = (H'H)^-1 H' (Aitken 1935), and of what adds to all points alike. Of many points some tell the part of the form.
fn of_the_fit(observed: &Observed, hyper: Hyper, alike: &DMatrix<f64>) -> DMatrix<f64> {
    let Observed { places, effects, .. } = observed;
    let inverse = |rows: &DMatrix<f64>| {
        rows.tr_mul(rows).pseudo_inverse(f64::EPSILON).unwrap_or_else(|_| DMatrix::zeros(rows.ncols(), rows.ncols()))
    };
    let by_scatter = inverse(effects) * hyper.scatter_mm.powi(2);
    let n = places.len();
    let chosen: Vec<usize> = (0..n.min(MOST_PAIRED)).map(|k| k * n / n.min(MOST_PAIRED)).collect();
    let rows = effects.select_rows(&chosen);
    // A+, a row a point.
    let weights = &rows * inverse(&rows);
    let p = rows.ncols();
    let covered: Vec<f64> = chosen
        .par_iter()
        .flat_map_iter(|&a| {
            let mut sum = vec![0.0; p];
            for (k, &b) in chosen.iter().enumerate() {
                let covariance = hyper.field.covariance_mm2(places[a], places[b]);
                sum.iter_mut().zip(weights.row(k).iter()).for_each(|(sum, weight)| *sum += covariance * weight);
            }
            sum
        })
        .collect();
    let covered = DMatrix::from_row_slice(chosen.len(), p, &covered);
    let of_alike = weights.tr_mul(&alike.select_rows(&chosen));
    by_scatter + weights.tr_mul(&covered) + &of_alike * of_alike.transpose()
}

/// Forms that may have been, a column each, and what was observed at their places.
struct Drawn {
    forms: DMatrix<f64>,
    observed: Observed,
    /// Which of the points they are.
    chosen: Vec<usize>,
}

impl Drawn {
    /// By each of the likely parameters as many as speaks for them.
    fn of(observed: &Observed, likely: &[(Hyper, f64)]) -> Result<Self, ModelError> {
        let n = observed.places.len();
        let chosen: Vec<usize> = (0..n.min(MOST_PLACES)).map(|k| k * n / n.min(MOST_PLACES)).collect();
        let seen = observed.only(&chosen);
        let whole: f64 = likely.iter().map(|(_, weight)| weight).sum();
        let mut forms = DMatrix::zeros(chosen.len(), 0);
        for (k, (hyper, weight)) in (1..).zip(likely) {
            let count = (SAMPLES as f64 * weight / whole).round() as usize;
            if count < FEWEST_SAMPLES {
                continue;
            }
            let drawn = if n <= MOST_DENSE {
                // What was observed less scatters that may have been.
                let scatters = Dense::fit(observed, *hyper)?.scatters(count, k)?;
                DMatrix::from_fn(n, count, |r, c| observed.deviations_mm[r] - scatters[(r, c)])
            } else {
                let lattice = Lattice::over(&observed.places, hyper.field.range_mm)?;
                Sparse::fit(&lattice, observed, *hyper)?.samples(&seen.places, count, k)?
            };
            let (rows, before) = forms.shape();
            forms = forms.resize(rows, before + count, 0.0);
            forms.columns_mut(before, count).copy_from(&drawn);
        }
        Ok(Self { forms, observed: seen, chosen })
    }

    /// Takes in that the scatter is known to a share of itself only, and what adds to all points alike: a column a standard uncertainty.
    ///
    /// What a form leaves of the observations is the scatter, and that may be as much larger or smaller; the motions are taken off afterwards.
    fn with_the_unknown(mut self, scatter_u: f64, alike: &DMatrix<f64>) -> Self {
        let mut normals = Normals::new(2, 0);
        for mut form in self.forms.column_iter_mut() {
            let share = (scatter_u * normals.next()).exp() - 1.0;
            let times: Vec<f64> = (0..alike.ncols()).map(|_| normals.next()).collect();
            for ((value, observed), &row) in form.iter_mut().zip(&self.observed.deviations_mm).zip(&self.chosen) {
                let more: f64 = times.iter().zip(alike.row(row).iter()).map(|(times, one)| times * one).sum();
                *value -= share * (observed - *value) + more;
            }
        }
        self
    }

    /// Each form after its own best fit.
    fn after_best_fit(mut self) -> Self {
        if self.observed.effects.ncols() > 0 {
            let base = self.observed.effects.clone().qr().q();
            let fitted: DMatrix<f64> = &base * base.tr_mul(&self.forms);
            self.forms -= fitted;
        }
        self
    }

    fn points(&self) -> Vec<FormPoint> {
        let count = self.forms.ncols() as f64;
        let of = |(k, at_mm): (usize, &[f64; 2])| {
            let row = self.forms.row(k);
            let mean_mm = row.sum() / count;
            let sigma_mm = (row.iter().map(|v| (v - mean_mm).powi(2)).sum::<f64>() / (count - 1.0)).sqrt();
            FormPoint { at_mm: *at_mm, form: Predicted { mean_mm, sigma_mm } }
        };
        self.observed.places.iter().enumerate().map(of).collect()
    }

    /// The figures; where no form is seen they are known from above alone.
    fn figures(&self, is_seen: bool) -> FormFigures {
        let mut found: [Vec<f64>; 3] = Default::default();
        let mut sorted = Vec::with_capacity(self.forms.nrows());
        for form in self.forms.column_iter() {
            sorted.clear();
            sorted.extend(form.iter().copied());
            sorted.sort_unstable_by(f64::total_cmp);
            let n = sorted.len();
            let left_out = n / 1000;
            found[0].push((sorted.iter().map(|v| v * v).sum::<f64>() / n as f64).sqrt());
            found[1].push(sorted[n - 1] - sorted[0]);
            found[2].push(sorted[n - 1 - left_out] - sorted[left_out]);
        }
        let [rms, pv, pv_most_points] = found.map(|values| Interval::of(values, is_seen));
        FormFigures { rms, pv, pv_most_points }
    }
}

impl Interval {
    /// Of values that are equally probable.
    fn of(mut values: Vec<f64>, has_low: bool) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        Self { median_mm: at(0.5), low_mm: if has_low { at(0.025) } else { 0.0 }, high_mm: at(0.975) }
    }
}

/// The motions that the registration was free to make, about the middle of the points and in units of their size.
struct Motions {
    centre: Point,
    size_mm: f64,
    /// A column a motion.
    free: DMatrix<f64>,
}

impl Motions {
    fn of(registration: &Registration, points: impl Iterator<Item = Point> + Clone) -> Self {
        let n = points.clone().count() as f64;
        let centre = Point::from(points.clone().fold(Vector::zeros(), |sum, p| sum + p.coords) / n);
        let size_mm = (points.map(|p| (p - centre).norm_squared()).sum::<f64>() / n).sqrt().max(f64::MIN_POSITIVE);
        let about = about(centre, size_mm);
        let covariance = about * registration.verdict.covariance * about.transpose();
        let SymmetricEigen { eigenvalues, eigenvectors } = covariance.symmetric_eigen();
        let seen = |k: &usize| eigenvalues[*k] > HELD * eigenvalues.max();
        let columns: Vec<Vector6<f64>> = (0..6).filter(seen).map(|k| eigenvectors.column(k).into_owned()).collect();
        let free = DMatrix::from_fn(6, columns.len(), |r, c| columns[c][r]);
        Self { centre, size_mm, free }
    }

    /// What a unit of each motion adds to the distance of each point from the surface.
    fn rows(&self, points: impl Iterator<Item = (Point, Vector)>) -> DMatrix<f64> {
        let rows: Vec<[f64; 6]> = points
            .map(|(point, normal)| {
                let arm = (point - self.centre).cross(&normal) / self.size_mm;
                [normal.x, normal.y, normal.z, arm.x, arm.y, arm.z]
            })
            .collect();
        DMatrix::from_fn(rows.len(), 6, |r, c| rows[r][c]) * &self.free
    }

    /// The covariance of the twist about the origin, of that of the free motions.
    fn to_twist(&self, covariance: &DMatrix<f64>) -> Matrix6<f64> {
        let whole = &self.free * covariance * self.free.transpose();
        let whole = Matrix6::from_fn(|r, c| whole[(r, c)]);
        // A motion is always one of a part that is there: the matrix has an inverse.
        let back = about(self.centre, self.size_mm).try_inverse().unwrap_or_else(Matrix6::identity);
        back * whole * back.transpose()
    }
}

/// Takes a twist about the origin to the motion of a centre and, in millimetres at the size, the turn about it.
fn about(centre: Point, size_mm: f64) -> Matrix6<f64> {
    let mut about = Matrix6::identity();
    // v + omega x c
    let cross: Matrix3<f64> = -centre.coords.cross_matrix();
    about.fixed_view_mut::<3, 3>(0, 3).copy_from(&cross);
    about.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * size_mm));
    about
}
