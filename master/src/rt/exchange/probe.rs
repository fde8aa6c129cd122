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
        let since = now.since(&self.start);
        let mut grown = self.grown();
        let more = |to: &mut [u8; 4], new: [u8; 4]| {
            for (to, new) in to.iter_mut().zip(new) {
                *to = new.max(*to);
            }
        };
        if self.has_read(Probe::RxErrors) {
            more(&mut grown.invalid_frames, since.invalid_frames);
            more(&mut grown.rx_errors, since.rx_errors);
        }
        if self.has_read(Probe::Forwarded) {
            more(&mut grown.forwarded, since.forwarded);
            grown.processing = grown.processing.max(since.processing);
            grown.pdi = grown.pdi.max(since.pdi);
        }
        if self.has_read(Probe::LostLinks) {
            more(&mut grown.lost_links, since.lost_links);
        }
        grown
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
        if let Some(begun) = self.begun.get_mut(n)
            && !std::mem::replace(begun, true)
        {
            let (now, start) = (&self.errors, &mut self.start);
            match probe {
                Probe::RxErrors => {
                    start.invalid_frames = now.invalid_frames;
                    start.rx_errors = now.rx_errors;
                }
                Probe::Forwarded => {
                    start.forwarded = now.forwarded;
                    (start.processing, start.pdi) = (now.processing, now.pdi);
                }
                Probe::LostLinks => start.lost_links = now.lost_links,
                Probe::AlStatus | Probe::ClockDifference => {}
            }
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
    fn each_has_its_own_place() {
        for probe in Probe::ALL {
            assert_eq!(Probe::ALL[probe as usize], probe);
        }
    }
}
