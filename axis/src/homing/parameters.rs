//! Homing parameters: method, speeds and offsets, and the objects that contain them.

use crate::axis::{AxisConfig, HomeReference};
use crate::limits::Limits;
use crate::scale::Scale;
use crate::units::{UserAcceleration, UserUnits, UserVelocity};

/// The equipment that a method requires.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Needs {
    /// Negative limit switch.
    pub negative_limit: bool,
    /// Positive limit switch.
    pub positive_limit: bool,
    /// Home switch.
    pub home_switch: bool,
    /// Index pulse of the encoder.
    pub index: bool,
    /// A mechanical stop (0x30B2).
    pub obstacle: bool,
}

/// A homing method (0x6098).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Method {
    /// The value of 0x6098.
    pub code: i8,
    /// A short description.
    pub text: &'static str,
    /// The signals that the method uses.
    pub needs: Needs,
}

const NOTHING: Needs = Needs {
    negative_limit: false,
    positive_limit: false,
    home_switch: false,
    index: false,
    obstacle: false,
};
const NEGATIVE: Needs = Needs {
    negative_limit: true,
    ..NOTHING
};
const POSITIVE: Needs = Needs {
    positive_limit: true,
    ..NOTHING
};
const HOME: Needs = Needs {
    home_switch: true,
    ..NOTHING
};
const HOME_AND_NEGATIVE: Needs = Needs {
    negative_limit: true,
    ..HOME
};
const HOME_AND_POSITIVE: Needs = Needs {
    positive_limit: true,
    ..HOME
};
const OBSTACLE: Needs = Needs {
    obstacle: true,
    ..NOTHING
};

const fn with_index(needs: Needs) -> Needs {
    Needs {
        index: true,
        ..needs
    }
}

const fn row(code: i8, text: &'static str, needs: Needs) -> Method {
    Method { code, text, needs }
}

/// The methods of CiA 402-2 (0x6098; 15, 16, 31 and 32 are reserved) and of maxon (negative),
/// sorted by code.
#[rustfmt::skip]
pub const METHODS: &[Method] = &[
    row(-4, "mechanical end in negative direction", OBSTACLE),
    row(-3, "mechanical end in positive direction", OBSTACLE),
    row(-2, "mechanical end in negative direction, then index", with_index(OBSTACLE)),
    row(-1, "mechanical end in positive direction, then index", with_index(OBSTACLE)),
    row(1, "negative limit switch, then index", with_index(NEGATIVE)),
    row(2, "positive limit switch, then index", with_index(POSITIVE)),
    row(3, "home switch on the positive side, index below it", with_index(HOME)),
    row(4, "home switch on the positive side, index above its edge", with_index(HOME)),
    row(5, "home switch on the negative side, index above it", with_index(HOME)),
    row(6, "home switch on the negative side, index below its edge", with_index(HOME)),
    row(7, "home switch upwards, index below its lower edge", with_index(HOME_AND_POSITIVE)),
    row(8, "home switch upwards, index above its lower edge", with_index(HOME_AND_POSITIVE)),
    row(9, "home switch upwards, index below its upper edge", with_index(HOME_AND_POSITIVE)),
    row(10, "home switch upwards, index above its upper edge", with_index(HOME_AND_POSITIVE)),
    row(11, "home switch downwards, index above its upper edge", with_index(HOME_AND_NEGATIVE)),
    row(12, "home switch downwards, index below its upper edge", with_index(HOME_AND_NEGATIVE)),
    row(13, "home switch downwards, index above its lower edge", with_index(HOME_AND_NEGATIVE)),
    row(14, "home switch downwards, index below its lower edge", with_index(HOME_AND_NEGATIVE)),
    row(17, "negative limit switch", NEGATIVE),
    row(18, "positive limit switch", POSITIVE),
    row(19, "home switch on the positive side, below it", HOME),
    row(20, "home switch on the positive side, above its edge", HOME),
    row(21, "home switch on the negative side, above it", HOME),
    row(22, "home switch on the negative side, below its edge", HOME),
    row(23, "home switch upwards, below its lower edge", HOME_AND_POSITIVE),
    row(24, "home switch upwards, above its lower edge", HOME_AND_POSITIVE),
    row(25, "home switch upwards, below its upper edge", HOME_AND_POSITIVE),
    row(26, "home switch upwards, above its upper edge", HOME_AND_POSITIVE),
    row(27, "home switch downwards, above its upper edge", HOME_AND_NEGATIVE),
    row(28, "home switch downwards, below its upper edge", HOME_AND_NEGATIVE),
    row(29, "home switch downwards, above its lower edge", HOME_AND_NEGATIVE),
    row(30, "home switch downwards, below its lower edge", HOME_AND_NEGATIVE),
    row(33, "index in negative direction", with_index(NOTHING)),
    row(34, "index in positive direction", with_index(NOTHING)),
    row(35, "where the axis is (older code)", NOTHING),
    row(37, "where the axis is", NOTHING),
];

