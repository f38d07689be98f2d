//! A hostile peer in shared memory whose every act the fuzzer chooses, and when this side acts between them.

#![no_main]

libfuzzer_sys::fuzz_target!(|script: &[u8]| {
    let _ = sinew_shm::hostile::play(script);
});
