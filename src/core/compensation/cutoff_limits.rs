//! Limits of the waves that can be corrected: distance of the points, contact width of the wheel, and the cut-off
//! that both require.

use rayon::prelude::*;
use regrind_figures::statistics::median;

use super::MapError;
use crate::geometry::DeviationSample;

/// Number of readings at which the distance to the neighbours is measured; more readings would not change the median.
const PROBED: usize = 50;
/// Distance below which two readings are repeats of one place, as a share of [`square_spacing_mm`].
const SAME_PLACE: f64 = 0.02;

/// Returns the width over which a wheel touches a flat surface, in millimetres: 2 sqrt(2 R a - a^2).
///
/// `wheel_radius_mm` (R) is the radius of the wheel in the section plane in which the width is measured. `depth_mm` (a)
/// is the depth of cut; a value outside 0 to R is clamped. The wheel averages over this width, so it cannot grind a
/// shorter wave.
pub fn contact_width_mm(wheel_radius_mm: f64, depth_mm: f64) -> f64 {
    let depth_mm = depth_mm.clamp(0.0, wheel_radius_mm.max(0.0));
    2.0 * (2.0 * wheel_radius_mm * depth_mm - depth_mm * depth_mm).max(0.0).sqrt()
}

/// Checks that the cut-off wavelength `cutoff_mm` is not too short. All values are in millimetres. `contact_width_mm`
/// is the width on which the wheel touches the part. `point_spacing_mm` is the distance of the measured points.
///
/// The minimum cut-off is twice the contact width or twice the distance of the points, whichever is larger. Either the
/// wheel cannot grind a wave that is shorter than this minimum, or the points cannot resolve this wave. The check
/// accepts a cut-off from 0.9 times the minimum, because the estimated distance has an uncertainty of 10 %.
///
/// # Errors
/// Returns [`MapError::CutoffBelowContact`] if the cut-off is too short and the contact width is larger than the
/// distance of the points. Returns [`MapError::CutoffBelowSpacing`] if the cut-off is too short otherwise.
pub(super) fn check_cutoff(cutoff_mm: f64, contact_width_mm: f64, point_spacing_mm: f64) -> Result<(), MapError> {
    let min_mm = 2.0 * contact_width_mm.max(point_spacing_mm);
    // 10 % is the uncertainty of an estimated spacing.
    if cutoff_mm >= 0.9 * min_mm {
        return Ok(());
    }
    Err(if contact_width_mm > point_spacing_mm {
        MapError::CutoffBelowContact { cutoff_mm, min_mm, contact_width_mm }
    } else {
        MapError::CutoffBelowSpacing { cutoff_mm, min_mm, point_spacing_mm }
    })
}

/// Estimates the distance between neighbouring readings along x and along y, and returns the larger of the two
/// distances, in millimetres. A reading is a measured deviation with its place (x, y). Returns 0 if no reading has a
/// neighbour at another place.
///
/// The estimate uses a sample of at most 50 readings. For each reading of the sample, finds the nearest other reading
/// in each of four sectors. The sectors are centred on the directions +x, -x, +y and -y, and each is 90 degrees wide.
/// The distance along x is the median of the distances in the sectors +x and -x. The distance along y is the median of
/// the distances in the sectors +y and -y. Several readings at one place count as one.
///
/// Example: for scan lines with dense readings along x and a large distance along y, the result is the distance between
/// the lines.
pub fn point_spacing_mm(readings: &[DeviationSample]) -> f64 {
    let [x, y] = point_spacings_mm(readings);
    x.max(y)
}

/// Estimates the distance between neighbouring readings along x and along y, and returns these two distances in
/// millimetres. A reading is a measured deviation with its place (x, y). The first distance is the median distance from
/// a reading to the nearest other reading in the sectors around +x and -x. The second distance is the same for the
/// sectors around +y and -y. Each sector is 90 degrees wide. Uses a sample of at most 50 readings.
///
/// A distance is 0 if no reading has a neighbour in the sectors of this axis.
pub(super) fn point_spacings_mm(readings: &[DeviationSample]) -> [f64; 2] {
    let step = readings.len().div_ceil(PROBED).max(1);
    let chosen: Vec<&DeviationSample> = readings.iter().step_by(step).collect();
    let same_mm = SAME_PLACE * square_spacing_mm(readings);
    let nearest: Vec<[f64; 4]> =
        chosen.par_iter().map(|from| nearest_by_sector(from.place_mm, readings, same_mm)).collect();
    let usual = |sectors: [usize; 2]| {
        let found = nearest.iter().flat_map(|n| sectors.map(|s| n[s])).filter(|d| d.is_finite());
        median(&mut found.collect::<Vec<f64>>()).unwrap_or(0.0)
    };
    [usual([0, 1]), usual([2, 3])]
}

