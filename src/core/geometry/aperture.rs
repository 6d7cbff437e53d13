//! The outline of a part in the plane: the region in which its surface counts.
//!
//! An aperture is a closed set in the (x, y) plane of the surface's own frame: it includes its boundary. Lengths are in
//! millimetres. [`Aperture::validate`] checks an aperture from outside once; the other functions rely on it.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Largest accepted coordinate or size of a part, in millimetres.
const MAX_COORDINATE_MM: f64 = 1e6;

/// Maximum number of corners of a polygon: its check compares every pair of edges.
const MAX_CORNERS: usize = 4000;

/// The outline of a part in the (x, y) plane.
///
/// Units: millimetres. As written in TOML: `kind = "circle"`, `radius_mm = 30.0`; the default centre is the origin.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Aperture {
    /// A rectangle along the axes.
    Rectangle {
        /// Its middle.
        #[serde(default)]
        centre_mm: [f64; 2],
        /// Its size along x.
        width_mm: f64,
        /// Its size along y.
        height_mm: f64,
    },
    /// A disc.
    Circle {
        /// Its middle.
        #[serde(default)]
        centre_mm: [f64; 2],
        /// Its radius.
        radius_mm: f64,
    },
    /// An ellipse along the axes.
    Ellipse {
        /// Its middle.
        #[serde(default)]
        centre_mm: [f64; 2],
        /// Half its size along x and along y.
        semi_axes_mm: [f64; 2],
    },
    /// A disc with a round hole in its middle.
    Annulus {
        /// Its middle.
        #[serde(default)]
        centre_mm: [f64; 2],
        /// Radius of the hole; 0 for none.
        inner_radius_mm: f64,
        /// Radius of the rim.
        outer_radius_mm: f64,
    },
    /// A simple polygon, convex or not, its corners in either sense of turning; the last corner joins the first.
    Polygon {
        /// The corners in order, each once.
        #[cfg_attr(feature = "schema", schemars(length(min = 3)))]
        corners_mm: Vec<[f64; 2]>,
    },
}

/// Reason why a set of numbers is not an outline. A key is written as in TOML; corners count from 1.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ApertureError {
    /// A coordinate is NaN, infinite or too large.
    #[error(
        "`{key}` is {value_mm} mm; it must be a number between -{MAX_COORDINATE_MM:e} and {MAX_COORDINATE_MM:e} mm"
    )]
    Coordinate { key: &'static str, value_mm: f64 },
    /// A size is zero, negative, NaN or too large.
    #[error("`{key}` is {value_mm} mm; it must be greater than 0 and at most {MAX_COORDINATE_MM:e} mm")]
    Size { key: &'static str, value_mm: f64 },
    /// The hole of an annulus is negative or as large as the rim.
    #[error(
        "`inner_radius_mm` is {inner_mm} mm; it must be at least 0 and less than `outer_radius_mm`, which is {outer_mm} mm"
    )]
    Hole { inner_mm: f64, outer_mm: f64 },
    /// Too few or too many corners.
    #[error("`corners_mm` has {count} corners; a polygon has from 3 to {MAX_CORNERS}")]
    CornerCount { count: usize },
    /// Two neighbouring corners coincide; often the first is repeated at the end.
    #[error("corners {first} and {second} of `corners_mm` are the same point; write each corner once")]
    RepeatedCorner { first: usize, second: usize },
    /// Two edges of the polygon meet where they should not.
    #[error(
        "the edges after corners {first} and {second} of `corners_mm` cross or touch; give the corners in order around \
         the outline"
    )]
    Crossing { first: usize, second: usize },
}

impl ApertureError {
    /// Returns the TOML key that has the wrong value, such as `radius_mm`.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Coordinate { key, .. } | Self::Size { key, .. } => key,
            Self::Hole { .. } => "inner_radius_mm",
            Self::CornerCount { .. } | Self::RepeatedCorner { .. } | Self::Crossing { .. } => "corners_mm",
        }
    }
}

