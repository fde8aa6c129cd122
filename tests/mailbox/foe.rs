//! The FoE client: every length, lost frames, SubDevices that are busy, faulty or gone. Every
//! transfer ends in bounded time.

use std::time::Duration;

use proptest::prelude::*;

use super::hostile::Noise;
use ecaxis_master::mailbox::foe::{FoeProgress, FoeTimeouts, foe_error_text};
use ecaxis_master::mailbox::{FoeCause, FoeClient, FoeError, MailboxTransport, Phase};
use ecaxis_test_support::mailbox::fault_injection::{Mischief, emergency};
use ecaxis_test_support::mailbox::files::Manner;
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{block_on, layout};

const NAME: &str = "app.bin";
/// The file bytes that a 48-byte mailbox carries.
const FULL: usize = 36;

fn client(len: u16) -> FoeClient {
    FoeClient::new(layout(len)).with_timeouts(FoeTimeouts {
        request: Duration::from_millis(100),
        answer: Duration::from_millis(500),
        busy: Duration::from_secs(3),
    })
}

fn server(mischief: &[Mischief]) -> Server {
    Server::new(48, &[], mischief)
}

fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|n| (n * 31 + n / 251) as u8).collect()
}

fn write(client: &mut FoeClient, server: &Server, data: &[u8]) -> Result<(), FoeError> {
    block_on(client.write(server, NAME, 0, data, &mut |_| {}))
}

fn read(client: &mut FoeClient, server: &Server) -> Result<Vec<u8>, FoeError> {
    block_on(client.read(server, NAME, 0, 1 << 20, &mut |_| {}))
}

/// Returns the error codes that the client sent.
fn error_codes(server: &Server) -> Vec<u32> {
    block_on(server.delay(Duration::from_millis(1)));
    server.files(|files| files.reported.clone())
}

fn stored(server: &Server) -> Option<Vec<u8>> {
    server.files(|files| files.stored.get(NAME).cloned())
}

/// A failed transfer must not affect the next one.
#[track_caller]
fn next_transfer_works(client: &mut FoeClient, server: &Server) {
    server.forgive();
    server.files(|files| files.manners.clear());
    let data = bytes(100);
    assert_eq!(write(client, server, &data), Ok(()));
    assert_eq!(stored(server), Some(data.clone()));
    assert_eq!(read(client, server), Ok(data));
    error_codes(server);
    assert!(server.files(|files| files.is_idle()));
}

#[test]
fn files_of_every_length_round_trip() {
    for mailbox in [32u16, 48, 100, 1486] {
        let full = usize::from(mailbox) - 12;
        let server = Server::new(mailbox, &[], &[]);
        let mut client = client(mailbox);
        for len in [0, 1, full - 1, full, full + 1, 3 * full, 3 * full + 1] {
            let data = bytes(len);
            assert_eq!(write(&mut client, &server, &data), Ok(()), "{len}");
            assert_eq!(stored(&server), Some(data.clone()), "{len}");
            assert_eq!(read(&mut client, &server), Ok(data), "{len}");
        }
    }
}

#[test]
fn progress_reports_every_packet_and_every_busy() {
    let server = server(&[]);
    server.files(|files| files.manners = vec![Manner::Busy(0, 1), Manner::Busy(2, 2)]);
    let mut heard = Vec::new();
    let data = bytes(2 * FULL + 5);
    block_on(client(48).write(&server, NAME, 0, &data, &mut |p| heard.push(p))).unwrap();
    let busy = FoeProgress::Busy {
        done: 30,
        entire: 100,
    };
    let at = FoeProgress::Bytes;
    assert_eq!(
        heard,
        [
            busy,
            at(0),
            at(FULL),
            busy,
            busy,
            at(2 * FULL),
            at(2 * FULL + 5)
        ]
    );
    assert_eq!(stored(&server), Some(data));
}

