//! What a registered measurement says of the form of a part, and of where its nominal frame is.
//!
//! The registration put the part where the deviations are smallest. What the part's own form did to that is told by the model: the motions
//! that the registration was free to make are its effects, the form is its field. The figures are those of the form after its own
//! best fit, over fields drawn from what the measurement leaves possible; so the scatter of the probe is taken off them, and the pose is
//! in their uncertainty.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SymmetricEigen, Vector6};

use rayon::prelude::*;

use super::budget::{self, Share};
use super::field::Pairs;
use super::likelihood::{ANY, ON_A_GRID, Told};
use super::machine::{Effects, Machine, Source, unsound};
use super::normals::Normals;
use super::spacing_mm;
use super::{AreaOptions, IsoFigures, SlopeFigures};
use super::{Dense, Hyper, Lattice, ModelError, Observed, Predicted, Priors, Sparse};
use crate::form::{IsoFits, SlopesAt};
use crate::geometry::{Point, Vector};
use crate::registration::{Deviation, LEAST_SIGMA_MM, PointStatus, Registration, robust_sigma};

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
    /// What the standard uncertainties of the figures come from, source by source; empty where they cannot be parted.
    pub budget: Vec<Share>,
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
    /// Below it with the probability of [`Given::probability`]: for who judges.
    #[serde(skip)]
    pub accepted_mm: f64,
    /// Below each of them with one of [`Interval::PROBABILITIES`].
    #[serde(skip)]
    pub quantiles_mm: [f64; 15],
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
/// What is less likely than this counts for nothing.
const FEW: f64 = 1e-3;
/// A point further from the field than this many robust sigmas is none that scattered.
const STANDS_OUT: f64 = 6.0;
/// Where more than this share of the points stood out, they would not be apart from the form: it has no other.
const MOST_APART: f64 = 0.1;
/// A direction whose variance is less than this share of the largest was held.
const HELD: f64 = 1e-13;

impl Form {
    /// Fits the model to a registration: its deviations over x and y of the model frame.
    ///
    /// # Errors
    /// Too few points, and points that leave nothing to tell the form by.
    pub fn of(registration: &Registration, given: &Given) -> Result<Self, ModelError> {
        let seen = Seen::of(registration, given, true)?;
        let drawn = Drawn::of(&seen.observed, &seen.told.likely)?;
        let at = |chosen: &[usize]| seen.ground_in.as_ref().map(|ground_in| ground_in.select_rows(chosen));
        let ground_in = at(&seen.of_all(&drawn.chosen));
        let slope = seen.slope(given, drawn.clone().without(ground_in.as_ref()));
        let drawn = drawn.with_the_scatter(&seen.observed, &seen.told, given).without(ground_in.as_ref());
        let drawn = seen.with_those_apart(drawn, given).after_best_fit();
        let ground_in = at(&drawn.chosen);
        Ok(Self { slope, ..seen.form(given, &drawn, ground_in) })
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
        let effects = seen.motions.rows(places.iter().copied());
        let drawn = Drawn::over(&seen.observed, &seen.told.likely, places.iter().map(plane).collect(), effects)?;
        let ground_in = seen.ground_in.is_some().then(|| seen.stated.columns(places.iter().copied()));
        let drawn = drawn.without(ground_in.as_ref());
        let slope = seen.slope(given, drawn.clone());
        let drawn = seen.with_those_apart(drawn.with_what_is_narrow(&seen.told, given), given).after_best_fit();
        Ok(Self { slope, ..seen.form(given, &drawn, ground_in) })
    }
}

/// A registration as the model sees it, with what speaks for which parameters.
struct Seen {
    motions: Motions,
    /// All points that were used, and what was observed at them.
    used: Vec<Deviation>,
    all: Observed,
    /// Those of them that no field explains, ascending: what stands there is form all the same.
    apart: Vec<usize>,
    /// The rest of them, and what was observed at those.
    kept: Vec<usize>,
    observed: Observed,
    /// What is stated of all points together.
    stated: Effects,
    /// What of that has been ground into the part, at all points: nothing before the first correction.
    ground_in: Option<DMatrix<f64>>,
    told: Told,
    is_seen: bool,
}

