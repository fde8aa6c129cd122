//! Read and write access of CoE clients to objects.

use ecaxis_esi::model::{ObjectCode, Writable};

use super::object_dictionary::{EntryHandle, Item, ObjectStore};
use super::pdo::PdoRules;
use super::startup::StartupWrites;
use super::{Abort, datatype, history};
use crate::coe::datatype::Kind;
use crate::esc::al::AlState;
use crate::firmware::BootLoader;

const STORE_PARAMETERS: u16 = 0x1010;
const RESTORE_PARAMETERS: u16 = 0x1011;

const ASSIGNMENTS: std::ops::RangeInclusive<u16> = 0x1c10..=0x1c1f;

/// The index range of enumeration objects, which have a variable length.
const ENUMERATIONS: std::ops::Range<u16> = 0x0800..0x1000;

/// The command of a client that wrote the right word to 0x1010 or 0x1011 (CiA 301).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ParameterCommand {
    Store,
    Restore,
}

/// Subindices that the dictionary counts and the device does not have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct MissingSubindices {
    /// The last one of each object, except PDOs, their assignment and module lists.
    pub last: bool,
    /// All of 0x1C10 to 0x1C1F.
    pub assignment: bool,
}

/// The data that an SDO request works on.
#[derive(Debug)]
pub(crate) struct Dictionary<'a> {
    pub(crate) store: &'a mut ObjectStore,
    pub(crate) pdo: &'a mut PdoRules,
    pub(crate) state: AlState,
    pub(crate) complete_access: bool,
    /// The downloads that are accepted whatever the dictionary says.
    pub(crate) startup: &'a StartupWrites,
    /// Rejects writes to objects in a PDO that is currently received.
    pub(crate) refuse_mapped: bool,
    /// Injected aborts: index, subindex, code.
    pub(crate) forced: &'a [(u16, u8, u32)],
    /// Writes that are confirmed and change nothing: index, subindex.
    pub(crate) ignored: &'a [(u16, u8)],
    /// Subindices that the store has and clients do not find.
    pub(crate) missing: MissingSubindices,
    pub(crate) command: Option<ParameterCommand>,
    /// The processor, which serves the objects of its program itself.
    pub(crate) processor: Option<&'a mut BootLoader>,
}

/// Maximum size of an object under complete access. An ESI may place an item at any offset.
const MAX_OBJECT_BITS: usize = 64 << 20;

