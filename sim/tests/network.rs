//! Links, loops and the path of frames: line, tree and ring, whole, broken and healed.

use crate::common::*;
use ecaxis_esi::model::Device;
use ecaxis_sim::frame::{self, FrameBuilder};
use ecaxis_sim::network::topology::media;
use ecaxis_sim::{
    FaultScript, FrameOutcome, Nic, SecondPort, Segment, SegmentOptions, SimDevice, Topology,
};

const MS: u64 = 1_000_000;

fn with_physics(physics: &str) -> SimDevice {
    sim(&Device {
        physics: physics.into(),
        ..coe_device()
    })
}

fn bus(physics: &[&str]) -> Bus {
    Bus::new(physics.iter().map(|p| with_physics(p)).collect())
}

fn ring(n: usize, second: SecondPort) -> Segment {
    let devices: Vec<SimDevice> = (0..n).map(|_| with_physics("YY")).collect();
    let media = media(&devices);
    let topology = Topology::by_order(&media).unwrap();
    let topology = topology.closed(&media, second).unwrap();
    Segment::with_topology(devices, topology, SegmentOptions::default())
}

fn faults(bus: &mut Bus, script: &str) {
    bus.segment.set_faults(FaultScript::parse(script).unwrap());
}

/// Returns the number of devices that a broadcast reaches; `None` if it does not come back.
fn count(bus: &mut Bus) -> Option<u16> {
    let bytes = FrameBuilder::default().datagram(7, 0, 0, &[0]).build();
    let bytes = bus.frame(bytes)?;
    Some(frame::next(&bytes, None).unwrap().wkc(&bytes))
}

/// Returns register contents from the device's side, reachable or not.
fn register(bus: &Bus, device: usize, at: u16, len: u16) -> Vec<u8> {
    let device = bus.segment.device(device).unwrap();
    device.registers(at, len).to_vec()
}

/// Returns loop and communication of each port, 0x0111.
fn loops(bus: &Bus, device: usize) -> u8 {
    register(bus, device, 0x111, 1)[0]
}

fn lost_links(bus: &Bus, device: usize) -> Vec<u8> {
    register(bus, device, 0x310, 4)
}

#[test]
fn dl_status_shows_link_and_loop_of_each_port() {
    // Data sheet section II, table 2: two bits a port, 01 closed without link, 10 open with link.
    let mut line = bus(&["YY", "YY", "YY"]);
    line.address_all();
    let status = |bus: &mut Bus, station| bus.read_u16(station, 0x110);
    assert_eq!(status(&mut line, 0x1001), 0x5a33);
    assert_eq!(status(&mut line, 0x1002), 0x5a33);
    assert_eq!(status(&mut line, 0x1003), 0x5613);
    // Coupler, terminal, drive at the second socket: ports 0, 1 and 2 of the coupler.
    let mut tree = bus(&["YKY", "KK", "YY"]);
    tree.address_all();
    assert_eq!(status(&mut tree, 0x1001), 0x6a73);
    assert_eq!(status(&mut tree, 0x1002), 0x5613);
    assert_eq!(status(&mut tree, 0x1003), 0x5613);
}

#[test]
fn frames_reach_devices_in_processing_order() {
    // Star of a four-port device: branches at ports 3, 1 and 2, the first of them two devices deep.
    let devices = ["YYYY", "YY", "YY", "YY", "YY"].map(with_physics);
    let media = media(&devices);
    let request = |after, port| {
        Some(ecaxis_sim::PortRequest {
            after,
            port,
            shared: false,
        })
    };
    let requests = [
        None,
        request(0, Some(3)),
        request(1, None),
        request(0, Some(1)),
        request(0, Some(2)),
    ];
    let topology = Topology::connect(&media, &requests).unwrap();
    let segment = Segment::with_topology(devices.to_vec(), topology, SegmentOptions::default());
    let mut bus = Bus::over(segment);
    assert_eq!(bus.address_all(), 5);
    for n in 0..5_u16 {
        let device = bus.segment.device(usize::from(n)).unwrap();
        assert_eq!(device.station_address(), 0x1001 + n);
    }
    // All four ports of the centre are open with a link.
    assert_eq!(loops(&bus, 0), 0xaa);
}

