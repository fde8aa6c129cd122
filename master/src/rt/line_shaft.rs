//! Line shafts in the cycle, and the set-points of the axes for those of other machines.

use std::sync::Arc;

use ecaxis_axis::setpoint::{LineShaft, LineShaftEnd, LineShaftPoint, LineShaftState, Motion};
use ecaxis_axis::{AxisStatus, HomingStatus, Mode};
use ecaxis_ecat::index::{IndexVec, LineShaftIndex};

use super::setpoint_cell::{SetpointCell, SetpointCells};

/// A line shaft and the points that arrive for it.
#[derive(Debug)]
pub(super) struct RtLineShaft {
    pub shaft: LineShaft,
    cell: Option<Arc<SetpointCell>>,
    arrived: Option<LineShaftPoint>,
}

impl RtLineShaft {
    pub fn new(shaft: LineShaft, cell: Option<Arc<SetpointCell>>) -> Self {
        Self {
            shaft,
            cell,
            arrived: None,
        }
    }

    /// `followed`: an axis is in gear with the shaft. RT: O(1).
    pub fn advance(&mut self, now_ns: Option<u64>, followed: bool, dt_s: f64) {
        if let Some(cell) = &self.cell {
            cell.read(&mut self.arrived);
        }
        // A follower behind a gateway takes a set-point in some of the cycles only. It must see the
        // end of the stream before another one begins.
        if !followed || self.shaft.state() != LineShaftState::Waiting {
            self.shaft.advance(now_ns, self.arrived, dt_s);
        }
    }
}

/// What other threads see of a line shaft.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LineShaftStatus {
    pub state: LineShaftState,
    /// The last motion.
    pub motion: Motion,
    /// The newest point.
    pub newest: LineShaftPoint,
    /// The age of the newest point in this cycle; `None` unless the shaft runs.
    pub age_ns: Option<i64>,
    /// The difference from the prediction.
    pub error: f64,
    /// Why the shaft does not run.
    pub end: LineShaftEnd,
}

impl LineShaftStatus {
    pub(super) fn new(shaft: &LineShaft, now_ns: Option<u64>) -> Self {
        let newest = shaft.newest();
        let runs = shaft.state() == LineShaftState::Running;
        let age = now_ns.map(|now| now.wrapping_sub(newest.at_ns).cast_signed());
        Self {
            state: shaft.state(),
            motion: shaft.last_motion(),
            newest,
            age_ns: age.filter(|_| runs),
            error: shaft.error(),
            end: shaft.end(),
        }
    }
}

/// The set-points of an axis for other machines.
#[derive(Debug)]
pub(super) struct AxisSetpoints {
    cell: Arc<SetpointCell>,
    /// The stream of the last cycle's point.
    stream: Option<u64>,
    last: f64,
}

impl AxisSetpoints {
    pub fn new(cell: Arc<SetpointCell>) -> Self {
        Self {
            cell,
            stream: None,
            last: 0.0,
        }
    }

    /// Publishes the set-point that takes effect at `at_ns`; `None`: there is none for other
    /// machines. `velocity` is the velocity limit of the axis. RT: O(1).
    pub fn publish(&mut self, at_ns: Option<u64>, axis: &AxisStatus, velocity: f64, dt_s: f64) {
        let homes = axis.homing == HomingStatus::Running;
        // In other modes the set-points are those of the drive.
        let cyclic = matches!(axis.mode, Mode::Csp | Mode::Csv);
        let Some(at_ns) = at_ns.filter(|_| axis.enabled && cyclic && !homes) else {
            if self.stream.take().is_some() {
                self.cell.write(None);
            }
            return;
        };
        let jumped = (axis.target_position - self.last).abs() > 2.0 * velocity * dt_s;
        let stream = self.stream.filter(|_| !jumped);
        let stream = stream.unwrap_or_else(|| self.cell.stream().wrapping_add(1));
        (self.stream, self.last) = (Some(stream), axis.target_position);
        let (velocity, acceleration) =
            end_of_cycle(axis.target_velocity, axis.target_acceleration, dt_s);
        let motion = Motion {
            position: axis.target_position,
            velocity,
            acceleration,
        };
        self.cell.write(Some(LineShaftPoint {
            stream,
            at_ns,
            motion,
        }));
    }
}

