//! Error codes (0x603F, and the first word of an emergency): CiA 301/402 classes, maxon EPOS4 and
//! IDX codes.
//!
//! The text describes the fault; the hint names the first thing to check.

/// The description of an error code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Description {
    /// The meaning of the code.
    pub text: &'static str,
    /// Possible causes and remedies.
    pub hint: &'static str,
    /// True if the code is listed. Otherwise the text describes its class.
    pub exact: bool,
}

/// Returns text and hint of any code. A code that is not listed gets the text of its class.
#[must_use]
pub fn describe(code: u16) -> Description {
    let exact = CODES
        .binary_search_by_key(&code, |row| row.0)
        .ok()
        .and_then(|at| CODES.get(at));
    if let Some(&(_, text, hint)) = exact {
        return Description {
            text,
            hint,
            exact: true,
        };
    }
    let (text, hint) = CLASSES
        .iter()
        .find(|(mask, value, _, _)| code & mask == *value)
        .map_or(
            ("error code not listed", "look it up in the drive's manual"),
            |(_, _, text, hint)| (*text, *hint),
        );
    Description {
        text,
        hint,
        exact: false,
    }
}

const INTERNAL: &str =
    "power-cycle the drive; if it returns, update the firmware or replace the drive";
const TUNING: &str = "repeat the tuning with the load free to move and the motor data checked";
const BUS: &str = "check cables and bus load; look at the drive's link and error counters";
const MAPPING: &str = "compare the PDO mapping the drive accepted with the one the master uses";