#[test]
fn broken_link_ends_the_line_until_it_heals() {
    let mut bus = bus(&["YY"; 4]);
    bus.address_all();
    bus.write(0x1002, 0x200, &[0x04, 0]);
    faults(
        &mut bus,
        "[[fault]]\nat = \"10ms\"\nfor = \"10ms\"\nkind = \"link-break\"\ndevice = 2\n",
    );
    assert_eq!(count(&mut bus), Some(4));
    // The event has been pending since the links came up.
    assert_eq!(bus.read_u16(0x1002, 0x110), 0x5a33);
    bus.wait(11 * MS);
    assert_eq!(count(&mut bus), Some(2));
    // Both ends detect it, each at its own port, and count it once.
    assert_eq!(loops(&bus, 1), 0x56);
    assert_eq!(loops(&bus, 2), 0x59);
    assert_eq!(lost_links(&bus, 1), [0, 1, 0, 0]);
    assert_eq!(lost_links(&bus, 2), [1, 0, 0, 0]);
    assert_eq!(lost_links(&bus, 0), [0; 4]);
    assert_eq!(lost_links(&bus, 3), [0; 4]);
    // The change sets the event in every frame until DL status is read.
    let event = |bus: &mut Bus| {
        let frame = FrameBuilder::default().datagram(7, 0, 0, &[0]).build();
        let frame = bus.frame(frame).unwrap();
        u16::from_le_bytes([frame[24], frame[25]])
    };
    assert_eq!(event(&mut bus), 0x04);
    assert_eq!(bus.read_u16(0x1002, 0x110), 0x5613);
    assert_eq!(event(&mut bus), 0);
    bus.wait(10 * MS);
    assert_eq!(count(&mut bus), Some(4));
    assert_eq!(loops(&bus, 1), 0x5a);
    assert_eq!(lost_links(&bus, 1), [0, 1, 0, 0]);
    // The device kept its power, and so its station address.
    assert_eq!(bus.read_u16(0x1003, 0x10), 0x1003);
    // Any value clears the counters of all ports.
    bus.write(0x1002, 0x310, &[0x7f]);
    assert_eq!(lost_links(&bus, 1), [0; 4]);
}

#[test]
fn cable_is_identified_by_either_end() {
    for (device, port) in [(1, 0), (0, 1)] {
        let mut bus = bus(&["YY", "YY"]);
        let script =
            format!("[[fault]]\nkind = \"link-break\"\ndevice = {device}\nport = {port}\n");
        faults(&mut bus, &script);
        assert_eq!(count(&mut bus), Some(1), "device {device} port {port}");
    }
}

#[test]
fn cut_branch_leaves_the_others_reachable() {
    let mut bus = bus(&["YKY", "KK", "KK", "YY", "YY"]);
    bus.address_all();
    assert!(bus.segment.plug(1, 0, false));
    assert_eq!(count(&mut bus), Some(3));
    assert_eq!(bus.read_u16(0x1004, 0x10), 0x1004);
    assert!(bus.segment.plug(1, 0, true));
    assert!(bus.segment.plug(0, 2, false));
    assert_eq!(count(&mut bus), Some(3));
    assert_eq!(bus.read_u16(0x1003, 0x10), 0x1003);
    assert!(!bus.segment.plug(0, 3, false), "no cable there");
}

#[test]
fn device_returns_in_init_after_power_loss() {
    let mut bus = bus(&["YY"; 3]);
    bus.address_all();
    bus.preop(0x1002);
    bus.preop(0x1003);
    faults(
        &mut bus,
        "[[fault]]\nat = \"10ms\"\nfor = \"10ms\"\nkind = \"absent\"\ndevice = 1\n",
    );
    bus.wait(15 * MS);
    assert_eq!(count(&mut bus), Some(1));
    assert_eq!(lost_links(&bus, 0), [0, 1, 0, 0]);
    assert_eq!(lost_links(&bus, 2), [1, 0, 0, 0]);
    bus.wait(10 * MS);
    assert_eq!(count(&mut bus), Some(3));
    // Registers have their power-on values and the EEPROM is loaded again. Its neighbour saw only
    // the lost link.
    let fresh = bus.segment.device(1).unwrap();
    assert_eq!(fresh.station_address(), 0);
    assert_eq!(fresh.al_state(), ecaxis_sim::AlState::Init);
    assert_eq!(lost_links(&bus, 1), [0; 4]);
    assert_eq!(loops(&bus, 1), 0x5a);
    assert_eq!(bus.read_u16(0x1003, 0x130), u16::from(PREOP));
}

