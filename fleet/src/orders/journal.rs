//! The log of an agent's orders. It remembers their nonces.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::digest::FileDigest;
use super::files::{self, at};
use super::order::{MAX_WINDOW, Order, OrderReply, Status};
use crate::error::{Error, Result};

/// The size at which the log begins again.
const MAX_LOG: u64 = 4 << 20;
/// The nonces that are remembered.
const MAX_NONCES: usize = 20_000;

/// A line of the log.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Entry {
    unix_time: u64,
    nonce: String,
    not_after: u64,
    sha256: FileDigest,
    sender: String,
    order: String,
    #[serde(flatten)]
    reply: OrderReply,
}

/// The log `orders.jsonl`, newest entry last, and its nonces.
#[derive(Debug)]
pub struct OrderJournal {
    path: PathBuf,
    file: File,
    known: BTreeMap<String, Entry>,
}

impl OrderJournal {
    /// Opens the log. An order that was running when the agent ended has failed.
    ///
    /// # Errors
    /// Fails if the log cannot be read or written.
    pub fn open(path: &Path) -> Result<Self> {
        let mut known = BTreeMap::new();
        if path.exists() {
            let file = File::open(path).map_err(at(path))?;
            for line in BufReader::new(file).split(b'\n') {
                let line = line.map_err(at(path))?;
                // The last line may be incomplete; it was not acknowledged.
                if let Ok(entry) = serde_json::from_slice::<Entry>(&line) {
                    known.insert(entry.nonce.clone(), entry);
                }
            }
        }
        for entry in known.values_mut() {
            if matches!(entry.reply.status, Status::Running | Status::Started) {
                entry.reply = OrderReply::new(Status::Failed, "the agent ended during the order");
            }
        }
        let file = open(path)?;
        let mut journal = Self {
            path: path.to_owned(),
            file,
            known,
        };
        journal.rewrite()?;
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
    /// Fails if the disk is full, or too many orders are remembered.
    pub fn begin(
        &mut self,
        order: &Order,
        sha256: FileDigest,
        sender: &str,
        now: u64,
        reply: OrderReply,
    ) -> Result<()> {
        // The clock may be set back by a day.
        self.known
            .retain(|_, entry| entry.not_after.saturating_add(MAX_WINDOW) >= now);
        if self.known.len() >= MAX_NONCES {
            return Err(Error::new("the agent had too many orders today"));
        }
        let entry = Entry {
            unix_time: now,
            nonce: order.nonce.clone(),
            not_after: order.not_after,
            sha256,
            sender: sender.to_owned(),
            order: order.action.summary(),
            reply,
        };
        self.append(&entry)?;
        self.known.insert(order.nonce.clone(), entry);
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
        let entry = entry.clone();
        match kept {
            true => self.append(&entry),
            false => Ok(()),
        }
    }

    fn append(&mut self, entry: &Entry) -> Result<()> {
        let size = self.file.metadata().map_err(at(&self.path))?.len();
        if size > MAX_LOG {
            self.rewrite()?;
        }
        let line = format!("{}\n", serde_json::to_string(entry).unwrap_or_default());
        let written = self.file.write_all(line.as_bytes());
        let stored = written.and_then(|()| self.file.sync_data());
        stored.map_err(at(&self.path))
    }

    /// Begins the log again with the remembered orders. The old one remains as `orders.jsonl.1`.
    fn rewrite(&mut self) -> Result<()> {
        let size = self.file.metadata().map_err(at(&self.path))?.len();
        if size > MAX_LOG {
            let old = self.path.with_extension("jsonl.1");
            fs::copy(&self.path, &old).map_err(at(&old))?;
        }
        let lines = self.known.values().map(|entry| {
            let line = serde_json::to_string(entry).unwrap_or_default();
            line + "\n"
        });
        files::write(&self.path, lines.collect::<String>().as_bytes())?;
        self.file = open(&self.path)?;
        Ok(())
    }
}

fn open(path: &Path) -> Result<File> {
    let file = OpenOptions::new().create(true).append(true).open(path);
    file.map_err(at(path))
}
