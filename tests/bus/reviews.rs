//! Machine files from reviews of devices, files and stacks as they are (`ECAXIS_CASES`, `bus/`): each
//! kind with the command of its review and what it must answer.

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::program::Ran;
use ecaxis_test_support::{assert_contains, case, root};

/// Copies a folder of cases with our ESI files, which some machine files name.
fn folder(name: &str) -> Option<Bench> {
    let cases = case(&format!("bus/{name}"))?;
    let bench = Bench::new();
    for from in [root().join("configs/esi"), cases] {
        for entry in std::fs::read_dir(from).expect("a folder") {
            let path = entry.expect("an entry").path();
            let name = path.file_name().expect("a name");
            std::fs::copy(&path, bench.path().join(name)).expect("copied");
        }
    }
    Some(bench)
}

/// The arguments of a command, its exit code, texts that it prints and texts that it does not.
type Row = (
    &'static str,
    i32,
    &'static [&'static str],
    &'static [&'static str],
);

fn check(bench: &Bench, (arguments, code, parts, absent): Row) {
    let words: Vec<_> = arguments.split(' ').collect();
    let Ran {
        code: exit,
        out,
        err,
    } = bench.ecaxis(&words);
    let text = format!("{arguments}\n{out}{err}");
    assert_eq!(exit, code, "{text}");
    assert_contains(&text, parts);
    for part in absent {
        assert!(!text.contains(part), "`{part}` is in:\n{text}");
    }
}

const OP: &[&str] = &["all SubDevices in Op"];
const ONE_IN: &[&str] = &["0 bytes out, 1 in", "no problems"];

#[test]
fn files_of_the_review_come_up_or_say_why_not() {
    let Some(bench) = folder("files") else { return };
    let run = |file: &str| format!("run {file} --sim --virtual --for 300ms");
    for file in [
        // The direction of a SyncManager is that of its PDOs and its ControlByte, not its text.
        "k1a_sm_without_text.toml",
        "k1b_sm_without_text_with_fmmu.toml",
        "k1c_sm_with_own_text.toml",
        "k1d_drive_sm_without_text.toml",
        "k1e_input_sm_called_outputs.toml",
        "k1f_control.toml",
        "k6_empty_pdo_in_assignment.toml",
        "k7_pdo_index_twice.toml",
        "k9_initcmd_on_read_only.toml",
        "k11_f030_sub0_16bit.toml",
        "k12_control.toml",
        "k12_module_pdo_without_sm.toml",
        "k12b_no_pdoassign.toml",
        "k12c_device_pdo_without_sm.toml",
        "k13_initcmd_shorter_than_object.toml",
        "k15_no_coe_X1.toml",
        "k15_no_coe_X4.toml",
        "k15_oversampling_X1.toml",
        "k15_oversampling_X4.toml",
    ] {
        let run = run(file);
        let words: Vec<_> = run.split(' ').collect();
        let Ran { code, out, err } = bench.ecaxis(&words);
        assert_eq!(code, 0, "{file}: {out}{err}");
        assert_contains(&err, OP);
    }
    let rows: [Row; 16] = [
        (
            "esi show k2_list_of_three.xml --device 2",
            0,
            &["T2", "0x00000002"],
            &["N1", "N3"],
        ),
        (
            "run k4_target_sub4.toml --sim --virtual --repeat 1",
            2,
            &["mode csp needs 0x607A:00; line 10 maps 0x607A:04"],
            &[],
        ),
        (
            "run k4_control.toml --sim --virtual --repeat 1",
            0,
            &["10.0000 turn"],
            &[],
        ),
        (
            "check k5_no_controlword.toml",
            2,
            &["has no mode csp: no RxPdo of the ESI has the Controlword 0x6040"],
            &["offers"],
        ),
        (
            "esi check k8_not_xml.xml",
            2,
            &["not XML: there is no < at the start"],
            &["\u{1b}"],
        ),
        (
            "check k9_initcmd_on_read_only.toml",
            0,
            &[
                "note: InitCmd",
                "read-only in the dictionary; it is sent all the same",
            ],
            &[],
        ),
        (
            "check k13_initcmd_shorter_than_object.toml",
            0,
            &[
                "note: InitCmd",
                "1 bytes, the object has 2; it is sent all the same",
            ],
            &[],
        ),
        (
            "run k10_one_buffer_output.toml --sim --virtual --for 300ms --record r.pcapng",
            0,
            OP,
            &[],
        ),
        ("analyze r.pcapng", 0, &["1 B  0 B"], &["mailbox"]),
        ("check k12_control.toml", 0, ONE_IN, &[]),
        ("check k12_module_pdo_without_sm.toml", 0, ONE_IN, &[]),
        ("check k12b_no_pdoassign.toml", 0, ONE_IN, &[]),
        (
            "check k12c_device_pdo_without_sm.toml",
            0,
            &["1 byte out, 1 in"],
            &[],
        ),
        (
            "eni import k14_eni_cycle_only_in_dc.xml",
            0,
            &["cycle       = \"4ms\""],
            &["\"1ms\""],
        ),
        (
            "check k15_oversampling_X4.toml",
            0,
            &["0 bytes out, 8 in"],
            &[],
        ),
        ("check k15_no_coe_X4.toml", 0, &["0 bytes out, 8 in"], &[]),
    ];
    for row in rows {
        check(&bench, row);
    }
}

