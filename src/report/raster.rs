//! Conversion of scattered samples to pixels.

use super::{ReportError, range};
use regrind_core::geometry::Grid;

/// Values on a grid of pixels. Unlike a map of measured values, it has a NaN where there is no sample.
#[derive(Clone, Debug)]
pub(super) struct Raster {
    /// Positions of the centres of the pixels.
    pub(super) grid: Grid,
    /// Values, one for each pixel.
    pub(super) values: Vec<f64>,
}

/// Maximum number of pixels on the longer side: finer than a screen shows a figure, and small enough for a page.
const MAX_PIXELS: usize = 480;

/// Reach in pixels: gaps of up to twice this width within the cloud are filled from their sides.
const REACH: usize = 2;

/// Reach for a cloud in scan lines, which is dense along the lines and sparse across them.
const LINES_REACH: usize = 8;

/// Minimum weight of a pixel. A pixel that gets less than this share of a sample has no value of its own.
const MIN_WEIGHT: f64 = 1e-3;

impl Raster {
    /// Creates a grid of pixels from `samples`, each with the position x and y and a value. Each sample contributes to
    /// the four pixels around it, with bilinear weights. The value of a pixel is the weighted mean of these
    /// contributions. `title` is the name of the figure in error messages.
    ///
    /// The width of a pixel is about the distance between samples. Small gaps between the samples are filled with the
    /// mean of neighbouring pixels. Other pixels without a sample are NaN.
    ///
    /// # Errors
    /// Fails if there are fewer than two samples, if a number is not finite, or if all samples have the same x and y.
    pub(super) fn new(title: &str, samples: &[[f64; 3]]) -> Result<Self, ReportError> {
        check(title, samples)?;
        let (low, size) = extent(samples);
        let points = samples.len();
        let spacing = spacing(size, points).max(size[0].max(size[1]) / (MAX_PIXELS - 1) as f64);
        if !(spacing > 0.0 && spacing.is_finite()) {
            return Err(ReportError::NoExtent { figure: title.into(), points });
        }
        let counts = size.map(|s| (s / spacing).round() as usize + 1);
        let spacing_mm =
            std::array::from_fn(|k| if counts[k] > 1 { size[k] / (counts[k] - 1) as f64 } else { spacing });
        let [columns, rows] = counts;
        let mut raster = Self { grid: Grid { columns, rows, first_mm: low, spacing_mm }, values: Vec::new() };
        raster.values = raster.means(samples);
        raster.fill();
        Ok(raster)
    }

    fn means(&self, samples: &[[f64; 3]]) -> Vec<f64> {
        let mut sums = vec![[0.0; 2]; self.grid.len()];
        for &[x, y, value] in samples {
            let [(i, u), (j, v)] = self.grid.cell([x, y]);
            for (di, dj, weight) in
                [(0, 0, (1.0 - u) * (1.0 - v)), (1, 0, u * (1.0 - v)), (0, 1, (1.0 - u) * v), (1, 1, u * v)]
            {
                // A sample on the last column or row has no weight beyond it.
                if weight > 0.0 {
                    let [sum, total] = &mut sums[(j + dj) * self.grid.columns + i + di];
                    *sum += weight * value;
                    *total += weight;
                }
            }
        }
        sums.into_iter().map(|[sum, total]| if total >= MIN_WEIGHT { sum / total } else { f64::NAN }).collect()
    }

    /// Fills narrow gaps between the pixels that have a value. A filled pixel gets the mean of its neighbours that have
    /// a value. The filling starts at the border of a gap and proceeds to its middle. Gaps of up to twice the reach (in
    /// pixels) are filled. The reach is [`REACH`], or [`LINES_REACH`] if the samples are scan lines: dense along each
    /// line and sparse across the lines.
    fn fill(&mut self) {
        let known: Vec<bool> = self.values.iter().map(|v| !v.is_nan()).collect();
        let count = |mask: &[bool]| mask.iter().filter(|&&m| m).count();
        let mut reach = REACH;
        let wide = self.closed(&known, LINES_REACH);
        if count(&known) * 2 < count(&wide) {
            reach = LINES_REACH;
        }
        let within = if reach == LINES_REACH { wide } else { self.closed(&known, reach) };
        for _ in 0..=reach {
            let before = self.values.clone();
            for pixel in 0..before.len() {
                if within[pixel] && before[pixel].is_nan() {
                    self.values[pixel] = self.mean_around(&before, pixel);
                }
            }
        }
    }

