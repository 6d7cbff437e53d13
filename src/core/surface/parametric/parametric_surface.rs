//! Surfaces of CAD systems, given by two parameters (u, v).

use super::bspline::{BSplineSurface, SurfacePoint};
use super::curve::Curve;
use super::frame::Frame;
use crate::geometry::{Point, Pose, Vector};

/// Surface given by two parameters.
///
/// With the axes (x, y, z) of `frame` and e(u) = x cos u + y sin u, ISO 10303-42. The side of du x dv is the side of the
/// normal of the surface; a face can lie on the other side.
#[derive(Clone, Debug, PartialEq)]
pub enum ParametricSurface {
    /// Tensor-product B-spline, rational or not.
    BSpline(BSplineSurface),
    /// origin + u x + v y.
    Plane {
        /// Origin, and axes in the plane.
        frame: Frame,
    },
    /// origin + r e(u) + v z.
    Cylinder {
        /// Origin, and axis z.
        frame: Frame,
        /// Radius r in millimetres.
        radius_mm: f64,
    },
    /// origin + (r + v tan a) e(u) + v z.
    Cone {
        /// Origin, and axis z.
        frame: Frame,
        /// Radius r at v = 0 in millimetres.
        radius_mm: f64,
        /// Half angle a of the cone.
        half_angle_rad: f64,
    },
    /// origin + r (cos v e(u) + sin v z).
    Sphere {
        /// Centre and axes.
        frame: Frame,
        /// Radius r in millimetres.
        radius_mm: f64,
    },
    /// origin + (R + r cos v) e(u) + r sin v z.
    Torus {
        /// Centre, and axis z.
        frame: Frame,
        /// Radius R of the circle of the tube's centres in millimetres.
        major_radius_mm: f64,
        /// Radius r of the tube in millimetres.
        minor_radius_mm: f64,
    },
    /// The curve at v, rotated by u about the axis.
    Revolution {
        /// Curve that is rotated.
        profile: Curve,
        /// Point on the axis.
        origin: Point,
        /// Direction of the axis, of length 1.
        axis: Vector,
    },
    /// The curve at u, shifted by v times the direction.
    Extrusion {
        /// Curve that is shifted.
        profile: Curve,
        /// Step for v = 1, in millimetres.
        direction: Vector,
    },
}

impl ParametricSurface {
    /// Returns the point at (`u`, `v`) with its first and second derivatives.
    pub fn evaluate(&self, u: f64, v: f64) -> SurfacePoint {
        match self {
            Self::BSpline(surface) => surface.evaluate(u, v),
            Self::Plane { frame: Frame { origin, axes: [x, y, _] } } => {
                SurfacePoint { point: origin + x * u + y * v, first: [*x, *y], second: [Vector::zeros(); 3] }
            }
            Self::Cylinder { frame, radius_mm } => around(frame, u, [*radius_mm, v], [0.0, 1.0], [0.0, 0.0]),
            Self::Cone { frame, radius_mm, half_angle_rad } => {
                let slope = half_angle_rad.tan();
                around(frame, u, [radius_mm + v * slope, v], [slope, 1.0], [0.0, 0.0])
            }
            Self::Sphere { frame, radius_mm: r } => {
                let (sine, cosine) = v.sin_cos();
                around(frame, u, [r * cosine, r * sine], [-r * sine, r * cosine], [-r * cosine, -r * sine])
            }
            Self::Torus { frame, major_radius_mm, minor_radius_mm: r } => {
                let (sine, cosine) = v.sin_cos();
                let place = [major_radius_mm + r * cosine, r * sine];
                around(frame, u, place, [-r * sine, r * cosine], [-r * cosine, -r * sine])
            }
            Self::Revolution { profile, origin, axis } => rotated(profile, origin, axis, u, v),
            Self::Extrusion { profile, direction } => {
                let (point, first, second) = profile.evaluate(u);
                let zero = Vector::zeros();
                SurfacePoint { point: point + direction * v, first: [first, *direction], second: [second, zero, zero] }
            }
        }
    }

