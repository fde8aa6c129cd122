//! Commands that take effect in the cycle of an instant of common time.
//!
//! They wait outside the queue, so that a stop passes them. All of them take effect in one cycle,
//! or none does: an instant that has passed, a jump of common time and a stop of the machine drop
//! them.

use super::Engine;
use crate::clock::Nanos;
use crate::rt::channel::{COMMANDS_PER_CYCLE, RtCommand};

/// What has become of the last common start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum StartState {
    #[default]
    None,
    /// The commands wait.
    Waits,
    /// The commands took effect.
    Begun { at: u64, cycle: u64 },
    /// The commands were dropped.
    Dropped { at: u64, cause: DropCause },
}

/// Why the commands of a common start were dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DropCause {
    #[error("the instant had passed by {} µs as the cycle took its commands", by_ns / 1000)]
    Passed { by_ns: Nanos },
    #[error("common time has jumped")]
    Jumped,
    #[error("common time is not locked")]
    Unlocked,
    #[error("the machine or a group stops")]
    Stopped,
    #[error("more than {COMMANDS_PER_CYCLE} commands wait for the instant")]
    TooMany,
}

/// Commands that wait for an instant.
#[derive(Debug)]
pub(super) struct DeferredCommands {
    pub state: StartState,
    /// The instant: the multiple of the cycle next to that of the request.
    at: u64,
    commands: Vec<RtCommand>,
    /// The commands of the queue that still belong to them.
    expected: usize,
}

impl DeferredCommands {
    #[allow(clippy::disallowed_methods, reason = "runs before the loop")]
    pub fn new() -> Self {
        Self {
            state: StartState::None,
            at: 0,
            commands: Vec::with_capacity(COMMANDS_PER_CYCLE),
            expected: 0,
        }
    }
}

impl Engine {
    /// Lets the next `count` commands of the queue wait for an instant of common time.
    pub(super) fn defer(&mut self, at: u64, count: usize) {
        match self.deferred.state {
            // A later part of the same start, sent before the sender knew.
            StartState::Begun { at: begun, .. } if begun == at => return,
            StartState::Dropped { at: dropped, .. } if dropped == at => {}
            _ => {
                self.deferred.at = at;
                self.deferred.state = StartState::Waits;
            }
        }
        self.deferred.expected = count;
        let late = self.after_instant();
        if let Some(by_ns) = late.filter(|late| *late >= self.start_window()) {
            self.drop_deferred(DropCause::Passed { by_ns });
        }
    }

    /// Returns true if the command waits or was dropped.
    #[allow(clippy::disallowed_methods, reason = "within the capacity")]
    pub(super) fn take_deferred(&mut self, command: RtCommand) -> bool {
        if self.deferred.expected == 0 {
            return false;
        }
        self.deferred.expected -= 1;
        if self.deferred.state != StartState::Waits {
            self.commands_taken += 1;
        } else if self.deferred.commands.len() < COMMANDS_PER_CYCLE {
            self.deferred.commands.push(command);
        } else {
            self.commands_taken += 1;
            self.drop_deferred(DropCause::TooMany);
        }
        true
    }

    /// Executes the commands that wait if this is their cycle: the one whose pulse of SYNC0 is next
    /// to the instant.
    pub(super) fn begin_deferred(&mut self) {
        if self.deferred.state != StartState::Waits {
            return;
        }
        match self.after_instant() {
            None => {}
            // Commands that are still in the queue would take effect later than these.
            Some(by_ns) if by_ns >= self.start_window() || self.deferred.expected > 0 => {
                self.drop_deferred(DropCause::Passed { by_ns });
            }
            Some(_) => {
                let cycle = self.stats.counters.cycles;
                self.deferred.state = StartState::Begun {
                    at: self.deferred.at,
                    cycle,
                };
                // Counted first: after a panic, no command may seem to be on its way.
                self.commands_taken += self.deferred.commands.len() as u64;
                for index in 0..self.deferred.commands.len() {
                    if let Some(&command) = self.deferred.commands.get(index) {
                        self.take(command);
                    }
                }
                self.deferred.commands.clear();
            }
        }
    }

    /// The time in which the commands may begin. It is longer than a cycle, because the distance
    /// of two pulses in common time changes with the corrections of both clocks.
    const fn start_window(&self) -> Nanos {
        self.config.cycle_ns + self.config.cycle_ns / 4
    }

    /// Returns the time since the begin of the instant's cycle; `None` before it.
    fn after_instant(&self) -> Option<Nanos> {
        let pulse = self.common.pulse_before(self.next)?;
        let begin = self.deferred.at.saturating_sub(self.config.cycle_ns / 2);
        pulse.checked_sub(begin)
    }

    /// Drops the commands, and forgets the instant: it may be requested again.
    pub(super) fn cancel_deferred(&mut self) {
        self.drop_deferred(DropCause::Stopped);
        self.deferred.state = StartState::None;
    }

    pub(super) fn drop_deferred(&mut self, cause: DropCause) {
        if self.deferred.state != StartState::Waits {
            return;
        }
        let at = self.deferred.at;
        self.deferred.state = StartState::Dropped { at, cause };
        self.commands_taken += self.deferred.commands.len() as u64;
        self.deferred.commands.clear();
    }
}
