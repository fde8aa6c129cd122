//! The object dictionary of an EPOS 24/1, 24/5 or 70/10, and its connection to the drive.
//!
//! Communication objects, PDO contents and ranges follow the application note "CANopen Basic
//! Information" (EPOS 24/1, 24/5, 70/10, firmware 2000h and later). Values that the note does not
//! define (identity, default mappings and controller gains) are the simulator's own.

use ecaxis_esi::model::{Access as CoeAccess, Writable};

use super::super::dictionary::{Access, Dictionary, Handle, Kind};
use super::super::pdo::mapping;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::PlantParams;

/// The drives of the first EPOS generation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Epos {
    /// EPOS 24/1.
    E24_1,
    /// EPOS 24/5.
    E24_5,
    /// EPOS 70/10.
    E70_10,
}

const MAXON: i64 = 0xfb;
const FIRMWARE: i64 = 0x2033;
/// Servo drive of CiA 402.
const DEVICE_TYPE: i64 = 0x0002_0192;

impl Epos {
    /// All models.
    pub const ALL: [Self; 3] = [Self::E24_1, Self::E24_5, Self::E70_10];

    /// Returns the vendor's product name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::E24_1 => "EPOS 24/1",
            Self::E24_5 => "EPOS 24/5",
            Self::E70_10 => "EPOS 70/10",
        }
    }

    /// Returns vendor, product code, revision and serial number (0x1018).
    pub(in super::super) fn identity(self, serial: u32) -> [u32; 4] {
        let hardware = self.hardware() << 16;
        [
            MAXON as u32,
            hardware as u32,
            (FIRMWARE << 16) as u32,
            serial,
        ]
    }

    /// Returns the model with this product name ([`Self::name`]).
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// Returns the bits of an object that PDO 1 and 2 can carry; `None` for all others.
    #[must_use]
    pub fn mappable_bits(index: u16, sub: u8) -> Option<u8> {
        let mut all = RECEIVABLE.iter().chain(&TRANSMITTABLE);
        all.find(|object| (object.0, object.1) == (index, sub))
            .map(|object| object.2)
    }

    /// Returns object 0x2003:02.
    pub(super) fn hardware(self) -> i64 {
        match self {
            Self::E24_1 => 0x6010,
            Self::E24_5 => 0x6210,
            Self::E70_10 => 0x6410,
        }
    }

    /// Returns the node numbers of its DIP switch: four bits on the smallest drive, seven on the
    /// others.
    #[must_use]
    pub fn node_ids(self) -> std::ops::RangeInclusive<u8> {
        match self {
            Self::E24_1 => 1..=15,
            Self::E24_5 | Self::E70_10 => 1..=127,
        }
    }

    /// Returns the plant from volts, continuous and peak amperes. Motor and load scale with the
    /// current.
    #[must_use]
    pub fn plant(self) -> PlantParams {
        let (volts, current) = match self {
            Self::E24_1 => (24.0, 1.0),
            Self::E24_5 => (24.0, 5.0),
            Self::E70_10 => (70.0, 10.0),
        };
        let own = PlantParams::default();
        let scale = current / own.nominal_current;
        PlantParams {
            inertia: own.inertia * scale,
            viscous_friction: own.viscous_friction * scale,
            coulomb_friction: own.coulomb_friction * scale,
            resistance: own.resistance / scale,
            inductance: own.inductance / scale,
            supply_voltage: volts,
            nominal_current: current,
            current_limit: 2.0 * current,
            max_motor_speed: if volts < 30.0 {
                4000
            } else {
                own.max_motor_speed
            },
            ..own
        }
    }
}

/// Objects that PDO 1 and 2 may carry, step 4 of the note's PDO configuration. Bits are as in the
/// mapping entry.
pub(in super::super) const RECEIVABLE: [(u16, u8, u8); 7] = [
    (0x6040, 0, 16),
    (0x607a, 0, 32),
    (0x60ff, 0, 32),
    (0x2078, 1, 16),
    (0x2030, 0, 16),
    (0x206b, 0, 32),
    (0x2062, 0, 32),
];
pub(in super::super) const TRANSMITTABLE: [(u16, u8, u8); 9] = [
    (0x6041, 0, 16),
    (0x6064, 0, 32),
    (0x606c, 0, 32),
    (0x2071, 1, 16),
    (0x6078, 0, 16),
    (0x207c, 1, 16),
    (0x207c, 2, 16),
    (0x2020, 0, 16),
    (0x2021, 0, 16),
];

