//! Asks the SubDevices after a stop. Reads only, by station address, so that nobody is taken for a neighbour when devices are
//! missing; one that has lost its address is looked for between those that have theirs. MAY BLOCK AND ALLOCATE; bounded in time.

use std::future::Future;
use std::pin::pin;
use std::task::Poll;

use serde::Serialize;

use crate::clock::{self, Nanos};
use crate::mailbox::{DeviceMailbox, Wire, WireError};
use crate::rt::exchange::ErrorCounters;
use crate::wire::Datagrams;

/// For all devices together.
pub const PATIENCE: Nanos = 500_000_000;
/// For one object of one device.
const MAILBOX_PATIENCE: Nanos = 200_000_000;
/// A wire from which so many frames in a row did not come back is not asked any further.
const SILENT: u32 = 2;
/// Lost frames are sent again.
const TRIES: u32 = 3;

const OP: u8 = 8;
const STATION: u16 = 0x0010;
/// DL status; AL status and AL status code follow at 0x0130 and 0x0134.
const STATUS: u16 = 0x0110;
const STATUS_LEN: usize = 0x0136 - 0x0110;
const ERROR_COUNTERS: u16 = 0x0300;
const ERROR_COUNTERS_LEN: usize = 0x14;
/// Divider; PDI watchdog at 0x0410, process data watchdog at 0x0420, its status at 0x0440, expirations at 0x0442 and 0x0443.
const WATCHDOG: u16 = 0x0400;
const WATCHDOG_LEN: usize = 0x44;
const EEPROM_STATUS: u16 = 0x0502;
const SYSTEM_TIME: u16 = 0x0910;
/// Activation of the cyclic unit at 0x0981, next SYNC0 at 0x0990, its cycle at 0x09A0.
const SYNC: u16 = 0x0980;
const SYNC_LEN: usize = 0x24;

const ERROR_CODE: u16 = 0x603f;
const INTERPOLATION_TIME: u16 = 0x60c2;

/// What one SubDevice told. `None`: it was not asked, or did not answer.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Look {
    /// It answered.
    pub answers: bool,
    /// A frame to it came back that nobody had touched.
    pub absent: bool,
    /// It did not answer at first, and does now.
    pub came_back: bool,
    /// The station address that it has: 0 after a loss of power.
    pub station: Option<u16>,
    pub al_status: Option<u8>,
    pub al_code: Option<u16>,
    /// 0x0110.
    pub dl_status: Option<u16>,
    pub errors: Option<ErrorCounters>,
    pub watchdog: Option<WatchdogLook>,
    /// 0x0502.
    pub eeprom: Option<u16>,
    pub sync: Option<SyncLook>,
    /// 0x603F.
    pub error_code: Option<u16>,
    /// 0x60C2, nanoseconds.
    pub interpolation_ns: Option<u64>,
}

/// What was seen of the bus when something failed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Witnessed {
    /// What the SubDevices told, in the order of the segment.
    pub looks: Vec<Look>,
    /// The group that stopped while the machine went on.
    pub group: Option<usize>,
}

impl Witnessed {
    #[must_use]
    pub fn of_machine(looks: Vec<Look>) -> Self {
        Self { looks, group: None }
    }
}

/// The watchdogs of a SubDevice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct WatchdogLook {
    /// Of the process data, nanoseconds; 0: off.
    pub time_ns: u64,
    /// 0x0440 bit 0.
    pub in_time: bool,
    /// 0x0442 and 0x0443; both stand still at 255.
    pub expired: u8,
    pub pdi_expired: u8,
}

/// The cyclic unit of a SubDevice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct SyncLook {
    /// 0x0981.
    pub activation: u8,
    /// SYNC0 comes so much later than the device was asked, nanoseconds; negative: it lies in the past, and never comes.
    pub next_ns: i64,
    /// 0x09A0, nanoseconds.
    pub cycle_ns: u32,
}

/// What is to be asked of a drive through its mailbox.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Ask {
    pub error_code: bool,
    pub interpolation: bool,
}

