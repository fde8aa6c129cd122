//! SDO over CAN (CiA 301 §7.2.4): eight bytes each way, expedited and segmented.

use super::Abort;

pub(super) type Message = [u8; 8];

/// The largest segmented transfer, in bytes.
const MAX_SIZE: usize = 0x1_0000;

/// The objects that a server reads and writes.
pub(super) trait Objects {
    fn read(&self, index: u16, sub: u8) -> Result<Vec<u8>, Abort>;
    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort>;
}

#[derive(Debug, Clone)]
enum Transfer {
    Upload {
        data: Vec<u8>,
        at: usize,
        toggle: bool,
    },
    Download {
        data: Vec<u8>,
        /// The announced size. 0: the client announced none.
        size: usize,
        toggle: bool,
    },
}

#[derive(Debug, Clone, Default)]
pub(super) struct Server {
    transfer: Option<(u16, u8, Transfer)>,
}

fn message(command: u8, index: u16, sub: u8, data: &[u8]) -> Message {
    let [low, high] = index.to_le_bytes();
    let mut out = [command, low, high, sub, 0, 0, 0, 0];
    for (to, from) in out.iter_mut().skip(4).zip(data) {
        *to = *from;
    }
    out
}

/// Returns one segment of up to seven bytes, its length, and whether it is the last.
fn segment(command: u8, rest: &[u8]) -> (Message, usize, bool) {
    let now = rest.len().min(7);
    let last = now == rest.len();
    let unused = if last { 7 - now as u8 } else { 0 };
    let mut out = [command | unused << 1 | u8::from(last), 0, 0, 0, 0, 0, 0, 0];
    for (to, from) in out.iter_mut().skip(1).zip(rest) {
        *to = *from;
    }
    (out, now, last)
}

fn content(segment: &Message) -> (&[u8], bool) {
    let [command, data @ ..] = segment;
    let used = 7 - usize::from(command >> 1 & 7);
    (data.get(..used).unwrap_or_default(), command & 1 != 0)
}

fn address(message: &Message) -> (u16, u8) {
    (u16::from_le_bytes([message[1], message[2]]), message[3])
}

fn expedited(message: &Message) -> &[u8] {
    let used = if message[0] & 1 != 0 {
        4 - usize::from(message[0] >> 2 & 3)
    } else {
        4
    };
    message.get(4..4 + used).unwrap_or_default()
}

fn size(message: &Message) -> u32 {
    u32::from_le_bytes([message[4], message[5], message[6], message[7]])
}

impl Server {
    pub(super) fn reset(&mut self) {
        self.transfer = None;
    }

    /// Returns the answer to one request. An abort by the client has no answer.
    pub(super) fn request(
        &mut self,
        objects: &mut impl Objects,
        request: &Message,
    ) -> Option<Message> {
        let result = match request[0] >> 5 {
            0 => self.download_segment(objects, request),
            1 => self.download(objects, request),
            2 => self.upload(objects, request),
            3 => self.upload_segment(request),
            4 => {
                self.transfer = None;
                return None;
            }
            _ => Err((Abort::COMMAND, address(request))),
        };
        Some(result.unwrap_or_else(|(abort, (index, sub))| {
            self.transfer = None;
            message(0x80, index, sub, &abort.0.to_le_bytes())
        }))
    }

    fn upload(&mut self, objects: &impl Objects, request: &Message) -> Reply {
        let (index, sub) = address(request);
        self.transfer = None;
        let data = objects
            .read(index, sub)
            .map_err(|abort| (abort, (index, sub)))?;
        if (1..=4).contains(&data.len()) {
            let unused = 4 - data.len() as u8;
            return Ok(message(0x43 | unused << 2, index, sub, &data));
        }
        let size = u32::try_from(data.len()).unwrap_or(u32::MAX);
        let transfer = Transfer::Upload {
            data,
            at: 0,
            toggle: false,
        };
        self.transfer = Some((index, sub, transfer));
        Ok(message(0x41, index, sub, &size.to_le_bytes()))
    }

    fn upload_segment(&mut self, request: &Message) -> Reply {
        let Some((index, sub, Transfer::Upload { data, at, toggle })) = &mut self.transfer else {
            return Err((Abort::COMMAND, (0, 0)));
        };
        if (request[0] & 0x10 != 0) != *toggle {
            return Err((Abort::TOGGLE, (*index, *sub)));
        }
        let rest = data.get(*at..).unwrap_or_default();
        let (out, now, last) = segment(request[0] & 0x10, rest);
        *at += now;
        *toggle = !*toggle;
        if last {
            self.transfer = None;
        }
        Ok(out)
    }

