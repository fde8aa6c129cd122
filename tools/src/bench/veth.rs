//! A pair of connected virtual Ethernet interfaces. Needs root (CAP_NET_ADMIN) and `ip` from
//! iproute2.
//!
//! A killed process leaves its pair behind. One end can move to the network namespace of a thread;
//! the kernel then removes both with the process. If that is not permitted, leftovers are
//! recognized by the process ID in the name.

use std::io;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// The name prefix before the process ID.
const PREFIX: &str = "ecx";
/// The time-out for a link.
const TIMEOUT: Duration = Duration::from_secs(5);

/// A pair of interfaces, removed on drop.
#[derive(Debug)]
pub struct VethPair {
    pub a: String,
    pub b: String,
}

impl VethPair {
    /// Creates both interfaces without IP and waits for a link.
    ///
    /// # Errors
    /// Fails if interfaces cannot be created or `ip` is missing.
    pub fn new() -> io::Result<Self> {
        static PAIRS: AtomicU32 = AtomicU32::new(0);
        let number = PAIRS.fetch_add(1, Ordering::Relaxed) % 100;
        let name = |end| format!("{PREFIX}{}-{number}{end}", std::process::id());
        let (a, b) = (name('a'), name('b'));
        ip(&["link", "add", &a, "type", "veth", "peer", "name", &b])?;
        let pair = Self { a, b };
        for nic in [&pair.a, &pair.b] {
            disable_ipv6(nic);
            ip(&["link", "set", nic, "up"])?;
        }
        for nic in [&pair.a, &pair.b] {
            wait_for_link(nic)?;
        }
        Ok(pair)
    }

    /// Brings one end up or down.
    ///
    /// # Errors
    /// Returns the error of `ip`.
    pub fn set(&self, nic: &str, up: bool) -> io::Result<()> {
        ip(&["link", "set", nic, if up { "up" } else { "down" }])
    }

    /// Moves `b` to the network namespace of a thread of this process, where it is down.
    ///
    /// # Errors
    /// Returns the error of `ip`.
    pub fn move_b(&self, thread: i32) -> io::Result<()> {
        ip(&["link", "set", &self.b, "netns", &thread.to_string()])
    }

    /// Waits until `a` has a link, which requires both ends to be up.
    ///
    /// # Errors
    /// Fails after a time-out.
    pub fn wait_for_link(&self) -> io::Result<()> {
        wait_for_link(&self.a)
    }
}

/// Brings an end up that was moved to the calling thread's network namespace.
///
/// # Errors
/// Returns the error of `ip`.
pub(super) fn up_here(nic: &str) -> io::Result<()> {
    disable_ipv6(nic);
    ip(&["link", "set", nic, "up"])
}

/// Returns the interfaces whose process no longer exists.
#[must_use]
pub fn leftovers() -> Vec<String> {
    let Ok(entries) = std::fs::read_dir("/sys/class/net") else {
        return Vec::new();
    };
    let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let mut left: Vec<String> = names.filter(|name| is_leftover(name)).collect();
    left.sort();
    left
}

fn is_leftover(name: &str) -> bool {
    let process = name.strip_prefix(PREFIX).and_then(|rest| {
        let (process, rest) = rest.split_once('-')?;
        rest.strip_suffix(['a', 'b'])?.parse::<u8>().ok()?;
        process.parse::<u32>().ok()
    });
    process.is_some_and(|process| !Path::new(&format!("/proc/{process}")).exists())
}

/// Disables address resolution and router solicitation of the host on this wire.
fn disable_ipv6(nic: &str) {
    let _ = std::fs::write(format!("/proc/sys/net/ipv6/conf/{nic}/disable_ipv6"), "1");
}

impl Drop for VethPair {
    fn drop(&mut self) {
        let _ = ip(&["link", "del", &self.a]);
    }
}

fn wait_for_link(nic: &str) -> io::Result<()> {
    let carrier = format!("/sys/class/net/{nic}/carrier");
    let start = Instant::now();
    while std::fs::read_to_string(Path::new(&carrier))?.trim() != "1" {
        if start.elapsed() > TIMEOUT {
            return Err(io::Error::other(format!("{nic} gets no link")));
        }
        thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

fn ip(arguments: &[&str]) -> io::Result<()> {
    let output = Command::new("ip")
        .args(arguments)
        .stdin(Stdio::null())
        .output()?;
    if output.status.success() {
        Ok(())
    } else {
        let reported = String::from_utf8_lossy(&output.stderr);
        Err(io::Error::other(format!("ip: {}", reported.trim())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leftovers_belong_to_ended_processes() {
        let here = std::process::id();
        assert!(!is_leftover(&format!("{PREFIX}{here}-0a")));
        // Process IDs end at 2²².
        assert!(is_leftover(&format!("{PREFIX}9999999-0a")));
        assert!(is_leftover(&format!("{PREFIX}9999999-12b")));
        for other in [
            "ecx",
            "ecx-0a",
            "ecx12",
            "ecx9999999-0c",
            "eth0",
            "ecx9999999-a",
            "ecx9999999-0",
        ] {
            assert!(!is_leftover(other), "{other}");
        }
    }

    #[test]
    fn veth_names_fit_the_interface_name_limit() {
        assert!(format!("{PREFIX}4194304-99b").len() < 16);
    }
}
