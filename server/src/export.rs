//! Samples as files: CSV and MCAP.

use std::io::{self, Write};
use std::sync::Arc;

use ecaxis_ecat::text::csv_cell;
use ecaxis_master::clock::Nanos;
use ecaxis_master::ros2::mcap::McapFile;
use ecaxis_master::ros2::topics::Topics;
use ecaxis_master::samples::Samples;

use crate::connection::Batch;

/// The rows that are read at once.
const PART: u64 = 4096;
/// Calls `take` with all kept rows between both times, in parts.
fn parts(
    samples: &Samples,
    words: &[usize],
    [from_ns, to_ns]: [Nanos; 2],
    mut take: impl FnMut(&Batch, usize) -> io::Result<()>,
) -> io::Result<()> {
    let end = samples.written();
    let mut next = end.saturating_sub(samples.capacity());
    while next < end {
        let count = PART.min(end - next);
        let part = Batch::read(samples, words, &mut next, count);
        let wanted = |row: &usize| (from_ns..=to_ns).contains(&part.times_ns[*row]);
        for row in (0..part.rows.len()).filter(wanted) {
            take(&part, row)?;
        }
    }
    Ok(())
}

/// Writes all kept rows between both times as CSV (RFC 4180). Values are exact; a value that does not
/// exist is empty.
///
/// # Errors
/// Fails if the text is not taken.
pub fn csv(
    out: &mut impl Write,
    samples: &Samples,
    words: &[usize],
    times: [Nanos; 2],
) -> io::Result<()> {
    write!(out, "row,time_ns")?;
    let signals = &samples.layout().signals;
    let known = |word: &usize| signals.iter().find(|signal| signal.word == *word);
    for signal in words.iter().filter_map(known) {
        let name = match signal.unit.is_empty() {
            true => signal.name.clone(),
            false => format!("{} [{}]", signal.name, signal.unit),
        };
        write!(out, ",{}", csv_cell(&name))?;
    }
    write!(out, "\r\n")?;
    parts(samples, words, times, |part, row| {
        write!(out, "{},{}", part.rows[row], part.times_ns[row])?;
        for values in &part.signals {
            out.write_all(b",")?;
            if values[row].is_finite() {
                write!(out, "{}", values[row])?;
            }
        }
        write!(out, "\r\n")
    })
}

/// Writes all kept rows between both times as MCAP, with the topics of the signals.
///
/// # Errors
/// Fails if the bytes are not taken.
pub fn mcap<W: Write>(
    out: W,
    samples: &Samples,
    topics: &Arc<Topics>,
    words: &[usize],
    [from_ns, to_ns]: [Nanos; 2],
) -> io::Result<W> {
    let wanted = |source| words.iter().any(|word| topics.words(source).contains(word));
    let mut file = McapFile::stream(out, Arc::clone(topics), wanted).map_err(io::Error::other)?;
    let (mut row, mut expected) = (Vec::new(), None);
    let end = samples.written();
    for number in end.saturating_sub(samples.capacity())..end {
        if !samples.read(number, &mut row) {
            continue;
        }
        let time = row.get(1);
        if !time.is_some_and(|time| (from_ns..=to_ns).contains(time)) {
            continue;
        }
        file.miss(number - expected.unwrap_or(number));
        expected = Some(number + 1);
        file.write_row(&row).map_err(io::Error::other)?;
    }
    Ok(file.finish().map_err(io::Error::other)?.into_inner())
}