/// Returns the average spacing of the readings, in millimetres: sqrt(A / n). A is the area of the bounding box of the
/// readings in x and y, and n is their number. A square grid with this spacing has about n nodes in the box. Returns 0
/// if there are no readings or if the box has no area.
fn square_spacing_mm(readings: &[DeviationSample]) -> f64 {
    let [width, depth] = [0, 1].map(|axis| {
        let along = readings.iter().map(|r| r.place_mm[axis]);
        along.clone().fold(f64::NEG_INFINITY, f64::max) - along.fold(f64::INFINITY, f64::min)
    });
    (width.max(0.0) * depth.max(0.0) / readings.len().max(1) as f64).sqrt()
}

/// Finds the nearest reading to the place `[x, y]` in each of four sectors, and returns the four distances in
/// millimetres. The sectors contain the directions within 45 degrees of +x, -x, +y and -y. The result is in this order.
/// A sector without a reading has the distance infinity.
///
/// Ignores readings at a distance of at most `same_mm` in millimetres, because such readings repeat a measurement at
/// the same place.
fn nearest_by_sector([x, y]: [f64; 2], readings: &[DeviationSample], same_mm: f64) -> [f64; 4] {
    let mut nearest2 = [f64::INFINITY; 4];
    for r in readings {
        let (dx, dy) = (r.place_mm[0] - x, r.place_mm[1] - y);
        let sector = if dx.abs() >= dy.abs() { usize::from(dx < 0.0) } else { 2 + usize::from(dy < 0.0) };
        let distance2 = dx * dx + dy * dy;
        if distance2 > same_mm * same_mm && distance2 < nearest2[sector] {
            nearest2[sector] = distance2;
        }
    }
    nearest2.map(f64::sqrt)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(columns: usize, rows: usize, step_mm: [f64; 2]) -> Vec<DeviationSample> {
        let place = |k: usize| [(k % columns) as f64 * step_mm[0], (k / columns) as f64 * step_mm[1]];
        (0..columns * rows).map(|k| DeviationSample { place_mm: place(k), deviation_mm: 0.0 }).collect()
    }

    #[test]
    fn contact_width_is_wheel_chord() {
        // 20 um deep with 12.5 mm: half the chord is sqrt(12.5^2 - 12.48^2).
        assert!((contact_width_mm(12.5, 0.02) - 2.0 * (12.5f64.powi(2) - 12.48f64.powi(2)).sqrt()).abs() < 1e-12);
        assert_eq!((contact_width_mm(12.5, 0.0), contact_width_mm(0.0, 1.0)), (0.0, 0.0));
    }

    #[test]
    fn point_spacing_of_sparser_direction() {
        let found = point_spacing_mm(&grid(60, 30, [102.0 / 59.0, 62.0 / 29.0]));
        assert!((found - 62.0 / 29.0).abs() < 1e-12, "{found}");
        assert!((point_spacing_mm(&grid(500, 12, [0.1, 4.0])) - 4.0).abs() < 1e-12);
        assert_eq!(point_spacing_mm(&grid(1, 1, [1.0, 1.0])), 0.0);
        assert_eq!(point_spacing_mm(&[]), 0.0);
        let again = |r: DeviationSample| {
            [0.0, 0.3, 0.6].map(|beside| DeviationSample { place_mm: r.place_mm.map(|x| x + beside), ..r })
        };
        let thrice: Vec<DeviationSample> = grid(20, 20, [260.0, 260.0]).into_iter().flat_map(again).collect();
        assert!((point_spacing_mm(&thrice) - 260.0).abs() < 1.0, "{}", point_spacing_mm(&thrice));
    }

    #[test]
    fn check_cutoff_of_contact_and_spacing() {
        let contact = contact_width_mm(12.5, 0.02);
        assert!(check_cutoff(5.0, contact, 2.14).is_ok());
        let Err(MapError::CutoffBelowSpacing { min_mm, .. }) = check_cutoff(3.0, contact, 2.14) else { panic!() };
        assert_eq!(min_mm, 4.28);
        assert!(matches!(check_cutoff(2.0, contact, 0.5), Err(MapError::CutoffBelowContact { .. })));
    }
}