/// How far devices that are well are asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Depth {
    /// States and error counters.
    Brief,
    /// Watchdogs, EEPROM and SYNC0, too.
    Whole,
}

/// Everybody who answers, `looks` and `stations` in the order of the segment; those that have answered before are not asked
/// again.
pub async fn at_registers(wire: &Datagrams, stations: &[u16], looks: &mut [Look], depth: Depth) {
    let mut asker = Asker::new(wire);
    let places = asker.everybody(stations, looks).await;
    for (place, look) in places
        .iter()
        .zip(looks.iter_mut())
        .filter(|(_, l)| l.answers)
    {
        if let Some(bytes) = asker
            .read::<ERROR_COUNTERS_LEN>(*place, ERROR_COUNTERS)
            .await
        {
            look.errors = Some(counters(&bytes));
        }
    }
    // Those with something to tell first, while there is time.
    let mut rest: Vec<_> = places.iter().zip(looks).collect();
    rest.retain(|(_, look)| look.answers && look.watchdog.is_none());
    if depth == Depth::Brief {
        rest.retain(|(_, look)| look.al_status != Some(OP));
    }
    rest.sort_by_key(|(_, look)| look.al_status == Some(OP));
    for (place, look) in rest {
        asker.details(*place, look).await;
    }
}

/// Those that did not answer, once more. Where no frame came back before, everybody.
pub async fn again(wire: &Datagrams, stations: &[u16], looks: &mut [Look]) {
    if !looks.iter().any(|look| look.answers || look.absent) {
        return at_registers(wire, stations, looks, Depth::Whole).await;
    }
    let absent: Vec<bool> = looks.iter().map(|look| look.absent).collect();
    if absent.contains(&true) {
        Asker::new(wire).everybody(stations, looks).await;
    }
    for (look, absent) in looks.iter_mut().zip(absent) {
        look.came_back |= absent && look.answers;
    }
}

/// Objects of one drive.
pub async fn at_objects(mailbox: &DeviceMailbox, ask: Ask, look: &mut Look) {
    if ask.error_code
        && let Some(Ok(bytes)) = within(mailbox.upload(ERROR_CODE, 0)).await
        && let [low, high] = *bytes
    {
        look.error_code = Some(u16::from_le_bytes([low, high]));
    }
    if ask.interpolation
        && let Some(Ok(value)) = within(mailbox.upload(INTERPOLATION_TIME, 1)).await
        && let Some(Ok(index)) = within(mailbox.upload(INTERPOLATION_TIME, 2)).await
        && let (&[value], &[index]) = (&*value, &*index)
    {
        look.interpolation_ns = interpolation(value, index as i8);
    }
}

/// 0x60C2: value × 10^index seconds, in nanoseconds.
fn interpolation(value: u8, index: i8) -> Option<u64> {
    let exponent = u32::try_from(i32::from(index) + 9).ok()?;
    u64::from(value).checked_mul(10u64.checked_pow(exponent)?)
}

/// `None` where it takes too long.
async fn within<F: Future>(future: F) -> Option<F::Output> {
    let end = clock::now().saturating_add(MAILBOX_PATIENCE);
    let mut future = pin!(future);
    std::future::poll_fn(|context| match future.as_mut().poll(context) {
        Poll::Ready(output) => Poll::Ready(Some(output)),
        Poll::Pending if clock::now() >= end => Poll::Ready(None),
        Poll::Pending => Poll::Pending,
    })
    .await
}

/// What comes of a question.
enum Heard<const N: usize> {
    Answer([u8; N]),
    /// The frame came back untouched.
    Nobody,
    /// No frame came back, or time is over.
    Nothing,
}

/// How a device is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Station(u16),
    /// It does not have the address that it was given.
    Position(u16),
}

impl Place {
    fn station(self) -> Option<u16> {
        match self {
            Self::Station(station) => Some(station),
            Self::Position(_) => None,
        }
    }
}

