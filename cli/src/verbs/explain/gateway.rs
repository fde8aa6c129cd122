//! The CAN network behind a gateway in `ecaxis explain`: its load, its dead time, and the path of
//! each target from the process data to the CAN frame.

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config::{GatewaySetup, Machine, NodeSetup, duration};
use ecaxis_master::rt::image;
use ecaxis_tools::cells;
use ecaxis_tools::document::{Document, Table};

/// The identifiers of the PDOs 1 to 3 to and from a node, without its node-ID.
const RECEIVE_IDS: [u16; 3] = [0x200, 0x300, 0x400];
const TRANSMIT_IDS: [u16; 3] = [0x180, 0x280, 0x380];
/// Bytes of the process data in one object.
const BYTES: u16 = 128;

pub(super) fn network(
    machine: &Machine,
    index: DeviceIndex,
    gateway: &GatewaySetup,
    out: &mut Document,
) {
    out.gap();
    out.line(format!(
        "CAN network: {} kbit/s, SYNC every {}, load {:.0} %",
        gateway.bit_rate / 1000,
        duration::show(gateway.sync_ns),
        gateway.load * 100.0
    ));
    let axes = machine.axes_of(index).any(|(_, axis)| axis.node.is_some());
    if axes {
        let dead_time = gateway.dead_time_ns(machine.bus.cycle_ns);
        let dead_time = duration::show(dead_time);
        out.line(format!(
            "  expected from a set-point to its first report: {dead_time}"
        ));
    }
    let image = image::of(&machine.rt_config()).ok();
    let region = image.and_then(|plan| *plan.regions.get(index)?);
    let start = region.map(|region| region.offset);
    let mut table = Table::new("node|object|way|gateway's data|image|EtherCAT|gateway|CAN");
    for node in &gateway.nodes {
        paths(node, start, &mut table);
    }
    out.table(table);
    let mut held = Table::new("node|object|value");
    for node in &gateway.nodes {
        for (index, sub, data) in &node.objects {
            let value = data
                .iter()
                .rev()
                .fold(0_u64, |value, byte| value << 8 | u64::from(*byte));
            held.row(cells![node.id, ecaxis_esi::address(*index, *sub), value]);
        }
    }
    if !held.is_empty() {
        out.line("the configuration tool of the gateway must write to the drives:");
        out.table(held);
    }
}

/// Adds the path of each object of a node.
fn paths(node: &NodeSetup, start: Option<usize>, table: &mut Table) {
    let ways = [
        ("out", &node.outputs, 0x2100, 0x2000, RECEIVE_IDS),
        ("in", &node.inputs, 0x2000, 0x2100, TRANSMIT_IDS),
    ];
    for (way, links, ethercat, canopen, ids) in ways {
        for link in links {
            let id = ids.get(usize::from(link.pdo).wrapping_sub(1));
            let id = id.map_or(0, |base| base + u16::from(node.id));
            let mut at = link.at;
            for &(index, sub, bits) in &link.contents {
                let last = at + u16::from(bits) / 8 - 1;
                let place = start.map_or("-".to_owned(), |start| {
                    let first = start + usize::from(at);
                    format!("{first}…{}", start + usize::from(last))
                });
                table.row(cells![
                    format!("{} ({})", node.id, node.drive),
                    ecaxis_esi::address(index, sub),
                    way,
                    format!("{at}…{last}"),
                    place,
                    bytes(ethercat, at, last),
                    // Control and status word have no object on this side.
                    bytes(canopen, at.saturating_sub(2), last.saturating_sub(2)),
                    format!("0x{id:03x}, {}…{}", at - link.at, last - link.at),
                ]);
                at = last + 1;
            }
        }
    }
}

/// Returns the objects of the first and the last byte.
fn bytes(object: u16, first: u16, last: u16) -> String {
    let of = |byte: u16| (object + byte / BYTES, byte % BYTES + 1);
    let ((index, sub), (_, end)) = (of(first), of(last));
    format!("0x{index:04x}:{sub:02x}…{end:02x}")
}
