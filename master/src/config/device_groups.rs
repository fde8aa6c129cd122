//! Rules for groups that the machine goes on without (`outside = "continue"`): what their devices must
//! have for it.

use ecaxis_ecat::index::DeviceIndex;

use super::problem::{Problems, Span};
use super::roles::OwnerKind;
use super::{GroupStopScope, Machine, StopGroup};

/// Reports outputs that would come on by themselves. `spans`: the places of the devices by their names.
pub(super) fn check(machine: &Machine, spans: &[(String, Span)], p: &mut Problems<'_>) {
    let groups = machine.stop.groups.iter();
    for group in groups.filter(|group| group.outside == GroupStopScope::Continue) {
        without_reset(machine, group, spans, p);
    }
}

/// Without axes there is no reset after which outputs follow a position or an input again.
fn without_reset(
    machine: &Machine,
    group: &StopGroup,
    spans: &[(String, Span)],
    p: &mut Problems<'_>,
) {
    let has_axis = |device: &DeviceIndex| machine.axes_of(*device).next().is_some();
    if group.devices.iter().any(has_axis) {
        return;
    }
    let returns = |kind: OwnerKind| matches!(kind, OwnerKind::PositionOutput | OwnerKind::Copy);
    let own = machine
        .roles
        .outputs()
        .find(|owned| returns(owned.owner.kind) && group.devices.contains(&owned.output.device));
    if let Some(owned) = own {
        let message = format!(
            "`{}` would come on by itself when its device returns: group `{}` has no axis to reset",
            owned.output.name, group.name
        );
        let hint = "put the device into a group with an axis, or write `outside = \"stop\"`";
        p.add_hint(place(machine, owned.output.device, spans), message, hint);
    }
}

fn place(machine: &Machine, device: DeviceIndex, spans: &[(String, Span)]) -> Span {
    let name = &machine.devices[device].name;
    let span = spans.iter().find(|(other, _)| other == name);
    span.map_or_else(Span::default, |(_, span)| span.clone())
}