/// Devices that have lost their addresses, as an index into `expected` and a position: in the order of the segment, between
/// those that still have theirs. `found` are the addresses at the positions.
fn realign(expected: &[u16], found: &[u16]) -> Vec<(usize, u16)> {
    let known = |station: &u16| expected.iter().position(|other| other == station);
    let mut lost = Vec::new();
    let mut next = 0;
    for (position, station) in (0u16..).zip(found) {
        if let Some(index) = known(station) {
            next = next.max(index + 1);
            continue;
        }
        let behind = found.iter().skip(usize::from(position)).filter_map(known);
        let end = behind.min().unwrap_or(expected.len());
        let mut missing = next..end;
        if let Some(index) = missing.find(|index| !found.contains(&expected[*index])) {
            lost.push((index, position));
            next = index + 1;
        }
    }
    lost
}

struct Asker<'a> {
    wire: &'a Datagrams,
    end: Nanos,
    /// Frames in a row that did not come back.
    lost: u32,
}

impl<'a> Asker<'a> {
    fn new(wire: &'a Datagrams) -> Self {
        let end = clock::now().saturating_add(PATIENCE);
        Self { wire, end, lost: 0 }
    }

    async fn ask<const N: usize>(&mut self, place: Place, register: u16) -> Heard<N> {
        let mut bytes = [0; N];
        for _ in 0..TRIES {
            if self.lost >= SILENT || self.wire.now() >= self.end {
                return Heard::Nothing;
            }
            let asked = match place {
                Place::Station(station) => self.wire.read(station, register, &mut bytes).await,
                Place::Position(at) => self.wire.read_at(at, register, &mut bytes).await,
            };
            match asked {
                Ok(0) => {
                    self.lost = 0;
                    return Heard::Nobody;
                }
                Ok(_) => {
                    self.lost = 0;
                    return Heard::Answer(bytes);
                }
                // Each has been repeated by ethercrab already.
                Err(WireError::Timeout { .. }) => self.lost += 1,
                Err(_) => return Heard::Nothing,
            }
        }
        Heard::Nothing
    }

    async fn read<const N: usize>(&mut self, place: Place, register: u16) -> Option<[u8; N]> {
        match self.ask(place, register).await {
            Heard::Answer(bytes) => Some(bytes),
            Heard::Nobody | Heard::Nothing => None,
        }
    }

    /// Status of those that have not answered yet; returns how each is reached.
    async fn everybody(&mut self, stations: &[u16], looks: &mut [Look]) -> Vec<Place> {
        let mut places: Vec<_> = stations.iter().map(|at| Place::Station(*at)).collect();
        for (place, look) in places.iter().zip(looks.iter_mut()) {
            if !look.answers {
                self.status(*place, look).await;
                look.station = place.station().filter(|_| look.answers);
            }
        }
        if !looks.iter().any(|look| look.absent) {
            return places;
        }
        let mut found = Vec::with_capacity(stations.len());
        while let Ok(position) = u16::try_from(found.len())
            && found.len() < stations.len()
            && let Some(bytes) = self.read::<2>(Place::Position(position), STATION).await
        {
            found.push(u16::from_le_bytes(bytes));
        }
        for (index, position) in realign(stations, &found) {
            if let (Some(place), Some(look)) = (places.get_mut(index), looks.get_mut(index))
                && look.absent
            {
                *place = Place::Position(position);
                self.status(*place, look).await;
                let station = found.get(usize::from(position));
                look.station = station.copied().filter(|_| look.answers);
            }
        }
        places
    }

    async fn status(&mut self, place: Place, look: &mut Look) {
        let bytes = match self.ask::<STATUS_LEN>(place, STATUS).await {
            Heard::Answer(bytes) => bytes,
            Heard::Nobody => {
                look.absent = true;
                return;
            }
            Heard::Nothing => return,
        };
        let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        (look.answers, look.absent) = (true, false);
        look.dl_status = Some(word(0));
        look.al_status = Some(bytes[0x20]);
        look.al_code = Some(word(0x24));
    }

