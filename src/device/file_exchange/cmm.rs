//! Folders of a measuring machine: the plan goes out, the measurement comes in.
//!
//! `plan.csv` has one row per target, `index,x,y,z,nx,ny,nz,what`. `plan.json` gives the remaining data and the
//! expected result. A result belongs to a hand-over if its name matches the pattern, or if it states part and cycle or
//! the identity of the plan itself. A file that states something else is ignored, whatever its name.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use data_encoding::HEXLOWER;
use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::dmis;
use super::outbox::{
    AcceptedFiles, HandOverHeader, Outbox, StoredHandover, absolute, json_lines, read_json, rename, unhex,
};
use super::result_requirements::{ResultRequirements, assemble_measurement, check_measurement, contradiction};
use super::stations::{PlacedStation, place_station};
use super::watch::{Watch, WatchedFile};
use super::{Exchange, ExchangeError, HandOver, HandOverStatus, MeasureOrder, Pattern, Permit, PollResult, file_word};
use crate::{Job, MeasuredPoint, Measurement, Plan, PlanTarget, TargetKind};
use regrind_formats::operator_step::{OperatorAction, OperatorStep, RequiredPoints, StepConfirmation};
use regrind_formats::references::{References, parse_references, read_references};
use regrind_formats::result::{Content, Coordinates, ResultFile, parse_result, read_bytes, read_statements};
use regrind_formats::{FormatError, write_atomic};

/// Name of the table of the targets in a hand-over.
const PLAN_TABLE: &str = "plan.csv";
/// Name of the file with the settings of the plan in a hand-over.
const PLAN_DOCUMENT: &str = "plan.json";

/// Settings of the file exchange with a measuring machine.
#[derive(Clone, Debug)]
pub struct CmmExchange {
    /// Name of the part in file names and headers.
    pub part: String,
    /// Folder for the plans.
    pub outbox: PathBuf,
    /// Folder in which results appear.
    pub inbox: PathBuf,
    /// Time without a change after which a file is complete.
    pub stable_for: Duration,
    /// Maximum time for which a poll of the folder waits for the reading of the found files. If the reading takes
    /// longer, a later poll returns its result; the job can be held in the meantime.
    pub read_timeout: Duration,
    /// Properties of the result files, as the cell file states them.
    pub content: Content,
    /// Pattern for the names of result files, with `{part}`, `{job}`, `{cycle}` and `*`.
    pub result: Pattern,
    /// Stations, if a measurement is made from several stations.
    pub stations: Option<Stations>,
    /// True if a result may have any number of points without targets; false if it needs a point for every target.
    pub free_count: bool,
    /// True if files are accepted that were in the inbox before the plan was handed over.
    pub accept_earlier_files: bool,
    /// Minimum number of points with a free count; with fewer points the driver waits for further stations.
    pub min_points: usize,
    /// Minimum fraction of the targets that need a point in a result.
    pub min_coverage: f64,
    /// True if the plan itself may be returned as the measurement.
    pub rehearsal: bool,
    /// Maximum difference in mm between the probe radius in a file and that of the plan.
    pub probe_tolerance_mm: f64,
    /// Sensor of the DMIS program, if the plan is also written as one.
    pub dmis_sensor: Option<String>,
}

impl CmmExchange {
    /// Returns the default settings of a CMM that exchanges files with this program. `part` is the name of the part.
    /// `outbox` is the folder to which this program writes measuring plans. `inbox` is the folder in which the result
    /// files of the CMM appear.
    pub fn new(part: impl Into<String>, outbox: impl Into<PathBuf>, inbox: impl Into<PathBuf>) -> Self {
        Self {
            part: part.into(),
            outbox: outbox.into(),
            inbox: inbox.into(),
            stable_for: Duration::from_secs(2),
            read_timeout: DEFAULT_READ_TIMEOUT,
            content: Content::default(),
            result: Pattern::new("{part}_c{cycle}.*"),
            stations: None,
            free_count: false,
            min_points: 1,
            min_coverage: 0.0,
            rehearsal: false,
            accept_earlier_files: false,
            probe_tolerance_mm: 1e-3,
            dmis_sensor: None,
        }
    }
}

/// Settings of a measurement from several stations, each with its own frame.
#[derive(Clone, Debug)]
pub struct Stations {
    /// File names of the points and of the reference points of each station. If both names have one `*`, they represent
    /// as many stations as there are pairs of files with the same characters in place of the `*`. The measurement is
    /// then complete when its files no longer change and have at least `min_points` points.
    pub files: Vec<StationFiles>,
    /// File of the reference points in the frame of the CMM.
    pub nominal: PathBuf,
    /// Group of points in the YAML files, if they hold several groups.
    pub group: Option<String>,
    /// Maximum residual of a reference point after the fit, in mm.
    pub limit_mm: f64,
}

/// File names of one station.
#[derive(Clone, Debug)]
pub struct StationFiles {
    /// Points: one file of the inbox.
    pub points: Pattern,
    /// Reference points as this station sees them: one file of the inbox.
    pub references: Pattern,
}

