//! Devices that come back while the others stay in Op.

use std::sync::{Arc, Mutex};

use ecaxis_axis::{Command, State};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::{AxisRef, Machine, OutputRef};
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{
    Attachments, Options, Progress, run_attached, run_with, simulated_bus,
};
use ecaxis_sim::Segment;
use ecaxis_test_support::wire::{WatchedBus, Watcher};
use ecaxis_test_support::{
    Heard, assert_contains, axes, faults, machine, run, run_badly, virtual_time,
};

/// Drives in a line, each in a group of its own that the others survive.
pub fn line(count: usize, steps: &str) -> Machine {
    machine(&line_text(count, steps))
}

pub(super) fn line_text(count: usize, steps: &str) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for position in 0..count {
        let limits = "limits = { position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }";
        text += &format!(
            "\n[[device]]\nname = \"a{position}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n{limits}\n\
             \n[[stop.group]]\nname = \"g{position}\"\naxes = [\"a{position}\"]\noutside = \"continue\"\n",
        );
    }
    text + steps
}

/// Returns name, time in ns and whether it had no power, of each device that returned.
pub(super) fn returned(heard: &Heard) -> Vec<(String, u64, bool)> {
    let each = heard.0.iter().filter_map(|progress| match progress {
        Progress::DeviceReturned {
            device,
            after_ns,
            restarted,
            ..
        } => Some((device.name.clone(), *after_ns, *restarted)),
        _ => None,
    });
    each.collect()
}

pub const STEPS: &str = "\n[[step]]\nenable = true\n\n[[step]]\nmove = { a0 = 80.0 }\n\n[[step]]\nmove = { a0 = -80.0 }\n\
    \n[[step]]\nreset = [\"a1\", \"a2\"]\n\n[[step]]\nenable = [\"a1\", \"a2\"]\n\n[[step]]\nmove = { a0 = 1.0, a1 = 2.0, a2 = 3.0 }\n";

/// Every way to lose a device: without power, with a broken cable that cuts off the next one, and by
/// its own fall to SafeOp.
#[test]
fn lost_devices_return_and_move_by_command_only() {
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 2\nat = \"1.5s\"\nfor = \"500ms\"\n";
    let both = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"1.5s\"\nfor = \"500ms\"\n";
    let cable =
        "[[fault]]\nkind = \"link-break\"\ndevice = 1\nport = 0\nat = \"1.5s\"\nfor = \"500ms\"\n";
    let watchdog = "[[fault]]\nkind = \"watchdog\"\ndevice = 2\nat = \"1.5s\"\n";
    let rows: [(&str, &[(&str, bool)]); 4] = [
        (off, &[("a2", true)]),
        (both, &[("a1", true), ("a2", false)]),
        (cable, &[("a1", false), ("a2", false)]),
        (watchdog, &[("a2", false)]),
    ];
    for (fault, expected) in rows {
        let (outcome, heard) = run(line(3, STEPS), faults(fault));
        let warnings = heard.warnings();
        let result = outcome.result;
        result.unwrap_or_else(|error| panic!("{fault}: {error}; {warnings:?}"));
        let found = returned(&heard);
        let mut names: Vec<_> = found
            .iter()
            .map(|(name, _, off)| (name.as_str(), *off))
            .collect();
        names.sort_unstable();
        assert_eq!(names, expected, "{fault}: {warnings:?}");
        for (name, after, _) in &found {
            assert!(*after < 3_000_000_000, "{name}: {after} ns");
        }
        let summary = outcome.summary.expect("a summary");
        for (axis, target) in summary.axes.iter().zip([1.0, 2.0, 3.0]) {
            assert_eq!(axis.target_position, target, "{fault}");
            assert!(
                axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
                "{axis:?}"
            );
        }
        // Without a command, a drive that has returned stays without power.
        let alone = STEPS.split("\n[[step]]\nreset").next().expect("a part");
        let (outcome, _) = run(line(3, alone), faults(fault));
        for axis in &outcome.summary.expect("a summary").axes[1..] {
            let idle = [State::SwitchOnDisabled, State::Fault].map(|state| state.to_string());
            assert!(idle.contains(&axis.final_state), "{fault}: {axis:?}");
        }
    }
}

