//! The model by the precision of the field on a grid: each node knows its neighbours alone, so there may be any number of points.
//!
//! A Matern field of smoothness nu = alpha - 1 in the plane solves (kappa^2 - Laplace)^(alpha/2) tau f = white noise (Lindgren, Rue and Lindstrom 2011). On a
//! square grid with C the area of each node and Q1 that of kappa^2 - Laplace, the precision is Q = tau^2 Q1 (C^-1 Q1)^(alpha - 1), with alpha 3 or 5.
//!
//! The usual Q1 errs by the square of kappa h. Here it is kappa^2 m x m + K x m + m x K, with K = [-1 2 -1] and m = [1 10 1] / 12 along each axis: for a
//! wave of w radians a node that is (kappa^2 + w^2)(1 - w^2/12) in every direction, and so the nodes are those of the true field
//! raised by (1 - w^2/12)^(-alpha/2) = 1 + alpha w^2/24. The B-splines of degree alpha - 1 by which places read the nodes lower it by the same: what is
//! left is of the fourth power. tau is that by which the field without an edge has its variance on this very grid; the edge, which would
//! add to it, lies further than one range away from every place. A field with a lay is laid on a grid of the plane in which it has none.
//!
//! With B the splines from nodes to points, P = Q + B'B / s^2 is the precision of the nodes beside known effects; the effects come from
//! H'R^-1 H with R^-1 = (1 - B P^-1 B' / s^2) / s^2, to which effects that are stated, of variance 1, add 1 on the diagonal.

use faer::Mat;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::dense::{told_apart, with_stated};
use super::normals::Normals;
use super::{Field, Hyper, ModelError, Observed, Predicted, Smoothness};
use crate::sparse::{Factor, Pattern, SelectedInverse};

/// How many ranges the grid goes on beyond every place.
const MARGIN: f64 = 1.25;
/// Beyond every place, at most, as a share of the part.
const MARGIN_OF_PART: f64 = 0.75;
/// Nodes along a part, at least.
const NODES_A_PART: f64 = 36.0;
/// Nodes in one range, at least; and of a smooth field at most: with more the precision drowns in rounding.
const NODES_A_RANGE: f64 = 14.0;
const MOST_A_RANGE: f64 = 30.0;
/// More would take minutes.
const MOST_NODES: usize = 120_000;
/// Samples that are made at a time.
const BATCH: usize = 50;

/// A square grid over the places of a part, and one range beyond them.
pub struct Lattice {
    field: Field,
    corner_mm: [f64; 2],
    spacing_mm: f64,
    counts: [usize; 2],
    pattern: Pattern,
}

/// The nodes by which a place is read, with how much each of them counts.
type Around = Vec<(usize, f64)>;

/// How the precision of a field is made: its alpha, which is how far Q reaches along either axis, and the nodes around a place from each other at most.
fn reach(smoothness: Smoothness) -> Result<isize, ModelError> {
    match smoothness {
        Smoothness::Once => Ok(3),
        Smoothness::Thrice => Ok(5),
        Smoothness::Endless => Err(ModelError::NoPrecision),
    }
}

impl Lattice {
    /// Lays a grid that is fine enough for a field, however strong, over all places that will be asked for.
    ///
    /// # Errors
    /// No field, or one that is endlessly smooth; no place, a place that is no number, more nodes than can be worked with.
    pub fn over(places: &[[f64; 2]], field: &Field) -> Result<Self, ModelError> {
        field.check()?;
        let (reach, range_mm) = (reach(field.smoothness)?, field.range_mm);
        if let Some(point) = places.iter().position(|place| !place.iter().all(|value| value.is_finite())) {
            return Err(ModelError::NotFinite { point });
        }
        if places.is_empty() {
            return Err(ModelError::TooFewPoints { points: 0, least: 1 });
        }
        let spans = [0, 1].map(|axis| {
            let of = places.iter().map(|&place| field.straightened(place)[axis]);
            [of.clone().fold(f64::INFINITY, f64::min), of.fold(f64::NEG_INFINITY, f64::max)]
        });
        let size_mm = spans.iter().map(|[low, high]| high - low).fold(0.0, f64::max);
        // A field that is wider than the part is told by points much nearer to each other than its range; and the edge of a rough one, however far, is
        // not seen once the motions of the part are free. A smooth one is held by its edge, but has fewer nodes to go there.
        let resolved_mm = if size_mm > 0.0 { size_mm / NODES_A_PART } else { f64::INFINITY };
        let is_rough = field.smoothness == Smoothness::Once;
        let finest_mm = if is_rough { 0.0 } else { range_mm / MOST_A_RANGE };
        let spacing_mm = (range_mm / NODES_A_RANGE).min(resolved_mm).max(finest_mm);
        let most_mm = if is_rough { (MARGIN_OF_PART * size_mm).max(2.0 * spacing_mm) } else { f64::INFINITY };
        let beyond_mm = (MARGIN * range_mm).min(most_mm);
        let ends = spans.map(|[low, high]| [low - beyond_mm, high + beyond_mm]);
        let counts = ends.map(|[low, high]| ((high - low) / spacing_mm).ceil() + 1.0);
        let nodes = counts[0] * counts[1];
        if nodes > MOST_NODES as f64 {
            return Err(ModelError::TooManyNodes { nodes: nodes as usize, most: MOST_NODES, range_mm });
        }
        let counts = counts.map(|count| count as usize);
        let (begins, rows) = pattern(counts, reach);
        let pattern = Pattern::new(counts[0] * counts[1], begins, rows).ok_or(ModelError::NotDefinite)?;
        Ok(Self { field: *field, corner_mm: ends.map(|[low, _]| low), spacing_mm, counts, pattern })
    }

