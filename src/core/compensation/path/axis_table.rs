//! Correction for controllers that compensate by a table: an offset of Z over the axis positions X and Y.
//!
//! A table of this kind (sag or straightness compensation over two axes, a levelling mesh) depends on the axis
//! positions, not on the contact point of the wheel. Each entry is therefore the height of the wheel's centre over the
//! corrected surface minus its height over the uncorrected surface, at the same X and Y of the centre. This includes
//! the slope of the surface and the radius of the wheel. The table is exact at its nodes.

use rayon::prelude::*;

use super::{PathError, TargetSurface, Wheel};
use crate::compensation::level_off::nearest_known;
use crate::geometry::{Grid, Point};

const STEPS: usize = 40;

/// Computes a compensation table for the axes of a grinder. Returns the offset of the Z axis at every node of `grid`,
/// in millimetres. A positive offset raises the wheel, so that more material remains. The nodes are positions of the
/// axes X and Y.
///
/// `before` is the surface without the correction, `after` is the surface with the correction. An offset is the height
/// of the wheel's centre in contact with `after` minus the height in contact with `before`.
///
/// The grid can extend beyond the part; the surfaces are extrapolated there. If the wheel cannot touch the surface at a
/// node, the node takes the offset of the nearest node at which contact is possible.
///
/// # Errors
/// Returns [`PathError::CannotTouch`] if contact is possible at no node of the grid.
pub fn axis_offsets(
    before: &TargetSurface,
    after: &TargetSurface,
    wheel: &Wheel,
    grid: &Grid,
) -> Result<Vec<f64>, PathError> {
    let one = |node: usize| {
        let axes = grid.place_mm(node);
        Ok(height_mm(after, wheel, axes)? - height_mm(before, wheel, axes)?)
    };
    let offsets: Vec<Result<f64, PathError>> = (0..grid.len()).into_par_iter().map(one).collect();
    let known: Vec<bool> = offsets.iter().map(Result::is_ok).collect();
    if !known.contains(&true) {
        return offsets.into_iter().collect();
    }
    let values: Vec<f64> = offsets.into_iter().map(Result::unwrap_or_default).collect();
    Ok(nearest_known(grid, &known).into_iter().map(|node| values[node]).collect())
}

