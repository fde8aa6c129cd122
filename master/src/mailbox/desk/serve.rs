//! One device's mailbox, looked after: requests one by one, messages that come unasked in between.

use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};

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
    listener: Arc<dyn Listen>,
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
            if let Poll::Ready(Some(job)) = self.urgent.poll_recv(context) {
                return Poll::Ready(Next::Job(job));
            }
            match self.jobs.poll_recv(context) {
                Poll::Ready(Some(job)) => return Poll::Ready(Next::Job(job)),
                Poll::Ready(None) => return Poll::Ready(Next::End),
                Poll::Pending => {}
            }
            // Nothing wakes us for it; every executor here asks again soon.
            if self.coe.waits(&self.wire) {
                return Poll::Ready(Next::Message);
            }
            Poll::Pending
        })
        .await
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
        Self {
            name,
            wire,
            coe,
            emergencies,
            urgent,
            jobs,
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
