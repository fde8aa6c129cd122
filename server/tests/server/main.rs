//! The server as its clients see it, on the simulated bus.

mod area;
mod commands;
mod faults;
mod fuzz;
mod harness;
mod hostile;
mod http;
mod lease;
mod streams;
