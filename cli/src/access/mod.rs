//! The bus and the device that a subcommand works on, and the signals that end the work.

pub(crate) mod bus;
pub(crate) mod change_log;
pub(crate) mod console;
pub(crate) mod device;
pub(crate) mod rights;
pub(crate) mod signals;
