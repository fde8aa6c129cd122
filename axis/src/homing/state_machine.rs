//! Switch to homing mode and back, as a pure state machine.
//!
//! Bit 4 acts on its rising edge, so it is low for at least one cycle first. Until the drive can
//! have seen the edge, its state refers to the previous homing. However a homing ends, the axis
//! stands before the mode changes back.

use crate::cia402::{HomingState, Mode};

/// Longest time in seconds after the start in which an error may refer to the previous homing.
/// "Attained" counts only after the drive has cleared it: an old one would end the search at once.
const STALE_S: f64 = 0.1;

/// Time in seconds for which an axis with "attained" stands, without "target reached" (bit 10),
/// until its homing has ended.
const SETTLE_S: f64 = 0.1;

/// Time in seconds that the drive has to show the new origin in 0x6064.
const ORIGIN_S: f64 = 0.5;

/// Time in seconds that an axis must stand before the mode changes back. A mode that takes over
/// earlier would end the deceleration at that position, perhaps with a last step further onto a
/// limit switch.
const REST_S: f64 = 0.05;

/// The reason why the home position is unknown.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum HomingError {
    /// The search took too long.
    #[error("home was not found within {} s", (timeout_s * 1e3).round() / 1e3)]
    Timeout {
        /// The time limit in seconds.
        timeout_s: f64,
    },
    /// Statusword bit 12 (homing attained) was set from the start on.
    #[error(
        "the drive has shown \"homing attained\" (Statusword bit 12) since before the search: it may \
         be that of an earlier homing"
    )]
    NeverCleared,
    /// The drive reports home, and another position.
    #[error(
        "the drive reports home, and a position (0x6064) of {reported:.4} instead of {expected:.4}"
    )]
    Elsewhere {
        /// The reported position.
        reported: f64,
        /// The configured home position.
        expected: f64,
    },
    /// The drive reports an error (Statusword bit 13).
    #[error("the drive reports a homing error")]
    Drive,
    /// A command ended homing.
    #[error("homing was aborted")]
    Aborted,
    /// A hold ended homing.
    #[error("a hold ended homing")]
    Held,
    /// 0x6061 did not show mode 6.
    #[error("the drive did not change to homing mode")]
    ModeRefused,
    /// The drive left Operation enabled.
    #[error("the axis lost its power while homing")]
    PowerLost,
}

/// Inputs of the sequence in one cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HomingInputs {
    /// The active mode, as 0x6061 shows it.
    pub mode: Mode,
    /// True if the last requested mode switch has failed.
    pub mode_failed: bool,
    /// Bits 13, 12 and 10; only valid in homing mode.
    pub state: HomingState,
    pub standing: bool,
    /// False if the method sets home where the axis is.
    pub moves: bool,
    /// The reported and the configured home position, if the drive does not stand there.
    pub elsewhere: Option<[f64; 2]>,
    /// False after a lost frame: the inputs are old.
    pub fresh: bool,
}

/// Requests of the sequence in one cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HomingOutputs {
    pub mode: Mode,
    /// Controlword bit 4.
    pub start: bool,
    /// Controlword bit 8.
    pub halt: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    Running,
    /// Home is known, and the axis is back in its mode.
    Attained,
    /// Homing failed. The axis is back in its mode, or still in homing mode if
    /// [`HomingInputs::mode_failed`] is set.
    Failed(HomingError),
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    Enter,
    /// Homing mode with bit 4 low.
    Prepare,
    Search {
        /// The drive has shown that it searches: neither "attained" nor "error".
        cleared: bool,
        elapsed_s: f64,
        /// Time in seconds for which the axis has been standing with "attained".
        attained_s: f64,
    },
    /// Halted because of `error`.
    Halt {
        error: HomingError,
        stood_s: f64,
    },
    Leave {
        result: Result<(), HomingError>,
    },
    Done {
        result: Result<(), HomingError>,
    },
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sequence {
    phase: Phase,
    back: Mode,
    timeout_s: f64,
}

