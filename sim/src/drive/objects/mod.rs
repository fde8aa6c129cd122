//! The objects that the drive reads and writes, as slots. An object without an ESI default gets a
//! power-on value.
//!
//! * `bind`: dictionary entries as slots
//! * `motor`: motor data
//! * `gains`: control parameters
//! * `parameters`: limits, profiles, and the results of the other modules
//! * `homing`: home position and method
//! * `io`: digital inputs and outputs
//! * `probe`: touch probes
//! * `options`: option codes
//! * `velocity`: thresholds for target speed, zero speed and slippage
//! * `torque`: current limits
//! * `units`: SI unit codes, interpolation time

mod bind;
mod gains;
mod homing;
mod io;
mod motor;
mod options;
mod parameters;
mod probe;
mod torque;
mod units;
mod velocity;

use std::ops::RangeInclusive;

use ecaxis_esi::model::Writable;

use super::control::Tuning;
use super::plant::PlantParams;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};

use bind::{Binder, RO, RW};
use gains::TuningSlots;
use io::IoSlots;
use parameters::ParameterSlots;
use units::COUNTS;

pub(super) use bind::AXIS_STRIDE;
pub(super) use homing::HomingParameters;
pub(super) use parameters::Parameters;
pub(super) use probe::ProbeSlots;
pub(super) use torque::CurrentLimits;

/// Returns the mode at power-on. A dictionary with a Controlword and without a writable 0x6060 is
/// that of a drive with one mode, which its target shows.
fn power_on_mode(b: &Binder<'_>) -> i64 {
    const PROFILE_POSITION: i64 = 1;
    let has = |index| b.slot(index, 0).is_some();
    let mode = b.slot(0x6060, 0).and_then(|slot| b.store.item(slot));
    let is_writable = mode.is_some_and(|item| item.access.write != Writable::Never);
    if is_writable || !has(0x6040) {
        return PROFILE_POSITION;
    }
    let targets = [(0x607a, 8), (0x60ff, 9), (0x6071, 10)];
    let target = targets.into_iter().find(|(index, _)| has(*index));
    target.map_or(PROFILE_POSITION, |(_, mode)| mode)
}

/// PP, PV, HM, CSP, CSV, CST.
const SUPPORTED_MODES: i64 = 1 | 1 << 2 | 1 << 5 | 1 << 7 | 1 << 8 | 1 << 9;

/// The manufacturer-specific area. An ESI without any of these objects omits them, and the drive
/// adds maxon's. An ESI with some of them is left as it is.
const MANUFACTURER_SPECIFIC: RangeInclusive<u16> = 0x2000..=0x5fff;

#[derive(Debug, Clone)]
pub(super) struct Objects {
    /// A maxon drive: torque in µNm, Statusword bit 4 as the state of the power stage.
    pub is_maxon: bool,
    /// True for the first axis of the device.
    pub is_first: bool,
    pub error_register: EntryHandle,
    pub error_code: EntryHandle,
    /// 0x1003:0 and its entries, if the ESI has them.
    history: [Option<EntryHandle>; 6],
    pub controlword: EntryHandle,
    pub statusword: EntryHandle,
    pub mode: EntryHandle,
    pub mode_display: EntryHandle,
    pub position_demand: EntryHandle,
    pub position: EntryHandle,
    pub velocity_demand: EntryHandle,
    pub velocity: EntryHandle,
    pub velocity_averaged: Option<EntryHandle>,
    pub torque: EntryHandle,
    pub torque_averaged: Option<EntryHandle>,
    pub current: Option<EntryHandle>,
    pub current_averaged: Option<EntryHandle>,
    pub current_demand: Option<EntryHandle>,
    pub thermal_level: Option<EntryHandle>,
    /// The position of an encoder at the load.
    pub load_position: Option<EntryHandle>,
    pub following_error: EntryHandle,
    pub target_position: EntryHandle,
    pub target_velocity: EntryHandle,
    pub target_torque: EntryHandle,
    pub position_offset: EntryHandle,
    pub velocity_offset: EntryHandle,
    pub torque_offset: EntryHandle,
    parameters: ParameterSlots,
    /// True if process data carries parameters in addition to the objects of
    /// [`super::Drive::sync`].
    parameters_are_mapped: bool,
    pub io: IoSlots,
    pub probes: Option<ProbeSlots>,
    tuning: TuningSlots,
}

/// 0x6091, if it acts.
#[derive(Debug, Clone, Copy)]
pub(super) struct GearSlots(pub Option<[EntryHandle; 2]>);

impl GearSlots {
    pub(super) fn bind(store: &mut ObjectStore, axis: u16, plant: &PlantParams) -> Self {
        let mut b = Binder::new(store, axis);
        let encoder = plant.quirks.gear_encoder;
        Self(encoder.map(|_| {
            [
                b.with_default(0x6091, 1, "Motor revolutions", 32, 1),
                b.with_default(0x6091, 2, "Shaft revolutions", 32, 1),
            ]
        }))
    }
}

#[expect(clippy::cast_possible_truncation, reason = "saturates")]
fn whole(value: f64) -> i64 {
    value.round() as i64
}

/// Returns a signed object. The standard has none longer than 32 bits; a dictionary may.
pub(super) fn int(store: &ObjectStore, slot: EntryHandle) -> i64 {
    let value = store.get_signed(slot);
    value.clamp(i32::MIN.into(), i32::MAX.into())
}

/// Returns an unsigned object.
fn uint(store: &ObjectStore, slot: EntryHandle) -> i64 {
    store.get(slot).clamp(0, u32::MAX.into())
}

