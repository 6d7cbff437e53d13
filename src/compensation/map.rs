//! From scattered deviations to a smooth map on a net.
//!
//! At every node a plane is fitted to the deviations around it with the weights of the areal Gaussian filter (ISO 16610-61; as
//! a regression filter of first order, ISO 16610-31, robustness left out). Inside the part this is the Gaussian filter, 50 % at the cut-off; at an edge
//! the plane carries on the slope that is there, so that nothing is pulled towards zero as padding would.

use rayon::prelude::*;
use thiserror::Error;

use super::net::{Net, NetError};

/// Weights beyond this share of the cut-off are below 1e-6 of the largest.
const REACH: f64 = 1.0;
/// alpha = sqrt(ln 2 / pi), by which the filter passes one half at the cut-off.
const ALPHA: f64 = 0.469_718_639_349_825_66;
/// Fewer points than this around a node are no evidence for a plane.
const LEAST_POINTS: usize = 6;

/// One deviation and where it was measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// x and y of the contact point in the model frame, in millimetres.
    pub at_mm: [f64; 2],
    /// Positive where material stands proud, in millimetres.
    pub deviation_mm: f64,
}

/// How a map is made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOptions {
    /// Wavelength at which half of the amplitude passes, in millimetres.
    pub cutoff_mm: f64,
    /// Wanted distance of the nodes, in millimetres.
    pub spacing_mm: f64,
}

/// A smooth map of the error of the part.
#[derive(Clone, Debug, PartialEq)]
pub struct ErrorMap {
    /// Where the nodes are.
    pub net: Net,
    /// The error at every node in millimetres, finite everywhere; where `valid` is not, that of the nearest valid node.
    pub values_mm: Vec<f64>,
    /// Whether enough was measured around a node.
    pub valid: Vec<bool>,
    /// Standard deviation of the deviations from the map, in millimetres: what the filter took out.
    pub rest_sigma_mm: f64,
}

/// Why there is no map.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
pub enum MapError {
    #[error(transparent)]
    Net(#[from] NetError),
    #[error("a cut-off of {cutoff_mm} mm is asked for; it must be above 0")]
    Cutoff { cutoff_mm: f64 },
    #[error("deviation {} is not finite; the measurement must not be used", index + 1)]
    NotFinite { index: usize },
    #[error(
        "only {valid} of {nodes} nodes have {LEAST_POINTS} measured points within the cut-off of {cutoff_mm} mm; measure more \
         densely or choose a longer cut-off"
    )]
    TooSparse { valid: usize, nodes: usize, cutoff_mm: f64 },
}

/// Filters deviations and lays them on a net.
///
/// Shapes: readings in any order. Frames: x and y of the model frame. Units: millimetres. Equation: weighted least squares of a
/// plane at every node with weights exp(-pi (r / (alpha cutoff))^2), alpha = sqrt(ln 2 / pi).
///
/// # Errors
/// Deviations that are not finite, too few of them for the cut-off, and a net that cannot be.
pub fn error_map(readings: &[Reading], options: &MapOptions) -> Result<ErrorMap, MapError> {
    let MapOptions { cutoff_mm, spacing_mm } = *options;
    if !(cutoff_mm > 0.0 && cutoff_mm.is_finite()) {
        return Err(MapError::Cutoff { cutoff_mm });
    }
    if let Some(index) = readings.iter().position(|r| !(r.at_mm[0] + r.at_mm[1] + r.deviation_mm).is_finite()) {
        return Err(MapError::NotFinite { index });
    }
    let net = Net::over(readings.iter().map(|r| r.at_mm), spacing_mm)?;
    let buckets = Buckets::new(readings, REACH * cutoff_mm);
    let fitted: Vec<Option<f64>> =
        (0..net.len()).into_par_iter().map(|node| buckets.plane_at(net.place_mm(node), cutoff_mm)).collect();
    let valid: Vec<bool> = fitted.iter().map(Option::is_some).collect();
    let count = valid.iter().filter(|v| **v).count();
    if count * 4 < net.len() {
        return Err(MapError::TooSparse { valid: count, nodes: net.len(), cutoff_mm });
    }
    let values_mm = level_off(&net, &fitted);
    let rest2: f64 = readings.iter().map(|r| (r.deviation_mm - net.interpolate(&values_mm, r.at_mm)).powi(2)).sum();
    let rest_sigma_mm = (rest2 / readings.len() as f64).sqrt();
    Ok(ErrorMap { net, values_mm, valid, rest_sigma_mm })
}