impl Aperture {
    /// Returns the rectangle with the corners `[x min, y min]` and `[x max, y max]`.
    pub(crate) fn from_corners([low, high]: [[f64; 2]; 2]) -> Self {
        let centre_mm = [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])];
        Self::Rectangle { centre_mm, width_mm: high[0] - low[0], height_mm: high[1] - low[1] }
    }

    /// Checks that the numbers describe a closed outline with an area above 0.
    ///
    /// # Errors
    /// Returns an error in each of these cases:
    ///
    /// - A coordinate is not finite, or its magnitude is above one kilometre.
    /// - A size is not above 0, or is above one kilometre.
    /// - The inner radius of an annulus is negative, or is not less than the outer radius.
    /// - A polygon has fewer than 3 or more than 4000 corners.
    /// - Two neighbouring corners of a polygon are equal, or its edges cross or touch.
    pub fn validate(&self) -> Result<(), ApertureError> {
        match self {
            Self::Rectangle { centre_mm, width_mm, height_mm } => {
                check_coordinates("centre_mm", centre_mm)?;
                check_size("width_mm", *width_mm)?;
                check_size("height_mm", *height_mm)
            }
            Self::Circle { centre_mm, radius_mm } => {
                check_coordinates("centre_mm", centre_mm)?;
                check_size("radius_mm", *radius_mm)
            }
            Self::Ellipse { centre_mm, semi_axes_mm } => {
                check_coordinates("centre_mm", centre_mm)?;
                semi_axes_mm.iter().try_for_each(|&axis| check_size("semi_axes_mm", axis))
            }
            Self::Annulus { centre_mm, inner_radius_mm, outer_radius_mm } => {
                check_coordinates("centre_mm", centre_mm)?;
                check_size("outer_radius_mm", *outer_radius_mm)?;
                if (0.0..*outer_radius_mm).contains(inner_radius_mm) {
                    return Ok(());
                }
                Err(ApertureError::Hole { inner_mm: *inner_radius_mm, outer_mm: *outer_radius_mm })
            }
            Self::Polygon { corners_mm } => validate_polygon(corners_mm),
        }
    }

    /// Returns true if the place (`x`, `y`), in mm, lies in the aperture or on its boundary; false if a coordinate is
    /// NaN.
    pub fn contains(&self, x: f64, y: f64) -> bool {
        match self {
            Self::Rectangle { centre_mm: [cx, cy], width_mm, height_mm } => {
                (x - cx).abs() <= 0.5 * width_mm && (y - cy).abs() <= 0.5 * height_mm
            }
            Self::Circle { centre_mm: [cx, cy], radius_mm } => (x - cx).hypot(y - cy) <= *radius_mm,
            Self::Ellipse { centre_mm: [cx, cy], semi_axes_mm: [a, b] } => ((x - cx) / a).hypot((y - cy) / b) <= 1.0,
            Self::Annulus { centre_mm: [cx, cy], inner_radius_mm, outer_radius_mm } => {
                (*inner_radius_mm..=*outer_radius_mm).contains(&(x - cx).hypot(y - cy))
            }
            Self::Polygon { corners_mm } => {
                let crossings = edges(corners_mm).filter(|[p, q]| crosses_ray(*p, *q, x, y)).count();
                crossings % 2 == 1 || edges(corners_mm).any(|edge| segment_distance(edge, x, y) == 0.0)
            }
        }
    }

    /// Returns the distance, in mm, of the place (`x`, `y`) to the nearest point of the aperture; 0 if it lies in the
    /// aperture.
    pub fn distance_mm(&self, x: f64, y: f64) -> f64 {
        match self {
            Self::Rectangle { centre_mm: [cx, cy], width_mm, height_mm } => {
                let [over_x, over_y] = [(x - cx).abs() - 0.5 * width_mm, (y - cy).abs() - 0.5 * height_mm];
                over_x.max(0.0).hypot(over_y.max(0.0))
            }
            Self::Circle { centre_mm: [cx, cy], radius_mm } => ((x - cx).hypot(y - cy) - radius_mm).max(0.0),
            Self::Ellipse { centre_mm: [cx, cy], semi_axes_mm } => ellipse_distance(*semi_axes_mm, x - cx, y - cy),
            Self::Annulus { centre_mm: [cx, cy], inner_radius_mm, outer_radius_mm } => {
                let r = (x - cx).hypot(y - cy);
                (inner_radius_mm - r).max(r - outer_radius_mm).max(0.0)
            }
            Self::Polygon { .. } if self.contains(x, y) => 0.0,
            Self::Polygon { corners_mm } => {
                edges(corners_mm).map(|edge| segment_distance(edge, x, y)).fold(f64::INFINITY, f64::min)
            }
        }
    }

    /// Returns the smallest rectangle along the axes that contains the aperture: `[[x min, y min], [x max, y max]]`.
    ///
    /// Units: millimetres.
    pub fn bounds(&self) -> [[f64; 2]; 2] {
        let around = |[x, y]: [f64; 2], a: f64, b: f64| [[x - a, y - b], [x + a, y + b]];
        match self {
            Self::Rectangle { centre_mm, width_mm, height_mm } => around(*centre_mm, 0.5 * width_mm, 0.5 * height_mm),
            Self::Circle { centre_mm, radius_mm } => around(*centre_mm, *radius_mm, *radius_mm),
            Self::Ellipse { centre_mm, semi_axes_mm: [a, b] } => around(*centre_mm, *a, *b),
            Self::Annulus { centre_mm, outer_radius_mm, .. } => around(*centre_mm, *outer_radius_mm, *outer_radius_mm),
            Self::Polygon { corners_mm } => super::bounds(corners_mm.iter().copied()),
        }
    }

    /// Returns the area of the aperture.
    ///
    /// Units: square millimetres.
    pub fn area_mm2(&self) -> f64 {
        match self {
            Self::Rectangle { width_mm, height_mm, .. } => width_mm * height_mm,
            Self::Circle { radius_mm, .. } => PI * radius_mm * radius_mm,
            Self::Ellipse { semi_axes_mm: [a, b], .. } => PI * a * b,
            Self::Annulus { inner_radius_mm: inner, outer_radius_mm: outer, .. } => {
                PI * (outer - inner) * (outer + inner)
            }
            // Areas are taken from one corner, so that a polygon far from the origin loses no digits.
            Self::Polygon { corners_mm } => {
                let of_edge = |[p, q]: [[f64; 2]; 2]| 0.5 * orient2d(corners_mm[0], p, q);
                edges(corners_mm).map(of_edge).sum::<f64>().abs()
            }
        }
    }

    /// Returns positions (x, y) in mm along the whole boundary of the aperture: at least `count` in total. The corners
    /// of a rectangle or polygon are included. For an annulus, each of its two circles gets `count` positions.
    ///
    /// On a round boundary, a position can be slightly outside the aperture because of rounding.
    pub fn outline_mm(&self, count: usize) -> Vec<[f64; 2]> {
        let around = |[x, y]: [f64; 2], a: f64, b: f64| {
            (0..count).map(move |i| {
                let (sine, cosine) = (std::f64::consts::TAU * i as f64 / count as f64).sin_cos();
                [x + a * cosine, y + b * sine]
            })
        };
        match self {
            Self::Rectangle { .. } => {
                let [[x0, y0], [x1, y1]] = self.bounds();
                along_edges(&[[x0, y0], [x1, y0], [x1, y1], [x0, y1]], count)
            }
            Self::Circle { centre_mm, radius_mm } => around(*centre_mm, *radius_mm, *radius_mm).collect(),
            Self::Ellipse { centre_mm, semi_axes_mm: [a, b] } => around(*centre_mm, *a, *b).collect(),
            Self::Annulus { centre_mm, inner_radius_mm: inner, outer_radius_mm: outer } => {
                around(*centre_mm, *outer, *outer).chain(around(*centre_mm, *inner, *inner)).collect()
            }
            Self::Polygon { corners_mm } => along_edges(corners_mm, count),
        }
    }

    /// Returns the distance from the origin to the aperture's farthest point.
    ///
    /// Units: millimetres. For an ellipse off the origin, the distance is the maximum over 720 points of the outline;
    /// its relative error is at most 1e-5.
    pub fn reach_mm(&self) -> f64 {
        match self {
            Self::Circle { centre_mm: [x, y], radius_mm: r }
            | Self::Annulus { centre_mm: [x, y], outer_radius_mm: r, .. } => x.hypot(*y) + r,
            _ => self.outline_mm(720).iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max),
        }
    }

    /// Returns positions (x, y) in mm that represent the aperture: up to 800 positions inside, then at least 240 along
    /// the outline. The result is the same at every call.
    ///
    /// For the positions inside, 800 positions are spread evenly over the bounding rectangle. Those that lie outside
    /// the aperture are dropped. The positions follow the additive recurrence of the plastic number (a low-discrepancy
    /// sequence).
    pub(crate) fn places_mm(&self) -> Vec<[f64; 2]> {
        let [least, most] = self.bounds();
        let plastic = 1.324_717_957_244_746_f64;
        let inside = (0..800).map(|i| {
            [0, 1].map(|k| {
                let t = (0.5 + f64::from(i) * plastic.powi(-1 - k as i32)).fract();
                least[k] + t * (most[k] - least[k])
            })
        });
        let inside = inside.filter(|[x, y]| self.contains(*x, *y));
        inside.chain(self.outline_mm(240)).collect()
    }
}

