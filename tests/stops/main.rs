//! Stops of machines, groups and axes for every cause, in virtual time.

#![allow(clippy::print_stdout, reason = "what was measured")]

mod brake;
mod bus_faults;
mod causes;
mod exchange;
mod failures;
mod gantry;
mod groups;
mod limits;
mod optional;
mod redundancy;
mod returns;
mod ring_members;
mod segments;
mod unknown;
