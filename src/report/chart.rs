//! Charts as SVG: lines, bands, points, bars and limits over one pair of axes. The page, the report, the plant and the
//! files of plots draw with this module.
//!
//! ```text
//!  layers (points in the units of the axes) --> places in pixels --> elements with classes --> SVG in a page
//!                                                                     + colours for paper ---> SVG in a file
//! ```
//!
//! A chart names its colours by classes, such as `pv` or `limit`. The style sheet of a page gives the colours, so that a
//! chart follows the theme of the page. A chart in a file contains the colours itself. The same chart always gives the
//! same bytes.

use std::fmt::Write;

use super::axis::{Ruler, Scale, label};
use regrind_formats::escaped;

/// Chart: layers over one pair of axes.
#[derive(Clone, Debug, Default)]
pub struct Chart {
    /// All that the chart shows, as a text for a screen reader.
    pub description: String,
    /// Title above the axes; empty for none.
    pub title: String,
    /// Width and height in pixels.
    pub size: [f64; 2],
    /// Width in pixels of the space to the right of the axes, for names.
    pub right_margin: f64,
    /// Horizontal axis, to the right.
    pub x: ChartAxis,
    /// Vertical axis, upwards.
    pub y: ChartAxis,
    /// Layers, from the lowest to the highest.
    pub layers: Vec<Layer>,
    /// True if the names of the layers are listed to the right of the axes.
    pub has_legend: bool,
}

/// Axis of a chart.
#[derive(Clone, Debug, Default)]
pub struct ChartAxis {
    /// Label with the unit; empty for none.
    pub label: String,
    /// Scale of the axis, linear or logarithmic.
    pub scale: Scale,
    /// Coordinates at both ends.
    pub range: [f64; 2],
    /// Coordinate and text of each tick.
    pub ticks: Vec<(f64, String)>,
    /// Times of the ticks, such as `2026-07-04T12:00:00Z`, for the scripts of a page, which show them in the time zone of
    /// the reader; empty for an axis without times.
    pub times: Vec<String>,
    /// Parts of the times that the scripts show: `day`, `hour` (with the day) or `minute` (without it).
    pub time_style: &'static str,
}

/// Formats a number with a number of decimals.
pub type NumberFormat<'a> = &'a dyn Fn(f64, usize) -> String;

/// Layer of a chart.
#[derive(Clone, Debug, Default)]
pub struct Layer {
    /// Name in the legend; empty for none.
    pub name: String,
    /// Class of all marks of the layer, which decides their colour.
    pub class: String,
    /// Marks, from the lowest to the highest.
    pub marks: Vec<Mark>,
}

/// Mark of a layer, in the units of the axes.
#[derive(Clone, Debug)]
pub enum Mark {
    /// Points, joined in this order.
    Line(Vec<[f64; 2]>),
    /// Points, joined by a dashed line.
    Dashes(Vec<[f64; 2]>),
    /// Points, joined in this order, of a stepped tolerance.
    Steps(Vec<[f64; 2]>),
    /// Area between two lines: x, lower and upper y of each place.
    Band(Vec<[f64; 3]>),
    /// Horizontal line over the whole width, with a name to the right.
    Across {
        /// Class of the line, such as `limit`.
        class: &'static str,
        /// Name; empty for none.
        name: String,
        /// Place on the vertical axis.
        at: f64,
    },
    /// Point.
    Dot(Dot),
    /// Rectangle.
    Bar {
        /// Class of the rectangle; its colour, unless `fill` gives one.
        class: &'static str,
        /// Colour.
        fill: Option<[u8; 3]>,
        /// Its two ends along the horizontal axis.
        x: [f64; 2],
        /// Its two ends along the vertical axis.
        y: [f64; 2],
        /// Text that is shown at the pointer; empty for none.
        tooltip: String,
    },
    /// Text, with its middle at a place.
    Text {
        /// Place of its base line.
        at: [f64; 2],
        /// Text.
        text: String,
    },
}

/// Point of a layer.
#[derive(Clone, Debug, Default)]
pub struct Dot {
    /// Place.
    pub at: [f64; 2],
    /// Shape.
    pub shape: Shape,
    /// Text that is shown at the pointer; empty for none.
    pub tooltip: String,
    /// Address to which the point leads; empty for none.
    pub link: String,
}

/// Shape of a point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Shape {
    /// Disc.
    #[default]
    Disc,
    /// Small disc, for many points.
    Small,
    /// Circle, for values that are not measured.
    Hollow,
    /// Square.
    Square,
    /// Triangle.
    Triangle,
    /// Diamond.
    Diamond,
    /// Large triangle, for values that call for attention.
    Out,
}

