//! The segment on a real network interface, in real time: other MainDevices may judge it.

use std::ffi::CString;
use std::io;
use std::mem;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};

use crate::frame::ETHERTYPE;
use crate::{Nanos, Segment, Transit};

const MAX_FRAME: usize = 1522;

#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    #[error("the interface `{0}` does not exist")]
    NoSuchInterface(String),
    #[error("opening a raw socket on `{0}` is not permitted")]
    NotPermitted(String),
    #[error("the interface `{nic}`: {what}: {source}")]
    Io {
        nic: String,
        what: &'static str,
        source: io::Error,
    },
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ServeStats {
    pub frames: u64,
    /// Lost on purpose, by the fault script.
    pub lost: u64,
    pub send_errors: u64,
}

/// Answers every EtherCAT frame on the interface until `stop` is set; looks at it at least every
/// millisecond.
pub fn serve(mut segment: Segment, nic: &str, stop: &AtomicBool) -> Result<ServeStats, ServeError> {
    let socket = open(nic)?;
    let mut stats = ServeStats::default();
    let mut buffer = [0_u8; MAX_FRAME];
    while !stop.load(Ordering::Relaxed) {
        let received = receive(&socket, &mut buffer).map_err(|source| ServeError::Io {
            nic: nic.to_owned(),
            what: "receiving",
            source,
        })?;
        let now = monotonic();
        let Some(bytes) = received.and_then(|len| buffer.get_mut(..len)) else {
            segment.advance(now);
            continue;
        };
        stats.frames += 1;
        match segment.transit(bytes, now) {
            Transit::Lost => stats.lost += 1,
            // The wire time the simulation adds is not waited for: a real wire follows.
            Transit::Back { .. } => {
                if !send(&socket, bytes) {
                    stats.send_errors += 1;
                }
            }
        }
    }
    Ok(stats)
}

fn monotonic() -> Nanos {
    let mut time = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `time` is a valid timespec to write to; CLOCK_MONOTONIC always exists.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &raw mut time) };
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    seconds * 1_000_000_000 + u64::try_from(time.tv_nsec).unwrap_or(0)
}

fn open(nic: &str) -> Result<OwnedFd, ServeError> {
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
    let index = i32::try_from(index).unwrap_or(0);
    if index == 0 {
        return Err(ServeError::NoSuchInterface(nic.to_owned()));
    }
    // Without a protocol it receives nothing until `bind` names one; other interfaces' frames stay out.
    // SAFETY: plain system call; the result is checked.
    let fd = unsafe { libc::socket(libc::AF_PACKET, libc::SOCK_RAW | libc::SOCK_CLOEXEC, 0) };
    if fd < 0 {
        let source = io::Error::last_os_error();
        return Err(if source.kind() == io::ErrorKind::PermissionDenied {
            ServeError::NotPermitted(nic.to_owned())
        } else {
            failed("opening a raw socket")(source)
        });
    }
    // SAFETY: `fd` is a valid descriptor that nothing else owns.
    let socket = unsafe { OwnedFd::from_raw_fd(fd) };

    let timeout = libc::timeval {
        tv_sec: 0,
        tv_usec: 1_000,
    };
    set_option(&socket, libc::SOL_SOCKET, libc::SO_RCVTIMEO, &timeout)
        .map_err(failed("setting the receive timeout"))?;
    // Our own replies would otherwise come back; older kernels are covered by the packet type.
    let _ = set_option(
        &socket,
        libc::SOL_PACKET,
        libc::PACKET_IGNORE_OUTGOING,
        &1_i32,
    );
    // Replies must not wait behind a traffic shaper.
    let _ = set_option(&socket, libc::SOL_PACKET, libc::PACKET_QDISC_BYPASS, &1_i32);
    // A MainDevice's destination address is the broadcast address, but need not be.
    let everything = libc::packet_mreq {
        mr_ifindex: index,
        mr_type: libc::PACKET_MR_PROMISC as libc::c_ushort,
        mr_alen: 0,
        mr_address: [0; 8],
    };
    set_option(
        &socket,
        libc::SOL_PACKET,
        libc::PACKET_ADD_MEMBERSHIP,
        &everything,
    )
    .map_err(failed("switching to promiscuous mode"))?;

    // SAFETY: all-zero is a valid sockaddr_ll.
    let mut address: libc::sockaddr_ll = unsafe { mem::zeroed() };
    address.sll_family = libc::AF_PACKET as libc::c_ushort;
    address.sll_protocol = ETHERTYPE.to_be();
    address.sll_ifindex = index;
    // SAFETY: the address lives through the call and the length is its size.
    let bound = unsafe {
        libc::bind(
            socket.as_raw_fd(),
            (&raw const address).cast(),
            size_of_val(&address) as libc::socklen_t,
        )
    };
    if bound < 0 {
        return Err(failed("binding the socket")(io::Error::last_os_error()));
    }
    Ok(socket)
}

fn set_option<T>(socket: &OwnedFd, level: i32, name: i32, value: &T) -> io::Result<()> {
    // SAFETY: the value lives through the call and the length is its size.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
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

/// A received frame's length; `None` after a millisecond without one.
fn receive(socket: &OwnedFd, buffer: &mut [u8]) -> io::Result<Option<usize>> {
    // SAFETY: all-zero is a valid sockaddr_ll.
    let mut from: libc::sockaddr_ll = unsafe { mem::zeroed() };
    let mut from_len = size_of_val(&from) as libc::socklen_t;
    // SAFETY: buffer and address are valid for the lengths given.
    let len = unsafe {
        libc::recvfrom(
            socket.as_raw_fd(),
            buffer.as_mut_ptr().cast(),
            buffer.len(),
            0,
            (&raw mut from).cast(),
            &raw mut from_len,
        )
    };
    if let Ok(len) = usize::try_from(len) {
        return Ok((from.sll_pkttype != libc::PACKET_OUTGOING).then_some(len));
    }
    let error = io::Error::last_os_error();
    match error.raw_os_error() {
        // An interface that goes down and up again is a pulled cable, not the end.
        Some(libc::EAGAIN | libc::EINTR | libc::ENETDOWN) => Ok(None),
        _ => Err(error),
    }
}

fn send(socket: &OwnedFd, bytes: &[u8]) -> bool {
    // SAFETY: the buffer is valid for its length.
    let sent = unsafe { libc::send(socket.as_raw_fd(), bytes.as_ptr().cast(), bytes.len(), 0) };
    usize::try_from(sent) == Ok(bytes.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SegmentOptions;

    #[test]
    fn a_missing_interface_is_named() {
        let segment = Segment::new(Vec::new(), SegmentOptions::default());
        let error = serve(segment, "no-such-nic", &AtomicBool::new(true)).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the interface `no-such-nic` does not exist"
        );
    }
}
