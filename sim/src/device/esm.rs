//! State changes: the requirements and the effects of each transition.

use ecaxis_esi::model::Direction;

use super::SimDevice;
use crate::drive::DeviceError;
use crate::esc::al::{self, AlState, Request, code, judge};
use crate::esc::registers as reg;
use crate::esc::sm::{BufferOwner, Mode, SyncManager};

/// The time a device waits for the first SYNC0 before Op.
const FIRST_SYNC_NS: u64 = 5_000_000_000;
/// The time a device waits for the first outputs before Op.
const FIRST_OUTPUTS_NS: u64 = 1_000_000_000;

#[derive(Debug, Clone)]
pub(super) struct Al {
    pub(super) state: AlState,
    pub(super) code: u16,
    /// The current request, or the last one.
    control: u16,
    /// The request that the application has not read yet, and the request in progress.
    unread: Option<u16>,
    followed: Option<u16>,
    pub(super) due: u64,
    /// True while Op is requested and the first SYNC0 or the first outputs are missing.
    pub(super) waits_for_op: bool,
}

impl Default for Al {
    fn default() -> Self {
        Self {
            state: AlState::Init,
            code: 0,
            control: 1,
            unread: None,
            followed: None,
            due: u64::MAX,
            waits_for_op: false,
        }
    }
}

impl SimDevice {
    pub(super) fn al_requested(&mut self, control: u16, local: u64) {
        if self.esc.emulates_device() {
            self.al.control = control;
            return self.emulate(control);
        }
        self.al.unread = Some(control);
        if self.al.followed.is_none() {
            self.al.waits_for_op = false;
            self.al.due = local.saturating_add(self.state_notice_ns);
        }
    }

    /// Applies a request that the controller has already answered; the application cannot refuse
    /// it. The controller also copies the acknowledge bit, which then looks like an error.
    /// Recordings of EK1100 and EL1004 show this.
    fn emulate(&mut self, control: u16) {
        let to = AlState::from_code((control & 0x0f) as u8);
        let refusal = self.refusals.iter().find(|(state, _)| Some(*state) == to);
        if let Some((_, code)) = refusal {
            return self.settle(self.al.state, *code);
        }
        if let Some(to) = to {
            self.change(to);
            self.latch_inputs();
        }
        self.esc.put(reg::AL_STATUS_CODE, &[0, 0]);
    }

    /// Handles a due event: a request to read, a request to complete, or the end of the wait before
    /// Op.
    pub(super) fn al_step(&mut self, local: u64) {
        self.al.due = u64::MAX;
        if std::mem::take(&mut self.al.waits_for_op) {
            return self.finish_op();
        }
        match self.al.followed.take() {
            Some(control) => {
                self.al.control = control;
                self.follow(local);
                if self.al.unread.is_some() {
                    self.al.waits_for_op = false;
                    self.al.due = local.saturating_add(self.state_notice_ns);
                }
            }
            None => {
                self.esc.read_al_control();
                self.al.followed = self.al.unread.take();
                let rest = self.state_change_ns - self.state_notice_ns;
                self.al.due = local.saturating_add(rest);
            }
        }
    }

    fn follow(&mut self, local: u64) {
        let has_error = self.al.code != 0 && !self.quirks.error_bit_missing;
        let request = judge(self.al.state, has_error, self.al.control);
        if request == Request::Change(AlState::SafeOp) && self.al.state < AlState::SafeOp {
            self.adopt_assignments();
        }
        match request {
            Request::Ignored => {}
            Request::Stay => self.settle(self.al.state, 0),
            Request::Refused(code) => self.settle(self.al.state, code),
            Request::Change(to) => match self.demand(to) {
                Err(code) => self.settle(self.al.state, code),
                Ok(()) if to == AlState::Op => match self.missing_for_op() {
                    None => self.enter(to),
                    Some((_, wait)) => {
                        self.settle(self.al.state, 0);
                        self.al.waits_for_op = true;
                        self.al.due = local + wait;
                    }
                },
                Ok(()) => self.enter(to),
            },
        }
        if self.al.state < AlState::SafeOp {
            self.pdo.release(&mut self.store);
        }
    }

    fn adopt_assignments(&mut self) {
        for data in &self.process {
            if let Some(sm) = self.esc.sms.get(data.sm).filter(|sm| sm.enabled) {
                let number = u8::try_from(data.sm).unwrap_or(u8::MAX);
                self.pdo.adopt(&mut self.store, number, sm.len.into());
            }
        }
    }

    /// Returns what a device lacks before Op: the AL status code of a refusal and the time that it
    /// waits. ETG.1020: outputs must be valid before they take effect.
    fn missing_for_op(&self) -> Option<(u16, u64)> {
        if self.sync0_decides() && self.sync0_pulses() == 0 {
            return Some((code::NO_SYNC_ERROR, FIRST_SYNC_NS));
        }
        let misses_outputs = !self.outputs_are_none() && !self.supervision.has_outputs();
        misses_outputs.then_some((code::NO_VALID_OUTPUTS, FIRST_OUTPUTS_NS))
    }