impl ChartAxis {
    /// Creates an axis over `range` with at most `max_ticks` steps between ticks at round numbers, which `number`
    /// formats. Ticks of a logarithmic axis are at 1, 2 and 5 times the powers of ten, or at the powers of ten where
    /// these would be too many.
    pub fn new(label: &str, scale: Scale, range: [f64; 2], max_ticks: usize, number: NumberFormat) -> Self {
        let ticks = match scale {
            Scale::Linear => Ruler::new(scale, range, range).round_coordinates(max_ticks),
            Scale::Log => log_ticks(range, max_ticks),
        };
        let text = |(value, decimals): (f64, Option<usize>)| {
            (value, decimals.map_or_else(|| label_of_power(value), |decimals| number(value, decimals)))
        };
        Self { label: label.to_owned(), scale, range, ticks: ticks.into_iter().map(text).collect(), ..Self::default() }
    }

    /// Creates a linear axis from the integer `first` to `last`, with half a step more at both ends. Its ticks are the
    /// multiples of 1, 2, 5, 10 and so on, so that there are at most `max_ticks`.
    pub fn of_integers(label: &str, [first, last]: [u32; 2], max_ticks: usize) -> Self {
        let steps = (0..9).flat_map(|power| [1, 2, 5].map(|step| step * 10_usize.pow(power)));
        let count = (last.max(first) - first) as usize + 1;
        let step = steps.into_iter().find(|step| count.div_ceil(*step) <= max_ticks.max(1)).unwrap_or(count);
        let is_tick = |at: &u32| (*at as usize).is_multiple_of(step);
        let ticks = (first..=last.max(first)).filter(is_tick).map(|at| (f64::from(at), at.to_string())).collect();
        let range = [f64::from(first) - 0.5, f64::from(last.max(first)) + 0.5];
        Self { label: label.to_owned(), scale: Scale::Linear, range, ticks, ..Self::default() }
    }

    fn ruler(&self, pixels: [f64; 2]) -> Ruler {
        Ruler::new(self.scale, self.range, pixels)
    }
}

/// Returns the ticks of a logarithmic axis: 1, 2 and 5 times the powers of ten within `range`, with their decimals. If
/// these are more than `max_ticks`, only powers of ten are returned, and every second, third... of them. A power that
/// needs more than four decimals or six digits has no number of decimals.
fn log_ticks([low, high]: [f64; 2], max_ticks: usize) -> Vec<(f64, Option<usize>)> {
    if !(low > 0.0 && high > low && high.is_finite()) {
        return Vec::new();
    }
    let (from, to) = (low.log10().floor() as i32, high.log10().ceil() as i32);
    let is_within = |value: &f64| (low * (1.0 - 1e-9)..=high * (1.0 + 1e-9)).contains(value);
    let of = |powers: &mut dyn Iterator<Item = i32>, steps: &[f64]| -> Vec<(f64, Option<usize>)> {
        let all = powers.flat_map(|power| steps.iter().map(move |step| (step * 10f64.powi(power), power)));
        all.filter(|(value, _)| is_within(value))
            .map(|(value, power)| (value, (-4..=5).contains(&power).then(|| (-power).max(0) as usize)))
            .collect()
    };
    let fine = of(&mut (from..=to), &[1.0, 2.0, 5.0]);
    if fine.len() <= max_ticks {
        return fine;
    }
    let coarse = |every: i32| of(&mut (from..=to).filter(|power| power.rem_euclid(every) == 0), &[1.0]);
    (1..100).map(coarse).find(|ticks| ticks.len() <= max_ticks.max(1)).unwrap_or_default()
}

/// Returns the text of a power of ten, such as "1e−9".
fn label_of_power(value: f64) -> String {
    label(value, 1e-9)
}

/// Margins of the axes in pixels: left, above and below, without the label of the horizontal axis and without a title.
const LEFT: f64 = 52.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 24.0;
/// Height of a line of text in pixels.
const LINE: f64 = 16.0;

