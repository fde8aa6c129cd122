//! System calls that have no safe form elsewhere: ALL UNSAFE CODE OF THIS CRATE. Nothing here decides anything; each
//! function is one call, or one mapping with the rules that keep it sound.
//!
//! - [`packet`]: AF_PACKET sockets;
//! - [`ethtool`]: questions to a network driver;
//! - [`ring`]: the memory that the kernel puts received frames into;
//! - [`process`]: what the kernel counts for a thread, and the heap's settings;
//! - [`signal`]: which signals the process ignores.

#![allow(unsafe_code, reason = "this is the place for it")]

pub mod ethtool;
pub mod packet;
pub mod process;
pub mod ring;
pub mod signal;

use std::io;

/// A C function's result, where negative is an error.
fn checked(result: libc::c_int) -> io::Result<libc::c_int> {
    if result < 0 {
        Err(io::Error::last_os_error())
    } else {
        Ok(result)
    }
}

/// The length of a value as system calls take it.
fn length<T>() -> libc::socklen_t {
    libc::socklen_t::try_from(size_of::<T>()).unwrap_or(0)
}
