//! The diagnosis history of a device, 0x10F3 (ETG.1020): the last messages of a failed device.

use std::fmt;

use ecaxis_axis::cia402::describe;
use ecaxis_esi::model::DiagMessage;

use crate::config::DeviceConfig;
use crate::mailbox::{DeviceMailbox, MailboxError, SdoError};

const HISTORY: u16 = 0x10f3;
/// The subindex of the maximum number of messages.
const MOST_KEPT: u8 = 1;
/// The subindex that names the newest message.
const NEWEST: u8 = 2;
/// The subindex of the first message.
const FIRST: u8 = 6;
/// The maximum number of messages that are read.
const MOST: usize = 3;
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
    fn parse(bytes: &[u8], texts: &[DiagMessage]) -> Option<Self> {
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

/// Reads the newest messages of a device with a history, newest first.
///
/// # Errors
/// Fails if the device does not return them.
pub(super) async fn read(
    mailbox: &DeviceMailbox,
    config: &DeviceConfig,
) -> Result<Vec<DiagnosisMessage>, MailboxError> {
    let mut messages = Vec::new();
    if !keeps_history(config) {
        return Ok(messages);
    }
    let number = async |sub| {
        let bytes = mailbox.upload(HISTORY, sub).await?;
        Ok::<_, MailboxError>(bytes.first().copied().unwrap_or(0))
    };
    let (kept, newest) = (number(MOST_KEPT).await?, number(NEWEST).await?);
    for sub in newest_first(kept, newest) {
        let bytes = match mailbox.upload(HISTORY, sub).await {
            Ok(bytes) => bytes,
            // This entry holds no message yet.
            Err(MailboxError::Sdo {
                source: SdoError::Abort { .. },
                ..
            }) => break,
            Err(error) => return Err(error),
        };
        if bytes.iter().all(|byte| *byte == 0) {
            break;
        }
        messages.extend(DiagnosisMessage::parse(
            &bytes,
            &config.device.diag_messages,
        ));
    }
    Ok(messages)
}

/// Returns the subindices of the newest messages. The history is a ring: the last kept message
/// precedes the first.
fn newest_first(kept: u8, newest: u8) -> impl Iterator<Item = u8> {
    let last = FIRST.saturating_add(kept.saturating_sub(1)).max(newest);
    let there = newest >= FIRST;
    let round = (FIRST..=newest)
        .rev()
        .chain((newest.saturating_add(1)..=last).rev());
    round.filter(move |_| there).take(MOST)
}

fn keeps_history(config: &DeviceConfig) -> bool {
    let mailbox = config.device.mailbox.as_ref();
    let says_so = mailbox
        .and_then(|m| m.coe.as_ref())
        .is_some_and(|coe| coe.diag_history);
    says_so || config.selection.dictionary.object(HISTORY).is_some()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn newest_first_wraps_around_the_ring() {
        let table: [(u8, u8, &[u8]); 8] = [
            (8, 0, &[]),
            (8, 5, &[]),
            (1, 6, &[6]),
            (8, 6, &[6, 13, 12]),
            (8, 7, &[7, 6, 13]),
            (8, 13, &[13, 12, 11]),
            // Inconsistent values from the device.
            (0, 255, &[255, 254, 253]),
            (255, 6, &[6, 255, 254]),
        ];
        for (kept, newest, subs) in table {
            let order: Vec<_> = newest_first(kept, newest).collect();
            assert_eq!(order, subs, "{kept} kept, {newest} newest");
        }
    }

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