/// Colours for paper, of a chart in a file. The hues are those of Okabe and Ito, which people with colour blindness can
/// distinguish; their yellow is left out because its contrast on white is too low.
pub(super) const PAPER: &str = "text{fill:#222;font-family:Helvetica,Arial,sans-serif;font-size:12px}.title{font-size:15px}.tick,.label{fill:#444}\
.grid{stroke:#ddd}.axis{fill:none;stroke:#444}.line,.dashes{fill:none;stroke-width:1.6}.dashes{stroke-dasharray:6 3}\
.band{fill-opacity:.2;stroke:none}.limit{stroke-dasharray:7 4;stroke-width:1.5}.bar{stroke:#222;stroke-width:.4}\
.pv .line,.pv .dashes,.pv .limit{stroke:#0072b2}.pv .dot,.pv .band,.pv .name{fill:#0072b2}\
.rms .line,.rms .dashes,.rms .limit{stroke:#a85400}.rms .dot,.rms .band,.rms .name{fill:#a85400}\
.s0 *{stroke:#0072b2}.s0 .dot{fill:#0072b2}.s1 *{stroke:#d55e00}.s1 .dot{fill:#d55e00}.s2 *{stroke:#009e73}.s2 .dot{fill:#009e73}\
.s3 *{stroke:#cc79a7}.s3 .dot{fill:#cc79a7}.s4 *{stroke:#e69f00}.s4 .dot{fill:#e69f00}.s5 *{stroke:#56b4e9}.s5 .dot{fill:#56b4e9}\
.s6 *{stroke:#000}.s6 .dot{fill:#000}.layer text{stroke:none!important}.layer .dot{stroke:none}.dot.hollow{fill:#fff!important;stroke:#222}";

impl Chart {
    /// Returns the chart as an SVG element of a page. The style sheet of the page gives the colours of its classes.
    pub fn to_markup(&self) -> String {
        self.drawn("class=\"chart\"", "")
    }

    /// Returns the chart as an SVG document for a file, with white paper and its own colours.
    pub fn to_file(&self) -> String {
        let [width, height] = self.size;
        let attributes = format!("xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\"");
        let paper = "<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>";
        self.drawn(&attributes, &format!("<style>{PAPER}</style>\n{paper}\n"))
    }

    fn drawn(&self, attributes: &str, before: &str) -> String {
        let [width, height] = self.size;
        let mut out = Output::default();
        let description = if self.description.is_empty() { &self.title } else { &self.description };
        out.put(format_args!(
            "<svg {attributes} viewBox=\"0 0 {width:.0} {height:.0}\" role=\"img\" aria-label=\"{}\">\n{before}",
            attribute(description)
        ));
        let area = self.area();
        if !self.title.is_empty() {
            out.text("title", [area.left, 18.0], "start", &self.title);
        }
        self.draw_axes(&area, &mut out);
        self.draw_names(&area, &mut out);
        for layer in &self.layers {
            out.put(format_args!("<g class=\"layer {}\">\n", attribute(&layer.class)));
            layer.marks.iter().for_each(|mark| draw_mark(mark, &area, &mut out));
            out.put(format_args!("</g>\n"));
        }
        out.put(format_args!("</svg>\n"));
        out.text
    }

    fn area(&self) -> Area {
        let [width, height] = self.size;
        let top = TOP + if self.title.is_empty() { 0.0 } else { LINE };
        let bottom = height - BOTTOM - if self.x.label.is_empty() { 0.0 } else { LINE };
        let left = LEFT + if self.y.label.is_empty() { 0.0 } else { LINE };
        let right = width - self.right_margin.max(8.0);
        Area { left, right, top, bottom, x: self.x.ruler([left, right]), y: self.y.ruler([bottom, top]) }
    }

    fn draw_axes(&self, area: &Area, out: &mut Output) {
        let Area { left, right, top, bottom, .. } = *area;
        for (value, text) in &self.y.ticks {
            let y = area.y.pixel(*value);
            out.line("grid", [left, y], [right, y]);
            out.text("tick", [left - 6.0, y + 4.0], "end", text);
        }
        for (k, (value, text)) in self.x.ticks.iter().enumerate() {
            let x = area.x.pixel(*value);
            out.line("grid", [x, bottom], [x, bottom + 4.0]);
            match self.x.times.get(k) {
                Some(time) => out.time([x, bottom + 17.0], text, time, self.x.time_style),
                None => out.text("tick", [x, bottom + 17.0], "middle", text),
            }
        }
        out.line("grid", [left, bottom], [right, bottom]);
        if !self.x.label.is_empty() {
            out.text("label", [0.5 * (left + right), bottom + 17.0 + LINE], "middle", &self.x.label);
        }
        if !self.y.label.is_empty() {
            let middle = 0.5 * (top + bottom);
            out.put(format_args!(
                "<text class=\"label\" transform=\"translate(12 {middle:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>\n",
                escaped(&self.y.label)
            ));
        }
    }

