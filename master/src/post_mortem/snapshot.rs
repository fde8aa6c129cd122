//! Reads the SubDevices after a stop. Reads by station address, so that missing devices do not
//! shift the others. Searches a device without its address between those that have theirs. Never
//! writes. MAY BLOCK AND ALLOCATE; bounded in time.

use std::time::Duration;

use ecaxis_ecat::al_state::AlState;
use ecaxis_ecat::index::GroupIndex;
use ecaxis_ecat::registers;
use serde::Serialize;

use crate::acyclic::enumerate::StatusRegisters;
use crate::clock::{self, Nanos};
use crate::datagram::DatagramClient;
use crate::mailbox::{DatagramError, DeviceMailbox, MailboxTransport};
use crate::rt::exchange::ErrorCounters;

/// The timeout in ns for all devices together.
pub const TIMEOUT: Nanos = 500_000_000;
/// The timeout for one object of one device.
const MAILBOX_TIMEOUT: Duration = Duration::from_millis(200);
/// The number of consecutive lost frames after which reading ends.
const MAX_CONSECUTIVE_LOSSES: u32 = 2;
/// The number of attempts per frame.
const MAX_ATTEMPTS: u32 = 3;

const OP: u8 = AlState::Op.code();
const ERROR_COUNTERS_LEN: usize = 0x14;
const WATCHDOG_LEN: usize = 0x44;
const SYNC_LEN: usize = 0x24;

const ERROR_CODE: u16 = 0x603f;
const INTERPOLATION_TIME: u16 = 0x60c2;

/// The data of one SubDevice. `None`: not asked, or no answer.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct DeviceSnapshot {
    /// `true` if the device answered.
    pub answers: bool,
    /// `true` if a frame to the device returned unprocessed.
    pub absent: bool,
    /// `true` if the device did not answer at first, and answered later.
    pub came_back: bool,
    /// The device's station address; 0 after a power loss.
    pub station: Option<u16>,
    pub al_status: Option<u8>,
    pub al_code: Option<u16>,
    /// 0x0110.
    pub dl_status: Option<u16>,
    pub errors: Option<ErrorCounters>,
    pub watchdog: Option<WatchdogSnapshot>,
    /// 0x0502.
    pub eeprom: Option<u16>,
    pub sync: Option<SyncSnapshot>,
    /// 0x603F.
    pub error_code: Option<u16>,
    /// 0x60C2, nanoseconds.
    pub interpolation_ns: Option<u64>,
}

/// The state of the bus after a failure.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Witnessed {
    /// The snapshots of the SubDevices in segment order.
    pub looks: Vec<DeviceSnapshot>,
    /// The group that stopped while the machine continued.
    pub group: Option<GroupIndex>,
}

impl Witnessed {
    #[must_use]
    pub fn of_machine(looks: Vec<DeviceSnapshot>) -> Self {
        Self { looks, group: None }
    }
}

/// The watchdogs of a SubDevice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct WatchdogSnapshot {
    /// The process data watchdog time in ns; 0: off.
    pub time_ns: u64,
    /// 0x0440 bit 0.
    pub in_time: bool,
    /// 0x0442 and 0x0443; both counters stop at 255.
    pub expired: u8,
    pub pdi_expired: u8,
}

/// The DC cyclic unit of a SubDevice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct SyncSnapshot {
    /// 0x0981.
    pub activation: u8,
    /// The time from reading to the next SYNC0 in ns. Negative: it lies in the past and never
    /// occurs.
    pub next_ns: i64,
    /// 0x09A0, nanoseconds.
    pub cycle_ns: u32,
}

/// The objects to read from a drive through its mailbox.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ObjectSelection {
    pub error_code: bool,
    pub interpolation: bool,
}

/// The amount of data to read from good devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Depth {
    /// States and error counters only.
    Brief,
    /// Also watchdogs, EEPROM status and SYNC0.
    Whole,
}

/// Reads all devices that answer. `looks` and `stations` are in segment order. Skips devices that
/// have already answered.
pub async fn read_registers(
    wire: &DatagramClient,
    stations: &[u16],
    looks: &mut [DeviceSnapshot],
    depth: Depth,
) {
    let mut asker = SnapshotReader::new(wire);
    let addresses = asker.everybody(stations, looks).await;
    for (address, look) in addresses
        .iter()
        .zip(looks.iter_mut())
        .filter(|(_, l)| l.answers)
    {
        if let Some(bytes) = asker
            .read::<ERROR_COUNTERS_LEN>(*address, registers::RX_ERROR_COUNTERS)
            .await
        {
            look.errors = Some(counters(&bytes));
        }
    }
    // Devices with an error come first, while time remains.
    let mut rest: Vec<_> = addresses.iter().zip(looks).collect();
    rest.retain(|(_, look)| look.answers && look.watchdog.is_none());
    if depth == Depth::Brief {
        rest.retain(|(_, look)| look.al_status != Some(OP));
    }
    rest.sort_by_key(|(_, look)| look.al_status == Some(OP));
    for (address, look) in rest {
        asker.details(*address, look).await;
    }
}

