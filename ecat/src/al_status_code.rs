//! AL status codes (register 0x0134): why a SubDevice refused a state change or left a state. The
//! texts paraphrase the tables of ETG.1000.6 and ETG.1020.
//!
//! ```
//! use ecaxis_ecat::al_status_code::{al_status_hint, al_status_text};
//!
//! assert_eq!(al_status_text(0x0020), "the device needs a cold start");
//! assert_eq!(al_status_hint(0x0020), Some("switch the device off and on again"));
//! ```

/// Returns the text of an AL status code. Codes from 0x8000 on are vendor-specific.
pub fn al_status_text(code: u16) -> &'static str {
    match code {
        0x0000 => "no error",
        0x0001 => "unspecified error",
        0x0002 => "out of memory",
        0x0003 => "invalid device setup",
        0x0004 => "the configuration does not fit this hardware or software revision",
        0x0005 => "reserved for compatibility",
        0x0006 => "the EEPROM does not fit the firmware",
        0x0007 => "the firmware update failed, the old firmware still runs",
        0x000e => "licence error",
        0x0011 => "invalid state change requested",
        0x0012 => "unknown state requested",
        0x0013 => "bootstrap is not supported",
        0x0014 => "no valid firmware",
        0x0015 => "invalid mailbox configuration for bootstrap",
        0x0016 => "invalid mailbox configuration for PreOp",
        0x0017 => "invalid SyncManager configuration",
        0x0018 => "no valid inputs available",
        0x0019 => "no valid outputs",
        0x001a => "synchronization error",
        0x001b => "SyncManager watchdog",
        0x001c => "invalid SyncManager types",
        0x001d => "invalid output configuration",
        0x001e => "invalid input configuration",
        0x001f => "invalid watchdog configuration",
        0x0020 => "the device needs a cold start",
        0x0021 => "the device needs Init",
        0x0022 => "the device needs PreOp",
        0x0023 => "the device needs SafeOp",
        0x0024 => "invalid input mapping",
        0x0025 => "invalid output mapping",
        0x0026 => "inconsistent settings",
        0x0027 => "free run is not supported",
        0x0028 => "the synchronization mode is not supported",
        0x0029 => "free run needs buffered SyncManagers",
        0x002a => "background watchdog",
        0x002b => "no valid inputs and outputs",
        0x002c => "fatal synchronization error: SYNC0 or SYNC1 stopped",
        0x002d => "no synchronization: SYNC0 or SYNC1 was never seen",
        0x002e => "the cycle time is too short for the device",
        0x0030 => "invalid DC SYNC configuration",
        0x0031 => "invalid DC latch configuration",
        0x0032 => "PLL error: not synchronized to the MainDevice",
        0x0033 => "DC: I/O error of the synchronization",
        0x0034 => "DC: too many SYNC events missed",
        0x0035 => "DC: invalid SYNC cycle time",
        0x0036 => "DC: the SYNC0 cycle time does not fit",
        0x0037 => "DC: the SYNC1 cycle time does not fit",
        0x0041 => "error of the AoE mailbox",
        0x0042 => "error of the EoE mailbox",
        0x0043 => "error of the CoE mailbox",
        0x0044 => "error of the FoE mailbox",
        0x0045 => "error of the SoE mailbox",
        0x004f => "error of the VoE mailbox",
        0x0050 => "the device has no access to its EEPROM",
        0x0051 => "EEPROM error",
        0x0052 => "external hardware is not ready",
        0x0060 => "the device restarted by itself",
        0x0061 => "the device identification was changed",
        0x0070 => "the configured modules (0xF030) differ from the detected ones (0xF050)",
        0x0080 => "the supply voltage is too low",
        0x0081 => "the supply voltage is too high",
        0x0082 => "the temperature is too low",
        0x0083 => "the temperature is too high",
        0x00f0 => "the application controller is available",
        0x8000..=0xffff => "manufacturer-specific AL status code",
        _ => UNKNOWN,
    }
}

const UNKNOWN: &str = "unknown AL status code";