/// Checks that both coordinates of `point`, in mm, are numbers of at most [`MAX_COORDINATE_MM`] in magnitude. `key` is
/// the TOML key of the point, for the error.
///
/// # Errors
/// Returns [`ApertureError::Coordinate`] with `key` if a coordinate is NaN or too large.
fn check_coordinates(key: &'static str, point: &[f64; 2]) -> Result<(), ApertureError> {
    match point.iter().find(|v| v.is_nan() || v.abs() > MAX_COORDINATE_MM) {
        Some(&value_mm) => Err(ApertureError::Coordinate { key, value_mm }),
        None => Ok(()),
    }
}

/// Checks that the size `value_mm` is above 0 and at most [`MAX_COORDINATE_MM`]. `key` is the TOML key of the size, for
/// the error.
///
/// # Errors
/// Returns [`ApertureError::Size`] with `key` if the size is outside these limits or NaN.
fn check_size(key: &'static str, value_mm: f64) -> Result<(), ApertureError> {
    if value_mm > 0.0 && value_mm <= MAX_COORDINATE_MM { Ok(()) } else { Err(ApertureError::Size { key, value_mm }) }
}

/// Checks that `corners`, joined in order and back to the first, form a simple polygon: no edges cross, touch or fold
/// back.
///
/// # Errors
/// Returns an error for fewer than 3 or more than [`MAX_CORNERS`] corners, for an invalid coordinate, for two equal
/// neighbouring corners, and for edges that cross, touch or fold back.
fn validate_polygon(corners: &[[f64; 2]]) -> Result<(), ApertureError> {
    let count = corners.len();
    if !(3..=MAX_CORNERS).contains(&count) {
        return Err(ApertureError::CornerCount { count });
    }
    for corner in corners {
        check_coordinates("corners_mm", corner)?;
    }
    let edges: Vec<_> = edges(corners).collect();
    if let Some(i) = edges.iter().position(|[p, q]| p == q) {
        return Err(ApertureError::RepeatedCorner { first: i + 1, second: (i + 1) % count + 1 });
    }
    for i in 0..count {
        for j in i + 1..count {
            let meet = if j == i + 1 {
                folds_back(edges[i], edges[j])
            } else if i == 0 && j == count - 1 {
                folds_back(edges[j], edges[i])
            } else {
                segments_meet(edges[i], edges[j])
            };
            if meet {
                return Err(ApertureError::Crossing { first: i + 1, second: j + 1 });
            }
        }
    }
    Ok(())
}

