//! Convergence of PV and RMS from cycle to cycle, with their limits, their uncertainty and the forecast for the next
//! cycle.

use maud::{Markup, html};
use regrind_cell::Tolerance;
use regrind_report::CycleSummary;

use super::language::{Language, decimal};
use super::texts::Text;

const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 190.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 84.0;
const TOP: f64 = 10.0;
const BOTTOM: f64 = 24.0;

/// One of the two figures over the cycles: (cycle, value, expanded uncertainty).
struct Line {
    name: &'static str,
    class: &'static str,
    points: Vec<(u32, f64, f64)>,
    limit_um: f64,
    /// Forecast for the next cycle: its number and the expected value.
    forecast: Option<(u32, f64)>,
}

impl Line {
    fn new(
        [name, class]: [&'static str; 2],
        k: usize,
        cycles: &[CycleSummary],
        limit_mm: Option<f64>,
        ahead: bool,
    ) -> Self {
        let of = |cycle: &CycleSummary| Some((cycle.cycle, cycle.figures?[k][0], cycle.figures?[k][1]));
        let can_be_shown = |value: f64| value > 0.0 && value.is_finite();
        let points: Vec<_> = cycles.iter().filter_map(of).filter(|(_, value, _)| can_be_shown(*value)).collect();
        let last = points.last().map(|(cycle, ..)| *cycle).filter(|_| ahead);
        let expected = last.and_then(|last| Some((last + 1, cycles.iter().find(|of| of.cycle == last)?.expected?[k])));
        let forecast = expected.filter(|(_, value)| can_be_shown(*value));
        Self { name, class, points, limit_um: limit_mm.map_or(f64::INFINITY, |mm| 1e3 * mm), forecast }
    }
}

/// Returns a chart as SVG: the error of the part after each cycle, in micrometres, as peak-to-valley (PV) and root mean
/// square (RMS). `tolerance` adds the limits. If `ahead` is true, the chart also contains the forecast for the next
/// cycle, if there is one. If nothing was measured, returns a sentence instead of the chart.
pub(crate) fn chart(cycles: &[CycleSummary], tolerance: Option<&Tolerance>, ahead: bool, language: Language) -> Markup {
    let lines = [
        Line::new(["PV", "pv"], 0, cycles, tolerance.map(|tolerance| tolerance.pv_mm), ahead),
        Line::new(["RMS", "rms"], 1, cycles, tolerance.map(|tolerance| tolerance.rms_mm), ahead),
    ];
    let Some(scale) = Scale::fitting(&lines) else {
        return html! { p .quiet { (Text::NotMeasured.to(language)) } };
    };
    html! {
        svg viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(words(&lines, language)) {
            @for decade in scale.ticks() {
                @let y = format!("{:.1}", scale.y(decade));
                line .grid x1=(LEFT) x2=(WIDTH - RIGHT) y1=(y) y2=(y) {}
                text .tick x=(LEFT - 6.0) y=(format!("{:.1}", scale.y(decade) + 4.0)) text-anchor="end" { (tick(decade, language)) }
            }
            @for cycle in scale.first..=scale.last {
                text .tick x=(format!("{:.1}", scale.x(cycle))) y=(HEIGHT - 6.0) text-anchor="middle" { (cycle) }
            }
            text .tick x="10" y=(TOP + 4.0) { "µm" }
            @for line in &lines { (drawn(line, &scale, language)) }
        }
    }
}

fn drawn(line: &Line, scale: &Scale, language: Language) -> Markup {
    let at = |cycle: u32, value: f64| format!("{:.1},{:.1}", scale.x(cycle), scale.y(value));
    let join = |points: Vec<String>| points.join(" ");
    let middle = join(line.points.iter().map(|(cycle, value, _)| at(*cycle, *value)).collect());
    let above = line.points.iter().map(|(cycle, value, u)| at(*cycle, value + u));
    let below = line.points.iter().rev().map(|(cycle, value, u)| at(*cycle, (value - u).max(scale.low)));
    let band = join(above.chain(below).collect());
    let right = WIDTH - RIGHT + 6.0;
    html! {
        g class=(line.class) {
            @if line.limit_um.is_finite() && line.limit_um > 0.0 {
                @let y = format!("{:.1}", scale.y(line.limit_um));
                line .limit x1=(LEFT) x2=(WIDTH - RIGHT) y1=(y) y2=(y) {}
                text .name x=(right) y=(y) dy="4" { (line.name) " " (Text::Limit.to(language)) }
            }
            polygon .band points=(band) {}
            polyline .line points=(middle) {}
            @for (cycle, value, u) in &line.points {
                circle cx=(format!("{:.1}", scale.x(*cycle))) cy=(format!("{:.1}", scale.y(*value))) r="4" {
                    title { (line.name) " " (decimal(*value, 2, language)) " ± " (decimal(*u, 2, language)) " µm" }
                }
            }
            @if let Some((cycle, value)) = line.forecast {
                @let (from, last) = line.points.last().map(|(cycle, value, _)| (*cycle, *value)).unwrap_or_default();
                polyline .forecast points=(join(vec![at(from, last), at(cycle, value.max(scale.low))])) {}
                circle .forecast cx=(format!("{:.1}", scale.x(cycle))) cy=(format!("{:.1}", scale.y(value.max(scale.low)))) r="4" {
                    title { (line.name) " " (Text::Forecast.to(language)) " " (decimal(value, 2, language)) " µm" }
                }
            }
        }
    }
}

/// Returns the values of the chart as one text for a screen reader. `lines` are the PV and RMS curves of the chart. The
/// text contains the name of each curve and, for each cycle, the number of the cycle and the value in µm. `language` is
/// the language of the word "cycle".
fn words(lines: &[Line], language: Language) -> String {
    let of = |line: &Line| {
        let points = line.points.iter().map(|(cycle, value, _)| {
            format!("{} {cycle}: {} µm", Text::Cycle.to(language), decimal(*value, 2, language))
        });
        format!("{}: {}", line.name, points.collect::<Vec<_>>().join(", "))
    };
    lines.iter().map(of).collect::<Vec<_>>().join("; ")
}

/// Scale of the chart: cycles to the right, micrometres upwards on a logarithmic axis.
struct Scale {
    first: u32,
    last: u32,
    low: f64,
    high: f64,
}

impl Scale {
    /// Returns a scale for the curves `lines` of the chart. The horizontal axis covers all measured and forecast
    /// cycles. The vertical axis covers all measured values and limits. A forecast above this range is drawn at the
    /// upper edge of the chart. Returns `None` if no curve has a measured point.
    fn fitting(lines: &[Line]) -> Option<Self> {
        let all = || lines.iter().flat_map(|line| &line.points);
        let first = all().map(|(cycle, ..)| *cycle).min()?;
        let forecast = || lines.iter().filter_map(|line| line.forecast);
        let last = all().map(|(cycle, ..)| *cycle).chain(forecast().map(|(cycle, _)| cycle)).max()?;
        let limits = lines.iter().map(|line| line.limit_um).filter(|limit| limit.is_finite() && *limit > 0.0);
        let values =
            || all().map(|(_, value, u)| value + u).chain(all().map(|(_, value, _)| *value)).chain(limits.clone());
        let low = values().fold(f64::INFINITY, f64::min) / 1.6;
        let low = forecast().map(|(_, value)| value / 1.6).fold(low, f64::min);
        let high = values().fold(0.0, f64::max) * 1.2;
        Some(Self { first, last: last.max(first + 1), low, high })
    }