    fn download(&mut self, objects: &mut impl Objects, request: &Message) -> Reply {
        let (index, sub) = address(request);
        let fail = |abort| (abort, (index, sub));
        self.transfer = None;
        if request[0] & 2 != 0 {
            // Without an announced size the object's own length applies.
            let mut data = expedited(request);
            if request[0] & 1 == 0
                && let Ok(now) = objects.read(index, sub)
            {
                data = data.get(..now.len()).unwrap_or(data);
            }
            objects.write(index, sub, data).map_err(fail)?;
        } else {
            let size = if request[0] & 1 != 0 {
                size(request)
            } else {
                0
            };
            let size = usize::try_from(size).unwrap_or(usize::MAX);
            if size > MAX_SIZE {
                return Err(fail(Abort::TOO_LONG));
            }
            let transfer = Transfer::Download {
                data: Vec::new(),
                size,
                toggle: false,
            };
            self.transfer = Some((index, sub, transfer));
        }
        Ok(message(0x60, index, sub, &[]))
    }

    fn download_segment(&mut self, objects: &mut impl Objects, request: &Message) -> Reply {
        let Some((index, sub, Transfer::Download { data, size, toggle })) = &mut self.transfer
        else {
            return Err((Abort::COMMAND, (0, 0)));
        };
        let address = (*index, *sub);
        if (request[0] & 0x10 != 0) != *toggle {
            return Err((Abort::TOGGLE, address));
        }
        let (bytes, last) = content(request);
        data.extend_from_slice(bytes);
        *toggle = !*toggle;
        if data.len() > if *size > 0 { *size } else { MAX_SIZE } {
            return Err((Abort::TOO_LONG, address));
        }
        if last {
            let (data, size) = (std::mem::take(data), *size);
            self.transfer = None;
            if data.len() < size {
                return Err((Abort::TOO_SHORT, address));
            }
            objects
                .write(address.0, address.1, &data)
                .map_err(|abort| (abort, address))?;
        }
        Ok([0x20 | request[0] & 0x10, 0, 0, 0, 0, 0, 0, 0])
    }
}

type Reply = Result<Message, (Abort, (u16, u8))>;

/// One transfer of a client.
#[derive(Debug, Clone)]
pub(super) struct Client {
    index: u16,
    sub: u8,
    download: bool,
    data: Vec<u8>,
    at: usize,
    toggle: bool,
}

/// The client's reaction to a response.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Progress {
    Send(Message),
    Done(Result<Vec<u8>, Abort>),
}

impl Client {
    /// Starts an upload, or with data a download. Returns the first message.
    pub(super) fn start(index: u16, sub: u8, data: Option<Vec<u8>>) -> (Self, Message) {
        let download = data.is_some();
        let data = data.unwrap_or_default();
        let first = match (download, data.len()) {
            (false, _) => message(0x40, index, sub, &[]),
            (true, 1..=4) => message(0x23 | (4 - data.len() as u8) << 2, index, sub, &data),
            (true, len) => {
                let size = u32::try_from(len).unwrap_or(u32::MAX);
                message(0x21, index, sub, &size.to_le_bytes())
            }
        };
        let client = Self {
            index,
            sub,
            download,
            data,
            at: 0,
            toggle: false,
        };
        (client, first)
    }

    /// Returns the message that aborts the transfer.
    pub(super) fn give_up(&self) -> Message {
        message(0x80, self.index, self.sub, &Abort::TIMEOUT.0.to_le_bytes())
    }

    pub(super) fn response(&mut self, response: &Message) -> Progress {
        let initiated = address(response) == (self.index, self.sub);
        match response[0] >> 5 {
            4 => Progress::Done(Err(Abort(size(response)))),
            2 if !self.download && initiated && response[0] & 2 != 0 => {
                Progress::Done(Ok(expedited(response).to_vec()))
            }
            2 if !self.download && initiated => Progress::Send(self.ask()),
            0 if !self.download => {
                let (bytes, last) = content(response);
                self.data.extend_from_slice(bytes);
                if last {
                    return Progress::Done(Ok(std::mem::take(&mut self.data)));
                }
                if self.data.len() > MAX_SIZE {
                    return Progress::Done(Err(Abort::TOO_LONG));
                }
                self.toggle = !self.toggle;
                Progress::Send(self.ask())
            }
            3 if self.download && initiated => {
                if (1..=4).contains(&self.data.len()) {
                    return Progress::Done(Ok(Vec::new()));
                }
                Progress::Send(self.next_segment())
            }
            1 if self.download => {
                if self.at >= self.data.len() {
                    return Progress::Done(Ok(Vec::new()));
                }
                self.toggle = !self.toggle;
                Progress::Send(self.next_segment())
            }
            _ => Progress::Done(Err(Abort::COMMAND)),
        }
    }

    fn ask(&self) -> Message {
        [0x60 | u8::from(self.toggle) << 4, 0, 0, 0, 0, 0, 0, 0]
    }