    /// Ends the wait for SYNC0 and outputs before Op if both have come.
    pub(super) fn continue_to_op(&mut self) {
        if self.al.waits_for_op && self.application_runs() && self.missing_for_op().is_none() {
            self.al.waits_for_op = false;
            self.al.due = u64::MAX;
            self.finish_op();
        }
    }

    fn finish_op(&mut self) {
        match self.missing_for_op() {
            None => self.enter(AlState::Op),
            Some((code, _)) => self.settle(self.al.state, code),
        }
    }

    fn settle(&mut self, state: AlState, code: u16) {
        self.al.state = state;
        self.al.code = code;
        self.esc.set_al(state, code);
        if self.quirks.error_bit_missing {
            self.esc.put_al_status(u16::from(state.code()));
        }
        if code == 0 && self.al.control & al::DEVICE_ID != 0 {
            let id = self.esc.u16_at(reg::STATION_ALIAS);
            self.esc
                .put_al_status(u16::from(state.code()) | al::DEVICE_ID);
            self.esc.put(reg::AL_STATUS_CODE, &id.to_le_bytes());
        }
    }

    /// Checks the preconditions of state `to`.
    fn demand(&self, to: AlState) -> Result<(), u16> {
        if let Some((_, code)) = self.refusals.iter().find(|(state, _)| *state == to) {
            return Err(*code);
        }
        let rising = to > self.al.state;
        match to {
            AlState::PreOp if rising => self.check_mailbox(code::INVALID_MAILBOX_PREOP),
            AlState::Boot if !self.has_boot => Err(code::BOOT_NOT_SUPPORTED),
            AlState::Boot => self.check_mailbox(code::INVALID_MAILBOX_BOOT),
            AlState::SafeOp if self.is_stopped() => Err(code::NO_VALID_FIRMWARE),
            AlState::SafeOp if rising && self.pdo.modules_differ(&self.store) => {
                Err(code::MODULES_DIFFER)
            }
            AlState::SafeOp if rising => {
                self.check_process_data(to)?;
                if self.sync0_before_safe_op && self.sync0_pulses() == 0 {
                    return Err(code::NO_SYNC_ERROR);
                }
                self.check_sync()
            }
            AlState::Op => {
                self.check_process_data(to)?;
                self.check_sync()
            }
            _ => Ok(()),
        }
    }

    fn check_mailbox(&self, code: u16) -> Result<(), u16> {
        let Some(mailbox) = &self.mailbox else {
            return Ok(());
        };
        let fits = |n: usize, filled: BufferOwner, boot: &(u16, u16)| {
            let (Some(sm), Some(limits)) = (self.esc.sms.get(n), self.mailbox_limits.get(n)) else {
                return false;
            };
            let place = if code == code::INVALID_MAILBOX_BOOT {
                (sm.start, sm.len) == *boot
            } else {
                sm.start == limits.start && (limits.min..=limits.max).contains(&sm.len)
            };
            sm.enabled && sm.mode == Mode::Mailbox && sm.filled == filled && place
        };
        let good = fits(
            mailbox.receive,
            BufferOwner::ByMainDevice,
            &self.boot_mailbox.0,
        ) && fits(mailbox.send, BufferOwner::ByDevice, &self.boot_mailbox.1);
        if good { Ok(()) } else { Err(code) }
    }

    /// Checks the SyncManagers against the mapping of the device. A buffered SyncManager takes
    /// three times its length. An `OpOnly` SyncManager (ETG.2000) may be disabled in SafeOp.
    fn check_process_data(&self, state: AlState) -> Result<(), u16> {
        for data in &self.process {
            let outputs = data.direction == Direction::Rx;
            let code = if outputs {
                code::INVALID_OUTPUTS
            } else {
                code::INVALID_INPUTS
            };
            let filled = if outputs {
                BufferOwner::ByMainDevice
            } else {
                BufferOwner::ByDevice
            };
            let Some(sm) = self.esc.sms.get(data.sm) else {
                return Err(code);
            };
            let len = self.pdo_len(data.sm);
            if len == 0 {
                if sm.enabled && sm.len > 0 {
                    return Err(code);
                }
                continue;
            }
            if data.op_only && state != AlState::Op && !sm.enabled {
                continue;
            }
            let good = sm.enabled
                && usize::from(sm.len) == len
                && sm.mode == data.mode
                && sm.filled == filled
                && (!self.quirks.exact_control_byte || sm.control == data.control)
                && self.is_free(data.sm, sm);
            if !good {
                return Err(code);
            }
        }
        Ok(())
    }