    /// Returns the number of nodes.
    pub fn nodes(&self) -> usize {
        self.counts[0] * self.counts[1]
    }

    /// The nodes by which a place is read; for a place beyond the grid those of its edge.
    fn around(&self, place: [f64; 2]) -> Around {
        let place = self.field.straightened(place);
        // So many nodes stand on either side of the nearest one.
        let beside = if self.field.smoothness == Smoothness::Once { 1 } else { 2 };
        let [(i, u), (j, v)] = [0, 1].map(|axis| {
            let (first, last) = (beside as f64, (self.counts[axis] - 1 - beside) as f64);
            let at = ((place[axis] - self.corner_mm[axis]) / self.spacing_mm).clamp(first - 0.5, last + 0.5);
            let nearest = at.round().clamp(first, last);
            (nearest as usize - beside, spline(beside, at - nearest))
        });
        let pairs = v.iter().enumerate().flat_map(|(b, v)| u.iter().enumerate().map(move |(a, u)| (a, b, u * v)));
        pairs.map(|(a, b, weight)| ((j + b) * self.counts[0] + i + a, weight)).collect()
    }

    /// The lower triangle of the precision of the field, in the order of the pattern.
    fn precision(&self, hyper: &Hyper, reach: isize) -> Vec<f64> {
        let kappa_h = (8.0 * (reach - 1) as f64).sqrt() / hyper.field.range_mm * self.spacing_mm;
        let tau2 = unit_variance(kappa_h, reach) / hyper.field.sigma_mm.powi(2);
        let [nx, ny] = self.counts.map(|count| count as isize);
        // Along an axis, in units of the spacing: C, and K and m = C - K / 12 between a node and the one `step` further.
        let share = |k: isize, count: isize| if k == 0 || k == count - 1 { 0.5 } else { 1.0 };
        let pull = |k: isize, step: isize, count: isize| match step {
            0 if k == 0 || k == count - 1 => 1.0,
            0 => 2.0,
            _ => -1.0,
        };
        let mass = |k: isize, step: isize, count: isize| {
            let whole = if step == 0 { share(k, count) } else { 0.0 };
            whole - pull(k, step, count) / 12.0
        };
        let inside = |i: isize, j: isize| (0..nx).contains(&i) && (0..ny).contains(&j);
        // Of the farthest reach, and what is looked at beside it.
        const SIDE: usize = 13;
        const MIDDLE: isize = 6;
        let column = |of: usize| -> Vec<f64> {
            let (i0, j0) = (of as isize % nx, of as isize / nx);
            let mut window = [[0.0_f64; SIDE]; SIDE];
            window[MIDDLE as usize][MIDDLE as usize] = 1.0;
            for turn in 1..=reach {
                let mut next = [[0.0_f64; SIDE]; SIDE];
                for (dj, di) in (-turn..=turn).flat_map(|dj| (-turn..=turn).map(move |di| (dj, di))) {
                    let (i, j) = (i0 + di, j0 + dj);
                    if !inside(i, j) {
                        continue;
                    }
                    let mut value = 0.0;
                    for (sj, si) in (-1..=1).flat_map(|sj| (-1..=1).map(move |si| (sj, si))) {
                        if inside(i + si, j + sj) {
                            let (mi, mj) = (mass(i, si, nx), mass(j, sj, ny));
                            let weight = kappa_h * kappa_h * mi * mj + pull(i, si, nx) * mj + mi * pull(j, sj, ny);
                            value += weight * window[(MIDDLE + dj + sj) as usize][(MIDDLE + di + si) as usize];
                        }
                    }
                    // Between two of them stands C^-1.
                    let area = if turn < reach { share(i, nx) * share(j, ny) } else { 1.0 };
                    next[(MIDDLE + dj) as usize][(MIDDLE + di) as usize] = value / area;
                }
                window = next;
            }
            below(of, self.counts, reach)
                .map(|(di, dj)| tau2 * window[(MIDDLE + dj) as usize][(MIDDLE + di) as usize])
                .collect()
        };
        // What stands far enough from every edge has the same column, and so has what stands alike beside one.
        let [along, across] =
            self.counts.map(|count| (0..count).map(|k| like(k, count, reach as usize)).collect::<Vec<_>>());
        let mut known: Vec<Option<Vec<f64>>> = vec![None; (2 * reach as usize + 3).pow(2)];
        let mut values = Vec::new();
        for (j, &row) in across.iter().enumerate() {
            for (i, &of) in along.iter().enumerate() {
                let seen = &mut known[row * (2 * reach as usize + 3) + of];
                values.extend_from_slice(seen.get_or_insert_with(|| column(j * self.counts[0] + i)));
            }
        }
        values
    }
}

