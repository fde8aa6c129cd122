//! The files of a device.

use std::collections::BTreeMap;

/// Files by name. They survive a power cycle.
#[derive(Debug, Clone, Default)]
pub struct FileStore {
    files: BTreeMap<String, Vec<u8>>,
    written: Option<String>,
}

impl FileStore {
    /// Returns the contents of a file.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&[u8]> {
        self.files.get(name).map(Vec::as_slice)
    }

    /// Returns names and contents, sorted by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &[u8])> {
        self.files
            .iter()
            .map(|(name, data)| (name.as_str(), data.as_slice()))
    }

    /// True without files.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    /// Returns the number of files.
    #[must_use]
    pub fn len(&self) -> usize {
        self.files.len()
    }

    pub(crate) fn put(&mut self, name: String, data: Vec<u8>) {
        self.files.insert(name, data);
    }

    /// Like [`Self::put`], for a write by a MainDevice.
    pub(super) fn write(&mut self, name: String, data: Vec<u8>) {
        self.written = Some(name.clone());
        self.put(name, data);
    }

    pub(crate) fn take_written(&mut self) -> Option<String> {
        self.written.take()
    }

    /// True if this file fits. It would replace a file of the same name.
    pub(crate) fn has_room(&self, name: &str, len: usize, capacity: usize) -> bool {
        let others = self.files.iter().filter(|(other, _)| *other != name);
        let used: usize = others.map(|(name, data)| name.len() + data.len()).sum();
        used + name.len() + len <= capacity
    }
}
