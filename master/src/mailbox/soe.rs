//! SoE (ETG.1000.6 §5.7): reads and writes elements of IDNs, executes procedure commands.
//!
//! A drive sends a long element in fragments without acknowledgements; it accepts fragments of a
//! request in the same way. The number of fragments that follow takes the place of the IDN in all
//! fragments but the last.

use std::fmt;
use std::time::Duration;

use ecaxis_ecat::mailbox::soe::{
    CommandState, DataState, Element, Idn, List, Message, Operation, Telegram, room,
};

use super::error::{CoeCause, Phase, SdoError, Subject};
use super::transfer::explain;
use super::transport::{Deadline, TransportError};
use super::{CoeClient, MailboxTransport};

/// The maximum length of an element in bytes: a full list with its lengths.
const MAX_ELEMENT: usize = 0xffff + 4;
/// The maximum number of old messages that are read before the first request.
const JOIN_DRAIN: usize = 64;
/// How often a read may be repeated.
const REPEATS: u32 = 10;
/// The pause between two reads of a procedure command's data state.
const COMMAND_PAUSE: Duration = Duration::from_millis(5);
/// The error code of a procedure command that is set already.
const ALREADY_ACTIVE: u16 = 0x7010;

/// An element of an IDN of one drive of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct IdnElement {
    /// The drive of the device, 0 to 7.
    pub drive: u8,
    pub idn: Idn,
    pub element: Element,
}

impl IdnElement {
    /// Returns the value of an IDN.
    #[must_use]
    pub const fn value(drive: u8, idn: Idn) -> Self {
        Self {
            drive,
            idn,
            element: Element::Value,
        }
    }

    /// Returns another element of the same IDN.
    #[must_use]
    pub const fn with(self, element: Element) -> Self {
        Self { element, ..self }
    }
}

/// Formats `S-0-0047 (Position command value)`; with the drive if it is not the first one, and with
/// the element if it is not the value.
impl fmt::Display for IdnElement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.element != Element::Value {
            write!(f, "{} of ", self.element.name())?;
        }
        self.idn.named().fmt(f)?;
        match self.drive {
            0 => Ok(()),
            drive => write!(f, " of drive {drive}"),
        }
    }
}

/// True if an element that is longer than one message is a whole list: other elements are shorter.
fn list_of(data: &[u8], room: usize) -> bool {
    data.len() <= room
        || List::parse(data).is_some_and(|list| list.data.len() + List::HEADER == data.len())
}

/// One transfer.
struct Transfer {
    at: IdnElement,
    operation: Operation,
    deadline: Deadline,
    /// The number of unexpected messages at its start.
    forgotten: u64,
}

impl CoeClient {
    /// Reads an element of an IDN. Lists contain their lengths. A read that lost a fragment is repeated:
    /// the drive has put the next one into its mailbox before the loss shows.
    pub async fn read_idn<W: MailboxTransport>(
        &mut self,
        w: &W,
        at: IdnElement,
    ) -> Result<Vec<u8>, SdoError> {
        let mut repeats = 0;
        loop {
            // The last attempt accepts a device that counts wrongly.
            match self.read_once(w, at, repeats < REPEATS).await {
                Err(error) if error.is_malformed() && repeats < REPEATS => repeats += 1,
                done => return done,
            }
        }
    }

    async fn read_once<W: MailboxTransport>(
        &mut self,
        w: &W,
        at: IdnElement,
        counts: bool,
    ) -> Result<Vec<u8>, SdoError> {
        let mut transfer = self.begin_idn(w, at, Operation::ReadResponse).await?;
        self.port.take_gap();
        let request = Telegram::read_request(at.drive, at.element, at.idn);
        let sent = self.port.send(w, &request).await;
        let done = match sent {
            Ok(()) => self.receive_idn(w, &mut transfer).await,
            Err(trouble) => Err(self.idn_trouble(&transfer, trouble)),
        };
        let done = match done {
            Ok(_) if self.port.take_gap() && counts => {
                let lost = "a fragment was lost: the counter of the mailbox has a gap";
                Err(self.idn_error(&transfer, CoeCause::Malformed(lost.into())))
            }
            Ok(data) => match list_of(&data, room(self.port.layout.in_len)) {
                true => Ok(data),
                false => {
                    let lost = "the length of a list in fragments contradicts its contents";
                    Err(self.idn_error(&transfer, CoeCause::Malformed(lost.into())))
                }
            },
            failed => failed,
        };
        self.end_idn(done)
    }

