//! A simulated EtherCAT segment with its own frame codec. Deterministic under virtual time.

pub mod coe;
pub mod drive;

/// True time of the simulated world, in nanoseconds. Every device's own clock drifts from it.
pub type Nanos = u64;
