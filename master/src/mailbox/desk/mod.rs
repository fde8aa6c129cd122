//! Mailboxes while a bus is looked after: transfers for whoever asks, from any thread and any executor, and what devices say unasked.
//!
//! - here: [`Mailboxes`] and [`DeviceMailbox`], the users' end; [`open`].
//! - `serve`: [`Desk`], which owns the mailbox of one device.
//!
//! Each device has a desk of its own, so that several make transfers at once and one that hangs holds up nobody else. A desk takes one
//! request at a time, in the order in which they came. The queue is bounded: who asks more waits. A future that is dropped takes its
//! request back, in the middle of a transfer too.

use std::fmt;
use std::sync::Arc;

use tokio::sync::{mpsc, oneshot};

use super::{Emergencies, SdoError};

mod serve;

pub use serve::{Desk, beside};

/// Requests that wait for one device; more wait in their futures.
const QUEUE: usize = 8;

/// What a transfer is about.
#[derive(Debug)]
struct Request {
    index: u16,
    sub: u8,
    complete: bool,
    /// To be written; `None`: it is read.
    data: Option<Vec<u8>>,
}

#[derive(Debug)]
struct Job {
    request: Request,
    reply: oneshot::Sender<Result<Vec<u8>, SdoError>>,
}

/// Why a request was not fulfilled.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MailboxError {
    #[error("no device is called `{name}`")]
    Unknown { name: String },
    #[error("`{name}` has no CoE mailbox")]
    None { name: String },
    /// The run is over.
    #[error("`{name}`: nobody looks after its mailbox any more")]
    Closed { name: String },
    #[error("`{name}`: {source}")]
    Sdo { name: String, source: SdoError },
}

/// The mailboxes of all devices of a machine, by name. Cheap to clone.
#[derive(Clone, Default)]
pub struct Mailboxes {
    devices: Arc<[Counter]>,
}

/// The names alone: the rest differs from run to run.
impl fmt::Debug for Mailboxes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.names()).finish()
    }
}

/// The users' side of a desk.
#[derive(Debug)]
struct Counter {
    name: Arc<str>,
    /// `None` where the device has no mailbox.
    lanes: Option<Lanes>,
}

#[derive(Debug, Clone)]
struct Lanes {
    jobs: mpsc::Sender<Job>,
    /// What is asked in order to explain a stop; it comes first.
    urgent: mpsc::Sender<Job>,
}

/// The mailbox of one device. Cheap to clone.
#[derive(Debug, Clone)]
pub struct DeviceMailbox {
    name: Arc<str>,
    lane: mpsc::Sender<Job>,
}

impl Mailboxes {
    /// Names of the devices that have one.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let with = self.devices.iter().filter(|device| device.lanes.is_some());
        with.map(|device| &*device.name)
    }

    /// # Errors
    /// [`MailboxError::Unknown`], [`MailboxError::None`].
    pub fn device(&self, name: &str) -> Result<DeviceMailbox, MailboxError> {
        let mut all = self.devices.iter();
        let device = all.find(|device| &*device.name == name);
        let device = device.ok_or_else(|| MailboxError::Unknown { name: name.into() })?;
        let lanes = device.lanes.as_ref();
        let lanes = lanes.ok_or_else(|| MailboxError::None { name: name.into() })?;
        Ok(DeviceMailbox {
            name: Arc::clone(&device.name),
            lane: lanes.jobs.clone(),
        })
    }

    /// That of the n-th device of the machine, before all others' requests.
    pub(crate) fn urgent(&self, device: usize) -> Option<DeviceMailbox> {
        let device = self.devices.get(device)?;
        Some(DeviceMailbox {
            name: Arc::clone(&device.name),
            lane: device.lanes.as_ref()?.urgent.clone(),
        })
    }

    /// Reads an object.
    ///
    /// # Errors
    /// [`MailboxError`].
    pub async fn upload(&self, device: &str, index: u16, sub: u8) -> Result<Vec<u8>, MailboxError> {
        self.device(device)?.upload(index, sub).await
    }

    /// Writes an object.
    ///
    /// # Errors
    /// [`MailboxError`].
    pub async fn download(
        &self,
        device: &str,
        index: u16,
        sub: u8,
        data: &[u8],
    ) -> Result<(), MailboxError> {
        self.device(device)?.download(index, sub, data).await
    }
}

impl DeviceMailbox {
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Reads an object.
    ///
    /// # Errors
    /// [`MailboxError::Sdo`], [`MailboxError::Closed`].
    pub async fn upload(&self, index: u16, sub: u8) -> Result<Vec<u8>, MailboxError> {
        self.ask(index, sub, false, None).await
    }

    /// Reads all of an object from `sub` (0 or 1) on, by complete access.
    ///
    /// # Errors
    /// As [`DeviceMailbox::upload`].
    pub async fn upload_complete(&self, index: u16, sub: u8) -> Result<Vec<u8>, MailboxError> {
        self.ask(index, sub, true, None).await
    }

    /// Writes an object.
    ///
    /// # Errors
    /// As [`DeviceMailbox::upload`].
    pub async fn download(&self, index: u16, sub: u8, data: &[u8]) -> Result<(), MailboxError> {
        self.ask(index, sub, false, Some(data)).await.map(drop)
    }

    /// Writes all of an object from `sub` (0 or 1) on, by complete access.
    ///
    /// # Errors
    /// As [`DeviceMailbox::upload`].
    pub async fn download_complete(
        &self,
        index: u16,
        sub: u8,
        data: &[u8],
    ) -> Result<(), MailboxError> {
        self.ask(index, sub, true, Some(data)).await.map(drop)
    }

    async fn ask(
        &self,
        index: u16,
        sub: u8,
        complete: bool,
        data: Option<&[u8]>,
    ) -> Result<Vec<u8>, MailboxError> {
        let (reply, answer) = oneshot::channel();
        let data = data.map(<[u8]>::to_vec);
        let request = Request {
            index,
            sub,
            complete,
            data,
        };
        let closed = || MailboxError::Closed {
            name: self.name.to_string(),
        };
        let job = Job { request, reply };
        self.lane.send(job).await.map_err(|_| closed())?;
        let answer = answer.await.map_err(|_| closed())?;
        answer.map_err(|source| MailboxError::Sdo {
            name: self.name.to_string(),
            source,
        })
    }
}

/// What a desk is opened for.
#[derive(Debug)]
pub struct Opening<W> {
    pub name: String,
    /// `None` where the device has no mailbox.
    pub mailbox: Option<(W, super::CoeClient)>,
}

/// Takes what devices say unasked.
pub trait Listen: fmt::Debug + Send + Sync {
    /// Called often; empties the queue.
    fn listen(&self, device: &str, emergencies: &Emergencies);
}

/// The desks of devices, and the handle to them.
pub fn open<W>(
    devices: impl IntoIterator<Item = Opening<W>>,
    listener: &Arc<dyn Listen>,
) -> (Mailboxes, Vec<Desk<W>>) {
    let mut counters = Vec::new();
    let mut desks = Vec::new();
    for Opening { name, mailbox } in devices {
        let name: Arc<str> = name.into();
        let lanes = mailbox.map(|(wire, coe)| {
            let (jobs, asked) = mpsc::channel(QUEUE);
            let (urgent, first) = mpsc::channel(1);
            let name = Arc::clone(&name);
            desks.push(Desk::new(
                name,
                wire,
                coe,
                first,
                asked,
                Arc::clone(listener),
            ));
            Lanes { jobs, urgent }
        });
        counters.push(Counter { name, lanes });
    }
    let devices = counters.into();
    (Mailboxes { devices }, desks)
}
