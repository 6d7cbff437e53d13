//! Folders of a grinder: map and pass go out, operator confirmations for start and end come in.
//!
//! `correction.csv` has one row per node, `x_mm,y_mm,correction_mm`, row by row with x fastest. `correction.json` gives
//! grid, sign, frame, units, the pass, and the hash that a confirmation has to name. If the run has a program for the
//! pass, it lies beside them. `started.json` and `done.json` are
//! in the same folder. The person who begins and ends the job copies them into the inbox; `regrind confirm` writes the
//! same files.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use data_encoding::HEXLOWER;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::outbox::{AcceptedFiles, HandOverHeader, Outbox, StoredHandover, absolute, json_lines, read_json, unhex};
use super::watch::{Watch, WatchedFile};
use super::{ConfirmedStep, Exchange, ExchangeError, GrindOrder, HandOver, HandOverStatus, Permit, PollResult};
use crate::{CorrectionMap, Job, Outcome, PassRecord};
use regrind_formats::operator_step::{OperatorAction, OperatorStep, StepConfirmation};
use regrind_formats::result::read_bytes;
use regrind_formats::run_files::{is_tool_path_file, program_for_pass};
use regrind_formats::write_atomic;

/// Names of the two confirmation files in the inbox.
const STARTED: &str = "started.json";
const DONE: &str = "done.json";
/// Name of the table of the map in a hand-over.
const MAP_TABLE: &str = "correction.csv";
/// Name of the file with the settings of the pass in a hand-over.
const PASS_DOCUMENT: &str = "correction.json";

/// Settings of the file exchange with a grinder.
#[derive(Clone, Debug)]
pub struct GrinderExchange {
    /// Name of the part in file names.
    pub part: String,
    /// Folder for the maps.
    pub outbox: PathBuf,
    /// Folder in which confirmations appear.
    pub inbox: PathBuf,
    /// Folder of the run, with the program of each pass.
    pub run_folder: PathBuf,
    /// Time without a change after which a file is complete.
    pub stable_for: Duration,
}

/// Folders of a grinder.
#[derive(Debug)]
pub struct GrinderFolders {
    settings: GrinderExchange,
    outbox: Outbox,
    watch: Watch,
    expected: Option<StoredHandover>,
    /// Action that begins the pass of the expected hand-over, once its files were read for it.
    step: Option<(Job, OperatorAction)>,
    /// Time at which the start was seen, by the clock of the driver.
    started: Option<Duration>,
}

/// Content of a confirmation file: a person confirms that a job has begun or ended.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
struct Confirmation {
    /// Identity of the map in hexadecimal digits: all 64 of them, or at least the first 8.
    map: String,
    job: Option<u32>,
    cycle: Option<u16>,
    /// Name of the operator who confirms.
    operator: Option<String>,
    wheel_radius_mm: Option<f64>,
    temperature_c: Option<f64>,
    removed_mm3: Option<f64>,
}

impl Confirmation {
    fn from_ticket(ticket: &HandOverHeader) -> Self {
        Self { map: ticket.identity.clone(), job: Some(ticket.job), cycle: Some(ticket.cycle), ..Self::default() }
    }

