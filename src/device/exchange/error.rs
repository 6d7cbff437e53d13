//! Errors of the files that are exchanged with a machine, in words by which the person at the machine can correct them.

use std::path::PathBuf;

use thiserror::Error;

use crate::hex;
use regrind_core::geometry::RigidError;
use regrind_formats::FormatError;

/// Reason why a file that was exchanged with a machine is not accepted. Lines count from 1.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the message of each tells what its fields are")]
#[non_exhaustive]
pub enum ExchangeError {
    /// The file itself is not valid.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// Neither file nor cell states if the coordinates are probe centres or contact points.
    #[error(
        "{path}: neither the file nor the cell says whether the coordinates are probe centres or contact points, and a wrong guess is \
         off by the probe radius; put `# coordinates: centres` or `# coordinates: contacts` above the points, or `coordinates = \"centres\"` \
         into the cell file"
    )]
    CoordinatesUnstated { path: PathBuf },
    /// The number of points differs from the number of targets of the plan.
    #[error(
        "{path}: {found} points for a plan of {expected} targets; export the whole measurement, or give it a column `index` with the \
         numbers of the plan's targets"
    )]
    Count { path: PathBuf, found: usize, expected: usize },
    /// Too few targets of the plan have a point.
    #[error(
        "{path}: points of {found} of {expected} targets, and {min} are needed; export the whole measurement, or touch what is missing first"
    )]
    TooFewTargets { path: PathBuf, found: usize, expected: usize, min: usize },
    /// The radius of the probe differs from that of the plan.
    #[error(
        "{path}: measured with a probe radius of {found_mm} mm, the recipe says {expected_mm} mm; they may differ by {limit_mm} mm: \
         measure with the right probe or correct the recipe"
    )]
    ProbeRadius { path: PathBuf, found_mm: f64, expected_mm: f64, limit_mm: f64 },
    /// A station sees too few or too many reference points.
    #[error(
        "station {station} sees {seen} reference points without names, the nominal file has {nominal} ({names}); {reason}: give one \
         for each, or give them the nominal names"
    )]
    ReferenceCount { station: String, seen: usize, nominal: usize, names: String, reason: &'static str },
    /// Too few reference points have a nominal name.
    #[error(
        "station {station}: fewer than 3 of its reference points bear a nominal name; missing are {missing}, not known are {extra}"
    )]
    ReferenceNames { station: String, missing: String, extra: String },
    /// The reference points determine no pose.
    #[error("station {station}: {source}")]
    Fit { station: String, source: RigidError },
    /// A reference point is too far from its nominal position.
    #[error("station {station}: reference point {point} is off by {off_mm:.3} mm, limit {limit_mm} mm; {diagnosis}")]
    ReferenceOff { station: String, point: String, off_mm: f64, limit_mm: f64, diagnosis: String },
    /// Several files match where one is required.
    #[error("{folder}: {} files fit `{pattern}`: {}; leave only the right one there", names.len(), names.join(", "))]
    Several { folder: PathBuf, pattern: String, names: Vec<String> },
    /// The file was already accepted for another cycle.
    #[error("{path}: the same bytes were the result of job {job} cycle {cycle}; export the new measurement")]
    AcceptedBefore { path: PathBuf, job: u32, cycle: u16 },
    /// The confirmation is for another hand-over.
    #[error("{path}: confirms {found}, handed over was {expected}; {remedy}")]
    Confirmation { path: PathBuf, found: String, expected: String, remedy: &'static str },
    /// The same job and cycle was handed over before.
    #[error("job {job} cycle {cycle} was handed over before, see {folder}; it is never handed over twice")]
    HandedOver { job: u32, cycle: u16, folder: PathBuf },
    /// Nobody waits for the hand-over any more; it was not made.
    #[error("job {job} cycle {cycle} was not handed over: it took too long, and nobody waited for it any more")]
    Withdrawn { job: u32, cycle: u16 },
    /// The confirmation names another map than the one that was handed over.
    #[error("the confirmation names the map {}, handed over was {}", hex(&found[..8]), hex(&expected[..8]))]
    OtherMap { expected: [u8; 32], found: [u8; 32] },
    /// No hand-over of the job is open.
    #[error("no hand-over of job {job} cycle {cycle} is open")]
    NotOpen { job: u32, cycle: u16 },
    /// The hand-over is not where it was put.
    #[error("{folder}: the hand-over is not there; was it moved or deleted? put it back or stop the job")]
    Missing { folder: PathBuf },
    /// The thread that read the files has failed.
    #[error(
        "{folder}: a file there could not be read by a fault of this program; take away what does not belong there, and report it"
    )]
    ReaderFailed { folder: PathBuf },
    /// The file belongs to something else, by its statements or its points.
    #[error("{path}: {reason}; export the measurement that was asked for")]
    Foreign { path: PathBuf, reason: String },
    /// The file was already a measurement of this run.
    #[error("{path}: the same bytes were a measurement of this run before; export the new one")]
    AlreadyMeasured { path: PathBuf },
}
