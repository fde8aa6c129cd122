//! A device with a program, with only its boot loader, and during the change.

use super::SimDevice;
use super::application::{Application, Io};
use crate::Nanos;
use crate::coe::object_dictionary::ObjectStore;
use crate::esc::al::AlState;
use crate::firmware::{Next, PROGRAM_IDENTIFICATION, boot_objects};

impl SimDevice {
    /// True while only the boot loader runs, because the program is stopped or missing.
    #[must_use]
    pub fn is_stopped(&self) -> bool {
        self.processor.as_ref().is_some_and(|p| p.stopped)
    }

    /// Returns the firmware file in the program memory; `None` for the factory program or no
    /// program.
    #[must_use]
    pub fn firmware(&self) -> Option<&[u8]> {
        self.processor.as_ref()?.flash.file()
    }

    pub(super) fn is_restarting(&self) -> bool {
        self.restarts_until.is_some()
    }

    /// Starts the processor and resets the rest of the application as at power-on.
    pub(super) fn boot(&mut self, stop: bool) {
        if let Some(parked) = self.parked.take() {
            (self.pdo, self.process) = *parked;
        }
        let Some(processor) = &mut self.processor else {
            return;
        };
        processor.restart(stop);
        if processor.stopped {
            self.store = boot_objects(&self.fresh.store, processor);
            self.application = Application::Io(Io::default());
            let pdo = std::mem::take(&mut self.pdo);
            let process = std::mem::take(&mut self.process);
            self.parked = Some(Box::new((pdo, process)));
        } else if let Some((header, checksum)) = processor.program() {
            self.esc.eeprom.patch(12, header.revision);
            for store in [&mut self.store, &mut self.fresh.store] {
                show(store, 0x1018, 3, &header.revision.to_le_bytes());
                show(store, 0x100a, 0, &header.version);
                show(store, PROGRAM_IDENTIFICATION, 1, &checksum.to_le_bytes());
            }
        }
    }

    /// Executes the command in 0x1F51. Returns true if it restarts the processor; the client then
    /// gets no answer.
    pub(super) fn obey_program_control(&mut self) -> bool {
        let Some(processor) = &mut self.processor else {
            return false;
        };
        let flash = &processor.flash;
        let (erase_ns, restart_ns) = (flash.erase_ns(), flash.restart_ns());
        match processor.take_next() {
            None => false,
            Some(Next::Clear) => {
                self.restarts_until = Some(self.local.saturating_add(erase_ns));
                false
            }
            Some(Next::Boot { stop }) => {
                if let Some(mailbox) = &mut self.mailbox {
                    mailbox.reset();
                }
                let now = self.esc.clock.true_time(self.local);
                self.restart_application(now);
                self.boot(stop);
                self.lay_out();
                self.close_process_data(true);
                self.restarts_until = Some(self.local.saturating_add(restart_ns));
                true
            }
        }
    }

    /// Resumes the service of the controller after a restart.
    pub(super) fn restarted(&mut self, local: u64) {
        self.restarts_until = None;
        self.start_ticking(local);
        if self.al.due < local {
            self.al.due = local;
        }
        if let Some(mailbox) = &mut self.mailbox {
            mailbox.rest_until(local);
        }
        self.pump_mailbox();
        self.plan_fetch(local);
    }

    /// True in Init with a program that has not run yet.
    pub(super) fn starts_new_program(&self) -> bool {
        let is_new = self.processor.as_ref().is_some_and(|p| p.flash.is_new());
        is_new && self.al.state == AlState::Init
    }

    /// Resets the processor and its controller.
    pub(super) fn reset(&mut self, local: u64) {
        let now = self.esc.clock.true_time(local);
        self.reset_at(now);
        let restart_ns = self.processor.as_ref().map_or(0, |p| p.flash.restart_ns());
        self.restarts_until = Some(self.local.saturating_add(restart_ns));
        self.was_reset = true;
    }

    /// Resets the device like a power cycle; the links are kept.
    pub(super) fn reset_at(&mut self, now: Nanos) {
        let links = self.esc.links();
        self.power_on(now);
        for (port, up) in (0..).zip(links) {
            self.esc.set_link(port, up);
        }
    }
}

fn show(store: &mut ObjectStore, index: u16, sub: u8, value: &[u8]) {
    if let Some(slot) = store.slot(index, sub) {
        for (to, from) in store.bytes_mut(slot).iter_mut().zip(value) {
            *to = *from;
        }
    }
}
