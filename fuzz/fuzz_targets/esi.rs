//! An ESI file and everything derived from it: choices, layouts, start-up lists, EEPROM images.
#![no_main]

#[path = "../../esi/tests/fuzz/walk.rs"]
mod walk;

use libfuzzer_sys::fuzz_target;
use walk::{Reached, walk};

fuzz_target!(|xml: &[u8]| walk(xml, &mut Reached::default()));
