//! Error maps of a run as its report shows them: on the scale of the tolerance and on their own, with the sections
//! through their extremes and the distribution of their values.

use std::path::Path;

use super::axis::{Scale, fixed, round_limit};
use super::chart::{Chart, ChartAxis, Layer, Mark};
use super::colour::ColourMap;
use super::heat_map::HeatMap;
use super::run_history::RunHistory;
use super::texts::ReportText as Text;
use super::{ReportError, range};
use regrind_formats::{MapNode, escaped, read_error_map};
use regrind_language::{Language, decimal};

/// Maximum size of a map in pixels of the page.
const MAP: [f64; 2] = [250.0, 190.0];
/// Width and height of a chart in pixels of the page.
const CHART: [f64; 2] = [400.0, 180.0];
/// Number of bars of a distribution.
const BARS: usize = 41;

/// Filtered error map of a cycle.
pub(super) struct CycleMap {
    pub(super) cycle: u32,
    /// x and y in millimetres and the error in micrometres of each node.
    samples_um: Vec<[f64; 3]>,
}

/// Reads the maps of the first and of the last cycle that has one; only the last one if there is no other.
///
/// # Errors
/// Fails if the file of an error map cannot be read.
pub(super) fn read_maps(story: &RunHistory, folder: &Path) -> Result<Vec<CycleMap>, ReportError> {
    let mapped: Vec<(u32, &str)> =
        story.cycles.iter().filter_map(|(cycle, told)| Some((*cycle, told.map.as_ref()?.0.as_str()))).collect();
    let last = mapped.last().copied();
    let first = mapped.first().copied().filter(|_| mapped.len() > 1);
    let read = |(cycle, name): (u32, &str)| -> Result<CycleMap, ReportError> {
        let nodes = read_error_map(&folder.join(name))?;
        let samples_um = nodes.iter().map(MapNode::error).map(|[x, y, error_mm]| [x, y, 1e3 * error_mm]).collect();
        Ok(CycleMap { cycle, samples_um })
    };
    first.into_iter().chain(last).map(read).collect()
}

impl CycleMap {
    /// Returns the limit of the map's own scale, in micrometres.
    pub(super) fn own_limit_um(&self) -> f64 {
        let [low, high] = range(self.samples_um.iter().map(|s| s[2]));
        round_limit(low.abs().max(high.abs()))
    }

    /// Returns the distance of the nearest node from a place, in millimetres.
    pub(super) fn distance_mm(&self, [x, y]: [f64; 2]) -> f64 {
        self.samples_um.iter().map(|node| (node[0] - x).hypot(node[1] - y)).fold(f64::INFINITY, f64::min)
    }

    /// Returns the map as SVG, with the colours from `-limit_um` to `limit_um`. A map that cannot be drawn, for example
    /// because it has one node only, is a paragraph with the reason.
    ///
    /// # Errors
    /// Fails only if the drawing returns [`ReportError::File`].
    pub(super) fn picture(&self, limit_um: f64, language: Language) -> Result<String, ReportError> {
        let drawn = HeatMap::new("", "", "\u{b5}m", &self.samples_um)
            .and_then(|map| map.with_max_size(MAP).with_limit(limit_um)?.to_plain_svg(language));
        match drawn {
            Ok(svg) => Ok(within_html(&svg)),
            Err(ReportError::File(error)) => Err(error.into()),
            Err(reason) => Ok(format!("<p>{}</p>\n", escaped(&reason.to_string()))),
        }
    }

    /// Returns two charts of the error: along x and along y, each through the lowest and the highest node.
    pub(super) fn sections(&self, language: Language) -> [String; 2] {
        let by_value = |a: &&[f64; 3], b: &&[f64; 3]| a[2].total_cmp(&b[2]);
        let samples = &self.samples_um;
        let extremes = [samples.iter().max_by(by_value), samples.iter().min_by(by_value)];
        let limit = self.own_limit_um();
        let number = |value: f64, decimals: usize| decimal(value, decimals, language);
        [0, 1].map(|along| {
            let across = 1 - along;
            let line = |extreme: &[f64; 3]| {
                // Nodes of one row are written with identical coordinates.
                let on_line = samples.iter().filter(|s| (s[across] - extreme[across]).abs() < 1e-6);
                let mut points: Vec<[f64; 2]> = on_line.map(|s| [s[along], s[2]]).collect();
                points.sort_by(|a, b| a[0].total_cmp(&b[0]));
                pieces(&points)
            };
            let title = [Text::SectionAlongX, Text::SectionAlongY][along].to(language);
            let layers: Vec<Layer> = extremes
                .iter()
                .flatten()
                .zip(["s1", "s0"])
                .map(|(extreme, class)| Layer {
                    name: format!("{} mm: {}", number(extreme[across], 2), signed(extreme[2], language)),
                    class: class.to_owned(),
                    marks: line(extreme).into_iter().map(Mark::Line).collect(),
                })
                .collect();
            let ends = range(samples.iter().map(|s| s[along]));
            let chart = Chart {
                title: title.to_owned(),
                size: CHART,
                right_margin: 190.0,
                x: ChartAxis::new("mm", Scale::Linear, ends, 6, &number),
                y: ChartAxis::new("\u{b5}m", Scale::Linear, [-limit, limit], 6, &number),
                layers,
                has_legend: true,
                ..Chart::default()
            };
            chart.to_markup()
        })
    }

