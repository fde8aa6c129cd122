//! File access over EtherCAT (ETG.1000.6 §5.8): the client of one SubDevice.
//!
//! - `error`: [`FoeError`].
//!
//! A file is transferred in packets, counted from 1 and acknowledged one by one. The first packet
//! that does not fill the mailbox is the last. A file whose last packet is full is followed by an
//! empty one. The mailbox layer (`transport`) handles lost frames. Packets that still arrive twice
//! are recognised by their number.

use std::time::Duration;

use super::error::Phase;
use super::transport::{Deadline, Port, TransportError};
use super::{MailboxLayout, MailboxTransport, Timeouts};

mod error;

use ecaxis_ecat::mailbox::DecodeError;
use ecaxis_ecat::mailbox::foe::Message;
pub use ecaxis_ecat::mailbox::foe::room;
pub use error::{FoeCause, FoeError, foe_error_text};

/// The maximum number of old messages that are read before a transfer.
const DRAIN: usize = 64;
/// How often one packet may be repeated.
const REPEATS: u32 = 3;
/// The pause between BUSY and the next attempt.
const BUSY_PAUSE: Duration = Duration::from_millis(10);

const ILLEGAL: u32 = 0x8004;
const PACKET_NUMBER: u32 = 0x8005;
pub(super) const NOT_DEFINED: u32 = 0x8000;
const DISK_FULL: u32 = 0x8003;

/// Timeouts per packet. Erasing a flash memory takes seconds, and not every SubDevice answers BUSY
/// meanwhile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FoeTimeouts {
    /// Until the SubDevice has fetched the previous message from its mailbox.
    pub request: Duration,
    /// Until it answers.
    pub answer: Duration,
    /// Until it sends an answer other than BUSY.
    pub busy: Duration,
}

impl Default for FoeTimeouts {
    fn default() -> Self {
        Self {
            request: Duration::from_secs(10),
            answer: Duration::from_secs(30),
            busy: Duration::from_secs(120),
        }
    }
}

/// The progress of a transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FoeProgress {
    /// Bytes transferred so far.
    Bytes(usize),
    /// The SubDevice answers BUSY, with its own progress.
    Busy { done: u16, entire: u16 },
}

/// The files of one SubDevice, for one transfer at a time. After a transfer that failed or was
/// dropped, the next one never takes an old answer for its own.
#[derive(Debug)]
pub struct FoeClient {
    port: Port,
    busy: Duration,
    /// A transfer has ended without its last answer, which may still arrive.
    unsettled: bool,
    /// The SubDevice still waits for the rest of a transfer.
    under_way: bool,
}

/// The file of a transfer, and its progress.
#[derive(Debug)]
struct Transfer<'a> {
    station: u16,
    file: &'a str,
    packet: u32,
}

/// How an answer relates to the last request.
enum ReplyMatch<T> {
    Take(T),
    /// An answer to an earlier packet; the right one may follow.
    Stale,
    /// The last packet again: the SubDevice has not received its acknowledgement.
    Again,
    Wrong {
        expected: u32,
        found: u32,
    },
    Nonsense(&'static str),
}

/// Why a transfer ended, and the error code to send if the SubDevice still waits.
struct FoeFailure {
    error: FoeError,
    report: Option<u32>,
}

impl From<FoeError> for FoeFailure {
    fn from(error: FoeError) -> Self {
        Self {
            error,
            report: None,
        }
    }
}

impl FoeClient {
    pub fn new(layout: MailboxLayout) -> Self {
        let mut client = Self {
            port: Port::new(layout),
            busy: Duration::ZERO,
            unsettled: true,
            under_way: false,
        };
        client.set_timeouts(FoeTimeouts::default());
        client
    }

    /// Returns the client with other timeouts.
    #[must_use]
    pub fn with_timeouts(mut self, timeouts: FoeTimeouts) -> Self {
        self.set_timeouts(timeouts);
        self
    }

