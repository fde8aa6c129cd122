//! A small executor for the supervisor's thread. Its waker writes an eventfd, so that a completion
//! in the real-time thread costs one system call and no lock.

use std::future::Future;
use std::os::fd::OwnedFd;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker};

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

/// The poll period for futures that wait for the clock; these are never woken.
const TICK: Timespec = Timespec {
    tv_sec: 0,
    tv_nsec: 500_000,
};

struct EventFdWaker(OwnedFd);

impl Wake for EventFdWaker {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        // A full counter means that a wake-up is already pending.
        let _ = rustix::io::write(&self.0, &1_u64.to_ne_bytes());
    }
}

/// Runs a future to completion on this thread.
pub fn block_on<F: Future>(future: F) -> std::io::Result<F::Output> {
    let event_fd = Arc::new(EventFdWaker(eventfd(
        0,
        EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC,
    )?));
    let waker = Waker::from(Arc::clone(&event_fd));
    let mut context = Context::from_waker(&waker);
    let mut future = pin!(future);
    let mut drain = [0; 8];
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return Ok(output);
        }
        let mut fds = [PollFd::new(&event_fd.0, PollFlags::IN)];
        // An interrupted wait only causes one unneeded poll.
        let _ = poll(&mut fds, Some(&TICK));
        let _ = rustix::io::read(&event_fd.0, &mut drain);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn block_on_completes_by_wake_up_and_by_clock() {
        let (tx, rx) = tokio::sync::oneshot::channel();
        let other = std::thread::spawn(move || tx.send(7).expect("receiver lives"));
        let sum = block_on(async {
            crate::clock::delay(Duration::from_millis(2)).await;
            rx.await.expect("sender lives") + 1
        })
        .expect("eventfd");
        other.join().expect("thread");
        assert_eq!(sum, 8);
    }
}
