//! A program as an interpreter reads it: ahead of the motion, which follows line by line.

use std::collections::VecDeque;

use crate::Vec3;

/// So many motions are read ahead at most.
const AHEAD: usize = 200;
/// Rapid travel.
const RAPID_MM_S: f64 = 100.0;

/// What is carried out in its turn.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Step {
    /// Straight to a place.
    Move { to_mm: Vec3, mm_s: f64, line: u32 },
    /// What is behind it is not read before the motion has come here.
    Wait { line: u32 },
    /// The end.
    End { line: u32 },
}

/// What an interpreter does at once, as it reads it.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Said {
    /// A log file is opened, anew or at its end.
    Open { path: String, anew: bool },
    /// A line goes into it.
    Log(String),
    /// It is closed.
    Close,
}

/// A program that is open.
#[derive(Clone, Debug)]
pub(super) struct Program {
    pub(super) path: String,
    pub(super) text: String,
    lines: Vec<String>,
    /// The line that is read next.
    next: usize,
    /// Where a loop began, and how often it is still to be gone through.
    repeats: Option<(usize, u32)>,
    at_mm: Vec3,
    feeds: bool,
    mm_s: f64,
    /// Nothing is read until this has been carried out.
    waits: bool,
}

impl Program {
    pub(super) fn new(path: &str, text: String) -> Self {
        let lines = text.lines().map(str::to_owned).collect();
        let (next, repeats, waits) = (0, None, false);
        Self { path: path.to_owned(), text, lines, next, repeats, at_mm: [0.0; 3], feeds: false, mm_s: 0.0, waits }
    }

    /// How many lines it has.
    pub(super) fn len(&self) -> usize {
        self.lines.len()
    }

    /// Goes back to the beginning, from a place.
    pub(super) fn rewind(&mut self, at_mm: Vec3) {
        (self.next, self.repeats, self.waits) = (0, None, false);
        (self.at_mm, self.feeds, self.mm_s) = (at_mm, false, 0.0);
    }

    /// What was waited for has been carried out.
    pub(super) fn go_on(&mut self) {
        self.waits = false;
    }

    /// Reads ahead; says what is done at once.
    pub(super) fn read_on(&mut self, steps: &mut VecDeque<Step>) -> Vec<Said> {
        let mut said = Vec::new();
        while !self.waits && steps.len() < AHEAD && self.next < self.lines.len() {
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
        let (mut to_mm, mut moves) = (self.at_mm, false);
        for (letter, value) in words(text) {
            match (letter, value) {
                ('G', 0.0) => self.feeds = false,
                ('G', 1.0) => self.feeds = true,
                ('F', feed) => self.mm_s = feed / 60.0,
                ('X' | 'Y' | 'Z', mm) => {
                    to_mm[letter as usize - 'X' as usize] = mm;
                    moves = true;
                }
                ('M', 66.0) => {
                    steps.push_back(Step::Wait { line });
                    self.waits = true;
                }
                ('M', 2.0 | 30.0) => {
                    steps.push_back(Step::End { line });
                    self.waits = true;
                }
                _ => {}
            }
        }
        if moves {
            let mm_s = if self.feeds { self.mm_s.max(1e-3) } else { RAPID_MM_S };
            steps.push_back(Step::Move { to_mm, mm_s, line });
            self.at_mm = to_mm;
        }
    }
}

/// What a comment has the interpreter do.
pub(super) fn says(text: &str) -> Option<Said> {
    let comment = text.trim().strip_prefix('(')?.strip_suffix(')')?;
    let (word, rest) = comment.split_once(',').unwrap_or((comment, ""));
    Some(match word {
        "LOGOPEN" => Said::Open { path: rest.to_owned(), anew: true },
        "LOGAPPEND" => Said::Open { path: rest.to_owned(), anew: false },
        "LOG" => Said::Log(rest.to_owned()),
        "LOGCLOSE" => Said::Close,
        _ => return None,
    })
}

/// Letters and the numbers behind them, without comments.
fn words(text: &str) -> Vec<(char, f64)> {
    let code = text.split([';', '(']).next().unwrap_or_default();
    let starts: Vec<usize> = code.char_indices().filter(|(_, c)| c.is_ascii_alphabetic()).map(|(at, _)| at).collect();
    let ends = starts.iter().skip(1).copied().chain([code.len()]);
    let word = |(from, to): (&usize, usize)| {
        let letter = code[*from..].chars().next()?.to_ascii_uppercase();
        Some((letter, code[from + 1..to].trim().parse().ok()?))
    };
    starts.iter().zip(ends).filter_map(word).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_program_says_runs_ahead_of_its_motion_but_for_an_input() {
        let text = "(LOG,a)\nG21 G90\nG64 P0.0001 Q0\nG0 Z5\nG1 X1.5Y-2Z0.25F600\n(LOG,b)\nM66 P0 L0\n(LOG,c)\nM2\n";
        let (mut program, mut steps) = (Program::new("p", text.to_owned()), VecDeque::new());
        let log = |word: &str| Said::Log(word.to_owned());
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
    fn a_loop_is_gone_through_as_often_as_it_says() {
        let text = "o<regrind> repeat [3]\nG1 X1 F60\no<regrind> endrepeat\nM2\n";
        let (mut program, mut steps) = (Program::new("p", text.to_owned()), VecDeque::new());
        program.read_on(&mut steps);
        assert_eq!(steps.len(), 4);
    }
}
