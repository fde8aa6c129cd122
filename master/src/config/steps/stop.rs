//! `[stop]`: how the machine stops, and which axes stop together.

use ecaxis_ecat::index::DeviceIndex;
use toml::Spanned;

use super::ProgramChecker;
use crate::config::fields::KeyExt;
use crate::config::problem::{Problems, suggestion};
use crate::config::raw::{RawGroup, RawStop};
use crate::config::roles::InputUse;
use crate::config::{StopGroup, StopSetup};
use ecaxis_axis::StopMethod;

impl ProgramChecker<'_> {
    /// Returns the stop settings. Mistakes are reported and replaced by defaults.
    pub(super) fn stop(&mut self, raw: &RawStop, p: &mut Problems<'_>) -> StopSetup {
        let others = raw.others.value().unwrap_or(StopMethod::Ramp);
        let mut groups: Vec<StopGroup> = Vec::new();
        for (index, group) in raw.groups.iter().enumerate() {
            let group = self.group(group, &raw.groups[..index], &groups, others, p);
            groups.push(group);
        }
        let mut emergency = Vec::new();
        self.usage = InputUse::Emergency;
        for raw in raw.emergency.iter().flat_map(|conditions| &conditions.0) {
            let Some(condition) = self.condition(raw, p) else {
                continue;
            };
            emergency.push(condition);
        }
        StopSetup {
            others,
            bus_lost: raw.bus_lost.value().unwrap_or_default(),
            emergency,
            groups,
        }
    }

    fn group(
        &self,
        raw: &RawGroup,
        before: &[RawGroup],
        groups: &[StopGroup],
        others: StopMethod,
        p: &mut Problems<'_>,
    ) -> StopGroup {
        if let Some(name) = &raw.name {
            let same = |other: &&RawGroup| {
                let other = other.name.as_ref();
                other.is_some_and(|other| other.get_ref() == name.get_ref())
            };
            if name.get_ref().trim().is_empty() {
                p.add(name.span(), "a group needs a name");
            } else if let Some(twin) = before.iter().find(same) {
                let message = format!("the group \"{}\" is there already", name.get_ref());
                let hint = format!("in line {}", p.line(&twin.span));
                p.add_hint(name.span(), message, hint);
            }
        }
        let mut group = StopGroup {
            name: raw
                .name
                .as_ref()
                .map_or_else(String::new, |n| n.get_ref().clone()),
            devices: Vec::new(),
            others: raw.others.value().unwrap_or(others),
            outside: raw.outside.value().unwrap_or_default(),
        };
        if raw.axes.is_none() && raw.devices.is_none() && !raw.written.has("axes") {
            let hint = "add `axes = [\"x\", \"y\"]`, or `devices` for SubDevices without an axis";
            p.add_hint(raw.span.clone(), "nothing is in this [[stop.group]]", hint);
        }
        let mut axes = Vec::new();
        for name in raw.axes.iter().flat_map(|names| &names.0) {
            let Some((axis, _)) = self.axis(name, p) else {
                continue;
            };
            let device = self.axes[axis].device;
            // All axes of a drive are in the same group.
            let others = self.axes.enumerate().filter(|(index, other)| {
                *index != axis && other.device == device && axes.contains(index)
            });
            if others.count() == 0 {
                self.join(&mut group, name, device, groups, p);
            }
            axes.push(axis);
        }
        for name in raw.devices.iter().flat_map(|names| &names.0) {
            let Some(device) = self.device(name) else {
                let hint = suggestion(
                    name.get_ref(),
                    self.devices.iter().map(|d| d.name),
                    "devices",
                );
                p.add_hint(
                    name.span(),
                    format!("no device is named `{}`", name.get_ref()),
                    hint,
                );
                continue;
            };
            if self.axes.iter().all(|axis| axis.device != device) {
                self.join(&mut group, name, device, groups, p);
            } else {
                let message = format!("`{}` has an axis", name.get_ref());
                p.add_hint(name.span(), message, "name it in `axes`");
            }
        }
        group
    }

    /// Adds a device to a group; a device is in one group at most.
    fn join(
        &self,
        group: &mut StopGroup,
        name: &Spanned<String>,
        device: DeviceIndex,
        groups: &[StopGroup],
        p: &mut Problems<'_>,
    ) {
        let other = groups.iter().find(|g| g.devices.contains(&device));
        if let Some(other) = other {
            let message = format!(
                "`{}` is in the group `{}` already",
                name.get_ref(),
                other.name
            );
            let hint = "a device is in one group at most";
            p.add_hint(name.span(), message, hint);
        } else if group.devices.contains(&device) {
            let message = format!("`{}` is named twice", name.get_ref());
            p.add_hint(name.span(), message, "once is enough");
        } else {
            group.devices.push(device);
        }
    }
}

#[cfg(test)]
#[path = "stop_tests.rs"]
mod tests;
