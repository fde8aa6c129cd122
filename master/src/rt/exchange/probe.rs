//! What the diagnostic slot reads of the SubDevices, one register block of one of them at a time.

use serde::Serialize;

/// What is read in turn of every SubDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Probe {
    /// AL status and AL status code, 0x0130–0x0135.
    AlStatus,
    /// System time difference, 0x092C.
    ClockDifference,
    /// Invalid frames and physical errors of the four ports, 0x0300–0x0307.
    RxErrors,
    /// Forwarded errors of the four ports, errors of the processing unit and of its PDI, 0x0308–0x030D.
    Forwarded,
    /// Lost links of the four ports, 0x0310–0x0313.
    LostLinks,
}

impl Probe {
    pub const ALL: [Self; 5] = [
        Self::AlStatus,
        Self::ClockDifference,
        Self::RxErrors,
        Self::Forwarded,
        Self::LostLinks,
    ];
    /// Where it is, and how long.
    pub(super) const fn register_and_len(self) -> (u16, usize) {
        match self {
            Self::AlStatus => (0x0130, 6),
            Self::ClockDifference => (0x092c, 4),
            Self::RxErrors => (0x0300, 8),
            Self::Forwarded => (0x0308, 6),
            Self::LostLinks => (0x0310, 4),
        }
    }
}

/// A SubDevice's error counters. Each stands still at 255; nobody clears them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ErrorCounters {
    /// Per port: frames with a wrong checksum or cut off.
    pub invalid_frames: [u8; 4],
    /// Per port: what the PHY could not make out.
    pub rx_errors: [u8; 4],
    /// Per port: frames that somebody before had found bad already.
    pub forwarded: [u8; 4],
    /// Frames that the processing unit found bad.
    pub processing: u8,
    /// Accesses of the device's own processor that failed.
    pub pdi: u8,
    /// Per port.
    pub lost_links: [u8; 4],
}

impl ErrorCounters {
    /// Copies what one probe reads.
    fn take(&mut self, probe: Probe, from: &Self) {
        match probe {
            Probe::RxErrors => {
                self.invalid_frames = from.invalid_frames;
                self.rx_errors = from.rx_errors;
            }
            Probe::Forwarded => {
                self.forwarded = from.forwarded;
                (self.processing, self.pdi) = (from.processing, from.pdi);
            }
            Probe::LostLinks => self.lost_links = from.lost_links,
            Probe::AlStatus | Probe::ClockDifference => {}
        }
    }

    /// The larger of each.
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

    /// What they have grown by.
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

/// The last that the diagnostic slot has read of one SubDevice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Diagnosis {
    /// It answered the last read.
    pub answers: bool,
    pub al_status: u8,
    pub al_code: u16,
    /// Own clock minus reference, nanoseconds.
    pub clock_difference: i32,
    pub errors: ErrorCounters,
    /// As they were read first.
    start: ErrorCounters,
    /// The first reads have been made; in the order of [`Probe::ALL`].
    begun: [bool; Probe::ALL.len()],
}

/// What the error counters of one SubDevice were shortly before a stop, and at it. Not part of what is published every cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Window {
    /// As they were when the last window began, and the one before it.
    begins: [ErrorCounters; 2],
    /// The first reads after the stop.
    at_stop: ErrorCounters,
    stopped: bool,
    /// Those reads have been made; in the order of [`Probe::ALL`].
    ended: [bool; Probe::ALL.len()],
}

impl Window {
    /// What the counters grew by shortly before the stop: from the window before the last to the first read after the stop, or
    /// to the `latest` where no such read was made.
    #[must_use]
    pub fn grown(&self, latest: &ErrorCounters) -> ErrorCounters {
        let mut end = *latest;
        for probe in Probe::ALL {
            if self.ended[probe as usize] {
                end.take(probe, &self.at_stop);
            }
        }
        end.since(&self.begins[0])
    }

    /// A window begins; none does after a stop. RT.
    pub(super) fn begin(&mut self, now: &ErrorCounters) {
        if !self.stopped {
            self.begins = [self.begins[1], *now];
        }
    }

    /// What one probe has read. RT.
    pub(super) fn take(&mut self, probe: Probe, now: &ErrorCounters, first: bool) {
        if first {
            for to in &mut self.begins {
                to.take(probe, now);
            }
        }
        if self.stopped && !std::mem::replace(&mut self.ended[probe as usize], true) {
            self.at_stop.take(probe, now);
        }
    }

    /// Its group stops. RT.
    pub(super) fn stop(&mut self) {
        self.stopped = true;
    }

    /// Its group has been reset. RT.
    pub(super) fn release(&mut self, now: &ErrorCounters) {
        *self = Self {
            begins: [*now; 2],
            ..Self::default()
        };
    }
}

impl Diagnosis {
    /// What the error counters have grown by since the cycle began.
    #[must_use]
    pub fn grown(&self) -> ErrorCounters {
        self.errors.since(&self.start)
    }

    /// What it says of this has been read, and is no default.
    #[must_use]
    pub fn has_read(&self, probe: Probe) -> bool {
        self.begun.get(probe as usize) == Some(&true)
    }

    /// As [`Diagnosis::grown`], up to counters that somebody else has read since.
    #[must_use]
    pub fn grown_to(&self, now: &ErrorCounters) -> ErrorCounters {
        self.latest(Some(now)).since(&self.start)
    }

