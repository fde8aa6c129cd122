//! A line of three devices with their evidence; one table row per failure.

use super::*;
use crate::clock::Nanos;
use crate::link::LinkStats;
use crate::post_mortem::DeviceSnapshot;
use crate::post_mortem::cause::about;
use crate::post_mortem::evidence::Stopped;
use crate::post_mortem::snapshot::WatchdogSnapshot;
use crate::rt::bus_monitor::StopCause;
use crate::rt::channel::Event;
use crate::rt::event_log::{Entry, LogEntryKind};
use crate::rt::exchange::ErrorCounters;
use crate::rt::stats::Counters;
use ecaxis_ecat::index::GroupIndex;

const MS: Nanos = 1_000_000;

fn at(position: u16) -> DeviceRef {
    DeviceRef {
        name: format!("a{position}"),
        position,
        station: 0x1000 + position,
    }
}

fn note(cycle: u64, note: LogEntryKind) -> Entry {
    Entry {
        first_cycle: cycle,
        last_cycle: cycle,
        time: cycle * MS,
        note,
    }
}

const STOP: Stopped = Stopped {
    cycle: 1000,
    time: 1000 * MS,
};

/// Returns one entry for consecutive cycles with the same event.
fn cycles(first: u64, last: u64, what: LogEntryKind) -> Entry {
    Entry {
        last_cycle: last,
        ..note(first, what)
    }
}

/// Returns the evidence of a good bus: all devices answer in Op with ports 0 and 1 in use. The
/// machine stopped in cycle 1000.
fn good() -> Evidence {
    let cause = StopCause::LeftOp { al_status: 8 };
    let device = |position: u16| DeviceEvidence {
        at: at(position),
        parent: position
            .checked_sub(1)
            .map(|before| (usize::from(before), 1)),
        grown: ErrorCounters::default(),
        recent: ErrorCounters::default(),
        look: DeviceSnapshot {
            answers: true,
            station: Some(0x1000 + position),
            al_status: Some(8),
            al_code: Some(0),
            dl_status: Some(0x0a30),
            ..DeviceSnapshot::default()
        },
    };
    Evidence {
        cycle_ns: MS,
        notes: vec![note(
            1000,
            LogEntryKind::Event(Event::Stopping { cycle: 1000, cause }),
        )],
        stop: Some(STOP),
        al_status: None,
        counters: Counters::default(),
        link: LinkStats::default(),
        devices: (0..3).map(device).collect(),
    }
}

fn with(change: impl FnOnce(&mut Evidence)) -> Evidence {
    let mut evidence = good();
    change(&mut evidence);
    evidence
}

fn lost(answered: bool) -> Error {
    report::Cause::BusLost {
        group: None,
        cycles: 3,
        wkc: (6, 9),
        answered,
    }
    .into()
}

fn left_op(position: u16, code: u16) -> Error {
    report::Cause::LeftOp {
        state: AlState::SafeOp,
        code,
    }
    .with_device(at(position))
}

fn absent(evidence: &mut Evidence, from: usize) {
    for device in &mut evidence.devices[from..] {
        device.look = DeviceSnapshot {
            absent: true,
            ..DeviceSnapshot::default()
        };
    }
    evidence.devices[from - 1].look.dl_status = Some(0x0210);
    evidence.devices[from - 1].recent.lost_links[1] = 1;
}

