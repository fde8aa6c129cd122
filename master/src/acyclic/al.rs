//! AL states, requested and awaited over raw datagrams, so that a refusal names its device.
//!
//! Registers: AL control 0x0120, AL status 0x0130, AL status code 0x0134 (ETG.1000.4, 6.1).

use std::convert::Infallible;
use std::time::Duration;

pub use crate::config::state_timeouts::BACK_TIMEOUT;
pub use crate::report::StateError;
pub use ecaxis_ecat::al_state::AlState;

use super::{DatagramClient, DeviceRef};
use crate::concurrent::try_join_all;
use crate::mailbox::{DatagramError, MailboxTransport};
use crate::report::{Cause, Error};
use ecaxis_ecat::al_state::ERROR;
use ecaxis_ecat::al_status_code;
use ecaxis_ecat::registers;

const ID_REQUEST: u8 = 0x20;
const DEVICE_EMULATION: u8 = 0x01;
const POLL: Duration = Duration::from_micros(500);
/// 200 ms for a device to process an acknowledgement.
const ACKNOWLEDGE_POLLS: u32 = 400;

/// The time in which a device answers the request of its identification if ESI or EEPROM say that it
/// has one.
pub const IDENTIFICATION_TIMEOUT: Duration = Duration::from_secs(1);
/// The time for every other device.
pub const SHORT_IDENTIFICATION_TIMEOUT: Duration = Duration::from_millis(10);

/// A device and the time-out of its state change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transition<'d> {
    pub device: &'d DeviceRef,
    pub timeout: Duration,
}

/// AL status code: invalid mailbox configuration for PreOp.
pub(crate) const INVALID_MAILBOX: u16 = 0x0016;

/// Returns AL status and AL status code; `None` if the device does not answer.
pub async fn read_status(
    wire: &impl MailboxTransport,
    station: u16,
) -> Result<Option<(u8, u16)>, DatagramError> {
    let mut status = [0; 6];
    if wire
        .read(station, registers::AL_STATUS, &mut status)
        .await?
        != 1
    {
        return Ok(None);
    }
    Ok(Some((
        status[0],
        u16::from_le_bytes([status[4], status[5]]),
    )))
}

/// True if AL status mirrors AL control, without a processor behind the controller (device
/// emulation, ETG.1000.4). The error bit is then the MainDevice's own acknowledgement and not a
/// refusal.
pub(crate) async fn emulated(wire: &impl MailboxTransport, station: u16) -> bool {
    let mut configuration = [0];
    let read = wire
        .read(station, registers::ESC_CONFIGURATION, &mut configuration)
        .await;
    read.is_ok_and(|count| count == 1) && configuration[0] & DEVICE_EMULATION != 0
}

/// Requests `wanted` from all devices and waits until the last one reaches it, all with the same
/// time-out. Pending errors of devices are acknowledged first.
pub async fn change_state(
    wire: &impl MailboxTransport,
    devices: &[DeviceRef],
    wanted: AlState,
    timeout: Duration,
) -> Result<(), Error> {
    let transitions = devices.iter().map(|device| Transition { device, timeout });
    change_states(wire, &transitions.collect::<Vec<_>>(), wanted).await
}

