//! Read-ahead: full pages of a result, read while its job still runs.
//!
//! A machine that supports this has a flag in its identity. Between two reads of the status at most one step is taken:
//! first the header, then one page at a time. So a heartbeat or an order waits for at most one request. The pages are
//! stored with the line, the boot of the machine and the START to which they belong. When the job has ended, the CRC
//! over all pages verifies the result; pages that are already stored are not read again. If the CRC is wrong, the
//! stored pages are discarded and all pages are read again.

use std::time::Duration;

use super::link::LinkRequest;
use super::machine::ModbusMachine;
use super::pages_ahead::{ReadAhead, ReadAheadFailures};
use super::protocol::{self, PAGE_REGISTERS, Registers};
use super::result_header::Header;
use super::status_block::StatusBlock;
use crate::{DeviceError, Interrupt, Job, MachineState, MeasuredPoint, PreliminaryPoints, digest};

/// Maximum transmission time of a page. An order waits for the request under way, so nothing is read ahead if a page
/// takes longer.
const MAX_PAGE_TIME: Duration = Duration::from_millis(75);
/// Number of bytes of a page read on a serial line, with its answer.
const PAGE_BYTES: u32 = 8 + 237;
/// Number of reads after which a page is selected again, if the machine still shows another page.
const MAX_READS: u32 = 10;
/// Number of failures after which reading ahead stops for the job. Its other pages are read when it has ended.
const MAX_FAILURES: u32 = 3;

impl ModbusMachine {
    /// Reads preliminary points of `job` while the machine still executes `job`. The machine stores its result as one
    /// header and numbered pages (blocks of registers). Each call reads the header or at most one page. A second call
    /// does nothing before the status of the machine was read again. Returns the new points, in the order of the plan.
    ///
    /// Returns `None` if there are no new points, a request fails, or `interrupt` is raised. Also returns `None` if
    /// preliminary points cannot be read: the job is not in progress, the machine does not support it, one page takes
    /// too long on the line, this client did not start the job, or earlier requests for this job failed too often.
    pub(super) async fn read_ahead(&mut self, job: Job, interrupt: &Interrupt) -> Option<PreliminaryPoints> {
        let block = self.last_block.take()?;
        let runs = matches!(
            block.state,
            MachineState::Execute | MachineState::Holding | MachineState::Held | MachineState::Stopping
        );
        let mine = block.job == Some(job) && self.last_start == Some(block.begun_by) && block.begun_by != 0;
        let room = self.unit.link.line().transmission(PAGE_BYTES) <= MAX_PAGE_TIME;
        if !(runs && mine && room && self.unit.offers_read_ahead()) || self.has_failed_ahead(block.begun_by) {
            return None;
        }
        match self.step_ahead(job, &block, interrupt).await {
            Ok(told) => told,
            Err(error) => {
                self.count_failure_ahead(block.begun_by, &error);
                None
            }
        }
    }

    fn has_failed_ahead(&self, start: u32) -> bool {
        self.read_ahead_failures.start == start && self.read_ahead_failures.count >= MAX_FAILURES
    }

    /// Handles a failed request for a part of a result whose job still runs. `start` is the sequence number of the
    /// START that began the job, and `error` is the error of the request.
    ///
    /// - If the machine answered that it is busy, does nothing.
    /// - After any other communication error, discards the stored pages of the result and counts the failure. After
    ///   [`MAX_FAILURES`] such errors, no more pages are read until the job has ended.
    /// - After any other error, for example invalid data, discards the stored pages. No more pages are read until the
    ///   job has ended.
    fn count_failure_ahead(&mut self, start: u32, error: &DeviceError) {
        if self.read_ahead_failures.start != start {
            self.read_ahead_failures = ReadAheadFailures { start, count: 0 };
        }
        match error {
            DeviceError::Exception { .. } if error.is_link() => return,
            error if error.is_link() => self.read_ahead_failures.count += 1,
            _ => self.read_ahead_failures.count = MAX_FAILURES,
        }
        self.read_ahead = None;
    }

    async fn step_ahead(
        &mut self,
        job: Job,
        block: &StatusBlock,
        interrupt: &Interrupt,
    ) -> Result<Option<PreliminaryPoints>, DeviceError> {
        if interrupt.is_raised() {
            return Ok(None);
        }
        let Some(ahead) = self.read_ahead.take().filter(|ahead| self.belongs_to(ahead, job, block.begun_by)) else {
            return self.begin_ahead(job, block).await.map(|()| None);
        };
        let ahead = self.read_ahead.insert(ahead);
        let page = ahead.next_page();
        if !ahead.is_due(block.progress.0) {
            return Ok(None);
        }
        if ahead.reads_since_select.is_none_or(|reads_since_select| reads_since_select >= MAX_READS) {
            self.select_ahead(page).await?;
            if interrupt.is_raised() {
                return Ok(None);
            }
        }
        self.read_page_ahead(page, block.progress.0).await
    }

    /// Returns true if the pages in `ahead` belong to `job` and to the START with the sequence number `start`. They
    /// must also have been read on the present connection and since the last restart of the machine.
    fn belongs_to(&self, ahead: &ReadAhead, job: Job, start: u32) -> bool {
        let boot_id = self.unit.identity().map(|identity| identity.boot_id);
        self.unit.generation() == Some(ahead.generation)
            && boot_id == Some(ahead.boot_id)
            && (ahead.job, ahead.start) == (job, start)
    }

