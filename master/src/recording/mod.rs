//! Reads pcap and pcapng files of any origin. Damage and truncation become a [`ReadIssue`], and
//! reading continues behind them. Memory is bounded for files of any length.
//!
//! - [`Reader`]: the packets of a file in order;
//! - `pcap`, `pcapng`: the two formats;
//! - `window`: the buffer;
//! - [`frame`]: the EtherCAT datagrams of a packet.

use std::fmt;
use std::io::{self, Read};

pub mod frame;
mod pcap;
mod pcapng;
mod window;

use window::PeekReader;

/// The maximum packet size. Larger ones are damaged: Ethernet has 1518 bytes, jumbo frames 9000.
const MAX_PACKET: usize = 256 * 1024;

/// The direction of a packet, if recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Sent by the recording computer.
    Out,
    In,
}

/// One packet of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Packet {
    /// The packet number from 1, as in Wireshark.
    pub number: u64,
    /// The time in ns since 1970; `None` if the format has no time.
    pub at: Option<u64>,
    pub interface: u32,
    /// LINKTYPE_… from <https://www.tcpdump.org/linktypes.html>.
    pub link_type: u16,
    pub direction: Option<Direction>,
    pub data: Vec<u8>,
    /// The length on the wire; more than `data` if the recording truncated it.
    pub original_len: usize,
}

/// A problem of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum ReadIssue {
    /// The file is not a recording; its probable type.
    Foreign(&'static str),
    /// The file ends within a packet, at this byte.
    Truncated { at: u64 },
    /// The data at this byte are not a packet. The next packet or the end of the file follows after
    /// `skipped` bytes.
    Damaged { at: u64, skipped: u64 },
    /// An operating system error during reading.
    Unreadable { at: u64, error: String },
}

impl fmt::Display for ReadIssue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Foreign(what) => write!(f, "this is not a recording but {what}"),
            Self::Truncated { at } => write!(f, "the file ends within a packet, at byte {at}"),
            Self::Damaged { at, skipped } => {
                write!(f, "damaged at byte {at}: {skipped} bytes were skipped")
            }
            Self::Unreadable { at, error } => write!(f, "cannot be read beyond byte {at}: {error}"),
        }
    }
}

/// The maximum number of stored issues.
const REMARKS: usize = 16;

#[derive(Debug)]
enum Format {
    Pcap(pcap::Pcap),
    Pcapng(pcapng::Pcapng),
    Foreign,
}

/// The packets of a file in file order.
#[derive(Debug)]
pub struct Reader<R> {
    window: PeekReader<R>,
    format: Format,
    peeked: Option<Packet>,
    packets: u64,
    remarks: Vec<ReadIssue>,
    more_remarks: u64,
}

/// The result of parsing at the present position.
enum Step {
    Packet(Packet),
    /// A block without a packet.
    Skip,
    End,
    /// Invalid data; nothing was consumed.
    Damaged,
    Truncated,
}

impl<R: Read> Reader<R> {
    /// Detects the format. A file that is not a recording has one issue and no packets.
    pub fn new(source: R) -> Self {
        let mut window = PeekReader::new(source);
        let mut remarks = Vec::new();
        let head = window.fill(24);
        let format = if let Some(pcap) = pcap::Pcap::new(head) {
            window.take(24);
            Format::Pcap(pcap)
        } else if head.starts_with(&pcapng::SECTION.to_le_bytes()) {
            Format::Pcapng(pcapng::Pcapng::default())
        } else {
            remarks.push(ReadIssue::Foreign(looks_like(head)));
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

    /// Returns the next packet.
    #[expect(
        clippy::should_implement_trait,
        reason = "it never ends with an error either"
    )]
    pub fn next(&mut self) -> Option<Packet> {
        self.peeked.take().or_else(|| self.read())
    }

    /// Returns the next packet without consuming it.
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
                    self.remark(ReadIssue::Truncated {
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
                    self.remark(ReadIssue::Damaged { at, skipped });
                }
            }
        }
    }

    fn ended(&mut self) -> Option<Packet> {
        if let Some(error) = self.window.error() {
            let at = self.window.end();
            self.remark(ReadIssue::Unreadable { at, error });
        }
        None
    }

    fn remark(&mut self, remark: ReadIssue) {
        if self.remarks.len() < REMARKS {
            self.remarks.push(remark);
        } else {
            self.more_remarks += 1;
        }
    }

    /// Returns the first issues.
    #[must_use]
    pub fn remarks(&self) -> &[ReadIssue] {
        &self.remarks
    }

    /// Returns the number of issues that were not stored.
    #[must_use]
    pub fn more_remarks(&self) -> u64 {
        self.more_remarks
    }

    /// Returns the number of bytes read.
    #[must_use]
    pub fn offset(&self) -> u64 {
        self.window.offset()
    }
}

/// Returns the probable type of a file that is not a recording.
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

/// Opens a file.
///
/// # Errors
/// Fails if it cannot be opened. Later errors are [`ReadIssue`]s.
pub fn open(path: &std::path::Path) -> io::Result<Reader<std::fs::File>> {
    let file = std::fs::File::open(path)?;
    if file.metadata()?.is_dir() {
        return Err(io::Error::from(io::ErrorKind::IsADirectory));
    }
    Ok(Reader::new(file))
}

#[cfg(test)]
mod tests;