/// Sorted by code.
#[rustfmt::skip]
const CODES: &[(u16, &str, &str)] = &[
    (0x0000, "no error", "nothing to do"),
    (0x1000, "generic error", "read the drive's error history (0x1003)"),
    (0x1080, "generic initialization error", INTERNAL),
    (0x1081, "generic initialization error", INTERNAL),
    (0x1082, "generic initialization error", INTERNAL),
    (0x1083, "generic initialization error", INTERNAL),
    (0x1090, "firmware incompatibility", "load a firmware that fits the hardware"),
    (0x2220, "continuous overcurrent inside the drive", "reduce load and acceleration; check motor data"),
    (0x2310, "overcurrent", "check the winding for a short, then current limit, controller gains and acceleration"),
    (0x2320, "short circuit, or power stage protection", "check motor cable and winding for shorts before switching on again"),
    (0x3130, "phase failure", "check the mains phases"),
    (0x3210, "DC link overvoltage", "braking feeds energy back: decelerate slower or add a brake chopper; check the supply"),
    (0x3220, "DC link undervoltage", "check the power supply's voltage and its current limit under acceleration"),
    (0x4210, "power stage too hot", "improve cooling, reduce the load's duty"),
    (0x4310, "drive too hot", "improve cooling, reduce the load's duty"),
    (0x4380, "motor too hot (I²t)", "reduce the load, check rated current and thermal time constant of the motor data"),
    (0x5112, "24 V supply low", "check the logic supply"),
    (0x5113, "logic supply voltage too low", "check the logic supply and what hangs on the drive's 5 V outputs"),
    (0x5114, "power stage supply too low", "check the power supply"),
    (0x5280, "hardware defect", INTERNAL),
    (0x5281, "hardware incompatibility", INTERNAL),
    (0x5480, "hardware error", INTERNAL),
    (0x5481, "hardware error", INTERNAL),
    (0x5482, "hardware error", INTERNAL),
    (0x5483, "hardware error", INTERNAL),
    (0x6010, "software reset by the watchdog", INTERNAL),
    (0x6080, "sign of life error", INTERNAL),
    (0x6081, "extension watchdog error", INTERNAL),
    (0x6180, "internal software error", INTERNAL),
    (0x6320, "software parameter error", "a start-up SDO has a value the drive cannot use; restore defaults and check them one by one"),
    (0x6380, "stored parameters corrupt", "restore and store the default parameters, then configure again"),
    (0x7121, "motor blocked", "free the mechanics, check the brake"),
    (0x7300, "sensor error", "check encoder cable and supply"),
    (0x7305, "incremental sensor 1 error", "check encoder cable, supply and resolution"),
    (0x7310, "speed error", "check encoder direction, motor phases and velocity gains"),
    (0x7320, "position sensor error", "check encoder cable, supply and resolution"),
    (0x7380, "position sensor breach", "check encoder cable and mounting; the motor may also be blocked"),
    (0x7381, "position sensor resolution does not fit", "set the encoder's pulses per turn (after which the position is lost: home again)"),
    (0x7382, "encoder index not found", "check the index channel's wiring, or select an encoder type without index"),
    (0x7388, "impossible Hall sensor pattern", "check Hall sensor cable and supply, and the sensor type setting"),
    (0x7389, "Hall sensor not found", "check Hall sensor cable and supply, and the sensor type setting"),
    (0x738A, "angle between encoder and Hall sensors wrong", "check encoder resolution, pole pairs and the mounting of both"),
    (0x738C, "SSI sensor error", "check cable, supply, data rate and number of bits"),
    (0x738D, "SSI sensor frame error", "check data rate, number of bits and encoding"),
    (0x7390, "main sensor missing", "assign a sensor to the control structure"),
    (0x7391, "commutation sensor missing", "assign a sensor that commutation can use"),
    (0x7392, "main sensor counts the wrong way", "swap the encoder's direction setting or two motor phases"),
    (0x7500, "communication error inside the drive", INTERNAL),
    (0x8110, "CAN overrun, objects lost", BUS),
    (0x8111, "CAN overrun", BUS),
    (0x8120, "CAN passive mode", BUS),
    (0x8130, "heartbeat or life guard error", BUS),
    (0x8140, "recovered from bus off", BUS),
    (0x8150, "COB-ID collision", "give every node its own identifiers"),
    (0x8180, "EtherCAT communication error", "frames stopped arriving or the master left Op: check cables and the master's cycle"),
    (0x8181, "EtherCAT initialization error", "read the AL status code; check the start-up settings"),
    (0x8182, "EtherCAT receive queue overflow", "fewer mailbox requests at a time"),
    (0x8183, "EtherCAT communication error inside the drive", INTERNAL),
    (0x8184, "EtherCAT cycle time error", "0x60C2 and the SYNC0 period must be the bus cycle, and one the drive supports"),
    (0x81FD, "CAN bus off", BUS),
    (0x81FE, "CAN receive queue overflow", BUS),
    (0x81FF, "CAN transmit queue overflow", BUS),
    (0x8210, "PDO not processed: wrong length", MAPPING),
    (0x8220, "PDO too long", MAPPING),
    (0x8250, "RxPDO timeout", "no process data within the drive's timeout: check the cycle and lost frames"),
    (0x8280, "EtherCAT PDO communication error", MAPPING),
    (0x8281, "EtherCAT SDO communication error", BUS),
    (0x8311, "excess torque", "reduce load or acceleration, check the mechanics"),
    (0x8611, "following error", "reduce velocity and acceleration, check for a blocked load, tune the position controller, or widen 0x6065"),
    (0x8612, "reference limit", "move back inside the range; check the homing offset"),
    (0x8A80, "negative limit switch", "move away in positive direction; check the switch's polarity"),
    (0x8A81, "positive limit switch", "move away in negative direction; check the switch's polarity"),
    (0x8A82, "software position limit", "the set-point is outside 0x607D; compare it with limits.position"),
    (0x8A88, "safe torque off", "both STO inputs must be powered before the axis can be enabled"),
    (0xFF01, "drive overloaded", "fewer features at a time, or a longer cycle"),
    (0xFF02, "watchdog error", INTERNAL),
    (0xFF0B, "drive overloaded for a moment", "fewer features at a time, or a longer cycle"),
    (0xFF10, "controller gain error", "check the controller gains and the motor data they were computed from"),
    (0xFF11, "auto tuning: identification failed", TUNING),
    (0xFF12, "auto tuning: current limit", "raise the current limit or reduce the load"),
    (0xFF13, "auto tuning: identification current", TUNING),
    (0xFF14, "auto tuning: data sampling", TUNING),
    (0xFF15, "auto tuning: samples do not match", TUNING),
    (0xFF16, "auto tuning: parameter", TUNING),
    (0xFF17, "auto tuning: amplitudes do not match", TUNING),
    (0xFF18, "auto tuning: period length", TUNING),
    (0xFF19, "auto tuning: timeout", TUNING),
    (0xFF20, "auto tuning: not at standstill", TUNING),
    (0xFF21, "auto tuning: torque invalid", TUNING),
    (0xFF22, "auto tuning: speed too high", TUNING),
    (0xFF23, "auto tuning: motor connection", "check the motor cable"),
    (0xFF24, "auto tuning: sensor signal", "check the encoder cable"),
];

