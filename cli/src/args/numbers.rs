//! Numbers on the command line, decimal or hexadecimal.

pub(crate) fn number(text: &str) -> Result<u32, String> {
    let hex = text.strip_prefix("0x").or(text.strip_prefix("0X"));
    let value = hex.map_or_else(
        || text.parse().ok(),
        |hex| u32::from_str_radix(hex, 16).ok(),
    );
    value.ok_or_else(|| "a number of 32 bits, decimal or 0x…".to_owned())
}

pub(crate) fn number_16(text: &str) -> Result<u16, String> {
    let value = number(text)
        .ok()
        .and_then(|value| u16::try_from(value).ok());
    value.ok_or_else(|| "a number of 16 bits, decimal or 0x…".to_owned())
}