#[test]
fn e_bus_powers_the_devices_behind_it() {
    let mut bus = bus(&["YKY", "KK", "YY"]);
    bus.address_all();
    bus.segment.power(0, false);
    bus.segment.power(0, true);
    let stations: Vec<u16> = (0..3)
        .map(|n| bus.segment.device(n).unwrap().station_address())
        .collect();
    // The drive at the second socket has its own supply.
    assert_eq!(stations, [0, 0, 0x1003]);
}

#[test]
fn unplugged_main_device_counts_as_lost_link_of_the_first_device() {
    let mut bus = bus(&["YY", "YY"]);
    faults(
        &mut bus,
        "[[fault]]\nat = \"1ms\"\nfor = \"1ms\"\nkind = \"silent\"\n",
    );
    assert_eq!(count(&mut bus), Some(2));
    bus.wait(MS);
    assert_eq!(count(&mut bus), None);
    assert_eq!(loops(&bus, 0), 0x59);
    bus.wait(MS);
    assert_eq!(count(&mut bus), Some(2));
    assert_eq!(lost_links(&bus, 0), [1, 0, 0, 0]);
}

#[test]
fn swapped_device_takes_the_position() {
    let mut bus = bus(&["YY"; 3]);
    bus.address_all();
    let old = bus.segment.swap(1, sim(&io_device())).unwrap();
    assert_eq!(old.name(), "COE");
    assert_eq!(bus.segment.device(1).unwrap().name(), "IO16");
    assert_eq!(count(&mut bus), Some(3));
    assert_eq!(bus.read(0x1003, 0x310, 4), [1, 0, 0, 0]);
    // A device without a second socket ends the line.
    bus.segment.swap(1, with_physics("Y"));
    assert_eq!(count(&mut bus), Some(2));
    bus.segment.swap(1, old);
    assert_eq!(count(&mut bus), Some(3));
    assert_eq!(lost_links(&bus, 0), [0, 3, 0, 0]);
    assert!(bus.segment.swap(3, sim(&io_device())).is_none());
}

#[test]
fn closed_loop_cuts_the_line_until_auto() {
    let mut bus = bus(&["YY"; 3]);
    bus.address_all();
    // Port 1 closed.
    bus.write(0x1001, 0x101, &[0x0c]);
    assert_eq!(count(&mut bus), Some(1));
    // The link stays: closed, with communication.
    assert_eq!(register(&bus, 0, 0x110, 2), [0x33, 0x5e]);
    bus.write(0x1001, 0x101, &[0x00]);
    assert_eq!(count(&mut bus), Some(3));
    assert_eq!(lost_links(&bus, 0), [0; 4]);
}

#[test]
fn loop_setting_takes_effect_after_the_frame() {
    let mut bus = bus(&["YY"; 3]);
    let close = FrameBuilder::default()
        .datagram(2, 0, 0x101, &[0x0c])
        .datagram(7, 0, 0x111, &[0])
        .build();
    let bytes = bus.frame(close).unwrap();
    let first = frame::next(&bytes, None).unwrap();
    let second = frame::next(&bytes, Some(&first)).unwrap();
    assert_eq!(second.wkc(&bytes), 3);
    assert_eq!(count(&mut bus), Some(1));
}

#[test]
fn open_port_without_a_link_loses_frames() {
    let mut bus = bus(&["YY"; 2]);
    bus.address_all();
    assert_eq!(bus.datagram(5, 0x1002, 0x101, &[0x08]).1, 1);
    assert_eq!(count(&mut bus), None);
    assert_eq!(loops(&bus, 1), 0x52);
}

#[test]
fn temporary_loop_settings_last_one_second() {
    let mut bus = bus(&["YY"; 2]);
    bus.address_all();
    // Bit 1: temporary. Port 1 of the last device is open without a link.
    bus.write(0x1002, 0x100, &[0x03, 0x08]);
    assert_eq!(count(&mut bus), None);
    bus.wait(900 * MS);
    assert_eq!(count(&mut bus), None);
    bus.wait(200 * MS);
    assert_eq!(count(&mut bus), Some(2));
    assert_eq!(register(&bus, 1, 0x100, 2), [0x01, 0x00]);
    // A second temporary setting does not change the setting that is restored.
    bus.write(0x1001, 0x100, &[0x03, 0x0c]);
    bus.write(0x1001, 0x100, &[0x03, 0x0c]);
    bus.wait(1_100 * MS);
    assert_eq!(count(&mut bus), Some(2));
}

