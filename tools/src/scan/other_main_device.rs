//! Evidence of another MainDevice on the segment. The detection writes nothing.

use std::fmt;
use std::time::Duration;

use ecaxis_ecat::registers;
use ecaxis_master::acyclic::AlState;
use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::acyclic::enumerate::{self, EnumeratedDevice};
use ecaxis_master::mailbox::MailboxTransport;
use ecaxis_master::report::Error;

const STEP: &str = "looking for another MainDevice";
/// The number of samples within the given time.
const LOOKS: u32 = 5;

const SM_SIZE: usize = 8;
const MOST_SMS: usize = 8;

/// Evidence of another MainDevice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MainDeviceEvidence {
    /// Foreign frames arrived.
    Frames { count: u64 },
    /// A state that only a MainDevice can have requested.
    State { position: u16, state: AlState },
    /// SYNC0 or SYNC1 is active.
    Sync { position: u16 },
    /// AL control changed during the detection.
    Control { position: u16, from: u8, to: u8 },
    /// New outputs arrived during the detection.
    Outputs { position: u16 },
    /// The clock was corrected during the detection.
    Time { position: u16 },
}

impl MainDeviceEvidence {
    /// True if the MainDevice is active now; otherwise it may have left.
    #[must_use]
    pub fn is_live(&self) -> bool {
        !matches!(self, Self::State { .. } | Self::Sync { .. })
    }
}

impl fmt::Display for MainDeviceEvidence {
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

/// Values that only a MainDevice changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct LivenessSample {
    control: u8,
    /// The full buffers of the output SyncManagers, two bits each.
    outputs: u16,
    /// 0x092C; updated only when a MainDevice writes the system time.
    difference: Option<u32>,
}

/// Samples all devices repeatedly for `time`. `heard`: foreign frames before the detection.
///
/// # Errors
/// [`Cause::Silent`](ecaxis_master::report::Cause::Silent) if a device leaves during the detection.
pub async fn look(
    wire: &DatagramClient,
    found: &[EnumeratedDevice],
    heard: u64,
    time: Duration,
) -> Result<Vec<MainDeviceEvidence>, Error> {
    let mut signs = Vec::new();
    if heard > 0 {
        signs.push(MainDeviceEvidence::Frames { count: heard });
    }
    for device in found {
        let position = device.position;
        let mut activation = [0; 1];
        let answer = wire
            .read_at(position, registers::DC_ACTIVATION, &mut activation)
            .await;
        let clocked = matches!(answer, Ok(1..));
        signs.extend(left(device, clocked.then_some(activation[0])));
    }
    let mut first: Vec<LivenessSample> = Vec::with_capacity(found.len());
    for n in 0..LOOKS {
        for (at, device) in found.iter().enumerate() {
            let look = look_at(wire, device.position).await?;
            match first.get(at) {
                Some(before) => collect_evidence(device.position, *before, look, &mut signs),
                None => first.push(look),
            }
        }
        if n + 1 < LOOKS {
            // Intervals grow: buffers rotate, and a whole number of rotations shows no change.
            wire.delay(time * (n + 1) / (LOOKS * (LOOKS - 1) / 2)).await;
        }
    }
    Ok(signs)
}

/// Returns the traces of an earlier MainDevice. `activation`: 0x0981, if the device has a clock.
fn left(
    device: &EnumeratedDevice,
    activation: Option<u8>,
) -> impl Iterator<Item = MainDeviceEvidence> + use<> {
    let (position, state) = (device.position, device.state);
    let led = matches!(state, AlState::SafeOp | AlState::Op);
    // Below SafeOp, SYNC0 and SYNC1 are unused: a departed MainDevice left them on.
    let sync = led && activation.is_some_and(|on| on & 1 != 0 && on & 0x06 != 0);
    let state = led.then_some(MainDeviceEvidence::State { position, state });
    state
        .into_iter()
        .chain(sync.then_some(MainDeviceEvidence::Sync { position }))
}

