//! The diagnosis history of a device, 0x10F3 (ETG.1020): the last messages of a failed device.

use crate::config::DeviceConfig;
use crate::mailbox::{DeviceMailbox, MailboxError};
use crate::report::DiagnosisMessage;

const HISTORY: u16 = 0x10f3;
/// The subindex of the maximum number of messages.
const MOST_KEPT: u8 = 1;
/// The subindex that names the newest message.
const NEWEST: u8 = 2;
/// The subindex of the first message.
const FIRST: u8 = 6;
/// The maximum number of messages that are read.
const MOST: usize = 3;

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
            Err(MailboxError::Sdo { source, .. }) if source.abort_code().is_some() => break,
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
}
