//! Display of an active run: a bar on a terminal, plain lines elsewhere, JSON for programs.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use regrind::cell::{
    Alarm, AlarmId, ComparedFigure, CompensationSummary, Device, Ending, Figures, FurtherTouches, Judgement, PvPoints,
    Tolerance, Verdict,
};
use regrind::document::visible;
use regrind::drive::{CycleRow, Notice, PreviewStatistics};
use regrind::formats::read_error_map;
use regrind::formats::run_files::{CycleFile, CycleFolder};
use regrind::model::FIRST_BATCH;
use regrind::recipe::{Recipe, SelectionMode};
use regrind::report::{Language, ending_words, first_lines, in_air, verdict_in_words};
use serde_json::json;
use tokio::sync::mpsc;

use super::blocks::{Blocks, sparkline};
use super::failure::Failure;
use super::outside::is_in_front;
use super::words::{judged, three_digits, time_left, wrapped};

/// Minimum time between two lines about the progress of the same job. A short job has one line.
const QUIET: Duration = Duration::from_secs(60);
/// Number of columns of the complete table of cycles. A narrower terminal gets a table with fewer columns.
const TABLE: usize = 80;

/// Display of a run.
pub(super) struct Show {
    json: bool,
    simulated: bool,
    head: String,
    tolerance: Tolerance,
    folder: String,
    /// True if the measurement selects its touches in batches. The transfer speed is then not shown, because there are
    /// too many batches.
    is_chosen: bool,
    bar: Option<ProgressBar>,
    /// Time of the last plain line about progress.
    said: Option<Instant>,
    job: Option<Job>,
    /// Figures of the measurement that is not yet judged.
    measured: Option<(u32, Figures)>,
    /// Cycles that have a row in the table so far.
    rows: Vec<u32>,
    /// Texts of the active alarms that were shown.
    alarms: HashMap<AlarmId, String>,
    /// RMS of each cycle.
    rms_mm: Vec<f64>,
}

/// Job of a machine that reports its progress.
struct Job {
    device: Device,
    cycle: u32,
    began: Instant,
}

impl Show {
    pub(super) fn new(json: bool, simulated: bool, recipe: &Recipe, tolerance: Tolerance, folder: &Path) -> Self {
        Self {
            json,
            simulated,
            head: format!("{}, {}", recipe.part.name, recipe.path().display()),
            tolerance,
            folder: folder.display().to_string(),
            is_chosen: recipe.measure.mode == SelectionMode::Adaptive,
            bar: (!json && io::stderr().is_terminal()).then(bar),
            said: None,
            job: None,
            measured: None,
            rows: Vec::new(),
            alarms: HashMap::new(),
            rms_mm: Vec::new(),
        }
    }

    /// Shows each notice of the run that arrives in `notices`, as text or as a line of JSON. Returns when the run has
    /// ended and no further notice can arrive. Returns an error if standard output cannot be written.
    pub(super) async fn follow(mut self, mut notices: mpsc::UnboundedReceiver<Notice>) -> Result<(), Failure> {
        if self.json {
            let first = json!({ "notice": "record", "folder": self.folder, "simulation": self.simulated });
            super::print(&format!("{first}\n"))?;
        } else {
            let marked = if self.simulated { "SIMULATION  " } else { "" };
            self.line(&format!("{marked}{}; tolerance {}", self.head, limits(&self.tolerance)))?;
            self.line(&format!("record in {}", self.folder))?;
        }
        while let Some(notice) = notices.recv().await {
            if self.json {
                self.print_json(&notice)?;
            } else {
                self.show(&notice)?;
            }
        }
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
        Ok(())
    }

    fn print_json(&self, notice: &Notice) -> Result<(), Failure> {
        let mut value = serde_json::to_value(notice).map_err(|e| Failure::Terminal(e.into()))?;
        if let Some(map) = value.as_object_mut() {
            map.insert("simulation".into(), self.simulated.into());
        }
        super::print(&format!("{value}\n"))
    }