/// Folders of a measuring machine.
#[derive(Debug)]
pub struct CmmFolders {
    judge: Arc<Judge>,
    watch: Watch,
    /// Check of the inbox that still runs.
    running_judgement: Option<RunningJudgement>,
    /// Plan that this program handed over last.
    published: Option<(Job, Arc<Plan>)>,
    /// Result that is expected. It exists after the plan was handed over, or after the hand-over was read from the
    /// folder following a restart.
    expected: Option<Expected>,
    /// Content of the folder at the last check, and the result of that check.
    last_judgement: Option<(Vec<WatchedFile>, PollResult<Measurement>)>,
    /// Name of the file of the inbox that a person sent last for the expected result.
    sent: Option<String>,
}

/// Checker that reads the files of the inbox and compares them with the expected result.
#[derive(Debug)]
struct Judge {
    settings: CmmExchange,
    outbox: Outbox,
}

/// Check of the inbox on a thread of its own, so that a file that takes long to read does not delay a hold or an abort.
#[derive(Debug)]
struct RunningJudgement {
    job: Job,
    found: Vec<WatchedFile>,
    receiver: mpsc::Receiver<(Judgement, Vec<String>)>,
}

/// Default of [`CmmExchange::read_timeout`].
const DEFAULT_READ_TIMEOUT: Duration = Duration::from_millis(40);
/// Maximum size in bytes of a file that is read although its name does not match the pattern.
const MAX_UNMATCHED_BYTES: u64 = 16 << 20;

/// Result that is expected for a hand-over.
#[derive(Clone, Debug)]
struct Expected {
    stored: StoredHandover,
    /// Plan that was handed over; `None` if any number of points is allowed, or if the stored plan cannot be read.
    plan: Option<Arc<Plan>>,
    /// Numbers of its targets, in the order of the plan.
    targets: Arc<[u32]>,
    since: Option<Duration>,
}

/// Measurement that was accepted from files.
#[derive(Debug)]
struct Accepted {
    measurement: Measurement,
    files: Vec<(String, String)>,
    notes: Vec<String>,
}

/// Result of a check of the inbox: an accepted measurement, or `None` if there is none yet.
type Judgement = Result<Option<Accepted>, ExchangeError>;

/// Finished check, with its notes and with the state of the files when it began.
struct FinishedJudgement {
    judgement: Judgement,
    notes: Vec<String>,
    files: Vec<WatchedFile>,
}

/// Two files of a station: its points, and the reference points in the frame of the station.
type Pair<'f> = (&'f WatchedFile, &'f WatchedFile);

impl CmmFolders {
    /// Creates the driver of a CMM that works with two folders: the outbox for the plans and the inbox for the results.
    /// `settings` contains both folders. Reads no folder; this happens only when the driver is opened.
    pub fn new(settings: CmmExchange) -> Self {
        let outbox = Outbox { folder: settings.outbox.clone() };
        let watch = Watch::new(&settings.inbox, settings.stable_for);
        let judge = Arc::new(Judge { settings, outbox });
        Self {
            judge,
            watch,
            running_judgement: None,
            published: None,
            expected: None,
            last_judgement: None,
            sent: None,
        }
    }

    /// Returns the data of the result that is expected for `job`: the hand-over (the folder with the files for the
    /// machine), the plan and the numbers of the targets. If this program was restarted after the hand-over, reads
    /// these data from the outbox.
    ///
    /// # Errors
    /// Returns an error if the job was not handed over, or if the files of the hand-over cannot be read.
    fn expect(&mut self, job: Job) -> Result<Expected, ExchangeError> {
        if let Some(expected) = self.expected.as_ref().filter(|e| e.stored.header.job() == job) {
            return Ok(expected.clone());
        }
        let stored = self.judge.outbox.handed_over(job)?;
        let (mut plan, mut targets) = (None, Arc::default());
        // If any number of points is allowed, the plan may have no targets.
        if !self.judge.settings.free_count {
            match self.published.as_ref().filter(|(of, _)| *of == job) {
                Some((_, published)) => plan = Some(Arc::clone(published)),
                // A plan that somebody saved again in another layout still gives the numbers of its targets.
                None => plan = stored_plan(&stored.path).ok().map(Arc::new),
            }
            targets = match &plan {
                Some(plan) => plan.targets.iter().map(|target| target.index).collect(),
                None => {
                    let path = stored.path.join(PLAN_TABLE);
                    parse_result(&path, &read_bytes(&path)?, &Content::default())?.indices.unwrap_or_default().into()
                }
            };
        }
        let expected = Expected { stored, plan, targets, since: None };
        self.expected = Some(expected.clone());
        Ok(expected)
    }

