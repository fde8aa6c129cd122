//! The worker of one device's mailbox. It serves requests one by one and reads emergencies in
//! between.

use std::future::{Future, poll_fn};
use std::mem;
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Wake, Waker};

use tokio::sync::mpsc;

use super::{EmergencySink, Job, Request};
use crate::eoe::Turn;
use crate::mailbox::eoe::EoeSender;
use crate::mailbox::{CoeClient, Emergencies, MailboxTransport, SdoError};

/// Owns the mailbox of one device.
#[derive(Debug)]
pub struct MailboxWorker<W> {
    pub(super) name: Arc<str>,
    pub(super) wire: W,
    pub(super) coe: CoeClient,
    pub(super) emergencies: Emergencies,
    pub(super) urgent: mpsc::Receiver<Job>,
    jobs: mpsc::Receiver<Job>,
    arrivals: Arc<Arrivals>,
    /// Wakes `arrivals`, which in turn wakes `outer`.
    waker: Waker,
    outer: Option<Waker>,
    eoe: EoeSender,
    /// The last item was a message: a fragment in the other direction precedes the next one.
    fragment_is_next: bool,
    /// The last item had the turn: the next poll leaves it to others.
    had_turn: bool,
    pub(super) listener: Arc<dyn EmergencySink>,
}

/// A flag that a receiver may have a request. Checking the receivers costs more than all other work
/// of an idle worker, and every worker is polled in every cycle.
#[derive(Debug)]
struct Arrivals {
    new: AtomicBool,
    outer: Mutex<Waker>,
}

impl Wake for Arrivals {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.new.store(true, Ordering::Release);
        let outer = self.outer.lock().unwrap_or_else(PoisonError::into_inner);
        outer.wake_by_ref();
    }
}

enum WorkItem {
    Job(Job),
    /// A message waits that belongs to no request. With EoE, reading it needs the turn.
    Message(Option<Turn>),
    /// A fragment of an Ethernet frame is due.
    Fragment(Turn),
    /// All senders are dropped.
    End,
}

impl<W: MailboxTransport> MailboxWorker<W> {
    /// Serves requests until all senders are dropped.
    pub async fn serve(mut self) {
        loop {
            match self.next().await {
                WorkItem::Job(job) => self.do_job(job).await,
                WorkItem::Message(turn) => {
                    let listening = async {
                        match turn {
                            // One at a time: a device that sends frames without end must not keep
                            // requests waiting.
                            Some(turn) => self.coe.take_message(&self.wire, turn).await,
                            // The cycle detects a device that is gone.
                            None => drop(self.coe.drain(&self.wire).await),
                        }
                    };
                    forward_emergencies(&self.name, &self.emergencies, &*self.listener, listening)
                        .await;
                }
                WorkItem::Fragment(turn) => {
                    self.coe
                        .send_fragment(&self.wire, &mut self.eoe, turn)
                        .await;
                }
                WorkItem::End => return,
            }
        }
    }

    async fn next(&mut self) -> WorkItem {
        poll_fn(|context| {
            if let Some(next) = self.arrived(context) {
                return Poll::Ready(next);
            }
            // No waker is registered for messages, frames and turns; every executor here polls again
            // soon.
            let message = self.coe.has_message(&self.wire);
            // Without EoE, this costs nothing.
            let Some(port) = self.coe.eoe_port() else {
                return match message {
                    true => Poll::Ready(WorkItem::Message(None)),
                    false => Poll::Pending,
                };
            };
            if mem::take(&mut self.had_turn) {
                return Poll::Pending;
            }
            let now = self.wire.now();
            let message = message || port.is_assembling(now);
            let fragment = self.eoe.is_due(now, port);
            if !message && !fragment {
                return Poll::Pending;
            }
            let Some(turn) = port.try_turn() else {
                return Poll::Pending;
            };
            self.had_turn = true;
            self.fragment_is_next = message && !(fragment && self.fragment_is_next);
            Poll::Ready(match self.fragment_is_next {
                true => WorkItem::Message(Some(turn)),
                false => WorkItem::Fragment(turn),
            })
        })
        .await
    }

    /// Returns the next item of the receivers, if anything has arrived since they were empty.
    fn arrived(&mut self, context: &Context<'_>) -> Option<WorkItem> {
        let known = self.outer.as_ref().filter(|w| w.will_wake(context.waker()));
        if known.is_none() {
            self.outer = Some(context.waker().clone());
            let outer = self.arrivals.outer.lock();
            *outer.unwrap_or_else(PoisonError::into_inner) = context.waker().clone();
            self.arrivals.new.store(true, Ordering::Release);
        }
        if !self.arrivals.new.swap(false, Ordering::AcqRel) {
            return None;
        }
        let mut inner = Context::from_waker(&self.waker);
        let next = match self.urgent.poll_recv(&mut inner) {
            Poll::Ready(Some(job)) => WorkItem::Job(job),
            _ => match self.jobs.poll_recv(&mut inner) {
                Poll::Ready(Some(job)) => WorkItem::Job(job),
                Poll::Ready(None) => WorkItem::End,
                Poll::Pending => return None,
            },
        };
        // There may be more items.
        self.arrivals.new.store(true, Ordering::Release);
        Some(next)
    }