/// The search for lost devices waited for the return of the slowest one.
#[test]
fn slow_device_does_not_delay_the_return_of_another() {
    let script = "[[fault]]\nkind = \"watchdog\"\ndevice = 2\nat = \"6s\"\n\
                  [[fault]]\nkind = \"watchdog\"\ndevice = 1\nat = \"6.15s\"\n";
    let slow = "position = 2\nsim = { state_change = \"180ms\" }\n";
    // Long enough for the slow one.
    let steps = STEPS.replace(
        "[[step]]\nreset",
        "[[step]]\ndwell = \"4s\"\n\n[[step]]\nreset",
    );
    let text = line_text(3, &steps).replace("position = 2\n", slow);
    let (outcome, heard) = run(machine(&text), faults(script));
    outcome.result.expect("both return");
    let found = returned(&heard);
    let names: Vec<_> = found.iter().map(|(name, ..)| name.as_str()).collect();
    assert_eq!(names, ["a1", "a2"], "{found:?}");
    assert!(found[1].1 > 700_000_000, "four state changes: {found:?}");
}

/// Another device at the place of a lost one: of another kind it is never driven, of the same kind it
/// is taken with a warning, unless the file gives the serial number.
#[test]
fn exchanged_device_is_driven_only_if_it_is_of_the_same_kind() {
    let exchange = |keys: &str, rest: &str| {
        format!("[[fault]]\nkind = \"swap\"\ndevice = 2\nat = \"1.5s\"\n{keys}\n{rest}")
    };
    let warned = |heard: &Heard, text: &str| heard.warnings().iter().any(|w| w.contains(text));

    // The old device is back after a second.
    let other = exchange("product = 0x77", "for = \"1s\"\n");
    let (outcome, heard) = run(line(3, STEPS), faults(&other));
    outcome.result.expect("the old device returns");
    assert!(
        warned(&heard, "`a2` does not return"),
        "{:?}",
        heard.warnings()
    );
    assert_eq!(returned(&heard).len(), 1);

    let other = exchange("product = 0x77", "");
    let (outcome, heard) = run(line(3, STEPS), faults(&other));
    assert!(outcome.result.is_err(), "a2 is never enabled again");
    assert_eq!(returned(&heard), []);
    assert!(warned(&heard, "the device is"), "{:?}", heard.warnings());

    let same = exchange("serial = 4711", "");
    let (outcome, heard) = run(line(3, STEPS), faults(&same));
    outcome.result.expect("it is taken");
    assert!(
        warned(&heard, "serial number 4711"),
        "{:?}",
        heard.warnings()
    );
    assert_eq!(returned(&heard).len(), 1);

    // The file names the serial number, which the simulated device then has.
    let text = line_text(3, STEPS).replace("position = 2\n", "position = 2\nserial = 17\n");
    let (outcome, heard) = run(machine(&text), faults(&same));
    assert!(outcome.result.is_err(), "a2 is never enabled again");
    assert_eq!(returned(&heard), []);
    assert!(warned(&heard, "4711"), "{:?}", heard.warnings());
}

/// The first output of the terminal in each frame.
struct FirstOutput(Arc<Mutex<Vec<bool>>>);

impl Watcher for FirstOutput {
    fn after(&mut self, segment: &mut Segment) {
        let outputs = segment.device_mut(3).map(|device| device.outputs());
        let on = outputs.is_some_and(|bytes| bytes.first().is_some_and(|byte| byte & 1 != 0));
        self.0.lock().expect("no panic").push(on);
    }
}

