//! Start-up SDOs: skipped, written, verified.

use ecaxis_esi::StartupSdo;
use ecaxis_master::acyclic::DeviceRef;
use ecaxis_master::bringup::{SdoOutcome, write_startup_sdo};
use ecaxis_master::config::StartupOptions;
use ecaxis_test_support::mailbox::fault_injection::Mischief;
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{STATION, block_on, client};

const HELD: (u16, u8) = (0x6065, 0);
const WRITE_ONLY: (u16, u8) = (0x2000, 1);

fn sdo((index, sub): (u16, u8), data: &[u8], name: &str) -> StartupSdo {
    StartupSdo {
        transition: "PS",
        index,
        sub,
        complete_access: false,
        data: data.to_vec(),
        name: name.to_owned(),
        origin: "a test".to_owned(),
        optional: false,
    }
}

/// Returns the result of one SDO, and how many requests the device received.
fn done(
    sdo: &StartupSdo,
    verify: bool,
    skip_equal: bool,
    mischief: &[Mischief],
) -> (Result<SdoOutcome, String>, usize) {
    let server = Server::new(
        48,
        &[
            (HELD.0, HELD.1, &[7, 0, 0, 0]),
            (WRITE_ONLY.0, WRITE_ONLY.1, &[0]),
        ],
        mischief,
    );
    let at = DeviceRef {
        name: "x".to_owned(),
        position: 0,
        station: STATION,
    };
    let way = StartupOptions { verify, skip_equal };
    let done = block_on(write_startup_sdo(&server, &at, &mut client(), sdo, way));
    (done.map_err(|error| error.to_string()), server.log().len())
}

#[test]
fn start_up_sdo_is_skipped_if_the_device_has_the_value() {
    let (same, other) = (sdo(HELD, &[7, 0, 0, 0], ""), sdo(HELD, &[8, 0, 0, 0], ""));
    assert_eq!(done(&same, false, true, &[]), (Ok(SdoOutcome::Held), 1));
    assert_eq!(done(&same, true, true, &[]), (Ok(SdoOutcome::Held), 1));
    assert_eq!(done(&same, false, false, &[]), (Ok(SdoOutcome::Written), 1));
    assert_eq!(done(&other, false, true, &[]), (Ok(SdoOutcome::Written), 2));
    assert_eq!(done(&other, true, true, &[]), (Ok(SdoOutcome::Written), 3));
}

#[test]
fn verification_failure_names_the_object() {
    let forgets = [Mischief::Forgetful];
    let known = sdo(HELD, &[8, 0, 0, 0], "");
    let (reported, _) = done(&known, true, false, &forgets);
    let reported = reported.expect_err("it holds another value");
    assert!(
        reported.contains("0x6065:00 (Following error window)")
            && reported.contains("0x00000008")
            && reported.contains("0x00000007"),
        "{reported}"
    );
    let named = sdo(HELD, &[8, 0, 0, 0], "Window");
    let reported = done(&named, true, false, &forgets).0.expect_err("likewise");
    assert!(reported.contains("0x6065:00 (Window)"), "{reported}");
    assert_eq!(
        done(&known, false, false, &forgets),
        (Ok(SdoOutcome::Written), 1)
    );
}

#[test]
fn unreadable_start_up_sdo_is_written_and_reported() {
    let secret = sdo(WRITE_ONLY, &[1], "");
    let hidden = [Mischief::WriteOnly(WRITE_ONLY.0)];
    assert_eq!(
        done(&secret, true, true, &hidden),
        (Ok(SdoOutcome::Unreadable), 3)
    );
}

#[test]
fn errors_name_the_object() {
    let missing = sdo((0x607d, 2), &[0; 4], "");
    let reported = done(&missing, false, false, &[])
        .0
        .expect_err("it is not there");
    assert!(
        reported.contains("0x607d:02 Max position limit"),
        "{reported}"
    );
}
