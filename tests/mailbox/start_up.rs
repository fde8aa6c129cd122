//! Start-up SDOs: skipped, written, verified.

use ecaxis_esi::model::{Access, Object, ObjectItem, Writable};
use ecaxis_esi::{Dictionary, StartupSdo};
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
    let dictionary = Dictionary::default();
    let mut client = client();
    let written = write_startup_sdo(&server, &at, &mut client, sdo, way, &dictionary);
    let done = block_on(written);
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

/// A record of two settings, as the ESI describes it.
fn record(index: u16) -> Dictionary {
    let item = |sub, bit_offset, bit_len, write| ObjectItem {
        sub,
        bit_offset,
        bit_len,
        access: Access { read: true, write },
        ..ObjectItem::default()
    };
    let items = vec![
        item(0, 0, 8, Writable::Never),
        item(1, 16, 16, Writable::Always),
        item(2, 32, 32, Writable::Always),
    ];
    let object = Object {
        index,
        items,
        ..Object::default()
    };
    Dictionary {
        objects: vec![object],
    }
}

/// Some firmware declares complete access in its ESI and refuses it, with any code.
#[test]
fn refused_complete_access_is_written_by_subindices() {
    let whole = |index: u16, data: &[u8]| StartupSdo {
        complete_access: true,
        ..sdo((index, 0), data, "")
    };
    let list: &[(u16, u8, &[u8])] = &[
        (0x1c12, 0, &[1]),
        (0x1c12, 1, &[0x05, 0x16]),
        (0x1c12, 2, &[0, 0]),
        (0x2010, 0, &[2]),
        (0x2010, 1, &[0, 0]),
        (0x2010, 2, &[0; 4]),
    ];
    for code in [0x0601_0000, 0x0601_0004, 0x0504_0001, 0x0800_0000] {
        for (sdo, written) in [
            (
                whole(0x1c12, &[2, 0, 0x00, 0x16, 0x01, 0x16]),
                vec![(0, vec![2]), (1, vec![0x00, 0x16]), (2, vec![0x01, 0x16])],
            ),
            (whole(0x1c12, &[0, 0]), vec![(0, vec![0])]),
            (
                whole(0x2010, &[2, 0, 1, 2, 3, 4, 5, 6]),
                vec![(0, vec![2]), (1, vec![1, 2]), (2, vec![3, 4, 5, 6])],
            ),
        ] {
            let server = Server::new(48, list, &[Mischief::NoCompleteAccess(code)]);
            let at = DeviceRef {
                name: "x".to_owned(),
                position: 0,
                station: STATION,
            };
            let mut client = client();
            let way = StartupOptions {
                verify: true,
                skip_equal: false,
            };
            let dictionary = record(0x2010);
            let outcome = write_startup_sdo(&server, &at, &mut client, &sdo, way, &dictionary);
            let outcome = block_on(outcome).map_err(|error| error.to_string());
            assert_eq!(outcome, Ok(SdoOutcome::BySubindex(code)), "{sdo:?}");
            for (sub, data) in written {
                let held = block_on(client.upload(&server, sdo.index, sub, false));
                assert_eq!(held.ok(), Some(data), "0x{:04x}:{sub:02x}", sdo.index);
            }
        }
    }
    // Without a description, the device's own refusal is reported.
    let unknown = whole(0x2011, &[1, 0, 9]);
    let (reported, requests) = done(&unknown, false, false, &[Mischief::NoCompleteAccess(1)]);
    assert!(reported.is_err());
    assert_eq!(requests, 1);
}
