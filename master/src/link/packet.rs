//! A real network interface through an AF_PACKET socket: no protocol stack, no queueing discipline.

use std::io;
use std::mem;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

use super::{Link, LinkError, MAX_FRAME};

const ETHERCAT: u16 = 0x88a4;

/// Why an interface cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    #[error("the interface `{nic}` does not exist")]
    NoSuchInterface { nic: String },
    #[error("opening a raw socket on `{nic}` is not permitted")]
    NotPermitted { nic: String },
    #[error("the interface `{nic}` is down")]
    Down { nic: String },
    #[error("the interface `{nic}` has no link: no cable, or nothing powered at its end")]
    NoCarrier { nic: String },
    #[error("the interface `{nic}` carries frames of at most {mtu} bytes, 1500 are needed")]
    Mtu { nic: String, mtu: u32 },
    #[error("the interface `{nic}`: {what}: {source}")]
    Io {
        nic: String,
        what: &'static str,
        source: io::Error,
    },
}

/// One interface, taken for EtherCAT frames only.
#[derive(Debug)]
pub struct PacketLink {
    socket: OwnedFd,
}

impl PacketLink {
    /// Opens the interface. Blocks and allocates.
    pub fn open(nic: &str) -> Result<Self, OpenError> {
        let index = interface_index(nic)?;
        // SAFETY: plain system call; the result is checked.
        let fd = unsafe {
            libc::socket(
                libc::AF_PACKET,
                libc::SOCK_RAW | libc::SOCK_NONBLOCK | libc::SOCK_CLOEXEC,
                // Receives nothing, from any interface, until it is bound.
                0,
            )
        };
        if fd < 0 {
            let error = io::Error::last_os_error();
            return Err(if error.kind() == io::ErrorKind::PermissionDenied {
                OpenError::NotPermitted {
                    nic: nic.to_owned(),
                }
            } else {
                OpenError::Io {
                    nic: nic.to_owned(),
                    what: "opening a raw socket",
                    source: error,
                }
            });
        }
        // SAFETY: `fd` is a valid descriptor that nothing else owns.
        let socket = unsafe { OwnedFd::from_raw_fd(fd) };
        check_interface(nic)?;

        // Our own transmissions would otherwise come back as received frames.
        set_option(&socket, libc::SOL_PACKET, libc::PACKET_IGNORE_OUTGOING, 1).map_err(
            |source| OpenError::Io {
                nic: nic.to_owned(),
                what: "PACKET_IGNORE_OUTGOING",
                source,
            },
        )?;
        // Cyclic frames must not wait behind a traffic shaper; an older kernel does without.
        let _ = set_option(&socket, libc::SOL_PACKET, libc::PACKET_QDISC_BYPASS, 1);

        // SAFETY: all-zero is a valid sockaddr_ll.
        let mut address: libc::sockaddr_ll = unsafe { mem::zeroed() };
        address.sll_family = u16::try_from(libc::AF_PACKET).unwrap_or(0);
        address.sll_protocol = ETHERCAT.to_be();
        address.sll_ifindex = index;
        let length = libc::socklen_t::try_from(size_of::<libc::sockaddr_ll>()).unwrap_or(0);
        // SAFETY: the address lives through the call and `length` is its size.
        let bound = unsafe {
            libc::bind(
                socket.as_raw_fd(),
                (&raw const address).cast::<libc::sockaddr>(),
                length,
            )
        };
        if bound < 0 {
            return Err(OpenError::Io {
                nic: nic.to_owned(),
                what: "binding the socket",
                source: io::Error::last_os_error(),
            });
        }
        Ok(Self { socket })
    }
}

impl Link for PacketLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        if frame.len() > MAX_FRAME {
            return Err(LinkError::TooLong(frame.len()));
        }
        match rustix::net::send(&self.socket, frame, rustix::net::SendFlags::empty()) {
            Ok(_) => Ok(()),
            Err(errno) => Err(LinkError::Send(errno)),
        }
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        match rustix::net::recv(&self.socket, &mut buf[..], rustix::net::RecvFlags::empty()) {
            Ok((len, _)) => Ok(Some(len)),
            Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => Ok(None),
            Err(errno) => Err(LinkError::Receive(errno)),
        }
    }
}

fn interface_index(nic: &str) -> Result<i32, OpenError> {
    let missing = || OpenError::NoSuchInterface {
        nic: nic.to_owned(),
    };
    let name = std::ffi::CString::new(nic).map_err(|_| missing())?;
    // SAFETY: `name` is a NUL-terminated string that lives through the call.
    let index = unsafe { libc::if_nametoindex(name.as_ptr()) };
    match i32::try_from(index) {
        Ok(index) if index > 0 => Ok(index),
        _ => Err(missing()),
    }
}

/// Up, with a carrier, and of full frame size, as sysfs tells without privileges.
fn check_interface(nic: &str) -> Result<(), OpenError> {
    let read = |attribute: &str| {
        std::fs::read_to_string(format!("/sys/class/net/{nic}/{attribute}"))
            .map(|text| text.trim().to_owned())
    };
    // Reading `carrier` fails with EINVAL while the interface is down.
    match read("carrier").as_deref() {
        Ok("1") => {}
        Ok(_) => {
            return Err(OpenError::NoCarrier {
                nic: nic.to_owned(),
            });
        }
        Err(error) if error.raw_os_error() == Some(libc::EINVAL) => {
            return Err(OpenError::Down {
                nic: nic.to_owned(),
            });
        }
        // No sysfs: nothing to check against.
        Err(_) => return Ok(()),
    }
    match read("mtu").ok().and_then(|text| text.parse::<u32>().ok()) {
        Some(mtu) if mtu < 1500 => Err(OpenError::Mtu {
            nic: nic.to_owned(),
            mtu,
        }),
        _ => Ok(()),
    }
}

fn set_option(socket: &OwnedFd, level: i32, name: i32, value: i32) -> io::Result<()> {
    let length = libc::socklen_t::try_from(size_of::<i32>()).unwrap_or(0);
    // SAFETY: `value` lives through the call and `length` is its size.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            level,
            name,
            (&raw const value).cast(),
            length,
        )
    };
    if result < 0 {
        Err(io::Error::last_os_error())
    } else {
        Ok(())
    }
}

/// The interfaces of this machine that could carry EtherCAT, for error messages.
#[must_use]
pub fn interfaces() -> Vec<String> {
    let Ok(entries) = std::fs::read_dir("/sys/class/net") else {
        return Vec::new();
    };
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| name != "lo")
        .collect();
    names.sort();
    names
}
