//! The way of one device back to SafeOp while the others stay in Op.
//!
//! The steps are those of the bring-up. Nothing here writes to another device, except the latch of
//! the receive times. The caller measures the delays first, which may change those of others.

use std::time::Duration;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_ecat::registers;
use ecaxis_esi::select::DcSettings;
use tokio::sync::Mutex;

use super::clocks::{self, START_DELAY};
use super::device::{self, StartupPhase, read, write};
use super::{BusDevice, Step, StepTimes, configure, mailbox, modules};
use crate::acyclic::{AlState, DeviceRef, al};
use crate::config::Machine;
use crate::datagram::DatagramClient;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};
use crate::rt::exchange::sign_magnitude;
use crate::rt::image::ImagePlan;
use crate::rt::phase::extend;

const STEP: &str = "bringing it back";
/// The first pulse must be as far ahead, in ns, once its start time is written.
const START_MARGIN: u64 = 1_000_000;

/// A device whose SYNC0 runs, and its settings.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RunningSync<'a> {
    pub at: &'a DeviceRef,
    pub dc: &'a DcSettings,
}

/// What the device joins.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RunningBus<'a> {
    pub wire: &'a DatagramClient,
    pub machine: &'a Machine,
    pub image: &'a ImagePlan,
    /// The reference clock; `None` without distributed clocks, and if this device is the reference.
    pub reference: Option<&'a DeviceRef>,
    /// A device in Op with SYNC0.
    pub sync: Option<RunningSync<'a>>,
    /// Held while the receive times of all devices belong to one frame.
    pub latch: &'a Mutex<()>,
}

/// Takes a device from any state to SafeOp. It has its station address, its delay (0x0928) is
/// written, and `device.coe` is a client for a mailbox that has restarted.
///
/// # Errors
/// As the bring-up.
pub(crate) async fn bring_back(
    bus: RunningBus<'_>,
    index: DeviceIndex,
    device: &mut BusDevice,
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let RunningBus {
        wire,
        machine,
        image,
        ..
    } = bus;
    let config = &machine.devices[index];
    let init = device.transition(AlState::Init, true);
    al::change_states(wire, &[init], AlState::Init).await?;
    reset(wire, &device.at).await?;
    let before = device.client().map(|client| *client.layout());
    mailbox::restore(wire, config, &device.at, before.as_ref()).await?;
    if let (true, Some(reference)) = (device.dc, bus.reference) {
        let _held = bus.latch.lock().await;
        join_clock(wire, &device.at, reference).await?;
    }
    let region = image.regions.get(index).copied().flatten();
    let status = image.mailboxes.as_ref().and_then(|m| m.logical_of(index));
    let times = StepTimes::default();
    let subject = (index, config, &mut *device);
    configure(wire, machine, subject, (region, status), progress, &times).await?;
    if let (false, Some((index, sub, _))) = (device.present, device.held.first()) {
        let (index, sub) = (*index, *sub);
        return Err(Cause::HeldOutput { index, sub }.with_device(&device.at));
    }
    for (axis, adopted) in &device.adopted {
        let mut other = Machine::clone(machine);
        other.adopt(*axis, adopted);
        if other.axes[*axis].config != machine.axes[*axis].config {
            return Err(Cause::OtherUnits.with_device(&device.at));
        }
    }
    if let Some(dc) = &config.selection.dc {
        let running = bus.sync;
        let running = running.ok_or_else(|| Cause::NoStart.with_device(&device.at))?;
        join_pulses(bus, &device.at, dc, running).await?;
    }
    let pulses = async || wire.delay(Duration::from_nanos(2 * START_DELAY)).await;
    modules::enter_safe_op(wire, config, device, pulses, progress).await?;
    device::start_up(wire, config, device, StartupPhase::InSafeOp, progress).await?;
    if config.selection.activates_sync() && bus.reference.is_some() {
        await_settled(wire, machine, &device.at).await?;
    }
    Ok(())
}

/// Sets the clock of the device. Its delay has been written.
async fn join_clock(
    wire: &DatagramClient,
    at: &DeviceRef,
    reference: &DeviceRef,
) -> Result<(), Error> {
    let delay = read(wire, at, STEP, registers::DC_SYSTEM_TIME_DELAY).await?;
    clocks::restart_control(wire, at).await?;
    let then = clocks::latch(wire, reference).await?;
    clocks::set_offset(wire, at, then, u32::from_le_bytes(delay)).await
}

