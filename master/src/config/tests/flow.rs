//! Programs whose outcome depends on conditions.

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
