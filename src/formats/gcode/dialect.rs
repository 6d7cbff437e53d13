//! Dialects: the form in which a kind of control needs its programs, as data: words, numbers, comments, path modes,
//! first and last lines.
//!
//! A dialect is a file. If it cannot express what a pass needs, the program is rejected ([`Dialect::post`]) and nothing
//! is omitted: a program that rounds corners by more than the recipe allows is worse than no program.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use regrind_core::compensation::path::{ArcOptions, PathMode, RotaryAxis};

/// Name of the dialect of LinuxCNC, which is the default of a cell.
pub const LINUXCNC: &str = "linuxcnc";

/// Format of the programs of a kind of control.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Dialect {
    /// Name of the dialect, and extension of its files.
    #[schemars(extend("x-required" = true))]
    pub dialect: Naming,
    /// Lines and comments.
    #[schemars(extend("x-required" = true))]
    pub text: Text,
    /// Numbers of blocks. Default: blocks have no numbers.
    pub blocks: Option<Blocks>,
    /// Format of numbers.
    #[schemars(extend("x-required" = true))]
    pub numbers: Numbers,
    /// The words of a move.
    #[schemars(extend("x-required" = true))]
    pub words: Words,
    /// Format of arcs. Default: lines only.
    pub arcs: Option<ArcWords>,
    /// Lines that select the path mode of a control; an omitted mode is refused.
    pub path: Modes,
    /// Lines for a head that tilts the wheel; a way of tilting that is omitted here is refused.
    pub rotary: Tilting,
    /// Lines before and after the moves.
    #[schemars(extend("x-required" = true))]
    pub program: Frame,
}

/// Name of a dialect, and extension of its files.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Naming {
    /// Name of the dialect.
    #[schemars(length(min = 1, max = 40), extend("x-required" = true), example = &"fanuc")]
    pub name: String,
    /// Extension of its files, without the point.
    #[schemars(length(min = 1, max = 8), extend("x-required" = true), example = &"nc")]
    pub extension: String,
}

/// End of a line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LineEnd {
    /// A line feed.
    #[default]
    Lf,
    /// A carriage return and a line feed.
    Crlf,
}

/// Lines and comments.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Text {
    /// End of each line.
    pub line_end: LineEnd,
    /// Maximum length of a line, in characters; longer comments are divided.
    #[schemars(range(min = 40, max = 10000))]
    pub max_line_length: usize,
    /// Text that begins a comment.
    #[schemars(length(min = 1, max = 8), extend("x-required" = true), example = &"(")]
    pub comment_begins: String,
    /// Text that ends a comment, if the end of its line does not.
    #[schemars(length(max = 8), example = &")")]
    pub comment_ends: String,
    /// Whether programs have capital letters only.
    pub upper_case: bool,
}

impl Default for Text {
    fn default() -> Self {
        let (comment_begins, comment_ends) = (String::new(), String::new());
        Self { line_end: LineEnd::Lf, max_line_length: 255, comment_begins, comment_ends, upper_case: false }
    }
}

/// Numbers of blocks.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Blocks {
    /// Text before the number.
    #[schemars(length(max = 4), example = &"N")]
    pub letter: String,
    /// Number of the first block.
    #[schemars(range(max = 100000))]
    pub first: u32,
    /// Step from each number to the next.
    #[schemars(range(min = 1, max = 1000))]
    pub step: u32,
    /// Largest number; after it the numbers begin again with the first one.
    #[schemars(range(min = 1, max = 999999999))]
    pub last: u32,
    /// Whether comments and the lines before them also have numbers.
    pub all: bool,
}

impl Default for Blocks {
    fn default() -> Self {
        Self { letter: "N".into(), first: 10, step: 10, last: 99_999, all: false }
    }
}

/// Format of numbers.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Numbers {
    /// Number of decimals of a coordinate; all of them are written.
    #[schemars(range(min = 2, max = 6), extend("x-required" = true), example = 4)]
    pub decimals: u8,
    /// Whether a coordinate of 0 or more has a plus sign.
    pub plus: bool,
    /// Maximum coordinate.
    #[schemars(range(min = 1.0, max = 1e6))]
    pub max_mm: f64,
    /// Number of decimals of an angle in degrees; all of them are written.
    #[schemars(range(min = 2, max = 6))]
    pub angle_decimals: u8,
    /// Maximum number of decimals of a feed; trailing zeros are omitted.
    #[schemars(range(max = 6))]
    pub feed_decimals: u8,
    /// Whether a whole feed ends with a point, for controls on which a number without a point counts increments.
    pub feed_point: bool,
}

impl Default for Numbers {
    fn default() -> Self {
        Self { decimals: 0, plus: false, max_mm: 1e6, angle_decimals: 4, feed_decimals: 6, feed_point: false }
    }
}

/// The words of a move.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Words {
    /// Text that begins a rapid move.
    #[schemars(length(min = 1, max = 20), extend("x-required" = true), example = &"G0 ")]
    pub rapid: String,
    /// Text that ends a rapid move.
    #[schemars(length(max = 20), example = &" R0 FMAX")]
    pub rapid_ends: String,
    /// Text that begins a straight move at feed.
    #[schemars(length(min = 1, max = 20), extend("x-required" = true), example = &"G1 ")]
    pub line: String,
    /// Whether `rapid` and `line` begin every block; if not, only where the motion changes or a track begins.
    pub each_block: bool,
    /// Words of the three axes.
    #[schemars(inner(length(min = 1, max = 4)))]
    pub axes: [String; 3],
    /// Text between the words of a block.
    #[schemars(length(max = 2))]
    pub between: String,
    /// Text before a feed, in mm/min.
    #[schemars(length(min = 1, max = 4))]
    pub feed: String,
}