    /// Returns the word that ISO 10303-42 has for the kind of the surface.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::BSpline(_) => "B-spline surface",
            Self::Plane { .. } => "plane",
            Self::Cylinder { .. } => "cylinder",
            Self::Cone { .. } => "cone",
            Self::Sphere { .. } => "sphere",
            Self::Torus { .. } => "torus",
            Self::Revolution { .. } => "surface of revolution",
            Self::Extrusion { .. } => "surface of linear extrusion",
        }
    }

    /// Returns the surface moved by `motion`.
    pub fn moved(&self, motion: &Pose) -> Self {
        match self {
            Self::BSpline(surface) => Self::BSpline(surface.moved(motion)),
            Self::Plane { frame } => Self::Plane { frame: frame.moved(motion) },
            Self::Cylinder { frame, radius_mm } => Self::Cylinder { frame: frame.moved(motion), radius_mm: *radius_mm },
            Self::Cone { frame, radius_mm, half_angle_rad } => {
                Self::Cone { frame: frame.moved(motion), radius_mm: *radius_mm, half_angle_rad: *half_angle_rad }
            }
            Self::Sphere { frame, radius_mm } => Self::Sphere { frame: frame.moved(motion), radius_mm: *radius_mm },
            Self::Torus { frame, major_radius_mm, minor_radius_mm } => Self::Torus {
                frame: frame.moved(motion),
                major_radius_mm: *major_radius_mm,
                minor_radius_mm: *minor_radius_mm,
            },
            Self::Revolution { profile, origin, axis } => Self::Revolution {
                profile: profile.moved(motion),
                origin: motion.transform_point(origin),
                axis: motion.transform_direction(axis),
            },
            Self::Extrusion { profile, direction } => {
                Self::Extrusion { profile: profile.moved(motion), direction: motion.transform_direction(direction) }
            }
        }
    }

    /// Returns ranges of u and v that contain all places of the surface near the points of `within`. A direction with
    /// ends of its own has these.
    pub(super) fn domain_near(&self, within: &[Point]) -> [[f64; 2]; 2] {
        const TURN: [f64; 2] = [0.0, std::f64::consts::TAU];
        let quarter = std::f64::consts::FRAC_PI_2;
        let along = |frame: &Frame, k: usize| range(within.iter().map(|p| frame.local(p)[k]));
        match self {
            Self::BSpline(surface) => surface.knots().map(|knots| knots.domain()),
            Self::Plane { frame } => [along(frame, 0), along(frame, 1)],
            Self::Cylinder { frame, .. } | Self::Cone { frame, .. } => [TURN, along(frame, 2)],
            Self::Sphere { .. } => [TURN, [-quarter, quarter]],
            Self::Torus { .. } => [TURN, TURN],
            Self::Revolution { profile, origin, axis } => {
                let domain = profile.domain().unwrap_or_else(|| {
                    // The profile passes through every point as it turns: the part that comes as near to the axis.
                    let turned = within.iter().map(|p| turned_to(profile, origin, axis, p));
                    range(turned.map(|p| profile.parameter_near(&p)))
                });
                [TURN, domain]
            }
            Self::Extrusion { profile, direction } => {
                let step = direction.norm_squared();
                let flat = |p: &Point| profile.parameter_near(p);
                let domain = profile.domain().unwrap_or_else(|| range(within.iter().map(flat)));
                let foot = profile.evaluate(0.5 * (domain[0] + domain[1])).0;
                let reach = within.iter().map(|p| (p - foot).dot(direction) / step);
                // The profile itself can lean along the direction.
                let ends = domain.map(|u| (profile.evaluate(u).0 - foot).dot(direction) / step);
                let [low, high] = range(reach);
                [domain, [low - ends[0].max(ends[1]).max(0.0), high - ends[0].min(ends[1]).min(0.0)]]
            }
        }
    }
}

impl ParametricSurface {
    /// Creates the surface that a profile makes as it turns about an axis. A whole ellipse around a point of the axis is
    /// cut where it crosses the axis, because its other half would make the same surface again.
    ///
    /// Lengths are in millimetres; `axis` has the length 1.
    pub fn revolution(profile: Curve, origin: Point, axis: Vector) -> Self {
        let profile = match first_half(&profile, &origin, &axis) {
            Some(ends) => profile.part(ends),
            None => profile,
        };
        Self::Revolution { profile, origin, axis }
    }