    fn show(&mut self, notice: &Notice) -> Result<(), Failure> {
        match notice {
            Notice::Progress { device, cycle, done, total, remaining_s } => {
                self.progress((*device, *cycle), *done, *total, *remaining_s)
            }
            Notice::State { state, cycle, event, has_progress: at_job } => {
                if !at_job {
                    self.end_job()?;
                }
                if let Some(bar) = &self.bar {
                    // The bar of a job ends with the job.
                    if !at_job {
                        bar.set_style(style("{wide_msg}"));
                    }
                    bar.set_message(format!("cycle {cycle}  {state}"));
                }
                self.order(event)
            }
            Notice::Transferred { .. } if self.is_chosen => Ok(()),
            Notice::Transferred { cycle, points, seconds, ms_per_point } => self.line(&format!(
                "cycle {cycle}: {points} points fetched in {seconds:.2} s, {} ms per point",
                three_digits(*ms_per_point)
            )),
            Notice::LoadPart => {
                let by_key = if reads_keys() { "press Enter here, or: " } else { "" };
                self.line(&format!(
                    "load and clamp the part, check that wheel and probe are clear of the part,\nthen: {by_key}regrind confirm loaded"
                ))
            }
            Notice::AskWhetherClear { device } => self.line(&format!(
                "{device}: no signal shows whether the machine is clear of the part; check that the machine is clear,\nthen: regrind confirm clear --machine {}",
                device.to_string().to_lowercase()
            )),
            Notice::Note { device, messages } => {
                messages.iter().try_for_each(|message| self.line(&format!("{device}: {message}")))
            }
            Notice::Figures { cycle, figures } => self.figures(*cycle, figures),
            Notice::Judged(judgement) => self.judgement(judgement),
            Notice::Compensated { cycle, summary } => self.compensated(*cycle, summary),
            // The record contains every repetition, but a person needs to see the alarm only once.
            Notice::Alarm(alarm) if self.alarms.get(&alarm.id) == Some(&alarm.event) => Ok(()),
            Notice::Alarm(alarm) => {
                self.alarms.insert(alarm.id, alarm.event.clone());
                self.alarm(alarm)
            }
            Notice::AlarmGone { alarm } => {
                self.alarms.remove(alarm);
                Ok(())
            }
            Notice::Refused { reason } => self.line(&format!("refused: {reason}")),
            Notice::RecordFailed { message } => self.line(&format!("RECORD: {message}")),
            Notice::Finished { cycles, touches, .. } => self.finished(cycles, *touches),
        }
    }

    fn compensated(&self, cycle: u32, summary: &CompensationSummary) -> Result<(), Failure> {
        self.line(&format!(
            "cycle {cycle}: next pass corrects up to {} µm, depth {} µm, {}, gain {}; expected PV {} µm, RMS {} µm",
            three_digits(1e3 * summary.max_correction_mm),
            three_digits(1e3 * summary.depth_mm),
            in_air(summary.air_share),
            gains(&summary.gains),
            three_digits(1e3 * summary.predicted_pv_mm),
            three_digits(1e3 * summary.predicted_rms_mm)
        ))?;
        for told in &summary.parameters {
            self.line(&format!("cycle {cycle}: {}", told.in_words()))?;
        }
        if let Some(mm) = summary.map_rms_mm {
            self.line(&format!(
                "cycle {cycle}: error that the correction map must correct: {} µm RMS",
                three_digits(1e3 * mm)
            ))?;
        }
        summary.warnings.iter().try_for_each(|warning| self.line(&format!("cycle {cycle}: {warning}")))
    }

    /// Prints a line about an order that the cell has accepted, and the effect of this order. `event` is the name of
    /// the order: `hold`, `resume`, `stop` or `abort`. Prints nothing for any other event.
    fn order(&mut self, event: &str) -> Result<(), Failure> {
        match event {
            "hold" => self.line(&format!(
                "HOLD     the cell holds at the next safe place; to continue: regrind resume {0}; to abort: Ctrl-C, or regrind abort {0}",
                self.folder
            )),
            "resume" => self.line("RESUME   the cell continues"),
            "stop" => self.line("STOP     the machines go to their safe place, and the run ends"),
            "abort" => self.line("ABORT    both machines run only their safe sequence"),
            _ => Ok(()),
        }
    }

