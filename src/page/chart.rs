//! Convergence of PV and RMS from cycle to cycle, with their limits, their uncertainty and the forecast for the next
//! cycle.

use maud::{Markup, PreEscaped, html};
use regrind_cell::Tolerance;
use regrind_report::{Chart, ChartAxis, CycleSummary, Dot, Layer, Mark, Scale, Shape};

use super::texts::Text;
use regrind_language::{Language, decimal};

/// Width and height of the chart, and the space to the right of its axes, in pixels.
const SIZE: [f64; 2] = [420.0, 190.0];
const RIGHT: f64 = 84.0;

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
    let Some([x, y]) = axes(&lines, language) else {
        return html! { p .quiet { (Text::NotMeasured.to(language)) } };
    };
    let layers = lines.iter().map(|line| layer(line, y.range[0], language)).collect();
    let description = words(&lines, language);
    let chart = Chart { description, size: SIZE, right_margin: RIGHT, x, y, layers, ..Chart::default() };
    PreEscaped(chart.to_markup())
}

/// Returns the marks of a line. `low_um` is the lower end of the vertical axis.
fn layer(line: &Line, low_um: f64, language: Language) -> Layer {
    let um = |value: f64| decimal(value, 2, language);
    let at = |cycle: u32, value: f64| [f64::from(cycle), value];
    let dot = |at, shape, tooltip| Mark::Dot(Dot { at, shape, tooltip, ..Dot::default() });
    let mut marks = Vec::new();
    if line.limit_um.is_finite() && line.limit_um > 0.0 {
        let name = format!("{} {}", line.name, Text::Limit.to(language));
        marks.push(Mark::Across { class: "limit", name, at: line.limit_um });
    }
    let band = |(cycle, value, u): &(u32, f64, f64)| [f64::from(*cycle), (value - u).max(low_um), value + u];
    marks.push(Mark::Band(line.points.iter().map(band).collect()));
    marks.push(Mark::Line(line.points.iter().map(|(cycle, value, _)| at(*cycle, *value)).collect()));
    marks.extend(line.points.iter().map(|(cycle, value, u)| {
        dot(at(*cycle, *value), Shape::Disc, format!("{} {} ± {} µm", line.name, um(*value), um(*u)))
    }));
    if let (Some((cycle, value)), Some((from, last, _))) = (line.forecast, line.points.last()) {
        marks.push(Mark::Dashes(vec![at(*from, *last), at(cycle, value)]));
        let tooltip = format!("{} {} {} µm", line.name, Text::Forecast.to(language), um(value));
        marks.push(dot(at(cycle, value), Shape::Hollow, tooltip));
    }
    Layer { name: String::new(), class: line.class.to_owned(), marks }
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

/// Returns the axes for the curves `lines`: cycles to the right, micrometres upwards on a logarithmic axis. The
/// horizontal axis covers all measured and forecast cycles. The vertical axis covers all measured values, limits and
/// forecasts. A forecast above this range is drawn at the upper edge of the chart. Returns `None` if no curve has a
/// measured point.
fn axes(lines: &[Line], language: Language) -> Option<[ChartAxis; 2]> {
    let all = || lines.iter().flat_map(|line| &line.points);
    let first = all().map(|(cycle, ..)| *cycle).min()?;
    let forecast = || lines.iter().filter_map(|line| line.forecast);
    let last = all().map(|(cycle, ..)| *cycle).chain(forecast().map(|(cycle, _)| cycle)).max()?;
    let limits = lines.iter().map(|line| line.limit_um).filter(|limit| limit.is_finite() && *limit > 0.0);
    let values = || all().map(|(_, value, u)| value + u).chain(all().map(|(_, value, _)| *value)).chain(limits.clone());
    let low = values().chain(forecast().map(|(_, value)| value)).fold(f64::INFINITY, f64::min) / 1.6;
    let high = values().fold(0.0, f64::max) * 1.2;
    let number = |value: f64, decimals: usize| decimal(value, decimals, language);
    let x = ChartAxis::of_integers(Text::Cycle.to(language), [first, last.max(first + 1)], 12);
    Some([x, ChartAxis::new("µm", Scale::Log, [low, high], 9, &number)])
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
