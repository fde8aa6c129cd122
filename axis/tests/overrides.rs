//! Override and hold: every motion of an axis within its limits at any rate, and stops that no rate
//! changes.

use ecaxis_axis::{Axis, Command, Limits, Mode, StopMethod};
use proptest::prelude::*;

use crate::common::{DT, Drive, LIMITS, Rig, all};

const JERK: f64 = 40_000.0;

fn rig(mode: Mode, jerk_limited: bool) -> Rig {
    let limits = Limits {
        jerk: jerk_limited.then_some(JERK),
        ..LIMITS
    };
    let mut config = all(mode, limits);
    config.jerk_limited = jerk_limited;
    let mut rig = Rig::new(Axis::new(config).unwrap(), Drive::at(0));
    rig.axis.command(Command::Enable).unwrap();
    rig.until(|status| status.ready, 200);
    rig
}

fn rate() -> impl Strategy<Value = f64> {
    prop_oneof![Just(0.0), Just(1.0), 0.05..=1.2f64]
}

fn move_to(position: f64, speed: f64) -> Command {
    Command::MoveTo {
        position,
        speed,
        ramp: 1.0,
    }
}

/// A product of small factors is a hold, not an override that is never planned.
#[test]
fn a_tiny_rate_holds() {
    for jerk_limited in [true, false] {
        let mut rig = rig(Mode::Csp, jerk_limited);
        rig.axis.command(move_to(45.0, 1.0)).unwrap();
        for _ in 0..100 {
            rig.cycle();
        }
        rig.axis.set_rate(5.6e-17);
        for _ in 0..2000 {
            rig.cycle();
        }
        let status = rig.axis.status();
        assert!(
            status.target_velocity == 0.0 && status.target_position < 44.0,
            "{status:?}"
        );
    }
}

