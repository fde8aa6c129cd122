//! SYNC0 and SYNC1 (Beckhoff ESC data sheet, section I, 9.2.3; section II, 2.15.3 and 2.15.4).

use super::Width;

/// Bits of the activation register 0x0981.
pub mod activation {
    /// The cyclic unit runs.
    pub const UNIT: u8 = 0x01;
    pub const SYNC0: u8 = 0x02;
    pub const SYNC1: u8 = 0x04;
    /// Writing the start time sets [`UNIT`].
    pub const AUTO: u8 = 0x08;
    /// A start time of 32 bits is extended to 64.
    pub const EXTEND: u8 = 0x10;
    /// A start time outside the near future starts the unit at once.
    pub const PLAUSIBILITY: u8 = 0x20;
    /// The near future is 2^31 ns, instead of half the range of the clock.
    pub const NEAR: u8 = 0x40;
    /// One pulse now, for debugging.
    pub const PING: u8 = 0x80;
}

/// The minimum pulse interval of an application. Faster pulses are counted and not served.
const DENSEST_NS: u64 = 10_000;
/// The minimum cycle time of a running cyclic unit.
const SHORTEST_CYCLE_NS: u32 = 60;

/// The time base of SYNC0 and SYNC1.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Base {
    #[default]
    Off,
    /// The unit runs; `next` is the system time of the next pulse.
    Running { next: u64 },
    /// A single shot has fired.
    Done,
}

/// The outputs with a rising edge.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Edges {
    pub sync0: bool,
    pub sync1: bool,
}

#[derive(Debug, Clone, Default)]
pub struct SyncUnit {
    width: Width,
    /// The activation register 0x0981.
    activation: u8,
    /// The activation status 0x0984.
    status: u8,
    /// The start time 0x0990 as written.
    start: u64,
    pub cycle0: u32,
    pub cycle1: u32,
    /// The pulse length 0x0982 in units of 10 ns; 0: acknowledge mode.
    pub pulse_length: u16,
    base: Base,
    /// Local times of the next pulses; `u64::MAX`: never.
    due0: u64,
    due1: u64,
    /// System time of the pending SYNC1 pulse.
    next1: Option<u64>,
    /// Pulses without acknowledgement in acknowledge mode. Bit 0: SYNC0, bit 1: SYNC1.
    unacknowledged: u8,
    /// SYNC0 pulses since activation.
    pub pulses: u64,
    /// The delay of the first pulse against the start time in ns, for fault injection.
    pub(crate) late: u64,
}

impl SyncUnit {
    #[must_use]
    pub fn new(width: Width, pulse_length: u16) -> Self {
        Self {
            width,
            pulse_length,
            due0: u64::MAX,
            due1: u64::MAX,
            ..Self::default()
        }
    }

    #[must_use]
    pub fn activation(&self) -> u8 {
        self.activation
    }

    /// True if SYNC0 is switched on, even if it never fires.
    #[must_use]
    pub fn sync0_on(&self) -> bool {
        let on = activation::UNIT | activation::SYNC0;
        self.activation & on == on
    }

    /// Returns the activation status 0x0984.
    #[must_use]
    pub fn status(&self) -> u8 {
        self.status
    }

    /// Returns 0x098E (0) or 0x098F (1): true if a pulse waits for its acknowledgement.
    #[must_use]
    pub fn waits(&self, n: u8) -> bool {
        self.unacknowledged >> n & 1 != 0
    }

    /// Acknowledges a pulse after the application read 0x098E (0) or 0x098F (1).
    pub fn acknowledge(&mut self, n: u8) {
        self.unacknowledged &= !(1 << n);
    }

    /// Returns 0x0990: the next SYNC0 pulse, or the start time if the unit does not run.
    #[must_use]
    pub fn next_sync0(&self) -> u64 {
        match self.base {
            Base::Running { next } => next,
            Base::Off | Base::Done => self.start,
        }
    }

