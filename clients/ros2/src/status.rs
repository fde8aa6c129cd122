//! `/diagnostics`: the parts of the machine, the lease, and what each joint does about commands.

use crate::cycle::Report;
use crate::follower::{End, Refusal};
use crate::joints::Joint;
use crate::messages::{DiagnosticStatus, KeyValue, level};
use serde_json::Value;

/// The state of the node.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct NodeStatus {
    /// Why the node does not own the motion.
    pub no_lease: Option<String>,
    /// What each joint does: level and text.
    pub joints: Vec<(u8, String)>,
    /// Why the last message of commands was refused; `None`: it was not.
    pub command: Option<String>,
    /// Why the last trajectory was refused.
    pub trajectory: Option<String>,
    /// Why the last value of an output was refused.
    pub output: Option<String>,
}

impl NodeStatus {
    #[must_use]
    pub fn new(joints: usize) -> Self {
        let waits = (level::OK, "waits for commands".to_owned());
        Self {
            joints: vec![waits; joints],
            ..Self::default()
        }
    }

    /// Returns the diagnostics of the node; `name` is its name.
    #[must_use]
    pub fn diagnostics(&self, name: &str, joints: &[Joint]) -> Vec<DiagnosticStatus> {
        let status = |part: String, (level, message): (u8, String)| DiagnosticStatus {
            level,
            name: format!("{name}: {part}"),
            message,
            hardware_id: name.to_owned(),
            values: Vec::new(),
        };
        let problem = |why: &Option<String>, level| match why {
            None => (level::OK, "ok".to_owned()),
            Some(why) => (level, why.clone()),
        };
        let parts = [
            ("lease", problem(&self.no_lease, level::WARN)),
            ("commands", problem(&self.command, level::WARN)),
            ("trajectory", problem(&self.trajectory, level::WARN)),
            ("outputs", problem(&self.output, level::WARN)),
        ];
        let parts = parts
            .into_iter()
            .map(|(part, state)| status(part.to_owned(), state));
        let joints = joints.iter().zip(&self.joints);
        let joints =
            joints.map(|(joint, state)| status(format!("joint {}", joint.name), state.clone()));
        parts.chain(joints).collect()
    }
}

/// Returns level and text of what a joint does. `stale_ms` is the longest time without a command.
#[must_use]
pub fn describe(report: Report, joint: &Joint, stale_ms: f64, tolerance: f64) -> (u8, String) {
    let text = match report {
        Report::Follows => return (level::OK, "follows commands".to_owned()),
        Report::Plays => return (level::OK, "follows a trajectory".to_owned()),
        Report::Stopped { held: false } | Report::Ended(End::Silent) => {
            return (level::OK, "waits for commands".to_owned());
        }
        Report::Ended(End::Done) => return (level::OK, "the trajectory is done".to_owned()),
        Report::Stopped { held: true } => "stopped by a service: `enable` lets it go on".to_owned(),
        Report::Ended(End::Stale) => {
            format!("stopped: no command came for {stale_ms} ms while it moved")
        }
        Report::Ended(End::Disabled) => "follows no more: it is not enabled".to_owned(),
        Report::Ended(End::Blocked) => "stopped: the server follows no more".to_owned(),
        Report::Refused(refusal) => {
            format!("commands are refused: {}", why(refusal, joint, tolerance))
        }
    };
    (level::WARN, text)
}

/// Returns why a command is not followed.
fn why(refusal: Refusal, joint: &Joint, tolerance: f64) -> String {
    match refusal {
        Refusal::Disabled => "the joint is not enabled".to_owned(),
        Refusal::Held => "a service has stopped the joint; `enable` lets it go on".to_owned(),
        Refusal::Moves => "the joint moves, or its mode has changed; it begins at rest".to_owned(),
        Refusal::Far(distance) => format!(
            "the first one is {:.6} from the joint; the most is {tolerance} (--start-tolerance)",
            distance * joint.scale
        ),
        Refusal::Trajectory => "a trajectory is under way".to_owned(),
        Refusal::OtherPublisher => "another publisher commands the joint".to_owned(),
    }
}

/// Returns a diagnostic of the server.
#[must_use]
pub fn of_server(name: &str, diagnostic: &Value) -> DiagnosticStatus {
    let text = |key: &str| diagnostic[key].as_str().unwrap_or_default().to_owned();
    let level = diagnostic["level"]
        .as_u64()
        .and_then(|level| u8::try_from(level).ok());
    let values = diagnostic["values"].as_object().into_iter().flatten();
    DiagnosticStatus {
        level: level.unwrap_or(level::STALE),
        name: format!("{name}: {}", text("name")),
        message: text("message"),
        hardware_id: text("hardware_id"),
        values: values
            .map(|(key, value)| KeyValue {
                key: key.clone(),
                value: value.as_str().unwrap_or_default().to_owned(),
            })
            .collect(),
    }
}
