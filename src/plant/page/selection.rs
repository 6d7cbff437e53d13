//! Selection of parts: the filters in an address, as a condition on the views and as a form.

use jiff::civil::Date;
use jiff::tz::TimeZone;
use jiff::{Timestamp, ToSpan};
use maud::{Markup, html};
use regrind_language::{Language, filled};
use serde::Deserialize;

use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::natural::natural_order;
use super::page_error::{Message, PageError};
use super::texts::Text;
use super::words::{encoded, shown};

/// Filters of parts: the column of the views, which is also the word in an address, and the label for people.
const KINDS: [(&str, Text); 6] = [
    ("recipe", Text::Recipe),
    ("cell", Text::Cell),
    ("grinder", Text::Grinder),
    ("cmm", Text::Cmm),
    ("wheel", Text::Wheel),
    ("probe", Text::Probe),
];
/// Day (UTC) on which a run began, as an expression on the views. The indexes of runs have it instead of the time: a
/// condition names it, and an order begins with it.
pub(super) const DAY_BEGAN: &str = "(began AT TIME ZONE 'UTC')::date";
/// Order of runs from the newest to the oldest, as the indexes of runs have it.
pub(super) const NEWEST_FIRST: &str = "(began AT TIME ZONE 'UTC')::date DESC, began DESC";
/// Number of days in the default period.
const DAYS: i64 = 90;
/// Maximum number of names in a form.
const NAMES: i64 = 5000;

/// Query of an address. A missing parameter receives its default.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct SelectionQuery {
    recipe: Option<String>,
    cell: String,
    grinder: String,
    cmm: String,
    wheel: String,
    probe: String,
    /// The first and the last day on which a run began, `2026-07-04`, UTC.
    since: String,
    until: String,
    /// `real` or `simulated`.
    parts: String,
    /// `first` or `last`: the measurement before any correction, or the one that the part was judged by.
    at: String,
}

/// Selection of parts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Selection {
    /// Names in the order of [`KINDS`]; an empty name matches any.
    names: [String; 6],
    since: Date,
    until: Date,
    /// True for simulated parts. Simulated and real parts are never counted together.
    pub(super) simulated: bool,
    pub(super) first: bool,
}

impl Selection {
    /// Builds the selection of parts from `asked`, the query of an address. A filter that `asked` does not contain gets
    /// its default:
    ///
    /// - real parts if the plant has any, otherwise simulated parts;
    /// - the recipe of the newest of these parts;
    /// - today (UTC) as the last day;
    /// - [`DAYS`] days before the last day as the first day.
    ///
    /// Returns an error if a date is invalid or if the plant cannot be reached.
    pub(super) async fn from_query(link: &DatabaseLink, asked: &SelectionQuery) -> Result<Self, PageError> {
        let simulated = is_simulated(link, &asked.parts).await?;
        let recipe = match &asked.recipe {
            Some(recipe) => recipe.clone(),
            None => newest_recipe(link, simulated).await?,
        };
        let SelectionQuery { cell, grinder, cmm, wheel, probe, since, until, at, .. } = asked.clone();
        let today = today();
        let until = day(&until)?.unwrap_or(today);
        let before = until.checked_sub(DAYS.days()).unwrap_or(Date::MIN);
        // No text in the database contains a zero character, so a name with one matches nothing.
        let names = [recipe, cell, grinder, cmm, wheel, probe].map(|name| name.replace('\0', ""));
        Ok(Self { names, since: day(&since)?.unwrap_or(before), until, simulated, first: at == "first" })
    }

    /// Returns the selection as an SQL condition on `part_run`, and the values of the parameters in this condition. The
    /// parameters are `$1`, `$2` and so on, in the order of the values.
    pub(super) fn condition(&self) -> (String, Vec<String>) {
        self.condition_on(|column, n| match column {
            // An index has the number of the cell, and the order of its runs.
            "cell" => format!("cell_id = (SELECT id FROM cell WHERE name = ${n})"),
            column => format!("{column} = ${n}"),
        })
    }

