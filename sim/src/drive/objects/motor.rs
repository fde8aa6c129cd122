//! Motor and supply data from commissioning: 0x3000–0x3002, 0x3010 and 0x2200 of a maxon drive.

use super::bind::Binder;
use super::whole;
use crate::drive::plant::PlantParams;

/// Index, subindex, name, bits, and the value for this plant. `None`: no known value.
type Row = (u16, u8, &'static str, u32, Option<fn(&PlantParams) -> f64>);

const ROWS: [Row; 12] = [
    (
        0x2200,
        1,
        "Power supply voltage",
        16,
        Some(|p| p.supply_voltage * 1e1),
    ),
    (0x3000, 1, "Sensors configuration", 32, None),
    (0x3000, 2, "Control structure", 32, None),
    (
        0x3000,
        5,
        "Main sensor resolution",
        32,
        Some(|p| f64::from(p.counts_per_turn)),
    ),
    (
        0x3010,
        1,
        "Digital incremental encoder 1 number of pulses",
        32,
        Some(|p| f64::from(p.counts_per_turn / 4)),
    ),
    (
        0x3001,
        1,
        "Nominal current",
        32,
        Some(|p| p.nominal_current * 1e3),
    ),
    (
        0x3001,
        2,
        "Output current limit",
        32,
        Some(|p| p.current_limit * 1e3),
    ),
    (0x3001, 3, "Number of pole pairs", 8, None),
    (
        0x3001,
        4,
        "Thermal time constant winding",
        16,
        Some(|p| p.thermal_time_constant * 1e1),
    ),
    (
        0x3001,
        5,
        "Torque constant",
        32,
        Some(|p| p.torque_constant * 1e6),
    ),
    (
        0x3002,
        1,
        "Electrical resistance",
        32,
        Some(|p| p.resistance * 1e3),
    ),
    (
        0x3002,
        2,
        "Electrical inductance",
        16,
        Some(|p| p.inductance * 1e6),
    ),
];

const OBJECTS: [(u16, &str); 5] = [
    (0x2200, "Power supply"),
    (0x3000, "Axis configuration"),
    (0x3001, "Motor data"),
    (0x3010, "Digital incremental encoder 1"),
    (0x3002, "Electrical system parameters"),
];

/// Adds the objects to a dictionary without vendor-specific objects.
pub(super) fn add(b: &mut Binder<'_>) {
    for (index, name) in OBJECTS {
        let rows = ROWS.iter().filter(|row| row.0 == index);
        b.add_own(
            index,
            name,
            rows.map(|&(_, sub, name, bits, _)| (sub, name, bits)),
        );
    }
}

pub(super) fn fill(b: &mut Binder<'_>, plant: &PlantParams) {
    for (index, sub, name, bits, of) in ROWS {
        if let Some(of) = of {
            let largest = f64::from(u32::MAX >> (32 - bits));
            b.own_motor_data(index, sub, name, whole(of(plant).clamp(0.0, largest)));
        }
    }
}
