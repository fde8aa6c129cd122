//! The sender of orders: signs them, serves their files, and follows them to their end.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use zenoh::query::QueryTarget;
use zenoh::{Session, Wait};

use super::digest::FileDigest;
use super::executor::unix_time;
use super::order::{Action, Order, OrderReply, SignedOrder, Status};
use super::signing::Signer;
use super::store::{CHUNK, FileSource};
use crate::error::{Error, Result};
use crate::keys::MachineId;

/// The time window of an order around the clock of the sender, in s.
pub(super) const EARLY: u64 = 30;
const LATE: u64 = 60;
/// The silence after which a machine is given up.
const SILENCE: Duration = Duration::from_secs(30);
const QUERY: Duration = Duration::from_secs(3);
const POLL: Duration = Duration::from_millis(300);

/// Sends orders with one key.
#[derive(Debug)]
pub struct OrderSender {
    session: Session,
    signer: Signer,
}

impl OrderSender {
    #[must_use]
    pub fn new(session: Session, signer: Signer) -> Self {
        Self { session, signer }
    }

    /// Serves files of orders to one machine until the returned value is dropped.
    ///
    /// # Errors
    /// Fails if the session is closed.
    pub async fn serve(&self, machine: &MachineId, files: Vec<Vec<u8>>) -> Result<FileServer> {
        let files: Arc<BTreeMap<FileDigest, Vec<u8>>> = Arc::new(
            files
                .into_iter()
                .map(|bytes| (FileDigest::of(&bytes), bytes))
                .collect(),
        );
        let queries = self.session.declare_queryable(machine.key("file/*"));
        let queries = queries
            .await
            .map_err(|e| Error::new(format!("Zenoh: {e}")))?;
        let task = tokio::spawn(async move {
            while let Ok(query) = queries.recv_async().await {
                let key = query.key_expr().as_str().to_owned();
                let digest = key.rsplit('/').next().and_then(|text| text.parse().ok());
                let file = digest.and_then(|digest: FileDigest| files.get(&digest));
                let offset = query.parameters().get("offset");
                let offset = offset.and_then(|text| text.parse::<usize>().ok());
                if let (Some(file), Some(offset)) = (file, offset)
                    && offset < file.len()
                {
                    let end = file.len().min(offset.saturating_add(CHUNK));
                    let _ = query.reply(key, &file[offset..end]).await;
                }
            }
        });
        Ok(FileServer(task))
    }

    /// Signs an order to a machine, which is valid from now on.
    ///
    /// # Errors
    /// Fails if the system has no random numbers.
    pub fn sign(&self, machine: &MachineId, action: Action) -> Result<SentOrder> {
        let (now, nonce) = (unix_time(), nonce()?);
        let (from, until) = (now.saturating_sub(EARLY), now + LATE);
        let order = Order::new(machine.clone(), action, from, until, nonce.clone());
        let order = serde_json::to_string(&order).map_err(|e| Error::new(e.to_string()))?;
        let signature = self.signer.sign(order.as_bytes(), "order.json", now)?;
        Ok(SentOrder {
            machine: machine.clone(),
            nonce,
            message: SignedOrder { order, signature }.emit(),
        })
    }

    /// Sends an order and follows it until it is started, done, refused or failed.
    ///
    /// # Errors
    /// Fails if the machine does not answer. The order may have been executed.
    pub async fn send(
        &self,
        machine: &MachineId,
        action: Action,
        progress: &mut (dyn FnMut(&str) + Send),
    ) -> Result<OrderReply> {
        self.follow(&self.sign(machine, action)?, progress).await
    }

    /// As [`Self::send`], with a signed order.
    ///
    /// # Errors
    /// Fails if the machine does not answer. The order may have been executed.
    pub async fn follow(
        &self,
        order: &SentOrder,
        progress: &mut (dyn FnMut(&str) + Send),
    ) -> Result<OrderReply> {
        let machine = &order.machine;
        let mut heard = Instant::now();
        loop {
            match self.query(machine, &order.message).await? {
                Some(reply) if reply.status == Status::Running => {
                    heard = Instant::now();
                    progress(&reply.text);
                }
                Some(reply) => return Ok(reply),
                None if heard.elapsed() > SILENCE => {
                    return Err(Error::new(format!(
                        "{machine} does not answer for {} s; the order may have been executed",
                        SILENCE.as_secs()
                    ))
                    .help("see `ecaxis-fleet status`; then send the same command again"));
                }
                None => {}
            }
            // The same order again: the agent executes it once and returns its state.
            tokio::time::sleep(POLL).await;
        }
    }

    async fn query(&self, machine: &MachineId, message: &[u8]) -> Result<Option<OrderReply>> {
        let failed = |e: zenoh::Error| Error::new(format!("Zenoh: {e}"));
        let replies = self
            .session
            .get(machine.key("order"))
            .payload(message)
            .target(QueryTarget::All)
            .timeout(QUERY)
            .await
            .map_err(failed)?;
        while let Ok(reply) = replies.recv_async().await {
            if let Ok(sample) = reply.into_result()
                && let Ok(reply) = serde_json::from_slice(&sample.payload().to_bytes())
            {
                return Ok(Some(reply));
            }
        }
        Ok(None)
    }
}

/// A signed order.
#[derive(Debug, Clone)]
pub struct SentOrder {
    pub machine: MachineId,
    pub nonce: String,
    message: Vec<u8>,
}

/// Serves files until it is dropped.
#[derive(Debug)]
pub struct FileServer(tokio::task::JoinHandle<()>);

impl Drop for FileServer {
    fn drop(&mut self) {
        self.0.abort();
    }
}

fn nonce() -> Result<String> {
    let mut bytes = [0; 16];
    let read = File::open("/dev/urandom").and_then(|mut file| file.read_exact(&mut bytes));
    read.map_err(|e| Error::new(format!("/dev/urandom: {e}")))?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Fetches the files of orders over Zenoh.
#[derive(Debug)]
pub struct ZenohSource {
    session: OnceLock<Session>,
    machine: MachineId,
}

impl ZenohSource {
    /// Returns a source that waits for its session.
    #[must_use]
    pub fn new(machine: MachineId) -> Self {
        let session = OnceLock::new();
        Self { session, machine }
    }

    /// Fetches by this session from now on.
    pub fn connect(&self, session: Session) {
        self.session.get_or_init(|| session);
    }
}

impl FileSource for ZenohSource {
    fn chunk(&self, digest: FileDigest, offset: u64) -> Result<Vec<u8>> {
        let key = self.machine.key(&format!("file/{digest}"));
        let failed = |e: zenoh::Error| Error::new(format!("Zenoh: {e}"));
        let session = self.session.get();
        let session = session.ok_or_else(|| Error::new("Zenoh is not connected"))?;
        let replies = session
            .get(format!("{key}?offset={offset}"))
            .target(QueryTarget::All)
            .timeout(QUERY)
            .wait()
            .map_err(failed)?;
        while let Ok(reply) = replies.recv() {
            if let Ok(sample) = reply.into_result()
                && sample.payload().len() <= CHUNK
            {
                return Ok(sample.payload().to_bytes().into_owned());
            }
        }
        Err(
            Error::new(format!("the sender of the file {digest} does not answer"))
                .help("send the order again; the transfer continues"),
        )
    }
}
