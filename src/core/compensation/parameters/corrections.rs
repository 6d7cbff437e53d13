//! Parameter corrections of the next pass, and their effect on the map.

use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};

use super::columns::{Extent, motion_effect, slide_effect};
use super::fit::ColumnFit;
use super::kinds::{MIN_NZ, ParameterKind, ParameterOptions, SurfacePoint, WheelTerm};
use crate::compensation::path::{HeightField, Jet};
use crate::geometry::{Grid, Point, Vector};

/// Minimum eigenvalue of a direction of the motions, as a share of the largest; a direction with less is ignored.
const MIN_EIGENVALUE_SHARE: f64 = 1e-9;

/// Part of the deviations that parameters and slides explain together, as a function of the place.
#[derive(Clone, Debug, PartialEq)]
pub struct ExplainedDeviation {
    extent: Extent,
    term: WheelTerm,
    slides: Vec<f64>,
    parameters: Vec<f64>,
    motion: AbsorbedMotion,
}

impl ExplainedDeviation {
    pub(super) fn new(
        contacts: &[SurfacePoint],
        extent: &Extent,
        options: &ParameterOptions,
        fitted: &ColumnFit,
    ) -> Self {
        let believed = fitted.joint_expectation(options);
        let (slides, parameters) = believed.as_slice().split_at(fitted.slides);
        let none = AbsorbedMotion([0.0; 6]);
        let (slides, parameters) = (slides.to_vec(), parameters.to_vec());
        let whole = Self { extent: *extent, term: options.wheel_term, slides, parameters, motion: none };
        let motion = AbsorbedMotion::fit(contacts, options.free_motions, |c| whole.deviation_with_motion_mm(c));
        Self { motion, ..whole }
    }

    fn deviation_with_motion_mm(&self, contact: &SurfacePoint) -> f64 {
        let slides = self.slides.iter().enumerate().map(|(k, value)| value * slide_effect(contact, &self.extent, k));
        let parameters = ParameterKind::ALL.into_iter().zip(&self.parameters);
        slides.sum::<f64>() + parameters.map(|(kind, value)| value * kind.effect(contact, self.term)).sum::<f64>()
    }

    /// Returns the part of the deviation at the point `contact` that machine parameters and bent guideways explain, in
    /// millimetres. The estimates of parameters and bends are shrunk towards 0 by their priors. If their combined
    /// effect contains a motion of the part, this motion is subtracted, because registration has already removed it
    /// from the deviations.
    pub fn at(&self, contact: &SurfacePoint) -> f64 {
        self.deviation_with_motion_mm(contact) - self.motion.at(contact)
    }
}

/// Motion of the part that registration fits to a change of the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
struct AbsorbedMotion([f64; 6]);

impl AbsorbedMotion {
    fn fit(contacts: &[SurfacePoint], free: [bool; 6], of: impl Fn(&SurfacePoint) -> f64) -> Self {
        let row = |c: &SurfacePoint| Vector6::from_fn(|k, _| if free[k] { motion_effect(c, k) } else { 0.0 });
        let gram: Matrix6<f64> = contacts.iter().map(|c| row(c) * row(c).transpose()).sum();
        let towards: Vector6<f64> = contacts.iter().map(|c| row(c) * of(c)).sum();
        // Turns and shifts have different units, so each is scaled to size 1.
        let sizes = gram.diagonal().map(|v| if v > 0.0 { v.sqrt().recip() } else { 0.0 });
        let parts = Matrix6::from_fn(|r, c| gram[(r, c)] * sizes[r] * sizes[c]).symmetric_eigen();
        let towards = towards.component_mul(&sizes);
        let least = MIN_EIGENVALUE_SHARE * parts.eigenvalues.max();
        let mut motion = Vector6::zeros();
        for (value, vector) in parts.eigenvalues.iter().zip(parts.eigenvectors.column_iter()) {
            if *value > least {
                motion += vector * (vector.dot(&towards) / value);
            }
        }
        Self(motion.component_mul(&sizes).into())
    }

    fn at(&self, contact: &SurfacePoint) -> f64 {
        self.0.iter().enumerate().map(|(k, value)| value * motion_effect(contact, k)).sum()
    }
}

