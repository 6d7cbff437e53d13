//! Encoding of values in registers: word order and checksums, implemented independently: an error must not be the same
//! at both ends of the wire.
//!
//! A machine with the low word first also uses that order in its payloads, while the physics behind it reads them high
//! word first. The machine must therefore know the values of more than one register in a payload; the table at the end
//! lists them.

/// Order of the registers of one value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WordOrder {
    /// High word first.
    #[default]
    Big,
    /// Low word first.
    Little,
}

impl WordOrder {
    /// Returns the two registers of a value in this word order.
    pub fn from_u32(self, value: u32) -> [u16; 2] {
        let mut words = [(value >> 16) as u16, value as u16];
        self.turn(&mut words);
        words
    }

    /// Returns the four registers of a value in this word order.
    pub fn from_f64(self, value: f64) -> [u16; 4] {
        let bits = value.to_bits();
        let mut words = [48, 32, 16, 0].map(|shift| (bits >> shift) as u16);
        self.turn(&mut words);
        words
    }

    /// Reads a value from two registers in this word order.
    pub fn to_u32(self, words: [u16; 2]) -> u32 {
        let [high, low] = match self {
            Self::Big => words,
            Self::Little => [words[1], words[0]],
        };
        u32::from(high) << 16 | u32::from(low)
    }

    /// Reads a value from four registers in this word order.
    pub fn to_f64(self, mut words: [u16; 4]) -> f64 {
        self.turn(&mut words);
        f64::from_bits(words.iter().fold(0, |bits, word| bits << 16 | u64::from(*word)))
    }

    fn turn(self, words: &mut [u16]) {
        if self == Self::Little {
            words.reverse();
        }
    }
}

/// Block of registers under construction.
#[derive(Debug)]
pub(crate) struct RegisterBlock {
    order: WordOrder,
    registers: Vec<u16>,
}

impl RegisterBlock {
    pub(crate) fn new(order: WordOrder, length: usize) -> Self {
        Self { order, registers: vec![0; length] }
    }

    pub(crate) fn u16(mut self, offset: usize, value: u16) -> Self {
        self.registers[offset] = value;
        self
    }

    pub(crate) fn u32(self, offset: usize, value: u32) -> Self {
        let words = self.order.from_u32(value);
        self.words(offset, &words)
    }

    pub(crate) fn f64(self, offset: usize, value: f64) -> Self {
        let words = self.order.from_f64(value);
        self.words(offset, &words)
    }

    /// Writes raw bytes into the block, two bytes into each register, from the register with the index `offset` on. The
    /// word order of the block does not change the order of these bytes. If the number of bytes is odd, the low byte of
    /// the last register is 0.
    pub(crate) fn bytes(self, offset: usize, bytes: &[u8]) -> Self {
        self.words(offset, &registers_of(bytes))
    }

    pub(crate) fn words(mut self, offset: usize, words: &[u16]) -> Self {
        self.registers[offset..offset + words.len()].copy_from_slice(words);
        self
    }

    pub(crate) fn done(self) -> Vec<u16> {
        self.registers
    }
}

/// Returns the bytes of registers, the high byte of each register first.
pub fn bytes_of(registers: &[u16]) -> Vec<u8> {
    registers.iter().flat_map(|register| register.to_be_bytes()).collect()
}

/// Packs bytes into registers, two bytes into each register and the high byte first. If the number of bytes is odd, the
/// low byte of the last register is 0.
pub fn registers_of(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair.get(1).copied().unwrap_or(0)])).collect()
}

/// Returns the CRC-16 of Modbus RTU.
pub fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    })
}

/// Converts a payload from one word order to the other, in place: reverses the 16-bit words of each value that has a
/// word order. A second call restores the payload.
///
/// `kind` and `format` are the numbers of the payload's kind and of its record format in docs/modbus.md. `bytes`
/// contains the header and the records of the payload. Bytes after the last complete record do not change. A payload of
/// an unknown kind does not change.
pub fn turn_payload(kind: u16, format: u16, bytes: &mut [u8]) {
    let (header, record) = fields(kind, format);
    let length = header.iter().map(|field| field.unsigned_abs()).sum::<usize>().min(bytes.len());
    let (head, records) = bytes.split_at_mut(length);
    turn_fields(head, header);
    let size: usize = record.iter().map(|field| field.unsigned_abs()).sum();
    if size > 0 {
        records.chunks_exact_mut(size).for_each(|bytes| turn_fields(bytes, record));
    }
}