    /// The error counters as they were last; `now` of those that have been read before.
    #[must_use]
    pub fn latest(&self, now: Option<&ErrorCounters>) -> ErrorCounters {
        let mut latest = self.errors;
        for probe in Probe::ALL {
            if let Some(now) = now.filter(|_| self.has_read(probe)) {
                let mut part = latest;
                part.take(probe, now);
                latest = latest.max(&part);
            }
        }
        latest
    }

    /// Takes an answer in. RT.
    pub(super) fn take(&mut self, probe: Probe, data: &[u8]) {
        match (probe, data) {
            (Probe::AlStatus, &[status, _, _, _, low, high]) => {
                self.al_status = status;
                self.al_code = u16::from_le_bytes([low, high]);
            }
            (Probe::ClockDifference, &[a, b, c, d]) => {
                self.clock_difference = sign_magnitude(u32::from_le_bytes([a, b, c, d]));
            }
            (Probe::RxErrors, &[i0, r0, i1, r1, i2, r2, i3, r3]) => {
                self.errors.invalid_frames = [i0, i1, i2, i3];
                self.errors.rx_errors = [r0, r1, r2, r3];
            }
            (Probe::Forwarded, &[f0, f1, f2, f3, processing, pdi]) => {
                self.errors.forwarded = [f0, f1, f2, f3];
                (self.errors.processing, self.errors.pdi) = (processing, pdi);
            }
            (Probe::LostLinks, &[l0, l1, l2, l3]) => self.errors.lost_links = [l0, l1, l2, l3],
            _ => return,
        }
        let n = probe as usize;
        if !std::mem::replace(&mut self.begun[n], true) {
            self.start.take(probe, &self.errors);
        }
    }
}

/// 0x092C, received − own time: bit 31 is the sign (own clock ahead), the rest the amount.
fn sign_magnitude(raw: u32) -> i32 {
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
    fn counters_grow_from_where_they_were_first_seen() {
        let mut diagnosis = Diagnosis::default();
        assert!(!diagnosis.has_read(Probe::RxErrors));
        diagnosis.take(Probe::RxErrors, &[3, 1, 0, 0, 0, 0, 0, 0]);
        assert!(diagnosis.has_read(Probe::RxErrors) && !diagnosis.has_read(Probe::LostLinks));
        diagnosis.take(Probe::LostLinks, &[0, 2, 0, 0]);
        assert_eq!(diagnosis.grown(), ErrorCounters::default());
        diagnosis.take(Probe::RxErrors, &[5, 1, 0, 4, 0, 0, 0, 0]);
        diagnosis.take(Probe::Forwarded, &[0, 0, 0, 0, 7, 0]);
        diagnosis.take(Probe::Forwarded, &[0, 0, 1, 0, 7, 9]);
        diagnosis.take(Probe::LostLinks, &[0, 3, 0, 0]);
        let grown = ErrorCounters {
            invalid_frames: [2, 0, 0, 0],
            rx_errors: [0, 4, 0, 0],
            forwarded: [0, 0, 1, 0],
            processing: 0,
            pdi: 9,
            lost_links: [0, 1, 0, 0],
        };
        assert_eq!(diagnosis.grown(), grown);
        diagnosis.take(Probe::LostLinks, &[0; 6]);
        assert_eq!(diagnosis.grown(), grown, "an answer of another length");
        let mut later = diagnosis.errors;
        later.invalid_frames[1] = 4;
        let more = ErrorCounters {
            invalid_frames: [2, 4, 0, 0],
            ..grown
        };
        assert_eq!(diagnosis.grown_to(&later), more);
        // After a loss of power they begin at zero.
        let none = ErrorCounters::default();
        assert_eq!(diagnosis.grown_to(&none), grown);
        assert_eq!(
            Diagnosis::default().grown_to(&later),
            none,
            "nothing to compare with"
        );
    }

    #[test]
    fn only_what_grew_around_the_stop_is_recent() {
        let lost = |n: u8| ErrorCounters {
            lost_links: [0, n, 0, 0],
            ..ErrorCounters::default()
        };
        let mut window = Window::default();
        let grown = |window: &Window, n| window.grown(&lost(n)).lost_links[1];
        window.take(Probe::LostLinks, &lost(1), true);
        window.take(Probe::LostLinks, &lost(3), false);
        assert_eq!(grown(&window, 3), 2);
        // Two windows later it is long ago.
        window.begin(&lost(3));
        assert_eq!(grown(&window, 3), 2);
        window.begin(&lost(3));
        assert_eq!(grown(&window, 3), 0);
        window.stop();
        window.begin(&lost(4));
        window.begin(&lost(4));
        // Not read since the stop: the latest.
        assert_eq!(grown(&window, 6), 3);
        window.take(Probe::RxErrors, &lost(5), false);
        assert_eq!(grown(&window, 6), 3, "another probe");
        window.take(Probe::LostLinks, &lost(5), false);
        window.take(Probe::LostLinks, &lost(9), false);
        assert_eq!(grown(&window, 9), 2, "the first read after the stop");
        window.release(&lost(9));
        assert_eq!(grown(&window, 10), 1);
    }

    #[test]
    fn each_has_its_own_place() {
        for probe in Probe::ALL {
            assert_eq!(Probe::ALL[probe as usize], probe);
        }
    }
}
