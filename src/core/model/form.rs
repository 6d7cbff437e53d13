//! What a registered measurement says of the form of a part, and of where its nominal frame is.
//!
//! The registration put the part where the deviations are smallest. What the part's own form did to that is told by the model: the motions
//! that the registration was free to make are its effects, the form is its field. The figures are those of the form after its own
//! best fit, over fields drawn from what the measurement leaves possible; so the scatter of the probe is taken off them, and the pose is
//! in their uncertainty.

use nalgebra::{DMatrix, Matrix3, Matrix6, SymmetricEigen, Vector6};

use rayon::prelude::*;

use super::likelihood::Told;
use super::normals::Normals;
use super::spacing_mm;
use super::{AreaOptions, IsoFigures, SlopeFigures};
use super::{Dense, Hyper, Lattice, ModelError, Observed, Predicted, Priors, Sparse};
use crate::form::{IsoFits, SlopesAt};
use crate::geometry::{Point, Vector};
use crate::registration::{Deviation, PointStatus, Registration};

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
    /// Power, irregularity and their like; none where the points are too few for them.
    pub iso: Option<IsoFigures>,
    /// The slopes of the smooth form; none where the points are too few for them.
    pub slope: Option<SlopeFigures>,
    /// How well the smooth form is known: the RMS of its standard uncertainty over all places.
    pub known_mm: f64,
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
    /// Standard uncertainty of what of it is smooth: what a correction can be made by.
    pub smooth_sigma_mm: f64,
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
    /// Below it with the probability of [`Given::look_risk`]: for who looks more than once.
    #[serde(skip)]
    pub least_mm: f64,
    /// Above it with that probability.
    #[serde(skip)]
    pub most_mm: f64,
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
        let seen = Seen::of(registration, given, true)?;
        let alike = seen.motions.alike(given, seen.places());
        let drawn = Drawn::of(&seen.observed, &seen.told.likely)?;
        let alike = alike.select_rows(&drawn.chosen);
        let slope = seen.slope(given, &drawn, &alike);
        let drawn =
            drawn.with_the_scatter(&seen.observed, &seen.told, given).with_what_is_alike(&alike).after_best_fit();
        Ok(Self { slope, ..seen.form(given, &drawn) })
    }

    /// Tells the parameters of the form by the points alone, whatever is expected of it beforehand: what a part teaches of those that
    /// follow. None where no form is seen. `in_order` says that the points may lie along a path.
    ///
    /// # Errors
    /// Those of [`Form::of`].
    pub fn alone(registration: &Registration, given: &Given, in_order: bool) -> Result<Option<Hyper>, ModelError> {
        let seen = Seen::of(registration, &Given { priors: None, ..*given }, in_order)?;
        Ok(seen.is_seen.then(|| seen.told.likely[0].0))
    }

    /// Tells the form at places of the part that need not have been touched: points of the nominal surface with their normals, in the model
    /// frame. The figures are those of all of them.
    ///
    /// What is too narrow for the distance of the points is told from the scatter of the probe by [`Given::probe_scatter_mm`] alone. As
    /// nothing says how wide it is, every place has one of its own.
    ///
    /// # Errors
    /// Those of [`Form::of`], and places that are too many for the range of the form.
    pub fn over(registration: &Registration, given: &Given, places: &[(Point, Vector)]) -> Result<Self, ModelError> {
        let seen = Seen::of(registration, given, false)?;
        let places: Vec<_> = thinned(places.len()).map(|k| places[k]).collect();
        let alike = seen.motions.alike(given, places.iter().copied());
        let effects = seen.motions.rows(places.iter().copied());
        let drawn = Drawn::over(&seen.observed, &seen.told.likely, places.iter().map(plane).collect(), effects)?;
        let slope = seen.slope(given, &drawn, &alike);
        let drawn = drawn.with_what_is_narrow(&seen.told, given).with_what_is_alike(&alike).after_best_fit();
        Ok(Self { slope, ..seen.form(given, &drawn) })
    }
}

/// A registration as the model sees it, with what speaks for which parameters.
struct Seen<'a> {
    used: Vec<&'a Deviation>,
    motions: Motions,
    observed: Observed,
    told: Told,
    is_seen: bool,
}

