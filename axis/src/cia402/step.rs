//! The power state machine as a pure function: computes the Controlword that takes the drive to the
//! requested power.
//!
//! [`controlword`] is the table (state × requested power × waiting time → command). [`step`] adds
//! state that a table cannot hold: the time in the present state, and the pulse train of a fault
//! reset.
//!
//! Of the transitions 0–16, the drive makes 0, 1, 13 and 14 itself. Disabling uses 8 instead of 5
//! and 9. "Disable operation" (5) is the same word as "switch on" (3). It would switch on a drive
//! that has fallen back to Ready to switch on. 9 is only for [`Power::Off`]. So bits 0 and 3 are
//! only sent for [`Power::Enabled`].

use super::state::State;
use super::words::{Controlword, Statusword};

/// The requested power of the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Power {
    /// Without power, ready to be enabled.
    #[default]
    Disabled,
    /// Operation enabled.
    Enabled,
    /// Quick stop active, or beyond.
    QuickStop,
    /// Removes the voltage at once, in any state.
    Off,
}

/// The request to the drive in one cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Request {
    /// The requested power.
    pub power: Power,
    /// Sends fault reset pulses while the drive is in Fault.
    pub reset_fault: bool,
    /// The drive's quick stop option code does not allow transition 16.
    pub without_transition_16: bool,
    /// A quick stop of the drive ends without power: "disable voltage" would only cut the time of
    /// its brake short. In its fault reaction the drive obeys "disable voltage".
    pub quick_stop_ends: bool,
    /// Takes the drive only as far as Switched on.
    pub hold: bool,
}

/// The state of the power state machine between cycles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PowerState {
    state: State,
    power: Power,
    in_state_s: f64,
    waited_s: f64,
    reset: FaultResetPulse,
}

impl PowerState {
    /// Returns the state before the first Statusword.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            state: State::NotReadyToSwitchOn,
            power: Power::Disabled,
            in_state_s: 0.0,
            waited_s: 0.0,
            reset: FaultResetPulse::Idle,
        }
    }

    /// Returns the state of the drive in the last Statusword.
    #[must_use]
    pub const fn state(&self) -> State {
        self.state
    }

    /// Returns the time in seconds since the drive entered its present state.
    #[must_use]
    pub const fn in_state_s(&self) -> f64 {
        self.in_state_s
    }
}

impl Default for PowerState {
    fn default() -> Self {
        Self::new()
    }
}

/// The progress of the drive towards the requested power.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum PowerProgress {
    /// The drive has the requested power.
    Reached,
    /// The drive is not yet in the requested state.
    Pending,
    /// The drive is in Fault or Fault reaction active, and no reset is requested.
    Faulted,
    /// Reset pulses are being sent.
    ResettingFault,
    /// All pulses were sent and the fault remains.
    ResetFailed,
}

/// The result of one cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Step {
    /// The state of the drive.
    pub state: State,
    /// The Controlword to send.
    pub controlword: Controlword,
    /// The progress towards the request.
    pub progress: PowerProgress,
}

/// Bit 7 acts on its rising edge: it is low, then high, then low again, each for a minimum time.
/// Cycles count as well, so that a cycle longer than the pulse still creates an edge.
#[derive(Debug, Clone, Copy, PartialEq)]
enum FaultResetPulse {
    Idle,
    Low { sent: u8, elapsed_s: f64 },
    High { sent: u8, elapsed_s: f64 },
    Failed,
}

const RESET_HALF_PERIOD_S: f64 = 0.05;
const RESET_PULSES: u8 = 3;

/// Time in seconds for which transition 16 (Quick stop active → Operation enabled) is tried.
/// Afterwards the drive goes through Switch on disabled, because its quick stop option code does
/// not allow transition 16.
const QUICK_STOP_RETURN_S: f64 = 0.5;

/// Longer than the lifetime of any machine; keeps sums finite.
const LONGEST_WAIT_S: f64 = 1e9;

