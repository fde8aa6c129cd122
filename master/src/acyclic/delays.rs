//! Propagation delays, measured by the receive times of the ports.

use ecaxis_ecat::registers;

use super::enumerate;
use super::topology::{PORT_ORDER, ParentPort, open_ports, parents, ring_end};
use crate::concurrent::try_join_all;
use crate::datagram::DatagramClient;
use crate::link::redundant::RingState;
use crate::report::{Cause, Error};

pub(crate) const STEP: &str = "measuring propagation delays";
/// The number of measurements for a mean: receive times have a resolution of 10 ns.
const LATCHES: u32 = 8;

/// A device whose delay is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MeasuredDevice {
    pub position: u16,
    /// DL status (0x0110).
    pub dl_status: u16,
    /// True if its controller latches receive times (0x0900).
    pub receive_times: bool,
}

/// Returns true if a controller with these features (0x0008) latches receive times.
#[must_use]
pub const fn has_receive_times(features: u16) -> bool {
    const DC: u16 = 1 << 2;
    features & DC != 0
}

/// Reads what [`measure`] needs to know of all devices, with their station addresses.
///
/// # Errors
/// A device that does not answer.
pub async fn devices(wire: &DatagramClient) -> Result<(Vec<u16>, Vec<MeasuredDevice>), Error> {
    let each = (0..enumerate::count(wire).await?).map(async |position| {
        let word = async |register| {
            let bytes = enumerate::at(wire, position, STEP, register).await?;
            Ok::<_, Error>(u16::from_le_bytes(bytes))
        };
        let device = MeasuredDevice {
            position,
            dl_status: word(registers::DL_STATUS).await?,
            receive_times: has_receive_times(word(registers::FEATURES).await?),
        };
        Ok::<_, Error>((word(registers::STATION_ADDRESS).await?, device))
    });
    let devices = try_join_all(each).await?;
    Ok(devices.into_iter().unzip())
}

/// Returns the one-way delays in ns from the first device with receive times; `None` for devices
/// without them. `devices` are all devices of the segment, in order. Latching receive times disturbs
/// another measurement only. A closed ring is open meanwhile. In a broken one, the delays of the line
/// behind the break count from the second interface.
///
/// # Errors
/// A device that does not answer.
pub async fn measure(
    wire: &DatagramClient,
    devices: &[MeasuredDevice],
) -> Result<Vec<Option<u32>>, Error> {
    match wire.ring() {
        Some(RingState::Closed | RingState::OneDirection) => {
            let end = ring_end(devices.iter().map(|device| device.dl_status));
            let Some(end) = end else {
                return Ok(vec![None; devices.len()]);
            };
            // A frame passes each port once in a closed ring, and a delay needs two times.
            let control = open_ring(wire, end).await?;
            let mut line = devices.to_vec();
            if let Some(last) = line.get_mut(usize::from(end.device)) {
                last.dl_status |= 1 << (8 + 2 * end.port);
            }
            let measured = Box::pin(measure_lines(wire, &line, line.len())).await;
            let status = enumerate::at(wire, end.device, STEP, registers::DL_STATUS).await;
            write_loops(wire, end, control).await?;
            let open = open_ports(u16::from_le_bytes(status?));
            if is_open(&open, end.port) {
                // The device has opened it again by itself: the measurement took too long.
                let late = Cause::Scan("the ring was not open long enough".to_owned());
                return Err(Error::from(late).with_action(STEP));
            }
            measured
        }
        Some(RingState::Broken { behind, .. }) => {
            measure_lines(wire, devices, usize::from(behind).min(devices.len())).await
        }
        Some(RingState::Silent) | None => measure_lines(wire, devices, devices.len()).await,
    }
}

/// Closes the port of the last device that leads to the second interface, for at most a second.
/// Returns the setting before.
async fn open_ring(wire: &DatagramClient, end: ParentPort) -> Result<[u8; 2], Error> {
    const TEMPORARY: u8 = 0x02;
    const CLOSED: u8 = 0x03;
    let control: [u8; 2] = enumerate::at(wire, end.device, STEP, registers::DL_CONTROL).await?;
    let [rule, loops] = control;
    let opened = [rule | TEMPORARY, loops | CLOSED << (2 * end.port)];
    write_loops(wire, end, opened).await?;
    Ok(control)
}