    /// Reads an element; `None` if the drive refuses to send it.
    pub async fn read_idn_optional<W: MailboxTransport>(
        &mut self,
        w: &W,
        at: IdnElement,
    ) -> Result<Option<Vec<u8>>, SdoError> {
        match self.read_idn(w, at).await {
            Ok(data) => Ok(Some(data)),
            Err(error) if error.soe_code().is_some() => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Writes an element of an IDN. Lists contain their lengths.
    pub async fn write_idn<W: MailboxTransport>(
        &mut self,
        w: &W,
        at: IdnElement,
        data: &[u8],
    ) -> Result<(), SdoError> {
        let mut transfer = self.begin_idn(w, at, Operation::WriteResponse).await?;
        if data.len() > MAX_ELEMENT {
            self.unsettled = false;
            return Err(self.idn_error(&transfer, CoeCause::TooLarge(data.len())));
        }
        let room = room(self.port.layout.out_len).max(1);
        let mut left = data.len().div_ceil(room).max(1);
        let mut rest = data;
        while left > 0 {
            let part = rest.get(..room).unwrap_or(rest);
            rest = rest.get(part.len()..).unwrap_or_default();
            left -= 1;
            let telegram = Telegram {
                operation: Operation::WriteRequest,
                incomplete: left > 0,
                error: false,
                drive: at.drive,
                elements: at.element.bit(),
                idn_or_left: match u16::try_from(left) {
                    Ok(0) => at.idn.0,
                    left => left.unwrap_or(u16::MAX),
                },
                data: part,
            };
            if let Err(trouble) = self.port.send(w, &telegram).await {
                return Err(self.idn_trouble(&transfer, trouble));
            }
        }
        let done = self.receive_idn(w, &mut transfer).await;
        self.end_idn(done).map(drop)
    }

    /// Executes a procedure command: sets it, waits until the drive has executed it, and clears it.
    /// A command that is still set, from an execution that was cancelled, is cleared first.
    pub async fn execute_command<W: MailboxTransport>(
        &mut self,
        w: &W,
        (drive, idn): (u8, Idn),
        timeout: Duration,
    ) -> Result<(), SdoError> {
        let at = IdnElement::value(drive, idn);
        let set = (DataState::SET | DataState::ENABLED).to_le_bytes();
        match self.write_idn(w, at, &set).await {
            Err(error) if error.soe_code() == Some(ALREADY_ACTIVE) => {
                self.write_idn(w, at, &[0, 0]).await?;
                self.write_idn(w, at, &set).await?;
            }
            done => done?,
        }
        let deadline = Deadline::after(w, timeout);
        let done = loop {
            let state = match self.read_idn(w, at.with(Element::DataState)).await {
                Ok(bytes) => match *bytes.as_slice() {
                    [low, high, ..] => DataState(u16::from_le_bytes([low, high])).command(),
                    _ => break Err(CoeCause::Malformed("a data state is too short".into())),
                },
                Err(error) => break Err(error.cause),
            };
            match state {
                CommandState::Executed => break Ok(()),
                CommandState::Failed | CommandState::Cleared => {
                    break Err(CoeCause::Command(state));
                }
                CommandState::Running | CommandState::Interrupted => {}
            }
            if deadline.passed(w) {
                break Err(CoeCause::Timeout {
                    phase: Phase::Command,
                    after: timeout,
                    set_aside: 0,
                });
            }
            w.delay(COMMAND_PAUSE).await;
        };
        let cleared = self.write_idn(w, at, &[0, 0]).await;
        match done {
            Ok(()) => cleared,
            Err(cause) => Err(SdoError {
                station: self.port.layout.station,
                asked: Subject::Idn(at),
                cause,
            }),
        }
    }

    /// Sends a read and drops its answer. A device that takes the read for a repetition does not answer.
    pub(super) async fn join_soe<W: MailboxTransport>(
        &mut self,
        w: &W,
    ) -> Result<(), TransportError> {
        const SETTLE: Duration = Duration::from_millis(20);
        self.port.drain(w, JOIN_DRAIN).await?;
        let read = Telegram::read_request(0, Element::DataState, Idn::TELEGRAM_TYPE);
        self.port.send(w, &read).await?;
        let mut deadline = Deadline::after(w, SETTLE);
        match self.port.receive(w, &mut deadline).await {
            Ok(()) | Err(TransportError::Timeout(_)) => Ok(()),
            Err(trouble) => Err(trouble),
        }
    }

    async fn begin_idn<W: MailboxTransport>(
        &mut self,
        w: &W,
        at: IdnElement,
        operation: Operation,
    ) -> Result<Transfer, SdoError> {
        let transfer = Transfer {
            at,
            operation,
            deadline: Deadline::after(w, self.port.timeouts.transfer),
            forgotten: self.port.forgotten,
        };
        match self.drain_after_failure(w).await {
            Ok(()) => Ok(transfer),
            Err(trouble) => Err(self.idn_trouble(&transfer, trouble)),
        }
    }

    /// Receives the answer with all its fragments.
    async fn receive_idn<W: MailboxTransport>(
        &mut self,
        w: &W,
        transfer: &mut Transfer,
    ) -> Result<Vec<u8>, SdoError> {
        let mut data = Vec::new();
        let mut left: Option<u16> = None;
        let mut deadline = Deadline::after(w, self.port.timeouts.answer);
        loop {
            if let Err(trouble) = self.port.receive(w, &mut deadline).await {
                return Err(self.idn_trouble(transfer, trouble));
            }
            let malformed = |what: String| CoeCause::Malformed(what);
            let cause = match Message::parse(self.port.message()) {
                Err(flaw) => malformed(flaw.to_string()),
                Ok(Message::Refused(code)) => CoeCause::Refused(code),
                Ok(Message::Telegram(answer))
                    if answer.operation == transfer.operation
                        && answer.drive == transfer.at.drive
                        && (answer.incomplete
                            || answer.error
                            || answer.idn() == Some(transfer.at.idn)) =>
                {
                    match (answer.error_code(), left) {
                        (Some(code), _) => CoeCause::Soe(code),
                        (None, Some(due)) if answer.left() != due => malformed(format!(
                            "{} fragments are left where {due} are due",
                            answer.left()
                        )),
                        _ if data.len() + answer.data.len() > MAX_ELEMENT => {
                            CoeCause::TooLarge(data.len() + answer.data.len())
                        }
                        _ => {
                            data.extend_from_slice(answer.data);
                            let (incomplete, follow) = (answer.incomplete, answer.left());
                            self.port.answered();
                            if !incomplete {
                                return Ok(data);
                            }
                            if follow == 0 {
                                malformed("an incomplete answer has no fragments left".into())
                            } else {
                                left = Some(follow - 1);
                                deadline = Deadline::after(w, self.port.timeouts.answer);
                                if transfer.deadline.passed(w) {
                                    let late = TransportError::Timeout(Phase::Transfer);
                                    return Err(self.idn_trouble(transfer, late));
                                }
                                continue;
                            }
                        }
                    }
                }
                Ok(_) => {
                    self.port.set_aside(w);
                    if deadline.passed(w) {
                        let late = TransportError::Timeout(Phase::Answer);
                        return Err(self.idn_trouble(transfer, late));
                    }
                    deadline.pause(w).await;
                    continue;
                }
            };
            return Err(self.idn_error(transfer, cause));
        }
    }

    /// Notes whether an answer is still due.
    fn end_idn<T>(&mut self, done: Result<T, SdoError>) -> Result<T, SdoError> {
        self.unsettled = match &done {
            Ok(_) => false,
            Err(error) => !matches!(error.cause, CoeCause::Soe(_) | CoeCause::Refused(_)),
        };
        done
    }

    fn idn_trouble(&self, transfer: &Transfer, trouble: TransportError) -> SdoError {
        let set_aside = self.port.forgotten.saturating_sub(transfer.forgotten);
        self.idn_error(transfer, explain(&self.port, trouble, set_aside))
    }

    fn idn_error(&self, transfer: &Transfer, cause: CoeCause) -> SdoError {
        SdoError {
            station: self.port.layout.station,
            asked: Subject::Idn(transfer.at),
            cause,
        }
    }
}
