//! Gains of EPOS4 and IDX as objects (application notes, tables 2-7 to 2-10).

/// A gain of the drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GainObject {
    pub index: u16,
    pub sub: u8,
    pub name: &'static str,
    /// The unit of the table.
    pub unit: &'static str,
    /// The SI value of one in the unit of the table.
    pub si: f64,
    /// The value of the object for one in the unit of the table.
    pub raw: f64,
}

const fn gain(
    (index, sub): (u16, u8),
    name: &'static str,
    unit: &'static str,
    si: f64,
) -> GainObject {
    GainObject {
        index,
        sub,
        name,
        unit,
        si,
        raw: 1000.0,
    }
}

const MILLI: f64 = 1e-3;

/// Current, position and velocity controller, velocity observer.
pub const GAINS: [GainObject; 17] = [
    gain((0x30a0, 1), "current P", "mV/A", MILLI),
    gain((0x30a0, 2), "current I", "mV/(A·ms)", 1.0),
    gain((0x30a1, 1), "position P", "mA/rad", MILLI),
    gain((0x30a1, 2), "position I", "mA/(rad·s)", MILLI),
    gain((0x30a1, 3), "position D", "mA·s/rad", MILLI),
    gain((0x30a1, 4), "position FF velocity", "mA·s/rad", MILLI),
    gain((0x30a1, 5), "position FF acceleration", "mA·s²/rad", MILLI),
    gain((0x30a2, 1), "velocity P", "mA·s/rad", MILLI),
    gain((0x30a2, 2), "velocity I", "mA/rad", MILLI),
    gain((0x30a2, 3), "velocity FF velocity", "mA·s/rad", MILLI),
    gain((0x30a2, 4), "velocity FF acceleration", "mA·s²/rad", MILLI),
    GainObject {
        raw: 1.0,
        ..gain((0x30a2, 5), "velocity filter cut-off", "1/s", 1.0)
    },
    gain((0x30a3, 1), "observer position correction", "1", 1.0),
    gain((0x30a3, 2), "observer velocity correction", "Hz", 1.0),
    gain((0x30a3, 3), "observer load correction", "mN·m/rad", MILLI),
    gain(
        (0x30a3, 4),
        "observer friction",
        "µN·m/rpm",
        0.000_03 / std::f64::consts::PI,
    ),
    gain((0x30a3, 5), "observer inertia", "g·cm²", 1e-7),
];

impl GainObject {
    /// Returns the gain of an object.
    #[must_use]
    pub fn find(index: u16, sub: u8) -> Option<&'static Self> {
        GAINS
            .iter()
            .find(|gain| (gain.index, gain.sub) == (index, sub))
    }

    /// Converts an SI value to the value of the object; saturates.
    #[must_use]
    pub fn to_raw(&self, si: f64) -> u32 {
        // The cast saturates, and NaN becomes 0.
        (si / self.si * self.raw).round() as u32
    }

    /// Converts the value of the object to SI.
    #[must_use]
    pub fn to_si(&self, raw: u32) -> f64 {
        f64::from(raw) / self.raw * self.si
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The conversions below the tables: one in the unit of the table, in SI.
    #[test]
    fn conversions_are_those_of_the_notes() {
        for (index, sub, raw, si) in [
            (0x30a0, 1, 1_000_000, 1.0),
            (0x30a0, 2, 1_000, 1.0),
            (0x30a1, 1, 1_000_000, 1.0),
            (0x30a1, 2, 1_000_000, 1.0),
            (0x30a1, 3, 1_000_000, 1.0),
            (0x30a1, 4, 1_000_000, 1.0),
            (0x30a1, 5, 1_000_000, 1.0),
            (0x30a2, 1, 20_000, 0.02),
            (0x30a2, 2, 500_000, 0.5),
            (0x30a2, 3, 1_000_000, 1.0),
            (0x30a2, 4, 1_000_000, 1.0),
            (0x30a2, 5, 318, 318.0),
            (0x30a3, 1, 400, 0.4),
            (0x30a3, 2, 100_000, 100.0),
            (0x30a3, 3, 1_000, 1e-3),
            (0x30a3, 4, 1_000, 9.549_296_585_513_72e-6),
            (0x30a3, 5, 360_000, 3.6e-5),
        ] {
            let gain = GainObject::find(index, sub).unwrap();
            assert!((gain.to_si(raw) / si - 1.0).abs() < 1e-12, "{gain:?}");
            assert_eq!(gain.to_raw(si), raw, "{gain:?}");
        }
        assert_eq!(GAINS.len(), 17);
        assert_eq!(GainObject::find(0x30a0, 3), None);
    }

    proptest! {
        #[test]
        fn both_ways_agree(n in 0..GAINS.len(), raw in any::<u32>()) {
            prop_assert_eq!(GAINS[n].to_raw(GAINS[n].to_si(raw)), raw);
        }
    }
}