    /// Returns the lengths after which u and v repeat; infinite for a parameter that does not.
    pub fn period(&self) -> [f64; 2] {
        const TURN: f64 = std::f64::consts::TAU;
        match self {
            Self::Plane { .. } => [f64::INFINITY; 2],
            Self::Extrusion { profile, .. } => [profile.period(), f64::INFINITY],
            Self::Revolution { profile, .. } => [TURN, profile.period()],
            Self::Torus { .. } => [TURN; 2],
            Self::BSpline(surface) => {
                let [u, v] = surface.knots().map(|knots| knots.domain());
                let place = |u: f64, v: f64| surface.evaluate(u, v).point;
                let size = (place(u[0], v[0]) - place(0.5 * (u[0] + u[1]), 0.5 * (v[0] + v[1]))).norm();
                let closes = |a: [Point; 3], b: [Point; 3]| (0..3).all(|i| (a[i] - b[i]).norm() <= 1e-7 * size);
                let along = |[low, high]: [f64; 2]| [0.2, 0.5, 0.9].map(|t| low + t * (high - low));
                let in_u = closes(along(v).map(|t| place(u[0], t)), along(v).map(|t| place(u[1], t)));
                let in_v = closes(along(u).map(|t| place(t, v[0])), along(u).map(|t| place(t, v[1])));
                [(in_u, u), (in_v, v)].map(|(closes, [low, high])| if closes { high - low } else { f64::INFINITY })
            }
            Self::Cylinder { .. } | Self::Cone { .. } | Self::Sphere { .. } => [TURN, f64::INFINITY],
        }
    }

    /// Returns v of the place where the surface meets its axis, if that is an end that no outline shows: the apex of a
    /// cone, or of a turned line, parabola or hyperbola.
    pub(super) fn apex(&self) -> Option<f64> {
        match self {
            Self::Cone { radius_mm, half_angle_rad, .. } => Some(-radius_mm / half_angle_rad.tan()),
            Self::Revolution { profile, origin, axis } if profile.domain().is_none() => {
                let out = meridian(profile, origin, axis)?;
                match profile {
                    Curve::Line { origin: start, direction } => {
                        let slope = direction.dot(&out);
                        (slope.abs() > 1e-9 * direction.norm()).then(|| (origin - start).dot(&out) / slope)
                    }
                    _ => {
                        let vertex = profile.evaluate(0.0).0 - origin;
                        let off = vertex - axis * vertex.dot(axis);
                        (off.norm() <= 1e-9 * (1.0 + vertex.norm())).then_some(0.0)
                    }
                }
            }
            _ => None,
        }
    }
}

impl SurfacePoint {
    /// Returns du x dv, which is as long as the area that a unit of (u, v) has.
    pub fn area_vector(&self) -> Vector {
        self.first[0].cross(&self.first[1])
    }

    /// Returns the two principal curvatures in 1/mm, in ascending order; positive where the surface bends towards the
    /// side of du x dv. Returns `None` where the surface has no normal.
    pub fn principal_curvatures(&self) -> Option<[f64; 2]> {
        let normal = self.area_vector().try_normalize(1e-300)?;
        let [du, dv] = &self.first;
        let (e, f, g) = (du.norm_squared(), du.dot(dv), dv.norm_squared());
        let [l, m, n] = self.second.map(|second| second.dot(&normal));
        let area = e * g - f * f;
        let mean = 0.5 * (e * n - 2.0 * f * m + g * l) / area;
        let gauss = (l * n - m * m) / area;
        let half_difference = (mean * mean - gauss).max(0.0).sqrt();
        Some([mean - half_difference, mean + half_difference])
    }
}

/// Point of a surface of revolution about the z axis of `frame`: distance from the axis and height, with their first and
/// second derivatives by v.
fn around(frame: &Frame, u: f64, place: [f64; 2], first: [f64; 2], second: [f64; 2]) -> SurfacePoint {
    let (sine, cosine) = u.sin_cos();
    let out = frame.direction(cosine, sine, 0.0);
    let onwards = frame.direction(-sine, cosine, 0.0);
    let z = frame.axes[2];
    SurfacePoint {
        point: frame.origin + out * place[0] + z * place[1],
        first: [onwards * place[0], out * first[0] + z * first[1]],
        second: [-out * place[0], onwards * first[0], out * second[0] + z * second[1]],
    }
}

