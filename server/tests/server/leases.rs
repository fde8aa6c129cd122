//! Leases with many programs on all transports, which share, hang, die and take over. A model of
//! docs/server.md says what each of them may do:
//!
//! - never two owners at once;
//! - only who has the secret, or the connection that took the lease, commands;
//! - an axis moves no longer than `ttl` and its stop after the owner's last message;
//! - reading renews nothing;
//! - a lease that has expired says so, with its times.
//!
//! `ECAXIS_LEASE_ACTIONS` and `ECAXIS_LEASE_SEED` set the number of actions and their seed.

use std::io::Write;
use std::net::TcpStream;
use std::sync::{Arc, Barrier, Mutex};
use std::time::{Duration, Instant};

use ecaxis_master::clock::{self, Clock};
use ecaxis_master::session::Options;
use ecaxis_server::http::HttpOptions;
use ecaxis_test_support::random::Random;
use serde_json::{Value, json};

use crate::harness::{Client, Server, TOKEN, demo};
use crate::hostile::count;
use crate::http::request;
use crate::memory::{Area, Rows, attach};
use crate::websocket::{frame, read_frame, websocket};

/// The programs: two on each transport.
const PROGRAMS: usize = 6;
/// The velocity of all motions, and the acceleration of the demonstration.
const VELOCITY: f64 = 5.0;
const ACCELERATION: f64 = 2500.0;
/// The time in which a computer with other work sees the end of a connection and stops an axis.
const SLACK: Duration = Duration::from_millis(500);
/// The rounding of the times in messages.
const ROUNDING: Duration = Duration::from_millis(60);

/// The connection of a program.
enum Link {
    Socket(Client),
    WebSocket(TcpStream),
    /// Each request has a connection of its own.
    Http,
}

struct Program {
    link: Link,
    /// Changes with each connection.
    connection: u64,
    /// The secret that the program knows.
    secret: Option<String>,
}

impl Program {
    fn connect(server: &Server, number: usize, connection: u64) -> Self {
        let link = match number % 3 {
            0 => Link::Socket(Client::new(&server.socket())),
            1 => Link::WebSocket(websocket(server)),
            _ => Link::Http,
        };
        Self {
            link,
            connection,
            secret: None,
        }
    }

    /// Sends a request, and returns its answer.
    fn ask(&mut self, server: &Server, op: &str, mut keys: Value) -> Value {
        match &mut self.link {
            Link::Socket(client) => {
                let answer = client.ask(op, keys);
                client.events.clear();
                answer
            }
            Link::WebSocket(stream) => {
                keys["op"] = json!(op);
                keys["id"] = json!(op);
                let message = frame(1, keys.to_string().as_bytes());
                stream.write_all(&message).unwrap();
                loop {
                    let (opcode, payload) = read_frame(stream);
                    if opcode != 1 {
                        continue;
                    }
                    let answer: Value = serde_json::from_slice(&payload).unwrap();
                    if answer["id"] == json!(op) {
                        return answer;
                    }
                }
            }
            Link::Http => {
                let authorization = format!("Bearer {TOKEN}");
                let headers = [("Authorization", authorization.as_str())];
                keys["wait"] = json!(false);
                let path = format!("/api/{op}");
                request(server, "POST", &path, &headers, &keys.to_string()).json()
            }
        }
    }
}

/// Which secret a message contains.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Secret {
    None,
    Known,
    Wrong,
}

/// The lease, as the documents describe it.
#[derive(Debug, Clone)]
struct Held {
    secret: String,
    name: String,
    /// The connection that took it; none over HTTP.
    connection: Option<u64>,
    ttl: Duration,
    /// When the owner's last message was sent and answered.
    renewed: [Instant; 2],
    /// When its connection has closed.
    closed: Option<Instant>,
}

/// Whether a lease was held during a request.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Known {
    Held,
    Ended,
    /// It ended at about this time.
    Unknown,
}

impl Held {
    fn during(&self, [sent, answered]: [Instant; 2]) -> Known {
        match self.closed {
            Some(closed) if sent > closed + SLACK => Known::Ended,
            Some(_) => Known::Unknown,
            None if answered < self.renewed[0] + self.ttl => Known::Held,
            None if sent > self.renewed[1] + self.ttl => Known::Ended,
            None => Known::Unknown,
        }
    }
}

