//! Classes of parameters: which of them belong to a machine, and which to one unit of a device.
//!
//! The first row that matches decides: those of the vendor, then those of the standards, then the
//! words in the name of a manufacturer's object. Everything else is a setting of the machine.

use std::fmt;
use std::ops::RangeInclusive;

use super::Parameter;
use super::dump::Origin;
use crate::mailbox::NamedObject;

/// The class of a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Class {
    /// Says which device it is.
    Identity,
    /// Depends on the machine and its motor.
    Machine,
    /// The result of tuning.
    Tuned,
    /// Measured or adjusted in one unit of the device, its motor or its encoder.
    Unit,
    /// Acts when it is written, or holds the present command.
    Command,
    /// Records of the device, and the state of its tools.
    Log,
}

impl Class {
    pub const ALL: [Self; 6] = [
        Self::Identity,
        Self::Machine,
        Self::Tuned,
        Self::Unit,
        Self::Command,
        Self::Log,
    ];

    /// Returns true if a write is possible while an axis of the device has power: it moves and
    /// resets nothing, and changes neither limits, units nor the meaning of positions.
    #[must_use]
    pub const fn is_written_with_power(self) -> bool {
        matches!(self, Self::Tuned | Self::Log)
    }

    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Identity => "identity",
            Self::Machine => "machine",
            Self::Tuned => "tuned",
            Self::Unit => "unit",
            Self::Command => "command",
            Self::Log => "log",
        }
    }
}