    /// Shows the progress of a job: on a terminal as a bar, elsewhere as a line at its begin and after each minute.
    fn progress(&mut self, job: (Device, u32), done: u32, total: u32, left_s: Option<[f64; 2]>) -> Result<(), Failure> {
        let (device, cycle) = job;
        let left = left_s.map_or(String::new(), |left_s| format!(", {} left", time_left(left_s)));
        let is_new = self.job.as_ref().is_none_or(|known| (known.device, known.cycle) != job);
        if is_new {
            self.end_job()?;
            self.job = Some(Job { device, cycle, began: Instant::now() });
        }
        if let Some(bar) = &self.bar {
            bar.set_style(style("{wide_msg} [{bar:16}] {percent:>3} %"));
            bar.set_length(u64::from(total));
            bar.set_position(u64::from(done));
            bar.set_message(format!("cycle {cycle}: {}{left}", doing(device)));
        } else if is_new || self.said.is_none_or(|at| at.elapsed() >= QUIET) {
            self.said = Some(Instant::now());
            let words = if is_new { whole_job(device, total) } else { how_far(device, done, total) };
            self.line(&format!("cycle {cycle}: {words}{left}"))?;
        }
        Ok(())
    }

    /// Leaves a line about the job that is over, where a bar has shown its progress.
    fn end_job(&mut self) -> Result<(), Failure> {
        let (Some(Job { device, cycle, began }), Some(_)) = (self.job.take(), &self.bar) else { return Ok(()) };
        let seconds = began.elapsed().as_secs_f64();
        self.line(&format!("cycle {cycle}: {}, {}", doing(device), time_left([seconds, seconds])))
    }

    fn figures(&mut self, cycle: u32, figures: &Figures) -> Result<(), Failure> {
        let compared = self.tolerance.compare(figures);
        let [pv, rms] = compared.map(|compared| judged(&compared));
        let points = figures.points;
        if let Some(FurtherTouches { target_count: targets, reason }) = figures.further_touches.as_deref() {
            // The first touches only show that they belong to this part.
            let known = figures
                .form
                .filter(|_| points as usize > FIRST_BATCH)
                .map_or(String::new(), |_| format!("{pv}; {rms}; "));
            self.line(&format!("cycle {cycle}: {known}{points} points measured; {targets} more follow: {reason}"))?;
            return self.picture(cycle);
        }
        for words in figures.weak_directions.iter().chain(&figures.warnings) {
            self.line(&format!("cycle {cycle}: {words}"))?;
        }
        self.rms_mm.push(compared[1].median_mm);
        self.measured = Some((cycle, figures.clone()));
        self.picture(cycle)
    }

    /// Prints the row of a judged cycle in the table of cycles. Prints also the reason of the judgement, unless the
    /// figures alone say it.
    fn judgement(&mut self, judgement: &Judgement) -> Result<(), Failure> {
        let Judgement { cycle, verdict, reason } = judgement;
        let decision = verdict_in_words(*verdict, Language::En);
        if let Some((_, figures)) = self.measured.take().filter(|(of, _)| of == cycle) {
            let compared = self.tolerance.compare(&figures);
            let with_u = |of: &ComparedFigure, digits: usize| {
                [of.median_mm, of.expanded_mm].map(|mm| format!("{:.digits$}", 1e3 * mm))
            };
            let values = [with_u(&compared[0], 2), with_u(&compared[1], 3)];
            self.row(*cycle, values, figures.points, figures.outliers, &decision)?;
        }
        if matches!(verdict, Verdict::Accept | Verdict::Continue) {
            return Ok(());
        }
        self.line(&format!("cycle {cycle}: {decision}: {reason}"))
    }

