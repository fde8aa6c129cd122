//! The power state machine as one pure function: what to send so that the drive goes where it is wanted.
//!
//! [`controlword`] is the table (state × wish × waiting time → command). [`step`] adds what a table cannot hold: how long the
//! drive has been where it is, and the pulse train of a fault reset.
//!
//! Of the standard's transitions 0–16 the drive makes 0, 1, 13 and 14 on its own. Disabling uses 8 rather than 5 and 9:
//! "disable operation" (5) is the same word as "switch on" (3), so a drive that has already fallen back to Ready to switch on
//! would be switched on by it; 9 is for [`Power::Off`] alone. So without [`Power::Enabled`] neither bit 0 nor bit 3 is ever sent.

use super::state::State;
use super::words::{Controlword, Statusword};

/// Where the drive's power is wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Power {
    #[default]
    Disabled,
    Enabled,
    QuickStop,
    /// Disabled the shortest way: no voltage, whatever the axis is doing.
    Off,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Request {
    pub power: Power,
    /// Send fault reset pulses while the drive is in Fault.
    pub reset_fault: bool,
    /// The drive's quick stop option code has no transition 16.
    pub no_return: bool,
    /// Operation is not enabled yet: an enabled drive is taken as far as Switched on.
    pub hold: bool,
}

/// What the state machine remembers between cycles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Memory {
    state: State,
    power: Power,
    in_state_s: f64,
    waited_s: f64,
    reset: Reset,
}

impl Memory {
    #[must_use]
    pub const fn new() -> Self {
        Self {
            state: State::NotReadyToSwitchOn,
            power: Power::Disabled,
            in_state_s: 0.0,
            waited_s: 0.0,
            reset: Reset::Idle,
        }
    }

    #[must_use]
    pub const fn state(&self) -> State {
        self.state
    }

    /// Seconds since the drive entered its present state.
    #[must_use]
    pub const fn in_state_s(&self) -> f64 {
        self.in_state_s
    }
}

impl Default for Memory {
    fn default() -> Self {
        Self::new()
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// The drive is where it is wanted.
    Reached,
    /// On the way.
    Pending,
    /// In Fault or on the way into it, and no reset was asked for.
    Faulted,
    /// Reset pulses are being sent.
    ResettingFault,
    /// All pulses were sent and the fault is still there.
    ResetFailed,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    pub state: State,
    pub controlword: Controlword,
    pub progress: Progress,
}

/// Bit 7 acts on its rising edge, so it is low for a while, high for a while, and low again. Counted in cycles too, so that
/// a cycle longer than the pulse still gives an edge.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Reset {
    Idle,
    Low { sent: u8, elapsed_s: f64 },
    High { sent: u8, elapsed_s: f64 },
    Failed,
}

const RESET_HALF_PERIOD_S: f64 = 0.05;
const RESET_PULSES: u8 = 3;

/// How long transition 16 (Quick stop active → Operation enabled) is tried. Drives whose quick stop option code does not
/// allow it are then taken through Switch on disabled.
const QUICK_STOP_RETURN_S: f64 = 0.5;

/// Longer than any machine runs; keeps the sums finite.
const LONGEST_WAIT_S: f64 = 1e9;

/// The command for a drive in `state` whose power is wanted as `power` and has been for `waited_s`, fault reset aside.
#[must_use]
pub fn controlword(state: State, power: Power, waited_s: f64) -> Controlword {
    match (state, power) {
        // 14 is the drive's own. Shutdown rather than disable voltage: nothing that could cut its braking ramp short.
        (State::FaultReactionActive, _) => Controlword::SHUTDOWN_COMMAND,
        (_, Power::Off) => Controlword::DISABLE_VOLTAGE_COMMAND, // 7, 9, 10, 12

        // 0, 1: the drive's own.
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

/// One cycle. Pure: the same arguments give the same answer. Any `dt_s` is accepted; what is not a positive number is no time.
#[must_use]
pub fn step(memory: Memory, statusword: Statusword, request: Request, dt_s: f64) -> (Memory, Step) {
    step_in(memory, State::from_statusword(statusword), request, dt_s)
}

/// [`step`] for a state that has been read already.
#[must_use]
pub fn step_in(mut memory: Memory, state: State, request: Request, dt_s: f64) -> (Memory, Step) {
    let dt_s = if dt_s > 0.0 { dt_s } else { 0.0 };
    // Nearly every cycle of a machine's life.
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
        memory.reset = Reset::Idle;
        let step = Step {
            state,
            controlword: Controlword::ENABLE_OPERATION_COMMAND,
            progress: Progress::Reached,
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
        Reset::Idle
    };
    let memory = Memory {
        state,
        power: request.power,
        in_state_s: since(same_state, memory.in_state_s),
        waited_s: since(same_wait, memory.waited_s),
        reset,
    };
    let waited_s = if request.no_return {
        QUICK_STOP_RETURN_S
    } else {
        memory.waited_s
    };
    let mut word = controlword(state, request.power, waited_s);
    if request.hold && state == State::SwitchedOn && request.power == Power::Enabled {
        word = Controlword::SWITCH_ON_COMMAND;
    }
    if matches!(reset, Reset::High { .. }) {
        word |= Controlword::FAULT_RESET_COMMAND;
    }
    let progress = match reset {
        Reset::Failed => Progress::ResetFailed,
        Reset::Low { .. } | Reset::High { .. } => Progress::ResettingFault,
        Reset::Idle if state.is_fault() => Progress::Faulted,
        Reset::Idle if reached(state, request.power) => Progress::Reached,
        Reset::Idle => Progress::Pending,
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
        // A drive whose quick stop option code ends in transition 12 has done what was asked, too.
        Power::QuickStop => matches!(state, State::QuickStopActive | State::SwitchOnDisabled),
    }
}

impl Reset {
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
