//! One axis: units, limits, and the unit of the drive's velocities.

use ecaxis_axis::cia402::QuickStopOption;
use ecaxis_axis::{
    Axis, AxisConfig, ConfigError, LimitError, Limits, Mode, Modes, Scale, ScaleError, VelocityUnit,
};
use ecaxis_esi as esi;
use toml::Spanned;

pub(crate) mod control;

use super::problem::{Problems, Span, suggestion};
use super::raw::{RawAxis, RawLimits, RawSdo, SdoValue};
use super::units::unit;
use super::{AxisSetup, VelocityUnitFrom};

pub(crate) fn setup(
    raw: &RawAxis,
    sdos: &[RawSdo],
    mode: esi::Mode,
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<AxisSetup> {
    let velocity = velocity_unit(raw, sdos, selection, p);
    let name = unit(raw.unit.as_ref(), p);
    // A wrong name is no reason to leave the figures unread.
    let shown = name.as_deref().unwrap_or("units");
    let scale = scale(raw, shown, p);
    let limits = limits(&raw.limits, shown, p);
    let ((velocity_unit, velocity_unit_from), limits) = (velocity?, limits?);
    let scale = scale?.with_velocity_unit(velocity_unit);
    let mut config = AxisConfig::new(Mode::from_code(mode.code()), scale, limits);
    if let Some(window) = &raw.target_window {
        config.target_window = *positive(window, "target_window", shown, p)?;
    }
    config.modes = modes(config.mode, selection);
    config.jerk_limited = raw.limits.jerk.is_some();
    config.loops = control::loops(&raw.loops, shown, selection, p)?;
    control::guards(raw, &mut config, shown, p)?;
    config.quick_stop = quick_stop(sdos, selection);
    let homing = match &raw.homing {
        Some(homing) => Some(control::homing(homing, &config, selection, p)?),
        None => None,
    };
    if let Some(dead_time) = &raw.dead_time {
        config.dead_time_s = *dead_time.get_ref() as f64 * 1e-9;
    }
    if let Err(e) = Axis::new(config) {
        let (at, message) = refused(&e, raw, shown);
        p.add(at, message);
        return None;
    }
    Some(AxisSetup {
        config,
        unit: name?,
        mode,
        velocity_unit_from,
        homing,
    })
}

/// 0x605A, as it will be.
fn quick_stop(sdos: &[RawSdo], selection: Option<&esi::Selection>) -> Option<QuickStopOption> {
    const QUICK_STOP_OPTION: u16 = 0x605a;
    let written = sdos.iter().find(|s| s.index == QUICK_STOP_OPTION);
    if let Some(written) = written {
        return match written.value.get_ref() {
            SdoValue::Integer(n) => Some(QuickStopOption(i16::try_from(*n).ok()?)),
            _ => None,
        };
    }
    let item = selection?.dictionary.item(QUICK_STOP_OPTION, 0)?;
    let bytes = <[u8; 2]>::try_from(item.default.as_slice()).ok()?;
    item.has_default
        .then(|| QuickStopOption(i16::from_le_bytes(bytes)))
}

/// Those that can be switched to: 0x6060 and its display are in the process data, and the mode's target is.
fn modes(own: Mode, selection: Option<&esi::Selection>) -> Modes {
    let mut modes = Modes::only(own);
    let Some(layout) = selection.map(|s| &s.layout) else {
        return modes;
    };
    if layout.rx_field(0x6060, 0).is_none() || layout.tx_field(0x6061, 0).is_none() {
        return modes;
    }
    let targets: [(Mode, &[u16]); 5] = [
        (Mode::Csp, &[0x607a]),
        (Mode::Csv, &[0x60ff]),
        (Mode::Cst, &[0x6071]),
        // The speed of a move is a fraction of the axis' limit, so the drive has to be told.
        (Mode::Pp, &[0x607a, 0x6081, 0x6083, 0x6084]),
        (Mode::Pv, &[0x60ff, 0x6083, 0x6084]),
    ];
    for (mode, targets) in targets {
        let mapped = |index: &u16| layout.rx_field(*index, 0).is_some();
        if targets.iter().all(mapped) {
            modes = modes.with(mode);
        }
    }
    modes.with(Mode::Hm)
}

/// `unit` may be empty.
pub(super) fn positive<'v>(
    value: &'v Spanned<f64>,
    what: &str,
    unit: &str,
    p: &mut Problems<'_>,
) -> Option<&'v f64> {
    if *value.get_ref() > 0.0 {
        return Some(value.get_ref());
    }
    let gap = if unit.is_empty() { "" } else { " " };
    let message = format!(
        "`{what}` is {}{gap}{unit}, but must be above zero",
        value.get_ref()
    );
    p.add(value.span(), message);
    None
}

/// What the axis refuses, at the key that is to blame and in the user's unit.
fn refused(error: &ConfigError, raw: &RawAxis, unit: &str) -> (Span, String) {
    let limits = &raw.limits;
    let of = |value: Option<Span>| value.unwrap_or(limits.span.clone());
    let velocity = of(limits.velocity.as_ref().map(Spanned::span));
    let position = of(limits.position.as_ref().map(Spanned::span));
    let torque = of(limits.torque.as_ref().map(Spanned::span));
    match error {
        ConfigError::Limit(LimitError::RangeTooWide { low, high, counts }) => (
            position,
            format!(
                "`limits.position` of {low} to {high} {unit} is {counts:.3e} counts wide, more than \
                 the 2^31 that a drive can tell apart"
            ),
        ),
        ConfigError::Limit(LimitError::VelocityNotRepresentable {
            velocity: limit,
            raw,
            unit: drive,
        }) => (
            velocity,
            format!(
                "`limits.velocity` of {limit} {unit}/s is {raw:.3e} {drive}, more than 32 bits hold"
            ),
        ),
        ConfigError::Limit(LimitError::TorqueNotRepresentable { torque: limit }) => (
            torque,
            format!("`limits.torque` of {limit} % is more than the 3276.7 % that 16 bits hold"),
        ),
        ConfigError::Limit(LimitError::EmptyRange { .. }) => (position, error.to_string()),
        ConfigError::NotPositive { .. } => (
            of(raw.target_window.as_ref().map(Spanned::span)),
            error.to_string(),
        ),
        ConfigError::Limit(LimitError::NotPositive { .. }) | ConfigError::Mode(_) => {
            (limits.span.clone(), error.to_string())
        }
        ConfigError::Outside { .. } => {
            let at = raw.dead_time.as_ref().map(Spanned::span);
            let at = at.or(raw.loops.cst.as_ref().map(|cst| cst.span.clone()));
            (at.unwrap_or(raw.span.clone()), error.to_string())
        }
    }
}

