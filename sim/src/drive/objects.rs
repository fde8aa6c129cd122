//! The objects the drive reads and writes, as slots; power-on values for those an ESI leaves empty.

use ecaxis_esi::model::{Access, Writable};

use super::plant::PlantParams;
use super::profile::Dynamics;
use super::state::OptionCodes;
use crate::coe::store::{ObjectStore, Slot};

const RW: Access = Access {
    read: true,
    write: Writable::Always,
};
const RO: Access = Access {
    read: true,
    write: Writable::Never,
};

/// rpm, the power-on value of 0x60A9.
const RPM: i64 = 0x00b4_4700;
/// rpm/s, of 0x60AA.
const RPM_PER_S: i64 = 0x00c0_0300;
const COUNTS: i64 = 0x00b5_0000;

/// PP, PV, HM, CSP, CSV, CST.
const SUPPORTED_MODES: i64 = 1 | 1 << 2 | 1 << 5 | 1 << 7 | 1 << 8 | 1 << 9;

#[derive(Debug, Clone)]
pub(super) struct Objects {
    pub error_register: Slot,
    pub error_code: Slot,
    /// 0x1003:0 and the entries behind it, where the ESI has them.
    history: [Option<Slot>; 6],
    pub controlword: Slot,
    pub statusword: Slot,
    pub mode: Slot,
    pub mode_display: Slot,
    pub position_demand: Slot,
    pub position: Slot,
    pub velocity_demand: Slot,
    pub velocity: Slot,
    pub velocity_averaged: Option<Slot>,
    pub torque: Slot,
    pub torque_averaged: Option<Slot>,
    pub current: Option<Slot>,
    pub current_averaged: Option<Slot>,
    pub following_error: Slot,
    pub target_position: Slot,
    pub target_velocity: Slot,
    pub target_torque: Slot,
    pub position_offset: Slot,
    pub velocity_offset: Slot,
    pub torque_offset: Slot,
    parameters: ParameterSlots,
    mapped: MappedLimits,
}

/// Limits that come with the process data: then zero means zero, where an unset object means "no limit".
#[derive(Debug, Clone, Copy, Default)]
struct MappedLimits {
    torque: bool,
    speed: bool,
}

#[derive(Debug, Clone)]
struct ParameterSlots {
    quick_stop_option: Slot,
    shutdown_option: Slot,
    disable_option: Slot,
    fault_option: Slot,
    abort_option: Slot,
    following_window: Slot,
    following_timeout: Slot,
    position_window: Slot,
    position_window_time: Slot,
    max_torque: Option<Slot>,
    rated_torque: Slot,
    range: [Slot; 2],
    limits: [Slot; 2],
    max_profile_velocity: Slot,
    max_motor_speed: Slot,
    profile_velocity: Slot,
    profile_acceleration: Slot,
    profile_deceleration: Slot,
    quick_stop_deceleration: Slot,
    max_acceleration: Slot,
    homing_method: Slot,
    home_position: Option<Slot>,
    home_offset: Option<Slot>,
    /// A drive without 0x60A9 and 0x60AA counts in encoder counts and seconds.
    unit_velocity: Option<Slot>,
    unit_acceleration: Option<Slot>,
    period_value: Slot,
    period_index: Slot,
    output_current_limit: Option<Slot>,
}

/// The parameters in counts and seconds.
#[derive(Debug, Clone, Copy)]
pub(super) struct Parameters {
    pub options: OptionCodes,
    /// 0x6007: what a lost connection does.
    pub abort_option: i64,
    /// Counts; `None`: not supervised.
    pub following_window: Option<f64>,
    /// Control cycles.
    pub following_timeout: u32,
    pub position_window: Option<f64>,
    pub position_window_time: u32,
    /// Smallest and largest 0x6064 can show, and how many values that are.
    pub range_min: i64,
    pub range_width: i64,
    pub software_limits: Option<(i64, i64)>,
    pub max_speed: f64,
    pub profile: Dynamics,
    pub quick_stop_deceleration: f64,
    pub homing_method: i64,
    pub home_position: i64,
    /// Counts/s that one unit of 0x60FF and 0x606C is.
    pub velocity_unit: f64,
    /// N·m that a thousandth of rated torque is.
    pub torque_unit: f64,
    /// A.
    pub current_limit: f64,
    /// 0x60C2.
    pub period_ns: i64,
}

struct Binder<'a>(&'a mut ObjectStore);

