//! The scaling of an axis: encoder, gear, feed, modulo; the drive's units of velocity, acceleration
//! and torque.

use ecaxis_axis::scale::TorqueScale;
use ecaxis_axis::units::{Amperes, NewtonMetres, UserUnits};
use ecaxis_axis::{AccelerationUnit, AxisConfig, Scale, ScaleError, VelocityUnit};
use ecaxis_esi as esi;
use toml::Spanned;

use super::super::fields::{Key, KeyExt};
use super::super::problem::Problems;
use super::super::raw::{RawAxis, RawSdo, SdoValue};
use super::super::units::is_turn;
use super::super::{TorqueSetup, TorqueUnit, UnitSource};
use super::positive;
use crate::text::rounded;

/// The maximum number of counts per motor turn.
const MOST_COUNTS: f64 = 2_147_483_648.0;

pub(super) fn scale(raw: &RawAxis, unit: &str, p: &mut Problems<'_>) -> Option<Scale> {
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
             a gear belongs in `gear` or `per_turn`",
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
    let per_turn = per_turn(raw, unit, p);
    let scale = match Scale::new(encoder?, per_turn?) {
        Ok(scale) => scale,
        Err(e) => {
            let at = raw.per_turn.as_ref().or(raw.feed.as_ref());
            let at = at.or(raw.encoder.as_ref());
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
    let offset = raw.offset.value().unwrap_or(0.0);
    let invert = raw.invert.value().unwrap_or(false);
    let scale = scale.with_invert(invert).with_offset(offset).ok()?;
    modulo(raw, scale, unit, p)
}

/// Returns the user units per motor turn, given directly or by gear and feed.
fn per_turn(raw: &RawAxis, unit: &str, p: &mut Problems<'_>) -> Option<f64> {
    let geared = raw.gear.place().or(raw.feed.place());
    if let (Some(at), Some(_)) = (geared, &raw.per_turn) {
        p.add_hint(
            at,
            "`per_turn` says already how far a turn of the motor goes, gear included",
            "write `gear` and `feed`, which is per turn of the shaft behind the gear; or `per_turn` alone",
        );
        return None;
    }
    if let Some(per_turn) = &raw.per_turn {
        return positive(per_turn, "per_turn", unit, p);
    }
    let scaled = raw.written.has("per_turn") || raw.written.has("feed");
    if let (false, Some(name)) = (scaled, &raw.unit)
        && !is_turn(unit)
    {
        let message =
            format!("`unit` is {unit}, but nothing says how many of them a turn of the motor is");
        let example = if unit.starts_with("deg") || unit == "°" {
            "360.0"
        } else {
            "5.0"
        };
        let hint = format!(
            "add `per_turn = {example}`, gear included; or `feed = {example}`, per turn of the shaft behind `gear`; or leave \
             `unit` out to count turns"
        );
        p.add_hint(name.span(), message, hint);
        return None;
    }
    let feed = match &raw.feed {
        Some(feed) => positive(feed, "feed", unit, p)?,
        None => 1.0,
    };
    let [motor, shaft] = raw.gear.value().unwrap_or([1, 1]);
    Some(feed * f64::from(shaft) / f64::from(motor))
}

fn modulo(raw: &RawAxis, scale: Scale, unit: &str, p: &mut Problems<'_>) -> Option<Scale> {
    let Some(length) = &raw.modulo else {
        if let Some(way) = &raw.way {
            let hint = "add `modulo = 360.0`, or leave `way` out";
            p.add_hint(way.span(), "only a modulo axis has a `way` to choose", hint);
            return None;
        }
        return Some(scale);
    };
    positive(length, "modulo", unit, p)?;
    if let Some(range) = &raw.limits.position {
        let message = "an axis that goes round and round has no range of positions";
        p.add_hint(
            range.span(),
            message,
            "leave `limits.position` or `modulo` out",
        );
        return None;
    }
    match scale.with_modulo(*length.get_ref()) {
        Ok(scale) => Some(scale),
        Err(error) => {
            let counts = length.get_ref() * scale.counts_per_unit();
            let hint = format!("`modulo` is {counts:.3e} counts: check `encoder` and the gear");
            p.add_hint(length.span(), error.to_string(), hint);
            None
        }
    }
}

/// The counts after which the drive's position repeats.
const WRAP: f64 = 4_294_967_296.0;

/// Returns why a start cannot determine the position of an absolute encoder: the drive counts 32 bits.
/// `None` if it can.
pub(crate) fn ambiguous_start(config: &AxisConfig, unit: &str) -> Option<String> {
    let scale = &config.scale;
    if !config.absolute || config.limits.position.is_some() {
        return None;
    }
    let length = scale.modulo();
    if let Some(length) = length {
        let counts = length * scale.counts_per_unit();
        let turns = (WRAP / counts).round();
        // Each wrap of the drive moves the angle by the rest.
        if turns >= 1.0 && (WRAP - turns * counts).abs() < 0.5 {
            return None;
        }
    }
    let half = rounded(scale.units_of_counts(WRAP / 2.0));
    let repeats = match length {
        Some(length) => {
            let turns = rounded(WRAP / (length * scale.counts_per_unit()));
            format!("its 2^32 counts are {turns} times {length} {unit}, no whole number")
        }
        None => "the axis is endless".to_owned(),
    };
    Some(format!(
        "`absolute`: {repeats}: beyond 2^31 counts, {half} {unit}, a start finds a wrong position, \
         so no start takes it as home"
    ))
}

/// Reports a range of an absolute encoder in which the drive's position repeats.
pub(super) fn absolute_range(
    raw: &RawAxis,
    config: &AxisConfig,
    unit: &str,
    p: &mut Problems<'_>,
) -> Option<()> {
    let is_counted = |end: f64| {
        let counts = config.scale.position_to_counts(UserUnits(end));
        i32::try_from(counts.0).is_ok()
    };
    let mut ends = config.limits.position.into_iter().flatten();
    if !config.absolute || ends.all(is_counted) {
        return Some(());
    }
    let half = rounded(config.scale.units_of_counts(WRAP / 2.0));
    let place = raw.limits.position.place();
    p.add_hint(
        place.unwrap_or(raw.span.clone()),
        format!(
            "`limits.position` goes beyond the drive's 2^31 counts, {half} {unit}: with `absolute`, \
             a start there finds a wrong position"
        ),
        "narrow `limits.position`, or correct `offset`",
    );
    None
}

const SI_UNIT_VELOCITY: u16 = 0x60a9;
const SI_UNIT_ACCELERATION: u16 = 0x60aa;
const RATED_TORQUE: u16 = 0x6076;

/// Returns the unit in 0x60A9, from the file's key, the file's SDO or the ESI's default.
pub(super) fn velocity_unit(
    raw: &RawAxis,
    sdos: &[RawSdo],
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<(VelocityUnit, UnitSource)> {
    if let Some(unit) = raw.velocity_unit.value() {
        return Some((unit, UnitSource::File));
    }
    if selection.is_some_and(|selection| selection.layout.idns) {
        let message = "`velocity_unit` is missing: a Sercos drive has it in S-0-0044 to S-0-0046";
        let hint = "write `velocity_unit = \"rpm\"`, \"mrpm\", \"counts/s\" or \"turns/s\"";
        p.add_hint(raw.span.clone(), message, hint);
        return None;
    }
    let Some((code, from)) = startup_value(SI_UNIT_VELOCITY, sdos, selection) else {
        return Some((VelocityUnit::default(), UnitSource::Nothing));
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

/// Returns the value of a 32-bit object after start-up, from the file's SDO or the ESI's default.
fn startup_value(
    index: u16,
    sdos: &[RawSdo],
    selection: Option<&esi::Selection>,
) -> Option<(u32, UnitSource)> {
    let written = sdos.iter().rev().find(|s| s.address() == (index, 0));
    let written = written.and_then(|s| match s.value.get_ref() {
        SdoValue::Integer(n) => u32::try_from(*n).ok(),
        _ => None,
    });
    if let Some(value) = written {
        return Some((value, UnitSource::Sdo));
    }
    let item = selection?.dictionary.item(index, 0)?;
    let bytes = <[u8; 4]>::try_from(item.default.as_slice()).ok()?;
    item.has_default
        .then_some((u32::from_le_bytes(bytes), UnitSource::Esi))
}

/// Returns the unit in 0x60AA if it is known and supported, otherwise the unit of 0x60A9 per
/// second.
pub(super) fn acceleration_unit(
    velocity: VelocityUnit,
    sdos: &[RawSdo],
    selection: Option<&esi::Selection>,
) -> (AccelerationUnit, UnitSource) {
    let known = startup_value(SI_UNIT_ACCELERATION, sdos, selection)
        .and_then(|(code, from)| Some((AccelerationUnit::from_si_code(code)?, from)));
    known.unwrap_or((velocity.into(), UnitSource::Nothing))
}

/// Returns the torque unit and the known motor data.
pub(super) fn torque(
    raw: &RawAxis,
    sdos: &[RawSdo],
    selection: Option<&esi::Selection>,
    p: &mut Problems<'_>,
) -> Option<TorqueSetup> {
    let unit = raw.torque_unit.value().unwrap_or_default();
    let mut known = |value: &Key<f64>, what: &str, unit: &str| match value {
        Some(value) => positive(value, what, unit, p).map(Some),
        None => Some(None),
    };
    let constant = known(&raw.torque_constant, "torque_constant", "Nm/A");
    let said = known(&raw.rated_torque, "rated_torque", "Nm");
    let (constant, said) = (constant?, said?);
    let counts_per_newton_metre = counts_per_newton_metre(selection);
    let (rated, rated_from) = match (said, startup_value(RATED_TORQUE, sdos, selection)) {
        (Some(rated), _) => (Some(rated), UnitSource::File),
        (None, Some((count, from))) if count > 0 => {
            (Some(f64::from(count) / counts_per_newton_metre), from)
        }
        _ => (None, UnitSource::Nothing),
    };
    let at = raw.torque_unit.place().unwrap_or(raw.span.clone());
    let drive_knows = selection.is_some_and(is_maxon);
    let unknown = unit == TorqueUnit::Amperes && constant.is_none();
    if unknown && !drive_knows {
        let message = "torques in A need the motor's torque constant";
        p.add_hint(at, message, "add `torque_constant = 0.0385` (Nm/A)");
        return None;
    }
    let torque = TorqueSetup {
        unit,
        rated,
        rated_from,
        constant,
        constant_from: if constant.is_some() {
            UnitSource::File
        } else {
            UnitSource::Nothing
        },
        counts_per_newton_metre,
        percent_per_unit: 1.0,
        limit_said: raw.limits.torque.is_some(),
    };
    // The drive reports the rated torque later. Until then torques are fractions of the limit.
    let limit = raw.limits.torque.value();
    match (unit, rated, limit) {
        (TorqueUnit::Percent, ..) => Some(torque),
        (_, Some(rated), _) if !unknown => torque.with_rated(rated, rated_from),
        (_, _, Some(limit)) => Some(TorqueSetup {
            percent_per_unit: 100.0 / limit,
            ..torque
        }),
        (_, Some(_), None) => {
            let message = "only the drive knows the motor's torque constant (0x3001:05), so torques in A need a limit";
            let hint = "add `torque` to `limits`, or `torque_constant = 0.0385` (Nm/A)";
            p.add_hint(at, message, hint);
            None
        }
        (_, None, None) => {
            let message = format!(
                "only the drive knows the motor's rated torque (0x6076), so torques in {unit} need a limit"
            );
            p.add_hint(
                at,
                message,
                "add `torque` to `limits`, or `rated_torque = 0.1` (Nm)",
            );
            None
        }
    }
}

/// Returns the counts of 0x6076 per Nm from the ESI's `Unit`. Without it, µNm for maxon drives and
/// mNm otherwise.
fn counts_per_newton_metre(selection: Option<&esi::Selection>) -> f64 {
    const NEWTON_METRE: u8 = 0x56;
    let Some(selection) = selection else {
        return 1e3;
    };
    let unit = selection
        .dictionary
        .item(RATED_TORQUE, 0)
        .map_or(0, |item| item.unit);
    if let [0, 0, NEWTON_METRE, prefix] = unit.to_le_bytes() {
        return 10f64.powi(-i32::from(i8::from_le_bytes([prefix])));
    }
    if is_maxon(selection) { 1e6 } else { 1e3 }
}

/// Returns `true` if the device has maxon's objects.
pub(crate) fn is_maxon(selection: &esi::Selection) -> bool {
    const MAXON: u32 = 0xfb;
    selection.dictionary.item(0x30b0, 0).is_some() || selection.identity.vendor == MAXON
}

impl TorqueSetup {
    /// Returns the setup with the motor's rated torque in Nm.
    pub(crate) fn with_rated(self, rated: f64, from: UnitSource) -> Option<Self> {
        let scale = TorqueScale::new(Some(rated), self.constant).ok()?;
        let percent_per_unit = match self.unit {
            TorqueUnit::Percent => 1.0,
            TorqueUnit::NewtonMetres => scale.of_newton_metres(NewtonMetres(1.0)).ok()?.0,
            TorqueUnit::Amperes => scale.of_amperes(Amperes(1.0)).ok()?.0,
        };
        Some(Self {
            rated: Some(rated),
            rated_from: from,
            percent_per_unit,
            ..self
        })
    }

    /// Converts a torque from the file's unit to percent of rated torque.
    #[must_use]
    pub fn percent(&self, torque: f64) -> f64 {
        torque * self.percent_per_unit
    }

    /// Converts percent of rated torque to the file's unit.
    #[must_use]
    pub fn shown(&self, percent: f64) -> f64 {
        percent / self.percent_per_unit
    }
}
