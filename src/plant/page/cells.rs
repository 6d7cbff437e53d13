//! State of every cell as it last reported it, with the time of that report. An old report does not show the present
//! state.

use std::cmp::Reverse;

use regrind_language::{Language, filled};

use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::super::{Row, ToSql};
use super::natural::natural_order;
use super::texts::{CellText, Text};
use super::words::ago;

/// Time without a report, in s, after which the state of a cell is unknown. A cell reports every second.
const SILENCE_S: f64 = 60.0;
/// Maximum number of cells on the page.
const MAX_CELLS: i64 = 2000;

/// Query of the last reports of all cells. A phase is a word, or an object whose only key is the word.
const REPORTED: &str = "SELECT cell, extract(epoch FROM now() - told_at)::double precision, run, coalesce(state, ''), coalesce(words, ''),
        coalesce(simulation, false), coalesce(part_name, ''), coalesce(serial, ''), cycle, most_cycles, done, total, left_least_s, left_most_s, alarms,
        coalesce(next, ''), coalesce(CASE jsonb_typeof(snapshot -> 'phase') WHEN 'string' THEN snapshot ->> 'phase'
            WHEN 'object' THEN (SELECT min(key) FROM jsonb_object_keys(snapshot -> 'phase') key) END, ''),
        coalesce(snapshot #>> '{next_step,step}', ''), coalesce(snapshot #>> '{next_step,device}', '')
    FROM cell_now ORDER BY cell LIMIT $1";

/// State of a cell, as the plant has it.
#[derive(Clone, Debug, Default)]
pub(super) struct CellSummary {
    pub(super) name: String,
    /// Seconds since the last report; `None` if the cell has never reported.
    pub(super) heard_s: Option<f64>,
    pub(super) run: Option<String>,
    pub(super) state: String,
    pub(super) description: String,
    pub(super) simulation: bool,
    pub(super) part: String,
    pub(super) serial: String,
    pub(super) cycle: Option<[i32; 2]>,
    pub(super) done: Option<[i32; 2]>,
    pub(super) remaining_s: Option<[f64; 2]>,
    pub(super) alarms: i32,
    /// Next action of a person, as a sentence of the cell in English.
    pub(super) next: String,
    /// Phase of the run, its next action, and the machine that this concerns, as words of the report; empty if the cell
    /// did not report them.
    pub(super) phase: String,
    pub(super) next_step: String,
    pub(super) device: String,
}

/// State of a cell as the page shows it, readable from two metres.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum DisplayState {
    /// An alarm, or an abort.
    Alarm,
    Held,
    /// The cell waits for a person.
    Asks,
    Runs,
    Still,
    /// Unknown state: the cell is silent.
    Silent,
}

impl DisplayState {
    pub(super) const ALL: [Self; 6] = [Self::Alarm, Self::Held, Self::Asks, Self::Runs, Self::Still, Self::Silent];

    pub(super) fn class(self) -> &'static str {
        match self {
            Self::Runs => "runs",
            Self::Held => "held",
            Self::Asks => "asks",
            Self::Alarm => "alarm",
            Self::Still => "still",
            Self::Silent => "lost",
        }
    }

    fn count_text(self) -> Text {
        match self {
            Self::Runs => Text::CountRunning,
            Self::Held => Text::CountHeld,
            Self::Asks => Text::CountWaiting,
            Self::Alarm => Text::CountAlarm,
            Self::Still => Text::CountIdle,
            Self::Silent => Text::CountSilent,
        }
    }

    /// Returns true if a person must do something at the cell.
    pub(super) fn needs_person(self) -> bool {
        matches!(self, Self::Alarm | Self::Held | Self::Asks)
    }

    /// Returns the SVG path of the symbol for this state. Symbols differ in shape, so that the state can be seen
    /// without colours.
    pub(super) fn shape(self) -> &'static str {
        match self {
            Self::Runs => "M6 3 L21 12 L6 21 Z",
            Self::Held => "M5 3 H10 V21 H5 Z M14 3 H19 V21 H14 Z",
            Self::Asks => "M12 2 A10 10 0 1 0 12 22 A10 10 0 1 0 12 2 Z",
            Self::Alarm => "M12 2 L23 21 H1 Z",
            Self::Still => "M4 4 H20 V20 H4 Z",
            Self::Silent => "M12 2 L22 12 L12 22 L2 12 Z",
        }
    }
}

/// Reads the last reported state of each cell from the plant, for at most `MAX_CELLS` cells, in the natural order of
/// their names. A cell keeps its place whatever its state.
pub(super) async fn read(link: &DatabaseLink) -> Result<Vec<CellSummary>, PlantError> {
    let rows = link.query(REPORTED, &[&MAX_CELLS as &(dyn ToSql + Sync)]).await?;
    let mut cells: Vec<CellSummary> = rows.iter().map(CellSummary::from_row).collect();
    cells.sort_by(|a, b| natural_order(&a.name, &b.name));
    Ok(cells)
}

