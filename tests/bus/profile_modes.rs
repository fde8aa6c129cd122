//! Axes whose device begins in PP or PV: the ESI's own module, moves, and stops. Virtual time.

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{assert_contains, faults, fixture, run_badly, run_well, virtual_time};

/// Three axes in PP, PV and CSP.
fn text(steps: &str) -> String {
    let mut text = String::from("[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n");
    for (position, (name, mode)) in [("x", "pp"), ("y", "pv"), ("z", "csp")].iter().enumerate() {
        text += &format!(
            "[[device]]\nname = \"{name}\"\nesi = \"esi/EPOS4.xml\"\nposition = {position}\nmode = \"{mode}\"\n[device.axis]\nencoder = 2000\n\
             limits = {{ velocity = 20.0, acceleration = 200.0, torque = 100.0, following_error = 0.5 }}\n"
        );
    }
    text + steps
}

#[test]
fn a_device_begins_in_a_profile_mode() {
    let steps = "[[step]]\nmove = { x = 10.0 }\nspeed = 0.5\n[[step]]\nvelocity = { y = 5.0 }\nramp = 0.4\n[[step]]\ndwell = \"300ms\"\n\
        [[step]]\nvelocity = { y = 0.0 }\n[[step]]\nmove_by = { x = -3.0 }\n";
    let machine = Bench::new().machine(&text(steps));
    let module = |device: usize| {
        let device = machine
            .devices
            .get(ecaxis_ecat::index::DeviceIndex(device))
            .expect("a device");
        device.selection.modules[0].type_name.clone()
    };
    assert_eq!([0, 1, 2].map(module), ["PPM", "PVM", "CSP"]);
    let summary = run_well(machine, virtual_time());
    let at: Vec<_> = summary
        .axes
        .iter()
        .map(|axis| axis.final_position)
        .collect();
    assert!((at[0] - 7.0).abs() < 0.01, "{at:?}");
    assert!(at[1] > 1.0, "{at:?}");
}

/// The axis in CSP fails while both others move: their drives stop, and have no power at the end.
#[test]
fn a_fault_of_another_axis_stops_profile_modes() {
    let steps = "[[step]]\nvelocity = { y = 15.0 }\n[[step]]\nmove = { x = 100.0, z = 50.0 }\n";
    let script = "[[fault]]\nkind = \"drive-fault\"\nat = \"1s\"\ndevice = 2\ncode = 0x2310\n";
    let bench = Bench::new();
    let (error, summary) = run_badly(bench.machine(&text(steps)), faults(script));
    assert_contains(&error, &["`z`", "0x2310"]);
    for axis in summary.expect("the cycle has run").axes {
        assert_ne!(axis.final_state, "Operation enabled");
    }
}

#[test]
fn what_a_profile_mode_cannot_do_is_refused() {
    let bench = Bench::new();
    for (steps, parts) in [
        ("[[step]]\nline = { x = 1.0 }\n", ["`line`", "mode \"pp\""]),
        (
            "[[step]]\nvelocity = { x = 1.0 }\n",
            ["`velocity`", "mode \"pp\""],
        ),
        ("[[step]]\nmove = { y = 1.0 }\n", ["`move`", "mode \"pv\""]),
    ] {
        assert_contains(&bench.parse(&text(steps)).expect_err(steps), &parts);
    }
    let fixed = text("").replace(
        "mode = \"pp\"\n",
        "mode = \"pp\"\npdo.rx = [\"0x6040\", \"0x607A\"]\n",
    );
    assert_contains(
        &bench.parse(&fixed).expect_err("no profile objects"),
        &[
            "mode \"pp\" needs 0x6081",
            "pdo.rx = [\"0x6040\", \"0x607A\", \"0x6081\"]",
        ],
    );
    let homing = text("").replace("mode = \"pp\"", "mode = \"hm\"");
    assert_contains(
        &bench.parse(&homing).expect_err("hm"),
        &["\"hm\"", "`home`"],
    );
}

/// The modules of the vendor's file.
#[test]
fn maxon_modules_are_taken() {
    let Some(esi) = fixture("esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml") else {
        return;
    };
    let bench = Bench::new();
    let steps = "[[step]]\nmove = { x = 2.0 }\n[[step]]\nvelocity = { y = 2.0 }\n[[step]]\nvelocity = { y = 0.0 }\n";
    let text = text(steps).replace("esi/EPOS4.xml", &esi.display().to_string());
    let summary = run_well(bench.machine(&text), virtual_time());
    assert!((summary.axes[0].final_position - 2.0).abs() < 0.01);
}
