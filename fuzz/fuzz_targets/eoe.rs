//! Messages of two devices with EoE to the virtual switch. A message that is understood means the
//! same after it is written and read again.
#![no_main]

use ecaxis_ecat::mailbox::Encode;
use ecaxis_ecat::mailbox::eoe::{Message, Service};
use ecaxis_master::eoe::{EoeNetwork, FRAMES_PER_PORT};
use libfuzzer_sys::fuzz_target;

/// The time between two messages in ns.
const STEP: u64 = 1_000_000;

fn check_round_trip(mailbox: &[u8]) {
    let Ok(message) = Message::parse(mailbox) else {
        return;
    };
    let unwritten = matches!(
        message.service,
        Service::Unknown(_) | Service::Refused(_) | Service::Other
    );
    if unwritten {
        return;
    }
    let mut bytes = Vec::new();
    message.emit(1, u16::MAX, &mut bytes);
    assert_eq!(Message::parse(&bytes), Ok(message));
}

fuzz_target!(|data: &[u8]| {
    let network = EoeNetwork::default();
    network.set_system_offset(Some(1 << 40));
    let ports = ["x", "y"].map(|name| network.add_device(name, true));
    let host = network.add_host("ecat0");
    let (mut rest, mut now) = (data, 0);
    while let [length, after @ ..] = rest {
        let (message, later) = after.split_at(usize::from(*length & 0x7f).min(after.len()));
        rest = later;
        now += STEP;
        check_round_trip(message);
        let port = &ports[usize::from(length >> 7)];
        let _ = port.receive(now, message);
        let _ = port.is_assembling(now);
    }
    let mut waiting = 0;
    while host.next_frame().is_some() {
        waiting += 1;
    }
    assert!(waiting <= 2 * FRAMES_PER_PORT);
    for port in &ports {
        while port.next_frame(now, 0).is_some() {}
    }
});
