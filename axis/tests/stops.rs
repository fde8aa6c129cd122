//! Stops: the sequence of outputs that the drive receives until it has no power.

use crate::common::{DT, LIMITS, axis, scale};
use ecaxis_axis::{
    Axis, AxisConfig, Command, CommandError, Delivery, EnableBlocker, Inputs, Limits, Mode,
    Outputs, StopMethod, StopPhase, Trip,
};

const FREE: Limits = Limits {
    position: None,
    following_error: None,
    ..LIMITS
};

fn inputs(word: u16, position: i32, display: i8) -> Inputs {
    Inputs {
        statusword: word,
        position: Some(position),
        velocity: Some(0),
        torque: Some(0),
        mode_display: Some(display),
        fresh: true,
        ..Inputs::default()
    }
}

/// A drive without 0x606C that follows.
fn following(word: u16, position: i32) -> Inputs {
    Inputs {
        velocity: None,
        ..inputs(word, position, 8)
    }
}

fn moving(word: u16, display: i8, mrpm: i32) -> Inputs {
    Inputs {
        velocity: Some(mrpm),
        ..inputs(word, 0, display)
    }
}

fn config(mode: Mode) -> AxisConfig {
    AxisConfig::new(mode, scale(), FREE)
}

fn enabled(config: AxisConfig) -> Axis {
    let display = config.mode.code();
    let mut axis = Axis::new(config).unwrap();
    axis.command(Command::Enable).unwrap();
    for word in [0x0240, 0x0231, 0x0233, 0x1237, 0x1237] {
        axis.step(&inputs(word, 0, display), DT);
    }
    assert!(axis.status().ready);
    axis
}

const fn to(position: f64) -> Command {
    Command::MoveTo {
        position,
        speed: 1.0,
        ramp: 1.0,
    }
}

/// CiA 402-2, Statusword bit 12 of CSP, CSV and CST: "drive follows the command value".
#[test]
fn targets_stay_at_actual_values_until_bit_12() {
    for (mode, command) in [
        (Mode::Csp, to(40.0)),
        (
            Mode::Csv,
            Command::Velocity {
                velocity: 10.0,
                ramp: 1.0,
            },
        ),
        (
            Mode::Cst,
            Command::Torque {
                percent: 10.0,
                ramp_s: 0.0,
            },
        ),
    ] {
        let mut axis = Axis::new(config(mode)).unwrap();
        axis.command(Command::Enable).unwrap();
        let display = mode.code();
        for word in [0x0240, 0x0231, 0x0233, 0x0237, 0x0237] {
            axis.step(&inputs(word, 0, display), DT);
        }
        // The drive moves by itself, for example for commutation.
        for n in 0..200 {
            // 5 counts in 1 ms are 150 rpm.
            let reported = Inputs {
                velocity: Some(150_000),
                ..inputs(0x0237, n * 5, display)
            };
            let out = axis.step(&reported, DT);
            let targets = (out.target_position, out.target_velocity, out.target_torque);
            assert_eq!(targets, (n * 5, 0, 0), "{mode}");
            assert_eq!(out.controlword, 0x000F);
        }
        let status = axis.status();
        assert_eq!((status.ready, status.enabled), (false, false));
        assert_eq!(status.waiting, Some(EnableBlocker::Follows { mode }));
        assert!(matches!(
            axis.command(command),
            Err(CommandError::NotEnabled { .. })
        ));
        let out = axis.step(&inputs(0x1237, 1000, display), DT);
        assert_eq!(out.target_position, 1000, "no step");
        assert!(axis.status().ready);
        axis.command(command).unwrap();
        // A drive that does not support the bit.
        let mut axis = Axis::new(AxisConfig {
            follows_bit: false,
            ..config(mode)
        })
        .unwrap();
        axis.command(Command::Enable).unwrap();
        for word in [0x0240, 0x0231, 0x0233, 0x0237, 0x0237] {
            axis.step(&inputs(word, 0, display), DT);
        }
        assert!(axis.status().ready);
    }
}

