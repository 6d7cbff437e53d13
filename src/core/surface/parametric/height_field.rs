//! Parametric surface as a height z = f(x, y): the place (u, v) of each (x, y) is found exactly.

use super::bspline::SurfacePoint;
use super::curve::Curve;
use super::frame::Frame;
use super::parametric_surface::{ParametricSurface, has_planar_profile, meridian};
use super::trimmed_domain::{TrimmedDomain, wrapped};
use crate::geometry::{Point, PointTree, Vector};

/// Largest number of places per direction from which the search can start.
const MAX_STARTS: usize = 256;

/// Smallest number of places per direction from which the search can start.
const MIN_STARTS: usize = 48;

/// Share of the domain by which a B-spline is continued beyond each of its ends. The nodes of a sampling around the
/// outline need it.
const CONTINUATION: f64 = 0.3;

/// Number of places that are tried for one (x, y), the nearest first.
const TRIES: u32 = 6;

/// Largest step of Newton's method, as a share of the size of the part, that can be due to rounding.
const MAX_ROUNDING: f64 = 1e-9;

/// Smallest z of a unit normal that counts as facing +z.
const MIN_NORMAL_Z: f64 = 1e-6;

/// The part of a parametric surface that faces +z, as z = f(x, y).
#[derive(Debug)]
pub struct HeightField {
    surface: ParametricSurface,
    /// Whether a profile that is turned lies in a plane with the axis.
    is_planar_profile: bool,
    /// 1 if du x dv faces +z, -1 if it faces -z.
    side: f64,
    /// Parameters of the places from which the search starts, and their z.
    starts: Vec<([f64; 2], f64)>,
    tree: PointTree,
    domain: [[f64; 2]; 2],
    /// Lengths after which u and v repeat; infinite for a parameter that does not.
    period: [f64; 2],
    /// Largest coordinate, for the limits of rounding.
    scale_mm: f64,
}

impl PartialEq for HeightField {
    /// Two fields are equal if they have the same surface and the same starts.
    fn eq(&self, other: &Self) -> bool {
        self.surface == other.surface && self.side == other.side && self.starts == other.starts
    }
}

impl HeightField {
    /// Creates the height field of the part of `surface` that the outlines enclose. `du x dv` faces +z if `side` is 1,
    /// and -z if it is -1.
    ///
    /// Returns `None` if no place of the part faces +z.
    pub(super) fn new(surface: ParametricSurface, outlines: &[Vec<Point>], side: f64) -> Option<Self> {
        let (trimmed, domain) = TrimmedDomain::of_outlines(&surface, outlines);
        let border: Vec<[f64; 2]> = trimmed.border_places().map(|at| trimmed.wrapped(at)).collect();
        // A ring on a sphere has two sides, of which one faces +z.
        let trimmed = if trimmed.is_ambiguous() { trimmed.everything() } else { trimmed };
        let [us, vs] = [0, 1].map(|k| start_parameters(&surface, k, trimmed.bounds(domain)[k]));
        let inside = trimmed.enclosed(us, vs).map(|at| trimmed.wrapped(at));
        let mut field = Self {
            is_planar_profile: has_planar_profile(&surface),
            surface,
            side,
            starts: Vec::new(),
            tree: PointTree::new([].into_iter()),
            domain,
            period: trimmed.period,
            scale_mm: outlines.iter().flatten().fold(1e-3, |scale: f64, p| scale.max(p.coords.amax())),
        };
        let mut places = Vec::new();
        for at in inside.chain(border) {
            let found = field.surface.evaluate(at[0], at[1]);
            let normal = found.area_vector().try_normalize(1e-300);
            let faces = normal.is_some_and(|normal| side * normal.z > MIN_NORMAL_Z);
            if faces && !is_pole(&found, domain, field.scale_mm) && found.point.coords.sum().is_finite() {
                field.starts.push((at, found.point.z));
                places.push(Point::new(found.point.x, found.point.y, 0.0));
                field.scale_mm = field.scale_mm.max(found.point.coords.amax());
            }
        }
        if matches!(field.surface, ParametricSurface::BSpline(_)) {
            let open = |k: usize| field.period[k].is_infinite();
            field.domain = [0, 1].map(|k| if open(k) { continued(domain[k]) } else { domain[k] });
        }
        field.tree = PointTree::new(places.into_iter());
        (!field.starts.is_empty()).then_some(field)
    }

