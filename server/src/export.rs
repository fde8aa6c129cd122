//! Samples as files: CSV and MCAP.

use std::fmt::Write as _;
use std::io::Cursor;
use std::sync::Arc;

use ecaxis_master::clock::Nanos;
use ecaxis_master::ros2::mcap::{McapError, McapFile};
use ecaxis_master::ros2::topics::Topics;
use ecaxis_master::samples::Samples;

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
                return Err(too_large());
            }
        }
        Ok(Self { names, batch })
    }
}

fn too_large() -> OpError {
    OpError::new(ErrorCode::TooLarge, "more than 8 million values")
        .help("choose fewer signals or a shorter time")
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

/// Returns all kept rows between both times as MCAP, with the topics of the signals.
///
/// # Errors
/// Fails if the rows have more than 8 million values.
pub fn mcap(
    samples: &Samples,
    topics: &Arc<Topics>,
    words: &[usize],
    [from_ns, to_ns]: [Nanos; 2],
) -> Result<Vec<u8>, OpError> {
    let failed = |error: McapError| OpError::new(ErrorCode::Failed, error.to_string());
    let wanted = |source| words.iter().any(|word| topics.words(source).contains(word));
    let bytes = Cursor::new(Vec::new());
    let mut file = McapFile::new(bytes, Arc::clone(topics), wanted).map_err(failed)?;
    let (mut row, mut values, mut expected) = (Vec::new(), 0, None);
    let end = samples.written();
    for number in end.saturating_sub(samples.capacity())..end {
        if !samples.read(number, &mut row) {
            continue;
        }
        if !row
            .get(1)
            .is_some_and(|time| (from_ns..=to_ns).contains(time))
        {
            continue;
        }
        file.miss(number - expected.unwrap_or(number));
        expected = Some(number + 1);
        values += row.len();
        if values > VALUES {
            return Err(too_large());
        }
        file.write_row(&row).map_err(failed)?;
    }
    Ok(file.finish().map_err(failed)?.into_inner())
}
