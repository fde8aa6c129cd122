//! The clocks, and SYNC0 on every device whose ESI OpMode uses it.
//!
//! ethercrab has measured the propagation delays. It would start SYNC0 at a whole multiple of the
//! cycle regardless of the ESI. Therefore offsets, start, shift, cycle and AssignActivate are
//! written here (ETG.1000.4, 6.4.2; ETG.2000, Dc).

use std::cell::Cell;
use std::future::Future;
use std::time::Duration;

use super::common_time::{common_offset, next_multiple};
use super::device::{read, write};
use super::process_data::RegisterBlock;
use super::{BusDevice, Step};
use crate::acyclic::DeviceRef;
use crate::clock::{self, Nanos};
use crate::concurrent::try_join_all;
use crate::config::{CommonTimeUse, Machine};
use crate::datagram::DatagramClient;
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};
use crate::rt::image::ImagePlan;
use crate::rt::phase::{ClockPlan, extend};
use ecaxis_ecat::registers;
use ecaxis_esi::select::DcSettings;

pub(super) const STEP: &str = "starting SYNC0";

/// The pause between two distributions of the time before the cycle.
const DISTRIBUTION_PERIOD: Duration = Duration::from_micros(100);
/// The time in ns that bring-up spends on settling alone.
const SETTLING_TIMEOUT: Nanos = 100_000_000;

/// The first pulse must still be in the future when the last device receives its start time.
pub(super) const START_DELAY: Nanos = 20_000_000;
const START_DELAY_PER_DEVICE: Nanos = 500_000;
/// A clock of 32 bits takes a time that is half a wrap ahead, 2.1 s, for the past.
const MAX_START_DELAY: Nanos = 2_000_000_000;
/// The minimum of that delay left after the last device was configured.
const START_MARGIN: Nanos = 10_000_000;
/// SYNC0 cycles without relation to the bus cycle have no finer pattern than this.
const SHORTEST_PATTERN: i64 = 1_000;
/// A margin between frames and SYNC0 below this, or below this part of the cycle, is a warning.
const SHORT_MARGIN: u64 = 10_000;
const SHORT_MARGIN_DIVISOR: u64 = 20;
/// How often a device that does not count the distributed time is asked again.
const FOLLOWER_ATTEMPTS: u32 = 3;
/// Lost datagrams can use up the delay; then the start is repeated with a longer one.
pub(super) const MAX_ATTEMPTS: u32 = 4;

/// Returns `None` if no device uses distributed clocks.
pub(super) async fn configure(
    wire: &DatagramClient,
    machine: &Machine,
    devices: &mut [BusDevice],
    image: &ImagePlan,
    progress: &dyn Fn(Step),
) -> Result<Option<ClockPlan>, Error> {
    let reference = reference(devices);
    let used = machine.devices.iter().any(|d| d.selection.dc.is_some());
    if let Some(reference) = reference.as_ref().filter(|_| used) {
        find_followers(wire, devices, reference).await?;
    }
    let wanting: Vec<_> = machine
        .devices
        .iter()
        .zip(&*devices)
        .filter(|(_, device)| device.present)
        .filter_map(|(config, device)| Some((config.selection.dc.as_ref()?, device)))
        .collect();
    if let Some((_, device)) = wanting.iter().find(|(_, device)| !device.dc) {
        return Err(Cause::NoClock.with_device(&device.at));
    }
    let (false, Some(reference)) = (wanting.is_empty(), reference) else {
        return Ok(None);
    };
    if let Some((_, device)) = wanting.iter().find(|(_, device)| !device.follows) {
        return Err(Cause::ClockDoesNotFollow.with_device(&device.at));
    }

    let cycle = machine.bus.cycle_ns;
    let mut ahead = START_DELAY
        + START_DELAY_PER_DEVICE * u64::try_from(wanting.len()).unwrap_or(u64::MAX / 1_000_000_000);
    let shifts = wanting.iter().map(|(dc, _)| i64::from(dc.sync0_shift_ns));
    let (earliest, latest) = (shifts.clone().min().unwrap_or(0), shifts.max().unwrap_or(0));
    let longest_shift = latest.max(0).unsigned_abs();
    let align = machine.bus.common_time == CommonTimeUse::Align;
    for _ in 0..MAX_ATTEMPTS {
        let common = match align {
            true => common_offset(wire, &reference).await?,
            false => None,
        };
        let now = system_time(wire, &reference).await?;
        let release_at = clock::now();
        ahead = ahead.min(MAX_START_DELAY.saturating_sub(longest_shift));
        let start = now.wrapping_add(ahead);
        let start = common.map_or(start, |offset| next_multiple(start, offset, cycle));
        let until = start.wrapping_sub(now);
        let starts = wanting.iter().map(async |(dc, device)| {
            let own = system_time(wire, &device.at).await?;
            let first = extend(start.wrapping_add_signed(i64::from(dc.sync0_shift_ns)), own);
            start_pulses(wire, &device.at, dc, first).await
        });
        try_join_all(starts).await?;
        // A device with a start time in the past never generates a pulse.
        let first = start.wrapping_add_signed(earliest);
        let reported = system_time(wire, &reference).await?;
        tracing::debug!(start, reported, "SYNC0 started");
        if extend(first, reported) > reported.wrapping_add(START_MARGIN) {
            progress(Step::Clocks {
                reference: reference.name.clone(),
                devices: wanting.len(),
            });
            let behind = |device: &BusDevice| i64::from(device.propagation_delay);
            let first_delay = devices.iter().find(|device| device.at == reference);
            let first_delay = first_delay.map_or(0, behind);
            let pulses = wanting.iter().map(|(dc, device)| Pulses {
                shift: i64::from(dc.sync0_shift_ns),
                cycle: u64::from(dc.sync0_cycle_ns),
                delay: behind(device) - first_delay,
            });
            let release = release_time(cycle, image.wire_ns(), pulses);
            let nearest = release.nearest.map(|device| &wanting[device].1.at);
            if let Some(text) = short_margin(cycle, image.wire_ns(), release.margin, nearest) {
                progress(Step::Warning(text));
            }
            return Ok(Some(ClockPlan {
                reference: reference.station,
                cycle_ns: cycle,
                release: start.wrapping_add(release.after) as u32,
                release_at: release_at + until + release.after,
                window_ns: machine.bus.clock_window_ns,
                sync0: start,
                align,
            }));
        }
        ahead *= 2;
    }
    Err(Cause::NoStart.with_device(&reference))
}

