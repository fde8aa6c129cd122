//! Drives that show their mode in Operation enabled only, or change it without power only.

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::session::Options;
use ecaxis_test_support::recordings::process_images;
use ecaxis_test_support::{
    assert_contains, faults, machine, recorded, run_badly, run_well, virtual_time,
};

/// Returns one drive with quirks and keys of its axis.
fn text(quirks: &str, keys: &str, steps: &str) -> String {
    format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\nposition = 0\n\
         mode = \"csp\"\n[device.axis]\nencoder = 2000\n\
         limits = {{ velocity = 20.0, acceleration = 200.0, torque = 100.0, following_error = 0.5 }}\n\
         homing = {{ method = 37 }}\n{keys}\n[device.sim]\nquirks = {{ {quirks} }}\n{steps}"
    )
}

const MOVE: &str = "[[step]]\nmove = { x = 2.0 }\n";
const SWITCH: &str = "[[step]]\nhome = [\"x\"]\n[[step]]\nmode = { x = \"csv\" }\n\
    [[step]]\nmode = { x = \"csp\" }\n[[step]]\nmove = { x = 2.0 }\n";

#[test]
fn drive_that_shows_its_mode_when_enabled_runs_with_its_key() {
    let quirk = "mode_shown_enabled = true";
    let (error, _) = run_badly(machine(&text(quirk, "", MOVE)), virtual_time());
    println!("{error}");
    assert_contains(
        &error,
        &["`x`", "stays in Switched on", "0x6061 shows mode"],
    );
    let key = "mode_display = \"enabled\"";
    let summary = run_well(machine(&text(quirk, key, MOVE)), virtual_time());
    assert!((summary.axes[0].final_position - 2.0).abs() < 0.01);

    let late = "mode_shown_enabled = true, mode_shown_late = \"3s\"";
    let key = "mode_display = \"enabled\"\nmode_time = \"100ms\"";
    let (error, _) = run_badly(machine(&text(late, key, MOVE)), virtual_time());
    println!("{error}");
    assert_contains(&error, &["`x`", "0x6061 shows mode"]);
}

#[test]
fn drive_that_changes_its_mode_without_power_runs_with_its_key() {
    let quirk = "mode_without_power = true";
    let (error, _) = run_badly(machine(&text(quirk, "", SWITCH)), virtual_time());
    println!("{error}");
    assert_contains(&error, &["`x`", "mode"]);
    for (quirk, key) in [
        (quirk, "mode_change = \"no-power\""),
        (
            "mode_without_power = true, mode_shown_enabled = true",
            "mode_change = \"no-power\"\nmode_display = \"enabled\"",
        ),
    ] {
        let summary = run_well(machine(&text(quirk, key, SWITCH)), virtual_time());
        let axis = &summary.axes[0];
        assert!((axis.final_position - 2.0).abs() < 0.01, "{quirk}");
        assert_eq!(axis.mode, "csp");
    }
}

const KEY: &str = "mode_change = \"no-power\"";

#[test]
fn step_mode_waits_for_the_brake_that_opens_again() {
    for release in ["30ms", "300ms"] {
        let keys = format!("{KEY}\nbrake = {{ release = \"{release}\", engage = \"40ms\" }}");
        let steps = "[[step]]\nmode = { x = \"csv\" }\n[[step]]\nvelocity = { x = 1.0 }\n\
            [[step]]\nvelocity = { x = 0.0 }\n[[step]]\nmode = { x = \"csp\" }\n\
            [[step]]\nhome = [\"x\"]\n[[step]]\nmove = { x = 2.0 }\n";
        let text = text("mode_without_power = true", &keys, steps);
        let summary = run_well(machine(&text), virtual_time());
        assert!((summary.axes[0].final_position - 2.0).abs() < 0.01);
    }
}

