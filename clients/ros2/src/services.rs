//! The services: `std_srvs/Trigger` for the node and for each joint.

use std::sync::mpsc::Sender;
use std::time::Duration;

use serde_json::{Value, json};

use crate::cycle::Message;
use crate::joints::Joint;
use crate::lease::{Shared, text};
use crate::messages::TriggerResponse;

/// The longest wait for an outcome: a homing may take minutes.
const TIMEOUT: Duration = Duration::from_secs(600);
/// The time in which the cycle ends what a joint follows.
const LET_GO: Duration = Duration::from_millis(20);

/// A service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    Enable,
    Disable,
    Reset,
    Stop,
    Home,
    Mode(String),
    /// Gets the lease, also from another client.
    Take,
    /// Gives the lease back.
    Release,
}

/// A service with its name below the node, and the joint that it is for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Service {
    pub name: String,
    pub action: Action,
    pub joint: Option<usize>,
}

/// Returns the services of a machine.
#[must_use]
pub fn services(joints: &[Joint]) -> Vec<Service> {
    let mut services = Vec::new();
    let mut add = |prefix: Option<(usize, &Joint)>, name: &str, action: Action| {
        let name = match prefix {
            None => name.to_owned(),
            Some((_, joint)) => format!("{}/{name}", name_token(&joint.name)),
        };
        services.push(Service {
            name,
            action,
            joint: prefix.map(|(index, _)| index),
        });
    };
    let common = |joint| {
        [
            (joint, "enable", Action::Enable),
            (joint, "disable", Action::Disable),
            (joint, "reset", Action::Reset),
            (joint, "stop", Action::Stop),
        ]
    };
    for (joint, name, action) in common(None) {
        add(joint, name, action);
    }
    add(None, "take", Action::Take);
    add(None, "release", Action::Release);
    for joint in joints.iter().enumerate() {
        for (joint, name, action) in common(Some(joint)) {
            add(joint, name, action);
        }
        if joint.1.has_homing {
            add(Some(joint), "home", Action::Home);
        }
        for mode in &joint.1.modes {
            add(
                Some(joint),
                &format!("mode_{mode}"),
                Action::Mode(mode.clone()),
            );
        }
    }
    services
}

/// Returns a name as a part of a service's name, which has letters, digits and single `_`.
#[must_use]
pub fn name_token(name: &str) -> String {
    let plain: String = name
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
        .collect();
    let words: Vec<_> = plain.split('_').filter(|word| !word.is_empty()).collect();
    let token = words.join("_");
    match token.starts_with(|c: char| c.is_ascii_alphabetic()) {
        true => token,
        false => format!("n_{token}"),
    }
}

/// What a service needs.
#[derive(Debug, Clone)]
pub struct Worker {
    pub shared: Shared,
    pub cycle: Sender<Message>,
    /// Gets or gives back the lease.
    pub lease: Sender<LeaseRequest>,
}

/// A request to the thread that keeps the lease.
#[derive(Debug)]
pub enum LeaseRequest {
    Take(Sender<Result<(), String>>),
    Release(Sender<Result<(), String>>),
}

impl Worker {
    /// Carries out a service. Blocks until its outcome is known.
    #[must_use]
    pub fn carry_out(&self, service: &Service) -> TriggerResponse {
        let result = self.try_carry_out(service);
        TriggerResponse {
            success: result.is_ok(),
            message: result.err().unwrap_or_else(|| "done".to_owned()),
        }
    }

    fn try_carry_out(&self, service: &Service) -> Result<(), String> {
        let joint = service.joint;
        let axis = joint
            .and_then(|index| self.shared.joints.get(index))
            .map_or("*", |joint| &joint.axis);
        let stop = |hold| {
            let _ = self.cycle.send(Message::Stop { joint, hold });
        };
        let release = || {
            let _ = self.cycle.send(Message::Release(joint));
        };
        let request = |op| self.request(op, axis, json!({"axis": axis}));
        match &service.action {
            Action::Enable => {
                request("enable")?;
                release();
                Ok(())
            }
            Action::Disable => {
                stop(false);
                request("disable")
            }
            Action::Reset => request("reset"),
            Action::Stop => {
                stop(true);
                match joint {
                    None => self.request("stop", "", json!({})),
                    Some(_) => request("halt"),
                }
            }
            Action::Home => {
                stop(true);
                std::thread::sleep(LET_GO);
                let result = request("home");
                release();
                result
            }
            Action::Mode(mode) => {
                stop(false);
                std::thread::sleep(LET_GO);
                self.request("mode", axis, json!({"axis": axis, "mode": mode}))
            }
            Action::Take => self.ask_lease(LeaseRequest::Take),
            Action::Release => self.ask_lease(LeaseRequest::Release),
        }
    }

    fn request(&self, op: &str, axis: &str, keys: Value) -> Result<(), String> {
        let machine = &self.shared.machine;
        let outcome = machine.command(op, axis, keys);
        outcome
            .and_then(|request| machine.wait(request, TIMEOUT))
            .map_err(text)
    }

    fn ask_lease(
        &self,
        request: impl FnOnce(Sender<Result<(), String>>) -> LeaseRequest,
    ) -> Result<(), String> {
        let (sender, answer) = std::sync::mpsc::channel();
        let lost = |_| "the node ends".to_owned();
        self.lease
            .send(request(sender))
            .map_err(|_| "the node ends".to_owned())?;
        answer.recv_timeout(TIMEOUT).map_err(lost)?
    }
}