/// Starts SYNC0 and SYNC1 of a device at a system time.
pub(super) async fn start_pulses(
    wire: &DatagramClient,
    at: &DeviceRef,
    dc: &DcSettings,
    first: u64,
) -> Result<(), Error> {
    for block in pulse_registers(dc, first) {
        write(wire, at, STEP, block.register, &block.data).await?;
    }
    Ok(())
}

/// Returns the registers that start SYNC0 and SYNC1 at a system time, in order.
#[must_use]
pub fn pulse_registers(dc: &DcSettings, first: u64) -> [RegisterBlock; 5] {
    [
        (registers::DC_CYCLIC_CONTROL, &[0, 0][..]),
        (registers::DC_START_TIME, &first.to_le_bytes()),
        (registers::DC_SYNC0_CYCLE, &dc.sync0_cycle_ns.to_le_bytes()),
        (registers::DC_SYNC1_CYCLE, &dc.sync1_delay_ns.to_le_bytes()),
        (
            registers::DC_CYCLIC_CONTROL,
            &dc.assign_activate.to_le_bytes(),
        ),
    ]
    .map(|(register, data)| RegisterBlock {
        register,
        data: data.to_vec(),
        op_only: None,
    })
}

/// Waits until all devices have seen pulses of SYNC0.
pub(super) async fn await_pulses(wire: &DatagramClient, plan: &ClockPlan) {
    const PULSES: u64 = 5;
    let begun = plan.release_at.saturating_add(PULSES * plan.cycle_ns);
    let wait = begun.saturating_sub(wire.now());
    wire.delay(Duration::from_nanos(wait)).await;
}

/// Sets the clocks, with the first device that has a system time as reference. ethercrab uses the
/// first device with receive times, even if it has no system time. Its offsets are old by the time
/// of the changes to PreOp, in which the clocks drift apart.
pub(super) async fn set_offsets(wire: &DatagramClient, devices: &[BusDevice]) -> Result<(), Error> {
    let clocks = || devices.iter().filter(|device| device.dc);
    let Some(reference) = clocks().min_by_key(|device| device.at.position) else {
        return Ok(());
    };
    let delay = |device: &BusDevice| {
        let behind = device.propagation_delay;
        behind.saturating_sub(reference.propagation_delay)
    };
    let restarts = clocks().map(async |device| {
        let delay = delay(device).to_le_bytes();
        let at = &device.at;
        restart_control(wire, at).await?;
        write(wire, at, STEP, registers::DC_SYSTEM_TIME_DELAY, &delay).await
    });
    try_join_all(restarts).await?;
    let then = latch(wire, &reference.at).await?;
    let others = clocks().filter(|device| device.at != reference.at);
    let offsets = others.map(|device| set_offset(wire, &device.at, then, delay(device)));
    try_join_all(offsets).await.map(|_| ())
}

