//! MCAP files (<https://mcap.dev>) with the topics of a machine.

use std::collections::BTreeMap;
use std::io::{Seek, Write};
use std::sync::Arc;

use ::mcap::records::{MessageHeader, Metadata};
use ::mcap::write::NoSeek;
use ::mcap::{WriteOptions, Writer};

use super::topics::{Diagnostic, Source, Topics, encode_diagnostics};
use crate::clock::Nanos;

pub use ::mcap::McapError;

/// An MCAP file that is being written.
pub struct McapFile<W: Write + Seek> {
    writer: Writer<W>,
    topics: Arc<Topics>,
    /// The channels with the sources of their messages.
    channels: Vec<(u16, Source)>,
    rows: u64,
    missed: u64,
    /// Rows missed since the last row.
    gap: u64,
    message: Vec<u8>,
}

impl<W: Write + Seek> McapFile<W> {
    /// Begins a file with those topics whose sources are wanted.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn new(
        file: W,
        topics: Arc<Topics>,
        wanted: impl Fn(Source) -> bool,
    ) -> Result<Self, McapError> {
        Self::create(file, WriteOptions::new(), topics, wanted)
    }

    fn create(
        file: W,
        options: WriteOptions,
        topics: Arc<Topics>,
        wanted: impl Fn(Source) -> bool,
    ) -> Result<Self, McapError> {
        let library = concat!("ecaxis ", env!("CARGO_PKG_VERSION"));
        let options = options.profile("ros2").compression(None).library(library);
        let mut writer = options.create(file)?;
        let mut channels = Vec::new();
        for topic in topics.list().iter().filter(|topic| wanted(topic.source)) {
            let schema = &topic.schema;
            let schema = writer.add_schema(schema.name, "ros2msg", schema.text.as_bytes())?;
            let channel = writer.add_channel(schema, &topic.name, "cdr", &BTreeMap::new())?;
            channels.push((channel, topic.source));
        }
        Ok(Self {
            writer,
            topics,
            channels,
            rows: 0,
            missed: 0,
            gap: 0,
            message: Vec::new(),
        })
    }

    /// Notes that rows are missing before the next one.
    pub fn miss(&mut self, rows: u64) {
        self.gap += rows;
        self.missed += rows;
    }

    /// Writes the messages of a row of samples.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn write_row(&mut self, row: &[u64]) -> Result<(), McapError> {
        let time = row.get(1).copied().unwrap_or_default();
        let gap = std::mem::take(&mut self.gap);
        for index in 0..self.channels.len() {
            let (channel, source) = self.channels[index];
            self.message.clear();
            if self.topics.encode(source, row, gap, &mut self.message) {
                self.write(channel, self.topics.unix_time(time))?;
            }
        }
        self.rows += 1;
        Ok(())
    }

    /// Writes the diagnostics at a time in ns since 1970.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn write_diagnostics(
        &mut self,
        time: Nanos,
        diagnostics: &[Diagnostic],
    ) -> Result<(), McapError> {
        let mut channels = self.channels.iter();
        let Some((channel, _)) = channels.find(|(_, source)| *source == Source::Diagnostics) else {
            return Ok(());
        };
        let channel = *channel;
        self.message.clear();
        encode_diagnostics(time, diagnostics, &mut self.message);
        self.write(channel, time)
    }

    /// Completes a part of the file: if the rest is lost, this part is still readable.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn flush(&mut self) -> Result<(), McapError> {
        self.writer.flush()
    }

    fn write(&mut self, channel_id: u16, time: Nanos) -> Result<(), McapError> {
        let header = MessageHeader {
            channel_id,
            sequence: self.rows as u32,
            log_time: time,
            publish_time: time,
        };
        self.writer.write_to_known_channel(&header, &self.message)
    }

    /// Completes the file. Its metadata `ecaxis` have the numbers of rows and of missing rows, and
    /// the time in ns since 1970 at which the clock of the samples was 0.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn finish(mut self) -> Result<W, McapError> {
        let numbers = [
            ("rows", self.rows),
            ("missed", self.missed),
            ("epoch_ns", self.topics.epoch()),
        ];
        self.writer.write_metadata(&Metadata {
            name: "ecaxis".to_owned(),
            metadata: numbers
                .map(|(key, n)| (key.to_owned(), n.to_string()))
                .into(),
        })?;
        self.writer.finish()?;
        let mut file = self.writer.into_inner();
        file.flush()?;
        Ok(file)
    }
}

impl<W: Write> McapFile<NoSeek<W>> {
    /// Begins a file that is written from its begin to its end, such as the answer to a request.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn stream(
        to: W,
        topics: Arc<Topics>,
        wanted: impl Fn(Source) -> bool,
    ) -> Result<Self, McapError> {
        let options = WriteOptions::new().disable_seeking(true);
        Self::create(NoSeek::new(to), options, topics, wanted)
    }
}

impl<W: Write + Seek> std::fmt::Debug for McapFile<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("McapFile")
            .field("rows", &self.rows)
            .field("missed", &self.missed)
            .finish_non_exhaustive()
    }
}
