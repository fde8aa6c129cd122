//! Raw machine → checked machine: the bus, names and positions. Devices and steps have their own
//! files.

use std::path::Path;

use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use toml::Spanned;

use super::cam;
use super::compensation;
use super::copy::{self, BitRange};
use super::device::{self, CheckedDevice, EsiFiles};
use super::device_groups;
use super::duration::show;
use super::ebus;
use super::eoe;
use super::fields::KeyExt;
use super::gantry;
use super::line_shaft;
use super::mailbox_gateway;
use super::needed;
use super::optional::OptionalPlaces;
use super::path;
use super::position_output;
use super::problem::{Problems, Span, suggestion};
use super::raw::{RawBus, RawDevice, RawMachine};
use super::roles::{OutputOwner, OwnerKind, ProcessDataRoles};
use super::second_encoder;
use super::sim;
use super::steps::{self, Resolved, ResolvedAxis, ResolvedDevice};

use crate::file_digest::{FileDigest, UsedFile};
use crate::rt::image;

use super::{
    AxisSetup, Bus, CommonTimeUse, Locator, MAX_SUBDEVICES, Machine, Nic, SegmentHead, ServerSetup,
    Signal, Spin, StopSetup, signal,
};

/// Returns `None` only if a problem has been reported.
pub(crate) fn machine(file: &UsedFile, raw: RawMachine, p: &mut Problems<'_>) -> Option<Machine> {
    let path = &*file.path;
    let cycle_span = raw.bus.cycle.place().unwrap_or_default();
    let common_time_span = raw.bus.common_time.place().unwrap_or_default();
    let bus = bus(raw.bus, p);
    unique_names(&raw.devices, p);
    eoe::unique(&raw.devices, p);
    if let Some(beyond) = raw.devices.get(MAX_SUBDEVICES) {
        let message = format!("a bus has at most {MAX_SUBDEVICES} SubDevices");
        p.add(beyond.span.clone(), message);
    }
    let places = places(&raw.devices, p);

    let folder = path.parent().unwrap_or(Path::new(""));
    let cycle = bus.as_ref().map(|b| (b.cycle_ns, cycle_span));
    let mut files = EsiFiles::new(folder, &raw.devices, cycle);
    let mut checked = Vec::new();
    let all: Vec<String> = raw
        .devices
        .iter()
        .filter_map(|d| Some(d.name.as_ref()?.get_ref().clone()))
        .collect();
    let connections = sim::Places::of(&raw.devices);
    let optional = OptionalPlaces::of(&raw.devices);
    let spans: Vec<_> = raw
        .devices
        .iter()
        .filter_map(|d| Some((d.name.as_ref()?.get_ref().clone(), d.span.clone())))
        .collect();
    let needs = needed::of_steps(&raw.steps);
    for (raw, at) in raw.devices.into_iter().zip(places) {
        checked.push(device::check(raw, at, &mut files, (&all, &needs), p));
    }
    // Steps use the machine's device indices, so the order is determined first.
    let position = |checked: &CheckedDevice| match checked.device.as_ref()?.at {
        Locator::Position(n) => Some(n),
        _ => None,
    };
    if checked.iter().all(|device| position(device).is_some()) {
        checked.sort_by_key(position);
    }
    let aligned = bus
        .as_ref()
        .is_some_and(|bus| bus.common_time == CommonTimeUse::Align);
    let clocked = |checked: &CheckedDevice| {
        let device = checked.device.as_ref();
        device.is_none_or(|device| device.selection.dc.is_some())
    };
    if aligned && !checked.iter().any(clocked) {
        let message = "no device has SYNC0: nothing can be aligned";
        let hint = "take the key out, or set `dc` of a device";
        p.add_hint(common_time_span, message, hint);
    }
    compensation::check(&mut checked, folder, p);
    let gantries = gantry::check(&raw.gantries, &mut checked, p);
    // Without a name, a device is invalid, and nothing refers to it.
    let named: Vec<_> = checked
        .iter()
        .filter_map(|checked| Some((checked.name.as_deref()?, checked)))
        .collect();
    let devices: IndexVec<DeviceIndex, ResolvedDevice<'_>> = named
        .iter()
        .map(|(name, checked)| ResolvedDevice {
            name,
            device: checked.device.as_ref(),
        })
        .collect();
    let each = (0..).map(DeviceIndex).zip(&named);
    let each =
        each.flat_map(|(device, (_, checked))| checked.axes.iter().map(move |axis| (device, axis)));
    let brakes: Vec<_> = each
        .clone()
        .filter_map(|(_, axis)| Some((axis.name.clone(), axis.brake_output.clone()?)))
        .collect();
    let encoders: Vec<_> = each
        .clone()
        .filter_map(|(_, axis)| Some((axis.name.clone(), axis.second_encoder.clone()?)))
        .collect();
    let axes: IndexVec<AxisIndex, ResolvedAxis<'_>> = each
        .map(|(device, axis)| ResolvedAxis {
            name: &axis.name,
            device,
            setup: axis.setup.as_ref(),
        })
        .collect();
    let cams = cam::check(&raw.cams, folder, p);
    let cycle_ns = bus.as_ref().map_or(0, |b| b.cycle_ns);
    let line_shafts = line_shaft::check(&raw.line_shafts, (&devices, &axes), cycle_ns, p);
    let mut tables = Vec::new();
    let cycle_s = bus.as_ref().map_or(1e-3, |b| b.cycle_ns as f64 * 1e-9);
    let paths = path::check(&raw.paths, &axes, folder, cycle_s, &mut tables, p);
    let known = &devices;
    let repeat = raw.repeat.value().unwrap_or(1);
    let resolved = Resolved {
        devices: known,
        axes: &axes,
        folder,
        cycle_s,
        gantries: &gantries,
        cams: &cams,
        line_shafts: &line_shafts,
        paths: &paths,
        tables: &tables,
    };
    let names = (raw.signals, raw.variables, raw.program, raw.sim);
    let program = steps::check(
        raw.steps,
        (raw.stop, raw.overrides),
        names,
        resolved,
        repeat,
        p,
    );
    let encoders = second_encoder::check(&encoders, known, p);
    let mut roles = ProcessDataRoles::of_devices(known, &axes);
    for (output, place) in program.outputs.iter().zip(&program.output_places) {
        let owner = OutputOwner::new(OwnerKind::Step, "", p.line(place));
        roles.claim_at(BitRange::of(output), owner, place.clone(), p);
    }
    let brakes = brake_outputs(&brakes, known, &mut roles, p);
    let positions = &raw.position_outputs;
    let position_outputs = position_output::check(positions, known, &axes, &program, &mut roles, p);
    let copies = copy::check(&raw.copies, known, &mut roles, p);
    let mut devices = Vec::new();
    let mut axes = Vec::new();
    for (index, checked) in (0..).map(DeviceIndex).zip(checked) {
        for axis in checked.axes {
            axes.push(AxisSetup {
                device: index,
                ..axis.setup?
            });
        }
        devices.push(checked.device?);
    }
    for brake in brakes {
        if let Some(axis) = axes.iter_mut().find(|axis| axis.name == brake.axis) {
            brake.check_group(axis, &program.stop, p);
            axis.brake_output = Some(brake.output);
        }
    }
    for encoder in encoders {
        encoder.add_to(&mut axes, &program.stop, &mut roles, p);
    }
    for used in &program.used {
        roles.add_input(used, None, &program.stop, p);
    }
    for copy in &copies {
        roles.add_source(copy.from.clone());
    }
    gantry::check_groups(&gantries, &axes, &program.stop, p);
    ebus::check(&mut devices);
    let devices: IndexVec<_, _> = devices.into();
    let gateway = raw.mailbox_gateway.as_ref();
    let gateway = gateway.map(|raw| mailbox_gateway::check(raw, p));
    let tap = raw.eoe.as_ref();
    let tap = tap.and_then(|raw| eoe::tap(raw, bus.as_ref(), &devices, p));
    connections.check(&devices, p);
    optional.check(&devices, &program, p);
    let machine = Machine {
        path: path.to_owned(),
        sha256: FileDigest::of_machine(file, &p.files.files),
        files: std::iter::once(file)
            .chain(&p.files.files)
            .cloned()
            .collect(),
        bus: bus?,
        devices,
        axes: axes.into(),
        gantries: gantries.iter().map(|gantry| gantry.config).collect(),
        cams,
        line_shafts: line_shafts.iter().filter_map(|s| s.setup.clone()).collect(),
        steps: program.steps,
        inputs: program.inputs,
        outputs: program.outputs,
        signals: program.signals,
        variables: program.variables,
        program: program.buttons,
        switched: program.switched,
        copies,
        position_outputs,
        roles,
        stop: program.stop,
        overrides: program.overrides,
        tables: program.tables,
        repeat,
        enable: raw.enable.value().unwrap_or(true),
        server: ServerSetup {
            stale_cycles: raw.server.stale_cycles.value().unwrap_or(10),
            lease_ns: raw.server.lease.value().unwrap_or(500_000_000),
        },
        mailbox_gateway: gateway,
        tap,
    };
    device_groups::check(&machine, &spans, p);
    if let Err(error) = image::of(&machine.rt_config()) {
        let name = &machine.devices[error.device].name;
        let span = spans.iter().find(|(other, _)| other == name);
        let message = format!("`{name}`: {error}");
        let hint = "map fewer objects with `pdo.rx` and `pdo.tx`, or choose another `assignment`";
        p.add_hint(
            span.map_or(Span::default(), |(_, span)| span.clone()),
            message,
            hint,
        );
    }
    Some(machine)
}

