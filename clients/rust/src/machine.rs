//! A machine, its axes and its commands.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Deserializer};
use serde_json::{Value, json};

use crate::connection::{Connection, Request};
use crate::{Cyclic, Error, Result, Subscription};

/// The time for commands that wait themselves.
const OUTCOME: Duration = Duration::from_secs(60);

/// How a client attaches.
#[derive(Debug, Clone)]
pub struct Options {
    /// The name of this client in events and errors of others.
    pub name: String,
    /// The longest silence of this client, after which what it moved stops.
    pub lease: Duration,
    /// The time until the bus is in Op; zero: attaches in any state.
    pub timeout: Duration,
    /// Takes the lease. Without it, commands are refused.
    pub take: bool,
    /// Takes the lease from another client, whose axes stop first.
    pub force: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            name: "Rust".to_owned(),
            lease: Duration::from_secs(2),
            timeout: Duration::from_secs(60),
            take: true,
            force: false,
        }
    }
}

/// An axis as the machine file describes it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct AxisInfo {
    /// Its name.
    pub name: String,
    /// The unit of its positions.
    #[serde(default)]
    pub unit: String,
    /// Its limits.
    pub limits: Limits,
    /// The machine file describes its homing.
    #[serde(default)]
    pub homing: bool,
}

/// The limits of an axis, in its units. Those that do not exist are `None`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct Limits {
    /// The least and the greatest position.
    pub position: Option<[f64; 2]>,
    /// The greatest velocity.
    pub velocity: f64,
    /// The greatest acceleration.
    pub acceleration: f64,
    /// The greatest jerk.
    pub jerk: Option<f64>,
    /// The following error at which the axis stops.
    pub following_error: Option<f64>,
}

/// The state of an axis. A number that is not known is NaN.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct AxisState {
    /// Its name.
    pub name: String,
    /// The state of CiA 402, such as `Operation enabled`.
    pub state: String,
    /// It has power and holds or moves.
    pub enabled: bool,
    /// It obeys motion commands.
    pub ready: bool,
    /// A motion has not reached its target.
    #[serde(default)]
    pub moving: bool,
    /// Set-point and drive stand.
    #[serde(default)]
    pub at_rest: bool,
    /// It was homed since the bus came up.
    #[serde(default)]
    pub homed: bool,
    /// The actual position.
    #[serde(deserialize_with = "number_or_nan")]
    pub position: f64,
    /// The actual velocity.
    #[serde(deserialize_with = "number_or_nan")]
    pub velocity: f64,
    /// The actual torque in percent.
    #[serde(deserialize_with = "number_or_nan")]
    pub torque: f64,
    /// The set-point.
    #[serde(deserialize_with = "number_or_nan")]
    pub target_position: f64,
    /// The velocity of the set-point.
    #[serde(deserialize_with = "number_or_nan")]
    pub target_velocity: f64,
    /// The following error.
    #[serde(deserialize_with = "number_or_nan")]
    pub following_error: f64,
    /// The fault of the drive.
    pub fault: Option<String>,
    /// The trip of the supervision.
    pub trip: Option<String>,
}

fn number_or_nan<'de, D: Deserializer<'de>>(deserializer: D) -> std::result::Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

/// A machine that `ecaxis serve` runs.
///
/// The client owns the motion until this value is dropped. Its lease ends if the program calls
/// nothing here for the time of [`Options::lease`]: what it moved then stops. [`Machine::wait`] and
/// [`Machine::sleep`] keep it. Threads may share a machine, by reference or in an `Arc`.
#[derive(Debug)]
pub struct Machine {
    connection: Connection,
    path: PathBuf,
    name: String,
    lease: Duration,
    virtual_time: bool,
    axes: Vec<AxisInfo>,
}

