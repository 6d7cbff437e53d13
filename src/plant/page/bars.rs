//! Bars of parts per day: accepted at the first measurement, accepted after a correction, and not accepted.

use maud::{Markup, html};

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 190.0;
const LEFT: f64 = 40.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = 24.0;

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
/// not accepted.
pub(super) fn bars(days: &[Day]) -> Markup {
    let most = days.iter().map(|day| day.count.ended).max().unwrap_or(0).max(1);
    let step = (super::control_chart::round_step(most as f64 / 4.0) as i64).max(1);
    let y = |count: i64| HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * count as f64 / (1.08 * most as f64);
    let wide = (WIDTH - LEFT) / days.len().max(1) as f64;
    let bar = |k: usize, class: &str, from: i64, to: i64| {
        let (x, height) = (LEFT + wide * (k as f64 + 0.15), y(from) - y(to));
        html! {
            @if to > from {
                rect .(class) x=(format!("{x:.1}")) width=(format!("{:.1}", 0.7 * wide)) y=(format!("{:.1}", y(to))) height=(format!("{height:.1}")) {}
            }
        }
    };
    let told = |day: &Day| {
        let Count { ended, accepted, at_once } = day.count;
        format!("{}: {ended} ended, {accepted} accepted, {at_once} at the first measurement", day.day)
    };
    html! {
        svg .chart .bars viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(days.iter().map(told).collect::<Vec<_>>().join("; ")) {
            @for tick in (0..=most).step_by(usize::try_from(step).unwrap_or(1)) {
                @let at = format!("{:.1}", y(tick));
                line .grid x1=(LEFT) x2=(WIDTH) y1=(at) y2=(at) {}
                text .tick x=(LEFT - 6.0) y=(at) dy="4" text-anchor="end" { (tick) }
            }
            @for (k, day) in days.iter().enumerate() {
                @let Count { ended, accepted, at_once } = day.count;
                g {
                    title { (told(day)) }
                    (bar(k, "at-once", 0, at_once)) (bar(k, "accepted", at_once, accepted)) (bar(k, "other", accepted, ended))
                    @if ended > 0 { text .count x=(format!("{:.1}", LEFT + wide * (k as f64 + 0.5))) y=(format!("{:.1}", y(ended) - 3.0)) text-anchor="middle" { (ended) } }
                }
                @if (days.len() - 1 - k).is_multiple_of(2) { text .tick x=(format!("{:.1}", LEFT + wide * (k as f64 + 0.5))) y=(HEIGHT - 6.0) text-anchor="middle" { (day.day) } }
            }
        }
        p .legend {
            span .key .at-once {} " accepted at the first measurement " span .key .accepted {} " accepted after corrections "
            span .key .other {} " not accepted, stopped or aborted"
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bar_heights_match_counts() {
        let day = |ended, accepted, at_once| Day { day: "07-04".into(), count: Count { ended, accepted, at_once } };
        let svg = bars(&[day(0, 0, 0), day(10, 8, 2)]).into_string();
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
        assert!(!bars(&[]).into_string().contains("NaN"));
    }
}
