//! Measuring machine that prints its hits: it moves its probe along a list of targets, and prints a line for each
//! touch. It receives nothing.
//!
//! ```text
//!  list     list of targets, implemented independently
//!  print    format of a touch, eight of them
//!  faults   faults, by line
//!  simulator  the machine of a simulated cell
//! ```
//!
//! This module contains no wire; `wire/hits` has one.

pub mod faults;
pub mod list;
pub mod print;
pub(crate) mod simulator;

use std::time::Duration;

use crate::cmm::{TouchProbe, TouchResult};
use crate::payload::{Feature, Target};
use faults::{Fault, PrintFaults};
use list::List;
use print::Style;

/// Options of measuring and printing.
#[derive(Clone, Debug)]
pub struct Options {
    /// Format of the line of a touch.
    pub style: Style,
    /// Radius of the probe, in mm.
    pub radius_mm: f64,
    /// True if contact points are printed instead of centres.
    pub contacts: bool,
    /// Distances before and beyond the target at which the search begins and ends, in mm.
    pub search_mm: [f64; 2],
}

/// Output of one touch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// Bytes to send; empty if the probe missed.
    pub bytes: Vec<u8>,
    /// True if the connection ends after the bytes.
    pub hangs_up: bool,
}

/// Part program with its probe, list and printer.
pub struct PartProgram {
    probe: TouchProbe,
    options: Options,
    faults: PrintFaults,
    list: Option<List>,
    next: usize,
    printed: u64,
}

impl PartProgram {
    /// Creates a simulated part program: the program of a CMM that measures targets and prints one line for each touch.
    /// `options` sets the probe radius and the format of the lines. `faults` contains the faults of certain lines. The
    /// program has no list of targets yet.
    pub fn new(probe: TouchProbe, options: Options, faults: PrintFaults) -> Self {
        Self { probe, options, faults, list: None, next: 0, printed: 0 }
    }

    /// Replaces the list of targets by the list in `text` (a `plan.csv`), and starts with its first target. Does
    /// nothing if `text` is not a valid list, or if it equals the present list.
    pub fn begin(&mut self, text: &str) {
        let list = List::read(text);
        if list.is_some() && list != self.list {
            (self.list, self.next) = (list, 0);
        }
    }

    /// Returns the duration of one touch, in simulated time.
    pub fn per_touch(&self) -> Duration {
        Duration::from_secs_f64(self.probe.seconds_per_point())
    }

    /// Touches the next target of the list, and returns the output of this touch. Returns `None` if no target is left.
    /// After the last target, the probe moves clear of the part.
    pub fn touch_next(&mut self) -> Option<Outgoing> {
        let target = *self.list.as_ref()?.targets.get(self.next)?;
        self.next += 1;
        let out = self.touch(&target);
        if self.next == self.list.as_ref().map_or(0, |list| list.targets.len()) {
            self.probe.release_part();
        }
        Some(out)
    }

    fn touch(&mut self, target: &Target) -> Outgoing {
        let Options { radius_mm, search_mm: [before, beyond], .. } = self.options;
        let touched = self.probe.touch(target.point_mm, target.normal, [radius_mm, before, beyond]);
        let TouchResult::Centre(centre_mm) = touched else { return Outgoing { bytes: Vec::new(), hangs_up: false } };
        let is_part = target.feature == Feature::Part;
        let back_mm = if self.options.contacts && is_part { radius_mm } else { 0.0 };
        let at_mm = std::array::from_fn(|k| centre_mm[k] - back_mm * target.normal[k]);
        self.printed += 1;
        let line = self.options.style.line(at_mm);
        match self.faults.next_at(|number| *number == self.printed) {
            Some(Fault::HangUp) => Outgoing { bytes: line, hangs_up: true },
            Some(fault) => Outgoing { bytes: fault.spoil(line), hangs_up: false },
            None => Outgoing { bytes: line, hangs_up: false },
        }
    }
}
