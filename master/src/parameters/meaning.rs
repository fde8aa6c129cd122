//! What a value means: words and codes of CiA 402, vendor ids.

use ecaxis_axis::cia402::describe;
use ecaxis_axis::{Controlword, Mode, Statusword};
use ecaxis_ecat::vendor::vendor_name;

/// The objects of each further axis of a drive are higher by this.
const NEXT_AXIS: u16 = 0x0800;
/// The first object of the first axis, and the first after the last.
const AXES: std::ops::Range<u16> = 0x6000..0xa000;

/// Returns the meaning of a Controlword, Statusword, mode, error code or vendor id, of any axis of
/// a drive. `value`: little-endian bytes.
#[must_use]
pub fn meaning(index: u16, sub: u8, value: &[u8]) -> Option<String> {
    let of_axis = match AXES.contains(&index) {
        true => 0x6000 + (index - AXES.start) % NEXT_AXIS,
        false => index,
    };
    // The length distinguishes these objects from those of I/O devices at the same indices.
    match (of_axis, sub, value) {
        (0x6040, 0, &[low, high]) => {
            let word = Controlword::from_bits_retain(u16::from_le_bytes([low, high]));
            Some(word.to_string())
        }
        (0x6041, 0, &[low, high]) => {
            let word = Statusword::from_bits_retain(u16::from_le_bytes([low, high]));
            Some(word.to_string())
        }
        (0x6060 | 0x6061, 0, &[code]) if index >= AXES.start => match Mode::from_code(code as i8) {
            Mode::Unknown(0) => Some("no mode".to_owned()),
            Mode::Unknown(_) => None,
            mode => Some(mode.to_string()),
        },
        (0x603f, 0, &[low, high]) => {
            let code = u16::from_le_bytes([low, high]);
            (code != 0).then(|| describe(code).text.to_owned())
        }
        (0x1018, 1, &[a, b, c, d]) => {
            vendor_name(u32::from_le_bytes([a, b, c, d])).map(str::to_owned)
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn meaning_of_words_codes_and_ids() {
        let known: [(u16, u8, &[u8], &str); 8] = [
            (0x6041, 0, &[0x37, 0x02], "Operation enabled"),
            (0x6841, 0, &[0x18, 0x02], "Fault"),
            (0x6040, 0, &[0x0f, 0x00], "enable operation"),
            (0x7840, 0, &[0x06, 0x00], "shutdown"),
            (0x6060, 0, &[8], "CSP"),
            (0x6061, 0, &[0], "no mode"),
            (0x603f, 0, &[0x20, 0x32], "DC link undervoltage"),
            (0x1018, 1, &[2, 0, 0, 0], "Beckhoff Automation"),
        ];
        for (index, sub, value, text) in known {
            assert_eq!(meaning(index, sub, value).as_deref(), Some(text));
        }
        let unknown: [(u16, u8, &[u8]); 6] = [
            // The number of entries of an I/O device's channel.
            (0x6040, 0, &[1]),
            (0x6041, 1, &[0x37, 0x02]),
            (0x603f, 0, &[0, 0]),
            (0x6064, 0, &[0x37, 0x02]),
            (0x1018, 2, &[2, 0, 0, 0]),
            (0x2041, 0, &[0x37, 0x02]),
        ];
        for (index, sub, value) in unknown {
            assert_eq!(meaning(index, sub, value), None, "{index:#x}");
        }
    }
}
