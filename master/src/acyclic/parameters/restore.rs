//! Writes values to a device.

use std::fmt;

use crate::acyclic::DeviceRef;
use crate::mailbox::{CoeClient, MailboxTransport, NamedObject, SdoError, abort_text};
use crate::report::{Cause, Error};
use ecaxis_esi::Dictionary;

use super::compare::Difference;
use super::restore_order::{Write, is_list, order, settings_only};
use crate::parameters::class::{Class, CopyRule};
use crate::parameters::{Parameter, writable_in_pre_op};

/// The maximum number of passes. Settings limit each other, so refused writes are retried after the
/// others.
const PASSES: usize = 8;

/// The result of a restore.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Restored {
    /// The subindices that differed and were written.
    pub written: Vec<Change>,
    /// The number of subindices that had the value already.
    pub same: usize,
    /// Writable parameters of the file that are not copied.
    pub skipped: Vec<Skipped>,
    /// Settings that the device does not have or does not allow to write.
    pub missing: Vec<NamedObject>,
    /// Settings that were refused in every pass, with the abort code.
    pub refused: Vec<(NamedObject, u32)>,
    /// Settings whose read-back value differs.
    pub differing: Vec<Difference>,
}

/// A value that was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Change {
    pub at: NamedObject,
    pub name: String,
    pub class: Class,
    /// The value before; `None` if it is not readable.
    pub before: Option<String>,
    pub after: String,
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let before = self.before.as_deref().unwrap_or("?");
        write!(f, "{} {before} → {}", self.at.number(), self.after)
    }
}

/// A parameter that is not copied.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Skipped {
    pub at: NamedObject,
    pub name: String,
    pub class: Class,
    /// What the object is, where that decides its class.
    pub what: &'static str,
    /// The value of the file.
    pub value: String,
    /// The value of the device, if it is data of a unit and differs.
    pub kept: Option<String>,
}

impl fmt::Display for Skipped {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.at.number())?;
        if !self.what.is_empty() {
            write!(f, " ({})", self.what)?;
        }
        match &self.kept {
            Some(kept) => write!(f, ": {kept} kept, {} in the file", self.value),
            None => Ok(()),
        }
    }
}

fn lines<T: fmt::Display>(
    verb: &str,
    all: &[T],
    class_of: impl Fn(&T) -> Class,
) -> impl Iterator<Item = String> {
    Class::ALL.iter().filter_map(move |&class| {
        let each = all.iter().filter(|one| class_of(one) == class);
        let each: Vec<_> = each.map(ToString::to_string).collect();
        (!each.is_empty()).then(|| format!("{verb} ({class}): {}", each.join(", ")))
    })
}

impl Restored {
    /// Returns a line for each class with what was written.
    pub fn lines_of_written(&self) -> impl Iterator<Item = String> {
        lines("written", &self.written, |change| change.class)
    }

    /// Returns a line for each class with what was not copied.
    pub fn lines_of_skipped(&self) -> impl Iterator<Item = String> {
        lines("not written", &self.skipped, |skipped| skipped.class)
    }

    #[must_use]
    pub fn complete(&self) -> bool {
        self.missing.is_empty() && self.refused.is_empty() && self.differing.is_empty()
    }
}

/// An incomplete restore.
#[derive(Debug, thiserror::Error)]
#[error("{source}{}", self.left())]
pub struct RestoreError {
    pub source: Box<Error>,
    /// The number of confirmed writes.
    pub written: usize,
    /// The number of planned writes; 0 if it ended before the first.
    pub of: usize,
    /// Lists that may be empty because they were not refilled.
    pub emptied: Vec<u16>,
}

impl RestoreError {
    /// Describes the state in which the device is left.
    #[must_use]
    pub fn left(&self) -> String {
        let mut text = match (self.written, self.of) {
            (0, _) if self.emptied.is_empty() => return "; nothing was written".to_owned(),
            (written, of) => format!("; {written} of {of} writes were done"),
        };
        if !self.emptied.is_empty() {
            let at = |index: &u16| NamedObject {
                index: *index,
                sub: 0,
            };
            let lists: Vec<String> = self.emptied.iter().map(|i| at(i).to_string()).collect();
            text += &format!(", and left empty: {}", lists.join(", "));
        }
        text
    }
}

/// The progress of the writes.
#[derive(Debug, Default)]
struct RestoreProgress {
    written: usize,
    of: usize,
    /// Lists that must still be filled.
    open: Vec<u16>,
    /// Emptied lists that the device refuses to fill.
    lost: Vec<u16>,
}

impl RestoreProgress {
    fn aborted(self, source: Error) -> RestoreError {
        RestoreError {
            source: Box::new(source),
            written: self.written,
            of: self.of,
            emptied: self.lost.into_iter().chain(self.open).collect(),
        }
    }
}

/// Access to the objects of `device`.
struct Device<'a, W> {
    coe: &'a mut CoeClient,
    wire: &'a W,
    device: &'a DeviceRef,
}

