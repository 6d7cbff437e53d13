//! Encoding and decoding of registers, exactly as docs/modbus.md defines it.
//!
//! Every value of more than one register goes through [`WordOrder`]; the word order is decided nowhere else. Values are
//! read by offset from [`Registers`], which never reads outside. Registers to be written are built with [`Writer`].

use sha2::{Digest, Sha256};

use super::settings::WordOrder;
use crate::{
    CarefulStart, CorrectionMap, Identified, Job, MachineCommand, MeasuredPoint, Outcome, Pass, Plan, TouchStatus,
};
use regrind_core::geometry::Grid;

impl WordOrder {
    fn bits(self, words: &[u16]) -> u64 {
        let shift_in = |bits: u64, word: &u16| (bits << 16) | u64::from(*word);
        if self.is_low_first() { words.iter().rev().fold(0, shift_in) } else { words.iter().fold(0, shift_in) }
    }
}

/// Number of data registers in a full page.
pub(super) const PAGE_REGISTERS: usize = 112;

/// Registers that were read, with the values at their offsets. An offset outside reads as zero, so the length has to be
/// checked only once.
#[derive(Debug, Clone, Copy)]
pub(super) struct Registers<'a> {
    words: &'a [u16],
    order: WordOrder,
}

impl<'a> Registers<'a> {
    pub(super) fn new(words: &'a [u16], order: WordOrder) -> Self {
        Self { words, order }
    }

    fn slice(&self, at: usize, count: usize) -> &'a [u16] {
        self.words.get(at..at + count).unwrap_or(&[])
    }

    pub(super) fn u16(&self, at: usize) -> u16 {
        self.words.get(at).copied().unwrap_or(0)
    }

    pub(super) fn i16(&self, at: usize) -> i16 {
        self.u16(at).cast_signed()
    }

    pub(super) fn u32(&self, at: usize) -> u32 {
        self.order.bits(self.slice(at, 2)) as u32
    }

    pub(super) fn i32(&self, at: usize) -> i32 {
        self.u32(at).cast_signed()
    }

    pub(super) fn f32(&self, at: usize) -> f32 {
        f32::from_bits(self.u32(at))
    }

    pub(super) fn f64(&self, at: usize) -> f64 {
        f64::from_bits(self.order.bits(self.slice(at, 4)))
    }

    /// Returns the identity (a SHA-256, 32 bytes) that is stored in 16 registers from the offset `at`. The high byte of
    /// each register comes first, whatever the word order. Returns zeros if the registers do not exist.
    pub(super) fn identity(&self, at: usize) -> [u8; 32] {
        let mut identity = [0; 32];
        for (pair, word) in identity.chunks_exact_mut(2).zip(self.slice(at, 16)) {
            pair.copy_from_slice(&word.to_be_bytes());
        }
        identity
    }

    /// Returns the text in the registers from `at` on, up to the first zero byte. A byte that is not printable ASCII
    /// becomes a question mark.
    pub(super) fn text(&self, at: usize, registers: usize) -> String {
        let bytes = bytes_of(self.slice(at, registers));
        let text = bytes.iter().take_while(|byte| **byte != 0);
        text.map(|byte| if (0x20..0x7f).contains(byte) { char::from(*byte) } else { '?' }).collect()
    }
}

/// Builder of registers to be written, filled from the front.
#[derive(Debug)]
pub(super) struct Writer {
    words: Vec<u16>,
    order: WordOrder,
}

impl Writer {
    pub(super) fn new(order: WordOrder) -> Self {
        Self { words: Vec::new(), order }
    }

    fn bits(&mut self, bits: u64, registers: usize) -> &mut Self {
        let words = (0..registers).map(|k| (bits >> (16 * k)) as u16);
        if self.order.is_low_first() {
            self.words.extend(words)
        } else {
            self.words.extend(words.rev())
        }
        self
    }

    pub(super) fn u16(&mut self, value: u16) -> &mut Self {
        self.words.push(value);
        self
    }

