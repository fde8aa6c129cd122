//! What quirks ([`Quirks::TABLE`]) change in a drive.
//!
//! * `act`: what the quirks of Controlword, Statusword, mode, position and brake do in each control
//!   cycle
//! * `gear`: 0x6091
//!
//! Parameters and torques read their quirks where they read their objects.

mod act;
mod gear;

pub(super) use act::{ActiveQuirks, Seen};
pub(super) use gear::Gear;

use crate::quirks::Quirks;

impl Quirks {
    /// True if the shaft has a holding brake.
    pub(super) fn has_brake(&self) -> bool {
        self.brake.is_some() || self.brake_bit.is_some()
    }

    /// Returns 0x6502 without the modes that the drive does not support.
    pub(super) fn supported_modes(&self, listed: i64) -> i64 {
        listed & !i64::from(self.unsupported_modes)
    }

    /// True if the drive supports a mode by its code.
    pub(super) fn supports(&self, mode: i64) -> bool {
        let bit = mode
            .checked_sub(1)
            .and_then(|n| u32::try_from(n).ok())
            .and_then(|n| 1_u32.checked_shl(n));
        bit.is_none_or(|bit| self.unsupported_modes & bit == 0)
    }
}
