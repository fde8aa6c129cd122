//! Programs that are certain to fail, and programs that may succeed.

use std::path::PathBuf;

use crate::config::{ConfigError, Problem, parse};

const HEAD: &str = r#"[bus]
cycle = "1ms"
[[device]]
name = "x"
esi = "esi/EPOS4.xml"
position = 0
mode = "csp"
pdo.rx = ["0x6040", "0x6060", "0x607A", "0x60FF", "0x6071", "0x6081", "0x6083", "0x6084"]
pdo.tx = ["0x6041", "0x6061", "0x6064", "0x606C", "0x6077"]
[device.axis]
encoder = 2000
limits = { velocity = 50.0, acceleration = 500.0 }
homing = { method = 37 }
[[device]]
name = "y"
esi = "esi/EPOS4.xml"
position = 1
mode = "csp"
pdo.rx = ["0x6040", "0x607A", "0x60B1", "0x60B2"]
pdo.tx = ["0x6041", "0x6064", "0x606C", "0x6077", "0x6061"]
[device.axis]
encoder = 2000
limits = { position = [-50.0, 50.0], velocity = 50.0, acceleration = 500.0 }
[[device]]
name = "z"
esi = "esi/EPOS4.xml"
position = 2
mode = "csp"
pdo.rx = ["0x6040", "0x6060", "0x607A", "0x60FF", "0x6071"]
pdo.tx = ["0x6041", "0x6061", "0x6064", "0x606C", "0x6077"]
[device.axis]
encoder = 2000
limits = { velocity = 50.0, acceleration = 500.0 }
mode_change = "no-power"
"#;

/// Returns the problems of a program. Each line is a step; an indented step is inside the
/// repetition before it.
fn problems(lines: &[&str]) -> Vec<Problem> {
    problems_with("", lines)
}

/// The same, with more tables before the steps.
fn problems_with(more: &str, lines: &[&str]) -> Vec<Problem> {
    let top: String = lines
        .iter()
        .filter(|line| line.starts_with("all "))
        .map(|line| format!("repeat = {}\n", &line[4..]))
        .collect();
    let steps = lines.iter().filter(|line| !line.starts_with("all "));
    let steps = steps.map(|line| match line.strip_prefix("  ") {
        Some(inner) => format!("[[step.step]]\n{inner}\n"),
        None => format!("[[step]]\n{line}\n"),
    });
    let text = format!("{top}{HEAD}{more}{}", steps.collect::<String>());
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs");
    match parse(&folder.join("test.toml"), &text) {
        Ok(_) => Vec::new(),
        Err(ConfigError::Problems(problems)) => problems,
        Err(other) => panic!("{other}"),
    }
}

