//! Clocks on the whole bus that a bring-up or a run cannot take for granted.

use std::fmt::Write as _;
use std::sync::{Arc, Mutex};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Nanos};
use ecaxis_master::config::Machine;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::session::{self, Options, Outcome, simulated_bus};
use ecaxis_sim::{AlState, Segment};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::recordings::{LRW, datagrams};
use ecaxis_test_support::wire::{WatchedBus, Watcher};
use ecaxis_test_support::{Heard, faults, machine, recorded, run_badly, run_well, virtual_time};

use crate::states::run_changed;

const MS: Nanos = 1_000_000;
const LIMITS: &str = "limits = { position = [-1000.0, 1000.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }";

fn drive(name: &str, position: usize, keys: &str, sim: &str) -> String {
    format!(
        "[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\n{keys}\n\
         [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n{LIMITS}\n[device.sim]\n{sim}\n"
    )
}

/// Two drives that move; `keys` are those of the second one.
fn pair(bus: &str, keys: &str, sim: &str) -> Machine {
    let mut text = format!("[bus]\ncycle = \"1ms\"\n{bus}\n");
    text += &drive("x", 0, "", "");
    text += &drive("y", 1, keys, sim);
    machine(&(text + "[[step]]\nmove = { x = 1.0, y = 1.0 }\n"))
}

/// ETG.1000.4, 6.4.2: a device that takes the distributed time counts the write. Without it, SYNC0
/// would drift away from the frames.
#[test]
fn a_device_that_does_not_take_the_time_runs_without_sync0_only() {
    const IGNORED: &str = "[[fault]]\nkind = \"clock-ignored\"\ndevice = 1\n";
    let (error, _) = run_badly(pair("", "", ""), faults(IGNORED));
    for part in ["`y`", "does not take the time", "0x0910"] {
        assert!(error.contains(part), "{part}: {error}");
    }
    let summary = run_well(pair("", "dc = \"off\"", ""), faults(IGNORED));
    assert!(
        summary
            .axes
            .iter()
            .all(|axis| axis.final_error_counts == Some(0))
    );
}

/// ETG.1020: a device may need SYNC0 before SafeOp and refuses with 0x002D until it runs. SOEM's
/// `ec_dcsync0` and its samples start SYNC0 before SafeOp for such devices.
#[test]
fn safe_op_is_requested_again_once_sync0_runs() {
    let waiting = |index: usize| {
        move |segment: &mut Segment| {
            let device = segment.device_mut(index).expect("two drives");
            device.require_sync0_in_safe_op();
        }
    };
    let (outcome, heard) = run_changed(pair("", "", ""), waiting(1));
    outcome
        .result
        .unwrap_or_else(|error| panic!("{error}; {:?}", heard.warnings()));
    // Without SYNC0, the refusal is final.
    let (outcome, _) = run_changed(pair("", "dc = \"off\"", ""), waiting(1));
    let error = outcome.result.expect_err("no SYNC0").to_string();
    assert!(error.contains("`y`") && error.contains("0x002d"), "{error}");
}

/// ETG.1500, feature 1103: the MainDevice observes the clock difference (0x092C) of each device.
/// Clock readings with an error of up to 20 µs are never within 100 ns at five drives at once.
#[test]
fn sync_window_and_time_out_are_those_of_the_machine_file() {
    let six = |bus: &str, keys: &str| {
        let mut text = format!("[bus]\ncycle = \"1ms\"\n{bus}\n") + &drive("d0", 0, "", "");
        for n in 1..6 {
            text += &drive(&format!("d{n}"), n, keys, "jitter = \"20us\"");
        }
        machine(&(text + "[[step]]\nmove = { d0 = 1.0 }\n"))
    };
    run_well(six("sync_window = \"100us\"", ""), virtual_time());
    // Devices without SYNC0 do not matter.
    run_well(
        six("sync_window = \"100ns\"", "dc = \"off\""),
        virtual_time(),
    );
    let waits = [200, 1_500].map(|timeout| {
        let bus = format!("sync_window = \"100ns\"\nsync_timeout = \"{timeout}ms\"");
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(virtual_time(), folder.path());
        let (error, _) = run_badly(six(&bus, ""), options);
        assert!(error.contains("does not settle"), "{error}");
        let sent = datagrams(&path).into_iter().filter(|d| d.sent);
        sent.filter(|d| d.command == LRW).count()
    });
    assert!((1_290..1_310).contains(&(waits[1] - waits[0])), "{waits:?}");
}