/// Returns the method with this code. A drive may support fewer methods.
#[must_use]
pub fn method(code: i8) -> Option<&'static Method> {
    let at = METHODS.binary_search_by_key(&code, |m| m.code).ok()?;
    METHODS.get(at)
}

/// Time in seconds by which a report may be late, and counts by which a drive may miss home.
const REPORT_S: f64 = 0.01;
const HOME_COUNTS: f64 = 10.0;

/// Homing parameters in user units. `None`: the drive keeps its own setting.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Homing {
    /// 0x6098.
    pub method: i8,
    /// Velocity to the switch or the mechanical stop, 0x6099:01.
    pub search_velocity: Option<f64>,
    /// Velocity off the switch and to the index, 0x6099:02.
    pub zero_velocity: Option<f64>,
    /// 0x609A.
    pub acceleration: Option<f64>,
    /// Distance of a final move away from the home position, maxon's 0x30B1.
    pub distance: Option<f64>,
    /// Position after homing. maxon: 0x30B0; others: 0x607C, whose sign depends on the vendor.
    pub position: Option<f64>,
    /// Current threshold that detects a mechanical stop, milliamperes, maxon's 0x30B2.
    pub threshold_ma: Option<u16>,
    /// True if the negative methods are maxon's. Otherwise they are the vendor's, and their
    /// meaning is unknown.
    pub maxon_methods: bool,
}

/// One start-up SDO.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct HomingObject {
    /// The index.
    pub index: u16,
    /// The subindex.
    pub subindex: u8,
    /// The value.
    pub value: i64,
    /// The length in bytes.
    pub bytes: u8,
}

/// A homing parameter is invalid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ParameterError {
    /// The method is unknown.
    #[error("homing method {0} is none of CiA 402, nor of the vendor")]
    Method(i8),
    /// A velocity or acceleration is out of range.
    #[error("{what} is {value}: it must be above zero and within the limit of {limit}")]
    Outside {
        /// The parameter's name.
        what: &'static str,
        /// The rejected value.
        value: f64,
        /// The limit of the axis.
        limit: f64,
    },
    /// A position is not representable as counts.
    #[error("{what} of {value} is not an integer of 32 bits")]
    Counts {
        /// The parameter's name.
        what: &'static str,
        /// The value in user units.
        value: f64,
    },
    /// A velocity or acceleration is below the resolution of the drive.
    #[error("{what} of {value} is less than the drive's smallest step")]
    TooSmall {
        /// The parameter's name.
        what: &'static str,
        /// The value in user units.
        value: f64,
    },
    /// The method needs [`Homing::threshold_ma`].
    #[error("homing method {0} runs into a mechanical end and needs the current that shows it")]
    NoThreshold(i8),
}

impl Homing {
    /// Returns parameters with this method and the drive's own settings otherwise.
    #[must_use]
    pub const fn by(method: i8) -> Self {
        Self {
            method,
            search_velocity: None,
            zero_velocity: None,
            acceleration: None,
            distance: None,
            position: None,
            threshold_ma: None,
            maxon_methods: true,
        }
    }