    pub(super) fn u32(&mut self, value: u32) -> &mut Self {
        self.bits(u64::from(value), 2)
    }

    pub(super) fn f64(&mut self, value: f64) -> &mut Self {
        self.bits(value.to_bits(), 4)
    }

    pub(super) fn f64s(&mut self, values: &[f64]) -> &mut Self {
        values.iter().for_each(|value| {
            self.f64(*value);
        });
        self
    }

    pub(super) fn identity(&mut self, identity: &[u8; 32]) -> &mut Self {
        self.words.extend(identity.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])));
        self
    }

    pub(super) fn zeros(&mut self, registers: usize) -> &mut Self {
        self.words.resize(self.words.len() + registers, 0);
        self
    }

    pub(super) fn words(&self) -> &[u16] {
        &self.words
    }

    pub(super) fn finish(self) -> Vec<u16> {
        self.words
    }
}

/// Returns the bytes of registers, the high byte of each register first.
pub(super) fn bytes_of(words: &[u16]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_be_bytes()).collect()
}

/// Returns the CRC-32 over the bytes of registers.
pub(super) fn crc32(words: &[u16]) -> u32 {
    crc32fast::hash(&bytes_of(words))
}

/// Returns the CRC-16 of Modbus RTU: reflected polynomial 0xA001, initial value 0xFFFF.
pub(super) fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xffff, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| if crc & 1 == 1 { (crc >> 1) ^ 0xa001 } else { crc >> 1 })
    })
}

/// Content of a command frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CommandFrame {
    pub(super) sequence: u32,
    pub(super) command: MachineCommand,
    pub(super) job: Option<Job>,
    pub(super) owner: u32,
    pub(super) epoch: u32,
    pub(super) token: u32,
    pub(super) argument: u32,
}

impl CommandFrame {
    /// Returns the 20 registers of the command block (layout in docs/modbus.md) that contain this command. `order` is
    /// the word order of each value of two registers.
    pub(super) fn words(&self, order: WordOrder) -> Vec<u16> {
        let (job, cycle, digest) = self.job.map_or((0, 0, 0), |job| (job.job, job.cycle, job.digest));
        let mut frame = Writer::new(order);
        frame.u32(self.sequence).u16(self.command as u16).u16(cycle).u32(self.owner).u32(self.epoch);
        frame.u32(job).u32(digest).u32(self.token).u32(self.argument);
        let crc = crc16(&bytes_of(frame.words()));
        frame.u16(crc).u16(0).u32(self.sequence);
        frame.finish()
    }
}

/// Payload that can be sent to a machine.
pub(super) trait Payload: Identified {
    /// Number of its kind.
    const KIND: u16;
    /// Name in messages.
    const NAME: &'static str;
    /// Returns the registers of the payload. `order` is the word order of each value that needs more than one register.
    fn words(&self, order: WordOrder) -> Vec<u16>;
    /// Returns the first value in the payload that no machine could accept. The result contains the name of the field,
    /// its value, and the allowed values in words. Returns `None` if all values are acceptable.
    fn invalid_field(&self) -> Option<(String, f64, &'static str)>;
}

fn sha256(words: &[u16]) -> [u8; 32] {
    Sha256::digest(bytes_of(words)).into()
}

/// Returns the first entry of `fields`, pairs of name and value, whose value is not a finite number. The result
/// contains the name, the value, and the allowed values in words. Returns `None` if all values are finite.
fn not_finite<'a>(fields: impl IntoIterator<Item = (&'a str, f64)>) -> Option<(String, f64, &'static str)> {
    let flaw = fields.into_iter().find(|(_, value)| !value.is_finite());
    flaw.map(|(field, value)| (field.to_owned(), value, "a finite number"))
}