/// Which of the nodes along an axis this one is like: each within reach of an end is like none but itself.
fn like(k: usize, count: usize, reach: usize) -> usize {
    let (before, behind) = (k, count - 1 - k);
    match () {
        () if before <= reach || count <= 2 * reach + 3 => before,
        () if behind <= reach => 2 * reach + 2 - behind,
        () => reach + 1,
    }
}

/// How much each node counts, at `t` from the nearest one (-1/2 to 1/2) of so many on either side: the B-spline of twice that degree.
fn spline(beside: usize, t: f64) -> Vec<f64> {
    let quartic = |x: f64| match x.abs() {
        x if x <= 0.5 => 115.0 / 192.0 - 0.625 * x * x + 0.25 * x.powi(4),
        x if x <= 1.5 => (55.0 + 20.0 * x - 120.0 * x * x + 80.0 * x.powi(3) - 16.0 * x.powi(4)) / 96.0,
        x => (5.0 - 2.0 * x).powi(4) / 384.0,
    };
    match beside {
        1 => vec![0.5 * (0.5 - t).powi(2), 0.75 - t * t, 0.5 * (0.5 + t).powi(2)],
        _ => (-2..=2).map(|k| quartic(t - f64::from(k))).collect(),
    }
}

/// Where, beside a node, the precision has an entry in its column, at or below the diagonal; ascending.
fn below(of: usize, [nx, ny]: [usize; 2], reach: isize) -> impl Iterator<Item = (isize, isize)> {
    let (i0, j0) = ((of % nx) as isize, (of / nx) as isize);
    let all = (0..=reach).flat_map(move |dj| (-reach..=reach).map(move |di| (di, dj)));
    all.filter(move |&(di, dj)| {
        let (i, j) = (i0 + di, j0 + dj);
        (dj > 0 || di >= 0) && (0..nx as isize).contains(&i) && j < ny as isize
    })
}

fn pattern(counts: [usize; 2], reach: isize) -> (Vec<usize>, Vec<usize>) {
    let (mut begins, mut rows) = (vec![0], Vec::new());
    for of in 0..counts[0] * counts[1] {
        rows.extend(below(of, counts, reach).map(|(di, dj)| (of as isize + dj * counts[0] as isize + di) as usize));
        begins.push(rows.len());
    }
    (begins, rows)
}

