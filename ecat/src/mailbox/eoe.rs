//! EoE messages (ETG.1000.6 clause 5.7): Ethernet frames in fragments, IP parameters, MAC filters
//! and time stamps. Both sides send fragments; a MainDevice sends the requests.
//!
//! ```
//! use ecaxis_ecat::mailbox::Encode;
//! use ecaxis_ecat::mailbox::eoe::{Fragments, Message, Reassembler, Service};
//!
//! let frame = [0x5a; 200];
//! let mut reassembler = Reassembler::default();
//! let mut bytes = Vec::new();
//! let mut complete = None;
//! for fragment in Fragments::new(&frame, 1, 128) {
//!     Message::from(Service::Fragment(fragment)).emit(1, 128, &mut bytes);
//!     if let Ok(Message { service: Service::Fragment(fragment), .. }) = Message::parse(&bytes) {
//!         complete = reassembler.add(&fragment).map(<[u8]>::to_vec);
//!     }
//! }
//! assert_eq!(complete.as_deref(), Some(&frame[..]));
//! ```

use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;
use core::net::Ipv4Addr;

use super::{DecodeError, Encode, HEADER, Mailbox, TYPE_EOE, TYPE_ERROR};

mod fragments;

pub use fragments::{Fragments, MAX_FRAME, MIN_FRAME, Reassembler, ReassemblyCounters};

/// The length in bytes of the EoE header (ETG.1000.6 Table 65).
pub const EOE_HEADER: usize = 4;
/// Sizes and offsets of fragments count in this many bytes.
pub const UNIT: usize = 32;
/// The length in bytes of the name in the IP parameters.
pub const NAME: usize = 32;
/// The maximum number of MAC filters and of masks, by the bits of their counts.
pub const MAX_FILTERS: (usize, usize) = (15, 3);

const FRAGMENT: u16 = 0;
const TIME_STAMP: u16 = 1;
const SET_IP: u16 = 2;
const SET_IP_RESPONSE: u16 = 3;
const SET_FILTER: u16 = 4;
const SET_FILTER_RESPONSE: u16 = 5;
const GET_IP: u16 = 6;
const GET_IP_RESPONSE: u16 = 7;
const GET_FILTER: u16 = 8;
const GET_FILTER_RESPONSE: u16 = 9;

/// Bits of the first word of the header.
const LAST: u16 = 1 << 8;
const TIME_APPENDED: u16 = 1 << 9;
const TIME_REQUESTED: u16 = 1 << 10;

/// The result of a request: done.
pub const RESULT_OK: u16 = 0;
/// The result of a request: the frame type is not supported.
pub const RESULT_UNSUPPORTED_TYPE: u16 = 2;

/// Returns the text of a result code (ETG.1000.6 Table 70).
#[must_use]
pub fn result_text(code: u16) -> &'static str {
    match code {
        RESULT_OK => "done",
        0x0001 => "unspecified error",
        RESULT_UNSUPPORTED_TYPE => "the frame type is not supported",
        0x0201 => "the device does not support IP",
        0x0202 => "the device does not support DHCP",
        0x0401 => "the device does not support MAC filters",
        _ => "unknown result code",
    }
}

/// A MAC address.
pub type MacAddress = [u8; 6];

/// Returns a MAC address as `02:00:00:00:00:01`.
#[must_use]
pub fn format_mac(mac: MacAddress) -> String {
    mac.map(|byte| format!("{byte:02x}")).join(":")
}

/// One EoE message, or another message in the mailbox of an EoE device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message<'a> {
    /// The port of the device; 0 is unspecified.
    pub port: u8,
    /// The message.
    pub service: Service<'a>,
}

/// The contents of an EoE message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Service<'a> {
    /// A part of an Ethernet frame.
    Fragment(Fragment<'a>),
    /// The time at which the device has sent a frame, in ns.
    TimeStamp {
        /// The number of the frame that requested it, 0 to 15.
        frame: u8,
        /// The lower half of the system time.
        time: u32,
    },
    /// Sets IP parameters.
    SetIp(IpParameters),
    /// The result of [`Service::SetIp`].
    SetIpResponse(u16),
    /// Sets the MAC filter.
    SetFilter(MacFilter),
    /// The result of [`Service::SetFilter`].
    SetFilterResponse(u16),
    /// Requests the IP parameters.
    GetIp,
    /// The IP parameters of a device.
    GetIpResponse {
        /// [`RESULT_OK`], or why there are no parameters.
        result: u16,
        /// The parameters.
        parameters: IpParameters,
    },
    /// Requests the MAC filter.
    GetFilter,
    /// The MAC filter of a device.
    GetFilterResponse {
        /// [`RESULT_OK`], or why there is no filter.
        result: u16,
        /// The filter.
        filter: MacFilter,
    },
    /// A frame type that the standard does not define.
    Unknown(u8),
    /// The SubDevice's mailbox rejected a message, with this code.
    Refused(u16),
    /// Another protocol.
    Other,
}