    /// Draws the legend, or the names of the horizontal lines, which are moved apart where they would overlap.
    fn draw_names(&self, area: &Area, out: &mut Output) {
        let right = area.right;
        if self.has_legend {
            for (row, layer) in self.layers.iter().filter(|layer| !layer.name.is_empty()).enumerate() {
                let y = area.top + 10.0 + 20.0 * row as f64;
                out.put(format_args!("<g class=\"layer {}\">\n", attribute(&layer.class)));
                let is_dashed = layer.marks.iter().any(|mark| matches!(mark, Mark::Dashes(_)));
                out.line(if is_dashed { "dashes" } else { "line" }, [right + 12.0, y], [right + 36.0, y]);
                if let Some(Mark::Dot(dot)) = layer.marks.iter().find(|mark| matches!(mark, Mark::Dot(_))) {
                    out.shape(dot.shape, [right + 24.0, y], "");
                }
                out.text("name", [right + 44.0, y + 4.0], "start", &layer.name);
                out.put(format_args!("</g>\n"));
            }
            return;
        }
        let across = self.layers.iter().flat_map(|layer| layer.marks.iter().map(move |mark| (&layer.class, mark)));
        let named: Vec<(&String, &str, &String, f64)> = across
            .filter_map(|(layer, mark)| match mark {
                Mark::Across { class, name, at } if !name.is_empty() => Some((layer, *class, name, area.y.pixel(*at))),
                _ => None,
            })
            .collect();
        let places = apart(named.iter().map(|(.., y)| *y).collect());
        for ((layer, class, name, _), y) in named.into_iter().zip(places) {
            out.put(format_args!("<g class=\"layer {}\">\n", attribute(layer)));
            out.text(&format!("name of-{class}"), [right + 6.0, y + 4.0], "start", name);
            out.put(format_args!("</g>\n"));
        }
    }
}

/// Escapes a text for an attribute between quotation marks.
fn attribute(text: &str) -> String {
    escaped(text).replace('"', "&quot;")
}

/// Moves labels upwards until they do not overlap. `at` contains the y coordinate of each label in pixels, measured
/// downwards from the top. Returns the new coordinates in the same order. The lowest label keeps its position.
fn apart(mut at: Vec<f64>) -> Vec<f64> {
    let mut order: Vec<usize> = (0..at.len()).collect();
    order.sort_by(|a, b| at[*b].total_cmp(&at[*a]));
    for pair in order.windows(2) {
        at[pair[1]] = at[pair[1]].min(at[pair[0]] - 14.0);
    }
    at
}

/// Rectangle between the axes, in pixels, and the places of coordinates in it.
struct Area {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
    x: Ruler,
    y: Ruler,
}

impl Area {
    /// Returns the place of a point. A point above or below the axes is drawn at their edge.
    fn place(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [self.x.pixel(x), self.height(y)]
    }

    fn height(&self, y: f64) -> f64 {
        let pixel = self.y.pixel(y);
        // A value at or below 0 has no place on a logarithmic axis; it is drawn at the lower edge.
        if pixel.is_nan() { self.bottom } else { pixel.clamp(self.top, self.bottom) }
    }
}

fn draw_mark(mark: &Mark, area: &Area, out: &mut Output) {
    match mark {
        Mark::Line(points) => out.polyline("line", points.iter().map(|point| area.place(*point))),
        Mark::Dashes(points) => out.polyline("dashes", points.iter().map(|point| area.place(*point))),
        Mark::Steps(points) => out.polyline("steps", points.iter().map(|point| area.place(*point))),
        Mark::Band(places) => {
            let above = places.iter().map(|[x, _, high]| area.place([*x, *high]));
            let below = places.iter().rev().map(|[x, low, _]| area.place([*x, *low]));
            let list = joined(above.chain(below));
            out.put(format_args!("<polygon class=\"band\" points=\"{list}\"/>\n"));
        }
        Mark::Across { class, at, .. } => {
            let y = area.height(*at);
            out.line(class, [area.left, y], [area.right, y]);
        }
        Mark::Dot(dot) => {
            if !dot.link.is_empty() {
                out.put(format_args!("<a href=\"{}\">", attribute(&dot.link)));
            }
            out.shape(dot.shape, area.place(dot.at), &dot.tooltip);
            if !dot.link.is_empty() {
                out.put(format_args!("</a>\n"));
            }
        }
        Mark::Bar { class, fill, x, y, tooltip } => {
            let [[x0, y0], [x1, y1]] = [area.place([x[0], y[0]]), area.place([x[1], y[1]])];
            let fill = fill.map_or(String::new(), |[r, g, b]| format!(" fill=\"#{r:02x}{g:02x}{b:02x}\""));
            let [left, top, width, height] = [x0.min(x1), y0.min(y1), (x1 - x0).abs(), (y1 - y0).abs()];
            out.put(format_args!(
                "<rect class=\"bar {class}\"{fill} x=\"{left:.1}\" y=\"{top:.1}\" width=\"{width:.1}\" height=\"{height:.1}\">{}</rect>\n",
                tooltip_element(tooltip)
            ));
        }
        Mark::Text { at, text } => {
            let [x, y] = area.place(*at);
            out.text("count", [x, y], "middle", text);
        }
    }
}

