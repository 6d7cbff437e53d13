//! Smallest concave radii of a formula, into which a ball must fit.

use crate::surface::DefinedSurface;

/// Number of evaluated positions along each axis of the aperture's box.
const POSITIONS_PER_AXIS: usize = 61;

/// Returns the smallest concave radius of the surface in mm, and the position (x, y) in mm at which the surface has
/// this radius. The result has two entries: first for the side of the surface towards +z, then for the side towards -z.
/// If the surface is not concave on a side, the radius of this entry is infinite and the position is (0, 0).
///
/// Computes the curvature on a grid within the aperture, from finite differences of the exact gradient. The radius is
/// accurate to a few percent, which is sufficient to check a recipe. The registration itself checks the offset surface
/// (the surface on which the probe centres are).
pub(super) fn min_concave_radii_mm(surface: &DefinedSurface) -> [(f64, [f64; 2]); 2] {
    let [[x0, y0], [x1, y1]] = surface.aperture().bounds();
    let at = |least: f64, most: f64, k: usize| least + (most - least) * k as f64 / (POSITIONS_PER_AXIS - 1) as f64;
    let step_mm = 1e-4 * (x1 - x0).min(y1 - y0);
    let mut sharpest = [(f64::INFINITY, [0.0; 2]); 2];
    for j in 0..POSITIONS_PER_AXIS {
        for i in 0..POSITIONS_PER_AXIS {
            let place = [at(x0, x1, i), at(y0, y1, j)];
            if !surface.aperture().contains(place[0], place[1]) {
                continue;
            }
            let Some([least, most]) = principal_curvatures(surface, place, step_mm) else { continue };
            // A surface of positive curvature is concave towards +z.
            for (side, curvature) in [most, -least].into_iter().enumerate() {
                if curvature > 0.0 && 1.0 / curvature < sharpest[side].0 {
                    sharpest[side] = (1.0 / curvature, place);
                }
            }
        }
    }
    sharpest
}

/// Returns the minimum and the maximum principal curvature of the surface at (`x`, `y`), in 1/mm. The curvature is
/// positive if the surface is concave towards +z. `step_mm` is the step of the finite differences. Returns `None` if
/// the formula has no value at this position or at a distance of one step from it, or if the curvature is not finite.
fn principal_curvatures(surface: &DefinedSurface, [x, y]: [f64; 2], step_mm: f64) -> Option<[f64; 2]> {
    let gradient = |x: f64, y: f64| surface.formula().sag_and_gradient(x, y).map(|(_, gradient)| gradient);
    let [p, q] = gradient(x, y)?;
    let slope = |ahead: [f64; 2], behind: [f64; 2], k: usize| (ahead[k] - behind[k]) / (2.0 * step_mm);
    let (east, west) = (gradient(x + step_mm, y)?, gradient(x - step_mm, y)?);
    let (north, south) = (gradient(x, y + step_mm)?, gradient(x, y - step_mm)?);
    let (r, t) = (slope(east, west, 0), slope(north, south, 1));
    let s = 0.5 * (slope(east, west, 1) + slope(north, south, 0));
    // Mean and Gaussian curvature of a height function over the plane.
    let w = 1.0 + p * p + q * q;
    let mean = ((1.0 + q * q) * r - 2.0 * p * q * s + (1.0 + p * p) * t) / (2.0 * w * w.sqrt());
    let gauss = (r * t - s * s) / (w * w);
    let spread = (mean * mean - gauss).max(0.0).sqrt();
    let both = [mean - spread, mean + spread];
    both.iter().all(|k| k.is_finite()).then_some(both)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn concave_radii_mm(surface: &str) -> [f64; 2] {
        let text = format!("[surface]\n{surface}\n[aperture]\nkind = 'circle'\nradius_mm = 20\n");
        min_concave_radii_mm(&DefinedSurface::from_toml(&text).unwrap()).map(|(radius, _)| radius)
    }

    #[test]
    fn hollows_of_known_surfaces() {
        let [up, down] = concave_radii_mm("kind = 'sphere'\nradius_mm = 50");
        assert!((up - 50.0).abs() < 1e-3 && down.is_infinite(), "{up} {down}");
        let [up, down] = concave_radii_mm("kind = 'sphere'\nradius_mm = -50");
        assert!((down - 50.0).abs() < 1e-3 && up.is_infinite(), "{up} {down}");
        let [up, down] = concave_radii_mm("kind = 'biconic'\nradius_x_mm = 60\nradius_y_mm = -80");
        assert!((up / 60.0 - 1.0).abs() < 0.01 && (down / 80.0 - 1.0).abs() < 0.01, "{up} {down}");
        assert_eq!(concave_radii_mm("kind = 'plane'"), [f64::INFINITY; 2]);
    }
}
