//! Convergence of PV and RMS from cycle to cycle, with their limits, their uncertainty and the forecast for the next
//! cycle.

use maud::{Markup, PreEscaped, html};
use regrind_cell::Tolerance;
use regrind_report::{ConvergenceCurve, ConvergenceWords, CycleSummary, convergence_chart};

use super::texts::Text;
use regrind_language::Language;

/// Returns the curve of figure number `k` over the cycles. If `ahead` is true, it has the forecast for the next cycle.
fn curve(
    named: [&'static str; 2],
    k: usize,
    cycles: &[CycleSummary],
    limit_mm: Option<f64>,
    ahead: bool,
) -> ConvergenceCurve {
    let measured = |cycle: &CycleSummary| Some((cycle.cycle, cycle.figures?[k][0], cycle.figures?[k][1]));
    let expected = |last: u32| Some(cycles.iter().find(|cycle| ahead && cycle.cycle == last)?.expected?[k]);
    ConvergenceCurve::new(named, cycles.iter().filter_map(measured), limit_mm.map(|mm| 1e3 * mm), expected)
}

/// Returns a chart as SVG: the error of the part after each cycle, in micrometres, as peak-to-valley (PV) and root mean
/// square (RMS). `tolerance` adds the limits. If `ahead` is true, the chart also contains the forecast for the next
/// cycle, if there is one. If nothing was measured, returns a sentence instead of the chart.
pub(crate) fn chart(cycles: &[CycleSummary], tolerance: Option<&Tolerance>, ahead: bool, language: Language) -> Markup {
    let curves = [
        curve(["PV", "pv"], 0, cycles, tolerance.map(|tolerance| tolerance.pv_mm), ahead),
        curve(["RMS", "rms"], 1, cycles, tolerance.map(|tolerance| tolerance.rms_mm), ahead),
    ];
    let say = |text: Text| text.to(language);
    let words =
        ConvergenceWords { language, cycle: say(Text::Cycle), limit: say(Text::Limit), forecast: say(Text::Forecast) };
    match convergence_chart(&curves, words) {
        Some(chart) => PreEscaped(chart.to_markup()),
        None => html! { p .quiet { (say(Text::NotMeasured)) } },
    }
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
        let of = |cycles: &[CycleSummary], ahead| curve(["PV", "pv"], 0, cycles, None, ahead).forecast();
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
