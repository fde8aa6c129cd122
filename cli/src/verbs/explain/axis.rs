//! An axis in `ecaxis explain`: units and their origin, limits, loops, supervision, homing.

use ecaxis_axis::Mode;
use ecaxis_axis::StopMethod;
use ecaxis_axis::scale::ModuloDirection;
use ecaxis_axis::supervision::FaultReset;
use ecaxis_master::config::{
    AxisSetup, HomingSetup, TorqueLimit, TorqueUnit, UnitSource, duration,
};
use ecaxis_tools::cells;
use ecaxis_tools::document::Table;

pub(super) fn axis(axis: &AxisSetup) -> Table {
    let mut table = Table::new("axis|value|from");
    units(axis, &mut table);
    limits(axis, &mut table);
    loops(axis, &mut table);
    guards(axis, &mut table);
    if let Some(homing) = &axis.homing {
        self::homing(homing, &axis.unit, &mut table);
    }
    table
}

/// Rounds to six significant digits.
fn rounded(x: f64) -> f64 {
    format!("{x:.5e}").parse().unwrap_or(x)
}

fn time(seconds: f64) -> String {
    duration::show((seconds * 1e9).round() as u64)
}

fn from(from: UnitSource, key: &'static str, object: &str) -> String {
    match from {
        UnitSource::File => format!("`{key}`; the drive is asked"),
        UnitSource::Sdo => format!("{object} from `sdo`"),
        UnitSource::Esi => format!("{object} in the ESI, until the drive is asked"),
        UnitSource::Drive => format!("{object} in the drive"),
        UnitSource::Nothing => format!("assumed, until the drive is asked for {object}"),
    }
}

fn units(axis: &AxisSetup, table: &mut Table) {
    let (scale, unit) = (&axis.config.scale, &axis.unit);
    let counts = format!("{} counts a motor turn", scale.counts_per_turn());
    table.row(cells!["encoder", counts, "`encoder`, held against 0x608F"]);
    let way = format!("{} {unit} a motor turn", rounded(scale.units_per_turn()));
    table.row(cells!["per turn", way, "`per_turn`, or `feed` and `gear`"]);
    let counts = format!("1 {unit} = {} counts", rounded(scale.counts_per_unit()));
    table.row(cells!["position", counts, "encoder and way per turn"]);
    if scale.inverted() {
        table.row(cells!["direction", "inverted", "`invert`"]);
    }
    if scale.offset() != 0.0 {
        let offset = format!("{} {unit} at count 0", scale.offset());
        table.row(cells!["offset", offset, "`offset`"]);
    }
    if let Some(length) = scale.modulo() {
        let way = match axis.way {
            ModuloDirection::Positive => "always forwards",
            ModuloDirection::Negative => "always backwards",
            _ => "the shorter way",
        };
        table.row(cells![
            "modulo",
            format!("{length} {unit}, {way}"),
            "`modulo`, `way`"
        ]);
    }
    let velocity = format!(
        "in {}, steps of {} {unit}/s",
        scale.velocity_unit(),
        rounded(scale.velocity_resolution())
    );
    let origin = from(axis.velocity_unit_from, "velocity_unit", "0x60A9");
    table.row(cells!["velocity", velocity, origin]);
    let origin = match axis.acceleration_unit_from {
        UnitSource::Nothing => "that of the velocity, until the drive is asked".to_owned(),
        known => from(known, "acceleration_unit", "0x60AA"),
    };
    let acceleration = format!("in {}", scale.acceleration_unit());
    table.row(cells!["acceleration", acceleration, origin]);
    let torque = &axis.torque;
    let shown = match torque.unit {
        TorqueUnit::Percent => "in % of rated torque".to_owned(),
        unit => format!("in {unit}"),
    };
    table.row(cells!["torque", shown, "`torque_unit`"]);
    if torque.unit != TorqueUnit::Percent {
        let rated = torque
            .rated
            .map_or("not known yet".to_owned(), |n| format!("{} Nm", rounded(n)));
        let origin = from(torque.rated_from, "rated_torque", "0x6076");
        table.row(cells!["rated torque", rated, origin]);
        let constant = torque.constant.map(|n| format!("{n} Nm/A"));
        if let Some(constant) = constant {
            table.row(cells!["torque constant", constant, "`torque_constant`"]);
        } else if torque.unit == TorqueUnit::Amperes {
            let origin = "0x3001:05, the drive is asked";
            table.row(cells!["torque constant", "not known yet", origin]);
        }
    }
}