    /// Returns the result of a check of the files in the inbox. The check tests in another thread whether the files are
    /// the result `expected`. If no check is running, starts a check of the files `found`. Then waits at most
    /// `read_timeout` for the end of the check.
    ///
    /// Returns `None` in each of these cases:
    ///
    /// - The check is still running.
    /// - The check was of another job.
    /// - The check accepted a file that has changed since the check began.
    fn finished_judgement(&mut self, expected: &Expected, found: &[WatchedFile]) -> Option<FinishedJudgement> {
        let job = expected.stored.header.job();
        if self.running_judgement.is_none() {
            let (judge, expected, files) = (Arc::clone(&self.judge), expected.clone(), found.to_owned());
            let (tell, judged) = mpsc::channel();
            std::thread::spawn(move || {
                let mut notes = Vec::new();
                let judgement = judge.judge(&expected, &files, &mut notes);
                // The receiver may be gone.
                let _ = tell.send((judgement, notes));
            });
            self.running_judgement = Some(RunningJudgement { job, found: found.to_owned(), receiver: judged });
        }
        let judged = self.running_judgement.as_ref()?.receiver.recv_timeout(self.judge.settings.read_timeout);
        if matches!(judged, Err(mpsc::RecvTimeoutError::Timeout)) {
            return None;
        }
        let RunningJudgement { job: asked, found: of, .. } = self.running_judgement.take()?;
        let broken = || (Err(ExchangeError::ReaderFailed { folder: self.judge.settings.inbox.clone() }), Vec::new());
        let (judgement, notes) = judged.unwrap_or_else(|_| broken());
        // Other files may have arrived or changed meanwhile, as a log does repeatedly. The files of an answer must not
        // have changed.
        let stands = |name: &str| of.iter().find(|file| file.name == name).is_some_and(|file| found.contains(file));
        let holds = match &judgement {
            Ok(Some(accepted)) => accepted.files.iter().all(|(name, _)| stands(name)),
            _ => true,
        };
        (asked == job && holds).then_some(FinishedJudgement { judgement, notes, files: of })
    }
}

impl Judge {
    fn judge(&self, expected: &Expected, found: &[WatchedFile], notes: &mut Vec<String>) -> Judgement {
        let accepted = match &self.settings.stations {
            None => self.judge_single(expected, found, notes),
            Some(stations) => self.judge_stations(expected, stations, found, notes),
        }?;
        if let Some((accepted, plan)) = accepted.as_ref().zip(expected.plan.as_ref()) {
            let path = accepted.files.first().map_or_else(PathBuf::new, |(name, _)| self.settings.inbox.join(name));
            let CmmExchange { min_coverage: min_found, rehearsal, .. } = self.settings;
            check_measurement(&path, plan, &accepted.measurement, min_found, rehearsal)?;
        }
        Ok(accepted)
    }

    /// Returns true if `file` may be read as an answer to the hand-over. A file that was in the inbox before the
    /// hand-over may be read only if the settings accept such files. If they do not, returns false and adds a text
    /// about this file to `notes`.
    fn is_new(&self, expected: &Expected, file: &WatchedFile, notes: &mut Vec<String>) -> bool {
        let earlier = !self.settings.accept_earlier_files && expected.stored.header.is_earlier(&file.name, &file.stamp);
        if earlier {
            notes
                .push(format!("{} was in the folder before the plan was handed over; the file was ignored", file.name));
        }
        !earlier
    }

    // ---- one file --------------------------------------------------------------------------------------------------

    fn judge_single(&self, expected: &Expected, found: &[WatchedFile], notes: &mut Vec<String>) -> Judgement {
        let ticket = &expected.stored.header;
        let pattern = self.settings.result.filled(&ticket.part, ticket.job, ticket.cycle);
        let mut ours: Vec<&WatchedFile> = Vec::new();
        for file in found {
            if !self.is_new(expected, file, notes) {
                continue;
            }
            if !file.settled {
                notes.push(format!(
                    "{} is still changing or changed a moment ago; waiting until the file is complete",
                    file.name
                ));
                // Another file must not be accepted before a file that matches the pattern has settled.
                if pattern.fits(&file.name) {
                    return Ok(None);
                }
                continue;
            }
            match self.foreign_reason(ticket, &pattern, file) {
                Ok(None) => ours.push(file),
                Ok(Some(reason)) => notes.push(format!("{} {reason}; ignored", file.name)),
                Err(error) => notes.push(error.to_string()),
            }
        }
        match ours[..] {
            [] => {
                notes.push(format!("waiting for {} in {}", pattern.as_str(), self.settings.inbox.display()));
                Ok(None)
            }
            [file] => self.accept_single(expected, file).map(Some),
            _ => Err(self.several(&pattern, &ours)),
        }
    }

    fn several(&self, pattern: &Pattern, files: &[&WatchedFile]) -> ExchangeError {
        ExchangeError::Several {
            folder: self.settings.inbox.clone(),
            pattern: pattern.as_str().to_owned(),
            names: files.iter().map(|f| f.name.clone()).collect(),
        }
    }

