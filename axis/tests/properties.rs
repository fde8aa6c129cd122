//! Random commands, faults, Statuswords and lost frames: properties that hold in every cycle.

use crate::common::{DT, Drive, LIMITS, Rig, axis, scale};
use ecaxis_axis::{Axis, AxisConfig, Command, Inputs, Limits, Mode, Outputs, State};
use proptest::prelude::*;

#[derive(Debug, Clone, Copy)]
enum Event {
    Command(Command),
    Fault,
    /// The drive shows this word for one cycle.
    Word(u16),
    /// The drive changes its state without a request.
    Jump(State),
    Lose(u8),
    Block(bool),
    Mode(i8),
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        8 => -60.0..60.0f64,
        2 => -250.0..250.0f64,
        1 => any::<f64>(),
    ]
}

fn part() -> impl Strategy<Value = f64> {
    prop_oneof![8 => 0.01..=1.0f64, 1 => any::<f64>()]
}

fn command() -> impl Strategy<Value = Command> {
    prop_oneof![
        4 => Just(Command::Enable),
        1 => Just(Command::Disable),
        3 => Just(Command::ResetFault),
        1 => Just(Command::Stop),
        1 => Just(Command::QuickStop),
        6 => (number(), part(), part())
            .prop_map(|(position, speed, ramp)| Command::MoveTo { position, speed, ramp }),
        6 => (number(), part()).prop_map(|(velocity, ramp)| Command::Velocity { velocity, ramp }),
        6 => (number(), 0.0..0.3f64).prop_map(|(percent, ramp_s)| Command::Torque { percent, ramp_s }),
    ]
}

fn event() -> impl Strategy<Value = Event> {
    let states = vec![
        State::NotReadyToSwitchOn,
        State::SwitchOnDisabled,
        State::ReadyToSwitchOn,
        State::SwitchedOn,
        State::QuickStopActive,
        State::Fault,
    ];
    prop_oneof![
        20 => command().prop_map(Event::Command),
        1 => Just(Event::Fault),
        1 => any::<u16>().prop_map(Event::Word),
        1 => prop::sample::select(states).prop_map(Event::Jump),
        3 => (1u8..6).prop_map(Event::Lose),
        1 => (1u8..=100).prop_map(Event::Lose),
        1 => any::<bool>().prop_map(Event::Block),
        1 => any::<i8>().prop_map(Event::Mode),
    ]
}

fn mode() -> impl Strategy<Value = Mode> {
    prop::sample::select(vec![Mode::Csp, Mode::Csv, Mode::Cst])
}

/// Model of the requested power only.
#[derive(Debug, Default)]
struct Asked {
    power: bool,
    end: bool,
}

struct Checker {
    mode: Mode,
    asked: Asked,
    before: Outputs,
    velocity_before: f64,
    planned_before: f64,
    /// True if the set-point of the previous cycle was the axis's own and not the actual value.
    enabled_before: bool,
    /// Half the position range; wider for an axis that was enabled outside it.
    range: f64,
}

const COUNTS_PER_UNIT: f64 = 400.0;
const MRPM_PER_UNIT: f64 = 12_000.0;