/// Commands, which "save" does not store.
pub(super) const VOLATILE: [u16; 6] = [0x2030, 0x2062, 0x206b, 0x6040, 0x607a, 0x60ff];

/// The default COB-IDs of PDO 1 to 3, without the node number.
pub(in super::super) const RECEIVE_COBS: [i64; 3] = [0x200, 0x300, 0x400];
pub(in super::super) const TRANSMIT_COBS: [i64; 3] = [0x180, 0x280, 0x380];

/// The objects that carry the node number in their low seven bits.
pub(super) const NUMBERED: [(u16, u8); 10] = [
    (0x1014, 0),
    (0x1200, 1),
    (0x1200, 2),
    (0x1400, 1),
    (0x1401, 1),
    (0x1402, 1),
    (0x1800, 1),
    (0x1801, 1),
    (0x1802, 1),
    (0x2000, 0),
];

/// The bit rates of the values of 0x2001, in bit/s (step 4).
pub(super) const BIT_RATES: [u32; 7] = [
    1_000_000, 800_000, 500_000, 250_000, 125_000, 50_000, 20_000,
];

/// Returns the factory dictionary.
pub(super) fn dictionary(model: Epos, id: u8, serial: u32, bit_rate: u32) -> Dictionary {
    use Access::{Ro, Rw};
    use Kind::{I8, I16, I32, U8, U16, U32};
    let mut d = Dictionary::default();
    let node = i64::from(id);
    let hardware = model.hardware();
    d.add(0x1000, 0, U32, Ro, DEVICE_TYPE);
    d.add(0x1001, 0, U8, Ro, 0);
    d.ranged(0x1003, 0, U8, 0, (0, 0));
    for sub in 1..=5 {
        d.add(0x1003, sub, U32, Ro, 0);
    }
    d.add(0x1005, 0, U32, Rw, 0x80);
    d.add_bytes(0x1008, 0, Ro, b"EPOS");
    d.add(0x100c, 0, U16, Rw, 0);
    d.add(0x100d, 0, U8, Rw, 0);
    for index in [0x1010, 0x1011] {
        d.add(index, 0, U8, Ro, 1);
        d.add(index, 1, U32, Rw, 1);
    }
    d.add(0x1014, 0, U32, Ro, 0x80 + node);
    d.add(0x1016, 0, U8, Ro, 1);
    d.add(0x1016, 1, U32, Rw, 0);
    d.add(0x1017, 0, U16, Rw, 0);
    d.add(0x1018, 0, U8, Ro, 4);
    for (sub, value) in (1..).zip(model.identity(serial)) {
        d.add(0x1018, sub, U32, Ro, i64::from(value));
    }
    d.add(0x1020, 0, U8, Ro, 2);
    d.add(0x1020, 1, U32, Rw, 0);
    d.add(0x1020, 2, U32, Rw, 0);
    d.add(0x1200, 0, U8, Ro, 2);
    d.add(0x1200, 1, U32, Ro, 0x600 + node);
    d.add(0x1200, 2, U32, Ro, 0x580 + node);
    pdos(&mut d, node);
    d.add(0x2000, 0, U8, Ro, node);
    let rate = BIT_RATES.iter().position(|rate| *rate == bit_rate);
    let rate = i64::try_from(rate.unwrap_or(0)).unwrap_or(0);
    d.ranged(0x2001, 0, U16, rate, (0, 6));
    d.add(0x2003, 0, U8, Ro, 4);
    for (sub, value) in (1..).zip([FIRMWARE, hardware, 0, 0]) {
        d.add(0x2003, sub, U16, Ro, value);
    }
    for (index, sub, kind, access) in [
        (0x2020, 0, U16, Ro),
        (0x2021, 0, U16, Ro),
        (0x2030, 0, I16, Rw),
        (0x2062, 0, I32, Rw),
        (0x206b, 0, I32, Rw),
        (0x2071, 1, U16, Ro),
        (0x2078, 1, U16, Rw),
        (0x207c, 1, I16, Ro),
        (0x207c, 2, I16, Ro),
        (0x6040, 0, U16, Rw),
        (0x6041, 0, U16, Ro),
        (0x6061, 0, I8, Ro),
        (0x6062, 0, I32, Ro),
        (0x6064, 0, I32, Ro),
        (0x606b, 0, I32, Ro),
        (0x606c, 0, I32, Ro),
        (0x6078, 0, I16, Ro),
        (0x607a, 0, I32, Rw),
        (0x60ff, 0, I32, Rw),
    ] {
        d.add(index, sub, kind, access, 0);
    }
    d.ranged(0x6060, 0, I8, 1, (-3, 6));
    for (index, sub, kind, value) in [
        (0x6065, 0, U32, 2000),
        (0x6067, 0, U32, 0xffff_ffff),
        (0x6068, 0, U16, 0),
        (0x607d, 1, I32, i64::from(i32::MIN)),
        (0x607d, 2, I32, i64::from(i32::MAX)),
        (0x607f, 0, U32, 25_000),
        (0x6081, 0, U32, 1000),
        (0x6083, 0, U32, 10_000),
        (0x6084, 0, U32, 10_000),
        (0x6085, 0, U32, 10_000),
        (0x6086, 0, I16, 0),
        (0x607c, 0, I32, 0),
        (0x6098, 0, I8, 35),
        (0x6099, 0, U8, 2),
        (0x6099, 1, U32, 100),
        (0x6099, 2, U32, 10),
        (0x609a, 0, U32, 1000),
        // Gains in the vendor's units. The simulated loops use their own gains.
        (0x60f6, 1, I16, 400),
        (0x60f6, 2, I16, 80),
        (0x60f9, 1, I16, 1000),
        (0x60f9, 2, I16, 100),
        (0x60fb, 1, I16, 150),
        (0x60fb, 2, I16, 10),
        (0x60fb, 3, I16, 200),
    ] {
        d.add(index, sub, kind, Rw, value);
    }
    d
}

