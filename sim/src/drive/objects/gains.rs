//! The control parameters of a maxon drive: 0x30A0–0x30A3, and the selection of the speed estimate.
//! Values written by SDO act within 10 ms.
//!
//! The IDX application notes (chapter 2, tables 2-7 to 2-10) name the units that EPOS Studio shows.
//! An object holds thousandths of them (µV/A, µA/rad, ‰, mHz, …); the filter's cut-off frequency is
//! in whole hertz.

use super::bind::Binder;
use super::units::prefix;
use super::{float, whole};
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::control::{
    CurrentGains, FeedGains, Feedback, Gains, ObserverGains, PositionGains, Tuning, VelocityGains,
};
use crate::drive::plant::PlantParams;

/// One control parameter.
#[derive(Debug)]
struct Row {
    index: u16,
    sub: u8,
    name: &'static str,
    bits: u32,
    /// The SI value of 1 in the object.
    unit: f64,
}

const fn row(index: u16, sub: u8, name: &'static str, bits: u32, unit: f64) -> Row {
    Row {
        index,
        sub,
        name,
        bits,
        unit,
    }
}

/// 1 nN·m per rpm, in N·m per rad/s.
const FRICTION: f64 = 1e-9 * 30.0 / std::f64::consts::PI;

/// The row of the position loop's I gain. 0x30A1:09 changes its unit by powers of ten.
const POSITION_I: usize = 3;
const POSITION_I_UNIT: &str = "SI unit position controller I gain";
const MICROAMPERE_PER_S: i64 = 0xfa04_0300;
const MILLIAMPERE_PER_S: i64 = 0xfd04_0300;
const LARGEST: f64 = 4_294_967_295.0;

/// 0x3000:02: PI current controller, PI velocity controller with low-pass filter, PID position
/// controller. The second digit selects the speed estimate.
const FILTERED: i64 = 0x0001_0111;
const OBSERVER: i64 = 2;

const ROWS: [Row; 17] = [
    row(0x30a0, 1, "Current controller P gain", 32, 1e-6),
    row(0x30a0, 2, "Current controller I gain", 32, 1e-3),
    row(0x30a1, 1, "Position controller P gain", 32, 1e-6),
    row(0x30a1, 2, "Position controller I gain", 32, 1e-6),
    row(0x30a1, 3, "Position controller D gain", 32, 1e-6),
    row(0x30a1, 4, "Position controller FF velocity gain", 32, 1e-6),
    row(
        0x30a1,
        5,
        "Position controller FF acceleration gain",
        32,
        1e-6,
    ),
    row(0x30a2, 1, "Velocity controller P gain", 32, 1e-6),
    row(0x30a2, 2, "Velocity controller I gain", 32, 1e-6),
    row(0x30a2, 3, "Velocity controller FF velocity gain", 32, 1e-6),
    row(
        0x30a2,
        4,
        "Velocity controller FF acceleration gain",
        32,
        1e-6,
    ),
    row(
        0x30a2,
        5,
        "Velocity controller filter cut-off frequency",
        16,
        1.0,
    ),
    row(
        0x30a3,
        1,
        "Velocity observer position correction gain",
        32,
        1e-3,
    ),
    row(
        0x30a3,
        2,
        "Velocity observer velocity correction gain",
        32,
        1e-3,
    ),
    row(
        0x30a3,
        3,
        "Velocity observer load correction gain",
        32,
        1e-6,
    ),
    row(0x30a3, 4, "Velocity observer friction", 32, FRICTION),
    row(0x30a3, 5, "Velocity observer inertia", 32, 1e-10),
];

const OBJECTS: [(u16, &str); 4] = [
    (0x30a0, "Current control parameter set"),
    (0x30a1, "Position control parameter set"),
    (0x30a2, "Velocity control parameter set"),
    (0x30a3, "Velocity observer parameter set"),
];

/// Returns the gains in the table's order.
fn to_table(g: &Gains) -> [f64; ROWS.len()] {
    [
        g.current.p,
        g.current.i,
        g.position.p,
        g.position.i,
        g.position.d,
        g.position.feed.velocity,
        g.position.feed.acceleration,
        g.velocity.p,
        g.velocity.i,
        g.velocity.feed.velocity,
        g.velocity.feed.acceleration,
        g.velocity.cut_off,
        g.observer.position,
        g.observer.velocity,
        g.observer.load,
        g.observer.friction,
        g.observer.inertia,
    ]
}

fn from_table(table: [f64; ROWS.len()]) -> Gains {
    let [
        cp,
        ci,
        pp,
        pi,
        pd,
        pv,
        pa,
        vp,
        vi,
        vv,
        va,
        cut_off,
        op,
        ov,
        ol,
        of,
        oj,
    ] = table;
    let feed = |velocity, acceleration| FeedGains {
        velocity,
        acceleration,
    };
    Gains {
        current: CurrentGains { p: cp, i: ci },
        position: PositionGains {
            p: pp,
            i: pi,
            d: pd,
            feed: feed(pv, pa),
        },
        velocity: VelocityGains {
            p: vp,
            i: vi,
            feed: feed(vv, va),
            cut_off,
        },
        observer: ObserverGains {
            position: op,
            velocity: ov,
            load: ol,
            friction: of,
            inertia: oj,
        },
    }
}

