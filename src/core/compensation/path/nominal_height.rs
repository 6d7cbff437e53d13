//! Conversion of a nominal surface into a smooth height over x and y.

use rayon::prelude::*;

use crate::geometry::{Aperture, Grid, Point, bounds};
use crate::surface::{FacetIndex, Nominal, NominalKind, OffsetSurface, Side};

use super::PathError;
use super::height_field::HeightField;

/// Maximum number of nodes of a field over points that do not form a grid.
const MAX_NODES: f64 = 2e6;
/// Maximum number of steps of Newton's method to a surface. Each step squares the error.
const STEPS: usize = 8;
/// Minimum z component of a normal: 84° of slope. A steeper surface is not a height over x and y.
const MIN_NZ: f64 = 0.1;

/// Converts the nominal surface into a height field over x and y. Returns this field and the outline of the part. If
/// `nominal` has no outline, the outline is the bounding box of its points in x and y.
///
/// If the points form a regular grid in x and y, they become the nodes of the field, with slopes from their normals.
/// Any other surface is sampled on a new regular grid. The new grid has about as many nodes as the surface has points.
///
/// # Errors
/// Returns [`PathError::NotAHeight`] if the surface is steeper than 84° at some point or faces away from +z. Returns
/// [`PathError::Empty`] if the points cover no area or do not form a surface.
pub fn nominal_height_field(nominal: &Nominal) -> Result<(HeightField, Aperture), PathError> {
    let [low, high] = bounds(nominal.points().map(|p| [p.x, p.y]));
    let outline = nominal.outline().cloned().unwrap_or(Aperture::from_corners([low, high]));
    let field = match regular(nominal)? {
        Some(field) => field,
        None => sampled(nominal, [low, high])?,
    };
    Ok((field, outline))
}

/// Returns the height field of a surface whose points form a regular grid in x and y. Returns `Ok(None)` if the points
/// form no regular grid.
///
/// # Errors
/// Returns [`PathError::NotAHeight`] if the surface is steeper than 84° at a point or faces away from +z.
fn regular(nominal: &Nominal) -> Result<Option<HeightField>, PathError> {
    let (NominalKind::Grid { columns, rows }, [patch]) = (nominal.kind(), nominal.patches()) else { return Ok(None) };
    let nodes = patch.nodes();
    // Two valid nodes along each axis fix the origin and the spacing of the grid.
    let of = |k: usize| (k % columns, k / columns);
    let mut there = (0..nodes.len()).filter(|&k| nodes[k].point.x.is_finite());
    let Some(first) = there.next() else { return Ok(None) };
    let other = |axis: usize| {
        let at = |k: usize| [of(k).0, of(k).1][axis];
        let far =
            (0..nodes.len()).filter(|&k| nodes[k].point.x.is_finite()).max_by_key(|&k| at(k).abs_diff(at(first)))?;
        let steps = at(far) as f64 - at(first) as f64;
        let spacing = (nodes[far].point[axis] - nodes[first].point[axis]) / steps;
        Some((spacing, nodes[first].point[axis] - spacing * at(first) as f64))
    };
    let (Some((dx, x0)), Some((dy, y0))) = (other(0), other(1)) else { return Ok(None) };
    let on = Grid { columns, rows, first_mm: [x0, y0], spacing_mm: [dx, dy] };
    let is_regular = |k: usize| {
        let (p, (i, j)) = (&nodes[k].point, of(k));
        !p.x.is_finite()
            || ((p.x - x0 - i as f64 * dx).abs() < 1e-4 * dx && (p.y - y0 - j as f64 * dy).abs() < 1e-4 * dy)
    };
    if !(dx > 0.0 && dy > 0.0 && (0..nodes.len()).into_par_iter().all(is_regular)) {
        return Ok(None);
    }
    let mut slopes = Vec::with_capacity(nodes.len());
    let mut heights = Vec::with_capacity(nodes.len());
    for (k, node) in nodes.iter().enumerate() {
        let (p, n) = (&node.point, &node.normal);
        if !(p.z.is_finite() && n.z.is_finite()) {
            slopes.push([0.0; 2]);
            heights.push(f64::NAN);
            continue;
        }
        if n.z < MIN_NZ {
            return Err(PathError::NotAHeight { x_mm: p.x, y_mm: p.y });
        }
        let slope = [-n.x / n.z, -n.y / n.z];
        // A node can be off its grid position by rounding: move it there along its tangent.
        let (i, j) = of(k);
        let off = [x0 + i as f64 * dx - p.x, y0 + j as f64 * dy - p.y];
        slopes.push(slope);
        heights.push(p.z + slope[0] * off[0] + slope[1] * off[1]);
    }
    Ok(Some(HeightField::hermite(on, &heights, &slopes)))
}

