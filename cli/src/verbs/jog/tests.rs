//! Requests older than the hold-to-run time-out are dropped, except stops.

use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::supervise::operator::Request;

use super::*;

const NOW: Nanos = 10_000_000_000;

fn hands() -> (Sender<(Instant, UiAction)>, MachineSide) {
    let (asks, asked) = channel();
    let hands = MachineSide {
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

fn messages(hands: &MachineSide) -> Vec<String> {
    let seen = hands.shared.seen();
    seen.messages.last(9).map(|m| m.text.clone()).collect()
}

#[test]
fn stale_requests_are_dropped_except_stops() {
    let (axis, speed) = (AxisIndex(0), 0.1);
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
            asks.send((ago(age), UiAction::For(request)))
                .expect("heard");
        }
        let mut expected = stops.to_vec();
        if passed {
            expected.splice(0..0, wanted);
        }
        assert_eq!(hands.hear(NOW), expected, "{age} ms");
        assert_eq!(messages(&hands).len(), usize::from(!passed));
    }
}

#[test]
fn sign_of_life_counts_from_its_send_time() {
    for (age, away) in [(0, false), (400, false), (700, true)] {
        let (asks, mut hands) = hands();
        // The order of arrival does not matter.
        for age in [age + 2_000, age, age + 1_000] {
            asks.send((ago(age), UiAction::Alive)).expect("heard");
        }
        hands.hear(NOW);
        assert_eq!(hands.away, away, "{age} ms");
    }
}

#[test]
fn leave_or_closed_channel_ends_the_session() {
    for leave in [true, false] {
        let (asks, mut hands) = hands();
        if leave {
            asks.send((ago(60_000), UiAction::Leave)).expect("heard");
        } else {
            drop(asks);
        }
        assert_eq!(hands.hear(NOW), []);
        assert!(hands.gone);
    }
}
