//! `ecaxis explain`: everything derived from the ESI files, each with its source element.

use std::fmt::Write;
use std::path::PathBuf;

use ecaxis_esi::SmLayout;
use ecaxis_master::config::{
    self, Action, Bus, DeviceConfig, Exchange, Machine, Nic, Step, duration,
};
use ecaxis_master::link::SocketKind;
use ecaxis_master::rt::exchange::LONGEST_LOOK;
use ecaxis_master::rt::image::{self, Access, ImagePlan};
use ecaxis_master::rt::spin::Spin;
use ecaxis_master::text::pluralize;

mod axis;
mod stop;

use crate::hints;
use crate::hints::Failure;
use crate::render::page;
use crate::render::pdo_table::{fields, startup};
use crate::render::report::Table;

const EXAMPLES: &str = "\
Examples:
  ecaxis explain machine.toml
  ecaxis explain machine.toml | less";

/// Show the configuration derived from a machine file and its ESI files: PDOs, start-up SDOs,
/// clocks, frames
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Machine file
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let machine = config::load(&args.file).map_err(|e| hints::config(&args.file, &e))?;
    let mut text = String::new();
    // Writing into a String cannot fail.
    let _ = explain(&machine, &mut text);
    page(&text)
}

fn explain(machine: &Machine, out: &mut String) -> std::fmt::Result {
    writeln!(out, "{}", machine.path.display())?;
    bus(machine, out)?;
    for device in &machine.devices {
        self::device(device, out)?;
    }
    wire(machine, out)?;
    stop::stop(machine, out)?;
    program(machine, out)
}

fn bus(machine: &Machine, out: &mut String) -> std::fmt::Result {
    let bus = &machine.bus;
    let nic = match &bus.nic {
        Nic::Sim => ["nic", "sim", "the simulated bus, from the same ESI files"],
        Nic::Interface(name) => ["nic", name, ""],
    };
    let cpu = bus
        .cpu
        .map_or("any CPU".to_owned(), |cpu| format!("CPU {cpu}"));
    let written = |key: &str| bus.written.iter().find(|(written, _)| *written == key);
    let origin =
        |key: &str| written(key).map_or("default".to_owned(), |(_, line)| format!("line {line}"));
    let mut table = Table::new(&["setting", "value", "from", "meaning"]);
    let mut row = |[key, value, meaning]: [&str; 3]| {
        table.row([key, value, &origin(key), meaning]);
    };
    row(nic);
    row([
        "cycle",
        &duration::show(bus.cycle_ns),
        "from frame to frame; also 0x60C2 and SYNC0",
    ]);
    let lost = bus.lost_frames.to_string();
    row([
        "lost_frames",
        &lost,
        "consecutive cycles without a valid answer stop the axes",
    ]);
    row(match bus.exchange {
        Exchange::SameCycle => [
            "exchange",
            "same-cycle",
            "answers are waited for within the cycle",
        ],
        Exchange::Pipelined => [
            "exchange",
            "pipelined",
            "answers are read in the next cycle, without waiting",
        ],
    });
    if matches!(bus.nic, Nic::Interface(_)) {
        let meaning = match bus.link {
            SocketKind::Ring => "frames are taken from memory that the kernel shares",
            SocketKind::Packet => "frames are taken by system calls",
        };
        row(["link", bus.link.name(), meaning]);
    }
    row([
        "priority",
        &format!("SCHED_FIFO {}", bus.priority),
        "of the real-time thread",
    ]);
    row(["cpu", &cpu, "where it runs"]);
    row([
        "spin",
        &match bus.spin {
            Spin::Auto => "auto".to_owned(),
            Spin::For(ns) => duration::show(ns),
        },
        "before a cycle is due, sleeping becomes spinning",
    ]);
    row(if bus.awake {
        [
            "idle",
            "awake",
            "something of the lowest class keeps that CPU busy",
        ]
    } else {
        ["idle", "sleep", "CPUs sleep between two cycles"]
    });
    let watchdog = duration::show(bus.watchdog_ns);
    let registers = format!(
        "0x0420 = {}, 0x0400 = {}; of the PDI: 0x0410 = {}",
        bus.process_data_watchdog(),
        Bus::WATCHDOG_DIVIDER,
        Bus::PDI_WATCHDOG,
    );
    row(["watchdog", &watchdog, &registers]);
    if machine.devices.iter().any(|d| d.selection.dc.is_some()) {
        row([
            "clock_window",
            &duration::show(bus.clock_window_ns),
            "a clock farther off is warned of (0x092C)",
        ]);
    }
    row([
        "op_timeout",
        &duration::show(bus.op_timeout_ns),
        "from SafeOp to Op",
    ]);
    let enable = duration::show(bus.enable_timeout_ns);
    row([
        "enable_timeout",
        &enable,
        "until a drive reports Operation enabled",
    ]);
    writeln!(out, "\nbus\n{}", table.shown(2))
}

