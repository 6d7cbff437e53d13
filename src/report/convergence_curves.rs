//! Convergence of PV and RMS from cycle to cycle as the pages show it: with limits, uncertainty and the forecast for the
//! next cycle.

use regrind_language::{Language, decimal};

use super::axis::Scale;
use super::chart::{Chart, ChartAxis, Dot, Layer, Mark, Shape};

/// Width and height of the chart, and the space to the right of its axes, in pixels.
const SIZE: [f64; 2] = [420.0, 190.0];
const RIGHT: f64 = 84.0;

/// One figure over the cycles.
#[derive(Clone, Debug)]
pub struct ConvergenceCurve {
    /// Name of the figure, such as PV.
    pub name: &'static str,
    /// Class of the curve, which decides its colour.
    pub class: &'static str,
    /// Cycle, value and expanded uncertainty, in micrometres.
    points: Vec<(u32, f64, f64)>,
    /// Limit in micrometres; infinite without a limit.
    limit_um: f64,
    /// Forecast for the next cycle: its number and the expected value.
    forecast: Option<(u32, f64)>,
}

/// Words of the chart in the language of the page.
#[derive(Clone, Copy, Debug)]
pub struct ConvergenceWords {
    /// Language of the decimal sign.
    pub language: Language,
    /// The word for a cycle.
    pub cycle: &'static str,
    /// The word for a limit.
    pub limit: &'static str,
    /// The word for a forecast.
    pub forecast: &'static str,
}

