//! Raw machine → checked machine: the bus, names and positions. Devices and steps have their own
//! files.

use std::path::Path;

use toml::Spanned;

use super::device::{self, EsiFiles};
use super::problem::{Problems, Span};
use super::raw::{RawBus, RawDevice, RawMachine};
use super::sim;
use super::steps::{self, ResolvedDevice};
use crate::bringup::MAX_SUBDEVICES;
use crate::link::SocketKind;
use crate::rt::spin::Spin;

use super::{Bus, DeviceConfig, Exchange, Locator, Machine, Nic, Signal, duration, signal};

/// Returns `None` only if a problem has been reported.
pub(crate) fn machine(path: &Path, raw: RawMachine, p: &mut Problems<'_>) -> Option<Machine> {
    let cycle_span = raw.bus.cycle.as_ref().map_or(0..0, Spanned::span);
    let bus = bus(raw.bus, p);
    unique_names(&raw.devices, p);
    if let Some(beyond) = raw.devices.get(MAX_SUBDEVICES) {
        let message = format!("a bus has at most {MAX_SUBDEVICES} SubDevices");
        p.add(beyond.span.clone(), message);
    }
    let places = places(&raw.devices, p);

    let folder = path.parent().unwrap_or(Path::new(""));
    let mut files = EsiFiles::new(folder, bus.as_ref().map(|b| (b.cycle_ns, cycle_span)));
    let mut names = Vec::new();
    let mut devices: Vec<Option<DeviceConfig>> = Vec::new();
    let all: Vec<String> = raw
        .devices
        .iter()
        .filter_map(|d| Some(d.name.as_ref()?.get_ref().clone()))
        .collect();
    let connections = sim::Places::of(&raw.devices);
    let mut brakes = Vec::new();
    for (raw, at) in raw.devices.into_iter().zip(places) {
        if let (Some(name), Some(axis)) = (&raw.name, &raw.axis)
            && let Some(output) = &axis.brake.output
        {
            brakes.push((name.get_ref().clone(), output.clone()));
        }
        names.push((
            raw.name.as_ref().map(|n| n.get_ref().clone()),
            raw.axis.is_some(),
        ));
        devices.push(device::check(raw, at, &mut files, &all, p));
    }
    // Steps use the machine's device indices, so the order is determined first.
    if devices.iter().all(|d| {
        matches!(
            d,
            Some(DeviceConfig {
                at: Locator::Position(_),
                ..
            })
        )
    }) {
        devices.sort_by_key(|d| match d {
            Some(DeviceConfig {
                at: Locator::Position(n),
                ..
            }) => *n,
            _ => 0,
        });
    }
    let known: Vec<ResolvedDevice<'_>> = devices
        .iter()
        .zip(&names)
        .filter_map(|(device, (name, has_axis))| match device {
            Some(device) => Some(ResolvedDevice::from(device)),
            None => name.as_deref().map(|name| ResolvedDevice {
                name,
                axis: Err(*has_axis),
                device: None,
            }),
        })
        .collect();
    let cycle_s = bus.as_ref().map_or(1e-3, |b| b.cycle_ns as f64 * 1e-9);
    let repeat = raw.repeat.map_or(1, Spanned::into_inner);
    let program = steps::check(raw.steps, raw.stop, &known, folder, cycle_s, repeat, p);
    let brakes = brake_outputs(&brakes, &known, &program.outputs, p);
    let mut devices: Vec<DeviceConfig> = devices.into_iter().collect::<Option<_>>()?;
    for (name, output) in brakes {
        let device = devices.iter_mut().find(|d| d.name == name);
        if let Some(axis) = device.and_then(|d| d.axis.as_mut()) {
            axis.brake_output = Some(output);
        }
    }
    connections.check(&devices, p);
    Some(Machine {
        path: path.to_owned(),
        bus: bus?,
        devices,
        steps: program.steps,
        inputs: program.inputs,
        outputs: program.outputs,
        stop: program.stop,
        tables: program.tables,
        repeat,
        enable: raw.enable.is_none_or(Spanned::into_inner),
    })
}

