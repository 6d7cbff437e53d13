//! Form error left by grinding: a smooth random error along the normal.

use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};

use crate::Rng;

/// Number of waves of a form error.
const WAVES: u32 = 96;

/// Gaussian random surface error with a Gaussian autocovariance, as a sum of plane waves.
///
/// Many waves of random direction, phase and (Gaussian) wave number give heights that are nearly Gaussian, and exact
/// derivatives everywhere. The correlation length l is the lag at which the autocovariance has fallen to 1/e: C(s) =
/// exp(-(s/l)^2), whose wave numbers have the standard deviation sqrt(2)/l on each axis.
#[derive(Clone, Debug)]
pub struct FormError {
    /// Wave vector (two numbers), phase and amplitude of each wave.
    waves: Vec<[f64; 4]>,
}

impl FormError {
    /// Draws a random form error from `seed`. The error has the peak-to-valley value `pv_mm` over a rectangle of
    /// `width_mm` by `depth_mm`, centred on the origin. `correlation_length_mm` is the distance at which the
    /// autocovariance has fallen to 1/e.
    pub fn new(seed: u64, correlation_length_mm: f64, pv_mm: f64, width_mm: f64, depth_mm: f64) -> Self {
        let bounds_mm = [width_mm, depth_mm].map(|size_mm| [-0.5 * size_mm, 0.5 * size_mm]);
        Self::over(seed, correlation_length_mm, pv_mm, bounds_mm)
    }

    /// Draws a random form error from `seed`, as [`Self::new`] does, over a rectangle that can be anywhere.
    /// `bounds_mm` has the minimum and the maximum of x, and those of y.
    pub fn over(seed: u64, correlation_length_mm: f64, pv_mm: f64, bounds_mm: [[f64; 2]; 2]) -> Self {
        let mut error = Self::with_amplitude(&mut crate::rng(seed), correlation_length_mm, 1.0);
        let (low, high) = error.extremes(bounds_mm);
        for wave in &mut error.waves {
            wave[3] = pv_mm / (high - low);
        }
        error
    }

    /// Draws a random form error with the random generator `rng`. `rms_mm` is the root mean square of the error over
    /// the infinite plane. `correlation_length_mm` is the distance at which the autocovariance has fallen to 1/e.
    ///
    /// The error is a sum of waves, and a wave of amplitude a has the mean square a^2/2.
    pub fn with_rms(rng: &mut Rng, correlation_length_mm: f64, rms_mm: f64) -> Self {
        Self::with_amplitude(rng, correlation_length_mm, rms_mm * (2.0 / f64::from(WAVES)).sqrt())
    }

    fn with_amplitude(rng: &mut Rng, correlation_length_mm: f64, amplitude_mm: f64) -> Self {
        let sigma = 2f64.sqrt() / correlation_length_mm;
        let wave = |_| {
            let [kx, ky]: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut *rng));
            [sigma * kx, sigma * ky, rng.random_range(0.0..std::f64::consts::TAU), amplitude_mm]
        };
        Self { waves: (0..WAVES).map(wave).collect() }
    }

    /// Returns a form without any error.
    pub fn none() -> Self {
        Self { waves: Vec::new() }
    }

    /// Returns the error at (x, y), in mm, positive where there is excess material.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        self.waves.iter().map(|[kx, ky, phase, a]| a * (kx * x + ky * y + phase).cos()).sum()
    }

    /// Adds this form error to `values_mm`, the values in mm at the nodes of a grid. The values are stored row by row,
    /// x fastest. `first_mm` is the position (x, y) of the first node, `step_mm` the spacing along x and y, and
    /// `columns` the number of nodes in a row.
    ///
    /// From node to node, the phase of a wave advances by the same angle. Each value is therefore computed by a
    /// rotation from the value before, without a cosine. Rounding errors accumulate to about 1e-14 of the amplitude
    /// over a row of hundreds of nodes.
    pub fn add_to_grid(&self, first_mm: [f64; 2], step_mm: [f64; 2], columns: usize, values_mm: &mut [f64]) {
        let turns: Vec<_> = self.waves.iter().map(|[kx, ..]| (kx * step_mm[0]).sin_cos()).collect();
        for (j, row) in values_mm.chunks_mut(columns).enumerate() {
            let y = first_mm[1] + j as f64 * step_mm[1];
            let start = |[kx, ky, phase, a]: &[f64; 4]| {
                let (sine, cosine) = (kx * first_mm[0] + ky * y + phase).sin_cos();
                (a * sine, a * cosine)
            };
            let (mut sines, mut cosines): (Vec<f64>, Vec<f64>) = self.waves.iter().map(start).unzip();
            for value in row {
                *value += cosines.iter().sum::<f64>();
                for ((sine, cosine), (turn_s, turn_c)) in sines.iter_mut().zip(&mut cosines).zip(&turns) {
                    (*sine, *cosine) = (*sine * turn_c + *cosine * turn_s, *cosine * turn_c - *sine * turn_s);
                }
            }
        }
    }

    /// Returns the derivatives of the form error with respect to x and y at (x, y), in mm/mm.
    pub fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        self.waves.iter().fold([0.0, 0.0], |[p, q], [kx, ky, phase, a]| {
            let s = -a * (kx * x + ky * y + phase).sin();
            [p + kx * s, q + ky * s]
        })
    }

    fn extremes(&self, [x_mm, y_mm]: [[f64; 2]; 2]) -> (f64, f64) {
        let at = |i: i32, [min, max]: [f64; 2]| 0.5 * (min + max) + (max - min) * (f64::from(i) / 100.0 - 0.5);
        (0..=100)
            .flat_map(|j| (0..=100).map(move |i| (i, j)))
            .map(|(i, j)| self.height(at(i, x_mm), at(j, y_mm)))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), h| (low.min(h), high.max(h)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn form_error_grid_matches_pointwise() {
        let form = FormError::with_rms(&mut crate::rng(3), 8.0, 0.5);
        let mut values = vec![1.0; 300 * 7];
        form.add_to_grid([-40.0, 3.0], [0.5, 2.5], 300, &mut values);
        for (k, value) in values.iter().enumerate() {
            let (x, y) = (-40.0 + 0.5 * (k % 300) as f64, 3.0 + 2.5 * (k / 300) as f64);
            assert!((value - 1.0 - form.height(x, y)).abs() < 1e-12, "({x}, {y})");
        }
        let mean_square = values.iter().map(|v| (v - 1.0).powi(2)).sum::<f64>() / values.len() as f64;
        assert!((0.3..0.7).contains(&mean_square.sqrt()), "{mean_square}");
    }
}
