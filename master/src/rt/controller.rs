//! User-supplied control loops inside the cycle.

use ecaxis_axis::setpoint::Rate;
use ecaxis_axis::{AxisStatus, Command, CommandError};
use ecaxis_ecat::index::{AxisIndex, GroupIndex, IndexVec};

use super::axis::RtAxis;
use super::bus_monitor::StopCause;
use super::cycle::Signals;
use super::gantry::{self, Gantry};
use super::overrides::{Overrides, check_hold};
use super::reaction_group::{ReactionGroup, check_permitted};

/// A reference to an axis of a machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct AxisRef(pub(crate) AxisIndex);

/// A reference to an input of a machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct InputRef(pub(crate) usize);

/// A reference to an output of a machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct OutputRef(pub(crate) usize);

/// User code that runs in the real-time thread once per cycle, after the inputs have arrived and
/// before the outputs are computed.
///
/// Its commands pass the same checks as all others: limits, supervision and the stop of the machine
/// stay in force. It must neither block nor allocate; its run time is part of the cycle. If it
/// panics, the machine stops as after a fault, and the controller is not called again.
pub trait Controller: Send {
    /// Runs once per cycle.
    fn cycle(&mut self, machine: &mut CycleContext<'_>);
}

impl std::fmt::Debug for dyn Controller {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Controller")
    }
}

/// The machine in one cycle, as a [`Controller`] sees it.
///
/// # Panics
/// Panics if a reference belongs to another machine, and this one has no such axis or signal. Such
/// a panic stops the machine like any other panic of the controller.
#[derive(Debug)]
pub struct CycleContext<'a> {
    pub(super) number: u64,
    pub(super) dt_s: f64,
    pub(super) fresh: bool,
    pub(super) guarded: bool,
    pub(super) axes: &'a mut IndexVec<AxisIndex, RtAxis>,
    pub(super) gantries: &'a mut [Gantry],
    pub(super) groups: &'a mut IndexVec<GroupIndex, ReactionGroup>,
    pub(super) overrides: &'a Overrides,
    pub(super) inputs: &'a [f64],
    pub(super) signals: &'a Signals,
    pub(super) outputs: &'a mut [u8],
    pub(super) finished: &'a mut bool,
}

impl CycleContext<'_> {
    /// Returns the number of cycles since the loop began.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Returns the nominal cycle time in seconds.
    #[must_use]
    pub fn dt_s(&self) -> f64 {
        self.dt_s
    }

    /// False if frames of this cycle were lost or a SubDevice is missing. Inputs and actual values
    /// are then from an earlier cycle. `stale_cycles` in an axis' status is the age in cycles.
    #[must_use]
    pub fn fresh(&self) -> bool {
        self.fresh
    }

    /// True once all SubDevices are in Op and the bus monitor is active. Before that, axes cannot
    /// be enabled.
    #[must_use]
    pub fn in_op(&self) -> bool {
        self.guarded
    }

    /// True while the machine is being stopped; it then rejects motion commands.
    #[must_use]
    pub fn stopping(&self) -> bool {
        self.groups
            .first()
            .is_some_and(|rest| rest.stop().is_some())
    }

    /// Returns why the group of an axis is stopped. The group rejects motion until one of its axes
    /// is reset ([`Command::ResetFault`]) and none of them has a fault, a trip or power. The group
    /// can then be enabled again, unless the machine stops as well.
    #[must_use]
    pub fn stopped(&self, axis: AxisRef) -> Option<StopCause> {
        let group = self.groups.get(self.axes[axis.0].group)?;
        group.stop().map(|stop| stop.cause)
    }

    /// Returns the override of an axis in this cycle. A held axis accepts no set-point that moves it.
    #[must_use]
    pub fn rate(&self, axis: AxisRef) -> Rate {
        self.overrides.rate(self.axes[axis.0].group)
    }

    /// Returns the status of an axis with this cycle's actual values.
    #[must_use]
    pub fn axis(&self, axis: AxisRef) -> AxisStatus {
        self.axes[axis.0].axis.status()
    }

    /// Sends a command to an axis; it takes effect in this cycle.
    ///
    /// # Errors
    /// The reason for the rejection. A rejected command changes nothing.
    pub fn command(&mut self, axis: AxisRef, command: Command) -> Result<(), CommandError> {
        check_permitted(self.groups, self.axes[axis.0].group, command)?;
        check_hold(self.rate(axis), command)?;
        if !self.guarded && command == Command::Enable {
            return Err(CommandError::NotInOp);
        }
        gantry::command(self.axes, self.gantries, axis.0, command)
    }

    /// Sets the axis' set-point position for this cycle. Call it in every cycle; otherwise the axis
    /// decelerates and holds.
    ///
    /// # Errors
    /// Fails if the step would exceed the limits or leave the range, or if the axis is held and the
    /// set-point moves it. The axis then decelerates.
    pub fn set_point(&mut self, axis: AxisRef, position: f64) -> Result<(), CommandError> {
        if self.stopping() {
            return Err(CommandError::Stopping);
        }
        if self.stopped(axis).is_some() {
            return Err(CommandError::GroupStopped);
        }
        gantry::check_motion(self.gantries, axis.0)?;
        let held = self.rate(axis).is_held();
        let axis = &mut self.axes[axis.0].axis;
        if held && position != axis.status().target_position {
            return Err(CommandError::Held);
        }
        axis.set_point(position)
    }

    /// Adds a torque feed-forward to the set-point of this cycle, in percent of rated torque: 0x60B2
    /// in CSP. Has no effect unless the object is mapped and the set-point was accepted.
    pub fn set_torque_feedforward(&mut self, axis: AxisRef, percent: f64) {
        self.axes[axis.0].axis.set_torque_feedforward(percent);
    }

    /// Returns an input as a number; a set bit is 1.
    #[must_use]
    pub fn input(&self, input: InputRef) -> f64 {
        self.inputs[input.0]
    }

    /// Sets an output. Values out of range are clamped.
    pub fn set(&mut self, output: OutputRef, value: f64) {
        self.signals.outputs[output.0].set(self.outputs, value);
    }

    /// Ends the run normally: the machine is brought to rest.
    pub fn finish(&mut self) {
        *self.finished = true;
    }
}
