//! The log of an agent's orders. It remembers their nonces.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::digest::FileDigest;
use super::files::{self, at};
use super::order::{Action, MAX_WINDOW, Order, OrderReply, Status};
use super::sender::EARLY;
use crate::error::{Error, Result};

/// The size at which the log begins again.
const MAX_LOG: u64 = 4 << 20;
/// The outcome of an order that was running when the agent ended.
pub(super) const INTERRUPTED: &str = "the agent ended during the order";
/// The nonces that are remembered.
const MAX_NONCES: usize = 20_000;

/// A line of the log.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Entry {
    unix_time: u64,
    /// The latest time that the log has seen.
    #[serde(default)]
    latest: u64,
    nonce: String,
    not_after: u64,
    sha256: FileDigest,
    sender: String,
    order: String,
    #[serde(flatten)]
    reply: OrderReply,
}

/// An order that was running when the agent ended.
#[derive(Debug, PartialEq, Eq)]
pub struct InterruptedOrder {
    pub nonce: String,
    pub sender: String,
    pub summary: String,
}

/// The log `orders.jsonl`, newest entry last, and its nonces.
#[derive(Debug)]
pub struct OrderJournal {
    path: PathBuf,
    file: File,
    /// The length of the whole entries.
    length: u64,
    /// The clock may be set back. It would make old orders valid again.
    latest: u64,
    known: BTreeMap<String, Entry>,
    /// The orders that were running when the agent ended.
    interrupted: Vec<InterruptedOrder>,
}

impl OrderJournal {
    /// Returns the orders that were running when the agent ended, once.
    pub fn take_interrupted(&mut self) -> Vec<InterruptedOrder> {
        std::mem::take(&mut self.interrupted)
    }

    /// Opens the log. An order that was running when the agent ended has failed.
    ///
    /// # Errors
    /// Fails if the log cannot be read, or not be opened for writing.
    pub fn open(path: &Path) -> Result<Self> {
        let (mut known, mut latest) = (BTreeMap::new(), 0);
        if path.exists() {
            let file = File::open(path).map_err(at(path))?;
            for line in BufReader::new(file).split(b'\n') {
                let line = line.map_err(at(path))?;
                // The last line may be incomplete; it was not acknowledged.
                if let Ok(entry) = serde_json::from_slice::<Entry>(&line) {
                    latest = latest.max(entry.latest).max(entry.unix_time);
                    known.insert(entry.nonce.clone(), entry);
                }
            }
        }
        let mut interrupted = Vec::new();
        for entry in known.values_mut() {
            if matches!(entry.reply.status, Status::Running | Status::Started) {
                entry.reply = OrderReply::new(Status::Failed, INTERRUPTED);
                interrupted.push(InterruptedOrder {
                    nonce: entry.nonce.clone(),
                    sender: entry.sender.clone(),
                    summary: entry.order.clone(),
                });
            }
        }
        let file = open(path)?;
        let length = whole_lines(path)?;
        let mut journal = Self {
            path: path.to_owned(),
            file,
            length,
            latest,
            known,
            interrupted,
        };
        // An agent on a full disk still stops its machine.
        if let Err(error) = journal.rewrite() {
            tracing::error!("the log of orders: {error}");
        }
        Ok(journal)
    }

    /// Returns the reply to an order that is known; an error if its nonce is that of another.
    ///
    /// # Errors
    /// Fails for another order with a known nonce.
    pub fn reply(&self, order: &Order, sha256: FileDigest) -> Result<Option<OrderReply>> {
        match self.known.get(&order.nonce) {
            Some(entry) if entry.sha256 == sha256 => Ok(Some(OrderReply {
                repeated: true,
                ..entry.reply.clone()
            })),
            Some(_) => Err(Error::new(
                "the nonce of the order was used by another order",
            )),
            None => Ok(None),
        }
    }

    /// Enters an order. After this, it is never executed again.
    ///
    /// # Errors
    /// Fails if the disk is full, too many orders are remembered, or the clock went back by a day.
    pub fn begin(
        &mut self,
        order: &Order,
        sha256: FileDigest,
        sender: &str,
        now: u64,
        reply: OrderReply,
    ) -> Result<()> {
        if now.saturating_add(MAX_WINDOW) < self.latest {
            let what = format!(
                "the clock is {} s behind the log of orders",
                self.latest - now
            );
            return Err(Error::new(what).help("set the clock of the machine's computer"));
        }
        self.latest = self.latest.max(now);
        // Each order that may be valid after this check is remembered.
        let latest = self.latest;
        self.known
            .retain(|_, entry| entry.not_after.saturating_add(MAX_WINDOW) >= latest);
        if self.known.len() >= MAX_NONCES {
            return Err(Error::new("the agent had too many orders today"));
        }
        self.enter(Entry {
            unix_time: now,
            latest: self.latest,
            nonce: order.nonce.clone(),
            not_after: order.not_after,
            sha256,
            sender: sender.to_owned(),
            order: order.action.summary(),
            reply,
        })
    }

    /// Returns true if an order `stop` was sent after this order, in the same second, or came after
    /// it was sent. The computers of two senders may have different clocks.
    #[must_use]
    pub fn stops_after(&self, order: &Order) -> bool {
        let sent = order.not_before.saturating_add(EARLY);
        let stop = Action::Stop { start: None }.summary();
        let mut stops = self.known.values().filter(|entry| entry.order == stop);
        stops.any(|entry| entry.not_after >= order.not_after || entry.unix_time >= sent)
    }

