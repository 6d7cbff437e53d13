//! A regular grid over x and y, for heights, maps and corrections.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Maximum number of nodes of a grid. It limits the size of a correction, which is read back from the machine over a
/// connection.
const MAX_NODES: f64 = 4e6;

/// Regular grid over x and y of the model frame; nodes run row by row, x fastest.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Grid {
    /// Number of nodes along x.
    pub columns: usize,
    /// Number of nodes along y.
    pub rows: usize,
    /// Position of the first node, in millimetres.
    pub first_mm: [f64; 2],
    /// Distance between nodes, along x and along y, in millimetres.
    pub spacing_mm: [f64; 2],
}

/// Reason why a grid cannot be built.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum GridError {
    #[error("the spacing of the map is {spacing_mm} mm; it must be a finite number above 0")]
    Spacing { spacing_mm: f64 },
    #[error(
        "a map with nodes every {spacing_mm} mm over {width_mm:.1} x {depth_mm:.1} mm has {nodes:.0} nodes, more than \
         {MAX_NODES:.0}; choose a wider spacing"
    )]
    TooFine { spacing_mm: f64, width_mm: f64, depth_mm: f64, nodes: f64 },
    #[error("there are no points for a map; check the measurement")]
    NoPoints,
}

impl Grid {
    /// Builds a grid that covers the smallest rectangle around `places_mm` (x and y of each place, in mm). The
    /// outermost nodes lie on the border of the rectangle.
    ///
    /// The spacing along x is the largest one that is at most `spacing_mm` and divides the width of the rectangle into
    /// equal steps. The spacing along y follows in the same way from the depth. If the width or the depth is 0, the
    /// grid has two nodes in this direction, at the distance `spacing_mm`.
    ///
    /// # Errors
    /// Returns an error if `spacing_mm` is not a finite number above 0, if the grid would have more than four million
    /// nodes, or if `places_mm` is empty.
    pub fn over(places_mm: impl Iterator<Item = [f64; 2]>, spacing_mm: f64) -> Result<Self, GridError> {
        let mut bounds: Option<[[f64; 2]; 2]> = None;
        for [x, y] in places_mm {
            let [low, high] = bounds.get_or_insert([[x, y]; 2]);
            (low[0], low[1]) = (low[0].min(x), low[1].min(y));
            (high[0], high[1]) = (high[0].max(x), high[1].max(y));
        }
        let [low, high] = bounds.ok_or(GridError::NoPoints)?;
        if !(spacing_mm > 0.0 && spacing_mm.is_finite()) {
            return Err(GridError::Spacing { spacing_mm });
        }
        let sizes = [high[0] - low[0], high[1] - low[1]];
        let steps = sizes.map(|size| (size / spacing_mm).ceil().max(1.0));
        let nodes = (steps[0] + 1.0) * (steps[1] + 1.0);
        if nodes > MAX_NODES || nodes.is_nan() {
            let [width_mm, depth_mm] = sizes;
            return Err(GridError::TooFine { spacing_mm, width_mm, depth_mm, nodes });
        }
        // A single column or row keeps the requested spacing, so that positions are distinct.
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

    /// Returns the number of nodes along x and along y.
    pub fn counts(&self) -> [usize; 2] {
        [self.columns, self.rows]
    }

    /// Returns true if there is no node.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns x and y of the node with the index `node`, in millimetres. Nodes are counted row by row, x fastest.
    pub fn place_mm(&self, node: usize) -> [f64; 2] {
        let (i, j) = (node % self.columns.max(1), node / self.columns.max(1));
        [self.first_mm[0] + i as f64 * self.spacing_mm[0], self.first_mm[1] + j as f64 * self.spacing_mm[1]]
    }

    /// Returns true if the grid has at least one and at most four million nodes, a finite first node and a finite
    /// spacing above 0. Use it for a grid that was read from a file.
    pub fn is_valid(&self) -> bool {
        let nodes = self.columns as f64 * self.rows as f64;
        self.columns > 0
            && self.rows > 0
            && nodes <= MAX_NODES
            && self.first_mm.iter().all(|v| v.is_finite())
            && self.spacing_mm.iter().all(|v| *v > 0.0 && v.is_finite())
    }

    /// Returns the index of the node nearest to `place_mm`; `None` if the place lies outside the grid by more than half
    /// a spacing.
    pub fn nearest(&self, place_mm: [f64; 2]) -> Option<usize> {
        let along = |k: usize, nodes: usize| {
            let node = ((place_mm[k] - self.first_mm[k]) / self.spacing_mm[k]).round();
            (0.0..nodes as f64).contains(&node).then_some(node as usize)
        };
        Some(along(1, self.rows)? * self.columns + along(0, self.columns)?)
    }

    /// Interpolates a map bilinearly from this grid to the grid `onto`. `values` has one value for each node of this
    /// grid. Returns one value for each node of `onto`.
    ///
    /// A node of `onto` outside this grid gets the value at the nearest position on the border of this grid. If both
    /// grids are equal, returns a copy of `values`.
    pub fn resample(&self, values: &[f64], onto: &Self) -> Vec<f64> {
        if self == onto {
            return values.to_vec();
        }
        (0..onto.len()).map(|k| self.interpolate(values, onto.place_mm(k))).collect()
    }

    /// Finds the cell of the grid that contains `place_mm` (x and y in mm). For a place outside the grid, finds the
    /// nearest cell.
    ///
    /// Returns one pair for x and one for y. The first number is the index of the column (x) or the row (y) at the
    /// lower side of the cell. The second number is the relative position in the cell, from 0 (lower side) to 1 (upper
    /// side).
    pub fn cell(&self, place_mm: [f64; 2]) -> [(usize, f64); 2] {
        [0, 1].map(|k| {
            let nodes = self.counts()[k];
            let at = ((place_mm[k] - self.first_mm[k]) / self.spacing_mm[k]).clamp(0.0, (nodes - 1) as f64);
            let lower = (at as usize).min(nodes.saturating_sub(2));
            (lower, at - lower as f64)
        })
    }

    /// Interpolates `values`, one for each node, bilinearly at `place_mm`. For a place outside the grid, returns the
    /// value at the nearest place on the border.
    pub fn interpolate(&self, values: &[f64], place_mm: [f64; 2]) -> f64 {
        let [(i, u), (j, v)] = self.cell(place_mm);
        let at = |i: usize, j: usize| values[j.min(self.rows - 1) * self.columns + i.min(self.columns - 1)];
        (1.0 - v) * ((1.0 - u) * at(i, j) + u * at(i + 1, j)) + v * ((1.0 - u) * at(i, j + 1) + u * at(i + 1, j + 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grid_over_reaches_borders() {
        let grid = Grid::over([[-1.0, 2.0], [3.0, 5.5]].into_iter(), 1.0).unwrap();
        assert_eq!((grid.columns, grid.rows), (5, 5));
        assert_eq!(grid.place_mm(0), [-1.0, 2.0]);
        assert_eq!(grid.place_mm(24), [3.0, 5.5]);
        assert_eq!(Grid::over(std::iter::empty(), 1.0), Err(GridError::NoPoints));
        assert!(matches!(Grid::over([[0.0; 2]].into_iter(), f64::NAN), Err(GridError::Spacing { .. })));
        assert!(matches!(Grid::over([[0.0; 2], [1e9, 1.0]].into_iter(), 1e-3), Err(GridError::TooFine { .. })));
        let line = Grid::over([[0.0, 1.0], [4.0, 1.0]].into_iter(), 2.0).unwrap();
        assert_eq!(line.interpolate(&[1.0, 2.0, 4.0, 1.0, 2.0, 4.0], [3.0, 1.0]), 3.0);
    }

    #[test]
    fn grid_nearest_node_and_resample() {
        let grid = Grid { columns: 3, rows: 2, first_mm: [-1.0, 5.0], spacing_mm: [1.0, 2.0] };
        for (place, node) in [([-1.4, 5.9], Some(0)), ([0.6, 6.1], Some(5)), ([1.6, 5.0], None), ([0.0, 3.9], None)] {
            assert_eq!(grid.nearest(place), node, "{place:?}");
        }
        assert_eq!(grid.nearest([f64::NAN, 5.0]), None);
        assert!(
            grid.is_valid() && !Grid { columns: 0, ..grid }.is_valid() && !Grid { columns: 1 << 60, ..grid }.is_valid()
        );
        assert!(
            !Grid { spacing_mm: [0.0, 1.0], ..grid }.is_valid()
                && !Grid { first_mm: [f64::NAN, 1.0], ..grid }.is_valid()
        );
        let values = [0.0, 1.0, 2.0, 4.0, 5.0, 6.0];
        let finer = Grid { columns: 5, rows: 1, first_mm: [-1.0, 6.0], spacing_mm: [0.5, 1.0] };
        assert_eq!(grid.resample(&values, &grid), values);
        assert_eq!(grid.resample(&values, &finer), [2.0, 2.5, 3.0, 3.5, 4.0]);
    }

    #[test]
    fn grid_interpolates_bilinearly() {
        let grid = Grid { columns: 3, rows: 2, first_mm: [0.0, 0.0], spacing_mm: [1.0, 2.0] };
        let plane = |[x, y]: [f64; 2]| 1.0 + 2.0 * x - 0.5 * y;
        let values: Vec<f64> = (0..6).map(|k| plane(grid.place_mm(k))).collect();
        for place in [[0.3, 0.1], [1.9, 2.0], [2.0, 1.3]] {
            assert!((grid.interpolate(&values, place) - plane(place)).abs() < 1e-15);
        }
        assert_eq!(grid.interpolate(&values, [9.0, -4.0]), plane([2.0, 0.0]));
    }
}
