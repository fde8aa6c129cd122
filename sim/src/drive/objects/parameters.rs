//! Parameters of the drive: option codes, limits, profiles, units.

use super::bind::{Binder, RW};
use super::homing::{HomingParameters, HomingSlots};
use super::options::OptionSlots;
use super::torque::{CurrentLimits, TorqueSlots};
use super::units::{RPM, RPM_AND_FINER, RPM_PER_S, acceleration_unit, period_ns, velocity_unit};
use super::velocity::{VelocitySlots, VelocityWindows};
use super::{cycles, float, int, uint, whole};
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::modes::Polarity;
use crate::drive::plant::PlantParams;
use crate::drive::profile::Dynamics;
use crate::drive::state::OptionCodes;

#[derive(Debug, Clone)]
pub(super) struct ParameterSlots {
    options: OptionSlots,
    velocity: VelocitySlots,
    following_window: EntryHandle,
    following_timeout: EntryHandle,
    position_window: EntryHandle,
    position_window_time: EntryHandle,
    torque: TorqueSlots,
    range: [EntryHandle; 2],
    limits: [EntryHandle; 2],
    max_profile_velocity: EntryHandle,
    max_motor_speed: EntryHandle,
    /// 0x3003:03, in rpm.
    max_gear_speed: Option<EntryHandle>,
    profile_velocity: EntryHandle,
    profile_acceleration: EntryHandle,
    profile_deceleration: EntryHandle,
    quick_stop_deceleration: EntryHandle,
    max_acceleration: EntryHandle,
    homing: HomingSlots,
    /// Without 0x60A9 and 0x60AA the units are counts/s and counts/s².
    unit_velocity: Option<EntryHandle>,
    unit_acceleration: Option<EntryHandle>,
    /// 0x607E, if the ESI has it.
    polarity: Option<EntryHandle>,
    period_value: EntryHandle,
    period_index: EntryHandle,
    /// Process data carries 0x6080. Zero then means zero; in an unset object it means "no limit".
    speed_is_mapped: bool,
    /// Process data carries 0x6080 or a torque limit.
    limits_are_mapped: bool,
}

/// The parameters in counts and seconds.
#[derive(Debug, Clone, Copy)]
pub(in crate::drive) struct Parameters {
    pub options: OptionCodes,
    /// The following error window, in counts. `None`: not supervised.
    pub following_window: Option<f64>,
    /// The following error time-out, in control cycles.
    pub following_timeout: u32,
    pub position_window: Option<f64>,
    pub position_window_time: u32,
    /// The smallest value of 0x6064, and the number of its values.
    pub range_min: i64,
    pub range_width: i64,
    pub software_limits: Option<(i64, i64)>,
    /// The lower of 0x6080 and 0x3003:03.
    pub max_speed: f64,
    /// The lower of 0x607F and [`Self::max_speed`].
    pub max_profile_speed: f64,
    pub velocity: VelocityWindows,
    pub profile: Dynamics,
    pub quick_stop_deceleration: f64,
    /// The unit of 0x60FF and 0x606C, in counts/s.
    pub velocity_unit: f64,
    /// A thousandth of the rated torque, in N·m.
    pub torque_unit: f64,
    pub current: CurrentLimits,
    /// 0x607E.
    pub polarity: Polarity,
    /// 0x60C2.
    pub period_ns: i64,
}

