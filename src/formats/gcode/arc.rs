//! Arcs and helices of a program that was read: their points, and the number of chords that approximate them. The
//! planned path provides the arcs that are written into new programs.

use std::f64::consts::TAU;

use super::read::Refusal;
pub(super) use regrind_core::compensation::path::Plane;
use regrind_core::geometry::Point;

/// An arc or a helix, in millimetres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Arc {
    plane: Plane,
    from: Point,
    /// Centre in the plane.
    centre: [f64; 2],
    radius: f64,
    /// Radius at the end. Rounding makes it differ from the radius at the start; the arc spirals from one to the other.
    end_radius: f64,
    begins: f64,
    /// Angle of the sweep, in radians; positive is counter-clockwise.
    pub(super) sweep: f64,
    /// Way along the axis perpendicular to the plane.
    pub(super) rise: f64,
}

/// Centre of an arc, as the program gives it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Centre {
    /// Position of the centre along the two axes of the plane.
    At([f64; 2]),
    /// Radius; negative for the longer arc.
    Radius(f64),
}

/// Maximum difference between the radii at the end and at the start: in millimetres, as LinuxCNC documents it, and as a
/// share of the radius for very small radii.
const RADIUS_TOLERANCE: [f64; 2] = [0.0127, 0.1];

impl Arc {
    /// Computes the arc from `from` to `to` in `plane`, in millimetres. The arc is a helix if the two points differ
    /// along the axis perpendicular to the plane. If the two points are equal in the plane, the arc is a full turn.
    /// `centre` is the centre in the plane, or the radius.
    ///
    /// # Errors
    /// A radius that differs between start and end by more than [`RADIUS_TOLERANCE`]; a radius of 0; a given radius
    /// with which no arc joins the points.
    pub(super) fn new(plane: Plane, from: Point, to: Point, clockwise: bool, centre: Centre) -> Result<Self, Refusal> {
        let [a, b, c] = plane.0;
        let (p, q) = ([from[a], from[b]], [to[a], to[b]]);
        let centre = match centre {
            Centre::At(at) => at,
            Centre::Radius(radius) => by_radius(p, q, radius, clockwise)?,
        };
        let arm = |at: [f64; 2]| [at[0] - centre[0], at[1] - centre[1]];
        let ([u, v], [s, t]) = (arm(p), arm(q));
        let (radius, end) = (u.hypot(v), s.hypot(t));
        let off = (radius - end).abs();
        if radius == 0.0 || off > RADIUS_TOLERANCE[0].min(RADIUS_TOLERANCE[1] * radius) {
            let found = format!("the radius of the arc is {radius:.4} mm at its beginning and {end:.4} mm at its end");
            return Err((found, "correct its centre or its end"));
        }
        let begins = v.atan2(u);
        let turn = t.atan2(s) - begins;
        // If the end equals the start, the arc is a full turn.
        let sweep = if clockwise {
            let down = turn.rem_euclid(TAU) - TAU;
            if down > -1e-9 { down - TAU } else { down }
        } else {
            let up = turn.rem_euclid(TAU);
            if up < 1e-9 { up + TAU } else { up }
        };
        Ok(Self { plane, from, centre, radius, end_radius: end, begins, sweep, rise: to[c] - from[c] })
    }

    /// Returns the point at `share` of the arc, from 0 at its start to 1 at its end.
    pub(super) fn at(&self, share: f64) -> Point {
        let [a, b, c] = self.plane.0;
        let (sine, cosine) = (self.begins + self.sweep * share).sin_cos();
        let radius = self.radius + (self.end_radius - self.radius) * share;
        let mut at = self.from;
        at[a] = self.centre[0] + radius * cosine;
        at[b] = self.centre[1] + radius * sine;
        at[c] = self.from[c] + self.rise * share;
        at
    }

    /// Returns the centre relative to the start, in millimetres. Each of the two pairs is an axis of the plane (0 for
    /// x, 1 for y, 2 for z) and the distance along it.
    pub(super) fn centre_from_start(&self) -> [(usize, f64); 2] {
        let [a, b, _] = self.plane.0;
        [(a, self.centre[0] - self.from[a]), (b, self.centre[1] - self.from[b])]
    }

