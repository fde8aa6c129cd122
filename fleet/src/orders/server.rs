//! The server of the machine, as orders use it.

use std::path::Path;
use std::time::{Duration, Instant};

use ecaxis_client::{Machine, Options};
use serde_json::{Value, json};

use super::digest::FileDigest;
use crate::error::{Error, Result};

/// The lease during an order. Each step renews it.
const LEASE: Duration = Duration::from_secs(5);
/// The time without a fault after which a machine is healthy.
const SETTLE: Duration = Duration::from_secs(2);
/// The time for the bus to go down.
const DOWN: Duration = Duration::from_secs(20);
const POLL: Duration = Duration::from_millis(200);
/// The time between two states that must both be without power.
const REPEAT: Duration = Duration::from_millis(100);

/// Returns an error of the server as one line.
pub fn text(error: ecaxis_client::Error) -> Error {
    let text = error.to_string();
    let (what, help) = text.split_once("\nhelp: ").unwrap_or((&text, ""));
    let error = Error::new(format!("the server: {what}"));
    if help.is_empty() {
        error
    } else {
        error.help(help)
    }
}

/// Connects under the name of the order's sender.
///
/// # Errors
/// Fails if no server answers.
pub fn connect(socket: &Path, sender: &str) -> std::result::Result<Machine, ecaxis_client::Error> {
    let options = Options {
        name: format!("fleet: {sender}"),
        lease: LEASE,
        timeout: Duration::ZERO,
        take: false,
        force: false,
    };
    Machine::attach(socket, options)
}

/// Enters a text in the change log of the machine. Returns false if no server answers.
pub fn note(socket: &Path, sender: &str, text: &str) -> bool {
    let text: String = text.chars().take(2000).collect();
    let noted = connect(socket, sender).and_then(|m| m.request("note", json!({"text": text})));
    noted.is_ok()
}

/// Takes the lease and requires that nothing moves. With the lease, no other client can enable an
/// axis.
///
/// # Errors
/// Fails if another client owns the motion, an axis has power or moves, or the program runs.
pub fn take_disabled(machine: &Machine) -> Result<()> {
    machine.take(false).map_err(text)?;
    let state = machine.request("state", json!({})).map_err(text)?;
    require_disabled(&state)?;
    // An `enable` of the owner before may still be under way.
    machine.sleep(REPEAT).map_err(text)?;
    let state = machine.request("state", json!({})).map_err(text)?;
    require_disabled(&state)
}

fn require_disabled(state: &Value) -> Result<()> {
    let disable = "disable all axes, then send the order again";
    for axis in state["axes"].as_array().into_iter().flatten() {
        let name = axis["name"].as_str().unwrap_or("?");
        if axis["at_rest"] == json!(false) || axis["moving"] == json!(true) {
            return Err(Error::new(format!("the axis `{name}` moves")).help(disable));
        }
        if axis["enabled"] == json!(true) {
            return Err(Error::new(format!("the axis `{name}` is enabled")).help(disable));
        }
    }
    match state["program"]["running"] == json!(true) {
        true => Err(Error::new("the program runs").help("stop it, then send the order again")),
        false => Ok(()),
    }
}

/// Brings the bus down and waits until the interface is free. Returns false if it was down. If it
/// does not go down, it is to come up again.
///
/// # Errors
/// Fails if the server refuses it.
pub fn bus_down(machine: &Machine) -> Result<bool> {
    let state = machine.request("state", json!({})).map_err(text)?;
    machine
        .request("bus", json!({"action": "down"}))
        .map_err(text)?;
    let begin = Instant::now();
    loop {
        let now = machine.request("state", json!({})).map_err(text)?;
        // A bus that had failed stays so: the server does not use the interface either.
        if now["bus"]["state"] == json!("down") || now["bus"]["state"] == json!("failed") {
            return Ok(state["bus"]["state"] != json!("down"));
        }
        if begin.elapsed() > DOWN {
            bus_up(machine)?;
            return Err(Error::new("the server does not bring the bus down"));
        }
        std::thread::sleep(POLL);
    }
}

