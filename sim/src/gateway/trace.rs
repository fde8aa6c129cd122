//! All frames of a secondary network.

use std::fmt::Write as _;
use std::sync::{Arc, Mutex, PoisonError};

use super::CanFrame;
use crate::Nanos;

/// Collects the frames of a network, with the true time of their end. Clones share their frames.
#[derive(Debug, Clone, Default)]
pub struct CanTrace(Arc<Mutex<Vec<(Nanos, CanFrame)>>>);

impl CanTrace {
    pub(super) fn push(&self, at: Nanos, frame: CanFrame) {
        let mut frames = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        frames.push((at, frame));
    }

    /// Returns the frames so far, oldest first, and forgets them.
    #[must_use]
    pub fn take(&self) -> Vec<(Nanos, CanFrame)> {
        let mut frames = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::take(&mut *frames)
    }

    /// Returns the frames as the log of `candump -L`, and forgets them.
    #[must_use]
    pub fn take_candump(&self, interface: &str) -> String {
        let mut out = String::new();
        for (at, frame) in self.take() {
            let (s, us) = (at / 1_000_000_000, at / 1000 % 1_000_000);
            let _ = write!(out, "({s}.{us:06}) {interface} {:03X}#", frame.id);
            if frame.remote {
                out.push('R');
            }
            for byte in frame.data() {
                let _ = write!(out, "{byte:02X}");
            }
            out.push('\n');
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_written_as_candump_does() {
        let trace = CanTrace::default();
        trace.push(1_002_003_999, CanFrame::new(0x201, &[0x0f, 0xa0]));
        trace.push(2_000_000_000, CanFrame::request(0x705));
        let text = "(1.002003) can0 201#0FA0\n(2.000000) can0 705#R\n";
        assert_eq!(trace.clone().take_candump("can0"), text);
        assert_eq!(trace.take(), []);
    }
}
