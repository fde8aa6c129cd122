//! The watchdogs for process data and for the process data interface (0x0400–0x0443).

/// Reset values of divider and count: 100 µs per unit, 1000 units.
pub const DEFAULT_DIVIDER: u16 = 0x09c2;
pub const DEFAULT_COUNT: u16 = 0x03e8;

#[derive(Debug, Clone, Default)]
pub struct Watchdog {
    /// Local time of expiry; `None` while the watchdog is stopped or has expired.
    deadline: Option<u64>,
    expired: bool,
}

impl Watchdog {
    /// Restarts the watchdog; a count of 0 switches it off. It expires after `divider` and `count`;
    /// real watchdogs take up to one unit longer.
    pub fn trigger(&mut self, local: u64, divider: u16, count: u16) {
        self.expired = false;
        let unit = (u64::from(divider) + 2) * 40;
        self.deadline = (count > 0).then(|| local.saturating_add(unit * u64::from(count)));
    }

    /// Stops the watchdog and clears an expiry.
    pub fn stop(&mut self) {
        (self.deadline, self.expired) = (None, false);
    }

    pub fn expire(&mut self) {
        (self.deadline, self.expired) = (None, true);
    }

    /// True if the watchdog expired and was not triggered since.
    #[must_use]
    pub fn expired(&self) -> bool {
        self.expired
    }

    #[must_use]
    pub fn due(&self) -> u64 {
        self.deadline.unwrap_or(u64::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn watchdog_time_follows_divider_and_count() {
        // (divider, count, nanoseconds)
        let rows = [
            (DEFAULT_DIVIDER, DEFAULT_COUNT, 100_000_000),
            (0, 1, 80),
            (0x09c2, 1, 100_000),
            (0xffff, 0xffff, 65_537 * 40 * 65_535),
        ];
        for (divider, count, expected) in rows {
            let mut watchdog = Watchdog::default();
            assert_eq!(watchdog.due(), u64::MAX, "not before it is triggered");
            watchdog.trigger(5, divider, count);
            assert_eq!(watchdog.due(), expected + 5);
            watchdog.trigger(5, divider, 0);
            assert_eq!(watchdog.due(), u64::MAX, "0 switches it off");
        }
    }
}
