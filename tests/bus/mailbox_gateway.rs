//! The mailbox gateway at sockets, on the simulated bus in real time: telegrams of clients, what they
//! may not write, transfers of several messages, and limits.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::session::{self, Cause, Observer, Options, Outcome, Progress};
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::{axes, machine, run, virtual_time};

/// The first device.
const X: u16 = 0x1000;
const COE: u8 = 3;
const FOE: u8 = 4;
/// The name of the device, which here is longer than its mailbox.
const LONG: u16 = 0x1008;
const NAME_LENGTH: usize = 80;

/// Returns a frame with the counter 2.
fn frame(station: u16, protocol: u8, body: &[u8]) -> Vec<u8> {
    let length = u16::try_from(body.len()).unwrap();
    let mut frame = (0x5000 | (length + 6)).to_le_bytes().to_vec();
    frame.extend(length.to_le_bytes());
    frame.extend(station.to_le_bytes());
    frame.extend([0, protocol | 0x20]);
    frame.extend(body);
    frame
}

/// A client by UDP.
struct Client(UdpSocket);

impl Client {
    fn new(address: SocketAddr) -> Self {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.connect(address).unwrap();
        let timeout = Duration::from_secs(5);
        socket.set_read_timeout(Some(timeout)).unwrap();
        Self(socket)
    }

    fn receive(&self) -> Vec<u8> {
        let mut buffer = [0; 2048];
        let length = self.0.recv(&mut buffer).expect("an answer");
        buffer[..length].to_vec()
    }

    /// Returns the body of the answer, whose header must be that of the request.
    fn ask(&self, station: u16, protocol: u8, body: &[u8]) -> (u8, Vec<u8>) {
        self.0.send(&frame(station, protocol, body)).unwrap();
        let answer = self.receive();
        assert_eq!(answer[4..6], station.to_le_bytes(), "{answer:02x?}");
        assert_eq!(answer[7] & 0xf0, 0x20, "{answer:02x?}");
        let length = usize::from(u16::from_le_bytes([answer[2], answer[3]]));
        assert_eq!(answer.len(), 8 + length);
        let header = u16::from_le_bytes([answer[0], answer[1]]);
        assert_eq!(usize::from(header), 0x5000 | (6 + length));
        (answer[7] & 0x0f, answer[8..].to_vec())
    }

    fn upload(&self, station: u16, index: u16, sub: u8) -> Vec<u8> {
        let [low, high] = index.to_le_bytes();
        let body = [0, 0x20, 0x40, low, high, sub, 0, 0, 0, 0];
        let (protocol, answer) = self.ask(station, COE, &body);
        assert_eq!(protocol, COE);
        answer
    }

    fn segment(&self, toggle: bool) -> Vec<u8> {
        let command = 0x60 | u8::from(toggle) << 4;
        let body = [0, 0x20, command, 0, 0, 0, 0, 0, 0, 0];
        self.ask(X, COE, &body).1
    }

    /// Writes four bytes and returns the abort code; 0: written.
    fn download(&self, station: u16, index: u16, sub: u8, value: u32) -> u32 {
        let [low, high] = index.to_le_bytes();
        let mut body = vec![0, 0x20, 0x23, low, high, sub];
        body.extend(value.to_le_bytes());
        let (_, answer) = self.ask(station, COE, &body);
        assert_eq!(answer[3..6], [low, high, sub], "{answer:02x?}");
        match answer[2] {
            0x60 => 0,
            0x80 => u32::from_le_bytes(answer[6..10].try_into().unwrap()),
            _ => panic!("{answer:02x?}"),
        }
    }
}

/// Runs clients on a thread once the bus is in Op, and ends the run after them.
struct WithClients<F> {
    clients: Option<F>,
    address: Option<SocketAddr>,
    stop: Arc<CancelToken>,
    thread: Option<std::thread::JoinHandle<()>>,
}

struct EndsTheRun(Arc<CancelToken>);

impl Drop for EndsTheRun {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

impl<F: FnOnce(SocketAddr) + Send + 'static> Observer for WithClients<F> {
    fn progress(&mut self, progress: &Progress) {
        if let Progress::MailboxGateway { address, .. } = progress {
            self.address = Some(*address);
        }
        // Diagnoses of all devices have been read.
        if let Progress::Status(status) = progress
            && status.counters.cycles > 100
            && let (Some(clients), Some(address)) = (self.clients.take(), self.address)
        {
            let stop = EndsTheRun(Arc::clone(&self.stop));
            self.thread = Some(std::thread::spawn(move || {
                let _stop = stop;
                clients(address);
            }));
        }
    }
}

