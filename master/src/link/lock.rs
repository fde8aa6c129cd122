//! Ensures one program per interface. The program that uses an interface holds a socket named after
//! it until the process ends. The name is abstract: it leaves no file, and it belongs to the
//! network namespace, like the interface. MAY BLOCK AND ALLOCATE, except when sending and receiving
//! frames.

use std::io;
use std::os::fd::OwnedFd;

use rustix::io::Errno;
use rustix::net::sockopt::socket_peercred;
use rustix::net::{
    AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with,
};

use super::redundant::RingStatus;
use super::{
    Link, LinkError, LinkStats, MAX_FRAME, Nanos, NicWarning, OpenError, SocketKind, capture,
};

/// The holder may exit between two attempts.
const MAX_ATTEMPTS: u32 = 3;

/// The lock on an interface.
#[derive(Debug)]
pub struct NicLock {
    _held: OwnedFd,
}

/// Another program uses the interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NicInUse {
    /// Its process id, if known.
    pub pid: Option<i32>,
}

impl NicLock {
    /// Takes the lock. Returns `None` if the system has no abstract sockets; then nothing is
    /// locked.
    ///
    /// # Errors
    /// [`NicInUse`] if another program holds the lock.
    pub fn take(nic: &str) -> Result<Option<Self>, NicInUse> {
        let mut holder = NicInUse { pid: None };
        for _ in 0..MAX_ATTEMPTS {
            match bind_lock_socket(nic) {
                Ok(held) => return Ok(Some(Self { _held: held })),
                Err(Errno::ADDRINUSE) => {}
                Err(error) => {
                    tracing::debug!("`{nic}` cannot be claimed: {error}");
                    return Ok(None);
                }
            }
            match lock_owner(nic) {
                Ok(pid) => {
                    holder.pid = Some(pid);
                    break;
                }
                // The holder has just exited.
                Err(Errno::CONNREFUSED) => {}
                Err(_) => break,
            }
        }
        Err(holder)
    }
}

fn name(nic: &str) -> Result<SocketAddrUnix, Errno> {
    SocketAddrUnix::new_abstract_name(format!("ecaxis/{nic}").as_bytes())
}

/// Never blocks: connections of other programs are never accepted.
fn socket() -> Result<OwnedFd, Errno> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)
}

fn bind_lock_socket(nic: &str) -> Result<OwnedFd, Errno> {
    let socket = socket()?;
    bind(&socket, &name(nic)?)?;
    listen(&socket, 1)?;
    Ok(socket)
}

fn lock_owner(nic: &str) -> Result<i32, Errno> {
    let socket = socket()?;
    connect(&socket, &name(nic)?)?;
    Ok(socket_peercred(&socket)?.pid.as_raw_nonzero().get())
}

/// A link to an interface that is locked for other programs.
#[derive(Debug)]
struct LockedLink {
    link: Box<dyn Link>,
    _claim: Option<NicLock>,
}

impl Link for LockedLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        self.link.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.link.recv(buf)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.link.next_arrival()
    }

    fn main_devices(&self) -> u64 {
        self.link.main_devices()
    }

    fn stats(&mut self) -> LinkStats {
        self.link.stats()
    }

    fn notices(&mut self) -> Vec<String> {
        self.link.notices()
    }

    fn ring(&self) -> Option<&'static RingStatus> {
        self.link.ring()
    }

    fn nic(&self) -> Option<&str> {
        self.link.nic()
    }

    fn exhausted_reason(&self) -> Option<&'static str> {
        self.link.exhausted_reason()
    }

    fn finish(self: Box<Self>) -> io::Result<Option<capture::RecordStats>> {
        self.link.finish()
    }
}

/// Opens an interface like [`super::open`], for the program that drives the segment. Only one
/// program can do so at a time.
///
/// # Errors
/// [`OpenError::Taken`] if another program holds the interface, or the reason why it cannot be
/// used.
pub fn open_exclusive(
    nic: &str,
    back_end: SocketKind,
) -> Result<(Box<dyn Link>, Vec<NicWarning>), OpenError> {
    locked(nic, || super::open(nic, back_end))
}

/// Like [`open_exclusive`], for one end of a ring ([`super::open_end`]).
///
/// # Errors
/// As [`open_exclusive`].
pub fn open_end_exclusive(
    nic: &str,
    back_end: SocketKind,
) -> Result<(Box<dyn Link>, Vec<NicWarning>), OpenError> {
    locked(nic, || super::open_end(nic, back_end))
}

type Opened = Result<(Box<dyn Link>, Vec<NicWarning>), OpenError>;

fn locked(nic: &str, open: impl FnOnce() -> Opened) -> Opened {
    let claim = NicLock::take(nic).map_err(|NicInUse { pid }| OpenError::Taken {
        nic: nic.to_owned(),
        pid,
    })?;
    let (link, concerns) = open()?;
    let claimed = LockedLink {
        link,
        _claim: claim,
    };
    Ok((Box::new(claimed), concerns))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nic_lock_admits_one_program_at_a_time() {
        let own = i32::try_from(std::process::id()).expect("a process");
        let nic = format!("test{own}");
        let claim = NicLock::take(&nic).expect("free").expect("Linux has them");
        // Many attempts must not block any program.
        for _ in 0..300 {
            let taken = NicLock::take(&nic).expect_err("taken");
            assert!(taken.pid.is_none_or(|pid| pid == own), "{taken:?}");
        }
        assert!(NicLock::take("another").expect("free").is_some());
        drop(claim);
        let claim = NicLock::take(&nic).expect("free again").expect("as before");
        let taken = NicLock::take(&nic).expect_err("taken");
        assert_eq!(taken.pid, Some(own));
        drop(claim);
    }
}
