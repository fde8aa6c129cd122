//! A SubDevice with two mailboxes and an object dictionary, written from ETG.1000.4 and ETG.1000.6
//! independently of the client.

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::STATION;
use super::describe;
use super::fault_injection::Mischief;
use super::files::Files;
use ecaxis_master::mailbox::{DatagramError, MailboxTransport};

#[derive(Debug)]
enum Segmented {
    Idle,
    Up {
        rest: Vec<u8>,
        toggle: bool,
    },
    Down {
        index: u16,
        sub: u8,
        complete: bool,
        size: usize,
        data: Vec<u8>,
        toggle: bool,
    },
}

#[derive(Debug)]
struct Inner {
    objects: BTreeMap<(u16, u8), Vec<u8>>,
    mischief: Vec<Mischief>,
    out_mailbox: Option<Vec<u8>>,
    in_mailbox: Option<Vec<u8>>,
    filled_at: u64,
    last_sent: Vec<u8>,
    queue: VecDeque<Vec<u8>>,
    activate: u8,
    pdi_control: u8,
    last_counter: u8,
    own_counter: u8,
    requests_written: u32,
    answers_made: u32,
    answers_fetched: u32,
    fetches: u32,
    ready_at: u64,
    transfer: Segmented,
    log: Vec<Vec<u8>>,
    files: Files,
}

pub struct Server {
    inner: RefCell<Inner>,
    now: Cell<u64>,
    pub datagrams: Cell<u64>,
    /// How long a request stays in the mailbox.
    pub thinking: Cell<u64>,
    len: usize,
}

const FRAME_TIME: u64 = 20_000;
const THINKING: u64 = 300_000;

impl Server {
    pub fn new(len: u16, objects: &[(u16, u8, &[u8])], mischief: &[Mischief]) -> Self {
        Self {
            inner: RefCell::new(Inner {
                objects: objects
                    .iter()
                    .map(|&(index, sub, data)| ((index, sub), data.to_vec()))
                    .collect(),
                mischief: mischief.to_vec(),
                out_mailbox: None,
                in_mailbox: None,
                filled_at: 0,
                last_sent: Vec::new(),
                queue: VecDeque::new(),
                activate: 0x01,
                pdi_control: 0x00,
                last_counter: 0,
                own_counter: 0,
                requests_written: 0,
                answers_made: 0,
                answers_fetched: 0,
                fetches: 0,
                ready_at: 0,
                transfer: Segmented::Idle,
                log: Vec::new(),
                files: Files::default(),
            }),
            now: Cell::new(0),
            datagrams: Cell::new(0),
            thinking: Cell::new(THINKING),
            len: usize::from(len),
        }
    }

    pub fn object(&self, index: u16, sub: u8) -> Option<Vec<u8>> {
        self.inner.borrow().objects.get(&(index, sub)).cloned()
    }

    pub fn set(&self, index: u16, sub: u8, value: &[u8]) {
        self.inner
            .borrow_mut()
            .objects
            .insert((index, sub), value.to_vec());
    }

    /// Returns the processed requests without duplicates.
    pub fn log(&self) -> Vec<Vec<u8>> {
        self.inner.borrow().log.clone()
    }

    /// Gives access to the file server.
    pub fn files<T>(&self, with: impl FnOnce(&mut Files) -> T) -> T {
        with(&mut self.inner.borrow_mut().files)
    }

    pub fn forgive(&self) {
        self.inner.borrow_mut().mischief.clear();
    }

    pub fn pardon(&self, mischief: &Mischief) {
        self.inner
            .borrow_mut()
            .mischief
            .retain(|other| other != mischief);
    }

    pub fn commit(&self, mischief: Mischief) {
        self.inner.borrow_mut().mischief.push(mischief);
    }

    /// Returns since when a message has been waiting.
    pub fn full_since(&self) -> Option<u64> {
        let inner = self.inner.borrow();
        inner.in_mailbox.as_ref().map(|_| inner.filled_at)
    }

    /// Queues a message without a request.
    pub fn say(&self, bytes: &[u8]) {
        self.inner.borrow_mut().queue.push_back(bytes.to_vec());
        self.pass(0);
    }

    fn pass(&self, nanos: u64) {
        self.now.set(self.now.get() + nanos);
        self.inner.borrow_mut().work(self.now.get(), self.len);
    }
}

impl Inner {
    fn is(&self, mischief: &Mischief) -> bool {
        self.mischief.contains(mischief)
    }

