//! The reference clock of the exchange: which device it is, and which of its times count.

use ecaxis_ecat::index::DeviceIndex;

use super::ExchangeDevice;
use crate::clock::Nanos;
use crate::rt::phase::{ClockPlan, extend};

/// The cycles in a row without a time of the reference clock after which another clock replaces it.
const REFERENCE_CYCLES: u8 = 10;
/// The drift between host and bus that a time may show, as a divisor: 1000 ppm.
const DRIFT: u64 = 1_000;

#[derive(Debug)]
pub(super) struct ReferenceClock {
    /// The devices that can be the reference clock, in the order in which frames pass them, and the
    /// one that is.
    candidates: Vec<(u16, DeviceIndex)>,
    current: usize,
    /// The cycles in a row without its time.
    missing: u8,
    /// Its last time, and the session clock's time when that frame was sent.
    last: Option<(u64, Nanos)>,
    cycle_ns: u64,
}

impl ReferenceClock {
    #[allow(clippy::disallowed_methods, reason = "runs before the loop")]
    pub fn new(members: &[ExchangeDevice], plan: Option<&ClockPlan>) -> Self {
        let devices = (0..).map(DeviceIndex).zip(members);
        let mut candidates: Vec<_> = devices
            .filter(|(_, member)| member.clock)
            .map(|(device, member)| (member.station, device))
            .collect();
        candidates.sort_unstable();
        let planned = plan.and_then(|plan| {
            let mut stations = candidates.iter().map(|(station, _)| *station);
            stations.position(|station| station == plan.reference)
        });
        Self {
            candidates,
            current: planned.unwrap_or(0),
            missing: 0,
            last: None,
            cycle_ns: plan.map_or(0, |plan| plan.cycle_ns),
        }
    }

    pub fn station(&self) -> Option<u16> {
        Some(self.candidates.get(self.current)?.0)
    }

    pub fn device(&self) -> Option<DeviceIndex> {
        Some(self.candidates.get(self.current)?.1)
    }

    /// Returns the time that clocks before the reference clock receive with a frame sent at `at`, or
    /// all clocks if the reference clock does not answer. It does not depend on the lateness of the
    /// cycle.
    pub fn expected(&self, at: Nanos) -> u64 {
        self.last.map_or(0, |(time, sent_at)| {
            time.wrapping_add(at.wrapping_sub(sent_at))
        })
    }

    /// Takes a time read by a frame sent at `at`. Returns it with the upper half that a clock of 32
    /// bits does not have. Returns `None` for a time that jumps by more than an eighth of a cycle:
    /// the clock was not set, or was set again. RT.
    pub fn take(&mut self, time: u64, at: Nanos) -> Option<u64> {
        let time = match self.last {
            None => time,
            Some((_, sent_at)) => {
                let expected = self.expected(at);
                let time = extend(time, expected);
                let tolerated = self.cycle_ns / 8 + at.abs_diff(sent_at) / DRIFT;
                if time.wrapping_sub(expected).cast_signed().unsigned_abs() > tolerated {
                    return None;
                }
                time
            }
        };
        self.last = Some((time, at));
        self.missing = 0;
        Some(time)
    }