    /// Checks that this confirmation belongs to the hand-over with the header `ticket`. A person confirms with it that
    /// a grinding pass has begun or ended. `path` is the file of the confirmation and is used only in the error text.
    ///
    /// # Errors
    /// Returns an error if the confirmation names no map, another map, another job or another cycle, or if one of its
    /// numbers is negative (except the temperature) or not finite.
    fn check(&self, path: &Path, ticket: &HandOverHeader) -> Result<(), ExchangeError> {
        let wrong = |found: String, expected: String, remedy| {
            Err(ExchangeError::Confirmation { path: path.to_owned(), found, expected, remedy })
        };
        let (map, identity) = (self.map.trim().to_lowercase(), &ticket.identity);
        if map.len() < 8 || !identity.starts_with(&map) {
            let found = if map.is_empty() { "no map".to_owned() } else { format!("map `{}`", self.map) };
            let remedy = "check which map the grinder has; then copy the confirmation file from the folder of the \
                          hand-over to the inbox again";
            return wrong(found, format!("map {identity}"), remedy);
        }
        let job = (self.job.unwrap_or(ticket.job), self.cycle.unwrap_or(ticket.cycle));
        if job != (ticket.job, ticket.cycle) {
            let (found, expected) =
                (format!("job {} cycle {}", job.0, job.1), format!("job {} cycle {}", ticket.job, ticket.cycle));
            let remedy = "copy the confirmation file from the folder of the hand-over to the inbox again";
            return wrong(found, expected, remedy);
        }
        let positive = |value: Option<f64>| value.is_none_or(|v| v.is_finite() && v >= 0.0);
        if !positive(self.wheel_radius_mm)
            || !positive(self.removed_mm3)
            || !self.temperature_c.is_none_or(f64::is_finite)
        {
            return wrong(
                "a negative or invalid number".to_owned(),
                "numbers of 0 or more".to_owned(),
                "correct the numbers",
            );
        }
        Ok(())
    }
}

impl GrinderFolders {
    /// Creates the driver of a grinder that works with two folders: the outbox for the correction maps and the inbox
    /// for the confirmations of a person. `settings` contains both folders. Reads no folder; this happens only when the
    /// driver is opened.
    pub fn new(settings: GrinderExchange) -> Self {
        let outbox = Outbox { folder: settings.outbox.clone() };
        let watch = Watch::new(&settings.inbox, settings.stable_for);
        Self { settings, outbox, watch, expected: None, step: None, started: None }
    }

    fn expect(&mut self, job: Job) -> Result<StoredHandover, ExchangeError> {
        if let Some(stored) = self.expected.as_ref().filter(|l| l.header.job() == job) {
            return Ok(stored.clone());
        }
        let stored = self.outbox.handed_over(job)?;
        self.expected = Some(stored.clone());
        Ok(stored)
    }

    /// Reads the confirmation of a pass from the file `name` in the inbox. Returns its content and the SHA-256 of the
    /// file in hexadecimal digits. `stored` is the hand-over that is confirmed, and `found` are the files in the inbox.
    ///
    /// Returns `None` if the file does not exist, was in the inbox before the hand-over, still changes, cannot be read,
    /// or does not belong to the hand-over. If the file exists, adds the reason to `notes`.
    fn confirmation(
        &self,
        name: &str,
        stored: &StoredHandover,
        found: &[WatchedFile],
        notes: &mut Vec<String>,
    ) -> Option<(Confirmation, String)> {
        let file = found.iter().find(|f| f.name == name)?;
        if stored.header.is_earlier(name, &file.stamp) {
            // The confirmation of an earlier pass, as its hand-over has it, stays in the inbox and is no news.
            let identity = &stored.header.identity;
            let is_of_earlier = |of: &Confirmation| of.map.len() == identity.len() && of.map != *identity;
            if read_json::<Confirmation>(&file.path).is_ok_and(|earlier| is_of_earlier(&earlier)) {
                return None;
            }
            notes.push(format!("{name} was in the inbox before the map was handed over; this file is ignored"));
            return None;
        }
        if !file.settled {
            notes.push(format!("{name} still changes or changed a moment ago; Regrind waits until it is stable"));
            return None;
        }
        let read = || -> Result<(Confirmation, String), ExchangeError> {
            let bytes = read_bytes(&file.path)?;
            let confirmation: Confirmation = read_json(&file.path)?;
            confirmation.check(&file.path, &stored.header)?;
            Ok((confirmation, HEXLOWER.encode(&Sha256::digest(&bytes))))
        };
        read().map_err(|error| notes.push(format!("not accepted: {error}"))).ok()
    }