/// The variance, with tau = 1, of the field on a grid without an edge: the mean over the waves that the grid has of what the precision
/// and the spline at a node make of them.
fn unit_variance(kappa_h: f64, reach: isize) -> f64 {
    // The function is smooth and returns to itself: equal steps are exact once they are finer than its width.
    let steps = ((20.0 / kappa_h) as usize).clamp(32, 2048) * 2;
    let wave = |k: usize| (std::f64::consts::TAU * k as f64 / steps as f64).cos();
    let spline = |c: f64| match reach {
        3 => (3.0 + c) / 4.0,
        _ => (114.0 + 76.0 * c + 2.0 * c * c) / 192.0,
    };
    // K, m and the spline along one axis. A wave and the one that runs the other way tell the same, and so do the two axes.
    let axis: Vec<[f64; 3]> = (0..=steps / 2).map(wave).map(|c| [2.0 - 2.0 * c, (5.0 + c) / 6.0, spline(c)]).collect();
    let weight = |k: usize| if k == 0 || 2 * k == steps { 1.0 } else { 2.0 };
    let of = |[ka, ma, sa]: [f64; 3], [kb, mb, sb]: [f64; 3]| {
        (sa * sb).powi(2) * (kappa_h * kappa_h * ma * mb + ka * mb + ma * kb).powi(-reach as i32)
    };
    let row = |a: usize| {
        let beside: f64 = (0..a).map(|b| weight(b) * of(axis[a], axis[b])).sum();
        weight(a) * (2.0 * beside + weight(a) * of(axis[a], axis[a]))
    };
    let rows: Vec<f64> = (0..axis.len()).into_par_iter().map(row).collect();
    rows.iter().sum::<f64>() / (steps * steps) as f64
}

/// What a variance comes from.
pub(super) struct Parted {
    /// The points by themselves.
    pub(super) scatter: f64,
    /// The field between them.
    pub(super) form: f64,
    /// The effects that nobody knows.
    pub(super) pose: f64,
    /// Each of those that are stated.
    pub(super) stated: Vec<f64>,
}

/// A model that knows some points.
pub struct Sparse<'a> {
    lattice: &'a Lattice,
    factor: Factor<'a>,
    inverse: SelectedInverse<'a>,
    /// The field at the nodes.
    mean_mm: Vec<f64>,
    /// What field and effects leave of each observation.
    residuals_mm: Vec<f64>,
    /// By how much the field at the nodes falls with each effect: P^-1 B'H / s^2.
    follows: Mat<f64>,
    found: DVector<f64>,
    covariance: DMatrix<f64>,
    likelihood: f64,
}

impl<'a> Sparse<'a> {
    /// Fits the effects and the field to what was measured.
    ///
    /// # Errors
    /// Those of [`super::Dense::fit`].
    pub fn fit(lattice: &'a Lattice, observed: &Observed, hyper: Hyper) -> Result<Self, ModelError> {
        observed.check()?;
        hyper.check()?;
        let Observed { places, deviations_mm, .. } = observed;
        let (effects, vague) = (observed.all_effects(), observed.effects.ncols());
        let (n, p) = (places.len(), effects.ncols());
        let precision2 = hyper.white_scatter_mm().powi(-2);
        if (hyper.field.smoothness, hyper.field.lay) != (lattice.field.smoothness, lattice.field.lay) {
            return Err(ModelError::OtherGrid);
        }
        let around: Vec<Around> = places.iter().map(|&place| lattice.around(place)).collect();
        let mut values = lattice.precision(&hyper, reach(hyper.field.smoothness)?);
        let before = lattice.pattern.factor(&values).ok_or(ModelError::NotDefinite)?.log_determinant();
        for nodes in &around {
            for (a, wa) in nodes {
                for (b, wb) in nodes.iter().filter(|(b, _)| b >= a) {
                    let entry = lattice.pattern.place(*b, *a).ok_or(ModelError::NotDefinite)?;
                    values[entry] += wa * wb * precision2;
                }
            }
        }
        let factor = lattice.pattern.factor(&values).ok_or(ModelError::NotDefinite)?;
        // B'H and B'd.
        let mut right = Mat::<f64>::zeros(lattice.nodes(), p + 1);
        for (k, nodes) in around.iter().enumerate() {
            for &(node, weight) in nodes {
                (0..p).for_each(|a| right[(node, a)] += weight * effects[(k, a)]);
                right[(node, p)] += weight * deviations_mm[k];
            }
        }
        let solved = factor.solve_all(&right).ok_or(ModelError::NotDefinite)?;
        let inner = |a: usize, b: usize| (0..lattice.nodes()).map(|k| right[(k, a)] * solved[(k, b)]).sum::<f64>();
        let plain = |a: usize, b: &dyn Fn(usize) -> f64| (0..n).map(|k| effects[(k, a)] * b(k)).sum::<f64>();
        let gram =
            DMatrix::from_fn(p, p, |a, b| (plain(a, &|k| effects[(k, b)]) - inner(a, b) * precision2) * precision2);
        let towards =
            DVector::from_fn(p, |a, _| (plain(a, &|k| deviations_mm[k]) - inner(a, p) * precision2) * precision2);
        let gram = told_apart(with_stated(gram, vague))?;
        let found = gram.solve(&towards);
        let follows = Mat::from_fn(lattice.nodes(), p, |r, c| solved[(r, c)] * precision2);
        let mean_mm: Vec<f64> = (0..lattice.nodes())
            .map(|k| solved[(k, p)] * precision2 - (0..p).map(|a| follows[(k, a)] * found[a]).sum::<f64>())
            .collect();
        let left = |(k, nodes): (usize, &Around)| {
            let field: f64 = nodes.iter().map(|&(node, weight)| weight * mean_mm[node]).sum();
            let moved: f64 = (0..p).map(|a| effects[(k, a)] * found[a]).sum();
            deviations_mm[k] - moved - field
        };
        let residuals_mm: Vec<f64> = around.iter().enumerate().map(left).collect();
        let squares = precision2 * deviations_mm.iter().zip(&residuals_mm).map(|(d, left)| d * left).sum::<f64>();
        let log_gram: f64 = 2.0 * gram.l_dirty().diagonal().iter().map(|v| v.ln()).sum::<f64>();
        let log_det = factor.log_determinant() - before - n as f64 * precision2.ln();
        Ok(Self {
            inverse: factor.selected_inverse().ok_or(ModelError::NotDefinite)?,
            lattice,
            factor,
            mean_mm,
            residuals_mm,
            follows,
            found,
            covariance: gram.inverse(),
            likelihood: -0.5 * (log_det + log_gram + squares + (n - vague) as f64 * std::f64::consts::TAU.ln()),
        })
    }

