//! An EEPROM image for a simulated device, which then receives arbitrary frames.
#![no_main]

#[path = "../../sim/tests/common/mod.rs"]
mod common;
#[path = "../../sim/tests/common/hostile/mod.rs"]
mod hostile;

use std::cell::RefCell;

use ecaxis_sim::{DeviceOptions, SimDevice};
use hostile::Hostile;
use libfuzzer_sys::fuzz_target;

thread_local! {
    static BUS: RefCell<Hostile> = RefCell::new(Hostile::new(1));
}

fuzz_target!(|image: &[u8]| {
    if let Ok(device) = SimDevice::from_sii(image, DeviceOptions::default()) {
        BUS.with_borrow_mut(|hostile| {
            hostile.replace(0, device);
            for _ in 0..50 {
                hostile.attack();
            }
        });
    }
});
