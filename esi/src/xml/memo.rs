//! Elements whose text stood in the file before are not read again: revisions of one device repeat most of their PDO
//! entries and subindices word for word.
//!
//! A text that was read whole, without a warning, is kept with what was made of it. Reading depends on nothing but
//! the text and how deep it is nested, so wherever text begins with the same bytes the same element stands, however
//! its end was guessed at.

use std::rc::Rc;

use memchr::memmem::Finder;

use super::{datatype, object, sync};
use crate::model::{DcMode, Entry, Pdo, SyncManager};

pub(super) struct Memos<'a> {
    pub rx_pdos: Memo<'a, Pdo>,
    pub tx_pdos: Memo<'a, Pdo>,
    pub entries: Memo<'a, Entry>,
    pub objects: Memo<'a, Rc<object::RawObject<'a>>>,
    pub flags: Memo<'a, object::Flags>,
    pub types: Memo<'a, Rc<datatype::Named>>,
    pub type_items: Memo<'a, datatype::SubItem>,
    pub object_items: Memo<'a, object::SubItem<'a>>,
    pub sync_managers: Memo<'a, SyncManager>,
    pub assignments: Memo<'a, sync::Assignment>,
    pub dc_modes: Memo<'a, DcMode>,
}

impl Memos<'_> {
    pub fn new() -> Self {
        Self {
            rx_pdos: Memo::new("</RxPdo>"),
            tx_pdos: Memo::new("</TxPdo>"),
            objects: Memo::new("</Object>"),
            entries: Memo::new("</Entry>"),
            flags: Memo::new("</Flags>"),
            types: Memo::new("</DataType>"),
            type_items: Memo::new("</SubItem>"),
            object_items: Memo::new("</SubItem>"),
            sync_managers: Memo::new("</Sm>"),
            assignments: Memo::new("</Sm>"),
            dc_modes: Memo::new("</OpMode>"),
        }
    }
}

/// Each text has one place, which the next of the same place takes over: memory and time stay bounded whatever a
/// file holds.
pub(super) struct Memo<'a, T> {
    end: Finder<'static>,
    /// Numbers of `known`, from 1.
    places: Vec<u16>,
    known: Vec<Known<'a, T>>,
    /// Of `known`, what was read last.
    last: usize,
}

struct Known<'a, T> {
    key: Key<'a>,
    value: T,
    /// Of `known`, what came behind it; that is tried first, for then no end must be looked for.
    next: usize,
}

/// Longer elements are rarely the same.
const MAX_LENGTH: usize = 16 << 10;
const PLACES: usize = 4096;

#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Key<'a> {
    place: usize,
    depth: usize,
    text: &'a [u8],
}

impl Key<'_> {
    /// Bytes of the element.
    pub fn length(&self) -> usize {
        self.text.len()
    }
}

impl<'a, T> Memo<'a, T> {
    fn new(end: &'static str) -> Self {
        Self {
            end: Finder::new(end),
            places: Vec::new(),
            known: Vec::new(),
            last: 0,
        }
    }

    /// Of the element at the beginning of `rest`, as far as its first end tag; with it what is known of it.
    pub fn find(&mut self, rest: &'a [u8], depth: usize) -> Option<(Key<'a>, Option<&T>)> {
        let (key, at) = match self.expected(rest, depth) {
            Some((at, key)) => (key, Some(at)),
            None => {
                let key = self.key(rest, depth)?;
                (key, self.at(&key))
            }
        };
        let Some(at) = at else {
            return Some((key, None));
        };
        self.came(at);
        let value = self.known.get(at).map(|known| &known.value);
        Some((key, value))
    }

    /// Where the element is what came last time behind the one before: its bytes and what is known of it.
    pub fn find_expected(&mut self, rest: &[u8], depth: usize) -> Option<(usize, &T)> {
        let (at, key) = self.expected(rest, depth)?;
        self.last = at;
        let value = self.known.get(at).map(|known| &known.value)?;
        Some((key.length(), value))
    }

    fn expected(&self, rest: &[u8], depth: usize) -> Option<(usize, Key<'a>)> {
        let at = self.known.get(self.last)?.next;
        let key = self.known.get(at)?.key;
        (key.depth == depth && rest.starts_with(key.text)).then_some((at, key))
    }