/// Returns the command for a drive in `state`, without the fault reset. `power` has been requested
/// for `waited_s` seconds.
#[must_use]
pub fn controlword(state: State, power: Power, waited_s: f64) -> Controlword {
    match (state, power) {
        // The drive makes 14 itself. Shutdown, because disable voltage could cut its braking ramp
        // short.
        (State::FaultReactionActive, _) => Controlword::SHUTDOWN_COMMAND,
        (_, Power::Off) => Controlword::DISABLE_VOLTAGE_COMMAND, // 7, 9, 10, 12

        // The drive makes 0 and 1 itself.
        (State::NotReadyToSwitchOn, _) => Controlword::DISABLE_VOLTAGE_COMMAND,

        (State::SwitchOnDisabled, Power::Enabled) => Controlword::SHUTDOWN_COMMAND, // 2
        (State::SwitchOnDisabled, _) => Controlword::DISABLE_VOLTAGE_COMMAND,

        (State::ReadyToSwitchOn, Power::Enabled) => Controlword::SWITCH_ON_COMMAND, // 3
        (State::ReadyToSwitchOn, Power::Disabled) => Controlword::DISABLE_VOLTAGE_COMMAND, // 7
        (State::ReadyToSwitchOn, Power::QuickStop) => Controlword::QUICK_STOP_COMMAND, // 7

        (State::SwitchedOn, Power::Enabled) => Controlword::ENABLE_OPERATION_COMMAND, // 4
        (State::SwitchedOn, Power::Disabled) => Controlword::SHUTDOWN_COMMAND,        // 6
        (State::SwitchedOn, Power::QuickStop) => Controlword::QUICK_STOP_COMMAND,     // 10

        (State::OperationEnabled, Power::Enabled) => Controlword::ENABLE_OPERATION_COMMAND,
        (State::OperationEnabled, Power::Disabled) => Controlword::SHUTDOWN_COMMAND, // 8
        (State::OperationEnabled, Power::QuickStop) => Controlword::QUICK_STOP_COMMAND, // 11

        (State::QuickStopActive, Power::Enabled) if waited_s < QUICK_STOP_RETURN_S => {
            Controlword::ENABLE_OPERATION_COMMAND // 16
        }
        (State::QuickStopActive, Power::QuickStop) => Controlword::QUICK_STOP_COMMAND,
        (State::QuickStopActive, _) => Controlword::DISABLE_VOLTAGE_COMMAND, // 12

        // 15 is a pulse train, see `step`.
        (State::Fault, _) => Controlword::DISABLE_VOLTAGE_COMMAND,

        (State::Unknown(_), Power::Enabled) => Controlword::SHUTDOWN_COMMAND,
        (State::Unknown(_), Power::Disabled) => Controlword::DISABLE_VOLTAGE_COMMAND,
        (State::Unknown(_), Power::QuickStop) => Controlword::QUICK_STOP_COMMAND,
    }
}

/// Runs one cycle. Pure: the same arguments give the same result. Accepts any `dt_s`; a value that
/// is not a positive number counts as 0.
#[must_use]
pub fn step(
    memory: PowerState,
    statusword: Statusword,
    request: Request,
    dt_s: f64,
) -> (PowerState, Step) {
    step_in(memory, State::from_statusword(statusword), request, dt_s)
}

