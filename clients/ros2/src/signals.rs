//! Inputs and outputs of devices without axes: a topic each, `std_msgs/Float64`.

use std::time::{Duration, Instant};

use ros2_client::Publisher;
use serde_json::Value;

use crate::messages::Float64;
use crate::services::name_token;

/// The longest time between two messages of an input that does not change.
const REPEAT: Duration = Duration::from_secs(1);

/// An input or output of the machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Signal {
    pub device: String,
    pub name: String,
    /// The topic, below the node.
    pub topic: String,
}

impl Signal {
    /// Returns the signals `inputs` or `outputs` of a machine. Those of drives belong to joints.
    #[must_use]
    pub fn of_machine(machine: &Value, kind: &str) -> Vec<Self> {
        let devices = machine["devices"].as_array().into_iter().flatten();
        let drives: Vec<_> = devices
            .filter(|device| {
                device["axes"]
                    .as_array()
                    .is_some_and(|axes| !axes.is_empty())
            })
            .filter_map(|device| device["name"].as_str())
            .collect();
        let mut signals: Vec<Self> = Vec::new();
        for signal in machine[kind].as_array().into_iter().flatten() {
            let (Some(device), Some(name)) = (signal["device"].as_str(), signal["name"].as_str())
            else {
                continue;
            };
            if drives.contains(&device) {
                continue;
            }
            let plain = format!("{kind}/{}/{}", name_token(device), name_token(name));
            let plain = plain.to_ascii_lowercase();
            let numbered = (2..).map(|number| format!("{plain}_{number}"));
            let used = |topic: &String| signals.iter().any(|signal| signal.topic == *topic);
            let mut topics = std::iter::once(plain.clone()).chain(numbered);
            let topic = topics.find(|topic| !used(topic)).unwrap_or(plain);
            signals.push(Self {
                device: device.to_owned(),
                name: name.to_owned(),
                topic,
            });
        }
        signals
    }
}

/// Publishes an input when it changes, and once a second.
#[allow(missing_debug_implementations, reason = "publishers have none")]
pub struct InputPublisher {
    pub signal: Signal,
    pub publisher: Publisher<Float64>,
    last: Option<(f64, Instant)>,
}

impl InputPublisher {
    #[must_use]
    pub fn new(signal: Signal, publisher: Publisher<Float64>) -> Self {
        Self {
            signal,
            publisher,
            last: None,
        }
    }

    /// Publishes the value in an object `state`, if there is one.
    pub fn publish(&mut self, state: &Value) {
        let inputs = state["inputs"].as_array().into_iter().flatten();
        let Signal { device, name, .. } = &self.signal;
        let mut own = inputs.filter(|input| input["device"] == **device && input["name"] == **name);
        let Some(value) = own.next().and_then(|input| input["value"].as_f64()) else {
            return;
        };
        let known = self
            .last
            .is_some_and(|(last, at)| last == value && at.elapsed() < REPEAT);
        if !known {
            self.last = Some((value, Instant::now()));
            let _ = self.publisher.publish(Float64 { data: value });
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn topics_have_valid_and_different_names() {
        let machine = json!({
            "devices": [{"name": "x", "axes": ["x"]}, {"name": "IO 1", "axes": []}],
            "inputs": [
                {"device": "x", "name": "Statusword"},
                {"device": "IO 1", "name": "Input 1"},
                {"device": "IO 1", "name": "input__1"},
                {"device": "IO 1", "name": "1"},
            ],
        });
        let topics: Vec<_> = Signal::of_machine(&machine, "inputs")
            .into_iter()
            .map(|signal| signal.topic)
            .collect();
        assert_eq!(
            topics,
            [
                "inputs/io_1/input_1",
                "inputs/io_1/input_1_2",
                "inputs/io_1/n_1"
            ]
        );
        assert!(Signal::of_machine(&machine, "outputs").is_empty());
    }
}
