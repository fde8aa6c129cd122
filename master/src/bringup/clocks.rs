//! SYNC0 on every device whose ESI OpMode uses it.
//!
//! ethercrab has measured the propagation delays, set offsets and run the static drift
//! compensation. It would start SYNC0 at a whole multiple of the cycle regardless of the ESI.
//! Therefore start, shift, cycle and AssignActivate are written here (ETG.1000.4, 6.4.2; ETG.2000,
//! Dc).

use super::device::{read, write};
use super::{BusDevice, Step};
use crate::acyclic::DeviceRef;
use crate::clock::Nanos;
use crate::config::Machine;
use crate::datagram::DatagramClient;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};
use crate::rt::phase::ClockPlan;
use ecaxis_ecat::registers;

const STEP: &str = "starting SYNC0";

/// The first pulse must still be in the future when the last device receives its start time.
const START_DELAY: Nanos = 100_000_000;
const START_DELAY_PER_DEVICE: Nanos = 5_000_000;
/// The minimum of that delay left after the last device was configured.
const START_MARGIN: Nanos = 10_000_000;
/// Lost datagrams can use up the delay; then the start is repeated with a longer one.
const MAX_ATTEMPTS: u32 = 3;

/// Returns `None` if no device uses distributed clocks.
pub(super) async fn configure(
    wire: &impl MailboxTransport,
    machine: &Machine,
    devices: &[BusDevice],
    progress: &mut dyn FnMut(Step),
) -> Result<Option<ClockPlan>, Error> {
    let wanting: Vec<_> = machine
        .devices
        .iter()
        .zip(devices)
        .filter_map(|(config, device)| Some((config.selection.dc.as_ref()?, device)))
        .collect();
    if let Some((_, device)) = wanting.iter().find(|(_, device)| !device.dc) {
        return Err(Cause::NoClock.with_device(&device.at));
    }
    let reference = devices
        .iter()
        .filter(|d| d.dc)
        .min_by_key(|d| d.at.position);
    let (false, Some(reference)) = (wanting.is_empty(), reference) else {
        return Ok(None);
    };

    let cycle = machine.bus.cycle_ns;
    let mut ahead = START_DELAY
        + START_DELAY_PER_DEVICE * u64::try_from(wanting.len()).unwrap_or(u64::MAX / 1_000_000_000);
    for _ in 0..MAX_ATTEMPTS {
        let now = system_time(wire, reference).await?;
        let start = (now.wrapping_add(ahead) / cycle + 1).wrapping_mul(cycle);
        for (dc, device) in &wanting {
            let first = start.wrapping_add_signed(i64::from(dc.sync0_shift_ns));
            for (register, data) in [
                (registers::DC_CYCLIC_CONTROL, &[0, 0][..]),
                (registers::DC_START_TIME, &first.to_le_bytes()),
                (registers::DC_SYNC0_CYCLE, &dc.sync0_cycle_ns.to_le_bytes()),
                (registers::DC_SYNC1_CYCLE, &dc.sync1_delay_ns.to_le_bytes()),
                (
                    registers::DC_CYCLIC_CONTROL,
                    &dc.assign_activate.to_le_bytes(),
                ),
            ] {
                write(wire, &device.at, STEP, register, data).await?;
            }
        }
        // A device with a start time in the past never generates a pulse.
        let shifts = || wanting.iter().map(|(dc, _)| i64::from(dc.sync0_shift_ns));
        let first = start.wrapping_add_signed(shifts().min().unwrap_or(0));
        let reported = system_time(wire, reference).await?;
        tracing::debug!(start, reported, "SYNC0 started");
        if reported.wrapping_add(START_MARGIN) < first {
            progress(Step::Clocks {
                reference: reference.at.name.clone(),
                devices: wanting.len(),
            });
            return Ok(Some(ClockPlan {
                reference: reference.at.station,
                cycle_ns: cycle,
                release: start.wrapping_add(between_pulses(cycle, shifts())),
            }));
        }
        ahead *= 2;
    }
    Err(Cause::NoStart.with_device(&reference.at))
}

/// Stops SYNC0 and SYNC1 of devices that are back in PreOp or Init. Active pulses would indicate a
/// running MainDevice.
pub(crate) async fn stop(wire: &impl MailboxTransport, stations: impl Iterator<Item = u16>) {
    for station in stations {
        // On an error, the segment still goes to Init.
        if let Err(error) = wire
            .write(station, registers::DC_CYCLIC_CONTROL, &[0, 0])
            .await
        {
            tracing::debug!("SYNC0 goes on: {error}");
            break;
        }
    }
}

