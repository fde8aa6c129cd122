//! Transfers that fail, each with its own error; the client stays usable afterwards.

mod timeouts;

use std::time::Duration;

use ecaxis_master::mailbox::{
    CoeCause, CoeClient, DatagramError, FoeClient, MAX_OBJECT, MailboxTransport, NamedObject,
    Phase, SdoError, Subject,
};
use ecaxis_test_support::mailbox::fault_injection::{Mischief, emergency};
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{STATION, block_on, client, layout};

const LONG: &[u8] = &[7; 100];
const OBJECTS: &[(u16, u8, &[u8])] = &[
    (0x1000, 0, &[0x92, 1, 2, 0]),
    (0x6041, 0, &[0x37, 0x02]),
    (0x2000, 0, LONG),
];

fn sdo_error(index: u16, cause: CoeCause) -> SdoError {
    SdoError {
        station: STATION,
        asked: Subject::Object(NamedObject { index, sub: 0 }),
        cause,
    }
}

fn server(mischief: &[Mischief]) -> Server {
    Server::new(48, OBJECTS, mischief)
}

/// Returns the error of the first upload of `index`. The next upload must succeed without the
/// faults.
fn upload_error(index: u16, mischief: &[Mischief]) -> (SdoError, Vec<Vec<u8>>) {
    let server = server(mischief);
    let mut client = client();
    let error = block_on(client.upload(&server, index, 0, false)).unwrap_err();
    let log = server.log();
    server.forgive();
    assert_eq!(
        block_on(client.upload(&server, 0x6041, 0, false)).unwrap(),
        [0x37, 0x02]
    );
    (error, log)
}

fn download_error(index: u16, data: &[u8], mischief: &[Mischief]) -> (SdoError, Vec<Vec<u8>>) {
    let server = server(mischief);
    let mut client = client();
    let error = block_on(client.download(&server, index, 0, false, data)).unwrap_err();
    let log = server.log();
    server.forgive();
    assert_eq!(
        block_on(client.upload(&server, 0x6041, 0, false)).unwrap(),
        [0x37, 0x02]
    );
    (error, log)
}

#[test]
fn abort_error_contains_code_and_text() {
    let (error, _) = upload_error(0x6060, &[]);
    assert_eq!(error, sdo_error(0x6060, CoeCause::Abort(0x0602_0000)));
    assert_eq!(
        error.to_string(),
        "station 0x1001: 0x6060:00 (Modes of operation) was refused with 0x06020000: the object does not exist"
    );
    let (error, _) = download_error(0x1000, &[1], &[]);
    assert_eq!(error.abort_code(), Some(0x0601_0002));
    let (error, _) = download_error(0x2abc, LONG, &[]);
    assert_eq!(error.abort_code(), Some(0x0602_0000));
}

/// ETG.1000.6 assigns the abort to the request service, some stacks to the response service.
#[test]
fn abort_is_parsed_under_either_service() {
    for service in [0x20, 0x30] {
        let abort = [
            10, 0, 0, 0, 0, 0x13, 0, service, 0x80, 0x41, 0x60, 0, 0xc0, 0xff, 0x00, 0x0f,
        ];
        let (error, _) = upload_error(0x6041, &[Mischief::Replace(1, abort.to_vec())]);
        assert_eq!(error.abort_code(), Some(0x0f00_ffc0));
        assert!(error.to_string().contains("wrong NMT state"), "{error}");
    }
}

/// ETG.1000.6 clause 5.6.2.7: bits 0 to 4 of the command are reserved in an abort.
#[test]
fn abort_with_reserved_bits_ends_uploads_and_downloads_with_its_code() {
    for (service, command) in [(0x20, 0x90), (0x20, 0x9f), (0x30, 0x81), (0x30, 0x9f)] {
        let abort = |index: u16| {
            let [low, high] = index.to_le_bytes();
            vec![
                10, 0, 0, 0, 0, 0x13, 0, service, command, low, high, 0, 0x11, 0, 0x09, 0x06,
            ]
        };
        for (n, index) in [(1, 0x6041), (1, 0x2000), (2, 0x2000)] {
            let (error, _) = upload_error(index, &[Mischief::Replace(n, abort(index))]);
            assert_eq!(error.abort_code(), Some(0x0609_0011), "{command:#x}");
            let (error, _) = download_error(index, LONG, &[Mischief::Replace(n, abort(index))]);
            assert_eq!(error.abort_code(), Some(0x0609_0011), "{command:#x}");
        }
    }
}