async fn write_loops(wire: &DatagramClient, end: ParentPort, to: [u8; 2]) -> Result<(), Error> {
    let written = wire.write_at(end.device, registers::DL_CONTROL, &to).await;
    match written {
        Ok(1) => Ok(()),
        answer => Err(enumerate::no_answer(end.device, STEP, answer)),
    }
}

/// Measures a line that a frame of the first interface passes, and one behind it that a frame of the
/// second interface passes.
async fn measure_lines(
    wire: &DatagramClient,
    devices: &[MeasuredDevice],
    first: usize,
) -> Result<Vec<Option<u32>>, Error> {
    let (line, other) = devices.split_at(first);
    let uplinks = parents(line.iter().map(|device| device.dl_status));
    let nodes = line.iter().zip(uplinks);
    let nodes: Vec<_> = nodes
        .map(|(device, uplink)| TreeNode {
            open: open_ports(device.dl_status),
            uplink,
        })
        .collect();
    let entries = entries(other);
    let mut sums: Vec<Option<i64>> = vec![None; devices.len()];
    for _ in 0..LATCHES {
        wire.write_all(registers::DC_RECEIVE_TIME, &[0; 4])
            .await
            .map_err(|error| Error::from(Cause::Datagram(error)).with_action(STEP))?;
        let times = devices.iter().map(async |device| {
            if !device.receive_times {
                return Ok::<_, Error>(None);
            }
            let (at, register) = (device.position, registers::DC_RECEIVE_TIME);
            let ports = receive_times(enumerate::at(wire, at, STEP, register).await?);
            Ok(Some(ports))
        });
        let times = try_join_all(times).await?;
        let processed = other.iter().map(async |device| {
            if !device.receive_times {
                return Ok::<_, Error>(None);
            }
            let (at, register) = (device.position, registers::DC_RECEIVE_TIME_UNIT);
            let bytes = enumerate::at(wire, at, STEP, register).await?;
            Ok(Some(u32::from_le_bytes(bytes)))
        });
        let processed = try_join_all(processed).await?;
        let (times, other_times) = times.split_at(first);
        let measured = delays(&nodes, times).into_iter().chain(delays_from_end(
            &entries,
            other_times,
            &processed,
        ));
        for (sum, delay) in sums.iter_mut().zip(measured) {
            if let Some(delay) = delay {
                *sum = Some(sum.unwrap_or(0) + delay);
            }
        }
    }
    let mean = |sum: i64| u32::try_from((sum / i64::from(LATCHES)).max(0)).unwrap_or(u32::MAX);
    Ok(sums.into_iter().map(|sum| sum.map(mean)).collect())
}

/// Returns the delays in a closed ring, from those of a ring that was broken behind `first` devices. The
/// cable at the break is taken to be as long as the others.
#[must_use]
pub fn joined(measured: &[Option<u32>], first: usize) -> Vec<Option<u32>> {
    let (line, other) = measured.split_at(first.min(measured.len()));
    let (Some(before), Some(after)) = (
        line.iter().rev().find_map(|delay| *delay),
        other.iter().find_map(|delay| *delay),
    ) else {
        let begin = other.iter().find_map(|delay| *delay).unwrap_or(0);
        let moved = other
            .iter()
            .map(|delay| delay.map(|delay| delay.saturating_sub(begin)));
        return line.iter().copied().chain(moved).collect();
    };
    let hops = |line: &[Option<u32>]| {
        let known: Vec<u32> = line.iter().flatten().copied().collect();
        known
            .windows(2)
            .map(|pair| pair[1].saturating_sub(pair[0]))
            .collect::<Vec<_>>()
    };
    let mut hops = [hops(line), hops(other)].concat();
    hops.sort_unstable();
    let hop = hops.get(hops.len() / 2).copied().unwrap_or(0);
    let begin = before.saturating_add(hop);
    let moved = other
        .iter()
        .map(|delay| delay.map(|delay| begin.saturating_add(delay.saturating_sub(after))));
    line.iter().copied().chain(moved).collect()
}

