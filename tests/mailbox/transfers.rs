//! Transfers that succeed.

use ecaxis_master::mailbox::CoeClient;
use ecaxis_test_support::mailbox::fault_injection::{Mischief, emergency};
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{block_on, client, layout};

fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|n| u8::try_from(n % 251).unwrap()).collect()
}

const IDENTITY: &[(u16, u8, &[u8])] = &[
    (0x1018, 0, &[4]),
    (0x1018, 1, &[0xfb, 0, 0, 0]),
    (0x1018, 2, &[0, 0, 0x50, 0x63]),
    (0x1018, 3, &[1, 0, 0x70, 1]),
    (0x1018, 4, &[9, 8, 7, 6]),
];

#[test]
fn every_length_round_trips_through_mailboxes_of_every_size() {
    for mailbox in [16u16, 17, 24, 48, 128, 512] {
        for len in (0..=70).chain([111, 112, 113, 400, 1000]) {
            let data = bytes(len);
            let server = Server::new(mailbox, &[(0x2000, 1, &data), (0x2000, 2, &[])], &[]);
            let mut client = CoeClient::new(layout(mailbox));
            block_on(async {
                assert_eq!(
                    client.upload(&server, 0x2000, 1, false).await.unwrap(),
                    data,
                    "{mailbox} {len}"
                );
                client
                    .download(&server, 0x2000, 2, false, &data)
                    .await
                    .unwrap();
                assert_eq!(server.object(0x2000, 2).unwrap(), data, "{mailbox} {len}");
            });
            assert_eq!(client.set_aside(), 0);
        }
    }
}

#[test]
fn expedited_download_matches_the_standard() {
    let server = Server::new(48, &[(0x6060, 0, &[0])], &[]);
    block_on(client().download(&server, 0x6060, 0, false, &[8])).unwrap();
    // ETG.1000.6 "SDO download expedited": CoE service 2, command 0x2f for one byte.
    assert_eq!(
        server.log(),
        [[0x00, 0x20, 0x2f, 0x60, 0x60, 0x00, 8, 0, 0, 0]]
    );
}

#[test]
fn complete_access_reads_and_writes_a_whole_record() {
    let server = Server::new(48, IDENTITY, &[]);
    let mut client = client();
    block_on(async {
        let whole = client.upload(&server, 0x1018, 0, true).await.unwrap();
        assert_eq!(whole.len(), 18);
        assert_eq!(whole[..6], [4, 0, 0xfb, 0, 0, 0]);
        let from_1 = client.upload(&server, 0x1018, 1, true).await.unwrap();
        assert_eq!(whole[2..], from_1);
        let mut changed = whole.clone();
        changed[2] = 0x55;
        client
            .download(&server, 0x1018, 0, true, &changed)
            .await
            .unwrap();
        assert_eq!(server.object(0x1018, 1).unwrap(), [0x55, 0, 0, 0]);
        // Short data is not sent expedited with complete access.
        client
            .download(&server, 0x1018, 4, true, &[1, 2, 3, 4])
            .await
            .unwrap();
        assert_eq!(server.object(0x1018, 4).unwrap(), [1, 2, 3, 4]);
    });
    assert_eq!(server.log().last().unwrap()[2], 0x31);
}

#[test]
fn the_mailbox_counter_goes_from_1_to_7_and_never_repeats() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 0x02])], &[]);
    let mut client = client();
    for _ in 0..20 {
        // The server would drop a repeated counter as a duplicate, and this upload would time out.
        assert_eq!(
            block_on(client.upload(&server, 0x6041, 0, false)).unwrap(),
            [0x37, 0x02]
        );
    }
    assert_eq!(server.log().len(), 20);
}

#[test]
fn emergencies_in_the_middle_are_kept_in_order() {
    let data = bytes(100);
    let mischief = [
        Mischief::Before(1, emergency(0x8611)),
        Mischief::Before(2, emergency(0x7320)),
        Mischief::Before(3, emergency(0x0000)),
    ];
    let server = Server::new(48, &[(0x2000, 0, &data)], &mischief);
    server.say(&emergency(0x2310));
    let mut client = client();
    assert_eq!(
        block_on(client.upload(&server, 0x2000, 0, false)).unwrap(),
        data
    );
    let codes: Vec<_> = client.take_emergencies().map(|e| e.code).collect();
    assert_eq!(codes, [0x2310, 0x8611, 0x7320, 0x0000]);
    assert_eq!(client.take_emergencies().count(), 0);
    assert_eq!(client.set_aside(), 0);
}

#[test]
fn emergency_queue_keeps_the_first_and_counts_the_rest() {
    let server = Server::new(48, &[], &[]);
    for code in 0x1000..0x1000 + 40 {
        server.say(&emergency(code));
    }
    let mut client = client();
    assert_eq!(block_on(client.drain(&server)).unwrap(), 40);
    assert_eq!(client.lost_emergencies(), 8);
    let first = client.take_emergencies().next().unwrap();
    assert_eq!(
        (first.code, first.register, first.data),
        (0x1000, 0x21, [1, 2, 3, 4, 5])
    );
}