/// Reads the devices that did not answer once more. Reads all devices if no frame returned before.
pub async fn retry_absent(wire: &DatagramClient, stations: &[u16], looks: &mut [DeviceSnapshot]) {
    if !looks.iter().any(|look| look.answers || look.absent) {
        return read_registers(wire, stations, looks, Depth::Whole).await;
    }
    let absent: Vec<bool> = looks.iter().map(|look| look.absent).collect();
    if absent.contains(&true) {
        SnapshotReader::new(wire).everybody(stations, looks).await;
    }
    for (look, absent) in looks.iter_mut().zip(absent) {
        look.came_back |= absent && look.answers;
    }
}

/// Reads objects of one drive.
pub async fn read_objects(
    mailbox: &DeviceMailbox,
    axis: u16,
    ask: ObjectSelection,
    look: &mut DeviceSnapshot,
) {
    let object = |index| ecaxis_esi::axis::object(index, axis);
    if ask.error_code
        && let Some(Ok(bytes)) =
            clock::timeout(MAILBOX_TIMEOUT, mailbox.upload(object(ERROR_CODE), 0)).await
        && let [low, high] = *bytes
    {
        look.error_code = Some(u16::from_le_bytes([low, high]));
    }
    if ask.interpolation
        && let Some(Ok(value)) = clock::timeout(
            MAILBOX_TIMEOUT,
            mailbox.upload(object(INTERPOLATION_TIME), 1),
        )
        .await
        && let Some(Ok(index)) =
            clock::timeout(MAILBOX_TIMEOUT, mailbox.upload(INTERPOLATION_TIME, 2)).await
        && let (&[value], &[index]) = (&*value, &*index)
    {
        look.interpolation_ns = interpolation(value, index as i8);
    }
}

/// Returns the interpolation time (0x60C2: value × 10^index s) in ns.
fn interpolation(value: u8, index: i8) -> Option<u64> {
    let exponent = u32::try_from(i32::from(index) + 9).ok()?;
    u64::from(value).checked_mul(10u64.checked_pow(exponent)?)
}

/// The result of one read.
enum ReadOutcome<const N: usize> {
    Answer([u8; N]),
    /// The frame returned unprocessed.
    NoResponse,
    /// No frame returned, or the time is over.
    Nothing,
}

/// The address by which a device is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Address {
    Station(u16),
    /// The position of a device that does not have its station address.
    Position(u16),
}

impl Address {
    fn station(self) -> Option<u16> {
        match self {
            Self::Station(station) => Some(station),
            Self::Position(_) => None,
        }
    }
}

/// Returns devices that lost their addresses, as an index into `expected` and a position. They lie
/// between devices that still have theirs. `found` holds the addresses by position.
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

struct SnapshotReader<'a> {
    wire: &'a DatagramClient,
    end: Nanos,
    /// The number of consecutive lost frames.
    lost: u32,
}

impl<'a> SnapshotReader<'a> {
    fn new(wire: &'a DatagramClient) -> Self {
        let end = clock::now().saturating_add(TIMEOUT);
        Self { wire, end, lost: 0 }
    }

    async fn ask<const N: usize>(&mut self, address: Address, register: u16) -> ReadOutcome<N> {
        let mut bytes = [0; N];
        for _ in 0..MAX_ATTEMPTS {
            if self.lost >= MAX_CONSECUTIVE_LOSSES || self.wire.now() >= self.end {
                return ReadOutcome::Nothing;
            }
            let asked = match address {
                Address::Station(station) => self.wire.read(station, register, &mut bytes).await,
                Address::Position(at) => self.wire.read_at(at, register, &mut bytes).await,
            };
            match asked {
                Ok(0) => {
                    self.lost = 0;
                    return ReadOutcome::NoResponse;
                }
                Ok(_) => {
                    self.lost = 0;
                    return ReadOutcome::Answer(bytes);
                }
                // ethercrab has already repeated each frame.
                Err(DatagramError::Timeout { .. }) => self.lost += 1,
                Err(_) => return ReadOutcome::Nothing,
            }
        }
        ReadOutcome::Nothing
    }

    async fn read<const N: usize>(&mut self, address: Address, register: u16) -> Option<[u8; N]> {
        match self.ask(address, register).await {
            ReadOutcome::Answer(bytes) => Some(bytes),
            ReadOutcome::NoResponse | ReadOutcome::Nothing => None,
        }
    }

