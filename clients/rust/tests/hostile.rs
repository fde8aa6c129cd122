//! Servers that answer what no `ecaxis serve` answers.

use std::io::{BufRead, BufReader, IoSlice, Write};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::{UnixListener, UnixStream};
use std::time::Duration;

use ecaxis_client::layout::{commands, samples};
use ecaxis_client::{Machine, Options, Result, SetPoint};
use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create};
use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};
use serde_json::{Value, json};

/// Serves one client: calls `answer` with each request.
fn serve(
    mut answer: impl FnMut(&mut UnixStream, &Value) + Send + 'static,
) -> (tempfile::TempDir, std::path::PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("s.sock");
    let listener = UnixListener::bind(&path).expect("a socket");
    std::thread::spawn(move || {
        let Ok((mut stream, _)) = listener.accept() else {
            return;
        };
        let reader = BufReader::new(stream.try_clone().expect("a copy"));
        for line in reader.lines().map_while(std::result::Result::ok) {
            answer(&mut stream, &serde_json::from_str(&line).expect("JSON"));
        }
    });
    (folder, path)
}

fn good(request: &Value) -> Value {
    let axis = json!({
        "name": "x", "unit": "mm", "homing": true, "state": "Operation enabled",
        "enabled": true, "ready": true, "position": 1.5, "velocity": null, "torque": 0,
        "target_position": 1.5, "target_velocity": 0.0, "following_error": 0.0,
        "fault": null, "trip": null,
        "limits": {"position": [-60.0, 60.0], "velocity": 250.0, "acceleration": 2500.0},
    });
    let mut answer = match request["op"].as_str() {
        Some("hello") => json!({"protocol": 1}),
        Some("machine") => json!({"axes": [axis]}),
        Some("state") => json!({"axes": [axis], "inputs": []}),
        _ => json!({}),
    };
    answer["id"] = request["id"].clone();
    answer["ok"] = json!(true);
    answer
}

/// Uses what a program uses.
fn exercise(path: &std::path::Path) -> Result<()> {
    let machine = Machine::attach(path, Options::default())?;
    machine.enable("*")?;
    let request = machine.move_to("x", 1.0, 1.0)?;
    machine.wait(request, Duration::from_millis(100))?;
    machine.axis("x")?;
    let mut cyclic = machine.cyclic()?;
    let axis = cyclic.axis("x")?;
    let signal = cyclic.signal("x.position")?;
    for _ in 0..3 {
        cyclic.poll();
        cyclic.set(axis, SetPoint::Position(cyclic.value(signal)));
        cyclic.publish();
        machine.keep()?;
    }
    Ok(())
}

#[test]
fn answers_that_no_server_gives_are_errors() {
    let deep = "[".repeat(100_000);
    for text in [
        "\u{0}\u{1}\u{fffd}",
        "17",
        "{\"id\": 1, \"ok",
        &deep,
        r#"{"id": 1, "ok": false}"#,
        r#"{"ok": true, "axes": [1], "protocol": 1}"#,
        r#"{"ok": true, "axes": {"a": "b"}, "protocol": 2}"#,
    ] {
        let line = format!("{text}\n");
        let (_folder, path) = serve(move |stream, _| {
            let _ = stream.write_all(line.as_bytes());
        });
        let error = exercise(&path).expect_err(text);
        assert!(!error.cause.is_empty(), "{error}");
    }
    let (_folder, path) = serve(|stream, _| drop(stream.shutdown(std::net::Shutdown::Both)));
    assert_eq!(&*exercise(&path).unwrap_err().code, "lost");
    let (_folder, path) = serve(|stream, _| drop(stream.write_all(&vec![b'a'; 40 << 20])));
    assert_eq!(&*exercise(&path).unwrap_err().code, "protocol");
}

/// Makes memory from words; `text` follows them.
fn memory(words: &[(usize, u64)], magic: [u8; 8], text: &[u8], seal: bool) -> OwnedFd {
    let mut all = [0_u64; 16];
    all[0] = u64::from_ne_bytes(magic);
    for (at, word) in words {
        all[*at] = *word;
    }
    let fd = memfd_create("hostile", MemfdFlags::ALLOW_SEALING).expect("memory");
    let mut bytes: Vec<u8> = all.iter().flat_map(|word| word.to_ne_bytes()).collect();
    bytes.extend(text);
    rustix::io::write(&fd, &bytes).expect("a write");
    ftruncate(&fd, 4096).expect("a size");
    if seal {
        fcntl_add_seals(&fd, SealFlags::SHRINK).expect("a seal");
    }
    fd
}

/// Runs a client against a server whose area has some words changed.
fn with_area(
    sample: Option<(usize, u64)>,
    command: Option<(usize, u64)>,
    seal: bool,
) -> Result<()> {
    let (_folder, path) = serve(move |stream, request| {
        let line = format!("{}\n", good(request));
        if request["op"] != json!("area") {
            let _ = stream.write_all(line.as_bytes());
            return;
        }
        let text = json!({"signals": [{"name": "x.position", "word": 8}]}).to_string();
        let mut words = vec![
            (samples::VERSION_AT, samples::VERSION),
            (samples::ROWS_AT, 64),
            (samples::ROW_WORDS, 12),
            (samples::ROWS, 4),
            (samples::CYCLE_NS, 1_000_000),
            (samples::WRITTEN, 9),
            (samples::DESCRIPTION_AT, 128),
            (samples::DESCRIPTION_BYTES, text.len() as u64),
        ];
        words.extend(sample);
        let first = memory(&words, samples::MAGIC, text.as_bytes(), seal);
        let mut words = vec![
            (commands::VERSION_AT, commands::VERSION),
            (commands::AXES_AT, 16),
            (commands::AXIS_WORDS, 4),
            (commands::AXES, 1),
        ];
        words.extend(command);
        let second = memory(&words, commands::MAGIC, &[], seal);
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        let fds = [first.as_fd(), second.as_fd()];
        control.push(SendAncillaryMessage::ScmRights(&fds));
        let bytes = [IoSlice::new(line.as_bytes())];
        sendmsg(stream, &bytes, &mut control, SendFlags::empty()).expect("a message");
    });
    exercise(&path)
}

#[test]
fn memory_of_another_layout_is_refused() {
    with_area(None, None, true).expect("the good one is used");
    for value in [0, 1, 1 << 32, 1 << 61, u64::MAX] {
        for at in [0, 1, 2, 3, 4, 8, 9] {
            let result = with_area(Some((at, value)), None, true);
            // A place that is inside the memory holds other values, not another layout.
            let inside = matches!((at, value), (1, 1) | (2, 0 | 1) | (4, 1));
            assert!(result.is_err() || inside, "samples {at} {value}");
        }
        for at in [0, 1, 2, 3, 4] {
            let result = with_area(None, Some((at, value)), true);
            let good = matches!((at, value), (1 | 4, 1));
            assert!(result.is_err() || good, "commands {at} {value}");
        }
    }
    assert!(with_area(None, None, false).is_err(), "it could shrink");
}