/// Returns the outputs that release brakes, with the name of the axis's device. `set`: the outputs
/// that steps set.
fn brake_outputs(
    brakes: &[(String, Spanned<String>)],
    known: &[ResolvedDevice<'_>],
    set: &[Signal],
    p: &mut Problems<'_>,
) -> Vec<(String, Signal)> {
    let mut found: Vec<(String, Signal)> = Vec::new();
    for (axis, text) in brakes {
        let Some(output) = signal::output_of_text(text, known, p) else {
            continue;
        };
        let taken = found.iter().find(|(_, other)| *other == output);
        let problem = if output.field.bit_len != 1 {
            let bits = output.field.bit_len;
            Some((
                format!("`{}` has {bits} bits", output.name),
                "a brake is opened by an output of one bit",
            ))
        } else if let Some((other, _)) = taken {
            let message = format!("`{}` opens the brake of `{other}` already", output.name);
            Some((message, "each brake has an output of its own"))
        } else if set.contains(&output) {
            let message = format!(
                "`{}` opens the brake of `{axis}`, and a step sets it",
                output.name
            );
            Some((
                message,
                "take it out of the step: the axis opens and closes its brake",
            ))
        } else {
            None
        };
        match problem {
            Some((message, hint)) => p.add_hint(text.span(), message, hint),
            None => found.push((axis.clone(), output)),
        }
    }
    found
}

fn bus(raw: RawBus, p: &mut Problems<'_>) -> Option<Bus> {
    let defaults = Bus::default();
    let cycle_ns = raw
        .cycle
        .as_ref()
        .and_then(|c| in_range(c, 50_000, 100_000_000, "a cycle", p));
    // The watchdog registers count 100 µs in 16 bits.
    let watchdog = raw
        .watchdog
        .as_ref()
        .map(|w| in_range(w, 1_000_000, 6_553_500_000, "a watchdog", p));
    let watchdog_ns = watchdog.unwrap_or(Some(defaults.watchdog_ns));
    if let (Some(cycle), Some(watchdog)) = (cycle_ns, watchdog_ns)
        && watchdog < cycle * 2
    {
        let at = raw
            .watchdog
            .as_ref()
            .or(raw.cycle.as_ref())
            .map_or(0..0, Spanned::span);
        let message = format!(
            "the watchdog of {} expires between two cycles of {}",
            duration::show(watchdog),
            duration::show(cycle),
        );
        p.add_hint(at, message, "make `watchdog` several cycles long");
    } else if let (Some(cycle), Some(watchdog)) = (cycle_ns, watchdog_ns) {
        check_lost_frames(&raw, cycle, watchdog, p);
    }
    let clock_window = raw
        .clock_window
        .as_ref()
        .map(|w| in_range(w, 100, 1_000_000_000, "a window for clocks", p));
    let clock_window_ns = clock_window.unwrap_or(Some(defaults.clock_window_ns));
    if let (Some(spin), Some(cycle)) = (&raw.spin, cycle_ns)
        && spin.get_ref().is_some_and(|spin| spin > cycle)
    {
        p.add(
            spin.span(),
            "spinning longer than a cycle never sleeps: `spin` must not exceed `cycle`",
        );
    }
    let exchange = raw
        .exchange
        .map_or(Some(Exchange::SameCycle), |e| match e.get_ref().as_str() {
            "same-cycle" => Some(Exchange::SameCycle),
            "pipelined" => Some(Exchange::Pipelined),
            other => {
                p.add_hint(
                    e.span(),
                    format!("unknown exchange `{other}`"),
                    "there are \"same-cycle\" and \"pipelined\"",
                );
                None
            }
        });
    let awake = match &raw.idle {
        Some(idle) => awake(idle, raw.cpu.is_some(), p),
        None => Some(defaults.awake),
    };
    let link = raw.link.map_or(Some(defaults.link), |l| back_end(&l, p));
    let timeout = |value: Option<Spanned<u64>>, default: u64, p: &mut Problems<'_>| match value {
        Some(value) => in_range(&value, 1_000_000, 600_000_000_000, "a timeout", p),
        None => Some(default),
    };
    let op_timeout_ns = timeout(raw.op_timeout, defaults.op_timeout_ns, p);
    let enable_timeout_ns = timeout(raw.enable_timeout, defaults.enable_timeout_ns, p);
    let nic = match &raw.nic {
        Some(name) => nic(name, p),
        None => Some(Nic::Sim),
    };
    Some(Bus {
        nic: nic?,
        cycle_ns: cycle_ns?,
        lost_frames: raw
            .lost_frames
            .map_or(defaults.lost_frames, Spanned::into_inner),
        cpu: raw
            .cpu
            .and_then(|cpu| usize::try_from(cpu.into_inner()).ok()),
        priority: raw.priority.map_or(defaults.priority, Spanned::into_inner),
        spin: match raw.spin.and_then(Spanned::into_inner) {
            Some(spin) => Spin::For(spin),
            None => Spin::Auto,
        },
        awake: awake?,
        op_timeout_ns: op_timeout_ns?,
        enable_timeout_ns: enable_timeout_ns?,
        watchdog_ns: watchdog_ns?,
        clock_window_ns: clock_window_ns?,
        exchange: exchange?,
        link: link?,
        written: raw.written,
    })
}

