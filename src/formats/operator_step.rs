//! Step that a machine asks of a person: what to do, what to check, and how to confirm it. The status of a cell
//! contains it, so that the terminal and the page show it in their own words.

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Step that a machine asks of a person.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OperatorStep {
    /// Action of the person.
    #[serde(flatten)]
    pub action: OperatorAction,
    /// Confirmation that ends the step. `None` if the machine itself reports the end, or if the person can only resume
    /// the run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub confirmation: Option<StepConfirmation>,
    /// First digits of the identity of the map that the confirmation must name, if it must name one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub named_map: Option<String>,
}

/// Action of a person at a machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "action", rename_all = "snake_case")]
pub enum OperatorAction {
    /// Measure the part.
    Measure {
        /// Name of the part.
        part: String,
        /// Cycle, with its batch if the measurement is taken batch by batch.
        cycle: String,
        /// Required points.
        points: RequiredPoints,
        /// First digits of the identity of the plan, if a person compares them.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        plan: Option<String>,
        /// Radius of the probe in mm; `None` if the plan states it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        probe_radius_mm: Option<f64>,
    },
    /// Move the probe clear of the part: every target is touched.
    MoveProbeClear,
    /// Check the part and the machine, and begin a pass.
    BeginPass {
        /// Name of the part.
        part: String,
        /// Cycle.
        cycle: u32,
        /// Program, or map for a program that the shop writes. `None` if the shop has its own program.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        program: Option<PathBuf>,
        /// First digits of the identity of the map.
        map: String,
        /// Radius of the wheel, in mm.
        wheel_radius_mm: f64,
        /// Feed, in mm/min.
        feed_mm_min: f64,
        /// Number of passes without in-feed at the end.
        spark_out_passes: u16,
    },
    /// Wait for the end of the pass, and see that the wheel is clear of the part.
    EndPass,
    /// Hold the machine at its own panel.
    Hold {
        /// Work that remains, in words.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        remaining: Option<String>,
    },
    /// Stop the machine at its own panel.
    Stop {
        /// Work that remains, in words.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        remaining: Option<String>,
    },
    /// Stop the machine at its own panel now: no program can stop it.
    Abort,
}

/// Points that a measurement requires.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RequiredPoints {
    /// Any points, at least this number.
    AtLeast(usize),
    /// A point for each target of a list.
    Listed {
        /// Number of targets.
        count: usize,
        /// File with the targets.
        file: PathBuf,
    },
}

/// Confirmation that ends a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StepConfirmation {
    /// The machine has begun its job.
    Started,
    /// The machine has ended its job and is clear of the part.
    Done,
    /// The same, with the file of the measurement.
    DoneWithFile,
    /// The machine is at rest.
    Still,
}

impl OperatorStep {
    /// Returns the step as lines of text for a terminal: what to do, what to check, and the command that confirms it.
    /// `machine` is the name of the machine in commands, such as `cmm`. `run` is the folder of the run as an argument of
    /// the command, with a blank before it, or empty.
    pub fn lines(&self, machine: &str, run: &str) -> Vec<String> {
        let mut lines = Vec::new();
        // A step that only waits for its end begins with that.
        if !matches!(self.action, OperatorAction::EndPass) {
            lines.push(self.action.to_string());
        }
        lines.extend(self.action.checks().map(|checks| format!("check: {checks}")));
        if let Some(confirmation) = self.confirmation {
            lines.extend(self.action.before_confirmation().map(str::to_owned));
            let map = self.named_map.as_ref().map_or_else(String::new, |map| format!(" --map {map}"));
            lines.push(format!("then: regrind confirm {}{map}{run}", confirmation.arguments(machine)));
        }
        lines
    }
}

impl OperatorAction {
    /// Returns what a person checks before the action.
    fn checks(&self) -> Option<String> {
        match self {
            Self::Measure { probe_radius_mm, .. } => {
                let radius = probe_radius_mm.map_or("as in the plan".to_owned(), |radius| format!("{radius} mm"));
                Some(format!("right part, clean, clamped; wheel clear of the part; probe radius {radius}"))
            }
            Self::BeginPass { wheel_radius_mm, feed_mm_min, spark_out_passes, .. } => Some(format!(
                "right part, clamped; probe clear of the part; wheel radius {wheel_radius_mm} mm, feed {feed_mm_min} \
                 mm/min, {spark_out_passes} spark-out passes"
            )),
            _ => None,
        }
    }

    /// Returns what must be so before a person confirms.
    fn before_confirmation(&self) -> Option<&'static str> {
        match self {
            Self::Measure { .. } => Some("when the part is measured and the probe is clear of the part,"),
            Self::BeginPass { .. } => Some("begin the pass,"),
            Self::EndPass => Some("when the pass has ended and the wheel is clear of the part,"),
            _ => None,
        }
    }
}