impl<'a> Seen<'a> {
    fn of(registration: &'a Registration, given: &Given, in_order: bool) -> Result<Self, ModelError> {
        let all = registration.deviations.iter().enumerate().filter(|(_, d)| d.status == PointStatus::Used);
        let (path, used): (Vec<f64>, Vec<&Deviation>) = all.map(|(k, d)| (k as f64, d)).unzip();
        if used.is_empty() {
            return Err(ModelError::TooFewPoints { points: 0, least: 7 });
        }
        let motions = Motions::of(registration, used.iter().map(|d| d.point));
        let observed = motions.observed(&used);
        let path = if in_order && is_path(&observed.places) { path } else { Vec::new() };
        let observed = Observed { path, ..observed };
        let priors = given.priors.unwrap_or_else(|| Priors::of_size(motions.size_mm));
        let mut told = Hyper::told(&observed, &priors)?;
        let is_seen = told.likely[0].0.evidence(&observed) > EVIDENCE;
        if !is_seen {
            // What is spoken for by next to nothing is as good as what is spoken for by a little more.
            told.likely.push((told.wide, 1.0));
            told.likely.iter_mut().for_each(|(_, weight)| *weight = 1.0);
        }
        Ok(Self { used, motions, observed, told, is_seen })
    }

    fn places(&self) -> impl ExactSizeIterator<Item = (Point, Vector)> + Clone + '_ {
        self.used.iter().map(|d| (d.point, d.normal))
    }

    /// The slopes of what is drawn, before anything is added that has none.
    fn slope(&self, given: &Given, drawn: &Drawn, alike: &DMatrix<f64>) -> Option<SlopeFigures> {
        let slopes = SlopesAt::over(&drawn.places, given.area.integration_mm)?;
        let smooth = drawn.clone().with_what_is_alike(alike).after_best_fit();
        Some(SlopeFigures::of(&slopes, &smooth.forms, self.is_seen))
    }

    /// The form by what is drawn, without its slopes.
    fn form(&self, given: &Given, drawn: &Drawn) -> Form {
        let alike = self.motions.alike(given, self.places());
        let covariance = of_the_fit(&self.observed, self.told.wide, &alike);
        Form {
            hyper: self.told.likely[0].0,
            frame_covariance: self.motions.to_twist(&covariance),
            points: drawn.points(),
            figures: drawn.figures(self.is_seen, given.look_risk),
            iso: IsoFits::over(&drawn.places, given.area.middle_mm)
                .map(|fits| IsoFigures::of(&fits, &drawn.forms, self.is_seen, given.look_risk)),
            slope: None,
            known_mm: drawn.known_mm(),
            is_seen: self.is_seen,
        }
    }
}

/// Whether points follow each other like those of a path that is gone along: most are near the one before.
fn is_path(places: &[[f64; 2]]) -> bool {
    const NEAR: f64 = 3.0;
    let apart_mm = |pair: &[[f64; 2]]| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]);
    let mut steps_mm: Vec<f64> = places.windows(2).map(apart_mm).collect();
    if steps_mm.is_empty() {
        return false;
    }
    let middle = steps_mm.len() / 2;
    let median_mm = *steps_mm.select_nth_unstable_by(middle, f64::total_cmp).1;
    median_mm <= NEAR * spacing_mm(places)
}

fn plane((point, _): &(Point, Vector)) -> [f64; 2] {
    [point.x, point.y]
}

/// Some of so many, evenly.
fn thinned(of: usize) -> impl Iterator<Item = usize> {
    let most = of.min(MOST_PLACES);
    (0..most).map(move |k| k * of / most)
}

/// What the points cannot tell of themselves.
#[derive(Clone, Copy, Debug)]
pub struct Given {
    /// What is known of form and scatter beforehand; without it what every part of its size is like.
    pub priors: Option<Priors>,
    /// Standard uncertainty of the radius of the probe: it moves every point along its normal alike.
    pub radius_sigma_mm: f64,
    /// Standard uncertainty of all lengths, as a share of them: that of temperature and expansion.
    pub scale_sigma: f64,
    /// How far the probe itself scatters, and to what share of that it is known: what points scatter by more is form, too narrow to be told
    /// otherwise. 0 where nothing tells; all of the scatter is the probe's then.
    pub probe_scatter_mm: [f64; 2],
    /// With what probability a figure may be beyond either of the bounds [`Interval::least_mm`] and [`Interval::most_mm`].
    pub look_risk: f64,
    /// What the figures of an area go by.
    pub area: AreaOptions,
}

impl Default for Given {
    fn default() -> Self {
        Self {
            priors: None,
            radius_sigma_mm: 0.0,
            scale_sigma: 0.0,
            probe_scatter_mm: [0.0; 2],
            look_risk: 0.005,
            area: AreaOptions::default(),
        }
    }
}

