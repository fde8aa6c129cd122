//! The client in Rust and its examples.

use std::time::Duration;

use ecaxis_client::layout;
use ecaxis_client::{ErrorKind, Machine, Options, SetPoint};
use ecaxis_master::config;
use ecaxis_master::rt::samples;

use crate::harness::{Server, demo};

#[path = "../../../clients/rust/examples/move.rs"]
#[allow(dead_code, reason = "`main` is for users")]
mod simple;
#[path = "../../../clients/rust/examples/sine.rs"]
#[allow(dead_code, reason = "`main` is for users")]
mod sine;
#[path = "../../../clients/rust/examples/square.rs"]
#[allow(dead_code, reason = "`main` is for users")]
mod square;

const README: &str = include_str!("../../../clients/rust/README.md");
const TIMEOUT: Duration = Duration::from_secs(30);

fn attach(server: &Server) -> Machine {
    Machine::attach(server.socket(), Options::default()).expect("the server is there")
}

fn path(server: &Server) -> String {
    server.socket().to_str().expect("a path").to_owned()
}

#[test]
fn examples_of_the_readme_are_those_that_run() {
    for text in [
        include_str!("../../../clients/rust/examples/move.rs"),
        include_str!("../../../clients/rust/examples/sine.rs"),
    ] {
        let (_attribute, code) = text.split_once("\n\n").expect("an attribute");
        assert!(README.contains(code), "README.md does not contain\n{code}");
    }
}

#[test]
fn example_moves_two_axes() {
    let server = Server::in_virtual_time(demo());
    simple::run(&path(&server)).expect("the example runs");
    let machine = attach(&server);
    assert!((machine.axis("x").unwrap().target_position - 20.0).abs() < 1e-6);
    assert!((machine.axis("y").unwrap().target_position + 10.0).abs() < 1e-6);
}

#[test]
fn example_writes_set_points_in_every_cycle() {
    let server = Server::in_real_time(demo());
    sine::run(&path(&server), 1.0).expect("the example runs");
    let machine = attach(&server);
    let state = machine.request("state", serde_json::json!({})).unwrap();
    // A computer that stands still makes sets late; none is refused.
    assert!(
        state["area"]["used"].as_u64() > Some(0),
        "{}",
        state["area"]
    );
    assert_eq!(state["area"]["refused"], serde_json::json!(0));
}

#[test]
fn example_moves_squares_and_resets_a_fault() {
    let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/square.toml");
    let script = "[[fault]]\nkind = 'drive-fault'\nat = '5s'\ndevice = 0\ncode = 0x4210\n";
    let server = Server::with_faults(config::load(&file).unwrap(), script);
    let faults = square::run(&path(&server), 4).expect("the example runs");
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert!(faults[0].starts_with("x: drive fault"), "{faults:?}");
    let machine = attach(&server);
    for name in ["x", "y"] {
        let axis = machine.axis(name).unwrap();
        assert!(
            !axis.enabled && axis.homed && axis.position.abs() < 0.05,
            "{axis:?}"
        );
    }
}

#[test]
fn errors_say_where_and_what_to_do() {
    let server = Server::in_virtual_time(demo());
    let machine = attach(&server);
    let second = Machine::attach(server.socket(), Options::default()).unwrap_err();
    assert_eq!(second.kind(), ErrorKind::NotOwner);
    let text = second.to_string();
    assert!(
        text.starts_with("take: `Rust` owns the motion (not_owner)\nhelp: "),
        "{text}"
    );
    let request = machine.move_to("x", 1.0, 1.0).unwrap();
    let error = machine.wait(request, TIMEOUT).unwrap_err();
    assert_eq!(
        (error.kind(), &*error.device, &*error.step),
        (ErrorKind::Refused, "x", "move")
    );
    assert_eq!(
        machine.move_to("x", f64::NAN, 1.0).unwrap_err().kind(),
        ErrorKind::Invalid
    );
    assert_eq!(machine.enable("z").unwrap_err().kind(), ErrorKind::Invalid);
    assert_eq!(machine.axis("z").unwrap_err().kind(), ErrorKind::Invalid);
    let sdo = serde_json::json!({"device": "x", "index": 0x5fff});
    assert_eq!(
        machine.request("sdo_read", sdo).unwrap_err().abort_code,
        Some(0x0602_0000)
    );
    machine.enable("x").unwrap();
    let request = machine.move_to("x", 1.0, 1.0).unwrap();
    machine.wait(request, TIMEOUT).unwrap();
    assert_eq!(machine.is_done(request), Ok(true));
    machine.release().unwrap();
    assert_eq!(
        machine
            .halt("x")
            .and_then(|r| machine.wait(r, TIMEOUT))
            .unwrap_err()
            .kind(),
        ErrorKind::NotOwner
    );
}

#[test]
fn a_silent_client_loses_the_lease_and_learns_it() {
    let server = Server::in_real_time(demo());
    let lease = Duration::from_millis(200);
    let options = Options {
        lease,
        ..Options::default()
    };
    let machine = Machine::attach(server.socket(), options).unwrap();
    machine.enable("x").unwrap();
    let request = machine.move_to("x", 50.0, 0.02).unwrap();
    machine.sleep(2 * lease).expect("`sleep` keeps the lease");
    assert_eq!(machine.is_done(request), Ok(false));
    std::thread::sleep(5 * lease);
    assert!(machine.wait(request, TIMEOUT).is_err());
    let ended = (0..100).find_map(|_| {
        std::thread::sleep(lease / 10);
        machine.keep().err()
    });
    assert_eq!(ended.map(|error| error.kind()), Some(ErrorKind::NotOwner));
    let axis = machine.axis("x").unwrap();
    assert!(axis.enabled && axis.position < 40.0, "{axis:?}");
}

