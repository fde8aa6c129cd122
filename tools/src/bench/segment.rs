//! A segment of CiA 402 drives in Op, limited to cyclic frames. It has no bring-up, states, mailbox
//! or EEPROM; the simulator covers those. Answering must take very little time.

use ecaxis_ecat::registers;
use ecaxis_master::clock::Nanos;
use ecaxis_master::link::pdu_loop::ETHERCAT;

/// The process data of a drive in bytes per direction.
pub const DRIVE_BYTES: usize = 12;
/// The station address of the first drive, which is the reference clock.
pub const FIRST_STATION: u16 = 0x1001;

const HEADERS: usize = 16;
const DATAGRAM_HEADER: usize = 10;
const WKC: usize = 2;
/// Set by the first SubDevice in the source address of a frame.
const LOCALLY_ADMINISTERED: u8 = 0x02;
const OP: u8 = 0x08;

/// Bytes of a frame on the wire that a socket does not see: preamble, FCS, gap.
const WIRE_OVERHEAD: u64 = 24;
const SHORTEST_FRAME: u64 = 60;
/// Time per byte in ns at 100 Mbit/s.
const NANOS_PER_BYTE: u64 = 80;
/// The forwarding delay of one SubDevice and its cable in ns, both directions.
pub const NANOS_PER_DEVICE: u64 = 1_000;

/// The CiA 402 power states of a drive without faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Power {
    #[default]
    SwitchOnDisabled,
    ReadyToSwitchOn,
    SwitchedOn,
    OperationEnabled,
    QuickStopActive,
}

impl Power {
    /// Returns the next state according to the CiA 402 Controlword command table.
    fn after(self, controlword: u16) -> Self {
        let quick_stop = controlword & 0x04 == 0;
        if controlword & 0x02 == 0 {
            return Self::SwitchOnDisabled;
        }
        if quick_stop {
            return match self {
                Self::OperationEnabled | Self::QuickStopActive => Self::QuickStopActive,
                _ => Self::SwitchOnDisabled,
            };
        }
        let (switch_on, enable) = (controlword & 0x01 != 0, controlword & 0x08 != 0);
        match (self, switch_on, enable) {
            (_, false, _) => Self::ReadyToSwitchOn,
            (Self::SwitchOnDisabled | Self::QuickStopActive, ..) => self,
            (_, true, false) | (Self::ReadyToSwitchOn, true, true) => Self::SwitchedOn,
            (Self::SwitchedOn | Self::OperationEnabled, true, true) => Self::OperationEnabled,
        }
    }

    fn statusword(self) -> u16 {
        match self {
            Self::SwitchOnDisabled => 0x0250,
            Self::ReadyToSwitchOn => 0x0231,
            Self::SwitchedOn => 0x0233,
            // Bit 12: the drive follows the target position.
            Self::OperationEnabled => 0x1237,
            Self::QuickStopActive => 0x0217,
        }
    }
}

/// A drive that reaches its target immediately. Outputs: Controlword, target position, mode;
/// inputs: Statusword, position, mode.
#[derive(Debug, Clone, Copy, Default)]
struct Drive {
    logical: u32,
    power: Power,
    position: i32,
    mode: u8,
}

impl Drive {
    fn inputs(&self) -> [u8; DRIVE_BYTES] {
        let mut inputs = [0; DRIVE_BYTES];
        inputs[0..2].copy_from_slice(&self.power.statusword().to_le_bytes());
        inputs[2..6].copy_from_slice(&self.position.to_le_bytes());
        inputs[6] = self.mode;
        inputs
    }

    fn take(&mut self, outputs: &[u8]) {
        if let [c0, c1, p0, p1, p2, p3, mode, ..] = *outputs {
            self.power = self.power.after(u16::from_le_bytes([c0, c1]));
            self.mode = mode;
            if self.power == Power::OperationEnabled {
                self.position = i32::from_le_bytes([p0, p1, p2, p3]);
            }
        }
    }
}

/// The result for a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seen {
    /// Answered in place.
    Answered,
    /// Inconsistent datagrams; unchanged.
    Malformed,
    /// Not EtherCAT.
    Foreign,
}

/// A line of drives.
#[derive(Debug, Clone)]
pub struct Segment {
    drives: Vec<Drive>,
    drift_ppm: i64,
}

impl Segment {
    /// Creates drives whose outputs and inputs share these logical addresses. Their clocks run
    /// `drift_ppm` faster than the computer's.
    #[must_use]
    pub fn new(logical: impl IntoIterator<Item = u32>, drift_ppm: i64) -> Self {
        let drives = logical.into_iter().map(|logical| Drive {
            logical,
            ..Drive::default()
        });
        Self {
            drives: drives.collect(),
            drift_ppm,
        }
    }

    #[must_use]
    pub fn devices(&self) -> u16 {
        u16::try_from(self.drives.len()).unwrap_or(u16::MAX)
    }

    /// Returns the time in ns from the first bit of a frame on the wire to its last bit back, at
    /// 100 Mbit/s.
    #[must_use]
    pub fn wire_ns(&self, frame: usize) -> Nanos {
        wire_ns(frame) + self.drives.len() as u64 * NANOS_PER_DEVICE
    }

