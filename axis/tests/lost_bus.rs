//! Lost frames: how far the set-point runs ahead of a drive that holds its last target, and how the
//! motion continues.

use crate::common;
use crate::common::{DT, Drive, LIMITS, Rig, axis, scale};
use ecaxis_axis::{Axis, AxisConfig, AxisStatus, Command, Limits, Mode, Outputs, State};
use proptest::prelude::*;

const COUNTS_PER_UNIT: f64 = 400.0;
const MRPM_PER_UNIT: f64 = 12_000.0;

/// Number of good cycles, then of lost cycles.
type Burst = (u32, u32);

const fn go(position: f64, speed: f64, ramp: f64) -> Command {
    Command::MoveTo {
        position,
        speed,
        ramp,
    }
}

const fn to(position: f64) -> Command {
    go(position, 1.0, 1.0)
}

const fn run_at(velocity: f64) -> Command {
    Command::Velocity {
        velocity,
        ramp: 1.0,
    }
}

const fn push(percent: f64) -> Command {
    Command::Torque {
        percent,
        ramp_s: 0.0,
    }
}

fn enabled(mode: Mode, limits: Limits) -> Rig {
    let axis = Axis::new(AxisConfig::new(mode, scale(), limits)).unwrap();
    let mut rig = Rig::new(axis, Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    rig
}

/// No position range, and no trip on the velocity that the motor keeps without supervision.
const ENDLESS: Limits = Limits {
    position: None,
    ..LIMITS
};

/// Runs one cycle. Returns the status, and the outputs that reached the drive, if any.
fn cycle(rig: &mut Rig, delivered: bool) -> (AxisStatus, Option<Outputs>) {
    let out = rig.out;
    if !delivered
        && rig.drive.mode == Mode::Csv.code()
        && rig.drive.state == State::OperationEnabled
    {
        rig.drive.position += rig.drive.velocity * DT;
    }
    let status = rig.cycle_with(delivered);
    // A motor that lags behind its target does not catch up faster than its maximum speed.
    let most = LIMITS.velocity * COUNTS_PER_UNIT;
    rig.drive.velocity = rig.drive.velocity.clamp(-most, most);
    (status, delivered.then_some(out))
}

/// Bounds of every step in the targets that a CSP drive receives.
#[derive(Debug)]
struct Seen {
    target: i32,
    /// Counts per cycle over the `over` cycles since the previous delivery; both 0 at rest.
    velocity: f64,
    over: f64,
    lost: u32,
}

impl Seen {
    fn new(rig: &Rig) -> Self {
        Self {
            target: rig.out.target_position,
            velocity: 0.0,
            over: 0.0,
            lost: 0,
        }
    }

    fn check(&mut self, delivered: Option<Outputs>) -> Result<(), TestCaseError> {
        let Some(out) = delivered else {
            self.lost += 1;
            return Ok(());
        };
        let step = f64::from(out.target_position.wrapping_sub(self.target));
        let most = 3.0 * LIMITS.velocity * DT * COUNTS_PER_UNIT + 1.0;
        prop_assert!(
            step.abs() <= most,
            "{step} counts after {} lost cycles",
            self.lost
        );
        let over = f64::from(self.lost + 1);
        if self.lost > 2 {
            (self.velocity, self.over) = (0.0, 0.0);
        } else {
            // Means over neighbouring intervals differ by at most the acceleration between their
            // middles.
            let velocity = step / over;
            let change = (velocity - self.velocity).abs();
            let steepest = LIMITS.acceleration * DT * DT * COUNTS_PER_UNIT;
            let most = steepest * (over + self.over).max(2.0) / 2.0 + 2.0;
            prop_assert!(
                change <= most,
                "velocity changed by {change} counts per cycle, not {most}"
            );
            (self.velocity, self.over) = (velocity, over);
        }
        self.target = out.target_position;
        self.lost = 0;
        Ok(())
    }
}

fn csp(moves: &[(Command, u32)], bursts: &[Burst], last: f64) -> Result<(), TestCaseError> {
    // Tight: half a cycle of velocity more than the delay alone causes.
    let limits = Limits {
        following_error: Some(0.5),
        ..LIMITS
    };
    let mut rig = enabled(Mode::Csp, limits);
    let mut seen = Seen::new(&rig);
    let mut due = moves.iter();
    let mut wait = 0;
    for &(good, lost) in bursts {
        for at in 0..good + lost {
            if wait == 0
                && let Some(&(command, after)) = due.next()
            {
                rig.axis.command(command).unwrap();
                wait = after;
            }
            wait = wait.saturating_sub(1);
            let pending = rig.axis.status().moving;
            let before = rig.out.target_position;
            let (status, delivered) = cycle(&mut rig, at < good);
            seen.check(delivered)?;
            prop_assert_eq!((status.trip, status.guarded_cycles), (None, 0));
            prop_assert!(status.ready);
            if status.stale_cycles > 2 {
                prop_assert_eq!(rig.out.target_position, before);
                prop_assert_eq!(status.target_velocity, 0.0);
                if pending && status.stale_cycles > 3 {
                    prop_assert!(status.moving && !status.in_target);
                }
            }
        }
    }
    rig.axis.command(to(last)).unwrap();
    for _ in 0..1000 {
        let (status, delivered) = cycle(&mut rig, true);
        seen.check(delivered)?;
        prop_assert_eq!(status.trip, None);
    }
    let status = rig.axis.status();
    prop_assert!(status.in_target && status.at_rest && !status.moving);
    prop_assert_eq!(status.final_error_counts, Some(0));
    prop_assert_eq!(
        rig.out.target_position,
        (last * COUNTS_PER_UNIT).round() as i32
    );
    Ok(())
}

/// The delivered velocity or torque changes by at most three cycles of ramp, and not at all while
/// frames are lost.
fn ramps(
    mode: Mode,
    commands: &[(Command, u32)],
    bursts: &[Burst],
    most: f64,
) -> Result<(), TestCaseError> {
    let limits = Limits {
        velocity: if mode == Mode::Cst { 10_000.0 } else { 200.0 },
        ..ENDLESS
    };
    let mut rig = enabled(mode, limits);
    let value = |out: &Outputs| {
        if mode == Mode::Csv {
            out.target_velocity
        } else {
            i32::from(out.target_torque)
        }
    };
    let mut before = value(&rig.out);
    let mut due = commands.iter();
    let mut wait = 0;
    for &(good, lost) in bursts {
        for at in 0..good + lost {
            if wait == 0
                && let Some(&(command, after)) = due.next()
            {
                rig.axis.command(command).unwrap();
                wait = after;
            }
            wait = wait.saturating_sub(1);
            let planned = value(&rig.out);
            let (status, delivered) = cycle(&mut rig, at < good);
            prop_assert_eq!((status.trip, status.guarded_cycles), (None, 0));
            if status.stale_cycles > 2 {
                prop_assert_eq!(value(&rig.out), planned);
            }
            if let Some(out) = delivered {
                let change = f64::from(value(&out) - before).abs();
                prop_assert!(change <= 3.0 * most + 1.0, "changed by {change}");
                before = value(&out);
            }
        }
    }
    Ok(())
}

fn bursts() -> impl Strategy<Value = Vec<Burst>> {
    let lost = prop_oneof![1u32..=4, 1u32..=100];
    prop::collection::vec((1u32..150, lost), 1..20)
}

fn waits(commands: impl Strategy<Value = Command>) -> impl Strategy<Value = Vec<(Command, u32)>> {
    prop::collection::vec((commands, 1u32..400), 1..12)
}

fn moves() -> impl Strategy<Value = Vec<(Command, u32)>> {
    waits(prop_oneof![
        1 => Just(Command::Stop),
        2 => prop::sample::select(vec![to(50.0), to(-50.0)]),
        4 => (-50.0..=50.0f64, 0.05..=1.0f64, 0.05..=1.0f64)
            .prop_map(|(position, speed, ramp)| go(position, speed, ramp)),
    ])
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
    fn positions_keep_their_steps_after_lost_frames(moves in moves(), bursts in bursts(), last in -50.0..=50.0f64) {
        csp(&moves, &bursts, last)?;
    }

    #[test]
    fn velocities_keep_their_ramp_after_lost_frames(
        commands in waits(prop_oneof![(-200.0..=200.0f64).prop_map(run_at), Just(Command::Stop)]),
        bursts in bursts(),
    ) {
        ramps(Mode::Csv, &commands, &bursts, LIMITS.acceleration * DT * MRPM_PER_UNIT)?;
    }

    #[test]
    fn torques_keep_their_ramp_after_lost_frames(
        commands in waits(prop_oneof![(-100.0..=100.0f64).prop_map(push), Just(Command::Stop)]),
        bursts in bursts(),
    ) {
        ramps(Mode::Cst, &commands, &bursts, 10.0)?;
    }
}

/// Every burst length at every point of one move: acceleration, cruise, deceleration, arrival.
#[test]
fn move_survives_every_burst_at_every_point() {
    for good in 1..360 {
        for lost in [1, 2, 3, 4, 19, 100] {
            let bursts = [(good, lost), (1, 0)];
            csp(&[(to(50.0), 1000)], &bursts, 50.0).unwrap();
        }
    }
}

#[test]
fn one_or_two_lost_frames_change_nothing() {
    let commands = [
        (Mode::Csp, to(50.0)),
        (Mode::Csv, run_at(30.0)),
        (Mode::Cst, push(20.0)),
    ];
    for (mode, command) in commands {
        for lost in [1, 2] {
            let mut whole = enabled(mode, ENDLESS);
            let mut holed = whole.clone();
            whole.axis.command(command).unwrap();
            holed.axis.command(command).unwrap();
            for at in 0..400 {
                whole.cycle();
                holed.cycle_with(at % 10 >= lost);
                let targets =
                    |out: &Outputs| (out.controlword, out.target_velocity, out.target_torque);
                assert_eq!(targets(&whole.out), targets(&holed.out));
                if mode == Mode::Csp {
                    assert_eq!(whole.out.target_position, holed.out.target_position);
                }
            }
        }
    }
}

/// The continued move has the requested goal, speed and ramp.
#[test]
fn a_frozen_move_keeps_its_speed_and_ramp() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(go(40.0, 0.25, 0.1)).unwrap();
    rig.run(400);
    assert_eq!(rig.axis.status().target_velocity, 50.0);
    for _ in 0..19 {
        rig.cycle_with(false);
    }
    let status = rig.axis.status();
    assert!(status.moving && !status.in_target && status.target_velocity == 0.0);
    let (mut fastest, mut before) = (0.0f64, 0.0);
    while !rig.axis.status().in_target {
        let velocity = rig.cycle().target_velocity;
        assert!((velocity - before).abs() / DT <= 200.0 + 1e-6);
        fastest = fastest.max(velocity);
        before = velocity;
    }
    assert_eq!(fastest, 50.0);
    assert_eq!(rig.out.target_position, 16_000);
}

