//! What the grinder is to displace its surface by.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use super::parameters::Set;
use crate::geometry::Grid;

/// What the grinder is to displace its surface by, and the parameters that it is told: absolute, it replaces the one before.
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
    /// What is taken back by parameters of the machine, beside the values; none where everything is theirs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub set: Option<Set>,
}

impl Correction {
    /// The first pass of a part: nothing is known yet.
    pub fn none(grid: Grid, level_mm: f64) -> Self {
        Self { grid, values_mm: vec![0.0; grid.len()], cycle: 1, level_mm, set: None }
    }

    /// Returns whether it is 0 everywhere, and no parameter is taken back.
    pub fn is_none(&self) -> bool {
        self.set.is_none() && self.values_mm.iter().all(|value| *value == 0.0)
    }

    /// Returns what map and parameters do together to the part as a registration sees it, at every node, in millimetres.
    pub fn seen_mm(&self) -> Cow<'_, [f64]> {
        self.with(|set| &set.seen_mm)
    }

    /// Returns by how much map and parameters displace the surface together, at every node, in millimetres: what is taken off goes by that.
    pub fn displaced_mm(&self) -> Cow<'_, [f64]> {
        self.with(|set| &set.displaced_mm)
    }

    /// Returns the map that a grinder is given, at every node, in millimetres: what is left for a map, and with it what setting and tilt take back.
    pub fn map_mm(&self) -> Cow<'_, [f64]> {
        self.with(|set| &set.setting_mm)
    }

    fn with(&self, of: impl Fn(&Set) -> &Vec<f64>) -> Cow<'_, [f64]> {
        match &self.set {
            None => Cow::Borrowed(&self.values_mm),
            Some(set) => self.values_mm.iter().zip(of(set)).map(|(value, of)| value + of).collect(),
        }
    }

    /// Returns the correction at a place, in millimetres.
    pub fn at(&self, place_mm: [f64; 2]) -> f64 {
        self.grid.interpolate(&self.values_mm, place_mm)
    }
}
