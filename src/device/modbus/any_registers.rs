//! Registers of any content, passed to all code that reads them: for tests and for fuzzing only.

use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use super::link::Link;
use super::machine::ModbusMachine;
use super::protocol::{Registers, decode_outcome, decode_pass_record, decode_point, point_registers};
use super::result_header::MAX_RESULT_BYTES;
use super::settings::{LineAddress, ModbusSettings, WordOrder};
use crate::{Job, MachineKind, Status};

/// Returns a driver for tests. The address of its Modbus line does not exist, and nothing is sent on the line.
fn driver() -> ModbusMachine {
    let settings = ModbusSettings::new(LineAddress::Tcp { host: "nowhere.invalid".into(), port: 502 });
    let link = Link::new(settings.line.clone(), settings.request_timeout, Duration::ZERO).expect("a thread");
    ModbusMachine::new(MachineKind::Cmm, link, settings)
}

/// Decodes arbitrary bytes as a block of registers, to test the decoders. The low seven bits of the first byte select
/// the kind of block. The high bit selects the word order. The other bytes are the content of the registers. Does
/// nothing if `bytes` is empty.
///
/// # Panics
/// Panics if a decoder fails its test: it panics, returns a value that is not finite or out of range, or accepts a
/// result above the maximum size.
pub fn any_registers(bytes: &[u8]) {
    static DRIVER: OnceLock<Mutex<ModbusMachine>> = OnceLock::new();
    let Some((which, bytes)) = bytes.split_first() else { return };
    let order = if which & 0x80 == 0 { WordOrder::Big } else { WordOrder::Little };
    let mut machine = DRIVER.get_or_init(|| Mutex::new(driver())).lock().unwrap_or_else(PoisonError::into_inner);
    machine.unit.map.word_order = order;
    // The line below has checked the length of an answer.
    let sized = |registers: usize| {
        let mut words: Vec<u16> = bytes.as_chunks::<2>().0.iter().map(|pair| u16::from_be_bytes(*pair)).collect();
        words.resize(registers, 0);
        words
    };
    match which & 0x7f {
        0 => drop(machine.unit.decode_identity(&sized(32))),
        1 => {
            if let Ok(block) = machine.decode_status(&sized(48)) {
                let Status { temperature_c, progress, .. } = Status::from(&block);
                assert!(temperature_c.is_none_or(|told| (-40.0..=120.0).contains(&told)));
                assert!(progress.is_none_or(|(done, total)| done <= total));
            }
        }
        2 => assert_header(&machine, &sized(56)),
        3 => assert_points(&sized(16), order),
        4 => {
            if let Ok((.., figures)) = decode_pass_record(Registers::new(&sized(32), order)) {
                assert!(figures.into_iter().all(f64::is_finite));
            }
        }
        _ => drop(decode_outcome(sized(1)[0])),
    }
}

fn assert_header(machine: &ModbusMachine, words: &[u16]) {
    let block = machine.unit.registers(words);
    let job = Job { job: block.u32(6), cycle: words[8], digest: 0 };
    for kind in [4, 5] {
        let Ok(header) = machine.header(words, job, kind, block.u32(46)) else { continue };
        let temperature_c = header.temperature_c.unwrap_or(0.0);
        let told = [header.probe_radius_mm, header.scale_mm, temperature_c, header.duration_s];
        assert!(told.into_iter().all(f64::is_finite) && header.bytes <= MAX_RESULT_BYTES);
        assert_eq!(header.bytes as usize, 2 * header.registers * header.records as usize);
    }
}

fn assert_points(words: &[u16], order: WordOrder) {
    for (format, scale_mm) in [(1, 1.0), (2, 1e-6), (2, f64::MAX)] {
        let size = point_registers(format).unwrap_or_default();
        if let Ok(point) = decode_point(Registers::new(&words[..size], order), format, scale_mm) {
            assert!(point.position_mm.into_iter().all(f64::is_finite));
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Returns blocks as a correct machine has them.
    fn samples() -> Vec<Vec<u8>> {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/registers");
        let mut paths: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        paths.sort();
        paths.iter().map(|path| std::fs::read(path).unwrap()).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn register_block_gives_value_or_error(
            which in any::<prop::sample::Index>(),
            changes in prop::collection::vec((any::<prop::sample::Index>(), prop::sample::select(vec![0, 1, 0x7f, 0x80, 0xf0, 0xff])), 0..5),
            noise in prop::collection::vec(any::<u8>(), 0..130),
        ) {
            let samples = samples();
            let mut block = samples[which.index(samples.len())].clone();
            any_registers(&block);
            for (at, with) in changes {
                let at = at.index(block.len());
                block[at] = with;
            }
            any_registers(&block);
            block[0] ^= 0x80;
            any_registers(&block);
            for which in 0..6 {
                any_registers(&[&[which], &noise[..]].concat());
            }
        }
    }
}
