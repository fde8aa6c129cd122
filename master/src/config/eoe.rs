//! Ethernet over EtherCAT: the TAP interface, and the IP parameters of devices.

use std::fmt;
use std::net::Ipv4Addr;

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::mailbox::eoe::{
    IpParameters, MAX_FILTERS, MacAddress, MacFilter, Message, NAME, format_mac,
};
use ecaxis_esi as esi;
use sha2::{Digest as _, Sha256};

use super::fields::{Key, KeyExt as _};
use super::problem::Problems;
use super::raw::{RawDevice, RawDeviceEoe, RawEoe};
use super::{Bus, DeviceConfig, Nic};

/// The length of the longest name of an interface (linux/if.h: IFNAMSIZ).
const INTERFACE_NAME: usize = 15;

/// The TAP interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TapSetup {
    /// The name of the interface.
    pub name: String,
    /// The address of this computer, and the length of its prefix.
    pub address: Option<(Ipv4Addr, u8)>,
}

/// Shows `interface ecat0, 192.168.7.1/24`.
impl fmt::Display for TapSetup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "interface {}", self.name)?;
        match self.address {
            Some((address, prefix)) => write!(f, ", {address}/{prefix}"),
            None => f.write_str(", without an address"),
        }
    }
}

/// The port of a device at the virtual switch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EoeSetup {
    /// The parameters that the device gets in PreOp; `None`: it keeps its own.
    pub parameters: Option<IpParameters>,
    /// The MAC filter that the device gets in PreOp; `None`: it keeps its own.
    pub filter: Option<MacFilter>,
    /// True if the device sends the times of frames.
    pub time_stamps: bool,
}

/// Shows `192.168.7.11/24, MAC 02:45:43:01:02:03`.
impl fmt::Display for EoeSetup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.parameters {
            Some(parameters) => format_parameters(parameters, f)?,
            None => f.write_str("its own IP parameters")?,
        }
        if let Some(filter) = &self.filter {
            write!(f, ", {}", format_filter(filter))?;
        }
        if self.time_stamps {
            f.write_str(", with time stamps")?;
        }
        Ok(())
    }
}

fn format_parameters(parameters: &IpParameters, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    if let (Some(ip), Some(mask)) = (parameters.ip, parameters.netmask) {
        write!(f, "{ip}/{}, ", mask.to_bits().count_ones())?;
    }
    let mac = parameters.mac.unwrap_or_default();
    write!(f, "MAC {}", format_mac(mac))?;
    if let Some(gateway) = parameters
        .gateway
        .filter(|gateway| !gateway.is_unspecified())
    {
        write!(f, ", gateway {gateway}")?;
    }
    if let Some(dns) = parameters.dns.filter(|dns| !dns.is_unspecified()) {
        write!(f, ", DNS server {dns}")?;
    }
    if let Some(name) = &parameters.name {
        let name = name.split(|byte| *byte == 0).next().unwrap_or_default();
        write!(f, ", name {}", String::from_utf8_lossy(name))?;
    }
    Ok(())
}

/// Returns a MAC filter as `MAC filter 01:80:c2:00:00:0e, no broadcasts`.
fn format_filter(filter: &MacFilter) -> String {
    let list = |addresses: &[MacAddress]| {
        let each = addresses.iter().map(|mac| format_mac(*mac));
        each.collect::<Vec<_>>().join(" ")
    };
    let mut text = match filter.filters.is_empty() {
        true => "MAC filter without addresses".to_owned(),
        false => format!("MAC filter {}", list(&filter.filters)),
    };
    if !filter.masks.is_empty() {
        text += &format!(", masks {}", list(&filter.masks));
    }
    if filter.no_broadcasts {
        text += ", no broadcasts";
    }
    text
}

