//! Manual operation of a machine: the dead-man rule, speeds, stops and resets, in virtual time.
//! Also `ecaxis jog` with lines and in a terminal.

mod lines;
mod operator;
mod replaced_requests;
mod terminal;

use ecaxis_axis::{Mode, State, Trip};
use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::supervise::operator::{
    Activity, HOLD_TO_RUN_TIMEOUT, MAX_MANUAL_SPEED, OperatorInput, Presence, Request,
    RequestEvent, View,
};
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{axes, faults, machine, recorded, virtual_time};
use operator::{Seen, by_hand, here, request};

/// The first two axes.
const X: AxisIndex = AxisIndex(0);
const Y: AxisIndex = AxisIndex(1);
/// Limits of the machines of `axes`, in turns/s and turns/s².
const VELOCITY: f64 = 50.0;
const ACCELERATION: f64 = 500.0;
const CYCLE_S: f64 = 0.001;
const LET_GO_S: f64 = HOLD_TO_RUN_TIMEOUT as f64 * 1e-9;

/// Enables axis 0, then calls `then` with the seconds since the axis was ready.
fn once_enabled(
    mut then: impl FnMut(&View<'_>, f64) -> Option<OperatorInput> + Send + 'static,
) -> impl FnMut(&View<'_>, f64) -> OperatorInput + Send + 'static {
    let mut ready = None;
    move |view, now| {
        let axis = &view.snapshot.axes[X];
        if ready.is_none() && !axis.ready {
            return match view.hands[X].doing {
                Activity::Nothing => request(Request::Enable { axis: X }),
                _ => here(),
            };
        }
        let since = now - *ready.get_or_insert(now);
        then(view, since).unwrap_or_else(operator::gone)
    }
}

/// Checks that the commanded velocity and its changes stay within the jog limits in every cycle.
#[track_caller]
fn within_limits(seen: &[Seen], axis: usize) {
    for pair in seen.windows(2) {
        let [before, now] = [&pair[0].axes[axis], &pair[1].axes[axis]];
        let velocity = now.target_velocity.abs();
        assert!(
            velocity <= MAX_MANUAL_SPEED * VELOCITY * 1.000_001,
            "{velocity} turns/s at {} s",
            pair[1].time_s
        );
        if before.enabled && now.enabled {
            let cycles = ((pair[1].time_s - pair[0].time_s) / CYCLE_S)
                .round()
                .max(1.0);
            let change = (now.target_velocity - before.target_velocity).abs();
            let most = ACCELERATION * CYCLE_S * cycles * 1.001;
            assert!(change <= most, "{change} turns/s at {} s", pair[1].time_s);
        }
    }
}

#[test]
fn a_released_axis_brakes() {
    let velocity = 0.1 * VELOCITY;
    let (outcome, seen) = by_hand(
        machine(&axes(1)),
        virtual_time(),
        once_enabled(move |_, since| match since {
            ..1.0 => Some(request(Request::Jog { axis: X, velocity })),
            ..3.0 => Some(here()),
            _ => None,
        }),
    );
    outcome.result.expect("leaving is not a failure");
    within_limits(&seen, 0);
    let moving = |s: &&Seen| s.axes[0].target_velocity != 0.0;
    let first = seen.iter().find(moving).expect("it jogs").time_s;
    let full = seen
        .iter()
        .filter(|s| s.axes[0].target_velocity == velocity);
    let slows = full.clone().next_back().expect("at full speed").time_s;
    let stands = seen.iter().rfind(moving).expect("it jogs").time_s;
    // The request lasts one second.
    let held = slows - first;
    assert!((held - (1.0 + LET_GO_S)).abs() < 0.02, "{held} s at speed");
    let braking = stands - slows;
    assert!(braking <= velocity / ACCELERATION + 0.005, "{braking} s");
    let news = seen.iter().flat_map(|s| &s.news);
    let news: Vec<String> = news.map(ToString::to_string).collect();
    assert_eq!(news, ["enabled", "let go, brakes", "stopped"]);
}

/// Both axes of `axes(2)` in groups of their own, without which the machine goes on.
const GROUPS: &str = "\n[[stop.group]]\nname = \"gx\"\naxes = [\"a0\"]\noutside = \"continue\"\n\
    \n[[stop.group]]\nname = \"gy\"\naxes = [\"a1\"]\noutside = \"continue\"\n";

/// The stop of one group leaves the motions of the others alone: a jog and a move of `X` go on while
/// the drive of `Y` has a fault or loses its power.
#[test]
fn the_stop_of_a_group_does_not_stop_the_others() {
    let text = format!("{}{GROUPS}", axes(2));
    for kind in ["drive-fault\"\ncode = 0x8611", "power-off\""] {
        for jogs in [true, false] {
            let script = format!("[[fault]]\nkind = \"{kind}\ndevice = 1\nat = \"1.5s\"\n");
            let folder = tempfile::tempdir().expect("a folder");
            let (options, recording) = recorded(faults(&script), folder.path());
            let (mut asked, mut begun) = (false, false);
            let (_, seen) = by_hand(
                machine(&text),
                options,
                once_enabled(move |_, since| {
                    if since > 6.0 {
                        return None;
                    }
                    let first = !std::mem::replace(&mut asked, true);
                    if first {
                        return Some(request(Request::Enable { axis: Y }));
                    }
                    if jogs {
                        return Some(match since {
                            ..4.0 => request(Request::Jog {
                                axis: X,
                                velocity: 1.0,
                            }),
                            _ => here(),
                        });
                    }
                    let go = Request::MoveTo {
                        axis: X,
                        position: 4.0,
                        speed: 0.02,
                    };
                    let begins = !std::mem::replace(&mut begun, true);
                    Some(if begins { request(go) } else { here() })
                }),
            );
            within_limits(&seen, 0);
            let news: Vec<_> = seen.iter().flat_map(|s| &s.news).collect();
            let ends = |event: &&&RequestEvent| event.axis() == Some(X);
            let last = news.iter().rfind(ends).map(ToString::to_string);
            let expected = if jogs { "stopped" } else { "is there" };
            assert_eq!(last.as_deref(), Some(expected), "{kind} {jogs}: {news:?}");
            let way = seen.last().expect("cycles").axes[0].target_position;
            assert!(way > 3.9, "{kind} {jogs}: {way}");
            // The drive of `X` received one motion, at 1 turn/s = 2 counts a cycle, and nothing else.
            let images = process_images(&recording);
            let first = |(out, _): &(Vec<u8>, Vec<u8>)| {
                let word = u16::from_le_bytes([out[0], out[1]]);
                let target = i32::from_le_bytes([out[2], out[3], out[4], out[5]]);
                (word, target)
            };
            let powered: Vec<_> = images.iter().map(first).collect();
            let enabled = |(word, _): &(u16, i32)| *word == 0x000f;
            let begin = powered.iter().position(enabled).expect("enabled");
            let end = powered.iter().rposition(enabled).expect("enabled");
            let powered = &powered[begin..=end];
            assert!(powered.iter().all(enabled), "{kind} {jogs}: power was lost");
            let moves = |three: &&[(u16, i32)]| three[1].1 != three[0].1;
            let moving = powered.windows(2).filter(moves).count();
            let starts = powered
                .windows(3)
                .filter(|three| three[1].1 == three[0].1 && three[2].1 != three[1].1);
            let starts = starts.count();
            assert!(
                moving > 3900 && starts == 1,
                "{kind} {jogs}: {moving} cycles, {starts} starts"
            );
        }
    }
}

#[test]
fn an_absent_operator_starts_nothing_and_stops_all_motion() {
    for jogs in [true, false] {
        let (outcome, seen) = by_hand(
            machine(&axes(1)),
            virtual_time(),
            once_enabled(move |_, since| {
                let jog = Request::Jog {
                    axis: X,
                    velocity: 5.0,
                };
                let go = Request::MoveTo {
                    axis: X,
                    position: 80.0,
                    speed: 0.2,
                };
                let mut turn = match since {
                    0.0 if !jogs => request(go),
                    ..2.0 if jogs => request(jog),
                    // A move requested by an absent operator is rejected as well.
                    0.8..0.9 => request(go),
                    ..3.0 => here(),
                    _ => return None,
                };
                if (0.5..1.0).contains(&since) {
                    turn.presence = Presence::Away;
                }
                // The returned operator sends no request.
                if since >= 1.0 {
                    turn.requests.clear();
                }
                Some(turn)
            }),
        );
        outcome.result.expect("leaving is not a failure");
        within_limits(&seen, 0);
        let ready = seen
            .iter()
            .find(|s| s.axes[0].ready)
            .expect("enabled")
            .time_s;
        let moving = seen.iter().filter(|s| s.axes[0].target_velocity != 0.0);
        let stands = moving.map(|s| s.time_s).next_back().expect("it moves") - ready;
        assert!((0.5..0.53).contains(&stands), "moves until {stands} s");
    }
}

/// Nothing brakes a torque that has ended. The drive's quick stop follows after the time of a stop,
/// and keeps its power until the operator leaves.
#[test]
fn a_torque_without_an_operator_ends_in_a_quick_stop() {
    let text = epos4(
        r#""0x607A", "0x6071""#,
        r#""0x6064", "0x606C", "0x6077""#,
        r#"
limits = { position = [-1000.0, 1000.0], velocity = 50.0, acceleration = 500.0, jerk = 20000.0, torque = 100.0 }
[device.sim]
motor = { viscous_friction = 0.0, coulomb_friction = 1e-5 }
"#,
    );
    let folder = tempfile::tempdir().expect("a folder");
    let (options, recording) = recorded(virtual_time(), folder.path());
    let mut next = 0;
    let (outcome, _) = by_hand(
        machine(&text),
        options,
        once_enabled(move |_, since| {
            let plan = [
                (
                    0.0,
                    Request::SetMode {
                        axis: X,
                        mode: Mode::Cst,
                    },
                ),
                (
                    0.5,
                    Request::Torque {
                        axis: X,
                        percent: 5.0,
                        ramp_s: 0.0,
                    },
                ),
            ];
            if since > 8.0 {
                return None;
            }
            let mut turn = match plan.get(next) {
                Some((at, wanted)) if since >= *at => {
                    next += 1;
                    request(*wanted)
                }
                _ => here(),
            };
            if since >= 1.5 {
                turn.presence = Presence::Away;
            }
            Some(turn)
        }),
    );
    outcome.result.expect("an ended torque fails no run");
    // Controlword and torque as received, position and velocity as reported.
    let cycles: Vec<(u16, i16, i32, i32)> = process_images(&recording)
        .iter()
        .filter(|(out, inputs)| out.len().min(inputs.len()) >= 11)
        .map(|(out, inputs)| {
            let long =
                |at: usize| i32::from_le_bytes(inputs[at..at + 4].try_into().expect("four bytes"));
            let word = u16::from_le_bytes([out[0], out[1]]);
            (word, i16::from_le_bytes([out[7], out[8]]), long(3), long(7))
        })
        .collect();
    let pushed = cycles
        .iter()
        .rposition(|c| c.1 == 50)
        .expect("a torque of 5 %");
    let ended = pushed
        + cycles[pushed..]
            .iter()
            .position(|c| c.1 == 0)
            .expect("it ends");
    let quick = ended
        + cycles[ended..]
            .iter()
            .position(|c| c.0 != 0x000f)
            .expect("a stop");
    assert_eq!(cycles[quick].0, 0x0002);
    // 100 % in 0.1 s.
    assert!(
        (4..=6).contains(&(ended - pushed)),
        "{} cycles",
        ended - pushed
    );
    let [coasts, last] = [cycles[quick - 1], cycles[cycles.len() - 1]];
    let turns = f64::from(coasts.3) / 60.0;
    assert!(turns > 5.0, "it coasts at {turns} turns/s");
    // Speed ÷ acceleration, acceleration ÷ jerk, and 1 s.
    let time_s = (quick - pushed) as f64 * CYCLE_S;
    let most = turns / ACCELERATION + 0.025 + 1.0;
    assert!(
        (1.0..most + 0.05).contains(&time_s),
        "{time_s} s, at most {most} s"
    );
    let stands = cycles[quick + 1000];
    assert_eq!((stands.0, stands.3), (0x0002, 0), "at rest, with power");
    assert!(stands.2.abs_diff(last.2) <= 1, "{} to {}", stands.2, last.2);
    assert_eq!(last.0, 0x0000);
}

#[test]
fn an_operator_who_leaves_in_motion_leaves_a_machine_at_rest() {
    let (outcome, seen) = by_hand(
        machine(&axes(2)),
        virtual_time(),
        once_enabled(|_, since| match since {
            0.0 => Some(request(Request::MoveBy {
                axis: X,
                distance: 80.0,
                speed: MAX_MANUAL_SPEED,
            })),
            ..0.5 => Some(here()),
            _ => None,
        }),
    );
    outcome.result.expect("leaving is not a failure");
    within_limits(&seen, 0);
    let last = &seen.last().expect("seen").axes[0];
    assert_eq!(
        last.target_velocity,
        MAX_MANUAL_SPEED * VELOCITY,
        "in the middle of it"
    );
    let summary = outcome.summary.expect("a summary");
    assert_eq!(summary.counters.wkc_errors, 0);
    // 12.5 turns/s for nearly half a second, then deceleration within the limits.
    let end = summary.axes[0].final_position;
    assert!((5.0..8.0).contains(&end), "stands at {end}");
}

#[test]
fn jog_rejects_more_than_a_quarter_of_the_speed_limit() {
    let jog = |velocity| Request::Jog { axis: X, velocity };
    let by = |speed| Request::MoveBy {
        axis: X,
        distance: 1.0,
        speed,
    };
    let all = [
        jog(MAX_MANUAL_SPEED * VELOCITY * 1.001),
        jog(-VELOCITY),
        jog(f64::NAN),
        jog(f64::INFINITY),
        by(MAX_MANUAL_SPEED * 1.001),
        by(0.0),
        by(-0.1),
        by(f64::NAN),
        Request::MoveTo {
            axis: X,
            position: 101.0,
            speed: 0.1,
        },
        Request::MoveTo {
            axis: X,
            position: f64::NAN,
            speed: 0.1,
        },
        Request::Home { axis: X },
        Request::SetMode {
            axis: X,
            mode: Mode::Csv,
        },
    ];
    let mut next = all.into_iter();
    let (outcome, seen) = by_hand(
        machine(&axes(1)),
        virtual_time(),
        once_enabled(move |view, since| {
            if since == 0.0 || view.news.iter().any(RequestEvent::is_failure) {
                return next.next().map(request);
            }
            (since < 5.0).then(here)
        }),
    );
    outcome.result.expect("leaving is not a failure");
    assert!(seen.iter().all(|s| s.axes[0].target_velocity == 0.0));
    let refused = seen.iter().flat_map(|s| &s.news);
    let refused = refused.filter(|news| matches!(news, RequestEvent::Refused { .. }));
    assert_eq!(refused.count(), all.len());
}

#[test]
fn a_rejected_request_keeps_the_dead_man_rule_active() {
    let (outcome, seen) = by_hand(
        machine(&axes(1)),
        virtual_time(),
        once_enabled(|_, since| {
            let mut turn = here();
            if since == 0.0 {
                // The second request is accepted before the rejection of the first is reported.
                turn.requests = vec![
                    Request::MoveTo {
                        axis: X,
                        position: 1000.0,
                        speed: 0.1,
                    },
                    Request::Jog {
                        axis: X,
                        velocity: 5.0,
                    },
                ];
            }
            (since < 2.0).then_some(turn)
        }),
    );
    outcome.result.expect("leaving is not a failure");
    within_limits(&seen, 0);
    let moving = seen.iter().filter(|s| s.axes[0].target_velocity != 0.0);
    let moving: Vec<f64> = moving.map(|s| s.time_s).collect();
    let lasted = moving
        .last()
        .zip(moving.first())
        .map_or(0.0, |(b, a)| b - a);
    assert!(lasted < LET_GO_S + 0.05, "{lasted} s");
}

#[test]
fn jog_stays_within_the_range_while_the_key_is_held() {
    let velocity = MAX_MANUAL_SPEED * VELOCITY;
    let (outcome, seen) = by_hand(
        machine(&axes(1)),
        virtual_time(),
        once_enabled(move |_, since| match since {
            ..12.0 => Some(request(Request::Jog { axis: X, velocity })),
            _ => None,
        }),
    );
    outcome.result.expect("leaving is not a failure");
    within_limits(&seen, 0);
    let last = &seen.last().expect("seen").axes[0];
    assert!(last.held_by_range);
    assert!((last.position - 100.0).abs() < 0.01, "{}", last.position);
    let beyond = seen.iter().find(|s| s.axes[0].target_position > 100.0);
    assert!(beyond.is_none(), "{beyond:?}");
}

#[test]
fn a_fault_stops_all_axes_and_is_reset() {
    let script = "[[fault]]\nkind = \"drive-fault\"\ndevice = 1\nat = \"2s\"\ncode = 0x8611\n";
    let mut reset = false;
    let (outcome, seen) = by_hand(
        machine(&axes(2)),
        faults(script),
        move |view: &View<'_>, now: f64| {
            let status = &view.snapshot.axes;
            let idle = view.idle();
            let ready = status.iter().all(|axis| axis.ready);
            if status[Y].fault.is_some() && !reset && !status[X].enabled {
                reset = true;
                return request(Request::Reset { axis: Y });
            }
            if now > 6.0 {
                return operator::gone();
            }
            let mut turn = here();
            if idle && !ready && (!reset || status[Y].fault.is_none()) {
                turn.requests = [X, Y].map(|axis| Request::Enable { axis }).to_vec();
            } else if ready {
                turn.requests = [X, Y]
                    .map(|axis| Request::Jog {
                        axis,
                        velocity: if axis == X { 2.0 } else { -2.0 },
                    })
                    .to_vec();
            }
            turn
        },
    );
    outcome.result.expect("the fault was seen to");
    within_limits(&seen, 0);
    let faulty = seen.iter().position(|s| s.axes[1].fault.is_some());
    let faulty = faulty.expect("a fault");
    // Axis 0 stops too and loses its power; both axes are enabled again later.
    let after = &seen[faulty..];
    let off = after
        .iter()
        .position(|s| s.axes[0].state != State::OperationEnabled);
    let off = off.expect("axis 0 loses its power");
    assert_eq!(after[off].axes[0].target_velocity, 0.0);
    let again = after[off..].iter().find(|s| s.axes.iter().all(|a| a.ready));
    assert!(again.is_some(), "both come back");
    let [a, b] = [0, 1].map(|axis| seen.last().expect("seen").axes[axis].target_velocity);
    assert_eq!((a, b), (2.0, -2.0), "and jog");
    let summary = outcome.summary.expect("a summary");
    assert_eq!(summary.group_stops.len(), 1, "{:?}", summary.group_stops);
}

#[test]
fn an_emergency_stop_removes_power_and_requires_a_reset() {
    for reset in [true, false] {
        let mut phase = 0;
        let (outcome, seen) = by_hand(
            machine(&axes(2)),
            virtual_time(),
            once_enabled(move |view, since| {
                let axis = &view.snapshot.axes[X];
                let (next, turn) = match phase {
                    0 => (
                        1,
                        request(Request::MoveBy {
                            axis: X,
                            distance: 50.0,
                            speed: 0.2,
                        }),
                    ),
                    1 if since > 0.5 => (2, request(Request::EmergencyStop)),
                    2 if since > 1.5 => {
                        assert!(!axis.enabled && axis.trip == Some(Trip::EmergencyStop));
                        (3, request(Request::Enable { axis: X }))
                    }
                    3 if view.news.iter().any(RequestEvent::is_failure) => {
                        assert!(!axis.enabled);
                        let enable = Request::Reset { axis: X };
                        (if reset { 4 } else { 6 }, request(enable))
                    }
                    4 if view.idle() => (5, request(Request::Enable { axis: X })),
                    5 if axis.ready => (6, here()),
                    6 => return None,
                    same => (same, here()),
                };
                phase = if turn.requests == [Request::Reset { axis: X }] && !reset {
                    return None;
                } else {
                    next
                };
                assert!(since < 20.0, "phase {phase}: {:?}", view.hands);
                Some(turn)
            }),
        );
        outcome
            .result
            .expect("leaving is not a failure, reset or not");
        let again = seen.iter().skip_while(|s| s.axes[0].trip.is_none());
        assert_eq!(again.clone().any(|s| s.axes[0].ready), reset);
    }
}

/// An EPOS4 with these extra objects (in addition to Controlword, Statusword and modes) and axis keys.
fn epos4(rx: &str, tx: &str, keys: &str) -> String {
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
         pdo.rx = [\"0x6040\", \"0x6060\", {rx}]\npdo.tx = [\"0x6041\", \"0x6061\", {tx}]\n\
         [device.axis]\nunit = \"turn\"\nencoder = 2000\n{keys}"
    )
}

/// An axis that supports homing and a switch to CSV.
fn versatile() -> String {
    epos4(
        r#""0x607A", "0x60FF""#,
        r#""0x6064", "0x606C""#,
        r#"
limits = { velocity = 50.0, acceleration = 500.0, following_error = 0.5 }
homing = { method = 17, search = 5.0, zero = 0.5, acceleration = 100.0, position = 3.0 }
[device.sim]
track = { negative_limit = -6.0, positive_limit = 6.0, home = [2.0, 2.5], index = 0.25 }
"#,
    )
}

#[test]
fn jog_homes_an_axis_and_switches_its_mode() {
    let plan = [
        Request::Home { axis: X },
        Request::MoveTo {
            axis: X,
            position: 5.0,
            speed: 0.2,
        },
        Request::SetMode {
            axis: X,
            mode: Mode::Csv,
        },
        Request::Jog {
            axis: X,
            velocity: 2.0,
        },
    ];
    let mut next = plan.into_iter();
    let (outcome, seen) = by_hand(
        machine(&versatile()),
        virtual_time(),
        once_enabled(move |view, since| {
            assert!(since < 20.0, "{:?}", view.hands);
            if view.idle() {
                return next.next().map(request);
            }
            Some(here())
        }),
    );
    outcome.result.expect("leaving is not a failure");
    within_limits(&seen, 0);
    let news = seen.iter().flat_map(|s| s.news.clone());
    let done: Vec<RequestEvent> = news
        .filter(|news| !matches!(news, RequestEvent::LetGo { .. }))
        .collect();
    let done: Vec<String> = done.iter().map(ToString::to_string).collect();
    assert_eq!(done, ["enabled", "homed", "is there", "in CSV", "stopped"]);
    let last = &seen.last().expect("seen").axes[0];
    assert!(last.homed() && last.mode == Mode::Csv);
    // 2 turns/s for 0.3 s, plus acceleration and deceleration.
    assert!((5.5..6.0).contains(&last.position), "{}", last.position);
}

#[test]
fn homing_ends_without_an_operator() {
    let (outcome, seen) = by_hand(
        machine(&versatile()),
        virtual_time(),
        once_enabled(|_, since| {
            let mut turn = match since {
                0.0 => request(Request::Home { axis: X }),
                ..2.0 => here(),
                _ => return None,
            };
            if since > 0.5 {
                turn.presence = Presence::Away;
            }
            Some(turn)
        }),
    );
    outcome.result.expect("leaving is not a failure");
    let ready = seen
        .iter()
        .find(|s| s.axes[0].ready)
        .expect("enabled")
        .time_s;
    let searched = seen.iter().filter(|s| s.axes[0].velocity.abs() > 1.0);
    let last = searched.map(|s| s.time_s).next_back().expect("it searches") - ready;
    assert!((0.4..0.7).contains(&last), "searches until {last} s");
    assert!(!seen.last().expect("seen").axes[0].homed());
}

/// Random requests, with a fault of the second drive in half of the runs: in a group that stops
/// alone, it ends no motion of the first axis.
#[test]
fn random_requests_stay_within_the_limits() {
    for seed in 1..=24_u64 {
        let groups = seed > 12;
        // xorshift
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let mut dice = move |sides: u64| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state % sides
        };
        let mut last_jog = [0.0_f64; 2];
        let mut away = false;
        // The number of requests, and the last one that may end a motion of `X`: a motion, or not.
        let (mut count, mut last) = (0, (0, false));
        let at = 1 + dice(6000);
        let script = format!(
            "[[fault]]\nkind = \"drive-fault\"\ncode = 0x8611\ndevice = 1\nat = \"{at}ms\"\n"
        );
        let options = faults(if groups { &script } else { "" });
        let text = format!("{}{}", axes(2), if groups { GROUPS } else { "" });
        let (outcome, seen) = by_hand(machine(&text), options, move |view, now| {
            let first = &view.snapshot.axes[X];
            for event in view.news.iter().filter(|event| event.axis() == Some(X)) {
                let ended = match event {
                    // A fault of its own stops its group.
                    RequestEvent::Failed { why, .. } => {
                        !why.contains("not reached") && !why.contains("its group has been stopped")
                    }
                    RequestEvent::Done { what, .. } => *what == Activity::Stopping,
                    _ => false,
                };
                let unasked = last == (event.request(), true);
                let healthy = first.trip.is_none() && first.fault.is_none() && !away;
                assert!(
                    !(ended && unasked && healthy),
                    "seed {seed}, {now} s: {event:?}"
                );
                // It brakes.
                let brakes = matches!(
                    event,
                    RequestEvent::LetGo { .. } | RequestEvent::Refused { .. }
                );
                last.1 &= !brakes;
            }
            if now > 8.0 {
                return operator::gone();
            }
            for (axis, hand) in view.hands.iter().enumerate() {
                let jogs = matches!(hand.doing, Activity::Jogging { .. });
                let long = now - last_jog[axis] > LET_GO_S + 0.003;
                assert!(!(jogs && long), "seed {seed}: still jogs at {now} s");
            }
            if dice(300) == 0 {
                away = !away;
            }
            let mut turn = here();
            if away {
                turn.presence = Presence::Away;
            }
            for _ in 0..dice(3) {
                let axis = AxisIndex(dice(2) as usize);
                let part = dice(1000) as f64 / 500.0 - 1.0;
                let again = match dice(60) {
                    0..10 => {
                        let velocity = part * 2.0 * MAX_MANUAL_SPEED * VELOCITY;
                        last_jog[axis.0] = now;
                        Request::Jog { axis, velocity }
                    }
                    10 => Request::MoveBy {
                        axis,
                        distance: part * 20.0,
                        speed: part * 0.5,
                    },
                    11 => Request::MoveTo {
                        axis,
                        position: part * 150.0,
                        speed: part * 0.5,
                    },
                    12..20 => Request::Enable { axis },
                    20 => Request::Disable { axis },
                    21 => Request::Stop { axis },
                    22 => Request::StopAll,
                    23..30 => Request::Reset { axis },
                    30 if dice(20) == 0 => Request::EmergencyStop,
                    31 => Request::Home { axis },
                    32 => Request::SetMode {
                        axis,
                        mode: Mode::Csv,
                    },
                    33 => Request::Enable { axis: AxisIndex(7) },
                    _ => continue,
                };
                count += 1;
                let moves = match again {
                    Request::Jog { velocity, .. } => velocity != 0.0,
                    Request::MoveBy { .. } | Request::MoveTo { .. } => true,
                    _ => false,
                };
                let stops_all = matches!(again, Request::StopAll | Request::EmergencyStop);
                if axis == X || stops_all {
                    last = (count, moves);
                }
                turn.requests.push(again);
            }
            turn
        });
        outcome
            .result
            .unwrap_or_else(|error| panic!("seed {seed}: {error}"));
        for axis in 0..2 {
            within_limits(&seen, axis);
            let out = seen
                .iter()
                .find(|s| s.axes[axis].target_position.abs() > 100.0);
            assert!(out.is_none(), "seed {seed}: {out:?}");
        }
        let moved = seen.iter().any(|s| s.axes[0].target_velocity != 0.0);
        assert!(moved, "seed {seed}: nothing has been tried");
    }
}

