//! Everything that was found, as it is printed, written as JSON or drawn.

use hdrhistogram::Histogram;
use serde::Serialize;

use super::Counted;
use super::clocks::Clocks;
use super::cycle::{Cycle, Group, Key};
use super::events::{Event, Of, What};
use super::mailbox::{Ended, Way};
use super::segment::{Device, Segment};
use super::values::value;
use crate::bringup::AlState;
use crate::mailbox::object_name;
use crate::recording::frame::Carrier;

mod trouble;

/// Transfers that are listed; they are counted beyond.
const TRANSFERS: usize = 20_000;
/// Lines that are looked back for one that says the same.
const TOGETHER: usize = 256;
/// A cycle this much longer than usual has left one out.
const GAP: f64 = 1.5;

/// A recording in words and numbers.
#[derive(Debug, Serialize)]
pub struct Report {
    pub file: FileReport,
    /// What went wrong, the worst first.
    pub trouble: Vec<String>,
    /// Devices that answered a broadcast read, at most.
    pub answering: Option<u16>,
    pub devices: Vec<DeviceReport>,
    /// What happened, in order: changes of state, refusals, emergencies.
    pub story: Vec<Line>,
    /// Likewise, with every transfer.
    pub events: Vec<Line>,
    pub more_events: u64,
    pub transfers: Vec<TransferReport>,
    pub more_transfers: u64,
    pub cycle: Vec<CycleReport>,
    pub clocks: ClocksReport,
    pub axes: Vec<AxisReport>,
}

#[derive(Debug, Serialize)]
pub struct FileReport {
    pub packets: u64,
    pub ethercat_frames: u64,
    pub other_packets: u64,
    /// When the first EtherCAT frame passed, nanoseconds since 1970.
    pub began_ns: u64,
    pub seconds: f64,
    pub sent: u64,
    pub answered: u64,
    pub lost: u64,
    /// Answers whose request is not in the recording.
    pub without_request: u64,
    /// Requests that the recording's end cut off from their answer.
    pub open: u64,
    /// What is odd about the file itself.
    pub remarks: Vec<String>,
}

#[derive(Debug, Serialize)]
pub struct DeviceReport {
    pub position: Option<u16>,
    pub station: Option<u16>,
    pub alias: Option<u16>,
    /// By machine file, ESI, EEPROM or 0x1008, whatever there is first.
    pub name: Option<String>,
    pub vendor: Option<u32>,
    pub product: Option<u32>,
    pub revision: Option<u32>,
    pub serial: Option<u32>,
    /// States in the order in which they were reached.
    pub states: Vec<String>,
    /// The last one.
    pub state: Option<String>,
    pub al_error: bool,
    pub al_code: Option<u16>,
    /// Bytes of process data from and to the MainDevice.
    pub output_bytes: u32,
    pub input_bytes: u32,
    pub sync_managers: Vec<SyncManagerReport>,
    pub fmmus: usize,
    /// SYNC0's cycle where it is started, nanoseconds.
    pub sync0_ns: Option<u32>,
    pub eeprom_words: usize,
    /// Error counters that are not 0: what is counted and how often.
    pub errors: Vec<(String, u8)>,
    pub reads: u64,
    pub writes: u64,
    pub failed_transfers: u64,
    pub emergencies: u64,
}

#[derive(Debug, Serialize)]
pub struct SyncManagerReport {
    pub number: u8,
    pub start: u16,
    pub len: u16,
    /// `mailbox out`, `mailbox in`, `outputs` or `inputs`.
    pub usage: &'static str,
}

/// One line of the story.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Line {
    /// Seconds since the first frame.
    pub at: f64,
    /// Empty: the bus.
    pub devices: Vec<usize>,
    pub text: String,
    pub trouble: bool,
    /// How often in a row.
    pub times: u32,
}

#[derive(Debug, Serialize)]
pub struct TransferReport {
    pub at: f64,
    pub device: usize,
    pub took_ns: u64,
    pub write: bool,
    pub index: u16,
    pub sub: u8,
    pub complete: bool,
    pub name: Option<String>,
    pub bytes: usize,
    pub segments: u32,
    pub value: String,
    /// `done`, `aborted`, `refused` or `no answer`.
    pub ended: &'static str,
    pub code: Option<u32>,
}

