//! Sercos drives: the mailbox service SoE (ETG.1000.6 §5.7), the IDNs, and the words of the process
//! data (IEC 61800-7-204).
//!
//! * `dictionary`: the IDNs of a drive
//! * `drive`: procedure command, configuration and diagnosis of a drive
//! * `words`: master control word and drive status word
//!
//! Motor, control loops and power stage are those of [`crate::drive`]. This module drives them by
//! S-0-0134 and S-0-0135 and shows their values as IDNs. It defines its own bits and codes, so that a
//! misread standard cannot cancel out between MainDevice and simulator.

mod dictionary;
mod drive;
mod words;

use ecaxis_esi::model::{Access, Device, Writable};

use crate::Nanos;
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};
use crate::device::mailbox::{Answer, Detail, MailboxCapacity};
use crate::drive::{Drive, Emergency, State};
use crate::esc::al::AlState;
use dictionary::{Dictionary, Idn};
use words::Words;

/// Operation and drive, elements, IDN or fragments left.
const HEADER: usize = 4;
const INCOMPLETE: u8 = 0x08;
const ERROR: u8 = 0x10;
/// The longest element that the drive accepts.
const MAX_WRITE: usize = 8192;
/// The time within which S-0-0099 clears an error, or has failed.
const RESET_NS: Nanos = 20_000_000;
/// Objects of the first drive; those of the next are as many indices later.
const STRIDE: u16 = 0x800;

mod operation {
    pub(super) const READ_REQUEST: u8 = 1;
    pub(super) const READ_RESPONSE: u8 = 2;
    pub(super) const WRITE_REQUEST: u8 = 3;
    pub(super) const WRITE_RESPONSE: u8 = 4;
    pub(super) const NOTIFICATION: u8 = 5;
    pub(super) const EMERGENCY: u8 = 6;
}

mod element {
    pub(super) const DATA_STATE: u8 = 0x01;
    pub(super) const NAME: u8 = 0x02;
    pub(super) const ATTRIBUTE: u8 = 0x04;
    pub(super) const UNIT: u8 = 0x08;
    pub(super) const MINIMUM: u8 = 0x10;
    pub(super) const MAXIMUM: u8 = 0x20;
    pub(super) const VALUE: u8 = 0x40;
    pub(super) const DEFAULT: u8 = 0x80;
}

/// The state of a procedure command (data state, bits 0 to 3).
mod state {
    pub(super) const CLEARED: u16 = 0;
    pub(super) const SET: u16 = 1;
    pub(super) const EXECUTED: u16 = 3;
    pub(super) const RUNNING: u16 = 7;
    pub(super) const FAILED: u16 = 0xf;
}

/// The values that an IDN has in the process data, and the object of the drive that has them.
const VALUES: [(u16, u16, u32, bool); 7] = [
    (36, 0x60ff, 32, true),
    (47, 0x607a, 32, true),
    (80, 0x6071, 16, true),
    (40, 0x606c, 32, false),
    (51, 0x6064, 32, false),
    (84, 0x6077, 16, false),
    (189, 0x60f4, 32, false),
];
const CONTROL_WORD: u16 = 134;
const STATUS_WORD: u16 = 135;

/// The Sercos side of a device.
#[derive(Debug, Clone)]
pub(crate) struct Sercos {
    drives: Vec<SercosDrive>,
    /// The fragments of a write request so far: drive, elements, data.
    request: Option<(u8, u8, Vec<u8>)>,
    /// Errors that requests get: drive, IDN, code.
    pub(crate) forced: Vec<(u8, u16, u16)>,
    notices: Vec<Vec<u8>>,
}

#[derive(Debug, Clone)]
struct SercosDrive {
    dictionary: Dictionary,
    words: Words,
    /// Slots of IDN and object, and whether the IDN is an output.
    values: Vec<(EntryHandle, EntryHandle, bool)>,
    control_word: EntryHandle,
    status_word: EntryHandle,
    controlword: EntryHandle,
    statusword: EntryHandle,
    mode: EntryHandle,
    error_code: EntryHandle,
    period: [EntryHandle; 2],
    /// S-0-0099: its data state and the local time at which it was set.
    reset: (u16, Nanos),
    reported: bool,
}

/// Returns the number of drives of a device with SoE alone.
fn drives(device: &Device) -> u8 {
    let pdos = device.rx_pdos.iter().chain(&device.tx_pdos);
    pdos.map(|pdo| (pdo.index >> 12 & 7) as u8 + 1)
        .max()
        .unwrap_or(0)
}