fn limits(axis: &AxisSetup, table: &mut Table) {
    let (config, unit) = (&axis.config, &axis.unit);
    let limits = &config.limits;
    let position = match limits.position {
        Some([low, high]) => format!("{low} to {high} {unit}"),
        None => "endless".to_owned(),
    };
    table.row(cells!["limits", position, "`limits.position`"]);
    // Those of the file are the drive's; a correction takes its share.
    let drive = axis.compensation.drive_limits(limits);
    let show = |load: f64, drive: f64, from: &str| {
        let load_text = rounded(load).to_string();
        match load == drive {
            true => (load_text, from.to_owned()),
            false => (
                format!("{load_text} of {}", rounded(drive)),
                format!("{from}, `compensation`"),
            ),
        }
    };
    let rpm = rounded(limits.velocity / config.scale.units_per_turn() * 60.0);
    let (velocity, origin) = show(limits.velocity, drive.velocity, "`limits.velocity`");
    let velocity = format!("{velocity} {unit}/s ({rpm} rpm)");
    table.row(cells!["", velocity, origin]);
    let key = "`limits.acceleration`";
    let (acceleration, origin) = show(limits.acceleration, drive.acceleration, key);
    table.row(cells!["", format!("{acceleration} {unit}/s²"), origin]);
    let key = match drive.jerk {
        Some(_) => "`limits.jerk`",
        None => "default: full acceleration in 50 ms",
    };
    let (jerk, origin) = show(limits.jerk(), drive.jerk(), key);
    table.row(cells!["", format!("{jerk} {unit}/s³"), origin]);
    let torque = rounded(axis.torque.shown(limits.torque));
    let percent = match axis.torque.unit {
        TorqueUnit::Percent => " of rated torque".to_owned(),
        _ if axis.torque.rated.is_none() => String::new(),
        _ => format!(" ({} % of rated)", rounded(limits.torque)),
    };
    let torque = format!("{torque} {}{percent}", axis.torque.unit);
    let origin = match &axis.torque_limit {
        TorqueLimit::NotNeeded => "`limits.torque`, or rated torque".to_owned(),
        TorqueLimit::Written(startup) => {
            let objects = startup.iter().map(|sdo| format!("0x{:04X}", sdo.index));
            let objects: Vec<_> = objects.collect();
            format!("`limits.torque`, written to {}", objects.join(" and "))
        }
        TorqueLimit::NotEffective { .. } => "`limits.torque`, in CST only".to_owned(),
    };
    table.row(cells!["", torque, origin]);
    let following = match limits.following_error {
        Some(error) => format!("following error {error} {unit}"),
        None => "following error not supervised".to_owned(),
    };
    table.row(cells!["", following, "`limits.following_error`"]);
}

fn loops(axis: &AxisSetup, table: &mut Table) {
    let (config, unit) = (&axis.config, &axis.unit);
    let modes = [
        Mode::Csp,
        Mode::Csv,
        Mode::Cst,
        Mode::Pp,
        Mode::Pv,
        Mode::Hm,
    ];
    let modes = modes
        .into_iter()
        .filter(|mode| config.modes.contains(*mode));
    let modes: Vec<String> = modes.map(|mode| mode.to_string()).collect();
    table.row(cells![
        "modes",
        modes.join(", "),
        "targets in the process data"
    ]);
    let csp = config.loops.csp;
    if csp.velocity != 0.0 || csp.acceleration != 0.0 {
        let offsets = format!(
            "{} of the velocity to 0x60B1, {} % per {unit}/s² to 0x60B2",
            csp.velocity, csp.acceleration
        );
        table.row(cells!["CSP", offsets, "`csp`"]);
    }
    if let Some(csv) = config.loops.csv {
        let gains = format!("Kv {} 1/s, feed-forward {}", csv.kv, csv.feed_forward);
        table.row(cells!["CSV", gains, "`csv`"]);
    }
    if let Some(cst) = config.loops.cst {
        let tn = cst.tn_s.map_or("none".to_owned(), time);
        let gains = format!("Kp {} % per {unit}, Tn {tn}, Tv {}", cst.kp, time(cst.tv_s));
        table.row(cells!["CST", gains, "`cst`"]);
        if cst.acceleration != 0.0 {
            let gain = format!("{} % per {unit}/s²", cst.acceleration);
            table.row(cells!["", gain, "`cst.acceleration`"]);
        }
    }
    let origin = match config.dead_time_s {
        0.0 => "default",
        _ => "`dead_time`",
    };
    table.row(cells!["dead time", time(config.dead_time_s), origin]);
}

