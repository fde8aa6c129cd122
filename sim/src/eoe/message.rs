//! EoE messages as bytes (ETG.1000.6 §5.7).

use std::net::Ipv4Addr;

/// Length of the EoE header.
pub(super) const HEADER: usize = 4;
/// Sizes and offsets count in this many bytes.
pub(super) const UNIT: usize = 32;
/// Maximum bytes of an Ethernet frame with a VLAN tag and a check sequence.
const FRAME: usize = 1522;

pub(super) const FRAGMENT: u8 = 0;
pub(super) const TIME_STAMP: u8 = 1;
pub(super) const SET_IP: u8 = 2;
pub(super) const SET_IP_RESPONSE: u8 = 3;
pub(super) const SET_FILTER: u8 = 4;
pub(super) const SET_FILTER_RESPONSE: u8 = 5;
pub(super) const GET_IP: u8 = 6;
pub(super) const GET_IP_RESPONSE: u8 = 7;
pub(super) const GET_FILTER: u8 = 8;
pub(super) const GET_FILTER_RESPONSE: u8 = 9;

/// The EoE header of a fragment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) kind: u8,
    pub(super) port: u8,
    pub(super) last: bool,
    pub(super) time_appended: bool,
    pub(super) time_requested: bool,
    pub(super) fragment: u16,
    /// Size of the frame in the first fragment, offset in the others.
    pub(super) units: u16,
    pub(super) frame: u16,
}

impl Header {
    pub(super) fn parse(body: &[u8]) -> Option<(Self, &[u8])> {
        let (&[kind, flags, low, high], data) = body.split_first_chunk()?;
        let second = u16::from_le_bytes([low, high]);
        let header = Self {
            kind: kind & 0x0f,
            port: kind >> 4,
            last: flags & 1 != 0,
            time_appended: flags & 2 != 0,
            time_requested: flags & 4 != 0,
            fragment: second & 0x3f,
            units: second >> 6 & 0x3f,
            frame: second >> 12,
        };
        Some((header, data))
    }

    pub(super) fn to_bytes(self) -> [u8; HEADER] {
        let second = self.fragment | self.units << 6 | self.frame << 12;
        let [low, high] = second.to_le_bytes();
        let flags = u8::from(self.last)
            | u8::from(self.time_appended) << 1
            | u8::from(self.time_requested) << 2;
        [self.kind | self.port << 4, flags, low, high]
    }

    /// Returns the header of the answer.
    pub(super) fn reply(&self, kind: u8, result: u16) -> Vec<u8> {
        let [low, high] = result.to_le_bytes();
        vec![kind | self.port << 4, 1, low, high]
    }
}

/// The frame that is being put together.
#[derive(Debug, Clone, Default)]
pub(super) struct Assembly {
    bytes: Vec<u8>,
    /// Frame and number of the next fragment.
    next: Option<(u16, u16)>,
}

impl Assembly {
    /// Adds a fragment; returns the frame once it is complete. A fragment that does not continue the
    /// frame drops it.
    pub(super) fn add(&mut self, header: &Header, data: &[u8]) -> Option<Vec<u8>> {
        let data = match header.time_appended {
            true => data.get(..data.len().checked_sub(4)?)?,
            false => data,
        };
        if header.fragment == 0 {
            self.bytes.clear();
        } else {
            let offset = usize::from(header.units) * UNIT;
            let continues = self.next.take() == Some((header.frame, header.fragment));
            if !continues || offset != self.bytes.len() {
                return None;
            }
        }
        self.bytes.extend_from_slice(data);
        if self.bytes.len() > FRAME || !header.last && !data.len().is_multiple_of(UNIT) {
            self.next = None;
            return None;
        }
        if header.last {
            return Some(std::mem::take(&mut self.bytes));
        }
        self.next = Some((header.frame, header.fragment + 1));
        None
    }
}

/// The IP parameters of a device.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Parameters {
    pub(super) mac: Option<[u8; 6]>,
    pub(super) ip: Option<Ipv4Addr>,
    pub(super) netmask: Option<Ipv4Addr>,
    pub(super) gateway: Option<Ipv4Addr>,
    dns: Option<Ipv4Addr>,
    name: Option<Vec<u8>>,
}

fn take<'a>(flags: u8, bit: u8, rest: &mut &'a [u8], length: usize) -> Option<Option<&'a [u8]>> {
    if flags >> bit & 1 == 0 {
        return Some(None);
    }
    let (field, behind) = rest.split_at_checked(length)?;
    *rest = behind;
    Some(Some(field))
}

fn address(bytes: &[u8]) -> Option<Ipv4Addr> {
    let [a, b, c, d] = *bytes.first_chunk()?;
    // Little-endian, so the last part comes first.
    Some(Ipv4Addr::new(d, c, b, a))
}

