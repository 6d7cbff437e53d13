//! True part, with an aperture and a grid of its own: the truth must share no error with the code under test.
//!
//! The part is a nominal shape plus a height error that grinding changes. This module also computes the contact of a ball
//! with it.
//!
//! The height error h is given on a fine grid over the part and a little beyond, in mm along the nominal normal. It is
//! interpolated by bicubic convolution (Catmull-Rom), which has a continuous gradient. That interpolation is the truth:
//! the real surface is r(x, y) = S(x, y) + h(x, y) n(x, y), and its tangents
//!
//! ```text
//!  r_x = S_x + h_x n + h n_x,    r_y = S_y + h_y n + h n_y
//! ```
//!
//! are exact, with the derivative of n from the second derivatives of the closed form. Where it was ground, the wheel
//! has left a groove around each of its tracks, whose height over h is
//!
//! ```text
//!  b(x, y) (y - y_k)^2 / 2        y_k the nearest track, b the curvature of the wheel across it minus the part's
//! ```
//!
//! and where two grooves meet there is a ridge. A ball of radius R travelling along p + t d touches where r + R m = p +
//! t d, m the unit normal of r: three equations for x, y, t, solved by Newton's method. The slopes of the Newton steps
//! are differences; the result is the root of the exact equations. A ball that is sharper than the wheel touches in one
//! groove, or lies on the ridge between two: it lies on the ridge if the contact in each groove, continued beyond its
//! strip, would lie in the strip of the other. A ball that is as blunt as the wheel or blunter reaches into no groove;
//! it rides on the ridges, on the one that it meets first.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::Vec3;
use crate::aperture::Aperture;
use crate::form::FormError;
use crate::point_surface::PointSurface;
use crate::shape::{Biconic, FreeForm, OffAxisAsphere, Shape, Sphere, ThroughOrigin, Wave, XyPolynomial};
use crate::vector::{cross, dot, length, unit_normal};

/// Spacing of the grid's nodes in mm; it is larger on a part where the grid would have over 400 nodes along a side.
pub const NODE_SPACING_MM: f64 = 0.5;
/// Number of nodes beyond the aperture on every side, so that interpolation at the edge has its neighbours.
const MARGIN_NODES: usize = 2;

/// Specification of the part and its blank.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PartSpec {
    /// True shape of the part without errors. In a recipe, the default is the nominal surface.
    pub shape: ShapeSpec,
    /// Outline of the part. In a recipe, the default is the outline of the nominal surface, or the convex hull of its
    /// points.
    pub aperture: Aperture,
    /// Height of the blank over the nominal surface before the first pass. In a recipe, the default is at most half of
    /// the removal budget.
    pub stock_um: f64,
    /// Peak to valley of the blank's form error. In a recipe, the default is a tenth of the stock if the recipe states
    /// no stock.
    pub form_error_um: f64,
    /// Correlation length of the blank's form error.
    pub form_error_correlation_mm: f64,
    /// True if each new job number at the grinder means that a person has clamped a new blank.
    pub fresh_per_job: bool,
    /// Defects that appear after passes.
    pub defects: Vec<DefectSpec>,
}

/// Local defect of the part: a broken-off piece, a pit, a scratch, or a deposit.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DefectSpec {
    /// Middle of the defect in the model frame.
    pub at_mm: [f64; 2],
    /// Total size of the defect along x and y.
    pub size_mm: [f64; 2],
    /// Height of the defect over the surface; negative where material is missing.
    pub height_um: f64,
    /// True for an ellipse with a round bottom; false for a rectangle that is flat except for its flanks.
    pub round: bool,
    /// Number of the pass after which the defect appears, before the part is measured.
    pub after_pass: u32,
}

impl DefectSpec {
    /// Returns the height of the defect over the surface at (x, y), in mm. The height is negative where material is
    /// missing, and 0 outside the defect. x and y are in mm in the model frame.
    pub fn height_mm(&self, [x, y]: [f64; 2]) -> f64 {
        /// Width of a flank, in mm: half of it is inside the rectangle and half outside.
        const FLANK_MM: f64 = 1.0;
        let from_middle = [x - self.at_mm[0], y - self.at_mm[1]];
        let share = if self.round {
            let beyond = (0..2).map(|k| (2.0 * from_middle[k] / self.size_mm[k]).powi(2)).sum::<f64>();
            (1.0 - beyond).max(0.0).powi(2)
        } else {
            let within = |k: usize| {
                let inside = 0.5 * self.size_mm[k] - from_middle[k].abs();
                let u = (inside / FLANK_MM + 0.5).clamp(0.0, 1.0);
                u * u * (3.0 - 2.0 * u)
            };
            within(0) * within(1)
        };
        1e-3 * self.height_um * share
    }
}

impl Default for PartSpec {
    fn default() -> Self {
        Self {
            shape: ShapeSpec::FreeForm {},
            aperture: Aperture::rectangle(51.0, 31.0),
            stock_um: 200.0,
            form_error_um: 20.0,
            form_error_correlation_mm: 30.0,
            fresh_per_job: true,
            defects: Vec::new(),
        }
    }
}

