//! The device's actual PDO assignment and mapping, read back and compared with the layout that the
//! cycle will use. With one bit of offset, a set-point would reach another object. Only the layout
//! counts: PDOs without entries and the split of objects over PDOs and gaps may differ.

use ecaxis_esi::layout::SmLayout;
use ecaxis_esi::model::Pdo;

use super::BusDevice;
use crate::config::DeviceConfig;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};

/// The PDO assignment of SyncManager n is 0x1C10 + n (ETG.1000.6, Table 67).
const ASSIGNMENT: u16 = 0x1c10;

/// A PDO and its mapping entries: index, subindex and bit length of each object.
type Contents = (u16, Vec<u32>);

pub(super) async fn compare(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
) -> Result<(), Error> {
    let selection = &config.selection;
    for (sms, pdos, offered) in [
        (
            &selection.layout.outputs,
            &selection.rx,
            &config.device.rx_pdos,
        ),
        (
            &selection.layout.inputs,
            &selection.tx,
            &config.device.tx_pdos,
        ),
    ] {
        let mut assigned = Vec::new();
        for sm in sms {
            let Some(list) = read_list(wire, device, assignment(sm)).await? else {
                // A device with a fixed assignment may hide it; it checks the lengths itself on the
                // way to SafeOp.
                return Ok(());
            };
            assigned.push((sm, list));
        }
        for (sm, list) in assigned {
            let mut actual = Vec::new();
            for (place, value) in list.into_iter().enumerate() {
                // An empty place of the assignment has index 0.
                let Some(pdo) = u16::try_from(value).ok().filter(|pdo| *pdo != 0) else {
                    continue;
                };
                let known = pdos.iter().chain(offered).find(|known| known.index == pdo);
                let read = read_list(wire, device, pdo).await?;
                let Some(contents) = read.or_else(|| known.map(entries)) else {
                    let sub = u8::try_from(place + 1).unwrap_or(u8::MAX);
                    let difference = Difference {
                        place: (assignment(sm), sub),
                        expected: "no such PDO".to_owned(),
                        actual: format!("0x{pdo:04x}"),
                    };
                    return Err(difference.with_device(device));
                };
                actual.push((pdo, contents));
            }
            let expected = pdos.iter().filter(|pdo| pdo.sm == Some(sm.sm));
            let expected: Vec<Contents> = expected.map(|pdo| (pdo.index, entries(pdo))).collect();
            if let Some(difference) = difference(&expected, &actual) {
                return Err(difference.with_device(device));
            }
        }
    }
    Ok(())
}

fn assignment(sm: &SmLayout) -> u16 {
    ASSIGNMENT + u16::from(sm.sm)
}

fn entries(pdo: &Pdo) -> Vec<u32> {
    pdo.entries.iter().map(|entry| entry.mapping()).collect()
}

/// An object in the process data of a SyncManager.
#[derive(Debug, Clone, Copy)]
struct MappedObject {
    bit: u32,
    /// Index, subindex and bit length.
    mapping: u32,
    /// The PDO and the subindex of its mapping object.
    place: (u16, u8),
}

impl MappedObject {
    fn show(object: Option<&Self>) -> String {
        object.map_or_else(
            || "nothing".to_owned(),
            |object| format!("0x{:08x} at bit {}", object.mapping, object.bit),
        )
    }
}

/// Returns the objects of these PDOs without gaps, and the length in bits.
fn lay_out(pdos: &[Contents]) -> (Vec<MappedObject>, u32) {
    let mut objects = Vec::new();
    let mut bit = 0_u32;
    for (pdo, contents) in pdos {
        for (sub, &mapping) in (1..=u8::MAX).zip(contents) {
            // A gap has index 0.
            if mapping >> 16 != 0 {
                objects.push(MappedObject {
                    bit,
                    mapping,
                    place: (*pdo, sub),
                });
            }
            bit = bit.saturating_add(mapping & 0xff);
        }
    }
    (objects, bit)
}

/// Where two layouts differ.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Difference {
    /// Index and subindex in the device, or in the ESI if the device has nothing there.
    place: (u16, u8),
    expected: String,
    actual: String,
}

impl Difference {
    fn with_device(self, device: &BusDevice) -> Error {
        let (index, sub) = self.place;
        Cause::Mapping {
            index,
            sub,
            expected: self.expected,
            actual: self.actual,
        }
        .with_device(&device.at)
    }
}

