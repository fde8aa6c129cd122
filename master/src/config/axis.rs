//! One axis: units, limits, and the unit of the drive's velocities.

use ecaxis_axis::{Axis, AxisConfig, Limits, Scale, VelocityUnit};
use ecaxis_esi as esi;
use toml::Spanned;

use super::AxisSetup;
use super::problem::{Problems, suggestion};
use super::raw::{RawAxis, RawSdo, SdoValue};

pub(crate) fn setup(
    raw: &RawAxis,
    sdos: &[RawSdo],
    mode: esi::Mode,
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<AxisSetup> {
    let unit = velocity_unit(raw, sdos, selection, p);
    let scale = scale(raw, p);
    let limits = limits(raw, p);
    let (scale, limits) = (scale?.with_velocity_unit(unit?), limits?);
    let mut config = AxisConfig::new(ecaxis_axis::Mode::from_code(mode.code()), scale, limits);
    if let Some(window) = &raw.target_window {
        config.target_window = *positive(window, "target_window", p)?;
    }
    if let Err(e) = Axis::new(config) {
        p.add(raw.limits.span.clone(), e.to_string());
        return None;
    }
    let unit = raw.unit.as_ref().map_or("turn", |u| u.get_ref().as_str());
    Some(AxisSetup {
        config,
        unit: unit.to_owned(),
        mode,
    })
}

fn positive<'v>(value: &'v Spanned<f64>, what: &str, p: &mut Problems<'_>) -> Option<&'v f64> {
    if *value.get_ref() > 0.0 {
        return Some(value.get_ref());
    }
    p.add(
        value.span(),
        format!("`{what}` is {}, but must be above zero", value.get_ref()),
    );
    None
}

/// Counts of a motor turn.
const MOST_COUNTS: f64 = 2_147_483_648.0;

fn scale(raw: &RawAxis, p: &mut Problems<'_>) -> Option<Scale> {
    let encoder = raw.encoder.as_ref().and_then(|v| positive(v, "encoder", p));
    if let Some(at) = raw.encoder.as_ref().filter(|v| *v.get_ref() > MOST_COUNTS) {
        p.add(
            at.span(),
            format!("`encoder` is {}, more than 32 bits can count", at.get_ref()),
        );
        return None;
    }
    let per_turn = match &raw.per_turn {
        Some(v) => positive(v, "per_turn", p),
        None => Some(&1.0),
    };
    let scale = match Scale::new(*encoder?, *per_turn?) {
        Ok(scale) => scale,
        Err(e) => {
            p.add(
                raw.per_turn
                    .as_ref()
                    .map_or(raw.span.clone(), Spanned::span),
                e.to_string(),
            );
            return None;
        }
    };
    let offset = raw.offset.as_ref().map_or(0.0, |o| *o.get_ref());
    let invert = raw.invert.as_ref().is_some_and(|i| *i.get_ref());
    scale.with_invert(invert).with_offset(offset).ok()
}

fn limits(raw: &RawAxis, p: &mut Problems<'_>) -> Option<Limits> {
    let raw = &raw.limits;
    let mut ok = true;
    let mut read = |value: &Option<Spanned<f64>>, what: &str| {
        let value = value.as_ref().map(|v| positive(v, what, p).copied());
        ok &= value != Some(None);
        value.flatten()
    };
    let velocity = read(&raw.velocity, "limits.velocity");
    let acceleration = read(&raw.acceleration, "limits.acceleration");
    let torque = read(&raw.torque, "limits.torque");
    let following_error = read(&raw.following_error, "limits.following_error");
    if let Some(range) = &raw.position
        && range.get_ref()[0] >= range.get_ref()[1]
    {
        p.add_hint(
            range.span(),
            "the range of positions is empty",
            "write the lower end first",
        );
        ok = false;
    }
    let limits = Limits {
        position: raw.position.as_ref().map(|r| *r.get_ref()),
        velocity: velocity?,
        acceleration: acceleration?,
        torque: torque.unwrap_or(100.0),
        following_error,
    };
    ok.then_some(limits)
}

const VELOCITY_UNITS: [(&str, VelocityUnit); 4] = [
    ("rpm", VelocityUnit::RPM),
    ("mrpm", VelocityUnit::MILLI_RPM),
    ("counts/s", VelocityUnit::COUNTS_PER_SECOND),
    ("turns/s", VelocityUnit::TURNS_PER_SECOND),
];

const SI_UNIT_VELOCITY: u16 = 0x60a9;

/// What 0x60A9 will say: the file's word, the file's SDO, or the ESI's default.
fn velocity_unit(
    raw: &RawAxis,
    sdos: &[RawSdo],
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<VelocityUnit> {
    if let Some(text) = &raw.velocity_unit {
        let known = VELOCITY_UNITS
            .iter()
            .find(|(name, _)| *name == text.get_ref());
        if known.is_none() {
            let message = format!("unknown unit of velocity \"{}\"", text.get_ref());
            let names = VELOCITY_UNITS.iter().map(|(name, _)| *name);
            p.add_hint(
                text.span(),
                message,
                suggestion(text.get_ref(), names, "units"),
            );
        }
        return known.map(|(_, unit)| *unit);
    }
    let written = sdos.iter().find(|s| s.index == SI_UNIT_VELOCITY);
    let written = written.and_then(|s| match s.value.get_ref() {
        SdoValue::Integer(n) => u32::try_from(*n).ok(),
        _ => None,
    });
    let default = || {
        let item = selection?.dictionary.item(SI_UNIT_VELOCITY, 0)?;
        let bytes = <[u8; 4]>::try_from(item.default.as_slice()).ok()?;
        item.has_default.then_some(u32::from_le_bytes(bytes))
    };
    let Some(code) = written.or_else(default) else {
        return Some(VelocityUnit::default());
    };
    let unit = VelocityUnit::from_si_code(code);
    if unit.is_none() {
        let message =
            format!("the drive's velocity unit (0x60A9) is 0x{code:08x}, which is not understood");
        let hint = "say it with `velocity_unit = \"rpm\"`, \"mrpm\", \"counts/s\" or \"turns/s\"";
        p.add_hint(raw.span.clone(), message, hint);
    }
    unit
}