    async fn details(&mut self, place: Place, look: &mut Look) {
        let Some(bytes) = self.read::<WATCHDOG_LEN>(place, WATCHDOG).await else {
            return;
        };
        let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        look.watchdog = Some(WatchdogLook {
            // Divider plus two, in units of 40 ns.
            time_ns: 40 * (u64::from(word(0)) + 2) * u64::from(word(0x20)),
            in_time: bytes[0x40] & 1 != 0,
            expired: bytes[0x42],
            pdi_expired: bytes[0x43],
        });
        let status = self.read::<2>(place, EEPROM_STATUS).await;
        look.eeprom = status.map(u16::from_le_bytes);
        // In this order: a pulse that was still to come then may have come since, but not the other way round.
        let Some(system) = self.read::<8>(place, SYSTEM_TIME).await else {
            return;
        };
        let Some(sync) = self.read::<SYNC_LEN>(place, SYNC).await else {
            return;
        };
        let [next @ .., c0, c1, c2, c3] = sync;
        let mut start = [0; 8];
        for (to, from) in start.iter_mut().zip(&next[0x10..]) {
            *to = *from;
        }
        let (start, system) = (u64::from_le_bytes(start), u64::from_le_bytes(system));
        // A clock of 32 bits has no upper half.
        let next_ns = match (start >> 32, system >> 32) {
            (0, _) | (_, 0) => i64::from((start as u32).wrapping_sub(system as u32) as i32),
            _ => start.wrapping_sub(system) as i64,
        };
        look.sync = Some(SyncLook {
            activation: sync[1],
            next_ns,
            cycle_ns: u32::from_le_bytes([c0, c1, c2, c3]),
        });
    }
}

fn counters(bytes: &[u8; ERROR_COUNTERS_LEN]) -> ErrorCounters {
    let every_other = |at: usize| std::array::from_fn(|port| bytes[at + 2 * port]);
    let each = |at: usize| std::array::from_fn(|port| bytes[at + port]);
    ErrorCounters {
        invalid_frames: every_other(0),
        rx_errors: every_other(1),
        forwarded: each(8),
        processing: bytes[0x0c],
        pdi: bytes[0x0d],
        lost_links: each(0x10),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_each_counter_lies() {
        // ETG.1000.4, table 40 and following: 0x0300 invalid frame, 0x0301 RX error of port 0, …
        let bytes = std::array::from_fn(|n| n as u8);
        let found = counters(&bytes);
        assert_eq!(found.invalid_frames, [0, 2, 4, 6]);
        assert_eq!(found.rx_errors, [1, 3, 5, 7]);
        assert_eq!(found.forwarded, [8, 9, 10, 11]);
        assert_eq!((found.processing, found.pdi), (12, 13));
        assert_eq!(found.lost_links, [16, 17, 18, 19]);
    }

    #[test]
    fn who_has_lost_its_address() {
        for (found, expected) in [
            (&[1, 2, 3, 4][..], &[][..]),
            (&[1, 3, 4], &[]),
            (&[1, 0, 3, 4], &[(1, 1)]),
            (&[1, 0, 4], &[(1, 1)]),
            (&[1, 0, 0, 4], &[(1, 1), (2, 2)]),
            (&[0, 0, 0, 0], &[(0, 0), (1, 1), (2, 2), (3, 3)]),
            // The second is gone, the last has restarted.
            (&[1, 3, 0], &[(3, 2)]),
            // A device more than there should be.
            (&[1, 2, 0, 3, 4], &[]),
            (&[], &[]),
        ] {
            assert_eq!(realign(&[1, 2, 3, 4], found), expected, "{found:?}");
        }
    }

    #[test]
    fn interpolation_times() {
        for (value, index, ns) in [
            (1, -3, Some(1_000_000)),
            (25, -5, Some(250_000)),
            (0, -3, Some(0)),
            (1, 0, Some(1_000_000_000)),
            (1, -10, None),
            (255, 127, None),
        ] {
            assert_eq!(interpolation(value, index), ns, "{value}, {index}");
        }
    }
}
