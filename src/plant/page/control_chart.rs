//! Control charts of individuals and their moving ranges (W. A. Shewhart; ISO 7870-2, individuals; NIST/SEMATECH
//! e-Handbook of Statistical Methods, 6.3.2.2).
//!
//! With n values x in the order of measurement, and the moving ranges MR = |x(i) - x(i-1)|: the centre is the mean of
//! x, the limits are at 2.660 mean MR from the centre (3 / d2, d2 = 1.128 for two values), and a range is out of
//! control above 3.267 mean MR (D4). Units: micrometres.

use jiff::civil::DateTime;
use maud::{Markup, PreEscaped};
use regrind_language::{Language, decimal, filled};
use regrind_report::{Chart, ChartAxis, Dot, Layer, Mark, Scale, Shape};

use super::nelson::{Broken, Zones};
use super::texts::Text;
use super::words::{rfc3339, shown};

/// Constants 3 / d2, d2 (1.128) and D4 for ranges of two values. A point is beyond 3 sigma exactly if it is out of the
/// limits.
const E2: f64 = 2.660;
pub(super) const D2: f64 = 3.0 / E2;
const D4: f64 = 3.267;
/// Minimum number of values for limits. Limits of fewer values change much with the next values.
pub(super) const ENOUGH: usize = 20;

/// Width of a chart and the space to the right of its axes, in pixels.
const WIDTH: f64 = 900.0;
const RIGHT: f64 = 150.0;
/// Room above and below the values of a chart, and the distance above them within which a tolerance is drawn, as shares
/// of the height that the values and the control limits take.
const ROOM: f64 = 0.06;
const TOLERANCE_WITHIN: f64 = 1.0;

/// Figure of a part.
#[derive(Clone, Debug)]
pub(super) struct Value {
    pub(super) run: i32,
    pub(super) serial: String,
    pub(super) cell: String,
    pub(super) when: String,
    pub(super) um: f64,
    /// Expanded uncertainty of the figure, and its tolerance.
    pub(super) u_um: Option<f64>,
    pub(super) limit_um: Option<f64>,
}

/// Control limits of values from one process.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Limits {
    pub(super) mean: f64,
    pub(super) mean_range: f64,
    pub(super) upper: f64,
    /// Lower limit; `None` if it would be below 0, because a peak-to-valley value is never negative.
    pub(super) lower: Option<f64>,
    pub(super) range_upper: f64,
}

impl Limits {
    /// Computes the control limits from `values` in the order of measurement. The result contains the mean, the mean
    /// moving range, and the control limits of both. A moving range is the absolute difference of two consecutive
    /// values. All results have the unit of `values`. Returns `None` if there are fewer than two values.
    pub(super) fn from_values(values: &[f64]) -> Option<Self> {
        let ranges = ranges(values);
        if ranges.is_empty() {
            return None;
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let mean_range = ranges.iter().sum::<f64>() / ranges.len() as f64;
        Some(Self {
            mean,
            mean_range,
            upper: mean + E2 * mean_range,
            lower: Some(mean - E2 * mean_range).filter(|lower| *lower > 0.0),
            range_upper: D4 * mean_range,
        })
    }

    /// Returns sigma within the process, from the mean moving range.
    pub(super) fn sigma(&self) -> f64 {
        self.mean_range / D2
    }

    /// Returns the mean and sigma for the rules of Nelson.
    pub(super) fn zones(&self) -> Zones {
        Zones { mean: self.mean, sigma: self.sigma() }
    }
}

/// Returns the moving ranges: the absolute differences of consecutive values. They are one fewer than the values.
pub(super) fn ranges(values: &[f64]) -> Vec<f64> {
    values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect()
}

/// Figure over the parts of a chart, with the words of the page.
#[derive(Clone, Copy)]
pub(super) struct Figure<'a> {
    /// Name of the figure, such as PV, and the class of its points.
    pub(super) name: &'a str,
    pub(super) class: &'a str,
    /// Parts in the order of measurement; not empty.
    pub(super) values: &'a [Value],
    pub(super) limits: &'a Limits,
    pub(super) language: Language,
}

