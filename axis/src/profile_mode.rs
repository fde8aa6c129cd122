//! Profiles of the drive: set-points of PP by handshake, the velocity of PV, and their halt.
//!
//! PP: bit 4 rises together with the target, and the drive answers with Statusword bit 12. Bit 4
//! falls, then bit 12. Only then does "target reached" (bit 10) refer to the new target. The target
//! is constant from the rising edge on.

use crate::cia402::ModeCommand;

/// Time in seconds within which the drive must acknowledge a set-point.
const ACKNOWLEDGE_S: f64 = 1.0;

/// The goal of the drive's profile, in user units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Goal {
    /// PP: position. PV: velocity.
    pub target: f64,
    /// PP: profile velocity (0x6081). PV: unused.
    pub velocity: f64,
    /// Profile acceleration and deceleration (0x6083, 0x6084).
    pub acceleration: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// No goal, or the goal was cancelled.
    Idle,
    /// Waits until bit 12 is low.
    Waiting,
    Raised,
    Lowered,
    Running,
    Reached,
    /// The drive did not answer in time.
    NotTaken,
}

/// Handshake and goals of one axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    phase: Phase,
    in_phase_s: f64,
    /// The goal that the drive has or receives now.
    goal: Option<Goal>,
    next: Option<Goal>,
    halt: bool,
    /// The override of the profile velocity. At 0 the drive is halted on its way.
    rate: f64,
    /// The override that the drive has received.
    sent_rate: f64,
}

impl Default for Profile {
    fn default() -> Self {
        Self::new()
    }
}

impl Profile {
    #[must_use]
    pub const fn new() -> Self {
        Self {
            phase: Phase::Idle,
            in_phase_s: 0.0,
            goal: None,
            next: None,
            halt: false,
            rate: 1.0,
            sent_rate: 1.0,
        }
    }

    /// Sets a new target position, which replaces the present one.
    pub const fn go_to(&mut self, goal: Goal) {
        self.next = Some(goal);
        if matches!(
            self.phase,
            Phase::Idle | Phase::Running | Phase::Reached | Phase::NotTaken
        ) {
            self.enter(Phase::Waiting);
        }
    }

    /// Sets a new target velocity.
    pub const fn run_at(&mut self, goal: Goal) {
        self.goal = Some(goal);
        self.halt = false;
    }

    /// Stops with the drive's halt (0x605D) and discards the goal.
    pub const fn halt(&mut self) {
        *self = Self {
            halt: true,
            ..Self::new()
        };
    }

    /// Sets the override. The drive takes another velocity with the same target again.
    pub fn set_rate(&mut self, rate: f64) {
        self.rate = rate;
        if rate == 0.0 {
            // While it halts, a drive reports standstill as "target reached" (bit 10), so the
            // target is set again after a hold.
            self.sent_rate = 0.0;
        } else if rate != self.sent_rate && self.phase == Phase::Running {
            self.next = self.goal;
            self.enter(Phase::Waiting);
        }
    }

    const fn enter(&mut self, phase: Phase) {
        self.phase = phase;
        self.in_phase_s = 0.0;
    }

    /// Runs one fresh cycle of PP. `acknowledged`: Statusword bit 12. `reached`: bit 10.
    pub fn step(&mut self, acknowledged: bool, reached: bool, dt_s: f64) {
        if self.phase == Phase::Waiting && self.rate == 0.0 {
            // A new target would end the halt.
            return;
        }
        self.in_phase_s += dt_s;
        let late = self.in_phase_s > ACKNOWLEDGE_S;
        match self.phase {
            Phase::Waiting if !acknowledged => {
                self.goal = self.next.take();
                self.halt = false;
                self.sent_rate = self.rate;
                self.enter(Phase::Raised);
            }
            Phase::Raised if acknowledged => self.enter(Phase::Lowered),
            Phase::Lowered if !acknowledged => {
                self.enter(if self.next.is_some() {
                    Phase::Waiting
                } else {
                    Phase::Running
                });
            }
            Phase::Waiting | Phase::Raised | Phase::Lowered if late => {
                self.enter(Phase::NotTaken);
            }
            Phase::Running if reached && self.rate > 0.0 => self.enter(Phase::Reached),
            _ => {}
        }
    }