    /// Prints a row of the table of cycles, and its head before the first row. `values` are PV and RMS, each with its
    /// expanded uncertainty or an empty text.
    fn row(
        &mut self,
        cycle: u32,
        values: [[String; 2]; 2],
        points: u32,
        outliers: u32,
        decision: &str,
    ) -> Result<(), Failure> {
        let is_narrow = self.bar.is_some() && columns() < TABLE;
        let line = |cycle: &str, pv: &str, rms: &str, points: &str, outliers: &str, decision: &str| match is_narrow {
            true => format!("{cycle:>5}  {pv:>14}  {rms:>15}  {decision}"),
            false => format!("{cycle:>5}  {pv:>15}  {rms:>17}  {points:>8}  {outliers:>8}  {decision}"),
        };
        if self.rows.is_empty() {
            let pv = format!("{} µm", pv_name(&self.tolerance));
            self.line(&line("cycle", &pv, "RMS µm", "points", "outliers", "decision"))?;
        }
        self.rows.push(cycle);
        let [pv, rms] = values.map(|[value, u]| if u.is_empty() { value } else { format!("{value} \u{b1} {u}") });
        let row = line(&cycle.to_string(), &pv, &rms, &points.to_string(), &outliers.to_string(), decision);
        self.line(row.trim_end())
    }

    /// Prints the error map of the cycle `cycle` in colour, and a small chart of the RMS values of all cycles so far.
    /// If the measurement selects its touches during the cycle, also prints the map of the standard deviation. Prints
    /// nothing if the output is JSON, if the terminal shows no colours, or if there is no error map.
    fn picture(&self, cycle: u32) -> Result<(), Failure> {
        let (Some(bar), true) = (&self.bar, console::colors_enabled()) else { return Ok(()) };
        let nodes = newest_map(Path::new(&self.folder), cycle).and_then(|path| read_error_map(&path).ok());
        let Some(nodes) = nodes else { return Ok(()) };
        // The rows above and below the map stay on the screen.
        let height = console::Term::stdout().size_checked().map_or(16, |(rows, _)| usize::from(rows).saturating_sub(8));
        let height = height.clamp(8, 24);
        let falls = match &self.rms_mm[..] {
            [] => String::new(),
            rms_mm => format!("RMS {}\n", sparkline(rms_mm.iter().copied())),
        };
        let error = |blocks: &Blocks| format!("filtered error: \u{b1} {} µm", three_digits(blocks.limit_um));
        let (blocks, below) = if self.is_chosen {
            // For chosen touches, the map of the error and the map of its standard deviation are shown side by side.
            const APART: usize = 2;
            let room = [columns().saturating_sub(2 + APART) / 2, height];
            let both = Blocks::paint_error(&nodes, room).zip(Blocks::paint_sigma(&nodes, room));
            let Some((blocks, sigma)) = both else { return Ok(()) };
            let wide = blocks.rows.first().map_or(0, Vec::len) + APART;
            let known = format!("standard deviation: up to {} µm", three_digits(sigma.limit_um));
            let known = match wide + known.chars().count() > columns() {
                true => format!("\n{known}"),
                false => known,
            };
            let below = format!("{:wide$}{known}\n{falls}", error(&blocks));
            (blocks.append_right(sigma, APART), below)
        } else {
            let Some(blocks) = Blocks::paint_error(&nodes, [columns().saturating_sub(2), height]) else {
                return Ok(());
            };
            let below = format!("{}   {falls}", error(&blocks));
            (blocks, below)
        };
        bar.suspend(|| super::print(&format!("{}{below}", blocks.to_ansi())))
    }

    fn alarm(&mut self, alarm: &Alarm) -> Result<(), Failure> {
        let mut text = format!("ALARM    {}\n         {}", alarm.event, alarm.consequence);
        for (k, remedy) in alarm.remedy.iter().enumerate() {
            let _ = write!(text, "\n         {}. {remedy}", k + 1);
        }
        self.striking(&text, "ALARM", "31")
    }