    /// Returns the same as [`Selection::condition`] for a query of one cell after the other. Machines and tools are
    /// compared without an index: the index of the cell finds its few runs, and that of a wheel finds those of all cells.
    pub(super) fn condition_within_cell(&self) -> (String, Vec<String>) {
        self.condition_on(|column, n| match column {
            "recipe" => format!("recipe = ${n}"),
            column => format!("coalesce({column}, '') = ${n}"),
        })
    }

    fn condition_on(&self, equal: impl Fn(&str, usize) -> String) -> (String, Vec<String>) {
        let mut values = vec![self.since.to_string(), self.until.to_string()];
        let world = if self.simulated { "simulation" } else { "NOT simulation" };
        let mut text = format!("{world} AND {DAY_BEGAN} BETWEEN $1::text::date AND $2::text::date");
        for ((column, _), name) in KINDS.iter().zip(&self.names).filter(|(_, name)| !name.is_empty()) {
            values.push(name.clone());
            text += &format!(" AND {}", equal(column, values.len()));
        }
        (text, values)
    }

    /// Returns the name of the selected recipe. An empty name selects all recipes.
    pub(super) fn recipe(&self) -> &str {
        &self.names[0]
    }

    /// Returns the selection as the query part of an address. The query contains all filters that are set, both dates,
    /// and the choice of real or simulated parts, also if they are defaults. So the address keeps its meaning when the
    /// defaults change later.
    pub(super) fn query(&self) -> String {
        let named = KINDS.iter().zip(&self.names).filter(|((kind, _), name)| *kind == "recipe" || !name.is_empty());
        let mut query: Vec<String> = named.map(|((kind, _), name)| format!("{kind}={}", encoded(name))).collect();
        query.push(format!("since={}&until={}", self.since, self.until));
        query.push(format!("parts={}", if self.simulated { "simulated" } else { "real" }));
        query.push(format!("at={}", if self.first { "first" } else { "last" }));
        query.join("&")
    }

    /// Describes the selection in a short text for people, such as "Recipe mirror, begun 2026-07-01 to 2026-07-04 (UTC)".
    pub(super) fn words(&self, language: Language) -> String {
        let named = KINDS.iter().zip(&self.names).filter(|(_, name)| !name.is_empty());
        let named: Vec<String> =
            named.map(|((_, word), name)| format!("{} {}", word.to(language), shown(name))).collect();
        let named = if named.is_empty() { Text::AllParts.to(language).to_owned() } else { named.join(", ") };
        let values: [(&str, &dyn std::fmt::Display); 3] =
            [("parts", &named), ("since", &self.since), ("until", &self.until)];
        filled(Text::BegunBetween.to(language), &values)
    }

    /// Renders the HTML form in which a person changes the selection. `action` is the address to which the form is
    /// sent. `kinds` are the keys of the filters that the form offers, such as `recipe` or `cell`. The form always
    /// offers the dates, and the choice of real or simulated parts. Returns an error if the plant cannot be reached.
    pub(super) async fn form(
        &self,
        link: &DatabaseLink,
        action: &str,
        kinds: &[&str],
        language: Language,
    ) -> Result<Markup, PlantError> {
        let say = |text: Text| text.to(language);
        let rows = link.query("SELECT kind, name FROM choice ORDER BY kind, name LIMIT $1", &[&NAMES]).await?;
        let names: Vec<(&str, &str)> = rows.iter().map(|row| (row.get(0), row.get(1))).collect();
        let chosen = |(kind, word): &(&str, Text), name: &String| {
            let mut known: Vec<&str> = names.iter().filter(|(of, _)| of == kind).map(|(_, name)| *name).collect();
            if !name.is_empty() && !known.contains(&name.as_str()) {
                known.push(name);
            }
            known.sort_by(|a, b| natural_order(a, b));
            html! {
                label { (say(*word)) " "
                    select name=(kind) {
                        option value="" { (say(Text::Any)) }
                        @for each in known { option value=(each) selected[each == name] { (shown(each)) } }
                    }
                }
            }
        };
        Ok(html! {
            form .filter method="get" action=(action) {
                @for (kind, name) in KINDS.iter().zip(&self.names).filter(|((kind, _), _)| kinds.contains(kind)) { (chosen(kind, name)) }
                label { (say(Text::Since)) " " input type="date" name="since" value=(self.since); }
                label { (say(Text::Until)) " " input type="date" name="until" value=(self.until); }
                @if kinds.len() == KINDS.len() {
                    label { (say(Text::Measured)) " " select name="at" {
                        option value="last" { (say(Text::AtLast)) }
                        option value="first" selected[self.first] { (say(Text::AtFirst)) }
                    } }
                }
                label { (say(Text::Parts)) " " select name="parts" {
                    option value="real" { (say(Text::Real)) }
                    option value="simulated" selected[self.simulated] { (say(Text::Simulated)) }
                } }
                button { (say(Text::Show)) }
            }
        })
    }
}