    fn work(&mut self, now: u64, len: usize) {
        let blocked =
            self.is(&Mischief::Blocked) && (self.in_mailbox.is_some() || !self.queue.is_empty());
        if now >= self.ready_at
            && !self.is(&Mischief::Deaf)
            && !blocked
            && let Some(request) = self.out_mailbox.take()
        {
            self.serve(&request, len);
        }
        if (self.activate ^ self.pdi_control) & 0x02 != 0 && !self.is(&Mischief::NoRepeat) {
            self.pdi_control ^= 0x02;
            if self.in_mailbox.is_none() && !self.last_sent.is_empty() {
                self.in_mailbox = Some(self.last_sent.clone());
                self.filled_at = now;
            }
        }
        if self.in_mailbox.is_none()
            && let Some(mut message) = self.queue.pop_front()
        {
            message.resize(len, 0xa5);
            self.last_sent.clone_from(&message);
            self.in_mailbox = Some(message);
            self.filled_at = now;
        }
    }

    fn serve(&mut self, request: &[u8], len: usize) {
        let counter = request[5] >> 4;
        assert!((1..=7).contains(&counter), "counter {counter}");
        if counter == self.last_counter {
            return;
        }
        self.last_counter = counter;
        let length = usize::from(u16::from_le_bytes([request[0], request[1]]));
        assert!(
            length + 6 <= len,
            "the client announced more than the mailbox holds"
        );
        let body = request[6..6 + length].to_vec();
        self.log.push(body.clone());
        if self.is(&Mischief::Mute) {
            return;
        }
        if request[5] & 0x0f == 4 {
            for answer in self.files.answer(&body, len - 6) {
                self.give(4, &answer, len);
            }
            return;
        }
        assert_eq!(request[5] & 0x0f, 3, "CoE");
        let service = body[1] >> 4;
        let answers = match service {
            2 => self.answer(&body[2..], len).into_iter().collect(),
            8 => describe::answers(&self.objects, &body[2..], len),
            _ => panic!("service {service} is none of a client's"),
        };
        let service = if service == 8 { 0x80 } else { 0x30 };
        for answer in answers {
            self.give(3, &[&[0x00, service], &answer[..]].concat(), len);
        }
    }

    fn give(&mut self, protocol: u8, answer: &[u8], len: usize) {
        self.answers_made += 1;
        let n = self.answers_made;
        self.own_counter = self.own_counter % 7 + 1;
        let mut message = u16::try_from(answer.len()).unwrap().to_le_bytes().to_vec();
        message.extend([0, 0, 0, protocol | self.own_counter << 4]);
        message.extend(answer);
        for mischief in self.mischief.clone() {
            match mischief {
                Mischief::Before(at, bytes) if at == n => self.queue.push_back(bytes),
                Mischief::Replace(at, bytes) if at == n => message = bytes,
                Mischief::Corrupt(at, position, to) if at == n => {
                    message.resize(len, 0xa5);
                    let position = position % len;
                    message[position] = to;
                }
                Mischief::Skip(at) if at == n => return,
                _ => {}
            }
        }
        self.queue.push_back(message);
    }

    fn answer(&mut self, sdo: &[u8], len: usize) -> Option<Vec<u8>> {
        let command = sdo[0];
        let segment_toggle = command & 0x10 != 0;
        match command >> 5 {
            0 => Some(self.take_segment(sdo, segment_toggle)),
            1 => Some(self.begin_download(sdo)),
            2 => Some(self.begin_upload(sdo, len)),
            3 => Some(self.give_segment(segment_toggle, len)),
            4 => {
                self.transfer = Segmented::Idle;
                None
            }
            _ => Some(abort(0, 0, 0x0504_0001)),
        }
    }

    fn begin_upload(&mut self, sdo: &[u8], len: usize) -> Vec<u8> {
        let (index, sub) = (u16::from_le_bytes([sdo[1], sdo[2]]), sdo[3]);
        let complete = sdo[0] & 0x10 != 0;
        if self.is(&Mischief::WriteOnly(index)) {
            return abort(index, sub, 0x0601_0001);
        }
        let data = if complete {
            self.whole(index, sub)
        } else {
            self.objects.get(&(index, sub)).cloned()
        };
        let Some(data) = data else {
            let known = self.objects.keys().any(|key| key.0 == index);
            return abort(index, sub, if known { 0x0609_0011 } else { 0x0602_0000 });
        };
        let address = [sdo[1], sdo[2], sub];
        if (1..=4).contains(&data.len()) && !complete {
            let mut answer = vec![0x43 | (4 - u8::try_from(data.len()).unwrap()) << 2];
            answer.extend(address);
            answer.extend(&data);
            answer.resize(8, 0);
            return answer;
        }
        let announced = self
            .mischief
            .iter()
            .find_map(|m| {
                if let Mischief::AnnounceSize(size) = m {
                    Some(*size)
                } else {
                    None
                }
            })
            .unwrap_or(u32::try_from(data.len()).unwrap());
        let mut answer = vec![if complete { 0x51 } else { 0x41 }];
        answer.extend(address);
        answer.extend(announced.to_le_bytes());
        let room = len - 16;
        let (now, later) = data.split_at(room.min(data.len()));
        answer.extend(now);
        self.transfer = Segmented::Up {
            rest: later.to_vec(),
            toggle: false,
        };
        answer
    }

