//! ISO 10110-5 figures of many forms at the same places. The part that depends only on the places is computed once.
//!
//! The fits of [`super::iso_10110`] are projections: the residual of a form f after a fit is f - Q Q'f, where the
//! columns of Q are the terms, orthonormalised on the places. Q is computed once. Each form then needs some twenty sums
//! over the places.

use nalgebra::DMatrix;

use super::iso::{MAX_SYMMETRIC_DEGREE, even_terms};

/// Minimum number of places for ISO 10110-5 figures.
const MIN_PLACES: usize = 12;
/// Minimum share of a term that is independent of the terms before it. With a smaller share, the places do not
/// determine the term.
const MIN_INDEPENDENT_SHARE: f64 = 1e-7;

/// Fits of ISO 10110-5 over a set of places.
pub struct IsoFits {
    /// Piston, x tilt, y tilt and r^2, orthonormalised in this order, each with one value per place.
    quadric_terms: Vec<Vec<f64>>,
    /// Coefficient of r^2 / R^2 per unit of the last quadric term, where R is the largest distance of a place from the
    /// centre. The next field, `power_pv`, is the peak to valley of r^2 / R^2 over the places.
    power: f64,
    power_pv: f64,
    /// Terms that are symmetric about the centre, orthonormalised, each with one value per place.
    symmetric_terms: Vec<Vec<f64>>,
}

/// Figures of ISO 10110-5 of a form. Units: millimetres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IsoFormValues {
    /// A: PV of the power.
    pub power_mm: f64,
    /// Height of the power at the rim relative to the centre, positive if the rim is higher.
    pub power_rim_mm: f64,
    /// B: PV of the irregularity.
    pub irregularity_mm: f64,
    /// C: PV of the part of the irregularity that is symmetric about the centre.
    pub symmetric_mm: f64,
    /// RMSt: root mean square of the form without piston and tilt.
    pub rms_total_mm: f64,
    /// RMSi: root mean square of the irregularity.
    pub rms_irregularity_mm: f64,
    /// RMSa: root mean square of the part of the irregularity that is not symmetric about the centre.
    pub rms_varying_mm: f64,
}

impl IsoFits {
    /// Prepares the least-squares fits of ISO 10110-5 for many forms at the same `places`.
    ///
    /// `middle_mm` is the centre of symmetry; with `None` it is the centre of the bounds of the places. Frame: model.
    /// Units: millimetres.
    ///
    /// Returns `None` if there are fewer than 12 places, or if the places do not determine piston, tilt and power, for
    /// example on a line.
    pub fn new(places: &[[f64; 2]], middle_mm: Option<[f64; 2]>) -> Option<Self> {
        if places.len() < MIN_PLACES {
            return None;
        }
        let [low, high] = crate::geometry::bounds(places.iter().copied());
        let middle = middle_mm.unwrap_or_else(|| std::array::from_fn(|k| 0.5 * (low[k] + high[k])));
        let reach = places.iter().map(|at| (at[0] - middle[0]).hypot(at[1] - middle[1])).fold(0.0, f64::max);
        if !(reach > 0.0 && reach.is_finite()) {
            return None;
        }
        let at = |k: usize| [0, 1].map(|axis| (places[k][axis] - middle[axis]) / reach);
        let square = |k: usize| at(k)[0].powi(2) + at(k)[1].powi(2);
        let rows = DMatrix::from_fn(places.len(), 4, |r, c| [1.0, at(r)[0], at(r)[1], square(r)][c]);
        let (base, scales) = orthogonalize(&rows)?;
        let squares = (0..places.len()).map(square);
        let (least, most) = (squares.clone().fold(f64::INFINITY, f64::min), squares.fold(0.0, f64::max));
        let even = DMatrix::from_fn(places.len(), MAX_SYMMETRIC_DEGREE + 1, |r, c| even_terms(square(r))[c]);
        let carried = (MAX_SYMMETRIC_DEGREE + 1).min(places.len() / 4).max(1);
        let (even, _) = (1..=carried).rev().find_map(|terms| orthogonalize(&even.columns(0, terms).into_owned()))?;
        Some(Self { quadric_terms: base, power: 1.0 / scales[3], power_pv: most - least, symmetric_terms: even })
    }

    /// Computes the ISO 10110-5 figures of one form, in millimetres. `form` holds one deviation in millimetres for each
    /// place of [`IsoFits::new`], in the same order.
    ///
    /// Piston and tilt are removed first; the rest is the total. The power is the part of the total proportional to
    /// r^2, where r is the distance from the centre of symmetry. The irregularity is the total without the power. Its
    /// symmetric part is rotationally symmetric about the centre, and its varying part is the rest.
    ///
    /// Returns the PV of power, irregularity and symmetric part, and the RMS of total, irregularity and varying part.
    /// Also returns the height of the power at the rim relative to the centre.
    pub fn evaluate(&self, form: &[f64]) -> IsoFormValues {
        let n = form.len() as f64;
        let dot = |row: &[f64], with: &[f64]| row.iter().zip(with).map(|(a, b)| a * b).sum::<f64>();
        let mut rest = form.to_vec();
        let mut taken = [0.0; 4];
        let mut rms_total_mm = 0.0;
        for (c, (taken, term)) in taken.iter_mut().zip(&self.quadric_terms).enumerate() {
            if c == 3 {
                rms_total_mm = (dot(&rest, &rest) / n).sqrt();
            }
            *taken = dot(term, &rest);
            rest.iter_mut().zip(term).for_each(|(value, term)| *value -= *taken * term);
        }
        let mut even = vec![0.0; form.len()];
        for term in &self.symmetric_terms {
            let share = dot(term, &rest);
            even.iter_mut().zip(term).for_each(|(value, term)| *value += share * term);
        }
        let varying: f64 = rest.iter().zip(&even).map(|(rest, even)| (rest - even).powi(2)).sum();
        let power_rim_mm = taken[3] * self.power;
        IsoFormValues {
            power_mm: power_rim_mm.abs() * self.power_pv,
            power_rim_mm,
            irregularity_mm: super::removed_forms::pv(rest.iter().copied()),
            symmetric_mm: super::removed_forms::pv(even.iter().copied()),
            rms_total_mm,
            rms_irregularity_mm: (dot(&rest, &rest) / n).sqrt(),
            rms_varying_mm: (varying / n).sqrt(),
        }
    }
}

