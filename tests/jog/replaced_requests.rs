//! Requests that replace a jog, and rejected requests: unattended motion stops, and every rejection
//! is reported.

use ecaxis_axis::Mode;
use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::supervise::operator::{
    Activity, OperatorInput, Presence, Request, RequestEvent, View,
};

use super::operator::{Seen, by_hand, gone, here, request};
use super::{LET_GO_S, X, Y, once_enabled, versatile, within_limits};
use ecaxis_test_support::{axes, faults, machine, virtual_time};

/// Jogs for a quarter of a second, sends one other request, then sends no requests.
fn replaced_by(file: &str, instead: Request, presence: Presence) -> (f64, Vec<Seen>) {
    const LAST: f64 = 0.25;
    let mut asked = false;
    let (outcome, seen) = by_hand(
        machine(file),
        virtual_time(),
        once_enabled(move |view, since| {
            let velocity = 5.0;
            if since < LAST {
                return Some(request(Request::Jog { axis: X, velocity }));
            }
            if !asked {
                asked = true;
                assert_eq!(view.snapshot.axes[X].target_velocity, velocity);
                return Some(request(instead));
            }
            let mut turn = here();
            turn.presence = presence;
            (since < 3.0).then_some(turn)
        }),
    );
    outcome.result.expect("leaving is not a failure");
    within_limits(&seen, 0);
    let ready = seen.iter().find(|s| s.axes[0].ready).expect("enabled");
    let moving = seen.iter().rfind(|s| s.axes[0].target_velocity != 0.0);
    let stands = moving.expect("it jogs").time_s - ready.time_s - LAST;
    (stands, seen)
}

/// A request that replaces a jog, or is rejected, must not let the axis move on without a held key.
#[test]
fn a_request_that_replaces_a_jog_keeps_the_dead_man_rule_active() {
    let speed = 0.1;
    let others = [
        Request::Enable { axis: X },
        Request::Reset { axis: X },
        Request::SetMode {
            axis: X,
            mode: Mode::Csv,
        },
        Request::MoveBy {
            axis: X,
            distance: 1000.0,
            speed,
        },
        Request::MoveTo {
            axis: X,
            position: 1000.0,
            speed,
        },
        Request::Home { axis: X },
    ];
    // The second machine has a range but no homing and no other mode, so it rejects each request.
    let versatile = versatile();
    for file in [&versatile, &axes(1)] {
        for instead in others {
            for presence in [Presence::Here, Presence::Away] {
                // The versatile machine has no range, so it accepts these moves.
                let goes = matches!(instead, Request::MoveBy { .. } | Request::MoveTo { .. });
                if goes && *file == versatile && presence == Presence::Here {
                    continue;
                }
                let (stands, _) = replaced_by(file, instead, presence);
                assert!(
                    stands < LET_GO_S + 0.05,
                    "{instead:?}, {presence:?}: moves for {stands} s"
                );
            }
        }
    }
}

/// A move that replaces a jog in the same cycle starts without braking.
#[test]
fn a_move_continues_from_a_jog() {
    let instead = Request::MoveTo {
        axis: X,
        position: 20.0,
        speed: 0.1,
    };
    let (_, seen) = replaced_by(&axes(1), instead, Presence::Here);
    let full = seen.iter().position(|s| s.axes[0].target_velocity == 5.0);
    let after = &seen[full.expect("at full speed")..];
    let near: Vec<_> = after
        .iter()
        .take_while(|s| s.axes[0].position < 10.0)
        .collect();
    let (first, last) = (near[0], near[near.len() - 1]);
    assert!(
        last.time_s - first.time_s > 1.9,
        "ten units at five a second"
    );
    for s in near {
        assert_eq!(s.axes[0].target_velocity, 5.0, "at {} s", s.time_s);
    }
}

fn both(request: impl Fn(AxisIndex) -> Request) -> OperatorInput {
    OperatorInput {
        requests: [X, Y].map(request).to_vec(),
        ..OperatorInput::default()
    }
}