    fn mean_around(&self, values: &[f64], pixel: usize) -> f64 {
        let (i, j) = (pixel % self.grid.columns, pixel / self.grid.columns);
        let around = |at: usize, count: usize| at.saturating_sub(1)..(at + 2).min(count);
        let (mut sum, mut total) = (0.0, 0.0);
        for row in around(j, self.grid.rows) {
            for value in
                around(i, self.grid.columns).map(|i| values[row * self.grid.columns + i]).filter(|v| !v.is_nan())
            {
                sum += value;
                total += 1.0;
            }
        }
        sum / total
    }

    /// Returns the morphological closing of `mask` with a square. The area of the pixels that are true is dilated by
    /// `reach` pixels, then eroded by `reach` pixels. Thus gaps of up to 2 * `reach` pixels become true. `mask` and the
    /// result have one entry for each pixel, row by row.
    fn closed(&self, mask: &[bool], reach: usize) -> Vec<bool> {
        let (columns, rows) = (self.grid.columns + 2 * reach, self.grid.rows + 2 * reach);
        let mut wide = vec![false; columns * rows];
        for j in 0..self.grid.rows {
            let to = (j + reach) * columns + reach;
            wide[to..to + self.grid.columns].copy_from_slice(&mask[j * self.grid.columns..(j + 1) * self.grid.columns]);
        }
        let grown = spread(&wide, columns, rows, reach, true);
        let shrunk = spread(&grown, columns, rows, reach, false);
        let row = |j: usize| (j + reach) * columns + reach;
        (0..self.grid.rows).flat_map(|j| shrunk[row(j)..row(j) + self.grid.columns].iter().copied()).collect()
    }
}

/// Returns a mask in which the area of the pixels with the value `value` has grown by `reach` pixels. A pixel of the
/// result is `value` if `mask` has this value within `reach` columns and `reach` rows of the pixel. Thus `value` = true
/// dilates the true area, and `value` = false erodes it. `mask` and the result have `columns` by `rows` pixels, row by
/// row.
fn spread(mask: &[bool], columns: usize, rows: usize, reach: usize, value: bool) -> Vec<bool> {
    let mut along = vec![!value; mask.len()];
    let mut out = vec![!value; mask.len()];
    for (pixel, _) in mask.iter().enumerate().filter(|&(_, &m)| m == value) {
        let (i, j) = (pixel % columns, pixel / columns);
        along[j * columns + i.saturating_sub(reach)..j * columns + (i + reach + 1).min(columns)].fill(value);
    }
    for (pixel, _) in along.iter().enumerate().filter(|&(_, &m)| m == value) {
        let (i, j) = (pixel % columns, pixel / columns);
        for row in j.saturating_sub(reach)..(j + reach + 1).min(rows) {
            out[row * columns + i] = value;
        }
    }
    out
}

/// Returns the spacing of a square grid that covers a rectangle of `width` by `height` with about `points` nodes. The
/// spacing has the unit of `width` and `height`. With n points and the size w by h, the spacing s solves (n - 1) s^2 =
/// (w + h) s + w h. `points` must be at least 2.
fn spacing([width, height]: [f64; 2], points: usize) -> f64 {
    let (sum, n) = (width + height, (points - 1) as f64);
    (sum + (sum * sum + 4.0 * n * width * height).sqrt()) / (2.0 * n)
}

/// Returns the minimum `[x, y]` of the samples, and their extent along x and along y.
fn extent(samples: &[[f64; 3]]) -> ([f64; 2], [f64; 2]) {
    let [[x0, x1], [y0, y1]] = [0, 1].map(|k| range(samples.iter().map(|s| s[k])));
    ([x0, y0], [x1 - x0, y1 - y0])
}