fn turn_fields(bytes: &mut [u8], fields: &[isize]) {
    let mut rest = bytes;
    for field in fields {
        let Some((value, after)) = rest.split_at_mut_checked(field.unsigned_abs()) else { return };
        if *field > 0 {
            // Reversing the bytes and then each pair reverses the words.
            value.reverse();
            value.chunks_exact_mut(2).for_each(<[u8]>::reverse);
        }
        rest = after;
    }
}

/// Returns the layout of a payload as two lists: the lengths of the values in the header, and the lengths of the values
/// in one record, both in bytes. A negative length marks raw bytes, which have no word order. `kind` and `format` are
/// numbers in docs/modbus.md. Both lists are empty for an unknown kind.
fn fields(kind: u16, format: u16) -> (&'static [isize], &'static [isize]) {
    match (kind, format) {
        (1, _) => (&[2, 2, 4, 8, 8, 8, 8, 8, 4, -4, 8], &[4, 2, 2, 8, 8, 8, 8, 8, 8]),
        (2, _) => (&[2, 2, 4, 4, 4, 8, 8, 8, 8, 8, -8, -32], &[8]),
        (3, _) => (&[2, 2, 4, 8, 8, 8, 8, 8, 8, 8, 8, 8, -16, -32], &[]),
        (4, 2) => (&[], &[4, 2, 2, 4, 4, 4]),
        (4, _) => (&[], &[4, 2, 2, 8, 8, 8]),
        (5, _) => (&[], &[4, 2, 2, 8, 8, 8, 8, 8, 8, 8]),
        _ => (&[], &[]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn word_order_encodes_u32_and_f64() {
        assert_eq!(WordOrder::Big.from_u32(0x1234_5678), [0x1234, 0x5678]);
        assert_eq!(WordOrder::Little.from_u32(0x1234_5678), [0x5678, 0x1234]);
        assert_eq!(WordOrder::Big.from_f64(-2.5e-7), [0xBE90, 0xC6F7, 0xA0B5, 0xED8D]);
        for order in [WordOrder::Big, WordOrder::Little] {
            assert_eq!(order.to_u32(order.from_u32(0xDEAD_BEEF)), 0xDEAD_BEEF);
            assert_eq!(order.to_f64(order.from_f64(-2.5e-7)), -2.5e-7);
        }
    }

    #[test]
    fn crc16_matches_modbus_specification() {
        assert_eq!(crc16(b"123456789"), 0x4B37);
        assert_eq!(crc16(&[]), 0xFFFF);
    }

    #[test]
    fn payload_fields_sum_to_length() {
        let sum = |fields: &[isize]| fields.iter().map(|f| f.unsigned_abs()).sum::<usize>();
        for (kind, format, header, record) in
            [(1, 1, 64, 56), (2, 1, 96, 8), (3, 1, 128, 0), (4, 1, 0, 32), (4, 2, 0, 20), (5, 1, 0, 64)]
        {
            let (h, r) = fields(kind, format);
            assert_eq!((sum(h), sum(r)), (header, record), "kind {kind} format {format}");
        }
    }

    #[test]
    fn turn_payload_twice_is_identity() {
        for (kind, format) in [(1, 1), (2, 1), (3, 1), (4, 1), (4, 2), (5, 1), (9, 1)] {
            for length in [0, 1, 7, 63, 64, 127, 128, 321] {
                let bytes: Vec<u8> = (0..length).map(|i| i as u8).collect();
                let mut turned = bytes.clone();
                turn_payload(kind, format, &mut turned);
                turn_payload(kind, format, &mut turned);
                assert_eq!(turned, bytes, "kind {kind} format {format} length {length}");
            }
        }
    }

    #[test]
    fn turn_payload_swaps_words_not_bytes() {
        let mut bytes: Vec<u8> = (0..20).collect();
        turn_payload(4, 2, &mut bytes);
        assert_eq!(bytes, [2, 3, 0, 1, 4, 5, 6, 7, 10, 11, 8, 9, 14, 15, 12, 13, 18, 19, 16, 17]);
    }
}
