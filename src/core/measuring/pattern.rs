//! Targets: the places where the probe touches the part.

use std::f64::consts::{PI, TAU};

use thiserror::Error;

use crate::geometry::{Point, Vector};
use crate::surface::{FacetIndex, Nominal, OffsetSurface, Side};

/// Maximum number of targets: more than a machine measures in a week.
const MAX_TARGETS: f64 = 1e7;
/// Maximum distance beyond the edge, in millimetres, at which a point counts as on the part. Such a distance is
/// rounding.
const EDGE_TOLERANCE_MM: f64 = 1e-6;
/// Maximum number of iterations in the search of a target; after that, the target counts as not on the surface.
const MAX_ITERATIONS: usize = 50;

/// Place to touch: a point of the nominal surface and its outward unit normal, in the model frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// Nominal contact point, in millimetres.
    pub point: Point,
    /// Unit normal towards the probe's side.
    pub normal: Vector,
}

/// Layout of the targets over x and y of the model frame.
#[derive(Clone, Debug, PartialEq)]
pub enum Layout {
    /// Grid with this spacing in millimetres; every second row runs backwards.
    GridSpacing(f64),
    /// Grid of this number of columns and rows; every second row runs backwards.
    GridPoints([u32; 2]),
    /// Spiral from the middle with this distance between turns and between points, in millimetres.
    SpiralSpacing(f64),
    /// Spiral from the middle with about this number of points.
    SpiralPoints(u32),
    /// Points of the nominal surface nearest to the given points, in the given order.
    Points(Vec<Point>),
}

/// Reason why no targets can be computed.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum PatternError {
    #[error("the measuring pattern has a spacing of {spacing_mm} mm; it must be a finite number above 0")]
    Spacing { spacing_mm: f64 },
    #[error("the measuring pattern has {count:.0} points, more than {MAX_TARGETS:.0}; choose a wider spacing")]
    TooMany { count: f64 },
    #[error(
        "none of the {requested} places of the measuring pattern lies on the part at least {margin_mm} mm inside its \
         edge; the part is {:.3} mm x {:.3} mm large: correct the unit of the nominal surface if it is not that large, or \
         reduce edge_margin_mm or the spacing", size_mm[0], size_mm[1]
    )]
    NoneOnPart { requested: usize, margin_mm: f64, size_mm: [f64; 2] },
}

/// Returns the targets of a measuring pattern on the part, in the order of measurement. A target is a point of the
/// nominal surface with its unit normal towards `side`, the side of the probe.
///
/// `layout` is a grid or a spiral in the xy plane, or a list of points. A target is omitted if it is not on the part,
/// or if it is less than `margin_mm` from the edge. Frame: model. Units: millimetres.
///
/// # Errors
/// Returns an error if the spacing of the layout is not a finite number above 0, if a grid or a spiral has more than
/// ten million points, or if every target is omitted.
pub fn targets(nominal: &Nominal, side: Side, layout: &Layout, margin_mm: f64) -> Result<Vec<Target>, PatternError> {
    let surface = OffsetSurface::new(nominal, 0.0, side).expect("a radius of 0 is good");
    let bounds = bounds(nominal);
    let places = places(layout, bounds, margin_mm)?;
    let (mut found, mut walk) = (Vec::with_capacity(places.len()), SurfaceWalk::new(surface, bounds));
    for place in &places {
        let target = match place {
            TargetRequest::AtXy(xy) => walk.target_at(*xy),
            TargetRequest::NearestTo(point) => walk.target_nearest_to(point),
        };
        found.extend(target.filter(|target| walk.is_inside(target, margin_mm)));
    }
    if found.is_empty() {
        let size_mm = [0, 1].map(|k| bounds[1][k] - bounds[0][k]);
        return Err(PatternError::NoneOnPart { requested: places.len(), margin_mm, size_mm });
    }
    Ok(found)
}

/// Returns `count` targets, spread evenly over the upper part of a reference sphere, for a probe that approaches from
/// above. The angle between the normal of a target and +z is at most 80 degrees.
///
/// `centre` is the centre of the sphere, in mm. The targets are in the same frame as `centre`.
pub fn sphere_targets(centre: Point, radius_mm: f64, count: usize) -> Vec<Target> {
    // Equal areas from the pole down to 80 degrees, each turned by the golden angle.
    let lowest = 80f64.to_radians().cos();
    (0..count)
        .map(|k| {
            let height = 1.0 - (1.0 - lowest) * (k as f64 + 0.5) / count as f64;
            let (sin, cos) = (k as f64 * PI * (3.0 - 5f64.sqrt())).sin_cos();
            let around = (1.0 - height * height).sqrt();
            let normal = Vector::new(around * cos, around * sin, height);
            Target { point: centre + radius_mm * normal, normal }
        })
        .collect()
}