    fn x(&self, cycle: u32) -> f64 {
        let share = f64::from(cycle - self.first) / f64::from(self.last - self.first);
        LEFT + 12.0 + share * (WIDTH - LEFT - RIGHT - 24.0)
    }

    fn y(&self, value: f64) -> f64 {
        let share = (value.max(self.low) / self.low).ln() / (self.high / self.low).ln();
        HEIGHT - BOTTOM - share.clamp(0.0, 1.0) * (HEIGHT - TOP - BOTTOM)
    }

    /// Returns the values, in micrometres, at which the vertical axis has horizontal grid lines. Only values within the
    /// range of the axis are returned. They are 1, 2 and 5 times each power of ten. If the range extends over more than
    /// three powers of ten, only the powers of ten are returned.
    fn ticks(&self) -> Vec<f64> {
        let (from, to) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
        let steps: &[f64] = if to - from > 3 { &[1.0] } else { &[1.0, 2.0, 5.0] };
        let all = (from..=to).flat_map(|decade| steps.iter().map(move |step| step * 10f64.powi(decade)));
        all.filter(|tick| (self.low..=self.high).contains(tick)).collect()
    }
}

/// Returns the text of a value on the vertical axis, with as many decimals as it needs.
fn tick(value: f64, language: Language) -> String {
    let digits = (-value.log10().floor()).clamp(0.0, 4.0);
    decimal(value, digits as usize, language)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn measured(cycle: u32, pv_um: f64, rms_um: f64) -> CycleSummary {
        CycleSummary {
            cycle,
            figures: Some([[pv_um, 0.1 * pv_um], [rms_um, 0.05 * rms_um]]),
            ..CycleSummary::default()
        }
    }

    #[test]
    fn chart_forecast_while_run_is_open() {
        let mut cycles = [measured(1, 20.0, 5.0), measured(2, 5.0, 1.0)];
        cycles[0].expected = Some([4.0, 0.9]);
        let of = |cycles: &[CycleSummary], ahead| Line::new(["PV", "pv"], 0, cycles, None, ahead).forecast;
        assert_eq!(of(&cycles, true), None, "it was made before the last measurement");
        assert_eq!(of(&cycles[..1], true), Some((2, 4.0)));
        assert_eq!(of(&cycles[..1], false), None);
    }

    #[test]
    fn chart_shows_every_cycle() {
        let cycles = [measured(1, 28.79, 5.285), measured(2, 3.6, 0.526)];
        let svg = chart(&cycles, None, true, Language::En).into_string();
        assert_eq!(svg.matches("<circle").count(), 4, "{svg}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }

    #[test]
    fn chart_without_measurements() {
        for cycles in [&[][..], &[CycleSummary { cycle: 1, ..CycleSummary::default() }], &[measured(1, f64::NAN, 0.0)]]
        {
            assert!(chart(cycles, None, true, Language::De).into_string().contains("gemessen"));
        }
    }
}
