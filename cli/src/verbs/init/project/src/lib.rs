//! A control loop in the cycle: `x` swings like a pendulum, and `y` mirrors it. After three swings,
//! the machine comes to rest.
//!
//! The controller gives set-points and reads actual values. Enabling, limits, supervision, lost
//! frames and the stop work as in every other run.

use std::f64::consts::TAU;

use ecaxis_master::config::{AxisRef, Machine, NameError};
use ecaxis_master::rt::controller::{Controller, CycleContext};

/// In the unit of the axes.
pub const AMPLITUDE: f64 = 20.0;
const PERIOD_S: f64 = 1.0;
const SWINGS: f64 = 3.0;

pub struct Pendulum {
    x: AxisRef,
    y: AxisRef,
    /// The positions of both axes at the first set-point.
    start: Option<[f64; 2]>,
    elapsed_s: f64,
}

impl Pendulum {
    /// Fails if the machine has no axis `x` or `y`.
    pub fn new(machine: &mut Machine) -> Result<Self, NameError> {
        Ok(Self {
            x: machine.axis("x")?,
            y: machine.axis("y")?,
            start: None,
            elapsed_s: 0.0,
        })
    }
}

impl Controller for Pendulum {
    /// Runs once a cycle in the real-time thread: it must not block, lock or allocate.
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        let (x, y) = (machine.axis(self.x), machine.axis(self.y));
        if machine.stopping() || !(x.ready && y.ready) {
            return;
        }
        let [x_start, y_start] = *self
            .start
            .get_or_insert([x.target_position, y.target_position]);
        self.elapsed_s += machine.dt_s();
        let swings = self.elapsed_s / PERIOD_S;
        // The swing grows in its first period and decays in its last: it begins and ends at rest.
        let swell = swings.min(SWINGS - swings).clamp(0.0, 1.0);
        let swell = swell * swell * (3.0 - 2.0 * swell);
        let way = AMPLITUDE * swell * (TAU * swings).sin();
        // A set-point beyond the limits is rejected, and its axis brakes.
        let rejected = machine.set_point(self.x, x_start + way).is_err()
            || machine.set_point(self.y, y_start - way).is_err();
        if rejected || swings >= SWINGS {
            machine.finish();
        }
    }
}
