//! Two endpoints of Safety over EtherCAT (FSoE, ETG.5100) that `[[copy]]` connects. The endpoints
//! follow the public description of the protocol with two bytes of safe data. They are test code
//! without any claim of safety. The other FSoE master is the package `fsoe-master` of PyPI
//! (`requirements.txt`); `ECAXIS_FSOE_PYTHON` names a Python that has it.

use std::io::{Read, Write};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::Machine;
use ecaxis_master::session::{Options, Outcome, run_on};
use ecaxis_sim::Segment;
use ecaxis_test_support::bench::Bench;
use ecaxis_test_support::wire::{WatchedBus, Watcher};
use ecaxis_test_support::{Heard, faults, root, skip, virtual_time};

/// The FSoE watchdog in bus cycles of 1 ms.
const WATCHDOG: u32 = 100;
const CONNECTION: u16 = 0x0207;
const ADDRESS: u16 = 0x0031;
/// The command of PDUs with fail-safe values in the state Data.
const FAIL_SAFE: u8 = 0x08;
/// The length of a PDU with two bytes of safe data.
const PDU_LEN: usize = 7;

/// The states of a connection, with their commands.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[repr(u8)]
enum State {
    #[default]
    Reset = 0x2a,
    Session = 0x4e,
    Connection = 0x64,
    Parameter = 0x52,
    Data = 0x36,
}

impl State {
    /// Returns the connection ID in PDUs of this state.
    fn connection(self) -> u16 {
        match self {
            Self::Reset | Self::Session => 0,
            _ => CONNECTION,
        }
    }
}

/// A safety PDU with two bytes of safe data.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Pdu {
    command: u8,
    data: u16,
    crc: u16,
    connection: u16,
}

impl Pdu {
    fn parse(bytes: &[u8]) -> Self {
        let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        Self {
            command: bytes[0],
            data: word(1),
            crc: word(3),
            connection: word(5),
        }
    }

    fn objects(&self) -> [i64; 4] {
        [
            self.command.into(),
            self.data.into(),
            self.crc.into(),
            self.connection.into(),
        ]
    }
}

/// The sequence number and the last CRC of one direction.
#[derive(Debug, Clone, Copy, Default)]
struct Sequence {
    number: u16,
    last: u16,
}

impl Sequence {
    /// Returns the CRC of the next PDU. `before` is the CRC of the last PDU of the other direction.
    /// Two PDUs in a row never have the same CRC.
    fn next(&mut self, before: u16, command: u8, data: u16, connection: u16) -> u16 {
        /// x^16 + x^13 + x^12 + x^11 + x^8 + x^7 + x^5 + x^4 + x^2 + x + 1.
        const POLYNOMIAL: u16 = 0x39b7;
        loop {
            self.number = self.number.checked_add(1).unwrap_or(1);
            let words = [before, connection, self.number].map(u16::to_le_bytes);
            let [low, high] = data.to_le_bytes();
            let bytes = [&words.concat()[..], &[command, low, high, 0, 0, 0]].concat();
            let crc = bytes.iter().fold(0_u16, |crc, &byte| {
                (0..8).fold(crc ^ u16::from(byte) << 8, |crc, _| {
                    (crc << 1) ^ if crc & 0x8000 == 0 { 0 } else { POLYNOMIAL }
                })
            });
            if crc != self.last {
                self.last = crc;
                return crc;
            }
        }
    }
}

/// One end of the connection.
#[derive(Debug, Default)]
struct Endpoint {
    /// The FSoE master sends first.
    leads: bool,
    state: State,
    /// The number of PDUs of this state so far.
    step: usize,
    sent: Pdu,
    received: Pdu,
    /// The CRC of the last PDU of each end in this session.
    sent_crc: u16,
    received_crc: u16,
    own: Sequence,
    others: Sequence,
    silent: u32,
    /// Received PDUs in the state Data.
    exchanged: u16,
    errors: Vec<&'static str>,
}

/// The safe data of the states before Data: session, connection, parameters.
const PHASES: [(State, &[u16]); 4] = [
    (State::Reset, &[0]),
    (State::Session, &[0x4711]),
    (State::Connection, &[CONNECTION, ADDRESS]),
    // Length of the watchdog in bytes, its value, length of further parameters.
    (State::Parameter, &[2, WATCHDOG as u16, 0]),
];

impl Endpoint {
    fn fail(&mut self, why: &'static str) {
        self.errors.push(why);
        self.enter(State::Reset);
    }

    /// Enters a state. Sequence numbers and CRCs begin again with each session.
    fn enter(&mut self, state: State) {
        (self.state, self.step) = (state, 0);
        if state == State::Session {
            (self.own, self.others) = Default::default();
            (self.sent_crc, self.received_crc) = (0, 0);
        }
    }