    /// Prints the rows of the cycles that were judged before this program followed the run, and the number of touches.
    fn finished(&mut self, cycles: &[CycleRow], touches: Option<[usize; 2]>) -> Result<(), Failure> {
        for row in cycles.iter().filter(|row| !self.rows.contains(&row.cycle)).cloned().collect::<Vec<_>>() {
            let [pv_um, rms_um] = row.judged_um();
            let values = [[format!("{pv_um:.2}"), String::new()], [format!("{rms_um:.3}"), String::new()]];
            self.row(row.cycle, values, row.points, row.outliers, "")?;
        }
        let Some([taken, whole]) = touches else { return Ok(()) };
        self.line(&format!("{taken} touches on the part, instead of {whole} with the complete pattern"))
    }

    fn line(&self, text: &str) -> Result<(), Failure> {
        self.striking(text, "", "")
    }

    /// Prints `text`, and rings the bell and colours `word` as [`striking`] does, above the bar if there is one.
    fn striking(&self, text: &str, word: &str, colour: &str) -> Result<(), Failure> {
        // Parts of the text come from a machine or a file.
        let text = &visible(text);
        match &self.bar {
            None => super::print(&format!("{text}\n")),
            Some(bar) => bar.suspend(|| super::print(&striking(text, word, colour))),
        }
    }
}

/// Prints the end of the run in the folder `folder`: the first lines of its report, and the path of the report.
///
/// # Errors
/// Standard output cannot be written.
pub(super) fn print_end(folder: &Path, ending: &Ending, report: &Path) -> Result<(), Failure> {
    let (word, colour) = match ending {
        Ending::Accepted { .. } => ("ACCEPTED", "32"),
        Ending::NotAccepted { .. } => ("NOT ACCEPTED", "31"),
        Ending::Stopped { .. } => ("STOPPED", "31"),
        Ending::Aborted { .. } => ("ABORTED", "31"),
    };
    let is_terminal = io::stdout().is_terminal();
    let columns = if is_terminal { columns() } else { usize::MAX };
    // A report that was written can be read again.
    let lines = first_lines(folder, columns).unwrap_or_else(|_| vec![ending_words(ending)]);
    let text = visible(&format!("\n{}", lines.join("\n")));
    let text = if is_terminal { striking(&text, word, colour) } else { format!("{text}\n") };
    // A path that is broken into lines cannot be copied.
    super::print(&format!("{text}report   {}\n", visible(&report.display().to_string())))
}

/// Returns `text` for a terminal: in lines that are not wider than it. If `word` is not empty, the text rings the bell, and
/// has the first occurrence of `word` in colour if the terminal supports colours. `colour` is the ANSI code of the
/// colour, such as `31` for red.
fn striking(text: &str, word: &str, colour: &str) -> String {
    let mut text = wrapped(text, columns());
    if !word.is_empty() && console::colors_enabled() {
        text = text.replacen(word, &format!("\x1b[1;{colour}m{word}\x1b[0m"), 1);
    }
    let bell = if word.is_empty() || !io::stdout().is_terminal() { "" } else { "\x07" };
    format!("{bell}{text}")
}

/// Returns the number of columns of the terminal.
fn columns() -> usize {
    console::Term::stdout().size_checked().map_or(usize::MAX, |(_, columns)| columns.into())
}

/// Returns the path of the newest error map of the cycle `cycle` in the run folder `run`. Looks first in the folders of
/// repeated measurements (`attempt-2` and higher), then in the cycle folder, and then in the folders of the batches of
/// touches. Returns `None` if there is no error map.
fn newest_map(run: &Path, cycle: u32) -> Option<PathBuf> {
    let existing = |folder: &dyn Fn(u32) -> CycleFolder| {
        let folders = (1..).map(|k| run.join(folder(k).to_string())).take_while(|folder| folder.is_dir());
        folders.collect::<Vec<_>>()
    };
    let batches = existing(&|batch| CycleFolder::Batch { cycle, batch });
    let attempts = existing(&|attempt| CycleFolder::Attempt { cycle, attempt });
    let maps = batches.into_iter().chain(attempts).map(|folder| folder.join(CycleFile::ErrorMap.name()));
    maps.rev().find(|map| map.is_file())
}

