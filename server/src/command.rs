//! The operations of the protocol, as clients write them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::error::{ErrorCode, OpError};
use crate::hub::BusState;
use crate::strict;

/// A request of a client: one JSON object.
#[derive(Debug)]
pub struct Request {
    /// Repeated in the answer.
    pub id: Option<Value>,
    /// `true`: the answer comes with the outcome.
    pub wait: Option<bool>,
    /// The secret of the lease. Over HTTP, commands that need the lease need it.
    pub lease: Option<String>,
    pub op: Result<Op, OpError>,
}

/// One operation with its keys.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
pub enum Op {
    /// Names the client and returns the version of server and protocol.
    Hello { name: Option<String> },
    /// Allows commands on this WebSocket connection.
    Token { token: String },
    /// Returns the machine: axes, devices, signals, steps.
    Machine {},
    /// Returns the state of the bus, the axes and the devices.
    State {},
    /// Returns the events with a number above `after`.
    Events {
        #[serde(default)]
        after: u64,
    },
    /// Returns the last 20 fault reports.
    FaultReports {},
    /// Returns the state of bus, devices and axes with a level each, as ROS diagnostics.
    Diagnostics {},
    /// Subscribes to topics.
    Subscribe {
        topics: Vec<Topic>,
        /// The period of state and samples, 10 to 10,000; that of set-points, 1 to 1,000.
        #[serde(default = "interval")]
        interval_ms: u64,
        /// The axis of the set-points.
        axis: Option<String>,
        /// The signals of the samples; all without this key.
        signals: Option<Vec<String>>,
    },
    /// Ends subscriptions.
    Unsubscribe { topics: Vec<Topic> },
    /// Waits until the bus is in a state.
    Await {
        bus: BusState,
        #[serde(default = "await_timeout")]
        timeout_ms: u64,
    },
    /// Reads an object of a device over CoE.
    SdoRead {
        device: String,
        index: Index,
        #[serde(default)]
        sub: u8,
        #[serde(default)]
        complete: bool,
    },
    /// Enters a text in the change log, at most 2000 characters. Needs no lease.
    Note {
        #[schemars(length(max = 2000))]
        text: String,
    },
    /// Gets the lease: the client owns the motion.
    Take {
        name: Option<String>,
        /// The longest silence of the owner, 100 to 60,000.
        ttl_ms: Option<u64>,
        #[serde(default)]
        force: bool,
    },
    /// Renews the lease.
    Renew {},
    /// Gives the lease back. What the client moved stops.
    Release {},
    /// Takes an axis, or `*` for all, to Operation enabled.
    Enable { axis: String },
    /// Decelerates, then removes power.
    Disable { axis: String },
    /// Moves to a position, or by a distance.
    Move {
        axis: String,
        to: Option<f64>,
        by: Option<f64>,
        /// A fraction of the velocity limit, above 0 and at most 1.
        #[serde(default = "one")]
        speed: f64,
    },
    /// Moves at a velocity until the next command.
    Velocity { axis: String, velocity: f64 },
    /// Moves at a velocity for 300 ms.
    Jog {
        axis: String,
        velocity: f64,
        /// The time of the newest state that the client has seen. A jog from a state older than
        /// 500 ms is refused: it may have waited in the network.
        seen_ns: Option<u64>,
    },
    /// Applies a torque in percent of the rated torque, in CST.
    Torque {
        axis: String,
        torque: f64,
        #[serde(default)]
        ramp_s: f64,
    },
    /// Homes an axis as the machine file says.
    Home { axis: String },
    /// Switches the mode of operation.
    Mode { axis: String, mode: String },
    /// Decelerates and holds.
    Halt { axis: String },
    /// Triggers the quick stop of the drive (0x605A).
    QuickStop { axis: String },
    /// Resets faults and trips.
    Reset { axis: String },
    /// Stops all axes, the program and all streams. Needs no lease.
    Stop {},
    /// Stops all axes and removes power as fast as possible. Needs no lease.
    EmergencyStop {},
    /// Sets an output that no axis writes.
    Output {
        device: String,
        output: String,
        value: f64,
    },
    /// Commands the NMT state of a node behind a gateway. Refused while its axis has power.
    Node {
        device: String,
        /// The node-ID.
        node: u8,
        action: NodeAction,
    },
    /// Switches an input of the simulated bus: a name of `[signals]`, or `io.Input 1`. Needs no
    /// lease.
    SimInput { input: String, value: f64 },
    /// Scales the speed of all motions, of the machine or of a group.
    Override {
        /// From 0 to 1.2.
        factor: f64,
        group: Option<String>,
    },
    /// Holds all motions on their way, of the machine or of a group. Needs no lease.
    Hold { group: Option<String> },
    /// Lets held motions continue.
    Resume { group: Option<String> },
    /// Starts or ends the program of the machine file.
    Program {
        action: ProgramAction,
        /// With `start`: the instant of common time, in ns since 1970, at most 1 h ahead.
        at_unix_ns: Option<u64>,
    },
    /// Writes an object of a device over CoE.
    SdoWrite {
        device: String,
        index: Index,
        #[serde(default)]
        sub: u8,
        /// Bytes in hex.
        data: Option<String>,
        /// A number or a text, in the type of the dictionary.
        value: Option<Value>,
        #[serde(default)]
        complete: bool,
    },
    /// Brings the bus up, or down to Init.
    Bus { action: BusAction },
    /// Starts a stream of points.
    StreamOpen {
        axis: String,
        /// The time between two points, at least one cycle.
        interval_ms: f64,
        #[serde(default)]
        interpolation: InterpolationName,
        /// The number of points that start the motion.
        #[serde(default = "prefill")]
        prefill: usize,
    },
    /// Adds points to a stream: `[position]`, `[position, velocity]` or `[position, velocity,
    /// torque]`.
    StreamPush { axis: String, points: Vec<Point> },
    /// Ends a stream: the axis stands at the last point.
    StreamClose { axis: String },
    /// Passes the memory for set-points in real time, on the socket only.
    Area {},
    /// Feeds a line shaft with set-points of an axis of another machine. Needs no lease.
    LineShaft {
        name: String,
        /// The stream of the event `setpoints`.
        stream: String,
        #[schemars(length(max = 64))]
        points: Vec<SetpointPoint>,
    },
    /// Lets virtual time advance.
    Advance {
        cycles: Option<u64>,
        seconds: Option<f64>,
    },
}

