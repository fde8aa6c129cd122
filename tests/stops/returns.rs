//! Devices that come back while the others stay in Op.

use ecaxis_axis::State;
use ecaxis_master::config::Machine;
use ecaxis_master::session::Progress;
use ecaxis_test_support::{Heard, faults, machine, run};

/// Drives in a line, each in a group of its own that the others survive.
fn line(count: usize, steps: &str) -> Machine {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for position in 0..count {
        let limits = "limits = { position = [-100.0, 100.0], velocity = 50.0, acceleration = 500.0, torque = 100.0, following_error = 1.0 }";
        text += &format!(
            "\n[[device]]\nname = \"a{position}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"csp\"\n\
             [device.axis]\nunit = \"turn\"\nper_turn = 1.0\nencoder = 2000\n{limits}\n\
             \n[[stop.group]]\nname = \"g{position}\"\naxes = [\"a{position}\"]\noutside = \"continue\"\n",
        );
    }
    machine(&(text + steps))
}

/// Returns name, time in ns and whether it had no power, of each device that returned.
fn returned(heard: &Heard) -> Vec<(String, u64, bool)> {
    let each = heard.0.iter().filter_map(|progress| match progress {
        Progress::DeviceReturned {
            device,
            after_ns,
            restarted,
        } => Some((device.name.clone(), *after_ns, *restarted)),
        _ => None,
    });
    each.collect()
}

const STEPS: &str = "\n[[step]]\nenable = true\n\n[[step]]\nmove = { a0 = 80.0 }\n\n[[step]]\nmove = { a0 = -80.0 }\n\
    \n[[step]]\nreset = [\"a1\", \"a2\"]\n\n[[step]]\nenable = [\"a1\", \"a2\"]\n\n[[step]]\nmove = { a0 = 1.0, a1 = 2.0, a2 = 3.0 }\n";

/// Every way to lose a device: without power, with a broken cable that cuts off the next one, and by
/// its own fall to SafeOp.
#[test]
fn lost_devices_return_and_move_by_command_only() {
    let off = "[[fault]]\nkind = \"power-off\"\ndevice = 2\nat = \"1.5s\"\nfor = \"500ms\"\n";
    let both = "[[fault]]\nkind = \"power-off\"\ndevice = 1\nat = \"1.5s\"\nfor = \"500ms\"\n";
    let cable =
        "[[fault]]\nkind = \"link-break\"\ndevice = 1\nport = 0\nat = \"1.5s\"\nfor = \"500ms\"\n";
    let watchdog = "[[fault]]\nkind = \"watchdog\"\ndevice = 2\nat = \"1.5s\"\n";
    let rows: [(&str, &[(&str, bool)]); 4] = [
        (off, &[("a2", true)]),
        (both, &[("a1", true), ("a2", false)]),
        (cable, &[("a1", false), ("a2", false)]),
        (watchdog, &[("a2", false)]),
    ];
    for (fault, expected) in rows {
        let (outcome, heard) = run(line(3, STEPS), faults(fault));
        let warnings = heard.warnings();
        let result = outcome.result;
        result.unwrap_or_else(|error| panic!("{fault}: {error}; {warnings:?}"));
        let found = returned(&heard);
        let mut names: Vec<_> = found
            .iter()
            .map(|(name, _, off)| (name.as_str(), *off))
            .collect();
        names.sort_unstable();
        assert_eq!(names, expected, "{fault}: {warnings:?}");
        for (name, after, _) in &found {
            assert!(*after < 3_000_000_000, "{name}: {after} ns");
        }
        let summary = outcome.summary.expect("a summary");
        for (axis, target) in summary.axes.iter().zip([1.0, 2.0, 3.0]) {
            assert_eq!(axis.target_position, target, "{fault}");
            assert!(
                axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
                "{axis:?}"
            );
        }
        // Without a command, a drive that has returned stays without power.
        let alone = STEPS.split("\n[[step]]\nreset").next().expect("a part");
        let (outcome, _) = run(line(3, alone), faults(fault));
        for axis in &outcome.summary.expect("a summary").axes[1..] {
            let idle = [State::SwitchOnDisabled, State::Fault].map(|state| state.to_string());
            assert!(idle.contains(&axis.final_state), "{fault}: {axis:?}");
        }
    }
}