    /// Returns the length of the arc or helix, in millimetres.
    pub(super) fn length(&self) -> f64 {
        (self.radius * self.sweep).hypot(self.rise)
    }

    /// Returns the number of equal chords that stay within `tolerance` millimetres of the arc: a whole number, at least
    /// 1.
    pub(super) fn chords(&self, tolerance: f64) -> f64 {
        let angle = 2.0 * (1.0 - (tolerance / self.radius).min(1.0)).acos();
        (self.sweep.abs() / angle.max(1e-9)).ceil().max(1.0)
    }
}

/// Returns the centre, in the coordinates of the plane, of the arc from `p` to `q` with the given `radius`, all in
/// millimetres. A positive radius gives the shorter arc, a negative radius the longer arc.
///
/// # Errors
/// A radius smaller than half the distance of the points, beyond the rounding error; two equal points.
fn by_radius(p: [f64; 2], q: [f64; 2], radius: f64, clockwise: bool) -> Result<[f64; 2], Refusal> {
    let (dx, dy) = (q[0] - p[0], q[1] - p[1]);
    let chord = dx.hypot(dy);
    let above2 = radius * radius - 0.25 * chord * chord;
    // A radius that rounding made slightly too small gives half a turn.
    if chord == 0.0 || above2 < -1e-3 * radius * radius {
        let found = format!("an arc of radius {radius} mm does not join two points {chord:.4} mm apart");
        return Err((found, "give its centre by I, J, K"));
    }
    let side = if clockwise == (radius < 0.0) { 1.0 } else { -1.0 };
    let above = above2.max(0.0).sqrt() * side / chord;
    Ok([p[0] + 0.5 * dx - above * dy, p[1] + 0.5 * dy + above * dx])
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    #[test]
    fn arc_from_centre_or_radius() {
        let (from, to) = (Point::new(10.0, 0.0, 1.0), Point::new(0.0, 10.0, 3.0));
        let arc = Arc::new(Plane::XY, from, to, false, Centre::At([0.0, 0.0])).unwrap();
        assert!((arc.sweep - PI / 2.0).abs() < 1e-12);
        let middle = arc.at(0.5);
        assert!((middle - Point::new(50f64.sqrt(), 50f64.sqrt(), 2.0)).norm() < 1e-12);
        let same = Arc::new(Plane::XY, from, to, false, Centre::Radius(10.0)).unwrap();
        assert!((same.at(0.3) - arc.at(0.3)).norm() < 1e-9);
        let long = Arc::new(Plane::XY, from, to, true, Centre::At([0.0, 0.0])).unwrap();
        assert!((long.sweep + 1.5 * PI).abs() < 1e-12);
        let far = Arc::new(Plane::XY, from, to, true, Centre::Radius(-10.0)).unwrap();
        assert!((far.at(0.3) - long.at(0.3)).norm() < 1e-9);
        let circle = Arc::new(Plane::XY, from, from, true, Centre::At([0.0, 0.0])).unwrap();
        assert!((circle.sweep + TAU).abs() < 1e-12 && (circle.length() - 20.0 * PI).abs() < 1e-9);
        assert!(Arc::new(Plane::XY, from, to, true, Centre::At([1.0, 0.0])).is_err());
        assert!(Arc::new(Plane::XY, from, to, true, Centre::Radius(3.0)).is_err());
        assert!(Arc::new(Plane::XY, from, from, true, Centre::Radius(3.0)).is_err());
    }

    #[test]
    fn arc_chords_within_tolerance() {
        let (from, to) = (Point::new(0.0, 5.0, 10.0), Point::new(10.0, 5.0, 0.0));
        let arc = Arc::new(Plane::ZX, from, to, true, Centre::At([0.0, 0.0]));
        let arc = arc.or_else(|_| Arc::new(Plane::ZX, from, to, false, Centre::At([0.0, 0.0]))).unwrap();
        let n = arc.chords(1e-4);
        let sag = (arc.at(0.5 / n) - nalgebra::center(&arc.at(0.0), &arc.at(1.0 / n))).norm();
        assert!(sag <= 1e-4 && sag > 0.5e-4, "{sag}");
        assert_eq!(arc.at(0.37).y, 5.0);
    }
}
