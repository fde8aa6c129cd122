//! An axis in gear with a line shaft, whose set-points another thread writes.

use std::sync::Arc;

use ecaxis_axis::setpoint::{LineShaftEnd, LineShaftPoint, Motion};
use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::clock;
use ecaxis_master::rt::setpoint_cell::{SetpointCell, SetpointCells};
use ecaxis_master::rt::setpoint_generator::{GeneratorError, GeneratorState};
use ecaxis_master::session::Attachments;
use ecaxis_master::supervise::operator::{
    self, Operator, OperatorInput, Presence, ProgramRequest, Request, View,
};
use ecaxis_test_support::{axes, machine, virtual_time};

use super::metered_among_users;

const SECOND: u64 = 1_000_000_000;

/// Writes set-points of a constant velocity until 8 s, and starts the program at 5 s.
#[derive(Debug)]
struct Feeder {
    cell: Arc<SetpointCell>,
    started: bool,
}

impl Operator for Feeder {
    fn turn(&mut self, _: &View<'_>) -> OperatorInput {
        // Common time is virtual time here.
        let at_ns = clock::now();
        if (4 * SECOND..8 * SECOND).contains(&at_ns) {
            let motion = Motion {
                position: at_ns as f64 * 1e-9,
                velocity: 1.0,
                acceleration: 0.0,
            };
            self.cell.write(Some(LineShaftPoint {
                stream: 1,
                at_ns,
                motion,
            }));
        }
        let now = at_ns >= 5 * SECOND && !self.started;
        self.started |= now;
        let start = Request::Program(ProgramRequest::Start);
        OperatorInput {
            presence: Presence::Here,
            requests: now.then_some(start).into_iter().collect(),
        }
    }
}

#[test]
fn a_line_shaft_and_its_stop_allocate_nothing() {
    let text = axes(2);
    let (before, _) = text.split_once("[[step]]").expect("steps");
    let shaft = "[[line_shaft]]\nname = \"shaft\"\nvelocity = 2.0\nacceleration = 10.0\n\
                 [[step]]\ngear = { a0 = { to = \"shaft\" } }\n[[step]]\ndwell = \"20s\"\n";
    let bus = operator::for_manual_mode(machine(&format!("{before}{shaft}")));
    let cell = Arc::<SetpointCell>::default();
    let published = Arc::<SetpointCell>::default();
    let operator = Feeder {
        cell: Arc::clone(&cell),
        started: false,
    };
    let attachments = Attachments {
        operator: Some(Box::new(operator)),
        setpoints: SetpointCells {
            axes: [Arc::clone(&published), Arc::default()].into(),
            line_shafts: [cell].into(),
        },
        ..Attachments::default()
    };
    let (counted, remains, result, _) =
        metered_among_users(bus, &virtual_time(), attachments, 12_000, 0);
    // The axis has followed the shaft until it stood.
    let state = remains.axes[AxisIndex(0)].generator.state();
    let end = LineShaftEnd::Timeout;
    assert!(
        matches!(state, GeneratorState::Failed(GeneratorError::LineShaft { end: found, .. }) if found == end),
        "{state:?}, {result:?}"
    );
    assert_eq!(published.stream(), 1);
    assert_eq!(counted, 0);
}
