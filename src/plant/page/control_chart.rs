//! Control charts of individuals and their moving ranges (W. A. Shewhart; ISO 7870-2, individuals; NIST/SEMATECH
//! e-Handbook of Statistical Methods, 6.3.2.2).
//!
//! With n values x in the order of measurement, and the moving ranges MR = |x(i) - x(i-1)|: the centre is the mean of
//! x, the limits are at 2.660 mean MR from the centre (3 / d2, d2 = 1.128 for two values), and a range is out of
//! control above 3.267 mean MR (D4). Units: micrometres.

use maud::{Markup, PreEscaped};
use regrind_report::{Chart, ChartAxis, Dot, Layer, Mark, Scale, Shape};

use super::words::shown;

/// Constants 3 / d2 and D4 for ranges of two values.
const E2: f64 = 2.660;
const D4: f64 = 3.267;
/// Minimum number of values for limits. Limits of fewer values change much with the next values.
pub(super) const ENOUGH: usize = 20;

/// Width of a chart and the space to the right of its axes, in pixels.
const WIDTH: f64 = 900.0;
const RIGHT: f64 = 130.0;

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

    /// Returns true if a value is above the upper or below the lower control limit.
    pub(super) fn is_out(&self, value: f64) -> bool {
        value > self.upper || self.lower.is_some_and(|lower| value < lower)
    }
}

/// Returns the moving ranges: the absolute differences of consecutive values. They are one fewer than the values.
pub(super) fn ranges(values: &[f64]) -> Vec<f64> {
    values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect()
}

/// Returns a horizontal line of a chart, with its name and its value.
fn across(class: &'static str, name: &str, at: f64) -> Mark {
    Mark::Across { class, name: format!("{name} {at:.2}"), at }
}

/// Draws the control chart of individual values in µm as SVG. `values` are the parts in the order of measurement; each
/// is one point of the chart. The chart also shows the mean and the control limits from `limits`, and the tolerance of
/// each part. Does not draw the tolerances if the largest tolerance is at least four times the largest of all values
/// and control limits. `name` is the name of the figure, such as PV. `class` is the CSS class of the points and of the
/// line between them.
pub(super) fn individuals(name: &str, class: &str, values: &[Value], limits: &Limits) -> Markup {
    let all: Vec<f64> = values.iter().map(|value| value.um).collect();
    let mut marks = vec![across("centre", "mean", limits.mean), across("control", "upper limit", limits.upper)];
    marks.extend(limits.lower.map(|at| across("control", "lower limit", at)));
    let most = all.iter().fold(limits.upper, |most, value| most.max(*value));
    // A tolerance far above all values would flatten the chart, so it is not drawn.
    let tolerance = values.iter().filter_map(|value| value.limit_um).fold(0.0, f64::max);
    let shows = tolerance > 0.0 && tolerance < 4.0 * most;
    if shows {
        marks.extend(tolerance_lines(values));
        // The label is next to the end of the line; the line itself is stepped.
        marks.extend(values.last().and_then(|value| value.limit_um).map(|at| across("allowed", "allowed", at)));
    }
    let (most, title) = (if shows { most.max(tolerance) } else { most }, format!("{name}, µm"));
    let layers = [Layer { marks, ..Layer::default() }, of_values(class, values, &all, |value| limits.is_out(value))];
    drawn((title, 300.0), values, most, layers)
}

