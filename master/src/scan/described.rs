//! The ESI files that describe what was found.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use ecaxis_esi as esi;

use super::{Device, Scan};
use crate::library::{self, Library, LoadError, Match};

/// The description that fits a device best.
#[derive(Debug, Clone)]
pub struct Described {
    /// The ESI file.
    pub path: PathBuf,
    pub file: Arc<esi::EsiFile>,
    pub device: Arc<esi::Device>,
    /// How its revision fits the device's: the strictest rule that takes it.
    pub rule: Match,
}

impl Described {
    /// A drive, by its ESI: the profile, or modes that it offers.
    #[must_use]
    pub fn is_drive(&self) -> bool {
        const CIA_402: u32 = 402;
        self.device.profile == Some(CIA_402)
            || esi::offered_modes(&self.file, &self.device)
                .iter()
                .any(|mode| mode.is_cyclic())
    }

    /// What is mapped where nobody chooses, bytes out and in; `None` where something must be chosen.
    #[must_use]
    pub fn default_bytes(&self) -> Option<(usize, usize)> {
        let choice = esi::Choice {
            cycle_ns: 1_000_000,
            ..esi::Choice::default()
        };
        let selection = esi::select(&self.file, &self.device, &choice).ok()?;
        Some((selection.layout.rx_bytes(), selection.layout.tx_bytes()))
    }
}

/// For each device the best description that a library has; `None` where it has none. Files that cannot be read are told.
#[must_use]
pub fn describe(scan: &Scan, library: &Library) -> (Vec<Option<Described>>, Vec<LoadError>) {
    let mut files = BTreeMap::new();
    let mut unreadable = Vec::new();
    let all = scan
        .devices
        .iter()
        .map(|device| one(device, library, &mut files, &mut unreadable))
        .collect();
    (all, unreadable)
}

type Files = BTreeMap<PathBuf, Option<Arc<esi::EsiFile>>>;

fn one(
    device: &Device,
    library: &Library,
    files: &mut Files,
    unreadable: &mut Vec<LoadError>,
) -> Option<Described> {
    let identity = device.identity()?;
    let rules = [Match::Equal, Match::Newer, Match::Ignore];
    let (entry, rule) = rules
        .into_iter()
        .find_map(|rule| Some((library.find(identity, rule)?, rule)))?;
    let path = library.folder().join(&entry.file);
    let file = files.entry(path.clone()).or_insert_with(|| {
        let read = library::load(&path).map_err(|error| unreadable.push(error));
        read.ok().map(Arc::new)
    });
    let file = file.clone()?;
    let of = |device: &&esi::Device| {
        let id = device.identity;
        (id.vendor, id.product, id.revision) == (entry.vendor, entry.product, entry.revision)
    };
    let described = Arc::new(file.devices.iter().find(of)?.clone());
    Some(Described {
        path,
        device: described,
        file,
        rule,
    })
}