fn abort_of(index: u16) -> Vec<u8> {
    abort_at(index, 0)
}

fn abort_at(index: u16, sub: u8) -> Vec<u8> {
    let [low, high] = index.to_le_bytes();
    vec![
        10, 0, 0, 0, 0, 0x13, 0, 0x20, 0x80, low, high, sub, 0x11, 0, 0x09, 0x06,
    ]
}

/// Slave stacks with 16-bit access to the mailbox write the command as a word: the low byte of the
/// index is lost.
#[test]
fn abort_without_the_low_byte_of_the_index_ends_the_transfer() {
    let (error, _) = upload_error(0x6041, &[Mischief::Replace(1, abort_of(0x6000))]);
    assert_eq!(error, sdo_error(0x6041, CoeCause::Abort(0x0609_0011)));
    let (error, _) = download_error(0x2000, LONG, &[Mischief::Replace(1, abort_of(0x2000))]);
    assert_eq!(error, sdo_error(0x2000, CoeCause::Abort(0x0609_0011)));
}

#[test]
fn abort_with_any_index_answers_the_only_request() {
    let server = server(&[Mischief::Replace(2, abort_of(0x1018))]);
    let mut client = client();
    block_on(client.upload(&server, 0x1000, 0, false)).unwrap();
    let error = block_on(client.upload(&server, 0x6041, 0, false)).unwrap_err();
    assert_eq!(error, sdo_error(0x6041, CoeCause::Abort(0x0609_0011)));
}

#[test]
fn abort_of_an_earlier_request_does_not_answer_the_next() {
    let server = server(&[Mischief::Skip(1), Mischief::Before(2, abort_of(0x1000))]);
    let mut client = client();
    block_on(client.upload(&server, 0x1000, 0, false)).unwrap_err();
    let value = block_on(client.upload(&server, 0x6041, 0, false)).unwrap();
    assert_eq!(value, [0x37, 0x02]);
}

/// A late abort of another subindex is not the answer, also to the first request of a client: an
/// earlier program may have asked.
#[test]
fn abort_of_another_subindex_does_not_answer_while_an_answer_is_late() {
    for (index, sub) in [(0x6041, 1), (0x6000, 1), (0x6100, 0)] {
        let server = server(&[Mischief::Before(1, abort_at(index, sub))]);
        let mut client = client();
        let value = block_on(client.upload(&server, 0x6041, 0, false)).unwrap();
        assert_eq!(value, [0x37, 0x02], "{index:#x}:{sub}");
    }
}

#[test]
fn abort_among_segments_ends_the_transfer_at_any_address() {
    let abort = [
        10, 0, 0, 0, 0, 0x13, 0, 0x20, 0x80, 0, 0, 0, 0x22, 0x00, 0x00, 0x08,
    ];
    let (error, _) = upload_error(0x2000, &[Mischief::Replace(2, abort.to_vec())]);
    assert_eq!(error.abort_code(), Some(0x0800_0022));
    let (error, _) = download_error(0x2000, LONG, &[Mischief::Replace(3, abort.to_vec())]);
    assert_eq!(error.abort_code(), Some(0x0800_0022));
}

#[test]
fn a_mailbox_error_reply_ends_the_transfer() {
    let reply = [4, 0, 0, 0, 0, 0x10, 1, 0, 2, 0];
    let (error, _) = upload_error(0x6041, &[Mischief::Replace(1, reply.to_vec())]);
    assert_eq!(error, sdo_error(0x6041, CoeCause::Refused(2)));
    assert!(
        error.to_string().contains("protocol is not supported"),
        "{error}"
    );
}

