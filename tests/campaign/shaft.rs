//! A master on another machine: runs a plan in this process, because the points of a line shaft come
//! from a connection in real time otherwise.

use std::fmt;
use std::path::Path;
use std::sync::Arc;

use ecaxis_axis::setpoint::{LineShaftPoint, Motion};
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::clock::{self, Clock};
use ecaxis_master::config;
use ecaxis_master::link::sim::SimLink;
use ecaxis_master::link::{Link, LinkError, MAX_FRAME};
use ecaxis_master::rt::setpoint_cell::{SetpointCell, SetpointCells};
use ecaxis_master::session::{
    self, Attachments, Observer, Options, Progress, recorded, recording_comment, simulated_bus,
};
use ecaxis_sim::FaultScript;
use serde_json::{Value, json};

use super::generate::Plan;
use super::random::Random;

/// The motion of the master, in units and in seconds of virtual time.
#[derive(Debug, Clone, Copy)]
pub struct Feed {
    pub velocity: f64,
    pub acceleration: f64,
    pub begin_s: f64,
    /// The master decelerates from here on.
    pub rest_s: f64,
    /// The share of messages that is lost.
    pub loss: f64,
    /// No message comes from here on.
    pub end_s: Option<f64>,
}

/// The time from one message to the next.
const INTERVAL_S: f64 = 0.005;
/// A set-point is known so long before it takes effect.
const AHEAD_S: f64 = 0.002;

impl Feed {
    /// The smooth change from 0 to 1 within 1: its integral, its value, its slope.
    fn ramp(x: f64) -> [f64; 3] {
        if x <= 0.0 {
            [0.0; 3]
        } else if x >= 1.0 {
            [x - 0.5, 1.0, 0.0]
        } else {
            let square = x * x;
            let value = 3.0 * square - 2.0 * square * x;
            let way = square * x - square * square / 2.0;
            [way, value, 6.0 * (x - square)]
        }
    }

    fn motion(&self, at_s: f64) -> Motion {
        let lasts = 1.5 * self.velocity / self.acceleration;
        let end = self.rest_s.max(self.begin_s + lasts);
        let [up, down] = [self.begin_s, end].map(|begin| Self::ramp((at_s - begin) / lasts));
        Motion {
            position: (up[0] - down[0]) * self.velocity * lasts,
            velocity: (up[1] - down[1]) * self.velocity,
            acceleration: (up[2] - down[2]) * self.velocity / lasts,
        }
    }
}

/// Writes the newest point of the master before each frame.
struct Fed {
    bus: SimLink,
    feed: Feed,
    random: Random,
    cell: Arc<SetpointCell>,
    start: u64,
    next_s: f64,
}

impl fmt::Debug for Fed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Fed")
    }
}

impl Link for Fed {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let now = clock::now();
        let now_s = (now - self.start) as f64 * 1e-9;
        while self.next_s <= now_s {
            self.next_s += INTERVAL_S;
            let ended = self.feed.end_s.is_some_and(|end| now_s >= end);
            if ended || self.random.chance(self.feed.loss) {
                continue;
            }
            let Some(offset) = clock::common_offset() else {
                continue;
            };
            let at_s = now_s + AHEAD_S;
            let at_ns = (now + (AHEAD_S * 1e9) as u64).wrapping_add_signed(offset);
            self.cell.write(Some(LineShaftPoint {
                stream: 1,
                at_ns,
                motion: self.feed.motion(at_s),
            }));
        }
        self.bus.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.bus.recv(buf)
    }

    fn next_arrival(&self) -> Option<clock::Nanos> {
        self.bus.next_arrival()
    }
}

#[derive(Debug, Default)]
struct Messages(String);

impl Observer for Messages {
    fn progress(&mut self, progress: &Progress) {
        if let Progress::Warning(text) = progress {
            self.0 += text;
            self.0.push('\n');
        }
    }
}

/// Runs the plan in a thread with virtual time. Returns the exit code, the result as the program
/// writes it, and the messages.
pub fn run(plan: &Plan, feed: Feed, folder: &Path) -> (i32, Value, String) {
    std::thread::scope(|scope| {
        let run = scope.spawn(|| {
            Clock::Virtual.enter();
            run_in_virtual_time(plan, feed, folder)
        });
        run.join().expect("no panic")
    })
}

fn run_in_virtual_time(plan: &Plan, feed: Feed, folder: &Path) -> (i32, Value, String) {
    let machine = config::load(&folder.join("machine.toml"));
    let machine = match machine {
        Ok(machine) => machine,
        Err(error) => return (2, Value::Null, error.to_string()),
    };
    let faults = FaultScript::parse(&plan.fault_script).expect("a fault script");
    let options = Options {
        clock: Clock::Virtual,
        seed: plan.seed,
        limit: Some((plan.ends_at * 1e9) as u64),
        faults: Some(faults),
        record: Some(folder.join("run.pcapng")),
        ..Options::default()
    };
    let cell = Arc::new(SetpointCell::new(0));
    let bus = simulated_bus(&machine, plan.seed, options.faults.as_ref(), None).expect("a bus");
    let comment = recording_comment(&machine);
    let fed = Fed {
        bus: SimLink::new(bus),
        feed,
        random: Random::new(plan.seed),
        cell: Arc::clone(&cell),
        // The thread of the link begins at the same time.
        start: clock::now(),
        next_s: 0.0,
    };
    let link = recorded(Box::new(fed), &options, &comment).expect("a recording");
    let attachments = Attachments {
        link: Some(link),
        setpoints: SetpointCells {
            line_shafts: [cell].into(),
            ..SetpointCells::default()
        },
        ..Attachments::default()
    };
    let mut heard = Messages::default();
    let outcome = session::run_attached(
        machine,
        Options {
            record: None,
            ..options
        },
        Arc::<CancelToken>::default(),
        &mut heard,
        attachments,
    );
    let error = outcome.result.err().map(|error| error.to_string());
    let result = json!({
        "ok": error.is_none(),
        "error": error,
        "summary": outcome.summary,
        "fault_report": outcome.fault_report,
    });
    (i32::from(error.is_some()), result, heard.0)
}
