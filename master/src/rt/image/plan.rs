//! The layout of the process image: the logical address, datagram and frame of each SubDevice.

use ecaxis_ecat::index::{DeviceIndex, GroupIndex, IndexVec};

use super::BitCopy;
use crate::rt::config::{ProcessDataCopy, RtConfig};

/// First logical address of the process image.
pub const LOGICAL_BASE: u32 = 0x0001_0000;

/// Bytes for process data in the first frame of a cycle: 1514 − 16 (headers) − 20 − 14 − 20. The
/// last three are the clock, AL status and diagnostic datagrams.
const FIRST_FRAME: usize = 1444;
/// Bytes for process data in every further frame.
const NEXT_FRAME: usize = 1498;
/// Bytes of a datagram's header and working counter.
const DATAGRAM: usize = 12;
/// Bytes of the datagram that corrects the reference clock.
const CORRECTION: usize = DATAGRAM + 8;

/// The process data of one SubDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProcessData {
    pub out_len: usize,
    pub in_len: usize,
    /// The group to whose working counters it contributes.
    pub group: GroupIndex,
    /// True if it supports LRW; otherwise it is accessed by its own LWR and LRD.
    pub lrw: bool,
    /// True if it has an FMMU for the status of its mailbox.
    pub mailbox: bool,
    pub op_only: OpOnly,
}

/// The directions of a SubDevice that are enabled in Op only (ETG.2000, `OpOnly`).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct OpOnly {
    pub outputs: bool,
    pub inputs: bool,
}

/// The position of one SubDevice's outputs and inputs. Both start at the same logical address, so
/// one byte of an LRW carries an output out and an input back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceRegion {
    pub logical: u32,
    /// The frame of the cycle that carries it; with LWR and LRD, the first of them.
    pub frame: usize,
    /// Offset in the image.
    pub offset: usize,
    pub out_len: usize,
    pub in_len: usize,
}

/// The command by which a datagram accesses the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// LRW: outputs out, inputs back.
    Both,
    /// LRD.
    Inputs,
    /// LWR.
    Outputs,
}

/// One datagram of process data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DatagramPlan {
    /// The frame of the cycle that carries it.
    pub frame: usize,
    /// The group whose SubDevices it addresses, and no others.
    pub group: GroupIndex,
    pub access: Access,
    pub logical: u32,
    /// Offset of its data in the image.
    pub offset: usize,
    pub len: usize,
    /// Sum over its SubDevices. In an LRW, inputs count 1 and outputs 2; otherwise each counts 1
    /// (ETG.1000.4).
    pub expected_wkc: u16,
    /// The part of `expected_wkc` that is missing while no SubDevice is in Op.
    pub op_only_wkc: u16,
}

/// The mapping of mailbox status: one byte each, the SyncManager's status register. It lies outside
/// the process data. There, a status that is always present would hide missing inputs from the
/// working counter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MailboxPlan {
    pub logical: u32,
    /// The devices in the order of their bytes.
    pub devices: Vec<DeviceIndex>,
}

impl MailboxPlan {
    /// Returns the logical address of a device's status.
    #[must_use]
    pub fn logical_of(&self, device: DeviceIndex) -> Option<u32> {
        let place = self.devices.iter().position(|&other| other == device)?;
        Some(self.address(place))
    }

    /// Returns the logical address of the status at `place`.
    #[must_use]
    pub fn address(&self, place: usize) -> u32 {
        let place = u32::try_from(place).unwrap_or(u32::MAX);
        self.logical.saturating_add(place)
    }
}

/// The whole image.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ImagePlan {
    /// `None` if a device has no process data.
    pub regions: IndexVec<DeviceIndex, Option<DeviceRegion>>,
    /// The group of each device.
    pub groups: IndexVec<DeviceIndex, GroupIndex>,
    pub datagrams: Vec<DatagramPlan>,
    /// The same image with separate datagrams for each device, so that each has its own working
    /// counter. Empty if the cycle is too short for their frames.
    pub separate: Vec<DatagramPlan>,
    /// `None` if no device has an FMMU for it.
    pub mailboxes: Option<MailboxPlan>,
    /// Inputs that are copied to outputs in every cycle, each with the device of the inputs.
    pub copies: Vec<(DeviceIndex, BitCopy)>,
    /// Outputs that have their initial value from the loss of their device to the reset of its
    /// group.
    pub output_locks: Vec<(DeviceIndex, BitCopy)>,
    /// Outputs that are copied to other outputs, after everything that writes outputs.
    pub repeats: Vec<BitCopy>,
    pub len: usize,
    /// The first frame corrects the reference clock.
    pub align: bool,
}

