//! Samples as files: CSV and MCAP.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Cursor;

use ecaxis_master::clock::Nanos;
use ecaxis_master::samples::Samples;
use serde_json::json;

use crate::connection::Batch;

/// Rows of some signals with their names.
#[derive(Debug, Clone, PartialEq)]
pub struct Rows {
    /// Names and units.
    pub names: Vec<(String, String)>,
    pub batch: Batch,
}

impl Rows {
    /// Reads all kept rows between both times.
    #[must_use]
    pub fn read(samples: &Samples, words: &[usize], [from_ns, to_ns]: [Nanos; 2]) -> Self {
        let signals = &samples.layout().signals;
        let known = |word: &usize| signals.iter().find(|signal| signal.word == *word);
        let names = words.iter().filter_map(known);
        let names = names
            .map(|signal| (signal.name.clone(), signal.unit.clone()))
            .collect();
        let mut next = samples.written().saturating_sub(samples.capacity());
        let mut batch = Batch::read(samples, words, &mut next, u64::MAX);
        let keep: Vec<bool> = batch
            .times_ns
            .iter()
            .map(|time| (from_ns..=to_ns).contains(time))
            .collect();
        retain(&mut batch.rows, &keep);
        retain(&mut batch.times_ns, &keep);
        for values in &mut batch.signals {
            retain(values, &keep);
        }
        Self { names, batch }
    }
}

fn retain<T>(values: &mut Vec<T>, keep: &[bool]) {
    let mut each = keep.iter();
    values.retain(|_| each.next().copied().unwrap_or(false));
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