/// As [`change_state`], with a time-out for each device.
pub async fn change_states(
    wire: &impl MailboxTransport,
    transitions: &[Transition<'_>],
    wanted: AlState,
) -> Result<(), Error> {
    let requests = transitions.iter().map(|t| request(wire, t.device, wanted));
    try_join_all(requests).await?;
    wait_state(wire, transitions, wanted).await
}

/// `true` if the wire failed while a state changed.
pub(crate) fn is_wire(error: &Error) -> bool {
    matches!(*error.cause, Cause::State(StateError::Wire { .. }))
}

/// True for a refusal by a device that may need SYNC0 before the change (ETG.1020).
pub(crate) fn awaits_sync(error: &Error) -> bool {
    let Cause::State(error) = &*error.cause else {
        return false;
    };
    let code = error.code();
    al_status_code::SYNC_LOST.contains(&code) || code == al_status_code::DC_SYNC_IO_ERROR
}

/// Requests a lower state from all devices that are not in it, at the same time, even if some fail.
/// Returns the first error at the end; one of the wire comes first. A request that a device has
/// received at `since` is not repeated: its controller takes no other one before the device has read
/// it.
pub async fn lower_state(
    wire: &impl MailboxTransport,
    transitions: &[Transition<'_>],
    wanted: AlState,
    since: u64,
) -> Result<(), Error> {
    let changes = transitions.iter().map(async |transition| {
        let one = std::slice::from_ref(transition);
        let station = transition.device.station;
        let mut control = [0];
        let (received, status) = (
            wire.read(station, registers::AL_CONTROL, &mut control)
                .await,
            read_status(wire, station).await,
        );
        let is_requested = received == Ok(1) && control == [wanted.code()];
        let has_error = !matches!(status, Ok(Some((status, _))) if status & ERROR == 0);
        Ok::<_, Infallible>(match is_requested && !has_error {
            true => wait_state_since(wire, one, wanted, since).await,
            false => change_states(wire, one, wanted).await,
        })
    });
    let Ok(changes) = try_join_all(changes).await;
    let mut errors: Vec<Error> = changes.into_iter().filter_map(Result::err).collect();
    // `false` comes first.
    errors.sort_by_key(|error| !is_wire(error));
    errors.into_iter().next().map_or(Ok(()), Err)
}

/// Acknowledges an error that the device still has, then requests a state.
pub(crate) async fn request(
    wire: &impl MailboxTransport,
    device: &DeviceRef,
    wanted: AlState,
) -> Result<(), Error> {
    let failed = |source| StateError::Wire { wanted, source }.with_device(device);
    let gone = || StateError::Gone { wanted }.with_device(device);
    let status = read_status(wire, device.station).await.map_err(failed)?;
    let (status, _) = status.ok_or_else(gone)?;
    tracing::debug!(%device, "AL status 0x{status:02x}, requesting {wanted}");
    // A controller with device emulation copies AL control into AL status. It has no error that an
    // acknowledgement could end; the request itself clears the bit.
    if status & ERROR != 0 && !emulated(wire, device.station).await {
        write_control(wire, device.station, status & 0x0f | ERROR)
            .await
            .map_err(failed)?;
        // A request that arrives before the device has read the acknowledgement is lost.
        for _ in 0..ACKNOWLEDGE_POLLS {
            match read_status(wire, device.station).await.map_err(failed)? {
                Some((status, _)) if status & ERROR != 0 => wire.delay(POLL).await,
                _ => break,
            }
        }
    }
    match write_control(wire, device.station, wanted.code())
        .await
        .map_err(failed)?
    {
        1 => Ok(()),
        _ => Err(gone()),
    }
}

/// Waits until every device is in `wanted`. The time-outs begin together.
pub async fn wait_state(
    wire: &impl MailboxTransport,
    transitions: &[Transition<'_>],
    wanted: AlState,
) -> Result<(), Error> {
    wait_state_since(wire, transitions, wanted, wire.now()).await
}

/// As [`wait_state`], for states requested at `begin`.
pub(crate) async fn wait_state_since(
    wire: &impl MailboxTransport,
    transitions: &[Transition<'_>],
    wanted: AlState,
    begin: u64,
) -> Result<(), Error> {
    let each = transitions.iter().map(|t| wait_one(wire, t, wanted, begin));
    try_join_all(each).await.map(|_| ())
}

/// Waits until one device is in `wanted`.
async fn wait_one(
    wire: &impl MailboxTransport,
    &Transition { device, timeout }: &Transition<'_>,
    wanted: AlState,
    begin: u64,
) -> Result<(), Error> {
    let timeout_ns = u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX);
    let end = begin.saturating_add(timeout_ns);
    loop {
        let failed = |source| StateError::Wire { wanted, source }.with_device(device);
        let Some((status, code)) = read_status(wire, device.station).await.map_err(failed)? else {
            return Err(StateError::Gone { wanted }.with_device(device));
        };
        let actual = AlState::from_status(status);
        if status & ERROR != 0 {
            let refused = StateError::Refused {
                wanted,
                actual,
                code,
            };
            return Err(refused.with_device(device));
        }
        if actual == wanted {
            return Ok(());
        }
        if wire.now() >= end {
            let late = StateError::Timeout {
                wanted,
                actual,
                code,
                timeout,
            };
            return Err(late.with_device(device));
        }
        wire.delay(POLL).await;
    }
}

/// Acknowledges the errors of all devices with requests of Init, except for devices that emulate
/// their states. Devices that fail or do not answer are skipped: the caller notices them.
pub(crate) async fn acknowledge_errors_in_init(wire: &DatagramClient) {
    let Ok(count) = wire.count().await else {
        return;
    };
    let each = (0..count).map(async |position| {
        acknowledge_in_init(wire, position).await;
        Ok::<_, Infallible>(())
    });
    let Ok(_) = try_join_all(each).await;
}

/// Acknowledges the error of a device, if it has one, with a request of Init, and waits until the device has
/// ended the error.
async fn acknowledge_in_init(wire: &DatagramClient, position: u16) {
    let byte = async |register| {
        let mut byte = [0];
        let answer = wire.read_at(position, register, &mut byte).await;
        (answer == Ok(1)).then_some(byte[0])
    };
    let failed = async || {
        let status = byte(registers::AL_STATUS).await;
        status.is_some_and(AlState::has_error)
    };
    if !failed().await {
        return;
    }
    let configuration = byte(registers::ESC_CONFIGURATION).await;
    if configuration.is_none_or(|bits| bits & DEVICE_EMULATION != 0) {
        return;
    }
    let acknowledge = [AlState::Init.code() | ERROR, 0];
    let _ = wire
        .write_at(position, registers::AL_CONTROL, &acknowledge)
        .await;
    // A request that arrives before the device has read the acknowledgement is lost.
    for _ in 0..ACKNOWLEDGE_POLLS {
        if !failed().await {
            return;
        }
        wire.delay(POLL).await;
    }
}

async fn write_control(
    wire: &impl MailboxTransport,
    station: u16,
    value: u8,
) -> Result<u16, DatagramError> {
    wire.write(station, registers::AL_CONTROL, &[value, 0])
        .await
}

/// Reads the explicit device identification (ETG.1020, "Explicit Device Identification"). It is
/// requested in AL control and answered in AL status code. Returns `None` if the device does not
/// answer in time or emulates its states: such a controller would answer with its own request.
pub async fn read_explicit_id(
    wire: &impl MailboxTransport,
    station: u16,
    timeout: Duration,
) -> Result<Option<u16>, DatagramError> {
    let Some((state, _)) = read_status(wire, station).await? else {
        return Ok(None);
    };
    if emulated(wire, station).await {
        return Ok(None);
    }
    let whole = async {
        write_control(wire, station, state & 0x0f | ID_REQUEST).await?;
        let end = wire
            .now()
            .saturating_add(u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX));
        let id = loop {
            match read_status(wire, station).await? {
                Some((status, code)) if status & ID_REQUEST != 0 => break Some(code),
                _ if wire.now() >= end => break None,
                _ => wire.delay(POLL).await,
            }
        };
        write_control(wire, station, state & 0x0f).await?;
        Ok(id)
    };
    // Shielded, because the request must be withdrawn.
    wire.stop().shield(whole).await
}

/// Returns the index of the first of these devices with this explicit device identification. Each
/// station has its own time-out.
pub async fn find_explicit_id(
    wire: &impl MailboxTransport,
    stations: impl Iterator<Item = (u16, Duration)>,
    id: u16,
) -> Option<usize> {
    for (index, (station, timeout)) in stations.enumerate() {
        if read_explicit_id(wire, station, timeout).await == Ok(Some(id)) {
            return Some(index);
        }
    }
    None
}
