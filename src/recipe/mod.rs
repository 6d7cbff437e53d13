//! A recipe: what one part shall become and how a cell gets it there.
//!
//! ```text
//!  text -> RecipeFile (as written, src/recipe/written.rs) -> Recipe (checked: mm, rad, s; no contradiction)
//! ```
//!
//! Everything that is wrong with a file is told at once ([`crate::document::Problems`]), each thing at its line and column. A
//! [`Recipe`] keeps the text it came from and its SHA-256, so that the record of a run holds exactly what was run.
//!
//! Micrometres and degrees stand in the file only. Feeds are mm/min, as on every grinder's panel.

mod check;
mod curvature;
mod written;

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use crate::compensation::{GainRule, Order, Roughness, Smoothing};
use crate::document::{Document, Problems, problem_at, read_text, schema_of, sha256};
use crate::geometry::{Aperture, Pose};
use crate::registration::{self, Loss, ProbeSide, Start};
use crate::surface::{DefinedSurface, Distance, Projection};

/// A recipe, checked.
#[derive(Clone, Debug)]
pub struct Recipe {
    /// The part.
    pub part: Part,
    /// What its surface shall be.
    pub nominal: NominalSource,
    /// How it is measured.
    pub measure: Measure,
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

/// The part of a recipe.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// Its name.
    pub name: String,
    /// What it is made of.
    pub material: Option<String>,
    /// Number of its drawing.
    pub drawing: Option<String>,
}

/// Where the nominal surface comes from.
#[derive(Clone, Debug, PartialEq)]
pub enum NominalSource {
    /// A file of points, a mesh or a definition.
    File {
        /// The file; relative paths of a recipe are relative to the recipe.
        path: PathBuf,
        /// What scattered points are projected onto.
        projection: Projection,
        /// The outline of the part, if it is smaller than the points.
        aperture: Option<Aperture>,
    },
    /// A formula.
    Surface(Box<DefinedSurface>),
}

/// How the part is measured.
#[derive(Clone, Debug, PartialEq)]
pub struct Measure {
    /// Radius of the probe.
    pub probe_radius_mm: f64,
    /// The side of the nominal surface on which the probe's centres lie.
    pub side: ProbeSide,
    /// Where points are taken.
    pub pattern: Pattern,
    /// Distance kept from the edge of the part.
    pub edge_margin_mm: f64,
    /// From how far the probe approaches a point, ball surface to point.
    pub approach_mm: f64,
    /// How far beyond a point the probe searches.
    pub search_mm: f64,
    /// Speed of the probe while it searches.
    pub speed_mm_s: f64,
    /// How far above the highest target the probe travels.
    pub safe_height_mm: f64,
    /// Least share of the points asked for that must be touched, 0 to 1; a measurement with fewer is no measurement.
    pub minimum_coverage: f64,
    /// Whether the reference sphere is touched before the part.
    pub qualify: bool,
    /// How far the radius found on the reference sphere may be from the probe's.
    pub radius_tolerance_mm: f64,
}

/// Where points are taken.
#[derive(Clone, Debug, PartialEq)]
pub enum Pattern {
    /// On a grid over x and y of the model frame, row by row.
    Grid(Density<[u32; 2]>),
    /// On a spiral from the middle outwards.
    Spiral(Density<u32>),
    /// At the points of a file, in the model frame.
    File {
        /// The file.
        path: PathBuf,
    },
    /// Where the operator takes them; the machine gets no plan.
    Free {
        /// How many there must be at least.
        least_points: u32,
    },
}

/// How dense a pattern is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Density<Count> {
    /// Points this far apart.
    SpacingMm(f64),
    /// This many: columns and rows of a grid, points of a spiral.
    Points(Count),
}