/// The output that releases a brake.
struct BrakeOutput {
    axis: String,
    output: Signal,
    place: Span,
}

impl BrakeOutput {
    /// Reports a brake that closes on a moving axis: its output is in a group that may stop alone.
    fn check_group(&self, axis: &AxisSetup, stop: &StopSetup, p: &mut Problems<'_>) {
        if let Some(group) = stop.group_alone(self.output.device, Some(axis.device)) {
            let (name, axis) = (&self.output.name, &self.axis);
            let message = format!(
                "`{name}` opens the brake of `{axis}`, and its group `{group}` may stop while `{axis}` moves"
            );
            let hint = "put both into one group (`devices`)";
            p.add_hint(self.place.clone(), message, hint);
        }
    }
}

/// Returns the outputs that release brakes. Each belongs to its axis.
fn brake_outputs(
    brakes: &[(String, Spanned<String>)],
    known: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    roles: &mut ProcessDataRoles,
    p: &mut Problems<'_>,
) -> Vec<BrakeOutput> {
    let mut found: Vec<BrakeOutput> = Vec::new();
    for (axis, text) in brakes {
        let Some(output) = signal::output_of_text(text, known, p) else {
            continue;
        };
        if output.field.bit_len != 1 {
            let message = format!("`{}` has {} bits", output.name, output.field.bit_len);
            p.add_hint(
                text.span(),
                message,
                "a brake is opened by an output of one bit",
            );
            continue;
        }
        let place = text.span();
        let owner = OutputOwner::new(OwnerKind::Brake, axis, p.line(&place));
        if roles.claim_at(BitRange::of(&output), owner, place.clone(), p) {
            found.push(BrakeOutput {
                axis: axis.clone(),
                output,
                place,
            });
        }
    }
    found
}

