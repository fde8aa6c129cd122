//! Control and supervision of an axis: loops, brake, supervision, fault reset, homing.

use ecaxis_axis::homing::{self, Homing, ParameterError};
use ecaxis_axis::supervision::{Brake, FaultReset, StopMethod, Supervision, TorqueWatch};
use ecaxis_axis::{AxisConfig, FeedForward, Loops, PositionPid, VelocityLoop};
use ecaxis_esi as esi;
use toml::Spanned;

use super::super::problem::{Problems, suggestion};
use super::super::raw::{RawAxis, RawHoming, RawLoops};
use super::super::{HomingSetup, TorqueSetup};
use super::{MAXON, positive};

/// The default time in s for which torque may exceed its supervised limit.
const TORQUE_TIME_S: f64 = 0.1;
const RESET_DELAY_S: f64 = 1.0;
const HOMING_TIMEOUT_NS: u64 = 60_000_000_000;

fn seconds(time: Option<&Spanned<u64>>) -> Option<f64> {
    time.map(|t| *t.get_ref() as f64 * 1e-9)
}

pub(super) fn loops(
    raw: &RawLoops,
    unit: &str,
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<Loops> {
    let mut offset = |value: &Option<Spanned<f64>>, index: u16| {
        let Some(value) = value else { return Some(0.0) };
        let mapped = selection.is_none_or(|s| s.layout.rx_field(index, 0).is_some());
        if !mapped {
            let message =
                format!("an offset goes into 0x{index:04X}, which is not in the process data");
            p.add_hint(value.span(), message, "map it with `pdo.rx`");
        }
        mapped.then_some(*value.get_ref())
    };
    let csp = FeedForward {
        velocity: offset(&raw.velocity_offset, 0x60b1)?,
        acceleration: offset(&raw.torque_offset, 0x60b2)?,
    };
    let reported = selection.is_none_or(|s| s.layout.tx_field(0x6064, 0).is_some());
    let needs_position = [
        raw.csv.as_ref().and_then(|csv| csv.kv.as_ref()),
        raw.cst.as_ref().and_then(|cst| cst.kp.as_ref()),
    ];
    for gain in needs_position.into_iter().flatten().filter(|_| !reported) {
        let message = "a position loop needs the position (0x6064) in the process data";
        p.add_hint(gain.span(), message, "map it with `pdo.tx`");
    }
    if !reported && (raw.csv.is_some() || raw.cst.is_some()) {
        return None;
    }
    let csv = match &raw.csv {
        Some(csv) => Some(VelocityLoop {
            kv: *positive(csv.kv.as_ref()?, "csv.kv", "1/s", p)?,
            feed_forward: part(csv.feed_forward.as_ref(), 1.0, "csv.feed_forward", p)?,
        }),
        None => None,
    };
    let cst = match &raw.cst {
        Some(cst) => Some(PositionPid {
            kp: *positive(cst.kp.as_ref()?, "cst.kp", &format!("% per {unit}"), p)?,
            tn_s: seconds(cst.tn.as_ref()),
            tv_s: seconds(cst.tv.as_ref()).unwrap_or(0.0),
            acceleration: cst.acceleration.as_ref().map_or(0.0, |a| *a.get_ref()),
        }),
        None => None,
    };
    Some(Loops { csp, csv, cst })
}

/// Returns a weight from 0 to 1.
fn part(
    value: Option<&Spanned<f64>>,
    default: f64,
    what: &str,
    p: &mut Problems<'_>,
) -> Option<f64> {
    let Some(value) = value else {
        return Some(default);
    };
    let n = *value.get_ref();
    if (0.0..=1.0).contains(&n) {
        return Some(n);
    }
    p.add(
        value.span(),
        format!("`{what}` is {n}, but it is a weight from 0 to 1"),
    );
    None
}

/// Reads brake, fault reset and supervision.
pub(super) fn guards(
    raw: &RawAxis,
    config: &mut AxisConfig,
    known: &TorqueSetup,
    unit: &str,
    p: &mut Problems<'_>,
) -> Option<()> {
    config.brake = Brake {
        release_s: seconds(raw.brake.release.as_ref()).unwrap_or(0.0),
        engage_s: seconds(raw.brake.engage.as_ref()).unwrap_or(0.0),
    };
    if let Some(tries) = &raw.fault_reset.tries {
        config.fault_reset = FaultReset::Automatic {
            tries: *tries.get_ref(),
            delay_s: seconds(raw.fault_reset.delay.as_ref()).unwrap_or(RESET_DELAY_S),
        };
    }
    let watch = &raw.supervise;
    let mut above_zero = |value: &Option<Spanned<f64>>, what: &str, unit: &str| match value {
        Some(value) => positive(value, what, unit, p).map(|n| Some(*n)),
        None => Some(None),
    };
    let torque = above_zero(&watch.torque, "supervise.torque", known.unit.sign())?;
    let acceleration = above_zero(
        &watch.acceleration,
        "supervise.acceleration",
        &format!("{unit}/s²"),
    )?;
    let standstill = above_zero(
        &watch.standstill,
        "supervise.standstill",
        &format!("{unit}/s"),
    )?;
    config.supervision = Supervision {
        reaction: one_of(raw.on_trip.as_ref(), &STOP_METHODS, "on_trip", p)?,
        emergency: one_of(
            raw.on_emergency.as_ref(),
            &STOPS_BY_DRIVE,
            "on_emergency",
            p,
        )?,
        torque: torque.map(|torque| TorqueWatch {
            percent: known.percent(torque),
            time_s: seconds(watch.torque_time.as_ref()).unwrap_or(TORQUE_TIME_S),
        }),
        acceleration,
        standstill,
        target_dwell_s: seconds(watch.target_time.as_ref()).unwrap_or(0.0),
        standstill_dwell_s: seconds(watch.standstill_time.as_ref()).unwrap_or(0.0),
    };
    Some(())
}

/// The stop methods of an axis, as the machine file names them.
pub(crate) const STOP_METHODS: [(&str, StopMethod); 3] = [
    ("quick-stop", StopMethod::QuickStop),
    ("ramp", StopMethod::Ramp),
    ("no-power", StopMethod::DisableVoltage),
];

/// The stop methods that a drive carries out by itself.
pub(crate) const STOPS_BY_DRIVE: [(&str, StopMethod); 2] = [
    ("quick-stop", StopMethod::QuickStop),
    ("no-power", StopMethod::DisableVoltage),
];

pub(crate) fn one_of<T: Copy + Default>(
    word: Option<&Spanned<String>>,
    all: &[(&str, T)],
    key: &str,
    p: &mut Problems<'_>,
) -> Option<T> {
    let Some(word) = word else {
        return Some(T::default());
    };
    let known = all.iter().find(|(name, _)| name == word.get_ref());
    if known.is_none() {
        let message = format!("`{key}` cannot be \"{}\"", word.get_ref());
        let names = all.iter().map(|(name, _)| *name);
        p.add_hint(
            word.span(),
            message,
            suggestion(word.get_ref(), names, "there are"),
        );
    }
    known.map(|(_, value)| *value)
}

/// Returns the homing with its SDOs.
pub(super) fn homing(
    raw: &RawHoming,
    config: &AxisConfig,
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<HomingSetup> {
    let number = |value: &Option<Spanned<f64>>| value.as_ref().map(|n| *n.get_ref());
    let homing = Homing {
        method: *raw.method.as_ref()?.get_ref(),
        search_velocity: number(&raw.search),
        zero_velocity: number(&raw.zero),
        acceleration: number(&raw.acceleration),
        distance: number(&raw.distance),
        position: number(&raw.position),
        threshold_ma: raw.threshold.as_ref().map(|n| *n.get_ref()),
    };
    if let Err(error) = homing.check(&config.scale, &config.limits) {
        let hint = match &error {
            ParameterError::Method(_) => {
                let all = homing::METHODS
                    .iter()
                    .map(|m| format!("{} {}", m.code, m.text));
                all.collect::<Vec<_>>().join("; ")
            }
            ParameterError::NoThreshold(_) => "add `threshold = 500` (mA)".to_owned(),
            _ => "values are in the axis' own units".to_owned(),
        };
        p.add_hint(raw.span.clone(), error.to_string(), hint);
        return None;
    }
    if let Some(timeout) = raw.timeout.as_ref().filter(|t| *t.get_ref() == 0) {
        p.add_hint(
            timeout.span(),
            "a `timeout` of nothing ends the search before it begins",
            "write the time that the longest search may take, such as \"60s\"",
        );
        return None;
    }
    let selection = selection?;
    let layout = &selection.layout;
    let mapped = layout.rx_field(0x6060, 0).is_some() && layout.tx_field(0x6061, 0).is_some();
    if !mapped {
        let message = "homing needs modes of operation and their display (0x6060, 0x6061) in the process data";
        p.add_hint(
            raw.span.clone(),
            message,
            "map 0x6060 and 0x6061 with `pdo.rx` and `pdo.tx`",
        );
        return None;
    }
    let maxon =
        selection.dictionary.item(0x30b0, 0).is_some() || selection.identity.vendor == MAXON;
    let startup = homing
        .objects(&config.scale, maxon)
        .map(|object| {
            let bytes = object.value.to_le_bytes();
            let name = selection
                .dictionary
                .item(object.index, object.subindex)
                .map_or(String::new(), |item| item.name.to_string());
            esi::StartupSdo {
                transition: "PS",
                index: object.index,
                sub: object.subindex,
                complete_access: false,
                data: bytes[..usize::from(object.bytes)].to_vec(),
                name,
                origin: "`homing` of the machine file".to_owned(),
            }
        })
        .collect();
    Some(HomingSetup {
        homing,
        startup,
        timeout_ns: raw
            .timeout
            .as_ref()
            .map_or(HOMING_TIMEOUT_NS, |t| *t.get_ref()),
    })
}
