//! The format `schemas` of `sinew-formats`, with bytes that libFuzzer selects by code coverage.

#![no_main]

use sinew_formats::Format;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let format = Format::named("schemas").expect("it has this name");
    (format.play)(bytes);
});
