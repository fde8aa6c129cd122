//! `ecaxis explain`: everything derived from the ESI files, each with its source element.

use std::path::PathBuf;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_esi::address;
use ecaxis_esi::model::Position;
use ecaxis_master::acyclic::StateTimeouts;
use ecaxis_master::config::{
    self, BitRange, Bus, DeviceConfig, ExchangeMode, Machine, Nic, Step, duration,
};
use ecaxis_master::link::SocketKind;
use ecaxis_master::rt::exchange::MAX_POLL_DATAGRAM;
use ecaxis_master::rt::gantry::safe_velocity;
use ecaxis_master::rt::image::{self, Access, ImagePlan};
use ecaxis_master::rt::spin::Spin;
use ecaxis_master::text::pluralize;
use ecaxis_tools::cells;
use ecaxis_tools::document::format::{hex32, times};
use ecaxis_tools::document::{Document, Table};

mod as_json;
mod axis;
mod gateway;
mod stop;

use crate::access::device::selected;
use crate::hints::{self, Failure};
use crate::render::pdo_table::{process_data, startup};
use crate::render::{note_of, print, print_json};

const EXAMPLES: &str = "\
Examples:
  ecaxis explain machine.toml
  ecaxis explain machine.toml | less
  ecaxis explain machine.toml x          one device, by name or position
  ecaxis explain machine.toml 0 --json   as JSON";

/// Show the configuration derived from a machine file and its ESI files: PDOs, start-up SDOs,
/// clocks, frames
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Show only this device: its name, or its position
    #[arg(value_name = "DEVICE")]
    device: Option<String>,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let machine = config::load(&args.file).map_err(|e| hints::config(&args.file, &e))?;
    let only = args.device.as_ref();
    let only = only.map(|name| selected(&machine, name)).transpose()?;
    match args.json {
        true => print_json(&as_json::machine(&machine, only)),
        false => print(&explain(&machine, only)),
    }
}

fn explain(machine: &Machine, only: Option<DeviceIndex>) -> Document {
    let mut out = Document::new(machine.path.display().to_string());
    if let Some(index) = only {
        device(machine, index, &mut out);
        return out;
    }
    bus(machine, &mut out);
    for index in machine.devices.indices() {
        device(machine, index, &mut out);
    }
    wire(machine, &mut out);
    ethernet(machine, &mut out);
    gantries(machine, &mut out);
    copies(machine, &mut out);
    stop::stop(machine, &mut out);
    signals(machine, &mut out);
    program(machine, &mut out);
    out
}

