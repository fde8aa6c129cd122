//! System calls without a safe wrapper elsewhere: ALL UNSAFE CODE OF THIS CRATE. Nothing here makes
//! decisions. Each function is one call, or one mapping with the rules that keep it sound.
//!
//! - [`packet`]: AF_PACKET sockets;
//! - [`ethtool`]: queries to a network driver;
//! - [`ring`]: the receive ring that is shared with the kernel;
//! - [`process`]: the resource usage of a thread, and the settings of the heap;
//! - [`shared_memory`]: memory that other processes can map;
//! - [`signal`]: the signals that the process ignores;
//! - [`tap`]: TAP interfaces.
//!
//! And what blocks or opens files, without unsafe code:
//!
//! - [`rt_thread`]: scheduling class, affinity and memory of the thread of the cycle;
//! - [`idle_spinner`]: keeps a CPU from its idle states;
//! - [`rights`]: gives up rights of the process and of threads;
//! - [`executor`]: runs a future on its thread, with an eventfd as the waker.

#![allow(unsafe_code, reason = "all unsafe code is in this module")]

pub mod ethtool;
#[deny(unsafe_code)]
pub mod executor;
#[deny(unsafe_code)]
pub mod idle_spinner;
pub mod packet;
pub mod process;
#[deny(unsafe_code)]
pub mod rights;
pub mod ring;
#[deny(unsafe_code)]
pub mod rt_thread;
pub mod shared_memory;
pub mod signal;
pub mod tap;

use std::io;

/// Converts the result of a C function, where negative means an error.
fn checked(result: libc::c_int) -> io::Result<libc::c_int> {
    if result < 0 {
        Err(io::Error::last_os_error())
    } else {
        Ok(result)
    }
}

/// Returns the size of `T` in the type that system calls take.
fn length<T>() -> libc::socklen_t {
    libc::socklen_t::try_from(size_of::<T>()).unwrap_or(0)
}
