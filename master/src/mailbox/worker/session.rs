//! A device's mailbox for several messages of one user, with no message of others in between.

use std::future::poll_fn;
use std::sync::Arc;
use std::task::Poll;

use tokio::sync::{mpsc, oneshot};

use super::MailboxError;
use super::task::{MailboxWorker, forward_emergencies};
use crate::mailbox::raw::OpenTransfer;
use crate::mailbox::{MailboxTransport, RawAnswer, RawMessage, SdoError};

/// One message and where its answers go.
#[derive(Debug)]
pub(super) struct SessionJob {
    request: RawMessage,
    reply: oneshot::Sender<Result<RawAnswer, SdoError>>,
}

/// The mailbox of a device, reserved for one user until it is dropped or urgent requests take it.
/// A transfer in progress is then aborted.
#[derive(Debug)]
pub struct MailboxSession {
    name: Arc<str>,
    jobs: mpsc::Sender<SessionJob>,
}

impl MailboxSession {
    pub(super) fn new(name: &Arc<str>) -> (Self, mpsc::Receiver<SessionJob>) {
        let (jobs, requests) = mpsc::channel(1);
        let name = Arc::clone(name);
        (Self { name, jobs }, requests)
    }

    /// Sends a message with a counter of this side and returns its answers.
    ///
    /// # Errors
    /// [`MailboxError::Sdo`]; [`MailboxError::Closed`] if the session or the run has ended.
    pub async fn exchange(&self, request: RawMessage) -> Result<RawAnswer, MailboxError> {
        let closed = || MailboxError::Closed {
            name: self.name.to_string(),
        };
        let (reply, answer) = oneshot::channel();
        let job = SessionJob { request, reply };
        self.jobs.send(job).await.map_err(|_| closed())?;
        let answer = answer.await.map_err(|_| closed())?;
        answer.map_err(|source| MailboxError::Sdo {
            name: self.name.to_string(),
            source,
        })
    }
}

enum Next {
    Job(SessionJob),
    /// An emergency waits in the mailbox.
    Message,
    End,
}

impl<W: MailboxTransport> MailboxWorker<W> {
    /// Serves the messages of one user until the user leaves or an urgent request arrives.
    pub(super) async fn serve_session(&mut self, mut requests: mpsc::Receiver<SessionJob>) {
        let name = &Arc::clone(&self.name);
        let mut open = OpenTransfer::None;
        loop {
            let next = poll_fn(|context| {
                if !self.urgent.is_empty() {
                    return Poll::Ready(Next::End);
                }
                match requests.poll_recv(context) {
                    Poll::Ready(Some(job)) => Poll::Ready(Next::Job(job)),
                    Poll::Ready(None) => Poll::Ready(Next::End),
                    // No waker is registered for messages; every executor here polls again soon.
                    Poll::Pending if self.coe.has_message(&self.wire) => Poll::Ready(Next::Message),
                    Poll::Pending => Poll::Pending,
                }
            });
            match next.await {
                Next::Job(SessionJob { request, reply }) => {
                    let exchange = self.coe.exchange_raw(&self.wire, &request, &mut open);
                    let done =
                        forward_emergencies(name, &self.emergencies, &*self.listener, exchange);
                    // The user may have left meanwhile.
                    let _ = reply.send(done.await);
                }
                Next::Message => {
                    let drain = self.coe.drain(&self.wire);
                    // The cycle detects a device that is gone.
                    let _ =
                        forward_emergencies(name, &self.emergencies, &*self.listener, drain).await;
                }
                Next::End => break,
            }
        }
        drop(requests);
        let end = self.coe.end_raw(&self.wire, open);
        forward_emergencies(name, &self.emergencies, &*self.listener, end).await;
    }
}