#[test]
fn diagnose_names_device_and_cause() {
    let damaged = |evidence: &mut Evidence| {
        evidence.devices[2].recent.invalid_frames[0] = 40;
        evidence.devices[2].recent.rx_errors[0] = 30;
        // Devices behind the damage only forward the frames.
        evidence.devices[1].recent.forwarded[1] = 40;
    };
    let overrun = |evidence: &mut Evidence| {
        evidence
            .notes
            .insert(0, note(990, LogEntryKind::Overrun(120)));
    };
    let rows: Vec<(Error, Evidence, &str)> = vec![
        (
            lost(true),
            with(|e| absent(e, 1)),
            "`a1` (position 1) is out of reach, with 1 behind it: port 1 of `a0` has no link; the cable is broken, or the device has no power",
        ),
        (
            report::Cause::Gone.with_device(at(2)),
            with(|e| absent(e, 2)),
            "`a2` (position 2) is out of reach: port 1 of `a1` has no link; the cable is broken, or the device has no power",
        ),
        (
            lost(true),
            with(|e| {
                absent(e, 2);
                e.devices[1].look.dl_status = Some(0x0a30);
            }),
            "`a2` (position 2) is out of reach: port 1 of `a1` has a link, but no device behind it answers",
        ),
        (
            report::Cause::Gone.with_device(at(1)),
            with(|e| {
                absent(e, 1);
                for device in &mut e.devices[1..] {
                    (device.look.answers, device.look.came_back) = (true, true);
                    (device.look.absent, device.look.al_status) = (false, Some(0x14));
                    device.look.station = Some(0x1000 + device.at.position);
                }
                (e.devices[1].look.station, e.devices[1].look.al_status) = (Some(0), Some(1));
            }),
            "`a1` (position 1) has been without power, which cut off 1 behind it: it is back in Init and has lost its station address",
        ),
        (
            lost(false),
            with(damaged),
            "`a2` (position 2): frames arrive damaged at its port 0: 40 CRC errors on the cable from port 1 of `a1`",
        ),
        (
            lost(false),
            with(|e| {
                e.devices[1].recent.invalid_frames[1] = 255;
            }),
            "`a1` (position 1): frames arrive damaged at its port 1: 255 or more CRC errors on the cable from `a2`",
        ),
        (
            lost(false),
            with(|e| e.devices[0].recent.lost_links[0] = 2),
            "`a0` (position 0): its port 0 lost the link 2 times, on the cable to this computer",
        ),
        (
            lost(false),
            with(|e| {
                for device in &mut e.devices {
                    device.look = DeviceSnapshot::default();
                }
            }),
            "no frame comes back: the cable from this computer to `a0` (position 0) is broken, or `a0` (position 0) has no power",
        ),
        (
            lost(false),
            with(|e| {
                e.notes.insert(0, cycles(1000, 1199, LogEntryKind::Lost));
            }),
            "no frame came back for 200 ms, then all devices answered again: the first cable, or this computer's interface",
        ),
        (
            left_op(0, 0x001b),
            with(overrun),
            "this computer was too late: 120 cycles left out, up to 120 ms without a frame; then: `a0` left Op for SafeOp, AL status code 0x001b (SyncManager watchdog)",
        ),
        (
            left_op(1, 0x001a),
            with(|e| e.notes.insert(0, note(999, LogEntryKind::WokeLate(3 * MS)))),
            "this computer was too late: 0 cycles left out, up to 3 ms without a frame; then: `a1` left Op for SafeOp, AL status code 0x001a (synchronization error)",
        ),
        // Long before the stop, without consequences.
        (
            left_op(1, 0x001a),
            with(|e| {
                overrun(e);
                e.stop = Some(Stopped {
                    cycle: 10_000,
                    time: 10_000 * MS,
                });
            }),
            "`a1` (position 1) left Op, AL status code 0x001a (synchronization error)",
        ),
        // The drive's own fault, however late the computer is.
        (
            report::Cause::DriveFault {
                code: Some(0x3220),
                statusword: 0x0218,
                report: Box::default(),
            }
            .with_device(at(1)),
            with(overrun),
            "`a1` (position 1, station 0x1001): drive fault (Statusword 0x0218: Fault), error code (0x603F) 0x3220: DC link undervoltage",
        ),
        // The drive notices its watchdog first.
        (
            report::Cause::DriveFault {
                code: Some(0x8250),
                statusword: 0x0218,
                report: Box::default(),
            }
            .with_device(at(1)),
            with(|e| e.devices[1].look.al_code = Some(0x001b)),
            "`a1` (position 1) left Op by its process data watchdog, though every frame came back",
        ),
        (
            left_op(1, 0x001b),
            with(|e| {
                e.devices[1].look.watchdog = Some(WatchdogSnapshot {
                    time_ns: 100 * MS,
                    ..WatchdogSnapshot::default()
                });
                e.devices[1].look.al_code = Some(0x001b);
                e.devices[2].look.al_code = Some(0x001b);
            }),
            "`a1` (position 1) left Op by its process data watchdog of 100 ms, though every frame came back; so did 1 other device",
        ),
        (
            left_op(2, 0x002c),
            with(|e| {
                e.devices[2].look.sync = Some(SyncSnapshot {
                    activation: 3,
                    next_ns: -2_345_678,
                    cycle_ns: 1_000_000,
                });
            }),
            "`a2` (position 2) left Op, AL status code 0x002c (fatal synchronization error: SYNC0 or SYNC1 stopped): its SYNC0 was due 2.35 ms ago",
        ),
        (
            report::Cause::State(StateError::Refused {
                wanted: AlState::Op,
                actual: AlState::SafeOp,
                code: 0x002d,
            })
            .with_device(at(2)),
            with(|e| {
                e.devices[2].look.sync = Some(SyncSnapshot::default());
            }),
            "`a2` (position 2) refused Op, AL status code 0x002d (no synchronization: SYNC0 or SYNC1 was never seen): its SYNC0 is not switched on",
        ),
        (
            report::Cause::LeftOp {
                state: AlState::Init,
                code: 0,
            }
            .with_device(at(0)),
            with(|e| {
                e.notes
                    .insert(0, note(999, LogEntryKind::OtherMainDevice(12)));
                e.devices[0].look.al_status = Some(1);
            }),
            "another MainDevice is on this wire: 12 EtherCAT frames that are not ours; `a0` (position 0) was sent to Init",
        ),
        (
            report::Cause::LeftOp {
                state: AlState::PreOp,
                code: 0,
            }
            .with_device(at(0)),
            good(),
            "`a0` (position 0) is in PreOp without an error: another program requested it, or the device restarted",
        ),
        (
            report::Cause::Trip {
                trip: Trip::FollowingError {
                    error: 2.0,
                    limit: 1.0,
                },
                limits: Vec::new(),
            }
            .with_device(at(1)),
            with(|e| e.devices[1].look.interpolation_ns = Some(20 * MS)),
            "`a1` (position 1): the drive counts on a cycle of 20 ms (0x60C2), it is 1 ms; then: `a1`: following error 2.0000 exceeds 1.0000",
        ),
        (
            report::Cause::Trip {
                trip: Trip::FollowingError {
                    error: 2.0,
                    limit: 1.0,
                },
                limits: Vec::new(),
            }
            .with_device(at(1)),
            with(|e| e.devices[1].look.interpolation_ns = Some(MS)),
            "`a1` (position 1, station 0x1001): following error 2.0000 exceeds 1.0000",
        ),
        (
            report::Cause::NotEnabled {
                state: ecaxis_axis::State::SwitchOnDisabled,
                statusword: 0x0240,
                waiting: None,
                code: None,
                timeout_ms: 5000,
            }
            .with_device(at(1)),
            with(|e| {
                e.devices[1].look.watchdog = Some(WatchdogSnapshot {
                    time_ns: 100 * MS,
                    expired: 1,
                    ..WatchdogSnapshot::default()
                });
            }),
            "`a1` (position 1) does not take its outputs: its process data watchdog of 100 ms has expired (0x0440)",
        ),
        // The device that is not in Op is why the working counter was wrong.
        (
            lost(true),
            with(|e| {
                e.devices[1].look.al_status = Some(0x14);
                e.devices[1].look.al_code = Some(0x8001);
            }),
            "`a1` (position 1) left Op for SafeOp, AL status code 0x8001 (manufacturer-specific AL status code)",
        ),
        (
            lost(false),
            with(|e| {
                e.notes.insert(0, cycles(997, 1001, LogEntryKind::Late));
                e.notes.insert(0, cycles(996, 1000, LogEntryKind::Lost));
            }),
            "frames come back too late for a cycle of 1 ms: 5 came in a later one",
        ),
        (
            lost(false),
            with(|e| {
                e.notes
                    .insert(0, cycles(501, 1000, LogEntryKind::LinkError))
            }),
            "this computer's network interface refused to send or to receive, 500 times",
        ),
        // Without answers from devices, only the error remains.
        (
            lost(true),
            Evidence::default(),
            "the bus is lost: 3 cycles in a row with working counter 6 instead of 9",
        ),
    ];
    for (error, evidence, expected) in rows {
        let reported = diagnose(&error, &evidence).cause.to_string();
        assert_eq!(reported, expected, "{error}");
    }
}

