//! Records all frames of a link in a pcapng file.
//!
//! [`Recorder`] has two sides: one is called from the cycle, the other writes the file. With
//! [`WriterMode::Background`] a ring of bytes connects the cycle to a writer thread, and a counter
//! counts the frames that do not fit. [`WriterMode::Inline`] writes in the calling thread and loses
//! nothing, which is acceptable in virtual time.
//!
//! With a limit, a recording is written in parts. Each part is a complete file of a quarter of the
//! limit. The first part, under the requested name, is kept: it shows the devices on the bus and
//! their configuration. Of the other, numbered parts (`run.0001.pcapng`), the newest three are
//! kept.

use std::fmt;
use std::io;
use std::path::Path;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use rtrb::{Consumer, Producer, RingBuffer};

use super::redundant::RingStatus;
use super::{Link, LinkError, LinkStats, MAX_FRAME, Nanos};
use crate::clock;
use crate::recording::Direction;
use crate::sys::rights;

mod file;

use file::RotatingWriter;
pub use file::parts_of;

/// Bytes between the cycle and the writer: about one second at 8 kHz with 200-byte frames.
const RING: usize = 4 << 20;
const HEADER: usize = 11;
const WRITER_PAUSE: Duration = Duration::from_millis(2);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WriterMode {
    /// The caller writes the file.
    Inline,
    /// A thread writes the file; the caller never blocks and frames may be dropped, counted.
    Background,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RecordStats {
    pub written: u64,
    /// Frames dropped because the ring was full or they exceeded the maximum length.
    pub dropped: u64,
}

/// Writes frames to a recording.
pub struct Recorder {
    sink: Sink,
    dropped: u64,
}

enum Sink {
    Inline {
        file: RotatingWriter,
        error: Option<io::Error>,
    },
    Background {
        ring: Producer<u8>,
        writer: JoinHandle<io::Result<u64>>,
    },
}

impl Recorder {
    /// Creates the file, writes its header and, for [`WriterMode::Background`], starts the writer.
    /// The file begins with the comment. With a `limit` the recording uses at most that many bytes. Parts of an older recording of
    /// this name are removed.
    ///
    /// # Errors
    /// Fails if the file cannot be created or written, or the thread cannot be started.
    pub fn create(
        path: &Path,
        mode: WriterMode,
        limit: Option<u64>,
        comment: &str,
    ) -> io::Result<Self> {
        let file = RotatingWriter::create(path, limit, comment)?;
        let sink = match mode {
            WriterMode::Inline => Sink::Inline { file, error: None },
            WriterMode::Background => {
                let (mut ring, mut reader) = RingBuffer::new(RING);
                touch(&mut ring, &mut reader);
                let writer = thread::Builder::new()
                    .name("record".into())
                    .spawn(move || {
                        rights::drop_capabilities();
                        write_all(reader, file)
                    })?;
                Sink::Background { ring, writer }
            }
        };
        Ok(Self { sink, dropped: 0 })
    }

    /// Records one frame. `at` is nanoseconds since 1970. RT with [`WriterMode::Background`]: never
    /// blocks or allocates; O(bytes). Write errors are returned by [`Recorder::finish`].
    pub fn frame(&mut self, dir: Direction, at: Nanos, frame: &[u8]) {
        let len = match u16::try_from(frame.len()) {
            Ok(len) if frame.len() <= MAX_FRAME => len,
            _ => {
                self.dropped += 1;
                return;
            }
        };
        match &mut self.sink {
            Sink::Inline { file, error } => {
                if error.is_some() {
                    self.dropped += 1;
                } else if let Err(e) = file.packet(dir, at, frame) {
                    self.dropped += 1;
                    *error = Some(e);
                }
            }
            Sink::Background { ring, .. } => {
                if ring.slots() < HEADER + frame.len() {
                    self.dropped += 1;
                    return;
                }
                let mut head = [0; HEADER];
                head[0] = u8::from(dir == Direction::In);
                head[1..3].copy_from_slice(&len.to_le_bytes());
                head[3..].copy_from_slice(&at.to_le_bytes());
                // Both fit: only this side fills the ring.
                let _ = ring.push_entire_slice(&head);
                let _ = ring.push_entire_slice(frame);
            }
        }
    }

    /// Returns the number of frames not recorded so far. RT.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Writes all buffered frames and closes the file.
    ///
    /// # Errors
    /// The first write error.
    pub fn finish(self) -> io::Result<RecordStats> {
        let written = match self.sink {
            Sink::Inline { error: Some(e), .. } => return Err(e),
            Sink::Inline { file, error: None } => file.finish()?,
            Sink::Background { ring, writer } => {
                drop(ring);
                writer
                    .join()
                    .map_err(|_| io::Error::other("the recording thread died"))??
            }
        };
        Ok(RecordStats {
            written,
            dropped: self.dropped,
        })
    }
}

impl fmt::Debug for Recorder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mode = match self.sink {
            Sink::Inline { .. } => WriterMode::Inline,
            Sink::Background { .. } => WriterMode::Background,
        };
        f.debug_struct("Recorder")
            .field("mode", &mode)
            .field("dropped", &self.dropped)
            .finish()
    }
}

