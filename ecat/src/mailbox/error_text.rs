//! Texts of error codes: SDO abort codes (CiA 301, ETG.1000.6, ETG.1020, maxon) and mailbox error
//! codes (ETG.1000.4).

/// Returns the text of an SDO abort code; codes from 0x0F00_0000 on are maxon's.
#[must_use]
pub fn abort_text(code: u32) -> &'static str {
    match code {
        0x0000_0000 => "no abort",
        0x0503_0000 => "the toggle bit did not alternate",
        0x0504_0000 => "the SDO protocol timed out",
        0x0504_0001 => "the command specifier is unknown",
        0x0504_0002 => "the block size is invalid",
        0x0504_0003 => "the sequence number is invalid",
        0x0504_0004 => "the CRC is wrong",
        0x0504_0005 => "out of memory",
        0x0601_0000 => "the object does not support this access",
        0x0601_0001 => "the object is write-only",
        0x0601_0002 => "the object is read-only",
        0x0601_0003 => "the subindex cannot be written unless subindex 0 is 0",
        0x0601_0004 => "objects of variable length have no complete access",
        0x0601_0005 => "the object is longer than the mailbox",
        0x0601_0006 => "the object is mapped to an RxPDO, so it cannot be written",
        0x0602_0000 => "the object does not exist",
        0x0604_0041 => "the object cannot be mapped to a PDO",
        0x0604_0042 => "the mapped objects would exceed the PDO's length",
        0x0604_0043 => "the parameters are incompatible",
        0x0604_0047 => "an incompatibility inside the device",
        0x0606_0000 => "a hardware error prevented the access",
        0x0607_0010 => "the data type or its length does not match",
        0x0607_0012 => "the data is too long for the object",
        0x0607_0013 => "the data is too short for the object",
        0x0609_0011 => "the subindex does not exist",
        0x0609_0030 => "the value is out of range",
        0x0609_0031 => "the value is too high",
        0x0609_0032 => "the value is too low",
        0x0609_0033 => "the configured modules (0xF030) differ from the detected ones (0xF050)",
        0x0609_0036 => "the maximum is below the minimum",
        0x060a_0023 => "a resource is not available",
        0x0800_0000 => "general error",
        0x0800_0020 => "the data cannot be transferred or stored",
        0x0800_0021 => {
            "the data cannot be transferred or stored: the device is under local control"
        }
        0x0800_0022 => "the data cannot be transferred or stored in the device's present state",
        0x0800_0023 => "the device has no object dictionary",
        0x0800_0024 => "no data available",
        0x0f00_ffb9 => "the CAN ID is wrong (maxon)",
        0x0f00_ffbc => "the device is not in service mode (maxon)",
        0x0f00_ffbe => "the password is wrong (maxon)",
        0x0f00_ffbf => "the command is illegal (maxon)",
        0x0f00_ffc0 => "the device is in the wrong NMT state (maxon)",
        0x0f00_0000..=0x0fff_ffff => "manufacturer-specific abort code",
        _ => "unknown abort code",
    }
}

/// Returns the text of the code in a mailbox error reply.
#[must_use]
pub fn mailbox_error_text(code: u16) -> &'static str {
    match code {
        0x0001 => "the mailbox header is wrong",
        0x0002 => "the mailbox protocol is not supported",
        0x0003 => "the channel field is wrong",
        0x0004 => "the service is not supported",
        0x0005 => "the protocol header is wrong",
        0x0006 => "the message is too short",
        0x0007 => "out of memory",
        0x0008 => "the lengths contradict each other",
        _ => "unknown mailbox error code",
    }
}
