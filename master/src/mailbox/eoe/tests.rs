//! Fragments next to the requests of others, at a device in memory.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};

use super::*;
use crate::eoe::{EoeNetwork, HostPort};
use crate::mailbox::worker::{EmergencySink, MailboxWorker, WorkerConfig, open, run_with_workers};
use crate::mailbox::{DatagramError, Emergencies, MailboxLayout, Mailboxes};

const LENGTH: u16 = 128;
const LAYOUT: MailboxLayout = MailboxLayout {
    station: 0x1001,
    out_address: 0x1000,
    out_len: LENGTH,
    in_address: 0x1400,
    in_len: LENGTH,
    out_sm: 0,
    in_sm: 1,
};
const MS: u64 = 1_000_000;
const ANSWER: [u8; 4] = [1, 2, 3, 4];

/// A device with the object 0x1000 and one message at a time in each mailbox.
#[derive(Default)]
struct Device {
    now: Cell<u64>,
    /// The mailbox error for fragments, and messages that precede each answer.
    error: Cell<u16>,
    before_answer: RefCell<Vec<Vec<u8>>>,
    /// The time that the device takes for a fragment.
    slow: Cell<u64>,
    /// The wire repeats the next write; the reply to the first one is lost.
    repeats_write: Cell<bool>,
    /// No reply to a write arrives.
    loses_writes: Cell<bool>,
    /// The out mailbox is full, and the device does not read it.
    stuck: Cell<bool>,
    out: RefCell<Option<(u64, Vec<u8>)>>,
    counter: Cell<u8>,
    fragments: Cell<u32>,
    /// The next message is lost on its way, and is not repeated.
    loses_read: Cell<bool>,
    /// Another port, and whether it could have the turn while a message was to be repeated.
    other: RefCell<Option<EoePort>>,
    turn_was_free: Cell<Option<bool>>,
    incoming: RefCell<VecDeque<Vec<u8>>>,
}

fn mailbox(protocol: u8, body: &[u8]) -> Vec<u8> {
    let mut message = vec![u8::try_from(body.len()).unwrap(), 0, 0, 0, 0, protocol];
    message.extend(body);
    message.resize(LENGTH.into(), 0);
    message
}

impl Device {
    fn work(&self) {
        let now = self.now.get();
        let message = self.out.borrow_mut().take_if(|(due, _)| now >= *due);
        let Some((_, message)) = message else { return };
        let counter = message[5] >> 4;
        if self.counter.replace(counter) == counter {
            return;
        }
        let mut incoming = self.incoming.borrow_mut();
        match message[5] & 0x0f {
            2 => {
                self.fragments.set(self.fragments.get() + 1);
                let [low, high] = self.error.get().to_le_bytes();
                if (low, high) != (0, 0) {
                    incoming.push_back(mailbox(0, &[1, 0, low, high]));
                }
            }
            3 => {
                incoming.extend(self.before_answer.borrow_mut().drain(..));
                let mut body = vec![0, 0x30, 0x43, 0x00, 0x10, 0];
                body.extend(ANSWER);
                incoming.push_back(mailbox(3, &body));
            }
            other => panic!("protocol {other}"),
        }
    }
}

impl MailboxTransport for Device {
    async fn read(
        &self,
        station: u16,
        register: u16,
        bytes: &mut [u8],
    ) -> Result<u16, DatagramError> {
        self.delay(Duration::from_micros(100)).await;
        let full = |full| 8 * u8::from(full);
        if register == 0x1400 && self.loses_read.take() {
            self.incoming.borrow_mut().clear();
            return Err(DatagramError::Timeout { station, register });
        }
        match register {
            0x1400 => match self.incoming.borrow_mut().pop_front() {
                Some(message) => bytes.copy_from_slice(&message),
                None => return Ok(0),
            },
            0x0805 => bytes[0] = full(self.stuck.get() || self.out.borrow().is_some()),
            0x080d => bytes[0] = full(!self.incoming.borrow().is_empty()),
            0x080e | 0x080f => {
                let other = self.other.borrow();
                let turn = other.as_ref().and_then(EoePort::try_turn);
                self.turn_was_free.set(Some(turn.is_some()));
                bytes[0] = 0;
            }
            other => panic!("register {other:#06x}"),
        }
        Ok(1)
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        self.delay(Duration::from_micros(100)).await;
        if register == 0x080e {
            return Ok(1);
        }
        assert_eq!(register, 0x1000);
        if self.loses_writes.get() {
            return Err(DatagramError::Timeout { station, register });
        }
        if self.stuck.get() || self.out.borrow().is_some() {
            return Ok(0);
        }
        let slow = match data[5] & 0x0f {
            2 => self.slow.get(),
            _ => MS,
        };
        *self.out.borrow_mut() = Some((self.now.get() + slow, data.to_vec()));
        Ok(u16::from(!self.repeats_write.take()))
    }

