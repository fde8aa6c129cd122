//! Answers datagrams of ethercrab's scan from what `bringup::eeproms` found before.
//!
//! - Reads of EEPROMs. ethercrab reads one device after another, four or eight bytes with three
//!   datagrams, and each read takes the EEPROM hundreds of microseconds.
//! - The request of Init, if all devices are in Init. A controller takes no other request until its
//!   processor has read this one (ESC data sheet, AL control), and the scan is fast.
//! - The DL status, if frames enter a device at another port than port 0. ethercrab measures the
//!   delays of every segment and rejects such a topology, even if nothing uses clocks.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::{Mutex, PoisonError};

use ecaxis_ecat::al_state::AlState;
use ecaxis_ecat::datagram::{Command, HEADER, Header, WORKING_COUNTER};
use ecaxis_ecat::registers::{AL_CONTROL, DL_STATUS, EEPROM_CONTROL, EEPROM_DATA};
use ecaxis_ecat::sii::control::{EIGHT_BYTES, READ};

use super::joined_frame::FRAME_HEADER;

/// The end of the EEPROM interface: control, address, data.
const INTERFACE_END: u16 = EEPROM_DATA + 8;
/// The position of the byte of the source address in which a SubDevice sets [`LOCAL`].
const SOURCE_ADDRESS: usize = 6;
/// The bit that distinguishes received frames from sent ones.
const LOCAL: u8 = 0x02;

/// Words of one EEPROM.
#[derive(Debug, Clone, Default)]
pub struct EepromWords {
    /// 0x0502 after the last read.
    status: u16,
    words: BTreeMap<u16, [u8; 2]>,
    /// The word address that was requested last; `None` if the device executes the request.
    requested: Option<u16>,
}

impl EepromWords {
    /// Adds what a read has brought, with 0x0502 afterwards. Returns the number of words.
    pub fn add(&mut self, word: u16, status: u16, data: [u8; 8]) -> u16 {
        self.status = status;
        let pairs = data.as_chunks().0.iter().take(usize::from(self.per_read()));
        self.words.extend((word..).zip(pairs.copied()));
        self.requested = Some(word);
        self.per_read()
    }

    /// Returns 0x0502 after the last read.
    #[must_use]
    pub fn status(&self) -> u16 {
        self.status
    }

    /// Returns the number of words that one read brings.
    #[must_use]
    pub fn per_read(&self) -> u16 {
        if self.status & EIGHT_BYTES != 0 { 4 } else { 2 }
    }

    #[must_use]
    pub fn word(&self, word: u16) -> Option<[u8; 2]> {
        self.words.get(&word).copied()
    }

    /// Returns what a read brings; `None` if a word of it is missing.
    fn data(&self, word: u16) -> Option<Vec<u8>> {
        let words = word..word.checked_add(self.per_read())?;
        let words: Option<Vec<_>> = words.map(|word| self.word(word)).collect();
        Some(words?.concat())
    }

    /// Returns the data of the answer to a datagram; `None` if the device must answer.
    fn answer(&mut self, command: Command, register: u16, data: &[u8]) -> Option<Vec<u8>> {
        match (command, register, data) {
            (Command::FPWR, EEPROM_CONTROL, [c0, c1, a0, a1, 0, 0])
                if u16::from_le_bytes([*c0, *c1]) == READ =>
            {
                let word = u16::from_le_bytes([*a0, *a1]);
                self.requested = self.data(word).map(|_| word);
                self.requested.map(|_| data.to_vec())
            }
            (Command::FPRD, EEPROM_CONTROL, [_, _]) => {
                self.requested.map(|_| self.status.to_le_bytes().to_vec())
            }
            (Command::FPRD, EEPROM_DATA, _) => {
                let brought = self.data(self.requested?)?;
                brought.get(..data.len()).map(<[u8]>::to_vec)
            }
            // Another command: from now on, only the device knows its EEPROM.
            (Command::FPWR, ..INTERFACE_END, _)
                if usize::from(register) + data.len() > usize::from(EEPROM_CONTROL) =>
            {
                *self = Self::default();
                None
            }
            _ => None,
        }
    }
}

/// What is known of a segment before ethercrab's scan.
#[derive(Debug, Default)]
pub struct ScanFindings {
    /// By station address.
    pub eeproms: BTreeMap<u16, EepromWords>,
    /// The number of devices if all are in Init without an error and have read their last request.
    pub all_in_init: Option<u16>,
    /// The station addresses of all devices if they are shown as a line.
    pub as_line: Option<RangeInclusive<u16>>,
}

/// The DL status of a device in a line, and of the last one: links and loops of the ports.
const IN_LINE: u16 = 0x5a30;
const LAST_IN_LINE: u16 = 0x5610;

