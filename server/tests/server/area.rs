//! Set-points in shared memory, from a client that knows docs/server.md only.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::harness::{Client, Server, demo};
use crate::memory::{Area, Words, attach};

/// The position of a sine of 5 mm and 1 Hz, from rest.
fn sine(t: f64) -> f64 {
    5.0 * (1.0 - (std::f64::consts::TAU * t).cos())
}

/// Runs the sine from `*cycle` on, for `cycles`, in virtual time.
fn follow(client: &mut Client, area: &Area, cycle: &mut u64, cycles: u64) {
    for _ in 0..cycles {
        *cycle += 1;
        area.write(*cycle, &[(1, sine(*cycle as f64 * 1e-3)), (0, 0.0)]);
        client.ok("advance", json!({"cycles": 1}));
    }
}

#[test]
fn an_axis_follows_the_area_exactly() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    let area = attach(&mut client);
    let word = |words: &Words, at: usize| words.get(at).to_ne_bytes();
    assert_eq!(&word(&area.samples, 0), b"ECAXSMPL");
    assert_eq!(&word(&area.commands, 0), b"ECAXCMDS");
    assert_eq!((area.commands.get(1), area.commands.get(4)), (1, 2));
    let mut cycle = 0;
    follow(&mut client, &area, &mut cycle, 500);
    assert!((client.position("x") - sine(0.5)).abs() < 0.2);
    assert_eq!(area.commands.get(8), 500);
    assert!(area.used() >= 499);
    assert_eq!(area.commands.get(11), 0, "nothing was refused");
    // Kind 0 ends it: the axis decelerates and holds.
    area.write(cycle + 1, &[(0, 0.0), (0, 0.0)]);
    client.advance(1.0);
    assert_eq!(client.axis("x")["at_rest"], json!(true));
    assert_eq!(client.kept_events("area"), Vec::<Value>::new());
}

#[test]
fn stale_set_points_stop_the_axis() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    let area = attach(&mut client);
    let mut cycle = 0;
    follow(&mut client, &area, &mut cycle, 250);
    client.advance(1.0);
    let axis = client.axis("x");
    assert_eq!(axis["at_rest"], json!(true));
    assert_eq!(axis["enabled"], json!(true));
    let events = client.kept_events("area");
    assert_eq!(events.len(), 1, "{events:?}");
    assert_eq!(
        (&events[0]["axis"], &events[0]["owner"]["name"]),
        (&json!("x"), &json!("test"))
    );
    // It follows again only from kind 0 on.
    let at = client.position("x");
    area.write(1000, &[(1, at), (0, 0.0)]);
    client.advance(0.01);
    assert_eq!(area.commands.get(12), 1);
    area.write(1001, &[(0, 0.0), (0, 0.0)]);
    client.advance(0.002);
    area.write(1002, &[(1, at), (0, 0.0)]);
    client.advance(0.002);
    assert_eq!(area.commands.get(12), 0);
}

#[test]
fn late_set_points_are_bridged() {
    let server = Server::in_virtual_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    let area = attach(&mut client);
    let mut cycle = 0;
    for _ in 0..40 {
        follow(&mut client, &area, &mut cycle, 20);
        // Five cycles without a set; the client's time goes on.
        client.ok("advance", json!({"cycles": 5}));
        cycle += 5;
    }
    assert_eq!(client.kept_events("area"), Vec::<Value>::new());
    assert_eq!(area.commands.get(11), 0);
    follow(&mut client, &area, &mut cycle, 100);
    let error = client.position("x") - sine(cycle as f64 * 1e-3);
    assert!(error.abs() < 0.1, "{error}");
}

#[test]
fn an_axis_stops_within_its_range_whatever_the_client_does() {
    // The client is gone shortly before the end of the range at 60 mm, or goes on beyond it.
    for gone_at in [59.9, 59.97, 61.0] {
        let server = Server::in_virtual_time(demo());
        let mut client = server.owner("test");
        client.done("enable", json!({"axis": "x"}));
        client.done("move", json!({"axis": "x", "to": 59.0}));
        let area = attach(&mut client);
        let (mut at, mut velocity, mut cycle) = (client.position("x"), 0.0, 0);
        let mut farthest: f64 = 0.0;
        for _ in 0..400 {
            if at < gone_at {
                velocity = f64::min(velocity + 1.0, 12.0);
                at += velocity * 1e-3;
                cycle += 1;
                area.write(cycle, &[(1, at), (0, 0.0)]);
            }
            client.ok("advance", json!({"cycles": 1}));
            farthest = farthest.max(client.position("x"));
        }
        assert!((59.9..=60.0).contains(&farthest), "{gone_at}: {farthest}");
        assert_eq!(client.axis("x")["at_rest"], json!(true));
        assert_eq!(client.kept_events("area").len(), 1, "{gone_at}");
    }
}