    /// Notes a cycle whose frame came back without a time. After some, the next usable clock becomes
    /// the reference clock. Without one, the reference clock stays. RT.
    pub fn miss(&mut self, usable: impl Fn(DeviceIndex) -> bool) {
        self.missing += 1;
        if self.missing < REFERENCE_CYCLES {
            return;
        }
        self.missing = 0;
        let clocks = self.candidates.iter().enumerate().cycle();
        let mut others = clocks
            .skip(self.current)
            .take(self.candidates.len())
            .skip(1);
        if let Some((next, _)) = others.find(|(_, (_, device))| usable(*device)) {
            self.current = next;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::poll_schedule::PollTarget;
    use super::super::tests::{clocks, reflect};
    use super::super::{DiagnosticRegister, Exchange, ExchangeMode};
    use super::*;
    use crate::link::{Link, LinkError, MAX_FRAME};

    const CYCLE: u64 = 1_000_000;

    fn reference(count: u16) -> ReferenceClock {
        let members: Vec<_> = (0..count)
            .map(|n| ExchangeDevice {
                station: 0x1000 + n,
                clock: true,
                mailbox: None,
            })
            .collect();
        let plan = ClockPlan {
            reference: 0x1000,
            cycle_ns: CYCLE,
            release: 0,
            release_at: 0,
            window_ns: 10_000,
            sync0: 0,
            align: false,
        };
        ReferenceClock::new(&members, Some(&plan))
    }

    #[test]
    fn a_time_that_jumps_is_not_taken() {
        for wrapped in [u64::MAX, u64::from(u32::MAX)] {
            let mut clock = reference(1);
            let start = u64::from(u32::MAX) - 3 * CYCLE;
            assert_eq!(clock.take(start, 0), Some(start));
            for (after, jump, taken) in [
                (CYCLE, 0, true),
                (2 * CYCLE, 124_000, true),
                (3 * CYCLE, 300_000, false),
                (4 * CYCLE, -300_000, false),
                (5 * CYCLE, 0, true),
                // After ten seconds without a time, a drift of 100 ppm is more than an eighth.
                (10_000 * CYCLE, 1_000_000, true),
            ] {
                let time = (start + after).wrapping_add_signed(jump);
                let found = clock.take(time & wrapped, after);
                assert_eq!(found, taken.then_some(time), "{after} {jump}");
            }
        }
    }

    /// The time for the other clocks is that of the frame, however late it is sent.
    #[test]
    fn expected_time_follows_the_send_time() {
        let mut clock = reference(2);
        clock.take(77_000_000, 5_000_000);
        for late in [0, 1, 40_000, 3_300_000] {
            assert_eq!(clock.expected(6_000_000 + late), 78_000_000 + late);
        }
    }

    #[test]
    fn only_a_usable_clock_replaces_the_reference() {
        let mut clock = reference(4);
        let missing = |clock: &mut ReferenceClock, usable: &[usize]| {
            for _ in 0..REFERENCE_CYCLES {
                clock.miss(|device| usable.contains(&device.0));
            }
            clock.device()
        };
        assert_eq!(missing(&mut clock, &[]), Some(DeviceIndex(0)));
        assert_eq!(missing(&mut clock, &[0]), Some(DeviceIndex(0)));
        assert_eq!(missing(&mut clock, &[0, 2]), Some(DeviceIndex(2)));
        assert_eq!(missing(&mut clock, &[1, 2]), Some(DeviceIndex(1)));
        assert_eq!(missing(&mut clock, &[]), Some(DeviceIndex(1)));
        assert_eq!(clock.station(), Some(0x1001));
    }

    /// A link that discards all frames.
    #[derive(Debug)]
    struct Nowhere;

    impl Link for Nowhere {
        fn send(&mut self, _: &[u8]) -> Result<(), LinkError> {
            Ok(())
        }

        fn recv(&mut self, _: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
            Ok(None)
        }
    }

    /// ETG.1000.4, FRMW: without the addressed device, the data come back as sent.
    #[test]
    fn system_time_comes_only_from_the_reference_clock() {
        let mut exchange = clocks(3, ExchangeMode::SameCycle);
        for wkc in [0, 1, 2, 200] {
            for answers in [true, false] {
                exchange.stage();
                let clock = exchange.layouts[0].clock.expect("a clock");
                let mut frame = reflect(&mut exchange, 0, 0);
                let sent = exchange.frame_sets[0].frames()[0].bytes[clock.data()].to_vec();
                frame[clock.data().end] = wkc;
                if !answers {
                    frame[clock.data()].copy_from_slice(&sent);
                }
                exchange.receive(&frame);
                let answer = exchange.evaluate();
                assert_eq!(answer.system_time.is_some(), answers, "counter {wkc}");
            }
        }
    }

    /// Runs cycles of three clocks. `gone` is the number of devices at the beginning that do not
    /// answer, `differences` are those of the clocks. Returns the reference clocks in their order.
    fn references(
        mode: ExchangeMode,
        differences: [u32; 3],
        gone: impl Fn(usize) -> u16,
    ) -> Vec<u16> {
        let mut exchange = clocks(3, mode);
        let mut seen = Vec::new();
        for cycle in 0..200 {
            let station = exchange.reference.station().expect("a clock");
            let clock = exchange.layouts[0].clock.expect("a clock");
            let mut frame = reflect(&mut exchange, 0, 0);
            let sent = &exchange.frame_sets[exchange.staged];
            let sent = sent.frames()[0].bytes[clock.data()].to_vec();
            if station < 0x1000 + gone(cycle) {
                frame[clock.data()].copy_from_slice(&sent);
            }
            answer_difference(&exchange, &mut frame, differences);
            exchange.receive(&frame);
            exchange.evaluate();
            exchange.stage();
            if seen.last() != Some(&station) {
                seen.push(station);
            }
        }
        seen
    }

    /// Answers a read of 0x092C in the diagnostic slot.
    fn answer_difference(exchange: &Exchange, frame: &mut [u8], differences: [u32; 3]) {
        let at = exchange.layouts[0].diagnostic_at;
        let Some(poll) = exchange.frame_sets[exchange.staged].poll else {
            return;
        };
        if let PollTarget::Registers { device, block } = poll.target
            && block == DiagnosticRegister::ClockDifference
        {
            frame[at + 10..at + 14].copy_from_slice(&differences[device.0].to_le_bytes());
        }
    }

    /// ETG.1000.4: every clock holds the system time, so another one can distribute it.
    #[test]
    fn next_clock_replaces_a_reference_that_does_not_answer() {
        for mode in [ExchangeMode::SameCycle, ExchangeMode::Pipelined] {
            let leave = |cycle| u16::from(cycle >= 60) + u16::from(cycle >= 120);
            assert_eq!(references(mode, [0; 3], leave), [0x1000, 0x1001, 0x1002]);
            let off = [0, 20_000, 0];
            assert_eq!(references(mode, off, leave), [0x1000, 0x1002], "{mode:?}");
            let all = |cycle| if cycle < 60 { 0 } else { 3 };
            let off = [0, 20_000, 0x8000_0000 | 20_000];
            assert_eq!(references(mode, off, all), [0x1000], "{mode:?}");
        }
    }

    #[test]
    fn lost_frames_do_not_replace_the_reference() {
        let mut exchange = clocks(3, ExchangeMode::SameCycle);
        for _ in 0..100 {
            exchange.send(&mut Nowhere, 0).expect("nowhere takes all");
            exchange.evaluate();
            exchange.stage();
        }
        assert_eq!(exchange.reference(), Some(DeviceIndex(0)));
    }
}