impl<W: MailboxTransport> Device<'_, W> {
    /// Returns the abort code if the device refuses the object.
    fn refusal<T>(&self, result: Result<T, SdoError>) -> Result<Result<T, u32>, Error> {
        result.map(Ok).or_else(|error| match error.abort_code() {
            Some(code) => Ok(Err(code)),
            None => Err(Cause::Sdo(error).with_device(self.device)),
        })
    }

    async fn read(&mut self, at: NamedObject) -> Result<Result<Vec<u8>, u32>, Error> {
        let read = self.coe.upload(self.wire, at.index, at.sub, false).await;
        self.refusal(read)
    }

    async fn write(&mut self, write: Write<'_>) -> Result<Result<(), u32>, Error> {
        let (index, sub, value) = match write {
            Write::Empty(index) => (index, 0, &[0_u8][..]),
            Write::Value(p) => (p.at.index, p.at.sub, p.value.as_slice()),
        };
        let written = self.coe.download(self.wire, index, sub, false, value).await;
        self.refusal(written)
    }
}

impl<W: MailboxTransport> Device<'_, W> {
    /// Tracks which lists are empty.
    async fn follow(
        &mut self,
        write: Write<'_>,
        course: &mut RestoreProgress,
    ) -> Result<Result<(), u32>, Error> {
        // A request may have taken effect even without an answer.
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

/// Writes the settings of `parameters` that `rule` copies, that exist and that differ, in a safe
/// order, and reads them back. Without a dictionary all exist. The device must be in PreOp.
/// `progress` receives the completed and planned writes. A cancellation takes effect when no list
/// is empty.
///
/// # Errors
/// [`Cause::Sdo`] with the remaining state if the device stops answering. Refused objects
/// are part of the result.
pub async fn restore(
    coe: &mut CoeClient,
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    dictionary: Option<&Dictionary>,
    (parameters, rule): (&[Parameter], CopyRule),
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Restored, RestoreError> {
    let mut course = RestoreProgress::default();
    let mut device = Device { coe, wire, device };
    let whole = device.restore(dictionary, (parameters, rule), progress, &mut course);
    let done = wire.stop().shield(whole).await;
    done.map_err(|source| course.aborted(source))
}

impl<W: MailboxTransport> Device<'_, W> {
    /// Fails if a cancellation was requested.
    fn go_on(&self, course: &RestoreProgress) -> Result<(), Error> {
        if !self.wire.stop().is_cancelled() || !course.open.is_empty() {
            return Ok(());
        }
        Err(Cause::Interrupted
            .with_device(self.device)
            .with_action("restoring its settings"))
    }

    /// Returns the report on a parameter that is not copied.
    async fn skip(&mut self, parameter: &Parameter, rule: CopyRule) -> Result<Skipped, Error> {
        let (class, what) = rule.class(parameter);
        // Other classes are not read: the value of a command says nothing.
        let kept = match class {
            Class::Unit => self.read(parameter.at).await?.ok(),
            _ => None,
        };
        let kept = kept.filter(|value| *value != parameter.value);
        Ok(Skipped {
            at: parameter.at,
            name: parameter.name.clone(),
            class,
            what,
            value: parameter.shown(),
            kept: kept.map(|value| parameter.data_type.show(&value)),
        })
    }

    async fn restore(
        &mut self,
        dictionary: Option<&Dictionary>,
        (parameters, rule): (&[Parameter], CopyRule),
        progress: &mut dyn FnMut(usize, usize),
        course: &mut RestoreProgress,
    ) -> Result<Restored, Error> {
        let mut restored = Restored::default();
        let mut wanted = Vec::new();
        let mut differing: Vec<(NamedObject, Option<String>)> = Vec::new();
        for parameter in settings_only(parameters) {
            self.go_on(course)?;
            if !parameter.writable {
                continue;
            }
            if !rule.copies(parameter) {
                restored.skipped.push(self.skip(parameter, rule).await?);
                continue;
            }
            let exists = dictionary.is_none_or(|dictionary| {
                let item = dictionary.item(parameter.at.index, parameter.at.sub);
                item.is_some_and(writable_in_pre_op)
            });
            if !exists {
                restored.missing.push(parameter.at);
                continue;
            }
            match self.read(parameter.at).await? {
                Ok(value) if value == parameter.value => restored.same += 1,
                Ok(value) => {
                    let before = parameter.data_type.show(&value);
                    differing.push((parameter.at, Some(before)));
                }
                // Unreadable objects may be writable.
                Err(_) => differing.push((parameter.at, None)),
            }
            wanted.push(parameter);
        }
        let differs = |p: &Parameter| differing.iter().find(|(at, _)| *at == p.at);
        let writes = order(&wanted, |p| differs(p).is_some());
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
                // If a list cannot be emptied, its elements fail as well.
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
                    let changed = differs(parameter).map(|(at, before)| Change {
                        at: *at,
                        name: parameter.name.clone(),
                        class: rule.class(parameter).0,
                        before: before.clone(),
                        after: parameter.shown(),
                    });
                    restored.written.extend(changed);
                    continue;
                }
                Ok(value) => Some(parameter.data_type.show(&value)),
                Err(code) => Some(format!("not readable ({code:#010x}: {})", abort_text(code))),
            };
            restored.differing.push(Difference {
                at: parameter.at,
                name: parameter.name.clone(),
                class: rule.class(parameter).0,
                left: Some(parameter.shown()),
                right,
                meanings: [parameter.meaning(), None],
            });
        }
        Ok(restored)
    }
}
