//! `[[position_output]]`: outputs that follow the position of an axis.

use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec};
use toml::Spanned;

use super::Signal;
use super::copy::BitRange;
use super::fields::KeyExt;
use super::problem::{Problems, suggestion};
use super::raw::RawPositionOutput;
use super::roles::{OutputOwner, OwnerKind, ProcessDataRoles};
use super::signal::{self, SignalDirection};
use super::steps::{Program, ResolvedAxis, ResolvedDevice};
use crate::rt::position_output::PositionTrigger;

/// An output that follows the position of an axis.
#[derive(Debug, Clone, PartialEq)]
pub struct PositionOutputSetup {
    pub output: Signal,
    pub trigger: PositionTrigger,
    /// The line of its table in the machine file.
    pub line: u32,
}

/// Checks the outputs, and makes each the property of its `[[position_output]]`.
pub(crate) fn check(
    raw: &[RawPositionOutput],
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    axes: &IndexVec<AxisIndex, ResolvedAxis<'_>>,
    program: &Program,
    roles: &mut ProcessDataRoles,
    p: &mut Problems<'_>,
) -> Vec<PositionOutputSetup> {
    let mut all: Vec<PositionOutputSetup> = Vec::new();
    for raw in raw {
        let output = raw.output.as_ref();
        let line = p.line(&raw.span);
        let output = output.and_then(|text| one_bit(text, devices, program, (roles, line), p));
        let trigger = trigger(raw, axes, p);
        if let (Some(output), Some(trigger)) = (output, trigger) {
            all.push(PositionOutputSetup {
                output,
                trigger,
                line,
            });
        }
    }
    all
}

/// Returns an output of one bit, owned by the `[[position_output]]` in this line.
fn one_bit(
    text: &Spanned<String>,
    devices: &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
    program: &Program,
    (roles, line): (&mut ProcessDataRoles, u32),
    p: &mut Problems<'_>,
) -> Option<Signal> {
    let named = program.signals.iter().find(|s| s.name == *text.get_ref());
    let word = named.map_or(text.get_ref(), |named| &named.signal);
    let output = match signal::of_text(word, devices, SignalDirection::Out) {
        Ok(output) => output?,
        Err(error) => {
            p.add_hint(text.span(), error.message, error.hint);
            return None;
        }
    };
    if output.field.bit_len != 1 {
        let message = format!("`{}` has {} bits", output.name, output.field.bit_len);
        p.add_hint(
            text.span(),
            message,
            "a position switches an output of one bit",
        );
        return None;
    }
    let owner = OutputOwner::new(OwnerKind::PositionOutput, "", line);
    let owned = roles.claim_at(BitRange::of(&output), owner, text.span(), p);
    owned.then_some(output)
}

fn trigger(
    raw: &RawPositionOutput,
    axes: &IndexVec<AxisIndex, ResolvedAxis<'_>>,
    p: &mut Problems<'_>,
) -> Option<PositionTrigger> {
    let name = raw.axis.as_ref()?;
    let found = axes
        .enumerate()
        .find(|(_, axis)| axis.name == name.get_ref());
    let Some((axis, known)) = found else {
        let hint = suggestion(name.get_ref(), axes.iter().map(|axis| axis.name), "axes");
        p.add_hint(
            name.span(),
            format!("no axis is named `{}`", name.get_ref()),
            hint,
        );
        return None;
    };
    let period = raw.period.value();
    if let (Some(place), Some(period)) = (raw.period.place(), period)
        && period <= 0.0
    {
        p.add_hint(
            place,
            "a `period` is above 0",
            "leave it out: the ranges do not repeat",
        );
        return None;
    }
    let ranges = raw.ranges.as_ref()?;
    let unit = known.setup.map_or("", |setup| &setup.unit);
    let limits = known.setup.and_then(|setup| setup.config.limits.position);
    let [low, high] = match period {
        Some(period) => [0.0, period],
        None => limits.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]),
    };
    let (message, hint) = if ranges.get_ref().is_empty() {
        (
            "no range is given".to_owned(),
            "write `ranges = [[10.0, 20.0]]`",
        )
    } else if let Some([from, to]) = ranges.get_ref().iter().find(|[from, to]| from >= to) {
        (
            format!("the range from {from} to {to} is empty"),
            "write the lower position first",
        )
    } else if let Some([from, to]) =
        (ranges.get_ref().iter()).find(|[from, to]| *from < low || *to > high)
    {
        let message =
            format!("the range from {from} to {to} {unit} is not within {low} to {high} {unit}");
        let hint = match period {
            Some(_) => "ranges are positions in one period",
            None => "correct the range, or `limits.position` of the axis",
        };
        (message, hint)
    } else {
        return Some(PositionTrigger {
            axis,
            actual: raw.actual.value().unwrap_or(false),
            ranges: ranges.get_ref().as_slice().into(),
            period,
            lead_s: raw.lead.value().unwrap_or(0) as f64 * 1e-9,
        });
    };
    p.add_hint(ranges.span(), message, hint);
    None
}