/// A machine at rest with three drives. Its bus tolerates a test computer that stalls.
fn text(key: &str) -> String {
    let tolerant = "cycle = \"2ms\"\nlost_frames = 1000\nwatchdog = \"6s\"";
    let text = axes(3).replace("cycle = \"1ms\"", tolerant);
    format!("{text}\n[mailbox_gateway]\nbind = \"127.0.0.1:0\"\n{key}\n")
}

fn long_names() -> Bench {
    let bench = Bench::new();
    bench.change("esi/EPOS4.xml", |esi| {
        esi.replace("STRING(5)", &format!("STRING({NAME_LENGTH})"))
            .replace(
                "<BitSize>40</BitSize>",
                &format!("<BitSize>{}</BitSize>", NAME_LENGTH * 8),
            )
            .replace(
                "<DefaultString>EPOS4<",
                &format!("<DefaultString>{}<", "E".repeat(NAME_LENGTH)),
            )
    });
    bench
}

fn with_clients(key: &str, clients: impl FnOnce(SocketAddr) + Send + 'static) -> Outcome {
    with_clients_of(false, key, clients)
}

/// `enable`: the axes get power.
fn with_clients_of(
    enable: bool,
    key: &str,
    clients: impl FnOnce(SocketAddr) + Send + 'static,
) -> Outcome {
    let stop = Arc::<CancelToken>::default();
    let mut observer = WithClients {
        clients: Some(clients),
        address: None,
        stop: Arc::clone(&stop),
        thread: None,
    };
    let options = Options {
        limit: Some(120_000_000_000),
        enable,
        ..Options::default()
    };
    let outcome = session::run(
        long_names().machine(&text(key)),
        options,
        stop,
        &mut observer,
    );
    let thread = observer.thread.take().expect("the bus was in Op");
    thread.join().expect("the clients' expectations hold");
    let summary = outcome.summary.as_ref().expect("a summary");
    assert_eq!(summary.counters.wkc_errors, 0);
    outcome
}