    /// Returns the reason, as text, why `file` does not belong to the hand-over with the header `ticket`. Returns
    /// `None` if the file belongs to this hand-over. Two conditions are then fulfilled:
    ///
    /// - The header of the file states the plan, or the part and the cycle; or the name of the file matches `pattern`.
    /// - Nothing in the header of the file contradicts `ticket`.
    ///
    /// A file of more than 16 MiB whose name does not match `pattern` is not read and does not belong to the hand-over.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read.
    fn foreign_reason(
        &self,
        ticket: &HandOverHeader,
        pattern: &Pattern,
        file: &WatchedFile,
    ) -> Result<Option<String>, ExchangeError> {
        if file.stamp.bytes > MAX_UNMATCHED_BYTES && !pattern.fits(&file.name) {
            let most = MAX_UNMATCHED_BYTES >> 20;
            let pattern = pattern.as_str();
            return Ok(Some(format!(
                "is larger than {most} MiB, and its name does not match {pattern}, so the file was not read"
            )));
        }
        let says = read_statements(&file.path, &read_bytes(&file.path)?)?;
        let says_so = says.part.is_some() && says.cycle.is_some() || says.plan.is_some();
        Ok(contradiction(&says, &ticket.part, ticket.cycle, &ticket.identity).or_else(|| {
            match says_so || pattern.fits(&file.name) {
                true => None,
                false => Some(format!(
                    "does not name this job or its plan, and the file name does not match {}",
                    pattern.as_str()
                )),
            }
        }))
    }

    fn accept_single(&self, expected: &Expected, file: &WatchedFile) -> Result<Accepted, ExchangeError> {
        let (result, sha) = self.read(expected, &file.path)?;
        let points = self.requirements(expected).assign_by_index(&file.path, &result)?;
        let mut notes: Vec<String> = result.notes.iter().map(|note| format!("{}: {note}", file.name)).collect();
        notes.extend(switched_off(&file.name, &result));
        let measurement = self.measurement(expected, points, &[result]);
        Ok(Accepted { measurement, files: vec![(file.name.clone(), sha)], notes })
    }

    /// Reads the file of measured points at `path`. Returns the content of the file and the SHA-256 of its bytes in
    /// hexadecimal digits. Returns an error if the file cannot be read, if another hand-over has already accepted the
    /// same bytes, or if the content does not agree with the plan and the cell file.
    fn read(&self, expected: &Expected, path: &Path) -> Result<(ResultFile, String), ExchangeError> {
        let bytes = read_bytes(path)?;
        let sha = HEXLOWER.encode(&Sha256::digest(&bytes));
        self.check_not_accepted_before(expected, path, &sha)?;
        Ok((self.requirements(expected).read(path, &bytes)?, sha))
    }

    /// Returns the requirements for a result file of the hand-over `expected`. They contain three items:
    ///
    /// - The numbers of the targets of the plan, or `None` if any number of points is allowed.
    /// - The properties of the files from the cell file, for example the unit of length and the decimal mark.
    /// - The probe radius and its tolerance, in mm.
    fn requirements<'a>(&'a self, expected: &'a Expected) -> ResultRequirements<'a> {
        ResultRequirements {
            targets: (!self.settings.free_count).then_some(&*expected.targets),
            content: &self.settings.content,
            probe_radius_mm: expected.stored.header.tool_radius_mm,
            probe_tolerance_mm: self.settings.probe_tolerance_mm,
        }
    }

    /// Returns an error if the file at `path` was already accepted as the answer to another hand-over. `sha` is the
    /// SHA-256 of the file; files with the same `sha` are the same file.
    ///
    /// There is one exception. If the other hand-over is of another run and the cell file has `accept_earlier_files`,
    /// the file is allowed.
    fn check_not_accepted_before(&self, expected: &Expected, path: &Path, sha: &str) -> Result<(), ExchangeError> {
        let own = (expected.stored.header.job, expected.stored.header.cycle);
        let taken = self.outbox.list()?.into_iter().filter_map(|stored| stored.accepted);
        let before = taken.filter(|t| (t.job, t.cycle) != own).find(|t| t.files.iter().any(|(_, s)| s == sha));
        match before {
            // Another run may use the same measurement if the cell file allows it; another cycle of the same run never
            // may.
            Some(AcceptedFiles { job, cycle, .. }) if job == own.0 || !self.settings.accept_earlier_files => {
                Err(ExchangeError::AcceptedBefore { path: path.to_owned(), job, cycle })
            }
            _ => Ok(()),
        }
    }

    fn measurement(&self, expected: &Expected, points: Vec<MeasuredPoint>, results: &[ResultFile]) -> Measurement {
        let ticket = &expected.stored.header;
        assemble_measurement(points, results, ticket.job(), unhex(&ticket.identity), ticket.start_number)
    }

    // ---- several stations ------------------------------------------------------------------------------------------