#[test]
fn commands_are_accepted_while_frames_are_lost() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    rig.run(200);
    for _ in 0..10 {
        rig.cycle_with(false);
    }
    let held = rig.out.target_position;
    // A stop discards the move; nothing remains to decelerate.
    let mut stopped = rig.clone();
    stopped.axis.command(Command::Stop).unwrap();
    stopped.cycle_with(false);
    let status = stopped.run(100);
    assert!(status.ready && !status.moving && status.trip.is_none());
    assert_eq!(stopped.out.target_position, held);
    // Another move waits in the same way.
    rig.axis.command(to(-10.0)).unwrap();
    assert!(rig.cycle_with(false).moving);
    assert_eq!(rig.out.target_position, held);
    rig.until(|s| s.in_target, 1000);
    assert_eq!(rig.out.target_position, -4000);
}

/// A stop or disable interrupted by lost frames ends at the present set-point.
#[test]
fn braking_ends_where_frames_are_lost() {
    for command in [Command::Stop, Command::Disable] {
        let mut rig = Rig::enabled(Mode::Csp);
        rig.axis.command(to(50.0)).unwrap();
        rig.run(200);
        rig.axis.command(command).unwrap();
        rig.run(20);
        assert!(rig.axis.status().target_velocity > 100.0);
        for _ in 0..20 {
            rig.cycle_with(false);
        }
        let held = rig.out.target_position;
        assert_eq!(rig.axis.status().target_velocity, 0.0);
        assert_eq!(rig.out.controlword, 0x000F, "waits for a frame");
        let status = rig.cycle();
        assert_eq!((rig.out.target_position, status.trip), (held, None));
        if command == Command::Disable {
            rig.until(|s| s.state == State::SwitchOnDisabled, 120);
        } else {
            assert!(rig.run(100).ready);
            assert_eq!(rig.out.target_position, held);
        }
    }
}