impl Default for Words {
    fn default() -> Self {
        Self {
            rapid: String::new(),
            rapid_ends: String::new(),
            line: String::new(),
            each_block: false,
            axes: ["X", "Y", "Z"].map(str::to_owned),
            between: " ".into(),
            feed: "F".into(),
        }
    }
}

/// Format of the centre of an arc.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum CentreWords {
    /// By `centre_words`, relative to the start of the arc.
    #[default]
    FromStart,
    /// By `centre_words`, in absolute coordinates.
    Absolute,
    /// By `centre_block`, a separate block before the arc that gives the coordinates with the words of the axes.
    BlockBefore,
}

/// Format of arcs.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ArcWords {
    /// Text that begins a clockwise arc, seen from the positive end of the axis normal to its plane.
    #[schemars(length(min = 1, max = 20), extend("x-required" = true), example = &"G2 ")]
    pub clockwise: String,
    /// Text after the coordinates of the arc.
    #[schemars(length(max = 20), example = &" DR-")]
    pub clockwise_ends: String,
    /// Text that begins a counter-clockwise arc.
    #[schemars(length(min = 1, max = 20), extend("x-required" = true), example = &"G3 ")]
    pub counter_clockwise: String,
    /// Text after the coordinates of the arc.
    #[schemars(length(max = 20), example = &" DR+")]
    pub counter_clockwise_ends: String,
    /// Texts that select the planes of x and y, of z and x, of y and z, before an arc in another plane than the last
    /// one. Omit them if the axes in the block determine the plane.
    #[schemars(inner(length(min = 1, max = 20)))]
    pub planes: Option<[String; 3]>,
    /// Format of the centre.
    pub centre: CentreWords,
    /// The words of the centre along the three axes.
    #[schemars(inner(length(min = 1, max = 4)))]
    pub centre_words: Option<[String; 3]>,
    /// Text that begins the block of the centre.
    #[schemars(length(min = 1, max = 20), example = &"CC ")]
    pub centre_block: Option<String>,
    /// Whether the third axis may move during an arc.
    pub third_axis: bool,
    /// Maximum difference between the radius at the end and at the start that the control accepts.
    #[schemars(range(min = 0.0, max = 1000.0), extend("x-required" = true), example = 2.0)]
    pub radius_error_um: f64,
    /// Lines after `program.setup` of a program with arcs.
    #[schemars(length(max = 16), inner(length(min = 1, max = 200)))]
    pub begin: Vec<String>,
    /// Lines before `program.end` of a program with arcs.
    #[schemars(length(max = 16), inner(length(min = 1, max = 200)))]
    pub end: Vec<String>,
}

impl Default for ArcWords {
    fn default() -> Self {
        let none = String::new;
        Self {
            clockwise: none(),
            clockwise_ends: none(),
            counter_clockwise: none(),
            counter_clockwise_ends: none(),
            planes: None,
            centre: CentreWords::FromStart,
            centre_words: None,
            centre_block: None,
            third_axis: false,
            radius_error_um: 0.0,
            begin: Vec::new(),
            end: Vec::new(),
        }
    }
}

/// Lines that select the path mode of a control.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Modes {
    /// For `path_mode = "blend"`; `{tolerance_mm}` is the maximum rounding of corners.
    pub blend: Option<PathModeText>,
    /// For `path_mode = "exact-path"`.
    pub exact_path: Option<PathModeText>,
    /// For `path_mode = "exact-stop"`.
    pub exact_stop: Option<PathModeText>,
}

/// Lines that select a path mode.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PathModeText {
    /// Lines before the moves.
    #[schemars(length(min = 1, max = 16), inner(length(min = 1, max = 200)), extend("x-required" = true))]
    pub begin: Vec<String>,
    /// Lines after the moves.
    #[schemars(length(max = 16), inner(length(min = 1, max = 200)))]
    pub end: Vec<String>,
}

/// Lines for a head that tilts the wheel.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Tilting {
    /// For a control that keeps the wheel's centre while the head turns: positions and feeds of the program are those
    /// of the centre.
    pub tool_centre: Option<Turning>,
    /// For a program with the positions of the slides: they include the rotation about the pivot. A feed is the inverse
    /// of the time of a block, in 1/min, because a slide can move far while the wheel hardly moves.
    pub slides: Option<Turning>,
}

/// Lines that select a way of tilting.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Turning {
    /// Lines before the moves, after those of the path mode; empty if the control needs no lines.
    #[schemars(length(max = 16), inner(length(min = 1, max = 200)))]
    pub begin: Vec<String>,
    /// Lines after the moves.
    #[schemars(length(max = 16), inner(length(min = 1, max = 200)))]
    pub end: Vec<String>,
}