/// Nominal surface, given by its parameters.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ShapeSpec {
    /// The free-form mirror of the shipped recipe.
    FreeForm {},
    /// A sphere.
    Sphere {
        /// Signed radius of curvature.
        radius_mm: f64,
    },
    /// Two conics, one in x and one in y.
    Biconic {
        /// Radii of curvature in x and y.
        radius_mm: [f64; 2],
        /// Conic constants in x and y.
        conic: [f64; 2],
    },
    /// A section of an asphere away from its axis. The origin lies on the surface at the centre of the section.
    OffAxisAsphere {
        /// Vertex radius of the parent.
        radius_mm: f64,
        /// Conic constant of the parent.
        conic: f64,
        /// Coefficient of the fourth power, in mm^-3.
        #[serde(default)]
        fourth: f64,
        /// Distance of the section's centre from the parent's axis, along x.
        shift_mm: f64,
    },
    /// Shallow waves in x and y.
    Wave {
        /// Peak to valley.
        height_mm: f64,
    },
    /// Powers of x and y.
    XyPolynomial {
        /// Divisor of x and y.
        normalisation_radius_mm: f64,
        /// The terms.
        coefficients: Vec<Coefficient>,
    },
    /// The nominal surface of the recipe.
    Nominal {
        /// The points; none in a file.
        #[serde(skip)]
        points: Arc<[Vec3]>,
    },
}

/// A term of an [`XyPolynomial`].
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Coefficient {
    /// Power of x.
    pub i: u32,
    /// Power of y.
    pub j: u32,
    /// Coefficient of the term.
    pub value_mm: f64,
}

impl ShapeSpec {
    /// Creates the nominal surface that this specification describes.
    pub fn build(&self) -> Box<dyn Shape> {
        match self.clone() {
            Self::FreeForm {} => Box::new(FreeForm::default()),
            Self::Sphere { radius_mm } => Box::new(Sphere { radius_mm }),
            Self::Biconic { radius_mm, conic } => Box::new(Biconic { radius_mm, conic }),
            Self::OffAxisAsphere { radius_mm, conic, fourth, shift_mm } => {
                Box::new(ThroughOrigin(OffAxisAsphere { radius_mm, conic, fourth, shift_mm }))
            }
            Self::Wave { height_mm } => Box::new(Wave { height_mm }),
            Self::XyPolynomial { normalisation_radius_mm, coefficients } => Box::new(XyPolynomial {
                normalisation_radius_mm,
                terms: coefficients.iter().map(|c| (c.i, c.j, c.value_mm)).collect(),
            }),
            Self::Nominal { points } => Box::new(PointSurface::through(points.to_vec()).unwrap_or_default()),
        }
    }
}

/// Heights on a grid, smooth between the nodes and constant beyond the edge.
#[derive(Clone, Debug)]
pub struct HeightGrid {
    first_mm: [f64; 2],
    step_mm: [f64; 2],
    columns: usize,
    rows: usize,
    /// Heights row by row, x fastest, in mm.
    pub(crate) heights_mm: Vec<f64>,
}

impl HeightGrid {
    /// Creates a grid over the bounding rectangle of `aperture`. All nodes have the height `height_mm`.
    pub fn over(aperture: &Aperture, height_mm: f64) -> Self {
        let (bounds_mm, half_mm) = (aperture.bounds_mm(), aperture.half_mm());
        let spacing = NODE_SPACING_MM.max(half_mm[0].max(half_mm[1]) / 200.0);
        let cells = half_mm.map(|half| ((2.0 * half / spacing).ceil() as usize).max(4));
        let step_mm = [0, 1].map(|i| 2.0 * half_mm[i] / cells[i] as f64);
        let first_mm = [0, 1].map(|i| bounds_mm[i][0] - MARGIN_NODES as f64 * step_mm[i]);
        let [columns, rows] = cells.map(|n| n + 1 + 2 * MARGIN_NODES);
        Self { first_mm, step_mm, columns, rows, heights_mm: vec![height_mm; columns * rows] }
    }

    /// Returns the positions (x, y) of the nodes, in the order of `heights_mm`.
    pub fn nodes(&self) -> impl Iterator<Item = [f64; 2]> + '_ {
        (0..self.rows).flat_map(move |j| (0..self.columns).map(move |i| self.node(i, j)))
    }

    /// Returns the nodes whose x is within the two limits `x_mm` and whose y is within the two limits `y_mm`. Each item
    /// has the index in `heights_mm` and the position (x, y) in mm. The limits of an axis can be in either order. A
    /// node on the lower limit is included. A node on the upper limit is excluded, so that a node on the border of two
    /// rectangles belongs to only one.
    pub(crate) fn within(&self, x_mm: [f64; 2], y_mm: [f64; 2]) -> impl Iterator<Item = (usize, [f64; 2])> + '_ {
        let from = |k: usize, place: f64| ((place - self.first_mm[k]) / self.step_mm[k]).ceil().max(0.0) as usize;
        let range =
            |k: usize, [a, b]: [f64; 2], count: usize| from(k, a.min(b)).min(count)..from(k, a.max(b)).min(count);
        let (columns, rows) = (range(0, x_mm, self.columns), range(1, y_mm, self.rows));
        rows.flat_map(move |j| columns.clone().map(move |i| (j * self.columns + i, self.node(i, j))))
    }

    fn node(&self, i: usize, j: usize) -> [f64; 2] {
        [self.first_mm[0] + i as f64 * self.step_mm[0], self.first_mm[1] + j as f64 * self.step_mm[1]]
    }

    /// Adds a random form error to `values_mm`, which has one value in mm for each node.
    pub fn add(&self, form: &FormError, values_mm: &mut [f64]) {
        form.add_to_grid(self.first_mm, self.step_mm, self.columns, values_mm);
    }

    /// Returns the area of a grid cell in mm².
    pub fn cell_mm2(&self) -> f64 {
        self.step_mm[0] * self.step_mm[1]
    }

    /// Returns the height at (x, y) in mm, and its derivatives with respect to x and y. Uses cubic (Catmull-Rom)
    /// interpolation between the nodes. A coordinate before the second node or after the last but one is clamped to
    /// that node, and the derivative on this axis is 0.
    pub fn at(&self, x: f64, y: f64) -> (f64, [f64; 2]) {
        let (i, wx, dx) = weights(x, self.first_mm[0], self.step_mm[0], self.columns);
        let (j, wy, dy) = weights(y, self.first_mm[1], self.step_mm[1], self.rows);
        let (mut h, mut hx, mut hy) = (0.0, 0.0, 0.0);
        for b in 0..4 {
            let row = &self.heights_mm[(j + b) * self.columns + i..][..4];
            let (mut value, mut slope) = (0.0, 0.0);
            for a in 0..4 {
                value += wx[a] * row[a];
                slope += dx[a] * row[a];
            }
            h += wy[b] * value;
            hx += wy[b] * slope;
            hy += dy[b] * value;
        }
        (h, [hx, hy])
    }
}