/// Returns true if a person at this terminal can answer a question. This requires that standard input and standard
/// error are terminals, and that this program is in the foreground of its terminal. Otherwise returns false.
pub(super) fn reads_keys() -> bool {
    is_in_front() && io::stdin().is_terminal() && io::stderr().is_terminal()
}

fn bar() -> ProgressBar {
    let bar = ProgressBar::new(1).with_style(style("{wide_msg}"));
    // Redraws regularly. Otherwise the last of several quick changes would not be shown, and a held cell would look
    // active.
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// Returns the word for the activity of a machine: measuring or grinding.
fn doing(device: Device) -> &'static str {
    match device {
        Device::Cmm => "measuring",
        Device::Grinder => "grinding",
    }
}

/// Returns the whole job of a machine as text for a person.
fn whole_job(device: Device, total: u32) -> String {
    match device {
        Device::Cmm => format!("{}, {total} points", doing(device)),
        Device::Grinder => doing(device).to_owned(),
    }
}

/// Returns the progress of a job as text for a person. For the measuring machine, the text states `done` of `total`
/// points. For the grinder, the text states `done` / `total` in per cent of the path.
pub(super) fn how_far(device: Device, done: u32, total: u32) -> String {
    match device {
        Device::Cmm => format!("measuring, {done} of {total} points"),
        Device::Grinder => {
            format!("grinding, {:.1} % of the path", 100.0 * f64::from(done) / f64::from(total.max(1)))
        }
    }
}

/// Returns a line of text about a measurement that is not yet complete. The line states the number of touches on the
/// part, and the RMS, minimum and maximum of the deviations from the planned positions in µm.
pub(super) fn preview_text(
    PreviewStatistics { touch_count: touched, rms_um, min_um, max_um }: &PreviewStatistics,
) -> String {
    format!(
        "preliminary, relative to the planned position: {touched} points touched, RMS {rms_um:.2} µm, deviations from {min_um:+.2} to {max_um:+.2} µm"
    )
}

/// Returns the name of the PV (peak-to-valley) figure to which the PV limit applies: `PV` for all points, or `PV 99.8
/// %` if the highest and the lowest 0.1 % are omitted.
pub(super) fn pv_name(tolerance: &Tolerance) -> &'static str {
    match tolerance.pv_points {
        PvPoints::All => "PV",
        PvPoints::MostPoints => "PV 99.8 %",
    }
}

/// Returns the acceptance limits of PV and RMS in µm as text. Omits a limit that is not finite.
pub(super) fn limits(tolerance: &Tolerance) -> String {
    let limits =
        [(pv_name(tolerance), tolerance.pv_mm), ("RMS", tolerance.rms_mm)].into_iter().filter(|(_, mm)| mm.is_finite());
    limits.map(|(name, mm)| format!("{name} {} µm", three_digits(1e3 * mm))).collect::<Vec<_>>().join(", ")
}

/// Returns the gains as text with two decimals. A gain is the share of the newest error that the next correction
/// removes; 1 means all of it. Each pair in `gains` contains the shortest wavelength of a wavelength range in mm and
/// the gain in this range. If the gains differ by less than 0.005, the text is the largest gain. Otherwise the text is
/// the range from the smallest to the largest gain.
fn gains(gains: &[[f64; 2]]) -> String {
    let least = gains.iter().map(|gain| gain[1]).fold(f64::INFINITY, f64::min);
    let most = gains.iter().map(|gain| gain[1]).fold(0.0, f64::max);
    if most - least < 0.005 { format!("{most:.2}") } else { format!("{least:.2} to {most:.2}") }
}
