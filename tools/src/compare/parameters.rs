//! Compares the device values of start-up SDOs.

use ecaxis_esi::StartupSdo;

use super::{Comparison, Difference};
use crate::scan::Scan;
use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::acyclic::device::with_mailbox;
use ecaxis_master::config::Machine;
use ecaxis_master::report::Cause;

/// False for PDO mapping and assignment, the module list and the mode, which every start-up
/// rewrites.
fn is_parameter(sdo: &StartupSdo) -> bool {
    !matches!(
        sdo.index,
        0x1600..=0x17ff | 0x1a00..=0x1bff | 0x1c10..=0x1c2f | 0xf030 | 0x6060 | 0x60c2
    )
}

/// Reads every object that a start-up SDO writes, and adds the differences. Devices in Init are in
/// PreOp meanwhile. Failures of a device are added to [`Comparison::unknown`].
pub async fn parameters(
    wire: &DatagramClient,
    machine: &Machine,
    scan: &Scan,
    comparison: &mut Comparison,
) {
    for (index, config) in machine.devices.enumerate() {
        let sdos: Vec<&StartupSdo> = config
            .selection
            .startup
            .iter()
            .filter(|sdo| is_parameter(sdo))
            .collect();
        let place = comparison.places.get(index).copied().flatten();
        let device = place.and_then(|at| scan.devices.get(usize::from(at)));
        let (Some(device), false) = (device, sdos.is_empty()) else {
            continue;
        };
        let Ok(sii) = &device.sii else { continue };
        let at = device.found.named(&config.name);
        let read = with_mailbox(wire, &at, sii, "reading its parameters", async |lent| {
            // The last write of an object takes effect.
            for (n, sdo) in sdos.iter().enumerate() {
                let again = |later: &&StartupSdo| (later.index, later.sub) == (sdo.index, sdo.sub);
                if sdos.iter().skip(n + 1).any(again) {
                    continue;
                }
                let read = lent
                    .coe
                    .upload(wire, sdo.index, sdo.sub, sdo.complete_access)
                    .await;
                match read {
                    Ok(found) if found == sdo.data => {}
                    Ok(found) => comparison.differences.push(Difference::Parameter {
                        device: index,
                        position: device.position(),
                        index: sdo.index,
                        sub: sdo.sub,
                        name: sdo.name.clone(),
                        expected: sdo.data.clone(),
                        found,
                    }),
                    // Some objects are write-only.
                    Err(error) if error.abort_code().is_some() => {}
                    Err(error) => return Err(Cause::Sdo(error).with_device(&at)),
                }
            }
            Ok(())
        });
        if let Err(error) = read.await {
            comparison.unknown.push(error.to_string());
        }
    }
}
