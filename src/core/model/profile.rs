//! The likelihood along the scale of a field beside effects of which a standard uncertainty is stated: they do not grow with it.
//!
//! Of K = sigma^2 K0 + E E' only K0 is ever factored. With P = K0^-1 - K0^-1 H (H'K0^-1 H)^-1 H'K0^-1 and the eigenvalues l of E'P E and b, E'P d in its
//! eigenvectors, the restricted likelihood of n points with p effects that nobody knows is
//!
//! ```text
//!  -2 L = (n - p) ln 2 pi sigma^2 + ln |K0| + ln |H'K0^-1 H| + sum ln(1 + l / sigma^2) + (d'P d - sum b^2 / (l + sigma^2)) / sigma^2
//! ```

use nalgebra::SymmetricEigen;

use super::dense::{Solved, told_apart};
use super::{Hyper, ModelError, Observed};

/// What has to be known of some points to have it for any scale.
pub(super) struct Profile {
    free: f64,
    log_det: f64,
    squares: f64,
    /// Eigenvalues, and the squares of what stands beside them.
    by_effects: Vec<[f64; 2]>,
}

impl Profile {
    /// The parameters are those of a field whose scale is 1.
    pub(super) fn of(observed: &Observed, unit: Hyper) -> Result<Self, ModelError> {
        let Solved { gram, towards, own, log_det, .. } = Solved::of(observed, &unit)?;
        let (p, q) = (observed.effects.ncols(), observed.stated.ncols());
        let vague = told_apart(gram.view((0, 0), (p, p)).into_owned())?;
        let across = gram.view((0, p), (p, q));
        let (of_across, of_towards) = (vague.solve(&across), vague.solve(&towards.rows(0, p)));
        let stated = gram.view((p, p), (q, q)) - across.tr_mul(&of_across);
        let left = towards.rows(p, q) - across.tr_mul(&of_towards);
        let squares = own - towards.rows(0, p).dot(&of_towards);
        let SymmetricEigen { eigenvalues, eigenvectors } = stated.symmetric_eigen();
        let beside = eigenvectors.tr_mul(&left);
        let by_effects = eigenvalues.iter().zip(&beside).map(|(l, b)| [l.max(0.0), b * b]).collect();
        let log_vague: f64 = 2.0 * vague.l_dirty().diagonal().iter().map(|v| v.ln()).sum::<f64>();
        let free = (observed.places.len() - p) as f64;
        Ok(Self { free, log_det: log_det + log_vague, squares, by_effects })
    }

    fn log_likelihood(&self, sigma_mm: f64) -> f64 {
        let variance = sigma_mm * sigma_mm;
        let [mut logs, mut explained] = [0.0; 2];
        for [l, squared] in &self.by_effects {
            logs += (1.0 + l / variance).ln();
            explained += squared / (l + variance);
        }
        let squares = (self.squares - explained).max(0.0) / variance;
        -0.5 * (self.free * (std::f64::consts::TAU * variance).ln() + self.log_det + logs + squares)
    }
}

/// The scale that suits some points best, all together, and the logarithm of the likelihood by it.
pub(super) fn best_scale(all: &[Profile]) -> (f64, f64) {
    // No deviation at all is a field of next to no strength; and the effects take no more off it than this.
    const LEAST_MM: f64 = 1e-12;
    const TAKEN: f64 = 14.0;
    const STEPS: usize = 14;
    const TURNS: usize = 32;
    let of = |log: f64| all.iter().map(|one| one.log_likelihood(log.exp())).sum::<f64>();
    let (squares, free) = all.iter().fold((0.0, 0.0), |(a, b), one| (a + one.squares, b + one.free));
    let most = (squares / free).max(0.0).sqrt().max(LEAST_MM).ln();
    let (least, step) = ((most - TAKEN).max(LEAST_MM.ln()), TAKEN / STEPS as f64);
    let coarse = (0..=STEPS).map(|k| (most - step * k as f64).max(least)).map(|log| (log, of(log)));
    let best = coarse.fold((most, f64::NEG_INFINITY), |a, b| if b.1 > a.1 { b } else { a });
    let (mut low, mut high) = (best.0 - step, best.0 + step);
    // The golden section.
    let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
    let between = |low: f64, high: f64| [high - golden * (high - low), low + golden * (high - low)];
    let [mut a, mut b] = between(low, high).map(|log| (log, of(log)));
    for _ in 0..TURNS {
        if a.1 > b.1 {
            (high, b) = (b.0, a);
            a = (between(low, high)[0], of(between(low, high)[0]));
        } else {
            (low, a) = (a.0, b);
            b = (between(low, high)[1], of(between(low, high)[1]));
        }
    }
    let best = if a.1 > b.1 { a } else { b };
    (best.0.exp(), best.1)
}

#[cfg(test)]
mod tests {
    use super::super::{Dense, Field};
    use super::*;
    use nalgebra::DMatrix;

    #[test]
    fn it_is_the_likelihood_of_the_exact_model_at_every_scale() {
        let places: Vec<[f64; 2]> = (0..40).map(f64::from).map(|k| [(7.31 * k) % 60.0, (13.7 * k) % 40.0]).collect();
        let deviations = places.iter().map(|[x, y]| 5e-3 * (0.1 * x).sin() + 2e-3 * (0.13 * y).cos()).collect();
        let effects = DMatrix::from_fn(40, 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
        let stated = DMatrix::from_fn(40, 2, |r, c| [1e-3 * places[r][0].powi(2) / 900.0, 4e-3][c]);
        let observed = Observed { effects, stated, ..Observed::without_effects(places, deviations) };
        let of = |sigma_mm: f64| Hyper { field: Field::new(sigma_mm, 25.0), scatter_mm: 0.1 * sigma_mm, drift: 0.0 };
        let profile = Profile::of(&observed, of(1.0)).unwrap();
        let exact = |sigma: f64| Dense::fit(&observed, of(sigma)).unwrap().log_likelihood();
        for sigma in [1e-4, 1e-3, 1e-2] {
            let [a, b] = [profile.log_likelihood(sigma), exact(sigma)];
            assert!((a - b).abs() < 1e-6 * b.abs(), "{sigma}: {a} {b}");
        }
        let (sigma, top) = best_scale(&[profile]);
        assert!((exact(sigma) - top).abs() < 1e-6 * top.abs());
        assert!([0.97, 1.03].iter().all(|by| exact(by * sigma) < top), "{sigma}");
    }
}
