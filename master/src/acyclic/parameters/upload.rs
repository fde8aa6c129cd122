//! Reads every readable object.

use crate::acyclic::DeviceRef;
use crate::mailbox::{CoeClient, MailboxTransport, NamedObject};
use crate::report::{Cause, Error};
use ecaxis_esi::Dictionary;

use crate::parameters::{Parameter, items, name_of, type_of, writable_in_pre_op};

/// The values of a device.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct UploadResult {
    /// Sorted by index and subindex.
    pub parameters: Vec<Parameter>,
    /// Objects declared readable that were refused, with the abort code.
    pub refused: Vec<(NamedObject, u32)>,
}

/// Reads the objects one by one. `progress` receives the number of completed and of all subindices.
///
/// # Errors
/// [`Cause::Sdo`] if the device stops answering. A refused object is not an error.
pub async fn collect(
    coe: &mut CoeClient,
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    dictionary: &Dictionary,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<UploadResult, Error> {
    let mut readable: Vec<_> = items(dictionary)
        .filter(|(_, item)| item.access.read && item.bit_len > 0)
        .collect();
    readable.sort_by_key(|(object, item)| (object.index, item.sub));
    readable.dedup_by_key(|(object, item)| (object.index, item.sub));
    let mut collected = UploadResult::default();
    for (n, (object, item)) in readable.iter().enumerate() {
        progress(n, readable.len());
        let at = NamedObject {
            index: object.index,
            sub: item.sub,
        };
        match coe.upload(wire, at.index, at.sub, false).await {
            Ok(value) => collected.parameters.push(Parameter {
                at,
                name: name_of(object, item),
                data_type: type_of(item),
                writable: writable_in_pre_op(item),
                value,
            }),
            Err(error) => match error.abort_code() {
                Some(code) => collected.refused.push((at, code)),
                None => return Err(Cause::Sdo(error).with_device(device)),
            },
        }
    }
    Ok(collected)
}
