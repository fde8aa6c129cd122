//! Line and column of byte offsets, without a table of all lines: a file may consist of line ends
//! only, or of one line.

use std::cell::{Cell, RefCell};

pub(super) struct Lines<'a> {
    text: &'a [u8],
    /// The line end byte: CR if the file contains no LF.
    end: u8,
    /// For each block: line ends before it, and characters since the last line end. Extended on
    /// demand, while the counted bytes are still in the cache.
    before: RefCell<Vec<(u32, u32)>>,
    /// The same values for the last requested offset. The next request is usually shortly after it.
    last: Cell<(usize, (u32, u32))>,
}

const BLOCK: usize = 4096;

impl<'a> Lines<'a> {
    pub fn new(text: &'a str) -> Self {
        let text = text.as_bytes();
        Self {
            text,
            end: match memchr::memchr(b'\n', text) {
                Some(_) => b'\n',
                None => b'\r',
            },
            before: RefCell::new(vec![(0, 0)]),
            last: Cell::default(),
        }
    }

    /// Returns line and column, both from 1. Columns count characters.
    pub fn position(&self, offset: usize) -> (u32, u32) {
        let offset = offset.min(self.text.len());
        let (lines, characters) = self.before(offset);
        self.last.set((offset, (lines, characters)));
        (lines.saturating_add(1), characters.saturating_add(1))
    }

    fn before(&self, offset: usize) -> (u32, u32) {
        let mut before = self.before.borrow_mut();
        let (mut from, mut known) = self.last.get();
        let block = (offset / BLOCK).min(before.len().saturating_sub(1));
        if !(block * BLOCK..=offset).contains(&from)
            && let Some(at_block) = before.get(block)
        {
            (from, known) = (block * BLOCK, *at_block);
        }
        while before.len() * BLOCK <= offset {
            let end = before.len() * BLOCK;
            known = self.passed(known, &self.text[from..end]);
            before.push(known);
            from = end;
        }
        self.passed(known, &self.text[from..offset])
    }

    /// Returns lines and characters after `bytes`.
    fn passed(&self, (lines, characters): (u32, u32), bytes: &[u8]) -> (u32, u32) {
        let small = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
        // A character is counted by its first byte.
        let count = |bytes: &[u8]| {
            let first = |byte: &&u8| **byte & 0xc0 != 0x80;
            small(bytes.iter().filter(first).count())
        };
        match memchr::memrchr(self.end, bytes) {
            None => (lines, characters.saturating_add(count(bytes))),
            Some(last) => {
                let ends = memchr::memchr_iter(self.end, &bytes[..=last]).count();
                (lines.saturating_add(small(ends)), count(&bytes[last + 1..]))
            }
        }
    }
}
