//! What goes between the cycle and the threads outside.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use ecaxis_axis::CommandError;
use ecaxis_axis::setpoint::{Knot, SetpointError, StreamConfig};
use ecaxis_master::sys::shared_memory::SharedMemory;

pub use ecaxis_client::layout::commands as words;

/// A point of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamPoint {
    pub knot: Knot,
    /// Torque feed-forward in percent of rated torque.
    pub torque: f64,
}

/// A message to the cycle.
#[derive(Debug)]
pub enum Message {
    /// The axes follow no client from now on; `None`: all axes.
    Release(Option<usize>),
    /// The memory of the client that owns the motion.
    Attach(Arc<SharedMemory>),
    /// No client writes set-points.
    Detach,
    Open {
        ticket: u64,
        axis: usize,
        config: StreamConfig,
    },
    Push {
        ticket: u64,
        axis: usize,
        points: Box<[StreamPoint]>,
    },
    Close {
        ticket: u64,
        axis: usize,
    },
}

/// A report of the cycle.
#[derive(Debug)]
pub enum Report {
    Opened {
        ticket: u64,
        result: Result<(), StreamError>,
    },
    Pushed {
        ticket: u64,
        accepted: usize,
        free: usize,
        error: Option<StreamError>,
        /// Returned to be freed outside the cycle.
        points: Box<[StreamPoint]>,
    },
    Closed {
        ticket: u64,
        result: Result<(), StreamError>,
    },
    StreamEnded {
        axis: usize,
        end: StreamEnd,
    },
    AreaStopped {
        axis: usize,
        cause: AreaStop,
    },
    /// Memory that is no longer used, to be freed outside the cycle.
    Detached(Arc<SharedMemory>),
}

/// Why a request to a stream was refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum StreamError {
    #[error("the axis is not ready: enable it first")]
    NotReady,
    #[error("the axis has no open stream")]
    NotOpen,
    #[error("the axis follows set-points of the cyclic area")]
    Follows,
    #[error(transparent)]
    Setpoint(#[from] SetpointError),
}

/// How a stream has ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StreamEnd {
    /// The axis stands at the last point.
    Done,
    /// The points ran out.
    Underrun,
    /// The axis refused a set-point.
    Refused(CommandError),
}

/// Why an axis no longer follows the cyclic area.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum AreaStop {
    #[error("no new set-point came for {0} cycles")]
    Stale(u32),
    #[error("a set-point was refused: {0}")]
    Refused(#[source] CommandError),
    #[error("a set-point is not a finite number")]
    NotFinite,
    #[error("{0} is not a kind of set-point")]
    Kind(u64),
    #[error("the kind of set-point has changed without 0 between")]
    KindChanged,
    #[error("the axis is not ready, or moves: enable it and wait until it stands")]
    NotReady,
}

/// What the area has done so far, for everybody outside the cycle.
#[derive(Debug, Default)]
pub struct AreaCounters {
    /// Leases that have ended. The axes then follow no client, also if the supervisor is busy.
    pub leases_ended: AtomicU64,
    /// 1 while memory is attached.
    pub attached: AtomicU64,
    /// Sets that were used.
    pub used: AtomicU64,
    /// Cycles without a new set while an axis follows.
    pub late: AtomicU64,
    /// Refused set-points.
    pub refused: AtomicU64,
    /// Axes that were stopped because set-points were late or refused.
    pub stopped: AtomicU64,
}