/// Draws the control chart of the moving ranges in µm as SVG. A moving range is the absolute difference of two
/// consecutive `values`. The chart also shows the mean range and the upper control limit from `limits`. `values` are
/// the parts in the order of measurement, and must not be empty. `name` is the name of the figure, such as PV. `class`
/// is the CSS class of the points and of the line between them.
pub(super) fn moving_ranges(name: &str, class: &str, values: &[Value], limits: &Limits) -> Markup {
    let all: Vec<f64> = values.iter().map(|value| value.um).collect();
    let all = ranges(&all);
    let marks =
        vec![across("centre", "mean range", limits.mean_range), across("control", "upper limit", limits.range_upper)];
    let most = all.iter().fold(limits.range_upper, |most, value| most.max(*value));
    let of_ranges = of_values(class, values, &all, |value| value > limits.range_upper);
    let title = format!("Moving range of {name}, µm");
    drawn((title, 170.0), values, most, [Layer { marks, ..Layer::default() }, of_ranges])
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

/// Returns the points of the figures `all`, in µm, and the line between them. The last figure belongs to the last of
/// `values`. `is_out` decides which points call for attention.
fn of_values(class: &str, values: &[Value], all: &[f64], is_out: impl Fn(f64) -> bool) -> Layer {
    // The first range belongs to the second value.
    let offset = values.len() - all.len();
    let at = |k: usize| [(k + offset) as f64, all[k]];
    let dot = |k: usize| {
        let (value, is_out) = (&values[k + offset], is_out(all[k]));
        Mark::Dot(Dot {
            at: at(k),
            shape: if is_out { Shape::Out } else { Shape::Small },
            tooltip: tooltip(value, all[k], is_out),
            link: format!("/runs/{}", value.run),
        })
    };
    let line = Mark::Line((0..all.len()).map(at).collect());
    Layer {
        class: class.to_owned(),
        marks: std::iter::once(line).chain((0..all.len()).map(dot)).collect(),
        ..Layer::default()
    }
}

/// Draws a chart of parts in their order, with µm from 0 to a little above `most_um` upwards.
fn drawn((title, height): (String, f64), values: &[Value], most_um: f64, layers: [Layer; 2]) -> Markup {
    let number = |value: f64, decimals: usize| format!("{value:.decimals$}");
    let last = values.len().saturating_sub(1);
    let date = |k: usize| (k as f64, values[k].when.get(..10).unwrap_or_default().to_owned());
    let x = ChartAxis {
        range: [-0.5, last as f64 + 0.5],
        ticks: marked(values.len()).into_iter().map(date).collect(),
        ..ChartAxis::default()
    };
    let most_um = if most_um > 0.0 { 1.05 * most_um } else { 1.0 };
    let chart = Chart {
        title,
        size: [WIDTH, height],
        right_margin: RIGHT,
        x,
        y: ChartAxis::new("", Scale::Linear, [0.0, most_um], 5, &number),
        layers: layers.into(),
        ..Chart::default()
    };
    PreEscaped(chart.to_markup())
}

/// Returns the tooltip of a point of a chart: serial number, cell, time and value. `is_out` is true for a value outside
/// the control limits.
fn tooltip(value: &Value, um: f64, is_out: bool) -> String {
    let out = if is_out { ", OUT OF LIMITS" } else { "" };
    format!("{}, {}, {}: {um:.3} µm{out}", shown(&value.serial), shown(&value.cell), value.when)
}

/// Returns the indices of the values whose dates are written on the x axis: at most six, evenly spaced.
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
        assert!(limits.is_out(limits.upper + 0.01) && !limits.is_out(limits.upper) && limits.is_out(45.0));
    }

    #[test]
    fn lower_limit_is_never_negative() {
        let limits = Limits::from_values(&[1.0, 4.0, 1.0]).unwrap();
        assert_eq!(limits.lower, None);
        assert!(!limits.is_out(0.0));
        assert_eq!((Limits::from_values(&[1.0]), Limits::from_values(&[])), (None, None));
    }

    #[test]
    fn control_chart_marks_out_of_limits() {
        let value = |um: f64| Value {
            run: 7,
            serial: "<b>\"&".into(),
            cell: "c".into(),
            when: "2026-07-04 12:00:00".into(),
            um,
            u_um: None,
            limit_um: Some(7.0),
        };
        let mut values: Vec<Value> = (0..30).map(|k| value(3.0 + 0.1 * f64::from(k % 3))).collect();
        values.push(value(9.0));
        let all: Vec<f64> = values.iter().map(|value| value.um).collect();
        let limits = Limits::from_values(&all).unwrap();
        let svg = individuals("PV", "pv", &values, &limits).into_string();
        assert_eq!((svg.matches("class=\"out\"").count(), svg.matches("<circle").count()), (1, 30), "{svg}");
        assert!(!svg.contains("<b>") && svg.contains("&lt;b&gt;") && !svg.contains("NaN"), "{svg}");
        let svg = moving_ranges("PV", "pv", &values, &limits).into_string();
        assert_eq!((svg.matches("class=\"out\"").count(), svg.matches("<circle").count()), (1, 29), "{svg}");
    }
}
