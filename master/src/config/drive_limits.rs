//! Compares the drive's own limits (CiA 402) with the machine file's limits. If a limit in the file
//! exceeds the drive's, the drive clips set-points or faults in motion.

use std::fmt;

use ecaxis_axis::units::{Counts, RawAcceleration, RawVelocity};
use ecaxis_axis::{Limits, Mode, VelocityUnit};
use ecaxis_esi as esi;

use super::problem::Problems;
use super::raw::RawSdo;
use super::{AxisSetup, UnitSource};
use crate::text::rounded;
use ecaxis_ecat::object::NamedObject;

const POSITION_RANGE: u16 = 0x607b;
const SOFTWARE_LIMIT: u16 = 0x607d;
const MAX_MOTOR_SPEED: u16 = 0x6080;
const MAX_PROFILE_VELOCITY: u16 = 0x607f;
const FOLLOWING_WINDOW: u16 = 0x6065;
const MAX_ACCELERATION: u16 = 0x60c5;
const MAX_TORQUES: [u16; 3] = [0x6072, 0x60e0, 0x60e1];

/// Offset objects, which add to a target after its limits: position, velocity, torque.
pub(crate) const OFFSETS: [u16; 3] = [0x60b0, 0x60b1, 0x60b2];

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
    /// Returns index and subindex of the drive's limits for this axis.
    pub(crate) fn limit_objects(&self) -> Vec<(u16, u8)> {
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
        if self.torque.limit_said {
            objects.extend(MAX_TORQUES.map(|index| (index, 0)));
        }
        objects
    }

    /// Returns the limits that this axis exceeds. `drive` returns the bytes of a limit object.
    /// `speed_unit`: the unit of 0x6080 if the ESI gives it. Zero means no limit.
    pub(crate) fn exceeded(
        &self,
        drive: impl Fn(u16, u8) -> Option<Vec<u8>>,
        speed_unit: Option<VelocityUnit>,
    ) -> Vec<LimitConflict> {
        let wanted = self.limit_objects();
        let value = |index: u16, sub: u8| {
            let known = wanted.contains(&(index, sub)).then(|| drive(index, sub))?;
            let signed = matches!(index, POSITION_RANGE | SOFTWARE_LIMIT);
            known.map(|bytes| number(&bytes, signed))
        };
        let set = |index: u16| value(index, 0).filter(|n| *n != 0);
        let mut found = Vec::new();
        for index in [SOFTWARE_LIMIT, POSITION_RANGE] {
            if let (Some(low), Some(high)) = (value(index, 1), value(index, 2)) {
                self.positions(index, low, high, &mut found);
            }
        }
        if let Some(speed) = set(MAX_MOTOR_SPEED) {
            found.extend(self.speed(speed, speed_unit));
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
            found.extend(set(index).and_then(|n| self.max_torque(index, n)));
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

    /// Checks 0x6080. CiA 402 counts it in rpm of the motor; some drives use the unit of 0x60A9.
    fn speed(&self, raw: i64, unit: Option<VelocityUnit>) -> Option<LimitConflict> {
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
            index: MAX_MOTOR_SPEED,
            sub: 0,
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

    /// Checks a torque limit in thousandths of the rated torque.
    fn max_torque(&self, index: u16, raw: i64) -> Option<LimitConflict> {
        let torque = &self.torque;
        let is_known = torque.unit == super::TorqueUnit::Percent || torque.rated.is_some();
        let most = raw as f64 / 10.0;
        let limit = self.config.limits.torque;
        (is_known && exceeds(limit, most)).then(|| LimitConflict {
            index,
            sub: 0,
            text: format!(
                "= {raw} ‰ of rated torque allows {} {unit}, `limits.torque` is {} {unit}",
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

/// Returns the unit of 0x6080 if the ESI gives it.
pub(crate) fn speed_unit(selection: &esi::Selection) -> Option<VelocityUnit> {
    let item = selection.dictionary.item(MAX_MOTOR_SPEED, 0)?;
    VelocityUnit::from_si_code(item.unit)
}

/// Checks the limits that the file's `sdo` entries and the ESI set in the drive. Returns what need
/// not be an error.
pub(super) fn check(
    axis: &AxisSetup,
    sdos: &[RawSdo],
    selection: &esi::Selection,
    p: &mut Problems<'_>,
) -> Vec<String> {
    let written = |index: u16, sub: u8| {
        let mut all = selection.startup.iter().rev();
        all.find(|sdo| (sdo.index, sdo.sub) == (index, sub))
    };
    let drive = |index: u16, sub: u8| match written(index, sub) {
        Some(sdo) => Some(sdo.data.clone()),
        None => {
            let item = selection.dictionary.item(index, sub);
            let default = item.filter(|item| item.has_default)?;
            Some(default.default.to_vec())
        }
    };
    let mut notes = Vec::new();
    for conflict in axis.exceeded(drive, speed_unit(selection)) {
        let object = (conflict.index, conflict.sub);
        let own = sdos.iter().rev().find(|s| s.address() == object);
        match own {
            Some(own) if conflict.certain => {
                let hint = "lower the limit of the axis, or let the drive allow more";
                p.add_hint(own.value.span(), conflict.to_string(), hint);
            }
            Some(_) => notes.push(conflict.to_string()),
            None => notes.push(format!("{conflict} (in the ESI; the drive is asked)")),
        }
    }
    for own in sdos.iter().filter(|sdo| OFFSETS.contains(&sdo.index)) {
        let (index, sub) = own.address();
        let is_zero = written(index, sub).is_none_or(|sdo| sdo.data.iter().all(|b| *b == 0));
        if !is_zero {
            let object = NamedObject { index, sub };
            let message = format!("{object} adds to every target of the axis, past its limits");
            p.add_hint(own.value.span(), message, "write 0, or leave it out");
        }
    }
    notes
}