/// Returns the weights of cubic (Catmull-Rom) interpolation at the coordinate `t` on one axis. `first` is the
/// coordinate of the first node, `step` the spacing and `nodes` the number of nodes.
///
/// The result has three parts: the index of the first of the four nodes around `t`, the weights of these four nodes,
/// and the derivatives of the weights with respect to `t`. Before the second node and after the last but one, the
/// weights are those at that node, and the derivatives are 0.
fn weights(t: f64, first: f64, step: f64, nodes: usize) -> (usize, [f64; 4], [f64; 4]) {
    let place = (t - first) / step;
    let held = place.clamp(1.0, (nodes - 2) as f64);
    let cell = (held as usize).min(nodes - 3);
    let u = held - cell as f64;
    let w = [
        u * (-0.5 + u * (1.0 - 0.5 * u)),
        1.0 + u * u * (-2.5 + 1.5 * u),
        u * (0.5 + u * (2.0 - 1.5 * u)),
        u * u * (-0.5 + 0.5 * u),
    ];
    let d = [-0.5 + u * (2.0 - 1.5 * u), u * (-5.0 + 4.5 * u), 0.5 + u * (4.0 - 4.5 * u), u * (-1.0 + 1.5 * u)];
    let inside = if place == held { 1.0 / step } else { 0.0 };
    (cell - 1, w, d.map(|c| c * inside))
}

/// Grooves that the wheel has left around its tracks, which run along x.
#[derive(Clone, Debug)]
pub struct Grooves {
    /// y of a track, in mm.
    pub first_mm: f64,
    /// Spacing of the tracks, in mm.
    pub spacing_mm: f64,
    /// Radius of the wheel across the tracks, in mm.
    pub wheel_radius_mm: f64,
    /// Difference of two curvatures in the direction across the track: curvature of the wheel minus curvature of the
    /// part, in 1/mm; 0 where nothing was ground.
    pub bend: HeightGrid,
}

impl Grooves {
    /// Returns the curvature in 1/mm, across the tracks, of the groove that the wheel leaves at (x, y) on `shape`. The
    /// tracks run along x.
    ///
    /// The gap between wheel and part is approximated by a quadratic function of x and y around the contact. At each
    /// distance across the tracks, the wheel cuts down to the minimum of this gap along x. The result is the curvature
    /// of these minima. If the gap has no mixed second derivative, this is the curvature of the wheel minus the
    /// curvature of the part.
    ///
    /// Returns 0 where the wheel leaves no groove, for example in a hollow that is narrower than the wheel.
    pub fn bend_at(shape: &dyn Shape, wheel_radius_mm: f64, [x, y]: [f64; 2]) -> f64 {
        let ([p, q], hessian) = (shape.gradient(x, y), shape.hessian(x, y));
        let w = 1.0 / (1.0 + p * p + q * q).sqrt();
        let metric = [1.0 + p * p, p * q, 1.0 + q * q];
        let [along, mixed, across]: [f64; 3] = std::array::from_fn(|k| metric[k] / wheel_radius_mm - w * hessian[k]);
        let bend = across - mixed * mixed / along;
        // A hollow that is narrower than the wheel has no groove.
        if along > 0.0 && bend > 0.0 && bend.is_finite() { bend } else { 0.0 }
    }

    fn nearest(&self, y: f64) -> f64 {
        ((y - self.first_mm) / self.spacing_mm).round()
    }

    fn track_mm(&self, number: f64) -> f64 {
        self.first_mm + number * self.spacing_mm
    }

    /// Returns the height of a groove at (x, y) over its bottom, in mm, and the derivatives of this height with respect
    /// to x and y. `track` is the number of the track that left the groove.
    fn at(&self, x: f64, y: f64, track: f64) -> (f64, [f64; 2]) {
        let (b, [bx, by]) = self.bend.at(x, y);
        let d = y - self.track_mm(track);
        (0.5 * b * d * d, [0.5 * bx * d * d, b * d + 0.5 * by * d * d])
    }
}

/// Result of moving a ball towards the part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Contact {
    /// The ball touches.
    Touched {
        /// Centre of the ball in the model frame, in mm.
        centre_mm: Vec3,
        /// Projection of the contact onto the plane (x, y), in mm.
        contact_mm: [f64; 2],
    },
    /// The ball is already in the material where the search begins.
    Unexpected,
    /// The search ended without a touch, or the contact is beyond the part's edge.
    Missed,
}

