//! Receives orders and executes them, one at a time.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde::Deserialize;

use super::digest::FileDigest;
use super::journal::{INTERRUPTED, OrderJournal};
use super::order::{Action, Order, OrderReply, SignedOrder, Status};
use super::server;
use super::signing::{KeyTable, Keyring};
use super::slots::Slots;
use super::store::{FileSource, FileStore};
use super::switch::SwitchOrder;
use crate::config;
use crate::error::{Error, Result};
use crate::keys::MachineId;

/// The table `[orders]` of an agent's file.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OrdersTable {
    /// The folder of the slots, the log and the received files.
    pub folder: PathBuf,
    /// The machine file that the server uses. With bundles: in `FOLDER/current`.
    pub machine_file: PathBuf,
    /// The program.
    #[serde(default = "ecaxis")]
    pub ecaxis: String,
    /// The command that restarts the server. Without it, bundles are refused.
    #[serde(default)]
    pub restart: Vec<String>,
    /// The time in which the machine is healthy after a change, in s.
    #[serde(default = "health_timeout_s")]
    pub health_timeout_s: u64,
    /// False: bundles are not compared with the bus.
    #[serde(default = "compare")]
    pub compare: bool,
}

fn ecaxis() -> String {
    "ecaxis".to_owned()
}

fn health_timeout_s() -> u64 {
    60
}

fn compare() -> bool {
    true
}

/// Executes the orders to one machine.
pub struct OrderExecutor {
    pub(super) machine: MachineId,
    pub(super) socket: PathBuf,
    pub(super) table: OrdersTable,
    pub(super) keys: Keyring,
    pub(super) store: FileStore,
    pub(super) slots: Slots,
    pub(super) source: Arc<dyn FileSource>,
    journal: Mutex<OrderJournal>,
    running: Mutex<Option<Running>>,
}

/// The order that is executed.
#[derive(Debug)]
struct Running {
    summary: String,
    nonce: String,
    /// An order `stop` ends a start.
    stop: Arc<AtomicBool>,
}

/// The time in which a start ends after an order `stop`.
const STOPPED: Duration = Duration::from_secs(5);

impl fmt::Debug for OrderExecutor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut shown = f.debug_struct("OrderExecutor");
        shown
            .field("machine", &self.machine)
            .finish_non_exhaustive()
    }
}

/// Why an order did not reach its end.
#[derive(Debug)]
pub(super) enum Ended {
    /// Nothing was changed.
    Refused(Error),
    Failed(Error),
}

/// `?` in the checks before a change.
impl From<Error> for Ended {
    fn from(error: Error) -> Self {
        Self::Refused(error)
    }
}