    fn give_segment(&mut self, toggle: bool, len: usize) -> Vec<u8> {
        let wrong = self.is(&Mischief::WrongToggle);
        let empty = self.is(&Mischief::EmptySegments);
        let Segmented::Up {
            rest,
            toggle: expected,
        } = &mut self.transfer
        else {
            return abort(0, 0, 0x0504_0001);
        };
        if toggle != *expected {
            return abort(0, 0, 0x0503_0000);
        }
        *expected = !*expected;
        let echo = if toggle != wrong { 0x10 } else { 0 };
        if empty {
            return vec![echo | 7 << 1, 0, 0, 0, 0, 0, 0, 0];
        }
        let room = len - 9;
        let part: Vec<u8> = rest.drain(..room.min(rest.len())).collect();
        let last = rest.is_empty();
        let unused = u8::try_from(7usize.saturating_sub(part.len())).unwrap();
        let mut answer = vec![echo | unused << 1 | u8::from(last)];
        answer.extend(&part);
        answer.resize(answer.len().max(8), 0xa5);
        answer
    }

    fn begin_download(&mut self, sdo: &[u8]) -> Vec<u8> {
        let (index, sub) = (u16::from_le_bytes([sdo[1], sdo[2]]), sdo[3]);
        let complete = sdo[0] & 0x10 != 0;
        let refusal = self.mischief.iter().find_map(|mischief| match mischief {
            Mischief::NoCompleteAccess(code) => Some(*code),
            _ => None,
        });
        if let Some(code) = refusal.filter(|_| complete) {
            return abort(index, sub, code);
        }
        if sdo[0] & 0x02 != 0 {
            let used = if sdo[0] & 1 != 0 {
                4 - usize::from(sdo[0] >> 2 & 3)
            } else {
                4
            };
            return self.store(index, sub, complete, &sdo[4..4 + used]);
        }
        let size = usize::try_from(u32::from_le_bytes(sdo[4..8].try_into().unwrap())).unwrap();
        let data = sdo[8..].to_vec();
        if data.len() == size {
            return self.store(index, sub, complete, &data);
        }
        if data.len() > size {
            return abort(index, sub, 0x0607_0012);
        }
        if !complete && !self.objects.contains_key(&(index, sub)) {
            return abort(index, sub, 0x0602_0000);
        }
        self.transfer = Segmented::Down {
            index,
            sub,
            complete,
            size,
            data,
            toggle: false,
        };
        vec![0x60, sdo[1], sdo[2], sub, 0, 0, 0, 0]
    }

    fn take_segment(&mut self, sdo: &[u8], toggle: bool) -> Vec<u8> {
        let wrong = self.is(&Mischief::WrongToggle);
        let Segmented::Down {
            index,
            sub,
            complete,
            size,
            data,
            toggle: expected,
        } = &mut self.transfer
        else {
            return abort(0, 0, 0x0504_0001);
        };
        if toggle != *expected {
            return abort(*index, *sub, 0x0503_0000);
        }
        *expected = !*expected;
        let mut part = &sdo[1..];
        if part.len() == 7 {
            part = &part[..7 - usize::from(sdo[0] >> 1 & 7)];
        }
        data.extend_from_slice(part);
        if sdo[0] & 1 != 0 {
            let (index, sub, complete, data, fits) =
                (*index, *sub, *complete, data.clone(), data.len() == *size);
            self.transfer = Segmented::Idle;
            if !fits {
                return abort(index, sub, 0x0607_0010);
            }
            let stored = self.store(index, sub, complete, &data);
            if stored[0] == 0x80 {
                return stored;
            }
        }
        vec![
            0x20 | if toggle != wrong { 0x10 } else { 0 },
            0,
            0,
            0,
            0,
            0,
            0,
            0,
        ]
    }

