//! Control and supervision of an axis: loops, brake, supervision, fault reset, homing.

use ecaxis_axis::homing::{self, Homing, ParameterError};
use ecaxis_axis::supervision::{Brake, FaultReset, Supervision, TorqueWatch};
use ecaxis_axis::{AxisConfig, FeedForward, Loops, PositionPid, VelocityLoop};
use ecaxis_ecat::object::NamedObject;
use ecaxis_esi as esi;
use toml::Spanned;

use super::super::fields::{Key, KeyExt, Ns};
use super::super::problem::Problems;
use super::super::raw::{RawAxis, RawHoming};
use super::super::{HomingSetup, TorqueSetup, sdo};
use super::{is_maxon, positive};

/// The default time in s for which torque may exceed its supervised limit.
const TORQUE_TIME_S: f64 = 0.1;
const RESET_DELAY_S: f64 = 1.0;
const HOMING_TIMEOUT_NS: u64 = 60_000_000_000;

pub(super) fn seconds(time: &Key<Ns>) -> Option<f64> {
    time.value().map(|ns| ns as f64 * 1e-9)
}

pub(super) fn loops(
    raw: &RawAxis,
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
        velocity: offset(&raw.csp.velocity_offset, 0x60b1)?,
        acceleration: offset(&raw.csp.torque_offset, 0x60b2)?,
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
            kv: positive(csv.kv.as_ref()?, "csv.kv", "1/s", p)?,
            feed_forward: weight(&csv.feed_forward, "csv.feed_forward", p)?,
        }),
        None => None,
    };
    let cst = match &raw.cst {
        Some(cst) => Some(PositionPid {
            kp: positive(cst.kp.as_ref()?, "cst.kp", &format!("% per {unit}"), p)?,
            tn_s: seconds(&cst.tn),
            tv_s: seconds(&cst.tv).unwrap_or(0.0),
            acceleration: cst.acceleration.value().unwrap_or(0.0),
        }),
        None => None,
    };
    Some(Loops { csp, csv, cst })
}

/// Returns a weight from 0 to 1; the default is 1.
fn weight(value: &Key<f64>, what: &str, p: &mut Problems<'_>) -> Option<f64> {
    let Some(value) = value else {
        return Some(1.0);
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
        release_s: seconds(&raw.brake.release).unwrap_or(0.0),
        engage_s: seconds(&raw.brake.engage).unwrap_or(0.0),
    };
    if let Some(tries) = raw.fault_reset.tries.value() {
        config.fault_reset = FaultReset::Automatic {
            tries,
            delay_s: seconds(&raw.fault_reset.delay).unwrap_or(RESET_DELAY_S),
        };
    }
    let watch = &raw.supervise;
    let mut above_zero = |value: &Option<Spanned<f64>>, what: &str, unit: &str| match value {
        Some(value) => positive(value, what, unit, p).map(Some),
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
        reaction: raw.on_trip.value().unwrap_or_default(),
        emergency: raw.on_emergency.value().unwrap_or_default(),
        torque: torque.map(|torque| TorqueWatch {
            percent: known.percent(torque),
            time_s: seconds(&watch.torque_time).unwrap_or(TORQUE_TIME_S),
        }),
        acceleration,
        standstill,
        target_dwell_s: seconds(&watch.target_time).unwrap_or(0.0),
        standstill_dwell_s: seconds(&watch.standstill_time).unwrap_or(0.0),
    };
    Some(())
}

