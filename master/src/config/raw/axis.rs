//! `[device.axis]` as written.

use ecaxis_axis::scale::ModuloDirection;
use ecaxis_axis::{StopMethod, VelocityUnit};
use toml::de::DeValue;

use super::super::TorqueUnit;
use super::super::fields::{Domain, Field, Key, Ns, Read, Table, TableKey, Value, Written, array};
use super::super::problem::{Problems, Span};
use super::{STOP_METHODS, STOPS_BY_DRIVE, Spanned};

const WAYS: [(&str, ModuloDirection); 3] = [
    ("shortest", ModuloDirection::Shortest),
    ("positive", ModuloDirection::Positive),
    ("negative", ModuloDirection::Negative),
];

const VELOCITY_UNITS: [(&str, VelocityUnit); 4] = [
    ("rpm", VelocityUnit::RPM),
    ("mrpm", VelocityUnit::MILLI_RPM),
    ("counts/s", VelocityUnit::COUNTS_PER_SECOND),
    ("turns/s", VelocityUnit::TURNS_PER_SECOND),
];

const TORQUE_UNITS: [(&str, TorqueUnit); 3] = [
    ("percent", TorqueUnit::Percent),
    ("Nm", TorqueUnit::NewtonMetres),
    ("A", TorqueUnit::Amperes),
];

table! { "[device.axis]",
    table RawAxis {
        name: Key<String>,
        /// The number of the axis in its drive, from 1.
        number: Key<u16> [1..=ecaxis_esi::axis::MAX_AXES],
        unit: Key<String>,
        per_turn: Key<f64>,
        /// Motor turns and the resulting turns of the output shaft.
        gear: Key<[u32; 2]>,
        /// User units per turn of the output shaft.
        feed: Key<f64>,
        modulo: Key<f64>,
        way: Key<ModuloDirection> [WAYS],
        encoder: Key<f64> = "2000",
        invert: Key<bool>,
        offset: Key<f64>,
        target_window: Key<f64>,
        velocity_unit: Key<VelocityUnit> [VELOCITY_UNITS],
        torque_unit: Key<TorqueUnit> [TORQUE_UNITS],
        torque_constant: Key<f64>,
        rated_torque: Key<f64>,
        limits: RawLimits = "{ velocity = 200.0, acceleration = 2000.0 }",
        dead_time: Key<Ns>,
        stop_timeout: Key<Ns>,
        follows_bit: Key<bool>,
        csp: RawOffsets,
        csv: Option<RawVelocityLoop>,
        cst: Option<RawPid>,
        brake: RawBrake,
        fault_reset: RawFaultReset,
        supervise: RawSupervision,
        on_trip: Key<StopMethod> [STOP_METHODS],
        on_emergency: Key<StopMethod> [STOPS_BY_DRIVE],
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

table! { "`limits`",
    table RawLimits {
        position: Key<[f64; 2]>,
        velocity: Key<f64> = "200.0",
        acceleration: Key<f64> = "2000.0",
        jerk: Key<f64>,
        torque: Key<f64>,
        following_error: Key<f64>,
    }
}

table! { "`csp`",
    /// Written to 0x60B1 and 0x60B2.
    table RawOffsets {
        velocity_offset: Key<f64>,
        torque_offset: Key<f64>,
    }
}

table! { "`csv`",
    table RawVelocityLoop {
        kv: Key<f64> = "20.0",
        feed_forward: Key<f64>,
    }
}

table! { "`cst`",
    table RawPid {
        kp: Key<f64> = "10.0",
        tn: Key<Ns>,
        tv: Key<Ns>,
        acceleration: Key<f64>,
    }
}

table! { "`brake`",
    table RawBrake {
        /// The output, for example `io.Output 3`.
        output: Key<String>,
        release: Key<Ns>,
        engage: Key<Ns>,
    }
}

table! { "`fault_reset`",
    table RawFaultReset {
        tries: Key<u8> [1..=100] = "3",
        delay: Key<Ns>,
    }
}

table! { "`supervise`",
    table RawSupervision {
        torque: Key<f64>,
        torque_time: Key<Ns>,
        acceleration: Key<f64>,
        standstill: Key<f64>,
        standstill_time: Key<Ns>,
        target_time: Key<Ns>,
    }
}

table! { "`homing`",
    table RawHoming {
        method: Key<i8> = "37",
        search: Key<f64>,
        zero: Key<f64>,
        acceleration: Key<f64>,
        distance: Key<f64>,
        position: Key<f64>,
        threshold: Key<u16> [1..=u16::MAX],
        timeout: Key<Ns>,
    }
}
