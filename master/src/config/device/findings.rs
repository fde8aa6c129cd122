//! What a bus or a device would refuse, found before the run.

use ecaxis_esi as esi;

use super::{KeyExt, MailboxSource, Problems, RawDevice, show};
use crate::link::MAX_DATA;

/// The shortest mailbox for one SDO: mailbox header, CoE header, SDO header and data.
const MIN_MAILBOX: u16 = 16;

/// Reports a mailbox of the ESI that cannot carry a message.
pub(super) fn mailbox(
    raw: &RawDevice,
    device: &esi::Device,
    source: MailboxSource,
    p: &mut Problems<'_>,
) {
    use esi::SmUse::{MBoxIn, MBoxOut};
    if device.mailbox.is_none() || source == MailboxSource::Eeprom {
        return;
    }
    let managers = (0..).zip(&device.sync_managers);
    let boxes: Vec<(u8, &esi::SyncManager)> = managers
        .filter(|(_, sm)| matches!(sm.usage, MBoxOut | MBoxIn))
        .collect();
    let name = &device.name;
    let wrong_size = boxes.iter().find_map(|(number, sm)| match sm.default_size {
        0 => Some(format!(
            "the mailbox of {name} (SyncManager {number}) has no size (`DefaultSize`)"
        )),
        size if size < MIN_MAILBOX => Some(format!(
            "the mailbox of {name} (SyncManager {number}) has {size} bytes, an SDO needs {MIN_MAILBOX}"
        )),
        size if size > MAX_DATA => Some(format!(
            "the mailbox of {name} (SyncManager {number}) has {size} bytes, a frame carries {MAX_DATA}"
        )),
        _ => None,
    });
    let end = |sm: &esi::SyncManager| u32::from(sm.start_address) + u32::from(sm.default_size);
    let overlap = || {
        let mut in_order = boxes.clone();
        in_order.sort_by_key(|(_, sm)| sm.start_address);
        in_order.windows(2).find_map(|pair| {
            let [(first, a), (second, b)] = pair else {
                return None;
            };
            (end(a) > u32::from(b.start_address)).then(|| {
                format!(
                    "the mailboxes of {name} overlap: SyncManager {first} ends at 0x{:04X}, \
                     SyncManager {second} begins at 0x{:04X}",
                    end(a),
                    b.start_address
                )
            })
        })
    };
    if let Some(message) = wrong_size.or_else(overlap) {
        let hint = match raw.sii.place() {
            Some(_) => "use an image of the device with its mailboxes",
            None => {
                "`mailbox = \"eeprom\"` uses the mailboxes of the device; or correct the SyncManagers in the ESI file"
            }
        };
        let at = raw.esi.place().or(raw.sii.place());
        p.add_hint(at.unwrap_or(raw.span.clone()), message, hint);
    }
}

/// Reports a shift of SYNC0 that exceeds its cycle.
pub(super) fn long_shift(selection: &esi::Selection) -> Option<String> {
    let dc = selection.dc.as_ref().filter(|dc| dc.activates_sync())?;
    let (shift, cycle) = (dc.sync0_shift_ns, dc.sync0_cycle_ns);
    (cycle > 0 && shift.unsigned_abs() >= cycle).then(|| {
        format!(
            "warning: the OpMode \"{}\" ({}) shifts SYNC0 by {}{}, and its cycle is {}: the OpMode is meant for a longer \
             cycle; raise `cycle`, or choose another `dc`",
            dc.name,
            dc.position.origin(),
            if shift < 0 { "-" } else { "" },
            show(u64::from(shift.unsigned_abs())),
            show(u64::from(cycle)),
        )
    })
}

/// Reports an EEPROM image that a SubDevice controller ignores.
pub(super) fn checksum(sii: &esi::sii::Sii) -> Option<String> {
    (!sii.checksum_ok).then(|| {
        "warning: the checksum of the EEPROM image is wrong, so a controller ignores its \
         configuration area; `ecaxis esi sii` generates an image from an ESI file"
            .to_owned()
    })
}