    fn key(&self, rest: &'a [u8], depth: usize) -> Option<Key<'a>> {
        let near = rest.get(..MAX_LENGTH).unwrap_or(rest);
        let length = self.end.find(near)? + self.end.needle().len();
        let text = &near[..length];
        Some(Key {
            place: place(text),
            depth,
            text,
        })
    }

    fn at(&self, key: &Key<'_>) -> Option<usize> {
        let number = usize::from(*self.places.get(key.place)?);
        let at = number.checked_sub(1)?;
        (self.known.get(at)?.key == *key).then_some(at)
    }

    fn came(&mut self, at: usize) {
        if let Some(last) = self.known.get_mut(self.last) {
            last.next = at;
        }
        self.last = at;
    }

    pub fn put(&mut self, key: Key<'a>, value: T) {
        self.places.resize(PLACES, 0);
        let Some(number) = self.places.get_mut(key.place) else {
            return;
        };
        let next = usize::MAX;
        let new = Known { key, value, next };
        let at = match usize::from(*number).checked_sub(1) {
            Some(at) => at,
            None => self.known.len(),
        };
        match self.known.get_mut(at) {
            Some(known) => *known = new,
            None => self.known.push(new),
        }
        *number = u16::try_from(at + 1).unwrap_or(0);
        self.came(at);
    }
}

/// Four words at a time, which do not wait for each other.
fn place(text: &[u8]) -> usize {
    const FACTOR: u64 = 0x9e37_79b9_7f4a_7c15;
    let (blocks, rest) = text.as_chunks::<32>();
    let mut last = [0; 32];
    last[..rest.len()].copy_from_slice(rest);
    let mut lanes = [text.len() as u64, 1, 2, 3];
    for block in blocks.iter().chain([&last]) {
        for (lane, word) in lanes.iter_mut().zip(block.as_chunks::<8>().0) {
            *lane = (lane.rotate_left(5) ^ u64::from_le_bytes(*word)).wrapping_mul(FACTOR);
        }
    }
    let hash = lanes.iter().fold(0, |hash: u64, lane| {
        (hash.rotate_left(5) ^ lane).wrapping_mul(FACTOR)
    });
    (hash >> (64 - PLACES.ilog2())) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    const ENTRIES: &[u8] = b"<Entry>a</Entry><Entry>b</Entry><Entry>a</Entry><Entry>b</Entry>";

    /// What is known of each element, after those before it were put there by their number.
    fn known(
        memo: &mut Memo<'static, usize>,
        text: &'static [u8],
        depth: usize,
    ) -> Vec<Option<usize>> {
        let mut at = 0;
        let mut all = Vec::new();
        while let Some((key, known)) = memo.find(&text[at..], depth) {
            let known = known.copied();
            at += key.length();
            if known.is_none() {
                memo.put(key, all.len());
            }
            all.push(known);
        }
        all
    }

    #[test]
    fn the_same_text_at_the_same_depth_is_known() {
        let mut memo = Memo::new("</Entry>");
        assert_eq!(known(&mut memo, ENTRIES, 5), [None, None, Some(0), Some(1)]);
        assert_eq!(
            known(&mut memo, ENTRIES, 5),
            [Some(0), Some(1), Some(0), Some(1)]
        );
        assert_eq!(known(&mut memo, ENTRIES, 6), [None, None, Some(0), Some(1)]);
    }

    #[test]
    fn what_is_expected_is_compared_all_the_same() {
        let mut memo = Memo::new("</Entry>");
        known(&mut memo, ENTRIES, 5);
        let other = b"<Entry>a</Entry><Entry>B</Entry><Entry>b</Entry><Entry>a";
        assert_eq!(known(&mut memo, other, 5), [Some(0), None, Some(1)]);
    }

    #[test]
    fn memory_is_bounded() {
        let texts: Vec<String> = (0..3 * PLACES)
            .map(|n| format!("<Entry>{n}</Entry>"))
            .collect();
        let mut memo = Memo::new("</Entry>");
        for (n, text) in texts.iter().enumerate() {
            let (key, known) = memo.find(text.as_bytes(), 1).unwrap();
            assert_eq!(known, None);
            memo.put(key, n);
        }
        assert!(memo.known.len() <= PLACES);
        let kept = texts.iter().enumerate().filter(|(n, text)| {
            let (_, known) = memo.find(text.as_bytes(), 1).unwrap();
            assert!(known.is_none_or(|known| known == n));
            known.is_some()
        });
        assert!(kept.count() > PLACES / 2);
    }

    #[test]
    fn long_elements_are_not_looked_for() {
        let text = format!("<Entry>{}</Entry>", "x".repeat(MAX_LENGTH));
        let mut memo = Memo::<usize>::new("</Entry>");
        assert!(memo.find(text.as_bytes(), 1).is_none());
    }
}