struct World<'a> {
    server: &'a Server,
    random: Random,
    programs: Vec<Program>,
    connections: u64,
    held: Option<Held>,
    /// The last lease that ended by its time, until another one is taken.
    expired: Option<Held>,
    rows: Rows<'a>,
    target: Option<f64>,
    /// The time in ns at which the axis must have stopped.
    moves_until: u64,
    /// The axis moved in the last cycle.
    moves: bool,
    moved: u64,
    /// Follows the events.
    watcher: Client,
    owner: Value,
    counts: [u64; 4],
}

impl<'a> World<'a> {
    fn new(server: &'a Server, area: &'a Area, seed: u64) -> Self {
        let mut watcher = server.client();
        let owner = watcher.ok("state", json!({}))["lease"]["owner"].clone();
        watcher.ok("subscribe", json!({"topics": ["events"]}));
        let programs = (0..PROGRAMS).map(|n| Program::connect(server, n, n as u64));
        Self {
            server,
            random: Random::new(seed),
            programs: programs.collect(),
            connections: PROGRAMS as u64,
            held: None,
            expired: None,
            rows: Rows::new(area, "x"),
            target: None,
            moves_until: clock::now(),
            moves: false,
            moved: 0,
            watcher,
            owner,
            counts: [0; 4],
        }
    }

    fn below(&mut self, bound: u64) -> u64 {
        self.random.below(bound)
    }

    /// Returns the secret of a message, and whether the sender is the owner by it.
    fn claim(&self, program: usize, secret: Secret) -> (Option<String>, bool) {
        let program = &self.programs[program];
        let secret = match secret {
            Secret::Known => program.secret.clone(),
            Secret::Wrong => Some("0123456789abcdef0123456789abcdef".to_owned()),
            Secret::None => None,
        };
        let claims = self.held.as_ref().is_some_and(|held| match &secret {
            Some(secret) => *secret == held.secret,
            None => {
                !matches!(program.link, Link::Http) && held.connection == Some(program.connection)
            }
        });
        (secret, claims)
    }

    /// Sends a message, and returns the answer with the times before and after.
    fn ask(&mut self, program: usize, op: &str, keys: Value) -> (Value, [Instant; 2]) {
        let sent = Instant::now();
        let answer = self.programs[program].ask(self.server, op, keys);
        (answer, [sent, Instant::now()])
    }

    /// The axis stops from now on, unless an owner commands it again.
    fn end_motion(&mut self, after: Duration) {
        let stop = Duration::from_secs_f64(VELOCITY / ACCELERATION);
        let end = clock::now() + (after + stop + SLACK).as_nanos() as u64;
        self.moves_until = self.moves_until.min(end);
    }

    /// The owner has spoken.
    fn renew(&mut self, times: [Instant; 2]) {
        let held = self.held.as_mut().expect("an owner");
        held.renewed = times;
        self.moves_until = u64::MAX;
        let ttl = held.ttl;
        self.end_motion(ttl);
    }

    /// Moves a lease that has ended.
    fn settle(&mut self, known: Known) {
        if known == Known::Ended
            && let Some(held) = self.held.take()
            && held.closed.is_none()
        {
            self.expired = Some(held);
        }
    }

    /// What the lease was during a request. Where the times do not say it, its answer does.
    fn known(&self, times: [Instant; 2], answer: &Value) -> Known {
        let Some(held) = &self.held else {
            return Known::Ended;
        };
        match held.during(times) {
            Known::Unknown if answer["error"]["code"] == json!("no_lease") => Known::Ended,
            Known::Unknown => Known::Held,
            known => known,
        }
    }

    /// Checks that a command with a claim had the answer that the documents promise.
    fn check(
        &mut self,
        what: &str,
        claims: bool,
        secret: &Option<String>,
        program: usize,
        times: [Instant; 2],
        answer: &Value,
    ) {
        let known = self.known(times, answer);
        let code = answer["error"]["code"].as_str().unwrap_or_default();
        let context = format!(
            "{what}, claims: {claims}, {known:?}, {answer}, {:?}",
            self.held
        );
        self.settle(known);
        match (known, claims) {
            (Known::Held, true) => {
                assert!(!["no_lease", "not_owner"].contains(&code), "{context}");
                self.counts[0] += 1;
                self.renew(times);
            }
            (Known::Held, false) => {
                assert_eq!(code, "not_owner", "only the owner commands: {context}");
                let owner = self.held.as_ref().map(|held| held.name.as_str());
                assert_eq!(
                    answer["error"]["owner"]["name"].as_str(),
                    owner,
                    "{context}"
                );
                self.counts[1] += 1;
            }
            _ => {
                assert_eq!(code, "no_lease", "it has ended: {context}");
                self.check_expiry(secret, program, times, answer);
                self.counts[2] += 1;
            }
        }
    }

