//! Convergence of the figures from cycle to cycle, and distribution of the last error.

use super::axis::{Scale, fixed, grouped};
use super::chart::{Chart, ChartAxis, Dot, Layer, Mark};
use super::colour::ColourMap;
use super::run_history::RunHistory;

/// Returns an SVG plot of PV and RMS in µm for each measured cycle of the run, with the limits of both. The vertical
/// axis is logarithmic. Returns `None` in these cases:
///
/// - the record of the run contains no tolerance;
/// - fewer than two cycles have figures;
/// - a number to draw is not finite or not above 0.
pub(super) fn convergence(story: &RunHistory) -> Option<String> {
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
        let name = |um: f64| format!("limit of {} {}", found[k].name, fixed(um, 2));
        let mut marks: Vec<Mark> =
            limit.map(|at| Mark::Across { class: "limit", name: name(at), at }).into_iter().collect();
        let points: Vec<[f64; 2]> =
            all.iter().map(|(cycle, found)| [f64::from(*cycle), 1e3 * found[k].median_mm]).collect();
        let dot = |at: &[f64; 2]| {
            Mark::Dot(Dot {
                at: *at,
                tooltip: format!("{} {} \u{b5}m", found[k].name, fixed(at[1], 3)),
                ..Dot::default()
            })
        };
        let dots: Vec<Mark> = points.iter().map(dot).collect();
        marks.push(Mark::Line(points));
        marks.extend(dots);
        Layer { name: found[k].name.to_owned(), class: ["pv", "rms"][k].to_owned(), marks }
    };
    let chart = Chart {
        title: "Convergence".into(),
        size: [620.0, 300.0],
        right_margin: 170.0,
        x: ChartAxis::of_integers("cycle", [*first, *last], 12),
        y: ChartAxis::new("\u{b5}m", Scale::Log, [low / 1.6, 1.2 * high], 9, &fixed),
        layers: vec![layer(0), layer(1)],
        ..Chart::default()
    };
    Some(chart.to_file())
}

/// Number of bars of a histogram.
const BARS: usize = 41;

/// Returns a histogram of the errors of a map as SVG. `samples_um` contains x, y and the error in µm of each node of
/// the map; x and y are not used. The axis of the error is symmetric about zero, and its limit is the largest absolute
/// error. Each bar has the colour that the diverging colour map gives its error. `title` is the title of the figure.
pub(super) fn histogram(title: &str, samples_um: &[[f64; 3]]) -> String {
    let largest = samples_um.iter().fold(0.0_f64, |largest, [.., error]| largest.max(error.abs()));
    let limit = if largest > 0.0 { largest } else { 1.0 };
    let mut counts = [0_usize; BARS];
    for [.., error] in samples_um {
        let share = (error / limit + 1.0) / 2.0;
        counts[((share * BARS as f64) as usize).min(BARS - 1)] += 1;
    }
    let most = counts.iter().copied().max().unwrap_or(0).max(1) as f64;
    let edge = |k: usize| limit * (2.0 * k as f64 / BARS as f64 - 1.0);
    let bar = |(k, count): (usize, &usize)| Mark::Bar {
        class: "",
        fill: Some(ColourMap::Diverging.at((k as f64 + 0.5) / BARS as f64)),
        x: [edge(k), edge(k + 1)],
        y: [0.0, *count as f64],
        tooltip: String::new(),
    };
    let marks = counts.iter().enumerate().map(bar).collect();
    let nodes = format!("{title}: {} nodes of the filtered map", grouped(samples_um.len()));
    let chart = Chart {
        title: nodes,
        size: [560.0, 270.0],
        right_margin: 30.0,
        x: ChartAxis::new("error / \u{b5}m", Scale::Linear, [-limit, limit], 8, &fixed),
        y: ChartAxis::new("nodes", Scale::Linear, [0.0, most], 4, &fixed),
        layers: vec![Layer { marks, ..Layer::default() }],
        ..Chart::default()
    };
    chart.to_file()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn histogram_counts_every_node_once() {
        let samples: Vec<[f64; 3]> = (0..=100).map(|k| [f64::from(k), 0.0, f64::from(k) / 10.0 - 5.0]).collect();
        let svg = histogram("a <title>", &samples);
        roxmltree::Document::parse(&svg).unwrap();
        assert!(svg.contains("101 nodes") && !svg.contains("NaN"), "{svg}");
        assert_eq!(svg.matches("<rect").count(), 1 + BARS, "paper and bars");
        let flat = histogram("zero", &[[0.0, 0.0, 0.0]; 3]);
        assert!(!flat.contains("NaN") && !flat.contains("inf"), "{flat}");
    }
}
