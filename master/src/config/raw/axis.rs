//! `[device.axis]` as written.

use toml::Spanned;

use super::super::fields::{self, Fields};
use super::super::problem::{Problems, Span};

#[derive(Debug)]
pub(crate) struct RawAxis {
    pub span: Span,
    pub unit: Option<Spanned<String>>,
    pub per_turn: Option<Spanned<f64>>,
    /// Motor turns and the resulting turns of the output shaft.
    pub gear: Option<Spanned<[u32; 2]>>,
    /// User units per turn of the output shaft.
    pub feed: Option<Spanned<f64>>,
    /// `true` if `per_turn` or `feed` is present, valid or not.
    pub scaled: bool,
    pub modulo: Option<Spanned<f64>>,
    pub way: Option<Spanned<String>>,
    pub encoder: Option<Spanned<f64>>,
    pub invert: Option<Spanned<bool>>,
    pub offset: Option<Spanned<f64>>,
    pub target_window: Option<Spanned<f64>>,
    pub velocity_unit: Option<Spanned<String>>,
    pub torque_unit: Option<Spanned<String>>,
    pub torque_constant: Option<Spanned<f64>>,
    pub rated_torque: Option<Spanned<f64>>,
    pub limits: RawLimits,
    pub dead_time: Option<Spanned<u64>>,
    pub stop_timeout: Option<Spanned<u64>>,
    pub follows_bit: Option<Spanned<bool>>,
    pub loops: RawLoops,
    pub brake: RawBrake,
    pub fault_reset: RawFaultReset,
    pub supervise: RawSupervision,
    pub on_trip: Option<Spanned<String>>,
    pub on_emergency: Option<Spanned<String>>,
    pub homing: Option<RawHoming>,
}

#[derive(Debug, Default)]
pub(crate) struct RawBrake {
    /// The output, for example `io.Output 3`.
    pub output: Option<Spanned<String>>,
    pub release: Option<Spanned<u64>>,
    pub engage: Option<Spanned<u64>>,
}

#[derive(Debug, Default)]
pub(crate) struct RawFaultReset {
    pub tries: Option<Spanned<u8>>,
    pub delay: Option<Spanned<u64>>,
}

#[derive(Debug, Default)]
pub(crate) struct RawSupervision {
    pub torque: Option<Spanned<f64>>,
    pub torque_time: Option<Spanned<u64>>,
    pub acceleration: Option<Spanned<f64>>,
    pub standstill: Option<Spanned<f64>>,
    pub standstill_time: Option<Spanned<u64>>,
    pub target_time: Option<Spanned<u64>>,
}

#[derive(Debug)]
pub(crate) struct RawHoming {
    pub span: Span,
    pub method: Option<Spanned<i8>>,
    pub search: Option<Spanned<f64>>,
    pub zero: Option<Spanned<f64>>,
    pub acceleration: Option<Spanned<f64>>,
    pub distance: Option<Spanned<f64>>,
    pub position: Option<Spanned<f64>>,
    pub threshold: Option<Spanned<u16>>,
    pub timeout: Option<Spanned<u64>>,
}

#[derive(Debug, Default)]
pub(crate) struct RawLimits {
    pub span: Span,
    pub position: Option<Spanned<[f64; 2]>>,
    pub velocity: Option<Spanned<f64>>,
    pub acceleration: Option<Spanned<f64>>,
    pub jerk: Option<Spanned<f64>>,
    pub torque: Option<Spanned<f64>>,
    pub following_error: Option<Spanned<f64>>,
}

/// The control loops of an axis for each mode.
#[derive(Debug, Default)]
pub(crate) struct RawLoops {
    /// CSP: written to 0x60B1 and 0x60B2.
    pub velocity_offset: Option<Spanned<f64>>,
    pub torque_offset: Option<Spanned<f64>>,
    pub csv: Option<RawVelocityLoop>,
    pub cst: Option<RawPid>,
}