impl ErrorMap {
    /// Returns the filtered error at a place, in millimetres.
    pub fn at(&self, place_mm: [f64; 2]) -> f64 {
        self.net.interpolate(&self.values_mm, place_mm)
    }

    /// Returns x, y and the error of every valid node, in millimetres.
    pub fn samples_mm(&self) -> Vec<[f64; 3]> {
        let nodes = (0..self.net.len()).filter(|&k| self.valid[k]);
        nodes.map(|k| (self.net.place_mm(k), self.values_mm[k])).map(|([x, y], e)| [x, y, e]).collect()
    }
}

/// The readings, sorted into square cells as wide as the filter reaches.
struct Buckets<'a> {
    readings: &'a [Reading],
    /// Indices of the readings, cell by cell.
    order: Vec<u32>,
    /// Where each cell begins in `order`; one more than there are cells.
    begins: Vec<u32>,
    first_mm: [f64; 2],
    size_mm: f64,
    cells: [usize; 2],
}

impl<'a> Buckets<'a> {
    fn new(readings: &'a [Reading], reach_mm: f64) -> Self {
        let fold = |pick: fn(f64, f64) -> f64, start: f64| {
            readings.iter().fold([start; 2], |b, r| [pick(b[0], r.at_mm[0]), pick(b[1], r.at_mm[1])])
        };
        let (low, high) = (fold(f64::min, f64::INFINITY), fold(f64::max, f64::NEG_INFINITY));
        // A short reach over a large part must not ask for more cells than there are readings to put in them.
        let area = (high[0] - low[0]).max(reach_mm) * (high[1] - low[1]).max(reach_mm);
        let size_mm = reach_mm.max((area / (4 * readings.len()) as f64).sqrt());
        let cells = [0, 1].map(|k| ((high[k] - low[k]) / size_mm) as usize + 1);
        let mut begins = vec![0u32; cells[0] * cells[1] + 1];
        let cell = |r: &Reading| {
            let [i, j] = [0, 1].map(|k| (((r.at_mm[k] - low[k]) / size_mm) as usize).min(cells[k] - 1));
            j * cells[0] + i
        };
        readings.iter().for_each(|r| begins[cell(r) + 1] += 1);
        for k in 1..begins.len() {
            begins[k] += begins[k - 1];
        }
        let mut next = begins.clone();
        let mut order = vec![0u32; readings.len()];
        for (index, r) in readings.iter().enumerate() {
            let slot = &mut next[cell(r)];
            order[*slot as usize] = index as u32;
            *slot += 1;
        }
        Self { readings, order, begins, first_mm: low, size_mm, cells }
    }

    /// Returns the readings of the cells within reach of a place.
    fn near(&self, place_mm: [f64; 2]) -> impl Iterator<Item = &Reading> {
        let [(i0, i1), (j0, j1)] = [0, 1].map(|k| {
            let c = ((place_mm[k] - self.first_mm[k]) / self.size_mm).floor();
            (c.max(1.0) as usize - 1, ((c + 1.0).max(0.0) as usize).min(self.cells[k] - 1))
        });
        (j0..=j1).flat_map(move |j| {
            let row = j * self.cells[0];
            let (begin, end) = (self.begins[row + i0.min(i1)] as usize, self.begins[row + i1 + 1] as usize);
            self.order[begin..end].iter().map(|&index| &self.readings[index as usize])
        })
    }

