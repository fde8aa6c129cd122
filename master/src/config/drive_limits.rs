//! Compares the drive's own limits (CiA 402) with the machine file's limits. If a limit in the file
//! exceeds the drive's, the drive clips set-points or faults in motion.

use std::fmt;

use ecaxis_axis::units::{Counts, RawAcceleration, RawVelocity};
use ecaxis_axis::{Limits, Mode, VelocityUnit};
use ecaxis_esi as esi;

use super::problem::Problems;
use super::raw::RawSdo;
use super::{AxisSetup, UnitSource, is_maxon};
use crate::text::rounded;
use ecaxis_ecat::object::NamedObject;

const POSITION_RANGE: u16 = 0x607b;
const SOFTWARE_LIMIT: u16 = 0x607d;
const MAX_MOTOR_SPEED: u16 = 0x6080;
const MAX_PROFILE_VELOCITY: u16 = 0x607f;
const FOLLOWING_WINDOW: u16 = 0x6065;
const MAX_ACCELERATION: u16 = 0x60c5;
const MAX_TORQUES: [u16; 3] = [0x6072, 0x60e0, 0x60e1];
/// maxon: the speed that the gear allows at its input, and the nominal and largest motor current.
const MAX_GEAR_SPEED: (u16, u8) = (0x3003, 3);
const NOMINAL_CURRENT: (u16, u8) = (0x3001, 1);
const CURRENT_LIMIT: (u16, u8) = (0x3001, 2);

/// A limit of the drive that the machine file exceeds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LimitConflict {
    pub index: u16,
    pub sub: u8,
    /// The drive's value in its own unit and in the axis's unit, and the file's value.
    text: String,
    /// `true` if the unit of the drive's value is known.
    pub certain: bool,
}

impl fmt::Display for LimitConflict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (index, sub) = (self.index, self.sub);
        write!(f, "{} {}", NamedObject { index, sub }, self.text)
    }
}

impl AxisSetup {
    /// Returns index and subindex of the drive's limits for this axis. `maxon`: the drive has
    /// maxon's objects.
    pub(crate) fn limit_objects(&self, maxon: bool) -> Vec<(u16, u8)> {
        let mut objects = vec![
            (POSITION_RANGE, 1),
            (POSITION_RANGE, 2),
            (MAX_MOTOR_SPEED, 0),
            (MAX_PROFILE_VELOCITY, 0),
            (MAX_ACCELERATION, 0),
        ];
        let modes = self.config.modes;
        if modes.contains(Mode::Csp) || modes.contains(Mode::Pp) {
            objects.extend([(SOFTWARE_LIMIT, 1), (SOFTWARE_LIMIT, 2)]);
        }
        if self.config.limits.following_error.is_some() {
            objects.push((FOLLOWING_WINDOW, 0));
        }
        objects.extend(MAX_TORQUES.map(|index| (index, 0)));
        if maxon {
            objects.push(MAX_GEAR_SPEED);
        }
        if maxon && self.torque.limit_said {
            objects.extend([NOMINAL_CURRENT, CURRENT_LIMIT]);
        }
        objects
    }

