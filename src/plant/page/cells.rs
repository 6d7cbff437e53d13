//! State of every cell as it last reported it, with the time of that report. An old report does not show the present
//! state.

use maud::{Markup, html};

use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::super::{Row, ToSql};
use super::words::{ago, encoded, range, shown};

/// Time without a report, in s, after which the state of a cell is unknown. A cell reports every second.
const SILENCE_S: f64 = 60.0;
/// Maximum number of cells on the page.
const MAX_CELLS: i64 = 2000;

/// State of a cell, as the plant has it.
pub(super) struct CellSummary {
    name: String,
    /// Seconds since the last report; `None` if the cell has never reported.
    heard_s: Option<f64>,
    run: Option<String>,
    state: String,
    description: String,
    simulation: bool,
    part: String,
    serial: String,
    cycle: Option<[i32; 2]>,
    done: Option<[i32; 2]>,
    remaining_s: Option<[f64; 2]>,
    alarms: i32,
    next: String,
}

/// State of a cell as the page shows it, readable from two metres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum DisplayState {
    Runs,
    Held,
    Alarm,
    Still,
    /// Unknown state: the cell is silent.
    Silent,
}

impl DisplayState {
    const ALL: [Self; 5] = [Self::Alarm, Self::Silent, Self::Held, Self::Runs, Self::Still];

    fn class(self) -> &'static str {
        match self {
            Self::Runs => "runs",
            Self::Held => "held",
            Self::Alarm => "alarm",
            Self::Still => "still",
            Self::Silent => "lost",
        }
    }

    fn words(self) -> &'static str {
        match self {
            Self::Runs => "at work",
            Self::Held => "held",
            Self::Alarm => "with an alarm or aborted",
            Self::Still => "without a run",
            Self::Silent => "silent",
        }
    }

    /// Returns the SVG path of the symbol for this state. Symbols differ in shape, so that the state can be seen
    /// without colours.
    fn shape(self) -> &'static str {
        match self {
            Self::Runs => "M6 3 L21 12 L6 21 Z",
            Self::Held => "M5 3 H10 V21 H5 Z M14 3 H19 V21 H14 Z",
            Self::Alarm => "M12 2 L23 21 H1 Z",
            Self::Still => "M4 4 H20 V20 H4 Z",
            Self::Silent => "M12 2 L22 12 L12 22 L2 12 Z",
        }
    }
}

/// Reads the last reported state of each cell from the plant, for at most `MAX_CELLS` cells. Cells with an alarm come
/// first, then cells that have not reported for a time, then the others.
pub(super) async fn read(link: &DatabaseLink) -> Result<Vec<CellSummary>, PlantError> {
    let text = "SELECT cell, extract(epoch FROM now() - told_at)::double precision, run, coalesce(state, ''), coalesce(words, ''),
            coalesce(simulation, false), coalesce(part_name, ''), coalesce(serial, ''), cycle, most_cycles, done, total, left_least_s,
            left_most_s, alarms, coalesce(next, '')
        FROM cell_now ORDER BY cell LIMIT $1";
    let mut cells: Vec<CellSummary> =
        link.query(text, &[&MAX_CELLS as &(dyn ToSql + Sync)]).await?.iter().map(CellSummary::from_row).collect();
    cells.sort_by_key(|cell| DisplayState::ALL.iter().position(|look| *look == cell.display_state()));
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
        }
    }

    fn is_silent(&self) -> bool {
        self.heard_s.is_none_or(|seconds| seconds > SILENCE_S)
    }

    fn display_state(&self) -> DisplayState {
        match self.state.as_str() {
            _ if self.is_silent() => DisplayState::Silent,
            "Aborting" | "Aborted" => DisplayState::Alarm,
            _ if self.alarms > 0 => DisplayState::Alarm,
            "Execute" | "Starting" | "Unholding" | "Unsuspending" | "Completing" => DisplayState::Runs,
            "Held" | "Holding" | "Suspending" | "Suspended" => DisplayState::Held,
            _ => DisplayState::Still,
        }
    }

    fn heard(&self) -> String {
        match self.heard_s {
            None => "no report yet".to_owned(),
            Some(seconds) if self.is_silent() => format!("no report for {}", ago(seconds)),
            Some(seconds) => format!("heard {} ago", ago(seconds)),
        }
    }
}