    /// Returns the surface.
    pub fn surface(&self) -> &ParametricSurface {
        &self.surface
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its computing time.
    pub(crate) fn term_count(&self) -> usize {
        match &self.surface {
            // Five steps of Newton's method, and six sums of four numbers at each.
            ParametricSurface::BSpline(surface) => {
                let [u, v] = surface.knots();
                5 * 6 * (u.degree() + 1) * (v.degree() + 1)
            }
            _ => 20,
        }
    }

    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (`x`, `y`). Returns `None` where the surface does not face
    /// +z, or has no point.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        if !(x + y).is_finite() {
            return None;
        }
        self.tree.nearest(&Point::new(x, y, 0.0), TRIES).find_map(|(start, _)| {
            let (parameters, z) = self.starts[start];
            let (z, normal) = match self.implicit(&Point::new(x, y, z)) {
                Some(_) => self.solve_height(x, y, z)?,
                None => self.solve_parameters([x, y], parameters)?,
            };
            let normal = normal * self.side;
            let faces = normal.z > 1e-9 * normal.norm() && z.is_finite();
            faces.then(|| (z, [-normal.x / normal.z, -normal.y / normal.z]))
        })
    }

    /// Solves f(x, y, z) = 0 for z by Newton's method, for a surface with an implicit form f. Returns z and the normal
    /// on the side of du x dv.
    fn solve_height(&self, x: f64, y: f64, start: f64) -> Option<(f64, Vector)> {
        let mut z = start;
        let mut last_step = f64::INFINITY;
        for _ in 0..60 {
            let (value, normal) = self.implicit(&Point::new(x, y, z))?;
            if normal.z == 0.0 {
                return None;
            }
            // A step of more than the size of the part leaves a place that is nearly vertical.
            let step = (value / normal.z).clamp(-self.scale_mm, self.scale_mm);
            z -= step;
            // The distance from a far centre is rounded more coarsely than the size of the part suggests: the steps end
            // where they no longer become smaller.
            let is_rounding = step.abs() >= last_step && last_step <= MAX_ROUNDING * self.scale_mm;
            last_step = step.abs();
            if is_rounding || step.abs() <= 4.0 * f64::EPSILON * self.scale_mm {
                let (_, normal) = self.implicit(&Point::new(x, y, z))?;
                return Some((z, normal));
            }
        }
        None
    }

    /// Returns the distance of `p` from the surface, positive on the side of du x dv, and its gradient. Returns `None`
    /// for a surface without such a form.
    fn implicit(&self, p: &Point) -> Option<(f64, Vector)> {
        let from_axis = |frame: &Frame| {
            let d = frame.local(p);
            let radius = d.x.hypot(d.y);
            let out = if radius > 0.0 { frame.direction(d.x / radius, d.y / radius, 0.0) } else { frame.axes[0] };
            (radius, d.z, out, frame.axes[2])
        };
        match &self.surface {
            ParametricSurface::Plane { frame } => Some((frame.local(p).z, frame.axes[2])),
            ParametricSurface::Cylinder { frame, radius_mm } => {
                let (radius, _, out, _) = from_axis(frame);
                Some((radius - radius_mm, out))
            }
            ParametricSurface::Cone { frame, radius_mm, half_angle_rad } => {
                let (radius, height, out, axis) = from_axis(frame);
                let (sine, cosine) = half_angle_rad.sin_cos();
                Some(((radius - radius_mm) * cosine - height * sine, out * cosine - axis * sine))
            }
            ParametricSurface::Sphere { frame, radius_mm } => {
                let out = p - frame.origin;
                let distance = out.norm();
                (distance > 0.0).then(|| (distance - radius_mm, out / distance))
            }
            ParametricSurface::Torus { frame, major_radius_mm, minor_radius_mm } => {
                let (radius, height, out, axis) = from_axis(frame);
                let across = radius - major_radius_mm;
                let distance = across.hypot(height);
                let normal = (out * across + axis * height) / distance;
                (distance > 0.0).then_some((distance - minor_radius_mm, normal))
            }
            ParametricSurface::Revolution { profile, origin, axis } if self.is_planar_profile => {
                distance_from_turned(profile, origin, axis, p)
            }
            ParametricSurface::Revolution { .. }
            | ParametricSurface::BSpline(_)
            | ParametricSurface::Extrusion { .. } => None,
        }
    }

    /// Solves S(u, v) = (x, y) for u and v by Newton's method; a step that does not come nearer is halved. Returns z and
    /// du x dv at the place.
    fn solve_parameters(&self, target: [f64; 2], start: [f64; 2]) -> Option<(f64, Vector)> {
        let off = |found: &SurfacePoint| [target[0] - found.point.x, target[1] - found.point.y];
        let length = |[x, y]: [f64; 2]| x.hypot(y);
        let limit = 1e-13 * self.scale_mm;
        let [mut u, mut v] = start;
        let mut found = self.surface.evaluate(u, v);
        let mut rest = off(&found);
        for _ in 0..40 {
            if length(rest) <= limit {
                break;
            }
            let [du, dv] = &found.first;
            let area = du.x * dv.y - du.y * dv.x;
            let step = [(rest[0] * dv.y - rest[1] * dv.x) / area, (rest[1] * du.x - rest[0] * du.y) / area];
            if !(step[0] + step[1]).is_finite() {
                return None;
            }
            let mut share = 1.0;
            loop {
                let at = [u + share * step[0], v + share * step[1]];
                let at = [0, 1].map(|k| self.within(k, at[k]));
                let next = self.surface.evaluate(at[0], at[1]);
                if length(off(&next)) < length(rest) {
                    ([u, v], found, rest) = (at, next, off(&next));
                    break;
                }
                share *= 0.5;
                if share < 1e-3 {
                    // Nothing is nearer: rounding, or the end of the surface.
                    return (length(rest) <= 100.0 * limit).then(|| self.ended(&found, [u, v], rest)).flatten();
                }
            }
        }
        (length(rest) <= limit).then(|| self.ended(&found, [u, v], rest)).flatten()
    }

    /// Returns z at the target, which lies `rest` beside the found place, and du x dv there. A place at which du x dv is
    /// zero, such as a pole, has the normal of its neighbour towards the middle.
    fn ended(&self, found: &SurfacePoint, at: [f64; 2], rest: [f64; 2]) -> Option<(f64, Vector)> {
        let lengths = found.first[0].norm() * found.first[1].norm();
        let mut normal = found.area_vector();
        if normal.norm() <= 1e-9 * lengths || lengths == 0.0 || is_pole(found, self.domain, self.scale_mm) {
            let [u, v] = [0, 1].map(|k| {
                let [low, high] = self.domain[k];
                at[k] + 1e-7 * (0.5 * (low + high) - at[k])
            });
            normal = self.surface.evaluate(u, v).area_vector();
        }
        let normal = normal.try_normalize(0.0)?;
        let slope = if normal.z == 0.0 { return None } else { [-normal.x / normal.z, -normal.y / normal.z] };
        Some((found.point.z + slope[0] * rest[0] + slope[1] * rest[1], normal))
    }

    /// Keeps a parameter of a B-spline within its continued domain; where the surface is closed, by whole turns.
    fn within(&self, k: usize, t: f64) -> f64 {
        if matches!(self.surface, ParametricSurface::BSpline(_)) {
            let [low, high] = self.domain[k];
            wrapped(t, [low, high], self.period[k]).clamp(low, high)
        } else {
            t
        }
    }
}