/// Height and slopes at a node.
type HeightAndSlopes = (f64, [f64; 2]);

/// Samples a surface whose nodes do not form a regular grid, and returns its height field over the rectangle from `low`
/// to `high`. Newton's method finds the height at each node.
///
/// # Errors
/// Returns [`PathError::NotAHeight`] if the surface is too steep, and [`PathError::Empty`] if the rectangle has no area
/// or the points give no surface.
fn sampled(nominal: &Nominal, [low, high]: [[f64; 2]; 2]) -> Result<HeightField, PathError> {
    let surface = OffsetSurface::new(nominal, 0.0, Side::Normal).map_err(|_| PathError::Empty)?;
    let size = [high[0] - low[0], high[1] - low[1]];
    let count = (nominal.len() as f64).clamp(9.0, MAX_NODES);
    let spacing = (size[0] * size[1] / count).sqrt();
    if !(spacing > 0.0 && spacing.is_finite()) {
        return Err(PathError::Empty);
    }
    let cells = size.map(|s| (s / spacing).ceil().clamp(2.0, MAX_NODES.sqrt()));
    let [columns, rows] = cells.map(|c| c as usize + 1);
    let on = Grid { columns, rows, first_mm: low, spacing_mm: [size[0] / cells[0], size[1] / cells[1]] };
    let middle = nominal.points().map(|p| p.z).sum::<f64>() / nominal.len() as f64;
    let lines: Vec<Result<Vec<HeightAndSlopes>, PathError>> = (0..rows)
        .into_par_iter()
        .map(|j| {
            let (mut place, mut z) = (FacetIndex::UNKNOWN, middle);
            (0..columns)
                .map(|i| {
                    let [x, y] = [low[0] + i as f64 * on.spacing_mm[0], low[1] + j as f64 * on.spacing_mm[1]];
                    let node = height_at(&surface, [x, y], z, &mut place)?;
                    if node.0.is_finite() {
                        z = node.0;
                    }
                    Ok(node)
                })
                .collect()
        })
        .collect();
    // Take the first error in the order of the lines, not in time, so that the same surface always gives the same
    // message.
    let lines: Vec<Vec<HeightAndSlopes>> = lines.into_iter().collect::<Result<_, PathError>>()?;
    let (heights, slopes): (Vec<f64>, Vec<[f64; 2]>) = lines.into_iter().flatten().unzip();
    Ok(HeightField::hermite(on, &heights, &slopes))
}

