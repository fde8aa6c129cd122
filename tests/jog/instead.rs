//! What takes the place of a jog, and what is refused: nothing runs on that nobody watches, and everything is told.

use ecaxis::supervise::manual::{Doing, News, Presence, Request, Turn, View};
use ecaxis_axis::Mode;

use super::common::{axes, machine, virtual_time};
use super::hands::{Seen, by_hand, gone, here, request};
use super::{LET_GO_S, VERSATILE, once_enabled, within_limits};

/// Jogs for a quarter of a second, asks for something else once, and for nothing any more.
fn replaced_by(file: &str, instead: Request, presence: Presence) -> (f64, Vec<Seen>) {
    const LAST: f64 = 0.25;
    let mut asked = false;
    let (outcome, seen) = by_hand(
        machine(file),
        virtual_time(),
        once_enabled(move |view, since| {
            let velocity = 5.0;
            if since < LAST {
                return Some(request(Request::Jog { axis: 0, velocity }));
            }
            if !asked {
                asked = true;
                assert_eq!(view.snapshot.axes[0].target_velocity, velocity);
                return Some(request(instead));
            }
            let mut turn = here();
            turn.presence = presence;
            (since < 3.0).then_some(turn)
        }),
    );
    outcome.result.expect("leaving is no failure");
    within_limits(&seen, 0);
    let ready = seen.iter().find(|s| s.axes[0].ready).expect("enabled");
    let moving = seen.iter().rfind(|s| s.axes[0].target_velocity != 0.0);
    let stands = moving.expect("it jogs").time_s - ready.time_s - LAST;
    (stands, seen)
}

/// What takes the place of a jog, or is refused in its place, does not let it run on with nobody holding a key.
#[test]
fn what_replaces_a_jog_does_not_make_the_rule_forget() {
    let speed = 0.1;
    let others = [
        Request::Enable { axis: 0 },
        Request::Reset { axis: 0 },
        Request::SetMode {
            axis: 0,
            mode: Mode::Csv,
        },
        Request::MoveBy {
            axis: 0,
            distance: 1000.0,
            speed,
        },
        Request::MoveTo {
            axis: 0,
            position: 1000.0,
            speed,
        },
        Request::Home { axis: 0 },
    ];
    // In the second there are a range, no homing and no other mode: there it is all refused.
    for file in [VERSATILE, &axes(1)] {
        for instead in others {
            for presence in [Presence::Here, Presence::Away] {
                // The versatile one has no range that would refuse it.
                let goes = matches!(instead, Request::MoveBy { .. } | Request::MoveTo { .. });
                if goes && file == VERSATILE && presence == Presence::Here {
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

/// A move that takes over from a jog in the same cycle does not brake first.
#[test]
fn a_move_takes_over_from_a_jog() {
    let instead = Request::MoveTo {
        axis: 0,
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

fn both(request: impl Fn(usize) -> Request) -> Turn {
    Turn {
        requests: [0, 1].map(request).to_vec(),
        ..Turn::default()
    }
}

/// The same with axes 0 and 1.
fn both_enabled(
    mut then: impl FnMut(&View<'_>, f64) -> Option<Turn> + Send + 'static,
) -> impl FnMut(&View<'_>, f64) -> Turn + Send + 'static {
    let mut ready = None;
    move |view, now| {
        if ready.is_none() && !view.snapshot.axes.iter().all(|axis| axis.ready) {
            return match view.hands[0].doing {
                Doing::Nothing if now < 0.01 => both(|axis| Request::Enable { axis }),
                _ => here(),
            };
        }
        let since = now - *ready.get_or_insert(now);
        then(view, since).unwrap_or_else(gone)
    }
}

/// Two axes are refused what was asked of them at once: each is told.
#[test]
fn every_refusal_is_told() {
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
    outcome.result.expect("leaving is no failure");
    let news = seen.iter().flat_map(|s| s.news.clone());
    let news: Vec<News> = news
        .skip_while(|news| matches!(news, News::Done { .. }))
        .collect();
    let refused = |axis| matches!(&news[axis], News::Refused { axis: told, .. } if *told == axis);
    assert!(news.len() == 2 && refused(0) && refused(1), "{news:?}");
}

/// Homing that is refused is over, and whoever waits for it waits no longer.
#[test]
fn homing_that_is_not_begun_is_over() {
    let second = VERSATILE.replace(r#"name = "x""#, r#"name = "y""#);
    let second = second.replace("position = 0\n", "position = 1\n");
    let (_, second) = second.split_once("[[device]]").expect("a device");
    let file = format!("{VERSATILE}[[device]]{second}");
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
    outcome.result.expect("leaving is no failure");
    let news = seen.iter().flat_map(|s| &s.news);
    let refused = news.filter(|news| matches!(news, News::Refused { .. }));
    assert_eq!(refused.count(), 2);
}
