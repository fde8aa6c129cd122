//! The effects of faults on single frames.

use super::script::{FaultKind, FrameSelection};
use super::{ActiveFault, Faults, Phase};
use crate::Nanos;
use crate::esc::al::AlState;
use crate::random::Random;

/// The effects on one frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct FrameFault {
    pub(crate) lost_on_the_way_out: bool,
    pub(crate) lost_on_the_way_back: bool,
    pub(crate) corrupted: Option<BitFlip>,
    /// The frame arrives at the MainDevice twice.
    pub(crate) twice: bool,
    /// The additional delay of the returning frame in ns.
    pub(crate) delay: Nanos,
    /// `Some`: a frame of another MainDevice follows. The inner value is the state that it requests
    /// from all devices.
    pub(crate) other: Option<Option<AlState>>,
}

/// The location of a bit error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BitFlip {
    /// In front of this port.
    At { device: usize, port: u8 },
    /// At a random location, selected by this number.
    Somewhere(u64),
}

impl FaultKind {
    pub(super) fn hits(&self) -> Option<FrameSelection> {
        match self {
            Self::FrameLoss { hits }
            | Self::FrameDuplicate { hits }
            | Self::FrameDelay { hits, .. }
            | Self::OtherMainDevice { hits, .. }
            | Self::FrameCorrupt { hits, .. } => Some(*hits),
            _ => None,
        }
    }
}

impl ActiveFault {
    /// True if the fault affects the frame that is sent now.
    fn strikes(&mut self, random: &mut Random) -> bool {
        match self.fault.kind.hits() {
            Some(FrameSelection::Next(_)) => {
                let left = self.left > 0;
                self.left = self.left.saturating_sub(1);
                left
            }
            Some(FrameSelection::Each(probability)) => random.chance(probability),
            None => false,
        }
    }
}

impl Faults {
    /// Determines the effects on the frame that is sent now.
    pub(crate) fn fate(&mut self) -> FrameFault {
        let mut fate = FrameFault::default();
        if !self.concerns_frames {
            return fate;
        }
        let Self {
            running, random, ..
        } = self;
        for fault in running.iter_mut().filter(|r| r.phase == Phase::Active) {
            if !fault.strikes(random) {
                continue;
            }
            fault.struck += 1;
            match fault.fault.kind {
                FaultKind::FrameLoss { .. } => {
                    let out = random.next() & 1 == 0;
                    fate.lost_on_the_way_out |= out;
                    fate.lost_on_the_way_back |= !out;
                }
                FaultKind::FrameDuplicate { .. } => fate.twice = true,
                FaultKind::FrameDelay { delay, .. } => {
                    fate.delay = fate.delay.saturating_add(delay);
                }
                FaultKind::OtherMainDevice { state, .. } => fate.other = Some(state),
                FaultKind::FrameCorrupt { at, .. } => {
                    fate.corrupted = Some(match at {
                        Some((device, port)) => BitFlip::At { device, port },
                        None => BitFlip::Somewhere(random.next()),
                    });
                }
                _ => {}
            }
        }
        fate
    }
}