fn pdos(d: &mut Dictionary, node: i64) {
    use Kind::{U8, U32};
    for n in 0..3u16 {
        let at = usize::from(n);
        for (index, base) in [
            (0x1400 + n, RECEIVE_COBS[at]),
            (0x1800 + n, TRANSMIT_COBS[at]),
        ] {
            d.add(index, 0, U8, Access::Ro, 2);
            d.ranged(index, 1, U32, base + node, (base + 1, base + 0x7f));
            d.ranged(index, 2, U8, 255, (1, 255));
        }
        let contents = if n == 2 {
            [mapping(0x6040, 0, 16), mapping(0x6060, 0, 8)]
        } else {
            [mapping(0x6040, 0, 16), mapping(0x607a, 0, 32)]
        };
        contents_of(d, 0x1600 + n, n, &contents);
        let contents = if n == 2 {
            [mapping(0x6041, 0, 16), mapping(0x6061, 0, 8)]
        } else {
            [mapping(0x6041, 0, 16), mapping(0x6064, 0, 32)]
        };
        contents_of(d, 0x1a00 + n, n, &contents);
    }
}

/// Adds the contents of a PDO. The third PDO is static.
fn contents_of(d: &mut Dictionary, index: u16, n: u16, contents: &[i64; 2]) {
    let access = if n == 2 { Access::Ro } else { Access::Rw };
    let used = if n == 0 { 1 } else { 2 };
    d.add(index, 0, Kind::U8, access, used);
    for sub in 1..=if n == 2 { 2 } else { 4 } {
        let value = contents
            .get(usize::from(sub) - 1)
            .filter(|_| i64::from(sub) <= used);
        d.add(index, sub, Kind::U32, access, value.copied().unwrap_or(0));
    }
}

/// Values that dictionary and drive share unchanged: (index and subindex in the drive).
const COMMANDS: [(u16, u8); 19] = [
    (0x6040, 0),
    (0x6065, 0),
    (0x6067, 0),
    (0x6068, 0),
    (0x607d, 1),
    (0x607d, 2),
    (0x607f, 0),
    (0x6081, 0),
    (0x6083, 0),
    (0x6084, 0),
    (0x6085, 0),
    (0x6086, 0),
    (0x607c, 0),
    (0x6098, 0),
    (0x6099, 1),
    (0x6099, 2),
    (0x609a, 0),
    (0x607a, 0),
    (0x60ff, 0),
];
const ACTUALS: [(u16, u8); 6] = [
    (0x6062, 0),
    (0x6064, 0),
    (0x606b, 0),
    (0x606c, 0),
    (0x1001, 0),
    (0x6041, 0),
];