    fn set_timeouts(&mut self, timeouts: FoeTimeouts) {
        self.port.timeouts = Timeouts {
            request: timeouts.request,
            answer: timeouts.answer,
            ..Timeouts::default()
        };
        self.busy = timeouts.busy;
    }

    /// Writes a file. A `password` of 0 means no password.
    pub async fn write<W: MailboxTransport>(
        &mut self,
        w: &W,
        file: &str,
        password: u32,
        data: &[u8],
        progress: &mut dyn FnMut(FoeProgress),
    ) -> Result<(), FoeError> {
        let mut transfer = self.begin(w, file).await?;
        let result = self
            .write_in(w, &mut transfer, password, data, progress)
            .await;
        self.end(w, result).await
    }

    /// Reads a file of at most `most` bytes. A `password` of 0 means no password.
    pub async fn read<W: MailboxTransport>(
        &mut self,
        w: &W,
        file: &str,
        password: u32,
        most: usize,
        progress: &mut dyn FnMut(FoeProgress),
    ) -> Result<Vec<u8>, FoeError> {
        let mut transfer = self.begin(w, file).await?;
        let result = self
            .read_in(w, &mut transfer, password, most, progress)
            .await;
        self.end(w, result).await
    }

    async fn begin<'a, W: MailboxTransport>(
        &mut self,
        w: &W,
        file: &'a str,
    ) -> Result<Transfer<'a>, FoeError> {
        let transfer = Transfer {
            station: self.port.layout.station,
            file,
            packet: 0,
        };
        self.port
            .check()
            .map_err(|trouble| transfer.trouble(&self.port, trouble).error)?;
        let room = room(self.port.layout.out_len);
        if !is_name(file, room) {
            return Err(transfer.error(FoeCause::Name { room }));
        }
        if self.under_way {
            self.give_up(w, NOT_DEFINED).await;
        }
        if self.unsettled {
            let drained = self.port.drain(w, DRAIN).await;
            drained.map_err(|trouble| transfer.trouble(&self.port, trouble).error)?;
        }
        (self.unsettled, self.under_way) = (true, true);
        Ok(transfer)
    }

    async fn end<W: MailboxTransport, T>(
        &mut self,
        w: &W,
        result: Result<T, FoeFailure>,
    ) -> Result<T, FoeError> {
        match result {
            Ok(value) => {
                (self.unsettled, self.under_way) = (false, false);
                Ok(value)
            }
            Err(FoeFailure { error, report }) => {
                match report {
                    Some(code) => self.give_up(w, code).await,
                    None => self.under_way = false,
                }
                Err(error)
            }
        }
    }

    /// Sends an error code to the SubDevice. If it cannot be sent now, it is sent before the next
    /// transfer. The caller gets the first error.
    async fn give_up<W: MailboxTransport>(&mut self, w: &W, code: u32) {
        self.under_way = self
            .port
            .send(w, &Message::Error { code, text: &[] })
            .await
            .is_err();
    }

    async fn write_in<W: MailboxTransport>(
        &mut self,
        w: &W,
        transfer: &mut Transfer<'_>,
        password: u32,
        data: &[u8],
        progress: &mut dyn FnMut(FoeProgress),
    ) -> Result<(), FoeFailure> {
        let full = room(self.port.layout.out_len);
        let name = transfer.file;
        let name = name.as_bytes();
        let mut request = Message::Write { password, name };
        let mut done = 0;
        let mut is_last = false;
        loop {
            let packet = transfer.packet;
            self.ask(w, transfer, &request, progress, |said| match said {
                Message::Ack { packet: acked } if *acked == packet => ReplyMatch::Take(()),
                Message::Ack { packet: acked } if acked.wrapping_add(1) == packet => {
                    ReplyMatch::Stale
                }
                Message::Ack { packet: found } => ReplyMatch::Wrong {
                    expected: packet,
                    found: *found,
                },
                _ => ReplyMatch::Nonsense("data where an acknowledgement is due"),
            })
            .await?;
            progress(FoeProgress::Bytes(done));
            if is_last {
                return Ok(());
            }
            let rest = data.get(done..).unwrap_or_default();
            let part = rest.get(..full).unwrap_or(rest);
            transfer.packet = packet.wrapping_add(1);
            request = Message::Data {
                packet: transfer.packet,
                data: part,
            };
            done += part.len();
            is_last = part.len() < full;
        }
    }

    async fn read_in<W: MailboxTransport>(
        &mut self,
        w: &W,
        transfer: &mut Transfer<'_>,
        password: u32,
        most: usize,
        progress: &mut dyn FnMut(FoeProgress),
    ) -> Result<Vec<u8>, FoeFailure> {
        let full = room(self.port.layout.in_len);
        let name = transfer.file;
        let name = name.as_bytes();
        let mut request = Message::Read { password, name };
        let mut file = Vec::new();
        loop {
            let due = transfer.packet.wrapping_add(1);
            let part = self
                .ask(w, transfer, &request, progress, |said| match said {
                    Message::Data { packet, data } if *packet == due => {
                        ReplyMatch::Take(data.to_vec())
                    }
                    Message::Data { packet, .. } if packet.wrapping_add(1) == due && due > 1 => {
                        ReplyMatch::Again
                    }
                    Message::Data { packet: found, .. } => ReplyMatch::Wrong {
                        expected: due,
                        found: *found,
                    },
                    _ => ReplyMatch::Nonsense("an acknowledgement where data are due"),
                })
                .await?;
            transfer.packet = due;
            if file.len() + part.len() > most {
                return Err(transfer.failure(FoeCause::TooLarge { most }, DISK_FULL));
            }
            file.extend_from_slice(&part);
            progress(FoeProgress::Bytes(file.len()));
            request = Message::Ack { packet: due };
            if part.len() < full {
                let sent = self.port.send(w, &request).await;
                return match sent {
                    Ok(()) => Ok(file),
                    Err(trouble) => Err(transfer.trouble(&self.port, trouble)),
                };
            }
        }
    }

    /// Sends a message and waits for its answer; repeats it while the SubDevice is busy. `pick`
    /// classifies answers other than errors and BUSY.
    async fn ask<W: MailboxTransport, T>(
        &mut self,
        w: &W,
        transfer: &Transfer<'_>,
        request: &Message<'_>,
        progress: &mut dyn FnMut(FoeProgress),
        pick: impl Fn(&Message<'_>) -> ReplyMatch<T>,
    ) -> Result<T, FoeFailure> {
        let mut busy: Option<Deadline> = None;
        let mut repeats = 0;
        loop {
            if let Err(trouble) = self.port.send(w, request).await {
                return Err(transfer.trouble(&self.port, trouble));
            }
            match self.answer(w, transfer, &pick).await? {
                Answer::Is(value) => return Ok(value),
                Answer::Again if repeats < REPEATS => repeats += 1,
                Answer::Again => {
                    return Err(
                        transfer.trouble(&self.port, TransportError::Timeout(Phase::Repeat))
                    );
                }
                Answer::Busy { done, entire } => {
                    progress(FoeProgress::Busy { done, entire });
                    let busy = busy.get_or_insert_with(|| Deadline::after(w, self.busy));
                    if busy.passed(w) {
                        let cause = FoeCause::Busy {
                            packet: transfer.packet,
                            after: self.busy,
                            done,
                            entire,
                        };
                        return Err(transfer.failure(cause, NOT_DEFINED));
                    }
                    w.delay(BUSY_PAUSE).await;
                }
            }
        }
    }

    async fn answer<W: MailboxTransport, T>(
        &mut self,
        w: &W,
        transfer: &Transfer<'_>,
        pick: &impl Fn(&Message<'_>) -> ReplyMatch<T>,
    ) -> Result<Answer<T>, FoeFailure> {
        let mut deadline = Deadline::after(w, self.port.timeouts.answer);
        loop {
            if let Err(trouble) = self.port.receive(w, &mut deadline).await {
                return Err(transfer.trouble(&self.port, trouble));
            }
            let answer = match Message::parse(self.port.message()) {
                Ok(Message::Busy { done, entire }) => Some(Answer::Busy { done, entire }),
                Ok(Message::Error { code, text }) => {
                    let text = words(text);
                    self.port.answered();
                    return Err(transfer.refused(code, text).into());
                }
                Ok(Message::Refused(code)) => return Err(transfer.mailbox(code)),
                Ok(Message::Other) => None,
                Ok(Message::Read { .. }) => return Err(transfer.malformed(DecodeError::Opcode(1))),
                Ok(Message::Write { .. }) => return Err(transfer.malformed(DecodeError::Opcode(2))),
                Ok(said) => match pick(&said) {
                    ReplyMatch::Take(value) => Some(Answer::Is(value)),
                    ReplyMatch::Again => Some(Answer::Again),
                    ReplyMatch::Stale => None,
                    ReplyMatch::Wrong { expected, found } => {
                        return Err(transfer.wrong(expected, found));
                    }
                    ReplyMatch::Nonsense(what) => return Err(transfer.malformed(what)),
                },
                Err(flaw) => return Err(transfer.malformed(flaw)),
            };
            if let Some(answer) = answer {
                self.port.answered();
                return Ok(answer);
            }
            self.port.set_aside(w);
            if deadline.passed(w) {
                return Err(transfer.trouble(&self.port, TransportError::Timeout(Phase::Answer)));
            }
            deadline.pause(w).await;
        }
    }
}

enum Answer<T> {
    Is(T),
    Again,
    Busy { done: u16, entire: u16 },
}

impl Transfer<'_> {
    fn trouble(&self, port: &Port, trouble: TransportError) -> FoeFailure {
        let packet = self.packet;
        let cause = match trouble {
            TransportError::Timeout(phase) => {
                let cause = FoeCause::Timeout {
                    packet,
                    phase,
                    after: match phase {
                        Phase::Request | Phase::Repeat => port.timeouts.request,
                        Phase::Answer | Phase::Fragment | Phase::Transfer | Phase::Command => {
                            port.timeouts.answer
                        }
                    },
                };
                return self.failure(cause, NOT_DEFINED);
            }
            TransportError::Gone => FoeCause::Gone { packet },
            TransportError::Wire(source) => FoeCause::Wire { packet, source },
            TransportError::Layout => FoeCause::Layout {
                out_len: port.layout.out_len,
                in_len: port.layout.in_len,
            },
        };
        self.error(cause).into()
    }

    fn error(&self, cause: FoeCause) -> FoeError {
        FoeError {
            station: self.station,
            file: self.file.to_owned(),
            cause,
        }
    }

    /// Returns the error with the code to report to the device.
    fn failure(&self, cause: FoeCause, report: u32) -> FoeFailure {
        FoeFailure {
            error: self.error(cause),
            report: Some(report),
        }
    }

    fn refused(&self, code: u32, text: String) -> FoeError {
        self.error(FoeCause::Refused {
            packet: self.packet,
            code,
            text,
        })
    }

    fn mailbox(&self, code: u16) -> FoeFailure {
        self.failure(FoeCause::Mailbox(code), NOT_DEFINED)
    }

    fn wrong(&self, expected: u32, found: u32) -> FoeFailure {
        self.failure(FoeCause::Packet { expected, found }, PACKET_NUMBER)
    }

    fn malformed(&self, what: impl ToString) -> FoeFailure {
        let cause = FoeCause::Malformed {
            packet: self.packet,
            what: what.to_string(),
        };
        self.failure(cause, ILLEGAL)
    }
}

/// True if `name` is a valid file name for a mailbox with [`room`] for `room` bytes.
#[must_use]
pub fn is_name(name: &str, room: usize) -> bool {
    (1..=room).contains(&name.len()) && !name.contains('\0')
}

/// Returns the SubDevice's error text, limited to printable characters.
fn words(text: &[u8]) -> String {
    let text = text.split(|b| *b == 0).next().unwrap_or_default();
    let text = String::from_utf8_lossy(text);
    let shown = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    shown.collect::<String>().trim().to_owned()
}