fn joined(points: impl Iterator<Item = [f64; 2]>) -> String {
    let mut list = String::new();
    for [x, y] in points {
        write!(list, "{x:.1},{y:.1} ").expect("writing to a string cannot fail");
    }
    list.truncate(list.trim_end().len());
    list
}

fn tooltip_element(text: &str) -> String {
    if text.is_empty() { String::new() } else { format!("<title>{}</title>", escaped(text)) }
}

/// Text of an SVG that is being written: coordinates in pixels, y downwards, one decimal.
#[derive(Default)]
struct Output {
    text: String,
}

impl Output {
    fn put(&mut self, arguments: std::fmt::Arguments) {
        self.text.write_fmt(arguments).expect("writing to a string cannot fail");
    }

    fn line(&mut self, class: &str, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
        self.put(format_args!(
            "<line class=\"{class}\" x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>\n"
        ));
    }

    fn polyline(&mut self, class: &str, points: impl Iterator<Item = [f64; 2]>) {
        let list = joined(points);
        self.put(format_args!("<polyline class=\"{class}\" points=\"{list}\"/>\n"));
    }

    fn text(&mut self, class: &str, [x, y]: [f64; 2], anchor: &str, text: &str) {
        let text = escaped(text);
        self.put(format_args!(
            "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>\n"
        ));
    }

    /// Draws the text of a tick at a time.
    fn time(&mut self, [x, y]: [f64; 2], text: &str, time: &str, style: &str) {
        let (text, time) = (escaped(text), attribute(time));
        self.put(format_args!(
            "<text class=\"tick\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"middle\" data-time=\"{time}\" data-style=\"{style}\">{text}</text>\n"
        ));
    }

