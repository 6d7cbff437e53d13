//! Line plots.

use std::path::Path;

use super::ReportError;
use super::axis::{Ruler, Scale, fixed};
use super::chart::{Chart, ChartAxis, Dot, Layer, Mark, Shape};
use regrind_formats::write_atomic;

/// Axis of a plot.
#[derive(Clone, Debug, Default)]
pub struct Axis {
    /// Label of the axis, with the unit.
    pub label: String,
    /// Scale of the axis, linear or logarithmic.
    pub scale: Scale,
}

/// Line of a plot.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points, joined in this order.
    pub points: Vec<[f64; 2]>,
}

/// Several lines over one pair of axes. Each line has its own colour and marker; a legend is drawn next to the axes.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    /// Title above the plot.
    pub title: String,
    /// Horizontal axis, to the right.
    pub x: Axis,
    /// Vertical axis, upwards.
    pub y: Axis,
    /// Lines, in the order of the legend.
    pub series: Vec<Series>,
}

/// Number of colours; the lines after them are dashed.
const COLOURS: usize = 7;
/// Width and height of the plot in pixels, without the names in the legend.
const SIZE: [f64; 2] = [660.0, 440.0];

impl Plot {
    /// Returns the plot as SVG.
    ///
    /// # Errors
    /// Fails if there are no points, if a number is not finite, or if a number on a logarithmic axis is not above 0.
    pub fn to_svg(&self) -> Result<String, ReportError> {
        let [x, y] = [self.axis(0)?, self.axis(1)?];
        let longest = self.series.iter().map(|s| s.name.chars().count()).max().unwrap_or(0);
        let right_margin = 56.0 + 6.6 * longest as f64;
        let layers = self.series.iter().enumerate().map(|(k, series)| layer(k, series)).collect();
        let chart = Chart {
            title: self.title.clone(),
            size: [SIZE[0] + right_margin, SIZE[1]],
            right_margin,
            x,
            y,
            layers,
            has_legend: true,
            ..Chart::default()
        };
        Ok(chart.to_file())
    }

    /// Saves the plot as an SVG file at `path`.
    ///
    /// # Errors
    /// Fails if there are no points, if a number is not finite, if a number on a logarithmic axis is not above 0, or if
    /// the file cannot be written.
    pub fn save_svg(&self, path: &Path) -> Result<(), ReportError> {
        Ok(write_atomic(path, self.to_svg()?.as_bytes())?)
    }

    /// Returns one axis of the plot: the x axis for `k` = 0, the y axis for `k` = 1. Its range contains the points of all
    /// series. It is widened to begin and end at a tick.
    ///
    /// # Errors
    /// Fails if there are no points, if a number is not finite, or if a number on a logarithmic axis is not above 0.
    fn axis(&self, k: usize) -> Result<ChartAxis, ReportError> {
        let (axis, what) = if k == 0 { (&self.x, "x") } else { (&self.y, "y") };
        let [mut low, mut high] = [f64::INFINITY, f64::NEG_INFINITY];
        for series in &self.series {
            for (index, value) in series.points.iter().map(|p| p[k]).enumerate() {
                let figure = || series.name.clone();
                if !value.is_finite() {
                    return Err(ReportError::NotFinite { figure: figure(), index, what, value });
                }
                if axis.scale == Scale::Log && value <= 0.0 {
                    return Err(ReportError::NoLogarithm { figure: figure(), index, what, value });
                }
                (low, high) = (low.min(value), high.max(value));
            }
        }
        if low > high {
            return Err(ReportError::TooFewPoints { figure: self.title.clone(), found: 0, least: 1 });
        }
        let ticks = if k == 0 { self.max_x_ticks(high - low) } else { 8 };
        let range = Ruler::new(axis.scale, [low, high], [0.0, 1.0]).rounded(8).range();
        Ok(ChartAxis::new(&axis.label, axis.scale, range, ticks, &fixed))
    }

    /// Returns the maximum number of ticks of the x axis. The number is 10, or less if all x values of the plot are
    /// integers. In that case it is the `extent` of the values, limited to 1 to 10.
    fn max_x_ticks(&self, extent: f64) -> usize {
        const MAX: usize = 10;
        let mut all = self.series.iter().flat_map(|series| &series.points).map(|point| point[0]);
        if all.all(|x| x.fract() == 0.0) { (extent as usize).clamp(1, MAX) } else { MAX }
    }
}

/// Returns the marks of the line with the index `k`: its points, joined, each with the marker of the line.
fn layer(k: usize, series: &Series) -> Layer {
    const SHAPES: [Shape; 4] = [Shape::Disc, Shape::Square, Shape::Triangle, Shape::Diamond];
    let points = series.points.clone();
    let dot = |at: &[f64; 2]| Mark::Dot(Dot { at: *at, shape: SHAPES[k % SHAPES.len()], ..Dot::default() });
    let dots: Vec<Mark> = points.iter().map(dot).collect();
    let line = if k < COLOURS { Mark::Line(points) } else { Mark::Dashes(points) };
    Layer {
        name: series.name.clone(),
        class: format!("s{}", k % COLOURS),
        marks: std::iter::once(line).chain(dots).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: Vec<[f64; 2]>) -> Plot {
        let lines = (0..9).map(|k| Series { name: format!("case <{k}>"), points: points.clone() }).collect();
        let log = Axis { label: "objective / mm²".into(), scale: Scale::Log };
        Plot { title: "a plot".into(), x: Axis { label: "iteration".into(), ..Axis::default() }, y: log, series: lines }
    }

    #[test]
    fn plot_svg_shows_every_line() {
        let svg = plot(vec![[0.0, 1e4], [1.0, 1.0], [2.0, 1e-18]]).to_svg().unwrap();
        let document = roxmltree::Document::parse(&svg).unwrap();
        assert_eq!(document.descendants().filter(|n| n.has_tag_name("polyline")).count(), 9);
        let texts: Vec<_> = document.descendants().filter_map(|n| n.text()).collect();
        for text in ["case <8>", "objective / mm²", "iteration", "a plot"] {
            assert!(texts.contains(&text), "{text} is not in {texts:?}");
        }
    }

    #[test]
    fn plot_refuses_unplottable_values() {
        let refused = |point| plot(vec![[0.0, 1.0], point]).to_svg().unwrap_err();
        assert!(matches!(refused([f64::NAN, 1.0]), ReportError::NotFinite { index: 1, what: "x", .. }));
        assert!(matches!(refused([1.0, f64::INFINITY]), ReportError::NotFinite { index: 1, what: "y", .. }));
        assert!(matches!(refused([1.0, 0.0]), ReportError::NoLogarithm { index: 1, what: "y", .. }));
        assert!(matches!(plot(Vec::new()).to_svg(), Err(ReportError::TooFewPoints { found: 0, .. })));
    }
}
