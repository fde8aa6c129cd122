//! The axis section of a drive, from its answers.

use std::ops::RangeInclusive;

use ecaxis_axis::scale::{AccelerationUnit, Scale, VelocityUnit};
use ecaxis_axis::units::{RawAcceleration, RawVelocity};
use ecaxis_esi as esi;

use super::MARK;
use super::lines::TomlWriter;
use crate::scan::{Device, DriveInfo, EsiMatch};

/// The default encoder resolution: 500 lines with quadrature.
const USUAL_ENCODER: f64 = 2000.0;
/// Turns per second, and per second squared.
const USUAL_VELOCITY: f64 = 1.0;
const USUAL_ACCELERATION: f64 = 10.0;
/// Values beyond these are no limits of a real drive: 120,000 rpm, and a thousandth of a turn per
/// second.
const VELOCITIES: RangeInclusive<f64> = 1e-3..=2000.0;
const ACCELERATIONS: RangeInclusive<f64> = 1e-2..=1e7;
/// The longest time in s to stop from the velocity limit.
const LONGEST_STOP_S: f64 = 600.0;
/// A range in turns that holds the first move, a tenth of a turn there and back.
const SHORTEST_RANGE: f64 = 0.5;
/// The part of the drive's 32 bits that a limit may use. Over-velocities must be distinguishable.
const USABLE: f64 = 0.6;
/// The maximum number of counts that a drive can distinguish.
const MOST_COUNTS: f64 = 2_147_483_648.0;
/// Percent of the rated torque, which every motor tolerates.
const TORQUE: f64 = 100.0;
const NOT_REPORTED: &str = "the drive does not say";

/// Returns the initial mode: the first of the ESI that the drive does not exclude.
pub(super) fn mode(device: &Device, described: Option<&EsiMatch>) -> Option<esi::Mode> {
    let described = described?;
    if !device.says_drive() && !described.is_drive() {
        return None;
    }
    let supported = drive(device).and_then(|drive| drive.supported_modes);
    let offered = esi::offered_modes(&described.file, &described.device);
    let possible = |mode: &esi::Mode| {
        // 0x6502: bit 0 is mode 1.
        let bit = u32::from(mode.code().to_le_bytes()[0]).saturating_sub(1);
        let supports = |modes: u32| modes.checked_shr(bit).unwrap_or(0) & 1 != 0;
        offered.contains(mode) && supported.filter(|modes| *modes != 0).is_none_or(supports)
    };
    let wanted = [esi::Mode::Csp, esi::Mode::Csv, esi::Mode::Cst];
    wanted.into_iter().find(possible)
}

fn drive(device: &Device) -> Option<&DriveInfo> {
    match &device.answers {
        Some(Ok(answers)) => answers.drive.as_ref(),
        _ => None,
    }
}

