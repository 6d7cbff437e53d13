//! `regrind watch`: full-screen terminal view of a running cell.

use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use ratatui::Frame;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind};
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Style, Stylize};
use ratatui::text::{Line, Span, Text};
use ratatui::widgets::{Gauge, Paragraph, Wrap};
use regrind::cell::StateName;
use regrind::drive::{CycleRow, JobProgress, Request, Snapshot, send_request};
use regrind::formats::{MapNode, read_error_map};
use regrind::report::run_summary;
use tokio::sync::mpsc;

use super::Outcome;
use super::blocks::{Blocks, sparkline};
use super::control;
use super::failure::Failure;
use super::show::{how_far, limits, preview_text, pv_name};
use super::words::{three_digits, time_left};

/// Time between two checks for a new map on record.
const BETWEEN_LOOKS: Duration = Duration::from_secs(1);

/// Watch a running cell: its state, progress, figures and error map, with a key to hold it
#[derive(Args, Debug)]
#[command(after_help = "\
RUN is the folder of a run; by default the run under runs/ that is running now. Keys: h holds the cell, u shows the
uncertainty of the map, q quits and leaves the cell as it is. If the output is not a terminal,
regrind prints one line for each new state.

Example:
  regrind watch

Exit codes: 0 the run ended, or q was pressed; 2 no such run; 3 the program of the run is no longer running.")]
pub(super) struct Arguments {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let folder = arguments.run.clone().map_or_else(|| control::live(Path::new("runs")), Ok)?;
    super::runtime()?.block_on(async {
        let gone = |source| Failure::unreached(&folder, source);
        let mut watch = regrind_control::watch(&folder).await.map_err(gone)?;
        let Some(first) = watch.next().await.map_err(gone)? else { return Err(gone(io::ErrorKind::BrokenPipe.into())) };
        if !io::stdout().is_terminal() {
            return in_lines(first, &mut watch, &folder).await;
        }
        let mut view = View {
            snapshot: first,
            folder: folder.clone(),
            map: None,
            as_sigma: false,
            looked: None,
            said: (String::new(), 0),
        };
        let mut terminal = ratatui::init();
        let ended = view.follow(&mut terminal, &mut watch).await;
        ratatui::restore();
        // The full-screen view is gone, so the last status is printed again.
        super::print(&format!("{}\n{}\n", folder.display(), view.snapshot.message))?;
        ended
    })
}

/// Follows a running cell without a full-screen view, for output to a file or a pipe. Prints one line (cycle and
/// message) for `first` and for each later status from `watch`. Omits a line that equals the line before it.
///
/// When the cell sends no more status, prints the recorded result from the run folder `folder` and returns. Returns an
/// error if the record contains no end of the run, or if printing fails.
async fn in_lines(
    first: Snapshot,
    watch: &mut regrind_control::StatusStream,
    folder: &Path,
) -> Result<Outcome, Failure> {
    let mut told = String::new();
    let mut seen = Ok(Some(first));
    while let Ok(Some(now)) = &seen {
        let line = format!("cycle {}: {}\n", now.cycle, now.message);
        if line != told {
            super::print(&line)?;
            told = line;
        }
        seen = watch.next().await;
    }
    super::print(&format!("{}\n", ended(folder, seen)?))?;
    Ok(Outcome::Accepted)
}

/// Returns the recorded verdict of the run in `folder`, after its cell has stopped sending its status. `told` is the
/// last result of waiting for the status; it gives the reason in the error.
///
/// Returns an error if the record does not contain the end of the run.
fn ended(folder: &Path, told: io::Result<Option<Snapshot>>) -> Result<String, Failure> {
    let summary = run_summary(folder).unwrap_or_default();
    if summary.ended.is_some() {
        return Ok(summary.verdict);
    }
    let source = told.err().unwrap_or_else(|| io::ErrorKind::BrokenPipe.into());
    Err(Failure::unreached(folder, source))
}

/// Content of the terminal.
struct View {
    snapshot: Snapshot,
    folder: PathBuf,
    /// Nodes of the last error map, and its name in the run folder.
    map: Option<(String, Vec<MapNode>)>,
    /// True if the view shows the standard deviation in place of the error.
    as_sigma: bool,
    /// Time of the last check of the record for a newer map, and the number of the cell's state at that time.
    looked: Option<(Instant, u64)>,
    /// Message about the result of the last key, with the number of the cell's state at that time. In another state it
    /// is no news.
    said: (String, u64),
}