enum TargetRequest {
    AtXy([f64; 2]),
    NearestTo(Point),
}

fn bounds(nominal: &Nominal) -> [[f64; 2]; 2] {
    let of_points = crate::geometry::bounds(nominal.points().map(|p| [p.x, p.y]));
    // A nominal can be sampled one ring beyond its aperture; targets must not lie there.
    match nominal.outline() {
        Some(outline) => {
            let [low, high] = outline.bounds();
            [
                [low[0].max(of_points[0][0]), low[1].max(of_points[0][1])],
                [high[0].min(of_points[1][0]), high[1].min(of_points[1][1])],
            ]
        }
        None => of_points,
    }
}

/// Returns the positions of a layout, in the order of measurement. A grid or a spiral covers the rectangle with the
/// corners `[low, high]`, made smaller by `margin_mm` on every side. The points of a list are returned unchanged.
/// Units: millimetres.
///
/// # Errors
/// Returns an error if the spacing of the layout is not a finite number above 0, or if a grid or a spiral has more than
/// [`MAX_TARGETS`] positions.
fn places(layout: &Layout, [low, high]: [[f64; 2]; 2], margin_mm: f64) -> Result<Vec<TargetRequest>, PatternError> {
    let [width, depth] = [0, 1].map(|k| (high[k] - low[k] - 2.0 * margin_mm).max(0.0));
    let middle = [0, 1].map(|k| 0.5 * (low[k] + high[k]));
    let grid = |columns: f64, rows: f64| {
        let count = columns * rows;
        if count > MAX_TARGETS {
            return Err(PatternError::TooMany { count });
        }
        let (columns, rows) = (columns as usize, rows as usize);
        let at = |i: usize, n: usize, size: f64| if n > 1 { size * (i as f64 / (n - 1) as f64 - 0.5) } else { 0.0 };
        Ok((0..columns * rows)
            .map(|k| {
                let (i, j) = (k % columns, k / columns);
                // Every second row runs backwards, so that the probe need not travel back.
                let i = if j % 2 == 0 { i } else { columns - 1 - i };
                TargetRequest::AtXy([middle[0] + at(i, columns, width), middle[1] + at(j, rows, depth)])
            })
            .collect())
    };
    let check = |spacing_mm: f64| {
        if spacing_mm > 0.0 && spacing_mm.is_finite() {
            Ok(spacing_mm)
        } else {
            Err(PatternError::Spacing { spacing_mm })
        }
    };
    match layout {
        Layout::GridSpacing(spacing) => {
            let spacing = check(*spacing)?;
            grid((width / spacing).floor() + 1.0, (depth / spacing).floor() + 1.0)
        }
        Layout::GridPoints([columns, rows]) => grid(f64::from((*columns).max(1)), f64::from((*rows).max(1))),
        Layout::SpiralSpacing(spacing) => spiral(check(*spacing)?, middle, [width, depth]),
        // The spiral has one point for each square of its spacing within the rectangle.
        Layout::SpiralPoints(count) => {
            let area = (width * depth).max(1e-9);
            spiral((area / f64::from((*count).max(1))).sqrt(), middle, [width, depth])
        }
        Layout::Points(points) => Ok(points.iter().map(|p| TargetRequest::NearestTo(*p)).collect()),
    }
}

