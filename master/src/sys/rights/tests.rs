//! Rights cannot be returned, so each test runs its checks in a process of its own.

use std::io::ErrorKind;
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;

use rustix::io::Errno;

use super::*;

/// The folder of the checks; set in the processes that run them.
const FOLDER: &str = "ECAXIS_TEST_RIGHTS";

/// Runs the test of this name again, in another process, where `checks` run instead.
fn in_own_process(name: &str, checks: impl FnOnce(&Path)) {
    if let Some(folder) = std::env::var_os(FOLDER) {
        return checks(Path::new(&folder));
    }
    let folder = tempfile::tempdir().unwrap();
    for made in ["in", "out"] {
        std::fs::create_dir(folder.path().join(made)).unwrap();
        std::fs::write(folder.path().join(made).join("old"), "old").unwrap();
    }
    let name = format!("sys::rights::tests::{name}");
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", &name, "--nocapture"]);
    let done = command.env(FOLDER, folder.path()).output().unwrap();
    let text = String::from_utf8_lossy(&done.stdout);
    let errors = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{text}{errors}");
    assert!(text.contains("1 passed"), "{text}{errors}");
}

fn limit(folder: &Path) -> Vec<RightsError> {
    limit_process(&NeededRights {
        write: vec![folder.join("in")],
        ..NeededRights::default()
    })
}

fn denied<T>(result: std::io::Result<T>) -> bool {
    result.is_err_and(|error| error.kind() == ErrorKind::PermissionDenied)
}

#[test]
fn only_needed_folders_are_open() {
    in_own_process("only_needed_folders_are_open", |folder| {
        let errors = limit(folder);
        // Linux has folders since 5.13 and connections since 6.7; older kernels are reported.
        let reported = |what| errors.iter().any(|e| e.to_string().ends_with(what));
        if reported("the kernel does not have it") {
            return;
        }
        let check = |inside: bool, name: &str| {
            let at = folder.join(if inside { "in" } else { "out" });
            let new = at.join(name);
            assert_eq!(!denied(std::fs::write(&new, "new")), inside, "{new:?}");
            for (done, what) in [
                (denied(std::fs::write(at.join("old"), "new")), "write"),
                (denied(std::fs::read(at.join("old"))), "read"),
                (denied(std::fs::read_dir(&at)), "list"),
                (
                    denied(std::fs::create_dir(at.join(name).with_extension("d"))),
                    "create",
                ),
                (denied(std::fs::remove_file(at.join("old"))), "remove"),
            ] {
                assert_eq!(done, !inside, "{what} in {at:?}");
            }
            std::fs::write(folder.join("in/old"), "old").unwrap();
        };
        check(true, "a");
        check(false, "a");
        // Threads inherit the limits.
        std::thread::scope(|scope| {
            let other = scope.spawn(|| check(false, "b"));
            other.join().unwrap();
        });
        assert!(std::fs::read("/proc/self/status").is_ok());
        // A file of others, which every user may read.
        assert!(denied(std::fs::read("/etc/passwd")));
        assert!(denied(std::fs::write("/proc/self/comm", "x")));
        if reported("(Linux 6.7 has all)") {
            return;
        }
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        assert!(denied(TcpStream::connect(listener.local_addr().unwrap())));
    });
}

#[test]
fn other_programs_and_sockets_are_refused() {
    in_own_process("other_programs_and_sockets_are_refused", |folder| {
        let before = capabilities(None).unwrap().permitted;
        let errors = limit(folder);
        assert!(
            !errors.iter().any(|e| matches!(e, RightsError::Seccomp(_))),
            "{errors:?}"
        );
        // The test harness prints the output of this process, which is not a thread of ours.
        assert!(denied(Command::new("/bin/true").status()));
        let domain = |family: libc::c_int| {
            let family = rustix::net::AddressFamily::from_raw(family.try_into().unwrap());
            rustix::net::socket(family, rustix::net::SocketType::DGRAM, None).err()
        };
        assert_eq!(domain(libc::AF_INET), None);
        for family in [libc::AF_ALG, libc::AF_VSOCK, libc::AF_BLUETOOTH] {
            assert_eq!(domain(family), Some(Errno::PERM));
        }
        let kept = capabilities(None).unwrap();
        assert_eq!(kept.permitted, before & BRING_UP);
        assert_eq!(kept.inheritable, CapabilitySet::empty());
        drop_capabilities_after_start();
        assert_eq!(capabilities(None).unwrap().permitted, before & BRING_UP);
        drop_capabilities();
        assert_eq!(capabilities(None).unwrap().permitted, before & FILES);
    });
}