/// Adds the objects on which the drives work, before the drives are created.
pub(crate) fn prepare(store: &mut ObjectStore, device: &Device) {
    let access = Access {
        read: true,
        write: Writable::Always,
    };
    // A second drive has its MDT there.
    store.ensure(
        0x1018,
        1,
        "",
        32,
        access,
        &device.identity.vendor.to_le_bytes(),
    );
    for drive in 0..u16::from(drives(device)) {
        for (index, sub, bits, value) in [
            (0x6040, 0, 16, 0),
            (0x6060, 0, 8, 8_i64),
            // A quick stop decelerates and removes the torque; a halt decelerates and keeps it.
            (0x605a, 0, 16, 2),
            (0x605d, 0, 16, 1),
            // 0.001 rpm.
            (0x60a9, 0, 32, 0xfdb4_4700),
            (0x60c2, 1, 8, 2),
            (0x60c2, 2, 8, -3),
            (0x60f4, 0, 32, 0),
        ] {
            let slot = store.ensure(index + drive * STRIDE, sub, "", bits, access, &[]);
            store.set(slot, value);
        }
    }
}

impl Sercos {
    /// Returns the Sercos side of the drives, bound to their objects.
    pub(crate) fn new(
        store: &mut ObjectStore,
        device: &Device,
        counts_per_turn: impl Fn(usize) -> u32,
    ) -> Self {
        let access = Access {
            read: true,
            write: Writable::Always,
        };
        let drives = (0..drives(device)).map(|number| {
            let mut object = |index: u16, sub, bits| {
                let index = index + u16::from(number) * STRIDE;
                store.ensure(index, sub, "", bits, access, &[])
            };
            let controlword = object(0x6040, 0, 16);
            let statusword = object(0x6041, 0, 16);
            let mode = object(0x6060, 0, 8);
            let error_code = object(0x603f, 0, 16);
            let period = [1, 2].map(|sub| object(0x60c2, sub, 8));
            let values = VALUES.map(|(_, index, bits, _)| object(index, 0, bits));
            let mut idn = |idn: u16, bits| store.ensure(idn, number, "", bits, access, &[]);
            let values = VALUES.iter().zip(values).map(|(value, object)| {
                let (own, _, bits, output) = *value;
                (idn(own, bits), object, output)
            });
            let values = values.collect();
            SercosDrive {
                dictionary: dictionary::new(counts_per_turn(number.into())),
                words: Words::default(),
                values,
                control_word: idn(CONTROL_WORD, 16),
                status_word: idn(STATUS_WORD, 16),
                controlword,
                statusword,
                mode,
                error_code,
                period,
                reset: (state::CLEARED, 0),
                reported: true,
            }
        });
        Self {
            drives: drives.collect(),
            request: None,
            forced: Vec::new(),
            notices: Vec::new(),
        }
    }

    /// Drops a request in progress.
    pub(crate) fn reset(&mut self) {
        self.request = None;
    }

    /// Gives the drives the outputs that have arrived.
    pub(crate) fn take_outputs(&mut self, store: &mut ObjectStore, drives: &[Drive]) {
        for (own, drive) in self.drives.iter_mut().zip(drives) {
            for (idn, object, _) in own.values.iter().filter(|(.., output)| *output) {
                let value = store.get_signed(*idn);
                store.show(*object, value);
            }
            let word = store.get(own.control_word) as u16;
            let controlword = own.words.controlword(word, drive.state());
            store.show(own.controlword, i64::from(controlword));
        }
    }

    /// Shows the values of the drives as IDNs.
    pub(crate) fn show(&self, store: &mut ObjectStore, drives: &[Drive]) {
        for (own, drive) in self.drives.iter().zip(drives) {
            for (idn, object, _) in own.values.iter().filter(|(.., output)| !output) {
                let value = store.get_signed(*object);
                store.show(*idn, value);
            }
            let statusword = store.get(own.statusword) as u16;
            let change = matches!(own.reset.0, state::EXECUTED | state::FAILED);
            let word = own.words.status_word(drive.state(), statusword, change);
            store.show(own.status_word, i64::from(word));
        }
    }

    /// Advances procedure commands. Returns messages for the MainDevice.
    pub(crate) fn act(&mut self, drives: &mut [Drive], local: Nanos) -> Vec<Vec<u8>> {
        for (number, (own, drive)) in (0..).zip(self.drives.iter_mut().zip(drives)) {
            let (bits, since) = &mut own.reset;
            if *bits == state::RUNNING {
                let is_fault = matches!(drive.state(), State::Fault | State::FaultReactionActive);
                if !is_fault {
                    *bits = state::EXECUTED;
                } else if local.saturating_sub(*since) > RESET_NS {
                    *bits = state::FAILED;
                } else {
                    drive.reset_fault();
                }
                own.reported = *bits == state::RUNNING;
            }
            if !own.reported {
                own.reported = true;
                let head = [
                    operation::NOTIFICATION | number << 5,
                    element::DATA_STATE,
                    99,
                    0,
                ];
                self.notices
                    .push([&head[..], &own.reset.0.to_le_bytes()].concat());
            }
        }
        std::mem::take(&mut self.notices)
    }

