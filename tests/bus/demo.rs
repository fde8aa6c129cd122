//! The main function on the simulated bus in virtual time: from a machine file to moving axes.

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::acyclic::AlState;
use ecaxis_master::bringup::Step;
use ecaxis_master::session::{Options, Progress};
use ecaxis_test_support::{axes, fixture, load, machine, run, run_well, virtual_time};

#[test]
fn the_demo_moves_both_axes_ten_turns_and_back_twice() {
    let summary = run_well(load("demo.toml"), virtual_time());
    assert_eq!(summary.program_runs, 2);
    assert_eq!(summary.axes.len(), 2);
    for axis in &summary.axes {
        assert!(axis.was_enabled, "{axis:?}");
        assert_eq!(axis.target_position, 0.0, "{axis:?}");
        let error = axis.final_error_counts.expect("CSP reports its error");
        assert!(error.abs() <= 1, "{axis:?}");
        assert!(
            axis.largest_following_error > 0.0,
            "an axis that moved has followed: {axis:?}"
        );
        assert_eq!((&axis.fault, &axis.trip), (&None, &None));
    }
    assert_eq!(summary.counters.lost_frames, 0);
    assert_eq!(summary.counters.wkc_errors, 0);
    let phase = summary
        .dc_phase_error
        .expect("the demo uses distributed clocks");
    assert!(
        phase.p99_ns < 10_000,
        "locked to SYNC0 within a hundredth of the cycle: {phase:?}"
    );
}

#[test]
fn three_axes_move_in_their_own_modes() {
    let summary = run_well(load("modes.toml"), virtual_time());
    let modes: Vec<_> = summary.axes.iter().map(|axis| axis.mode.as_str()).collect();
    assert_eq!(modes, ["csp", "csv", "cst"]);
    for axis in &summary.axes {
        // The axis is enabled only while 0x6061 displays its mode.
        assert!(axis.was_enabled, "{axis:?}");
    }
}

/// Terminals without mailbox, mode or axis next to a drive are mapped and exchanged in each cycle.
#[test]
fn a_coupler_and_terminals_work_next_to_an_axis() {
    let machine = load("terminals.toml");
    let names: Vec<_> = machine.devices.iter().map(|d| d.name.as_str()).collect();
    assert_eq!(
        names,
        ["coupler", "switches", "valves", "doors", "lamps", "x"]
    );
    let summary = run_well(machine, virtual_time());
    assert_eq!(summary.devices, 6);
    assert_eq!(summary.counters.wkc_errors, 0);
    assert_eq!(summary.counters.lost_frames, 0);
    assert_eq!(summary.axes.len(), 1);
    assert_eq!(summary.axes[0].final_error_counts, Some(0), "{summary:?}");
}

/// The MainDevice treats a gateway without axes as bytes.
#[test]
fn a_gateway_with_nodes_works_next_to_an_axis() {
    let machine = load("gateway.toml");
    let gateway = machine.devices[DeviceIndex(0)]
        .sim
        .gateway
        .as_ref()
        .expect("[[device.node]]");
    let nodes: Vec<_> = gateway
        .nodes
        .iter()
        .map(|node| (node.id, node.drive.name()))
        .collect();
    assert_eq!(
        nodes,
        [(1, "EPOS 24/1"), (2, "EPOS 24/5"), (100, "EPOS 70/10")]
    );
    assert!(machine.devices[DeviceIndex(1)].sim.gateway.is_none());
    let summary = run_well(machine, virtual_time());
    assert_eq!(summary.counters.wkc_errors, 0);
    assert_eq!(summary.axes[0].final_error_counts, Some(0), "{summary:?}");
}

