//! Pages of a result that were read ahead, and when the next page is due.

use super::protocol::PAGE_REGISTERS;
use super::result_header::{Header, MAX_RESULT_BYTES};
use crate::Job;

/// Pages that were read ahead, with the connection, boot and job to which they belong.
#[derive(Debug)]
pub(super) struct ReadAhead {
    pub(super) generation: u64,
    pub(super) boot_id: u32,
    pub(super) start: u32,
    pub(super) job: Job,
    pub(super) header: Header,
    /// Data registers of the pages, from the first page on.
    pub(super) words: Vec<u16>,
    /// Number of reads of the next page since it was selected; `None` if it was not selected.
    pub(super) reads_since_select: Option<u32>,
    /// Progress, as a number of points, at which the next page was read and was not full yet.
    pub(super) not_full_at: Option<u32>,
}

impl ReadAhead {
    /// Returns the number of measured points whose registers are complete in the pages stored so far. A page is one
    /// block of registers of the result of a measurement.
    pub(super) fn point_count(&self) -> usize {
        self.words.len() / self.header.registers
    }

    pub(super) fn next_page(&self) -> u32 {
        (self.words.len() / PAGE_REGISTERS) as u32
    }

    /// Returns true if the next page (block of registers) of the partial result should be read now, because the machine
    /// has measured enough points to fill this page. `progress` is the number of measured points in the last status of
    /// the machine.
    ///
    /// Returns false if this page was already read when the machine reported the same `progress`, and the page was not
    /// full then. Also returns false if the stored pages would exceed the maximum size of a result.
    pub(super) fn is_due(&self, progress: u32) -> bool {
        let registers = u64::from(progress) * self.header.registers as u64;
        let end = self.words.len() + PAGE_REGISTERS;
        end as u64 <= registers && 2 * end <= MAX_RESULT_BYTES as usize && self.not_full_at != Some(progress)
    }
}

/// Failures of the read-ahead in a job.
#[derive(Debug, Default)]
pub(super) struct ReadAheadFailures {
    pub(super) start: u32,
    pub(super) count: u32,
}