    fn send(&mut self, data: u16) {
        let connection = self.state.connection();
        let command = self.state as u8;
        let crc = self.own.next(self.received_crc, command, data, connection);
        self.sent_crc = crc;
        self.sent = Pdu {
            command,
            data,
            crc,
            connection,
        };
    }

    /// Runs once per bus cycle with the PDU in the outputs of the device.
    fn cycle(&mut self, pdu: Pdu) {
        if !self.errors.is_empty() {
            return;
        }
        self.silent += 1;
        if self.leads && self.sent == Pdu::default() {
            self.send(0);
        }
        if pdu == self.received || pdu == Pdu::default() {
            if self.state == State::Data && self.silent > WATCHDOG {
                self.fail("watchdog");
            }
            return;
        }
        let command = match pdu.command {
            FAIL_SAFE => State::Data as u8,
            command => command,
        };
        // The slave follows the state of the master.
        if !self.leads && command != self.state as u8 {
            let next = PHASES.iter().map(|phase| phase.0).chain([State::Data]);
            let next = next.skip_while(|state| *state != self.state).nth(1);
            match next {
                Some(next) if next as u8 == command => self.enter(next),
                _ => return self.fail("command"),
            }
        }
        let connection = self.state.connection();
        if command != self.state as u8 {
            return self.fail("command");
        }
        if pdu.connection != connection {
            return self.fail("connection ID");
        }
        let crc = self
            .others
            .next(self.sent_crc, pdu.command, pdu.data, connection);
        if crc != pdu.crc {
            return self.fail("CRC");
        }
        self.received = pdu;
        self.received_crc = crc;
        self.silent = 0;
        if self.leads {
            self.answered(pdu.data)
        } else {
            self.asked(pdu.data)
        }
    }

    /// The slave answers a PDU: the same parameters, or its inputs, the outputs plus one.
    fn asked(&mut self, data: u16) {
        let phase = PHASES.iter().find(|phase| phase.0 == self.state);
        if let Some((state, values)) = phase {
            let expected = values.get(self.step).copied();
            if *state != State::Session && expected != Some(data) {
                return self.fail("parameter");
            }
            self.step += 1;
            self.send(if *state == State::Session {
                0x0815
            } else {
                data
            });
        } else {
            self.exchanged += 1;
            self.send(data.wrapping_add(1));
        }
    }

    /// The master checks an answer and sends its next PDU.
    fn answered(&mut self, data: u16) {
        let phase = PHASES.iter().position(|phase| phase.0 == self.state);
        let Some(phase) = phase else {
            if data != self.sent.data.wrapping_add(1) {
                return self.fail("safe data");
            }
            self.exchanged += 1;
            return self.send(self.exchanged.wrapping_mul(7));
        };
        let (state, values) = PHASES[phase];
        if state != State::Session && data != values[self.step] {
            return self.fail("parameter");
        }
        self.step += 1;
        if self.step == values.len() {
            self.enter(PHASES.get(phase + 1).map_or(State::Data, |next| next.0));
        }
        let phase = PHASES.iter().find(|phase| phase.0 == self.state);
        self.send(phase.map_or(0, |(_, values)| values[self.step]));
    }
}

/// The process of `fsoe.py`.
struct OtherMaster {
    process: Child,
    request: [u8; PDU_LEN],
    errors: u16,
    /// Checked answers in the state Data.
    checked: u32,
    in_data: bool,
}

