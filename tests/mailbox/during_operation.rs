//! Mailbox access during operation: status from the cycle, repeated messages, dropped futures.

use std::cell::Cell;
use std::future::{Future, poll_fn};
use std::pin::pin;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use ecaxis_master::mailbox::{DatagramError, MailboxStatus, MailboxTransport};
use ecaxis_test_support::mailbox::fault_injection::emergency;
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{block_on, client};

/// A wire on which each delay takes one poll of the executor, with a cycle that reads the mailbox
/// status.
pub struct DuringOperation<'a> {
    server: &'a Server,
    /// The interval at which the cycle reads the status.
    cycle: Option<Duration>,
    /// How long a status counts as recent.
    lasts: Duration,
}

impl<'a> DuringOperation<'a> {
    pub fn new(server: &'a Server, cycle: Option<Duration>) -> Self {
        Self {
            server,
            cycle,
            lasts: Duration::MAX,
        }
    }
}

impl MailboxTransport for DuringOperation<'_> {
    async fn read(
        &self,
        station: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        self.server.read(station, register, buf).await
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        self.server.write(station, register, data).await
    }

    async fn delay(&self, duration: Duration) {
        self.server.delay(duration).await;
        let waited = Cell::new(false);
        poll_fn(|_| match waited.replace(true) {
            true => Poll::Ready(()),
            false => Poll::Pending,
        })
        .await;
    }

    fn now(&self) -> u64 {
        self.server.now()
    }

    fn seen(&self) -> Option<MailboxStatus> {
        let cycle = u64::try_from(self.cycle?.as_nanos()).unwrap();
        let at = self.now() / cycle * cycle;
        Some(MailboxStatus {
            at,
            full: self.server.full_since().is_some_and(|since| since <= at),
        })
    }

    fn seen_lately(&self) -> Option<MailboxStatus> {
        let seen = self.seen()?;
        let age = Duration::from_nanos(self.now() - seen.at);
        (age <= self.lasts).then_some(seen)
    }
}

/// Polls a future until it is ready.
pub fn finish<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    for _ in 0..100_000 {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return output;
        }
    }
    panic!("it does not come to an end");
}

#[test]
fn upload_polls_no_status_that_the_cycle_reads() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    for (cycle, datagrams) in [(None, 4..100), (Some(Duration::from_micros(250)), 2..3)] {
        let wire = DuringOperation::new(&server, cycle);
        let mut client = client();
        finish(client.upload(&wire, 0x6041, 0, false)).expect("read");
        let before = server.datagrams.get();
        for _ in 0..20 {
            let read = finish(client.upload(&wire, 0x6041, 0, false));
            assert_eq!(read.expect("read"), [0x37, 2]);
        }
        let each = (server.datagrams.get() - before) / 20;
        assert!(datagrams.contains(&each), "{each} datagrams with {cycle:?}");
    }
}

#[test]
fn waiting_message_is_noticed_once() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    let wire = DuringOperation::new(&server, Some(Duration::from_millis(1)));
    let mut client = client();
    finish(client.drain(&wire)).expect("it is there");
    assert!(!client.has_message(&wire));
    block_on(server.delay(Duration::from_millis(5)));
    server.say(&emergency(0x8130));
    block_on(server.delay(Duration::from_millis(2)));
    assert!(client.has_message(&wire));
    finish(client.drain(&wire)).expect("it is there");
    assert!(!client.has_message(&wire), "what was seen before is read");
    block_on(server.delay(Duration::from_millis(2)));
    assert!(!client.has_message(&wire));
    let received = client.emergencies().take();
    assert_eq!(received.len(), 1);
    assert!(received[0].at >= 7_000_000, "{received:?}");
}

/// On a large bus the cycle reads a mailbox status seldom. A transfer then reads the status itself,
/// and a message is noticed even if its status is old.
#[test]
fn transfer_polls_the_status_if_the_cycle_reads_it_seldom() {
    const SELDOM: Duration = Duration::from_millis(200);
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    let wire = DuringOperation {
        lasts: Duration::from_millis(4),
        ..DuringOperation::new(&server, Some(SELDOM))
    };
    let mut client = client();
    finish(client.drain(&wire)).expect("it is there");
    for _ in 0..3 {
        let before = Duration::from_nanos(wire.now());
        let read = finish(client.upload(&wire, 0x6041, 0, false));
        assert_eq!(read.expect("read"), [0x37, 2]);
        let took = Duration::from_nanos(wire.now()) - before;
        assert!(took < SELDOM / 4, "{took:?}");
    }
    let next = SELDOM - Duration::from_nanos(wire.now() % SELDOM.as_nanos() as u64);
    server.say(&emergency(0x8130));
    assert!(!client.has_message(&wire));
    block_on(server.delay(next + SELDOM / 2));
    assert!(wire.seen_lately().is_none() && client.has_message(&wire));
}

#[test]
fn repeated_emergency_of_a_counting_device_counts_once() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    let mut client = client();
    let said = |counter: u8| {
        let mut bytes = emergency(0x8130);
        bytes[5] = 0x03 | counter << 4;
        bytes
    };
    // It is not known yet whether the device counts.
    server.say(&said(5));
    server.say(&said(5));
    block_on(client.drain(&server)).expect("it is there");
    assert_eq!(client.take_emergencies().count(), 2);
    for _ in 0..5 {
        block_on(client.upload(&server, 0x6041, 0, false)).expect("read");
    }
    for counter in [6, 6, 6, 7, 7] {
        server.say(&said(counter));
    }
    block_on(client.drain(&server)).expect("it is there");
    assert_eq!(client.take_emergencies().count(), 2);
    let read = block_on(client.upload(&server, 0x6041, 0, false));
    assert_eq!(read.expect("read"), [0x37, 2]);
}

/// Drops a segmented transfer after each possible number of polls. The next transfer must read the
/// current data, and a device in mid-transfer must have received an abort.
#[test]
fn dropped_transfer_does_not_affect_the_next() {
    let data: Vec<u8> = (0..200).collect();
    let mut reported = 0;
    for turns in 0..200 {
        let server = Server::new(48, &[(0x2000, 0, &data), (0x6041, 0, &[0x37, 2])], &[]);
        let wire = DuringOperation::new(&server, None);
        let mut client = client();
        let ended = {
            let mut future = pin!(client.upload(&wire, 0x2000, 0, false));
            let mut context = Context::from_waker(Waker::noop());
            (0..turns).any(|_| future.as_mut().poll(&mut context).is_ready())
        };
        if turns % 2 == 0 {
            finish(client.abort_transfer(&wire)).expect("it is there");
        }
        let read = finish(client.upload(&wire, 0x6041, 0, false));
        assert_eq!(read.expect("read"), [0x37, 2], "{turns} turns");
        let whole = finish(client.upload(&wire, 0x2000, 0, false));
        assert_eq!(whole.expect("read"), data, "{turns} turns");
        reported += usize::from(server.log().iter().any(|body| body.get(2) == Some(&0x80)));
        if ended {
            assert!(reported > 0, "none was in the middle");
            return;
        }
    }
    panic!("the transfer takes more turns");
}