#[test]
fn bit_12_that_is_lost_is_a_trip() {
    let mut axis = enabled(config(Mode::Csp));
    axis.command(to(40.0)).unwrap();
    let mut position = 0;
    for _ in 0..100 {
        position = axis.step(&following(0x1237, position), DT).target_position;
    }
    // A drive that limits a step clears the bit for one or two cycles.
    for _ in 0..9 {
        position = axis.step(&following(0x0237, position), DT).target_position;
    }
    position = axis.step(&following(0x1237, position), DT).target_position;
    for _ in 0..9 {
        let out = axis.step(&following(0x0237, position), DT);
        assert_eq!(out.controlword, 0x000F);
    }
    let out = axis.step(&following(0x0237, position), DT);
    assert_eq!(out.controlword, 0x0002);
    let trip = Some(Trip::NotFollowing { mode: Mode::Csp });
    assert_eq!(axis.status().trip, trip);
    // Also at rest: the drive holds no load. The axis is not enabled again by itself.
    let mut axis = enabled(config(Mode::Csp));
    for _ in 0..9 {
        let out = axis.step(&inputs(0x0237, 0, 8), DT);
        assert_eq!(out.controlword, 0x000F);
    }
    let out = axis.step(&inputs(0x0237, 0, 8), DT);
    assert_eq!((out.controlword, axis.status().trip), (0x0002, trip));
    for word in [0x0240; 10]
        .into_iter()
        .chain([0x0231, 0x0233, 0x1237, 0x1237])
    {
        let out = axis.step(&inputs(word, 0, 8), DT);
        assert_eq!(out.controlword & 0x000F & !0x0006, 0, "{word:#06x}");
    }
    assert_eq!(axis.status().trip, trip);
}

/// A word that a drive with power cannot show holds the last command for five cycles.
#[test]
fn unlisted_statusword_is_no_loss_of_power() {
    for word in [0x0000, 0x0056, 0x8001] {
        for cycles in [1, 5] {
            let mut axis = enabled(config(Mode::Csp));
            axis.command(to(40.0)).unwrap();
            let mut position = 0;
            for _ in 0..100 {
                position = axis.step(&following(0x1237, position), DT).target_position;
            }
            // All inputs of such a cycle are zero on many drives.
            let before = position;
            for _ in 0..cycles {
                let out = axis.step(&inputs(word, 0, 8), DT);
                assert_eq!(out.controlword, 0x000F, "{word:#06x}");
                position = out.target_position;
            }
            assert!(position > before, "the set-point goes on");
            for _ in 0..100 {
                let out = axis.step(&following(0x1237, position), DT);
                assert_eq!(out.controlword, 0x000F, "{word:#06x}");
                position = out.target_position;
            }
            assert_eq!(axis.status().trip, None);
        }
        let mut axis = enabled(config(Mode::Csp));
        let mut words = Vec::new();
        for _ in 0..3000 {
            words.push(axis.step(&inputs(word, 0, 8), DT).controlword);
        }
        assert_eq!(axis.status().trip, Some(Trip::UnlistedStatusword { word }));
        assert!(words[..5].iter().all(|word| *word == 0x000F));
        // A quick stop, and no voltage only after its time-out.
        assert!(
            words[5..1000].iter().all(|word| *word == 0x0002),
            "{words:?}"
        );
        assert_eq!(words.last(), Some(&0x0000));
        assert!(!axis.stop_ended(), "it may still have power");
    }
}

