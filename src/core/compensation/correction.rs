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
    #[serde(rename = "set", default, skip_serializing_if = "Option::is_none")]
    pub parameters: Option<ParameterCorrections>,
}

impl Correction {
    /// Returns the correction for the first pass of a part: pass number 1, the value 0 at every node of `grid`, and no
    /// corrections of machine parameters (wheel radius, wheel setting, part tilt). `level_mm` is the height of the
    /// target surface above the nominal surface, in millimetres.
    pub fn zero(grid: Grid, level_mm: f64) -> Self {
        Self { grid, values_mm: vec![0.0; grid.len()], cycle: 1, level_mm, parameters: None }
    }

    /// Returns true if this correction changes nothing: `values_mm` is 0 at every node, and there are no corrections of
    /// machine parameters (`parameters` is `None`).
    pub fn is_zero(&self) -> bool {
        self.parameters.is_none() && self.values_mm.iter().all(|value| *value == 0.0)
    }

    /// Returns the visible part of this correction at every node, in millimetres. Visible is the part that a
    /// measurement still shows after registration. This is `values_mm` plus the visible part of the corrections of the
    /// machine parameters ([`ParameterCorrections::apparent_mm`]). Without such corrections, returns `values_mm`.
    ///
    /// The machine parameters are the wheel radius, the wheel setting and the part tilt. A part of their corrections
    /// changes the surface like a motion of the part. Registration removes this part from the measurement.
    pub fn apparent_mm(&self) -> Cow<'_, [f64]> {
        self.add_parameter_effect(|set| &set.apparent_mm)
    }

    /// Returns the total displacement of the surface by this correction at every node, in millimetres along the normal.
    /// A positive displacement leaves material. This is `values_mm` plus the displacement by the corrections of the
    /// machine parameters wheel radius, wheel setting and part tilt ([`ParameterCorrections::displacement_mm`]).
    /// Without such corrections, returns `values_mm`.
    ///
    /// The amount of removed material follows from this displacement.
    pub fn displacement_mm(&self) -> Cow<'_, [f64]> {
        self.add_parameter_effect(|set| &set.displacement_mm)
    }

    /// Returns the displacement map that the grinder receives, at every node, in millimetres. This is `values_mm` plus
    /// the displacement by the corrections of the wheel setting and the part tilt
    /// ([`ParameterCorrections::setting_mm`]). The wheel setting is the offset of the wheel in x, y and z. Without such
    /// corrections, returns `values_mm`.
    ///
    /// The grinder has no inputs for setting and tilt, so the map must contain their effect. The grinder has an input
    /// for the wheel radius, so the map does not contain the effect of a corrected radius.
    pub fn map_mm(&self) -> Cow<'_, [f64]> {
        self.add_parameter_effect(|set| &set.setting_mm)
    }

    fn add_parameter_effect(&self, of: impl Fn(&ParameterCorrections) -> &Vec<f64>) -> Cow<'_, [f64]> {
        match &self.parameters {
            None => Cow::Borrowed(&self.values_mm),
            Some(set) => self.values_mm.iter().zip(of(set)).map(|(value, of)| value + of).collect(),
        }
    }

    /// Returns `values_mm`, interpolated bilinearly at a place `[x, y]` of the model frame, in millimetres. Beyond the
    /// border of the grid, returns the value of the nearest place on the border.
    pub fn at(&self, place_mm: [f64; 2]) -> f64 {
        self.grid.interpolate(&self.values_mm, place_mm)
    }
}
