//! Base type names → their index in the object dictionary (ETG.1020).

/// Returns the index of a base type in the object dictionary (ETG.1020), or 0 for other types.
pub(super) fn type_code(name: &str) -> u8 {
    match name {
        "BOOL" | "BIT" => 0x01,
        "SINT" => 0x02,
        "INT" => 0x03,
        "DINT" => 0x04,
        "USINT" => 0x05,
        "UINT" => 0x06,
        "UDINT" => 0x07,
        "REAL" => 0x08,
        "INT24" => 0x10,
        "LREAL" => 0x11,
        "LINT" => 0x15,
        "UINT24" => 0x16,
        "ULINT" => 0x1b,
        "BYTE" => 0x1e,
        "WORD" => 0x1f,
        "DWORD" => 0x20,
        "BITARR8" => 0x2d,
        "BITARR16" => 0x2e,
        "BITARR32" => 0x2f,
        _ if name.starts_with("STRING") => 0x09,
        _ => match name.strip_prefix("BIT").and_then(|bits| bits.parse().ok()) {
            Some(bits @ 1..=8) => 0x2f + bits,
            _ => 0,
        },
    }
}