fn device(device: &DeviceConfig, out: &mut String) -> std::fmt::Result {
    let selection = &device.selection;
    let esi = device.esi_path.display();
    writeln!(
        out,
        "\ndevice `{}` at {} (line {})",
        device.name, device.at, device.line
    )?;
    writeln!(
        out,
        "  {} {:?}, {esi}:{}",
        device.device.type_name, selection.device_name, device.device.position
    )?;
    writeln!(out, "  {}", selection.identity)?;
    if let Some(mode) = selection.mode {
        writeln!(out, "  mode {mode} (0x6060 = {})", mode.code())?;
    }
    for module in &selection.modules {
        writeln!(
            out,
            "  module {:?} (0x{:08x}) in slot {:?}, {esi}:{}",
            module.type_name, module.ident, module.slot_name, module.position,
        )?;
    }
    if let Some(assignment) = &selection.assignment {
        writeln!(out, "  PDO assignment {assignment:?}")?;
    }
    for note in &selection.notes {
        writeln!(out, "  note: {note}")?;
    }
    if let Some(axis) = &device.axis {
        axis::axis(axis, out)?;
    }
    sync_managers(device, out)?;
    let layout = &selection.layout;
    fields("outputs", layout.rx_bytes(), &layout.rx, out)?;
    fields("inputs", layout.tx_bytes(), &layout.tx, out)?;
    clock(device, out)?;
    startup(&device.selection.startup, out)
}

fn sync_managers(device: &DeviceConfig, out: &mut String) -> std::fmt::Result {
    let mut table = Table::new(&["SM", "use", "address", "bytes", "control", "FMMU"]);
    let layout = &device.selection.layout;
    let process: Vec<(&str, &SmLayout)> = layout
        .outputs
        .iter()
        .map(|sm| ("outputs", sm))
        .chain(layout.inputs.iter().map(|sm| ("inputs", sm)))
        .collect();
    for (number, sm) in device.device.sync_managers.iter().enumerate() {
        let planned = process.iter().find(|(_, p)| usize::from(p.sm) == number);
        let (usage, address, len, control, fmmu) = match planned {
            Some((usage, p)) => {
                let fmmu = p.fmmu.map_or("next free".to_owned(), |f| f.to_string());
                (
                    (*usage).to_owned(),
                    p.start_address,
                    p.len,
                    p.control_byte,
                    fmmu,
                )
            }
            None => {
                let usage = match sm.usage {
                    ecaxis_esi::SmUse::MBoxOut => "mailbox out",
                    ecaxis_esi::SmUse::MBoxIn => "mailbox in",
                    _ => "unused",
                };
                (
                    usage.to_owned(),
                    sm.start_address,
                    sm.default_size,
                    sm.control_byte,
                    String::new(),
                )
            }
        };
        table.row([
            &number.to_string(),
            &usage,
            &format!("0x{address:04x}"),
            &len.to_string(),
            &format!("0x{control:02x}"),
            &fmmu,
        ]);
    }
    writeln!(out, "\n{}", table.shown(2))
}

fn clock(device: &DeviceConfig, out: &mut String) -> std::fmt::Result {
    let Some(dc) = &device.selection.dc else {
        return writeln!(out, "\n  no distributed clock (0x0980 = 0x0000)");
    };
    let sync = |cycle: u32, shift: i32| match cycle {
        0 => "off".to_owned(),
        cycle => {
            let sign = if shift < 0 { "-" } else { "" };
            let shift = duration::show(u64::from(shift.unsigned_abs()));
            format!(
                "every {}, shifted by {sign}{shift}",
                duration::show(u64::from(cycle))
            )
        }
    };
    writeln!(
        out,
        "\n  distributed clock: OpMode {:?}, {}:{}",
        dc.name,
        device.esi_path.display(),
        dc.position,
    )?;
    let [low, high] = dc.assign_activate.to_le_bytes();
    writeln!(
        out,
        "    AssignActivate 0x{:04x}: 0x0980 = 0x{low:02x}, 0x0981 = 0x{high:02x}",
        dc.assign_activate,
    )?;
    writeln!(
        out,
        "    SYNC0 {}",
        sync(dc.sync0_cycle_ns, dc.sync0_shift_ns)
    )?;
    writeln!(
        out,
        "    SYNC1 {}",
        sync(dc.sync1_cycle_ns, dc.sync1_shift_ns)
    )
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
    frames[0] = AL_STATUS + LONGEST_LOOK + if clock { CLOCK } else { 0 };
    for datagram in &plan.datagrams {
        frames[datagram.frame] += DATAGRAM + datagram.len;
    }
    frames
        .into_iter()
        .map(|len| ETHERNET + (ECAT_HEADER + len).max(SHORTEST_PAYLOAD))
        .collect()
}

