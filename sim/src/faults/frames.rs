//! What becomes of single frames.

use super::script::{FaultKind, Hits};
use super::{Faults, Phase, Running};
use crate::Nanos;
use crate::esc::al::AlState;
use crate::random::Random;

/// What happens to one frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Fate {
    pub(crate) lost_on_the_way_out: bool,
    pub(crate) lost_on_the_way_back: bool,
    pub(crate) corrupted: Option<Corrupted>,
    /// Arrives at the MainDevice twice.
    pub(crate) twice: bool,
    /// Comes back so much later.
    pub(crate) delay: Nanos,
    /// Another MainDevice's frame follows it; the state that it sends everybody to.
    pub(crate) other: Option<Option<AlState>>,
}

/// Where a bit turns over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Corrupted {
    /// In front of the port.
    At { device: usize, port: u8 },
    /// Anywhere, drawn by lot.
    Somewhere(u64),
}

impl FaultKind {
    pub(super) fn hits(&self) -> Option<Hits> {
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

impl Running {
    /// Whether it strikes the frame that is sent now.
    fn strikes(&mut self, random: &mut Random) -> bool {
        match self.fault.kind.hits() {
            Some(Hits::Next(_)) => {
                let left = self.left > 0;
                self.left = self.left.saturating_sub(1);
                left
            }
            Some(Hits::Each(probability)) => random.chance(probability),
            None => false,
        }
    }
}

impl Faults {
    /// Decides about the frame that is sent now.
    pub(crate) fn fate(&mut self) -> Fate {
        let mut fate = Fate::default();
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
                        Some((device, port)) => Corrupted::At { device, port },
                        None => Corrupted::Somewhere(random.next()),
                    });
                }
                _ => {}
            }
        }
        fate
    }
}
