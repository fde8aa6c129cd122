//! What measuring needs: a wire that is made and removed again, something at its other end that answers, and the same cycle
//! that a machine turns. `benches/` and `ecaxis bench` are built on it. May block and allocate.
//!
//! - [`veth`]: two virtual interfaces, connected;
//! - [`reflector`]: answers every frame unchanged after a fixed time;
//! - [`segment`]: drives as the cyclic frames see them; [`bus`]: answers with them from another CPU, [`in_process`]: in
//!   the same thread;
//! - [`rig`]: a machine of such axes, made of the parts of the real cycle;
//! - [`turn`]: turns it and measures; [`kernel`]: what the kernel tells of a CPU meanwhile;
//! - [`wakeup`]: how late a thread wakes up, by the cycle's clock and by cyclictest;
//! - [`exchange`]: what a frame to and fro costs;
//! - [`plan`], [`compare`]: what takes turns, and the rounds of it; [`program`]: another MainDevice; [`machine`]: the bus of a
//!   machine file; [`host`]: the computer;
//! - [`report`], [`remarks`], [`text`], [`html`]: what it came to, and what is to be kept in mind.

pub mod bus;
pub mod compare;
pub mod exchange;
mod held;
pub mod host;
pub mod html;
pub mod in_process;
pub mod kernel;
pub mod machine;
pub mod plan;
pub mod program;
pub mod reflector;
pub mod remarks;
pub mod report;
pub mod rig;
pub mod segment;
mod svg;
pub mod text;
pub mod turn;
pub mod veth;
pub mod wakeup;