    /// The former owner learns when its lease was renewed, and how long it lasts.
    fn check_expiry(
        &mut self,
        secret: &Option<String>,
        program: usize,
        times: [Instant; 2],
        answer: &Value,
    ) {
        let Some(expired) = &self.expired else {
            return;
        };
        let program = &self.programs[program];
        let own = match secret {
            Some(secret) => *secret == expired.secret,
            None => {
                !matches!(program.link, Link::Http)
                    && expired.connection == Some(program.connection)
            }
        };
        let message = answer["error"]["message"].as_str().unwrap_or_default();
        let Some(rest) = message
            .strip_prefix("the lease has expired: it was renewed ")
            .filter(|_| own)
        else {
            assert!(!own, "it does not say that it has expired: {message}");
            return;
        };
        let (silent, rest) = rest.split_once(" s ago, and lasts ").expect(message);
        let seconds = |text: &str| Duration::from_secs_f64(text.parse().expect(message));
        let silent = seconds(silent);
        assert!(
            silent + ROUNDING >= times[0].duration_since(expired.renewed[1]),
            "{message}"
        );
        assert!(
            silent <= times[1].duration_since(expired.renewed[0]) + ROUNDING,
            "{message}"
        );
        assert_eq!(
            seconds(rest.trim_end_matches(" s")),
            expired.ttl,
            "{message}"
        );
        self.counts[3] += 1;
    }

    fn take(&mut self, program: usize, secret: Secret, force: bool) {
        let (secret, claims) = self.claim(program, secret);
        let ttl = 100 + 50 * self.below(6);
        let name = format!("program {program}");
        let mut keys = json!({"name": name, "ttl_ms": ttl, "force": force});
        if let Some(secret) = &secret {
            keys["lease"] = json!(secret);
        }
        let (answer, times) = self.ask(program, "take", keys);
        let code = answer["error"]["code"].as_str().unwrap_or_default();
        let known = match &self.held {
            Some(held) if held.during(times) == Known::Unknown => match code {
                "not_owner" => Known::Held,
                // The secret of the lease says whether it is the same.
                _ if answer["lease"] == json!(held.secret) => Known::Held,
                _ => Known::Ended,
            },
            _ => self.known(times, &answer),
        };
        let context = format!(
            "take, claims: {claims}, force: {force}, {known:?}, {answer}, {:?}",
            self.held
        );
        self.settle(known);
        if known == Known::Held && !claims && !force {
            assert_eq!(code, "not_owner", "two owners: {context}");
            return;
        }
        assert_eq!(answer["ok"], json!(true), "{context}");
        let given = answer["lease"].as_str().expect("a secret").to_owned();
        self.programs[program].secret = Some(given.clone());
        let ttl = Duration::from_millis(ttl);
        if known == Known::Held && claims {
            let held = self.held.as_mut().expect("an owner");
            assert_eq!(given, held.secret, "{context}");
            (held.ttl, held.name) = (ttl, name);
            self.renew(times);
            return;
        }
        // What the previous owner moved stops.
        self.end_motion(Duration::ZERO);
        let connection = match self.programs[program].link {
            Link::Http => None,
            _ => Some(self.programs[program].connection),
        };
        self.expired = None;
        self.held = Some(Held {
            secret: given,
            name,
            connection,
            ttl,
            renewed: times,
            closed: None,
        });
    }

    fn command(&mut self, program: usize, secret: Secret) {
        let (secret, claims) = self.claim(program, secret);
        let back = self.below(2) == 0;
        let velocity = match self.target {
            Some(target) if target > 20.0 => -VELOCITY,
            Some(target) if target < -20.0 => VELOCITY,
            _ if back => -VELOCITY,
            _ => VELOCITY,
        };
        let (op, mut keys) = match self.below(6) {
            0 => ("renew", json!({})),
            1 => ("enable", json!({"axis": "x"})),
            2 => ("jog", json!({"axis": "x", "velocity": velocity})),
            _ => ("velocity", json!({"axis": "x", "velocity": velocity})),
        };
        if let Some(secret) = &secret {
            keys["lease"] = json!(secret);
        }
        let (answer, times) = self.ask(program, op, keys);
        self.check(op, claims, &secret, program, times, &answer);
    }

