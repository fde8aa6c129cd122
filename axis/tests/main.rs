//! The tests of `ecaxis-axis`.

#![allow(clippy::print_stdout, reason = "tests print counts and what they skip")]

mod common;
mod compensation;
mod counting;
mod enabling;
mod explorer;
mod loops;
mod lost_bus;
mod lost_modes;
mod machine;
mod mode_keys;
mod modes;
mod motion;
mod no_alloc;
mod no_alloc_motion;
mod overrides;
mod profiles;
mod properties;
mod reactions;
mod shortest_time;
mod skipped_cycles;
mod stop_room;
mod stops;
mod supervision;
mod sweep;
mod take_up;