/// A stop while the axis is being enabled: it gets no power, and the request ends as replaced.
#[test]
fn a_stop_ends_the_enabling_of_an_axis() {
    for stop in [Request::StopAll, Request::Stop { axis: X }] {
        let mut turn = 0;
        let (outcome, seen) = by_hand(machine(&versatile()), virtual_time(), move |view, now| {
            turn += 1;
            match turn {
                1 => request(Request::Enable { axis: X }),
                2 => {
                    assert_eq!(view.hands[X].doing, Activity::Enabling);
                    request(stop)
                }
                _ if now < 3.0 => here(),
                _ => operator::gone(),
            }
        });
        outcome.result.expect("leaving is not a failure");
        let powered = seen.iter().find(|s| s.axes[0].powered);
        assert!(powered.is_none(), "{stop:?}: power at {powered:?}");
    }
}

/// A stop of all axes ends a switch of the mode without power, too: power does not return.
#[test]
fn stop_of_all_axes_ends_a_switch_without_power() {
    let keys = "\nmode_change = \"no-power\"";
    let text = versatile().replace(
        "\n[device.sim]\n",
        &format!("{keys}\n[device.sim]\nquirks = {{ mode_without_power = true }}\n"),
    );
    for begin in [
        Request::Home { axis: X },
        Request::SetMode {
            axis: X,
            mode: Mode::Csv,
        },
    ] {
        let mut phase = 0;
        let mut begin = Some(begin);
        let mut stopped = 0.0;
        let (outcome, seen) = by_hand(
            machine(&text),
            virtual_time(),
            once_enabled(move |view, since| {
                let axis = &view.snapshot.axes[X];
                let turn = match phase {
                    0 => {
                        phase = 1;
                        request(begin.take().expect("once"))
                    }
                    1 if !axis.powered => {
                        (phase, stopped) = (2, since);
                        request(Request::StopAll)
                    }
                    2 if since > stopped + 4.0 => return None,
                    _ => here(),
                };
                assert!(since < 20.0, "phase {phase}");
                Some(turn)
            }),
        );
        outcome.result.expect("leaving is not a failure");
        let off = seen
            .iter()
            .position(|s| s.axes[0].ready)
            .expect("ready first");
        let mut after = seen[off..].iter().skip_while(|s| s.axes[0].powered);
        assert!(after.next().is_some(), "the switch removes the power");
        assert!(after.all(|s| !s.axes[0].powered), "it does not return");
    }
}
