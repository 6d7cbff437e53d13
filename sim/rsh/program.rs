//! Program as the interpreter reads it: ahead of the motion, which follows line by line.

use std::collections::VecDeque;

use crate::Vec3;
use crate::program::LineReader;

/// Maximum number of motions that are read ahead.
const MAX_QUEUED_STEPS: usize = 200;
/// Speed of rapid travel, in mm/s.
const RAPID_MM_S: f64 = 100.0;
/// Maximum distance of the chords of an arc from the arc, in mm.
const CHORDS_MM: f64 = 1e-5;
/// Line that makes the interpreter wait for all earlier motion, because it asks for an input.
const INPUT_WAIT: &str = "M66";

/// Queued step, carried out in its turn.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Step {
    /// Straight move to a position.
    Move { to_mm: Vec3, mm_s: f64, line: u32 },
    /// Line that cannot be executed.
    Refused { reason: String, line: u32 },
    /// Barrier: the lines after it are read only when the motion has reached it.
    Wait { line: u32 },
    /// End of the program.
    End { line: u32 },
}

/// Action that the interpreter carries out at once, when it reads it.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum LogAction {
    /// Opens a log file, empty or at its end.
    Open { path: String, truncate: bool },
    /// Writes a line to the log file.
    Log(String),
    /// Closes the log file.
    Close,
}

/// Open program.
#[derive(Clone)]
pub(super) struct Program {
    pub(super) path: String,
    pub(super) text: String,
    lines: Vec<String>,
    /// Index of the line that is read next.
    next: usize,
    /// Index of the line at which a loop began, and the number of repetitions left.
    repeats: Option<(usize, u32)>,
    reader: LineReader,
    /// True if nothing is read until the queued steps have been carried out.
    waits: bool,
}

impl Program {
    pub(super) fn new(path: &str, text: String) -> Self {
        let lines = text.lines().map(str::to_owned).collect();
        let reader = LineReader::new([0.0; 3]);
        Self { path: path.to_owned(), text, lines, next: 0, repeats: None, reader, waits: false }
    }

    /// Returns the number of lines of the program.
    pub(super) fn len(&self) -> usize {
        self.lines.len()
    }

    /// Goes back to the first line of the program and resets the modes (motion, plane, arc centres, feed) to those of a
    /// new program. `at_mm` is the position from which the first move starts, in mm.
    pub(super) fn rewind(&mut self, at_mm: Vec3) {
        (self.next, self.repeats, self.waits) = (0, None, false);
        self.reader = LineReader::new(at_mm);
    }

    /// Allows [`Self::read_on`] to read further lines. [`Self::read_on`] stops at a line that waits for the motion
    /// (M66). The caller calls this function when the machine has carried out all steps before that line.
    pub(super) fn go_on(&mut self) {
        self.waits = false;
    }

    /// Reads lines ahead of the motion and appends their steps to `steps`. Stops when the queue `steps` is full (200
    /// steps or more), when the program ends, or at a line that waits for the motion. Returns the actions on the log
    /// file that these lines request, in order. The caller must carry out these actions at once, before the steps.
    pub(super) fn read_on(&mut self, steps: &mut VecDeque<Step>) -> Vec<LogAction> {
        let mut said = Vec::new();
        while !self.waits && steps.len() < MAX_QUEUED_STEPS && self.next < self.lines.len() {
            let text = self.lines[self.next].clone();
            self.next += 1;
            let line = self.next as u32;
            if let Some(one) = says(&text) {
                said.push(one);
            } else if text.starts_with("o<") {
                self.repeat(&text);
            } else {
                self.code(&text, line, steps);
            }
        }
        said
    }

    fn repeat(&mut self, text: &str) {
        if let Some(count) = text.split_once("repeat [").and_then(|(_, rest)| rest.trim_end_matches(']').parse().ok()) {
            self.repeats = Some((self.next, count));
        } else if let Some((begin, left)) = self.repeats
            && text.ends_with("endrepeat")
        {
            self.repeats = (left > 1).then_some((begin, left - 1));
            if left > 1 {
                self.next = begin;
            }
        }
    }