/// The drive stays in Switched on until 0x6061 shows the mode.
#[test]
fn operation_is_enabled_in_the_mode_that_shows() {
    let mut axis = axis(Mode::Csp);
    axis.command(Command::Enable).unwrap();
    let mut words = Vec::new();
    for (word, display) in [
        (0x0240, 10),
        (0x0231, 10),
        (0x0233, 10),
        (0x0233, 10),
        (0x0233, 8),
    ] {
        words.push(axis.step(&inputs(word, 0, display), DT).controlword);
    }
    assert_eq!(words, [0x0006, 0x0007, 0x0007, 0x0007, 0x000F]);
    for _ in 0..200 {
        axis.step(&inputs(0x0233, 0, 10), DT);
    }
    let waiting = EnableBlocker::Mode {
        expected: Mode::Csp,
        display: Mode::Cst,
    };
    assert_eq!(axis.status().waiting, Some(waiting));
}

/// Power is removed at standstill, with any duration of the drive's ramp.
#[test]
fn a_long_quick_stop_keeps_its_power() {
    let mut axis = enabled(config(Mode::Csv));
    axis.step(&moving(0x1237, 9, 2_000_000), DT);
    axis.stop_by(StopMethod::QuickStop);
    let mut words: Vec<(u16, i32)> = Vec::new();
    for n in 0..6000 {
        let mrpm = (2_000_000 - n * 400).max(0);
        let word = if axis.status().controlword == 0x0006 {
            0x0231
        } else {
            0x0217
        };
        let out = axis.step(&moving(word, 9, mrpm), DT);
        if words.last().map(|last| last.0) != Some(out.controlword) {
            words.push((out.controlword, mrpm));
        }
    }
    assert_eq!(words.len(), 2, "{words:?}");
    assert_eq!(words[0].0, 0x0002);
    assert!(words[1].0 == 0x0000 && words[1].1 <= 24_000, "{words:?}");
    assert_eq!(axis.status().trip, None);
}

/// A drive that does not decelerate within a configured time-out: the voltage is removed, and the
/// axis trips.
#[test]
fn a_stop_that_fails_is_a_trip() {
    for (timeout, decelerates, least, most) in
        [(None, false, 1000, 1200), (Some(0.5), true, 490, 510)]
    {
        let mut axis = enabled(AxisConfig {
            stop_timeout_s: timeout,
            ..config(Mode::Csv)
        });
        axis.step(&moving(0x1237, 9, 2_000_000), DT);
        axis.stop_by(StopMethod::QuickStop);
        let mut cut = None;
        for n in 0..4000 {
            let mrpm = if decelerates {
                2_000_000 - n * 400
            } else {
                2_000_000
            };
            let out = axis.step(&moving(0x0217, 9, mrpm), DT);
            if out.controlword == 0x0000 {
                cut = Some(n);
                break;
            }
            assert_eq!(out.controlword, 0x0002);
        }
        let cut = cut.expect("no voltage");
        assert!((least..=most).contains(&cut), "{cut}");
        assert!(
            matches!(
                axis.status().trip,
                Some(Trip::NotStopped {
                    method: StopMethod::QuickStop,
                    ..
                })
            ),
            "{:?}",
            axis.status().trip
        );
        for _ in 0..3500 {
            axis.step(&moving(0x0217, 9, 2_000_000), DT);
        }
        let stop = axis.status().stop.unwrap();
        assert_eq!(stop.phase, StopPhase::PowerKept);
        assert!(axis.stop_ended());
    }
}

fn follow(axis: &mut Axis, position: &mut i32) -> Outputs {
    let velocity = axis.status().target_velocity * 12_000.0;
    let seen = Inputs {
        position: Some(*position),
        velocity: Some(velocity as i32),
        ..inputs(0x1237, *position, axis.status().mode.code())
    };
    let out = axis.step(&seen, DT);
    *position = out.target_position;
    out
}

