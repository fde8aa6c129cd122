//! Checks that stop an enabled axis: following error, limits, a lost connection.

use super::control::Demand;
use super::io::input;
use super::modes::Mode;
use super::{DeviceError, Drive, State, fault};

const LIMIT_SWITCHES: u32 = 1 << input::NEGATIVE_LIMIT | 1 << input::POSITIVE_LIMIT;

impl Drive {
    /// Handles a communication error. Only an enabled axis reacts.
    pub(crate) fn error(&mut self, error: DeviceError) {
        if !self.enabled() {
            return;
        }
        match error {
            DeviceError::RxPdoTimeout if !self.mode.is_some_and(Mode::is_cyclic) => {}
            DeviceError::RxPdoTimeout | DeviceError::SyncLost | DeviceError::BusDown => {
                self.lose_connection(error);
            }
        }
    }

    /// Reacts as 0x6007 demands.
    pub(super) fn lose_connection(&mut self, error: DeviceError) {
        if let Some(reaction) = self.parameters.options.connection_reaction() {
            self.raise(error.code(), reaction);
        }
    }

    pub(super) fn raise(&mut self, code: u16, reaction: fault::Reaction) {
        let already = matches!(
            self.power.state(),
            State::FaultReactionActive | State::Fault
        );
        self.motion.fail_homing();
        if self.power.raise(reaction) || already {
            self.faults.latch(code);
        }
    }

    /// Checks following error and position limits.
    pub(super) fn supervise(&mut self, demand: &Demand) {
        if self.power.state() != State::OperationEnabled {
            return;
        }
        let counts = self.controller.counts();
        let error = self.motion.following_error(demand, counts).abs();
        let outside = self
            .parameters
            .following_window
            .is_some_and(|window| error > window);
        self.following_error = outside;
        self.following_cycles = if outside {
            self.following_cycles.saturating_add(1)
        } else {
            0
        };
        let ramp = self.parameters.options.fault_ramp();
        if let Some(code) = self.struck_limit(demand) {
            self.raise(code, ramp);
        } else if outside && self.following_cycles > self.parameters.following_timeout {
            self.raise(fault::FOLLOWING_ERROR, ramp);
        } else if let Some((min, max)) = self.parameters.software_limits
            && !matches!(demand, Demand::Position { .. })
        {
            // Position set-points are clamped to the limits. Speed and torque modes can only be
            // stopped.
            let (at, speed) = (counts + self.frame.shift, self.controller.velocity());
            if (at > max && speed > 0.0) || (at < min && speed < 0.0) {
                self.raise(fault::SOFTWARE_POSITION_LIMIT, ramp);
            }
        }
    }

    pub(super) fn at_limit_switch(&self) -> bool {
        self.enabled() && self.inputs.all() & LIMIT_SWITCHES != 0
    }

    /// Returns the fault if the axis ran onto a limit switch or is commanded further onto it.
    /// Homing handles the switches itself.
    fn struck_limit(&self, demand: &Demand) -> Option<u16> {
        if self.inputs.all() & LIMIT_SWITCHES == 0 || self.mode == Some(Mode::Homing) {
            return None;
        }
        let speed = match demand {
            Demand::Torque(_) => self.controller.velocity(),
            _ => self.motion.demanded().1,
        };
        let speed = if self.is_slow(speed) { 0.0 } else { speed };
        let struck = |bit| self.inputs.rose(bit) && !self.stands();
        let onto = |bit, further: bool| self.inputs.is_on(bit) && (further || struck(bit));
        if onto(input::NEGATIVE_LIMIT, speed < 0.0) {
            Some(fault::NEGATIVE_LIMIT_SWITCH)
        } else if onto(input::POSITIVE_LIMIT, speed > 0.0) {
            Some(fault::POSITIVE_LIMIT_SWITCH)
        } else {
            None
        }
    }
}
