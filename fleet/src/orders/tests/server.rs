//! Orders against a server that answers as `ecaxis serve` does.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Mutex;
use std::thread;

use serde_json::{Value, json};

use super::*;

/// The machine as the server sees it, and the connection that waits for the end of the program.
#[derive(Default)]
struct Served {
    sha256: String,
    program: Option<(UnixStream, Value)>,
    stops: usize,
    starts: usize,
    /// The state of the bus after it has come up, and now.
    up: Option<&'static str>,
    bus: Option<&'static str>,
    /// The connection with the lease.
    owner: Option<usize>,
}

/// The server notes the end of a connection later than the client.
const NOTED: Duration = Duration::from_millis(500);

fn serve(folder: &Path) -> Arc<Mutex<Served>> {
    let served = Arc::new(Mutex::new(Served::default()));
    let listener = UnixListener::bind(folder.join("m.sock")).unwrap();
    let shared = Arc::clone(&served);
    thread::spawn(move || {
        for (connection, stream) in listener.incoming().flatten().enumerate() {
            let served = Arc::clone(&shared);
            thread::spawn(move || {
                answer(connection, &stream, &served);
                thread::sleep(NOTED);
                let mut served = served.lock().unwrap();
                served.owner = served.owner.filter(|owner| *owner != connection);
            });
        }
    });
    served
}

fn answer(connection: usize, stream: &UnixStream, served: &Mutex<Served>) {
    for line in BufReader::new(stream)
        .lines()
        .map_while(std::io::Result::ok)
    {
        let request: Value = serde_json::from_str(&line).unwrap();
        let id = &request["id"];
        let mut served = served.lock().unwrap();
        let mut answers = vec![(stream.try_clone().unwrap(), json!({"id": id, "ok": true}))];
        match request["op"].as_str().unwrap() {
            "hello" => answers[0].1["protocol"] = json!(1),
            "machine" => {
                answers[0].1["axes"] = json!([]);
                answers[0].1["sha256"] = json!(served.sha256);
            }
            "state" => {
                answers[0].1["axes"] = json!([]);
                answers[0].1["program"] = json!({"running": served.program.is_some()});
                answers[0].1["bus"] = json!({"state": served.bus.unwrap_or("op")});
            }
            "take" => match *served.owner.get_or_insert(connection) == connection {
                true => answers[0].1["lease_ms"] = json!(5000),
                false => {
                    answers[0].1["ok"] = json!(false);
                    answers[0].1["error"] = json!({"code": "not_owner", "message": "another connection owns the motion"});
                }
            },
            "bus" => {
                let up = request["action"] == "up";
                served.bus = if up { served.up } else { Some("down") };
            }
            "program" => {
                served.starts += 1;
                let (waits, _) = answers.pop().unwrap();
                served.program = Some((waits, id.clone()));
            }
            "stop" => {
                served.stops += 1;
                let error = json!({"code": "replaced", "message": "all axes were stopped"});
                let ended = served.program.take();
                answers
                    .extend(ended.map(|(waits, id)| {
                        (waits, json!({"id": id, "ok": false, "error": error}))
                    }));
            }
            _ => {}
        }
        for (mut stream, answer) in answers {
            let _ = writeln!(stream, "{answer}");
        }
    }
}

fn nonce(number: u8) -> String {
    format!("{number:032x}")
}

fn stop(signer: &Signer, number: u8, start: Option<String>) -> Vec<u8> {
    order(signer, number, |order| {
        let start = start.clone();
        order.action = Action::Stop { start };
    })
}

fn started(executor: &Arc<OrderExecutor>, order: &[u8]) {
    let begin = executor.receive(order);
    assert_eq!(begin.status, Status::Running, "{}", begin.text);
    assert_eq!(outcome(executor, order).status, Status::Started);
}