impl Figure<'_> {
    /// Returns a horizontal line of a chart, with its name and its value.
    fn across(&self, class: &'static str, name: Text, at: f64) -> Mark {
        Mark::Across { class, name: format!("{} {}", name.to(self.language), decimal(at, 2, self.language)), at }
    }

    fn um(&self) -> Vec<f64> {
        self.values.iter().map(|value| value.um).collect()
    }

    /// Draws the control chart of individual values in µm as SVG: each part is one point, with the mean, the control
    /// limits, the zones of one and two sigma, and the tolerance of each part. `broken` has the rules that each point
    /// breaks; these numbers stand above the point.
    ///
    /// The axis covers the values and the control limits, and the tolerance if it is not far from them.
    pub(super) fn individuals(&self, broken: &[Broken]) -> Markup {
        let (all, limits) = (self.um(), self.limits);
        let range = value_range(&all, limits, self.tolerance());
        let zone = |k: f64| limits.mean + k * limits.sigma();
        let zones = [-2.0, -1.0, 1.0, 2.0].map(zone).into_iter().filter(|at| (range[0]..=range[1]).contains(at));
        let mut marks: Vec<Mark> = zones.map(|at| Mark::Across { class: "zone", name: String::new(), at }).collect();
        marks.push(self.across("centre", Text::MeanOfChart, limits.mean));
        marks.push(self.across("control", Text::UpperLimit, limits.upper));
        marks.extend(limits.lower.map(|at| self.across("control", Text::LowerLimit, at)));
        if self.tolerance().is_some_and(|tolerance| tolerance <= range[1]) {
            marks.extend(tolerance_lines(self.values));
            // The label is next to the end of the line; the line itself is stepped.
            let last = self.values.last().and_then(|value| value.limit_um);
            marks.extend(last.map(|at| self.across("allowed", Text::Allowed, at)));
        }
        let mut points = self.points(&all, |k| broken.get(k).is_some_and(|broken| broken.any()));
        points.marks.extend(numbers_of_rules(&all, broken, range));
        let title = format!("{}, µm", self.name);
        self.drawn((title, 300.0), range, [Layer { marks, ..Layer::default() }, points])
    }

    /// Draws the control chart of the moving ranges in µm as SVG, with the mean range and its upper control limit. A
    /// moving range is the absolute difference of two consecutive values. Its axis begins at 0, the smallest range.
    pub(super) fn moving_ranges(&self) -> Markup {
        let (all, limits) = (ranges(&self.um()), self.limits);
        let marks = vec![
            self.across("centre", Text::MeanRange, limits.mean_range),
            self.across("control", Text::UpperLimit, limits.range_upper),
        ];
        let most = all.iter().fold(limits.range_upper, |most, value| most.max(*value));
        let points = self.points(&all, |k| all[k] > limits.range_upper);
        let title = filled(Text::MovingRangeOf.to(self.language), &[("name", &self.name)]);
        let range = [0.0, if most > 0.0 { 1.05 * most } else { 1.0 }];
        self.drawn((title, 170.0), range, [Layer { marks, ..Layer::default() }, points])
    }

    /// Returns the largest tolerance of the parts; `None` if no part has one.
    pub(super) fn tolerance(&self) -> Option<f64> {
        let limits = self.values.iter().filter_map(|value| value.limit_um).filter(|limit| *limit > 0.0);
        limits.fold(None, |most: Option<f64>, limit| Some(most.map_or(limit, |most| most.max(limit))))
    }

    /// Returns true if the chart of the individual values has no room for the tolerance.
    pub(super) fn tolerance_is_far(&self) -> bool {
        let range = value_range(&self.um(), self.limits, self.tolerance());
        self.tolerance().is_some_and(|tolerance| tolerance > range[1])
    }

    /// Returns the points of the figures `all`, in µm, and the line between them. The last figure belongs to the last
    /// part. `is_out` decides by the index of a figure whether it calls for attention.
    fn points(&self, all: &[f64], is_out: impl Fn(usize) -> bool) -> Layer {
        // The first range belongs to the second value.
        let offset = self.values.len() - all.len();
        let at = |k: usize| [(k + offset) as f64, all[k]];
        let dot = |k: usize| {
            let (value, is_out) = (&self.values[k + offset], is_out(k));
            Mark::Dot(Dot {
                at: at(k),
                shape: if is_out { Shape::Out } else { Shape::Small },
                tooltip: self.tooltip(value, all[k]),
                link: format!("/runs/{}", value.run),
            })
        };
        let line = Mark::Line((0..all.len()).map(at).collect());
        let marks = std::iter::once(line).chain((0..all.len()).map(dot)).collect();
        Layer { class: self.class.to_owned(), marks, ..Layer::default() }
    }

    /// Draws a chart of the parts in their order, with `range` in µm upwards.
    fn drawn(&self, (title, height): (String, f64), range: [f64; 2], layers: [Layer; 2]) -> Markup {
        let number = |value: f64, decimals: usize| decimal(value, decimals, self.language);
        let times: Vec<&str> = self.values.iter().map(|value| value.when.as_str()).collect();
        let y = ChartAxis::new("", Scale::Linear, range, if height > 200.0 { 8 } else { 4 }, &number);
        let (size, layers) = ([WIDTH, height], layers.into());
        let chart = Chart { title, size, right_margin: RIGHT, x: time_axis(&times), y, layers, ..Chart::default() };
        PreEscaped(chart.to_markup())
    }

    /// Returns the tooltip of a point of a chart: serial number, cell, time and value.
    fn tooltip(&self, value: &Value, um: f64) -> String {
        let um = decimal(um, 3, self.language);
        format!("{}, {}, {} UTC: {um} µm", shown(&value.serial), shown(&value.cell), value.when)
    }
}

