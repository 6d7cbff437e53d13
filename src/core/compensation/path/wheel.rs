//! Geometry of the wheel: position of its centre for a given contact, its curvatures at the contact, and the volume of
//! its body.
//!
//! **Axes.** The spindle's direction is a unit vector in the model frame, fixed during the program unless a head tilts
//! it. The programmed point is the centre of the ball, or the centre of the circle along which the rim's profile is
//! swept.
//!
//! ```text
//!  sphere   c = p + R n
//!  torus    c = p + r n + Rt m     a disc with a round rim, outer radius R = Rt + r
//!  cup      c = p + r n + Rc m     a ring of mean radius Rc whose face has the radius r, spindle tilted by a
//!           m = unit vector along n minus the component of n along the spindle
//! ```
//!
//! By default a disc's spindle is along y, across tracks that run along x: the disc rolls along the track. A cup's
//! spindle is tilted from z towards -x. The lowest point of its ring is then on the -x side and touches with the outer
//! side of the face; the rest of the ring is clear of the part. On a hollow sphere of radius rho the whole ring
//! touches if the angle a between the normal and the spindle satisfies sin a = D / (2 (rho - r)), with D = 2 Rc the
//! mean diameter of the ring. On a dome the inner side of the face touches, with sin a = D / (2 (rho + r)). A free
//! form has no single rho. The spindle is therefore tilted further than any slope of the part, and only one point of
//! the ring touches at a time, on the outer side of the face.

use crate::geometry::{Point, Vector};

use super::target_surface::Contact;

/// Sine of the minimum angle between the normal and the spindle of a rim or a ring. At smaller angles the contact
/// point runs around the wheel.
pub(super) const MIN_SPINDLE_ANGLE_SINE: f64 = 0.035;

/// Shape and size of a wheel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Wheel {
    /// A ball.
    Sphere {
        /// Radius of the ball, in millimetres.
        radius_mm: f64,
    },
    /// A disc with a round rim.
    Torus {
        /// Radius of the circle along which the rim's profile is swept, in millimetres: the outer radius minus the rim
        /// radius.
        ring_mm: f64,
        /// Radius of the rim's profile, in millimetres.
        tube_mm: f64,
        /// Direction of the spindle, of unit length.
        spindle: Vector,
    },
    /// A ring that cuts with its face.
    Cup {
        /// Mean radius of the ring: from the spindle to the middle of the face, in millimetres.
        ring_mm: f64,
        /// Radius of the face's profile, in millimetres.
        tube_mm: f64,
        /// Direction of the spindle, from the face into the machine, of unit length.
        spindle: Vector,
    },
}

impl Wheel {
    /// Returns a cup wheel whose spindle is tilted from z towards -x by `tilt_rad`. A cup wheel is a ring that grinds
    /// with its rounded face. The face lies around the spindle, in a plane perpendicular to it.
    ///
    /// `ring_mm` is the distance from the spindle to the middle of the face. `tube_mm` is the radius of the round
    /// profile of the face. Both are in millimetres.
    pub fn tilted_cup(ring_mm: f64, tube_mm: f64, tilt_rad: f64) -> Self {
        Self::Cup { ring_mm, tube_mm, spindle: Vector::new(-tilt_rad.sin(), 0.0, tilt_rad.cos()) }
    }

    /// Returns the wheel's centre, which is the programmed point, when the wheel touches at `contact`. Returns `None`
    /// if a rim or ring cannot touch there, because the normal is within 2° of the spindle.
    #[inline]
    pub fn centre(&self, contact: &Contact) -> Option<Point> {
        let Contact { point, normal } = contact;
        match self {
            Self::Sphere { radius_mm } => Some(point + normal * *radius_mm),
            Self::Torus { ring_mm, tube_mm, spindle } | Self::Cup { ring_mm, tube_mm, spindle } => {
                let across = normal - spindle * normal.dot(spindle);
                let lean = across.norm();
                (lean >= MIN_SPINDLE_ANGLE_SINE).then(|| point + normal * *tube_mm + across * (ring_mm / lean))
            }
        }
    }

    /// Returns the two principal curvatures of the wheel at the contact point, in 1/mm, and the unit vector of the
    /// direction of the first one. `normal` is the unit normal of the surface at the contact. The first curvature is in
    /// the direction of rotation about the spindle. The second is at a right angle to it, along the profile of the rim.
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

    /// Returns the signed distance of a point from the surface of the wheel, in mm, negative inside the wheel.
    /// `from_centre` is the vector from the wheel's centre to the point.
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
                // The wall of the cup rises from its face along the spindle.
                (radial - ring_mm).hypot(axial.min(0.0)) - tube_mm
            }
        }
    }

    /// Returns a ball with its radius increased by `mm`; returns any other wheel unchanged.
    #[must_use]
    pub fn with_larger_radius(self, mm: f64) -> Self {
        match self {
            Self::Sphere { radius_mm } => Self::Sphere { radius_mm: radius_mm + mm },
            other => other,
        }
    }

    /// Returns the largest distance, in millimetres, from the wheel's centre to a point of its ball, rim or ring.
    pub fn reach_mm(&self) -> f64 {
        match self {
            Self::Sphere { radius_mm } => *radius_mm,
            Self::Torus { ring_mm, tube_mm, .. } | Self::Cup { ring_mm, tube_mm, .. } => ring_mm + tube_mm,
        }
    }

    /// Returns the wheel mirrored in the plane z = 0: the z component of the spindle changes its sign.
    #[must_use]
    pub fn mirrored(mut self) -> Self {
        if let Self::Torus { spindle, .. } | Self::Cup { spindle, .. } = &mut self {
            spindle.z = -spindle.z;
        }
        self
    }

    /// Returns shape, size and spindle of the wheel in one line, for the comment at the head of a grinding program.
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
    fn wheel_touches_without_penetration() {
        for wheel in wheels() {
            for normal in [Vector::z(), Vector::new(0.2, -0.1, 1.0), Vector::new(-0.3, 0.3, 1.0)] {
                let contact = contact(normal);
                let from = contact.point - wheel.centre(&contact).unwrap();
                assert!(wheel.distance_mm(&from).abs() < 1e-12, "{wheel:?}");
                // A step along the normal goes into the wheel; a step against it goes out of the wheel.
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
    fn wheel_curvatures_match_tangent_gap() {
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
    fn wheel_cannot_touch_along_spindle() {
        let wheel = Wheel::Torus { ring_mm: 48.0, tube_mm: 2.0, spindle: Vector::y() };
        assert_eq!(wheel.centre(&contact(Vector::new(0.0, 1.0, 0.01))), None);
    }

    #[test]
    fn cup_touches_hollow_sphere_with_ring() {
        // sin a = D / (2 (rho - r)): the angle between normal and spindle is a. Every point of the ring is then at the
        // same distance from the centre of the sphere.
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
