//! Compares recorded and simulated answers: equal, or different for one of a few reasons.

use super::recording::{Datagram, FPRD};

/// Real clocks drift against the recording host's, and its time stamps jitter.
const CLOCK_TOLERANCE_NS: u64 = 100_000;
/// Cables and E-bus contacts.
const LOOP_TOLERANCE_NS: i64 = 50;
/// The deviation of a clock from the reference depends on both crystals.
const DIFFERENCE_TOLERANCE_NS: u64 = 1_000;

/// Status of SyncManager 1.
const SEND_MAILBOX: u16 = 0x080d;

/// A reason for which answers may differ.
pub struct Excuse {
    /// The name in docs/captures.md.
    pub name: &'static str,
    explains: fn(&Case) -> bool,
}

/// A datagram with different answers.
pub struct Case<'a> {
    pub recorded: &'a Datagram,
    pub ours: &'a Datagram,
    /// The recorded answers to later repetitions of the same request, without other traffic in
    /// between.
    pub later: &'a [Datagram],
}

pub const EXCUSES: &[Excuse] = &[
    Excuse {
        name: "at work",
        explains: polled,
    },
    Excuse {
        name: "clocks",
        explains: clocks,
    },
    Excuse {
        name: "behind the message",
        explains: behind_message,
    },
    Excuse {
        name: "opened",
        explains: opened,
    },
    Excuse {
        name: "reserved bytes",
        explains: reserved,
    },
    Excuse {
        name: "reserved bit",
        explains: eeprom_bit,
    },
    Excuse {
        name: "no link",
        explains: unlinked,
    },
];

/// Returns the first reason that covers all differences.
pub fn excuse(case: &Case) -> Option<usize> {
    EXCUSES.iter().position(|excuse| (excuse.explains)(case))
}

impl Case<'_> {
    fn only_data_differs(&self) -> bool {
        let rest = |d: &Datagram| Datagram {
            data: Vec::new(),
            ..d.clone()
        };
        rest(self.recorded) == rest(self.ours)
    }
}

/// Mailbox status: the recorded device gives the same answer to a later poll.
fn polled(case: &Case) -> bool {
    case.only_data_differs()
        && case.recorded.ado == SEND_MAILBOX
        && case.later.iter().any(|later| later.data == case.ours.data)
}

/// Fields of the clock registers: address, bytes.
const CLOCK_FIELDS: [(u16, usize); 5] = [
    (0x0900, 4),
    (0x0904, 4),
    (0x0910, 8),
    (0x0918, 8),
    (DIFFERENCE, 4),
];
const DIFFERENCE: u16 = 0x092c;

/// Receive times, system time and its difference.
fn clocks(case: &Case) -> bool {
    let mut explained = vec![false; case.recorded.data.len()];
    // The time between the ports of one device does not depend on the time of the latch.
    let mut loops = None;
    for (address, len) in CLOCK_FIELDS {
        let Some(at) = address.checked_sub(case.recorded.ado).map(usize::from) else {
            continue;
        };
        let value = |d: &Datagram| Some(number(address, d.data.get(at..at + len)?));
        let (Some(recorded), Some(ours)) = (value(case.recorded), value(case.ours)) else {
            continue;
        };
        let unused = 64 - 8 * u32::try_from(len).unwrap();
        let apart = (ours.wrapping_sub(recorded) << unused) >> unused;
        let tolerance = if address == DIFFERENCE {
            DIFFERENCE_TOLERANCE_NS
        } else {
            CLOCK_TOLERANCE_NS
        };
        explained[at..at + len].fill(apart.unsigned_abs() <= tolerance);
        if address < 0x0910 && apart != 0 {
            let (least, most) = loops.get_or_insert((apart, apart));
            (*least, *most) = (apart.min(*least), apart.max(*most));
        }
    }
    if loops.is_some_and(|(least, most)| most - least > LOOP_TOLERANCE_NS) {
        return false;
    }
    let differs = case.recorded.data.iter().zip(&case.ours.data);
    let mut differs = differs.zip(explained).filter(|((a, b), _)| a != b);
    case.only_data_differs() && differs.all(|(_, explained)| explained)
}

/// Returns a little-endian number; the difference register is a magnitude with a sign.
fn number(address: u16, bytes: &[u8]) -> i64 {
    let raw = bytes
        .iter()
        .rev()
        .fold(0, |value, byte| value << 8 | i64::from(*byte));
    if address == DIFFERENCE && raw & 0x8000_0000 != 0 {
        -(raw & 0x7fff_ffff)
    } else {
        raw
    }
}

/// A mailbox keeps older memory contents; only the message itself counts.
fn behind_message(case: &Case) -> bool {
    let [recorded, ours] = [case.recorded, case.ours].map(|d| d.data.as_slice());
    let &[low, high, ..] = recorded else {
        return false;
    };
    let end = 6 + usize::from(u16::from_le_bytes([low, high]));
    case.only_data_differs()
        && case.recorded.command == FPRD
        && case.recorded.ado >= 0x1000
        && recorded.get(..end).is_some()
        && recorded.get(..end) == ours.get(..end)
}

/// SyncManager 1: the firmware has already written the first byte of the next answer.
fn opened(case: &Case) -> bool {
    case.only_data_differs()
        && case.recorded.ado == SEND_MAILBOX
        && case.recorded.data[0] == 0x80
        && case.ours.data[0] == 0x02
        && case.recorded.data[1..] == case.ours.data[1..]
}

/// Answers to downloads: some firmware leaves the written data in the four reserved bytes.
fn reserved(case: &Case) -> bool {
    let cleared = |d: &Datagram| {
        let mut data = d.data.clone();
        let answer = data.get(5..9).is_some_and(|head| {
            let [kind, _, service, command] = [head[0] & 0x0f, head[1], head[2] >> 4, head[3]];
            (kind, service, command) == (3, 3, 0x60)
        });
        if let Some(reserved) = data.get_mut(12..16).filter(|_| answer) {
            reserved.fill(0);
        }
        Datagram { data, ..d.clone() }
    };
    let case = Case {
        recorded: &cleared(case.recorded),
        ours: &cleared(case.ours),
        later: &[],
    };
    case.recorded.data.get(8) == Some(&0x60)
        && (case.recorded == case.ours || behind_message(&case))
}

/// Bit 4 is set in newer ET1200 up to SafeOp.
fn eeprom_bit(case: &Case) -> bool {
    case.only_data_differs()
        && case.recorded.ado == 0x0502
        && case.recorded.data[0] ^ case.ours.data[0] == 0x10
        && case.recorded.data[1..] == case.ours.data[1..]
}

/// A port without a link shows the receive time of a frame before the capture.
fn unlinked(case: &Case) -> bool {
    case.only_data_differs() && case.recorded.ado == 0x0904 && case.ours.data == [0; 4]
}