/// Returns the delays in a ring that is broken behind `first` devices, from those of a closed one. A
/// frame of the second interface passes all devices behind the break, and then each of them again.
#[must_use]
pub fn split(line: &[Option<u32>], first: usize) -> Vec<Option<u32>> {
    let (before, behind) = line.split_at(first.min(line.len()));
    let begin = behind.iter().find_map(|delay| *delay).unwrap_or(0);
    let end = behind.iter().rev().find_map(|delay| *delay).unwrap_or(0);
    let moved = behind.iter().map(|delay| {
        delay.map(|delay| {
            end.saturating_sub(begin)
                .saturating_add(delay.saturating_sub(begin))
        })
    });
    before.iter().copied().chain(moved).collect()
}

/// Returns the port at which a frame of the second interface enters each device of its line first;
/// `None` for devices on a branch.
fn entries(line: &[MeasuredDevice]) -> Vec<Option<u8>> {
    let status = line.iter().map(|device| device.dl_status);
    let mut entries = vec![None; line.len()];
    let parents = parents(status.clone());
    let mut next = ring_end(status);
    // The depth never exceeds the number of devices.
    while let Some(end) = next {
        let device = usize::from(end.device);
        match entries.get_mut(device) {
            Some(entry @ None) => *entry = Some(end.port),
            _ => break,
        }
        next = parents.get(device).copied().flatten();
    }
    entries
}

/// Returns the delays of the devices that a frame of the second interface passes: first towards the
/// break, then back through the processing units. It passes the device at the end twice, `longest`
/// apart, and each other device in between. `processed` are the receive times of the processing
/// units.
fn delays_from_end(
    entries: &[Option<u8>],
    times: &[Option<[u32; 4]>],
    processed: &[Option<u32>],
) -> Vec<Option<i64>> {
    let both = entries.iter().zip(times).zip(processed);
    let apart: Vec<Option<i64>> = both
        .map(|((entry, times), processed)| {
            let entered = time(times.as_ref()?, (*entry)?);
            // `as` keeps the bits, as in `between`.
            Some(i64::from((*processed)?.wrapping_sub(entered) as i32))
        })
        .collect();
    let longest = apart.iter().flatten().copied().max().unwrap_or(0);
    let delay = |apart: Option<i64>| Some(i64::midpoint(longest, apart?));
    apart.into_iter().map(delay).collect()
}

/// Parses 0x0900 to 0x090F: local times in ns at which a frame arrived at each port.
fn receive_times(bytes: [u8; 16]) -> [u32; 4] {
    let mut times = [0; 4];
    for (time, word) in times.iter_mut().zip(bytes.chunks_exact(4)) {
        *time = word
            .iter()
            .rev()
            .fold(0, |time, byte| time << 8 | u32::from(*byte));
    }
    times
}

/// A device of the tree.
#[derive(Debug, Clone, Copy)]
struct TreeNode {
    /// The ports that forward frames.
    open: [bool; 4],
    uplink: Option<ParentPort>,
}

fn is_open(ports: &[bool; 4], port: u8) -> bool {
    ports.get(usize::from(port)).copied().unwrap_or(false)
}

fn time(times: &[u32; 4], port: u8) -> u32 {
    times.get(usize::from(port)).copied().unwrap_or(0)
}

/// Returns the time in ns from one receive time to a later one of the same device; the clock has 32
/// bits.
fn between(times: &[u32; 4], from: u8, to: u8) -> i64 {
    // `as` keeps the bits: jitter can make the difference negative.
    i64::from(time(times, to).wrapping_sub(time(times, from)) as i32)
}

/// Returns the open port before `port` in frame order.
fn before(ports: &[bool; 4], port: u8) -> u8 {
    let earlier = PORT_ORDER.into_iter().take_while(|other| *other != port);
    let earlier = earlier.filter(|other| is_open(ports, *other));
    earlier.last().unwrap_or(0)
}