    fn release(&mut self, program: usize, secret: Secret) {
        let (secret, claims) = self.claim(program, secret);
        let mut keys = json!({});
        if let Some(secret) = &secret {
            keys["lease"] = json!(secret);
        }
        let (answer, times) = self.ask(program, "release", keys);
        self.check("release", claims, &secret, program, times, &answer);
        if answer["ok"] == json!(true) {
            self.held = None;
            self.end_motion(Duration::ZERO);
        }
    }

    fn read(&mut self, program: usize, secret: Secret) {
        let (secret, _) = self.claim(program, secret);
        let ops = [
            "state",
            "machine",
            "events",
            "diagnostics",
            "hello",
            "fault_reports",
        ];
        let op = ops[self.below(ops.len() as u64) as usize];
        let keys = secret.map_or_else(|| json!({}), |secret| json!({"lease": secret}));
        let (answer, _) = self.ask(program, op, keys);
        assert_eq!(answer["ok"], json!(true), "{op}: {answer}");
    }

    /// The connection closes without a release, and the program starts again.
    fn die(&mut self, program: usize) {
        let connection = self.programs[program].connection;
        self.connections += 1;
        self.programs[program] = Program::connect(self.server, program, self.connections);
        if let Some(held) = self.held.as_mut()
            && held.connection == Some(connection)
        {
            held.closed = Some(Instant::now());
            self.end_motion(Duration::ZERO);
        }
    }

    fn act(&mut self) {
        let program = self.below(PROGRAMS as u64) as usize;
        // Most often the owner, by its connection or secret.
        let owner = self.held.as_ref().and_then(|held| {
            let secret = &held.secret;
            self.programs
                .iter()
                .position(|p| p.secret.as_ref() == Some(secret))
        });
        let program = owner
            .filter(|_| self.random.below(3) > 0)
            .unwrap_or(program);
        let secret = match self.below(8) {
            0 => Secret::Wrong,
            1 | 2 => Secret::None,
            _ => Secret::Known,
        };
        match self.below(32) {
            0..4 => self.take(program, secret, false),
            4 => self.take(program, secret, true),
            5 => self.release(program, secret),
            6 => self.die(program),
            7 => {
                // The owner gives its secret to another program.
                let to = self.below(PROGRAMS as u64) as usize;
                self.programs[to].secret = self.programs[program].secret.clone();
            }
            8..12 => self.read(program, secret),
            12 => {
                let (answer, times) = self.ask(program, "stop", json!({}));
                assert_eq!(answer["ok"], json!(true), "{answer}");
                // A stop of the owner's own connection renews.
                if self.claim(program, Secret::None).1 && self.known(times, &answer) == Known::Held
                {
                    let before = self.held.as_ref().map(|held| held.during(times));
                    if before == Some(Known::Held) {
                        self.renew(times);
                    }
                }
            }
            13..17 => {
                // The owner hangs, or only reads: for less or more than its time.
                let ttl = self
                    .held
                    .as_ref()
                    .map_or(100, |held| held.ttl.as_millis() as u64);
                let end = Instant::now() + Duration::from_millis(self.below(ttl * 3 / 2));
                let reads = self.below(2) == 0;
                while Instant::now() < end {
                    std::thread::sleep(Duration::from_millis(5));
                    if reads {
                        self.read(program, secret);
                    }
                }
            }
            17 if self.moves => {
                // All programs are silent until the axis must have stopped.
                let left = self.moves_until.saturating_sub(clock::now());
                std::thread::sleep(Duration::from_nanos(left) + Duration::from_millis(20));
            }
            _ => self.command(program, secret),
        }
    }