impl View {
    async fn follow(
        &mut self,
        terminal: &mut ratatui::DefaultTerminal,
        watch: &mut regrind_control::StatusStream,
    ) -> Result<Outcome, Failure> {
        let mut keys = keys();
        loop {
            self.read_map();
            terminal.draw(|frame| self.draw(frame)).map_err(Failure::Terminal)?;
            tokio::select! {
                seen = watch.next() => match seen {
                    Ok(Some(seen)) => self.snapshot = seen,
                    told => {
                        self.snapshot.message = ended(&self.folder, told)?;
                        return Ok(Outcome::Accepted);
                    }
                },
                key = keys.recv() => match key {
                    Some(KeyCode::Char('q') | KeyCode::Esc) | None => return Ok(Outcome::Accepted),
                    Some(KeyCode::Char('h')) => self.hold().await,
                    Some(KeyCode::Char('u')) => self.as_sigma = !self.as_sigma,
                    Some(_) => {}
                },
            }
        }
    }

    async fn hold(&mut self) {
        let folder = self.folder.clone();
        let asked = tokio::task::spawn_blocking(move || {
            send_request(&folder, &Request::Hold { reason: "regrind watch".into(), state_number: None })
        });
        let message = match asked.await {
            Ok(Ok(reply)) => format!("hold: {}", reply.message),
            Ok(Err(error)) => format!("hold: {error}"),
            Err(error) => format!("hold: {error}"),
        };
        self.said = (message, self.snapshot.state_number);
    }

    /// Reads the newest error map in the record of the run and stores it for display. Does nothing if the status of the
    /// cell has not changed since the last check, or if this check is less than [`BETWEEN_LOOKS`] ago.
    ///
    /// Keeps the displayed map if the record has no newer one, or if the newer map cannot be read.
    fn read_map(&mut self) {
        let number = self.snapshot.state_number;
        if self.looked.is_some_and(|(at, of)| of == number || at.elapsed() < BETWEEN_LOOKS) {
            return;
        }
        self.looked = Some((Instant::now(), number));
        let cycles = run_summary(&self.folder).map(|summary| summary.cycles).unwrap_or_default();
        let Some(name) = cycles.into_iter().rev().find_map(|of| of.map) else { return };
        if self.map.as_ref().is_some_and(|(known, _)| *known == name) {
            return;
        }
        if let Ok(map) = read_error_map(&self.folder.join(&name)) {
            self.map = Some((name, map));
        }
    }

    /// Draws the state, the job, the alarms, the table of the cycles, and below them the map in the room that is left. All
    /// widths have this layout.
    fn draw(&self, frame: &mut Frame) {
        let alarms = self.alarms();
        let head = self.head();
        let [wide, high] = [frame.area().width, frame.area().height].map(usize::from);
        // A line that is broken between words can need one row more than its letters.
        let rows_of = |line: &Line| 1 + line.width().saturating_sub(1) / wide.max(9).saturating_sub(8);
        let head_rows: usize = head.iter().map(rows_of).sum();
        let job_rows = if self.snapshot.progress.is_some() { 2 } else { 0 };
        let alarm_rows: usize = alarms.lines.iter().map(rows_of).sum();
        let cycle_rows = if self.snapshot.tolerance.is_some() { 3 + self.snapshot.cycles.len() } else { 0 };
        // The head and the keys are always there; then come the alarms, the newest cycles, and the map.
        let mut left = high.saturating_sub(1);
        let mut taken = |wanted: usize| {
            let rows = wanted.min(left);
            left -= rows;
            Constraint::Length(rows as u16)
        };
        let rows = [
            taken(head_rows),
            taken(job_rows),
            taken(alarm_rows),
            taken(cycle_rows),
            taken(usize::MAX),
            Constraint::Length(1),
        ];
        let [top, job, alarm, figures, map, foot] = Layout::vertical(rows).areas(frame.area());
        frame.render_widget(Paragraph::new(head.to_vec()).wrap(Wrap { trim: true }), top);
        self.job(frame, job);
        frame.render_widget(Paragraph::new(alarms).wrap(Wrap { trim: true }).red(), alarm);
        frame.render_widget(self.figures(figures), figures);
        self.maps(frame, map);
        let (message, of_state) = &self.said;
        // The hold itself brings the cell through Holding to Held.
        let is_news = !message.is_empty() && self.snapshot.state_number <= of_state + 2;
        let keys = if is_news { message } else { "h hold   u uncertainty   q quit" };
        frame.render_widget(Paragraph::new(keys).dim(), foot);
    }

