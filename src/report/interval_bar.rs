//! Bar of a figure: its value, its uncertainty and its limit on one scale that begins at 0.

/// Width of the bar in the units of its picture.
const WIDTH: f64 = 400.0;
/// Share of the width that the largest of the interval and the limit takes.
const LARGEST_SHARE: f64 = 0.9;

/// Returns the bar of a figure as an SVG element of a page. `interval` has the lower end, the value and the upper end.
/// The interval and the limit have one unit, and the style sheet of the page gives the colours of the classes `track`,
/// `value`, `uncertainty`, `limit` and `beyond`. A number that is not
/// finite has no mark. `is_within` is false if the figure does not keep its limit by the rule of its decision; the limit
/// is then `beyond`.
pub fn interval_bar(interval: [f64; 3], limit: Option<f64>, is_within: bool) -> String {
    let [low, value, high] = interval;
    let limit = limit.filter(|limit| limit.is_finite());
    let largest = limit.unwrap_or(0.0).max(high).max(value);
    let scale = if largest > 0.0 && largest.is_finite() { LARGEST_SHARE * WIDTH / largest } else { 0.0 };
    let place = |value: f64| {
        let place = (value * scale).clamp(0.0, WIDTH);
        if place.is_finite() { place } else { 0.0 }
    };
    let rect = |class: &str, x: f64, width: f64, [y, height]: [u32; 2]| {
        format!("<rect class=\"{class}\" x=\"{x:.1}\" y=\"{y}\" width=\"{width:.1}\" height=\"{height}\"/>")
    };
    let class = if is_within { "limit" } else { "limit beyond" };
    let mark = limit.map_or(String::new(), |limit| rect(class, place(limit), 3.0, [0, 16]));
    format!(
        "<svg class=\"interval\" viewBox=\"0 0 {WIDTH} 16\" preserveAspectRatio=\"none\" aria-hidden=\"true\">{}{}{}{mark}</svg>",
        rect("track", 0.0, WIDTH, [3, 10]),
        rect("value", 0.0, place(value), [3, 10]),
        rect("uncertainty", place(low), place(high) - place(low), [5, 6]),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The limit of 8 is the largest value: it lies at 0.9 of 400. The figure of 4 ± 1 lies at half of this.
    #[test]
    fn bar_places_value_interval_and_limit() {
        let svg = interval_bar([3.0, 4.0, 5.0], Some(8.0), true);
        for piece in [
            "class=\"limit\" x=\"360.0\"",
            "class=\"value\" x=\"0.0\" y=\"3\" width=\"180.0\"",
            "class=\"uncertainty\" x=\"135.0\" y=\"5\" width=\"90.0\"",
        ] {
            assert!(svg.contains(piece), "{piece}: {svg}");
        }
        assert!(!svg.contains("beyond"), "{svg}");
        assert!(interval_bar([5.5, 7.0, 8.5], Some(8.0), false).contains("limit beyond"));
        roxmltree::Document::parse(&svg).unwrap();
    }

    #[test]
    fn bar_without_limit_or_number() {
        let odd = [
            ([0.0; 3], None),
            ([f64::NAN; 3], Some(1.0)),
            ([0.0, 1.0, f64::INFINITY], None),
            ([1.0; 3], Some(f64::INFINITY)),
        ];
        for (interval, limit) in odd {
            let svg = interval_bar(interval, limit, true);
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }
}
