//! Board of all cells: a card for each cell, and of many cells a dense board of small tiles. A cell keeps its place
//! whatever its state, so that a person finds it again.

use maud::{Markup, html};
use regrind_language::{Language, filled};

use super::cells::{CellSummary, DisplayState, needing_person};
use super::texts::Text;
use super::words::{clamped, encoded, range, shown};

/// Maximum number of cells that are shown as cards.
const MAX_CARDS: usize = 24;
/// Maximum number of cells that are listed as needing a person, and how many of them are open at first.
const LISTED: usize = 100;
const OPEN: usize = 8;

/// Draws the cells: of at most `MAX_CARDS` cells a card, otherwise a dense board.
pub(super) fn board(cells: &[CellSummary], language: Language) -> Markup {
    let is_dense = cells.len() > MAX_CARDS;
    let is_all_simulated = is_all_simulated(cells);
    html! {
        ul .cells.dense[is_dense].(width_class(cells)) {
            @for (k, cell) in cells.iter().enumerate() { (tile(k, cell, is_dense, !is_all_simulated, language)) }
        }
    }
}

/// Returns true if every cell that has reported is simulated, and one has. The mark then stands once above the board.
pub(super) fn is_all_simulated(cells: &[CellSummary]) -> bool {
    let mut reported = cells.iter().filter(|cell| cell.heard_s.is_some()).peekable();
    reported.peek().is_some() && reported.all(|cell| cell.simulation)
}

/// Returns the class of the width of a tile, by the length of the names: a name tells its cell by its end, which must not
/// be cut off. Few names that are much longer than the others are.
fn width_class(cells: &[CellSummary]) -> &'static str {
    let mut lengths: Vec<usize> = cells.iter().map(|cell| shown(&cell.name).chars().count()).collect();
    lengths.sort_unstable();
    match lengths.get(lengths.len() * 9 / 10) {
        None | Some(0..=9) => "short-names",
        Some(10..=13) => "usual-names",
        Some(_) => "long-names",
    }
}

/// Returns the address of the run of a cell; without a run that of the trend of the cell.
fn address(cell: &CellSummary) -> String {
    match &cell.run {
        Some(run) => format!("/run?cell={}&name={}", encoded(&cell.name), encoded(run)),
        None => format!("/trend?recipe=&cell={}", encoded(&cell.name)),
    }
}

fn tile(k: usize, cell: &CellSummary, is_dense: bool, is_marked: bool, language: Language) -> Markup {
    let look = cell.display_state();
    let (name, word) = (shown(&cell.name), shown(&cell.state_word(language)));
    // On a dense board only what calls for attention has a symbol.
    let has_symbol = !is_dense || !matches!(look, DisplayState::Runs | DisplayState::Still);
    html! {
        li .cell .(look.class()) #(format!("c{k}")) data-cell=(name) {
            h3 {
                @if has_symbol { svg .shape viewBox="0 0 24 24" aria-hidden="true" { path d=(look.shape()) {} } }
                a .name href=(address(cell)) title=(name) { (name) }
                @if is_marked && cell.simulation { span .simulation title=(Text::Simulation.to(language)) { @if is_dense { "SIM" } @else { (Text::Simulation.to(language)) } } }
            }
            p .state title=(word) { strong { (word) @if cell.alarms > 0 && look != DisplayState::Silent { " · " (alarms(cell, language)) } } }
            @if !is_dense { (part_of_card(cell, look, language)) }
            @if look != DisplayState::Silent {
                (progress(cell, is_dense, language))
                @if !is_dense { (end_of_card(cell, look, language)) }
            }
        }
    }
}

/// Returns the progress of the job of a cell; empty if there is none.
fn progress(cell: &CellSummary, is_dense: bool, language: Language) -> Markup {
    let Some([done, total]) = cell.done else { return Markup::default() };
    let largest = total.max(1);
    html! {
        progress max=(largest) value=(done.clamp(0, largest)) aria-label=(Text::OfTheJob.to(language)) {}
        @if !is_dense {
            p .left {
                (filled(Text::DoneOfTotal.to(language), &[("done", &done), ("total", &total)]))
                @if let Some(left) = cell.remaining_s { ", " (filled(Text::TimeLeft.to(language), &[("time", &range(left, language))])) }
            }
        }
    }
}

/// Returns the part of a card, or that its state is unknown.
fn part_of_card(cell: &CellSummary, look: DisplayState, language: Language) -> Markup {
    let part = part_line(cell, language);
    let last = match cell.description.as_str() {
        "" => String::new(),
        words => filled(Text::LastReport.to(language), &[("words", &shown(words))]),
    };
    html! {
        @if look == DisplayState::Silent { p .unknown title=(last) { (Text::StateUnknown.to(language)) " " (last) } }
        @if !part.is_empty() { p .part title=(part) { (part) } }
    }
}

/// Returns the last line of the card of a cell that reports: the next action of a person, otherwise the time of the
/// report.
fn end_of_card(cell: &CellSummary, look: DisplayState, language: Language) -> Markup {
    let next = shown(&cell.next_action(language));
    html! {
        @if look.needs_person() && !next.is_empty() { p .next title=(next) { (next) } } @else { p .heard .quiet { (cell.heard(language)) } }
    }
}

