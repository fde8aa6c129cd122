//! An ESI file.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|xml: &[u8]| {
    let _ = ecaxis_esi::parse(xml);
});
