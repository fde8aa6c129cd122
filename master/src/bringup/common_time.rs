//! SYNC0 on whole multiples of the cycle in common time, from its first pulse on.

use super::clocks::{STEP, system_time};
use super::device::read;
use crate::acyclic::DeviceRef;
use crate::clock;
use crate::datagram::DatagramClient;
use crate::report::Error;
use ecaxis_ecat::registers;

/// Readings of the reference clock; the fastest one counts.
const READINGS: usize = 16;

/// Returns common time minus system time of the reference clock in ns. A frame passes the clock
/// after it was sent, so the largest difference is next to the true one.
pub(super) async fn common_offset(
    wire: &DatagramClient,
    reference: &DeviceRef,
) -> Result<Option<i64>, Error> {
    let mut found: Option<i64> = None;
    for _ in 0..READINGS {
        let host = clock::common_offset();
        let sent = clock::now();
        let time = system_time(wire, reference).await?;
        if let Some(host) = host {
            let common = sent.wrapping_add_signed(host);
            let offset = common.wrapping_sub(time).cast_signed();
            found = Some(found.map_or(offset, |best| best.max(offset)));
        }
    }
    Ok(found)
}

/// Returns the first system time from `from` on that is a whole multiple of the cycle in common
/// time.
pub(super) fn next_multiple(from: u64, common_offset: i64, cycle: u64) -> u64 {
    let cycle = cycle.max(1);
    let within = from.wrapping_add_signed(common_offset) % cycle;
    from.wrapping_add((cycle - within) % cycle)
}

/// Returns the offset (0x0920) of a clock.
///
/// # Errors
/// The device does not answer.
pub(crate) async fn clock_offset(wire: &DatagramClient, at: &DeviceRef) -> Result<u64, Error> {
    let offset = read(wire, at, STEP, registers::DC_SYSTEM_TIME_OFFSET).await?;
    Ok(u64::from_le_bytes(offset))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn next_multiple_is_one_in_common_time() {
        for (from, offset, cycle) in [
            (1_000_000_000, 946_684_800_123_456_789, 1_000_000),
            (846_684_800_000_000_000, 946_684_800_000_000_001, 250_000),
            (5, -5, 1_000_000),
            (7, 0, 1_000_000),
        ] {
            let at = next_multiple(from, offset, cycle);
            assert!((from..from + cycle).contains(&at), "{from} {at}");
            assert_eq!(at.wrapping_add_signed(offset) % cycle, 0, "{from}");
        }
    }
}
