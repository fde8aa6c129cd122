//! The topology of a segment, from the open ports (DL status, 0x0110).

/// The order in which a frame that arrived at port 0 leaves the other ports (Beckhoff ESC data
/// sheet, section I, 3.1).
const ORDER: [u8; 3] = [3, 1, 2];

/// Returns `true` if communication is established at the port: bits 9, 11, 13 and 15.
#[must_use]
pub fn talks(dl_status: u16, port: u8) -> bool {
    port < 4 && dl_status >> (9 + 2 * u16::from(port)) & 1 != 0
}

/// Returns `true` if the port has a physical link: bits 4 to 7.
#[must_use]
pub fn has_link(dl_status: u16, port: u8) -> bool {
    port < 4 && dl_status >> (4 + u16::from(port)) & 1 != 0
}

/// Returns the upstream device and its port for each SubDevice in segment order. `None`: connected
/// to the MainDevice, or the port bits give no place.
#[must_use]
pub fn parents(dl_status: &[u16]) -> Vec<Option<(usize, u8)>> {
    let mut waiting: Vec<(usize, u8)> = Vec::new();
    let mut parents = Vec::with_capacity(dl_status.len());
    for (device, &status) in dl_status.iter().enumerate() {
        parents.push(waiting.pop());
        // `pop` takes the last port first, so the ports are pushed in reverse order.
        let open = ORDER.iter().rev().filter(|port| talks(status, **port));
        waiting.extend(open.map(|port| (device, *port)));
    }
    parents
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the DL status of a device with these ports open.
    fn open(ports: &[u8]) -> u16 {
        ports.iter().fold(0, |status, port| {
            status | 1 << (9 + 2 * port) | 1 << (4 + port)
        })
    }

    #[test]
    fn parents_finds_lines_and_junctions() {
        type Parent = Option<(usize, u8)>;
        let table: [(&[&[u8]], &[Parent]); 5] = [
            (&[], &[]),
            (&[&[0]], &[None]),
            (
                &[&[0, 1], &[0, 1], &[0]],
                &[None, Some((0, 1)), Some((1, 1))],
            ),
            // A junction: port 3 first, then 1, then 2.
            (
                &[&[0, 1, 2, 3], &[0, 1], &[0], &[0], &[0]],
                &[None, Some((0, 3)), Some((1, 1)), Some((0, 1)), Some((0, 2))],
            ),
            // Fewer open ports than devices.
            (&[&[0], &[0, 1]], &[None, None]),
        ];
        for (devices, expected) in table {
            let status: Vec<u16> = devices.iter().map(|ports| open(ports)).collect();
            assert_eq!(parents(&status), expected, "{devices:?}");
        }
    }

    #[test]
    fn dl_status_bits_match_their_ports() {
        assert!(talks(0x0200, 0) && talks(0x8000, 3) && !talks(0xffff, 4));
        assert!(has_link(0x0010, 0) && has_link(0x0080, 3) && !has_link(0xff0f, 1));
    }
}
