//! Transfer of a result from a machine in pages, between two readings of its header.

use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::commands::ACKNOWLEDGE_TIMEOUT;
use super::machine::ModbusMachine;
use super::protocol::{self, PAGE_REGISTERS, RecordError, crc32};
use super::result_header::{Header, MAX_RESULT_BYTES};
use super::status_block::StatusBlock;
use crate::{Coordinates, DeviceError, Interrupt, Job, MachineState, range};

impl ModbusMachine {
    /// Fetches the complete result of `job`. `kind` is the number of the kind of result: 4 measurement, 5 pass record.
    /// Checks that the result belongs to this job and that its CRC-32 is correct. Returns the status, the header of the
    /// result and its data registers. Repeats the transfer after a communication error, at most `retries` times.
    ///
    /// # Errors
    /// The job is not complete, the result belongs to another job, `interrupt` is raised, or the transfer fails.
    pub(super) async fn fetch(
        &mut self,
        job: Job,
        kind: u16,
        interrupt: &Interrupt,
    ) -> Result<(StatusBlock, Header, Vec<u16>), DeviceError> {
        let mut tries = 0;
        loop {
            let status = self.read_status_block().await?;
            if status.state != MachineState::Complete || status.done == 0 {
                return Err(DeviceError::NoResult { machine: self.machine(), job, state: status.state });
            }
            self.check_job(job, &status)?;
            if let Some(began) = self.last_start.filter(|began| *began != status.done) {
                let (sent, held) = (u64::from(began), u64::from(status.done));
                let field = "the START whose job has ended";
                return Err(DeviceError::Mismatch { machine: self.machine(), field, sent, found: held });
            }
            match self.fetch_once(job, kind, status.done, interrupt).await {
                Ok(Some((header, words))) => return Ok((status, header, words)),
                // The pages that were read ahead do not belong to this result; the next attempt reads all pages.
                Ok(None) => {}
                Err(error) if !error.is_link() || tries >= self.retries => return Err(error),
                Err(_) => tries += 1,
            }
        }
    }

    async fn fetch_once(
        &mut self,
        job: Job,
        kind: u16,
        done: u32,
        interrupt: &Interrupt,
    ) -> Result<Option<(Header, Vec<u16>)>, DeviceError> {
        let before = self.header_words().await?;
        let header = self.header(&before, job, kind, done)?;
        let total = (header.bytes / 2) as usize;
        let pages = total.div_ceil(PAGE_REGISTERS) as u32;
        let mut words = Vec::with_capacity(total);
        words.extend(self.registers_read_ahead(job, &header, done).into_iter().flatten());
        let ahead = (words.len() / PAGE_REGISTERS) as u32;
        for page in ahead..pages {
            self.check_interrupt(interrupt, "result", page, pages)?;
            self.send_heartbeat().await?;
            let due = (total - words.len()).min(PAGE_REGISTERS);
            self.fetch_page(page, due, &mut words).await?;
        }
        let after = self.header_words().await?;
        if before != after {
            let (expected, found) = (u64::from(crc32(&before)), u64::from(crc32(&after)));
            return Err(self.unit.reject_data("header of a result (read twice)", expected, found).await);
        }
        let crc = crc32(&words);
        if ahead > 0 && (crc != header.crc || self.registers_read_ahead(job, &header, done).is_none()) {
            self.read_ahead = None;
            return Ok(None);
        }
        if crc != header.crc {
            return Err(self.unit.reject_data("check number of a result", header.crc.into(), crc.into()).await);
        }
        Ok(Some((header, words)))
    }

    async fn header_words(&mut self) -> Result<Vec<u16>, DeviceError> {
        self.unit.read("outbox header", self.unit.map.outbox_header, 56).await
    }

