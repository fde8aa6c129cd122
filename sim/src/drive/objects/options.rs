//! Option codes 0x6007 and 0x605A–0x605E.

use super::bind::{Binder, RW};
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::drive::state::OptionCodes;

#[derive(Debug, Clone)]
pub(super) struct OptionSlots {
    quick_stop: EntryHandle,
    shutdown: EntryHandle,
    disable: EntryHandle,
    /// Without 0x605D a halt uses the slow-down ramp, and the cyclic modes ignore halts.
    halt: Option<EntryHandle>,
    fault: EntryHandle,
    abort: EntryHandle,
}

impl OptionSlots {
    pub(super) fn bind(b: &mut Binder<'_>) -> Self {
        let slots = Self {
            quick_stop: b.with_default(0x605a, 0, "Quick stop option code", 16, 6),
            shutdown: b.bind(0x605b, 0, "Shutdown option code", 16, RW),
            disable: b.with_default(0x605c, 0, "Disable operation option code", 16, 1),
            halt: b.slot(0x605d, 0),
            fault: b.with_default(0x605e, 0, "Fault reaction option code", 16, 2),
            abort: b.with_default(0x6007, 0, "Abort connection option code", 16, 3),
        };
        if let Some(halt) = slots.halt {
            b.fill(halt, 1);
            b.choose(halt, OptionCodes::HALT);
        }
        b.choose(slots.quick_stop, OptionCodes::QUICK_STOP);
        b.choose(slots.shutdown, OptionCodes::SHUTDOWN);
        b.choose(slots.disable, OptionCodes::DISABLE);
        b.choose(slots.fault, OptionCodes::FAULT);
        b.choose(slots.abort, OptionCodes::ABORT);
        slots
    }

    pub(super) fn read(&self, store: &ObjectStore) -> OptionCodes {
        OptionCodes {
            quick_stop: store.get_signed(self.quick_stop),
            shutdown: store.get_signed(self.shutdown),
            disable: store.get_signed(self.disable),
            halt: self.halt.map(|slot| store.get_signed(slot)),
            fault: store.get_signed(self.fault),
            abort: store.get_signed(self.abort),
        }
    }
}