/// Returns positions along an Archimedean spiral that starts at `middle`. Positions outside the rectangle of size
/// `[width, depth]` with the centre `middle` are left out. `spacing` is the distance between turns, and also between
/// successive positions. Units: millimetres.
///
/// # Errors
/// Returns an error if there are more than [`MAX_TARGETS`] positions.
fn spiral(spacing: f64, middle: [f64; 2], [width, depth]: [f64; 2]) -> Result<Vec<TargetRequest>, PatternError> {
    let reach = 0.5 * width.hypot(depth);
    let count = PI * (reach / spacing).powi(2);
    if count > MAX_TARGETS {
        return Err(PatternError::TooMany { count });
    }
    // Archimedes' spiral r = spacing * turns, with an arc of one spacing from point to point.
    let (mut angle, mut found) = (0.0f64, Vec::new());
    loop {
        let r = spacing * angle / TAU;
        if r > reach {
            return Ok(found);
        }
        let (sin, cos) = angle.sin_cos();
        let (x, y) = (r * cos, r * sin);
        if x.abs() <= 0.5 * width && y.abs() <= 0.5 * depth {
            found.push(TargetRequest::AtXy([middle[0] + x, middle[1] + y]));
        }
        angle += spacing / r.max(spacing / TAU).hypot(spacing / TAU);
    }
}

/// Search of targets on the surface, one after another. Each search starts at the facet and the height of the target
/// before.
struct SurfaceWalk<'a> {
    surface: OffsetSurface<'a>,
    facet: FacetIndex,
    /// Height of the last target, at which the search for the next begins.
    z: f64,
    /// Diagonal of the bounds in x and y: limit of one step in height.
    size_mm: f64,
}

impl<'a> SurfaceWalk<'a> {
    fn new(surface: OffsetSurface<'a>, [low, high]: [[f64; 2]; 2]) -> Self {
        let z = surface.nominal().points().next().map_or(0.0, |p| p.z);
        Self { surface, facet: FacetIndex::UNKNOWN, z, size_mm: (high[0] - low[0]).hypot(high[1] - low[1]) }
    }

    /// Finds the point of the surface with the given x and y, in mm, and returns it as a target with its normal. The
    /// height z is found by Newton's method. Each step intersects the vertical line through (x, y) with the tangent
    /// plane at the projection of the current point onto the surface.
    ///
    /// Returns `None` if the surface is nearly vertical, if the iteration does not converge, or if the point lies
    /// beyond the edge of the surface.
    fn target_at(&mut self, [x, y]: [f64; 2]) -> Option<Target> {
        let mut p = Point::new(x, y, self.z);
        for _ in 0..MAX_ITERATIONS {
            let foot = self.surface.project(&p, self.facet);
            self.facet = foot.facet;
            let lean = foot.normal.z;
            if lean.abs() < 1e-3 || !foot.distance_mm.is_finite() {
                return None;
            }
            let step = foot.distance_mm / lean;
            p.z -= step.clamp(-self.size_mm, self.size_mm);
            if step.abs() < 1e-9 * (1.0 + self.size_mm) {
                self.z = p.z;
                return (foot.beyond_edge_mm <= EDGE_TOLERANCE_MM).then_some(Target { point: p, normal: foot.normal });
            }
        }
        None
    }

    /// Returns the target at the projection of the point `p` onto the surface. Returns `None` if the projection lies
    /// beyond the edge, or if `p` is farther from the surface than 5 % of the diagonal of the part.
    fn target_nearest_to(&mut self, p: &Point) -> Option<Target> {
        let foot = self.surface.project(p, self.facet);
        self.facet = foot.facet;
        let target = Target { point: p - foot.distance_mm * foot.normal, normal: foot.normal };
        // A point far away belongs to another part, or to another unit.
        let near = foot.distance_mm.abs() <= 0.05 * self.size_mm;
        (foot.beyond_edge_mm <= EDGE_TOLERANCE_MM && near).then_some(target)
    }

    /// Returns true if the target lies within the outline of the part and at least `margin_mm` from the edge.
    ///
    /// The distance from the edge is checked with eight points. They lie in the tangent plane, on a circle of radius
    /// `margin_mm` about the target. Each must lie within the outline, and its projection must not lie beyond the edge
    /// of the surface.
    fn is_inside(&self, target: &Target, margin_mm: f64) -> bool {
        let outline = self.surface.nominal().outline();
        let (u, _) = frame(&target.normal);
        let v = target.normal.cross(&u);
        let around = (0..8).map(|k| (f64::from(k) * TAU / 8.0).sin_cos());
        // The margin is reduced slightly, so that rounding does not exclude points exactly on it.
        let margin_mm = margin_mm * (1.0 - 1e-9);
        outline.is_none_or(|o| o.contains(target.point.x, target.point.y))
            && (margin_mm == 0.0
                || around.map(|(s, c)| target.point + margin_mm * (c * u + s * v)).all(|p| {
                    self.surface.project(&p, self.facet).beyond_edge_mm <= EDGE_TOLERANCE_MM
                        && outline.is_none_or(|o| o.contains(p.x, p.y))
                }))
    }
}

