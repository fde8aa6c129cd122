//! EoE at the mailbox of a device: its IP parameters, and Ethernet frames between the requests of
//! others.

use std::fmt;
use std::time::Duration;

use ecaxis_ecat::mailbox::eoe::{Fragments, Message, RESULT_OK, Service, result_text};

use super::error::CoeCause;
use super::transfer::explain;
use super::transport::{Deadline, TransportError};
use super::{CoeClient, MailboxTransport};
use crate::clock::Nanos;
use crate::eoe::{EoePort, Turn};

/// The first and the longest pause before a fragment is offered again to a full mailbox.
const PAUSE_MIN: Nanos = 500_000;
const PAUSE_MAX: Nanos = 20_000_000;
/// A device that takes no fragment for this time in ns loses the frames that wait for it.
const TAKES_NONE: Nanos = 1_000_000_000;

/// Why a device has not taken its IP parameters or its MAC filter.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EoeError {
    /// The request is longer than the mailbox.
    #[error("the request has {length} bytes, the mailbox of the device {mailbox}")]
    TooLong {
        /// The bytes of the request.
        length: usize,
        /// The bytes of the mailbox.
        mailbox: u16,
    },
    /// The result of the device.
    #[error("the device refused them with result {:#06x}: {}", .0, result_text(*.0))]
    Result(u16),
    /// The mailbox.
    #[error("{0}")]
    Mailbox(CoeCause),
}

/// What a device with EoE is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EoeSetting {
    /// The IP parameters.
    IpParameters,
    /// The MAC filter.
    MacFilter,
}

impl fmt::Display for EoeSetting {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::IpParameters => "IP parameters",
            Self::MacFilter => "MAC filter",
        })
    }
}

/// The frame that is on its way to a device in fragments.
#[derive(Debug, Default)]
pub(super) struct EoeSender {
    frame: Vec<u8>,
    /// The number of the frame, 0 to 15.
    number: u8,
    /// The fragments that the device has taken.
    sent: usize,
    /// The time of the first attempt that the device did not take, and the next attempt.
    waits: Option<(Nanos, Nanos)>,
    pause: Nanos,
}

impl EoeSender {
    /// Returns true if a fragment is due.
    pub(super) fn is_due(&self, now: Nanos, port: &EoePort) -> bool {
        self.waits.is_none_or(|(_, next)| now >= next)
            && (!self.frame.is_empty() || port.has_frame())
    }

    /// Forgets the frame: the device has restarted.
    pub(super) fn restart(&mut self) {
        *self = Self {
            number: self.number,
            ..Self::default()
        };
    }
}

impl CoeClient {
    /// Sends a request that sets IP parameters or the MAC filter.
    ///
    /// # Errors
    /// [`EoeError`].
    pub async fn set_ethernet<W: MailboxTransport>(
        &mut self,
        w: &W,
        request: Service<'_>,
    ) -> Result<(), EoeError> {
        let request = Message::from(request);
        let (length, mailbox) = (request.length(), self.port.layout.out_len);
        if length > usize::from(mailbox) {
            return Err(EoeError::TooLong { length, mailbox });
        }
        let set_aside = self.port.forgotten;
        match self.ask_result(w, request).await {
            Ok(Ok(RESULT_OK)) => Ok(()),
            Ok(Ok(result)) => Err(EoeError::Result(result)),
            Ok(Err(code)) => Err(EoeError::Mailbox(CoeCause::Refused(code))),
            Err(trouble) => {
                let set_aside = self.port.forgotten.saturating_sub(set_aside);
                Err(EoeError::Mailbox(explain(&self.port, trouble, set_aside)))
            }
        }
    }

    /// Returns the result, or the code with which the mailbox refused the request.
    async fn ask_result<W: MailboxTransport>(
        &mut self,
        w: &W,
        request: Message<'_>,
    ) -> Result<Result<u16, u16>, TransportError> {
        self.drain_after_failure(w).await?;
        let filter = matches!(request.service, Service::SetFilter(_));
        self.port.send(w, &request).await?;
        let mut deadline = Deadline::after(w, self.port.timeouts.answer);
        loop {
            self.port.receive(w, &mut deadline).await?;
            let answer = Message::parse(self.port.message()).map(|message| message.service);
            let answer = match answer {
                Ok(Service::SetIpResponse(result)) if !filter => Ok(result),
                Ok(Service::SetFilterResponse(result)) if filter => Ok(result),
                Ok(Service::Refused(code)) => Err(code),
                _ => {
                    self.port.set_aside(w);
                    if deadline.passed(w) {
                        return Err(TransportError::Timeout(super::Phase::Answer));
                    }
                    deadline.pause(w).await;
                    continue;
                }
            };
            self.port.answered();
            self.unsettled = false;
            return Ok(answer);
        }
    }

    /// Connects the mailbox with a port of the switch.
    pub(crate) fn connect(&mut self, port: EoePort) {
        self.port.eoe = Some(port);
    }

    pub(super) fn eoe_port(&self) -> Option<&EoePort> {
        self.port.eoe.as_ref()
    }

    /// Offers the next fragment to the device once.
    pub(super) async fn send_fragment<W: MailboxTransport>(
        &mut self,
        w: &W,
        sender: &mut EoeSender,
        turn: Turn,
    ) {
        let Some(port) = self.port.eoe.clone() else {
            return;
        };
        if port.is_unsupported() {
            return sender.restart();
        }
        if sender.frame.is_empty() {
            let number = sender.number.wrapping_add(1) & 0x0f;
            let Some(frame) = port.next_frame(w.now(), number) else {
                return;
            };
            (sender.frame, sender.sent, sender.number) = (frame, 0, number);
        }
        let out_len = self.port.layout.out_len;
        let mut fragments = Fragments::new(&sender.frame, sender.number, out_len);
        let Some(mut fragment) = fragments.nth(sender.sent) else {
            // The mailbox is too small for a fragment.
            sender.restart();
            return port.drop_frames(1);
        };
        fragment.time_requested = port.has_time_stamps();
        let message = Message::from(Service::Fragment(fragment));
        let written = self.port.write_once(w, &message).await;
        drop(turn);
        let now = w.now();
        match written {
            Ok(0) => {}
            Ok(_) => {
                (sender.waits, sender.pause) = (None, 0);
                sender.sent += 1;
                if fragment.last {
                    sender.frame.clear();
                    port.count(true);
                }
                return;
            }
            // Ethernet repeats the frame.
            Err(_) => {
                sender.restart();
                return port.count(false);
            }
        }
        sender.pause = (sender.pause * 2).clamp(PAUSE_MIN, PAUSE_MAX);
        let since = sender.waits.map_or(now, |(since, _)| since);
        sender.waits = Some((since, now.saturating_add(sender.pause)));
        if now.saturating_sub(since) > TAKES_NONE {
            self.port.withdraw();
            sender.restart();
            // Further frames find the pause that this one has left.
            sender.pause = PAUSE_MAX;
            port.drop_frames(1);
        }
    }

    /// Reads one message that belongs to no request, if there is one.
    pub(super) async fn take_message<W: MailboxTransport>(&mut self, w: &W, turn: Turn) {
        let Some(port) = self.port.eoe.clone() else {
            return;
        };
        // The cycle detects a device that is gone.
        let _ = self.port.take_one(w, turn).await;
        if !self.port.waits(w) && port.is_assembling(w.now()) {
            w.delay(Duration::from_nanos(PAUSE_MIN)).await;
        }
    }
}

#[cfg(test)]
mod tests;
