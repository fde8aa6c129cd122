//! AL status codes (register 0x0134): why a SubDevice refused a state change or left a state. The
//! texts paraphrase the tables of ETG.1000.6 and ETG.1020.
//!
//! ```
//! use ecaxis_ecat::al_status_code::{al_status_hint, al_status_text};
//!
//! assert_eq!(al_status_text(0x0020), "the device needs a cold start");
//! assert_eq!(al_status_hint(0x0020), Some("switch the device off and on again"));
//! ```

use crate::codes::codes;

const UNKNOWN: &str = "unknown AL status code";

codes! {
    /// Returns the text of an AL status code. Codes from 0x8000 on are vendor-specific.
    al_status_text(u16), else {
        0x8000..=0xffff => "manufacturer-specific AL status code",
        _ => UNKNOWN,
    };
    NO_ERROR = 0x0000, "no error";
    UNSPECIFIED_ERROR = 0x0001, "unspecified error";
    NO_MEMORY = 0x0002, "out of memory";
    INVALID_DEVICE_SETUP = 0x0003, "invalid device setup";
    INVALID_REVISION = 0x0004, "the configuration does not fit this hardware or software revision";
    RESERVED = 0x0005, "reserved for compatibility";
    EEPROM_MISMATCH = 0x0006, "the EEPROM does not fit the firmware";
    UPDATE_FAILED = 0x0007, "the firmware update failed, the old firmware still runs";
    LICENCE_ERROR = 0x000e, "licence error";
    INVALID_STATE_CHANGE = 0x0011, "invalid state change requested";
    UNKNOWN_STATE = 0x0012, "unknown state requested";
    BOOTSTRAP_UNSUPPORTED = 0x0013, "bootstrap is not supported";
    NO_VALID_FIRMWARE = 0x0014, "no valid firmware";
    INVALID_BOOTSTRAP_MAILBOX = 0x0015, "invalid mailbox configuration for bootstrap";
    INVALID_PRE_OP_MAILBOX = 0x0016, "invalid mailbox configuration for PreOp";
    INVALID_SYNC_MANAGER = 0x0017, "invalid SyncManager configuration";
    NO_VALID_INPUTS = 0x0018, "no valid inputs available";
    NO_VALID_OUTPUTS = 0x0019, "no valid outputs";
    SYNC_ERROR = 0x001a, "synchronization error";
    SYNC_MANAGER_WATCHDOG = 0x001b, "SyncManager watchdog";
    INVALID_SYNC_MANAGER_TYPES = 0x001c, "invalid SyncManager types";
    INVALID_OUTPUT_CONFIGURATION = 0x001d, "invalid output configuration";
    INVALID_INPUT_CONFIGURATION = 0x001e, "invalid input configuration";
    INVALID_WATCHDOG = 0x001f, "invalid watchdog configuration";
    NEEDS_COLD_START = 0x0020, "the device needs a cold start";
    NEEDS_INIT = 0x0021, "the device needs Init";
    NEEDS_PRE_OP = 0x0022, "the device needs PreOp";
    NEEDS_SAFE_OP = 0x0023, "the device needs SafeOp";
    INVALID_INPUT_MAPPING = 0x0024, "invalid input mapping";
    INVALID_OUTPUT_MAPPING = 0x0025, "invalid output mapping";
    INCONSISTENT_SETTINGS = 0x0026, "inconsistent settings";
    FREE_RUN_UNSUPPORTED = 0x0027, "free run is not supported";
    SYNC_MODE_UNSUPPORTED = 0x0028, "the synchronization mode is not supported";
    FREE_RUN_NEEDS_BUFFERS = 0x0029, "free run needs buffered SyncManagers";
    BACKGROUND_WATCHDOG = 0x002a, "background watchdog";
    NO_VALID_INPUTS_AND_OUTPUTS = 0x002b, "no valid inputs and outputs";
    FATAL_SYNC_ERROR = 0x002c, "fatal synchronization error: SYNC0 or SYNC1 stopped";
    NO_SYNC = 0x002d, "no synchronization: SYNC0 or SYNC1 was never seen";
    CYCLE_TOO_SHORT = 0x002e, "the cycle time is too short for the device";
    INVALID_DC_SYNC = 0x0030, "invalid DC SYNC configuration";
    INVALID_DC_LATCH = 0x0031, "invalid DC latch configuration";
    PLL_ERROR = 0x0032, "PLL error: not synchronized to the MainDevice";
    DC_SYNC_IO_ERROR = 0x0033, "DC: I/O error of the synchronization";
    DC_SYNC_MISSED = 0x0034, "DC: too many SYNC events missed";
    INVALID_SYNC_CYCLE = 0x0035, "DC: invalid SYNC cycle time";
    INVALID_SYNC0_CYCLE = 0x0036, "DC: the SYNC0 cycle time does not fit";
    INVALID_SYNC1_CYCLE = 0x0037, "DC: the SYNC1 cycle time does not fit";
    AOE_ERROR = 0x0041, "error of the AoE mailbox";
    EOE_ERROR = 0x0042, "error of the EoE mailbox";
    COE_ERROR = 0x0043, "error of the CoE mailbox";
    FOE_ERROR = 0x0044, "error of the FoE mailbox";
    SOE_ERROR = 0x0045, "error of the SoE mailbox";
    VOE_ERROR = 0x004f, "error of the VoE mailbox";
    NO_EEPROM_ACCESS = 0x0050, "the device has no access to its EEPROM";
    EEPROM_ERROR = 0x0051, "EEPROM error";
    HARDWARE_NOT_READY = 0x0052, "external hardware is not ready";
    RESTARTED = 0x0060, "the device restarted by itself";
    IDENTIFICATION_CHANGED = 0x0061, "the device identification was changed";
    MODULES_DIFFER = 0x0070, "the configured modules (0xF030) differ from the detected ones (0xF050)";
    SUPPLY_TOO_LOW = 0x0080, "the supply voltage is too low";
    SUPPLY_TOO_HIGH = 0x0081, "the supply voltage is too high";
    TEMPERATURE_TOO_LOW = 0x0082, "the temperature is too low";
    TEMPERATURE_TOO_HIGH = 0x0083, "the temperature is too high";
    CONTROLLER_AVAILABLE = 0x00f0, "the application controller is available";
}

