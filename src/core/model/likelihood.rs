//! How strong and how wide the field is, and how far a point scatters: by what was measured.
//!
//! The restricted likelihood, whatever the effects are, times what was known beforehand, is made as large as it gets. Its two shapes, the
//! range and the share of the scatter, are searched; the scale follows from them at once: sigma^2 is the mean square of the whitened
//! residuals.

use super::{Dense, Field, Hyper, ModelError, Observed};

/// What is known of a field before anything is measured: the median of each, and by what factor it may be off (one standard deviation of
/// its logarithm).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Priors {
    /// Of the range.
    pub range_mm: [f64; 2],
    /// Of the ratio of the scatter to the field.
    pub scatter_ratio: [f64; 2],
}

/// More points tell hardly more of the parameters, and take time by their cube.
const MOST_POINTS: usize = 400;

impl Priors {
    /// What every part is like: the range some third of its size, the scatter a twentieth of the field, each by a factor of six.
    pub fn of_size(size_mm: f64) -> Self {
        Self { range_mm: [size_mm / 3.0, 6.0], scatter_ratio: [0.05, 20.0] }
    }

    fn log_density(&self, range_mm: f64, ratio: f64) -> f64 {
        let of = |value: f64, [median, factor]: [f64; 2]| -0.5 * ((value / median).ln() / factor.ln()).powi(2);
        of(range_mm, self.range_mm) + of(ratio, self.scatter_ratio)
    }
}

impl Hyper {
    /// Finds the parameters that what was measured speaks for most.
    ///
    /// # Errors
    /// Those of [`Dense::fit`].
    pub fn of(observed: &Observed, priors: &Priors) -> Result<Self, ModelError> {
        observed.check()?;
        let few = thinned(observed);
        let least_mm = least_range_mm(&few);
        let at = |[range, ratio]: [f64; 2]| scaled(&few, range.exp().max(least_mm), ratio.exp(), priors);
        let start = [priors.range_mm[0].ln(), priors.scatter_ratio[0].ln()];
        let (best, _) = climb(start, |place| at(place).map_or(f64::NEG_INFINITY, |(_, value)| value));
        at(best).map(|(hyper, _)| hyper)
    }
}

/// A field that forgets itself between two neighbours is no form: what is narrower than this cannot be told from scatter.
fn least_range_mm(observed: &Observed) -> f64 {
    const NEIGHBOURS: f64 = 2.5;
    let span = |axis: usize| {
        let of = observed.places.iter().map(|place| place[axis]);
        of.clone().fold(f64::NEG_INFINITY, f64::max) - of.fold(f64::INFINITY, f64::min)
    };
    NEIGHBOURS * (span(0) * span(1) / observed.places.len() as f64).sqrt()
}

/// The parameters with the scale that suits them best, and the logarithm of their probability.
fn scaled(observed: &Observed, range_mm: f64, ratio: f64, priors: &Priors) -> Result<(Hyper, f64), ModelError> {
    let unit = Hyper { field: Field { sigma_mm: 1.0, range_mm }, scatter_mm: ratio };
    let model = Dense::fit(observed, unit)?;
    let free = (observed.places.len() - observed.effects.ncols()) as f64;
    // No deviation at all is a field of no strength.
    let sigma_mm = (model.whitened_squares(observed) / free).sqrt().max(f64::MIN_POSITIVE.sqrt());
    let squares = model.whitened_squares(observed);
    let value = model.log_likelihood() + 0.5 * squares - 0.5 * free - free * sigma_mm.ln();
    let hyper = Hyper { field: Field { sigma_mm, range_mm }, scatter_mm: ratio * sigma_mm };
    Ok((hyper, value + priors.log_density(range_mm, ratio)))
}

/// Some of the points, far from each other and near: every k-th in a fixed disorder.
fn thinned(observed: &Observed) -> Observed {
    let n = observed.places.len();
    if n <= MOST_POINTS {
        return observed.clone();
    }
    // Steps of the golden section go everywhere and repeat nothing.
    let mut chosen: Vec<usize> =
        (0..MOST_POINTS).map(|k| (((k as f64 + 0.5) * 0.618_033_988_749_894_9).fract() * n as f64) as usize).collect();
    chosen.sort_unstable();
    chosen.dedup();
    Observed {
        places: chosen.iter().map(|&k| observed.places[k]).collect(),
        deviations_mm: chosen.iter().map(|&k| observed.deviations_mm[k]).collect(),
        effects: observed.effects.select_rows(&chosen),
    }
}