/// Finds the height, in mm, and the slopes of a surface at `[x, y]`, by Newton's method along z. `start_mm` is the
/// first height to try. `place` is the facet of the surface at which the search begins; the function replaces it by the
/// facet that it found.
///
/// The height is NaN if `[x, y]` is not on the part or if Newton's method does not converge.
///
/// # Errors
/// Returns [`PathError::NotAHeight`] if the surface is steeper than 84° or faces away from +z.
fn height_at(
    surface: &OffsetSurface,
    [x, y]: [f64; 2],
    start_mm: f64,
    place: &mut FacetIndex,
) -> Result<HeightAndSlopes, PathError> {
    let mut z = start_mm;
    for _ in 0..STEPS {
        let foot = surface.project(&Point::new(x, y, z), *place);
        *place = foot.facet;
        let n = foot.normal;
        if n.z < MIN_NZ {
            return Err(PathError::NotAHeight { x_mm: x, y_mm: y });
        }
        let step = foot.distance_mm / n.z;
        z -= step;
        if step.abs() < 1e-10 {
            if foot.beyond_edge_mm > 0.0 && foot.beyond_edge_steps > 1.0 {
                return Ok((f64::NAN, [0.0; 2]));
            }
            return Ok((z, [-n.x / n.z, -n.y / n.z]));
        }
    }
    Ok((f64::NAN, [0.0; 2]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Vector;
    use crate::surface::PlaneProjection;

    fn z(x: f64, y: f64) -> (f64, [f64; 2]) {
        (0.01 * x * x - 0.004 * y * y + 0.1 * x, [0.02 * x + 0.1, -0.008 * y])
    }

    #[test]
    fn nominal_height_from_grid_fills_holes() {
        let (columns, rows) = (41, 31);
        let place = |k: usize| [(k % columns) as f64 * 0.5 - 10.0, (k / columns) as f64 * 0.5 - 7.5];
        let hole = |[x, y]: [f64; 2]| x.hypot(y) > 7.6;
        let nan = Point::new(f64::NAN, f64::NAN, f64::NAN);
        let points: Vec<Point> = (0..columns * rows)
            .map(place)
            .map(|[x, y]| if hole([x, y]) { nan } else { Point::new(x, y, z(x, y).0) })
            .collect();
        let normals = (0..columns * rows)
            .map(place)
            .map(|[x, y]| Vector::new(-z(x, y).1[0], -z(x, y).1[1], 1.0).normalize())
            .collect();
        let nominal = Nominal::from_grid_with_normals(columns, rows, points, normals)
            .unwrap()
            .with_outline(Aperture::Circle { centre_mm: [0.0; 2], radius_mm: 6.0 });
        let (field, outline) = nominal_height_field(&nominal).unwrap();
        assert_eq!(outline.reach_mm(), 6.0);
        for [x, y] in [[0.3, 0.1], [-5.1, 2.7], [1.1, -5.8]] {
            let jet = field.at([x, y]);
            assert!((jet.value - z(x, y).0).abs() < 1e-9 && (jet.slope[0] - z(x, y).1[0]).abs() < 1e-9);
        }
        assert!((field.at([9.0, 6.0]).value - z(9.0, 6.0).0).abs() < 0.2);
    }

    #[test]
    fn nominal_height_from_scattered_points() {
        let points: Vec<Point> = (0..3000)
            .map(|k| [(f64::from(k) * 0.618_034).fract() * 20.0 - 10.0, (f64::from(k) + 0.5) / 200.0 - 7.5])
            .map(|[x, y]| Point::new(x, y, z(x, y).0))
            .collect();
        let nominal = Nominal::from_triangulated_points(points, PlaneProjection::Xy).unwrap();
        let (field, _) = nominal_height_field(&nominal).unwrap();
        for [x, y] in [[0.3, 0.1], [-5.1, 2.7], [7.1, -5.8]] {
            assert!((field.at([x, y]).value - z(x, y).0).abs() < 2e-6, "{}", field.at([x, y]).value - z(x, y).0);
        }
    }

    #[test]
    fn nominal_height_refuses_wall() {
        let points = (0..25).map(|k| Point::new(f64::from(k % 5), f64::from(k / 5), 20.0 * f64::from(k % 5))).collect();
        let nominal = Nominal::from_points(points, PlaneProjection::Xy).unwrap();
        assert!(matches!(nominal_height_field(&nominal), Err(PathError::NotAHeight { .. })));
    }
}
