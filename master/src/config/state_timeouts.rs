//! The time-outs of state changes: those of the ESI, otherwise the defaults of ETG.1020. ETG.2010
//! defines no content for time-outs in the EEPROM.

use std::time::Duration;

use ecaxis_esi::model::Info;

use crate::mailbox::Timeouts;
use ecaxis_ecat::al_state::AlState;

/// The ETG.1020 default for Init → PreOp.
pub const PRE_OP_TIMEOUT: Duration = Duration::from_secs(3);
/// The ETG.1020 default for PreOp → SafeOp.
pub const SAFE_OP_TIMEOUT: Duration = Duration::from_secs(10);
/// The ETG.1020 default for a transition to a lower state.
pub const BACK_TIMEOUT: Duration = Duration::from_secs(5);

/// The time-outs of one device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StateTimeouts {
    /// Init → PreOp and Init → Bootstrap.
    pub pre_op: Duration,
    /// PreOp → SafeOp and SafeOp → Op.
    pub safe_op_op: Duration,
    /// Any state → Init, and SafeOp → PreOp.
    pub back_to_init: Duration,
    /// Op → SafeOp.
    pub back_to_safe_op: Duration,
}

impl StateTimeouts {
    /// The defaults of ETG.1020.
    pub const DEFAULT: Self = Self {
        pre_op: PRE_OP_TIMEOUT,
        safe_op_op: SAFE_OP_TIMEOUT,
        back_to_init: BACK_TIMEOUT,
        back_to_safe_op: Duration::from_millis(200),
    };

    /// Returns the time-outs of `Info/StateMachine/Timeout` (ETG.2000). A time of 0 is not stated.
    #[must_use]
    pub fn new(info: &Info) -> Self {
        let or = |ms, default| milliseconds(ms).unwrap_or(default);
        let default = Self::DEFAULT;
        Self {
            pre_op: or(info.preop_timeout_ms, default.pre_op),
            safe_op_op: or(info.safeop_op_timeout_ms, default.safe_op_op),
            back_to_init: or(info.back_to_init_timeout_ms, default.back_to_init),
            back_to_safe_op: or(info.back_to_safeop_timeout_ms, default.back_to_safe_op),
        }
    }

    /// Returns the time-out of the way up to a state, or of the way back to it.
    #[must_use]
    pub fn select(&self, wanted: AlState, back: bool) -> Duration {
        match (wanted, back) {
            (AlState::SafeOp, true) => self.back_to_safe_op,
            (_, true) | (AlState::Init | AlState::Unknown(_), false) => self.back_to_init,
            (AlState::PreOp | AlState::Bootstrap, false) => self.pre_op,
            (AlState::SafeOp | AlState::Op, false) => self.safe_op_op,
        }
    }
}

/// Returns the mailbox time-outs of `Info/Mailbox/Timeout` (ETG.2000).
#[must_use]
pub fn mailbox_timeouts(info: &Info) -> Timeouts {
    let default = Timeouts::default();
    Timeouts {
        request: milliseconds(info.mailbox_request_timeout_ms).unwrap_or(default.request),
        answer: milliseconds(info.mailbox_response_timeout_ms).unwrap_or(default.answer),
        ..default
    }
}

fn milliseconds(ms: Option<u32>) -> Option<Duration> {
    ms.filter(|ms| *ms > 0)
        .map(|ms| Duration::from_millis(u64::from(ms)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// ETG.2000, `Info/StateMachine/Timeout` and `Info/Mailbox/Timeout`; the defaults are those of
    /// ETG.1020.
    #[test]
    fn timeouts_of_the_esi_replace_the_defaults_one_by_one() {
        let ms = Duration::from_millis;
        let default = StateTimeouts::new(&Info::default());
        let up = [AlState::PreOp, AlState::SafeOp, AlState::Op];
        let times = up.map(|state| default.select(state, false));
        assert_eq!(times, [ms(3_000), ms(10_000), ms(10_000)]);
        let back = [AlState::SafeOp, AlState::PreOp, AlState::Init];
        let times = back.map(|state| default.select(state, true));
        assert_eq!(times, [ms(200), ms(5_000), ms(5_000)]);

        let info = Info {
            safeop_op_timeout_ms: Some(30_000),
            back_to_safeop_timeout_ms: Some(0),
            mailbox_response_timeout_ms: Some(2_000),
            ..Info::default()
        };
        let stated = StateTimeouts::new(&info);
        let expected = StateTimeouts {
            safe_op_op: ms(30_000),
            ..default
        };
        assert_eq!(stated, expected);
        let mailbox = mailbox_timeouts(&info);
        assert_eq!((mailbox.request, mailbox.answer), (ms(100), ms(2_000)));
    }
}
