//! The gateway's objects on both networks (manual HMSI-168-81): the EtherCAT side for the
//! configured data sizes (§5.4.1, §8), and the CANopen object dictionary (§7).

use ecaxis_esi::model::{Access as CoeAccess, Device, Direction, Entry, Pdo as EsiPdo};

use super::dictionary::{Access, Dictionary, Kind};
use super::pdo::{INVALID, mapping};
use crate::coe::object_dictionary::{EntryHandle, ObjectStore};

/// The largest process data size in each direction, in bytes.
pub(super) const BUFFER: usize = 512;
pub(super) const MIN_SIZE: u16 = 2;
pub(super) const MAX_SIZE: u16 = 512;
/// Bytes per PDO and object of the EtherCAT side, and per byte object of the CANopen side.
pub(super) const BYTES_AN_OBJECT: u16 = 128;
/// EtherCAT: input and output bytes.
const INPUTS: u16 = 0x2000;
const OUTPUTS: u16 = 0x2100;
/// CANopen: data to and from the secondary network.
pub(super) const TRANSMIT_BUFFER: u16 = 0x2000;
pub(super) const RECEIVE_BUFFER: u16 = 0x2100;

/// True if the process data is that of a gateway: bytes of 0x2100 as outputs, bytes of 0x2000 as
/// inputs.
#[must_use]
pub fn is_gateway(device: &Device) -> bool {
    let begins = |pdos: &[EsiPdo], index: u16, object: u16| {
        let pdo = pdos.iter().find(|pdo| pdo.index == index);
        let first = pdo.and_then(|pdo| pdo.entries.first());
        first.is_some_and(|entry| (entry.index, entry.sub, entry.bit_len) == (object, 1, 8))
    };
    let coe = device.mailbox.as_ref().and_then(|m| m.coe.as_ref());
    coe.is_some()
        && begins(&device.rx_pdos, 0x1600, OUTPUTS)
        && begins(&device.tx_pdos, 0x1a00, INPUTS)
}

/// Returns the numbers of input and output bytes that the ESI maps by default.
#[must_use]
pub fn default_sizes(device: &Device) -> (u16, u16) {
    let bytes = |pdos: &[EsiPdo]| {
        let assigned = pdos.iter().filter(|pdo| pdo.sm.is_some());
        let bits: u32 = assigned.map(EsiPdo::bit_len).sum();
        let bytes = u16::try_from(bits / 8).unwrap_or(MAX_SIZE);
        bytes.clamp(MIN_SIZE, MAX_SIZE)
    };
    (bytes(&device.tx_pdos), bytes(&device.rx_pdos))
}

/// Returns the device as CoE describes it, with only the PDOs and bytes that the sizes need.
pub(super) fn shape(device: &Device, (inputs, outputs): (u16, u16)) -> Device {
    let mut shaped = device.clone();
    shaped.dictionary.objects.retain(|object| {
        !matches!(object.index, 0x1600..=0x1603 | 0x1a00..=0x1a03 | 0x1c12 | 0x1c13)
            && !matches!(object.index, 0x2000..=0x2003 | 0x2100..=0x2103)
    });
    shaped.rx_pdos = pdos(&device.rx_pdos, Direction::Rx, outputs);
    shaped.tx_pdos = pdos(&device.tx_pdos, Direction::Tx, inputs);
    shaped
}

/// Returns the device with other input and output sizes, as its CoE objects describe them.
#[must_use]
pub fn with_sizes(device: &Device, inputs: u16, outputs: u16) -> Device {
    let size = |bytes: u16| bytes.clamp(MIN_SIZE, MAX_SIZE);
    shape(device, (size(inputs), size(outputs)))
}

