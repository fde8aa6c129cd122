//! The registers that the diagnostic slot reads, one register block of one SubDevice at a time.

use ecaxis_ecat::al_state::AlState;
use ecaxis_ecat::registers;
use serde::Serialize;

/// A register block that is read from every SubDevice in turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DiagnosticRegister {
    /// AL status and AL status code, 0x0130–0x0135.
    AlStatus,
    /// DL status, 0x0110: the links and loops of the four ports.
    DlStatus,
    /// System time difference, 0x092C.
    ClockDifference,
    /// Invalid frames and physical errors of the four ports, 0x0300–0x0307.
    RxErrors,
    /// Forwarded errors of the four ports, errors of the processing unit and of its PDI,
    /// 0x0308–0x030D.
    Forwarded,
    /// Lost links of the four ports, 0x0310–0x0313.
    LostLinks,
}

impl DiagnosticRegister {
    pub const ALL: [Self; 6] = [
        Self::AlStatus,
        Self::DlStatus,
        Self::ClockDifference,
        Self::RxErrors,
        Self::Forwarded,
        Self::LostLinks,
    ];
    /// Returns its address and length.
    pub(super) const fn register_and_len(self) -> (u16, usize) {
        match self {
            Self::AlStatus => (registers::AL_STATUS, 6),
            Self::DlStatus => (registers::DL_STATUS, 2),
            Self::ClockDifference => (registers::DC_SYSTEM_TIME_DIFFERENCE, 4),
            Self::RxErrors => (registers::RX_ERROR_COUNTERS, 8),
            Self::Forwarded => (registers::FORWARDED_ERROR_COUNTERS, 6),
            Self::LostLinks => (registers::LOST_LINK_COUNTERS, 4),
        }
    }
}

/// The error counters of a SubDevice. Each saturates at 255, and the master never clears them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ErrorCounters {
    /// Per port: frames with a wrong checksum or truncated.
    pub invalid_frames: [u8; 4],
    /// Per port: symbols that the PHY could not decode.
    pub rx_errors: [u8; 4],
    /// Per port: frames that an earlier device had already marked as bad.
    pub forwarded: [u8; 4],
    /// Frames that the processing unit found bad.
    pub processing: u8,
    /// Failed accesses by the device's own processor (PDI).
    pub pdi: u8,
    /// Per port: lost links.
    pub lost_links: [u8; 4],
}

impl ErrorCounters {
    /// Copies the counters of one register block.
    fn take(&mut self, block: DiagnosticRegister, from: &Self) {
        match block {
            DiagnosticRegister::RxErrors => {
                self.invalid_frames = from.invalid_frames;
                self.rx_errors = from.rx_errors;
            }
            DiagnosticRegister::Forwarded => {
                self.forwarded = from.forwarded;
                (self.processing, self.pdi) = (from.processing, from.pdi);
            }
            DiagnosticRegister::LostLinks => self.lost_links = from.lost_links,
            DiagnosticRegister::AlStatus
            | DiagnosticRegister::DlStatus
            | DiagnosticRegister::ClockDifference => {}
        }
    }

    /// Returns the larger value of each counter.
    fn max(&self, other: &Self) -> Self {
        let more = |a: [u8; 4], b: [u8; 4]| std::array::from_fn(|port: usize| a[port].max(b[port]));
        Self {
            invalid_frames: more(self.invalid_frames, other.invalid_frames),
            rx_errors: more(self.rx_errors, other.rx_errors),
            forwarded: more(self.forwarded, other.forwarded),
            processing: self.processing.max(other.processing),
            pdi: self.pdi.max(other.pdi),
            lost_links: more(self.lost_links, other.lost_links),
        }
    }

    /// Returns the increments since `start`.
    #[must_use]
    pub fn since(&self, start: &Self) -> Self {
        let less = |now: [u8; 4], then: [u8; 4]| {
            std::array::from_fn(|port| now[port].saturating_sub(then[port]))
        };
        Self {
            invalid_frames: less(self.invalid_frames, start.invalid_frames),
            rx_errors: less(self.rx_errors, start.rx_errors),
            forwarded: less(self.forwarded, start.forwarded),
            processing: self.processing.saturating_sub(start.processing),
            pdi: self.pdi.saturating_sub(start.pdi),
            lost_links: less(self.lost_links, start.lost_links),
        }
    }
}