fn guards(axis: &AxisSetup, table: &mut Table) {
    let (config, unit) = (&axis.config, &axis.unit);
    let watch = &config.supervision;
    let window = format!(
        "{} {unit} for {}",
        rounded(config.target_window),
        time(watch.target_dwell_s)
    );
    table.row(cells![
        "in target",
        window,
        "`target_window`, `supervise.target_time`"
    ]);
    let standstill = watch
        .standstill
        .map_or("1 % of the velocity limit".to_owned(), |v| {
            format!("{v} {unit}/s")
        });
    let standstill = format!("{standstill} for {}", time(watch.standstill_dwell_s));
    table.row(cells![
        "standstill",
        standstill,
        "`supervise.standstill`, `.standstill_time`"
    ]);
    if let Some(torque) = watch.torque {
        let shown = rounded(axis.torque.shown(torque.percent));
        let torque = format!(
            "above {shown} {} for {}",
            axis.torque.unit,
            time(torque.time_s)
        );
        table.row(cells![
            "over torque",
            torque,
            "`supervise.torque`, `.torque_time`"
        ]);
    }
    if let Some(acceleration) = watch.acceleration {
        let acceleration = format!("above {acceleration} {unit}/s²");
        table.row(cells![
            "over acceleration",
            acceleration,
            "`supervise.acceleration`"
        ]);
    }
    let reaction = match watch.reaction {
        StopMethod::QuickStop => "the drive's quick stop, then no power",
        StopMethod::Ramp => "by the acceleration limit, then no power",
        StopMethod::DisableVoltage => "no power at once",
    };
    table.row(cells!["on a trip", reaction, "`on_trip`"]);
    let emergency = match watch.emergency {
        StopMethod::Ramp | StopMethod::QuickStop => "the drive's quick stop",
        StopMethod::DisableVoltage => "no power at once",
    };
    table.row(cells!["on emergency", emergency, "`on_emergency`"]);
    let full = config.stop_time_s(config.mode, config.limits.velocity);
    let (stop, origin) = match config.stop_timeout_s {
        Some(timeout) => (time(timeout), "`stop_timeout`"),
        None => (
            format!("{} from full speed", time(full)),
            "ramp and 1 s; longer while it slows",
        ),
    };
    table.row(cells!["stop time-out", stop, origin]);
    if !config.follows_bit {
        table.row(cells!["Statusword bit 12", "ignored", "`follows_bit`"]);
    }
    if config.mode_display_enabled {
        let shown = format!(
            "{} after Operation enabled, else a trip",
            time(config.mode_time_s)
        );
        table.row(cells!["0x6061 shown", shown, "`mode_display`"]);
    }
    if config.mode_change_unpowered {
        table.row(cells![
            "mode switch",
            "at standstill: no power, 0x6060, power",
            "`mode_change`"
        ]);
    }
    if let Some(option) = config.quick_stop {
        let option = format!("option {}", option.0);
        table.row(cells!["quick stop", option, "0x605A from `sdo` or the ESI"]);
    }
    let reset = match config.fault_reset {
        FaultReset::Manual => "by a step or command".to_owned(),
        FaultReset::Automatic { tries, delay_s } => {
            format!("by itself after {}, {tries} times", time(delay_s))
        }
    };
    table.row(cells!["fault reset", reset, "`fault_reset`"]);
    let brake = config.brake;
    if brake.release_s > 0.0 || brake.engage_s > 0.0 || axis.brake_output.is_some() {
        let by = axis.brake_output.as_ref();
        let by = by.map_or(String::new(), |output| format!(", by `{}`", output.name));
        let times = format!(
            "opens in {}, closes in {}{by}",
            time(brake.release_s),
            time(brake.engage_s)
        );
        table.row(cells!["brake", times, "`brake`"]);
    }
}

fn homing(setup: &HomingSetup, unit: &str, table: &mut Table) {
    let home = &setup.homing;
    let text = home
        .known_method()
        .map_or("method of the vendor", |method| method.text);
    let method = format!("{}: {text}", home.method);
    table.row(cells!["homing", method, "`homing.method`, 0x6098"]);
    let threshold = home.threshold_ma.map(f64::from);
    for (what, value, suffix, origin) in [
        ("search", home.search_velocity, "/s", "`search`, 0x6099:01"),
        ("zero", home.zero_velocity, "/s", "`zero`, 0x6099:02"),
        (
            "acceleration",
            home.acceleration,
            "/s²",
            "`acceleration`, 0x609A",
        ),
        ("distance", home.distance, "", "`distance`, 0x30B1"),
        (
            "position there",
            home.position,
            "",
            "`position`, 0x30B0 or 0x607C",
        ),
    ] {
        if let Some(value) = value {
            let text = format!("{what} {value} {unit}{suffix}");
            table.row(cells!["", text, origin]);
        }
    }
    if let Some(current) = threshold {
        let text = format!("mechanical end at {current} mA");
        table.row(cells!["", text, "`threshold`, 0x30B2"]);
    }
    let timeout = format!("{} at most", duration::show(setup.timeout_ns));
    table.row(cells!["", timeout, "`homing.timeout`"]);
}
