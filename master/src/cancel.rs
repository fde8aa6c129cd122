//! Cooperative cancellation that leaves nothing half done.

use std::future::poll_fn;
use std::pin::pin;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::task::Poll;

/// Cancels work cooperatively. [`CancelToken::run_until_cancelled`] drops a cancelled future at its
/// next await. Sections in [`CancelToken::shield`] run to completion first: restoring a device's
/// state, finishing an EEPROM write.
///
/// One thread polls all futures under one token.
#[derive(Debug, Default)]
pub struct CancelToken {
    asked: AtomicBool,
    /// The number of shielded sections that are running.
    held: AtomicU32,
}

/// Marks a shielded section as running until it is dropped.
struct ShieldGuard<'a>(&'a AtomicU32);

impl<'a> ShieldGuard<'a> {
    fn new(held: &'a AtomicU32) -> Self {
        held.fetch_add(1, Ordering::Relaxed);
        Self(held)
    }
}

impl Drop for ShieldGuard<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl CancelToken {
    /// Returns a token that is never cancelled.
    #[must_use]
    pub fn never() -> &'static Self {
        static NEVER: CancelToken = CancelToken {
            asked: AtomicBool::new(false),
            held: AtomicU32::new(0),
        };
        &NEVER
    }

    /// Requests cancellation.
    pub fn cancel(&self) {
        self.asked.store(true, Ordering::Relaxed);
    }

    /// True once cancellation was requested. A shielded section checks this where it can end early.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }

    /// Runs `work` until it completes. Returns `None` if the token is cancelled while no inner
    /// section is shielded.
    pub async fn run_until_cancelled<F: Future>(&self, work: F) -> Option<F::Output> {
        let held = || self.held.load(Ordering::Relaxed);
        let outside = held();
        run_until(|| self.is_cancelled() && held() == outside, work).await
    }

    /// Runs `work` until it completes. Returns `None` once the token is cancelled, even in a shielded
    /// section.
    pub(crate) async fn run_until_requested<F: Future>(&self, work: F) -> Option<F::Output> {
        run_until(|| self.is_cancelled(), work).await
    }

    /// Runs `work` to completion even if the token is cancelled.
    pub async fn shield<F: Future>(&self, work: F) -> F::Output {
        let _held = ShieldGuard::new(&self.held);
        work.await
    }

    /// Runs `work` and cancels this token once `parent` is cancelled.
    pub(crate) async fn cancel_with<F: Future>(&self, parent: &Self, work: F) -> F::Output {
        let mut work = pin!(work);
        poll_fn(|context| {
            if parent.is_cancelled() {
                self.cancel();
            }
            work.as_mut().poll(context)
        })
        .await
    }
}

/// Runs `work` until it completes; returns `None` once `ends` returns true. Every executor here
/// polls again soon, so nothing is woken.
async fn run_until<F: Future>(ends: impl Fn() -> bool, work: F) -> Option<F::Output> {
    let ends = poll_fn(|_| match ends() {
        true => Poll::Ready(()),
        false => Poll::Pending,
    });
    tokio::select! {
        biased;
        () = ends => None,
        output = work => Some(output),
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::task::{Context, Waker};

    use super::*;

    /// Pending once, then ready.
    async fn pause() {
        let mut waited = false;
        poll_fn(|_| {
            let ready = waited;
            waited = true;
            match ready {
                true => Poll::Ready(()),
                false => Poll::Pending,
            }
        })
        .await;
    }

    /// Polls `future` at most `most` times, until it is ready.
    fn polled<F: Future>(future: F, most: usize) -> Option<F::Output> {
        let mut future = pin!(future);
        let mut context = Context::from_waker(Waker::noop());
        (0..most).find_map(|_| match future.as_mut().poll(&mut context) {
            Poll::Ready(output) => Some(output),
            Poll::Pending => None,
        })
    }

    #[test]
    fn cancel_completes_only_shielded_sections() {
        // The step that requests cancellation, and the text that the work has written by then.
        for (at, expected) in [
            (0, ""),
            (1, "a"),
            // Inside the shielded section, only the inner cancellable section ends early.
            (2, "a<>"),
            (3, "a<b>"),
            (4, "a<b>c"),
            (5, "a<b>cd"),
        ] {
            let stop = CancelToken::default();
            let (flag, reported, step) = (
                CancelToken::default(),
                std::cell::RefCell::new(String::new()),
                Cell::new(0),
            );
            let reached = |n: i32| {
                step.set(n);
                if n == at {
                    flag.cancel();
                }
            };
            let say = |text: &str| reported.borrow_mut().push_str(text);
            reached(0);
            let work = async {
                say("a");
                reached(1);
                pause().await;
                stop.shield(async {
                    say("<");
                    reached(2);
                    pause().await;
                    let inner = async {
                        pause().await;
                        say("b");
                        reached(3);
                        pause().await;
                    };
                    let left = stop.run_until_cancelled(inner).await.is_none();
                    assert_eq!(left, at == 2 || at == 3);
                    pause().await;
                    say(">");
                })
                .await;
                reached(4);
                if at != 4 {
                    pause().await;
                }
                say("c");
                pause().await;
                say("d");
                reached(5);
            };
            let done = polled(stop.cancel_with(&flag, stop.run_until_cancelled(work)), 20)
                .expect("it ends");
            assert_eq!(reported.into_inner(), expected, "at {at}");
            assert_eq!(done.is_some(), at == 5, "at {at}, reached {}", step.get());
            assert_eq!(stop.held.load(Ordering::Relaxed), 0);
        }
    }
}