/// A device whose mailbox handler continues only after its emergency was read.
#[test]
fn a_full_mailbox_does_not_block_a_request() {
    let server = Server::new(48, &[(0x6041, 0, &[1, 0])], &[Mischief::Blocked]);
    let mut client = client();
    block_on(async {
        client.upload(&server, 0x6041, 0, false).await.unwrap();
        server.say(&emergency(0x8130));
        server.say(&emergency(0x8180));
        client.upload(&server, 0x6041, 0, false).await.unwrap();
    });
    assert_eq!(client.take_emergencies().count(), 2);
}

/// The request arrived but its echo was lost. The device answers before, while or after it is sent
/// again.
#[test]
fn the_answer_to_a_request_sent_twice_is_not_set_aside() {
    for thinking in 0..100 {
        for (emergencies, mischief) in [
            (0, vec![Mischief::LoseRequestEcho(2)]),
            (1, vec![Mischief::LoseRequestEcho(2)]),
            (1, vec![Mischief::LoseRequestEcho(2), Mischief::Blocked]),
            (0, vec![Mischief::RequestTwice(2)]),
            (1, vec![Mischief::RequestTwice(2)]),
            (1, vec![Mischief::RequestTwice(2), Mischief::Blocked]),
        ] {
            let server = Server::new(48, &[(0x6041, 0, &[1, 0])], &mischief);
            server.thinking.set(10_000 * thinking);
            let mut client = client();
            block_on(async {
                client.upload(&server, 0x6041, 0, false).await.unwrap();
                (0..emergencies).for_each(|_| server.say(&emergency(0x8130)));
                client.upload(&server, 0x6041, 0, false).await.unwrap();
            });
            let seen = (client.take_emergencies().count(), client.set_aside());
            assert_eq!(seen, (emergencies, 0), "{thinking} {mischief:?}");
        }
    }
}

#[test]
fn an_answer_of_another_object_is_set_aside() {
    let stale = [
        10, 0, 0, 0, 0, 0x13, 0, 0x30, 0x4b, 0x40, 0x60, 0, 0xff, 0xff, 0, 0,
    ];
    let other_sub = [
        10, 0, 0, 0, 0, 0x13, 0, 0x30, 0x4b, 0x41, 0x60, 1, 0xff, 0xff, 0, 0,
    ];
    let segment = [10, 0, 0, 0, 0, 0x13, 0, 0x30, 0x01, 9, 9, 9, 9, 9, 9, 9];
    let sdo_info = [10, 0, 0, 0, 0, 0x13, 0, 0x80, 0x02, 0, 0, 0, 0, 0, 0, 0];
    let eoe = [4, 0, 0, 0, 0, 0x12, 0, 0, 0, 0];
    let mischief = [
        Mischief::Before(1, stale.to_vec()),
        Mischief::Before(1, other_sub.to_vec()),
        Mischief::Before(1, segment.to_vec()),
        Mischief::Before(1, sdo_info.to_vec()),
        Mischief::Before(1, eoe.to_vec()),
    ];
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 0x02])], &mischief);
    let mut client = client();
    assert_eq!(
        block_on(client.upload(&server, 0x6041, 0, false)).unwrap(),
        [0x37, 0x02]
    );
    assert_eq!(client.set_aside(), 5);
}

#[test]
fn lost_frames_only_delay_transfers() {
    let data = bytes(200);
    for n in 1..=6 {
        for mischief in [
            Mischief::LoseAnswer(n),
            Mischief::LoseFetch(n),
            Mischief::LoseRequest(n),
            Mischief::LoseRequestEcho(n),
            Mischief::FetchTwice(n),
            Mischief::RequestTwice(n),
        ] {
            let server = Server::new(
                48,
                &[(0x2000, 0, &data), (0x2001, 0, &[])],
                std::slice::from_ref(&mischief),
            );
            let mut client = client();
            block_on(async {
                assert_eq!(
                    client.upload(&server, 0x2000, 0, false).await.unwrap(),
                    data,
                    "{mischief:?}"
                );
            });
            let server = Server::new(48, &[(0x2001, 0, &[])], std::slice::from_ref(&mischief));
            block_on(async {
                client
                    .download(&server, 0x2001, 0, false, &data)
                    .await
                    .unwrap();
                assert_eq!(server.object(0x2001, 0).unwrap(), data, "{mischief:?}");
            });
            assert_eq!(client.set_aside(), 0, "{mischief:?}");
        }
    }
}

/// Some devices use 4 bytes for short strings announced in a normal transfer, and pad them.
#[test]
fn padding_after_a_normal_upload_is_cut_off() {
    let padded = [
        14, 0, 0, 0, 0, 0x13, 0, 0x30, 0x41, 0x08, 0x10, 0, 2, 0, 0, 0, b'x', b'y', 0, 0,
    ];
    let server = Server::new(
        48,
        &[(0x1008, 0, b"zzzzz")],
        &[Mischief::Replace(1, padded.to_vec())],
    );
    assert_eq!(
        block_on(client().upload(&server, 0x1008, 0, false)).unwrap(),
        b"xy"
    );
}
