//! Emergencies of CoE, emergencies and notifications of SoE: messages that a device sends without a
//! request, queued until they are taken.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecaxis_axis::cia402::describe;
use ecaxis_ecat::mailbox::soe::{DataState, Idn, Operation, Telegram};

/// The capacity of the queue. Beyond it the newest are dropped and counted, because the first ones
/// show the cause.
pub const EMERGENCY_QUEUE: usize = 32;

/// The service that sent an emergency.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EmergencySource {
    /// CoE.
    Coe,
    /// SoE: the drive of the device.
    Soe { drive: u8 },
    /// A notification of SoE, such as the end of a procedure command.
    Notification { drive: u8, idn: Idn },
}

/// One emergency (ETG.1000.6 Table 50), or a notification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Emergency {
    pub source: EmergencySource,
    /// CoE: the code as in 0x603F; 0x0000 means that an earlier error is gone. SoE: the diagnostic
    /// number. Notification: the data state.
    pub code: u16,
    /// Error register 0x1001.
    pub register: u8,
    /// Vendor-specific data.
    pub data: [u8; 5],
}

impl Emergency {
    #[must_use]
    pub const fn from_bytes([low, high, register, data @ ..]: [u8; 8]) -> Self {
        Self {
            source: EmergencySource::Coe,
            code: u16::from_le_bytes([low, high]),
            register,
            data,
        }
    }

    /// Returns the emergency or notification in an SoE telegram; `None` for other telegrams.
    #[must_use]
    pub fn from_telegram(telegram: &Telegram<'_>) -> Option<Self> {
        let drive = telegram.drive;
        let mut bytes = [0; 8];
        for (to, from) in bytes.iter_mut().zip(telegram.data) {
            *to = *from;
        }
        let source = match telegram.operation {
            Operation::Emergency => EmergencySource::Soe { drive },
            Operation::Notification => {
                let idn = telegram.idn()?;
                EmergencySource::Notification { drive, idn }
            }
            _ => return None,
        };
        Some(Self {
            source,
            ..Self::from_bytes(bytes)
        })
    }

    /// Returns the meaning of the code according to CiA 301, CiA 402 and maxon.
    pub fn text(&self) -> &'static str {
        match self.source {
            EmergencySource::Coe => {}
            EmergencySource::Soe { .. } => return "see S-0-0095 and S-0-0390 of the drive",
            EmergencySource::Notification { .. } => return "notification of a procedure command",
        }
        match self.code {
            0xa000 | 0xa001 => self.class(),
            _ if self.is_reset() => "an earlier error is gone",
            code => describe(code).text,
        }
    }

    /// True if the emergency reports that an earlier error is gone.
    pub fn is_reset(&self) -> bool {
        self.code == 0 && self.source == EmergencySource::Coe
    }

    /// True if the message reports a failure.
    pub fn is_failure(&self) -> bool {
        match self.source {
            EmergencySource::Coe => self.code != 0,
            EmergencySource::Soe { .. } => true,
            EmergencySource::Notification { .. } => self.code & DataState::FAILED != 0,
        }
    }

    /// Returns the meaning of the code's class according to CiA 301. The drive's fault table has
    /// the exact text.
    pub fn class(&self) -> &'static str {
        match self.code {
            0xa000 => "PreOp to SafeOp failed",
            0xa001 => "SafeOp to Op failed",
            _ => match self.code >> 8 {
                0x00 => "error reset or no error",
                0x10 => "generic error",
                0x20..=0x2f => "current",
                0x30..=0x3f => "voltage",
                0x40..=0x4f => "temperature",
                0x50..=0x5f => "device hardware",
                0x60..=0x6f => "device software",
                0x70..=0x7f => "additional modules",
                0x81 => "communication",
                0x82 => "protocol",
                0x80 | 0x83..=0x8f => "monitoring",
                0x90..=0x9f => "external error",
                0xf0..=0xfe => "additional functions",
                0xff => "device specific",
                _ => "unknown class",
            },
        }
    }
}

impl fmt::Display for Emergency {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c, d, e] = self.data;
        match self.source {
            EmergencySource::Coe => {}
            EmergencySource::Soe { drive } => {
                return write!(
                    f,
                    "SoE emergency of drive {drive}: {:#06x}, data {:02x} {a:02x} {b:02x} {c:02x} {d:02x} {e:02x}",
                    self.code, self.register
                );
            }
            EmergencySource::Notification { drive, idn } => {
                let state = DataState(self.code).command();
                return write!(
                    f,
                    "notification of drive {drive}: {} is {state}",
                    idn.named()
                );
            }
        }
        write!(
            f,
            "emergency {:#06x} ({}), error register {:#04x}, data {a:02x} {b:02x} {c:02x} {d:02x} {e:02x}",
            self.code,
            self.text(),
            self.register
        )
    }
}

/// An emergency with the time at which it was read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Received {
    /// On the wire's clock, in ns.
    pub at: u64,
    pub emergency: Emergency,
}

/// The emergencies of a device that were not taken yet. The queue is bounded and keeps the first
/// ones. Clones share one queue, so it can be emptied during a transfer.
#[derive(Debug, Clone, Default)]
pub struct Emergencies(Arc<Mutex<Queue>>);

#[derive(Debug, Default)]
struct Queue {
    waiting: VecDeque<Received>,
    lost: u64,
}

impl Emergencies {
    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn push(&self, at: u64, emergency: Emergency) {
        let mut queue = self.queue();
        if queue.waiting.len() < EMERGENCY_QUEUE {
            queue.waiting.push_back(Received { at, emergency });
        } else {
            queue.lost += 1;
        }
    }

    /// Takes the queued emergencies, oldest first.
    pub fn take(&self) -> Vec<Received> {
        self.queue().waiting.drain(..).collect()
    }

    /// Returns how many emergencies were dropped because the queue was full.
    pub fn lost(&self) -> u64 {
        self.queue().lost
    }
}