#[test]
fn a_stop_ends_a_start_that_runs_and_may_be_repeated() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    let (signer, pair) = keys();
    let executor = executor(folder.path(), &[key(&pair, &[Right::Start])]);
    let start = order(&signer, 1, |_| ());
    started(&executor, &start);
    let busy = executor.receive(&order(&signer, 2, |_| ()));
    assert!(busy.text.contains("is not done yet"), "{}", busy.text);
    for number in [3, 4] {
        let reply = executor.receive(&stop(&signer, number, None));
        assert_eq!(reply.status, Status::Done, "{}", reply.text);
    }
    let begin = Instant::now();
    while executor.receive(&start).status == Status::Started {
        assert!(begin.elapsed() < Duration::from_secs(20));
        thread::sleep(Duration::from_millis(10));
    }
    let reply = executor.receive(&start);
    assert_eq!(reply.status, Status::Failed);
    assert!(
        reply.text.contains("all axes were stopped"),
        "{}",
        reply.text
    );
    assert!(served.lock().unwrap().stops >= 2);
}

fn start_at(signer: &Signer, number: u8, at: u64) -> Vec<u8> {
    order(signer, number, |order| {
        (order.not_before, order.not_after) = (at - 30, at + 60);
    })
}

fn stop_at(signer: &Signer, number: u8, at: u64) -> Vec<u8> {
    order(signer, number, |order| {
        (order.not_before, order.not_after) = (at - 30, at + 60);
        order.action = Action::Stop { start: None };
    })
}

/// A start that was sent before a stop does not begin after it; one of the same second may be newer.
#[test]
fn a_start_from_before_a_stop_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    let (signer, pair) = keys();
    let executor = executor(folder.path(), &[key(&pair, &[Right::Start])]);
    let now = unix_time();
    let reply = executor.receive(&stop_at(&signer, 1, now));
    assert_eq!(reply.status, Status::Done, "{}", reply.text);
    for (number, at) in [(2, now - 2), (5, now)] {
        let late = executor.receive(&start_at(&signer, number, at));
        assert_eq!(late.status, Status::Refused, "{}", late.text);
        assert!(late.text.contains("after this start"), "{}", late.text);
    }
    assert_eq!(served.lock().unwrap().starts, 0);
    started(&executor, &start_at(&signer, 3, now + 20));
    executor.receive(&stop_at(&signer, 4, now));
}

/// The clock of the computer that sent the stop is behind: the stop counts from its arrival.
#[test]
fn a_start_from_before_the_arrival_of_a_stop_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    let (signer, pair) = keys();
    let executor = executor(folder.path(), &[key(&pair, &[Right::Start])]);
    let now = unix_time();
    let behind = executor.receive(&stop_at(&signer, 1, now - 20));
    assert_eq!(behind.status, Status::Done, "{}", behind.text);
    let late = executor.receive(&start_at(&signer, 2, now - 5));
    assert_eq!(late.status, Status::Refused, "{}", late.text);
    assert!(late.text.contains("after this start"), "{}", late.text);
    assert_eq!(served.lock().unwrap().starts, 0);
}

#[test]
fn a_stop_of_one_start_leaves_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path());
    let (signer, pair) = keys();
    let rights = [key(&pair, &[Right::Start])];
    let executor = executor(folder.path(), &rights);
    // It comes before its start, as a network may have it.
    let reply = executor.receive(&stop(&signer, 1, Some(nonce(2))));
    assert_eq!(reply.status, Status::Done, "{}", reply.text);
    let late = executor.receive(&order(&signer, 2, |_| ()));
    assert_eq!(late.status, Status::Refused, "{}", late.text);
    let start = order(&signer, 3, |_| ());
    started(&executor, &start);
    executor.receive(&stop(&signer, 4, Some(nonce(2))));
    assert_eq!(served.lock().unwrap().stops, 0);
    assert_eq!(executor.receive(&start).status, Status::Started);
    let reply = executor.receive(&stop(&signer, 5, Some(nonce(3))));
    assert_eq!(reply.status, Status::Done, "{}", reply.text);
    assert_eq!(served.lock().unwrap().stops, 1);
    assert_eq!(executor.receive(&start).status, Status::Failed);
    assert_eq!(served.lock().unwrap().starts, 1);
}

