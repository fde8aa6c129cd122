//! Devices, events and transfers of the report, from the segment.

use std::collections::BTreeMap;

use super::process_data::{axes, clocks, cycle};
use super::{
    Absence, DeviceReport, FileReport, LINKS_LOST, Line, Report, SyncManagerReport, TransferReport,
    problems,
};
use crate::analyze::events::{Event, EventKind, EventScope};
use crate::analyze::mailbox::{TransferDirection, TransferOutcome};
use crate::analyze::segment::{Device, RecordedSegment};
use crate::analyze::values::value;
use crate::analyze::{Context, PacketCounts};
use ecaxis_ecat::registers;
use ecaxis_ecat::vendor::vendor_name;
use ecaxis_master::mailbox::object_name;
use ecaxis_master::recording::frame::Encapsulation;

/// The maximum number of listed transfers; further ones are counted.
const TRANSFERS: usize = 20_000;
/// The number of lines searched backwards for an identical one.
const TOGETHER: usize = 256;

/// The time in s since the first frame of the recording.
pub(super) struct Since(u64);

impl Since {
    pub fn seconds(&self, at: u64) -> f64 {
        at.saturating_sub(self.0) as f64 / 1e9
    }
}

pub(in crate::analyze) fn report(
    remarks: Vec<String>,
    counted: &PacketCounts,
    mut segment: RecordedSegment,
) -> Report {
    let since = Since(counted.first.unwrap_or(0));
    // In cabling order, if known.
    let mut order: Vec<usize> = (0..segment.devices.len()).collect();
    order.sort_by_key(|n| {
        let device = segment.devices.get(*n);
        let (position, station) = device.map_or((None, None), |d| (d.position, d.station));
        (position.is_none(), position, station)
    });
    let place = |n: usize| order.iter().position(|m| *m == n).unwrap_or(n);
    let mut devices = Vec::new();
    for n in &order {
        let Some(device) = segment.devices.get(*n) else {
            continue;
        };
        let own = segment
            .events
            .iter()
            .filter(|event| event.of == EventScope::Device(*n));
        devices.push(device_report(device, &mut segment.known, own));
    }
    let (transfers, more_transfers) = transfers(&segment, &since, place);
    let story = lines(
        segment.events.iter().filter(|event| event.what.matters()),
        &since,
        place,
    );
    let mut report = Report {
        file: file(remarks, counted, &segment),
        cause: None,
        trouble: Vec::new(),
        answering: segment.answering,
        absences: absences(&segment.events, &since),
        story: together(story),
        events: lines(segment.events.iter(), &since, place),
        more_events: segment.more_events,
        transfers,
        more_transfers,
        cycle: cycle(&segment.cycle, &since),
        clocks: clocks(&segment.clocks),
        axes: axes(&segment, &order, &devices, &since),
        devices,
    };
    report.trouble = problems::of(&report);
    report.cause = problems::cause(&report);
    report
}

fn absences(events: &[Event], since: &Since) -> Vec<Absence> {
    let mut found: Vec<Absence> = Vec::new();
    let mut all = 0;
    for event in events {
        let EventKind::Answering(count) = event.what else {
            continue;
        };
        let at = since.seconds(event.at);
        let open = found.last_mut().filter(|absence| absence.until.is_none());
        match open {
            Some(absence) if count >= all => absence.until = Some(at),
            Some(absence) => absence.absent = absence.absent.max(all - count),
            None if count < all => found.push(Absence {
                at,
                absent: all - count,
                of: all,
                until: None,
            }),
            None => {}
        }
        all = all.max(count);
    }
    found
}

fn file(mut remarks: Vec<String>, counted: &PacketCounts, segment: &RecordedSegment) -> FileReport {
    let mut remark = |count: u64, text: &str| {
        if count > 0 {
            remarks.push(format!("{count} {text}"));
        }
    };
    remark(counted.other, "packets are not EtherCAT");
    remark(
        counted.other_ethercat,
        "EtherCAT packets carry no datagrams (network variables, mailbox gateway)",
    );
    remark(
        counted.cut,
        "EtherCAT frames are cut: datagrams are missing",
    );
    remark(
        counted.back,
        "frames are recorded before the one in front of them",
    );
    remark(
        segment.cycle.unfollowed,
        "datagrams of further process data were not followed",
    );
    remark(
        segment.unfollowed,
        "datagrams of further devices were not followed",
    );
    if counted.interfaces.len() > 1 {
        let interfaces: Vec<String> = counted.interfaces.iter().map(ToString::to_string).collect();
        remarks.push(format!(
            "EtherCAT on interfaces {}, taken together; `--interface` picks one",
            interfaces.join(", ")
        ));
    }
    for carrier in &counted.carriers {
        match carrier {
            Encapsulation::Ethernet => {}
            Encapsulation::Vlan(vlan) => {
                remarks.push(format!("frames carry the tag of VLAN {vlan}"))
            }
            Encapsulation::Udp => remarks.push("frames are carried in UDP".to_owned()),
        }
    }
    let began = counted.first.unwrap_or(0);
    FileReport {
        packets: counted.packets,
        ethercat_frames: counted.frames,
        other_packets: counted.other + counted.other_ethercat,
        began_ns: began,
        seconds: Since(began).seconds(counted.last),
        sent: segment.sent,
        answered: segment.answered,
        lost: segment.unanswered,
        without_request: segment.unasked,
        open: segment.open,
        remarks,
    }
}

