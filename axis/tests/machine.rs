//! Random simulation of a machine: commands, faults, mode switches and lost frames, checked in
//! every cycle.
//!
//! `cargo test` runs a bounded part; `ECAXIS_MACHINE_SECONDS` requests more, `ECAXIS_SEED` a single
//! run.

use crate::common::{DT, Drive, LIMITS, Rig, all};
use ecaxis_axis::{
    Axis, AxisConfig, AxisStatus, Brake, Command, Edge, FaultReset, FeedForward, Inputs, Limits,
    Loops, Mode, Outputs, Probe, Source, State, StopMethod, Supervision, TorqueWatch,
};

const COUNTS_PER_UNIT: f64 = 400.0;
const MRPM_PER_UNIT: f64 = 12_000.0;

/// Simulated seconds per seed.
const RUN_S: f64 = 10.0;

/// Longest time from trip to power off: a ramp or the drive's halt, the wait for lost frames, the
/// brake, a few cycles.
const STOPPED_WITHIN_S: f64 = 2.0 * (1.0 + 0.2 + 0.1) + 3.0 * 0.1 + 0.05 + 0.01;

/// splitmix64.
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Returns true once in `n` calls on average.
    fn one_in(&mut self, n: u64) -> bool {
        self.next().is_multiple_of(n)
    }

    fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[(self.next() % from.len() as u64) as usize]
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (self.next() >> 11) as f64 / (1u64 << 53) as f64 * (high - low)
    }

    /// Returns a number that is mostly within limits, and sometimes any bit pattern.
    fn number(&mut self, most: f64) -> f64 {
        if self.one_in(20) {
            f64::from_bits(self.next())
        } else {
            self.between(-most, most)
        }
    }
}

const MODES: [Mode; 5] = [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pp, Mode::Pv];

fn config(dice: &mut Dice) -> AxisConfig {
    let limits = Limits {
        position: dice.pick(&[None, Some([-50.0, 50.0])]),
        following_error: dice.pick(&[None, Some(1.0)]),
        ..LIMITS
    };
    let base = all(dice.pick(&MODES), limits);
    let loops = Loops {
        csv: base.loops.csv.filter(|_| !dice.one_in(2)),
        cst: base.loops.cst.filter(|_| !dice.one_in(2)),
        csp: FeedForward {
            velocity: dice.pick(&[0.0, 0.5]),
            acceleration: dice.pick(&[0.0, 0.01]),
        },
    };
    AxisConfig {
        loops,
        jerk_limited: dice.one_in(3),
        mode_time_s: 0.2,
        supervision: Supervision {
            reaction: dice.pick(&[
                StopMethod::QuickStop,
                StopMethod::Ramp,
                StopMethod::DisableVoltage,
            ]),
            emergency: dice.pick(&[StopMethod::QuickStop, StopMethod::DisableVoltage]),
            torque: dice.pick(&[
                None,
                Some(TorqueWatch {
                    percent: 90.0,
                    time_s: 0.1,
                }),
            ]),
            ..Supervision::default()
        },
        brake: dice.pick(&[
            Brake::default(),
            Brake {
                release_s: 0.02,
                engage_s: 0.03,
            },
        ]),
        fault_reset: dice.pick(&[
            FaultReset::Manual,
            FaultReset::Automatic {
                tries: 3,
                delay_s: 0.05,
            },
        ]),
        ..base
    }
}