/// ETG.2000, `AssignActivate`: 0x0981 has a bit for SYNC0 and one for SYNC1. A device with 0x0100, such
/// as Beckhoff's EL6224, has a clock and neither: its outputs wait for no pulse, so its clock need not
/// be inside the window before Op. These clocks never are; the drive still reaches Op and moves.
#[test]
fn clock_without_sync_signals_need_not_settle_before_op() {
    let bench = Bench::new();
    for (file, activate) in [("timed.xml", "#x100"), ("synced.xml", "#x500")] {
        bench.write(file, &bench.read("esi/IO8.xml"));
        bench.change(file, |esi| {
            let dc = format!(
                "<Dc><OpMode><Name>DC</Name><AssignActivate>{activate}</AssignActivate></OpMode></Dc><Eeprom>"
            );
            esi.replace("<Eeprom>", &dc)
        });
    }
    let bus = |file: &str| {
        let mut text = String::from(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\nsync_window = \"100ns\"\nsync_timeout = \"1s\"\n",
        );
        text += &drive("x", 0, "", "");
        for n in 1..6 {
            let _ = write!(
                text,
                "[[device]]\nname = \"io{n}\"\nesi = \"{file}\"\nposition = {n}\n[device.sim]\njitter = \"20us\"\n"
            );
        }
        bench.machine(&(text + "[[step]]\nmove = { x = 1.0 }\n"))
    };
    let summary = run_well(bus("timed.xml"), virtual_time());
    assert_eq!(summary.axes[0].final_error_counts, Some(0));
    let (error, _) = run_badly(bus("synced.xml"), virtual_time());
    assert!(
        error.contains("`io") && error.contains("does not settle"),
        "{error}"
    );
}

/// The time from SYNC0 to the arrival of outputs at the drives, after every cyclic frame.
#[derive(Debug)]
struct Watched {
    bus: SimLink,
    drives: std::ops::Range<usize>,
    arrivals: Arc<Mutex<Vec<(Nanos, usize, Nanos)>>>,
}

impl Link for Watched {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        self.bus.send(frame)?;
        if frame.get(11) == Some(&0x20) {
            let segment = self.bus.segment();
            let mut arrivals = self.arrivals.lock().expect("one thread");
            arrivals.extend(self.drives.clone().filter_map(|drive| {
                let device = segment.device(drive)?;
                let pulse = device.sync0_log().last()?;
                let after = device.outputs_log().last()?.checked_sub(pulse)?;
                Some((clock::now(), drive, after))
            }));
        }
        Ok(())
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.bus.recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.bus.next_arrival()
    }
}

/// Runs a machine and returns the arrivals at these drives.
fn watch(
    machine: Machine,
    options: Options,
    drives: std::ops::Range<usize>,
) -> (Outcome, Heard, Vec<(Nanos, usize, Nanos)>) {
    options.clock.enter();
    let bus = simulated_bus(&machine, 1, options.faults.as_ref(), None).expect("a bus");
    let arrivals = Arc::default();
    let link = Box::new(Watched {
        bus: SimLink::new(bus),
        drives,
        arrivals: Arc::clone(&arrivals),
    });
    let mut heard = Heard::default();
    let stop = Arc::<CancelToken>::default();
    let outcome = session::run_on(link, machine, options, stop, &mut heard);
    let arrivals = arrivals.lock().expect("one thread").clone();
    (outcome, heard, arrivals)
}

