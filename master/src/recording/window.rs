//! The part of a file that is looked at, in memory.

use std::io::{ErrorKind, Read};

const CHUNK: usize = 64 * 1024;

/// Bytes from [`Window::offset`] on, as many as were asked for.
#[derive(Debug)]
pub(super) struct Window<R> {
    source: R,
    buffer: Vec<u8>,
    /// Of what has not been taken, in the buffer.
    start: usize,
    /// In the file, of `start`.
    offset: u64,
    ended: bool,
    error: Option<String>,
}

impl<R: Read> Window<R> {
    pub fn new(source: R) -> Self {
        Self {
            source,
            buffer: Vec::new(),
            start: 0,
            offset: 0,
            ended: false,
            error: None,
        }
    }

    /// The next `len` bytes, fewer only where the file ends.
    pub fn fill(&mut self, len: usize) -> &[u8] {
        while !self.ended && self.buffer.len() - self.start < len {
            if self.start > 0 {
                self.buffer.drain(..self.start);
                self.start = 0;
            }
            let had = self.buffer.len();
            self.buffer.resize(had + CHUNK.max(len - had), 0);
            let got = self
                .source
                .read(self.buffer.get_mut(had..).unwrap_or_default());
            let got = match got {
                Ok(got) => got,
                Err(e) if e.kind() == ErrorKind::Interrupted => {
                    self.buffer.truncate(had);
                    continue;
                }
                Err(e) => {
                    self.error = Some(e.to_string());
                    0
                }
            };
            self.buffer.truncate(had + got);
            self.ended = got == 0;
        }
        let end = self.buffer.len().min(self.start + len);
        self.buffer.get(self.start..end).unwrap_or_default()
    }

    /// Moves on; returns by how much, which is less than `len` only at the file's end.
    pub fn take(&mut self, len: usize) -> usize {
        let mut left = len;
        while left > 0 {
            let there = self.fill(left.min(CHUNK)).len();
            if there == 0 {
                break;
            }
            self.start += there;
            self.offset += there as u64;
            left -= there;
        }
        len - left
    }

    /// Where in the file this is.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// Where the bytes that are known end.
    pub fn end(&self) -> u64 {
        self.offset + (self.buffer.len() - self.start) as u64
    }

    pub fn error(&mut self) -> Option<String> {
        self.error.take()
    }
}

/// An integer of a file of either byte order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    Little,
    Big,
}

impl Order {
    pub fn u16(self, bytes: &[u8], at: usize) -> u16 {
        let two = bytes.get(at..).and_then(<[u8]>::first_chunk).copied();
        let two = two.unwrap_or_default();
        match self {
            Self::Little => u16::from_le_bytes(two),
            Self::Big => u16::from_be_bytes(two),
        }
    }

    pub fn u32(self, bytes: &[u8], at: usize) -> u32 {
        let four = bytes.get(at..).and_then(<[u8]>::first_chunk).copied();
        let four = four.unwrap_or_default();
        match self {
            Self::Little => u32::from_le_bytes(four),
            Self::Big => u32::from_be_bytes(four),
        }
    }
}
