//! Objects of a device from SDO transfers: identity, name, and the PDO mapping.

use std::collections::BTreeMap;

use super::mailbox::{Transfer, TransferDirection, TransferOutcome};

/// The maximum number of stored objects.
const OBJECTS: usize = 8192;

/// The values of the objects that describe a device.
#[derive(Debug, Default, Clone)]
pub struct Objects {
    values: BTreeMap<(u16, u8), Vec<u8>>,
}

/// One object in a PDO, or a gap (index 0).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mapped {
    pub index: u16,
    pub sub: u8,
    /// The bit offset in its SyncManager.
    pub bit: u32,
    pub bits: u8,
}

fn describes(index: u16) -> bool {
    matches!(index, 0x1000..=0x1018 | 0x1600..=0x17ff | 0x1a00..=0x1bff | 0x1c10..=0x1c2f)
}

fn maps(index: u16) -> bool {
    index >= 0x1600
}

impl Objects {
    /// Stores the value of a transfer. Returns true if the PDOs changed.
    pub fn learn(&mut self, transfer: &Transfer) -> bool {
        let whole = transfer.data.len() == transfer.len;
        if transfer.ended != TransferOutcome::Done || !describes(transfer.index) || !whole {
            return false;
        }
        let index = transfer.index;
        if transfer.complete {
            self.whole(transfer);
        } else {
            self.set((index, transfer.sub), transfer.data.clone());
        }
        // A download changes the mapping. An upload shows the existing one.
        maps(index) && (transfer.way == TransferDirection::Write || !self.values.is_empty())
    }

    fn set(&mut self, at: (u16, u8), data: Vec<u8>) {
        if self.values.len() < OBJECTS || self.values.contains_key(&at) {
            self.values.insert(at, data);
        }
    }

    /// Stores a complete access: subindex 0 in two bytes, then all other subindices.
    fn whole(&mut self, transfer: &Transfer) {
        let size = match transfer.index {
            0x1c10..=0x1c2f => 2,
            0x1600..=0x1bff | 0x1018 => 4,
            _ => return,
        };
        let rest = if transfer.sub == 0 {
            let Some((count, rest)) = transfer.data.split_first_chunk::<2>() else {
                return;
            };
            self.set(
                (transfer.index, 0),
                count.get(..1).unwrap_or_default().to_vec(),
            );
            rest
        } else {
            &transfer.data
        };
        for (sub, value) in (1..=u8::MAX).zip(rest.chunks_exact(size)) {
            self.set((transfer.index, sub), value.to_vec());
        }
    }

    fn number(&self, index: u16, sub: u8) -> Option<u32> {
        let value = self.values.get(&(index, sub))?;
        let bytes = value.get(..value.len().min(4))?;
        Some(
            bytes
                .iter()
                .rev()
                .fold(0, |n, byte| n << 8 | u32::from(*byte)),
        )
    }

    /// Returns vendor, product, revision and serial number.
    pub fn identity(&self) -> (Option<u32>, Option<u32>, Option<u32>, Option<u32>) {
        let of = |sub| self.number(0x1018, sub);
        (of(1), of(2), of(3), of(4))
    }

    /// Returns the device name (0x1008).
    pub fn name(&self) -> Option<String> {
        let text = String::from_utf8_lossy(self.values.get(&(0x1008, 0))?);
        let text = text.trim_matches(|c: char| c.is_whitespace() || c.is_control());
        (!text.is_empty()).then(|| text.chars().filter(|c| !c.is_control()).take(60).collect())
    }

    /// Returns the objects of a SyncManager in order; `None` if the recording is incomplete.
    pub fn mapping(&self, sync_manager: u8) -> Option<Vec<Mapped>> {
        let assignment = 0x1c10 + u16::from(sync_manager);
        let pdos = self.number(assignment, 0)?;
        let (mut mapped, mut bit) = (Vec::new(), 0_u32);
        for n in (1..=u8::MAX).take(pdos as usize) {
            let pdo = u16::try_from(self.number(assignment, n)?).ok()?;
            let entries = self.number(pdo, 0)?;
            for sub in (1..=u8::MAX).take(entries as usize) {
                let [bits, sub, low, high] = self.number(pdo, sub)?.to_le_bytes();
                mapped.push(Mapped {
                    index: u16::from_le_bytes([low, high]),
                    sub,
                    bit,
                    bits,
                });
                bit += u32::from(bits);
            }
        }
        (!mapped.is_empty()).then_some(mapped)
    }
}