    fn judge_stations(
        &self,
        expected: &Expected,
        stations: &Stations,
        found: &[WatchedFile],
        notes: &mut Vec<String>,
    ) -> Judgement {
        let new: Vec<&WatchedFile> = found.iter().filter(|file| self.is_new(expected, file, notes)).collect();
        let (pairs, waiting) = self.paired(&expected.stored.header, stations, &new)?;
        if !waiting.is_empty() {
            let (there, of, waiting) = (pairs.len(), stations.files.len(), waiting.join(", "));
            notes.push(format!("{there} of {of} stations are complete; waiting for {waiting}"));
            return Ok(None);
        }
        let used = |name: &str| pairs.iter().any(|(p, r)| p.name == name || r.name == name);
        let left: Vec<&str> = new.iter().map(|f| f.name.as_str()).filter(|name| !used(name)).collect();
        if !left.is_empty() {
            notes.push(format!("these files were ignored, because they belong to no station: {}", left.join(", ")));
        }
        let accepted = self.merge(expected, stations, &pairs)?;
        let (there, least) = (accepted.measurement.points.len(), self.settings.min_points);
        if self.settings.free_count && there < least {
            notes.extend(accepted.notes);
            notes.push(format!(
                "{there} points from {} stations; at least {least} points are required; waiting for further stations",
                pairs.len()
            ));
            return Ok(None);
        }
        Ok(Some(accepted))
    }

    /// Finds the files of each station among the files `new`, which are the files in the inbox that may be read. A
    /// station is one place from which the part is measured, with its own frame. Each station has two files: the
    /// measured points and the measured reference points. `stations` contains the names of these files. The part, the
    /// job and the cycle of `ticket` are filled into the names.
    ///
    /// Returns two lists. The first list contains the pair of files of each complete station. The second list contains
    /// texts about items that are awaited: a missing file, or a file that still changes.
    ///
    /// # Errors
    /// Returns an error if several files match one file name of a station.
    fn paired<'f>(
        &self,
        ticket: &HandOverHeader,
        stations: &Stations,
        new: &[&'f WatchedFile],
    ) -> Result<(Vec<Pair<'f>>, Vec<String>), ExchangeError> {
        let (mut pairs, mut waiting) = (Vec::new(), Vec::new());
        for station in self.named_stations(ticket, stations, new) {
            match (self.settled(&station.points, new)?, self.settled(&station.references, new)?) {
                (Ok(points), Ok(references)) => pairs.push((points, references)),
                (points, references) => waiting.extend([points.err(), references.err()].into_iter().flatten()),
            }
        }
        if waiting.is_empty() && pairs.is_empty() {
            waiting.push("the first station".to_owned());
        }
        Ok((pairs, waiting))
    }

    /// Returns the only file in `new` whose name matches `pattern`. Returns an inner `Err` if there is no such file
    /// yet, or if the file still changes. The inner `Err` is a text that says what is awaited.
    ///
    /// # Errors
    /// Returns an outer `Err` if several files match `pattern`.
    fn settled<'f>(
        &self,
        pattern: &Pattern,
        new: &[&'f WatchedFile],
    ) -> Result<Result<&'f WatchedFile, String>, ExchangeError> {
        let fits: Vec<&WatchedFile> = new.iter().copied().filter(|f| pattern.fits(&f.name)).collect();
        match fits[..] {
            [] => Ok(Err(pattern.as_str().to_owned())),
            [file] if !file.settled => Ok(Err(format!("{} to stop changing", file.name))),
            [file] => Ok(Ok(file)),
            _ => Err(self.several(pattern, &fits)),
        }
    }

    /// Returns two file names for each station: the file of measured points and the file of reference points. A station
    /// is one place from which the part is measured. The names come from the entries in `stations`. The part, the job
    /// and the cycle of `ticket` are filled into the names.
    ///
    /// If both names of an entry contain a star (`*`), this entry stands for several stations. The star is replaced by
    /// each text for which both files exist in `files`. Each such text gives one station. These stations are in the
    /// order of `files`. If only one name or no name contains a star, the entry gives one station.
    fn named_stations(
        &self,
        ticket: &HandOverHeader,
        stations: &Stations,
        files: &[&WatchedFile],
    ) -> Vec<StationFiles> {
        let mut named = Vec::new();
        for station in &stations.files {
            let [points, references] =
                [&station.points, &station.references].map(|p| p.filled(&ticket.part, ticket.job, ticket.cycle));
            if !points.as_str().contains('*') || !references.as_str().contains('*') {
                named.push(StationFiles { points, references });
                continue;
            }
            for star in files.iter().filter_map(|file| points.star(&file.name)) {
                let wanted = references.with_star(star);
                if files.iter().any(|file| file.name == wanted.as_str()) {
                    named.push(StationFiles { points: points.with_star(star), references: wanted });
                }
            }
        }
        named
    }

    fn merge(&self, expected: &Expected, stations: &Stations, pairs: &[Pair<'_>]) -> Result<Accepted, ExchangeError> {
        let nominal = read_references(&stations.nominal, stations.group.as_deref())?;
        let (mut points, mut results) = (Vec::new(), Vec::<ResultFile>::new());
        let (mut files, mut notes) = (Vec::new(), Vec::new());
        for (k, (file, reference_file)) in pairs.iter().enumerate() {
            let (result, sha) = self.read(expected, &file.path)?;
            if let Some(reason) = self.station_contradiction(expected, file)? {
                return Err(reason);
            }
            let bytes = read_bytes(&reference_file.path)?;
            let seen = parse_references(&reference_file.path, &bytes, stations.group.as_deref())?;
            let placed = self.place(k, &seen, &nominal, stations)?;
            notes.extend(switched_off(&file.name, &result));
            notes.push(placed.summary());
            points.extend(result.points.iter().map(|p| placed.cmm_from_station.transform_point(p)));
            files.extend([
                (file.name.clone(), sha),
                (reference_file.name.clone(), HEXLOWER.encode(&Sha256::digest(&bytes))),
            ]);
            if let Some(first) = results.first().filter(|first| first.coordinates != result.coordinates) {
                let words = |c: Option<Coordinates>| format!("{c:?}").to_lowercase();
                return Err(FormatError::Contradiction {
                    path: file.path.clone(),
                    key: "coordinates",
                    found: words(result.coordinates),
                    by: "first station",
                    expected: words(first.coordinates),
                }
                .into());
            }
            results.push(result);
        }
        let points = self.requirements(expected).assign_in_order(&self.settings.inbox, &points)?;
        Ok(Accepted { measurement: self.measurement(expected, points, &results), files, notes })
    }

    fn place(
        &self,
        index: usize,
        seen: &References,
        nominal: &References,
        stations: &Stations,
    ) -> Result<PlacedStation, ExchangeError> {
        let name = seen.path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        place_station(&format!("{} ({name})", index + 1), seen, nominal, stations.limit_mm)
    }

    /// Returns an error value if the header of a station's file names another part, cycle or plan than the hand-over.
    /// Returns `None` if the header agrees or names none of them.
    ///
    /// # Errors
    /// Returns an outer error if the file cannot be read.
    fn station_contradiction(
        &self,
        expected: &Expected,
        file: &WatchedFile,
    ) -> Result<Option<ExchangeError>, ExchangeError> {
        let ticket = &expected.stored.header;
        let reason = self.foreign_reason(ticket, &Pattern::new("*"), file)?;
        Ok(reason.map(|found| {
            FormatError::Contradiction {
                path: file.path.clone(),
                key: "the file",
                found,
                by: "plan",
                expected: format!("part {} cycle {}", ticket.part, ticket.cycle),
            }
            .into()
        }))
    }
}

