//! `/trend`: PV and RMS of consecutive parts, with control limits and tolerance.

use axum::extract::{Query, State};
use axum::response::Response;
use maud::{Markup, html};
use regrind_language::{Language, decimal, filled};
use regrind_page::Reader;

use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::capability::{Distribution, Index, MIN_PARTS, NoCapability, capability};
use super::content::{PageContent, page};
use super::control_chart::{ENOUGH, Figure, Limits, Value, ranges};
use super::nelson::{Broken, FALSE_ALARMS, RULES, broken_rules, expected_by_chance};
use super::page_error::PageError;
use super::selection::{ALL_KINDS, NEWEST_FIRST, Selection, SelectionQuery, mark};
use super::shared::Shared;
use super::texts::Text;
use super::words::{name, um, when};

/// Maximum number of parts in a chart, and of parts in the list of those that break a rule.
const MAX_PARTS: i64 = 250;
const LISTED: usize = 5;

/// Query of parts by their last measurement, up to its first condition: those that were judged for good.
const LAST_MEASURED: &str = "SELECT id, serial, cell, to_char(began, 'YYYY-MM-DD HH24:MI:SS'), pv_um, pv_u_um, pv_limit_um, rms_um, rms_u_um, rms_limit_um
    FROM part_run WHERE result IN ('accepted', 'not accepted') AND pv_um IS NOT NULL";
/// Query of parts by their first measurement. The limit makes the database read one cycle of each run that it shows,
/// and never all cycles.
const FIRST_MEASURED: &str = "SELECT id, serial, cell, to_char(began, 'YYYY-MM-DD HH24:MI:SS'), y.pv_um, y.pv_u_um, pv_limit_um, y.rms_um, y.rms_u_um, rms_limit_um
    FROM (SELECT id, serial, cell, cell_id, began, recipe, grinder, cmm, wheel, probe, simulation, pv_limit_um, rms_limit_um FROM part_run) p
        CROSS JOIN LATERAL (SELECT pv_um, pv_u_um, rms_um, rms_u_um FROM cycle WHERE run = p.id AND cycle = 1 LIMIT 1) y
    WHERE y.pv_um IS NOT NULL";

/// Part with its two figures.
pub(super) struct Part {
    pub(super) pv: Value,
    pub(super) rms: Option<Value>,
}

pub(super) async fn trend(
    State(plant): State<Shared>,
    reader: Reader,
    Query(asked): Query<SelectionQuery>,
) -> Response {
    page(&reader, made(&plant, &asked, reader.language)).await
}

async fn made(plant: &Shared, asked: &SelectionQuery, language: Language) -> Result<PageContent, PageError> {
    let say = |text: Text| text.to(language);
    let link = plant.lease().await?;
    let selection = Selection::from_query(&link, asked).await?;
    let form = selection.form(&link, "/trend", &ALL_KINDS, language).await?;
    let parts = parts(&link, &selection, MAX_PARTS).await?;
    let main = html! {
        main .list .plant {
            h1 { (say(Text::Trend)) " " (mark(selection.simulated, language)) }
            (form)
            p .quiet {
                (selection.words(language)) ": " (filled(say(if parts.len() == 1 { Text::OnePart } else { Text::CountParts }), &[("count", &parts.len())]))
                @if parts.len() as i64 == MAX_PARTS { " " (say(Text::OnlyNewest)) }
            }
            @if selection.recipe().is_empty() { p .warns { (say(Text::RecipesInChart)) } }
            (charts(&parts, &selection, language))
            p {
                a href=(format!("/export.csv?{}", selection.query())) { "CSV" } " · "
                a href=(format!("/trend.dfq?{}", selection.query())) { "DFQ (Q-DAS)" }
            }
        }
    };
    Ok(PageContent { title: say(Text::Trend).into(), again_s: None, main })
}

/// Reads the `most` newest parts of a selection, by the start of their run. Returns the parts from the oldest to the
/// newest. Omits a part without a finite PV. Where the last measurement is asked for, a part counts only if it was judged
/// for good: the figures of a run that is under way, was stopped or broke off are those of an unfinished part.
pub(super) async fn parts(link: &DatabaseLink, selection: &Selection, most: i64) -> Result<Vec<Part>, PlantError> {
    let (condition, values) = selection.condition();
    let text = if selection.first { FIRST_MEASURED } else { LAST_MEASURED };
    let text = format!("{text} AND {condition} ORDER BY {NEWEST_FIRST} LIMIT {most}");
    let values: Vec<_> = values.iter().map(|value| value as &(dyn super::super::ToSql + Sync)).collect();
    let rows = link.query(&text, &values).await?;
    let part = |row: &super::super::Row| {
        let value = |um: f64, k: usize| Value {
            run: row.get(0),
            serial: row.get(1),
            cell: row.get(2),
            when: row.get(3),
            um,
            u_um: row.get(k),
            limit_um: row.get(k + 1),
        };
        let finite = |k: usize| row.get::<_, Option<f64>>(k).filter(|um| um.is_finite());
        Some(Part { pv: value(finite(4)?, 5), rms: finite(7).map(|um| value(um, 8)) })
    };
    Ok(rows.iter().rev().filter_map(part).collect())
}