/// Mask and value; the first matching row applies.
#[rustfmt::skip]
const CLASSES: &[(u16, u16, &str, &str)] = &[
    (0xFF00, 0x0000, "error reset or no error", "nothing to do"),
    (0xFF00, 0x1000, "generic error", "read the drive's error history (0x1003)"),
    (0xF000, 0x2000, "current error", "check motor cable, winding and current limits"),
    (0xF000, 0x3000, "voltage error", "check mains and supply voltages"),
    (0xF000, 0x4000, "temperature error", "let it cool; check cooling and load"),
    (0xF000, 0x5000, "drive hardware error", INTERNAL),
    (0xFFF0, 0x6180, "internal software error", INTERNAL),
    (0xFFF0, 0x6190, "internal software error", INTERNAL),
    (0xFF00, 0x6300, "data set error", "check the start-up SDOs; restore defaults"),
    (0xF000, 0x6000, "drive software error", INTERNAL),
    (0xFF00, 0x7100, "power module or brake error", "check motor, brake and brake chopper"),
    (0xFF00, 0x7300, "sensor error", "check encoder cable, supply and settings"),
    (0xFF00, 0x7500, "communication error inside the drive", INTERNAL),
    (0xF000, 0x7000, "additional module error", "check what is attached to the drive"),
    (0xFF00, 0x8100, "communication error", BUS),
    (0xFF00, 0x8200, "protocol error", MAPPING),
    (0xFF00, 0x8300, "torque control error", "check load, torque limits and motor data"),
    (0xFF00, 0x8400, "velocity control error", "check velocity limits and controller gains"),
    (0xFF00, 0x8500, "position control error", "check position limits and controller gains"),
    (0xFF00, 0x8600, "positioning error", "check load, following error window and ranges"),
    (0xFF00, 0x8700, "synchronisation error", "check distributed clocks, SYNC0 period and shift"),
    (0xF000, 0x8000, "monitoring error", "look it up in the drive's manual"),
    (0xFF00, 0x9000, "external error", "check the drive's digital inputs"),
    (0xFF00, 0xF000, "additional function error", "look it up in the drive's manual"),
    (0xFF00, 0xFF00, "device specific error", "look it up in the drive's manual"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_sorted_for_the_search() {
        assert!(CODES.windows(2).all(|pair| pair[0].0 < pair[1].0));
    }

    #[test]
    fn codes_get_their_own_or_their_class_text() {
        assert_eq!(describe(0x8611).text, "following error");
        assert!(describe(0x8611).exact);
        assert_eq!(describe(0x2399).text, "current error");
        assert!(!describe(0x2399).exact);
        assert_eq!(describe(0x618A).text, "internal software error");
        assert_eq!(describe(0xB123).text, "error code not listed");
    }

    #[test]
    fn every_code_has_text_and_hint() {
        for code in 0..=u16::MAX {
            let d = describe(code);
            assert!(!d.text.is_empty() && !d.hint.is_empty());
        }
    }
}