/// Returns the TAP interface; `None` if it is invalid and has been reported.
pub(super) fn tap(
    raw: &RawEoe,
    bus: Option<&Bus>,
    devices: &IndexVec<DeviceIndex, DeviceConfig>,
    p: &mut Problems<'_>,
) -> Option<TapSetup> {
    let tap = raw.tap.as_ref()?;
    let (name, at) = (tap.get_ref(), tap.span());
    let known = |c: char| c.is_ascii_alphanumeric() || "_.-".contains(c);
    let valid = !name.is_empty()
        && name.len() <= INTERFACE_NAME
        && name.chars().all(known)
        && name.starts_with(|c: char| c.is_ascii_alphanumeric());
    if !valid {
        let message = format!("\"{name}\" is not the name of an interface");
        let hint = "write up to 15 letters and digits, such as `tap = \"ecat0\"`";
        p.add_hint(at.clone(), message, hint);
    }
    let of_bus = bus.is_some_and(|bus| {
        bus.nic == Nic::Interface(name.clone()) || bus.redundant.as_ref() == Some(name)
    });
    if of_bus {
        let message = format!("`{name}` is the interface of the bus");
        p.add_hint(
            at.clone(),
            message,
            "write another name, such as `tap = \"ecat0\"`",
        );
    }
    let connected = || {
        devices
            .iter()
            .filter_map(|device| Some((device, device.eoe.as_ref()?)))
    };
    if connected().next().is_none() && !devices.is_empty() {
        let message = "no device is connected with the TAP interface";
        let hint = "add `eoe = { ip = \"192.168.7.11\" }` to a [[device]] with EoE";
        p.add_hint(at, message, hint);
    }
    let mut address = None;
    if let Some(text) = &raw.address {
        address = prefixed(text.get_ref());
        let Some((own, prefix)) = address else {
            let message = format!(
                "\"{}\" is not an IPv4 address with its prefix",
                text.get_ref()
            );
            let hint = "write `address = \"192.168.7.1/24\"`";
            p.add_hint(text.span(), message, hint);
            return None;
        };
        let mask = u32::MAX << (32 - u32::from(prefix));
        for (device, eoe) in connected() {
            let ip = eoe.parameters.and_then(|parameters| parameters.ip);
            let Some(ip) = ip else { continue };
            let problem = if ip == own {
                format!("{own} is the address of `{}` as well", device.name)
            } else if (ip.to_bits() ^ own.to_bits()) & mask != 0 {
                format!(
                    "`{}` ({ip}) is not in the subnet of {own}/{prefix}",
                    device.name
                )
            } else {
                continue;
            };
            let hint = "give this computer and the devices different addresses of one subnet";
            p.add_hint(text.span(), problem, hint);
        }
    }
    (valid && !of_bus).then(|| TapSetup {
        name: name.clone(),
        address,
    })
}

/// Parses `192.168.7.1/24`.
fn prefixed(text: &str) -> Option<(Ipv4Addr, u8)> {
    let (address, prefix) = text.split_once('/')?;
    let address = address.parse().ok()?;
    let prefix = prefix
        .parse()
        .ok()
        .filter(|prefix| (1..=30).contains(prefix))?;
    is_host(address, prefix).then_some((address, prefix))
}

/// Returns true if a host of a subnet may have this address.
fn is_host(address: Ipv4Addr, prefix: u8) -> bool {
    let host = address.to_bits() & (u32::MAX >> prefix);
    let reserved = address.is_multicast()
        || address.is_broadcast()
        || address.is_unspecified()
        || address.is_loopback();
    !reserved && host != 0 && host != u32::MAX >> prefix
}

