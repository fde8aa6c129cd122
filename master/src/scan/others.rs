//! Signs of another MainDevice on the segment. Looking for them writes nothing.

use std::fmt;
use std::time::Duration;

use crate::bringup::AlState;
use crate::mailbox::Wire;
use crate::service::station::{self, Found};
use crate::service::{Datagrams, ServiceError};

const STEP: &str = "looking for another MainDevice";
/// Looked at so often within the time that is given.
const LOOKS: u32 = 5;

const AL_CONTROL: u16 = 0x0120;
const SYNC_MANAGERS: u16 = 0x0800;
const SM_SIZE: usize = 8;
const MOST_SMS: usize = 8;
const DIFFERENCE: u16 = 0x092c;
const ACTIVATION: u16 = 0x0981;

/// What tells of another MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sign {
    /// Frames came in that nobody here had sent.
    Frames { count: u64 },
    /// A state that somebody must have led it to.
    State { position: u16, state: AlState },
    /// It makes SYNC0 or SYNC1.
    Sync { position: u16 },
    /// AL control changed meanwhile.
    Control { position: u16, from: u8, to: u8 },
    /// New outputs came meanwhile.
    Outputs { position: u16 },
    /// Its clock was corrected meanwhile.
    Time { position: u16 },
}

impl Sign {
    /// Somebody is there now; otherwise somebody may have left it so.
    #[must_use]
    pub fn is_live(&self) -> bool {
        !matches!(self, Self::State { .. } | Self::Sync { .. })
    }
}

impl fmt::Display for Sign {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Frames { count: 1 } => {
                f.write_str("a frame came in that this program had not sent")
            }
            Self::Frames { count } => {
                write!(f, "{count} frames came in that this program had not sent")
            }
            Self::State { position, state } => write!(f, "position {position} is in {state}"),
            Self::Sync { position } => write!(f, "position {position} makes SYNC0"),
            Self::Control { position, from, to } => write!(
                f,
                "position {position}: AL control changed from 0x{from:02x} to 0x{to:02x}"
            ),
            Self::Outputs { position } => {
                write!(f, "position {position} gets process data")
            }
            Self::Time { position } => write!(f, "position {position}: its clock is corrected"),
        }
    }
}

/// What only a MainDevice changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Look {
    control: u8,
    /// Which buffers of the output SyncManagers are full, two bits each.
    outputs: u16,
    /// 0x092C; it is only measured when somebody writes the system time.
    difference: Option<u32>,
}

/// Looks at everybody again and again for so long. `heard`: frames of others before.
///
/// # Errors
/// [`ServiceError::Silent`] where one leaves meanwhile.
pub async fn look(
    wire: &Datagrams,
    found: &[Found],
    heard: u64,
    time: Duration,
) -> Result<Vec<Sign>, ServiceError> {
    let mut signs = Vec::new();
    if heard > 0 {
        signs.push(Sign::Frames { count: heard });
    }
    for device in found {
        let position = device.position;
        let mut activation = [0; 1];
        let answer = wire.read_at(position, ACTIVATION, &mut activation).await;
        let clocked = matches!(answer, Ok(1..));
        signs.extend(left(device, clocked.then_some(activation[0])));
    }
    let mut first: Vec<Look> = Vec::with_capacity(found.len());
    for n in 0..LOOKS {
        for (at, device) in found.iter().enumerate() {
            let look = look_at(wire, device.position).await?;
            match first.get(at) {
                Some(before) => tell(device.position, *before, look, &mut signs),
                None => first.push(look),
            }
        }
        if n + 1 < LOOKS {
            // Each time longer: buffers go round, and a whole number of rounds looks like none.
            wire.delay(time * (n + 1) / (LOOKS * (LOOKS - 1) / 2)).await;
        }
    }
    Ok(signs)
}

/// What somebody must have led a device to. `activation`: 0x0981, where there is a clock.
fn left(device: &Found, activation: Option<u8>) -> impl Iterator<Item = Sign> + use<> {
    let (position, state) = (device.position, device.state);
    let led = matches!(state, AlState::SafeOp | AlState::Op);
    // Below SafeOp nobody uses SYNC0 or SYNC1: it is what a MainDevice that went away has forgotten.
    let sync = led && activation.is_some_and(|on| on & 1 != 0 && on & 0x06 != 0);
    let state = led.then_some(Sign::State { position, state });
    state
        .into_iter()
        .chain(sync.then_some(Sign::Sync { position }))
}