const CURRENT_ACTUAL: (u16, u8) = (0x30d1, 2);
/// Remote: the Controlword comes over the network.
const REMOTE: i64 = 1 << 9;

/// Objects of the dictionary bound to objects of the drive.
#[derive(Debug, Clone)]
pub(super) struct ObjectBindings {
    commands: Vec<(Handle, EntryHandle)>,
    actuals: Vec<(Handle, EntryHandle)>,
    /// The nominal current, in mA.
    nominal_current: f64,
    counts_per_turn: i64,
}

/// Returns the store for the drive: velocities in rpm, the current in mA.
pub(super) fn store() -> ObjectStore {
    let mut store = ObjectStore::default();
    let rw = CoeAccess {
        read: true,
        write: Writable::Always,
    };
    for (index, sub, name, bits) in [
        (0x60a9, 0, "SI unit velocity", 32),
        (0x60aa, 0, "SI unit acceleration", 32),
        (
            CURRENT_ACTUAL.0,
            CURRENT_ACTUAL.1,
            "Current actual value",
            32,
        ),
    ] {
        store.ensure(index, sub, name, bits, rw, &[]);
    }
    store
}

impl ObjectBindings {
    pub(super) fn new(d: &Dictionary, store: &ObjectStore, plant: &PlantParams) -> Self {
        let pairs = |list: &[(u16, u8)]| {
            list.iter()
                .filter_map(|(index, sub)| Some((d.find(*index, *sub)?, store.slot(*index, *sub)?)))
                .collect()
        };
        Self {
            commands: pairs(&COMMANDS),
            actuals: pairs(&ACTUALS),
            nominal_current: plant.nominal_current * 1e3,
            counts_per_turn: i64::from(plant.counts_per_turn.max(1)),
        }
    }

    /// Copies commands from the dictionary to the drive. Position, velocity and current mode (-1,
    /// -2, -3) have their own set-points without a profile. They use the drive's cyclic modes.
    #[expect(clippy::cast_precision_loss, reason = "16 bits")]
    #[expect(clippy::cast_possible_truncation, reason = "saturates")]
    pub(super) fn command(&self, d: &Dictionary, store: &mut ObjectStore) {
        for (from, to) in &self.commands {
            store.set(*to, d.at(*from));
        }
        let mut put = |index, value| {
            if let Some(slot) = store.slot(index, 0) {
                store.set(slot, value);
            }
        };
        let mode = d.get(0x6060, 0);
        put(
            0x6060,
            match mode {
                -1 => 8,
                -2 => 9,
                -3 => 10,
                own => own,
            },
        );
        match mode {
            -1 => put(0x607a, d.get(0x2062, 0)),
            -2 => put(0x60ff, d.get(0x206b, 0)),
            -3 => {
                let thousandths = d.get(0x2030, 0) as f64 * 1e3 / self.nominal_current.max(1.0);
                put(0x6071, thousandths.round() as i64);
            }
            _ => {}
        }
    }

    /// Copies actual values from the drive to the dictionary.
    pub(super) fn publish(&self, store: &ObjectStore, d: &mut Dictionary, operational: bool) {
        for (to, from) in &self.actuals {
            d.put(*to, store.get_signed(*from));
        }
        let statusword = d.get(0x6041, 0) & !REMOTE | if operational { REMOTE } else { 0 };
        d.set(0x6041, 0, statusword);
        let get = |index, sub| {
            let slot = store.slot(index, sub);
            slot.map_or(0, |slot| store.get_signed(slot))
        };
        d.set(
            0x6061,
            0,
            match get(0x6061, 0) {
                8 => -1,
                9 => -2,
                10 => -3,
                own => own,
            },
        );
        d.set(0x6078, 0, get(CURRENT_ACTUAL.0, CURRENT_ACTUAL.1));
        d.set(0x2071, 1, get(0x60fd, 0));
        let position = d.get(0x6064, 0);
        d.set(0x2020, 0, position);
        d.set(
            0x2021,
            0,
            position - position.rem_euclid(self.counts_per_turn),
        );
    }
}

/// Converts the drive's error codes to EPOS 24/1, 24/5 and 70/10 numbering.
pub(super) fn error_code(code: u16) -> u16 {
    match code {
        0x8a80 => 0xff06,
        0x8a81 => 0xff07,
        0x8a82 => 0xff09,
        same => same,
    }
}