impl ScanFindings {
    /// Returns data and working counter of the answer to a datagram; `None` if the bus must answer.
    fn answer(&mut self, header: Header, data: &[u8]) -> Option<(Vec<u8>, u16)> {
        let [s0, s1, r0, r1] = header.address.to_le_bytes();
        let register = u16::from_le_bytes([r0, r1]);
        if let (Command::BWR, AL_CONTROL, [control, ..]) = (header.command, register, data)
            && AlState::from_status(*control) == AlState::Init
        {
            return Some((data.to_vec(), self.all_in_init?));
        }
        let station = u16::from_le_bytes([s0, s1]);
        if let (Command::FPRD, DL_STATUS, [_, _]) = (header.command, register, data) {
            let line = self.as_line.as_ref()?;
            let status = match station == *line.end() {
                true => LAST_IN_LINE,
                false => IN_LINE,
            };
            let known = line.contains(&station);
            return known.then(|| (status.to_le_bytes().to_vec(), 1));
        }
        let device = self.eeproms.get_mut(&station)?;
        Some((device.answer(header.command, register, data)?, 1))
    }
}

/// The answers to ethercrab's scan. Empty at all other times.
#[derive(Debug, Default)]
pub struct ScanAnswers(Mutex<ScanFindings>);

impl ScanAnswers {
    /// Replaces the findings and returns the previous ones. The default ends the answers.
    pub fn replace(&self, with: ScanFindings) -> ScanFindings {
        let mut findings = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *findings, with)
    }

    /// Returns the answer to a frame with one datagram as the bus would send it; `None` if the frame
    /// must be sent.
    pub(super) fn answer(&self, frame: &[u8]) -> Option<Vec<u8>> {
        let header = frame.get(FRAME_HEADER..)?.first_chunk::<HEADER>()?;
        let header = Header::parse(header);
        let start = FRAME_HEADER + HEADER;
        let end = start + usize::from(header.len);
        let mut findings = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (data, counter) = findings.answer(header, frame.get(start..end)?)?;
        let mut answer = frame.to_vec();
        answer.get_mut(start..end)?.copy_from_slice(&data);
        let place = answer.get_mut(end..end + WORKING_COUNTER)?;
        place.copy_from_slice(&counter.to_le_bytes());
        *answer.get_mut(SOURCE_ADDRESS)? |= LOCAL;
        Some(answer)
    }
}

#[cfg(test)]
mod tests {
    use ecaxis_ecat::registers::EEPROM_CONFIGURATION;

    use super::*;
    use crate::link::joined_frame::datagrams;

    const STATION: u16 = 0x1001;
    const DEVICES: u16 = 300;
    const BYTES: [u8; 8] = [1, 2, 3, 4, 5, 6, 7, 8];

    fn answers(status: u16) -> ScanAnswers {
        let mut words = EepromWords::default();
        words.add(0x40, status, BYTES);
        let answers = ScanAnswers::default();
        answers.replace(ScanFindings {
            eeproms: BTreeMap::from([(STATION, words)]),
            ..ScanFindings::default()
        });
        answers
    }

    /// Returns the data of the answer to one datagram, whose frame is otherwise that of a SubDevice.
    fn ask(
        answers: &ScanAnswers,
        command: Command,
        (station, register): (u16, u16),
        data: &[u8],
    ) -> Option<Vec<u8>> {
        let header = Header {
            command,
            index: 9,
            address: u32::from(register) << 16 | u32::from(station),
            len: u16::try_from(data.len()).expect("short"),
            more: false,
        };
        let total = u16::try_from(HEADER + data.len() + 2).expect("short");
        let mut frame = vec![0x10; 12];
        frame.extend([0x88, 0xa4]);
        frame.extend((0x1000 | total).to_le_bytes());
        frame.extend(header.emit());
        frame.extend(data);
        frame.extend([0, 0]);
        let answer = answers.answer(&frame)?;
        let parts: Vec<_> = datagrams(&answer).collect();
        assert_eq!((parts.len(), answer.len()), (1, frame.len()));
        assert_eq!(
            answer[SOURCE_ADDRESS..12],
            [0x12, 0x10, 0x10, 0x10, 0x10, 0x10]
        );
        assert_eq!(
            answer[..FRAME_HEADER + HEADER][12..],
            frame[..FRAME_HEADER + HEADER][12..]
        );
        let (_, rest) = answer.split_at(FRAME_HEADER + HEADER);
        let (data, counter) = rest.split_at(data.len());
        let counts = match command {
            Command::BWR => DEVICES,
            _ => 1,
        };
        assert_eq!(counter, u16::to_le_bytes(counts));
        Some(data.to_vec())
    }

    fn request(answers: &ScanAnswers, word: u16) -> bool {
        let [a0, a1] = word.to_le_bytes();
        let read = [0, 1, a0, a1, 0, 0];
        let answer = ask(answers, Command::FPWR, (STATION, EEPROM_CONTROL), &read);
        assert!(answer.as_ref().is_none_or(|answer| answer == &read));
        answer.is_some()
    }

    fn status(answers: &ScanAnswers) -> Option<Vec<u8>> {
        ask(answers, Command::FPRD, (STATION, EEPROM_CONTROL), &[0, 0])
    }