impl CellSummary {
    fn from_row(row: &Row) -> Self {
        let pair = |k: usize| Some([row.get::<_, Option<i32>>(k)?, row.get::<_, Option<i32>>(k + 1)?]);
        let left = |k: usize| Some([row.get::<_, Option<f64>>(k)?, row.get::<_, Option<f64>>(k + 1)?]);
        Self {
            name: row.get(0),
            heard_s: row.get(1),
            run: row.get(2),
            state: row.get(3),
            description: row.get(4),
            simulation: row.get(5),
            part: row.get(6),
            serial: row.get(7),
            cycle: pair(8),
            done: pair(10),
            remaining_s: left(12),
            alarms: row.get(14),
            next: row.get(15),
            phase: row.get(16),
            next_step: row.get(17),
            device: row.get(18),
        }
    }

    fn is_silent(&self) -> bool {
        self.heard_s.is_none_or(|seconds| seconds > SILENCE_S)
    }

    pub(super) fn display_state(&self) -> DisplayState {
        let asks = !matches!(self.next_step.as_str(), "" | "nothing" | "keep_away" | "read_report");
        match self.state.as_str() {
            _ if self.is_silent() => DisplayState::Silent,
            "Aborting" | "Aborted" => DisplayState::Alarm,
            _ if self.alarms > 0 => DisplayState::Alarm,
            "Held" | "Holding" | "Suspending" | "Suspended" => DisplayState::Held,
            "Execute" | "Starting" | "Unholding" | "Unsuspending" | "Completing" if asks => DisplayState::Asks,
            "Execute" | "Starting" | "Unholding" | "Unsuspending" | "Completing" => DisplayState::Runs,
            _ => DisplayState::Still,
        }
    }

    /// Returns the state in one or two words. A state that this program does not know is shown as the cell described it.
    pub(super) fn state_word(&self, language: Language) -> String {
        if self.is_silent() {
            return self.heard(language);
        }
        let phase = match self.phase.as_str() {
            "load" => Some(CellText::Loading),
            "grind" => Some(CellText::Grinding),
            "transfer" => Some(CellText::Transferring),
            "measure" => Some(CellText::Measuring),
            "register" | "judge" | "compensate" => Some(CellText::Evaluating),
            _ => None,
        };
        let text = match self.state.as_str() {
            // Without a phase the description says more than the state.
            "Execute" if phase.is_none() && !self.description.is_empty() => None,
            "Execute" => Some(phase.unwrap_or(CellText::Executing)),
            other => state_text(other),
        };
        match text {
            Some(text) => text.to(language).to_owned(),
            None if self.description.is_empty() => self.state.clone(),
            None => self.description.clone(),
        }
    }

    /// Returns the time of the last report in words.
    pub(super) fn heard(&self, language: Language) -> String {
        let since = |text: Text, seconds| filled(text.to(language), &[("time", &ago(seconds, language))]);
        match self.heard_s {
            None => Text::NoReportYet.to(language).to_owned(),
            Some(seconds) if self.is_silent() => since(Text::NoReportFor, seconds),
            Some(seconds) => since(Text::HeardAgo, seconds),
        }
    }

    /// Returns the next action of a person as a sentence; empty if there is none. An action that this program does not
    /// know is shown as the cell said it.
    pub(super) fn next_action(&self, language: Language) -> String {
        let text = match self.next_step.as_str() {
            "nothing" => return String::new(),
            "load" => CellText::NextLoad,
            "see_clear" => CellText::NextSeeClear,
            "at_machine" => CellText::NextAtMachine,
            "see_to_alarm" => CellText::NextSeeToAlarm,
            "clear_alarm" => CellText::NextClearAlarm,
            "resume_or_stop" => CellText::NextResumeOrStop,
            "see_whether_it_stands" => CellText::NextSeeStands,
            "keep_away" => CellText::NextKeepAway,
            "emergency_circuit" => CellText::NextEmergencyCircuit,
            "read_report" => CellText::NextReadReport,
            _ => return self.next.clone(),
        };
        let machine = match self.device.as_str() {
            "Grinder" => Text::Grinder,
            "Cmm" => Text::Cmm,
            _ => Text::Machine,
        };
        filled(text.to(language), &[("machine", &machine.to(language))])
    }
}

/// Returns the word for a state by its PackML name, other than `Execute`. Returns `None` for another name.
fn state_text(name: &str) -> Option<CellText> {
    Some(match name {
        "Idle" => CellText::AtIdle,
        "Starting" => CellText::AtStarting,
        "Holding" => CellText::AtHolding,
        "Held" => CellText::AtHeld,
        "Unholding" => CellText::AtUnholding,
        "Suspending" => CellText::AtSuspending,
        "Suspended" => CellText::AtSuspended,
        "Unsuspending" => CellText::AtUnsuspending,
        "Stopping" => CellText::AtStopping,
        "Stopped" => CellText::AtStopped,
        "Aborting" => CellText::AtAborting,
        "Aborted" => CellText::AtAborted,
        "Completing" => CellText::AtCompleting,
        "Complete" => CellText::AtComplete,
        _ => return None,
    })
}

