//! Mailbox messages of any protocol from another program: which messages answer them, and whether a
//! transfer of several messages is in progress.
//!
//! The counter belongs to this side: a message gets the counter of the mailbox, whatever the other
//! program has put there.

use std::time::Duration;

use ecaxis_ecat::mailbox::coe::{Answer, Message, Request};
use ecaxis_ecat::mailbox::gateway::Telegram;
use ecaxis_ecat::mailbox::{
    DecodeError, Encode, HEADER, Mailbox, TYPE_COE, TYPE_EOE, TYPE_ERROR, TYPE_FOE, TYPE_SOE, foe,
};

use super::error::{Phase, SdoError, Subject};
use super::foe::NOT_DEFINED;
use super::transfer::explain;
use super::transport::{Deadline, TransportError};
use super::{CoeClient, MailboxLayout, MailboxTransport};

/// The maximum number of messages in an answer: an object list has two bytes for each object.
const MAX_MESSAGES: usize = 1 << 13;
/// How long a message of a protocol without defined answers waits for one.
const OTHER_ANSWER: Duration = Duration::from_secs(1);
/// Bits of the first byte of a SoE message: further fragments follow, and the opcode.
const SOE_INCOMPLETE: u8 = 0x08;

/// A mailbox message without its station address and counter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawMessage {
    pub channel: u8,
    pub protocol: u8,
    pub body: Vec<u8>,
}

/// The answers to a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawAnswer {
    pub messages: Vec<RawMessage>,
    /// A transfer is in progress, and its next message must follow before those of others.
    pub unfinished: bool,
}

impl RawMessage {
    /// Parses a message in a device's mailbox.
    fn of_mailbox(mailbox: &[u8]) -> Result<Self, DecodeError> {
        let Mailbox { protocol, body, .. } = Mailbox::parse(mailbox)?;
        Ok(Self {
            channel: mailbox.get(4).copied().unwrap_or_default(),
            protocol,
            body: body.to_vec(),
        })
    }

    /// Returns `true` if the mailbox of a device holds the message.
    #[must_use]
    pub fn fits(&self, layout: &MailboxLayout) -> bool {
        HEADER + self.body.len() <= usize::from(layout.out_len)
    }

    /// Returns the message as a whole mailbox.
    #[must_use]
    pub fn mailbox(&self) -> Vec<u8> {
        let length = u16::try_from(HEADER + self.body.len()).unwrap_or(u16::MAX);
        let mut mailbox = Vec::new();
        self.emit(0, length, &mut mailbox);
        mailbox
    }
}

impl Encode for RawMessage {
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>) {
        let telegram = Telegram {
            station: 0,
            channel: self.channel,
            protocol: self.protocol,
            counter,
            body: &self.body,
        };
        telegram.emit(counter, mailbox, out);
    }
}

/// The transfer of several messages that is in progress.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum OpenTransfer {
    #[default]
    None,
    /// Segments of an object follow.
    Sdo {
        index: u16,
        sub: u8,
    },
    /// A file is read. `last`: only the acknowledgement of its last part is missing.
    FoeRead {
        last: bool,
    },
    FoeWrite,
    /// Fragments of a SoE request follow.
    Soe,
}

/// What a message means to a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Meaning {
    /// It is the only answer or the last one.
    Last,
    /// Further answers follow.
    More,
    /// It belongs to something else.
    Other,
}

impl OpenTransfer {
    /// Returns `true` if the device answers a request.
    fn is_answered(self, request: &RawMessage) -> bool {
        match request.protocol {
            TYPE_COE => !matches!(sdo_request(&request.mailbox()), Some(Request::Abort { .. })),
            TYPE_FOE => match foe::Message::parse(&request.mailbox()) {
                Ok(foe::Message::Ack { .. }) => self != Self::FoeRead { last: true },
                Ok(foe::Message::Error { .. }) => false,
                _ => true,
            },
            TYPE_SOE => !soe_continues(request),
            _ => true,
        }
    }

