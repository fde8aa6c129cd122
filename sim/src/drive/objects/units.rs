//! Units of the drive's objects: SI unit codes of 0x60A8–0x60AA, the time code of 0x60C2.

/// rpm, the power-on value of 0x60A9.
pub(super) const RPM: i64 = 0x00b4_4700;
/// rpm and its tenths to millionths: the values of 0x60A9 that a drive with rpm accepts.
pub(super) const RPM_AND_FINER: &[i64] = &[
    RPM,
    rpm_by_ten_to(-1),
    rpm_by_ten_to(-2),
    rpm_by_ten_to(-3),
    rpm_by_ten_to(-4),
    rpm_by_ten_to(-5),
    rpm_by_ten_to(-6),
];

/// Returns the code as the 32-bit two's complement that the object holds.
const fn rpm_by_ten_to(power: i64) -> i64 {
    (power << 24) + RPM
}

/// rpm/s, for 0x60AA.
pub(super) const RPM_PER_S: i64 = 0x00c0_0300;
/// Encoder counts, the only value of 0x60A8.
pub(super) const COUNTS: i64 = 0x00b5_0000;

/// Returns 0x60C2 in ns. An invalid cycle time means "no interpolation".
pub(super) fn period_ns(value: i64, index: i64) -> i64 {
    let Some(power) = index.checked_add(9).and_then(|e| u32::try_from(e).ok()) else {
        return 0;
    };
    10i64
        .checked_pow(power)
        .and_then(|ns| ns.checked_mul(value))
        .filter(|ns| (0..=10_000_000_000).contains(ns))
        .unwrap_or(0)
}

/// Returns the factor of the prefix (power of ten, pico to tera). SI unit codes are prefix,
/// numerator, denominator, reserved, high byte first.
pub(super) fn prefix(code: i64) -> f64 {
    let prefix = i32::from(((code >> 24) & 0xff) as u8 as i8);
    10f64.powi(prefix.clamp(-12, 12))
}

/// Returns the counts/s per unit of velocity.
pub(super) fn velocity_unit(code: i64, counts_per_turn: f64) -> f64 {
    let numerator = match (code >> 16) & 0xff {
        0xb5 => 1.0,
        _ => counts_per_turn,
    };
    let denominator = match (code >> 8) & 0xff {
        0x03 => 1.0,
        _ => 60.0,
    };
    prefix(code) * numerator / denominator
}

/// Returns the counts/s² per unit of acceleration. 0xC0 is revolutions per minute, per second.
pub(super) fn acceleration_unit(code: i64, counts_per_turn: f64) -> f64 {
    let numerator = match (code >> 16) & 0xff {
        0xb5 => 1.0,
        0xb4 => counts_per_turn,
        _ => counts_per_turn / 60.0,
    };
    prefix(code) * numerator
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unit_codes_scale_velocity_and_acceleration() {
        let rpm = 2000.0 / 60.0;
        assert_eq!(velocity_unit(0x00b4_4700, 2000.0), rpm);
        assert!((velocity_unit(0xfdb4_4700, 2000.0) - rpm * 1e-3).abs() < 1e-12);
        for (power, code) in (0..).zip(RPM_AND_FINER) {
            let unit = velocity_unit(code & 0xffff_ffff, 2000.0);
            assert!(
                (unit / rpm * 10f64.powi(power) - 1.0).abs() < 1e-12,
                "{code:x}"
            );
        }
        assert_eq!(RPM_AND_FINER[3] & 0xffff_ffff, 0xfdb4_4700);
        assert_eq!(RPM_AND_FINER[6] & 0xffff_ffff, 0xfab4_4700);
        assert_eq!(velocity_unit(0x00b5_0300, 2000.0), 1.0);
        assert_eq!(velocity_unit(0x00b4_0300, 2000.0), 2000.0);
        assert_eq!(acceleration_unit(0x00c0_0300, 2000.0), rpm);
    }

    #[test]
    fn interpolation_period() {
        assert_eq!(period_ns(1, -3), 1_000_000);
        assert_eq!(period_ns(25, -5), 250_000);
        assert_eq!(period_ns(0, -3), 0);
        assert_eq!(period_ns(255, 127), 0);
        assert_eq!(period_ns(1, -10), 0);
    }
}
