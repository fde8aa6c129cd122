//! Recordings as files: pcap and pcapng, ours and other people's. Reads what may be cut, damaged or something else: what is
//! wrong becomes a [`Remark`], what follows is read all the same. Memory is bounded however long the file is.
//!
//! - [`Reader`]: packets of a file, one after the other;
//! - `pcap`, `pcapng`: the two formats;
//! - `window`: a part of a file in memory;
//! - [`frame`]: what of a packet is EtherCAT, and its datagrams.

use std::fmt;
use std::io::{self, Read};

pub mod frame;
mod pcap;
mod pcapng;
mod window;

use window::Window;

/// No packet is longer. What claims to be is damaged: Ethernet has 1518 bytes, jumbo frames 9000.
const MAX_PACKET: usize = 256 * 1024;

/// Which way a packet went, where the recording says so.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Sent by the computer that recorded.
    Out,
    In,
}

/// One packet of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Packet {
    /// From 1, as Wireshark counts.
    pub number: u64,
    /// Nanoseconds since 1970; `None` where the format has no time.
    pub at: Option<u64>,
    pub interface: u32,
    /// LINKTYPE_… of <https://www.tcpdump.org/linktypes.html>.
    pub link_type: u16,
    pub direction: Option<Direction>,
    pub data: Vec<u8>,
    /// How long it was on the wire; more than `data` where the recording cut it.
    pub original_len: usize,
}

/// Something about a file that its reader should know.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Remark {
    /// The file is no recording; what it seems to be.
    Foreign(&'static str),
    /// The file ends within a packet, at this byte.
    Truncated { at: u64 },
    /// What stands at this byte is no packet; `skipped` bytes later there was one again, or the file's end.
    Damaged { at: u64, skipped: u64 },
    /// An operating system error while reading.
    Unreadable { at: u64, error: String },
}

impl fmt::Display for Remark {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Foreign(what) => write!(f, "this is no recording but {what}"),
            Self::Truncated { at } => write!(f, "the file ends within a packet, at byte {at}"),
            Self::Damaged { at, skipped } => {
                write!(f, "damaged at byte {at}: {skipped} bytes were left out")
            }
            Self::Unreadable { at, error } => write!(f, "cannot be read beyond byte {at}: {error}"),
        }
    }
}

/// Remarks that are kept; a file of noise would have thousands.
const REMARKS: usize = 16;

#[derive(Debug)]
enum Format {
    Pcap(pcap::Pcap),
    Pcapng(pcapng::Pcapng),
    Foreign,
}

/// Packets of a file, in the file's order.
#[derive(Debug)]
pub struct Reader<R> {
    window: Window<R>,
    format: Format,
    peeked: Option<Packet>,
    packets: u64,
    remarks: Vec<Remark>,
    more_remarks: u64,
}

/// What a format made of the bytes in front of it.
enum Step {
    Packet(Packet),
    /// Something that is no packet.
    Skip,
    End,
    /// Not what the format says; nothing has been taken.
    Damaged,
    Truncated,
}

impl<R: Read> Reader<R> {
    /// Looks at the head of a file. A file that is no recording has a remark and no packets.
    pub fn new(source: R) -> Self {
        let mut window = Window::new(source);
        let mut remarks = Vec::new();
        let head = window.fill(24);
        let format = if let Some(pcap) = pcap::Pcap::new(head) {
            window.take(24);
            Format::Pcap(pcap)
        } else if head.starts_with(&pcapng::SECTION.to_le_bytes()) {
            Format::Pcapng(pcapng::Pcapng::default())
        } else {
            remarks.push(Remark::Foreign(looks_like(head)));
            Format::Foreign
        };
        Self {
            window,
            format,
            peeked: None,
            packets: 0,
            remarks,
            more_remarks: 0,
        }
    }

    /// The next packet.
    #[expect(
        clippy::should_implement_trait,
        reason = "it never ends with an error either"
    )]
    pub fn next(&mut self) -> Option<Packet> {
        self.peeked.take().or_else(|| self.read())
    }

    /// The next packet, which stays the next.
    pub fn peek(&mut self) -> Option<&Packet> {
        if self.peeked.is_none() {
            self.peeked = self.read();
        }
        self.peeked.as_ref()
    }

    fn read(&mut self) -> Option<Packet> {
        loop {
            let at = self.window.offset();
            let step = match &mut self.format {
                Format::Pcap(pcap) => pcap.step(&mut self.window),
                Format::Pcapng(pcapng) => pcapng.step(&mut self.window),
                Format::Foreign => return None,
            };
            match step {
                Step::Packet(mut packet) => {
                    self.packets += 1;
                    packet.number = self.packets;
                    return Some(packet);
                }
                Step::Skip => {}
                Step::End => return self.ended(),
                Step::Truncated => {
                    self.remark(Remark::Truncated {
                        at: self.window.end(),
                    });
                    self.format = Format::Foreign;
                    return self.ended();
                }
                Step::Damaged => {
                    self.window.take(1);
                    loop {
                        let sound = match &mut self.format {
                            Format::Pcap(pcap) => pcap.sound(&mut self.window),
                            Format::Pcapng(pcapng) => pcapng.sound(&mut self.window),
                            Format::Foreign => true,
                        };
                        if sound || self.window.take(1) == 0 {
                            break;
                        }
                    }
                    let skipped = self.window.offset() - at;
                    self.remark(Remark::Damaged { at, skipped });
                }
            }
        }
    }

    fn ended(&mut self) -> Option<Packet> {
        if let Some(error) = self.window.error() {
            let at = self.window.end();
            self.remark(Remark::Unreadable { at, error });
        }
        None
    }

    fn remark(&mut self, remark: Remark) {
        if self.remarks.len() < REMARKS {
            self.remarks.push(remark);
        } else {
            self.more_remarks += 1;
        }
    }

    /// What was noticed so far; the first ones.
    #[must_use]
    pub fn remarks(&self) -> &[Remark] {
        &self.remarks
    }

    /// Remarks that were not kept.
    #[must_use]
    pub fn more_remarks(&self) -> u64 {
        self.more_remarks
    }

    /// Bytes of the file that have been read.
    #[must_use]
    pub fn offset(&self) -> u64 {
        self.window.offset()
    }
}

/// What a file that is no recording may be.
fn looks_like(head: &[u8]) -> &'static str {
    match head {
        [] => "an empty file",
        [0x1f, 0x8b, ..] => "a gzip archive (unpack it first)",
        [0x28, 0xb5, 0x2f, 0xfd, ..] => "a zstd archive (unpack it first)",
        [0x04, 0x22, 0x4d, 0x18, ..] => "an lz4 archive (unpack it first)",
        [b'P', b'K', ..] => "a zip archive (unpack it first)",
        _ if head
            .iter()
            .all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace()) =>
        {
            "a text file"
        }
        _ => "some other file",
    }
}

/// Opens a file for reading.
///
/// # Errors
/// Where it cannot be opened; everything later is a [`Remark`].
pub fn open(path: &std::path::Path) -> io::Result<Reader<std::fs::File>> {
    let file = std::fs::File::open(path)?;
    if file.metadata()?.is_dir() {
        return Err(io::Error::from(io::ErrorKind::IsADirectory));
    }
    Ok(Reader::new(file))
}

#[cfg(test)]
mod tests;