/// A device without a clock, the reference clock alone at one port, two drives at the other.
pub(crate) fn branches() -> Machine {
    let bench = Bench::new();
    bench.write("hub.xml", &bench.read("esi/IO8.xml"));
    bench.change("hub.xml", |esi| esi.replace("\"YY\"", "\"YYY\""));
    let mut text = String::from("[bus]\ncycle = \"1ms\"\n");
    text += "[[device]]\nname = \"hub\"\nesi = \"hub.xml\"\nposition = 0\n";
    text += &drive("ref", 1, "", "after = \"hub\"\nport = 1\ndrift_ppm = 50.0");
    text += &drive("a", 2, "", "after = \"hub\"\nport = 2\ndrift_ppm = -80.0");
    text += &drive("b", 3, "", "drift_ppm = 120.0");
    text += "[[stop.group]]\nname = \"first\"\naxes = [\"ref\"]\noutside = \"continue\"\n";
    for to in [30.0, -30.0, 0.0] {
        let _ = write!(text, "[[step]]\nmove = {{ a = {to:?}, b = {to:?} }}\n");
    }
    bench.machine(&text)
}

/// ETG.1000.4: all clocks hold the system time. The drives that remain keep moving, and their outputs
/// keep arriving in the middle between two pulses of SYNC0.
#[test]
fn drives_keep_moving_in_phase_when_the_reference_clock_loses_its_power() {
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"1s\"\n";
    let (outcome, heard, arrivals) = watch(branches(), faults(off), 2..4);
    let warnings = heard.warnings();
    outcome
        .result
        .unwrap_or_else(|error| panic!("{error}; {warnings:?}"));
    let replaced: Vec<_> = warnings
        .iter()
        .filter(|w| w.contains("replaces it"))
        .collect();
    assert_eq!(replaced.len(), 1, "{warnings:?}");
    assert!(replaced[0].contains("`a`"), "{replaced:?}");
    let summary = outcome.summary.expect("a summary");
    for axis in &summary.axes[1..] {
        assert!(
            axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
            "{axis:?}"
        );
    }
    let during: Vec<_> = arrivals
        .iter()
        .filter(|(at, ..)| *at > 1_000 * MS)
        .collect();
    assert!(during.len() > 2_000, "{}", during.len());
    for (at, drive, after) in during {
        assert!(
            (450_000..550_000).contains(after),
            "{drive} at {at}: {after} ns"
        );
    }
}

/// A SYNC0 cycle of half the bus cycle (ETG.2000, `CycleTimeSync0` with factor -2): frames arrive in
/// the middle between two of its pulses.
#[test]
fn frames_arrive_between_the_pulses_of_a_faster_sync0() {
    let bench = Bench::new();
    bench.write("fast.xml", &bench.read("esi/EPOS4.xml"));
    bench.change("fast.xml", |esi| {
        let cycle = "<CycleTimeSync0 Factor=\"1\">0</CycleTimeSync0>";
        assert!(esi.contains(cycle), "the ESI has {cycle}");
        esi.replace(cycle, "<CycleTimeSync0 Factor=\"-2\">0</CycleTimeSync0>")
    });
    let mut text = String::from("[bus]\ncycle = \"1ms\"\n");
    text += &drive("x", 0, "", "").replace("esi/EPOS4.xml", "fast.xml");
    text += "[[step]]\nmove = { x = 30.0 }\n";
    let (outcome, _, arrivals) = watch(bench.machine(&text), virtual_time(), 0..1);
    outcome.result.expect("runs");
    assert!(arrivals.len() > 500);
    for (at, _, after) in &arrivals[arrivals.len() / 2..] {
        assert!((200_000..300_000).contains(after), "at {at}: {after} ns");
    }
}

/// Registers 0x0980 to 0x09A7 of a device in Op, and the true times of its last pulses.
#[derive(Debug, Default)]
struct SyncUnit {
    control: [u8; 2],
    cycles: [u32; 2],
    pulses: [Vec<Nanos>; 2],
}

