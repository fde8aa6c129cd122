//! Homing: the sequence's orders carried out, and the new position taken over.

use super::{Axis, Control};
use crate::cia402::{Mode, ModeCommand, ModeStatus};
use crate::homing::{HomingError, Order, Outcome, Seen, Sequence};
use crate::status::{HomingStatus, Refused};

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Home {
    sequence: Option<Sequence>,
    order: Option<Order>,
    pub(super) status: HomingStatus,
    /// Home was found, and not searched anew since.
    pub(super) homed: bool,
}

impl Home {
    pub(super) const fn running(&self) -> bool {
        self.sequence.is_some()
    }

    pub(super) fn abort(&mut self) {
        if let Some(sequence) = &mut self.sequence {
            sequence.abort();
        }
    }

    pub(super) fn bits(&self) -> ModeCommand {
        self.order
            .map_or(ModeCommand::Nothing, |order| ModeCommand::Hm {
                start: order.start,
                halt: order.halt,
            })
    }

    fn end(&mut self, status: HomingStatus) {
        self.sequence = None;
        self.order = None;
        self.status = status;
    }
}

impl Axis {
    pub(super) fn home(&mut self, timeout_s: f64) -> Result<(), Refused> {
        if !timeout_s.is_finite() {
            return Err(Refused::NotFinite {
                what: "time limit",
                value: timeout_s,
            });
        }
        if timeout_s <= 0.0 {
            return Err(Refused::Negative {
                what: "time limit",
                value: timeout_s,
            });
        }
        self.check_switch(Mode::Hm)?;
        self.switch_failed = None;
        self.home = Home {
            sequence: Some(Sequence::new(self.mode, timeout_s)),
            order: None,
            status: HomingStatus::Running,
            homed: false,
        };
        Ok(())
    }

    /// Once a cycle, after the mode.
    pub(super) fn settle_homing(&mut self, fresh: bool, dt_s: f64) {
        let Some(sequence) = self.home.sequence else {
            return;
        };
        if !self.active {
            self.mode = sequence.back();
            let error = if sequence.attained() {
                None
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
        let seen = Seen {
            mode: self.mode,
            mode_failed: self.switch.is_none()
                && ordered.is_some()
                && self.switch_failed == ordered,
            state,
            standing: self.standing(),
            fresh,
        };
        let before = sequence.attained();
        let (sequence, order, outcome) = sequence.step(&seen, dt_s);
        self.home.sequence = Some(sequence);
        self.home.order = Some(order);
        if sequence.attained() && !before {
            self.home.homed = true;
            self.actual.start_over(&self.config.scale);
        }
        match outcome {
            Outcome::Running if order.mode != self.mode => {
                if self.switch.map(|switch| switch.to) != Some(order.mode)
                    && self.switch_failed != Some(order.mode)
                {
                    self.begin_switch_late(order.mode);
                }
            }
            Outcome::Running => {}
            Outcome::Attained => self.home.end(HomingStatus::Attained),
            Outcome::Failed(error) => self.home.end(HomingStatus::Failed(error)),
        }
    }

    /// Everything that speaks against a switch to this mode now.
    pub(super) fn check_switch(&self, to: Mode) -> Result<(), Refused> {
        if !(self.config.modes.contains(to) || to == self.config.mode) {
            return Err(Refused::ModeNotOffered { mode: to });
        }
        self.check_ready()?;
        if to == self.mode {
            return Ok(());
        }
        if self.mode_display.is_none() {
            return Err(Refused::NoModeDisplay);
        }
        let control = self.config.control(to);
        if control == Control::Position && self.actual.counts().is_none() {
            return Err(Refused::NoPosition { mode: to });
        }
        // Nobody knows how these would brake.
        let rest = matches!(to, Mode::Pp | Mode::Hm);
        if rest && !(self.setpoint_at_rest() && self.standing()) {
            return Err(Refused::StillMoving {
                velocity: self.actual.velocity(),
            });
        }
        Ok(())
    }
}
