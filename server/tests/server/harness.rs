//! A server in this process, and its clients.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::change_log::ChangeLog;
use ecaxis_master::clock::Clock;
use ecaxis_master::config::{self, Machine};
use ecaxis_master::session::Options;
use ecaxis_server::http::HttpOptions;
use ecaxis_server::serve::{Listening, ServeError, ServerOptions, serve};
use ecaxis_sim::FaultScript;
use serde_json::{Value, json};

pub const TOKEN: &str = "0123456789abcdef";
pub const WATCH_TOKEN: &str = "fedcba9876543210";

/// A server that ends with this value.
pub struct Server {
    folder: tempfile::TempDir,
    stop: Arc<CancelToken>,
    thread: Option<JoinHandle<Result<(), ServeError>>>,
    pub url: Option<String>,
}

/// The demonstration machine: axes `x` and `y` in CSP.
pub fn demo() -> Machine {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/demo.toml");
    config::load(&path).unwrap()
}

impl Server {
    /// Starts a server whose time advances on request.
    pub fn in_virtual_time(machine: Machine) -> Self {
        let options = Options {
            clock: Clock::Virtual,
            ..Options::default()
        };
        Self::start(machine, options, None)
    }

    /// Like [`Server::in_virtual_time`], with a fault script.
    pub fn with_faults(machine: Machine, script: &str) -> Self {
        let options = Options {
            clock: Clock::Virtual,
            faults: Some(FaultScript::parse(script).unwrap()),
            ..Options::default()
        };
        Self::start(machine, options, None)
    }

    /// Like [`Server::in_virtual_time`], with a recording.
    pub fn with_recording(machine: Machine) -> Self {
        let options = Options {
            clock: Clock::Virtual,
            ..Options::default()
        };
        Self::start_recording(machine, options, None, true)
    }

    pub fn in_real_time(machine: Machine) -> Self {
        Self::start(machine, Options::default(), None)
    }

    /// Starts a server with HTTP, on a free port of the loopback interface.
    pub fn with_http(machine: Machine, control: bool) -> Self {
        let http = HttpOptions {
            address: "127.0.0.1:0".parse().unwrap(),
            control,
            token: TOKEN.to_owned(),
            watch_token: Some(WATCH_TOKEN.to_owned()),
            known_token: false,
            hosts: Vec::new(),
            recordings: None,
        };
        Self::start(machine, Options::default(), Some(http))
    }

    pub fn start(machine: Machine, run: Options, http: Option<HttpOptions>) -> Self {
        Self::start_recording(machine, run, http, false)
    }

    fn start_recording(
        machine: Machine,
        run: Options,
        http: Option<HttpOptions>,
        record: bool,
    ) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let stop = Arc::<CancelToken>::default();
        let options = ServerOptions {
            socket: Some((folder.path().join("s.sock"), 0o600)),
            http,
            keep_ns: 10_000_000_000,
            change_log: Some(ChangeLog::new(folder.path().join("changes.jsonl"))),
            record: record.then(|| folder.path().join("run.mcap")),
        };
        let (ready, listening) = std::sync::mpsc::channel::<Listening>();
        let cancel = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            let describe =
                Box::new(|error: &ecaxis_master::report::Error| (error.to_string(), None));
            serve(machine, run, options, &cancel, describe, |listening| {
                ready.send(listening.clone()).unwrap();
            })
        });
        let listening = listening.recv().expect("the server listens");
        Self {
            folder,
            stop,
            thread: Some(thread),
            url: listening.url,
        }
    }

    /// Ends the server. Returns its recording.
    pub fn recorded(mut self) -> Vec<u8> {
        self.end();
        std::fs::read(self.folder.path().join("run.mcap")).unwrap()
    }

    fn end(&mut self) {
        self.stop.cancel();
        let ended = self.thread.take().map(JoinHandle::join);
        if !std::thread::panicking()
            && let Some(ended) = ended
        {
            ended.expect("no panic").expect("the server ends");
        }
    }

    pub fn socket(&self) -> PathBuf {
        self.folder.path().join("s.sock")
    }

    /// Returns the entries of the change log. A thread writes them soon after the answers.
    pub fn changes(&self) -> Vec<Value> {
        let log = self.folder.path().join("changes.jsonl");
        let text = std::fs::read_to_string(log).unwrap_or_default();
        // The end of the last line may not be written yet.
        let complete = text.rfind('\n').map_or("", |end| &text[..end]);
        complete
            .lines()
            .map(|line| serde_json::from_str(line).expect("JSON"))
            .collect()
    }

    /// Connects a client, and waits until the bus is in Op.
    pub fn client(&self) -> Client {
        let mut client = Client::new(&self.socket());
        client.ok("await", json!({"bus": "op"}));
        client
    }

    /// Connects a client that owns the motion.
    pub fn owner(&self, name: &str) -> Client {
        let mut client = self.client();
        client.ok("take", json!({"name": name, "ttl_ms": 60_000}));
        client
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end();
    }
}

