//! The processor: program or boot loader, and the objects that make it change between them.

use ecaxis_esi::model::{Access, ObjectCode, Writable};

use super::{FirmwareHeader, FirmwareOptions, Flash};
use crate::coe::Abort;
use crate::coe::store::ObjectStore;
use crate::esc::al::AlState;

const PROGRAM_DATA: u16 = 0x1f50;
const PROGRAM_CONTROL: u16 = 0x1f51;
pub(crate) const PROGRAM_IDENTIFICATION: u16 = 0x1f56;

/// 0x1000 of a boot loader: no profile that knows axes.
const BOOT_LOADER: u32 = 0x0000_012e;

/// What is written to 0x1F51 (CiA 302-3).
mod control {
    pub(super) const STOP: u8 = 0;
    pub(super) const START: u8 = 1;
    pub(super) const RESET: u8 = 2;
    pub(super) const CLEAR: u8 = 3;
}

/// What the processor does next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Next {
    /// Restarts; whoever ordered it hears nothing.
    Boot { stop: bool },
    /// Clears the program memory and answers then.
    Clear,
}

/// A device's processor, as far as it can have another program.
#[derive(Debug, Clone)]
pub(crate) struct Processor {
    pub(crate) flash: Flash,
    /// Its boot loader runs.
    pub(crate) stopped: bool,
    /// The program has 0x1F51.
    has_control: bool,
    next: Option<Next>,
}

impl Processor {
    pub(crate) fn new(options: FirmwareOptions, store: &ObjectStore, device: (u32, u32)) -> Self {
        Self {
            flash: Flash::new(options, device),
            stopped: false,
            has_control: store.has_object(PROGRAM_CONTROL),
            next: None,
        }
    }

    /// Whether a subindex is served here and not from the store.
    pub(crate) fn serves(&self, index: u16, sub: u8) -> bool {
        self.has_control && matches!(index, PROGRAM_DATA | PROGRAM_CONTROL) && sub == 1
    }

    /// Most bytes that a download to it may have.
    pub(crate) fn capacity(&self, index: u16) -> Result<usize, Abort> {
        match index {
            PROGRAM_DATA if !self.stopped => Err(Abort::WRONG_STATE),
            PROGRAM_DATA => Ok(self.flash.capacity()),
            _ => Ok(1),
        }
    }

    /// A download to an object that is served here.
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

    /// Starts anew: its program, unless it is to stop or there is none.
    pub(crate) fn restart(&mut self, stop: bool) {
        self.flash.restart();
        self.next = None;
        self.stopped = stop || self.flash.program.is_none();
    }

    /// What the program says of itself, where it is not the one from the factory: its header, and 0x1F56.
    pub(crate) fn program(&self) -> Option<(FirmwareHeader, u32)> {
        let program = self.flash.program.as_ref()?;
        Some((program.header?, program.checksum))
    }
}

/// What is left of a device while its program is stopped: the low words of product and revision belong to the program.
pub(crate) fn boot_objects(of: &ObjectStore, processor: &Processor) -> ObjectStore {
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