/// The process data of a device does not fit into one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{len} bytes of process data do not fit into one frame of {}", NEXT_FRAME - DATAGRAM)]
pub struct TooLarge {
    pub device: DeviceIndex,
    pub len: usize,
}

impl DeviceRegion {
    /// The region of a device without process data.
    pub const EMPTY: Self = Self {
        logical: LOGICAL_BASE,
        frame: 0,
        offset: 0,
        out_len: 0,
        in_len: 0,
    };
}

impl ImagePlan {
    /// Returns the number of frames per cycle; the first is always sent, even without process data.
    #[must_use]
    pub fn frames(&self) -> usize {
        frames(&self.datagrams)
    }

    /// Returns the longest time of a cycle's frames on the wire in ns.
    #[must_use]
    pub fn wire_ns(&self) -> u64 {
        wire_ns(&self.datagrams, self.align).max(wire_ns(&self.separate, self.align))
    }

    /// Returns the place of a copy in the image; `None` if a device has no process data there.
    fn bit_copy(&self, copy: &ProcessDataCopy) -> Option<BitCopy> {
        let place = |(device, bit): (DeviceIndex, usize)| {
            let region = self.regions.get(device)?.as_ref()?;
            let end = (bit + copy.bits).div_ceil(8);
            let inside = end <= region.in_len.max(region.out_len);
            inside.then_some(region.offset * 8 + bit)
        };
        Some(BitCopy {
            from: place(copy.from)?,
            to: place(copy.to)?,
            bits: copy.bits,
        })
    }
}

/// Returns the number of frames for these datagrams; the first is always sent, even without process
/// data.
#[must_use]
pub fn frames(datagrams: &[DatagramPlan]) -> usize {
    datagrams.last().map_or(0, |last| last.frame) + 1
}

/// Returns the time of a cycle's frames on the wire in ns, from the first bit to the last one:
/// 100 Mbit/s.
fn wire_ns(datagrams: &[DatagramPlan], align: bool) -> u64 {
    // The other content of the first frame. `FRAME` is headers, FCS, preamble and gap.
    const FIRST: usize = 54;
    const FRAME: usize = 16 + 4 + 20;
    let data: usize = datagrams.iter().map(|d| d.len + DATAGRAM).sum();
    let correction = usize::from(align) * CORRECTION;
    let bytes = FIRST + correction + frames(datagrams) * FRAME + data;
    80 * bytes as u64
}

/// Returns the image of a machine according to its settings.
#[allow(clippy::disallowed_methods, reason = "runs before the loop")]
pub fn of(config: &RtConfig) -> Result<ImagePlan, TooLarge> {
    let mut image = lay_out_both(&config.devices, config.align)?;
    // A frame takes about 1 µs through a device.
    let through = 1000 * config.devices.len() as u64;
    if wire_ns(&image.separate, config.align) + through > config.cycle_ns / 2 {
        image.separate.clear();
    }
    let placed = |copies: &[ProcessDataCopy]| {
        let copies = copies.iter();
        let copies = copies.filter_map(|copy| Some((copy.from.0, image.bit_copy(copy)?)));
        copies.collect::<Vec<_>>()
    };
    let (copies, locks) = (placed(&config.copies), placed(&config.output_locks));
    (image.copies, image.output_locks) = (copies, locks);
    let repeats = config.repeats.iter();
    image.repeats = repeats.filter_map(|copy| image.bit_copy(copy)).collect();
    Ok(image)
}

/// Returns the image of these devices without copies and corrections of the reference clock.
pub fn plan(devices: &[ProcessData]) -> Result<ImagePlan, TooLarge> {
    lay_out_both(devices, false)
}

