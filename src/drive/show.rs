//! Notices about a run for whoever shows it.

use std::time::Duration;

use super::Drive;
use super::notice::Notice;
use crate::cell::{Device, Event};

impl Drive {
    /// Notifies people of `event`, and updates the progress of the job and the preview of the points. Must be called
    /// after the cell has handled the event. `now` is the time since the run began.
    pub(super) fn show_event(&mut self, now: Duration, event: &Event) {
        self.display.progress_estimator.update_state(self.cell.state());
        if self.display.progress_estimator.progress().is_none_or(|progress| progress.device != Device::Cmm) {
            self.display.preview_statistics.reset();
        }
        let notice = match event {
            Event::Progressed { device, done, total } => {
                let cycle = self.cell.cycle();
                self.display.progress_estimator.record_progress(now, (*device, cycle), *done, *total);
                self.display.progress_estimator.update_state(self.cell.state());
                let remaining_s = self.display.progress_estimator.progress().and_then(|progress| progress.remaining_s);
                Notice::Progress { device: *device, cycle, done: *done, total: *total, remaining_s }
            }
            Event::Registered { cycle, figures } => {
                self.notify(Notice::Figures { cycle: *cycle, figures: figures.clone() });
                // No other notice of the state may follow: the result of a computation may hold the cell.
                self.state_notice(event)
            }
            Event::Compensated { cycle, summary } => {
                self.notify(Notice::Compensated { cycle: *cycle, summary: summary.clone() });
                self.state_notice(event)
            }
            event => self.state_notice(event),
        };
        self.notify(notice);
    }

    pub(super) fn state_notice(&self, event: &Event) -> Notice {
        let (state, cycle, at_job) =
            (self.cell.in_words(), self.cell.cycle(), self.display.progress_estimator.progress().is_some());
        Notice::State { state, cycle, event: event.name().to_owned(), has_progress: at_job }
    }

    pub(super) fn notify(&self, notice: Notice) {
        // The receiver may be gone; the run continues.
        let _ = self.display.notices.send(notice);
    }
}