/// Returns the moments in ms at which the first output of the terminal switches, first on. `owner`: the
/// text of the machine file that writes it.
fn switching(owner: &str, by_controller: bool) -> Vec<usize> {
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 3\nat = \"2s\"\nfor = \"500ms\"\n";
    let terminal = |name: &str, position: usize| {
        format!("\n[[device]]\nname = \"{name}\"\nesi = \"esi/IO8.xml\"\nposition = {position}\n")
    };
    // The other one is nearer: it remains.
    let rest = terminal("in", 2) + &terminal("io", 3) + owner;
    let text = line_text(2, &rest);
    let text = text.replace("axes = [\"a1\"]\n", "axes = [\"a1\"]\ndevices = [\"io\"]\n");
    let (mut machine, options) = (machine(&text), faults(off));
    let controller = by_controller.then(|| {
        let output = machine.output("io", "Output 1").expect("free");
        let axes = ["a0", "a1"].map(|name| machine.axis(name).expect("an axis"));
        let cycles = 0;
        Box::new(Sets {
            output,
            axes,
            cycles,
        }) as Box<dyn Controller>
    });
    let seen = Arc::new(Mutex::new(vec![false]));
    let link = WatchedBus::new(&machine, &options, FirstOutput(Arc::clone(&seen)));
    let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
    let attachments = Attachments {
        controller,
        link: Some(Box::new(link)),
        ..Attachments::default()
    };
    let outcome = run_attached(machine, options, stop, &mut heard, attachments);
    outcome
        .result
        .unwrap_or_else(|error| panic!("{owner}: {error}"));
    assert_eq!(returned(&heard).len(), 1, "{owner}: {:?}", heard.warnings());
    let seen = seen.lock().expect("no panic");
    let pairs = seen.windows(2).enumerate();
    let changes = pairs.filter(|(_, pair)| pair[0] != pair[1]);
    changes.map(|(cycle, _)| cycle + 1).collect()
}

/// Sets the output in every cycle, and resets the group 6 s after the first motion.
struct Sets {
    output: OutputRef,
    axes: [AxisRef; 2],
    cycles: usize,
}

impl Controller for Sets {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        if machine.stopping() || (self.cycles == 0 && !machine.axis(self.axes[0]).ready) {
            return;
        }
        self.cycles += 1;
        machine.set(self.output, 1.0);
        if self.cycles == 6000 {
            machine
                .command(self.axes[1], Command::ResetFault)
                .expect("it may be reset");
        }
        if self.cycles == 8000 {
            machine.finish();
        }
    }
}

/// A terminal of a stopped group came back with the outputs of positions and copies on, and did not
/// come back with outputs of steps.
#[test]
fn outputs_of_a_returned_terminal_are_off_until_the_reset() {
    let steps = |first: &str, last: &str| {
        format!(
            "\n[[step]]\nenable = true\n{first}\n[[step]]\nmove = {{ a0 = 80.0 }}\nspeed = 0.2\n\
             \n[[step]]\nreset = [\"a1\"]\n\n[[step]]\ndwell = \"300ms\"\n{last}\n[[step]]\ndwell = \"300ms\"\n"
        )
    };
    let set = "\n[[step]]\nset = { io.\"Output 1\" = true }\n";
    let position =
        "[[position_output]]\noutput = \"io.Output 1\"\naxis = \"a0\"\nranges = [[1.0, 100.0]]\n";
    let copy = "[[sim.inputs]]\nat = \"100ms\"\nset = { in.\"Input 1\" = true }\n\
                [[copy]]\nfrom = \"in.Input 1\"\nto = \"io.Output 1\"\n";
    let safety = format!("{copy}fsoe = true\n");
    // The bytes of the terminal are those of its last frame until it has power again.
    // The end of the move, and the return, in ms.
    const RESET: usize = 8000;
    for (owner, again) in [
        (position.to_owned() + &steps("", ""), RESET..9500),
        (copy.to_owned() + &steps("", ""), RESET..9500),
        // Only the second step switches it on.
        (steps(set, set), RESET + 300..10_000),
        // Frames of a safety connection pass.
        (safety + &steps("", ""), 1500..4500),
    ] {
        let changes = switching(&owner, false);
        let [on, off, back, ..] = changes[..] else {
            panic!("{owner}: {changes:?}")
        };
        assert!(
            on < 2000 && (1000..2600).contains(&off),
            "{owner}: {changes:?}"
        );
        assert!(again.contains(&back), "{owner}: {changes:?}");
    }
    // A step in between fails, and names the group.
    let early = format!("\n[[step]]\ndwell = \"3s\"\n{set}");
    let text = line_text(
        2,
        &format!("\n[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 2\n{early}"),
    );
    let text = text.replace("axes = [\"a1\"]\n", "axes = [\"a1\"]\ndevices = [\"io\"]\n");
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 2\nat = \"1.5s\"\nfor = \"500ms\"\n";
    let (outcome, _) = run(machine(&text), faults(off));
    let error = outcome.result.expect_err("the outputs are off").to_string();
    assert!(error.contains("g1"), "{error}");
}

