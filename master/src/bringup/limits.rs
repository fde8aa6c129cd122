//! The drive's own limits, read after its start-up SDOs and its units. A limit of the machine file
//! beyond them causes a warning, and so does a drive that ignores a lost connection. Objects that
//! would add to every target are set to zero.

use ecaxis_ecat::index::AxisIndex;
use ecaxis_esi::{StartupSdo, axis};

use super::{BusDevice, Step, device};
use crate::config::cycle_objects::OFFSETS;
use crate::config::{AxisSetup, DeviceConfig, UnitProblem, is_maxon};
use crate::mailbox::{MailboxTransport, NamedObject};
use crate::report::{Cause, Error};

/// The drive's reaction to a lost connection; 0 is none (CiA 402-2, 0x6007).
const ABORT_CONNECTION: u16 = 0x6007;

fn is_zero(data: &[u8]) -> bool {
    data.iter().all(|byte| *byte == 0)
}

pub(super) async fn compare(
    wire: &impl MailboxTransport,
    config: &DeviceConfig,
    (axis_index, axis): (AxisIndex, &AxisSetup),
    device: &mut BusDevice,
    progress: &dyn Fn(Step),
) -> Result<(), Error> {
    let Some(coe) = device.coe.as_mut() else {
        return Ok(());
    };
    let object = |index| axis::object(index, axis.number);
    let failed = |source| {
        Cause::Sdo(source)
            .with_device(&device.at)
            .with_action("reading the drive's limits")
    };
    let selection = &*config.selection.of_axis(axis.number);
    let dictionary = &selection.dictionary;
    // Only objects in the ESI's dictionary are read, if the ESI has a dictionary.
    let exists =
        |index, sub| dictionary.objects.is_empty() || dictionary.item(index, sub).is_some();
    let mut adopted = device.adopted.iter();
    let adopted = adopted.find(|(index, _)| *index == axis_index);
    let axis = adopted.map_or(axis, |(_, adopted)| &adopted.setup);
    let mut held = Vec::new();
    for (index, sub) in axis.limit_objects(is_maxon(selection)) {
        if exists(index, sub)
            && let Some(data) = coe
                .upload_optional(wire, object(index), sub, false)
                .await
                .map_err(failed)?
        {
            held.push(((index, sub), data));
        }
    }
    let drive = |index, sub| {
        let mut all = held.iter();
        let found = all.find(|(object, _)| *object == (index, sub))?;
        Some(found.1.clone())
    };
    for mut conflict in axis.exceeded(drive, selection) {
        conflict.index = object(conflict.index);
        if conflict.wraps() {
            return Err(Cause::Units {
                problems: vec![UnitProblem::PositionRange(conflict)],
            }
            .with_device(&device.at));
        }
        progress(Step::Warning(format!("{}: {conflict}", device.at)));
        device.limits.push((axis_index, conflict));
    }
    if exists(ABORT_CONNECTION, 0) {
        let index = object(ABORT_CONNECTION);
        let found = coe.upload_optional(wire, index, 0, false).await;
        if found.map_err(failed)?.is_some_and(|data| is_zero(&data)) {
            progress(Step::Warning(format!(
                "{}: {} = 0: the drive does not stop if the connection is lost; for a fault \
                 reaction (0x605e), write `sdo = [{{ index = {index:#06x}, value = 1 }}]`",
                device.at,
                NamedObject { index, sub: 0 }
            )));
        }
    }
    for index in OFFSETS {
        // Objects in the process data are written every cycle.
        if !exists(index, 0) || selection.layout.rx_field(index, 0).is_some() {
            continue;
        }
        let index = object(index);
        let found = coe.upload_optional(wire, index, 0, false).await;
        let found = found.map_err(failed)?;
        let Some(data) = found.filter(|data| !is_zero(data)) else {
            continue;
        };
        let zero = StartupSdo {
            transition: "PS",
            index,
            sub: 0,
            complete_access: false,
            data: vec![0; data.len()],
            name: String::new(),
            origin: "no offset to the axis' targets".to_owned(),
            optional: false,
        };
        device::download(wire, &device.at, coe, &zero).await?;
        progress(Step::Warning(format!(
            "{}: {} was not zero and adds to every target: it is zero now",
            device.at,
            NamedObject { index, sub: 0 }
        )));
    }
    Ok(())
}
