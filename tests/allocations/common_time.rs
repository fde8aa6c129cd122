//! SYNC0 that is aligned with common time, and a program that starts at an instant.

use std::sync::{Arc, Mutex};

use ecaxis_master::config::CommonTimeUse;
use ecaxis_master::rt::cycle::StartState;
use ecaxis_master::session::Attachments;
use ecaxis_master::supervise::operator::{
    self, Operator, OperatorInput, Presence, ProgramRequest, Request, View,
};
use ecaxis_test_support::{axes, faults, machine};

use super::metered_among_users;

const SECOND: u64 = 1_000_000_000;
/// Common time is virtual time here.
const REQUEST: u64 = 12 * SECOND;
const START: u64 = 14 * SECOND;

/// Requests the start once.
#[derive(Debug, Default)]
struct StartOnce {
    requested: bool,
    seen: Arc<Mutex<StartState>>,
}

impl Operator for StartOnce {
    fn turn(&mut self, view: &View<'_>) -> OperatorInput {
        let now = view.now >= REQUEST && !self.requested;
        self.requested |= now;
        *self.seen.lock().expect("one thread") = view.snapshot.start;
        let at_unix_ns = START;
        let start = Request::Program(ProgramRequest::StartAt { at_unix_ns });
        OperatorInput {
            presence: Presence::Here,
            requests: now.then_some(start).into_iter().collect(),
        }
    }
}

/// The correction goes on while frames are lost and the offset is read again.
#[test]
fn alignment_and_a_common_start_allocate_nothing() {
    let script = "[[fault]]\nkind = \"frame-loss\"\nat = \"8s\"\ncount = 1\n";
    let mut bus = operator::for_manual_mode(machine(&axes(2)));
    bus.bus.common_time = CommonTimeUse::Align;
    let operator = StartOnce::default();
    let seen = Arc::clone(&operator.seen);
    let attachments = Attachments {
        operator: Some(Box::new(operator)),
        ..Attachments::default()
    };
    let (counted, remains, result, _) =
        metered_among_users(bus, &faults(script), attachments, 16_000, 0);
    assert!(result.is_none(), "{result:?}");
    assert!(remains.stats.counters.lost_frames > 0);
    let start = *seen.lock().expect("one thread");
    assert!(
        matches!(start, StartState::Begun { at: START, .. }),
        "{start:?}"
    );
    assert_eq!(counted, 0);
}