#[test]
fn auto_close_waits_for_a_command() {
    let mut bus = bus(&["YY"; 2]);
    bus.address_all();
    bus.write(0x1001, 0x101, &[0x04]);
    assert_eq!(count(&mut bus), Some(2));
    bus.segment.plug(1, 0, false);
    bus.segment.plug(1, 0, true);
    assert_eq!(lost_links(&bus, 0), [0, 1, 0, 0]);
    assert_eq!(count(&mut bus), Some(1));
    assert_eq!(register(&bus, 0, 0x110, 2), [0x33, 0x5e]);
    // A lost link at a waiting port is not counted.
    bus.segment.plug(1, 0, false);
    bus.segment.plug(1, 0, true);
    assert_eq!(lost_links(&bus, 0), [0, 1, 0, 0]);
    bus.write(0x1001, 0x101, &[0x04]);
    assert_eq!(count(&mut bus), Some(2));
}

#[test]
fn auto_close_port_opens_on_a_frame() {
    let mut bus = bus(&["YY"; 3]);
    bus.address_all();
    // Port 0 of the second device.
    bus.write(0x1002, 0x101, &[0x01]);
    bus.segment.plug(1, 0, false);
    bus.segment.plug(1, 0, true);
    // The port drops the first frame and opens for the next.
    assert_eq!(count(&mut bus), None);
    assert_eq!(count(&mut bus), Some(3));
}

#[test]
fn port_0_stays_reachable_with_every_loop_closed() {
    let mut bus = bus(&["YY"; 2]);
    bus.address_all();
    bus.write(0x1001, 0x101, &[0xff]);
    assert_eq!(loops(&bus, 0), 0x5f);
    assert_eq!(count(&mut bus), Some(1));
    bus.write(0x1001, 0x101, &[0x00]);
    assert_eq!(count(&mut bus), Some(2));
}

#[test]
fn other_protocols_are_dropped_unless_enabled() {
    let mut bus = bus(&["YY"; 2]);
    bus.address_all();
    let arp = || {
        let mut bytes = vec![0x10; 60];
        bytes[12..14].copy_from_slice(&[0x08, 0x06]);
        bytes
    };
    assert_eq!(bus.frame(arp()), None);
    bus.write(0x1001, 0x100, &[0]);
    assert_eq!(bus.frame(arp()), None, "the second device destroys it");
    bus.write(0x1002, 0x100, &[0]);
    // The source address is not marked either.
    assert_eq!(bus.frame(arp()), Some(arp()));
    let frame = FrameBuilder::default().datagram(7, 0, 0, &[0]).build();
    assert_eq!(bus.frame(frame).unwrap()[6], 0x10);
}

#[test]
fn malformed_frames_pass_and_are_counted() {
    let mut bus = bus(&["YY"; 2]);
    bus.address_all();
    let mut bytes = FrameBuilder::default().datagram(7, 0, 0, &[0]).build();
    bytes[22] = 0xff;
    let sent = bytes.clone();
    assert_eq!(bus.frame(bytes).unwrap()[7..], sent[7..]);
    assert_eq!(bus.read(0x1002, 0x30c, 1), [1]);
    bus.write(0x1002, 0x30c, &[0]);
    assert_eq!(bus.read(0x1002, 0x30c, 1), [0]);
}

fn send(segment: &mut Segment, nic: Nic, now: u64) -> (FrameOutcome, u16, bool) {
    let mut bytes = FrameBuilder::default()
        .datagram(7, 0, 0x130, &[0; 2])
        .build();
    let transit = segment.transit_from(nic, &mut bytes, now);
    let datagram = frame::next(&bytes, None).unwrap();
    (transit, datagram.wkc(&bytes), bytes[23] & 0x40 != 0)
}

fn back_at(transit: FrameOutcome) -> Option<Nic> {
    match transit {
        FrameOutcome::Back { nic, .. } => Some(nic),
        FrameOutcome::Lost => None,
    }
}

