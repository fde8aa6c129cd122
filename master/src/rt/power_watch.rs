//! Every loss of power has a recorded cause. An axis whose drive leaves Operation enabled without
//! one shows an error of this program: the machine fails.

/// What an axis was commanded to do with its power, and what its drive shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct PowerWatch {
    /// Power was commanded, and nothing has ended that command.
    wanted: bool,
    /// Since then the axis was enabled, and its drive in Operation enabled.
    present: bool,
}

impl PowerWatch {
    /// Records a command that enables the axis. RT.
    pub const fn want(&mut self) {
        *self = Self {
            wanted: true,
            present: false,
        };
    }

    /// Records a cause for which the axis may lose its power: a command, a stop, a trip or a fault.
    /// RT.
    pub const fn end(&mut self) {
        self.wanted = false;
    }

    /// Records a mode switch: some drives need it without power. RT.
    pub const fn switch_mode(&mut self) {
        self.present = false;
    }

    /// True if power is not commanded, or a cause has ended the command. RT.
    pub const fn has_ended(self) -> bool {
        !self.wanted
    }

    /// Takes the state of a drive that was heard in this cycle. Returns true, once, if it has left
    /// Operation enabled without a cause. RT.
    pub const fn is_lost(&mut self, enabled: bool, operation_enabled: bool) -> bool {
        let lost = self.wanted && self.present && !operation_enabled;
        if lost {
            self.wanted = false;
        }
        self.present = operation_enabled && (self.present || enabled);
        lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_of_power_needs_a_cause() {
        let mut watch = PowerWatch::default();
        // A drive that was enabled before the run.
        assert!(!watch.is_lost(false, true) && !watch.is_lost(false, false));
        watch.want();
        // On its way from an earlier command, before the axis is enabled.
        assert!(!watch.is_lost(false, true) && !watch.is_lost(false, false));
        assert!(!watch.is_lost(true, true) && !watch.is_lost(false, true));
        assert!(watch.is_lost(false, false));
        assert!(!watch.is_lost(false, false), "reported once");

        watch.want();
        assert!(!watch.is_lost(true, true) && !watch.has_ended());
        watch.switch_mode();
        assert!(!watch.is_lost(false, false) && !watch.is_lost(true, true));
        watch.end();
        assert!(!watch.is_lost(false, false) && watch.has_ended());
    }
}