/// A part of an Ethernet frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fragment<'a> {
    /// The number of the frame, 0 to 15.
    pub frame: u8,
    /// The number of the fragment, 0 to 63.
    pub number: u8,
    /// In the first fragment the size of the frame, in further ones the offset of the data, in
    /// units of [`UNIT`] bytes, 0 to 63.
    pub units: u8,
    /// True for the last fragment of a frame.
    pub last: bool,
    /// The time at which the frame arrived at the device's port, in ns; only in the last fragment.
    pub time: Option<u32>,
    /// True if the time of sending is requested.
    pub time_requested: bool,
    /// The data; a multiple of [`UNIT`] bytes except in the last fragment.
    pub data: &'a [u8],
}

/// The IP parameters of a device; `None` is not included.
///
/// Stacks disagree whether a parameter that is not included occupies its place. Both readings agree
/// if the included parameters have no gap.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct IpParameters {
    /// The MAC address.
    pub mac: Option<MacAddress>,
    /// The IP address.
    pub ip: Option<Ipv4Addr>,
    /// The subnet mask.
    pub netmask: Option<Ipv4Addr>,
    /// The default gateway.
    pub gateway: Option<Ipv4Addr>,
    /// The DNS server.
    pub dns: Option<Ipv4Addr>,
    /// The DNS name, with NULs behind it.
    pub name: Option<[u8; NAME]>,
}

impl IpParameters {
    /// The length of the flags and all parameters.
    const LENGTH: usize = 4 + 6 + 4 * 4 + NAME;

    fn flags(&self) -> u32 {
        let included = [
            self.mac.is_some(),
            self.ip.is_some(),
            self.netmask.is_some(),
            self.gateway.is_some(),
            self.dns.is_some(),
            self.name.is_some(),
        ];
        let bits = (0..).zip(included);
        bits.fold(0, |flags, (bit, included)| {
            flags | u32::from(included) << bit
        })
    }

    fn emit(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(&self.flags().to_le_bytes());
        out.extend(self.mac.iter().flatten());
        for address in [self.ip, self.netmask, self.gateway, self.dns] {
            // A DWORD, little-endian like all others.
            out.extend(
                address
                    .iter()
                    .flat_map(|address| address.octets().into_iter().rev()),
            );
        }
        out.extend(self.name.iter().flatten());
    }

    fn parse(body: &[u8]) -> Result<Self, DecodeError> {
        let short = || DecodeError::Short {
            what: "EoE IP parameters",
            length: body.len(),
        };
        let (flags, mut rest) = body.split_first_chunk().ok_or_else(short)?;
        let flags = u32::from_le_bytes(*flags);
        let included = |bit: u32| flags >> bit & 1 != 0;
        let lengths = [6, 4, 4, 4, 4, NAME];
        let sum: usize = (0..)
            .zip(lengths)
            .filter_map(|(bit, length)| included(bit).then_some(length))
            .sum();
        // With parameters at fixed places, the message has the length of all of them.
        let fixed = body.len() >= Self::LENGTH && 4 + sum != body.len();
        let mut take = |bit: u32, length: usize| -> Result<Option<&[u8]>, DecodeError> {
            if !included(bit) && !fixed {
                return Ok(None);
            }
            // A name may be shorter than its place.
            let length = match bit {
                5 => length.min(rest.len()),
                _ => length,
            };
            let (field, behind) = rest.split_at_checked(length).ok_or_else(short)?;
            rest = behind;
            Ok(included(bit).then_some(field))
        };
        let mac = take(0, 6)?.and_then(|bytes| bytes.first_chunk().copied());
        let mut address = |bit| {
            let bytes = take(bit, 4)?.and_then(|bytes| bytes.first_chunk::<4>());
            Ok(bytes.map(|bytes| Ipv4Addr::from_bits(u32::from_le_bytes(*bytes))))
        };
        let (ip, netmask, gateway, dns) = (address(1)?, address(2)?, address(3)?, address(4)?);
        let name = take(5, NAME)?.map(|bytes| {
            let mut name = [0; NAME];
            for (to, from) in name.iter_mut().zip(bytes) {
                *to = *from;
            }
            name
        });
        Ok(Self {
            mac,
            ip,
            netmask,
            gateway,
            dns,
            name,
        })
    }
}