/// Point of the surface that a profile makes as it turns about an axis.
fn rotated(profile: &Curve, origin: &Point, axis: &Vector, u: f64, v: f64) -> SurfacePoint {
    let (sine, cosine) = u.sin_cos();
    // Rodrigues' formula, and its derivatives by the angle.
    let parts = |d: &Vector| {
        let along = axis * d.dot(axis);
        (along, d - along, axis.cross(d))
    };
    let turn = |d: &Vector| {
        let (along, across, onwards) = parts(d);
        along + across * cosine + onwards * sine
    };
    let by_angle = |d: &Vector| {
        let (_, across, onwards) = parts(d);
        onwards * cosine - across * sine
    };
    let (point, first, second) = profile.evaluate(v);
    let out = point - origin;
    let (_, across, onwards) = parts(&out);
    SurfacePoint {
        point: origin + turn(&out),
        first: [by_angle(&out), turn(&first)],
        second: [-(across * cosine + onwards * sine), by_angle(&first), turn(&second)],
    }
}

/// Returns `p` turned about the axis into the half-plane of the profile.
pub(super) fn turned_to(profile: &Curve, origin: &Point, axis: &Vector, p: &Point) -> Point {
    let out = p - origin;
    let height = out.dot(axis);
    let radius = (out - axis * height).norm();
    let direction = meridian(profile, origin, axis).unwrap_or_else(Vector::zeros);
    origin + axis * height + direction * radius
}

/// Returns the direction from the axis, of length 1, in which the profile is farthest from the axis. Returns `None` if
/// the whole profile lies on the axis.
pub(super) fn meridian(profile: &Curve, origin: &Point, axis: &Vector) -> Option<Vector> {
    let [low, high] = profile.domain().unwrap_or([-1.0, 1.0]);
    let out = |i: i32| {
        let d = profile.evaluate(low + (high - low) * f64::from(i) / 16.0).0 - origin;
        d - axis * d.dot(axis)
    };
    let farthest = (0..=16).map(out).max_by(|a, b| a.norm().total_cmp(&b.norm()))?;
    farthest.try_normalize(1e-12)
}

/// Returns the parameters between which an ellipse lies on one side of an axis through its centre: from 0 on, or around
/// 0. Returns `None` for another curve, and for an ellipse that is not in a plane with the axis.
fn first_half(profile: &Curve, origin: &Point, axis: &Vector) -> Option<[f64; 2]> {
    let Curve::Ellipse { frame, semi_axes_mm } = profile else { return None };
    let across = |d: Vector| d - axis * d.dot(axis);
    let is_centred = across(frame.origin - origin).norm() <= 1e-9 * semi_axes_mm[0].max(semi_axes_mm[1]);
    let out = [0, 1].into_iter().find_map(|k| across(frame.axes[k]).try_normalize(1e-6))?;
    let is_planar = frame.axes[2].dot(&out).abs().max(frame.axes[2].dot(axis).abs()) <= 1e-9;
    // The distance from the axis is c cos(t - phase).
    let [x, y] = [0, 1].map(|k| semi_axes_mm[k] * frame.axes[k].dot(&out));
    let phase = y.atan2(x);
    let quarter = std::f64::consts::FRAC_PI_2;
    (is_centred && is_planar).then_some([phase - quarter, phase + quarter])
}

/// Tells whether the profile of a surface of revolution lies in a plane with the axis.
pub(super) fn has_planar_profile(surface: &ParametricSurface) -> bool {
    let ParametricSurface::Revolution { profile, origin, axis } = surface else { return false };
    let Some(out) = meridian(profile, origin, axis) else { return false };
    let across = axis.cross(&out);
    let [low, high] = profile.domain().unwrap_or([-1.0, 1.0]);
    let place = |i: i32| profile.evaluate(low + (high - low) * f64::from(i) / 32.0).0 - origin;
    let size = (0..=32).map(|i| place(i).norm()).fold(0.0, f64::max);
    (0..=32).all(|i| place(i).dot(&across).abs() <= 1e-12 * size)
}

