//! The object dictionary of a CANopen device: numbers, texts and blocks of bytes.

use super::Abort;

/// The access rights of SDO clients.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    Ro,
    Rw,
    Wo,
}

/// The type of an entry: bytes and sign of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    U8,
    U16,
    U32,
    I8,
    I16,
    I32,
    /// A text or a block of bytes of any length.
    Bytes,
}

impl Kind {
    pub(super) fn len(self) -> u8 {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 => 4,
            Self::Bytes => 0,
        }
    }

    fn value(self, data: &[u8]) -> i64 {
        let raw = data
            .iter()
            .take(4)
            .rev()
            .fold(0u32, |value, byte| value << 8 | u32::from(*byte));
        match self {
            Self::I8 => i64::from(raw as u8 as i8),
            Self::I16 => i64::from(raw as u16 as i16),
            Self::I32 => i64::from(raw as i32),
            _ => i64::from(raw),
        }
    }
}

/// An existing entry. Valid for the dictionary's lifetime.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Handle(usize);

#[derive(Debug, Clone)]
struct Entry {
    key: u32,
    kind: Kind,
    access: Access,
    range: Option<(i64, i64)>,
    value: i64,
    bytes: Vec<u8>,
}

#[derive(Debug, Clone, Default)]
pub(super) struct Dictionary {
    /// Sorted by key.
    entries: Vec<Entry>,
}

fn key(index: u16, sub: u8) -> u32 {
    u32::from(index) << 8 | u32::from(sub)
}

impl Dictionary {
    /// Adds or replaces an entry.
    pub(super) fn add(&mut self, index: u16, sub: u8, kind: Kind, access: Access, value: i64) {
        self.insert(Entry {
            key: key(index, sub),
            kind,
            access,
            range: None,
            value,
            bytes: Vec::new(),
        });
    }

    /// Adds or replaces an entry with the range of values that a client may write.
    pub(super) fn ranged(
        &mut self,
        index: u16,
        sub: u8,
        kind: Kind,
        value: i64,
        range: (i64, i64),
    ) {
        self.add(index, sub, kind, Access::Rw, value);
        if let Some(entry) = self.entry_mut(index, sub) {
            entry.range = Some(range);
        }
    }

    pub(super) fn add_bytes(&mut self, index: u16, sub: u8, access: Access, bytes: &[u8]) {
        self.insert(Entry {
            key: key(index, sub),
            kind: Kind::Bytes,
            access,
            range: None,
            value: 0,
            bytes: bytes.to_vec(),
        });
    }

    fn insert(&mut self, entry: Entry) {
        match self.entries.binary_search_by_key(&entry.key, |e| e.key) {
            Ok(at) => self.entries[at] = entry,
            Err(at) => self.entries.insert(at, entry),
        }
    }

    fn entry_mut(&mut self, index: u16, sub: u8) -> Option<&mut Entry> {
        let at = self.find(index, sub)?.0;
        self.entries.get_mut(at)
    }

    pub(super) fn find(&self, index: u16, sub: u8) -> Option<Handle> {
        let key = key(index, sub);
        self.entries
            .binary_search_by_key(&key, |entry| entry.key)
            .ok()
            .map(Handle)
    }

    fn entry(&self, index: u16, sub: u8) -> Result<&Entry, Abort> {
        let found = self.find(index, sub).and_then(|h| self.entries.get(h.0));
        found.ok_or_else(|| {
            let at = self.entries.partition_point(|e| e.key < key(index, 0));
            let object = self.entries.get(at);
            if object.is_some_and(|e| e.key >> 8 == u32::from(index)) {
                Abort::NO_SUBINDEX
            } else {
                Abort::NO_OBJECT
            }
        })
    }

    /// Returns a number; 0 if the entry does not exist.
    pub(super) fn get(&self, index: u16, sub: u8) -> i64 {
        self.find(index, sub).map_or(0, |handle| self.at(handle))
    }

    pub(super) fn set(&mut self, index: u16, sub: u8, value: i64) {
        if let Some(handle) = self.find(index, sub) {
            self.put(handle, value);
        }
    }

    pub(super) fn at(&self, handle: Handle) -> i64 {
        self.entries.get(handle.0).map_or(0, |entry| entry.value)
    }

    /// Sets a number, truncated to the entry's type.
    pub(super) fn put(&mut self, handle: Handle, value: i64) {
        if let Some(entry) = self.entries.get_mut(handle.0) {
            entry.value = entry.kind.value(&value.to_le_bytes());
        }
    }

