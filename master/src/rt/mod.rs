//! The real-time side. MUST NOT BLOCK OR ALLOCATE: nothing here waits for anything but the clock
//! and the wire, allocates, locks or logs once a value has been prepared.
//!
//! - [`image`]: where each SubDevice's process data lies;
//! - [`exchange`]: the frames of a cycle, built once and refilled;
//! - [`phase`]: keeps the release of frames in phase with SYNC0;
//! - [`guard`]: how many bad cycles the machine rides through;
//! - [`groups`]: what stops together, and when it may come back;
//! - [`feed`]: set-points from lines, tables, other axes;
//! - [`slot`]: one axis in the cycle;
//! - [`stats`]: bounded histograms and counters;
//! - [`journal`]: what the cycle has noticed, in order;
//! - [`history`]: the last cycles as they were;
//! - [`heartbeat`]: whether the thread beside the cycle still runs;
//! - [`handover`]: the queues to and from everybody else;
//! - [`controller`]: a user's own code in the cycle;
//! - [`cycle`]: one turn of the loop, from wake-up to publishing;
//! - [`margin`]: when sleeping ends and spinning begins;
//! - [`awake`]: keeps a CPU from sleeping;
//! - [`thread`]: scheduling class, affinity and memory of the thread that turns it.
//!
//! Constructors run before the loop and may allocate; they are the only functions that may.

#![cfg_attr(
    not(test),
    deny(
        clippy::disallowed_types,
        clippy::disallowed_methods,
        clippy::disallowed_macros
    )
)]

pub mod awake;
pub mod controller;
pub mod cycle;
pub mod exchange;
pub mod feed;
pub mod groups;
pub mod guard;
pub mod handover;
pub mod heartbeat;
pub mod history;
pub mod image;
pub mod journal;
pub mod margin;
pub mod phase;
pub mod slot;
pub mod stats;
pub mod thread;