    /// Returns the system time of the reference clock.
    #[must_use]
    pub fn system_time(&self, now: Nanos) -> u64 {
        let drift = i128::from(now) * i128::from(self.drift_ppm) / 1_000_000;
        now.wrapping_add_signed(i64::try_from(drift).unwrap_or(0))
    }

    /// Answers a frame in place as it passes at `now`.
    pub fn answer(&mut self, frame: &mut [u8], now: Nanos) -> Seen {
        if frame.get(12..14) != Some(&ETHERCAT[..]) {
            return Seen::Foreign;
        }
        if !well_formed(frame) {
            return Seen::Malformed;
        }
        frame[6] |= LOCALLY_ADMINISTERED;
        let mut at = HEADERS;
        loop {
            let len = length(frame, at);
            let end = at + DATAGRAM_HEADER + len;
            let more = frame[at + 7] & 0x80 != 0;
            self.pass(&mut frame[at..end + WKC], now);
            if !more {
                return Seen::Answered;
            }
            at = end + WKC;
        }
    }

    /// Processes one datagram.
    fn pass(&mut self, datagram: &mut [u8], now: Nanos) {
        let (header, rest) = datagram.split_at_mut(DATAGRAM_HEADER);
        let (data, wkc) = rest.split_at_mut(rest.len() - WKC);
        let adp = u16::from_le_bytes([header[2], header[3]]);
        let ado = u16::from_le_bytes([header[4], header[5]]);
        let devices = self.devices();
        let station = adp
            .checked_sub(FIRST_STATION)
            .filter(|device| *device < devices);
        let add = match header[0] {
            // FPRD
            4 if station.is_some() => {
                read_register(ado, data);
                1
            }
            // BRD: the address counts the devices; the data of all are OR-ed.
            7 => {
                header[2..4].copy_from_slice(&adp.wrapping_add(devices).to_le_bytes());
                read_register(ado, data);
                devices
            }
            // FRMW: read from the reference clock, written to all others.
            14 if station == Some(0) => {
                if ado == registers::DC_SYSTEM_TIME {
                    let time = self.system_time(now).to_le_bytes();
                    let len = data.len().min(time.len());
                    data[..len].copy_from_slice(&time[..len]);
                }
                devices
            }
            command @ 10..=12 => self.logical(command, u32::from(ado) << 16 | u32::from(adp), data),
            _ => 0,
        };
        let sum = u16::from_le_bytes([wkc[0], wkc[1]]).wrapping_add(add);
        wkc.copy_from_slice(&sum.to_le_bytes());
    }

    /// Processes LRD, LWR, LRW (10 to 12). Returns their working counter increment.
    fn logical(&mut self, command: u8, start: u32, data: &mut [u8]) -> u16 {
        let (reads, writes) = (command != 11, command != 10);
        let mut sum = 0;
        for drive in &mut self.drives {
            let at = drive.logical.checked_sub(start).map(|at| at as usize);
            let Some(mapped) = at.and_then(|at| data.get_mut(at..at.checked_add(DRIVE_BYTES)?))
            else {
                continue;
            };
            // Inputs are the values before this frame, as with a SyncManager's buffers.
            let inputs = drive.inputs();
            if writes {
                drive.take(mapped);
                sum += if reads { 2 } else { 1 };
            }
            if reads {
                mapped.copy_from_slice(&inputs);
                sum += 1;
            }
        }
        sum
    }
}

/// Returns the time of a frame on the wire in ns, including preamble and gap.
#[must_use]
pub fn wire_ns(frame: usize) -> Nanos {
    ((frame as u64).max(SHORTEST_FRAME) + WIRE_OVERHEAD) * NANOS_PER_BYTE
}

/// Returns the AL status of a device in Op; all other registers read as zero.
fn read_register(ado: u16, data: &mut [u8]) {
    data.fill(0);
    if let (registers::AL_STATUS, Some(status)) = (ado, data.first_mut()) {
        *status = OP;
    }
}

/// Returns the data length of the datagram at this offset.
fn length(frame: &[u8], at: usize) -> usize {
    usize::from(u16::from_le_bytes([frame[at + 6], frame[at + 7] & 0x07]))
}

/// True if all datagrams lie within the frame and the last one is marked as last.
fn well_formed(frame: &[u8]) -> bool {
    let Some(&[low, high]) = frame.get(14..HEADERS) else {
        return false;
    };
    let end = HEADERS + usize::from(u16::from_le_bytes([low, high & 0x07]));
    if high >> 4 != 1 || end > frame.len() {
        return false;
    }
    let mut at = HEADERS;
    loop {
        if at + DATAGRAM_HEADER > end {
            return false;
        }
        let next = at + DATAGRAM_HEADER + length(frame, at) + WKC;
        if next > end {
            return false;
        }
        if frame[at + 7] & 0x80 == 0 {
            return true;
        }
        at = next;
    }
}

#[cfg(test)]
#[path = "segment_tests.rs"]
mod tests;