/// Every interrupted move: the stop uses the limits of the axis, never gains speed, and gets enough
/// time before it becomes harder.
#[test]
fn a_stop_uses_the_limits_of_the_axis() {
    for (jerk, ramp) in [
        (None, 1.0),
        (None, 0.05),
        (Some(20_000.0), 1.0),
        (Some(20_000.0), 0.05),
        (Some(1000.0), 1.0),
        (Some(1000.0), 0.1),
    ] {
        let limits = Limits { jerk, ..FREE };
        let calm = AxisConfig {
            jerk_limited: jerk.is_some(),
            limits,
            ..config(Mode::Csp)
        };
        for cycles in [50, 300, 700, 2000, 6000] {
            for disable in [false, true] {
                let mut axis = enabled(calm);
                let command = Command::MoveTo {
                    position: 5000.0,
                    speed: 1.0,
                    ramp,
                };
                axis.command(command).unwrap();
                let mut position = 0;
                for _ in 0..cycles {
                    follow(&mut axis, &mut position);
                }
                let mut speed = axis.status().target_velocity;
                let jerk_s = jerk.map_or(0.0, |jerk| limits.acceleration / jerk);
                let from_full_jerk = jerk.map_or(0.0, |jerk| 2.0 * (speed / jerk).sqrt());
                let most_s = (speed / limits.acceleration + jerk_s).max(from_full_jerk);
                axis.command(if disable {
                    Command::Disable
                } else {
                    Command::Stop
                })
                .unwrap();
                let mut n = 0;
                while speed > 0.0 {
                    let out = follow(&mut axis, &mut position);
                    let status = axis.status();
                    assert_eq!((out.controlword, status.trip), (0x000F, None));
                    assert!(
                        status.target_velocity <= speed * (1.0 + 1e-9),
                        "{jerk:?} {ramp} {cycles}: {} after {speed}",
                        status.target_velocity
                    );
                    speed = status.target_velocity;
                    n += 1;
                    assert!(
                        f64::from(n) * DT <= most_s + 0.01,
                        "{jerk:?} {ramp} {cycles}: {n} cycles, {most_s} s"
                    );
                }
                assert!(speed >= 0.0);
            }
        }
    }
}

/// Late replies prove that targets arrive: targets ramp down, and the motion continues with the
/// next reply in time.
#[test]
fn late_replies_ramp_the_targets_down() {
    let mut axis = enabled(config(Mode::Csp));
    axis.command(to(4000.0)).unwrap();
    let mut position = 0;
    for _ in 0..300 {
        follow(&mut axis, &mut position);
    }
    let most = LIMITS.acceleration * DT * DT * 400.0 + 2.0;
    let mut step = 80;
    for n in 0..30 {
        let late = Inputs {
            fresh: false,
            delivery: match n > 0 {
                true => Delivery::Earlier,
                false => Delivery::Unknown,
            },
            ..inputs(0x1237, position, 8)
        };
        let target = axis.step(&late, DT).target_position;
        let change = target - position - step;
        assert!(
            f64::from(change.abs()) <= most,
            "cycle {n}: {step} {change}"
        );
        (step, position) = (target - position, target);
    }
    assert!(step < 70, "decelerates: {step}");
    for n in 0..200 {
        let before = position;
        let target = follow(&mut axis, &mut position).target_position;
        let change = target - before - step;
        assert!(
            f64::from(change.abs()) <= most,
            "cycle {n}: {step} {change}"
        );
        step = target - before;
    }
    assert_eq!(axis.status().trip, None);
    assert!(step >= 79, "goes on: {step}");
}

/// A drive that took its targets, in a frame that another device missed, gets no fewer cycles than
/// after an answer.
#[test]
fn frame_without_another_device_counts_as_delivered() {
    let mut axis = enabled(config(Mode::Csp));
    axis.command(to(4000.0)).unwrap();
    let mut position = 0;
    for _ in 0..300 {
        follow(&mut axis, &mut position);
    }
    let steps = [
        Delivery::Now,
        Delivery::Unknown,
        Delivery::Unknown,
        Delivery::Unknown,
    ];
    let steps = steps.map(|delivery| {
        let stale = Inputs {
            fresh: false,
            delivery,
            ..inputs(0x1237, position, 8)
        };
        let target = axis.step(&stale, DT).target_position;
        let step = target - position;
        position = target;
        step
    });
    assert!(steps[..3].iter().all(|step| *step >= 78), "{steps:?}");
    assert_eq!(steps[3], 0);
}

