//! AF_PACKET sockets: packet(7).

use std::ffi::CString;
use std::io;
use std::mem;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::ptr;

use super::ring::Ring;
use super::{checked, length};

/// A raw packet socket. Receives nothing until it is bound.
#[derive(Debug)]
pub struct PacketSocket {
    fd: OwnedFd,
}

/// The metadata that the kernel reports with a received frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Received {
    /// The bytes stored in the buffer.
    pub len: usize,
    /// The length on the wire, in bytes.
    pub wire_len: usize,
    /// `tp_status`: `TP_STATUS_…`.
    pub status: u32,
    /// `sll_pkttype`: `PACKET_…`.
    pub packet_type: u8,
}

/// Space for one control message with a `tpacket_auxdata`, aligned like control messages.
type Control = [u64; 8];

impl PacketSocket {
    /// Opens a non-blocking socket that is closed on exec.
    ///
    /// # Errors
    /// `PermissionDenied` without CAP_NET_RAW.
    pub fn new() -> io::Result<Self> {
        let kind = libc::SOCK_RAW | libc::SOCK_NONBLOCK | libc::SOCK_CLOEXEC;
        // SAFETY: plain system call; the result is checked. A socket of protocol 0 receives nothing
        // until it is bound.
        let fd = checked(unsafe { libc::socket(libc::AF_PACKET, kind, 0) })?;
        // SAFETY: `fd` is a valid descriptor that nothing else owns.
        let fd = unsafe { OwnedFd::from_raw_fd(fd) };
        Ok(Self { fd })
    }

    /// Receives frames of one EtherType from one interface.
    ///
    /// # Errors
    /// The error of bind(2).
    pub fn bind(&self, interface: i32, ethertype: u16) -> io::Result<()> {
        // SAFETY: all-zero is a valid sockaddr_ll.
        let mut address: libc::sockaddr_ll = unsafe { mem::zeroed() };
        address.sll_family = u16::try_from(libc::AF_PACKET).unwrap_or(0);
        address.sll_protocol = ethertype.to_be();
        address.sll_ifindex = interface;
        // SAFETY: the address lives through the call and the length is its size.
        let result = unsafe {
            libc::bind(
                self.fd.as_raw_fd(),
                (&raw const address).cast::<libc::sockaddr>(),
                length::<libc::sockaddr_ll>(),
            )
        };
        checked(result).map(|_| ())
    }

    /// Sets an option of the level `SOL_PACKET`.
    ///
    /// # Errors
    /// The error of setsockopt(2).
    pub fn set(&self, name: i32, value: i32) -> io::Result<()> {
        self.set_any(name, &value)
    }

    fn set_any<T>(&self, name: i32, value: &T) -> io::Result<()> {
        // SAFETY: the value lives through the call and the length is its size.
        let result = unsafe {
            libc::setsockopt(
                self.fd.as_raw_fd(),
                libc::SOL_PACKET,
                name,
                (&raw const *value).cast(),
                length::<T>(),
            )
        };
        checked(result).map(|_| ())
    }

    /// Receives into a ring of `slots` slots of `slot_len` bytes from now on (TPACKET_V2). Call
    /// this before [`PacketSocket::bind`].
    ///
    /// # Errors
    /// The error of setsockopt(2) or mmap(2). Fails if `slot_len` does not divide a page, or if the
    /// slots do not fill whole pages.
    pub fn receive_ring(&self, slots: usize, slot_len: usize) -> io::Result<Ring> {
        let page = rustix::param::page_size();
        let invalid = || io::Error::from(io::ErrorKind::InvalidInput);
        let bytes = slots.checked_mul(slot_len).ok_or_else(invalid)?;
        if slot_len == 0 || !page.is_multiple_of(slot_len) || !bytes.is_multiple_of(page) {
            return Err(invalid());
        }
        let number = |n: usize| libc::c_uint::try_from(n).map_err(|_| invalid());
        self.set(
            libc::PACKET_VERSION,
            libc::tpacket_versions::TPACKET_V2 as i32,
        )?;
        // Blocks of one page are always available, and they are mapped contiguously.
        let request = libc::tpacket_req {
            tp_block_size: number(page)?,
            tp_block_nr: number(bytes / page)?,
            tp_frame_size: number(slot_len)?,
            tp_frame_nr: number(slots)?,
        };
        self.set_any(libc::PACKET_RX_RING, &request)?;
        Ring::map(&self.fd, slots, slot_len)
    }

    /// Returns the frames received and the frames dropped for lack of space since the last call
    /// (PACKET_STATISTICS).
    ///
    /// # Errors
    /// The error of getsockopt(2).
    pub fn statistics(&self) -> io::Result<(u32, u32)> {
        // SAFETY: all-zero is a valid tpacket_stats.
        let mut stats: libc::tpacket_stats = unsafe { mem::zeroed() };
        let mut len = length::<libc::tpacket_stats>();
        // SAFETY: `stats` takes `len` bytes.
        let result = unsafe {
            libc::getsockopt(
                self.fd.as_raw_fd(),
                libc::SOL_PACKET,
                libc::PACKET_STATISTICS,
                (&raw mut stats).cast(),
                &raw mut len,
            )
        };
        checked(result).map(|_| (stats.tp_packets, stats.tp_drops))
    }