/// Straight path of a ball's centre, in the model frame.
#[derive(Clone, Copy, Debug)]
pub struct Approach {
    /// Target point, in mm.
    pub point_mm: Vec3,
    /// Direction from which the ball comes, of unit length.
    pub direction: Vec3,
    /// Radius of the ball, in mm.
    pub radius_mm: f64,
    /// Distance from the target, along the direction, at which the centre begins its search, in mm.
    pub from_mm: f64,
    /// Distance from the target, along the direction, at which the centre ends its search, in mm.
    pub to_mm: f64,
}

impl Approach {
    fn centre(&self, t: f64) -> Vec3 {
        std::array::from_fn(|i| self.point_mm[i] + t * self.direction[i])
    }
}

/// Part with its real surface.
pub struct Part {
    /// Nominal surface.
    pub shape: Box<dyn Shape>,
    /// Aperture of the part.
    pub aperture: Aperture,
    /// Height of the real surface over the nominal, along the nominal normal; where it is ground, at the bottom of the
    /// grooves.
    pub height: HeightGrid,
    /// Grooves that the last pass left; `None` on a blank.
    pub grooves: Option<Grooves>,
}

impl Part {
    /// Creates the blank of a part: the nominal surface with stock and with a random form error, which is drawn from a
    /// seed.
    pub fn blank(spec: &PartSpec, seed: u64) -> Self {
        let mut height = HeightGrid::over(&spec.aperture, spec.stock_um * 1e-3);
        let form = if spec.form_error_um > 0.0 {
            let (length, pv) = (spec.form_error_correlation_mm, spec.form_error_um * 1e-3);
            FormError::over(seed, length, pv, spec.aperture.bounds_mm())
        } else {
            FormError::none()
        };
        let mut heights_mm = height.heights_mm.clone();
        height.add(&form, &mut heights_mm);
        height.heights_mm = heights_mm;
        Self { shape: spec.shape.build(), aperture: spec.aperture.clone(), height, grooves: None }
    }

    /// Returns the deviation of the real surface from the nominal surface at (x, y), in mm along the nominal normal.
    /// The deviation is positive for excess material and includes the grooves.
    pub fn deviation_mm(&self, x: f64, y: f64) -> f64 {
        self.height_and_gradient(x, y, self.nearest_track(y)).0
    }

    /// Returns the height in mm of the ridges between the grooves, over the bottom of the grooves, near (x, y). Returns
    /// 0 if the part has no grooves.
    pub fn ridge_mm(&self, x: f64, y: f64) -> f64 {
        self.grooves.as_ref().map_or(0.0, |grooves| grooves.bend.at(x, y).0 * grooves.spacing_mm.powi(2) / 8.0)
    }

    fn nearest_track(&self, y: f64) -> f64 {
        self.grooves.as_ref().map_or(0.0, |grooves| grooves.nearest(y))
    }

    /// Returns the height of the real surface over the nominal surface at (x, y), in mm, and its derivatives with
    /// respect to x and y. Uses the groove of track number `track`, even if another track is nearer. Without grooves,
    /// `track` is ignored.
    fn height_and_gradient(&self, x: f64, y: f64, track: f64) -> (f64, [f64; 2]) {
        let (h, slope) = self.height.at(x, y);
        let Some(grooves) = &self.grooves else { return (h, slope) };
        let (over, by) = grooves.at(x, y, track);
        (h + over, [slope[0] + by[0], slope[1] + by[1]])
    }

    /// Returns the point of the real surface at the nominal position (x, y) in mm, and the derivatives of this point
    /// with respect to x and to y. Uses the groove of track number `track`, also at positions beyond the borders of
    /// this groove.
    fn tangents(&self, x: f64, y: f64, track: f64) -> (Vec3, Vec3, Vec3) {
        let ([p, q], [zxx, zxy, zyy]) = (self.shape.gradient(x, y), self.shape.hessian(x, y));
        let (h, [hx, hy]) = self.height_and_gradient(x, y, track);
        let w = 1.0 / (1.0 + p * p + q * q).sqrt();
        let n = [-p * w, -q * w, w];
        // n = N / |N| with N = (-p, -q, 1), so dn = (dN - n (n . dN)) / |N|.
        let turn = |a: f64, b: f64| -> Vec3 {
            let along = -(n[0] * a + n[1] * b);
            [w * (-a - n[0] * along), w * (-b - n[1] * along), -w * n[2] * along]
        };
        let (nx, ny) = (turn(zxx, zxy), turn(zxy, zyy));
        let tx: Vec3 = std::array::from_fn(|i| [1.0, 0.0, p][i] + hx * n[i] + h * nx[i]);
        let ty: Vec3 = std::array::from_fn(|i| [0.0, 1.0, q][i] + hy * n[i] + h * ny[i]);
        let [sx, sy, sz] = self.shape.point(x, y);
        ([sx + h * n[0], sy + h * n[1], sz + h * n[2]], tx, ty)
    }

