//! Dictionary entries as slots.

use ecaxis_esi::model::{Access, Writable};

use crate::coe::object_dictionary::{EntryHandle, ObjectStore};

pub(super) const RW: Access = Access {
    read: true,
    write: Writable::Always,
};
pub(super) const RO: Access = Access {
    read: true,
    write: Writable::Never,
};

/// Finds the drive's objects in a dictionary or adds them. Sets the values that commissioning would
/// have set.
pub(super) struct Binder<'a>(pub &'a mut ObjectStore);

impl Binder<'_> {
    /// True if the dictionary is that of a maxon drive. One without a vendor counts as maxon's.
    pub(super) fn is_maxon(&self) -> bool {
        const MAXON: i64 = 0xfb;
        let vendor = self.0.slot(0x1018, 1).map(|slot| self.0.get(slot));
        self.0.slot(0x30b0, 0).is_some() || vendor.is_none_or(|vendor| vendor == MAXON)
    }

    pub(super) fn bind(
        &mut self,
        index: u16,
        sub: u8,
        name: &str,
        bits: u32,
        access: Access,
    ) -> EntryHandle {
        self.0.ensure(index, sub, name, bits, access, &[])
    }

    /// Binds a parameter. An ESI without a default leaves zero there, unlike a real drive at
    /// power-up.
    pub(super) fn with_default(
        &mut self,
        index: u16,
        sub: u8,
        name: &str,
        bits: u32,
        default: i64,
    ) -> EntryHandle {
        let slot = self.bind(index, sub, name, bits, RW);
        self.fill(slot, default);
        slot
    }

    pub(super) fn fill(&mut self, slot: EntryHandle, default: i64) {
        if self.0.get(slot) == 0 {
            self.0.set(slot, default);
        }
    }

    /// Restricts an object to the values that a client may write. A default outside the list
    /// disables the check, because that drive supports more values.
    pub(super) fn choose(&mut self, slot: EntryHandle, choices: &'static [i64]) {
        if choices.contains(&self.0.get_signed(slot)) {
            self.0.set_choices(slot, choices);
        }
    }

    /// Binds a vendor-specific object. Another vendor may use the same index for something else, so
    /// the name must match.
    pub(super) fn own(&self, index: u16, sub: u8, name: &str) -> Option<EntryHandle> {
        let slot = self.0.slot(index, sub)?;
        (self.0.item(slot)?.name == name).then_some(slot)
    }

    /// Adds a vendor-specific record to a dictionary without such objects.
    pub(super) fn add_own<'r>(
        &mut self,
        index: u16,
        name: &str,
        rows: impl Iterator<Item = (u8, &'r str, u32)>,
    ) {
        let count = self.bind(index, 0, name, 8, RO);
        for (sub, name, bits) in rows {
            self.bind(index, sub, name, bits, RW);
            self.0.set(count, i64::from(sub));
        }
    }

    /// Binds motor data. Commissioning has set it, so the ESI's factory value is replaced.
    pub(super) fn motor_data(&mut self, slot: EntryHandle, value: i64) -> EntryHandle {
        self.0.set(slot, value);
        slot
    }

    /// Widens software limits that exclude the present position. Such factory values do not fit the
    /// machine.
    pub(super) fn drop_limits_without(&mut self, [min, max]: [EntryHandle; 2], position: i64) {
        let (low, high) = (self.0.get_signed(min), self.0.get_signed(max));
        if low < high && !(low..=high).contains(&position) {
            self.0.set(min, i64::from(i32::MIN));
            self.0.set(max, i64::from(i32::MAX));
        }
    }

    pub(super) fn own_motor_data(
        &mut self,
        index: u16,
        sub: u8,
        name: &str,
        value: i64,
    ) -> Option<EntryHandle> {
        let slot = self.own(index, sub, name)?;
        Some(self.motor_data(slot, value))
    }
}
