//! The distance of a probe centre from the offset surface, against the exact one.

use crate::common::{RADIUS_MM, free_form};
use regrind_core::geometry::Point;
use regrind_core::surface::{DistanceModel, FacetIndex, Nominal, OffsetSurface, Side};
use regrind_sim::form::FormError;
use regrind_sim::shape::{FreeForm, Shape};

/// Largest and least error of the distance over points whose exact distance is known, inside and within two steps of
/// the edge.
fn errors_nm(nominal: &Nominal, distance: DistanceModel, step: [f64; 2]) -> [f64; 2] {
    let shape = FreeForm::default();
    let form = FormError::new(3, 30.0, 6.657e-3, 102.0, 62.0);
    let surface = OffsetSurface::new(nominal, RADIUS_MM, Side::Normal).unwrap().with_distance_model(distance);
    let mut range = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    let at = |i: usize, n: usize, size: f64| size * ((i as f64 + 0.37) / n as f64 - 0.5);
    for j in 0..331 {
        for i in 0..517 {
            let (x, y) = (at(i, 517, 102.0), at(j, 331, 62.0));
            let (s, n, e) = (shape.point(x, y), shape.normal(x, y), form.height(x, y));
            let p = Point::from(std::array::from_fn::<f64, 3, _>(|k| s[k] + (RADIUS_MM + e) * n[k]));
            let foot = surface.project(&p, FacetIndex::UNKNOWN);
            let error = (foot.distance_mm - e) * 1e6;
            let border = 51.0 - x.abs() < 2.0 * step[0] || 31.0 - y.abs() < 2.0 * step[1];
            let r = &mut range[usize::from(border)];
            *r = [r[0].min(error), r[1].max(error)];
        }
    }
    range.map(|[low, high]| high - low)
}

// The bounds are peak to valley in nanometres, inside and within two steps of the border.

#[test]
fn distance_error_on_paper_grid() {
    let (nominal, step) = (free_form(1021, 1241), [0.1, 0.05]);
    let flat = errors_nm(&nominal, DistanceModel::Triangle, step);
    let curved = errors_nm(&nominal, DistanceModel::Curved, step);
    println!("flat {flat:.3?} nm, curved {curved:.5?} nm");
    assert!(flat[0] < 60.0 && flat[0] > 5.0, "{flat:?}");
    assert!(curved[0] < 0.05 && curved[1] < 1.0, "{curved:?}");
}

#[test]
fn distance_error_on_coarse_grid() {
    let (nominal, step) = (free_form(128, 156), [102.0 / 127.0, 62.0 / 155.0]);
    let flat = errors_nm(&nominal, DistanceModel::Triangle, step);
    let curved = errors_nm(&nominal, DistanceModel::Curved, step);
    println!("flat {flat:.1?} nm, curved {curved:.3?} nm");
    assert!(curved[0] < 5.0 && curved[1] < 5.0, "{curved:?}");
}
