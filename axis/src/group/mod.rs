//! Several axes together.
//!
//! | module | contents |
//! |---|---|
//! | `line` | [`Line`]: a straight line through the positions of all axes, with one profile |
//! | `path` | [`PathPlan`]: lines and arcs with blended corners, planned as a whole |
//! | `together` | [`arrive_together`]: separate moves that take the same time |
//!
//! This module owns no axis. A line gives each axis its own set-point source ([`LinePath`]). All
//! sources compute bit-identical results, so the axes stay synchronous without communication in the
//! cycle. Nothing allocates, except the plan of a path before the motion.
//!
//! ```
//! use ecaxis_axis::group::arrive_together;
//! use ecaxis_axis::setpoint::{Goal, JerkLimited, Motion, MotionLimits, MoveRequest};
//!
//! let limits = MotionLimits { velocity: 100.0, acceleration: 1000.0, jerk: 20_000.0 };
//! let to = |target| {
//!     let request = MoveRequest::within(Goal::Position(target), limits);
//!     JerkLimited::new(request, Motion::default(), 0.001)
//! };
//! let mut moves = [to(10.0)?, to(100.0)?];
//! let duration_s = arrive_together(&mut moves)?;
//! assert!((moves[0].duration_s() - duration_s).abs() < 1e-6);
//! # Ok::<(), ecaxis_axis::setpoint::SetpointError>(())
//! ```

mod line;
mod path;
mod together;

pub use line::{Line, LineAxis, LineError, LinePath};
pub use path::{PathError, PathLimits, PathPlan, PathSegment};
pub use together::arrive_together;