/// Parameter corrections of a pass. They are absolute: they replace those of the pass before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterCorrections {
    /// Difference of each parameter from the value stated in the recipe, in its unit, in the order of
    /// [`ParameterKind::ALL`].
    pub values: [f64; ParameterKind::COUNT],
    /// Number of the first pass that is ground with them.
    pub since_cycle: u16,
    /// Displacement of the surface along its normal by these corrections, at every node of the correction, in
    /// millimetres.
    #[serde(rename = "displaced_mm")]
    pub displacement_mm: Vec<f64>,
    /// Part of `displacement_mm` that setting and tilt cause. A grinder has an input for its wheel radius, but can
    /// apply setting and tilt only through its map.
    pub setting_mm: Vec<f64>,
    /// Part of `displacement_mm` that remains after registration: a map without these corrections would have to contain
    /// it.
    #[serde(rename = "seen_mm")]
    pub apparent_mm: Vec<f64>,
}

impl ParameterCorrections {
    /// Returns the parameter corrections that compensate wrong values of the machine parameters, with the resulting
    /// displacement of the surface at each node. `values` holds the estimated difference of each parameter from its
    /// value in the recipe. `since_cycle` is the number of the first pass with these corrections. Returns `None` if all
    /// values are 0.
    ///
    /// Shapes: `values` is in the order of [`ParameterKind::ALL`]. `contacts` are the points at which the part was
    /// measured; they determine which motion of the part registration removes. `nodes` are the points of the surface at
    /// the nodes of the correction. Units: millimetres, radians.
    pub fn from_values(
        values: [f64; ParameterKind::COUNT],
        since_cycle: u16,
        [contacts, nodes]: [&[SurfacePoint]; 2],
        options: &ParameterOptions,
    ) -> Option<Self> {
        if values.iter().all(|value| *value == 0.0) {
            return None;
        }
        let of = |c: &SurfacePoint, but: Option<ParameterKind>| {
            let each = ParameterKind::ALL.into_iter().zip(values).filter(|(kind, _)| Some(*kind) != but);
            -each.map(|(kind, value)| value * kind.effect(c, options.wheel_term)).sum::<f64>()
        };
        let motion = AbsorbedMotion::fit(contacts, options.free_motions, |c| of(c, None));
        let displaced_mm: Vec<f64> = nodes.iter().map(|node| of(node, None)).collect();
        let setting_mm = nodes.iter().map(|node| of(node, Some(ParameterKind::WheelRadius))).collect();
        let apparent_mm = nodes.iter().zip(&displaced_mm).map(|(node, of)| of - motion.at(node)).collect();
        Some(Self { values, since_cycle, displacement_mm: displaced_mm, setting_mm, apparent_mm })
    }

    /// Returns the correction of one parameter: its difference from the value stated in the recipe, in millimetres or
    /// radians.
    pub fn value(&self, kind: ParameterKind) -> f64 {
        ParameterKind::ALL.iter().position(|of| *of == kind).map_or(0.0, |k| self.values[k])
    }

    /// Returns true if every number is finite and each vector has `nodes` values.
    pub fn is_valid(&self, nodes: usize) -> bool {
        let each = [&self.displacement_mm, &self.setting_mm, &self.apparent_mm];
        self.values.iter().all(|v| v.is_finite())
            && each.iter().all(|of| of.len() == nodes && of.iter().all(|v| v.is_finite()))
    }
}

impl SurfacePoint {
    /// Returns one point with its normal for each node of `grid`: the point of `surface` at the x and y of the node. If
    /// the surface is not known there or is too steep, returns the nearest known point. If no point is known at all,
    /// returns the origin with the normal +z. The deviations of the returned points are 0.
    pub fn under_nodes(surface: &HeightField, grid: &Grid) -> Vec<Self> {
        let at = |k: usize| {
            let [x, y] = grid.place_mm(k);
            let Jet { value, slope: [p, q], .. } = surface.at([x, y]);
            let normal = Vector::new(-p, -q, 1.0).normalize();
            let is_known = value.is_finite() && normal.z >= MIN_NZ;
            is_known.then_some(Self { point: Point::new(x, y, value), normal, deviation_mm: 0.0 })
        };
        let known: Vec<Option<Self>> = (0..grid.len()).map(at).collect();
        let nearest = |k: usize| {
            let [x, y] = grid.place_mm(k);
            let far = |c: &&Self| (c.point.x - x).hypot(c.point.y - y);
            known.iter().flatten().min_by(|a, b| far(a).total_cmp(&far(b))).copied()
        };
        let level = Self { point: Point::origin(), normal: Vector::z(), deviation_mm: 0.0 };
        (0..grid.len()).map(|k| known[k].or_else(|| nearest(k)).unwrap_or(level)).collect()
    }
}
