//! Two virtual Ethernet interfaces, connected to each other. Needs root (CAP_NET_ADMIN) and `ip` of iproute2.
//!
//! A process that is killed leaves its pair behind. One end can be moved into a network namespace that lives as long as a
//! thread; then whatever ends the process, the kernel removes both. Where that is not permitted, what a process has left is
//! recognised by its number in the name.

use std::io;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// Before the process's number.
const PREFIX: &str = "ecx";
/// How long an interface may take to have a link.
const PATIENCE: Duration = Duration::from_secs(5);

/// A pair of interfaces, removed when this is dropped.
#[derive(Debug)]
pub struct VethPair {
    pub a: String,
    pub b: String,
}

impl VethPair {
    /// Makes both, without IP, and waits until they have a link.
    ///
    /// # Errors
    /// Where interfaces may not be made, or `ip` is missing.
    pub fn new() -> io::Result<Self> {
        static PAIRS: AtomicU32 = AtomicU32::new(0);
        let number = PAIRS.fetch_add(1, Ordering::Relaxed) % 100;
        let name = |end| format!("{PREFIX}{}-{number}{end}", std::process::id());
        let (a, b) = (name('a'), name('b'));
        ip(&["link", "add", &a, "type", "veth", "peer", "name", &b])?;
        let pair = Self { a, b };
        for nic in [&pair.a, &pair.b] {
            quiet(nic);
            ip(&["link", "set", nic, "up"])?;
        }
        for nic in [&pair.a, &pair.b] {
            wait_for_link(nic)?;
        }
        Ok(pair)
    }

    /// Takes one end down or up.
    ///
    /// # Errors
    /// What `ip` says.
    pub fn set(&self, nic: &str, up: bool) -> io::Result<()> {
        ip(&["link", "set", nic, if up { "up" } else { "down" }])
    }

    /// Moves `b` into the network namespace of a thread of this process, where it is down.
    ///
    /// # Errors
    /// What `ip` says.
    pub fn move_b(&self, thread: i32) -> io::Result<()> {
        ip(&["link", "set", &self.b, "netns", &thread.to_string()])
    }

    /// Waits until `a` has a link, as it does when both ends are up.
    ///
    /// # Errors
    /// When that takes too long.
    pub fn wait_for_link(&self) -> io::Result<()> {
        wait_for_link(&self.a)
    }
}

/// Brings an end up that has been moved into the calling thread's network namespace.
///
/// # Errors
/// What `ip` says.
pub(super) fn up_here(nic: &str) -> io::Result<()> {
    quiet(nic);
    ip(&["link", "set", nic, "up"])
}

/// Interfaces whose makers are no longer there.
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

/// No address resolution or router solicitation of the host's on this wire.
fn quiet(nic: &str) {
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
        if start.elapsed() > PATIENCE {
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
        let told = String::from_utf8_lossy(&output.stderr);
        Err(io::Error::other(format!("ip: {}", told.trim())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_dead_process_leaves_interfaces_behind() {
        let here = std::process::id();
        assert!(!is_leftover(&format!("{PREFIX}{here}-0a")));
        // Process numbers end at 2²².
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
    fn names_fit_into_an_interface_name() {
        assert!(format!("{PREFIX}4194304-99b").len() < 16);
    }
}
