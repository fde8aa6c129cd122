//! Queries to a network driver: `SIOCETHTOOL` of linux/ethtool.h. No privileges needed.

use std::io;
use std::mem;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

use super::checked;

const SIOCETHTOOL: u32 = 0x8946;

/// The 32-bit words of an answer. The longest structure queried, ethtool_drvinfo, has 49.
pub const WORDS: usize = 64;

/// Read-only commands whose answer is a structure of fixed length that fits into [`WORDS`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum EthtoolCommand {
    DriverInfo = 0x03,
    Coalescing = 0x0e,
    Ring = 0x10,
    Flags = 0x25,
    GenericReceiveOffload = 0x2b,
    Channels = 0x3c,
    EnergyEfficient = 0x44,
}

/// A socket for ethtool queries on one interface.
#[derive(Debug)]
pub struct EthtoolSocket {
    socket: OwnedFd,
    name: [libc::c_char; libc::IFNAMSIZ],
}

impl EthtoolSocket {
    /// # Errors
    /// `InvalidInput` if `nic` cannot be an interface name, otherwise the error of socket(2).
    pub fn of(nic: &str) -> io::Result<Self> {
        let mut name = [0; libc::IFNAMSIZ];
        // The terminating NUL stays.
        if nic.is_empty() || nic.len() >= name.len() {
            return Err(io::Error::from(io::ErrorKind::InvalidInput));
        }
        for (to, from) in name.iter_mut().zip(nic.bytes()) {
            *to = libc::c_char::from_ne_bytes([from]);
        }
        // SAFETY: plain system call; the result is checked.
        let fd = checked(unsafe {
            libc::socket(libc::AF_INET, libc::SOCK_DGRAM | libc::SOCK_CLOEXEC, 0)
        })?;
        // SAFETY: `fd` is a valid descriptor that nothing else owns.
        let socket = unsafe { OwnedFd::from_raw_fd(fd) };
        Ok(Self { socket, name })
    }

    /// Returns the answer structure as words; the first word repeats the command.
    ///
    /// # Errors
    /// The driver's error; `EOPNOTSUPP` if it does not support the command.
    pub fn ask(&self, question: EthtoolCommand) -> io::Result<[u32; WORDS]> {
        let mut answer = [0_u32; WORDS];
        answer[0] = question as u32;
        // SAFETY: all-zero is a valid ifreq.
        let mut request: libc::ifreq = unsafe { mem::zeroed() };
        request.ifr_name = self.name;
        request.ifr_ifru.ifru_data = answer.as_mut_ptr().cast();
        // The type of the request code differs between C libraries.
        let code = SIOCETHTOOL as _;
        // SAFETY: the kernel writes the command's structure to `answer`. `answer` is longer than
        // any of these structures and lives through the call.
        checked(unsafe { libc::ioctl(self.socket.as_raw_fd(), code, &raw mut request) })?;
        Ok(answer)
    }
}