    pub(super) fn header(&self, words: &[u16], job: Job, kind: u16, done: u32) -> Result<Header, DeviceError> {
        let machine = self.machine();
        let block = self.unit.registers(words);
        self.compare([
            ("the kind of the result", u64::from(kind), u64::from(words[0])),
            ("the job of the result", u64::from(job.job), u64::from(block.u32(6))),
            ("the cycle of the result", u64::from(job.cycle), u64::from(words[8])),
            ("the number of the finished job", u64::from(done), u64::from(block.u32(46))),
        ])?;
        if words[28] != 1 {
            return Err(DeviceError::WrongLengthUnit { machine, unit: words[28] });
        }
        let reals = [("the probe's radius", 12), ("the scale", 16), ("the mean temperature", 20), ("the duration", 24)];
        for (field, at) in reals {
            // A machine without a thermometer gives NaN as the temperature.
            let is_untold = at == 20 && block.f64(at).is_nan();
            if !is_untold && !block.f64(at).is_finite() {
                return Err(DeviceError::NotFinite { machine, field: field.into(), value: block.f64(at) });
            }
        }
        let (format, bytes, records) = (words[1], block.u32(2), block.u32(10));
        let size = match kind {
            4 => protocol::point_registers(format),
            _ => (format == 1).then_some(32),
        };
        let Some(size) = size else {
            return Err(DeviceError::Unlisted { machine, field: "the format of the result", found: format.into() });
        };
        let expected = 2 * size as u64 * u64::from(records);
        if u64::from(bytes) != expected || bytes > MAX_RESULT_BYTES {
            let expected = expected.min(MAX_RESULT_BYTES.into());
            return Err(DeviceError::WrongCount {
                machine,
                elements: "bytes of the result",
                expected,
                found: bytes.into(),
            });
        }
        if (kind, format) == (4, 2) {
            range::check_count_scale(&machine, block.f64(16))?;
        }
        Ok(Header {
            format,
            bytes,
            crc: block.u32(4),
            records,
            registers: size,
            coordinates: words[9],
            probe_radius_mm: block.f64(12),
            scale_mm: block.f64(16),
            temperature_c: Some(block.f64(20)).filter(|told| !told.is_nan()),
            duration_s: block.f64(24),
            identity: block.identity(30),
        })
    }

    /// Reads one page of a result and appends its data registers to `words`. A result is transferred in pages (blocks
    /// of registers). `page` is the number of the page, counted from 0. `due` is the expected number of data registers
    /// in this page. The machine may need some time to provide the page, so the request is repeated for
    /// [`ACKNOWLEDGE_TIMEOUT`] if the machine provides another page.
    ///
    /// # Errors
    /// Returns an error if the machine still provides another page after this time, if the number of registers in the
    /// page is not `due`, or if a request fails.
    async fn fetch_page(&mut self, page: u32, due: usize, words: &mut Vec<u16>) -> Result<(), DeviceError> {
        let map = self.unit.map;
        let mut select = self.unit.writer();
        select.u32(page);
        let began = Instant::now();
        loop {
            self.unit.write("outbox select", map.outbox_select, select.words()).await?;
            let read = self.unit.read("outbox page", map.outbox_page, 4 + due as u16).await?;
            let found = self.unit.registers(&read).u32(0);
            if found == page && usize::from(read[2]) == due {
                words.extend_from_slice(&read[4..]);
                return Ok(());
            }
            if found == page {
                return Err(self.unit.reject_data("number of registers in a page", due as u64, read[2].into()).await);
            }
            if began.elapsed() > ACKNOWLEDGE_TIMEOUT {
                return Err(self.unit.reject_data("number of a page", page.into(), found.into()).await);
            }
            sleep(Duration::from_millis(2)).await;
        }
    }

    pub(super) fn coordinates(&self, header: &Header) -> Result<Coordinates, DeviceError> {
        match header.coordinates {
            1 => Ok(Coordinates::Centres),
            2 => Ok(Coordinates::Contacts),
            other => {
                let (field, found) = ("the kind of its coordinates", u32::from(other));
                Err(DeviceError::Unlisted { machine: self.machine(), field, found })
            }
        }
    }

    pub(super) fn record_error(&self, flaw: RecordError) -> DeviceError {
        let machine = self.machine();
        match flaw {
            RecordError::NotFinite { field, value } => DeviceError::NotFinite { machine, field, value },
            RecordError::Unlisted { field, found } => DeviceError::Unlisted { machine, field, found },
        }
    }

    pub(super) fn count(&self, what: &'static str, expected: u64, found: u64) -> Result<(), DeviceError> {
        match expected == found {
            true => Ok(()),
            false => Err(DeviceError::WrongCount { machine: self.machine(), elements: what, expected, found }),
        }
    }
}
