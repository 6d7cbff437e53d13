//! Additional signal that a cell file requests: the value in its registers, and the cause of a missing value.

use super::protocol::Registers;
use super::settings::{Signal, SignalType, WordOrder};

impl Signal {
    /// Decodes the value of the signal from its registers `words` with the word order `order`, and multiplies it by the
    /// scale of the signal. The result is in the unit of the signal. It may be NaN or infinite.
    pub(super) fn value(&self, words: &[u16], order: WordOrder) -> f64 {
        let block = Registers::new(words, order);
        let kept = match self.kind {
            SignalType::U16 => f64::from(block.u16(0)),
            SignalType::I16 => f64::from(block.i16(0)),
            SignalType::U32 => f64::from(block.u32(0)),
            SignalType::I32 => f64::from(block.i32(0)),
            SignalType::F32 => f64::from(block.f32(0)),
            SignalType::F64 => block.f64(0),
        };
        kept * self.scale
    }

    /// Returns in words the probable cause of a wrong value in the registers `words`:
    ///
    /// - The word order is wrong, if the value is not in range but would be in range in the other word order.
    /// - Otherwise, if the value is not finite, the entry of the signal in the cell file is wrong.
    ///
    /// Returns `None` for a value in range. Also returns `None` for a finite value that is out of range in both word
    /// orders.
    pub(super) fn cause(&self, words: &[u16]) -> Option<String> {
        let is_good = |value: &f64| (self.range[0]..=self.range[1]).contains(value);
        let value = self.value(words, self.word_order);
        let other = self.word_order.with_words_swapped();
        let name = other.name();
        let swapped =
            Some(self.value(words, other)).filter(|swapped| !is_good(&value) && words.len() > 1 && is_good(swapped));
        let hint = swapped.map(|swapped| {
            let unit = &self.unit;
            format!("in the other word order, the value would be {swapped} {unit}, which is inside its range: write word_order = \"{name}\" in the cell file")
        });
        let reads = || {
            format!(
                "the value from register {} is {value}, which is not a finite number: compare address, type, scale and word_order in the cell file with the register list of the machine",
                self.address
            )
        };
        hint.or_else(|| (!value.is_finite()).then(reads))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn signal(kind: SignalType, word_order: WordOrder) -> Signal {
        let (name, unit) = ("part_temperature".into(), "C".into());
        Signal { name, address: 1000, kind, word_order, scale: 1.0, unit, range: [15.0, 25.0] }
    }

    #[test]
    fn signal_cause_names_swapped_words() {
        let float = |value: f32| [(value.to_bits() >> 16) as u16, value.to_bits() as u16];
        let [first, second] = float(20.25);
        let big = signal(SignalType::F32, WordOrder::Big);
        assert_eq!(big.cause(&[first, second]), None);
        let told = big.cause(&[second, first]).unwrap();
        assert!(told.contains("20.25 C") && told.contains("word_order = \"little\""), "{told}");
        let little = signal(SignalType::F32, WordOrder::Little);
        assert!(little.cause(&[first, second]).unwrap().contains("word_order = \"big\""));
        // No number in either order: only the value that the register gives is known.
        let told = big.cause(&[0x7fc0, 0x7fc0]).unwrap();
        assert!(told.contains("register 1000") && told.contains("NaN"), "{told}");
        // Out of range in both orders, and a value of one word.
        assert_eq!(big.cause(&float(40.0)), None);
        assert_eq!(signal(SignalType::I16, WordOrder::Big).cause(&[7]), None);
    }
}
