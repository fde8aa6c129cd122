//! The power state machine of the drive: states, transitions 0–16, and stops during a transition.
//! Each call is one control cycle and takes at most one transition.

use super::fault::Reaction;

/// CiA 402 power drive system states.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum State {
    /// Not ready to switch on.
    NotReadyToSwitchOn,
    /// Switch on disabled.
    SwitchOnDisabled,
    /// Ready to switch on.
    ReadyToSwitchOn,
    /// Switched on.
    SwitchedOn,
    /// Operation enabled: the motor follows its set-points.
    OperationEnabled,
    /// Quick stop active.
    QuickStopActive,
    /// Fault reaction active.
    FaultReactionActive,
    /// Fault.
    Fault,
}

impl State {
    /// Returns Statusword bits 0–3, 5 and 6.
    pub(super) fn bits(self) -> u16 {
        match self {
            Self::NotReadyToSwitchOn => 0x0000,
            Self::SwitchOnDisabled => 0x0040,
            Self::ReadyToSwitchOn => 0x0021,
            Self::SwitchedOn => 0x0023,
            Self::OperationEnabled => 0x0027,
            Self::QuickStopActive => 0x0007,
            Self::FaultReactionActive => 0x000f,
            Self::Fault => 0x0008,
        }
    }
}

/// The command that a Controlword carries for the power state machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Request {
    DisableVoltage,
    QuickStop,
    Shutdown,
    SwitchOn,
    EnableOperation,
    /// Bit 7 is set and no bit requests less power.
    None,
}

impl Request {
    pub(super) fn decode(controlword: u16) -> Self {
        // A request for less power acts even while bit 7 is set. A request for more power does not.
        match controlword & 0x8f {
            w if w & 0x02 == 0 => Self::DisableVoltage,
            w if w & 0x04 == 0 => Self::QuickStop,
            w if w & 0x80 != 0 => Self::None,
            w if w & 0x01 == 0 => Self::Shutdown,
            w if w & 0x08 == 0 => Self::SwitchOn,
            _ => Self::EnableOperation,
        }
    }
}

/// The deceleration of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ramp {
    /// Profile deceleration, 0x6084.
    SlowDown,
    /// Quick stop deceleration, 0x6085.
    QuickStop,
    /// No ramp: the current limit and the supply voltage determine the deceleration.
    Limit,
}

/// An active stop, and the state that follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stop {
    pub ramp: Ramp,
    /// `None`: hold the axis at standstill.
    pub then: Option<State>,
}

/// 0x605A to 0x605E and 0x6007 as written (CiA 402-2, "device control objects"). A write of an
/// unsupported value is refused: see [`OptionCodes::QUICK_STOP`] and the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct OptionCodes {
    pub quick_stop: i64,
    pub shutdown: i64,
    pub disable: i64,
    pub halt: Option<i64>,
    pub fault: i64,
    pub abort: i64,
}

impl OptionCodes {
    pub(super) const QUICK_STOP: &[i64] = &[0, 1, 2, 3, 4, 5, 6, 7, 8];
    pub(super) const SHUTDOWN: &[i64] = &[0, 1];
    pub(super) const DISABLE: &[i64] = &[0, 1];
    pub(super) const HALT: &[i64] = &[1, 2, 3, 4];
    pub(super) const FAULT: &[i64] = &[0, 1, 2, 3, 4];
    pub(super) const ABORT: &[i64] = &[0, 1, 2, 3];

    fn quick_stop(&self) -> Option<Stop> {
        let ramp = match self.quick_stop {
            1 | 5 => Ramp::SlowDown,
            2 | 6 => Ramp::QuickStop,
            3 | 4 | 7 | 8 => Ramp::Limit,
            _ => return None,
        };
        let then = (self.quick_stop < 5).then_some(State::SwitchOnDisabled);
        Some(Stop { ramp, then })
    }

    pub(super) fn fault_ramp(&self) -> Option<Ramp> {
        match self.fault {
            1 => Some(Ramp::SlowDown),
            2 => Some(Ramp::QuickStop),
            3 | 4 => Some(Ramp::Limit),
            _ => None,
        }
    }

    /// Returns the ramp of a halt. The axis stays enabled in any case.
    pub(super) fn halt_ramp(&self) -> Ramp {
        match self.halt {
            Some(2) => Ramp::QuickStop,
            Some(3 | 4) => Ramp::Limit,
            _ => Ramp::SlowDown,
        }
    }

    /// Returns the reaction of an enabled axis to a communication error. `None`: no reaction.
    pub(super) fn connection_reaction(&self) -> Option<Reaction> {
        match self.abort {
            1 => Some(self.fault_ramp()),
            2 => Some(None),
            3 => Some(Some(Ramp::QuickStop)),
            _ => None,
        }
    }
}

/// The inputs of the state machine for one control cycle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Inputs {
    /// `None`: no Controlword is being received.
    pub request: Option<Request>,
    /// Controlword bit 7 rose and the fault's cause is gone.
    pub reset: bool,
    /// The active stop has ended.
    pub stopped: bool,
    pub options: OptionCodes,
}

