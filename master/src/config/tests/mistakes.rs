//! Each mistake is reported with its place, a message and a hint.

use super::*;

#[test]
#[rustfmt::skip] // one row per mistake
fn config_reports_each_mistake_with_its_place() {
    for (from, to, message, hint, marked) in [
        ("cycle =", "cycel =", "unknown key `cycel` in [bus]", "did you mean `cycle`?", "cycel"),
        ("\"1ms\"", "\"1mms\"", "unknown unit of time `mms`", "did you mean `ms`?", "mms"),
        ("\"1ms\"", "1", "a duration needs a unit", "\"1ms\"", "1"),
        ("\"1ms\"", "\"10us\"", "`cycle` of 10 µs is not possible", "", "\"10us\""),
        ("\"1ms\"", "\"1.234567ms\"", "0x60C2", "", "\"1.234567ms\""),
        ("nic = \"sim\"", "nic = \"a b\"", "cannot be a network interface", "enp3s0", "\"a b\""),
        ("nic = \"sim\"", "lost_frames = 0", "a whole number from 1 to 1000, found 0", "", "0"),
        ("nic = \"sim\"", "priority = true", "expected a whole number, found true or false", "", "true"),
        ("nic = \"sim\"", "exchange = \"piped\"", "`exchange` cannot be \"piped\"", "`pipelined`", "\"piped\""),
        ("nic = \"sim\"", "lost_frames = 100", "are 100 ms, but the drives' `watchdog` stops them after 100 ms", "lost_frames = 99", "100"),
        ("nic = \"sim\"", "watchdog = \"2ms\"", "`lost_frames` = 3 cycles of 1 ms", "lost_frames = 1", "\"2ms\""),
        ("\"1ms\"", "\"40ms\"", "are 120 ms", "lost_frames = 2", "\"40ms\""),
        ("nic = \"sim\"", "watchdog = \"6.6s\"", "`watchdog` of 6.6 s is not possible", "from 1 ms to 6.5535 s", "\"6.6s\""),
        ("nic = \"sim\"", "watchdog = \"1ms\"", "expires between two cycles", "", "\"1ms\""),
        ("nic = \"sim\"", "spin = \"2ms\"", "never sleeps", "", "\"2ms\""),
        ("nic = \"sim\"", "spin = \"later\"", "\"later\" is not a duration", "", "later"),
        ("nic = \"sim\"", "spin = 5", "a duration needs a unit", "\"5us\"", "5"),
        ("nic = \"sim\"", "idle = \"awake\"", "CPU to keep awake is missing", "cpu = 1", "\"awake\""),
        ("nic = \"sim\"", "idle = \"never\"", "`idle` cannot be \"never\"", "there are: `sleep`, `awake`", "\"never\""),
        ("nic = \"sim\"", "link = \"xyz\"", "`link` cannot be \"xyz\"", "there are: `ring`, `packet`", "\"xyz\""),
        ("[bus]", "[mailbox_gateway]\nbind = \"localhost\"\n[bus]", "\"localhost\" is not an IP address with a port", "127.0.0.1:34980", "\"localhost\""),
        ("[bus]", "[mailbox_gateway]\nwrite = 1\n[bus]", "expected true or false", "", "1"),
        ("[bus]", "[eoe]\ntap = \"ecat0\"\n[bus]", "no device is connected with the TAP interface", "eoe = {", "\"ecat0\""),
        ("[bus]", "[buss]", "unknown key `buss`", "did you mean `bus`?", "buss"),
        ("[[step]]", "[[stpe]]", "unknown key `stpe`", "did you mean `step`?", "stpe"),
        ("repeat = 2", "repeat = 0", "a whole number from 1", "", "0"),
        ("name = \"v\"", "name = \"v\"\nfoo = 1", "unknown key `foo` in [[device]]", "known keys:", "foo"),
        ("\"D1.xml\"", "\"D2.xml\"", "cannot read", "did you mean `D1.xml`?", "\"D2.xml\""),
        ("\"D1.xml\"", "\"cut.xml\"", "cut.xml:", "damaged", "\"cut.xml\""),
        ("position = 1", "position = 0", "position 0 is taken", "line 10 has it", "0"),
        ("position = 1", "position = 2", "nothing is at position 1", "count from 0", "2"),
        ("position = 1", "position = -1", "a whole number from 0 to 65535", "", "-1"),
        ("position = 1", "position = 1\nalias = 5", "not by two", "", "5"),
        ("position = 1\n", "", "position on the bus is missing", "position = 1", "[[device]]"),
        ("position = 0", "position = 0\nproduct = 0x11", "matches product 0x00000011", "", "0x11"),
        ("position = 0", "position = 0\ndc = \"FreeRun\"", "no DC mode", "", "\"FreeRun\""),
        ("\"csp\"", "\"cps\"", "unknown mode", "did you mean `csp`?", "\"cps\""),
        ("\"csp\"", "\"hm\"", "no axis begins in mode", "csv", "\"hm\""),
        ("index = 0x6065", "index = 0x6066", "no such object", "type", "{ index = 0x6066, value = 2500 }"),
        ("value = 2500", "value = -1", "does not fit", "", "-1"),
        ("value = 2500", "valeu = 2500", "unknown key `valeu`", "did you mean `value`?", "valeu"),
        ("encoder = 2000", "encoder = 0", "`encoder` is 0, but must be above zero", "", "0"),
        ("encoder = 2000", "encoder = 0.5", "less than one count a turn", "four to a line", "0.5"),
        ("encoder = 2000", "encoder = 1e10", "more than 32 bits", "", "1e10"),
        ("encoder = 2000\n", "", "`encoder` is missing", "encoder = 2000", "[device.axis]"),
        ("velocity = 200.0", "velocity = -200.0", "`limits.velocity` is -200 mm/s", "", "-200.0"),
        ("velocity = 200.0", "velocity = 1e6", "1000000 mm/s is 1.200e10 mrpm", "", "1e6"),
        ("acceleration = 2000.0", "acceleration = 1e-3", "0.001 mm/s² takes 55.6 h to stop from the 200 mm/s", "an hour", "1e-3"),
        ("ramp = 0.3", "ramp = 1e-6", "`x` takes 13.9 h to reach its velocity", "an hour", "1e-6"),
        ("torque = 100.0", "torque = 4000.0", "`limits.torque` of 4000 %", "", "4000.0"),
        ("[-50.0, 50.0]", "[-5e9, 5e9]", "-5000000000 to 5000000000 mm is 4.000e12 counts wide", "", "[-5e9, 5e9]"),
        ("per_turn = 5.0", "per_turn = 1e-20", "1 mm is 2.000e23 counts", "", "1e-20"),
        ("unit = \"mm\"", "unit = \"mmm\"", "unknown unit `mmm`", "did you mean `mm`?", "\"mmm\""),
        ("unit = \"mm\"", "unit = \"slots\"", "unknown unit `slots`", "`unit = \"custom:slots\"`", "\"slots\""),
        ("unit = \"mm\"", "unit = \"custom: \"", "1 to 16 characters", "", "\"custom: \""),
        ("velocity = 200.0", "velocity = \"fast\"", "expected a number, found a string", "", "\"fast\""),
        ("velocity = 200.0", "velocity = nan", "a number from -1e15 to 1e15, found nan", "", "nan"),
        ("[-50.0, 50.0]", "[50.0, -50.0]", "range of positions is empty", "lower end", "[50.0, -50.0]"),
        ("[-50.0, 50.0]", "[50.0]", "two ends", "", "[50.0]"),
        ("unit = \"mm\"", "velocity_unit = \"rmp\"", "`velocity_unit` cannot be \"rmp\"", "`rpm`", "\"rmp\""),
        ("x = 50.0", "y = 50.0", "no device is named `y`", "axes: `x`, `v`", "y"),
        ("x = 50.0", "v = 50.0", "`move` is not possible for `v` in mode \"csv\"", "csv = { kv", "v"),
        ("dwell = \"500ms\"", "mode = { x = \"cst\" }", "`x` cannot switch to \"cst\"", "it can: `csp`", "\"cst\""),
        ("unit = \"mm\"", "csv = { kv = 0 }", "`csv.kv` is 0", "", "0"),
        ("unit = \"mm\"", "csv = { kv = 5, feed_forward = 2 }", "a weight from 0 to 1", "", "2"),
        ("unit = \"mm\"", "csp = { velocity_offset = 1 }", "0x60B1, which is not in the process data", "pdo.rx", "1"),
        ("unit = \"mm\"", "dead_time = \"1s\"", "must be between 0 and 0.1", "", "\"1s\""),
        ("per_turn = 5.0", "per_turn = 5.0\ngear = [3, 1]", "`per_turn` says already", "`feed`", "[3, 1]"),
        ("per_turn = 5.0", "gear = [3, 0]\nfeed = 5.0", "a whole number from 1 to 4294967295, found 0", "", "0"),
        ("per_turn = 5.0", "gear = [3]\nfeed = 5.0", "two numbers", "gear = [3, 1]", "[3]"),
        ("per_turn = 5.0", "gear = 3\nfeed = 5.0", "expected motor turns and shaft turns", "", "3"),
        ("per_turn = 5.0", "feed = true", "expected a number", "", "true"),
        ("per_turn = 5.0", "feed = -1", "`feed` is -1 mm", "", "-1"),
        ("unit = \"mm\"", "modulo = 360", "has no range of positions", "`modulo` out", "[-50.0, 50.0]"),
        ("unit = \"mm\"", "modulo = 0", "`modulo` is 0", "", "0"),
        ("unit = \"mm\"", "way = \"shortest\"", "only a modulo axis", "modulo = 360.0", "\"shortest\""),
        ("[device.axis]\nencoder = 2000", "[device.axis]\nmodulo = 1e-4\nencoder = 2000", "less than 2 counts", "2.000e-1", "1e-4"),
        ("[device.axis]\nencoder = 2000", "[device.axis]\nmodulo = 1\nway = \"forwards\"\nencoder = 2000", "`way` cannot be \"forwards\"", "`positive`", "\"forwards\""),
        ("unit = \"mm\"", "torque_unit = \"nm\"", "`torque_unit` cannot be \"nm\"", "`Nm`", "\"nm\""),
        ("unit = \"mm\"", "torque_unit = \"A\"", "need the motor's torque constant", "torque_constant", "\"A\""),
        ("unit = \"mm\"", "rated_torque = 0", "`rated_torque` is 0 Nm", "", "0"),
        ("unit = \"mm\"", "torque_constant = -1", "`torque_constant` is -1 Nm/A", "", "-1"),
        ("[device.axis]\nencoder = 2000", "[device.axis]\ntorque_unit = \"Nm\"\nencoder = 2000", "only the drive knows the motor's rated torque", "rated_torque", "\"Nm\""),
        ("unit = \"mm\"", "torque_unit = \"Nm\"\nrated_torque = 0.1", "`limits.torque` of 100 Nm is 100000.0 % of the rated torque", "", "100.0"),
        ("x = 50.0", "x = 50.1", "outside the axis' limits, -50 to 50 mm", "", "50.1"),
        ("v = 25.0", "v = 51", "outside the axis' limits, -50 to 50 turn/s", "", "51"),
        ("{ x = 50.0 }", "{}", "no axis is named", "", "{}"),
        ("{ x = 50.0 }", "50.0", "expected axes and targets", "{ x = 50.0 }", "50.0"),
        ("speed = 0.5", "speed = 5", "fraction of the axis' velocity limit", "up to 1.0", "5"),
        ("ramp = 0.3", "dwell = \"1s\"", "`move` and `dwell`", "a [[step]] for each", "\"1s\""),
        ("velocity = { v = 25.0 }", "velocity = { v = 25.0 }\nspeed = 0.5", "`speed` does not go with `velocity`", "", "0.5"),
        ("dwell = \"500ms\"", "enable = [\"q\"]", "no device is named `q`", "axes: `x`, `v`", "\"q\""),
        ("dwell = \"500ms\"", "line = { x = 60 }", "outside the axis' limits, -50 to 50 mm", "", "60"),
        ("dwell = \"500ms\"", "gear = { x = { to = \"x\" } }", "`x` cannot follow itself", "", "\"x\""),
        ("[bus]", "[[line_shaft]]\nname = \"x\"\nvelocity = 1.0\nacceleration = 1.0\n[bus]", "the name `x` is taken", "another name", "\"x\""),
        ("[bus]", "[[line_shaft]]\nname = \"s\"\nvelocity = 0.0\nacceleration = 1.0\n[bus]", "`velocity` must be above 0", "", "0.0"),
        ("[bus]", "[[line_shaft]]\nname = \"s\"\nvelocity = 100.0\nacceleration = 100.0\ntimeout = \"2ms\"\n[bus]", "the timeout of 2 ms ends within 4 cycles of 1 ms", "delay", "\"2ms\""),
        ("dwell = \"500ms\"", "gear = { x = { to = \"s\", ratio = 3.0 } }\n[[line_shaft]]\nname = \"s\"\nvelocity = 100.0\nacceleration = 100.0", "`x` cannot follow `s`: its velocity would be up to 300.3 mm/s", "`ratio`", "\"s\""),
        ("dwell = \"500ms\"", "gear = { x = { to = \"s\", actual = true } }\n[[line_shaft]]\nname = \"s\"\nvelocity = 100.0\nacceleration = 100.0", "no reported positions", "`actual`", "true"),
        ("dwell = \"500ms\"", "gear = { x = { to = \"s\" } }\n[[line_shaft]]\nname = \"s\"\nvelocity = -1.0\nacceleration = 100.0", "`velocity` must be above 0", "", "-1.0"),
        ("dwell = \"500ms\"", "gear = { x = { to = \"t\" } }\n[[line_shaft]]\nname = \"s\"\nvelocity = 100.0\nacceleration = 100.0", "nothing to follow is named `t`", "`s`", "\"t\""),
        ("dwell = \"500ms\"", "gear = { v = { to = \"x\" } }", "`gear` is not possible for `v`", "position loop", "v"),
        ("dwell = \"500ms\"", "sine = { x = { amplitude = 40, frequency = 50, periods = 2 } }", "would be reached, above the limit", "smaller amplitude", "40"),
        ("dwell = \"500ms\"", "sine = { x = { amplitude = 1, frequency = 500, periods = 2 } }", "more than the 100 Hz", "", "500"),
        ("dwell = \"500ms\"", "table = { x = \"none.csv\" }", "none.csv", "relative to the machine file", "\"none.csv\""),
        ("dwell = \"500ms\"", "sine = 5", "expected one axis", "amplitude", "5"),
        ("dwell = \"500ms\"", "disable = []", "no axis is named", "`true` for every axis", "[]"),
        ("dwell = \"500ms\"", "move_by = { x = 101 }", "a way of 101 mm is longer than the axis' range, -50 to 50 mm", "", "101"),
        ("dwell = \"500ms\"", "move_to = { x = 5 }", "unknown key `move_to`", "did you mean `move`?", "move_to"),
        ("dwell = \"500ms\"", "table = { x = \"/dev/zero\" }", "not a regular file", "relative", "\"/dev/zero\""),
        ("{ x = 50.0 }", "{ x = 1e300 }", "a number from -1e15 to 1e15, found 1e300", "", "1e300"),
        ("per_turn = 5.0\n", "", "`unit` is mm, but nothing says", "add `per_turn = 5.0`", "\"mm\""),
        ("per_turn = 5.0\n", "gear = [3, 1]\n", "`unit` is mm, but nothing says", "`feed = 5.0`", "\"mm\""),
        ("unit = \"mm\"\nper_turn = 5.0", "unit = \"custom:slots\"", "`unit` is slots, but nothing says", "leave `unit` out", "\"custom:slots\""),
        ("dwell = \"500ms\"", "repeat = 2", "nothing is repeated", "[[step.step]]", "2"),
        ("dwell = \"500ms\"", "wait = { z.In = true }", "no device is named `z`", "devices: `x`, `v`", "z"),
        ("dwell = \"500ms\"", "wait = { x.Nothing = true }", "no input \"Nothing\"", "its inputs: ", "Nothing"),
        ("dwell = \"500ms\"", "wait = { x.\"0x6041\" = 65536 }", "is not a value of `x.", "16 bits: 0 to 65535", "65536"),
        ("dwell = \"500ms\"", "set = { x.\"0x607A\" = 5 }", "written by the axis `x` in line", "a command", "\"0x607A\""),
        ("dwell = \"500ms\"", "", "does nothing", "dwell", "[[step]]"),
        ("dwell = \"500ms\"", "dwel = \"500ms\"", "unknown key `dwel`", "`dwell`", "dwel"),
        ("dwell = \"500ms\"", "dwell = \"500 parsec\"", "unknown unit of time `parsec`", "units:", "parsec"),
    ] {
        one(from, to, message, hint, marked);
    }
}

