//! Figure with its uncertainty and its limit: as a number, and as a bar that shows all three.

use maud::{Markup, html};

use super::texts::Text;
use regrind_language::{Language, decimal};

/// Width of the bar in the units of its picture.
const WIDTH: f64 = 400.0;
/// Share of the width that the larger of the figure and the limit takes.
const LARGEST_SHARE: f64 = 0.9;

/// Returns the HTML of a figure. `value_um` has the figure and its expanded uncertainty, in micrometres. `limit_um` is
/// the limit, if there is one. The bar begins at 0.
pub(crate) fn gauge(
    name: &str,
    [value_um, expanded_um]: [f64; 2],
    limit_um: Option<f64>,
    digits: usize,
    language: Language,
) -> Markup {
    let um = |value: f64| decimal(value, digits, language);
    let bar = Bar::fitting([value_um, expanded_um], limit_um);
    let is_beyond = limit_um.is_some_and(|limit_um| value_um + expanded_um > limit_um);
    let class = name.to_lowercase();
    html! {
        div .gauge .(class) {
            span .name { (name) }
            strong { (um(value_um)) }
            span .more {
                "± " (um(expanded_um)) " µm"
                @if let Some(limit_um) = limit_um { " · " (Text::Limit.to(language)) " " (um(limit_um)) }
            }
            svg viewBox=(format!("0 0 {WIDTH} 16")) preserveAspectRatio="none" aria-hidden="true" {
                rect .track x="0" y="3" width=(WIDTH) height="10" {}
                rect .value x="0" y="3" width=(bar.place(value_um)) height="10" {}
                rect .uncertainty x=(bar.place(value_um - expanded_um)) y="5" width=(bar.width(value_um, expanded_um)) height="6" {}
                @if let Some(limit_um) = limit_um {
                    rect .limit .beyond[is_beyond] x=(bar.place(limit_um)) y="0" width="3" height="16" {}
                }
            }
        }
    }
}

/// Scale of the bar.
struct Bar {
    per_um: f64,
}

impl Bar {
    fn fitting([value_um, expanded_um]: [f64; 2], limit_um: Option<f64>) -> Self {
        let largest_um = (value_um + expanded_um).max(limit_um.unwrap_or(0.0));
        let is_usable = largest_um > 0.0 && largest_um.is_finite();
        Self { per_um: if is_usable { LARGEST_SHARE * WIDTH / largest_um } else { 0.0 } }
    }

    /// Returns the place of a value on the bar, as a number of the picture.
    fn place(&self, um: f64) -> String {
        let place = (um * self.per_um).clamp(0.0, WIDTH);
        format!("{:.1}", if place.is_finite() { place } else { 0.0 })
    }

    /// Returns the width of the interval of a figure, as a number of the picture.
    fn width(&self, value_um: f64, expanded_um: f64) -> String {
        let [low, high] =
            [value_um - expanded_um, value_um + expanded_um].map(|um| (um * self.per_um).clamp(0.0, WIDTH));
        format!("{:.1}", if (high - low).is_finite() { high - low } else { 0.0 })
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
