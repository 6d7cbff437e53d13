//! A part that is measured warm is larger than it will be.

use crate::geometry::Point;

/// The temperature at which a length is what it is said to be (ISO 1).
pub const REFERENCE_C: f64 = 20.0;

/// How the part and the scales that measure it grow with their temperature; both have the one that is told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Expansion {
    /// Expansion of the part, per kelvin.
    pub part_per_k: f64,
    /// Its standard uncertainty.
    pub part_sigma_per_k: f64,
    /// Expansion of the scales that the machine does not correct by itself, per kelvin.
    pub scales_per_k: f64,
    /// Standard uncertainty of the temperature that is told, in kelvins.
    pub temperature_sigma_k: f64,
}

impl Expansion {
    /// Returns what a length of 1 is measured as at a temperature in degrees Celsius.
    pub fn measured(&self, temperature_c: f64) -> f64 {
        1.0 + (self.part_per_k - self.scales_per_k) * (temperature_c - REFERENCE_C)
    }

    /// Returns the standard uncertainty of [`Expansion::measured`].
    pub fn sigma(&self, temperature_c: f64) -> f64 {
        let by_temperature = (self.part_per_k - self.scales_per_k) * self.temperature_sigma_k;
        by_temperature.hypot(self.part_sigma_per_k * (temperature_c - REFERENCE_C))
    }

    /// Takes points of a part at a temperature to where they would be at 20 degrees Celsius, about their middle.
    ///
    /// Frame: any. A centre of the probe comes as near as that to the surface too, so the radius that belongs to it is that of the ball
    /// divided by [`Expansion::measured`]; what the ball itself grows by is in the radius that was found on the sphere.
    pub fn at_reference(&self, points: &[Point], temperature_c: f64) -> Vec<Point> {
        let n = points.len().max(1) as f64;
        let middle = Point::from(points.iter().map(|p| p.coords).sum::<crate::geometry::Vector>() / n);
        let measured = self.measured(temperature_c);
        points.iter().map(|p| middle + (p - middle) / measured).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEEL: Expansion =
        Expansion { part_per_k: 11.5e-6, part_sigma_per_k: 1e-6, scales_per_k: 8e-6, temperature_sigma_k: 0.5 };

    #[test]
    fn by_hand() {
        // 3.5e-6 a kelvin more than the scales, ten kelvins: 3.5 um on 100 mm.
        assert!((STEEL.measured(30.0) - 1.000_035).abs() < 1e-12);
        assert!((STEEL.sigma(30.0) - (1.75e-6_f64).hypot(1e-5)).abs() < 1e-18);
        assert!(STEEL.measured(20.0) == 1.0 && (STEEL.sigma(20.0) - 1.75e-6).abs() < 1e-18);
        let warm = [Point::new(-50.0 * 1.000_035, 3.0, 0.0), Point::new(50.0 * 1.000_035, 3.0, 0.0)];
        let [a, b] = STEEL.at_reference(&warm, 30.0)[..] else { panic!() };
        assert!((a - Point::new(-50.0, 3.0, 0.0)).norm() < 1e-12 && (b - Point::new(50.0, 3.0, 0.0)).norm() < 1e-12);
        assert!(STEEL.at_reference(&[], 30.0).is_empty());
    }
}