impl Sequence {
    /// Creates a sequence from mode `back` into homing and back. `timeout_s` limits the search.
    #[must_use]
    pub const fn new(back: Mode, timeout_s: f64) -> Self {
        Self {
            phase: Phase::Enter,
            back,
            timeout_s,
        }
    }

    /// Returns the mode before and after homing.
    #[must_use]
    pub const fn back(&self) -> Mode {
        self.back
    }

    /// Returns true once home was found: positions then refer to the new origin.
    #[must_use]
    pub const fn attained(&self) -> bool {
        matches!(
            self.phase,
            Phase::Leave { result: Ok(()) } | Phase::Done { result: Ok(()) }
        )
    }

    /// Returns true if nothing remains but the switch back.
    #[must_use]
    pub const fn leaves(&self) -> bool {
        matches!(self.phase, Phase::Leave { .. })
    }

    /// Halts the axis and switches back. Has no effect after the end of the search.
    pub fn abort(&mut self, error: HomingError) {
        self.phase = match self.phase {
            Phase::Enter | Phase::Prepare => Phase::Leave { result: Err(error) },
            Phase::Search { .. } => Phase::halt(error),
            over => over,
        };
    }

    /// Runs one cycle. Pure.
    #[must_use]
    pub fn step(mut self, seen: &HomingInputs, dt_s: f64) -> (Self, HomingOutputs, Outcome) {
        self.phase = self.phase.next(seen, self.back, self.timeout_s, dt_s);
        let homing = |start, halt| HomingOutputs {
            mode: Mode::Hm,
            start,
            halt,
        };
        let back = HomingOutputs {
            mode: self.back,
            start: false,
            halt: false,
        };
        let (order, outcome) = match self.phase {
            Phase::Enter | Phase::Prepare => (homing(false, false), Outcome::Running),
            Phase::Search { .. } => (homing(true, false), Outcome::Running),
            Phase::Halt { .. } => (homing(true, true), Outcome::Running),
            Phase::Leave { .. } => (back, Outcome::Running),
            Phase::Done { result: Ok(()) } => (back, Outcome::Attained),
            Phase::Done { result: Err(error) } => (back, Outcome::Failed(error)),
        };
        (self, order, outcome)
    }
}

impl Phase {
    fn next(self, seen: &HomingInputs, back: Mode, timeout_s: f64, dt_s: f64) -> Self {
        match self {
            Self::Enter if seen.mode_failed => Self::Done {
                result: Err(HomingError::ModeRefused),
            },
            Self::Enter if seen.fresh && seen.mode == Mode::Hm => Self::Prepare,
            Self::Prepare if seen.fresh => Self::Search {
                cleared: !(seen.state.is_attained() || seen.state.is_error()),
                elapsed_s: 0.0,
                attained_s: 0.0,
            },
            Self::Search {
                cleared,
                elapsed_s,
                attained_s,
            } => {
                let elapsed_s = elapsed_s + dt_s;
                let (attained, error) = (seen.state.is_attained(), seen.state.is_error());
                let cleared = cleared || seen.fresh && !attained && !error;
                let evident = attained && seen.standing && (cleared || !seen.moves);
                let attained_s = match (seen.fresh, evident) {
                    (false, _) => attained_s,
                    (true, true) => attained_s + dt_s,
                    (true, false) => 0.0,
                };
                let ended = seen.state == HomingState::Completed || attained_s >= SETTLE_S;
                if seen.fresh && error && (cleared || elapsed_s >= STALE_S) {
                    Self::halt(HomingError::Drive)
                } else if seen.fresh && evident && ended && seen.elsewhere.is_none() {
                    Self::Leave { result: Ok(()) }
                } else if let Some([reported, expected]) = seen.elsewhere
                    && attained_s > ORIGIN_S
                {
                    Self::halt(HomingError::Elsewhere { reported, expected })
                } else if elapsed_s > timeout_s {
                    Self::halt(if cleared || !attained {
                        HomingError::Timeout { timeout_s }
                    } else {
                        HomingError::NeverCleared
                    })
                } else {
                    Self::Search {
                        cleared,
                        elapsed_s,
                        attained_s,
                    }
                }
            }
            Self::Halt { error, stood_s } => {
                let stood_s = match (seen.fresh, seen.standing) {
                    (false, _) => stood_s,
                    (true, true) => stood_s + dt_s,
                    (true, false) => 0.0,
                };
                // A drive that ignores the halt is stopped by the supervision of the axis.
                if stood_s > REST_S {
                    Self::Leave { result: Err(error) }
                } else {
                    Self::Halt { error, stood_s }
                }
            }
            Self::Leave { result } if seen.mode == back || seen.mode_failed => {
                Self::Done { result }
            }
            same => same,
        }
    }

