//! Mistakes in conditions, repetitions, names and variables: each is reported once, with a remedy.

use super::*;

const HEAD: &str = "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n\
    [[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
    [device.axis]\nencoder = 2000\nlimits = { position = [-10.0, 10.0], velocity = 50.0, acceleration = 500.0 }\n\
    [[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n\
    [signals]\na = \"io.Input 1\"\nlamp = \"io.Output 1\"\n[variables]\nn = 0\n";

fn load(text: &str) -> Result<Machine, ConfigError> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs");
    parse(&folder.join("m.toml"), text)
}

#[test]
fn wrong_programs_are_refused_with_a_remedy() {
    let step = |text: &str| format!("{HEAD}[[step]]\n{text}\n");
    let rows = [
        (
            step("wait = { b = true }"),
            "no signal is named `b`",
            "signals: `a`, `lamp`",
        ),
        (
            step("wait = { io = true }"),
            "no signal of `io` is named",
            "io.\"Input 1\"",
        ),
        (step("wait = { lamp = true }"), "no input \"Output 1\"", ""),
        (step("set = { a = true }"), "no output \"Input 1\"", ""),
        (
            step("wait = { a = 2 }"),
            "2 is not a value",
            "true or false",
        ),
        (
            step("wait = { a = { above = 2, below = 1 } }"),
            "no value is above 2",
            "",
        ),
        (step("wait = []"), "", ""),
        (
            step("wait = { n = 1 }\ntimeout = \"none\""),
            "nothing can end this wait",
            "if",
        ),
        (
            step("wait = { x.position = 1.0 }"),
            "never exactly a number",
            "above",
        ),
        (step("wait = { x.moving = 2 }"), "true or false", ""),
        (step("let = { m = 1 }"), "no variable is named `m`", "`n`"),
        (
            step("repeat = \"forever\"\nstep = []"),
            "nothing is repeated",
            "[[step.step]]",
        ),
        (
            step("if = { a = true }"),
            "`if` has no steps",
            "[[step.step]]",
        ),
        (
            step("while = { a = true }\nuntil = { a = false }\nstep = [{ dwell = \"1ms\" }]"),
            "`until` does not go with `while`",
            "",
        ),
        (
            step("repeat = \"often\"\nstep = [{ dwell = \"1ms\" }]"),
            "often",
            "",
        ),
        (
            step("repeat = \"forever\"\nstep = [{ dwell = \"1ms\" }]\n[[step]]\nenable = true"),
            "no run reaches this step",
            "until",
        ),
        (
            step("alarm = \"end\"\n[[step]]\nenable = true"),
            "no run reaches this step",
            "remove",
        ),
        (
            step(
                "if = { a = true }\nstep = [{ disable = [\"x\"] }]\nelse = [{ disable = [\"x\"] }]\n[[step]]\nmove = { x = 1.0 }",
            ),
            "needs `x` to have power",
            "enable",
        ),
        (
            step("repeat = 20\nstep = [{ move = { x = 0.0 } }, { move_by = { x = 11.0 } }]"),
            "outside its limits",
            "go back",
        ),
        (
            HEAD.replace("[signals]\n", "[signals]\nx = \"io.Input 2\"\n"),
            "name of a device already",
            "another name",
        ),
        (
            HEAD.replace("[variables]\nn", "[variables]\na"),
            "name of a signal already",
            "another name",
        ),
        (
            HEAD.replace("io.Input 1", "io.Inputt 1"),
            "no input \"Inputt 1\"",
            "did you mean",
        ),
        (
            HEAD.replace("io.Output 1", "io.Outputt 1"),
            "no output \"Outputt 1\"",
            "did you mean",
        ),
        (
            HEAD.replace("io.Input 1", "Input"),
            "names no input and no output",
            "io.Input 3",
        ),
        (
            HEAD.to_owned() + "[sim]\ninputs = [{ at = \"1s\", set = { x.\"Statusword\" = 1 } }]\n",
            "an input of a drive",
            "I/O devices",
        ),
        (
            HEAD.to_owned() + "[sim]\ninputs = [{ at = \"1s\", set = { lamp = true } }]\n",
            "no input \"Output 1\"",
            "",
        ),
    ];
    let mut wrong = Vec::new();
    for (text, message, hint) in rows {
        let found = match load(&text) {
            Err(ConfigError::Problems(found)) => found,
            _ => Vec::new(),
        };
        let as_said = |found: &Problem| {
            let said = found.hint.as_deref().unwrap_or_default();
            found.message.contains(message) && said.contains(hint)
        };
        if found.len() != 1 || !found.iter().all(as_said) {
            let text = text.strip_prefix(HEAD).unwrap_or(&text).to_owned();
            wrong.push((text, message, hint, found));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// What a branch may have done is not certain: it refuses no step.
#[test]
fn uncertain_states_refuse_no_step() {
    for steps in [
        "if = { a = true }\nstep = [{ disable = [\"x\"] }]\n[[step]]\nmove = { x = 1.0 }",
        "while = { a = true }\nstep = [{ move_by = { x = 1.0 } }]\n[[step]]\nmove_by = { x = 5.0 }",
        "move = { x = 0.0 }\n[[step]]\nrepeat = \"forever\"\nuntil = { a = true }\nstep = [{ move_by = { x = 6.0 } }]",
        "repeat = \"forever\"\nstep = [{ move = { x = 1.0 } }, { move = { x = 0.0 } }]",
    ] {
        let text = format!("{HEAD}[[step]]\n{steps}\n");
        if let Err(error) = load(&text) {
            panic!("{error}");
        }
    }
}