fn pdos(templates: &[EsiPdo], direction: Direction, size: u16) -> Vec<EsiPdo> {
    let (index, object, word) = match direction {
        Direction::Rx => (0x1600, OUTPUTS, "Output"),
        Direction::Tx => (0x1a00, INPUTS, "Input"),
    };
    let sm = templates.iter().find_map(|pdo| pdo.sm);
    let position = templates.first().map(|pdo| pdo.position);
    (0..size.div_ceil(BYTES_AN_OBJECT))
        .map(|n| {
            let first = n * BYTES_AN_OBJECT;
            let count = (size - first).min(BYTES_AN_OBJECT);
            let entries = (0..count).map(|byte| Entry {
                position: position.unwrap_or_default(),
                index: object + n,
                sub: byte as u8 + 1,
                bit_len: 8,
                name: format!("{word} byte {:04}", first + byte).into(),
                data_type: "USINT".into(),
                depends_on: Default::default(),
            });
            EsiPdo {
                position: position.unwrap_or_default(),
                direction,
                index: index + n,
                name: format!("{word}s {}", n + 1),
                sm,
                fixed: true,
                mandatory: true,
                virtual_: false,
                overwritten_by_module: false,
                oversampling: None,
                exclude: Vec::new(),
                su: None,
                excluded_sm: Vec::new(),
                depends_on: Default::default(),
                entries: entries.collect(),
            }
        })
        .collect()
}

/// Adds the manufacturer objects before the PDOs of the shaped device. They are read-only over SDO
/// ("for consistency reasons").
pub(super) fn prepare(store: &mut ObjectStore, (inputs, outputs): (u16, u16), name: &str) {
    let ro = CoeAccess::default();
    for (object, size, word) in [(INPUTS, inputs, "Input"), (OUTPUTS, outputs, "Output")] {
        for n in 0..size.div_ceil(BYTES_AN_OBJECT) {
            let first = n * BYTES_AN_OBJECT;
            let count = (size - first).min(BYTES_AN_OBJECT);
            store.ensure(object + n, 0, "No. of entries", 8, ro, &[count as u8]);
            for byte in 0..count {
                let name = format!("{word} byte {:04}", first + byte);
                store.ensure(object + n, byte as u8 + 1, &name, 8, ro, &[]);
            }
        }
    }
    let bits = u32::try_from(name.len() * 8).unwrap_or(0);
    let title = "Manufacturer device name";
    let slot = store.ensure(0x1008, 0, title, bits, ro, name.as_bytes());
    store.set_type(slot, "STRING(1)");
    store.ensure(0x1c00, 0, "SubIndex 000", 8, ro, &[4]);
    for sub in 1..=4 {
        store.ensure(
            0x1c00,
            sub,
            "Sync manager communication type",
            8,
            ro,
            &[sub],
        );
    }
}

/// Returns the slots of the input and output bytes, in order.
pub(super) fn slots(store: &ObjectStore, (inputs, outputs): (u16, u16)) -> [Vec<EntryHandle>; 2] {
    [(INPUTS, inputs), (OUTPUTS, outputs)].map(|(object, size)| {
        let bytes = 0..size;
        let slot = |n: u16| {
            store.slot(
                object + n / BYTES_AN_OBJECT,
                (n % BYTES_AN_OBJECT) as u8 + 1,
            )
        };
        bytes.filter_map(slot).collect()
    })
}

/// Returns the place of a buffer object of the CANopen side: true for the receive buffer, offset
/// and length in bytes. No object holds the first two bytes, the control and status word.
pub(super) fn buffer_place(index: u16, sub: u8) -> Option<(bool, usize, usize)> {
    let (receive, low) = match index {
        TRANSMIT_BUFFER..=0x20ff => (false, index - TRANSMIT_BUFFER),
        RECEIVE_BUFFER..=0x21ff => (true, index - RECEIVE_BUFFER),
        _ => return None,
    };
    let count = buffer_count(index)?;
    let n = usize::from(sub.checked_sub(1)?);
    if n >= usize::from(count) {
        return None;
    }
    let (first, size) = match low {
        0x00..=0x03 => (usize::from(low) * 128, 1),
        0x10..=0x11 => (usize::from(low - 0x10) * 256, 2),
        _ => (0, 4),
    };
    Some((receive, 2 + first + n * size, size))
}

