//! File access over EtherCAT (ETG.1000.6 §5.8): the client of one SubDevice.
//!
//! - `message`: the bytes.
//! - `error`: [`FoeError`].
//!
//! A file goes in packets, counted from 1 and acknowledged one by one; the first one that does not fill the mailbox is the
//! last, so that a file whose last packet is full is followed by an empty one. What lost frames do to that is the mailbox's
//! business (`port`); packets that come twice all the same are recognised by their number.

use std::time::Duration;

use super::error::Phase;
use super::port::{Deadline, Port, Trouble};
use super::{MailboxLayout, Timeouts, Wire};

mod error;
mod message;

pub use error::{FoeError, foe_error_text};
pub use message::room;
use message::{Message, Request, parse};

/// Messages that are cleared away before a transfer at most.
const DRAIN: usize = 64;
/// How often one packet may come twice.
const REPEATS: u32 = 3;
/// Between BUSY and asking again.
const BUSY_PAUSE: Duration = Duration::from_millis(10);

const ILLEGAL: u32 = 0x8004;
const PACKET_NUMBER: u32 = 0x8005;
const NOT_DEFINED: u32 = 0x8000;
const DISK_FULL: u32 = 0x8003;

/// How long to wait, each for one packet. Erasing a flash memory takes seconds, and not every SubDevice says BUSY then.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FoeTimeouts {
    /// Until the SubDevice has taken the previous message out of its mailbox.
    pub request: Duration,
    /// Until it answers.
    pub answer: Duration,
    /// Until it answers with anything else than BUSY.
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

/// A transfer goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FoeProgress {
    /// Bytes that have got through.
    Bytes(usize),
    /// The SubDevice puts the client off, with what it says of how much it has done.
    Busy { done: u16, entire: u16 },
}

/// One SubDevice's files. One transfer at a time. A transfer that failed, or whose future was dropped, leaves nothing
/// behind that the next one would take for its answer.
#[derive(Debug)]
pub struct FoeClient {
    port: Port,
    busy: Duration,
    /// A transfer has ended without its last answer; it may still come.
    unsettled: bool,
    /// The SubDevice still waits for the rest of a transfer.
    under_way: bool,
}

/// What a transfer is about, and how far it is.
#[derive(Debug)]
struct Transfer<'a> {
    station: u16,
    file: &'a str,
    packet: u32,
}

