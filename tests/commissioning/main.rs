//! From an unknown bus to a running machine: `scan`, `compare`, parameters, EEPROMs and firmware of
//! simulated devices. `ECAXIS_UPDATE_SNAPSHOTS=1` writes `tests/snapshots/scan` again; review the
//! difference.

mod compare;
mod firmware;
mod parameters;
mod scan;