/// The last values that the diagnostic slot has read from one SubDevice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SubDeviceDiagnostics {
    /// True if it answered the last read.
    pub answers: bool,
    pub al_status: u8,
    pub al_code: u16,
    /// DL status: the links and loops of the ports.
    pub dl_status: u16,
    /// Own clock minus reference, nanoseconds.
    pub clock_difference: i32,
    pub errors: ErrorCounters,
    /// True from a read that it did not answer to the next read of its AL status.
    pub(super) al_status_outdated: bool,
    /// True once it was seen in Op, missing, or with an error: it may reach Op after the others.
    pub(super) judged: bool,
    /// The counters at the first read.
    start: ErrorCounters,
    /// For each of [`DiagnosticRegister::ALL`], true once it was read.
    begun: [bool; DiagnosticRegister::ALL.len()],
}

/// The error counters of one SubDevice shortly before a stop and at the stop. Not part of the
/// published snapshot.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Window {
    /// The counters at the start of the last window and of the one before it.
    begins: [ErrorCounters; 2],
    /// The first reads after the stop.
    at_stop: ErrorCounters,
    stopped: bool,
    /// For each of [`DiagnosticRegister::ALL`], true once it was read after the stop.
    ended: [bool; DiagnosticRegister::ALL.len()],
}

impl Window {
    /// Returns the increments shortly before the stop. They count from the window before the last
    /// to the first read after the stop. Without such a read, they count to `latest`.
    #[must_use]
    pub fn increments(&self, latest: &ErrorCounters) -> ErrorCounters {
        let mut end = *latest;
        for block in DiagnosticRegister::ALL {
            if self.ended[block as usize] {
                end.take(block, &self.at_stop);
            }
        }
        end.since(&self.begins[0])
    }

    /// Begins a window, unless stopped. RT.
    pub(super) fn begin(&mut self, now: &ErrorCounters) {
        if !self.stopped {
            self.begins = [self.begins[1], *now];
        }
    }

    /// Takes the values of one register block. RT.
    pub(super) fn take(&mut self, block: DiagnosticRegister, now: &ErrorCounters, first: bool) {
        if first {
            for to in &mut self.begins {
                to.take(block, now);
            }
        }
        if self.stopped && !std::mem::replace(&mut self.ended[block as usize], true) {
            self.at_stop.take(block, now);
        }
    }

    /// Freezes the window when its group stops. RT.
    pub(super) fn stop(&mut self) {
        self.stopped = true;
    }

    /// Restarts the window after its group was reset. RT.
    pub(super) fn release(&mut self, now: &ErrorCounters) {
        *self = Self {
            begins: [*now; 2],
            ..Self::default()
        };
    }
}

impl SubDeviceDiagnostics {
    /// Returns true if the device answers and was in Op.
    #[must_use]
    pub fn is_in_op(&self) -> bool {
        self.current_al_status() == Some(AlState::Op.code())
    }

    /// Returns the AL status; `None` if the device does not answer, or has not been asked for it since it
    /// answers again.
    #[must_use]
    pub fn current_al_status(&self) -> Option<u8> {
        (self.answers && !self.al_status_outdated).then_some(self.al_status)
    }

    /// Returns the increments of the error counters since the cycle began.
    #[must_use]
    pub fn grown(&self) -> ErrorCounters {
        self.errors.since(&self.start)
    }

    /// True if the device answers and its clock is as close to the reference clock.
    #[must_use]
    pub fn clock_within(&self, window_ns: u64) -> bool {
        self.answers
            && self.has_read(DiagnosticRegister::ClockDifference)
            && u64::from(self.clock_difference.unsigned_abs()) <= window_ns
    }

    /// True once this register block was read, so that its values are not defaults.
    #[must_use]
    pub fn has_read(&self, block: DiagnosticRegister) -> bool {
        self.begun.get(block as usize) == Some(&true)
    }

    /// Returns the increments up to `now`, counters that were read later by other means.
    #[must_use]
    pub fn grown_to(&self, now: &ErrorCounters) -> ErrorCounters {
        self.latest(Some(now)).since(&self.start)
    }