fn command(dice: &mut Dice, mode: Mode) -> Command {
    let part = |dice: &mut Dice| {
        if dice.one_in(20) {
            dice.number(2.0)
        } else {
            dice.between(0.01, 1.0)
        }
    };
    let (speed, ramp) = (part(dice), part(dice));
    match dice.next() % 20 {
        0 => Command::Stop,
        1 if dice.one_in(3) => Command::Disable,
        2 if dice.one_in(3) => Command::QuickStop,
        2 if dice.one_in(3) => Command::DisableVoltage,
        3 if dice.one_in(4) => Command::EmergencyStop,
        4..=6 => Command::SetMode(dice.pick(&MODES)),
        7 | 8 => Command::Home {
            timeout_s: dice.pick(&[0.05, 1.0]),
        },
        9 => Command::ArmProbe {
            probe: dice.pick(&[Probe::First, Probe::Second]),
            edge: Edge::Positive,
            source: Source::Input,
            stop: dice.one_in(2),
        },
        10 => Command::MoveBy {
            distance: dice.number(30.0),
            speed,
            ramp,
        },
        11 => Command::Torque {
            percent: dice.number(110.0),
            ramp_s: dice.between(0.0, 0.3),
        },
        12 | 13 => Command::Velocity {
            velocity: dice.number(210.0),
            ramp,
        },
        _ if mode == Mode::Cst && dice.one_in(2) => Command::Torque {
            percent: dice.between(-20.0, 20.0),
            ramp_s: 0.1,
        },
        _ if matches!(mode, Mode::Csv | Mode::Pv) => Command::Velocity {
            velocity: dice.between(-200.0, 200.0),
            ramp,
        },
        _ => Command::MoveTo {
            position: dice.number(50.0),
            speed,
            ramp,
        },
    }
}

/// Values of the previous cycle, and pending obligations.
struct Checker {
    config: AxisConfig,
    /// True while power is requested.
    asked: bool,
    ending: bool,
    before: (AxisStatus, Outputs),
    /// Target step of the previous cycle, counts.
    step_before: f64,
    /// Time by which power must be off.
    deadline_s: Option<f64>,
}

/// Returns the modes that the drive may be in, according to the status.
fn in_force(status: &AxisStatus) -> [Option<Mode>; 2] {
    [Some(status.mode), status.switching]
}

impl Checker {
    fn took(&mut self, command: Command, taken: bool) {
        match command {
            Command::Enable if taken => (self.asked, self.ending) = (true, false),
            Command::Disable => self.ending = true,
            Command::QuickStop | Command::EmergencyStop | Command::DisableVoltage => {
                self.asked = false;
            }
            _ => {}
        }
    }

    /// Checks that targets after skipped cycles continue from rest.
    fn left_out(&mut self, axis: &Axis, out: Outputs) {
        let (was, sent) = self.before;
        self.before = (axis.status(), out);
        if self.before.0.stale_cycles > 2 {
            self.step_before = 0.0;
        }
        if was.enabled && in_force(&was) == [Some(Mode::Csp), None] {
            let step = f64::from(out.target_position.wrapping_sub(sent.target_position));
            let most = self.config.limits.velocity * DT * COUNTS_PER_UNIT + 1.0;
            assert!(step.abs() <= most, "{step} counts\n{was:#?}");
        }
    }