/// The covariance of the motions as the registration finds them, by least squares of deviations that a form makes alike: A+ (K + s^2) A+'
/// with A+ = (H'H)^-1 H' (Aitken 1935), and of what adds to all points alike. Of many points some tell the part of the form.
fn of_the_fit(observed: &Observed, hyper: Hyper, alike: &DMatrix<f64>) -> DMatrix<f64> {
    let Observed { places, effects, .. } = observed;
    let inverse = |rows: &DMatrix<f64>| {
        rows.tr_mul(rows).pseudo_inverse(f64::EPSILON).unwrap_or_else(|_| DMatrix::zeros(rows.ncols(), rows.ncols()))
    };
    let by_scatter = inverse(effects) * hyper.white_scatter_mm().powi(2);
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

/// Forms that may have been, a column each, at some places.
#[derive(Clone)]
struct Drawn {
    forms: DMatrix<f64>,
    places: Vec<[f64; 2]>,
    effects: DMatrix<f64>,
    /// Which of the points the places are, where they are points.
    chosen: Vec<usize>,
    /// Standard uncertainty of what is told of each place, as far as it is smooth.
    smooth_sigma_mm: Vec<f64>,
}

impl Drawn {
    /// At the points, by each of the likely parameters as many as speaks for them.
    fn of(observed: &Observed, likely: &[(Hyper, f64)]) -> Result<Self, ModelError> {
        let n = observed.places.len();
        let chosen: Vec<usize> = thinned(n).collect();
        let seen = observed.only(&chosen);
        let forms = mixed(chosen.len(), likely, |hyper, count, seed| {
            if n <= MOST_DENSE {
                // What was observed less scatters that may have been.
                let scatters = Dense::fit(observed, hyper)?.scatters(count, seed)?;
                return Ok(DMatrix::from_fn(n, count, |r, c| observed.deviations_mm[r] - scatters[(r, c)]));
            }
            let lattice = Lattice::over(&observed.places, hyper.field.range_mm)?;
            Sparse::fit(&lattice, observed, hyper)?.samples(&seen.places, count, seed)
        })?;
        Ok(Self { smooth_sigma_mm: spread_mm(&forms), forms, places: seen.places, effects: seen.effects, chosen })
    }

    /// The same at other places.
    fn over(
        observed: &Observed,
        likely: &[(Hyper, f64)],
        places: Vec<[f64; 2]>,
        effects: DMatrix<f64>,
    ) -> Result<Self, ModelError> {
        let everywhere: Vec<[f64; 2]> = observed.places.iter().chain(&places).copied().collect();
        let forms = mixed(places.len(), likely, |hyper, count, seed| {
            let lattice = Lattice::over(&everywhere, hyper.field.range_mm)?;
            Sparse::fit(&lattice, observed, hyper)?.samples(&places, count, seed)
        })?;
        let drawn = Self { forms, places, effects, chosen: Vec::new(), smooth_sigma_mm: Vec::new() }.after_best_fit();
        Ok(Self { smooth_sigma_mm: spread_mm(&drawn.forms), ..drawn })
    }

    /// Takes in what is not known of the scatter, and what of it is too narrow a form to be told from it.
    ///
    /// What a smooth form leaves of the observations is the scatter, as far as that is known, and that is the
    /// probe's but for a share of its square. That share of what is left at a point is form; how much more or less
    /// is as uncertain as the scatter of the probe lets it be. Motions are in what is left too; they are taken off
    /// afterwards.
    fn with_the_scatter(mut self, observed: &Observed, told: &Told, given: &Given) -> Self {
        let mut normals = Normals::new(2, 0);
        for mut form in self.forms.column_iter_mut() {
            let share = (told.scatter_u * normals.next()).exp() - 1.0;
            let [probe_mm, narrow_mm] = parted(told, given, &mut normals);
            let is_form = narrow_mm.powi(2) / (probe_mm.powi(2) + narrow_mm.powi(2)).max(f64::MIN_POSITIVE);
            let moved_mm = is_form.sqrt() * probe_mm;
            for (value, &row) in form.iter_mut().zip(&self.chosen) {
                let left = observed.deviations_mm[row] - *value;
                *value += (is_form - share * (1.0 - is_form)) * left;
                if moved_mm > 0.0 {
                    *value += moved_mm * normals.next();
                }
            }
        }
        self
    }

    /// Adds what is too narrow to be told at places that were not touched: what the scatter is more than that of the probe.
    fn with_what_is_narrow(mut self, told: &Told, given: &Given) -> Self {
        for (c, mut form) in self.forms.column_iter_mut().enumerate() {
            let mut normals = Normals::new(4, c as u64);
            let [_, narrow_mm] = parted(told, given, &mut normals);
            form.iter_mut().for_each(|value| *value += narrow_mm * normals.next());
        }
        self
    }

    /// Adds what adds to all places alike: a column a standard uncertainty.
    fn with_what_is_alike(mut self, alike: &DMatrix<f64>) -> Self {
        let mut normals = Normals::new(3, 0);
        for mut form in self.forms.column_iter_mut() {
            alike.column_iter().for_each(|one| form.axpy(normals.next(), &one, 1.0));
        }
        self
    }

    /// Each form after its own best fit.
    fn after_best_fit(mut self) -> Self {
        if self.effects.ncols() > 0 {
            let base = self.effects.clone().qr().q();
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
            let smooth_sigma_mm = self.smooth_sigma_mm[k];
            FormPoint { at_mm: *at_mm, form: Predicted { mean_mm, sigma_mm }, smooth_sigma_mm }
        };
        self.places.iter().enumerate().map(of).collect()
    }

    /// The RMS over all places of how well the smooth form is known.
    fn known_mm(&self) -> f64 {
        let squares: f64 = self.smooth_sigma_mm.iter().map(|sigma| sigma * sigma).sum();
        (squares / self.smooth_sigma_mm.len().max(1) as f64).sqrt()
    }

    /// The figures; where no form is seen they are known from above alone.
    fn figures(&self, is_seen: bool, look_risk: f64) -> FormFigures {
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
        let [rms, pv, pv_most_points] = found.map(|values| Interval::of(values, is_seen, look_risk));
        FormFigures { rms, pv, pv_most_points }
    }
}

/// The scatter of the probe and what of the scatter is too narrow a form, each as it may be. Where nothing tells how
/// far the probe scatters it is the scatter that was found.
fn parted(told: &Told, given: &Given, normals: &mut Normals) -> [f64; 2] {
    let ([probe_mm, probe_u], scatter_mm) = (given.probe_scatter_mm, told.likely[0].0.scatter_mm);
    if probe_mm <= 0.0 {
        return [scatter_mm, 0.0];
    }
    let may_be = |mm: f64, share: f64, z: f64| (mm * (share * z).exp()).powi(2);
    let found = may_be(scatter_mm, told.scatter_u, normals.next());
    let own = may_be(probe_mm, probe_u, normals.next());
    [own.min(found).sqrt(), (found - own).max(0.0).sqrt()]
}

/// The standard deviation of each row.
fn spread_mm(forms: &DMatrix<f64>) -> Vec<f64> {
    forms.row_iter().map(|row| row.variance().sqrt()).collect()
}

/// Forms drawn by each of the likely parameters, as many as speaks for them, one beside the other.
fn mixed(
    rows: usize,
    likely: &[(Hyper, f64)],
    draw: impl Fn(Hyper, usize, u64) -> Result<DMatrix<f64>, ModelError>,
) -> Result<DMatrix<f64>, ModelError> {
    let whole: f64 = likely.iter().map(|(_, weight)| weight).sum();
    let mut forms = DMatrix::zeros(rows, 0);
    for (seed, (hyper, weight)) in (1..).zip(likely) {
        let count = (SAMPLES as f64 * weight / whole).round() as usize;
        if count < FEWEST_SAMPLES {
            continue;
        }
        let drawn = draw(*hyper, count, seed)?;
        let before = forms.ncols();
        forms = forms.resize(rows, before + count, 0.0);
        forms.columns_mut(before, count).copy_from(&drawn);
    }
    Ok(forms)
}

impl Interval {
    /// Of values that are equally probable.
    pub(super) fn of(mut values: Vec<f64>, has_low: bool, risk: f64) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        let low = |share: f64| if has_low { at(share) } else { 0.0 };
        Self {
            median_mm: at(0.5),
            low_mm: low(0.025),
            high_mm: at(0.975),
            least_mm: low(risk),
            most_mm: at(1.0 - risk),
        }
    }
}