    /// Reads the header of the partial result of `job`, which still runs. Stores this header, so that the pages of the
    /// result can be read and decoded next. `block` is the last status of the machine. Stores nothing if the machine
    /// has no partial result yet, or if the identity of the machine must be verified again.
    ///
    /// # Errors
    /// The request fails. Or the header has another kind, names another job or plan, states that the job has ended, or
    /// contains an invalid value.
    async fn begin_ahead(&mut self, job: Job, block: &StatusBlock) -> Result<(), DeviceError> {
        let address = self.unit.map.outbox_header;
        let words = self.unit.request_once("outbox header", address, LinkRequest::Read { address, count: 56 }).await?;
        if words[0] == 0 {
            return Ok(()); // There is nothing yet.
        }
        let header = self.header(&words, job, 4, 0)?;
        let measured = digest(&[header.identity]);
        self.compare([("the digest of the plan that is measured", job.digest.into(), measured.into())])?;
        self.coordinates(&header)?;
        let (Some(generation), start) = (self.unit.generation(), block.begun_by) else { return Ok(()) };
        let (words, reads_since_select, not_full_at) = (Vec::new(), None, None);
        let boot_id = block.boot_id;
        self.read_ahead =
            Some(ReadAhead { generation, boot_id, start, job, header, words, reads_since_select, not_full_at });
        Ok(())
    }

    async fn select_ahead(&mut self, page: u32) -> Result<(), DeviceError> {
        let address = self.unit.map.outbox_select;
        let mut select = self.unit.writer();
        select.u32(page);
        let ask = LinkRequest::Write { address, words: select.words().into() };
        self.unit.request_once("outbox select", address, ask).await?;
        if let Some(ahead) = &mut self.read_ahead {
            ahead.reads_since_select = Some(0);
        }
        Ok(())
    }

    /// Reads the page of the partial result that the machine shows at present. `page` is the number of the requested
    /// page, counted from 0. Stores the page if the machine shows the page with this number and this page is full.
    /// `progress` is the number of measured points in the last status of the machine.
    ///
    /// Returns the points whose registers have become complete with this page. Returns `None` if there are no such
    /// points.
    ///
    /// # Errors
    /// The request fails, a point is invalid, or the requested page is shown but is neither full nor empty.
    async fn read_page_ahead(&mut self, page: u32, progress: u32) -> Result<Option<PreliminaryPoints>, DeviceError> {
        let address = self.unit.map.outbox_page;
        let read = self
            .unit
            .request_once("outbox page", address, LinkRequest::Read { address, count: 4 + PAGE_REGISTERS as u16 })
            .await?;
        let shown = self.unit.registers(&read).u32(0);
        let Some(mut ahead) = self.read_ahead.take() else { return Ok(None) };
        let before = ahead.point_count();
        match (shown == page, usize::from(read[2])) {
            (true, PAGE_REGISTERS) => {
                ahead.words.extend_from_slice(&read[4..]);
                (ahead.reads_since_select, ahead.not_full_at) = (None, None);
            }
            (true, 0) => ahead.not_full_at = Some(progress),
            (true, other) => {
                let (machine, what) =
                    (self.machine(), "data registers in a result page that is read while the job runs");
                return Err(DeviceError::WrongCount {
                    machine,
                    elements: what,
                    expected: PAGE_REGISTERS as u64,
                    found: other as u64,
                });
            }
            (false, _) => {
                ahead.reads_since_select = ahead.reads_since_select.map(|reads_since_select| reads_since_select + 1)
            }
        }
        let points = self.points_of(&ahead, before)?;
        let coordinates = self.coordinates(&ahead.header)?;
        let told = PreliminaryPoints { job: ahead.job, first_index: before, points, coordinates };
        self.read_ahead = Some(ahead);
        Ok((!told.points.is_empty()).then_some(told))
    }

    /// Decodes the points in the stored pages of `ahead` that were not returned before. `told` is the number of points
    /// that were already returned. These points are skipped. A point whose registers are not complete yet is skipped
    /// too.
    ///
    /// # Errors
    /// The registers of a point are invalid.
    fn points_of(&self, ahead: &ReadAhead, told: usize) -> Result<Vec<MeasuredPoint>, DeviceError> {
        let Header { format, registers, scale_mm, .. } = ahead.header;
        let new = &ahead.words[told * registers..ahead.point_count() * registers];
        let point = |record| protocol::decode_point(Registers::new(record, self.unit.map.word_order), format, scale_mm);
        let points = new.chunks_exact(registers).map(|record| point(record).map_err(|flaw| self.record_error(flaw)));
        points.collect()
    }

    /// Returns the registers of the result of `job` that were already read while this job ran. They are the first
    /// registers of the complete result, so only the rest must still be read. `header` is the header of the complete
    /// result, and `done` is the sequence number of the START that began the job.
    ///
    /// Returns `None` if no registers were read while the job ran. Also returns `None` if these registers do not fit
    /// the complete result: another job, connection, restart of the machine, plan, format, kind of coordinates, probe
    /// radius or scale, or too many registers.
    pub(super) fn registers_read_ahead(&self, job: Job, header: &Header, done: u32) -> Option<Vec<u16>> {
        let ahead = self.read_ahead.as_ref().filter(|ahead| self.belongs_to(ahead, job, done))?;
        let like = |of: &Header| {
            let reals = [of.probe_radius_mm, of.scale_mm].map(f64::to_bits);
            (of.format, of.coordinates, of.identity, reals)
        };
        let within = ahead.words.len() <= (header.bytes / 2) as usize;
        (within && !ahead.words.is_empty() && like(&ahead.header) == like(header)).then(|| ahead.words.clone())
    }
}
