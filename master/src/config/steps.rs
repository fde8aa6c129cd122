//! The demonstration program: axes by name, targets within limits.

use toml::Spanned;

use super::axis::too_long;
use super::problem::{Problems, suggestion};
use super::raw::{RawStep, RawTarget, Verb};
use super::{AxisSetup, DeviceConfig, Step};
use crate::config::device::mode_name;
use ecaxis_axis::Mode;

const WHOLE_TORQUE_RAMP_NS: u64 = 100_000_000;

/// What steps know about a device, which may itself be wrong.
pub(crate) struct Known<'c> {
    pub name: &'c str,
    /// `Err(false)`: it has no axis; `Err(true)`: its axis is wrong, and that has been said.
    pub axis: Result<&'c AxisSetup, bool>,
}

impl<'c> From<&'c DeviceConfig> for Known<'c> {
    fn from(device: &'c DeviceConfig) -> Self {
        Self {
            name: &device.name,
            axis: device.axis.as_ref().ok_or(false),
        }
    }
}

pub(crate) fn check(steps: Vec<RawStep>, devices: &[Known<'_>], p: &mut Problems<'_>) -> Vec<Step> {
    steps
        .into_iter()
        .filter_map(|step| one(step, devices, p))
        .collect()
}

fn one(step: RawStep, devices: &[Known<'_>], p: &mut Problems<'_>) -> Option<Step> {
    match step {
        RawStep::Dwell(ns) => Some(Step::Dwell {
            ns: ns.into_inner(),
        }),
        RawStep::Torque { targets, ramp } => {
            let targets = resolve(targets, "torque", Mode::Cst, devices, p);
            let ramp_ns = ramp.map_or(WHOLE_TORQUE_RAMP_NS, Spanned::into_inner);
            Some(Step::Torque {
                targets: targets?,
                ramp_ns,
            })
        }
        RawStep::Motion {
            verb,
            targets,
            speed,
            ramp,
        } => {
            let ramp_at = ramp.as_ref().map(Spanned::span);
            let speed = fraction(speed, "speed", p);
            let ramp = fraction(ramp, "ramp", p);
            let slow = |targets: &[(usize, f64)], p: &mut Problems<'_>| {
                let at = ramp_at.clone()?;
                ramps(targets, verb, speed?, ramp?, devices).map(|message| {
                    p.add_hint(at, message, "a ramp may last an hour at most");
                })
            };
            match verb {
                Verb::Move => {
                    let targets = resolve(targets, "move", Mode::Csp, devices, p)?;
                    slow(&targets, p);
                    Some(Step::Move {
                        targets,
                        speed: speed?,
                        ramp: ramp?,
                    })
                }
                Verb::Velocity => {
                    let targets = resolve(targets, "velocity", Mode::Csv, devices, p)?;
                    slow(&targets, p);
                    Some(Step::Velocity {
                        targets,
                        ramp: ramp?,
                    })
                }
            }
        }
    }
}

/// What is wrong where an axis would take more than an hour to reach its velocity.
fn ramps(
    targets: &[(usize, f64)],
    verb: Verb,
    speed: f64,
    ramp: f64,
    devices: &[Known<'_>],
) -> Option<String> {
    targets.iter().find_map(|&(index, target)| {
        let device = devices.get(index)?;
        let limits = &device.axis.ok()?.config.limits;
        let velocity = match verb {
            Verb::Move => limits.velocity * speed,
            Verb::Velocity => target.abs(),
        };
        let time = too_long(velocity, limits.acceleration * ramp)?;
        let name = device.name;
        Some(format!(
            "with a `ramp` of {ramp}, `{name}` takes {time} to reach its velocity"
        ))
    })
}

fn fraction(value: Option<Spanned<f64>>, what: &str, p: &mut Problems<'_>) -> Option<f64> {
    let Some(value) = value else { return Some(1.0) };
    let n = *value.get_ref();
    if n > 0.0 && n <= 1.0 {
        return Some(n);
    }
    let limit = if what == "speed" {
        "velocity"
    } else {
        "acceleration"
    };
    let message = format!("`{what}` is {n}, but it is a fraction of the axis' {limit} limit");
    p.add_hint(value.span(), message, "a number above 0.0 and up to 1.0");
    None
}

fn resolve(
    targets: Vec<RawTarget>,
    verb: &str,
    mode: Mode,
    devices: &[Known<'_>],
    p: &mut Problems<'_>,
) -> Option<Vec<(usize, f64)>> {
    let count = targets.len();
    let mut resolved = Vec::with_capacity(count);
    for RawTarget { axis: name, value } in targets {
        let Some(index) = devices.iter().position(|d| d.name == name.get_ref()) else {
            let names = devices
                .iter()
                .filter(|d| d.axis != Err(false))
                .map(|d| d.name);
            let hint = suggestion(name.get_ref(), names, "axes");
            p.add_hint(
                name.span(),
                format!("no device is named `{}`", name.get_ref()),
                hint,
            );
            continue;
        };
        let axis = match devices[index].axis {
            Ok(axis) => axis,
            Err(true) => continue,
            Err(false) => {
                let message = format!("`{}` has no axis to move", name.get_ref());
                p.add_hint(
                    name.span(),
                    message,
                    "give it a [device.axis], or leave it out here",
                );
                continue;
            }
        };
        if axis.config.mode != mode {
            let message = format!(
                "`{verb}` needs an axis in mode \"{}\"; `{}` is in \"{}\"",
                mode_name(mode),
                name.get_ref(),
                axis.mode,
            );
            let hint = match axis.config.mode {
                Mode::Csv => "write `velocity = { … }` for it",
                Mode::Cst => "write `torque = { … }` for it",
                _ => "write `move = { … }` for it",
            };
            p.add_hint(name.span(), message, hint);
            continue;
        }
        if within(*value.get_ref(), &value, verb, axis, p) {
            resolved.push((index, value.into_inner()));
        }
    }
    resolved.sort_by_key(|(index, _)| *index);
    (resolved.len() == count).then_some(resolved)
}

fn within(n: f64, at: &Spanned<f64>, verb: &str, axis: &AxisSetup, p: &mut Problems<'_>) -> bool {
    let limits = &axis.config.limits;
    let unit = &axis.unit;
    let (low, high, unit) = match verb {
        "move" => match limits.position {
            Some([low, high]) => (low, high, unit.clone()),
            None => return true,
        },
        "velocity" => (-limits.velocity, limits.velocity, format!("{unit}/s")),
        _ => (-limits.torque, limits.torque, "%".into()),
    };
    if (low..=high).contains(&n) {
        return true;
    }
    let message = format!("{n} {unit} is outside the axis' limits, {low} to {high} {unit}");
    p.add(at.span(), message);
    false
}
