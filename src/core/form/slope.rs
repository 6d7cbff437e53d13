//! Slopes of a map.

use serde::Serialize;

use super::FormError;
use crate::geometry::{Grid, GridMap};

/// Slopes of a map over an integration length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Slope {
    /// Root mean square of the gradient's length.
    pub rms_rad: f64,
    /// Root mean square of the slopes along x and along y.
    #[serde(rename = "rms_along_rad")]
    pub axis_rms_rad: [f64; 2],
    /// Largest length of the gradient.
    #[serde(rename = "largest_rad")]
    pub max_rad: f64,
    /// Integration length along x and along y, in millimetres: an even number of steps of the grid.
    pub integration_mm: [f64; 2],
    /// Number of nodes with a slope.
    pub nodes: usize,
}

/// Computes the slopes of a map, and returns their root mean square and maximum over all nodes that have a slope. The
/// slopes are in radians.
///
/// The slope along x is a central difference: the value at half of `integration_mm` after the node, minus the value at
/// half of `integration_mm` before the node, divided by `integration_mm`. The slope along y is computed in the same
/// way. Before this, `integration_mm` is rounded to an even number of grid steps, at least two. A node has a slope if
/// the four nodes of its two differences are all valid.
///
/// # Errors
/// Returns an error if `integration_mm` is not a finite number above 0, or if no node has a slope.
pub fn slope(map: &GridMap, integration_mm: f64) -> Result<Slope, FormError> {
    if !(integration_mm > 0.0 && integration_mm.is_finite()) {
        return Err(FormError::Integration { integration_mm });
    }
    let Grid { columns, rows, spacing_mm, .. } = map.grid;
    let half = spacing_mm.map(|spacing| (0.5 * integration_mm / spacing).round().clamp(1.0, 1e9) as usize);
    let length_mm: [f64; 2] = std::array::from_fn(|k| 2.0 * half[k] as f64 * spacing_mm[k]);
    let known = |i: usize, j: usize| {
        let k = j * columns + i;
        (i < columns && j < rows && map.valid[k]).then(|| map.values_mm[k])
    };
    let (mut sums, mut largest, mut nodes) = ([0.0; 2], 0.0f64, 0usize);
    for j in half[1]..rows.saturating_sub(half[1]) {
        for i in half[0]..columns.saturating_sub(half[0]) {
            let ends = [(i - half[0], j), (i + half[0], j), (i, j - half[1]), (i, j + half[1])];
            let [Some(left), Some(right), Some(low), Some(high)] = ends.map(|(i, j)| known(i, j)) else { continue };
            let [x, y] = [(right - left) / length_mm[0], (high - low) / length_mm[1]];
            (sums[0], sums[1], nodes) = (sums[0] + x * x, sums[1] + y * y, nodes + 1);
            largest = largest.max(x.hypot(y));
        }
    }
    if nodes == 0 {
        return Err(FormError::NoSlope { integration_mm });
    }
    let mean = sums.map(|sum| sum / nodes as f64);
    Ok(Slope {
        rms_rad: (mean[0] + mean[1]).sqrt(),
        axis_rms_rad: mean.map(f64::sqrt),
        max_rad: largest,
        integration_mm: length_mm,
        nodes,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const NODES: usize = 41 * 31;

    fn slope_of(f: impl Fn(f64, f64) -> f64, valid: &[bool], integration_mm: f64) -> Result<Slope, FormError> {
        let grid = Grid { columns: 41, rows: 31, first_mm: [-20.0, -15.0], spacing_mm: [1.0; 2] };
        let values_mm = (0..NODES).map(|k| f((k % 41) as f64 - 20.0, (k / 41) as f64 - 15.0)).collect();
        slope(&GridMap { grid, values_mm, valid: valid.to_vec() }, integration_mm)
    }

    #[test]
    fn slope_of_plane_at_every_length() {
        let all = vec![true; NODES];
        for length in [0.1, 2.0, 3.0, 12.0] {
            let found = slope_of(|x, y| 3e-6 * x - 4e-6 * y + 1.0, &all, length).unwrap();
            assert!((found.rms_rad - 5e-6).abs() < 1e-15 && (found.max_rad - 5e-6).abs() < 1e-15);
            assert!((found.axis_rms_rad[0] - 3e-6).abs() < 1e-15);
        }
        assert_eq!(slope_of(|_, _| 0.0, &all, 4.0).unwrap().rms_rad, 0.0);
        let found = slope_of(|_, _| 0.0, &all, 4.9).unwrap();
        assert_eq!((found.integration_mm, found.nodes), ([4.0, 4.0], 37 * 27));
    }

    #[test]
    fn slope_of_wave_attenuated_by_sinc() {
        // sin(kx) over a length L has the slope k cos(kx) sinc(kL/2); its rms over whole waves is k sinc / sqrt 2.
        let (k, all) = (std::f64::consts::TAU / 12.0, vec![true; NODES]);
        for length in [2.0, 4.0, 6.0] {
            let expected = (0.5 * k * length).sin() / (0.5 * k * length) * k * 1e-6 / 2f64.sqrt();
            let found = slope_of(|x, _| 1e-6 * (k * x).sin(), &all, length).unwrap().axis_rms_rad[0];
            // Not whole waves: a few percent.
            assert!((found / expected - 1.0).abs() < 0.05, "{length}: {found} {expected}");
        }
    }

    #[test]
    fn slope_skips_invalid_nodes() {
        let mut valid = vec![true; NODES];
        valid[15 * 41 + 20] = false;
        let spike = |x: f64, y: f64| if (x, y) == (0.0, 0.0) { 1.0 } else { 0.0 };
        let found = slope_of(spike, &valid, 2.0).unwrap();
        assert_eq!((found.rms_rad, found.nodes), (0.0, 39 * 29 - 4));
        assert_eq!(slope_of(spike, &vec![false; NODES], 2.0), Err(FormError::NoSlope { integration_mm: 2.0 }));
        assert_eq!(slope_of(spike, &valid, 50.0), Err(FormError::NoSlope { integration_mm: 50.0 }));
        assert!(matches!(slope_of(spike, &valid, f64::NAN), Err(FormError::Integration { .. })));
    }
}
