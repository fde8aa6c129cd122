//! What the running machine publishes for the object dictionary of the MainDevice.

use std::convert::Infallible;

use ecaxis_axis::{AxisStatus, Controlword};
use ecaxis_ecat::al_state::AlState;
use ecaxis_ecat::index::{AxisIndex, IndexVec};
use tokio::sync::{oneshot, watch};

use crate::clock::Nanos;
use crate::rt::channel::Snapshot;
use crate::rt::exchange::SubDeviceDiagnostics;

/// The period in ns over which frames are counted.
const RATE_PERIOD: Nanos = 1_000_000_000;

/// The machine at one moment.
#[derive(Debug, Clone, Default)]
pub(super) struct Live {
    /// The state that the MainDevice has requested from all devices, as AL control.
    pub(super) requested: u8,
    /// Cycles whose frames did not all come back in time.
    pub(super) lost_frames: u64,
    /// Cyclic frames in the last full second.
    pub(super) frames_per_second: u32,
    /// The number of devices that answered the last broadcast.
    pub(super) answering: u16,
    /// In the order of the machine file; empty before the first cycle.
    pub(super) devices: Vec<DeviceLive>,
    /// Whether each axis has power, or is being enabled; empty before the first cycle.
    pub(super) power: IndexVec<AxisIndex, bool>,
}

/// One device at one moment.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct DeviceLive {
    pub(super) found: SubDeviceDiagnostics,
    /// How often the device ceased to answer.
    pub(super) absences: u32,
    /// How often it left Op without a request.
    pub(super) abnormal: u32,
}

impl DeviceLive {
    pub(super) fn follow(&mut self, now: &SubDeviceDiagnostics, in_op: bool) {
        let before = std::mem::replace(&mut self.found, *now);
        self.absences += u32::from(before.answers && !now.answers);
        let left = before.is_in_op() && now.answers && !now.is_in_op();
        self.abnormal += u32::from(in_op && left);
    }
}

/// The supervisor's end of the gateway. The gateway ends when it is dropped.
#[derive(Debug)]
pub(crate) struct LivePublisher {
    status: watch::Sender<Live>,
    _end: oneshot::Sender<Infallible>,
    frames_per_cycle: u64,
    requested: AlState,
    /// Time and number of the cycles at the start of the current second.
    second: Option<(Nanos, u64)>,
}

impl LivePublisher {
    pub(super) fn new(
        status: watch::Sender<Live>,
        end: oneshot::Sender<Infallible>,
        frames: usize,
    ) -> Self {
        Self {
            status,
            _end: end,
            frames_per_cycle: u64::try_from(frames).unwrap_or(u64::MAX),
            requested: AlState::SafeOp,
            second: None,
        }
    }

    /// Returns true if the axis has power, or will have it as soon as the drive follows the
    /// Controlword.
    fn has_power(axis: &AxisStatus) -> bool {
        let command = Controlword::from_bits_retain(axis.controlword);
        axis.powered
            || axis.state.has_power()
            || command.contains(Controlword::ENABLE_OPERATION_COMMAND)
    }

    /// Sets the state that is requested from the devices.
    pub(crate) fn set_requested(&mut self, state: AlState) {
        self.requested = state;
    }

    /// Publishes a snapshot of the cycle.
    pub(crate) fn publish(&mut self, snapshot: &Snapshot) {
        let rate = self.rate(snapshot);
        let requested = self.requested;
        self.status.send_modify(|live| {
            live.requested = requested.code();
            live.lost_frames = snapshot.counters.lost_frames;
            live.frames_per_second = rate.unwrap_or(live.frames_per_second);
            live.power = snapshot.axes.iter().map(Self::has_power).collect();
            live.answering = snapshot.al_status.map_or(0, |(_, devices)| devices);
            live.devices
                .resize(snapshot.diagnoses.len(), DeviceLive::default());
            for (device, now) in live.devices.iter_mut().zip(&snapshot.diagnoses) {
                device.follow(now, requested == AlState::Op);
            }
        });
    }

    /// Returns the frames per second, once in a second.
    fn rate(&mut self, snapshot: &Snapshot) -> Option<u32> {
        let now = (snapshot.time, snapshot.counters.cycles);
        let (time, cycles) = *self.second.get_or_insert(now);
        let elapsed = snapshot.time.saturating_sub(time);
        if elapsed < RATE_PERIOD {
            return None;
        }
        self.second = Some(now);
        let cycles = snapshot.counters.cycles.saturating_sub(cycles);
        let frames = u128::from(cycles) * u128::from(self.frames_per_cycle);
        let rate = frames * u128::from(RATE_PERIOD) / u128::from(elapsed);
        Some(u32::try_from(rate).unwrap_or(u32::MAX))
    }
}