/// How the measured points are registered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RegistrationSettings {
    /// How the nominal surface runs between its points.
    pub distance: Distance,
    /// How a distance counts.
    pub loss: Loss,
    /// A point farther away than this many robust sigmas is an outlier.
    pub outlier_sigmas: f64,
    /// Coordinates that stay as the start has them: x, y, z, rx, ry, rz of the model frame.
    pub held: [bool; 6],
    /// Where to begin.
    pub start: StartAt,
    /// The farthest that the part may lie from where the fixture holds it.
    pub largest_shift_mm: f64,
    /// The most that the part may be turned from how the fixture holds it.
    pub largest_turn_rad: f64,
    /// The least share of the surface that must be covered, 0 to 1.
    pub least_coverage: f64,
    /// Refuse a fit whose rms deviation is above this; `None` for the registration's own limit.
    pub max_rms_mm: Option<f64>,
}

/// Where a registration begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum StartAt {
    /// Nowhere in particular.
    Search,
    /// Where the cell's fixture holds the part.
    Fixture,
}

/// When a part is good: every limit that is given must hold. At least one is given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Acceptance {
    /// Largest peak to valley of the deviations.
    pub pv_mm: Option<f64>,
    /// Which points the peak to valley is taken of.
    pub pv_of: PvOf,
    /// Largest rms of the deviations.
    pub rms_mm: Option<f64>,
    /// Whether the expanded uncertainty (k = 2) is added before the comparison.
    pub expanded_uncertainty: bool,
}

/// How what is left is turned into a correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Compensation {
    /// By what the share of the deviation that one cycle takes back is chosen; fixed at 0 measures and judges only.
    pub gain: GainRule,
    /// What a pass adds by itself, as far as the recipe knows (rms).
    pub repeatability_mm: Option<f64>,
    /// Whether a run begins with what the last one of this part found to come back.
    pub learn: bool,
    /// The least that a pass takes off where it takes off least.
    pub least_depth_mm: f64,
    /// Wavelengths shorter than this are left alone.
    pub cutoff_mm: f64,
    /// What makes the map smooth.
    pub smoothing: Smoothing,
    /// What the Gaussian filters let pass unchanged.
    pub filter_order: Order,
    /// How a spline's smoothness is chosen.
    pub roughness: Roughness,
    /// The correction is nowhere larger than this.
    pub largest_correction_mm: f64,
    /// The most that may be taken off anywhere, over all passes.
    pub removal_budget_mm: f64,
    /// The most that one pass may take off anywhere.
    pub depth_of_cut_mm: f64,
    /// Distance of the nodes of the map.
    pub spacing_mm: f64,
    /// How far the correction may sit beside its place on the part (k = 2).
    pub largest_displacement_mm: f64,
}

/// How the part is ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grinding {
    /// The wheel.
    pub wheel: Wheel,
    /// Feed along the track.
    pub feed_mm_min: f64,
    /// Distance of the tracks; the largest one where a scallop height is given.
    pub track_mm: f64,
    /// How the tracks run.
    pub tracks: Tracks,
    /// Height of the ridges between tracks at most.
    pub scallop_mm: Option<f64>,
    /// How far the lines of a program may be from the path of the wheel's centre.
    pub chord_error_mm: f64,
    /// How far tracks go on beyond the edge of the part.
    pub overrun_mm: f64,
    /// How far above its path the wheel travels between tracks.
    pub safe_height_mm: f64,
    /// How exactly the controller keeps to the program.
    pub path_mode: PathMode,
    /// Passes without in-feed at the end.
    pub spark_out_passes: u16,
    /// Level of the first pass over the nominal surface; each further pass goes deeper by the depth of cut.
    pub allowance_mm: f64,
}

/// How tracks run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tracks {
    /// Along x, one beside the other.
    Raster {
        /// Whether all run towards +x.
        one_way: bool,
    },
    /// From the rim to the middle.
    Spiral,
}

/// How exactly a controller keeps to a program.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PathMode {
    /// Corners are rounded off.
    Blend {
        /// By so much at most.
        tolerance_mm: f64,
    },
    /// Every point is passed through.
    ExactPath,
    /// Every point is stopped at.
    ExactStop,
}