fn device_report<'e>(
    device: &Device,
    known: &mut Context,
    events: impl Iterator<Item = &'e Event>,
) -> DeviceReport {
    let configuration = device.configuration();
    let sync_managers: Vec<SyncManagerReport> = configuration
        .sync_managers()
        .map(|sm| SyncManagerReport {
            number: sm.number,
            start: sm.start,
            len: sm.len,
            usage: match (sm.mailbox, sm.output) {
                (true, true) => "mailbox out",
                (true, false) => "mailbox in",
                (false, true) => "outputs",
                (false, false) => "inputs",
            },
        })
        .collect();
    let bytes = |usage: &str| {
        let all = sync_managers.iter().filter(|sm| sm.usage == usage);
        all.map(|sm| u32::from(sm.len)).sum()
    };
    let (eeprom, objects) = (&device.eeprom, device.objects.identity());
    let vendor = eeprom.vendor().or(objects.0);
    let product = eeprom.product().or(objects.1);
    let revision = eeprom.revision().or(objects.2);
    let by_machine = known.name(device.position, product).map(ToOwned::to_owned);
    let by_esi = match (vendor, product) {
        (Some(vendor), Some(product)) => known.type_name(vendor, product, revision.unwrap_or(0)),
        _ => None,
    };
    // Bit 1 of the activation register enables cyclic SYNC0.
    let sync0 = configuration
        .u8(registers::DC_ACTIVATION)
        .is_some_and(|activation| activation & 2 != 0);
    let mut report = DeviceReport {
        position: device.position,
        station: device.station,
        alias: configuration
            .u16(0x0012)
            .or(eeprom.alias())
            .filter(|alias| *alias != 0),
        name: by_machine
            .or(by_esi)
            .or_else(|| eeprom.name())
            .or_else(|| device.objects.name()),
        vendor,
        vendor_name: vendor.and_then(vendor_name),
        product,
        revision,
        serial: eeprom.serial().or(objects.3),
        states: device.reached.iter().map(ToString::to_string).collect(),
        state: device.state.map(|state| state.to_string()),
        al_error: device.error,
        al_code: device.code,
        output_bytes: bytes("outputs"),
        input_bytes: bytes("inputs"),
        sync_managers,
        fmmus: configuration.fmmus().count(),
        sync0_ns: configuration
            .u32(registers::DC_SYNC0_CYCLE)
            .filter(|ns| sync0 && *ns > 0),
        eeprom_words: eeprom.words(),
        errors: errors(device),
        reads: 0,
        writes: 0,
        failed_transfers: 0,
        emergencies: 0,
        mailbox_messages: mailbox_messages(device),
        al_errors: Vec::new(),
        emergency_codes: Vec::new(),
    };
    for event in events {
        match &event.what {
            EventKind::Transfer(transfer) => {
                match transfer.way {
                    TransferDirection::Read => report.reads += 1,
                    TransferDirection::Write => report.writes += 1,
                }
                report.failed_transfers += u64::from(transfer.ended != TransferOutcome::Done);
            }
            EventKind::Emergency(emergency) => {
                report.emergencies += 1;
                if emergency.is_failure() {
                    once(&mut report.emergency_codes, emergency.code);
                }
            }
            EventKind::State {
                code: Some(code), ..
            }
            | EventKind::Code(code)
                if *code != 0 =>
            {
                once(&mut report.al_errors, *code);
            }
            _ => {}
        }
    }
    report
}

/// Mailbox types (ETG.1000.4, mailbox header).
const PROTOCOLS: [(usize, &str); 7] = [
    (0, "error"),
    (1, "AoE"),
    (2, "EoE"),
    (3, "CoE"),
    (4, "FoE"),
    (5, "SoE"),
    (15, "VoE"),
];

fn mailbox_messages(device: &Device) -> BTreeMap<&'static str, u64> {
    let counted = PROTOCOLS.iter().filter_map(|(number, name)| {
        let count = device.mailbox.messages.get(*number).copied()?;
        (count > 0).then_some((*name, count))
    });
    counted.collect()
}

/// The maximum number of codes of one kind per device.
const CODES: usize = 16;