impl ParameterSlots {
    pub(super) fn bind(b: &mut Binder<'_>, plant: &PlantParams) -> Self {
        let max_motor_speed = b.bind(0x6080, 0, "Max motor speed", 32, RW);
        b.motor_data(max_motor_speed, i64::from(plant.max_motor_speed));
        let (unit_velocity, unit_acceleration) = (b.slot(0x60a9, 0), b.slot(0x60aa, 0));
        let counts_per_turn = f64::from(plant.counts_per_turn.max(1));
        let mut unit = |slot: Option<EntryHandle>, default, of: fn(i64, f64) -> f64| {
            slot.map_or(1.0, |slot| {
                b.fill(slot, default);
                of(b.store.get(slot), counts_per_turn)
            })
        };
        let per_unit_velocity = unit(unit_velocity, RPM, velocity_unit);
        let per_unit_acceleration = unit(unit_acceleration, RPM_PER_S, acceleration_unit);
        if let Some(slot) = unit_velocity {
            b.choose(slot, RPM_AND_FINER);
        }
        // rpm and rpm/s in the drive's units.
        let per_rpm = counts_per_turn / 60.0 / per_unit_velocity;
        let per_rpm_s = counts_per_turn / 60.0 / per_unit_acceleration;
        let speed = |rpm: f64| whole(rpm * per_rpm).clamp(1, 0xffff_ffff);
        let acceleration = whole(10_000.0 * per_rpm_s).clamp(1, 0xffff_ffff);
        let limits = [
            b.bind(0x607d, 1, "Min position limit", 32, RW),
            b.bind(0x607d, 2, "Max position limit", 32, RW),
        ];
        b.drop_limits_without(limits, i64::from(plant.initial_position));
        Self {
            options: OptionSlots::bind(b),
            velocity: VelocitySlots::find(b),
            // maxon's factory value; 0xFFFFFFFF is off (CiA 402-2), as in the ESI of other vendors.
            following_window: b.with_default(
                0x6065,
                0,
                "Following error window",
                32,
                if b.is_maxon() { 2000 } else { 0xffff_ffff },
            ),
            following_timeout: b.bind(0x6066, 0, "Following error time out", 16, RW),
            position_window: b.with_default(0x6067, 0, "Position window", 32, 0xffff_ffff),
            position_window_time: b.bind(0x6068, 0, "Position window time", 16, RW),
            torque: TorqueSlots::bind(b, plant),
            range: [
                b.bind(0x607b, 1, "Min position range limit", 32, RW),
                b.bind(0x607b, 2, "Max position range limit", 32, RW),
            ],
            limits,
            max_profile_velocity: b.with_default(
                0x607f,
                0,
                "Max profile velocity",
                32,
                speed(50_000.0),
            ),
            max_motor_speed,
            max_gear_speed: b.own(0x3003, 3, "Max gear input speed"),
            profile_velocity: b.with_default(0x6081, 0, "Profile velocity", 32, speed(1000.0)),
            profile_acceleration: b.with_default(
                0x6083,
                0,
                "Profile acceleration",
                32,
                acceleration,
            ),
            profile_deceleration: b.with_default(
                0x6084,
                0,
                "Profile deceleration",
                32,
                acceleration,
            ),
            quick_stop_deceleration: b.with_default(
                0x6085,
                0,
                "Quick stop deceleration",
                32,
                acceleration,
            ),
            max_acceleration: b.with_default(0x60c5, 0, "Max acceleration", 32, 0xffff_ffff),
            homing: HomingSlots::bind(b, per_rpm, per_rpm_s, &plant.quirks),
            unit_velocity,
            unit_acceleration,
            polarity: b.slot(0x607e, 0),
            period_value: b.bind(0x60c2, 1, "Interpolation time period value", 8, RW),
            period_index: b.with_default(0x60c2, 2, "Interpolation time index", 8, -3),
            speed_is_mapped: false,
            limits_are_mapped: false,
        }
    }

    /// Sets the objects that the output process data carries.
    pub(super) fn set_mapped(&mut self, is_mapped: impl Fn(EntryHandle) -> bool) {
        self.speed_is_mapped = is_mapped(self.max_motor_speed);
        self.limits_are_mapped = self.torque.set_mapped(is_mapped) || self.speed_is_mapped;
    }

    /// True if parameters change with the process data.
    pub(super) fn limits_are_mapped(&self) -> bool {
        self.limits_are_mapped
    }

    /// Returns the units of speed and acceleration, in counts/s and counts/s².
    fn units(&self, store: &ObjectStore, counts_per_turn: f64) -> (f64, f64) {
        let velocity = self
            .unit_velocity
            .map_or(1.0, |slot| velocity_unit(store.get(slot), counts_per_turn));
        let acceleration = self.unit_acceleration.map_or(1.0, |slot| {
            acceleration_unit(store.get(slot), counts_per_turn)
        });
        (velocity, acceleration)
    }