fn reply(done: std::result::Result<String, Ended>) -> OrderReply {
    match done {
        Ok(text) => OrderReply::new(Status::Done, text),
        Err(Ended::Refused(error)) => OrderReply::new(Status::Refused, error.to_string()),
        Err(Ended::Failed(error)) => OrderReply::new(Status::Failed, error.to_string()),
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the seconds since 1970.
#[must_use]
pub fn unix_time() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.map_or(0, |now| now.as_secs())
}

impl OrderExecutor {
    /// Opens the folder of the orders. Paths are relative to the agent's file.
    ///
    /// # Errors
    /// Fails if a key is wrong, or the folder cannot be used.
    pub fn open(
        file: &Path,
        machine: MachineId,
        socket: PathBuf,
        table: &OrdersTable,
        keys: &[KeyTable],
        source: Arc<dyn FileSource>,
    ) -> Result<Arc<Self>> {
        let mut table = table.clone();
        table.folder = config::resolve(file, &table.folder);
        table.machine_file = config::resolve(file, &table.machine_file);
        let slots = Slots::open(&table.folder)?;
        Ok(Arc::new(Self {
            machine,
            socket,
            keys: Keyring::new(keys)?,
            store: FileStore::open(&table.folder.join("files"), Duration::from_secs(1))?,
            journal: Mutex::new(OrderJournal::open(&table.folder.join("orders.jsonl"))?),
            slots,
            table,
            source,
            running: Mutex::new(None),
        }))
    }

    /// Continues a switch during which the agent ended.
    ///
    /// # Errors
    /// Fails if the file of the switch is damaged.
    pub fn resume(self: &Arc<Self>) -> Result<()> {
        let interrupted = lock(&self.journal).take_interrupted();
        let pending = self.slots.pending()?;
        let switch = pending.as_ref().and_then(|switch| switch.nonce.clone());
        let executor = Arc::clone(self);
        // The log of the machine is that of its server, which may not answer.
        thread::spawn(move || {
            for order in interrupted {
                // The outcome of a switch follows.
                if Some(&order.nonce) != switch.as_ref() {
                    let text = format!("order `{}`: failed: {INTERRUPTED}", order.summary);
                    executor.note(&order.sender, &text);
                }
            }
        });
        let Some(switch) = pending else {
            return Ok(());
        };
        let nonce = switch.nonce.clone().unwrap_or_default();
        *lock(&self.running) = Some(Running {
            summary: format!("the switch by `{}`", switch.sender),
            nonce: nonce.clone(),
            stop: Arc::default(),
        });
        let executor = Arc::clone(self);
        let enter = move |executor: &Self, reply: OrderReply| {
            let kept = reply.status != Status::Running;
            let entered = lock(&executor.journal).update(&nonce, unix_time(), reply, kept);
            if let Err(error) = entered {
                tracing::error!("the log of orders: {error}");
            }
        };
        // The log has no end of this order: its sender still waits.
        let text = "the switch continues after a restart of the agent";
        enter(self, OrderReply::new(Status::Running, text));
        thread::spawn(move || {
            let reply = reply(executor.finish(&switch, &mut |_| ()));
            executor.discard([]);
            tracing::warn!(
                sender = switch.sender,
                "switch after a restart: {}",
                reply.text
            );
            let text = format!("switch after a restart of the agent: {}", reply.text);
            server::note(&executor.socket, &switch.sender, &text);
            enter(&executor, reply);
            *lock(&executor.running) = None;
        });
        Ok(())
    }

    /// Returns the answer to a message. A new order begins; a known one is not executed again.
    pub fn receive(self: &Arc<Self>, bytes: &[u8]) -> OrderReply {
        let refused = |error: Error| OrderReply::new(Status::Refused, error.to_string());
        let verified = SignedOrder::parse(bytes).and_then(|signed| {
            let text = signed.order.as_bytes();
            let key = self.keys.verify("the order", text, &signed.signature)?;
            let order = Order::parse(&signed.order)?;
            Ok((order, key, FileDigest::of(text)))
        });
        let (order, key, sha256) = match verified {
            Ok(verified) => verified,
            Err(error) => {
                tracing::debug!("order refused: {error}");
                return refused(error);
            }
        };
        let now = unix_time();
        let mut journal = lock(&self.journal);
        match journal.reply(&order, sha256) {
            Ok(None) => {}
            Ok(Some(reply)) => return reply,
            Err(error) => return refused(error),
        }
        let permitted = order.check(&self.machine, now);
        let permitted = permitted.and_then(|()| key.require(order.action.right()));
        let permitted = permitted.and_then(|()| match order.action {
            Action::Start { .. } if journal.stops_after(&order) => {
                let what = "an order `stop` was sent after this start";
                Err(Error::new(what).help("send the start again"))
            }
            _ => Ok(()),
        });
        if let Err(error) = permitted {
            // Without an entry: the sender decides how many of them come, and how long they count.
            let summary = order.action.summary();
            tracing::info!(sender = key.name, "order `{summary}`: refused: {error}");
            return refused(error);
        }
        let mut running = lock(&self.running);
        let stops = matches!(order.action, Action::Stop { .. });
        let reply = match &*running {
            Some(other) if !stops => {
                refused(Error::new(format!("{} is not done yet", other.summary)))
            }
            _ => OrderReply::new(Status::Running, "accepted"),
        };
        let begins = reply.status == Status::Running;
        if let Err(error) = journal.begin(&order, sha256, &key.name, now, reply.clone()) {
            // A stop may be executed twice. It needs no log.
            if !stops {
                return refused(error);
            }
            tracing::error!("the log of orders: {error}");
        }
        drop(journal);
        if !begins {
            drop(running);
            self.log(&order, &key.name, &reply);
            return reply;
        }
        if stops {
            drop(running);
            return self.execute(&order, &key.name, &AtomicBool::new(false));
        }
        let stop = Arc::default();
        *running = Some(Running {
            summary: format!("`{}` by `{}`", order.action.summary(), key.name),
            nonce: order.nonce.clone(),
            stop: Arc::clone(&stop),
        });
        let (executor, sender) = (Arc::clone(self), key.name.clone());
        let first = reply.clone();
        thread::spawn(move || {
            executor.log(&order, &sender, &first);
            executor.execute(&order, &sender, &stop);
            *lock(&executor.running) = None;
        });
        reply
    }

    /// Stops all axes and the start under way; with the nonce of a start, this start alone.
    fn stop(
        &self,
        order: &Order,
        start: Option<&str>,
        sender: &str,
    ) -> std::result::Result<String, Ended> {
        let Some(start) = start else {
            if let Some(running) = &*lock(&self.running) {
                running.stop.store(true, Ordering::SeqCst);
            }
            let machine = server::connect(&self.socket, sender).map_err(server::text)?;
            machine
                .stop()
                .map_err(server::text)
                .map_err(Ended::Failed)?;
            return Ok("all axes decelerate and hold; the program has ended".to_owned());
        };
        // It may come later than this order.
        let revoked = lock(&self.journal).revoke(start, order.not_after, sender, unix_time());
        let runs = || {
            let running = lock(&self.running);
            let running = running.as_ref().filter(|running| running.nonce == start);
            running.map(|running| Arc::clone(&running.stop))
        };
        if let Some(stop) = runs() {
            stop.store(true, Ordering::SeqCst);
        }
        let begin = Instant::now();
        while runs().is_some() {
            if begin.elapsed() > STOPPED {
                let what = "the start has not ended yet: its axes may still decelerate";
                return Err(Ended::Failed(
                    Error::new(what).help("see the server's state"),
                ));
            }
            thread::sleep(Duration::from_millis(20));
        }
        revoked?;
        Ok("the start is cancelled".to_owned())
    }

    /// Enters an order with its state in the change log of the machine.
    fn log(&self, order: &Order, sender: &str, reply: &OrderReply) {
        let (summary, text) = (order.action.summary(), reply.text.replace('\n', " "));
        let status = match reply.status {
            Status::Running => "begins",
            Status::Started => "started",
            Status::Done => "done",
            Status::Refused => "refused",
            Status::Failed => "failed",
        };
        let text = format!("order `{summary}`: {status}: {text}");
        tracing::info!(sender, "{text}");
        self.note(sender, &text);
    }

    fn note(&self, sender: &str, text: &str) {
        if !server::note(&self.socket, sender, text) {
            tracing::warn!(sender, "no server answers: the change log has no entry");
        }
    }

    fn execute(self: &Arc<Self>, order: &Order, sender: &str, stop: &AtomicBool) -> OrderReply {
        let switch = |no_server| SwitchOrder {
            sender,
            nonce: &order.nonce,
            no_server,
        };
        let mut progress = |status: Status, text: String| {
            let reply = OrderReply::new(status, text);
            let kept = status == Status::Started;
            if kept {
                self.log(order, sender, &reply);
            }
            let updated = lock(&self.journal).update(&order.nonce, unix_time(), reply, kept);
            if let Err(error) = updated {
                tracing::error!("the log of orders: {error}");
            }
        };
        let done = match &order.action {
            Action::Push {
                manifest,
                signature,
                no_server,
            } => self.push(*manifest, signature, &switch(*no_server), &mut |text| {
                progress(Status::Running, text);
            }),
            Action::Back { no_server } => self.back(&switch(*no_server), &mut |text| {
                progress(Status::Running, text);
            }),
            Action::Start { at_unix_ns } => self.start(*at_unix_ns, sender, stop, &mut progress),
            Action::Stop { start } => self.stop(order, start.as_deref(), sender),
            Action::Firmware {
                device,
                name,
                file,
                signature,
            } => {
                let signature = signature.as_deref();
                self.update_firmware(device, name, *file, signature, sender, &mut |text| {
                    progress(Status::Running, text);
                })
            }
            Action::Parameters { device, name, file } => {
                self.update_parameters(device, name, *file, sender, &mut |text| {
                    progress(Status::Running, text);
                })
            }
        };
        let reply = reply(done);
        self.log(order, sender, &reply);
        let updated = lock(&self.journal).update(&order.nonce, unix_time(), reply.clone(), true);
        if let Err(error) = updated {
            tracing::error!("the log of orders: {error}");
        }
        reply
    }

    /// Removes received files and unpacked bundles of neither a slot nor the order under way.
    pub(super) fn discard(&self, needed: impl IntoIterator<Item = FileDigest>) {
        let discarded = self.slots.clean().and_then(|used| match used {
            Some(mut used) => {
                used.extend(needed);
                self.store.keep(&used)
            }
            None => Ok(()),
        });
        if let Err(error) = discarded {
            tracing::warn!("removing old files: {error}");
        }
    }

    /// Fetches a file of the order.
    pub(super) fn fetch(
        &self,
        file: super::manifest::FileRef,
        progress: &mut dyn FnMut(String),
    ) -> Result<Vec<u8>> {
        if file.size > super::manifest::MAX_FILE {
            let most = super::manifest::MAX_FILE;
            return Err(Error::new(format!("the file is longer than {most} bytes")));
        }
        let size = file.size;
        self.store.get(file, &*self.source, &mut |have| {
            progress(format!("file {}: {have} of {size} bytes", file.sha256));
        })
    }

    pub(super) fn health_timeout(&self) -> Duration {
        Duration::from_secs(self.table.health_timeout_s)
    }
}