    /// Returns the process data bytes of a SyncManager under the current assignment and mapping.
    #[must_use]
    pub(crate) fn pdo_len(&self, sm: usize) -> usize {
        let mut map = Vec::new();
        self.pdo
            .layout(&self.store, u8::try_from(sm).unwrap_or(0), &mut map)
    }

    /// True if the memory of the SyncManager overlaps no other SyncManager.
    fn is_free(&self, n: usize, sm: &SyncManager) -> bool {
        let area = |sm: &SyncManager| usize::from(sm.start)..usize::from(sm.start) + sm.footprint();
        let own = area(sm);
        let mut others = self
            .esc
            .sms
            .iter()
            .enumerate()
            .filter(|(m, sm)| *m != n && sm.enabled);
        let clear = others.all(|(_, other)| {
            let other = area(other);
            other.is_empty() || other.start >= own.end || own.start >= other.end
        });
        clear && own.end <= self.esc.memory()
    }

    fn check_sync(&self) -> Result<(), u16> {
        let activation = self
            .esc
            .bytes(reg::DC_ACTIVATION, 1)
            .first()
            .copied()
            .unwrap_or(0);
        if self.esc.dc.is_none() || activation & 1 == 0 {
            return Ok(());
        }
        // Without SYNC0, some devices take the time alone, or SYNC1.
        if activation & 2 == 0 {
            return match self.activations.contains(&activation) {
                true => Ok(()),
                false => Err(code::INVALID_DC_SYNC),
            };
        }
        if self.esc.u32_at(reg::DC_SYNC0_CYCLE) == 0 {
            return Err(code::INVALID_SYNC_CYCLE);
        }
        Ok(())
    }

    fn enter(&mut self, to: AlState) {
        self.change(to);
        self.settle(to, 0);
        self.latch_inputs();
        self.pump_mailbox();
    }

    /// Applies the effects of a state change on SyncManagers and outputs.
    fn change(&mut self, to: AlState) {
        let from = std::mem::replace(&mut self.al.state, to);
        if from == AlState::Op && to != from {
            self.drop_outputs();
        } else if to == AlState::Op {
            self.supervision.enter_op();
        }
        if from < AlState::SafeOp && to >= AlState::SafeOp {
            self.supervision.end_outputs();
            self.lay_out();
            self.close_process_data(false);
        } else if to < AlState::SafeOp {
            self.close_process_data(true);
        }
        if (to == AlState::Init || from == AlState::Init)
            && let Some(mailbox) = &mut self.mailbox
        {
            mailbox.reset();
            if let Some(time) = self.quirks.mailbox_late {
                mailbox.be_silent_until(self.local.saturating_add(time.0));
            }
            if let Some(sercos) = &mut self.sercos {
                sercos.reset();
            }
            for n in [mailbox.receive, mailbox.send] {
                if let Some(sm) = self.esc.sms.get_mut(n) {
                    sm.reset();
                }
                self.esc.refresh_sm(n);
            }
        }
    }

    /// Opens or closes the process data SyncManagers. Without an application, nothing holds them
    /// closed.
    pub(super) fn close_process_data(&mut self, closed: bool) {
        let closed = closed && !self.esc.emulates_device();
        for data in &self.process {
            self.esc.close_sm(data.sm, closed);
        }
    }

    /// Changes to a lower state because of an error of the device.
    pub(super) fn fall_to(&mut self, state: AlState, code: u16, error: DeviceError) {
        self.drop_outputs();
        if state < AlState::SafeOp {
            self.close_process_data(true);
        }
        // A pending request is still processed.
        if std::mem::take(&mut self.al.waits_for_op) {
            self.al.due = u64::MAX;
        }
        self.settle(state, code);
        self.show();
        self.application.error(error);
    }

    pub(super) fn watchdog_expired(&mut self) {
        self.esc.expire_watchdog();
        self.supervision.end_outputs();
        self.drop_outputs();
        let minds = self.application_runs() && !self.esc.emulates_device();
        if self.al.state == AlState::Op && minds {
            self.fall_to(
                AlState::SafeOp,
                code::SM_WATCHDOG,
                DeviceError::RxPdoTimeout,
            );
        }
    }

    /// Reacts to SyncManager or SYNC0 changes by the MainDevice while the application runs.
    pub(super) fn configuration_changed(&mut self, sms: bool, sync: bool) {
        let minds = self.application_runs() && !self.esc.emulates_device();
        if self.al.state < AlState::SafeOp || !minds {
            return;
        }
        if sms && let Err(code) = self.check_process_data(self.al.state) {
            self.fall_to(AlState::PreOp, code, DeviceError::BusDown);
        } else if sync && self.al.state == AlState::Op && !self.sync0_decides() {
            self.fall_to(
                AlState::SafeOp,
                code::FATAL_SYNC_ERROR,
                DeviceError::SyncLost,
            );
        }
    }
}
