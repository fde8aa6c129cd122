//! Messages of the diagnosis history, 0x10F3 (ETG.1020).

use std::fmt;

use ecaxis_axis::cia402::describe;
use ecaxis_esi::model::DiagMessage;

/// The low word of diagnosis codes whose high word is an emergency error code.
const ERROR_CODE: u32 = 0xe800;

/// One message of the diagnosis history.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DiagnosisMessage {
    pub kind: DiagnosisKind,
    /// The diagnosis code.
    pub code: u32,
    pub text_id: u16,
    /// The text from the ESI or of the error code. Placeholders of device parameters remain
    /// unchanged.
    pub text: Option<String>,
    /// The device's own time in ns; 0: none.
    pub time: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DiagnosisKind {
    Info,
    Warning,
    Error,
    Other(u8),
}

impl fmt::Display for DiagnosisMessage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.kind {
            DiagnosisKind::Info => f.write_str("info")?,
            DiagnosisKind::Warning => f.write_str("warning")?,
            DiagnosisKind::Error => f.write_str("error")?,
            DiagnosisKind::Other(kind) => write!(f, "message of type {kind}")?,
        }
        write!(f, " {:#010x}", self.code)?;
        match &self.text {
            Some(text) => write!(f, " ({text})"),
            None => write!(f, ", text {:#06x}", self.text_id),
        }
    }
}

impl DiagnosisMessage {
    /// Returns `None` if the bytes are too few.
    pub(crate) fn parse(bytes: &[u8], texts: &[DiagMessage]) -> Option<Self> {
        let (&code, rest) = bytes.split_first_chunk::<4>()?;
        let (&flags, rest) = rest.split_first_chunk::<2>()?;
        let (&text_id, rest) = rest.split_first_chunk::<2>()?;
        let time = rest
            .first_chunk::<8>()
            .map_or(0, |time| u64::from_le_bytes(*time));
        let (code, text_id) = (u32::from_le_bytes(code), u16::from_le_bytes(text_id));
        let text = texts
            .iter()
            .find(|text| text.text_id == text_id && text_id != 0);
        let [error_low, error_high] = [(code >> 16) as u8, (code >> 24) as u8];
        let error = (code & 0xffff == ERROR_CODE).then(|| {
            describe(u16::from_le_bytes([error_low, error_high]))
                .text
                .to_owned()
        });
        Some(Self {
            kind: match u16::from_le_bytes(flags) & 0x0f {
                0 => DiagnosisKind::Info,
                1 => DiagnosisKind::Warning,
                2 => DiagnosisKind::Error,
                other => DiagnosisKind::Other(other as u8),
            },
            code,
            text_id,
            text: text.map(|text| text.text.clone()).or(error),
            time,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn diagnosis_message_parses_as_in_etg_1020() {
        let texts = [DiagMessage {
            text_id: 0x0102,
            text: "Supply voltage %f too low".to_owned(),
        }];
        let mut bytes = vec![0x00, 0xe8, 0x20, 0x32, 0x02, 0x00, 0x00, 0x00];
        let parse = |bytes: &[u8]| DiagnosisMessage::parse(bytes, &texts).map(|m| m.to_string());
        let undervoltage = describe(0x3220).text;
        let reported = Some(format!("error 0x3220e800 ({undervoltage})"));
        assert_eq!(parse(&bytes), reported, "without a time");
        bytes.extend(7_u64.to_le_bytes());
        assert_eq!(parse(&bytes), reported);
        assert_eq!(
            DiagnosisMessage::parse(&bytes, &[]).map(|m| m.time),
            Some(7)
        );
        bytes[..8].copy_from_slice(&[0x34, 0xe1, 0, 0, 1, 2, 2, 1]);
        let reported = "warning 0x0000e134 (Supply voltage %f too low)";
        assert_eq!(parse(&bytes).as_deref(), Some(reported));
        bytes[6] = 9;
        bytes[4] = 7;
        let reported = "message of type 7 0x0000e134, text 0x0109";
        assert_eq!(parse(&bytes).as_deref(), Some(reported));
        for len in 0..8 {
            assert_eq!(parse(&bytes[..len]), None, "{len} bytes");
        }
    }
}