    const fn halt(error: HomingError) -> Self {
        Self::Halt {
            error,
            stood_s: 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 0.001;

    fn seen(mode: Mode, state: HomingState, standing: bool) -> HomingInputs {
        HomingInputs {
            mode,
            mode_failed: false,
            state,
            standing,
            moves: true,
            elsewhere: None,
            fresh: true,
        }
    }

    /// Steps over rows of (mode, state, standing) × cycles. Returns the sequence, the last request
    /// and the outcome.
    fn run(
        mut sequence: Sequence,
        rows: &[(Mode, HomingState, bool, u32)],
    ) -> (Sequence, HomingOutputs, Outcome) {
        let mut last = None;
        for &(mode, state, standing, cycles) in rows {
            for _ in 0..cycles {
                let (next, order, outcome) = sequence.step(&seen(mode, state, standing), DT);
                sequence = next;
                last = Some((order, outcome));
            }
        }
        let (order, outcome) = last.unwrap();
        (sequence, order, outcome)
    }

    fn new() -> Sequence {
        Sequence::new(Mode::Csp, 5.0)
    }

    const HM: Mode = Mode::Hm;
    const CSP: Mode = Mode::Csp;

    #[test]
    fn sequence_switches_to_homing_and_back() {
        use HomingState::*;
        let order = |mode, start, halt| HomingOutputs { mode, start, halt };
        let rows: &[(Mode, HomingState, bool, u32, HomingOutputs, Outcome)] = &[
            (
                CSP,
                NotStarted,
                true,
                10,
                order(HM, false, false),
                Outcome::Running,
            ),
            (
                HM,
                NotStarted,
                true,
                1,
                order(HM, false, false),
                Outcome::Running,
            ),
            (
                HM,
                NotStarted,
                true,
                1,
                order(HM, true, false),
                Outcome::Running,
            ),
            (
                HM,
                InProgress,
                false,
                2000,
                order(HM, true, false),
                Outcome::Running,
            ),
            (
                HM,
                AttainedNotReached,
                false,
                300,
                order(HM, true, false),
                Outcome::Running,
            ),
            (
                HM,
                Completed,
                true,
                1,
                order(CSP, false, false),
                Outcome::Running,
            ),
            (
                HM,
                NotStarted,
                true,
                5,
                order(CSP, false, false),
                Outcome::Running,
            ),
            (
                CSP,
                NotStarted,
                true,
                1,
                order(CSP, false, false),
                Outcome::Attained,
            ),
        ];
        let mut sequence = new();
        for &(mode, state, standing, cycles, expected, outcome) in rows {
            let (next, order, now) = run(sequence, &[(mode, state, standing, cycles)]);
            assert_eq!((order, now), (expected, outcome), "{state:?}");
            sequence = next;
        }
        assert!(sequence.attained());
    }

    #[test]
    fn state_of_the_previous_homing_is_ignored() {
        use HomingState::*;
        for old in [Completed, ErrorStanding] {
            let before = [(HM, old, true, 2), (HM, old, true, 50)];
            let (sequence, order, outcome) = run(new(), &before);
            assert_eq!((order.start, outcome), (true, Outcome::Running));
            let (_, order, _) = run(
                sequence,
                &[(HM, InProgress, false, 10), (HM, Completed, true, 1)],
            );
            assert_eq!(order.mode, CSP);
        }
        // Never cleared: it may be that of an earlier homing.
        let (mut sequence, order, _) = run(new(), &[(HM, Completed, true, 5010)]);
        assert!(order.halt && !sequence.attained());
        for _ in 0..60 {
            (sequence, _, _) = sequence.step(&seen(HM, Completed, true), DT);
        }
        let (_, _, outcome) = sequence.step(&seen(CSP, NotStarted, true), DT);
        assert_eq!(outcome, Outcome::Failed(HomingError::NeverCleared));
        // A method without motion may end before the first answer.
        let mut sequence = new();
        for _ in 0..3 {
            let there = HomingInputs {
                moves: false,
                ..seen(HM, Completed, true)
            };
            (sequence, _, _) = sequence.step(&there, DT);
        }
        assert!(sequence.attained());
    }

    #[test]
    fn sequence_reports_each_failure() {
        use HomingState::*;
        let start = (HM, NotStarted, true, 3);
        let search = (HM, InProgress, false, 100);
        // An error while moving: halt, stand, switch back.
        let (sequence, order, _) = run(new(), &[start, search, (HM, ErrorMoving, false, 5)]);
        assert!(order.halt && order.mode == HM);
        let (sequence, order, _) = run(sequence, &[(HM, ErrorStanding, true, 60)]);
        assert_eq!(order.mode, CSP);
        let (_, _, outcome) = run(sequence, &[(CSP, NotStarted, true, 1)]);
        assert_eq!(outcome, Outcome::Failed(HomingError::Drive));
        // Home is never found, and the axis never stands.
        let (sequence, order, _) = run(new(), &[start, (HM, InProgress, false, 5010)]);
        assert!(order.halt);
        let rest = [
            (HM, InProgress, false, 2100),
            (HM, NotStarted, true, 60),
            (CSP, NotStarted, true, 1),
        ];
        let (_, _, outcome) = run(sequence, &rest);
        let timeout = HomingError::Timeout { timeout_s: 5.0 };
        assert_eq!(outcome, Outcome::Failed(timeout));
        assert_eq!(timeout.to_string(), "home was not found within 5 s");
        let timeout_s = 60e9 * 1e-9;
        let timeout = HomingError::Timeout { timeout_s };
        assert_eq!(timeout.to_string(), "home was not found within 60 s");
        // Aborted in each phase.
        for rows in [
            &[(CSP, NotStarted, true, 3)][..],
            &[start],
            &[start, search],
        ] {
            let (mut sequence, _, _) = run(new(), rows);
            sequence.abort(HomingError::Aborted);
            let rest = [(HM, NotStarted, true, 60), (CSP, NotStarted, true, 1)];
            let (_, order, outcome) = run(sequence, &rest);
            assert_eq!(outcome, Outcome::Failed(HomingError::Aborted));
            assert!(!order.start && !order.halt);
        }
        // The mode is not available.
        let refused = HomingInputs {
            mode_failed: true,
            ..seen(CSP, NotStarted, true)
        };
        let (_, _, outcome) = new().step(&refused, DT);
        assert_eq!(outcome, Outcome::Failed(HomingError::ModeRefused));
    }

    #[test]
    fn abort_after_the_end_changes_nothing() {
        let (mut sequence, _, _) = run(
            new(),
            &[
                (HM, HomingState::NotStarted, true, 3),
                (HM, HomingState::Completed, true, 1),
            ],
        );
        sequence.abort(HomingError::Aborted);
        let (_, _, outcome) = run(sequence, &[(CSP, HomingState::NotStarted, true, 1)]);
        assert_eq!(outcome, Outcome::Attained);
    }
}
