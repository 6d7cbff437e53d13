//! Recipe of a part: its target surface, and how a cell measures, grinds and accepts it.
//!
//! ```text
//!  text -> tables (each key declared once: src/recipe/tables.rs) -> Recipe (checked, no contradiction)
//! ```
//!
//! All errors of a file are reported together ([`crate::document::Problems`]), each with its line and column. A
//! [`Recipe`] keeps its text and its SHA-256, so that the record of a run contains exactly the recipe that was run.
//!
//! Units are those of the file and are the last part of each name. Micrometres ([`Micrometres`]) and degrees are
//! converted when a recipe is turned into numerical settings. Feeds are in mm/min, as on the panel of every grinder.

mod check;
mod curvature;
mod sources;
mod tables;

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

pub use sources::{MeasuringPattern, NominalSource, TableSettings};
use tables::RecipeFile;
pub use tables::{
    Acceptance, Compensation, CycleSettings, Grinding, MeasurementSettings, Micrometres, ParameterTolerances, Part,
    RegistrationSettings, RegistrationStart, SelectionMode, SpindleAxis, Tilt, TiltKind, WheelDimensions,
};

use crate::cell::Tolerance;
use crate::document::{Document, Problems, RenamedKey, problem_at, read_text, schema_of, sha256};
use crate::geometry::Pose;
use crate::registration::{self, Coordinate, Start};

/// Checked recipe.
#[derive(Clone, Debug)]
pub struct Recipe {
    /// The part.
    pub part: Part,
    /// Source of the nominal surface.
    pub nominal: NominalSource,
    /// Settings of the measurement.
    pub measure: MeasurementSettings,
    /// Pattern of the measured points.
    pub pattern: MeasuringPattern,
    /// Settings of the registration.
    pub registration: RegistrationSettings,
    /// Acceptance limits.
    pub acceptance: Acceptance,
    /// Settings that turn the remaining error into a correction.
    pub compensation: Compensation,
    /// Settings of grinding.
    pub grinding: Grinding,
    /// Maximum number of cycles, and the action if the part does not improve.
    pub cycle: CycleSettings,
    /// True properties of a simulated cell, as written in the recipe. Only the simulator reads this table.
    pub simulation: Option<toml::Table>,
    path: PathBuf,
    text: String,
    source_sha256: [u8; 32],
    notes: Vec<String>,
}

/// Keys that have a new name since version 0.2.
const RENAMED: &[RenamedKey] = &[
    RenamedKey { old: "measuring.mode", new: "measure.mode" },
    RenamedKey { old: "measuring.accepted_risk", new: "measure.accepted_risk" },
    RenamedKey { old: "measure.minimum_coverage", new: "measure.min_coverage" },
    RenamedKey { old: "registration.hold", new: "registration.lock" },
    RenamedKey { old: "registration.hold_uncertainty_um", new: "registration.lock_uncertainty_um" },
    RenamedKey { old: "registration.largest_shift_mm", new: "registration.max_shift_mm" },
    RenamedKey { old: "registration.largest_turn_deg", new: "registration.max_turn_deg" },
    RenamedKey { old: "registration.least_coverage", new: "registration.min_coverage" },
    RenamedKey { old: "compensation.least_depth_um", new: "compensation.min_depth_um" },
    RenamedKey { old: "compensation.largest_correction_um", new: "compensation.max_correction_um" },
    RenamedKey { old: "compensation.largest_displacement_mm", new: "compensation.max_displacement_mm" },
    RenamedKey { old: "cycle.most_cycles", new: "cycle.max_cycles" },
    RenamedKey { old: "simulation.cmm.travel_least_mm", new: "simulation.cmm.min_travel_mm" },
    RenamedKey { old: "simulation.cmm.travel_most_mm", new: "simulation.cmm.max_travel_mm" },
    RenamedKey { old: "simulation.cmm.unexpected_touches_most", new: "simulation.cmm.max_unexpected_touches" },
    RenamedKey { old: "simulation.grinder.feed_most_mm_min", new: "simulation.grinder.max_feed_mm_min" },
    RenamedKey { old: "simulation.grinder.map_most_um", new: "simulation.grinder.max_map_um" },
];

static SCHEMA: LazyLock<serde_json::Value> = LazyLock::new(schema_of::<RecipeFile>);

/// Returns the JSON schema of a recipe.
pub fn json_schema() -> &'static serde_json::Value {
    &SCHEMA
}

impl Recipe {
    /// Reads a recipe.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read, and all errors of its text.
    pub fn read(path: &Path) -> Result<Self, Problems> {
        let text = read_text(path)?;
        Self::parse(path, &text)
    }