/// Same as `once_enabled` for axes 0 and 1.
fn both_enabled(
    mut then: impl FnMut(&View<'_>, f64) -> Option<OperatorInput> + Send + 'static,
) -> impl FnMut(&View<'_>, f64) -> OperatorInput + Send + 'static {
    let mut ready = None;
    move |view, now| {
        if ready.is_none() && !view.snapshot.axes.iter().all(|axis| axis.ready) {
            return match view.hands[X].doing {
                Activity::Nothing if now < 0.01 => both(|axis| Request::Enable { axis }),
                _ => here(),
            };
        }
        let since = now - *ready.get_or_insert(now);
        then(view, since).unwrap_or_else(gone)
    }
}

/// Requests for two axes are rejected at once; both rejections are reported.
#[test]
fn every_rejection_is_reported() {
    let far = |axis| Request::MoveTo {
        axis,
        position: 1000.0,
        speed: 0.1,
    };
    let (outcome, seen) = by_hand(
        machine(&axes(2)),
        virtual_time(),
        both_enabled(move |_, since| match since {
            0.0 => Some(both(far)),
            ..1.0 => Some(here()),
            _ => None,
        }),
    );
    outcome.result.expect("leaving is not a failure");
    let news = seen.iter().flat_map(|s| s.news.clone());
    let news: Vec<RequestEvent> = news
        .skip_while(|news| matches!(news, RequestEvent::Done { .. }))
        .collect();
    let refused = |n: usize| matches!(&news[n], RequestEvent::Refused { axis, .. } if axis.0 == n);
    assert!(news.len() == 2 && refused(0) && refused(1), "{news:?}");
}

/// A rejected homing counts as finished, so that no caller waits for it.
#[test]
fn rejected_homing_counts_as_finished() {
    let first = versatile();
    let second = first.replace(r#"name = "x""#, r#"name = "y""#);
    let second = second.replace("position = 0\n", "position = 1\n");
    let (_, second) = second.split_once("[[device]]").expect("a device");
    let file = format!("{first}[[device]]{second}");
    let mut asked = false;
    let (outcome, seen) = by_hand(
        machine(&file),
        virtual_time(),
        both_enabled(move |view, since| {
            let jog = |axis| Request::Jog {
                axis,
                velocity: 5.0,
            };
            if since < 0.2 {
                return Some(both(jog));
            }
            if !asked {
                asked = true;
                return Some(both(|axis| Request::Home { axis }));
            }
            assert!(since < 1.0, "{:?}", view.hands);
            (!view.idle()).then(here)
        }),
    );
    outcome.result.expect("leaving is not a failure");
    let news = seen.iter().flat_map(|s| &s.news);
    let refused = news.filter(|news| matches!(news, RequestEvent::Refused { .. }));
    assert_eq!(refused.count(), 2);
}

/// The axes of a stopped group stop already. A stop of them is not rejected, so no rejection ends
/// the reset that follows.
#[test]
fn a_stop_of_a_stopped_group_is_accepted() {
    let script = "[[fault]]\nkind = \"drive-fault\"\ndevice = 1\nat = \"2s\"\ncode = 0x8611\n";
    let mut next = [
        Request::Stop { axis: X },
        Request::Reset { axis: X },
        Request::Enable { axis: X },
    ]
    .into_iter();
    let mut faulty = false;
    let (outcome, seen) = by_hand(
        machine(&axes(2)),
        faults(script),
        both_enabled(move |view, since| {
            let status = &view.snapshot.axes;
            faulty |= status[Y].fault.is_some();
            if !faulty {
                let velocity = 2.0;
                return Some(request(Request::Jog { axis: X, velocity }));
            }
            let enables = next.len() == 1 && !view.idle();
            let turn = (!enables).then(|| next.next().map(request)).flatten();
            (since < 8.0).then(|| turn.unwrap_or_else(here))
        }),
    );
    outcome.result.expect("the fault was seen to");
    let news = seen.iter().flat_map(|s| &s.news);
    let refused: Vec<_> = news
        .filter(|news| matches!(news, RequestEvent::Refused { .. }))
        .collect();
    assert!(refused.is_empty(), "{refused:?}");
    assert!(seen.last().expect("seen").axes[0].ready, "enabled again");
}
