//! The wheel: where its centre must be for it to touch a place, how it bends there, and what space it fills.
//!
//! **Axes.** The spindle's direction is a unit vector in the model frame, fixed during the program unless a head tilts it. The point
//! that a program moves is the centre of the ball, or the middle of the circle that the rim's own curve is swept around.
//!
//! ```text
//!  sphere   c = p + R n
//!  torus    c = p + r n + Rt m     a disc with a round rim, outer radius R = Rt + r
//!  cup      c = p + r n + Rc m     a ring of mean radius Rc whose face has the radius r, spindle tilted by a
//!           m = unit of (n less its component along the spindle)
//! ```
//!
//! A disc's spindle lies along y, across tracks that run along x, unless said otherwise: it rolls along the track. A cup's spindle is
//! tilted from z towards -x: the lowest place of its ring is on the side of -x, touches with the outer side of the face, and the rest of
//! the ring stands clear. On a hollow sphere of radius rho the whole ring touches where the normal leans from the spindle by a with
//! sin a = D / (2 (rho - r)); on a dome it would be the inner side of the face, with sin a = D / (2 (rho + r)). A free form has no one
//! rho, so the spindle is tilted further than any slope of the part, and one place of the ring touches at a time: the outer one.

use crate::geometry::{Point, Vector};

use super::wanted::Contact;

/// The least angle between the normal and the spindle of a rim or a ring, sine: nearer, the place of contact runs around the wheel.
pub(super) const LEAST_LEAN: f64 = 0.035;

/// A wheel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Wheel {
    /// A ball.
    Sphere {
        /// Its radius, in millimetres.
        radius_mm: f64,
    },
    /// A disc with a round rim.
    Torus {
        /// Radius of the circle on which the rim's curve has its centres, in millimetres: the outer radius less the rim's.
        ring_mm: f64,
        /// Radius of the rim's own curve, in millimetres.
        tube_mm: f64,
        /// Direction of the spindle, of unit length.
        spindle: Vector,
    },
    /// A ring that cuts with its face.
    Cup {
        /// Radius to the middle of the face, in millimetres.
        ring_mm: f64,
        /// Radius of the face's own curve, in millimetres.
        tube_mm: f64,
        /// Direction of the spindle, from the face into the machine, of unit length.
        spindle: Vector,
    },
}

impl Wheel {
    /// A cup whose spindle is tilted by an angle from z towards -x.
    pub fn tilted_cup(ring_mm: f64, tube_mm: f64, tilt_rad: f64) -> Self {
        Self::Cup { ring_mm, tube_mm, spindle: Vector::new(-tilt_rad.sin(), 0.0, tilt_rad.cos()) }
    }

    /// Returns the point that the program moves when the wheel touches a place; `None` where a rim cannot touch it.
    #[inline]
    pub fn centre(&self, contact: &Contact) -> Option<Point> {
        let Contact { point, normal } = contact;
        match self {
            Self::Sphere { radius_mm } => Some(point + normal * *radius_mm),
            Self::Torus { ring_mm, tube_mm, spindle } | Self::Cup { ring_mm, tube_mm, spindle } => {
                let across = normal - spindle * normal.dot(spindle);
                let lean = across.norm();
                (lean >= LEAST_LEAN).then(|| point + normal * *tube_mm + across * (ring_mm / lean))
            }
        }
    }

    /// Returns the curvatures of the wheel where it touches, 1/mm, and the direction of the first: around the spindle, and across.
    pub(super) fn curvatures(&self, normal: &Vector) -> ([f64; 2], Vector) {
        match self {
            Self::Sphere { radius_mm } => ([1.0 / radius_mm; 2], normal.cross(&Vector::y()).normalize()),
            Self::Torus { ring_mm, tube_mm, spindle } | Self::Cup { ring_mm, tube_mm, spindle } => {
                let around = spindle.cross(normal);
                let lean = around.norm();
                ([lean / (ring_mm + tube_mm * lean), 1.0 / tube_mm], around / lean.max(f64::MIN_POSITIVE))
            }
        }
    }

    /// Returns the distance of a point from the wheel, given from its centre; negative inside.
    pub fn distance_mm(&self, from_centre: &Vector) -> f64 {
        match self {
            Self::Sphere { radius_mm } => from_centre.norm() - radius_mm,
            Self::Torus { ring_mm, tube_mm, spindle } => {
                let axial = from_centre.dot(spindle);
                let radial = (from_centre - spindle * axial).norm();
                // A disc is solid within its rim.
                (radial - ring_mm).max(0.0).hypot(axial) - tube_mm
            }
            Self::Cup { ring_mm, tube_mm, spindle } => {
                let axial = from_centre.dot(spindle);
                let radial = (from_centre - spindle * axial).norm();
                // The wall of the cup stands on its face.
                (radial - ring_mm).hypot(axial.min(0.0)) - tube_mm
            }
        }
    }

    /// The same wheel with a larger radius; of a ball.
    #[must_use]
    pub fn larger_by(self, mm: f64) -> Self {
        match self {
            Self::Sphere { radius_mm } => Self::Sphere { radius_mm: radius_mm + mm },
            other => other,
        }
    }

