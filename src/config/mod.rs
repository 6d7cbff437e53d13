//! A cell: its machines, their wires, the pose of the part in the fixture, and the limits of the machines.
//!
//! ```text
//!  text -> CellFile (as written, src/config/tables.rs) -> CellConfig (checked: mm, rad, s; no contradiction)
//! ```
//!
//! All errors of a file are reported together ([`crate::document::Problems`]), each with its line and column.

mod cell_config;
mod check;
mod dialect;
#[cfg(feature = "plant")]
mod plant;
mod tables;

use std::path::Path;
use std::sync::LazyLock;

use crate::document::{Document, Problems, RenamedKey, problem_at, read_text, schema_of};

pub use cell_config::{
    CellConfig, CmmConfig, GrinderConfig, GrinderLimits, LinkConfig, ProgramConfig, ReferenceSphere, RotaryConfig,
    TravelLimits,
};
pub use dialect::{DialectFile, dialect_schema, dialects, parse_dialect, read_dialect, read_named_dialect};
#[cfg(feature = "plant")]
pub use plant::{PlantConfig, plant_schema};
pub use tables::RotaryLetter;

/// Name of the built-in simulated cell.
pub const BUILT_IN_CELL: &str = "sim";

/// Keys that have a new name since version 0.2.
const RENAMED: &[RenamedKey] = &[
    RenamedKey { old: "cmm.wire.what", new: "cmm.wire.coordinates" },
    RenamedKey { old: "cmm.wire.take_earlier", new: "cmm.wire.accept_earlier_files" },
    RenamedKey { old: "cmm.wire.apart", new: "cmm.wire.cannot_reach_part" },
    RenamedKey { old: "cmm.wire.tries_again", new: "cmm.wire.retries" },
    RenamedKey { old: "cmm.wire.double_within_ms", new: "cmm.wire.duplicate_window_ms" },
    RenamedKey { old: "cmm.wire.line_within_ms", new: "cmm.wire.line_timeout_ms" },
    RenamedKey { old: "cmm.wire.passed_over", new: "cmm.wire.ignored_prefixes" },
    RenamedKey { old: "cmm.wire.repeated", new: "cmm.wire.repeated_touch" },
    RenamedKey { old: "grinder.wire.take_earlier", new: "grinder.wire.accept_earlier_files" },
    RenamedKey { old: "grinder.wire.apart", new: "grinder.wire.cannot_reach_part" },
    RenamedKey { old: "cmm.travel.least_mm", new: "cmm.travel.min_mm" },
    RenamedKey { old: "cmm.travel.most_mm", new: "cmm.travel.max_mm" },
    RenamedKey { old: "grinder.travel.least_mm", new: "grinder.travel.min_mm" },
    RenamedKey { old: "grinder.travel.most_mm", new: "grinder.travel.max_mm" },
    RenamedKey { old: "grinder.rotary.least_deg", new: "grinder.rotary.min_deg" },
    RenamedKey { old: "grinder.rotary.most_deg", new: "grinder.rotary.max_deg" },
    RenamedKey { old: "grinder.rotary.largest_rate_deg_min", new: "grinder.rotary.max_rate_deg_min" },
    RenamedKey { old: "grinder.limits.largest_feed_mm_min", new: "grinder.limits.max_feed_mm_min" },
    RenamedKey { old: "grinder.limits.least_wheel_radius_mm", new: "grinder.limits.min_wheel_radius_mm" },
    RenamedKey { old: "grinder.limits.largest_wheel_radius_mm", new: "grinder.limits.max_wheel_radius_mm" },
    RenamedKey { old: "grinder.limits.largest_depth_mm", new: "grinder.limits.max_depth_mm" },
    RenamedKey { old: "grinder.limits.largest_speed_mm_s", new: "grinder.limits.max_speed_mm_s" },
    RenamedKey { old: "grinder.limits.largest_acceleration_mm_s2", new: "grinder.limits.max_acceleration_mm_s2" },
    RenamedKey { old: "grinder.limits.largest_jerk_mm_s3", new: "grinder.limits.max_jerk_mm_s3" },
];