/// Which Ethernet frames a device passes on.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MacFilter {
    /// Addresses that pass, at most 15.
    pub filters: Vec<MacAddress>,
    /// Masks of addresses, at most 3.
    pub masks: Vec<MacAddress>,
    /// True if broadcasts do not pass.
    pub no_broadcasts: bool,
}

impl MacFilter {
    /// The places for filters and masks.
    const PLACES: (usize, usize) = (16, 4);
    const NO_BROADCASTS: u8 = 1 << 7;

    fn emit(&self, out: &mut Vec<u8>) {
        let filters = self.filters.get(..MAX_FILTERS.0).unwrap_or(&self.filters);
        let masks = self.masks.get(..MAX_FILTERS.1).unwrap_or(&self.masks);
        let count = |addresses: &[MacAddress]| u8::try_from(addresses.len()).unwrap_or(0);
        let broadcasts = match self.no_broadcasts {
            true => Self::NO_BROADCASTS,
            false => 0,
        };
        out.extend_from_slice(&[count(filters) | count(masks) << 4 | broadcasts, 0]);
        for (addresses, places) in [(filters, Self::PLACES.0), (masks, Self::PLACES.1)] {
            out.extend(addresses.iter().flatten());
            out.resize(out.len() + 6 * places.saturating_sub(addresses.len()), 0);
        }
    }

    fn parse(body: &[u8]) -> Result<Self, DecodeError> {
        let short = DecodeError::Short {
            what: "an EoE MAC filter",
            length: body.len(),
        };
        let ([options, _], rest) = body.split_first_chunk().ok_or(short)?;
        let (filters, rest) =
            rest.split_at_checked(6 * Self::PLACES.0)
                .ok_or(DecodeError::Short {
                    what: "an EoE MAC filter",
                    length: body.len(),
                })?;
        let addresses = |bytes: &[u8], count: u8| -> Vec<MacAddress> {
            let (all, _) = bytes.as_chunks();
            all.iter().take(usize::from(count)).copied().collect()
        };
        Ok(Self {
            filters: addresses(filters, options & 0x0f),
            masks: addresses(rest, options >> 4 & 3),
            no_broadcasts: options & Self::NO_BROADCASTS != 0,
        })
    }
}

impl<'a> From<Service<'a>> for Message<'a> {
    fn from(service: Service<'a>) -> Self {
        Self { port: 0, service }
    }
}

impl<'a> Message<'a> {
    /// The bytes of a request that sets the MAC filter, with the headers.
    pub const FILTER_REQUEST: usize = HEADER + EOE_HEADER + 2 + 6 * (16 + 4);

    /// Returns the bytes of a message, with the headers.
    #[must_use]
    pub fn length(&self) -> usize {
        let mut bytes = Vec::new();
        self.emit(0, 6, &mut bytes);
        let body = bytes.first_chunk().map_or(0, |n| u16::from_le_bytes(*n));
        HEADER + usize::from(body)
    }

    /// Parses one whole mailbox.
    ///
    /// # Errors
    /// [`DecodeError`] if the message is inconsistent.
    pub fn parse(mailbox: &'a [u8]) -> Result<Self, DecodeError> {
        let mailbox = Mailbox::parse(mailbox)?;
        let body = match mailbox.protocol {
            TYPE_EOE => mailbox.body,
            TYPE_ERROR => return Ok(Service::Refused(mailbox.error_code()?).into()),
            _ => return Ok(Service::Other.into()),
        };
        let Some((&[a, b, c, d], data)) = body.split_first_chunk() else {
            return Err(DecodeError::Short {
                what: "an EoE message",
                length: body.len(),
            });
        };
        let (first, second) = (u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d]));
        let service = match first & 0x0f {
            FRAGMENT => Service::Fragment(Fragment::parse(first, second, data)?),
            TIME_STAMP => match data.first_chunk() {
                Some(time) => Service::TimeStamp {
                    frame: frame_number(second),
                    time: u32::from_le_bytes(*time),
                },
                None => {
                    return Err(DecodeError::Short {
                        what: "an EoE time stamp",
                        length: data.len(),
                    });
                }
            },
            SET_IP => Service::SetIp(IpParameters::parse(data)?),
            SET_IP_RESPONSE => Service::SetIpResponse(second),
            SET_FILTER => Service::SetFilter(MacFilter::parse(data)?),
            SET_FILTER_RESPONSE => Service::SetFilterResponse(second),
            GET_IP => Service::GetIp,
            GET_IP_RESPONSE => Service::GetIpResponse {
                result: second,
                parameters: match (second, data) {
                    (1.., []) => IpParameters::default(),
                    _ => IpParameters::parse(data)?,
                },
            },
            GET_FILTER => Service::GetFilter,
            GET_FILTER_RESPONSE => Service::GetFilterResponse {
                result: second,
                filter: match (second, data) {
                    (1.., []) => MacFilter::default(),
                    _ => MacFilter::parse(data)?,
                },
            },
            other => Service::Unknown(u8::try_from(other).unwrap_or(0)),
        };
        let port = a >> 4;
        Ok(Self { port, service })
    }
}

