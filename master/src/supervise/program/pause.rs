//! Pause and single step: by the operator, by a key of `ecaxis run`, by an input of `[program]`.
//!
//! A paused program begins no step. A step that has begun ends first.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};

use super::super::Supervisor;
use super::Turn;
use crate::clock::Nanos;
use crate::config::Step;
use crate::link::sim::SimInput;
use crate::report::Error;
use crate::rt::channel::Snapshot;

/// Pauses the program from another thread.
#[derive(Debug, Default)]
pub struct ProgramControl {
    paused: AtomicBool,
    steps: AtomicU32,
    /// Values for inputs of the simulated bus.
    inputs: Mutex<Vec<SimInput>>,
}

impl ProgramControl {
    /// Lets no step begin, or all steps again.
    pub fn pause(&self, paused: bool) {
        self.steps.store(0, Ordering::Relaxed);
        self.paused.store(paused, Ordering::Relaxed);
    }

    /// Lets one step of the paused program begin. Pauses a running program.
    pub fn step(&self) {
        if self.is_paused() {
            self.steps.fetch_add(1, Ordering::Relaxed);
        }
        self.paused.store(true, Ordering::Relaxed);
    }

    /// Switches an input of the simulated bus. A real bus has none.
    pub fn switch(&self, input: SimInput) {
        let mut inputs = self.inputs.lock().unwrap_or_else(PoisonError::into_inner);
        inputs.push(input);
    }

    fn take_inputs(&self) -> Vec<SimInput> {
        std::mem::take(&mut self.inputs.lock().unwrap_or_else(PoisonError::into_inner))
    }

    #[must_use]
    pub fn is_paused(&self) -> bool {
        self.paused.load(Ordering::Relaxed)
    }

    fn may_step(&self) -> bool {
        self.steps.load(Ordering::Relaxed) > 0
    }

    fn take_step(&self) -> bool {
        let less = |steps: u32| steps.checked_sub(1);
        let (set, fetch) = (Ordering::Relaxed, Ordering::Relaxed);
        self.steps.fetch_update(set, fetch, less).is_ok()
    }
}

/// The inputs of `[program]`.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Buttons {
    /// The program is paused.
    pub paused: bool,
    /// The value of `step` before. True at first: an input that is pressed from the start steps
    /// nothing.
    released: bool,
    /// A step may begin.
    step: bool,
}

impl Supervisor {
    pub(in crate::supervise) fn watch_buttons(&mut self, snapshot: &Snapshot) {
        if let Some(inputs) = &mut self.sim_inputs {
            // A value without room would be too late.
            for input in self.control.take_inputs() {
                let _ = inputs.push(input);
            }
        }
        let machine = std::sync::Arc::clone(&self.machine);
        let holds = |when: &Option<_>| {
            let when: &crate::config::When = when.as_ref()?;
            Some(when.holds(|subject| self.value(snapshot, subject)))
        };
        let paused = holds(&machine.program.pause).unwrap_or(false);
        let pressed = holds(&machine.program.step).unwrap_or(false);
        let before = self.buttons;
        let stopped = paused || self.is_paused();
        self.buttons = Buttons {
            paused,
            released: !pressed,
            // A press before the pause steps nothing.
            step: stopped && (before.step || (pressed && before.released)),
        };
    }

    /// Returns true if one step of the paused program may begin.
    fn may_step(&self) -> bool {
        let attendance = self.attendance.as_ref();
        attendance.is_some_and(|attendance| attendance.may_step())
            || self.control.may_step()
            || self.buttons.step
    }

    /// Takes the permission for one step of the paused program.
    fn take_step(&mut self) -> bool {
        let attendance = self.attendance.as_mut();
        attendance.is_some_and(|attendance| attendance.take_step())
            || self.control.take_step()
            || std::mem::take(&mut self.buttons.step)
    }

    /// Returns true if no step may begin.
    pub(in crate::supervise) fn is_paused(&self) -> bool {
        let attendance = self.attendance.as_ref();
        self.buttons.paused
            || self.control.is_paused()
            || attendance.is_some_and(|attendance| attendance.is_paused())
    }
}

impl Turn<'_, '_> {
    /// Waits while the program is paused. A step that only contains others leaves the permission
    /// for a single step to the first of them.
    pub(super) async fn await_program_step(
        &mut self,
        step: &Step,
        start: Nanos,
    ) -> Result<(), Error> {
        // A press before the pause steps nothing.
        if !self.is_paused() {
            self.buttons.step = false;
        }
        let contains = !step.action.lists().is_empty();
        while self.is_paused() && !self.over(start) {
            if contains && self.may_step() || !contains && self.take_step() {
                break;
            }
            self.poll_and_query().await?;
        }
        Ok(())
    }
}