#[test]
fn whole_ring_carries_frames_from_port_to_port() {
    let mut segment = ring(4, SecondPort::Listens);
    let (transit, wkc, _) = send(&mut segment, Nic::Primary, 0);
    assert_eq!((back_at(transit), wkc), (Some(Nic::Secondary), 4));
    // In the other direction no frame passes a processing unit.
    let (transit, wkc, _) = send(&mut segment, Nic::Secondary, 0);
    assert_eq!((back_at(transit), wkc), (Some(Nic::Primary), 0));
    // Only the ports that do not exist are closed.
    let last = segment.device(3).unwrap().registers(0x111, 1);
    assert_eq!(last, [0x5a]);
}

#[test]
fn broken_ring_reaches_every_device_from_one_side() {
    for broken in 0..=4_usize {
        let mut segment = ring(4, SecondPort::Listens);
        if broken == 4 {
            segment.plug(3, 1, false);
        } else {
            segment.plug(broken, 0, false);
        }
        let (first, reached, circulating) = send(&mut segment, Nic::Primary, 0);
        let (second, others, marked) = send(&mut segment, Nic::Secondary, 0);
        let expected = |n: usize, nic| (n > 0).then_some(nic);
        assert_eq!(back_at(first), expected(broken, Nic::Primary), "{broken}");
        assert_eq!(
            back_at(second),
            expected(4 - broken, Nic::Secondary),
            "{broken}"
        );
        assert_eq!(usize::from(reached), broken);
        assert_eq!(usize::from(others), 4 - broken);
        // Beyond the break the first device has lost its port 0 and marks passing frames.
        assert!(!circulating);
        assert_eq!(marked, broken < 4);
    }
}

/// ESC data sheet, section I, 3: a port without link closes its loop, so a broken ring is two
/// lines.
#[test]
fn a_fault_script_breaks_the_closing_cable_of_a_ring() {
    let script = "[[fault]]\nat = '1ms'\nfor = '1ms'\nkind = 'link-break'\ndevice = 3\nport = 1";
    let script = FaultScript::parse(script).unwrap();
    let mut segment = ring(4, SecondPort::Listens);
    assert_eq!(script.check(segment.topology()), Ok(()));
    let line = Topology::by_order(&media(&vec![with_physics("YY"); 4])).unwrap();
    assert!(script.check(&line).is_err());
    segment.set_faults(script);
    let mut reached = |now| {
        let (first, all, _) = send(&mut segment, Nic::Primary, now);
        (back_at(first), all)
    };
    assert_eq!(reached(0), (Some(Nic::Secondary), 4));
    assert_eq!(reached(3 * MS / 2), (Some(Nic::Primary), 4));
    assert_eq!(reached(3 * MS), (Some(Nic::Secondary), 4));
}

#[test]
fn circulating_frame_is_destroyed() {
    let mut segment = ring(2, SecondPort::Listens);
    segment.plug(0, 0, false);
    let mut bytes = FrameBuilder::default()
        .datagram(7, 0, 0x130, &[0; 2])
        .build();
    let once = segment.transit_from(Nic::Secondary, &mut bytes, 0);
    assert_eq!(back_at(once), Some(Nic::Secondary));
    let again = segment.transit_from(Nic::Secondary, &mut bytes, 0);
    assert_eq!(again, FrameOutcome::Lost);
    let datagram = frame::next(&bytes, None).unwrap();
    assert_eq!(datagram.wkc(&bytes), 2, "processed once only");
}

#[test]
fn reflecting_ring_behaves_like_a_line() {
    let mut segment = ring(3, SecondPort::Reflects);
    let (transit, wkc, _) = send(&mut segment, Nic::Primary, 0);
    assert_eq!((back_at(transit), wkc), (Some(Nic::Primary), 3));
    segment.plug(2, 1, false);
    let (transit, wkc, _) = send(&mut segment, Nic::Primary, 0);
    assert_eq!((back_at(transit), wkc), (Some(Nic::Primary), 3));
    // A break in front of the first device cuts off all devices: a reflecting second port sends no
    // frames.
    assert_eq!(send(&mut segment, Nic::Secondary, 0).0, FrameOutcome::Lost);
    segment.plug(2, 1, true);
    segment.plug(0, 0, false);
    assert_eq!(send(&mut segment, Nic::Primary, 0).0, FrameOutcome::Lost);
}
