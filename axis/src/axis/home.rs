//! Homing: executes the requests of the sequence and applies the new position.

use super::{Axis, AxisConfig, ControlledQuantity};
use crate::cia402::{Mode, ModeCommand, ModeStatus};
use crate::homing::{HomingError, HomingInputs, HomingOutputs, Outcome, Sequence};
use crate::status::{CommandError, HomingStatus, PositionValidity};

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct HomingRun {
    sequence: Option<Sequence>,
    order: Option<HomingOutputs>,
    pub(super) status: HomingStatus,
    pub(super) validity: PositionValidity,
}

impl HomingRun {
    pub(super) fn of(config: &AxisConfig) -> Self {
        let validity = if config.absolute && config.absolute_start {
            PositionValidity::Absolute
        } else if config.home.is_some() {
            PositionValidity::Unknown
        } else {
            PositionValidity::Unreferenced
        };
        Self {
            validity,
            ..Self::default()
        }
    }

    pub(super) const fn running(&self) -> bool {
        self.sequence.is_some()
    }

    /// Returns true if the search is over and nothing remains but the switch back.
    pub(super) fn leaves(&self) -> bool {
        self.sequence.is_some_and(|sequence| sequence.leaves())
    }

    /// Ends a search with an error. The first one remains.
    pub(super) fn abort(&mut self, error: HomingError) {
        if let Some(sequence) = &mut self.sequence {
            sequence.abort(error);
        }
    }

    pub(super) fn bits(&self) -> ModeCommand {
        self.order
            .map_or(ModeCommand::Nothing, |order| ModeCommand::Hm {
                start: order.start,
                halt: order.halt,
            })
    }

    /// Returns true while the drive is commanded to halt (Controlword bit 8).
    pub(super) fn is_halted(&self) -> bool {
        self.order.is_some_and(|order| order.halt)
    }

    /// Notes that home is no longer where it was.
    pub(super) fn invalidate(&mut self) {
        if self.validity.is_homed() {
            self.validity = PositionValidity::Unknown;
        }
    }

    fn end(&mut self, status: HomingStatus) {
        if self.validity == PositionValidity::Homing {
            self.validity = PositionValidity::Unknown;
        }
        self.sequence = None;
        self.order = None;
        self.status = status;
    }
}

impl Axis {
    /// Takes the position of a drive that has restarted as it is. `same`: it is the drive that was
    /// there before. Home is kept only by the absolute encoder of the same drive.
    pub fn restarted(&mut self, same: bool) {
        let kept = same && self.config.absolute;
        if !kept {
            self.home.invalidate();
        }
        self.cancel_mode_cycle();
        self.actual
            .start_over(&self.config.scale, &self.compensation, kept);
        self.restart_second_encoder();
    }

    pub(super) fn check_home(&self, timeout_s: f64) -> Result<(), CommandError> {
        if !timeout_s.is_finite() {
            return Err(CommandError::NotFinite {
                what: "time limit",
                value: timeout_s,
            });
        }
        if timeout_s <= 0.0 {
            return Err(CommandError::Negative {
                what: "time limit",
                value: timeout_s,
            });
        }
        self.check_switch(Mode::Hm)
    }

    pub(super) fn home(&mut self, timeout_s: f64) -> Result<(), CommandError> {
        self.check_home(timeout_s)?;
        self.switch_failed = None;
        self.forget_target();
        self.home_second_encoder();
        self.home = HomingRun {
            sequence: Some(Sequence::new(self.mode, timeout_s)),
            order: None,
            status: HomingStatus::Running,
            validity: PositionValidity::Homing,
        };
        Ok(())
    }

    /// Returns the reported and the configured home position if the drive does not stand there.
    fn home_elsewhere(&self) -> Option<[f64; 2]> {
        let home = self.config.home?;
        let expected = home.position?;
        let reported = self.actual.restarted(&self.config.scale)?;
        let off = (reported - expected).abs() > home.window;
        off.then_some([reported, expected])
    }

    /// Advances the homing sequence, once per cycle and after the mode switch.
    pub(super) fn settle_homing(&mut self, fresh: bool, dt_s: f64) {
        let Some(sequence) = self.home.sequence.filter(|_| self.mode_cycle.is_none()) else {
            return;
        };
        if !self.follows() {
            let refused = self.switch_failed == Some(Mode::Hm);
            self.mode = sequence.back();
            let error = if sequence.attained() {
                None
            } else if refused {
                Some(HomingError::ModeRefused)
            } else {
                Some(HomingError::PowerLost)
            };
            self.home
                .end(error.map_or(HomingStatus::Attained, HomingStatus::Failed));
            return;
        }
        let ordered = self.home.order.map(|order| order.mode);
        let ModeStatus::Hm(state) = self.statusword.in_mode(Mode::Hm) else {
            return;
        };
        let seen = HomingInputs {
            mode: self.mode,
            mode_failed: self.switch.is_none()
                && ordered.is_some()
                && self.switch_failed == ordered,
            state,
            standing: self.at_standstill(),
            moves: self.config.home.is_none_or(|home| home.moves),
            elsewhere: self.home_elsewhere(),
            fresh,
        };
        let before = sequence.attained();
        let (sequence, order, outcome) = sequence.step(&seen, dt_s);
        self.home.sequence = Some(sequence);
        self.home.order = Some(order);
        if sequence.attained() && !before {
            self.home.validity = if self.config.absolute {
                PositionValidity::Absolute
            } else {
                PositionValidity::Homed
            };
            self.actual.reference();
            self.actual
                .start_over(&self.config.scale, &self.compensation, false);
        }
        match outcome {
            Outcome::Running if order.mode != self.mode => {
                if self.switching() != Some(order.mode) && self.switch_failed != Some(order.mode) {
                    self.begin_switch_late(order.mode);
                }
            }
            Outcome::Running => {}
            Outcome::Attained => self.home.end(HomingStatus::Attained),
            Outcome::Failed(error) => self.home.end(HomingStatus::Failed(error)),
        }
    }

    /// Checks all conditions for a switch to mode `to`.
    pub(super) fn check_switch(&self, to: Mode) -> Result<(), CommandError> {
        if !(self.config.modes.contains(to) || to == self.config.mode) {
            return Err(CommandError::ModeNotOffered { mode: to });
        }
        self.check_ready()?;
        if to == self.mode {
            return Ok(());
        }
        if self.mode_display.is_none() {
            return Err(CommandError::NoModeDisplay);
        }
        let control = self.config.control(to);
        if control == ControlledQuantity::Position && self.actual.counts().is_none() {
            return Err(CommandError::NoPosition { mode: to });
        }
        // The deceleration is unknown in these modes.
        let unpowered = self.config.mode_change_unpowered;
        let rest = matches!(to, Mode::Pp | Mode::Hm) || unpowered;
        let rests = self.setpoint_at_rest() && self.at_standstill();
        // A set-point that turns back rests for a cycle, and goes on until the power is removed.
        if rest && !(rests && (!unpowered || self.setpoint_arrived())) {
            return Err(CommandError::StillMoving {
                velocity: self.actual.velocity(),
            });
        }
        Ok(())
    }
}
