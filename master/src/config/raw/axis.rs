//! `[device.axis]` as written.

use ecaxis_axis::compensation::ReferenceFlank;
use ecaxis_axis::scale::ModuloDirection;
use ecaxis_axis::{StopMethod, VelocityUnit};
use toml::de::DeValue;

use super::super::TorqueUnit;
use super::super::fields::{Domain, Field, Key, Ns, Read, Table, TableKey, Value, Written, array};
use super::super::problem::{Problems, Span};
use super::super::schema::{self, Schema};
use super::{STOP_METHODS, STOPS_BY_DRIVE, Spanned};

const WAYS: [(&str, ModuloDirection); 3] = [
    ("shortest", ModuloDirection::Shortest),
    ("positive", ModuloDirection::Positive),
    ("negative", ModuloDirection::Negative),
];

const TORQUE_UNITS: [(&str, TorqueUnit); 3] = [
    ("percent", TorqueUnit::Percent),
    ("Nm", TorqueUnit::NewtonMetres),
    ("A", TorqueUnit::Amperes),
];

/// True: in Operation enabled only.
const MODE_DISPLAYS: [(&str, bool); 2] = [("always", false), ("enabled", true)];

/// True: without power only.
const MODE_CHANGES: [(&str, bool); 2] = [("always", false), ("no-power", true)];

table! { "[device.axis]",
    table RawAxis {
        /// Unique name; required if the drive has several axes here (text; default that of the
        /// device)
        name: Key<String>,
        /// Axis of the drive (1 to 8; default by order)
        number: Key<u16> [1..=ecaxis_esi::axis::MAX_AXES],
        /// Position unit: mm, deg, turn, …; your own as `"custom:slots"` (text; default `"turn"`)
        unit: Key<String>,
        /// Units per motor turn, gear included; or the next two (above 0; default 1.0)
        per_turn: Key<f64>,
        /// Gear ratio, whole numbers (as 0x6091) ([motor turns, shaft turns]; default [1, 1])
        gear: Key<[u32; 2]>,
        /// Units per turn of the shaft behind the gear (above 0; default 1.0)
        feed: Key<f64>,
        /// Period after which positions repeat; not with `limits.position` (above 0, unit; default
        /// none: linear axis)
        modulo: Key<f64>,
        /// Direction in which a modulo axis moves (`"shortest"`, `"positive"`, `"negative"`;
        /// default `"shortest"`)
        way: Key<ModuloDirection> [WAYS],
        /// Counts per motor turn, four per line of an incremental encoder (1 to 2^31)
        encoder: Key<f64> = "2000",
        /// The positive direction is the drive's negative direction (true, false; default false)
        invert: Key<bool>,
        /// Position at count 0 (number, unit; default 0)
        offset: Key<f64>,
        /// Distance within which a move is in target (unit; default a tenth of the following error,
        /// or ten counts)
        target_window: Key<f64>,
        /// Unit of the drive's velocities, with a power of ten if needed (`"rpm"`, `"0.1rpm"`,
        /// `"mrpm"`, `"counts/s"`, `"turns/s"`, …; default what 0x60A9 says)
        velocity_unit: Key<VelocityUnit>,
        /// Unit of torques in limits, supervision and steps (`"percent"`, `"Nm"`, `"A"`; default
        /// `"percent"`)
        torque_unit: Key<TorqueUnit> [TORQUE_UNITS],
        /// Other drives need it for `torque_unit = "A"` (above 0, Nm/A; default what maxon's
        /// 0x3001:05 says)
        torque_constant: Key<f64>,
        /// Rated torque of the motor (above 0, Nm; default what 0x6076 says)
        rated_torque: Key<f64>,
        /// Writes `limits.torque` to the drive (0x6072, or 0x60E0 and 0x60E1), for all modes (`true`,
        /// `false`; default `false`)
        torque_limit_in_drive: Key<bool>,
        /// Commanded values never exceed these limits
        limits: RawLimits = "{ velocity = 200.0, acceleration = 2000.0 }",
        /// From a set-point to the first report that can show it (time, up to 100 ms; default 0)
        dead_time: Key<Ns>,
        /// Time after which a stop becomes harder (time above 0; default see below)
        stop_timeout: Key<Ns>,
        /// The drive serves Statusword bit 12 in CSP, CSV and CST (`true`, `false`; default `true`)
        follows_bit: Key<bool>,
        /// When 0x6061 shows the commanded mode (`"always"`, `"enabled"`; default `"always"`)
        mode_display: Key<bool> [MODE_DISPLAYS],
        /// When the drive changes its mode (`"always"`, `"no-power"`; default `"always"`)
        mode_change: Key<bool> [MODE_CHANGES],
        /// Time within which 0x6061 must show the commanded mode (time above 0; default `"1s"`)
        mode_time: Key<Ns>,
        /// What accompanies the target in CSP
        csp: RawOffsets,
        /// Position loop over the drive's velocity
        csv: Option<RawVelocityLoop>,
        /// Position loop over the drive's torque
        cst: Option<RawPid>,
        /// Times of the holding brake, and its output
        brake: RawBrake,
        /// Automatic reset of faults
        fault_reset: RawFaultReset,
        /// Supervision of reported torque, acceleration and standstill
        supervise: RawSupervision,
        /// Reaction to a trip (`"quick-stop"`, `"ramp"`, `"no-power"`; default `"quick-stop"`)
        on_trip: Key<StopMethod> [STOP_METHODS],
        /// Reaction to an emergency stop (`"quick-stop"`, `"no-power"`; default `"quick-stop"`)
        on_emergency: Key<StopMethod> [STOPS_BY_DRIVE],
        /// The drive keeps home without power: absolute encoder (`true`, `false`; default `false`)
        absolute: Key<bool>,
        /// Backlash and pitch error between drive and load
        compensation: Option<RawCompensation>,
        /// Encoder at the load that is compared with the axis
        second_encoder: Option<RawSecondEncoder>,
        /// Homing by the drive; 0x6060 and 0x6061 must be mapped
        homing: Option<RawHoming>,
    }
}

