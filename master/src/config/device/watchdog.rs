//! `watchdog_trigger` of `[[device]]`.

use ecaxis_esi as esi;
use toml::Spanned;

use super::super::WatchdogTrigger;
use super::super::problem::Problems;

/// Lets outputs trigger the watchdog: a drive must stop if its outputs fail, whatever its ESI
/// contains.
pub(super) fn set_trigger(
    selection: &mut esi::Selection,
    key: Option<&Spanned<WatchdogTrigger>>,
    p: &mut Problems<'_>,
) {
    if let Some(key) = key.filter(|_| selection.layout.outputs.is_empty()) {
        let hint = "omit it: only outputs trigger the watchdog";
        p.add_hint(key.span(), "`watchdog_trigger` without outputs", hint);
    }
    let rule = key.map_or_else(WatchdogTrigger::default, |key| *key.get_ref());
    let has_axis = selection.mode.is_some();
    let watched = match rule {
        WatchdogTrigger::Preferred => has_axis,
        WatchdogTrigger::Required => true,
        WatchdogTrigger::Esi => false,
    };
    for sm in &mut selection.layout.outputs {
        let of_esi = sm.has_trigger();
        sm.watched = watched;
        let (number, before, now) = (sm.sm, sm.control_byte, sm.control());
        if sm.has_trigger() != of_esi {
            let otherwise = match rule {
                WatchdogTrigger::Preferred => {
                    "; a device that refuses it gets the ESI's (`watchdog_trigger`)"
                }
                _ => "",
            };
            selection.notes.push(format!(
                "SyncManager {number} gets ControlByte 0x{now:02x}, with the watchdog trigger that 0x{before:02x} in the ESI lacks{otherwise}"
            ));
        } else if has_axis && !of_esi {
            selection.notes.push(format!(
                "SyncManager {number} gets ControlByte 0x{now:02x}, without the watchdog trigger (`watchdog_trigger`): only the drive itself can stop the axis if its outputs fail"
            ));
        }
    }
}
