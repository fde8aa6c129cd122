//! Messages of other programs through the mailbox workers: raw messages in, raw messages out.

use std::fmt::Debug;
use std::sync::Arc;
use std::time::Duration;

use ecaxis_master::mailbox::worker::{EmergencySink, WorkerConfig, open, run_with_workers};
use ecaxis_master::mailbox::{
    Emergencies, MailboxSession, Mailboxes, RawAnswer, RawMessage, Received,
};
use ecaxis_test_support::mailbox::fault_injection::emergency;
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{STATION, client};

use crate::during_operation::{DuringOperation, finish};

#[derive(Debug, Default)]
struct Sink(std::sync::Mutex<Vec<Received>>);

impl EmergencySink for Sink {
    fn listen(&self, _: &str, emergencies: &Emergencies) {
        self.0.lock().unwrap().extend(emergencies.take());
    }
}

/// Runs a user of the mailbox of one device. Returns how many emergencies arrived.
fn with_device(server: &Server, user: impl AsyncFnOnce(Mailboxes)) -> usize {
    let sink = Arc::new(Sink::default());
    let listener: Arc<dyn EmergencySink> = Arc::<Sink>::clone(&sink);
    let wire = DuringOperation::new(server, Some(Duration::from_millis(1)));
    let device = WorkerConfig {
        name: "x".to_owned(),
        mailbox: Some((wire, client())),
    };
    let (mailboxes, workers) = open([device], &listener);
    finish(run_with_workers(workers, user(mailboxes)));
    sink.0.lock().unwrap().len()
}

async fn session(mailboxes: &Mailboxes) -> MailboxSession {
    let (index, mailbox, layout) = mailboxes.at_station(STATION).expect("it is there");
    assert_eq!((index.0, layout.station), (0, STATION));
    mailbox.session().await.expect("reserved")
}

fn message(protocol: u8, body: &[u8]) -> RawMessage {
    RawMessage {
        channel: 0,
        protocol,
        body: body.to_vec(),
    }
}

fn coe(body: &[u8]) -> RawMessage {
    message(3, body)
}

/// An upload of an object.
fn upload(index: u16, sub: u8) -> RawMessage {
    let [low, high] = index.to_le_bytes();
    coe(&[0, 0x20, 0x40, low, high, sub, 0, 0, 0, 0])
}

#[track_caller]
fn only(answer: &RawAnswer, unfinished: bool) -> &[u8] {
    let [message] = &answer.messages[..] else {
        panic!("{answer:?}")
    };
    assert_eq!(answer.unfinished, unfinished);
    &message.body
}

#[test]
fn raw_messages_and_other_requests_alternate() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    with_device(&server, async |mailboxes| {
        for _ in 0..10 {
            let session = session(&mailboxes).await;
            let answer = session.exchange(upload(0x6041, 0)).await.expect("answered");
            let body = [0, 0x30, 0x4b, 0x41, 0x60, 0, 0x37, 2, 0, 0];
            assert_eq!(only(&answer, false), body);
            drop(session);
            let read = mailboxes.upload("x", 0x6041, 0).await;
            assert_eq!(read.expect("read"), [0x37, 2]);
        }
    });
    // The counter of this side never repeats: the device drops no request.
    assert_eq!(server.log().len(), 20);
}

#[test]
fn segments_of_a_session_come_before_requests_of_others() {
    let data: Vec<u8> = (0..100).collect();
    let server = Server::new(48, &[(0x2000, 1, &data), (0x6041, 0, &[0x37, 2])], &[]);
    with_device(&server, async |mailboxes| {
        let session = session(&mailboxes).await;
        let first = session.exchange(upload(0x2000, 1)).await.expect("answered");
        let mut read = only(&first, true)[10..].to_vec();
        let segments = async {
            for (toggle, unfinished) in [(0_u8, true), (0x10, false)] {
                let request = coe(&[0, 0x20, 0x60 | toggle, 0, 0, 0, 0, 0, 0, 0]);
                let answer = session.exchange(request).await.expect("a segment");
                read.extend(&only(&answer, unfinished)[3..]);
            }
            drop(session);
        };
        let (other, ()) = tokio::join!(mailboxes.upload("x", 0x6041, 0), segments);
        assert_eq!(other.expect("read"), [0x37, 2]);
        read.truncate(100);
        assert_eq!(read, data);
    });
    let commands: Vec<u8> = server.log().iter().map(|body| body[2]).collect();
    assert_eq!(commands, [0x40, 0x60, 0x70, 0x40]);
}

