//! Bars of parts per day: accepted at the first measurement, accepted after a correction, and not accepted.

use maud::{Markup, PreEscaped, html};
use regrind_language::{Language, filled};
use regrind_report::{Chart, ChartAxis, Layer, Mark, Scale};

use super::texts::Text;

/// Width and height of the chart in pixels.
const SIZE: [f64; 2] = [640.0, 190.0];

/// Counts of one day.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Day {
    /// Month and day, `07-04`.
    pub(super) day: String,
    pub(super) count: Count,
}

/// Counts of parts that ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Count {
    pub(super) ended: i64,
    pub(super) accepted: i64,
    /// Parts accepted at the first measurement.
    pub(super) at_once: i64,
}

/// Draws a bar for each day, with the numbers of parts that were accepted at the first measurement, accepted later, and
/// not accepted. The bars begin at 0, because their heights are numbers of parts.
pub(super) fn bars(days: &[Day], language: Language) -> Markup {
    let most = days.iter().map(|day| day.count.ended).max().unwrap_or(0).max(1) as f64;
    let told = |day: &Day| {
        let Count { ended, accepted, at_once } = day.count;
        let values: [(&str, &dyn std::fmt::Display); 4] =
            [("day", &day.day), ("ended", &ended), ("accepted", &accepted), ("at_once", &at_once)];
        filled(Text::DayOfParts.to(language), &values)
    };
    let marks = days.iter().enumerate().flat_map(|(k, day)| {
        let (Count { ended, accepted, at_once }, x) = (day.count, k as f64);
        let bar = move |(class, from, to): (&'static str, i64, i64)| {
            let (x, y) = ([x - 0.35, x + 0.35], [from as f64, to as f64]);
            (to > from).then(|| Mark::Bar { class, fill: None, x, y, tooltip: told(day) })
        };
        let parts = [("at-once", 0, at_once), ("accepted", at_once, accepted), ("other", accepted, ended)];
        let count = (ended > 0).then(|| Mark::Text { at: [x, ended as f64 + 0.02 * most], text: ended.to_string() });
        parts.into_iter().filter_map(bar).chain(count).collect::<Vec<_>>()
    });
    let last = days.len().saturating_sub(1);
    let dated = days.iter().enumerate().filter(|(k, _)| (last - k).is_multiple_of(2));
    let number = |value: f64, _: usize| format!("{value:.0}");
    let chart = Chart {
        description: days.iter().map(told).collect::<Vec<_>>().join("; "),
        size: SIZE,
        x: ChartAxis {
            range: [-0.5, last as f64 + 0.5],
            ticks: dated.map(|(k, day)| (k as f64, day.day.clone())).collect(),
            ..ChartAxis::default()
        },
        y: ChartAxis::new("", Scale::Linear, [0.0, 1.12 * most], most.clamp(2.0, 4.0) as usize, &number),
        layers: vec![Layer { class: "bars".into(), marks: marks.collect(), ..Layer::default() }],
        ..Chart::default()
    };
    html! {
        div {
            div .wide .newest { (PreEscaped(chart.to_markup())) }
            p .legend {
                @for (class, text) in [("at-once", Text::AcceptedAtOnce), ("accepted", Text::AcceptedLater), ("other", Text::NotAcceptedAny)] {
                    span { span .key .(class) {} " " (text.to(language)) } " "
                }
                (Text::DaysOfUtc.to(language))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bar_heights_match_counts() {
        let day = |ended, accepted, at_once| Day { day: "07-04".into(), count: Count { ended, accepted, at_once } };
        let svg = bars(&[day(0, 0, 0), day(10, 8, 2)], Language::En).into_string();
        assert_eq!(svg.matches("<rect").count(), 3, "{svg}");
        let heights: Vec<f64> = svg
            .split("<rect")
            .skip(1)
            .map(|rect| rect.split("height=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap())
            .collect();
        assert!(
            (heights[0] / heights[1] - 2.0 / 6.0).abs() < 0.01 && (heights[2] / heights[1] - 2.0 / 6.0).abs() < 0.01,
            "{heights:?}"
        );
        assert!(!bars(&[], Language::En).into_string().contains("NaN"));
    }
}
