//! One axis: units, limits, and the drive's velocity unit.

use ecaxis_axis::cia402::QuickStopOption;
use ecaxis_axis::{Axis, AxisConfig, Compensation, ConfigError, LimitError, Limits, Mode, Modes};
use ecaxis_ecat::index::DeviceIndex;
use ecaxis_esi as esi;
use toml::Spanned;

pub(crate) mod control;
mod scale;
mod torque_limit;

pub(crate) use scale::{ambiguous_start, is_maxon};
pub use torque_limit::TorqueLimit;
pub(crate) use torque_limit::torque_limit;

use super::fields::KeyExt;
use super::problem::{Problems, Span};
use super::raw::{RawAxis, RawLimits, RawSdo, SdoValue};
use super::units::unit;
use super::{AxisSetup, TorqueSetup, TorqueUnit};

pub(crate) fn setup(
    raw: &RawAxis,
    sdos: &[RawSdo],
    mode: esi::Mode,
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<AxisSetup> {
    let velocity = scale::velocity_unit(raw, sdos, selection, p);
    let name = unit(raw.unit.as_ref(), p);
    // The numbers are checked even if the unit's name is wrong.
    let shown = name.as_deref().unwrap_or("units");
    let scale = scale::scale(raw, shown, p);
    let torque = scale::torque(raw, sdos, selection, p);
    let limits = limits(&raw.limits, torque.as_ref(), shown, p);
    let ((velocity_unit, velocity_unit_from), limits) = (velocity?, limits?);
    let torque = torque?;
    let (acceleration_unit, acceleration_unit_from) =
        scale::acceleration_unit(velocity_unit, sdos, selection);
    let mut scale = scale?.with_velocity_unit(velocity_unit);
    if acceleration_unit != velocity_unit.into() {
        scale = scale.with_acceleration_unit(acceleration_unit);
    }
    let mut config = AxisConfig::new(Mode::from_code(mode.code()), scale, limits);
    if let Some(window) = &raw.target_window {
        config.target_window = positive(window, "target_window", shown, p)?;
    }
    config.modes = modes(config.mode, selection);
    config.jerk_limited = raw.limits.jerk.is_some();
    config.loops = control::loops(raw, shown, selection, p)?;
    control::guards(raw, &mut config, &torque, shown, p)?;
    config.quick_stop_ends = selection.is_some_and(|selection| selection.layout.idns);
    config.quick_stop = match config.quick_stop_ends {
        // A falling edge of "drive on" decelerates, then removes the torque.
        true => Some(QuickStopOption(2)),
        false => quick_stop(sdos, selection),
    };
    let homing = match &raw.homing {
        Some(homing) => Some(control::homing(homing, &config, selection, p)?),
        None => None,
    };
    config.home = homing.as_ref().map(|setup| setup.homing.reference(&config));
    config.stop_timeout_s = control::seconds(&raw.stop_timeout);
    config.absolute = raw.absolute.value().unwrap_or(false);
    scale::absolute_range(raw, &config, shown, p)?;
    config.absolute_start = ambiguous_start(&config, shown).is_none();
    config.follows_bit = raw.follows_bit.value().unwrap_or(true);
    for (key, place) in [
        ("mode_display", raw.mode_display.place()),
        ("mode_change", raw.mode_change.place()),
        ("mode_time", raw.mode_time.place()),
    ] {
        let mapped = |s: &esi::Selection| s.layout.tx_field(0x6061, 0).is_some();
        if let Some(place) = place
            && selection.is_some_and(|selection| !mapped(selection))
        {
            let message = format!("`{key}` needs 0x6061 in the process data");
            p.add_hint(place, message, "add \"0x6061\" to `pdo.tx`");
        }
    }
    config.mode_display_enabled = raw.mode_display.value().unwrap_or(false);
    config.mode_change_unpowered = raw.mode_change.value().unwrap_or(false);
    if let Some(mode_time_s) = control::seconds(&raw.mode_time) {
        config.mode_time_s = mode_time_s;
    }
    if let Some(dead_time_s) = control::seconds(&raw.dead_time) {
        config.dead_time_s = dead_time_s;
    }
    if let Err(e) = Axis::new(config) {
        let (at, message) = refused(&e, raw, &torque, shown);
        p.add(at, message);
        return None;
    }
    Some(AxisSetup {
        name: String::new(),
        device: DeviceIndex(0),
        number: 0,
        node: None,
        config,
        unit: name?,
        mode,
        velocity_unit_from,
        acceleration_unit_from,
        torque,
        way: raw.way.value().unwrap_or_default(),
        homing,
        compensation: Compensation::default(),
        second_encoder: None,
        brake_output: None,
        torque_limit: TorqueLimit::default(),
    })
}

/// Returns 0x605A as it is after start-up.
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

/// The targets that a mode needs in the process data, and the reported values.
pub(super) const MODE_OBJECTS: [(Mode, &[u16], &[u16]); 5] = [
    // A switch to a position mode starts from the actual position.
    (Mode::Csp, &[0x607a], &[0x6064]),
    (Mode::Csv, &[0x60ff], &[]),
    // A switch to CST starts from the actual torque.
    (Mode::Cst, &[0x6071], &[0x6077]),
    // A move's speed is a fraction of the axis limit, so the drive needs the profile objects.
    (Mode::Pp, &[0x607a, 0x6081, 0x6083, 0x6084], &[0x6064]),
    (Mode::Pv, &[0x60ff, 0x6083, 0x6084], &[]),
];

/// Returns the modes to which the axis can switch. 0x6060, 0x6061 and the mode's targets must be in
/// the process data.
fn modes(own: Mode, selection: Option<&esi::Selection>) -> Modes {
    let mut modes = Modes::only(own);
    let Some(layout) = selection.map(|s| &s.layout) else {
        return modes;
    };
    if layout.rx_field(0x6060, 0).is_none() || layout.tx_field(0x6061, 0).is_none() {
        return modes;
    }
    for (mode, targets, reported) in MODE_OBJECTS {
        let sent = targets
            .iter()
            .all(|index| layout.rx_field(*index, 0).is_some());
        let seen = reported
            .iter()
            .all(|index| layout.tx_field(*index, 0).is_some());
        if sent && seen {
            modes = modes.with(mode);
        }
    }
    modes.with(Mode::Hm)
}

/// Returns the value if it is positive. `unit` may be empty.
pub(super) fn positive(
    value: &Spanned<f64>,
    what: &str,
    unit: &str,
    p: &mut Problems<'_>,
) -> Option<f64> {
    if *value.get_ref() > 0.0 {
        return Some(*value.get_ref());
    }
    let gap = if unit.is_empty() { "" } else { " " };
    let message = format!(
        "`{what}` is {}{gap}{unit}, but must be above zero",
        value.get_ref()
    );
    p.add(value.span(), message);
    None
}

/// Returns the key and message, in the user's unit, for a configuration that the axis rejects.
fn refused(error: &ConfigError, raw: &RawAxis, known: &TorqueSetup, unit: &str) -> (Span, String) {
    let limits = &raw.limits;
    let of = |value: Option<Span>| value.unwrap_or(limits.span.clone());
    let velocity = of(limits.velocity.place());
    let position = of(limits.position.place());
    let torque = of(limits.torque.place());
    match error {
        ConfigError::Limit(LimitError::RangeTooWide { low, high, counts }) => (
            position,
            format!(
                "`limits.position` of {low} to {high} {unit} is {counts:.3e} counts wide, more than \
                 the 2^31 that a drive can distinguish"
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
            match known.unit {
                TorqueUnit::Percent => format!(
                    "`limits.torque` of {limit} % is more than the 3276.7 % that 16 bits hold"
                ),
                unit => format!(
                    "`limits.torque` of {} {unit} is {limit:.1} % of the rated torque, more than the \
                     3276.7 % that 16 bits hold",
                    known.shown(*limit)
                ),
            },
        ),
        ConfigError::Limit(LimitError::EmptyRange { .. }) => (position, error.to_string()),
        ConfigError::NotPositive {
            what: "stop_timeout_s",
            ..
        } => (
            of(raw.stop_timeout.place()),
            "`stop_timeout` must be above 0".to_owned(),
        ),
        ConfigError::NotPositive {
            what: "mode_time_s",
            ..
        } => (
            of(raw.mode_time.place()),
            "`mode_time` must be above 0".to_owned(),
        ),
        ConfigError::NotPositive { .. } => (of(raw.target_window.place()), error.to_string()),
        ConfigError::Limit(LimitError::NotPositive { .. }) | ConfigError::Mode(_) => {
            (limits.span.clone(), error.to_string())
        }
        ConfigError::Outside { .. } => {
            let cst = raw.cst.as_ref().map(|cst| cst.span.clone());
            let at = raw.dead_time.place().or(cst);
            (at.unwrap_or(raw.span.clone()), error.to_string())
        }
    }
}

fn limits(
    raw: &RawLimits,
    known: Option<&TorqueSetup>,
    unit: &str,
    p: &mut Problems<'_>,
) -> Option<Limits> {
    let mut ok = true;
    let mut read = |value: &Option<Spanned<f64>>, what: &str, unit: &str| {
        let value = value.as_ref().map(|v| positive(v, what, unit, p));
        ok &= value != Some(None);
        value.flatten()
    };
    let velocity = read(&raw.velocity, "limits.velocity", &format!("{unit}/s"));
    let acceleration = read(
        &raw.acceleration,
        "limits.acceleration",
        &format!("{unit}/s²"),
    );
    let torque_unit = known.map_or(TorqueUnit::Percent, |torque| torque.unit);
    let torque = read(&raw.torque, "limits.torque", torque_unit.sign());
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
        position: raw.position.value(),
        velocity: velocity?,
        acceleration: acceleration?,
        jerk,
        torque: torque.map_or(100.0, |n| known.map_or(n, |known| known.percent(n))),
        following_error,
    };
    ok.then_some(limits)
}

/// Returns the time to reach a velocity if it exceeds one hour.
pub(crate) fn too_long(velocity: f64, acceleration: f64) -> Option<String> {
    const HOUR: f64 = 3600.0;
    let seconds = velocity / acceleration;
    // Written so that NaN (infinity / infinity) counts as too long.
    if seconds <= HOUR {
        return None;
    }
    Some(if seconds < 1000.0 * HOUR {
        format!("{:.1} h", seconds / HOUR)
    } else {
        format!("{:.3e} h", seconds / HOUR)
    })
}