/// Returns the border of a part of a surface as outlines. Where the surface closes around itself, there is no border; a
/// side that is one place, such as a pole, is an outline of one place.
pub fn natural_outlines(surface: &ParametricSurface, part: [[f64; 2]; 2]) -> Vec<Vec<Point>> {
    const PLACES: usize = 200;
    let [[u0, u1], [v0, v1]] = part;
    let side = |from: [f64; 2], to: [f64; 2]| -> Vec<Point> {
        let at = |i: usize, k: usize| from[k] + i as f64 / PLACES as f64 * (to[k] - from[k]);
        (0..PLACES).map(|i| surface.evaluate(at(i, 0), at(i, 1)).point).collect()
    };
    let corners = [[u0, v0], [u1, v0], [u1, v1], [u0, v1]];
    let sides: [Vec<Point>; 4] = std::array::from_fn(|i| side(corners[i], corners[(i + 1) % 4]));
    let size = sides.iter().flatten().fold(0.0, |size: f64, p| size.max((p - sides[0][0]).norm()));
    let is_pole = |side: &[Point]| side.iter().all(|p| (p - side[0]).norm() <= 1e-9 * size);
    // Opposite sides pass the same places in opposite senses.
    let closes = |a: &[Point], b: &[Point]| (1..PLACES).all(|i| (a[i] - b[PLACES - i]).norm() <= 1e-7 * size);
    let [bottom, right, top, left] = sides;
    let ring = |side: Vec<Point>| if is_pole(&side) { side[..1].to_vec() } else { side };
    match (closes(&left, &right), closes(&bottom, &top)) {
        (true, true) => Vec::new(),
        (true, false) => vec![ring(bottom), ring(top)],
        (false, true) => vec![ring(right), ring(left)],
        (false, false) => vec![[bottom, right, top, left].concat()],
    }
}