/// Counts of a motor turn.
const MOST_COUNTS: f64 = 2_147_483_648.0;

fn scale(raw: &RawAxis, unit: &str, p: &mut Problems<'_>) -> Option<Scale> {
    let encoder = raw
        .encoder
        .as_ref()
        .and_then(|v| positive(v, "encoder", "", p));
    if let Some(at) = raw
        .encoder
        .as_ref()
        .filter(|v| *v.get_ref() > 0.0 && *v.get_ref() < 1.0)
    {
        p.add_hint(
            at.span(),
            format!("`encoder` is {}, less than one count a turn", at.get_ref()),
            "write the counts of one motor turn, four to a line of an incremental encoder; \
             a gear belongs in `per_turn`",
        );
        return None;
    }
    if let Some(at) = raw.encoder.as_ref().filter(|v| *v.get_ref() > MOST_COUNTS) {
        p.add(
            at.span(),
            format!("`encoder` is {}, more than 32 bits can count", at.get_ref()),
        );
        return None;
    }
    let per_turn = match &raw.per_turn {
        Some(v) => positive(v, "per_turn", unit, p),
        None => Some(&1.0),
    };
    let scale = match Scale::new(*encoder?, *per_turn?) {
        Ok(scale) => scale,
        Err(e) => {
            let at = raw.per_turn.as_ref().or(raw.encoder.as_ref());
            let message = match e {
                ScaleError::Unusable { counts_per_unit } => {
                    format!("1 {unit} is {counts_per_unit:.3e} counts, outside 1e-6 … 1e15")
                }
                _ => e.to_string(),
            };
            p.add(at.map_or(raw.span.clone(), Spanned::span), message);
            return None;
        }
    };
    let offset = raw.offset.as_ref().map_or(0.0, |o| *o.get_ref());
    let invert = raw.invert.as_ref().is_some_and(|i| *i.get_ref());
    scale.with_invert(invert).with_offset(offset).ok()
}

fn limits(raw: &RawLimits, unit: &str, p: &mut Problems<'_>) -> Option<Limits> {
    let mut ok = true;
    let mut read = |value: &Option<Spanned<f64>>, what: &str, unit: &str| {
        let value = value.as_ref().map(|v| positive(v, what, unit, p).copied());
        ok &= value != Some(None);
        value.flatten()
    };
    let velocity = read(&raw.velocity, "limits.velocity", &format!("{unit}/s"));
    let acceleration = read(
        &raw.acceleration,
        "limits.acceleration",
        &format!("{unit}/s²"),
    );
    let torque = read(&raw.torque, "limits.torque", "%");
    let jerk = read(&raw.jerk, "limits.jerk", &format!("{unit}/s³"));
    let following_error = read(&raw.following_error, "limits.following_error", unit);
    if let (Some(velocity), Some(acceleration), Some(at)) =
        (velocity, acceleration, &raw.acceleration)
        && let Some(time) = too_long(velocity, acceleration)
    {
        let message = format!(
            "`limits.acceleration` of {acceleration} {unit}/s² takes {time} to stop from the \
             {velocity} {unit}/s of `limits.velocity`"
        );
        p.add_hint(at.span(), message, "a stop may last an hour at most");
        ok = false;
    }
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
        jerk,
        torque: torque.unwrap_or(100.0),
        following_error,
    };
    ok.then_some(limits)
}

/// How long it takes to reach a velocity, where that is more than an hour.
pub(crate) fn too_long(velocity: f64, acceleration: f64) -> Option<String> {
    const HOUR: f64 = 3600.0;
    let seconds = velocity / acceleration;
    // Not a comparison with `>`: infinity over infinity is too long as well.
    if seconds <= HOUR {
        return None;
    }
    Some(if seconds < 1000.0 * HOUR {
        format!("{:.1} h", seconds / HOUR)
    } else {
        format!("{:.3e} h", seconds / HOUR)
    })
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
) -> Option<(VelocityUnit, VelocityUnitFrom)> {
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
        return known.map(|(_, unit)| (*unit, VelocityUnitFrom::File));
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
    let written = written.map(|code| (code, VelocityUnitFrom::Sdo));
    let default = || default().map(|code| (code, VelocityUnitFrom::Esi));
    let Some((code, from)) = written.or_else(default) else {
        return Some((VelocityUnit::default(), VelocityUnitFrom::Nothing));
    };
    let unit = VelocityUnit::from_si_code(code);
    if unit.is_none() {
        let message =
            format!("the drive's velocity unit (0x60A9) is 0x{code:08x}, which is not understood");
        let hint = "say it with `velocity_unit = \"rpm\"`, \"mrpm\", \"counts/s\" or \"turns/s\"";
        p.add_hint(raw.span.clone(), message, hint);
    }
    Some((unit?, from))
}
