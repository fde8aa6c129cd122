//! One client: its telegrams in, the answers out, and the devices that its transfers reserve.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use ecaxis_ecat::mailbox::abort_code;
use ecaxis_ecat::mailbox::gateway::Telegram;
use ecaxis_ecat::mailbox::{ERROR_MEMORY, TYPE_COE, coe};
use tokio::time::Instant;

use super::Gateway;
use super::access::{mailbox_error, sdo_abort};
use crate::mailbox::{MailboxError, MailboxSession, RawAnswer, RawMessage};

/// How long a device stays reserved for the next message of a transfer.
pub(super) const HOLD: Duration = Duration::from_secs(2);
/// The station address of the MainDevice.
const MAIN_DEVICE: u16 = 0;

#[derive(Debug)]
pub(super) struct Client {
    gateway: Arc<Gateway>,
    /// The devices with a transfer of this client, and when they are free again.
    held: HashMap<u16, (MailboxSession, Instant)>,
}

/// Returns the frame with an answer to a request.
fn frame_of(request: &Telegram<'_>, answer: &RawMessage) -> Vec<u8> {
    let mut frame = Vec::new();
    let answer = Telegram {
        // Devices may leave the address empty, and have a counter of their own.
        station: request.station,
        counter: request.counter,
        channel: answer.channel,
        protocol: answer.protocol,
        body: &answer.body,
    };
    answer.emit_frame(&mut frame);
    frame
}

/// Returns the error that answers a request beyond the limit; empty for a damaged request.
pub(super) fn refusal(frame: &[u8]) -> Vec<u8> {
    let request = Telegram::parse(frame);
    request.map_or_else(
        |_| Vec::new(),
        |request| frame_of(&request, &mailbox_error(ERROR_MEMORY)),
    )
}

impl Client {
    pub(super) fn new(gateway: &Arc<Gateway>) -> Self {
        Self {
            gateway: Arc::clone(gateway),
            held: HashMap::new(),
        }
    }

    /// Returns when the first reserved device must be released.
    pub(super) fn next_release(&self) -> Option<Instant> {
        self.held.values().map(|(_, until)| *until).min()
    }

    /// Releases the devices whose client is silent.
    pub(super) fn release(&mut self) {
        let now = Instant::now();
        self.held.retain(|_, (_, until)| *until > now);
    }

    /// Returns the frames that answer a frame. No error telegram exists: nothing answers a frame
    /// that is damaged, and a device that is not there or silent.
    pub(super) async fn answer(&mut self, frame: &[u8]) -> Vec<Vec<u8>> {
        let Ok(telegram) = Telegram::parse(frame) else {
            return Vec::new();
        };
        let message = RawMessage {
            channel: telegram.channel,
            protocol: telegram.protocol,
            body: telegram.body.to_vec(),
        };
        let answers = match telegram.station {
            MAIN_DEVICE => self.gateway.answer(&message),
            station => self.forward(station, message).await,
        };
        let frames = answers.iter().map(|answer| frame_of(&telegram, answer));
        frames.collect()
    }

    async fn forward(&mut self, station: u16, message: RawMessage) -> Vec<RawMessage> {
        self.release();
        let Some((device, mailbox, layout)) = self.gateway.mailboxes.at_station(station) else {
            return Vec::new();
        };
        let held = self.held.remove(&station);
        let access = &self.gateway.access;
        if let Some(refusal) = access.refusal(device, &layout, &message, held.is_some()) {
            // The transfer goes on with another message.
            self.held.extend(held.map(|held| (station, held)));
            return vec![refusal];
        }
        let mut answer = Err(None);
        if let Some((session, _)) = held {
            answer = self.exchange(station, session, message.clone()).await;
            if answer == Err(None) && is_segment(&message) {
                // This side needed the device. The transfer is aborted.
                return vec![sdo_abort(None, abort_code::LOCAL_CONTROL)];
            }
        }
        if answer == Err(None) {
            answer = match mailbox.session().await {
                Ok(session) => self.exchange(station, session, message).await,
                Err(_) => Err(None),
            };
        }
        if let Err(Some(error)) = &answer {
            tracing::debug!(%error, "a message of the mailbox gateway");
        }
        answer.map_or_else(|_| Vec::new(), |answer| answer.messages)
    }

    /// Exchanges a message and keeps the session of a transfer. `Err(None)`: the session has ended.
    async fn exchange(
        &mut self,
        station: u16,
        session: MailboxSession,
        message: RawMessage,
    ) -> Result<RawAnswer, Option<MailboxError>> {
        let answer = session
            .exchange(message)
            .await
            .map_err(|error| match error {
                MailboxError::Closed { .. } => None,
                error => Some(error),
            })?;
        if answer.unfinished {
            self.held.insert(station, (session, Instant::now() + HOLD));
        }
        Ok(answer)
    }
}

fn is_segment(message: &RawMessage) -> bool {
    let mailbox = message.mailbox();
    message.protocol == TYPE_COE
        && matches!(
            coe::Request::parse(&mailbox),
            Ok(Some(
                coe::Request::UploadSegment { .. } | coe::Request::DownloadSegment { .. }
            ))
        )
}

impl Gateway {
    /// Returns the answers of the MainDevice.
    fn answer(&self, message: &RawMessage) -> Vec<RawMessage> {
        if message.protocol == TYPE_COE
            && let Some(refusal) = self.access.sdo_refusal(None, message, false)
        {
            return vec![refusal];
        }
        self.dictionary.answer(message)
    }
}