fn bus(machine: &Machine, out: &mut Document) {
    let bus = &machine.bus;
    let written = |key: &str| bus.written.iter().find(|(written, _)| *written == key);
    let origin =
        |key: &str| written(key).map_or("default".to_owned(), |(_, line)| format!("line {line}"));
    let mut table = Table::new("setting|value|from|meaning");
    let mut row = |key: &str, value: &str, meaning: &str| {
        table.row(cells![key, value, origin(key), meaning]);
    };
    let time = duration::show;
    match &bus.nic {
        Nic::Sim => row("nic", "sim", "the simulated bus, from the same ESI files"),
        Nic::Interface(name) => row("nic", name, ""),
    }
    if let Some(second) = &bus.redundant {
        row("redundant", second, "the other end of the ring");
    }
    let cycle = time(bus.cycle_ns);
    row(
        "cycle",
        &cycle,
        "from frame to frame; also 0x60C2 and SYNC0",
    );
    let meaning = "consecutive cycles without a valid answer stop the axes";
    row("lost_frames", &bus.lost_frames.to_string(), meaning);
    let (value, meaning) = match bus.exchange {
        ExchangeMode::SameCycle => ("same-cycle", "answers are waited for within the cycle"),
        ExchangeMode::Pipelined => (
            "pipelined",
            "answers are read in the next cycle, without waiting",
        ),
    };
    row("exchange", value, meaning);
    if matches!(bus.nic, Nic::Interface(_)) {
        let meaning = match bus.link {
            SocketKind::Ring => "frames are taken from memory that the kernel shares",
            SocketKind::Packet => "frames are taken by system calls",
        };
        row("link", bus.link.name(), meaning);
    }
    let priority = format!("SCHED_FIFO {}", bus.priority);
    row("priority", &priority, "of the real-time thread");
    let cpu = bus
        .cpu
        .map_or("any CPU".to_owned(), |cpu| format!("CPU {cpu}"));
    row("cpu", &cpu, "where it runs");
    let spin = match bus.spin {
        Spin::Auto => "auto".to_owned(),
        Spin::For(ns) => time(ns),
    };
    row(
        "spin",
        &spin,
        "before a cycle is due, sleeping becomes spinning",
    );
    match bus.awake {
        true => row(
            "idle",
            "awake",
            "something of the lowest class keeps that CPU busy",
        ),
        false => row("idle", "sleep", "CPUs sleep between two cycles"),
    }
    let registers = format!(
        "0x0420 = {}, 0x0400 = {}; of the PDI: 0x0410 = {}",
        bus.process_data_watchdog(),
        Bus::WATCHDOG_DIVIDER,
        Bus::PDI_WATCHDOG,
    );
    row("watchdog", &time(bus.watchdog_ns), &registers);
    if machine.devices.iter().any(|d| d.selection.dc.is_some()) {
        let window = time(bus.clock_window_ns);
        row(
            "clock_window",
            &window,
            "a clock farther off is warned of (0x092C)",
        );
        row(
            "sync_window",
            &time(bus.sync_window_ns),
            "of clocks with SYNC0 before Op (0x092C)",
        );
        row(
            "sync_timeout",
            &time(bus.sync_timeout_ns),
            "for clocks and frames to be in phase",
        );
    }
    match bus.op_timeout_ns {
        Some(timeout) => row("op_timeout", &time(timeout), "from SafeOp to Op"),
        None => {
            let all = machine.devices.iter().map(|device| {
                let timeouts = StateTimeouts::new(&device.device.info);
                u64::try_from(timeouts.safe_op_op.as_nanos()).unwrap_or(u64::MAX)
            });
            let (shortest, longest) = (all.clone().min(), all.max());
            let shown = match (shortest, longest) {
                (Some(a), Some(b)) if a != b => format!("{} to {}", time(a), time(b)),
                (_, Some(one)) => time(one),
                _ => "10 s".to_owned(),
            };
            row("op_timeout", &shown, "from SafeOp to Op");
        }
    }
    let meaning = "until a drive reports Operation enabled";
    row("enable_timeout", &time(bus.enable_timeout_ns), meaning);
    out.section("bus", table);
}

/// Shows the virtual switch and what is connected with it.
fn ethernet(machine: &Machine, out: &mut Document) {
    let connected = machine.devices.iter().filter(|device| device.eoe.is_some());
    let names: Vec<_> = connected
        .map(|device| format!("`{}`", device.name))
        .collect();
    if names.is_empty() {
        return;
    }
    out.heading("Ethernet over EtherCAT (EoE)".to_owned());
    out.line(format!("virtual switch: {}", names.join(", ")));
    match &machine.tap {
        Some(tap) => out.line(format!(
            "TAP {tap}; exists during the run, needs CAP_NET_ADMIN"
        )),
        None => out.line("no TAP interface ([eoe]): the devices reach each other only".to_owned()),
    }
}

