//! The simulator against captures of real buses. Every recorded request goes to a simulated bus
//! with the same EEPROM contents at the recorded time. Its answer must equal the recorded one.
//! docs/captures.md has the results.

mod buses;
mod compare;
mod image;
mod recording;

use std::collections::BTreeMap;

use crate::common::fixture;
use buses::{BUSES, Bus, Device};
use compare::{Case, EXCUSES, excuse};
use ecaxis_sim::frame::FrameBuilder;
use ecaxis_sim::{DeviceOptions, FrameOutcome, MailboxOptions, Segment, SegmentOptions, SimDevice};
use image::{Objects, Pdos, recorded_bytes, recorded_image};
use recording::{Datagram, FPRD, Recording, datagrams};

/// The time until the simulated firmware finds a request in its mailbox.
const FETCH_NS: u64 = 100_000;
/// The virtual time of the first recorded frame.
const START: u64 = 1_000_000_000;

#[derive(Default)]
struct Tally {
    frames: usize,
    unanswered: usize,
    compared: usize,
    equal: usize,
    excused: [usize; EXCUSES.len()],
    /// Unexplained difference → (first time in ns, count).
    wrong: BTreeMap<String, (u64, usize)>,
}

/// Returns the clock's reading when the capture latched receive times, as an offset to virtual
/// time.
fn clock_offset(recording: &Recording, station: u16) -> u64 {
    let mut latched = 0;
    let mut offset = 0;
    for (at, _, back) in recording.answered() {
        if back.command != FPRD && back.ado == 0x0900 {
            latched = START + at;
        }
        if back.command != FPRD || back.adp != station || back.wkc == 0 {
            continue;
        }
        let value = |bytes: &[u8]| {
            bytes
                .iter()
                .rev()
                .fold(0, |v: u64, b| v << 8 | u64::from(*b))
        };
        match back.ado {
            0x0900 if offset == 0 => offset = value(&back.data[..4]).wrapping_sub(latched),
            0x0918 => offset = value(&back.data).wrapping_sub(latched),
            _ => {}
        }
    }
    offset
}

fn build(device: &Device, recording: &Recording) -> Option<SimDevice> {
    let objects = Objects::recorded(recording, device.station);
    let image = match device.image {
        Some(path) => fixture(path)?,
        None => {
            let known = recorded_bytes(recording, device.station);
            recorded_image(&known, device.pdi_control, &Pdos::recorded(&objects))
        }
    };
    let options = DeviceOptions {
        esc: Some(device.esc),
        clock_offset_ns: clock_offset(recording, device.station),
        state_change_ns: device.firmware_ns.state_change,
        // The recorded firmware reads AL control just before it follows it.
        state_notice_ns: Some(device.firmware_ns.state_change),
        mailbox: MailboxOptions {
            processing_ns: device.firmware_ns.mailbox.saturating_sub(FETCH_NS),
            ..MailboxOptions::default()
        },
        ..DeviceOptions::default()
    };
    let mut sim = SimDevice::from_sii(&image, options).unwrap();
    objects.feed(&mut sim);
    Some(sim)
}