    /// Returns the limits that this axis exceeds. `drive` returns the bytes of a limit object.
    /// Zero means no limit, but no torque in a limit of torques.
    pub(crate) fn exceeded(
        &self,
        drive: impl Fn(u16, u8) -> Option<Vec<u8>>,
        selection: &esi::Selection,
    ) -> Vec<LimitConflict> {
        let wanted = self.limit_objects(is_maxon(selection));
        let value = |index: u16, sub: u8| {
            let known = wanted.contains(&(index, sub)).then(|| drive(index, sub))?;
            let signed = matches!(index, POSITION_RANGE | SOFTWARE_LIMIT);
            known.map(|bytes| number(&bytes, signed))
        };
        let set_in = |(index, sub): (u16, u8)| value(index, sub).filter(|n| *n != 0);
        let set = |index: u16| set_in((index, 0));
        let mut found = Vec::new();
        for index in [SOFTWARE_LIMIT, POSITION_RANGE] {
            if let (Some(low), Some(high)) = (value(index, 1), value(index, 2)) {
                self.positions(index, low, high, &mut found);
            }
        }
        for object in [(MAX_MOTOR_SPEED, 0), MAX_GEAR_SPEED] {
            let speed = set_in(object);
            found.extend(speed.and_then(|speed| self.speed(object, speed, selection)));
        }
        let velocity = set(MAX_PROFILE_VELOCITY).and_then(|n| i32::try_from(n).ok());
        found.extend(velocity.and_then(|raw| self.profile_velocity(raw)));
        if let Some(raw) = set(MAX_ACCELERATION).and_then(|n| u32::try_from(n).ok()) {
            found.extend(self.acceleration(raw));
        }
        if let Some(window) = set(FOLLOWING_WINDOW).filter(|n| *n != i64::from(u32::MAX)) {
            found.extend(self.following(window));
        }
        for index in MAX_TORQUES {
            // Zero is not the limit in the cycle if the outputs have another value.
            let is_output = selection.layout.rx_field(index, 0).is_some();
            let limit = value(index, 0).filter(|n| *n != 0 || !is_output);
            found.extend(limit.and_then(|n| self.max_torque(index, n)));
        }
        if let (Some(nominal), Some(most)) = (set_in(NOMINAL_CURRENT), set_in(CURRENT_LIMIT)) {
            found.extend(self.max_current(nominal, most));
        }
        found
    }

    /// Returns what the drive must permit.
    fn drive_limits(&self) -> Limits {
        self.compensation.drive_limits(&self.config.limits)
    }

    /// Checks a position range; an inverted range does not count.
    fn positions(&self, index: u16, low: i64, high: i64, found: &mut Vec<LimitConflict>) {
        if low >= high {
            return;
        }
        let scale = &self.config.scale;
        let unit = &self.unit;
        let half = scale.units_of_counts(0.5);
        for (sub, count, full) in [(1, low, i32::MIN), (2, high, i32::MAX)] {
            let at = scale.position_to_user(Counts(count)).0;
            let is_upper = (sub == 2) != scale.inverted();
            let file = self.drive_limits().position;
            let end = file.map(|[low, high]| if is_upper { high } else { low });
            let exceeds = match end {
                Some(end) if is_upper => end > at + half,
                Some(end) => end < at - half,
                None => count != i64::from(full),
            };
            if exceeds {
                let at = rounded(at);
                let end = end.map_or("is not set".to_owned(), |end| {
                    format!("goes to {} {unit}", rounded(end))
                });
                let text = format!("= {count} is {at} {unit}, `limits.position` {end}");
                found.push(LimitConflict {
                    index,
                    sub,
                    text,
                    certain: true,
                });
            }
        }
    }

    /// Checks a speed of the motor. CiA 402 counts 0x6080 in rpm; some drives use the unit of
    /// 0x60A9. An ESI may give the unit.
    fn speed(
        &self,
        (index, sub): (u16, u8),
        raw: i64,
        selection: &esi::Selection,
    ) -> Option<LimitConflict> {
        let item = selection.dictionary.item(index, sub);
        let unit = item.and_then(|item| VelocityUnit::from_si_code(item.unit));
        let scale = &self.config.scale;
        let of_drive = scale.velocity_unit();
        let allowed = |unit| {
            let resolution = scale.with_velocity_unit(unit).velocity_resolution();
            raw as f64 * resolution
        };
        let shown = unit.unwrap_or(VelocityUnit::RPM);
        let most = allowed(shown);
        let limit = self.drive_limits().velocity;
        if !exceeds(limit, most) {
            return None;
        }
        let certain = unit.is_some() || exceeds(limit, allowed(of_drive));
        let doubt = match certain {
            true => String::new(),
            false => format!(" (if it counts rpm as CiA 402 says, and not {of_drive})"),
        };
        let name = &self.unit;
        Some(LimitConflict {
            index,
            sub,
            text: format!(
                "= {raw} {shown} allows {} {name}/s, `limits.velocity` is {} {name}/s{doubt}",
                rounded(most),
                rounded(limit),
            ),
            certain,
        })
    }