impl Display for OperatorAction {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let at_panel = |f: &mut Formatter<'_>, what: &str, remaining: &Option<String>| {
            write!(f, "{what} the machine at its own panel")?;
            remaining.iter().try_for_each(|remaining| write!(f, "; {remaining}"))
        };
        match self {
            Self::Measure { part, cycle, points, plan, .. } => {
                write!(f, "MEASURE {part}, cycle {cycle}: {points}")?;
                plan.iter().try_for_each(|plan| write!(f, " (plan {plan})"))
            }
            Self::MoveProbeClear => f.write_str("every target is touched; when the probe is clear of the part,"),
            Self::BeginPass { part, cycle, program, map, .. } => {
                let by = program.as_ref().map_or("your own program".to_owned(), |file| file.display().to_string());
                write!(f, "GRIND {part}, cycle {cycle}: with {by} (map {map})")
            }
            Self::EndPass => f.write_str("the pass runs; wait for its end"),
            Self::Hold { remaining } => at_panel(f, "HOLD", remaining),
            Self::Stop { remaining } => at_panel(f, "STOP", remaining),
            Self::Abort => f.write_str("ABORT: stop the machine at its own panel NOW; Regrind cannot stop the machine"),
        }
    }
}

impl Display for RequiredPoints {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::AtLeast(least) => write!(f, "at least {least} points"),
            Self::Listed { count, file } => write!(f, "the {count} points of {}", file.display()),
        }
    }
}

impl StepConfirmation {
    /// Returns the arguments of `regrind confirm`.
    fn arguments(self, machine: &str) -> String {
        match self {
            Self::Started => "started".to_owned(),
            Self::Done => "done".to_owned(),
            Self::DoneWithFile => "done --file RESULT".to_owned(),
            Self::Still => format!("still --machine {machine}"),
        }
    }
}

/// Returns the run folder `run` as an argument of a command, with a blank before it. Returns an empty text if the folder
/// is directly in `runs`, because then a command finds the newest run without the argument.
pub fn run_argument(run: &Path) -> String {
    if run.parent() == Some(Path::new("runs")) { String::new() } else { format!(" {}", run.display()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn begin_pass() -> OperatorStep {
        let action = OperatorAction::BeginPass {
            part: "mirror".into(),
            cycle: 2,
            program: None,
            map: "3fa9c210".into(),
            wheel_radius_mm: 20.0,
            feed_mm_min: 3000.0,
            spark_out_passes: 1,
        };
        OperatorStep { action, confirmation: Some(StepConfirmation::Started), named_map: None }
    }

    #[test]
    fn step_lines_end_with_command() {
        let lines = begin_pass().lines("grinder", " runs/x");
        assert_eq!(lines.len(), 4);
        assert!(lines[0].contains("mirror, cycle 2") && lines[0].contains("3fa9c210"), "{lines:?}");
        assert!(lines[1].starts_with("check: ") && lines[1].contains("20 mm"), "{lines:?}");
        assert_eq!(lines[3], "then: regrind confirm started runs/x");
        let named = OperatorStep { named_map: Some("3fa9c210".into()), ..begin_pass() };
        assert_eq!(named.lines("grinder", "")[3], "then: regrind confirm started --map 3fa9c210");
        let hold = OperatorStep {
            action: OperatorAction::Hold { remaining: Some("3 targets remain".into()) },
            confirmation: Some(StepConfirmation::Still),
            named_map: None,
        };
        let lines = hold.lines("cmm", "");
        assert!(lines[0].ends_with("; 3 targets remain"), "{lines:?}");
        assert_eq!(lines[1..], ["then: regrind confirm still --machine cmm"]);
    }

    #[test]
    fn step_without_confirmation_asks_for_no_command() {
        let lines = OperatorStep { confirmation: None, ..begin_pass() }.lines("grinder", "");
        assert!(lines.iter().all(|line| !line.contains("regrind confirm")), "{lines:?}");
    }

    #[test]
    fn run_argument_only_outside_runs() {
        assert_eq!(run_argument(Path::new("runs/a")), "");
        assert_eq!(run_argument(Path::new("shop/runs/a")), " shop/runs/a");
    }

    #[test]
    fn step_serializes_and_parses() {
        let abort = OperatorStep { action: OperatorAction::Abort, confirmation: None, named_map: None };
        let text = serde_json::to_string(&abort).unwrap();
        assert_eq!(text, r#"{"action":"abort"}"#);
        for step in [abort, begin_pass()] {
            let text = serde_json::to_string(&step).unwrap();
            assert_eq!(serde_json::from_str::<OperatorStep>(&text).unwrap(), step, "{text}");
        }
    }
}