#[test]
#[rustfmt::skip] // one row per program
fn program_check_rejects_steps_certain_to_fail() {
    let rows: &[(&[&str], &str, &str)] = &[
        (&["mode = { x = \"pv\" }", "move = { x = 1.0 }"], "`move` is not possible for `x` in mode \"pv\", to which step 1 has switched it", "mode = { x = \"pp\" }`, or \"csp\""),
        (&["mode = { x = \"csv\" }", "move_by = { x = 1.0 }"], "`move_by` is not possible for `x` in mode \"csv\"", "\"csp\""),
        (&["mode = { x = \"cst\" }", "velocity = { x = 1.0 }"], "`velocity` is not possible for `x` in mode \"cst\"", "\"pv\" }`, or \"csp\", \"csv\""),
        (&["mode = { x = \"pp\" }", "velocity = { x = 1.0 }"], "`velocity` is not possible for `x` in mode \"pp\"", "\"csp\""),
        (&["mode = { x = \"cst\" }", "mode = { x = \"csp\" }", "torque = { x = 1.0 }"], "`torque` is not possible for `x` in mode \"csp\", to which step 2", "mode = { x = \"cst\" }`"),
        (&["torque = { x = 1.0 }", "mode = { x = \"cst\" }"], "`torque` is not possible for `x` in mode \"csp\"", "\"cst\""),
        (&["mode = { x = \"pp\" }", "line = { x = 1.0 }"], "`line` is not possible for `x` in mode \"pp\"", "\"csp\" }`"),
        (&["mode = { x = \"pp\" }", "move = { x = 1.0 }\narrive = \"together\""], "`arrive = \"together\"` is not possible for `x` in mode \"pp\"", "\"csp\" }`"),
        (&["mode = { x = \"pp\" }", "sine = { x = { amplitude = 1, frequency = 1, periods = 1 } }"], "`sine` or `square` is not possible", "\"csp\" }`"),
        (&["mode = { x = \"pv\" }", "gear = { x = { to = \"y\" } }"], "`gear` is not possible for `x` in mode \"pv\"", "\"csp\" }`"),
        (&["repeat = 3", "  move = { x = 1.0 }", "  mode = { x = \"pv\" }"], "is not possible for `x` in mode \"pv\", to which step 1.2 has switched it, when it is repeated", "\"csp\""),
        (&["all 2", "move = { x = 1.0 }", "mode = { x = \"pv\" }"], "to which step 2 has switched it, when it is repeated", "\"csp\""),
        (&["enable = [\"y\"]", "move = { x = 1.0 }"], "`move` needs `x` to have power, and no step before has enabled it", "enable = [\"x\"]"),
        (&["disable = true", "home = true"], "`home` needs `x` to have power, which step 1 has taken away", "enable = [\"x\"]"),
        (&["all 2", "enable = true", "repeat = 2", "  velocity = { x = 1.0 }", "  disable = [\"x\"]"], "which step 2.2 has taken away, when it is repeated", "enable = [\"x\"]"),
        (&["enable = [\"x\"]", "gear = { x = { to = \"y\" } }"], "`gear` needs `y` to have power", "enable = [\"y\"]"),
        (&["gear = { x = { to = \"y\" } }", "mode = { x = \"csv\" }"], "`mode` needs `x` to be free, but since step 1 it follows another axis", "stop = [\"x\"]"),
        (&["gear = { x = { to = \"y\" } }", "home = [\"x\"]"], "`home` needs `x` to be free", "stop = [\"x\"]"),
        (&["velocity = { x = 1.0 }", "home = [\"x\"]"], "`home` needs `x` at rest, but since step 1 it turns", "velocity = { x = 0.0 }"),
        (&["velocity = { x = -1.0 }", "mode = { x = \"pp\" }"], "`mode` needs `x` at rest", "stop = [\"x\"]"),
        (&["velocity = { z = 1.0 }", "mode = { z = \"csv\" }"], "`mode` needs `z` at rest, but since step 1 it turns", "velocity = { z = 0.0 }"),
        (&["mode = { z = \"csv\" }", "velocity = { z = 1.0 }", "mode = { z = \"csp\" }"], "`mode` needs `z` at rest, but since step 2 it turns", "stop = [\"z\"]"),
        (&["mode = { z = \"cst\" }", "torque = { z = 1.0 }", "mode = { z = \"csp\" }"], "`mode` needs `z` without torque, but since step 2 it has one", "torque = { z = 0.0 }"),
        (&["mode = { x = \"cst\" }", "torque = { x = 1.0 }", "mode = { x = \"pp\" }"], "`mode` needs `x` without torque", "stop = [\"x\"]"),
        (&["mode = { x = \"cst\" }", "torque = { x = -1.0 }", "home = [\"x\"]"], "`home` needs `x` without torque", "stop = [\"x\"]"),
        (&["velocity = { x = 1.0 }", "sine = { x = { amplitude = 1, frequency = 1, periods = 1 } }"], "`sine` or `square` needs `x` at rest", "stop = [\"x\"]"),
        (&["phase = { x = 1.0 }"], "`phase` shifts `x` against its master, and no step before lets it follow one", "gear = { x = { to = … } }"),
        (&["gear = { x = { to = \"y\" } }", "move = { x = 1.0 }", "phase = { x = 1.0 }"], "`phase` shifts `x` against its master", "gear"),
        (&["gear = { x = { to = \"y\" } }", "disable = [\"x\"]", "phase = { x = 1.0 }"], "`phase` needs `x` to have power, which step 2", "enable = [\"x\"]"),
        (&["disable = [\"x\"]", "superimpose = { x = 1.0 }"], "`superimpose` needs `x` to have power", "enable = [\"x\"]"),
        (&["mode = { x = \"pp\" }", "superimpose = { x = 1.0 }"], "`superimpose` is not possible for `x` in mode \"pp\"", "\"csp\" }`"),
        (&["velocity = { x = 1.0 }", "line_by = { x = 1.0, y = 1.0 }"], "`line_by` needs `x` at rest", "stop = [\"x\"]"),
        (&["move = { y = 45.0 }", "move_by = { y = 6.0 }"], "`move_by` of 6 turn leads `y` from 45 to 51 turn, outside its limits, -50 to 50 turn", "go back"),
        (&["move = { y = 45.0 }", "sine = { y = { amplitude = 6, frequency = 0.1, periods = 1 } }"], "an amplitude of 6 turn about 45 turn leads `y` outside its limits, -50 to 50 turn", "smaller amplitude"),
        (&["move = { y = 0.0 }", "repeat = 6", "  line_by = { y = -10.0 }"], "`line_by` of -10 turn leads `y` from -50 to -60 turn, outside its limits, -50 to 50 turn, when it is repeated", "less often"),
    ];
    for (lines, message, hint) in rows {
        let found = problems(lines);
        let [problem] = found.as_slice() else { panic!("{lines:?}: {found:#?}") };
        assert!(problem.message.contains(message), "{lines:?}: {problem}");
        assert!(problem.hint.as_deref().unwrap_or_default().contains(hint), "{lines:?}: {problem}");
    }
}