#[derive(Debug)]
pub(crate) struct RawVelocityLoop {
    pub kv: Option<Spanned<f64>>,
    pub feed_forward: Option<Spanned<f64>>,
}

#[derive(Debug)]
pub(crate) struct RawPid {
    pub span: Span,
    pub kp: Option<Spanned<f64>>,
    pub tn: Option<Spanned<u64>>,
    pub tv: Option<Spanned<u64>>,
    pub acceleration: Option<Spanned<f64>>,
}

pub(super) fn read(mut f: Fields<'_>, span: Span, p: &mut Problems<'_>) -> RawAxis {
    let encoder = f.need("encoder", "encoder = 2000");
    let limits = f.need(
        "limits",
        "limits = { velocity = 200.0, acceleration = 2000.0 }",
    );
    let mut axis = RawAxis {
        span: span.clone(),
        unit: optional!(p, f, "unit", string),
        per_turn: optional!(p, f, "per_turn", number),
        gear: f.get("gear").and_then(|v| gear(v, p)),
        feed: optional!(p, f, "feed", number),
        scaled: f.has("per_turn") || f.has("feed"),
        modulo: optional!(p, f, "modulo", number),
        way: optional!(p, f, "way", string),
        encoder: encoder.and_then(|v| fields::number(p, v)),
        invert: optional!(p, f, "invert", boolean),
        offset: optional!(p, f, "offset", number),
        target_window: optional!(p, f, "target_window", number),
        velocity_unit: optional!(p, f, "velocity_unit", string),
        torque_unit: optional!(p, f, "torque_unit", string),
        torque_constant: optional!(p, f, "torque_constant", number),
        rated_torque: optional!(p, f, "rated_torque", number),
        limits: RawLimits::default(),
        dead_time: optional!(p, f, "dead_time", duration),
        stop_timeout: optional!(p, f, "stop_timeout", duration),
        follows_bit: optional!(p, f, "follows_bit", boolean),
        loops: RawLoops::default(),
        brake: RawBrake::default(),
        fault_reset: RawFaultReset::default(),
        supervise: RawSupervision::default(),
        on_trip: optional!(p, f, "on_trip", string),
        on_emergency: optional!(p, f, "on_emergency", string),
        homing: None,
    };
    if let Some(value) = limits
        && let Some(mut f) = fields::table(p, value, "`limits`")
    {
        let position = f.get("position").and_then(|v| {
            let ends = fields::array(p, v, "a list of two positions")?;
            let [low, high] = ends.as_slice() else {
                p.add_hint(
                    v.span(),
                    "a range has two ends",
                    "write `position = [-50.0, 50.0]`",
                );
                return None;
            };
            let range = [fields::number(p, low), fields::number(p, high)];
            let [Some(low), Some(high)] = range else {
                return None;
            };
            Some(Spanned::new(
                v.span(),
                [low.into_inner(), high.into_inner()],
            ))
        });
        let velocity = f.need("velocity", "velocity = 200.0");
        let acceleration = f.need("acceleration", "acceleration = 2000.0");
        axis.limits = RawLimits {
            span: value.span(),
            position,
            velocity: velocity.and_then(|v| fields::number(p, v)),
            acceleration: acceleration.and_then(|v| fields::number(p, v)),
            jerk: optional!(p, f, "jerk", number),
            torque: optional!(p, f, "torque", number),
            following_error: optional!(p, f, "following_error", number),
        };
        f.done(p);
    }
    axis.loops = loops(&mut f, p);
    guards(&mut f, &mut axis, p);
    axis.homing = f.get("homing").and_then(|v| homing(v, p));
    f.done(p);
    axis
}

