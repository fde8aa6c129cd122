//! What the copies of the last frames have shown of the ring.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

use super::End;
use crate::link::interface::Carrier;

/// The path of a copy of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CopyPath {
    /// True if it came back to the interface that had sent it: the ring is broken.
    pub returned: bool,
    /// How many devices have processed it; `None` if the frame had no broadcast.
    pub devices: Option<u16>,
}

/// The state of a ring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RingState {
    /// No frame has come back yet, or none does any longer.
    Silent,
    Closed,
    /// Frames cross the ring in one direction only.
    OneDirection,
    /// The ring is broken behind as many devices, of `devices` that answer.
    Broken {
        behind: u16,
        devices: u16,
    },
}

impl RingState {
    /// Returns the number of devices in front of the break, if it is broken.
    #[must_use]
    pub const fn split(self) -> Option<u16> {
        match self {
            Self::Broken { behind, .. } => Some(behind),
            Self::Silent | Self::Closed | Self::OneDirection => None,
        }
    }

    /// Returns a sentence about the ring of a number of devices. `name` returns the device at a
    /// position, `in_front` the position of the one in front of it.
    #[must_use]
    pub fn text(
        self,
        all: usize,
        name: impl Fn(u16) -> String,
        in_front: impl Fn(u16) -> Option<u16>,
    ) -> String {
        match self {
            Self::Silent => "no frame comes back to either end of the ring".to_owned(),
            Self::OneDirection => {
                "frames cross the ring in one direction only: a cable or an interface is damaged, \
                 and the next broken cable may stop the machine"
                    .to_owned()
            }
            Self::Closed => "the ring is closed: a single broken cable stops nothing".to_owned(),
            Self::Broken { behind, devices } => {
                let all = u16::try_from(all).unwrap_or(u16::MAX).max(devices);
                let missing = all - devices;
                let before = match in_front(behind) {
                    None => "the first interface (`nic`)".to_owned(),
                    Some(before) => format!("`{}`", name(before)),
                };
                let after = match behind + missing {
                    after if after < all => format!("`{}`", name(after)),
                    _ => "the second interface (`redundant`)".to_owned(),
                };
                if missing > 0 {
                    return format!(
                        "the ring is broken between {before} and {after}, and frames do not reach {missing} \
                         of {all} devices"
                    );
                }
                format!(
                    "the ring is broken between {before} and {after}: every device is still reached, \
                     but the next broken cable stops a part of the machine"
                )
            }
        }
    }
}

/// The state of a ring, shared between its link and the rest of the program.
#[derive(Debug, Default)]
pub struct RingStatus {
    /// Of each interface's copy: [`ARRIVED`], [`RETURNED`] and the number of devices.
    copies: [AtomicU64; 2],
    swapped: AtomicBool,
    /// A measurement opens the ring.
    open: AtomicBool,
    /// The network interfaces, first and second.
    carriers: OnceLock<[Carrier; 2]>,
    /// The number of breaks and, in the low 16 bits, the place of the last one.
    breaks: AtomicU64,
}

const ARRIVED: u64 = 1 << 16;
const RETURNED: u64 = 1 << 17;

impl RingStatus {
    /// Returns the status of a closed ring. It lives as long as the process.
    #[must_use]
    pub(in crate::link) fn closed() -> &'static Self {
        let status = Self::default();
        for copy in &status.copies {
            copy.store(ARRIVED, Relaxed);
        }
        Box::leak(Box::new(status))
    }

    /// Sets whether the copy of an interface came back to it and how many devices have processed it;
    /// `None` if it does not arrive.
    pub(super) fn set(&self, from: End, path: Option<(bool, u16)>) {
        let word = path.map_or(0, |(returned, devices)| {
            ARRIVED | if returned { RETURNED } else { 0 } | u64::from(devices)
        });
        let before = self.copies[from as usize].swap(word, Relaxed);
        let breaks = before & (ARRIVED | RETURNED) == ARRIVED && word != before;
        if from == End::First && breaks && !self.is_open_for_measurement() {
            let (count, _) = self.breaks();
            let place = word & 0xffff;
            self.breaks
                .store(u64::from(count.wrapping_add(1)) << 16 | place, Relaxed);
        }
    }

    /// True if the last copy of the second interface has crossed the ring without any device.
    pub(super) fn second_is_idle(&self) -> bool {
        self.copies[1].load(Relaxed) == ARRIVED
    }

    /// Returns how many devices the copy of the first interface passes; the maximum if that is unknown.
    pub(super) fn before(&self) -> u16 {
        let first = self.copies[0].load(Relaxed);
        match self.get() {
            RingState::Broken { behind, .. } => behind,
            RingState::Closed => (first & 0xffff) as u16,
            RingState::Silent | RingState::OneDirection => u16::MAX,
        }
    }

    /// Exchanges the interfaces: the first one is that at the IN port of the first device.
    pub(crate) fn swap(&self) {
        self.swapped.fetch_xor(true, Relaxed);
        for copy in &self.copies {
            copy.store(0, Relaxed);
        }
    }

    /// Returns true if the cables of both interfaces are exchanged.
    #[must_use]
    pub fn swapped(&self) -> bool {
        self.swapped.load(Relaxed)
    }

    #[must_use]
    pub fn get(&self) -> RingState {
        let [first, second] = [&self.copies[0], &self.copies[1]].map(|copy| copy.load(Relaxed));
        let arrived = |word: u64| word & ARRIVED != 0;
        let crossed = |word: u64| arrived(word) && word & RETURNED == 0;
        let devices = |word: u64| (word & 0xffff) as u16;
        match (crossed(first), crossed(second)) {
            (true, true) => RingState::Closed,
            (false, false) if !arrived(first) && !arrived(second) => RingState::Silent,
            // The copy that does not arrive has met no device.
            (false, false) => RingState::Broken {
                behind: devices(first),
                devices: devices(first).saturating_add(devices(second)),
            },
            // The copy of the other interface has not arrived since the break.
            (true, false) if arrived(second) => RingState::Broken {
                behind: devices(first).saturating_sub(devices(second)),
                devices: devices(first),
            },
            (false, true) if arrived(first) => RingState::Broken {
                behind: devices(first),
                devices: devices(first),
            },
            _ => RingState::OneDirection,
        }
    }

    /// Sets the interfaces whose links are read, once.
    pub fn watch(&self, carriers: [Carrier; 2]) {
        let _ = self.carriers.set(carriers);
    }

    /// Returns the name of each interface and whether it has a link. Not for the cycle. Without
    /// network interfaces it is empty.
    pub fn links(&self) -> impl Iterator<Item = (&str, bool)> {
        let carriers = self.carriers.get().into_iter().flatten();
        carriers.map(|carrier| (carrier.nic.as_str(), carrier.has_link()))
    }

    /// Counts no breaks until the result is dropped: a measurement opens the ring.
    pub(crate) fn open_for_measurement(&self) -> OpenRing<'_> {
        self.open.store(true, Relaxed);
        OpenRing(self)
    }

    pub(crate) fn is_open_for_measurement(&self) -> bool {
        self.open.load(Relaxed)
    }

    /// Returns how often the ring was broken, and behind how many devices it was the last time.
    #[must_use]
    pub fn breaks(&self) -> (u32, u16) {
        let word = self.breaks.load(Relaxed);
        ((word >> 16) as u32, (word & 0xffff) as u16)
    }
}

/// A ring during a measurement.
#[derive(Debug)]
pub(crate) struct OpenRing<'a>(&'a RingStatus);

impl Drop for OpenRing<'_> {
    fn drop(&mut self) {
        self.0.open.store(false, Relaxed);
    }
}