impl Seen {
    /// Tells the parameters, without the points that no field explains by them.
    fn of(registration: &Registration, given: &Given, at_points: bool) -> Result<Self, ModelError> {
        /// Each round tells the parameters anew, and without the tallest of a defect its flanks stand out.
        const ROUNDS: usize = 3;
        let mut seen = Self::with_all_in_the_fit(registration, given, at_points)?;
        for _ in 0..ROUNDS {
            let more = seen.unexplained()?;
            let apart = seen.apart.len() + more.len();
            if more.is_empty() || apart as f64 > MOST_APART * seen.all.places.len() as f64 {
                break;
            }
            let mut apart = [&seen.apart[..], &more[..]].concat();
            apart.sort_unstable();
            let kept: Vec<usize> = (0..seen.used.len()).filter(|k| apart.binary_search(k).is_err()).collect();
            let observed = seen.all.only(&kept);
            // What is left may be too few to tell anything; then it is told with them.
            let Ok((told, is_seen)) = told(&observed, seen.motions.size_mm, given, at_points) else { break };
            seen = Self { apart, kept, observed, told, is_seen, ..seen };
        }
        Ok(seen)
    }

    /// The points that are further from the field than its scatter lets any of them be, of all that were used.
    fn unexplained(&self) -> Result<Vec<usize>, ModelError> {
        /// Of fewer points nobody knows what is usual.
        const FEWEST: usize = 40;
        let (observed, hyper) = (&self.observed, self.told.likely[0].0);
        if observed.places.len() < FEWEST {
            return Ok(Vec::new());
        }
        let residuals_mm = if observed.places.len() <= MOST_DENSE {
            Dense::fit(observed, hyper)?.residuals_mm()
        } else {
            let lattice = Lattice::over(&observed.places, &hyper.field)?;
            Sparse::fit(&lattice, observed, hyper)?.residuals_mm().to_vec()
        };
        let (middle_mm, sigma_mm) = robust_sigma(residuals_mm.iter().copied());
        // Where a field goes through every point, what is left of them is no scatter.
        let limit_mm = STANDS_OUT * sigma_mm.max(0.5 * hyper.scatter_mm).max(LEAST_SIGMA_MM);
        let stands_out = |k: &usize| (residuals_mm[*k] - middle_mm).abs() > limit_mm;
        Ok(self.of_all(&(0..residuals_mm.len()).filter(stands_out).collect::<Vec<_>>()))
    }

    /// The numbers among all that were used of some that were kept.
    fn of_all(&self, chosen: &[usize]) -> Vec<usize> {
        chosen.iter().map(|&k| self.kept[k]).collect()
    }

    /// Puts the points that no field explains into what is drawn, each with the height that was found there but for the scatter of a touch:
    /// in their order among the points, or in place of the nearest of other places.
    fn with_those_apart(&self, drawn: Drawn, given: &Given) -> Drawn {
        let (rows, at_points) = (drawn.places.len(), !drawn.chosen.is_empty());
        let chosen = self.of_all(&drawn.chosen);
        let drawn = Drawn { chosen, ..drawn };
        if self.apart.is_empty() {
            return drawn;
        }
        // Of the points of a scan as large a share as of the others, the tallest of them.
        let mut apart = self.apart.clone();
        if at_points {
            apart.sort_by(|a, b| self.all.deviations_mm[*b].abs().total_cmp(&self.all.deviations_mm[*a].abs()));
            apart.truncate((self.apart.len() * rows).div_ceil(self.kept.len().max(1)));
            apart.sort_unstable();
        }
        let found = self.touched_at(&apart, drawn.forms.ncols(), given);
        if at_points { drawn.beside(found) } else { drawn.replaced_by(&found) }
    }