#[test]
fn a_length_beyond_the_mailbox_is_malformed() {
    for length in [43u16, 0x1000, 0xffff] {
        let [low, high] = length.to_le_bytes();
        let answer = [
            low, high, 0, 0, 0, 0x13, 0, 0x30, 0x4b, 0x41, 0x60, 0, 0, 0, 0, 0,
        ];
        let (error, _) = upload_error(0x6041, &[Mischief::Replace(1, answer.to_vec())]);
        assert!(matches!(error.cause, CoeCause::Malformed(_)), "{error}");
        assert!(
            error
                .to_string()
                .contains(&format!("says {length}, the mailbox holds 42")),
            "{error}"
        );
    }
}

#[test]
fn answers_that_end_too_early_are_malformed() {
    let answer = [
        0, 0, 0, 0, 0, 0x13, 0, 0x30, 0x4b, 0x41, 0x60, 0, 0x37, 0x02, 0, 0,
    ];
    for length in 0..10 {
        let mut answer = answer;
        answer[0] = length;
        let (error, _) = upload_error(0x6041, &[Mischief::Replace(1, answer.to_vec())]);
        assert!(
            matches!(error.cause, CoeCause::Malformed(_)),
            "{length}: {error}"
        );
    }
}

/// A device that fetches the old request only after its emergencies were read. There are more of
/// them than one call drains.
#[test]
fn upload_works_after_many_pending_emergencies() {
    let server = server(&[Mischief::Deaf]);
    let mut client = client();
    block_on(async {
        client.upload(&server, 0x6041, 0, false).await.unwrap_err();
        server.commit(Mischief::Blocked);
        for _ in 0..70 {
            server.say(&emergency(0x8130));
        }
        server.pardon(&Mischief::Deaf);
        assert_eq!(
            client.upload(&server, 0x1000, 0, false).await.unwrap(),
            [0x92, 1, 2, 0]
        );
    });
    let kept = u64::try_from(client.take_emergencies().count()).unwrap();
    assert_eq!(kept + client.lost_emergencies(), 70);
}

#[test]
fn wrong_toggle_bit_ends_the_transfer_with_an_abort() {
    let toggle = [0x00, 0x20, 0x80, 0x00, 0x20, 0, 0x00, 0x00, 0x03, 0x05];
    let (error, _) = upload_error(0x2000, &[Mischief::WrongToggle]);
    assert!(error.to_string().contains("toggle"), "{error}");
    let server = server(&[Mischief::WrongToggle]);
    let mut client = client();
    block_on(async {
        let error = client
            .download(&server, 0x2000, 0, false, LONG)
            .await
            .unwrap_err();
        assert!(error.to_string().contains("toggle"), "{error}");
        server.delay(Duration::from_millis(5)).await;
    });
    assert_eq!(server.log().last().unwrap()[..10], toggle);
}

#[test]
fn wrong_announced_sizes_are_malformed() {
    let (error, _) = upload_error(0x2000, &[Mischief::AnnounceSize(101)]);
    assert!(
        error
            .to_string()
            .contains("101 bytes were announced, 100 came"),
        "{error}"
    );
    let (error, _) = upload_error(0x2000, &[Mischief::AnnounceSize(60)]);
    assert!(
        error
            .to_string()
            .contains("60 bytes were announced, 71 came"),
        "{error}"
    );
    let (error, _) = upload_error(0x2000, &[Mischief::EmptySegments]);
    assert!(
        error.to_string().contains("a segment without data"),
        "{error}"
    );
}

#[test]
fn oversized_objects_are_rejected_before_the_transfer() {
    let (error, log) = upload_error(0x2000, &[Mischief::AnnounceSize(u32::MAX)]);
    assert!(
        matches!(error.cause, CoeCause::TooLarge(0xffff_ffff)),
        "{error}"
    );
    assert_eq!(log.len(), 1);
    let (error, log) = download_error(0x2000, &vec![0; MAX_OBJECT + 1], &[]);
    assert!(matches!(error.cause, CoeCause::TooLarge(_)), "{error}");
    assert!(log.is_empty());
}