fn device(machine: &Machine, index: DeviceIndex, out: &mut Document) {
    let device = &machine.devices[index];
    let selection = &device.selection;
    let (at, line) = (&device.at, device.line);
    out.heading(format!("device `{}` at {at} (line {line})", device.name));
    let (name, type_name) = (&selection.device_name, &device.device.type_name);
    out.line(format!(
        "{type_name} {name:?}, {}",
        origin(device, device.device.position)
    ));
    out.line(selection.identity.to_string());
    if device.optional {
        out.line("optional: may be absent, and appear at any port".to_owned());
    }
    if let Some(eoe) = &device.eoe {
        out.line(format!("EoE, set in PreOp: {eoe}"));
    }
    if let Some(mode) = selection.mode {
        out.line(format!("mode {mode} (0x6060 = {})", mode.code()));
    }
    for module in &selection.modules {
        out.line(format!(
            "module {:?} (0x{:08x}) in slot {:?}, {}",
            module.type_name,
            module.ident,
            module.slot_name,
            origin(device, module.position),
        ));
    }
    if let Some(assignment) = &selection.assignment {
        out.line(format!("PDO assignment {assignment:?}"));
    }
    for note in &selection.notes {
        let (lead, note) = note_of(note);
        out.item(lead, note);
    }
    let (axes, several) = (machine.axes_of(index), machine.axes_of(index).count() > 1);
    for (_, axis) in axes {
        out.gap();
        let node = axis
            .node
            .and_then(|n| device.gateway.as_ref()?.nodes.get(n));
        if let Some(node) = node {
            out.line(format!("axis of node {}: `{}`", node.id, axis.name));
        } else if several || axis.name != device.name {
            let (name, number) = (&axis.name, axis.number + 1);
            out.line(format!("axis {number} of the drive: `{name}`"));
        }
        out.table(axis::axis(axis));
    }
    if let Some(gateway) = &device.gateway {
        gateway::network(machine, index, gateway, out);
    }
    process_data(&device.device, &selection.layout, out);
    clock(device, out);
    startup(&device.selection, out);
}

/// Returns file, line and column of an element, or the EEPROM image.
fn origin(device: &DeviceConfig, position: Position) -> String {
    let file = device.esi_path.display();
    match device.has_esi() {
        true => format!("{file}:{position}"),
        false => file.to_string(),
    }
}

fn clock(device: &DeviceConfig, out: &mut Document) {
    out.gap();
    let Some(dc) = &device.selection.dc else {
        out.line("no distributed clock (0x0980 = 0x0000)");
        return;
    };
    out.line(format!(
        "distributed clock: OpMode {:?}, {}",
        dc.name,
        origin(device, dc.position)
    ));
    let [low, high] = dc.assign_activate.to_le_bytes();
    out.line(format!(
        "  AssignActivate 0x{:04x}: 0x0980 = 0x{low:02x}, 0x0981 = 0x{high:02x}",
        dc.assign_activate,
    ));
    let show = |ns: u32| duration::show(ns.into());
    out.line(match dc.sync0_cycle_ns {
        0 => "  SYNC0 off".to_owned(),
        cycle => {
            let sign = if dc.sync0_shift_ns < 0 { "-" } else { "" };
            let shift = show(dc.sync0_shift_ns.unsigned_abs());
            format!("  SYNC0 every {}, shifted by {sign}{shift}", show(cycle))
        }
    });
    out.line(match dc.activates_sync1() {
        false => "  SYNC1 off".to_owned(),
        true => format!("  SYNC1 {} after SYNC0 (0x09a4)", show(dc.sync1_delay_ns)),
    });
}

/// Preamble, Ethernet header, FCS, gap.
const ETHERNET: usize = 8 + 14 + 4 + 12;
const ECAT_HEADER: usize = 2;
/// Header and working counter.
const DATAGRAM: usize = 12;
const CLOCK: usize = DATAGRAM + 8;
const AL_STATUS: usize = DATAGRAM + 2;
const SHORTEST_PAYLOAD: usize = 46;
const NS_PER_BYTE: usize = 80;
const FORWARDING_NS: usize = 1_000;

