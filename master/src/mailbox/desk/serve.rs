//! One device's mailbox, looked after: requests one by one, messages that come unasked in between.

use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Wake, Waker};

use tokio::sync::mpsc;

use super::{Job, Listen, Request};
use crate::mailbox::{CoeClient, Emergencies, SdoError, Wire};

/// Owns the mailbox of one device.
#[derive(Debug)]
pub struct Desk<W> {
    name: Arc<str>,
    wire: W,
    coe: CoeClient,
    emergencies: Emergencies,
    urgent: mpsc::Receiver<Job>,
    jobs: mpsc::Receiver<Job>,
    arrivals: Arc<Arrivals>,
    /// Wakes `arrivals`; whom these wake in turn.
    waker: Waker,
    outer: Option<Waker>,
    listener: Arc<dyn Listen>,
}

/// Whether one of the receivers is worth looking at. Looking costs more than everything else that an idle desk does,
/// and every desk is polled in every cycle.
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

enum Next {
    Job(Job),
    /// A message waits that nobody has asked for.
    Message,
    /// Nobody will ask any more.
    End,
}

impl<W: Wire> Desk<W> {
    /// Until nobody can ask any more.
    pub async fn serve(mut self) {
        loop {
            match self.next().await {
                Next::Job(job) => self.do_job(job).await,
                Next::Message => {
                    let listening = self.coe.drain(&self.wire);
                    // A device that is gone is the cycle's to notice.
                    let _ =
                        telling(&self.name, &self.emergencies, &*self.listener, listening).await;
                }
                Next::End => return,
            }
        }
    }

    async fn next(&mut self) -> Next {
        poll_fn(|context| {
            if let Some(next) = self.arrived(context) {
                return Poll::Ready(next);
            }
            // Nothing wakes us for it; every executor here asks again soon.
            if self.coe.waits(&self.wire) {
                return Poll::Ready(Next::Message);
            }
            Poll::Pending
        })
        .await
    }

    /// What the receivers have, if anything has come since they had nothing.
    fn arrived(&mut self, context: &Context<'_>) -> Option<Next> {
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
            Poll::Ready(Some(job)) => Next::Job(job),
            _ => match self.jobs.poll_recv(&mut inner) {
                Poll::Ready(Some(job)) => Next::Job(job),
                Poll::Ready(None) => Next::End,
                Poll::Pending => return None,
            },
        };
        // There may be more.
        self.arrivals.new.store(true, Ordering::Release);
        Some(next)
    }

    async fn do_job(&mut self, job: Job) {
        let Job { request, mut reply } = job;
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
            telling(
                &self.name,
                &self.emergencies,
                &*self.listener,
                unless_dropped,
            )
            .await
        };
        match done {
            Some(answer) => {
                // It may have been dropped meanwhile.
                let _ = reply.send(answer);
            }
            None => {
                let settling = self.coe.give_up(&self.wire);
                let _ = telling(&self.name, &self.emergencies, &*self.listener, settling).await;
            }
        }
    }
}

impl<W> Desk<W> {
    pub(super) fn new(
        name: Arc<str>,
        wire: W,
        coe: CoeClient,
        urgent: mpsc::Receiver<Job>,
        jobs: mpsc::Receiver<Job>,
        listener: Arc<dyn Listen>,
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
            listener,
        }
    }
}

async fn transfer<W: Wire>(
    coe: &mut CoeClient,
    wire: &W,
    request: Request,
) -> Result<Vec<u8>, SdoError> {
    let Request {
        index,
        sub,
        complete,
        data,
    } = request;
    match data {
        Some(data) => {
            let written = coe.download(wire, index, sub, complete, &data).await;
            written.map(|()| Vec::new())
        }
        None => coe.upload(wire, index, sub, complete).await,
    }
}

/// Reports emergencies as they come, however long the future takes.
async fn telling<F: Future>(
    name: &str,
    emergencies: &Emergencies,
    listener: &dyn Listen,
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

/// Runs a future to its end, with desks beside it.
pub async fn beside<W: Wire, F: Future>(desks: Vec<Desk<W>>, future: F) -> F::Output {
    let served = desks.into_iter().map(|desk| Some(Box::pin(desk.serve())));
    let mut served: Vec<Option<Pin<Box<_>>>> = served.collect();
    let mut serve = |context: &mut Context<'_>| {
        for slot in &mut served {
            if let Some(desk) = slot
                && desk.as_mut().poll(context).is_ready()
            {
                *slot = None;
            }
        }
    };
    let mut future = pin!(future);
    poll_fn(|context| {
        // Before, so that what has been answered counts now; and after, so that what is asked leaves now.
        serve(context);
        let done = future.as_mut().poll(context);
        if done.is_pending() {
            serve(context);
        }
        done
    })
    .await
}
