//! Reproducible random numbers of a normal distribution.

/// Stream of independent standard normal numbers: SplitMix64 (Steele, Lea and Flood 2014), transformed in pairs (Box
/// and Muller 1958).
pub(super) struct NormalGenerator {
    state: u64,
    spare: Option<f64>,
}

impl NormalGenerator {
    /// Creates a generator of standard normal numbers. Each number `stream` gives an independent sequence for the same
    /// `seed`; the same seed and stream give the same sequence.
    pub(super) fn new(seed: u64, stream: u64) -> Self {
        let mut mixed = Self { state: seed, spare: None };
        let state = mixed.bits() ^ stream.wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(17);
        mixed.state = state;
        mixed
    }

    /// Returns the next random number of the standard normal distribution.
    pub(super) fn next(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        let (sine, cosine) = (std::f64::consts::TAU * self.uniform()).sin_cos();
        self.spare = Some(radius * sine);
        radius * cosine
    }

    /// Returns a uniform random number in [0, 1).
    pub(super) fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_are_gaussian_and_independent() {
        const N: usize = 100_000;
        let draw = |stream| {
            let mut normals = NormalGenerator::new(7, stream);
            (0..N).map(|_| normals.next()).collect::<Vec<f64>>()
        };
        let (a, b) = (draw(0), draw(1));
        let mean = |of: &dyn Fn(usize) -> f64| (0..N).map(of).sum::<f64>() / N as f64;
        for (found, expected) in [
            (mean(&|k| a[k]), 0.0),
            (mean(&|k| a[k].powi(2)), 1.0),
            (mean(&|k| a[k].powi(4)), 3.0),
            (mean(&|k| a[k] * b[k]), 0.0),
        ] {
            assert!((found - expected).abs() < 0.1, "{found} {expected}");
        }
        assert_eq!(draw(1), b);
    }
}