#[test]
fn transfer_that_its_user_leaves_is_aborted() {
    let data = [7; 100];
    let server = Server::new(48, &[(0x2000, 1, &data), (0x6041, 0, &[0x37, 2])], &[]);
    with_device(&server, async |mailboxes| {
        let session = session(&mailboxes).await;
        let first = session.exchange(upload(0x2000, 1)).await.expect("answered");
        only(&first, true);
        drop(session);
        let read = mailboxes.upload("x", 0x2000, 1).await;
        assert_eq!(read.expect("read"), data);
    });
    let log = server.log();
    // After the first part an abort of this object with the general code.
    assert_eq!(log[1], [0, 0x20, 0x80, 0, 0x20, 1, 0, 0, 0, 8]);
    assert_eq!(log[2][2], 0x40);
}

#[test]
fn lists_have_all_their_fragments_and_aborts_no_answer() {
    let objects: Vec<(u16, u8, &[u8])> = (0..100).map(|n| (0x2000 + n, 0, &[1_u8][..])).collect();
    let server = Server::new(48, &objects, &[]);
    with_device(&server, async |mailboxes| {
        let session = session(&mailboxes).await;
        let list = coe(&[0, 0x80, 1, 0, 0, 0, 1, 0]);
        let answer = session.exchange(list).await.expect("a list");
        let indices: Vec<u8> = answer
            .messages
            .iter()
            .flat_map(|part| part.body[6..].to_vec())
            .collect();
        assert_eq!(indices.len(), 2 + 200);
        assert!(answer.messages.len() > 4 && !answer.unfinished);
        let abort = coe(&[0, 0x20, 0x80, 0, 0x20, 0, 0, 0, 0, 8]);
        let answer = session.exchange(abort).await.expect("sent");
        assert_eq!(answer.messages, []);
    });
}

#[test]
fn a_file_is_one_transfer_in_both_directions() {
    let file: Vec<u8> = (0..100).collect();
    // 48 bytes hold 36 bytes of a file.
    let server = Server::new(48, &[], &[]);
    server.files(|files| files.stored.insert("a".to_owned(), file.clone()));
    with_device(&server, async |mailboxes| {
        let session = session(&mailboxes).await;
        let mut next = message(4, &[1, 0, 0, 0, 0, 0, b'a']);
        let mut read: Vec<u8> = Vec::new();
        for packet in 1..=3_u8 {
            let answer = session.exchange(next).await.expect("a part");
            read.extend(&only(&answer, true)[6..]);
            next = message(4, &[4, 0, packet, 0, 0, 0]);
        }
        // The device does not answer the acknowledgement of the last part.
        let answer = session.exchange(next).await.expect("sent");
        assert_eq!((answer.messages.len(), answer.unfinished), (0, false));
        assert_eq!(read, file);

        let begin = message(4, &[2, 0, 0, 0, 0, 0, b'b']);
        let answer = session.exchange(begin).await.expect("accepted");
        assert_eq!(only(&answer, true), [4, 0, 0, 0, 0, 0]);
        for (packet, part) in (1_u8..).zip(file.chunks(36)) {
            let data = [&[3, 0, packet, 0, 0, 0], part].concat();
            let answer = session.exchange(message(4, &data)).await.expect("accepted");
            assert_eq!(only(&answer, packet < 3), [4, 0, packet, 0, 0, 0]);
        }
    });
    assert_eq!(server.files(|files| files.stored["b"].clone()), file);
}

#[test]
fn emergencies_within_a_session_are_reported_and_no_answers() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    let reported = with_device(&server, async |mailboxes| {
        let session = session(&mailboxes).await;
        for code in 0..5 {
            server.say(&emergency(0x1000 + code));
            let answer = session.exchange(upload(0x6041, 0)).await.expect("answered");
            assert_eq!(only(&answer, false)[1], 0x30);
        }
    });
    assert_eq!(reported, 5);
}