impl Dictionary<'_> {
    /// Fails with the abort that a fault script demands.
    fn check_forced(&self, index: u16, sub: u8) -> Result<(), Abort> {
        let mut forced = self.forced.iter();
        let abort = forced.find(|(i, s, _)| (*i, *s) == (index, sub));
        abort.map_or(Ok(()), |(.., code)| Err(Abort(*code)))
    }

    /// True if clients do not find this subindex, although the dictionary has it.
    fn is_missing(&self, index: u16, sub: u8) -> bool {
        let is_assignment = ASSIGNMENTS.contains(&index);
        let is_last =
            !is_assignment && !self.pdo.is_list(index) && sub == self.store.highest_sub(index);
        sub > 0 && (self.missing.assignment && is_assignment || self.missing.last && is_last)
    }

    /// Returns the entry of a subindex that clients find.
    pub(super) fn slot(&self, index: u16, sub: u8) -> Option<EntryHandle> {
        let slot = self.store.slot(index, sub);
        slot.filter(|_| !self.is_missing(index, sub))
    }

    fn find(&self, index: u16, sub: u8) -> Result<(EntryHandle, &Item), Abort> {
        self.check_forced(index, sub)?;
        let slot = self.slot(index, sub);
        slot.and_then(|slot| Some((slot, self.store.item(slot)?)))
            .ok_or(if self.store.has_object(index) {
                Abort::NO_SUBINDEX
            } else {
                Abort::NO_OBJECT
            })
    }

    /// Reads an item, or under complete access the object from subindex 0 or 1 on.
    pub(crate) fn read(&self, index: u16, sub: u8, complete: bool) -> Result<Vec<u8>, Abort> {
        if self.is_whole(index, sub, complete)? {
            return Ok(self.read_all(index, sub));
        }
        let (slot, item) = self.find(index, sub)?;
        if !item.access.read {
            return Err(Abort::WRITE_ONLY);
        }
        Ok(read_item(self.store, slot))
    }

    /// True if complete access applies to the whole object. Objects without subindices have only
    /// one item.
    fn is_whole(&self, index: u16, sub: u8, complete: bool) -> Result<bool, Abort> {
        if !complete {
            return Ok(false);
        }
        if !self.store.has_object(index) {
            return Err(Abort::NO_OBJECT);
        }
        let is_supported =
            self.complete_access || self.startup.capacity(index, sub, true).is_some();
        if !is_supported || sub > 1 {
            return Err(Abort::UNSUPPORTED_ACCESS);
        }
        if ENUMERATIONS.contains(&index) {
            return Err(Abort::VARIABLE_LENGTH);
        }
        self.check_forced(index, sub)?;
        // Subindex 1 only leaves out subindex 0; the object may begin with a later one.
        if self.places(index, sub, i64::MAX).next().is_none() {
            return Err(Abort::NO_SUBINDEX);
        }
        Ok(self.store.object_code(index) != ObjectCode::Var)
    }

    /// Returns the items of complete access with their bit offsets in the data; subindex 0 takes 16
    /// bits. Lists yield only the first `count` elements.
    fn places(
        &self,
        index: u16,
        first: u8,
        count: i64,
    ) -> impl Iterator<Item = (EntryHandle, &Item, usize)> {
        let start = if first == 0 { 0 } else { 16 };
        let list = self.pdo.is_list(index);
        self.store
            .object(index)
            .filter_map(|slot| Some((slot, self.store.item(slot)?)))
            .filter(move |(_, item)| item.sub >= first && !(list && i64::from(item.sub) > count))
            .filter(move |(_, item)| !self.is_missing(index, item.sub))
            .map(move |(slot, item)| (slot, item, (item.bit_offset as usize).saturating_sub(start)))
    }

    fn count(&self, index: u16) -> i64 {
        let count = self.store.slot(index, 0);
        count.map_or(0, |slot| self.store.get(slot))
    }

    /// Reads the whole object. Gaps and unreadable items are zero.
    fn read_all(&self, index: u16, first: u8) -> Vec<u8> {
        let mut out = Vec::new();
        for (slot, item, at) in self.places(index, first, self.count(index)) {
            let bits = item.bit_len as usize;
            let padded = if item.sub == 0 { bits.max(16) } else { bits };
            if at + padded > MAX_OBJECT_BITS {
                continue;
            }
            out.resize(out.len().max((at + padded).div_ceil(8)), 0);
            if item.access.read {
                crate::bits::copy(&mut out, at, self.store.bytes(slot), 0, bits);
            }
        }
        out
    }

    /// Checks that an item may be written now, regardless of the value.
    fn check_access(&self, item: &Item) -> Result<(), Abort> {
        match (item.access.write, self.state) {
            (Writable::Never, _) => return Err(Abort::READ_ONLY),
            (Writable::Only { pre_op: true, .. }, AlState::PreOp)
            | (Writable::Only { safe_op: true, .. }, AlState::SafeOp)
            | (Writable::Only { op: true, .. }, AlState::Op)
            | (Writable::Always, _) => {}
            (Writable::Only { .. }, _) => return Err(Abort::WRONG_STATE),
        }
        let running = matches!(self.state, AlState::SafeOp | AlState::Op);
        if self.refuse_mapped && running && self.pdo.receives(self.store, item.index, item.sub) {
            return Err(Abort::MAPPED);
        }
        Ok(())
    }

    /// Returns the maximum bytes of a download, so that a transfer that cannot succeed is rejected
    /// at once.
    pub(crate) fn capacity(&self, index: u16, sub: u8, complete: bool) -> Result<usize, Abort> {
        let startup = self.startup.capacity(index, sub, complete);
        let by_dictionary = self.capacity_by_dictionary(index, sub, complete);
        match (startup, by_dictionary) {
            (Some(startup), Ok(capacity)) => Ok(startup.max(capacity)),
            (Some(startup), Err(Abort::READ_ONLY | Abort::WRONG_STATE)) => Ok(startup),
            (_, by_dictionary) => by_dictionary,
        }
    }

    fn capacity_by_dictionary(&self, index: u16, sub: u8, complete: bool) -> Result<usize, Abort> {
        if self.is_whole(index, sub, complete)? {
            let ends = self.places(index, sub, i64::MAX).map(|(_, item, at)| {
                at + (item.bit_len as usize).max(if item.sub == 0 { 16 } else { 0 })
            });
            return Ok(ends.max().unwrap_or(0).div_ceil(8));
        }
        let (_, item) = self.find(index, sub)?;
        self.check_access(item)?;
        match &self.processor {
            Some(processor) if processor.serves(index, sub) => processor.capacity(index),
            _ => Ok(item.bit_len.div_ceil(8) as usize),
        }
    }

    pub(crate) fn write(
        &mut self,
        index: u16,
        sub: u8,
        complete: bool,
        data: &[u8],
    ) -> Result<(), Abort> {
        let is_startup = self.startup.contains(index, sub, complete, data);
        match self.is_whole(index, sub, complete)? {
            true if is_startup => self.overwrite_all(index, sub, data),
            true => self.write_all(index, sub, data),
            false => self.write_item(index, sub, data, is_startup),
        }
    }

    /// Writes an item. A start-up download is written as far as the item reaches.
    fn write_item(
        &mut self,
        index: u16,
        sub: u8,
        data: &[u8],
        is_startup: bool,
    ) -> Result<(), Abort> {
        let (_, item) = self.find(index, sub)?;
        if !is_startup {
            self.check_access(item)?;
        }
        if let Some(processor) = &mut self.processor
            && processor.serves(index, sub)
        {
            return processor.write(index, data, self.state);
        }
        let (slot, item) = self.find(index, sub)?;
        if !is_startup {
            check_length(item, data)?;
        }
        if matches!(index, STORE_PARAMETERS | RESTORE_PARAMETERS) && sub > 0 {
            self.command = Some(command(index, data)?);
            return Ok(());
        }
        if !is_startup {
            check_range(item, data)?;
        }
        if item.ignores_writes || self.ignored.contains(&(index, sub)) {
            return Ok(());
        }
        if history::is_acknowledgement(index, sub) {
            let up_to = data.first().copied().unwrap_or(0);
            return history::acknowledge(self.store, up_to);
        }
        let value = low_bits(data);
        self.pdo
            .before_write(self.store, index, sub, value, self.state)?;
        let bytes = self.store.bytes_mut(slot);
        for (n, byte) in bytes.iter_mut().enumerate() {
            *byte = data.get(n).copied().unwrap_or(0);
        }
        self.pdo.after_write(self.store, index, sub, value);
        Ok(())
    }

    /// Writes a complete-access download. Read-only items keep their values. Data that end between
    /// two items leave the remaining items unchanged. Lists (PDO assignment and mapping) are
    /// emptied first and get their count last, like item by item writes.
    fn write_all(&mut self, index: u16, first: u8, data: &[u8]) -> Result<(), Abort> {
        let list = self.pdo.is_list(index);
        let count = match data.first() {
            Some(count) if list && first == 0 => i64::from(*count),
            _ => i64::MAX,
        };
        let mut values = Vec::new();
        let mut refused = Abort::READ_ONLY;
        for (_, item, at) in self.places(index, first, count) {
            let bits = item.bit_len as usize;
            let left = (data.len() * 8).saturating_sub(at);
            if left == 0 && count == i64::MAX {
                break;
            }
            if left < bits {
                return Err(Abort::TOO_SHORT);
            }
            match self.check_access(item) {
                Ok(()) => {}
                Err(Abort::READ_ONLY) => continue,
                Err(abort) => {
                    refused = abort;
                    continue;
                }
            }
            let mut value = vec![0; bits.div_ceil(8)];
            crate::bits::copy(&mut value, 0, data, at, bits);
            values.push((item.sub, value));
        }
        if values.is_empty() {
            return Err(refused);
        }
        if list && first == 0 {
            self.write_item(index, 0, &[0], false)?;
            // Moves the count to the end.
            values.rotate_left(1);
        }
        values
            .iter()
            .try_for_each(|(sub, value)| self.write_item(index, *sub, value, false))
    }

    /// Writes a complete-access start-up download as far as the items reach.
    fn overwrite_all(&mut self, index: u16, first: u8, data: &[u8]) -> Result<(), Abort> {
        let places: Vec<_> = self
            .places(index, first, i64::MAX)
            .map(|(slot, item, at)| (slot, at, item.bit_len as usize))
            .collect();
        for (slot, at, bits) in places {
            crate::bits::copy(self.store.bytes_mut(slot), 0, data, at, bits);
        }
        Ok(())
    }
}