    /// Returns the last known error counters. `now` replaces only those that were read before.
    #[must_use]
    pub fn latest(&self, now: Option<&ErrorCounters>) -> ErrorCounters {
        let mut latest = self.errors;
        for block in DiagnosticRegister::ALL {
            if let Some(now) = now.filter(|_| self.has_read(block)) {
                let mut part = latest;
                part.take(block, now);
                latest = latest.max(&part);
            }
        }
        latest
    }

    /// Takes whether a read was answered. A device need not have every register block: only a block
    /// that it has shows that it is missing. RT.
    pub(super) fn note_answer(&mut self, block: DiagnosticRegister, answered: bool) {
        self.judged |= block == DiagnosticRegister::AlStatus && !answered;
        if answered || block == DiagnosticRegister::AlStatus || self.has_read(block) {
            self.answers = answered;
            self.al_status_outdated |= !answered;
        }
    }

    /// Processes an answer. RT.
    pub(super) fn take(&mut self, block: DiagnosticRegister, data: &[u8]) {
        match (block, data) {
            (DiagnosticRegister::AlStatus, &[status, _, _, _, low, high]) => {
                (self.al_status, self.al_status_outdated) = (status, false);
                self.judged |= status == AlState::Op.code() || status & AL_ERROR != 0;
                self.al_code = u16::from_le_bytes([low, high]);
            }
            (DiagnosticRegister::DlStatus, &[low, high]) => {
                self.dl_status = u16::from_le_bytes([low, high]);
            }
            (DiagnosticRegister::ClockDifference, &[a, b, c, d]) => {
                self.clock_difference = sign_magnitude(u32::from_le_bytes([a, b, c, d]));
            }
            (DiagnosticRegister::RxErrors, &[i0, r0, i1, r1, i2, r2, i3, r3]) => {
                self.errors.invalid_frames = [i0, i1, i2, i3];
                self.errors.rx_errors = [r0, r1, r2, r3];
            }
            (DiagnosticRegister::Forwarded, &[f0, f1, f2, f3, processing, pdi]) => {
                self.errors.forwarded = [f0, f1, f2, f3];
                (self.errors.processing, self.errors.pdi) = (processing, pdi);
            }
            (DiagnosticRegister::LostLinks, &[l0, l1, l2, l3]) => {
                self.errors.lost_links = [l0, l1, l2, l3]
            }
            _ => return,
        }
        let n = block as usize;
        if !std::mem::replace(&mut self.begun[n], true) {
            self.start.take(block, &self.errors);
        }
    }
}

/// The error indication in the AL status.
const AL_ERROR: u8 = 0x10;

