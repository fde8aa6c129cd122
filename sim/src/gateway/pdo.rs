//! PDO communication and mapping parameters (CiA 301 §7.5.2.35 on), for the gateway and its nodes.

use super::dictionary::Dictionary;

/// The first objects of the communication and of the mapping parameters.
pub(super) const RECEIVE: (u16, u16) = (0x1400, 0x1600);
pub(super) const TRANSMIT: (u16, u16) = (0x1800, 0x1a00);

/// COB-ID bit 31: the PDO does not exist.
pub(super) const INVALID: u32 = 0x8000_0000;

/// One PDO. `T` is the location of a mapped object.
#[derive(Debug, Clone)]
pub(super) struct Pdo<T> {
    pub(super) cob: u16,
    /// The transmission type.
    pub(super) kind: u8,
    /// The inhibit time in 0.1 ms.
    pub(super) inhibit: u16,
    /// The event timer in ms.
    pub(super) event_timer: u16,
    /// The location and length in bytes of each mapped object.
    pub(super) map: Vec<(T, u8)>,
    /// The length of all mapped objects, in bytes.
    pub(super) len: usize,
}

impl<T> Pdo<T> {
    /// Loads PDO number `n`, counted from 0. Returns `None` if it is invalid or maps nothing.
    pub(super) fn load(
        dictionary: &Dictionary,
        (communication, mapping): (u16, u16),
        n: u16,
        place: impl Fn(u16, u8) -> Option<T>,
    ) -> Option<Self> {
        let (communication, mapping) = (communication + n, mapping + n);
        let cob = dictionary.get(communication, 1) as u32;
        let count = dictionary.get(mapping, 0).clamp(0, 8) as u8;
        if cob & INVALID != 0 || count == 0 {
            return None;
        }
        let mut pdo = Self {
            cob: (cob & 0x7ff) as u16,
            kind: dictionary.get(communication, 2) as u8,
            inhibit: dictionary.get(communication, 3) as u16,
            event_timer: dictionary.get(communication, 5) as u16,
            map: Vec::with_capacity(usize::from(count)),
            len: 0,
        };
        for sub in 1..=count {
            let (index, sub, bits) = entry(dictionary.get(mapping, sub) as u32);
            let bytes = bits / 8;
            pdo.map.push((place(index, sub)?, bytes));
            pdo.len += usize::from(bytes);
        }
        (pdo.len <= 8).then_some(pdo)
    }

    /// True if the PDO is sent or applied with a SYNC.
    pub(super) fn is_synchronous(&self) -> bool {
        self.kind <= 240
    }
}

/// Returns index, subindex and bits of a mapping entry.
pub(super) fn entry(mapping: u32) -> (u16, u8, u8) {
    let [bits, sub, low, high] = mapping.to_le_bytes();
    (u16::from_le_bytes([low, high]), sub, bits)
}

/// Returns a mapping entry.
pub(super) fn mapping(index: u16, sub: u8, bits: u8) -> i64 {
    i64::from(u32::from(index) << 16 | u32::from(sub) << 8 | u32::from(bits))
}
