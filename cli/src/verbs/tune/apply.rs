//! Writes proposed gains to the drive.

use ecaxis_master::config::{AxisSetup, Machine};
use ecaxis_master::mailbox::MailboxTransport;

use super::report::DriveGain;
use crate::access::device::{Open, Target};
use crate::hints::{self, Failure};
use crate::render::note;

/// Writes gains, each after it was read.
pub(super) fn write(
    machine: Machine,
    setup: &AxisSetup,
    gains: &[DriveGain],
) -> Result<(), Failure> {
    if gains.is_empty() {
        let message = "no gains of the drive are proposed, so nothing was written";
        return Err(Failure::new(hints::FAILED, message)
            .hint("the machine file needs `rated_torque` and `torque_constant` of the axis"));
    }
    let target = Target::of_device(machine, setup.device);
    let gains = gains.to_vec();
    let done = target.open("writing gains", async move |open: &mut Open<'_>| {
        let mut done = Vec::new();
        for gain in gains {
            let wire = &open.at.wire;
            let object = gain.object;
            // A drive without the object refuses here, before anything was changed.
            let before = open.coe.upload(wire, object.index, object.sub, false).await;
            done.push((gain, open.at.sdo_error(before)?));
        }
        for (gain, _) in &done {
            let wire = &open.at.wire;
            let value = gain.raw.to_le_bytes();
            let object = gain.object;
            let download = open
                .coe
                .download(wire, object.index, object.sub, false, &value);
            // A started download is not cancelled.
            let sent = wire.stop().shield(download).await;
            open.at.sdo_error(sent)?;
        }
        Ok(done)
    })?;
    for (gain, before) in done {
        let before = before
            .iter()
            .rev()
            .fold(0_u64, |v, b| v << 8 | u64::from(*b));
        note(&format!(
            "0x{:04x}:{:02x} {}: {} (it was {before})",
            gain.object.index, gain.object.sub, gain.object.name, gain.raw
        ));
    }
    Ok(())
}
