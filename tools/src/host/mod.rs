//! Reads the state of a computer from its files. Paths are relative to a root folder, so that
//! copies of other computers can be examined. [`counters`]: the kernel's counters of a CPU.

pub mod counters;

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::Serialize;

/// The maximum number of bytes read from a file.
const LONGEST: u64 = 1 << 20;
/// The maximum number of CPUs.
const MOST_CPUS: usize = 8192;

/// A property of a computer or of a measurement.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Fact {
    pub name: &'static str,
    pub value: String,
}

/// A computer, described by its files.
#[derive(Debug, Clone)]
pub struct Host {
    root: PathBuf,
}

impl Host {
    /// Returns this computer.
    #[must_use]
    pub fn here() -> Self {
        Self::at("/")
    }

    /// Returns the computer whose `proc`, `sys`, `etc` … are in `root`.
    #[must_use]
    pub fn at(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    fn path(&self, path: &str) -> PathBuf {
        self.root.join(path)
    }

    pub(crate) fn exists(&self, path: &str) -> bool {
        self.path(path).exists()
    }

    /// Returns the content, or `None` if the file is missing or unreadable.
    pub(crate) fn bytes(&self, path: &str) -> Option<Vec<u8>> {
        let mut bytes = Vec::new();
        let file = File::open(self.path(path)).ok()?;
        file.take(LONGEST).read_to_end(&mut bytes).ok()?;
        Some(bytes)
    }

    /// Returns the trimmed text. Invalid UTF-8 is replaced.
    pub(crate) fn text(&self, path: &str) -> Option<String> {
        let bytes = self.bytes(path)?;
        Some(String::from_utf8_lossy(&bytes).trim().to_owned())
    }

    pub(crate) fn number<T: FromStr>(&self, path: &str) -> Option<T> {
        self.text(path)?.parse().ok()
    }

    pub(crate) fn cpus(&self, path: &str) -> Option<Cpus> {
        Cpus::parse(&self.text(path)?)
    }

    /// Returns the sorted entries of a folder, or nothing if it is missing.
    pub(crate) fn names(&self, folder: &str) -> Vec<String> {
        let Ok(entries) = fs::read_dir(self.path(folder)) else {
            return Vec::new();
        };
        let mut names: Vec<String> = entries
            .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
            .collect();
        names.sort();
        names
    }

    /// Returns the numeric entries of [`Self::names`], sorted by value.
    pub(crate) fn numbers(&self, folder: &str) -> Vec<u32> {
        let names = self.names(folder);
        let mut numbers: Vec<u32> = names.iter().filter_map(|n| n.parse().ok()).collect();
        numbers.sort_unstable();
        numbers
    }

    /// Returns the last path component of a symlink's target.
    pub(crate) fn link(&self, path: &str) -> Option<String> {
        let target = fs::read_link(self.path(path)).ok()?;
        Some(target.file_name()?.to_str()?.to_owned())
    }

    /// True if the file can be opened for writing. Writes nothing.
    pub(crate) fn writable(&self, path: &str) -> bool {
        let path: &Path = &self.path(path);
        fs::OpenOptions::new().write(true).open(path).is_ok()
    }

    /// Returns the network interfaces that could carry EtherCAT.
    #[must_use]
    pub fn interfaces(&self) -> Vec<String> {
        let mut names = self.names("sys/class/net");
        if names.is_empty() {
            let devices = self.text("proc/net/dev").unwrap_or_default();
            let named = devices.lines().filter_map(|line| line.split_once(':'));
            names = named.map(|(name, _)| name.trim().to_owned()).collect();
        }
        names.retain(|name| name != "lo" && name != "bonding_masters");
        names
    }

    /// Returns the kind of the hypervisor, if the kernel knows it.
    pub(crate) fn hypervisor_kind(&self) -> Option<String> {
        let kind = self.text("sys/hypervisor/type");
        kind.filter(|kind| !kind.is_empty())
    }

    /// True on a virtual machine.
    pub(crate) fn is_virtual(&self) -> bool {
        let cpu = self.text("proc/cpuinfo").unwrap_or_default();
        let flags = cpu.lines().find(|line| line.starts_with("flags"));
        let guest = flags.is_some_and(|line| line.split_whitespace().any(|f| f == "hypervisor"));
        guest || self.hypervisor_kind().is_some()
    }
}

/// A set of CPUs in the kernel's notation: `0-3,7`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Cpus(BTreeSet<usize>);

impl Cpus {
    /// Parses the kernel's notation; otherwise `None`.
    pub fn parse(text: &str) -> Option<Self> {
        let mut set = BTreeSet::new();
        let parts = text.trim().split(',').filter(|part| !part.is_empty());
        for part in parts {
            let (first, last) = part.split_once('-').unwrap_or((part, part));
            let (first, last): (usize, usize) = (first.parse().ok()?, last.parse().ok()?);
            if first > last || last >= MOST_CPUS {
                return None;
            }
            set.extend(first..=last);
        }
        Some(Self(set))
    }

    pub fn contains(&self, cpu: usize) -> bool {
        self.0.contains(&cpu)
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub fn first(&self) -> Option<usize> {
        self.0.first().copied()
    }

    pub fn last(&self) -> Option<usize> {
        self.0.last().copied()
    }

    pub fn iter(&self) -> impl Iterator<Item = usize> + '_ {
        self.0.iter().copied()
    }

    pub fn without(&self, other: &Self) -> Self {
        Self(self.0.difference(&other.0).copied().collect())
    }

    pub fn only(cpu: usize) -> Self {
        Self(BTreeSet::from([cpu]))
    }
}

impl std::fmt::Display for Cpus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut runs: Vec<(usize, usize)> = Vec::new();
        for cpu in self.iter() {
            match runs.last_mut() {
                Some((_, last)) if *last + 1 == cpu => *last = cpu,
                _ => runs.push((cpu, cpu)),
            }
        }
        for (n, (first, last)) in runs.iter().enumerate() {
            let comma = if n == 0 { "" } else { "," };
            match first == last {
                true => write!(f, "{comma}{first}")?,
                false => write!(f, "{comma}{first}-{last}")?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn cpus_parse_kernel_lists() {
        for (text, expected) in [
            ("0-3,7", Some("0-3,7")),
            ("", Some("")),
            ("1,0,2\n", Some("0-2")),
            ("3-1", None),
            ("0-99999999999", None),
            ("0-8191", Some("0-8191")),
            ("0-8192", None),
            ("a", None),
            ("-1", None),
        ] {
            let shown = Cpus::parse(text).map(|cpus| cpus.to_string());
            assert_eq!(shown.as_deref(), expected, "{text}");
        }
    }

    proptest! {
        #[test]
        fn cpus_parse_their_own_output(cpus in proptest::collection::btree_set(0..200_usize, 0..40)) {
            let cpus = Cpus(cpus);
            prop_assert_eq!(Cpus::parse(&cpus.to_string()), Some(cpus));
        }

        #[test]
        fn no_text_panics(text in "[-0-9, ]{0,24}|.{0,24}") {
            let _ = Cpus::parse(&text);
        }
    }
}
