//! The stream of a leader on another machine, as a link that feeds the line shaft: at rest, then a
//! constant acceleration up to a constant velocity.

use std::fmt;
use std::sync::Arc;

use ecaxis_axis::setpoint::{LineShaftPoint, Motion};
use ecaxis_master::clock::{self, Nanos, set_common_offset};
use ecaxis_master::link::redundant::RingStatus;
use ecaxis_master::link::sim::SimInputSender;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME, capture};
use ecaxis_master::rt::setpoint_cell::SetpointCell;

/// Common time at the begin of a run, in ns since 1970.
const BEGIN: u64 = 1_795_651_200_000_000_000;
/// The time in ns from the begin of a run to the first motion.
const START: u64 = 6_500_000_000;
/// The time in ns between two messages, and that by which a point is known before its instant.
const INTERVAL: u64 = 5_000_000;
const AHEAD: u64 = 2_000_000;
const VELOCITY: f64 = 3.906_25;
const ACCELERATION: f64 = 19.531_25;

pub struct Leader {
    pub link: Box<dyn Link>,
    pub cell: Arc<SetpointCell>,
    /// The times of the first frame and of the next message.
    pub begin: Nanos,
    pub next: Nanos,
}

impl fmt::Debug for Leader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Leader")
    }
}

fn motion(at_s: f64) -> Motion {
    let ramp_s = VELOCITY / ACCELERATION;
    let (fast, slow) = ((at_s - ramp_s).max(0.0), at_s.clamp(0.0, ramp_s));
    Motion {
        position: ACCELERATION * slow * slow / 2.0 + VELOCITY * fast,
        velocity: ACCELERATION * slow,
        acceleration: if slow > 0.0 && slow < ramp_s {
            ACCELERATION
        } else {
            0.0
        },
    }
}

impl Link for Leader {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let now = clock::now();
        if self.next == 0 {
            (self.begin, self.next) = (now, now);
            set_common_offset(BEGIN.cast_signed() - now.cast_signed());
        }
        if now >= self.next {
            self.next += INTERVAL;
            let ahead = now - self.begin + AHEAD;
            let at_ns = BEGIN + ahead;
            let motion = motion((ahead.cast_signed() - START.cast_signed()) as f64 * 1e-9);
            let stream = 1;
            self.cell.write(Some(LineShaftPoint {
                stream,
                at_ns,
                motion,
            }));
        }
        self.link.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.link.recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.link.next_arrival()
    }

    fn ring(&self) -> Option<&'static RingStatus> {
        self.link.ring()
    }

    fn take_sim_inputs(&mut self) -> Option<SimInputSender> {
        self.link.take_sim_inputs()
    }

    fn finish(self: Box<Self>) -> std::io::Result<Option<capture::RecordStats>> {
        self.link.finish()
    }
}
