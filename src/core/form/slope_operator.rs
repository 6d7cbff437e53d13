//! Slopes of many forms at the same scattered places. The part that depends only on the places is computed once.
//!
//! The slope at a place is the slope of the least-squares plane through the values at all places within a distance R.
//! This plane attenuates a wave of wavenumber k by the factor 1 - (k R)^2 / 12. A difference over a length L attenuates
//! the wave by 1 - (k L)^2 / 24. So a radius R = L / sqrt 2 gives the integration length L.

use nalgebra::{Matrix2, SymmetricEigen, Vector2};

use crate::geometry::bounds;

/// Minimum number of places, and minimum number of nodes (places with a slope), for slope figures.
const MIN_PLACES: usize = 20;
const MIN_NODES: usize = 6;
/// Maximum number of nodes, and maximum number of places from which the slope of a node is computed.
const MAX_NODES: usize = 1500;
const MAX_NEIGHBOURS: usize = 24;
/// Minimum radius, in mean spacings of the places: a little more than the diagonal of a square with this spacing as
/// side.
const MIN_RADIUS_SPACINGS: f64 = 1.5;
/// Limits and growth of the radius. The radius grows by the factor `RADIUS_GROWTH` while less than `MIN_NODE_SHARE` of
/// the nodes have a slope. It is at most `MAX_RADIUS_SHARE` of the shorter side of the part.
const MIN_NODE_SHARE: f64 = 0.25;
const MAX_RADIUS_SHARE: f64 = 0.3;
const RADIUS_GROWTH: f64 = 1.25;
/// Minimum variance of the surrounding places along any direction, in squared radii, and maximum offset of their
/// centroid, in radii. A place outside these limits lies at an edge and has no slope.
const MIN_VARIANCE: f64 = 0.08;
const MAX_CENTROID_OFFSET: f64 = 0.25;

/// Weights that give the slopes from the values at a set of places.
pub struct SlopeOperator {
    /// Integration length of the slopes, in mm.
    pub integration_mm: f64,
    /// Number of nodes.
    pub nodes: usize,
    /// Index in `weights` at which each node starts, followed by the length of `weights`.
    node_starts: Vec<usize>,
    /// Index of a place near a node, and the weights of its value for the slopes of that node along x and y.
    weights: Vec<(usize, [f64; 2])>,
}

impl SlopeOperator {
    /// Prepares the computation of slopes at scattered `places` (x and y in mm, model frame). The result can be used
    /// for many forms that are given at these places.
    ///
    /// `integration_mm` is the length, in mm, over which a slope is averaged. With `None`, the shortest length is used
    /// that the spacing of the places allows. If the places are too far apart for the given length, a longer one is
    /// used. The field [`SlopeOperator::integration_mm`] has the length that was used.
    ///
    /// Returns `None` if there are fewer than 20 places. Also returns `None` if no length up to about 0.4 of the
    /// shorter side of the part gives enough slopes: at least 6, and at a quarter or more of the examined places.
    pub fn new(places: &[[f64; 2]], integration_mm: Option<f64>) -> Option<Self> {
        if places.len() < MIN_PLACES {
            return None;
        }
        let [low, high] = bounds(places.iter().copied());
        let size_mm = [0, 1].map(|k| high[k] - low[k]);
        let spacing_mm = (size_mm[0] * size_mm[1] / places.len() as f64).sqrt();
        let longest_mm = MAX_RADIUS_SHARE * size_mm[0].min(size_mm[1]);
        let wanted_mm = integration_mm.filter(|mm| mm.is_finite() && *mm > 0.0).unwrap_or(0.0);
        let mut radius_mm = (wanted_mm / 2f64.sqrt()).max(MIN_RADIUS_SPACINGS * spacing_mm);
        if !(radius_mm.is_finite() && radius_mm > 0.0) {
            return None;
        }
        // Sorted along x, so that the near places form one contiguous run.
        let mut order: Vec<usize> = (0..places.len()).collect();
        order.sort_by(|&a, &b| places[a][0].total_cmp(&places[b][0]).then(a.cmp(&b)));
        while radius_mm <= longest_mm {
            let made = Self::with_radius(places, &order, radius_mm);
            let asked = places.len().min(MAX_NODES) as f64;
            if made.nodes >= MIN_NODES && made.nodes as f64 >= MIN_NODE_SHARE * asked {
                return Some(made);
            }
            radius_mm *= RADIUS_GROWTH;
        }
        None
    }

