//! Thermal expansion: a part that is measured warm is larger than at 20 degrees Celsius.

use crate::geometry::Point;

/// Reference temperature of a length (ISO 1), in degrees Celsius.
pub const REFERENCE_TEMPERATURE_C: f64 = 20.0;

/// Thermal expansion of the part and of the scales that measure it. Both have the reported temperature.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ThermalExpansion {
    /// Coefficient of thermal expansion of the part, per kelvin.
    pub part_per_k: f64,
    /// Standard uncertainty of `part_per_k`, per kelvin.
    pub part_sigma_per_k: f64,
    /// Coefficient of thermal expansion of the scales, as far as the machine does not compensate it, per kelvin.
    pub scales_per_k: f64,
    /// Standard uncertainty of the reported temperature, in kelvins.
    pub temperature_sigma_k: f64,
}

impl ThermalExpansion {
    /// Returns the measured length of a part at `temperature_c` (degrees Celsius) divided by its length at 20 degrees
    /// Celsius.
    pub fn length_factor(&self, temperature_c: f64) -> f64 {
        1.0 + (self.part_per_k - self.scales_per_k) * (temperature_c - REFERENCE_TEMPERATURE_C)
    }

    /// Returns the standard uncertainty of [`ThermalExpansion::length_factor`] at `temperature_c` (degrees Celsius).
    /// The result has no unit. It contains the uncertainties of the temperature and of the expansion coefficient of the
    /// part.
    pub fn length_factor_sigma(&self, temperature_c: f64) -> f64 {
        let by_temperature = (self.part_per_k - self.scales_per_k) * self.temperature_sigma_k;
        by_temperature.hypot(self.part_sigma_per_k * (temperature_c - REFERENCE_TEMPERATURE_C))
    }

    /// Converts points that were measured at `temperature_c` (degrees Celsius) to their positions at 20 degrees
    /// Celsius. The points are scaled about their centroid by 1 / [`ThermalExpansion::length_factor`]. Frame: any.
    /// Units: millimetres.
    ///
    /// If the points are centres of the probe's ball, the scaling also changes their distance from the surface. The
    /// caller must then use the radius of the ball divided by [`ThermalExpansion::length_factor`]. The expansion of the
    /// ball itself needs no correction, because the calibration on the reference sphere already contains it.
    pub fn at_reference(&self, points: &[Point], temperature_c: f64) -> Vec<Point> {
        let n = points.len().max(1) as f64;
        let middle = Point::from(points.iter().map(|p| p.coords).sum::<crate::geometry::Vector>() / n);
        let measured = self.length_factor(temperature_c);
        points.iter().map(|p| middle + (p - middle) / measured).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEEL: ThermalExpansion =
        ThermalExpansion { part_per_k: 11.5e-6, part_sigma_per_k: 1e-6, scales_per_k: 8e-6, temperature_sigma_k: 0.5 };

    #[test]
    fn thermal_expansion_by_hand() {
        // 3.5e-6 per kelvin more than the scales, over ten kelvins: 3.5 um on 100 mm.
        assert!((STEEL.length_factor(30.0) - 1.000_035).abs() < 1e-12);
        assert!((STEEL.length_factor_sigma(30.0) - (1.75e-6_f64).hypot(1e-5)).abs() < 1e-18);
        assert!(STEEL.length_factor(20.0) == 1.0 && (STEEL.length_factor_sigma(20.0) - 1.75e-6).abs() < 1e-18);
        let warm = [Point::new(-50.0 * 1.000_035, 3.0, 0.0), Point::new(50.0 * 1.000_035, 3.0, 0.0)];
        let [a, b] = STEEL.at_reference(&warm, 30.0)[..] else { panic!() };
        assert!((a - Point::new(-50.0, 3.0, 0.0)).norm() < 1e-12 && (b - Point::new(50.0, 3.0, 0.0)).norm() < 1e-12);
        assert!(STEEL.at_reference(&[], 30.0).is_empty());
    }
}
