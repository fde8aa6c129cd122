//! pcapng: sections of blocks; each block has a type, and its length at both ends
//! (<https://www.ietf.org/archive/id/draft-ietf-opsawg-pcapng-02.html>).

use std::io::Read;

use super::window::{ByteOrder, PeekReader};
use super::{Direction, MAX_PACKET, Packet, Step};

pub(super) const SECTION: u32 = 0x0a0d_0d0a;
const MAGIC: u32 = 0x1a2b_3c4d;
const INTERFACE: u32 = 1;
/// The obsolete predecessor of enhanced packets.
const PACKET: u32 = 2;
const SIMPLE: u32 = 3;
const ENHANCED: u32 = 6;
/// Type, length, length.
const EMPTY: usize = 12;
/// The maximum block size. Blocks without packets (names, statistics, secrets) may be longer than a
/// packet.
const MAX_BLOCK: usize = 64 << 20;
/// The maximum number of interfaces; packets of others have an unknown link type.
const MAX_INTERFACES: usize = 1024;

const OPTION_END: u16 = 0;
const EPB_FLAGS: u16 = 2;
const IF_TSRESOL: u16 = 9;
const IF_TSOFFSET: u16 = 14;

#[derive(Debug, Clone, Copy)]
struct Interface {
    link_type: u16,
    /// As in `if_tsresol`: a negative power of ten, or of two with the highest bit set.
    resolution: u8,
    offset_s: i64,
}

#[derive(Debug)]
pub(super) struct Pcapng {
    order: ByteOrder,
    interfaces: Vec<Interface>,
}

impl Default for Pcapng {
    fn default() -> Self {
        Self {
            order: ByteOrder::Little,
            interfaces: Vec::new(),
        }
    }
}

impl Pcapng {
    /// Returns type, length and byte order of a plausible block header. Only a section header
    /// contains the byte order.
    fn head(&self, head: &[u8]) -> Option<(u32, usize, ByteOrder)> {
        if head.len() < EMPTY {
            return None;
        }
        // The type is the same in both byte orders.
        let order = if ByteOrder::Little.u32(head, 0) == SECTION {
            let of = |order: ByteOrder| (order.u32(head, 8) == MAGIC).then_some(order);
            of(ByteOrder::Little).or_else(|| of(ByteOrder::Big))?
        } else {
            self.order
        };
        let kind = order.u32(head, 0);
        let len = usize::try_from(order.u32(head, 4)).ok()?;
        let most = if matches!(kind, PACKET | SIMPLE | ENHANCED) {
            MAX_PACKET
        } else {
            MAX_BLOCK
        };
        (len >= EMPTY && len.is_multiple_of(4) && len <= most).then_some((kind, len, order))
    }

    pub fn step<R: Read>(&mut self, window: &mut PeekReader<R>) -> Step {
        let head = window.fill(EMPTY);
        match head.len() {
            0 => return Step::End,
            EMPTY => {}
            _ => return Step::Truncated,
        }
        let Some((kind, len, order)) = self.head(head) else {
            return Step::Damaged;
        };
        if !matches!(kind, SECTION | INTERFACE | PACKET | SIMPLE | ENHANCED) {
            return if window.take(len) < len {
                Step::Truncated
            } else {
                Step::Skip
            };
        }
        let block = window.fill(len);
        if block.len() < len {
            return Step::Truncated;
        }
        if usize::try_from(order.u32(block, len - 4)) != Ok(len) {
            return Step::Damaged;
        }
        let body = block.get(8..len - 4).unwrap_or_default();
        let step = match kind {
            SECTION => {
                self.order = order;
                self.interfaces.clear();
                Step::Skip
            }
            INTERFACE => {
                if self.interfaces.len() < MAX_INTERFACES {
                    self.interfaces.push(interface(order, body));
                }
                Step::Skip
            }
            _ => self.packet(kind, body).map_or(Step::Damaged, Step::Packet),
        };
        if !matches!(step, Step::Damaged) {
            window.take(len);
        }
        step
    }

