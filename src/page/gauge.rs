//! Figure with its uncertainty and its limit: as a number, and as a bar that shows all three.

use maud::{Markup, PreEscaped, html};

use regrind_report::interval_bar;

use super::texts::Text;
use regrind_language::{Language, decimal};

/// Returns the HTML of a figure. `value_um` has the figure and its expanded uncertainty, in micrometres. `limit_um` is
/// the limit, if there is one. The bar begins at 0.
pub fn gauge(
    name: &str,
    [value_um, expanded_um]: [f64; 2],
    limit_um: Option<f64>,
    digits: usize,
    language: Language,
) -> Markup {
    let um = |value: f64| decimal(value, digits, language);
    let class = name.to_lowercase();
    html! {
        div .gauge .(class) {
            span .name { (name) }
            strong { (um(value_um)) }
            span .more {
                "± " (um(expanded_um)) " µm"
                @if let Some(limit_um) = limit_um { " · " (Text::Limit.to(language)) " " (um(limit_um)) }
            }
            (PreEscaped(interval_bar(
                [value_um - expanded_um, value_um, value_um + expanded_um],
                limit_um,
                limit_um.is_none_or(|limit_um| value_um + expanded_um <= limit_um),
            )))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The limit of 8 µm is the largest value: it lies at 0.9 of 400. The figure of 4 ± 1 µm lies at half of this.
    #[test]
    fn gauge_places_value_uncertainty_and_limit() {
        let html = gauge("PV", [4.0, 1.0], Some(8.0), 2, Language::De).into_string();
        for piece in ["4,00", "± 1,00 µm", "x=\"360.0\"", "width=\"180.0\"", "x=\"135.0\"", "width=\"90.0\""] {
            assert!(html.contains(piece), "{piece}: {html}");
        }
        assert!(!html.contains("beyond"), "{html}");
    }

    #[test]
    fn gauge_without_limit_or_number() {
        for (value_um, limit_um) in [([0.0, 0.0], None), ([f64::NAN, 1.0], Some(1.0)), ([1.0, f64::INFINITY], None)] {
            let html = gauge("RMS", value_um, limit_um, 3, Language::En).into_string();
            assert!(!html.contains("x=\"NaN") && !html.contains("=\"inf"), "{html}");
        }
        let beyond = gauge("PV", [7.0, 1.5], Some(8.0), 2, Language::En).into_string();
        assert!(beyond.contains("beyond"), "{beyond}");
    }
}