impl fmt::Display for Class {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// Objects of one class: indices, subindices, class, and what they are.
type Row = (RangeInclusive<u16>, RangeInclusive<u8>, Class, &'static str);

const ALL: RangeInclusive<u8> = 0..=u8::MAX;
const VAR: RangeInclusive<u8> = 0..=0;

const fn only(sub: u8) -> RangeInclusive<u8> {
    sub..=sub
}

/// Objects of CiA 301, CiA 302, ETG.1020 and ETG.5001.
const COMMUNICATION: &[Row] = &[
    (0x1000..=0x1000, ALL, Class::Identity, "device type"),
    (0x1001..=0x1003, ALL, Class::Log, "error history"),
    (0x1008..=0x100a, ALL, Class::Identity, "name and version"),
    (0x1010..=0x1011, ALL, Class::Command, "store and restore"),
    (0x1012..=0x1013, ALL, Class::Command, "time"),
    (0x1018..=0x1018, ALL, Class::Identity, "identity"),
    (0x1023..=0x1026, ALL, Class::Command, "OS command"),
    (0x10e0..=0x10e0, ALL, Class::Command, "device ID reload"),
    (0x10f3..=0x10f3, ALL, Class::Log, "diagnosis history"),
    (0x10f8..=0x10f8, ALL, Class::Command, "time"),
    (
        0x1c32..=0x1c33,
        only(8),
        Class::Command,
        "measurement of times",
    ),
    (
        0x1f25..=0x1f25,
        ALL,
        Class::Command,
        "configuration request",
    ),
    (0x1f50..=0x1f57, ALL, Class::Command, "program control"),
    (0x1f82..=0x1f82, ALL, Class::Command, "NMT request"),
    (0xb000..=0xbfff, ALL, Class::Command, "command of a module"),
    (0xf008..=0xf008, ALL, Class::Command, "code word"),
    (0xf980..=0xf98f, ALL, Class::Identity, "safety address"),
    (
        0xfb00..=0xfbff,
        ALL,
        Class::Command,
        "command of the device",
    ),
];

/// Objects of each axis of a CiA 402 drive. Terminals have records at these indices, whose
/// elements are settings; so a variable has its subindex here.
const PROFILE: &[Row] = &[
    (0x6040..=0x6040, VAR, Class::Command, "Controlword"),
    (0x6042..=0x6042, VAR, Class::Command, "target"),
    (0x6060..=0x6060, VAR, Class::Command, "mode of operation"),
    (0x6071..=0x6071, VAR, Class::Command, "target"),
    (0x607a..=0x607a, VAR, Class::Command, "target"),
    (0x60b0..=0x60b2, VAR, Class::Command, "offset of the target"),
    (0x60b8..=0x60b8, VAR, Class::Command, "touch probe function"),
    (0x60c1..=0x60c1, ALL, Class::Command, "interpolation data"),
    (0x60c4..=0x60c4, only(6), Class::Command, "buffer clear"),
    (0x60f6..=0x60fb, ALL, Class::Tuned, "control parameters"),
    (0x60fe..=0x60fe, ALL, Class::Command, "digital outputs"),
    (0x60ff..=0x60ff, VAR, Class::Command, "target"),
    (
        0x6406..=0x6407,
        VAR,
        Class::Log,
        "date of calibration or service",
    ),
];

/// maxon EPOS4 and IDX.
const MAXON: &[Row] = &[
    (0x2100..=0x2101, ALL, Class::Identity, "serial number"),
    (0x210c..=0x210c, ALL, Class::Unit, "memory of the user"),
    (0x2ec0..=0x2ec0, ALL, Class::Command, "internal control"),
    (
        0x3010..=0x3010,
        only(4),
        Class::Unit,
        "position of the index",
    ),
    (
        0x3012..=0x3012,
        only(0x0a),
        Class::Unit,
        "commutation offset",
    ),
    (
        0x30a0..=0x30a4,
        ALL,
        Class::Tuned,
        "controller and observer",
    ),
    (0x30ae..=0x30ae, ALL, Class::Tuned, "dual loop controller"),
    (
        0x30b5..=0x30b5,
        ALL,
        Class::Unit,
        "home reference and its state",
    ),
    (0x3158..=0x3158, ALL, Class::Tuned, "times of the brake"),
    (
        0x3163..=0x3163,
        ALL,
        Class::Unit,
        "adjustment of analog inputs",
    ),
    (0x3182..=0x3182, ALL, Class::Command, "analog output"),
    (0x31e0..=0x31e9, ALL, Class::Log, "data recorder"),
    (0x3240..=0x3240, ALL, Class::Command, "test"),
    (0x3241..=0x3241, only(6), Class::Unit, "rotor angle"),
    (
        0x3241..=0x3241,
        ALL,
        Class::Unit,
        "offset of the current sensors",
    ),
    (0x3248..=0x3250, ALL, Class::Log, "state of the auto tuning"),
];

/// Synapticon SOMANET.
const SYNAPTICON: &[Row] = &[
    (0x2000..=0x2000, ALL, Class::Command, "command object"),
    (0x2001..=0x2001, ALL, Class::Unit, "commutation offset"),
    (0x2003..=0x2003, only(5), Class::Unit, "order of the phases"),
    (
        0x2008..=0x2008,
        ALL,
        Class::Unit,
        "cogging torque compensation",
    ),
    (
        0x2009..=0x2009,
        only(1),
        Class::Unit,
        "state of the commutation offset",
    ),
    (0x2010..=0x2013, ALL, Class::Tuned, "controller"),
    (0x2015..=0x2015, ALL, Class::Tuned, "feed-forward"),
    (0x2021..=0x2023, ALL, Class::Tuned, "filter"),
    (0x20f2..=0x20f2, ALL, Class::Identity, "assigned name"),
    (
        0x2207..=0x2208,
        6..=0x0b,
        Class::Unit,
        "angle of a Hall state",
    ),
    (0x2300..=0x2300, ALL, Class::Command, "offset of the target"),
    (0x2601..=0x2604, ALL, Class::Command, "digital output"),
    (0x2701..=0x2704, ALL, Class::Command, "tuning command"),
    (0x2705..=0x2705, ALL, Class::Log, "state of the set-up"),
    (0x2a00..=0x2a03, ALL, Class::Command, "tuning command"),
    (0x2ffe..=0x2fff, ALL, Class::Command, "data of the user"),
];

/// Elmo Gold.
const ELMO: &[Row] = &[
    (0x2005..=0x2005, ALL, Class::Command, "target"),
    (0x20e0..=0x20e0, ALL, Class::Identity, "alias"),
    (0x20fd..=0x20fd, ALL, Class::Command, "digital inputs"),
    (0x2110..=0x211e, ALL, Class::Tuned, "controller and filter"),
    (0x22a1..=0x22a1, only(1), Class::Command, "digital outputs"),
    (0x2e00..=0x2e00, ALL, Class::Command, "gain scheduling"),
    (0x2e10..=0x2e10, ALL, Class::Command, "set position"),
    (
        0x2f00..=0x2f01,
        ALL,
        Class::Command,
        "variables of the user",
    ),
];

/// Beckhoff AX8000 and terminals.
const BECKHOFF: &[Row] = &[
    (0x300c..=0x300d, ALL, Class::Command, "tuning command"),
    (
        0x32cd..=0x32cd,
        only(1),
        Class::Command,
        "commutation command",
    ),
];

/// Inovance SV660.
const INOVANCE: &[Row] = &[
    (
        0x2000..=0x2001,
        ALL,
        Class::Identity,
        "serial number and type",
    ),
    (
        0x2005..=0x2005,
        0x2f..=0x32,
        Class::Unit,
        "offset of the absolute position",
    ),
    (
        0x2006..=0x2007,
        only(4),
        Class::Command,
        "reference from the keypad",
    ),
    (0x2008..=0x2009, ALL, Class::Tuned, "gains and auto tuning"),
    (0x200b..=0x200b, ALL, Class::Log, "fault record"),
    (0x200d..=0x200d, ALL, Class::Command, "auxiliary function"),
    (
        0x200e..=0x200e,
        only(0x26),
        Class::Command,
        "reset of the EEPROM",
    ),
];

/// STEPPERONLINE A6.
const STEPPERONLINE: &[Row] = &[
    (0x2001..=0x2002, ALL, Class::Tuned, "gains and auto tuning"),
    (
        0x2003..=0x2003,
        only(0x22),
        Class::Command,
        "speed reference",
    ),
    (
        0x2003..=0x2003,
        only(0x42),
        Class::Command,
        "torque reference",
    ),
    (
        0x2010..=0x2010,
        0x11..=0x14,
        Class::Unit,
        "offset of the absolute position",
    ),
    (
        0x2010..=0x2010,
        only(0x1f),
        Class::Unit,
        "offset of the absolute position",
    ),
    (0x2031..=0x2031, ALL, Class::Command, "reset"),
];

/// The rows of vendors by vendor id.
const VENDORS: &[(u32, &[Row])] = &[
    (0x0000_0002, BECKHOFF),
    (0x0000_009a, ELMO),
    (0x0000_00fb, MAXON),
    (0x0000_22d2, SYNAPTICON),
    (0x0010_0000, INOVANCE),
    (0x0040_0000, STEPPERONLINE),
];

/// The tuning commands of drives whose vendor has no rows.
const FOREIGN: &[Row] = &[(0x3413..=0x3413, ALL, Class::Command, "commutation command")];

/// Words in the names of manufacturers' objects. Letters are lower case.
const WORDS: &[(&str, Class)] = &[
    ("serial number", Class::Identity),
    ("calibration", Class::Unit),
    ("commutation offset", Class::Unit),
    ("commutation angle", Class::Unit),
    ("angle offset", Class::Unit),
    ("rotor angle", Class::Unit),
    ("rotor offset", Class::Unit),
    ("electrical angle", Class::Unit),
    ("encoder offset", Class::Unit),
    ("sensor offset", Class::Unit),
    ("current offset", Class::Unit),
    ("adc offset", Class::Unit),
    ("absolute position offset", Class::Unit),
    ("home reference", Class::Unit),
    ("password", Class::Command),
];

/// The ranges with objects of manufacturers, and the settings of terminals.
const MANUFACTURER: [RangeInclusive<u16>; 2] = [0x2000..=0x5fff, 0x8000..=0x8fff];

const AXES: RangeInclusive<u16> = 0x6000..=0x9fff;
const AXIS: u16 = 0x0800;

/// Returns the class of an object and, where it decides, what the object is.
#[must_use]
pub fn classify(vendor: u32, at: NamedObject, name: &str) -> (Class, &'static str) {
    let find = |rows: &'static [Row], index: u16| {
        let mut rows = rows.iter();
        let row = rows.find(|row| row.0.contains(&index) && row.1.contains(&at.sub));
        row.map(|row| (row.2, row.3))
    };
    let own = VENDORS.iter().find(|(id, _)| *id == vendor);
    let of_vendor = find(own.map_or(FOREIGN, |(_, rows)| rows), at.index);
    let standard = match AXES.contains(&at.index) {
        true => find(PROFILE, AXES.start() + (at.index - AXES.start()) % AXIS),
        false => find(COMMUNICATION, at.index),
    };
    let by_name = || {
        MANUFACTURER
            .iter()
            .find(|range| range.contains(&at.index))?;
        let name = name.to_lowercase();
        let word = WORDS.iter().find(|(word, _)| name.contains(word));
        word.map(|&(_, class)| (class, "by its name"))
    };
    let found = of_vendor.or(standard).or_else(by_name);
    found.unwrap_or((Class::Machine, ""))
}

/// Says which parameters of a device may be written to another device, or to itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CopyRule {
    vendor: u32,
    classes: [Option<Class>; 3],
}