    fn head(&self) -> [Line<'_>; 2] {
        let Snapshot { simulation, state, phase, cycle, max_cycles, next, part, serial, .. } = &self.snapshot;
        let colour = match state {
            StateName::Execute | StateName::Starting | StateName::Unholding | StateName::Unsuspending => Color::Green,
            StateName::Complete => Color::Green,
            StateName::Aborting | StateName::Aborted | StateName::Stopped => Color::Red,
            _ => Color::Yellow,
        };
        let marked = if *simulation { "  SIMULATION" } else { "" };
        let phase = phase.map_or(String::new(), |phase| format!("  {}", phase.name()));
        let first = Line::from(vec![
            Span::styled(
                format!(" {} ", state.to_string().to_uppercase()),
                Style::new().fg(Color::Black).bg(colour).bold(),
            ),
            Span::raw(format!("{phase}  cycle {cycle} of at most {max_cycles}  {part}  {serial}{marked}")),
        ]);
        [first, Line::from(format!("next: {next}"))]
    }

    fn job(&self, frame: &mut Frame, area: Rect) {
        let Some(JobProgress { device, done, total, remaining_s }) = self.snapshot.progress else { return };
        let left = remaining_s.map_or(String::new(), |remaining_s| format!(", {} left", time_left(remaining_s)));
        let ratio = (f64::from(done) / f64::from(total.max(1))).clamp(0.0, 1.0);
        // A text on the bar could not be read on both of its colours.
        let gauge =
            Gauge::default().ratio(ratio).gauge_style(Style::new().fg(Color::Blue).bg(Color::DarkGray)).label("");
        let [text, bar] = Layout::vertical([Constraint::Length(1), Constraint::Length(1)]).areas(area);
        let preview = self.snapshot.preview.as_ref().map_or(String::new(), |told| format!("   {}", preview_text(told)));
        let line =
            Line::from(vec![Span::raw(format!("{}{left}", how_far(device, done, total))), Span::raw(preview).dim()]);
        frame.render_widget(Paragraph::new(line), text);
        frame.render_widget(gauge, bar);
    }

    fn alarms(&self) -> Text<'_> {
        let of = |alarm: &regrind::cell::Alarm| {
            let remedy = alarm.remedy.iter().zip(1..).map(|(remedy, k)| Line::from(format!("{k}. {remedy}")));
            let event = Line::from(format!("ALARM  {}", alarm.event)).bold();
            [event, Line::from(alarm.consequence.clone())].into_iter().chain(remedy).collect::<Vec<_>>()
        };
        Text::from(self.snapshot.alarms.iter().flat_map(of).collect::<Vec<_>>())
    }

    /// Returns the table of the cycles. In a lower area it has the newest ones, and in a narrow one fewer columns.
    fn figures(&self, area: Rect) -> Paragraph<'_> {
        /// Columns of a row with the points and the outliers.
        const WHOLE: u16 = 47;
        let Some(tolerance) = self.snapshot.tolerance else { return Paragraph::default() };
        let columns = |cycle: &str, pv: &str, rms: &str, points: &str, outliers: &str| match area.width < WHOLE {
            true => format!("{cycle:>5} {pv:>13} {rms:>8}"),
            false => format!("{cycle:>5} {pv:>13} {rms:>8} {points:>8} {outliers:>9}"),
        };
        let row = |row: &CycleRow| {
            let (CycleRow { cycle, points, outliers, .. }, [pv_um, rms_um]) = (row, row.judged_um());
            let [cycle, points, outliers] = [cycle, points, outliers].map(u32::to_string);
            Line::from(columns(&cycle, &format!("{pv_um:.2}"), &format!("{rms_um:.3}"), &points, &outliers))
        };
        let falls = sparkline(self.snapshot.cycles.iter().map(|row| row.judged_um()[1]));
        let pv = format!("{} \u{b5}m", pv_name(&tolerance));
        let head = Line::from(columns("cycle", &pv, "RMS \u{b5}m", "points", "outliers"));
        let limits = Line::from(vec![
            Span::raw(format!("tolerance {}   ", limits(&tolerance))),
            Span::raw(if falls.is_empty() { String::new() } else { format!("RMS {falls}") }).cyan(),
        ]);
        let first = self.snapshot.cycles.len().saturating_sub(usize::from(area.height.saturating_sub(2)));
        let lines = [limits, head.dim()].into_iter().chain(self.snapshot.cycles[first..].iter().map(row));
        Paragraph::new(lines.collect::<Vec<_>>())
    }

    /// Draws the map of the error, or that of its standard deviation. If there is room for both, they are side by side.
    fn maps(&self, frame: &mut Frame, area: Rect) {
        const APART: u16 = 3;
        let Some((_, nodes)) = &self.map else { return };
        let room = [area.width, area.height.saturating_sub(1)].map(usize::from);
        let [error, sigma] = [Blocks::paint_error, Blocks::paint_sigma].map(|painted| painted(nodes, room));
        let shown = if self.as_sigma { [sigma, error] } else { [error, sigma] };
        let mut left = area;
        for (k, blocks) in shown.into_iter().enumerate() {
            let Some(blocks) = blocks else { return };
            let title = match (k == 1) != self.as_sigma {
                true => format!("standard deviation: up to {} \u{b5}m", three_digits(blocks.limit_um)),
                false => format!("error, filtered: \u{b1} {} \u{b5}m", three_digits(blocks.limit_um)),
            };
            let width = blocks.rows.first().map_or(0, Vec::len).max(title.chars().count()) as u16;
            if width > left.width {
                return;
            }
            let lines = std::iter::once(Line::from(title)).chain(blocks.rows.iter().map(|row| line_of(row)));
            frame.render_widget(Paragraph::new(lines.collect::<Vec<_>>()), left);
            let taken = (width + APART).min(left.width);
            left = Rect { x: left.x + taken, width: left.width - taken, ..left };
        }
    }
}

