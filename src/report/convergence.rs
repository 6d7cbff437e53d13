//! Convergence of the figures from cycle to cycle.

use super::axis::Scale;
use super::chart::{Chart, ChartAxis, Dot, Layer, Mark};
use super::run_history::RunHistory;
use super::texts::ReportText as Text;
use regrind_language::{Language, decimal};

/// Returns an SVG plot of PV and RMS in µm for each measured cycle of the run, with the limits of both. The vertical
/// axis is logarithmic. Returns `None` in these cases:
///
/// - the record of the run contains no tolerance;
/// - fewer than two cycles have figures;
/// - a number to draw is not finite or not above 0.
pub(super) fn convergence(story: &RunHistory, language: Language) -> Option<String> {
    let tolerance = story.tolerance()?;
    let measured = story
        .cycles
        .iter()
        .filter_map(|(cycle, of)| Some((*cycle, of.measurements.iter().rev().find_map(|of| of.figures.as_ref())?)));
    let all: Vec<_> = measured.map(|(cycle, figures)| (cycle, tolerance.compare(figures))).collect();
    let ([(first, found), .., (last, _)], Some(_)) = (&all[..], all.get(1)) else { return None };
    let values = || all.iter().flat_map(|(_, found)| [0, 1].map(|k| 1e3 * found[k].median_mm));
    if values().any(|um| !(um > 0.0 && um.is_finite())) {
        return None;
    }
    let limits = [0, 1].map(|k| 1e3 * found[k].limit_mm);
    let finite = limits.into_iter().filter(|um| um.is_finite() && *um > 0.0);
    let [low, high] = super::range(values().chain(finite));
    let layer = |k: usize| {
        let limit = Some(limits[k]).filter(|um| um.is_finite());
        let name = |um: f64| format!("{} {} {}", found[k].name, Text::LimitOf.to(language), decimal(um, 2, language));
        let mut marks: Vec<Mark> =
            limit.map(|at| Mark::Across { class: "limit", name: name(at), at }).into_iter().collect();
        let points: Vec<[f64; 2]> =
            all.iter().map(|(cycle, found)| [f64::from(*cycle), 1e3 * found[k].median_mm]).collect();
        let dot = |at: &[f64; 2]| {
            Mark::Dot(Dot {
                at: *at,
                tooltip: format!("{} {} \u{b5}m", found[k].name, decimal(at[1], 3, language)),
                ..Dot::default()
            })
        };
        let dots: Vec<Mark> = points.iter().map(dot).collect();
        marks.push(Mark::Line(points));
        marks.extend(dots);
        Layer { name: found[k].name.to_owned(), class: ["pv", "rms"][k].to_owned(), marks }
    };
    let number = |value: f64, decimals: usize| decimal(value, decimals, language);
    let layers = vec![layer(0), layer(1)];
    let names = layers.iter().flat_map(|layer| &layer.marks).filter_map(|mark| match mark {
        Mark::Across { name, .. } => Some(name.chars().count()),
        _ => None,
    });
    // Letters of the widest usual fonts take 7.6 pixels.
    let right_margin = 14.0 + 7.6 * names.max().unwrap_or(0) as f64;
    let chart = Chart {
        title: Text::Convergence.to(language).to_owned(),
        size: [400.0, 180.0],
        right_margin,
        x: ChartAxis::of_integers(Text::Cycle.to(language), [*first, *last], 12),
        y: ChartAxis::new("\u{b5}m", Scale::Log, [low / 1.6, 1.2 * high], 9, &number),
        layers,
        ..Chart::default()
    };
    Some(chart.to_markup())
}