/// Public reports of other programs, rebuilt.
#[test]
fn reports_of_the_review_are_answered() {
    let refuse = "run m.toml --virtual --for 100ms --faults refuse.faults.toml";
    let rows: [(&str, &[Row]); 13] = [
        (
            "01-stale-assignment",
            &[("explain sparse.toml", 0, &["0x1c13:00  0x00"], &[])],
        ),
        (
            "02-empty-modules",
            &[
                ("check brackets.toml", 0, &["0 bytes out, 0 in"], &[]),
                (
                    "scan --sim empty.toml --esi MIO2.xml --write w.toml",
                    0,
                    &[],
                    &[],
                ),
                ("check w.toml", 0, &["0 bytes out, 0 in"], &[]),
                (
                    "compare w.toml --sim empty.toml",
                    0,
                    &["as in the file"],
                    &[],
                ),
                (
                    "compare brackets.toml --sim empty.toml",
                    0,
                    &["as in the file"],
                    &[],
                ),
            ],
        ),
        (
            "03-optional-io",
            &[
                ("check opt.toml", 0, &["1 in; optional", "no problems"], &[]),
                (
                    "check opt2.toml",
                    2,
                    &["the machine stops without `io`", "`devices = [\"io\"]`"],
                    &[],
                ),
                ("run opt.toml --virtual", 0, OP, &[]),
            ],
        ),
        (
            "06-wrong-terminal",
            &[
                (
                    "run m4.toml --virtual --for 100ms --faults swap.faults.toml",
                    1,
                    &[
                        "`in1` (position 1",
                        "describes 8 digital inputs",
                        "is 8 digital outputs",
                    ],
                    &["no longer", "missing"],
                ),
                (
                    "run drives.toml --virtual --for 100ms --faults drives.faults.toml",
                    1,
                    &["`x` (position 1", "describes EPOS4-class", "is IDX-class"],
                    &["missing"],
                ),
            ],
        ),
        (
            "07-complete-access-refused",
            &[(
                refuse,
                1,
                &["0x1c12:00", "complete access was refused", "0x06010004"],
                &[],
            )],
        ),
        (
            "08-sdo-contradicts-pdos",
            &[(
                "check m.toml",
                2,
                &[
                    "0x1c12:00",
                    "follows from `mode`, `modules`, `assignment` and `pdo`",
                ],
                &[],
            )],
        ),
        (
            "09-modules-differ",
            &[(
                refuse,
                0,
                &["0x0070", "(0xF030) differ from the detected ones (0xF050)"],
                &["`mode`"],
            )],
        ),
        (
            "10-sim-object-outside-dictionary",
            &[
                ("run own.toml --virtual --for 100ms", 0, OP, &[]),
                ("run initcmd.toml --virtual --for 100ms", 0, OP, &[]),
            ],
        ),
        (
            "11-returning-io-is-unknown",
            &[(
                "run m.toml --virtual --faults power.faults.toml",
                0,
                &["`io` (position 2, station 0x1002) is in Op again"],
                &["not in the machine file", "closed"],
            )],
        ),
        (
            "12-sii-without-pdos",
            &[
                (
                    "check nopdo.toml",
                    0,
                    &["the EEPROM image describes no PDO"],
                    &[],
                ),
                (
                    "check a6.toml",
                    0,
                    &["the EEPROM image describes no PDO"],
                    &[],
                ),
            ],
        ),
        (
            "14-device-over-one-frame",
            &[(
                "check BIGGER.toml",
                2,
                &["1680 bytes of process data do not fit"],
                &[],
            )],
        ),
        (
            "15-sync0-no-divisor",
            &[(
                "check m.toml",
                0,
                &["fixes the cycle of SYNC0 at 250 µs", "must be a multiple"],
                &[],
            )],
        ),
        (
            "16-ebus-current",
            &[(
                "check m.toml",
                0,
                &["take 300 mA, and it supplies 200 mA"],
                &[],
            )],
        ),
    ];
    for (name, rows) in rows {
        let Some(bench) = folder(&format!("reports/{name}")) else {
            return;
        };
        for row in rows {
            check(&bench, *row);
        }
    }
}
