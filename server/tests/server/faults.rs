//! The server stays when the bus or a drive fails, says so, and takes commands again.

use serde_json::{Value, json};

use crate::harness::{Client, Server, demo};

fn states(client: &mut Client) -> Vec<Value> {
    let events = client.kept_events("bus");
    events.iter().map(|event| event["state"].clone()).collect()
}

#[test]
fn a_drive_fault_is_reported_and_reset() {
    let script = "[[fault]]\nkind = 'drive-fault'\nat = '2s'\ndevice = 0\ncode = 0x3210\n";
    let server = Server::with_faults(demo(), script);
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "*"}));
    client.ok("velocity", json!({"axis": "x", "velocity": 5}));
    client.advance(2.0);
    let fault = client.kept_events("fault");
    assert_eq!(fault[0]["axis"], json!("x"));
    // The code is read after the fault.
    let last = fault.last().unwrap()["why"].as_str().unwrap();
    assert!(last.contains("0x3210"), "{fault:?}");
    assert_eq!(client.kept_events("group_stopped").len(), 1);
    // The other axis has stopped with it, within its limits.
    let other = client.axis("y");
    assert_eq!(other["at_rest"], json!(true));
    assert!(
        other["stopped"].as_str().unwrap().contains("`x`"),
        "{other}"
    );
    let error = client.refused("move", json!({"axis": "y", "to": 1, "wait": true}));
    assert!(
        ["refused", "failed"].contains(&error["code"].as_str().unwrap()),
        "{error}"
    );
    client.done("reset", json!({"axis": "x"}));
    client.done("enable", json!({"axis": "*"}));
    client.done("move", json!({"axis": "x", "to": 1.0}));
    assert_eq!(client.kept_events("group_released").len(), 1);
}

/// The refusal of the stop counted for the reset that followed it.
#[test]
fn a_reset_that_follows_a_stop_is_not_refused() {
    let script = "[[fault]]\nkind = 'drive-fault'\nat = '2s'\ndevice = 0\ncode = 0x3210\n";
    let server = Server::with_faults(demo(), script);
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "*"}));
    let slow = |axis: &str| json!({"axis": axis, "to": 50, "speed": 0.01, "wait": true});
    let (first, second) = (
        client.send("move", slow("x")),
        client.send("move", slow("y")),
    );
    assert_eq!(client.answer(first)["ok"], json!(false));
    assert_eq!(client.answer(second)["ok"], json!(false));
    client.ok("stop", json!({}));
    client.done("reset", json!({"axis": "*"}));
    client.done("enable", json!({"axis": "*"}));
}

#[test]
fn a_cable_that_breaks_and_returns_needs_no_person() {
    let script = "[[fault]]\nkind = 'silent'\nat = '2s'\nfor = '3s'\n";
    let server = Server::with_faults(demo(), script);
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "*"}));
    client.ok("velocity", json!({"axis": "x", "velocity": 5}));
    let id = client.send("advance", json!({"seconds": 10.0}));
    let answer = client.answer(id);
    assert_eq!(answer["error"]["code"], json!("not_up"), "{answer}");
    client.ok("await", json!({"bus": "op"}));
    let states = states(&mut client);
    let failed = states.iter().position(|state| *state == json!("failed"));
    assert!(
        failed.is_some() && states.last() == Some(&json!("op")),
        "{states:?}"
    );
    let bus = client.kept_events("bus");
    let failure = bus
        .iter()
        .find(|event| event["state"] == json!("failed"))
        .unwrap();
    assert_eq!(failure["retry_s"], json!(1.0));
    // Nothing has power until a client says so.
    client.advance(0.1);
    assert_eq!(client.axis("x")["enabled"], json!(false));
    client.done("enable", json!({"axis": "*"}));
    let at = client.position("x");
    client.done("move", json!({"axis": "x", "by": 1.0}));
    assert_eq!(client.position("x"), at + 1.0);
    let reports = client.ok("fault_reports", json!({}))["reports"].clone();
    let headline = reports[0]["report"]["headline"].as_str().unwrap();
    assert!(headline.contains("cable"), "{headline}");
    // Clients that ask for all of them, and read no answer, do not delay a move.
    let mut hoarders: Vec<Client> = (0..20).map(|_| Client::new(&server.socket())).collect();
    for hoarder in &mut hoarders {
        for _ in 0..50 {
            hoarder.send("fault_reports", json!({}));
        }
    }
    client.done("move", json!({"axis": "x", "by": 1.0}));
    assert_eq!(client.position("x"), at + 2.0);
}

#[test]
fn a_device_that_is_missing_is_named() {
    let script = "[[fault]]\nkind = 'absent'\ndevice = 1\n";
    let server = Server::with_faults(demo(), script);
    let mut client = Client::new(&server.socket());
    client.ok("await", json!({"bus": "failed"}));
    let state = client.ok("state", json!({}))["bus"].clone();
    assert!(state["error"].as_str().unwrap().contains("`y`"), "{state}");
    let error = client.refused("await", json!({"bus": "op", "timeout_ms": 10}));
    assert!(
        error["message"].as_str().unwrap().contains("`y`"),
        "{error}"
    );
    let error = client.refused("sdo_read", json!({"device": "x", "index": 0x6061}));
    assert_eq!(error["code"], json!("not_up"));
}

#[test]
fn each_device_names_the_port_that_leads_to_it() {
    let server = Server::in_virtual_time(demo());
    let mut client = Client::new(&server.socket());
    client.ok("await", json!({"bus": "op"}));
    // The registers are read one after another, and the state is published a little later.
    let mut devices = json!(null);
    for _ in 0..100 {
        client.advance(0.1);
        devices = client.ok("state", json!({}))["devices"].clone();
        if [0, 1]
            .iter()
            .all(|n| devices[n]["ports"][0]["open"] != json!(null))
        {
            break;
        }
    }
    assert_eq!(devices[0]["parent"], json!(null));
    assert_eq!(devices[1]["parent"], json!({"device": "x", "port": 1}));
    assert_eq!(devices[1]["position"], json!(1));
    let open = |device: &Value| {
        let ports = device["ports"].as_array().unwrap().clone();
        ports
            .iter()
            .map(|port| port["open"].clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(
        open(&devices[0]),
        [true, true, false, false].map(Value::from)
    );
    assert_eq!(
        open(&devices[1]),
        [true, false, false, false].map(Value::from)
    );
}

/// The state shows a ring that breaks and is repaired; no axis notices.
#[test]
fn a_broken_ring_is_part_of_the_state() {
    let script = "[[fault]]\nkind = 'link-break'\nat = '2s'\nfor = '3s'\ndevice = 1\nport = 0\n";
    let mut machine = demo();
    machine.bus.redundant = Some("second".to_owned());
    let server = Server::with_faults(machine, script);
    let mut client = server.owner("test");
    client.done("enable", json!({"axis": "*"}));
    let mut ring = |seconds: f64| {
        client.advance(seconds);
        let state = client.ask("state", json!({}));
        state["bus"]["ring"].clone()
    };
    let expected = |state: &str, behind: Value, breaks: u32| json!({"state": state, "behind": behind, "breaks": breaks, "links": {}});
    assert_eq!(ring(0.5), expected("closed", Value::Null, 0));
    assert_eq!(ring(3.0), expected("broken", json!(1), 1));
    assert_eq!(ring(5.0), expected("closed", Value::Null, 1));
    let events = client.kept_events("ring");
    let broken: Vec<_> = events.iter().map(|event| &event["broken"]).collect();
    assert_eq!(broken, [&json!(true), &json!(false)]);
}