#[test]
fn nothing_in_the_area_is_trusted() {
    let server = Server::in_virtual_time(demo());
    for (kind, value, text) in [
        (1, f64::NAN, "finite"),
        (1, f64::INFINITY, "finite"),
        (1, 30.0, "step"),
        (1, -1e300, "step"),
        (2, 1e6, "velocity"),
        (3, 10.0, "CST"),
        (77, 0.0, "77"),
    ] {
        let mut client = server.owner("test");
        client.done("enable", json!({"axis": "x"}));
        let area = attach(&mut client);
        area.write(1, &[(1, client.position("x")), (0, 0.0)]);
        client.advance(0.003);
        let before = client.position("x");
        area.write(2, &[(0, 0.0), (0, 0.0)]);
        client.advance(0.003);
        area.write(3, &[(kind, value), (0, 0.0)]);
        client.advance(0.5);
        assert_eq!(client.position("x"), before, "kind {kind}, {value}");
        let event = client.kept_events("area").last().unwrap().clone();
        let why = event["why"].as_str().unwrap();
        assert!(
            why.to_lowercase().contains(&text.to_lowercase()),
            "{kind} {value}: {why}"
        );
        client.ok("release", json!({}));
    }
}

#[test]
fn the_area_of_a_former_owner_has_no_effect() {
    let server = Server::in_virtual_time(demo());
    let mut first = server.owner("first");
    first.done("enable", json!({"axis": "x"}));
    let old = attach(&mut first);
    let mut cycle = 0;
    follow(&mut first, &old, &mut cycle, 100);
    let mut second = server.client();
    second.ok("take", json!({"force": true}));
    second.advance(1.0);
    let at = second.position("x");
    old.write(5000, &[(0, 0.0), (0, 0.0)]);
    second.advance(0.01);
    old.write(5001, &[(2, 5.0), (0, 0.0)]);
    second.advance(0.5);
    assert_eq!(second.position("x"), at);
    let new = attach(&mut second);
    new.write(1, &[(2, 5.0), (0, 0.0)]);
    second.advance(0.005);
    assert!(second.position("x") > at);
    let error = first.refused("area", json!({}));
    assert_eq!(error["code"], json!("not_owner"));
}

/// In real time, a client that reads the samples answers each cycle before the next.
#[test]
fn a_real_time_client_misses_few_cycles() {
    let server = Server::in_real_time(demo());
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    let area = attach(&mut client);
    let (mut row, start) = (area.samples.get(6), Instant::now());
    let mut cycle = 0;
    while start.elapsed() < Duration::from_secs(2) {
        let now = area.samples.get(6);
        if now == row {
            std::thread::sleep(Duration::from_micros(200));
            continue;
        }
        row = now;
        cycle += 1;
        area.write(cycle, &[(1, client_sine(cycle)), (0, 0.0)]);
    }
    // How many are late depends on the computer; that they are used does not.
    assert!(area.used() > 0 && area.used() <= cycle);
    // A computer that stands still makes sets late; nothing else may stop the axis.
    for event in client.kept_events("area") {
        let why = event["why"].as_str().unwrap();
        assert!(why.starts_with("no new set-point"), "{event}");
    }
}

/// Slow enough that a stall of many cycles stays within the limits.
fn client_sine(cycle: u64) -> f64 {
    0.5 * (1.0 - (std::f64::consts::TAU * cycle as f64 * 1e-3).cos())
}