    /// Returns the Controlword bits of PP.
    #[must_use]
    pub const fn position_bits(&self) -> ModeCommand {
        let raised = matches!(self.phase, Phase::Raised);
        ModeCommand::Pp {
            new_set_point: raised,
            change_at_once: raised,
            relative: false,
            halt: self.halt || self.rate == 0.0,
        }
    }

    /// Returns the Controlword bits of PV.
    #[must_use]
    pub const fn velocity_bits(&self) -> ModeCommand {
        ModeCommand::Pv { halt: self.halt }
    }

    #[must_use]
    pub const fn goal(&self) -> Option<&Goal> {
        self.goal.as_ref()
    }

    /// Returns true while the drive is commanded to halt (Controlword bit 8).
    #[must_use]
    pub fn is_halted(&self) -> bool {
        self.halt || self.rate == 0.0
    }

    /// PP: returns true while a target is pending.
    #[must_use]
    pub const fn pending(&self) -> bool {
        matches!(
            self.phase,
            Phase::Waiting | Phase::Raised | Phase::Lowered | Phase::Running
        )
    }

    /// PP: returns true if the drive reports that the target is reached.
    #[must_use]
    pub const fn reached(&self) -> bool {
        matches!(self.phase, Phase::Reached)
    }

    /// PP: returns true if the drive did not acknowledge the set-point, or did not clear its
    /// acknowledgement.
    #[must_use]
    pub const fn not_taken(&self) -> bool {
        matches!(self.phase, Phase::NotTaken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 0.001;

    const fn to(target: f64) -> Goal {
        Goal {
            target,
            velocity: 1.0,
            acceleration: 1.0,
        }
    }

    fn word(profile: &Profile) -> (bool, bool) {
        match profile.position_bits() {
            ModeCommand::Pp {
                new_set_point,
                halt,
                ..
            } => (new_set_point, halt),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn handshake_row_by_row() {
        let mut profile = Profile::new();
        profile.go_to(to(5.0));
        // Bit 12, bit 10 → bit 4, pending.
        for (acknowledged, reached, raised, pending) in [
            (true, true, false, true),
            (false, true, true, true),
            (false, true, true, true),
            (true, true, false, true),
            (true, false, false, true),
            (false, false, false, true),
            (false, false, false, true),
            (false, true, false, false),
        ] {
            profile.step(acknowledged, reached, DT);
            assert_eq!((word(&profile).0, profile.pending()), (raised, pending));
        }
        assert!(profile.reached() && profile.goal() == Some(&to(5.0)));
    }

    #[test]
    fn new_target_waits_for_the_handshake_of_the_previous_one() {
        let mut profile = Profile::new();
        profile.go_to(to(5.0));
        profile.step(false, false, DT);
        profile.go_to(to(6.0));
        assert_eq!(profile.goal(), Some(&to(5.0)), "bit 4 is up");
        profile.step(true, false, DT);
        profile.step(false, false, DT);
        assert!(!word(&profile).0);
        profile.step(false, false, DT);
        assert!(word(&profile).0);
        assert_eq!(profile.goal(), Some(&to(6.0)));
    }

    #[test]
    fn halt_lasts_until_the_next_target_is_sent() {
        let mut profile = Profile::new();
        profile.go_to(to(5.0));
        profile.step(false, false, DT);
        profile.halt();
        assert_eq!(word(&profile), (false, true));
        assert!(!profile.pending() && profile.goal().is_none());
        profile.go_to(to(6.0));
        assert_eq!(word(&profile), (false, true));
        profile.step(false, true, DT);
        assert_eq!(word(&profile), (true, false));
        profile.halt();
        profile.run_at(to(1.0));
        assert_eq!(profile.velocity_bits(), ModeCommand::Pv { halt: false });
    }

    #[test]
    fn set_point_without_answer_fails() {
        for stuck in [false, true] {
            let mut profile = Profile::new();
            profile.go_to(to(5.0));
            for _ in 0..1100 {
                profile.step(stuck, false, DT);
            }
            assert!(profile.not_taken() && !word(&profile).0);
        }
    }
}
