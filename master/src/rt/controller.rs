//! A user's own control loop inside the cycle.

use ecaxis_axis::{AxisStatus, Command, Refused};

use super::cycle::Signals;
use super::groups::{Group, admit};
use super::guard::StopCause;
use super::slot::AxisSlot;
use crate::config::{AxisRef, InputRef, OutputRef};

/// Called once a cycle in the real-time thread, after the inputs have arrived and before the outputs are made.
///
/// What it orders passes the same guards as everything else: limits, supervision, and the stop of the machine stay in
/// force. It must neither block nor allocate; the time it takes is part of the cycle's. If it panics, the machine stops
/// as after a fault, and it is not called again.
pub trait Controller: Send {
    /// One cycle.
    fn cycle(&mut self, machine: &mut Cycle<'_>);
}

impl std::fmt::Debug for dyn Controller {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Controller")
    }
}

/// The machine in one cycle, as a [`Controller`] sees it.
///
/// # Panics
/// With references of another machine: where this one has no such axis or signal. That stops the machine like any other panic
/// of the controller.
#[derive(Debug)]
pub struct Cycle<'a> {
    pub(super) number: u64,
    pub(super) dt_s: f64,
    pub(super) fresh: bool,
    pub(super) guarded: bool,
    pub(super) axes: &'a mut [AxisSlot],
    pub(super) groups: &'a mut [Group],
    pub(super) inputs: &'a [f64],
    pub(super) signals: &'a Signals,
    pub(super) outputs: &'a mut [u8],
    pub(super) finished: &'a mut bool,
}

impl Cycle<'_> {
    /// Counts the cycles since the loop began.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Nominal length of a cycle, seconds.
    #[must_use]
    pub fn dt_s(&self) -> f64 {
        self.dt_s
    }

    /// `false`: frames of this cycle were lost, or a SubDevice is missing, and its inputs and actual values are those of a cycle before;
    /// of an axis, `stale_cycles` of its status tells how long ago that was.
    #[must_use]
    pub fn fresh(&self) -> bool {
        self.fresh
    }

    /// All SubDevices are in Op and the guards are armed. Before, axes cannot be enabled.
    #[must_use]
    pub fn in_op(&self) -> bool {
        self.guarded
    }

    /// The machine is being stopped and takes no more motion.
    #[must_use]
    pub fn stopping(&self) -> bool {
        self.groups
            .first()
            .is_some_and(|rest| rest.stop().is_some())
    }

    /// Why the group of an axis is stopped. It takes no motion until one of its axes is reset ([`Command::ResetFault`]) and none of them
    /// has a fault, a trip or power any more; then it can be enabled again, unless the machine stops, too.
    #[must_use]
    pub fn stopped(&self, axis: AxisRef) -> Option<StopCause> {
        let group = self.groups.get(self.axes[axis.0].group)?;
        group.stop().map(|stop| stop.cause)
    }

    /// An axis with this cycle's actual values.
    #[must_use]
    pub fn axis(&self, axis: AxisRef) -> AxisStatus {
        self.axes[axis.0].axis.status()
    }

    /// Orders an axis to do something from this cycle on.
    ///
    /// # Errors
    /// Why it does not; nothing has changed then.
    pub fn command(&mut self, axis: AxisRef, command: Command) -> Result<(), Refused> {
        let slot = &mut self.axes[axis.0];
        admit(self.groups, slot.group, command)?;
        if !self.guarded && command == Command::Enable {
            return Err(Refused::NotInOp);
        }
        slot.command(command)
    }

    /// Gives the set-point's position for this cycle; to be called in every cycle, or the axis decelerates and holds.
    ///
    /// # Errors
    /// It would step further or harder than the limits allow, or leave the range: the axis decelerates instead.
    pub fn set_point(&mut self, axis: AxisRef, position: f64) -> Result<(), Refused> {
        if self.stopping() {
            return Err(Refused::Stopping);
        }
        if self.stopped(axis).is_some() {
            return Err(Refused::GroupStopped);
        }
        self.axes[axis.0].axis.set_point(position)
    }

    /// An input as a number; a bit that is set is 1.
    #[must_use]
    pub fn input(&self, input: InputRef) -> f64 {
        self.inputs[input.0]
    }

    /// Puts an output to a value; what does not fit is cut down to the nearest that does.
    pub fn set(&mut self, output: OutputRef, value: f64) {
        self.signals.outputs[output.0].set(self.outputs, value);
    }

    /// The work is done: the machine is brought to rest, the run ends well.
    pub fn finish(&mut self) {
        *self.finished = true;
    }
}