/// Restarts the control loop of a clock at the frequency of its oscillator.
pub(super) async fn restart_control(wire: &DatagramClient, at: &DeviceRef) -> Result<(), Error> {
    /// The value after reset.
    const DEFAULT_SPEED_START: u16 = 0x1000;
    let start = DEFAULT_SPEED_START.to_le_bytes();
    write(wire, at, STEP, registers::DC_SPEED_COUNTER_START, &start).await
}

/// Latches the receive times. Returns the system time at which the frame was at the reference clock.
pub(super) async fn latch(wire: &DatagramClient, reference: &DeviceRef) -> Result<u64, Error> {
    let latched = wire.write_all(registers::DC_RECEIVE_TIME, &[0; 4]).await;
    latched.map_err(|error| {
        Cause::Datagram(error)
            .with_device(reference)
            .with_action(STEP)
    })?;
    let offset = read(wire, reference, STEP, registers::DC_SYSTEM_TIME_OFFSET).await?;
    let local = read(wire, reference, STEP, registers::DC_RECEIVE_TIME_UNIT).await?;
    Ok(u64::from_le_bytes(local).wrapping_add(u64::from_le_bytes(offset)))
}

/// Sets the clock of a device whose receive times were latched at `then`.
pub(super) async fn set_offset(
    wire: &DatagramClient,
    at: &DeviceRef,
    then: u64,
    delay: u32,
) -> Result<(), Error> {
    let local = read(wire, at, STEP, registers::DC_RECEIVE_TIME_UNIT).await?;
    let there = then.wrapping_add(u64::from(delay));
    let offset = there.wrapping_sub(u64::from_le_bytes(local)).to_le_bytes();
    write(wire, at, STEP, registers::DC_SYSTEM_TIME_OFFSET, &offset).await
}

/// Returns the reference clock: the first device with a system time.
pub(super) fn reference(devices: &[BusDevice]) -> Option<DeviceRef> {
    let clocks = devices.iter().filter(|device| device.dc);
    let first = clocks.min_by_key(|device| device.at.position);
    first.map(|device| device.at.clone())
}

/// Distributes the time of the reference clock while `work` runs, so that the clocks compensate
/// their drift meanwhile.
pub(super) async fn distribute_during<T>(
    wire: &DatagramClient,
    reference: Option<&DeviceRef>,
    work: impl Future<Output = T>,
) -> T {
    let Some(reference) = reference else {
        return work.await;
    };
    let over = Cell::new(false);
    let work = async {
        let done = work.await;
        over.set(true);
        done
    };
    let distribution = async {
        while !over.get() {
            // A device that no longer answers fails in `work`.
            let _ = wire.distribute_time(reference.station).await;
            wire.delay(DISTRIBUTION_PERIOD).await;
        }
    };
    tokio::join!(work, distribution).0
}

