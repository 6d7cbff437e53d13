//! Control charts of individuals and their moving ranges (W. A. Shewhart; ISO 7870-2, individuals; NIST/SEMATECH
//! e-Handbook of Statistical Methods, 6.3.2.2).
//!
//! With n values x in the order of measurement, and the moving ranges MR = |x(i) - x(i-1)|: the centre is the mean of
//! x, the limits are at 2.660 mean MR from the centre (3 / d2, d2 = 1.128 for two values), and a range is out of
//! control above 3.267 mean MR (D4). Units: micrometres.

use maud::{Markup, html};

use super::words::shown;

/// Constants 3 / d2 and D4 for ranges of two values.
const E2: f64 = 2.660;
const D4: f64 = 3.267;
/// Minimum number of values for limits. Limits of fewer values change much with the next values.
pub(super) const ENOUGH: usize = 20;

const WIDTH: f64 = 900.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = 120.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 26.0;

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

/// Horizontal line of a chart, with its name.
struct Across {
    class: &'static str,
    name: &'static str,
    at: f64,
}

/// Draws the control chart of individual values in µm as SVG. `values` are the parts in the order of measurement; each
/// is one point of the chart. The chart also shows the mean and the control limits from `limits`, and the tolerance of
/// each part. Does not draw the tolerances if the largest tolerance is at least four times the largest of all values
/// and control limits. `name` is the name of the figure, such as PV. `class` is the CSS class of the points and of the
/// line between them.
pub(super) fn individuals(name: &str, class: &str, values: &[Value], limits: &Limits) -> Markup {
    let all: Vec<f64> = values.iter().map(|value| value.um).collect();
    let mut lines = vec![
        Across { class: "centre", name: "mean", at: limits.mean },
        Across { class: "control", name: "upper limit", at: limits.upper },
    ];
    lines.extend(limits.lower.map(|at| Across { class: "control", name: "lower limit", at }));
    let most = all.iter().fold(limits.upper, |most, value| most.max(*value));
    // A tolerance far above all values would flatten the chart, so it is not drawn.
    let tolerance = values.iter().filter_map(|value| value.limit_um).fold(0.0, f64::max);
    let shows = tolerance > 0.0 && tolerance < 4.0 * most;
    let scale = Scale { max: if shows { most.max(tolerance) } else { most }, count: values.len(), height: 280.0 };
    let steps = if shows { tolerance_line(values, &scale) } else { Vec::new() };
    // The label is next to the end of the line; the line itself is stepped.
    let last = values.last().and_then(|value| value.limit_um).filter(|_| shows);
    lines.extend(last.map(|at| Across { class: "allowed", name: "allowed", at }));
    drawn(&format!("{name}, µm"), class, values, &all, &lines, &scale, |value| limits.is_out(value), &steps)
}

/// Draws the control chart of the moving ranges in µm as SVG. A moving range is the absolute difference of two
/// consecutive `values`. The chart also shows the mean range and the upper control limit from `limits`. `values` are
/// the parts in the order of measurement, and must not be empty. `name` is the name of the figure, such as PV. `class`
/// is the CSS class of the points and of the line between them.
pub(super) fn moving_ranges(name: &str, class: &str, values: &[Value], limits: &Limits) -> Markup {
    let all: Vec<f64> = values.iter().map(|value| value.um).collect();
    let all = ranges(&all);
    let lines = [
        Across { class: "centre", name: "mean range", at: limits.mean_range },
        Across { class: "control", name: "upper limit", at: limits.range_upper },
    ];
    let most = all.iter().fold(limits.range_upper, |most, value| most.max(*value));
    let scale = Scale { max: most, count: values.len(), height: 150.0 };
    let is_out = |value| value > limits.range_upper;
    drawn(&format!("Moving range of {name}, µm"), class, &values[1..], &all, &lines, &scale, is_out, &[])
}

/// Returns the tolerances of the parts as stepped lines, in pixels of the drawing. Each text is one line, in the format
/// of the `points` attribute of an SVG polyline. A part without a tolerance ends the line, and the next part with a
/// tolerance begins a new line.
fn tolerance_line(values: &[Value], scale: &Scale) -> Vec<String> {
    let half = 0.5 * (scale.x(1) - scale.x(0));
    let mut parts: Vec<String> = vec![String::new()];
    for (k, value) in values.iter().enumerate() {
        let Some(limit) = value.limit_um else {
            parts.push(String::new());
            continue;
        };
        let (x, y) = (scale.x(k), scale.y(limit));
        if let Some(part) = parts.last_mut() {
            *part += &format!("{:.1},{y:.1} {:.1},{y:.1} ", x - half, x + half);
        }
    }
    parts.retain(|part| !part.is_empty());
    parts
}

