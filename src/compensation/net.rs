//! A regular net over x and y that maps and corrections are written on.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Most nodes a net may have: a correction is read back over a wire.
const MOST_NODES: f64 = 4e6;

/// A regular net over x and y of the model frame; nodes run row by row, x fastest.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Net {
    /// Nodes along x.
    pub columns: usize,
    /// Nodes along y.
    pub rows: usize,
    /// The first node, in millimetres.
    pub first_mm: [f64; 2],
    /// Distance of the nodes, in millimetres.
    pub spacing_mm: [f64; 2],
}

/// Why there is no such net.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
pub enum NetError {
    #[error("a map with nodes every {spacing_mm} mm is asked for; the spacing must be above 0")]
    Spacing { spacing_mm: f64 },
    #[error(
        "a map with nodes every {spacing_mm} mm over {width_mm:.1} x {depth_mm:.1} mm has {nodes:.0} nodes, more than \
         {MOST_NODES:.0}; choose a wider spacing"
    )]
    TooFine { spacing_mm: f64, width_mm: f64, depth_mm: f64, nodes: f64 },
    #[error("there is no point to lay a map over")]
    NoPoints,
}

impl Net {
    /// Lays a net over the bounds of some places, its spacing at most the one wanted, its border on the bounds.
    ///
    /// # Errors
    /// A spacing that is not above 0 or makes too many nodes; no place.
    pub fn over(places_mm: impl Iterator<Item = [f64; 2]>, spacing_mm: f64) -> Result<Self, NetError> {
        let mut bounds: Option<[[f64; 2]; 2]> = None;
        for [x, y] in places_mm {
            let [low, high] = bounds.get_or_insert([[x, y]; 2]);
            (low[0], low[1]) = (low[0].min(x), low[1].min(y));
            (high[0], high[1]) = (high[0].max(x), high[1].max(y));
        }
        let [low, high] = bounds.ok_or(NetError::NoPoints)?;
        if !(spacing_mm > 0.0 && spacing_mm.is_finite()) {
            return Err(NetError::Spacing { spacing_mm });
        }
        let sizes = [high[0] - low[0], high[1] - low[1]];
        let steps = sizes.map(|size| (size / spacing_mm).ceil().max(1.0));
        let nodes = (steps[0] + 1.0) * (steps[1] + 1.0);
        if nodes > MOST_NODES || nodes.is_nan() {
            let [width_mm, depth_mm] = sizes;
            return Err(NetError::TooFine { spacing_mm, width_mm, depth_mm, nodes });
        }
        // A single column or row keeps a spacing of its own, so that positions stay apart.
        let spacing = |size: f64, steps: f64| if size > 0.0 { size / steps } else { spacing_mm };
        Ok(Self {
            columns: steps[0] as usize + 1,
            rows: steps[1] as usize + 1,
            first_mm: low,
            spacing_mm: [spacing(sizes[0], steps[0]), spacing(sizes[1], steps[1])],
        })
    }

    /// Returns the number of nodes.
    pub fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// Whether there is no node.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns x and y of a node, in millimetres.
    pub fn place_mm(&self, node: usize) -> [f64; 2] {
        let (i, j) = (node % self.columns, node / self.columns);
        [self.first_mm[0] + i as f64 * self.spacing_mm[0], self.first_mm[1] + j as f64 * self.spacing_mm[1]]
    }

    /// Returns the value at a place between the nodes, bilinear; beyond the border that of the nearest place on it.
    pub fn interpolate(&self, values: &[f64], [x, y]: [f64; 2]) -> f64 {
        let along = |at: f64, first: f64, spacing: f64, nodes: usize| {
            let u = ((at - first) / spacing).clamp(0.0, (nodes - 1) as f64);
            let cell = (u as usize).min(nodes.saturating_sub(2));
            (cell, u - cell as f64)
        };
        let (i, u) = along(x, self.first_mm[0], self.spacing_mm[0], self.columns);
        let (j, v) = along(y, self.first_mm[1], self.spacing_mm[1], self.rows);
        let at = |i: usize, j: usize| values[j.min(self.rows - 1) * self.columns + i.min(self.columns - 1)];
        (1.0 - v) * ((1.0 - u) * at(i, j) + u * at(i + 1, j)) + v * ((1.0 - u) * at(i, j + 1) + u * at(i + 1, j + 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_net_reaches_from_border_to_border() {
        let net = Net::over([[-1.0, 2.0], [3.0, 5.5]].into_iter(), 1.0).unwrap();
        assert_eq!((net.columns, net.rows), (5, 5));
        assert_eq!(net.place_mm(0), [-1.0, 2.0]);
        assert_eq!(net.place_mm(24), [3.0, 5.5]);
        assert_eq!(Net::over(std::iter::empty(), 1.0), Err(NetError::NoPoints));
        assert!(matches!(Net::over([[0.0; 2]].into_iter(), f64::NAN), Err(NetError::Spacing { .. })));
        assert!(matches!(Net::over([[0.0; 2], [1e9, 1.0]].into_iter(), 1e-3), Err(NetError::TooFine { .. })));
        let line = Net::over([[0.0, 1.0], [4.0, 1.0]].into_iter(), 2.0).unwrap();
        assert_eq!(line.interpolate(&[1.0, 2.0, 4.0, 1.0, 2.0, 4.0], [3.0, 1.0]), 3.0);
    }

    #[test]
    fn values_between_nodes_are_bilinear_and_level_off_outside() {
        let net = Net { columns: 3, rows: 2, first_mm: [0.0, 0.0], spacing_mm: [1.0, 2.0] };
        let plane = |[x, y]: [f64; 2]| 1.0 + 2.0 * x - 0.5 * y;
        let values: Vec<f64> = (0..6).map(|k| plane(net.place_mm(k))).collect();
        for place in [[0.3, 0.1], [1.9, 2.0], [2.0, 1.3]] {
            assert!((net.interpolate(&values, place) - plane(place)).abs() < 1e-15);
        }
        assert_eq!(net.interpolate(&values, [9.0, -4.0]), plane([2.0, 0.0]));
    }
}