/// Distributes the time until all clocks with SYNC signals have settled, within [`SETTLING_TIMEOUT`].
/// Returns false if one has not: then the cycle continues, and Op waits for it.
pub(super) async fn settle(
    wire: &DatagramClient,
    machine: &Machine,
    devices: &[BusDevice],
) -> Result<bool, Error> {
    let Some(reference) = reference(devices) else {
        return Ok(true);
    };
    let window = machine.bus.sync_window_ns;
    let others: Vec<_> = machine
        .devices
        .iter()
        .zip(devices)
        .filter(|(config, _)| config.selection.activates_sync())
        .map(|(_, device)| device)
        .filter(|device| device.dc && device.at != reference)
        .collect();
    let end = wire.now().saturating_add(SETTLING_TIMEOUT);
    loop {
        let each = others
            .iter()
            .map(|device| read(wire, &device.at, STEP, registers::DC_SYSTEM_TIME_DIFFERENCE));
        let differences = try_join_all(each).await?;
        // Bit 31 is the sign.
        let amount = |difference: &[u8; 4]| u32::from_le_bytes(*difference) & 0x7fff_ffff;
        if differences.iter().all(|d| u64::from(amount(d)) <= window) {
            return Ok(true);
        }
        if wire.now() >= end {
            return Ok(false);
        }
        let distributed = wire.distribute_time(reference.station).await;
        distributed.map_err(|error| {
            Cause::Datagram(error)
                .with_device(&reference)
                .with_action(STEP)
        })?;
        wire.delay(DISTRIBUTION_PERIOD).await;
    }
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

/// Finds the devices that follow the reference clock. If the working counter of the distributed time
/// (FRMW) shows that some do not, each device receives almost its own time.
async fn find_followers(
    wire: &DatagramClient,
    devices: &mut [BusDevice],
    reference: &DeviceRef,
) -> Result<(), Error> {
    let failed = |at: &DeviceRef, error| Cause::Datagram(error).with_device(at).with_action(STEP);
    for device in &mut *devices {
        device.follows = device.at == *reference;
    }
    // Repeated: a frame that loses its end in a device counts too little.
    for _ in 0..FOLLOWER_ATTEMPTS {
        let counted = wire.distribute_time(reference.station).await;
        let counted = counted.map_err(|error| failed(reference, error))?;
        let all = devices.iter().filter(|device| device.dc).count() <= usize::from(counted);
        for device in devices
            .iter_mut()
            .filter(|device| device.dc && !device.follows)
        {
            let at = &device.at;
            device.follows = all || {
                let time = system_time(wire, at).await?.to_le_bytes();
                let written = wire.write(at.station, registers::DC_SYSTEM_TIME, &time);
                written.await.map_err(|error| failed(at, error))? > 0
            };
            tracing::debug!(device = %at, follows = device.follows, "system time written");
        }
        if devices.iter().all(|device| device.follows || !device.dc) {
            break;
        }
    }
    Ok(())
}

pub(super) async fn system_time(
    wire: &impl MailboxTransport,
    at: &DeviceRef,
) -> Result<u64, Error> {
    let time = read(wire, at, STEP, registers::DC_SYSTEM_TIME).await?;
    Ok(u64::from_le_bytes(time))
}

/// The SYNC0 pulses of a device.
#[derive(Debug, Clone, Copy)]
struct Pulses {
    /// The first pulse after the common start.
    shift: i64,
    cycle: u64,
    /// The propagation delay from the reference clock.
    delay: i64,
}

/// When the frames of a cycle should pass the reference clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Release {
    /// In ns after the common start of SYNC0, less than a cycle.
    after: u64,
    /// The time in ns from a pulse to the first bit, and from the last bit to the next pulse.
    margin: i64,
    /// The device with the pulse before the frames.
    nearest: Option<usize>,
}

/// Returns a warning if the frames come close to the pulses of a device.
fn short_margin(
    cycle: u64,
    frames: u64,
    margin: i64,
    nearest: Option<&DeviceRef>,
) -> Option<String> {
    let least = SHORT_MARGIN.min(cycle / SHORT_MARGIN_DIVISOR);
    if u64::try_from(margin).is_ok_and(|margin| margin >= least) {
        return None;
    }
    let name = &nearest?.name;
    let us = |ns: f64| ns / 1000.0;
    Some(format!(
        "between the SYNC0 pulses of `{name}` and the frames of {:.1} µs, only {:.1} µs remain: \
         outputs can reach it a cycle late. Use a longer cycle or fewer process data",
        us(frames as f64),
        us(margin as f64).max(0.0),
    ))
}

/// Returns when a cycle's frames should begin to pass the reference clock.
///
/// Every device has the same distance from a pulse to the first bit of the frames as from their last
/// bit to the next pulse, or a larger one. `frames` is the time from the first bit to the last one.
fn release_time(cycle: u64, frames: u64, devices: impl Iterator<Item = Pulses>) -> Release {
    let period = i64::try_from(cycle).unwrap_or(i64::MAX).max(1);
    let frames = i64::try_from(frames).unwrap_or(i64::MAX);
    // Pulses of other cycles than the bus cycle repeat in this pattern.
    let step = |device: &Pulses| {
        let step = greatest_common_divisor(device.cycle, cycle);
        i64::try_from(step).unwrap_or(period).max(SHORTEST_PATTERN)
    };
    let devices: Vec<_> = devices.map(|device| (step(&device), device)).collect();
    let longest = devices.iter().map(|(step, _)| *step).max();
    let mut pulses = Vec::new();
    for (index, (step, device)) in devices.into_iter().enumerate() {
        // No frame fits between the pulses of this device: it must not move those of the others.
        if step <= frames && Some(step) != longest {
            continue;
        }
        let first = device.shift - device.delay;
        let repeated = (0..).map(|n| n * step).take_while(|&after| after < period);
        pulses.extend(repeated.map(|after| ((first + after).rem_euclid(period), index)));
    }
    pulses.sort_unstable();
    let following = pulses.iter().skip(1).map(|(pulse, _)| *pulse);
    let wrapped = pulses.first().map(|(first, _)| first + period);
    let (gap, start, nearest) = pulses
        .iter()
        .zip(following.chain(wrapped))
        .map(|(&(pulse, device), next)| (next - pulse, pulse, Some(device)))
        .max_by_key(|&(gap, start, _)| (gap, -start))
        .unwrap_or((period, 0, None));
    let after = (start + gap / 2 - frames / 2).rem_euclid(period);
    Release {
        after: after.unsigned_abs(),
        margin: (gap - frames) / 2,
        nearest,
    }
}

