//! What the grinder is to displace its surface by.

use serde::{Deserialize, Serialize};

use crate::geometry::Grid;

/// What the grinder is to displace its surface by: absolute, it replaces the one before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Correction {
    /// Where the nodes are.
    #[serde(rename = "net")]
    pub grid: Grid,
    /// Wanted displacement along the outward normal at every node, in millimetres; positive leaves material.
    pub values_mm: Vec<f64>,
    /// The pass it is for, from 1.
    pub cycle: u16,
    /// Height of the surface wanted over the nominal one, along the normal, in millimetres: the allowance that is left.
    pub level_mm: f64,
}

impl Correction {
    /// The first pass of a part: nothing is known yet.
    pub fn none(grid: Grid, level_mm: f64) -> Self {
        Self { grid, values_mm: vec![0.0; grid.len()], cycle: 1, level_mm }
    }

    /// Returns whether it is 0 everywhere.
    pub fn is_none(&self) -> bool {
        self.values_mm.iter().all(|value| *value == 0.0)
    }

    /// Returns the correction at a place, in millimetres.
    pub fn at(&self, place_mm: [f64; 2]) -> f64 {
        self.grid.interpolate(&self.values_mm, place_mm)
    }
}
