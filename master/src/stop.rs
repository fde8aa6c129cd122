//! Ends a piece of work early, where that leaves nothing half done.

use std::future::poll_fn;
use std::pin::pin;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::task::Poll;

/// Somebody may want a piece of work to end before it is done. It is left where it waits ([`Stop::unless`]), except that what is in
/// hand somewhere within ([`Stop::hold`]) comes to its own end first: a device's state put back, an EEPROM written to its last word.
///
/// The pieces of one work are polled by one thread.
#[derive(Debug, Default)]
pub struct Stop {
    asked: AtomicBool,
    /// Pieces in hand.
    held: AtomicU32,
}

/// In hand until it is dropped.
struct Held<'a>(&'a AtomicU32);

impl<'a> Held<'a> {
    fn new(held: &'a AtomicU32) -> Self {
        held.fetch_add(1, Ordering::Relaxed);
        Self(held)
    }
}

impl Drop for Held<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Stop {
    /// Of work that nobody ends.
    #[must_use]
    pub fn never() -> &'static Self {
        static NEVER: Stop = Stop {
            asked: AtomicBool::new(false),
            held: AtomicU32::new(0),
        };
        &NEVER
    }

    /// The work is to end.
    pub fn ask(&self) {
        self.asked.store(true, Ordering::Relaxed);
    }

    /// Whether the work is to end. What is in hand looks for it where it can end early.
    #[must_use]
    pub fn is_asked(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }

    /// Work that is left once it is to end and nothing within is in hand; `None` then.
    pub async fn unless<F: Future>(&self, work: F) -> Option<F::Output> {
        let mut work = pin!(work);
        let outside = self.held.load(Ordering::Relaxed);
        poll_fn(|context| {
            if self.is_asked() && self.held.load(Ordering::Relaxed) == outside {
                return Poll::Ready(None);
            }
            work.as_mut().poll(context).map(Some)
        })
        .await
    }

    /// Work that comes to its own end, whoever wants it to end.
    pub async fn hold<F: Future>(&self, work: F) -> F::Output {
        let _held = Held::new(&self.held);
        work.await
    }

    /// Work that is to end once `flag` is set.
    pub(crate) async fn once<F: Future>(&self, flag: &AtomicBool, work: F) -> F::Output {
        let mut work = pin!(work);
        poll_fn(|context| {
            if flag.load(Ordering::Relaxed) {
                self.ask();
            }
            work.as_mut().poll(context)
        })
        .await
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::task::{Context, Waker};

    use super::*;

    /// Pending once.
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

    /// Polls so often, at most, until it is done.
    fn polled<F: Future>(future: F, most: usize) -> Option<F::Output> {
        let mut future = pin!(future);
        let mut context = Context::from_waker(Waker::noop());
        (0..most).find_map(|_| match future.as_mut().poll(&mut context) {
            Poll::Ready(output) => Some(output),
            Poll::Pending => None,
        })
    }

    #[test]
    fn what_is_in_hand_comes_to_its_end_and_nothing_more() {
        // Where it is asked to end; what has been done then.
        for (at, expected) in [
            (0, ""),
            (1, "a"),
            // Within what is held only what may be left is left.
            (2, "a<>"),
            (3, "a<b>"),
            (4, "a<b>c"),
            (5, "a<b>cd"),
        ] {
            let stop = Stop::default();
            let (flag, told, step) = (
                AtomicBool::new(false),
                std::cell::RefCell::new(String::new()),
                Cell::new(0),
            );
            let reached = |n: i32| {
                step.set(n);
                if n == at {
                    flag.store(true, Ordering::Relaxed);
                }
            };
            let say = |text: &str| told.borrow_mut().push_str(text);
            reached(0);
            let work = async {
                say("a");
                reached(1);
                pause().await;
                stop.hold(async {
                    say("<");
                    reached(2);
                    pause().await;
                    let inner = async {
                        pause().await;
                        say("b");
                        reached(3);
                        pause().await;
                    };
                    let left = stop.unless(inner).await.is_none();
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
            let done = polled(stop.once(&flag, stop.unless(work)), 20).expect("it ends");
            assert_eq!(told.into_inner(), expected, "at {at}");
            assert_eq!(done.is_some(), at == 5, "at {at}, reached {}", step.get());
            assert_eq!(stop.held.load(Ordering::Relaxed), 0);
        }
    }
}