    async fn delay(&self, duration: Duration) {
        let nanos = u64::try_from(duration.as_nanos()).unwrap();
        self.now.set(self.now.get() + nanos);
        self.work();
    }

    fn now(&self) -> u64 {
        self.now.get()
    }
}

#[derive(Debug)]
struct Ignore;

impl EmergencySink for Ignore {
    fn listen(&self, _: &str, _: &Emergencies) {}
}

fn open_one(device: Device, coe: CoeClient) -> (Mailboxes, Vec<MailboxWorker<Device>>) {
    let only = WorkerConfig {
        name: "a0".to_owned(),
        mailbox: Some((device, coe)),
    };
    let sink: Arc<dyn EmergencySink> = Arc::new(Ignore);
    open([only], &sink)
}

/// Nothing at the device waits.
fn ready<T>(future: impl Future<Output = T>) -> T {
    let mut context = Context::from_waker(Waker::noop());
    match pin!(future).poll(&mut context) {
        Poll::Ready(done) => done,
        Poll::Pending => panic!("it waits"),
    }
}

struct Bench {
    device: Device,
    coe: CoeClient,
    sender: EoeSender,
    network: EoeNetwork,
    host: HostPort,
}

impl Bench {
    fn new() -> Self {
        let network = EoeNetwork::default();
        let mut coe = CoeClient::new(LAYOUT);
        coe.connect(network.add_device("a0", false));
        let mut bench = Self {
            device: Device::default(),
            coe,
            sender: EoeSender::default(),
            host: network.add_host("ecat0"),
            network,
        };
        bench.device.slow.set(MS);
        assert_eq!(bench.upload(), Ok(ANSWER.to_vec()));
        bench
    }

    fn frame(&self) {
        let mut frame = [0xff; 60];
        frame[6..12].copy_from_slice(&[2, 0, 0, 0, 0, 1]);
        self.host.receive(self.device.now(), &frame);
    }

    fn send(&mut self) {
        let turn = self.coe.port.eoe.as_ref().and_then(EoePort::try_turn);
        let turn = turn.expect("no other has it");
        ready(self.coe.send_fragment(&self.device, &mut self.sender, turn));
    }

    fn upload(&mut self) -> Result<Vec<u8>, String> {
        let done = ready(self.coe.upload(&self.device, 0x1000, 0, false));
        done.map_err(|error| error.to_string())
    }

    fn counters(&self) -> crate::eoe::EthernetCounters {
        self.network.counters().swap_remove(0)
    }
}

#[test]
fn mailbox_error_for_a_fragment_does_not_fail_an_sdo() {
    let mut bench = Bench::new();
    bench.device.error.set(0x0005);
    for n in 1..=3 {
        bench.frame();
        bench.send();
        assert_eq!(bench.upload(), Ok(ANSWER.to_vec()), "{n}");
        assert_eq!(bench.counters().refused, n);
    }
    assert_eq!(bench.device.fragments.get(), 3);
    // Without a fragment, the error belongs to the SDO.
    let error = mailbox(0, &[1, 0, 5, 0]);
    bench.device.before_answer.borrow_mut().push(error);
    let failed = bench.upload().expect_err("refused");
    assert!(failed.contains("0x0005"), "{failed}");
}

#[test]
fn device_without_eoe_gets_no_more_frames() {
    let mut bench = Bench::new();
    bench.device.error.set(0x0002);
    bench.frame();
    bench.frame();
    bench.send();
    assert_eq!(bench.upload(), Ok(ANSWER.to_vec()));
    for _ in 0..3 {
        bench.frame();
        bench.send();
    }
    assert_eq!(bench.device.fragments.get(), 1);
    let counters = bench.counters();
    assert!(counters.unsupported, "{counters:?}");
    assert_eq!((counters.refused, counters.not_taken), (1, 4));
    // A device that has restarted may have another firmware.
    bench.coe = bench.coe.restarted();
    assert!(!bench.counters().unsupported);
}

