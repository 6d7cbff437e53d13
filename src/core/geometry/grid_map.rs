//! Values at the nodes of a regular grid, some of which can be missing.

use super::Grid;

/// Map: a value at every node of a grid, and whether it is valid.
#[derive(Clone, Debug, PartialEq)]
pub struct GridMap {
    /// Grid of the nodes.
    pub grid: Grid,
    /// Value at every node, in millimetres. The owner of the map states the value of a node that is not valid.
    pub values_mm: Vec<f64>,
    /// True for each node with a value of its own: one that was measured, or that has enough readings around it.
    pub valid: Vec<bool>,
}

impl GridMap {
    /// Creates a map in which every node is valid. `values_mm` has one entry for each node of `grid`.
    pub fn all_valid(grid: Grid, values_mm: Vec<f64>) -> Self {
        Self { grid, values_mm, valid: vec![true; grid.len()] }
    }

    /// Returns the value at a place `[x, y]`, interpolated bilinearly, in millimetres. Beyond the border of the grid,
    /// returns the value of the nearest place on the border. Uses all nodes, valid or not.
    pub fn at(&self, place_mm: [f64; 2]) -> f64 {
        self.grid.interpolate(&self.values_mm, place_mm)
    }

    /// Returns true if the node nearest to a place `[x, y]` is valid. Returns false if the place lies outside the grid
    /// by more than half a spacing.
    pub fn is_valid_at(&self, place_mm: [f64; 2]) -> bool {
        self.grid.nearest(place_mm).is_some_and(|node| self.valid[node])
    }

    /// Returns the map on the grid `onto`: the values interpolated bilinearly, and a node valid if the nearest node of
    /// this map is.
    #[must_use]
    pub fn resample(&self, onto: Grid) -> Self {
        let valid = (0..onto.len()).map(|k| self.is_valid_at(onto.place_mm(k))).collect();
        Self { grid: onto, values_mm: self.grid.resample(&self.values_mm, &onto), valid }
    }

    /// Returns the number of valid nodes.
    pub fn valid_count(&self) -> usize {
        self.valid.iter().filter(|valid| **valid).count()
    }

    /// Returns the indices and the values of the valid nodes, in ascending order of the indices.
    pub fn valid_values_mm(&self) -> impl Iterator<Item = (usize, f64)> + Clone {
        self.values_mm.iter().copied().enumerate().filter(|(node, _)| self.valid[*node])
    }

    /// Returns x, y and the value of every valid node, in millimetres.
    pub fn samples_mm(&self) -> impl Iterator<Item = [f64; 3]> {
        self.valid_values_mm().map(|(node, value)| (self.grid.place_mm(node), value)).map(|([x, y], v)| [x, y, v])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: Grid = Grid { columns: 3, rows: 2, first_mm: [-1.0, 5.0], spacing_mm: [1.0, 2.0] };

    #[test]
    fn grid_map_skips_invalid_nodes() {
        let mut map = GridMap::all_valid(GRID, vec![0.0, 1.0, 2.0, 4.0, 5.0, 6.0]);
        map.valid[1] = false;
        assert_eq!((map.valid_count(), map.samples_mm().nth(1)), (5, Some([1.0, 5.0, 2.0])));
        assert_eq!(map.valid_values_mm().last(), Some((5, 6.0)));
        assert!(map.is_valid_at([-0.6, 5.9]) && !map.is_valid_at([0.4, 5.9]) && !map.is_valid_at([1.6, 5.0]));
        assert_eq!(map.at([-0.5, 6.0]), 2.5);
        let finer = map.resample(Grid { columns: 5, rows: 1, first_mm: [-1.0, 5.5], spacing_mm: [0.5, 1.0] });
        assert_eq!(finer.values_mm, [1.0, 1.5, 2.0, 2.5, 3.0]);
        assert_eq!(finer.valid, [true, false, false, true, true]);
        assert_eq!(map.resample(GRID), map);
    }
}
