//! Who hangs at whose port, and how long frames take. Pure.
//!
//! Frames pass a device's ports in the order 0, 3, 1, 2 and back to 0, so that the order of devices is that of a tree walked branch by
//! branch. Frames are taken to come in at port 0, as they do where no cable is plugged into the wrong socket.

/// Order in which frames pass the ports.
const ORDER: [u8; 4] = [0, 3, 1, 2];

/// A port that leads away from the MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Uplink {
    /// Position of the device.
    pub device: u16,
    pub port: u8,
}

/// A device in its tree.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Ports that frames go out of and come back in at.
    pub open: [bool; 4],
    pub uplink: Option<Uplink>,
}

/// For each device in the order of the segment the port it hangs at; `None` for the first, and for those that no port is left for:
/// then what the ports say cannot be.
#[must_use]
pub fn uplinks(open: &[[bool; 4]]) -> Vec<Option<Uplink>> {
    // Devices with ports that nobody has been found at yet.
    let mut waiting: Vec<(u16, Vec<u8>)> = Vec::new();
    let mut all = Vec::with_capacity(open.len());
    for (position, ports) in (0_u16..).zip(open) {
        let mut uplink = None;
        while let Some((device, free)) = waiting.last_mut() {
            if free.is_empty() {
                waiting.pop();
                continue;
            }
            uplink = Some(Uplink {
                device: *device,
                port: free.remove(0),
            });
            break;
        }
        all.push(uplink);
        let free = ORDER.into_iter().skip(1);
        let free = free.filter(|port| is_open(ports, *port)).collect();
        waiting.push((position, free));
    }
    all
}

fn is_open(ports: &[bool; 4], port: u8) -> bool {
    ports.get(usize::from(port)).copied().unwrap_or(false)
}

fn time(times: &[u32; 4], port: u8) -> u32 {
    times.get(usize::from(port)).copied().unwrap_or(0)
}

/// Nanoseconds from one receive time to a later one of the same device; the clock has 32 bits.
fn between(times: &[u32; 4], from: u8, to: u8) -> i64 {
    // `as` keeps the bits: a few nanoseconds of noise may make it less than zero.
    i64::from(time(times, to).wrapping_sub(time(times, from)) as i32)
}

/// The open port before `port` in the order of the frame.
fn before(ports: &[bool; 4], port: u8) -> u8 {
    let earlier = ORDER.into_iter().take_while(|other| *other != port);
    let earlier = earlier.filter(|other| is_open(ports, *other));
    earlier.last().unwrap_or(0)
}

/// One way from the first device that has a clock, nanoseconds; `None` for devices without receive times. `times` are those at which one
/// frame came in at each port.
///
/// What a device takes between its port and what hangs there is the difference of its own two times; less what passes behind the next
/// device's port 0, it is the way there and back (ETG.1000.4, "propagation delay measurement"). Devices without receive times are part
/// of the cable.
#[must_use]
pub fn delays(places: &[Place], times: &[Option<[u32; 4]>]) -> Vec<Option<i64>> {
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
                let last = ORDER.into_iter().rfind(|port| is_open(&place.open, *port));
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

/// The nearest device towards the MainDevice that has receive times, and its port.
fn clocked<'a>(
    from: Option<Uplink>,
    places: &'a [Place],
    times: &'a [Option<[u32; 4]>],
) -> Option<(&'a Place, &'a [u32; 4], Uplink)> {
    let mut next = from;
    // Nobody hangs deeper than there are devices.
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

    const LINE: [bool; 4] = [true, true, false, false];
    const END: [bool; 4] = [true, false, false, false];

    fn at(device: u16, port: u8) -> Option<Uplink> {
        Some(Uplink { device, port })
    }

    #[test]
    fn a_line_hangs_at_port_1() {
        assert_eq!(uplinks(&[LINE, LINE, END]), [None, at(0, 1), at(1, 1)]);
        assert_eq!(uplinks(&[END]), [None]);
        assert_eq!(uplinks(&[]), []);
    }

    #[test]
    fn branches_are_walked_in_the_order_of_the_ports() {
        let coupler = [true, true, true, true];
        assert_eq!(
            uplinks(&[coupler, LINE, END, END, END]),
            [None, at(0, 3), at(1, 1), at(0, 1), at(0, 2)]
        );
    }

    #[test]
    fn ports_that_cannot_be() {
        // The first says that nobody comes after it.
        assert_eq!(uplinks(&[END, END]), [None, None]);
        assert_eq!(uplinks(&[LINE, END, END]), [None, at(0, 1), None]);
    }

    fn places(open: &[[bool; 4]]) -> Vec<Place> {
        let uplinks = uplinks(open);
        open.iter()
            .zip(uplinks)
            .map(|(open, uplink)| Place {
                open: *open,
                uplink,
            })
            .collect()
    }

    /// 100 ns a cable, each device's clock started at another time; one wraps.
    #[test]
    fn a_line_of_three() {
        let places = places(&[LINE, LINE, END]);
        let times = [
            Some([1000, 1400, 0, 0]),
            Some([u32::MAX - 50, 149, 0, 0]),
            Some([7, 0, 0, 0]),
        ];
        assert_eq!(delays(&places, &times), [Some(0), Some(100), Some(200)]);
    }

    #[test]
    fn a_device_without_a_clock_is_cable() {
        let places = places(&[LINE, LINE, END]);
        let times = [Some([0, 400, 0, 0]), None, Some([0; 4])];
        assert_eq!(delays(&places, &times), [Some(0), None, Some(200)]);
    }

    #[test]
    fn the_second_branch_waits_for_the_first() {
        let places = places(&[[true, true, false, true], END, END]);
        // 200 ns there and back at port 3, 600 at port 1.
        let times = [Some([0, 800, 0, 200]), Some([0; 4]), Some([0; 4])];
        assert_eq!(delays(&places, &times), [Some(0), Some(100), Some(500)]);
    }
}