/// Returns the ends of an axis that uses its height: from a little below the smallest value and limit to a little above
/// the largest, and never below 0. A tolerance is included if it does not flatten the chart.
fn value_range(values: &[f64], limits: &Limits, tolerance: Option<f64>) -> [f64; 2] {
    let ends = |of: fn(f64, f64) -> f64, first: f64| values.iter().fold(first, |end, value| of(end, *value));
    let low = ends(f64::min, limits.lower.unwrap_or(limits.mean));
    let high = ends(f64::max, limits.upper);
    let near = tolerance.filter(|tolerance| *tolerance <= high + TOLERANCE_WITHIN * (high - low));
    let high = near.map_or(high, |tolerance| high.max(tolerance));
    let room = if high > low { ROOM * (high - low) } else { 0.5 * high.abs().max(1.0) };
    [(low - room).max(0.0), high + room]
}

/// Returns the numbers of broken rules above their points. Of points in a row that break the same rules, the first has
/// the numbers.
fn numbers_of_rules(all: &[f64], broken: &[Broken], range: [f64; 2]) -> Vec<Mark> {
    let is_first = |k: usize| broken[k].any() && (k == 0 || broken[k - 1] != broken[k]);
    let places = (0..broken.len()).filter(|k| is_first(*k));
    let above = 0.06 * (range[1] - range[0]);
    places.map(|k| Mark::Text { at: [k as f64, all[k] + above], text: broken[k].numbers() }).collect()
}

/// Returns the tolerances of the parts as stepped lines. A part without a tolerance ends a line, and the next part with
/// a tolerance begins a new one.
fn tolerance_lines(values: &[Value]) -> Vec<Mark> {
    let steps = values.iter().enumerate().collect::<Vec<_>>();
    let lines = steps.split(|(_, value)| value.limit_um.is_none()).filter(|line| !line.is_empty());
    let step = |(k, value): &(usize, &Value)| {
        let (x, y) = (*k as f64, value.limit_um.unwrap_or_default());
        [[x - 0.5, y], [x + 0.5, y]]
    };
    lines.map(|line| Mark::Steps(line.iter().flat_map(step).collect())).collect()
}

/// Returns the axis of parts in their order. `times` are the times (UTC) of all parts. The ticks have as much of the time
/// as the span of the chart needs: hours of one day, hours with their day, days, or days with their year.
fn time_axis(times: &[&str]) -> ChartAxis {
    let last = times.len().saturating_sub(1);
    let style = time_style(times.first().copied().unwrap_or_default(), times.last().copied().unwrap_or_default());
    let part = |time: &str| {
        let within = match style {
            "minute" => 11..16,
            "hour" => 5..16,
            "day" => 5..10,
            _ => 0..10,
        };
        time.get(within).unwrap_or_default().to_owned()
    };
    let places = marked(times.len());
    ChartAxis {
        range: [-0.5, last as f64 + 0.5],
        ticks: places.iter().map(|k| (*k as f64, part(times[*k]))).collect(),
        times: places.iter().map(|k| rfc3339(times[*k])).collect(),
        time_style: style,
        ..ChartAxis::default()
    }
}

/// Returns the parts of a time that distinguish the ticks from `first` to `last`, such as `2026-07-04 12:00:00`.
fn time_style(first: &str, last: &str) -> &'static str {
    let [first, last] = [first, last].map(|time| time.parse::<DateTime>().unwrap_or_default());
    match last.duration_since(first).as_hours().abs() {
        0..20 => "minute",
        20..144 => "hour",
        144..7200 => "day",
        _ => "date",
    }
}