#[test]
fn a_blocked_motor_is_still_found_after_a_burst() {
    let mut rig = Rig::enabled(Mode::Csp);
    rig.axis.command(to(50.0)).unwrap();
    rig.run(200);
    for _ in 0..50 {
        rig.cycle_with(false);
    }
    rig.drive.blocked = true;
    let status = rig.until(|s| s.trip.is_some(), 40);
    assert!(status.max_following_error > 1.0);
}

fn under_way(mode: Mode) -> Rig {
    let mut rig = enabled(mode, ENDLESS);
    let command = match mode {
        Mode::Csp => to(1000.0),
        Mode::Csv => run_at(200.0),
        _ => push(30.0),
    };
    rig.axis.command(command).unwrap();
    rig.run(30);
    rig
}

/// Returns true for "shutdown" and "disable voltage".
const fn no_power(out: &Outputs) -> bool {
    matches!(out.controlword, 0x0006 | 0x0000)
}

/// Returns the seconds without a fresh cycle until the Controlword is neither "enable operation"
/// nor "quick stop".
fn until_no_power(rig: &mut Rig, again: &[Command]) -> f64 {
    for cycles in 1..10_000 {
        for &command in again {
            let _ = rig.axis.command(command);
        }
        rig.cycle_with(false);
        if no_power(&rig.out) {
            return f64::from(cycles) * DT;
        }
    }
    panic!("still {:#06x}", rig.out.controlword);
}