/// The deceleration of the late cycles is more than the jerk limit can end before the axis turns.
#[test]
fn late_answers_in_a_stop_do_not_turn_a_slow_axis() {
    let config = config(Mode::Csp);
    let jerk = config.limits.acceleration * 20.0;
    let mut axis = enabled(AxisConfig {
        jerk_limited: true,
        limits: Limits {
            jerk: Some(jerk),
            ..config.limits
        },
        ..config
    });
    let velocity = config.limits.velocity * 0.1;
    let turn = Command::Velocity {
        velocity,
        ramp: 1.0,
    };
    axis.command(turn).unwrap();
    let mut position = 0;
    for _ in 0..300 {
        follow(&mut axis, &mut position);
    }
    for n in 0..5 {
        if n == 2 {
            axis.stop_by(StopMethod::Ramp);
        }
        let stale = Inputs {
            fresh: false,
            delivery: Delivery::Now,
            ..inputs(0x1237, position, 8)
        };
        position = axis.step(&stale, DT).target_position;
    }
    for _ in 0..300 {
        let before = position;
        follow(&mut axis, &mut position);
        assert!(position >= before, "{before} → {position}");
    }
}

/// With pipelined answers: a late answer in the first stale cycle leaves both cycles that are
/// planned without an answer.
#[test]
fn late_reply_keeps_the_cycles_planned_without_an_answer() {
    let mut axis = enabled(AxisConfig {
        answers_late: 1,
        ..config(Mode::Csp)
    });
    axis.command(to(4000.0)).unwrap();
    let mut position = 0;
    for _ in 0..300 {
        follow(&mut axis, &mut position);
    }
    for delivery in [Delivery::Earlier, Delivery::Unknown] {
        let stale = Inputs {
            fresh: false,
            delivery,
            ..inputs(0x1237, position, 8)
        };
        let target = axis.step(&stale, DT).target_position;
        assert_eq!(target - position, 80);
        position = target;
    }
}

/// A Sercos drive that keeps its torque for 300 ms after the quick stop, seen two cycles late:
/// 0x6000 stays until the torque leaves, and "enable" waits for it. A drive that keeps its torque
/// has no voltage after 2 s.
#[test]
fn a_quick_stop_of_a_sercos_drive_keeps_the_time_of_its_brake() {
    use ecaxis_axis::{DriveWords, QuickStopOption, SercosWords};
    for (hold, again) in [(300, false), (300, true), (usize::MAX, false)] {
        let mut axis = Axis::new(AxisConfig {
            quick_stop: Some(QuickStopOption(2)),
            quick_stop_ends: true,
            ..config(Mode::Csp)
        })
        .unwrap();
        let mut words = DriveWords::Sercos(SercosWords::new(false));
        let (mut late, mut torque, mut sent) = ([0x8000_u16; 2], 0_usize, Vec::new());
        for n in 0..4000 {
            match n {
                0 => axis.command(Command::Enable).unwrap(),
                100 => {
                    assert!(axis.status().enabled);
                    axis.stop_by(StopMethod::QuickStop);
                }
                // At standstill, in the first cycles after the request to remove the power.
                260 if again => axis.command(Command::Enable).unwrap(),
                _ => {}
            }
            let seen = words.statusword(late[0]);
            let out = axis.step(&inputs(seen, 0, 8), DT);
            let word = words.control(out.controlword).word & !0x0400;
            torque = match word {
                0xe000 => 1,
                0x6000 if (1..hold).contains(&torque) => torque + 1,
                _ => 0,
            };
            late = [late[1], if torque > 0 { 0xc000 } else { 0x8000 }];
            if sent.last().is_none_or(|(last, _)| *last != word) {
                sent.push((word, 0));
            }
            sent.last_mut().unwrap().1 += 1;
            assert_eq!(axis.status().trip, None, "{n}");
        }
        let stopped = sent.iter().position(|(word, _)| *word == 0xe000).unwrap() + 1;
        println!("{sent:04x?}");
        let (word, cycles) = sent[stopped];
        assert_eq!(word, 0x6000);
        if hold == usize::MAX {
            assert!((2000..2300).contains(&cycles), "{cycles}");
        } else {
            assert!(cycles >= hold, "{cycles}");
        }
        let last = if again { 0xe000 } else { 0x0000 };
        assert_eq!(sent.last().unwrap().0, last);
        assert_eq!(axis.status().enabled, again);
    }
}

