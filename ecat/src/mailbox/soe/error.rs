//! SoE error codes (ETG.1000.6, table of SoE errors; IEC 61800-7-204 service channel errors).

macro_rules! errors {
    ($($code:literal => $text:literal,)*) => {
        /// All error codes with their texts, sorted by code.
        pub const ERROR_CODES: &[(u16, &str)] = &[$(($code, $text),)*];

        /// Returns the text of an SoE error code.
        #[must_use]
        pub const fn soe_error_text(code: u16) -> &'static str {
            match code {
                $($code => $text,)*
                _ => "unknown SoE error code",
            }
        }
    };
}

errors! {
    0x0000 => "no error",
    0x0001 => "the service channel is not open",
    0x0009 => "invalid access to closing the service channel",
    0x1001 => "the drive has no such IDN",
    0x1009 => "invalid access to element 1",
    0x2001 => "it has no name",
    0x2002 => "the name is too short",
    0x2003 => "the name is too long",
    0x2004 => "the name is read-only",
    0x2005 => "the name is write-protected at this time",
    0x3002 => "the attribute is too short",
    0x3003 => "the attribute is too long",
    0x3004 => "the attribute is read-only",
    0x3005 => "the attribute is write-protected at this time",
    0x4001 => "it has no unit",
    0x4002 => "the unit is too short",
    0x4003 => "the unit is too long",
    0x4004 => "the unit is read-only",
    0x4005 => "the unit is write-protected at this time",
    0x5001 => "it has no minimum",
    0x5002 => "the minimum is too short",
    0x5003 => "the minimum is too long",
    0x5004 => "the minimum is read-only",
    0x5005 => "the minimum is write-protected at this time",
    0x6001 => "it has no maximum",
    0x6002 => "the maximum is too short",
    0x6003 => "the maximum is too long",
    0x6004 => "the maximum is read-only",
    0x6005 => "the maximum is write-protected at this time",
    0x7002 => "the value is too short",
    0x7003 => "the value is too long",
    0x7004 => "the value is read-only",
    0x7005 => "the value is write-protected in this state",
    0x7006 => "the value is below the minimum",
    0x7007 => "the value is above the maximum",
    0x7008 => "the value is invalid: an unsupported IDN, bit or combination of bits",
    0x7009 => "the value is protected by a password",
    0x700a => "the value is write-protected: process data carries it",
    0x700b => "invalid indirect addressing, such as a data container or a list",
    0x700c => "the value is write-protected by other settings",
    0x700d => "the value is an invalid floating-point number",
    0x700e => "the value is write-protected at parameterization level",
    0x700f => "the value is write-protected at operating level",
    0x7010 => "the procedure command is already active",
    0x7011 => "the procedure command cannot be interrupted",
    0x7012 => "the procedure command cannot be executed in this state",
    0x7013 => "the procedure command cannot be executed: invalid or false parameters",
    0x7014 => "it has no data state",
    0x8001 => "it has no default value",
    0x8002 => "the default value is too long",
    0x8004 => "the default value is read-only",
    0x800a => "the device has no such drive",
    0x800b => "general error",
    0x800c => "no element is addressed",
}

/// The errors of class 1 in the order of the bits of S-0-0011 (IEC 61800-7-204).
pub const CLASS_1_DIAGNOSTICS: [&str; 16] = [
    "overload shutdown",
    "amplifier overtemperature",
    "motor overtemperature",
    "cooling error",
    "control voltage error",
    "feedback error",
    "commutation error",
    "overcurrent",
    "overvoltage",
    "undervoltage",
    "error of the power supply phases",
    "excessive position deviation",
    "communication error",
    "travel limit exceeded",
    "reserved bit 14",
    "manufacturer-specific error (S-0-0129)",
];

/// Returns the texts of the bits of S-0-0011 that are set.
pub fn class_1_texts(bits: u16) -> impl Iterator<Item = &'static str> {
    let all = (0..).zip(CLASS_1_DIAGNOSTICS);
    all.filter(move |(bit, _)| bits >> bit & 1 != 0)
        .map(|(_, text)| text)
}
