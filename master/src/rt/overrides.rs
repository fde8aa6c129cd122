//! Override and hold: the rate of all motions, for the machine and for each group.
//!
//! The rate of an axis is the product of the machine's factor and its group's, at most [`MAX_RATE`].
//! It is 0 while one of both is held. Stops do not use the rate.

use ecaxis_axis::setpoint::{Rate, TableRate};
use ecaxis_axis::{Command, CommandError, MAX_RATE};
use ecaxis_ecat::index::{GroupIndex, IndexVec};

use super::config::Condition;
use super::controller::InputRef;

/// How the machine file sets the override.
#[derive(Debug, Clone, PartialEq)]
pub struct OverrideConfig {
    /// The machine's factor at the start, from 0 to [`MAX_RATE`].
    pub initial: f64,
    /// The conditions that hold the machine; one is enough.
    pub hold: Vec<Condition>,
    /// An input that multiplies the machine's factor.
    pub input: Option<OverrideInput>,
}

impl Default for OverrideConfig {
    fn default() -> Self {
        Self {
            initial: 1.0,
            hold: Vec::new(),
            input: None,
        }
    }
}

/// An input for the override: its values at 0 % and at 100 %.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OverrideInput {
    pub input: InputRef,
    pub zero: f64,
    pub full: f64,
}

/// Steps of an input, so that its noise does not plan every motion again.
const STEP: f64 = 0.01;

impl OverrideInput {
    /// Returns the factor in whole steps; `before` unless the input has left its step. Without a
    /// valid value it is 0. RT.
    fn factor(&self, inputs: &[f64], before: f64) -> f64 {
        let value = inputs.get(self.input.0).copied().unwrap_or(f64::NAN);
        let factor = (value - self.zero) / (self.full - self.zero);
        // NaN becomes 0.
        let factor = if factor > 0.0 {
            factor.min(MAX_RATE)
        } else {
            0.0
        };
        if (factor - before).abs() < STEP * 0.75 {
            return before;
        }
        (factor / STEP).round() * STEP
    }
}

/// The override of the machine or of one group.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Override {
    /// From 0 to [`MAX_RATE`].
    pub factor: f64,
    pub held: bool,
}

impl Override {
    /// Returns the rate of the axes of a group. `self` is the override of the machine. RT.
    #[must_use]
    pub fn rate(self, group: Self) -> Rate {
        if self.held || group.held {
            return Rate::HELD;
        }
        Rate::new((self.factor * group.factor).min(MAX_RATE))
    }
}

impl Default for Override {
    fn default() -> Self {
        Self {
            factor: 1.0,
            held: false,
        }
    }
}

/// The overrides of a machine.
#[derive(Debug)]
pub(super) struct Overrides {
    config: OverrideConfig,
    /// Requested for each group; the first entry is the machine's.
    requested: IndexVec<GroupIndex, Override>,
    /// What the inputs demand of the machine.
    input: Override,
    /// The present rate of the tables of each group.
    pub tables: IndexVec<GroupIndex, TableRate>,
}

/// The rates of one axis in one cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    pub own: Rate,
    /// The lowest rate of all axes on the line of the axis.
    pub line: Rate,
}

impl Rates {
    pub const WHOLE: Self = Self {
        own: Rate::WHOLE,
        line: Rate::WHOLE,
    };
}

impl Overrides {
    #[allow(
        clippy::disallowed_methods,
        clippy::disallowed_macros,
        reason = "runs before the loop"
    )]
    pub fn new(config: OverrideConfig, groups: usize) -> Self {
        let mut requested: IndexVec<GroupIndex, _> = vec![Override::default(); groups].into();
        if let Some(machine) = requested.get_mut(GroupIndex::MACHINE) {
            machine.factor = config.initial;
        }
        Self {
            config,
            requested,
            input: Override::default(),
            tables: vec![TableRate::WHOLE; groups].into(),
        }
    }

    /// Sets the factor of the machine or of a group. Invalid factors are ignored. RT.
    pub fn set_factor(&mut self, group: GroupIndex, factor: f64) {
        if let Some(own) = self.requested.get_mut(group)
            && (0.0..=MAX_RATE).contains(&factor)
        {
            own.factor = factor;
        }
    }

    /// Holds or releases the machine or a group. RT.
    pub fn set_hold(&mut self, group: GroupIndex, held: bool) {
        if let Some(own) = self.requested.get_mut(group) {
            own.held = held;
        }
    }

    /// Reads the inputs. A missing or NaN input holds the machine. RT.
    pub fn read(&mut self, inputs: &[f64]) {
        let holds = |c: &Condition| {
            let value = inputs.get(c.input.0);
            value.is_none_or(|n| n.is_nan() || c.bounds.holds(*n))
        };
        let before = self.input.factor;
        self.input = Override {
            factor: (self.config.input).map_or(1.0, |input| input.factor(inputs, before)),
            held: self.config.hold.iter().any(holds),
        };
    }

    /// Returns the override of the machine, or that of a group alone. RT.
    pub fn of(&self, group: GroupIndex) -> Override {
        let own = self.requested.get(group).copied().unwrap_or_default();
        if group != GroupIndex::MACHINE {
            return own;
        }
        Override {
            factor: (own.factor * self.input.factor).min(MAX_RATE),
            held: own.held || self.input.held,
        }
    }

    /// Returns the rate of the axes of a group. RT.
    pub fn rate(&self, group: GroupIndex) -> Rate {
        let machine = self.of(GroupIndex::MACHINE);
        match group {
            GroupIndex::MACHINE => machine.rate(Override::default()),
            group => machine.rate(self.of(group)),
        }
    }
}