#[test]
fn threads_share_a_machine_and_its_events_come() {
    let server = Server::in_real_time(demo());
    let machine = attach(&server);
    let mut events = machine.events().unwrap();
    let samples = machine
        .samples(&["x.position", "y.position"], TIMEOUT / 1000)
        .unwrap();
    assert_eq!(
        machine
            .samples(&["z.position"], TIMEOUT)
            .unwrap_err()
            .kind(),
        ErrorKind::Invalid
    );
    std::thread::scope(|scope| {
        for (axis, to) in [("x", 0.5), ("y", -0.5)] {
            let machine = &machine;
            scope.spawn(move || {
                machine.enable(axis).unwrap();
                let request = machine.move_to(axis, to, 0.5).unwrap();
                machine.wait(request, TIMEOUT).unwrap();
            });
        }
    });
    let ends = events.by_ref().filter(|event| event["event"] == "done");
    let axes: Vec<_> = ends
        .take(4)
        .map(|event| event["axis"].as_str().unwrap_or_default().to_owned())
        .collect();
    assert_eq!(
        axes.iter().filter(|axis| *axis == "y").count(),
        2,
        "{axes:?}"
    );
    let arrived = samples.take(1000).any(|batch| {
        let rows = batch["rows"].as_array().into_iter().flatten();
        rows.filter_map(|row| Some((row[0].as_f64()?, row[1].as_f64()?)))
            .any(|(x, y)| x > 0.4 && y < -0.4)
    });
    assert!(arrived);
    drop(server);
    // The events end with the server.
    events.for_each(drop);
    assert_eq!(machine.keep().unwrap_err().kind(), ErrorKind::Lost);
}

/// A clone of the samples goes on without the area.
#[test]
fn samples_are_read_in_another_thread() {
    let server = Server::in_real_time(demo());
    let machine = attach(&server);
    let mut samples = machine.cyclic().unwrap().samples().clone();
    let read = std::thread::spawn(move || {
        let (first, begin) = (samples.next_cycle(), samples.time_ns());
        let passed: u64 = (0..50).map(|_| samples.wait().unwrap()).sum();
        assert_eq!(samples.next_cycle() - first, passed);
        (passed, samples.time_ns() - begin)
    });
    let (cycles, ns) = read.join().unwrap();
    // The cycle follows the reference clock. A busy computer skips cycles, and no part of one.
    let due = (ns + 500_000) / 1_000_000;
    assert!(due >= cycles, "{cycles} {ns}");
    assert!(
        ns.abs_diff(due * 1_000_000) < cycles * 1_000 + 100_000,
        "{cycles} {ns}"
    );
}

/// What the server refuses stops the axis, and the client sees it.
#[test]
fn a_set_point_that_is_no_number_stops_the_axis() {
    let server = Server::in_virtual_time(demo());
    let machine = attach(&server);
    machine.enable("x").unwrap();
    let mut cyclic = machine.cyclic().unwrap();
    let axis = cyclic.axis("x").unwrap();
    let millisecond = Duration::from_millis(1);
    for cycle in 0..200 {
        cyclic.set(axis, SetPoint::Position(50e-6 * f64::from(cycle * cycle)));
        cyclic.publish();
        machine.sleep(millisecond).unwrap();
    }
    assert!(!cyclic.is_stopped(axis) && cyclic.poll() > 100 && cyclic.in_op());
    let position = cyclic.signal("x.target_position").unwrap();
    let before = cyclic.value(position);
    assert!(before > 1.5, "{before}");
    for value in [f64::NAN, 1e9, f64::INFINITY] {
        cyclic.set(axis, SetPoint::Position(value));
        cyclic.publish();
        machine.sleep(200 * millisecond).unwrap();
        assert!(cyclic.is_stopped(axis));
        assert!(machine.axis("x").unwrap().at_rest);
        cyclic.set(axis, SetPoint::None);
        cyclic.publish();
        machine.sleep(2 * millisecond).unwrap();
        assert!(!cyclic.is_stopped(axis));
    }
    assert_eq!(cyclic.counters().refused, 3);
    cyclic.poll();
    let stopped_after = cyclic.value(position) - before;
    assert!((0.0..0.5).contains(&stopped_after), "{stopped_after}");
}

/// The header of the samples is written down twice, because neither side may depend on the other.
#[test]
fn client_and_cycle_agree_on_the_samples() {
    use layout::samples as client;
    assert_eq!(
        (client::MAGIC, client::VERSION),
        (samples::MAGIC, samples::VERSION)
    );
    let of_client = [
        client::VERSION_AT,
        client::ROWS_AT,
        client::ROW_WORDS,
        client::ROWS,
        client::CYCLE_NS,
        client::WRITTEN,
        client::NEXT_NS,
        client::DESCRIPTION_AT,
        client::DESCRIPTION_BYTES,
        client::HEADER,
    ];
    let of_cycle = [
        samples::header::VERSION,
        samples::header::ROWS_AT,
        samples::header::ROW_WORDS,
        samples::header::ROWS,
        samples::header::CYCLE_NS,
        samples::header::WRITTEN,
        samples::header::NEXT_NS,
        samples::header::DESCRIPTION_AT,
        samples::header::DESCRIPTION_BYTES,
        samples::header::WORDS,
    ];
    assert_eq!(of_client, of_cycle);
    assert_eq!(samples::COUNT_COLUMNS[client::FLAGS], "flags");
    assert_eq!(samples::COUNT_COLUMNS[client::TIME_NS], "time_ns");
    let flags = (samples::flags::IN_OP, samples::flags::STOPPING);
    assert_eq!((client::IN_OP, client::STOPPING), flags);
}
