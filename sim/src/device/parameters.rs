//! What outlives a power cycle: parameters stored by 0x1010, files.

use super::SimDevice;
use crate::coe::store::{ObjectStore, Slot};
use crate::foe::FileStore;

impl SimDevice {
    /// The device's files, as FoE shows them.
    #[must_use]
    pub fn foe_files(&self) -> &FileStore {
        &self.files
    }

    /// Puts a file into the device, or replaces it. False, and nothing changes, if it does not fit.
    pub fn put_file(&mut self, name: &str, data: &[u8]) -> bool {
        let capacity = self.mailbox_options.foe.capacity;
        let fits = self.files.has_room(name, data.len(), capacity);
        if fits {
            self.files.put(name.to_owned(), data.to_vec());
        }
        fits
    }

    /// Name of the file that a MainDevice completed last; each is told once.
    pub fn take_written_file(&mut self) -> Option<String> {
        self.files.take_written()
    }

    /// 0x1010: the next power-on starts with the present values.
    pub(super) fn store_parameters(&mut self) {
        for slot in kept(&self.store) {
            self.fresh.store.copy_from(&self.store, slot);
        }
    }

    /// 0x1011: the next power-on starts with the defaults.
    pub(super) fn restore_parameters(&mut self) {
        for slot in kept(&self.store) {
            self.fresh.store.restore(slot);
        }
    }
}

/// What the ESI marks as backup; where it marks nothing, all that can be written.
fn kept(store: &ObjectStore) -> Vec<Slot> {
    use ecaxis_esi::model::Writable;
    let those = |keeps: fn(&crate::coe::store::Item) -> bool| {
        let of = |slot: &Slot| store.item(*slot).is_some_and(keeps);
        store.slots().filter(of).collect::<Vec<_>>()
    };
    let marked = those(|item| item.backup);
    if marked.is_empty() {
        those(|item| item.access.write != Writable::Never)
    } else {
        marked
    }
}
