//! Line and column of byte offsets, without a table of all lines: a file may be nothing but line ends, or one line.

use std::cell::{Cell, RefCell};

pub(super) struct Lines<'a> {
    text: &'a [u8],
    /// Line ends before each block, and characters since the last of them; grows with the offsets asked for, while
    /// what is counted was just read.
    before: RefCell<Vec<(u32, u32)>>,
    /// The same before the offset asked for last; the next is mostly not far behind it.
    last: Cell<(usize, (u32, u32))>,
}

const BLOCK: usize = 512;

impl<'a> Lines<'a> {
    pub fn new(text: &'a str) -> Self {
        Self {
            text: text.as_bytes(),
            before: RefCell::new(vec![(0, 0)]),
            last: Cell::default(),
        }
    }

    /// Both from 1; columns count characters.
    pub fn position(&self, offset: usize) -> (u32, u32) {
        let offset = offset.min(self.text.len());
        let block = offset / BLOCK * BLOCK;
        let (mut from, mut known) = self.last.get();
        if !(block..=offset).contains(&from) {
            (from, known) = (block, self.before(offset / BLOCK));
        }
        let (lines, characters) = passed(known, &self.text[from..offset]);
        self.last.set((offset, (lines, characters)));
        (lines.saturating_add(1), characters.saturating_add(1))
    }

    fn before(&self, block: usize) -> (u32, u32) {
        let mut before = self.before.borrow_mut();
        if let Some(known) = before.get(block) {
            return *known;
        }
        let mut known = before.last().copied().unwrap_or_default();
        while before.len() <= block {
            let end = before.len() * BLOCK;
            known = passed(known, &self.text[end - BLOCK..end]);
            before.push(known);
        }
        known
    }
}

/// Lines and characters behind `bytes`.
fn passed((lines, characters): (u32, u32), bytes: &[u8]) -> (u32, u32) {
    let small = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    // A character is counted by its first byte.
    let count = |bytes: &[u8]| {
        let first = |byte: &&u8| **byte & 0xc0 != 0x80;
        small(bytes.iter().filter(first).count())
    };
    match memchr::memrchr(b'\n', bytes) {
        None => (lines, characters.saturating_add(count(bytes))),
        Some(last) => {
            let ends = memchr::memchr_iter(b'\n', &bytes[..=last]).count();
            (lines.saturating_add(small(ends)), count(&bytes[last + 1..]))
        }
    }
}
