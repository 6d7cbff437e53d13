//! Displacement of the surface that the grinder is to apply.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use super::parameters::ParameterCorrections;
use crate::geometry::Grid;

/// Displacement of the surface that the grinder is to apply, with the parameter corrections of its machine.
///
/// It is absolute: it replaces the correction of the pass before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Correction {
    /// Grid of the nodes that `values_mm` belongs to.
    #[serde(rename = "net")]
    pub grid: Grid,
    /// Commanded displacement along the outward normal at every node, in millimetres; positive leaves material.
    pub values_mm: Vec<f64>,
    /// Number of the pass that it is for, from 1.
    pub cycle: u16,
    /// Height of the target surface above the nominal one, along the normal, in millimetres: the allowance that
    /// remains.
    pub level_mm: f64,
    /// Parameter corrections of the machine, in addition to `values_mm`; `None` if the map alone corrects.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub set: Option<ParameterCorrections>,
}

impl Correction {
    /// Returns the correction for the first pass of a part, before anything is known: 0 everywhere.
    pub fn zero(grid: Grid, level_mm: f64) -> Self {
        Self { grid, values_mm: vec![0.0; grid.len()], cycle: 1, level_mm, set: None }
    }

    /// Returns true if the map is 0 everywhere and no parameter is compensated.
    pub fn is_zero(&self) -> bool {
        self.set.is_none() && self.values_mm.iter().all(|value| *value == 0.0)
    }

    /// Returns the joint effect of map and parameters as it appears after registration, at every node, in
    /// millimetres.
    pub fn apparent_mm(&self) -> Cow<'_, [f64]> {
        self.add_parameter_effect(|set| &set.seen_mm)
    }

    /// Returns the displacement of the surface by map and parameters together, at every node, in millimetres.
    ///
    /// This is the displacement that decides how much material is removed.
    pub fn displacement_mm(&self) -> Cow<'_, [f64]> {
        self.add_parameter_effect(|set| &set.displaced_mm)
    }

    /// Returns the map that the grinder receives, at every node, in millimetres.
    ///
    /// It is the sum of `values_mm` and of the displacement by wheel setting and tilt, which the grinder can apply
    /// only in its map.
    pub fn map_mm(&self) -> Cow<'_, [f64]> {
        self.add_parameter_effect(|set| &set.setting_mm)
    }

    fn add_parameter_effect(&self, of: impl Fn(&ParameterCorrections) -> &Vec<f64>) -> Cow<'_, [f64]> {
        match &self.set {
            None => Cow::Borrowed(&self.values_mm),
            Some(set) => self.values_mm.iter().zip(of(set)).map(|(value, of)| value + of).collect(),
        }
    }

    /// Returns the interpolated `values_mm` at a place in x and y, in millimetres.
    pub fn at(&self, place_mm: [f64; 2]) -> f64 {
        self.grid.interpolate(&self.values_mm, place_mm)
    }
}