static SCHEMA: LazyLock<serde_json::Value> = LazyLock::new(schema_of::<tables::CellFile>);

/// Returns the JSON schema of a cell file.
pub fn json_schema() -> &'static serde_json::Value {
    &SCHEMA
}

impl CellConfig {
    /// Reads the cell file at `path`, and returns its checked settings. If `path` is [`BUILT_IN_CELL`], reads no file
    /// and returns the settings of the simulated cell that is built into the program.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read. Otherwise returns all errors found in its text.
    pub fn read(path: &Path) -> Result<Self, Problems> {
        if path == Path::new(BUILT_IN_CELL) {
            return Self::parse(path, include_str!("../../config/sim.toml"));
        }
        let text = read_text(path)?;
        Self::parse(path, &text)
    }

    /// Parses a cell file from its content `text`. `path` is the path of the file: it appears in error messages, and
    /// relative paths in the text are resolved against its folder.
    ///
    /// # Errors
    /// Returns all errors found in the text.
    pub fn parse(path: &Path, text: &str) -> Result<Self, Problems> {
        let mut document = Document::parse(path, text)?;
        let renamed = document.rename_keys(RENAMED);
        document.check_schema(&SCHEMA);
        let checked = document.deserialize().map(|written| check::check(&written, path, &mut document));
        document.finish()?;
        let cell = checked.and_then(|checked| checked.into_cell(path, text, renamed));
        cell.ok_or_else(|| {
            Problems::whole(path, text, "a required value is missing".into(), "compare it with config/sim.toml")
        })
    }

    /// Builds an error report about one key of this cell file, for an error that another module has found. The report
    /// shows the position of `key` in the file. `found` describes the present value, `allowed` the permitted values,
    /// and `remedy` the action that corrects the error.
    pub fn problem(&self, key: &str, found: &str, allowed: &str, remedy: &str) -> Problems {
        problem_at(&self.path, &self.text, RENAMED, key, [found, allowed, remedy])
    }

    /// Returns notes for people about this cell file. A note is about a key under its old name, or about the connection
    /// to a machine, for example a serial port that this computer does not have.
    ///
    /// A note is not an error, because the file can be checked on a computer other than that of the cell.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = [self.renamed.clone(), self.cmm.link.wire.notes(), self.grinder.link.wire.notes()].concat();
        notes.dedup();
        notes
    }

    /// Returns a note for each machine whose calibration had to be repeated before `today`, a day in the form
    /// `2027-03-31`.
    pub fn calibration_notes(&self, today: &str) -> Vec<String> {
        let links = [("cmm", "CMM", &self.cmm.link), ("grinder", "grinder", &self.grinder.link)];
        let note = |(key, name, link): (&str, &str, &LinkConfig)| {
            let due = link.calibration_due.as_ref().filter(|due| due.as_str() < today)?;
            Some(format!(
                "the calibration of the {name} was due on {due} ({key}.calibration_due), so its errors are no longer \
                 known; have the machine calibrated, then write the next day into the cell file"
            ))
        };
        links.into_iter().filter_map(note).collect()
    }

    /// Returns one note for each key that the cell file has under its old name. The note states the line and the new
    /// name. The value under an old name is still used.
    pub fn renamed_keys(&self) -> &[String] {
        &self.renamed
    }

    /// Returns true if all records of the runs of this cell carry the mark SIMULATION. This is the case if the machines
    /// are simulated. This is also the case in a rehearsal (a run in which people act as the machines and no part
    /// exists).
    pub fn is_marked_simulation(&self) -> bool {
        self.simulated || self.rehearsal
    }

    /// Returns true if persons operate both machines by hand: neither machine has an automatic connection.
    pub fn is_manual(&self) -> bool {
        [&self.cmm.link, &self.grinder.link].iter().all(|link| link.wire.is_by_person())
    }

    /// Returns the path of the cell file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the exact text of the cell file.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Returns the SHA-256 of the text of the cell file.
    pub fn source_sha256(&self) -> &[u8; 32] {
        &self.source_sha256
    }
}