/// Returns the maximum size of each frame of a cycle on the wire in bytes, with the interframe gap.
fn frame_bytes(plan: &ImagePlan, clock: bool) -> Vec<usize> {
    let mut frames = vec![0; plan.frames()];
    frames[0] = AL_STATUS + MAX_POLL_DATAGRAM + if clock { CLOCK } else { 0 };
    for datagram in &plan.datagrams {
        frames[datagram.frame] += DATAGRAM + datagram.len;
    }
    frames
        .into_iter()
        .map(|len| ETHERNET + (ECAT_HEADER + len).max(SHORTEST_PAYLOAD))
        .collect()
}

fn wire(machine: &Machine, out: &mut Document) {
    let plan = match image::of(&machine.rt_config()) {
        Ok(plan) => plan,
        Err(e) => {
            out.heading("process image");
            out.line(e.to_string());
            return;
        }
    };
    let bytes = pluralize(plan.len, "byte");
    out.heading(format!(
        "process image: {bytes}; outputs and inputs share addresses"
    ));
    let mut table = Table::new("device|logical|outputs|inputs|frame");
    for (device, region) in machine.devices.iter().zip(&plan.regions) {
        let Some(region) = region else { continue };
        let (at, frame) = (hex32(region.logical), region.frame + 1);
        table.row(cells![
            device.name,
            at,
            region.out_len,
            region.in_len,
            frame
        ]);
    }
    out.table(table);
    let clock = machine.devices.iter().any(|d| d.selection.dc.is_some());
    let frames = frame_bytes(&plan, clock);
    let total: usize = frames.iter().sum();
    let ns = (total - 12) * NS_PER_BYTE + machine.devices.len() * FORWARDING_NS;
    let wkc = plan.datagrams.iter().map(|d| u32::from(d.expected_wkc));
    let wkc: u32 = wkc.sum();
    let clock = if clock { "FRMW 0x0910, " } else { "" };
    let process_data = commands(&plan);
    let ns = u64::try_from(ns).unwrap_or(u64::MAX);
    let percent = |ns: u64| ns as f64 * 100.0 / machine.bus.cycle_ns as f64;
    out.heading(format!(
        "frames a cycle: {} ({clock}{process_data}BRD 0x0130, one diagnostic read), at most {total} bytes on the wire",
        frames.len()
    ));
    out.line(format!(
        "about {} µs from the first bit sent to the last received at 100 Mbit/s, {:.1} % of the cycle",
        ns.div_ceil(1000),
        percent(ns),
    ));
    out.line(format!("expected working counter {wkc}"));
    let (ns, why) = load(machine, ns);
    out.line(format!(
        "estimated load of the real-time thread: about {} µs, {:.1} % of its CPU",
        ns.div_ceil(1000),
        percent(ns),
    ));
    out.line(format!("  ({why}; `ecaxis bench` measures it)"));
}

/// Returns the estimated CPU time per cycle in ns and its composition. The figures are measurements
/// on small computers (docs/realtime.md).
fn load(machine: &Machine, wire_ns: u64) -> (u64, &'static str) {
    /// Wake-up, building frames, stepping the axes, publishing, in ns.
    const WORK_NS: u64 = 20_000;
    const AXIS_NS: u64 = 200;
    /// A typical spin time of `"auto"` in ns. It never exceeds this fraction of the cycle:
    const SPIN_NS: u64 = 50_000;
    let axes = machine.axes.len();
    let work = WORK_NS + AXIS_NS * u64::try_from(axes).unwrap_or(u64::MAX / AXIS_NS);
    let spin = match machine.bus.spin {
        Spin::Auto => SPIN_NS.min(match machine.bus.exchange {
            ExchangeMode::SameCycle => machine.bus.cycle_ns * 2 / 5,
            ExchangeMode::Pipelined => machine.bus.cycle_ns * 4 / 25,
        }),
        Spin::For(ns) => ns,
    };
    match machine.bus.exchange {
        ExchangeMode::SameCycle => (work + spin + wire_ns, "work, spinning, waiting for answers"),
        ExchangeMode::Pipelined => (work + spin, "work, spinning"),
    }
}