/// One datagram of the cycle.
#[derive(Debug, Serialize)]
pub struct CycleReport {
    pub command: &'static str,
    pub logical_address: u32,
    pub bytes: usize,
    pub count: u64,
    pub lost: u64,
    /// The interval that is usual.
    pub cycle_ns: u64,
    pub interval_min_ns: u64,
    pub interval_p1_ns: u64,
    pub interval_p99_ns: u64,
    pub interval_max_ns: u64,
    /// Intervals in which at least one cycle was left out: when they ended, and how long they were.
    pub gaps: Vec<(f64, u64)>,
    pub round_trip_p50_ns: Option<u64>,
    pub round_trip_max_ns: Option<u64>,
    pub usual_wkc: Option<u16>,
    /// How many answers had which working counter.
    pub wkc: Vec<(u16, u64)>,
    /// When it changed.
    pub runs: Vec<WkcRun>,
    pub more_runs: u64,
}

/// Cycles in a row with one working counter; none where there was no answer.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct WkcRun {
    pub at: f64,
    pub wkc: Option<u16>,
    pub cycles: u64,
}

#[derive(Debug, Serialize)]
pub struct ClocksReport {
    /// Station of the clock whose time is distributed.
    pub reference: Option<u16>,
    pub readings: u64,
    pub rate_ppm: Option<f64>,
    /// How much intervals of the reference clock differ from those of the recording.
    pub jitter_p50_ns: Option<u64>,
    pub jitter_p99_ns: Option<u64>,
    pub differences: Vec<ClockReport>,
}

/// System time differences of a device, without sign but for the last.
#[derive(Debug, Serialize)]
pub struct ClockReport {
    pub station: u16,
    pub readings: u64,
    pub p50_ns: u64,
    pub p99_ns: u64,
    pub max_ns: u64,
    pub last_ns: i64,
}

#[derive(Debug, Serialize)]
pub struct AxisReport {
    pub device: usize,
    pub name: String,
    pub cycles: u64,
    /// When which CiA 402 state began.
    pub states: Vec<(f64, String)>,
    pub modes: Vec<(f64, String)>,
    pub error_code: Option<u16>,
    /// Of positions: counts, or the machine file's unit.
    pub unit: String,
    /// Greatest distance between target and actual position in CSP while Operation enabled.
    pub largest_following_error: Option<f64>,
    pub travelled: Option<(f64, f64)>,
    pub plots: Vec<Plot>,
}

/// Two curves that belong together: target and actual.
#[derive(Debug, Serialize)]
pub struct Plot {
    pub title: &'static str,
    pub unit: String,
    /// Seconds, least, greatest.
    pub target: Vec<(f64, f64, f64)>,
    pub actual: Vec<(f64, f64, f64)>,
}

/// Seconds since the recording's first frame.
struct Since(u64);

impl Since {
    fn seconds(&self, at: u64) -> f64 {
        at.saturating_sub(self.0) as f64 / 1e9
    }
}

pub(super) fn report(remarks: Vec<String>, counted: &Counted, mut segment: Segment) -> Report {
    let since = Since(counted.first.unwrap_or(0));
    // As they are cabled, as far as that is known.
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
            .filter(|event| event.of == Of::Device(*n));
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
        trouble: Vec::new(),
        answering: segment.answering,
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
    report.trouble = trouble::of(&report);
    report
}

fn file(mut remarks: Vec<String>, counted: &Counted, segment: &Segment) -> FileReport {
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
            Carrier::Ethernet => {}
            Carrier::Vlan(vlan) => remarks.push(format!("frames carry the tag of VLAN {vlan}")),
            Carrier::Udp => remarks.push("frames are carried in UDP".to_owned()),
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
    known: &mut super::Known,
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
    // Cyclic operation of SYNC0 is bit 1 of what activates it.
    let sync0 = configuration
        .u8(0x0981)
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
        sync0_ns: configuration.u32(0x09a0).filter(|ns| sync0 && *ns > 0),
        eeprom_words: eeprom.words(),
        errors: errors(device),
        reads: 0,
        writes: 0,
        failed_transfers: 0,
        emergencies: 0,
    };
    for event in events {
        match &event.what {
            What::Transfer(transfer) => {
                match transfer.way {
                    Way::Read => report.reads += 1,
                    Way::Write => report.writes += 1,
                }
                report.failed_transfers += u64::from(transfer.ended != Ended::Done);
            }
            What::Emergency(_) => report.emergencies += 1,
            _ => {}
        }
    }
    report
}