    /// Enters the nonce of a start that is not to begin. A known order stays as it is.
    ///
    /// # Errors
    /// Fails if the log cannot be written.
    pub fn revoke(&mut self, nonce: &str, not_after: u64, sender: &str, now: u64) -> Result<()> {
        if self.known.contains_key(nonce) {
            return Ok(());
        }
        self.enter(Entry {
            unix_time: now,
            latest: self.latest,
            nonce: nonce.to_owned(),
            not_after,
            // The order itself is not known.
            sha256: FileDigest::of(b""),
            sender: sender.to_owned(),
            order: "start".to_owned(),
            reply: OrderReply::new(Status::Refused, "cancelled before it came"),
        })
    }

    fn enter(&mut self, entry: Entry) -> Result<()> {
        self.append(&entry)?;
        self.known.insert(entry.nonce.clone(), entry);
        Ok(())
    }

    /// Changes the reply to an order, and enters it if `kept`.
    ///
    /// # Errors
    /// Fails if the log cannot be written.
    pub fn update(&mut self, nonce: &str, now: u64, reply: OrderReply, kept: bool) -> Result<()> {
        let Some(entry) = self.known.get_mut(nonce) else {
            return Ok(());
        };
        entry.reply = reply;
        entry.unix_time = now;
        self.latest = self.latest.max(now);
        entry.latest = self.latest;
        let entry = entry.clone();
        match kept {
            true => self.append(&entry),
            false => Ok(()),
        }
    }

    fn append(&mut self, entry: &Entry) -> Result<()> {
        if self.length > MAX_LOG {
            self.rewrite()?;
        }
        let line = format!("{}\n", serde_json::to_string(entry).unwrap_or_default());
        // A failed append may have left a part of a line, which would spoil this one.
        let cut = self.file.set_len(self.length);
        let written = cut.and_then(|()| self.file.write_all(line.as_bytes()));
        let stored = written.and_then(|()| self.file.sync_data());
        stored.map_err(at(&self.path))?;
        self.length += line.len() as u64;
        Ok(())
    }

    /// Begins the log again with the remembered orders. The old one remains as `orders.jsonl.1`.
    fn rewrite(&mut self) -> Result<()> {
        let size = self.file.metadata().map_err(at(&self.path))?.len();
        if size > MAX_LOG {
            let old = self.path.with_extension("jsonl.1");
            fs::copy(&self.path, &old).map_err(at(&old))?;
        }
        let latest = self.latest;
        let lines = self.known.values_mut().map(|entry| {
            entry.latest = latest;
            let line = serde_json::to_string(entry).unwrap_or_default();
            line + "\n"
        });
        let lines: String = lines.collect();
        files::write(&self.path, lines.as_bytes())?;
        self.file = open(&self.path)?;
        self.length = lines.len() as u64;
        Ok(())
    }
}

/// Returns the length of the lines that have an end.
fn whole_lines(path: &Path) -> Result<u64> {
    let bytes = fs::read(path).map_err(at(path))?;
    let end = bytes.iter().rposition(|byte| *byte == b'\n');
    Ok(end.map_or(0, |end| end as u64 + 1))
}

fn open(path: &Path) -> Result<File> {
    let file = OpenOptions::new().create(true).append(true).open(path);
    file.map_err(at(path))
}

#[cfg(test)]
mod tests {
    use super::super::order::Action;
    use super::*;

    const DAY: u64 = MAX_WINDOW;

    fn begin(journal: &mut OrderJournal, nonce: &str, now: u64) -> Result<()> {
        let machine = "hall/m1".parse().unwrap();
        let action = Action::Back { no_server: false };
        let order = Order::new(machine, action, now, now + 60, nonce.to_owned());
        let reply = OrderReply::new(Status::Done, "done");
        journal.begin(&order, FileDigest::of(nonce.as_bytes()), "anna", now, reply)
    }

    #[test]
    fn a_part_of_an_entry_does_not_spoil_the_next_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("orders.jsonl");
        let mut journal = OrderJournal::open(&path).unwrap();
        begin(&mut journal, "a", 1000).unwrap();
        // What an append on a full disk leaves.
        open(&path)
            .unwrap()
            .write_all(b"{\"unix_time\":10")
            .unwrap();
        begin(&mut journal, "b", 1001).unwrap();
        drop(journal);
        let again = OrderJournal::open(&path).unwrap();
        assert_eq!(again.known.keys().collect::<Vec<_>>(), ["a", "b"]);
    }

    #[test]
    fn an_order_stays_known_when_the_clock_is_set_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("orders.jsonl");
        let mut journal = OrderJournal::open(&path).unwrap();
        begin(&mut journal, "old", 10 * DAY).unwrap();
        begin(&mut journal, "new", 20 * DAY).unwrap();
        assert!(!journal.known.contains_key("old"));
        drop(journal);
        let mut again = OrderJournal::open(&path).unwrap();
        let error = begin(&mut again, "old", 10 * DAY).unwrap_err().to_string();
        assert!(error.contains("behind the log of orders"), "{error}");
        begin(&mut again, "next", 19 * DAY).unwrap();
        assert!(again.known.contains_key("new"));
        drop(again);
        // The entry with the lower time does not lower the latest.
        assert_eq!(OrderJournal::open(&path).unwrap().latest, 20 * DAY);
    }
}