    /// Prepares an operator that computes the slopes of a form at up to [`MAX_NODES`] of the `places`, evenly chosen.
    /// The slope at such a place is that of the least-squares plane through the values at places within `radius_mm`.
    /// The operator holds the weights of these values.
    ///
    /// `order` has the indices of all places, sorted by x. A place is skipped if the places around it do not determine
    /// a slope: fewer than four, mainly on one side, or along a line.
    fn with_radius(places: &[[f64; 2]], order: &[usize], radius_mm: f64) -> Self {
        let most = places.len().min(MAX_NODES);
        let (mut begins, mut weights) = (vec![0], Vec::new());
        for of in (0..most).map(|k| k * places.len() / most) {
            if let Some(around) = plane_slope_weights(places, order, of, radius_mm) {
                weights.extend(around);
                begins.push(weights.len());
            }
        }
        Self { integration_mm: radius_mm * 2f64.sqrt(), nodes: begins.len() - 1, node_starts: begins, weights }
    }

    /// Computes the slope (the length of the gradient) of a form at each node, that is, at each place that has a slope.
    /// Returns the root mean square and the maximum of these slopes, in radians.
    ///
    /// `form` has one value in mm for each of the places given to [`SlopeOperator::new`], in the same order.
    pub fn evaluate(&self, form: &[f64]) -> [f64; 2] {
        let (mut squares, mut most) = (0.0, 0.0_f64);
        for ends in self.node_starts.windows(2) {
            let mut slope = [0.0; 2];
            for (place, weight) in &self.weights[ends[0]..ends[1]] {
                slope[0] += weight[0] * form[*place];
                slope[1] += weight[1] * form[*place];
            }
            let square = slope[0] * slope[0] + slope[1] * slope[1];
            squares += square;
            most = most.max(square);
        }
        [(squares / self.nodes as f64).sqrt(), most.sqrt()]
    }
}