/// Events in the window that do not explain the stop are not its cause.
#[test]
fn diagnose_prefers_certain_silence_to_occasional_trouble() {
    let silence = "no frame came back for 20 ms, then all devices answered again";
    type Change = fn(&mut Evidence);
    let others: [Change; 7] = [
        |_| {},
        |e| e.notes.insert(0, cycles(700, 704, LogEntryKind::Late)),
        |e| e.notes.insert(0, note(800, LogEntryKind::WokeLate(2 * MS))),
        |e| {
            e.notes
                .insert(0, note(900, LogEntryKind::OtherMainDevice(1)))
        },
        |e| e.devices[1].recent.invalid_frames[0] = 3,
        |e| e.devices[1].recent.lost_links[1] = 1,
        // Gone after the stop: all devices answered when frames returned.
        |e| {
            absent(e, 2);
            e.al_status = Some((OP, 3));
        },
    ];
    for (n, other) in others.into_iter().enumerate() {
        let evidence = with(|e| {
            e.notes.insert(0, cycles(981, 1000, LogEntryKind::Lost));
            other(e);
        });
        let found = diagnose(&lost(false), &evidence).cause.to_string();
        assert!(found.starts_with(silence), "{n}: {found}");
    }
}

#[test]
fn stopped_find_returns_the_stop_of_an_error() {
    let stopping =
        |cycle, cause| note(cycle, LogEntryKind::Event(Event::Stopping { cycle, cause }));
    let cause = StopCause::LeftOp { al_status: 4 };
    let group = note(
        100,
        LogEntryKind::Event(Event::GroupStopping {
            cycle: 100,
            group: GroupIndex(1),
            cause,
        }),
    );
    let notes = [
        group,
        stopping(500, StopCause::Requested),
        stopping(600, cause),
    ];
    for (group, by_cycle, expected) in [
        (Some(1), true, 100),
        (None, true, 600),
        (None, false, 500),
        (Some(2), true, 600),
    ] {
        let found = Stopped::find(&notes, group.map(GroupIndex), by_cycle).map(|stop| stop.cycle);
        assert_eq!(found, Some(expected), "{group:?}, {by_cycle}");
    }
    assert_eq!(Stopped::find(&notes[..1], None, true), None);
}