fn interval() -> u64 {
    100
}

fn await_timeout() -> u64 {
    60_000
}

fn one() -> f64 {
    1.0
}

fn prefill() -> usize {
    8
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Topic {
    Events,
    State,
    Samples,
    Setpoints,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ProgramAction {
    Start,
    Pause,
    Resume,
    Step,
    Stop,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum NodeAction {
    Start,
    Stop,
    PreOperational,
    Reset,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum BusAction {
    Up,
    Down,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum InterpolationName {
    #[default]
    Cubic,
    Linear,
}

/// A point of a stream: a position, the velocity there, and the torque feed-forward in percent.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(untagged)]
pub enum Point {
    Position([f64; 1]),
    WithVelocity([f64; 2]),
    WithTorque([f64; 3]),
}

/// A set-point of an axis for other machines, in units of the axis.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SetpointPoint {
    /// The instant in ns of common time at which it takes effect.
    pub unix_ns: u64,
    pub position: f64,
    pub velocity: f64,
    pub acceleration: f64,
}

/// The index of an object: a number, or a text such as `"0x6061"`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(untagged)]
pub enum Index {
    Number(u16),
    Text(String),
}

impl Index {
    /// Returns the number.
    ///
    /// # Errors
    /// Fails if the text is not a number.
    pub fn number(&self) -> Result<u16, OpError> {
        match self {
            Self::Number(number) => Ok(*number),
            Self::Text(text) => {
                let hex = text.strip_prefix("0x").or(text.strip_prefix("0X"));
                let number = hex.map_or_else(|| text.parse(), |hex| u16::from_str_radix(hex, 16));
                number.map_err(|_| {
                    let message = format!("`index`: \"{text}\" is not an index");
                    OpError::new(ErrorCode::BadRequest, message).help("write 24673 or \"0x6061\"")
                })
            }
        }
    }
}

/// What an operation needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    Read,
    /// The right to command.
    Command,
    /// The right to command, and the lease.
    Lease,
}

impl Op {
    /// Returns what the operation needs.
    #[must_use]
    pub fn access(&self) -> Access {
        match self {
            Self::Hello { .. }
            | Self::Token { .. }
            | Self::Machine {}
            | Self::State {}
            | Self::Events { .. }
            | Self::FaultReports {}
            | Self::Diagnostics {}
            | Self::Subscribe { .. }
            | Self::Unsubscribe { .. }
            | Self::Await { .. } => Access::Read,
            Self::Stop {}
            | Self::EmergencyStop {}
            | Self::Hold { .. }
            | Self::Note { .. }
            | Self::Take { .. }
            | Self::Renew {}
            | Self::Release {}
            | Self::SdoRead { .. }
            | Self::SimInput { .. }
            | Self::LineShaft { .. }
            | Self::Advance { .. } => Access::Command,
            Self::Disable { axis } if axis == ALL => Access::Command,
            _ => Access::Lease,
        }
    }
}

impl Op {
    /// True if the change log contains the operation: not those that repeat many times a second.
    #[must_use]
    pub fn is_change(&self) -> bool {
        self.access() != Access::Read
            && !matches!(
                self,
                Self::Renew {}
                    | Self::SdoRead { .. }
                    | Self::Advance { .. }
                    | Self::StreamPush { .. }
                    | Self::LineShaft { .. }
            )
    }
}

/// Means all axes.
pub const ALL: &str = "*";

impl Request {
    /// Reads a request from a text of a client.
    #[must_use]
    pub fn parse(text: &[u8]) -> Self {
        match strict::from_slice(text) {
            Ok(Value::Object(map)) => Self::from_object(map),
            Ok(_) => Self::invalid("a request is a JSON object"),
            Err(error) => Self::invalid(format!("not JSON: {error}")),
        }
    }

    fn invalid(message: impl Into<String>) -> Self {
        let error = OpError::new(ErrorCode::BadRequest, message);
        Self {
            id: None,
            wait: None,
            lease: None,
            op: Err(error.help("write one object per line, such as {\"op\": \"state\"}")),
        }
    }

    /// Reads a request from an object.
    #[must_use]
    pub fn from_object(mut map: Map<String, Value>) -> Self {
        let id = map.remove("id");
        let wait = map.remove("wait");
        let flag = wait.as_ref().and_then(Value::as_bool);
        let secret = map.remove("lease");
        let lease = secret.as_ref().and_then(Value::as_str).map(str::to_owned);
        let wrong = |message| Err(OpError::new(ErrorCode::BadRequest, message));
        let op = if wait.is_some() && flag.is_none() {
            wrong("`wait` is true or false")
        } else if secret.is_some() && lease.is_none() {
            wrong("`lease` is a text: that of the answer to `take`")
        } else {
            read_op(map)
        };
        Self {
            id,
            wait: flag,
            lease,
            op,
        }
    }
}

fn read_op(map: Map<String, Value>) -> Result<Op, OpError> {
    let name = match map.get("op") {
        Some(Value::String(name)) => name.clone(),
        _ => {
            let error = OpError::new(ErrorCode::BadRequest, "the key `op` with a name is missing");
            return Err(error.help("write {\"op\": \"state\"}"));
        }
    };
    if !operations().iter().any(|(known, _, _)| *known == name) {
        let message = format!("no operation is called `{name}`");
        return Err(OpError::new(ErrorCode::UnknownOp, message).help("docs/server.md lists them"));
    }
    Op::deserialize(Value::Object(map)).map_err(|error| {
        OpError::new(ErrorCode::BadRequest, format!("`{name}`: {error}"))
            .help("docs/server.md lists the keys of each operation")
    })
}

/// Returns name, description and JSON schema of each operation.
pub fn operations() -> &'static [(String, String, Value)] {
    static ALL: std::sync::OnceLock<Vec<(String, String, Value)>> = std::sync::OnceLock::new();
    ALL.get_or_init(|| {
        let mut settings = schemars::generate::SchemaSettings::draft2020_12();
        settings.inline_subschemas = true;
        let schema = settings.into_generator().into_root_schema_for::<Op>();
        let variants = schema.get("oneOf").and_then(Value::as_array);
        let variants = variants.into_iter().flatten();
        variants.filter_map(operation).collect()
    })
}

fn operation(variant: &Value) -> Option<(String, String, Value)> {
    let mut schema = variant.clone();
    let name = schema.pointer("/properties/op/const")?.as_str()?.to_owned();
    let text = schema.get("description").and_then(Value::as_str);
    let text = text.unwrap_or_default().to_owned();
    // Over HTTP, the path names the operation.
    let object = schema.as_object_mut()?;
    object.remove("description");
    if let Some(properties) = object.get_mut("properties").and_then(Value::as_object_mut) {
        properties.remove("op");
        properties.insert("wait".to_owned(), json!({"type": "boolean"}));
        properties.insert("id".to_owned(), json!({}));
        properties.insert("lease".to_owned(), json!({"type": "string"}));
    }
    if let Some(required) = object.get_mut("required").and_then(Value::as_array_mut) {
        required.retain(|key| key != "op");
    }
    Some((name, text, schema))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn op(text: &str) -> Result<Op, OpError> {
        Request::parse(text.as_bytes()).op
    }

    #[test]
    fn requests_are_read() {
        let request = Request::parse(br#"{"id": [1], "op": "stop", "wait": true}"#);
        assert_eq!(request.id, Some(json!([1])));
        assert_eq!(
            (request.wait, request.op.unwrap()),
            (Some(true), Op::Stop {})
        );
        let moves = op(r#"{"op": "move", "axis": "x", "to": 1}"#).unwrap();
        let axis = "x".to_owned();
        let (to, by, speed) = (Some(1.0), None, 1.0);
        assert_eq!(
            moves,
            Op::Move {
                axis,
                to,
                by,
                speed
            }
        );
        let pushed = op(r#"{"op": "stream_push", "axis": "x", "points": [[1], [2, 0.5]]}"#);
        let points = vec![Point::Position([1.0]), Point::WithVelocity([2.0, 0.5])];
        let axis = "x".to_owned();
        assert_eq!(pushed.unwrap(), Op::StreamPush { axis, points });
    }

    #[test]
    fn invalid_requests_are_refused_with_a_reason() {
        for (text, code, part) in [
            ("", ErrorCode::BadRequest, "not JSON"),
            ("[]", ErrorCode::BadRequest, "object"),
            ("{}", ErrorCode::BadRequest, "`op`"),
            (r#"{"op": "fly"}"#, ErrorCode::UnknownOp, "fly"),
            (
                r#"{"op": "stop", "axis": "x"}"#,
                ErrorCode::BadRequest,
                "axis",
            ),
            (r#"{"op": "enable"}"#, ErrorCode::BadRequest, "axis"),
            (
                r#"{"op": "enable", "axis": 1}"#,
                ErrorCode::BadRequest,
                "string",
            ),
            (
                r#"{"op": "stop", "wait": 1}"#,
                ErrorCode::BadRequest,
                "`wait`",
            ),
            (
                r#"{"op": "velocity", "axis": "x", "velocity": 1e999}"#,
                ErrorCode::BadRequest,
                "number",
            ),
            (
                r#"{"op": "velocity", "axis": "x", "velocity": NaN}"#,
                ErrorCode::BadRequest,
                "JSON",
            ),
        ] {
            let error = op(text).unwrap_err();
            assert_eq!(error.code, code, "{text}: {error:?}");
            assert!(error.message.contains(part), "{text}: {error:?}");
        }
    }

    #[test]
    fn every_operation_has_a_description_and_is_documented() {
        let text = include_str!("../../docs/server.md");
        assert!(operations().len() > 30);
        for (name, about, _) in operations() {
            assert!(about.ends_with('.'), "{name}");
            assert!(
                text.contains(&format!("`{name}`")),
                "{name} is missing in server.md"
            );
        }
    }
}