/// Computes the weights that give the slope at one place, `places[of]`. The slope is that of the least-squares plane
/// through the values at the places within `radius_mm` of `places[of]`.
///
/// Returns one entry for each place that the plane uses, at most 24: the index of the place, and the weights of its
/// value for the slopes along x and along y, in 1 / mm. `order` has the indices of all places, sorted by x. Returns
/// `None` if fewer than four places are within the radius, or if these places lie mainly on one side or along a line.
fn plane_slope_weights(
    places: &[[f64; 2]],
    order: &[usize],
    of: usize,
    radius_mm: f64,
) -> Option<Vec<(usize, [f64; 2])>> {
    let [x, y] = places[of];
    let first = order.partition_point(|&k| places[k][0] < x - radius_mm);
    let run = order[first..].iter().copied().take_while(|&k| places[k][0] <= x + radius_mm);
    let near: Vec<usize> = run.filter(|&k| (places[k][0] - x).hypot(places[k][1] - y) <= radius_mm).collect();
    let count = near.len().min(MAX_NEIGHBOURS);
    if count < 4 {
        return None;
    }
    let near: Vec<usize> = (0..count).map(|k| near[k * near.len() / count]).collect();
    let at = |k: usize| Vector2::new(places[k][0] - x, places[k][1] - y) / radius_mm;
    let middle = near.iter().map(|&k| at(k)).sum::<Vector2<f64>>() / count as f64;
    let moment: Matrix2<f64> = near.iter().map(|&k| (at(k) - middle) * (at(k) - middle).transpose()).sum();
    let least = SymmetricEigen::new(moment).eigenvalues.min() / count as f64;
    if middle.norm() > MAX_CENTROID_OFFSET || least < MIN_VARIANCE {
        return None;
    }
    let inverse = moment.try_inverse()?;
    let weight = |k: usize| (inverse * (at(k) - middle) / radius_mm).into();
    Some(near.into_iter().map(|k| (k, weight(k))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(spacing_mm: f64) -> Vec<[f64; 2]> {
        let count = [(60.0 / spacing_mm) as i32, (40.0 / spacing_mm) as i32];
        let all = (0..=count[0]).flat_map(|i| (0..=count[1]).map(move |j| [f64::from(i), f64::from(j)]));
        all.map(|at| at.map(|v| v * spacing_mm)).collect()
    }

    fn scattered(count: u32) -> Vec<[f64; 2]> {
        let of = |k: f64| [(0.754_877_666 * k).fract() * 60.0, (0.569_840_291 * k).fract() * 40.0];
        (0..count).map(|k| of(f64::from(k) + 0.5)).collect()
    }

    fn slopes_of(at: &SlopeOperator, places: &[[f64; 2]], form: impl Fn(f64, f64) -> f64) -> [f64; 2] {
        at.evaluate(&places.iter().map(|[x, y]| form(*x, *y)).collect::<Vec<_>>())
    }

    #[test]
    fn slopes_at_match_plane() {
        for (places, wanted) in
            [(grid(1.0), None), (grid(2.0), Some(9.0)), (scattered(300), None), (scattered(60), None)]
        {
            let at = SlopeOperator::new(&places, wanted).unwrap();
            let [rms, most] = slopes_of(&at, &places, |x, y| 3e-6 * x - 4e-6 * y + 1.0);
            assert!((rms - 5e-6).abs() < 1e-14 && (most - 5e-6).abs() < 1e-14, "{rms} {most}");
            assert_eq!(slopes_of(&at, &places, |_, _| 0.0), [0.0; 2]);
            assert!(wanted.is_none_or(|wanted: f64| (at.integration_mm / wanted - 1.0).abs() < 1e-12));
        }
    }

    #[test]
    fn slopes_at_attenuate_wave_by_sinc() {
        // sin(kx) over a length L has the slope k cos(kx) sinc(kL/2).
        let k = std::f64::consts::TAU / 20.0;
        for (places, wanted) in [(grid(1.0), 2.0), (grid(1.0), 5.0), (grid(1.0), 8.0), (scattered(2400), 6.0)] {
            let at = SlopeOperator::new(&places, Some(wanted)).unwrap();
            let length = at.integration_mm;
            let expected = (0.5 * k * length).sin() / (0.5 * k * length) * k * 1e-6 / 2f64.sqrt();
            let [rms, most] = slopes_of(&at, &places, |x, _| 1e-6 * (k * x).sin());
            assert!((rms / expected - 1.0).abs() < 0.05, "{length}: {rms} {expected}");
            assert!((most / (expected * 2f64.sqrt()) - 1.0).abs() < 0.1, "{length}: {most}");
        }
    }

    #[test]
    fn slopes_at_scan_lines_and_few_points() {
        // A scan: 0.2 mm along, 4 mm across.
        let scan: Vec<[f64; 2]> =
            (0..11).flat_map(|j| (0..301).map(move |i| [0.2 * f64::from(i), 4.0 * f64::from(j)])).collect();
        let at = SlopeOperator::new(&scan, None).unwrap();
        assert!((4.0..16.0).contains(&at.integration_mm) && at.nodes > 300, "{} {}", at.integration_mm, at.nodes);
        assert!((slopes_of(&at, &scan, |x, y| 1e-6 * (x + y))[0] - 2f64.sqrt() * 1e-6).abs() < 1e-14);
        assert!(SlopeOperator::new(&scattered(19), None).is_none());
        let line: Vec<[f64; 2]> = (0..40).map(|k| [f64::from(k), 0.5 * f64::from(k)]).collect();
        assert!(SlopeOperator::new(&line, None).is_none() && SlopeOperator::new(&[[1.0; 2]; 40], None).is_none());
    }
}
