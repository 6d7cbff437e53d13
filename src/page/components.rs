//! Page of all components of the look, each in each of its states: for people who change the look, and for the tests
//! that measure it in every theme.

use axum::Extension;
use axum::http::HeaderMap;
use axum::response::Response;
use maud::{Markup, PreEscaped, html};
use regrind_report::{Chart, ChartAxis, Dot, Layer, Mark, Scale, Shape};

use super::gauge::gauge;
use super::guard::Session;
use super::reader::language;
use super::texts::Text;
use super::view::plain_document;
use regrind_language::{Language, decimal};

/// Colours of the look by their names in the style sheet, with their meanings.
const COLOURS: [(&str, &str); 18] = [
    ("page", "ground of the page"),
    ("ground", "ground of cards"),
    ("panel", "ground of quiet parts"),
    ("track", "empty part of a bar"),
    ("line", "borders and grid lines"),
    ("ink", "text"),
    ("quiet", "text of less weight"),
    ("link", "links and focus"),
    ("accent", "the next action, and the step that is on"),
    ("runs", "a cell that runs"),
    ("good", "accepted"),
    ("amber", "HOLD, and attention"),
    ("held", "attention as text"),
    ("alarm", "ABORT and alarms"),
    ("asks", "a person is asked"),
    ("still", "a cell at rest"),
    ("pv", "peak-to-valley"),
    ("rms", "root mean square"),
];

/// States of the chip at the head of a cell: class and state.
const CHIPS: [(&str, &str); 8] = [
    ("runs", "EXECUTE"),
    ("held", "HELD"),
    ("asks", "EXECUTE"),
    ("alarm", "ABORTING"),
    ("bad", "ABORTED"),
    ("good", "ACCEPTED"),
    ("rejected", "NOT ACCEPTED"),
    ("lost", "?"),
];

/// Serves the page of the components.
pub(crate) async fn components(Extension(session): Extension<Session>, headers: HeaderMap) -> Response {
    let language = language(&headers);
    let main = html! {
        main .list .components {
            h1 { (Text::Components.to(language)) }
            (colours())
            (type_scale())
            (buttons(language))
            (chips())
            (figures(language))
            (messages())
            (fields())
        }
    };
    plain_document(Text::Components.to(language), &session, language, main)
}

fn colours() -> Markup {
    html! {
        section .card {
            h2 { "Colours" }
            div .swatches {
                @for (name, meaning) in COLOURS {
                    figure {
                        svg .swatch viewBox="0 0 60 30" preserveAspectRatio="none" aria-hidden="true" { rect .(format!("of-{name}")) width="60" height="30" {} }
                        figcaption { strong { (name) } br; (meaning) }
                    }
                }
            }
        }
    }
}

fn type_scale() -> Markup {
    html! {
        section .card {
            h2 { "Type" }
            p .size-3 { "26 px: PV 3.87 µm" }
            p .size-2 { "19 px: load and clamp the part" }
            p { "15 px: text of the page, 0123456789" }
            p .quiet { "13 px: names of axes, times, names of files" }
        }
    }
}

/// Returns the buttons, each enabled and disabled.
fn buttons(language: Language) -> Markup {
    let orders = [("hold", Text::Hold), ("resume", Text::Resume), ("stop", Text::Stop), ("abort", Text::Abort)];
    html! {
        section .card {
            h2 { "Buttons" }
            @for is_disabled in [false, true] {
                div .orders .shown {
                    @for (class, text) in orders {
                        button type="button" class=(class) disabled[is_disabled] { (text.to(language)) }
                    }
                }
            }
            div .choices {
                button type="button" aria-pressed="true" { "chosen" }
                button type="button" aria-pressed="false" { "not chosen" }
                button type="button" disabled { "disabled" }
                a href="/components" { "a link" }
            }
        }
    }
}

fn chips() -> Markup {
    html! {
        section .card {
            h2 { "States" }
            div .chips {
                @for (class, state) in CHIPS {
                    div .banner .(class) { div .state { div { strong { (state) } span .more { (class) } } } }
                }
            }
            span .simulation { "SIMULATION" }
        }
    }
}

/// Returns gauges below, at and above a limit, and a chart with all its marks.
fn figures(language: Language) -> Markup {
    let number = |value: f64, decimals: usize| decimal(value, decimals, language);
    let dot = |at: [f64; 2], shape| Mark::Dot(Dot { at, shape, ..Dot::default() });
    let line = |name: &str, class: &str, scale: f64| Layer {
        name: name.to_owned(),
        class: class.to_owned(),
        marks: vec![
            Mark::Across { class: "limit", name: format!("{name} limit"), at: 4.0 * scale },
            Mark::Band(vec![[1.0, 18.0 * scale, 22.0 * scale], [2.0, 5.0 * scale, 7.0 * scale]]),
            Mark::Line(vec![[1.0, 20.0 * scale], [2.0, 6.0 * scale]]),
            dot([1.0, 20.0 * scale], Shape::Disc),
            dot([2.0, 6.0 * scale], Shape::Disc),
            Mark::Dashes(vec![[2.0, 6.0 * scale], [3.0, 3.0 * scale]]),
            dot([3.0, 3.0 * scale], Shape::Hollow),
        ],
    };
    let chart = Chart {
        description: "A chart with all its marks".into(),
        size: [420.0, 190.0],
        right_margin: 90.0,
        x: ChartAxis::of_integers(Text::Cycle.to(language), [1, 3], 10),
        y: ChartAxis::new("µm", Scale::Log, [0.2, 30.0], 9, &number),
        layers: vec![line("PV", "pv", 1.0), line("RMS", "rms", 0.15)],
        ..Chart::default()
    };
    html! {
        section .card {
            h2 { "Figures" }
            (gauge("PV", [3.87, 0.99], Some(7.0), 2, language))
            (gauge("RMS", [1.2, 0.1], Some(1.0), 3, language))
            (gauge("PV", [3.87, 0.99], None, 2, language))
            (PreEscaped(chart.to_markup()))
            progress max="100" value="40" aria-label="a bar" {}
        }
    }
}

fn messages() -> Markup {
    html! {
        section .card {
            h2 { "Messages" }
            article .alarm { h3 { "An alarm that is raised" } ol { li { "The first thing to do." } li { "The next one." } } }
            article .alarm .past { h3 { "An alarm that is withdrawn" } p .quiet { "12:00:05" } }
            p .warns { "A value that calls for attention" }
            p .record { span .verified { "The record is as it was written." } }
            p .record { span .broken { "The record is not as it was written." } }
        }
    }
}

fn fields() -> Markup {
    html! {
        section .card {
            h2 { "Fields and tables" }
            p { label { "Text " input value="1.5"; } " " label { "Choice " select { option { "first" } option { "second" } } } }
            table {
                tr { th { "Name" } th .n { "Value, µm" } }
                tr { td { "PV" } td .n { "3.87" } }
                tr .limit { td { "limit" } td .n { "7.00" } }
            }
        }
    }
}
