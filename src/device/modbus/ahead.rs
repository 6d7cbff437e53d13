//! Full pages of a result, read while its job still runs.
//!
//! A machine that can says so by a flag of its identity. Between two looks at the status one step is taken at most, the header first and then a
//! page at a time, so that neither a beat nor an order waits for more than the request under way. What came so is kept beside whose
//! it is: the line, the machine's boot, the START. The result is proved at its end as always, by its CRC over all pages; what was kept
//! only need not be read again. Where the proof fails it is thrown away, and all is read anew.

use std::time::Duration;

use super::codec::{self, Registers};
use super::link::Ask;
use super::{Block, Header, ModbusMachine, PAGE, RESULT_BYTES};
use crate::{DeviceError, Interrupt, Job, MeasuredPoint, Preliminary, State, digest};

/// An order waits for the request under way. Where a page is longer on the line nothing is read ahead.
const LONGEST_REQUEST: Duration = Duration::from_millis(75);
/// Bytes of a read of a page on a serial line, with its answer.
const PAGE_BYTES: u32 = 8 + 237;
/// A page that does not show is selected anew after so many looks.
const LOOKS: u32 = 10;
/// After so many failures the rest of a job is read at its end.
const MISSES: u32 = 3;

/// The pages that were read ahead, and whose they are.
#[derive(Debug)]
pub(super) struct Ahead {
    generation: u64,
    boot_id: u32,
    start: u32,
    job: Job,
    header: Header,
    /// The data of the pages, from the first on.
    words: Vec<u16>,
    /// How often the page that is next was looked at since it was selected; none where it was not.
    looks: Option<u32>,
    /// The progress at which the page that is next was not full yet.
    not_full_at: Option<u32>,
}

/// What went wrong with reading ahead in a job.
#[derive(Debug, Default)]
pub(super) struct Misses {
    start: u32,
    count: u32,
}

impl Ahead {
    /// Points that are there whole.
    fn points(&self) -> usize {
        self.words.len() / self.header.registers
    }

    fn next_page(&self) -> u32 {
        (self.words.len() / PAGE) as u32
    }

    /// Whether the page that is next should be full by what the status tells of the progress.
    fn is_due(&self, progress: u32) -> bool {
        let registers = u64::from(progress) * self.header.registers as u64;
        let end = self.words.len() + PAGE;
        end as u64 <= registers && 2 * end <= RESULT_BYTES as usize && self.not_full_at != Some(progress)
    }
}

impl ModbusMachine {
    /// Takes one step ahead after a look at the status, at most one after each. Returns the points that are new by it.
    pub(super) async fn read_ahead(&mut self, job: Job, interrupt: &Interrupt) -> Option<Preliminary> {
        let block = self.seen.take()?;
        let runs = matches!(block.state, State::Execute | State::Holding | State::Held | State::Stopping);
        let mine = block.job == Some(job) && self.began == Some(block.begun_by) && block.begun_by != 0;
        let room = self.unit.link.line().transmission(PAGE_BYTES) <= LONGEST_REQUEST;
        if !(runs && mine && room && self.unit.gives_ahead()) || self.has_missed(block.begun_by) {
            return None;
        }
        match self.step_ahead(job, &block, interrupt).await {
            Ok(told) => told,
            Err(error) => {
                self.miss(block.begun_by, &error);
                None
            }
        }
    }

    fn has_missed(&self, start: u32) -> bool {
        self.misses.start == start && self.misses.count >= MISSES
    }

    /// Counts a failure. A machine that refuses is not asked again in this job, and one that is busy is no failure.
    fn miss(&mut self, start: u32, error: &DeviceError) {
        if self.misses.start != start {
            self.misses = Misses { start, count: 0 };
        }
        match error {
            DeviceError::Exception { .. } if error.is_link() => return,
            error if error.is_link() => self.misses.count += 1,
            _ => self.misses.count = MISSES,
        }
        self.ahead = None;
    }

    async fn step_ahead(
        &mut self,
        job: Job,
        block: &Block,
        interrupt: &Interrupt,
    ) -> Result<Option<Preliminary>, DeviceError> {
        if interrupt.is_raised() {
            return Ok(None);
        }
        let Some(ahead) = self.ahead.take().filter(|ahead| self.is_of(ahead, job, block.begun_by)) else {
            return self.begin_ahead(job, block).await.map(|()| None);
        };
        let ahead = self.ahead.insert(ahead);
        let page = ahead.next_page();
        if !ahead.is_due(block.progress.0) {
            return Ok(None);
        }
        if ahead.looks.is_none_or(|looks| looks >= LOOKS) {
            self.select_ahead(page).await?;
            if interrupt.is_raised() {
                return Ok(None);
            }
        }
        self.take_page(page, block.progress.0).await
    }