fn check(title: &str, samples: &[[f64; 3]]) -> Result<(), ReportError> {
    const MIN_POINTS: usize = 2;
    if samples.len() < MIN_POINTS {
        return Err(ReportError::TooFewPoints { figure: title.into(), found: samples.len(), least: MIN_POINTS });
    }
    for (index, sample) in samples.iter().enumerate() {
        if let Some(k) = sample.iter().position(|c| !c.is_finite()) {
            let what = ["x", "y", "value"][k];
            return Err(ReportError::NotFinite { figure: title.into(), index, what, value: sample[k] });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(columns: i32, rows: i32, keep: impl Fn(i32, i32) -> bool) -> Vec<[f64; 3]> {
        (0..rows)
            .flat_map(|j| (0..columns).map(move |i| (i, j)))
            .filter(|&(i, j)| keep(i, j))
            .map(|(i, j)| [f64::from(i) * 0.5 - 3.0, f64::from(j) * 0.5, f64::from(i - 2 * j)])
            .collect()
    }

    #[test]
    fn raster_of_regular_grid() {
        let raster = Raster::new("grid", &grid(12, 7, |_, _| true)).unwrap();
        assert_eq!((raster.grid.columns, raster.grid.rows), (12, 7));
        assert_eq!(raster.grid.spacing_mm, [0.5, 0.5]);
        for (pixel, value) in raster.values.iter().enumerate() {
            let exact = (pixel % 12) as f64 - 2.0 * (pixel / 12) as f64;
            assert!((value - exact).abs() < 1e-9, "{pixel}: {value} against {exact}");
        }
    }

    #[test]
    fn raster_fills_gaps_but_not_holes() {
        let lost = |i: i32, j: i32| (i, j) == (3, 3) || (i, j) == (4, 3);
        let hole = |i: i32, j: i32| (20..30).contains(&i) && (10..20).contains(&j);
        let raster = Raster::new("holes", &grid(40, 30, |i, j| !lost(i, j) && !hole(i, j))).unwrap();
        let at = |x: f64, y: f64| {
            let i = ((x - raster.grid.first_mm[0]) / raster.grid.spacing_mm[0]).round() as usize;
            raster.values[(y / raster.grid.spacing_mm[1]).round() as usize * raster.grid.columns + i]
        };
        // The value changes by 3 from one pixel to the next across the diagonal.
        assert!((at(-1.5, 1.5) + 3.0).abs() < 3.0, "{}", at(-1.5, 1.5));
        assert!(at(9.25, 7.25).is_nan());
    }

    #[test]
    fn raster_of_scan_lines() {
        let samples: Vec<[f64; 3]> =
            (0..20).flat_map(|j| (0..400).map(move |i| [f64::from(i) * 0.05, f64::from(j), f64::from(j)])).collect();
        let raster = Raster::new("lines", &samples).unwrap();
        assert!(raster.values.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn raster_of_disc() {
        let raster = Raster::new("disc", &grid(41, 41, |i, j| (i - 20).pow(2) + (j - 20).pow(2) <= 400)).unwrap();
        assert!(raster.values[0].is_nan() && raster.values.last().unwrap().is_nan());
        let middle = raster.values[raster.grid.rows / 2 * raster.grid.columns + raster.grid.columns / 2];
        assert!(middle.is_finite());
        let known = raster.values.iter().filter(|v| v.is_finite()).count() as f64;
        assert!((known / raster.values.len() as f64 - 0.785).abs() < 0.06, "{known}");
    }

    #[test]
    fn raster_refuses_bad_samples() {
        assert!(matches!(Raster::new("", &[[0.0; 3]]), Err(ReportError::TooFewPoints { found: 1, .. })));
        assert!(matches!(Raster::new("", &[[1.0; 3]; 5]), Err(ReportError::NoExtent { points: 5, .. })));
        let bad = [[0.0; 3], [1.0, 0.0, f64::NAN]];
        assert!(matches!(Raster::new("", &bad), Err(ReportError::NotFinite { index: 1, what: "value", .. })));
    }
}
