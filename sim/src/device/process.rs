//! Process data: SyncManager buffers ↔ objects. The layouts are computed on entry to SafeOp. Later
//! code in this module does not allocate.

use ecaxis_esi::model::Direction;

use super::SimDevice;
use crate::Nanos;
use crate::bits;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::coe::pdo::Mapped;
use crate::drive::{CONTROL_PERIOD_NS, Drive};
use crate::esc::al::AlState;
use crate::esc::registers::ADDRESS_SPACE;
use crate::esc::sm::{Mode, SyncManager};

/// The process data of one SyncManager.
#[derive(Debug, Clone)]
pub(super) struct ProcessData {
    pub(super) sm: usize,
    pub(super) direction: Direction,
    /// The buffer mode in the ESI.
    pub(super) mode: Mode,
    /// The ControlByte in the ESI.
    pub(super) control: u8,
    /// True if the SyncManager may be disabled outside Op.
    pub(super) op_only: bool,
    pub(super) map: Vec<Mapped>,
    /// The length in bytes.
    pub(super) len: usize,
}

/// Wrong inputs of a drive.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct InputFault {
    /// All inputs are zero.
    pub zero: bool,
    /// The Statusword has these values in the bits of the mask.
    pub statusword: u16,
    pub mask: u16,
    /// The number of inputs still to affect.
    pub left: u32,
}

impl InputFault {
    fn statusword(self, store: &ObjectStore, slot: EntryHandle) -> [u8; 2] {
        let [low, high, ..] = store.get(slot).to_le_bytes();
        let word = u16::from_le_bytes([low, high]);
        (word & !self.mask | self.statusword & self.mask).to_le_bytes()
    }
}

impl SimDevice {
    /// Makes the next inputs of a drive wrong.
    pub(crate) fn disturb_inputs(&mut self, fault: InputFault) {
        self.input_fault = fault;
    }

    /// Computes the layouts again from assignment and mapping.
    pub(super) fn lay_out(&mut self) {
        for data in &mut self.process {
            let sm = u8::try_from(data.sm).unwrap_or(0);
            data.len = self.pdo.layout(&self.store, sm, &mut data.map);
        }
        self.application.laid_out(&self.process);
    }

    /// Takes outputs, if they take effect in this state, and latches inputs.
    pub(super) fn exchange(&mut self) {
        self.show();
        // A device with device emulation stays in Op after the watchdog has expired.
        if self.al.state == AlState::Op && !self.esc.watchdog.expired() {
            self.take_outputs();
        }
        self.empty_single_buffers();
        self.latch_inputs();
    }

    /// Handles the end of commanded outputs.
    pub(super) fn drop_outputs(&mut self) {
        if self.application.rest(&mut self.store, &self.process) {
            self.latch_inputs();
        }
    }

    /// Frees output areas with one buffer, which accept new data only after that.
    fn empty_single_buffers(&mut self) {
        for data in &self.process {
            if data.mode == Mode::Mailbox && data.direction == Direction::Rx {
                if let Some(sm) = self.esc.sms.get_mut(data.sm) {
                    sm.full = false;
                }
                self.esc.refresh_sm(data.sm);
            }
        }
    }

    fn take_outputs(&mut self) {
        for data in self.process.iter().filter(|d| d.direction == Direction::Rx) {
            let Some(buffer) = self.esc.fetch_buffer(data.sm, self.local) else {
                continue;
            };
            for m in &data.map {
                bits::copy(self.store.exchange_mut(m.slot), 0, buffer, m.bit, m.bits);
            }
        }
        if let Some(sercos) = &mut self.sercos {
            sercos.take_outputs(&mut self.store, self.application.drives());
        }
        self.application.sync(&mut self.store);
    }

    pub(super) fn latch_inputs(&mut self) {
        let is_early = self.al.state < AlState::SafeOp && !self.esc.emulates_device();
        if is_early || self.quirks.inputs_unfilled {
            return;
        }
        self.show();
        let drives = self.application.drives();
        let fault = Some(self.input_fault).filter(|fault| fault.left > 0);
        let zero =
            fault.is_some_and(|fault| fault.zero) || drives.iter().any(Drive::inputs_are_zero);
        let is_statusword = |slot| drives.iter().any(|drive| drive.shows_statusword(slot));
        for data in self.process.iter().filter(|d| d.direction == Direction::Tx) {
            // A SyncManager over registers is not filled by the device.
            let ram = |sm: &&SyncManager| usize::from(sm.start) >= ADDRESS_SPACE;
            if self.esc.sms.get(data.sm).filter(ram).is_none() {
                continue;
            }
            let Some(buffer) = self.esc.fill_buffer(data.sm) else {
                continue;
            };
            if zero {
                buffer.fill(0);
            } else {
                for m in &data.map {
                    bits::copy(buffer, m.bit, self.store.bytes(m.slot), 0, m.bits);
                    if let Some(fault) = fault
                        && is_statusword(m.slot)
                    {
                        let word = fault.statusword(&self.store, m.slot);
                        bits::copy(buffer, m.bit, &word, 0, m.bits);
                    }
                }
            }
            if fault.is_some() {
                self.input_fault.left = self.input_fault.left.saturating_sub(1);
            }
            self.esc.filled_buffer(data.sm, self.local);
        }
    }

    /// Returns the buffers of a direction, in the order of the SyncManagers.
    fn buffers(&self, direction: Direction) -> Vec<u8> {
        let of_direction = self.process.iter().filter(|d| d.direction == direction);
        of_direction
            .flat_map(|d| self.esc.latest_buffer(d.sm))
            .copied()
            .collect()
    }

    /// Returns the last received output process data.
    #[must_use]
    pub fn outputs(&self) -> Vec<u8> {
        self.buffers(Direction::Rx)
    }

    /// Returns the last latched input process data.
    #[must_use]
    pub fn inputs(&self) -> Vec<u8> {
        self.buffers(Direction::Tx)
    }

    /// Sets a digital input of a drive from this true time on. [`crate::drive::input`] names the
    /// bits of 0x60FD. Returns false if the device is not a drive.
    pub fn set_digital_input(&mut self, now: Nanos, bit: u8, on: bool) -> bool {
        self.advance(now);
        let left = self.tick.saturating_sub(self.esc.clock.local(now));
        let Some(drive) = self.application.drives_mut().first_mut() else {
            return false;
        };
        drive.set_input(bit, on, 1.0 - share(left, CONTROL_PERIOD_NS));
        true
    }

    /// Returns the digital outputs of a drive, with the bits of 0x60FE.
    #[must_use]
    pub fn digital_outputs(&self) -> Option<u32> {
        self.drive().map(|drive| drive.outputs(&self.store))
    }

    /// Sets an object without access checks. An input object of an I/O device then no longer
    /// mirrors an output. Returns false if the object does not exist.
    pub fn set_input(&mut self, index: u16, sub: u8, value: i64) -> bool {
        let Some(slot) = self.store.slot(index, sub) else {
            return false;
        };
        self.store.set(slot, value);
        self.application.hold(slot);
        true
    }
}

/// Returns the share of a control period, at most 1.
fn share(part: Nanos, whole: Nanos) -> f64 {
    let short = |ns: Nanos| f64::from(u32::try_from(ns).unwrap_or(u32::MAX));
    (short(part) / short(whole)).min(1.0)
}