/// Returns the one-way delays in ns from the first device with a clock; `None` for devices without
/// receive times. `times` are the receive times of one frame by port.
///
/// The difference of a device's two receive times covers the branch between its ports. Minus the
/// time behind port 0 of the next device, it is the round-trip delay (ETG.1000.4, "propagation
/// delay measurement"). Devices without receive times count as cable.
fn delays(places: &[TreeNode], times: &[Option<[u32; 4]>]) -> Vec<Option<i64>> {
    let mut delays: Vec<Option<i64>> = Vec::with_capacity(places.len());
    for (place, own) in places.iter().zip(times) {
        let Some(own) = own else {
            delays.push(None);
            continue;
        };
        let delay = match clocked(place.uplink, places, times) {
            None => 0,
            Some((parent, their, uplink)) => {
                let earlier = before(&parent.open, uplink.port);
                let last = PORT_ORDER
                    .into_iter()
                    .rfind(|port| is_open(&place.open, *port));
                let behind = between(own, 0, last.unwrap_or(0));
                let way = (between(their, earlier, uplink.port) - behind) / 2;
                let theirs = delays.get(usize::from(uplink.device)).copied().flatten();
                theirs.unwrap_or(0) + between(their, 0, earlier) + way.max(0)
            }
        };
        delays.push(Some(delay));
    }
    delays
}

/// Returns the nearest device towards the MainDevice with receive times, and its port.
fn clocked<'a>(
    from: Option<ParentPort>,
    places: &'a [TreeNode],
    times: &'a [Option<[u32; 4]>],
) -> Option<(&'a TreeNode, &'a [u32; 4], ParentPort)> {
    let mut next = from;
    // The depth never exceeds the number of devices.
    for _ in places {
        let uplink = next?;
        let place = places.get(usize::from(uplink.device))?;
        if let Some(Some(times)) = times.get(usize::from(uplink.device)) {
            return Some((place, times, uplink));
        }
        next = place.uplink;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: u16 = 0x0a00;
    const END: u16 = 0x0200;

    /// Returns the tree of devices with these DL status values.
    fn places(dl_status: &[u16]) -> Vec<TreeNode> {
        let uplinks = parents(dl_status.iter().copied());
        let nodes = dl_status.iter().zip(uplinks);
        let node = |(status, uplink): (&u16, Option<ParentPort>)| TreeNode {
            open: open_ports(*status),
            uplink,
        };
        nodes.map(node).collect()
    }

    /// 100 ns per cable; each device's clock has another start value, and one wraps.
    #[test]
    fn delays_of_a_line_of_three() {
        let places = places(&[LINE, LINE, END]);
        let times = [
            Some([1000, 1400, 0, 0]),
            Some([u32::MAX - 50, 149, 0, 0]),
            Some([7, 0, 0, 0]),
        ];
        assert_eq!(delays(&places, &times), [Some(0), Some(100), Some(200)]);
    }

    #[test]
    fn delays_treat_a_device_without_clock_as_cable() {
        let places = places(&[LINE, LINE, END]);
        let times = [Some([0, 400, 0, 0]), None, Some([0; 4])];
        assert_eq!(delays(&places, &times), [Some(0), None, Some(200)]);
    }

    #[test]
    fn delays_of_the_second_branch_exclude_the_first() {
        let places = places(&[0x8a00, END, END]);
        // Round trip: 200 ns at port 3, 600 ns at port 1.
        let times = [Some([0, 800, 0, 200]), Some([0; 4]), Some([0; 4])];
        assert_eq!(delays(&places, &times), [Some(0), Some(100), Some(500)]);
    }

    #[test]
    fn receive_times_are_little_endian() {
        let mut bytes = [0; 16];
        bytes[4..8].copy_from_slice(&0x1234_5678_u32.to_le_bytes());
        assert_eq!(receive_times(bytes), [0, 0x1234_5678, 0, 0]);
    }
}
