//! Advice for the causes that a fault report can name.

use ecaxis_ecat::al_status_code::al_status_hint;
use ecaxis_master::post_mortem::DiagnosedCause;

/// Returns the advice, likeliest first. It is empty if the error brings its own.
pub(crate) fn diagnosed(cause: &DiagnosedCause) -> Vec<String> {
    match cause {
        DiagnosedCause::Overload { .. } => vec![
            "`ecaxis doctor` reports host settings that disturb the cycle, each with the command that fixes it".to_owned(),
            "reserve a CPU for the cycle (`cpu`), keep that CPU awake, and stop other heavy load on this computer".to_owned(),
            "or take a longer `cycle`; a longer `watchdog` tolerates single delays".to_owned(),
        ],
        DiagnosedCause::OtherMainDevice { .. } => vec![
            "end the other EtherCAT program: TwinCAT, SOEM or IgH's `ethercat`, or a second `ecaxis`, on this computer or another".to_owned(),
            "connect the segment to this computer's port alone, without a switch in between".to_owned(),
        ],
        DiagnosedCause::Interface { .. } => vec![
            "check that the interface is up, its cable plugged (`ip link`), and that NetworkManager does not manage it".to_owned(),
        ],
        DiagnosedCause::NoResponse { .. } => vec![
            "check the link light of the first device's IN port, its power and the cable".to_owned(),
            "`ip link` shows whether the interface still has a carrier".to_owned(),
        ],
        DiagnosedCause::LateFrames { .. } => vec![
            "switch interrupt coalescing off: `ethtool -C IF rx-usecs 0 tx-usecs 0`; `ecaxis doctor IF` shows what else delays frames".to_owned(),
            "USB adapters and virtual interfaces add delays of a millisecond: use a dedicated network card".to_owned(),
            "or take a longer `cycle`, or `exchange = \"pipelined\"`, which allows frames one cycle to return".to_owned(),
        ],
        DiagnosedCause::TemporaryOutage { .. } => vec![
            "look for a loose plug at this computer or at the first device, and for an interface that resets (`dmesg`, `ethtool -S`)".to_owned(),
            "`lost_frames` in the machine file sets how many lost cycles in a row are tolerated".to_owned(),
        ],
        DiagnosedCause::OutOfReach { link, .. } => {
            let first = match link {
                Some(true) => "the link is up, but the device does not answer: switch it off and on, then check its firmware and EEPROM",
                _ => "look at the link lights at both ends of that cable and at the power of the device behind it",
            };
            vec![
                first.to_owned(),
                "check the order of IN and OUT: a cable in the wrong socket reverses the order of the line".to_owned(),
                "where connectors move with the machine, use cables for drag chains and sockets that lock".to_owned(),
            ]
        }
        DiagnosedCause::Restarted { .. } => vec![
            "check its supply: a dip when all axes accelerate, a loose terminal, a tripped fuse, an emergency stop that also cuts the logic supply".to_owned(),
            "feed the logic of drives from a separate supply".to_owned(),
        ],
        DiagnosedCause::DamagedFrames { .. } => vec![
            "replace that cable and check both sockets; then check whether the counters still grow".to_owned(),
            "keep it away from motor cables, and connect its shield at both ends".to_owned(),
            "if the errors stay with the device after the cable is replaced, its PHY or its supply is the cause".to_owned(),
        ],
        DiagnosedCause::LinkFlapping { .. } => vec![
            "look for a loose plug, a worn cable in a drag chain, or a device at the other end that restarted".to_owned(),
        ],
        DiagnosedCause::Watchdog { silence_ns: 0, .. } => vec![
            "the watchdog may be too short for the cycle: omit `watchdog` to use the default".to_owned(),
            "frames arrived without outputs: look for a device in front of it that was not in Op".to_owned(),
        ],
        DiagnosedCause::Watchdog { .. } => vec![
            "find out why no frame came back: the cable, a device in front that restarted, or this computer (`ecaxis doctor`)".to_owned(),
            "`lost_frames` in the machine file stops the machine before the watchdogs do".to_owned(),
        ],
        DiagnosedCause::OutputsNotTaken { .. } => vec![
            "switch the device off and on; check its outputs' SyncManager and FMMU against `ecaxis explain`".to_owned(),
        ],
        DiagnosedCause::Sync { code, .. } => {
            let own = al_status_hint(*code).map(ToOwned::to_owned);
            own.into_iter()
                .chain([
                    "check that frames arrive between two SYNC0 pulses: `ecaxis explain` prints shift and cycle, the summary the phase error".to_owned(),
                    "if the drive supports them, 0x10F1:02 is its limit of missed cycles, and 0x1C32:0B counts them".to_owned(),
                ])
                .collect()
        }
        DiagnosedCause::LeftOp { code: 0, .. } => vec![
            "check whether another program drives the bus, then the device's supply".to_owned(),
        ],
        DiagnosedCause::LeftOp { code, .. } => {
            vec![al_status_hint(*code).unwrap_or("look the code up in the device's manual").to_owned()]
        }
        DiagnosedCause::Interpolation { .. } => vec![
            "0x60C2 must be the cycle: it is written from `cycle` unless `sdo` in the machine file says otherwise".to_owned(),
            "a drive that confirms the write but keeps the old value needs another state or firmware; read it back with `ecaxis sdo`".to_owned(),
        ],
        DiagnosedCause::Mailbox { .. } => vec![
            "switch the device off and on; check that its firmware runs (RUN light, its own display)".to_owned(),
            "another program that uses the same mailbox takes the answers away".to_owned(),
        ],
        DiagnosedCause::Revision { .. } => vec![
            "get the ESI file of that revision from the manufacturer, or pick the revision with `revision`".to_owned(),
            "`identity` in the machine file sets which other revisions are accepted for that of the ESI file".to_owned(),
        ],
        DiagnosedCause::Unexplained { .. } => Vec::new(),
    }
}

/// Explains a working counter that is too small. A device adds 1 if its inputs are read, 2 if its
/// outputs are written, 3 for both (ETG.1000.4, LRW).
pub(super) fn working_counter((seen, expected): (u16, u16)) -> &'static str {
    match (seen, expected.saturating_sub(seen)) {
        (0, _) => {
            "no device takes part: the devices are not in SafeOp or Op, or another program has changed their FMMUs"
        }
        (_, 0) => {
            "more devices take part than expected: another device answers at the same logical address"
        }
        (_, missing) if missing % 3 == 0 => {
            "a device with inputs and outputs is missing as a whole: check its power and the cable to it"
        }
        (_, missing) if missing % 3 == 2 => {
            "a device does not take its outputs: it has left Op (check its AL status code), or its controller does not support LRW"
        }
        _ => "a device does not give its inputs: check its state, and whether it has a free FMMU",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn working_counter_hint_names_the_missing_access() {
        for (seen, expected, word) in [
            (0, 9, "no device takes part"),
            (6, 9, "as a whole"),
            (3, 9, "as a whole"),
            (7, 9, "does not take its outputs"),
            (8, 9, "does not give its inputs"),
            (9, 9, "more devices"),
            (12, 9, "more devices"),
            (u16::MAX, 0, "more devices"),
        ] {
            assert!(
                working_counter((seen, expected)).contains(word),
                "{seen} of {expected}"
            );
        }
    }
}
