//! SDO abort codes (CiA 301, ETG.1000.6, ETG.1020, maxon).

use crate::codes::codes;

codes! {
    /// Returns the text of an SDO abort code; codes from 0x0F00_0000 on are maxon's.
    abort_text(u32), else {
        0x0f00_0000..=0x0fff_ffff => "manufacturer-specific abort code",
        _ => "unknown abort code",
    };
    NO_ABORT = 0x0000_0000, "no abort";
    TOGGLE = 0x0503_0000, "the toggle bit did not alternate";
    TIMEOUT = 0x0504_0000, "the SDO protocol timed out";
    INVALID_COMMAND = 0x0504_0001, "the command specifier is unknown";
    INVALID_BLOCK_SIZE = 0x0504_0002, "the block size is invalid";
    INVALID_SEQUENCE = 0x0504_0003, "the sequence number is invalid";
    CRC = 0x0504_0004, "the CRC is wrong";
    NO_MEMORY = 0x0504_0005, "out of memory";
    UNSUPPORTED_ACCESS = 0x0601_0000, "the object does not support this access";
    WRITE_ONLY = 0x0601_0001, "the object is write-only";
    READ_ONLY = 0x0601_0002, "the object is read-only";
    SUBINDEX_0_NOT_ZERO = 0x0601_0003, "the subindex cannot be written unless subindex 0 is 0";
    NO_COMPLETE_ACCESS = 0x0601_0004, "objects of variable length have no complete access";
    LONGER_THAN_MAILBOX = 0x0601_0005, "the object is longer than the mailbox";
    MAPPED_TO_RX_PDO = 0x0601_0006, "the object is mapped to an RxPDO, so it cannot be written";
    NO_OBJECT = 0x0602_0000, "the object does not exist";
    NOT_MAPPABLE = 0x0604_0041, "the object cannot be mapped to a PDO";
    PDO_TOO_LONG = 0x0604_0042, "the mapped objects would exceed the PDO's length";
    INCOMPATIBLE_PARAMETERS = 0x0604_0043, "the parameters are incompatible";
    INTERNAL_INCOMPATIBILITY = 0x0604_0047, "an incompatibility inside the device";
    HARDWARE = 0x0606_0000, "a hardware error prevented the access";
    TYPE_MISMATCH = 0x0607_0010, "the data type or its length does not match";
    DATA_TOO_LONG = 0x0607_0012, "the data is too long for the object";
    DATA_TOO_SHORT = 0x0607_0013, "the data is too short for the object";
    NO_SUBINDEX = 0x0609_0011, "the subindex does not exist";
    OUT_OF_RANGE = 0x0609_0030, "the value is out of range";
    TOO_HIGH = 0x0609_0031, "the value is too high";
    TOO_LOW = 0x0609_0032, "the value is too low";
    MODULES_DIFFER = 0x0609_0033, "the configured modules (0xF030) differ from the detected ones (0xF050)";
    MAX_BELOW_MIN = 0x0609_0036, "the maximum is below the minimum";
    NO_RESOURCE = 0x060a_0023, "a resource is not available";
    GENERAL = 0x0800_0000, "general error";
    NOT_STORED = 0x0800_0020, "the data cannot be transferred or stored";
    LOCAL_CONTROL = 0x0800_0021, "the data cannot be transferred or stored: the device is under local control";
    DEVICE_STATE = 0x0800_0022, "the data cannot be transferred or stored in the device's present state";
    NO_DICTIONARY = 0x0800_0023, "the device has no object dictionary";
    NO_DATA = 0x0800_0024, "no data available";
    CAN_ID = 0x0f00_ffb9, "the CAN ID is wrong (maxon)";
    NOT_IN_SERVICE_MODE = 0x0f00_ffbc, "the device is not in service mode (maxon)";
    PASSWORD = 0x0f00_ffbe, "the password is wrong (maxon)";
    ILLEGAL_COMMAND = 0x0f00_ffbf, "the command is illegal (maxon)";
    NMT_STATE = 0x0f00_ffc0, "the device is in the wrong NMT state (maxon)";
}

/// Returns true if the device does not have the object or the subindex.
#[must_use]
pub const fn is_no_such_object(code: u32) -> bool {
    matches!(code, NO_OBJECT | NO_SUBINDEX)
}
