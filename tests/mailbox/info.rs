//! SDO Information: answers in any number of fragments, and their possible faults.

use ecaxis_master::mailbox::{
    CoeCause, CoeClient, EntryDescription, InfoError, InfoRequest, ObjectDescription, ObjectList,
    Phase, Timeouts,
};
use ecaxis_test_support::mailbox::describe::{entry_name, object_name};
use ecaxis_test_support::mailbox::fault_injection::{Mischief, emergency};
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{STATION, block_on, layout};

/// A server like a drive: 440 objects, some with subindices.
fn server(len: u16, mischief: &[Mischief]) -> Server {
    let objects: Vec<(u16, u8, &[u8])> = (0..440)
        .map(|n| (0x2000 + n, 0, &[1_u8, 2][..]))
        .chain([(0x2003, 1, &[1_u8; 4][..]), (0x2003, 7, &[9])])
        .collect();
    Server::new(len, &objects, mischief)
}

fn client(len: u16) -> CoeClient {
    CoeClient::new(layout(len)).with_timeouts(Timeouts {
        answer: std::time::Duration::from_millis(500),
        ..Timeouts::default()
    })
}

#[test]
fn lists_and_descriptions_come_through_mailboxes_of_every_size() {
    // With 15 data bytes, an index is split in every other fragment.
    for len in [16, 18, 27, 48, 49, 128, 1486] {
        let (server, mut client) = (server(len, &[]), client(len));
        let all = block_on(client.object_list(&server, ObjectList::All)).unwrap();
        assert_eq!(all, (0x2000..0x2000 + 440).collect::<Vec<u16>>(), "{len}");
        assert_eq!(block_on(client.list_lengths(&server)), Ok([440; 5]));
        assert_eq!(
            block_on(client.object_description(&server, 0x2003)),
            Ok(ObjectDescription {
                index: 0x2003,
                data_type: 7,
                max_sub: 7,
                code: 9,
                name: object_name(0x2003),
            })
        );
        assert_eq!(
            block_on(client.entry_description(&server, 0x2003, 1)),
            Ok(EntryDescription {
                index: 0x2003,
                sub: 1,
                data_type: 5,
                bit_len: 32,
                access: 0x13f,
                name: entry_name(0x2003, 1),
            })
        );
    }
}

/// Returns the error of the list. The next request must be answered.
fn list_error(mischief: &[Mischief]) -> InfoError {
    let (server, mut client) = (server(48, mischief), client(48));
    let error = block_on(client.object_list(&server, ObjectList::All)).unwrap_err();
    server.forgive();
    assert_eq!(
        block_on(client.upload(&server, 0x2000, 0, false)),
        Ok(vec![1, 2])
    );
    assert_eq!(block_on(client.list_lengths(&server)), Ok([440; 5]));
    error
}

#[test]
fn refusal_names_the_request() {
    let (server, mut client) = (server(48, &[]), client(48));
    let error = block_on(client.entry_description(&server, 0x2003, 2)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "station 0x1001: the description of 0x2003:02 was refused with 0x06090011: the subindex does not exist"
    );
    assert!(error.is_refusal());
    assert!(block_on(client.object_description(&server, 0x5fff)).is_err());
    assert_eq!(block_on(client.list_lengths(&server)), Ok([440; 5]));
}

#[test]
fn mailbox_without_sdo_info_refuses() {
    let error = list_error(&[Mischief::Replace(1, vec![4, 0, 0, 0, 0, 0x10, 1, 0, 4, 0])]);
    assert_eq!(
        error.to_string(),
        "station 0x1001: the list of all objects: the mailbox refused the request with 0x0004: the service is not supported"
    );
    let abort = [10, 0, 0, 0, 0, 0x13, 0, 0x30, 0x80, 0, 0, 0, 1, 0, 4, 5];
    let error = list_error(&[Mischief::Replace(1, abort.to_vec())]);
    assert_eq!(error.abort_code(), Some(0x0504_0001));
}

