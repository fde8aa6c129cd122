//! The processor with program or boot loader, and the objects that switch between them.

use ecaxis_esi::model::{Access, ObjectCode, Writable};

use super::{FirmwareHeader, FirmwareOptions, Flash};
use crate::coe::Abort;
use crate::coe::object_dictionary::ObjectStore;
use crate::esc::al::AlState;

const PROGRAM_DATA: u16 = 0x1f50;
const PROGRAM_CONTROL: u16 = 0x1f51;
pub(crate) const PROGRAM_IDENTIFICATION: u16 = 0x1f56;

/// 0x1000 of a boot loader: a profile without axes.
const BOOT_LOADER: u32 = 0x0000_012e;

/// Commands in 0x1F51 (CiA 302-3).
mod control {
    pub(super) const STOP: u8 = 0;
    pub(super) const START: u8 = 1;
    pub(super) const RESET: u8 = 2;
    pub(super) const CLEAR: u8 = 3;
}

/// The next action of the processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Next {
    /// Restarts the processor. The client gets no answer.
    Boot { stop: bool },
    /// Clears the program memory and then answers.
    Clear,
}

/// A processor with a replaceable program.
#[derive(Debug, Clone)]
pub(crate) struct BootLoader {
    pub(crate) flash: Flash,
    /// True while the boot loader runs.
    pub(crate) stopped: bool,
    /// True if the program has 0x1F51.
    has_control: bool,
    next: Option<Next>,
}

impl BootLoader {
    pub(crate) fn new(options: FirmwareOptions, store: &ObjectStore, device: (u32, u32)) -> Self {
        Self {
            flash: Flash::new(options, device),
            stopped: false,
            has_control: store.has_object(PROGRAM_CONTROL),
            next: None,
        }
    }

    /// True if the boot loader serves a subindex instead of the store.
    pub(crate) fn serves(&self, index: u16, sub: u8) -> bool {
        self.has_control && matches!(index, PROGRAM_DATA | PROGRAM_CONTROL) && sub == 1
    }

    /// Returns the maximum bytes of a download to a served object.
    pub(crate) fn capacity(&self, index: u16) -> Result<usize, Abort> {
        match index {
            PROGRAM_DATA if !self.stopped => Err(Abort::WRONG_STATE),
            PROGRAM_DATA => Ok(self.flash.capacity()),
            _ => Ok(1),
        }
    }

    /// Handles a download to a served object.
    pub(crate) fn write(&mut self, index: u16, data: &[u8], state: AlState) -> Result<(), Abort> {
        if state != AlState::PreOp {
            return Err(Abort::WRONG_STATE);
        }
        if index == PROGRAM_DATA {
            return self.flash.download(data);
        }
        let &[command] = data else {
            return Err(Abort::TOO_SHORT);
        };
        match (command, self.stopped) {
            (control::STOP, true) | (control::START, false) => Ok(()),
            (control::STOP, false) => self.order(Next::Boot { stop: true }),
            (control::RESET, false) => self.order(Next::Boot { stop: false }),
            (control::START, true) if self.flash.program.is_some() => {
                self.order(Next::Boot { stop: false })
            }
            (control::CLEAR, true) => {
                self.flash.erase();
                self.order(Next::Clear)
            }
            (control::START | control::RESET | control::CLEAR, _) => Err(Abort::WRONG_STATE),
            _ => Err(Abort::VALUE),
        }
    }

    fn order(&mut self, next: Next) -> Result<(), Abort> {
        self.next = Some(next);
        Ok(())
    }

    pub(crate) fn take_next(&mut self) -> Option<Next> {
        self.next.take()
    }

    /// Restarts the processor. The program starts, unless `stop` is set or there is no program.
    pub(crate) fn restart(&mut self, stop: bool) {
        self.flash.restart();
        self.next = None;
        self.stopped = stop || self.flash.program.is_none();
    }

    /// Returns the header of the program and its 0x1F56; `None` for the factory program.
    pub(crate) fn program(&self) -> Option<(FirmwareHeader, u32)> {
        let program = self.flash.program.as_ref()?;
        Some((program.header?, program.checksum))
    }
}

/// Returns the objects of the boot loader. Product and revision lack their low words, which belong
/// to the program.
pub(crate) fn boot_objects(of: &ObjectStore, processor: &BootLoader) -> ObjectStore {
    let mut store = ObjectStore::default();
    let ro = Access::default();
    let value = |index, sub| of.slot(index, sub).map_or(0, |slot| of.get(slot));
    store.ensure(0x1000, 0, "Device type", 32, ro, &BOOT_LOADER.to_le_bytes());
    if let Some(slot) = of.slot(0x1008, 0) {
        let name = of.bytes(slot).to_vec();
        let bits = u32::try_from(name.len() * 8).unwrap_or(0);
        let slot = store.ensure(0x1008, 0, "Device name", bits, ro, &name);
        store.set_type(slot, "STRING(1)");
    }
    store.describe(0x1018, ObjectCode::Record, "Identity");
    store.ensure(0x1018, 0, "Highest subindex", 8, ro, &[4]);
    for (sub, name, value) in [
        (1, "Vendor ID", value(0x1018, 1)),
        (2, "Product code", value(0x1018, 2) & 0xffff_0000),
        (3, "Revision number", 0),
        (4, "Serial number", value(0x1018, 4)),
    ] {
        let slot = store.ensure(0x1018, sub, name, 32, ro, &[]);
        store.set(slot, value);
    }
    if processor.has_control {
        let write = |read| Access {
            read,
            write: Writable::Only {
                pre_op: true,
                safe_op: false,
                op: false,
            },
        };
        let checksum = processor.flash.program.as_ref().map_or(0, |p| p.checksum);
        for (index, name, bits, access, value) in [
            (PROGRAM_DATA, "Program data", 8, write(false), 0),
            (PROGRAM_CONTROL, "Program control", 8, write(true), 0),
            (
                PROGRAM_IDENTIFICATION,
                "Program software identification",
                32,
                ro,
                checksum,
            ),
        ] {
            store.describe(index, ObjectCode::Array, name);
            store.ensure(index, 0, "Highest subindex", 8, ro, &[1]);
            store.ensure(index, 1, "Program 1", bits, access, &value.to_le_bytes());
        }
    }
    store.keep_defaults();
    store
}
