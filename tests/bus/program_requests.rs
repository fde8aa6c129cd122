//! Requests of an operator that start and stop the program.

use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::supervise::operator::{ProgramRequest, Request};

use crate::common_time::{Act, BEGIN, MS, SECOND, plan, run};

/// A start and its stop may come in the same turn. Only the program ends, and it may start again.
#[test]
fn a_program_is_stopped_before_it_begins() {
    let request = |request| Act::Request(Request::Program(request));
    let start = request(ProgramRequest::Start);
    let at_unix_ns = BEGIN + 7 * SECOND;
    let axis = AxisIndex(0);
    for first in [start, request(ProgramRequest::StartAt { at_unix_ns })] {
        for stop in [
            request(ProgramRequest::Stop),
            Act::Request(Request::StopAll),
            Act::Request(Request::Disable { axis }),
        ] {
            let acts = [(5 * SECOND, first), (5 * SECOND, stop), (6 * SECOND, start)];
            let run = run(plan("", &acts, 9));
            let case = format!("{first:?}, {stop:?}");
            assert_eq!(run.error, None, "{case}");
            let mut results = run.results();
            results.retain(|result| *result != Ok(()));
            assert_eq!(results, [Err("stopped".to_owned())], "{case}");
            let moves = run
                .seen
                .changes
                .iter()
                .filter(|at| **at > BEGIN + 4 * SECOND);
            let first = moves.min().expect("the second start moves") - BEGIN;
            let soon = 6 * SECOND..6 * SECOND + 900 * MS;
            assert!(soon.contains(&first), "{case}: {first}");
        }
    }
}
