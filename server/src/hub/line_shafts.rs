//! Set-points of axes for other machines, and those of other machines for line shafts.

use std::hash::{BuildHasher as _, Hasher as _, RandomState};

use ecaxis_axis::setpoint::{LineShaftPoint, Motion};
use ecaxis_ecat::index::LineShaftIndex;
use ecaxis_master::rt::setpoint_cell::{SetpointCell, SetpointCells};

use super::*;
use crate::command::SetpointPoint;

/// The points of one message.
const MAX_POINTS: usize = 64;
/// The attempts to read common time.
const READINGS: usize = 20;
/// The hex digits of a stream.
const STREAM_DIGITS: usize = 16;

/// The connection that feeds a line shaft.
#[derive(Debug)]
struct Feeder {
    client: ClientId,
    /// The newest point: its stream and instant.
    stream: u64,
    newest_ns: u64,
}

/// The cells of the cycle, and who writes those of the line shafts.
#[derive(Debug)]
pub(super) struct Setpoints {
    pub cells: SetpointCells,
    feeders: Mutex<Vec<Option<Feeder>>>,
}

impl Setpoints {
    pub fn new(machine: &Machine) -> Self {
        // Streams of one server differ from those of another, and of an earlier one.
        let cell = || {
            Arc::new(SetpointCell::new(
                RandomState::new().build_hasher().finish(),
            ))
        };
        let shafts = machine.line_shafts.len();
        Self {
            cells: SetpointCells {
                axes: (0..machine.axes.len()).map(|_| cell()).collect(),
                line_shafts: (0..shafts).map(|_| cell()).collect(),
            },
            feeders: Mutex::new((0..shafts).map(|_| None).collect()),
        }
    }

    fn feeders(&self) -> MutexGuard<'_, Vec<Option<Feeder>>> {
        self.feeders.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Nothing feeds the shafts of a client any more.
    pub fn disconnect(&self, client: ClientId) {
        let mut feeders = self.feeders();
        for (feeder, cell) in feeders.iter_mut().zip(&self.cells.line_shafts) {
            if feeder
                .as_ref()
                .is_some_and(|feeder| feeder.client == client)
            {
                cell.write(None);
                *feeder = None;
            }
        }
    }
}

/// Returns the text of a stream.
#[must_use]
pub fn stream_text(stream: u64) -> String {
    format!("{stream:016x}")
}

fn stream_number(text: &str) -> Result<u64, OpError> {
    let hex = text.len() == STREAM_DIGITS && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    let number = hex.then(|| u64::from_str_radix(text, 16).ok()).flatten();
    number.ok_or_else(|| {
        let message = format!("`stream` is not a text of {STREAM_DIGITS} hex digits");
        OpError::new(ErrorCode::BadRequest, message).help("pass the one of the event `setpoints`")
    })
}

impl Hub {
    /// Returns the cells for a run.
    #[must_use]
    pub fn setpoints(&self) -> SetpointCells {
        self.setpoints.cells.clone()
    }

    /// Returns the newest set-point of an axis for other machines.
    #[must_use]
    pub fn setpoint(&self, axis: AxisIndex) -> Option<LineShaftPoint> {
        let mut point = None;
        self.setpoints.cells.axes.get(axis.0)?.read(&mut point);
        point
    }

    /// Returns the client that feeds a line shaft.
    #[must_use]
    pub fn feeder(&self, shaft: LineShaftIndex) -> Option<ClientId> {
        let feeders = self.setpoints.feeders();
        Some(feeders.get(shaft.0)?.as_ref()?.client)
    }

    /// Returns common time on the clock of the run.
    fn common_now(&self) -> Option<u64> {
        let offset = match self.options.virtual_time {
            true => Some(self.latest()?.snapshot.common_time.host_offset_ns),
            // An interruption between two readings is ordinary here.
            false => (0..READINGS).find_map(|_| clock::common_offset()),
        };
        Some(self.now().wrapping_add_signed(offset?))
    }

    /// Passes points of a client to a line shaft. Returns the number of points that were accepted:
    /// those that are not newer than the newest one are dropped.
    ///
    /// # Errors
    /// Fails if another connection feeds the shaft and its points are not too old, or with the first
    /// point that is rejected.
    pub fn feed_line_shaft(
        &self,
        client: ClientId,
        name: &str,
        stream: &str,
        points: &[SetpointPoint],
    ) -> Result<usize, OpError> {
        let mut shafts = self.machine.line_shafts.enumerate();
        let shaft = shafts.find(|(_, setup)| setup.name == name);
        let Some((index, setup)) = shaft else {
            let message = format!("no line shaft is called `{name}`");
            return Err(OpError::new(ErrorCode::UnknownName, message)
                .help("add a [[line_shaft]] with this name to the machine file"));
        };
        let stream = stream_number(stream)?;
        if points.len() > MAX_POINTS {
            let message = format!("a message has at most {MAX_POINTS} points");
            return Err(OpError::new(ErrorCode::BadRequest, message).help("send the newest ones"));
        }
        let Some(now_ns) = self.common_now() else {
            let message = "common time could not be read";
            return Err(OpError::new(ErrorCode::Refused, message).help("send the next point"));
        };
        let mut feeders = self.setpoints.feeders();
        let cell = self.setpoints.cells.line_shafts.get(index.0);
        let (Some(feeder), Some(cell)) = (feeders.get_mut(index.0), cell) else {
            return Ok(0);
        };
        // Neither a connection whose points are too old nor instants of a clock that was set since
        // then prevent new ones.
        let timeout_ns = (setup.config.timeout_s * 1e9) as u64;
        let recent = |known: &Feeder| known.newest_ns.abs_diff(now_ns) <= timeout_ns;
        let known = feeder.as_ref().filter(|known| recent(known));
        if known.is_some_and(|known| known.client != client) {
            let message = format!("another connection feeds `{name}`");
            return Err(OpError::new(ErrorCode::Refused, message)
                .help("close that connection first; `line_shafts` in the state names its client"));
        }
        let mut newest_ns = known
            .filter(|known| known.stream == stream)
            .map(|known| known.newest_ns);
        let mut accepted = 0;
        let mut newest = None;
        let mut rejected = None;
        for (number, point) in points.iter().enumerate() {
            if newest_ns.is_some_and(|newest| point.unix_ns <= newest) {
                continue;
            }
            let point = LineShaftPoint {
                stream,
                at_ns: point.unix_ns,
                motion: Motion {
                    position: point.position,
                    velocity: point.velocity,
                    acceleration: point.acceleration,
                },
            };
            if let Err(error) = setup.config.check(&point, now_ns) {
                let message = format!("point {}: {error}", number + 1);
                rejected = Some(OpError::new(ErrorCode::Refused, message));
                break;
            }
            newest_ns = Some(point.at_ns);
            newest = Some(point);
            accepted += 1;
        }
        if let Some(point) = newest {
            cell.write(Some(point));
            *feeder = Some(Feeder {
                client,
                stream,
                newest_ns: point.at_ns,
            });
        }
        match rejected {
            Some(error) => Err(error
                .with("accepted", accepted)
                .help("the limits are those of the [[line_shaft]]; both clocks must agree")),
            None => Ok(accepted),
        }
    }
}