    /// Returns 0x0998: the next SYNC1 pulse.
    #[must_use]
    pub fn next_sync1(&self) -> u64 {
        match (self.next1, self.base) {
            (Some(next), _) => next,
            (None, Base::Running { next }) => {
                self.width.cut(next.wrapping_add(u64::from(self.cycle1)))
            }
            (None, _) => 0,
        }
    }

    /// Returns the local time of the next pulse; `u64::MAX` if there is none.
    #[must_use]
    pub fn due(&self) -> u64 {
        self.due0.min(self.due1)
    }

    /// Handles a write to 0x0990. `complete`: the last byte was written. `low`: the last byte of
    /// the lower half was written.
    pub fn write_start(&mut self, start: u64, low: bool, complete: bool, local: u64, system: u64) {
        self.start = self.width.cut(start);
        let extends = self.activation & activation::EXTEND != 0 && self.width == Width::Bits64;
        if extends && low && !complete {
            let base = system & !0xffff_ffff | start & 0xffff_ffff;
            self.start = if base < system {
                base.wrapping_add(1 << 32)
            } else {
                base
            };
        }
        let all = if extends || self.width == Width::Bits32 {
            low
        } else {
            complete
        };
        if self.activation & activation::AUTO != 0 && all {
            self.activate(self.activation | activation::UNIT, local, system);
        }
    }

    /// Handles a write to 0x0981. The bits above the first three exist only if `enhanced`.
    pub fn write_activation(
        &mut self,
        value: u8,
        enhanced: bool,
        local: u64,
        system: u64,
    ) -> Edges {
        let known = if enhanced { 0xff } else { 0x07 };
        let value = value & known;
        self.activate(value & !activation::PING, local, system);
        if value & activation::PING == 0 {
            return Edges::default();
        }
        Edges {
            sync0: self.edge(0, activation::SYNC0, false),
            sync1: self.edge(1, activation::SYNC1, false),
        }
    }

    fn activate(&mut self, value: u8, local: u64, system: u64) {
        let was = std::mem::replace(&mut self.activation, value);
        if value & activation::UNIT == 0 {
            self.base = Base::Off;
            (self.due0, self.due1) = (u64::MAX, u64::MAX);
            (self.next1, self.status, self.unacknowledged) = (None, 0, 0);
            return;
        }
        if was & activation::UNIT != 0 {
            return;
        }
        self.pulses = 0;
        let ahead = self.width.ahead(self.start, system);
        let near = match value & activation::NEAR {
            0 => self.width.half(),
            _ => 1 << 31,
        };
        let implausible = ahead == 0 || ahead >= near;
        self.status = value >> 1 & 3 | u8::from(implausible) << 2;
        let next = if implausible && value & activation::PLAUSIBILITY != 0 {
            system.wrapping_add(1)
        } else {
            self.start.wrapping_add(self.late)
        };
        self.base = Base::Running {
            next: self.width.cut(next),
        };
        self.aim(local, system);
    }

    /// Computes the local times of the next pulses, after a change of the clock offset or start
    /// time.
    pub fn aim(&mut self, local: u64, system: u64) {
        let when = |target: u64| {
            let ahead = self.width.ahead(target, system);
            // A 32-bit comparator that was passed matches again after the clock has wrapped.
            match (ahead, self.width) {
                (0, Width::Bits32) => local.saturating_add(1 << 32),
                (0, Width::Bits64) => u64::MAX,
                (ahead, Width::Bits64) if ahead >= Width::Bits64.half() => u64::MAX,
                (ahead, _) => local.saturating_add(ahead),
            }
        };
        self.due0 = match self.base {
            Base::Running { next } => when(next),
            Base::Off | Base::Done => u64::MAX,
        };
        self.due1 = self.next1.map_or(u64::MAX, when);
    }

    /// True if the start time was missed, so that no pulse comes for centuries.
    #[cfg(test)]
    fn never_starts(&self) -> bool {
        self.sync0_on() && self.pulses == 0 && self.due0 == u64::MAX
    }