    /// Returns how far the wheel reaches from its centre, in millimetres.
    pub fn reach_mm(&self) -> f64 {
        match self {
            Self::Sphere { radius_mm } => *radius_mm,
            Self::Torus { ring_mm, tube_mm, .. } | Self::Cup { ring_mm, tube_mm, .. } => ring_mm + tube_mm,
        }
    }

    /// Returns the wheel with z turned round.
    #[must_use]
    pub fn mirrored(mut self) -> Self {
        if let Self::Torus { spindle, .. } | Self::Cup { spindle, .. } = &mut self {
            spindle.z = -spindle.z;
        }
        self
    }

    /// Returns what the wheel is, for the header of a program.
    pub fn description(&self) -> String {
        let of = |v: &Vector| format!("{:.4} {:.4} {:.4}", v.x, v.y, v.z);
        match self {
            Self::Sphere { radius_mm } => format!("sphere, radius {radius_mm} mm, XYZ is its centre"),
            Self::Torus { ring_mm, tube_mm, spindle } => {
                let outer = ring_mm + tube_mm;
                format!("torus, radius {outer} mm, rim {tube_mm} mm, spindle along {}, XYZ is its centre", of(spindle))
            }
            Self::Cup { ring_mm, tube_mm, spindle } => {
                format!(
                    "cup, radius {ring_mm} mm, face {tube_mm} mm, spindle along {}, XYZ is the middle of its ring",
                    of(spindle)
                )
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn contact(normal: Vector) -> Contact {
        Contact { point: Point::new(1.0, 2.0, 3.0), normal: normal.normalize() }
    }

    fn wheels() -> [Wheel; 3] {
        [
            Wheel::Sphere { radius_mm: 12.5 },
            Wheel::Torus { ring_mm: 48.0, tube_mm: 2.0, spindle: Vector::y() },
            Wheel::tilted_cup(30.0, 3.0, 0.6),
        ]
    }

    #[test]
    fn every_wheel_touches_the_place_and_enters_nothing_beside_it() {
        for wheel in wheels() {
            for normal in [Vector::z(), Vector::new(0.2, -0.1, 1.0), Vector::new(-0.3, 0.3, 1.0)] {
                let contact = contact(normal);
                let from = contact.point - wheel.centre(&contact).unwrap();
                assert!(wheel.distance_mm(&from).abs() < 1e-12, "{wheel:?}");
                // Outwards along the normal is into the wheel, inwards is out of it.
                assert!((wheel.distance_mm(&(from + contact.normal * 0.1)) + 0.1).abs() < 1e-12);
                assert!((wheel.distance_mm(&(from - contact.normal * 0.1)) - 0.1).abs() < 1e-12);
                for k in 0..16 {
                    let (s, c) = (f64::from(k) * 0.4).sin_cos();
                    let u = contact.normal.cross(&Vector::x()).normalize();
                    let aside = u * (s * 0.5) + contact.normal.cross(&u) * (c * 0.5);
                    assert!(wheel.distance_mm(&(from + aside)) > 0.0, "{wheel:?}");
                }
            }
        }
    }

    #[test]
    fn curvatures_are_how_the_wheel_leaves_its_tangent_plane() {
        for wheel in wheels() {
            let contact = contact(Vector::new(0.2, -0.1, 1.0));
            let from = contact.point - wheel.centre(&contact).unwrap();
            let ([around, across], direction) = wheel.curvatures(&contact.normal);
            for (curvature, along) in [(around, direction), (across, direction.cross(&contact.normal))] {
                let step = 0.02;
                let gap = wheel.distance_mm(&(from + along * step));
                assert!((gap / (0.5 * step * step) - curvature).abs() < 1e-3 * curvature, "{wheel:?} {curvature}");
            }
        }
    }

    #[test]
    fn a_rim_cannot_touch_a_place_that_faces_its_spindle() {
        let wheel = Wheel::Torus { ring_mm: 48.0, tube_mm: 2.0, spindle: Vector::y() };
        assert_eq!(wheel.centre(&contact(Vector::new(0.0, 1.0, 0.01))), None);
    }

    #[test]
    fn a_cup_on_a_hollow_sphere_touches_with_all_of_its_ring_at_the_angle_of_the_formula() {
        // sin a = D / (2 (rho - r)): the normal leans from the spindle by a, and every place of the ring is as far from the middle.
        let (ring, tube, rho): (f64, f64, f64) = (20.0, 2.0, 100.0);
        let lean = (ring / (rho - tube)).asin();
        let wheel = Wheel::tilted_cup(ring, tube, lean);
        let bottom = Contact { point: Point::origin(), normal: Vector::z() };
        let centre = wheel.centre(&bottom).unwrap();
        let (Wheel::Cup { spindle, .. }, middle) = (wheel, Point::new(0.0, 0.0, rho)) else { unreachable!() };
        let u = spindle.cross(&Vector::y()).normalize();
        for k in 0..12 {
            let (s, c) = (f64::from(k) * 0.5).sin_cos();
            let on_ring = centre + u * (ring * c) + spindle.cross(&u) * (ring * s);
            assert!(((on_ring - middle).norm() + tube - rho).abs() < 1e-9);
        }
    }
}