impl Machine {
    /// Connects to the socket of a server, waits until the bus is in Op and takes the lease.
    ///
    /// # Errors
    /// Fails without a server, if the bus does not come up, or if another client owns the motion.
    pub fn attach(socket: impl AsRef<Path>, options: Options) -> Result<Self> {
        let connection = Connection::open(socket.as_ref(), None)?;
        let hello = connection.ask("hello", "", json!({"name": options.name}))?;
        if hello["protocol"] != json!(1) {
            let error = Error::protocol("the server speaks another version of the protocol");
            return Err(error.at("attach", ""));
        }
        if !options.timeout.is_zero() {
            let timeout_ms = u64::try_from(options.timeout.as_millis()).unwrap_or(u64::MAX);
            let bus = json!({"bus": "op", "timeout_ms": timeout_ms});
            let timeout = options.timeout.saturating_add(Duration::from_secs(1));
            connection.ask_within("await", "", bus, timeout)?;
        }
        let mut machine = connection.ask("machine", "", json!({}))?;
        let axes = read(machine["axes"].take(), "machine")?;
        let machine = Self {
            connection,
            path: socket.as_ref().to_owned(),
            name: options.name,
            lease: options.lease,
            virtual_time: hello["virtual"] == json!(true),
            axes,
        };
        if options.take {
            machine.take(options.force)?;
        }
        Ok(machine)
    }

    /// Returns true if time advances only while a client waits: `ecaxis serve --virtual`.
    #[must_use]
    pub fn is_virtual(&self) -> bool {
        self.virtual_time
    }

    /// Returns the axes in the order of the machine file.
    #[must_use]
    pub fn axes(&self) -> &[AxisInfo] {
        &self.axes
    }

    /// Returns the state of an axis.
    ///
    /// # Errors
    /// Fails if the axis is unknown or the bus is not in Op.
    pub fn axis(&self, name: &str) -> Result<AxisState> {
        let mut state = self.connection.ask("state", name, json!({}))?;
        let axes = state["axes"].as_array_mut();
        let mut axes = axes.into_iter().flatten();
        let Some(axis) = axes.find(|axis| axis["name"] == json!(name)) else {
            let error = Error::new("unknown_name", "the machine has no such axis");
            return Err(error.help("see the machine file").at("state", name));
        };
        if axis["state"] == json!("unknown") {
            return Err(Error::new("not_up", "the bus is not in Op").at("state", name));
        }
        read(axis.take(), "state")
    }

    /// Returns the value of an input.
    ///
    /// # Errors
    /// Fails if the input is unknown or the bus is not in Op.
    pub fn input(&self, device: &str, name: &str) -> Result<f64> {
        let state = self.connection.ask("state", device, json!({}))?;
        let mut inputs = state["inputs"].as_array().into_iter().flatten();
        let found = inputs.find(|i| i["device"] == json!(device) && i["name"] == json!(name));
        let Some(input) = found else {
            let error = Error::new("unknown_name", format!("the device has no input `{name}`"));
            return Err(error
                .help("`ecaxis explain` lists them")
                .at("input", device));
        };
        let no_value = || Error::new("not_up", "the bus is not in Op").at("input", device);
        input["value"].as_f64().ok_or_else(no_value)
    }

    /// Brings an axis, or `*` for all, to Operation enabled, and waits for it.
    ///
    /// # Errors
    /// Fails if the axis has a fault or does not get there.
    pub fn enable(&self, axis: &str) -> Result<()> {
        self.complete("enable", axis, json!({"axis": axis}))
    }

    /// Decelerates an axis, or `*` for all, then removes the power, and waits for it.
    ///
    /// # Errors
    /// Fails if the axis is not enabled or its group has stopped.
    pub fn disable(&self, axis: &str) -> Result<()> {
        self.complete("disable", axis, json!({"axis": axis}))
    }

    /// Resets faults and trips of an axis, or `*` for all, and waits for it.
    ///
    /// # Errors
    /// Fails if the fault stays.
    pub fn reset(&self, axis: &str) -> Result<()> {
        self.complete("reset", axis, json!({"axis": axis}))
    }

    /// Switches an input of the simulated bus: a name of `[signals]`, or `io.Input 1`.
    ///
    /// # Errors
    /// Fails if the bus is real, or the input is unknown or cannot have the value.
    pub fn set_input(&mut self, name: &str, value: f64) -> Result<()> {
        let keys = json!({"input": name, "value": value});
        self.complete("sim_input", name, keys)
    }

