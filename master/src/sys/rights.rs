//! Least rights for a program that runs one machine: capabilities, folders (landlock) and system
//! calls (seccomp) that it does not need are given up, for good.
//!
//! [`limit_process`] runs before the program starts a thread, because all three apply to a thread
//! and to those that it starts. Each thread that needs less then calls [`drop_capabilities`] or
//! [`limit_cycle`]. Without [`limit_process`], they change nothing.
//!
//! A call that a filter refuses fails with EPERM. Nothing here ends the process: a call that the
//! lists lack must not stop a machine in motion.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use landlock::{
    ABI, AccessFs, AccessNet, Ruleset, RulesetAttr as _, RulesetCreatedAttr as _, RulesetStatus,
    path_beneath_rules,
};
use rustix::thread::{CapabilitySet, CapabilitySets, capabilities, set_capabilities};

mod filter;

/// What a thread needs that writes files. In a process with locked memory, every allocation locks
/// memory. Root may write files of other users, as far as landlock permits.
const FILES: CapabilitySet = CapabilitySet::IPC_LOCK.union(CapabilitySet::DAC_OVERRIDE);
/// What a thread needs that brings up a bus: raw sockets and SCHED_FIFO besides.
const BRING_UP: CapabilitySet = FILES
    .union(CapabilitySet::NET_RAW)
    .union(CapabilitySet::SYS_NICE);

/// Folders and files that are read although no option names them. `/etc` has secrets of other
/// programs: only the C library reads there. No name of a host or a user is resolved.
const SYSTEM: [&str; 8] = [
    "/proc",
    "/sys",
    "/dev",
    "/usr",
    "/lib",
    "/lib64",
    "/etc/ld.so.cache",
    "/etc/localtime",
];
/// Files that are written although no option names them.
const DEVICES: [&str; 4] = [
    "/dev/cpu_dma_latency",
    "/dev/net/tun",
    "/dev/null",
    "/dev/tty",
];

static LIMITED: AtomicBool = AtomicBool::new(false);
static ONE_BRING_UP: AtomicBool = AtomicBool::new(false);

/// What the process still needs after [`limit_process`].
#[derive(Debug, Clone, Default)]
pub struct NeededRights {
    /// Files and folders that are read.
    pub read: Vec<PathBuf>,
    /// Files and folders in which files are created, written and removed.
    pub write: Vec<PathBuf>,
    /// True if the process binds a port below 1024.
    pub low_port: bool,
    /// True if the process creates a network interface.
    pub interface: bool,
    /// True if the bus is brought up once. Otherwise the rights for that stay with the threads that
    /// bring it up again.
    pub one_bring_up: bool,
}

/// Rights that could not be given up.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RightsError {
    #[error("capabilities cannot be dropped: {0}")]
    Capabilities(String),
    #[error("landlock is not available: {0}")]
    Landlock(String),
    #[error("seccomp is not available: {0}")]
    Seccomp(String),
}

/// Gives up what the process does not need. Call it before the first thread starts. Returns what was
/// not possible; everything else is done.
pub fn limit_process(needed: &NeededRights) -> Vec<RightsError> {
    let mut denied = Vec::new();
    // Never denied; landlock and seccomp need it.
    let _ = rustix::thread::set_no_new_privs(true);
    let low_port = match needed.low_port {
        true => CapabilitySet::NET_BIND_SERVICE,
        false => CapabilitySet::empty(),
    };
    let interface = match needed.interface {
        true => CapabilitySet::NET_ADMIN,
        false => CapabilitySet::empty(),
    };
    denied.extend(keep_capabilities(BRING_UP | low_port | interface).err());
    denied.extend(limit_folders(needed).err().map(RightsError::Landlock));
    denied.extend(filter::limit_process().err().map(RightsError::Seccomp));
    ONE_BRING_UP.store(needed.one_bring_up, Ordering::Relaxed);
    LIMITED.store(true, Ordering::Relaxed);
    denied
}

/// Drops the capabilities of a thread that brings up no bus.
pub fn drop_capabilities() {
    if LIMITED.load(Ordering::Relaxed) {
        // Never denied: capabilities become fewer.
        let _ = keep_capabilities(FILES);
    }
}

/// Drops the capabilities of the thread that has started the only bring-up.
pub fn drop_capabilities_after_start() {
    if ONE_BRING_UP.load(Ordering::Relaxed) {
        drop_capabilities();
    }
}

/// Drops the capabilities of the thread of the cycle. Permits it only the system calls of the cycle
/// and of the way back to Init.
///
/// # Errors
/// Fails if the kernel has no filters for system calls.
pub fn limit_cycle() -> Result<(), RightsError> {
    if !LIMITED.load(Ordering::Relaxed) {
        return Ok(());
    }
    keep_capabilities(CapabilitySet::IPC_LOCK)?;
    filter::limit_cycle().map_err(RightsError::Seccomp)
}

/// Keeps those of the thread's capabilities that are in `kept`.
fn keep_capabilities(kept: CapabilitySet) -> Result<(), RightsError> {
    let failed = |error: rustix::io::Errno| RightsError::Capabilities(error.to_string());
    let now = capabilities(None).map_err(failed)?;
    let fewer = CapabilitySets {
        effective: now.effective & kept,
        permitted: now.permitted & kept,
        inheritable: CapabilitySet::empty(),
    };
    set_capabilities(None, fewer).map_err(failed)
}

/// Permits the calling thread, and those that it starts, to read and write in the needed folders
/// only, and to open no TCP connection.
fn limit_folders(needed: &NeededRights) -> Result<(), String> {
    // Version 3 handles truncation. Version 4 handles TCP.
    let (read, write) = (AccessFs::from_read(ABI::V3), AccessFs::from_write(ABI::V3));
    let read_only = read & !AccessFs::Execute;
    let restrict = || {
        let rules = Ruleset::default()
            .handle_access(read | write)?
            .handle_access(AccessNet::ConnectTcp)?
            .create()?
            .add_rules(path_beneath_rules(SYSTEM, read_only))?
            .add_rules(path_beneath_rules(&needed.read, read_only))?
            .add_rules(path_beneath_rules(DEVICES, read_only | write))?
            .add_rules(path_beneath_rules(&needed.write, read_only | write))?;
        rules.restrict_self()
    };
    match restrict().map_err(|error| error.to_string())?.ruleset {
        RulesetStatus::FullyEnforced => Ok(()),
        RulesetStatus::PartiallyEnforced => {
            Err("the kernel has only a part of it (Linux 6.7 has all)".to_owned())
        }
        RulesetStatus::NotEnforced => Err("the kernel does not have it".to_owned()),
    }
}

#[cfg(test)]
#[allow(unsafe_code, reason = "the tests make calls that no library offers")]
mod tests;
