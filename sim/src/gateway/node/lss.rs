//! The layer setting services of a node (CiA 305): its number and bit rate without DIP switches.

use super::super::can::{CanBus, CanFrame};
use super::super::dictionary::Dictionary;
use super::super::lss::{MASTER, SLAVE, UNNUMBERED, cs};
use super::super::nmt::NmtState;
use super::{COMMUNICATION_BOOT_NS, MS, Node, epos};

/// The bit rates of the standard's table, by their values of 0x2001. `None`: not supported.
const BIT_TIMINGS: [Option<u8>; 9] = [
    Some(0),
    Some(1),
    Some(2),
    Some(3),
    Some(4),
    None,
    Some(5),
    Some(6),
    None,
];
const OUT_OF_RANGE: u8 = 1;

/// The state of the services in a node.
#[derive(Debug, Clone, Default)]
pub(super) struct Lss {
    /// State "Configuration", else "Waiting".
    configures: bool,
    /// The parts of the address that matched in a row: selection, and identification.
    selected: u8,
    identified: u8,
    /// The number and the value of 0x2001 that wait to be activated or stored.
    number: Option<u8>,
    rate: Option<u8>,
    /// A change of the bit rate: the switch, and the end of the second delay.
    switch: Option<(u64, u64)>,
}

impl Lss {
    pub(super) fn due(&self) -> u64 {
        self.switch.map_or(u64::MAX, |(at, end)| at.min(end))
    }

    /// Takes one part of an LSS address, which are sent in order. True after the last one.
    fn matched(seen: &mut u8, part: u8, matches: bool, parts: u8) -> bool {
        *seen = match part {
            _ if !matches => 0,
            0 => 1,
            part if *seen == part => part + 1,
            _ => 0,
        };
        *seen == parts
    }
}

impl Node {
    /// True while the services are accessible: in STOPPED, and without a number.
    fn lss_accessible(&self) -> bool {
        self.nmt == NmtState::Stopped || self.number == UNNUMBERED
    }

    pub(super) fn lss_request(&mut self, frame: &CanFrame, now: u64, bus: &mut CanBus) {
        if frame.id != MASTER || frame.data().len() != 8 || !self.lss_accessible() {
            return;
        }
        let [command, data @ ..] = frame.padded();
        let value = u32::from_le_bytes([data[0], data[1], data[2], data[3]]);
        let identity = [1, 2, 3, 4].map(|sub| self.d.get(0x1018, sub) as u32);
        let own = |part: u8| identity.get(usize::from(part)).copied().unwrap_or(0);
        let configures = self.lss.configures;
        let answer: Option<[u8; 4]> = match command {
            cs::SWITCH_GLOBAL => {
                self.lss.configures = data[0] == 1;
                if configures && data[0] == 0 {
                    self.leave_configuration(now);
                }
                None
            }
            cs::SELECT_VENDOR..=cs::SELECT_SERIAL if !configures => {
                let part = command - cs::SELECT_VENDOR;
                let all = Lss::matched(&mut self.lss.selected, part, value == own(part), 4);
                self.lss.configures = all;
                return self.answer_lss(all.then_some((cs::SELECTED, [0; 4])), now, bus);
            }
            cs::IDENTIFY_VENDOR..=cs::IDENTIFY_SERIAL_HIGH => {
                let part = command - cs::IDENTIFY_VENDOR;
                let matches = match part {
                    0 | 1 => value == own(part),
                    2 => own(2) >= value,
                    3 => own(2) <= value,
                    4 => own(3) >= value,
                    _ => own(3) <= value,
                };
                let all = Lss::matched(&mut self.lss.identified, part, matches, 6);
                return self.answer_lss(all.then_some((cs::IDENTIFIED, [0; 4])), now, bus);
            }
            cs::IDENTIFY_UNNUMBERED => {
                let answers = self.number == UNNUMBERED;
                let answer = answers.then_some((cs::IS_UNNUMBERED, [0; 4]));
                return self.answer_lss(answer, now, bus);
            }
            cs::SET_NUMBER if configures => {
                let valid = (1..=127).contains(&data[0]) || data[0] == UNNUMBERED;
                self.lss.number = Some(data[0]).filter(|_| valid).or(self.lss.number);
                Some([u8::from(!valid) * OUT_OF_RANGE, 0, 0, 0])
            }
            cs::SET_BIT_TIMING if configures => {
                let rate = BIT_TIMINGS.get(usize::from(data[1])).copied().flatten();
                let rate = rate.filter(|_| data[0] == 0);
                self.lss.rate = rate.or(self.lss.rate);
                Some([u8::from(rate.is_none()) * OUT_OF_RANGE, 0, 0, 0])
            }
            cs::ACTIVATE_BIT_TIMING if configures && self.lss.rate.is_some() => {
                let delay = u64::from(u16::from_le_bytes([data[0], data[1]])) * MS;
                self.online = false;
                bus.forget(self.settings.id);
                self.lss.switch = Some((now + delay, now + 2 * delay));
                None
            }
            cs::STORE if configures => {
                self.stored_number = self.lss.number.unwrap_or(self.stored_number);
                if let Some(rate) = self.lss.rate {
                    self.stored.set(0x2001, 0, i64::from(rate));
                }
                Some([0; 4])
            }
            cs::INQUIRE_VENDOR..=cs::INQUIRE_SERIAL if configures => {
                Some(own(command - cs::INQUIRE_VENDOR).to_le_bytes())
            }
            cs::INQUIRE_NUMBER if configures => Some([self.number, 0, 0, 0]),
            _ => None,
        };
        self.answer_lss(answer.map(|data| (command, data)), now, bus);
    }

    fn answer_lss(&self, answer: Option<(u8, [u8; 4])>, now: u64, bus: &mut CanBus) {
        let Some((command, [a, b, c, d])) = answer else {
            return;
        };
        let frame = CanFrame::new(SLAVE, &[command, a, b, c, d, 0, 0, 0]);
        bus.send(self.settings.id, frame, now);
    }

    /// A node without a number starts with the new one; others take theirs at the next reset.
    fn leave_configuration(&mut self, now: u64) {
        if self.number == UNNUMBERED && self.lss.number.is_some() {
            self.initialise(now + COMMUNICATION_BOOT_NS);
        }
    }

    /// Switches the bit rate when its time has come.
    pub(super) fn step_lss(&mut self, now: u64) {
        let Some((at, end)) = self.lss.switch else {
            return;
        };
        if at <= now {
            let rate = self.lss.rate.map_or(0, usize::from);
            self.bit_rate = epos::BIT_RATES.get(rate).copied().unwrap_or(self.bit_rate);
            self.lss.switch = Some((u64::MAX, end));
        }
        if end <= now {
            self.online = true;
            self.lss.switch = None;
        }
    }

    /// Takes the number that waits, in all objects that carry it.
    pub(super) fn take_number(&mut self) {
        let number = self.lss.number.take().unwrap_or(self.number);
        self.lss = Lss::default();
        self.set_number(number);
    }

    pub(super) fn set_number(&mut self, number: u8) {
        let before = i64::from(std::mem::replace(&mut self.number, number) & 0x7f);
        let number = i64::from(number & 0x7f);
        let renumber = |d: &mut Dictionary| {
            for (index, sub) in epos::NUMBERED {
                let value = d.get(index, sub);
                if value & 0x7f == before {
                    d.set(index, sub, value - before + number);
                }
            }
        };
        renumber(&mut self.d);
        renumber(&mut self.stored);
    }
}
