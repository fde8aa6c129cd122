//! The session's clock: monotonic time, or virtual time that advances only by waiting.
//!
//! This module is also ethercrab's time source. Without its `std` feature, ethercrab reads the time
//! from embassy-time. No wake-up is ever scheduled there, because every executor here polls.

use std::cell::Cell;
use std::future::poll_fn;
use std::task::{Poll, Waker};
use std::time::Duration;

use rustix::thread::{ClockId, clock_nanosleep_absolute};
use rustix::time::{Timespec, clock_gettime};

/// Nanoseconds of the session's clock.
pub type Nanos = u64;

const NANOS_PER_SECOND: u64 = 1_000_000_000;

/// The start of virtual time. It is not zero, so that a clock read before the start is visible.
const VIRTUAL_EPOCH: Nanos = NANOS_PER_SECOND;

/// A reading of two clocks that takes longer was interrupted.
const LONGEST_READING: Nanos = 5_000;

thread_local! {
    /// The virtual time of this thread; `None` where time is real.
    static VIRTUAL: Cell<Option<Nanos>> = const { Cell::new(None) };
    /// Common time minus virtual time.
    static COMMON: Cell<i64> = const { Cell::new(0) };
}

/// The name of the clock that computers have in common.
pub const COMMON_CLOCK: &str = "CLOCK_REALTIME";

/// The time base of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// `CLOCK_MONOTONIC`.
    Real,
    /// Advances only by waiting; one thread does all the work.
    Virtual,
}

/// Returns the time of the thread's clock. RT: reads the clock, no other system call.
#[must_use]
pub fn now() -> Nanos {
    VIRTUAL.get().unwrap_or_else(monotonic)
}

/// Returns common time (`CLOCK_REALTIME`) minus the time of the thread's clock. Linux runs both
/// clocks at the same rate, so the difference changes only when `CLOCK_REALTIME` is set. Virtual
/// time begins in 1970. Returns `None` if the thread was interrupted between the readings. RT:
/// reads clocks, no other system call.
#[must_use]
pub fn common_offset() -> Option<i64> {
    if VIRTUAL.get().is_some() {
        return Some(COMMON.get());
    }
    let before = monotonic();
    let common = read(ClockId::Realtime);
    let after = monotonic();
    let took = after.saturating_sub(before);
    (took <= LONGEST_READING).then(|| common.wrapping_sub(before + took / 2).cast_signed())
}

/// Sets the common time of this thread's virtual clock, as a program of the host sets
/// `CLOCK_REALTIME`.
pub fn set_common_offset(offset: i64) {
    COMMON.set(offset);
}

fn monotonic() -> Nanos {
    read(ClockId::Monotonic)
}

fn read(clock: ClockId) -> Nanos {
    let t = clock_gettime(clock);
    let seconds = u64::try_from(t.tv_sec).unwrap_or(0);
    let nanos = u64::try_from(t.tv_nsec).unwrap_or(0);
    seconds * NANOS_PER_SECOND + nanos
}

impl Clock {
    /// Makes this the clock of the calling thread.
    pub fn enter(self) {
        VIRTUAL.set(match self {
            Self::Real => None,
            Self::Virtual => Some(VIRTUAL_EPOCH),
        });
    }

    /// Sleeps until `spin` before `t`, then spins. Returns how late the sleep ended; `None` if it
    /// did not sleep or time is virtual. RT: blocks on the clock only.
    pub fn sleep_until(self, t: Nanos, spin: Nanos) -> Option<Nanos> {
        match self {
            Self::Virtual => {
                VIRTUAL.set(VIRTUAL.get().map(|now| now.max(t)));
                None
            }
            Self::Real => {
                let wake = t.saturating_sub(spin);
                let mut late = None;
                if monotonic() < wake {
                    let request = Timespec {
                        tv_sec: i64::try_from(wake / NANOS_PER_SECOND).unwrap_or(i64::MAX),
                        tv_nsec: i64::try_from(wake % NANOS_PER_SECOND).unwrap_or(0),
                    };
                    // A signal ends the sleep early; the loop below waits for the rest.
                    let slept = clock_nanosleep_absolute(ClockId::Monotonic, &request);
                    let now = monotonic();
                    late = slept.is_ok().then(|| now.saturating_sub(wake));
                    if now >= t {
                        return late;
                    }
                }
                while monotonic() < t {
                    std::hint::spin_loop();
                }
                late
            }
        }
    }

    /// One iteration of a polling loop that must poll again at `next` at the latest. RT.
    pub fn relax(self, next: Nanos) {
        match self {
            Self::Virtual => VIRTUAL.set(VIRTUAL.get().map(|now| now.max(next))),
            Self::Real => std::hint::spin_loop(),
        }
    }
}

/// Completes once the clock has advanced by `duration`.
pub async fn delay(duration: Duration) {
    let until = now().saturating_add(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX));
    poll_fn(|_| {
        if now() >= until {
            Poll::Ready(())
        } else {
            Poll::Pending
        }
    })
    .await;
}

/// Runs `work` until it completes; returns `None` if it takes longer than `duration`.
pub async fn timeout<F: Future>(duration: Duration, work: F) -> Option<F::Output> {
    tokio::select! {
        biased;
        output = work => Some(output),
        () = delay(duration) => None,
    }
}

#[derive(Debug)]
struct Driver;

impl embassy_time_driver::Driver for Driver {
    /// Ticks are microseconds (feature `tick-hz-1_000_000`).
    fn now(&self) -> u64 {
        now() / 1_000
    }

    fn schedule_wake(&self, _at: u64, _waker: &Waker) {}
}

embassy_time_driver::time_driver_impl!(static DRIVER: Driver = Driver);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sleep_until_returns_its_lateness() {
        let t = now() + 50_000_000;
        assert!(Clock::Real.sleep_until(t, 1_000_000).is_some());
        assert!(now() >= t);
        assert_eq!(
            Clock::Real.sleep_until(t, 1_000_000),
            None,
            "nothing to sleep"
        );
        let t = now() + 100_000;
        assert_eq!(
            Clock::Real.sleep_until(t, 1_000_000),
            None,
            "all of it is spun"
        );
        assert!(now() >= t);
    }

    #[test]
    fn common_time_is_that_of_the_system() {
        let offset = (0..1_000).find_map(|_| common_offset()).expect("a reading");
        let common = now().wrapping_add_signed(offset);
        let unix = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let unix = unix.expect("after 1970").as_nanos();
        assert!(
            unix.abs_diff(u128::from(common)) < 10_000_000_000,
            "{common} {unix}"
        );
    }

    #[test]
    fn virtual_time_advances_only_by_waiting() {
        std::thread::spawn(|| {
            Clock::Virtual.enter();
            let start = now();
            assert_eq!(now(), start);
            Clock::Virtual.sleep_until(start + 5_000_000, 100_000);
            assert_eq!(now(), start + 5_000_000);
            Clock::Virtual.relax(start);
            assert_eq!(now(), start + 5_000_000, "time never goes back");
            assert_eq!(embassy_time_driver::now(), now() / 1_000);
        })
        .join()
        .expect("thread");
    }
}