/// Computes the height z of the wheel's centre, in mm, at which the wheel touches the surface `wanted` while the axes X
/// and Y are at `axes`. Newton's method finds the contact point.
///
/// # Errors
/// Returns [`PathError::CannotTouch`] if the wheel cannot touch, or if the method does not converge.
fn height_mm(wanted: &TargetSurface, wheel: &Wheel, axes: [f64; 2]) -> Result<f64, PathError> {
    let refused = |[x_mm, y_mm]: [f64; 2]| PathError::CannotTouch { x_mm, y_mm };
    let centre = |place: [f64; 2]| wheel.centre(&wanted.at(place)).ok_or_else(|| refused(place));
    let off = |at: &Point| [at.x - axes[0], at.y - axes[1]];
    let size = |[x, y]: [f64; 2]| f64::hypot(x, y);
    // The contact point of a rim is far from the point below its centre.
    let first = centre(axes)?;
    let mut place = [2.0 * axes[0] - first.x, 2.0 * axes[1] - first.y];
    let mut at = centre(place)?;
    for _ in 0..STEPS {
        if size(off(&at)) < 1e-9 {
            return Ok(at.z);
        }
        const H: f64 = 1e-4;
        let (east, north) = (centre([place[0] + H, place[1]])?, centre([place[0], place[1] + H])?);
        let [a, b, c, d] = [east.x - at.x, north.x - at.x, east.y - at.y, north.y - at.y].map(|v| v / H);
        let ([x, y], determinant) = (off(&at), a * d - b * c);
        let step = [(d * x - b * y) / determinant, (a * y - c * x) / determinant];
        // Limit the step to the reach of the wheel and halve it until the residual decreases: the curvature of the
        // surface changes at the edge of the part.
        let mut share = (wheel.reach_mm() / size(step)).min(1.0);
        (place, at) = loop {
            let next = [place[0] - share * step[0], place[1] - share * step[1]];
            if !(next[0] + next[1]).is_finite() || share < 1e-6 {
                return Err(refused(axes));
            }
            match centre(next) {
                Ok(there) if size(off(&there)) < size(off(&at)) => break (next, there),
                _ => share /= 2.0,
            }
        };
    }
    Err(refused(axes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compensation::Correction;
    use crate::compensation::path::HeightField;
    use crate::geometry::{Grid, Vector};

    #[test]
    fn axis_offset_grows_by_inverse_cosine() {
        let on = Grid { columns: 41, rows: 41, first_mm: [-20.0, -20.0], spacing_mm: [1.0, 1.0] };
        let heights: Vec<f64> = (0..41 * 41).map(|k| 0.5 * (f64::from(k % 41) - 20.0)).collect();
        let slope = HeightField::hermite(on, &heights, &vec![[0.5, 0.0]; 41 * 41]);
        let grid = Grid { columns: 3, rows: 3, first_mm: [-2.0, -2.0], spacing_mm: [2.0, 2.0] };
        let corrected = |e: f64| Correction { grid, values_mm: vec![e; 9], cycle: 1, level_mm: 0.01, parameters: None };
        let [before, after] = [0.0, 0.004].map(|e| TargetSurface::new(slope.clone(), &corrected(e), 5.0).unwrap());
        for wheel in
            [Wheel::Sphere { radius_mm: 5.0 }, Wheel::Torus { ring_mm: 8.0, tube_mm: 2.0, spindle: Vector::y() }]
        {
            let offsets = axis_offsets(&before, &after, &wheel, &grid).unwrap();
            // A plane that is shifted by e along its normal is higher by e / nz.
            let expected = 0.004 * 1.25f64.sqrt();
            assert!(offsets.iter().all(|dz| (dz - expected).abs() < 1e-9), "{offsets:?}");
        }
    }

    #[test]
    fn axis_offset_where_wheel_cannot_touch() {
        // A flat plane joins a slope whose normal is parallel to the spindle of a cup. The rim can touch the plane,
        // not the slope.
        let spindle = Vector::new(-0.5, 0.0, 0.75f64.sqrt());
        let wheel = Wheel::Cup { ring_mm: 6.0, tube_mm: 1.0, spindle };
        let facing = 0.5 / 0.75f64.sqrt();
        let on = Grid { columns: 61, rows: 41, first_mm: [-30.0, -20.0], spacing_mm: [1.0, 1.0] };
        let ground = |k: usize| (k % on.columns) as f64 - 30.0;
        let offsets = |first_mm: f64| {
            let heights: Vec<f64> = (0..on.columns * on.rows).map(|k| facing * ground(k).max(0.0)).collect();
            let slopes: Vec<[f64; 2]> =
                (0..on.columns * on.rows).map(|k| [if ground(k) > 0.0 { facing } else { 0.0 }, 0.0]).collect();
            let grid = Grid { columns: 2, rows: 1, first_mm: [first_mm, 0.0], spacing_mm: [40.0, 1.0] };
            let corrected =
                |e: f64| Correction { grid, values_mm: vec![e; 2], cycle: 1, level_mm: 0.0, parameters: None };
            let [before, after] = [0.0, 0.004]
                .map(|e| TargetSurface::new(HeightField::hermite(on, &heights, &slopes), &corrected(e), 1.0).unwrap());
            axis_offsets(&before, &after, &wheel, &grid)
        };
        let found = offsets(-20.0).unwrap();
        assert!(found.iter().all(|dz| (dz - 0.004).abs() < 1e-9), "{found:?}");
        let nowhere = offsets(20.0);
        assert!(matches!(nowhere, Err(PathError::CannotTouch { .. })), "{nowhere:?}");
    }
}