    /// Reads the status of all devices that have not answered yet. Returns the address of each
    /// device.
    async fn everybody(&mut self, stations: &[u16], looks: &mut [DeviceSnapshot]) -> Vec<Address> {
        let mut addresses: Vec<_> = stations.iter().map(|at| Address::Station(*at)).collect();
        for (address, look) in addresses.iter().zip(looks.iter_mut()) {
            if !look.answers {
                self.status(*address, look).await;
                look.station = address.station().filter(|_| look.answers);
            }
        }
        if !looks.iter().any(|look| look.absent) {
            return addresses;
        }
        let mut found = Vec::with_capacity(stations.len());
        while let Ok(position) = u16::try_from(found.len())
            && found.len() < stations.len()
            && let Some(bytes) = self
                .read::<2>(Address::Position(position), registers::STATION_ADDRESS)
                .await
        {
            found.push(u16::from_le_bytes(bytes));
        }
        for (index, position) in realign(stations, &found) {
            if let (Some(address), Some(look)) = (addresses.get_mut(index), looks.get_mut(index))
                && look.absent
            {
                *address = Address::Position(position);
                self.status(*address, look).await;
                let station = found.get(usize::from(position));
                look.station = station.copied().filter(|_| look.answers);
            }
        }
        addresses
    }

    async fn status(&mut self, address: Address, look: &mut DeviceSnapshot) {
        let bytes = match self.ask(address, StatusRegisters::START).await {
            ReadOutcome::Answer(bytes) => bytes,
            ReadOutcome::NoResponse => {
                look.absent = true;
                return;
            }
            ReadOutcome::Nothing => return,
        };
        let status = StatusRegisters::parse(&bytes);
        (look.answers, look.absent) = (true, false);
        look.dl_status = Some(status.dl_status);
        look.al_status = Some(status.al_status);
        look.al_code = Some(status.al_code);
    }

    async fn details(&mut self, address: Address, look: &mut DeviceSnapshot) {
        let Some(bytes) = self
            .read::<WATCHDOG_LEN>(address, registers::WATCHDOG_DIVIDER)
            .await
        else {
            return;
        };
        let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        look.watchdog = Some(WatchdogSnapshot {
            // Divider plus two, in units of 40 ns.
            time_ns: 40 * (u64::from(word(0)) + 2) * u64::from(word(0x20)),
            in_time: bytes[0x40] & 1 != 0,
            expired: bytes[0x42],
            pdi_expired: bytes[0x43],
        });
        let status = self.read::<2>(address, registers::EEPROM_CONTROL).await;
        look.eeprom = status.map(u16::from_le_bytes);
        // The system time is read first: a pulse between both reads then never looks missed.
        let Some(system) = self.read::<8>(address, registers::DC_SYSTEM_TIME).await else {
            return;
        };
        let Some(sync) = self
            .read::<SYNC_LEN>(address, registers::DC_CYCLIC_CONTROL)
            .await
        else {
            return;
        };
        let [next @ .., c0, c1, c2, c3] = sync;
        let mut start = [0; 8];
        for (to, from) in start.iter_mut().zip(&next[0x10..]) {
            *to = *from;
        }
        let (start, system) = (u64::from_le_bytes(start), u64::from_le_bytes(system));
        // A 32-bit clock has no upper half.
        let next_ns = match (start >> 32, system >> 32) {
            (0, _) | (_, 0) => i64::from((start as u32).wrapping_sub(system as u32) as i32),
            _ => start.wrapping_sub(system) as i64,
        };
        look.sync = Some(SyncSnapshot {
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
    fn counters_reads_each_error_counter_from_its_address() {
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
    fn realign_finds_devices_without_an_address() {
        for (found, expected) in [
            (&[1, 2, 3, 4][..], &[][..]),
            (&[1, 3, 4], &[]),
            (&[1, 0, 3, 4], &[(1, 1)]),
            (&[1, 0, 4], &[(1, 1)]),
            (&[1, 0, 0, 4], &[(1, 1), (2, 2)]),
            (&[0, 0, 0, 0], &[(0, 0), (1, 1), (2, 2), (3, 3)]),
            // The second is gone, the last has restarted.
            (&[1, 3, 0], &[(3, 2)]),
            // One device more than expected.
            (&[1, 2, 0, 3, 4], &[]),
            (&[], &[]),
        ] {
            assert_eq!(realign(&[1, 2, 3, 4], found), expected, "{found:?}");
        }
    }

    #[test]
    fn interpolation_converts_value_and_index_to_ns() {
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