#[test]
fn telegrams_are_answered_by_devices_and_by_the_main_device() {
    let outcome = with_clients("", |address| {
        let client = Client::new(address);
        // The recorded request of TwinSAFE Loader, to a device of this bus and of its object.
        let mut request = *b"\x10\x50\x0a\0\xe9\x03\0\x23\0\x20\x41\x80\xf9\x02\0\0\0\0";
        request[4..6].copy_from_slice(&X.to_le_bytes());
        request[11..14].copy_from_slice(&[0x18, 0x10, 1]);
        client.0.send(&request).unwrap();
        let mut expected = *b"\x10\x50\x0a\0\xe9\x03\0\x23\0\x30\x43\x80\xf9\x02\x0a\x0e\0\0";
        expected[4..6].copy_from_slice(&X.to_le_bytes());
        expected[11..14].copy_from_slice(&[0x18, 0x10, 1]);
        assert_eq!(client.receive(), expected);
        // A client that starts again repeats its counters.
        for station in [X, X + 1, X + 2] {
            for _ in 0..5 {
                let answer = client.upload(station, 0x1018, 1);
                assert_eq!(answer[2..], [0x43, 0x18, 0x10, 1, 0x0a, 0x0e, 0, 0]);
            }
        }
        // Every device is in Op, and the MainDevice knows it.
        let answer = client.upload(0, 0xa002, 1);
        assert_eq!(answer[2..], [0x4b, 2, 0xa0, 1, 8, 0, 0, 0]);
        let list = client.ask(X, COE, &[0, 0x80, 1, 0, 0, 0, 1, 0]).1;
        let mut left = u16::from_le_bytes([list[4], list[5]]);
        assert!(left > 2, "{list:02x?}");
        while left > 0 {
            let part = client.receive();
            left -= 1;
            assert_eq!(part[12..14], left.to_le_bytes());
        }

        // Stations that do not exist answer nothing, nor do damaged frames.
        client.0.send(&frame(0x0999, COE, &[0; 10])).unwrap();
        client.0.send(&frame(X, COE, &[0; 10])[..12]).unwrap();
        let answer = client.upload(X, 0x1018, 1);
        assert_eq!(answer[2], 0x43);
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn without_the_key_write_nothing_is_written() {
    let outcome = with_clients("", |address| {
        let client = Client::new(address);
        for (station, index, sub) in [(X, 0x6065, 0), (X, 0x6040, 0), (0, 0xf002, 1)] {
            assert_eq!(client.download(station, index, sub, 5), 0x0800_0021);
        }
        // Segments of a download, of no transfer, and an unknown command.
        for (command, code) in [
            (0x00, 0x0800_0021),
            (0x60, 0x0504_0001),
            (0xc0, 0x0504_0001),
        ] {
            let body = [0, 0x20, command, 0, 0, 0, 0, 0, 0, 0];
            let answer = client.ask(X, COE, &body).1;
            assert_eq!(answer[2], 0x80);
            assert_eq!(answer[6..10], u32::to_le_bytes(code), "{command:#x}");
        }
        let (protocol, answer) = client.ask(X, FOE, b"\x02\0\0\0\0\0firmware");
        assert_eq!((protocol, &answer[..6]), (FOE, &b"\x05\0\x02\x80\0\0"[..]));
        // AoE, EoE, writing of SoE, VoE, PDOs over CoE, and another CoE service.
        let refused = [
            (1, &[1; 12][..]),
            (2, &[0; 12]),
            (5, &[3, 0, 1, 0]),
            (15, &[0; 8]),
            (COE, &[0, 0x50, 0, 0]),
            (COE, &[0, 0x10, 0, 0, 0, 0, 0, 0]),
        ];
        for (protocol, body) in refused {
            let answer = client.ask(X, protocol, body);
            assert_eq!(answer, (0, vec![1, 0, 4, 0]), "{protocol}");
        }
        // Longer than the mailbox of 48 bytes.
        let answer = client.ask(X, COE, &[0; 43]);
        assert_eq!(answer, (0, vec![1, 0, 8, 0]));
        assert_eq!(client.upload(X, 0x6065, 0)[2] & 0x80, 0);
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn objects_of_the_cycle_are_protected_in_op() {
    let outcome = with_clients("write = true", |address| {
        let client = Client::new(address);
        for index in [
            0x6040, 0x6060, 0x607a, 0x60ff, 0x6071, 0x60c2, 0x6840, 0x1c12, 0x1c13, 0x1c32, 0x1600,
            0x1a00, 0x1a03,
        ] {
            assert_eq!(client.download(X, index, 0, 6), 0x0800_0022, "{index:#x}");
        }
        assert_eq!(client.download(X, 0x6065, 0, 4711), 0);
        let answer = client.upload(X, 0x6065, 0);
        assert_eq!(answer[6..10], 4711_u32.to_le_bytes());
        // The device itself refuses.
        assert_eq!(client.download(X, 0x1018, 1, 5), 0x0601_0002);
        // A scan counts the devices of the bus.
        let scan = [0, 0x20, 0x2b, 0x02, 0xf0, 1, 0, 0, 0, 0];
        assert_eq!(client.ask(0, COE, &scan).1[2], 0x60);
        let answer = client.upload(0, 0xf002, 3);
        assert_eq!(
            answer[2..16],
            *b"\x41\x02\xf0\x03\x06\0\0\0\x01\0\x03\0\0\0"
        );
        assert_eq!(client.download(0, 0x8000, 1, 5), 0x0601_0002);
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn a_drive_with_power_gets_no_write_that_moves_resets_or_limits_it() {
    let outcome = with_clients_of(true, "write = true", |address| {
        let client = Client::new(address);
        let end = Instant::now() + Duration::from_secs(30);
        // Statusword: Operation enabled.
        while client.upload(X, 0x6041, 0)[6] & 0x6f != 0x27 {
            assert!(Instant::now() < end, "no power");
            std::thread::sleep(Duration::from_millis(20));
        }
        let before = client.upload(X, 0x6065, 0);
        for (index, sub) in [
            (0x1010, 1),
            (0x1011, 1),
            (0x6065, 0),
            (0x607f, 0),
            (0x6040, 0),
        ] {
            assert_eq!(client.download(X, index, sub, 6), 0x0800_0022, "{index:#x}");
        }
        assert_eq!(client.upload(X, 0x6065, 0), before);
        let (protocol, answer) = client.ask(X, FOE, b"\x02\0\0\0\0\0firmware");
        assert_eq!((protocol, &answer[..6]), (FOE, &b"\x05\0\x02\x80\0\0"[..]));
        // The drive itself answers: it has no such object.
        assert_eq!(client.download(X, 0x60f9, 1, 6), 0x0602_0000);
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn other_protocols_reach_the_device_with_the_key_write() {
    let outcome = with_clients("write = true", |address| {
        let client = Client::new(address);
        // AoE, EoE, writing of SoE, VoE: the device answers that it has none of them.
        for protocol in [1, 2, 5, 15] {
            let answer = client.ask(X, protocol, &[3, 0, 1, 0, 0, 0, 0, 0]);
            assert_eq!(answer, (0, vec![1, 0, 2, 0]), "{protocol}");
        }
        // The simulated drive decides about files itself.
        let (protocol, answer) = client.ask(X, FOE, b"\x02\0\0\0\0\0firmware");
        assert_eq!(protocol, FOE);
        assert!(!answer.starts_with(b"\x05\0\x02\x80"), "{answer:02x?}");
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn a_segmented_transfer_holds_the_device_until_it_ends_or_its_client_is_silent() {
    let outcome = with_clients("", |address| {
        let [client, other] = [(); 2].map(|()| Client::new(address));
        let begin = || {
            let answer = client.upload(X, LONG, 0);
            assert_eq!(answer[2], 0x41, "{answer:02x?}");
            let size = u32::from_le_bytes(answer[6..10].try_into().unwrap());
            (usize::try_from(size).unwrap(), answer[10..].to_vec())
        };
        let (size, mut data) = begin();
        assert_eq!(size, NAME_LENGTH);
        let waiting = std::thread::spawn(move || {
            let asked = Instant::now();
            assert_eq!(other.upload(X, 0x1018, 1)[2], 0x43);
            (asked.elapsed(), other)
        });
        let mut toggle = false;
        loop {
            // Longer than any answer takes.
            std::thread::sleep(Duration::from_millis(150));
            let answer = client.segment(toggle);
            assert_eq!(answer[2] & 0xf0, u8::from(toggle) << 4, "{answer:02x?}");
            data.extend(&answer[3..]);
            toggle = !toggle;
            if answer[2] & 1 != 0 {
                break;
            }
        }
        assert_eq!(data[..size], *"E".repeat(size).as_bytes());
        let (waited, other) = waiting.join().expect("answered");
        assert!(waited > Duration::from_millis(250), "{waited:?}");

        begin();
        let asked = Instant::now();
        assert_eq!(other.upload(X, 0x1018, 1)[2], 0x43);
        let waited = asked.elapsed();
        assert!(waited > Duration::from_millis(1900), "{waited:?}");
        // The transfer is over, also for its client.
        let answer = client.segment(false);
        assert_eq!(answer[2..10], [0x80, 0, 0, 0, 1, 0, 4, 5]);
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn tcp_clients_are_served_up_to_their_limit() {
    let outcome = with_clients("", |address| {
        let connect = || {
            let stream = TcpStream::connect(address).unwrap();
            let timeout = Duration::from_secs(5);
            stream.set_read_timeout(Some(timeout)).unwrap();
            stream
        };
        let request = frame(X, COE, &[0, 0x20, 0x40, 0x18, 0x10, 1, 0, 0, 0, 0]);
        let answered = |stream: &mut TcpStream, frames: usize| {
            let mut answers = vec![0; 18 * frames];
            stream.read_exact(&mut answers).unwrap();
            for answer in answers.chunks(18) {
                assert_eq!(answer[8..14], [0, 0x30, 0x43, 0x18, 0x10, 1]);
            }
        };
        let mut clients: Vec<_> = (0..16).map(|_| connect()).collect();
        for client in &mut clients {
            client.write_all(&request).unwrap();
        }
        for client in &mut clients {
            answered(client, 1);
        }
        // Mailbox error 7: no memory.
        let mut turned_away = connect();
        turned_away.write_all(&request).unwrap();
        let mut answer = Vec::new();
        turned_away.read_to_end(&mut answer).unwrap();
        assert_eq!(answer[8..], [1, 0, 7, 0]);
        let mut silent = connect();
        assert_eq!(silent.read(&mut [0; 10]).unwrap_or(0), 0);

        // Frames may come together and in pieces.
        let first = clients.first_mut().unwrap();
        let three = request.repeat(3);
        for part in three.chunks(7) {
            first.write_all(part).unwrap();
            std::thread::sleep(Duration::from_millis(2));
        }
        answered(first, 3);
        // Another protocol ends the connection.
        first.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
        assert_eq!(first.read(&mut [0; 10]).unwrap_or(0), 0);
        clients.remove(0);
        let mut next = connect();
        next.write_all(&request).unwrap();
        answered(&mut next, 1);
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn random_datagrams_do_not_disturb_clients_or_the_cycle() {
    let outcome = with_clients("write = false", |address| {
        let noise = Client::new(address);
        // The system drops datagrams while the buffer of the socket is full of noise.
        let upload = |station: u16, index: u16| {
            let [low, high] = index.to_le_bytes();
            let request = frame(station, COE, &[0, 0x20, 0x40, low, high, 1, 0, 0, 0, 0]);
            let answer = (0..30).find_map(|_| {
                let client = Client::new(address);
                let timeout = Duration::from_secs(1);
                client.0.set_read_timeout(Some(timeout)).unwrap();
                client.0.send(&request).unwrap();
                let mut answer = [0; 64];
                client.0.recv(&mut answer).ok().map(|_| answer)
            });
            let answer = answer.expect("an answer");
            assert_eq!(answer[11..14], [low, high, 1]);
            answer[14..18].to_vec()
        };
        let mut state = 0x2545_f491_4f6c_dd1d_u64;
        let mut random = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state
        };
        let mut good = Vec::new();
        for index in [0x1018_u16, 0x6041, 0x8000, 0xf020] {
            let [low, high] = index.to_le_bytes();
            let body = [0, 0x20, 0x50, low, high, 0, 0, 0, 0, 0];
            good.extend([0, X, X + 1].map(|station| frame(station, COE, &body)));
            let body = [0, 0x80, 5, 0, 0, 0, low, high, 1, 7];
            good.push(frame(0, COE, &body));
        }
        for round in 0..20_000_usize {
            let mut datagram = good[round % good.len()].clone();
            if round % 4 == 0 {
                let length = usize::try_from(random() % 64).unwrap();
                datagram = (0..length).map(|_| random().to_le_bytes()[3]).collect();
            } else {
                let place = usize::try_from(random()).unwrap() % datagram.len();
                datagram[place] = random().to_le_bytes()[3];
            }
            noise.0.send(&datagram).unwrap();
            if round % 1000 == 0 {
                assert_eq!(upload(X + 2, 0x1018), [0x0a, 0x0e, 0, 0]);
            }
        }
        assert_eq!(upload(X, 0x1018), [0x0a, 0x0e, 0, 0]);
        assert_eq!(upload(0, 0xf020)[..2], X.to_le_bytes());
    });
    outcome.result.expect("an undisturbed run");
}

#[test]
fn an_address_in_use_ends_the_run_before_the_first_frame() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let text = text("").replace("127.0.0.1:0", &address.to_string());
    let options = Options::default();
    let (outcome, heard) = run(machine(&text), options);
    let error = outcome.result.expect_err("taken");
    assert!(
        matches!(*error.cause, Cause::MailboxGateway { address: at, .. } if at == address),
        "{error}"
    );
    assert!(heard.0.is_empty(), "{:?}", heard.0);
}

#[test]
fn virtual_time_has_no_gateway_and_says_so() {
    let options = Options {
        limit: Some(100_000_000),
        enable: false,
        ..virtual_time()
    };
    let (outcome, heard) = run(machine(&text("")), options);
    outcome.result.expect("an undisturbed run");
    let warned = heard.0.iter().any(|progress| match progress {
        Progress::Warning(text) => text.contains("virtual time has no mailbox gateway"),
        Progress::MailboxGateway { .. } => panic!("{progress:?}"),
        _ => false,
    });
    assert!(warned, "{:?}", heard.0);
}