    /// Returns the action with which a person begins the pass of `stored`. Reads it from the files of the hand-over,
    /// because an earlier process may have written them.
    ///
    /// # Errors
    /// The file with the settings of the pass cannot be read, or somebody has changed its layout.
    fn begin_pass(stored: &StoredHandover) -> Result<OperatorAction, ExchangeError> {
        #[derive(Deserialize)]
        struct HandedOver {
            program: Option<String>,
            pass: HandedOverPass,
        }
        #[derive(Deserialize)]
        struct HandedOverPass {
            wheel_radius_mm: f64,
            feed_mm_min: f64,
            spark_out_passes: u16,
        }
        let HandedOver { program, pass } = read_json(&stored.path.join(PASS_DOCUMENT))?;
        let file = program.as_deref().filter(|name| is_tool_path_file(name)).unwrap_or(MAP_TABLE);
        Ok(OperatorAction::BeginPass {
            part: stored.header.part.clone(),
            cycle: stored.header.cycle.into(),
            program: Some(absolute(&stored.path.join(file))),
            map: map_digits(&stored.header),
            wheel_radius_mm: pass.wheel_radius_mm,
            feed_mm_min: pass.feed_mm_min,
            spark_out_passes: pass.spark_out_passes,
        })
    }

    fn record(&self, stored: &StoredHandover, done: &Confirmation, now: Duration) -> PassRecord {
        let ticket = &stored.header;
        PassRecord {
            removed_mm3: done.removed_mm3,
            wheel_radius_mm: done.wheel_radius_mm,
            temperature_c: done.temperature_c,
            duration_s: self.started.map(|begun| now.saturating_sub(begun).as_secs_f64()),
            ..PassRecord::unmeasured(Outcome::Complete, unhex(&ticket.identity), ticket.job(), ticket.start_number)
        }
    }
}

impl Exchange for GrinderFolders {
    type Request = GrindOrder;
    type Answer = PassRecord;

    fn open(&mut self) -> Result<Vec<HandOver>, ExchangeError> {
        self.outbox.open(&mut self.watch)
    }

    fn publish(&mut self, job: Job, sequence: u32, order: &GrindOrder, permit: &Permit) -> Result<(), ExchangeError> {
        let GrinderExchange { part, inbox, run_folder, .. } = &self.settings;
        let ticket = HandOverHeader::new(part, job, sequence, &order.map_identity, order.pass.wheel_radius_mm, inbox)?;
        let word = json_lines(&serde_json::json!(Confirmation::from_ticket(&ticket)));
        let program = program_for_pass(run_folder, job.cycle.into());
        let name = program.as_ref().and_then(|path| path.file_name()?.to_str());
        let mut files = vec![
            (MAP_TABLE, correction_csv(&ticket, &order.map).into_bytes()),
            (PASS_DOCUMENT, json_lines(&correction_json(&ticket, order, name, inbox))),
            (STARTED, word.clone()),
            (DONE, word),
        ];
        if let Some((path, name)) = program.as_ref().zip(name) {
            files.push((name, read_bytes(path)?));
        }
        self.outbox.publish(&ticket, &files, permit)?;
        (self.expected, self.started, self.step) = (None, None, None);
        Ok(())
    }

    fn mark(&mut self, job: Job, standing: HandOverStatus) -> Result<(), ExchangeError> {
        self.expected = None;
        self.outbox.mark(job, standing)
    }

    fn poll(&mut self, now: Duration, job: Job) -> Result<PollResult<PassRecord>, ExchangeError> {
        let stored = self.expect(job)?;
        let found = self.watch.scan(now)?;
        let mut notes = Vec::new();
        if self.confirmation(STARTED, &stored, &found, &mut notes).is_some() {
            self.started.get_or_insert(now);
        }
        let done = self.confirmation(DONE, &stored, &found, &mut notes);
        let begun = self.started.is_some() || done.is_some();
        let Some((done, sha)) = done else {
            let (what, word, file) = if begun { ("end", "done", DONE) } else { ("start", "started", STARTED) };
            let map = map_digits(&stored.header);
            notes.push(format!(
                "waiting for the confirmation of the {what} of the pass: type regrind confirm {word} --map {map}, or \
                 copy {file} from {} to {}",
                stored.path.display(),
                self.settings.inbox.display()
            ));
            return Ok(PollResult { answer: None, start_confirmed: begun, notes });
        };
        if self.started.is_none() {
            let note = "the end of the pass was confirmed, but not the start: the duration of the pass is unknown";
            notes.push(note.to_owned());
        }
        let taken = AcceptedFiles { job: job.job, cycle: job.cycle, files: vec![(DONE.to_owned(), sha)] };
        self.outbox.record_accepted(&stored, &taken)?;
        Ok(PollResult { answer: Some(self.record(&stored, &done, now)), start_confirmed: begun, notes })
    }