/// Touches all pages of the ring, so that they exist before the cycle starts.
fn touch(ring: &mut Producer<u8>, reader: &mut Consumer<u8>) {
    let zeros = [0; 4096];
    let mut sink = [0; 4096];
    for _ in 0..RING.div_ceil(zeros.len()) {
        let _ = ring.push_partial_slice(&zeros);
        let _ = reader.pop_partial_slice(&mut sink);
    }
}

fn write_all(mut ring: Consumer<u8>, mut file: RotatingWriter) -> io::Result<u64> {
    let mut head = [0; HEADER];
    let mut frame = [0; MAX_FRAME];
    let mut failed = None;
    loop {
        // Read before the ring: anything pushed before the producer was dropped is still found
        // below.
        let last = ring.is_abandoned();
        while ring.slots() >= HEADER {
            if ring.pop_entire_slice(&mut head).is_err() {
                break;
            }
            let dir = if head[0] == 0 {
                Direction::Out
            } else {
                Direction::In
            };
            let len = usize::from(u16::from_le_bytes([head[1], head[2]])).min(MAX_FRAME);
            let mut at = [0; 8];
            at.copy_from_slice(&head[3..]);
            let frame = &mut frame[..len];
            while ring.pop_entire_slice(frame).is_err() {
                if ring.is_abandoned() && ring.slots() < len {
                    return Err(io::Error::other("the recording ends within a frame"));
                }
                thread::yield_now();
            }
            // After a write error the ring is still emptied, so that the cycle is not affected.
            if failed.is_none() {
                failed = file.packet(dir, u64::from_le_bytes(at), frame).err();
            }
        }
        if last {
            return match failed {
                Some(e) => Err(e),
                None => file.finish(),
            };
        }
        thread::sleep(WRITER_PAUSE);
    }
}

/// Records all frames that pass through.
#[derive(Debug)]
pub struct CapturingLink {
    inner: Box<dyn Link>,
    recorder: Recorder,
    /// Added to the clock's time to get nanoseconds since 1970.
    epoch: Nanos,
}

impl CapturingLink {
    #[must_use]
    pub fn new(inner: Box<dyn Link>, recorder: Recorder, epoch: Nanos) -> Self {
        Self {
            inner,
            recorder,
            epoch,
        }
    }
}

