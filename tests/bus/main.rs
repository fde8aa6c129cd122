//! Whole-bus runs on the simulated bus in virtual time: from a machine file to the motion of the
//! axes.

#![allow(clippy::print_stdout, reason = "what was measured")]

mod axes;
mod bring_up;
mod cabling;
mod cams;
mod clock_wrap;
mod clocks;
mod common_time;
mod compensation;
mod controller;
mod copy;
mod cycles;
mod damaged_eeprom;
mod demo;
mod eeproms;
mod eoe;
mod flow;
mod fsoe;
mod gateway_axes;
mod gateway_stops;
mod homing;
mod long_segment;
mod lrw;
mod mailbox_gateway;
mod mailbox_sizes;
mod mailboxes;
mod oddities;
mod overrides;
mod paths;
mod phase;
mod position_outputs;
mod probe;
mod profile_modes;
mod program;
mod repeats;
mod samples;
mod several_axes;
mod soe;
mod soe_idns;
mod soe_stops;
mod states;
mod superimpose;
mod units;
mod vendor_esi;
