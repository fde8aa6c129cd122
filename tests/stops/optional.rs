//! Optional devices: absent at the start, taken away and exchanged.

use ecaxis_test_support::program::run as ecaxis;
use ecaxis_test_support::{faults, load, root, run};

use super::returns::returned;

fn exchange() -> String {
    std::fs::read_to_string(root().join("configs/tool-changer.faults")).expect("a script")
}

#[test]
fn tools_are_exchanged_in_a_program() {
    let (outcome, heard) = run(load("tool-changer.toml"), faults(&exchange()));
    let warnings = heard.warnings();
    outcome
        .result
        .unwrap_or_else(|error| panic!("{error}: {warnings:?}"));
    assert_eq!(warnings, Vec::<String>::new());
    let mut names: Vec<_> = returned(&heard)
        .into_iter()
        .map(|(name, ..)| name)
        .collect();
    // Both drives of the mill come to Op together.
    names[1..3].sort_unstable();
    assert_eq!(names, ["drill", "mill", "tilt", "gripper"]);
    let summary = outcome.summary.expect("a summary");
    assert_eq!(summary.group_stops.len(), 0, "{:?}", summary.group_stops);
    let targets: Vec<_> = summary
        .axes
        .iter()
        .map(|axis| axis.target_position)
        .collect();
    assert_eq!(targets, [300.0, 3.0, 4.0, 30.0, 5.0]);
    let script = root().join("configs/tool-changer.faults");
    let arguments = ["run", "configs/tool-changer.toml", "--virtual", "--faults"];
    let script = script.to_str().expect("text");
    ecaxis(arguments.iter().chain([&script])).exits(0);
}

/// A tool is there at the start. If it is taken away with power, the run has failed.
#[test]
fn tool_that_is_taken_away_with_power_is_a_failure() {
    let mut machine = load("tool-changer.toml");
    let enabled = |step: &ecaxis_master::config::Step| {
        matches!(&step.action, ecaxis_master::config::Action::Disable { .. })
    };
    let at = machine.steps.iter().position(enabled).expect("a step");
    machine.steps.truncate(at);
    let last = machine.steps[1].clone();
    machine.steps.push(ecaxis_master::config::Step {
        action: ecaxis_master::config::Action::Dwell { ns: 8_000_000_000 },
        uses: Vec::new(),
        ..last
    });
    let script = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"6s\"\n\
                  [[fault]]\nkind = \"absent\"\ndevice = 2\n[[fault]]\nkind = \"absent\"\ndevice = 3\n\
                  [[fault]]\nkind = \"absent\"\ndevice = 4\n";
    let (outcome, heard) = run(machine, faults(script));
    assert_eq!(returned(&heard), [], "the drill was there");
    let summary = outcome.summary.expect("a summary");
    let stops: Vec<_> = summary
        .group_stops
        .iter()
        .map(|s| (s.group.as_str(), s.released))
        .collect();
    assert_eq!(stops, [("drill", false)]);
}