pub(super) fn greatest_common_divisor(a: u64, b: u64) -> u64 {
    match a {
        0 => b,
        _ => greatest_common_divisor(b % a, a),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn release(cycle: u64, frames: u64, devices: &[(i64, u64, i64)]) -> u64 {
        let pulses = devices.iter().map(|&(shift, cycle, delay)| Pulses {
            shift,
            cycle,
            delay,
        });
        release_time(cycle, frames, pulses).after
    }

    /// 60 µs of frames between two pulses, 200 µs and 66 µs apart.
    #[test]
    fn margin_is_the_time_between_frames_and_pulses() {
        for (cycle, margin, warned) in [(200_000, 70_000, false), (66_000, 3_000, true)] {
            let pulses = Pulses {
                shift: 0,
                cycle,
                delay: 0,
            };
            let release = release_time(cycle, 60_000, [pulses].into_iter());
            assert_eq!((release.margin, release.nearest), (margin, Some(0)));
            let at = DeviceRef {
                name: "drive".to_owned(),
                position: 0,
                station: 0x1000,
            };
            let text = short_margin(cycle, 60_000, release.margin, Some(&at));
            assert_eq!(text.is_some(), warned, "{text:?}");
        }
    }

    /// ETG.2000, `ShiftTimeSync0`: each device has its own pulses within the cycle.
    #[test]
    fn release_time_is_in_the_middle_of_the_longest_pause() {
        for (shifts, expected) in [
            (&[0][..], 500_000),
            (&[500_000], 0),
            (&[-250_000], 250_000),
            (&[0, 0, 200_000], 600_000),
            (&[0, 500_000], 250_000),
            (&[], 500_000),
        ] {
            let devices: Vec<_> = shifts.iter().map(|&at| (at, 1_000_000, 0)).collect();
            assert_eq!(release(1_000_000, 0, &devices), expected, "{shifts:?}");
        }
    }

    /// ETG.2000, `CycleTimeSync0`: a factor of -2 or -4, or a fixed time, makes SYNC0 faster than
    /// the bus; a positive factor makes it slower.
    #[test]
    fn release_time_avoids_the_pulses_of_faster_and_slower_sync0() {
        for (devices, expected) in [
            (&[(0, 500_000, 0)][..], 250_000),
            (&[(0, 250_000, 0)], 125_000),
            (&[(62_500, 125_000, 0)], 125_000),
            (&[(0, 4_000_000, 0)], 500_000),
            // Between the third and the fourth pulse of the first device.
            (
                &[
                    (0, 250_000, 0),
                    (600_000, 1_000_000, 0),
                    (100_000, 1_000_000, 0),
                    (400_000, 1_000_000, 0),
                ],
                875_000,
            ),
        ] {
            assert_eq!(release(1_000_000, 0, devices), expected, "{devices:?}");
        }
    }

    /// A device whose pulses are closer than the frames are long does not move the frames towards the
    /// pulse of a drive: 60 µs of frames, and SYNC0 cycles of 10 µs and of no common divisor.
    #[test]
    fn release_time_ignores_pulses_that_no_frame_fits_between() {
        for fast in [10_000, 300_007] {
            let devices = [(0, 1_000_000, 0), (0, fast, 500)];
            assert_eq!(release(1_000_000, 60_000, &devices), 470_000, "{fast} ns");
        }
    }

    /// The pause before the first bit at the first device is as long as that after the last bit at
    /// the last device: each frame arrives later by the propagation delay (ETG.1000.4, distributed
    /// clocks).
    #[test]
    fn release_time_leaves_room_for_the_frames_and_their_propagation() {
        let cycle = 1_000_000;
        let frames = 120_000;
        let devices: Vec<_> = (0..100).map(|n| (0, cycle, n * 1_000)).collect();
        let start = release(cycle, frames, &devices) as i64;
        let before = start;
        let after = cycle as i64 - (start + 99_000 + frames as i64);
        assert_eq!(before - after, 0, "{before} {after}");
    }
}
