//! Mailbox access from any thread and any executor during operation.
//!
//! - here: [`Mailboxes`] and [`DeviceMailbox`], the users' end; [`open`].
//! - `session`: [`MailboxSession`], a device for several messages of another program.
//! - `task`: [`MailboxWorker`], which owns the mailbox of one device.
//!
//! Each device has its own worker, so transfers to several devices run in parallel. A device that
//! hangs does not delay the others. A worker processes requests one at a time, in order of arrival.
//! Its queue is bounded; further callers wait for a free place. Dropping a request's future cancels
//! the request, even during the transfer.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use ecaxis_ecat::index::{DeviceIndex, IndexVec};
use ecaxis_ecat::mailbox::soe::Idn;
use tokio::sync::{mpsc, oneshot};

use super::{CoeClient, Emergencies, IdnElement, MailboxLayout, SdoError};

mod session;
mod task;

pub use session::MailboxSession;
pub use task::{MailboxWorker, run_with_workers};

/// The capacity of a device's queue; further requests wait in their futures.
const QUEUE: usize = 8;

/// One transfer.
#[derive(Debug)]
enum Request {
    Sdo {
        index: u16,
        sub: u8,
        complete: bool,
        /// The data to write; `None` reads.
        data: Option<Vec<u8>>,
    },
    Idn {
        at: IdnElement,
        /// The data to write; `None` reads.
        data: Option<Vec<u8>>,
    },
    /// Executes a procedure command.
    Command {
        drive: u8,
        idn: Idn,
        timeout: Duration,
    },
}

#[derive(Debug)]
enum Job {
    Transfer {
        request: Request,
        reply: oneshot::Sender<Result<Vec<u8>, SdoError>>,
    },
    /// Serves the messages of one user until the user leaves.
    Session(mpsc::Receiver<session::SessionJob>),
    /// Lends the mailbox until it comes back or the other end is dropped.
    Loan {
        to: oneshot::Sender<CoeClient>,
        back: oneshot::Receiver<CoeClient>,
    },
}

/// Why a request failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MailboxError {
    #[error("no device is called `{name}`")]
    Unknown { name: String },
    #[error("`{name}` has no CoE mailbox")]
    None { name: String },
    /// The run has ended.
    #[error("`{name}`: the run has ended; mailbox access is closed")]
    Closed { name: String },
    #[error("`{name}`: {source}")]
    Sdo { name: String, source: SdoError },
}

/// The mailboxes of all devices of a machine, by name. Cheap to clone.
#[derive(Clone, Default)]
pub struct Mailboxes {
    devices: Arc<IndexVec<DeviceIndex, WorkerHandle>>,
}

/// Shows only the names: the rest differs from run to run.
impl fmt::Debug for Mailboxes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.names()).finish()
    }
}

/// The users' end of a worker.
#[derive(Debug)]
struct WorkerHandle {
    name: Arc<str>,
    /// `None` if the device has no mailbox.
    queues: Option<RequestQueues>,
}

#[derive(Debug, Clone)]
struct RequestQueues {
    jobs: mpsc::Sender<Job>,
    /// Requests that explain a stop; they take precedence.
    urgent: mpsc::Sender<Job>,
    layout: MailboxLayout,
}

/// The mailbox of one device. Cheap to clone.
#[derive(Debug, Clone)]
pub struct DeviceMailbox {
    name: Arc<str>,
    lane: mpsc::Sender<Job>,
}

