//! pcap, the older format: a head of 24 bytes, then records of 16 bytes and a packet
//! (<https://www.ietf.org/archive/id/draft-ietf-opsawg-pcap-04.html>).

use std::io::Read;

use super::window::{ByteOrder, PeekReader};
use super::{MAX_PACKET, Packet, Step};

const MICROS: u32 = 0xa1b2_c3d4;
const NANOS: u32 = 0xa1b2_3c4d;
const RECORD: usize = 16;
/// The maximum distance of consecutive records in s; used to resynchronize after damage.
const APART_S: u32 = 86_400;

#[derive(Debug)]
pub(super) struct Pcap {
    order: ByteOrder,
    /// True if fractions of a second are in ns.
    nanos: bool,
    link_type: u16,
    seconds: Option<u32>,
}

impl Pcap {
    pub fn new(head: &[u8]) -> Option<Self> {
        let head = head.get(..24)?;
        let of = |order: ByteOrder| match order.u32(head, 0) {
            MICROS => Some((order, false)),
            NANOS => Some((order, true)),
            _ => None,
        };
        let (order, nanos) = of(ByteOrder::Little).or_else(|| of(ByteOrder::Big))?;
        Some(Self {
            order,
            nanos,
            // The upper half contains the length of the FCS.
            link_type: (order.u32(head, 20) & 0xffff) as u16,
            seconds: None,
        })
    }

    /// Returns (seconds, fraction, stored bytes, packet bytes) of a plausible record header.
    fn head(&self, head: &[u8]) -> Option<(u32, u32, usize, usize)> {
        let field = |n: usize| self.order.u32(head, 4 * n);
        let kept = usize::try_from(field(2)).ok()?;
        let original = usize::try_from(field(3)).ok()?;
        let limit = if self.nanos { 1_000_000_000 } else { 1_000_000 };
        let good = head.len() >= RECORD && kept <= MAX_PACKET && field(1) < limit;
        good.then_some((field(0), field(1), kept, original))
    }

    pub fn step<R: Read>(&mut self, window: &mut PeekReader<R>) -> Step {
        let head = window.fill(RECORD);
        match head.len() {
            0 => return Step::End,
            RECORD => {}
            _ => return Step::Truncated,
        }
        let Some((seconds, fraction, kept, original_len)) = self.head(head) else {
            return Step::Damaged;
        };
        let Some(data) = window.fill(RECORD + kept).get(RECORD..RECORD + kept) else {
            return Step::Truncated;
        };
        let data = data.to_vec();
        window.take(RECORD + kept);
        self.seconds = Some(seconds);
        let nanos = if self.nanos { 1 } else { 1_000 } * u64::from(fraction);
        Step::Packet(Packet {
            number: 0,
            at: Some(u64::from(seconds) * 1_000_000_000 + nanos),
            interface: 0,
            link_type: self.link_type,
            direction: None,
            data,
            original_len,
        })
    }

    /// True if a record begins here and is followed by another one or the end of the file.
    pub fn sound<R: Read>(&mut self, window: &mut PeekReader<R>) -> bool {
        let near = |seconds: u32| self.seconds.is_none_or(|s| s.abs_diff(seconds) <= APART_S);
        let follows = |head: &[u8]| {
            let fields = self.head(head)?;
            (near(fields.0) && fields.2 <= fields.3 && fields.2 >= 14).then_some(fields.2)
        };
        let Some(kept) = follows(window.fill(RECORD)) else {
            return false;
        };
        let both = window.fill(RECORD + kept + RECORD);
        match both.get(RECORD + kept..) {
            None => false,
            Some([]) => true,
            Some(next) => follows(next).is_some(),
        }
    }
}