struct SyncObserver(Arc<Mutex<SyncUnit>>);

impl Watcher for SyncObserver {
    fn after(&mut self, segment: &mut Segment) {
        let device = segment.device(1).expect("two devices");
        if device.al_state() != AlState::Op {
            return;
        }
        let word = |register| {
            let bytes = device.registers(register, 4).first_chunk();
            u32::from_le_bytes(*bytes.expect("four bytes"))
        };
        *self.0.lock().expect("one thread") = SyncUnit {
            control: word(0x0980).to_le_bytes()[..2].try_into().expect("two"),
            cycles: [0x09a0, 0x09a4].map(word),
            pulses: [device.sync0_log().collect(), device.sync1_log().collect()],
        };
    }
}

/// ETG.2000, `AssignActivate`: the low byte goes to 0x0980, the high byte to 0x0981. ESC data sheet,
/// section I, 9.2.3: SYNC1 comes 0x09A4 after SYNC0. Rows: an oversampling terminal with four samples
/// (EL3702, 750,000 at 1 ms as `ecmccfg` writes it), the same with 0x0700, EL7201 with 1,000, and 0x0500:
/// SYNC1 without the output SYNC0.
#[test]
fn sync1_follows_sync0_as_the_esi_says() {
    let rows = [
        ("#x0730", -4, -1, 0, [0x30, 0x07], 750_000, 4),
        ("#x700", -4, -1, 0, [0x00, 0x07], 750_000, 4),
        ("#x700", 1, 1, 1_000, [0x00, 0x07], 1_000, 1),
        ("#x500", 1, 1, 1_000, [0x00, 0x05], 1_000, 0),
    ];
    for (activate, sync0, sync1, shift, control, delay, sync0_per_cycle) in rows {
        let bench = Bench::new();
        bench.write("own.xml", &bench.read("esi/IO8.xml"));
        bench.change("own.xml", |esi| {
            let dc = format!(
                "<Dc><OpMode><Name>DC</Name><AssignActivate>{activate}</AssignActivate>\
                 <CycleTimeSync0 Factor=\"{sync0}\">0</CycleTimeSync0>\
                 <CycleTimeSync1 Factor=\"{sync1}\">0</CycleTimeSync1>\
                 <ShiftTimeSync1>{shift}</ShiftTimeSync1></OpMode></Dc><Eeprom>"
            );
            esi.replace("<Eeprom>", &dc)
        });
        let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
        text += &drive("x", 0, "", "");
        text += "[[device]]\nname = \"io\"\nesi = \"own.xml\"\nposition = 1\n[[step]]\nmove = { x = 1.0 }\n";
        let machine = bench.machine(&text);
        let seen = Arc::default();
        let observer = SyncObserver(Arc::clone(&seen));
        let bus = WatchedBus::new(&machine, &virtual_time(), observer);
        let stop = Arc::<CancelToken>::default();
        let outcome = session::run_on(
            Box::new(bus),
            machine,
            virtual_time(),
            stop,
            &mut Heard::default(),
        );
        outcome.result.expect("runs");
        let seen = seen.lock().expect("one thread");
        assert_eq!(seen.control, control, "{activate}");
        assert_eq!(seen.cycles[1], delay, "{activate}");
        let [sync0, sync1] = &seen.pulses;
        let near = |a: Nanos, b: Nanos| a.abs_diff(b) < 1_000;
        assert!(sync1.len() > 1, "{activate}");
        assert!(sync1.windows(2).all(|pair| near(pair[1] - pair[0], MS)));
        let last = *sync1.last().expect("a pulse");
        let before = sync0.iter().filter(|at| (last - MS..last).contains(*at));
        assert_eq!(before.count(), sync0_per_cycle, "{activate}");
        if sync0_per_cycle > 0 {
            assert!(
                sync0
                    .iter()
                    .any(|at| near(last - at.min(&last), u64::from(delay)))
            );
        }
    }
}
