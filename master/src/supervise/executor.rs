//! A small executor for the thread beside the cycle. Its waker writes an eventfd, so that a
//! completion in the real-time thread costs one system call and no lock.

use std::future::Future;
use std::os::fd::OwnedFd;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker};

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

/// Futures that wait for the clock are not woken; they are asked again this often.
const TICK: Timespec = Timespec {
    tv_sec: 0,
    tv_nsec: 500_000,
};

struct Bell(OwnedFd);

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        // Full means that the bell has been rung already.
        let _ = rustix::io::write(&self.0, &1_u64.to_ne_bytes());
    }
}

/// Runs a future to its end on this thread.
pub fn block_on<F: Future>(future: F) -> std::io::Result<F::Output> {
    let bell = Arc::new(Bell(eventfd(
        0,
        EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC,
    )?));
    let waker = Waker::from(Arc::clone(&bell));
    let mut context = Context::from_waker(&waker);
    let mut future = pin!(future);
    let mut drain = [0; 8];
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return Ok(output);
        }
        let mut fds = [PollFd::new(&bell.0, PollFlags::IN)];
        // An interrupted wait only asks the future once too often.
        let _ = poll(&mut fds, Some(&TICK));
        let _ = rustix::io::read(&bell.0, &mut drain);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn completes_by_wake_up_and_by_clock() {
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
