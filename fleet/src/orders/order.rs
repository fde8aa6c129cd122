//! Orders: JSON texts with a signature, a time window and a nonce.

use serde::{Deserialize, Serialize};

use super::manifest::{BundlePath, FileRef};
use super::signing::Right;
use crate::error::{Error, Result};
use crate::keys::MachineId;

/// The longest order with its signature in bytes.
pub const MAX_ORDER: usize = 64 << 10;
/// The longest time window in s.
pub const MAX_WINDOW: u64 = 86_400;
const FORMAT: u32 = 1;

/// What a machine is to do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Action {
    /// Take a bundle.
    Push {
        manifest: FileRef,
        signature: String,
        /// The sender says that no server of this machine runs.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        no_server: bool,
    },
    /// Go back to the previous bundle.
    Back {
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        no_server: bool,
    },
    /// Start the program of the machine file.
    Start {
        /// The instant of the start in ns since 1970; at once without it.
        at_unix_ns: Option<u64>,
    },
    /// Stop all axes and the program.
    Stop {
        /// The nonce of an order `start`: stop only what this order has started, or will start.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        start: Option<String>,
    },
    /// Write firmware to a device.
    Firmware {
        device: String,
        name: BundlePath,
        file: FileRef,
        /// The text of `FILE.minisig`, for the policy of the machine.
        signature: Option<String>,
    },
    /// Write parameters to a device, and store them there.
    Parameters {
        device: String,
        name: BundlePath,
        file: FileRef,
    },
}

impl Action {
    /// Returns the right that the action needs.
    #[must_use]
    pub fn right(&self) -> Right {
        match self {
            Self::Push { .. } | Self::Back { .. } => Right::Push,
            Self::Start { .. } => Right::Start,
            Self::Stop { .. } => Right::Stop,
            Self::Firmware { .. } | Self::Parameters { .. } => Right::Update,
        }
    }

    /// Returns the action in a few words, for logs.
    #[must_use]
    pub fn summary(&self) -> String {
        match self {
            Self::Push { manifest, .. } => format!("push bundle {}", manifest.sha256),
            Self::Back { .. } => "push back".to_owned(),
            Self::Start { at_unix_ns: None } => "start".to_owned(),
            Self::Start {
                at_unix_ns: Some(at),
            } => format!("start at {at} ns"),
            Self::Stop { start: None } => "stop".to_owned(),
            Self::Stop { start: Some(_) } => "stop of a start".to_owned(),
            Self::Firmware { device, file, .. } => {
                format!("firmware {} to `{device}`", file.sha256)
            }
            Self::Parameters { device, file, .. } => {
                format!("parameters {} to `{device}`", file.sha256)
            }
        }
    }
}

/// An order to one machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Order {
    /// The version of the format: 1.
    pub ecaxis_order: u32,
    pub machine: MachineId,
    pub action: Action,
    /// In seconds since 1970.
    pub not_before: u64,
    pub not_after: u64,
    /// 32 hexadecimal digits that no other order has.
    pub nonce: String,
}

/// An order with its signature, as it travels.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SignedOrder {
    pub order: String,
    pub signature: String,
}

impl SignedOrder {
    /// Reads a message.
    ///
    /// # Errors
    /// Fails if it is not an order.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        if bytes.len() > MAX_ORDER {
            return Err(Error::new(format!(
                "the order is longer than {MAX_ORDER} bytes"
            )));
        }
        serde_json::from_slice(bytes).map_err(|e| Error::new(format!("not an order: {e}")))
    }

    #[must_use]
    pub fn emit(&self) -> Vec<u8> {
        serde_json::to_vec(self).unwrap_or_default()
    }
}

impl Order {
    #[must_use]
    pub fn new(machine: MachineId, action: Action, from: u64, until: u64, nonce: String) -> Self {
        Self {
            ecaxis_order: FORMAT,
            machine,
            action,
            not_before: from,
            not_after: until,
            nonce,
        }
    }

    /// Reads an order.
    ///
    /// # Errors
    /// Fails if the text is not an order.
    pub fn parse(text: &str) -> Result<Self> {
        let order: Self = serde_json::from_str(text)
            .map_err(|e| Error::new(format!("the order is damaged: {e}")))?;
        if order.ecaxis_order != FORMAT {
            let what = format!("the order has the format {}", order.ecaxis_order);
            return Err(Error::new(what).help("use the same version of ecaxis-fleet"));
        }
        let digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
        let is_nonce = |text: &str| text.len() == 32 && text.bytes().all(digit);
        let stopped = match &order.action {
            Action::Stop { start } => start.as_deref(),
            _ => None,
        };
        if !is_nonce(&order.nonce) || !stopped.is_none_or(is_nonce) {
            return Err(Error::new(
                "the nonce has 32 hexadecimal digits, lower case",
            ));
        }
        Ok(order)
    }

    /// Checks machine and time window.
    ///
    /// # Errors
    /// Fails with the reason of the refusal.
    pub fn check(&self, machine: &MachineId, now: u64) -> Result<()> {
        if self.machine != *machine {
            return Err(Error::new(format!(
                "the order is for {}, not for {machine}",
                self.machine
            )));
        }
        if self.not_after.saturating_sub(self.not_before) > MAX_WINDOW {
            let what = format!("the time window of the order is longer than {MAX_WINDOW} s");
            return Err(Error::new(what));
        }
        let clocks = "send it again, and compare the clocks of both computers";
        if now < self.not_before {
            let early = self.not_before - now;
            return Err(Error::new(format!("the order begins in {early} s")).help(clocks));
        }
        if now > self.not_after {
            let late = now - self.not_after;
            return Err(Error::new(format!("the order expired {late} s ago")).help(clocks));
        }
        Ok(())
    }
}

/// How far an order is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    Running,
    /// It runs on without its sender.
    Started,
    Done,
    /// Nothing was changed.
    Refused,
    Failed,
}

/// The answer to an order, and to its repetition.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OrderReply {
    pub status: Status,
    pub text: String,
    /// True if the agent knew the order already. It executes an order once.
    #[serde(default)]
    pub repeated: bool,
}

impl OrderReply {
    #[must_use]
    pub fn new(status: Status, text: impl Into<String>) -> Self {
        Self {
            status,
            text: text.into(),
            repeated: false,
        }
    }
}