impl Mailboxes {
    /// Returns the names of the devices with a mailbox.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let with = self.devices.iter().filter(|device| device.queues.is_some());
        with.map(|device| &*device.name)
    }

    /// Returns the mailbox of a device.
    ///
    /// # Errors
    /// [`MailboxError::Unknown`], [`MailboxError::None`].
    pub fn device(&self, name: &str) -> Result<DeviceMailbox, MailboxError> {
        let mut all = self.devices.iter();
        let device = all.find(|device| &*device.name == name);
        let device = device.ok_or_else(|| MailboxError::Unknown { name: name.into() })?;
        let queues = device.queues.as_ref();
        let queues = queues.ok_or_else(|| MailboxError::None { name: name.into() })?;
        Ok(DeviceMailbox {
            name: Arc::clone(&device.name),
            lane: queues.jobs.clone(),
        })
    }

    /// Returns the device with this station address, its mailbox and its mailbox sizes.
    #[must_use]
    pub fn at_station(&self, station: u16) -> Option<(DeviceIndex, DeviceMailbox, MailboxLayout)> {
        self.devices.enumerate().find_map(|(index, device)| {
            let queues = device.queues.as_ref()?;
            let mailbox = DeviceMailbox {
                name: Arc::clone(&device.name),
                lane: queues.jobs.clone(),
            };
            (queues.layout.station == station).then_some((index, mailbox, queues.layout))
        })
    }

    /// Returns the urgent mailbox of a device: its requests precede all others.
    pub(crate) fn urgent(&self, device: DeviceIndex) -> Option<DeviceMailbox> {
        let device = self.devices.get(device)?;
        Some(DeviceMailbox {
            name: Arc::clone(&device.name),
            lane: device.queues.as_ref()?.urgent.clone(),
        })
    }

    /// Borrows the mailbox of a device that has restarted, after the transfers in progress; further
    /// ones wait for its return. `None` if the device has no mailbox.
    pub(crate) async fn borrow(
        &self,
        device: DeviceIndex,
    ) -> Option<(CoeClient, oneshot::Sender<CoeClient>)> {
        let queues = self.devices.get(device)?.queues.as_ref()?;
        let ((to, lent), (give_back, back)) = (oneshot::channel(), oneshot::channel());
        queues.jobs.send(Job::Loan { to, back }).await.ok()?;
        Some((lent.await.ok()?, give_back))
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

    /// Reads an object from `sub` (0 or 1) on by complete access.
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

    /// Reserves the device for several messages, after the requests of others. Urgent requests end
    /// the session.
    ///
    /// # Errors
    /// [`MailboxError::Closed`].
    pub async fn session(&self) -> Result<MailboxSession, MailboxError> {
        let (session, requests) = MailboxSession::new(&self.name);
        let sent = self.lane.send(Job::Session(requests)).await;
        sent.map_err(|_| self.closed())?;
        Ok(session)
    }

    fn closed(&self) -> MailboxError {
        MailboxError::Closed {
            name: self.name.to_string(),
        }
    }

    /// Reads an element of an IDN (SoE).
    ///
    /// # Errors
    /// [`MailboxError`].
    pub async fn read_idn(&self, at: IdnElement) -> Result<Vec<u8>, MailboxError> {
        self.transfer(Request::Idn { at, data: None }).await
    }

    /// Writes an element of an IDN (SoE).
    ///
    /// # Errors
    /// [`MailboxError`].
    pub async fn write_idn(&self, at: IdnElement, data: &[u8]) -> Result<(), MailboxError> {
        let data = Some(data.to_vec());
        self.transfer(Request::Idn { at, data }).await.map(drop)
    }

    /// Executes a procedure command of a drive (SoE).
    ///
    /// # Errors
    /// [`MailboxError`].
    pub async fn execute_command(
        &self,
        (drive, idn): (u8, Idn),
        timeout: Duration,
    ) -> Result<(), MailboxError> {
        let command = Request::Command {
            drive,
            idn,
            timeout,
        };
        self.transfer(command).await.map(drop)
    }

    async fn ask(
        &self,
        index: u16,
        sub: u8,
        complete: bool,
        data: Option<&[u8]>,
    ) -> Result<Vec<u8>, MailboxError> {
        let data = data.map(<[u8]>::to_vec);
        self.transfer(Request::Sdo {
            index,
            sub,
            complete,
            data,
        })
        .await
    }

    async fn transfer(&self, request: Request) -> Result<Vec<u8>, MailboxError> {
        let (reply, answer) = oneshot::channel();
        let job = Job::Transfer { request, reply };
        self.lane.send(job).await.map_err(|_| self.closed())?;
        let answer = answer.await.map_err(|_| self.closed())?;
        answer.map_err(|source| MailboxError::Sdo {
            name: self.name.to_string(),
            source,
        })
    }
}

/// The configuration of a worker.
#[derive(Debug)]
pub struct WorkerConfig<W> {
    pub name: String,
    /// `None` if the device has no mailbox.
    pub mailbox: Option<(W, CoeClient)>,
}

/// Receives the emergencies of devices.
pub trait EmergencySink: fmt::Debug + Send + Sync {
    /// Called often; takes all emergencies from the queue.
    fn listen(&self, device: &str, emergencies: &Emergencies);
}

/// Creates the workers of the devices, and the handle to them.
pub fn open<W>(
    devices: impl IntoIterator<Item = WorkerConfig<W>>,
    listener: &Arc<dyn EmergencySink>,
) -> (Mailboxes, Vec<MailboxWorker<W>>) {
    let mut counters = Vec::new();
    let mut workers = Vec::new();
    for WorkerConfig { name, mailbox } in devices {
        let name: Arc<str> = name.into();
        let queues = mailbox.map(|(wire, coe)| {
            let (jobs, asked) = mpsc::channel(QUEUE);
            let (urgent, first) = mpsc::channel(1);
            let name = Arc::clone(&name);
            let layout = *coe.layout();
            workers.push(MailboxWorker::new(
                name,
                wire,
                coe,
                first,
                asked,
                Arc::clone(listener),
            ));
            RequestQueues {
                jobs,
                urgent,
                layout,
            }
        });
        counters.push(WorkerHandle { name, queues });
    }
    let devices = Arc::new(counters.into());
    (Mailboxes { devices }, workers)
}