#[derive(Debug, Clone)]
pub(super) struct TuningSlots {
    /// In the table's order. `None`: the dictionary has no such object, and the value from
    /// commissioning stays.
    gains: [Option<EntryHandle>; ROWS.len()],
    position_i_unit: Option<EntryHandle>,
    torque_constant: Option<EntryHandle>,
    nominal_current: Option<EntryHandle>,
    thermal_time_constant: Option<EntryHandle>,
    control_structure: Option<EntryHandle>,
    commissioned: Tuning,
}

impl TuningSlots {
    pub(super) fn add(b: &mut Binder<'_>) {
        for (index, name) in OBJECTS {
            let rows = ROWS.iter().filter(|row| row.index == index);
            let unit = (index == 0x30a1).then_some((9, POSITION_I_UNIT, 32));
            let rows = rows.map(|row| (row.sub, row.name, row.bits)).chain(unit);
            b.add_own(index, name, rows);
        }
    }

    /// Finds the objects and writes the result of tuning this motor.
    pub(super) fn bind(b: &mut Binder<'_>, plant: &PlantParams) -> Self {
        let commissioned = Tuning {
            gains: Gains::tuned(plant),
            feedback: Feedback::default(),
            torque_constant: plant.torque_constant.max(1e-9),
            nominal_current: plant.nominal_current,
            thermal_time_constant: plant.thermal_time_constant,
        };
        let table = to_table(&commissioned.gains);
        // Stiff drives with heavy loads need more than 32 bits of microamperes.
        let wide = table.get(POSITION_I).is_some_and(|i| *i * 1e6 > LARGEST);
        let unit = if wide {
            MILLIAMPERE_PER_S
        } else {
            MICROAMPERE_PER_S
        };
        let position_i_unit = b.own_motor_data(0x30a1, 9, POSITION_I_UNIT, unit);
        let mut slots = Self {
            gains: [None; ROWS.len()],
            position_i_unit,
            torque_constant: b.own(0x3001, 5, "Torque constant"),
            nominal_current: b.own(0x3001, 1, "Nominal current"),
            thermal_time_constant: b.own(0x3001, 4, "Thermal time constant winding"),
            control_structure: b.own_motor_data(0x3000, 2, "Control structure", FILTERED),
            commissioned,
        };
        let units = slots.units(b.store);
        for (((slot, row), value), unit) in slots.gains.iter_mut().zip(&ROWS).zip(table).zip(units)
        {
            let value = whole((value / unit).min(LARGEST));
            *slot = b.own_motor_data(row.index, row.sub, row.name, value);
        }
        slots
    }

    fn units(&self, store: &ObjectStore) -> [f64; ROWS.len()] {
        let mut units = ROWS.map(|row| row.unit);
        if let (Some(unit), Some(slot)) = (units.get_mut(POSITION_I), self.position_i_unit) {
            *unit = prefix(store.get(slot));
        }
        units
    }