    /// Sends an NMT command to a node behind a gateway: `start`, `stop`, `pre_operational` or
    /// `reset`.
    ///
    /// # Errors
    /// Fails if the node is unknown, or its axis has power.
    pub fn command_node(&self, device: &str, node: u8, action: &str) -> Result<()> {
        let keys = json!({"device": device, "node": node, "action": action});
        self.complete("node", device, keys)
    }

    /// Sets an output that no axis writes.
    ///
    /// # Errors
    /// Fails if the output is unknown or the value does not fit.
    pub fn set_output(&self, device: &str, name: &str, value: f64) -> Result<()> {
        let keys = json!({"device": device, "output": name, "value": value});
        self.complete("output", device, keys)
    }

    /// Homes an axis as the machine file says.
    ///
    /// # Errors
    /// As for all motions: fails only if the request cannot be sent. [`Machine::wait`] has the
    /// outcome.
    pub fn home(&self, axis: &str) -> Result<Request> {
        self.connection.command("home", axis, json!({"axis": axis}))
    }

    /// Moves to a position. `speed` is a fraction of the velocity limit, above 0 and at most 1.
    ///
    /// # Errors
    /// As [`Machine::home`].
    pub fn move_to(&self, axis: &str, to: f64, speed: f64) -> Result<Request> {
        let keys = json!({"axis": axis, "to": finite(to, axis)?, "speed": finite(speed, axis)?});
        self.connection.command("move", axis, keys)
    }

    /// Moves by a distance.
    ///
    /// # Errors
    /// As [`Machine::home`].
    pub fn move_by(&self, axis: &str, by: f64, speed: f64) -> Result<Request> {
        let keys = json!({"axis": axis, "by": finite(by, axis)?, "speed": finite(speed, axis)?});
        self.connection.command("move", axis, keys)
    }

    /// Runs at a velocity until the next command.
    ///
    /// # Errors
    /// As [`Machine::home`].
    pub fn run(&self, axis: &str, velocity: f64) -> Result<Request> {
        let keys = json!({"axis": axis, "velocity": finite(velocity, axis)?});
        self.connection.command("velocity", axis, keys)
    }

    /// Decelerates an axis and holds.
    ///
    /// # Errors
    /// As [`Machine::home`].
    pub fn halt(&self, axis: &str) -> Result<Request> {
        self.connection.command("halt", axis, json!({"axis": axis}))
    }

    /// Waits for the outcome of a command and keeps the lease meanwhile.
    ///
    /// # Errors
    /// Fails if the command was refused, did not reach its end, or has no outcome in time.
    pub fn wait(&self, request: Request, timeout: Duration) -> Result<()> {
        self.connection.wait(request, timeout)
    }

    /// Returns true once a command has reached its end. Does not wait.
    ///
    /// # Errors
    /// Fails if it was refused or did not reach its end.
    pub fn is_done(&self, request: Request) -> Result<bool> {
        self.connection
            .outcome(request)
            .transpose()
            .map(|o| o.is_some())
    }

    /// All axes decelerate and hold. Needs no lease.
    ///
    /// # Errors
    /// Fails if the connection is lost.
    pub fn stop(&self) -> Result<()> {
        self.connection.ask("stop", "", json!({})).map(drop)
    }

    /// Each axis stops as the machine file says and loses power. Needs no lease.
    ///
    /// # Errors
    /// Fails if the connection is lost.
    pub fn emergency_stop(&self) -> Result<()> {
        self.connection
            .ask("emergency_stop", "", json!({}))
            .map(drop)
    }

    /// Waits and keeps the lease. With `ecaxis serve --virtual`, time advances.
    ///
    /// # Errors
    /// Fails if the lease has ended or the connection is lost.
    pub fn sleep(&self, time: Duration) -> Result<()> {
        if !self.virtual_time {
            return self.connection.sleep(time);
        }
        let keys = json!({"seconds": time.as_secs_f64()});
        let timeout = OUTCOME.saturating_add(time);
        self.connection
            .ask_within("advance", "", keys, timeout)
            .map(drop)
    }