    /// What some of the points found, as often as forms are drawn.
    fn touched_at(&self, points: &[usize], count: usize, given: &Given) -> Drawn {
        let scatter_mm = self.told.likely[0].0.scatter_mm;
        let of_probe_mm =
            if given.probe_scatter_mm[0] > 0.0 { scatter_mm.min(given.probe_scatter_mm[0]) } else { scatter_mm };
        let mut forms = DMatrix::zeros(points.len(), count);
        for (c, mut form) in forms.column_iter_mut().enumerate() {
            let mut normals = Normals::new(6, c as u64);
            for (value, &k) in form.iter_mut().zip(points) {
                *value = self.all.deviations_mm[k] - of_probe_mm * normals.next();
            }
        }
        let found = Drawn {
            forms,
            places: points.iter().map(|&k| self.all.places[k]).collect(),
            effects: self.all.effects.select_rows(points),
            chosen: points.to_vec(),
            smooth_sigma_mm: vec![scatter_mm; points.len()],
        };
        found.without(self.ground_in.as_ref().map(|columns| columns.select_rows(points)).as_ref())
    }

    /// Tells the parameters by the points that the pose was fitted to. The others are far from the surface, and no field.
    fn with_all_in_the_fit(registration: &Registration, given: &Given, at_points: bool) -> Result<Self, ModelError> {
        let all = registration.deviations.iter().enumerate().filter(|(_, d)| d.status == PointStatus::Used);
        let (path, used): (Vec<f64>, Vec<&Deviation>) = all.map(|(k, d)| (k as f64, d)).unzip();
        if used.is_empty() {
            return Err(ModelError::TooFewPoints { points: 0, least: 7 });
        }
        let motions = Motions::of(registration, used.iter().map(|d| d.point));
        let stated = motions.stated(registration, given)?;
        let columns = stated.columns(used.iter().map(|d| (d.point, d.normal)));
        let (shown, ground_in) =
            if given.is_corrected { (DMatrix::zeros(used.len(), 0), Some(columns)) } else { (columns, None) };
        let observed = Observed { stated: shown, ..motions.observed(&used) };
        let path = if at_points && is_path(&observed.places) { path } else { Vec::new() };
        let observed = Observed { path, ..observed };
        let (kept, apart): (Vec<usize>, Vec<usize>) = (0..used.len()).partition(|&k| used[k].in_fit);
        let (all, observed) =
            if apart.is_empty() { (observed.clone(), observed) } else { (observed.clone(), observed.only(&kept)) };
        let (told, is_seen) = told(&observed, motions.size_mm, given, at_points)?;
        let used = used.into_iter().copied().collect();
        Ok(Self { motions, used, all, apart, kept, observed, stated, ground_in, told, is_seen })
    }

    /// The slopes of what is drawn, before anything is added that has none.
    fn slope(&self, given: &Given, drawn: Drawn) -> Option<SlopeFigures> {
        let slopes = SlopesAt::over(&drawn.places, given.area.integration_mm)?;
        let smooth = drawn.after_best_fit();
        Some(SlopeFigures::of(&slopes, &smooth.forms, (self.is_seen, given)))
    }

    /// The form by what is drawn, without its slopes; `ground_in` is what of it each of the stated effects may have made there.
    fn form(&self, given: &Given, drawn: &Drawn, ground_in: Option<DMatrix<f64>>) -> Form {
        let ground_into_kept = self.ground_in.as_ref().map(|columns| columns.select_rows(&self.kept));
        let alike = ground_into_kept.as_ref().unwrap_or(&self.observed.stated);
        let covariance = of_the_fit(&self.observed, &self.told.wide, alike);
        // What stands apart is seen, whatever the rest shows.
        let is_seen = self.is_seen || !self.apart.is_empty();
        let figures = drawn.figures(is_seen, given);
        let hyper = self.told.likely[0].0;
        let on_a_grid = if ON_A_GRID.contains(&hyper.field.smoothness) { hyper } else { self.told.plain };
        let ground_in = ground_in.map(|columns| best_fitted(columns, &drawn.effects));
        let of_drawn = budget::Drawn { forms: &drawn.forms, places: &drawn.places, effects: &drawn.effects, ground_in };
        let uncertainties_mm = [figures.rms, figures.pv_most_points].map(|of| of.standard_mm());
        let mut budget =
            budget::parted((&self.observed, &self.stated.sources()), &on_a_grid, &of_drawn, uncertainties_mm);
        budget.retain(|share| share.source != Source::Datum || given.datum.is_some());
        Form {
            hyper,
            frame_covariance: self.motions.to_twist(&covariance),
            points: drawn.points(),
            figures,
            budget,
            iso: IsoFits::over(&drawn.places, given.area.middle_mm)
                .map(|fits| IsoFigures::of(&fits, &drawn.forms, is_seen, given)),
            slope: None,
            known_mm: drawn.known_mm(),
            is_seen,
        }
    }
}

