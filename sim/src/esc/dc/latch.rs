//! LATCH0 and LATCH1: system time of the edges of an input (Beckhoff ESC data sheet, section II, 2.15.5).

/// Edges of one input; bit 0 stands for the positive one, bit 1 for the negative one.
#[derive(Debug, Clone, Copy, Default)]
pub struct Latch {
    /// 0x09A8: bit set: single event, else continuous.
    pub control: u8,
    /// Edges seen in single event mode and not read since.
    events: u8,
    level: bool,
    /// System time of the positive and the negative edge.
    times: [u64; 2],
}

/// Bit 2 of the status: the input's level.
const LEVEL: u8 = 0x04;

impl Latch {
    /// The input has this level at this system time. True if that was an edge which counts.
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

    /// 0x09AE.
    #[must_use]
    pub fn status(&self) -> u8 {
        self.events | if self.level { LEVEL } else { 0 }
    }

    #[must_use]
    pub fn time(&self, edge: usize) -> u64 {
        self.times.get(edge).copied().unwrap_or(0)
    }

    /// Whoever controls the unit has read an edge's time: the next one may come.
    pub fn acknowledge(&mut self, edge: usize) {
        self.events &= !(1 << edge.min(1));
    }

    /// Edges wait to be read.
    #[must_use]
    pub fn pending(&self) -> bool {
        self.events != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn continuous_keeps_the_last_edge_and_has_no_events() {
        let mut latch = Latch::default();
        for (level, at) in [(true, 10), (true, 11), (false, 20), (true, 30)] {
            assert!(!latch.input(level, at));
        }
        assert_eq!((latch.time(0), latch.time(1)), (30, 20));
        assert_eq!(latch.status(), LEVEL);
    }

    #[test]
    fn a_single_event_waits_to_be_read() {
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