#[test]
fn every_axis_of_the_modes_machine_moves() {
    let (outcome, heard) = run(load("modes.toml"), virtual_time());
    outcome.result.expect("runs");
    let mut largest = [0.0_f64; 3];
    for progress in &heard.0 {
        if let Progress::Status(status) = progress {
            for (largest, axis) in largest.iter_mut().zip(&status.axes) {
                *largest = largest.max(axis.position.abs());
            }
        }
    }
    assert!(largest.iter().all(|moved| *moved > 0.1), "{largest:?}");
}

/// Uses the vendor's own ESI with its slots and modules.
#[test]
fn the_vendor_esi_works_in_each_cyclic_mode() {
    let Some(esi) = fixture("esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml") else {
        return;
    };
    for (mode, step, limits) in [
        ("csp", "move = { x = 10.0 }", "position = [-50.0, 50.0],"),
        ("csv", "velocity = { x = 20.0 }", ""),
        ("cst", "torque = { x = 5.0 }", ""),
    ] {
        let text = format!(
            r#"
            [bus]
            nic = "sim"
            cycle = "1ms"
            [[device]]
            name = "x"
            esi = "{}"
            position = 0
            mode = "{mode}"
            [device.axis]
            unit = "turn"
            per_turn = 1.0
            encoder = 2000
            limits = {{ {limits} velocity = 50.0, acceleration = 200.0, torque = 100.0 }}
            [[step]]
            {step}
            [[step]]
            dwell = "1500ms"
            "#,
            esi.display()
        );
        let (outcome, heard) = run(machine(&text), virtual_time());
        outcome.result.expect("the program runs");
        let summary = outcome.summary.expect("a summary");
        let axis = &summary.axes[0];
        assert!(axis.was_enabled, "{mode}: {axis:?}");
        let last = heard.0.iter().rev().find_map(|progress| match progress {
            Progress::Status(status) => Some(status.axes[0].clone()),
            _ => None,
        });
        let last = last.expect("a status a second");
        match mode {
            "csv" => assert!((last.velocity - 20.0).abs() < 0.4, "{last:?}"),
            "cst" => assert!(
                (last.torque - 5.0).abs() < 1.0 && last.velocity > 1.0,
                "{last:?}"
            ),
            _ => {}
        }
        if mode == "csp" {
            assert!(
                axis.final_error_counts.is_some_and(|e| e.abs() <= 1),
                "{axis:?}"
            );
            assert!((axis.final_position - 10.0).abs() < 0.001, "{axis:?}");
        }
    }
}

/// The application notes' `SetupDriveCommandingCSP`, object by object: clear assignments, rewrite
/// one PDO per direction, empty the other three, assign again, 1 ms, mode 8.
#[test]
fn the_vendor_startup_list_matches_the_application_notes() {
    let Some(esi) = fixture("esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml") else {
        return;
    };
    let text = axes(1).replace("esi/EPOS4.xml", &esi.display().to_string());
    let machine = machine(&text);
    let list: Vec<_> = machine.devices[DeviceIndex(0)]
        .selection
        .startup
        .iter()
        .map(|sdo| {
            let value = sdo
                .data
                .iter()
                .rev()
                .fold(0_u64, |v, b| v << 8 | u64::from(*b));
            (sdo.index, sdo.sub, value)
        })
        .collect();
    let at = |wanted: (u16, u8, u64)| {
        list.iter()
            .position(|sdo| *sdo == wanted)
            .unwrap_or_else(|| panic!("{wanted:x?} in {list:x?}"))
    };
    let last = |index, sub| {
        list.iter()
            .rev()
            .find(|s| s.0 == index && s.1 == sub)
            .map(|s| s.2)
    };

    for sm in [0x1c12, 0x1c13] {
        let cleared = at((sm, 0, 0));
        let assigned = at((sm, 0, 1));
        assert!(cleared < assigned);
        let pdo = if sm == 0x1c12 { 0x1600 } else { 0x1a00 };
        assert!(at((sm, 1, pdo)) < assigned);
        // Contents change only while nothing is assigned and the PDO has no entries.
        let emptied = at((pdo as u16, 0, 0));
        let first_entry = list
            .iter()
            .position(|s| s.0 == pdo as u16 && s.1 == 1)
            .expect("an entry");
        assert!(cleared < emptied && emptied < first_entry && first_entry < at((sm, 1, pdo)));
    }
    assert_eq!(last(0x1600, 1), Some(0x6040_0010));
    assert_eq!(last(0x1600, 2), Some(0x607a_0020));
    assert_eq!(last(0x1a00, 1), Some(0x6041_0010));
    assert_eq!(last(0x1a00, 2), Some(0x6064_0020));
    for other in [0x1601, 0x1602, 0x1603, 0x1a01, 0x1a02, 0x1a03] {
        assert_eq!(last(other, 0), Some(0), "0x{other:04x} is emptied");
    }
    assert_eq!(last(0x60c2, 1), Some(1), "1 ms");
    assert_eq!(last(0x6060, 0), Some(8), "CSP");
}