impl OtherMaster {
    /// Starts the master, or skips the test.
    fn start() -> Option<Self> {
        let Some(python) = std::env::var_os("ECAXIS_FSOE_PYTHON") else {
            skip("ECAXIS_FSOE_PYTHON names no Python with fsoe-master");
            return None;
        };
        let process = Command::new(python)
            .arg(root().join("tests/bus/fsoe.py"))
            .args([CONNECTION, ADDRESS, WATCHDOG as u16].map(|n| n.to_string()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("Python starts");
        Some(Self {
            process,
            request: [0; PDU_LEN],
            errors: 0,
            checked: 0,
            in_data: false,
        })
    }

    /// Runs once per bus cycle with the PDU in the outputs of the device.
    fn cycle(&mut self, pdu: &[u8]) {
        let input = self.process.stdin.as_mut().expect("a pipe");
        input.write_all(pdu).expect("it runs");
        let mut answer = [0; PDU_LEN + 7];
        let output = self.process.stdout.as_mut().expect("a pipe");
        output.read_exact(&mut answer).expect("it answers");
        let (request, rest) = answer.split_at(PDU_LEN);
        self.request.copy_from_slice(request);
        self.errors = u16::from_le_bytes([rest[0], rest[1]]);
        self.checked = u32::from_le_bytes([rest[2], rest[3], rest[4], rest[5]]);
        self.in_data = rest[6] == 1;
    }
}

impl Drop for OtherMaster {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// The other master at position 0 and the own slave at position 1, with lost answers.
struct WithOtherMaster<F> {
    ends: Arc<Mutex<(OtherMaster, Endpoint)>>,
    cycle: usize,
    lost: F,
}

impl<F: Fn(usize) -> bool + Send> Watcher for WithOtherMaster<F> {
    fn before(&mut self, segment: &mut Segment) {
        self.cycle += 1;
        let mut ends = self.ends.lock().expect("no panic");
        let (master, slave) = &mut *ends;
        for position in 0..2 {
            let device = segment.device_mut(position).expect("a device");
            let outputs = device.outputs();
            let whole = outputs.len() == PDU_LEN;
            let sent = if position == 0 {
                if whole {
                    master.cycle(&outputs);
                }
                Pdu::parse(&master.request)
            } else {
                if whole {
                    slave.cycle(Pdu::parse(&outputs));
                }
                slave.sent
            };
            for (sub, value) in (1..).zip(sent.objects()) {
                assert!(device.set_input(0x6010, sub, value));
            }
        }
    }

    fn answer(&mut self, _: &mut [u8]) -> bool {
        !(self.lost)(self.cycle)
    }
}

/// The devices at positions 0 (safety logic) and 1 (drive) with their endpoints.
struct Endpoints(Arc<Mutex<[Endpoint; 2]>>);

impl Watcher for Endpoints {
    fn before(&mut self, segment: &mut Segment) {
        let mut endpoints = self.0.lock().expect("no panic");
        for (position, endpoint) in endpoints.iter_mut().enumerate() {
            let device = segment.device_mut(position).expect("a device");
            let outputs = device.outputs();
            if outputs.len() == 7 {
                endpoint.cycle(Pdu::parse(&outputs));
            }
            for (sub, value) in (1..).zip(endpoint.sent.objects()) {
                assert!(device.set_input(0x6010, sub, value));
            }
        }
    }
}

/// The endpoints with lost answers: `lost` decides per bus cycle.
struct Lossy<F>(Endpoints, usize, F);

impl<F: Fn(usize) -> bool + Send> Watcher for Lossy<F> {
    fn before(&mut self, segment: &mut Segment) {
        self.0.before(segment);
        self.1 += 1;
    }

    fn answer(&mut self, _: &mut [u8]) -> bool {
        !(self.2)(self.1)
    }
}

fn esi() -> String {
    let pdo = |kind: &str, sm: u8, index: &str, object: &str| {
        let entries = [
            ("Command", 8, "USINT"),
            ("Safe data", 16, "UINT"),
            ("CRC 0", 16, "UINT"),
        ];
        let entries = (1..).zip(entries.into_iter().chain([("Connection ID", 16, "UINT")]));
        let entries = entries.map(|(sub, (name, bits, kind))| {
            format!(
                "<Entry><Index>{object}</Index><SubIndex>{sub}</SubIndex><BitLen>{bits}</BitLen>\
                 <Name>{name}</Name><DataType>{kind}</DataType></Entry>"
            )
        });
        let entries: String = entries.collect();
        format!(
            "<{kind} Fixed=\"1\" Mandatory=\"1\" Sm=\"{sm}\"><Index>{index}</Index>\
             <Name>Safety {kind}</Name>{entries}</{kind}>"
        )
    };
    let words = super::copy::WORDS;
    let (head, rest) = words.split_once("<RxPdo").expect("outputs");
    let (_, tail) = rest.split_once("<Eeprom>").expect("EEPROM");
    let pdos = pdo("RxPdo", 0, "#x1610", "#x7010") + &pdo("TxPdo", 1, "#x1A10", "#x6010");
    format!("{head}{pdos}<Eeprom>{tail}")
}

/// Returns the machine with both devices and the copies between them.
fn safety_machine(exchange: &str, dwell: &str) -> Machine {
    let bench = Bench::new();
    bench.write("safety.xml", &esi());
    let text = format!(
        r#"[bus]
nic = "sim"
cycle = "1ms"
lost_frames = 400
watchdog = "1s"
exchange = "{exchange}"
[[device]]
name = "logic"
esi = "safety.xml"
position = 0
[[device]]
name = "drive"
esi = "safety.xml"
position = 1
[[copy]]
from = "logic.pdo.0x1A10"
to = "drive.pdo.0x1610"
[[copy]]
from = "drive.bytes.0..7"
to = "logic.pdo.0x1610"
[[step]]
dwell = "{dwell}"
"#
    );
    bench.machine(&text)
}

fn run(
    exchange: &str,
    options: Options,
    lost: impl Fn(usize) -> bool + Send + 'static,
) -> (Outcome, [Endpoint; 2]) {
    let machine = safety_machine(exchange, "2s");
    let mut endpoints = <[Endpoint; 2]>::default();
    endpoints[0].leads = true;
    let endpoints = Arc::new(Mutex::new(endpoints));
    let watcher = Lossy(Endpoints(Arc::clone(&endpoints)), 0, lost);
    let link = Box::new(WatchedBus::new(&machine, &options, watcher));
    let mut heard = Heard::default();
    let stop = Arc::<CancelToken>::default();
    let outcome = run_on(link, machine, options, stop, &mut heard);
    let endpoints = std::mem::take(&mut *endpoints.lock().expect("no panic"));
    (outcome, endpoints)
}

/// ETG.5100: each safety PDU is answered within the FSoE watchdog. A safety PDU and its answer take
/// four bus cycles, six with a pipelined exchange.
#[test]
fn a_safety_connection_stays_connected() {
    for (exchange, cycles) in [("same-cycle", 4), ("pipelined", 6)] {
        let (outcome, endpoints) = run(exchange, virtual_time(), |_| false);
        outcome.result.expect("runs");
        for endpoint in &endpoints {
            assert_eq!(
                (endpoint.state, &endpoint.errors[..]),
                (State::Data, &[][..])
            );
            let expected = 2000 / cycles;
            assert!(
                endpoint.exchanged >= expected - 10,
                "{exchange}: {endpoint:?}"
            );
        }
    }
}

/// ETG.5100: a repeated safety PDU does not count as an error; the watchdog bounds the repetitions.
#[test]
fn a_safety_connection_survives_lost_frames() {
    let (outcome, endpoints) = run("same-cycle", virtual_time(), |n| n > 300 && n % 40 < 9);
    outcome.result.expect("runs");
    for endpoint in &endpoints {
        assert_eq!(
            (endpoint.state, &endpoint.errors[..]),
            (State::Data, &[][..])
        );
        assert!(endpoint.exchanged > 300, "{endpoint:?}");
    }
}

/// ETG.5100: without a new safety PDU, the FSoE watchdog of each end expires. The held value never
/// passes as a new PDU: both ends detect the loss.
#[test]
fn both_ends_detect_the_loss_of_a_device() {
    let script = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"1s\"\n";
    let (outcome, endpoints) = run("same-cycle", faults(script), |_| false);
    outcome.result.expect_err("a device is missing");
    for endpoint in &endpoints {
        assert!(endpoint.exchanged > 50, "{endpoint:?}");
        assert_eq!(endpoint.errors, ["watchdog"]);
    }
}

/// Runs the other master and the own slave. Returns the outcome and both ends.
fn run_with_other_master(
    dwell: &str,
    options: Options,
    lost: impl Fn(usize) -> bool + Send + 'static,
) -> Option<(Outcome, OtherMaster, Endpoint)> {
    let master = OtherMaster::start()?;
    let machine = safety_machine("same-cycle", dwell);
    let ends = Arc::new(Mutex::new((master, Endpoint::default())));
    let watcher = WithOtherMaster {
        ends: Arc::clone(&ends),
        cycle: 0,
        lost,
    };
    let link = Box::new(WatchedBus::new(&machine, &options, watcher));
    let mut heard = Heard::default();
    let stop = Arc::<CancelToken>::default();
    let outcome = run_on(link, machine, options, stop, &mut heard);
    let ends = Arc::into_inner(ends).expect("the bus is gone");
    let (master, slave) = ends.into_inner().expect("no panic");
    Some((outcome, master, slave))
}

/// The FSoE master of PyPI judges each answer (`fsoe-master`). 10⁵ cycles with nine lost answers of
/// 40; a PDU and its answer then take four to 13 cycles.
#[test]
fn another_safety_master_stays_connected_with_lost_frames() {
    let lost = |n: usize| n > 300 && n % 40 < 9;
    let Some((outcome, master, slave)) = run_with_other_master("100s", virtual_time(), lost) else {
        return;
    };
    outcome.result.expect("runs");
    println!("{} checked answers", master.checked);
    assert_eq!((master.errors, master.in_data), (0, true));
    assert_eq!((slave.state, &slave.errors[..]), (State::Data, &[][..]));
    assert!(master.checked > 10_000, "{}", master.checked);
}

/// ETG.5100: the FSoE watchdog, here that of `fsoe-master` of PyPI.
#[test]
fn another_safety_master_detects_the_loss_of_a_device() {
    let script = "[[fault]]\nkind = \"absent\"\ndevice = 1\nat = \"1s\"\n";
    let Some((outcome, master, slave)) = run_with_other_master("2s", faults(script), |_| false)
    else {
        return;
    };
    outcome.result.expect_err("a device is missing");
    assert!(master.checked > 50, "{}", master.checked);
    assert_eq!((master.errors, master.in_data), (1, false));
    assert_eq!(slave.errors, ["watchdog"]);
}
