//! TAP interfaces: tun(4), netdevice(7).

use std::ffi::CString;
use std::io;
use std::mem;
use std::net::Ipv4Addr;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

use rustix::fs::{Mode, OFlags};

use super::checked;

/// A TAP interface. The kernel removes it with the descriptor, unless it was there before.
#[derive(Debug)]
pub struct TapInterface {
    fd: OwnedFd,
}

/// The step at which a TAP interface could not be opened.
#[derive(Debug)]
pub struct TapError {
    pub step: TapStep,
    pub source: io::Error,
}

/// A step of opening a TAP interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TapStep {
    /// Opening the device of the kernel.
    #[error("opening /dev/net/tun")]
    Open,
    /// Writing its name.
    #[error("its name")]
    Name,
    /// Creating it, or attaching to it.
    #[error("creating it")]
    Create,
    /// Opening a socket for the next steps.
    #[error("opening a socket")]
    Socket,
    /// Setting its address.
    #[error("its address")]
    Address,
    /// Setting its subnet mask.
    #[error("its netmask")]
    Netmask,
    /// Switching it on.
    #[error("switching it on")]
    SwitchOn,
}

impl TapInterface {
    /// Creates the interface, or attaches to one that is there and free. Sets the address with the
    /// length of its prefix, and switches the interface on.
    ///
    /// # Errors
    /// `PermissionDenied` without CAP_NET_ADMIN.
    pub fn open(name: &str, address: Option<(Ipv4Addr, u8)>) -> Result<Self, TapError> {
        let at = |step| move |source| TapError { step, source };
        let flags = OFlags::RDWR | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let fd = rustix::fs::open("/dev/net/tun", flags, Mode::empty())
            .map_err(|error| at(TapStep::Open)(error.into()))?;
        let mut request = request(name).map_err(at(TapStep::Name))?;
        // The constants fit: IFF_TAP is 2, IFF_NO_PI is 0x1000.
        request.ifr_ifru.ifru_flags = (libc::IFF_TAP | libc::IFF_NO_PI) as libc::c_short;
        // SAFETY: `request` is a valid ifreq that outlives the call.
        let set = unsafe { libc::ioctl(fd.as_raw_fd(), libc::TUNSETIFF, &raw mut request) };
        checked(set).map_err(at(TapStep::Create))?;
        let socket = control_socket().map_err(at(TapStep::Socket))?;
        if let Some((address, prefix)) = address {
            let mask = u32::MAX.checked_shl(32 - u32::from(prefix)).unwrap_or(0);
            set_address(&socket, name, libc::SIOCSIFADDR as libc::Ioctl, address)
                .map_err(at(TapStep::Address))?;
            let mask = Ipv4Addr::from_bits(mask);
            set_address(&socket, name, libc::SIOCSIFNETMASK as libc::Ioctl, mask)
                .map_err(at(TapStep::Netmask))?;
        }
        switch_on(&socket, name).map_err(at(TapStep::SwitchOn))?;
        Ok(Self { fd })
    }

    /// Receives one frame; `None` if none waits.
    pub fn receive(&self, buffer: &mut [u8]) -> Option<usize> {
        rustix::io::read(&self.fd, buffer).ok()
    }

    /// Sends one frame; false if the interface does not take it.
    pub fn send(&self, frame: &[u8]) -> bool {
        rustix::io::write(&self.fd, frame).is_ok()
    }
}

/// Returns an empty request for an interface.
fn request(name: &str) -> io::Result<libc::ifreq> {
    let name = CString::new(name)?;
    // SAFETY: all-zero is a valid ifreq.
    let mut request: libc::ifreq = unsafe { mem::zeroed() };
    let bytes = name.as_bytes();
    if bytes.is_empty() || bytes.len() >= request.ifr_name.len() {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    for (to, from) in request.ifr_name.iter_mut().zip(bytes) {
        *to = from.cast_signed() as libc::c_char;
    }
    Ok(request)
}

fn control_socket() -> io::Result<OwnedFd> {
    let kind = libc::SOCK_DGRAM | libc::SOCK_CLOEXEC;
    // SAFETY: plain system call; the result is checked.
    let fd = checked(unsafe { libc::socket(libc::AF_INET, kind, 0) })?;
    // SAFETY: `fd` is a valid descriptor that nothing else owns.
    Ok(unsafe { OwnedFd::from_raw_fd(fd) })
}

fn set_address(
    socket: &OwnedFd,
    name: &str,
    operation: libc::Ioctl,
    address: Ipv4Addr,
) -> io::Result<()> {
    let mut request = request(name)?;
    let address = libc::sockaddr_in {
        sin_family: libc::sa_family_t::try_from(libc::AF_INET).unwrap_or(0),
        sin_port: 0,
        sin_addr: libc::in_addr {
            s_addr: u32::from_ne_bytes(address.octets()),
        },
        sin_zero: [0; 8],
    };
    // SAFETY: both are plain data of 16 bytes.
    request.ifr_ifru.ifru_addr =
        unsafe { mem::transmute::<libc::sockaddr_in, libc::sockaddr>(address) };
    // SAFETY: `request` is a valid ifreq that outlives the call.
    let set = unsafe { libc::ioctl(socket.as_raw_fd(), operation, &raw mut request) };
    checked(set).map(drop)
}

/// Switches an interface on, unless it is on.
fn switch_on(socket: &OwnedFd, name: &str) -> io::Result<()> {
    let mut request = request(name)?;
    // SAFETY: `request` is a valid ifreq that outlives the call.
    let got = unsafe {
        libc::ioctl(
            socket.as_raw_fd(),
            libc::SIOCGIFFLAGS as libc::Ioctl,
            &raw mut request,
        )
    };
    checked(got)?;
    // SAFETY: SIOCGIFFLAGS has set the flags.
    let flags = unsafe { request.ifr_ifru.ifru_flags };
    // The constant is 1.
    let up = libc::IFF_UP as libc::c_short;
    if flags & up != 0 {
        return Ok(());
    }
    request.ifr_ifru.ifru_flags = flags | up;
    // SAFETY: as above.
    let set = unsafe {
        libc::ioctl(
            socket.as_raw_fd(),
            libc::SIOCSIFFLAGS as libc::Ioctl,
            &raw mut request,
        )
    };
    checked(set).map(drop)
}