fn once(codes: &mut Vec<u16>, code: u16) {
    if !codes.contains(&code) && codes.len() < CODES {
        codes.push(code);
    }
}

/// Returns the error counters from 0x0300 on.
fn errors(device: &Device) -> Vec<(String, u8)> {
    let ports = 0..4_u16;
    let of_port = |port: u16| {
        [
            (
                registers::RX_ERROR_COUNTERS + 2 * port,
                format!("invalid frames at port {port}"),
            ),
            (
                registers::RX_ERROR_COUNTERS + 1 + 2 * port,
                format!("receive errors at port {port}"),
            ),
            (
                registers::FORWARDED_ERROR_COUNTERS + port,
                format!("errors forwarded to port {port}"),
            ),
            (
                registers::LOST_LINK_COUNTERS + port,
                format!("{LINKS_LOST}{port}"),
            ),
        ]
    };
    let unit = [
        (
            registers::PROCESSING_UNIT_ERRORS,
            "errors of the processing unit".to_owned(),
        ),
        (
            registers::PDI_ERRORS,
            "errors of the process data interface".to_owned(),
        ),
    ];
    let all = ports.flat_map(of_port).chain(unit);
    let counted = all.filter_map(|(register, what)| Some((what, device.registers.u8(register)?)));
    counted.filter(|(_, count)| *count > 0).collect()
}

fn lines<'e>(
    events: impl Iterator<Item = &'e Event>,
    since: &Since,
    place: impl Fn(usize) -> usize,
) -> Vec<Line> {
    let line = |event: &Event| {
        let axis = match event.what {
            EventKind::Axis { axis: n @ 1.., .. } | EventKind::AxisError { axis: n @ 1.., .. } => {
                format!("axis {n}: ")
            }
            _ => String::new(),
        };
        Line {
            at: since.seconds(event.at),
            devices: match event.of {
                EventScope::Bus => Vec::new(),
                EventScope::Device(n) => vec![place(n)],
            },
            text: format!("{axis}{}", event.what),
            trouble: event.what.is_trouble(),
            times: 1,
        }
    };
    events.map(line).collect()
}

/// Merges identical lines of several devices, because bring-up repeats each action per device.
fn together(lines: Vec<Line>) -> Vec<Line> {
    let mut kept: Vec<Line> = Vec::new();
    for line in lines {
        if let Some(last) = kept.last_mut()
            && (&last.text, &last.devices) == (&line.text, &line.devices)
        {
            last.times += 1;
            continue;
        }
        // Search back to the last line of the same device or of the whole bus.
        let other = |old: &&mut Line| {
            old.devices.is_empty() || line.devices.iter().any(|n| old.devices.contains(n))
        };
        let same = kept
            .iter_mut()
            .rev()
            .take(TOGETHER)
            .take_while(|old| !other(old) && line.at - old.at < 1.0)
            .find(|old| old.text == line.text && old.times == 1);
        match same {
            Some(old) if !line.devices.is_empty() => old.devices.extend(&line.devices),
            _ => kept.push(line),
        }
    }
    for line in &mut kept {
        line.devices.sort_unstable();
    }
    kept
}

fn transfers(
    segment: &RecordedSegment,
    since: &Since,
    place: impl Fn(usize) -> usize,
) -> (Vec<TransferReport>, u64) {
    let all = segment
        .events
        .iter()
        .filter_map(|event| match (&event.what, event.of) {
            (EventKind::Transfer(transfer), EventScope::Device(n)) => Some((n, transfer)),
            _ => None,
        });
    let (mut listed, mut more) = (Vec::new(), 0);
    for (n, transfer) in all {
        if listed.len() >= TRANSFERS {
            more += 1;
            continue;
        }
        let names = segment.devices.get(n).map(|device| &device.mailbox.names);
        let reported = names.and_then(|names| {
            let own = names.get(&(transfer.index, u16::from(transfer.sub)));
            own.or_else(|| names.get(&(transfer.index, u16::MAX)))
        });
        let standard = object_name(transfer.index, transfer.sub).map(ToOwned::to_owned);
        let (ended, code) = match transfer.ended {
            TransferOutcome::Done => ("done", None),
            TransferOutcome::Aborted { code, .. } => ("aborted", Some(code)),
            TransferOutcome::Refused(code) => ("refused", Some(u32::from(code))),
            TransferOutcome::Unanswered => ("no answer", None),
        };
        listed.push(TransferReport {
            at: since.seconds(transfer.began),
            device: place(n),
            took_ns: transfer.ended_at.saturating_sub(transfer.began),
            write: transfer.way == TransferDirection::Write,
            index: transfer.index,
            sub: transfer.sub,
            complete: transfer.complete,
            name: standard.or_else(|| reported.cloned()),
            bytes: transfer.len,
            segments: transfer.segments,
            value: value(transfer),
            ended,
            code,
        });
    }
    (listed, more)
}