/// Lines before and after the moves.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Frame {
    /// Maximum length of the name of a program.
    #[schemars(range(min = 4, max = 80))]
    pub max_name_length: usize,
    /// First and last number of programs; each cycle uses the next number.
    pub numbers: Option<[u32; 2]>,
    /// Lines before the comments; `{name}` and `{number}` are those of the program.
    #[schemars(length(max = 32), inner(length(min = 1, max = 200)))]
    pub begin: Vec<String>,
    /// Lines after the comments: units of mm and mm/min, absolute coordinates, the plane, the work offset, no
    /// compensations.
    #[schemars(length(max = 32), inner(length(min = 1, max = 200)))]
    pub setup: Vec<String>,
    /// Lines at the end.
    #[schemars(length(min = 1, max = 32), inner(length(min = 1, max = 200)), extend("x-required" = true))]
    pub end: Vec<String>,
}

impl Default for Frame {
    fn default() -> Self {
        Self { max_name_length: 24, numbers: None, begin: Vec::new(), setup: Vec::new(), end: Vec::new() }
    }
}

/// Fault of a key of a dialect: the key, the value found, the allowed values and the remedy.
#[derive(Clone, Debug, PartialEq)]
pub struct DialectProblem {
    /// The key as a path.
    pub key: String,
    /// Value found.
    pub found: String,
    /// Allowed values.
    pub allowed: &'static str,
    /// Remedy.
    pub remedy: &'static str,
}

/// Requirement of a program that a dialect cannot express.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum DialectError {
    #[error(
        "the dialect `{dialect}` has no words for grinding.path_mode = \"{mode}\"; choose another path mode, or \
         write [path.{key}] into a dialect of your own"
    )]
    Mode { dialect: String, mode: &'static str, key: &'static str },
    #[error(
        "the dialect `{dialect}` cannot state how far the control may round corners; a setting of the control determines it: \
         write that setting as grinder.program.controller_tolerance_um into the cell file"
    )]
    ToleranceUnknown { dialect: String },
    #[error(
        "the control rounds corners by {found_um} µm (grinder.program.controller_tolerance_um); \
         grinding.path_tolerance_um allows {limit_um} µm; set a tighter tolerance on the control, or raise \
         grinding.path_tolerance_um"
    )]
    ToleranceWide { found_um: f64, limit_um: f64 },
    #[error(
        "grinding.path_tolerance_um = {found_um} cannot be written with the {decimals} decimals of a length in the \
         dialect `{dialect}`; write a multiple of {step_um} µm"
    )]
    ToleranceFine { dialect: String, found_um: f64, decimals: u8, step_um: f64 },
    #[error(
        "the dialect `{dialect}` writes {decimals} decimals, which moves points by up to {found_um:.3} µm; \
         grinding.chord_error_um allows {limit_um} µm; raise it, or write more decimals into a dialect of your own \
         if the control reads them"
    )]
    Rounding { dialect: String, decimals: u8, found_um: f64, limit_um: f64 },
    #[error(
        "the dialect `{dialect}` has no words for arcs; remove grinder.program.arcs_within_um, or write [arcs] into \
         a dialect of your own"
    )]
    NoArcs { dialect: String },
    #[error(
        "grinder.program.arcs_within_um is {found_um} µm, less than the {min_um:.4} µm by which the {decimals} \
         decimals of the dialect `{dialect}` move points; raise it, or write more decimals into a dialect of your \
         own if the control reads them"
    )]
    ArcsFine { dialect: String, found_um: f64, decimals: u8, min_um: f64 },
    #[error(
        "grinder.program.arcs_within_um is {found_um} µm, more than grinding.chord_error_um, {limit_um} µm; write \
         {limit_um} or less"
    )]
    ArcsWide { found_um: f64, limit_um: f64 },
    #[error(
        "grinder.program.arcs_within_um requires an upright wheel, but grinding.tilt tilts the wheel; remove one of the two keys"
    )]
    ArcsTilted,
    #[error(
        "the dialect `{dialect}` has no words for a control that keeps the wheel's centre while the head tilts; give \
         the place of the pivot, grinder.rotary.pivot_mm, or write [rotary.tool_centre] into a dialect of your own"
    )]
    ToolCentre { dialect: String },
    #[error(
        "the dialect `{dialect}` has no words for slides that move with a tilting head; remove \
         grinder.rotary.pivot_mm if the control keeps the wheel's centre, or write [rotary.slides] into a dialect of \
         your own"
    )]
    Slides { dialect: String },
    #[error(
        "programs of the dialect `{dialect}` have the numbers {least} to {most} (program.numbers), and cycle {cycle} \
         has no number in this range; extend the range"
    )]
    Number { dialect: String, least: u32, most: u32, cycle: u16 },
}

/// A dialect that can express a program, with its lines for the path mode and its words for arcs.
#[derive(Clone, Debug, PartialEq)]
pub struct Post<'a> {
    /// The dialect.
    pub dialect: &'a Dialect,
    /// Lines before and after the moves that set the path mode.
    pub mode: [Vec<String>; 2],
    /// Words for arcs and the limits of arcs; `None` if no arcs are written.
    pub arcs: Option<(&'a ArcWords, ArcOptions)>,
}

/// Accuracy with which a control has to follow a program.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exactness {
    /// The path mode.
    pub mode: PathMode,
    /// Maximum rounding of corners with [`PathMode::Blend`], in millimetres.
    pub tolerance_mm: f64,
    /// Maximum rounding of corners by a setting of the control itself, in millimetres, if it is known.
    pub controller_mm: Option<f64>,
    /// Maximum distance of points from their exact position, in millimetres.
    pub chord_error_mm: f64,
    /// Maximum distance from the path of arcs that replace lines, in millimetres; `None` for lines only.
    pub arcs_within_mm: Option<f64>,
}