impl Checker {
    fn check(&mut self, rig: &Rig, inputs: &Inputs) -> Result<(), TestCaseError> {
        let status = rig.axis.status();
        let out = rig.out;
        let step = out
            .target_position
            .wrapping_sub(self.before.target_position);
        let velocity = f64::from(step) / COUNTS_PER_UNIT / DT;
        if !self.asked.power {
            prop_assert_eq!(
                out.controlword & 0x09,
                0,
                "power without a command: {:?}",
                status
            );
        }
        prop_assert_eq!(status.guarded_cycles, 0);
        if self.mode != Mode::Csv {
            prop_assert_eq!(out.target_velocity, 0);
        }
        if self.mode != Mode::Cst {
            prop_assert_eq!(out.target_torque, 0);
        }
        let held = status.enabled && self.enabled_before;
        // Too many lost frames: targets are constant, and in CSP the motion continues from rest.
        let frozen = held && status.stale_cycles > 2;
        if frozen {
            let targets =
                |out: &Outputs| (out.target_position, out.target_velocity, out.target_torque);
            prop_assert_eq!(targets(&out), targets(&self.before));
            if self.mode == Mode::Csp {
                prop_assert_eq!(status.target_velocity, 0.0);
                self.planned_before = 0.0;
                self.velocity_before = 0.0;
            }
        }
        // The plan before rounding to counts, with full precision.
        let planned = (status.target_velocity - self.planned_before).abs();
        let most = LIMITS.acceleration * DT * (1.0 + 1e-6);
        prop_assert!(!held || planned <= most, "velocity changed by {planned}");
        prop_assert!(status.target_velocity.abs() <= LIMITS.velocity);
        self.planned_before = status.target_velocity;
        match self.mode {
            Mode::Csp if held => {
                // Rounding to whole counts: one for a step, two for the difference of steps.
                let most = LIMITS.velocity * DT * COUNTS_PER_UNIT + 1.0;
                prop_assert!(f64::from(step).abs() <= most, "step of {step} counts");
                let change = (velocity - self.velocity_before).abs() * DT * COUNTS_PER_UNIT;
                let most = LIMITS.acceleration * DT * DT * COUNTS_PER_UNIT + 2.0;
                prop_assert!(
                    change <= most,
                    "velocity changed by {change} counts per cycle"
                );
                prop_assert!(status.target_position.abs() <= self.range + 1e-9);
            }
            Mode::Csv => {
                let change = out.target_velocity.abs_diff(self.before.target_velocity);
                let most = LIMITS.acceleration * DT * MRPM_PER_UNIT + 1.0;
                prop_assert!(
                    !held || f64::from(change) <= most,
                    "velocity changed by {change}"
                );
                prop_assert!(
                    f64::from(out.target_velocity.abs()) <= LIMITS.velocity * MRPM_PER_UNIT
                );
            }
            Mode::Cst => {
                let change = out.target_torque.abs_diff(self.before.target_torque);
                prop_assert!(!held || change <= 11, "torque changed by {change}");
                prop_assert!(out.target_torque.abs() <= 1000);
            }
            _ => {}
        }
        if !status.enabled {
            prop_assert_eq!((out.target_velocity, out.target_torque), (0, 0));
        }
        // While following, and in the cycle of enabling: the reported position. An axis that has begun
        // to move meanwhile is taken over.
        let moves = status.velocity.abs() > LIMITS.velocity * 0.01;
        // The values of an unlisted Statusword are not believed.
        if !held
            && inputs.fresh
            && status.statusword == inputs.statusword
            && !(status.enabled && (self.enabled_before || moves && self.mode != Mode::Cst))
        {
            prop_assert_eq!(Some(out.target_position), inputs.position);
        }
        self.velocity_before = match (held, status.enabled) {
            (true, _) => velocity,
            (false, true) => status.target_velocity,
            (false, false) => 0.0,
        };
        if !held {
            self.range = status.position.abs().max(50.0);
        }
        self.before = out;
        self.enabled_before = status.enabled;
        Ok(())
    }
}

