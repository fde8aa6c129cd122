//! The process-data watchdog (0x0400–0x0443). The PDI watchdog never expires: the simulated
//! application does not hang.

/// Reset values: 100 µs per unit, 1000 units.
pub const DEFAULT_DIVIDER: u16 = 0x09c2;
pub const DEFAULT_COUNT: u16 = 0x03e8;

#[derive(Debug, Clone, Default)]
pub struct Watchdog {
    /// Local time of expiry, `None` until first triggered.
    deadline: Option<u64>,
    pub expired: bool,
}

impl Watchdog {
    /// Process data arrived in a SyncManager that triggers the watchdog.
    pub fn trigger(&mut self, local: u64, divider: u16, count: u16) {
        self.expired = false;
        let unit = (u64::from(divider) + 2) * 40;
        self.deadline = (count > 0).then(|| local.saturating_add(unit * u64::from(count)));
    }

    /// Stops waiting, as leaving SafeOp and Op does.
    pub fn stop(&mut self) {
        self.deadline = None;
        self.expired = false;
    }

    #[must_use]
    pub fn due(&self) -> u64 {
        self.deadline.unwrap_or(u64::MAX)
    }

    pub fn expire(&mut self) {
        self.deadline = None;
        self.expired = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_100_ms() {
        let mut watchdog = Watchdog::default();
        assert_eq!(watchdog.due(), u64::MAX);
        watchdog.trigger(5, DEFAULT_DIVIDER, DEFAULT_COUNT);
        assert_eq!(watchdog.due(), 100_000_005);
        watchdog.trigger(5, DEFAULT_DIVIDER, 0);
        assert_eq!(watchdog.due(), u64::MAX);
    }
}
