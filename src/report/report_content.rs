//! Content that all parts of a report have in common.

use super::maps::CycleMap;
use super::run_history::RunHistory;
use super::shop_header::ShopHeader;
use super::texts::ReportText as Text;
use regrind_journal::Verified;
use regrind_language::Language;

/// Options of a report: everything that it has besides its record.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReportOptions {
    /// Language of the texts.
    pub language: Language,
    /// Header of the shop; `None` for none.
    pub header: Option<ShopHeader>,
}

/// Content of a report.
pub(super) struct Report<'r> {
    pub(super) story: &'r RunHistory,
    pub(super) verified: &'r Verified,
    /// Maps of the first and of the last cycle.
    pub(super) maps: Vec<CycleMap>,
    pub(super) language: Language,
    pub(super) header: Option<&'r ShopHeader>,
}

impl Report<'_> {
    /// Returns a text in the language of the report.
    pub(super) fn say(&self, text: Text) -> &'static str {
        text.to(self.language)
    }

    /// Returns the serial number of the part, or the name of the run if it has none.
    pub(super) fn serial(&self) -> &str {
        self.story.begin.as_ref().map_or_else(|| self.run(), |begin| &begin.part)
    }

    /// Returns the mark of a simulation for captions; empty for a real run.
    pub(super) fn mark(&self) -> &'static str {
        if self.story.start.simulation == Some(true) { " SIMULATION" } else { "" }
    }

    /// Returns the title of the document.
    pub(super) fn title(&self) -> String {
        let [name, ..] = self.story.start.content.names();
        format!("{}, {}", name.unwrap_or("Part"), self.run())
    }

    /// Returns the texts at the foot of each page: on the left the program and the run, on the right the serial number
    /// and the mark of a simulation.
    pub(super) fn foot(&self) -> [String; 2] {
        let mark = if self.story.start.simulation == Some(true) { " \u{b7} SIMULATION" } else { "" };
        let program = self.story.start.regrind.as_deref().unwrap_or_default();
        [format!("Regrind {program} \u{b7} {}", self.run()), format!("{}{mark}", self.serial())]
    }

    pub(super) fn run(&self) -> &str {
        self.story.start.run.as_deref().unwrap_or_default()
    }
}

/// Formats a time from a record in a readable form, without fractions of a second, such as "2026-01-31 09:15:00 UTC".
/// `utc` is a time in UTC in the format RFC 3339.
pub(super) fn when(utc: &str) -> String {
    let second: String = utc.chars().take(19).collect();
    format!("{} UTC", second.replacen('T', " ", 1))
}