    /// Moves a ball along the straight path `way` until it touches the part. Returns `Contact::Touched` with the centre
    /// of the ball and the contact.
    ///
    /// Returns `Contact::Missed` if the path ends without a touch. A contact outside the aperture is also
    /// `Contact::Missed`, because the side and the rim of the part are not modelled.
    ///
    /// If the ball already touches before the start of the path, returns `Contact::Unexpected` if (x, y) of the start
    /// is inside the aperture. Otherwise returns `Contact::Missed`.
    pub fn touch(&self, way: &Approach) -> Contact {
        let start = way.centre(way.from_mm);
        let Some(t) = self.near_contact(way) else { return Contact::Missed };
        let unexpected = || match self.aperture.contains(start[0], start[1]) {
            true => Contact::Unexpected,
            false => Contact::Missed,
        };
        match self.exact_contact(way, t) {
            None if t >= way.from_mm => unexpected(),
            None => Contact::Missed,
            Some((_, t)) if t > way.from_mm => unexpected(),
            Some((foot, t)) if t < way.to_mm || !self.aperture.contains(foot[0], foot[1]) => Contact::Missed,
            Some((contact_mm, t)) => Contact::Touched { centre_mm: way.centre(t), contact_mm },
        }
    }

    /// Returns the distance in mm between a ball and the real surface, to first order. `c` is the centre of the ball,
    /// and `radius_mm` is its radius. The ridges between the grooves are ignored: the real surface is taken at the
    /// bottom of the grooves. The distance is negative if the ball is inside the material.
    fn gap(&self, c: Vec3, radius_mm: f64) -> f64 {
        let [p, q] = self.shape.gradient(c[0], c[1]);
        let vertical = c[2] - self.shape.height(c[0], c[1]);
        vertical / (1.0 + p * p + q * q).sqrt() - self.height.at(c[0], c[1]).0 - radius_mm
    }

    /// Moves the ball along the path `way` until it nearly touches the part (distance below 0.02 mm), for 100 steps at
    /// most. The length of each step is the distance between ball and surface. Returns the position on the path, in mm
    /// from the target. Returns `None` if the ball passes the end of the path by more than 1 mm, or if the distance is
    /// not finite.
    fn near_contact(&self, way: &Approach) -> Option<f64> {
        let mut t = way.from_mm;
        for _ in 0..100 {
            let gap = self.gap(way.centre(t), way.radius_mm);
            if !gap.is_finite() || t < way.to_mm - 1.0 {
                return None;
            }
            if gap < 0.02 {
                return Some(t);
            }
            t -= gap;
        }
        Some(t)
    }

    /// Computes the contact of the ball on the path `way` with the part, by an iteration. `t` is the start of the
    /// iteration: the position of the ball's centre on the path, in mm from the target. Returns (x, y) of the contact,
    /// and the position of the ball's centre on the path, in mm from the target. Returns `None` if the iteration finds
    /// no contact.
    fn exact_contact(&self, way: &Approach, t: f64) -> Option<([f64; 2], f64)> {
        let centre = way.centre(t);
        let [p, q] = self.shape.gradient(centre[0], centre[1]);
        let w = way.radius_mm / (1.0 + p * p + q * q).sqrt();
        let foot = [centre[0] + p * w, centre[1] + q * w];
        let Some(grooves) = &self.grooves else { return self.contact_in(way, [foot[0], foot[1], t], 0.0) };
        let mut track = grooves.nearest(foot[1]);
        if way.radius_mm >= grooves.wheel_radius_mm {
            let ridges = (-3..3).map(|k| grooves.track_mm(track + f64::from(k) + 0.5));
            let touched = ridges.filter_map(|y| self.contact_on_ridge(way, [foot[0], t], y));
            return touched.max_by(|a, b| a.1.total_cmp(&b.1));
        }
        let mut before = f64::NAN;
        for _ in 0..20 {
            let (foot, t) = self.contact_in(way, [foot[0], foot[1], t], track)?;
            let nearest = grooves.nearest(foot[1]);
            if nearest == track {
                return Some((foot, t));
            }
            let next = track + (nearest - track).signum();
            if next == before {
                return self.contact_on_ridge(way, [foot[0], t], grooves.track_mm(0.5 * (track + next)));
            }
            (before, track) = (track, next);
        }
        None
    }

    /// Computes the contact of the ball with a ridge (the line at constant `y` where two grooves meet) by Newton's
    /// method. The iteration starts at `x` on the ridge and at the position `t` of the ball on the path `way`. Returns
    /// (x, y) of the contact and the position t on the path, in mm from the target. Returns `None` if the iteration
    /// does not converge.
    ///
    /// Solves |r - c| = R and (r - c) . r_x = 0. Here r is the point of the ridge, r_x its derivative with respect to
    /// x, R the radius of the ball and c = p + t d its centre on the path, with the target p and the direction d.
    fn contact_on_ridge(&self, way: &Approach, [mut x, mut t]: [f64; 2], y: f64) -> Option<([f64; 2], f64)> {
        let track = self.nearest_track(y);
        let mut last = f64::INFINITY;
        for _ in 0..40 {
            let ((r, tx, _), c) = (self.tangents(x, y, track), way.centre(t));
            let off: Vec3 = std::array::from_fn(|i| r[i] - c[i]);
            let miss = [length(off) - way.radius_mm, dot(off, tx)];
            let size = miss[0].abs().max(miss[1].abs());
            if !size.is_finite() || size < 1e-14 || (size < 1e-11 && size >= last) {
                last = last.min(size);
                break;
            }
            last = size;
            const STEP_MM: f64 = 1e-4;
            let [ahead, behind] = [x + STEP_MM, x - STEP_MM].map(|x| self.tangents(x, y, track).1);
            let bend: Vec3 = std::array::from_fn(|i| (ahead[i] - behind[i]) / (2.0 * STEP_MM));
            let off_mm = length(off);
            let (a, b) = (miss[1] / off_mm, -dot(off, way.direction) / off_mm);
            let (c, d) = (dot(tx, tx) + dot(off, bend), -dot(way.direction, tx));
            let determinant = a * d - b * c;
            let step = [(d * miss[0] - b * miss[1]) / determinant, (a * miss[1] - c * miss[0]) / determinant];
            let longest = step[0].abs().max(step[1].abs());
            let damping = if longest > 2.0 { 2.0 / longest } else { 1.0 };
            (x, t) = (x - damping * step[0], t - damping * step[1]);
        }
        (last < 1e-10).then_some(([x, y], t))
    }