/// Keys of all filters that a form can have.
pub(super) const ALL_KINDS: [&str; 6] = [KINDS[0].0, KINDS[1].0, KINDS[2].0, KINDS[3].0, KINDS[4].0, KINDS[5].0];

/// Returns true if simulated parts are selected. `asked` is `real` or `simulated`. For any other text, returns true if
/// the plant has no real part.
pub(super) async fn is_simulated(link: &DatabaseLink, asked: &str) -> Result<bool, PlantError> {
    match asked {
        "real" => Ok(false),
        "simulated" => Ok(true),
        _ => {
            let rows = link.query("SELECT NOT EXISTS (SELECT FROM part_run WHERE NOT simulation)", &[]).await?;
            Ok(rows.first().is_some_and(|row| row.get(0)))
        }
    }
}

async fn newest_recipe(link: &DatabaseLink, simulated: bool) -> Result<String, PlantError> {
    let world = if simulated { "simulation" } else { "NOT simulation" };
    let text =
        format!("SELECT recipe FROM part_run WHERE {world} AND recipe IS NOT NULL ORDER BY {NEWEST_FIRST} LIMIT 1");
    let rows = link.query(&text, &[]).await?;
    Ok(rows.first().map_or_else(String::new, |row| row.get(0)))
}

/// Renders the mark SIMULATION for simulated parts, and nothing for real parts.
pub(super) fn mark(simulated: bool, language: Language) -> Markup {
    html! { @if simulated { span .simulation { (Text::Simulation.to(language)) } } }
}

pub(super) fn today() -> Date {
    Timestamp::now().to_zoned(TimeZone::UTC).date()
}

/// Parses a date that a person wrote, such as 2026-07-04. Returns `None` for an empty text, and an error for an invalid
/// date.
fn day(text: &str) -> Result<Option<Date>, PageError> {
    let text = text.trim();
    if text.is_empty() {
        return Ok(None);
    }
    // Accepts only days that the database can represent.
    let found = text.parse::<Date>().ok().filter(|day| (1970..=9000).contains(&day.year()));
    let bad = || PageError::Nonsense(Message::Text(Text::NoDate, vec![("text", format!("{text:?}"))]));
    found.map(Some).ok_or_else(bad)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn selection(names: [&str; 6]) -> Selection {
        let day = |text: &str| text.parse().unwrap();
        let names = names.map(str::to_owned);
        Selection { names, since: day("2026-07-01"), until: day("2026-07-04"), simulated: true, first: false }
    }

    #[test]
    fn condition_binds_names_as_parameters() {
        let hostile = "x' OR '1'='1";
        let (text, values) = selection(["", hostile, "", "", "R 5", ""]).condition();
        assert!(
            !text.contains(hostile)
                && text.ends_with("AND cell_id = (SELECT id FROM cell WHERE name = $3) AND wheel = $4"),
            "{text}"
        );
        assert_eq!(values, ["2026-07-01", "2026-07-04", hostile, "R 5"]);
    }

    #[test]
    fn selection_query_string() {
        let query = selection(["a&b", "", "", "", "", ""]).query();
        assert_eq!(query, "recipe=a%26b&since=2026-07-01&until=2026-07-04&parts=simulated&at=last");
    }

    #[test]
    fn day_refuses_invalid_dates() {
        assert!(matches!(day("yesterday"), Err(PageError::Nonsense(_))) && matches!(day(" "), Ok(None)));
        assert!(matches!(day("-9999-01-01"), Err(PageError::Nonsense(_))));
    }
}