#[test]
fn diagnose_returns_the_cause_of_a_stopped_group() {
    let error = report::Cause::GroupStopped {
        group: "g".into(),
        cause: std::sync::Arc::new(report::Cause::Gone.with_device(at(2))),
    }
    .with_device(at(1));
    let evidence = with(|e| absent(e, 2));
    let found = diagnose(&error, &evidence);
    assert!(
        matches!(found.cause, DiagnosedCause::OutOfReach { .. }),
        "{found:?}"
    );
    assert_eq!(found.also, [], "a lost link goes with it");
}

#[test]
fn diagnose_keeps_other_observations() {
    let error = report::Cause::DriveFault {
        code: Some(0x3220),
        statusword: 0x0218,
        report: Box::default(),
    }
    .with_device(at(1));
    let evidence = with(|e| {
        e.devices[2].recent.invalid_frames[0] = 7;
        e.notes
            .insert(0, note(999, LogEntryKind::OtherMainDevice(1)));
    });
    let found = diagnose(&error, &evidence);
    assert!(
        matches!(found.cause, DiagnosedCause::Unexplained { .. }),
        "{found:?}"
    );
    assert!(
        matches!(
            *found.also,
            [
                DiagnosedCause::OtherMainDevice { device: None, .. },
                DiagnosedCause::DamagedFrames { count: 7, .. }
            ]
        ),
        "{found:?}"
    );
}

#[test]
fn about_rounds_times_to_three_digits() {
    for (ns, text) in [
        (0, "0 ns"),
        (999, "999 ns"),
        (1_510_240, "1.51 ms"),
        (99_999_999, "100 ms"),
    ] {
        assert_eq!(about(ns), text);
    }
    assert_ne!(about(u64::MAX), "");
}
