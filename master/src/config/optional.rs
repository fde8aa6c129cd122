//! Devices that may be absent (`optional`).

use ecaxis_ecat::index::{DeviceIndex, IndexVec};

use super::problem::{Problems, Span};
use super::raw::RawDevice;
use super::steps::Program;
use super::{DeviceConfig, GroupStopScope, Locator};

/// The keys `optional = true` of the file, with the names of their devices.
pub(crate) struct OptionalPlaces(Vec<(String, Span)>);

impl OptionalPlaces {
    pub(crate) fn of(devices: &[RawDevice]) -> Self {
        let place = |device: &RawDevice| {
            let optional = device.optional.as_ref().filter(|key| *key.get_ref())?;
            Some((device.name.as_ref()?.get_ref().clone(), optional.span()))
        };
        Self(devices.iter().filter_map(place).collect())
    }

    /// Reports optional devices that could not appear during a run.
    pub(crate) fn check(
        &self,
        devices: &IndexVec<DeviceIndex, DeviceConfig>,
        program: &Program,
        p: &mut Problems<'_>,
    ) {
        for (name, span) in &self.0 {
            let found = devices.enumerate().find(|(_, device)| device.name == *name);
            let Some((index, device)) = found else {
                continue;
            };
            let mut groups = program.stop.groups.iter();
            let group = groups.find(|group| group.devices.contains(&index));
            let other = group.and_then(|group| {
                let mut own = group.devices.iter().filter_map(|index| devices.get(*index));
                own.find(|device| !device.optional)
            });
            let steady = |device: &&DeviceConfig| !device.optional && device.selection.dc.is_some();
            let (message, hint) = if matches!(device.at, Locator::Position(_)) {
                (
                    format!("`{name}` may appear at any port, so no position locates it"),
                    "locate it by `alias` or `id`".to_owned(),
                )
            } else if group.is_none_or(|group| group.outside != GroupStopScope::Continue) {
                (
                    format!("the machine stops without `{name}`"),
                    format!("add a [[stop.group]] with `{name}` and `outside = \"continue\"`"),
                )
            } else if let Some(other) = other {
                (
                    format!(
                        "the group of `{name}` cannot run without it, and `{}` is in it",
                        other.name
                    ),
                    "write a group for optional devices alone".to_owned(),
                )
            } else if program.outputs.iter().any(|signal| signal.device == index) {
                (
                    format!(
                        "steps set outputs of `{name}`, which would be switched on as soon as it appears"
                    ),
                    "leave them out of the steps".to_owned(),
                )
            } else if device.selection.dc.is_some() && !devices.iter().any(|d| steady(&d)) {
                (
                    format!("`{name}` has SYNC0, and no device that is always there has it"),
                    "write `dc = \"off\"`, or use SYNC0 on a device that is not optional"
                        .to_owned(),
                )
            } else {
                continue;
            };
            p.add_hint(span.clone(), message, hint);
        }
    }
}
