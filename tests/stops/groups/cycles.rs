//! Group stops cycle by cycle, as a controller sees them.

use std::sync::{Arc, Mutex};

use ecaxis_axis::{AxisStatus, Command, CommandError, State};
use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::{AxisRef, Machine};
use ecaxis_master::rt::bus_monitor::StopCause;
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{Options, Outcome, run_with};
use proptest::prelude::*;

use super::{ALONE, AXES, BREAK, FAULT, GANTRY, alone, bench};
use ecaxis_test_support::{Heard, faults, machine};

struct Closure<F>(F);

impl<F: FnMut(&mut CycleContext<'_>) + Send> Controller for Closure<F> {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        (self.0)(machine);
    }
}

/// The status of every axis in the order of [`AXES`], and whether it is stopped, for each cycle.
type Trace = Vec<[(AxisStatus, bool); 3]>;

fn trace(
    machine: Machine,
    options: Options,
    mut act: impl FnMut(&mut CycleContext<'_>, &[AxisRef; 3], usize) + Send + 'static,
) -> (Outcome, Trace) {
    let axes = AXES.map(|name| machine.axis(name).expect("an axis"));
    let kept = Arc::new(Mutex::new(Trace::default()));
    let trace = Arc::clone(&kept);
    let controller = move |machine: &mut CycleContext<'_>| {
        let mut trace = trace.lock().expect("no panic while it is locked");
        let ready = axes.iter().all(|&axis| machine.axis(axis).ready);
        if machine.stopping() || (trace.is_empty() && !ready) {
            return;
        }
        trace.push(axes.map(|axis| (machine.axis(axis), machine.stopped(axis).is_some())));
        act(machine, &axes, trace.len());
    };
    let stop = Arc::<CancelToken>::default();
    let outcome = run_with(
        machine,
        options,
        stop,
        &mut Heard::default(),
        Box::new(Closure(controller)),
    );
    let trace = std::mem::take(&mut *kept.lock().expect("no panic while it is locked"));
    (outcome, trace)
}

fn turn(velocity: f64) -> Command {
    Command::Velocity {
        velocity,
        ramp: 1.0,
    }
}

/// The set-points of `z` continue in each cycle during the stop.
#[test]
fn a_controller_sees_the_stop_and_resets_the_group() {
    let (outcome, trace) = trace(alone(""), faults(FAULT), |machine, &[z, x, y], cycle| {
        let at = cycle as f64 * 1e-3;
        let swing = 5.0 - 5.0 * (at * 2.0).cos();
        machine.set_point(z, swing).expect("z goes on");
        match cycle {
            1 => {
                machine.command(x, turn(10.0)).expect("x is ready");
                machine.command(y, turn(10.0)).expect("y is ready");
            }
            2000 => {
                assert!(matches!(
                    machine.stopped(y),
                    Some(StopCause::DriveFault { axis: AxisIndex(1) })
                ));
                assert_eq!(machine.stopped(z), None);
                assert_eq!(
                    machine.command(y, turn(1.0)),
                    Err(CommandError::GroupStopped)
                );
                assert_eq!(
                    machine.command(y, Command::Enable),
                    Err(CommandError::GroupStopped)
                );
                assert_eq!(machine.set_point(y, 0.0), Err(CommandError::GroupStopped));
                machine
                    .command(x, Command::ResetFault)
                    .expect("to be reset");
            }
            2300 => {
                assert_eq!(machine.stopped(y), None);
                for axis in [x, y] {
                    assert!(!machine.axis(axis).enabled);
                    machine.command(axis, Command::Enable).expect("sound again");
                }
            }
            3000 => {
                assert!(machine.axis(x).ready && machine.axis(y).ready);
                machine.finish();
            }
            _ => {}
        }
    });
    outcome.result.expect("the machine goes on");
    assert!(trace.len() >= 3000);
    let stopped = trace.iter().filter(|cycle| cycle[1].1).count();
    assert!((500..1500).contains(&stopped), "{stopped}");
    for pair in trace.windows(2) {
        let [before, after] = [pair[0][0].0, pair[1][0].0];
        assert_eq!(after.stale_cycles, 0);
        let change = (after.target_velocity - before.target_velocity).abs();
        assert!(change <= 0.05, "{change}");
    }
}