/// Sets the clocks again, with the first device that has a system time as reference. ethercrab uses
/// the first device with receive times. If that device has no system time, ethercrab has given all
/// other devices a time of zero.
pub(super) async fn set_again(wire: &DatagramClient, devices: &[BusDevice]) -> Result<(), Error> {
    const STEP: &str = "setting the clocks";
    /// The value after reset; writing it restarts the control loop at the frequency of the
    /// oscillator.
    const DEFAULT_SPEED_START: u16 = 0x1000;
    /// The number that ethercrab sends.
    const STATIC_SYNC_CYCLES: u32 = 1_000;

    let clocks = || devices.iter().filter(|device| device.dc);
    let Some(reference) = clocks().min_by_key(|device| device.at.position) else {
        return Ok(());
    };
    let delay = |device: &BusDevice| {
        let behind = device.propagation_delay;
        behind.saturating_sub(reference.propagation_delay)
    };
    for device in clocks() {
        let start = DEFAULT_SPEED_START.to_le_bytes();
        let delay = delay(device).to_le_bytes();
        let at = &device.at;
        write(wire, at, STEP, registers::DC_SPEED_COUNTER_START, &start).await?;
        write(wire, at, STEP, registers::DC_SYSTEM_TIME_DELAY, &delay).await?;
    }
    let failed = |error| {
        Cause::Datagram(error)
            .with_device(&reference.at)
            .with_action(STEP)
    };
    wire.write_all(registers::DC_RECEIVE_TIME, &[0; 4])
        .await
        .map_err(failed)?;
    let offset = read(wire, &reference.at, STEP, registers::DC_SYSTEM_TIME_OFFSET).await?;
    let local = read(wire, &reference.at, STEP, registers::DC_RECEIVE_TIME_UNIT).await?;
    // The system time at which the frame was at the reference clock.
    let then = u64::from_le_bytes(local).wrapping_add(u64::from_le_bytes(offset));
    for device in clocks().filter(|device| device.at != reference.at) {
        let local = read(wire, &device.at, STEP, registers::DC_RECEIVE_TIME_UNIT).await?;
        let there = then.wrapping_add(u64::from(delay(device)));
        let offset = there.wrapping_sub(u64::from_le_bytes(local)).to_le_bytes();
        write(
            wire,
            &device.at,
            STEP,
            registers::DC_SYSTEM_TIME_OFFSET,
            &offset,
        )
        .await?;
    }
    for _ in 0..STATIC_SYNC_CYCLES {
        wire.distribute_time(reference.at.station)
            .await
            .map_err(failed)?;
    }
    Ok(())
}

/// True if the device has a system time. Some devices only latch receive times for the delay
/// measurement. Their 0x0008 reads the same, but 0x0910 does not answer (Beckhoff ESC data sheet,
/// section I, 9.1).
pub(super) async fn has_system_time(
    wire: &impl MailboxTransport,
    at: &DeviceRef,
) -> Result<bool, Error> {
    let counter = wire
        .read(at.station, registers::DC_SYSTEM_TIME, &mut [0; 8])
        .await;
    let counter =
        counter.map_err(|error| Cause::Datagram(error).with_device(at).with_action(STEP))?;
    Ok(counter > 0)
}

async fn system_time(wire: &impl MailboxTransport, reference: &BusDevice) -> Result<u64, Error> {
    let time = read(wire, &reference.at, STEP, registers::DC_SYSTEM_TIME).await?;
    Ok(u64::from_le_bytes(time))
}

/// Returns the middle of the longest pause between the SYNC0 pulses of a cycle, in ns after the
/// pulse without shift. A frame there has the largest distance from every pulse.
fn between_pulses(cycle: u64, shifts: impl Iterator<Item = i64>) -> u64 {
    let period = i64::try_from(cycle).unwrap_or(i64::MAX).max(1);
    let mut pulses: Vec<i64> = shifts.map(|shift| shift.rem_euclid(period)).collect();
    pulses.sort_unstable();
    let following = pulses.iter().skip(1).copied();
    let wrapped = pulses.first().map(|first| first + period);
    let (gap, start) = pulses
        .iter()
        .zip(following.chain(wrapped))
        .map(|(&pulse, next)| (next - pulse, pulse))
        .max_by_key(|&(gap, start)| (gap, -start))
        .unwrap_or((period, 0));
    (start + gap / 2).rem_euclid(period).unsigned_abs()
}

#[cfg(test)]
mod tests {
    use super::between_pulses;

    #[test]
    fn between_pulses_returns_the_longest_pause() {
        for (shifts, expected) in [
            (&[0][..], 500_000),
            (&[500_000], 0),
            (&[-250_000], 250_000),
            (&[0, 0, 200_000], 600_000),
            (&[0, 500_000], 250_000),
            (&[], 500_000),
        ] {
            assert_eq!(
                between_pulses(1_000_000, shifts.iter().copied()),
                expected,
                "{shifts:?}"
            );
        }
    }
}