    /// Returns the method, if its meaning is known.
    #[must_use]
    pub fn known_method(&self) -> Option<&'static Method> {
        method(self.method).filter(|known| self.maxon_methods || known.code >= 0)
    }

    /// Checks the parameters against scale and limits of the axis.
    pub fn check(&self, scale: &Scale, limits: &Limits) -> Result<(), ParameterError> {
        let method = self.known_method();
        let vendor_specific = !self.maxon_methods && self.method < 0;
        if method.is_none() && !vendor_specific {
            return Err(ParameterError::Method(self.method));
        }
        let resolution = scale.velocity_resolution();
        for (what, value, limit) in [
            ("search velocity", self.search_velocity, limits.velocity),
            ("zero velocity", self.zero_velocity, limits.velocity),
            (
                "homing acceleration",
                self.acceleration,
                limits.acceleration,
            ),
        ] {
            let Some(value) = value else { continue };
            if !(value > 0.0 && value <= limit) {
                return Err(ParameterError::Outside { what, value, limit });
            }
            // A speed rounded to 0 would never reach home.
            if value < resolution * 0.5 {
                return Err(ParameterError::TooSmall { what, value });
            }
        }
        for (what, value) in [
            ("distance", self.distance),
            ("home position", self.position),
        ] {
            let Some(value) = value else { continue };
            let counts = (value * scale.counts_per_unit()).abs();
            if counts.is_nan() || counts >= f64::from(i32::MAX) {
                return Err(ParameterError::Counts { what, value });
            }
        }
        let needs_obstacle = method.is_some_and(|method| method.needs.obstacle);
        if needs_obstacle && self.threshold_ma.is_none() {
            return Err(ParameterError::NoThreshold(self.method));
        }
        Ok(())
    }

    /// Returns what a completed homing shows. A drive may stop beyond its switch or index, by its
    /// braking distance; with speeds of its own, by at most a turn of the motor.
    #[must_use]
    pub fn reference(&self, config: &AxisConfig) -> HomeReference {
        let limits = &config.limits;
        let fastest = [self.search_velocity, self.zero_velocity]
            .into_iter()
            .flatten()
            .reduce(f64::max);
        let braking = fastest.map_or(config.scale.units_per_turn().abs(), |velocity| {
            let acceleration = self.acceleration.unwrap_or(limits.acceleration);
            velocity * velocity / (2.0 * acceleration) + velocity * REPORT_S
        });
        HomeReference {
            position: self.position,
            window: config.target_window + config.scale.units_of_counts(HOME_COUNTS) + braking,
            moves: !matches!(self.method, 35 | 37),
        }
    }

    /// Returns the objects to write before the first homing. `maxon`: writes 0x30B0 instead of
    /// 0x607C. Values have the drive's units and direction. Checked parameters never exceed the
    /// value range.
    pub fn objects(
        &self,
        scale: &Scale,
        maxon: bool,
    ) -> impl Iterator<Item = HomingObject> + use<> {
        let home = if maxon { 0x30B0 } else { 0x607C };
        let object = |index, subindex, bytes, value: Option<i64>| {
            value.map(|value| HomingObject {
                index,
                subindex,
                value,
                bytes,
            })
        };
        let velocity = |v: f64| i64::from(scale.velocity_to_raw(UserVelocity(v)).0).abs();
        let acceleration = |a: f64| i64::from(scale.acceleration_to_raw(UserAcceleration(a)).0);
        let position = |p: f64| scale.position_to_counts(UserUnits(p)).0;
        // A distance has the direction of the axis but not its offset.
        let distance = |d: f64| scale.position_to_counts(UserUnits(d + scale.offset())).0;
        [
            object(0x6098, 0, 1, Some(i64::from(self.method))),
            object(0x6099, 1, 4, self.search_velocity.map(velocity)),
            object(0x6099, 2, 4, self.zero_velocity.map(velocity)),
            object(0x609A, 0, 4, self.acceleration.map(acceleration)),
            object(0x30B1, 0, 4, self.distance.map(distance)),
            object(home, 0, 4, self.position.map(position)),
            object(0x30B2, 0, 2, self.threshold_ma.map(i64::from)),
        ]
        .into_iter()
        .flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scale::VelocityUnit;

    const LIMITS: Limits = Limits {
        position: None,
        velocity: 200.0,
        acceleration: 2000.0,
        jerk: None,
        torque: 100.0,
        following_error: None,
    };

    fn scale() -> Scale {
        Scale::new(2000.0, 5.0)
            .unwrap()
            .with_velocity_unit(VelocityUnit::RPM)
    }

    #[test]
    fn methods_are_sorted_and_match_the_standard() {
        assert!(METHODS.windows(2).all(|m| m[0].code < m[1].code));
        for code in i8::MIN..=i8::MAX {
            let standard = matches!(code, 1..=14 | 17..=30 | 33..=35 | 37);
            let maxon = matches!(code, -4..=-1);
            assert_eq!(method(code).is_some(), standard || maxon, "{code}");
            if let Some(method) = method(code) {
                // 1 to 14, 33 and 34 search for the index; 17 to 30 are the same without it.
                let index = matches!(code, -2 | -1 | 1..=14 | 33 | 34);
                assert_eq!(method.needs.index, index, "{code}");
            }
        }
        for code in 1..=14 {
            let (with, without) = (method(code).unwrap(), method(code + 16).unwrap());
            assert_eq!(with.needs, with_index(without.needs));
        }
    }

    #[test]
    fn objects_are_in_the_drives_units() {
        let homing = Homing {
            search_velocity: Some(10.0),
            zero_velocity: Some(1.0),
            acceleration: Some(100.0),
            distance: Some(-2.5),
            position: Some(5.0),
            ..Homing::by(7)
        };
        assert_eq!(homing.check(&scale(), &LIMITS), Ok(()));
        let as_rows = |scale: &Scale, maxon| {
            homing
                .objects(scale, maxon)
                .map(|o| (o.index, o.subindex, o.value, o.bytes))
                .collect::<Vec<_>>()
        };
        let expected = vec![
            (0x6098, 0, 7, 1),
            (0x6099, 1, 120, 4),
            (0x6099, 2, 12, 4),
            (0x609A, 0, 1200, 4),
            (0x30B1, 0, -1000, 4),
            (0x30B0, 0, 2000, 4),
        ];
        assert_eq!(as_rows(&scale(), true), expected);
        let inverted = scale().with_invert(true).with_offset(1.0).unwrap();
        let mut rows = as_rows(&inverted, false);
        assert_eq!(rows.pop(), Some((0x607C, 0, -1600, 4)));
        assert_eq!(rows.pop(), Some((0x30B1, 0, 1000, 4)));
        assert_eq!(
            rows.get(1),
            Some(&(0x6099, 1, 120, 4)),
            "a speed has no sign"
        );
        let mut only = Homing::by(37).objects(&scale(), true);
        assert_eq!(only.next().map(|o| o.value), Some(37));
        assert_eq!(only.next(), None);
    }

    #[test]
    fn invalid_parameters_are_rejected() {
        let base = Homing::by(1);
        for homing in [
            Homing::by(0),
            Homing::by(15),
            Homing::by(36),
            Homing::by(-3),
            Homing {
                search_velocity: Some(0.0),
                ..base
            },
            Homing {
                search_velocity: Some(201.0),
                ..base
            },
            Homing {
                zero_velocity: Some(f64::NAN),
                ..base
            },
            Homing {
                zero_velocity: Some(0.01),
                ..base
            },
            Homing {
                acceleration: Some(2001.0),
                ..base
            },
            Homing {
                distance: Some(f64::INFINITY),
                ..base
            },
            Homing {
                position: Some(1e9),
                ..base
            },
        ] {
            let error = homing
                .check(&scale(), &LIMITS)
                .expect_err("must be refused");
            assert!(!error.to_string().is_empty());
        }
        let end = Homing {
            threshold_ma: Some(500),
            ..Homing::by(-3)
        };
        assert_eq!(end.check(&scale(), &LIMITS), Ok(()));
        // Another vendor's methods have no known needs.
        for method in [-1, -17, i8::MIN] {
            let vendor = Homing {
                maxon_methods: false,
                ..Homing::by(method)
            };
            assert_eq!(vendor.check(&scale(), &LIMITS), Ok(()));
            assert_eq!(vendor.known_method(), None);
        }
        let reserved = Homing {
            maxon_methods: false,
            ..Homing::by(15)
        };
        assert!(reserved.check(&scale(), &LIMITS).is_err());
    }
}
