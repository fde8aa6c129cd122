//! A raw socket on one interface, with the kernel's arrival time of every frame.

use std::ffi::CString;
use std::io;
use std::mem;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::ptr;

use super::ServeError;
use crate::Nanos;

/// A buffer for one control message with a time stamp, aligned for the message header.
type Control = [u64; 8];

#[derive(Debug)]
pub(super) struct RawSocket {
    fd: OwnedFd,
    nic: CString,
    index: u32,
}

/// A received frame in the caller's buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Received {
    pub(super) len: usize,
    /// Monotonic time of the arrival at the interface.
    pub(super) at: Nanos,
    /// True if the frame was longer than the buffer.
    pub(super) cut: bool,
}

impl RawSocket {
    pub(super) fn open(nic: &str) -> Result<Self, ServeError> {
        let failed = |what| {
            move |source| ServeError::Io {
                nic: nic.to_owned(),
                what,
                source,
            }
        };
        let name = CString::new(nic).map_err(|_| ServeError::NoSuchInterface(nic.to_owned()))?;
        // SAFETY: `name` is NUL-terminated and lives through the call.
        let index = unsafe { libc::if_nametoindex(name.as_ptr()) };
        let number = i32::try_from(index).unwrap_or(0);
        if number == 0 {
            return Err(ServeError::NoSuchInterface(nic.to_owned()));
        }
        // Without a protocol, the socket receives no frames of other interfaces until `bind`.
        // SAFETY: plain system call; the result is checked.
        let fd = unsafe {
            libc::socket(
                libc::AF_PACKET,
                libc::SOCK_RAW | libc::SOCK_CLOEXEC | libc::SOCK_NONBLOCK,
                0,
            )
        };
        if fd < 0 {
            let source = io::Error::last_os_error();
            return Err(if source.kind() == io::ErrorKind::PermissionDenied {
                ServeError::NotPermitted(nic.to_owned())
            } else {
                failed("opening a raw socket")(source)
            });
        }
        // SAFETY: `fd` is a valid descriptor that nothing else owns.
        let fd = unsafe { OwnedFd::from_raw_fd(fd) };
        let socket = Self {
            fd,
            nic: name,
            index,
        };

        // Without stamps, the time of the receive call applies.
        let _ = socket.set(libc::SOL_SOCKET, libc::SO_TIMESTAMPNS, &1_i32);
        // The socket must not receive our own replies. On older kernels, the packet type excludes
        // them.
        let _ = socket.set(libc::SOL_PACKET, libc::PACKET_IGNORE_OUTGOING, &1_i32);
        // Replies must not wait behind a traffic shaper.
        let _ = socket.set(libc::SOL_PACKET, libc::PACKET_QDISC_BYPASS, &1_i32);
        // The destination address of a MainDevice need not be the broadcast address.
        let everything = libc::packet_mreq {
            mr_ifindex: number,
            mr_type: libc::PACKET_MR_PROMISC as libc::c_ushort,
            mr_alen: 0,
            mr_address: [0; 8],
        };
        socket
            .set(libc::SOL_PACKET, libc::PACKET_ADD_MEMBERSHIP, &everything)
            .map_err(failed("switching to promiscuous mode"))?;

        // SAFETY: all-zero is a valid sockaddr_ll.
        let mut address: libc::sockaddr_ll = unsafe { mem::zeroed() };
        address.sll_family = libc::AF_PACKET as libc::c_ushort;
        address.sll_protocol = (libc::ETH_P_ALL as u16).to_be();
        address.sll_ifindex = number;
        // SAFETY: the address lives through the call and the length is its size.
        let bound = unsafe {
            libc::bind(
                socket.fd.as_raw_fd(),
                (&raw const address).cast(),
                size_of_val(&address) as libc::socklen_t,
            )
        };
        if bound < 0 {
            return Err(failed("binding the socket")(io::Error::last_os_error()));
        }
        let mut len = size_of_val(&address) as libc::socklen_t;
        // SAFETY: address and length are valid to write to.
        let named = unsafe {
            libc::getsockname(
                socket.fd.as_raw_fd(),
                (&raw mut address).cast(),
                &raw mut len,
            )
        };
        // On the loopback interface, every reply would return as a request.
        if named == 0 && address.sll_hatype != libc::ARPHRD_ETHER {
            return Err(ServeError::NotEthernet(nic.to_owned()));
        }
        Ok(socket)
    }

    /// Fails if the interface was removed or replaced by another of the same name. Its socket
    /// receives no frames and reports no error.
    pub(super) fn check(&self) -> Result<(), ServeError> {
        // SAFETY: the name is NUL-terminated and lives through the call.
        if unsafe { libc::if_nametoindex(self.nic.as_ptr()) } == self.index {
            return Ok(());
        }
        Err(ServeError::Gone(self.nic.to_string_lossy().into_owned()))
    }

    /// Returns true unless the interface has lost its link.
    pub(super) fn has_carrier(&self) -> bool {
        // SAFETY: all-zero is a valid ifreq.
        let mut request: libc::ifreq = unsafe { mem::zeroed() };
        let name = self.nic.as_bytes_with_nul();
        for (to, from) in request.ifr_name.iter_mut().zip(name) {
            *to = from.cast_signed() as libc::c_char;
        }
        // SAFETY: the request lives through the call, and the kernel writes into it only.
        let read = unsafe {
            libc::ioctl(
                self.fd.as_raw_fd(),
                libc::SIOCGIFFLAGS as _,
                &raw mut request,
            )
        };
        // SAFETY: after success, the flags are valid.
        let flags = i32::from(unsafe { request.ifr_ifru.ifru_flags });
        read < 0 || flags & libc::IFF_RUNNING != 0
    }