impl CopyRule {
    /// Settings of the machine and of tuning go to every unit.
    #[must_use]
    pub const fn to_other_unit(vendor: u32) -> Self {
        Self {
            vendor,
            classes: [Some(Class::Machine), Some(Class::Tuned), None],
        }
    }

    /// Data of the unit go back to it as well.
    #[must_use]
    pub const fn to_same_unit(vendor: u32) -> Self {
        Self {
            vendor,
            classes: [Some(Class::Machine), Some(Class::Tuned), Some(Class::Unit)],
        }
    }

    /// Returns the rule from one device to another, whose vendor says what a write does. A serial
    /// number of 0 distinguishes no units.
    #[must_use]
    pub fn between(from: &Origin, to: &Origin) -> Self {
        let same = from.identity() == to.identity() && from.serial == to.serial && to.serial != 0;
        if same {
            Self::to_same_unit(to.vendor)
        } else {
            Self::to_other_unit(to.vendor)
        }
    }

    /// Keeps the given classes only.
    #[must_use]
    pub fn only(mut self, wanted: &[Class]) -> Self {
        for class in &mut self.classes {
            *class = class.filter(|class| wanted.contains(class));
        }
        self
    }

    #[must_use]
    pub fn allows(&self, class: Class) -> bool {
        self.classes.contains(&Some(class))
    }

