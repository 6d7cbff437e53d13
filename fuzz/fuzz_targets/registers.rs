#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| regrind::device::any_registers(bytes));
