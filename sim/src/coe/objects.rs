//! Objects as a CoE client may read and write them.

use ecaxis_esi::model::Writable;

use super::Abort;
use super::pdo::PdoRules;
use super::store::{ObjectStore, Slot};
use crate::esc::al::AlState;

/// What an SDO request works on.
#[derive(Debug)]
pub(crate) struct Dictionary<'a> {
    pub(crate) store: &'a mut ObjectStore,
    pub(crate) pdo: &'a mut PdoRules,
    pub(crate) state: AlState,
    pub(crate) complete_access: bool,
    /// Injected aborts: index, subindex, code.
    pub(crate) forced: &'a [(u16, u8, u32)],
}

impl Dictionary<'_> {
    fn find(&self, index: u16, sub: u8) -> Result<Slot, Abort> {
        if let Some((.., code)) = self
            .forced
            .iter()
            .find(|(i, s, _)| (*i, *s) == (index, sub))
        {
            return Err(Abort(*code));
        }
        self.store
            .slot(index, sub)
            .ok_or(if self.store.has_object(index) {
                Abort::NO_SUBINDEX
            } else {
                Abort::NO_OBJECT
            })
    }

    pub(crate) fn read(&self, index: u16, sub: u8) -> Result<Vec<u8>, Abort> {
        let slot = self.find(index, sub)?;
        if self.store.item(slot).is_some_and(|item| !item.access.read) {
            return Err(Abort::WRITE_ONLY);
        }
        Ok(read_item(self.store, slot))
    }

    /// All subindices from `first` (0 or 1) on, packed; subindex 0 takes 16 bits.
    pub(crate) fn read_all(&self, index: u16, first: u8) -> Result<Vec<u8>, Abort> {
        let start = self.check_complete(index, first)?;
        let count = self
            .store
            .slot(index, 0)
            .map_or(0, |slot| self.store.get(slot));
        let mut out = Vec::new();
        for slot in self.store.object(index) {
            let Some(item) = self.store.item(slot) else {
                continue;
            };
            let beyond = self.pdo.is_list(index) && i64::from(item.sub) > count;
            if item.sub < first || beyond || !item.access.read {
                continue;
            }
            let at = usize::try_from(item.bit_offset)
                .unwrap_or(0)
                .saturating_sub(start);
            let bits = usize::try_from(item.bit_len).unwrap_or(0);
            let padded = if item.sub == 0 { 16 } else { bits };
            out.resize(out.len().max((at + padded).div_ceil(8)), 0);
            crate::bits::copy(&mut out, at, self.store.bytes(slot), 0, bits);
        }
        Ok(out)
    }

    fn check_complete(&self, index: u16, first: u8) -> Result<usize, Abort> {
        self.find(index, first)?;
        if !self.complete_access {
            return Err(Abort::NO_COMPLETE_ACCESS);
        }
        match first {
            0 => Ok(0),
            1 => Ok(16),
            _ => Err(Abort::NO_SUBINDEX),
        }
    }

    pub(crate) fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        let slot = self.find(index, sub)?;
        let Some(item) = self.store.item(slot) else {
            return Err(Abort::NO_OBJECT);
        };
        match (item.access.write, self.state) {
            (Writable::Never, _) => return Err(Abort::READ_ONLY),
            (Writable::Only { pre_op: true, .. }, AlState::PreOp)
            | (Writable::Only { safe_op: true, .. }, AlState::SafeOp)
            | (Writable::Only { op: true, .. }, AlState::Op)
            | (Writable::Always, _) => {}
            (Writable::Only { .. }, _) => return Err(Abort::WRONG_STATE),
        }
        let len = usize::try_from(item.bit_len.div_ceil(8)).unwrap_or(0);
        if data.len() > len {
            return Err(Abort::TOO_LONG);
        }
        if data.len() < len && !item.text {
            return Err(Abort::TOO_SHORT);
        }
        if item.bit_len <= 64 && !item.text {
            let value = value_of(data, item.signed);
            if let (Some(min), Some(max)) = (item.min, item.max)
                && min < max
            {
                if value > max {
                    return Err(Abort::VALUE_TOO_HIGH);
                }
                if value < min {
                    return Err(Abort::VALUE_TOO_LOW);
                }
            }
            if let Some(choices) = item.choices
                && !choices.contains(&value_of(data, true))
            {
                return Err(Abort::VALUE);
            }
            self.pdo
                .before_write(self.store, index, sub, value, self.state)?;
            self.store.set(slot, value);
            self.pdo.after_write(self.store, index, sub, value);
        } else {
            let bytes = self.store.bytes_mut(slot);
            let (head, tail) = bytes.split_at_mut(data.len());
            head.copy_from_slice(data);
            tail.fill(0);
        }
        Ok(())
    }

    /// Most bytes a download may carry, so that a too long one is refused at once.
    pub(crate) fn capacity(&self, index: u16, sub: u8, complete: bool) -> Result<usize, Abort> {
        if complete {
            let start = self.check_complete(index, sub)?;
            let bits = self
                .store
                .object(index)
                .filter_map(|slot| self.store.item(slot))
                .map(|item| item.bit_offset + item.bit_len.max(if item.sub == 0 { 16 } else { 0 }))
                .max();
            let bytes = bits.unwrap_or(0).div_ceil(8);
            return Ok(usize::try_from(bytes)
                .unwrap_or(0)
                .saturating_sub(start / 8));
        }
        let slot = self.find(index, sub)?;
        let bits = self.store.item(slot).map_or(0, |item| item.bit_len);
        Ok(usize::try_from(bits.div_ceil(8)).unwrap_or(0))
    }

    /// A complete-access download. Lists (PDO assignment and mapping) are emptied first and get
    /// their count last, as if the client had done it item by item.
    pub(crate) fn write_all(&mut self, index: u16, first: u8, data: &[u8]) -> Result<(), Abort> {
        let start = self.check_complete(index, first)?;
        let slots: Vec<Slot> = self.store.object(index).collect();
        let list = self.pdo.is_list(index);
        let mut wrote = false;
        if list && first == 0 {
            self.write(index, 0, &[0])?;
            wrote = true;
        }
        for slot in slots {
            let Some(item) = self.store.item(slot) else {
                continue;
            };
            if item.sub < first || (item.sub == 0 && list) {
                continue;
            }
            let at = usize::try_from(item.bit_offset)
                .unwrap_or(0)
                .saturating_sub(start);
            let bits = usize::try_from(item.bit_len).unwrap_or(0);
            if at + bits > data.len() * 8 {
                break;
            }
            if item.access.write == Writable::Never {
                continue;
            }
            let mut value = vec![0; bits.div_ceil(8)];
            crate::bits::copy(&mut value, 0, data, at, bits);
            let sub = item.sub;
            let used = data.first().copied().unwrap_or(0);
            if list && first == 0 && sub > used {
                break;
            }
            self.write(index, sub, &value)?;
            wrote = true;
        }
        if list
            && first == 0
            && let Some(count) = data.first()
        {
            self.write(index, 0, &[*count])?;
        }
        if wrote { Ok(()) } else { Err(Abort::READ_ONLY) }
    }
}

/// Bytes as an upload carries them; a text ends before its padding.
pub(crate) fn read_item(store: &ObjectStore, slot: Slot) -> Vec<u8> {
    let bytes = store.bytes(slot);
    if store.item(slot).is_some_and(|item| item.text) {
        let len = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
        return bytes.get(..len.max(1)).unwrap_or(bytes).to_vec();
    }
    bytes.to_vec()
}

fn value_of(data: &[u8], signed: bool) -> i64 {
    let negative = signed && data.last().is_some_and(|b| b & 0x80 != 0);
    let mut raw = [if negative { 0xff } else { 0 }; 8];
    for (to, from) in raw.iter_mut().zip(data) {
        *to = *from;
    }
    i64::from_le_bytes(raw)
}