/// Makes a system call, and returns its result or the error of the kernel.
fn call(number: libc::c_long, arguments: [usize; 2]) -> Result<libc::c_long, Errno> {
    // SAFETY: the calls of the tests get numbers, and pointers to nothing.
    let result = unsafe { libc::syscall(number, arguments[0], arguments[1], 0, 0, 0) };
    match result {
        -1 => Err(Errno::from_io_error(&std::io::Error::last_os_error()).unwrap()),
        result => Ok(result),
    }
}

/// Starts a process by `clone` that ends at once.
fn clone(flags: libc::c_int) -> Result<libc::c_long, Errno> {
    let flags = usize::try_from(flags | libc::SIGCHLD).unwrap();
    let process = call(libc::SYS_clone, [flags, 0])?;
    if process == 0 {
        // SAFETY: ends the new process; nothing of this one is cleaned up there.
        unsafe { libc::_exit(0) };
    }
    Ok(process)
}

#[test]
fn namespaces_and_calls_of_x32_are_refused_and_threads_start() {
    in_own_process(
        "namespaces_and_calls_of_x32_are_refused_and_threads_start",
        |folder| {
            limit(folder);
            let user = usize::try_from(libc::CLONE_NEWUSER).unwrap();
            assert_eq!(call(libc::SYS_unshare, [user, 0]), Err(Errno::PERM));
            for flag in [
                libc::CLONE_NEWUSER,
                libc::CLONE_NEWNET,
                libc::CLONE_NEWNS | libc::CLONE_NEWPID,
            ] {
                assert_eq!(clone(flag), Err(Errno::PERM), "{flag:#x}");
            }
            assert!(clone(0).is_ok());
            // Without the filter, EFAULT.
            assert_eq!(call(libc::SYS_clone3, [0, 64]), Err(Errno::NOSYS));
            // Without the filter, a number, or ENOSYS if the kernel has no x32.
            #[cfg(target_arch = "x86_64")]
            assert_eq!(
                call(0x4000_0000 | libc::SYS_getpid, [0; 2]),
                Err(Errno::PERM)
            );
            assert!(call(libc::SYS_getpid, [0; 2]).is_ok());
            let thread = std::thread::Builder::new().spawn(|| 7).unwrap();
            assert_eq!(thread.join().unwrap(), 7);
        },
    );
}

#[test]
fn the_cycle_has_the_clock_and_memory_but_no_files() {
    in_own_process(
        "the_cycle_has_the_clock_and_memory_but_no_files",
        |folder| {
            // Without the first, the second changes nothing.
            limit_cycle().unwrap();
            assert!(std::fs::read(folder.join("in/old")).is_ok());
            limit(folder);
            std::thread::scope(|scope| {
                let cycle = scope.spawn(|| {
                    limit_cycle().unwrap();
                    assert!(denied(std::fs::read(folder.join("in/old"))));
                    assert!(denied(std::net::UdpSocket::bind("127.0.0.1:0")));
                    assert!(std::thread::Builder::new().spawn(|| {}).is_err());
                    std::thread::sleep(std::time::Duration::from_millis(1));
                    std::hint::black_box(vec![1_u8; 64 << 20]);
                    assert!(std::panic::catch_unwind(|| panic!("of the test")).is_err());
                });
                cycle.join().unwrap();
            });
            // The other threads are as before.
            assert!(std::fs::read(folder.join("in/old")).is_ok());
        },
    );
}