impl Exchange for CmmFolders {
    type Request = MeasureOrder;
    type Answer = Measurement;

    fn open(&mut self) -> Result<Vec<HandOver>, ExchangeError> {
        self.judge.outbox.open(&mut self.watch)
    }

    fn publish(&mut self, job: Job, sequence: u32, order: &MeasureOrder, permit: &Permit) -> Result<(), ExchangeError> {
        let CmmExchange { part, inbox, .. } = &self.judge.settings;
        let ticket = HandOverHeader::new(part, job, sequence, &order.plan_identity, order.plan.probe_radius_mm, inbox)?;
        let expects = self.judge.settings.result.filled(&ticket.part, ticket.job, ticket.cycle);
        let mut files = vec![
            (PLAN_TABLE, plan_csv(&ticket.part, job, &ticket.identity, &order.plan).into_bytes()),
            (PLAN_DOCUMENT, plan_json(&ticket, order, &self.judge.settings, expects.as_str())),
        ];
        if let (Some(sensor), Some(coordinates)) =
            (&self.judge.settings.dmis_sensor, self.judge.settings.content.coordinates)
        {
            let (part, identity) = (&*ticket.part, &*ticket.identity);
            let about = dmis::DmisHeader { part, cycle: ticket.cycle, identity, sensor, coordinates };
            files.push(("plan.dmi", dmis::program(&order.plan, &about).into_bytes()));
        }
        self.judge.outbox.publish(&ticket, &files, permit)?;
        (self.expected, self.last_judgement, self.running_judgement, self.sent) = (None, None, None, None);
        self.published = Some((job, Arc::new(order.plan.clone())));
        Ok(())
    }

    fn mark(&mut self, job: Job, standing: HandOverStatus) -> Result<(), ExchangeError> {
        (self.expected, self.last_judgement, self.running_judgement) = (None, None, None);
        self.judge.outbox.mark(job, standing)
    }

    fn step(&mut self, job: Job, _: bool) -> Result<Option<OperatorStep>, ExchangeError> {
        if self.judge.settings.stations.is_some() {
            return Ok(None);
        }
        let Expected { stored, targets, .. } = self.expect(job)?;
        let points = match self.judge.settings.free_count {
            true => RequiredPoints::AtLeast(self.judge.settings.min_points),
            false => RequiredPoints::Listed { count: targets.len(), file: absolute(&stored.path.join(PLAN_TABLE)) },
        };
        let action = OperatorAction::Measure {
            part: stored.header.part.clone(),
            cycle: job.batch_id().to_string(),
            points,
            plan: stored.header.identity.get(..8).map(str::to_owned),
            probe_radius_mm: Some(stored.header.tool_radius_mm),
        };
        let confirmation = Some(StepConfirmation::DoneWithFile);
        Ok(Some(OperatorStep { action, confirmation, named_map: None }))
    }