/// Returns the homing with its SDOs.
pub(super) fn homing(
    raw: &RawHoming,
    config: &AxisConfig,
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<HomingSetup> {
    let dictionary = &selection?.dictionary;
    let has_threshold = may_have(dictionary, THRESHOLD, 0);
    let homing = Homing {
        method: raw.method.value()?,
        search_velocity: raw.search.value(),
        zero_velocity: raw.zero.value(),
        acceleration: raw.acceleration.value(),
        distance: raw.distance.value(),
        position: raw.position.value(),
        threshold_ma: raw.threshold.value(),
        maxon_methods: selection.is_some_and(is_maxon) || has_threshold,
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
            "a `timeout` of 0 ends the search before it begins",
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
    let objects = homing.objects(&config.scale, is_maxon(selection));
    let startup = objects.map(|object| {
        let data = object.value.to_le_bytes()[..usize::from(object.bytes)].to_vec();
        let address = (object.index, object.subindex);
        startup_sdo(selection, address, data, "`homing` of the machine file")
    });
    let startup: Vec<_> = startup.collect();
    let is_possible = |sdo: &esi::StartupSdo| is_possible(sdo, raw, &homing, dictionary, p);
    let possible: Vec<bool> = startup.iter().map(is_possible).collect();
    if possible.contains(&false) {
        return None;
    }
    Some(HomingSetup {
        homing,
        startup,
        timeout_ns: raw.timeout.value().unwrap_or(HOMING_TIMEOUT_NS),
    })
}

/// maxon's current threshold that detects a mechanical end.
const THRESHOLD: u16 = 0x30b2;
const HOMING_METHOD: u16 = 0x6098;

/// True if a drive may have an object: an object of the profile, or a vendor's object that its ESI
/// lists. Some files list no object of the vendor at all.
fn may_have(dictionary: &esi::Dictionary, index: u16, sub: u8) -> bool {
    /// Vendor-specific objects of CiA 301.
    const OF_VENDOR: std::ops::Range<u16> = 0x2000..0x6000;
    let mut objects = dictionary.objects.iter();
    let lists_vendor = objects.any(|object| OF_VENDOR.contains(&object.index));
    !(lists_vendor && OF_VENDOR.contains(&index)) || dictionary.item(index, sub).is_some()
}

/// Returns a start-up SDO with the name that the ESI gives the object.
pub(super) fn startup_sdo(
    selection: &esi::Selection,
    (index, sub): (u16, u8),
    data: Vec<u8>,
    origin: &str,
) -> esi::StartupSdo {
    let item = selection.dictionary.item(index, sub);
    esi::StartupSdo {
        transition: "PS",
        index,
        sub,
        complete_access: false,
        data,
        name: item.map_or(String::new(), |item| item.name.to_string()),
        origin: origin.to_owned(),
        optional: false,
    }
}

/// Reports a homing object that the ESI lacks, or whose range excludes the value. The vendor's own
/// methods may be beyond the range: files do not list all of them.
fn is_possible(
    sdo: &esi::StartupSdo,
    raw: &RawHoming,
    homing: &Homing,
    dictionary: &esi::Dictionary,
    p: &mut Problems<'_>,
) -> bool {
    let place = match (sdo.index, sdo.sub) {
        (HOMING_METHOD, _) => raw.method.place(),
        (0x6099, 1) => raw.search.place(),
        (0x6099, _) => raw.zero.place(),
        (0x609a, _) => raw.acceleration.place(),
        (0x30b1, _) => raw.distance.place(),
        (THRESHOLD, _) => raw.threshold.place(),
        _ => raw.position.place(),
    };
    let place = place.unwrap_or(raw.span.clone());
    let object = NamedObject {
        index: sdo.index,
        sub: sdo.sub,
    };
    let Some(item) = dictionary.item(sdo.index, sdo.sub) else {
        let may_have = may_have(dictionary, sdo.index, sdo.sub);
        if !may_have {
            let message = format!("the drive has no {object}: its ESI does not list it");
            p.add_hint(place, message, "remove the key from `homing`");
        }
        return may_have;
    };
    let is_vendor_method = sdo.index == HOMING_METHOD && homing.known_method().is_none();
    let Some(problem) = sdo::outside_esi_range(item, &sdo.data).filter(|_| !is_vendor_method)
    else {
        return true;
    };
    let hint = match (sdo.index, homing.method) {
        // Method 37 replaces 35 (CiA 402-2).
        (HOMING_METHOD, 37) => "older drives have method 35 for the same",
        (HOMING_METHOD, _) => "write a method that the drive has",
        _ => "write a value that the drive accepts",
    };
    p.add_hint(place, format!("{object}: {problem}"), hint);
    false
}

/// Returns a note about a vendor's homing method that the ESI's range does not include.
pub(in super::super) fn vendor_method_note(
    homing: &HomingSetup,
    selection: &esi::Selection,
) -> Option<String> {
    let method = homing.homing.method;
    if homing.homing.known_method().is_some() {
        return None;
    }
    let item = selection.dictionary.item(HOMING_METHOD, 0)?;
    let range = sdo::outside_esi_range(item, &method.to_le_bytes());
    range.map(|range| format!("homing method of the vendor: {range} for 0x6098"))
}
