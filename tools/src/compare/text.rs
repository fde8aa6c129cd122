//! The differences in words.

use std::fmt;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_esi::address;
use ecaxis_master::config::{Locator, Machine};

use super::Difference;
use crate::scan::{Device, Scan};

impl Difference {
    /// Returns the stable name of the kind.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Missing { .. } => "missing",
            Self::Added { .. } => "added",
            Self::Swapped { .. } => "swapped",
            Self::Moved { .. } => "moved",
            Self::Reversed { .. } => "reversed",
            Self::Revision { .. } => "revision",
            Self::Alias { .. } => "alias",
            Self::Serial { .. } => "serial",
            Self::Modules { .. } => "modules",
            Self::Parameter { .. } => "parameter",
        }
    }

    /// Returns the indices of the devices in the file and their positions on the bus.
    #[must_use]
    pub fn location(&self) -> (Vec<DeviceIndex>, Vec<u16>) {
        match self {
            Self::Missing { device } => (vec![*device], vec![]),
            Self::Added { position } => (vec![], vec![*position]),
            Self::Swapped { devices, positions } => (devices.to_vec(), positions.to_vec()),
            Self::Moved { device, to, .. } => (vec![*device], vec![*to]),
            Self::Reversed { devices, position } => (devices.clone(), vec![*position]),
            Self::Revision {
                device, position, ..
            }
            | Self::Alias {
                device, position, ..
            }
            | Self::Serial {
                device, position, ..
            }
            | Self::Modules {
                device, position, ..
            }
            | Self::Parameter {
                device, position, ..
            } => (vec![*device], vec![*position]),
        }
    }

    /// Returns the difference as text.
    #[must_use]
    pub fn display<'a>(&'a self, machine: &'a Machine, scan: &'a Scan) -> impl fmt::Display + 'a {
        DifferenceDisplay {
            difference: self,
            machine,
            scan,
        }
    }
}

struct DifferenceDisplay<'a> {
    difference: &'a Difference,
    machine: &'a Machine,
    scan: &'a Scan,
}

impl DifferenceDisplay<'_> {
    fn name(&self, device: DeviceIndex) -> &str {
        let device = self.machine.devices.get(device);
        device.map_or("?", |device| device.name.as_str())
    }

    fn kind(&self, device: DeviceIndex) -> String {
        let device = self.machine.devices.get(device);
        device.map_or_else(String::new, |d| d.device.type_name.clone())
    }

    /// Describes the device at a position.
    fn there(&self, position: u16) -> String {
        let device = self.scan.devices.get(usize::from(position));
        let Some(identity) = device.and_then(Device::identity) else {
            return "an unknown device".to_owned();
        };
        let mut esi = self.machine.devices.iter().flat_map(|d| d.esi.headers());
        let of_product =
            esi.find(|(id, ..)| (id.vendor, id.product) == (identity.vendor, identity.product));
        let known = of_product.map(|(_, type_name, _)| type_name.to_owned());
        match known.or_else(|| device.and_then(Device::own_name)) {
            Some(name) => format!("{name}, {identity}"),
            None => identity.to_string(),
        }
    }
}

impl fmt::Display for DifferenceDisplay<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.difference {
            Difference::Missing { device } => {
                let at = self.machine.devices.get(*device).map(|d| d.at.to_string());
                write!(
                    f,
                    "`{}` ({}) is missing: no {} is left on the bus for it",
                    self.name(*device),
                    at.unwrap_or_default(),
                    self.kind(*device)
                )
            }
            Difference::Added { position } => write!(
                f,
                "position {position} is not in the file: {}",
                self.there(*position)
            ),
            Difference::Swapped { devices, positions } => write!(
                f,
                "`{}` and `{}` are swapped: `{}` is at position {}, `{}` at position {}",
                self.name(devices[0]),
                self.name(devices[1]),
                self.name(devices[0]),
                positions[0],
                self.name(devices[1]),
                positions[1]
            ),
            Difference::Moved { device, from, to } => write!(
                f,
                "`{}` is at position {to}, in the file at position {from}",
                self.name(*device)
            ),
            Difference::Reversed { devices, position } => {
                let names: Vec<String> = devices
                    .iter()
                    .map(|device| format!("`{}`", self.name(*device)))
                    .collect();
                let device = match names.as_slice() {
                    [] => format!("the device at position {position}"),
                    [name] => name.clone(),
                    names => format!("one of {}", names.join(", ")),
                };
                write!(
                    f,
                    "{device}: IN and OUT are swapped, frames reach it at position {position}"
                )
            }
            Difference::Revision {
                device,
                position,
                expected,
                found,
            } => {
                let rule = self.machine.devices.get(*device).map(|d| d.identity);
                write!(
                    f,
                    "`{}` (position {position}) has revision 0x{found:08x}, its ESI describes 0x{expected:08x} (identity = \"{}\")",
                    self.name(*device),
                    rule.unwrap_or_default()
                )
            }
            Difference::Alias {
                device,
                position,
                expected,
                found,
            } => {
                let what = match expected {
                    Locator::Id(_) => "device identification",
                    _ => "alias",
                };
                write!(
                    f,
                    "`{}`: no device has {expected}; the {} at position {position} has {what} {found}",
                    self.name(*device),
                    self.kind(*device)
                )
            }
            Difference::Serial {
                device,
                position,
                expected,
                found,
            } => write!(
                f,
                "`{}` (position {position}) has serial number {found}, the file says {expected}",
                self.name(*device)
            ),
            Difference::Modules {
                device,
                position,
                expected,
                found,
            } => write!(
                f,
                "`{}` (position {position}) holds the modules [{}], the file says [{}]",
                self.name(*device),
                found.join(", "),
                expected.join(", ")
            ),
            Difference::Parameter {
                device,
                position,
                index,
                sub,
                name,
                expected,
                found,
            } => write!(
                f,
                "`{}` (position {position}): {} {name} is {}, start-up writes {}",
                self.name(*device),
                address(*index, *sub),
                number(found),
                number(expected)
            ),
        }
    }
}

/// Formats little-endian bytes as a number.
fn number(bytes: &[u8]) -> String {
    if bytes.len() > 8 {
        return format!("{} bytes", bytes.len());
    }
    let value = bytes
        .iter()
        .rev()
        .fold(0_u64, |value, byte| value << 8 | u64::from(*byte));
    format!("{value} (0x{value:0width$x})", width = bytes.len() * 2)
}