    /// Checks 0x607F. It limits profiles of the drive; some drives limit every velocity by it.
    fn profile_velocity(&self, raw: i32) -> Option<LimitConflict> {
        let scale = &self.config.scale;
        let most = scale.velocity_to_user(RawVelocity(raw)).0.abs();
        let limit = self.drive_limits().velocity;
        let modes = self.config.modes;
        let profiles = [Mode::Pp, Mode::Pv, Mode::Hm];
        let certain = self.velocity_unit_from != UnitSource::Nothing
            && profiles.iter().any(|mode| modes.contains(*mode));
        let (unit, name) = (scale.velocity_unit(), &self.unit);
        exceeds(limit, most).then(|| LimitConflict {
            index: MAX_PROFILE_VELOCITY,
            sub: 0,
            text: format!(
                "= {raw} {unit} allows {} {name}/s, `limits.velocity` is {} {name}/s",
                rounded(most),
                rounded(limit),
            ),
            certain,
        })
    }

    fn acceleration(&self, raw: u32) -> Option<LimitConflict> {
        let scale = &self.config.scale;
        let most = scale.acceleration_to_user(RawAcceleration(raw)).0.abs();
        let limit = self.drive_limits().acceleration;
        let certain = self.acceleration_unit_from != UnitSource::Nothing;
        let (unit, name) = (scale.acceleration_unit(), &self.unit);
        let doubt = match certain {
            true => String::new(),
            false => format!(" (if it counts {unit}, which is assumed)"),
        };
        exceeds(limit, most).then(|| LimitConflict {
            index: MAX_ACCELERATION,
            sub: 0,
            text: format!(
                "= {raw} {unit} allows {} {name}/s², `limits.acceleration` is {} {name}/s²{doubt}",
                rounded(most),
                rounded(limit),
            ),
            certain,
        })
    }

    fn following(&self, window: i64) -> Option<LimitConflict> {
        let limit = self.config.limits.following_error?;
        let scale = &self.config.scale;
        let most = scale.units_of_counts(window as f64);
        let name = &self.unit;
        exceeds(limit, most).then(|| LimitConflict {
            index: FOLLOWING_WINDOW,
            sub: 0,
            text: format!(
                "= {window} is {} {name}, `limits.following_error` is {} {name}: the drive faults first",
                rounded(most),
                rounded(limit),
            ),
            certain: true,
        })
    }

    /// Checks maxon's current limit. The rated torque is that of the nominal current.
    fn max_current(&self, nominal: i64, raw: i64) -> Option<LimitConflict> {
        let most = raw as f64 / nominal as f64 * 100.0;
        let drive = format!("= {raw} mA, {nominal} mA nominal,");
        self.torque_limit(CURRENT_LIMIT, most, &drive)
    }

    /// Checks a torque limit in thousandths of the rated torque.
    fn max_torque(&self, index: u16, raw: i64) -> Option<LimitConflict> {
        if raw == 0 {
            return Some(LimitConflict {
                index,
                sub: 0,
                text: "= 0 leaves the drive without torque: it cannot move; write the largest \
                       torque in 0.1 % of the rated torque, such as 1000"
                    .to_owned(),
                certain: true,
            });
        }
        if !self.torque.limit_said {
            return None;
        }
        let drive = format!("= {raw} ‰ of rated torque");
        self.torque_limit((index, 0), raw as f64 / 10.0, &drive)
    }

    /// Compares `limits.torque` with a limit of the drive in percent of the rated torque. `drive`:
    /// the limit in the unit of the object.
    fn torque_limit(
        &self,
        (index, sub): (u16, u8),
        most: f64,
        drive: &str,
    ) -> Option<LimitConflict> {
        let torque = &self.torque;
        let is_known = torque.unit == super::TorqueUnit::Percent || torque.rated.is_some();
        let limit = self.config.limits.torque;
        (is_known && exceeds(limit, most)).then(|| LimitConflict {
            index,
            sub,
            text: format!(
                "{drive} allows {} {unit}, `limits.torque` is {} {unit}",
                rounded(torque.shown(most)),
                rounded(torque.shown(limit)),
                unit = torque.unit,
            ),
            certain: true,
        })
    }
}

