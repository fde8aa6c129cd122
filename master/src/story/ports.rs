//! Who is connected to which port of whom, from the ports that are open (DL status, 0x0110).

/// Ports in the order in which a frame that came in at port 0 leaves (Beckhoff ESC data sheet, section I, 3.1).
const ORDER: [u8; 3] = [3, 1, 2];

/// Whether frames go out of and come in at the port: bits 9, 11, 13 and 15.
#[must_use]
pub fn talks(dl_status: u16, port: u8) -> bool {
    port < 4 && dl_status >> (9 + 2 * u16::from(port)) & 1 != 0
}

/// Whether the port sees a partner: bits 4 to 7.
#[must_use]
pub fn has_link(dl_status: u16, port: u8) -> bool {
    port < 4 && dl_status >> (4 + u16::from(port)) & 1 != 0
}

/// For each SubDevice, in the order of the segment, the one that it is connected to and at which port of it. The first is at the
/// MainDevice, and so are those that the port bits leave no place for.
#[must_use]
pub fn parents(dl_status: &[u16]) -> Vec<Option<(usize, u8)>> {
    let mut waiting: Vec<(usize, u8)> = Vec::new();
    let mut parents = Vec::with_capacity(dl_status.len());
    for (device, &status) in dl_status.iter().enumerate() {
        parents.push(waiting.pop());
        // The first to be reached is taken first.
        let open = ORDER.iter().rev().filter(|port| talks(status, **port));
        waiting.extend(open.map(|port| (device, *port)));
    }
    parents
}

#[cfg(test)]
mod tests {
    use super::*;

    /// DL status of a device at which these ports are open.
    fn open(ports: &[u8]) -> u16 {
        ports.iter().fold(0, |status, port| {
            status | 1 << (9 + 2 * port) | 1 << (4 + port)
        })
    }

    #[test]
    fn trees() {
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
    fn bits() {
        assert!(talks(0x0200, 0) && talks(0x8000, 3) && !talks(0xffff, 4));
        assert!(has_link(0x0010, 0) && has_link(0x0080, 3) && !has_link(0xff0f, 1));
    }
}
