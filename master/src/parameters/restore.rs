//! Values written back into a device.

use ecaxis_esi::Dictionary;

use super::compare::Difference;
use super::rules::{Write, is_list, is_setting, order, that_count};
use super::{Parameter, writable_in_pre_op};
use crate::bringup::DeviceRef;
use crate::mailbox::{CoeClient, ObjectAddress, SdoError, Wire, abort_text};
use crate::service::ServiceError;

/// Settings limit each other; what is refused is tried again after the others, as long as that helps.
const PASSES: usize = 8;

/// How it went.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Restored {
    /// Subindices that had another value, and were written.
    pub written: usize,
    /// Subindices that had the value already.
    pub same: usize,
    /// Settings of the file that the device does not have, or does not let be written.
    pub missing: Vec<ObjectAddress>,
    /// Refused to the end, with the abort code.
    pub refused: Vec<(ObjectAddress, u32)>,
    /// Read back, and not what was written.
    pub differing: Vec<Difference>,
}

impl Restored {
    #[must_use]
    pub fn complete(&self) -> bool {
        self.missing.is_empty() && self.refused.is_empty() && self.differing.is_empty()
    }
}

/// What `device` says to one object.
struct Device<'a, W> {
    coe: &'a mut CoeClient,
    wire: &'a W,
    device: &'a DeviceRef,
}

impl<W: Wire> Device<'_, W> {
    /// The abort code where the device refuses.
    fn refusal<T>(&self, result: Result<T, SdoError>) -> Result<Result<T, u32>, ServiceError> {
        match result {
            Ok(value) => Ok(Ok(value)),
            Err(SdoError::Abort { code, .. }) => Ok(Err(code)),
            Err(source) => Err(ServiceError::Sdo {
                device: self.device.clone(),
                source,
            }),
        }
    }

    async fn read(&mut self, at: ObjectAddress) -> Result<Result<Vec<u8>, u32>, ServiceError> {
        let read = self.coe.upload(self.wire, at.index, at.sub, false).await;
        self.refusal(read)
    }

    async fn write(&mut self, write: Write<'_>) -> Result<Result<(), u32>, ServiceError> {
        let (index, sub, value) = match write {
            Write::Empty(index) => (index, 0, &[0_u8][..]),
            Write::Value(p) => (p.at.index, p.at.sub, p.value.as_slice()),
        };
        let written = self.coe.download(self.wire, index, sub, false, value).await;
        self.refusal(written)
    }
}

/// Writes those settings of `parameters` that the device has and that differ, in a safe order, and reads them back. The
/// device is in PreOp. `progress` is told writes done and writes there are.
///
/// # Errors
/// [`ServiceError::Sdo`] where the device stops answering. What it refuses is part of the result.
pub async fn restore(
    coe: &mut CoeClient,
    wire: &impl Wire,
    device: &DeviceRef,
    dictionary: &Dictionary,
    parameters: &[Parameter],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Restored, ServiceError> {
    let mut device = Device { coe, wire, device };
    let mut restored = Restored::default();
    let mut wanted = Vec::new();
    let mut differing: Vec<ObjectAddress> = Vec::new();
    for parameter in that_count(parameters).into_iter().filter(|p| is_setting(p)) {
        let item = dictionary.item(parameter.at.index, parameter.at.sub);
        if !item.is_some_and(writable_in_pre_op) {
            restored.missing.push(parameter.at);
            continue;
        }
        match device.read(parameter.at).await? {
            Ok(value) if value == parameter.value => restored.same += 1,
            // What cannot be read can still be written.
            Ok(_) | Err(_) => differing.push(parameter.at),
        }
        wanted.push(parameter);
    }
    let writes = order(&wanted, |p| differing.contains(&p.at));
    let mut left = Vec::new();
    for (n, write) in writes.iter().enumerate() {
        progress(n, writes.len());
        match (device.write(*write).await?, write) {
            (Err(code), Write::Value(parameter)) if is_list(parameter.at.index) => {
                restored.refused.push((parameter.at, code));
            }
            (Err(code), Write::Value(parameter)) => left.push((*parameter, code)),
            // That a list cannot be emptied shows in its elements.
            (Err(_), Write::Empty(_)) | (Ok(()), _) => {}
        }
    }
    for _ in 1..PASSES {
        let mut still = Vec::new();
        for (parameter, _) in &left {
            if let Err(code) = device.write(Write::Value(parameter)).await? {
                still.push((*parameter, code));
            }
        }
        let helped = still.len() < left.len();
        left = still;
        if !helped {
            break;
        }
    }
    let refused = left.iter().map(|(parameter, code)| (parameter.at, *code));
    restored.refused.extend(refused);
    for parameter in wanted {
        let tried = writes.contains(&Write::Value(parameter));
        let refused = restored.refused.iter().any(|(at, _)| *at == parameter.at);
        if !tried || refused {
            continue;
        }
        let right = match device.read(parameter.at).await? {
            Ok(value) if value == parameter.value => {
                restored.written += usize::from(differing.contains(&parameter.at));
                continue;
            }
            Ok(value) => Some(parameter.data_type.show(&value)),
            Err(code) => Some(format!("not readable ({code:#010x}: {})", abort_text(code))),
        };
        restored.differing.push(Difference {
            at: parameter.at,
            name: parameter.name.clone(),
            left: Some(parameter.shown()),
            right,
        });
    }
    Ok(restored)
}