fn wire(machine: &Machine, out: &mut String) -> std::fmt::Result {
    let plan = match image::of(machine) {
        Ok(plan) => plan,
        Err(e) => return writeln!(out, "\nprocess image\n  {e}"),
    };
    writeln!(
        out,
        "\nprocess image: {}; outputs and inputs share addresses",
        pluralize(plan.len, "byte")
    )?;
    let mut table = Table::new(&["device", "logical", "outputs", "inputs", "frame"]);
    for (device, region) in machine.devices.iter().zip(&plan.regions) {
        let Some(region) = region else { continue };
        let at = format!("0x{:08x}", region.logical);
        let (outputs, inputs) = (region.out_len.to_string(), region.in_len.to_string());
        table.row([
            &device.name,
            &at,
            &outputs,
            &inputs,
            &(region.frame + 1).to_string(),
        ]);
    }
    writeln!(out, "{}", table.shown(2))?;
    let clock = machine.devices.iter().any(|d| d.selection.dc.is_some());
    let frames = frame_bytes(&plan, clock);
    let total: usize = frames.iter().sum();
    let ns = (total - 12) * NS_PER_BYTE + machine.devices.len() * FORWARDING_NS;
    let wkc: u32 = plan
        .datagrams
        .iter()
        .map(|d| u32::from(d.expected_wkc))
        .sum();
    let clock = if clock { "FRMW 0x0910, " } else { "" };
    let process_data = commands(&plan);
    let ns = u64::try_from(ns).unwrap_or(u64::MAX);
    let percent = |ns: u64| ns as f64 * 100.0 / machine.bus.cycle_ns as f64;
    writeln!(
        out,
        "\nframes a cycle: {} ({clock}{process_data}BRD 0x0130, one diagnostic read), at most {total} bytes on the wire",
        frames.len()
    )?;
    writeln!(
        out,
        "  about {} µs from the first bit sent to the last received at 100 Mbit/s, {:.1} % of the cycle",
        ns.div_ceil(1000),
        percent(ns),
    )?;
    writeln!(out, "  expected working counter {wkc}")?;
    let (ns, why) = load(machine, ns);
    writeln!(
        out,
        "  estimated load of the real-time thread: about {} µs, {:.1} % of its CPU\n    ({why}; `ecaxis bench` measures it)",
        ns.div_ceil(1000),
        percent(ns),
    )
}

/// Returns the estimated CPU time per cycle in ns and its composition. The figures are measurements
/// on small computers (docs/realtime.md).
fn load(machine: &Machine, wire_ns: u64) -> (u64, &'static str) {
    /// Wake-up, building frames, stepping the axes, publishing, in ns.
    const WORK_NS: u64 = 20_000;
    const AXIS_NS: u64 = 200;
    /// A typical spin time of `"auto"` in ns. It never exceeds this fraction of the cycle:
    const SPIN_NS: u64 = 50_000;
    let axes = machine.devices.iter().filter(|d| d.axis.is_some()).count();
    let work = WORK_NS + AXIS_NS * u64::try_from(axes).unwrap_or(u64::MAX / AXIS_NS);
    let spin = match machine.bus.spin {
        Spin::Auto => SPIN_NS.min(match machine.bus.exchange {
            Exchange::SameCycle => machine.bus.cycle_ns * 2 / 5,
            Exchange::Pipelined => machine.bus.cycle_ns * 4 / 25,
        }),
        Spin::For(ns) => ns,
    };
    match machine.bus.exchange {
        Exchange::SameCycle => (work + spin + wire_ns, "work, spinning, waiting for answers"),
        Exchange::Pipelined => (work + spin, "work, spinning"),
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

fn program(machine: &Machine, out: &mut String) -> std::fmt::Result {
    if machine.steps.is_empty() {
        return writeln!(
            out,
            "\nno program: the axes are enabled and hold their positions"
        );
    }
    writeln!(out, "\nprogram, {}", times(machine.repeat))?;
    steps(machine, &machine.steps, out)
}

fn steps(machine: &Machine, each: &[Step], out: &mut String) -> std::fmt::Result {
    for step in each {
        let depth = step.number.matches('.').count();
        let text = machine.describe(&step.action);
        writeln!(
            out,
            "{:indent$}{}. {text}",
            "",
            step.number,
            indent = 2 + 3 * depth
        )?;
        if let Action::Repeat { steps: inner, .. } = &step.action {
            steps(machine, inner, out)?;
        }
    }
    Ok(())
}

fn times(n: u32) -> String {
    if n == 1 {
        "once".to_owned()
    } else {
        format!("{n} times")
    }
}

#[cfg(test)]
mod tests;