/// A device whose ESI requires a command between SafeOp and Op receives it in SafeOp. Earlier
/// commands are sent in PreOp.
#[test]
fn startup_commands_wait_for_their_transition() {
    let Some(esi) = fixture("esi/hpmicro/ECAT_CIA402.xml") else {
        return;
    };
    let text = axes(1).replace("esi/EPOS4.xml", &esi.display().to_string());
    let machine = machine(&text);
    let count = |late: bool| {
        let list = &machine.devices[DeviceIndex(0)].selection.startup;
        list.iter()
            .filter(|sdo| (sdo.transition == "SO") == late)
            .count()
    };
    let (early, late) = (count(false), count(true));
    assert!(late > 0, "this ESI has InitCmds of SafeOp → Op");
    let (outcome, heard) = run(machine, virtual_time());
    outcome.result.expect("runs");
    let mut safe_op = false;
    let mut sent = (0, 0);
    for progress in &heard.0 {
        match progress {
            Progress::Step(Step::State(AlState::SafeOp)) => safe_op = true,
            Progress::Step(Step::StartUp { .. }) if safe_op => sent.1 += 1,
            Progress::Step(Step::StartUp { .. }) => sent.0 += 1,
            _ => {}
        }
    }
    assert_eq!(sent, (early, late));
}

#[test]
fn the_same_seed_gives_the_same_summary_and_the_same_recording() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let run = |name: &str, seed| {
        let record = folder.path().join(name);
        let limit = Some(20_000_000_000);
        let options = Options {
            seed,
            limit,
            record: Some(record.clone()),
            ..virtual_time()
        };
        let summary = run_well(load("demo.toml"), options);
        assert!(summary.machine_seconds > 20.0, "{summary:?}");
        let json = serde_json::to_string(&summary).expect("a summary is JSON");
        (json, std::fs::read(record).expect("the recording"))
    };
    let first = run("first.pcapng", 7);
    let second = run("second.pcapng", 7);
    assert_eq!(first.0, second.0);
    assert!(first.1.len() > 1_000_000, "{} bytes", first.1.len());
    assert!(first.1 == second.1, "the recordings differ");
}

#[test]
fn bus_positions_may_differ_from_the_file_order() {
    let text = axes(3)
        .replace("position = 0", "position = 9")
        .replace("position = 2", "position = 0");
    let summary = run_well(
        machine(&text.replace("position = 9", "position = 2")),
        virtual_time(),
    );
    assert_eq!(summary.axes.len(), 3);
    assert!(
        summary
            .axes
            .iter()
            .all(|a| a.final_error_counts.is_some_and(|e| e.abs() <= 1))
    );
}

/// ETG.1020, "Explicit Device ID": AL control bit 5 requests the identification, the AL status code
/// contains it.
#[test]
fn a_device_is_found_by_its_explicit_identification() {
    let text = axes(3).replace("position = 1", "id = 77");
    let summary = run_well(machine(&text), virtual_time());
    assert_eq!(summary.axes.len(), 3);
}