/// What an answer is to the client.
enum Pick<T> {
    Take(T),
    /// To something that is over; the right one may follow.
    Stale,
    /// The last packet once more: the SubDevice has not seen its acknowledgement.
    Again,
    Wrong {
        expected: u32,
        found: u32,
    },
    Nonsense(&'static str),
}

/// Why a transfer ended, and what the SubDevice is told where it still waits.
struct Ended {
    error: FoeError,
    tell: Option<u32>,
}

impl From<FoeError> for Ended {
    fn from(error: FoeError) -> Self {
        Self { error, tell: None }
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

    /// The same with other timeouts.
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

    /// Writes a file. `password` 0 is none.
    pub async fn write<W: Wire>(
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

    /// Reads a file of at most `most` bytes. `password` 0 is none.
    pub async fn read<W: Wire>(
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

    async fn begin<'a, W: Wire>(&mut self, w: &W, file: &'a str) -> Result<Transfer<'a>, FoeError> {
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
            return Err(FoeError::Name {
                station: transfer.station,
                file: file.to_owned(),
                room,
            });
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

    async fn end<W: Wire, T>(&mut self, w: &W, result: Result<T, Ended>) -> Result<T, FoeError> {
        match result {
            Ok(value) => {
                (self.unsettled, self.under_way) = (false, false);
                Ok(value)
            }
            Err(Ended { error, tell }) => {
                match tell {
                    Some(code) => self.give_up(w, code).await,
                    None => self.under_way = false,
                }
                Err(error)
            }
        }
    }

    /// The SubDevice may not hear it; what matters to the caller is the first error. It is told before the next transfer, then.
    async fn give_up<W: Wire>(&mut self, w: &W, code: u32) {
        self.under_way = self.port.send(w, &Request::Error { code }).await.is_err();
    }

    async fn write_in<W: Wire>(
        &mut self,
        w: &W,
        transfer: &mut Transfer<'_>,
        password: u32,
        data: &[u8],
        progress: &mut dyn FnMut(FoeProgress),
    ) -> Result<(), Ended> {
        let full = room(self.port.layout.out_len);
        let name = transfer.file;
        let mut request = Request::Write { password, name };
        let mut done = 0;
        let mut is_last = false;
        loop {
            let packet = transfer.packet;
            self.ask(w, transfer, &request, progress, |said| match said {
                Message::Ack { packet: acked } if *acked == packet => Pick::Take(()),
                Message::Ack { packet: acked } if acked.wrapping_add(1) == packet => Pick::Stale,
                Message::Ack { packet: found } => Pick::Wrong {
                    expected: packet,
                    found: *found,
                },
                _ => Pick::Nonsense("data where an acknowledgement is due"),
            })
            .await?;
            progress(FoeProgress::Bytes(done));
            if is_last {
                return Ok(());
            }
            let rest = data.get(done..).unwrap_or_default();
            let part = rest.get(..full).unwrap_or(rest);
            transfer.packet = packet.wrapping_add(1);
            request = Request::Data {
                packet: transfer.packet,
                data: part,
            };
            done += part.len();
            is_last = part.len() < full;
        }
    }

    async fn read_in<W: Wire>(
        &mut self,
        w: &W,
        transfer: &mut Transfer<'_>,
        password: u32,
        most: usize,
        progress: &mut dyn FnMut(FoeProgress),
    ) -> Result<Vec<u8>, Ended> {
        let full = room(self.port.layout.in_len);
        let name = transfer.file;
        let mut request = Request::Read { password, name };
        let mut file = Vec::new();
        loop {
            let due = transfer.packet.wrapping_add(1);
            let part = self
                .ask(w, transfer, &request, progress, |said| match said {
                    Message::Data { packet, data } if *packet == due => Pick::Take(data.to_vec()),
                    Message::Data { packet, .. } if packet.wrapping_add(1) == due && due > 1 => {
                        Pick::Again
                    }
                    Message::Data { packet: found, .. } => Pick::Wrong {
                        expected: due,
                        found: *found,
                    },
                    _ => Pick::Nonsense("an acknowledgement where data are due"),
                })
                .await?;
            transfer.packet = due;
            if file.len() + part.len() > most {
                return Err(Ended {
                    error: FoeError::TooLarge {
                        station: transfer.station,
                        file: transfer.file.to_owned(),
                        most,
                    },
                    tell: Some(DISK_FULL),
                });
            }
            file.extend_from_slice(&part);
            progress(FoeProgress::Bytes(file.len()));
            request = Request::Ack { packet: due };
            if part.len() < full {
                let sent = self.port.send(w, &request).await;
                return match sent {
                    Ok(()) => Ok(file),
                    Err(trouble) => Err(transfer.trouble(&self.port, trouble)),
                };
            }
        }
    }

    /// Sends a message until its answer comes, and again while the SubDevice is busy. `pick` judges what is neither an error nor BUSY.
    async fn ask<W: Wire, T>(
        &mut self,
        w: &W,
        transfer: &Transfer<'_>,
        request: &Request<'_>,
        progress: &mut dyn FnMut(FoeProgress),
        pick: impl Fn(&Message<'_>) -> Pick<T>,
    ) -> Result<T, Ended> {
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
                    return Err(transfer.trouble(&self.port, Trouble::Timeout(Phase::Repeat)));
                }
                Answer::Busy { done, entire } => {
                    progress(FoeProgress::Busy { done, entire });
                    let busy = busy.get_or_insert_with(|| Deadline::after(w, self.busy));
                    if busy.passed(w) {
                        return Err(Ended {
                            error: FoeError::Busy {
                                station: transfer.station,
                                file: transfer.file.to_owned(),
                                packet: transfer.packet,
                                after: self.busy,
                                done,
                                entire,
                            },
                            tell: Some(NOT_DEFINED),
                        });
                    }
                    w.delay(BUSY_PAUSE).await;
                }
            }
        }
    }