    fn check(
        &mut self,
        axis: &Axis,
        out: Outputs,
        inputs: &Inputs,
        now_s: f64,
    ) -> Result<(), String> {
        let status = axis.status();
        let (was, sent) = self.before;
        let limits = self.config.limits;
        let ensure = |so: bool, what: &str| {
            if so {
                Ok(())
            } else {
                Err(format!(
                    "{what}\nbefore: {sent:?}\nnow: {out:?}\n{status:#?}"
                ))
            }
        };
        ensure(
            self.asked || out.controlword & 0x09 == 0,
            "power without a command",
        )?;
        ensure(status.guarded_cycles == 0, "the last guard had to help")?;

        let held = status.enabled && was.enabled;
        let frozen = held && status.stale_cycles > 2;
        // A goal is not a set-point: the drive plans its own motion.
        let goals = matches!(status.mode, Mode::Pp | Mode::Pv);
        if frozen && !goals {
            let targets = |out: &Outputs| match status.mode {
                Mode::Csv => out.target_velocity,
                Mode::Cst => i32::from(out.target_torque),
                _ => out.target_position,
            };
            ensure(
                targets(&out) == targets(&sent),
                "targets move without frames",
            )?;
        }
        let live = |mode: Mode| {
            held && in_force(&status).contains(&Some(mode)) && in_force(&was).contains(&Some(mode))
        };
        // The same control law in the previous cycle and in this one.
        let steady = |mode: Mode| held && status.mode == mode && was.mode == mode;

        let step = f64::from(out.target_position.wrapping_sub(sent.target_position));
        if steady(Mode::Csp) {
            let most = limits.velocity * DT * COUNTS_PER_UNIT + 1.0;
            ensure(step.abs() <= most, "position steps")?;
            let change = (step - self.step_before).abs();
            let most = limits.acceleration * DT * DT * COUNTS_PER_UNIT + 2.0;
            ensure(frozen || change <= most, "velocity of positions steps")?;
        }
        self.step_before = if steady(Mode::Csp) && !frozen {
            step
        } else if status.enabled
            && status.mode == Mode::Csp
            && (was.mode != Mode::Csp || !was.enabled)
        {
            // Taken over at its velocity.
            status.target_velocity * DT * COUNTS_PER_UNIT
        } else {
            0.0
        };

        let change = f64::from(out.target_velocity.abs_diff(sent.target_velocity));
        let most = limits.acceleration * DT * MRPM_PER_UNIT;
        if steady(Mode::Csv) && status.switching.is_none() && was.switching.is_none() {
            let parts = if self.config.loops.csv.is_some() {
                2.0
            } else {
                1.0
            };
            ensure(change <= parts * most + 1.0, "velocity steps")?;
        }
        ensure(
            f64::from(out.target_velocity.abs()) <= limits.velocity * MRPM_PER_UNIT + 1.0,
            "velocity above its limit",
        )?;
        ensure(
            f64::from(out.target_torque.abs()) <= limits.torque * 10.0,
            "torque above its limit",
        )?;
        ensure(
            f64::from(out.profile_velocity) <= limits.velocity * MRPM_PER_UNIT + 1.0
                && f64::from(out.profile_acceleration) <= limits.acceleration * MRPM_PER_UNIT + 1.0,
            "profile above the limits",
        )?;
        // A new mode starts where its targets were during the switch.
        let entered = |mode: Mode| held && status.mode == mode && was.switching == Some(mode);
        if entered(Mode::Csp) {
            let most = limits.velocity * DT * COUNTS_PER_UNIT + 1.0;
            ensure(step.abs() <= most, "position steps into CSP")?;
        }
        if entered(Mode::Csv) {
            ensure(change <= 2.0 * most + 1.0, "velocity steps into CSV")?;
        }
        if self.config.loops.cst.is_none() && (steady(Mode::Cst) || entered(Mode::Cst)) {
            let change = out.target_torque.abs_diff(sent.target_torque);
            ensure(change <= 11, "torque steps")?;
        }
        let offsets = (out.velocity_offset, out.torque_offset) == (0, 0);
        let csp = status.enabled && status.mode == Mode::Csp && status.switching.is_none();
        ensure(offsets || csp, "offsets outside CSP")?;
        let counts = |mode| live(mode) || in_force(&status).contains(&Some(mode));
        ensure(
            out.target_velocity == 0
                || counts(Mode::Csv)
                || counts(Mode::Pv)
                || status.switching == Some(Mode::Csp),
            "velocity where none counts",
        )?;
        ensure(
            out.target_torque == 0 || counts(Mode::Cst),
            "torque where none counts",
        )?;

        if !status.enabled {
            ensure(out.target_torque == 0, "a torque without power")?;
            ensure(out.target_velocity == 0, "a velocity without power")?;
            ensure(
                out.controlword & 0x0170 == 0,
                "bits of a mode without power",
            )?;
        }
        // While following, and in the cycle of enabling: the reported position. An axis that has begun
        // to move meanwhile is taken over.
        // The values of an unlisted Statusword are not believed.
        let believed = status.statusword == inputs.statusword;
        if !held && inputs.fresh && believed && (status.mode == Mode::Csp || !status.enabled) {
            let speed = status.velocity.abs();
            let moves = speed > limits.velocity * 0.01;
            let lead = if moves && status.enabled {
                speed * self.config.dead_time_s * COUNTS_PER_UNIT + 2.0
            } else {
                0.0
            };
            let step = inputs
                .position
                .map_or(0, |at| at.wrapping_sub(out.target_position));
            ensure(f64::from(step.abs()) <= lead, "enabled with a step")?;
        }
        ensure(
            out.controlword & 0x0F == 0x0F || out.controlword & 0x0170 == 0,
            "bits of a mode next to another command",
        )?;
        ensure(
            out.brake_open || !status.ready,
            "ready against a closed brake",
        )?;

        // A trip or an emergency stop ends without power, in bounded time.
        let no_power = out.controlword & 0x0F != 0x0F && out.controlword & 0x06 != 0x02;
        if no_power || (status.trip.is_none() && status.ready) {
            self.deadline_s = None;
        } else if status.trip.is_some() && was.trip.is_none() {
            self.deadline_s.get_or_insert(now_s + STOPPED_WITHIN_S);
        }
        ensure(
            self.deadline_s.is_none_or(|by| now_s <= by),
            "still powered after a trip",
        )?;

        let ramps = self.config.supervision.reaction == StopMethod::Ramp;
        self.ending |= status.trip.is_some() && ramps;
        let ended = status.fault.is_some() && !status.resetting || status.trip.is_some() && !ramps;
        if ended || self.ending && !status.enabled {
            self.asked = false;
        }
        self.before = (status, out);
        Ok(())
    }
}