    /// Renews the lease if a third of its time is over. Does not wait.
    ///
    /// # Errors
    /// Fails once the lease has ended.
    pub fn keep(&self) -> Result<()> {
        self.connection.keep()
    }

    /// Gets the lease. With `force`, from another client, whose axes stop first.
    ///
    /// # Errors
    /// Fails if another client owns the motion.
    pub fn take(&self, force: bool) -> Result<()> {
        let ttl_ms = u64::try_from(self.lease.as_millis()).unwrap_or(u64::MAX);
        self.connection
            .ask("take", "", json!({"ttl_ms": ttl_ms, "force": force}))?;
        self.connection.set_lease(Some(self.lease));
        Ok(())
    }

    /// Gives the lease back. What this client moved stops.
    ///
    /// # Errors
    /// Fails if this client does not own the motion.
    pub fn release(&self) -> Result<()> {
        self.connection.set_lease(None);
        self.connection.ask("release", "", json!({})).map(drop)
    }

    /// Any operation of `docs/server.md` with its keys. Returns its answer.
    ///
    /// # Errors
    /// Fails if the server refuses it.
    pub fn request(&self, op: &str, keys: Value) -> Result<Value> {
        self.connection.ask_within(op, "", keys, OUTCOME)
    }

    /// Any command of `docs/server.md` that has an outcome, such as `mode`. `device` names the axis
    /// or device in errors.
    ///
    /// # Errors
    /// As [`Machine::home`].
    pub fn command(&self, op: &str, device: &str, keys: Value) -> Result<Request> {
        self.connection.command(op, device, keys)
    }

    /// Returns the events of the server from now on, such as `fault`.
    ///
    /// # Errors
    /// Fails if the connection is lost.
    pub fn events(&self) -> Result<Subscription> {
        Subscription::open(&self.path, &self.name, json!({"topics": ["events"]}))
    }

    /// Returns the values of signals in every cycle, a batch of cycles each `interval`. The names
    /// are those of [`Samples::signal`](crate::Samples::signal).
    ///
    /// # Errors
    /// Fails if a signal is unknown or the connection is lost.
    pub fn samples(&self, signals: &[&str], interval: Duration) -> Result<Subscription> {
        let interval_ms = u64::try_from(interval.as_millis()).unwrap_or(u64::MAX);
        let keys = json!({"topics": ["samples"], "signals": signals, "interval_ms": interval_ms});
        Subscription::open(&self.path, &self.name, keys)
    }

    /// Returns the newest set-point of an axis each `interval`, with its instant of common time.
    ///
    /// # Errors
    /// Fails if the axis is unknown or the connection is lost.
    pub fn setpoints(&self, axis: &str, interval: Duration) -> Result<Subscription> {
        let interval_ms = u64::try_from(interval.as_millis()).unwrap_or(u64::MAX);
        let keys = json!({"topics": ["setpoints"], "axis": axis, "interval_ms": interval_ms});
        Subscription::open(&self.path, &self.name, keys)
    }

    /// Maps the memory for set-points in every cycle.
    ///
    /// # Errors
    /// Fails without the lease, or if the memory is not as `docs/server.md` describes it.
    pub fn cyclic(&self) -> Result<Cyclic> {
        let descriptors = self.connection.ask_descriptors("area")?;
        let names = self.axes.iter().map(|axis| axis.name.clone()).collect();
        let other = || Error::protocol("the shared memory of the server has another layout");
        Cyclic::map(&descriptors, names).ok_or_else(|| other().at("area", ""))
    }

    fn complete(&self, op: &str, device: &str, keys: Value) -> Result<()> {
        let request = self.connection.command(op, device, keys)?;
        self.connection.wait(request, OUTCOME)
    }
}

fn finite(value: f64, axis: &str) -> Result<f64> {
    let error = || Error::new("bad_request", format!("{value} is not a finite number"));
    value
        .is_finite()
        .then_some(value)
        .ok_or_else(|| error().at("move", axis))
}

fn read<T: serde::de::DeserializeOwned>(value: Value, step: &str) -> Result<T> {
    serde_json::from_value(value).map_err(|error| Error::protocol(error.to_string()).at(step, ""))
}