fn gear(value: super::Value<'_>, p: &mut Problems<'_>) -> Option<Spanned<[u32; 2]>> {
    let turns = fields::array(p, value, "motor turns and shaft turns, `[3, 1]`")?;
    let [motor, shaft] = turns.as_slice() else {
        let hint = "write motor turns and the turns of the shaft that they make: `gear = [3, 1]`";
        p.add_hint(value.span(), "a gear ratio has two numbers", hint);
        return None;
    };
    let motor = fields::integer(p, motor, 1, u32::MAX);
    let shaft = fields::integer(p, shaft, 1, u32::MAX);
    let turns = [motor?.into_inner(), shaft?.into_inner()];
    Some(Spanned::new(value.span(), turns))
}

fn guards(f: &mut Fields<'_>, axis: &mut RawAxis, p: &mut Problems<'_>) {
    if let Some(value) = f.get("brake")
        && let Some(mut f) = fields::table(p, value, "`brake`")
    {
        axis.brake = RawBrake {
            output: optional!(p, f, "output", string),
            release: optional!(p, f, "release", duration),
            engage: optional!(p, f, "engage", duration),
        };
        f.done(p);
    }
    if let Some(value) = f.get("fault_reset")
        && let Some(mut f) = fields::table(p, value, "`fault_reset`")
    {
        let tries = f.need("tries", "tries = 3");
        axis.fault_reset = RawFaultReset {
            tries: tries.and_then(|v| fields::integer(p, v, 1, 100)),
            delay: optional!(p, f, "delay", duration),
        };
        f.done(p);
    }
    if let Some(value) = f.get("supervise")
        && let Some(mut f) = fields::table(p, value, "`supervise`")
    {
        axis.supervise = RawSupervision {
            torque: optional!(p, f, "torque", number),
            torque_time: optional!(p, f, "torque_time", duration),
            acceleration: optional!(p, f, "acceleration", number),
            standstill: optional!(p, f, "standstill", number),
            standstill_time: optional!(p, f, "standstill_time", duration),
            target_time: optional!(p, f, "target_time", duration),
        };
        f.done(p);
    }
}

fn homing(value: super::Value<'_>, p: &mut Problems<'_>) -> Option<RawHoming> {
    let mut f = fields::table(p, value, "`homing`")?;
    let method = f.need("method", "method = 37");
    let homing = RawHoming {
        span: value.span(),
        method: method.and_then(|v| fields::integer(p, v, i8::MIN, i8::MAX)),
        search: optional!(p, f, "search", number),
        zero: optional!(p, f, "zero", number),
        acceleration: optional!(p, f, "acceleration", number),
        distance: optional!(p, f, "distance", number),
        position: optional!(p, f, "position", number),
        threshold: optional!(p, f, "threshold", integer(1, u16::MAX)),
        timeout: optional!(p, f, "timeout", duration),
    };
    f.done(p);
    Some(homing)
}

fn loops(f: &mut Fields<'_>, p: &mut Problems<'_>) -> RawLoops {
    let mut loops = RawLoops::default();
    if let Some(value) = f.get("csp")
        && let Some(mut f) = fields::table(p, value, "`csp`")
    {
        loops.velocity_offset = optional!(p, f, "velocity_offset", number);
        loops.torque_offset = optional!(p, f, "torque_offset", number);
        f.done(p);
    }
    if let Some(value) = f.get("csv")
        && let Some(mut f) = fields::table(p, value, "`csv`")
    {
        let kv = f.need("kv", "kv = 20.0");
        loops.csv = Some(RawVelocityLoop {
            kv: kv.and_then(|v| fields::number(p, v)),
            feed_forward: optional!(p, f, "feed_forward", number),
        });
        f.done(p);
    }
    if let Some(value) = f.get("cst")
        && let Some(mut f) = fields::table(p, value, "`cst`")
    {
        let kp = f.need("kp", "kp = 10.0");
        loops.cst = Some(RawPid {
            span: value.span(),
            kp: kp.and_then(|v| fields::number(p, v)),
            tn: optional!(p, f, "tn", duration),
            tv: optional!(p, f, "tv", duration),
            acceleration: optional!(p, f, "acceleration", number),
        });
        f.done(p);
    }
    loops
}
