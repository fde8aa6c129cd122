//! Limits the datagrams in flight: first come, first served, with bounded overtaking.
//!
//! A plain counter of datagrams in flight would not suffice. Of the frames that wait, ethercrab
//! sends the one in the lowest slot, which may be a newer one every time.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::task::{Poll, Waker};

#[derive(Debug)]
pub(super) struct InFlightLimiter {
    /// The size of the window, counted from the oldest permit.
    max: u64,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// The number of the oldest permit that is still in use.
    oldest: u64,
    /// For each permit from `oldest` on: true if it was dropped.
    over: VecDeque<bool>,
    waiting: Vec<Waker>,
}

/// Permission to send one datagram, until it is dropped.
#[derive(Debug)]
pub(super) struct Permit<'a> {
    turns: &'a InFlightLimiter,
    number: u64,
}

impl InFlightLimiter {
    pub fn new(max: u64) -> Self {
        Self {
            max,
            state: Mutex::default(),
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub async fn take(&self) -> Permit<'_> {
        let number = {
            let mut state = self.state();
            let number = state.oldest + state.over.len() as u64;
            state.over.push_back(false);
            number
        };
        let turn = Permit {
            turns: self,
            number,
        };
        poll_fn(|context| {
            let mut state = self.state();
            if number < state.oldest + self.max {
                return Poll::Ready(());
            }
            if !state.waiting.iter().any(|w| w.will_wake(context.waker())) {
                state.waiting.push(context.waker().clone());
            }
            Poll::Pending
        })
        .await;
        turn
    }
}

impl Drop for Permit<'_> {
    fn drop(&mut self) {
        let woken = {
            let mut state = self.turns.state();
            let place = usize::try_from(self.number - state.oldest).unwrap_or(usize::MAX);
            if let Some(over) = state.over.get_mut(place) {
                *over = true;
            }
            while state.over.front() == Some(&true) {
                state.over.pop_front();
                state.oldest += 1;
            }
            std::mem::take(&mut state.waiting)
        };
        for waker in woken {
            waker.wake();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;
    use std::task::Context;

    use super::*;

    #[test]
    fn limiter_bounds_overtaking() {
        let turns = InFlightLimiter::new(3);
        let mut context = Context::from_waker(Waker::noop());
        let mut at_once = || match pin!(turns.take()).poll(&mut context) {
            Poll::Ready(turn) => Some(turn),
            Poll::Pending => None,
        };
        let oldest = at_once().expect("it is the first");
        // Requests that do not get a permit are dropped and delay no other.
        let later = [at_once(), at_once(), at_once(), at_once()];
        assert_eq!(later.map(|turn| turn.is_some()), [true, true, false, false]);
        assert!(at_once().is_none(), "the oldest waits still");
        drop(oldest);
        assert!(
            [at_once(), at_once(), at_once()]
                .iter()
                .all(Option::is_some)
        );
    }

    #[test]
    fn limiter_grants_permits_in_order_of_request() {
        let turns = InFlightLimiter::new(3);
        let mut context = Context::from_waker(Waker::noop());
        let mut asked: Vec<_> = (0..8).map(|_| Box::pin(turns.take())).collect();
        let mut had = Vec::new();
        let mut order = Vec::new();
        for _ in 0..8 {
            for (number, future) in asked.iter_mut().enumerate() {
                if !order.contains(&number)
                    && let Poll::Ready(turn) = future.as_mut().poll(&mut context)
                {
                    order.push(number);
                    had.push(turn);
                }
            }
            had.remove(0);
        }
        assert_eq!(order, (0..8).collect::<Vec<_>>());
    }
}