impl Dialect {
    /// Returns the texts of this dialect for a program with the accuracy `exactness`: the lines that set the path mode,
    /// and the words for arcs. No words for arcs are returned if `exactness` allows only straight lines.
    ///
    /// The path mode selects how exactly the control follows the corners of the path. In the mode [`PathMode::Blend`],
    /// the control rounds the corners within the path tolerance.
    ///
    /// # Errors
    /// - The dialect has no words for the path mode.
    /// - In the mode `Blend`, the lines of the dialect do not contain the path tolerance, and the setting of the
    ///   control is unknown or above this tolerance.
    /// - In the mode `Blend`, the lines contain the path tolerance, but the decimals of the dialect cannot express its
    ///   value.
    /// - Rounding to the decimals of the dialect moves points by more than the chord error.
    /// - Arcs are requested, but the dialect has no words for them.
    /// - Arcs are requested with a tolerance below the rounding error or above the chord error.
    pub fn post(&self, exactness: &Exactness) -> Result<Post<'_>, DialectError> {
        let dialect = || self.dialect.name.clone();
        let (mode, word, key) = match exactness.mode {
            PathMode::Blend => (&self.path.blend, "blend", "blend"),
            PathMode::ExactPath => (&self.path.exact_path, "exact-path", "exact_path"),
            PathMode::ExactStop => (&self.path.exact_stop, "exact-stop", "exact_stop"),
        };
        let mode = mode.as_ref().ok_or_else(|| DialectError::Mode { dialect: dialect(), mode: word, key })?;
        let decimals = self.numbers.decimals;
        let step_mm = 10f64.powi(-i32::from(decimals));
        if exactness.mode == PathMode::Blend {
            self.check_tolerance(mode, exactness, step_mm)?;
        }
        let (found_um, limit_um) = (self.rounding_um(), 1e3 * exactness.chord_error_mm);
        if found_um > limit_um * (1.0 + 1e-9) {
            return Err(DialectError::Rounding { dialect: dialect(), decimals, found_um, limit_um });
        }
        let tolerance = super::number::short(exactness.tolerance_mm);
        let lines = |lines: &[String]| lines.iter().map(|line| line.replace(TOLERANCE, &tolerance)).collect();
        let arcs = exactness.arcs_within_mm.map(|within_mm| self.arcs(within_mm)).transpose()?;
        if let Some(found_um) = exactness.arcs_within_mm.map(|mm| 1e3 * mm).filter(|um| *um > limit_um * (1.0 + 1e-9)) {
            return Err(DialectError::ArcsWide { found_um, limit_um });
        }
        Ok(Post { dialect: self, mode: [lines(&mode.begin), lines(&mode.end)], arcs })
    }

    /// Returns the words of this dialect for arcs, and the limits for the computation of arcs. `within_mm` is the
    /// maximum distance of an arc from the path, in millimetres.
    ///
    /// # Errors
    /// A dialect without words for arcs; a `within_mm` below the rounding error of the dialect's decimals.
    pub fn arcs(&self, within_mm: f64) -> Result<(&ArcWords, ArcOptions), DialectError> {
        let dialect = || self.dialect.name.clone();
        let words = self.arcs.as_ref().ok_or_else(|| DialectError::NoArcs { dialect: dialect() })?;
        let (found_um, min_um, decimals) = (1e3 * within_mm, self.rounding_um(), self.numbers.decimals);
        if found_um < min_um {
            return Err(DialectError::ArcsFine { dialect: dialect(), found_um, decimals, min_um });
        }
        let options = ArcOptions {
            tolerance_mm: within_mm,
            steps_per_mm: 10f64.powi(i32::from(decimals)),
            max_radius_error_mm: 1e-3 * words.radius_error_um,
            max_coordinate_mm: self.numbers.max_mm,
            allows_helix: words.third_axis,
            // An arc must not need more blocks than the lines that it replaces.
            min_lines: if words.centre == CentreWords::BlockBefore { 3 } else { 2 },
        };
        Ok((words, options))
    }

    /// Returns the largest distance, in micrometres, by which rounding to the decimals of this dialect moves a point.
    fn rounding_um(&self) -> f64 {
        1e3 * 0.5 * 10f64.powi(-i32::from(self.numbers.decimals)) * 3f64.sqrt()
    }

    /// Returns the lines of this dialect for a rotary head that tilts the wheel. One group of lines comes before the
    /// moves and selects how the control treats the tilt. The other group comes after the moves and ends this mode.
    /// `rotary` is the rotary axis of the head.
    ///
    /// If `rotary.pivot_mm` is `None`, the control itself keeps the wheel's centre at the programmed position. Then
    /// `[rotary.tool_centre]` of the dialect is returned. Otherwise the program states the positions of the slides (the
    /// linear axes), and `[rotary.slides]` is returned.
    ///
    /// # Errors
    /// A dialect without the required lines.
    pub fn turning(&self, rotary: &RotaryAxis) -> Result<&Turning, DialectError> {
        let dialect = || self.dialect.name.clone();
        match rotary.pivot_mm {
            None => self.rotary.tool_centre.as_ref().ok_or_else(|| DialectError::ToolCentre { dialect: dialect() }),
            Some(_) => self.rotary.slides.as_ref().ok_or_else(|| DialectError::Slides { dialect: dialect() }),
        }
    }

    fn check_tolerance(&self, mode: &PathModeText, exactness: &Exactness, step_mm: f64) -> Result<(), DialectError> {
        let says = mode.begin.iter().any(|line| line.contains(TOLERANCE));
        let (dialect, limit_um) = (self.dialect.name.clone(), 1e3 * exactness.tolerance_mm);
        match exactness.controller_mm {
            None if !says => Err(DialectError::ToleranceUnknown { dialect }),
            Some(mm) if !says && mm > exactness.tolerance_mm * (1.0 + 1e-9) => {
                Err(DialectError::ToleranceWide { found_um: 1e3 * mm, limit_um })
            }
            _ => {
                let steps = exactness.tolerance_mm / step_mm;
                if says && ((steps - steps.round()).abs() > 1e-6 || steps < 0.5) {
                    let (decimals, step_um) = (self.numbers.decimals, 1e3 * step_mm);
                    return Err(DialectError::ToleranceFine { dialect, found_um: limit_um, decimals, step_um });
                }
                Ok(())
            }
        }
    }

    /// Returns the program number for a cycle: the first number of the range for cycle 1, and so on. Returns `None` if
    /// programs of this dialect have no numbers.
    ///
    /// # Errors
    /// A cycle for which the range of numbers is too short.
    pub fn number(&self, cycle: u16) -> Result<Option<u32>, DialectError> {
        let Some([least, most]) = self.program.numbers else { return Ok(None) };
        let number = least.saturating_add(u32::from(cycle.max(1)) - 1);
        if number > most {
            return Err(DialectError::Number { dialect: self.dialect.name.clone(), least, most, cycle });
        }
        Ok(Some(number))
    }

    /// Returns the program name for a part and a cycle, such as `LENS_C3`. It has only capital letters, digits and `_`,
    /// and begins with a letter. A long name of the part is cut to the length that the control allows.
    pub fn name(&self, part: &str, cycle: u16) -> String {
        let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' };
        let cycle = format!("_C{cycle}");
        let room = self.program.max_name_length.saturating_sub(cycle.len()).max(1);
        let begins_plainly = part.starts_with(|c: char| c.is_ascii_alphabetic());
        let part = if begins_plainly { part.to_owned() } else { format!("P{part}") };
        part.chars().map(plain).take(room).collect::<String>() + &cycle
    }

    /// Returns the faults of the dialect that the JSON schema of its file cannot detect. An example is a limit of the
    /// line length (`text.max_line_length`) that is too small for the block of a move. The list is empty if the dialect
    /// has no such fault.
    pub fn faults(&self) -> Vec<DialectProblem> {
        let mut faults = Vec::new();
        let mut fault = |key: &str, found: String, allowed, remedy| {
            faults.push(DialectProblem { key: key.to_owned(), found, allowed, remedy });
        };
        if let Some(blocks) =
            self.blocks.as_ref().filter(|blocks| blocks.first.saturating_add(blocks.step) > blocks.last)
        {
            let found = format!("is {}, less than `first` plus `step`", blocks.last);
            fault("blocks.last", found, "blocks require different numbers", "raise it");
        }
        if !self.dialect.extension.chars().all(|c| c.is_ascii_alphanumeric()) {
            let found = format!("is {:?}", self.dialect.extension);
            fault("dialect.extension", found, "an extension has only letters and digits", "remove the point");
        }
        let [x, y, z] = &self.words.axes;
        if x == y || y == z || z == x {
            fault("words.axes", format!("are {x}, {y} and {z}"), "each axis has a word of its own", "name three axes");
        }
        if (&self.words.rapid, &self.words.rapid_ends) == (&self.words.line, &String::new()) {
            let found = format!("is {:?}, the same as `line`", self.words.rapid);
            fault("words.rapid", found, "a control must distinguish rapid moves from feeds", "correct one of them");
        }
        if let Some([least, most]) = self.program.numbers.filter(|[least, most]| least > most || *least == 0) {
            fault(
                "program.numbers",
                format!("are {least} to {most}"),
                "the first must be at least 1 and at most the second",
                "correct them",
            );
        }
        if let Some(arcs) = &self.arcs {
            for (key, found, allowed, remedy) in arcs.faults() {
                fault(key, found, allowed, remedy);
            }
        }
        let longest = self.longest_move();
        if longest > self.text.max_line_length {
            let found = format!("is {}, and a move has up to {longest} characters", self.text.max_line_length);
            fault("text.max_line_length", found, "a move is never divided", "raise it, or lower `numbers.max_mm`");
        }
        for (key, line) in self.lines() {
            if let Some((found, allowed, remedy)) = self.fault_of(&key, line) {
                fault(&key, found, allowed, remedy);
            }
        }
        faults
    }

    /// Returns all fixed texts of the dialect (words and lines), each with its key, such as `program.begin[0]`.
    fn lines(&self) -> impl Iterator<Item = (String, &String)> {
        let of = |key: &'static str, lines: &'static str| move |(k, line)| (format!("{key}{lines}[{k}]"), line);
        let frame = &self.program;
        let lists = [("program.begin", &frame.begin), ("program.setup", &frame.setup), ("program.end", &frame.end)];
        let modes = [
            ("path.blend", &self.path.blend),
            ("path.exact_path", &self.path.exact_path),
            ("path.exact_stop", &self.path.exact_stop),
        ];
        let words = [
            ("text.comment_begins", &self.text.comment_begins),
            ("text.comment_ends", &self.text.comment_ends),
            ("words.rapid", &self.words.rapid),
            ("words.rapid_ends", &self.words.rapid_ends),
            ("words.line", &self.words.line),
            ("words.between", &self.words.between),
            ("words.feed", &self.words.feed),
        ];
        let of_modes =
            modes.into_iter().filter_map(|(key, mode)| Some((key, mode.as_ref()?))).flat_map(move |(key, mode)| {
                let begin = mode.begin.iter().enumerate().map(of(key, ".begin"));
                begin.chain(mode.end.iter().enumerate().map(of(key, ".end")))
            });
        let turnings = [("rotary.tool_centre", &self.rotary.tool_centre), ("rotary.slides", &self.rotary.slides)];
        let of_turnings = turnings.into_iter().filter_map(|(key, turning)| Some((key, turning.as_ref()?))).flat_map(
            move |(key, turning)| {
                let begin = turning.begin.iter().enumerate().map(of(key, ".begin"));
                begin.chain(turning.end.iter().enumerate().map(of(key, ".end")))
            },
        );
        let of_lists = lists.into_iter().flat_map(move |(key, lines)| lines.iter().enumerate().map(of(key, "")));
        let of_arcs = self.arcs.iter().flat_map(move |arcs| {
            let lines = arcs.begin.iter().enumerate().map(of("arcs", ".begin"));
            let lines = lines.chain(arcs.end.iter().enumerate().map(of("arcs", ".end")));
            arcs.words().map(|(key, word)| (key.to_owned(), word)).chain(lines)
        });
        words
            .into_iter()
            .map(|(key, word)| (key.to_owned(), word))
            .chain(of_modes)
            .chain(of_turnings)
            .chain(of_lists)
            .chain(of_arcs)
    }

    /// Returns the fault of `line`, the fixed text with the key `key`: what was found, what is allowed, and the remedy.
    /// Returns `None` if it has no fault.
    fn fault_of(&self, key: &str, line: &str) -> Option<(String, &'static str, &'static str)> {
        if !line.chars().all(|c| matches!(c, ' '..='~')) {
            return Some((
                format!("is {line:?}"),
                "only printable ASCII characters on one line are allowed",
                "write each line as its own entry, in plain characters",
            ));
        }
        if line.len() > self.text.max_line_length {
            let found = format!("has {} characters", line.len());
            return Some((found, "it must be at most text.max_line_length", "shorten it"));
        }
        let bare = match key.starts_with("path.blend.begin") {
            true => line.replace(TOLERANCE, ""),
            false if key.starts_with("program.begin") || key.starts_with("program.end") => {
                let numbered = self.program.numbers.is_some();
                let line = line.replace(NAME, "");
                if numbered { line.replace(NUMBER, "") } else { line }
            }
            false => line.to_owned(),
        };
        if bare.contains(['{', '}']) {
            let allowed = "program.begin and program.end may have {name} and, with program.numbers, {number}; \
                           path.blend.begin may have {tolerance_mm}";
            return Some((format!("is {line:?}"), allowed, "remove it"));
        }
        // Only slides that move with a tilting head use a feed by time.
        let allowed = if key.starts_with("rotary.slides.begin") { "G93" } else { "" };
        let is_other = |word: &&str| *word != allowed && OTHER.contains(word);
        let other = line.to_ascii_uppercase().split_whitespace().find(is_other).map(str::to_owned);
        other.map(|word| {
            let allowed = "programs use mm, mm/min and absolute coordinates";
            (format!("has the word {word}"), allowed, "remove it")
        })
    }

    /// Returns the largest number of characters that the block of one move can have.
    fn longest_move(&self) -> usize {
        let words = &self.words;
        let digits = |largest: f64| largest.log10().floor().max(0.0) as usize + 1;
        let coordinate = digits(self.numbers.max_mm) + 2 + usize::from(self.numbers.decimals);
        let axes: usize = words.axes.iter().map(|axis| axis.len() + coordinate + words.between.len()).sum();
        let angle = if self.rotary == Tilting::default() {
            0
        } else {
            1 + words.between.len() + 5 + usize::from(self.numbers.angle_decimals)
        };
        let feed = words.feed.len() + digits(1e6) + 1 + usize::from(self.numbers.feed_decimals);
        let begins = words.rapid.len().max(words.line.len()) + words.rapid_ends.len();
        let arcs = self.arcs.as_ref().map_or(0, |arcs| arcs.longest() + 2 * (coordinate + words.between.len()));
        let number = self.blocks.as_ref().map_or(0, |b| b.letter.len() + digits(f64::from(b.last)) + 1);
        number + begins + axes + angle + feed + arcs
    }
}

