//! Map in coloured blocks for a terminal. Each character shows two pixels, the upper and the lower half.

use regrind::formats::MapNode;
use regrind::report::ColourMap;

/// Colour of a pixel. `None` without a measurement.
type Pixel = Option<[u8; 3]>;

/// Pixels of a map.
pub(super) struct Blocks {
    /// Upper and lower half of each character, row by row from the top.
    pub(super) rows: Vec<Vec<[Pixel; 2]>>,
    /// Maximum absolute value of the pixels in µm: the value at the end of the colour scale.
    pub(super) limit_um: f64,
}

impl Blocks {
    /// Draws an error map in coloured blocks: blue below zero, red above zero. `nodes` are the nodes of the map. `most`
    /// is the maximum width and height of the drawing, in characters. A character shows two pixels, one above the
    /// other.
    ///
    /// Returns `None` if the nodes have no extent in x or in y, or if `most` contains 0.
    pub(super) fn paint_error(nodes: &[MapNode], most: [usize; 2]) -> Option<Self> {
        let nodes: Vec<[f64; 3]> = nodes.iter().map(MapNode::error).collect();
        Self::painted(&nodes, most, |share| ColourMap::Diverging.at(0.5 + 0.5 * share))
    }

    /// Draws the standard uncertainty of an error map in coloured blocks, from dark (0) to bright (maximum). `nodes`
    /// are the nodes of the map. `most` is the maximum width and height of the drawing, in characters.
    ///
    /// Returns `None` if the nodes have no extent in x or in y, or if `most` contains 0.
    pub(super) fn paint_sigma(nodes: &[MapNode], most: [usize; 2]) -> Option<Self> {
        let nodes: Vec<[f64; 3]> = nodes.iter().map(MapNode::sigma).collect();
        Self::painted(&nodes, most, |share| ColourMap::Sequential.at(share))
    }

    /// Draws `nodes` on a grid of pixels. A node is `[x, y, value]`, in mm. A pixel has the mean value of the nodes in
    /// its area, and is empty if there is no node. `most` is the maximum width and height of the drawing, in
    /// characters. A character shows two pixels.
    ///
    /// `colour` returns the RGB colour of a pixel. The argument of `colour` is the mean value of the pixel divided by
    /// the largest absolute mean value, from -1 to 1.
    ///
    /// Returns `None` if the nodes have no extent in x or in y, or if `most` contains 0.
    fn painted(nodes: &[[f64; 3]], most: [usize; 2], colour: impl Fn(f64) -> [u8; 3]) -> Option<Self> {
        let range = |k: usize| nodes.iter().fold([f64::MAX, f64::MIN], |[a, b], node| [a.min(node[k]), b.max(node[k])]);
        let ([x0, x1], [y0, y1]) = (range(0), range(1));
        let (wide, deep) = (x1 - x0, y1 - y0);
        if !(wide > 0.0 && deep > 0.0) || most.contains(&0) {
            return None;
        }
        // A pixel is at least as large as the distance of the nodes, so that none between them is empty.
        let spacing_mm =
            [0, 1].map(|k| spacing(nodes.iter().map(|node| node[k]).collect())).into_iter().fold(0.0, f64::max);
        let pixel_mm = (wide / most[0] as f64).max(deep / (2 * most[1]) as f64).max(spacing_mm);
        let [columns, lines] = [wide, deep].map(|size| ((size / pixel_mm).round() as usize).max(1));
        let mut sums = vec![(0.0, 0_u32); columns * lines];
        // A node at the edge of a pixel must not fall into the one before it by rounding, which would leave it empty.
        const ROUNDING: f64 = 1e-9;
        for [x, y, value_mm] in nodes {
            let column = (((x - x0) / wide * columns as f64 + ROUNDING) as usize).min(columns - 1);
            let line = (((y1 - y) / deep * lines as f64 + ROUNDING) as usize).min(lines - 1);
            let (sum, count) = &mut sums[line * columns + column];
            (*sum, *count) = (*sum + value_mm, *count + 1);
        }
        let means: Vec<Option<f64>> =
            sums.iter().map(|(sum, count)| (*count > 0).then(|| sum / f64::from(*count))).collect();
        let limit_mm = means.iter().flatten().fold(0.0_f64, |limit, mean| limit.max(mean.abs()));
        let colour = |mean: f64| colour(if limit_mm > 0.0 { mean / limit_mm } else { 0.0 });
        let at = |line: usize, column: usize| means.get(line * columns + column).copied().flatten().map(colour);
        let row = |above: usize| (0..columns).map(|column| [at(above, column), at(above + 1, column)]).collect();
        Some(Self { rows: (0..lines).step_by(2).map(row).collect(), limit_um: 1e3 * limit_mm })
    }

    /// Returns the pixels as text with ANSI colour codes.
    pub(super) fn to_ansi(&self) -> String {
        let code = |plane: u8, [r, g, b]: [u8; 3]| format!("\x1b[{plane};2;{r};{g};{b}m");
        let block = |[above, below]: &[Pixel; 2]| match (above, below) {
            (Some(above), Some(below)) => format!("{}{}\u{2580}\x1b[0m", code(38, *above), code(48, *below)),
            (Some(above), None) => format!("{}\u{2580}\x1b[0m", code(38, *above)),
            (None, Some(below)) => format!("{}\u{2584}\x1b[0m", code(38, *below)),
            (None, None) => " ".to_owned(),
        };
        self.rows.iter().map(|row| row.iter().map(block).chain(["\n".to_owned()]).collect::<String>()).collect()
    }

