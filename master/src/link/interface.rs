//! The requirements on a network interface for EtherCAT, and settings that disturb the cycle.

use std::fmt;
use std::fs::File;
use std::io;
use std::net::IpAddr;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use super::filter::LinkStats;
use crate::sys::packet::{self, PacketSocket};

pub(super) const ETHERTYPE: u16 = 0x88a4;

const SYS: &str = "/sys/class/net";

/// `type` in sysfs: ARPHRD_… of linux/if_arp.h.
const ARPHRD_ETHER: u32 = 1;
const ARPHRD_LOOPBACK: u32 = 772;

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
    #[error("the interface `{nic}` {what}")]
    Unfit { nic: String, what: &'static str },
    #[error("another ecaxis{} drives `{nic}`", holder(*pid))]
    Taken {
        nic: String,
        /// Its process id.
        pid: Option<i32>,
    },
    #[error("another MainDevice drives the segment on `{nic}`: {frames} foreign EtherCAT frames in {} ms", super::LISTEN.as_millis())]
    Driven { nic: String, frames: u64 },
    #[error("the kernel gives no receive ring on `{nic}`: {source}")]
    NoRing { nic: String, source: io::Error },
    #[error("the interface `{nic}`: {what}: {source}")]
    Io {
        nic: String,
        what: &'static str,
        source: io::Error,
    },
}

fn holder(pid: Option<i32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (pid {pid})"))
}

/// A setting of a usable interface that will disturb the cycle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NicWarning {
    /// The interface has IP addresses, so the host's own traffic uses it too.
    Addresses { nic: String, addresses: Vec<IpAddr> },
    /// The interface is part of a bridge, bond or team.
    Member { nic: String, of: String },
    /// One end of a ring of SubDevices has no link.
    NoLink { nic: String },
    /// A plain socket replaces the ring.
    NoRing { nic: String, reason: String },
}

impl fmt::Display for NicWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Addresses { nic, addresses } => {
                write!(f, "the interface `{nic}` has ")?;
                for (n, address) in addresses.iter().enumerate() {
                    write!(f, "{}{address}", if n > 0 { ", " } else { "" })?;
                }
                f.write_str(
                    ": the computer sends its own traffic among the frames, which delays them",
                )
            }
            Self::Member { nic, of } => write!(
                f,
                "the interface `{nic}` is part of `{of}`: what that forwards comes among the frames"
            ),
            Self::NoLink { nic } => write!(
                f,
                "the interface `{nic}` has no link: the ring is open at this end"
            ),
            Self::NoRing { nic, reason } => write!(
                f,
                "no receive ring on `{nic}` ({reason}): a plain socket is used, which costs a system call a look"
            ),
        }
    }
}

/// Checks that the interface is up, has a carrier, is wired Ethernet and has the full frame size.
/// Returns its index. Reads sysfs, which needs no privileges. Without sysfs, only the name is
/// checked.
///
/// # Errors
/// The first unmet requirement.
pub fn check(nic: &str) -> Result<i32, OpenError> {
    let index = index(nic)?;
    SysfsNic::of(Path::new(SYS), nic).check()?;
    Ok(index)
}

pub(super) fn index(nic: &str) -> Result<i32, OpenError> {
    let missing = || OpenError::NoSuchInterface {
        nic: nic.to_owned(),
    };
    packet::interface_index(nic).ok_or_else(missing)
}

/// Returns the index of the other end of a virtual cable in this network namespace.
pub(super) fn peer_index(nic: &str) -> Option<i32> {
    let peer = SysfsNic::of(Path::new(SYS), nic).read("iflink").ok()?;
    let peer = peer.parse().ok()?;
    (index(nic).ok()? != peer).then_some(peer)
}

/// Returns warnings about a usable interface.
#[must_use]
pub fn concerns(nic: &str) -> Vec<NicWarning> {
    let addresses = packet::ip_addresses(nic).unwrap_or_default();
    let addresses = (!addresses.is_empty()).then(|| NicWarning::Addresses {
        nic: nic.to_owned(),
        addresses,
    });
    let member = SysfsNic::of(Path::new(SYS), nic).member();
    addresses.into_iter().chain(member).collect()
}

