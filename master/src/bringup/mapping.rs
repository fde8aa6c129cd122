//! The device's actual PDO assignment and mapping, read back and compared with the layout that the
//! cycle will use. With one bit of offset, a set-point would reach another object.

use ecaxis_esi::model::Pdo;

use super::BusDevice;
use crate::config::DeviceConfig;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};

/// The PDO assignment of SyncManager n is 0x1C10 + n (ETG.1000.6, Table 67).
const ASSIGNMENT: u16 = 0x1c10;

pub(super) async fn compare(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    device: &mut BusDevice,
) -> Result<(), Error> {
    let selection = &config.selection;
    for (sms, pdos) in [
        (&selection.layout.outputs, &selection.rx),
        (&selection.layout.inputs, &selection.tx),
    ] {
        let mut assigned = Vec::new();
        for sm in sms {
            let index = ASSIGNMENT + u16::from(sm.sm);
            let Some(list) = read_list(wire, device, index).await? else {
                // A device with a fixed assignment may hide it; it checks the lengths itself on the
                // way to SafeOp.
                return Ok(());
            };
            assigned.extend(list.into_iter().map(|pdo| (index, pdo)));
        }
        for (place, (index, actual)) in assigned.iter().enumerate() {
            let expected = pdos.get(place).map(|pdo| u32::from(pdo.index));
            if expected != Some(*actual) {
                return Err(differs(device, *index, place, expected, Some(*actual), 4));
            }
        }
        if let (Some(missing), Some(sm)) = (pdos.get(assigned.len()), sms.last()) {
            let index = ASSIGNMENT + u16::from(sm.sm);
            let expected = Some(u32::from(missing.index));
            return Err(differs(device, index, assigned.len(), expected, None, 4));
        }
        for pdo in pdos {
            compare_contents(wire, device, pdo).await?;
        }
    }
    Ok(())
}

async fn compare_contents(
    wire: &impl MailboxTransport,
    device: &mut BusDevice,
    pdo: &Pdo,
) -> Result<(), Error> {
    let Some(actual) = read_list(wire, device, pdo.index).await? else {
        return Ok(());
    };
    let expected: Vec<u32> = pdo.entries.iter().map(|entry| entry.mapping()).collect();
    let len = actual.len().max(expected.len());
    for place in 0..len {
        let (expected, actual) = (expected.get(place).copied(), actual.get(place).copied());
        if expected != actual {
            return Err(differs(device, pdo.index, place, expected, actual, 8));
        }
    }
    Ok(())
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

fn differs(
    device: &BusDevice,
    index: u16,
    place: usize,
    expected: Option<u32>,
    actual: Option<u32>,
    digits: usize,
) -> Error {
    let show = |value: Option<u32>| {
        value.map_or_else(
            || "nothing".to_owned(),
            |value| format!("0x{value:0digits$x}"),
        )
    };
    Cause::Mapping {
        index,
        sub: u8::try_from(place + 1).unwrap_or(u8::MAX),
        expected: show(expected),
        actual: show(actual),
    }
    .with_device(&device.at)
}