/// The self-test after power-on, in control cycles.
const SELF_TEST: u32 = 5;

#[derive(Debug, Clone)]
pub(super) struct Power {
    state: State,
    stop: Option<Stop>,
    hold: Option<State>,
    /// Safe torque off is requested.
    sto: bool,
    /// The enable input is off.
    disabled: bool,
    /// Control cycles until the next automatic transition.
    wait: u32,
    enable_cycles: u32,
}

impl Power {
    pub(super) fn new(enable_cycles: u32) -> Self {
        Self {
            state: State::NotReadyToSwitchOn,
            stop: None,
            hold: None,
            sto: false,
            disabled: false,
            wait: SELF_TEST,
            enable_cycles,
        }
    }

    pub(super) fn state(&self) -> State {
        self.state
    }

    pub(super) fn stop(&self) -> Option<Stop> {
        self.stop
    }

    pub(super) fn hold_in(&mut self, state: Option<State>) {
        self.hold = state;
    }

    /// Requests safe torque off or ends the request. Meanwhile the drive is in Switch on disabled.
    pub(super) fn set_sto(&mut self, on: bool) {
        self.sto = on;
    }

    /// Switches the enable input off or on. Without it the drive reaches Ready to switch on.
    pub(super) fn set_disabled(&mut self, disabled: bool) {
        self.disabled = disabled;
    }

    /// Returns the transition that STO or the missing enable input causes.
    fn inhibited(&mut self) -> Option<(u8, State)> {
        use State as S;
        if self.sto && self.state == S::FaultReactionActive {
            // The fault reaction needs torque.
            self.stop = None;
        }
        match self.state {
            S::ReadyToSwitchOn if self.sto => Some((7, S::SwitchOnDisabled)),
            S::SwitchedOn if self.sto => Some((10, S::SwitchOnDisabled)),
            S::OperationEnabled if self.sto => Some((9, S::SwitchOnDisabled)),
            S::QuickStopActive if self.sto || self.disabled => Some((12, S::SwitchOnDisabled)),
            S::SwitchedOn if self.disabled => Some((6, S::ReadyToSwitchOn)),
            S::OperationEnabled if self.disabled => Some((8, S::ReadyToSwitchOn)),
            _ => None,
        }
    }

    /// True while the output stage drives the winding.
    pub(super) fn powered(&self) -> bool {
        match self.state {
            State::OperationEnabled => true,
            State::QuickStopActive | State::FaultReactionActive => self.stop.is_some(),
            _ => false,
        }
    }

    /// Takes transition 13. With `ramp: None` the motor coasts. Returns false if the drive does not
    /// react.
    pub(super) fn raise(&mut self, ramp: Option<Ramp>) -> bool {
        if matches!(self.state, State::FaultReactionActive | State::Fault) {
            return false;
        }
        let stop = ramp.filter(|_| self.powered()).map(|ramp| Stop {
            ramp,
            then: Some(State::Fault),
        });
        self.go(State::FaultReactionActive, stop)
    }

    /// Runs one control cycle. Returns the number of the CiA 402 transition, for the tests.
    pub(super) fn step(&mut self, inputs: &Inputs) -> Option<u8> {
        use State as S;
        let request = inputs.request.unwrap_or(Request::None);
        if self.sto || self.disabled {
            if let Some((number, to)) = self.inhibited() {
                return self.go(to, None).then_some(number);
            }
            match (self.state, request) {
                (S::SwitchOnDisabled, _) if self.sto => return None,
                (S::ReadyToSwitchOn, Request::SwitchOn | Request::EnableOperation) => return None,
                _ => {}
            }
        }
        if let Some(Stop { then: Some(to), .. }) = self.stop
            && inputs.stopped
        {
            let number = match (self.state, to) {
                (S::FaultReactionActive, _) => 14,
                (S::QuickStopActive, _) => 12,
                (_, S::SwitchedOn) => 5,
                _ => 8,
            };
            return self.go(to, None).then_some(number);
        }
        let (number, to, stop) = match (self.state, request) {
            (S::NotReadyToSwitchOn, _) => {
                self.wait = self.wait.saturating_sub(1);
                if self.wait > 0 {
                    return None;
                }
                (1, S::SwitchOnDisabled, None)
            }
            (S::SwitchOnDisabled, Request::Shutdown) => (2, S::ReadyToSwitchOn, None),
            (S::ReadyToSwitchOn, Request::SwitchOn | Request::EnableOperation) => {
                (3, S::SwitchedOn, None)
            }
            (S::SwitchedOn, Request::EnableOperation) => {
                if self.wait < self.enable_cycles {
                    self.wait += 1;
                    return None;
                }
                (4, S::OperationEnabled, None)
            }
            (S::SwitchedOn, Request::Shutdown) => (6, S::ReadyToSwitchOn, None),
            (S::ReadyToSwitchOn, Request::DisableVoltage | Request::QuickStop) => {
                (7, S::SwitchOnDisabled, None)
            }
            (S::SwitchedOn, Request::DisableVoltage | Request::QuickStop) => {
                (10, S::SwitchOnDisabled, None)
            }
            (S::OperationEnabled, Request::DisableVoltage) => (9, S::SwitchOnDisabled, None),
            (S::OperationEnabled, Request::QuickStop) => {
                (11, S::QuickStopActive, inputs.options.quick_stop())
            }
            (S::OperationEnabled, Request::SwitchOn) => {
                return self.leave(5, S::SwitchedOn, inputs.options.disable);
            }
            (S::OperationEnabled, Request::Shutdown) => {
                return self.leave(8, S::ReadyToSwitchOn, inputs.options.shutdown);
            }
            (S::OperationEnabled, Request::EnableOperation) => {
                // Enabled again during a shutdown or disable ramp.
                self.stop = None;
                return None;
            }
            (S::QuickStopActive, Request::DisableVoltage) => (12, S::SwitchOnDisabled, None),
            (S::QuickStopActive, _) if self.stop.is_none() => (12, S::SwitchOnDisabled, None),
            (S::QuickStopActive, Request::EnableOperation)
                if self.stop.is_some_and(|stop| stop.then.is_none()) =>
            {
                (16, S::OperationEnabled, None)
            }
            (S::FaultReactionActive, _) if self.stop.is_none() => (14, S::Fault, None),
            (S::Fault, _) if inputs.reset => (15, S::SwitchOnDisabled, None),
            _ => return None,
        };
        self.go(to, stop).then_some(number)
    }