/// Distances that an axis without a range rejects during operation.
#[test]
fn move_by_rejects_distances_beyond_the_axis_range() {
    let endless = GOOD.replace("position = [-50.0, 50.0], ", "");
    for (step, message) in [
        (
            "move_by = { x = 1e14 }",
            "a way of 100000000000000 mm is longer",
        ),
        (
            "line = { x = -1e14 }",
            "-100000000000000 mm is outside the axis' limits",
        ),
    ] {
        let found = problems(&endless.replace("dwell = \"500ms\"", step));
        assert_eq!(found.len(), 1, "{found:#?}");
        assert!(found[0].message.contains(message), "{}", found[0]);
    }
}

#[test]
fn toml_syntax_errors_name_the_correction() {
    for (from, to, message, hint) in [
        (
            "\"D1.xml\"",
            "\"esi\\SV1.xml\"",
            "begins an escape",
            "single quotes",
        ),
        (
            "repeat = 2",
            "enable = no",
            "`no` is not a value",
            "write `false`",
        ),
        (
            "repeat = 2",
            "enable = off # now",
            "`off` is not a value",
            "write `false`",
        ),
        (
            "repeat = 2",
            "enable = True",
            "`True` is not a value",
            "write `true`",
        ),
        ("\"csp\"", "csp", "`csp` is not a value", "`\"csp\"`"),
    ] {
        let found = broken(from, to);
        assert!(found[0].message.contains(message), "{}", found[0]);
        let said = found[0].hint.as_deref().unwrap_or_default();
        assert!(said.contains(hint), "{}", found[0]);
    }
}

