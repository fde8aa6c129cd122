//! Mailbox messages to a drive and to a device that consists mainly of a mailbox.
#![no_main]

#[path = "../../sim/tests/common/mod.rs"]
mod common;
#[path = "../../sim/tests/common/hostile/mod.rs"]
mod hostile;

use std::cell::RefCell;

use ecaxis_sim::frame::FrameBuilder;
use hostile::{Hostile, exchange};
use libfuzzer_sys::fuzz_target;

/// Station and mailbox addresses of the drive and of the other device.
const TARGETS: [(u16, u16, u16); 2] = [(0x1001, 0x1000, 0x1040), (0x1003, 0x1000, 0x1600)];
const LEN: usize = 48;

thread_local! {
    static BUS: RefCell<Hostile> = RefCell::new(Hostile::new(1));
}

fuzz_target!(|data: &[u8]| {
    BUS.with_borrow_mut(|hostile| {
        hostile.rebuild();
        let mut rest = data;
        while let [len, after @ ..] = rest {
            let (message, later) = after.split_at(usize::from(*len).min(after.len()));
            let Some((kind, body)) = message.split_first() else {
                rest = later;
                continue;
            };
            let mut mailbox = vec![0; LEN];
            // With the highest bit of the type byte, the length in the header is wrong.
            let claimed = if kind & 0x80 == 0 { body.len() } else { 0xffff };
            mailbox[..2].copy_from_slice(&(claimed as u16).to_le_bytes());
            mailbox[5] = kind & 0x7f;
            for (to, from) in mailbox[6..].iter_mut().zip(body) {
                *to = *from;
            }
            for (station, out, back) in TARGETS {
                let bus = &mut hostile.bus;
                let request = FrameBuilder::default().datagram(5, station, out, &mailbox);
                exchange(&mut bus.segment, bus.now, &request.build());
                bus.now += 1_000_000;
                let answer = FrameBuilder::default().datagram(4, station, back, &[0; LEN]);
                exchange(&mut bus.segment, bus.now, &answer.build());
            }
            rest = later;
        }
    });
});
