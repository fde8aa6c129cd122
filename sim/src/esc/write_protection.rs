//! Write protection (0x0020–0x0031) and reset over the wire (0x0040).
//!
//! Source: Beckhoff ESC data sheet, section II, 2.3.

use super::registers as reg;

/// The enable writes of the current frame and the progress of the reset sequence.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct WriteProtection {
    /// True if the current frame wrote 0x0020; the next field is the same for 0x0030.
    registers_enabled: bool,
    all_enabled: bool,
    /// The value that the current frame wrote to 0x0040.
    reset_byte: Option<u8>,
    /// Bytes of the reset sequence seen in consecutive frames.
    progress: u8,
}

const RESET_SEQUENCE: [u8; 3] = *b"RES";

impl WriteProtection {
    pub(super) fn begin_frame(&mut self) {
        (self.registers_enabled, self.all_enabled) = (false, false);
        self.reset_byte = None;
    }

    /// True if no reset sequence is in progress. Any other frame would abort the sequence.
    pub(super) fn is_idle(&self) -> bool {
        self.progress == 0
    }

    /// True if the protection registers permit a write from `start` to `end`.
    pub(super) fn allows(&self, start: usize, end: usize, registers: bool, all: bool) -> bool {
        let only = |register: u16| start == usize::from(register) && end == start + 1;
        if all && !self.all_enabled {
            return only(reg::ESC_WRITE_ENABLE);
        }
        if registers && !self.registers_enabled && start < reg::USER_RAM {
            return only(reg::WRITE_ENABLE) || only(reg::ESC_WRITE_ENABLE);
        }
        true
    }

    /// Notes a permitted write.
    pub(super) fn note(&mut self, start: usize, data: &[u8]) {
        let at = |register: u16| data.get(usize::from(register).checked_sub(start)?);
        self.registers_enabled |= at(reg::WRITE_ENABLE).is_some();
        self.all_enabled |= at(reg::ESC_WRITE_ENABLE).is_some();
        self.reset_byte = at(reg::RESET).copied().or(self.reset_byte);
    }

    /// Ends the frame. Returns the progress of the reset sequence if it changed; 3 resets the
    /// device.
    pub(super) fn end_frame(&mut self) -> Option<u8> {
        let before = self.progress;
        let expected = RESET_SEQUENCE.get(usize::from(before)).copied();
        self.progress = if self.reset_byte.is_some() && self.reset_byte == expected {
            before + 1
        } else {
            0
        };
        (self.progress != before).then_some(self.progress)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn protected_areas_are_writable_for_one_frame() {
        // (start, end, registers protected, everything protected), allowed before and after
        // enabling
        let rows = [
            (0x0100, 0x0104, false, false, [true, true, true]),
            (0x0100, 0x0104, true, false, [false, true, false]),
            (0x0020, 0x0021, true, false, [true, true, true]),
            (0x0020, 0x0022, true, false, [false, true, false]),
            (0x0030, 0x0031, true, false, [true, true, true]),
            (0x0f80, 0x0f90, true, false, [true, true, true]),
            (0x1000, 0x1010, true, false, [true, true, true]),
            (0x0100, 0x0104, false, true, [false, false, true]),
            (0x1000, 0x1010, false, true, [false, false, true]),
            (0x0020, 0x0021, false, true, [false, false, true]),
            (0x0030, 0x0031, false, true, [true, true, true]),
        ];
        for (start, end, registers, all, expected) in rows {
            let mut guard = WriteProtection::default();
            let mut seen = [false; 3];
            seen[0] = guard.allows(start, end, registers, all);
            guard.note(0x0020, &[0]);
            seen[1] = guard.allows(start, end, registers, all);
            guard.begin_frame();
            guard.note(0x0030, &[0]);
            seen[2] = guard.allows(start, end, registers, all);
            assert_eq!(seen, expected, "0x{start:04x} {registers} {all}");
        }
    }

    #[test]
    fn reset_sequence_needs_three_consecutive_frames() {
        let run = |frames: &[Option<u8>]| {
            let mut guard = WriteProtection::default();
            let mut last = 0;
            for byte in frames {
                guard.begin_frame();
                if let Some(byte) = byte {
                    guard.note(0x0040, &[*byte]);
                }
                last = guard.end_frame().unwrap_or(last);
            }
            last
        };
        assert_eq!(run(&[Some(b'R')]), 1);
        assert_eq!(run(&[Some(b'R'), Some(b'E'), Some(b'S')]), 3);
        assert_eq!(run(&[Some(b'R'), None, Some(b'E'), Some(b'S')]), 0);
        assert_eq!(run(&[Some(b'R'), Some(b'R'), Some(b'E')]), 0);
        assert_eq!(run(&[Some(b'E'), Some(b'S')]), 0);
    }
}