    /// Fits the weighted plane at a place and returns its height there; `None` where too little was measured.
    fn plane_at(&self, place_mm: [f64; 2], cutoff_mm: f64) -> Option<f64> {
        let reach2 = (REACH * cutoff_mm).powi(2);
        let falloff = std::f64::consts::PI / (ALPHA * cutoff_mm).powi(2);
        // Moments of the weights: 1, x, y, xx, xy, yy, and of the weighted deviations: d, xd, yd; lengths in cut-offs.
        let (mut m, mut count) = ([0.0f64; 9], 0usize);
        for r in self.near(place_mm) {
            let (x, y) = (r.at_mm[0] - place_mm[0], r.at_mm[1] - place_mm[1]);
            let r2 = x * x + y * y;
            if r2 <= reach2 {
                let (w, x, y, d) = ((-falloff * r2).exp(), x / cutoff_mm, y / cutoff_mm, r.deviation_mm);
                for (sum, term) in m.iter_mut().zip([1.0, x, y, x * x, x * y, y * y, d, x * d, y * d]) {
                    *sum += w * term;
                }
                count += 1;
            }
        }
        if count < LEAST_POINTS { None } else { plane(m) }
    }
}

/// Solves the normal equations for the plane's height at the origin; `None` where the points lie all to one side or on a line.
fn plane([s, x, y, xx, xy, yy, d, xd, yd]: [f64; 9]) -> Option<f64> {
    // Centred at the mean place, the slope part is 2 by 2.
    let (mx, my, md) = (x / s, y / s, d / s);
    let (cxx, cxy, cyy) = (xx / s - mx * mx, xy / s - mx * my, yy / s - my * my);
    let (cxd, cyd) = (xd / s - mx * md, yd / s - my * md);
    let determinant = cxx * cyy - cxy * cxy;
    // The mean place must not be farther away than the points are wide: that would be extrapolation.
    let flat = determinant <= 1e-4 * (cxx + cyy).powi(2) || determinant.is_nan();
    if flat || mx * mx + my * my > 4.0 * (cxx + cyy) {
        return None;
    }
    let (p, q) = ((cyy * cxd - cxy * cyd) / determinant, (cxx * cyd - cxy * cxd) / determinant);
    Some(md - p * mx - q * my)
}

