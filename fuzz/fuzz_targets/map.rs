#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    regrind_testparsers::map(bytes);
});
