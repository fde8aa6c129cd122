//! The file or files of a recording.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use crate::link::{MAX_FRAME, Nanos};
use crate::recording::Direction;

/// The maximum number of parts of a recording with a limit.
const PARTS: u64 = 4;

/// Returns the path of the part with this number.
fn part_name(path: &Path, number: u32) -> PathBuf {
    let mut name = path
        .file_stem()
        .map_or_else(OsString::new, ToOwned::to_owned);
    name.push(format!(".{number:04}"));
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}

/// Returns the existing paths that match numbered parts of a recording of this name.
///
/// # Errors
/// Fails if the folder cannot be read.
pub fn parts_of(path: &Path) -> io::Result<Vec<PathBuf>> {
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    let mut found = Vec::new();
    for entry in fs::read_dir(folder)? {
        let name = entry?.file_name();
        // The number is the extension of the remaining stem.
        let number = Path::new(&name)
            .file_stem()
            .and_then(|stem| Path::new(stem).extension());
        let number = number.and_then(|n| n.to_str()?.parse::<u32>().ok());
        if let Some(number) = number
            && part_name(path, number).file_name() == Some(&name)
        {
            found.push(path.with_file_name(name));
        }
    }
    found.sort();
    Ok(found)
}

/// Writes the file or files of a recording.
pub(super) struct RotatingWriter {
    file: Pcapng<BufWriter<File>>,
    path: PathBuf,
    /// The begin of each part.
    header: Vec<u8>,
    /// Maximum bytes per part.
    each: Option<u64>,
    /// The number of the current part; 0 is the first.
    number: u32,
    /// Frames in earlier parts.
    before: u64,
}

fn open_part(path: &Path, header: &[u8]) -> io::Result<Pcapng<BufWriter<File>>> {
    Pcapng::new(
        BufWriter::with_capacity(1 << 20, File::create(path)?),
        header,
    )
}

impl RotatingWriter {
    pub fn create(path: &Path, limit: Option<u64>, comment: &str) -> io::Result<Self> {
        let header = header(comment);
        let file = open_part(path, &header)?;
        if limit.is_some() {
            for old in parts_of(path)? {
                let mut magic = Vec::new();
                File::open(&old)?.take(4).read_to_end(&mut magic)?;
                if magic == SECTION.to_le_bytes() {
                    fs::remove_file(old)?;
                }
            }
        }
        Ok(Self {
            file,
            path: path.to_owned(),
            header,
            each: limit.map(|limit| limit / PARTS),
            number: 0,
            before: 0,
        })
    }

    pub fn packet(&mut self, dir: Direction, at: Nanos, frame: &[u8]) -> io::Result<()> {
        let room = |each| self.file.bytes + BLOCK_MOST <= each;
        if !self.each.is_none_or(room) {
            self.turn()?;
        }
        self.file.packet(dir, at, frame)
    }

    /// Continues in a new part and removes the oldest one.
    fn turn(&mut self) -> io::Result<()> {
        let next = open_part(&part_name(&self.path, self.number + 1), &self.header)?;
        self.before += std::mem::replace(&mut self.file, next).finish()?;
        self.number += 1;
        if let Some(old) = self
            .number
            .checked_sub(PARTS as u32 - 1)
            .filter(|old| *old > 0)
        {
            fs::remove_file(part_name(&self.path, old))?;
        }
        Ok(())
    }

    /// Returns how many frames were written, including those in removed parts.
    pub fn finish(self) -> io::Result<u64> {
        Ok(self.before + self.file.finish()?)
    }
}

/// A pcapng writer: one section, one Ethernet interface, nanosecond timestamps.
struct Pcapng<W> {
    out: W,
    /// The buffer of one block, so that each frame is one write.
    block: Vec<u8>,
    written: u64,
    /// Bytes written to the file so far.
    bytes: u64,
}

const SECTION: u32 = 0x0a0d_0d0a;
/// Bytes of the longest block.
const BLOCK_MOST: u64 = 48 + MAX_FRAME as u64;