/// "Disable voltage" reaches a Sercos drive in every phase of its reaction to a fault, and an axis
/// whose power is already being removed.
#[test]
fn disable_voltage_is_the_hardest_stop_at_any_time() {
    use ecaxis_axis::{DriveWords, SercosWords};
    for (method, at) in [
        (None, 150),
        (None, 151),
        (None, 160),
        (Some(StopMethod::Ramp), 102),
        (Some(StopMethod::Ramp), 300),
        (Some(StopMethod::QuickStop), 102),
        (Some(StopMethod::QuickStop), 300),
    ] {
        let mut axis = Axis::new(AxisConfig {
            quick_stop_ends: true,
            ..config(Mode::Csp)
        })
        .unwrap();
        let mut words = DriveWords::Sercos(SercosWords::new(false));
        let mut raw = 0x8000;
        for n in 0..600 {
            match n {
                0 => axis.command(Command::Enable).unwrap(),
                100 => {
                    assert!(axis.status().enabled);
                    if let Some(method) = method {
                        axis.stop_by(method);
                    }
                }
                _ => {}
            }
            if n == at {
                axis.stop_by(StopMethod::DisableVoltage);
            }
            let seen = words.statusword(raw);
            let out = axis.step(&inputs(seen, 0, 8), DT);
            let word = words.control(out.controlword).word & !0x0400;
            // The drive keeps its torque as long as it is enabled; at 150 it reacts to a fault.
            let torque = raw & 0xc000 == 0xc000;
            raw = match word {
                0xe000 => 0xc000,
                0x6000 if torque => raw & 0xe000,
                _ => 0x8000 | raw & 0x2000,
            };
            if method.is_none() && n >= 149 {
                raw |= 0x2000;
            }
            if n >= at {
                assert_eq!(word, 0, "{method:?} {at} {n}");
            } else if method.is_none() && n > 150 {
                assert_eq!(word, 0x6000, "{method:?} {at} {n}");
            }
        }
    }
}

/// A move cannot be superimposed on what the axis does not plan, nor on a move to a probe.
#[test]
fn only_own_motions_have_a_source() {
    use ecaxis_axis::{Edge, Probe, Source};
    let mut axis = Axis::new(config(Mode::Csp)).unwrap();
    let drive = |axis: &mut Axis| {
        axis.step(
            &Inputs {
                touch_probe_status: Some(1),
                ..inputs(0x1237, 0, 8)
            },
            DT,
        )
    };
    assert!(matches!(
        axis.source(),
        Err(CommandError::NotEnabled { .. })
    ));
    axis.command(Command::Enable).unwrap();
    drive(&mut axis);
    drive(&mut axis);
    assert!(axis.status().enabled, "{:?}", axis.status());
    assert!(axis.source().is_ok());
    axis.set_point(0.0).unwrap();
    assert_eq!(axis.source(), Err(CommandError::Following));
    drive(&mut axis);
    drive(&mut axis);
    assert!(axis.source().is_ok());
    for stop in [false, true] {
        axis.command(Command::ArmProbe {
            probe: Probe::First,
            edge: Edge::Positive,
            source: Source::Input,
            stop,
        })
        .unwrap();
        assert_eq!(axis.source().is_err(), stop);
    }
    axis.command(Command::DisarmProbe {
        probe: Probe::First,
    })
    .unwrap();
    assert!(axis.source().is_ok());
}