fn scenario(mode: Mode, events: &[(Event, u8)]) -> Result<u32, TestCaseError> {
    let mut rig = Rig::new(axis(mode), Drive::at(0));
    let mut checker = Checker {
        mode,
        asked: Asked::default(),
        before: rig.out,
        velocity_before: 0.0,
        planned_before: 0.0,
        enabled_before: false,
        range: 50.0,
    };
    let mut enabled_cycles = 0;
    for &(event, wait) in events {
        let (mut word, mut lost, mut shown_mode) = (None, 0, None);
        match event {
            Event::Command(command) => {
                let taken = rig.axis.command(command).is_ok();
                match command {
                    Command::Enable if taken => {
                        checker.asked = Asked {
                            power: true,
                            end: false,
                        }
                    }
                    Command::Disable => checker.asked.end = true,
                    Command::QuickStop => checker.asked.power = false,
                    _ => {}
                }
            }
            Event::Fault => rig.drive.fault(),
            Event::Word(bits) => word = Some(bits),
            Event::Jump(state) => rig.drive.state = state,
            Event::Lose(cycles) => lost = cycles,
            Event::Block(blocked) => rig.drive.blocked = blocked,
            Event::Mode(mode) => shown_mode = Some(mode),
        }
        for cycle in 0..=wait {
            let mut inputs = rig.drive.inputs();
            inputs.fresh = cycle >= lost;
            if cycle == 0 {
                inputs.statusword = word.unwrap_or(inputs.statusword);
                inputs.mode_display = shown_mode.or(inputs.mode_display);
            }
            if inputs.fresh {
                rig.drive.cycle(&rig.out, DT);
            }
            rig.out = rig.axis.step(&inputs, DT);
            checker.check(&rig, &inputs)?;
            let status = rig.axis.status();
            enabled_cycles += u32::from(status.ready);
            // A fault or a trip ends the request; so does the end of deceleration for a disable.
            let ended = status.fault.is_some() && !status.resetting || status.trip.is_some();
            if ended || checker.asked.end && !status.enabled {
                checker.asked.power = false;
            }
        }
    }
    Ok(enabled_cycles)
}

fn config() -> ProptestConfig {
    ProptestConfig {
        cases: ProptestConfig::default().cases.max(400),
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn every_cycle_keeps_the_limits(mode in mode(), events in prop::collection::vec((event(), any::<u8>()), 1..60)) {
        scenario(mode, &events)?;
    }

    /// Random inputs, commands and times.
    #[test]
    fn random_inputs_do_not_panic(
        mode in mode(),
        cycles in prop::collection::vec(
            (any::<u16>(), any::<Option<i32>>(), any::<Option<i32>>(), any::<Option<i16>>(), any::<Option<i8>>(),
             any::<bool>(), any::<f64>(), prop::option::of(command())),
            1..200,
        ),
        wide in any::<bool>(),
    ) {
        let limits = if wide { Limits { position: None, velocity: 1e4, following_error: None, ..LIMITS } } else { LIMITS };
        let mut axis = Axis::new(AxisConfig::new(mode, scale(), limits)).unwrap();
        let mut asked = false;
        for (statusword, position, velocity, torque, mode_display, fresh, dt, command) in cycles {
            if let Some(command) = command {
                asked |= axis.command(command).is_ok() && command == Command::Enable;
            }
            let inputs = Inputs { statusword, position, velocity, torque, mode_display, fresh, ..Inputs::default() };
            let out = axis.step(&inputs, dt);
            let status = axis.status();
            prop_assert!(status.position.is_finite() && status.target_position.is_finite());
            prop_assert!(status.velocity.is_finite() && status.target_velocity.is_finite());
            if !asked {
                prop_assert_eq!(out.controlword & 0x09, 0);
            }
        }
    }
}

/// The scenarios above are only meaningful if the axis is often enabled in them.
#[test]
fn plain_scenario_is_mostly_enabled() {
    let go = |position| {
        Event::Command(Command::MoveTo {
            position,
            speed: 1.0,
            ramp: 1.0,
        })
    };
    let events = [
        (Event::Command(Command::Enable), 20),
        (go(50.0), 200),
        (Event::Lose(3), 20),
        (go(-50.0), 250),
        (Event::Fault, 20),
        (Event::Command(Command::ResetFault), 250),
        (Event::Command(Command::Enable), 20),
    ];
    assert!(scenario(Mode::Csp, &events).unwrap() > 480);
}
