//! Runs the same work on many devices at the same time, in one task.

use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::task::Poll;

/// Runs futures at the same time until all complete or one fails. Returns their outputs in order, or
/// the first error; then the other futures are dropped.
///
/// # Errors
/// The first error. Of several at the same time, that of the first future.
pub async fn try_join_all<T, E, F>(futures: impl IntoIterator<Item = F>) -> Result<Vec<T>, E>
where
    F: Future<Output = Result<T, E>>,
{
    let futures = futures.into_iter();
    let mut running: Vec<Pin<Box<F>>> = futures.map(Box::pin).collect();
    let mut outputs: Vec<Option<T>> = running.iter().map(|_| None).collect();
    poll_fn(|context| {
        let mut pending = false;
        for (future, output) in running.iter_mut().zip(&mut outputs) {
            if output.is_some() {
                continue;
            }
            match future.as_mut().poll(context) {
                Poll::Ready(Ok(value)) => *output = Some(value),
                Poll::Ready(Err(error)) => return Poll::Ready(Err(error)),
                Poll::Pending => pending = true,
            }
        }
        if pending {
            return Poll::Pending;
        }
        Poll::Ready(Ok(()))
    })
    .await?;
    Ok(outputs.into_iter().flatten().collect())
}

/// Futures that run while other work runs.
#[derive(Debug)]
pub struct Background<F> {
    running: Vec<Pin<Box<F>>>,
}

impl<F: Future> Background<F> {
    #[must_use]
    pub const fn new() -> Self {
        Self {
            running: Vec::new(),
        }
    }

    pub fn add(&mut self, future: F) {
        self.running.push(Box::pin(future));
    }

    /// Runs the futures until `work` completes. Returns its output, and the outputs of the futures
    /// that have completed meanwhile.
    pub async fn run_during<W: Future>(&mut self, work: W) -> (W::Output, Vec<F::Output>) {
        let mut work = pin!(work);
        let mut outputs = Vec::new();
        let done = poll_fn(|context| {
            self.running
                .retain_mut(|future| match future.as_mut().poll(context) {
                    Poll::Ready(output) => {
                        outputs.push(output);
                        false
                    }
                    Poll::Pending => true,
                });
            work.as_mut().poll(context)
        });
        (done.await, outputs)
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;
    use std::task::{Context, Waker};

    use super::*;

    /// Pending `times` times, then ready.
    async fn pause(times: u32) {
        let mut left = times;
        poll_fn(|_| match left {
            0 => Poll::Ready(()),
            _ => {
                left -= 1;
                Poll::Pending
            }
        })
        .await;
    }

    fn run<F: Future>(future: F) -> F::Output {
        let mut future = pin!(future);
        let mut context = Context::from_waker(Waker::noop());
        loop {
            if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
                return output;
            }
        }
    }

    #[test]
    fn try_join_all_runs_all_at_once_and_keeps_the_order() {
        let ended = RefCell::new(Vec::new());
        let each = [3, 1, 2].map(|times| {
            let ended = &ended;
            async move {
                pause(times).await;
                ended.borrow_mut().push(times);
                Ok::<_, ()>(times)
            }
        });
        assert_eq!(run(try_join_all(each)), Ok(vec![3, 1, 2]));
        assert_eq!(ended.into_inner(), [1, 2, 3]);
        let none: [std::future::Ready<Result<(), ()>>; 0] = [];
        assert_eq!(run(try_join_all(none)), Ok(vec![]));
    }

    #[test]
    fn try_join_all_ends_at_the_first_error() {
        let ended = RefCell::new(0);
        let each =
            [(5, Ok(())), (2, Err('b')), (2, Err('c')), (1, Ok(()))].map(|(times, result)| {
                let ended = &ended;
                async move {
                    pause(times).await;
                    *ended.borrow_mut() += 1;
                    result
                }
            });
        assert_eq!(run(try_join_all(each)), Err('b'));
        assert_eq!(ended.into_inner(), 2);
    }

    #[test]
    fn background_futures_run_on_during_later_work() {
        let mut background = Background::new();
        for times in [1, 5, 3] {
            background.add(async move {
                pause(times).await;
                times
            });
        }
        let outputs = |run: ((), Vec<u32>)| run.1;
        assert_eq!(outputs(run(background.run_during(pause(3)))), [1, 3]);
        assert!(outputs(run(background.run_during(pause(0)))).is_empty());
        assert_eq!(outputs(run(background.run_during(pause(9)))), [5]);
    }
}
