//! A measuring machine that prints its hits: it leads its probe over a list of targets, and says each touch in a line. It hears nothing.
//!
//! ```text
//!  list     what is to be touched, by a reader of its own
//!  print    how a touch is written, in eight formats
//!  faults   what goes wrong with which line
//! ```
//!
//! No wire is in here; `wire/hits` has one.

pub mod faults;
pub mod list;
pub mod print;

use std::time::Duration;

use crate::cmm::{Led, Touch};
use crate::payload::Feature;
use faults::{Fault, Faults};
use list::List;
use print::Style;

/// How this machine measures and writes.
#[derive(Clone, Debug)]
pub struct Options {
    /// How a touch is written.
    pub style: Style,
    /// The probe's radius.
    pub radius_mm: f64,
    /// Contacts are written, and not centres.
    pub contacts: bool,
    /// How far before the point it begins to search, and how far beyond it ends.
    pub search_mm: [f64; 2],
}

/// What goes out for a touch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// The bytes; nothing where the probe missed.
    pub bytes: Vec<u8>,
    /// The connection ends behind them.
    pub hangs_up: bool,
}

/// A part program, between its list and its printer.
pub struct Program {
    probe: Led,
    options: Options,
    faults: Faults,
    list: Option<List>,
    next: usize,
    printed: u64,
}

impl Program {
    /// A program before a machine; it has no list yet.
    pub fn new(probe: Led, options: Options, faults: Faults) -> Self {
        Self { probe, options, faults, list: None, next: 0, printed: 0 }
    }

    /// Begins anew with a list, unless it is the one that it has.
    pub fn begin(&mut self, text: &str) {
        let list = List::read(text);
        if list.is_some() && list != self.list {
            (self.list, self.next) = (list, 0);
        }
    }

    /// How long a touch takes.
    pub fn per_touch(&self) -> Duration {
        Duration::from_secs_f64(self.probe.seconds_per_point())
    }

    /// Touches the next target; nothing where none is left. Behind the last one the probe goes clear of the part.
    pub fn touch_next(&mut self) -> Option<Outgoing> {
        let target = *self.list.as_ref()?.targets.get(self.next)?;
        self.next += 1;
        let out = self.touch(&target);
        if self.next == self.list.as_ref().map_or(0, |list| list.targets.len()) {
            self.probe.let_go();
        }
        Some(out)
    }

    fn touch(&mut self, target: &list::Target) -> Outgoing {
        let Options { radius_mm, search_mm: [before, beyond], .. } = self.options;
        let touched = self.probe.touch(target.point_mm, target.normal, [radius_mm, before, beyond]);
        let Touch::Centre(centre_mm) = touched else { return Outgoing { bytes: Vec::new(), hangs_up: false } };
        let is_part = target.feature == Feature::Part;
        let back_mm = if self.options.contacts && is_part { radius_mm } else { 0.0 };
        let at_mm = std::array::from_fn(|k| centre_mm[k] - back_mm * target.normal[k]);
        self.printed += 1;
        let line = self.options.style.line(at_mm);
        match self.faults.at(|number| *number == self.printed) {
            Some(Fault::HangUp) => Outgoing { bytes: line, hangs_up: true },
            Some(fault) => Outgoing { bytes: fault.spoil(line), hangs_up: false },
            None => Outgoing { bytes: line, hangs_up: false },
        }
    }
}
