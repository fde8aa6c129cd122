//! Signal dispositions: sigaction(2).

use std::{io, mem, ptr};

use super::checked;

/// Returns whether the process ignores a signal, as `nohup` does with SIGHUP.
///
/// # Errors
/// The error of sigaction(2).
pub fn is_ignored(signal: libc::c_int) -> io::Result<bool> {
    // SAFETY: all-zero is a valid sigaction.
    let mut old: libc::sigaction = unsafe { mem::zeroed() };
    // SAFETY: without a new action the call only writes to `old`.
    checked(unsafe { libc::sigaction(signal, ptr::null(), &raw mut old) })?;
    Ok(old.sa_sigaction == libc::SIG_IGN)
}

/// Makes the process ignore a signal.
///
/// # Errors
/// The error of sigaction(2).
pub fn ignore(signal: libc::c_int) -> io::Result<()> {
    // SAFETY: all-zero is a valid sigaction.
    let mut action: libc::sigaction = unsafe { mem::zeroed() };
    action.sa_sigaction = libc::SIG_IGN;
    // SAFETY: `action` is valid; SIG_IGN runs no code of this process.
    checked(unsafe { libc::sigaction(signal, &raw const action, ptr::null_mut()) })?;
    Ok(())
}