    /// Returns the state after a request and its answers.
    fn after(self, request: &RawMessage, answers: &[RawMessage], layout: &MailboxLayout) -> Self {
        let mailbox = request.mailbox();
        let answer = answers.last().map(RawMessage::mailbox);
        match request.protocol {
            TYPE_COE => match sdo_request(&mailbox) {
                // SDO Information may come within a transfer of an object.
                Some(Request::Information { .. }) => self,
                Some(request) => self.after_sdo(&request, answer.as_deref()),
                None => Self::None,
            },
            TYPE_FOE => after_file(self, &mailbox, answer.as_deref(), layout),
            TYPE_SOE if soe_continues(request) => Self::Soe,
            _ => Self::None,
        }
    }

    fn after_sdo(self, request: &Request<'_>, answer: Option<&[u8]>) -> Self {
        let answer = answer.and_then(|mailbox| match Message::parse(mailbox) {
            Ok(Message::Sdo(answer)) => Some(answer),
            _ => None,
        });
        match (*request, answer) {
            (Request::Upload { index, sub, .. }, Some(Answer::Upload { size, data, .. }))
                if data.len() < size =>
            {
                Self::Sdo { index, sub }
            }
            (
                Request::Download {
                    index,
                    sub,
                    size,
                    data,
                    ..
                },
                Some(Answer::Download { .. }),
            ) if u32::try_from(data.len()).is_ok_and(|length| length < size) => {
                Self::Sdo { index, sub }
            }
            (Request::UploadSegment { .. }, Some(Answer::UploadSegment { last: false, .. }))
            | (
                Request::DownloadSegment { last: false, .. },
                Some(Answer::DownloadSegment { .. }),
            ) => self,
            _ => Self::None,
        }
    }
}

fn after_file(
    before: OpenTransfer,
    request: &[u8],
    answer: Option<&[u8]>,
    layout: &MailboxLayout,
) -> OpenTransfer {
    use foe::Message::{Ack, Busy, Data, Read, Write};
    let answer = answer.and_then(|mailbox| foe::Message::parse(mailbox).ok());
    match (foe::Message::parse(request), answer) {
        (Ok(Read { .. } | Ack { .. }), Some(Data { data, .. })) => OpenTransfer::FoeRead {
            last: data.len() < foe::room(layout.in_len),
        },
        (Ok(Write { .. }), Some(Ack { .. } | Busy { .. })) => OpenTransfer::FoeWrite,
        (Ok(Data { data, .. }), Some(Ack { .. })) if data.len() >= foe::room(layout.out_len) => {
            OpenTransfer::FoeWrite
        }
        (Ok(Data { .. } | Ack { .. } | Read { .. }), Some(Busy { .. })) => before,
        _ => OpenTransfer::None,
    }
}

fn sdo_request(mailbox: &[u8]) -> Option<Request<'_>> {
    Request::parse(mailbox).ok().flatten()
}

fn soe_continues(message: &RawMessage) -> bool {
    let first = message.body.first();
    first.is_some_and(|first| first & SOE_INCOMPLETE != 0)
}

/// Returns what a message in a device's mailbox means to a request.
fn meaning(request: &RawMessage, answer: &[u8]) -> Meaning {
    let Ok(message) = RawMessage::of_mailbox(answer) else {
        return Meaning::Other;
    };
    match message.protocol {
        TYPE_ERROR => return Meaning::Last,
        protocol if protocol != request.protocol => return Meaning::Other,
        TYPE_COE => {}
        TYPE_SOE if soe_continues(&message) => return Meaning::More,
        // A part of an Ethernet frame answers nothing.
        TYPE_EOE if message.body.first().is_some_and(|kind| kind & 0x0f == 0) => {
            return Meaning::Other;
        }
        _ => return Meaning::Last,
    }
    let asked = request.mailbox();
    let (Some(asked), Ok(answer)) = (sdo_request(&asked), Message::parse(answer)) else {
        return Meaning::Other;
    };
    match (asked, answer) {
        (Request::Information { .. }, Message::Information(part)) if part.left > 0 => Meaning::More,
        (Request::Information { .. }, Message::Information(_)) => Meaning::Last,
        (Request::Information { .. }, _) | (_, Message::Information(_)) => Meaning::Other,
        (_, Message::Sdo(answer)) => sdo_meaning(&asked, &answer),
        _ => Meaning::Other,
    }
}