#[test]
#[rustfmt::skip] // one row per program
fn program_check_accepts_steps_that_may_succeed() {
    let rows: &[&[&str]] = &[
        &["mode = { x = \"pv\" }", "velocity = { x = 1.0 }", "stop = [\"x\"]", "mode = { x = \"pp\" }", "move = { x = 1.0 }"],
        &["repeat = 3", "  move = { x = 1.0 }", "  mode = { x = \"cst\" }", "  torque = { x = 1.0 }", "  mode = { x = \"csp\" }"],
        // Without power, `mode` only selects a mode.
        &["disable = [\"x\"]", "mode = { x = \"pp\" }", "enable = [\"x\"]", "move = { x = 1.0 }"],
        &["enable = [\"x\"]", "move = { x = 1.0 }", "disable = [\"x\"]"],
        // The end of its range may have stopped the axis.
        &["velocity = { y = 1.0 }", "line = { y = 1.0 }"],
        &["gear = { x = { to = \"y\" } }", "move = { y = 1.0 }", "move = { x = 0.0 }", "home = [\"x\"]"],
        // A drive that switches without power does so at rest. A switch to the present mode needs no rest.
        &["velocity = { z = 1.0 }", "mode = { z = \"csp\" }", "velocity = { z = 0.0 }", "mode = { z = \"csv\" }"],
        &["mode = { z = \"cst\" }", "torque = { z = 1.0 }", "torque = { z = 0.0 }", "mode = { z = \"csp\" }"],
        &["mode = { x = \"cst\" }", "torque = { x = 1.0 }", "mode = { x = \"csp\" }"],
        &["velocity = { z = 1.0 }", "stop = [\"z\"]", "mode = { z = \"cst\" }"],
        &["gear = { x = { to = \"y\" } }", "phase = { x = 1.0 }", "phase = { x = -1.0 }"],
        &["repeat = 2", "  gear = { x = { to = \"y\" } }", "  phase = { x = 1.0 }"],
        // The shift moves the position.
        &["move = { y = 45.0 }", "superimpose = { y = -20.0 }", "move_by = { y = 10.0 }"],
        // The start position is unknown.
        &["move_by = { y = 60.0 }"],
        &["enable = true", "move = { y = 45.0 }", "disable = true", "enable = true", "move_by = { y = 60.0 }"],
        &["move = { y = 0.0 }", "repeat = 5", "  move_by = { y = 10.0 }"],
        &["move = { y = 0.0 }", "repeat = 1000000", "  move_by = { y = 0.1 }", "  move_by = { y = -0.1 }"],
        &["move = { y = 45.0 }", "sine = { y = { amplitude = 1, frequency = 1, periods = 1 } }", "move_by = { y = 5.0 }"],
    ];
    for lines in rows {
        let found = problems(lines);
        assert!(found.is_empty(), "{lines:?}: {found:#?}");
    }
}

