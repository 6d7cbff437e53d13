//! Convergence of the figures from cycle to cycle, and distribution of the last error.

use super::ReportError;
use super::axis::{Ruler, Scale, grouped};
use super::colour::ColourMap;
use super::plot::{Axis, Plot, Series};
use super::run_history::RunHistory;
use super::svg::{Anchor, Frame, LARGE, SMALL, Svg};

/// Returns an SVG plot of PV and RMS in µm for each measured cycle of the run, with the limits of both. The vertical
/// axis is logarithmic. Returns `None` in these cases:
///
/// - the record of the run contains no tolerance;
/// - fewer than two cycles have figures;
/// - a number to draw is not finite or not above 0.
pub(super) fn convergence(story: &RunHistory) -> Option<String> {
    let tolerance = story.tolerance()?;
    let measured = story.cycles.iter().filter_map(|(cycle, of)| {
        Some((f64::from(*cycle), of.measurements.iter().rev().find_map(|of| of.figures.as_ref())?))
    });
    let all: Vec<_> = measured.map(|(cycle, figures)| (cycle, tolerance.compare(figures))).collect();
    let ([(first, found), .., (last, _)], Some(_)) = (&all[..], all.get(1)) else { return None };
    let line = |k: usize| all.iter().map(|(cycle, found)| [*cycle, 1e3 * found[k].median_mm]).collect();
    let of = |k: usize| {
        let (name, limit_um) = (found[k].name, 1e3 * found[k].limit_mm);
        let limit = limit_um
            .is_finite()
            .then(|| Series { name: format!("limit of {name}"), points: vec![[*first, limit_um], [*last, limit_um]] });
        [Some(Series { name: name.to_owned(), points: line(k) }), limit]
    };
    let plot = Plot {
        title: "Convergence".into(),
        x: Axis { label: "cycle".into(), scale: Scale::Linear },
        y: Axis { label: "\u{b5}m".into(), scale: Scale::Log },
        series: [0, 1].into_iter().flat_map(of).flatten().collect(),
    };
    // A figure of zero cannot be drawn on a logarithmic axis. The table contains it.
    plot.to_svg().ok()
}

/// Number of bars of a histogram.
const BARS: usize = 41;
const CORNER: [f64; 2] = [70.0, 58.0];
const SIZE: [f64; 2] = [460.0, 180.0];

/// Returns a histogram of the errors of a map as SVG. `samples_um` contains x, y and the error in µm of each node of
/// the map; x and y are not used. The axis of the error is symmetric about zero, and its limit is the largest absolute
/// error. Each bar has the colour that the diverging colour map gives its error. `title` is the title of the figure.
pub(super) fn histogram(title: &str, samples_um: &[[f64; 3]]) -> Result<String, ReportError> {
    let largest = samples_um.iter().fold(0.0_f64, |largest, [.., error]| largest.max(error.abs()));
    let limit = if largest > 0.0 { largest } else { 1.0 };
    let mut counts = [0_usize; BARS];
    for [.., error] in samples_um {
        let share = (error / limit + 1.0) / 2.0;
        counts[((share * BARS as f64) as usize).min(BARS - 1)] += 1;
    }
    let most = counts.iter().copied().max().unwrap_or(0).max(1) as f64;
    let [left, top] = CORNER;
    let [width, height] = SIZE;
    let x = Ruler::new(Scale::Linear, [-limit, limit], [left, left + width]);
    let y = Ruler::new(Scale::Linear, [0.0, most], [top + height, top]);
    let mut svg = Svg::new(left + width + 30.0, top + height + 54.0);
    svg.text([left, 24.0], Anchor::Start, LARGE, title);
    let below = format!("{} nodes of the filtered map", grouped(samples_um.len()));
    svg.text([left, 44.0], Anchor::Start, SMALL, &below);
    for (k, count) in counts.iter().enumerate() {
        let share = (k as f64 + 0.5) / BARS as f64;
        let [r, g, b] = ColourMap::Diverging.at(share);
        let begin = left + width * k as f64 / BARS as f64;
        let end = y.pixel(*count as f64);
        svg.rectangle([begin, end], [width / BARS as f64, top + height - end], &format!("#{r:02x}{g:02x}{b:02x}"));
    }
    svg.frame(&Frame {
        corner: CORNER,
        size: SIZE,
        x_ticks: x.ticks(8),
        y_ticks: y.ticks(4),
        x_label: "error / \u{b5}m",
        y_label: "nodes",
        grid: false,
    });
    Ok(svg.finish())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn histogram_counts_every_node_once() {
        let samples: Vec<[f64; 3]> = (0..=100).map(|k| [f64::from(k), 0.0, f64::from(k) / 10.0 - 5.0]).collect();
        let svg = histogram("a <title>", &samples).unwrap();
        roxmltree::Document::parse(&svg).unwrap();
        assert!(svg.contains("101 nodes") && !svg.contains("NaN"), "{svg}");
        assert_eq!(svg.matches("<rect").count(), 1 + BARS + 1, "paper, bars and frame");
        let flat = histogram("zero", &[[0.0, 0.0, 0.0]; 3]).unwrap();
        assert!(!flat.contains("NaN") && !flat.contains("inf"), "{flat}");
    }
}
