//! LATCH0 and LATCH1: the system time of input edges (Beckhoff ESC data sheet, section II, 2.15.5).

/// The edges of one input. Bit 0 is the positive edge, bit 1 the negative one.
#[derive(Debug, Clone, Copy, Default)]
pub struct Latch {
    /// 0x09A8. A set bit selects single event mode, otherwise continuous mode.
    pub control: u8,
    /// Unread edges in single event mode.
    events: u8,
    level: bool,
    /// The system times of the positive and the negative edge.
    times: [u64; 2],
}

/// Bit 2 of the status: the level of the input.
const LEVEL: u8 = 0x04;

impl Latch {
    /// Sets the level of the input at this system time. Returns true for an edge that is recorded.
    pub fn input(&mut self, level: bool, system: u64) -> bool {
        if std::mem::replace(&mut self.level, level) == level {
            return false;
        }
        let edge = usize::from(!level);
        let bit = 1 << edge;
        let single = self.control & bit != 0;
        if single && self.events & bit != 0 {
            return false;
        }
        if single {
            self.events |= bit;
        }
        if let Some(time) = self.times.get_mut(edge) {
            *time = system;
        }
        single
    }

    /// Returns the status register 0x09AE.
    #[must_use]
    pub fn status(&self) -> u8 {
        self.events | if self.level { LEVEL } else { 0 }
    }

    #[must_use]
    pub fn time(&self, edge: usize) -> u64 {
        self.times.get(edge).copied().unwrap_or(0)
    }

    /// Enables the next event of an edge after its time was read by the side that controls the
    /// unit.
    pub fn acknowledge(&mut self, edge: usize) {
        self.events &= !(1 << edge.min(1));
    }

    /// True while unread edges exist.
    #[must_use]
    pub fn pending(&self) -> bool {
        self.events != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latch_in_continuous_mode_keeps_the_last_edge_without_events() {
        let mut latch = Latch::default();
        for (level, at) in [(true, 10), (true, 11), (false, 20), (true, 30)] {
            assert!(!latch.input(level, at));
        }
        assert_eq!((latch.time(0), latch.time(1)), (30, 20));
        assert_eq!(latch.status(), LEVEL);
    }

    #[test]
    fn latch_in_single_event_mode_keeps_the_edge_until_read() {
        let mut latch = Latch {
            control: 0b01,
            ..Latch::default()
        };
        assert!(latch.input(true, 10));
        assert!(!latch.input(false, 20), "continuous at this edge");
        assert!(!latch.input(true, 30));
        assert_eq!((latch.time(0), latch.time(1)), (10, 20));
        assert_eq!(latch.status(), LEVEL | 1);
        latch.acknowledge(0);
        latch.input(false, 40);
        assert!(latch.input(true, 50));
        assert_eq!(latch.time(0), 50);
    }
}
