//! One drive: its procedure command, the values that configure it, and the IDNs that show its state.

use super::{CONTROL_WORD, STATUS_WORD, SercosDrive, VALUES, state};
use crate::Nanos;
use crate::coe::object_dictionary::ObjectStore;

impl SercosDrive {
    /// Sets, interrupts or clears S-0-0099.
    pub(super) fn command(&mut self, control: u16, local: Nanos) -> Result<(), u16> {
        match (control & 3, self.reset.0) {
            (state::CLEARED, _) => self.reset = (state::CLEARED, local),
            (state::EXECUTED, state::CLEARED) => self.reset = (state::RUNNING, local),
            (state::EXECUTED, _) => return Err(0x7010),
            (state::SET, _) => return Err(0x7011),
            _ => return Err(0x7013),
        }
        Ok(())
    }

    /// Applies a value that configures the drive.
    pub(super) fn apply(
        &mut self,
        store: &mut ObjectStore,
        drive: u8,
        number: u16,
        value: &[u8],
    ) -> Result<(), u16> {
        let word = value
            .first_chunk()
            .map_or(0, |bytes| u16::from_le_bytes(*bytes));
        match number {
            2 => {
                // The cycle in 0x60C2: a value up to 255 and a power of ten.
                let (mut value, mut power) = (word, -6_i64);
                while value > 255 {
                    (value, power) = (value / 10, power + 1);
                }
                store.set(self.period[0], i64::from(value));
                store.set(self.period[1], power);
            }
            16 | 24 => return map(store, drive, number, value),
            32 => {
                let mode = match word & 7 {
                    1 => 10,
                    2 => 9,
                    3 | 4 => 8,
                    _ => return Err(0x7008),
                };
                store.set(self.mode, mode);
            }
            _ => {}
        }
        Ok(())
    }

    /// Updates the IDNs that show the state of the drive.
    pub(super) fn refresh(&mut self, store: &ObjectStore) {
        let code = store.get(self.error_code) as u16;
        let values = VALUES.iter().zip(&self.values);
        let mut shown: Vec<(u16, Vec<u8>)> = values
            .map(|((number, _, bits, _), (idn, ..))| {
                let bytes = store.get_signed(*idn).to_le_bytes();
                let len = (*bits / 8) as usize;
                (*number, bytes.get(..len).unwrap_or_default().to_vec())
            })
            .collect();
        let number = if code == 0 {
            0
        } else {
            0xf_0000 | u32::from(code)
        };
        let text = match code {
            0 => "ready".to_owned(),
            code => format!("F{code:04X} {}", diagnostic(code)),
        };
        let words = [
            (CONTROL_WORD, self.control_word),
            (STATUS_WORD, self.status_word),
        ];
        shown.extend(
            words.map(|(idn, slot)| (idn, (store.get(slot) as u16).to_le_bytes().to_vec())),
        );
        shown.push((11, class_1(code).to_le_bytes().to_vec()));
        shown.push((95, text.into_bytes()));
        shown.push((390, number.to_le_bytes().to_vec()));
        for (number, value) in shown {
            if let Some(idn) = self.dictionary.get_mut(&number) {
                idn.value = value;
            }
        }
    }
}

/// Sets the contents of AT (16) or MDT (24). The word of the drive comes first.
fn map(store: &mut ObjectStore, drive: u8, number: u16, list: &[u8]) -> Result<(), u16> {
    let pdo = number | u16::from(drive) << 12;
    let outputs = number == 24;
    let mut entries = vec![(if outputs { CONTROL_WORD } else { STATUS_WORD }, 16)];
    for idn in list
        .chunks(2)
        .map(|one| u16::from_le_bytes([one[0], one[1]]))
    {
        let known = VALUES
            .iter()
            .find(|(own, .., out)| *own == idn && *out == outputs);
        let (_, _, bits, _) = known.ok_or(0x7008_u16)?;
        entries.push((idn, *bits));
    }
    for (sub, (idn, bits)) in (1..).zip(&entries) {
        let slot = store.slot(pdo, sub).ok_or(0x7008_u16)?;
        store.set(
            slot,
            i64::from(u32::from(*idn) << 16 | u32::from(drive) << 8 | bits),
        );
    }
    let count = store.slot(pdo, 0).ok_or(0x7008_u16)?;
    store.set(count, i64::try_from(entries.len()).unwrap_or(0));
    Ok(())
}

/// Returns the bit of S-0-0011 for an error code of the drive.
fn class_1(code: u16) -> u16 {
    match code {
        0 => 0,
        0x2200..=0x23ff => 1 << 7,
        0x3110..=0x3211 => 1 << 8,
        0x3220..=0x3221 => 1 << 9,
        0x4200..=0x42ff => 1 << 1,
        0x4300..=0x43ff => 1 << 2,
        0x7300..=0x73ff => 1 << 5,
        0x8100..=0x82ff => 1 << 12,
        0x8600..=0x86ff => 1 << 11,
        0x8a80..=0x8a82 => 1 << 13,
        _ => 1 << 15,
    }
}

fn diagnostic(code: u16) -> &'static str {
    match class_1(code).trailing_zeros() {
        1 => "amplifier overtemperature",
        2 => "motor overtemperature",
        5 => "feedback error",
        7 => "overcurrent",
        8 => "overvoltage",
        9 => "undervoltage",
        11 => "excessive position deviation",
        12 => "communication error",
        13 => "travel limit exceeded",
        _ => "drive error",
    }
}