/// Returns the edges of a closed polygon, each as the pair of its start and end corner. The last edge returns to the
/// first corner.
fn edges(corners: &[[f64; 2]]) -> impl Iterator<Item = [[f64; 2]; 2]> + '_ {
    corners.iter().zip(corners.iter().cycle().skip(1)).map(|(p, q)| [*p, *q])
}

/// Returns at least `count` positions along the edges of a closed polygon. These are the corners and, on each edge,
/// equally spaced positions between its two corners. Each edge has the same number of positions.
fn along_edges(corners: &[[f64; 2]], count: usize) -> Vec<[f64; 2]> {
    let steps = count.div_ceil(corners.len()).max(1);
    let places = edges(corners).flat_map(|[p, q]| {
        (0..steps).map(move |i| {
            let t = i as f64 / steps as f64;
            [p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])]
        })
    });
    places.collect()
}

/// Returns true if the ray from the point (`x`, `y`) towards +x crosses the edge from `p` to `q`. The end of the edge
/// with the lower y counts as part of the edge, the other end does not. Therefore a ray through a corner is not counted
/// twice.
fn crosses_ray(p: [f64; 2], q: [f64; 2], x: f64, y: f64) -> bool {
    (p[1] > y) != (q[1] > y) && x < p[0] + (y - p[1]) / (q[1] - p[1]) * (q[0] - p[0])
}

