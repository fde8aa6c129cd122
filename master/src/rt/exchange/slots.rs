//! The datagrams of a cycle in its frames.

use super::super::image::{Access, DatagramPlan, ImagePlan};
use super::super::phase::ClockPlan;
use super::frame::{DatagramSlot, Frame, clear_wkc, push, write_header};
use super::poll_schedule::MAX_POLL_DATAGRAM;
use crate::link::MAX_FRAME;
use ecaxis_ecat::datagram::Command;
use ecaxis_ecat::index::{DeviceIndex, GroupIndex};
use ecaxis_ecat::registers;

#[derive(Debug, Clone, Copy)]
pub(super) struct ProcessDatagram {
    pub(super) slot: DatagramSlot,
    pub(super) access: Access,
    pub(super) group: GroupIndex,
    /// Offset in the image.
    pub(super) image: usize,
    pub(super) expected_wkc: u16,
    /// The counter while no device is in Op.
    pub(super) expected_wkc_before_op: u16,
    /// The range of its devices in [`Exchange`](super::Exchange)'s `order`: the first, and one past
    /// the last.
    pub(super) devices: (usize, usize),
}

/// The positions of a cycle's datagrams in its frames.
#[derive(Debug)]
pub(super) struct DatagramSlots {
    pub(super) clock: Option<DatagramSlot>,
    /// The offset of the reference clock (0x0920), if SYNC0 is aligned.
    pub(super) clock_offset: Option<DatagramSlot>,
    pub(super) process_data: Vec<ProcessDatagram>,
    pub(super) al_status: DatagramSlot,
    pub(super) diagnostic_at: usize,
}

impl DatagramSlots {
    /// Puts all datagrams except the diagnostic one into empty frames.
    #[allow(clippy::disallowed_methods, reason = "runs before the loop")]
    pub(super) fn fill(
        frames: &mut [Frame],
        plan: &ImagePlan,
        datagrams: &[DatagramPlan],
        order: &[DeviceIndex],
        clock: Option<&ClockPlan>,
    ) -> Self {
        let aligns = clock.is_some_and(|clock| clock.align);
        let clock = clock.map(|clock| {
            let address = u32::from(registers::DC_SYSTEM_TIME) << 16 | u32::from(clock.reference);
            push(&mut frames[0], 0, Command::FRMW, address, 8)
        });
        // Behind the time, which is thus distributed before it is corrected.
        let clock_offset = aligns.then(|| push(&mut frames[0], 0, Command::NOP, 0, 8));
        let offset = |device: &DeviceIndex| plan.regions[*device].map_or(0, |region| region.offset);
        let process_data = datagrams.iter().map(|datagram| {
            let first = order.partition_point(|device| offset(device) < datagram.offset);
            let behind = datagram.offset + datagram.len;
            let end = order.partition_point(|device| offset(device) < behind);
            let frame = datagram.frame;
            let command = match datagram.access {
                Access::Both => Command::LRW,
                Access::Inputs => Command::LRD,
                Access::Outputs => Command::LWR,
            };
            let (logical, len) = (datagram.logical, datagram.len);
            ProcessDatagram {
                slot: push(&mut frames[frame], frame, command, logical, len),
                access: datagram.access,
                group: datagram.group,
                image: datagram.offset,
                expected_wkc: datagram.expected_wkc,
                expected_wkc_before_op: datagram.expected_wkc - datagram.op_only_wkc,
                devices: (first, end),
            }
        });
        let process_data = process_data.collect();
        let al_status = push(
            &mut frames[0],
            0,
            Command::BRD,
            u32::from(registers::AL_STATUS) << 16,
            2,
        );
        let diagnostic_at = frames[0].bytes.len();
        debug_assert!(diagnostic_at + MAX_POLL_DATAGRAM <= MAX_FRAME);
        Self {
            clock,
            clock_offset,
            process_data,
            al_status,
            diagnostic_at,
        }
    }
}

/// Writes the datagram that sets the offset of the reference clock (0x0920). Without an offset, no
/// device processes it.
pub(super) fn write_clock_offset(
    frame: &mut [u8],
    slot: DatagramSlot,
    station: Option<u16>,
    offset: Option<u64>,
) {
    let (command, station, offset) = match station.zip(offset) {
        Some((station, offset)) => (Command::FPWR, station, offset),
        None => (Command::NOP, 0, 0),
    };
    let address = u32::from(registers::DC_SYSTEM_TIME_OFFSET) << 16 | u32::from(station);
    write_header(frame, slot.offset, command, address, slot.len);
    if let Some(data) = frame.get_mut(slot.data()) {
        data.copy_from_slice(&offset.to_le_bytes());
    }
    clear_wkc(frame, slot);
}