/// Gives every node without a value that of the nearest node with one, so that the map levels off outside.
fn level_off(net: &Net, fitted: &[Option<f64>]) -> Vec<f64> {
    let mut values: Vec<f64> = fitted.iter().map(|v| v.unwrap_or(f64::NAN)).collect();
    // Rings grow outwards from the valid nodes; the first to arrive is the nearest in steps.
    let mut edge: Vec<usize> = (0..net.len()).filter(|&k| fitted[k].is_some()).collect();
    while !edge.is_empty() {
        let mut next = Vec::new();
        for k in edge {
            let (i, j) = (k % net.columns, k / net.columns);
            let left = (i > 0).then(|| k - 1);
            let right = (i + 1 < net.columns).then_some(k + 1);
            let below = (j > 0).then(|| k - net.columns);
            let above = (j + 1 < net.rows).then_some(k + net.columns);
            for neighbour in [left, right, below, above].into_iter().flatten() {
                if values[neighbour].is_nan() {
                    values[neighbour] = values[k];
                    next.push(neighbour);
                }
            }
        }
        edge = next;
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Readings every `step` over a rectangle, of a function of the place.
    fn sampled(width: f64, depth: f64, step: f64, f: impl Fn(f64, f64) -> f64) -> Vec<Reading> {
        let (columns, rows) = ((width / step) as usize + 1, (depth / step) as usize + 1);
        (0..columns * rows)
            .map(|k| [(k % columns) as f64 * step - width / 2.0, (k / columns) as f64 * step - depth / 2.0])
            .map(|at_mm| Reading { at_mm, deviation_mm: f(at_mm[0], at_mm[1]) })
            .collect()
    }

    fn made(readings: &[Reading], cutoff_mm: f64) -> ErrorMap {
        error_map(readings, &MapOptions { cutoff_mm, spacing_mm: 1.0 }).unwrap()
    }

    #[test]
    fn nothing_gives_nothing_and_a_plane_stays_a_plane_to_its_edges() {
        assert!(made(&sampled(40.0, 30.0, 1.0, |_, _| 0.0), 8.0).values_mm.iter().all(|v| *v == 0.0));
        let plane = |x: f64, y: f64| 3e-3 + 1e-4 * x - 2e-4 * y;
        let map = made(&sampled(40.0, 30.0, 1.0, plane), 8.0);
        for k in 0..map.net.len() {
            let [x, y] = map.net.place_mm(k);
            assert!(map.valid[k] && (map.values_mm[k] - plane(x, y)).abs() < 1e-15);
        }
    }

    #[test]
    fn a_wave_at_the_cutoff_passes_by_half() {
        let cutoff = 10.0;
        for (ratio, passed) in [(1.0, 0.5), (2.0, 0.5f64.powf(0.25)), (0.5, 0.5f64.powi(4))] {
            let k = std::f64::consts::TAU / (ratio * cutoff);
            let map = made(&sampled(80.0, 60.0, 0.5, |x, _| 1e-3 * (k * x).cos()), cutoff);
            assert!((map.at([0.0, 0.0]) - 1e-3 * passed).abs() < 5e-6, "{ratio}: {}", map.at([0.0, 0.0]));
        }
    }

    #[test]
    fn a_hole_is_not_valid_and_levels_off() {
        let mut readings = sampled(60.0, 60.0, 1.0, |x, _| 1e-5 * x);
        readings.retain(|r| r.at_mm[0].hypot(r.at_mm[1]) > 15.0);
        let map = made(&readings, 6.0);
        let middle = (0..map.net.len()).find(|&k| map.net.place_mm(k) == [0.0, 0.0]).unwrap();
        assert!(!map.valid[middle]);
        assert!(map.values_mm.iter().all(|v| v.is_finite() && v.abs() < 3.1e-4));
    }

    #[test]
    fn the_order_of_the_points_does_not_matter() {
        let mut readings = sampled(30.0, 30.0, 1.3, |x, y| 1e-3 * (0.3 * x + 0.2 * y).sin());
        let map = made(&readings, 7.0);
        readings.reverse();
        let back = made(&readings, 7.0);
        assert!(map.values_mm.iter().zip(&back.values_mm).all(|(a, b)| (a - b).abs() < 1e-15));
    }

    #[test]
    fn what_makes_no_map_is_said() {
        let options = MapOptions { cutoff_mm: 5.0, spacing_mm: 1.0 };
        let mut readings = sampled(30.0, 30.0, 1.0, |_, _| 0.0);
        assert!(matches!(error_map(&[], &options), Err(MapError::Net(NetError::NoPoints))));
        let zero = MapOptions { cutoff_mm: 0.0, ..options };
        assert!(matches!(error_map(&readings, &zero), Err(MapError::Cutoff { .. })));
        readings[7].deviation_mm = f64::NAN;
        assert_eq!(error_map(&readings, &options), Err(MapError::NotFinite { index: 7 }));
        let sparse = sampled(100.0, 100.0, 20.0, |_, _| 0.0);
        assert!(matches!(error_map(&sparse, &options), Err(MapError::TooSparse { .. })));
        let line: Vec<Reading> = (0..100).map(|k| Reading { at_mm: [f64::from(k), 0.0], deviation_mm: 0.0 }).collect();
        assert!(matches!(error_map(&line, &options), Err(MapError::TooSparse { .. })));
    }
}