/// Makes the columns of the matrix `rows` orthonormal, one after another (QR decomposition). Returns the columns of Q
/// and the diagonal elements of the triangular matrix R.
///
/// The absolute value of a diagonal element is the length of the part of a column that is linearly independent of the
/// columns before it. Returns `None` if, for one column, this length is at most [`MIN_INDEPENDENT_SHARE`] times the
/// length of the whole column.
fn orthogonalize(rows: &DMatrix<f64>) -> Option<(Vec<Vec<f64>>, Vec<f64>)> {
    let (q, r) = rows.clone().qr().unpack();
    let columns = q.column_iter().map(|column| column.iter().copied().collect()).collect();
    let is_new = |k: usize| r[(k, k)].abs() > MIN_INDEPENDENT_SHARE * r.column(k).norm();
    let scales = (0..rows.ncols()).map(|k| r[(k, k)]).collect();
    (0..rows.ncols()).all(is_new).then_some((columns, scales))
}

#[cfg(test)]
mod tests {
    use super::super::iso_10110;
    use super::*;
    use crate::geometry::{Aperture, DeviationSample};

    fn disc(spacing_mm: f64) -> Vec<[f64; 2]> {
        let reach = (20.0 / spacing_mm) as i32;
        let all = (-reach..=reach).flat_map(|i| (-reach..=reach).map(move |j| [f64::from(i), f64::from(j)]));
        all.map(|at| at.map(|v| v * spacing_mm)).filter(|[x, y]| x.hypot(*y) <= 20.0).collect()
    }

    #[test]
    fn iso_fits_match_iso_10110() {
        let aperture = Aperture::Circle { centre_mm: [0.0; 2], radius_mm: 20.0 };
        for places in [disc(1.3), disc(4.0), disc(8.0)] {
            let fits = IsoFits::new(&places, Some([0.0; 2])).unwrap();
            let form = |[x, y]: [f64; 2]| {
                1e-3 * (0.4 + 0.02 * x - 0.01 * y
                    + 2e-3 * (x * x + y * y)
                    + (0.3 * x).sin() * (0.2 * y).cos()
                    + 1e-5 * (x * x + y * y).powi(2))
            };
            let values: Vec<f64> = places.iter().map(|&at| form(at)).collect();
            let samples: Vec<DeviationSample> =
                places.iter().map(|&at_mm| DeviationSample { place_mm: at_mm, deviation_mm: form(at_mm) }).collect();
            let (one, many) = (iso_10110(&samples, &aperture, 632.8).unwrap(), fits.evaluate(&values));
            for (one_nm, many_mm) in [
                (one.power_nm, many.power_mm),
                (one.power_rim_nm, many.power_rim_mm),
                (one.irregularity_nm, many.irregularity_mm),
                (one.symmetric_nm, many.symmetric_mm),
                (one.rms_total_nm, many.rms_total_mm),
                (one.rms_irregularity_nm, many.rms_irregularity_mm),
                (one.rms_varying_nm, many.rms_varying_mm),
            ] {
                assert!((1e6 * many_mm - one_nm).abs() < 1e-6 * one_nm.abs(), "{one:?} {many:?}");
            }
        }
    }

    #[test]
    fn iso_fits_of_motion_and_sphere() {
        let places = disc(2.0);
        let fits = IsoFits::new(&places, None).unwrap();
        let of = |form: &dyn Fn(f64, f64) -> f64| {
            fits.evaluate(&places.iter().map(|[x, y]| form(*x, *y)).collect::<Vec<_>>())
        };
        let sphere = of(&|x, y| 5e-6 * (x * x + y * y) + 0.3 - 2e-3 * x + 1e-3 * y);
        // 5e-6 * 20^2 from the middle to the rim.
        assert!((sphere.power_mm - 2e-3).abs() < 1e-12 && (sphere.power_rim_mm - 2e-3).abs() < 1e-12, "{sphere:?}");
        assert!(sphere.irregularity_mm < 1e-12 && sphere.symmetric_mm < 1e-12 && sphere.rms_varying_mm < 1e-12);
        let nothing = of(&|_, _| 0.0);
        assert_eq!((nothing.power_mm, nothing.irregularity_mm, nothing.rms_total_mm), (0.0, 0.0, 0.0));
    }

    #[test]
    fn iso_fits_refuse_few_or_collinear() {
        assert!(IsoFits::new(&disc(2.0)[..11], None).is_none());
        let line: Vec<[f64; 2]> = (0..40).map(|k| [f64::from(k), 0.5 * f64::from(k)]).collect();
        assert!(IsoFits::new(&line, None).is_none() && IsoFits::new(&[[3.0; 2]; 40], None).is_none());
    }
}