    fn polarity(&self, store: &ObjectStore, plant: &PlantParams) -> Polarity {
        let object = self.polarity.map_or(0, |slot| uint(store, slot));
        Polarity::of(object, &plant.quirks)
    }

    /// Reads the homing parameters. They are needed only in homing mode.
    pub(super) fn read_homing(&self, store: &ObjectStore, plant: &PlantParams) -> HomingParameters {
        let counts_per_turn = f64::from(plant.counts_per_turn.max(1));
        let (velocity_unit, acceleration_unit) = self.units(store, counts_per_turn);
        let read = self.homing.read(store, velocity_unit, acceleration_unit);
        let polarity = self.polarity(store, plant);
        let negated = plant.quirks.home_offset_negated;
        let home_position = if negated {
            -read.home_position
        } else {
            read.home_position
        };
        HomingParameters {
            home_position: polarity.way(home_position),
            ..read
        }
    }

    /// Returns the present values of the objects.
    pub(super) fn read(&self, store: &ObjectStore, plant: &PlantParams) -> Parameters {
        let p = self;
        let counts_per_turn = f64::from(plant.counts_per_turn.max(1));
        let (velocity_unit, acceleration_unit) = self.units(store, counts_per_turn);
        let speed = |slot| float(uint(store, slot)) * velocity_unit;
        let acceleration = |slot| float(uint(store, slot).max(1)) * acceleration_unit;
        let window = |slot| {
            Some(uint(store, slot))
                .filter(|&w| w < 0xffff_ffff)
                .map(float)
        };
        let polarity = self.polarity(store, plant);
        let cycles = |slot| cycles(uint(store, slot));
        let pair = |[min, max]: [EntryHandle; 2]| (int(store, min), int(store, max));
        let (range_min, range_max) = match pair(p.range) {
            (min, max) if min < max => (min, max),
            _ => (i64::from(i32::MIN), i64::from(i32::MAX)),
        };
        // 0x6080 is always in rpm, independent of 0x60A9.
        let max_speed = match uint(store, p.max_motor_speed) {
            0 if !self.speed_is_mapped => i64::from(plant.max_motor_speed),
            rpm => rpm,
        };
        let max_speed = match p.max_gear_speed.map(|slot| uint(store, slot)) {
            Some(gear) if gear > 0 => gear.min(max_speed),
            _ => max_speed,
        };
        let max_speed = float(max_speed) * counts_per_turn / 60.0;
        let profile_limit = speed(p.max_profile_velocity).min(max_speed);
        let max_acceleration = acceleration(p.max_acceleration);
        Parameters {
            options: p.options.read(store),
            velocity: p.velocity.read(store, velocity_unit),
            following_window: window(p.following_window),
            following_timeout: cycles(p.following_timeout),
            position_window: window(p.position_window),
            position_window_time: cycles(p.position_window_time),
            range_min,
            range_width: range_max - range_min + 1,
            software_limits: Some(pair(p.limits)).filter(|(min, max)| min < max).map(
                |(min, max)| {
                    if polarity.position {
                        (-max, -min)
                    } else {
                        (min, max)
                    }
                },
            ),
            polarity,
            max_speed,
            max_profile_speed: profile_limit,
            profile: Dynamics {
                velocity: speed(p.profile_velocity).min(profile_limit),
                acceleration: acceleration(p.profile_acceleration).min(max_acceleration),
                deceleration: acceleration(p.profile_deceleration).min(max_acceleration),
            },
            quick_stop_deceleration: acceleration(p.quick_stop_deceleration),
            velocity_unit: velocity_unit * plant.quirks.velocity_factor.unwrap_or(1.0),
            torque_unit: p.torque.rated(store) * 1e-3,
            current: p.torque.read(store, plant, polarity.torque),
            period_ns: period_ns(uint(store, p.period_value), int(store, p.period_index)),
        }
    }
}