/// Lays devices out group by group, so that each group has its own working counters. No device is
/// split over two frames. The position of a device does not depend on its access commands. With
/// `align`, the first frame has room for the correction of the reference clock.
#[allow(
    clippy::disallowed_methods,
    clippy::disallowed_macros,
    reason = "runs before the loop"
)]
fn lay_out_both(devices: &[ProcessData], align: bool) -> Result<ImagePlan, TooLarge> {
    let separate = lay_out(devices, false, align)?.datagrams;
    let image = lay_out(devices, true, align)?;
    Ok(ImagePlan { separate, ..image })
}

/// If `shared`, adjacent devices share a datagram.
#[allow(
    clippy::disallowed_methods,
    clippy::disallowed_macros,
    reason = "runs before the loop"
)]
fn lay_out(devices: &[ProcessData], shared: bool, align: bool) -> Result<ImagePlan, TooLarge> {
    let mut image = ImagePlan {
        align,
        regions: vec![None; devices.len()].into(),
        groups: devices.iter().map(|device| device.group).collect(),
        ..ImagePlan::default()
    };
    let mut order: Vec<_> = image.regions.indices().zip(devices).collect();
    order.sort_by_key(|(_, device)| device.group);
    let mut frames = FramePacker {
        last: 0,
        room: FIRST_FRAME - usize::from(align) * CORRECTION,
    };
    for (index, device) in order {
        let (out, inp) = (device.out_len, device.in_len);
        let len = out.max(inp);
        if len == 0 {
            continue;
        }
        if len + DATAGRAM > NEXT_FRAME {
            return Err(TooLarge { device: index, len });
        }
        let (reads, writes) = (u16::from(inp > 0), u16::from(out > 0));
        let (late_reads, late_writes) = (
            reads * u16::from(device.op_only.inputs),
            writes * u16::from(device.op_only.outputs),
        );
        let mut datagram = DatagramPlan {
            frame: 0,
            group: device.group,
            access: Access::Both,
            logical: LOGICAL_BASE.saturating_add(u32::try_from(image.len).unwrap_or(u32::MAX)),
            offset: image.len,
            len,
            expected_wkc: reads + 2 * writes,
            op_only_wkc: late_reads + 2 * late_writes,
        };
        let first = image.datagrams.len();
        let frame = match image.datagrams.last_mut() {
            Some(last)
                if shared
                    && device.lrw
                    && (last.access, last.group) == (Access::Both, device.group)
                    && len <= frames.room =>
            {
                last.len += len;
                last.expected_wkc += datagram.expected_wkc;
                last.op_only_wkc += datagram.op_only_wkc;
                frames.room -= len;
                last.frame
            }
            _ if device.lrw => {
                datagram.frame = frames.place(len);
                image.datagrams.push(datagram);
                datagram.frame
            }
            _ => {
                for (access, len, op_only_wkc) in [
                    (Access::Outputs, out, late_writes),
                    (Access::Inputs, inp, late_reads),
                ] {
                    if len > 0 {
                        image.datagrams.push(DatagramPlan {
                            frame: frames.place(len),
                            access,
                            len,
                            expected_wkc: 1,
                            op_only_wkc,
                            ..datagram
                        });
                    }
                }
                image.datagrams[first].frame
            }
        };
        image.regions[index] = Some(DeviceRegion {
            logical: datagram.logical,
            frame,
            offset: image.len,
            out_len: out,
            in_len: inp,
        });
        image.len += len;
    }
    let indices = image.regions.indices().zip(devices);
    let watched = indices.filter_map(|(index, device)| device.mailbox.then_some(index));
    let watched: Vec<_> = watched.collect();
    if !watched.is_empty() {
        image.mailboxes = Some(MailboxPlan {
            logical: LOGICAL_BASE.saturating_add(u32::try_from(image.len).unwrap_or(u32::MAX)),
            devices: watched,
        });
    }
    Ok(image)
}

/// The frame that is being filled.
struct FramePacker {
    last: usize,
    room: usize,
}

