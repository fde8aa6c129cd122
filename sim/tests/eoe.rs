//! Ethernet over EtherCAT of a device (ETG.1000.6 §5.7): IP parameters, results, and the IP host in
//! fragments as bytes of the standard.

use crate::common::*;
use ecaxis_esi::model::Eoe;
use ecaxis_sim::DeviceOptions;

const S: u16 = 0x1001;
const EOE: u8 = 2;
/// Flags of MAC, IP address, subnet mask and gateway, and these.
const PARAMETERS: [u8; 22] = [
    0x0f, 0, 0, 0, 2, 0, 0, 0, 0, 1, 11, 7, 168, 192, 0, 255, 255, 255, 0, 0, 0, 0,
];

fn preop() -> Bus {
    let mut device = coe_device();
    device.mailbox.as_mut().expect("a mailbox").eoe = Some(Eoe::default());
    let mut bus = Bus::new(vec![sim_with(&device, DeviceOptions::default())]);
    bus.address_all();
    bus.preop(S);
    bus
}

fn ask(bus: &mut Bus, header: [u8; 4], data: &[u8]) -> (u8, Vec<u8>) {
    bus.mailbox(S, EOE, &[&header, data].concat())
}

#[test]
fn ip_parameters_are_set_and_read_back() {
    let mut bus = preop();
    assert_eq!(
        ask(&mut bus, [2, 1, 0, 0], &PARAMETERS),
        (EOE, vec![3, 1, 0, 0])
    );
    let read = [&[7, 1, 0, 0], &PARAMETERS[..]].concat();
    assert_eq!(ask(&mut bus, [6, 1, 0, 0], &[]), (EOE, read));
    // An unknown type: a result.
    assert_eq!(ask(&mut bus, [10, 1, 0, 0], &[]), (EOE, vec![11, 1, 2, 0]));
    for (length, what) in [(0, "no header"), (3, "half a header")] {
        let body = &[2, 1, 0, 0][..length];
        assert_eq!(bus.mailbox(S, EOE, body), (0, vec![1, 0, 6, 0]), "{what}");
    }
    let short = ask(&mut bus, [4, 1, 0, 0], &[0; 30]);
    assert_eq!(short, (0, vec![1, 0, 6, 0]), "half a filter");
    let short = ask(&mut bus, [2, 1, 0, 0], &PARAMETERS[..12]);
    assert_eq!(short, (0, vec![1, 0, 6, 0]), "an address that ends early");
}

/// Returns an ARP request for 192.168.7.11.
fn arp() -> Vec<u8> {
    let mut frame = vec![0xff; 6];
    frame.extend([2, 0, 0, 0, 0, 9, 8, 6, 0, 1, 8, 0, 6, 4, 0, 1]);
    frame.extend([2, 0, 0, 0, 0, 9, 192, 168, 7, 1]);
    frame.extend([0, 0, 0, 0, 0, 0, 192, 168, 7, 11]);
    frame
}

/// Sends a frame of at most 64 bytes in fragments of 32 bytes.
fn send(bus: &mut Bus, frame: &[u8]) {
    let (first, last) = frame.split_at(32);
    let units = u16::try_from(frame.len().div_ceil(32)).unwrap();
    for (flags, number, units, data) in [(0, 0, units, first), (1, 1, 1, last)] {
        let [low, high] = (number | units << 6 | 3 << 12_u16).to_le_bytes();
        bus.send_mailbox(S, EOE, &[&[0, flags, low, high], data].concat());
        bus.wait(2_000_000);
    }
}

/// Returns the next frame that the device has sent.
fn receive(bus: &mut Bus) -> Option<Vec<u8>> {
    let mut frame = Vec::new();
    loop {
        bus.wait(2_000_000);
        let (kind, body) = bus.fetch(S)?;
        assert_eq!((kind, body[0]), (EOE, 0), "{body:02x?}");
        let offset = u16::from_le_bytes([body[2], body[3]]) >> 6 & 0x3f;
        if body[2] & 0x3f > 0 {
            assert_eq!(usize::from(offset) * 32, frame.len());
        }
        frame.extend(&body[4..]);
        if body[1] & 1 != 0 {
            return Some(frame);
        }
    }
}

#[test]
fn host_answers_arp_once_it_has_an_address() {
    let mut bus = preop();
    send(&mut bus, &arp());
    assert_eq!(receive(&mut bus), None, "without an address");
    ask(&mut bus, [2, 1, 0, 0], &PARAMETERS);
    send(&mut bus, &arp());
    let answer = receive(&mut bus).expect("an answer");
    assert_eq!(answer[..6], [2, 0, 0, 0, 0, 9]);
    assert_eq!(answer[6..12], [2, 0, 0, 0, 0, 1]);
    assert_eq!(answer[12..14], [8, 6]);
    assert_eq!(answer[28..32], [192, 168, 7, 11]);
    // Requests of other protocols pass between frames.
    assert_eq!(bus.upload(S, 0x2003, 0).unwrap(), [7, 0, 0, 0]);
    // A frame whose second fragment is lost.
    bus.send_mailbox(S, EOE, &[&[0, 0, 0x80, 0x30], &arp()[..32]].concat());
    bus.wait(2_000_000);
    assert_eq!(receive(&mut bus), None);
    send(&mut bus, &arp());
    assert!(receive(&mut bus).is_some());
    // After Init, the device has no address.
    bus.to(S, INIT);
    bus.write(S, 0x806, &[0]);
    bus.write(S, 0x80e, &[0]);
    bus.preop(S);
    send(&mut bus, &arp());
    assert_eq!(receive(&mut bus), None);
}
