//! The delay between two attempts to bring a bus up.

use std::time::Duration;

/// The first and the longest delay.
const FIRST: Duration = Duration::from_secs(1);
const LONGEST: Duration = Duration::from_secs(10);
/// A bus that was up as long ends the series of failed attempts.
const LASTED_NS: u64 = 10_000_000_000;

/// The delay until the next attempt. It grows with each failed attempt in a row.
#[derive(Debug)]
pub struct RetryDelay {
    next: Duration,
}

impl Default for RetryDelay {
    fn default() -> Self {
        Self { next: FIRST }
    }
}

impl RetryDelay {
    /// Returns the delay after a failure. `up_ns` is how long the bus was up; `None` if it did not
    /// come up.
    pub fn after_failure(&mut self, up_ns: Option<u64>) -> Duration {
        if up_ns.is_some_and(|ns| ns > LASTED_NS) {
            self.next = FIRST;
        }
        let delay = self.next;
        self.next = (delay * 2).min(LONGEST);
        delay
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delay_grows_until_the_bus_was_up() {
        let mut delay = RetryDelay::default();
        let seconds = [
            None,
            None,
            Some(1),
            None,
            None,
            None,
            Some(LASTED_NS + 1),
            None,
        ]
        .map(|up_ns| delay.after_failure(up_ns).as_secs());
        assert_eq!(seconds, [1, 2, 4, 8, 10, 10, 1, 2]);
    }
}