/// Returns `true` if the excess is larger than a rounding error.
fn exceeds(limit: f64, most: f64) -> bool {
    limit > most * (1.0 + 1e-6)
}

fn number(bytes: &[u8], signed: bool) -> i64 {
    let len = bytes.len().min(8);
    let mut all = [0; 8];
    all[..len].copy_from_slice(&bytes[..len]);
    let unused = 8 * (8 - u32::try_from(len).unwrap_or(8));
    match (u64::from_le_bytes(all).checked_shl(unused), signed) {
        (None, _) => 0,
        (Some(n), true) => n as i64 >> unused,
        (Some(n), false) => i64::try_from(n >> unused).unwrap_or(i64::MAX),
    }
}

impl LimitConflict {
    /// Returns `true` if positions repeat at the limit: the reported one would jump.
    pub(crate) fn wraps(&self) -> bool {
        esi::axis::of(self.index).is_some_and(|(_, same)| same == POSITION_RANGE)
    }
}

/// The time at full speed within which the end of 32 bits is worth a note, in s.
const SOON_S: f64 = 3600.0;

/// Returns a note about a range of 32 bits on an endless axis. Some drives stop at its ends, others
/// take it as no range.
fn whole_range(axis: &AxisSetup, drive: impl Fn(u16, u8) -> Option<Vec<u8>>) -> Option<String> {
    let config = &axis.config;
    let modes = config.modes;
    let has_range = config.limits.position.is_some();
    if has_range || !(modes.contains(Mode::Csp) || modes.contains(Mode::Pp)) {
        return None;
    }
    let end = |sub: u8| drive(SOFTWARE_LIMIT, sub).map(|bytes| number(&bytes, true));
    let whole = (Some(i64::from(i32::MIN)), Some(i64::from(i32::MAX)));
    let half = config.scale.units_of_counts(f64::from(i32::MAX));
    let is_soon = half / config.limits.velocity < SOON_S;
    (is_soon && (end(1), end(2)) == whole).then(|| {
        let half = rounded(half);
        format!(
            "0x607d:01 and :02 are the whole range: some drives stop there, at {half} {}; 0 in both \
             is not a limit",
            axis.unit
        )
    })
}

/// Returns the bytes of an object after the start-up SDOs: those of an SDO, or the ESI's default.
pub(super) fn after_startup(selection: &esi::Selection, index: u16, sub: u8) -> Option<Vec<u8>> {
    let mut written = selection.startup.iter().rev();
    match written.find(|sdo| (sdo.index, sdo.sub) == (index, sub)) {
        Some(sdo) => Some(sdo.data.clone()),
        None => {
            let item = selection.dictionary.item(index, sub);
            let default = item.filter(|item| item.has_default)?;
            Some(default.default.to_vec())
        }
    }
}

/// Checks the limits that the file's `sdo` entries and the ESI set in the drive. Returns what need
/// not be an error.
pub(super) fn check(
    axis: &AxisSetup,
    sdos: &[RawSdo],
    selection: &esi::Selection,
    p: &mut Problems<'_>,
) -> Vec<String> {
    let drive = |index: u16, sub: u8| after_startup(selection, index, sub);
    let mut notes = Vec::new();
    for conflict in axis.exceeded(drive, selection) {
        let object = (conflict.index, conflict.sub);
        let own = sdos.iter().rev().find(|s| s.address() == object);
        match own {
            Some(own) if conflict.certain => {
                let hint = match conflict.wraps() {
                    true => "write 0 to 0x607B:01 and :02: ecaxis counts on where 32 bits end",
                    false => "lower the limit of the axis, or let the drive allow more",
                };
                p.add_hint(own.value.span(), conflict.to_string(), hint);
            }
            Some(_) => notes.push(conflict.to_string()),
            None => notes.push(format!("{conflict} (in the ESI; the drive is asked)")),
        }
    }
    notes.extend(whole_range(axis, drive));
    notes
}