/// Formats the datagrams as `LRW, ` or `2 LRW, LWR, LRD, `.
fn commands(plan: &ImagePlan) -> String {
    let mut text = String::new();
    for (access, name) in [
        (Access::Both, "LRW"),
        (Access::Outputs, "LWR"),
        (Access::Inputs, "LRD"),
    ] {
        match plan.datagrams.iter().filter(|d| d.access == access).count() {
            0 => {}
            1 => text += &format!("{name}, "),
            several => text += &format!("{several} {name}, "),
        }
    }
    text
}

fn gantries(machine: &Machine, out: &mut Document) {
    if machine.gantries.is_empty() {
        return;
    }
    let dt_s = machine.bus.cycle_ns as f64 * 1e-9;
    let mut table = Table::new("first|second|skew|while homing|a blocked half is safe up to");
    for gantry in &machine.gantries {
        let [first, second] = gantry.axes.map(|axis| &machine.axes[axis]);
        let safe = safe_velocity(&first.config, gantry.max_skew, dt_s);
        let unit = &first.unit;
        table.row(cells![
            first.name,
            second.name,
            format!("{} {unit}", gantry.max_skew),
            format!("{} {unit}", gantry.max_homing_skew),
            format!("{safe:.1} {unit}/s")
        ]);
    }
    out.section("gantries", table);
}

fn copies(machine: &Machine, out: &mut Document) {
    if machine.copies.is_empty() {
        return;
    }
    let mut table = Table::new("from|to|length|line|without frames");
    for copy in &machine.copies {
        let held = match has_watchdog(&machine.devices[copy.to.device], &copy.to) {
            true => format!("{}, watchdog", duration::show(machine.bus.watchdog_ns)),
            false => "keeps its value".to_owned(),
        };
        let length = copy.to.length();
        table.row(cells![
            copy.from.name,
            copy.to.name,
            length,
            copy.line,
            held
        ]);
    }
    out.section("copies", table);
}

/// True if all these outputs end with the watchdog of their SyncManager (bit 6 of its ControlByte).
fn has_watchdog(device: &DeviceConfig, outputs: &BitRange) -> bool {
    let mut first = 0;
    device.selection.layout.outputs.iter().all(|sm| {
        let start = first;
        first += u32::from(sm.len) * 8;
        let apart = outputs.bits.end <= start || first <= outputs.bits.start;
        apart || sm.has_trigger()
    })
}

/// Lists the inputs and outputs with the names that steps use.
fn signals(machine: &Machine, out: &mut Document) {
    let mut table = Table::new("name|object|bits|in [signals]");
    for index in machine.devices.indices() {
        let [inputs, outputs] = machine.signals_of(index);
        let all = inputs.iter().map(|signal| ("in", signal));
        for (way, signal) in all.chain(outputs.iter().map(|signal| ("out", signal))) {
            let named = machine
                .signals
                .iter()
                .find(|named| named.signal == signal.name);
            table.row(cells![
                format!("{way:<3}  {}", signal.name),
                address(signal.field.index, signal.field.sub),
                signal.field.bit_len,
                named.map_or("", |named| named.name.as_str())
            ]);
        }
    }
    out.heading("inputs and outputs by name");
    out.table(table);
}

fn program(machine: &Machine, out: &mut Document) {
    if machine.steps.is_empty() {
        out.heading("no program: the axes are enabled and hold their positions");
        return;
    }
    out.heading(format!("program, {}", times(machine.repeat)));
    steps(machine, machine.steps.iter(), out);
}

fn steps<'s>(machine: &Machine, each: impl Iterator<Item = &'s Step>, out: &mut Document) {
    for step in each {
        let indent = " ".repeat(3 * step.number.matches('.').count());
        let lead = format!("{indent}{}. ", step.number);
        out.item(lead, machine.describe_step(step));
        steps(machine, step.action.inner(), out);
    }
}

#[cfg(test)]
mod tests;
