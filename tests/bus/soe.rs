//! Sercos drives (SoE) as axes, next to a CiA 402 drive on the simulated bus.

use ecaxis_axis::State;
use ecaxis_test_support::{load, run_well, virtual_time};

#[test]
fn sercos_axes_and_a_cia_402_axis_move_together() {
    let summary = run_well(load("sercos.toml"), virtual_time());
    assert_eq!(summary.counters.wkc_errors, 0);
    let names: Vec<&str> = summary.axes.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(names, ["x", "y", "z"]);
    for axis in &summary.axes {
        println!("{}: {} at the end", axis.name, axis.final_position);
        assert!(axis.final_position.abs() < 0.01, "{axis:?}");
        assert_eq!(axis.final_state, State::SwitchOnDisabled.to_string());
        assert_eq!((&axis.fault, &axis.trip), (&None, &None));
    }
}