/// Returns why a value is a guess. `silent`: the meaning of a missing answer.
fn unsaid(device: &Device, silent: &'static str) -> &'static str {
    match device.answers {
        Some(Ok(_)) => silent,
        Some(Err(_)) => "it did not answer",
        None => "it was not asked",
    }
}

/// Returns `[device.axis]` in turns of the motor.
pub(super) fn section(device: &Device, described: &EsiMatch) -> String {
    let unknown = DriveInfo::default();
    let drive = drive(device).unwrap_or(&unknown);
    let mut lines = TomlWriter::default();
    lines.header("[device.axis]");
    let comment = format!("{MARK} of the motor; or your own, with `per_turn`");
    lines.add("unit", "\"turn\"", &comment);
    let encoder = encoder(device, drive, &mut lines);
    if let Some(polarity) = drive.units.polarity.filter(|p| p & 0xc0 != 0) {
        lines.comment(&format!(
            "{MARK} the drive inverts by itself, 0x607E is 0x{polarity:02x}"
        ));
    }
    let by_esi = default(described, 0x60a9);
    let mut units = vec![VelocityUnit::default()];
    units.extend(
        [drive.units.velocity_unit, by_esi]
            .into_iter()
            .flatten()
            .filter_map(VelocityUnit::from_si_code),
    );
    let unknown = |code: &u32| VelocityUnit::from_si_code(*code).is_none();
    if let Some(code) = drive.units.velocity_unit.filter(unknown) {
        let comment =
            format!("{MARK} the drive's unit of velocity, 0x60A9, is 0x{code:08x}: not understood");
        lines.add("velocity_unit", "\"counts/s\"", &comment);
        units.push(VelocityUnit::COUNTS_PER_SECOND);
    } else if let Some(code) = by_esi.filter(unknown) {
        let own = drive.units.velocity_unit;
        let own = own.and_then(VelocityUnit::from_si_code);
        let unit = own.unwrap_or(VelocityUnit::COUNTS_PER_SECOND);
        let comment = format!("{MARK} 0x60A9 of the ESI is 0x{code:08x}: not understood");
        lines.add("velocity_unit", &format!("\"{unit}\""), &comment);
        units.push(unit);
    }
    if let Ok(scale) = Scale::new(encoder, 1.0) {
        let of_unit = |unit: &VelocityUnit| {
            let scale = scale.with_velocity_unit(*unit);
            scale.velocity_to_user(RawVelocity(i32::MAX)).0.abs()
        };
        let most = units.iter().map(of_unit).fold(f64::MAX, f64::min) * USABLE;
        limits(
            device,
            drive,
            scale_of(drive, scale, described),
            most,
            &mut lines,
        );
    }
    lines.text()
}

fn encoder(device: &Device, drive: &DriveInfo, lines: &mut TomlWriter) -> f64 {
    let sensor = drive.sensor_resolution.map(f64::from);
    let sensor = sensor.filter(|counts| (1.0..=MOST_COUNTS).contains(counts));
    let said = drive.units.counts_per_turn();
    let said = said.filter(|(_, counts)| (1.0..=MOST_COUNTS).contains(counts));
    let (counts, comment) = match (said, sensor) {
        (Some((index, counts)), _) => {
            let comment = format!("counts a motor turn, by 0x{index:04X}");
            (counts, comment)
        }
        (None, Some(counts)) => (counts, "counts a motor turn, by 0x3000:05".to_owned()),
        (None, None) => (
            USUAL_ENCODER,
            format!(
                "{MARK} counts a motor turn; {}",
                unsaid(device, NOT_REPORTED)
            ),
        ),
    };
    lines.add("encoder", &plain(counts), &comment);
    counts
}

/// Returns the default of a 32-bit object in the ESI.
fn default(described: &EsiMatch, index: u16) -> Option<u32> {
    let item = described.device.dictionary.item(index, 0)?;
    let bytes = <[u8; 4]>::try_from(item.default.as_slice()).ok()?;
    item.has_default.then(|| u32::from_le_bytes(bytes))
}

/// Returns the drive's scale of velocities and accelerations.
fn scale_of(drive: &DriveInfo, scale: Scale, described: &EsiMatch) -> Scale {
    let default = |index: u16| default(described, index);
    let velocity = drive.units.velocity_unit.or_else(|| default(0x60a9));
    let velocity = velocity.and_then(VelocityUnit::from_si_code);
    let velocity = velocity.unwrap_or_default();
    let acceleration = drive.units.acceleration_unit.or_else(|| default(0x60aa));
    let acceleration = acceleration.and_then(AccelerationUnit::from_si_code);
    scale
        .with_velocity_unit(velocity)
        .with_acceleration_unit(acceleration.unwrap_or(velocity.into()))
}

/// Adds the limits. `most`: the highest velocity in turns/s that every unit can express.
fn limits(device: &Device, drive: &DriveInfo, scale: Scale, most: f64, lines: &mut TomlWriter) {
    let turns = |n: i32| scale.units_of_counts(f64::from(n));
    match range(drive) {
        Some([low, high]) if turns(high) - turns(low) >= SHORTEST_RANGE => {
            let [low, high] = [low, high].map(|n| number(turns(n)));
            let comment = format!("{MARK} the drive's own, 0x607D");
            lines.add("limits.position", &format!("[{low}, {high}]"), &comment);
        }
        Some([low, high]) => {
            let [low, high] = [low, high].map(|n| number(turns(n)));
            let comment = format!("{MARK} 0x607D, less than half a turn");
            lines.comment(&format!("limits.position = [{low}, {high}]  {comment}"));
        }
        None => {
            let why = unsaid(device, "the drive knows no ends");
            lines.comment(&format!("limits.position = [-10.0, 10.0]  {MARK} {why}"));
        }
    }

    // The smaller of two equivalent limits.
    let profile = drive.max_profile_velocity.filter(|n| *n > 0);
    let profile = profile.and_then(|n| i32::try_from(n).ok());
    let profile = profile.map(|n| (scale.velocity_to_user(RawVelocity(n)).0, "0x607F"));
    let motor = drive.max_motor_speed.filter(|n| *n > 0);
    let motor = motor.map(|rpm| (f64::from(rpm) / 60.0, "0x6080"));
    let both = [profile, motor].into_iter().flatten();
    let slowest = both.min_by(|a, b| a.0.total_cmp(&b.0));
    // A value beyond the range of the object, or of real motors, is not a limit.
    let velocity = slowest.filter(|(n, _)| *n <= most && VELOCITIES.contains(n));
    let absurd = |value: Option<(f64, &'static str)>| match value {
        Some((_, object)) => format!("{object} is not a plausible limit"),
        None => unsaid(device, NOT_REPORTED).to_owned(),
    };
    let usual = USUAL_VELOCITY.min(most);
    said_or(
        "limits.velocity",
        velocity,
        usual,
        ("turns/s", &absurd(slowest)),
        lines,
    );
    let velocity = velocity.map_or(usual, |(velocity, _)| velocity);

    let raws = [
        (drive.max_acceleration, "0x60C5"),
        (drive.max_deceleration, "0x60C6"),
    ];
    let each = raws.into_iter().filter_map(|(raw, object)| {
        let raw = raw.filter(|n| *n > 0 && *n < u32::MAX)?;
        Some((scale.acceleration_to_user(RawAcceleration(raw)).0, object))
    });
    let lowest = each.min_by(|a, b| a.0.total_cmp(&b.0));
    let acceleration =
        lowest.filter(|(n, _)| ACCELERATIONS.contains(n) && velocity / n <= LONGEST_STOP_S);
    said_or(
        "limits.acceleration",
        acceleration,
        USUAL_ACCELERATION,
        ("turns/s²", &absurd(lowest)),
        lines,
    );

    let allowed = drive.max_torque.filter(|n| *n > 0);
    let comment = match allowed {
        Some(n) => format!(
            "% of the rated torque; 0x6072 allows {}",
            plain(f64::from(n) / 10.0)
        ),
        None => "% of the rated torque".to_owned(),
    };
    let torque = allowed.map_or(TORQUE, |n| TORQUE.min(f64::from(n) / 10.0));
    lines.add("limits.torque", &number(torque), &comment);

    let window = drive.following_window.filter(|n| (1..u32::MAX).contains(n));
    let window = window.map(|n| scale.units_of_counts(f64::from(n)));
    match window {
        Some(turns) => {
            let comment = format!("{MARK} turns; the drive's own, 0x6065");
            lines.add("limits.following_error", &number(turns), &comment);
        }
        None => {
            let why = unsaid(device, "the drive does not watch it");
            lines.comment(&format!("limits.following_error = 0.5  {MARK} {why}"));
        }
    }
}

/// Returns the drive's software limits, unless they are the full range.
fn range(drive: &DriveInfo) -> Option<[i32; 2]> {
    let [low, high] = drive.software_limits?;
    let wide = i64::from(high) - i64::from(low);
    // The ends are rounded in the file.
    let most = i64::from(i32::MAX) / 10 * 9;
    (low < high && low > i32::MIN && high < i32::MAX && wide < most).then_some([low, high])
}

/// Formats a value. `words`: the unit, and the reason for a guess.
fn said_or(
    key: &str,
    said: Option<(f64, &str)>,
    usual: f64,
    words: (&str, &str),
    lines: &mut TomlWriter,
) {
    let (unit, unsaid) = words;
    let (value, comment) = match said {
        Some((value, object)) => (value, format!("{MARK} {unit}; the drive's own, {object}")),
        None => (usual, format!("{MARK} {unit}; {unsaid}")),
    };
    lines.add(key, &number(value), &comment);
}

/// Formats a whole number without a decimal point.
fn plain(value: f64) -> String {
    let text = number(value);
    text.strip_suffix(".0").map_or(text.clone(), str::to_owned)
}

/// Formats a number with a decimal point and significant digits only.
fn number(value: f64) -> String {
    let rounded = (value * 1e4).round() / 1e4;
    // Rounding to zero would remove all significant digits.
    let shown = if rounded == 0.0 { value } else { rounded };
    format!("{shown:?}")
}