proptest! {
    /// Moves in CSP with a rate that changes at any time: velocity, acceleration and, with jerk
    /// limits, jerk hold in every cycle. A hold stands, and the end is exact.
    #[test]
    fn moves_keep_the_limits_at_any_rate(
        jerk_limited in any::<bool>(), target in -45.0..45.0f64, speed in 0.1..=1.0f64,
        rates in prop::collection::vec((rate(), 1u32..150), 1..12),
    ) {
        let mut rig = rig(Mode::Csp, jerk_limited);
        rig.axis.command(move_to(target, speed)).unwrap();
        let mut before = rig.axis.status();
        for (rate, cycles) in rates.into_iter().chain([(0.0, 1500), (1.0, 12_000)]) {
            rig.axis.set_rate(rate);
            for _ in 0..cycles {
                let now = rig.cycle();
                let velocity = (now.target_position - before.target_position) / DT;
                prop_assert!(velocity.abs() <= (LIMITS.velocity * speed * 1.2).min(LIMITS.velocity) + 1e-6);
                prop_assert!(now.target_acceleration.abs() <= LIMITS.acceleration * (1.0 + 1e-6));
                let jerk = (now.target_acceleration - before.target_acceleration) / DT;
                prop_assert!(!jerk_limited || jerk.abs() <= JERK * (1.0 + 1e-6), "{}", jerk);
                prop_assert!(now.guarded_cycles == 0 && now.trip.is_none());
                before = now;
            }
            let there = before.target_position == target;
            prop_assert!(rate > 0.0 || cycles < 1500 || (before.target_velocity == 0.0 && (there || before.moving)));
        }
        prop_assert_eq!(before.target_position, target);
        prop_assert!(before.in_target);
    }

    /// Velocities in CSP, CSV and PV, and moves in PP: each follows its rate, waits at 0, and ends as
    /// without an override.
    #[test]
    fn every_mode_follows_its_rate(mode in 0usize..4, first in 0.2..=1.2f64, held in 100u32..500) {
        let mode = [Mode::Csp, Mode::Csv, Mode::Pv, Mode::Pp][mode];
        let mut rig = rig(mode, false);
        // A count per cycle is 2.5 units per second.
        let command = match mode {
            Mode::Pp => move_to(40.0, 0.2),
            _ => Command::Velocity { velocity: 60.0, ramp: 1.0 },
        };
        rig.axis.set_rate(first);
        rig.axis.command(command).unwrap();
        rig.run(150);
        let wanted = match mode {
            Mode::Pp => 40.0 * first,
            _ => 60.0 * first,
        };
        let status = rig.axis.status();
        prop_assert!((status.velocity - wanted).abs() <= 2.6, "{} {}", status.velocity, wanted);
        prop_assert_eq!(status.moving, mode == Mode::Pp);
        rig.axis.set_rate(0.0);
        let status = rig.run(held);
        prop_assert!(status.velocity.abs() < 0.5 && status.moving, "{:?}", status);
        let at = status.position;
        rig.axis.set_rate(1.0);
        let status = rig.run(150);
        prop_assert!(status.position > at + 0.5, "{} {}", at, status.position);
        if mode == Mode::Pp {
            let status = rig.until(|status| status.in_target, 3000);
            prop_assert!((status.position - 40.0).abs() <= 1e-6);
        }
    }

    /// What stops receive does not depend on the override: from the command on, all outputs are
    /// those of an axis whose rate does not change.
    #[test]
    fn stops_are_the_same_at_any_rate(
        mode in 0usize..5, stop in 0usize..6, jerk_limited in any::<bool>(), first in rate(),
        rates in prop::collection::vec(rate(), 1..20),
    ) {
        let mode = [Mode::Csp, Mode::Csv, Mode::Cst, Mode::Pv, Mode::Pp][mode];
        let mut rig = rig(mode, jerk_limited);
        rig.axis.set_rate(1.0);
        let command = match mode {
            Mode::Pv => Command::Velocity { velocity: 100.0, ramp: 1.0 },
            _ => move_to(45.0, 0.8),
        };
        rig.axis.command(command).unwrap();
        rig.run(100);
        // A hold or another speed has just begun.
        rig.axis.set_rate(first);
        rig.run(20);
        let mut other = rig.clone();
        for rig in [&mut rig, &mut other] {
            match stop {
                0 => rig.axis.command(Command::Disable).unwrap(),
                1 => rig.axis.command(Command::QuickStop).unwrap(),
                2 => rig.axis.command(Command::EmergencyStop).unwrap(),
                3 => rig.axis.stop_by(StopMethod::Ramp),
                4 => rig.axis.stop_by(StopMethod::QuickStop),
                _ => rig.drive.fault(),
            }
        }
        for cycle in 0..2000 {
            if cycle % 100 == 0 {
                other.axis.set_rate(rates[cycle / 100 % rates.len()]);
            }
            let (a, b) = (rig.cycle(), other.cycle());
            prop_assert_eq!(rig.out, other.out);
            prop_assert_eq!(a.state, b.state);
        }
        let status = rig.axis.status();
        prop_assert!(!status.enabled && status.velocity == 0.0, "{:?}", status);
    }
}

/// A stop in a hold, then a trip in a hold: power goes, and a later rate moves nothing.
#[test]
fn stop_and_trip_in_a_hold_end_the_motion() {
    for trips in [false, true] {
        let mut rig = rig(Mode::Csp, true);
        rig.axis.command(move_to(40.0, 1.0)).unwrap();
        rig.run(100);
        rig.axis.set_rate(0.0);
        let held = rig.run(500);
        assert!(held.moving && held.target_velocity == 0.0);
        if trips {
            rig.drive.position += 3000.0;
            rig.drive.blocked = true;
            let status = rig.until(|status| status.trip.is_some(), 5);
            assert!(status.trip.is_some());
        } else {
            rig.axis.command(Command::Stop).unwrap();
        }
        rig.axis.set_rate(1.0);
        let status = rig.run(1000);
        assert_eq!(status.target_velocity, 0.0);
        assert!(!status.moving);
        if !trips {
            assert_eq!(status.target_position, held.target_position);
        }
    }
}

/// Rates that are no numbers from 0 to 1.2 hold the axis.
#[test]
fn invalid_rates_hold() {
    for rate in [f64::NAN, -0.1, 1.3, f64::INFINITY] {
        let mut rig = rig(Mode::Csp, false);
        rig.axis.set_rate(rate);
        rig.axis.command(move_to(10.0, 1.0)).unwrap();
        let status = rig.run(200);
        assert!(status.target_position == 0.0 && status.moving);
    }
}