    /// What the field and the effects leave of each observation.
    pub(super) fn residuals_mm(&self) -> &[f64] {
        &self.residuals_mm
    }

    /// Returns the logarithm of the likelihood, as [`super::Dense::log_likelihood`] does.
    pub fn log_likelihood(&self) -> f64 {
        self.likelihood
    }

    /// Returns the effects and their covariance, as [`super::Dense::effects`] does.
    pub fn effects(&self) -> (&DVector<f64>, &DMatrix<f64>) {
        (&self.found, &self.covariance)
    }

    /// Tells the field at some places, the effects taken off.
    pub fn predict(&self, places: &[[f64; 2]]) -> Vec<Predicted> {
        let p = self.found.len();
        let tell = |&place: &[f64; 2]| {
            let nodes = self.lattice.around(place);
            let mean_mm = nodes.iter().map(|&(node, weight)| weight * self.mean_mm[node]).sum();
            let pairs = nodes.iter().flat_map(|&(a, wa)| nodes.iter().map(move |&(b, wb)| (a, b, wa * wb)));
            let known: f64 = pairs.map(|(a, b, weight)| weight * self.inverse.entry(a.max(b), a.min(b))).sum();
            let moved =
                DVector::from_fn(p, |a, _| nodes.iter().map(|&(node, w)| w * self.follows[(node, a)]).sum::<f64>());
            let by_effects = if p == 0 { 0.0 } else { moved.dot(&(&self.covariance * &moved)) };
            Predicted { mean_mm, sigma_mm: (known + by_effects).max(0.0).sqrt() }
        };
        places.par_iter().map(tell).collect()
    }