/// The same for a controller, which sets its output in every cycle.
#[test]
fn output_of_a_controller_is_off_until_the_reset() {
    let changes = switching("", true);
    let [on, off, back, ..] = changes[..] else {
        panic!("{changes:?}")
    };
    assert!(on < 2000 && (1000..2600).contains(&off), "{changes:?}");
    assert!((on + 5990..on + 6100).contains(&back), "{changes:?}");
}

/// Panics once all axes can move.
struct Panics(Vec<AxisRef>);

impl Controller for Panics {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        if self.0.iter().all(|axis| machine.axis(*axis).ready) {
            panic!("as a faulty program does");
        }
    }
}

/// The stop of a machine takes its devices out of Op: none of them is lost, and none returns.
#[test]
fn no_device_returns_once_the_machine_stops() {
    let machine = machine(&axes(60));
    let axes = (0..3).map(|n| machine.axis(&format!("a{n}")).expect("an axis"));
    let controller = Box::new(Panics(axes.collect()));
    let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
    let outcome = run_with(machine, virtual_time(), stop, &mut heard, controller);
    let error = outcome.result.expect_err("it panicked").to_string();
    assert!(error.contains("panicked"), "{error}");
    assert_eq!(heard.warnings(), [""; 0]);
    let of_devices = |progress: &&Progress| {
        matches!(
            progress,
            Progress::DeviceLost { .. } | Progress::DeviceReturned { .. }
        )
    };
    assert_eq!(heard.0.iter().filter(of_devices).count(), 0);
}

const DRIVES: usize = 16;
/// The drives in front of those that come and go.
const STEADY: usize = 8;

/// What the cycles of a run have shown.
#[derive(Debug, Default, Clone, PartialEq)]
struct Seen {
    /// For each cycle, what the steady drives receive.
    steady: Vec<u64>,
    /// The cycles in which a steady drive did not answer: the frame was on the cable that broke.
    stale: Vec<usize>,
    /// Drives that moved without power, or began at another target than their position.
    wrong: Vec<String>,
    /// Drives with power at the end.
    ready: usize,
}

/// Moves the steady drives. Resets and enables the others whenever possible.
struct Hall {
    axes: Vec<AxisRef>,
    cycles: usize,
    /// For each drive that comes and goes, whether it was enabled in the last cycle.
    enabled: Vec<bool>,
    seen: Arc<Mutex<Seen>>,
}