/// Error counters from 0x0300 on.
fn errors(device: &Device) -> Vec<(String, u8)> {
    let ports = 0..4_u16;
    let of_port = |port: u16| {
        [
            (0x0300 + 2 * port, format!("invalid frames at port {port}")),
            (0x0301 + 2 * port, format!("receive errors at port {port}")),
            (0x0308 + port, format!("errors forwarded to port {port}")),
            (0x0310 + port, format!("links lost at port {port}")),
        ]
    };
    let unit = [
        (0x030c, "errors of the processing unit".to_owned()),
        (0x030d, "errors of the process data interface".to_owned()),
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
            What::Axis { axis: n @ 1.., .. } | What::AxisError { axis: n @ 1.., .. } => {
                format!("axis {n}: ")
            }
            _ => String::new(),
        };
        Line {
            at: since.seconds(event.at),
            devices: match event.of {
                Of::Bus => Vec::new(),
                Of::Device(n) => vec![place(n)],
            },
            text: format!("{axis}{}", event.what),
            trouble: event.what.is_trouble(),
            times: 1,
        }
    };
    events.map(line).collect()
}

/// Lines that say the same of several devices become one: bring-up does everything device by device.
fn together(lines: Vec<Line>) -> Vec<Line> {
    let mut kept: Vec<Line> = Vec::new();
    for line in lines {
        if let Some(last) = kept.last_mut()
            && (&last.text, &last.devices) == (&line.text, &line.devices)
        {
            last.times += 1;
            continue;
        }
        // Back to what was said of the same device, or of the whole bus.
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
    segment: &Segment,
    since: &Since,
    place: impl Fn(usize) -> usize,
) -> (Vec<TransferReport>, u64) {
    let all = segment
        .events
        .iter()
        .filter_map(|event| match (&event.what, event.of) {
            (What::Transfer(transfer), Of::Device(n)) => Some((n, transfer)),
            _ => None,
        });
    let (mut listed, mut more) = (Vec::new(), 0);
    for (n, transfer) in all {
        if listed.len() >= TRANSFERS {
            more += 1;
            continue;
        }
        let names = segment.devices.get(n).map(|device| &device.mailbox.names);
        let told = names.and_then(|names| {
            let own = names.get(&(transfer.index, u16::from(transfer.sub)));
            own.or_else(|| names.get(&(transfer.index, u16::MAX)))
        });
        let standard = object_name(transfer.index, transfer.sub).map(ToOwned::to_owned);
        let (ended, code) = match transfer.ended {
            Ended::Done => ("done", None),
            Ended::Aborted { code, .. } => ("aborted", Some(code)),
            Ended::Refused(code) => ("refused", Some(u32::from(code))),
            Ended::Unanswered => ("no answer", None),
        };
        listed.push(TransferReport {
            at: since.seconds(transfer.began),
            device: place(n),
            took_ns: transfer.ended_at.saturating_sub(transfer.began),
            write: transfer.way == Way::Write,
            index: transfer.index,
            sub: transfer.sub,
            complete: transfer.complete,
            name: standard.or_else(|| told.cloned()),
            bytes: transfer.len,
            segments: transfer.segments,
            value: value(transfer),
            ended,
            code,
        });
    }
    (listed, more)
}

fn cycle(cycle: &Cycle, since: &Since) -> Vec<CycleReport> {
    let mut all: Vec<_> = cycle
        .groups
        .iter()
        .map(|(key, group)| group_report(key, group, since))
        .collect();
    // The one that is there most often tells the cycle.
    all.sort_by(|a, b| {
        b.count
            .cmp(&a.count)
            .then(a.logical_address.cmp(&b.logical_address))
    });
    all
}

fn quantile(histogram: &Histogram<u64>, quantile: f64) -> u64 {
    histogram.value_at_quantile(quantile)
}

fn group_report(key: &Key, group: &Group, since: &Since) -> CycleReport {
    let (command, logical_address, bytes) = *key;
    let cycle_ns = quantile(&group.intervals, 0.5);
    let answered = !group.round_trips.is_empty();
    let mut gaps: Vec<(f64, u64)> = group
        .gaps
        .iter()
        .filter(|(interval, _)| *interval as f64 > GAP * cycle_ns as f64)
        .map(|(interval, at)| (since.seconds(*at), *interval))
        .collect();
    gaps.sort_by(|a, b| b.1.cmp(&a.1));
    CycleReport {
        command: command.name(),
        logical_address,
        bytes,
        count: group.sent,
        lost: group.lost,
        cycle_ns,
        interval_min_ns: group.intervals.min(),
        interval_p1_ns: quantile(&group.intervals, 0.01),
        interval_p99_ns: quantile(&group.intervals, 0.99),
        interval_max_ns: group.intervals.max(),
        gaps,
        round_trip_p50_ns: answered.then(|| quantile(&group.round_trips, 0.5)),
        round_trip_max_ns: answered.then(|| group.round_trips.max()),
        usual_wkc: group.usual(),
        wkc: group
            .counters
            .iter()
            .map(|(wkc, count)| (*wkc, *count))
            .collect(),
        runs: group
            .runs
            .iter()
            .map(|run| WkcRun {
                at: since.seconds(run.at),
                wkc: run.wkc,
                cycles: run.cycles,
            })
            .collect(),
        more_runs: group.more_runs,
    }
}

fn clocks(clocks: &Clocks) -> ClocksReport {
    let reference = clocks.reference.as_ref();
    let jitter = reference
        .map(|r| &r.jitter)
        .filter(|jitter| !jitter.is_empty());
    ClocksReport {
        reference: reference.map(|r| r.station),
        readings: reference.map_or(0, |r| r.readings),
        rate_ppm: reference.and_then(super::clocks::Reference::rate_ppm),
        jitter_p50_ns: jitter.map(|jitter| quantile(jitter, 0.5)),
        jitter_p99_ns: jitter.map(|jitter| quantile(jitter, 0.99)),
        differences: clocks
            .differences
            .iter()
            .map(|(station, d)| ClockReport {
                station: *station,
                readings: d.readings,
                p50_ns: quantile(&d.amounts, 0.5),
                p99_ns: quantile(&d.amounts, 0.99),
                max_ns: d.amounts.max(),
                last_ns: d.last,
            })
            .collect(),
    }
}

/// How a device is called where there is no room for more.
#[must_use]
pub fn called(place: usize, device: &DeviceReport) -> String {
    device
        .name
        .clone()
        .unwrap_or_else(|| format!("device {place}"))
}

fn axes(
    segment: &Segment,
    order: &[usize],
    devices: &[DeviceReport],
    since: &Since,
) -> Vec<AxisReport> {
    let mut reports = Vec::new();
    for (place, (n, told)) in order.iter().zip(devices).enumerate() {
        let Some(device) = segment.devices.get(*n) else {
            continue;
        };
        let known = segment.known.axis(device.position, told.product);
        for axis in device.axes.seen() {
            // The machine file knows the first axis of a device.
            let (scale, unit) = match known.filter(|_| axis.number == 0) {
                Some((scale, unit)) => (Some(scale), unit.clone()),
                None => (None, "counts".to_owned()),
            };
            let position = |counts: f64| {
                let counts_of = ecaxis_axis::units::Counts(counts as i64);
                scale.map_or(counts, |scale| scale.position_to_user(counts_of).0)
            };
            let raw = |value: f64| value;
            let seconds = |at: u64| since.seconds(at);
            let plot = |title,
                        unit: &str,
                        pair: &(super::axes::Curve, super::axes::Curve),
                        to: &dyn Fn(f64) -> f64| {
                let of = |curve: &super::axes::Curve| -> Vec<(f64, f64, f64)> {
                    let points = curve.points.iter().map(|(at, low, high)| {
                        // A direction that is turned round swaps them.
                        let (a, b) = (to(*low), to(*high));
                        (seconds(*at), a.min(b), a.max(b))
                    });
                    points.collect()
                };
                Plot {
                    title,
                    unit: unit.to_owned(),
                    target: of(&pair.0),
                    actual: of(&pair.1),
                }
            };
            let plots = [
                plot("Position", &unit, &axis.position, &position),
                plot("Velocity", "as on the wire", &axis.velocity, &raw),
                plot("Torque", "per mille", &axis.torque, &raw),
            ];
            let name = match axis.number {
                0 => called(place, told),
                number => format!("{} axis {number}", called(place, told)),
            };
            let error = axis.largest_error.map(|error| error as f64);
            reports.push(AxisReport {
                device: place,
                name,
                cycles: axis.cycles,
                states: axis
                    .states
                    .iter()
                    .map(|(at, s)| (seconds(*at), s.to_string()))
                    .collect(),
                modes: axis
                    .modes
                    .iter()
                    .map(|(at, m)| (seconds(*at), m.to_string()))
                    .collect(),
                error_code: axis.error,
                largest_following_error: error
                    .map(|error| scale.map_or(error, |scale| scale.units_of_counts(error).abs())),
                travelled: axis.position.1.range().map(|(low, high)| {
                    let (a, b) = (position(low), position(high));
                    (a.min(b), a.max(b))
                }),
                unit,
                plots: plots
                    .into_iter()
                    .filter(|plot| !plot.target.is_empty() || !plot.actual.is_empty())
                    .collect(),
            });
        }
    }
    reports
}

/// The highest of the states that a device reached.
#[must_use]
pub fn highest(device: &DeviceReport) -> Option<&str> {
    let rank = |name: &&String| {
        [
            AlState::Init,
            AlState::Bootstrap,
            AlState::PreOp,
            AlState::SafeOp,
            AlState::Op,
        ]
        .iter()
        .position(|state| state.to_string() == **name)
    };
    device.states.iter().max_by_key(rank).map(String::as_str)
}