/// Returns the section header of unknown length with opt_comment (1) and shb_userappl (4), then the
/// description of an Ethernet interface with if_tsresol (9) = 10^-9.
fn header(comment: &str) -> Vec<u8> {
    let program = concat!("ecaxis ", env!("CARGO_PKG_VERSION"));
    let mut section = Vec::new();
    for word in [0x1a2b_3c4d, 1, u32::MAX, u32::MAX] {
        section.extend(u32::to_le_bytes(word));
    }
    for (code, text) in [(1_u16, comment), (4, program)] {
        let text = text.get(..usize::from(u16::MAX)).unwrap_or(text).as_bytes();
        let Ok(len) = u16::try_from(text.len()) else {
            continue;
        };
        section.extend(code.to_le_bytes());
        section.extend(len.to_le_bytes());
        section.extend(text);
        section.resize(section.len().next_multiple_of(4), 0);
    }
    section.extend([0; 4]);
    let total = u32::try_from(section.len() + 12).unwrap_or(u32::MAX);
    let mut bytes: Vec<u8> = [SECTION, total].map(u32::to_le_bytes).concat();
    bytes.extend(section);
    let interface = [total, 1, 32, 1, 0, 0x0001_0009, 9, 0, 32];
    bytes.extend(interface.map(u32::to_le_bytes).concat());
    bytes
}

/// Returns bits 0 and 1 of `epb_flags`.
pub(super) fn flag(direction: Direction) -> u32 {
    match direction {
        Direction::In => 1,
        Direction::Out => 2,
    }
}

impl<W: Write> Pcapng<W> {
    fn new(mut out: W, header: &[u8]) -> io::Result<Self> {
        out.write_all(header)?;
        Ok(Self {
            out,
            block: Vec::with_capacity(48 + MAX_FRAME),
            written: 0,
            bytes: header.len() as u64,
        })
    }

    fn packet(&mut self, direction: Direction, at: Nanos, frame: &[u8]) -> io::Result<()> {
        let len = u32::try_from(frame.len()).map_err(|_| io::ErrorKind::InvalidInput)?;
        // 28 bytes before the data, 12 bytes of options and 4 bytes after the data.
        let total = 44 + len.next_multiple_of(4);
        let (high, low) = ((at >> 32) as u32, at as u32);
        self.block.clear();
        for word in [6, total, 0, high, low, len, len] {
            self.block.extend(word.to_le_bytes());
        }
        self.block.extend(frame);
        self.block.resize(self.block.len().next_multiple_of(4), 0);
        // The option epb_flags (2) of 4 bytes, and the end of the options.
        for word in [0x0004_0002, flag(direction), 0, total] {
            self.block.extend(word.to_le_bytes());
        }
        self.out.write_all(&self.block)?;
        self.written += 1;
        self.bytes += self.block.len() as u64;
        Ok(())
    }

    fn finish(mut self) -> io::Result<u64> {
        self.out.flush()?;
        Ok(self.written)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Recorder, WriterMode};
    use super::*;

    #[test]
    fn limited_recording_keeps_the_first_and_newest_parts() {
        const LIMIT: u64 = 200_000;
        for mode in [WriterMode::Inline, WriterMode::Background] {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("a night.pcapng");
            // One file of an older recording, and one that is not a recording.
            let old = dir.path().join("a night.0042.pcapng");
            let other = dir.path().join("a night.0043.pcapng");
            fs::write(&old, SECTION.to_le_bytes()).unwrap();
            fs::write(&other, "notes").unwrap();
            let mut recorder = Recorder::create(&path, mode, Some(LIMIT), "").unwrap();
            let frames = 3_000;
            for at in 0..frames {
                recorder.frame(Direction::Out, at, &[0x5a; 200]);
            }
            let stats = recorder.finish().unwrap();
            assert_eq!((stats.written, stats.dropped), (frames, 0));
            assert!(!old.exists() && other.exists());
            fs::remove_file(other).unwrap();

            let mut files = parts_of(&path).unwrap();
            assert_eq!(files.len(), 3, "{files:?}");
            files.insert(0, path);
            let sizes = files.iter().map(|file| file.metadata().unwrap().len());
            assert!(sizes.sum::<u64>() <= LIMIT);
            let stamps = files.iter().flat_map(|file| {
                let mut reader = crate::recording::open(file).unwrap();
                let stamps: Vec<u64> = std::iter::from_fn(|| reader.next())
                    .map(|packet| packet.at.unwrap())
                    .collect();
                assert_eq!(reader.remarks(), []);
                stamps
            });
            let stamps: Vec<u64> = stamps.collect();
            assert_eq!(
                (stamps.first(), stamps.last()),
                (Some(&0), Some(&(frames - 1)))
            );
            let jumps = stamps
                .windows(2)
                .filter(|pair| pair[1] != pair[0] + 1)
                .count();
            assert_eq!(jumps, 1, "between the first part and the newest");
        }
    }
}