impl FramePacker {
    /// Reserves space for a new datagram and returns its frame.
    fn place(&mut self, len: usize) -> usize {
        if len + DATAGRAM > self.room {
            self.last += 1;
            self.room = NEXT_FRAME;
        }
        self.room -= len + DATAGRAM;
        self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn lrw(sizes: &[(usize, usize)]) -> Vec<ProcessData> {
        let each = sizes.iter().map(|&(out_len, in_len)| ProcessData {
            out_len,
            in_len,
            group: GroupIndex(0),
            lrw: true,
            mailbox: false,
            op_only: OpOnly::default(),
        });
        each.collect()
    }

    fn grouped(mut devices: Vec<ProcessData>, groups: &[usize]) -> Vec<ProcessData> {
        for (device, &group) in devices.iter_mut().zip(groups) {
            device.group = GroupIndex(group);
        }
        devices
    }

    #[test]
    fn working_counters_and_addresses_of_a_drive_an_input_and_an_output() {
        let image = plan(&lrw(&[(12, 14), (0, 1), (1, 0), (0, 0)])).expect("fits");
        assert_eq!(
            image.datagrams,
            [DatagramPlan {
                frame: 0,
                group: GroupIndex(0),
                access: Access::Both,
                logical: LOGICAL_BASE,
                offset: 0,
                len: 16,
                expected_wkc: 3 + 1 + 2,
                op_only_wkc: 0,
            }]
        );
        assert_eq!(image.regions[DeviceIndex(1)].map(|r| r.offset), Some(14));
        assert_eq!(
            image.regions[DeviceIndex(2)].map(|r| r.logical),
            Some(LOGICAL_BASE + 15)
        );
        assert_eq!(image.regions[DeviceIndex(3)], None);
    }

    #[test]
    fn a_hundred_axes_of_twelve_bytes_fit_into_one_frame() {
        let hundred = plan(&lrw(&[(12, 12); 100])).expect("fits");
        assert_eq!((hundred.datagrams.len(), hundred.frames()), (1, 1));
        let many = plan(&lrw(&[(12, 12); 300])).expect("fits");
        assert_eq!((many.datagrams.len(), many.frames()), (3, 3));
        assert_eq!(
            plan(&lrw(&[(1500, 0)])),
            Err(TooLarge {
                device: DeviceIndex(0),
                len: 1500
            })
        );
    }

    #[test]
    fn group_has_separate_datagrams() {
        let sizes = [(12, 13), (0, 1), (12, 13), (0, 0), (12, 13)];
        let image = plan(&grouped(lrw(&sizes), &[1, 0, 2, 1, 1])).expect("fits");
        let datagrams: Vec<_> = image
            .datagrams
            .iter()
            .map(|d| (d.frame, d.group.0, d.offset, d.len, d.expected_wkc))
            .collect();
        assert_eq!(
            datagrams,
            [(0, 0, 0, 1, 1), (0, 1, 1, 26, 6), (0, 2, 27, 13, 3)]
        );
        let offsets: Vec<_> = image.regions.iter().map(|r| r.map(|r| r.offset)).collect();
        assert_eq!(offsets, [Some(1), Some(0), Some(27), None, Some(14)]);
        assert_eq!(*image.groups, [1, 0, 2, 1, 1].map(GroupIndex));
    }

    /// ETG.1000.4, working counter: a disabled FMMU contributes neither 2 for outputs nor 1 for
    /// inputs. ETG.2000: `OpOnly` SyncManagers are disabled outside Op.
    #[test]
    fn op_only_directions_count_in_op_only() {
        let mut devices = lrw(&[(12, 13), (1, 1), (1, 1)]);
        devices[1].op_only.outputs = true;
        let counters = |devices: &[ProcessData]| {
            let image = plan(devices).expect("fits");
            let datagrams = image.datagrams.iter();
            let counters = datagrams.map(|d| (d.expected_wkc, d.op_only_wkc));
            counters.collect::<Vec<_>>()
        };
        assert_eq!(counters(&devices), [(9, 2)]);
        devices[1].lrw = false;
        assert_eq!(counters(&devices), [(3, 0), (1, 1), (1, 0), (3, 0)]);
    }

    #[test]
    fn device_without_lrw_uses_two_datagrams_at_the_same_position() {
        let mut devices = lrw(&[(12, 13), (4, 6), (0, 2), (12, 13)]);
        let places = |devices: &[ProcessData]| {
            let image = plan(devices).expect("fits");
            image
                .regions
                .iter()
                .map(|r| r.map(|r| r.offset))
                .collect::<Vec<_>>()
        };
        let before = places(&devices);
        (devices[1].lrw, devices[2].lrw) = (false, false);
        assert_eq!(places(&devices), before);
        let image = plan(&devices).expect("fits");
        let datagrams: Vec<_> = image
            .datagrams
            .iter()
            .map(|d| (d.access, d.offset, d.len, d.expected_wkc))
            .collect();
        assert_eq!(
            datagrams,
            [
                (Access::Both, 0, 13, 3),
                (Access::Outputs, 13, 4, 1),
                (Access::Inputs, 13, 6, 1),
                (Access::Inputs, 19, 2, 1),
                (Access::Both, 21, 13, 3),
            ]
        );
    }

    proptest! {
        /// Every byte of every device is in one datagram of its group per direction. No datagrams
        /// overlap, and every frame has enough space.
        #[test]
        fn plan_fits_any_devices_without_overlap(
            devices in proptest::collection::vec((0_usize..900, 0_usize..1486, 0_usize..4, any::<bool>(), any::<bool>()), 0..40),
        ) {
            let devices: Vec<ProcessData> = devices
                .into_iter()
                .map(|(out_len, in_len, group, lrw, mailbox)| ProcessData { out_len, in_len, group: GroupIndex(group), lrw, mailbox, op_only: OpOnly::default() })
                .collect();
            let image = plan(&devices).expect("none is too large");
            for frame in 0..image.frames() {
                let of_frame = image.datagrams.iter().filter(|d| d.frame == frame);
                let bytes: usize = of_frame.map(|d| d.len + DATAGRAM).sum();
                let room = if frame == 0 { FIRST_FRAME } else { NEXT_FRAME };
                prop_assert!(bytes <= room);
            }
            for datagram in &image.datagrams {
                prop_assert_eq!(datagram.logical, LOGICAL_BASE + datagram.offset as u32);
                prop_assert!(datagram.offset + datagram.len <= image.len);
            }
            let watched: Vec<_> = (0..devices.len()).filter(|&d| devices[d].mailbox).map(DeviceIndex).collect();
            prop_assert_eq!(image.mailboxes.as_ref().map_or(&[][..], |m| &m.devices), &watched[..]);
            for (place, &device) in watched.iter().enumerate() {
                let logical = image.mailboxes.as_ref().and_then(|m| m.logical_of(device));
                prop_assert_eq!(logical, Some(LOGICAL_BASE + (image.len + place) as u32));
            }
            let carried = |access: Access, group: GroupIndex, from: usize, to: usize| {
                let carries = image.datagrams.iter().filter(|d| {
                    (d.access == access || d.access == Access::Both)
                        && d.group == group && d.offset <= from && to <= d.offset + d.len
                });
                from == to || carries.count() == 1
            };
            let mut used = vec![false; image.len];
            for (region, device) in image.regions.iter().zip(&devices) {
                let len = device.out_len.max(device.in_len);
                prop_assert_eq!(region.is_some(), len > 0);
                let Some(region) = region else { continue };
                let (at, group) = (region.offset, device.group);
                prop_assert!(carried(Access::Outputs, group, at, at + device.out_len));
                prop_assert!(carried(Access::Inputs, group, at, at + device.in_len));
                for byte in &mut used[at..at + len] {
                    prop_assert!(!std::mem::replace(byte, true));
                }
            }
            let expected: u32 = devices
                .iter()
                .map(|d| u32::from(d.in_len > 0) + u32::from(d.out_len > 0) * if d.lrw { 2 } else { 1 })
                .sum();
            prop_assert_eq!(image.datagrams.iter().map(|d| u32::from(d.expected_wkc)).sum::<u32>(), expected);
        }
    }
}
