//! Stops a single thread of another process with ptrace(2).

#![allow(unsafe_code, reason = "ptrace has no safe form")]

use std::io;
use std::marker::PhantomData;
use std::ptr::null_mut;

/// A stopped thread. It runs again when this value is dropped by the thread that created it.
pub(super) struct Frozen {
    thread: libc::pid_t,
    /// Only the tracing thread may release the traced thread.
    _here: PhantomData<*const ()>,
}

/// Stops the process's thread of this name.
#[track_caller]
pub(super) fn thread(process: u32, name: &str) -> Frozen {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).expect("it runs");
    let mut tasks = tasks.map(|task| task.expect("a thread").path());
    let task = tasks.find(|task| {
        let comm = std::fs::read_to_string(task.join("comm")).unwrap_or_default();
        comm.trim_end() == name
    });
    let task = task.unwrap_or_else(|| panic!("no thread `{name}`"));
    let number = task.file_name().and_then(|name| name.to_str());
    let thread: libc::pid_t = number
        .and_then(|number| number.parse().ok())
        .expect("a number");
    // SAFETY: these requests take no pointers, and the status is writable.
    unsafe {
        let traced = libc::ptrace(
            libc::PTRACE_SEIZE,
            thread,
            null_mut::<u8>(),
            null_mut::<u8>(),
        );
        assert_eq!(traced, 0, "{}", io::Error::last_os_error());
        let asked = libc::ptrace(
            libc::PTRACE_INTERRUPT,
            thread,
            null_mut::<u8>(),
            null_mut::<u8>(),
        );
        assert_eq!(asked, 0, "{}", io::Error::last_os_error());
        let mut status = 0;
        let stopped = libc::waitpid(thread, &raw mut status, libc::__WALL);
        assert_eq!(stopped, thread, "{}", io::Error::last_os_error());
    }
    Frozen {
        thread,
        _here: PhantomData,
    }
}

impl Drop for Frozen {
    fn drop(&mut self) {
        // SAFETY: the request takes no pointers; it fails if the thread has ended.
        unsafe {
            libc::ptrace(
                libc::PTRACE_DETACH,
                self.thread,
                null_mut::<u8>(),
                null_mut::<u8>(),
            );
        }
    }
}