    /// Computes the contact of the ball with the groove of track number `track` by Newton's method. The iteration
    /// starts at `from` = (x, y, t): the position (x, y) of the contact, and the position t of the ball on the path
    /// `way`. Returns (x, y) of the contact and the position t, in mm from the target. Returns `None` if the iteration
    /// does not converge.
    ///
    /// Solves r + R m = p + t d. Here r is the point of the surface, m its unit normal, R the radius of the ball and p
    /// + t d its centre on the path, with the target p and the direction d.
    fn contact_in(&self, way: &Approach, from: Vec3, track: f64) -> Option<([f64; 2], f64)> {
        let offset = |x: f64, y: f64| -> Vec3 {
            let (r, tx, ty) = self.tangents(x, y, track);
            let m = unit_normal(tx, ty);
            std::array::from_fn(|i| r[i] + way.radius_mm * m[i])
        };
        let mut at = from;
        let mut last = f64::INFINITY;
        for _ in 0..40 {
            let [x, y, t] = at;
            let (c, ball) = (offset(x, y), way.centre(t));
            let miss: Vec3 = std::array::from_fn(|i| c[i] - ball[i]);
            let size = miss.iter().fold(0.0, |most: f64, e| most.max(e.abs()));
            // At the rounding error of the coordinates, the residual stops falling.
            if !size.is_finite() || size < 1e-14 || (size < 1e-11 && size >= last) {
                last = last.min(size);
                break;
            }
            last = size;
            const STEP_MM: f64 = 1e-5;
            let slope = |a: Vec3, b: Vec3| -> Vec3 { std::array::from_fn(|i| (a[i] - b[i]) / (2.0 * STEP_MM)) };
            let along_x = slope(offset(x + STEP_MM, y), offset(x - STEP_MM, y));
            let along_y = slope(offset(x, y + STEP_MM), offset(x, y - STEP_MM));
            let step = solve([along_x, along_y, way.direction.map(|d| -d)], miss)?;
            let longest = step.iter().fold(0.0, |most: f64, e| most.max(e.abs()));
            let damping = if longest > 2.0 { 2.0 / longest } else { 1.0 };
            at = std::array::from_fn(|i| at[i] - damping * step[i]);
        }
        (last < 1e-10).then_some(([at[0], at[1]], at[2]))
    }
}

/// Solves three linear equations by Cramer's rule: the columns a, b, c of the matrix, and the right side. Returns
/// `None` if the matrix is singular.
fn solve([a, b, c]: [Vec3; 3], right: Vec3) -> Option<Vec3> {
    let determinant = dot(a, cross(b, c));
    let x = [dot(right, cross(b, c)), dot(a, cross(right, c)), dot(a, cross(b, right))].map(|d| d / determinant);
    x.iter().all(|value| value.is_finite()).then_some(x)
}

