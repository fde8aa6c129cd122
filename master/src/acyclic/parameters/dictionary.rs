//! The dictionary of a device from SDO Information.

use crate::acyclic::DeviceRef;
use crate::mailbox::{
    CoeCause, CoeClient, EntryDescription, InfoError, InfoRequest, MailboxTransport,
    ObjectDescription, ObjectList,
};
use crate::report::{Cause, Error};
use ecaxis_esi::model::{Access, PdoMapping};
use ecaxis_esi::{Dictionary, Object, ObjectCode, ObjectItem, Writable};

use crate::parameters::DataType;

/// The maximum number of subindices; the largest known device has a tenth of it.
const MAX_ITEMS: usize = 50_000;

/// The maximum number of objects in a row whose description does not arrive in time.
const MAX_UNANSWERED: usize = 3;

/// The dictionary of a device as far as its answers are usable.
#[derive(Debug, Clone, Default)]
pub struct ReadDictionary {
    pub dictionary: Dictionary,
    /// Descriptions that were malformed or did not arrive in time, in reading order.
    pub failed: Vec<InfoError>,
}

/// Reads all descriptions. `progress` receives the number of completed and of all objects.
///
/// # Errors
/// [`Cause::Information`], also without SDO Information. Objects and subindices without a
/// description are skipped. A malformed or late description costs its object or subindex. Three
/// objects in a row that are not answered in time are an error.
pub async fn dictionary(
    coe: &mut CoeClient,
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<ReadDictionary, Error> {
    let failed = |error| Cause::Information(error).with_device(device);
    let all = coe.object_list(wire, ObjectList::All).await;
    let all = all.map_err(failed)?;
    let mut read = ReadDictionary::default();
    let mut count = 0;
    let mut unanswered = 0;
    for (n, index) in all.iter().enumerate() {
        progress(n, all.len());
        let before = read.failed.len();
        let found = object(coe, wire, *index, &mut read.failed).await;
        let new = read.failed.get(before..).unwrap_or_default();
        let late = new.iter().rfind(|error| error.is_timeout());
        unanswered = late.map_or(0, |_| unanswered + 1);
        match late {
            Some(error) if unanswered >= MAX_UNANSWERED => return Err(failed(error.clone())),
            _ => {}
        }
        let Some(found) = found.map_err(failed)? else {
            continue;
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
        read.dictionary.objects.push(found);
    }
    Ok(read)
}

/// Reads one object with all subindices; `None` if the device describes no such object. Adds
/// malformed and late descriptions to `failed`; a late one ends the object.
///
/// # Errors
/// [`InfoError`] if the device stops answering. Subindices without a description are skipped,
/// because records have gaps.
pub async fn object(
    coe: &mut CoeClient,
    wire: &impl MailboxTransport,
    index: u16,
    failed: &mut Vec<InfoError>,
) -> Result<Option<Object>, InfoError> {
    let described = coe.object_description(wire, index).await;
    let Some(ObjectDescription {
        max_sub,
        code,
        name,
        ..
    }) = usable(described, failed)?
    else {
        return Ok(None);
    };
    let code = match code {
        8 => ObjectCode::Array,
        9 => ObjectCode::Record,
        _ => ObjectCode::Var,
    };
    let last = if code == ObjectCode::Var { 0 } else { max_sub };
    let mut items = Vec::new();
    let mut offset = 16;
    for sub in 0..=last {
        let entry = coe.entry_description(wire, index, sub).await;
        let late = entry.as_ref().is_err_and(InfoError::is_timeout);
        let Some(entry) = usable(entry, failed)? else {
            if late {
                break;
            }
            continue;
        };
        let mut item = item(&entry);
        if sub > 0 {
            item.bit_offset = offset;
            offset = offset.saturating_add(item.bit_len);
        }
        items.push(item);
    }
    Ok(Some(Object {
        index,
        name: name.as_str().into(),
        code,
        items,
        ..Object::default()
    }))
}

/// Returns `None` for an error that concerns one description only. A refused description is not
/// added to `failed`.
fn usable<T>(
    answer: Result<T, InfoError>,
    failed: &mut Vec<InfoError>,
) -> Result<Option<T>, InfoError> {
    match answer {
        Ok(described) => Ok(Some(described)),
        Err(error) if error.is_refusal() => Ok(None),
        Err(error) if error.is_malformed() || error.is_timeout() => {
            failed.push(error);
            Ok(None)
        }
        Err(error) => Err(error),
    }
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
