//! The ring in the bring-up: which interface leads to the first device, and the propagation delays.

use std::time::Duration;

use ecaxis_ecat::registers;

use super::{BusDevice, Step, name_at};
use crate::acyclic::{delays, enumerate, topology};
use crate::clock::Nanos;
use crate::config::Machine;
use crate::datagram::DatagramClient;
use crate::link::redundant::RingState;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};

/// The propagation delays in ns by station address, in the order of the segment; `None` without a
/// clock.
pub type RingDelays = Vec<(u16, Option<u32>)>;

/// The propagation delays of a ring.
#[derive(Debug, Clone)]
pub(crate) struct RingMeasurement {
    pub state: RingState,
    /// In the ring as it was.
    pub now: RingDelays,
    /// In the closed ring.
    pub closed: RingDelays,
}

/// Returns true if the cables of a broken ring are exchanged at the computer. The first device of
/// the line of the first interface has its port 0 open. That of the second one has lost the link of
/// its port 0. In a closed ring the frames show it (`link::redundant`).
pub(super) async fn enters_at_last_port(wire: &DatagramClient) -> Result<bool, Error> {
    const STEP: &str = "looking at the ends of the ring";
    let Some(RingState::Broken { behind, .. }) = wire.ring() else {
        return Ok(false);
    };
    let status = enumerate::at(wire, 0, STEP, registers::DL_STATUS).await?;
    let [open, ..] = topology::open_ports(u16::from_le_bytes(status));
    Ok(open != (behind > 0))
}

/// Reports the ring, and measures the delays of its devices, which ethercrab has taken for a line. A
/// cable that breaks meanwhile cuts devices off behind the port that the measurement has closed, for
/// at most a second. The measurement is then repeated.
pub(super) async fn measure(
    wire: &DatagramClient,
    machine: &Machine,
    state: RingState,
    devices: &mut [BusDevice],
    progress: &dyn Fn(Step),
) -> Result<RingMeasurement, Error> {
    const TIMEOUT: Nanos = 3_000_000_000;
    const PAUSE: Duration = Duration::from_millis(20);
    progress(ring_step(machine, state));
    if wire.swapped() {
        let text = "the cables of `nic` and `redundant` are exchanged: `redundant` leads to the first device";
        progress(Step::Warning(text.to_owned()));
    }
    let present = devices.iter().filter(|device| device.present).count();
    let end = wire.now().saturating_add(TIMEOUT);
    let measured = loop {
        let measured = measure_once(wire).await;
        let late = wire.now() >= end;
        match measured {
            Ok(Some(measured)) if measured.now.len() >= present || late => break measured,
            Ok(None) if late => {
                let text = "cables of the ring lose and find their link all the time";
                return Err(Error::from(Cause::Scan(text.to_owned())).with_action(delays::STEP));
            }
            Err(error) if late => return Err(error),
            _ => wire.delay(PAUSE).await,
        }
    };
    for device in devices {
        let of_device = measured
            .now
            .iter()
            .find(|(station, _)| *station == device.at.station);
        if let Some((_, delay)) = of_device {
            device.propagation_delay = delay.unwrap_or(0);
        }
    }
    if measured.state != state {
        progress(ring_step(machine, measured.state));
    }
    Ok(measured)
}

/// Measures the delays of a ring. A closed ring is open meanwhile. Returns `None` if it has changed.
///
/// # Errors
/// A device that does not answer.
pub(crate) async fn measure_once(wire: &DatagramClient) -> Result<Option<RingMeasurement>, Error> {
    let (Some(state), Some(status)) = (wire.ring(), wire.ring_status()) else {
        return Ok(None);
    };
    let _open = status.open_for_measurement();
    let before = delays::devices(wire).await?;
    let measured = delays::measure(wire, &before.1).await?;
    let unchanged = delays::devices(wire).await? == before;
    let Some(after) = wire.ring().filter(|after| after.split() == state.split()) else {
        return Ok(None);
    };
    if !unchanged {
        return Ok(None);
    }
    let closed = match after.split() {
        Some(first) => delays::joined(&measured, usize::from(first)),
        None => measured.clone(),
    };
    let of_stations = |delays: Vec<_>| before.0.iter().copied().zip(delays).collect();
    Ok(Some(RingMeasurement {
        state: after,
        now: of_stations(measured),
        closed: of_stations(closed),
    }))
}

/// Returns the report on the ring at the start.
fn ring_step(machine: &Machine, ring: RingState) -> Step {
    // Which device of a branch the cable belongs to is not known in a broken ring.
    let in_front = |position: u16| position.checked_sub(1);
    let name = |position| name_at(machine, position);
    let text = ring.text(machine.devices.len(), name, in_front);
    match ring {
        RingState::Closed => Step::Ring(text),
        RingState::Broken { .. } | RingState::Silent | RingState::OneDirection => {
            Step::Warning(text)
        }
    }
}