    #[must_use]
    pub fn class(&self, parameter: &Parameter) -> (Class, &'static str) {
        classify(self.vendor, parameter.at, &parameter.name)
    }

    /// Returns true if the value is a setting that may be written.
    #[must_use]
    pub fn copies(&self, parameter: &Parameter) -> bool {
        parameter.writable && self.allows(self.class(parameter).0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vendor_rows_standards_and_names_give_the_class() {
        let (maxon, somanet, beckhoff, unknown) = (0xfb, 0x22d2, 2, 0x1234_5678);
        for (vendor, index, sub, name, class) in [
            (maxon, 0x3241, 1, "", Class::Unit),
            (maxon, 0x3241, 6, "", Class::Unit),
            (maxon, 0x30b5, 2, "", Class::Unit),
            (maxon, 0x3012, 0x0a, "", Class::Unit),
            (maxon, 0x3012, 0x0b, "", Class::Machine),
            (maxon, 0x30a1, 1, "", Class::Tuned),
            (maxon, 0x3001, 1, "", Class::Machine),
            (maxon, 0x2ec0, 1, "", Class::Command),
            (maxon, 0x324b, 1, "", Class::Log),
            (somanet, 0x2001, 0, "", Class::Unit),
            (somanet, 0x2003, 1, "", Class::Machine),
            (somanet, 0x2003, 5, "", Class::Unit),
            (somanet, 0x2701, 0, "", Class::Command),
            (beckhoff, 0x32cd, 1, "", Class::Command),
            (
                beckhoff,
                0x800f,
                1,
                "AI Vendor data: Calibration offset",
                Class::Unit,
            ),
            (unknown, 0x3413, 0, "", Class::Command),
            (unknown, 0x3241, 1, "Following window", Class::Machine),
            (unknown, 0x2077, 0, "Commutation angle offset", Class::Unit),
            (
                unknown,
                0x2078,
                0,
                "Encoder: Serial Number",
                Class::Identity,
            ),
            (unknown, 0x607c, 0, "Calibration", Class::Machine),
            (unknown, 0x1010, 1, "", Class::Command),
            (unknown, 0x1011, 1, "", Class::Command),
            (unknown, 0x1023, 1, "", Class::Command),
            (unknown, 0x1003, 0, "", Class::Log),
            (unknown, 0x1018, 1, "", Class::Identity),
            (unknown, 0x6040, 0, "", Class::Command),
            (unknown, 0x6840, 0, "", Class::Command),
            (unknown, 0x68ff, 0, "", Class::Command),
            (unknown, 0x60fe, 1, "", Class::Command),
            (unknown, 0x60fb, 1, "", Class::Tuned),
            (unknown, 0x6065, 0, "", Class::Machine),
            // Settings of the fifth channel of a terminal.
            (unknown, 0x8040, 1, "", Class::Machine),
            (unknown, 0x8060, 0x11, "", Class::Machine),
            (unknown, 0xfbf0, 1, "", Class::Command),
        ] {
            let at = NamedObject { index, sub };
            assert_eq!(classify(vendor, at, name).0, class, "{vendor:#x} {at}");
        }
        assert!(VENDORS.is_sorted_by_key(|(id, _)| *id));
    }

    #[test]
    fn with_power_only_tuning_and_records_are_written() {
        for (vendor, index, written) in [
            (0x1234_5678, 0x1010, false),
            (0x1234_5678, 0x1011, false),
            (0x1234_5678, 0x1f51, false),
            (0x1234_5678, 0x6040, false),
            (0x1234_5678, 0x6060, false),
            (0x1234_5678, 0x6065, false),
            (0x1234_5678, 0x6071, false),
            (0x1234_5678, 0x6072, false),
            (0x1234_5678, 0x607a, false),
            (0x1234_5678, 0x607d, false),
            (0x1234_5678, 0x607f, false),
            (0x1234_5678, 0x60ff, false),
            (0x1234_5678, 0x6865, false),
            (0x1234_5678, 0x2000, false),
            (0x1234_5678, 0x60f9, true),
            (0x1234_5678, 0x1003, true),
            (0xfb, 0x30a1, true),
            (0xfb, 0x3001, false),
        ] {
            let at = NamedObject { index, sub: 0 };
            let class = classify(vendor, at, "").0;
            assert_eq!(class.is_written_with_power(), written, "{vendor:#x} {at}");
        }
    }

    #[test]
    fn unit_data_goes_back_to_the_same_unit_only() {
        let origin = |revision, serial| Origin {
            vendor: 0xfb,
            product: 1,
            revision,
            serial,
            ..Origin::default()
        };
        for (from, to, same) in [
            (origin(1, 7), origin(1, 7), true),
            (origin(1, 7), origin(1, 8), false),
            (origin(1, 7), origin(2, 7), false),
            (origin(1, 0), origin(1, 0), false),
        ] {
            let rule = CopyRule::between(&from, &to);
            assert_eq!(rule.allows(Class::Unit), same, "{from:?} {to:?}");
            assert!(rule.allows(Class::Machine) && rule.allows(Class::Tuned));
            let never = [Class::Identity, Class::Command, Class::Log];
            assert!(never.iter().all(|class| !rule.allows(*class)));
            let rule = rule.only(&[Class::Tuned, Class::Unit, Class::Command]);
            assert_eq!(rule.allows(Class::Unit), same);
            assert!(!rule.allows(Class::Machine) && !rule.allows(Class::Command));
        }
    }
}