/// Converts 0x092C, received minus own time. Bit 31 is the sign (own clock ahead), the rest the
/// amount.
pub(crate) fn sign_magnitude(raw: u32) -> i32 {
    let amount = i32::try_from(raw & 0x7fff_ffff).unwrap_or(i32::MAX);
    if raw & 0x8000_0000 == 0 {
        amount
    } else {
        -amount
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_difference_register_is_sign_and_magnitude() {
        assert_eq!(sign_magnitude(5), 5);
        assert_eq!(sign_magnitude(0x8000_0005), -5);
    }

    #[test]
    fn a_register_block_that_a_device_lacks_does_not_make_it_missing() {
        let mut diagnosis = SubDeviceDiagnostics::default();
        diagnosis.note_answer(DiagnosticRegister::AlStatus, true);
        diagnosis.take(DiagnosticRegister::AlStatus, &[8, 0, 0, 0, 0, 0]);
        diagnosis.note_answer(DiagnosticRegister::ClockDifference, false);
        assert!(diagnosis.is_in_op());
        diagnosis.note_answer(DiagnosticRegister::AlStatus, false);
        assert!(!diagnosis.is_in_op());
    }

    /// A device that came back counted as in Op until its AL status was read, and was reported twice.
    #[test]
    fn returned_device_is_in_op_once_its_al_status_says_so() {
        let mut diagnosis = SubDeviceDiagnostics::default();
        for (block, data) in [
            (DiagnosticRegister::AlStatus, &[8, 0, 0, 0, 0, 0][..]),
            (DiagnosticRegister::DlStatus, &[0, 0][..]),
        ] {
            diagnosis.note_answer(block, true);
            diagnosis.take(block, data);
        }
        assert_eq!(diagnosis.current_al_status(), Some(8));
        diagnosis.note_answer(DiagnosticRegister::AlStatus, false);
        diagnosis.note_answer(DiagnosticRegister::DlStatus, true);
        assert!(diagnosis.answers && diagnosis.current_al_status().is_none());
        diagnosis.note_answer(DiagnosticRegister::AlStatus, true);
        diagnosis.take(DiagnosticRegister::AlStatus, &[4, 0, 0, 0, 0, 0]);
        assert_eq!(
            (diagnosis.current_al_status(), diagnosis.is_in_op()),
            (Some(4), false)
        );
    }

    #[test]
    fn error_counters_grow_from_their_first_values() {
        let mut diagnosis = SubDeviceDiagnostics::default();
        assert!(!diagnosis.has_read(DiagnosticRegister::RxErrors));
        diagnosis.take(DiagnosticRegister::RxErrors, &[3, 1, 0, 0, 0, 0, 0, 0]);
        assert!(
            diagnosis.has_read(DiagnosticRegister::RxErrors)
                && !diagnosis.has_read(DiagnosticRegister::LostLinks)
        );
        diagnosis.take(DiagnosticRegister::LostLinks, &[0, 2, 0, 0]);
        assert_eq!(diagnosis.grown(), ErrorCounters::default());
        diagnosis.take(DiagnosticRegister::RxErrors, &[5, 1, 0, 4, 0, 0, 0, 0]);
        diagnosis.take(DiagnosticRegister::Forwarded, &[0, 0, 0, 0, 7, 0]);
        diagnosis.take(DiagnosticRegister::Forwarded, &[0, 0, 1, 0, 7, 9]);
        diagnosis.take(DiagnosticRegister::LostLinks, &[0, 3, 0, 0]);
        let grown = ErrorCounters {
            invalid_frames: [2, 0, 0, 0],
            rx_errors: [0, 4, 0, 0],
            forwarded: [0, 0, 1, 0],
            processing: 0,
            pdi: 9,
            lost_links: [0, 1, 0, 0],
        };
        assert_eq!(diagnosis.grown(), grown);
        diagnosis.take(DiagnosticRegister::LostLinks, &[0; 6]);
        assert_eq!(diagnosis.grown(), grown, "an answer of another length");
        let mut later = diagnosis.errors;
        later.invalid_frames[1] = 4;
        let more = ErrorCounters {
            invalid_frames: [2, 4, 0, 0],
            ..grown
        };
        assert_eq!(diagnosis.grown_to(&later), more);
        // After a loss of power the counters begin at zero.
        let none = ErrorCounters::default();
        assert_eq!(diagnosis.grown_to(&none), grown);
        assert_eq!(
            SubDeviceDiagnostics::default().grown_to(&later),
            none,
            "nothing to compare with"
        );
    }

    #[test]
    fn window_counts_only_increments_around_the_stop() {
        let lost = |n: u8| ErrorCounters {
            lost_links: [0, n, 0, 0],
            ..ErrorCounters::default()
        };
        let mut window = Window::default();
        let grown = |window: &Window, n| window.increments(&lost(n)).lost_links[1];
        window.take(DiagnosticRegister::LostLinks, &lost(1), true);
        window.take(DiagnosticRegister::LostLinks, &lost(3), false);
        assert_eq!(grown(&window, 3), 2);
        // Two windows later, the increment is no longer recent.
        window.begin(&lost(3));
        assert_eq!(grown(&window, 3), 2);
        window.begin(&lost(3));
        assert_eq!(grown(&window, 3), 0);
        window.stop();
        window.begin(&lost(4));
        window.begin(&lost(4));
        // Not read since the stop: `latest` counts.
        assert_eq!(grown(&window, 6), 3);
        window.take(DiagnosticRegister::RxErrors, &lost(5), false);
        assert_eq!(grown(&window, 6), 3, "another probe");
        window.take(DiagnosticRegister::LostLinks, &lost(5), false);
        window.take(DiagnosticRegister::LostLinks, &lost(9), false);
        assert_eq!(grown(&window, 9), 2, "the first read after the stop");
        window.release(&lost(9));
        assert_eq!(grown(&window, 10), 1);
    }

    #[test]
    fn diagnostic_registers_are_in_declaration_order() {
        for block in DiagnosticRegister::ALL {
            assert_eq!(DiagnosticRegister::ALL[block as usize], block);
        }
    }
}
