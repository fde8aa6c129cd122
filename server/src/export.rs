//! Samples as files: CSV and MCAP.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Cursor;

use ecaxis_master::clock::Nanos;
use ecaxis_master::samples::Samples;
use serde_json::json;

use crate::connection::Batch;
use crate::error::{ErrorCode, OpError};

/// The rows that are read at once.
const PART: u64 = 4096;
/// The most values of a file: its text is in memory.
const VALUES: usize = 8 << 20;

/// Rows of some signals with their names.
#[derive(Debug, Clone, PartialEq)]
pub struct Rows {
    /// Names and units.
    pub names: Vec<(String, String)>,
    pub batch: Batch,
}

impl Rows {
    /// Reads all kept rows between both times.
    ///
    /// # Errors
    /// Fails if they have more than 8 million values.
    pub fn read(
        samples: &Samples,
        words: &[usize],
        [from_ns, to_ns]: [Nanos; 2],
    ) -> Result<Self, OpError> {
        let signals = &samples.layout().signals;
        let known = |word: &usize| signals.iter().find(|signal| signal.word == *word);
        let names = words.iter().filter_map(known);
        let names = names
            .map(|signal| (signal.name.clone(), signal.unit.clone()))
            .collect();
        let mut batch = Batch {
            signals: vec![Vec::new(); words.len()],
            ..Batch::default()
        };
        let mut next = samples.written().saturating_sub(samples.capacity());
        let end = samples.written();
        while next < end {
            let count = PART.min(end - next);
            let part = Batch::read(samples, words, &mut next, count);
            let wanted = |row: &usize| (from_ns..=to_ns).contains(&part.times_ns[*row]);
            for row in (0..part.rows.len()).filter(wanted) {
                batch.rows.push(part.rows[row]);
                batch.times_ns.push(part.times_ns[row]);
                for (to, from) in batch.signals.iter_mut().zip(&part.signals) {
                    to.push(from[row]);
                }
            }
            if batch.rows.len().saturating_mul(words.len().max(1)) > VALUES {
                let error = OpError::new(ErrorCode::TooLarge, "more than 8 million values");
                return Err(error.help("choose fewer signals or a shorter time"));
            }
        }
        Ok(Self { names, batch })
    }
}

/// Returns the rows as CSV (RFC 4180). Values are exact; a value that does not exist is empty.
#[must_use]
pub fn csv(rows: &Rows) -> String {
    let mut text = String::from("row,time_ns");
    for (name, unit) in &rows.names {
        let name = match unit.is_empty() {
            true => name.clone(),
            false => format!("{name} [{unit}]"),
        };
        let _ = write!(text, ",\"{}\"", name.replace('"', "\"\""));
    }
    text.push_str("\r\n");
    for (index, (row, time)) in rows.batch.rows.iter().zip(&rows.batch.times_ns).enumerate() {
        let _ = write!(text, "{row},{time}");
        for values in &rows.batch.signals {
            text.push(',');
            if let Some(value) = values.get(index).filter(|value| value.is_finite()) {
                let _ = write!(text, "{value}");
            }
        }
        text.push_str("\r\n");
    }
    text
}

/// Returns the rows as MCAP: one channel with JSON messages, one for each cycle.
///
/// # Errors
/// Fails if the writer fails.
pub fn mcap(rows: &Rows) -> Result<Vec<u8>, mcap::McapError> {
    let mut bytes = Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().profile("").compression(None);
    let mut writer = options.create(&mut bytes)?;
    let mut properties = serde_json::Map::new();
    properties.insert("row".to_owned(), json!({"type": "integer"}));
    for (name, unit) in &rows.names {
        let about = json!({"type": ["number", "null"], "description": unit});
        properties.insert(name.clone(), about);
    }
    let schema = json!({"type": "object", "properties": properties});
    let schema = serde_json::to_vec(&schema).unwrap_or_default();
    let schema = writer.add_schema("ecaxis.Samples", "jsonschema", &schema)?;
    let channel = writer.add_channel(schema, "/samples", "json", &BTreeMap::new())?;
    for (index, (row, time)) in rows.batch.rows.iter().zip(&rows.batch.times_ns).enumerate() {
        let mut message = serde_json::Map::new();
        message.insert("row".to_owned(), json!(row));
        for ((name, _), values) in rows.names.iter().zip(&rows.batch.signals) {
            message.insert(name.clone(), json!(values.get(index)));
        }
        let data = serde_json::to_vec(&message).unwrap_or_default();
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            // At most 2^32 rows are kept.
            sequence: u32::try_from(*row & u64::from(u32::MAX)).unwrap_or(0),
            log_time: *time,
            publish_time: *time,
        };
        writer.write_to_known_channel(&header, &data)?;
    }
    writer.finish()?;
    drop(writer);
    Ok(bytes.into_inner())
}
