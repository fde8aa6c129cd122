//! The settings of the cycle, as plain data.

use ecaxis_axis::StopMethod;
use ecaxis_axis::setpoint::{Cam, LineShaft};
use ecaxis_ecat::index::{DeviceIndex, GroupIndex, IndexVec};

use super::controller::InputRef;
use super::gantry::GantryConfig;
use super::image::ProcessData;
use super::overrides::OverrideConfig;
use super::spin::Spin;
use crate::clock::Nanos;

/// The settings of the cycle.
#[derive(Debug, Clone)]
pub struct RtConfig {
    pub cycle_ns: Nanos,
    /// DC offsets in ns beyond this are reported.
    pub clock_window_ns: u64,
    /// SYNC0 is kept on whole multiples of the cycle in common time.
    pub align: bool,
    /// The time spun before the release; the rest of the cycle is slept.
    pub spin: Spin,
    pub exchange: ExchangeMode,
    /// The number of consecutive cycles without a valid answer that stops the axes.
    pub lost_frames: u32,
    /// The process data of each SubDevice.
    pub devices: IndexVec<DeviceIndex, ProcessData>,
    /// The reaction groups; the first one holds all SubDevices without a named group.
    pub groups: IndexVec<GroupIndex, GroupConfig>,
    /// The stop method of axes without valid inputs.
    pub bus_lost: StopMethod,
    /// The conditions for an emergency stop; one is enough.
    pub emergency: Vec<Condition>,
    pub overrides: OverrideConfig,
    pub gantries: Vec<GantryConfig>,
    pub cams: Vec<Cam>,
    /// The line shafts as they begin.
    pub line_shafts: Vec<LineShaft>,
    /// Inputs that are copied to outputs in every cycle.
    pub copies: Vec<ProcessDataCopy>,
    /// Outputs that have their initial value from the loss of their device to the reset of its group.
    pub output_locks: Vec<ProcessDataCopy>,
    /// Outputs that repeat other outputs of their device.
    pub repeats: Vec<ProcessDataCopy>,
}

/// Bits of the process data that are copied.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProcessDataCopy {
    /// The source: its device, and the first bit in the inputs (or outputs) of that device.
    pub from: (DeviceIndex, usize),
    /// The target: its device, and the first bit in the outputs of that device.
    pub to: (DeviceIndex, usize),
    /// The length in bits.
    pub bits: usize,
}

/// The cycle in which answers are evaluated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ExchangeMode {
    /// The cycle that sent the frames; the thread waits for the answers.
    #[default]
    SameCycle,
    /// The cycle after it: the answers have arrived by then, and the thread does not wait.
    Pipelined,
}

/// How a reaction group stops.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GroupConfig {
    /// The stop method of the other axes when one faults, trips, or can no longer follow.
    pub others: StopMethod,
    pub outside: GroupStopScope,
}

impl GroupConfig {
    /// Returns the settings of the group whose stop is the stop of the machine.
    #[must_use]
    pub const fn machine(others: StopMethod) -> Self {
        let outside = GroupStopScope::Stop;
        Self { others, outside }
    }
}

/// What the machine does when a group stops.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum GroupStopScope {
    /// The machine stops as well, within the limits of its axes.
    #[default]
    Stop,
    Continue,
}

/// A condition on an input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Condition {
    pub input: InputRef,
    pub bounds: Bounds,
}

/// Bounds of a value. All given ones must hold.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Bounds<T = f64> {
    pub equal: Option<T>,
    pub above: Option<T>,
    pub below: Option<T>,
}

impl<T: Copy> Bounds<T> {
    /// Returns the bounds with each number converted.
    #[must_use]
    pub fn map<U>(self, convert: impl Fn(T) -> U) -> Bounds<U> {
        Bounds {
            equal: self.equal.map(&convert),
            above: self.above.map(&convert),
            below: self.below.map(&convert),
        }
    }
}

impl Bounds {
    /// RT.
    #[must_use]
    pub fn holds(&self, value: f64) -> bool {
        self.equal.is_none_or(|n| value == n)
            && self.above.is_none_or(|n| value > n)
            && self.below.is_none_or(|n| value < n)
    }
}
