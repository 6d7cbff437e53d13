//! Convergence of a run: PV and RMS of each cycle, with their uncertainty and limits.

use maud::{Markup, PreEscaped, html};
use regrind_language::Language;
use regrind_report::{ConvergenceCurve, ConvergenceWords, convergence_chart};

use super::super::Row;
use super::texts::Text;

/// Draws the convergence of a run. `rows` are its cycles in order, with the columns cycle, PV, its expanded uncertainty,
/// RMS, its expanded uncertainty (in µm); `limits_um` are the limits of PV and RMS. Returns a sentence if no cycle was
/// measured.
pub(super) fn convergence(rows: &[Row], limits_um: [Option<f64>; 2], language: Language) -> Markup {
    let curve = |named: [&'static str; 2], k: usize, limit_um: Option<f64>| {
        let points = rows.iter().filter_map(move |row| {
            let expanded_um = row.get::<_, Option<f64>>(k + 1).filter(|um| um.is_finite()).unwrap_or_default();
            Some((u32::try_from(row.get::<_, i32>(0)).ok()?, row.get::<_, Option<f64>>(k)?, expanded_um))
        });
        ConvergenceCurve::new(named, points, limit_um, |_| None)
    };
    let curves = [curve(["PV", "pv"], 1, limits_um[0]), curve(["RMS", "rms"], 3, limits_um[1])];
    let say = |text: Text| text.to(language);
    let words = ConvergenceWords {
        language,
        cycle: say(Text::Cycle),
        limit: say(Text::Limit),
        forecast: say(Text::ExpectedPv),
    };
    match convergence_chart(&curves, words) {
        Some(chart) => PreEscaped(chart.to_markup()),
        None => html! { p .quiet { (say(Text::NoCycleReported)) } },
    }
}