/// A second in ns. Clocks that count other seconds, or are set by whole ones, have cycles in common.
const SECOND: u64 = 1_000_000_000;

fn bus(raw: RawBus, p: &mut Problems<'_>) -> Option<Bus> {
    let defaults = Bus::default();
    let cycle_ns = raw.cycle.value();
    let watchdog_ns = raw.watchdog.value().unwrap_or(defaults.watchdog_ns);
    let lost_frames = raw.lost_frames.value().unwrap_or(defaults.lost_frames);
    if let Some(cycle) = cycle_ns {
        if watchdog_ns < cycle * 2 {
            let at = raw.watchdog.place().or(raw.cycle.place());
            let message = format!(
                "the watchdog of {} expires between two cycles of {}",
                show(watchdog_ns),
                show(cycle),
            );
            let hint = "make `watchdog` several cycles long";
            p.add_hint(at.unwrap_or_default(), message, hint);
        } else {
            check_lost_frames(&raw, lost_frames, cycle, watchdog_ns, p);
        }
        if let Some(common) = &raw.common_time
            && *common.get_ref() == CommonTimeUse::Align
            && !SECOND.is_multiple_of(cycle)
        {
            let message = format!(
                "a second is not a whole number of cycles of {}",
                show(cycle)
            );
            p.add_hint(common.span(), message, "use a cycle that divides a second");
        }
        if let Some(spin) = &raw.spin
            && let Spin::For(ns) = spin.get_ref()
            && *ns > cycle
        {
            let message =
                "spinning longer than a cycle never sleeps: `spin` must not exceed `cycle`";
            p.add(spin.span(), message);
        }
    }
    let awake = raw.idle.value().unwrap_or(defaults.awake);
    if let (Some(idle), true, None) = (&raw.idle, awake, &raw.cpu)
        && !raw.written.has("cpu")
    {
        let message = "the CPU to keep awake is missing";
        let hint = "say where the real-time thread runs: `cpu = 1`";
        p.add_hint(idle.span(), message, hint);
    }
    let nic = match &raw.nic {
        Some(name) => nic(name, p),
        None => Some(Nic::Sim),
    };
    let redundant = raw
        .redundant
        .as_ref()
        .map(|name| redundant(name, nic.as_ref(), p));
    Some(Bus {
        nic: nic?,
        redundant: redundant.flatten(),
        cycle_ns: cycle_ns?,
        lost_frames,
        cpu: raw.cpu.value().and_then(|cpu| usize::try_from(cpu).ok()),
        priority: raw.priority.value().unwrap_or(defaults.priority),
        spin: raw.spin.value().unwrap_or_default(),
        awake,
        op_timeout_ns: raw.op_timeout.value(),
        enable_timeout_ns: raw
            .enable_timeout
            .value()
            .unwrap_or(defaults.enable_timeout_ns),
        watchdog_ns,
        clock_window_ns: raw.clock_window.value().unwrap_or(defaults.clock_window_ns),
        sync_window_ns: raw.sync_window.value().unwrap_or(defaults.sync_window_ns),
        sync_timeout_ns: raw.sync_timeout.value().unwrap_or(defaults.sync_timeout_ns),
        common_time: raw.common_time.value().unwrap_or_default(),
        exchange: raw.exchange.value().unwrap_or(defaults.exchange),
        link: raw.link.value().unwrap_or(defaults.link),
        unknown_devices: raw.unknown_devices.value().unwrap_or_default(),
        written: raw.written.keys,
    })
}

