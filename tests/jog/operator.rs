//! Operators made of closures, and a record of the cycles that they saw.

use std::fmt;
use std::sync::{Arc, Mutex};

use ecaxis_axis::AxisStatus;
use ecaxis_master::config::Machine;
use ecaxis_master::session::{self, Options, Outcome};
use ecaxis_master::supervise::operator::{
    Operator, OperatorInput, Presence, Request, RequestEvent, View,
};

use ecaxis_test_support::Heard;

/// One cycle.
#[derive(Debug, Clone)]
pub struct Seen {
    /// The time of the cycle since the first cycle.
    pub time_s: f64,
    pub axes: Vec<AxisStatus>,
    pub news: Vec<RequestEvent>,
}

pub fn here() -> OperatorInput {
    OperatorInput::default()
}

pub fn request(request: Request) -> OperatorInput {
    OperatorInput {
        requests: vec![request],
        ..OperatorInput::default()
    }
}

pub fn gone() -> OperatorInput {
    OperatorInput {
        presence: Presence::Gone,
        ..OperatorInput::default()
    }
}

struct Plan<F> {
    plan: F,
    began: Option<u64>,
    seen: Arc<Mutex<Vec<Seen>>>,
}

impl<F> fmt::Debug for Plan<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Plan")
    }
}

impl<F: FnMut(&View<'_>, f64) -> OperatorInput + Send> Operator for Plan<F> {
    fn turn(&mut self, view: &View<'_>) -> OperatorInput {
        let began = *self.began.get_or_insert(view.now);
        let time_s = (view.now - began) as f64 * 1e-9;
        let replaced = |event: &&RequestEvent| matches!(event, RequestEvent::Replaced { .. });
        let news = view.news.iter().filter(|event| !replaced(event));
        self.seen.lock().expect("no panic").push(Seen {
            time_s: (view.snapshot.time.saturating_sub(began)) as f64 * 1e-9,
            axes: view.snapshot.axes.to_vec(),
            news: news.cloned().collect(),
        });
        (self.plan)(view, time_s)
    }
}

/// Runs a machine with the operator `plan`, which receives the seconds since its first call.
pub fn by_hand(
    machine: Machine,
    options: Options,
    plan: impl FnMut(&View<'_>, f64) -> OperatorInput + Send + 'static,
) -> (Outcome, Vec<Seen>) {
    let seen = Arc::new(Mutex::new(Vec::new()));
    let operator = Box::new(Plan {
        plan,
        began: None,
        seen: Arc::clone(&seen),
    });
    let mut heard = Heard::default();
    let outcome =
        session::run_with_operator(machine, options, Arc::default(), &mut heard, operator);
    let seen = std::mem::take(&mut *seen.lock().expect("no panic"));
    (outcome, seen)
}