/// Converts milliseconds to control cycles of 0.4 ms.
fn cycles(ms: i64) -> u32 {
    u32::try_from((ms * 5 + 1) / 2).unwrap_or(u32::MAX)
}

/// Converts any store value. Values here never need more than 53 bits.
#[expect(clippy::cast_precision_loss, reason = "32-bit objects")]
pub(super) fn float(value: i64) -> f64 {
    value as f64
}

impl Objects {
    pub(super) fn bind(store: &mut ObjectStore, axis: u16, plant: &PlantParams) -> Self {
        let mut b = Binder::new(store, axis);
        let history = [0, 1, 2, 3, 4, 5].map(|sub| b.slot(0x1003, sub));
        if axis == 0 && !b.store.has_any(MANUFACTURER_SPECIFIC) {
            motor::add(&mut b);
            TuningSlots::add(&mut b);
            homing::add(&mut b);
        }
        motor::fill(&mut b, plant);
        let tuning = TuningSlots::bind(&mut b, plant);
        let modes = b.with_default(0x6502, 0, "Supported drive modes", 32, SUPPORTED_MODES);
        let listed = plant.quirks.supported_modes(b.store.get(modes));
        b.store.set(modes, listed);
        b.with_default(0x60a8, 0, "SI unit position", 32, COUNTS);
        let parameters = ParameterSlots::bind(&mut b, plant);
        let power_on_mode = power_on_mode(&b);
        Self {
            is_maxon: b.is_maxon(),
            is_first: axis == 0,
            error_register: b.bind(0x1001, 0, "Error register", 8, RO),
            error_code: b.bind(0x603f, 0, "Error code", 16, RO),
            history,
            controlword: b.bind(0x6040, 0, "Controlword", 16, RW),
            statusword: b.bind(0x6041, 0, "Statusword", 16, RO),
            mode: b.with_default(0x6060, 0, "Modes of operation", 8, power_on_mode),
            mode_display: b.bind(0x6061, 0, "Modes of operation display", 8, RO),
            position_demand: b.bind(0x6062, 0, "Position demand value", 32, RO),
            position: b.bind(0x6064, 0, "Position actual value", 32, RO),
            velocity_demand: b.bind(0x606b, 0, "Velocity demand value", 32, RO),
            velocity: b.bind(0x606c, 0, "Velocity actual value", 32, RO),
            velocity_averaged: b.own(0x30d3, 1, "Velocity actual value averaged"),
            torque: b.bind(0x6077, 0, "Torque actual value", 16, RO),
            torque_averaged: b.own(0x30d2, 1, "Torque actual value averaged"),
            current: b.own(0x30d1, 2, "Current actual value"),
            current_averaged: b.own(0x30d1, 1, "Current actual value averaged"),
            current_demand: b.own(0x30d0, 0, "Current demand value"),
            thermal_level: b.own(0x3200, 1, "I2t level motor"),
            load_position: b.slot(0x60e4, 1),
            following_error: b.bind(0x60f4, 0, "Following error actual value", 32, RO),
            target_position: b.bind(0x607a, 0, "Target position", 32, RW),
            target_velocity: b.bind(0x60ff, 0, "Target velocity", 32, RW),
            target_torque: b.bind(0x6071, 0, "Target torque", 16, RW),
            position_offset: b.bind(0x60b0, 0, "Position offset", 32, RW),
            velocity_offset: b.bind(0x60b1, 0, "Velocity offset", 32, RW),
            torque_offset: b.bind(0x60b2, 0, "Torque offset", 16, RW),
            parameters,
            parameters_are_mapped: false,
            io: IoSlots::bind(&mut b),
            probes: ProbeSlots::find(&b),
            tuning,
        }
    }

    /// Sets the objects that the output process data carries.
    pub(super) fn set_mapped(&mut self, mapped: &[EntryHandle]) {
        self.parameters.set_mapped(|slot| mapped.contains(&slot));
        let commands = [
            self.controlword,
            self.mode,
            self.target_position,
            self.target_velocity,
            self.target_torque,
            self.position_offset,
            self.velocity_offset,
            self.torque_offset,
            self.io.outputs,
            self.probes.as_ref().map_or(self.mode, |p| p.function),
        ];
        self.parameters_are_mapped = mapped.iter().any(|slot| !commands.contains(slot));
    }

    /// True if process data may change any parameter.
    pub(super) fn parameters_are_mapped(&self) -> bool {
        self.parameters_are_mapped
    }

    /// True if parameters change with the process data.
    pub(super) fn limits_are_mapped(&self) -> bool {
        self.parameters.limits_are_mapped()
    }

    /// Adds an error to 0x1003, newest first.
    pub(super) fn record(&self, store: &mut ObjectStore, code: u16) {
        let [Some(count), entries @ ..] = self.history else {
            return;
        };
        let mut carried = i64::from(code);
        let mut used = 0;
        for slot in entries.into_iter().flatten() {
            let older = store.get(slot);
            store.show(slot, carried);
            used += 1;
            carried = older;
            if carried == 0 {
                break;
            }
        }
        store.show(count, used);
    }

    pub(super) fn parameters(&self, store: &ObjectStore, plant: &PlantParams) -> Parameters {
        self.parameters.read(store, plant)
    }

    pub(super) fn homing(&self, store: &ObjectStore, plant: &PlantParams) -> HomingParameters {
        self.parameters.read_homing(store, plant)
    }

    pub(super) fn tuning(&self, store: &ObjectStore) -> Tuning {
        self.tuning.read(store)
    }
}