impl Controller for Hall {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        let mut seen = self.seen.lock().expect("no panic while it is locked");
        let ready = |machine: &CycleContext<'_>, axis: &AxisRef| machine.axis(*axis).ready;
        let number = seen.steady.len();
        if machine.stopping() || (number == 0 && !self.axes.iter().all(|a| ready(machine, a))) {
            return;
        }
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        let mut add = |value: u64| hash = (hash ^ value).wrapping_mul(0x0000_0100_0000_01b3);
        let at = number as f64 * 1e-3;
        for (index, &axis) in self.axes.iter().enumerate() {
            let status = machine.axis(axis);
            if index < STEADY {
                add(status.target_position.to_bits());
                add(u64::from(status.controlword));
                if status.stale_cycles > 0 && seen.stale.last() != Some(&number) {
                    seen.stale.push(number);
                }
                let swing = 5.0 - 5.0 * (at * 0.5 * (index + 1) as f64).cos();
                let _ = machine.set_point(axis, swing);
                continue;
            }
            let enabled = std::mem::replace(&mut self.enabled[index - STEADY], status.enabled);
            let off = (status.target_position - status.position).abs();
            if status.enabled && !enabled && status.stale_cycles == 0 && off > 0.01 {
                let text = format!("{number}: drive {index} begins {off} from its position");
                seen.wrong.push(text);
            }
            if number % 100 != index {
                continue;
            }
            if machine.stopped(axis).is_some() || status.fault.is_some() {
                let _ = machine.command(axis, Command::ResetFault);
            } else if !status.enabled {
                let _ = machine.command(axis, Command::Enable);
            } else if status.ready {
                let to = if number % 1000 < 500 { 3.0 } else { -3.0 };
                let _ = machine.command(
                    axis,
                    Command::MoveTo {
                        position: to,
                        speed: 0.2,
                        ramp: 1.0,
                    },
                );
            }
        }
        seen.steady.push(hash);
        if number + 1 == self.cycles {
            seen.ready = self.axes.iter().filter(|axis| ready(machine, axis)).count();
            machine.finish();
        }
    }
}

fn hall(options: Options, seconds: usize) -> (Seen, Heard) {
    let machine = line(DRIVES, "");
    options.clock.enter();
    // The last device is not in the machine file.
    let bus = line(DRIVES + 1, "");
    let bus = simulated_bus(&bus, options.seed, options.faults.as_ref(), None).expect("a bus");
    let axes = (0..DRIVES).map(|n| machine.axis(&format!("a{n}")).expect("an axis"));
    let seen = Arc::<Mutex<Seen>>::default();
    let controller = Hall {
        axes: axes.collect(),
        cycles: seconds * 1000,
        enabled: vec![true; DRIVES - STEADY],
        seen: Arc::clone(&seen),
    };
    let (mut heard, stop) = (Heard::default(), Arc::<CancelToken>::default());
    let attachments = Attachments {
        controller: Some(Box::new(controller)),
        link: Some(Box::new(SimLink::new(bus))),
        ..Attachments::default()
    };
    let outcome = run_attached(machine, options, stop, &mut heard, attachments);
    let warnings = heard.warnings();
    outcome
        .result
        .unwrap_or_else(|error| panic!("{error}; {warnings:?}"));
    let seen = seen.lock().expect("no panic while it is locked").clone();
    (seen, heard)
}

/// The unknown device is there in none of the run.
const ABSENT: &str = "[[fault]]\nkind = \"absent\"\ndevice = 16\n";

/// Losses of power, breaks, watchdogs, exchanged drives and an unknown device behind the last one at
/// random, each over before the next.
fn script(seed: u64, seconds: usize) -> (String, usize) {
    let mut state = seed | 1;
    let mut random = |below: u64| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state % below
    };
    let (mut text, mut events, mut at) = (format!("{ABSENT}for = \"2900ms\"\n"), 0, 3_000);
    // The last one returns before the end.
    while at + 9_000 < seconds as u64 * 1000 {
        let device = STEADY as u64 + random((DRIVES - STEADY) as u64);
        let outage = 20 + random(1500);
        let keys = match random(6) {
            4 => "kind = \"swap\"\nproduct = 0x77".to_owned(),
            // Until the next fault begins.
            5 => {
                text += &format!("{ABSENT}at = \"{}ms\"\nfor = \"{outage}ms\"\n", at + outage);
                "kind = \"watchdog\"".to_owned()
            }
            0 => "kind = \"link-break\"\nport = 0".to_owned(),
            1 => "kind = \"watchdog\"".to_owned(),
            _ => "kind = \"power-off\"".to_owned(),
        };
        text += &format!(
            "[[fault]]\n{keys}\ndevice = {device}\nat = \"{at}ms\"\nfor = \"{outage}ms\"\n"
        );
        events += 1;
        at += outage + 3_000 + random(3_000);
    }
    (text, events)
}