#[test]
fn brake_output_is_exclusive() {
    let io = "[[device]]\nname = \"io.a\"\nesi = \"esi/IO8.xml\"\nposition = 2\n";
    let axis = |name: &str, position: usize, brake: &str| {
        format!(
            "[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\n[device.axis]\n\
             encoder = 2000\nlimits = {{ velocity = 50.0, acceleration = 500.0 }}\nbrake = {{ {brake} }}\n"
        )
    };
    let load = |first: &str, second: &str, steps: &str| {
        let text = format!(
            "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n{}{}{io}{steps}",
            axis("x", 0, first),
            axis("y", 1, second)
        );
        let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs");
        parse(&folder.join("m.toml"), &text)
    };
    let first = "output = \"io.a.Output 1\", release = \"50ms\"";
    let machine = load(first, "output = \"io.a.Output 2\"", "").unwrap();
    let output = |axis: usize| {
        let output = machine.axes[AxisIndex(axis)].brake_output.as_ref();
        output.map(|s| (s.device.0, s.name.as_str()))
    };
    assert_eq!(
        (output(0), output(1)),
        (Some((2, "io.a.Output 1")), Some((2, "io.a.Output 2")))
    );
    let error = machine.clone().output("io.a", "Output 1").unwrap_err();
    assert!(error.message.contains("opens the brake of `x`"), "{error}");
    assert!(machine.clone().output("io.a", "Output 3").is_ok());
    for (second, steps, message) in [
        (
            "output = \"io.a.Output 1\"",
            "",
            "opens the brake of `x` in line 12; the brake of `y` in line 21 may not",
        ),
        ("output = \"io.a.Output 9\"", "", "no output \"Output 9\""),
        ("output = \"o.Output 1\"", "", "no device is named `o`"),
        ("output = \"Output 1\"", "", "names no output"),
        ("output = \"x.0x60B1\"", "", "has 32 bits"),
        (
            "",
            "[[step]]\nset = { \"io.a\".\"Output 1\" = true }\n",
            "is set by the step in line",
        ),
        (
            "",
            "[[stop.group]]\nname = \"g\"\naxes = [\"y\"]\ndevices = [\"io.a\"]\noutside = \"continue\"\n",
            "its group `g` may stop while `x` moves",
        ),
    ] {
        let Err(ConfigError::Problems(found)) = load(first, second, steps) else {
            panic!("{second} {steps}")
        };
        assert_eq!(found.len(), 1, "{found:#?}");
        assert!(found[0].message.contains(message), "{}", found[0]);
    }
}

