//! The drive's own limits, read after its start-up SDOs and its units. A limit of the machine file
//! beyond them causes a warning. Objects that would add to every target are set to zero.

use ecaxis_ecat::index::AxisIndex;
use ecaxis_esi::{StartupSdo, axis};

use super::{BusDevice, Step, device};
use crate::config::drive_limits::{OFFSETS, speed_unit};
use crate::config::{AxisSetup, DeviceConfig};
use crate::mailbox::{MailboxTransport, NamedObject};
use crate::report::{Cause, Error};

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
    for (index, sub) in axis.limit_objects() {
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
    for mut conflict in axis.exceeded(drive, speed_unit(selection)) {
        conflict.index = object(conflict.index);
        progress(Step::Warning(format!("{}: {conflict}", device.at)));
        device.limits.push((axis_index, conflict));
    }
    for index in OFFSETS {
        // Objects in the process data are written every cycle.
        if !exists(index, 0) || selection.layout.rx_field(index, 0).is_some() {
            continue;
        }
        let index = object(index);
        let found = coe.upload_optional(wire, index, 0, false).await;
        let found = found.map_err(failed)?;
        let Some(data) = found.filter(|data| data.iter().any(|byte| *byte != 0)) else {
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