impl Parameters {
    /// Parses the parameters that are included, one behind the other.
    pub(super) fn parse(data: &[u8]) -> Option<Self> {
        let (&[flags, _, _, _], mut rest) = data.split_first_chunk()?;
        let rest = &mut rest;
        let mac = take(flags, 0, rest, 6)?.and_then(|bytes| bytes.first_chunk().copied());
        let ip = take(flags, 1, rest, 4)?.and_then(address);
        let netmask = take(flags, 2, rest, 4)?.and_then(address);
        let gateway = take(flags, 3, rest, 4)?.and_then(address);
        let dns = take(flags, 4, rest, 4)?.and_then(address);
        let length = rest.len().min(32);
        let name = take(flags, 5, rest, length)?.map(<[u8]>::to_vec);
        Some(Self {
            mac,
            ip,
            netmask,
            gateway,
            dns,
            name,
        })
    }

    pub(super) fn to_bytes(&self) -> Vec<u8> {
        let included = [
            self.mac.is_some(),
            self.ip.is_some(),
            self.netmask.is_some(),
            self.gateway.is_some(),
            self.dns.is_some(),
            self.name.is_some(),
        ];
        let bits = (0..).zip(included);
        let flags: u8 = bits.map(|(bit, on)| u8::from(on) << bit).sum();
        let mut bytes = vec![flags, 0, 0, 0];
        bytes.extend(self.mac.iter().flatten());
        for address in [self.ip, self.netmask, self.gateway, self.dns] {
            bytes.extend(address.iter().flat_map(|address| {
                let [a, b, c, d] = address.octets();
                [d, c, b, a]
            }));
        }
        if let Some(name) = &self.name {
            let mut name = name.clone();
            name.resize(32, 0);
            bytes.extend(name);
        }
        bytes
    }

    /// Takes the parameters that are included.
    pub(super) fn update(&mut self, new: &Self) {
        self.mac = new.mac.or(self.mac);
        self.ip = new.ip.or(self.ip);
        self.netmask = new.netmask.or(self.netmask);
        self.gateway = new.gateway.or(self.gateway);
        self.dns = new.dns.or(self.dns);
        if new.name.is_some() {
            self.name.clone_from(&new.name);
        }
    }
}

/// Length of a MAC filter: its head, 16 places for addresses, 4 for masks.
const FILTER: usize = 2 + 16 * 6 + 4 * 6;

/// Which frames a device passes on to its host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Filter(Vec<u8>);

impl Filter {
    pub(super) fn parse(data: &[u8]) -> Option<Self> {
        data.get(..FILTER).map(|bytes| Self(bytes.to_vec()))
    }

    pub(super) fn to_bytes(&self) -> &[u8] {
        &self.0
    }

    /// Returns true if a frame for this address passes. An address passes that equals one of the
    /// filter, in all bits or in those of a mask.
    pub(super) fn passes(&self, to: &[u8]) -> bool {
        let (head, places) = self.0.split_first().unwrap_or((&0, &[]));
        if to.iter().all(|byte| *byte == 0xff) {
            return head & 0x80 == 0;
        }
        let lists = places.get(1..).unwrap_or_default();
        let addresses = lists.chunks_exact(6);
        let masks = addresses.clone().skip(16).take(usize::from(head >> 4 & 3));
        let masks: Vec<_> = std::iter::once(&[0xff; 6][..]).chain(masks).collect();
        addresses.take(usize::from(head & 0x0f)).any(|address| {
            masks.iter().any(|mask| {
                let bytes = address.iter().zip(to).zip(*mask);
                bytes.into_iter().all(|((a, b), mask)| (a ^ b) & mask == 0)
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two addresses and one mask; broadcasts pass unless the highest bit is set.
    #[test]
    fn filter_passes_addresses_and_masks() {
        let mut bytes = vec![0; FILTER];
        bytes[..8].copy_from_slice(&[0x12, 0, 1, 0x80, 0xc2, 0, 0, 0x0e]);
        bytes[8..14].copy_from_slice(&[1, 0, 0x5e, 0, 0, 0]);
        bytes[98..104].copy_from_slice(&[0xff, 0xff, 0xff, 0, 0, 0]);
        let filter = Filter::parse(&bytes).expect("a filter");
        for (to, passes) in [
            ([1, 0x80, 0xc2, 0, 0, 0x0e], true),
            ([1, 0x80, 0xc2, 9, 9, 9], true),
            ([1, 0, 0x5e, 1, 2, 3], true),
            ([1, 0, 0x5f, 0, 0, 0], false),
            ([0; 6], false),
            ([0xff; 6], true),
        ] {
            assert_eq!(filter.passes(&to), passes, "{to:02x?}");
        }
        bytes[0] = 0x81;
        let filter = Filter::parse(&bytes).expect("a filter");
        assert!(!filter.passes(&[0xff; 6]));
        assert!(filter.passes(&[1, 0x80, 0xc2, 0, 0, 0x0e]));
        assert!(!filter.passes(&[1, 0x80, 0xc2, 9, 9, 9]), "no mask");
        assert_eq!(filter.to_bytes(), bytes);
        assert_eq!(Filter::parse(&bytes[..FILTER - 1]), None);
    }
}