/// Returns true where one parameter moves the point by next to nothing.
fn is_pole(found: &SurfacePoint, domain: [[f64; 2]; 2], scale_mm: f64) -> bool {
    let reach = [0, 1].map(|k| found.first[k].norm() * (domain[k][1] - domain[k][0]));
    reach[0].min(reach[1]) <= 1e-9 * scale_mm
}

/// Returns the distance of `p` from the surface that a profile makes as it turns about an axis, and the gradient of this
/// distance: positive on the side of du x dv. The profile must lie in a plane with the axis.
fn distance_from_turned(profile: &Curve, origin: &Point, axis: &Vector, p: &Point) -> Option<(f64, Vector)> {
    let out_of_axis = meridian(profile, origin, axis)?;
    let out = p - origin;
    let height = out.dot(axis);
    let across = out - axis * height;
    let radius = across.norm();
    let direction = if radius > 0.0 { across / radius } else { out_of_axis };
    // In the half-plane of the profile, and in the one across the axis.
    let sides = [1.0, -1.0].map(|sign| {
        let place = origin + axis * height + out_of_axis * (sign * radius);
        let (foot, tangent, _) = profile.evaluate(profile.parameter_near(&place));
        // du is along axis x out; on the far side of the axis it points the other way.
        let onwards = if (foot - origin).dot(&out_of_axis) < -1e-9 * foot.coords.amax() { -1.0 } else { 1.0 };
        let normal = axis.cross(&out_of_axis).cross(&tangent).try_normalize(1e-300)? * onwards;
        let turned = axis * normal.dot(axis) + direction * (sign * normal.dot(&out_of_axis));
        // Beyond an end of the profile its tangent goes on.
        Some(((place - foot).norm(), (place - foot).dot(&normal), turned))
    });
    let nearest = sides.into_iter().flatten().min_by(|a, b| a.0.total_cmp(&b.0));
    nearest.map(|(_, distance, normal)| (distance, normal))
}