    /// Tells what the uncertainty of a sum over places, each with its weight, comes from.
    ///
    /// With the motions known the sum is told by a'd, of whose error the scatter makes s^2 a'a, an effect that is stated (e'a)^2, and the field what
    /// is left; that the motions are not known adds the rest.
    pub(super) fn parted(&self, observed: &Observed, hyper: &Hyper, sum: (&[[f64; 2]], &[f64])) -> Option<Parted> {
        let (nodes, vague, stated) = (self.lattice.nodes(), observed.effects.ncols(), observed.stated.ncols());
        let mut right = Mat::<f64>::zeros(nodes, 1);
        for (&place, weight) in sum.0.iter().zip(sum.1) {
            self.lattice.around(place).iter().for_each(|(node, share)| right[(*node, 0)] += weight * share);
        }
        let solved = self.factor.solve_all(&right)?;
        let own: f64 = (0..nodes).map(|k| right[(k, 0)] * solved[(k, 0)]).sum();
        let follows = |a: usize| (0..nodes).map(|k| self.follows[(k, a)] * right[(k, 0)]).sum::<f64>();
        let moved = DVector::from_fn(self.found.len(), |a, _| follows(a));
        let precision = self.covariance.clone().try_inverse()?;
        let precision = precision.view((vague, vague), (stated, stated)).into_owned();
        let held = if stated == 0 { DVector::zeros(0) } else { precision.try_inverse()? * moved.rows(vague, stated) };
        let pose_known = own + moved.rows(vague, stated).dot(&held);
        let precision2 = hyper.white_scatter_mm().powi(-2);
        let weight = |k: usize| {
            let around = self.lattice.around(observed.places[k]);
            let read = |of: &dyn Fn(usize) -> f64| around.iter().map(|&(node, share)| share * of(node)).sum::<f64>();
            let left = |c: usize| observed.stated[(k, c)] - read(&|node| self.follows[(node, vague + c)]);
            precision2 * (read(&|node| solved[(node, 0)]) - (0..stated).map(|c| left(c) * held[c]).sum::<f64>())
        };
        let weights = DVector::from_fn(observed.places.len(), |k, _| weight(k));
        let scatter = weights.norm_squared() / precision2;
        let stated: Vec<f64> = observed.stated.tr_mul(&weights).iter().map(|of| of * of).collect();
        let form = (pose_known - scatter - stated.iter().sum::<f64>()).max(0.0);
        let pose = (own + moved.dot(&(&self.covariance * &moved)) - pose_known).max(0.0);
        Some(Parted { scatter, form, pose, stated })
    }

    /// Draws fields that what was measured leaves possible, each with its own effects: a row a place, a column a sample, in millimetres. The
    /// same seed gives the same samples.
    ///
    /// # Errors
    /// Memory that does not suffice.
    pub fn samples(&self, places: &[[f64; 2]], count: usize, seed: u64) -> Result<DMatrix<f64>, ModelError> {
        let (nodes, p) = (self.lattice.nodes(), self.found.len());
        let around: Vec<Around> = places.iter().map(|&place| self.lattice.around(place)).collect();
        let root = self.covariance.clone().cholesky().map(|root| root.l());
        let batch = |first: usize| -> Option<Vec<f64>> {
            // Each sample has a stream of its own, and as many are made with it in every case: it is the same whichever others are wanted.
            let mut normals: Vec<Normals> = (first..first + BATCH).map(|k| Normals::new(seed, k as u64)).collect();
            let mut white = Mat::zeros(nodes, BATCH);
            for (c, normals) in normals.iter_mut().enumerate() {
                white.col_as_slice_mut(c).fill_with(|| normals.next());
            }
            let mut field = self.factor.colour(white)?;
            let mut values = Vec::with_capacity(BATCH * places.len());
            for (c, normals) in normals.iter_mut().enumerate().take(count - first) {
                let drawn = DVector::from_fn(p, |_, _| normals.next());
                let off = root.as_ref().map_or(DVector::zeros(p), |root| root * drawn);
                let field = field.col_as_slice_mut(c);
                field.iter_mut().zip(&self.mean_mm).for_each(|(field, mean)| *field += mean);
                for (a, off) in off.iter().enumerate() {
                    field.iter_mut().zip(self.follows.col_as_slice(a)).for_each(|(field, of)| *field -= of * off);
                }
                let at = |nodes: &Around| nodes.iter().map(|&(node, weight)| weight * field[node]).sum::<f64>();
                values.extend(around.iter().map(at));
            }
            Some(values)
        };
        let firsts: Vec<usize> = (0..count).step_by(BATCH).collect();
        let batches: Option<Vec<Vec<f64>>> = firsts.into_par_iter().map(batch).collect();
        let values = batches.ok_or(ModelError::NotDefinite)?.concat();
        Ok(DMatrix::from_vec(places.len(), count, values))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Dense, Lay};
    use super::*;

    const HYPER: Hyper = Hyper { field: Field::new(5e-3, 30.0), scatter_mm: 3e-4, drift: 0.0 };

    #[test]
    fn within_reach_of_an_end_a_node_is_like_none_but_itself() {
        let of = |count: usize| (0..count).map(|k| like(k, count, 3)).collect::<Vec<_>>();
        assert_eq!(of(11), [0, 1, 2, 3, 4, 4, 4, 5, 6, 7, 8]);
        assert_eq!(of(9), [0, 1, 2, 3, 4, 5, 6, 7, 8]);
        assert_eq!(of(4), [0, 1, 2, 3]);
    }

