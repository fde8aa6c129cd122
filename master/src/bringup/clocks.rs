//! SYNC0 on every device whose ESI OpMode asks for it.
//!
//! ethercrab has measured the propagation delays, set offsets and run the static drift
//! compensation. It would start SYNC0 at a whole multiple of the cycle whatever the ESI says, so
//! start, shift, cycle and AssignActivate are written here (ETG.1000.4, 6.4.2; ETG.2000, Dc).

use super::device::{read, write};
use super::{BringUpError, BusDevice, Step};
use crate::clock::Nanos;
use crate::config::Machine;
use crate::mailbox::Wire;

const STEP: &str = "starting SYNC0";
const SYSTEM_TIME: u16 = 0x0910;
/// 0x0980 cyclic unit control, 0x0981 activation.
const ACTIVATION: u16 = 0x0980;
const START_TIME: u16 = 0x0990;
const SYNC0_CYCLE: u16 = 0x09a0;
const SYNC1_CYCLE: u16 = 0x09a4;

/// The first pulse must still lie ahead when the last device has been told of it.
const START_DELAY: Nanos = 100_000_000;
const START_DELAY_PER_DEVICE: Nanos = 5_000_000;

/// What the cyclic exchange needs to keep the clocks together and itself in phase.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DcPlan {
    /// Station address of the reference clock.
    pub reference: u16,
    pub cycle_ns: u64,
    /// System time of a SYNC0 pulse without shift.
    pub start: u64,
    /// Devices that run on SYNC0.
    pub devices: usize,
}

/// `None` where no device asks for distributed clocks.
pub(super) async fn configure(
    wire: &impl Wire,
    machine: &Machine,
    devices: &[BusDevice],
    progress: &mut dyn FnMut(Step),
) -> Result<Option<DcPlan>, BringUpError> {
    let wanting: Vec<_> = machine
        .devices
        .iter()
        .zip(devices)
        .filter_map(|(config, device)| Some((config.selection.dc.as_ref()?, device)))
        .collect();
    if let Some((_, device)) = wanting.iter().find(|(_, device)| !device.dc) {
        return Err(BringUpError::NoClock {
            device: device.at.clone(),
        });
    }
    let reference = devices
        .iter()
        .filter(|d| d.dc)
        .min_by_key(|d| d.at.position);
    let (false, Some(reference)) = (wanting.is_empty(), reference) else {
        return Ok(None);
    };

    let mut now = [0; 8];
    read(wire, reference, STEP, SYSTEM_TIME, &mut now).await?;
    let cycle = machine.bus.cycle_ns;
    let ahead = START_DELAY
        + START_DELAY_PER_DEVICE * u64::try_from(wanting.len()).unwrap_or(u64::MAX / 1_000_000_000);
    let start = (u64::from_le_bytes(now).wrapping_add(ahead) / cycle + 1).wrapping_mul(cycle);

    for (dc, device) in &wanting {
        write(wire, device, STEP, ACTIVATION, &[0, 0]).await?;
        let first = start.wrapping_add_signed(i64::from(dc.sync0_shift_ns));
        write(wire, device, STEP, START_TIME, &first.to_le_bytes()).await?;
        write(
            wire,
            device,
            STEP,
            SYNC0_CYCLE,
            &dc.sync0_cycle_ns.to_le_bytes(),
        )
        .await?;
        write(
            wire,
            device,
            STEP,
            SYNC1_CYCLE,
            &dc.sync1_cycle_ns.to_le_bytes(),
        )
        .await?;
        write(
            wire,
            device,
            STEP,
            ACTIVATION,
            &dc.assign_activate.to_le_bytes(),
        )
        .await?;
    }
    progress(Step::Clocks {
        reference: reference.at.name.clone(),
        devices: wanting.len(),
    });
    Ok(Some(DcPlan {
        reference: reference.at.station,
        cycle_ns: cycle,
        start,
        devices: wanting.len(),
    }))
}
