//! A correction as controllers take it that compensate by a table: an offset of Z over the places of X and Y.
//!
//! Such tables (sag or straightness compensation over two axes, a levelling mesh) know where the axes are, not where the wheel touches. So
//! the table holds, for the wheel's centre at X and Y, how much higher it must be for the corrected surface than for the one without a
//! correction; the slope of the surface and the radius of the wheel are in it. It is exact at the nodes.

use rayon::prelude::*;

use super::{PathError, Wanted, Wheel};
use crate::compensation::Net;

const STEPS: usize = 30;

/// Returns the offset of Z at every node of a net over the axes X and Y, in millimetres; positive leaves material.
///
/// # Errors
/// A place that the wheel cannot touch.
pub fn axis_offsets(before: &Wanted, after: &Wanted, wheel: &Wheel, net: &Net) -> Result<Vec<f64>, PathError> {
    let one = |node: usize| {
        let axes = net.place_mm(node);
        Ok(height_mm(after, wheel, axes)? - height_mm(before, wheel, axes)?)
    };
    (0..net.len()).into_par_iter().map(one).collect()
}

/// The height of the wheel's centre over X and Y: the place that it touches then is searched by Newton's method.
fn height_mm(wanted: &Wanted, wheel: &Wheel, axes: [f64; 2]) -> Result<f64, PathError> {
    let refused = |[x_mm, y_mm]: [f64; 2]| PathError::CannotTouch { x_mm, y_mm };
    let centre = |place: [f64; 2]| wheel.centre(&wanted.at(place)).ok_or_else(|| refused(place));
    let mut place = axes;
    // A rim touches far from below its centre.
    let first = centre(place)?;
    place = [2.0 * place[0] - first.x, 2.0 * place[1] - first.y];
    for _ in 0..STEPS {
        let at = centre(place)?;
        let off = [at.x - axes[0], at.y - axes[1]];
        if off[0].hypot(off[1]) < 1e-9 {
            return Ok(at.z);
        }
        const H: f64 = 1e-4;
        let (east, north) = (centre([place[0] + H, place[1]])?, centre([place[0], place[1] + H])?);
        let [a, b, c, d] = [east.x - at.x, north.x - at.x, east.y - at.y, north.y - at.y].map(|v| v / H);
        let determinant = a * d - b * c;
        let step = [(d * off[0] - b * off[1]) / determinant, (a * off[1] - c * off[0]) / determinant];
        // A step no longer than the wheel, whatever the surface does.
        let share = (wheel.reach_mm() / step[0].hypot(step[1])).min(1.0);
        place = [place[0] - share * step[0], place[1] - share * step[1]];
        if !(place[0] + place[1]).is_finite() {
            return Err(refused(axes));
        }
    }
    Err(refused(axes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compensation::Correction;
    use crate::compensation::path::{Field, Lattice};
    use crate::geometry::Vector;

    #[test]
    fn a_slope_raises_the_offset_by_one_over_the_cosine() {
        let on = Lattice { columns: 41, rows: 41, first_mm: [-20.0, -20.0], spacing_mm: [1.0, 1.0] };
        let heights: Vec<f64> = (0..41 * 41).map(|k| 0.5 * (f64::from(k % 41) - 20.0)).collect();
        let slope = Field::hermite(on, &heights, &vec![[0.5, 0.0]; 41 * 41]);
        let net = Net { columns: 3, rows: 3, first_mm: [-2.0, -2.0], spacing_mm: [2.0, 2.0] };
        let corrected = |e: f64| Correction { net, values_mm: vec![e; 9], cycle: 1, level_mm: 0.01 };
        let [before, after] = [0.0, 0.004].map(|e| Wanted::new(slope.clone(), &corrected(e), 5.0).unwrap());
        for wheel in
            [Wheel::Sphere { radius_mm: 5.0 }, Wheel::Torus { ring_mm: 8.0, tube_mm: 2.0, spindle: Vector::y() }]
        {
            let offsets = axis_offsets(&before, &after, &wheel, &net).unwrap();
            // Moved by e along the normal, a plane is higher by e / nz.
            let expected = 0.004 * 1.25f64.sqrt();
            assert!(offsets.iter().all(|dz| (dz - expected).abs() < 1e-9), "{offsets:?}");
        }
    }
}