    fn store(&mut self, index: u16, sub: u8, complete: bool, data: &[u8]) -> Vec<u8> {
        let address = index.to_le_bytes();
        if complete {
            let mut rest = data.to_vec();
            let keys: Vec<_> = self
                .objects
                .keys()
                .filter(|k| k.0 == index && k.1 >= sub)
                .copied()
                .collect();
            for key in keys {
                let old = self.objects[&key].len();
                let take = if key.1 == 0 { 2 } else { old };
                if rest.len() < take {
                    return abort(index, sub, 0x0607_0013);
                }
                let mut value: Vec<u8> = rest.drain(..take).collect();
                value.truncate(old);
                self.objects.insert(key, value);
            }
            return vec![0x70, address[0], address[1], sub, 0, 0, 0, 0];
        }
        let forgetful = self.is(&Mischief::Forgetful);
        match self.objects.get_mut(&(index, sub)) {
            None => abort(index, sub, 0x0602_0000),
            Some(_) if index == 0x1000 => abort(index, sub, 0x0601_0002),
            Some(value) => {
                if !forgetful {
                    *value = data.to_vec();
                }
                vec![0x60, address[0], address[1], sub, 0, 0, 0, 0]
            }
        }
    }

    fn whole(&self, index: u16, from: u8) -> Option<Vec<u8>> {
        let mut bytes = Vec::new();
        for (key, value) in self
            .objects
            .iter()
            .filter(|(key, _)| key.0 == index && key.1 >= from)
        {
            bytes.extend(value);
            // Subindex 0 takes 16 bits.
            if key.1 == 0 {
                bytes.push(0);
            }
        }
        (!bytes.is_empty()).then_some(bytes)
    }
}

fn abort(index: u16, sub: u8, code: u32) -> Vec<u8> {
    let [low, high] = index.to_le_bytes();
    let mut answer = vec![0x80, low, high, sub];
    answer.extend(code.to_le_bytes());
    answer
}

impl MailboxTransport for Server {
    async fn read(
        &self,
        station: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        self.datagrams.set(self.datagrams.get() + 1);
        self.pass(FRAME_TIME);
        let lost = Err(DatagramError::Timeout { station, register });
        let mut inner = self.inner.borrow_mut();
        if inner.is(&Mischief::Off) || station != STATION {
            return Ok(0);
        }
        if register == 0x1400 {
            assert_eq!(buf.len(), self.len, "a mailbox is read whole");
            inner.fetches += 1;
            if inner.is(&Mischief::LoseFetch(inner.fetches)) {
                return lost;
            }
            let Some(message) = inner.in_mailbox.take() else {
                return Ok(0);
            };
            inner.answers_fetched += 1;
            if inner.is(&Mischief::LoseAnswer(inner.answers_fetched)) {
                return lost;
            }
            if inner.is(&Mischief::FetchTwice(inner.answers_fetched)) {
                return Ok(0);
            }
            buf.copy_from_slice(&message);
            return Ok(1);
        }
        buf[0] = match register {
            0x0805 => 0x26 | u8::from(inner.out_mailbox.is_some()) << 3,
            0x080d => 0x22 | u8::from(inner.in_mailbox.is_some()) << 3,
            0x080e => inner.activate,
            0x080f => inner.pdi_control,
            _ => panic!("register {register:#06x} is none of a mailbox"),
        };
        Ok(1)
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        self.datagrams.set(self.datagrams.get() + 1);
        self.pass(FRAME_TIME);
        let lost = Err(DatagramError::Timeout { station, register });
        let mut inner = self.inner.borrow_mut();
        if inner.is(&Mischief::Off) || station != STATION {
            return Ok(0);
        }
        match register {
            0x1000 => {
                assert_eq!(data.len(), self.len, "a mailbox is written whole");
                inner.requests_written += 1;
                if inner.is(&Mischief::LoseRequest(inner.requests_written)) {
                    return lost;
                }
                if inner.out_mailbox.is_some() {
                    return Ok(0);
                }
                inner.out_mailbox = Some(data.to_vec());
                inner.ready_at = self.now.get() + self.thinking.get();
                if inner.is(&Mischief::LoseRequestEcho(inner.requests_written)) {
                    return lost;
                }
                if inner.is(&Mischief::RequestTwice(inner.requests_written)) {
                    drop(inner);
                    self.pass(FRAME_TIME);
                    let mut inner = self.inner.borrow_mut();
                    if inner.out_mailbox.is_some() {
                        return Ok(0);
                    }
                    inner.out_mailbox = Some(data.to_vec());
                }
                Ok(1)
            }
            0x080e => {
                let waits = (inner.activate ^ data[0]) & 2 != 0 && inner.in_mailbox.is_some();
                assert!(
                    !waits,
                    "a repeat was asked for while the message still waits"
                );
                inner.activate = data[0];
                Ok(1)
            }
            _ => panic!("register {register:#06x} is not to be written"),
        }
    }

    async fn delay(&self, duration: Duration) {
        self.pass(u64::try_from(duration.as_nanos()).unwrap());
    }

    fn now(&self) -> u64 {
        self.now.get()
    }
}