    async fn do_job(&mut self, job: Job) {
        let (request, mut reply) = match job {
            Job::Transfer { request, reply } => (request, reply),
            Job::Session(requests) => return self.serve_session(requests).await,
            Job::Loan { to, back } => {
                if to.send(self.coe.restarted()).is_ok() {
                    let restarted = self.coe.restarted();
                    self.coe = back.await.unwrap_or(restarted);
                    self.eoe.restart();
                }
                return;
            }
        };
        if reply.is_closed() {
            return;
        }
        let done = {
            let mut transfer = pin!(transfer(&mut self.coe, &self.wire, request));
            let unless_dropped = poll_fn(|context| {
                if reply.poll_closed(context).is_ready() {
                    return Poll::Ready(None);
                }
                transfer.as_mut().poll(context).map(Some)
            });
            forward_emergencies(
                &self.name,
                &self.emergencies,
                &*self.listener,
                unless_dropped,
            )
            .await
        };
        match done {
            Some(answer) => {
                // The caller may have dropped its future meanwhile.
                let _ = reply.send(answer);
            }
            None => {
                let settling = self.coe.abort_transfer(&self.wire);
                let _ =
                    forward_emergencies(&self.name, &self.emergencies, &*self.listener, settling)
                        .await;
            }
        }
    }
}

impl<W> MailboxWorker<W> {
    pub(super) fn new(
        name: Arc<str>,
        wire: W,
        coe: CoeClient,
        urgent: mpsc::Receiver<Job>,
        jobs: mpsc::Receiver<Job>,
        listener: Arc<dyn EmergencySink>,
    ) -> Self {
        let emergencies = coe.emergencies();
        let arrivals = Arc::new(Arrivals {
            new: AtomicBool::new(true),
            outer: Mutex::new(Waker::noop().clone()),
        });
        Self {
            name,
            wire,
            coe,
            emergencies,
            urgent,
            jobs,
            waker: Waker::from(Arc::clone(&arrivals)),
            arrivals,
            outer: None,
            eoe: EoeSender::default(),
            fragment_is_next: false,
            had_turn: false,
            listener,
        }
    }
}

async fn transfer<W: MailboxTransport>(
    coe: &mut CoeClient,
    wire: &W,
    request: Request,
) -> Result<Vec<u8>, SdoError> {
    match request {
        Request::Sdo {
            index,
            sub,
            complete,
            data: Some(data),
        } => {
            let written = coe.download(wire, index, sub, complete, &data).await;
            written.map(|()| Vec::new())
        }
        Request::Sdo {
            index,
            sub,
            complete,
            data: None,
        } => coe.upload(wire, index, sub, complete).await,
        Request::Idn {
            at,
            data: Some(data),
        } => {
            let written = coe.write_idn(wire, at, &data).await;
            written.map(|()| Vec::new())
        }
        Request::Idn { at, data: None } => coe.read_idn(wire, at).await,
        Request::Command {
            drive,
            idn,
            timeout,
        } => {
            let executed = coe.execute_command(wire, (drive, idn), timeout).await;
            executed.map(|()| Vec::new())
        }
    }
}

/// Reports emergencies as they arrive while the future runs.
pub(super) async fn forward_emergencies<F: Future>(
    name: &str,
    emergencies: &Emergencies,
    listener: &dyn EmergencySink,
    future: F,
) -> F::Output {
    let mut future = pin!(future);
    poll_fn(|context| {
        let done = future.as_mut().poll(context);
        listener.listen(name, emergencies);
        done
    })
    .await
}

/// Runs a future to completion while serving the workers.
pub async fn run_with_workers<W: MailboxTransport, F: Future>(
    workers: Vec<MailboxWorker<W>>,
    future: F,
) -> F::Output {
    let served = workers
        .into_iter()
        .map(|worker| Some(Box::pin(worker.serve())));
    let mut served: Vec<Option<Pin<Box<_>>>> = served.collect();
    let mut serve = |context: &mut Context<'_>| {
        for slot in &mut served {
            if let Some(worker) = slot
                && worker.as_mut().poll(context).is_ready()
            {
                *slot = None;
            }
        }
    };
    let mut future = pin!(future);
    poll_fn(|context| {
        // Served before the future, so that it sees finished answers, and after it, so that its
        // requests leave now.
        serve(context);
        let done = future.as_mut().poll(context);
        if done.is_pending() {
            serve(context);
        }
        done
    })
    .await
}
