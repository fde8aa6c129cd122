//! Drives whose ESI files have one unusual element each (`esi/oddities.xml`): each reaches Op and
//! moves, and its registers have the values that the standards demand.

use std::path::Path;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_master::config::{self, Machine};
use ecaxis_test_support::recordings::{Datagram, FPWR, LRW, datagrams, process_images};
use ecaxis_test_support::{assert_contains, recorded, root, run, run_well, virtual_time};

/// One drive, alone on the bus at 1 ms.
struct Row {
    device: &'static str,
    mode: &'static str,
    axes: u16,
    /// Further keys of the device on the simulated bus.
    sim: &'static str,
    /// PDOs of the outputs in their order, and bytes of outputs and inputs.
    rx: &'static [u16],
    bytes: [usize; 2],
    /// Values that must be written to registers: the register, and the first bytes.
    written: &'static [(u16, &'static [u8])],
}

const ROW: Row = Row {
    device: "",
    mode: "csp",
    axes: 1,
    sim: "",
    rx: &[0x1600],
    bytes: [6, 6],
    written: &[],
};

/// FMMUs as ETG.1000.4 defines them: logical address (the same for both), length, bits, physical
/// address, bit, direction (2: outputs, 1: inputs), enabled.
const OUTPUTS_FMMU: &[u8] = &[0, 0, 1, 0, 6, 0, 0, 7, 0, 0x11, 0, 2, 1];
const INPUTS_FMMU: &[u8] = &[0, 0, 1, 0, 6, 0, 0, 7, 0, 0x12, 0, 1, 1];

/// SYNC0 and SYNC1 cycle (0x09A0, 0x09A4) by ETG.2000 and the ET1100 data sheet, section I, 9.2.3;
/// 0x0980: the second byte has cyclic operation (bit 0), SYNC0 (bit 1) and SYNC1 (bit 2).
const ROWS: &[Row] = &[
    // CiA 402: the drive has one Controlword. Of two PDOs with it, the one of the mode is assigned.
    Row {
        device: "replaced-controlword",
        rx: &[0x1601],
        ..ROW
    },
    Row {
        device: "replaced-controlword",
        mode: "csv",
        rx: &[0x1602],
        ..ROW
    },
    Row {
        device: "double-controlword",
        rx: &[0x1600, 0x1601],
        bytes: [8, 6],
        ..ROW
    },
    // ETG.2000: the PDOs of a SyncManager say what the missing FMMU maps.
    Row {
        device: "one-fmmu",
        written: &[(0x0600, OUTPUTS_FMMU), (0x0610, INPUTS_FMMU)],
        ..ROW
    },
    // ETG.1000.4: the direction is bits 2 and 3 of the control byte; ETG.2000: `Sm` of the PDOs.
    Row {
        device: "unnamed-sync-managers",
        written: &[(0x0600, OUTPUTS_FMMU), (0x0610, INPUTS_FMMU)],
        ..ROW
    },
    Row {
        device: "renamed-sync-managers",
        written: &[(0x0600, OUTPUTS_FMMU), (0x0610, INPUTS_FMMU)],
        ..ROW
    },
    Row {
        device: "dictionary-only",
        ..ROW
    },
    // ETG.1000.6, 6.4: the mailbox is enabled before PreOp.
    Row {
        device: "mailbox-disabled",
        written: &[
            (0x0800, &[0, 0x10, 0x80, 0, 0x26, 0, 1]),
            (0x0808, &[0x80, 0x10, 0x80, 0, 0x22, 0, 1]),
        ],
        ..ROW
    },
    Row {
        device: "opmode-without-pdo",
        written: &[(0x09a0, &1_000_000_u32.to_le_bytes()), (0x0980, &[0, 3])],
        ..ROW
    },
    // ETG.2000: the PDOs of an OpMode are assigned together.
    Row {
        device: "wrong-excludes",
        rx: &[0x1600, 0x1601],
        ..ROW
    },
    // CiA 402-1: the objects of axis n are 0x800 · (n − 1) later.
    Row {
        device: "two-axes",
        axes: 2,
        rx: &[0x1600, 0x1610],
        bytes: [12, 12],
        ..ROW
    },
    Row {
        device: "six-axes",
        axes: 6,
        rx: &[0x1600, 0x1610, 0x1620, 0x1630, 0x1640, 0x1650],
        bytes: [36, 36],
        ..ROW
    },
    // ETG.2000, `OpOnly`: disabled until Op is requested.
    Row {
        device: "op-only",
        written: &[
            (0x0810, &[0, 0x11, 6, 0, 0x64, 0, 0]),
            (0x0816, &[1]),
            (0x0816, &[0]),
        ],
        ..ROW
    },
    // ETG.2000, `StateMachine/Timeout`: the times of the device, not those of ETG.1020.
    Row {
        device: "op-within-200ms",
        sim: "state_change = \"150ms\"",
        ..ROW
    },
    Row {
        device: "op-within-30s",
        sim: "state_change = \"12s\"",
        ..ROW
    },
    Row {
        device: "sync0-twice",
        written: &[(0x09a0, &500_000_u32.to_le_bytes()), (0x0980, &[0, 3])],
        ..ROW
    },
    Row {
        device: "sync1-cycle",
        written: &[
            (0x09a0, &1_000_000_u32.to_le_bytes()),
            (0x09a4, &1_000_u32.to_le_bytes()),
            (0x0980, &[0, 7]),
        ],
        ..ROW
    },
    Row {
        device: "sync1-oversampling",
        written: &[
            (0x09a0, &250_000_u32.to_le_bytes()),
            (0x09a4, &750_000_u32.to_le_bytes()),
            (0x0980, &[0, 7]),
        ],
        ..ROW
    },
];

