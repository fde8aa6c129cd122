//! A segment of CiA 402 drives in Op, limited to cyclic frames. It has no bring-up, states, mailbox
//! or EEPROM; the simulator covers those. Answering must take very little time.

use ecaxis_ecat::al_state::AlState;
use ecaxis_ecat::registers;
use ecaxis_master::clock::Nanos;
use ecaxis_sim::frame::{self, Command, Datagram, Kind, wire_time};

/// The process data of a drive in bytes per direction.
pub const DRIVE_BYTES: usize = 12;
/// The station address of the first drive, which is the reference clock.
pub const FIRST_STATION: u16 = 0x1001;

/// Set by the first SubDevice in the source address of a frame.
const LOCALLY_ADMINISTERED: u8 = 0x02;
const OP: u8 = AlState::Op.code();

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

/// A line of drives.
#[derive(Debug, Clone)]
pub struct BenchSegment {
    drives: Vec<Drive>,
    drift_ppm: i64,
}

impl BenchSegment {
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
        wire_time(frame) + self.drives.len() as u64 * NANOS_PER_DEVICE
    }

    /// Returns the system time of the reference clock.
    #[must_use]
    pub fn system_time(&self, now: Nanos) -> u64 {
        let drift = i128::from(now) * i128::from(self.drift_ppm) / 1_000_000;
        now.wrapping_add_signed(i64::try_from(drift).unwrap_or(0))
    }

    /// Answers an EtherCAT frame in place as it passes at `now`; others stay unchanged.
    pub fn answer(&mut self, frame: &mut [u8], now: Nanos) -> Kind {
        let kind = frame::kind(frame);
        if kind == Kind::EtherCat {
            frame[6] |= LOCALLY_ADMINISTERED;
            let mut next = frame::next(frame, None);
            while let Some(datagram) = next {
                let add = self.pass(frame, &datagram, now);
                datagram.add_wkc(frame, add);
                next = frame::next(frame, Some(&datagram));
            }
        }
        kind
    }

    /// Processes one datagram. Returns its working counter increment.
    fn pass(&mut self, frame: &mut [u8], datagram: &Datagram, now: Nanos) -> u16 {
        let (adp, ado) = (datagram.adp(frame), datagram.ado(frame));
        let logical = datagram.logical(frame);
        let devices = self.devices();
        let station = adp
            .checked_sub(FIRST_STATION)
            .filter(|device| *device < devices);
        let data = &mut frame[datagram.data.clone()];
        match datagram.command {
            Command::Fprd if station.is_some() => {
                read_register(ado, data);
                1
            }
            // The address counts the devices; the data of all are OR-ed.
            Command::Brd if devices > 0 => {
                read_register(ado, data);
                datagram.set_adp(frame, adp.wrapping_add(devices));
                devices
            }
            // Read from the reference clock, written to all others.
            Command::Frmw if station == Some(0) => {
                if ado == registers::DC_SYSTEM_TIME {
                    let time = self.system_time(now).to_le_bytes();
                    let len = data.len().min(time.len());
                    data[..len].copy_from_slice(&time[..len]);
                }
                devices
            }
            Command::Lrd => self.logical(true, false, logical, data),
            Command::Lwr => self.logical(false, true, logical, data),
            Command::Lrw => self.logical(true, true, logical, data),
            _ => 0,
        }
    }

    /// Processes LRD, LWR, LRW. Returns their working counter increment.
    fn logical(&mut self, reads: bool, writes: bool, start: u32, data: &mut [u8]) -> u16 {
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

/// Returns the AL status of a device in Op; all other registers read as zero.
fn read_register(ado: u16, data: &mut [u8]) {
    data.fill(0);
    if let (registers::AL_STATUS, Some(status)) = (ado, data.first_mut()) {
        *status = OP;
    }
}

#[cfg(test)]
#[path = "segment_tests.rs"]
mod tests;