    /// Fires all pulses that are due at `local`.
    pub fn fire(&mut self, local: u64) -> Edges {
        let mut edges = Edges::default();
        // SYNC1 counts from the first SYNC0 after its own pulse. A SYNC0 at the same time is not after
        // it.
        let sync1_pending = self.next1.is_some() && self.due1 >= self.due0;
        if self.due1 <= local {
            (self.due1, self.next1) = (u64::MAX, None);
            edges.sync1 = self.edge(1, activation::SYNC1, false);
            self.status &= !0x02;
        }
        let Base::Running { next } = self.base else {
            return edges;
        };
        if self.due0 > local {
            return edges;
        }
        let due = self.due0;
        edges.sync0 = self.edge(0, activation::SYNC0, self.pulses > 0);
        self.pulses += 1;
        self.status &= !0x01;
        match self.cycle1 {
            0 => {
                edges.sync1 = self.edge(1, activation::SYNC1, self.pulses > 1);
                self.status &= !0x02;
            }
            cycle1 if !sync1_pending => {
                self.next1 = Some(self.width.cut(next.wrapping_add(u64::from(cycle1))));
                self.due1 = due.saturating_add(u64::from(cycle1));
            }
            _ => {}
        }
        if self.cycle0 == 0 {
            (self.base, self.due0) = (Base::Done, u64::MAX);
            return edges;
        }
        let cycle = u64::from(self.cycle0.max(SHORTEST_CYCLE_NS));
        let skipped = DENSEST_NS.div_ceil(cycle).max(1);
        self.pulses += skipped - 1;
        self.due0 = due.saturating_add(cycle * skipped);
        self.base = Base::Running {
            next: self.width.cut(next.wrapping_add(cycle * skipped)),
        };
        edges
    }

