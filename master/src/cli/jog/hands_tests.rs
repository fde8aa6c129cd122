//! What has waited too long is no longer wanted.

use ecaxis::supervise::manual::Request;

use super::*;

const NOW: Nanos = 10_000_000_000;

fn hands() -> (Sender<(Instant, Ask)>, Hands) {
    let (asks, asked) = channel();
    let hands = Hands {
        asked,
        shared: Arc::default(),
        heard: None,
        shown: None,
        began: None,
        away: false,
        gone: false,
    };
    (asks, hands)
}

fn ago(ms: u64) -> Instant {
    let age = Duration::from_millis(ms);
    Instant::now().checked_sub(age).expect("up for longer")
}

fn told(hands: &Hands) -> Vec<String> {
    let seen = hands.shared.seen();
    seen.messages.last(9).map(|m| m.text.clone()).collect()
}

#[test]
fn keys_from_a_stall_do_nothing_but_stop() {
    let (axis, speed) = (0, 0.1);
    let wanted = [
        Request::Jog {
            axis,
            velocity: 5.0,
        },
        Request::MoveBy {
            axis,
            distance: 1.0,
            speed,
        },
        Request::Home { axis },
        Request::Enable { axis },
        Request::Reset { axis },
    ];
    let stops = [
        Request::Stop { axis },
        Request::StopAll,
        Request::EmergencyStop,
        Request::Disable { axis },
    ];
    for (age, passed) in [(0, true), (200, true), (400, false), (5_000, false)] {
        let (asks, mut hands) = hands();
        for request in wanted.into_iter().chain(stops) {
            asks.send((ago(age), Ask::For(request))).expect("heard");
        }
        let mut expected = stops.to_vec();
        if passed {
            expected.splice(0..0, wanted);
        }
        assert_eq!(hands.hear(NOW), expected, "{age} ms");
        assert_eq!(told(&hands).len(), usize::from(!passed));
    }
}

#[test]
fn a_sign_of_life_is_as_old_as_it_is() {
    for (age, away) in [(0, false), (400, false), (700, true)] {
        let (asks, mut hands) = hands();
        // In whatever order.
        for age in [age + 2_000, age, age + 1_000] {
            asks.send((ago(age), Ask::Alive)).expect("heard");
        }
        hands.hear(NOW);
        assert_eq!(hands.away, away, "{age} ms");
    }
}

#[test]
fn who_leaves_has_left() {
    for leave in [true, false] {
        let (asks, mut hands) = hands();
        if leave {
            asks.send((ago(60_000), Ask::Leave)).expect("heard");
        } else {
            drop(asks);
        }
        assert_eq!(hands.hear(NOW), []);
        assert!(hands.gone);
    }
}