/// The steady drives receive bit by bit what they receive in an undisturbed run.
/// `ECAXIS_MACHINE_SECONDS` sets the machine time.
#[test]
fn drives_come_and_go_without_any_effect_on_the_others() {
    let total = std::env::var("ECAXIS_MACHINE_SECONDS").ok();
    let total = total.and_then(|seconds| seconds.parse().ok()).unwrap_or(60);
    let seconds = total.min(600);
    let calm = hall(faults(ABSENT), seconds).0;
    assert_eq!((calm.steady.len(), calm.ready), (seconds * 1000, DRIVES));
    let (mut events, mut returns, mut late) = (0, 0, 0);
    for seed in 1..=(total / seconds) as u64 {
        let (text, count) = script(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15), seconds);
        let (seen, heard) = hall(
            Options {
                seed,
                ..faults(&text)
            },
            seconds,
        );
        // A lost frame shows in the next cycles.
        let lost = |at: usize| {
            seen.stale
                .iter()
                .any(|stale| (*stale..stale + 3).contains(&at))
        };
        let both = seen.steady.iter().zip(&calm.steady).enumerate();
        let first = both.filter(|(_, (a, b))| a != b).find(|(at, _)| !lost(*at));
        assert_eq!(first, None, "seed {seed}: {text}");
        assert!(seen.stale.len() <= count, "seed {seed}: {:?}", seen.stale);
        assert_eq!(seen.wrong, Vec::<String>::new(), "seed {seed}");
        assert_eq!(seen.ready, DRIVES, "seed {seed}: {:?}", heard.warnings());
        for (name, after, _) in returned(&heard) {
            // Outages last 1.52 s at most; a second one may follow during the return.
            assert!(
                after < 9_000_000_000,
                "seed {seed}: {name} after {after} ns: {:?}",
                heard.warnings()
            );
            late += usize::from(after > 4_520_000_000);
            returns += 1;
        }
        events += count;
        let time = seed * seconds as u64;
        println!("{time} s of machine time: {events} faults, {returns} returns, {late} late");
    }
    assert!(returns >= events / 2, "{returns} of {events}");
    assert!(
        late <= returns / 100,
        "{late} of {returns} later than 3 s after their link"
    );
}

/// I/O and a drive with SYNC0, whose pulses no other device has.
fn io_and_drive(positions: [u8; 2], more: &str) -> Machine {
    machine(&io_and_drive_text(positions, more))
}