    fn set<T>(&self, level: i32, name: i32, value: &T) -> io::Result<()> {
        // SAFETY: the value lives through the call and the length is its size.
        let result = unsafe {
            libc::setsockopt(
                self.fd.as_raw_fd(),
                level,
                name,
                (&raw const *value).cast(),
                size_of::<T>() as libc::socklen_t,
            )
        };
        if result < 0 {
            Err(io::Error::last_os_error())
        } else {
            Ok(())
        }
    }

    /// Returns the next received frame.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> Result<Option<Received>, ServeError> {
        // SAFETY: all-zero is a valid sockaddr_ll and a valid msghdr.
        let (mut from, mut message): (libc::sockaddr_ll, libc::msghdr) =
            unsafe { (mem::zeroed(), mem::zeroed()) };
        let mut control: Control = [0; 8];
        let mut part = libc::iovec {
            iov_base: buffer.as_mut_ptr().cast(),
            iov_len: buffer.len(),
        };
        message.msg_name = (&raw mut from).cast();
        message.msg_namelen = size_of_val(&from) as libc::socklen_t;
        message.msg_iov = &raw mut part;
        message.msg_iovlen = 1;
        message.msg_control = (&raw mut control).cast();
        // Its type depends on the C library.
        message.msg_controllen = size_of_val(&control) as _;
        // SAFETY: every pointer in `message` is valid for the length next to it.
        let len = unsafe { libc::recvmsg(self.fd.as_raw_fd(), &raw mut message, 0) };
        let Ok(len) = usize::try_from(len) else {
            let source = io::Error::last_os_error();
            return match source.raw_os_error() {
                // An interface that goes down and up again is an unplugged cable, not a removed
                // interface.
                Some(libc::EAGAIN | libc::EINTR | libc::ENETDOWN) => Ok(None),
                _ => Err(ServeError::Io {
                    nic: self.nic.to_string_lossy().into_owned(),
                    what: "receiving",
                    source,
                }),
            };
        };
        if from.sll_pkttype == libc::PACKET_OUTGOING {
            return Ok(None);
        }
        let now = clock(libc::CLOCK_MONOTONIC);
        // Stamps use the adjustable clock, so only their age is used.
        let age =
            stamp(&message).map_or(0, |stamp| clock(libc::CLOCK_REALTIME).saturating_sub(stamp));
        Ok(Some(Received {
            len,
            at: now.saturating_sub(age),
            cut: message.msg_flags & libc::MSG_TRUNC != 0,
        }))
    }

    /// Returns false if the interface rejects the frame.
    pub(super) fn send(&self, bytes: &[u8]) -> bool {
        // SAFETY: the buffer is valid for its length.
        let sent =
            unsafe { libc::send(self.fd.as_raw_fd(), bytes.as_ptr().cast(), bytes.len(), 0) };
        usize::try_from(sent) == Ok(bytes.len())
    }
}

/// Waits for a frame at one of the sockets. Returns false on time-out.
pub(super) fn wait(sockets: &[RawSocket], timeout: Nanos) -> bool {
    let mut polled = [libc::pollfd {
        fd: -1,
        events: libc::POLLIN,
        revents: 0,
    }; 2];
    for (slot, socket) in polled.iter_mut().zip(sockets) {
        slot.fd = socket.fd.as_raw_fd();
    }
    let timeout = libc::timespec {
        tv_sec: 0,
        tv_nsec: timeout.min(999_999_999).cast_signed(),
    };
    // SAFETY: descriptors and timeout are valid for the call.
    unsafe { libc::ppoll(polled.as_mut_ptr(), 2, &raw const timeout, ptr::null()) > 0 }
}

/// Returns the kernel's arrival time from the control messages.
fn stamp(message: &libc::msghdr) -> Option<Nanos> {
    // SAFETY: the kernel has filled `msg_control` up to `msg_controllen`.
    let header = unsafe { libc::CMSG_FIRSTHDR(message).as_ref()? };
    if (header.cmsg_level, header.cmsg_type) != (libc::SOL_SOCKET, libc::SO_TIMESTAMPNS) {
        return None;
    }
    // SAFETY: a message of this type carries a timespec, which need not be aligned.
    let time: libc::timespec = unsafe { ptr::read_unaligned(libc::CMSG_DATA(header).cast()) };
    nanos(&time)
}

/// Returns the time of a clock in ns.
pub(super) fn clock(id: libc::clockid_t) -> Nanos {
    let mut time = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `time` is a valid timespec to write to; the clocks used here always exist.
    unsafe { libc::clock_gettime(id, &raw mut time) };
    nanos(&time).unwrap_or(0)
}

fn nanos(time: &libc::timespec) -> Option<Nanos> {
    let seconds = u64::try_from(time.tv_sec).ok()?;
    let rest = u64::try_from(time.tv_nsec).ok()?;
    seconds.checked_mul(1_000_000_000)?.checked_add(rest)
}