/// Climbs to the highest place of two dimensions by a simplex (Nelder and Mead 1965).
fn climb(start: [f64; 2], height: impl Fn([f64; 2]) -> f64) -> ([f64; 2], f64) {
    const TURNS: usize = 120;
    const SMALL: f64 = 1e-4;
    let seen = |place: [f64; 2]| (place, height(place));
    let mut corners = [seen(start), seen([start[0] + 0.7, start[1]]), seen([start[0], start[1] + 0.9])];
    for _ in 0..TURNS {
        corners.sort_by(|a, b| b.1.total_cmp(&a.1));
        let [best, middle, worst] = corners;
        let spread =
            (0..2).map(|k| (best.0[k] - worst.0[k]).abs().max((best.0[k] - middle.0[k]).abs())).fold(0.0, f64::max);
        if spread < SMALL {
            break;
        }
        let centre = [0, 1].map(|k| 0.5 * (best.0[k] + middle.0[k]));
        let along = |factor: f64| [0, 1].map(|k| centre[k] + factor * (centre[k] - worst.0[k]));
        let reflected = seen(along(1.0));
        let replaced = if reflected.1 > best.1 {
            let further = seen(along(2.0));
            if further.1 > reflected.1 { further } else { reflected }
        } else if reflected.1 > middle.1 {
            reflected
        } else {
            let nearer = seen(along(if reflected.1 > worst.1 { 0.5 } else { -0.5 }));
            if nearer.1 <= worst.1.max(reflected.1) {
                for corner in &mut corners[1..] {
                    *corner = seen([0, 1].map(|k| 0.5 * (corner.0[k] + best.0[k])));
                }
                continue;
            }
            nearer
        };
        corners[2] = replaced;
    }
    corners.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((start, f64::NEG_INFINITY))
}

#[cfg(test)]
mod tests {
    use super::super::normals::Normals;
    use super::*;
    use nalgebra::{DMatrix, DVector};

    /// A field of known parameters at 300 places of a part of 102 x 62 mm, moved and tilted by what nobody knows.
    fn drawn(hyper: Hyper, seed: u64) -> Observed {
        let places: Vec<[f64; 2]> = (0..300)
            .map(|k| f64::from(k) + 0.5)
            .map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0])
            .collect();
        let n = places.len();
        let covariance = DMatrix::from_fn(n, n, |r, c| {
            hyper.field.covariance_mm2(places[r], places[c]) + if r == c { 1e-14 } else { 0.0 }
        });
        let mut normals = Normals::new(seed, 0);
        let field = covariance.cholesky().unwrap().l() * DVector::from_fn(n, |_, _| normals.next());
        let of = |k: usize, scatter: f64| field[k] + hyper.scatter_mm * scatter + 0.3 - 0.01 * places[k][0];
        let deviations_mm = (0..places.len()).map(|k| of(k, normals.next())).collect();
        let effects = DMatrix::from_fn(places.len(), 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
        Observed { places, deviations_mm, effects }
    }

    #[test]
    fn planted_parameters_are_found_again() {
        let planted = Hyper { field: Field { sigma_mm: 5e-3, range_mm: 30.0 }, scatter_mm: 3e-4 };
        let (mut sigma, mut range, mut scatter) = (0.0, 0.0, 0.0);
        const PARTS: u32 = 6;
        for seed in 0..PARTS {
            let found = Hyper::of(&drawn(planted, u64::from(seed)), &Priors::of_size(102.0)).unwrap();
            sigma += (found.field.sigma_mm / planted.field.sigma_mm).ln() / f64::from(PARTS);
            range += (found.field.range_mm / planted.field.range_mm).ln() / f64::from(PARTS);
            scatter += (found.scatter_mm / planted.scatter_mm).ln() / f64::from(PARTS);
        }
        let off = [sigma, range, scatter].map(f64::exp);
        println!("sigma, range, scatter: {off:.3?} of what was planted");
        assert!((off[0] - 1.0).abs() < 0.3 && (off[1] - 1.0).abs() < 0.25 && (off[2] - 1.0).abs() < 0.08, "{off:?}");
    }

    #[test]
    fn the_scale_of_everything_is_the_scale_of_what_is_found() {
        let planted = Hyper { field: Field { sigma_mm: 5e-3, range_mm: 30.0 }, scatter_mm: 3e-4 };
        let observed = drawn(planted, 1);
        let tenfold =
            Observed { deviations_mm: observed.deviations_mm.iter().map(|d| 10.0 * d).collect(), ..observed.clone() };
        let [a, b] = [observed, tenfold].map(|observed| Hyper::of(&observed, &Priors::of_size(102.0)).unwrap());
        assert!((b.field.sigma_mm / a.field.sigma_mm - 10.0).abs() < 1e-6);
        assert!((b.field.range_mm / a.field.range_mm - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_hill_is_climbed() {
        let hill = |[x, y]: [f64; 2]| -(x - 1.0).powi(2) - 30.0 * (y + 2.0 - 0.3 * x).powi(2);
        let (top, height) = climb([-3.0, 4.0], hill);
        assert!((top[0] - 1.0).abs() < 1e-3 && (top[1] + 1.7).abs() < 1e-3 && height > -1e-6, "{top:?}");
    }
}