    fn take_file(&mut self, job: Job, file: &Path) -> Result<(), ExchangeError> {
        let Expected { stored, .. } = self.expect(job)?;
        if self.judge.settings.stations.is_some() || stored.status != HandOverStatus::Open {
            return Err(ExchangeError::NotOpen { job: job.job, cycle: job.cycle });
        }
        let HandOverHeader { part, job, cycle, .. } = &stored.header;
        let (pattern, inbox) = (self.judge.settings.result.filled(part, *job, *cycle), &self.judge.settings.inbox);
        let name = fitting_name(file, &pattern)?;
        let bytes = read_bytes(file)?;
        // A person who sends a file again replaces the one that was sent before and not accepted.
        if let Some(before) = self.sent.take().filter(|before| inbox.join(before).exists()) {
            set_aside(inbox, &before)?;
        }
        if inbox.join(&name).exists() {
            return Err(ExchangeError::NameTaken { path: file.to_owned(), inbox: inbox.clone() });
        }
        write_atomic(&inbox.join(&name), &bytes)?;
        self.sent = Some(name);
        Ok(())
    }

    fn poll(&mut self, now: Duration, job: Job) -> Result<PollResult<Measurement>, ExchangeError> {
        let mut expected = self.expect(job)?;
        let since = *expected.since.get_or_insert(now);
        self.expected = Some(expected.clone());
        let found = self.watch.scan(now)?;
        if let Some((_, look)) = self.last_judgement.as_ref().filter(|(before, _)| *before == found) {
            return Ok(look.clone());
        }
        let Some(FinishedJudgement { judgement, mut notes, files: of }) = self.finished_judgement(&expected, &found)
        else {
            let names = || found.iter().map(|file| file.name.as_str()).collect::<Vec<_>>().join(", ");
            let reading =
                || PollResult { start_confirmed: false, answer: None, notes: vec![format!("reading {}", names())] };
            return Ok(self.last_judgement.as_ref().map_or_else(reading, |(_, before)| before.clone()));
        };
        let answer = match judgement {
            Ok(None) => None,
            Err(error) => {
                notes.push(format!("not accepted: {error}"));
                None
            }
            Ok(Some(accepted)) => {
                let taken = AcceptedFiles { job: job.job, cycle: job.cycle, files: accepted.files };
                self.judge.outbox.record_accepted(&expected.stored, &taken)?;
                notes.extend(accepted.notes);
                let duration_s = now.saturating_sub(since).as_secs_f64();
                Some(Measurement { duration_s: Some(duration_s), ..accepted.measurement })
            }
        };
        let look = PollResult { start_confirmed: answer.is_some(), answer, notes };
        self.last_judgement = Some((of, look.clone()));
        Ok(look)
    }
}

/// Returns a name for the file `file` of a person that fits `pattern`. Keeps the name of the file if possible. Otherwise
/// the characters of the star are its extension, or all of its name.
///
/// # Errors
/// The name does not fit, and the pattern has not exactly one star.
fn fitting_name(file: &Path, pattern: &Pattern) -> Result<String, ExchangeError> {
    let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    if !name.starts_with('.') && pattern.fits(name) {
        return Ok(name.to_owned());
    }
    let star = match file.extension().and_then(|extension| extension.to_str()) {
        Some(extension) if pattern.with_star("").as_str().ends_with('.') => extension,
        _ => name,
    };
    let fitting = pattern.with_star(&file_word(star)).as_str().to_owned();
    match pattern.star(&fitting) {
        Some(_) => Ok(fitting),
        None => Err(ExchangeError::NameUnfit { path: file.to_owned(), pattern: pattern.as_str().to_owned() }),
    }
}

/// Renames a file of the folder `inbox` that a person replaces, so that it is no longer read. It stays there.
fn set_aside(inbox: &Path, name: &str) -> Result<(), ExchangeError> {
    let names = (1..).map(|k| inbox.join(format!(".replaced-{k}-{name}")));
    let aside = names.into_iter().find(|path| !path.exists()).expect("some number is free");
    Ok(rename(&inbox.join(name), &aside)?)
}

fn switched_off(name: &str, result: &ResultFile) -> Option<String> {
    let off = result.switched_off;
    (off > 0).then(|| format!("{name}: {off} rows are marked as disabled in the file and were ignored"))
}

/// Reads a plan that was handed over earlier from the files `plan.json` and `plan.csv` in `folder`. These files do not
/// contain the careful start (the slower speed for the first targets). The field `careful_start` of the returned plan
/// is therefore `None`.
///
/// # Errors
/// Returns an error if a file cannot be read, or if somebody has changed the layout of a file.
fn stored_plan(folder: &Path) -> Result<Plan, ExchangeError> {
    #[derive(Deserialize)]
    struct Stored {
        probe_radius_mm: f64,
        approach_mm: f64,
        search_mm: f64,
        speed_mm_s: f64,
        safe_height_mm: f64,
    }
    let Stored { probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm } =
        read_json(&folder.join(PLAN_DOCUMENT))?;
    let path = folder.join(PLAN_TABLE);
    let bytes = read_bytes(&path)?;
    let text = String::from_utf8_lossy(&bytes);
    let rows = text.lines().zip(1..).filter(|(row, _)| !row.starts_with('#')).skip(1);
    let target = |(row, line): (&str, u64)| {
        stored_target(row).ok_or_else(|| FormatError::Unexpected {
            path: path.clone(),
            place: format!("line {line}"),
            expected: "a target row exactly as Regrind wrote this row".to_owned(),
            found: row.chars().take(40).collect(),
        })
    };
    let targets = rows.map(target).collect::<Result<_, _>>()?;
    Ok(Plan { targets, probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm, careful_start: None })
}