impl ArcWords {
    /// Returns the faults of the words for arcs. Each fault has the key, what was found, what is allowed, and the
    /// remedy.
    fn faults(&self) -> impl Iterator<Item = (&'static str, String, &'static str, &'static str)> {
        let missing = || "is missing".to_owned();
        let allowed = "an arc requires its end and its centre";
        let by_words = self.centre != CentreWords::BlockBefore;
        let same = self.clockwise == self.counter_clockwise && self.clockwise_ends == self.counter_clockwise_ends;
        let twice = |words: &[String; 3]| words[0] == words[1] || words[1] == words[2] || words[2] == words[0];
        [
            (by_words && self.centre_words.is_none()).then(|| {
                (
                    "arcs.centre_words",
                    missing(),
                    allowed,
                    "write the words of its centre, such as [\"I\", \"J\", \"K\"]",
                )
            }),
            (!by_words && self.centre_block.is_none()).then(|| {
                (
                    "arcs.centre_block",
                    missing(),
                    allowed,
                    "write the beginning of the block of its centre, such as \"CC \"",
                )
            }),
            self.centre_words.as_ref().filter(|words| twice(words)).map(|words| {
                let found = format!("are {}", words.join(", "));
                ("arcs.centre_words", found, "each axis has a word of its own", "name three words")
            }),
            same.then(|| {
                let found = format!("is {:?}, the same as `clockwise`", self.counter_clockwise);
                (
                    "arcs.counter_clockwise",
                    found,
                    "a control must distinguish the two directions",
                    "correct one of them, or their ends",
                )
            }),
        ]
        .into_iter()
        .flatten()
    }