/// The motions that the registration was free to make, about the middle of the points and in units of their size.
pub(super) struct Motions {
    centre: Point,
    size_mm: f64,
    /// A column a motion.
    free: DMatrix<f64>,
}

impl Motions {
    pub(super) fn of(registration: &Registration, points: impl Iterator<Item = Point> + Clone) -> Self {
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

    /// Deviations of which the motions move them all.
    pub(super) fn observed(&self, used: &[&Deviation]) -> Observed {
        Observed {
            places: used.iter().map(|d| [d.point.x, d.point.y]).collect(),
            deviations_mm: used.iter().map(|d| d.deviation_mm).collect(),
            effects: self.rows(used.iter().map(|d| (d.point, d.normal))),
            path: Vec::new(),
        }
    }

    /// What a standard uncertainty of the radius of the probe and of the scale add to every point.
    fn alike(&self, given: &Given, points: impl ExactSizeIterator<Item = (Point, Vector)>) -> DMatrix<f64> {
        let mut alike = DMatrix::zeros(points.len(), 2);
        for (r, (point, normal)) in points.enumerate() {
            alike[(r, 0)] = given.radius_sigma_mm;
            alike[(r, 1)] = given.scale_sigma * (point - self.centre).dot(&normal);
        }
        alike
    }

    /// What a unit of each motion adds to the distance of each point from the surface.
    pub(super) fn rows(&self, points: impl Iterator<Item = (Point, Vector)>) -> DMatrix<f64> {
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