/// Tells which parameters the observations speak for, and whether they show a form at all.
fn told(observed: &Observed, size_mm: f64, given: &Given, at_points: bool) -> Result<(Told, bool), ModelError> {
    let priors = given.priors.unwrap_or_else(|| Priors::of_size(size_mm));
    let is_dense = at_points && observed.places.len() <= MOST_DENSE;
    let mut told = Hyper::told(observed, &priors, if is_dense { &ANY } else { &ON_A_GRID })?;
    let is_seen = told.plain.evidence(observed) > EVIDENCE;
    if !is_seen {
        // What is spoken for by next to nothing is as good as what is spoken for by a little more.
        let on_a_grid = told.wide.iter().filter(|(wide, _)| ON_A_GRID.contains(&wide.field.smoothness));
        told.likely.extend(on_a_grid.copied());
        told.likely.iter_mut().for_each(|(_, weight)| *weight = 1.0);
    }
    Ok((told, is_seen))
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
    /// What the machine does to all points together, as its cell file states it.
    pub machine: Machine,
    /// Standard uncertainty of the radius of the probe as it was found: it moves every point along its normal alike.
    pub radius_sigma_mm: f64,
    /// Standard uncertainty of all lengths, as a share of them: that of temperature and expansion.
    pub scale_sigma: f64,
    /// Standard uncertainties of where the part was held, where the registration was not free to move it: along x, y and z of the model in
    /// millimetres, and of its turns about them through the middle of the points in radians. 0 in what is taken for known, or was found.
    /// Nothing where the registration held nothing.
    pub datum: Option<[f64; 6]>,
    /// Whether the part was corrected by what the same machine found of it where it is held: then all that is stated is ground into it, and the
    /// points show it no more.
    pub is_corrected: bool,
    /// How far the probe itself scatters, and to what share of that it is known: what points scatter by more is form, too narrow to be told
    /// otherwise. 0 where nothing tells; all of the scatter is the probe's then.
    pub probe_scatter_mm: [f64; 2],
    /// With what probability a figure may be beyond either of the bounds [`Interval::least_mm`] and [`Interval::most_mm`].
    pub look_risk: f64,
    /// With what probability a figure must be within its limit to be accepted.
    pub probability: f64,
    /// What the figures of an area go by.
    pub area: AreaOptions,
}

impl Default for Given {
    fn default() -> Self {
        Self {
            priors: None,
            machine: Machine::default(),
            radius_sigma_mm: 0.0,
            scale_sigma: 0.0,
            datum: None,
            is_corrected: false,
            probe_scatter_mm: [0.0; 2],
            look_risk: 0.005,
            probability: 0.975,
            area: AreaOptions::default(),
        }
    }
}