    fn next_segment(&mut self) -> Message {
        let rest = self.data.get(self.at..).unwrap_or_default();
        let (out, now, _) = segment(u8::from(self.toggle) << 4, rest);
        self.at += now;
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[derive(Default)]
    struct TestObject(Vec<u8>);

    impl Objects for TestObject {
        fn read(&self, index: u16, _: u8) -> Result<Vec<u8>, Abort> {
            match index {
                0x2000 => Ok(self.0.clone()),
                _ => Err(Abort::NO_OBJECT),
            }
        }

        fn write(&mut self, index: u16, _: u8, data: &[u8]) -> Result<(), Abort> {
            match index {
                0x2000 => self.0 = data.to_vec(),
                _ => return Err(Abort::NO_OBJECT),
            }
            Ok(())
        }
    }

    /// Returns the result and the messages sent.
    fn transfer(
        objects: &mut TestObject,
        index: u16,
        data: Option<Vec<u8>>,
    ) -> (Result<Vec<u8>, Abort>, usize) {
        let mut server = Server::default();
        let (mut client, mut next) = Client::start(index, 3, data);
        for n in 1.. {
            let response = server.request(objects, &next).unwrap();
            match client.response(&response) {
                Progress::Send(message) => next = message,
                Progress::Done(result) => return (result, n),
            }
        }
        unreachable!()
    }

    /// The application note's overview: reading and writing one, two and four bytes.
    #[test]
    fn command_specifiers_of_expedited_transfers() {
        for (len, read, write) in [(1, 0x4f, 0x2f), (2, 0x4b, 0x2b), (4, 0x43, 0x23)] {
            let mut objects = TestObject(vec![0x5a; len]);
            let answer = Server::default().request(&mut objects, &message(0x40, 0x2000, 0, &[]));
            assert_eq!(answer.unwrap()[0], read);
            let (_, request) = Client::start(0x2000, 0, Some(vec![1; len]));
            assert_eq!(request[0], write);
            let answer = Server::default().request(&mut objects, &request);
            assert_eq!(answer.unwrap()[..4], [0x60, 0, 0x20, 0]);
            assert_eq!(objects.0, vec![1; len]);
        }
    }

    #[test]
    fn sdo_server_aborts_on_wrong_toggles_commands_and_lengths() {
        let mut objects = TestObject(vec![7; 20]);
        let mut server = Server::default();
        let abort = |answer: Option<Message>| size(&answer.unwrap());
        server.request(&mut objects, &message(0x40, 0x2000, 0, &[]));
        assert_eq!(
            abort(server.request(&mut objects, &[0x70, 0, 0, 0, 0, 0, 0, 0])),
            0x0503_0000
        );
        assert_eq!(
            abort(server.request(&mut objects, &[0x60, 0, 0, 0, 0, 0, 0, 0])),
            0x0504_0001
        );
        assert_eq!(
            abort(server.request(&mut objects, &[0xe0, 0, 0, 0, 0, 0, 0, 0])),
            0x0504_0001
        );
        server.request(&mut objects, &message(0x21, 0x2000, 0, &[9]));
        assert_eq!(
            abort(server.request(&mut objects, &[0x01, 1, 2, 3, 4, 5, 6, 7])),
            0x0607_0013
        );
        server.request(&mut objects, &message(0x21, 0x2000, 0, &[3]));
        assert_eq!(
            abort(server.request(&mut objects, &[0x01, 1, 2, 3, 4, 5, 6, 7])),
            0x0607_0012
        );
        assert_eq!(objects.0, [7; 20]);
        assert_eq!(
            server.request(&mut objects, &[0x80, 0, 0, 0, 0, 0, 0, 0]),
            None
        );
        assert_eq!(
            transfer(&mut objects, 0x2001, None).0,
            Err(Abort::NO_OBJECT)
        );
    }

    proptest! {
        #[test]
        fn sdo_transfers_of_any_length_survive_a_round_trip(data in prop::collection::vec(any::<u8>(), 1..300)) {
            let mut objects = TestObject::default();
            let (result, messages) = transfer(&mut objects, 0x2000, Some(data.clone()));
            prop_assert_eq!(result, Ok(Vec::new()));
            prop_assert_eq!(&objects.0, &data);
            let segments = if data.len() > 4 { data.len().div_ceil(7) } else { 0 };
            prop_assert_eq!(messages, 1 + segments);
            prop_assert_eq!(transfer(&mut objects, 0x2000, None), (Ok(data), 1 + segments));
        }

        #[test]
        fn sdo_server_survives_random_messages(messages in prop::collection::vec(any::<Message>(), 1..40)) {
            let mut objects = TestObject(vec![1; 30]);
            let (mut server, mut client) = (Server::default(), Client::start(0x2000, 0, None).0);
            for message in messages {
                server.request(&mut objects, &message);
                client.response(&message);
            }
        }
    }
}