/// A client on the socket.
pub struct Client {
    pub stream: UnixStream,
    reader: BufReader<UnixStream>,
    next: u64,
    /// Events and other answers that came before an answer.
    pub events: Vec<Value>,
}

impl Client {
    pub fn new(path: &Path) -> Self {
        let stream = UnixStream::connect(path).unwrap();
        // A test fails instead of waiting for ever.
        stream
            .set_read_timeout(Some(Duration::from_secs(60)))
            .unwrap();
        Self {
            reader: BufReader::new(stream.try_clone().unwrap()),
            stream,
            next: 0,
            events: Vec::new(),
        }
    }

    /// Sends a request without waiting for its answer.
    pub fn send(&mut self, op: &str, keys: Value) -> u64 {
        self.next += 1;
        let mut request = keys;
        request["op"] = json!(op);
        request["id"] = json!(self.next);
        self.send_line(&request.to_string());
        self.next
    }

    pub fn send_line(&mut self, line: &str) {
        self.stream.write_all(line.as_bytes()).unwrap();
        self.stream.write_all(b"\n").unwrap();
    }

    pub fn line(&mut self) -> Value {
        let mut line = String::new();
        self.reader.read_line(&mut line).expect("an answer");
        assert!(!line.is_empty(), "the server has closed the connection");
        serde_json::from_str(&line).expect("JSON")
    }

    /// Returns the answer to a request. Answers come in any order.
    pub fn answer(&mut self, id: u64) -> Value {
        let is_answer = |line: &Value| line["id"] == json!(id);
        if let Some(at) = self.events.iter().position(is_answer) {
            return self.events.remove(at);
        }
        loop {
            let line = self.line();
            if is_answer(&line) {
                return line;
            }
            self.events.push(line);
        }
    }

    pub fn ask(&mut self, op: &str, keys: Value) -> Value {
        let id = self.send(op, keys);
        self.answer(id)
    }

    /// Sends a request that must succeed.
    pub fn ok(&mut self, op: &str, keys: Value) -> Value {
        let answer = self.ask(op, keys.clone());
        assert_eq!(answer["ok"], json!(true), "{op} {keys}: {answer}");
        answer
    }

    /// Sends a command and waits for its outcome, which must be good.
    pub fn done(&mut self, op: &str, mut keys: Value) -> Value {
        keys["wait"] = json!(true);
        self.ok(op, keys)
    }

    /// Sends a request that must be refused; returns the error.
    pub fn refused(&mut self, op: &str, keys: Value) -> Value {
        let answer = self.ask(op, keys.clone());
        assert_eq!(answer["ok"], json!(false), "{op} {keys}: {answer}");
        answer["error"].clone()
    }

    /// Returns the state of an axis.
    pub fn axis(&mut self, name: &str) -> Value {
        let state = self.ok("state", json!({}));
        let axes = state["axes"].as_array().unwrap();
        axes.iter()
            .find(|axis| axis["name"] == json!(name))
            .unwrap()
            .clone()
    }

    pub fn position(&mut self, name: &str) -> f64 {
        self.axis(name)["target_position"].as_f64().unwrap()
    }

    pub fn advance(&mut self, seconds: f64) {
        self.ok("advance", json!({"seconds": seconds}));
    }

    /// Returns the state once common time is known.
    pub fn locked_state(&mut self) -> Value {
        for _ in 0..100 {
            let state = self.ok("state", json!({}));
            if state["bus"]["common_time"]["locked"] == json!(true) {
                return state;
            }
            self.advance(0.1);
        }
        panic!("common time is not locked");
    }

    /// Returns the events so far of this kind.
    pub fn kept_events(&mut self, kind: &str) -> Vec<Value> {
        let events = self.ok("events", json!({}))["events"].clone();
        let events = events.as_array().unwrap().iter();
        events
            .filter(|event| event["event"] == json!(kind))
            .cloned()
            .collect()
    }
}