#[test]
fn the_right_to_start_includes_the_stop_alone() {
    for (rights, permitted) in [
        (vec![Right::Start], true),
        (vec![Right::Stop], true),
        (vec![Right::Push, Right::Update, Right::Bundle], false),
    ] {
        let folder = tempfile::tempdir().unwrap();
        serve(folder.path());
        let (signer, pair) = keys();
        let executor = executor(folder.path(), &[key(&pair, &rights)]);
        let reply = executor.receive(&stop(&signer, 1, None));
        assert_eq!(reply.status == Status::Done, permitted, "{}", reply.text);
        let later = order(&signer, 2, |order| {
            order.not_after += 1;
        });
        let start = executor.receive(&later);
        assert_eq!(
            start.status == Status::Running,
            rights.contains(&Right::Start)
        );
    }
}

/// A program that accepts each machine file, with the digest of `manifest`.
fn accepting(folder: &Path) -> String {
    use std::os::unix::fs::PermissionsExt;
    let path = folder.join("ecaxis");
    let digest = FileDigest::of(b"machine");
    let text = format!("#!/bin/sh\necho '{{\"sha256\": \"{digest}\", \"files\": []}}'\n");
    fs::write(&path, text).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    path.display().to_string()
}

/// Whether the device is well shows only when its bus is up.
#[test]
fn an_update_that_makes_the_bus_unhealthy_takes_it_down_again() {
    for (up, status, why, after) in [
        ("op", Status::Done, "has the parameters", "op"),
        ("error", Status::Failed, "the bus is `error`", "down"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let ecaxis = accepting(folder.path());
        install(folder.path(), b"machine", None);
        let served = serve(folder.path());
        {
            let mut served = served.lock().unwrap();
            served.sha256 = FileDigest::of(b"machine").to_string();
            served.up = Some(up);
        }
        let (signer, pair) = keys();
        let rights = [key(&pair, &[Right::Update])];
        let source = Memory::new(&[b"values"], 9);
        let executor = executor_with(folder.path(), &rights, &ecaxis, source);
        let update = order(&signer, 1, |order| {
            order.action = Action::Parameters {
                device: "x".to_owned(),
                name: BundlePath::try_from("x.toml".to_owned()).unwrap(),
                file: FileRef::of(b"values"),
            };
        });
        let reply = outcome(&executor, &update);
        assert_eq!(reply.status, status, "{}", reply.text);
        assert!(reply.text.contains(why), "{}", reply.text);
        assert!(!reply.text.contains("stays up"), "{}", reply.text);
        assert_eq!(served.lock().unwrap().bus, Some(after));
    }
}

/// Makes a bundle the current one.
fn install(folder: &Path, content: &[u8], pending: Option<&str>) -> FileDigest {
    let slots = Slots::open(&folder.join("orders")).unwrap();
    let made = manifest(vec![file("m.toml", content)]);
    let text = made.emit();
    let (id, signature) = (FileDigest::of(&text), String::new());
    let unpacked = Unpacked {
        id,
        text,
        signature,
        manifest: made,
    };
    slots.unpack(&unpacked, &[content.to_vec()]).unwrap();
    slots
        .switch(&Switch {
            to: id,
            current: slots.current(),
            previous: slots.previous(),
            sender: "anna".to_owned(),
            nonce: pending.map(str::to_owned),
        })
        .unwrap();
    if pending.is_none() {
        slots.confirm().unwrap();
    }
    id
}

#[test]
fn a_push_needs_the_server_of_its_machine() {
    let own = FileDigest::of(b"machine").to_string();
    for (installed, server, no_server, status, why) in [
        (false, None, false, Status::Refused, "no server answers at"),
        (true, None, false, Status::Refused, "no server answers at"),
        (
            false,
            Some("of another machine"),
            false,
            Status::Refused,
            "does not run",
        ),
        (
            true,
            Some("of another machine"),
            true,
            Status::Refused,
            "does not run",
        ),
        // The switch begins; without a server after it, the machine is not healthy.
        (
            false,
            None,
            true,
            Status::Failed,
            "no bundle is current, as before",
        ),
        (
            true,
            Some(own.as_str()),
            false,
            Status::Done,
            "runs the bundle",
        ),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let ecaxis = accepting(folder.path());
        let before = installed.then(|| install(folder.path(), b"before", None));
        if let Some(sha256) = server {
            serve(folder.path()).lock().unwrap().sha256 = sha256.to_owned();
        }
        let (signer, pair) = keys();
        let text = manifest(vec![file("m.toml", b"pushed")]).emit();
        let signature = signer.sign(&text, "manifest.json", 1).unwrap();
        let source = Memory::new(&[&text, b"pushed"], 9);
        let rights = [key(&pair, &[Right::Push, Right::Bundle])];
        let executor = executor_with(folder.path(), &rights, &ecaxis, source);
        let push = order(&signer, 1, |order| {
            let signature = signature.clone();
            order.action = Action::Push {
                manifest: FileRef::of(&text),
                signature,
                no_server,
            };
        });
        let reply = outcome(&executor, &push);
        let case = format!("{installed} {server:?} {no_server}: {}", reply.text);
        assert!(reply.status == status && reply.text.contains(why), "{case}");
        let slots = Slots::open(&folder.path().join("orders")).unwrap();
        let done = status == Status::Done;
        let current = if done {
            Some(FileDigest::of(&text))
        } else {
            before
        };
        assert_eq!(slots.current(), current, "{case}");
        // Nothing of a refused or failed bundle is left.
        let left = |path: &str| fs::read_dir(folder.path().join(path)).unwrap().count();
        assert_eq!(slots.path(FileDigest::of(&text)).exists(), done, "{case}");
        assert_eq!(left("orders/files"), usize::from(done), "{case}");
    }
}

#[test]
fn a_switch_after_a_restart_of_the_agent_ends_its_order() {
    for (sha256, status) in [
        (FileDigest::of(b"machine").to_string(), Status::Done),
        ("of another machine".to_owned(), Status::Failed),
    ] {
        let folder = tempfile::tempdir().unwrap();
        serve(folder.path()).lock().unwrap().sha256 = sha256;
        let (signer, pair) = keys();
        let rights = [key(&pair, &[Right::Push])];
        let push = order(&signer, 1, |order| {
            order.action = Action::Back { no_server: false }
        });
        // The agent ends during the order: the log has its beginning alone.
        fs::create_dir(folder.path().join("orders")).unwrap();
        let log = folder.path().join("orders/orders.jsonl");
        let mut journal = super::super::journal::OrderJournal::open(&log).unwrap();
        let text = SignedOrder::parse(&push).unwrap().order;
        let begun = OrderReply::new(Status::Running, "accepted");
        let (order, sha256) = (
            Order::parse(&text).unwrap(),
            FileDigest::of(text.as_bytes()),
        );
        journal
            .begin(&order, sha256, "anna", unix_time(), begun)
            .unwrap();
        drop(journal);
        install(folder.path(), b"m", Some(&nonce(1)));
        let after = executor(folder.path(), &rights);
        after.resume().unwrap();
        assert_eq!(after.receive(&push).status, Status::Running);
        let reply = outcome(&after, &push);
        assert_eq!(reply.status, status, "{}", reply.text);
        let log = fs::read_to_string(&log).unwrap();
        let last: Value = serde_json::from_str(log.lines().last().unwrap()).unwrap();
        assert_eq!(last["status"], json!(status));
    }
}
