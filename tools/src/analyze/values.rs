//! Formats object values.

use super::mailbox::Transfer;
use ecaxis_master::parameters::meaning::meaning;

/// The maximum number of bytes shown of a value that is neither a number nor a text.
const SHOWN: usize = 16;

/// Formats the value of a transfer: a number of up to eight bytes, a text, or bytes.
pub fn value(transfer: &Transfer) -> String {
    let data = &transfer.data;
    if let Some(text) = printable(data, matches!(transfer.index, 0x1008..=0x100a)) {
        return format!("\"{text}\"");
    }
    if !transfer.complete && matches!(transfer.len, 1..=4 | 8) && data.len() == transfer.len {
        let raw = data
            .iter()
            .rev()
            .fold(0_u64, |n, byte| n << 8 | u64::from(*byte));
        let width = 2 * data.len();
        let bits = 8 * u32::try_from(data.len()).unwrap_or(8);
        let signed = (raw as i64) << (64 - bits) >> (64 - bits);
        let number = match (raw, signed) {
            (0..=9, _) => format!("{raw}"),
            (_, -1_000_000..0) if bits >= 16 => format!("{signed} (0x{raw:0width$x})"),
            _ => format!("{raw} (0x{raw:0width$x})"),
        };
        return match meaning(transfer.index, transfer.sub, data) {
            Some(text) => format!("{number}: {text}"),
            None => number,
        };
    }
    let bytes = data.iter().take(SHOWN).map(|byte| format!("{byte:02x}"));
    let shown = bytes.collect::<Vec<_>>().join(" ");
    match transfer.len {
        0 => "nothing".to_owned(),
        len if len > SHOWN => format!("{shown} … ({len} bytes)"),
        _ => shown,
    }
}

/// Returns the text if it is printable, and longer than a number or known to be a text.
fn printable(data: &[u8], known: bool) -> Option<String> {
    let end = data.iter().rposition(|byte| *byte != 0)? + 1;
    let text = data.get(..end)?;
    let readable = text.iter().all(|byte| (0x20..0x7f).contains(byte));
    (readable && (known || data.len() > 4 && text.len() > 2))
        .then(|| text.iter().take(80).map(|byte| char::from(*byte)).collect())
}
