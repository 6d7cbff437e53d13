//! A recipe: what one part shall become and how a cell gets it there.
//!
//! ```text
//!  text -> tables (each key declared once: src/recipe/tables.rs) -> Recipe (checked, no contradiction)
//! ```
//!
//! Everything that is wrong with a file is told at once ([`crate::document::Problems`]), each thing at its line and column. A
//! [`Recipe`] keeps the text it came from and its SHA-256, so that the record of a run holds exactly what was run.
//!
//! Units are those of the file, last in the names: micrometres ([`Um`]) and degrees end where a recipe is turned into what is computed
//! with. Feeds are mm/min, as on every grinder's panel.

mod check;
mod curvature;
mod tables;

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use crate::cell::Tolerance;
use crate::document::{Document, Problems, problem_at, read_text, schema_of, sha256};
use crate::geometry::{Aperture, Pose};
use crate::measuring::Layout;
use crate::registration::{self, Coordinate, Start};
use crate::surface::{DefinedSurface, Projection};

use tables::RecipeFile;
pub use tables::{
    Acceptance, Compensation, Cycle, Grinding, Leaning, MachineParameters, Measure, Measuring, Mode, Part,
    RegistrationSettings, SpindleAxis, StartAt, Tilt, Um, Wheel,
};

/// A recipe, checked.
#[derive(Clone, Debug)]
pub struct Recipe {
    /// The part.
    pub part: Part,
    /// What its surface shall be.
    pub nominal: NominalSource,
    /// How it is measured.
    pub measure: Measure,
    /// Which targets are touched.
    pub measuring: Measuring,
    /// Where points are taken.
    pub pattern: Pattern,
    /// How the measured points are registered.
    pub registration: RegistrationSettings,
    /// When it is good.
    pub acceptance: Acceptance,
    /// How what is left is turned into a correction.
    pub compensation: Compensation,
    /// How it is ground.
    pub grinding: Grinding,
    /// How often, and what to do when it does not get better.
    pub cycle: Cycle,
    /// The truth of a simulated cell, as written; the simulator reads it, nobody else.
    pub simulation: Option<toml::Table>,
    path: PathBuf,
    text: String,
    source_sha256: [u8; 32],
}

/// How a table of points is read where it does not say so itself, in the words of the recipe.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TableWords {
    /// Which columns are x, y and z.
    pub columns: Option<String>,
    /// The unit; without it mm.
    pub unit: Option<String>,
    /// The unit of z, where it is another one.
    pub height_unit: Option<String>,
}

/// Where the nominal surface comes from.
#[derive(Clone, Debug, PartialEq)]
pub enum NominalSource {
    /// A file of points, a mesh or a definition.
    File {
        /// The file; relative paths of a recipe are relative to the recipe.
        path: PathBuf,
        /// How a table of points is read.
        table: TableWords,
        /// What scattered points are projected onto.
        projection: Projection,
        /// The outline of the part, if it is smaller than the points.
        aperture: Option<Aperture>,
    },
    /// A formula.
    Surface(Box<DefinedSurface>),
}

/// Where points are taken.
#[derive(Clone, Debug, PartialEq)]
pub enum Pattern {
    /// Where Regrind lays them.
    Laid(Layout),
    /// At the points of a file, in the model frame.
    File {
        /// The file; relative paths of a recipe are relative to the recipe.
        path: PathBuf,
        /// How a table of points is read.
        table: TableWords,
    },
    /// Where the operator takes them; the machine gets no plan.
    Free {
        /// How many there must be at least.
        least_points: u32,
    },
}

static SCHEMA: LazyLock<serde_json::Value> = LazyLock::new(schema_of::<RecipeFile>);

/// Returns the JSON schema of a recipe.
pub fn json_schema() -> &'static serde_json::Value {
    &SCHEMA
}

impl Recipe {
    /// Reads a recipe.
    ///
    /// # Errors
    /// A file that cannot be read, and everything that is wrong with its text.
    pub fn read(path: &Path) -> Result<Self, Problems> {
        let text = read_text(path)?;
        Self::parse(path, &text)
    }

    /// Returns the files that it names beside itself.
    pub fn files(&self) -> Vec<&Path> {
        let nominal = match &self.nominal {
            NominalSource::File { path, .. } => Some(path.as_path()),
            NominalSource::Surface(_) => None,
        };
        let pattern = match &self.pattern {
            Pattern::File { path, .. } => Some(path.as_path()),
            Pattern::Laid(_) | Pattern::Free { .. } => None,
        };
        nominal.into_iter().chain(pattern).collect()
    }

    /// Reads a recipe from its text; the path is for messages, and relative paths are relative to its folder.
    ///
    /// # Errors
    /// Everything that is wrong with the text.
    pub fn parse(path: &Path, text: &str) -> Result<Self, Problems> {
        let mut document = Document::parse(path, text)?;
        document.hold_against(&SCHEMA);
        let written: Option<RecipeFile> = document.as_written();
        let made = written.as_ref().map(|written| check::check(written, path, &mut document));
        document.finish()?;
        let (Some(written), Some((Some(nominal), Some(pattern)))) = (written, made) else {
            let found = "something is missing".into();
            return Err(Problems::whole(path, text, found, "compare it with a shipped recipe"));
        };
        let RecipeFile {
            part,
            measure,
            measuring,
            registration,
            acceptance,
            compensation,
            grinding,
            cycle,
            simulation,
            ..
        } = written;
        Ok(Self {
            part,
            nominal,
            measure,
            measuring,
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
        })
    }

    /// Returns a problem with a key of this recipe that somebody else has found, at its place in the text.
    pub fn problem(&self, key: &str, found: &str, allowed: &str, remedy: &str) -> Problems {
        problem_at(&self.path, &self.text, key, [found, allowed, remedy])
    }

    /// Returns the options of a registration, given where the cell's fixture holds the part.
    pub fn registration_options(&self, fixture_cmm_from_model: Pose) -> registration::Options {
        let settings = &self.registration;
        registration::Options {
            distance: settings.distance,
            start: match settings.start {
                StartAt::Search => Start::Search,
                StartAt::Fixture => Start::Pose(fixture_cmm_from_model),
            },
            side: self.measure.side,
            locked: Coordinate::locked(&settings.hold),
            loss: settings.loss,
            outlier_sigmas: settings.outlier_sigmas,
            rms_limit_mm: settings.max_rms_um.map(Um::mm),
            ..registration::Options::new(self.measure.probe_radius_mm)
        }
    }

    /// Returns the probability with which a figure must be within its limit: no more may be accepted wrongly by who judges than in the whole
    /// of a measurement whose touches are chosen.
    pub fn probability(&self) -> f64 {
        let risk = self.measuring.accepted_risk.filter(|_| self.measuring.mode == Mode::Adaptive);
        let usual = risk.filter(|risk| *risk < 1.0 - Tolerance::USUAL).map_or(Tolerance::USUAL, |risk| 1.0 - risk);
        self.acceptance.probability.unwrap_or(usual)
    }

    /// Returns the path that the recipe was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the exact text of the recipe.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Returns the SHA-256 of the text.
    pub fn source_sha256(&self) -> &[u8; 32] {
        &self.source_sha256
    }
}