    fn packet(&self, kind: u32, body: &[u8]) -> Option<Packet> {
        let word = |at| self.order.u32(body, at);
        let (interface, fixed, kept, original): (u32, usize, u32, u32) = match kind {
            ENHANCED => (word(0), 20, word(12), word(16)),
            PACKET => (u32::from(self.order.u16(body, 0)), 20, word(12), word(16)),
            // Limited by the interface's snapshot length only.
            _ => {
                let there = u32::try_from(body.len().saturating_sub(4)).ok()?;
                (0, 4, word(0).min(there), word(0))
            }
        };
        let kept = usize::try_from(kept).ok()?;
        let data = body.get(fixed..fixed.checked_add(kept)?)?.to_vec();
        let known = usize::try_from(interface)
            .ok()
            .and_then(|n| self.interfaces.get(n));
        let at = (kind != SIMPLE).then(|| {
            let raw = u64::from(word(4)) << 32 | u64::from(word(8));
            known.map_or(0, |interface| interface.nanos(raw))
        });
        let options = body
            .get(fixed + kept.next_multiple_of(4)..)
            .unwrap_or_default();
        let flags = option(self.order, options, EPB_FLAGS).map(|flags| self.order.u32(flags, 0));
        let direction = match flags.filter(|_| kind == ENHANCED).map(|flags| flags & 3) {
            Some(1) => Some(Direction::In),
            Some(2) => Some(Direction::Out),
            _ => None,
        };
        Some(Packet {
            number: 0,
            at,
            interface,
            link_type: known.map_or(u16::MAX, |interface| interface.link_type),
            direction,
            data,
            original_len: usize::try_from(original).ok()?,
        })
    }

    /// True if a block of known type begins here with the same length at both ends.
    pub fn sound<R: Read>(&mut self, window: &mut PeekReader<R>) -> bool {
        let Some((kind, len, order)) = self.head(window.fill(EMPTY)) else {
            return false;
        };
        // Unknown types and long blocks do not prove a block boundary.
        matches!(kind, SECTION | INTERFACE | PACKET | SIMPLE | ENHANCED)
            && len <= MAX_PACKET
            && usize::try_from(order.u32(window.fill(len), len - 4)) == Ok(len)
    }
}

impl Interface {
    /// Converts a timestamp to ns since 1970, limited to the representable range.
    fn nanos(&self, raw: u64) -> u64 {
        let raw = u128::from(raw);
        let exponent = u32::from(self.resolution & 0x7f);
        let nanos = if self.resolution & 0x80 != 0 {
            (raw * 1_000_000_000).checked_shr(exponent).unwrap_or(0)
        } else if exponent <= 9 {
            raw * 10_u128.pow(9 - exponent)
        } else {
            10_u128
                .checked_pow(exponent - 9)
                .map_or(0, |unit| raw / unit)
        };
        let nanos = i128::try_from(nanos).unwrap_or(i128::MAX);
        let nanos = nanos.saturating_add(i128::from(self.offset_s) * 1_000_000_000);
        u64::try_from(nanos.max(0)).unwrap_or(u64::MAX)
    }
}

fn interface(order: ByteOrder, body: &[u8]) -> Interface {
    let options = body.get(8..).unwrap_or_default();
    let offset = option(order, options, IF_TSOFFSET).and_then(<[u8]>::first_chunk::<8>);
    Interface {
        link_type: order.u16(body, 0),
        resolution: option(order, options, IF_TSRESOL)
            .and_then(|value| value.first().copied())
            .unwrap_or(6),
        offset_s: offset.map_or(0, |bytes| match order {
            ByteOrder::Little => i64::from_le_bytes(*bytes),
            ByteOrder::Big => i64::from_be_bytes(*bytes),
        }),
    }
}

/// Returns the value of the first option with this code.
fn option(order: ByteOrder, mut options: &[u8], wanted: u16) -> Option<&[u8]> {
    while options.len() >= 4 {
        let code = order.u16(options, 0);
        let len = usize::from(order.u16(options, 2));
        if code == OPTION_END {
            return None;
        }
        let value = options.get(4..4 + len)?;
        if code == wanted {
            return Some(value);
        }
        options = options.get(4 + len.next_multiple_of(4)..)?;
    }
    None
}