/// Returns the port of a device at the virtual switch.
pub(super) fn device(
    raw: &RawDevice,
    described: Option<&esi::Device>,
    notes: Option<&mut Vec<String>>,
    p: &mut Problems<'_>,
) -> Option<EoeSetup> {
    let eoe = raw.eoe.as_ref()?;
    let at = &eoe.span;
    let mailbox = described.map(|device| device.mailbox.as_ref());
    if let Some(mailbox) = mailbox {
        let missing = match mailbox {
            Some(mailbox) if mailbox.eoe.is_none() => Some("EoE"),
            Some(mailbox) if mailbox.coe.is_none() => Some("CoE, which EoE needs here"),
            None => Some("EoE: it has no mailbox"),
            Some(_) => None,
        };
        if let Some(missing) = missing {
            let message = format!("the ESI of the device has no {missing}");
            p.add_hint(
                at.clone(),
                message,
                "omit `eoe`, or use the ESI file of its firmware",
            );
            return None;
        }
    }
    let ip = address(&eoe.ip, p);
    let mask = address(&eoe.netmask, p);
    let gateway = address(&eoe.gateway, p);
    let dns = address(&eoe.dns, p);
    let mac = eoe.mac.as_ref().and_then(|text| {
        let mac = parse_mac(text.get_ref());
        if mac.is_none() {
            let message = format!("\"{}\" is not the MAC address of a device", text.get_ref());
            let hint = "write six bytes with an even first one, `mac = \"02:00:00:00:00:01\"`";
            p.add_hint(text.span(), message, hint);
        }
        mac
    });
    let name = eoe.name.as_ref().and_then(|text| {
        let name = dns_name(text.get_ref());
        if name.is_none() {
            let message = format!("\"{}\" is not a DNS name", text.get_ref());
            let hint = "write up to 32 letters, digits, hyphens and dots";
            p.add_hint(text.span(), message, hint);
        }
        name
    });
    let needs_ip = [&eoe.netmask, &eoe.gateway, &eoe.dns, &eoe.name];
    if let (None, Some(key)) = (&eoe.ip, needs_ip.into_iter().flatten().next()) {
        let message = "without `ip`, the device keeps its own IP parameters";
        p.add_hint(key.span(), message, "add `ip = \"192.168.7.11\"`");
    }
    let mask = mask.unwrap_or(Ipv4Addr::new(255, 255, 255, 0));
    let prefix = u8::try_from(mask.to_bits().leading_ones()).unwrap_or(32);
    if mask.to_bits().checked_shl(u32::from(prefix)).unwrap_or(0) != 0
        || !(1..=30).contains(&prefix)
    {
        let message = format!("{mask} is not a subnet mask");
        let place = eoe.netmask.place().unwrap_or(at.clone());
        p.add_hint(place, message, "write `netmask = \"255.255.255.0\"`");
    } else if let (Some(ip), Some(text)) = (ip, &eoe.ip) {
        if !is_host(ip, prefix) {
            let message = format!("no device of its subnet ({mask}) may have the address {ip}");
            let hint = "neither the first nor the last address of the subnet belongs to a device";
            p.add_hint(text.span(), message, hint);
        }
        if let (Some(gateway), Some(text)) = (gateway, &eoe.gateway)
            && (gateway.to_bits() ^ ip.to_bits()) & mask.to_bits() != 0
        {
            let message = format!("the gateway {gateway} is not in the subnet of {ip} ({mask})");
            p.add_hint(
                text.span(),
                message,
                "a gateway is reached without a gateway",
            );
        }
    }
    let spoken = mailbox.flatten().and_then(|mailbox| mailbox.eoe);
    if let (Some(notes), Some(spoken)) = (notes, spoken) {
        let refused = [
            (ip.is_some() && spoken.ip == Some(false), "IP"),
            (mac.is_some() && spoken.mac == Some(false), "MAC"),
        ];
        for (_, what) in refused.into_iter().filter(|(refused, _)| *refused) {
            notes.push(format!(
                "the ESI says that the device takes no {what} address by EoE: it may refuse `eoe`"
            ));
        }
    }
    let label = raw.name.as_ref().map_or("", |name| name.get_ref());
    let some = ip.is_some() || mac.is_some();
    // Without gaps: see `IpParameters`.
    let parameters = some.then(|| IpParameters {
        mac: Some(mac.unwrap_or_else(|| derived_mac(label))),
        ip,
        netmask: ip.map(|_| mask),
        gateway: ip.map(|_| gateway.unwrap_or(Ipv4Addr::UNSPECIFIED)),
        dns: ip.and(dns.or(name.map(|_| Ipv4Addr::UNSPECIFIED))),
        name: ip.and(name),
    });
    Some(EoeSetup {
        parameters,
        filter: mac_filter(eoe, described, p),
        time_stamps: time_stamps(eoe, spoken, p),
    })
}

/// Returns the MAC filter that the keys describe.
fn mac_filter(
    raw: &RawDeviceEoe,
    described: Option<&esi::Device>,
    p: &mut Problems<'_>,
) -> Option<MacFilter> {
    let mut addresses = |key: &Key<Vec<String>>, max: usize, what: &str| {
        let Some(list) = key else {
            return Some(Vec::new());
        };
        let texts = list.get_ref();
        let bytes: Option<Vec<_>> = texts.iter().map(|text| mac_bytes(text)).collect();
        if bytes.is_none() || texts.len() > max {
            let message = format!("`{what}` takes up to {max} addresses of six bytes");
            let hint = format!("write `{what} = [\"01:80:c2:00:00:0e\"]`");
            p.add_hint(list.span(), message, hint);
        }
        bytes
    };
    let filters = addresses(&raw.filters, MAX_FILTERS.0, "filters")?;
    let masks = addresses(&raw.filter_masks, MAX_FILTERS.1, "filter_masks")?;
    if let (None, Some(place)) = (
        &raw.filters,
        raw.filter_masks.place().or(raw.broadcasts.place()),
    ) {
        let message = "without `filters`, the device keeps its own filter";
        p.add_hint(
            place,
            message,
            "add `filters = []`, with the addresses that pass",
        );
    }
    let place = raw.filters.place()?;
    let areas = described.map_or(&[][..], |device| &device.sync_managers);
    let mailbox = areas.iter().find(|area| area.usage == esi::SmUse::MBoxOut);
    let needed = Message::FILTER_REQUEST;
    if let Some(area) = mailbox.filter(|area| usize::from(area.default_size) < needed) {
        let message = format!(
            "a MAC filter needs a mailbox of {needed} bytes, the device has {} (ESI)",
            area.default_size
        );
        p.add_hint(place, message, "omit `filters`");
    }
    Some(MacFilter {
        filters,
        masks,
        no_broadcasts: raw.broadcasts.value() == Some(false),
    })
}

