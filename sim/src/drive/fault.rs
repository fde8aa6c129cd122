//! The fault latch: error code, error register, emergencies waiting to be sent.

use super::state::Ramp;

/// A CoE emergency as the mailbox sends it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Emergency {
    pub code: u16,
    /// 0x1001 when the emergency was raised.
    pub register: u8,
    pub data: [u8; 5],
}

/// Errors that the communication side reports to the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DeviceError {
    /// SYNC0 is not in step with the process data.
    SyncLost,
    /// A cyclic mode received no new set-point in time.
    RxPdoTimeout,
    /// The device left Op, or the link is down.
    BusDown,
}

impl DeviceError {
    pub(super) fn code(self) -> u16 {
        match self {
            Self::SyncLost => 0x8280,
            Self::RxPdoTimeout => 0x8250,
            Self::BusDown => 0x8180,
        }
    }
}

pub(super) const FOLLOWING_ERROR: u16 = 0x8611;
pub(super) const NEGATIVE_LIMIT_SWITCH: u16 = 0x8a80;
pub(super) const POSITIVE_LIMIT_SWITCH: u16 = 0x8a81;
pub(super) const SOFTWARE_POSITION_LIMIT: u16 = 0x8a82;

/// Returns 0x1001 for a fault code: the generic bit and the bit of its family.
pub(super) fn error_register(code: u16) -> u8 {
    1 | match code >> 8 {
        0x00 => return 0,
        0x20..=0x2f => 1 << 1,
        0x30..=0x3f => 1 << 2,
        0x40..=0x4f => 1 << 3,
        0x81 | 0x82 => 1 << 4,
        0x83..=0x8f | 0x73 => 1 << 5,
        0xff => 1 << 7,
        _ => 0,
    }
}

/// The reaction of a moving axis to a fault. `None`: coast.
pub(super) type Reaction = Option<Ramp>;

const QUEUE: usize = 8;

#[derive(Debug, Clone, Default)]
pub(super) struct Faults {
    /// 0x603F.
    code: u16,
    /// A persistent cause: reset is refused while it is set.
    cause: Option<u16>,
    queue: [Option<Emergency>; QUEUE],
    /// The newest code that is not yet in the error history.
    unrecorded: Option<u16>,
}

impl Faults {
    pub(super) fn code(&self) -> u16 {
        self.code
    }

    pub(super) fn register(&self) -> u8 {
        error_register(self.code)
    }

    pub(super) fn cause(&self) -> Option<u16> {
        self.cause
    }

    pub(super) fn set_cause(&mut self, cause: Option<u16>) {
        self.cause = cause;
    }

    pub(super) fn latch(&mut self, code: u16) {
        self.code = code;
        self.unrecorded = Some(code);
        self.announce(code);
    }

    /// Clears the fault and queues the emergency "Error reset or no error".
    pub(super) fn clear(&mut self) {
        self.code = 0;
        self.announce(0);
    }

    pub(super) fn take_unrecorded(&mut self) -> Option<u16> {
        self.unrecorded.take()
    }

    pub(super) fn take_emergency(&mut self) -> Option<Emergency> {
        let first = self.queue.first_mut()?.take();
        if first.is_some() {
            self.queue.rotate_left(1);
        }
        first
    }

    fn announce(&mut self, code: u16) {
        // The queue is full only if no client reads the mailbox. It then keeps the oldest
        // emergencies.
        if let Some(free) = self.queue.iter_mut().find(|slot| slot.is_none()) {
            *free = Some(Emergency {
                code,
                register: error_register(code),
                data: [0; 5],
            });
        }
    }
}