    /// Takes transition 5 or 8: at once, or after a ramp during which the state stays.
    fn leave(&mut self, number: u8, to: State, option: i64) -> Option<u8> {
        if option == 1 {
            self.stop = Some(Stop {
                ramp: Ramp::SlowDown,
                then: Some(to),
            });
            return None;
        }
        self.go(to, None).then_some(number)
    }

    /// Handles the end of Controlword reception. Ready to switch on and Switched on go back to
    /// Switch on disabled.
    pub(super) fn abandon(&mut self) {
        if matches!(self.state, State::ReadyToSwitchOn | State::SwitchedOn) {
            self.go(State::SwitchOnDisabled, None);
        }
    }

    fn go(&mut self, to: State, stop: Option<Stop>) -> bool {
        if self.hold == Some(self.state) && to != self.state {
            return false;
        }
        self.state = to;
        self.stop = stop;
        self.wait = 0;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use State as S;

    /// CiA 402 figure "power drive system FSA", without transition 13.
    const ARROWS: [(u8, State, State); 15] = [
        (1, S::NotReadyToSwitchOn, S::SwitchOnDisabled),
        (2, S::SwitchOnDisabled, S::ReadyToSwitchOn),
        (3, S::ReadyToSwitchOn, S::SwitchedOn),
        (4, S::SwitchedOn, S::OperationEnabled),
        (5, S::OperationEnabled, S::SwitchedOn),
        (6, S::SwitchedOn, S::ReadyToSwitchOn),
        (7, S::ReadyToSwitchOn, S::SwitchOnDisabled),
        (8, S::OperationEnabled, S::ReadyToSwitchOn),
        (9, S::OperationEnabled, S::SwitchOnDisabled),
        (10, S::SwitchedOn, S::SwitchOnDisabled),
        (11, S::OperationEnabled, S::QuickStopActive),
        (12, S::QuickStopActive, S::SwitchOnDisabled),
        (14, S::FaultReactionActive, S::Fault),
        (15, S::Fault, S::SwitchOnDisabled),
        (16, S::QuickStopActive, S::OperationEnabled),
    ];

    #[test]
    fn controlwords_cause_only_standard_transitions() {
        let options = OptionCodes {
            quick_stop: 6,
            shutdown: 0,
            disable: 0,
            halt: None,
            fault: 2,
            abort: 3,
        };
        let mut taken = Vec::new();
        for (_, state, _) in ARROWS {
            for word in 0..=u16::MAX {
                for flags in 0..4 {
                    let mut power = Power::new(0);
                    power.state = state;
                    if state == S::QuickStopActive {
                        power.stop = options.quick_stop();
                    }
                    let number = power.step(&Inputs {
                        request: Some(Request::decode(word)),
                        reset: flags & 1 != 0,
                        stopped: flags & 2 != 0,
                        options,
                    });
                    match number {
                        None => assert_eq!(power.state, state),
                        Some(number) => {
                            assert!(ARROWS.contains(&(number, state, power.state)), "{word:x}");
                            taken.push(number);
                        }
                    }
                }
            }
            taken.sort_unstable();
            taken.dedup();
        }
        // Transition 1 waits for the self-test.
        let all = ARROWS.map(|(number, ..)| number);
        assert_eq!(taken, all[1..]);
    }
}