/// Returns true if the device sends the times of frames. Reports the key for a device that cannot.
fn time_stamps(raw: &RawDeviceEoe, described: Option<esi::Eoe>, p: &mut Problems<'_>) -> bool {
    let Some(key) = raw.time_stamps.as_ref().filter(|key| *key.get_ref()) else {
        return false;
    };
    if described.is_some_and(|eoe| eoe.time_stamp != Some(true)) {
        let message = "the ESI of the device has no time stamps (`TimeStamp` of `EoE`)";
        p.add_hint(key.span(), message, "omit `time_stamps`");
    }
    true
}

/// Returns an address that a key has; `None` without the key, or if it has been reported.
fn address(key: &Key<String>, p: &mut Problems<'_>) -> Option<Ipv4Addr> {
    let text = key.as_ref()?;
    let parsed = text.get_ref().parse().ok();
    if parsed.is_none() {
        let message = format!("\"{}\" is not an IPv4 address", text.get_ref());
        p.add_hint(
            text.span(),
            message,
            "write four numbers, such as \"192.168.7.11\"",
        );
    }
    parsed
}

/// Parses a MAC address of one device.
fn parse_mac(text: &str) -> Option<MacAddress> {
    mac_bytes(text).filter(|mac| mac[0] & 1 == 0 && *mac != [0; 6])
}

/// Parses six bytes.
fn mac_bytes(text: &str) -> Option<MacAddress> {
    let mut mac = [0; 6];
    let mut parts = text.split([':', '-']);
    for byte in &mut mac {
        let part = parts.next().filter(|part| part.len() == 2)?;
        let hex = part.bytes().all(|digit| digit.is_ascii_hexdigit());
        *byte = hex.then(|| u8::from_str_radix(part, 16).ok())??;
    }
    parts.next().is_none().then_some(mac)
}

fn dns_name(text: &str) -> Option<[u8; NAME]> {
    let known = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '.';
    let mut name = [0; NAME];
    let room = name.get_mut(..text.len()).filter(|room| !room.is_empty())?;
    room.copy_from_slice(text.as_bytes());
    text.chars().all(known).then_some(name)
}

/// Returns a locally administered MAC address that depends on the name of the device alone.
fn derived_mac(name: &str) -> MacAddress {
    let digest = Sha256::digest(name.as_bytes());
    let [a, b, c] = digest.first_chunk().copied().unwrap_or_default();
    [0x02, 0x45, 0x43, a, b, c]
}

/// An address as a number, and its text.
type Address<'d> = (u64, &'d toml::Spanned<String>);

fn ip_of(eoe: &RawDeviceEoe) -> Option<Address<'_>> {
    let text = eoe.ip.as_ref()?;
    let ip: Ipv4Addr = text.get_ref().parse().ok()?;
    Some((ip.to_bits().into(), text))
}

fn mac_of(eoe: &RawDeviceEoe) -> Option<Address<'_>> {
    let text = eoe.mac.as_ref()?;
    let [a, b, c, d, e, f] = parse_mac(text.get_ref())?;
    Some((u64::from_be_bytes([0, 0, a, b, c, d, e, f]), text))
}

/// Reports devices with the same address.
pub(super) fn unique(devices: &[RawDevice], p: &mut Problems<'_>) {
    let eoe = || devices.iter().filter_map(|device| device.eoe.as_ref());
    for (n, device) in eoe().enumerate() {
        for of in [ip_of as fn(&RawDeviceEoe) -> Option<Address<'_>>, mac_of] {
            let Some((address, text)) = of(device) else {
                continue;
            };
            let mut others = eoe().take(n).filter_map(of);
            if others.any(|(other, _)| other == address) {
                let message = format!("two devices have the address {}", text.get_ref());
                p.add_hint(
                    text.span(),
                    message,
                    "give each device an address of its own",
                );
            }
        }
    }
}