    /// Whether pages are of this job, and came on this line from this boot of the machine.
    fn is_of(&self, ahead: &Ahead, job: Job, start: u32) -> bool {
        let boot_id = self.unit.identity().map(|identity| identity.boot_id);
        self.unit.generation() == Some(ahead.generation)
            && boot_id == Some(ahead.boot_id)
            && (ahead.job, ahead.start) == (job, start)
    }

    /// Reads the header of what there is so far. It names the job and the plan, and has no number of an end.
    async fn begin_ahead(&mut self, job: Job, block: &Block) -> Result<(), DeviceError> {
        let address = self.unit.map.outbox_header;
        let words = self.unit.once("outbox header", address, Ask::Read { address, count: 56 }).await?;
        if words[0] == 0 {
            return Ok(()); // There is nothing yet.
        }
        let header = self.header(&words, job, 4, 0)?;
        let measured = digest(&[header.identity]);
        self.compare([("the digest of the plan that is measured", job.digest.into(), measured.into())])?;
        self.coordinates(&header)?;
        let (Some(generation), start) = (self.unit.generation(), block.begun_by) else { return Ok(()) };
        let (words, looks, not_full_at) = (Vec::new(), None, None);
        let boot_id = block.boot_id;
        self.ahead = Some(Ahead { generation, boot_id, start, job, header, words, looks, not_full_at });
        Ok(())
    }

    async fn select_ahead(&mut self, page: u32) -> Result<(), DeviceError> {
        let address = self.unit.map.outbox_select;
        let mut select = self.unit.writer();
        select.u32(page);
        let ask = Ask::Write { address, words: select.words().into() };
        self.unit.once("outbox select", address, ask).await?;
        if let Some(ahead) = &mut self.ahead {
            ahead.looks = Some(0);
        }
        Ok(())
    }

    /// Takes the page that was selected, if it shows and is full.
    async fn take_page(&mut self, page: u32, progress: u32) -> Result<Option<Preliminary>, DeviceError> {
        let address = self.unit.map.outbox_page;
        let read = self.unit.once("outbox page", address, Ask::Read { address, count: 4 + PAGE as u16 }).await?;
        let shown = self.unit.registers(&read).u32(0);
        let Some(mut ahead) = self.ahead.take() else { return Ok(None) };
        let before = ahead.points();
        match (shown == page, usize::from(read[2])) {
            (true, PAGE) => {
                ahead.words.extend_from_slice(&read[4..]);
                (ahead.looks, ahead.not_full_at) = (None, None);
            }
            (true, 0) => ahead.not_full_at = Some(progress),
            (true, other) => {
                let (machine, what) = (self.machine(), "data registers of a page that is read while its job runs");
                return Err(DeviceError::Count { machine, what, expected: PAGE as u64, found: other as u64 });
            }
            (false, _) => ahead.looks = ahead.looks.map(|looks| looks + 1),
        }
        let points = self.points_of(&ahead, before)?;
        let coordinates = self.coordinates(&ahead.header)?;
        let told = Preliminary { job: ahead.job, from: before, points, coordinates };
        self.ahead = Some(ahead);
        Ok((!told.points.is_empty()).then_some(told))
    }

    /// Reads the points from the first that was not told.
    fn points_of(&self, ahead: &Ahead, told: usize) -> Result<Vec<MeasuredPoint>, DeviceError> {
        let Header { format, registers, scale_mm, .. } = ahead.header;
        let new = &ahead.words[told * registers..ahead.points() * registers];
        let point = |record| codec::point(Registers::new(record, self.unit.map.word_order), format, scale_mm);
        let points = new.chunks_exact(registers).map(|record| point(record).map_err(|flaw| self.flawed(flaw)));
        points.collect()
    }

    /// What was read ahead of this result; none where it is of another job, line, boot, plan or format, or more than there is.
    pub(super) fn kept(&self, job: Job, header: &Header, done: u32) -> Option<Vec<u16>> {
        let ahead = self.ahead.as_ref().filter(|ahead| self.is_of(ahead, job, done))?;
        let like = |of: &Header| {
            let reals = [of.probe_radius_mm, of.scale_mm].map(f64::to_bits);
            (of.format, of.coordinates, of.identity, reals)
        };
        let within = ahead.words.len() <= (header.bytes / 2) as usize;
        (within && !ahead.words.is_empty() && like(&ahead.header) == like(header)).then(|| ahead.words.clone())
    }
}
