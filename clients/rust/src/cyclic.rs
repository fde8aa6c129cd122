//! Set-points in every cycle, in shared memory.

use std::fmt;
use std::ops::{Deref, DerefMut};
use std::os::fd::OwnedFd;
use std::sync::atomic::{Ordering, fence};

use crate::layout::commands;
use crate::memory::Memory;
use crate::{Error, Result, Samples};

/// The place of an axis in the set-points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AxisNumber(usize);

/// A set-point in the units of its axis.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum SetPoint {
    /// The axis decelerates and holds.
    #[default]
    None,
    /// A position. The first one must be where the axis is.
    Position(f64),
    /// A velocity.
    Velocity(f64),
    /// A torque in percent.
    Torque(f64),
}

/// What the server has done with the set-points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Counters {
    /// Sets used.
    pub used: u64,
    /// Cycles without a new set.
    pub late: u64,
    /// Set-points refused.
    pub refused: u64,
    /// The number of the last set that was used.
    pub last: u64,
}

/// The set-points of every cycle, and its values: all of [`Samples`]. Its functions use neither the
/// connection nor a lock, and allocate nothing.
///
/// The lease still needs [`Machine::keep`](crate::Machine::keep). Once this value is dropped, its
/// axes decelerate and hold.
pub struct Cyclic {
    samples: Samples,
    commands: Memory,
    axes: Box<[String]>,
    axes_at: usize,
    axis_words: usize,
    counter: u64,
    set_points: Box<[SetPoint]>,
}

impl Cyclic {
    /// Maps the memory of a server. `None`: it does not have the layout of `docs/server.md`. Every
    /// offset is read once and checked here.
    pub(crate) fn map(descriptors: &[OwnedFd], axes: Box<[String]>) -> Option<Self> {
        let [first, second] = descriptors else {
            return None;
        };
        let samples = Samples::map(first)?;
        let commands = Memory::map(second, true, commands::HEADER)?;
        let known = commands.load(0) == u64::from_ne_bytes(commands::MAGIC)
            && commands.load(commands::VERSION_AT) == commands::VERSION;
        let (axes_at, axis_words) = (
            commands.size(commands::AXES_AT),
            commands.size(commands::AXIS_WORDS),
        );
        let axes_end = axes.len().checked_mul(axis_words)?.checked_add(axes_at)?;
        let fits = commands.size(commands::AXES) == axes.len()
            && axes_at >= commands::HEADER
            && axis_words >= 2
            && axes_end <= commands.words().len();
        (known && fits).then(|| Self {
            counter: commands.load(commands::COUNTER),
            set_points: vec![SetPoint::None; axes.len()].into(),
            samples,
            commands,
            axes,
            axes_at,
            axis_words,
        })
    }

    /// Returns the values alone.
    #[must_use]
    pub fn samples(&self) -> &Samples {
        &self.samples
    }

    /// Returns the place of an axis.
    ///
    /// # Errors
    /// Fails if the machine has no such axis.
    pub fn axis(&self, name: &str) -> Result<AxisNumber> {
        let found = self.axes.iter().position(|axis| axis == name);
        let error = || Error::new("unknown_name", "the machine has no such axis");
        found
            .map(AxisNumber)
            .ok_or_else(|| error().at("area", name))
    }

    /// Prepares the set-point of an axis. [`Cyclic::publish`] makes it valid; it stays until it is
    /// replaced.
    pub fn set(&mut self, axis: AxisNumber, set_point: SetPoint) {
        if let Some(prepared) = self.set_points.get_mut(axis.0) {
            *prepared = set_point;
        }
    }

    /// Makes the prepared set-points valid for the next cycle. Returns the number of the set. An
    /// axis that starts fast keeps its first position until the server has used that set.
    pub fn publish(&mut self) -> u64 {
        let words = self.commands.words();
        let sequence = self.commands.load(commands::SEQUENCE) & !1;
        self.counter = self.counter.wrapping_add(1);
        words[commands::SEQUENCE].store(sequence.wrapping_add(1), Ordering::Relaxed);
        fence(Ordering::Release);
        words[commands::COUNTER].store(self.counter, Ordering::Relaxed);
        words[commands::FROM_ROW].store(self.next_cycle(), Ordering::Relaxed);
        let axes = words[self.axes_at..].chunks_exact(self.axis_words);
        for (axis, set_point) in axes.zip(&self.set_points) {
            let (kind, value) = match *set_point {
                SetPoint::None => (0, 0.0),
                SetPoint::Position(value) => (1, value),
                SetPoint::Velocity(value) => (2, value),
                SetPoint::Torque(value) => (3, value),
            };
            axis[0].store(kind, Ordering::Relaxed);
            axis[1].store(value.to_bits(), Ordering::Relaxed);
        }
        words[commands::SEQUENCE].store(sequence.wrapping_add(2), Ordering::Release);
        self.counter
    }

    /// Returns true if the server has refused a set-point of the axis, or none came in time: the
    /// axis has stopped, and follows again after a set with [`SetPoint::None`].
    #[must_use]
    pub fn is_stopped(&self, axis: AxisNumber) -> bool {
        self.commands.load(commands::BLOCKED) >> axis.0.min(63) & 1 == 1
    }

    /// Returns what the server has done with the set-points.
    #[must_use]
    pub fn counters(&self) -> Counters {
        Counters {
            used: self.commands.load(commands::USED),
            late: self.commands.load(commands::LATE),
            refused: self.commands.load(commands::REFUSED),
            last: self.commands.load(commands::LAST_USED),
        }
    }
}

impl Deref for Cyclic {
    type Target = Samples;

    fn deref(&self) -> &Samples {
        &self.samples
    }
}

impl DerefMut for Cyclic {
    fn deref_mut(&mut self) -> &mut Samples {
        &mut self.samples
    }
}

impl Drop for Cyclic {
    fn drop(&mut self) {
        self.set_points.fill(SetPoint::None);
        self.publish();
    }
}

impl fmt::Debug for Cyclic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Cyclic")
            .field("axes", &self.axes)
            .field("set_points", &self.set_points)
            .field("samples", &self.samples)
            .finish_non_exhaustive()
    }
}