#[test]
fn sdo_waits_for_a_device_that_is_busy_with_a_fragment() {
    let mut bench = Bench::new();
    bench.device.slow.set(800 * MS);
    bench.frame();
    bench.send();
    assert_eq!(bench.upload(), Ok(ANSWER.to_vec()));
    assert_eq!(bench.device.fragments.get(), 1);
}

#[test]
fn counter_of_a_repeated_write_is_not_used_again() {
    let mut bench = Bench::new();
    bench.frame();
    bench.device.repeats_write.set(true);
    bench.send();
    assert_eq!(bench.upload(), Ok(ANSWER.to_vec()));
    // The fragment comes again, after the request.
    bench.send();
    assert_eq!(bench.upload(), Ok(ANSWER.to_vec()));
    assert_eq!(bench.device.fragments.get(), 2);
    // The same fragment has the same counter, and the device takes it once.
    bench.frame();
    bench.device.repeats_write.set(true);
    bench.send();
    ready(bench.device.delay(Duration::from_millis(50)));
    bench.send();
    ready(bench.device.delay(Duration::from_millis(50)));
    assert_eq!(bench.upload(), Ok(ANSWER.to_vec()));
    assert_eq!(bench.device.fragments.get(), 3);
}

#[test]
fn damaged_eoe_does_not_fail_an_sdo() {
    let mut bench = Bench::new();
    let mut damaged = mailbox(2, &[0; 20]);
    damaged[..2].copy_from_slice(&[0xff, 0xff]);
    bench.device.before_answer.borrow_mut().push(damaged);
    assert_eq!(bench.upload(), Ok(ANSWER.to_vec()));
    assert_eq!(bench.counters().invalid, 1);
}

#[test]
fn frames_that_a_device_does_not_take_are_counted() {
    let mut bench = Bench::new();
    bench.frame();
    bench.device.loses_writes.set(true);
    bench.send();
    bench.device.loses_writes.set(false);
    assert_eq!(bench.counters().not_taken, 1);
    bench.device.stuck.set(true);
    bench.frame();
    let before = bench.device.now();
    while bench.counters().not_taken == 1 {
        bench.send();
        ready(bench.device.delay(Duration::from_millis(20)));
    }
    assert!(bench.device.now() - before > TAKES_NONE);
    // A frame after a long pause is offered again and again, too.
    ready(bench.device.delay(Duration::from_secs(10)));
    bench.frame();
    bench.send();
    bench.send();
    assert_eq!(bench.counters().not_taken, 2);
    bench.device.stuck.set(false);
    bench.send();
    assert_eq!(
        (bench.counters().not_taken, bench.counters().to_port),
        (2, 1)
    );
}

#[test]
fn device_that_repeats_nothing_leaves_the_turn_to_others() {
    let mut bench = Bench::new();
    let other = bench.network.add_device("a1", false);
    bench.device.other.replace(Some(other.clone()));
    bench.device.loses_read.set(true);
    let lost = mailbox(2, &[0; 20]);
    bench.device.incoming.borrow_mut().push_back(lost);
    let turn = other.try_turn().expect("no other has it");
    ready(bench.coe.take_message(&bench.device, turn));
    assert_eq!(bench.device.turn_was_free.get(), Some(true));
}

#[test]
fn sdo_is_served_while_another_device_has_the_turn() {
    let bench = Bench::new();
    let other = bench.network.add_device("a1", false);
    bench.frame();
    let (mailboxes, workers) = open_one(bench.device, bench.coe);
    let _turn = other.try_turn().expect("no other has it");
    let upload = async {
        // The worker waits for the turn.
        tokio::task::yield_now().await;
        mailboxes.upload("a0", 0x1000, 0).await
    };
    let mut upload = pin!(run_with_workers(workers, upload));
    let mut context = Context::from_waker(Waker::noop());
    let answer = (0..5).find_map(|_| match upload.as_mut().poll(&mut context) {
        Poll::Ready(answer) => Some(answer),
        Poll::Pending => None,
    });
    assert_eq!(answer, Some(Ok(ANSWER.to_vec())));
    assert_eq!(bench.network.counters()[0].to_port, 0);
}
