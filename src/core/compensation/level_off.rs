//! Values of a map outside the measured area: the map levels off to a constant and never extrapolates.

use crate::geometry::Grid;

/// Values at every node of a grid, with the source node of each.
pub(super) struct Levelled {
    pub values: Vec<f64>,
    /// Index of the source node: the nearest node with a value of its own, or the node itself if it has one.
    pub sources: Vec<usize>,
}

/// Extends a surface from the known nodes of `grid` to all of its nodes. `known` is true for the nodes whose `values`
/// are valid. Returns the values at all nodes, and for each node the index of its source: the nearest known node. Far
/// from the known nodes, a node has the value of its source.
///
/// `slopes` holds the slopes of the surface along x and y at each node. The transition to the constant value has the
/// length `distance_mm` (L) and no kink. At the distance t from the source, the surface differs from the value of the
/// source by g t (1 - t / L)^2. Here g is the slope at the source in the direction of the node. This difference starts
/// with the slope g, is at most 4/27 |g| L, and is 0 from t = L on. With L = 0, there is no transition.
pub(super) fn level_off(
    grid: &Grid,
    mut values: Vec<f64>,
    slopes: &[[f64; 2]],
    known: &[bool],
    distance_mm: f64,
) -> Levelled {
    let sources = nearest_known(grid, known);
    for k in (0..grid.len()).filter(|&k| !known[k]) {
        let source = sources[k];
        let (here, there) = (grid.place_mm(k), grid.place_mm(source));
        let off = [here[0] - there[0], here[1] - there[1]];
        let left = 1.0 - off[0].hypot(off[1]) / distance_mm;
        let rise = slopes[source][0] * off[0] + slopes[source][1] * off[1];
        values[k] = values[source] + if left > 0.0 && left.is_finite() { rise * left * left } else { 0.0 };
    }
    Levelled { values, sources }
}

/// Returns, for every node of `grid`, the index of the nearest known node: the nearest node for which `known` is true.
/// For a known node this is its own index. At least one node must be known.
///
/// Method: two sweeps over the grid, in which each node compares its candidate for the nearest known node with the
/// candidates of its neighbours (Danielsson 1980).
pub(super) fn nearest_known(grid: &Grid, known: &[bool]) -> Vec<usize> {
    const NONE: usize = usize::MAX;
    let (columns, rows) = (grid.columns, grid.rows);
    let mut nearest: Vec<usize> = (0..grid.len()).map(|k| if known[k] { k } else { NONE }).collect();
    let distance2 = |a: usize, b: usize| {
        let steps = [(a % columns).abs_diff(b % columns), (a / columns).abs_diff(b / columns)];
        (steps[0] as f64 * grid.spacing_mm[0]).powi(2) + (steps[1] as f64 * grid.spacing_mm[1]).powi(2)
    };
    let mut offer = |to: usize, from: usize| {
        let candidate = nearest[from];
        if candidate != NONE && (nearest[to] == NONE || distance2(to, candidate) < distance2(to, nearest[to])) {
            nearest[to] = candidate;
        }
    };
    for sweep in 0..2 {
        for n in 0..rows {
            let (j, before) = if sweep == 0 { (n, n.wrapping_sub(1)) } else { (rows - 1 - n, rows - n) };
            if before < rows {
                for i in 0..columns {
                    for from in i.saturating_sub(1)..(i + 2).min(columns) {
                        offer(j * columns + i, before * columns + from);
                    }
                }
            }
            for i in 1..columns {
                offer(j * columns + i, j * columns + i - 1);
            }
            for i in (1..columns).rev() {
                offer(j * columns + i - 1, j * columns + i);
            }
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: Grid = Grid { columns: 31, rows: 9, first_mm: [0.0, 0.0], spacing_mm: [1.0, 2.0] };

    #[test]
    fn nearest_known_matches_brute_force() {
        let seeds = [0, 40, 95, 200, 260];
        let known: Vec<bool> = (0..GRID.len()).map(|k| seeds.contains(&k)).collect();
        let far = |a: usize, b: usize| {
            let (p, q) = (GRID.place_mm(a), GRID.place_mm(b));
            (p[0] - q[0]).hypot(p[1] - q[1])
        };
        for (k, found) in nearest_known(&GRID, &known).into_iter().enumerate() {
            let least = seeds.iter().map(|s| far(k, *s)).fold(f64::INFINITY, f64::min);
            assert!((far(k, found) - least).abs() < 1e-12, "{k}: {found}");
        }
    }

    #[test]
    fn level_off_fades_slope_within_distance() {
        let known: Vec<bool> = (0..GRID.len()).map(|k| k % GRID.columns <= 10).collect();
        let values = (0..GRID.len()).map(|k| if known[k] { 0.1 * GRID.place_mm(k)[0] } else { 0.0 }).collect();
        let slopes = vec![[0.1, 0.0]; GRID.len()];
        let levelled = level_off(&GRID, values, &slopes, &known, 12.0).values;
        // 1 mm away: 1 + 0.1 (1 - 1/12)^2.
        assert!((levelled[11] - (1.0 + 0.1 * (11.0f64 / 12.0).powi(2))).abs() < 1e-15);
        assert!(levelled.iter().all(|v| *v <= 1.0 + 4.0 / 27.0 * 1.2 + 1e-12));
        assert!((22..31).all(|i| levelled[i] == 1.0));
        let at_once = level_off(&GRID, levelled.clone(), &slopes, &known, 0.0).values;
        assert!((11..31).all(|i| at_once[i] == 1.0));
    }
}