fn io_and_drive_text([io, drive]: [u8; 2], more: &str) -> String {
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
         [[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = {io}\n\
         [[device]]\nname = \"a\"\nesi = \"esi/EPOS4.xml\"\nposition = {drive}\nmode = \"csp\"\n\
         [device.axis]\nencoder = 2000\nlimits = {{ velocity = 50.0, acceleration = 500.0 }}\n\
         {more}"
    )
}

/// A lost device that must not return was reported as one that the file does not have, and its port
/// was closed.
#[test]
fn device_that_must_not_return_is_no_unknown_device() {
    let machine = io_and_drive(
        [0, 1],
        "[[stop.group]]\nname = \"g\"\naxes = [\"a\"]\noutside = \"continue\"\n\
         [[step]]\ndwell = \"3s\"\n",
    );
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"500ms\"\nfor = \"300ms\"\n";
    let (_, heard) = run(machine, faults(off));
    let warnings = heard.warnings();
    let refused = |w: &&String| w.contains("no other device in Op has SYNC0");
    assert_eq!(warnings.iter().filter(refused).count(), 1, "{warnings:?}");
    let unknown = |heard: &Heard| {
        let mut all = heard.0.iter();
        all.any(|progress| matches!(progress, Progress::UnknownDevice(_)))
    };
    assert!(!unknown(&heard), "{warnings:?}");
}

/// A group of I/O devices alone has no axis that a step could reset.
#[test]
fn group_without_axes_returns_by_itself() {
    let machine = io_and_drive(
        [1, 0],
        "[[stop.group]]\nname = \"g\"\ndevices = [\"io\"]\noutside = \"continue\"\n\
         [[step]]\nset = { io.\"Output 1\" = true }\n\
         [[step]]\nmove = { a = 60.0 }\n\
         [[step]]\nset = { io.\"Output 2\" = true }\n\
         [[step]]\nmove = { a = 0.0 }\n",
    );
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"500ms\"\nfor = \"200ms\"\n";
    let (outcome, heard) = run(machine, faults(off));
    let warnings = heard.warnings();
    outcome
        .result
        .unwrap_or_else(|error| panic!("{error}; {warnings:?}"));
    let names: Vec<_> = returned(&heard).into_iter().map(|found| found.0).collect();
    assert_eq!(names, ["io"], "{warnings:?}");
    let released = |progress: &Progress| matches!(progress, Progress::GroupReleased { .. });
    assert_eq!(heard.0.iter().filter(|p| released(p)).count(), 1);
}

/// A device without process data changes no working counter. The loss of a coupler stopped the whole
/// machine, whatever its group said.
#[test]
fn device_without_process_data_leaves_and_returns_with_its_group_alone() {
    let coupler = |place: &str| {
        format!(
            "\n[[device]]\nname = \"coupler\"\nesi = \"esi/terminals.xml\"\ntype = \"CP0\"\n{place}\n"
        )
    };
    let group = |devices: &str| {
        format!("\n[[stop.group]]\nname = \"g\"\ndevices = {devices}\noutside = \"continue\"\n")
    };
    let steps = "[[step]]\nmove = { a = 60.0 }\n[[step]]\nmove = { a = 0.0 }\n";
    let off = |device| {
        format!(
            "[[fault]]\nkind = \"power-off\"\ndevice = {device}\nat = \"500ms\"\nfor = \"300ms\"\n"
        )
    };
    let absent = "[[fault]]\nkind = \"absent\"\ndevice = 2\nfor = \"1s\"\n".to_owned();
    let optional = "alias = 7\noptional = true\nsim = { after = \"io\" }";
    let rows = [
        ("position = 2", "[\"coupler\"]", off(2), 1),
        ("position = 2", "[\"coupler\", \"io\"]", off(2), 1),
        // An optional device without power may leave.
        (optional, "[\"coupler\"]", off(2), 0),
        (optional, "[\"coupler\"]", absent, 0),
    ];
    for (place, devices, fault, stops) in rows {
        for exchange in ["same-cycle", "pipelined"] {
            let more = coupler(place) + &group(devices) + steps;
            let text = io_and_drive_text([1, 0], &more).replacen(
                "cycle =",
                &format!("exchange = \"{exchange}\"\ncycle ="),
                1,
            );
            let what = format!("{place}, {devices}, {fault}, {exchange}");
            let (outcome, heard) = run(machine(&text), faults(&fault));
            let warnings = heard.warnings();
            outcome
                .result
                .unwrap_or_else(|error| panic!("{what}: {error}; {warnings:?}"));
            let names: Vec<_> = returned(&heard).into_iter().map(|found| found.0).collect();
            assert_eq!(names, ["coupler"], "{what}: {warnings:?}");
            let released = |progress: &Progress| matches!(progress, Progress::GroupReleased { .. });
            assert_eq!(heard.0.iter().filter(|p| released(p)).count(), 1, "{what}");
            let summary = outcome.summary.expect("a summary");
            let causes: Vec<_> = summary.group_stops.iter().map(|stop| &stop.cause).collect();
            assert_eq!(causes.len(), stops, "{what}: {causes:?}");
            for cause in causes {
                assert_contains(cause, &["`coupler`", "no longer answers"]);
            }
        }
    }
    // Without a group, the machine stops.
    let text = io_and_drive_text([1, 0], &(coupler("position = 2") + steps));
    let (error, _) = run_badly(machine(&text), faults(&off(2)));
    assert_contains(&error, &["`coupler`", "no longer answers"]);
}