/// Returns the interfaces of this host that could carry EtherCAT.
#[must_use]
pub fn interfaces() -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(SYS) else {
        return Vec::new();
    };
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| {
            let attributes = SysfsNic::of(Path::new(SYS), name);
            attributes.kind().is_none()
        })
        .collect();
    names.sort();
    names
}

/// Reads during a run whether an interface has a link.
#[derive(Debug)]
pub struct Carrier {
    pub nic: String,
    file: File,
}

impl Carrier {
    /// Opens the interface's file in sysfs, if there is one.
    #[must_use]
    pub fn open(nic: &str) -> Option<Self> {
        let file = File::open(SysfsNic::of(Path::new(SYS), nic).folder.join("carrier")).ok()?;
        let nic = nic.to_owned();
        Some(Self { nic, file })
    }

    /// Returns true if the interface has a link. It has none while it is down, where reading fails.
    #[must_use]
    pub fn has_link(&self) -> bool {
        let mut text = [0];
        self.file.read_at(&mut text, 0).is_ok_and(|len| len == 1) && text == *b"1"
    }
}

/// An interface's folder in sysfs.
struct SysfsNic<'n> {
    nic: &'n str,
    folder: PathBuf,
}

impl<'n> SysfsNic<'n> {
    fn of(sys: &Path, nic: &'n str) -> Self {
        Self {
            nic,
            folder: sys.join(nic),
        }
    }

    fn read(&self, attribute: &str) -> io::Result<String> {
        std::fs::read_to_string(self.folder.join(attribute)).map(|text| text.trim().to_owned())
    }

    fn has(&self, attribute: &str) -> bool {
        self.folder.join(attribute).exists()
    }

    /// Returns why the interface can never carry EtherCAT, regardless of its state.
    fn kind(&self) -> Option<&'static str> {
        let number = self.read("type").ok().and_then(|text| text.parse().ok());
        match number {
            Some(ARPHRD_LOOPBACK) => return Some("is the loopback; no wire leads out of it"),
            Some(other) if other != ARPHRD_ETHER => return Some("is not an Ethernet interface"),
            _ => {}
        }
        if self.has("wireless") || self.has("phy80211") {
            return Some("is wireless; EtherCAT needs a cable");
        }
        let uevent = self.read("uevent").unwrap_or_default();
        if uevent.lines().any(|line| line == "DEVTYPE=vlan") {
            return Some("is a VLAN: its frames have a tag, by which SubDevices do not know them");
        }
        None
    }

    fn check(&self) -> Result<(), OpenError> {
        let nic = self.nic.to_owned();
        if let Some(what) = self.kind() {
            return Err(OpenError::Unfit { nic, what });
        }
        // Reading `carrier` fails with EINVAL while the interface is down.
        match self.read("carrier").as_deref() {
            Ok("1") => {}
            Ok(_) => return Err(OpenError::NoCarrier { nic }),
            Err(error) if error.raw_os_error() == Some(libc::EINVAL) => {
                return Err(OpenError::Down { nic });
            }
            // Without sysfs, nothing can be checked.
            Err(_) => return Ok(()),
        }
        match self.read("mtu").ok().and_then(|text| text.parse().ok()) {
            Some(mtu) if mtu < 1500 => Err(OpenError::Mtu { nic, mtu }),
            _ => Ok(()),
        }
    }

    /// Returns a warning if the interface is part of a bridge, bond or team.
    fn member(&self) -> Option<NicWarning> {
        let master = std::fs::read_link(self.folder.join("master")).ok()?;
        Some(NicWarning::Member {
            nic: self.nic.to_owned(),
            of: master.file_name()?.to_string_lossy().into_owned(),
        })
    }
}

