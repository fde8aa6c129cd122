use ecaxis_ecat::index::DeviceIndex;
use ecaxis_sim::{QuirkValue, Quirks};

use super::super::{ConfigError, Machine, Problem, parse};

/// Loads the demonstration drive with these lines of its axis and of `[device.sim]`.
fn load(axis: &str, sim: &str) -> Result<Machine, ConfigError> {
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/m.toml");
    let text = format!(
        "[bus]\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\nmode = \"csp\"\n\
         [device.axis]\nunit = \"turn\"\nencoder = 2000\nlimits = {{ velocity = 10.0, acceleration = 100.0 }}\n{axis}\n\
         [device.sim]\n{sim}\n"
    );
    parse(std::path::Path::new(root), &text)
}

fn quirks(axis: &str, sim: &str) -> Quirks {
    let machine = load(axis, sim).expect("a machine");
    machine.devices[DeviceIndex(0)].sim.quirks
}

fn problems(sim: &str) -> Vec<Problem> {
    match load("", sim) {
        Err(ConfigError::Problems(problems)) => problems,
        other => panic!("expected problems: {other:?}"),
    }
}

/// Each entry of the table is a key of the file, and its value reaches the drive.
#[test]
fn every_quirk_can_be_written_in_a_machine_file() {
    for quirk in Quirks::TABLE {
        let (text, number) = match quirk.value {
            QuirkValue::Flag => ("true".into(), 1.0),
            QuirkValue::Time => ("\"10ms\"".into(), 10e6),
            QuirkValue::Factor => ("2.5".into(), 2.5),
            QuirkValue::Distance => ("1.5".into(), 3000.0),
            QuirkValue::Torque => ("-0.25".into(), -0.25),
            QuirkValue::Modes => ("[\"csv\", \"cst\"]".into(), f64::from(0x300)),
            QuirkValue::Whole(low, _) => (low.to_string(), f64::from(low)),
        };
        let mut wanted = Quirks::default();
        quirk.set(&mut wanted, number);
        assert_ne!(wanted, Quirks::default(), "{}", quirk.key);
        let line = format!("quirks = {{ {} = {text} }}", quirk.key);
        assert_eq!(quirks("", &line), wanted, "{line}");
    }
    assert_eq!(quirks("", ""), Quirks::default());
}

#[test]
fn distances_of_quirks_are_in_the_direction_of_the_axis() {
    let line = "quirks = { shift_after_enable = 1.5 }";
    assert_eq!(quirks("invert = true", line).shift_after_enable, -3000);
}

#[test]
#[rustfmt::skip] // one row per mistake
fn wrong_quirks_are_rejected() {
    for (sim, message) in [
        ("quirks = { bit12 = true }", "unknown key `bit12` in `quirks`"),
        ("quirks = { bit12_late = \"2min\" }", "`bit12_late` of 120 s is not possible"),
        ("quirks = { velocity_factor = 0 }", "`velocity_factor` of 0 is not possible"),
        ("quirks = { unsupported_modes = [\"vl\"] }", "`unsupported_modes` cannot be \"vl\""),
        ("quirks = { load_torque = 2000.0 }", "`load_torque` of 2000 N·m is not possible"),
        ("quirks = { torque_polarity_bit = 4 }", "from 5 to 7, found 4"),
        ("quirks = { shift_after_homing = 2e6 }", "2000000 exceeds 32 bits of counts"),
    ] {
        let found = problems(sim);
        assert!(found.iter().any(|p| p.message.contains(message)), "{sim}: {found:?}");
    }
}
