//! Propagation delays, measured by the receive times of the ports.

use ecaxis_ecat::registers;

use super::enumerate;
use super::topology::{PORT_ORDER, ParentPort, open_ports, parents};
use crate::datagram::DatagramClient;
use crate::report::{Cause, Error};

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

/// Returns the one-way delays in ns from the first device with receive times; `None` for devices
/// without them. `devices` are all devices of the segment, in order. Latching receive times disturbs
/// another measurement only.
///
/// # Errors
/// A device that does not answer.
pub async fn measure(
    wire: &DatagramClient,
    devices: &[MeasuredDevice],
) -> Result<Vec<Option<u32>>, Error> {
    const STEP: &str = "measuring propagation delays";
    let uplinks = parents(devices.iter().map(|device| device.dl_status));
    let nodes = devices.iter().zip(uplinks);
    let nodes: Vec<_> = nodes
        .map(|(device, uplink)| TreeNode {
            open: open_ports(device.dl_status),
            uplink,
        })
        .collect();
    let mut sums: Vec<Option<i64>> = vec![None; devices.len()];
    for _ in 0..LATCHES {
        wire.write_all(registers::DC_RECEIVE_TIME, &[0; 4])
            .await
            .map_err(|error| Error::from(Cause::Datagram(error)).with_action(STEP))?;
        let mut times = Vec::with_capacity(devices.len());
        for device in devices {
            times.push(if device.receive_times {
                let register = registers::DC_RECEIVE_TIME;
                let bytes = enumerate::at(wire, device.position, STEP, register).await?;
                Some(receive_times(bytes))
            } else {
                None
            });
        }
        for (sum, delay) in sums.iter_mut().zip(delays(&nodes, &times)) {
            if let Some(delay) = delay {
                *sum = Some(sum.unwrap_or(0) + delay);
            }
        }
    }
    let mean = |sum: i64| u32::try_from((sum / i64::from(LATCHES)).max(0)).unwrap_or(u32::MAX);
    Ok(sums.into_iter().map(|sum| sum.map(mean)).collect())
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