/// What has changed, once each.
fn tell(position: u16, before: Look, now: Look, signs: &mut Vec<Sign>) {
    let mut add = |sign: Sign, known: fn(&Sign) -> bool| {
        let known = |other: &Sign| known(other) && of(other) == Some(position);
        if !signs.iter().any(known) {
            signs.push(sign);
        }
    };
    if before.control != now.control {
        let (from, to) = (before.control, now.control);
        add(Sign::Control { position, from, to }, |s| {
            matches!(s, Sign::Control { .. })
        });
    }
    if before.outputs != now.outputs {
        add(Sign::Outputs { position }, |s| {
            matches!(s, Sign::Outputs { .. })
        });
    }
    if before.difference != now.difference {
        add(Sign::Time { position }, |s| matches!(s, Sign::Time { .. }));
    }
}

fn of(sign: &Sign) -> Option<u16> {
    match sign {
        Sign::Frames { .. } => None,
        Sign::State { position, .. }
        | Sign::Sync { position }
        | Sign::Control { position, .. }
        | Sign::Outputs { position }
        | Sign::Time { position } => Some(*position),
    }
}

async fn look_at(wire: &Datagrams, position: u16) -> Result<Look, ServiceError> {
    let [control, _] = station::at(wire, position, STEP, AL_CONTROL).await?;
    let mut sms = [0; SM_SIZE * MOST_SMS];
    // Controllers have four or eight; none answers for those it does not have.
    for len in [sms.len(), sms.len() / 2] {
        let some = sms.get_mut(..len).unwrap_or_default();
        if matches!(wire.read_at(position, SYNC_MANAGERS, some).await, Ok(1..)) {
            break;
        }
    }
    let mut difference = [0; 4];
    let answer = wire.read_at(position, DIFFERENCE, &mut difference).await;
    Ok(Look {
        control,
        outputs: full_buffers(&sms),
        difference: matches!(answer, Ok(1..)).then(|| u32::from_le_bytes(difference)),
    })
}

/// Of each SyncManager that is on, has three buffers and is written by the MainDevice: which of them was written last.
fn full_buffers(sms: &[u8]) -> u16 {
    sms.chunks_exact(SM_SIZE).fold(0, |all, sm| {
        let &[_, _, _, _, control, status, activate, _] = sm else {
            return all;
        };
        let outputs = control & 0x0f == 0x04 && activate & 1 != 0;
        let buffer = if outputs { status >> 4 & 3 } else { 0 };
        all << 2 | u16::from(buffer)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_of_outputs_alone() {
        let sm = |control, status, activate| [0, 0x10, 4, 0, control, status, activate, 0];
        let all = [
            sm(0x26, 0x30, 1), // a mailbox
            sm(0x64, 0x20, 1), // outputs
            sm(0x20, 0x20, 1), // inputs
            sm(0x64, 0x20, 0), // off
        ]
        .concat();
        assert_eq!(full_buffers(&all), 0b00_10_00_00);
    }

    #[test]
    fn sync0_is_a_sign_where_it_is_used() {
        for (state, activation, expected) in [
            (AlState::Init, Some(3), 0),
            (AlState::PreOp, Some(7), 0),
            (AlState::SafeOp, None, 1),
            (AlState::SafeOp, Some(1), 1),
            (AlState::SafeOp, Some(2), 1),
            (AlState::SafeOp, Some(3), 2),
            (AlState::Op, Some(5), 2),
        ] {
            let found = Found {
                position: 1,
                station: 0x1001,
                alias: 0,
                state,
                error: false,
                code: 0,
            };
            let signs: Vec<_> = left(&found, activation).collect();
            assert_eq!(signs.len(), expected, "{state} {activation:?}: {signs:?}");
            assert!(!signs.iter().any(Sign::is_live));
        }
    }

    #[test]
    fn each_change_is_told_once() {
        let before = Look {
            control: 2,
            outputs: 0,
            difference: Some(1),
        };
        let now = Look {
            control: 4,
            outputs: 1,
            difference: Some(2),
        };
        let mut signs = Vec::new();
        for _ in 0..3 {
            tell(7, before, before, &mut signs);
            tell(7, before, now, &mut signs);
        }
        tell(8, before, now, &mut signs);
        assert_eq!(signs.len(), 6, "{signs:?}");
        assert!(signs.iter().all(Sign::is_live));
    }
}