    fn shape(&mut self, shape: Shape, [x, y]: [f64; 2], tooltip: &str) {
        let title = tooltip_element(tooltip);
        let (class, outline) = match shape {
            Shape::Disc | Shape::Small | Shape::Hollow => {
                let (class, radius) = match shape {
                    Shape::Hollow => ("dot hollow", 4.0),
                    Shape::Small => ("dot", 3.0),
                    _ => ("dot", 4.0),
                };
                return self.put(format_args!(
                    "<circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\">{title}</circle>\n"
                ));
            }
            Shape::Square => ("dot", "m-3.2,-3.2h6.4v6.4h-6.4z"),
            Shape::Triangle => ("dot", "m0,-4.4l4.2,7.4h-8.4z"),
            Shape::Diamond => ("dot", "m0,-4.6l4,4.6l-4,4.6l-4,-4.6z"),
            Shape::Out => ("out", "m0,-8l7,12h-14z"),
        };
        self.put(format_args!("<path class=\"{class}\" d=\"M{x:.1},{y:.1}{outline}\">{title}</path>\n"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixed(value: f64, decimals: usize) -> String {
        format!("{value:.decimals$}").replace('.', ",")
    }

    fn chart(layers: Vec<Layer>) -> Chart {
        Chart {
            description: "a <b> \"c\"".into(),
            size: [160.0, 96.0],
            right_margin: 8.0,
            x: ChartAxis::of_integers("", [1, 3], 10),
            y: ChartAxis::new("", Scale::Linear, [0.0, 6.0], 3, &fixed),
            layers,
            ..Chart::default()
        }
    }

    /// The axes take the pixels 52 to 152 along x and 72 to 12 along y: x = 0.5 to 3.5, y = 0 to 6.
    #[test]
    fn marks_at_their_pixels() {
        let marks = vec![
            Mark::Line(vec![[0.5, 0.0], [2.0, 3.0], [3.5, 6.0]]),
            Mark::Band(vec![[0.5, 0.0, 6.0], [3.5, 3.0, 9.0]]),
            Mark::Across { class: "limit", name: "limit".into(), at: 4.5 },
            Mark::Dot(Dot { at: [2.0, 3.0], tooltip: "3 & more".into(), ..Dot::default() }),
            Mark::Bar { class: "", fill: Some([255, 0, 1]), x: [0.5, 2.0], y: [0.0, 3.0], tooltip: String::new() },
        ];
        let svg = chart(vec![Layer { class: "pv".into(), marks, ..Layer::default() }]).to_file();
        roxmltree::Document::parse(&svg).unwrap();
        for piece in [
            "points=\"52.0,72.0 102.0,42.0 152.0,12.0\"",
            // The upper end of the band leaves the axes and is cut at their edge.
            "points=\"52.0,12.0 152.0,12.0 152.0,42.0 52.0,72.0\"",
            "class=\"limit\" x1=\"52.0\" y1=\"27.0\" x2=\"152.0\" y2=\"27.0\"",
            "cx=\"102.0\" cy=\"42.0\" r=\"4\"><title>3 &amp; more</title>",
            "fill=\"#ff0001\" x=\"52.0\" y=\"42.0\" width=\"50.0\" height=\"30.0\"",
            "aria-label=\"a &lt;b&gt; &quot;c&quot;\"",
        ] {
            assert!(svg.contains(piece), "{piece}: {svg}");
        }
    }

    #[test]
    fn ticks_have_their_times() {
        let ticks = vec![(1.0, "07-04".to_owned()), (3.0, "07-05".to_owned())];
        let times = vec!["2026-07-04T12:00:00Z".to_owned(), "2026-07-05\"".to_owned()];
        let x = ChartAxis { range: [0.5, 3.5], ticks, times, time_style: "day", ..ChartAxis::default() };
        let svg = Chart { x, ..chart(Vec::new()) }.to_markup();
        assert!(svg.contains("x=\"68.7\" y=\"89.0\" text-anchor=\"middle\" data-time=\"2026-07-04T12:00:00Z\" data-style=\"day\">07-04<"), "{svg}");
        assert!(svg.contains("data-time=\"2026-07-05&quot;\""), "{svg}");
    }

    #[test]
    fn values_without_place_at_lower_edge() {
        let log = ChartAxis::new("", Scale::Log, [0.1, 10.0], 9, &fixed);
        let line = Mark::Line(vec![[1.0, 0.0], [2.0, 1.0], [3.0, -5.0]]);
        let svg = Chart { y: log, ..chart(vec![Layer { marks: vec![line], ..Layer::default() }]) }.to_markup();
        assert!(svg.contains("68.7,72.0 102.0,42.0 135.3,72.0") && !svg.contains("NaN"), "{svg}");
    }

    #[test]
    fn ticks_of_each_scale() {
        let texts = |axis: ChartAxis| axis.ticks.into_iter().map(|(_, text)| text).collect::<Vec<_>>();
        let of = |scale, range, most| texts(ChartAxis::new("", scale, range, most, &fixed));
        assert_eq!(of(Scale::Linear, [0.0, 1.0], 5), ["0,0", "0,2", "0,4", "0,6", "0,8", "1,0"]);
        assert_eq!(of(Scale::Log, [0.3, 12.0], 9), ["0,5", "1", "2", "5", "10"]);
        assert_eq!(of(Scale::Log, [1e-9, 1e3], 6), ["1e\u{2212}8", "1e\u{2212}6", "0,0001", "0,01", "1", "100"]);
        assert_eq!(of(Scale::Log, [0.0, 1.0], 6), [""; 0], "no logarithm of 0");
        assert_eq!(texts(ChartAxis::of_integers("", [1, 5], 10)), ["1", "2", "3", "4", "5"]);
        assert_eq!(
            texts(ChartAxis::of_integers("", [1, 100], 10)),
            ["10", "20", "30", "40", "50", "60", "70", "80", "90", "100"]
        );
        assert_eq!(texts(ChartAxis::of_integers("", [7, 7], 10)), ["7"]);
    }

    #[test]
    fn names_do_not_overlap() {
        assert_eq!(apart(vec![50.0, 48.0, 20.0]), [50.0, 36.0, 20.0]);
        assert_eq!(apart(vec![30.0, 32.0, 31.0]), [4.0, 32.0, 18.0]);
    }
}
