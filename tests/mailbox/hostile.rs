//! Random answers: no panic, and an end in bounded time.

use std::cell::{Cell, RefCell};
use std::time::Duration;

use proptest::prelude::*;

use ecaxis_master::mailbox::{DatagramError, EMERGENCY_QUEUE, MailboxTransport, ObjectList};
use ecaxis_test_support::mailbox::fault_injection::Mischief;
use ecaxis_test_support::mailbox::server::Server;
use ecaxis_test_support::mailbox::{block_on, client};

/// Answers every datagram with random data. Time passes only while the client waits, so that an
/// endless loop without a pause reaches the datagram limit.
pub struct Noise {
    now: Cell<u64>,
    datagrams: Cell<u64>,
    random: Cell<u64>,
    /// Whole mailboxes to answer with, in turn.
    mailboxes: RefCell<Vec<Vec<u8>>>,
    /// Of 256 frames: how many are lost, and how many come back unprocessed.
    lost: u8,
    untouched: u8,
}

const DATAGRAMS: u64 = 1_000_000;

impl Noise {
    pub fn new(mailboxes: Vec<Vec<u8>>, seed: u64, lost: u8, untouched: u8) -> Self {
        Self {
            now: Cell::new(0),
            datagrams: Cell::new(0),
            random: Cell::new(seed),
            mailboxes: RefCell::new(mailboxes),
            lost,
            untouched,
        }
    }

    /// xorshift64.
    fn next(&self) -> u64 {
        let mut x = self.random.get();
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        self.random.set(x);
        x
    }

    fn datagram(&self, station: u16, register: u16) -> Result<u16, DatagramError> {
        self.datagrams.set(self.datagrams.get() + 1);
        assert!(
            self.datagrams.get() < DATAGRAMS,
            "the client does not come to an end"
        );
        let [dice, counter, ..] = self.next().to_le_bytes();
        if dice < self.lost {
            Err(DatagramError::Timeout { station, register })
        } else if dice < self.lost.saturating_add(self.untouched) {
            Ok(0)
        } else {
            Ok(1 + u16::from(counter & 1))
        }
    }
}

impl MailboxTransport for Noise {
    async fn read(
        &self,
        station: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        let result = self.datagram(station, register);
        if register >= 0x1000 {
            let mut mailboxes = self.mailboxes.borrow_mut();
            if let Some(mailbox) = mailboxes.first().cloned() {
                mailboxes.rotate_left(1);
                for (to, from) in buf.iter_mut().zip(mailbox) {
                    *to = from;
                }
            }
        } else {
            buf.fill_with(|| self.next().to_le_bytes()[0] | 0x08 & self.next().to_le_bytes()[1]);
        }
        result
    }

    async fn write(&self, station: u16, register: u16, _: &[u8]) -> Result<u16, DatagramError> {
        self.datagram(station, register)
    }

    async fn delay(&self, duration: Duration) {
        self.now
            .set(self.now.get() + u64::try_from(duration.as_nanos()).unwrap());
    }

    fn now(&self) -> u64 {
        self.now.get()
    }
}

/// Bytes that often resemble CoE enough to pass the first checks.
fn mailbox() -> impl Strategy<Value = Vec<u8>> {
    let noise = prop::collection::vec(any::<u8>(), 48);
    let plausible = (
        noise.clone(),
        0u8..46,
        prop::sample::select(vec![0x10, 0x20, 0x30, 0x30, 0x30, 0x80]),
        any::<u8>(),
    )
        .prop_map(|(mut bytes, length, service, command)| {
            bytes[..12]
                .copy_from_slice(&[length, 0, 0, 0, 0, 0x13, 0, service, command, 0x00, 0x20, 1]);
            bytes
        });
    // Sizes of a few kilobytes, so that segments follow.
    let begun = (noise.clone(), 0u8..8).prop_map(|(mut bytes, size)| {
        bytes[..16].copy_from_slice(&[
            42, 0, 0, 0, 0, 0x13, 0, 0x30, 0x41, 0x00, 0x20, 1, 0, size, 0, 0,
        ]);
        bytes
    });
    let segment =
        (noise.clone(), any::<bool>(), 3u8..=42).prop_map(|(mut bytes, toggle, length)| {
            bytes[..9].copy_from_slice(&[length, 0, 0, 0, 0, 0x13, 0, 0x30, u8::from(toggle) << 4]);
            bytes
        });
    // Fragments of descriptions, in any number.
    let fragment =
        (noise.clone(), 0u8..46, 0u8..8, 0u8..4).prop_map(|(mut bytes, length, opcode, left)| {
            bytes[..12].copy_from_slice(&[length, 0, 0, 0, 0, 0x13, 0, 0x80, opcode, 0, left, 0]);
            bytes[12..15].copy_from_slice(&[0x00, 0x20, 1]);
            bytes
        });
    prop_oneof![noise, plausible, begun, segment, fragment]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_answers_end_in_bounded_time_without_panic(
        mailboxes in prop::collection::vec(mailbox(), 0..12),
        seed in 1u64..,
        lost in prop::sample::select(vec![0u8, 10, 100]),
        untouched in prop::sample::select(vec![0u8, 10, 100]),
        data in prop::collection::vec(any::<u8>(), 0..200),
        complete: bool,
    ) {
        let noise = Noise::new(mailboxes, seed, lost, untouched);
        let mut client = client();
        for _ in 0..3 {
            let begin = noise.now();
            let _ = block_on(client.upload(&noise, 0x2000, 1, complete));
            let _ = block_on(client.download(&noise, 0x2000, 1, complete, &data));
            let _ = block_on(client.drain(&noise));
            // Two transfers of at most 10 s each, one last message of each, and the time for
            // draining.
            prop_assert!(noise.now() - begin < 60_000_000_000);
            let begin = noise.now();
            let _ = block_on(client.object_list(&noise, ObjectList::All));
            let _ = block_on(client.object_description(&noise, 0x2000));
            let _ = block_on(client.entry_description(&noise, 0x2000, 1));
            prop_assert!(noise.now() - begin < 90_000_000_000);
        }
        prop_assert!(client.take_emergencies().count() <= EMERGENCY_QUEUE);
    }

    /// After any changed byte in any answer, the data is correct or there is an error, and the next
    /// transfer works.
    #[test]
    fn one_changed_byte_never_yields_wrong_data(answer in 1u32..8, position in 0usize..48, value: u8) {
        let data: Vec<u8> = (0..150).collect();
        let mischief = [Mischief::Corrupt(answer, position, value)];
        let server = Server::new(48, &[(0x2000, 0, &data), (0x6041, 0, &[0x37, 2])], &mischief);
        let mut client = client();
        if let Ok(read) = block_on(client.upload(&server, 0x2000, 0, false)) {
            // A smaller announced size means a shorter object; nothing on the wire contradicts it.
            prop_assert!(read.len() <= data.len());
        }
        server.forgive();
        prop_assert_eq!(block_on(client.upload(&server, 0x6041, 0, false)).unwrap(), vec![0x37, 2]);
        prop_assert!(server.now() < 3_000_000_000);
    }
}