/// Returns the changes, each once.
fn collect_evidence(
    position: u16,
    before: LivenessSample,
    now: LivenessSample,
    signs: &mut Vec<MainDeviceEvidence>,
) {
    let mut add = |sign: MainDeviceEvidence, known: fn(&MainDeviceEvidence) -> bool| {
        let known = |other: &MainDeviceEvidence| known(other) && of(other) == Some(position);
        if !signs.iter().any(known) {
            signs.push(sign);
        }
    };
    if before.control != now.control {
        let (from, to) = (before.control, now.control);
        add(MainDeviceEvidence::Control { position, from, to }, |s| {
            matches!(s, MainDeviceEvidence::Control { .. })
        });
    }
    if before.outputs != now.outputs {
        add(MainDeviceEvidence::Outputs { position }, |s| {
            matches!(s, MainDeviceEvidence::Outputs { .. })
        });
    }
    if before.difference != now.difference {
        add(MainDeviceEvidence::Time { position }, |s| {
            matches!(s, MainDeviceEvidence::Time { .. })
        });
    }
}

fn of(sign: &MainDeviceEvidence) -> Option<u16> {
    match sign {
        MainDeviceEvidence::Frames { .. } => None,
        MainDeviceEvidence::State { position, .. }
        | MainDeviceEvidence::Sync { position }
        | MainDeviceEvidence::Control { position, .. }
        | MainDeviceEvidence::Outputs { position }
        | MainDeviceEvidence::Time { position } => Some(*position),
    }
}

async fn look_at(wire: &DatagramClient, position: u16) -> Result<LivenessSample, Error> {
    let [control, _] = enumerate::at(wire, position, STEP, registers::AL_CONTROL).await?;
    let mut sms = [0; SM_SIZE * MOST_SMS];
    // Controllers have four or eight SyncManagers; reading more gets no answer.
    for len in [sms.len(), sms.len() / 2] {
        let some = sms.get_mut(..len).unwrap_or_default();
        if matches!(
            wire.read_at(position, registers::SYNC_MANAGER, some).await,
            Ok(1..)
        ) {
            break;
        }
    }
    let mut difference = [0; 4];
    let answer = wire
        .read_at(
            position,
            registers::DC_SYSTEM_TIME_DIFFERENCE,
            &mut difference,
        )
        .await;
    Ok(LivenessSample {
        control,
        outputs: full_buffers(&sms),
        difference: matches!(answer, Ok(1..)).then(|| u32::from_le_bytes(difference)),
    })
}

/// Returns the last written buffer of each active output SyncManager with three buffers.
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
    fn full_buffers_covers_only_outputs() {
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
    fn sync0_is_evidence_only_if_used() {
        for (state, activation, expected) in [
            (AlState::Init, Some(3), 0),
            (AlState::PreOp, Some(7), 0),
            (AlState::SafeOp, None, 1),
            (AlState::SafeOp, Some(1), 1),
            (AlState::SafeOp, Some(2), 1),
            (AlState::SafeOp, Some(3), 2),
            (AlState::Op, Some(5), 2),
        ] {
            let found = EnumeratedDevice {
                position: 1,
                station: 0x1001,
                alias: 0,
                dl_status: 0,
                state,
                error: false,
                code: 0,
            };
            let signs: Vec<_> = left(&found, activation).collect();
            assert_eq!(signs.len(), expected, "{state} {activation:?}: {signs:?}");
            assert!(!signs.iter().any(MainDeviceEvidence::is_live));
        }
    }

    #[test]
    fn collect_evidence_reports_each_change_once() {
        let before = LivenessSample {
            control: 2,
            outputs: 0,
            difference: Some(1),
        };
        let now = LivenessSample {
            control: 4,
            outputs: 1,
            difference: Some(2),
        };
        let mut signs = Vec::new();
        for _ in 0..3 {
            collect_evidence(7, before, before, &mut signs);
            collect_evidence(7, before, now, &mut signs);
        }
        collect_evidence(8, before, now, &mut signs);
        assert_eq!(signs.len(), 6, "{signs:?}");
        assert!(signs.iter().all(MainDeviceEvidence::is_live));
    }
}
