//! Line plots.

use std::path::Path;

use super::ReportError;
use super::axis::{Ruler, Scale};
use super::svg::{Anchor, Frame, LARGE, SMALL, Svg};
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

/// Okabe and Ito's colours, which people with colour blindness can distinguish. Their yellow is left out because its
/// contrast on white is too low.
const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];

const CORNER: [f64; 2] = [70.0, 44.0];
const SIZE: [f64; 2] = [520.0, 340.0];

impl Plot {
    /// Returns the plot as SVG.
    ///
    /// # Errors
    /// Fails if there are no points, if a number is not finite, or if a number on a logarithmic axis is not above 0.
    pub fn to_svg(&self) -> Result<String, ReportError> {
        let [x, y] = [self.ruler(0)?, self.ruler(1)?];
        let longest = self.series.iter().map(|s| s.name.chars().count()).max().unwrap_or(0);
        let [right, bottom] = [CORNER[0] + SIZE[0], CORNER[1] + SIZE[1]];
        let mut svg = Svg::new(right + 56.0 + 6.6 * longest as f64, bottom + 54.0);
        svg.text([CORNER[0], 24.0], Anchor::Start, LARGE, &self.title);
        svg.frame(&Frame {
            corner: CORNER,
            size: SIZE,
            x_ticks: x.ticks(self.max_x_ticks()),
            y_ticks: y.ticks(8),
            x_label: &self.x.label,
            y_label: &self.y.label,
            grid: true,
        });
        for (k, series) in self.series.iter().enumerate() {
            let pixels: Vec<[f64; 2]> = series.points.iter().map(|p| [x.pixel(p[0]), y.pixel(p[1])]).collect();
            draw(&mut svg, k, &pixels);
            let row = CORNER[1] + 12.0 + 20.0 * k as f64;
            draw(&mut svg, k, &[[right + 14.0, row], [right + 40.0, row]]);
            svg.text([right + 48.0, row + 4.0], Anchor::Start, SMALL, &series.name);
        }
        Ok(svg.finish())
    }

    /// Saves the plot as an SVG file at `path`.
    ///
    /// # Errors
    /// Fails if there are no points, if a number is not finite, if a number on a logarithmic axis is not above 0, or if
    /// the file cannot be written.
    pub fn save_svg(&self, path: &Path) -> Result<(), ReportError> {
        Ok(write_atomic(path, self.to_svg()?.as_bytes())?)
    }

    /// Returns the maximum number of ticks of the x axis. The number is 10, or less if all x values of the plot are
    /// integers. In that case it is the difference between the largest and the smallest x, limited to 1 to 10.
    fn max_x_ticks(&self) -> usize {
        const MAX: usize = 10;
        let all = || self.series.iter().flat_map(|series| &series.points).map(|point| point[0]);
        let [low, high] = super::range(all());
        if all().all(|x| x.fract() == 0.0) { ((high - low) as usize).clamp(1, MAX) } else { MAX }
    }

    /// Returns the mapping from plot coordinates to pixels for one axis: the x axis for `k` = 0, the y axis for `k` =
    /// 1. The range of the axis contains the points of all series. It is widened to begin and end at a tick.
    ///
    /// # Errors
    /// Fails if there are no points, if a number is not finite, or if a number on a logarithmic axis is not above 0.
    fn ruler(&self, k: usize) -> Result<Ruler, ReportError> {
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
        let pixels = if k == 0 { [CORNER[0], CORNER[0] + SIZE[0]] } else { [CORNER[1] + SIZE[1], CORNER[1]] };
        Ok(Ruler::new(axis.scale, [low, high], pixels).rounded(8))
    }
}

/// Draws a line through `pixels`, with a marker at each point. `k` is the index of the series; it selects colour,
/// marker and dashes.
fn draw(svg: &mut Svg, k: usize, pixels: &[[f64; 2]]) {
    let colour = COLOURS[k % COLOURS.len()];
    let dashes = if k < COLOURS.len() { "none" } else { "6 3" };
    svg.polyline(pixels, colour, dashes);
    for &pixel in pixels {
        svg.marker(pixel, k % 4, colour);
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
        assert_eq!(document.descendants().filter(|n| n.has_tag_name("polyline")).count(), 18);
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
