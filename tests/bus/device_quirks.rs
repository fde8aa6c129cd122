//! ecaxis on devices whose mailbox or inputs differ from the standard (`docs/drive.md`, "Quirks"): they
//! reach Op, or the run ends with an error that names device, step, object and code.

use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{Heard, assert_contains, run, virtual_time};

/// Runs a drive that moves, or a modular I/O device, with a quirk. Returns the error.
fn run_with(esi: &str, quirk: &str) -> (Result<(), String>, Heard) {
    let axis = |encoder: u32| {
        format!(
            "[device.axis]\nunit = \"turn\"\nencoder = {encoder}\n\
             limits = {{ velocity = 20.0, acceleration = 100.0, following_error = 1.0 }}\n\
             [[step]]\nmove = {{ z = 1.0 }}\n"
        )
    };
    let (mode, rest) = match esi {
        "SV1" => ("mode = \"csp\"\n", axis(131_072)),
        "EPOS4" => ("mode = \"csp\"\n", axis(2000)),
        _ => ("", "[[step]]\ndwell = \"100ms\"\n".to_owned()),
    };
    let text = format!(
        "[bus]\nnic = \"sim\"\ncycle = \"1ms\"\n[[device]]\nname = \"z\"\nesi = \"esi/{esi}.xml\"\n\
         position = 0\n{mode}[device.sim]\nquirks = {{ {quirk} }}\n{rest}"
    );
    let (outcome, heard) = run(Bench::new().machine(&text), virtual_time());
    (outcome.result.map_err(|error| error.to_string()), heard)
}

#[track_caller]
fn runs(esi: &str, quirk: &str) -> Heard {
    let (result, heard) = run_with(esi, quirk);
    assert_eq!(result, Ok(()), "{esi}, {quirk}");
    heard
}

#[track_caller]
fn fails(esi: &str, quirk: &str, parts: &[&str]) {
    let (result, _) = run_with(esi, quirk);
    let error = result.expect_err(quirk);
    assert_contains(&error, &["`z` (position 0, station 0x1000)"]);
    assert_contains(&error, parts);
}

#[test]
fn messages_of_a_device_between_answers_delay_nothing() {
    for esi in ["SV1", "EPOS4", "MIO2"] {
        let heard = runs(esi, "unsolicited_emergencies = true");
        let texts: Vec<String> = heard.0.iter().map(|p| format!("{p:?}")).collect();
        let emergencies = texts.iter().filter(|text| text.contains("Emergency"));
        assert!(emergencies.count() > 3, "{esi}: {texts:?}");
        runs(esi, "unsolicited_requests = true");
    }
}

/// The default time-out is 6 s (`mailbox::Timeouts`).
#[test]
fn a_mailbox_that_answers_late_is_waited_for_until_the_time_out() {
    for (esi, object) in [("SV1", "0x60c2:01"), ("EPOS4", "0xf030:00")] {
        runs(esi, "mailbox_late = \"5s\"");
        let parts = ["start-up SDO", object, "no answer came within 6s"];
        fails(esi, "mailbox_late = \"7s\"", &parts);
    }
}

#[test]
fn a_missing_last_subindex_does_not_prevent_op() {
    for esi in ["SV1", "EPOS4", "MIO2"] {
        runs(esi, "last_subindex_missing = true");
    }
}

/// Where the assignment is fixed, it cannot be read back and need not; where it is written, the refusal
/// ends bring-up. Before, the unreadable list counted as empty and as another layout.
#[test]
fn an_assignment_without_subindices_stops_bring_up_where_it_is_written() {
    let quirk = "assignment_subindices_missing = true";
    runs("SV1", quirk);
    let refused = "0x06090011: the subindex does not exist";
    fails(
        "EPOS4",
        quirk,
        &["start-up SDO 0x1c12:01", "0x1600", refused],
    );
    fails("MIO2", quirk, &["start-up SDO 0x1c12:01", refused]);
}

/// The working counter is 2 of 3. Before, the error named no device.
#[test]
fn a_device_that_does_not_fill_its_inputs_is_named_before_op() {
    for (esi, sm) in [
        ("SV1", "SyncManager 3 (0x1300, 13 bytes)"),
        ("EPOS4", "SyncManager 3 (0x1180, "),
    ] {
        let parts = ["does not fill its inputs", sm, "working counter"];
        fails(esi, "inputs_unfilled = true", &parts);
    }
}