#[derive(Default)]
struct Sum {
    cycles: u64,
    ready: u64,
    taken: u64,
    refused: u64,
    switches: u64,
    homed: u64,
    trips: u64,
    faults: u64,
}

fn run(seed: u64, sum: &mut Sum) -> Result<(), String> {
    let mut dice = Dice(seed);
    let config = config(&mut dice);
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
    let drive = &mut rig.drive;
    drive.mode_delay = dice.pick(&[Some(0), Some(1), Some(4), Some(30)]);
    drive.quick_stop_stays = dice.one_in(2);
    drive.home_at = dice.pick(&[None, Some(-4000.0), Some(f64::MAX)]);
    drive.home_is = dice.pick(&[0.0, 12_345.0]);
    let mut checker = Checker {
        config,
        asked: false,
        ending: false,
        before: (rig.axis.status(), rig.out),
        step_before: 0.0,
        deadline_s: None,
    };
    let cycles = (RUN_S / DT) as u64;
    let (mut lost, mut unheard, mut quiet, mut unblock) = (0u32, 0u32, 0u32, 0u64);
    for cycle in 0..cycles {
        let (mut word, mut shown, mut left_out) = (None, None, 0u32);
        quiet = quiet.saturating_sub(1);
        if quiet == 0 {
            quiet = dice.pick(&[1, 10, 50, 200, 200, 400]);
            let status = rig.axis.status();
            let order = if status.ready || dice.one_in(10) {
                Some(command(&mut dice, status.mode))
            } else if status.trip.is_some() || status.fault.is_some() {
                Some(Command::ResetFault)
            } else {
                Some(Command::Enable)
            };
            if let Some(order) = order {
                let taken = rig.axis.command(order).is_ok();
                checker.took(order, taken);
                *if taken {
                    &mut sum.taken
                } else {
                    &mut sum.refused
                } += 1;
            }
            match dice.next() % 60 {
                0 => rig.drive.fault(),
                1 => word = Some(dice.next() as u16),
                2 => {
                    rig.drive.state = dice.pick(&[
                        State::SwitchOnDisabled,
                        State::ReadyToSwitchOn,
                        State::SwitchedOn,
                        State::QuickStopActive,
                        State::Fault,
                    ]);
                }
                3 => (rig.drive.blocked, unblock) = (true, cycle + 500),
                4 => shown = Some(dice.next() as i8),
                5 => lost = dice.pick(&[50, 500, 4000]),
                6..=10 => lost = dice.pick(&[1, 2, 3, 4, 10]),
                11..=13 => unheard = dice.pick(&[1, 2, 3, 4, 10, 50]),
                14..=16 => left_out = dice.pick(&[1, 2, 3, 4, 40]),
                _ => {}
            }
        }
        let turns = |drive: &Drive| {
            drive.state == State::OperationEnabled && drive.mode != Mode::Csp.code()
        };
        if left_out > 0 {
            if turns(&rig.drive) {
                rig.drive.position += rig.drive.velocity * DT * f64::from(left_out);
            }
            rig.out = rig.axis.skipped(left_out);
            checker.left_out(&rig.axis, rig.out);
        }
        rig.drive.blocked &= cycle < unblock;
        let mut inputs = rig.drive.inputs();
        inputs.statusword = word.unwrap_or(inputs.statusword);
        inputs.mode_display = shown.or(inputs.mode_display);
        inputs.touch_probe_status = Some(if dice.one_in(50) { 0x0303 } else { 0x0101 });
        inputs.fresh = lost == 0 && unheard == 0;
        if lost == 0 {
            rig.drive.cycle(&rig.out, DT);
        } else if turns(&rig.drive) {
            // The motor keeps turning.
            rig.drive.position += rig.drive.velocity * DT;
        }
        // A motor that catches up does not exceed its maximum speed.
        let most = 1.1 * LIMITS.velocity * COUNTS_PER_UNIT;
        rig.drive.velocity = rig.drive.velocity.clamp(-most, most);
        lost = lost.saturating_sub(1);
        unheard = unheard.saturating_sub(1);
        rig.out = rig.axis.step(&inputs, DT);
        let was = checker.before.0;
        checker
            .check(&rig.axis, rig.out, &inputs, cycle as f64 * DT)
            .map_err(|what| format!("seed {seed}, cycle {cycle}: {what}"))?;
        let status = checker.before.0;
        sum.cycles += 1;
        sum.ready += u64::from(status.ready);
        sum.switches += u64::from(status.mode != was.mode);
        sum.homed += u64::from(status.homed() && !was.homed());
        sum.trips += u64::from(status.trip.is_some() && was.trip.is_none());
        sum.faults += u64::from(status.fault.is_some() && was.fault.is_none());
    }
    Ok(())
}