/// Computes the contact of a ball on the path `way` with the outside of a sphere. `centre_mm` and `sphere_radius_mm`
/// describe the sphere, in the frame of `way`. Returns `Contact::Unexpected` if the ball overlaps the sphere at the
/// start of the path. Returns `Contact::Missed` if the ball does not meet the sphere on the path. The (x, y) of the
/// returned contact is the (x, y) of the ball's centre.
pub fn touch_sphere(centre_mm: Vec3, sphere_radius_mm: f64, way: &Approach) -> Contact {
    let from_centre: Vec3 = std::array::from_fn(|i| way.point_mm[i] - centre_mm[i]);
    let along = dot(from_centre, way.direction);
    let reach = sphere_radius_mm + way.radius_mm;
    let beside = dot(from_centre, from_centre) - along * along;
    if beside >= reach * reach {
        return Contact::Missed;
    }
    let t = (reach * reach - beside).sqrt() - along;
    if t > way.from_mm {
        // A ball that comes from the far side can leave the sphere before the search begins.
        let inside = t - 2.0 * (t + along) < way.from_mm;
        return if inside { Contact::Unexpected } else { Contact::Missed };
    }
    if t < way.to_mm {
        return Contact::Missed;
    }
    let centre = way.centre(t);
    Contact::Touched { centre_mm: centre, contact_mm: [centre[0], centre[1]] }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the point of the real surface over the nominal position.
    fn surface(part: &Part, [x, y]: [f64; 2]) -> Vec3 {
        part.tangents(x, y, part.nearest_track(y)).0
    }

    fn rough_part() -> Part {
        Part::blank(&PartSpec { stock_um: 120.0, form_error_correlation_mm: 6.0, ..PartSpec::default() }, 11)
    }

    fn way(part: &Part, x: f64, y: f64, direction: Vec3) -> Approach {
        let norm = dot(direction, direction).sqrt();
        let direction = direction.map(|c| c / norm);
        Approach { point_mm: part.shape.point(x, y), direction, radius_mm: 1.5, from_mm: 4.5, to_mm: -1.5 }
    }

    /// Returns the distance of a point from the real surface by a search of the neighbourhood with shrinking steps.
    fn distance_by_search(part: &Part, c: Vec3) -> f64 {
        let (mut best, mut middle, mut half) = (f64::INFINITY, [c[0], c[1]], 3.0);
        while half > 1e-7 {
            let about = middle;
            for i in -20..=20 {
                for j in -20..=20 {
                    let at = [about[0] + half * f64::from(i) / 20.0, about[1] + half * f64::from(j) / 20.0];
                    let r = surface(part, at);
                    let d = (0..3).map(|k| (r[k] - c[k]).powi(2)).sum::<f64>().sqrt();
                    if d < best {
                        (best, middle) = (d, at);
                    }
                }
            }
            half *= 0.3;
        }
        best
    }

    #[test]
    fn contact_on_a_sphere_is_concentric() {
        let spec = PartSpec {
            shape: ShapeSpec::Sphere { radius_mm: -80.0 },
            aperture: Aperture::circle(30.0),
            stock_um: 50.0,
            form_error_um: 0.0,
            ..PartSpec::default()
        };
        let part = Part::blank(&spec, 1);
        for (x, y) in [(0.0, 0.0), (11.3, -20.9), (-28.0, 4.4)] {
            for direction in [part.shape.normal(x, y), [0.0, 0.0, 1.0], [0.1, -0.2, 1.0]] {
                let Contact::Touched { centre_mm: c, .. } = part.touch(&way(&part, x, y, direction)) else {
                    panic!("no touch at ({x}, {y})")
                };
                let distance = (c[0] * c[0] + c[1] * c[1] + (c[2] + 80.0).powi(2)).sqrt();
                assert!((distance - 81.55).abs() < 1e-11, "{distance}");
            }
        }
    }

    #[test]
    fn contact_matches_surface_search() {
        let part = rough_part();
        for (x, y) in [(0.1, 0.2), (37.0, -22.6), (-50.2, 30.1), (12.25, 8.75), (-20.0, -5.0)] {
            for tilt in [[0.0, 0.0, 0.0], [0.15, -0.1, 0.0]] {
                let n = part.shape.normal(x, y);
                let way = way(&part, x, y, std::array::from_fn(|i| n[i] + tilt[i]));
                let Contact::Touched { centre_mm, .. } = part.touch(&way) else { panic!("no touch at ({x}, {y})") };
                let distance = distance_by_search(&part, centre_mm);
                assert!((distance - 1.5).abs() < 1e-10, "{distance} at ({x}, {y})");
                let off: Vec3 = cross(std::array::from_fn(|i| centre_mm[i] - way.point_mm[i]), way.direction);
                assert!(dot(off, off).sqrt() < 1e-12, "the centre left its line");
            }
        }
    }

    /// Returns a part with the grooves of a wheel.
    fn grooved(wheel_radius_mm: f64, spacing_mm: f64) -> Part {
        let mut part = rough_part();
        let mut bend = HeightGrid::over(&part.aperture, 0.0);
        bend.heights_mm = bend.nodes().map(|at| Grooves::bend_at(part.shape.as_ref(), wheel_radius_mm, at)).collect();
        part.grooves = Some(Grooves { first_mm: -32.6, spacing_mm, wheel_radius_mm, bend });
        part
    }

    #[test]
    fn defect_height_profile() {
        let chip =
            DefectSpec { at_mm: [10.0, -5.0], size_mm: [3.0, 4.0], height_um: -50.0, round: false, after_pass: 1 };
        let at = |defect: &DefectSpec, x: f64, y: f64| defect.height_mm([10.0 + x, -5.0 + y]);
        assert_eq!([at(&chip, 0.0, 0.0), at(&chip, 1.0, 1.5), at(&chip, 1.5, 0.0)], [-0.05, -0.05, -0.025]);
        assert_eq!([at(&chip, 2.0, 0.0), at(&chip, 0.0, -2.5), at(&chip, 9.0, 9.0)], [0.0; 3]);
        let bump = DefectSpec { height_um: 16.0, round: true, ..chip };
        assert_eq!([at(&bump, 0.0, 0.0), at(&bump, 1.5, 0.0), at(&bump, 0.0, 2.0)], [0.016, 0.0, 0.0]);
        // Half the square of its radius from its middle: a quarter of its height is left.
        assert!((at(&bump, 0.75_f64.hypot(0.75), 0.0) - 0.004).abs() < 1e-12);
    }

    #[test]
    fn contact_on_grooves_does_not_cut() {
        // A ball of 1.5 mm lies in the grooves of a wheel of 12.5 mm, hardly in those of 1.6 mm, and rides on the
        // ridges of one of 1 mm.
        for (wheel_radius_mm, spacing_mm, rides) in [(12.5, 0.5, false), (1.6, 0.3, false), (1.0, 0.2, true)] {
            let part = grooved(wheel_radius_mm, spacing_mm);
            let (mut on_ridges, mut in_grooves) = (0, 0);
            for k in 0..60 {
                let (x, y) = (f64::from(k) * 1.37 - 40.0, 20.0 - spacing_mm * 0.1 * f64::from(k % 23));
                let n = part.shape.normal(x, y);
                let tilt = [0.0, 0.1, -0.07][k as usize % 3];
                let way = way(&part, x, y, [n[0] + tilt, n[1] - 0.5 * tilt, n[2]]);
                let Contact::Touched { centre_mm: c, contact_mm } = part.touch(&way) else {
                    panic!("no touch at {x} {y}")
                };
                // Search of the neighbourhood: no point is nearer than the radius, and the contact is at the radius.
                let distance = |[x, y]: [f64; 2]| {
                    let r = surface(&part, [x, y]);
                    (0..3).map(|i| (r[i] - c[i]).powi(2)).sum::<f64>().sqrt()
                };
                assert!(
                    (distance(contact_mm) - 1.5).abs() < 1e-9,
                    "{wheel_radius_mm} at {x} {y}: {}",
                    distance(contact_mm)
                );
                let around = (0..200 * 40).map(|i| (f64::from(i % 200) - 100.0, f64::from(i / 200) - 20.0));
                let places = around.map(|(i, j)| [contact_mm[0] + 0.01 * j, contact_mm[1] + 0.004 * i]);
                let nearest = places.map(distance).fold(f64::INFINITY, f64::min);
                assert!(nearest > 1.5 - 1e-9, "{wheel_radius_mm} at {x} {y}: cuts {} nm deep", 1e6 * (1.5 - nearest));
                let grooves = part.grooves.as_ref().unwrap();
                let beside = (contact_mm[1] - grooves.track_mm(grooves.nearest(contact_mm[1]))).abs();
                if (beside - 0.5 * spacing_mm).abs() < 1e-9 { on_ridges += 1 } else { in_grooves += 1 }
            }
            assert!(if rides { in_grooves == 0 } else { in_grooves > 0 && on_ridges > 0 }, "{on_ridges} {in_grooves}");
        }
    }

    #[test]
    fn groove_curvature_wheel_minus_part() {
        let flat = crate::shape::Wave { height_mm: 1e-9 };
        assert!((Grooves::bend_at(&flat, 12.5, [3.0, 4.0]) - 0.08).abs() < 1e-9);
        // At the bottom of a bowl and at the top of a dome; no groove if the bowl is narrower than the wheel.
        let bowl = |radius_mm: f64| Grooves::bend_at(&Sphere { radius_mm }, 12.5, [0.0, 0.0]);
        assert!((bowl(50.0) - 0.06).abs() < 1e-12 && (bowl(-50.0) - 0.1).abs() < 1e-12 && bowl(12.0) == 0.0);
    }

    #[test]
    fn contact_missed_or_unexpected() {
        let part = rough_part();
        let n = part.shape.normal(0.0, 0.0);
        let plain = way(&part, 0.0, 0.0, n);
        assert!(matches!(part.touch(&plain), Contact::Touched { .. }));
        assert_eq!(part.touch(&way(&part, 52.0, 0.0, part.shape.normal(52.0, 0.0))), Contact::Missed);
        assert_eq!(part.touch(&Approach { to_mm: 1.7, ..plain }), Contact::Missed);
        assert_eq!(part.touch(&Approach { from_mm: 1.6, ..plain }), Contact::Unexpected);
        assert_eq!(part.touch(&Approach { from_mm: -5.0, to_mm: -9.0, ..plain }), Contact::Unexpected);
        assert_eq!(part.touch(&Approach { point_mm: [1e7, 0.0, 0.0], ..plain }), Contact::Missed);
    }

    #[test]
    fn contact_missed_outside_sphere_domain() {
        let spec = PartSpec {
            shape: ShapeSpec::Sphere { radius_mm: 40.0 },
            aperture: Aperture::circle(30.0),
            ..PartSpec::default()
        };
        let part = Part::blank(&spec, 1);
        let way = Approach {
            point_mm: [60.0, 0.0, 10.0],
            direction: [0.0, 0.0, 1.0],
            radius_mm: 1.0,
            from_mm: 4.0,
            to_mm: -2.0,
        };
        assert_eq!(part.touch(&way), Contact::Missed);
    }

    #[test]
    fn contact_on_reference_sphere() {
        let way = Approach {
            point_mm: [13.0, 0.5, 0.0],
            direction: [1.0, 0.0, 0.0],
            radius_mm: 1.5,
            from_mm: 5.0,
            to_mm: -2.0,
        };
        let Contact::Touched { centre_mm: c, .. } = touch_sphere([0.5, 0.0, 0.0], 12.5, &way) else {
            panic!("no touch")
        };
        let distance = ((c[0] - 0.5).powi(2) + c[1] * c[1]).sqrt();
        assert!((distance - 14.0).abs() < 1e-12 && c[1] == 0.5, "{c:?}");
        assert_eq!(touch_sphere([0.5, 40.0, 0.0], 12.5, &way), Contact::Missed);
        assert_eq!(touch_sphere([3.5, 0.0, 0.0], 12.5, &Approach { from_mm: 2.0, ..way }), Contact::Unexpected);
        assert_eq!(touch_sphere([-9.5, 0.0, 0.0], 12.5, &way), Contact::Missed);
    }

    #[test]
    fn height_grid_gradient_and_node_values() {
        let part = rough_part();
        let grid = &part.height;
        for (k, [x, y]) in grid.nodes().enumerate() {
            if part.aperture.contains(x, y) {
                assert!((grid.at(x, y).0 - grid.heights_mm[k]).abs() < 1e-14);
            }
        }
        for (x, y) in [(3.3, 4.1), (-50.9, 30.9), (0.5, 0.5), (20.01, -14.99)] {
            let (_, [hx, hy]) = grid.at(x, y);
            let e = 1e-5;
            let fx = (grid.at(x + e, y).0 - grid.at(x - e, y).0) / (2.0 * e);
            let fy = (grid.at(x, y + e).0 - grid.at(x, y - e).0) / (2.0 * e);
            assert!((hx - fx).abs() < 1e-8 && (hy - fy).abs() < 1e-8, "({x}, {y}): {hx} {fx} {hy} {fy}");
        }
    }
}
