//! The ESI descriptions of scanned devices.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use ecaxis_esi as esi;
use ecaxis_esi::sii::MailboxDifference;

use super::{Device, Scan};
use ecaxis_master::esi_library::{self, Entry, Library, LoadError, RevisionMatch};

/// The best description of a device.
#[derive(Debug, Clone)]
pub struct EsiMatch {
    /// The ESI file; `None`: the device's own EEPROM describes it.
    pub path: Option<PathBuf>,
    /// Other files that describe the same revision.
    pub others: Vec<PathBuf>,
    pub file: Arc<esi::EsiFile>,
    pub device: Arc<esi::Device>,
    /// The strictest revision rule that accepts the description.
    pub rule: RevisionMatch,
}

impl EsiMatch {
    /// Returns the description of a device by its EEPROM. `None` if the image is damaged, or has no
    /// identity: a missing part would change the process data.
    #[must_use]
    pub fn from_eeprom(device: &Device) -> Option<Self> {
        let sii = device.sii.as_ref().ok()?;
        if !sii.damage.is_empty() || matches!(sii.identity.vendor, 0 | u32::MAX) {
            return None;
        }
        let file = Arc::new(sii.to_esi_file());
        let device = Arc::new(file.devices.first()?.clone());
        Some(Self {
            path: None,
            others: Vec::new(),
            file,
            device,
            rule: RevisionMatch::Equal,
        })
    }

    /// Compares the mailboxes of the ESI with those of the device's EEPROM.
    #[must_use]
    pub fn mailbox_difference(&self, device: &Device) -> Option<MailboxDifference> {
        self.path.as_ref()?;
        device.sii.as_ref().ok()?.mailbox_difference(&self.device)
    }

    /// True if the ESI declares a drive by its profile or modes.
    #[must_use]
    pub fn is_drive(&self) -> bool {
        const CIA_402: u32 = 402;
        self.device.profile == Some(CIA_402)
            || esi::offered_modes(&self.file, &self.device)
                .iter()
                .any(|mode| mode.is_cyclic())
    }

    /// Returns the default process data in bytes out and in; `None` if an option must be selected.
    #[must_use]
    pub fn default_bytes(&self) -> Option<(usize, usize)> {
        let choice = esi::SelectOptions {
            cycle_ns: 1_000_000,
            ..esi::SelectOptions::default()
        };
        let selection = esi::select(&self.file, &self.device, &choice).ok()?;
        Some((selection.layout.rx_bytes(), selection.layout.tx_bytes()))
    }
}

/// Returns the best description of each device, if the library has one, and the files that cannot
/// be read.
#[must_use]
pub fn describe(scan: &Scan, library: &Library) -> (Vec<Option<EsiMatch>>, Vec<LoadError>) {
    let identities: Vec<_> = scan.devices.iter().map(Device::identity).collect();
    describe_identities(&identities, library)
}

/// Like [`describe`], for devices that are known by their identity.
#[must_use]
pub fn describe_identities(
    identities: &[Option<esi::Identity>],
    library: &Library,
) -> (Vec<Option<EsiMatch>>, Vec<LoadError>) {
    let entries: Vec<_> = identities
        .iter()
        .map(|identity| find_entry((*identity)?, library))
        .collect();
    let is_described = |header: &esi::DeviceHeader| {
        let mut known = entries.iter().flatten();
        known.any(|(entry, _)| {
            let id = header.identity;
            (id.product, id.revision) == (entry.product, entry.revision)
        })
    };
    let mut files: Files = BTreeMap::new();
    let mut unreadable = Vec::new();
    let describe = |found: &Option<(&Entry, RevisionMatch)>| {
        let (entry, rule) = (*found)?;
        let path = library.folder().join(&entry.file);
        let file = files.entry(path.clone()).or_insert_with(|| {
            let read = esi_library::load(&path, &is_described);
            read.map_err(|error| unreadable.push(error))
                .ok()
                .map(Arc::new)
        });
        let file = file.clone()?;
        let of = |device: &&esi::Device| {
            let id = device.identity;
            (id.vendor, id.product, id.revision) == (entry.vendor, entry.product, entry.revision)
        };
        let device = Arc::new(file.devices.iter().find(of)?.clone());
        let is_same = |other: &&Entry| {
            other.file != entry.file
                && (other.vendor, other.product, other.revision)
                    == (entry.vendor, entry.product, entry.revision)
        };
        let others = library.entries().iter().filter(is_same);
        let mut others: Vec<PathBuf> = others.map(|other| other.file.clone()).collect();
        others.dedup();
        Some(EsiMatch {
            path: Some(path),
            others,
            device,
            file,
            rule,
        })
    };
    let all = entries.iter().map(describe).collect();
    (all, unreadable)
}

type Files = BTreeMap<PathBuf, Option<Arc<esi::EsiFile>>>;

fn find_entry(identity: esi::Identity, library: &Library) -> Option<(&Entry, RevisionMatch)> {
    let rules = [
        RevisionMatch::Equal,
        RevisionMatch::Newer,
        RevisionMatch::Ignore,
    ];
    rules
        .into_iter()
        .find_map(|rule| Some((library.find(identity, rule)?, rule)))
}
