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

/// A restore that broke off.
#[derive(Debug, thiserror::Error)]
#[error("{source}{}", self.left())]
pub struct RestoreError {
    pub source: ServiceError,
    /// Writes that the device has confirmed.
    pub written: usize,
    /// Writes that there were to be; 0 where it broke off before the first.
    pub of: usize,
    /// Lists that may have been emptied and were not filled again.
    pub emptied: Vec<u16>,
}

impl RestoreError {
    /// In which condition the device is left, behind what failed.
    #[must_use]
    pub fn left(&self) -> String {
        let mut text = match (self.written, self.of) {
            (0, _) if self.emptied.is_empty() => return "; nothing was written".to_owned(),
            (written, of) => format!("; {written} of {of} writes were done"),
        };
        if !self.emptied.is_empty() {
            let at = |index: &u16| ObjectAddress {
                index: *index,
                sub: 0,
            };
            let lists: Vec<String> = self.emptied.iter().map(|i| at(i).to_string()).collect();
            text += &format!(", and left empty: {}", lists.join(", "));
        }
        text
    }
}

/// How far the writing is.
#[derive(Debug, Default)]
struct Course {
    written: usize,
    of: usize,
    /// Lists that are still to be filled.
    open: Vec<u16>,
    /// Emptied lists that the device does not let be filled.
    lost: Vec<u16>,
}

impl Course {
    fn broke_off(self, source: ServiceError) -> RestoreError {
        RestoreError {
            source,
            written: self.written,
            of: self.of,
            emptied: self.lost.into_iter().chain(self.open).collect(),
        }
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

impl<W: Wire> Device<'_, W> {
    /// Notes what becomes of lists.
    async fn follow(
        &mut self,
        write: Write<'_>,
        course: &mut Course,
    ) -> Result<Result<(), u32>, ServiceError> {
        // Whether a request got there is not known before it is answered.
        let list = match write {
            Write::Empty(index) => {
                course.open.push(index);
                index
            }
            Write::Value(parameter) => parameter.at.index,
        };
        let answer = self.write(write).await?;
        let settled = match (write, &answer) {
            (Write::Empty(_), Err(_)) => true,
            (Write::Value(parameter), _) => parameter.at.sub == 0,
            (Write::Empty(_), Ok(())) => false,
        };
        if settled && course.open.contains(&list) {
            course.open.retain(|index| *index != list);
            if matches!(write, Write::Value(_)) && answer.is_err() {
                course.lost.push(list);
            }
        }
        course.written += usize::from(answer.is_ok());
        Ok(answer)
    }
}

/// Writes those settings of `parameters` that the device has and that differ, in a safe order, and reads them back. The
/// device is in PreOp. `progress` is told writes done and writes there are. Who ends it ends it where no list is empty.
///
/// # Errors
/// [`ServiceError::Sdo`] where the device stops answering, with how it is left. What it refuses is part of the result.
pub async fn restore(
    coe: &mut CoeClient,
    wire: &impl Wire,
    device: &DeviceRef,
    dictionary: &Dictionary,
    parameters: &[Parameter],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Restored, RestoreError> {
    let mut course = Course::default();
    let mut device = Device { coe, wire, device };
    let whole = device.restore(dictionary, parameters, progress, &mut course);
    let done = wire.stop().hold(whole).await;
    done.map_err(|source| course.broke_off(source))
}

impl<W: Wire> Device<'_, W> {
    /// Ends here where somebody wants it to.
    fn go_on(&self, course: &Course) -> Result<(), ServiceError> {
        if !self.wire.stop().is_asked() || !course.open.is_empty() {
            return Ok(());
        }
        Err(ServiceError::Stopped {
            device: self.device.clone(),
            step: "restoring its settings",
        })
    }

    async fn restore(
        &mut self,
        dictionary: &Dictionary,
        parameters: &[Parameter],
        progress: &mut dyn FnMut(usize, usize),
        course: &mut Course,
    ) -> Result<Restored, ServiceError> {
        let mut restored = Restored::default();
        let mut wanted = Vec::new();
        let mut differing: Vec<ObjectAddress> = Vec::new();
        for parameter in that_count(parameters).into_iter().filter(|p| is_setting(p)) {
            self.go_on(course)?;
            let item = dictionary.item(parameter.at.index, parameter.at.sub);
            if !item.is_some_and(writable_in_pre_op) {
                restored.missing.push(parameter.at);
                continue;
            }
            match self.read(parameter.at).await? {
                Ok(value) if value == parameter.value => restored.same += 1,
                // What cannot be read can still be written.
                Ok(_) | Err(_) => differing.push(parameter.at),
            }
            wanted.push(parameter);
        }
        let writes = order(&wanted, |p| differing.contains(&p.at));
        course.of = writes.len();
        let mut left = Vec::new();
        for (n, write) in writes.iter().enumerate() {
            self.go_on(course)?;
            progress(n, writes.len());
            match (self.follow(*write, course).await?, write) {
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
                self.go_on(course)?;
                if let Err(code) = self.follow(Write::Value(parameter), course).await? {
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
            self.go_on(course)?;
            let tried = writes.contains(&Write::Value(parameter));
            let refused = restored.refused.iter().any(|(at, _)| *at == parameter.at);
            if !tried || refused {
                continue;
            }
            let right = match self.read(parameter.at).await? {
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
}
