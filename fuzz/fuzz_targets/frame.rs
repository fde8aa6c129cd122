//! Frames to a bus in Op, each with its length and the microseconds to wait after it.
#![no_main]

#[path = "../../sim/tests/common/mod.rs"]
mod common;
#[path = "../../sim/tests/common/hostile/mod.rs"]
mod hostile;

use std::cell::RefCell;

use hostile::{Hostile, exchange};
use libfuzzer_sys::fuzz_target;

thread_local! {
    static BUS: RefCell<Hostile> = RefCell::new(Hostile::new(1));
}

fuzz_target!(|data: &[u8]| {
    BUS.with_borrow_mut(|hostile| {
        hostile.rebuild();
        let mut rest = data;
        while let [a, b, c, d, after @ ..] = rest {
            let len = usize::from(u16::from_le_bytes([*a, *b])).min(after.len());
            let (frame, later) = after.split_at(len);
            exchange(&mut hostile.bus.segment, hostile.bus.now, frame);
            hostile.bus.now += u64::from(u16::from_le_bytes([*c, *d])) * 1_000;
            rest = later;
        }
    });
});