/// Parses a row of `plan.csv` as a target. Returns `None` if the row is not a target.
fn stored_target(row: &str) -> Option<PlanTarget> {
    let cells: Vec<&str> = row.split(',').collect();
    let [index, x, y, z, nx, ny, nz, what] = cells[..] else { return None };
    let what =
        [TargetKind::Part, TargetKind::ReferenceSphere].into_iter().find(|kind| what.parse() == Ok(*kind as u16))?;
    let three = |words: [&str; 3]| -> Option<[f64; 3]> {
        let [x, y, z] = words.map(|word| word.parse().ok());
        Some([x?, y?, z?])
    };
    Some(PlanTarget {
        index: index.parse().ok()?,
        kind: what,
        point_mm: three([x, y, z])?,
        normal: three([nx, ny, nz])?,
    })
}

/// Returns the text of the file `plan.csv`. The text begins with a header that names the part, the job and `identity`
/// (the SHA-256 of the plan). After the header, a CSV table contains the targets of the plan: points in mm, unit
/// normals, and kinds.
pub(crate) fn plan_csv(part: &str, job: Job, identity: &str, plan: &Plan) -> String {
    let mut text = format!(
        "# Regrind measuring plan\n# part: {}\n# job: {}\n# cycle: {}\n# plan: {}\n# units: mm\n# probe_radius_mm: {}\n\
         # frame: coordinate system of the measuring machine; x y z = nominal contact point, nx ny nz = outward unit \
         normal\n\
         # what: 1 = the part, 2 = the reference sphere\nindex,x,y,z,nx,ny,nz,what\n",
        part, job.job, job.cycle, identity, plan.probe_radius_mm
    );
    for target in &plan.targets {
        let ([x, y, z], [nx, ny, nz]) = (target.point_mm, target.normal);
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{},{x},{y},{z},{nx},{ny},{nz},{}", target.index, target.kind as u16);
    }
    text
}

fn plan_json(ticket: &HandOverHeader, order: &MeasureOrder, settings: &CmmExchange, expects: &str) -> Vec<u8> {
    let plan = &order.plan;
    let expects = match &settings.stations {
        None => serde_json::json!({
            "file": expects,
            "folder": settings.inbox,
            "points": if settings.free_count { serde_json::json!("any number") } else { plan.targets.len().into() },
            "columns": "index,x,y,z in mm, or x,y,z with a row for every target in the order of the plan",
            "say above the points": [
                format!("# part: {}", ticket.part), format!("# cycle: {}", ticket.cycle), format!("# plan: {}", ticket.identity),
                "# coordinates: centres  (or: contacts)".to_owned(), "# units: mm".to_owned(),
            ],
        }),
        Some(stations) => serde_json::json!({
            "folder": settings.inbox,
            "stations": stations.files.iter().map(|s| [s.points.as_str(), s.references.as_str()]).collect::<Vec<_>>(),
        }),
    };
    json_lines(&serde_json::json!({
        "kind": "measuring plan", "part": ticket.part, "job": ticket.job, "cycle": ticket.cycle, "plan": ticket.identity,
        "units": "mm", "frame": "measuring machine", "targets": plan.targets.len(), "probe_radius_mm": plan.probe_radius_mm,
        "approach_mm": plan.approach_mm, "search_mm": plan.search_mm, "speed_mm_s": plan.speed_mm_s,
        "safe_height_mm": plan.safe_height_mm, "expected_back": expects,
        // After an unusable measurement the part may not lie where it should.
        "careful_targets": plan.careful_start.map_or(0, |careful| careful.target_count),
        "careful_speed_mm_s": plan.careful_start.map(|careful| careful.speed_mm_s),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sent_file_gets_fitting_name() {
        let name = |file: &str, pattern: &str| fitting_name(Path::new(file), &Pattern::new(pattern)).ok();
        assert_eq!(name("a/SN-7_c1.csv", "SN-7_c1.*").as_deref(), Some("SN-7_c1.csv"));
        assert_eq!(name("a/points.csv", "SN-7_c1.*").as_deref(), Some("SN-7_c1.csv"));
        assert_eq!(name("points.csv", "SN-7_*_c1").as_deref(), Some("SN-7_points.csv_c1"));
        assert_eq!(name("points", "SN-7_c1.*").as_deref(), Some("SN-7_c1.points"));
        assert_eq!(name("points.csv", "result.txt"), None);
        assert_eq!(name("points.csv", "*_c1_*"), None);
        assert_eq!(name("result.txt", "result.txt").as_deref(), Some("result.txt"));
    }
}