/// `[device.axis]`, or `[[device.axis]]` for each axis of a drive.
#[derive(Debug, Default)]
pub(crate) struct AxisTables(pub Vec<RawAxis>);

impl Field for AxisTables {
    type Value = Self;

    fn of(value: Option<Self>) -> Option<Self> {
        Some(value.unwrap_or_default())
    }
}

impl Read for AxisTables {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let axes = match value.get_ref() {
            DeValue::Array(axes) => axes.iter().collect(),
            _ => vec![value],
        };
        let read = axes.into_iter().map(|axis| RawAxis::read(axis, key, p));
        Some(Self(read.collect::<Option<_>>()?))
    }
}

impl Schema for AxisTables {
    fn schema() -> serde_json::Value {
        let axis = schema::definition("axis");
        let several = serde_json::json!({ "type": "array", "items": axis });
        schema::any_of([axis, several])
    }
}

impl Read for [u32; 2] {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let turns = array(p, value, "motor turns and shaft turns, `[3, 1]`")?;
        let [motor, shaft] = turns.as_slice() else {
            let hint =
                "write motor turns and the turns of the shaft that they make: `gear = [3, 1]`";
            p.add_hint(value.span(), "a gear ratio has two numbers", hint);
            return None;
        };
        let [motor, shaft] = [motor, shaft].map(|v| Domain::read(&(1..=u32::MAX), v, key, p));
        Some([motor?, shaft?])
    }
}

impl Read for VelocityUnit {
    fn read(value: Value<'_>, key: &str, p: &mut Problems<'_>) -> Option<Self> {
        let text = String::read(value, key, p)?;
        let unit = text.parse();
        if unit.is_err() {
            let message = format!("`{key}` cannot be \"{text}\"");
            let hint = "there are `rpm`, `mrpm`, `counts/s`, `turns/s`, and powers of ten of them, \
                        such as `0.1rpm` or `10^-5 turns/s`";
            p.add_hint(value.span(), message, hint);
        }
        unit.ok()
    }
}

impl Schema for VelocityUnit {
    fn schema() -> serde_json::Value {
        let factor = r"(10\^-?[0-9]|1(0{1,9})?|0\.0{0,8}1)?";
        let pattern = format!("^(mrpm|{factor} *(rpm|counts/s|turns/s))$");
        serde_json::json!({ "type": "string", "pattern": pattern })
    }
}

table! { "`limits`",
    table RawLimits {
        /// Range ([low, high], unit; default endless)
        position: Key<[f64; 2]>,
        /// (above 0, unit/s)
        velocity: Key<f64> = "200.0",
        /// Also applies to stops; a stop may last an hour at most (above 0, unit/s²)
        acceleration: Key<f64> = "2000.0",
        /// Bounds lines, waves and paths; if written, also moves and velocities (above 0, unit/s³; default full acceleration in 50 ms)
        jerk: Key<f64>,
        /// (above 0, `torque_unit`; default rated torque)
        torque: Key<f64>,
        /// Set-point minus reported position, after the dead time (above 0, unit; default not
        /// supervised)
        following_error: Key<f64>,
    }
}

const FLANKS: [(&str, ReferenceFlank); 2] = [
    ("positive", ReferenceFlank::Positive),
    ("negative", ReferenceFlank::Negative),
];