/// Returns the first entry of `fields`, pairs of name and value, whose value is not finite or not above 0. The result
/// contains the name, the value, and the allowed values in words. Returns `None` if all values are finite and above 0.
fn not_positive<'a>(fields: impl IntoIterator<Item = (&'a str, f64)>) -> Option<(String, f64, &'static str)> {
    let flaw = fields.into_iter().find(|(_, value)| !(value.is_finite() && *value > 0.0));
    flaw.map(|(field, value)| (field.to_owned(), value, "a finite number above 0"))
}

impl Payload for Plan {
    const KIND: u16 = 1;
    const NAME: &'static str = "plan";

    fn words(&self, order: WordOrder) -> Vec<u16> {
        let mut plan = Writer::new(order);
        plan.u16(1).u16(0).u32(self.targets.len() as u32);
        plan.f64s(&[self.probe_radius_mm, self.approach_mm, self.search_mm, self.speed_mm_s, self.safe_height_mm]);
        match self.careful_start {
            Some(CarefulStart { target_count: targets, speed_mm_s }) => plan.u32(targets).zeros(2).f64(speed_mm_s),
            None => plan.zeros(8),
        };
        for target in &self.targets {
            plan.u32(target.index).u16(target.kind as u16).u16(0).f64s(&target.point_mm).f64s(&target.normal);
        }
        plan.finish()
    }

    fn invalid_field(&self) -> Option<(String, f64, &'static str)> {
        let count = self.targets.len();
        if count == 0 || count > 1_000_000 {
            return Some(("the number of targets".into(), count as f64, "1 to 1,000,000"));
        }
        let header = [
            ("probe_radius_mm", self.probe_radius_mm),
            ("approach_mm", self.approach_mm),
            ("search_mm", self.search_mm),
            ("speed_mm_s", self.speed_mm_s),
        ];
        let careful = self.careful_start.and_then(|careful| careful.invalid_field(count, self.speed_mm_s));
        not_positive(header).or(careful).or_else(|| not_finite([("safe_height_mm", self.safe_height_mm)])).or_else(
            || {
                self.targets.iter().find_map(|target| {
                    let numbers = target.point_mm.iter().chain(&target.normal);
                    let length = target.normal.iter().map(|n| n * n).sum::<f64>().sqrt();
                    match numbers.copied().find(|value| !value.is_finite()) {
                        Some(value) => {
                            Some((format!("a coordinate of target {}", target.index), value, "a finite number"))
                        }
                        None if (length - 1.0).abs() > 1e-6 => Some((
                            format!("the length of the normal of target {}", target.index),
                            length,
                            "1 within 1e-6",
                        )),
                        None => None,
                    }
                })
            },
        )
    }
}

impl CarefulStart {
    fn invalid_field(self, targets: usize, speed_mm_s: f64) -> Option<(String, f64, &'static str)> {
        if self.target_count == 0 || self.target_count as usize > targets {
            return Some(("the number of careful targets".into(), self.target_count.into(), "1 to all of them"));
        }
        let slower = self.speed_mm_s > 0.0 && self.speed_mm_s <= speed_mm_s;
        (!slower).then(|| ("careful_speed_mm_s".into(), self.speed_mm_s, "above 0, and not above speed_mm_s"))
    }
}

impl Payload for CorrectionMap {
    const KIND: u16 = 2;
    const NAME: &'static str = "correction map";

    fn words(&self, order: WordOrder) -> Vec<u16> {
        let max_mm = self.values_mm.iter().fold(0.0, |most: f64, value| most.max(value.abs()));
        let Grid { columns, rows, first_mm, spacing_mm } = self.grid;
        let mut map = Writer::new(order);
        map.u16(1).u16(1).u32(columns as u32).u32(rows as u32).u32(0);
        map.f64s(&first_mm).f64s(&spacing_mm).f64(max_mm).zeros(4).identity(&self.part_identity);
        map.f64s(&self.values_mm);
        map.finish()
    }

