//! Every readable object with its value.

use ecaxis_esi::Dictionary;

use super::{Parameter, items, name_of, type_of, writable_in_pre_op};
use crate::bringup::DeviceRef;
use crate::mailbox::{CoeClient, ObjectAddress, SdoError, Wire};
use crate::service::ServiceError;

/// What a device holds.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Collected {
    /// By index and subindex, rising.
    pub parameters: Vec<Parameter>,
    /// Called readable, and refused.
    pub refused: Vec<(ObjectAddress, u32)>,
}

/// Reads them one by one. `progress` is told subindices done and subindices there are.
///
/// # Errors
/// [`ServiceError::Sdo`] where the device stops answering; that it refuses an object is none.
pub async fn collect(
    coe: &mut CoeClient,
    wire: &impl Wire,
    device: &DeviceRef,
    dictionary: &Dictionary,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Collected, ServiceError> {
    let mut readable: Vec<_> = items(dictionary)
        .filter(|(_, item)| item.access.read && item.bit_len > 0)
        .collect();
    readable.sort_by_key(|(object, item)| (object.index, item.sub));
    readable.dedup_by_key(|(object, item)| (object.index, item.sub));
    let mut collected = Collected::default();
    for (n, (object, item)) in readable.iter().enumerate() {
        progress(n, readable.len());
        let at = ObjectAddress {
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
            Err(SdoError::Abort { code, .. }) => collected.refused.push((at, code)),
            Err(source) => {
                return Err(ServiceError::Sdo {
                    device: device.clone(),
                    source,
                });
            }
        }
    }
    Ok(collected)
}