/// Returns subindex 0 of a buffer object.
pub(super) fn buffer_count(index: u16) -> Option<u8> {
    Some(match index & 0xfeff {
        0x2000..=0x2002 | 0x2010 | 0x2020 => 128,
        0x2003 => 126,
        0x2011 => 127,
        _ => return None,
    })
}

/// Returns the factory CANopen dictionary without the buffers. `node` is the gateway's own node
/// number.
pub(super) fn factory(
    node: u8,
    vendor: u32,
    product: u32,
    revision: u32,
    serial: u32,
) -> Dictionary {
    use Access::{Ro, Rw, Wo};
    use Kind::{U8, U16, U32};
    let mut d = Dictionary::default();
    let own = i64::from(node);
    d.add(0x1000, 0, U32, Ro, 0);
    d.add(0x1001, 0, U8, Ro, 0);
    d.ranged(0x1003, 0, U8, 0, (0, 0));
    for sub in 1..=16 {
        d.add(0x1003, sub, U32, Ro, 0);
    }
    d.add(0x1005, 0, U32, Rw, 0x80);
    d.add(0x1006, 0, U32, Rw, 0);
    d.add(0x1007, 0, U32, Rw, 0);
    d.add_bytes(0x1008, 0, Ro, b"CANopen gateway");
    d.add_bytes(0x1009, 0, Ro, b"simulated");
    d.add_bytes(0x100a, 0, Ro, env!("CARGO_PKG_VERSION").as_bytes());
    d.add(0x100c, 0, U16, Rw, 0);
    d.add(0x100d, 0, U8, Rw, 0);
    for index in [0x1010, 0x1011] {
        d.add(index, 0, U8, Ro, 1);
        d.add(index, 1, U32, Rw, 1);
    }
    d.add(0x1014, 0, U32, Ro, 0x80 + own);
    d.add(0x1016, 0, U8, Ro, 127);
    for sub in 1..=127 {
        d.add(0x1016, sub, U32, Rw, 0);
    }
    d.add(0x1017, 0, U16, Rw, 0);
    d.add(0x1018, 0, U8, Ro, 4);
    for (sub, value) in (1..).zip([vendor, product, revision, serial]) {
        d.add(0x1018, sub, U32, Ro, i64::from(value));
    }
    d.add(0x1029, 0, U8, Ro, 2);
    d.add(0x1029, 1, U8, Ro, 0);
    d.add(0x1029, 2, U8, Ro, 0);
    for n in 0..128 {
        pdo_parameters(&mut d, n, own);
    }
    for index in [0x1f22, 0x1f25, 0x1f26, 0x1f27, 0x1f81, 0x1f82, 0x1f83] {
        let most = if matches!(index, 0x1f25 | 0x1f82 | 0x1f83) {
            128
        } else {
            127
        };
        d.add(index, 0, U8, Ro, i64::from(most));
        for sub in 1..=most {
            match (index, sub) {
                (0x1f22, _) => d.add_bytes(index, sub, Rw, &[]),
                (0x1f25, _) => d.add(index, sub, U32, Wo, 0),
                (0x1f82 | 0x1f83, 128) => d.add(index, sub, U8, Wo, 0),
                (0x1f82 | 0x1f83, _) => d.add(index, sub, U8, Rw, 0),
                _ => d.add(index, sub, U32, Rw, 0),
            }
        }
    }
    for index in 0x1f84..=0x1f88 {
        d.add(index, 0, U8, Ro, 127);
        for sub in 1..=127 {
            d.add(index, sub, U32, Rw, 0);
        }
    }
    d.add(0x1f80, 0, U32, Rw, 0);
    d.add(0x1f89, 0, U32, Rw, 0);
    for index in [0x3000, 0x3001] {
        d.ranged(index, 0, U16, 16, (MIN_SIZE.into(), MAX_SIZE.into()));
    }
    d
}