#[test]
fn mode_and_axis_require_each_other() {
    let found = broken("mode = \"csv\"\n", "");
    assert_eq!(found.len(), 1, "{found:#?}");
    assert!(found[0].message.contains("needs a `mode`"));
    let (head, _) = GOOD.split_once("[device.axis]\nencoder").unwrap();
    let found = problems(head);
    assert_eq!(found.len(), 1, "{found:#?}");
    assert!(found[0].message.contains("needs a [device.axis]"));
}

#[test]
fn mode_must_be_offered_by_the_esi() {
    let found = problems(&GOOD.replace("mode = \"csv\"", "mode = \"cst\""));
    assert!(
        found[0].message.contains("6071") || found[0].message.contains("cst"),
        "{found:#?}"
    );
}

#[test]
fn config_reports_all_mistakes_at_once() {
    let text = GOOD
        .replace("cycle = ", "cycel = ")
        .replace("name = \"v\"", "name = \"x\"")
        .replace(
            "encoder = 2000\nlimits = { velocity = 50",
            "encoder = 2000\nlimits = { velocity = 0",
        )
        .replace("dwell = \"500ms\"", "dwell = \"500mss\"")
        .replace("x = 50.0", "q = 50.0");
    let found = problems(&text);
    let lines: Vec<u32> = found.iter().map(|p| p.line).collect();
    assert_eq!(lines, [5, 21, 28, 31, 36, 39], "{found:#?}");
}

#[test]
fn broken_toml_is_reported_with_its_line() {
    let found = problems("[bus\nnic = \"sim\"\n");
    assert_eq!(found[0].line, 1);
    let found = problems("");
    assert!(found.iter().any(|p| p.message.contains("`bus` is missing")));
    assert!(
        found
            .iter()
            .any(|p| p.message.contains("`device` is missing"))
    );
}

#[test]
fn load_reports_a_missing_file() {
    let e = load(&PathBuf::from("/nowhere/m.toml")).unwrap_err();
    assert!(
        e.to_string().starts_with("cannot read /nowhere/m.toml"),
        "{e}"
    );
}