    pub(super) fn bytes(&self, index: u16, sub: u8) -> &[u8] {
        self.entry(index, sub)
            .map_or(&[], |entry| entry.bytes.as_slice())
    }

    /// Returns the data of an SDO upload.
    pub(super) fn read(&self, index: u16, sub: u8) -> Result<Vec<u8>, Abort> {
        let entry = self.entry(index, sub)?;
        match (entry.access, entry.kind) {
            (Access::Wo, _) => Err(Abort::WRITE_ONLY),
            (_, Kind::Bytes) => Ok(entry.bytes.clone()),
            (_, kind) => {
                let bytes = entry.value.to_le_bytes();
                Ok(bytes.into_iter().take(usize::from(kind.len())).collect())
            }
        }
    }

    /// Checks an SDO download. Returns its value.
    pub(super) fn check(&self, index: u16, sub: u8, data: &[u8]) -> Result<i64, Abort> {
        let entry = self.entry(index, sub)?;
        if entry.access == Access::Ro {
            return Err(Abort::READ_ONLY);
        }
        if entry.kind == Kind::Bytes {
            return Ok(0);
        }
        match data.len().cmp(&usize::from(entry.kind.len())) {
            std::cmp::Ordering::Less => return Err(Abort::TOO_SHORT),
            std::cmp::Ordering::Greater => return Err(Abort::TOO_LONG),
            std::cmp::Ordering::Equal => {}
        }
        let value = entry.kind.value(data);
        match entry.range {
            Some((_, max)) if value > max => Err(Abort::VALUE_TOO_HIGH),
            Some((min, _)) if value < min => Err(Abort::VALUE_TOO_LOW),
            _ => Ok(value),
        }
    }

    /// Handles an SDO download.
    pub(super) fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        let value = self.check(index, sub, data)?;
        if let Some(entry) = self.entry_mut(index, sub) {
            match entry.kind {
                Kind::Bytes => entry.bytes = data.to_vec(),
                _ => entry.value = value,
            }
        }
        Ok(())
    }

    /// Copies all values of the same entries within a range of indices.
    pub(super) fn restore(&mut self, from: &Self, indices: std::ops::RangeInclusive<u16>) {
        for (to, from) in self.entries.iter_mut().zip(&from.entries) {
            let index = (to.key >> 8) as u16;
            if to.key == from.key && indices.contains(&index) {
                to.value = from.value;
                to.bytes.clone_from(&from.bytes);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dictionary_checks_access_length_and_range() {
        let mut d = Dictionary::default();
        d.ranged(0x3000, 0, Kind::U16, 16, (2, 512));
        d.add(0x1000, 0, Kind::U32, Access::Ro, 0x20192);
        d.add(0x6060, 0, Kind::I8, Access::Rw, -1);
        d.add(0x1f25, 1, Kind::U32, Access::Wo, 0);
        d.add_bytes(0x1008, 0, Access::Ro, b"gateway");
        assert_eq!(d.read(0x6060, 0), Ok(vec![0xff]));
        assert_eq!(d.read(0x1008, 0), Ok(b"gateway".to_vec()));
        for (index, sub, data, expected) in [
            (0x3000, 0, &[0, 2][..], Ok(())),
            (0x3000, 0, &[1, 2], Err(Abort::VALUE_TOO_HIGH)),
            (0x3000, 0, &[1, 0], Err(Abort::VALUE_TOO_LOW)),
            (0x3000, 0, &[1], Err(Abort::TOO_SHORT)),
            (0x3000, 0, &[1, 0, 0], Err(Abort::TOO_LONG)),
            (0x3000, 1, &[1, 0], Err(Abort::NO_SUBINDEX)),
            (0x3001, 0, &[1, 0], Err(Abort::NO_OBJECT)),
            (0x1000, 0, &[0; 4], Err(Abort::READ_ONLY)),
            (0x1f25, 1, &[0; 4], Ok(())),
        ] {
            assert_eq!(
                d.write(index, sub, data),
                expected,
                "{index:04x}:{sub} {data:?}"
            );
        }
        assert_eq!(d.read(0x1f25, 1), Err(Abort::WRITE_ONLY));
        assert_eq!(d.get(0x3000, 0), 512);
        d.set(0x6060, 0, 0x1_ff80);
        assert_eq!(d.get(0x6060, 0), -128);
    }
}