    fn invalid_field(&self) -> Option<(String, f64, &'static str)> {
        let Grid { columns, rows, first_mm, spacing_mm } = self.grid;
        let nodes = columns.checked_mul(rows);
        if nodes != Some(self.values_mm.len()) {
            return Some(("the number of values".into(), self.values_mm.len() as f64, "columns times rows"));
        }
        if !(2..=65_535).contains(&columns) || !(2..=65_535).contains(&rows) {
            return Some(("the number of columns or rows".into(), columns.min(rows) as f64, "2 to 65,535"));
        }
        not_positive([("spacing_mm along x", spacing_mm[0]), ("spacing_mm along y", spacing_mm[1])])
            .or_else(|| not_finite([("first_mm x", first_mm[0]), ("first_mm y", first_mm[1])]))
            .or_else(|| not_finite(self.values_mm.iter().map(|value| ("a value of the map", *value))))
    }
}

impl Payload for Pass {
    const KIND: u16 = 3;
    const NAME: &'static str = "pass";

    fn words(&self, order: WordOrder) -> Vec<u16> {
        let mut pass = Writer::new(order);
        pass.u16(1).u16(self.spark_out_passes).u32(0);
        pass.f64s(&[
            self.wheel_radius_mm,
            self.feed_mm_min,
            self.track_spacing_mm,
            self.level_mm,
            self.depth_of_cut_mm,
        ]);
        pass.f64s(&self.x_mm).f64s(&self.y_mm).zeros(8).identity(&self.part_identity);
        pass.finish()
    }

    fn invalid_field(&self) -> Option<(String, f64, &'static str)> {
        let positive = [
            ("wheel_radius_mm", self.wheel_radius_mm),
            ("feed_mm_min", self.feed_mm_min),
            ("track_spacing_mm", self.track_spacing_mm),
            ("the width of x_mm", self.x_mm[1] - self.x_mm[0]),
            ("the width of y_mm", self.y_mm[1] - self.y_mm[0]),
        ];
        not_positive(positive).or_else(|| {
            let depth = self.depth_of_cut_mm;
            match depth.is_finite() && depth >= 0.0 {
                true => not_finite([("level_mm", self.level_mm)]),
                false => Some(("depth_of_cut_mm".into(), depth, "a finite number, 0 or more")),
            }
        })
    }
}

impl Identified for Plan {
    fn identity(&self) -> [u8; 32] {
        sha256(&self.words(WordOrder::Big))
    }
}

impl Identified for CorrectionMap {
    fn identity(&self) -> [u8; 32] {
        sha256(&self.words(WordOrder::Big))
    }
}

impl Identified for Pass {
    fn identity(&self) -> [u8; 32] {
        sha256(&self.words(WordOrder::Big))
    }
}

/// Error in a record that a machine sent.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum RecordError {
    /// A coordinate or another value is not a finite number.
    NotFinite { field: String, value: f64 },
    /// A code is not in the contract.
    Unlisted { field: &'static str, found: u32 },
}

/// Returns the number of registers that one measured point occupies in a result: 16 in `format` 1 (coordinates in mm),
/// 10 in `format` 2 (coordinates in counts). Returns `None` for any other format.
pub(super) fn point_registers(format: u16) -> Option<usize> {
    match format {
        1 => Some(16),
        2 => Some(10),
        _ => None,
    }
}

/// Decodes one measured point from the registers of its record. In format 1 the coordinates are in mm. In format 2 they
/// are counts, and `scale_mm` is the length of one count in mm. The coordinates of the returned point are in mm.
///
/// # Errors
/// The status of the point is unknown, or a coordinate is not finite.
pub(super) fn decode_point(record: Registers<'_>, format: u16, scale_mm: f64) -> Result<MeasuredPoint, RecordError> {
    let index = record.u32(0);
    let status = match record.u16(2) {
        1 => TouchStatus::Touched,
        2 => TouchStatus::NotFound,
        3 => TouchStatus::NotReached,
        other => return Err(RecordError::Unlisted { field: "the status of a point", found: u32::from(other) }),
    };
    let at_mm = match format {
        1 => [4, 8, 12].map(|at| record.f64(at)),
        _ => [4, 6, 8].map(|at| f64::from(record.i32(at)) * scale_mm),
    };
    if let Some(value) = at_mm.into_iter().find(|value| !value.is_finite()) {
        return Err(RecordError::NotFinite { field: format!("a coordinate of point {index}"), value });
    }
    Ok(MeasuredPoint { index, status, quality: record.u16(3), position_mm: at_mm })
}