    /// Checks the motion of every cycle, and the chain of owners.
    fn observe(&mut self) {
        while let Some((time, target, enabled)) = self.rows.read_with_time() {
            let before = self.target.replace(target);
            let moves = enabled && before.is_some_and(|before| (target - before).abs() > 1e-9);
            self.moves = moves;
            self.moved += u64::from(moves);
            let late = time.saturating_sub(self.moves_until);
            assert!(
                !moves || late == 0,
                "the axis moves {late} ns too long: {:?}",
                self.held
            );
        }
        self.watcher.ok("hello", json!({}));
        for event in std::mem::take(&mut self.watcher.events) {
            assert_ne!(event["event"], json!("missed"), "{event}");
            if event["event"] == json!("lease") {
                assert_eq!(event["previous"]["client"], self.owner["client"], "{event}");
                let [previous, owner] = ["previous", "owner"].map(|key| &event[key]["client"]);
                match event["why"].as_str() {
                    // The owner itself may take it again.
                    Some("taken") => assert!(previous.is_null() || previous == owner, "{event}"),
                    Some("taken over") => assert!(!previous.is_null(), "{event}"),
                    _ => assert!(!previous.is_null() && owner.is_null(), "{event}"),
                }
                self.owner = event["owner"].clone();
            }
        }
    }
}

#[test]
fn programs_of_all_kinds_obey_the_lease() {
    let server = Server::with_http(demo(), true);
    let mut setup = server.owner("setup");
    setup.done("enable", json!({"axis": "*"}));
    let area = attach(&mut setup);
    setup.ok("release", json!({}));
    drop(setup);
    let mut world = World::new(&server, &area, count("ECAXIS_LEASE_SEED", 1));
    for _ in 0..count("ECAXIS_LEASE_ACTIONS", 300) {
        world.act();
        world.observe();
    }
    let [accepted, refused, ended, expired] = world.counts;
    println!(
        "{accepted} commands of owners, {refused} of others, {ended} without a lease, {expired} of these of former owners, {} cycles moved",
        world.moved
    );
    assert!(accepted > 10 && refused > 5 && ended > 5 && expired > 0 && world.moved > 100);
}

/// Programs take and release at the same time: the times in which they own the motion do not
/// overlap.
#[test]
fn programs_at_the_same_time_are_never_two_owners() {
    let options = Options {
        clock: Clock::Virtual,
        ..Options::default()
    };
    let http = HttpOptions {
        address: "127.0.0.1:0".parse().unwrap(),
        control: true,
        token: TOKEN.to_owned(),
        watch_token: None,
        known_token: false,
        hosts: Vec::new(),
        recordings: None,
    };
    let server = Server::start(demo(), options, Some(http));
    server.client();
    let rounds = count("ECAXIS_LEASE_ACTIONS", 300) / 3;
    let (begin, owned) = (Barrier::new(PROGRAMS), Arc::new(Mutex::new(Vec::new())));
    std::thread::scope(|scope| {
        for number in 0..PROGRAMS {
            let (server, begin, owned) = (&server, &begin, Arc::clone(&owned));
            scope.spawn(move || {
                let mut random = Random::new(number as u64 + 1);
                let mut program = Program::connect(server, number, 0);
                begin.wait();
                for _ in 0..rounds {
                    let name = format!("program {number}");
                    let answer = program.ask(server, "take", json!({"name": name}));
                    if answer["ok"] != json!(true) {
                        assert_eq!(answer["error"]["code"], json!("not_owner"), "{answer}");
                        continue;
                    }
                    let from = Instant::now();
                    let secret = json!({"lease": answer["lease"]});
                    for _ in 0..random.below(3) {
                        let answer = program.ask(server, "renew", secret.clone());
                        assert_eq!(answer["ok"], json!(true), "{answer}");
                    }
                    owned.lock().unwrap().push((from, Instant::now(), number));
                    // A program that dies has no lease either, some time later.
                    if random.below(8) == 0 && number % 3 != 2 {
                        program = Program::connect(server, number, 0);
                        continue;
                    }
                    let answer = program.ask(server, "release", secret);
                    assert_eq!(answer["ok"], json!(true), "{answer}");
                }
            });
        }
    });
    let mut owned = std::mem::take(&mut *owned.lock().unwrap());
    owned.sort();
    for pair in owned.windows(2) {
        assert!(pair[0].1 <= pair[1].0, "two owners: {pair:?}");
    }
    let programs: std::collections::HashSet<_> = owned.iter().map(|(.., number)| number).collect();
    println!("{} times of {} owners", owned.len(), programs.len());
    assert!(programs.len() > 1);
}
