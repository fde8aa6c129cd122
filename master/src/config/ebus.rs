//! The supply of terminals over the E-bus. A coupler or feed terminal has a negative `EBusCurrent` in
//! its ESI, the current that it supplies; the terminals behind it have the current that they take.

use super::{DeviceConfig, Locator};
use crate::text::pluralize;

/// A coupler or feed terminal, and what is behind it so far.
struct Supply {
    name: String,
    milliamperes: i64,
    used: i64,
    devices: usize,
}

/// Warns of a supply whose terminals take more current than it has. `devices` are in the order of the
/// segment, as far as positions locate them. A device whose Ethernet ports come between its E-bus ports
/// ends the list: positions do not show which terminals follow on the E-bus.
pub(super) fn check(devices: &mut [DeviceConfig]) {
    let mut supply: Option<Supply> = None;
    let mut warnings = Vec::new();
    let mut next = None;
    for device in devices.iter() {
        let Locator::Position(position) = device.at else {
            continue;
        };
        // What is at a position that the file locates otherwise is unknown.
        if next != Some(position) {
            warnings.extend(supply.take().and_then(Supply::warning));
        }
        next = position.checked_add(1);
        if branches(&device.device.physics) {
            supply = None;
            break;
        }
        let current = i64::from(device.device.info.ebus_current_ma.unwrap_or(0));
        let on_ebus = device.device.physics.starts_with(['K', 'k']);
        if current < 0 || !on_ebus {
            warnings.extend(supply.take().and_then(Supply::warning));
        }
        if current < 0 {
            let (name, milliamperes) = (device.name.clone(), -current);
            supply = Some(Supply {
                name,
                milliamperes,
                used: 0,
                devices: 0,
            });
            continue;
        }
        let Some(supply) = &mut supply else { continue };
        supply.used += current;
        supply.devices += usize::from(current > 0);
    }
    warnings.extend(supply.take().and_then(Supply::warning));
    for (name, warning) in warnings {
        if let Some(device) = devices.iter_mut().find(|device| device.name == name) {
            device.selection.notes.push(warning);
        }
    }
}

/// True if a device on the E-bus has an Ethernet port too, or a coupler one that comes before its E-bus:
/// frames leave at port 3, then 1, then 2.
fn branches(physics: &str) -> bool {
    let is = |port: usize, kind: char| {
        let found = physics.chars().nth(port);
        found.is_some_and(|found| found.eq_ignore_ascii_case(&kind))
    };
    is(0, 'K') && (1..4).any(|port| is(port, 'Y')) || is(3, 'Y') && (1..3).any(|port| is(port, 'K'))
}

impl Supply {
    /// Returns the name of the device and the warning, if the supply does not suffice.
    fn warning(self) -> Option<(String, String)> {
        let Self {
            name,
            milliamperes,
            used,
            devices,
        } = self;
        (used > milliamperes).then(|| {
            let text = format!(
                "warning: {} on its E-bus take {used} mA, and it supplies {milliamperes} mA (EBusCurrent); \
                 insert a feed terminal",
                pluralize(devices, "device")
            );
            (name, text)
        })
    }
}