/// Adds PDO number `n` in each direction. The first four have the default identifiers; all map
/// successive groups of eight buffer bytes (§6.2.4, default PDO mapping scheme).
fn pdo_parameters(d: &mut Dictionary, n: u16, own: i64) {
    use Access::{Ro, Rw};
    use Kind::{U8, U16, U32};
    for (communication, contents, base, buffer) in [
        (0x1400 + n, 0x1600 + n, 0x200, RECEIVE_BUFFER),
        (0x1800 + n, 0x1a00 + n, 0x180, TRANSMIT_BUFFER),
    ] {
        let cob = if n < 4 {
            base + i64::from(n) * 0x100 + own
        } else {
            i64::from(INVALID)
        };
        d.add(communication, 0, U8, Ro, if base == 0x200 { 2 } else { 5 });
        d.add(communication, 1, U32, Rw, cob);
        d.add(communication, 2, U8, Rw, 255);
        if base == 0x180 {
            d.add(communication, 3, U16, Rw, 0);
            d.add(communication, 5, U16, Rw, 0);
        }
        // 510 bytes in groups of eight fill 64 PDOs. The manual's table ends at PDO 128; the
        // remaining PDOs stay empty.
        let first = n * 8;
        let used = 510u16.saturating_sub(first).min(8) as u8;
        d.ranged(contents, 0, U8, used.into(), (0, 8));
        for sub in 1..=8u8 {
            let byte = first + u16::from(sub) - 1;
            let object = (byte / 128, byte % 128);
            let value = if sub <= used {
                mapping(buffer + object.0, object.1 as u8 + 1, 8)
            } else {
                0
            };
            d.add(contents, sub, U32, Rw, value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The manual's tables of transmit and receive buffer, first and last line of each object.
    #[test]
    fn buffer_objects_match_the_manual() {
        for (index, sub, place) in [
            (0x2000, 1, Some((false, 2, 1))),
            (0x2000, 128, Some((false, 129, 1))),
            (0x2001, 1, Some((false, 130, 1))),
            (0x2002, 128, Some((false, 385, 1))),
            (0x2003, 1, Some((false, 386, 1))),
            (0x2003, 126, Some((false, 511, 1))),
            (0x2003, 127, None),
            (0x2010, 1, Some((false, 2, 2))),
            (0x2010, 128, Some((false, 256, 2))),
            (0x2011, 1, Some((false, 258, 2))),
            (0x2011, 127, Some((false, 510, 2))),
            (0x2020, 1, Some((false, 2, 4))),
            (0x2020, 128, Some((false, 510, 4))),
            (0x2100, 1, Some((true, 2, 1))),
            (0x2103, 126, Some((true, 511, 1))),
            (0x2110, 2, Some((true, 4, 2))),
            (0x2120, 128, Some((true, 510, 4))),
            (0x2100, 0, None),
            (0x2004, 1, None),
            (0x2200, 1, None),
        ] {
            assert_eq!(buffer_place(index, sub), place, "{index:04x}:{sub}");
        }
    }

    #[test]
    fn default_pdos_match_the_manual() {
        let d = factory(42, 1, 2, 3, 4);
        for (n, cob) in [
            (0, 0x22a),
            (1, 0x32a),
            (2, 0x42a),
            (3, 0x52a),
            (4, 0x8000_0000),
        ] {
            assert_eq!(d.get(0x1400 + n, 1), cob);
        }
        for (n, cob) in [
            (0, 0x1aa),
            (1, 0x2aa),
            (2, 0x3aa),
            (3, 0x4aa),
            (127, 0x8000_0000),
        ] {
            assert_eq!(d.get(0x1800 + n, 1), cob);
        }
        assert_eq!(d.get(0x1603, 1), mapping(0x2100, 25, 8));
        assert_eq!(d.get(0x1a04, 8), mapping(0x2000, 40, 8));
        assert_eq!(d.get(0x163f, 0), 6);
        assert_eq!(d.get(0x163f, 6), mapping(0x2103, 126, 8));
        assert_eq!(d.get(0x3000, 0), 16);
    }
}