/// Checks whether an axis with this rate may receive a command. A held axis accepts motions that
/// wait. The search for home by a drive cannot. RT.
pub(super) fn check_hold(rate: Rate, command: Command) -> Result<(), CommandError> {
    match command {
        Command::Home { .. } if rate.is_held() => Err(CommandError::Held),
        Command::Home { .. }
        | Command::Torque { .. }
        | Command::Enable
        | Command::Disable
        | Command::ResetFault
        | Command::Stop
        | Command::HoldHoming
        | Command::QuickStop
        | Command::DisableVoltage
        | Command::EmergencyStop
        | Command::ArmProbe { .. }
        | Command::DisarmProbe { .. }
        | Command::SetMode(_)
        | Command::MoveTo { .. }
        | Command::MoveBy { .. }
        | Command::Velocity { .. } => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rt::config::Bounds;

    const ONE: GroupIndex = GroupIndex(1);

    #[test]
    fn rate_is_the_product_and_0_in_a_hold() {
        let mut all = Overrides::new(OverrideConfig::default(), 2);
        for (machine, group, expected) in [
            (1.0, 1.0, 1.0),
            (0.5, 0.5, 0.25),
            (1.2, 1.2, 1.2),
            (0.0, 1.0, 0.0),
        ] {
            all.set_factor(GroupIndex::MACHINE, machine);
            all.set_factor(ONE, group);
            assert_eq!(all.rate(ONE).value(), expected);
            assert_eq!(all.rate(GroupIndex::MACHINE).value(), machine);
        }
        for invalid in [f64::NAN, -0.1, 1.21] {
            all.set_factor(ONE, invalid);
        }
        assert_eq!(all.of(ONE).factor, 1.0);
        all.set_factor(GroupIndex::MACHINE, 0.8);
        all.set_hold(ONE, true);
        let rates =
            |all: &Overrides| [ONE, GroupIndex::MACHINE].map(|group| all.rate(group).value());
        assert_eq!(rates(&all), [0.0, 0.8]);
        all.set_hold(ONE, false);
        all.set_hold(GroupIndex::MACHINE, true);
        assert_eq!(rates(&all), [0.0, 0.0]);
    }

    #[test]
    fn inputs_hold_and_scale_and_a_missing_one_holds() {
        let bounds = Bounds {
            equal: Some(0.0),
            ..Bounds::default()
        };
        let input = InputRef(0);
        let mut all = Overrides::new(
            OverrideConfig {
                initial: 1.0,
                hold: vec![Condition { input, bounds }],
                input: Some(OverrideInput {
                    input: InputRef(1),
                    zero: 100.0,
                    full: 1100.0,
                }),
            },
            1,
        );
        for (inputs, expected) in [
            (&[1.0, 1100.0][..], 1.0),
            (&[1.0, 1104.0], 1.0),
            (&[1.0, 607.0], 0.51),
            (&[1.0, 604.0], 0.51),
            (&[1.0, 99_999.0], MAX_RATE),
            (&[1.0, -5.0], 0.0),
            (&[1.0, f64::NAN], 0.0),
            (&[0.0, 1100.0], 0.0),
            (&[f64::NAN, 1100.0], 0.0),
            (&[], 0.0),
        ] {
            all.read(inputs);
            let rate = all.rate(GroupIndex::MACHINE).value();
            assert!((rate - expected).abs() < 1e-12, "{inputs:?}: {rate}");
        }
    }
}