/// The covariance of the motions as the registration finds them, by least squares of deviations that a form makes alike: A+ (K + s^2) A+'
/// with A+ = (H'H)^-1 H' (Aitken 1935), and of what adds to all points alike. K is the mean of those of fields that it may be, each as
/// likely as it is said. Of many points some tell the part of the form.
fn of_the_fit(observed: &Observed, likely: &[(Hyper, f64)], alike: &DMatrix<f64>) -> DMatrix<f64> {
    let Observed { places, effects, .. } = observed;
    let inverse = |rows: &DMatrix<f64>| {
        rows.tr_mul(rows).pseudo_inverse(f64::EPSILON).unwrap_or_else(|_| DMatrix::zeros(rows.ncols(), rows.ncols()))
    };
    let whole: f64 = likely.iter().map(|(_, weight)| weight).sum();
    let scatter2: f64 = likely.iter().map(|(hyper, weight)| weight / whole * hyper.white_scatter_mm().powi(2)).sum();
    let n = places.len();
    let chosen: Vec<usize> = (0..n.min(MOST_PAIRED)).map(|k| k * n / n.min(MOST_PAIRED)).collect();
    let rows = effects.select_rows(&chosen);
    // A+, a row a point.
    let weights = &rows * inverse(&rows);
    let p = rows.ncols();
    let counting = likely.iter().filter(|(_, weight)| *weight > FEW * whole);
    let fields: Vec<_> = counting.map(|(hyper, weight)| (hyper.field.pairs(), weight / whole)).collect();
    let covered: Vec<f64> = chosen
        .par_iter()
        .flat_map_iter(|&a| {
            let mut sum = vec![0.0; p];
            for (k, &b) in chosen.iter().enumerate() {
                let of = |(pairs, weight): &(Pairs, f64)| weight * pairs.covariance_mm2(places[a], places[b]);
                let covariance: f64 = fields.iter().map(of).sum();
                sum.iter_mut().zip(weights.row(k).iter()).for_each(|(sum, weight)| *sum += covariance * weight);
            }
            sum
        })
        .collect();
    let covered = DMatrix::from_row_slice(chosen.len(), p, &covered);
    let of_alike = weights.tr_mul(&alike.select_rows(&chosen));
    inverse(effects) * scatter2 + weights.tr_mul(&covered) + &of_alike * of_alike.transpose()
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
            let lattice = Lattice::over(&observed.places, &hyper.field)?;
            Sparse::fit(&lattice, observed, hyper)?.samples(&seen.places, count, seed)
        })?;
        // What is stated moves the part too, and that is no form.
        let smooth_sigma_mm = match observed.stated.ncols() {
            0 => spread_mm(&forms),
            _ => spread_mm(&best_fitted(forms.clone(), &seen.effects)),
        };
        Ok(Self { smooth_sigma_mm, forms, places: seen.places, effects: seen.effects, chosen })
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
            let lattice = Lattice::over(&everywhere, &hyper.field)?;
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
        // What is stated is left of the observations as well, and is no scatter.
        let seen = observed.only(&self.chosen);
        let stated = (seen.stated.ncols() > 0).then(|| seen.all_effects().qr().q());
        for mut form in self.forms.column_iter_mut() {
            let share = (told.scatter_u * normals.next()).exp() - 1.0;
            let [probe_mm, narrow_mm] = parted(told, given, &mut normals);
            let is_form = narrow_mm.powi(2) / (probe_mm.powi(2) + narrow_mm.powi(2)).max(f64::MIN_POSITIVE);
            let moved_mm = is_form.sqrt() * probe_mm;
            let left = DVector::from_fn(form.len(), |k, _| seen.deviations_mm[k] - form[k]);
            let left = stated.as_ref().map_or_else(|| left.clone(), |base| &left - base * base.tr_mul(&left));
            for (value, left) in form.iter_mut().zip(&left) {
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

    /// Takes off what was ground in: each column as often as a normal number says.
    ///
    /// A part that was corrected by what a machine found of it has the machine's errors as its form, d = (f - E t) + E t + e, and the points
    /// show neither: t is as little known as before anything was measured.
    fn without(mut self, ground_in: Option<&DMatrix<f64>>) -> Self {
        let Some(columns) = ground_in.filter(|columns| columns.ncols() > 0) else { return self };
        for (c, mut form) in self.forms.column_iter_mut().enumerate() {
            let mut normals = Normals::new(5, c as u64);
            for column in columns.column_iter() {
                form.axpy(-normals.next(), &column, 1.0);
            }
        }
        self
    }

    /// Both, in the order of the points.
    fn beside(self, other: Self) -> Self {
        let (rows, more) = (self.places.len(), other.places.len());
        let [mut forms, mut effects] = [self.forms, self.effects].map(|of| of.resize_vertically(rows + more, 0.0));
        forms.rows_mut(rows, more).copy_from(&other.forms);
        effects.rows_mut(rows, more).copy_from(&other.effects);
        let places = [self.places, other.places].concat();
        let chosen = [self.chosen, other.chosen].concat();
        let smooth_sigma_mm = [self.smooth_sigma_mm, other.smooth_sigma_mm].concat();
        let mut order: Vec<usize> = (0..chosen.len()).collect();
        order.sort_unstable_by_key(|&row| chosen[row]);
        Self {
            forms: forms.select_rows(&order),
            effects: effects.select_rows(&order),
            places: order.iter().map(|&row| places[row]).collect(),
            chosen: order.iter().map(|&row| chosen[row]).collect(),
            smooth_sigma_mm: order.iter().map(|&row| smooth_sigma_mm[row]).collect(),
        }
    }

    /// With what others found in the rows of the places that are nearest to theirs.
    fn replaced_by(mut self, other: &Self) -> Self {
        let square = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2);
        for (r, place) in other.places.iter().enumerate() {
            let nearer =
                |a: &usize, b: &usize| square(self.places[*a], *place).total_cmp(&square(self.places[*b], *place));
            let Some(nearest) = (0..self.places.len()).min_by(nearer) else { continue };
            self.forms.row_mut(nearest).copy_from(&other.forms.row(r));
            self.effects.row_mut(nearest).copy_from(&other.effects.row(r));
            self.smooth_sigma_mm[nearest] = other.smooth_sigma_mm[r];
        }
        self
    }

    /// Each form after its own best fit.
    fn after_best_fit(mut self) -> Self {
        self.forms = best_fitted(self.forms, &self.effects);
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
    fn figures(&self, is_seen: bool, given: &Given) -> FormFigures {
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
        let [rms, pv, pv_most_points] = found.map(|values| Interval::of(values, is_seen, given));
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

/// Each form after its own best fit.
fn best_fitted(mut forms: DMatrix<f64>, effects: &DMatrix<f64>) -> DMatrix<f64> {
    if effects.ncols() > 0 {
        let base = effects.clone().qr().q();
        let fitted: DMatrix<f64> = &base * base.tr_mul(&forms);
        forms -= fitted;
    }
    forms
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
    /// The probabilities of the quantiles by which a figure is recorded.
    pub const PROBABILITIES: [f64; 15] =
        [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.99, 0.995, 0.999];

    /// Returns the standard uncertainty: its width over that of a normal figure.
    pub fn standard_mm(&self) -> f64 {
        const WIDTH: f64 = 2.0 * 1.96;
        (self.high_mm - self.low_mm) / WIDTH
    }

    /// Of values that are equally probable.
    pub(super) fn of(mut values: Vec<f64>, has_low: bool, given: &Given) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        let Given { look_risk, probability, .. } = *given;
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        let low = |share: f64| if has_low { at(share) } else { 0.0 };
        Self {
            median_mm: at(0.5),
            low_mm: low(0.025),
            high_mm: at(0.975),
            least_mm: low(look_risk),
            most_mm: at(1.0 - look_risk),
            accepted_mm: at(probability),
            quantiles_mm: Self::PROBABILITIES.map(|share| if share < 0.5 { low(share) } else { at(share) }),
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
            stated: DMatrix::zeros(used.len(), 0),
            path: Vec::new(),
        }
    }

    /// What is stated of all points together, about their middle.
    pub(super) fn stated(&self, registration: &Registration, given: &Given) -> Result<Effects, ModelError> {
        let of_others = [given.radius_sigma_mm, given.scale_sigma];
        let datum = given.datum.unwrap_or_default();
        if let Some((what, value)) = unsound(&given.machine, of_others, &datum) {
            return Err(ModelError::Stated { what, value });
        }
        let model_from_machine = registration.cmm_from_model.rotation.transpose();
        Ok(Effects::new(given.machine, of_others, self.centre, model_from_machine).held(datum))
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