/// A motion that is refused must not leave the axis at the velocity of the area.
#[test]
fn a_refused_motion_ends_the_velocity_of_the_area() {
    let server = Server::in_virtual_time(demo());
    for (op, keys) in [
        ("move", json!({"axis": "x", "to": 1, "speed": 2})),
        ("move", json!({"axis": "x", "to": 1000})),
        ("home", json!({"axis": "x"})),
        ("velocity", json!({"axis": "x", "velocity": 1e9})),
        ("jog", json!({"axis": "x", "velocity": 1e9})),
        ("program", json!({"action": "pause"})),
    ] {
        let mut client = server.owner("test");
        client.done("enable", json!({"axis": "*"}));
        client.done("move", json!({"axis": "x", "to": -50.0}));
        let area = attach(&mut client);
        let mut counter = 0;
        let mut write = |client: &mut Client| {
            for _ in 0..100 {
                counter += 1;
                area.write(counter, &[(2, 5.0), (0, 0.0)]);
                client.ok("advance", json!({"cycles": 5}));
            }
        };
        write(&mut client);
        assert_eq!(client.axis("x")["target_velocity"], json!(5.0));
        client.ask(op, keys.clone());
        // The client goes on as if nothing had happened.
        write(&mut client);
        let velocity = client.axis("x")["target_velocity"].as_f64().unwrap();
        let expected = if op == "program" { 5.0 } else { 0.0 };
        assert_eq!(velocity, expected, "{op} {keys}");
        client.ok("release", json!({}));
        client.advance(0.5);
        assert_eq!(client.axis("x")["at_rest"], json!(true), "{op} {keys}");
    }
}

/// An axis that is enabled again follows from kind 0 on only, also if the client has written
/// set-points all the time.
#[test]
fn an_axis_that_is_enabled_again_does_not_follow_at_once() {
    for (kind, speed) in [(1, 0.002), (2, 0.001)] {
        let server = Server::in_virtual_time(demo());
        let mut client = server.owner("test");
        client.done("enable", json!({"axis": "x"}));
        let area = attach(&mut client);
        let (mut counter, mut step) = (0, 0);
        let mut write = |client: &mut Client, cycles: u64, more: u64| {
            for _ in 0..cycles {
                (counter, step) = (counter + 1, step + more);
                area.write(counter, &[(kind, speed * step as f64), (0, 0.0)]);
                client.ok("advance", json!({"cycles": 1}));
            }
        };
        write(&mut client, 100, 1);
        assert_ne!(client.axis("x")["target_velocity"], json!(0.0));
        client.ok("disable", json!({"axis": "*"}));
        write(&mut client, 500, 0);
        assert_eq!(client.axis("x")["enabled"], json!(false));
        client.ok("enable", json!({"axis": "x"}));
        write(&mut client, 500, 0);
        let axis = client.axis("x");
        assert_eq!(axis["ready"], json!(true), "{axis}");
        let at = client.position("x");
        write(&mut client, 100, 1);
        assert_eq!(client.position("x"), at);
        area.write(counter + 1, &[(0, 0.0), (0, 0.0)]);
        client.ok("advance", json!({"cycles": 2}));
        area.write(counter + 2, &[(2, 1.0), (0, 0.0)]);
        client.advance(0.008);
        assert_eq!(client.axis("x")["target_velocity"], json!(1.0));
    }
}

/// The same after a fault of the drive, which no command of a client precedes.
#[test]
fn an_axis_that_is_reset_does_not_follow_at_once() {
    let script = "[[fault]]\nkind = 'drive-fault'\nat = '2s'\ndevice = 0\ncode = 0x3210\n";
    let server = Server::with_faults(demo(), script);
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "x"}));
    let area = attach(&mut client);
    let mut counter = 0;
    let mut write = |client: &mut Client, cycles: u64, velocity: f64| {
        for _ in 0..cycles {
            counter += 1;
            area.write(counter, &[(2, velocity), (0, 0.0)]);
            client.ok("advance", json!({"cycles": 1}));
        }
    };
    write(&mut client, 2_000, 1.0);
    assert_ne!(client.axis("x")["fault"], json!(null));
    client.ok("reset", json!({"axis": "x"}));
    write(&mut client, 500, 1.0);
    client.ok("enable", json!({"axis": "x"}));
    write(&mut client, 500, 1.0);
    let axis = client.axis("x");
    assert_eq!(
        (&axis["ready"], &axis["fault"]),
        (&json!(true), &json!(null))
    );
    let at = client.position("x");
    write(&mut client, 100, 2.0);
    assert_eq!(client.position("x"), at);
    assert!(client.kept_events("area").len() == 1);
}