/// Runs [`step`] with an already decoded state.
#[must_use]
pub fn step_in(
    mut memory: PowerState,
    state: State,
    request: Request,
    dt_s: f64,
) -> (PowerState, Step) {
    let dt_s = if dt_s > 0.0 { dt_s } else { 0.0 };
    // The fast path of nearly all cycles.
    let running = matches!(
        (state, memory.state, request.power, memory.power),
        (
            State::OperationEnabled,
            State::OperationEnabled,
            Power::Enabled,
            Power::Enabled
        )
    );
    if running {
        memory.in_state_s = (memory.in_state_s + dt_s).min(LONGEST_WAIT_S);
        memory.waited_s = (memory.waited_s + dt_s).min(LONGEST_WAIT_S);
        memory.reset = FaultResetPulse::Idle;
        let step = Step {
            state,
            controlword: Controlword::ENABLE_OPERATION_COMMAND,
            progress: PowerProgress::Reached,
        };
        return (memory, step);
    }
    let same_state = state == memory.state;
    let same_wait = same_state && request.power == memory.power;
    let since = |same: bool, before: f64| {
        if same {
            (before + dt_s).min(LONGEST_WAIT_S)
        } else {
            0.0
        }
    };
    let reset = if state == State::Fault && request.reset_fault {
        memory.reset.next(dt_s)
    } else {
        FaultResetPulse::Idle
    };
    let memory = PowerState {
        state,
        power: request.power,
        in_state_s: since(same_state, memory.in_state_s),
        waited_s: since(same_wait, memory.waited_s),
        reset,
    };
    let waited_s = if request.without_transition_16 {
        QUICK_STOP_RETURN_S
    } else {
        memory.waited_s
    };
    let mut word = controlword(state, request.power, waited_s);
    if request.hold && state == State::SwitchedOn && request.power == Power::Enabled {
        word = Controlword::SWITCH_ON_COMMAND;
    }
    if request.quick_stop_ends {
        word = match (state, request.power) {
            (State::FaultReactionActive, Power::Off) => Controlword::DISABLE_VOLTAGE_COMMAND,
            (State::QuickStopActive, power) if power != Power::Off => {
                Controlword::QUICK_STOP_COMMAND
            }
            _ => word,
        };
    }
    if matches!(reset, FaultResetPulse::High { .. }) {
        word |= Controlword::FAULT_RESET_COMMAND;
    }
    let progress = match reset {
        FaultResetPulse::Failed => PowerProgress::ResetFailed,
        FaultResetPulse::Low { .. } | FaultResetPulse::High { .. } => PowerProgress::ResettingFault,
        FaultResetPulse::Idle if state.is_fault() => PowerProgress::Faulted,
        FaultResetPulse::Idle if reached(state, request.power) => PowerProgress::Reached,
        FaultResetPulse::Idle => PowerProgress::Pending,
    };
    (
        memory,
        Step {
            state,
            controlword: word,
            progress,
        },
    )
}

const fn reached(state: State, power: Power) -> bool {
    match power {
        Power::Disabled | Power::Off => matches!(state, State::SwitchOnDisabled),
        Power::Enabled => matches!(state, State::OperationEnabled),
        // A drive whose quick stop ends with transition 12 has also reached the request.
        Power::QuickStop => matches!(state, State::QuickStopActive | State::SwitchOnDisabled),
    }
}

impl FaultResetPulse {
    fn next(self, dt_s: f64) -> Self {
        match self {
            Self::Idle => Self::Low {
                sent: 0,
                elapsed_s: 0.0,
            },
            Self::Low { sent, elapsed_s } => {
                let elapsed_s = elapsed_s + dt_s;
                if elapsed_s < RESET_HALF_PERIOD_S {
                    Self::Low { sent, elapsed_s }
                } else if sent < RESET_PULSES {
                    Self::High {
                        sent: sent.saturating_add(1),
                        elapsed_s: 0.0,
                    }
                } else {
                    Self::Failed
                }
            }
            Self::High { sent, elapsed_s } => {
                let elapsed_s = elapsed_s + dt_s;
                if elapsed_s < RESET_HALF_PERIOD_S {
                    Self::High { sent, elapsed_s }
                } else {
                    Self::Low {
                        sent,
                        elapsed_s: 0.0,
                    }
                }
            }
            Self::Failed => Self::Failed,
        }
    }
}

#[cfg(test)]
#[path = "step_tests.rs"]
mod tests;
