//! How many bad cycles the machine rides through, and what stops it.

use super::exchange::Answer;

/// AL status that every SubDevice must show while the machine runs.
const OP: u8 = 0x08;
/// Cycles that AL status may differ before the machine stops: one lost broadcast is not a fault.
const AL_CYCLES: u32 = 2;

/// Why the machine stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StopCause {
    /// Asked to.
    Requested,
    /// The drive of this axis reported a fault.
    DriveFault { axis: usize },
    /// This axis stopped itself.
    Trip {
        axis: usize,
        trip: ecaxis_axis::Trip,
    },
    /// So many cycles in a row without a valid answer.
    BusLost {
        cycles: u32,
        last_wkc: (u16, u16),
        answered: bool,
    },
    /// A condition of the machine file for it holds.
    EmergencyStop,
    /// This axis can no longer follow what it was geared to, or led along.
    FollowLost { axis: usize },
    /// The user's controller panicked.
    Controller,
    /// At least one SubDevice is no longer in Op.
    LeftOp { al_status: u8 },
}

impl StopCause {
    /// A graver one stops a machine anew that is already stopping: by a shorter way.
    #[must_use]
    pub fn severity(&self) -> u8 {
        match self {
            Self::Requested | Self::Controller => 1,
            Self::DriveFault { .. } | Self::Trip { .. } | Self::FollowLost { .. } => 2,
            Self::BusLost { .. } | Self::LeftOp { .. } => 3,
            Self::EmergencyStop => 4,
        }
    }
}

/// Counts bad cycles in a row.
#[derive(Debug, Clone)]
pub struct Guard {
    lost_frames: u32,
    devices: u16,
    bad: u32,
    al: u32,
}

impl Guard {
    /// `lost_frames` bad cycles in a row stop the machine; `devices` SubDevices must answer.
    #[must_use]
    pub fn new(lost_frames: u32, devices: u16) -> Self {
        Self {
            lost_frames: lost_frames.max(1),
            devices,
            bad: 0,
            al: 0,
        }
    }

    /// Looks at one cycle. RT.
    pub fn check(&mut self, answer: &Answer) -> Option<StopCause> {
        self.bad = if answer.inputs_fresh && answer.complete {
            0
        } else {
            self.bad + 1
        };
        if self.bad >= self.lost_frames {
            return Some(StopCause::BusLost {
                cycles: self.bad,
                last_wkc: answer.wkc,
                answered: answer.complete,
            });
        }
        match answer.al_status {
            Some((status, wkc)) if status != OP || wkc != self.devices => {
                self.al += 1;
                (self.al >= AL_CYCLES).then_some(StopCause::LeftOp { al_status: status })
            }
            Some(_) => {
                self.al = 0;
                None
            }
            None => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: Answer = Answer {
        complete: true,
        inputs_fresh: true,
        wkc: (3, 3),
        system_time: None,
        al_status: Some((OP, 2)),
    };
    const LOST: Answer = Answer {
        complete: false,
        inputs_fresh: false,
        wkc: (0, 3),
        system_time: None,
        al_status: None,
    };

    #[test]
    fn rides_through_fewer_bad_cycles_than_the_limit() {
        let mut guard = Guard::new(3, 2);
        for _ in 0..10 {
            assert_eq!(guard.check(&LOST), None);
            assert_eq!(guard.check(&LOST), None);
            assert_eq!(guard.check(&GOOD), None);
        }
        guard.check(&LOST);
        guard.check(&LOST);
        assert!(matches!(
            guard.check(&LOST),
            Some(StopCause::BusLost { cycles: 3, .. })
        ));
    }

    #[test]
    fn a_device_that_leaves_op_stops_the_machine() {
        let mut guard = Guard::new(3, 2);
        let left = Answer {
            al_status: Some((0x1c, 2)),
            ..GOOD
        };
        assert_eq!(guard.check(&left), None);
        assert_eq!(
            guard.check(&left),
            Some(StopCause::LeftOp { al_status: 0x1c })
        );
        let mut guard = Guard::new(3, 2);
        let gone = Answer {
            al_status: Some((OP, 1)),
            ..GOOD
        };
        guard.check(&gone);
        assert_eq!(
            guard.check(&gone),
            Some(StopCause::LeftOp { al_status: OP })
        );
    }
}