/// Returns the smallest and the largest of the numbers.
pub(super) fn range(numbers: impl Iterator<Item = f64>) -> [f64; 2] {
    numbers.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], t| [low.min(t), high.max(t)])
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    fn frame() -> Frame {
        Frame::new(Point::new(1.0, -2.0, 0.5), Vector::new(0.1, 0.2, 1.0), Vector::new(1.0, 0.3, 0.0)).unwrap()
    }

    /// One of each kind that is not a B-spline.
    pub fn kinds() -> Vec<ParametricSurface> {
        let frame = frame();
        let arc = Curve::Ellipse {
            frame: Frame::new(frame.origin + frame.axes[0] * 6.0, frame.axes[1], frame.axes[0]).unwrap(),
            semi_axes_mm: [2.0, 3.0],
        };
        vec![
            ParametricSurface::Plane { frame },
            ParametricSurface::Cylinder { frame, radius_mm: 5.0 },
            ParametricSurface::Cone { frame, radius_mm: 5.0, half_angle_rad: 0.4 },
            ParametricSurface::Sphere { frame, radius_mm: 5.0 },
            ParametricSurface::Torus { frame, major_radius_mm: 7.0, minor_radius_mm: 2.0 },
            ParametricSurface::Revolution { profile: arc.clone(), origin: frame.origin, axis: frame.axes[2] },
            ParametricSurface::Extrusion { profile: arc, direction: Vector::new(0.2, 3.0, 0.1) },
        ]
    }

    #[test]
    fn derivatives_match_differences() {
        let h = 1e-5;
        for surface in kinds() {
            let at = |u: f64, v: f64| surface.evaluate(u, v);
            let SurfacePoint { first, second, .. } = at(0.7, 0.3);
            let difference = |a: Vector, b: Vector| (a - b) / (2.0 * h);
            let by_u = [at(0.7 + h, 0.3), at(0.7 - h, 0.3)];
            let by_v = [at(0.7, 0.3 + h), at(0.7, 0.3 - h)];
            let kind = surface.kind();
            assert!((difference(by_u[0].point.coords, by_u[1].point.coords) - first[0]).norm() < 1e-8, "{kind}");
            assert!((difference(by_v[0].point.coords, by_v[1].point.coords) - first[1]).norm() < 1e-8, "{kind}");
            assert!((difference(by_u[0].first[0], by_u[1].first[0]) - second[0]).norm() < 1e-8, "{kind}");
            assert!((difference(by_v[0].first[0], by_v[1].first[0]) - second[1]).norm() < 1e-8, "{kind}");
            assert!((difference(by_v[0].first[1], by_v[1].first[1]) - second[2]).norm() < 1e-8, "{kind}");
        }
    }

    #[test]
    fn curvatures_by_hand() {
        let close = |found: Option<[f64; 2]>, expected: [f64; 2]| {
            let found = found.unwrap();
            // Where both are equal, rounding of their difference shows as its root.
            (found[0] - expected[0]).abs() < 1e-8 && (found[1] - expected[1]).abs() < 1e-8
        };
        let [plane, cylinder, _, sphere, torus, ..] = &kinds()[..] else { unreachable!() };
        assert!(close(plane.evaluate(1.0, 2.0).principal_curvatures(), [0.0, 0.0]));
        assert!(close(cylinder.evaluate(1.0, 2.0).principal_curvatures(), [-0.2, 0.0]));
        assert!(close(sphere.evaluate(1.0, 0.4).principal_curvatures(), [-0.2, -0.2]));
        // On the outer equator: the tube bends with radius 2, the ring with 9.
        assert!(close(torus.evaluate(1.0, 0.0).principal_curvatures(), [-0.5, -1.0 / 9.0]));
        let pole = sphere.evaluate(0.0, std::f64::consts::FRAC_PI_2);
        assert!(pole.area_vector().norm() < 1e-14);
    }

    /// The half of an ellipse on one side of the axis makes the whole ellipsoid; a tube is made by the whole circle.
    #[test]
    fn ellipse_around_axis_is_halved() {
        let (origin, axis) = (Point::new(1.0, 2.0, 3.0), Vector::z());
        let ellipse = |x: Vector, offset: f64| Curve::Ellipse {
            frame: Frame::new(origin + Vector::x() * offset, Vector::y(), x).unwrap(),
            semi_axes_mm: [5.0, 3.0],
        };
        let ends = |profile: Curve| {
            let ParametricSurface::Revolution { profile, .. } = ParametricSurface::revolution(profile, origin, axis)
            else {
                return None;
            };
            profile.domain()
        };
        let (quarter, turn) = (std::f64::consts::FRAC_PI_2, std::f64::consts::TAU);
        let close = |found: Option<[f64; 2]>, expected: [f64; 2]| {
            let found = found.unwrap();
            (found[0] - expected[0]).abs() < 1e-12 && (found[1] - expected[1]).abs() < 1e-12
        };
        assert!(close(ends(ellipse(Vector::x(), 0.0)), [-quarter, quarter]));
        assert!(close(ends(ellipse(Vector::z(), 0.0)), [0.0, 2.0 * quarter]));
        assert!(close(ends(ellipse(Vector::x(), 9.0)), [0.0, turn]));
    }

    #[test]
    fn apex_is_where_surface_meets_axis() {
        let z = ParametricSurface::Cone { frame: frame(), radius_mm: 5.0, half_angle_rad: 0.4 };
        let apex = z.evaluate(0.7, z.apex().unwrap()).point;
        assert!((apex - frame().origin).cross(&frame().axes[2]).norm() < 1e-12);
        let line = Curve::Line { origin: Point::new(4.0, 0.0, 1.0), direction: Vector::new(-2.0, 0.0, 0.5) };
        let turned = ParametricSurface::revolution(line, Point::origin(), Vector::z());
        assert!((turned.evaluate(0.3, turned.apex().unwrap()).point - Point::new(0.0, 0.0, 2.0)).norm() < 1e-14);
        let vertex = Frame::new(Point::new(0.0, 0.0, 1.0), Vector::y(), Vector::z()).unwrap();
        let parabola = Curve::Parabola { frame: vertex, focal_mm: 30.0 };
        assert_eq!(ParametricSurface::revolution(parabola, Point::origin(), Vector::z()).apex(), Some(0.0));
        assert_eq!(kinds()[1].apex(), None);
    }

    #[test]
    fn moved_surface_has_moved_points() {
        let motion = frame().pose();
        for surface in kinds() {
            let (p, q) = (surface.evaluate(0.4, 0.9), surface.moved(&motion).evaluate(0.4, 0.9));
            assert!((q.point - motion.transform_point(&p.point)).norm() < 1e-13, "{}", surface.kind());
        }
    }
}