/// Returns a row of a map as a line of half blocks.
fn line_of(row: &[[Option<[u8; 3]>; 2]]) -> Line<'static> {
    let colour = |pixel: Option<[u8; 3]>| pixel.map_or(Color::Reset, |[r, g, b]| Color::Rgb(r, g, b));
    let cell = |[above, below]: &[Option<[u8; 3]>; 2]| match (above, below) {
        (None, None) => Span::raw(" "),
        (None, below) => Span::styled("\u{2584}", Style::new().fg(colour(*below))),
        (above, below) => Span::styled("\u{2580}", Style::new().fg(colour(*above)).bg(colour(*below))),
    };
    row.iter().map(cell).collect()
}

/// Starts a thread that reads pressed keys, and returns the channel on which the keys arrive. Ctrl-C arrives as Esc.
/// The thread ends when the channel is dropped.
fn keys() -> mpsc::Receiver<KeyCode> {
    let (pressed, keys) = mpsc::channel(16);
    std::thread::spawn(move || {
        while !pressed.is_closed() {
            // Polls with a timeout, so that the thread ends with its receiver.
            if !event::poll(Duration::from_millis(200)).unwrap_or(false) {
                continue;
            }
            match event::read() {
                Ok(Event::Key(key)) if key.kind == KeyEventKind::Press => {
                    // In raw mode Ctrl-C is an ordinary key.
                    let leaves = key.code == KeyCode::Char('c') && key.modifiers.contains(event::KeyModifiers::CONTROL);
                    let code = if leaves { KeyCode::Esc } else { key.code };
                    if pressed.blocking_send(code).is_err() {
                        return;
                    }
                }
                Ok(_) => {}
                Err(_) => return,
            }
        }
    });
    keys
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;
    use regrind::cell::{Device, PvPoints, Tolerance};

    /// A cell in its second pass, with the map of a part of 100 mm by 60 mm.
    fn view(serial: &str) -> View {
        let row = |cycle, pv_um| CycleRow {
            cycle,
            pv_um,
            judged_pv_um: None,
            rms_um: 0.1 * pv_um,
            judged_rms_um: None,
            points: 1800,
            outliers: 0,
            level_um: 20.0,
        };
        let node = |k: usize| {
            let [x, y] = [(k % 100) as f64, (k / 100) as f64];
            MapNode { at_mm: [x, y], error_mm: 1e-5 * (x - y), sigma_mm: 1e-4 }
        };
        View {
            snapshot: Snapshot {
                part: "free-form mirror".into(),
                serial: serial.into(),
                simulation: true,
                cycle: 2,
                max_cycles: 5,
                tolerance: Some(Tolerance {
                    pv_mm: 7e-3,
                    rms_mm: 1e-3,
                    with_uncertainty: true,
                    probability: Tolerance::DEFAULT_PROBABILITY,
                    pv_points: PvPoints::MostPoints,
                }),
                cycles: vec![row(1, 29.53), row(2, 3.87)],
                progress: Some(JobProgress { device: Device::Grinder, done: 30, total: 100, remaining_s: None }),
                ..Snapshot::default()
            },
            folder: PathBuf::from("runs/a"),
            map: Some(("cycle-1/error_map.csv".into(), (0..6000).map(node).collect())),
            as_sigma: false,
            looked: None,
            said: (String::new(), 0),
        }
    }

    /// Returns the rows of the screen as texts, and the number of half blocks of the map.
    fn drawn(view: &View, size: [u16; 2]) -> (Vec<String>, usize) {
        let mut terminal = Terminal::new(TestBackend::new(size[0], size[1])).unwrap();
        terminal.draw(|frame| view.draw(frame)).unwrap();
        let buffer = terminal.backend().buffer().clone();
        let row = |y: u16| (0..size[0]).map(|x| buffer[(x, y)].symbol().to_owned()).collect::<String>();
        let rows: Vec<String> = (0..size[1]).map(row).collect();
        let blocks = rows.iter().flat_map(|row| row.chars()).filter(|c| ['\u{2580}', '\u{2584}'].contains(c)).count();
        (rows, blocks)
    }

    #[test]
    fn every_width_has_the_same_rows() {
        for size in [[60, 24], [80, 24], [120, 40], [200, 50]] {
            let (rows, blocks) = drawn(&view("SN-9"), size);
            let all = rows.join("\n");
            for words in [
                "cycle 2 of at most 5",
                "SN-9",
                "SIMULATION",
                "grinding, 30.0 % of the path",
                "cycle  PV 99.8 % \u{b5}m   RMS \u{b5}m   points  outliers",
                "    1         29.53    2.953     1800         0",
                "    2          3.87    0.387     1800         0",
                "error, filtered: \u{b1}",
            ] {
                assert!(all.contains(words), "{words}: {size:?}\n{all}");
            }
            assert!(rows.last().unwrap().starts_with("h hold   u uncertainty   q quit"), "{size:?}\n{all}");
            assert!(blocks > usize::from(size[1]) * 10, "{blocks} blocks of a map: {size:?}\n{all}");
            // The map has no holes: between the first and the last block of a row there is no blank.
            for row in rows.iter().filter(|row| row.contains('\u{2580}')) {
                let map = row.trim_matches(' ').split("   ").next().unwrap();
                assert!(!map.contains(' '), "{size:?}: {row:?}");
            }
        }
    }

    /// The head, every step of the alarm and the newest cycle are there before the map.
    #[test]
    fn alarm_and_newest_cycle_come_before_the_map() {
        let alarm: regrind::cell::Alarm = serde_json::from_value(serde_json::json!({
            "id": "link_lost", "what": "The link to a machine is lost: CMM. ".repeat(4), "consequence": "No new step begins.",
            "remedy": ["Check the cable.", "Compare the register map.", "Wait."], "clears": "operator" }))
        .unwrap();
        for size in [[60, 24], [80, 24], [120, 40]] {
            let mut view = view("SN-9");
            view.snapshot.alarms = vec![alarm.clone()];
            let first = view.snapshot.cycles[0].clone();
            view.snapshot.cycles = (1..=11).map(|cycle| CycleRow { cycle, ..first.clone() }).collect();
            let (rows, _) = drawn(&view, size);
            let all = rows.join("\n");
            for words in ["SIMULATION", "next:", "1. Check the cable.", "3. Wait.", "   11         29.53", "h hold"] {
                assert!(all.contains(words), "{words}: {size:?}\n{all}");
            }
        }
    }

    #[test]
    fn small_terminals_and_long_names_are_drawn() {
        for size in [[1, 1], [10, 5], [40, 12], [60, 24]] {
            let (rows, _) = drawn(&view(&"long serial ".repeat(30)), size);
            assert_eq!(rows.len(), usize::from(size[1]));
        }
        let empty = View { map: None, snapshot: Snapshot::default(), ..view("a") };
        assert_eq!(drawn(&empty, [80, 24]).1, 0);
    }
}
