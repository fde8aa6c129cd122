//! One machine for an interface: who drives it holds a socket of its name, for as long as the process lives. The name is abstract, so it leaves no file
//! behind, and belongs to the network namespace, as the interface does. MAY BLOCK AND ALLOCATE, but for the frames.

use std::io;
use std::os::fd::OwnedFd;

use rustix::io::Errno;
use rustix::net::sockopt::socket_peercred;
use rustix::net::{
    AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with,
};

use super::{BackEnd, Concern, Link, LinkError, LinkStats, MAX_FRAME, Nanos, OpenError, capture};

/// A holder may go between two looks at it.
const TRIES: u32 = 3;

/// An interface that this program drives.
#[derive(Debug)]
pub struct Claim {
    _held: OwnedFd,
}

/// Another program drives it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Taken {
    /// Its process, where it can be asked.
    pub pid: Option<i32>,
}

impl Claim {
    /// `None`: this system has no such sockets, and nobody can be kept away.
    ///
    /// # Errors
    /// [`Taken`].
    pub fn take(nic: &str) -> Result<Option<Self>, Taken> {
        let mut holder = Taken { pid: None };
        for _ in 0..TRIES {
            match hold(nic) {
                Ok(held) => return Ok(Some(Self { _held: held })),
                Err(Errno::ADDRINUSE) => {}
                Err(error) => {
                    tracing::debug!("`{nic}` cannot be claimed: {error}");
                    return Ok(None);
                }
            }
            match holder_of(nic) {
                Ok(pid) => {
                    holder.pid = Some(pid);
                    break;
                }
                // It has gone just now.
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

/// Never waits: nobody takes the connections that askers make.
fn socket() -> Result<OwnedFd, Errno> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)
}

fn hold(nic: &str) -> Result<OwnedFd, Errno> {
    let socket = socket()?;
    bind(&socket, &name(nic)?)?;
    listen(&socket, 1)?;
    Ok(socket)
}

fn holder_of(nic: &str) -> Result<i32, Errno> {
    let socket = socket()?;
    connect(&socket, &name(nic)?)?;
    Ok(socket_peercred(&socket)?.pid.as_raw_nonzero().get())
}

/// A link to an interface that nobody else drives meanwhile.
#[derive(Debug)]
struct Claimed {
    link: Box<dyn Link>,
    _claim: Option<Claim>,
}

impl Link for Claimed {
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

    fn remarks(&mut self) -> Vec<String> {
        self.link.remarks()
    }

    fn lacks(&self) -> Option<&'static str> {
        self.link.lacks()
    }

    fn finish(self: Box<Self>) -> io::Result<Option<capture::RecordStats>> {
        self.link.finish()
    }
}

/// As [`super::open`], for somebody who leads the segment: one program at a time.
///
/// # Errors
/// [`OpenError::Taken`] where another one has it, and why the interface cannot be used.
pub fn open_alone(
    nic: &str,
    back_end: BackEnd,
) -> Result<(Box<dyn Link>, Vec<Concern>), OpenError> {
    let claim = Claim::take(nic).map_err(|Taken { pid }| OpenError::Taken {
        nic: nic.to_owned(),
        pid,
    })?;
    let (link, concerns) = super::open(nic, back_end)?;
    let claimed = Claimed {
        link,
        _claim: claim,
    };
    Ok((Box::new(claimed), concerns))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_at_a_time() {
        let own = i32::try_from(std::process::id()).expect("a process");
        let nic = format!("test{own}");
        let claim = Claim::take(&nic).expect("free").expect("Linux has them");
        // However often somebody asks, nobody waits.
        for _ in 0..300 {
            let taken = Claim::take(&nic).expect_err("taken");
            assert!(taken.pid.is_none_or(|pid| pid == own), "{taken:?}");
        }
        assert!(Claim::take("another").expect("free").is_some());
        drop(claim);
        let claim = Claim::take(&nic).expect("free again").expect("as before");
        let taken = Claim::take(&nic).expect_err("taken");
        assert_eq!(taken.pid, Some(own));
        drop(claim);
    }
}
