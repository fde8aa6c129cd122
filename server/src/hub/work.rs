//! Commands on their way to the machine, and their outcomes.

use super::*;

/// A transfer that the operator polls until it ends. In virtual time, it ends at the same moment
/// every time.
pub struct Transfer(pub Pin<Box<dyn Future<Output = Outcome> + Send>>);

impl std::fmt::Debug for Transfer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Transfer")
    }
}

/// What the machine must do for a client.
#[derive(Debug)]
pub enum Work {
    Request(Request),
    Open {
        axis: usize,
        config: StreamConfig,
    },
    Push {
        axis: usize,
        points: Box<[StreamPoint]>,
    },
    Close {
        axis: usize,
    },
    Attach(Arc<SharedMemory>),
    Detach,
    /// A transfer with a mailbox.
    Transfer(Transfer),
}

impl Work {
    /// Returns true if nothing may drop it.
    pub(super) fn stops(&self) -> bool {
        matches!(self, Self::Detach) || matches!(self, Self::Request(request) if request.stops())
    }

    pub(super) fn is_emergency(&self) -> bool {
        matches!(self, Self::Request(Request::EmergencyStop))
    }
}

#[derive(Debug)]
pub struct QueuedWork {
    /// The number of the command; 0: no client waits for an outcome.
    pub ticket: u64,
    pub work: Work,
}

/// The end of a command: more keys of the answer, or the error.
pub type Outcome = Result<Map<String, Value>, OpError>;

/// A command whose outcome is not known yet.
#[derive(Debug)]
pub(super) struct PendingCommand {
    /// The number of parts, such as axes, without an outcome.
    pub(super) left: usize,
    pub(super) failure: Option<OpError>,
    pub(super) reply: Option<oneshot::Sender<Outcome>>,
    /// The client waits for the outcome.
    pub(super) waits: bool,
    /// The command needs the lease, and ends with it.
    pub(super) owned: bool,
}

impl PendingCommand {
    /// Returns true while a client that still exists waits.
    pub(super) fn is_awaited(&self) -> bool {
        self.waits && self.reply.as_ref().is_some_and(|reply| !reply.is_closed())
    }
}

/// Ends one part of a command. The last part gives the answer.
pub(super) fn finish(inner: &mut Inner, ticket: u64, outcome: Outcome) {
    let Some(pending) = inner.pending.get_mut(&ticket) else {
        return;
    };
    pending.left = pending.left.saturating_sub(1);
    let done = match outcome {
        Ok(keys) => keys,
        Err(error) => {
            pending.failure.get_or_insert(error);
            Map::new()
        }
    };
    if pending.left > 0 {
        return;
    }
    let Some(mut pending) = inner.pending.remove(&ticket) else {
        return;
    };
    let outcome = pending.failure.take().map_or(Ok(done), Err);
    if let Some(reply) = pending.reply.take() {
        // The client may have gone.
        let _ = reply.send(outcome);
    }
}

/// Ends all parts of a command.
pub(super) fn abandon(inner: &mut Inner, ticket: u64, error: &OpError) {
    if let Some(pending) = inner.pending.get_mut(&ticket) {
        pending.left = 1;
    }
    finish(inner, ticket, Err(error.clone()));
}

/// Queues the stop of everything that clients moved. Commands of the owner that wait end with the
/// error. Those that need no lease stay behind the stop: one of them may ask for more than a stop.
pub(super) fn stop_all(inner: &mut Inner, error: &OpError) {
    for queued in std::mem::take(&mut inner.queue) {
        let pending = inner.pending.get(&queued.ticket);
        let stays = match pending {
            Some(pending) => !pending.owned,
            None => queued.work.is_emergency(),
        };
        match stays {
            true => inner.queue.push_back(queued),
            false => abandon(inner, queued.ticket, error),
        }
    }
    let stops = [
        Work::Detach,
        Work::Request(Request::Program(ProgramRequest::Stop)),
        Work::Request(Request::StopAll),
    ];
    for work in stops.into_iter().rev() {
        inner.queue.push_front(QueuedWork { ticket: 0, work });
    }
}
