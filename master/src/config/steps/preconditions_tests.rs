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
"#;

/// Returns the problems of a program. Each line is a step; an indented step is inside the
/// repetition before it.
fn problems(lines: &[&str]) -> Vec<Problem> {
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
    let text = format!("{top}{HEAD}{}", steps.collect::<String>());
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
        (&["velocity = { x = 1.0 }", "line_by = { x = 1.0, y = 1.0 }"], "`line_by` needs `x` at rest", "stop = [\"x\"]"),
        (&["move = { y = 45.0 }", "move_by = { y = 6.0 }"], "`move_by` of 6 turn leads `y` from 45 to 51 turn, outside its limits, -50 to 50 turn", "go back"),
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