#[test]
fn missing_fragment_fails_the_list() {
    // 882 bytes in 25 fragments of 36; each time another fragment is missing.
    let skips = |first: u32| [0, 1, 2].map(|n| Mischief::Skip(first + 25 * n));
    let error = list_error(&[Mischief::Skip(3), Mischief::Skip(29), Mischief::Skip(62)]);
    assert!(
        error.to_string().contains("fragments to come where"),
        "{error}"
    );
    // Only a timeout reveals that the last fragment is missing.
    let error = list_error(&skips(25));
    assert_eq!(
        error,
        InfoError {
            station: STATION,
            asked: InfoRequest::List(ObjectList::All),
            cause: CoeCause::Timeout {
                phase: Phase::Answer,
                after: std::time::Duration::from_millis(500),
                set_aside: 0,
            },
        }
    );
}

#[test]
fn fragments_that_are_lost_are_repeated() {
    for mischief in [
        Mischief::LoseAnswer(4),
        Mischief::LoseFetch(4),
        Mischief::LoseRequestEcho(1),
        Mischief::LoseRequest(1),
        Mischief::FetchTwice(2),
        Mischief::Skip(3),
        Mischief::Skip(25),
        Mischief::Before(5, emergency(0x8611)),
    ] {
        let (server, mut client) = (server(48, std::slice::from_ref(&mischief)), client(48));
        let all = block_on(client.object_list(&server, ObjectList::All));
        assert_eq!(all.map(|all| all.len()), Ok(440), "{mischief:?}");
        let heard = usize::from(matches!(mischief, Mischief::Before(..)));
        assert_eq!(client.take_emergencies().count(), heard);
    }
}

#[test]
fn inconsistent_fragments_are_malformed() {
    let fragment = |left: u8, data: &[u8]| {
        let mut message = vec![
            6 + data.len() as u8,
            0,
            0,
            0,
            0,
            0x13,
            0,
            0x80,
            2,
            0,
            left,
            0,
        ];
        message.extend(data);
        message
    };
    for (mischief, part) in [
        // The second fragment again, a wrong count, a fragment without data, an error without a
        // code.
        (Mischief::Replace(2, fragment(24, &[1; 36])), "24 fragments"),
        (Mischief::Replace(2, fragment(23, &[])), "without data"),
        (
            Mischief::Replace(2, vec![6, 0, 0, 0, 0, 0x13, 0, 0x80, 7, 0, 0, 0]),
            "an error without its code",
        ),
        (
            Mischief::Replace(2, vec![4, 0, 0, 0, 0, 0x13, 0, 0x80, 2, 0]),
            "too short",
        ),
        (Mischief::Replace(25, fragment(0, &[1; 3])), "half an index"),
    ] {
        let error = list_error(std::slice::from_ref(&mischief));
        assert!(error.to_string().contains(part), "{mischief:?}: {error}");
    }
}

#[test]
fn answer_to_another_request_is_set_aside() {
    let other = [8, 0, 0, 0, 0, 0x13, 0, 0x80, 2, 0, 0, 0, 2, 0];
    let server = server(48, &[Mischief::Before(1, other.to_vec())]);
    let mut client = client(48);
    let all = block_on(client.object_list(&server, ObjectList::All));
    assert_eq!(all.map(|all| all.len()), Ok(440));
    assert_eq!(client.set_aside(), 1);
}

#[test]
fn silent_and_missing_devices_end_in_time() {
    for (mischief, phase) in [
        (Mischief::Mute, Phase::Answer),
        (Mischief::Deaf, Phase::Answer),
    ] {
        let error = list_error(std::slice::from_ref(&mischief));
        assert!(
            matches!(error.cause, CoeCause::Timeout { phase: p, .. } if p == phase),
            "{error}"
        );
    }
    let (server, mut client) = (server(48, &[Mischief::Off]), client(48));
    let error = block_on(client.list_lengths(&server)).unwrap_err();
    assert!(error.cause == CoeCause::Gone, "{error}");
    assert!(error.to_string().contains("does not answer"));
}