fn charts(parts: &[Part], selection: &Selection, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let pv: Vec<Value> = parts.iter().map(|part| part.pv.clone()).collect();
    let rms: Vec<Value> = parts.iter().filter_map(|part| part.rms.clone()).collect();
    html! {
        @if pv.len() < 2 { p { (say(Text::TooFewForChart)) } }
        @else if pv.len() < ENOUGH {
            p .warns { (filled(say(Text::PreliminaryLimits), &[("count", &pv.len()), ("enough", &ENOUGH)])) }
        }
        @for (name, class, values) in [("PV", "pv", &pv), ("RMS", "rms", &rms)] {
            (figure([name, class], values, selection, language))
        }
        @if pv.len() >= 2 {
            p .quiet {
                (say(Text::LimitsAre)) " " (say(Text::TimesAre)) " " span data-zone=(say(Text::LocalTime)) { "UTC" } ". "
                (filled(say(Text::FalseAlarmsAre), &[("share", &decimal(100.0 * FALSE_ALARMS.iter().sum::<f64>(), 1, language))]))
            }
        }
    }
}

fn figure([name, class]: [&str; 2], values: &[Value], selection: &Selection, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let all: Vec<f64> = values.iter().map(|value| value.um).collect();
    let Some(limits) = Limits::from_values(&all) else { return Markup::default() };
    let broken = broken_rules(&all, limits.zones());
    let figure = Figure { name, class, values, limits: &limits, language };
    let far = figure.tolerance().filter(|_| figure.tolerance_is_far());
    html! {
        section .card .figure data-figure=(name) {
            h2 .unseen { (name) }
            div .charts {
                div .wide .newest { (figure.individuals(&broken)) }
                @if let Some(limit) = far { p .quiet { (filled(say(Text::ToleranceIsAbove), &[("limit", &um(Some(limit), 2, language))])) } }
                div .wide .newest { (figure.moving_ranges()) }
            }
            div .side {
                (limits_of(&limits, values, language))
                (capability_of(values, &broken, selection, language))
                (rules_of(values, &broken, language))
                (ranges_of(&all, values, &limits, language))
            }
        }
    }
}

/// Lists the limits of a control chart, and how many parts are above their tolerance.
fn limits_of(limits: &Limits, values: &[Value], language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let number = |value: f64| um(Some(value), 3, language);
    let over = values.iter().filter(|value| value.limit_um.is_some_and(|limit| value.um > limit)).count();
    let limited = values.iter().filter(|value| value.limit_um.is_some()).count();
    html! {
        dl .about .limits {
            dt { (say(Text::MeanOfChart)) } dd { strong { (number(limits.mean)) } " µm" }
            dt { (say(Text::ControlLimits)) }
            dd { @match limits.lower { Some(lower) => { strong { (number(lower)) } " – " } None => { "≤ " } } strong { (number(limits.upper)) } " µm" }
            dt { (say(Text::MeanRange)) } dd { (number(limits.mean_range)) " µm (≤ " (number(limits.range_upper)) ")" }
            dt { (say(Text::AboveTolerance)) } dd { (filled(say(Text::CountOfAll), &[("count", &over), ("all", &limited)])) }
        }
    }
}