/// Checks that lost frames stop the axes before the drives' watchdogs expire.
fn check_lost_frames(raw: &RawBus, lost: u32, cycle: u64, watchdog: u64, p: &mut Problems<'_>) {
    let gap = u64::from(lost) * cycle;
    if gap < watchdog {
        return;
    }
    let at = raw.lost_frames.place().or(raw.watchdog.place());
    let at = at.or(raw.cycle.place());
    let message = format!(
        "`lost_frames` = {lost} cycles of {} are {}, but the drives' `watchdog` stops them after {}",
        show(cycle),
        show(gap),
        show(watchdog),
    );
    // At least 1, because the watchdog is two cycles or longer.
    let most = (watchdog - 1) / cycle;
    let hint = format!("write `lost_frames = {most}` or less, or a longer `watchdog`");
    p.add_hint(at.unwrap_or_default(), message, hint);
}

fn nic(name: &Spanned<String>, p: &mut Problems<'_>) -> Option<Nic> {
    match name.get_ref().as_str() {
        "sim" => Some(Nic::Sim),
        // The length limit of Linux interface names.
        other
            if (1..16).contains(&other.len())
                && !other.contains(|c: char| c == '/' || c.is_whitespace()) =>
        {
            Some(Nic::Interface(other.to_owned()))
        }
        other => {
            let hint = "write an interface such as \"enp3s0\", or \"sim\"";
            p.add_hint(
                name.span(),
                format!("\"{other}\" cannot be a network interface"),
                hint,
            );
            None
        }
    }
}

/// Returns the interface at the other end of a ring.
fn redundant(name: &Spanned<String>, first: Option<&Nic>, p: &mut Problems<'_>) -> Option<String> {
    let second = nic(name, p)?;
    match (first, &second) {
        (Some(Nic::Interface(first)), Nic::Interface(second)) if first == second => {
            let hint = "write the interface at the other end of the ring, or remove `redundant`";
            p.add_hint(name.span(), format!("`nic` is \"{first}\" too"), hint);
            None
        }
        (Some(Nic::Interface(_)), Nic::Sim) => {
            let hint = "write the interface at the other end of the ring";
            p.add_hint(
                name.span(),
                "`nic` is not the simulated bus".to_owned(),
                hint,
            );
            None
        }
        (_, Nic::Interface(second)) => Some(second.clone()),
        (_, Nic::Sim) => Some("sim".to_owned()),
    }
}

fn unique_names(devices: &[RawDevice], p: &mut Problems<'_>) {
    // The only axis of a device may have its name.
    let mut names: Vec<&Spanned<String>> = Vec::new();
    for device in devices {
        names.extend(&device.name);
        let nodes = device.node.iter().flat_map(|node| &node.axes.0);
        let axes = device.axes.0.iter().chain(nodes);
        let axes = axes.filter_map(|axis| axis.name.as_ref());
        let of_device = device.name.as_ref().filter(|_| device.axes.0.len() == 1);
        names.extend(
            axes.filter(|name| of_device.is_none_or(|device| device.get_ref() != name.get_ref())),
        );
    }
    for (i, name) in names.iter().enumerate() {
        if name.get_ref().trim().is_empty() {
            p.add(name.span(), "a device needs a name");
        }
        let twin = names[..i].iter().find(|n| n.get_ref() == name.get_ref());
        if let Some(twin) = twin {
            let message = format!("the name \"{}\" is taken", name.get_ref());
            p.add_hint(
                name.span(),
                message,
                format!("line {} has it", p.line(&twin.span())),
            );
        }
    }
}

