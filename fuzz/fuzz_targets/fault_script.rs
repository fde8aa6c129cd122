//! A fault script, run on a bus if it is valid.
#![no_main]

#[path = "../../sim/tests/common/mod.rs"]
mod common;
#[path = "../../sim/tests/common/hostile/mod.rs"]
mod hostile;

use std::cell::RefCell;

use ecaxis_sim::FaultScript;
use hostile::Hostile;
use libfuzzer_sys::fuzz_target;

thread_local! {
    static BUS: RefCell<Hostile> = RefCell::new(Hostile::new(1));
}

fuzz_target!(|text: &str| {
    let Ok(script) = FaultScript::parse(text) else {
        return;
    };
    BUS.with_borrow_mut(|hostile| {
        if script.check(hostile.bus.segment.topology()).is_ok() {
            hostile.rebuild_with(script);
            for _ in 0..50 {
                hostile.attack();
            }
        }
    });
});
