//! Tests in real time: processes, signals, network interfaces, real-time threads. They run one
//! after the other, and a failure counts only if the host did not cause it. Most need root.

#![allow(clippy::print_stdout, reason = "what was measured")]

mod bench;
mod chain;
mod eoe;
mod first_steps;
mod gateway;
mod interruptions;
mod link;
mod redundancy;
mod signals;
mod stop_trials;
mod vendors;
mod veth;
mod wait;
