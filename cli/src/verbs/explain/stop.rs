//! The stop reactions of the machine and its axis groups in `ecaxis explain`.

use ecaxis_axis::StopMethod;
use ecaxis_ecat::index::GroupIndex;
use ecaxis_master::config::{GroupStopScope, Machine};

use ecaxis_tools::cells;
use ecaxis_tools::document::{Document, Table};

pub(super) fn stop(machine: &Machine, out: &mut Document) {
    let stop = &machine.stop;
    let by_drive = match stop.bus_lost {
        StopMethod::Ramp | StopMethod::QuickStop => "the drives' quick stop",
        StopMethod::DisableVoltage => "no power",
    };
    let conditions = stop.emergency.iter().map(|c| machine.condition(c));
    let emergency = match conditions.collect::<Vec<_>>() {
        none if none.is_empty() => "no condition".to_owned(),
        all => all.join(", or "),
    };
    let lost = format!(
        "{} cycles: {by_drive}; if they answer, a ramp",
        machine.bus.lost_frames
    );
    let mut table = Table::new("when|what happens|key");
    let others = format!("the others: {}", way(stop.others));
    table.row(cells!["an axis faults or trips", others, "`others`"]);
    table.row(cells!["no process data", lost, "`bus_lost`"]);
    table.row(cells!["emergency stop", emergency, "`emergency`"]);
    out.section("stop", table);
    if stop.groups.is_empty() {
        out.gap();
        out.line("all axes stop together");
        return;
    }
    let mut table = Table::new("group|axes|devices|others|outside");
    let axes = |group: GroupIndex| {
        let axes = machine.axes.iter();
        let own = axes.filter(|axis| machine.group_of(axis.device) == group);
        let names: Vec<_> = own.map(|axis| axis.name.as_str()).collect();
        names.join(" ")
    };
    let devices = |group: GroupIndex| {
        let devices = machine.devices.enumerate();
        let own = devices.filter(|(device, _)| machine.group_of(*device) == group);
        let without = own.filter(|(_, device)| device.selection.mode.is_none());
        let names: Vec<_> = without.map(|(_, device)| device.name.as_str()).collect();
        names.join(" ")
    };
    for (index, group) in (1..).map(GroupIndex).zip(&stop.groups) {
        let outside = match group.outside {
            GroupStopScope::Stop => "stops",
            GroupStopScope::Continue => "continues",
        };
        let (axes, devices) = (axes(index), devices(index));
        table.row(cells![
            group.name,
            axes,
            devices,
            way(group.others),
            outside
        ]);
    }
    table.row(cells![
        "(the rest)",
        axes(GroupIndex::MACHINE),
        devices(GroupIndex::MACHINE),
        way(stop.others),
        "stops"
    ]);
    out.table(table);
}

fn way(way: StopMethod) -> &'static str {
    match way {
        StopMethod::Ramp => "within their limits",
        StopMethod::QuickStop => "quick stop",
        StopMethod::DisableVoltage => "no power",
    }
}