impl Binder<'_> {
    fn bind(&mut self, index: u16, sub: u8, name: &str, bits: u32, access: Access) -> Slot {
        self.0.ensure(index, sub, name, bits, access, &[])
    }

    /// A parameter. An ESI without a default leaves zero there, which is not what a drive powers up
    /// with.
    fn with_default(&mut self, index: u16, sub: u8, name: &str, bits: u32, default: i64) -> Slot {
        let slot = self.bind(index, sub, name, bits, RW);
        self.fill(slot, default);
        slot
    }

    fn fill(&mut self, slot: Slot, default: i64) {
        if self.0.get(slot) == 0 {
            self.0.set(slot, default);
        }
    }

    /// A maker's own object. Elsewhere the same index means something else, so the name decides.
    fn own(&self, index: u16, sub: u8, name: &str) -> Option<Slot> {
        let slot = self.0.slot(index, sub)?;
        (self.0.item(slot)?.name == name).then_some(slot)
    }

    /// Motor data: commissioning has set it, whatever the ESI's factory value is.
    fn motor_data(&mut self, slot: Slot, value: i64) -> Slot {
        self.0.set(slot, value);
        slot
    }

    /// Commissioning has fitted the software limits to the machine; factory values that shut out the
    /// place where it stands cannot be meant.
    fn drop_limits_without(&mut self, [min, max]: [Slot; 2], position: i64) {
        let (low, high) = (self.0.get_signed(min), self.0.get_signed(max));
        if low < high && !(low..=high).contains(&position) {
            self.0.set(min, i64::from(i32::MIN));
            self.0.set(max, i64::from(i32::MAX));
        }
    }

    fn own_motor_data(&mut self, index: u16, sub: u8, name: &str, value: i64) -> Option<Slot> {
        let slot = self.own(index, sub, name)?;
        Some(self.motor_data(slot, value))
    }
}

#[expect(clippy::cast_possible_truncation, reason = "saturates")]
fn whole(value: f64) -> i64 {
    value.round() as i64
}

/// Fits whatever the dictionary's type is; a store value never needs more than 53 bits here.
#[expect(clippy::cast_precision_loss, reason = "32-bit objects")]
pub(super) fn float(value: i64) -> f64 {
    value as f64
}