/// Returns a hint for codes that a wrong configuration or an unsuitable host causes.
pub fn al_status_hint(code: u16) -> Option<&'static str> {
    Some(match code {
        0x0003 | 0x0004 | 0x0006 => {
            "the ESI file may describe another revision of this device; compare it with the revision that it reports"
        }
        0x0011 | 0x0012 => {
            "the state must be changed step by step; power-cycle the device if it persists"
        }
        0x0015 | 0x0016 => {
            "mailbox addresses and lengths must be those of SM0 and SM1 in the ESI file of this very revision"
        }
        0x0017 | 0x001c => {
            "SyncManager addresses, lengths and control bytes must be those of the ESI file of this very revision"
        }
        0x0018 | 0x002b => {
            "the device has no inputs to send yet; look at its own error code (0x603F) and supply"
        }
        0x0019 => {
            "valid outputs must already arrive when Op is requested; is the cyclic exchange running?"
        }
        0x001a | 0x0034 => {
            "frames come at the wrong moment; look at the host's jitter and the DC shift of the ESI's mode"
        }
        0x001b => {
            "no process data for longer than the watchdog allows: a cable, lost frames, or a host that was held up"
        }
        0x001d => {
            "the length of the outputs' SyncManager differs from the assigned RxPDOs (0x1C12); did a start-up SDO fail, or is the mapping another one?"
        }
        0x001e => {
            "the length of the inputs' SyncManager differs from the assigned TxPDOs (0x1C13); did a start-up SDO fail, or is the mapping another one?"
        }
        0x001f => {
            "the device does not accept this watchdog time; leave `watchdog` out to get the default"
        }
        0x0020 => "switch the device off and on again",
        0x0024 => "an object in `pdo.tx` cannot be mapped, or its length is wrong",
        0x0025 => "an object in `pdo.rx` cannot be mapped, or its length is wrong",
        0x0026 => {
            "two settings contradict each other: often the mode of operation and the mapped objects, or the cycle time and 0x60C2"
        }
        0x0027 | 0x0028 => {
            "choose another `dc` mode: the device does not offer this kind of synchronization"
        }
        0x0029 => "use a DC mode in place of free run",
        0x002c | 0x0032 | 0x0033 => {
            "the device lost its synchronization; look at the DC deviation and at lost frames"
        }
        0x002d => {
            "SYNC0 never came: was it started before SafeOp, and is the reference clock's time distributed every cycle?"
        }
        0x002e => "raise `cycle`; 0x1C32:05 holds the shortest cycle that the device accepts",
        0x0030 => {
            "AssignActivate or shift do not fit: choose a `dc` mode that the ESI file offers, or the cycle time is not supported"
        }
        0x0035..=0x0037 => {
            "the device does not accept this cycle time; try a multiple of its base cycle, such as 1ms"
        }
        0x0043 => "a start-up SDO was refused or never answered",
        0x0050 | 0x0051 | 0x0014 => {
            "the EEPROM or firmware must be written again with the manufacturer's tool"
        }
        0x0060 => "the device restarted; look at its supply",
        0x0070 => "the ESI module that `mode` picks is not what the device has",
        0x0080 | 0x0081 => "look at the supply",
        0x0082 | 0x0083 => "look at the surroundings and the load",
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_that_ethercrab_knows_has_a_text() {
        use ethercrab::AlStatusCode;

        let known = (0..0x8000)
            .filter(|code| !matches!(AlStatusCode::from(*code), AlStatusCode::Unknown(_)));
        let missing: Vec<u16> = known
            .filter(|code| al_status_text(*code) == UNKNOWN)
            .collect();
        assert!(missing.is_empty(), "{missing:#06x?}");
    }

    #[test]
    fn unknown_codes_are_called_unknown_and_get_no_hint() {
        for code in [0x0005u16, 0x000f, 0x0040, 0x1234, 0x7fff, 0x8001, 0xffff] {
            assert_eq!(al_status_hint(code), None, "{code:#06x}");
        }
        assert_eq!(al_status_text(0x1234), "unknown AL status code");
        assert_eq!(
            al_status_text(0x8001),
            "manufacturer-specific AL status code"
        );
    }

    #[test]
    fn no_code_has_a_hint_without_a_text() {
        for code in 0..=u16::MAX {
            assert!(
                al_status_hint(code).is_none() || al_status_text(code) != UNKNOWN,
                "{code:#06x}"
            );
        }
    }
}