/// Returns the indices of the values whose times are written on the x axis: at most six, evenly spaced.
fn marked(count: usize) -> Vec<usize> {
    let most = 6.min(count);
    let mut marked: Vec<usize> = (0..most).map(|k| k * (count - 1) / (most - 1).max(1)).collect();
    marked.dedup();
    marked
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_match_nist_example() {
        // NIST/SEMATECH e-Handbook 6.3.2.2: ten batches, mean 50.81, mean range 1.8778, limits 45.82 and 55.80.
        let flow = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1];
        let limits = Limits::from_values(&flow).unwrap();
        let near = |value: f64, known: f64| (value - known).abs() < 2e-3;
        assert!(near(limits.mean, 50.81) && near(limits.mean_range, 1.8778), "{limits:?}");
        assert!(near(limits.upper, 55.8041) && near(limits.lower.unwrap(), 45.8159), "{limits:?}");
        assert!(near(limits.range_upper, 6.1347), "{limits:?}");
        assert!(near(limits.mean + 3.0 * limits.sigma(), limits.upper), "{limits:?}");
    }

    #[test]
    fn lower_limit_is_never_negative() {
        let limits = Limits::from_values(&[1.0, 4.0, 1.0]).unwrap();
        assert_eq!(limits.lower, None);
        assert_eq!((Limits::from_values(&[1.0]), Limits::from_values(&[])), (None, None));
    }

    fn value(um: f64, when: &str) -> Value {
        let (serial, cell, when) = ("<b>\"&".into(), "c".into(), when.into());
        Value { run: 7, serial, cell, when, um, u_um: None, limit_um: Some(7.0) }
    }

    #[test]
    fn control_chart_marks_broken_rules() {
        let mut values: Vec<Value> =
            (0..30).map(|k| value(3.0 + 0.1 * f64::from(k % 3), "2026-07-04 12:00:00")).collect();
        values.push(value(9.0, "2026-07-04 13:00:00"));
        let all: Vec<f64> = values.iter().map(|value| value.um).collect();
        let limits = Limits::from_values(&all).unwrap();
        let figure = Figure { name: "PV", class: "pv", values: &values, limits: &limits, language: Language::En };
        let broken = super::super::nelson::broken_rules(&all, limits.zones());
        assert!(broken[30].has(1), "{broken:?}");
        let svg = figure.individuals(&broken).into_string();
        let out = broken.iter().filter(|broken| broken.any()).count();
        assert_eq!((svg.matches("class=\"out\"").count(), svg.matches("<circle").count()), (out, 31 - out), "{svg}");
        assert!(svg.contains(&format!(">{}</text>", broken[30].numbers())), "the numbers of the rules: {svg}");
        assert!(!svg.contains("<b>") && svg.contains("&lt;b&gt;") && !svg.contains("NaN"), "{svg}");
        let svg = figure.moving_ranges().into_string();
        assert_eq!((svg.matches("class=\"out\"").count(), svg.matches("<circle").count()), (1, 29), "{svg}");
    }

    #[test]
    fn axis_uses_its_height() {
        let limits = |values: &[f64]| Limits::from_values(values).unwrap();
        let values = [50.0, 50.4, 49.8, 50.1];
        let of = limits(&values);
        let [low, high] = value_range(&values, &of, None);
        assert!(low > 48.0 && high < 52.5, "{low} {high}");
        // A near tolerance is in the chart, a far one would flatten it.
        assert!(value_range(&values, &of, Some(52.0))[1] > 52.0 && value_range(&values, &of, Some(90.0))[1] < 52.5);
        // Never below 0, and never without a height.
        let [low, high] = value_range(&[0.02, 0.5], &limits(&[0.02, 0.5]), None);
        assert!(low == 0.0 && high > 0.5);
        let [low, high] = value_range(&[3.0, 3.0], &limits(&[3.0, 3.0]), None);
        assert!(low < 3.0 && high > 3.0);
    }

    #[test]
    fn ticks_have_the_time_that_tells_them_apart() {
        let style = |last: &str| time_style("2026-07-04 10:00:00", last);
        assert_eq!(
            ["2026-07-04 15:00:00", "2026-07-06 10:00:00", "2026-08-04 10:00:00", "2028-07-04 10:00:00"].map(style),
            ["minute", "hour", "day", "date"]
        );
        let texts = |last: &str| {
            time_axis(&["2026-07-04 10:00:00", last]).ticks.into_iter().map(|(_, text)| text).collect::<Vec<_>>()
        };
        assert_eq!(texts("2026-07-04 15:30:00"), ["10:00", "15:30"]);
        assert_eq!(texts("2026-07-06 15:30:00"), ["07-04 10:00", "07-06 15:30"]);
        assert_eq!(texts("2026-08-06 15:30:00"), ["07-04", "08-06"]);
        assert_eq!(time_axis(&["2026-07-04 10:00:00"]).times, ["2026-07-04T10:00:00Z"]);
        assert!(time_axis(&[]).ticks.is_empty());
    }
}
