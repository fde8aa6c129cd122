//! The register values of a SubDevice (ETG.1000.4) from writes and reads.

/// The end of the registers and start of process memory.
const REGISTERS: usize = 0x1000;
const FMMUS: usize = 16;
const SYNC_MANAGERS: usize = 16;
/// The mode of SyncManagers that are mailboxes.
const MODE_MAILBOX: u8 = 2;

/// The registers of one device.
#[derive(Clone)]
pub struct Registers {
    values: Vec<u8>,
    known: Vec<bool>,
}

impl std::fmt::Debug for Registers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let known = self.known.iter().filter(|known| **known).count();
        f.debug_struct("Registers").field("known", &known).finish()
    }
}

impl Default for Registers {
    fn default() -> Self {
        Self {
            values: vec![0; REGISTERS],
            known: vec![false; REGISTERS],
        }
    }
}

/// The configuration of one SyncManager.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncManager {
    pub number: u8,
    pub start: u16,
    pub len: u16,
    pub mailbox: bool,
    /// True for MainDevice to SubDevice.
    pub output: bool,
    pub enabled: bool,
}

/// The configuration of one FMMU.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fmmu {
    pub number: u8,
    pub logical: u32,
    pub len: u16,
    pub logical_start_bit: u8,
    pub physical: u16,
    pub physical_start_bit: u8,
    /// True for MainDevice to SubDevice.
    pub output: bool,
    pub input: bool,
}

impl Registers {
    pub fn set(&mut self, register: u16, data: &[u8]) {
        let start = usize::from(register);
        let values = self.values.iter_mut().skip(start);
        let known = self.known.iter_mut().skip(start);
        for ((value, known), new) in values.zip(known).zip(data) {
            (*value, *known) = (*new, true);
        }
    }

    /// Returns the bytes if all of them are known.
    pub fn bytes(&self, register: u16, len: usize) -> Option<&[u8]> {
        let range = usize::from(register)..usize::from(register) + len;
        let known = self.known.get(range.clone())?;
        self.values
            .get(range)
            .filter(|_| known.iter().all(|known| *known))
    }

    pub fn u8(&self, register: u16) -> Option<u8> {
        self.bytes(register, 1)?.first().copied()
    }

    pub fn u16(&self, register: u16) -> Option<u16> {
        let bytes = self.bytes(register, 2)?.first_chunk()?;
        Some(u16::from_le_bytes(*bytes))
    }

    pub fn u32(&self, register: u16) -> Option<u32> {
        let bytes = self.bytes(register, 4)?.first_chunk()?;
        Some(u32::from_le_bytes(*bytes))
    }

    /// Iterates over the SyncManagers with a known configuration and a length above 0.
    pub fn sync_managers(&self) -> impl Iterator<Item = SyncManager> + '_ {
        (0..SYNC_MANAGERS as u8).filter_map(|number| {
            let at = ecaxis_ecat::registers::SYNC_MANAGER
                + ecaxis_ecat::registers::SYNC_MANAGER_LEN * u16::from(number);
            let control = self.u8(at + 4)?;
            let (start, len) = (self.u16(at)?, self.u16(at + 2)?);
            // Process data may have one buffer, too, but only they have an FMMU.
            let one_buffer = control & 0x03 == MODE_MAILBOX;
            (len > 0).then_some(SyncManager {
                number,
                start,
                len,
                mailbox: one_buffer && !self.is_mapped(start, len),
                output: control >> 2 & 0x03 == 1,
                enabled: self.u8(at + 6).is_some_and(|activate| activate & 1 != 0),
            })
        })
    }

    /// True if an active FMMU maps a part of the memory.
    fn is_mapped(&self, start: u16, len: u16) -> bool {
        let end = |start: u16, len: u16| u32::from(start) + u32::from(len);
        self.fmmus().any(|fmmu| {
            u32::from(fmmu.physical) < end(start, len)
                && u32::from(start) < end(fmmu.physical, fmmu.len)
        })
    }

    /// Iterates over the active FMMUs.
    pub fn fmmus(&self) -> impl Iterator<Item = Fmmu> + '_ {
        (0..FMMUS as u8).filter_map(|number| {
            let at = 0x0600 + 16 * u16::from(number);
            let kind = self.u8(at + 11)?;
            (self.u8(at + 12)? & 1 != 0).then_some(Fmmu {
                number,
                logical: self.u32(at)?,
                len: self.u16(at + 4)?,
                logical_start_bit: self.u8(at + 6)? & 7,
                physical: self.u16(at + 8)?,
                physical_start_bit: self.u8(at + 10)? & 7,
                output: kind & 2 != 0,
                input: kind & 1 != 0,
            })
        })
    }
}

/// Returns the part of the data at the register `wanted` if all `len` bytes are present.
pub fn part(register: u16, data: &[u8], wanted: u16, len: usize) -> Option<&[u8]> {
    let at = usize::from(wanted.checked_sub(register)?);
    data.get(at..at.checked_add(len)?)
}

/// Returns the part as a little-endian number of two bytes.
pub fn part_u16(register: u16, data: &[u8], wanted: u16) -> Option<u16> {
    let bytes = part(register, data, wanted, 2)?.first_chunk()?;
    Some(u16::from_le_bytes(*bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// ETG.1000.4: the same mode serves mailboxes and process data of one buffer. An FMMU maps the
    /// latter only.
    #[test]
    fn a_sync_manager_with_one_buffer_is_a_mailbox_unless_it_is_mapped() {
        let mut registers = Registers::default();
        // Start, length, control, status, activation.
        registers.set(0x0800, &[0x00, 0x10, 128, 0, 0x26, 0, 1]);
        registers.set(0x0808, &[0x80, 0x10, 1, 0, 0x46, 0, 1]);
        let mailboxes = |registers: &Registers| -> Vec<bool> {
            registers.sync_managers().map(|sm| sm.mailbox).collect()
        };
        assert_eq!(mailboxes(&registers), [true, true]);
        registers.set(0x0600, &[0, 0, 1, 0, 1, 0, 0, 7, 0x80, 0x10, 0, 2, 1]);
        assert_eq!(mailboxes(&registers), [true, false]);
        // Mailbox status: a register of the SyncManager, not its memory.
        registers.set(0x0610, &[0, 0, 1, 0, 1, 0, 0, 0, 0x0d, 0x08, 0, 1, 1]);
        assert_eq!(mailboxes(&registers), [true, false]);
    }
}
