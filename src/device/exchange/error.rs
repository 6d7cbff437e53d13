//! What can be wrong with files that stand for a machine, said so that the person at the machine can mend it.

use std::path::PathBuf;

use thiserror::Error;

use crate::formats::FormatError;
use crate::geometry::RigidError;

/// Why a file that was exchanged with a machine is not taken. Lines count from 1.
#[derive(Debug, Error)]
pub enum ExchangeError {
    /// The file itself is not good.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// Nothing tells centres from contact points.
    #[error(
        "{path}: neither the file nor the cell says whether the coordinates are probe centres or contact points, and a wrong guess is \
         off by the probe radius; put `# coordinates: centres` or `# coordinates: contacts` above the points, or `what = \"centres\"` \
         into the cell file"
    )]
    CoordinatesUnstated {
        /// The file.
        path: PathBuf,
    },
    /// Another number of points than the plan has targets.
    #[error(
        "{path}: {found} points for a plan of {expected} targets; export the whole measurement, or give it a column `index` with the \
         numbers of the plan's targets"
    )]
    Count {
        /// The file.
        path: PathBuf,
        /// Points in the file.
        found: usize,
        /// Targets of the plan.
        expected: usize,
    },
    /// The radius of the probe is not the plan's.
    #[error(
        "{path}: measured with a probe radius of {found_mm} mm, the recipe says {expected_mm} mm; they may differ by {limit_mm} mm: \
         measure with the right probe or correct the recipe"
    )]
    ProbeRadius {
        /// The file.
        path: PathBuf,
        /// Radius in the file.
        found_mm: f64,
        /// Radius of the plan.
        expected_mm: f64,
        /// How much they may differ.
        limit_mm: f64,
    },
    /// A station that sees too few, or too many, reference points.
    #[error(
        "station {station} sees {seen} reference points without names, the nominal file has {nominal} ({names}); {why}: give one \
         for each, or give them the nominal names"
    )]
    ReferenceCount {
        /// The station.
        station: String,
        /// Points seen.
        seen: usize,
        /// Points in the nominal file.
        nominal: usize,
        /// Their names.
        names: String,
        /// Why it cannot be told which is which.
        why: &'static str,
    },
    /// Names that are not nominal ones.
    #[error(
        "station {station}: fewer than 3 of its reference points bear a nominal name; missing are {missing}, not known are {extra}"
    )]
    ReferenceNames {
        /// The station.
        station: String,
        /// Nominal points not seen.
        missing: String,
        /// Seen points not nominal.
        extra: String,
    },
    /// Reference points that fix no pose.
    #[error("station {station}: {source}")]
    Fit {
        /// The station.
        station: String,
        /// The reason.
        source: RigidError,
    },
    /// A reference point that is not where it belongs.
    #[error("station {station}: reference point {point} is off by {off_mm:.3} mm, limit {limit_mm} mm; {diagnosis}")]
    ReferenceOff {
        /// The station.
        station: String,
        /// The point's name.
        point: String,
        /// By how much it is off.
        off_mm: f64,
        /// The limit.
        limit_mm: f64,
        /// What may be the reason, and what to do.
        diagnosis: String,
    },
    /// Several files where there should be one.
    #[error("{folder}: {} files fit `{pattern}`: {}; leave only the right one there", names.len(), names.join(", "))]
    Several {
        /// The folder.
        folder: PathBuf,
        /// The pattern.
        pattern: String,
        /// The files.
        names: Vec<String>,
    },
    /// A file that was taken for another cycle already.
    #[error("{path}: the same bytes were the result of job {job} cycle {cycle}; export the new measurement")]
    TakenBefore {
        /// The file.
        path: PathBuf,
        /// The job.
        job: u32,
        /// The cycle.
        cycle: u16,
    },
    /// A confirmation for something else.
    #[error("{path}: confirms {found}, handed over was {expected}; {remedy}")]
    Confirmation {
        /// The file.
        path: PathBuf,
        /// What it confirms.
        found: String,
        /// What was handed over.
        expected: String,
        /// What to do.
        remedy: &'static str,
    },
    /// The same job and cycle a second time.
    #[error("job {job} cycle {cycle} was handed over before, see {folder}; it is never handed over twice")]
    HandedOver {
        /// The job.
        job: u32,
        /// The cycle.
        cycle: u16,
        /// The folder of the hand-over.
        folder: PathBuf,
    },
    /// A hand-over that is not where it was put.
    #[error("{folder}: the hand-over is not there; was it moved or deleted? put it back or stop the job")]
    Missing {
        /// Where it should be.
        folder: PathBuf,
    },
    /// A file that says it is of something else.
    #[error("{path}: {why}; export the measurement that was asked for")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What it says.
        why: String,
    },
    /// A file that was a measurement of this run already.
    #[error("{path}: the same bytes were a measurement of this run before; export the new one")]
    Offered {
        /// The file.
        path: PathBuf,
    },
}