/// While a group is lost, the other groups have fresh inputs and continue.
#[test]
fn only_the_lost_group_has_stale_inputs() {
    let (outcome, trace) = trace(alone(""), faults(BREAK), |machine, &[z, x, _], cycle| {
        if cycle == 1 {
            machine.command(x, turn(10.0)).expect("x is ready");
            machine.command(z, turn(10.0)).expect("z is ready");
        }
        if cycle == 2500 {
            machine.finish();
        }
    });
    outcome.result.expect("the machine goes on");
    let lost = trace
        .iter()
        .filter(|cycle| cycle[1].0.stale_cycles > 0)
        .count();
    assert!((1000..1500).contains(&lost), "{lost}");
    for [z, x, y] in trace {
        assert_eq!(z.0.stale_cycles, 0);
        assert_eq!(x.0.stale_cycles, y.0.stale_cycles);
        if x.0.stale_cycles > 2 {
            assert!(x.1 && y.1 && !z.1);
        }
        // A returning drive must not be enabled by its outputs: the enable command ends after
        // `lost_frames` (3) cycles and one more frame.
        if x.0.stale_cycles > 4 {
            assert_eq!(x.0.controlword & 0x0008, 0);
        }
    }
}

/// A brake closes before power-off.
#[test]
fn a_group_stop_waits_for_the_brake() {
    let keys = [("y", "brake = { release = \"50ms\", engage = \"300ms\" }")];
    let text = bench(&keys, &format!("{GANTRY}{ALONE}"));
    let (outcome, trace) = trace(machine(&text), faults(FAULT), |machine, _, cycle| {
        if cycle == 2500 {
            machine.finish();
        }
    });
    outcome.result.expect("the machine goes on");
    let held = trace
        .iter()
        .filter(|cycle| cycle[2].1 && cycle[2].0.enabled)
        .count();
    // The axis is already at rest: 100 ms to settle, 300 ms for the brake.
    assert!((380..500).contains(&held), "{held}");
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    Fault,
    Blocked,
    Break,
    PowerOff,
}

fn script(events: &[(Kind, usize, u64)]) -> String {
    let mut script = String::new();
    for &(kind, device, at) in events {
        let rest = match kind {
            Kind::Fault => format!("kind = \"drive-fault\"\ndevice = {device}\ncode = 0x7305\n"),
            Kind::Blocked => format!("kind = \"blocked\"\ndevice = {device}\nfor = \"200ms\"\n"),
            Kind::Break => {
                format!("kind = \"link-break\"\ndevice = {device}\nport = 0\nfor = \"30ms\"\n")
            }
            Kind::PowerOff => format!("kind = \"power-off\"\ndevice = {device}\n"),
        };
        script += &format!("[[fault]]\nat = \"{at}ms\"\n{rest}");
    }
    script
}

/// The number of cases, with four machine-seconds each.
fn cases() -> u32 {
    let seconds = std::env::var("ECAXIS_MACHINE_SECONDS").ok();
    let seconds = seconds.and_then(|s| s.parse::<u32>().ok());
    seconds.map_or(40, |seconds| seconds / 4 + 1)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: cases(), failure_persistence: None, ..ProptestConfig::default() })]

    /// After any fault of one axis, all axes of its group are at rest or without power within the
    /// time of their limits. The machine continues if only the group is affected.
    #[test]
    fn a_group_comes_to_rest_in_time(
        events in proptest::collection::vec(
            (prop_oneof![Just(Kind::Fault), Just(Kind::Blocked), Just(Kind::Break), Just(Kind::PowerOff)], 1_usize..3, 1200_u64..2500),
            1..4,
        ),
        others in prop_oneof![Just("ramp"), Just("quick-stop"), Just("no-power")],
        velocities in [-40.0..40.0_f64, -40.0..40.0],
        seed: u64,
    ) {
        let text = bench(&[], &format!("{GANTRY}{ALONE}others = \"{others}\"\n"));
        let options = Options { seed, ..faults(&script(&events)) };
        let (outcome, trace) = trace(machine(&text), options, move |machine, &[z, x, y], cycle| {
            if cycle == 1 {
                let _ = machine.command(x, turn(velocities[0]));
                let _ = machine.command(y, turn(velocities[1]));
                let _ = machine.command(z, turn(10.0));
            }
            if cycle == 4000 {
                machine.finish();
            }
        });
        prop_assert!(outcome.result.is_ok(), "{:?}", outcome.result);
        prop_assert!(trace.len() >= 4000);
        // 80 ms from 40 turns/s, and 100 ms to settle. A quick stop delayed by a blocked shaft or
        // lost frames has two seconds.
        let mut stopped_for = 0;
        for [z, x, y] in trace.iter().take(4000) {
            prop_assert!(!z.1 && z.0.enabled && z.0.stale_cycles == 0);
            prop_assert_eq!(x.1, y.1);
            stopped_for = if x.1 { stopped_for + 1 } else { 0 };
            for (status, _) in [x, y] {
                if stopped_for > 400 && status.stale_cycles == 0 {
                    prop_assert!(!status.enabled || status.at_rest, "{status:?}");
                }
                if stopped_for > 2200 {
                    let enables = status.controlword & 0x000f == 0x000f;
                    prop_assert!(!enables, "{status:?}");
                    let powered = status.state == State::OperationEnabled && status.stale_cycles == 0;
                    prop_assert!(!powered, "{status:?}");
                }
            }
        }
    }
}