    /// Sends one frame. RT: one system call.
    ///
    /// # Errors
    /// The error of send(2).
    pub fn send(&self, frame: &[u8]) -> rustix::io::Result<()> {
        rustix::net::send(&self.fd, frame, rustix::net::SendFlags::empty()).map(|_| ())
    }

    /// Returns the next received frame, with `PACKET_AUXDATA` where that is enabled; `None` if none
    /// has arrived. RT: one system call.
    ///
    /// # Errors
    /// The error of recvmsg(2).
    pub fn receive(&self, buf: &mut [u8]) -> rustix::io::Result<Option<Received>> {
        // SAFETY: all-zero is a valid sockaddr_ll and a valid msghdr.
        let (mut from, mut message): (libc::sockaddr_ll, libc::msghdr) =
            unsafe { (mem::zeroed(), mem::zeroed()) };
        let mut control: Control = [0; 8];
        let mut part = libc::iovec {
            iov_base: buf.as_mut_ptr().cast(),
            iov_len: buf.len(),
        };
        message.msg_name = (&raw mut from).cast();
        message.msg_namelen = length::<libc::sockaddr_ll>();
        message.msg_iov = &raw mut part;
        message.msg_iovlen = 1;
        message.msg_control = (&raw mut control).cast();
        message.msg_controllen = size_of::<Control>() as _;
        // SAFETY: every pointer in `message` is valid for the length next to it. MSG_TRUNC returns
        // the length on the wire.
        let len = unsafe { libc::recvmsg(self.fd.as_raw_fd(), &raw mut message, libc::MSG_TRUNC) };
        let Ok(wire_len) = usize::try_from(len) else {
            return match rustix::io::Errno::from_io_error(&io::Error::last_os_error()) {
                Some(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => Ok(None),
                Some(errno) => Err(errno),
                None => Err(rustix::io::Errno::IO),
            };
        };
        Ok(Some(Received {
            len: wire_len.min(buf.len()),
            wire_len,
            status: auxiliary(&message).map_or(0, |aux| aux.tp_status),
            packet_type: from.sll_pkttype,
        }))
    }
}

fn auxiliary(message: &libc::msghdr) -> Option<libc::tpacket_auxdata> {
    // SAFETY: the kernel has filled `msg_control` up to `msg_controllen`.
    let header = unsafe { libc::CMSG_FIRSTHDR(message).as_ref()? };
    if (header.cmsg_level, header.cmsg_type) != (libc::SOL_PACKET, libc::PACKET_AUXDATA) {
        return None;
    }
    // SAFETY: a message of this type carries a tpacket_auxdata, which need not be aligned.
    Some(unsafe { ptr::read_unaligned(libc::CMSG_DATA(header).cast()) })
}

/// Returns the index of an interface; `None` if no interface has this name.
#[must_use]
pub fn interface_index(name: &str) -> Option<i32> {
    let name = CString::new(name).ok()?;
    // SAFETY: `name` is a NUL-terminated string that lives through the call.
    let index = unsafe { libc::if_nametoindex(name.as_ptr()) };
    i32::try_from(index).ok().filter(|index| *index > 0)
}

/// Returns the IP addresses of an interface.
///
/// # Errors
/// The error of getifaddrs(3).
pub fn ip_addresses(name: &str) -> io::Result<Vec<IpAddr>> {
    let mut list: *mut libc::ifaddrs = ptr::null_mut();
    // SAFETY: `list` takes a pointer; the result is checked.
    checked(unsafe { libc::getifaddrs(&raw mut list) })?;
    let mut addresses = Vec::new();
    let mut next = list;
    // SAFETY: the list is valid until it is freed below, and ends with a null pointer.
    while let Some(entry) = unsafe { next.as_ref() } {
        next = entry.ifa_next;
        // SAFETY: names are NUL-terminated and live as long as the list.
        let of = unsafe { std::ffi::CStr::from_ptr(entry.ifa_name) };
        if of.to_bytes() != name.as_bytes() {
            continue;
        }
        // SAFETY: the address is null or valid as long as the list.
        let Some(address) = (unsafe { entry.ifa_addr.as_ref() }) else {
            continue;
        };
        match i32::from(address.sa_family) {
            libc::AF_INET => {
                // SAFETY: the family says that it is a sockaddr_in.
                let v4: libc::sockaddr_in = unsafe { ptr::read_unaligned(entry.ifa_addr.cast()) };
                addresses.push(Ipv4Addr::from(u32::from_be(v4.sin_addr.s_addr)).into());
            }
            libc::AF_INET6 => {
                // SAFETY: the family says that it is a sockaddr_in6.
                let v6: libc::sockaddr_in6 = unsafe { ptr::read_unaligned(entry.ifa_addr.cast()) };
                addresses.push(Ipv6Addr::from(v6.sin6_addr.s6_addr).into());
            }
            _ => {}
        }
    }
    // SAFETY: the list was allocated by getifaddrs, and no reference into it is kept.
    unsafe { libc::freeifaddrs(list) };
    Ok(addresses)
}