/// The shape of a wheel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Wheel {
    /// A ball.
    Sphere {
        /// Its radius.
        radius_mm: f64,
    },
    /// A disc with a round rim.
    Torus {
        /// Radius to the outermost point of the rim.
        radius_mm: f64,
        /// Radius of the rim's own curve.
        minor_radius_mm: f64,
        /// Whether the spindle lies along x; else along y.
        spindle_along_x: bool,
    },
    /// A ring that cuts with its face.
    Cup {
        /// Radius to the middle of the face.
        radius_mm: f64,
        /// Radius of the face's own curve.
        minor_radius_mm: f64,
        /// Tilt of the spindle from z towards -x; `None` for five degrees more than the part slopes.
        tilt_rad: Option<f64>,
    },
}

impl Wheel {
    /// Returns the radius with which the wheel is known to the grinder.
    pub fn radius_mm(&self) -> f64 {
        match *self {
            Self::Sphere { radius_mm } | Self::Torus { radius_mm, .. } | Self::Cup { radius_mm, .. } => radius_mm,
        }
    }
}

/// How often, and what to do when it does not get better.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cycle {
    /// What the first cycle begins with.
    pub begin_with: BeginWith,
    /// Most cycles of grinding and measuring.
    pub most_cycles: u16,
    /// What to do when a cycle brings next to nothing.
    pub on_stall: OnTrouble,
    /// What to do when a cycle makes it worse.
    pub on_divergence: OnTrouble,
    /// An rms that falls by less than this brings next to nothing.
    pub stall_mm: f64,
}

/// What the first cycle begins with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum BeginWith {
    /// A pass of the grinder.
    Grind,
    /// A measurement of the part as it is; its surface stands over the nominal one by `grinding.allowance_um`.
    Measure,
}

/// Which points a peak to valley is taken of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
pub enum PvOf {
    /// All that were used.
    #[serde(rename = "all")]
    All,
    /// All but the outermost 0.2 %, so that no two points decide.
    #[default]
    #[serde(rename = "99.8 %")]
    MostPoints,
}

/// What the share of a deviation that a cycle takes back is chosen by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum GainBy {
    /// What the passes have told of what comes back and what does not, one share for all wavelengths.
    Adaptive,
    /// The same for each octave of wavelengths by itself.
    #[default]
    Wavelength,
}

/// What to do when the part does not get better.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum OnTrouble {
    /// End the run; the part is not in tolerance.
    Stop,
    /// Hold with an alarm; a person decides.
    Hold,
}

static SCHEMA: LazyLock<serde_json::Value> = LazyLock::new(schema_of::<written::RecipeFile>);

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

    /// Reads a recipe from its text; the path is for messages, and relative paths are relative to its folder.
    ///
    /// # Errors
    /// Everything that is wrong with the text.
    pub fn parse(path: &Path, text: &str) -> Result<Self, Problems> {
        let mut document = Document::parse(path, text)?;
        document.hold_against(&SCHEMA);
        let checked = document.as_written().map(|written| check::check(written, path, &mut document));
        document.finish()?;
        let recipe = checked.and_then(|checked| checked.into_recipe(path, text, sha256(text)));
        recipe.ok_or_else(|| {
            Problems::whole(path, text, "something is missing".into(), "compare it with a shipped recipe")
        })
    }

    /// Returns a problem with a key of this recipe that somebody else has found, at its place in the text.
    pub fn problem(&self, key: &str, found: &str, allowed: &str, remedy: &str) -> Problems {
        problem_at(&self.path, &self.text, key, [found, allowed, remedy])
    }

    /// Returns where the nominal surface comes from.
    pub fn nominal_source(&self) -> &NominalSource {
        &self.nominal
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
            locked: settings.held,
            loss: settings.loss,
            outlier_sigmas: settings.outlier_sigmas,
            rms_limit_mm: settings.max_rms_mm,
            ..registration::Options::new(self.measure.probe_radius_mm)
        }
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