#[test]
fn lost_frames_only_delay_transfers() {
    for n in 1..8 {
        for mischief in [
            Mischief::LoseAnswer(n),
            Mischief::LoseFetch(n),
            Mischief::LoseRequest(n),
            Mischief::LoseRequestEcho(n),
            Mischief::FetchTwice(n),
            Mischief::RequestTwice(n),
        ] {
            let data = bytes(3 * FULL);
            let server = server(std::slice::from_ref(&mischief));
            let mut client = client(48);
            assert_eq!(write(&mut client, &server, &data), Ok(()), "{mischief:?}");
            assert_eq!(stored(&server), Some(data.clone()), "{mischief:?}");
            assert_eq!(read(&mut client, &server), Ok(data), "{mischief:?}");
        }
    }
}

#[test]
fn repeated_packets_are_recognised_by_number() {
    let server = server(&[]);
    let data = bytes(3 * FULL + 1);
    let mut client = client(48);
    server.files(|files| files.manners = vec![Manner::StaleAck(2), Manner::StaleAck(3)]);
    assert_eq!(write(&mut client, &server, &data), Ok(()));
    server.files(|files| files.manners = vec![Manner::DataAgain(1, 1), Manner::DataAgain(3, 3)]);
    assert_eq!(read(&mut client, &server), Ok(data.clone()));
    assert_eq!(stored(&server), Some(data));
    // The number of repetitions is limited.
    server.files(|files| files.manners = vec![Manner::DataAgain(2, 9)]);
    let error = read(&mut client, &server).unwrap_err();
    assert!(
        matches!(
            error.cause,
            FoeCause::Timeout {
                phase: Phase::Repeat,
                ..
            }
        ),
        "{error}"
    );
    next_transfer_works(&mut client, &server);
}

#[test]
fn transfer_fails_if_the_subdevice_stays_busy() {
    for packet in [0, 2] {
        let server = server(&[]);
        server.files(|files| files.manners = vec![Manner::Busy(packet, u32::MAX)]);
        let mut client = client(48);
        let error = write(&mut client, &server, &bytes(3 * FULL)).unwrap_err();
        let FoeCause::Busy {
            packet: at,
            done: 30,
            entire: 100,
            ..
        } = error.cause
        else {
            panic!("{error}")
        };
        assert_eq!(at, packet);
        assert!((3_000_000_000..5_000_000_000).contains(&server.now()));
        assert_eq!(error_codes(&server), [0x8000]);
        next_transfer_works(&mut client, &server);
    }
}

#[test]
fn refusals_have_code_text_and_packet() {
    for (code, text) in [
        (0x8001, "not found"),
        (0x8002, "access denied"),
        (0x8003, "disk full"),
        (0x8004, "illegal"),
        (0x8005, "packet number wrong"),
        (0x8006, "already exists"),
        (0x8008, "bootstrap only"),
        (0x800a, "password"),
        (0x800b, "program error"),
        (0x800c, "checksum"),
        (0x800d, "does not fit the hardware"),
        (0x8010, "header"),
        (0x9001, "manufacturer"),
    ] {
        for packet in [0, 2] {
            let server = server(&[]);
            let words = b" flash\x1b\x07 worn\0rest";
            server.files(|files| files.manners = vec![Manner::Refuse(packet, code, words)]);
            let mut client = client(48);
            let error = write(&mut client, &server, &bytes(3 * FULL)).unwrap_err();
            assert_eq!(error.code(), Some(code));
            let shown = error.to_string();
            let where_ = if packet == 0 {
                "at the request"
            } else {
                "at packet 2"
            };
            for part in ["0x1001", NAME, text, where_, "flash   worn"] {
                assert!(shown.contains(part), "`{part}` is not in `{shown}`");
            }
            assert!(!shown.contains("rest"), "{shown}");
            assert_eq!(error_codes(&server), [0; 0], "ERROR is not answered");
            next_transfer_works(&mut client, &server);
        }
        assert!(foe_error_text(code).contains(text));
    }
}

