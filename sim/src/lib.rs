//! A simulated EtherCAT segment with its own frame codec. Deterministic under virtual time.

mod bits;
pub mod coe;
pub mod drive;
pub mod esc;
pub mod frame;

/// True time of the simulated world, in nanoseconds. Every device's own clock drifts from it.
pub type Nanos = u64;