impl Objects {
    pub(super) fn bind(store: &mut ObjectStore, plant: &PlantParams) -> Self {
        let mut b = Binder(store);
        let history = [0, 1, 2, 3, 4, 5].map(|sub| b.0.slot(0x1003, sub));
        b.own_motor_data(
            0x3001,
            1,
            "Nominal current",
            whole(plant.nominal_current * 1e3),
        );
        let output_current_limit = b.own_motor_data(
            0x3001,
            2,
            "Output current limit",
            whole(plant.current_limit * 1e3),
        );
        b.own_motor_data(
            0x3001,
            5,
            "Torque constant",
            whole(plant.torque_constant * 1e6),
        );
        b.own_motor_data(
            0x2200,
            1,
            "Power supply voltage",
            whole(plant.supply_voltage * 10.0),
        );
        b.with_default(0x6502, 0, "Supported drive modes", 32, SUPPORTED_MODES);
        b.with_default(0x60a8, 0, "SI unit position", 32, COUNTS);
        b.bind(0x60fd, 0, "Digital inputs", 32, RO);
        b.bind(0x60fe, 1, "Physical outputs", 32, RW);
        let rated_torque = b.bind(0x6076, 0, "Motor rated torque", 32, RW);
        b.motor_data(rated_torque, whole(plant.rated_torque() * 1e6));
        let max_motor_speed = b.bind(0x6080, 0, "Max motor speed", 32, RW);
        b.motor_data(max_motor_speed, i64::from(plant.max_motor_speed));
        let (unit_velocity, unit_acceleration) = (b.0.slot(0x60a9, 0), b.0.slot(0x60aa, 0));
        let counts_per_turn = f64::from(plant.counts_per_turn.max(1));
        let mut unit = |slot: Option<Slot>, default, of: fn(i64, f64) -> f64| {
            slot.map_or(1.0, |slot| {
                b.fill(slot, default);
                of(b.0.get(slot), counts_per_turn)
            })
        };
        // rpm and rpm/s in the drive's units.
        let per_rpm = counts_per_turn / 60.0 / unit(unit_velocity, RPM, velocity_unit);
        let per_rpm_s =
            counts_per_turn / 60.0 / unit(unit_acceleration, RPM_PER_S, acceleration_unit);
        let speed = |rpm: f64| whole(rpm * per_rpm).clamp(1, 0xffff_ffff);
        let acceleration = whole(10_000.0 * per_rpm_s).clamp(1, 0xffff_ffff);
        let limits = [
            b.bind(0x607d, 1, "Min position limit", 32, RW),
            b.bind(0x607d, 2, "Max position limit", 32, RW),
        ];
        b.drop_limits_without(limits, i64::from(plant.initial_position));
        let parameters = ParameterSlots {
            quick_stop_option: b.with_default(0x605a, 0, "Quick stop option code", 16, 6),
            shutdown_option: b.bind(0x605b, 0, "Shutdown option code", 16, RW),
            disable_option: b.with_default(0x605c, 0, "Disable operation option code", 16, 1),
            fault_option: b.with_default(0x605e, 0, "Fault reaction option code", 16, 2),
            abort_option: b.with_default(0x6007, 0, "Abort connection option code", 16, 3),
            following_window: b.with_default(0x6065, 0, "Following error window", 32, 2000),
            following_timeout: b.bind(0x6066, 0, "Following error time out", 16, RW),
            position_window: b.with_default(0x6067, 0, "Position window", 32, 0xffff_ffff),
            position_window_time: b.bind(0x6068, 0, "Position window time", 16, RW),
            max_torque: b.0.slot(0x6072, 0),
            rated_torque,
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
            homing_method: b.with_default(0x6098, 0, "Homing method", 8, 37),
            home_position: b.own(0x30b0, 0, "Home position"),
            home_offset: b.0.slot(0x607c, 0),
            unit_velocity,
            unit_acceleration,
            period_value: b.bind(0x60c2, 1, "Interpolation time period value", 8, RW),
            period_index: b.with_default(0x60c2, 2, "Interpolation time index", 8, -3),
            output_current_limit,
        };
        Self {
            error_register: b.bind(0x1001, 0, "Error register", 8, RO),
            error_code: b.bind(0x603f, 0, "Error code", 16, RO),
            history,
            controlword: b.bind(0x6040, 0, "Controlword", 16, RW),
            statusword: b.bind(0x6041, 0, "Statusword", 16, RO),
            mode: b.with_default(0x6060, 0, "Modes of operation", 8, 1),
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
            following_error: b.bind(0x60f4, 0, "Following error actual value", 32, RO),
            target_position: b.bind(0x607a, 0, "Target position", 32, RW),
            target_velocity: b.bind(0x60ff, 0, "Target velocity", 32, RW),
            target_torque: b.bind(0x6071, 0, "Target torque", 16, RW),
            position_offset: b.bind(0x60b0, 0, "Position offset", 32, RW),
            velocity_offset: b.bind(0x60b1, 0, "Velocity offset", 32, RW),
            torque_offset: b.bind(0x60b2, 0, "Torque offset", 16, RW),
            parameters,
            mapped: MappedLimits::default(),
        }
    }

    /// Which outputs the process data now carries.
    pub(super) fn set_mapped(&mut self, is_mapped: impl Fn(Slot) -> bool) {
        self.mapped = MappedLimits {
            torque: self.parameters.max_torque.is_some_and(&is_mapped),
            speed: is_mapped(self.parameters.max_motor_speed),
        };
    }

    /// Parameters change with the process data.
    pub(super) fn limits_are_mapped(&self) -> bool {
        self.mapped.torque || self.mapped.speed
    }

    /// 0x1003: the newest error first.
    pub(super) fn record(&self, store: &mut ObjectStore, code: u16) {
        let [Some(count), entries @ ..] = self.history else {
            return;
        };
        let mut carried = i64::from(code);
        let mut used = 0;
        for slot in entries.into_iter().flatten() {
            let older = store.get(slot);
            store.set(slot, carried);
            used += 1;
            carried = older;
            if carried == 0 {
                break;
            }
        }
        store.set(count, used);
    }