/// [`Service::Refused`], [`Service::Other`] and [`Service::Unknown`] write an empty mailbox.
impl Encode for Message<'_> {
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>) {
        let (kind, second) = match &self.service {
            Service::Fragment(fragment) => fragment.header(),
            Service::TimeStamp { frame, .. } => (TIME_STAMP, u16::from(*frame) << 12),
            Service::SetIp(_) => (SET_IP, 0),
            Service::SetIpResponse(result) => (SET_IP_RESPONSE, *result),
            Service::SetFilter(_) => (SET_FILTER, 0),
            Service::SetFilterResponse(result) => (SET_FILTER_RESPONSE, *result),
            Service::GetIp => (GET_IP, 0),
            Service::GetIpResponse { result, .. } => (GET_IP_RESPONSE, *result),
            Service::GetFilter => (GET_FILTER, 0),
            Service::GetFilterResponse { result, .. } => (GET_FILTER_RESPONSE, *result),
            Service::Unknown(_) | Service::Refused(_) | Service::Other => {
                out.clear();
                return out.resize(usize::from(mailbox), 0);
            }
        };
        // Requests and responses are a single fragment.
        let last = match &self.service {
            Service::Fragment(_) => 0,
            _ => LAST,
        };
        let first = kind | u16::from(self.port & 0x0f) << 4 | last;
        super::emit(TYPE_EOE, counter, mailbox, out, |out| {
            out.extend_from_slice(&first.to_le_bytes());
            out.extend_from_slice(&second.to_le_bytes());
            match &self.service {
                Service::Fragment(fragment) => {
                    out.extend_from_slice(fragment.data);
                    out.extend(fragment.time.iter().flat_map(|time| time.to_le_bytes()));
                }
                Service::TimeStamp { time, .. } => out.extend_from_slice(&time.to_le_bytes()),
                Service::SetIp(parameters) | Service::GetIpResponse { parameters, .. } => {
                    parameters.emit(out);
                }
                Service::SetFilter(filter) | Service::GetFilterResponse { filter, .. } => {
                    filter.emit(out);
                }
                _ => {}
            }
        });
    }
}

fn frame_number(second: u16) -> u8 {
    second.to_be_bytes()[0] >> 4
}

impl<'a> Fragment<'a> {
    fn parse(first: u16, second: u16, data: &'a [u8]) -> Result<Self, DecodeError> {
        let bits = |from: u32| u8::try_from(second >> from & 0x3f).unwrap_or(0);
        let (data, time) = match first & TIME_APPENDED {
            0 => (data, None),
            _ => match data.split_last_chunk() {
                Some((data, time)) => (data, Some(u32::from_le_bytes(*time))),
                None => {
                    return Err(DecodeError::Short {
                        what: "an EoE fragment with its time",
                        length: data.len(),
                    });
                }
            },
        };
        Ok(Self {
            frame: frame_number(second),
            number: bits(0),
            units: bits(6),
            last: first & LAST != 0,
            time,
            time_requested: first & TIME_REQUESTED != 0,
            data,
        })
    }

    fn header(&self) -> (u16, u16) {
        let bit = |set: bool, bit: u16| if set { bit } else { 0 };
        let first = FRAGMENT
            | bit(self.last, LAST)
            | bit(self.time.is_some(), TIME_APPENDED)
            | bit(self.time_requested, TIME_REQUESTED);
        let second = u16::from(self.number & 0x3f)
            | u16::from(self.units & 0x3f) << 6
            | u16::from(self.frame & 0x0f) << 12;
        (first, second)
    }
}

#[cfg(test)]
mod tests;