    /// Returns the present values of the objects.
    pub(super) fn read(&self, store: &ObjectStore) -> Tuning {
        let mut table = to_table(&self.commissioned.gains);
        for ((value, slot), unit) in table.iter_mut().zip(self.gains).zip(self.units(store)) {
            if let Some(slot) = slot {
                *value = float(store.get(slot).max(0)) * unit;
            }
        }
        let observed = self
            .control_structure
            .is_some_and(|slot| store.get(slot) >> 4 & 0xf == OBSERVER);
        let motor = |slot: Option<EntryHandle>, unit: f64, commissioned: f64| {
            slot.map(|slot| float(store.get(slot)) * unit)
                .filter(|value| *value > 0.0)
                .unwrap_or(commissioned)
        };
        let c = &self.commissioned;
        Tuning {
            gains: from_table(table),
            feedback: if observed {
                Feedback::Observer
            } else {
                Feedback::Filter
            },
            torque_constant: motor(self.torque_constant, 1e-6, c.torque_constant),
            nominal_current: motor(self.nominal_current, 1e-3, c.nominal_current),
            thermal_time_constant: motor(self.thermal_time_constant, 0.1, c.thermal_time_constant),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 2.3.1–2.3.3, "conversion of … parameters (EPOS4/IDX to SI units)": index, subindex, and the
    /// factor from EPOS Studio's unit to SI. The objects hold thousandths of that unit; only the
    /// cut-off frequency is in whole hertz.
    const NOTES: [(u16, u8, f64); 17] = [
        (0x30a0, 1, 0.001),
        (0x30a0, 2, 1.0),
        (0x30a1, 1, 0.001),
        (0x30a1, 2, 0.001),
        (0x30a1, 3, 0.001),
        (0x30a1, 4, 0.001),
        (0x30a1, 5, 0.001),
        (0x30a2, 1, 0.001),
        (0x30a2, 2, 0.001),
        (0x30a2, 3, 0.001),
        (0x30a2, 4, 0.001),
        (0x30a2, 5, 1000.0),
        (0x30a3, 1, 1.0),
        (0x30a3, 2, 1.0),
        (0x30a3, 3, 0.001),
        (0x30a3, 4, 0.000_03 / std::f64::consts::PI),
        (0x30a3, 5, 0.000_000_1),
    ];

    fn drive(plant: &PlantParams) -> (ObjectStore, TuningSlots) {
        let mut store = ObjectStore::default();
        let mut b = Binder::new(&mut store, 0);
        super::super::motor::add(&mut b);
        TuningSlots::add(&mut b);
        super::super::motor::fill(&mut b, plant);
        let slots = TuningSlots::bind(&mut b, plant);
        (store, slots)
    }

    #[test]
    fn gain_objects_convert_as_in_the_application_notes() {
        let (mut store, slots) = drive(&PlantParams::default());
        for (n, (index, sub, factor)) in NOTES.into_iter().enumerate() {
            let slot = store.slot(index, sub).unwrap();
            let raw = 400 + i64::try_from(n).unwrap();
            store.set(slot, raw);
            let value = to_table(&slots.read(&store).gains)[n];
            let expected = factor * float(raw) / 1000.0;
            assert!(
                (value / expected - 1.0).abs() < 1e-12,
                "0x{index:04x}:{sub}: {value}, not {expected}"
            );
        }
    }

    /// 2.3.4: FF_ω = r / k_m, FF_α = J / k_m.
    #[test]
    fn tuning_writes_motor_values_to_the_objects() {
        let plant = PlantParams::default();
        let (store, slots) = drive(&plant);
        let value = |index, sub| store.get(store.slot(index, sub).unwrap());
        for (index, sub, expected) in [
            (0x3001, 1, 3200),
            (0x3001, 4, 300),
            (0x3001, 5, 37_000),
            (0x3002, 1, 600),
            (0x3002, 2, 460),
            // 20 µN·m·s / 37 mN·m/A, 3.6e-5 kg·m² / 37 mN·m/A
            (0x30a1, 4, 541),
            (0x30a1, 5, 973),
            (0x30a2, 3, 541),
            (0x30a2, 4, 973),
            // 20 µN·m·s/rad in nN·m/rpm, 360 g·cm²
            (0x30a3, 4, 2094),
            (0x30a3, 5, 360_000),
        ] {
            assert_eq!(value(index, sub), expected, "0x{index:04x}:{sub}");
        }
        // Only the rounding in the objects changes the gains.
        let tuned = to_table(&Gains::tuned(&plant));
        for (read, tuned) in to_table(&slots.read(&store).gains).into_iter().zip(tuned) {
            assert!((read / tuned - 1.0).abs() < 3e-3, "{read}, not {tuned}");
        }
    }

    #[test]
    fn position_i_gain_unit_is_configurable() {
        let (mut store, slots) = drive(&PlantParams::default());
        let gain = store.slot(0x30a1, 2).unwrap();
        let unit = store.slot(0x30a1, 9).unwrap();
        assert_eq!(store.get(unit), 0xfa04_0300);
        store.set(gain, 163_393_222);
        assert!((slots.read(&store).gains.position.i - 163.393_222).abs() < 1e-9);
        store.set(unit, 0xfd04_0300);
        assert!((slots.read(&store).gains.position.i - 163_393.222).abs() < 1e-6);
        // A load that needs the coarser unit from the start.
        let heavy = PlantParams {
            inertia: 0.02,
            ..PlantParams::default()
        };
        let (store, slots) = drive(&heavy);
        assert_eq!(store.get(unit), 0xfd04_0300);
        let tuned = Gains::tuned(&heavy).position.i;
        assert!((slots.read(&store).gains.position.i / tuned - 1.0).abs() < 1e-4);
    }

    #[test]
    fn control_structure_selects_the_speed_estimate() {
        let (mut store, slots) = drive(&PlantParams::default());
        let structure = store.slot(0x3000, 2).unwrap();
        for (value, feedback) in [
            (0x0001_0111, Feedback::Filter),
            (0x0001_0121, Feedback::Observer),
            (0, Feedback::Filter),
        ] {
            store.set(structure, value);
            assert_eq!(slots.read(&store).feedback, feedback);
        }
    }

    #[test]
    fn vendor_objects_of_other_drives_stay_unchanged() {
        let mut store = ObjectStore::default();
        let access = super::super::bind::RW;
        let slot = store.ensure(0x30a0, 1, "Brake delay", 32, access, &[7]);
        let plant = PlantParams::default();
        let slots = TuningSlots::bind(&mut Binder::new(&mut store, 0), &plant);
        assert_eq!(store.get(slot), 7);
        let tuned = Gains::tuned(&plant).current;
        assert_eq!(slots.read(&store).gains.current, tuned);
    }
}