/// Returns twice the signed area of the triangle `p`, `q`, `r`: positive if the three points are in anticlockwise
/// order, 0 if they lie on a line.
fn orient2d(p: [f64; 2], q: [f64; 2], r: [f64; 2]) -> f64 {
    (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
}

/// Returns true if the edge from `q` to `r` runs back along the edge from `p` to `q`: both lie on one line and have
/// opposite directions.
fn folds_back([p, q]: [[f64; 2]; 2], [_, r]: [[f64; 2]; 2]) -> bool {
    let forward = (q[0] - p[0]) * (r[0] - q[0]) + (q[1] - p[1]) * (r[1] - q[1]);
    orient2d(p, q, r) == 0.0 && forward < 0.0
}

/// Returns true if the segment from `a` to `b` and the segment from `c` to `d` cross or touch.
fn segments_meet([a, b]: [[f64; 2]; 2], [c, d]: [[f64; 2]; 2]) -> bool {
    let (c_side, d_side, a_side, b_side) = (orient2d(a, b, c), orient2d(a, b, d), orient2d(c, d, a), orient2d(c, d, b));
    if c_side * d_side < 0.0 && a_side * b_side < 0.0 {
        return true;
    }
    let within = |p: [f64; 2], q: [f64; 2], r: [f64; 2]| {
        (0..2).all(|k| p[k].min(q[k]) <= r[k] && r[k] <= p[k].max(q[k])) && orient2d(p, q, r) == 0.0
    };
    within(a, b, c) || within(a, b, d) || within(c, d, a) || within(c, d, b)
}

/// Returns the distance of the place (`x`, `y`) to the nearest point of the segment from `p` to `q`.
fn segment_distance([p, q]: [[f64; 2]; 2], x: f64, y: f64) -> f64 {
    let (ex, ey) = (q[0] - p[0], q[1] - p[1]);
    let t = (((x - p[0]) * ex + (y - p[1]) * ey) / (ex * ex + ey * ey)).clamp(0.0, 1.0);
    (x - p[0] - t * ex).hypot(y - p[1] - t * ey)
}

/// Returns the distance of the point (`x`, `y`) to an ellipse with its centre at the origin and the semi-axes `[a, b]`
/// along x and y. Returns 0 if the point lies inside the ellipse. All lengths have the same unit.
///
/// The nearest point of the ellipse is (a^2 x / (t + a^2), b^2 y / (t + b^2)). The number t >= 0 is the root of the
/// condition that this point lies on the ellipse. The condition is a convex, decreasing function of t. Therefore
/// Newton's method, started at t = 0, approaches the root from below and never passes the root.
fn ellipse_distance([a, b]: [f64; 2], x: f64, y: f64) -> f64 {
    if (x / a).hypot(y / b) <= 1.0 {
        return 0.0;
    }
    let mut t = 0.0;
    for _ in 0..60 {
        let (u, v) = (a * x / (t + a * a), b * y / (t + b * b));
        let step = (u * u + v * v - 1.0) / (2.0 * (u * u / (t + a * a) + v * v / (t + b * b)));
        t += step.max(0.0);
        if step <= 1e-15 * t {
            break;
        }
    }
    (x * t / (t + a * a)).hypot(y * t / (t + b * b))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns an L shape: the square with corners 0 and 4 without its upper right quarter.
    fn l_shape() -> Aperture {
        Aperture::Polygon { corners_mm: vec![[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [2.0, 2.0], [2.0, 4.0], [0.0, 4.0]] }
    }

    fn all_kinds() -> Vec<Aperture> {
        vec![
            Aperture::Rectangle { centre_mm: [1.0, -2.0], width_mm: 3.0, height_mm: 1.0 },
            Aperture::Circle { centre_mm: [0.5, 0.25], radius_mm: 2.0 },
            Aperture::Ellipse { centre_mm: [-1.0, 0.0], semi_axes_mm: [4.0, 0.5] },
            Aperture::Annulus { centre_mm: [0.0, 1.0], inner_radius_mm: 1.0, outer_radius_mm: 2.5 },
            l_shape(),
        ]
    }

    #[test]
    fn areas_by_hand() {
        let areas: Vec<f64> = all_kinds().iter().map(Aperture::area_mm2).collect();
        let expected = [3.0, 4.0 * PI, 2.0 * PI, 5.25 * PI, 12.0];
        assert!(areas.iter().zip(expected).all(|(area, expected)| (area - expected).abs() < 1e-12), "{areas:?}");
        // The same polygon in the other turning sense, and a kilometre away.
        let Aperture::Polygon { corners_mm } = l_shape() else { panic!() };
        let corners_mm = corners_mm.into_iter().rev().map(|[x, y]| [x + 1e6, y - 1e6]).collect();
        assert_eq!(Aperture::Polygon { corners_mm }.area_mm2(), 12.0);
    }

    #[test]
    fn contains_by_hand() {
        let inside = |a: &Aperture, x, y| a.contains(x, y);
        let [rectangle, circle, ellipse, annulus, l] = &all_kinds()[..] else { panic!() };
        assert!(inside(rectangle, 2.5, -1.5) && !inside(rectangle, 2.6, -2.0));
        assert!(inside(circle, 2.5, 0.25) && !inside(circle, 2.0, 2.0));
        assert!(inside(ellipse, 3.0, 0.0) && inside(ellipse, -1.0, 0.5) && !inside(ellipse, 2.0, 0.4));
        assert!(inside(annulus, 0.0, 3.5) && inside(annulus, 1.0, 1.0) && !inside(annulus, 0.0, 1.0));
        assert!(inside(l, 1.0, 3.0) && inside(l, 2.0, 2.0) && inside(l, 4.0, 2.0) && !inside(l, 3.0, 3.0));
        // The ray from here runs through the corner (2, 2) and along the edge that ends there.
        assert!(inside(l, 1.0, 2.0) && !inside(l, -1.0, 2.0) && !inside(l, -1.0, 0.0));
        assert!(all_kinds().iter().all(|a| !a.contains(f64::NAN, 0.0)));
    }

    #[test]
    fn distances_by_hand() {
        let kinds = all_kinds();
        for (aperture, place, distance) in [
            (&kinds[0], [5.5, 1.5], 3.0f64.hypot(3.0)),
            (&kinds[1], [0.5, 5.25], 3.0),
            (&kinds[2], [5.0, 0.0], 2.0),
            (&kinds[2], [-1.0, 2.5], 2.0),
            (&kinds[3], [0.25, 1.0], 0.75),
            (&kinds[3], [3.5, 1.0], 1.0),
            (&kinds[4], [3.0, 3.0], 1.0),
            (&kinds[4], [5.0, 3.0], 2.0f64.sqrt()),
        ] {
            let found = aperture.distance_mm(place[0], place[1]);
            assert!((found - distance).abs() < 1e-14, "{aperture:?} {place:?}: {found}");
        }
    }

    #[test]
    fn aperture_distance_matches_outline() {
        for aperture in all_kinds() {
            let outline = aperture.outline_mm(20_000);
            assert!(outline.len() >= 20_000);
            for i in 0..400 {
                let (x, y) = (-6.0 + 0.6 * (i % 20) as f64, -6.0 + 0.6 * (i / 20) as f64);
                let nearest = outline.iter().map(|p| (p[0] - x).hypot(p[1] - y)).fold(f64::INFINITY, f64::min);
                let expected = if aperture.contains(x, y) { 0.0 } else { nearest };
                assert!((aperture.distance_mm(x, y) - expected).abs() < 1e-3, "{aperture:?} ({x}, {y})");
            }
        }
    }

    #[test]
    fn aperture_bounds_match_outline() {
        for aperture in all_kinds() {
            let [least, most] = aperture.bounds();
            let outline = aperture.outline_mm(4000);
            for k in 0..2 {
                let coordinates = || outline.iter().map(|p| p[k]);
                assert!((coordinates().fold(f64::INFINITY, f64::min) - least[k]).abs() < 1e-5);
                assert!((coordinates().fold(f64::NEG_INFINITY, f64::max) - most[k]).abs() < 1e-5);
            }
            let farthest = outline.iter().map(|p| p[0].hypot(p[1])).fold(0.0, f64::max);
            assert!((aperture.reach_mm() - farthest).abs() < 1e-4, "{aperture:?}");
        }
    }

    #[test]
    fn aperture_refuses_degenerate_outline() {
        let circle = |radius_mm| Aperture::Circle { centre_mm: [0.0; 2], radius_mm }.validate();
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e7] {
            assert!(matches!(circle(bad), Err(ApertureError::Size { key: "radius_mm", .. })), "{bad}");
        }
        let off = Aperture::Circle { centre_mm: [0.0, f64::NAN], radius_mm: 1.0 };
        assert!(matches!(off.validate(), Err(ApertureError::Coordinate { key: "centre_mm", .. })));
        for inner_radius_mm in [2.0, 3.0, -0.1, f64::NAN] {
            let ring = Aperture::Annulus { centre_mm: [0.0; 2], inner_radius_mm, outer_radius_mm: 2.0 };
            assert!(matches!(ring.validate(), Err(ApertureError::Hole { .. })));
        }
        assert!(all_kinds().iter().all(|a| a.validate().is_ok()));
    }

    #[test]
    fn aperture_refuses_non_simple_polygon() {
        let polygon = |corners: &[[f64; 2]]| Aperture::Polygon { corners_mm: corners.to_vec() }.validate();
        assert_eq!(polygon(&[[0.0, 0.0], [1.0, 0.0]]), Err(ApertureError::CornerCount { count: 2 }));
        let closed = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]];
        assert_eq!(polygon(&closed), Err(ApertureError::RepeatedCorner { first: 4, second: 1 }));
        let bow_tie = [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]];
        assert_eq!(polygon(&bow_tie), Err(ApertureError::Crossing { first: 1, second: 3 }));
        let flat = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]];
        assert!(matches!(polygon(&flat), Err(ApertureError::Crossing { .. })));
        let spike = [[0.0, 0.0], [4.0, 0.0], [2.0, 0.0], [2.0, 2.0]];
        assert!(matches!(polygon(&spike), Err(ApertureError::Crossing { .. })));
        let touching = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 0.0], [0.0, 4.0]];
        assert!(matches!(polygon(&touching), Err(ApertureError::Crossing { .. })));
        // Either turning sense is valid, and so is a corner in a straight side.
        assert_eq!(polygon(&[[0.0, 1.0], [1.0, 0.0], [0.5, 0.0], [0.0, 0.0]]), Ok(()));
    }

    #[test]
    fn aperture_kinds_read_from_toml() {
        let read = |text: &str| toml::from_str::<Aperture>(text);
        let circle = Aperture::Circle { centre_mm: [0.0; 2], radius_mm: 30.0 };
        assert_eq!(read("kind = 'circle'\nradius_mm = 30").unwrap(), circle);
        assert!(read("kind = 'circle'\nradius_mm = 30\ndiameter_mm = 1").is_err());
        for aperture in all_kinds() {
            assert_eq!(read(&toml::to_string(&aperture).unwrap()).unwrap(), aperture);
        }
    }
}