fn check_length(item: &Item, data: &[u8]) -> Result<(), Abort> {
    let len = item.bit_len.div_ceil(8) as usize;
    if data.len() > len {
        return Err(Abort::TOO_LONG);
    }
    if data.len() < len && item.kind != Kind::Text {
        return Err(Abort::TOO_SHORT);
    }
    Ok(())
}

fn check_range(item: &Item, data: &[u8]) -> Result<(), Abort> {
    let (min, max) = (item.min.as_deref(), item.max.as_deref());
    datatype::check(item.kind, item.bit_len, data, min, max)?;
    match item.choices {
        Some(choices) if !choices.contains(&extended(data)) => Err(Abort::VALUE),
        _ => Ok(()),
    }
}

/// Returns the bytes of an upload. A text ends before its padding.
pub(crate) fn read_item(store: &ObjectStore, slot: EntryHandle) -> Vec<u8> {
    let bytes = store.bytes(slot);
    if store.item(slot).is_some_and(|item| item.kind == Kind::Text) {
        let len = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
        return bytes.get(..len.max(1)).unwrap_or(bytes).to_vec();
    }
    bytes.to_vec()
}

/// Returns the command of a write to 0x1010 or 0x1011. Fails without the right signature (CiA 301).
fn command(index: u16, data: &[u8]) -> Result<ParameterCommand, Abort> {
    match (index, data) {
        (STORE_PARAMETERS, b"save") => Ok(ParameterCommand::Store),
        (RESTORE_PARAMETERS, b"load") => Ok(ParameterCommand::Restore),
        _ => Err(Abort::NOT_STORED),
    }
}

/// Returns the value as two's complement; long values yield their low 64 bits.
fn extended(data: &[u8]) -> i64 {
    let negative = data.last().is_some_and(|last| last & 0x80 != 0);
    let mut raw = [if negative { 0xff } else { 0 }; 8];
    for (to, from) in raw.iter_mut().zip(data) {
        *to = *from;
    }
    i64::from_le_bytes(raw)
}

/// Returns the low bits for the PDO rules, whose objects are unsigned and at most 32 bits.
fn low_bits(data: &[u8]) -> i64 {
    let mut raw = [0; 8];
    for (to, from) in raw.iter_mut().zip(data.iter().take(7)) {
        *to = *from;
    }
    i64::from_le_bytes(raw)
}