#[test]
fn power_is_removed_in_bounded_time_without_answers() {
    // By set-points and by quick stop: each from full speed, with one second margin and 0.1 s to
    // settle.
    const BOUND: f64 = 2.0 * (1.0 + 0.1 + 2.0 * DT);
    for mode in [Mode::Csp, Mode::Csv, Mode::Cst] {
        let both = [Command::QuickStop, Command::Disable];
        for commands in [&both[..], &both[1..]] {
            for (before, after) in [(0, 0), (0, 10), (10, 0), (5000, 0)] {
                for again in [&[][..], commands] {
                    let mut rig = under_way(mode);
                    for _ in 0..before {
                        rig.cycle_with(false);
                    }
                    for &command in commands {
                        rig.axis.command(command).unwrap();
                    }
                    rig.run(after);
                    let seconds = until_no_power(&mut rig, again);
                    assert!(seconds <= BOUND, "{mode} {commands:?}: {seconds} s");
                    // Power stays off after further commands.
                    for _ in 0..5000 {
                        for &command in again {
                            let _ = rig.axis.command(command);
                        }
                        rig.cycle_with(false);
                        assert!(no_power(&rig.out), "{:#06x}", rig.out.controlword);
                    }
                }
            }
        }
    }
}

/// An axis at rest when the frames are lost does not wait.
#[test]
fn a_standing_axis_is_disabled_at_once() {
    let mut rig = Rig::new(axis(Mode::Csp), Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|s| s.ready, 100);
    for _ in 0..10 {
        rig.cycle_with(false);
    }
    rig.axis.command(Command::Disable).unwrap();
    for _ in 0..101 {
        rig.cycle_with(false);
    }
    assert_eq!(rig.out.controlword, 0x0006);
}

/// The drive received the new mode during lost frames and moves to the target sent with it. The
/// set-point continues from there, wherever the motor is by then.
#[test]
fn csp_entered_during_lost_frames_continues_from_the_sent_target() {
    let most = LIMITS.velocity * DT * COUNTS_PER_UNIT + 1.0;
    for delivered in 1..4 {
        for lost in 3..12 {
            for knocked in [-1.0, 0.0, 1.0] {
                let axis = Axis::new(common::all(Mode::Csv, ENDLESS)).unwrap();
                let mut rig = Rig::new(axis, Drive::at(0));
                rig.axis.command(Command::Enable).unwrap();
                rig.until(|s| s.ready, 100);
                rig.axis.command(run_at(100.0)).unwrap();
                rig.run(500);
                rig.axis.command(Command::SetMode(Mode::Csp)).unwrap();
                rig.cycle_with(true);
                for _ in 0..delivered {
                    cycle(&mut rig, true);
                }
                let mut entered = rig.axis.status().mode == Mode::Csp;
                for n in 0..lost + 50 {
                    let before = rig.out;
                    if n == lost {
                        // An external force pushes the motor.
                        rig.drive.velocity = knocked * LIMITS.velocity * COUNTS_PER_UNIT;
                    }
                    let (status, _) = cycle(&mut rig, n >= lost);
                    let step = rig.out.target_position.wrapping_sub(before.target_position);
                    entered |= status.mode == Mode::Csp;
                    assert!(
                        f64::from(step.abs()) <= most,
                        "{delivered} delivered, {lost} lost, knocked {knocked}: {step} counts in cycle {n}"
                    );
                }
                assert!(entered, "{delivered} delivered, {lost} lost");
            }
        }
    }
}
