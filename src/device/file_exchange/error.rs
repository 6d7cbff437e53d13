//! Errors of the files that are exchanged with a machine, in words by which the person at the machine can correct them.

use std::path::PathBuf;

use data_encoding::HEXLOWER;
use thiserror::Error;

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
        "{path}: neither the file nor the cell file states whether the coordinates are probe centres or contact \
         points, and a wrong guess causes an error of one probe radius; \
         write `# coordinates: centres` or `# coordinates: \
         contacts` above the points, or `coordinates = \"centres\"` into the cell file"
    )]
    CoordinatesUnstated { path: PathBuf },
    /// The name of a file that a person sends is not one that the inbox expects.
    #[error("{path}: the name does not fit {pattern}, the names of result files in the cell file; rename the file")]
    NameUnfit { path: PathBuf, pattern: String },
    /// The inbox has a file of this name, which a person put there.
    #[error("{path}: {inbox} has a file for this measurement already; move it to another folder first")]
    NameTaken { path: PathBuf, inbox: PathBuf },
    /// The number of points differs from the number of targets of the plan.
    #[error(
        "{path}: {found} points for a plan of {expected} targets; export the complete measurement, or add a column \
         `index` with the numbers of the plan's targets"
    )]
    Count { path: PathBuf, found: usize, expected: usize },
    /// Too few targets of the plan have a point.
    #[error(
        "{path}: {found} of {expected} targets have a point; at least {min} are required; export the complete \
         measurement, or measure the missing targets first"
    )]
    TooFewTargets { path: PathBuf, found: usize, expected: usize, min: usize },
    /// The radius of the probe differs from that of the plan.
    #[error(
        "{path}: measured with a probe radius of {found_mm} mm; the recipe has {expected_mm} mm, and the limit of \
         the difference is {limit_mm} mm: measure with the right probe or correct the recipe"
    )]
    ProbeRadius { path: PathBuf, found_mm: f64, expected_mm: f64, limit_mm: f64 },
    /// A station sees too few or too many reference points.
    #[error(
        "station {station} has {seen} reference points without names, but the nominal file has {nominal} ({names}); \
         {reason}. Measure all nominal points, or give the points the nominal names"
    )]
    ReferenceCount { station: String, seen: usize, nominal: usize, names: String, reason: &'static str },
    /// Too few reference points have a nominal name.
    #[error(
        "station {station}: fewer than 3 of its reference points have a nominal name; missing: {missing}; unknown: \
         {extra}; correct the names"
    )]
    ReferenceNames { station: String, missing: String, extra: String },
    /// The reference points determine no pose.
    #[error("station {station}: {source}")]
    Fit { station: String, source: RigidError },
    /// A reference point is too far from its nominal position.
    #[error(
        "station {station}: reference point {point} is {off_mm:.3} mm from its nominal position, limit {limit_mm} mm; \
         {diagnosis}"
    )]
    ReferenceOff { station: String, point: String, off_mm: f64, limit_mm: f64, diagnosis: String },
    /// Several files match where one is required.
    #[error(
        "{folder}: {} files match `{pattern}`: {}; leave only the requested file in this folder",
        names.len(), names.join(", ")
    )]
    Several { folder: PathBuf, pattern: String, names: Vec<String> },
    /// The file was already accepted for another cycle.
    #[error(
        "{path}: a file with exactly this content was already the result of job {job} cycle {cycle}; export the new \
         measurement"
    )]
    AcceptedBefore { path: PathBuf, job: u32, cycle: u16 },
    /// The confirmation is for another hand-over.
    #[error("{path}: this confirmation contains {found}, but {expected} must be there; {remedy}")]
    Confirmation { path: PathBuf, found: String, expected: String, remedy: &'static str },
    /// The same job and cycle was handed over before.
    #[error(
        "job {job} cycle {cycle} was already handed over (see {folder}); Regrind does not hand over the same cycle of \
         a job twice"
    )]
    HandedOver { job: u32, cycle: u16, folder: PathBuf },
    /// The client had stopped waiting for the hand-over, so it was not published.
    #[error(
        "job {job} cycle {cycle} was not handed over: the start was cancelled, because writing the files took too \
         long; check the folder and its disk"
    )]
    Withdrawn { job: u32, cycle: u16 },
    /// The confirmation names another map than the one that was handed over.
    #[error(
        "the confirmation names the map {}, but the map {} was handed over; check which map the grinder has",
        HEXLOWER.encode(&found[..8]), HEXLOWER.encode(&expected[..8])
    )]
    OtherMap { expected: [u8; 32], found: [u8; 32] },
    /// No hand-over of the job is open.
    #[error("job {job} cycle {cycle} has no open hand-over, so no confirmation is expected")]
    NotOpen { job: u32, cycle: u16 },
    /// The hand-over is not where it was put.
    #[error(
        "{folder}: the folder of the hand-over is missing; check whether this folder was moved or deleted. Put the \
         folder back, or stop the job"
    )]
    Missing { folder: PathBuf },
    /// The thread that read the files has failed.
    #[error(
        "{folder}: this program failed to read a file in this folder; remove the files that do not belong in this \
         folder, and report this error"
    )]
    ReaderFailed { folder: PathBuf },
    /// The header of the file, or its points, show that it is not the requested measurement.
    #[error("{path}: {reason}; export the requested measurement")]
    Foreign { path: PathBuf, reason: String },
    /// The file was already a measurement of this run.
    #[error(
        "{path}: a file with exactly this content was already a measurement of this run; export the new measurement"
    )]
    AlreadyMeasured { path: PathBuf },
}
