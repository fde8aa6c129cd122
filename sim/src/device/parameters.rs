//! Data that survives a power cycle: parameters stored by 0x1010, and files.

use super::SimDevice;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::foe::FileStore;

impl SimDevice {
    /// Returns the files that FoE serves.
    #[must_use]
    pub fn foe_files(&self) -> &FileStore {
        &self.files
    }

    /// Adds or replaces a file. Returns false and changes nothing if the file does not fit.
    pub fn put_file(&mut self, name: &str, data: &[u8]) -> bool {
        let capacity = self.mailbox_options.foe.capacity;
        let fits = self.files.has_room(name, data.len(), capacity);
        if fits {
            self.files.put(name.to_owned(), data.to_vec());
        }
        fits
    }

    /// Returns the name of the file that a MainDevice wrote last. Each write is reported once.
    pub fn take_written_file(&mut self) -> Option<String> {
        self.files.take_written()
    }

    /// Stores the present values for the next power-on (0x1010).
    pub(super) fn store_parameters(&mut self) {
        for slot in kept(&self.store) {
            self.fresh.store.copy_from(&self.store, slot);
        }
    }

    /// Restores the defaults for the next power-on (0x1011).
    pub(super) fn restore_parameters(&mut self) {
        for slot in kept(&self.store) {
            self.fresh.store.restore(slot);
        }
    }
}

/// Returns the entries that the ESI marks as backup, or all writable entries if it marks none.
fn kept(store: &ObjectStore) -> Vec<EntryHandle> {
    use ecaxis_esi::model::Writable;
    let those = |keeps: fn(&crate::coe::object_dictionary::Item) -> bool| {
        let of = |slot: &EntryHandle| store.item(*slot).is_some_and(keeps);
        store.slots().filter(of).collect::<Vec<_>>()
    };
    let marked = those(|item| item.backup);
    if marked.is_empty() {
        those(|item| item.access.write != Writable::Never)
    } else {
        marked
    }
}
