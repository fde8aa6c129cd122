//! The server as its clients see it, on the simulated bus.

#![allow(clippy::print_stdout, reason = "tests print what they measured")]

mod area;
mod commands;
mod documented;
mod faults;
mod foxglove;
mod fuzz;
mod harness;
mod hostile;
mod http;
mod lease;
mod leases;
mod line_shaft;
mod memory;
mod ros2;
mod rust_client;
mod samples;
mod streams;
mod websocket;
