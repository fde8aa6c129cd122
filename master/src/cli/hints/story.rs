//! What to do about the causes that a fault story finds.

use ecaxis::al_status::al_status_hint;
use ecaxis::story::Cause;

/// Likeliest first. Nothing where the error itself brings its advice.
pub(crate) fn cause(cause: &Cause) -> Vec<String> {
    match cause {
        Cause::Overload { .. } => vec![
            "`ecaxis doctor` finds what keeps this computer from being on time, with the command that mends it".to_owned(),
            "give the cycle a CPU of its own (`cpu`), keep that CPU awake, and end what else is heavy on this computer".to_owned(),
            "or take a longer `cycle`; a longer `watchdog` rides through single delays".to_owned(),
        ],
        Cause::OtherMainDevice { .. } => vec![
            "end the other EtherCAT program: TwinCAT, SOEM or IgH's `ethercat`, or a second `ecaxis`, on this computer or another".to_owned(),
            "connect the segment to this computer's port alone, without a switch in between".to_owned(),
        ],
        Cause::Interface { .. } => vec![
            "look whether the interface is up and its cable plugged (`ip link`), and that nothing manages it (NetworkManager)".to_owned(),
        ],
        Cause::NobodyAnswers { .. } => vec![
            "look at the link light of the first device's IN port, at its power, and at the cable".to_owned(),
            "`ip link` shows whether the interface still has a carrier".to_owned(),
        ],
        Cause::LateFrames { .. } => vec![
            "switch interrupt coalescing off: `ethtool -C IF rx-usecs 0 tx-usecs 0`; `ecaxis doctor IF` says what else delays frames".to_owned(),
            "USB adapters and virtual interfaces take a millisecond now and then: use a card of its own".to_owned(),
            "or take a longer `cycle`, or `exchange = \"pipelined\"`, which gives frames a cycle to come back".to_owned(),
        ],
        Cause::Silence { .. } => vec![
            "look for a loose plug at this computer or at the first device, and for an interface that resets (`dmesg`, `ethtool -S`)".to_owned(),
            "`lost_frames` in the machine file sets how many cycles in a row are ridden through".to_owned(),
        ],
        Cause::OutOfReach { link, .. } => {
            let first = match link {
                Some(true) => "the link is there, the device is silent: switch it off and on, then look at its firmware and EEPROM",
                _ => "look at the link lights at both ends of that cable and at the power of the device behind it",
            };
            vec![
                first.to_owned(),
                "check the order of IN and OUT: a cable in the wrong one of two sockets turns the line round".to_owned(),
                "where connectors move with the machine, use cables for drag chains and sockets that lock".to_owned(),
            ]
        }
        Cause::Restarted { .. } => vec![
            "look at its supply: a dip when all axes accelerate, a loose terminal, a tripped fuse, an emergency stop that cuts the logic supply, too".to_owned(),
            "feed the logic of drives from a supply of its own".to_owned(),
        ],
        Cause::DamagedFrames { .. } => vec![
            "change that cable, and look at both sockets; then whether the counters still grow".to_owned(),
            "keep it away from motor cables, and its screen connected at both ends".to_owned(),
            "errors at one port that stay with the device when the cable is changed come from its PHY or its supply".to_owned(),
        ],
        Cause::LooseLink { .. } => vec![
            "look for a loose plug, a worn cable in a drag chain, or a device at the other end that restarted".to_owned(),
        ],
        Cause::Watchdog { silence_ns: 0, .. } => vec![
            "the watchdog may be shorter than the cycle needs: leave `watchdog` out to get the default".to_owned(),
            "frames came, but outputs did not: look for a device in front of it that was not in Op".to_owned(),
        ],
        Cause::Watchdog { .. } => vec![
            "find out why no frame came back: the cable, a device in front that restarted, or this computer (`ecaxis doctor`)".to_owned(),
            "`lost_frames` in the machine file stops the machine before the watchdogs do".to_owned(),
        ],
        Cause::OutputsNotTaken { .. } => vec![
            "switch the device off and on; look whether its outputs' SyncManager and FMMU are as `ecaxis explain` prints them".to_owned(),
        ],
        Cause::Sync { code, .. } => {
            let own = al_status_hint(*code).map(ToOwned::to_owned);
            own.into_iter()
                .chain([
                    "look whether frames come between two SYNC0 pulses: `ecaxis explain` prints shift and cycle, the summary the phase error".to_owned(),
                    "for drives that know it, 0x10F1:02 and 0x1C32:0B tell how many misses they bear and had".to_owned(),
                ])
                .collect()
        }
        Cause::LeftOp { code: 0, .. } => vec![
            "look whether another program drives the bus, then at the device's supply".to_owned(),
        ],
        Cause::LeftOp { code, .. } => {
            vec![al_status_hint(*code).unwrap_or("look the code up in the device's manual").to_owned()]
        }
        Cause::Interpolation { .. } => vec![
            "0x60C2 must be the cycle: it is written from `cycle` unless `sdo` in the machine file says otherwise".to_owned(),
            "a drive that confirms the write and keeps its old value wants it in another state, or another firmware; read it back with `ecaxis sdo`".to_owned(),
        ],
        Cause::Mailbox { .. } => vec![
            "switch the device off and on; look whether its firmware runs (RUN light, its own display)".to_owned(),
            "another program that uses the same mailbox takes the answers away".to_owned(),
        ],
        Cause::Revision { .. } => vec![
            "get the ESI file of that revision from the manufacturer, or pick the revision with `revision`".to_owned(),
            "`identity` in the machine file says which other revisions may stand for that of the ESI file".to_owned(),
        ],
        Cause::AsTold { .. } => Vec::new(),
    }
}

/// What a working counter that is too small says: a device adds 1 where its inputs are read, 2 where its outputs are written
/// (ETG.1000.4, LRW), 3 for both.
pub(super) fn working_counter((seen, expected): (u16, u16)) -> &'static str {
    match (seen, expected.saturating_sub(seen)) {
        (0, _) => {
            "nobody takes part: the devices are not in SafeOp or Op, or another program has changed their FMMUs"
        }
        (_, 0) => {
            "more devices take part than should: another device answers at the same logical address"
        }
        (_, missing) if missing % 3 == 0 => {
            "a device with inputs and outputs is missing as a whole: check its power and the cable to it"
        }
        (_, missing) if missing % 3 == 2 => {
            "a device does not take its outputs: it has left Op (look at its AL status code), or its controller knows no LRW"
        }
        _ => {
            "a device does not give its inputs: look at its state, and whether it has an FMMU left"
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_of_a_working_counter() {
        for (seen, expected, word) in [
            (0, 9, "nobody takes part"),
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
