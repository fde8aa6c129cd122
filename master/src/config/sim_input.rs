//! Inputs of simulated I/O devices, switched by the file, a console or a client.

use super::signal::SignalDirection;
use super::sim::bus_order;
use super::{Machine, NameError, Signal};
use crate::link::sim::SimInput;
use crate::rt::image::NumericFormat;

impl Machine {
    /// Returns the input of a name of `[signals]`, or of a device and its signal: `io.Input 1`.
    ///
    /// # Errors
    /// Fails if no input has the name, or if a drive sets it.
    pub fn switchable_input(&self, name: &str) -> Result<Signal, NameError> {
        let named = self.signals.iter().find(|named| named.name == name);
        let text = named.map_or(name, |named| named.signal.as_str());
        let devices = self.devices.iter().map(|device| device.name.as_str());
        let device = devices.filter(|device| {
            let rest = text.strip_prefix(device);
            rest.is_some_and(|rest| rest.starts_with('.'))
        });
        let Some(device) = device.max_by_key(|device| device.len()) else {
            let inputs = self.named_inputs().map(|(name, _)| format!("`{name}`"));
            let hint = match inputs.collect::<Vec<_>>().join(", ") {
                none if none.is_empty() => "write a device and its input: io.Input 1".to_owned(),
                names => format!("inputs of [signals]: {names}"),
            };
            return Err(NameError::of_signal(
                format!("no input is named `{name}`"),
                hint,
            ));
        };
        let signal = self.signal(device, &text[device.len() + 1..], SignalDirection::In)?;
        if self.devices[signal.device].selection.mode.is_some() {
            let message = format!(
                "`{}` is an input of a drive, which the drive sets",
                signal.name
            );
            return Err(NameError::of_signal(
                message,
                "switch inputs of I/O devices",
            ));
        }
        Ok(signal)
    }

    /// Returns the names of `[signals]` that are inputs of I/O devices.
    pub fn named_inputs(&self) -> impl Iterator<Item = (&str, Signal)> {
        let named = self.signals.iter();
        named.filter_map(|named| {
            let signal = self.switchable_input(&named.name).ok()?;
            Some((named.name.as_str(), signal))
        })
    }

    /// Returns the command to the simulated bus for an input.
    ///
    /// # Errors
    /// Fails if the input cannot have the value.
    pub fn sim_input(&self, input: &Signal, value: f64) -> Result<SimInput, NameError> {
        let (low, high, whole) = input.range();
        if !(low..=high).contains(&value) || (whole && value.fract() != 0.0) {
            let message = format!("{value} is not a value of `{}`", input.name);
            return Err(NameError::of_signal(
                message,
                format!("it has {low} to {high}"),
            ));
        }
        let name = &self.devices[input.device].name;
        let order = bus_order(&self.devices);
        let position = order.iter().position(|other| other.name == *name);
        Ok(SimInput {
            position: position.unwrap_or(usize::MAX),
            index: input.field.index,
            sub: input.field.sub,
            value: match input.kind() {
                NumericFormat::Real => (value as f32).to_bits().into(),
                NumericFormat::Signed | NumericFormat::Unsigned => value as i64,
            },
        })
    }

    /// Reads a line of a console: `press start`, `release start`, or `set io.Input 1 = 1`. `None`: it is
    /// another command.
    ///
    /// # Errors
    /// Fails if the input or its value does not exist.
    pub fn parse_input_line(&self, line: &str) -> Option<Result<SimInput, String>> {
        let (verb, rest) = line.trim().split_once(char::is_whitespace)?;
        let (name, value) = match (verb, rest.split_once('=')) {
            ("press", None) => (rest, Ok(1.0)),
            ("release", None) => (rest, Ok(0.0)),
            ("set", Some((name, value))) => (name, number(value.trim())),
            ("set", None) => return Some(Err("write `set io.Input 1 = 1`".to_owned())),
            ("press" | "release", Some(_)) => {
                return Some(Err(format!("`{verb}` takes the name of an input")));
            }
            _ => return None,
        };
        let command = || {
            let value = value.clone()?;
            let signal = self
                .switchable_input(name.trim())
                .map_err(|e| e.to_string())?;
            self.sim_input(&signal, value).map_err(|e| e.to_string())
        };
        Some(command())
    }
}

fn number(text: &str) -> Result<f64, String> {
    match text {
        "true" => Ok(1.0),
        "false" => Ok(0.0),
        _ => {
            let number = text.parse::<f64>().ok().filter(|n| n.is_finite());
            number.ok_or_else(|| format!("`{text}` is not a number, true or false"))
        }
    }
}
