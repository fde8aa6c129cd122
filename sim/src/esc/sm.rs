//! SyncManagers: who may touch process RAM, and when a buffer or mailbox changes hands.

/// How a SyncManager hands its area over.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Mode {
    #[default]
    Buffered,
    Mailbox,
    /// Control codes 1 and 3.
    Reserved,
}

impl Mode {
    #[must_use]
    pub fn from_control(control: u8) -> Self {
        match control & 3 {
            0 => Self::Buffered,
            2 => Self::Mailbox,
            _ => Self::Reserved,
        }
    }
}

/// Who fills the area.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Filled {
    /// The device writes, the MainDevice reads (inputs, mailbox in).
    #[default]
    ByDevice,
    ByMainDevice,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SyncManager {
    pub start: u16,
    pub len: u16,
    /// Register byte 4, as last accepted.
    pub control: u8,
    pub mode: Mode,
    pub filled: Filled,
    pub watchdog: bool,
    /// The MainDevice enabled it.
    pub enabled: bool,
    /// The device holds it closed (states below SafeOp).
    pub closed_by_device: bool,
    /// A mailbox with a message in it, or a buffer that was filled at least once.
    pub full: bool,
    /// A mailbox access began with the first byte and has not reached the last.
    open: bool,
}

/// What an access may do and causes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    Denied,
    Allowed,
    /// The access includes the last byte: the area changes hands.
    Completes,
}

impl SyncManager {
    /// The five configuration bytes and the activation byte, as registers hold them.
    pub fn configure(&mut self, r: &[u8; 8]) {
        let enable = r[6] & 1 != 0;
        if !self.enabled {
            self.start = u16::from_le_bytes([r[0], r[1]]);
            self.len = u16::from_le_bytes([r[2], r[3]]);
            self.control = r[4];
            self.mode = Mode::from_control(r[4]);
            self.filled = if r[4] >> 2 & 3 == 1 {
                Filled::ByMainDevice
            } else {
                Filled::ByDevice
            };
            self.watchdog = r[4] & 0x40 != 0;
        }
        if enable != self.enabled {
            self.enabled = enable;
            self.reset();
        }
    }

    /// Empties it, as enabling and closing do.
    pub fn reset(&mut self) {
        self.full = false;
        self.open = false;
    }

    #[must_use]
    pub fn overlaps(&self, start: usize, len: usize) -> bool {
        let (own, own_len) = (usize::from(self.start), usize::from(self.len));
        own_len > 0 && len > 0 && start < own + own_len && own < start + len
    }

    /// Bytes of memory it takes: three buffers in process RAM, one for mailboxes and for the digital
    /// outputs in front of it.
    #[must_use]
    pub fn footprint(&self) -> usize {
        let three = self.mode == Mode::Buffered && self.start >= 0x1000;
        usize::from(self.len) * if three { 3 } else { 1 }
    }

    #[must_use]
    pub fn is_open(&self) -> bool {
        self.enabled && !self.closed_by_device && self.mode != Mode::Reserved
    }

    /// Whether the MainDevice may read these bytes. State changes only in [`Self::did_read`].
    #[must_use]
    pub fn may_read(&self, start: usize, len: usize) -> Access {
        self.judge(start, len, Filled::ByDevice)
    }

    #[must_use]
    pub fn may_write(&self, start: usize, len: usize) -> Access {
        self.judge(start, len, Filled::ByMainDevice)
    }

    fn judge(&self, start: usize, len: usize, direction: Filled) -> Access {
        if !self.is_open() || self.filled != direction {
            return Access::Denied;
        }
        let readable = self.full == (direction == Filled::ByDevice);
        let first = usize::from(self.start);
        let begins = start <= first;
        match self.mode {
            Mode::Mailbox if !readable || !(begins || self.open) => return Access::Denied,
            Mode::Buffered if direction == Filled::ByDevice && !self.full => {
                return Access::Denied;
            }
            _ => {}
        }
        if start + len >= first + usize::from(self.len) {
            Access::Completes
        } else {
            Access::Allowed
        }
    }

    pub fn did_read(&mut self, access: Access) {
        if self.mode == Mode::Mailbox {
            self.open = access == Access::Allowed;
            if access == Access::Completes {
                self.full = false;
            }
        }
    }

    pub fn did_write(&mut self, access: Access) {
        self.open = self.mode == Mode::Mailbox && access == Access::Allowed;
        if access == Access::Completes {
            self.full = true;
        }
    }

    /// Register byte 5.
    #[must_use]
    pub fn status(&self) -> u8 {
        match (self.mode, self.full) {
            (Mode::Mailbox, true) => 0x08,
            (Mode::Buffered, false) if self.enabled => 0x30,
            _ => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sm(control: u8) -> SyncManager {
        let mut sm = SyncManager::default();
        sm.configure(&[0x00, 0x10, 0x30, 0, control, 0, 1, 0]);
        sm
    }

    #[test]
    fn a_full_mailbox_takes_nothing_more() {
        let mut sm = sm(0x26);
        assert_eq!(sm.may_read(0x1000, 0x30), Access::Denied);
        let access = sm.may_write(0x1000, 0x30);
        assert_eq!(access, Access::Completes);
        sm.did_write(access);
        assert_eq!(sm.status(), 0x08);
        assert_eq!(sm.may_write(0x1000, 0x30), Access::Denied);
    }

    #[test]
    fn a_mailbox_opens_at_its_first_byte_and_hands_over_at_its_last() {
        let mut sm = sm(0x26);
        assert_eq!(sm.may_write(0x102f, 1), Access::Denied);
        let access = sm.may_write(0x1000, 0x10);
        assert_eq!(access, Access::Allowed);
        sm.did_write(access);
        assert!(!sm.full);
        let access = sm.may_write(0x102f, 1);
        sm.did_write(access);
        assert!(sm.full);
    }

    #[test]
    fn an_empty_mailbox_and_an_unfilled_buffer_are_not_read() {
        for control in [0x22, 0x20] {
            let mut sm = sm(control);
            assert_eq!(sm.may_read(0x1000, 0x30), Access::Denied);
            sm.full = true;
            assert_eq!(sm.may_read(0x1000, 0x30), Access::Completes);
            sm.closed_by_device = true;
            assert_eq!(sm.may_read(0x1000, 0x30), Access::Denied);
        }
    }

    #[test]
    fn an_enabled_one_keeps_its_area_until_disabled() {
        let mut sm = sm(0x64);
        sm.configure(&[0x00, 0x20, 0x10, 0, 0x20, 0, 1, 0]);
        assert_eq!((sm.start, sm.watchdog), (0x1000, true));
        sm.configure(&[0x00, 0x20, 0x10, 0, 0x20, 0, 0, 0]);
        sm.configure(&[0x00, 0x20, 0x10, 0, 0x20, 0, 1, 0]);
        assert_eq!((sm.start, sm.watchdog), (0x2000, false));
    }
}
