//! Settings of a machine that prints hits in a cell file, and the machine created from them.

use std::path::PathBuf;
use std::time::Duration;

use regrind_formats::result::Coordinates;

use super::job::LineRules;
use super::link::{HitSource, LinkTimeouts};
use super::protocol::LineParser;
use super::target_list::{Repeated, TouchRules};

/// Settings for a machine that prints hits.
#[derive(Clone, Debug)]
pub struct HitLinesSettings {
    /// Name of the part in prompts.
    pub part: String,
    /// Folder of the run.
    pub run_folder: PathBuf,
    /// Folder in which a part program reads the list.
    pub plan_folder: Option<PathBuf>,
    /// Source of the lines.
    pub source: HitSource,
    /// Parameters of the parsing of lines.
    pub parser: LineParser,
    /// Meaning of the coordinates: centres of the probe, or contacts.
    pub coordinates: Coordinates,
    /// Required angle of the rotary table and its tolerance, in degrees.
    pub rotary_deg: [f64; 2],
    /// Maximum distance of a point from its target, in mm.
    pub limit_mm: f64,
    /// Time within which an identical line is the same touch.
    pub duplicate_window: Duration,
    /// Handling of a second touch of a target.
    pub repeated: Repeated,
    /// Timeout of the rest of a line.
    pub line_timeout: Duration,
    /// Beginnings of lines that are ignored.
    pub ignored_prefixes: Vec<String>,
    /// Time after the last point at which the probe is clear of the part; `None` if a person confirms it.
    pub clear_after: Option<Duration>,
    /// Minimum number of points, if any points are accepted.
    pub min_free_points: Option<usize>,
    /// Timeout of the connection.
    pub connect_timeout: Duration,
    /// Duration of silence after which reception begins. Data received before were sent before the connection was used,
    /// and are discarded.
    pub silence: Duration,
    /// True if the cell is a simulation.
    pub simulated: bool,
}

impl HitLinesSettings {
    pub(super) fn line_rules(&self) -> LineRules {
        let passed_over = self.ignored_prefixes.clone();
        LineRules { parser: self.parser, rotary_deg: self.rotary_deg, ignored_prefixes: passed_over }
    }

    pub(super) fn touch_rules(&self) -> TouchRules {
        let Self { limit_mm, duplicate_window: double_within, repeated, .. } = *self;
        TouchRules { limit_mm, duplicate_window: double_within, repeated }
    }

    pub(super) fn timeouts(&self) -> LinkTimeouts {
        LinkTimeouts { connect: self.connect_timeout, silence: self.silence, rest: self.line_timeout }
    }
}