    /// Returns the paths of the files that the recipe names: the nominal surface and the measuring pattern, if they are
    /// files.
    pub fn files(&self) -> Vec<&Path> {
        let nominal = match &self.nominal {
            NominalSource::File { path, .. } => Some(path.as_path()),
            NominalSource::Surface(_) => None,
        };
        let pattern = match &self.pattern {
            MeasuringPattern::File { path, .. } => Some(path.as_path()),
            MeasuringPattern::Generated(_) | MeasuringPattern::Free { .. } => None,
        };
        nominal.into_iter().chain(pattern).collect()
    }

    /// Parses and checks a recipe from its `text`. `path` is the path of the recipe file. It is used in messages, and
    /// relative paths in the recipe are relative to its folder. Does not read the file.
    ///
    /// # Errors
    /// Fails if the text has errors. The result contains all errors that were found.
    pub fn parse(path: &Path, text: &str) -> Result<Self, Problems> {
        let mut document = Document::parse(path, text)?;
        let notes = document.rename_keys(RENAMED);
        document.check_schema(&SCHEMA);
        let written: Option<RecipeFile> = document.deserialize();
        let made = written.as_ref().map(|written| check::check(written, path, &mut document));
        document.finish()?;
        let (Some(written), Some((Some(nominal), Some(pattern)))) = (written, made) else {
            let found = "a required value is missing".into();
            return Err(Problems::whole(path, text, found, "compare it with a shipped recipe"));
        };
        let RecipeFile { part, measure, registration, acceptance, compensation, grinding, cycle, simulation, .. } =
            written;
        Ok(Self {
            part,
            nominal,
            measure,
            pattern,
            registration,
            acceptance,
            compensation,
            grinding,
            cycle,
            simulation,
            path: path.to_owned(),
            text: text.to_owned(),
            source_sha256: sha256(text),
            notes,
        })
    }

    /// Returns an error for the recipe key `key`. The error contains the position of this key in the recipe file.
    /// `found` describes the value of the key, `allowed` the permitted values, and `remedy` the action that solves the
    /// problem. Other modules call this function when they find a problem with a value of the recipe.
    pub fn problem(&self, key: &str, found: &str, allowed: &str, remedy: &str) -> Problems {
        problem_at(&self.path, &self.text, RENAMED, key, [found, allowed, remedy])
    }

    /// Returns a note for each key that the recipe has under an old name. The note states the line, the old name and
    /// the new name. An old name is not an error: its value is used.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Returns the options of the registration as the recipe defines them. `fixture_cmm_from_model` is the pose of the
    /// part in the fixture of the cell; it maps the model frame to the CMM frame. If the recipe sets
    /// `registration.start` to the fixture, the registration begins with this pose. Otherwise the registration searches
    /// for a start pose.
    pub fn registration_options(&self, fixture_cmm_from_model: Pose) -> registration::RegistrationOptions {
        let settings = &self.registration;
        registration::RegistrationOptions {
            distance_model: settings.distance,
            start: match settings.start {
                RegistrationStart::Search => Start::Search,
                RegistrationStart::Fixture => Start::Pose(fixture_cmm_from_model),
            },
            side: self.measure.side,
            locked: Coordinate::locked_flags(&settings.lock),
            loss: settings.loss,
            outlier_sigmas: settings.outlier_sigmas,
            rms_limit_mm: settings.max_rms_um.map(Micrometres::mm),
            ..registration::RegistrationOptions::new(self.measure.probe_radius_mm)
        }
    }

    /// Returns the probability, from 0 to 1, with which a figure must be within its limit for the part to be accepted.
    /// This is `acceptance.probability` if the recipe contains this key. Otherwise it is 0.975. In mode adaptive, it is
    /// 1 - `measure.accepted_risk` instead if this is higher than 0.975.
    pub fn required_probability(&self) -> f64 {
        let risk = self.measure.accepted_risk.filter(|_| self.measure.mode == SelectionMode::Adaptive);
        let usual = risk
            .filter(|risk| *risk < 1.0 - Tolerance::DEFAULT_PROBABILITY)
            .map_or(Tolerance::DEFAULT_PROBABILITY, |risk| 1.0 - risk);
        self.acceptance.probability.unwrap_or(usual)
    }

    /// Returns the path of the recipe.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the exact text of the recipe.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Returns the SHA-256 of the text of the recipe.
    pub fn source_sha256(&self) -> &[u8; 32] {
        &self.source_sha256
    }
}