    /// Returns true if output `n` rises. An output that is still high does not rise.
    fn edge(&mut self, n: u8, enable: u8, repeated: bool) -> bool {
        if self.activation & enable == 0 {
            return false;
        }
        if self.pulse_length == 0 {
            let waits = self.waits(n);
            self.unacknowledged |= 1 << n;
            return !waits;
        }
        let length = u64::from(self.pulse_length) * 10;
        let cyclic = self.cycle0 > 0 && repeated;
        !(cyclic && length > u64::from(self.cycle0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ON: u8 = activation::UNIT | activation::SYNC0 | activation::SYNC1;

    fn unit(cycle0: u32, cycle1: u32) -> SyncUnit {
        let mut unit = SyncUnit::new(Width::Bits64, 1);
        (unit.cycle0, unit.cycle1) = (cycle0, cycle1);
        unit
    }

    /// Fires until `end`, with a local clock equal to the system clock.
    fn pulses(unit: &mut SyncUnit, end: u64) -> (Vec<u64>, Vec<u64>) {
        let (mut sync0, mut sync1) = (Vec::new(), Vec::new());
        while unit.due() <= end {
            let at = unit.due();
            let edges = unit.fire(at);
            sync0.extend(edges.sync0.then_some(at));
            sync1.extend(edges.sync1.then_some(at));
        }
        (sync0, sync1)
    }

    /// ESC data sheet, section I, 9.2.3: SYNC1 comes its cycle time after SYNC0, and the next one is
    /// counted from the next SYNC0. SOEM's `ec_dcsync01` has the same period,
    /// `((CyclTime1 / CyclTime0) + 1) * CyclTime0`. EL3702 with 2 and 4 samples at 1 ms, as `ecmccfg`
    /// configures them on hardware: 500 µs after 500 µs, and 750 µs after 250 µs.
    #[test]
    fn sync1_counts_from_sync0() {
        // (SYNC0 cycle, SYNC1 cycle, SYNC1 pulses in µs after the start)
        let rows: [(u32, u32, &[u64]); 7] = [
            (100, 0, &[0, 100, 200, 300, 400, 500, 600]),
            (100, 30, &[30, 130, 230, 330, 430, 530]),
            (100, 100, &[100, 300, 500]),
            (100, 150, &[150, 350, 550]),
            (100, 200, &[200, 500]),
            (100, 250, &[250, 550]),
            (100, 300, &[300]),
        ];
        for (cycle0, cycle1, expected) in rows {
            let mut unit = unit(cycle0 * 1_000, cycle1 * 1_000);
            unit.write_start(5_000_000, true, true, 0, 0);
            unit.write_activation(ON, true, 0, 0);
            assert_eq!(unit.status(), 3, "both pending");
            let (sync0, sync1) = pulses(&mut unit, 5_600_000);
            let relative: Vec<u64> = sync1.iter().map(|at| (at - 5_000_000) / 1_000).collect();
            assert_eq!(relative, expected, "SYNC1 cycle {cycle1}");
            let soem = u64::from((cycle1 / cycle0 + 1) * cycle0);
            assert!(relative.windows(2).all(|pair| pair[1] - pair[0] == soem));
            assert_eq!(sync0.len(), 7);
            assert_eq!(unit.status(), 0);
            assert_eq!(unit.next_sync0(), 5_700_000);
        }
    }

    /// `ecmccfg` with terminals that sample 2, 4 and 10 times in 1 ms: the period of SYNC1 is 1 ms. The
    /// cycle itself in 0x09A4 makes it one SYNC0 cycle too long.
    #[test]
    fn sync1_of_oversampling_terminals_has_the_period_of_the_bus() {
        for (samples, excess) in [(2, 0), (4, 0), (10, 0), (2, 500_000), (10, 100_000)] {
            let cycle0 = 1_000_000 / samples;
            let mut unit = unit(cycle0, 1_000_000 - cycle0 + excess);
            unit.write_start(5_000_000, true, true, 0, 0);
            unit.write_activation(ON, true, 0, 0);
            let (_, sync1) = pulses(&mut unit, 30_000_000);
            assert!(sync1.len() > 10);
            let period = u64::from(1_000_000 + excess);
            assert!(sync1.windows(2).all(|pair| pair[1] - pair[0] == period));
        }
    }

    #[test]
    fn a_cycle_of_zero_is_a_single_shot() {
        let mut unit = unit(0, 500);
        unit.write_start(1_000, true, true, 0, 0);
        unit.write_activation(ON, true, 0, 0);
        assert_eq!(pulses(&mut unit, 1_000_000), (vec![1_000], vec![1_500]));
        // The unit fires again only after a new activation.
        unit.write_start(2_000_000, true, true, 1_000_000, 1_000_000);
        unit.write_activation(ON, true, 1_000_000, 1_000_000);
        assert_eq!(unit.due(), u64::MAX);
        unit.write_activation(0, true, 1_000_000, 1_000_000);
        unit.write_activation(ON, true, 1_000_000, 1_000_000);
        assert_eq!(unit.due(), 2_000_000);
    }

    #[test]
    fn sync0_with_a_past_start_time_fires_after_the_clock_has_wrapped() {
        let mut wide = unit(500, 0);
        wide.write_start(1_000, true, true, 2_000, 2_000);
        wide.write_activation(ON, true, 2_000, 2_000);
        assert!(wide.never_starts());
        assert_eq!(wide.status(), 7, "out of the near future");
        let mut narrow = SyncUnit::new(Width::Bits32, 1);
        narrow.write_start(1_000, true, false, 2_000, 2_000);
        narrow.write_activation(ON, true, 2_000, 2_000);
        assert!(!narrow.never_starts());
        assert_eq!(narrow.due(), 1_000 + (1 << 32));
    }

    #[test]
    fn sync0_with_an_implausible_start_time_fires_at_once_if_enabled() {
        let near = activation::PLAUSIBILITY | activation::NEAR;
        // (activation, start, expected local time of the first pulse) at 10 s.
        let rows = [
            (activation::PLAUSIBILITY, 9_000_000_000, 10_000_000_001),
            (activation::PLAUSIBILITY, 20_000_000_000, 20_000_000_000),
            (near, 11_000_000_000, 11_000_000_000),
            (near, 20_000_000_000, 10_000_000_001),
            (0, 20_000_000_000, 20_000_000_000),
        ];
        for (bits, start, first) in rows {
            let mut unit = unit(1_000_000, 0);
            let now = 10_000_000_000;
            unit.write_start(start, true, true, now, now);
            unit.write_activation(ON | bits, true, now, now);
            assert_eq!(unit.due(), first, "0x{bits:02x}, {start}");
        }
    }

    #[test]
    fn writing_the_start_time_activates_the_unit_if_enabled() {
        let auto = activation::AUTO | activation::SYNC0;
        let mut unit = unit(1_000, 0);
        unit.write_activation(auto, true, 0, 0);
        unit.write_start(5_000, true, false, 0, 0);
        assert_eq!(unit.due(), u64::MAX, "half of it is not enough");
        unit.write_start(5_000, false, true, 0, 0);
        assert_eq!(unit.due(), 5_000);
        assert_eq!(unit.activation(), auto | activation::UNIT);
        unit.write_activation(auto | activation::EXTEND, true, 0, 0);
        let now = (7 << 32) + 9_000;
        unit.write_start(5_000, true, false, 0, now);
        assert_eq!(unit.next_sync0(), (8 << 32) + 5_000);
        // A controller without the enhanced activation ignores these bits.
        unit.write_activation(0xff, false, 0, 0);
        assert_eq!(unit.activation(), 0x07);
    }

    #[test]
    fn output_in_acknowledge_mode_stays_high_until_acknowledged() {
        let mut unit = unit(100_000, 0);
        unit.pulse_length = 0;
        unit.write_start(1_000_000, true, true, 0, 0);
        unit.write_activation(ON, true, 0, 0);
        assert_eq!(pulses(&mut unit, 1_300_000).0, [1_000_000]);
        assert!(unit.waits(0) && unit.waits(1));
        unit.acknowledge(0);
        assert_eq!(pulses(&mut unit, 1_500_000), (vec![1_400_000], vec![]));
    }

    #[test]
    fn pulse_longer_than_the_cycle_keeps_the_output_high() {
        let mut unit = unit(100_000, 0);
        unit.pulse_length = 10_001;
        unit.write_start(1_000_000, true, true, 0, 0);
        unit.write_activation(ON, true, 0, 0);
        assert_eq!(pulses(&mut unit, 2_000_000).0, [1_000_000]);
        unit.write_activation(0, true, 0, 0);
        unit.pulse_length = 10_000;
        unit.write_activation(ON, true, 0, 0);
        assert_eq!(pulses(&mut unit, 1_200_000).0.len(), 3);
    }

    #[test]
    fn ping_fires_one_pulse_at_once() {
        let mut unit = unit(0, 0);
        let ping = activation::PING | activation::SYNC1;
        let edges = unit.write_activation(ping, true, 0, 0);
        assert_eq!((edges.sync0, edges.sync1), (false, true));
        assert_eq!(unit.activation(), activation::SYNC1);
    }

    #[test]
    fn pulses_above_the_maximum_rate_are_counted_and_not_served() {
        let mut unit = unit(1, 0);
        unit.write_start(1, true, true, 0, 0);
        unit.write_activation(ON, true, 0, 0);
        let (served, _) = pulses(&mut unit, 1_000_000);
        assert!(served.len() <= 101, "{}", served.len());
        assert!(unit.pulses >= 1_000_000 / u64::from(SHORTEST_CYCLE_NS));
    }

    #[test]
    fn sync0_misses_a_pulse_that_an_offset_change_skips() {
        let mut unit = unit(1_000, 0);
        unit.write_start(5_000, true, true, 0, 0);
        unit.write_activation(ON, true, 0, 0);
        unit.aim(1_000, 3_000);
        assert_eq!(unit.due(), 3_000);
        unit.aim(1_000, 6_000);
        assert_eq!(unit.due(), u64::MAX);
    }
}