/// Returns the first difference between the layouts of two lists of PDOs.
fn difference(expected: &[Contents], actual: &[Contents]) -> Option<Difference> {
    let ((wanted, wanted_bits), (found, found_bits)) = (lay_out(expected), lay_out(actual));
    let on_wire = |object: &MappedObject| (object.bit, object.mapping);
    for n in 0..wanted.len().max(found.len()) {
        let (wanted, found) = (wanted.get(n), found.get(n));
        if wanted.map(on_wire) != found.map(on_wire) {
            // If one side ends first, the sizes say more.
            let size = |bits: u32| match wanted.is_none() || found.is_none() {
                true => format!(", {} bytes in all", bits.div_ceil(8)),
                false => String::new(),
            };
            return Some(Difference {
                place: found.or(wanted)?.place,
                expected: MappedObject::show(wanted) + &size(wanted_bits),
                actual: MappedObject::show(found) + &size(found_bits),
            });
        }
    }
    let (wanted, found) = (wanted_bits.div_ceil(8), found_bits.div_ceil(8));
    let last = actual.last().or(expected.last())?;
    (wanted != found).then(|| Difference {
        place: (last.0, 0),
        expected: format!("{wanted} bytes"),
        actual: format!("{found} bytes"),
    })
}

/// Returns `None` if the device has no such object or no CoE mailbox.
async fn read_list(
    wire: &impl MailboxTransport,
    device: &mut BusDevice,
    index: u16,
) -> Result<Option<Vec<u32>>, Error> {
    let Some(coe) = device.coe.as_mut() else {
        return Ok(None);
    };
    let list = coe.upload_list(wire, index).await;
    list.map_err(|source| {
        Cause::Sdo(source)
            .with_device(&device.at)
            .with_action("reading the PDO mapping back")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pdo(index: u16, contents: &[u32]) -> Contents {
        (index, contents.to_vec())
    }

    /// ETG.1000.6, PDO assignment and PDO mapping: the process data of a SyncManager are the mapped
    /// objects of its PDOs in order. Nothing else is on the wire.
    #[test]
    fn layouts_are_compared_and_not_lists() {
        const STATUS: u32 = 0x6041_0010;
        const POSITION: u32 = 0x6064_0020;
        let expected = [pdo(0x1a00, &[STATUS, 0x0000_0010, POSITION])];
        for same in [
            &[pdo(0x1a00, &[STATUS, 0x0000_0010, POSITION])][..],
            // A PDO without entries, as some devices assign for an empty slot.
            &[
                pdo(0x1a10, &[]),
                pdo(0x1a00, &[STATUS, 0x0000_0010, POSITION]),
            ],
            // The same objects in two PDOs, the gap in two parts.
            &[
                pdo(0x1a00, &[STATUS, 0x0000_0008]),
                pdo(0x1a01, &[0x0000_0008, POSITION]),
            ],
        ] {
            assert_eq!(difference(&expected, same), None, "{same:?}");
        }
        let differs = |actual: &[Contents]| {
            let found = difference(&expected, actual).expect("a difference");
            (found.place, found.expected, found.actual)
        };
        let position = "0x60640020 at bit 32".to_owned();
        assert_eq!(
            differs(&[pdo(0x1a00, &[STATUS, POSITION])]),
            (
                (0x1a00, 2),
                position.clone(),
                "0x60640020 at bit 16".to_owned()
            )
        );
        assert_eq!(
            differs(&[pdo(0x1a00, &[STATUS])]),
            (
                (0x1a00, 3),
                position + ", 8 bytes in all",
                "nothing, 2 bytes in all".to_owned()
            )
        );
        assert_eq!(
            differs(&[pdo(0x1a00, &[STATUS, 0x0000_0010, POSITION, 0x0000_0008])]),
            ((0x1a00, 0), "8 bytes".to_owned(), "9 bytes".to_owned())
        );
        let other = differs(&[pdo(0x1a00, &[STATUS, 0x0000_0010, 0x606c_0020])]);
        assert_eq!(other.2, "0x606c0020 at bit 32");
        assert_eq!(difference(&[], &[pdo(0x1600, &[])]), None);
    }
}