/// Decodes the record of a pass. Returns the job number, the cycle number, the outcome, and six values:
///
/// - path travelled, in mm
/// - volume removed, in mm³
/// - largest depth removed, in mm
/// - fraction of the path on which the wheel removed no material, from 0 to 1
/// - mean spindle load, where 1 is full load
/// - radius of the wheel, in mm
///
/// The ranges of the values are not checked.
///
/// # Errors
/// The outcome is unknown, or a value is not finite.
pub(super) fn decode_pass_record(record: Registers<'_>) -> Result<(u32, u16, Outcome, [f64; 6]), RecordError> {
    const FIELDS: [&str; 6] =
        ["path travelled", "volume removed", "largest depth", "idle share", "spindle load", "wheel radius"];
    let outcome = decode_outcome(record.u16(3))?;
    let figures = [4, 8, 12, 16, 20, 24].map(|at| record.f64(at));
    match FIELDS.iter().zip(figures).find(|(_, value)| !value.is_finite()) {
        Some((field, value)) => Err(RecordError::NotFinite { field: (*field).into(), value }),
        None => Ok((record.u32(0), record.u16(2), outcome, figures)),
    }
}

/// Decodes the outcome of a job from its number in docs/modbus.md.
///
/// # Errors
/// The number is unknown.
pub(super) fn decode_outcome(number: u16) -> Result<Outcome, RecordError> {
    Ok(match number {
        0 => Outcome::None,
        1 => Outcome::Complete,
        2 => Outcome::Stopped,
        3 => Outcome::Aborted,
        4 => Outcome::Failed,
        other => return Err(RecordError::Unlisted { field: "the result", found: u32::from(other) }),
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{PlanTarget, TargetKind};

    #[test]
    fn codec_word_and_byte_order() {
        // 0x12345678, and -2.5e-7, whose bits are 0xBE90C6F7A0B5ED8D.
        for (order, whole, real) in [
            (WordOrder::Big, [0x1234, 0x5678], [0xbe90, 0xc6f7, 0xa0b5, 0xed8d]),
            (WordOrder::Little, [0x5678, 0x1234], [0xed8d, 0xa0b5, 0xc6f7, 0xbe90]),
        ] {
            let mut writer = Writer::new(order);
            writer.u32(0x1234_5678).f64(-2.5e-7);
            let words = writer.finish();
            assert_eq!(words, [&whole[..], &real[..]].concat());
            let back = Registers::new(&words, order);
            assert_eq!((back.u32(0), back.f64(2)), (0x1234_5678, -2.5e-7));
        }
        assert_eq!(bytes_of(&[0x1234, 0x5678]), [0x12, 0x34, 0x56, 0x78]);
    }

    #[test]
    fn crc16_and_crc32_match_standard() {
        assert_eq!(crc16(b"123456789"), 0x4b37);
        assert_eq!(crc32(&[0x3132, 0x3334, 0x3536, 0x3738]), 0x9ae0_daaf); // "12345678"
        // The request "read two registers from 0 of unit 1" ends in C4 0B on the line: low byte first.
        assert_eq!(crc16(&[1, 3, 0, 0, 0, 2]).to_le_bytes(), [0xc4, 0x0b]);
    }

    #[test]
    fn command_frame_layout() {
        let frame = CommandFrame {
            sequence: 0x0001_0002,
            command: MachineCommand::Start,
            job: Some(Job { job: 7, cycle: 2, digest: 0xdead_beef }),
            owner: 0x11,
            epoch: 3,
            token: 0xcafe_f00d,
            argument: 0,
        };
        let head = [1, 2, 3, 2, 0, 0x11, 0, 3, 0, 7, 0xdead, 0xbeef, 0xcafe, 0xf00d, 0, 0];
        let words = frame.words(WordOrder::Big);
        assert_eq!(words[..16], head);
        assert_eq!(words[16], crc16(&bytes_of(&head)));
        assert_eq!(words[17..], [0, 1, 2]);
        let little = frame.words(WordOrder::Little);
        assert_eq!(little[..4], [2, 1, 3, 2]);
        assert_eq!(little[16], crc16(&bytes_of(&little[..16])));
    }

    fn plan() -> Plan {
        let target = PlanTarget {
            index: 9,
            kind: TargetKind::ReferenceSphere,
            point_mm: [1.0, -2.0, 0.5],
            normal: [0.0, 0.0, 1.0],
        };
        Plan {
            targets: vec![target],
            probe_radius_mm: 2.0,
            approach_mm: 1.0,
            search_mm: 0.5,
            speed_mm_s: 4.0,
            safe_height_mm: 8.0,
            careful_start: None,
        }
    }

    #[test]
    fn plan_word_layout() {
        let words = plan().words(WordOrder::Big);
        assert_eq!(words.len(), (64 + 56) / 2);
        assert_eq!(words[..4], [1, 0, 0, 1]);
        assert_eq!(words[4..8], [0x4000, 0, 0, 0]); // 2.0 at byte 8
        assert_eq!(words[20..24], [0x4020, 0, 0, 0]); // 8.0 at byte 40
        assert_eq!(words[24..32], [0; 8]);
        let careful = Plan { careful_start: Some(CarefulStart { target_count: 1, speed_mm_s: 2.0 }), ..plan() };
        assert_eq!(careful.words(WordOrder::Big)[24..32], [0, 1, 0, 0, 0x4000, 0, 0, 0]); // at byte 48 and 56
        assert_eq!(careful.words(WordOrder::Little)[24..32], [1, 0, 0, 0, 0, 0, 0, 0x4000]);
        for (targets, speed_mm_s) in [(0, 2.0), (2, 2.0), (1, 0.0), (1, 4.5), (1, f64::NAN)] {
            let flawed = Plan { careful_start: Some(CarefulStart { target_count: targets, speed_mm_s }), ..plan() };
            assert!(flawed.invalid_field().is_some(), "{targets} {speed_mm_s}");
        }
        assert_eq!(words[32..36], [0, 9, 2, 0]); // the target at byte 64
        assert_eq!(words[40..44], [0xc000, 0, 0, 0]); // y = -2 at byte 64 + 16
        assert_eq!(words[56..60], [0x3ff0, 0, 0, 0]); // nz = 1 at byte 64 + 48
    }

    #[test]
    fn map_and_pass_word_layout() {
        let map = CorrectionMap {
            grid: Grid { columns: 2, rows: 3, first_mm: [-1.0, -2.0], spacing_mm: [2.0, 4.0] },
            values_mm: vec![0.0, 0.5, -0.25, 0.0, 0.0, 1.0],
            part_identity: [0xab; 32],
        };
        let words = map.words(WordOrder::Big);
        assert_eq!(words.len(), 48 + 6 * 4);
        assert_eq!(words[..8], [1, 1, 0, 2, 0, 3, 0, 0]);
        assert_eq!(words[24..28], [0x3ff0, 0, 0, 0]); // the largest, 1.0, at byte 48
        assert_eq!(words[32..48], [0xabab; 16]); // byte 64
        assert_eq!(words[52..56], [0x3fe0, 0, 0, 0]); // the second value, 0.5
        let pass = Pass {
            spark_out_passes: 2,
            wheel_radius_mm: 1.0,
            feed_mm_min: 2.0,
            track_spacing_mm: 0.5,
            level_mm: 0.0,
            depth_of_cut_mm: 0.5,
            x_mm: [-1.0, 1.0],
            y_mm: [-2.0, 2.0],
            part_identity: [0xcd; 32],
        };
        let words = pass.words(WordOrder::Big);
        assert_eq!(words.len(), 64);
        assert_eq!(words[..4], [1, 2, 0, 0]);
        assert_eq!(words[24..28], [0xbff0, 0, 0, 0]); // least x, -1, at byte 48
        assert_eq!(words[48..], [0xcdcd; 16]); // byte 96
        assert_eq!((map.invalid_field(), pass.invalid_field(), plan().invalid_field()), (None, None, None));
    }

    #[test]
    fn identity_independent_of_word_order() {
        let bytes = bytes_of(&plan().words(WordOrder::Big));
        assert_eq!(plan().identity(), <[u8; 32]>::from(Sha256::digest(&bytes)));
        assert_ne!(plan().words(WordOrder::Big), plan().words(WordOrder::Little));
    }

    #[test]
    fn plan_invalid_field_is_named() {
        let mut bad = plan();
        bad.targets[0].point_mm[2] = f64::NAN;
        assert!(bad.invalid_field().is_some_and(|(field, ..)| field.contains("target 9")));
        bad = plan();
        bad.targets[0].normal = [0.0, 0.0, 2.0];
        assert!(bad.invalid_field().is_some_and(|(_, length, _)| length == 2.0));
        bad = plan();
        bad.targets.clear();
        assert!(bad.invalid_field().is_some());
        bad = plan();
        bad.probe_radius_mm = 0.0;
        assert!(bad.invalid_field().is_some());
    }

    #[test]
    fn point_decodes_both_formats() {
        let mut writer = Writer::new(WordOrder::Little);
        writer.u32(70_000).u16(1).u16(5).f64s(&[1.5, -2.5, 3.5]);
        let words = writer.finish();
        let read = decode_point(Registers::new(&words, WordOrder::Little), 1, 1.0).unwrap();
        assert_eq!(read.index, 70_000);
        assert_eq!((read.status, read.quality, read.position_mm), (TouchStatus::Touched, 5, [1.5, -2.5, 3.5]));
        let mut writer = Writer::new(WordOrder::Big);
        writer.u32(1).u16(2).u16(100).u32(10).u32((-20_i32).cast_unsigned()).u32(0);
        let words = writer.finish();
        let read = decode_point(Registers::new(&words, WordOrder::Big), 2, 0.5).unwrap();
        assert_eq!((read.status, read.position_mm), (TouchStatus::NotFound, [5.0, -10.0, 0.0]));
        assert_eq!((point_registers(1), point_registers(2), point_registers(3)), (Some(16), Some(10), None));
    }

    #[test]
    fn point_decode_refuses_non_finite() {
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let mut writer = Writer::new(WordOrder::Big);
            writer.u32(3).u16(1).u16(0).f64s(&[0.0, value, 0.0]);
            let words = writer.finish();
            let flaw = decode_point(Registers::new(&words, WordOrder::Big), 1, 1.0);
            assert!(matches!(flaw, Err(RecordError::NotFinite { field, .. }) if field.contains("point 3")));
        }
    }

    proptest! {
        #[test]
        fn registers_decode_never_panics(words in prop::collection::vec(any::<u16>(), 0..70), at in 0_usize..80) {
            let registers = Registers::new(&words, WordOrder::Little);
            let _ = (registers.u32(at), registers.f64(at), registers.text(at, 16), registers.identity(at));
            let _ = decode_point(registers, 1, 1.0);
            let _ = decode_pass_record(registers);
        }

        #[test]
        fn values_round_trip_both_word_orders(whole in any::<u32>(), bits in any::<u64>()) {
            for order in [WordOrder::Big, WordOrder::Little] {
                let mut writer = Writer::new(order);
                writer.u32(whole).f64(f64::from_bits(bits));
                let words = writer.finish();
                let back = Registers::new(&words, order);
                prop_assert_eq!(back.u32(0), whole);
                prop_assert_eq!(back.f64(2).to_bits(), bits);
            }
        }
    }
}