    /// Returns the message that reports an emergency of a drive.
    pub(crate) fn emergency(drive: u8, emergency: &Emergency) -> Option<Vec<u8>> {
        // SoE reports no end of an error.
        if emergency.code == 0 {
            return None;
        }
        let head = [operation::EMERGENCY | drive << 5, element::VALUE, 0x86, 1];
        let [low, high] = emergency.code.to_le_bytes();
        let data = [low, high, emergency.register];
        Some([&head[..], &data, &emergency.data].concat())
    }

    /// Answers a request.
    pub(crate) fn request(
        &mut self,
        store: &mut ObjectStore,
        (state, local): (AlState, Nanos),
        message: &[u8],
        room: MailboxCapacity,
    ) -> Answer {
        let Some((&[first, elements, low, high], data)) = message.split_first_chunk() else {
            return Answer::Error(Detail::TooShort);
        };
        let (operation, drive) = (first & 7, first >> 5);
        let number = u16::from_le_bytes([low, high]);
        let incomplete = first & INCOMPLETE != 0;
        let response = match operation {
            operation::READ_REQUEST => operation::READ_RESPONSE,
            operation::WRITE_REQUEST => operation::WRITE_RESPONSE,
            _ => return Answer::Error(Detail::ServiceNotSupported),
        };
        let refuse = |code: u16| {
            let head = [response | ERROR | drive << 5, elements, low, high];
            Answer::One([&head[..], &code.to_le_bytes()].concat())
        };
        if operation == operation::WRITE_REQUEST {
            let same = |request: &(u8, u8, Vec<u8>)| (request.0, request.1) == (drive, elements);
            let mut request = self.request.take().filter(same);
            let whole = request.get_or_insert((drive, elements, Vec::new()));
            whole.2.extend_from_slice(data);
            if whole.2.len() > MAX_WRITE {
                return refuse(0x7003);
            }
            if incomplete {
                self.request = request;
                return Answer::None;
            }
            let whole = request.map(|(_, _, data)| data).unwrap_or_default();
            return match self.write(store, (state, local), drive, elements, number, &whole) {
                Ok(()) => Answer::One(vec![response | drive << 5, elements, low, high]),
                Err(code) => refuse(code),
            };
        }
        let data = match self.read(store, drive, elements, number) {
            Ok(data) => data,
            Err(code) => return refuse(code),
        };
        let room = room.send.saturating_sub(HEADER).max(1);
        let count = data.len().div_ceil(room).max(1);
        let parts = (0..count).map(|n| {
            let part = data.get(n * room..).unwrap_or_default();
            let part = part.get(..room).unwrap_or(part);
            let left = u16::try_from(count - 1 - n).unwrap_or(u16::MAX);
            let (flag, word) = match left {
                0 => (0, number),
                left => (INCOMPLETE, left),
            };
            let [low, high] = word.to_le_bytes();
            let head = [response | flag | drive << 5, elements, low, high];
            [&head[..], part].concat()
        });
        Answer::Parts(parts.collect())
    }

    /// Returns the elements of an IDN in the order of their bits.
    fn read(
        &mut self,
        store: &ObjectStore,
        drive: u8,
        elements: u8,
        number: u16,
    ) -> Result<Vec<u8>, u16> {
        self.check(drive, elements, number)?;
        let own = self.drives.get_mut(usize::from(drive)).ok_or(0x800a_u16)?;
        own.refresh(store);
        let idn = own.dictionary.get(&number).ok_or(0x1001_u16)?;
        let mut data = Vec::new();
        for bit in (0..8).map(|n| 1 << n).filter(|bit| elements & bit != 0) {
            match bit {
                element::DATA_STATE => {
                    let bits = if idn.is_command() { own.reset.0 } else { 0 };
                    data.extend(bits.to_le_bytes());
                }
                element::NAME => list(&mut data, idn.name.as_bytes(), idn.name.len()),
                element::ATTRIBUTE => data.extend(idn.attribute.to_le_bytes()),
                element::UNIT if idn.unit.is_empty() => return Err(0x4001),
                element::UNIT => list(&mut data, idn.unit.as_bytes(), idn.unit.len()),
                element::MINIMUM | element::MAXIMUM => {
                    let missing: u16 = if bit == element::MINIMUM {
                        0x5001
                    } else {
                        0x6001
                    };
                    let (low, high) = idn.range.ok_or(missing)?;
                    let value = if bit == element::MINIMUM { low } else { high };
                    let bytes = value.to_le_bytes();
                    data.extend(bytes.get(..idn.width()).unwrap_or_default());
                }
                element::DEFAULT if idn.is_command() => return Err(0x8001),
                _ => {
                    let value = if bit == element::VALUE {
                        &idn.value
                    } else {
                        &idn.default
                    };
                    match idn.is_list() {
                        true => list(&mut data, value, idn.max),
                        false => data.extend(value),
                    }
                }
            }
        }
        Ok(data)
    }