/// Codes that follow from a lost synchronization.
pub const SYNC_LOST: [u16; 5] = [
    SYNC_ERROR,
    FATAL_SYNC_ERROR,
    NO_SYNC,
    PLL_ERROR,
    DC_SYNC_MISSED,
];

/// Returns a hint for codes that a wrong configuration or an unsuitable host causes.
pub fn al_status_hint(code: u16) -> Option<&'static str> {
    Some(match code {
        INVALID_DEVICE_SETUP | INVALID_REVISION | EEPROM_MISMATCH => {
            "the ESI file may describe another revision of this device; compare it with the revision that it reports"
        }
        INVALID_STATE_CHANGE | UNKNOWN_STATE => {
            "the state must be changed step by step; power-cycle the device if it persists"
        }
        BOOTSTRAP_UNSUPPORTED => {
            "the device has no Bootstrap: update its firmware as its manual describes, often in PreOp or with its vendor's tool"
        }
        INVALID_BOOTSTRAP_MAILBOX | INVALID_PRE_OP_MAILBOX => {
            "mailbox addresses and lengths must be those of SM0 and SM1 in the ESI file of this very revision"
        }
        INVALID_SYNC_MANAGER | INVALID_SYNC_MANAGER_TYPES => {
            "SyncManager addresses, lengths and control bytes must be those of the ESI file of this very revision"
        }
        NO_VALID_INPUTS | NO_VALID_INPUTS_AND_OUTPUTS => {
            "the device has no inputs to send yet; look at its own error code (0x603F) and supply"
        }
        NO_VALID_OUTPUTS => {
            "valid outputs must already arrive when Op is requested; is the cyclic exchange running?"
        }
        SYNC_ERROR | DC_SYNC_MISSED => {
            "frames arrive at the wrong time; check the host's jitter and the DC shift of the ESI's mode"
        }
        SYNC_MANAGER_WATCHDOG => {
            "no process data for longer than the watchdog allows: a cable, lost frames, or a delayed host; if the device refuses Op, no outputs have reached it in SafeOp"
        }
        INVALID_OUTPUT_CONFIGURATION => {
            "the length of the outputs' SyncManager differs from the assigned RxPDOs (0x1C12); did a start-up SDO fail, or does the mapping differ? Some firmware refuses the watchdog trigger: see `watchdog_trigger`"
        }
        INVALID_INPUT_CONFIGURATION => {
            "the length of the inputs' SyncManager differs from the assigned TxPDOs (0x1C13); did a start-up SDO fail, or does the mapping differ?"
        }
        INVALID_WATCHDOG => {
            "the device does not accept this watchdog time; leave `watchdog` out to get the default"
        }
        NEEDS_COLD_START => "switch the device off and on again",
        INVALID_INPUT_MAPPING => "an object in `pdo.tx` cannot be mapped, or its length is wrong",
        INVALID_OUTPUT_MAPPING => "an object in `pdo.rx` cannot be mapped, or its length is wrong",
        INCONSISTENT_SETTINGS => {
            "two settings contradict each other: often the mode of operation and the mapped objects, or the cycle time and 0x60C2"
        }
        FREE_RUN_UNSUPPORTED | SYNC_MODE_UNSUPPORTED => {
            "choose another `dc` mode: the device does not offer this kind of synchronization"
        }
        FREE_RUN_NEEDS_BUFFERS => "use a DC mode in place of free run",
        FATAL_SYNC_ERROR | PLL_ERROR | DC_SYNC_IO_ERROR => {
            "the device lost its synchronization; look at the DC deviation and at lost frames"
        }
        NO_SYNC => {
            "SYNC0 never came: was it started before SafeOp, and is the reference clock's time distributed every cycle?"
        }
        CYCLE_TOO_SHORT => {
            "raise `cycle`; 0x1C32:05 holds the shortest cycle that the device accepts"
        }
        INVALID_DC_SYNC => {
            "AssignActivate or shift do not fit: choose a `dc` mode that the ESI file offers, or the cycle time is not supported"
        }
        INVALID_SYNC_CYCLE..=INVALID_SYNC1_CYCLE => {
            "the device does not accept this cycle time; try a multiple of its base cycle, such as 1ms"
        }
        COE_ERROR => "a start-up SDO was refused or never answered",
        NO_EEPROM_ACCESS | EEPROM_ERROR | NO_VALID_FIRMWARE => {
            "the EEPROM or firmware must be written again with the manufacturer's tool"
        }
        HARDWARE_NOT_READY => {
            "the device waits for what is connected to it: check the supply of its power stage, its encoder, modules and safety inputs, then start again"
        }
        RESTARTED => "the device restarted; look at its supply",
        MODULES_DIFFER => {
            "the modules in its slots (0xF050) are not those that `modules` or `mode` configures; `ecaxis compare` shows both"
        }
        SUPPLY_TOO_LOW | SUPPLY_TOO_HIGH => "look at the supply",
        TEMPERATURE_TOO_LOW | TEMPERATURE_TOO_HIGH => "look at the surroundings and the load",
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