/// A change of the mode without power: the output is off from the command on that removes it.
#[test]
fn a_position_output_is_off_while_the_mode_changes_without_power() {
    let folder = tempfile::tempdir().expect("a folder");
    let output = "[[device]]\nname = \"io\"\nesi = \"esi/IO8.xml\"\nposition = 1\n\
        [[position_output]]\noutput = \"io.Output 1\"\naxis = \"x\"\nranges = [[-10.0, 10.0]]\n";
    let machine = machine(&text(
        "mode_without_power = true",
        KEY,
        &format!("{output}{SWITCH}"),
    ));
    let layout = &machine.devices[DeviceIndex(0)].selection.layout;
    let terminal = layout.rx_bytes().max(layout.tx_bytes());
    let (options, path) = recorded(virtual_time(), folder.path());
    run_well(machine, options);
    let images = process_images(&path);
    let outputs: Vec<(u16, bool)> = images
        .iter()
        .filter_map(|(out, _)| {
            Some((
                u16::from_le_bytes([out[0], out[1]]),
                out.get(terminal)? & 1 != 0,
            ))
        })
        .collect();
    let on = |word: u16| {
        outputs
            .iter()
            .filter(|(w, on)| *w & 0x0f == word && *on)
            .count()
    };
    assert!(on(0x0f) > 100, "on with power: {}", on(0x0f));
    for word in [0x00, 0x06, 0x07] {
        assert!(
            outputs.iter().any(|(w, _)| *w & 0x0f == word),
            "0x{word:02x} is sent"
        );
        assert_eq!(on(word), 0, "on with Controlword 0x{word:02x}");
    }
}

/// Safe torque off while the axis waits for the planned loss of power is not that loss.
#[test]
fn safe_torque_off_before_the_switch_stops_the_machine() {
    for at in [120, 160, 200, 230, 260] {
        let sto =
            format!("[[fault]]\nkind = \"sto\"\nat = \"{at}ms\"\nfor = \"200ms\"\ndevice = 0\n");
        let text = text("mode_without_power = true", KEY, SWITCH);
        let (error, _) = run_badly(machine(&text), faults(&sto));
        assert_contains(&error, &["`x`"]);
    }
}

#[test]
fn drive_that_keeps_its_power_fails_the_step() {
    let steps = [
        "[[step]]\nhome = [\"x\"]\n",
        "[[step]]\nmode = { x = \"csv\" }\n",
    ];
    for step in steps {
        let quirks = "mode_without_power = true, shutdown_ignored = true";
        let (error, _) = run_badly(machine(&text(quirks, KEY, step)), virtual_time());
        println!("{error}");
        assert_contains(&error, &["`x`"]);
    }
}

/// At rest in PV the drive reports up to 10 rpm, which is more than standstill for a cycle at times.
#[test]
fn a_noisy_velocity_at_rest_does_not_refuse_the_next_mode() {
    let axis = "[bus]\nnic = \"sim\"\ncycle = \"500us\"\n[[device]]\nname = \"x\"\nesi = \"esi/EPOS4.xml\"\n\
        position = 0\nmode = \"csp\"\n\
        pdo.rx = [\"0x6040\", \"0x6060\", \"0x607A\", \"0x60FF\", \"0x6071\", \"0x6081\", \"0x6083\", \"0x6084\"]\n\
        pdo.tx = [\"0x6041\", \"0x6061\", \"0x6064\", \"0x606C\", \"0x6077\"]\n\
        [device.axis]\nunit = \"mm\"\nencoder = 2000\nper_turn = 5.0\nmode_change = \"no-power\"\n\
        limits = { velocity = 80.0, acceleration = 1600.0, torque = 100.0, following_error = 4.0 }\n\
        homing = { method = 37 }\n[device.sim]\nquirks = { mode_without_power = true }\n";
    let steps = "[[step]]\nmode = { x = \"pv\" }\n[[step]]\nvelocity = { x = 48.0 }\n\
        [[step]]\nstop = [\"x\"]\n[[step]]\nmode = { x = \"csp\" }\n[[step]]\nhome = [\"x\"]\n";
    let text = format!("{axis}{}", steps.repeat(4));
    for seed in 0..8 {
        let options = Options {
            seed,
            ..virtual_time()
        };
        run_well(machine(&text), options);
    }
}