/// Shows the capability of the process with its conditions.
fn capability_of(values: &[Value], broken: &[Broken], selection: &Selection, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let all: Vec<f64> = values.iter().map(|value| value.um).collect();
    let limits: Vec<Option<f64>> = values.iter().map(|value| value.limit_um).collect();
    let number = |value: f64| decimal(value, 2, language);
    let shown = |index: Index| {
        let [low, high] = index.interval.map(number);
        html! { strong { (number(index.value)) } " (" (low) " – " (high) ")" }
    };
    let none = |reason: Text| html! { dd { "– " span .quiet { (filled(say(reason), &[("count", &MIN_PARTS)])) } } };
    html! {
        dl .about .capability {
            dt { "Cp" } dd { "– " span .quiet { (say(Text::OneSided)) } }
            dt { "Cpk" }
            @if selection.recipe().is_empty() { (none(Text::CapabilityOneRecipe)) } @else {
                @match capability(&all, &limits) {
                    Ok(found) => {
                        dd { (shown(found.within)) }
                        dt { "Ppk" } dd { (shown(found.overall)) }
                        dt { (say(Text::DistributionIs)) } dd { (say(distribution_text(found.distribution))) }
                    }
                    Err(reason) => { (none(no_capability_text(reason))) }
                }
            }
        }
        @if !selection.recipe().is_empty() && capability(&all, &limits).is_ok() { (control_of(broken, selection, language)) }
    }
}

/// Says whether the process is in control: otherwise its capability predicts nothing.
fn control_of(broken: &[Broken], selection: &Selection, language: Language) -> Markup {
    let marked = broken.iter().filter(|broken| broken.any()).count();
    let [mean, bound] = expected_by_chance(broken.len());
    let counts: [(&str, &dyn std::fmt::Display); 3] =
        [("count", &marked), ("all", &broken.len()), ("chance", &decimal(mean, 0, language))];
    let text = if marked as f64 > bound { Text::NotInControl } else { Text::CheckRules };
    html! {
        @if marked > 0 { p .warns { (filled(text.to(language), &counts)) } }
        @if !selection.first { p .quiet { (Text::CapabilityOfLoop.to(language)) } }
    }
}

fn distribution_text(distribution: Distribution) -> Text {
    match distribution {
        Distribution::Normal => Text::NormalDistribution,
        Distribution::LogNormal => Text::LogNormalDistribution,
    }
}

fn no_capability_text(reason: NoCapability) -> Text {
    match reason {
        NoCapability::TooFewParts => Text::CapabilityTooFew,
        NoCapability::NoLimit => Text::CapabilityNoLimit,
        NoCapability::SeveralLimits => Text::CapabilitySeveralLimits,
        NoCapability::NoSpread => Text::CapabilityNoSpread,
        NoCapability::OtherDistribution => Text::CapabilityOtherDistribution,
    }
}

/// Lists the broken rules in words, each with its newest parts.
fn rules_of(values: &[Value], broken: &[Broken], language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    const WORDS: [Text; RULES] =
        [Text::Rule1, Text::Rule2, Text::Rule3, Text::Rule4, Text::Rule5, Text::Rule6, Text::Rule7, Text::Rule8];
    let places = |rule: usize| -> Vec<&Value> {
        values.iter().zip(broken).rev().filter(|(_, broken)| broken.has(rule)).map(|(value, _)| value).collect()
    };
    let found: Vec<(usize, Text, Vec<&Value>)> =
        (1..).zip(WORDS).map(|(rule, text)| (rule, text, places(rule))).filter(|(.., at)| !at.is_empty()).collect();
    html! {
        h3 { (say(Text::NelsonsRules)) }
        @if found.is_empty() { p .quiet { (say(Text::NoRuleBroken)) } }
        @for (rule, text, at) in &found {
            details .rule data-rule=(rule) {
                summary { strong .number { (rule) } " " (say(*text)) ": " (filled(say(Text::PointsNewest), &[("count", &at.len())])) }
                (list(at, language))
            }
        }
    }
}

/// Lists the moving ranges above their limit by the parts after the step.
fn ranges_of(all: &[f64], values: &[Value], limits: &Limits, language: Language) -> Markup {
    let above: Vec<&Value> = ranges(all)
        .iter()
        .zip(&values[1..])
        .rev()
        .filter(|(range, _)| **range > limits.range_upper)
        .map(|(_, value)| value)
        .collect();
    html! {
        @if !above.is_empty() {
            details .rule data-rule="range" {
                summary { (filled(Text::RangesAbove.to(language), &[("count", &above.len()), ("all", &(values.len() - 1))])) }
                (list(&above, language))
            }
        }
    }
}

/// Renders a list of the first parts of `values`, with links to their runs.
fn list(values: &[&Value], language: Language) -> Markup {
    html! {
        ul .out {
            @for value in values.iter().take(LISTED) {
                li {
                    a href=(format!("/runs/{}", value.run)) { (name(&value.serial)) } " " (um(Some(value.um), 3, language)) " µm"
                    @if let Some(u) = value.u_um { " ± " (um(Some(u), 3, language)) } " "
                    span .quiet { (name(&value.cell)) " " (when(&value.when)) }
                }
            }
        }
    }
}