    fn check(&self, drive: u8, elements: u8, number: u16) -> Result<(), u16> {
        let of = |forced: &&(u8, u16, u16)| (forced.0, forced.1) == (drive, number);
        if let Some((.., code)) = self.forced.iter().find(of) {
            return Err(*code);
        }
        if usize::from(drive) >= self.drives.len() {
            return Err(0x800a);
        }
        if elements == 0 {
            return Err(0x800c);
        }
        Ok(())
    }

    fn write(
        &mut self,
        store: &mut ObjectStore,
        (state, local): (AlState, Nanos),
        drive: u8,
        elements: u8,
        number: u16,
        data: &[u8],
    ) -> Result<(), u16> {
        self.check(drive, elements, number)?;
        let own = self.drives.get_mut(usize::from(drive)).ok_or(0x800a_u16)?;
        let idn = own.dictionary.get(&number).ok_or(0x1001_u16)?;
        match elements {
            element::VALUE => {}
            element::DATA_STATE => return Err(0x1009),
            element::NAME => return Err(0x2004),
            element::ATTRIBUTE => return Err(0x3004),
            element::UNIT => return Err(0x4004),
            element::MINIMUM => return Err(0x5004),
            element::MAXIMUM => return Err(0x6004),
            element::DEFAULT => return Err(0x8004),
            _ => return Err(0x7008),
        }
        let protected = idn.attribute >> 28 & 7;
        let in_state = match state {
            AlState::Op => protected >> 2,
            AlState::SafeOp => protected >> 1,
            _ => protected,
        };
        match in_state & 1 {
            1 if protected == 7 => return Err(0x7004),
            1 => return Err(0x7005),
            _ => {}
        }
        if idn.locked {
            return Err(0x7009);
        }
        let mdt = own.dictionary.get(&24).map(|list| list.value.clone());
        let cyclic = number == CONTROL_WORD
            || state >= AlState::SafeOp
                && mdt.is_some_and(|mdt| mdt.chunks(2).any(|one| one == number.to_le_bytes()));
        if cyclic {
            return Err(0x700a);
        }
        let value = checked(idn, data)?;
        if idn.is_command() {
            return own.command(u16::from_le_bytes([value[0], value[1]]), local);
        }
        own.apply(store, drive, number, &value)?;
        if let Some(idn) = own.dictionary.get_mut(&number) {
            idn.value = value;
        }
        Ok(())
    }
}

/// Appends a list with its lengths.
fn list(to: &mut Vec<u8>, data: &[u8], max: usize) {
    let length = |n: usize| u16::try_from(n).unwrap_or(u16::MAX).to_le_bytes();
    to.extend(length(data.len()));
    to.extend(length(max.max(data.len())));
    to.extend_from_slice(data);
}

/// Returns the value without the lengths of a list, if its length and range are valid.
fn checked(idn: &Idn, data: &[u8]) -> Result<Vec<u8>, u16> {
    let width = idn.width();
    let value = if idn.is_list() {
        let Some((&[low, high, _, _], rest)) = data.split_first_chunk() else {
            return Err(0x7002);
        };
        let length = usize::from(u16::from_le_bytes([low, high]));
        match rest.len() {
            n if n < length => return Err(0x7002),
            n if n > length || length > idn.max => return Err(0x7003),
            _ if length % width != 0 => return Err(0x7008),
            _ => rest,
        }
    } else {
        match data.len() {
            n if n < width => return Err(0x7002),
            n if n > width => return Err(0x7003),
            _ => data,
        }
    };
    if let (Some((low, high)), false) = (idn.range, idn.is_list()) {
        let raw = value
            .iter()
            .rev()
            .fold(0_u64, |n, byte| n << 8 | u64::from(*byte));
        let unused = 64 - 8 * u32::try_from(width).unwrap_or(8);
        let number = match idn.is_signed() {
            true => (raw << unused).cast_signed() >> unused,
            false => i64::try_from(raw).unwrap_or(i64::MAX),
        };
        if number < low {
            return Err(0x7006);
        }
        if number > high {
            return Err(0x7007);
        }
    }
    Ok(value.to_vec())
}