/// Clears what a device that kept its power still has: FMMUs, SyncManagers and pulses.
pub(crate) async fn reset(wire: &DatagramClient, at: &DeviceRef) -> Result<(), Error> {
    const FMMU_LEN: usize = 16;
    let [fmmus, managers] = read(wire, at, STEP, registers::FMMU_COUNT).await?;
    let fmmus = vec![0; FMMU_LEN * usize::from(fmmus.min(16))];
    let managers =
        vec![0; usize::from(registers::SYNC_MANAGER_LEN) * usize::from(managers.min(16))];
    write(wire, at, STEP, registers::FMMU, &fmmus).await?;
    write(wire, at, STEP, registers::SYNC_MANAGER, &managers).await?;
    // A device without clocks does not answer.
    let off = wire.write(at.station, registers::DC_CYCLIC_CONTROL, &[0, 0]);
    let failed = |error| Cause::Datagram(error).with_device(at).with_action(STEP);
    off.await.map_err(failed).map(drop)
}

/// Starts the pulses of a device on the grid of the others: the first pulse is a whole number of
/// periods after the next one of a device that runs (0x0990, ESC data sheet, section II).
async fn join_pulses(
    bus: RunningBus<'_>,
    at: &DeviceRef,
    dc: &DcSettings,
    running: RunningSync<'_>,
) -> Result<(), Error> {
    let (wire, cycle) = (bus.wire, bus.machine.bus.cycle_ns);
    let own_cycle = u64::from(dc.sync0_cycle_ns);
    let common = clocks::greatest_common_divisor(own_cycle, cycle).max(1);
    let period = (own_cycle / common).max(1).saturating_mul(cycle);
    let mut ahead = START_DELAY;
    for _ in 0..clocks::MAX_ATTEMPTS {
        let now = clocks::system_time(wire, at).await?;
        let next = read(wire, running.at, STEP, registers::DC_START_TIME).await?;
        let shift = i64::from(dc.sync0_shift_ns) - i64::from(running.dc.sync0_shift_ns);
        let grid = extend(u64::from_le_bytes(next).wrapping_add_signed(shift), now);
        let first = next_on_grid(grid, period, now.wrapping_add(ahead));
        clocks::start_pulses(wire, at, dc, first).await?;
        let reported = clocks::system_time(wire, at).await?;
        if extend(first, reported) > reported.wrapping_add(START_MARGIN) {
            return Ok(());
        }
        ahead *= 2;
    }
    Err(Cause::NoStart.with_device(at))
}

/// Returns the first time of a grid at or after `from`.
fn next_on_grid(grid: u64, period: u64, from: u64) -> u64 {
    let since = from.wrapping_sub(grid).cast_signed();
    let period = i64::try_from(period).unwrap_or(i64::MAX).max(1);
    let late = since.rem_euclid(period);
    let wait = if late == 0 { 0 } else { period - late };
    from.wrapping_add_signed(wait)
}

/// Waits until the clock of the device follows the reference clock.
async fn await_settled(
    wire: &DatagramClient,
    machine: &Machine,
    at: &DeviceRef,
) -> Result<(), Error> {
    const POLL: Duration = Duration::from_millis(2);
    let end = wire.now().saturating_add(machine.bus.sync_timeout_ns);
    loop {
        let raw = read(wire, at, STEP, registers::DC_SYSTEM_TIME_DIFFERENCE).await?;
        let difference_ns = sign_magnitude(u32::from_le_bytes(raw));
        if u64::from(difference_ns.unsigned_abs()) <= machine.bus.sync_window_ns {
            return Ok(());
        }
        if wire.now() >= end {
            return Err(Cause::ClockNotSettled { difference_ns }.with_device(at));
        }
        wire.delay(POLL).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn next_on_grid_is_a_whole_number_of_periods_away() {
        for (grid, period, from, next) in [
            (1_000, 250, 1_000, 1_000),
            (1_000, 250, 1_001, 1_250),
            (1_000, 250, 999, 1_000),
            (5_000, 250, 1_001, 1_250),
            (100, 250, 1_001, 1_100),
            (u64::MAX - 99, 250, 1_001, 1_150),
            (1_000, 0, 1_234, 1_234),
        ] {
            assert_eq!(
                next_on_grid(grid, period, from),
                next,
                "{grid} {period} {from}"
            );
        }
    }
}