fn replay(bus: &Bus, bytes: &[u8]) -> Option<Tally> {
    let recording = Recording::read(bytes);
    let devices = bus.devices.iter().map(|device| build(device, &recording));
    let devices = devices.collect::<Option<Vec<_>>>()?;
    let mut segment = Segment::new(devices, SegmentOptions::default());
    segment.advance(0);
    for (n, (command, adp, ado, data)) in (1..).zip(bus.before) {
        let frame = FrameBuilder::default().datagram(*command, *adp, *ado, data);
        segment.transit(&mut frame.build(), n * 1_000_000);
    }
    let mut tally = Tally {
        frames: recording.frames,
        ..Tally::default()
    };
    // (recorded, ours), in the order of the requests.
    let mut answers: Vec<(u64, Datagram, Datagram)> = Vec::new();
    for (n, exchange) in recording.exchanges.iter().enumerate() {
        let mut frame = exchange.request.clone();
        let back = segment.transit(&mut frame, START + exchange.at);
        match (&exchange.answer, back) {
            // Ethernet and EtherCAT headers, with the source address marked.
            (Some(recorded), FrameOutcome::Back { .. }) if recorded[..16] == frame[..16] => {
                let pairs = datagrams(recorded).into_iter().zip(datagrams(&frame));
                answers.extend(pairs.map(|(recorded, ours)| (exchange.at, recorded, ours)));
            }
            (None, FrameOutcome::Lost) => tally.unanswered += 1,
            // The recording ended before the answer came.
            (None, _) if n + 1 == recording.exchanges.len() => {}
            (recorded, back) => {
                let what = format!("frame: recorded {recorded:02x?}, ours {back:?}");
                tally.wrong.entry(what).or_insert((exchange.at, 0)).1 += 1;
            }
        }
    }
    let recorded: Vec<Datagram> = answers
        .iter()
        .map(|(_, recorded, _)| recorded.clone())
        .collect();
    for (n, (at, recorded_now, ours)) in answers.iter().enumerate() {
        tally.compared += 1;
        if recorded_now == ours {
            tally.equal += 1;
            continue;
        }
        let after = &recorded[n + 1..];
        let repeated = after
            .iter()
            .take_while(|d| d.same_request(recorded_now))
            .count();
        let case = Case {
            recorded: recorded_now,
            ours,
            later: &after[..repeated],
        };
        match excuse(&case) {
            Some(reason) => tally.excused[reason] += 1,
            None => {
                let what = difference(recorded_now, ours);
                tally.wrong.entry(what).or_insert((*at, 0)).1 += 1;
            }
        }
    }
    Some(tally)
}

/// Describes a difference without the time, so that repetitions can be counted.
fn difference(recorded: &Datagram, ours: &Datagram) -> String {
    let side = |d: &Datagram| {
        let data: Vec<_> = d.data.iter().map(|byte| format!("{byte:02x}")).collect();
        let (adp, len, irq, wkc) = (d.adp, d.len, d.irq, d.wkc);
        let data = data.concat();
        format!("ADP {adp:04x} length {len:04x} irq {irq:04x} wkc {wkc} {data}")
    };
    format!(
        "command {} at 0x{:04x}\n    recorded {}\n    ours     {}",
        recorded.command,
        recorded.ado,
        side(recorded),
        side(ours)
    )
}

/// Returns a row of the table in docs/captures.md.
fn row(bus: &Bus, tally: &Tally) -> String {
    let file = bus.file.rsplit('/').next().unwrap_or_default();
    let file = file.split('.').next().unwrap_or_default();
    let names: Vec<_> = bus.devices.iter().map(|device| device.name).collect();
    let names = if names.is_empty() {
        "nobody".to_owned()
    } else {
        names.join(", ")
    };
    let excused = tally
        .excused
        .iter()
        .zip(EXCUSES)
        .filter(|(count, _)| **count > 0);
    let excused: Vec<_> = excused
        .map(|(count, excuse)| format!("{count} {}", excuse.name))
        .collect();
    let (frames, unanswered) = (tally.frames, tally.unanswered);
    let (compared, equal, excused) = (tally.compared, tally.equal, excused.join(", "));
    format!("| {file} | {names} | {frames} | {unanswered} | {compared} | {equal} | {excused} |")
}

#[test]
fn simulated_buses_answer_like_the_captured_ones() {
    let documented = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/captures.md");
    let documented = std::fs::read_to_string(documented).unwrap();
    let mut excused = [0; EXCUSES.len()];
    let mut wrong = Vec::new();
    for bus in BUSES {
        let Some(bytes) = fixture(&format!("frames/{}", bus.file)) else {
            return;
        };
        let Some(tally) = replay(bus, &bytes) else {
            return;
        };
        let row = row(bus, &tally);
        eprintln!("{row}");
        if !documented.contains(&row) {
            wrong.push(format!("docs/captures.md lacks the row\n  {row}"));
        }
        for (sum, count) in excused.iter_mut().zip(tally.excused) {
            *sum += count;
        }
        let mut found: Vec<_> = tally.wrong.into_iter().collect();
        found.sort_by_key(|(_, (at, _))| *at);
        wrong.extend(found.into_iter().map(|(what, (at, count))| {
            let at = at as f64 / 1e6;
            format!("{}: {count} times from {at:.3} ms on: {what}", bus.file)
        }));
    }
    for (excuse, count) in EXCUSES.iter().zip(excused) {
        if count == 0 {
            wrong.push(format!("nothing is excused by `{}`", excuse.name));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
