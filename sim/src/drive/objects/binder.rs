//! From a dictionary's entries to slots.

use ecaxis_esi::model::{Access, Writable};

use crate::coe::store::{ObjectStore, Slot};

pub(super) const RW: Access = Access {
    read: true,
    write: Writable::Always,
};
pub(super) const RO: Access = Access {
    read: true,
    write: Writable::Never,
};

/// Finds the drive's objects in a dictionary, or adds them, and gives them what commissioning would have set.
pub(super) struct Binder<'a>(pub &'a mut ObjectStore);

impl Binder<'_> {
    pub(super) fn bind(
        &mut self,
        index: u16,
        sub: u8,
        name: &str,
        bits: u32,
        access: Access,
    ) -> Slot {
        self.0.ensure(index, sub, name, bits, access, &[])
    }

    /// A parameter. An ESI without a default leaves zero there, which is not what a drive powers up
    /// with.
    pub(super) fn with_default(
        &mut self,
        index: u16,
        sub: u8,
        name: &str,
        bits: u32,
        default: i64,
    ) -> Slot {
        let slot = self.bind(index, sub, name, bits, RW);
        self.fill(slot, default);
        slot
    }

    pub(super) fn fill(&mut self, slot: Slot, default: i64) {
        if self.0.get(slot) == 0 {
            self.0.set(slot, default);
        }
    }

    /// The values that a client may write. A drive whose ESI starts from another one knows more than is
    /// known here.
    pub(super) fn choose(&mut self, slot: Slot, choices: &'static [i64]) {
        if choices.contains(&self.0.get_signed(slot)) {
            self.0.set_choices(slot, choices);
        }
    }

    /// A maker's own object. Elsewhere the same index means something else, so the name decides.
    pub(super) fn own(&self, index: u16, sub: u8, name: &str) -> Option<Slot> {
        let slot = self.0.slot(index, sub)?;
        (self.0.item(slot)?.name == name).then_some(slot)
    }

    /// A maker's own record, for a dictionary that says nothing about any.
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

    /// Motor data: commissioning has set it, whatever the ESI's factory value is.
    pub(super) fn motor_data(&mut self, slot: Slot, value: i64) -> Slot {
        self.0.set(slot, value);
        slot
    }

    /// Commissioning has fitted the software limits to the machine; factory values that shut out the
    /// place where it stands cannot be meant.
    pub(super) fn drop_limits_without(&mut self, [min, max]: [Slot; 2], position: i64) {
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
    ) -> Option<Slot> {
        let slot = self.own(index, sub, name)?;
        Some(self.motor_data(slot, value))
    }
}