/// `couple` waits for both halves, without a limit.
#[test]
fn program_check_rejects_gantries_that_cannot_couple() {
    let gantry = "[[gantry]]\naxes = [\"g\", \"h\"]\nmax_skew = 1.0\n";
    let half = |name: &str, position: usize| {
        format!(
            "[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nencoder = 2000\nlimits = {{ velocity = 50.0, acceleration = 500.0 }}\n"
        )
    };
    let head = half("g", 3) + &half("h", 4) + gantry;
    let rows: &[(&[&str], &str)] = &[
        (
            &[
                "decouple = [\"g\"]",
                "disable = [\"h\"]",
                "couple = [\"g\"]",
            ],
            "`couple` needs `h` to have power, which step 2 has taken away",
        ),
        (
            &[
                "decouple = [\"g\"]",
                "velocity = { h = 1.0 }",
                "couple = [\"g\"]",
            ],
            "`couple` needs `h` at rest, but since step 2 it turns",
        ),
        (
            &["velocity = { g = 1.0 }", "decouple = [\"g\"]"],
            "`decouple` needs `g` at rest",
        ),
        (
            &[
                "decouple = [\"g\"]",
                "gear = { g = { to = \"x\" } }",
                "couple = [\"g\"]",
            ],
            "`couple` needs `g` to be free",
        ),
        (
            &[
                "decouple = [\"g\"]",
                "move = { h = 1.0 }",
                "couple = [\"g\"]",
            ],
            "",
        ),
        (
            &[
                "disable = true",
                "decouple = [\"g\"]",
                "enable = true",
                "couple = true",
            ],
            "",
        ),
    ];
    for (lines, message) in rows {
        let found = problems_with(&head, lines);
        match message.is_empty() {
            true => assert!(found.is_empty(), "{lines:?}: {found:#?}"),
            false => {
                let [problem] = found.as_slice() else {
                    panic!("{lines:?}: {found:#?}")
                };
                assert!(problem.message.contains(message), "{lines:?}: {problem}");
            }
        }
    }
}

#[test]
fn probe_requires_its_objects_in_the_process_data() {
    let found = problems(&["probe = { y = { to = 5.0, input = 2, edge = \"falling\" } }"]);
    let [problem] = found.as_slice() else {
        panic!("{found:#?}")
    };
    assert!(
        problem
            .message
            .contains("touch probe 2 of `y` needs 0x60B8, 0x60B9, 0x60BD"),
        "{problem}"
    );
    let hint = problem.hint.as_deref().unwrap_or_default();
    for list in [
        r#"pdo.rx = ["0x6040", "0x607A", "0x60B1", "0x60B2", "0x60B8"]"#,
        r#"pdo.tx = ["0x6041", "0x6064", "0x606C", "0x6077", "0x6061", "0x60B9", "0x60BD"]"#,
    ] {
        assert!(hint.contains(list), "{hint}");
    }
    for (step, message) in [
        ("probe = { y = { to = 51.0 } }", "outside the axis' limits"),
        (
            "probe = { y = { by = -101.0 } }",
            "longer than the axis' range",
        ),
        (
            "probe = { y = { to = 5.0, edge = \"up\" } }",
            "`edge` cannot be \"up\"",
        ),
        ("probe = { y = { to = 5.0, input = 3 } }", "from 1 to 2"),
        ("probe = { y = {} }", "the distance to search"),
        ("probe = { y = { to = 5.0, by = 1.0 } }", "both say how far"),
        (
            "move = { y = 5.0 }\narrive = \"soon\"",
            "`arrive` cannot be \"soon\"",
        ),
        (
            "velocity = { y = 5.0 }\narrive = \"together\"",
            "`arrive` does not go with `velocity`",
        ),
    ] {
        let found = problems(&[step]);
        assert!(
            found.iter().any(|p| p.message.contains(message)),
            "{step}: {found:#?}"
        );
    }
}