const TURN: i32 = 2_000;

/// Returns the machine of a row. Axis n moves n turns in CSP, and all turn at 5 turns/s in CSV.
fn machine(row: &Row) -> Machine {
    let esi = root().join("tests/bus/esi/oddities.xml");
    let mut text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"d\"\nesi = \"{}\"\ntype = \"{}\"\n\
         position = 0\nmode = \"{}\"\n[device.sim]\n{}\n",
        esi.display(),
        row.device,
        row.mode,
        row.sim,
    );
    let mut targets = Vec::new();
    for n in 1..=row.axes {
        text += &format!(
            "[[device.axis]]\nname = \"m{n}\"\nnumber = {n}\nunit = \"turn\"\nencoder = {TURN}\n\
             limits = {{ velocity = 20.0, acceleration = 200.0, following_error = 1.0 }}\n"
        );
        targets.push(format!("m{n} = {n}.0"));
    }
    text += &match row.mode {
        "csp" => format!("[[step]]\nmove = {{ {} }}\n", targets.join(", ")),
        _ => "[[step]]\nvelocity = { m1 = 5.0 }\n[[step]]\ndwell = \"300ms\"\n".to_owned(),
    };
    config::parse(Path::new("machine.toml"), &text)
        .unwrap_or_else(|e| panic!("{}: {e}", row.device))
}

/// Returns the writes to a register in their order.
fn written(datagrams: &[Datagram], register: u16) -> Vec<&[u8]> {
    let writes = datagrams
        .iter()
        .filter(|d| d.sent && d.command == FPWR && d.register() == register);
    writes.map(|d| &d.data[..]).collect()
}

/// Returns how far an axis has moved by its own inputs, in counts.
fn moved(machine: &Machine, datagrams: &[Datagram], axis: u16) -> i32 {
    let layout = &machine.devices[DeviceIndex(0)].selection.layout;
    let field = layout.tx_field(0x6064 + 0x800 * axis, 0).expect("mapped");
    let at = (field.bit_offset / 8) as usize;
    // ETG.1000.4: outputs count 2 and inputs 1. Without them, the data are those that were sent.
    let exchanged = datagrams
        .iter()
        .filter(|d| !d.sent && d.command == LRW && d.working_counter == 3);
    let mut positions = exchanged.map(|d| {
        let bytes = d.data[at..at + 4].try_into().expect("four bytes");
        i32::from_le_bytes(bytes)
    });
    let first = positions.next().expect("cycles");
    positions.next_back().expect("cycles") - first
}

#[test]
fn each_unusual_drive_reaches_op_and_moves() {
    for row in ROWS {
        let folder = tempfile::tempdir().expect("a folder");
        let (options, path) = recorded(virtual_time(), folder.path());
        let machine = machine(row);
        let selection = &machine.devices[DeviceIndex(0)].selection;
        let rx: Vec<u16> = selection.rx.iter().map(|pdo| pdo.index).collect();
        assert_eq!(rx, row.rx, "{}", row.device);
        let layout = &selection.layout;
        let bytes = [layout.rx_bytes(), layout.tx_bytes()];
        assert_eq!(bytes, row.bytes, "{}", row.device);

        let summary = run_well(machine.clone(), options);
        assert_eq!(summary.counters.wkc_errors, 0, "{}", row.device);
        let datagrams = datagrams(&path);
        for axis in 0..row.axes {
            let counts = moved(&machine, &datagrams, axis);
            let turned = f64::from(counts) / f64::from(TURN);
            println!(
                "{} {}: axis {} moved {turned} turns",
                row.device,
                row.mode,
                axis + 1
            );
            let (target, tolerance) = match row.mode {
                "csp" => (f64::from(axis + 1), 0.01),
                _ => (1.5, 0.3),
            };
            assert!((turned - target).abs() < tolerance, "{turned}");
        }
        for (register, value) in row.written {
            let writes = written(&datagrams, *register);
            let found = writes.iter().any(|data| data.starts_with(value));
            assert!(found, "{} 0x{register:04x}: {writes:02x?}", row.device);
        }
    }
}

/// CiA 402-2: the drive reads a Controlword that is mapped twice from either place.
#[test]
fn both_controlwords_of_a_drive_have_one_value() {
    let row = ROWS.iter().find(|row| row.device == "double-controlword");
    let folder = tempfile::tempdir().expect("a folder");
    let (options, path) = recorded(virtual_time(), folder.path());
    run_well(machine(row.expect("a row")), options);
    let images = process_images(&path);
    assert!(images.iter().all(|(sent, _)| sent[..2] == sent[2..4]));
    assert!(images.iter().any(|(sent, _)| sent[..2] == [0x0f, 0]));
}

/// ETG.2000: a drive that takes longer than its own time-out is named with that time.
#[test]
fn a_drive_slower_than_its_own_time_out_is_named() {
    let slow = Row {
        device: "op-within-200ms",
        sim: "state_change = \"250ms\"",
        ..ROW
    };
    let (outcome, _) = run(machine(&slow), virtual_time());
    let error = outcome.result.expect_err("too slow").to_string();
    assert_contains(&error, &["`d`", "did not reach SafeOp within 200 ms"]);
}
