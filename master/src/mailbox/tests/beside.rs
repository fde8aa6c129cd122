//! Beside a cycle: what it sees of the mailbox, messages that come twice, futures that are dropped.

use std::cell::Cell;
use std::future::{Future, poll_fn};
use std::pin::pin;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use super::mischief::emergency;
use super::server::Server;
use super::{block_on, client};
use crate::mailbox::{Seen, Wire, WireError};

/// A wire on which waiting takes a turn of the executor, with a cycle that looks at the mailbox.
struct Beside<'a> {
    server: &'a Server,
    /// How often it looks.
    cycle: Option<Duration>,
    /// How long what it has seen is new.
    lasts: Duration,
}

impl<'a> Beside<'a> {
    fn new(server: &'a Server, cycle: Option<Duration>) -> Self {
        Self {
            server,
            cycle,
            lasts: Duration::MAX,
        }
    }
}

impl Wire for Beside<'_> {
    async fn read(&self, station: u16, register: u16, buf: &mut [u8]) -> Result<u16, WireError> {
        self.server.read(station, register, buf).await
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, WireError> {
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

    fn seen(&self) -> Option<Seen> {
        let cycle = u64::try_from(self.cycle?.as_nanos()).unwrap();
        let at = self.now() / cycle * cycle;
        Some(Seen {
            at,
            full: self.server.full_since().is_some_and(|since| since <= at),
        })
    }

    fn seen_lately(&self) -> Option<Seen> {
        let seen = self.seen()?;
        let age = Duration::from_nanos(self.now() - seen.at);
        (age <= self.lasts).then_some(seen)
    }
}

/// However often it has to be asked.
fn finish<T>(future: impl Future<Output = T>) -> T {
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
fn nothing_is_asked_for_what_the_cycle_sees() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    for (cycle, datagrams) in [(None, 4..100), (Some(Duration::from_micros(250)), 2..3)] {
        let wire = Beside::new(&server, cycle);
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
fn a_message_that_waits_is_noticed_once() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    let wire = Beside::new(&server, Some(Duration::from_millis(1)));
    let mut client = client();
    finish(client.drain(&wire)).expect("it is there");
    assert!(!client.waits(&wire));
    block_on(server.delay(Duration::from_millis(5)));
    server.say(&emergency(0x8130));
    block_on(server.delay(Duration::from_millis(2)));
    assert!(client.waits(&wire));
    finish(client.drain(&wire)).expect("it is there");
    assert!(!client.waits(&wire), "what was seen before is read");
    block_on(server.delay(Duration::from_millis(2)));
    assert!(!client.waits(&wire));
    let received = client.emergencies().take();
    assert_eq!(received.len(), 1);
    assert!(received[0].at >= 7_000_000, "{received:?}");
}

/// On a big bus its turn comes seldom: a transfer looks for itself, and what was said is noticed however long ago it was seen.
#[test]
fn where_the_cycle_looks_seldom_a_transfer_looks_for_itself() {
    const SELDOM: Duration = Duration::from_millis(200);
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    let wire = Beside {
        lasts: Duration::from_millis(4),
        ..Beside::new(&server, Some(SELDOM))
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
    assert!(!client.waits(&wire));
    block_on(server.delay(next + SELDOM / 2));
    assert!(wire.seen_lately().is_none() && client.waits(&wire));
}

#[test]
fn what_a_counting_device_says_twice_counts_once() {
    let server = Server::new(48, &[(0x6041, 0, &[0x37, 2])], &[]);
    let mut client = client();
    let said = |counter: u8| {
        let mut bytes = emergency(0x8130);
        bytes[5] = 0x03 | counter << 4;
        bytes
    };
    // Nobody knows yet whether it counts.
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

/// Dropped after every number of turns that a transfer in segments takes: the next one reads what is there, and a device that was in the
/// middle has been told.
#[test]
fn a_dropped_future_leaves_nothing_behind() {
    let data: Vec<u8> = (0..200).collect();
    let mut told = 0;
    for turns in 0..200 {
        let server = Server::new(48, &[(0x2000, 0, &data), (0x6041, 0, &[0x37, 2])], &[]);
        let wire = Beside::new(&server, None);
        let mut client = client();
        let ended = {
            let mut future = pin!(client.upload(&wire, 0x2000, 0, false));
            let mut context = Context::from_waker(Waker::noop());
            (0..turns).any(|_| future.as_mut().poll(&mut context).is_ready())
        };
        if turns % 2 == 0 {
            finish(client.give_up(&wire)).expect("it is there");
        }
        let read = finish(client.upload(&wire, 0x6041, 0, false));
        assert_eq!(read.expect("read"), [0x37, 2], "{turns} turns");
        let whole = finish(client.upload(&wire, 0x2000, 0, false));
        assert_eq!(whole.expect("read"), data, "{turns} turns");
        told += usize::from(server.log().iter().any(|body| body.get(2) == Some(&0x80)));
        if ended {
            assert!(told > 0, "none was in the middle");
            return;
        }
    }
    panic!("the transfer takes more turns");
}