/// Returns the locator of each device; `None` if it is invalid.
fn places(devices: &[RawDevice], p: &mut Problems<'_>) -> Vec<Option<Locator>> {
    let mut places: Vec<Option<(Locator, Span)>> = Vec::new();
    for device in devices {
        let placed = ["position", "alias", "id", "behind"];
        let placed = placed.iter().any(|key| device.written.has(key));
        let given = [
            (&device.position, Locator::Position as fn(u16) -> Locator),
            (&device.alias, Locator::Alias),
            (&device.id, Locator::Id),
        ];
        let given = given.into_iter();
        let given = given.filter_map(|(n, at)| Some((at(n.value()?), n.place()?)));
        let behind = device.behind.as_ref();
        let mut given = given.chain(behind.and_then(|name| {
            let place = places.iter().flatten();
            let head = head(devices, name, p)?;
            let before =
                place.filter(|(at, _)| matches!(at, Locator::Behind(of, _) if *of == head));
            let number = u16::try_from(before.count() + 1).unwrap_or(u16::MAX);
            Some((Locator::Behind(head, number), name.span()))
        }));
        let place = match (given.next(), given.next()) {
            (Some(place), None) => Some(place),
            (Some(_), Some((_, span))) => {
                p.add(
                    span,
                    "a device is found by one of `position`, `alias`, `id` and `behind`, not by two",
                );
                None
            }
            (None, _) if placed => None,
            (None, _) => {
                let message = "the position on the bus is missing";
                let hint = format!(
                    "add `position = {}`, or `alias`, `id` or `behind`",
                    places.len()
                );
                p.add_hint(device.span.clone(), message, hint);
                None
            }
        };
        if let Some((at, span)) = &place
            && let Some((_, twin)) = places.iter().flatten().find(|(other, _)| other == at)
        {
            let hint = format!("line {} has it", p.line(twin));
            p.add_hint(span.clone(), format!("{at} is taken"), hint);
        }
        places.push(place);
    }
    gaps(&places, p);
    places
        .into_iter()
        .map(|place| place.map(|(at, _)| at))
        .collect()
}

/// Returns the head of a segment with this name.
fn head(
    devices: &[RawDevice],
    name: &Spanned<String>,
    p: &mut Problems<'_>,
) -> Option<SegmentHead> {
    let names = || devices.iter().filter_map(|device| device.name.as_ref());
    let named =
        |device: &&RawDevice| device.name.as_ref().map(Spanned::get_ref) == Some(name.get_ref());
    let Some(device) = devices.iter().find(named) else {
        let known = names().map(|name| name.get_ref().as_str());
        let hint = suggestion(name.get_ref(), known, "devices");
        p.add_hint(
            name.span(),
            format!("there is no device \"{}\"", name.get_ref()),
            hint,
        );
        return None;
    };
    let alias = device
        .alias
        .as_ref()
        .map(|n| SegmentHead::Alias(*n.get_ref()));
    let id = device.id.as_ref().map(|n| SegmentHead::Id(*n.get_ref()));
    let head = alias.or(id);
    if head.is_none() {
        let (message, hint) = match &device.behind {
            Some(first) => (
                format!("`{}` is not the head of its segment", name.get_ref()),
                format!("write `behind = \"{}\"`", first.get_ref()),
            ),
            None => (
                format!(
                    "the head of a segment has an `alias` or `id`, and `{}` has none",
                    name.get_ref()
                ),
                "locate the head by `alias` or `id`, and this device by its place behind it"
                    .to_owned(),
            ),
        };
        p.add_hint(name.span(), message, hint);
    }
    head
}

/// Checks that positions have no gaps, because every SubDevice must be described.
fn gaps(places: &[Option<(Locator, Span)>], p: &mut Problems<'_>) {
    let mut positions: Vec<(u16, &Span)> = Vec::new();
    for place in places {
        match place {
            Some((Locator::Position(n), span)) => positions.push((*n, span)),
            _ => return,
        }
    }
    positions.sort_by_key(|(n, _)| *n);
    let mut next = 0_u16;
    for (n, span) in positions {
        if n > next {
            let message = format!("nothing is at position {next}");
            let hint = "positions count from 0, and every SubDevice on the bus has its [[device]]";
            p.add_hint(span.clone(), message, hint);
            return;
        }
        next = n.saturating_add(1);
    }
}