#[test]
fn passwords_are_sent_and_names_are_checked() {
    let server = server(&[]);
    server.files(|files| files.password = 0x1234_5678);
    let mut client = client(48);
    let error = write(&mut client, &server, &[]).unwrap_err();
    assert_eq!(error.code(), Some(0x800a));
    let data = bytes(40);
    block_on(client.write(&server, NAME, 0x1234_5678, &data, &mut |_| {})).unwrap();
    let back = block_on(client.read(&server, NAME, 0x1234_5678, 40, &mut |_| {}));
    assert_eq!(back, Ok(data));
    let most = "n".repeat(FULL);
    block_on(client.write(&server, &most, 0x1234_5678, &[1], &mut |_| {})).unwrap();
    for name in ["", &"n".repeat(FULL + 1), "a\0b"] {
        let before = server.log().len();
        let error = block_on(client.write(&server, name, 0, &[], &mut |_| {})).unwrap_err();
        assert!(
            matches!(error.cause, FoeCause::Name { room: FULL }),
            "{error}"
        );
        assert_eq!(server.log().len(), before, "nothing was sent");
    }
}

#[test]
fn invalid_answer_ends_the_transfer_and_sends_an_error() {
    for (manner, code, part) in [
        (
            Manner::Misnumber(2, 7),
            0x8005,
            "packet 7 came where packet 2",
        ),
        (
            Manner::Misnumber(0, 1),
            0x8005,
            "packet 1 came where packet 0",
        ),
        (Manner::Opcode(1, 3), 0x8004, "data where"),
        (Manner::Opcode(1, 2), 0x8004, "opcode 2"),
        (Manner::Opcode(0, 9), 0x8004, "opcode 9"),
    ] {
        let server = server(&[]);
        server.files(|files| files.manners = vec![manner.clone()]);
        let mut client = client(48);
        let error = write(&mut client, &server, &bytes(3 * FULL)).unwrap_err();
        assert!(error.to_string().contains(part), "{error}");
        assert_eq!(error_codes(&server), [code], "{manner:?}");
        next_transfer_works(&mut client, &server);
    }
    let server = server(&[]);
    let mut client = client(48);
    write(&mut client, &server, &bytes(101)).unwrap();
    let error = block_on(client.read(&server, NAME, 0, 100, &mut |_| {})).unwrap_err();
    assert!(
        matches!(error.cause, FoeCause::TooLarge { most: 100 }),
        "{error}"
    );
    next_transfer_works(&mut client, &server);
}

#[test]
fn silent_subdevice_times_out() {
    for (mischief, phase) in [
        (Mischief::Mute, Phase::Answer),
        (Mischief::Deaf, Phase::Request),
    ] {
        let server = server(std::slice::from_ref(&mischief));
        let mut client = client(48);
        // The first request to a SubDevice that does not read its mailbox still fits.
        let first = write(&mut client, &server, &bytes(10)).unwrap_err();
        let error = if phase == Phase::Request {
            write(&mut client, &server, &bytes(10)).unwrap_err()
        } else {
            first
        };
        let FoeCause::Timeout { phase: found, .. } = error.cause else {
            panic!("{error}")
        };
        assert_eq!(found, phase);
        assert!(server.now() < 2_000_000_000);
        next_transfer_works(&mut client, &server);
    }
    let server = server(&[Mischief::Off]);
    let mut client = client(48);
    let error = write(&mut client, &server, &bytes(10)).unwrap_err();
    let FoeError {
        station: 0x1001,
        file,
        cause: FoeCause::Gone { packet: 0 },
    } = &error
    else {
        panic!("{error}")
    };
    assert!(error.to_string().contains(&format!("file `{file}`: ")));
    next_transfer_works(&mut client, &server);
}

#[test]
fn other_messages_in_between_are_set_aside() {
    let mailbox_error = vec![4, 0, 0, 0, 0, 0x10, 1, 0, 2, 0];
    let server = server(&[Mischief::Before(2, emergency(0x8110))]);
    let mut client = client(48);
    assert_eq!(write(&mut client, &server, &bytes(100)), Ok(()));
    server.commit(Mischief::Replace(5, mailbox_error));
    server.commit(Mischief::Replace(6, vec![4, 0, 0, 0, 0, 0x10, 1, 0, 2, 0]));
    let error = write(&mut client, &server, &bytes(100)).unwrap_err();
    assert!(matches!(error.cause, FoeCause::Mailbox(2)), "{error}");
    next_transfer_works(&mut client, &server);
}