/// Returns a text with the number of cells in each state. States without a cell are omitted. If there is no cell, the
/// text says how to enrol one.
pub(super) fn tally(cells: &[CellSummary]) -> String {
    let of = |look: DisplayState| (cells.iter().filter(|cell| cell.display_state() == look).count(), look);
    let told = DisplayState::ALL.map(of).into_iter().filter(|(count, _)| *count > 0);
    let told: Vec<String> = told.map(|(count, look)| format!("{count} {}", look.words())).collect();
    if told.is_empty() {
        "no cell is enrolled yet; to enrol one: regrind plant enrol".to_owned()
    } else {
        told.join(" · ")
    }
}

/// Draws a card for each cell as HTML. A card shows the name and the state of the cell, the part, and the time of the
/// last report. If the cell still reports, the card also shows the progress of the current job and the number of
/// alarms, if there are any.
pub(super) fn cards(cells: &[CellSummary]) -> Markup {
    html! { div .cells { @for cell in cells { (card(cell)) } } }
}

fn card(cell: &CellSummary) -> Markup {
    let look = cell.display_state();
    html! {
        article .cell .(look.class()) data-cell=(shown(&cell.name)) {
            h3 {
                svg .shape viewBox="0 0 24 24" aria-hidden="true" { path d=(look.shape()) {} }
                span .name { (shown(&cell.name)) }
                @if cell.simulation { span .simulation { "SIMULATION" } }
            }
            @if look == DisplayState::Silent {
                p .state { strong { (cell.heard()) } }
                p { "Its present state is unknown." @if !cell.description.is_empty() { " Last report: " (shown(&cell.description)) } }
                (of_part(cell))
            } @else {
                p .state { strong { (shown(if cell.description.is_empty() { &cell.state } else { &cell.description })) } }
                (of_part(cell))
                @if let Some([done, total]) = cell.done {
                    progress max=(total.max(1)) value=(done.clamp(0, total.max(1))) aria-label="of the job under way" {}
                    p .left { (done) " of " (total) @if let Some(left) = cell.remaining_s { ", " strong { (range(left)) } " left" } }
                }
                @if cell.alarms > 0 { p .alarms { strong { (cell.alarms) @if cell.alarms == 1 { " alarm" } @else { " alarms" } } } }
                @if !cell.next.is_empty() && matches!(look, DisplayState::Held | DisplayState::Alarm) { p { "Next: " (shown(&cell.next)) } }
                p .quiet { (cell.heard()) }
            }
        }
    }
}

fn of_part(cell: &CellSummary) -> Markup {
    let Some(run) = &cell.run else { return Markup::default() };
    html! {
        p {
            a href=(format!("/run?cell={}&name={}", encoded(&cell.name), encoded(run))) {
                (shown(if cell.serial.is_empty() { run } else { &cell.serial }))
            }
            " " (shown(&cell.part))
            @if let Some([cycle, most]) = cell.cycle.filter(|[cycle, _]| *cycle > 0) { ", cycle " (cycle) " of at most " (most) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(state: &str, heard_s: Option<f64>, alarms: i32) -> CellSummary {
        CellSummary {
            name: "<script>".into(),
            heard_s,
            run: Some("r&s".into()),
            state: state.into(),
            description: String::new(),
            simulation: true,
            part: "<i>".into(),
            serial: "\u{202e}42".into(),
            cycle: Some([2, 6]),
            done: Some([30, 300]),
            remaining_s: Some([80.0, 130.0]),
            alarms,
            next: String::new(),
        }
    }

    #[test]
    fn silent_cell_not_shown_running() {
        for heard in [None, Some(61.0), Some(1e9), Some(f64::NAN)] {
            let silent = cell("Execute", heard.filter(|heard| !heard.is_nan()), 0);
            assert_eq!(silent.display_state(), DisplayState::Silent);
            let card = card(&silent).into_string();
            assert!(card.contains("unknown") && !card.contains("left") && !card.contains("runs"), "{card}");
        }
        let looks = [
            ("Execute", 0, DisplayState::Runs),
            ("Execute", 1, DisplayState::Alarm),
            ("Held", 0, DisplayState::Held),
            ("Idle", 0, DisplayState::Still),
        ];
        for (state, alarms, look) in looks {
            assert_eq!(cell(state, Some(1.0), alarms).display_state(), look);
        }
    }

    #[test]
    fn cell_card_escapes_html() {
        let card = card(&cell("Execute", Some(1.0), 0)).into_string();
        assert!(!card.contains("<script>") && !card.contains("<i>") && !card.contains('\u{202e}'), "{card}");
        assert!(card.contains("name=r%26s") && card.contains("1 – 2 min") && card.contains("SIMULATION"), "{card}");
        assert!(tally(&[cell("Held", Some(1.0), 0)]).contains("1 held"));
    }
}
