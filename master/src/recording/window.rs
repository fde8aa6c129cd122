//! A buffered window of a file.

use std::io::{ErrorKind, Read};

const CHUNK: usize = 64 * 1024;

/// The bytes from [`PeekReader::offset`] on.
#[derive(Debug)]
pub(super) struct PeekReader<R> {
    source: R,
    buffer: Vec<u8>,
    /// The start of the unconsumed bytes in the buffer.
    start: usize,
    /// The file offset of `start`.
    offset: u64,
    ended: bool,
    error: Option<String>,
}

impl<R: Read> PeekReader<R> {
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

    /// Returns the next `len` bytes, fewer only at the end of the file.
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

    /// Skips bytes. Returns their number, which is less than `len` only at the end of the file.
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

    /// Returns the file offset.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// Returns the file offset of the end of the buffer.
    pub fn end(&self) -> u64 {
        self.offset + (self.buffer.len() - self.start) as u64
    }

    pub fn error(&mut self) -> Option<String> {
        self.error.take()
    }
}

/// The byte order of a file's integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

impl ByteOrder {
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