    fn data(answers: &ScanAnswers, len: usize) -> Option<Vec<u8>> {
        ask(
            answers,
            Command::FPRD,
            (STATION, EEPROM_DATA),
            &vec![0; len],
        )
    }

    /// ETG.1000.4: a read brings four or eight bytes, as 0x0502 says.
    #[test]
    fn known_words_are_answered_from_any_word_on() {
        let eight = answers(EIGHT_BYTES);
        assert!(request(&eight, 0x40));
        assert_eq!(status(&eight), Some(EIGHT_BYTES.to_le_bytes().to_vec()));
        assert_eq!(data(&eight, 8), Some(BYTES.to_vec()));
        assert!(!request(&eight, 0x41), "a word is missing");
        let four = answers(0x80);
        assert_eq!(status(&four), Some(vec![0x80, 0]), "before a request");
        assert!(request(&four, 0x40));
        assert_eq!(data(&four, 4), Some(BYTES[..4].to_vec()));
        assert_eq!(data(&four, 8), None, "more than a read brings");
    }

    #[test]
    fn unknown_word_is_left_to_its_device_until_the_next_known_one() {
        let answers = answers(EIGHT_BYTES);
        for unknown in [0x3f, 0x44, 0xfffd, 0xffff] {
            assert!(!request(&answers, unknown));
            assert_eq!((status(&answers), data(&answers, 8)), (None, None));
            assert!(request(&answers, 0x40));
            assert_eq!(data(&answers, 8), Some(BYTES.to_vec()));
        }
    }

    #[test]
    fn everything_else_is_left_to_the_devices() {
        let answers = answers(EIGHT_BYTES);
        let read = [0, 1, 0x40, 0, 0, 0];
        let other = |command, at, data: &[u8]| ask(&answers, command, at, data).is_none();
        assert!(other(Command::FPWR, (STATION + 1, EEPROM_CONTROL), &read));
        assert!(other(Command::APWR, (STATION, EEPROM_CONTROL), &read));
        assert!(other(
            Command::FPWR,
            (STATION, EEPROM_CONFIGURATION),
            &[2, 0]
        ));
        assert!(other(Command::FPWR, (STATION, AL_CONTROL), &[2, 0]));
        assert!(other(Command::FPRD, (STATION, EEPROM_CONTROL), &[0; 6]));
        assert!(request(&answers, 0x40), "none of these changes it");
        for changes in [
            (EEPROM_CONTROL, &[1, 2, 0x40, 0, 0, 0][..]),
            (EEPROM_CONTROL, &[0, 4, 0, 0, 0, 0]),
            (EEPROM_CONTROL, &[0, 0]),
            (EEPROM_DATA, &[7, 7]),
            (EEPROM_CONFIGURATION, &[0; 16]),
        ] {
            let answers = self::answers(EIGHT_BYTES);
            assert_eq!(
                ask(&answers, Command::FPWR, (STATION, changes.0), changes.1),
                None
            );
            assert!(!request(&answers, 0x40), "{changes:?}");
        }
    }

    /// ETG.1000.4, AL control: ethercrab requests Init with the bit that acknowledges errors.
    #[test]
    fn request_of_init_is_answered_if_all_devices_are_in_init() {
        let answers = answers(EIGHT_BYTES);
        let request =
            |command, control| ask(&answers, command, (0, AL_CONTROL), &[control, 0]).is_some();
        assert!(!request(Command::BWR, 0x11));
        answers.replace(ScanFindings {
            all_in_init: Some(DEVICES),
            ..ScanFindings::default()
        });
        assert!(request(Command::BWR, 0x11) && request(Command::BWR, 1));
        assert!(!request(Command::BWR, 2) && !request(Command::FPWR, 1));
        answers.replace(ScanFindings::default());
        assert!(!request(Command::BWR, 0x11));
    }

    /// ETG.1000.4, DL status: link of ports 0 and 1 in bits 4 and 5, open ports in bits 9 and 11.
    #[test]
    fn dl_status_is_that_of_a_line_if_wanted() {
        let answers = answers(EIGHT_BYTES);
        let status = |station| ask(&answers, Command::FPRD, (station, DL_STATUS), &[0, 0]);
        assert_eq!(status(STATION), None);
        answers.replace(ScanFindings {
            as_line: Some(0x1000..=0x1002),
            ..ScanFindings::default()
        });
        let found = [0x0fff, 0x1000, 0x1001, 0x1002, 0x1003].map(status);
        let [inner, last] = [vec![0x30, 0x5a], vec![0x10, 0x56]].map(Some);
        assert_eq!(found, [None, inner.clone(), inner, last, None]);
    }

    #[test]
    fn damaged_frames_are_not_answered() {
        let answers = answers(EIGHT_BYTES);
        for len in 0..64 {
            for fill in [0, 4, 0xff] {
                assert_eq!(answers.answer(&vec![fill; len]), None);
            }
        }
    }
}