    fn step(&mut self, job: Job, start_confirmed: bool) -> Result<Option<OperatorStep>, ExchangeError> {
        let stored = self.expect(job)?;
        let named_map = Some(map_digits(&stored.header));
        if start_confirmed {
            let (action, confirmation) = (OperatorAction::EndPass, Some(StepConfirmation::Done));
            return Ok(Some(OperatorStep { action, confirmation, named_map }));
        }
        let action = match self.step.take().filter(|(of, _)| *of == job) {
            Some((_, action)) => action,
            None => Self::begin_pass(&stored)?,
        };
        self.step = Some((job, action.clone()));
        Ok(Some(OperatorStep { action, confirmation: Some(StepConfirmation::Started), named_map }))
    }

    fn confirm(&mut self, job: Job, what: ConfirmedStep, map_identity: [u8; 32]) -> Result<(), ExchangeError> {
        let stored = self.expect(job)?;
        if HEXLOWER.encode(&map_identity) != stored.header.identity {
            return Err(ExchangeError::OtherMap { expected: unhex(&stored.header.identity), found: map_identity });
        }
        if stored.status != HandOverStatus::Open {
            return Err(ExchangeError::NotOpen { job: job.job, cycle: job.cycle });
        }
        let name = if what == ConfirmedStep::Started { STARTED } else { DONE };
        let word = json_lines(&serde_json::json!(Confirmation::from_ticket(&stored.header)));
        Ok(write_atomic(&self.settings.inbox.join(name), &word)?)
    }
}

/// Returns the digits of the identity of the map that a confirmation has to name at least.
fn map_digits(ticket: &HandOverHeader) -> String {
    ticket.identity.get(..8).unwrap_or_default().to_owned()
}

fn correction_csv(ticket: &HandOverHeader, map: &CorrectionMap) -> String {
    let mut text = format!(
        "# Regrind correction\n# part: {}\n# job: {}\n# cycle: {}\n# map: {}\n# units: mm\n# frame: model\n\
         # correction: required displacement of the ground surface along the outward normal; \
         a positive value leaves material\n\
         x_mm,y_mm,correction_mm\n",
        ticket.part, ticket.job, ticket.cycle, ticket.identity
    );
    for (k, value) in map.values_mm.iter().enumerate() {
        let [x, y] = map.grid.place_mm(k);
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{x},{y},{value}");
    }
    text
}

fn correction_json(
    ticket: &HandOverHeader,
    order: &GrindOrder,
    program: Option<&str>,
    inbox: &Path,
) -> serde_json::Value {
    let (map, grid, pass) = (&order.map, &order.map.grid, &order.pass);
    serde_json::json!({
        "kind": "correction map", "part": ticket.part, "job": ticket.job, "cycle": ticket.cycle, "map": ticket.identity,
        "program": program, "units": "mm", "frame": "model",
        "sign": "a positive value leaves material, along the outward normal", "absolute": true,
        "columns": grid.columns, "rows": grid.rows, "first_mm": grid.first_mm, "spacing_mm": grid.spacing_mm,
        "nominal_surface": HEXLOWER.encode(&map.part_identity),
        "pass": {
            "wheel_radius_mm": pass.wheel_radius_mm, "feed_mm_min": pass.feed_mm_min, "track_spacing_mm": pass.track_spacing_mm,
            "level_mm": pass.level_mm, "depth_of_cut_mm": pass.depth_of_cut_mm, "spark_out_passes": pass.spark_out_passes,
            "x_mm": pass.x_mm, "y_mm": pass.y_mm,
        },
        "confirm": format!(
            "copy {STARTED} when the pass has begun, and {DONE} when the pass has ended and the wheel is clear of the \
             part; copy both files to {}",
            inbox.display()
        ),
    })
}