fn sdo_meaning(asked: &Request<'_>, answer: &Answer<'_>) -> Meaning {
    let fits = match (*asked, *answer) {
        (_, Answer::Abort { .. })
        | (Request::UploadSegment { .. }, Answer::UploadSegment { .. })
        | (Request::DownloadSegment { .. }, Answer::DownloadSegment { .. }) => true,
        (
            Request::Upload { index, .. },
            Answer::Upload {
                index: answered, ..
            },
        )
        | (
            Request::Download { index, .. } | Request::DownloadExpedited { index, .. },
            Answer::Download {
                index: answered, ..
            },
        ) => index == answered,
        _ => false,
    };
    if fits { Meaning::Last } else { Meaning::Other }
}

impl CoeClient {
    /// Sends a message of any protocol and returns its answers. `open` is the transfer in progress.
    pub(super) async fn exchange_raw<W: MailboxTransport>(
        &mut self,
        w: &W,
        request: &RawMessage,
        open: &mut OpenTransfer,
    ) -> Result<RawAnswer, SdoError> {
        if *open == OpenTransfer::None {
            let ready = self.drain_after_failure(w).await;
            ready.map_err(|trouble| self.raw_error(trouble, 0))?;
        }
        self.unsettled = true;
        let set_aside = self.port.forgotten;
        let sent = self.port.send(w, request).await;
        sent.map_err(|trouble| self.raw_error(trouble, 0))?;
        let mut messages = Vec::new();
        if open.is_answered(request) {
            let received = self.receive_raw(w, request, &mut messages).await;
            let set_aside = self.port.forgotten.saturating_sub(set_aside);
            received.map_err(|trouble| self.raw_error(trouble, set_aside))?;
            self.port.answered();
        }
        self.unsettled = false;
        *open = open.after(request, &messages, &self.port.layout);
        Ok(RawAnswer {
            messages,
            unfinished: *open != OpenTransfer::None,
        })
    }

    async fn receive_raw<W: MailboxTransport>(
        &mut self,
        w: &W,
        request: &RawMessage,
        messages: &mut Vec<RawMessage>,
    ) -> Result<(), TransportError> {
        let known = matches!(request.protocol, TYPE_COE | TYPE_FOE | TYPE_SOE);
        let time = match known {
            true => self.port.timeouts.answer,
            false => OTHER_ANSWER,
        };
        let mut deadline = Deadline::after(w, time);
        loop {
            self.port.receive(w, &mut deadline).await?;
            match meaning(request, self.port.message()) {
                Meaning::Other => self.port.set_aside(w),
                found => {
                    if let Ok(message) = RawMessage::of_mailbox(self.port.message()) {
                        messages.push(message);
                    }
                    if found == Meaning::Last || messages.len() >= MAX_MESSAGES {
                        return Ok(());
                    }
                    deadline = Deadline::after(w, time);
                    continue;
                }
            }
            if deadline.passed(w) {
                return Err(TransportError::Timeout(Phase::Answer));
            }
            deadline.pause(w).await;
        }
    }

    /// Ends a transfer that another program has left: the device forgets it.
    pub(super) async fn end_raw<W: MailboxTransport>(&mut self, w: &W, open: OpenTransfer) {
        match open {
            OpenTransfer::None => return,
            OpenTransfer::Sdo { index, sub } => self.in_segments = Some((index, sub)),
            OpenTransfer::FoeRead { .. } | OpenTransfer::FoeWrite => {
                let farewell = foe::Message::Error {
                    code: NOT_DEFINED,
                    text: b"",
                };
                // The device may not receive it; the next user finds out.
                let _ = self.port.send(w, &farewell).await;
            }
            OpenTransfer::Soe => {}
        }
        self.unsettled = true;
        let _ = self.abort_transfer(w).await;
    }

    fn raw_error(&self, trouble: TransportError, set_aside: u64) -> SdoError {
        SdoError {
            station: self.port.layout.station,
            asked: Subject::Telegram,
            cause: explain(&self.port, trouble, set_aside),
        }
    }
}