    async fn answer<W: Wire, T>(
        &mut self,
        w: &W,
        transfer: &Transfer<'_>,
        pick: &impl Fn(&Message<'_>) -> Pick<T>,
    ) -> Result<Answer<T>, Ended> {
        let mut deadline = Deadline::after(w, self.port.timeouts.answer);
        loop {
            if let Err(trouble) = self.port.receive(w, &mut deadline).await {
                return Err(transfer.trouble(&self.port, trouble));
            }
            let answer = match parse(self.port.message()) {
                Ok(Message::Busy { done, entire }) => Some(Answer::Busy { done, entire }),
                Ok(Message::Error { code, text }) => {
                    let text = words(text);
                    self.port.free = true;
                    return Err(transfer.refused(code, text).into());
                }
                Ok(Message::Refused(code)) => return Err(transfer.mailbox(code)),
                Ok(Message::Other) => None,
                Ok(said) => match pick(&said) {
                    Pick::Take(value) => Some(Answer::Is(value)),
                    Pick::Again => Some(Answer::Again),
                    Pick::Stale => None,
                    Pick::Wrong { expected, found } => {
                        return Err(transfer.wrong(expected, found));
                    }
                    Pick::Nonsense(what) => return Err(transfer.malformed(what)),
                },
                Err(flaw) => return Err(transfer.malformed(flaw)),
            };
            if let Some(answer) = answer {
                self.port.free = true;
                return Ok(answer);
            }
            self.port.set_aside(w);
            if deadline.passed(w) {
                return Err(transfer.trouble(&self.port, Trouble::Timeout(Phase::Answer)));
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
    fn trouble(&self, port: &Port, trouble: Trouble) -> Ended {
        let Self {
            station, packet, ..
        } = *self;
        match trouble {
            Trouble::Timeout(phase) => Ended {
                error: FoeError::Timeout {
                    station,
                    file: self.file.to_owned(),
                    packet,
                    phase,
                    after: match phase {
                        Phase::Request | Phase::Repeat => port.timeouts.request,
                        Phase::Answer | Phase::Transfer => port.timeouts.answer,
                    },
                },
                tell: Some(NOT_DEFINED),
            },
            Trouble::Gone => FoeError::Gone {
                station,
                file: self.file.to_owned(),
                packet,
            }
            .into(),
            Trouble::Wire(source) => FoeError::Wire {
                station,
                file: self.file.to_owned(),
                packet,
                source,
            }
            .into(),
            Trouble::Layout => FoeError::Layout {
                station,
                file: self.file.to_owned(),
                out_len: port.layout.out_len,
                in_len: port.layout.in_len,
            }
            .into(),
        }
    }

    fn refused(&self, code: u32, text: String) -> FoeError {
        FoeError::Refused {
            station: self.station,
            file: self.file.to_owned(),
            packet: self.packet,
            code,
            text,
        }
    }

    fn mailbox(&self, code: u16) -> Ended {
        Ended {
            error: FoeError::Mailbox {
                station: self.station,
                file: self.file.to_owned(),
                code,
            },
            tell: Some(NOT_DEFINED),
        }
    }

    fn wrong(&self, expected: u32, found: u32) -> Ended {
        Ended {
            error: FoeError::Packet {
                station: self.station,
                file: self.file.to_owned(),
                expected,
                found,
            },
            tell: Some(PACKET_NUMBER),
        }
    }

    fn malformed(&self, what: impl ToString) -> Ended {
        Ended {
            error: FoeError::Malformed {
                station: self.station,
                file: self.file.to_owned(),
                packet: self.packet,
                what: what.to_string(),
            },
            tell: Some(ILLEGAL),
        }
    }
}

/// Whether a file can be asked for by this name through a mailbox with [`room`] for so many bytes.
#[must_use]
pub fn is_name(name: &str, room: usize) -> bool {
    (1..=room).contains(&name.len()) && !name.contains('\0')
}

/// A SubDevice's own words, as far as a terminal can show them.
fn words(text: &[u8]) -> String {
    let text = text.split(|b| *b == 0).next().unwrap_or_default();
    let text = String::from_utf8_lossy(text);
    let shown = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    shown.collect::<String>().trim().to_owned()
}