/// Returns `true` if `cpu` is kept awake.
fn awake(idle: &Spanned<String>, has_cpu: bool, p: &mut Problems<'_>) -> Option<bool> {
    match idle.get_ref().as_str() {
        "sleep" => Some(false),
        "awake" if has_cpu => Some(true),
        "awake" => {
            p.add_hint(
                idle.span(),
                "it is not said which CPU to keep awake",
                "say where the real-time thread runs: `cpu = 1`",
            );
            None
        }
        other => {
            p.add_hint(
                idle.span(),
                format!("unknown idle `{other}`"),
                "there are \"sleep\" and \"awake\"",
            );
            None
        }
    }
}

fn back_end(name: &Spanned<String>, p: &mut Problems<'_>) -> Option<SocketKind> {
    let found = SocketKind::ALL.iter().find(|b| b.name() == name.get_ref());
    if found.is_none() {
        let names: Vec<_> = SocketKind::ALL.iter().map(|b| format!("\"{b}\"")).collect();
        p.add_hint(
            name.span(),
            format!("unknown link `{}`", name.get_ref()),
            format!("there are {}", names.join(" and ")),
        );
    }
    found.copied()
}

/// Checks that lost frames stop the axes before the drives' watchdogs expire.
fn check_lost_frames(raw: &RawBus, cycle: u64, watchdog: u64, p: &mut Problems<'_>) {
    let lost = raw
        .lost_frames
        .as_ref()
        .map_or(Bus::default().lost_frames, |l| *l.get_ref());
    let gap = u64::from(lost) * cycle;
    if gap < watchdog {
        return;
    }
    let at = raw.lost_frames.as_ref().map(Spanned::span);
    let at = at.or(raw.watchdog.as_ref().map(Spanned::span));
    let at = at.or(raw.cycle.as_ref().map(Spanned::span));
    let message = format!(
        "`lost_frames` = {lost} cycles of {} are {}, but the drives' `watchdog` stops them after {}",
        duration::show(cycle),
        duration::show(gap),
        duration::show(watchdog),
    );
    // At least 1, because the watchdog is two cycles or longer.
    let most = (watchdog - 1) / cycle;
    let hint = format!("write `lost_frames = {most}` or less, or a longer `watchdog`");
    p.add_hint(at.unwrap_or(0..0), message, hint);
}

fn in_range(
    ns: &Spanned<u64>,
    low: u64,
    high: u64,
    what: &str,
    p: &mut Problems<'_>,
) -> Option<u64> {
    let value = *ns.get_ref();
    if (low..=high).contains(&value) {
        return Some(value);
    }
    let message = format!(
        "{what} of {} is not possible; it must be from {} to {}",
        duration::show(value),
        duration::show(low),
        duration::show(high),
    );
    p.add(ns.span(), message);
    None
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

fn unique_names(devices: &[RawDevice], p: &mut Problems<'_>) {
    for (i, device) in devices.iter().enumerate() {
        let Some(name) = &device.name else { continue };
        if name.get_ref().trim().is_empty() {
            p.add(name.span(), "a device needs a name");
        }
        let twin = devices[..i]
            .iter()
            .filter_map(|d| d.name.as_ref())
            .find(|n| n.get_ref() == name.get_ref());
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
        let given = [
            device
                .position
                .as_ref()
                .map(|n| (Locator::Position(*n.get_ref()), n.span())),
            device
                .alias
                .as_ref()
                .map(|n| (Locator::Alias(*n.get_ref()), n.span())),
            device
                .id
                .as_ref()
                .map(|n| (Locator::Id(*n.get_ref()), n.span())),
        ];
        let mut given = given.into_iter().flatten();
        let place = match (given.next(), given.next()) {
            (Some(place), None) => Some(place),
            (Some(_), Some((_, span))) => {
                p.add(
                    span,
                    "a device is found by one of `position`, `alias` and `id`, not by two",
                );
                None
            }
            (None, _) if device.placed => None,
            (None, _) => {
                let message = "it is not said where on the bus the device is";
                let hint = format!("add `position = {}`, or `alias` or `id`", places.len());
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