/// Returns a text with the number of cells in each state. States without a cell are omitted. If there is no cell, the
/// text says how to enrol one.
pub(super) fn tally(cells: &[CellSummary], language: Language) -> String {
    let count = |look: DisplayState| (cells.iter().filter(|cell| cell.display_state() == look).count(), look);
    let counts = DisplayState::ALL.map(count).into_iter().filter(|(count, _)| *count > 0);
    let words: Vec<String> =
        counts.map(|(count, look)| filled(look.count_text().to(language), &[("count", &count)])).collect();
    if words.is_empty() { Text::NoCellEnrolled.to(language).to_owned() } else { words.join(" · ") }
}

/// Returns the places of the cells that need a person: those with an alarm first, then held ones, then those that wait.
/// Cells with more alarms come first, otherwise the order is the natural one.
pub(super) fn needing_person(cells: &[CellSummary]) -> Vec<usize> {
    let mut places: Vec<usize> = (0..cells.len()).filter(|k| cells[*k].display_state().needs_person()).collect();
    places.sort_by_key(|k| (cells[*k].display_state(), Reverse(cells[*k].alarms), *k));
    places
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in super::super) fn cell(state: &str, heard_s: Option<f64>, alarms: i32) -> CellSummary {
        CellSummary {
            name: "<script>".into(),
            heard_s,
            run: Some("r&s".into()),
            state: state.into(),
            simulation: true,
            part: "<i>".into(),
            serial: "\u{202e}42".into(),
            cycle: Some([2, 6]),
            done: Some([30, 300]),
            remaining_s: Some([80.0, 130.0]),
            alarms,
            ..CellSummary::default()
        }
    }

    #[test]
    fn states_and_their_looks() {
        for heard in [None, Some(61.0), Some(1e9)] {
            assert_eq!(cell("Execute", heard, 1).display_state(), DisplayState::Silent);
        }
        let looks = [
            ("Execute", 0, "", DisplayState::Runs),
            ("Execute", 0, "nothing", DisplayState::Runs),
            ("Execute", 0, "load", DisplayState::Asks),
            ("Execute", 1, "load", DisplayState::Alarm),
            ("Held", 0, "resume_or_stop", DisplayState::Held),
            ("Aborting", 0, "keep_away", DisplayState::Alarm),
            ("Complete", 0, "read_report", DisplayState::Still),
            // A stop by a person is no alarm.
            ("Stopped", 0, "read_report", DisplayState::Still),
            ("Idle", 0, "", DisplayState::Still),
        ];
        for (state, alarms, next_step, look) in looks {
            let cell = CellSummary { next_step: next_step.into(), ..cell(state, Some(1.0), alarms) };
            assert_eq!(cell.display_state(), look, "{state}, {alarms}, {next_step}");
        }
    }

    #[test]
    fn state_in_words_of_each_language() {
        let word = |state: &str, phase: &str, language| {
            CellSummary { phase: phase.into(), ..cell(state, Some(1.0), 0) }.state_word(language)
        };
        for phase in ["register", "judge", "compensate"] {
            assert_eq!(word("Execute", phase, Language::En), "Evaluating");
        }
        assert_eq!(word("Idle", "", Language::En), "Idle");
        let mut words: Vec<String> = Vec::new();
        for &language in Language::ALL {
            words.extend(
                [("Idle", ""), ("Execute", "judge"), ("Execute", "grind"), ("Held", "grind")]
                    .map(|(s, p)| word(s, p, language)),
            );
        }
        let all = words.len();
        words.sort();
        words.dedup();
        assert_eq!(words.len(), all, "each word is of one language and of one state: {words:?}");
        // An unknown state is shown as the cell said it.
        assert_eq!(word("Odd", "odd", Language::De), "Odd");
        let told = CellSummary { description: "grinding".into(), ..cell("Execute", Some(1.0), 0) };
        assert_eq!(told.state_word(Language::De), "grinding");
    }

    #[test]
    fn list_of_those_who_need_a_person() {
        let of = |state: &str, alarms, next_step: &str| CellSummary {
            next_step: next_step.into(),
            ..cell(state, Some(1.0), alarms)
        };
        let cells = [
            of("Execute", 0, "load"),
            of("Idle", 0, ""),
            of("Held", 0, ""),
            of("Held", 2, ""),
            of("Execute", 0, ""),
            of("Aborted", 0, ""),
        ];
        assert_eq!(needing_person(&cells), [3, 5, 2, 0]);
        assert_eq!(
            tally(&cells, Language::En),
            "2 with an alarm or aborted · 1 held · 1 waiting for a person · 1 at work · 1 idle"
        );
        assert!(tally(&[], Language::En).contains("regrind plant enrol"));
    }

    #[test]
    fn next_action_names_the_machine() {
        let of = |step: &str, device: &str| CellSummary {
            next_step: step.into(),
            device: device.into(),
            next: "as told".into(),
            ..cell("Execute", Some(1.0), 0)
        };
        assert!(of("see_clear", "Grinder").next_action(Language::En).contains("Grinder"));
        assert!(of("see_clear", "odd").next_action(Language::En).contains("machine"));
        assert_eq!(of("bring", "").next_action(Language::En), "as told");
        assert_eq!(of("nothing", "").next_action(Language::En), "");
    }
}