    fn places(count: u32) -> Vec<[f64; 2]> {
        // Steps of two irrational numbers: everywhere, and nowhere twice.
        (0..count)
            .map(|k| f64::from(k) + 0.5)
            .map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0])
            .collect()
    }

    /// Points of a shape with motions of a part as effects.
    fn observed(count: u32) -> Observed {
        let places = places(count);
        let mut normals = Normals::new(3, 0);
        let shape = |[x, y]: [f64; 2]| 5e-3 * ((0.08 * x).sin() * (0.11 * y).cos() + 0.4 * (0.17 * x + 0.05 * y).sin());
        let deviations_mm = places.iter().map(|&place| shape(place) + 3e-4 * normals.next()).collect();
        let effects = DMatrix::from_fn(places.len(), 3, |r, c| [1.0, places[r][0] - 50.0, places[r][1] - 30.0][c]);
        Observed { effects, ..Observed::without_effects(places, deviations_mm) }
    }

    /// A field of each smoothness, one with a lay, and one far wider than the part.
    fn hypers() -> [Hyper; 4] {
        let smooth = Field { smoothness: Smoothness::Thrice, ..HYPER.field };
        let fields = [
            HYPER.field,
            Field { range_mm: 45.0, ..smooth },
            Field { lay: Lay::at(0.4, 3.0), range_mm: 40.0, ..HYPER.field },
            Field { sigma_mm: 0.03, range_mm: 150.0, ..smooth },
        ];
        fields.map(|field| Hyper { field, ..HYPER })
    }

    #[test]
    fn it_tells_what_the_covariances_of_all_points_tell() {
        let observed = observed(1500);
        let asked: Vec<[f64; 2]> = (0..600).map(|k| [4.1 * f64::from(k % 25), 2.6 * f64::from(k / 25)]).collect();
        for hyper in hypers() {
            let exact = Dense::fit(&observed, hyper).unwrap();
            let lattice = Lattice::over(&observed.places, &hyper.field).unwrap();
            let sparse = Sparse::fit(&lattice, &observed, hyper).unwrap();
            let (mut worst_mean, mut worst_sigma) = (0.0_f64, 0.0_f64);
            for (a, b) in exact.predict(&asked).into_iter().zip(sparse.predict(&asked)) {
                worst_mean = worst_mean.max((a.mean_mm - b.mean_mm).abs() / a.sigma_mm);
                worst_sigma = worst_sigma.max((b.sigma_mm / a.sigma_mm - 1.0).abs());
            }
            println!(
                "{} nodes: mean off by {worst_mean:.4} sigma, sigma by {:.3} %",
                lattice.nodes(),
                100.0 * worst_sigma
            );
            assert!(worst_mean < 0.05 && worst_sigma < 0.02, "{hyper:?} {worst_mean} {worst_sigma}");
            let sigmas = |found: &DMatrix<f64>| found.diagonal().map(f64::sqrt);
            let (a, b) = (sigmas(exact.effects().1), sigmas(sparse.effects().1));
            assert!((0..3).all(|k| (b[k] / a[k] - 1.0).abs() < 0.02), "{hyper:?} {a} {b}");
            let off = exact.effects().0 - sparse.effects().0;
            assert!((0..3).all(|k| off[k].abs() < 0.05 * a[k]), "{hyper:?} {off} {a}");
            let likelihoods = [exact.log_likelihood(), sparse.log_likelihood()];
            assert!((likelihoods[0] - likelihoods[1]).abs() < 3.0, "{hyper:?} {likelihoods:?}");
        }
    }

    #[test]
    fn what_is_stated_it_tells_as_the_covariances_of_all_points_do_and_parts_its_variance() {
        let mut observed = observed(600);
        let rows: Vec<[f64; 2]> =
            observed.places.iter().map(|[x, y]| [2e-3, 4e-3 * ((x - 50.0) / 50.0).powi(2) + 1e-5 * y]).collect();
        observed.stated = DMatrix::from_fn(600, 2, |r, c| rows[r][c]);
        let exact = Dense::fit(&observed, HYPER).unwrap();
        let lattice = Lattice::over(&observed.places, &HYPER.field).unwrap();
        let sparse = Sparse::fit(&lattice, &observed, HYPER).unwrap();
        let asked: Vec<[f64; 2]> = (0..150).map(|k| [8.1 * f64::from(k % 12), 5.0 * f64::from(k / 12)]).collect();
        for (a, b) in exact.predict(&asked).into_iter().zip(sparse.predict(&asked)) {
            assert!((a.mean_mm - b.mean_mm).abs() < 0.06 * a.sigma_mm && (b.sigma_mm / a.sigma_mm - 1.0).abs() < 0.03);
        }
        let [a, b] = [exact.log_likelihood(), sparse.log_likelihood()];
        assert!((a - b).abs() < 3.0, "{a} {b}");
        // What is stated makes the field less well known, never better.
        let before = Dense::fit(&Observed { stated: DMatrix::zeros(600, 0), ..observed.clone() }, HYPER).unwrap();
        let sigma = |model: &Dense| model.predict(&asked[40..41])[0].sigma_mm;
        assert!(sigma(&exact) > sigma(&before));
        // The variance of one place is the sum of its parts.
        for place in &asked {
            let parts = sparse.parted(&observed, &HYPER, (&[*place], &[1.0])).unwrap();
            let whole = parts.scatter + parts.form + parts.pose + parts.stated.iter().sum::<f64>();
            let told = sparse.predict(&[*place])[0].sigma_mm.powi(2);
            assert!((whole / told - 1.0).abs() < 1e-6, "{whole} {told}");
            assert!(parts.scatter > 0.0 && parts.form > 0.0 && parts.stated[1] > 0.0);
        }
    }

    #[test]
    fn samples_scatter_as_it_says_and_are_the_same_for_a_seed() {
        let observed = observed(120);
        let lattice = Lattice::over(&observed.places, &HYPER.field).unwrap();
        let model = Sparse::fit(&lattice, &observed, HYPER).unwrap();
        let asked = [[10.0, 10.0], [50.0, 30.0], [101.0, 61.0], [0.0, 62.0]];
        let samples = model.samples(&asked, 4000, 1).unwrap();
        for (row, told) in samples.row_iter().zip(model.predict(&asked)) {
            let mean = row.mean();
            let sigma = (row.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 4000.0).sqrt();
            assert!((mean - told.mean_mm).abs() < 0.08 * told.sigma_mm, "{mean} {told:?}");
            assert!((sigma / told.sigma_mm - 1.0).abs() < 0.06, "{sigma} {told:?}");
        }
        let again = model.samples(&asked, 60, 1).unwrap();
        assert_eq!(again.columns(0, 60), samples.columns(0, 60));
        assert_ne!(model.samples(&asked, 60, 2).unwrap(), again);
    }

    #[test]
    fn before_anything_is_measured_it_is_the_field() {
        // One point far from all that is asked for.
        let observed = Observed::without_effects(vec![[300.0, 300.0]], vec![0.0]);
        let asked = [[0.0, 0.0], [37.3, 11.9], [90.0, 60.0]];
        let all: Vec<[f64; 2]> = asked.iter().copied().chain(observed.places.clone()).collect();
        for hyper in &hypers()[..3] {
            let lattice = Lattice::over(&all, &hyper.field).unwrap();
            let model = Sparse::fit(&lattice, &observed, *hyper).unwrap();
            for told in model.predict(&asked) {
                assert!(told.mean_mm.abs() < 1e-12);
                assert!((told.sigma_mm / hyper.field.sigma_mm - 1.0).abs() < 0.02, "{hyper:?} {told:?}");
            }
        }
    }

    #[test]
    fn a_grid_that_cannot_be_is_refused_in_words() {
        let of = |places: &[[f64; 2]], range_mm| {
            Lattice::over(places, &Field::new(1.0, range_mm)).err().unwrap().to_string()
        };
        assert!(of(&[], 1.0).contains("1 points at least"));
        assert!(of(&[[0.0, f64::NAN]], 1.0).contains("point 1 "));
        assert!(of(&[[0.0; 2]], 0.0).contains("the range is 0 mm"));
        assert!(of(&[[0.0; 2], [1e6, 1e6]], 1.0).contains("more than 120000"));
        let endless = Field { smoothness: Smoothness::Endless, ..Field::new(1.0, 1.0) };
        assert!(Lattice::over(&[[5.0, 5.0]], &endless).err().unwrap().to_string().contains("no precision"));
        let observed = Observed::without_effects(vec![[5.0, 5.0]], vec![0.0]);
        let lattice = Lattice::over(&observed.places, &Field::new(1.0, 1.0)).unwrap();
        let other = Hyper { field: Field { lay: Lay::at(0.0, 2.0), ..Field::new(1.0, 1.0) }, ..HYPER };
        assert!(Sparse::fit(&lattice, &observed, other).err().unwrap().to_string().contains("another lay"));
        assert!(Lattice::over(&[[5.0, 5.0]], &Field::new(1.0, 1.0)).is_ok(), "one place is enough");
    }
}