impl Link for CapturingLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        self.recorder
            .frame(Direction::Out, clock::now() + self.epoch, frame);
        self.inner.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        let received = self.inner.recv(buf)?;
        if let Some(len) = received {
            self.recorder
                .frame(Direction::In, clock::now() + self.epoch, &buf[..len]);
        }
        Ok(received)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.inner.next_arrival()
    }

    fn main_devices(&self) -> u64 {
        self.inner.main_devices()
    }

    fn stats(&mut self) -> LinkStats {
        self.inner.stats()
    }

    fn ring(&self) -> Option<&'static RingStatus> {
        self.inner.ring()
    }

    fn nic(&self) -> Option<&str> {
        self.inner.nic()
    }

    fn take_sim_inputs(&mut self) -> Option<super::sim::SimInputSender> {
        self.inner.take_sim_inputs()
    }

    fn exhausted_reason(&self) -> Option<&'static str> {
        self.inner.exhausted_reason()
    }

    fn notices(&mut self) -> Vec<String> {
        self.inner.notices()
    }

    fn finish(self: Box<Self>) -> io::Result<Option<RecordStats>> {
        self.recorder.finish().map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pcap_file::pcapng::blocks::enhanced_packet::EnhancedPacketOption;
    use pcap_file::pcapng::{Block, PcapNgReader};

    fn sample() -> Vec<(Direction, Nanos, Vec<u8>)> {
        (0..500_u32)
            .map(|i| {
                let dir = if i % 2 == 0 {
                    Direction::Out
                } else {
                    Direction::In
                };
                let at = 1_700_000_000_000_000_123 + u64::from(i) * 1_000_001;
                let len = 60 + (i as usize * 37) % (MAX_FRAME - 59);
                (dir, at, (0..len).map(|b| (b % 251) as u8).collect())
            })
            .collect()
    }

    fn record(mode: WriterMode) -> (Vec<u8>, RecordStats) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pcapng");
        let mut recorder = Recorder::create(&path, mode, None, "").unwrap();
        for (dir, at, frame) in sample() {
            recorder.frame(dir, at, &frame);
        }
        let stats = recorder.finish().unwrap();
        (std::fs::read(path).unwrap(), stats)
    }

    #[test]
    fn recording_contains_each_frame_with_time_and_direction() {
        let (bytes, stats) = record(WriterMode::Inline);
        assert_eq!(
            stats,
            RecordStats {
                written: 500,
                dropped: 0
            }
        );
        let mut reader = PcapNgReader::new(bytes.as_slice()).unwrap();
        let mut expected = sample().into_iter();
        let mut seen = 0;
        while let Some(block) = reader.next_block() {
            let Block::EnhancedPacket(packet) = block.unwrap().into_owned() else {
                continue;
            };
            let (dir, at, frame) = expected.next().unwrap();
            assert_eq!(packet.data.as_ref(), frame);
            assert_eq!(packet.original_len as usize, frame.len());
            // The crate returns the raw value as nanoseconds, which is correct here.
            assert_eq!(packet.timestamp, Duration::from_nanos(at));
            let flags = packet.options.iter().find_map(|o| match o {
                EnhancedPacketOption::Flags(flags) => Some(*flags),
                _ => None,
            });
            assert_eq!(flags, Some(file::flag(dir)));
            seen += 1;
        }
        assert_eq!(seen, 500);
    }

    #[test]
    fn both_modes_write_the_same_bytes() {
        let (inline, _) = record(WriterMode::Inline);
        let (background, stats) = record(WriterMode::Background);
        assert_eq!(
            stats,
            RecordStats {
                written: 500,
                dropped: 0
            }
        );
        assert_eq!(inline, background);
    }

    #[test]
    fn recorder_counts_dropped_frames() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pcapng");
        let mut recorder = Recorder::create(&path, WriterMode::Background, None, "").unwrap();
        let frame = [0x5a; MAX_FRAME];
        let sent = 20_000;
        for at in 0..sent {
            recorder.frame(Direction::Out, at, &frame);
        }
        recorder.frame(Direction::Out, sent, &[0; MAX_FRAME + 1]);
        let stats = recorder.finish().unwrap();
        assert!(stats.dropped >= 1);
        assert_eq!(stats.written + stats.dropped, sent + 1);
    }

    #[test]
    fn finish_returns_the_error_of_a_full_disk() {
        let full = Path::new("/dev/full");
        let mut recorder = Recorder::create(full, WriterMode::Background, None, "").unwrap();
        for at in 0..2000 {
            recorder.frame(Direction::In, at, &[0; 1000]);
        }
        assert!(recorder.finish().is_err());
    }
}
