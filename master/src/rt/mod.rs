//! The real-time side. MUST NOT BLOCK OR ALLOCATE: after its preparation, nothing here allocates,
//! locks, logs, or waits for anything but the clock and the wire.
//!
//! - [`config`]: the settings of the cycle;
//! - [`image`]: the layout of the process image;
//! - [`exchange`]: the frames of a cycle, built once and refilled;
//! - [`common_time`]: the time that computers have in common, and the alignment of SYNC0 with it;
//! - [`phase`]: keeps the release of frames in phase with SYNC0;
//! - [`bus_monitor`]: counts bad cycles and decides when the bus is lost;
//! - [`reaction_group`]: axes that stop together, and their release;
//! - [`setpoint_generator`]: set-points from lines, tables and other axes;
//! - [`line_shaft`]: the motion of masters on other machines, and set-points for their followers;
//! - [`setpoint_cell`]: the way of these set-points to and from other threads;
//! - [`axis`]: one axis in the cycle;
//! - [`gateway`]: a CANopen gateway: control word, states of its nodes, phase of SYNC;
//! - [`stats`]: bounded histograms and counters;
//! - [`event_log`]: the events of the cycle, in order;
//! - [`flight_recorder`]: the state of the last cycles;
//! - [`samples`]: a row of values for every cycle, for other threads and processes;
//! - [`heartbeat`]: detects a dead supervisor thread;
//! - [`gantry`]: two axes that move as one;
//! - [`position_output`]: outputs that follow the position of an axis;
//! - [`channel`]: the queues to and from the other threads;
//! - [`controller`]: user code in the cycle;
//! - [`cycle`]: one cycle, from wake-up to publishing;
//! - [`spin`]: the time between the end of the sleep and the release.
//!
//! Constructors run before the loop. They are the only functions that may allocate.

#![cfg_attr(
    not(test),
    deny(
        clippy::disallowed_types,
        clippy::disallowed_methods,
        clippy::disallowed_macros
    )
)]

pub mod axis;
pub mod bus_monitor;
pub mod channel;
pub mod common_time;
pub mod config;
pub mod controller;
pub mod cycle;
pub mod event_log;
pub mod exchange;
pub mod flight_recorder;
pub mod gantry;
pub mod gateway;
pub mod heartbeat;
pub mod image;
pub mod line_shaft;
pub mod overrides;
pub mod phase;
pub mod position_output;
mod power_watch;
pub mod reaction_group;
pub mod samples;
pub mod setpoint_cell;
pub mod setpoint_generator;
pub mod spin;
pub mod stats;