impl ConvergenceCurve {
    /// Creates the curve of the figure with the name and the class `named`. `points` has the cycle, the value and the
    /// expanded uncertainty in micrometres. A value that is not finite or not above 0 has no place on the logarithmic
    /// axis and is left out. `limit_um` is the limit. `expected` is the forecast for the cycle after the last one, from
    /// the number of the last one.
    pub fn new(
        named: [&'static str; 2],
        points: impl IntoIterator<Item = (u32, f64, f64)>,
        limit_um: Option<f64>,
        expected: impl Fn(u32) -> Option<f64>,
    ) -> Self {
        let can_be_shown = |value: f64| value > 0.0 && value.is_finite();
        let points: Vec<_> = points.into_iter().filter(|(_, value, _)| can_be_shown(*value)).collect();
        let last = points.last().map(|(cycle, ..)| *cycle);
        let forecast =
            last.and_then(|last| Some((last + 1, expected(last)?))).filter(|(_, value)| can_be_shown(*value));
        let limit_um = limit_um.filter(|um| um.is_finite()).unwrap_or(f64::INFINITY);
        Self { name: named[0], class: named[1], points, limit_um, forecast }
    }

    /// Returns the forecast for the next cycle: its number and the expected value in micrometres.
    pub fn forecast(&self) -> Option<(u32, f64)> {
        self.forecast
    }
}

/// Returns a chart of the error of a part after each cycle, in micrometres. Returns `None` if no curve has a measured
/// point.
pub fn convergence_chart(curves: &[ConvergenceCurve], words: ConvergenceWords) -> Option<Chart> {
    let [x, y] = axes(curves, words)?;
    let layers = curves.iter().map(|curve| layer(curve, y.range[0], words)).collect();
    let description = description(curves, words);
    Some(Chart { description, size: SIZE, right_margin: RIGHT, x, y, layers, ..Chart::default() })
}

/// Returns the marks of a curve. `low_um` is the lower end of the vertical axis.
fn layer(curve: &ConvergenceCurve, low_um: f64, words: ConvergenceWords) -> Layer {
    let um = |value: f64| decimal(value, 2, words.language);
    let at = |cycle: u32, value: f64| [f64::from(cycle), value];
    let dot = |at, shape, tooltip| Mark::Dot(Dot { at, shape, tooltip, ..Dot::default() });
    let mut marks = Vec::new();
    if curve.limit_um.is_finite() && curve.limit_um > 0.0 {
        let name = format!("{} {}", curve.name, words.limit);
        marks.push(Mark::Across { class: "limit", name, at: curve.limit_um });
    }
    let band = |(cycle, value, u): &(u32, f64, f64)| [f64::from(*cycle), (value - u).max(low_um), value + u];
    marks.push(Mark::Band(curve.points.iter().map(band).collect()));
    marks.push(Mark::Line(curve.points.iter().map(|(cycle, value, _)| at(*cycle, *value)).collect()));
    marks.extend(curve.points.iter().map(|(cycle, value, u)| {
        dot(at(*cycle, *value), Shape::Disc, format!("{} {} ± {} µm", curve.name, um(*value), um(*u)))
    }));
    if let (Some((cycle, value)), Some((from, last, _))) = (curve.forecast, curve.points.last()) {
        marks.push(Mark::Dashes(vec![at(*from, *last), at(cycle, value)]));
        let tooltip = format!("{} {} {} µm", curve.name, words.forecast, um(value));
        marks.push(dot(at(cycle, value), Shape::Hollow, tooltip));
    }
    Layer { name: String::new(), class: curve.class.to_owned(), marks }
}

/// Returns the values of the chart as one text for a screen reader: the name of each curve and, for each cycle, the
/// number of the cycle and the value in µm.
fn description(curves: &[ConvergenceCurve], words: ConvergenceWords) -> String {
    let text = |curve: &ConvergenceCurve| {
        let points = curve
            .points
            .iter()
            .map(|(cycle, value, _)| format!("{} {cycle}: {} µm", words.cycle, decimal(*value, 2, words.language)));
        format!("{}: {}", curve.name, points.collect::<Vec<_>>().join(", "))
    };
    curves.iter().map(text).collect::<Vec<_>>().join("; ")
}

/// Returns the axes for the curves: cycles to the right, micrometres upwards on a logarithmic axis. The horizontal axis
/// covers all measured and forecast cycles. The vertical axis covers all measured values, limits and forecasts. A
/// forecast above this range is drawn at the upper edge of the chart. Returns `None` if no curve has a measured point.
fn axes(curves: &[ConvergenceCurve], words: ConvergenceWords) -> Option<[ChartAxis; 2]> {
    let all = || curves.iter().flat_map(|curve| &curve.points);
    let first = all().map(|(cycle, ..)| *cycle).min()?;
    let forecast = || curves.iter().filter_map(|curve| curve.forecast);
    let last = all().map(|(cycle, ..)| *cycle).chain(forecast().map(|(cycle, _)| cycle)).max()?;
    let limits = curves.iter().map(|curve| curve.limit_um).filter(|limit| limit.is_finite() && *limit > 0.0);
    let values = || all().map(|(_, value, u)| value + u).chain(all().map(|(_, value, _)| *value)).chain(limits.clone());
    let low = values().chain(forecast().map(|(_, value)| value)).fold(f64::INFINITY, f64::min) / 1.6;
    let high = values().fold(0.0, f64::max) * 1.2;
    let number = |value: f64, decimals: usize| decimal(value, decimals, words.language);
    let x = ChartAxis::of_integers(words.cycle, [first, last.max(first + 1)], 12);
    Some([x, ChartAxis::new("µm", Scale::Log, [low, high], 9, &number)])
}

#[cfg(test)]
mod tests {
    use super::*;

    const WORDS: ConvergenceWords =
        ConvergenceWords { language: Language::En, cycle: "cycle", limit: "limit", forecast: "forecast" };

    fn curve(expected: Option<f64>) -> ConvergenceCurve {
        let points = [(1, 28.79, 0.4), (2, 3.6, 0.2), (3, f64::NAN, 0.1), (4, 0.0, 0.1)];
        ConvergenceCurve::new(["PV", "pv"], points, Some(7.0), |_| expected)
    }

    #[test]
    fn every_measured_cycle_and_limit_shown() {
        let svg = convergence_chart(&[curve(None)], WORDS).unwrap().to_markup();
        assert_eq!((svg.matches("<circle").count(), svg.matches("PV limit").count()), (2, 1), "{svg}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }

    #[test]
    fn forecast_is_for_cycle_after_last() {
        assert_eq!(curve(Some(2.0)).forecast(), Some((3, 2.0)));
        assert_eq!(curve(Some(f64::NAN)).forecast(), None);
        let none = ConvergenceCurve::new(["PV", "pv"], [], None, |_| Some(2.0));
        assert_eq!(none.forecast(), None);
        assert!(convergence_chart(&[none], WORDS).is_none());
    }
}
