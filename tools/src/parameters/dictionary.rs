//! The dictionary of a device from SDO Information.

use ecaxis_esi::model::{Access, PdoMapping};
use ecaxis_esi::{Dictionary, Object, ObjectCode, ObjectItem, Writable};
use ecaxis_master::acyclic::DeviceRef;
use ecaxis_master::mailbox::{
    CoeCause, CoeClient, EntryDescription, InfoError, InfoRequest, MailboxTransport,
    ObjectDescription, ObjectList,
};
use ecaxis_master::report::{Cause, Error};

use super::DataType;

/// The maximum number of subindices; the largest known device has a tenth of it.
const MAX_ITEMS: usize = 50_000;

/// Reads all descriptions. `progress` receives the number of completed and of all objects.
///
/// # Errors
/// [`Cause::Information`], also without SDO Information. Objects and subindices without a
/// description are skipped.
pub async fn dictionary(
    coe: &mut CoeClient,
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Dictionary, Error> {
    let failed = |error| Cause::Information(error).with_device(device);
    let all = coe.object_list(wire, ObjectList::All).await;
    let all = all.map_err(failed)?;
    let mut objects = Vec::new();
    let mut count = 0;
    for (n, index) in all.iter().enumerate() {
        progress(n, all.len());
        let found = match object(coe, wire, *index).await {
            Ok(found) => found,
            Err(error) if error.is_refusal() => continue,
            Err(error) => return Err(failed(error)),
        };
        count += found.items.len();
        if count > MAX_ITEMS {
            let what = format!("it leads to more than {MAX_ITEMS} subindices");
            return Err(failed(InfoError {
                station: device.station,
                asked: InfoRequest::List(ObjectList::All),
                cause: CoeCause::Malformed(what),
            }));
        }
        objects.push(found);
    }
    Ok(Dictionary { objects })
}

/// Reads one object with all subindices.
///
/// # Errors
/// [`InfoError`]. Subindices without a description are skipped, because records have gaps.
pub async fn object(
    coe: &mut CoeClient,
    wire: &impl MailboxTransport,
    index: u16,
) -> Result<Object, InfoError> {
    let ObjectDescription {
        max_sub,
        code,
        name,
        ..
    } = coe.object_description(wire, index).await?;
    let code = match code {
        8 => ObjectCode::Array,
        9 => ObjectCode::Record,
        _ => ObjectCode::Var,
    };
    let last = if code == ObjectCode::Var { 0 } else { max_sub };
    let mut items = Vec::new();
    let mut offset = 16;
    for sub in 0..=last {
        let entry = match coe.entry_description(wire, index, sub).await {
            Ok(entry) => entry,
            Err(error) if error.is_refusal() => continue,
            Err(error) => return Err(error),
        };
        let mut item = item(&entry);
        if sub > 0 {
            item.bit_offset = offset;
            offset = offset.saturating_add(item.bit_len);
        }
        items.push(item);
    }
    Ok(Object {
        index,
        name: name.as_str().into(),
        code,
        items,
        ..Object::default()
    })
}

fn item(entry: &EntryDescription) -> ObjectItem {
    let bit_len = u32::from(entry.bit_len);
    let data_type = DataType::coded(entry.data_type, bit_len);
    let bit = |n: u32| entry.access >> n & 1 != 0;
    ObjectItem {
        sub: entry.sub,
        name: entry.name.as_str().into(),
        type_name: data_type.to_string().as_str().into(),
        bit_len,
        access: Access {
            read: bit(0) || bit(1) || bit(2),
            write: match (bit(3), bit(4), bit(5)) {
                (false, false, false) => Writable::Never,
                (true, true, true) => Writable::Always,
                (pre_op, safe_op, op) => Writable::Only {
                    pre_op,
                    safe_op,
                    op,
                },
            },
        },
        pdo_mapping: PdoMapping {
            rx: bit(6),
            tx: bit(7),
        },
        backup: bit(8),
        setting: bit(9),
        ..ObjectItem::default()
    }
}