/// Returns velocity and acceleration at the end of a cycle from its mean velocity. In the cycle in
/// which an axis comes to rest, both are 0: its deceleration does not go on.
fn end_of_cycle(mean: f64, acceleration: f64, dt_s: f64) -> (f64, f64) {
    let end = mean + acceleration * dt_s / 2.0;
    let none = mean.abs() <= acceleration.abs() * dt_s * 1e-6;
    match none || end * mean <= 0.0 {
        true => (0.0, 0.0),
        false => (end, acceleration),
    }
}

/// Returns the line shafts with their cells. `slowest_s` is the longest time between two set-points
/// of an axis. Runs before the loop.
#[allow(clippy::disallowed_methods, reason = "runs before the loop")]
pub(super) fn shafts(
    shafts: &[LineShaft],
    cells: &SetpointCells,
    slowest_s: f64,
) -> IndexVec<LineShaftIndex, RtLineShaft> {
    let cells = cells.line_shafts.iter().cloned().map(Some);
    let cells = cells.chain(std::iter::repeat(None));
    let each = shafts.iter().zip(cells);
    each.map(|(shaft, cell)| RtLineShaft::new(shaft.with_slowest_follower(slowest_s), cell))
        .collect()
}

/// Returns the set-points of the axes for other machines. Runs before the loop.
#[allow(clippy::disallowed_methods, reason = "runs before the loop")]
pub(super) fn axis_setpoints(cells: &SetpointCells) -> Box<[AxisSetpoints]> {
    cells.axes.iter().cloned().map(AxisSetpoints::new).collect()
}

#[cfg(test)]
mod tests {
    use ecaxis_axis::setpoint::LineShaftConfig;

    use super::*;

    const MS: u64 = 1_000_000;

    /// Whatever cycle is the last one of a stop, its point is not predicted to move backwards.
    #[test]
    fn the_last_point_of_a_stop_does_not_reverse() {
        let dt_s = 1e-3;
        for acceleration in [100.0, 77.7] {
            for start in [8.0, -8.0, 0.05] {
                let mut velocity: f64 = start;
                while velocity != 0.0 {
                    // As an axis decelerates: the last step ends exactly at rest.
                    let next = match velocity.abs() > acceleration * dt_s {
                        true => velocity - acceleration.copysign(velocity) * dt_s,
                        false => 0.0,
                    };
                    let (v, a) = end_of_cycle(next, (next - velocity) / dt_s, dt_s);
                    assert!(v * start >= 0.0 && a * start <= 0.0, "{v} {a}");
                    assert!(v != 0.0 || a == 0.0, "{v} {a}");
                    velocity = next;
                }
            }
        }
        assert_eq!(end_of_cycle(8.0, -100.0, dt_s), (8.0 - 0.05, -100.0));
        assert_eq!(end_of_cycle(0.05, 100.0, dt_s), (0.05 + 0.05, 100.0));
    }

    /// A follower that takes a set-point in some of the cycles only sees the end of a stream, even
    /// if the next one is already there.
    #[test]
    fn another_stream_begins_once_no_axis_follows() {
        let config = LineShaftConfig {
            velocity: 10.0,
            acceleration: 100.0,
            timeout_s: 0.05,
            smoothing_s: 0.01,
            max_error: 1.0,
        };
        let cell = Arc::new(SetpointCell::new(0));
        let shaft = LineShaft::new(config).expect("usable");
        let mut shaft = RtLineShaft::new(shaft, Some(Arc::clone(&cell)));
        let mut now = 1_000_000 * MS;
        let mut cycle = |shaft: &mut RtLineShaft, stream, followed| {
            now += MS;
            let motion = Motion {
                position: stream as f64,
                ..Motion::default()
            };
            cell.write(Some(LineShaftPoint {
                stream,
                at_ns: now,
                motion,
            }));
            shaft.advance(Some(now), followed, 0.001);
            shaft.shaft.state()
        };
        assert_eq!(cycle(&mut shaft, 1, false), LineShaftState::Running);
        assert_eq!(cycle(&mut shaft, 1, true), LineShaftState::Running);
        assert_eq!(cycle(&mut shaft, 2, true), LineShaftState::Stopping);
        let states: Vec<_> = (0..100).map(|_| cycle(&mut shaft, 2, true)).collect();
        assert!(!states.contains(&LineShaftState::Running), "{states:?}");
        assert_eq!(shaft.shaft.motion(), Err(LineShaftEnd::StreamChanged));
        assert_eq!(cycle(&mut shaft, 2, false), LineShaftState::Running);
        assert_eq!(shaft.shaft.last_motion().position, 2.0);
    }
}
