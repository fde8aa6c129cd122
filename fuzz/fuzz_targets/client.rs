//! The mailbox clients with a device that may send anything: SDO transfers, SDO Information, files.
//! Each request must end.
#![no_main]

use std::cell::{Cell, RefCell};
use std::pin::pin;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use ecaxis_master::mailbox::{
    CoeClient, DatagramError, FoeClient, MailboxLayout, MailboxTransport, ObjectList,
};
use libfuzzer_sys::fuzz_target;

const LEN: u16 = 48;
const LAYOUT: MailboxLayout = MailboxLayout {
    station: 0x1001,
    out_address: 0x1000,
    out_len: LEN,
    in_address: 0x1030,
    in_len: LEN,
    out_sm: 0,
    in_sm: 1,
};
/// The status register of SyncManager 1, and its bit "mailbox full".
const STATUS: u16 = 0x080d;
const FULL: u8 = 0x08;
/// More datagrams than any request needs.
const DATAGRAMS: u32 = 2_000_000;
const INDEX: u16 = 0x2000;

/// A device that sends the messages of the input in order.
struct Device<'a> {
    rest: RefCell<&'a [u8]>,
    now: Cell<u64>,
    datagrams: Cell<u32>,
    counter: Cell<u8>,
}

impl Device<'_> {
    fn passed(&self) {
        self.datagrams.set(self.datagrams.get() + 1);
        assert!(
            self.datagrams.get() < DATAGRAMS,
            "it does not come to an end"
        );
    }

    /// Writes the next message: length, kind and bytes. A kind above 0x7f is followed by a header
    /// of six bytes that may be wrong.
    fn say(&self, mailbox: &mut [u8]) {
        mailbox.fill(0);
        let mut rest = self.rest.borrow_mut();
        let Some((len, after)) = rest.split_first() else {
            return;
        };
        let (message, later) = after.split_at(usize::from(*len).min(after.len()));
        *rest = later;
        let Some((kind, body)) = message.split_first() else {
            return;
        };
        let place = if kind & 0x80 != 0 {
            mailbox
        } else {
            let counter = self.counter.get() % 7 + 1;
            self.counter.set(counter);
            let (header, data) = mailbox.split_at_mut(6);
            header[0] = body.len().min(data.len()) as u8;
            header[5] = counter << 4 | kind & 0x0f;
            data
        };
        for (to, from) in place.iter_mut().zip(body) {
            *to = *from;
        }
    }
}

impl MailboxTransport for Device<'_> {
    async fn read(&self, _: u16, register: u16, buffer: &mut [u8]) -> Result<u16, DatagramError> {
        self.passed();
        if register == LAYOUT.in_address {
            self.say(buffer);
        } else {
            let full = register == STATUS && !self.rest.borrow().is_empty();
            buffer.fill(if full { FULL } else { 0 });
        }
        Ok(1)
    }

    async fn write(&self, _: u16, _: u16, _: &[u8]) -> Result<u16, DatagramError> {
        self.passed();
        Ok(1)
    }

    async fn delay(&self, time: Duration) {
        self.now.set(self.now.get() + time.as_nanos() as u64);
    }

    fn now(&self) -> u64 {
        self.now.get()
    }
}

fn now<T>(question: impl Future<Output = T>) -> T {
    match pin!(question).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(answer) => answer,
        Poll::Pending => panic!("nothing waits but for virtual time"),
    }
}

fuzz_target!(|input: &[u8]| {
    let Some((questions, messages)) = input.split_first() else {
        return;
    };
    let device = Device {
        rest: RefCell::new(messages),
        now: Cell::new(0),
        datagrams: Cell::new(0),
        counter: Cell::new(0),
    };
    let mut coe = CoeClient::new(LAYOUT);
    let mut foe = FoeClient::new(LAYOUT);
    // Two requests, so that the second one runs with the remains of the first.
    for question in [questions & 0x0f, questions >> 4] {
        match question {
            0 => drop(now(coe.upload(&device, INDEX, 1, false))),
            1 => drop(now(coe.upload(&device, INDEX, 0, true))),
            2 => drop(now(coe.download(&device, INDEX, 1, false, &[1, 2, 3, 4]))),
            3 => drop(now(coe.download(&device, INDEX, 0, true, &[5; 300]))),
            4 => drop(now(coe.list_lengths(&device))),
            5 => drop(now(coe.object_list(&device, ObjectList::All))),
            6 => drop(now(coe.object_description(&device, INDEX))),
            7 => drop(now(coe.entry_description(&device, INDEX, 1))),
            8 => drop(now(foe.read(&device, "a.bin", 0, 1_000, &mut |_| {}))),
            9 => drop(now(foe.write(&device, "a.bin", 7, &[9; 200], &mut |_| {}))),
            _ => drop(now(coe.drain(&device))),
        }
    }
    for emergency in coe.take_emergencies() {
        let _ = emergency.to_string();
    }
});