fn alarms(cell: &CellSummary, language: Language) -> String {
    let text = if cell.alarms == 1 { Text::OneAlarm } else { Text::ManyAlarms };
    filled(text.to(language), &[("count", &cell.alarms)])
}

/// Returns the part of a cell in words: serial number, cycle and name; empty without a run.
fn part_line(cell: &CellSummary, language: Language) -> String {
    let Some(run) = &cell.run else { return String::new() };
    let serial = if cell.serial.is_empty() { run } else { &cell.serial };
    let cycle = cell
        .cycle
        .filter(|[cycle, _]| *cycle > 0)
        .map(|[cycle, most]| filled(Text::CycleOfAtMost.to(language), &[("cycle", &cycle), ("most", &most)]));
    let words = [Some(shown(serial)), cycle, Some(shown(&cell.part))];
    words.into_iter().flatten().filter(|text| !text.is_empty()).collect::<Vec<_>>().join(", ")
}

/// Lists the cells that need a person, with what to do, and with links to their runs.
pub(super) fn needs_person(cells: &[CellSummary], language: Language) -> Markup {
    let places = needing_person(cells);
    let (open, rest) = places.split_at(places.len().min(OPEN));
    let line = |k: usize| needy(&cells[k], k, language);
    html! {
        section .card .needs aria-label=(Text::NeedsPerson.to(language)) {
            h2 { (Text::NeedsPerson.to(language)) }
            @if places.is_empty() { p .quiet { (Text::NobodyNeeded.to(language)) } }
            @else { ul { @for k in open { (line(*k)) } } }
            @if !rest.is_empty() {
                details #more-needs {
                    summary { (filled(Text::MoreCells.to(language), &[("count", &rest.len())])) }
                    ul { @for k in rest.iter().take(LISTED) { (line(*k)) } }
                    @if rest.len() > LISTED { p .quiet { (filled(Text::MarkedOnBoard.to(language), &[("count", &(rest.len() - LISTED))])) } }
                }
            }
        }
    }
}

fn needy(cell: &CellSummary, k: usize, language: Language) -> Markup {
    let look = cell.display_state();
    let (name, part) = (shown(&cell.name), part_line(cell, language));
    html! {
        li .(look.class()) {
            svg .shape viewBox="0 0 24 24" aria-hidden="true" { path d=(look.shape()) {} }
            a .name href=(format!("#c{k}")) title=(name) { (name) }
            strong .word { (shown(&cell.state_word(language))) @if cell.alarms > 0 { " · " (alarms(cell, language)) } }
            @if !part.is_empty() { a .part href=(address(cell)) title=(part) { (part) } }
            @let next = cell.next_action(language);
            @if !next.is_empty() { div .next { (clamped(&next)) } }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::cells::tests::cell;
    use super::*;

    /// Returns the names of the cells of a board in the order of their places.
    fn places(html: &str) -> Vec<&str> {
        html.split("data-cell=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect()
    }

    fn cells(count: usize) -> Vec<CellSummary> {
        (1..=count).map(|k| CellSummary { name: format!("cell-{k}"), ..cell("Execute", Some(1.0), 0) }).collect()
    }

    #[test]
    fn cells_keep_their_places() {
        for count in [3, 30] {
            let mut cells = cells(count);
            let calm = board(&cells, Language::En).into_string();
            (cells[1].alarms, cells[2].state) = (2, "Idle".into());
            let html = board(&cells, Language::En).into_string();
            assert_eq!(places(&html), places(&calm));
            assert!(
                html.contains("class=\"cell alarm\" id=\"c1\"") && html.contains("class=\"cell still\" id=\"c2\""),
                "{html}"
            );
        }
    }

    #[test]
    fn board_is_dense_above_24_cells() {
        let [cards, dense] = [24, 25].map(|count| board(&cells(count), Language::En).into_string());
        assert!(!cards.contains("dense") && cards.contains("1 – 2 min"), "{cards}");
        assert!(dense.contains("dense") && !dense.contains("min left"), "{dense}");
        // A thousand cells stay a page of bounded size.
        let bytes = board(&cells(1000), Language::En).into_string().len();
        assert!(bytes < 600_000, "{bytes}");
    }

    #[test]
    fn silent_cell_not_shown_running() {
        for heard in [None, Some(61.0), Some(1e9)] {
            let html = board(&[cell("Execute", heard, 0)], Language::En).into_string();
            assert!(html.contains("unknown") && !html.contains("progress") && !html.contains("runs"), "{html}");
        }
    }

    #[test]
    fn texts_of_cells_are_escaped() {
        let odd = CellSummary { next_step: "odd".into(), next: "<b>".into(), ..cell("Execute", Some(1.0), 0) };
        for html in [board(std::slice::from_ref(&odd), Language::En), needs_person(&[odd], Language::En)] {
            let html = html.into_string();
            assert!(
                !html.contains("<script>")
                    && !html.contains("<i>")
                    && !html.contains("<b>")
                    && !html.contains('\u{202e}'),
                "{html}"
            );
            assert!(html.contains("name=r%26s"), "{html}");
        }
    }

    #[test]
    fn list_of_needy_cells_is_bounded() {
        let mut many = cells(1000);
        for cell in &mut many {
            cell.alarms = 1;
        }
        let html = needs_person(&many, Language::En).into_string();
        assert_eq!(html.matches("<li").count(), OPEN + LISTED);
        assert!(html.contains("892"), "{html}");
    }
}