#[expect(clippy::too_many_arguments, reason = "each is one thing that the chart shows")]
fn drawn(
    title: &str,
    class: &str,
    values: &[Value],
    all: &[f64],
    lines: &[Across],
    scale: &Scale,
    is_out: impl Fn(f64) -> bool,
    steps: &[String],
) -> Markup {
    // The first range belongs to the second value.
    let offset = scale.count - values.len();
    let at = |k: usize| (scale.x(k + offset), scale.y(all[k]));
    let line: String = (0..all.len()).map(|k| format!("{:.1},{:.1} ", at(k).0, at(k).1)).collect();
    let right = WIDTH - RIGHT;
    let labels = apart(lines.iter().map(|line| scale.y(line.at)).collect());
    html! {
        svg .chart viewBox=(format!("0 0 {WIDTH} {}", scale.height)) role="img" aria-label=(title) {
            text .title x=(LEFT) y=(TOP) { (title) }
            @for tick in scale.ticks() {
                @let y = format!("{:.1}", scale.y(tick));
                line .grid x1=(LEFT) x2=(right) y1=(y) y2=(y) {}
                text .tick x=(LEFT - 6.0) y=(y) dy="4" text-anchor="end" { (tick) }
            }
            @for k in scale.marked().into_iter().filter(|k| *k >= offset) {
                text .tick x=(format!("{:.1}", scale.x(k))) y=(scale.height - 6.0) text-anchor="middle" { (values[k - offset].when.get(..10).unwrap_or_default()) }
            }
            @for step in steps { polyline .tolerance points=(step) {} }
            @for (across, label) in lines.iter().zip(labels) {
                @let y = format!("{:.1}", scale.y(across.at));
                line .(across.class) x1=(LEFT) x2=(right) y1=(y) y2=(y) {}
                text .(across.class) x=(right + 5.0) y=(format!("{label:.1}")) dy="4" { (across.name) " " (format!("{:.2}", across.at)) }
            }
            g .(class) {
                polyline .line points=(line) {}
                @for (k, value) in values.iter().enumerate() {
                    @let (x, y) = at(k);
                    a href=(format!("/runs/{}", value.run)) {
                        @if is_out(all[k]) {
                            path .out d=(format!("M{x:.1} {:.1} l7 12 h-14 Z", y - 8.0)) { (tooltip(value, all[k], true)) }
                        } @else {
                            circle cx=(format!("{x:.1}")) cy=(format!("{y:.1}")) r="3" { (tooltip(value, all[k], false)) }
                        }
                    }
                }
            }
        }
    }
}

/// Returns the tooltip of a point of a chart: serial number, cell, time and value. `is_out` is true for a value outside
/// the control limits.
fn tooltip(value: &Value, um: f64, is_out: bool) -> Markup {
    let out = if is_out { ", OUT OF LIMITS" } else { "" };
    html! { title { (shown(&value.serial)) ", " (shown(&value.cell)) ", " (value.when) ": " (format!("{um:.3}")) " µm" (out) } }
}

/// Moves labels upwards until they do not overlap. `at` contains the y coordinate of each label in pixels, measured
/// downwards from the top. Returns the new coordinates in the same order. The lowest label keeps its position.
fn apart(mut at: Vec<f64>) -> Vec<f64> {
    let mut order: Vec<usize> = (0..at.len()).collect();
    order.sort_by(|a, b| at[*b].total_cmp(&at[*a]));
    for pair in order.windows(2) {
        at[pair[1]] = at[pair[1]].min(at[pair[0]] - 13.0);
    }
    at
}

/// Scale of a chart: parts in their order on the x axis, µm from 0 upwards on the y axis.
struct Scale {
    max: f64,
    count: usize,
    height: f64,
}

impl Scale {
    fn x(&self, k: usize) -> f64 {
        let share = if self.count > 1 { k as f64 / (self.count - 1) as f64 } else { 0.5 };
        LEFT + 10.0 + share * (WIDTH - LEFT - RIGHT - 20.0)
    }

    fn y(&self, value: f64) -> f64 {
        let share = if self.max > 0.0 { value / (1.05 * self.max) } else { 0.0 };
        self.height - BOTTOM - share * (self.height - TOP - BOTTOM - 8.0)
    }

    /// Returns the values, in µm, of the ticks on the y axis. The values are 0 and the multiples of a round step, up to
    /// the maximum of the chart. The step is 1, 2 or 5 times a power of ten. There are at most five ticks.
    fn ticks(&self) -> Vec<f64> {
        let step = round_step(self.max / 4.0);
        // Rounds, so that a tick is 0.6 and not 0.6000000000000001.
        let per_step = 10f64.powf(-step.log10().floor());
        let round = |tick: f64| (tick * per_step).round() / per_step;
        (0..20).map(|k| f64::from(k) * step).take_while(|tick| *tick <= 1.04 * self.max).map(round).collect()
    }

    /// Returns the indices of the values whose dates are written on the x axis: at most six, evenly spaced.
    fn marked(&self) -> Vec<usize> {
        let most = 6.min(self.count);
        let mut marked: Vec<usize> = (0..most).map(|k| k * (self.count - 1) / (most - 1).max(1)).collect();
        marked.dedup();
        marked
    }
}

/// Returns the smallest number of the form 1, 2 or 5 times a power of ten that is at least `least`. Returns 1 if
/// `least` is not a finite number above 0.
pub(super) fn round_step(least: f64) -> f64 {
    if !(least > 0.0 && least.is_finite()) {
        return 1.0;
    }
    let decade = 10f64.powf(least.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().find(|step| step * decade >= least * 0.999_999);
    step.unwrap_or(10.0) * decade
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

    #[test]
    fn steps_are_round() {
        assert_eq!([0.9, 1.0, 1.1, 4.0, 70.0, 0.03].map(round_step), [1.0, 1.0, 2.0, 5.0, 100.0, 0.05]);
    }
}
