//! Cycles a part: how many cycles accepted parts took, as a mean and as a distribution.
//!
//! A closed loop is not meant to be right at the first measurement: it corrects a part until it is good. The number of
//! cycles tells more of it than the first-pass yield.

use std::collections::HashMap;

use maud::{Markup, html};
use regrind_language::{Language, decimal, filled};

use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::selection::{DAY_BEGAN, NEWEST_FIRST};
use super::texts::Text;

/// Maximum number of parts that are counted: the newest.
pub(super) const COUNTED: i64 = 4000;
/// Number of classes of the distribution: 1, 2, 3, 4, and 5 or more cycles.
const CLASSES: usize = 5;
/// Width and height of the bar of a distribution, in pixels.
const SIZE: [f64; 2] = [120.0, 12.0];

/// Numbers of accepted parts by their cycles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct CycleCounts {
    classes: [i64; CLASSES],
    /// Sum of the cycles of all parts.
    sum: i64,
}

/// Cycles a part, by recipe and by cell.
#[derive(Debug, Default)]
pub(super) struct CyclesOfParts {
    pub(super) recipes: HashMap<String, CycleCounts>,
    pub(super) cells: HashMap<String, CycleCounts>,
    /// Number of parts that are counted.
    pub(super) parts: i64,
}

impl CycleCounts {
    /// Counts `parts` more parts that took `cycles` cycles each. A part without a cycle is not counted.
    pub(super) fn add(&mut self, cycles: i64, parts: i64) {
        if cycles < 1 || parts < 1 {
            return;
        }
        self.classes[(cycles as usize).min(CLASSES) - 1] += parts;
        self.sum += cycles * parts;
    }

    fn parts(&self) -> i64 {
        self.classes.iter().sum()
    }

    /// Returns the mean number of cycles as text; a dash without parts.
    pub(super) fn mean(&self, language: Language) -> String {
        if self.parts() == 0 {
            return "–".to_owned();
        }
        decimal(self.sum as f64 / self.parts() as f64, 2, language)
    }

    /// Returns the distribution in words: the number of parts of each class, such as `1: 12, 2: 30, ≥ 5: 1`.
    fn words(&self) -> String {
        let class = |(k, parts): (usize, &i64)| {
            (*parts > 0).then(|| format!("{}{}: {parts}", if k + 1 == CLASSES { "≥ " } else { "" }, k + 1))
        };
        self.classes.iter().enumerate().filter_map(class).collect::<Vec<_>>().join(", ")
    }

    /// Draws the distribution as a bar whose sections are the shares of parts with 1, 2, 3, 4, and 5 or more cycles.
    pub(super) fn bar(&self, language: Language) -> Markup {
        let parts = self.parts();
        if parts == 0 {
            return Markup::default();
        }
        let mut from = 0.0;
        let sections: Vec<(usize, f64, f64)> = self
            .classes
            .iter()
            .enumerate()
            .map(|(k, count)| {
                let width = SIZE[0] * *count as f64 / parts as f64;
                let section = (k + 1, from, width);
                from += width;
                section
            })
            .filter(|(.., width)| *width > 0.0)
            .collect();
        let words = filled(Text::CyclesInWords.to(language), &[("counts", &self.words())]);
        html! {
            svg .cycle-bar viewBox=(format!("0 0 {} {}", SIZE[0], SIZE[1])) preserveAspectRatio="none" role="img" aria-label=(words) {
                title { (words) }
                @for (class, x, width) in sections {
                    rect .(format!("cycles-{class}")) x=(format!("{x:.1}")) y="0" width=(format!("{width:.1}")) height=(SIZE[1]) {}
                }
            }
        }
    }
}

impl CyclesOfParts {
    /// Reads how many cycles the newest accepted parts took whose runs began on or after the day `since` (`2026-07-04`,
    /// UTC).
    pub(super) async fn read(link: &DatabaseLink, since: &str, simulated: bool) -> Result<Self, PlantError> {
        let world = if simulated { "simulation" } else { "NOT simulation" };
        // Limited before it is counted, so that an index answers whatever the number of runs.
        let text = format!(
            "SELECT recipe, cell, cycles, count(*), grouping(recipe, cell) FROM (
                SELECT recipe, cell, cycles FROM part_run WHERE {world} AND {DAY_BEGAN} >= $1::text::date AND result = 'accepted'
                ORDER BY {NEWEST_FIRST} LIMIT {COUNTED}) newest
             GROUP BY GROUPING SETS ((recipe, cycles), (cell, cycles))"
        );
        let mut found = Self::default();
        for row in link.query(&text, &[&since]).await? {
            let [cycles, parts] = [i64::from(row.get::<_, Option<i32>>(2).unwrap_or_default()), row.get(3)];
            let is_recipe = row.get::<_, i32>(4) == 0b01;
            let name = row.get::<_, Option<String>>(usize::from(!is_recipe)).unwrap_or_default();
            let of = if is_recipe { &mut found.recipes } else { &mut found.cells };
            of.entry(name).or_default().add(cycles, parts);
            found.parts += if is_recipe { parts } else { 0 };
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_and_distribution_of_cycles() {
        let mut counts = CycleCounts::default();
        for (cycles, parts) in [(1, 2), (2, 5), (7, 1), (5, 2), (0, 9), (3, 0)] {
            counts.add(cycles, parts);
        }
        // (2 + 10 + 7 + 10) / 10
        assert_eq!((counts.mean(Language::En), counts.words()), ("2.90".into(), "1: 2, 2: 5, ≥ 5: 3".into()));
        let svg = counts.bar(Language::De).into_string();
        for piece in [
            "cycles-1\" x=\"0.0\" y=\"0\" width=\"24.0\"",
            "cycles-2\" x=\"24.0\" y=\"0\" width=\"60.0\"",
            "cycles-5\" x=\"84.0\" y=\"0\" width=\"36.0\"",
        ] {
            assert!(svg.contains(piece), "{piece}: {svg}");
        }
        let none = CycleCounts::default();
        assert_eq!((none.mean(Language::En), none.bar(Language::En).into_string()), ("–".into(), String::new()));
    }
}