/// Returns two unit vectors that are perpendicular to each other and to the unit vector `normal`. The first is the x
/// axis, projected onto the plane perpendicular to `normal` and normalised. If `normal` is close to the x axis, the y
/// axis is used instead.
fn frame(normal: &Vector) -> (Vector, Vector) {
    let x = if normal.x.abs() < 0.9 { Vector::x() } else { Vector::y() };
    let u = (x - normal * normal.dot(&x)).normalize();
    (u, normal.cross(&u))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::PlaneProjection;

    /// Returns a dome z = -(x^2 + y^2) / 200 over 40 x 20 mm, with a point every 0.5 mm.
    fn dome() -> Nominal {
        let points = (0..81 * 41).map(|k| [f64::from(k % 81) * 0.5 - 20.0, f64::from(k / 81) * 0.5 - 10.0]);
        let points = points.map(|[x, y]| Point::new(x, y, -(x * x + y * y) / 200.0)).collect();
        Nominal::from_points(points, PlaneProjection::Auto).unwrap()
    }

    #[test]
    fn grid_targets_alternate_on_surface() {
        let found = targets(&dome(), Side::Normal, &Layout::GridPoints([10, 5]), 1.0).unwrap();
        assert_eq!(found.len(), 50);
        for Target { point, normal } in &found {
            assert!((point.z + (point.x * point.x + point.y * point.y) / 200.0).abs() < 1e-6, "{point}");
            let true_normal = Vector::new(point.x / 100.0, point.y / 100.0, 1.0).normalize();
            assert!((normal - true_normal).norm() < 1e-5 && point.x.abs() < 19.001 && point.y.abs() < 9.001);
        }
        assert!(found[9].point.x > 18.9 && found[10].point.x > 18.9 && found[0].point.x < -18.9);
        let below = targets(&dome(), Side::Opposite, &Layout::GridPoints([10, 5]), 1.0).unwrap();
        assert!(below.iter().all(|t| t.normal.z < 0.0));
    }

    #[test]
    fn targets_of_each_layout() {
        let spaced = targets(&dome(), Side::Normal, &Layout::GridSpacing(2.0), 0.0).unwrap();
        assert_eq!(spaced.len(), 21 * 11);
        let spiral = targets(&dome(), Side::Normal, &Layout::SpiralPoints(400), 1.0).unwrap();
        assert!((300..500).contains(&spiral.len()), "{}", spiral.len());
        let near = Layout::Points(vec![Point::new(3.0, 4.0, 0.5), Point::new(300.0, 0.0, 0.0)]);
        assert_eq!(targets(&dome(), Side::Normal, &near, 0.0).unwrap().len(), 1);
    }

    #[test]
    fn targets_respect_outline_and_margin() {
        let round = dome().with_outline(crate::geometry::Aperture::Circle { radius_mm: 8.0, centre_mm: [0.0, 0.0] });
        let found = targets(&round, Side::Normal, &Layout::GridSpacing(0.5), 2.0).unwrap();
        let farthest = found.iter().map(|t| t.point.x.hypot(t.point.y)).fold(0.0, f64::max);
        assert!((5.5..6.05).contains(&farthest), "{farthest}");
    }

    #[test]
    fn targets_refuse_bad_layout() {
        let lay = |layout: Layout, margin| targets(&dome(), Side::Normal, &layout, margin);
        assert!(matches!(lay(Layout::GridSpacing(0.0), 0.0), Err(PatternError::Spacing { .. })));
        assert!(matches!(lay(Layout::GridSpacing(1e-9), 0.0), Err(PatternError::TooMany { .. })));
        assert!(matches!(lay(Layout::SpiralSpacing(1e-9), 0.0), Err(PatternError::TooMany { .. })));
        assert!(matches!(lay(Layout::GridSpacing(1.0), 15.0), Err(PatternError::NoneOnPart { .. })));
    }

    #[test]
    fn sphere_targets_on_upper_half() {
        let centre = Point::new(1.0, 2.0, 3.0);
        for Target { point, normal } in sphere_targets(centre, 12.5, 25) {
            assert!(((point - centre).norm() - 12.5).abs() < 1e-12 && normal.z > 0.17);
        }
    }
}
