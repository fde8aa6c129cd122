//! A link that records all frames of an inner link.

use std::io;

use super::capture::{Dir, RecordStats, Recorder};
use super::{Link, LinkError, LinkStats, MAX_FRAME, Nanos};
use crate::clock;

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
            .frame(Dir::Out, clock::now() + self.epoch, frame);
        self.inner.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        let received = self.inner.recv(buf)?;
        if let Some(len) = received {
            self.recorder
                .frame(Dir::In, clock::now() + self.epoch, &buf[..len]);
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