    /// Appends the map `other`, which must have the same number of rows, to the right. Leaves `apart` empty columns
    /// between the maps.
    pub(super) fn append_right(mut self, other: Self, apart: usize) -> Self {
        for (row, more) in self.rows.iter_mut().zip(other.rows) {
            row.extend(std::iter::repeat_n([None; 2], apart).chain(more));
        }
        self
    }
}

/// Returns the smallest distance of two different coordinates, or 0 if there are no two.
fn spacing(mut coordinates: Vec<f64>) -> f64 {
    coordinates.sort_by(f64::total_cmp);
    let (Some(first), Some(last)) = (coordinates.first(), coordinates.last()) else { return 0.0 };
    // The nodes of one column are written alike; a smaller distance is a rounding error.
    let least = 1e-6 * (last - first);
    let steps = coordinates.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > least);
    steps.fold(None, |smallest: Option<f64>, step| Some(smallest.map_or(step, |of| of.min(step)))).unwrap_or(0.0)
}

/// Returns `values` as a line of bars, with one character for each value. The height of a bar is on a logarithmic scale
/// from the minimum (lowest bar) to the maximum (highest bar). A value below 1e-9 counts as 1e-9. If all values are
/// equal, all bars have the full height.
pub(super) fn sparkline(values: impl Iterator<Item = f64> + Clone) -> String {
    const STEPS: [char; 8] =
        ['\u{2581}', '\u{2582}', '\u{2583}', '\u{2584}', '\u{2585}', '\u{2586}', '\u{2587}', '\u{2588}'];
    let logs = values.map(|value| value.max(1e-9).ln());
    let (low, high) = logs.clone().fold((f64::MAX, f64::MIN), |(low, high), log| (low.min(log), high.max(log)));
    let step = |log: f64| if high > low { (7.0 * (log - low) / (high - low)).round() as usize } else { 7 };
    logs.map(|log| STEPS[step(log).min(7)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_orientation_and_size() {
        // Above the surface on the right, below it on the left.
        let node = |i, j| node([f64::from(i), f64::from(j)], 1e-4 * f64::from(i + j) - 2.9e-3);
        let nodes: Vec<MapNode> = (0..40).flat_map(|i| (0..20).map(move |j| node(i, j))).collect();
        let blocks = Blocks::paint_error(&nodes, [20, 30]).unwrap();
        assert!(blocks.rows.iter().all(|row| row.len() == 20) && blocks.rows.len() == 5, "{}", blocks.rows.len());
        let [r, _, b] = blocks.rows[0][19][0].unwrap();
        assert!(r > b, "proud is red");
        let [r, _, b] = blocks.rows[4][0][1].unwrap();
        assert!(b > r, "deep is blue");
        assert!(Blocks::paint_error(&nodes, [40, 3]).unwrap().rows.len() <= 3);
        let sigma = Blocks::paint_sigma(&nodes, [20, 30]).unwrap();
        assert_eq!((sigma.rows.len(), sigma.limit_um), (5, 0.1));
        let both = blocks.append_right(sigma, 2);
        assert!(both.rows.iter().all(|row| row.len() == 42 && row[20..22] == [[None; 2]; 2]));
        assert_eq!(both.rows[0][30][0].unwrap(), ColourMap::Sequential.at(1.0));
    }

    /// A terminal wider than the map has nodes: every pixel between the nodes has a colour.
    #[test]
    fn blocks_have_no_empty_pixels_at_any_width() {
        let nodes: Vec<MapNode> =
            (0..40).flat_map(|i| (0..20).map(move |j| node([f64::from(i), f64::from(j)], 1e-3))).collect();
        for wide in [10, 39, 40, 60, 120, 200] {
            let blocks = Blocks::paint_error(&nodes, [wide, 100]).unwrap();
            let lines = blocks.rows.len();
            let is_full = |(line, row): (usize, &Vec<[Pixel; 2]>)| {
                row.iter().all(|[above, below]| above.is_some() && (below.is_some() || line + 1 == lines))
            };
            assert!(blocks.rows.iter().enumerate().all(is_full), "{wide}");
        }
    }

    /// Returns a node with a standard deviation of 0.1 µm.
    fn node(at_mm: [f64; 2], error_mm: f64) -> MapNode {
        MapNode { at_mm, error_mm, sigma_mm: 1e-4 }
    }

    #[test]
    fn blocks_refuse_map_without_extent() {
        let painted = |places: &[[f64; 2]], most| {
            Blocks::paint_error(&places.iter().map(|at_mm| node(*at_mm, 0.0)).collect::<Vec<_>>(), most)
        };
        for places in [&[][..], &[[1.0, 1.0]], &[[1.0, 1.0], [2.0, 1.0]]] {
            assert!(painted(places, [10, 10]).is_none());
        }
        assert!(painted(&[[0.0, 0.0], [1.0, 1.0]], [0, 4]).is_none());
    }

    #[test]
    fn sparkline_follows_values() {
        assert_eq!(sparkline([100.0, 10.0, 1.0].into_iter()), "\u{2588}\u{2585}\u{2581}");
        assert_eq!(sparkline([5.0].into_iter()), "\u{2588}");
        assert_eq!(sparkline([].into_iter()), "");
    }
}
