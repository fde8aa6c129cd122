//! Propagation delays. Pure.

use ecaxis_master::acyclic::topology::{PORT_ORDER, ParentPort};

/// A device of the tree.
#[derive(Debug, Clone, Copy)]
pub struct TreeNode {
    /// The ports that forward frames.
    pub open: [bool; 4],
    pub uplink: Option<ParentPort>,
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
#[must_use]
pub fn delays(places: &[TreeNode], times: &[Option<[u32; 4]>]) -> Vec<Option<i64>> {
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
    use ecaxis_master::acyclic::topology::{open_ports, parents};

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
}