    fn code(&mut self, text: &str, line: u32, steps: &mut VecDeque<Step>) {
        if text.starts_with(INPUT_WAIT) {
            steps.push_back(Step::Wait { line });
            self.waits = true;
            return;
        }
        match self.reader.read(text) {
            Ok(Some((from_mm, waypoint))) => {
                let mm_s = waypoint.feed_mm_min.map_or(RAPID_MM_S, |feed| (feed / 60.0).max(1e-3));
                let chords = waypoint.in_chords(from_mm, CHORDS_MM);
                steps.extend(chords.into_iter().map(|to_mm| Step::Move { to_mm, mm_s, line }));
            }
            Ok(None) => {}
            Err(reason) => steps.push_back(Step::Refused { reason, line }),
        }
        if self.reader.has_ended() {
            steps.push_back(Step::End { line });
            self.waits = true;
        }
    }
}

/// Returns the action on the log file that the program line `text` requests. A line requests an action only if it is
/// one of the comments `(LOGOPEN,path)`, `(LOGAPPEND,path)`, `(LOG,text)` and `(LOGCLOSE)`. Returns `None` for any
/// other line.
pub(super) fn says(text: &str) -> Option<LogAction> {
    let comment = text.trim().strip_prefix('(')?.strip_suffix(')')?;
    let (word, rest) = comment.split_once(',').unwrap_or((comment, ""));
    Some(match word {
        "LOGOPEN" => LogAction::Open { path: rest.to_owned(), truncate: true },
        "LOGAPPEND" => LogAction::Open { path: rest.to_owned(), truncate: false },
        "LOG" => LogAction::Log(rest.to_owned()),
        "LOGCLOSE" => LogAction::Close,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_precedes_motion_until_input_wait() {
        let text =
            "(LOG,a)\nG21 G90 G94\nG64 P0.0001 Q0\nG0 Z5\nG1 X1.5Y-2Z0.25F600\n(LOG,b)\nM66 P0 L0\n(LOG,c)\nM2\n";
        let (mut program, mut steps) = (Program::new("p", text.to_owned()), VecDeque::new());
        let log = |word: &str| LogAction::Log(word.to_owned());
        assert_eq!(program.read_on(&mut steps), [log("a"), log("b")]);
        let moves = [
            Step::Move { to_mm: [0.0, 0.0, 5.0], mm_s: RAPID_MM_S, line: 4 },
            Step::Move { to_mm: [1.5, -2.0, 0.25], mm_s: 10.0, line: 5 },
            Step::Wait { line: 7 },
        ];
        assert_eq!(steps, moves);
        assert!(program.read_on(&mut steps).is_empty());
        (steps, program.waits) = (VecDeque::new(), false);
        assert_eq!(program.read_on(&mut steps), [log("c")]);
        assert_eq!(steps, [Step::End { line: 9 }]);
    }

    #[test]
    fn rsh_arc_stays_in_plane_or_refused() {
        let text = "G21 G90 G94 G61 G91.1\nG0 X3Y1Z9\nG18 G3 X3Z5I0K-2F600\nG90.1 G2 X3Z9I3K7\nG91.1 X4Z5I0K-2\nM2\n";
        let (mut program, mut steps) = (Program::new("p", text.to_owned()), VecDeque::new());
        let mut ahead = VecDeque::new();
        // It continues to read when the steps it has read are carried out.
        while steps.back() != Some(&Step::End { line: 6 }) {
            program.read_on(&mut ahead);
            steps.append(&mut ahead);
        }
        let along = |of: u32| -> Vec<Vec3> {
            let ends = |step: &Step| match step {
                Step::Move { to_mm, line, .. } if *line == of => Some(*to_mm),
                _ => None,
            };
            steps.iter().filter_map(ends).collect()
        };
        for (line, ends) in [(3, [3.0, 1.0, 5.0]), (4, [3.0, 1.0, 9.0])] {
            let arc = along(line);
            assert_eq!(arc.last(), Some(&ends));
            // One way by the larger x, and the other way round back.
            assert!(
                arc.iter().all(|[x, y, z]| *x >= 3.0 && *y == 1.0 && ((x - 3.0).hypot(z - 7.0) - 2.0).abs() < 1e-12)
            );
            assert!(arc.iter().any(|[x, _, _]| *x > 4.99) && arc.len() > 100, "{}", arc.len());
        }
        assert!(matches!(steps.iter().rev().nth(1), Some(Step::Refused { line: 5, .. })));
    }

    #[test]
    fn rsh_repeat_loop_expands() {
        let text = "G21 G90 G94 G61\no<regrind> repeat [3]\nG1 X1 F60\no<regrind> endrepeat\nM2\n";
        let (mut program, mut steps) = (Program::new("p", text.to_owned()), VecDeque::new());
        program.read_on(&mut steps);
        assert_eq!(steps.len(), 4);
    }
}