    /// Returns all fixed words for arcs, each with its key, such as `arcs.clockwise`.
    fn words(&self) -> impl Iterator<Item = (&'static str, &String)> {
        [
            ("arcs.clockwise", &self.clockwise),
            ("arcs.clockwise_ends", &self.clockwise_ends),
            ("arcs.counter_clockwise", &self.counter_clockwise),
            ("arcs.counter_clockwise_ends", &self.counter_clockwise_ends),
        ]
        .into_iter()
        .chain(self.planes.iter().flatten().map(|word| ("arcs.planes", word)))
        .chain(self.centre_words.iter().flatten().map(|word| ("arcs.centre_words", word)))
        .chain(self.centre_block.iter().map(|word| ("arcs.centre_block", word)))
    }

    /// Returns the largest number of characters that an arc adds to the block of a straight move, without the
    /// coordinates of its centre.
    fn longest(&self) -> usize {
        let longest = |words: &Option<[String; 3]>| words.iter().flatten().map(String::len).max().unwrap_or(0);
        self.clockwise.len().max(self.counter_clockwise.len())
            + self.clockwise_ends.len().max(self.counter_clockwise_ends.len())
            + longest(&self.planes)
            + 2 * longest(&self.centre_words)
            + 2
    }
}

/// Placeholders in the lines of a dialect.
pub(super) const NAME: &str = "{name}";
pub(super) const NUMBER: &str = "{number}";
pub(super) const TOLERANCE: &str = "{tolerance_mm}";
/// Words that are rejected in the lines of a dialect: for inches, for incremental positions, and for feeds by time or
/// by revolution.
const OTHER: [&str; 9] = ["G20", "G70", "G700", "G91", "G93", "G95", "G96", "G961", "INCH"];

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Reads the dialect `name` from the dialects that are delivered with Regrind (`config/dialects`). Panics if the
    /// file is missing or not valid.
    pub(in super::super) fn shipped(name: &str) -> Dialect {
        let file = format!("{}/../../config/dialects/{name}.toml", env!("CARGO_MANIFEST_DIR"));
        toml::from_str(&std::fs::read_to_string(file).unwrap()).unwrap()
    }

    fn exactly(mode: PathMode, tolerance_um: f64, controller_um: Option<f64>, chord_um: f64) -> Exactness {
        let controller_mm = controller_um.map(|um| 1e-3 * um);
        let (tolerance_mm, chord_error_mm) = (1e-3 * tolerance_um, 1e-3 * chord_um);
        Exactness { mode, tolerance_mm, controller_mm, chord_error_mm, arcs_within_mm: None }
    }

    #[test]
    fn shipped_dialects_have_no_faults() {
        for name in ["linuxcnc", "fanuc", "sinumerik", "heidenhain"] {
            let dialect = shipped(name);
            assert_eq!((dialect.dialect.name.as_str(), dialect.faults()), (name, Vec::new()));
        }
    }

    #[test]
    fn dialect_faults_name_keys() {
        let keys = |change: &dyn Fn(&mut Dialect)| {
            let mut dialect = shipped("fanuc");
            change(&mut dialect);
            dialect.faults().into_iter().map(|fault| fault.key).collect::<Vec<_>>()
        };
        assert_eq!(keys(&|d| d.program.setup.push("G20 G90".into())), ["program.setup[2]"]);
        assert_eq!(keys(&|d| d.program.setup.push("G54 {name}".into())), ["program.setup[2]"]);
        assert_eq!(keys(&|d| d.program.begin.push("{tolerance_mm}".into())), ["program.begin[2]"]);
        assert_eq!(keys(&|d| d.program.numbers = None), ["program.begin[1]"]);
        assert_eq!(keys(&|d| d.program.numbers = Some([8, 7])), ["program.numbers"]);
        assert_eq!(keys(&|d| d.words.rapid = d.words.line.clone()), ["words.rapid"]);
        assert_eq!(keys(&|d| d.words.axes[1] = "X".into()), ["words.axes"]);
        assert_eq!(keys(&|d| d.text.max_line_length = 40), ["text.max_line_length"]);
        assert_eq!(keys(&|d| d.dialect.extension = ".nc".into()), ["dialect.extension"]);
        assert_eq!(keys(&|d| d.path.blend.as_mut().unwrap().begin.push("G5\n".into())), ["path.blend.begin[1]"]);
        let slides = |d: &mut Dialect, line: &str| d.rotary.slides.as_mut().unwrap().begin.push(line.into());
        assert_eq!(keys(&|d| slides(d, "G93")), Vec::<String>::new());
        assert_eq!(keys(&|d| slides(d, "G91")), ["rotary.slides.begin[1]"]);
        assert_eq!(
            keys(&|d| d.rotary.tool_centre.as_mut().unwrap().begin.push("G93".into())),
            ["rotary.tool_centre.begin[1]"]
        );
        assert_eq!(keys(&|d| d.blocks = Some(Blocks { last: 15, ..Blocks::default() })), ["blocks.last"]);
    }

    #[test]
    fn post_refuses_unsupported_modes() {
        let [linuxcnc, fanuc, heidenhain] = ["linuxcnc", "fanuc", "heidenhain"].map(shipped);
        let blend = PathMode::Blend;
        assert_eq!(linuxcnc.post(&exactly(blend, 0.1, None, 0.1)).unwrap().mode[0], ["G64 P0.0001 Q0"]);
        assert!(matches!(fanuc.post(&exactly(blend, 0.1, None, 0.1)), Err(DialectError::ToleranceUnknown { .. })));
        assert!(matches!(fanuc.post(&exactly(blend, 0.1, Some(1.0), 0.1)), Err(DialectError::ToleranceWide { .. })));
        assert!(fanuc.post(&exactly(blend, 1.0, Some(1.0), 0.1)).is_ok());
        assert!(matches!(
            fanuc.post(&exactly(PathMode::ExactPath, 0.1, None, 0.1)),
            Err(DialectError::Mode { mode: "exact-path", .. })
        ));
        assert!(fanuc.post(&exactly(PathMode::ExactStop, 0.1, None, 0.1)).is_ok());
        let fine = heidenhain.post(&exactly(blend, 0.25, None, 0.1));
        assert!(matches!(fine, Err(DialectError::ToleranceFine { step_um, .. }) if (step_um - 0.1).abs() < 1e-12));
        let coarse = heidenhain.post(&exactly(blend, 0.1, None, 0.05));
        assert!(matches!(coarse, Err(DialectError::Rounding { decimals: 4, .. })));
    }

    #[test]
    fn post_refuses_arcs_out_of_range() {
        let within = |dialect: &Dialect, um: f64| {
            let exactness = exactly(PathMode::Blend, 0.1, Some(0.1), 0.1);
            dialect.post(&Exactness { arcs_within_mm: Some(1e-3 * um), ..exactness }).map(|post| post.arcs.unwrap().1)
        };
        let [linuxcnc, heidenhain] = ["linuxcnc", "heidenhain"].map(shipped);
        assert_eq!(within(&linuxcnc, 0.1).unwrap().steps_per_mm, 1e6);
        assert!(within(&linuxcnc, 0.001).is_ok() && within(&heidenhain, 0.09).is_ok());
        assert!(matches!(within(&linuxcnc, 0.0008), Err(DialectError::ArcsFine { decimals: 6, .. })));
        assert!(matches!(within(&heidenhain, 0.08), Err(DialectError::ArcsFine { decimals: 4, .. })));
        assert!(matches!(within(&linuxcnc, 0.11), Err(DialectError::ArcsWide { .. })));
        let plain = Dialect { arcs: None, ..linuxcnc };
        assert!(matches!(within(&plain, 0.1), Err(DialectError::NoArcs { .. })));
        let keys = |name: &str, change: &dyn Fn(&mut ArcWords)| {
            let mut dialect = shipped(name);
            change(dialect.arcs.as_mut().unwrap());
            dialect.faults().into_iter().map(|fault| fault.key).collect::<Vec<_>>()
        };
        assert_eq!(keys("fanuc", &|arcs| arcs.centre_words = None), ["arcs.centre_words"]);
        assert_eq!(keys("fanuc", &|arcs| arcs.centre_words.as_mut().unwrap()[1] = "I".into()), ["arcs.centre_words"]);
        assert_eq!(keys("heidenhain", &|arcs| arcs.centre_block = None), ["arcs.centre_block"]);
        assert_eq!(keys("heidenhain", &|arcs| arcs.clockwise_ends = " DR+".into()), ["arcs.counter_clockwise"]);
        assert_eq!(keys("linuxcnc", &|arcs| arcs.begin.push("G91".into())), ["arcs.begin[1]"]);
    }

    #[test]
    fn program_name_and_number_limits() {
        let fanuc = shipped("fanuc");
        assert_eq!(fanuc.name("free-form mirror", 2), "FREE_FORM_MIR_C2");
        assert_eq!(fanuc.name("7 \u{e9}", 65_535), "P7___C65535");
        assert_eq!(
            [fanuc.number(0), fanuc.number(1), fanuc.number(999)],
            [Ok(Some(7001)), Ok(Some(7001)), Ok(Some(7999))]
        );
        assert!(matches!(fanuc.number(1000), Err(DialectError::Number { cycle: 1000, .. })));
        assert_eq!(shipped("sinumerik").number(1), Ok(None));
    }
}
