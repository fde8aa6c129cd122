//! What the tests of several packages share.

#![allow(
    missing_debug_implementations,
    clippy::print_stderr,
    clippy::print_stdout,
    reason = "only tests use it"
)]

pub mod mailbox;
