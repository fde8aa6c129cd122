//! `ecaxis firmware update` on devices that refuse files or are busy (`docs/drive.md`, "Quirks").

use ecaxis_test_support::assert_contains;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::program::Ran;

/// Updates a drive with a quirk from a sample file.
fn update(quirk: &str) -> Ran {
    let bench = Bench::new();
    bench.copy("demo.toml", "machine.toml");
    let machine = bench.read("machine.toml").replacen(
        "[device.axis]",
        &format!("[device.sim]\nquirks = {{ {quirk} }}\n[device.axis]"),
        1,
    );
    bench.write("machine.toml", &machine);
    let size = ["--size", "2KiB"];
    bench.well(
        &[
            &["firmware", "sample", "machine.toml", "x", "-o", "new.bin"],
            &size[..],
        ]
        .concat(),
    );
    let words = ["firmware", "update", "machine.toml", "x", "new.bin"];
    bench.ecaxis(&[&words[..], &["--sim", "--virtual", "--yes"]].concat())
}

#[test]
fn a_refused_file_is_an_error_with_device_step_file_code_and_hint() {
    for (quirk, code, text, hint) in [
        ("foe_disk_full", "0x8003", "disk full", "program memory"),
        ("foe_illegal", "0x8004", "illegal", "--via program"),
    ] {
        let ran = update(&format!("{quirk} = true"));
        assert_eq!(ran.code, 1, "{quirk}");
        let device = ["`x` (position 0", "sending the file", "`new.bin`"];
        assert_contains(&ran.err, &device);
        assert_contains(&ran.err, &[code, text, "= help:", hint]);
    }
}

/// The client waits up to 120 s, with a progress report, and the update succeeds.
#[test]
fn a_device_that_is_busy_for_seconds_gets_the_file() {
    let ran = update("foe_busy = \"20s\"").exits(0);
    assert_contains(&ran.err, &["100 %"]);
}