    pub(super) fn parameters(&self, store: &ObjectStore, plant: &PlantParams) -> Parameters {
        let p = &self.parameters;
        let counts_per_turn = f64::from(plant.counts_per_turn.max(1));
        let velocity_unit = p
            .unit_velocity
            .map_or(1.0, |slot| velocity_unit(store.get(slot), counts_per_turn));
        let acceleration_unit = p.unit_acceleration.map_or(1.0, |slot| {
            acceleration_unit(store.get(slot), counts_per_turn)
        });
        let speed = |slot| float(store.get(slot)) * velocity_unit;
        let acceleration = |slot| float(store.get(slot).max(1)) * acceleration_unit;
        let window = |slot| {
            Some(store.get(slot))
                .filter(|&w| w < 0xffff_ffff)
                .map(float)
        };
        // Milliseconds in control cycles of 0.4 ms.
        let cycles = |slot| u32::try_from((store.get(slot) * 5 + 1) / 2).unwrap_or(u32::MAX);
        let pair = |[min, max]: [Slot; 2]| (store.get_signed(min), store.get_signed(max));
        let (range_min, range_max) = match pair(p.range) {
            (min, max) if min < max => (min, max),
            _ => (i64::from(i32::MIN), i64::from(i32::MAX)),
        };
        // 0x6080 is in rpm whatever 0x60A9 says.
        let max_speed = match store.get(p.max_motor_speed) {
            0 if !self.mapped.speed => i64::from(plant.max_motor_speed),
            rpm => rpm.max(0),
        };
        let max_speed = float(max_speed) * counts_per_turn / 60.0;
        let profile_limit = speed(p.max_profile_velocity).min(max_speed);
        let max_acceleration = acceleration(p.max_acceleration);
        let rated_torque = float(store.get(p.rated_torque)) * 1e-6;
        let current_limit = p
            .output_current_limit
            .map(|slot| float(store.get(slot)) * 1e-3)
            .map_or(plant.current_limit, |limit| limit.min(plant.current_limit));
        let current_limit = match p.max_torque.map(|slot| store.get(slot)) {
            Some(limit) if (limit > 0 || self.mapped.torque) && plant.torque_constant > 0.0 => {
                let torque = float(limit.max(0)) * 1e-3 * rated_torque;
                current_limit.min(torque / plant.torque_constant)
            }
            _ => current_limit,
        };
        Parameters {
            options: OptionCodes {
                quick_stop: store.get_signed(p.quick_stop_option),
                shutdown: store.get_signed(p.shutdown_option),
                disable: store.get_signed(p.disable_option),
                fault: store.get_signed(p.fault_option),
            },
            abort_option: store.get_signed(p.abort_option),
            following_window: window(p.following_window),
            following_timeout: cycles(p.following_timeout),
            position_window: window(p.position_window),
            position_window_time: cycles(p.position_window_time),
            range_min,
            range_width: range_max - range_min + 1,
            software_limits: Some(pair(p.limits)).filter(|(min, max)| min < max),
            max_speed,
            profile: Dynamics {
                velocity: speed(p.profile_velocity).min(profile_limit),
                acceleration: acceleration(p.profile_acceleration).min(max_acceleration),
                deceleration: acceleration(p.profile_deceleration).min(max_acceleration),
            },
            quick_stop_deceleration: acceleration(p.quick_stop_deceleration),
            homing_method: store.get_signed(p.homing_method),
            home_position: p
                .home_position
                .or(p.home_offset)
                .map_or(0, |slot| store.get_signed(slot)),
            velocity_unit,
            torque_unit: rated_torque * 1e-3,
            current_limit,
            period_ns: period_ns(store.get(p.period_value), store.get_signed(p.period_index)),
        }
    }
}

/// 0x60C2 in nanoseconds; what cannot be a cycle time counts as "no interpolation".
fn period_ns(value: i64, index: i64) -> i64 {
    let Some(power) = index.checked_add(9).and_then(|e| u32::try_from(e).ok()) else {
        return 0;
    };
    10i64
        .checked_pow(power)
        .and_then(|ns| ns.checked_mul(value))
        .filter(|ns| (0..=10_000_000_000).contains(ns))
        .unwrap_or(0)
}

/// SI unit codes: prefix (power of ten), numerator, denominator, reserved; high byte first.
fn prefix(code: i64) -> f64 {
    let prefix = i32::from(((code >> 24) & 0xff) as u8 as i8);
    10f64.powi(prefix)
}

/// Counts/s per unit of velocity.
fn velocity_unit(code: i64, counts_per_turn: f64) -> f64 {
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

/// Counts/s² per unit of acceleration; 0xC0 is revolutions per minute, per second.
fn acceleration_unit(code: i64, counts_per_turn: f64) -> f64 {
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
    fn units_by_code() {
        let rpm = 2000.0 / 60.0;
        assert_eq!(velocity_unit(0x00b4_4700, 2000.0), rpm);
        assert!((velocity_unit(0xfdb4_4700, 2000.0) - rpm * 1e-3).abs() < 1e-12);
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