#[test]
fn mailboxes_that_cannot_carry_coe_are_refused_before_anything_is_sent() {
    for len in [0, 6, 15, 1487] {
        let server = server(&[]);
        let mut client = CoeClient::new(layout(len));
        let refused = |asked| SdoError {
            station: STATION,
            asked,
            cause: CoeCause::Mailbox {
                out_len: len,
                in_len: len,
            },
        };
        let object = Subject::Object(NamedObject {
            index: 0x6041,
            sub: 0,
        });
        assert_eq!(
            block_on(client.upload(&server, 0x6041, 0, false)).unwrap_err(),
            refused(object)
        );
        assert_eq!(
            block_on(client.drain(&server)).unwrap_err(),
            refused(Subject::Emptying)
        );
        assert_eq!(server.datagrams.get(), 0);
    }
}

/// A wire on which no frame comes back.
struct Silent;

impl MailboxTransport for Silent {
    async fn read(&self, station: u16, register: u16, _: &mut [u8]) -> Result<u16, DatagramError> {
        Err(DatagramError::Timeout { station, register })
    }

    async fn write(&self, station: u16, register: u16, _: &[u8]) -> Result<u16, DatagramError> {
        Err(DatagramError::Timeout { station, register })
    }

    async fn delay(&self, _: Duration) {}

    fn now(&self) -> u64 {
        0
    }
}

/// Every error names its object or file, and shows no register that looks like an object.
#[test]
fn every_error_names_its_object_or_file() {
    const NAMED: &str = "station 0x1001: 0x6065:00 (Following error window)";
    let named = |text: String| {
        assert!(text.starts_with(NAMED), "{text}");
        assert!(!text.contains("register"), "{text}");
        text
    };
    let silent = [
        block_on(client().upload(&Silent, 0x6065, 0, false)).map(|_| ()),
        block_on(client().download(&Silent, 0x6065, 0, false, &[1])),
        block_on(client().download(&Silent, 0x6065, 0, false, LONG)),
    ];
    for error in silent {
        let text = named(error.unwrap_err().to_string());
        assert_eq!(text, format!("{NAMED}: no frame came back"));
    }
    let off = server(&[Mischief::Off]);
    let error = block_on(client().upload(&off, 0x6065, 0, false)).unwrap_err();
    assert!(named(error.to_string()).ends_with("it is off, or has lost its address"));

    let source = DatagramError::Other("a frame was too long".to_owned());
    for cause in [
        CoeCause::Abort(1),
        CoeCause::Timeout {
            phase: Phase::Answer,
            after: Duration::ZERO,
            set_aside: 0,
        },
        CoeCause::Refused(1),
        CoeCause::Malformed(String::new()),
        CoeCause::TooLarge(1),
        CoeCause::Gone,
        CoeCause::Mailbox {
            out_len: 1,
            in_len: 1,
        },
        CoeCause::Wire(source),
    ] {
        named(sdo_error(0x6065, cause).to_string());
    }

    let asked = "station 0x1001: the description of 0x6065:00 (Following error window): ";
    for error in [
        block_on(client().entry_description(&Silent, 0x6065, 0)).unwrap_err(),
        block_on(client().entry_description(&off, 0x6065, 0)).unwrap_err(),
        block_on(CoeClient::new(layout(6)).entry_description(&off, 0x6065, 0)).unwrap_err(),
    ] {
        let text = error.to_string();
        assert!(
            text.starts_with(asked) && !text.contains("register"),
            "{text}"
        );
    }
    for error in [
        block_on(FoeClient::new(layout(48)).write(&Silent, "new.bin", 0, &[1], &mut |_| {})),
        block_on(FoeClient::new(layout(48)).write(&off, "new.bin", 0, &[1], &mut |_| {})),
        block_on(FoeClient::new(layout(6)).write(&off, "new.bin", 0, &[1], &mut |_| {})),
    ] {
        let text = error.unwrap_err().to_string();
        assert!(
            text.starts_with("station 0x1001: file `new.bin`: "),
            "{text}"
        );
        assert!(!text.contains("register"), "{text}");
    }
}