#[test]
fn dropped_transfer_is_ended_before_the_next() {
    use std::task::{Context, Waker};

    /// Never returns from its n-th delay.
    struct Stops<'a>(&'a Server, std::cell::Cell<u32>);
    impl MailboxTransport for Stops<'_> {
        async fn read(
            &self,
            station: u16,
            register: u16,
            buf: &mut [u8],
        ) -> Result<u16, ecaxis_master::mailbox::DatagramError> {
            self.0.read(station, register, buf).await
        }
        async fn write(
            &self,
            station: u16,
            register: u16,
            data: &[u8],
        ) -> Result<u16, ecaxis_master::mailbox::DatagramError> {
            self.0.write(station, register, data).await
        }
        async fn delay(&self, duration: Duration) {
            if self.1.get() == 0 {
                std::future::pending::<()>().await;
            }
            self.1.set(self.1.get() - 1);
            self.0.delay(duration).await;
        }
        fn now(&self) -> u64 {
            self.0.now()
        }
    }

    for delays in 0..20 {
        let server = server(&[]);
        let mut client = client(48);
        let stops = Stops(&server, std::cell::Cell::new(delays));
        {
            let data = bytes(300);
            let mut ignored = |_| {};
            let future = client.write(&stops, NAME, 0, &data, &mut ignored);
            let mut future = std::pin::pin!(future);
            let polled = future
                .as_mut()
                .poll(&mut Context::from_waker(Waker::noop()));
            assert!(polled.is_pending());
        }
        next_transfer_works(&mut client, &server);
    }
}

/// Bytes that often resemble FoE enough to pass the first checks.
fn mailbox() -> impl Strategy<Value = Vec<u8>> {
    let noise = prop::collection::vec(any::<u8>(), 48);
    let plausible =
        (noise.clone(), 0u8..46, 0u8..8, 0u8..4).prop_map(|(mut bytes, length, opcode, packet)| {
            bytes[..12].copy_from_slice(&[length, 0, 0, 0, 0, 0x14, opcode, 0, packet, 0, 0, 0]);
            bytes
        });
    prop_oneof![noise, plausible]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_answers_end_in_bounded_time_without_panic(
        mailboxes in prop::collection::vec(mailbox(), 0..12),
        seed in 1u64..,
        lost in prop::sample::select(vec![0u8, 10, 100]),
        untouched in prop::sample::select(vec![0u8, 10, 100]),
        data in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let noise = Noise::new(mailboxes, seed, lost, untouched);
        let mut client = client(48);
        for _ in 0..3 {
            let begin = noise.now();
            let _ = block_on(client.write(&noise, NAME, 0, &data, &mut |_| {}));
            let _ = block_on(client.read(&noise, NAME, 0, 1000, &mut |_| {}));
            // At most 7 packets out and 29 in, each with its own timeouts.
            prop_assert!(noise.now() - begin < 36 * 5_000_000_000);
        }
    }

    /// After any changed byte in any answer, the file is correct or there is an error, and the next
    /// transfer works.
    #[test]
    fn one_changed_byte_never_yields_wrong_data(answer in 1u32..7, position in 0usize..48, value: u8) {
        let server = server(&[Mischief::Corrupt(answer, position, value)]);
        let mut client = client(48);
        let data = bytes(150);
        match write(&mut client, &server, &data) {
            Ok(()) => prop_assert_eq!(stored(&server), Some(data)),
            // The byte made an error message of an acknowledgement. A device that sends one has
            // ended its transfer, but this server has not.
            Err(error) if error.code().is_some() => return Ok(()),
            Err(_) => {}
        }
        next_transfer_works(&mut client, &server);
    }

    #[test]
    fn written_file_is_read_back(
        mailbox in 20u16..300,
        data in prop::collection::vec(any::<u8>(), 0..3000),
        busy in prop::collection::vec((0u32..20, 0u32..3), 0..4),
    ) {
        let server = Server::new(mailbox, &[], &[]);
        server.files(|files| files.manners = busy.iter().map(|(n, times)| Manner::Busy(*n, *times)).collect());
        let mut client = client(mailbox);
        prop_assert_eq!(write(&mut client, &server, &data), Ok(()));
        prop_assert_eq!(read(&mut client, &server), Ok(data));
    }
}