/// Returns the parameters of the direction `k` at which the search can start: places in each span, so that no feature
/// of the surface lies between two of them.
fn start_parameters(surface: &ParametricSurface, k: usize, [low, high]: [f64; 2]) -> Vec<f64> {
    let breaks = match surface {
        ParametricSurface::BSpline(surface) => surface.knots()[k].breaks(),
        _ => vec![low, high],
    };
    let spans = breaks.len() - 1;
    if spans > MAX_STARTS {
        return (0..=MAX_STARTS).map(|i| low + (high - low) * i as f64 / MAX_STARTS as f64).collect();
    }
    let parts = MIN_STARTS.div_ceil(spans).clamp(1, MIN_STARTS);
    let inside = |pair: &[f64]| {
        let (from, width) = (pair[0], pair[1] - pair[0]);
        (0..parts).map(move |i| from + width * i as f64 / parts as f64)
    };
    breaks.windows(2).flat_map(inside).chain([high]).collect()
}

/// Returns the range with its continuation on both sides.
fn continued([low, high]: [f64; 2]) -> [f64; 2] {
    let beyond = CONTINUATION * (high - low);
    [low - beyond, high + beyond]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sphere with the centre (0, 0, R) has the sag R - sqrt(R^2 - r^2) = r^2 / (R + sqrt(R^2 - r^2)). The distance
    /// from the centre of a large sphere is rounded more coarsely than the size of the part suggests.
    #[test]
    fn large_spheres_have_height_everywhere() {
        for radius_mm in [13.0, 50.0, 200.0, 333.3, 500.0, 1000.0, 1e4, 12_345.678, 1e5] {
            // The poles lie far from the part.
            let frame =
                Frame { origin: Point::new(0.0, 0.0, radius_mm), axes: [Vector::y(), Vector::z(), Vector::x()] };
            let surface = ParametricSurface::Sphere { frame, radius_mm };
            let sag = |x: f64, y: f64| {
                let square = x * x + y * y;
                square / (radius_mm + (radius_mm * radius_mm - square).sqrt())
            };
            let outline = (0..64).map(|k| {
                let (sine, cosine) = (f64::from(k) * std::f64::consts::TAU / 64.0).sin_cos();
                let [x, y] = [12.5 * cosine, 12.5 * sine];
                Point::new(x, y, sag(x, y))
            });
            let field = HeightField::new(surface, &[outline.collect()], -1.0).unwrap();
            for i in 0..400 {
                let (sine, cosine) = (f64::from(i) * 2.4).sin_cos();
                let r = 12.4 * (f64::from(i) / 400.0).sqrt();
                let (x, y) = (r * cosine, r * sine);
                let (z, slope) = field.sag_and_gradient(x, y).unwrap_or_else(|| panic!("R {radius_mm} at {x}, {y}"));
                let limit = 8.0 * f64::EPSILON * (radius_mm + 100.0);
                assert!((z - sag(x, y)).abs() <= limit, "R {radius_mm} at {x}, {y}: {z}");
                let steepness = x / (radius_mm * radius_mm - r * r).sqrt();
                assert!((slope[0] - steepness).abs() <= 1e-12 * (1.0 + steepness.abs()), "R {radius_mm} at {x}, {y}");
            }
        }
    }
}
