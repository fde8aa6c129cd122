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

/// The objects of a drive in the profile area of the first axis; those of the next axis are as many
/// indices later (CiA 402-1, multiple axes).
const PROFILE_AREA: std::ops::Range<u16> = 0x6000..0x6800;
pub(in crate::drive) const AXIS_STRIDE: u16 = 0x800;

/// Finds the objects of an axis in a dictionary or adds them. Sets the values that commissioning
/// would have set.
pub(super) struct Binder<'a> {
    pub store: &'a mut ObjectStore,
    /// The number of the axis in its device, from 0.
    axis: u16,
}

impl<'a> Binder<'a> {
    pub(super) fn new(store: &'a mut ObjectStore, axis: u16) -> Self {
        Self { store, axis }
    }

    /// Returns the index of an object of this axis.
    fn own_index(&self, index: u16) -> u16 {
        if PROFILE_AREA.contains(&index) {
            index + self.axis * AXIS_STRIDE
        } else {
            index
        }
    }

    /// Returns an object of this axis if the dictionary has it.
    pub(super) fn slot(&self, index: u16, sub: u8) -> Option<EntryHandle> {
        self.store.slot(self.own_index(index), sub)
    }

    /// True if the dictionary is that of a maxon drive. One without a vendor counts as maxon's.
    pub(super) fn is_maxon(&self) -> bool {
        const MAXON: i64 = 0xfb;
        let vendor = self.store.slot(0x1018, 1).map(|slot| self.store.get(slot));
        self.store.slot(0x30b0, 0).is_some() || vendor.is_none_or(|vendor| vendor == MAXON)
    }

    pub(super) fn bind(
        &mut self,
        index: u16,
        sub: u8,
        name: &str,
        bits: u32,
        access: Access,
    ) -> EntryHandle {
        let index = self.own_index(index);
        self.store.ensure(index, sub, name, bits, access, &[])
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
        if self.store.get(slot) == 0 {
            self.store.set(slot, default);
        }
    }

    /// Restricts an object to the values that a client may write. A default outside the list
    /// disables the check, because that drive supports more values.
    pub(super) fn choose(&mut self, slot: EntryHandle, choices: &'static [i64]) {
        if choices.contains(&self.store.get_signed(slot)) {
            self.store.set_choices(slot, choices);
        }
    }

    /// Binds a vendor-specific object. Another vendor may use the same index for something else, so
    /// the name must match. Only the first axis has such objects.
    pub(super) fn own(&self, index: u16, sub: u8, name: &str) -> Option<EntryHandle> {
        if self.axis > 0 {
            return None;
        }
        let slot = self.store.slot(index, sub)?;
        (self.store.item(slot)?.name == name).then_some(slot)
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
            self.store.set(count, i64::from(sub));
        }
    }

    /// Binds motor data. Commissioning has set it, so the ESI's factory value is replaced.
    pub(super) fn motor_data(&mut self, slot: EntryHandle, value: i64) -> EntryHandle {
        self.store.set(slot, value);
        slot
    }

    /// Widens software limits that exclude the present position. Such factory values do not fit the
    /// machine.
    pub(super) fn drop_limits_without(&mut self, [min, max]: [EntryHandle; 2], position: i64) {
        let (low, high) = (self.store.get_signed(min), self.store.get_signed(max));
        if low < high && !(low..=high).contains(&position) {
            self.store.set(min, i64::from(i32::MIN));
            self.store.set(max, i64::from(i32::MAX));
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