table! { "`compensation`",
    #[derive(Clone)]
    table RawCompensation {
        /// Way of the drive between both flanks (above 0, unit; default none)
        backlash: Key<f64>,
        /// Direction of the last motion of homing; required with `backlash` (`"positive"`, `"negative"`)
        homing_ends: Key<ReferenceFlank> [FLANKS],
        /// Pitch error, load minus drive, at positions of the load (list of [position, error], unit;
        /// default this, `file`, or none)
        errors: Key<Vec<Vec<f64>>>,
        /// CSV file with the same columns (path)
        file: Key<String>,
    }
}

table! { "`second_encoder`",
    #[derive(Clone)]
    table RawSecondEncoder {
        /// Input of 32 bits with its counts (device.input, text)
        input: Key<String> = "\"x.0x60E4:01\"",
        /// Counts per unit of the axis; negative if it counts the other way (not 0, 1/unit)
        counts_per_unit: Key<f64> = "1000.0",
        /// Largest difference from the position of the axis, which trips beyond (above 0, unit)
        max_difference: Key<f64> = "0.2",
        /// Position of the axis at count 0 (unit; default the difference is 0 when home is found)
        offset: Key<f64>,
    }
}

table! { "`csp`",
    /// Written to 0x60B1 and 0x60B2.
    table RawOffsets {
        /// Share of the velocity that is written to 0x60B1, which must be mapped (0 to 1; default
        /// 0)
        velocity_offset: Key<f64>,
        /// Torque per acceleration, written to 0x60B2, which must be mapped (% per unit/s²; default
        /// 0)
        torque_offset: Key<f64>,
    }
}

table! { "`csv`",
    table RawVelocityLoop {
        /// Gain of the position loop over the drive's velocity (above 0, 1/s; default no position
        /// loop)
        kv: Key<f64> = "20.0",
        /// Share of the velocity that is fed forward (0 to 1; default 1)
        feed_forward: Key<f64>,
    }
}

table! { "`cst`",
    table RawPid {
        /// Gain of the position loop over the drive's torque (above 0, % per unit; default no
        /// position loop)
        kp: Key<f64> = "10.0",
        /// Integral action time (time; default no integral part)
        tn: Key<Ns>,
        /// Derivative action time (time; default 0)
        tv: Key<Ns>,
        /// Torque per acceleration (% per unit/s²; default 0)
        acceleration: Key<f64>,
    }
}

table! { "`brake`",
    table RawBrake {
        /// One-bit output that opens the brake (device.output, text; default the drive switches its
        /// brake)
        output: Key<String>,
        /// From Operation enabled to the first motion (time; default 0)
        release: Key<Ns>,
        /// From standstill to the loss of power (time; default 0)
        engage: Key<Ns>,
    }
}

table! { "`fault_reset`",
    table RawFaultReset {
        /// Number of automatic fault resets (1 to 100; default no automatic reset)
        tries: Key<u8> [1..=100] = "3",
        /// From the fault to the reset (time; default `"1s"`)
        delay: Key<Ns>,
    }
}

table! { "`supervise`",
    table RawSupervision {
        /// Reported torque that must not last (above 0, `torque_unit`; default not supervised)
        torque: Key<f64>,
        /// Time for which the torque may exceed it (time; default `"100ms"`)
        torque_time: Key<Ns>,
        /// Reported acceleration, filtered (above 0, unit/s²; default not supervised)
        acceleration: Key<f64>,
        /// The axis is at standstill below this velocity (above 0, unit/s; default 1 % of the
        /// velocity limit)
        standstill: Key<f64>,
        /// Time for which the velocity must be below it (time; default 0)
        standstill_time: Key<Ns>,
        /// Time that the axis must be within `target_window` (time; default 0)
        target_time: Key<Ns>,
    }
}

table! { "`homing`",
    table RawHoming {
        /// 0x6098: CiA 402 methods or the vendor's negative ones; the error for a wrong one lists all
        /// (number)
        method: Key<i8> = "37",
        /// Velocity to the switch or mechanical end (0x6099:01) (above 0, unit/s; default the
        /// drive's)
        search: Key<f64>,
        /// Velocity off the switch and to the index (0x6099:02) (above 0, unit/s; default the
        /// drive's)
        zero: Key<f64>,
        /// 0x609A (above 0, unit/s²; default the drive's)
        acceleration: Key<f64>,
        /// Further travel from the position found (maxon's 0x30B1) (unit; default the drive's)
        distance: Key<f64>,
        /// Position value there (maxon's 0x30B0, others' 0x607C) (unit; default the drive's)
        position: Key<f64>,
        /// Current that detects a mechanical end (maxon's 0x30B2); needed by such methods (1 to
        /// 65535 mA)
        threshold: Key<u16> [1..=u16::MAX],
        /// Of the whole search (time; default `"1min"`)
        timeout: Key<Ns>,
    }
}