#[test]
fn axis_keeps_its_promises_in_random_runs() {
    let asked = |name: &str| {
        std::env::var(name)
            .ok()
            .and_then(|text| text.parse::<u64>().ok())
    };
    let mut sum = Sum::default();
    if let Some(seed) = asked("ECAXIS_SEED") {
        return run(seed, &mut sum).unwrap_or_else(|what| panic!("{what}"));
    }
    let seconds = asked("ECAXIS_MACHINE_SECONDS").unwrap_or(1000);
    for seed in 0..seconds.div_ceil(RUN_S as u64) {
        run(seed, &mut sum).unwrap_or_else(|what| panic!("{what}"));
    }
    let share = sum.ready as f64 / sum.cycles as f64;
    println!(
        "{:.0} machine-seconds, ready {:.0} % of it; commands taken {}, refused {}; modes switched {}, homed {}, trips {}, faults {}",
        sum.cycles as f64 * DT,
        share * 100.0,
        sum.taken,
        sum.refused,
        sum.switches,
        sum.homed,
        sum.trips,
        sum.faults,
    );
    // The simulation is only meaningful if the axis is often enabled and many events occur.
    assert!(share > 0.3, "{share}");
    for count in [
        sum.taken,
        sum.refused,
        sum.switches,
        sum.homed,
        sum.trips,
        sum.faults,
    ] {
        assert!(count * 50 > seconds, "{count} in {seconds} s");
    }
}