pub(super) fn socket(nic: &str) -> Result<PacketSocket, OpenError> {
    let nic = nic.to_owned();
    PacketSocket::new().map_err(|source| match source.kind() {
        io::ErrorKind::PermissionDenied => OpenError::NotPermitted { nic },
        _ => OpenError::Io {
            nic,
            what: "opening a raw socket",
            source,
        },
    })
}

pub(super) fn bind(nic: &str, socket: &PacketSocket, index: i32) -> Result<(), OpenError> {
    // Without this option, the kernel also delivers sent frames, marked as outgoing.
    let _ = socket.set(libc::PACKET_IGNORE_OUTGOING, 1);
    // Cyclic frames must not wait behind a traffic shaper. Kernels without this option ignore it.
    let _ = socket.set(libc::PACKET_QDISC_BYPASS, 1);
    socket
        .bind(index, ETHERTYPE)
        .map_err(|source| OpenError::Io {
            nic: nic.to_owned(),
            what: "binding the socket",
            source,
        })
}

/// Adds the frames that the kernel has dropped since the last call.
pub(super) fn add_drops(socket: &PacketSocket, stats: &mut LinkStats) {
    if let Ok((_, dropped)) = socket.statistics() {
        stats.dropped += u64::from(dropped);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Checks an interface with these sysfs files; the others are those of a working interface.
    fn with(files: &[(&str, &str)]) -> (tempfile::TempDir, Result<(), String>) {
        let sys = tempfile::tempdir().unwrap();
        let folder = sys.path().join("eth9");
        std::fs::create_dir(&folder).unwrap();
        let fine = [
            ("type", "1"),
            ("carrier", "1"),
            ("mtu", "1500"),
            ("uevent", "INTERFACE=eth9"),
        ];
        for (name, text) in fine.iter().chain(files) {
            std::fs::write(folder.join(name), format!("{text}\n")).unwrap();
        }
        let checked = SysfsNic::of(sys.path(), "eth9").check();
        let result = checked.map_err(|error| error.to_string());
        (sys, result)
    }

    #[test]
    fn check_rejects_unsuitable_interfaces() {
        assert_eq!(with(&[]).1, Ok(()));
        assert_eq!(with(&[("mtu", "9000")]).1, Ok(()));
        for (file, text, said) in [
            ("type", "772", "loopback"),
            ("type", "280", "not an Ethernet interface"),
            ("phy80211", "", "wireless"),
            ("wireless", "", "wireless"),
            ("uevent", "DEVTYPE=vlan\nINTERFACE=eth9", "VLAN"),
            ("carrier", "0", "no link"),
            ("mtu", "1400", "1400"),
        ] {
            let error = with(&[(file, text)]).1.expect_err(file);
            assert!(error.contains(said), "{file} {text}: {error}");
        }
    }

    #[test]
    fn check_passes_without_sysfs() {
        let nowhere = SysfsNic::of(Path::new("/nonexistent"), "eth9");
        assert!(nowhere.check().is_ok());
        assert_eq!(nowhere.member(), None);
    }

    #[test]
    fn member_warning_names_the_bridge() {
        let (sys, _) = with(&[]);
        let folder = sys.path().join("eth9");
        std::os::unix::fs::symlink("../../devices/virtual/net/br0", folder.join("master")).unwrap();
        let member = SysfsNic::of(sys.path(), "eth9").member();
        let expected = NicWarning::Member {
            nic: "eth9".into(),
            of: "br0".into(),
        };
        assert_eq!(member, Some(expected));
    }

    #[test]
    fn loopback_is_rejected_and_has_addresses() {
        if packet::interface_index("lo").is_none() {
            return;
        }
        assert!(matches!(check("lo"), Err(OpenError::Unfit { .. })));
        let addresses = packet::ip_addresses("lo").unwrap();
        assert!(addresses.iter().all(IpAddr::is_loopback), "{addresses:?}");
        assert!(!interfaces().contains(&"lo".to_owned()));
    }
}