    /// Returns the distribution of the error over the nodes. Each bar has the colour that the map gives its error.
    pub(super) fn distribution(&self, language: Language) -> String {
        let limit = self.own_limit_um();
        let mut counts = [0_usize; BARS];
        for [.., error] in &self.samples_um {
            let share = (error / limit + 1.0) / 2.0;
            counts[((share * BARS as f64) as usize).min(BARS - 1)] += 1;
        }
        let most = counts.iter().copied().max().unwrap_or(0).max(1) as f64;
        let edge = |k: usize| limit * (2.0 * k as f64 / BARS as f64 - 1.0);
        let bar = |(k, count): (usize, &usize)| Mark::Bar {
            class: "",
            fill: Some(ColourMap::Diverging.at((k as f64 + 0.5) / BARS as f64)),
            x: [edge(k), edge(k + 1)],
            y: [0.0, *count as f64],
            tooltip: String::new(),
        };
        let marks = counts.iter().enumerate().map(bar).collect();
        let number = |value: f64, decimals: usize| decimal(value, decimals, language);
        let nodes = Text::Nodes.to(language);
        let chart = Chart {
            title: format!("{}: {} {nodes}", Text::Distribution.to(language), self.samples_um.len()),
            size: CHART,
            right_margin: 30.0,
            x: ChartAxis::new(Text::ErrorAxis.to(language), Scale::Linear, [-limit, limit], 8, &number),
            y: ChartAxis::new(nodes, Scale::Linear, [0.0, most], 4, &fixed),
            layers: vec![Layer { marks, ..Layer::default() }],
            ..Chart::default()
        };
        chart.to_markup()
    }
}

/// Divides a section where nodes are missing, so that no line crosses a place that was not measured.
fn pieces(points: &[[f64; 2]]) -> Vec<Vec<[f64; 2]>> {
    let steps = || points.windows(2).map(|pair| pair[1][0] - pair[0][0]).filter(|step| *step > 0.0);
    let usual = steps().fold(f64::INFINITY, f64::min);
    let is_joined = |a: &[f64; 2], b: &[f64; 2]| b[0] - a[0] < 1.5 * usual;
    points.chunk_by(is_joined).map(<[[f64; 2]]>::to_vec).collect()
}

/// Formats an error in micrometres with its sign.
fn signed(um: f64, language: Language) -> String {
    let sign = if um < 0.0 { "" } else { "+" };
    format!("{sign}{} \u{b5}m", decimal(um, 2, language))
}

/// Removes the XML namespace from an SVG, because an SVG within an HTML page does not need it.
pub(super) fn within_html(svg: &str) -> String {
    svg.replacen(" xmlns=\"http://www.w3.org/2000/svg\"", "", 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map() -> CycleMap {
        let node = |k: usize| {
            let [x, y] = [(k % 5) as f64, (k / 5) as f64];
            [x, y, if k == 7 { 4.2 } else { 0.1 * x - y }]
        };
        CycleMap { cycle: 2, samples_um: (0..20).map(node).collect() }
    }

    #[test]
    fn own_limit_is_round() {
        assert_eq!(map().own_limit_um(), 5.0);
    }

    /// The highest node is the eighth, at x = 2 and y = 1; the lowest is at x = 0 and y = 3.
    #[test]
    fn sections_go_through_extremes() {
        let [along_x, along_y] = map().sections(Language::De);
        for svg in [&along_x, &along_y] {
            roxmltree::Document::parse(svg).unwrap();
            assert_eq!(svg.matches("<polyline").count(), 2, "{svg}");
        }
        assert!(
            along_x.contains("1,00 mm: +4,20 \u{b5}m") && along_x.contains("3,00 mm: \u{2212}3,00 \u{b5}m"),
            "{along_x}"
        );
        assert!(along_y.contains("2,00 mm: +4,20") && along_y.contains("0,00 mm: \u{2212}3,00"), "{along_y}");
    }

    #[test]
    fn section_ends_at_missing_nodes() {
        let points = [[0.0, 1.0], [1.0, 2.0], [3.0, 4.0], [4.0, 5.0], [5.0, 6.0]];
        assert_eq!(pieces(&points), [points[..2].to_vec(), points[2..].to_vec()]);
        assert_eq!(pieces(&points[..1]), [points[..1].to_vec()]);
        assert!(pieces(&[]).is_empty());
    }

    #[test]
    fn distribution_counts_every_node_once() {
        let svg = map().distribution(Language::En);
        roxmltree::Document::parse(&svg).unwrap();
        assert!(svg.contains("20 nodes") && !svg.contains("NaN"), "{svg}");
        assert_eq!(svg.matches("<rect").count(), BARS, "bars");
        let flat = CycleMap { cycle: 1, samples_um: vec![[0.0, 0.0, 0.0]; 3] };
        assert!(!flat.distribution(Language::En).contains("NaN"));
        assert!(flat.picture(1.0, Language::En).unwrap().starts_with("<p>"), "one place is no map");
    }

    #[test]
    fn picture_marks_extremes() {
        let svg = map().picture(5.0, Language::En).unwrap();
        roxmltree::Document::parse(&svg).unwrap();
        assert!(svg.contains("+4.20") && svg.contains("\u{2212}3.00") && svg.contains("\u{b5}m"), "{svg}");
    }
}