/// Brings the bus up.
///
/// # Errors
/// Fails if the server refuses it.
pub fn bus_up(machine: &Machine) -> Result<()> {
    let up = machine.request("bus", json!({"action": "up"}));
    up.map_err(text).map(drop)
}

/// Waits until the server runs this machine in Op, without a fault for [`SETTLE`]. `leased` has the
/// lease; without it, another connection takes it, and stays there.
///
/// # Errors
/// Fails with the last reason when the time is over.
pub fn await_health(
    leased: &mut Option<Machine>,
    socket: &Path,
    sender: &str,
    sha256: Option<FileDigest>,
    timeout: Duration,
) -> Result<()> {
    let begin = Instant::now();
    let mut healthy: Option<Instant> = None;
    loop {
        let observed = match &*leased {
            Some(machine) => machine
                .keep()
                .map_err(text)
                .and_then(|()| health(machine, sha256)),
            None => connect_and_take(socket, sender)
                .and_then(|machine| health(leased.insert(machine), sha256)),
        };
        match observed {
            Ok(()) if healthy.get_or_insert_with(Instant::now).elapsed() >= SETTLE => return Ok(()),
            Ok(()) => {}
            Err(error) => {
                healthy = None;
                // The lease stays while the server answers: no other client enables an axis.
                *leased = leased.take().filter(|machine| machine.keep().is_ok());
                if begin.elapsed() > timeout {
                    let what = error.to_string();
                    let what = what.split("\nhelp:").next().unwrap_or_default();
                    let seconds = timeout.as_secs();
                    return Err(Error::new(format!("not healthy after {seconds} s: {what}")));
                }
            }
        }
        std::thread::sleep(POLL);
    }
}

/// Connects and takes the lease.
///
/// # Errors
/// Fails if the server is absent, or another client owns the motion.
pub fn connect_and_take(socket: &Path, sender: &str) -> Result<Machine> {
    let machine = connect(socket, sender).map_err(text)?;
    machine.take(false).map_err(text)?;
    Ok(machine)
}

fn health(machine: &Machine, sha256: Option<FileDigest>) -> Result<()> {
    if let Some(expected) = sha256 {
        let described = machine.request("machine", json!({})).map_err(text)?;
        if described["sha256"] != json!(expected) {
            return Err(Error::new("the server runs another machine file"));
        }
    }
    let state = machine.request("state", json!({})).map_err(text)?;
    let bus = state["bus"]["state"].as_str().unwrap_or("unknown");
    if bus != "op" {
        let why = state["bus"]["error"].as_str().unwrap_or("");
        return Err(Error::new(format!("the bus is `{bus}`: {why}")));
    }
    let axes = state["axes"].as_array().into_iter().flatten();
    let mut faults = axes.filter_map(|axis| {
        let why = axis["fault"].as_str().or(axis["trip"].as_str())?;
        Some(format!("axis `{}`: {why}", axis["name"].as_str()?))
    });
    match faults.next() {
        Some(fault) => Err(Error::new(fault)),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_in_motion_is_refused() {
        let axis = |enabled, at_rest| {
            json!({"axes": [{"name": "x", "enabled": false, "at_rest": true, "moving": false},
                {"name": "y", "enabled": enabled, "at_rest": at_rest, "moving": false}],
                "program": {"running": false}})
        };
        assert!(require_disabled(&axis(false, true)).is_ok());
        let moves = require_disabled(&axis(false, false))
            .unwrap_err()
            .to_string();
        assert!(moves.contains("`y` moves"), "{moves}");
        let enabled = require_disabled(&axis(true, true)).unwrap_err().to_string();
        assert!(enabled.contains("`y` is enabled"), "{enabled}");
        let program = json!({"axes": [], "program": {"running": true}});
        assert!(require_disabled(&program).is_err());
        // The bus is down: no axis has a state.
        let down = json!({"axes": [{"name": "x", "state": "unknown", "enabled": null}]});
        assert!(require_disabled(&down).is_ok());
    }
}
