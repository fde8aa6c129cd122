//! SDO Information (ETG.1000.6 §5.6.3): the objects of a device with their names and types. An
//! answer may have many fragments; they are joined before the answer is parsed.

use std::fmt;

use ecaxis_ecat::mailbox::coe::{Answer, Fragment, Message, Request};

use super::error::{CoeCause, InfoError, Phase};
use super::transfer::explain;
use super::transport::{Deadline, TransportError};
use super::{CoeClient, MailboxTransport};
use ecaxis_ecat::object::NamedObject;

const LIST: u8 = 1;
const OBJECT: u8 = 3;
const ENTRY: u8 = 5;
const ERROR: u8 = 7;

/// How often a request is repeated if fragments of its answer are missing.
const MAX_ATTEMPTS: u32 = 3;

/// The longest answer is a list of all 65,536 indices.
const MAX_ANSWER: usize = 2 + 2 * 0x1_0000;

/// The requested parts of an entry description, always answered: access rights, category and
/// mapping.
const VALUE_INFO: u8 = 0x07;

/// A list of objects (ETG.1000.6 Table 43).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u16)]
pub enum ObjectList {
    All = 1,
    /// Objects that can be mapped into an RxPDO.
    RxMappable = 2,
    TxMappable = 3,
    /// Objects to restore on a replacement device: saved by "store parameters".
    Backup = 4,
    /// Objects set at start-up.
    Settings = 5,
}

/// A request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum InfoRequest {
    Lengths,
    List(ObjectList),
    Object(u16),
    Entry(u16, u8),
}

impl InfoRequest {
    fn opcode(self) -> u8 {
        match self {
            Self::Lengths | Self::List(_) => LIST,
            Self::Object(_) => OBJECT,
            Self::Entry(..) => ENTRY,
        }
    }

    fn body(self) -> Vec<u8> {
        match self {
            Self::Lengths => vec![0, 0],
            Self::List(list) => (list as u16).to_le_bytes().to_vec(),
            Self::Object(index) => index.to_le_bytes().to_vec(),
            Self::Entry(index, sub) => {
                let [low, high] = index.to_le_bytes();
                vec![low, high, sub, VALUE_INFO]
            }
        }
    }

    /// True if the answer echoes this request at its beginning.
    fn begins(self, data: &[u8]) -> bool {
        let body = self.body();
        let echoed = match self {
            Self::Entry(..) => 3,
            _ => 2,
        };
        data.get(..echoed).is_some() && data.get(..echoed) == body.get(..echoed)
    }
}

impl fmt::Display for InfoRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Lengths => f.write_str("the lengths of the object lists"),
            Self::List(ObjectList::All) => f.write_str("the list of all objects"),
            Self::List(ObjectList::RxMappable) => f.write_str("the list of objects for RxPDOs"),
            Self::List(ObjectList::TxMappable) => f.write_str("the list of objects for TxPDOs"),
            Self::List(ObjectList::Backup) => f.write_str("the list of backup objects"),
            Self::List(ObjectList::Settings) => f.write_str("the list of settings"),
            Self::Object(index) => write!(f, "the description of object {index:#06x}"),
            Self::Entry(index, sub) => {
                write!(f, "the description of {}", NamedObject { index, sub })
            }
        }
    }
}

/// Why a request failed.
#[derive(Debug)]
enum InfoFailure {
    /// Some fragments arrived and others did not.
    Gap(InfoError),
    For(InfoError),
}

impl From<InfoError> for InfoFailure {
    fn from(error: InfoError) -> Self {
        Self::For(error)
    }
}

/// The device's description of one object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ObjectDescription {
    pub index: u16,
    /// Index of the type in the object dictionary (ETG.1020, "Base Data Types").
    pub data_type: u16,
    /// The highest subindex.
    pub max_sub: u8,
    /// 7 variable, 8 array, 9 record.
    pub code: u8,
    pub name: String,
}

/// The device's description of one subindex.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EntryDescription {
    pub index: u16,
    pub sub: u8,
    /// As [`ObjectDescription::data_type`].
    pub data_type: u16,
    pub bit_len: u16,
    /// Bits 0 to 2: readable in PreOp, SafeOp, Op; 3 to 5: writable; 6 and 7: mappable into RxPDOs
    /// and TxPDOs; 8: backup; 9: setting (ETG.1000.6 Table 46).
    pub access: u16,
    pub name: String,
}

impl CoeClient {
    /// Returns the number of objects in each list, in the order of [`ObjectList`].
    pub async fn list_lengths<W: MailboxTransport>(
        &mut self,
        w: &W,
    ) -> Result<[u16; 5], InfoError> {
        let asked = InfoRequest::Lengths;
        let data = self.inquire(w, asked).await?;
        let words: Vec<u16> = words(data.get(2..).unwrap_or_default()).collect();
        words
            .try_into()
            .map_err(|_| self.malformed(asked, format!("{} bytes for 5 lengths", data.len())))
    }

    /// Returns the indices in the device's order.
    pub async fn object_list<W: MailboxTransport>(
        &mut self,
        w: &W,
        list: ObjectList,
    ) -> Result<Vec<u16>, InfoError> {
        let asked = InfoRequest::List(list);
        let data = self.inquire(w, asked).await?;
        if data.len() % 2 != 0 {
            return Err(self.malformed(asked, "half an index at its end"));
        }
        Ok(words(data.get(2..).unwrap_or_default()).collect())
    }

    pub async fn object_description<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
    ) -> Result<ObjectDescription, InfoError> {
        let asked = InfoRequest::Object(index);
        let data = self.inquire(w, asked).await?;
        let [_, _, low, high, max_sub, code, name @ ..] = data.as_slice() else {
            return Err(self.malformed(asked, format!("{} bytes are too few", data.len())));
        };
        Ok(ObjectDescription {
            index,
            data_type: u16::from_le_bytes([*low, *high]),
            max_sub: *max_sub,
            code: *code & 0x0f,
            name: text(name),
        })
    }

    pub async fn entry_description<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
        sub: u8,
    ) -> Result<EntryDescription, InfoError> {
        let asked = InfoRequest::Entry(index, sub);
        let data = self.inquire(w, asked).await?;
        let [_, _, _, reported, t0, t1, b0, b1, a0, a1, rest @ ..] = data.as_slice() else {
            return Err(self.malformed(asked, format!("{} bytes are too few", data.len())));
        };
        let bit_len = u16::from_le_bytes([*b0, *b1]);
        let value = usize::from(bit_len.div_ceil(8));
        // Values that were not requested but that some devices send: unit, default, minimum and
        // maximum.
        let before = [(0x08, 4), (0x10, value), (0x20, value), (0x40, value)]
            .iter()
            .filter(|(bit, _)| reported & bit != 0)
            .map(|(_, len)| len)
            .sum::<usize>();
        let Some(name) = rest.get(before..) else {
            let what = format!("{} bytes, {before} of them announced as values", rest.len());
            return Err(self.malformed(asked, what));
        };
        Ok(EntryDescription {
            index,
            sub,
            data_type: u16::from_le_bytes([*t0, *t1]),
            bit_len,
            access: u16::from_le_bytes([*a0, *a1]),
            name: text(name),
        })
    }

    /// Returns the whole answer without the headers of its fragments. If a frame with a fragment
    /// was lost, a fast device may already have filled its mailbox with the next fragment. The
    /// request is then repeated.
    async fn inquire<W: MailboxTransport>(
        &mut self,
        w: &W,
        asked: InfoRequest,
    ) -> Result<Vec<u8>, InfoError> {
        let total = Deadline::after(w, self.port.timeouts.transfer);
        let mut tries = 1;
        loop {
            match self.ask_once(w, asked, &total).await {
                Err(InfoFailure::Gap(_)) if tries < MAX_ATTEMPTS => tries += 1,
                Err(InfoFailure::Gap(error) | InfoFailure::For(error)) => return Err(error),
                Ok(data) => return Ok(data),
            }
        }
    }

    async fn ask_once<W: MailboxTransport>(
        &mut self,
        w: &W,
        asked: InfoRequest,
        total: &Deadline,
    ) -> Result<Vec<u8>, InfoFailure> {
        let body = asked.body();
        let request = Request::Information {
            opcode: asked.opcode(),
            body: &body,
        };
        let ready = self.drain_after_failure(w).await;
        ready.map_err(|trouble| self.error(asked, trouble))?;
        let sent = self.port.send(w, &request).await;
        sent.map_err(|trouble| self.error(asked, trouble))?;

        let mut data = Vec::new();
        // The number of fragments still to come, once the first has arrived.
        let mut expected: Option<u16> = None;
        let mut answer = Deadline::after(w, self.port.timeouts.answer);
        loop {
            if total.passed(w) {
                return Err(self
                    .error(asked, TransportError::Timeout(Phase::Transfer))
                    .into());
            }
            let received = self.port.receive(w, &mut answer).await;
            if let Err(trouble) = received {
                let silent = matches!(trouble, TransportError::Timeout(Phase::Answer));
                let error = self.error(asked, trouble);
                return Err(match expected {
                    Some(_) if silent => InfoFailure::Gap(error),
                    _ => InfoFailure::For(error),
                });
            }
            let fragment = match Message::parse(self.port.message()) {
                Ok(Message::Information(fragment))
                    if self.is_answer(asked, expected, &fragment) =>
                {
                    fragment
                }
                Ok(Message::Information(Fragment {
                    opcode: ERROR,
                    data,
                    ..
                })) => {
                    let code = data.first_chunk().map(|code| u32::from_le_bytes(*code));
                    return Err(match code {
                        Some(code) => self.aborted(asked, code).into(),
                        None => self.malformed(asked, "an error without its code").into(),
                    });
                }
                // Some devices refuse unknown requests with an SDO abort.
                Ok(Message::Sdo(Answer::Abort { code, .. })) => {
                    return Err(self.aborted(asked, code).into());
                }
                Ok(Message::Refused(code)) => {
                    return Err(self.failure(asked, CoeCause::Refused(code)).into());
                }
                Ok(_) => {
                    self.port.set_aside(w);
                    if answer.passed(w) {
                        return Err(self
                            .error(asked, TransportError::Timeout(Phase::Answer))
                            .into());
                    }
                    answer.pause(w).await;
                    continue;
                }
                Err(flaw) => return Err(self.malformed(asked, flaw).into()),
            };
            let left = fragment.left;
            if let Some(expected) = expected
                && left != expected
            {
                let what = format!("{left} fragments to come where {expected} were");
                let error = self.malformed(asked, what);
                return Err(match left < expected {
                    true => InfoFailure::Gap(error),
                    false => InfoFailure::For(error),
                });
            }
            if data.len() + fragment.data.len() > MAX_ANSWER {
                let what = format!("more than {MAX_ANSWER} bytes");
                return Err(self.malformed(asked, what).into());
            }
            if fragment.data.is_empty() && left > 0 {
                return Err(self.malformed(asked, "a fragment without data").into());
            }
            data.extend_from_slice(fragment.data);
            match left.checked_sub(1) {
                Some(next) => expected = Some(next),
                None => break,
            }
            answer = Deadline::after(w, self.port.timeouts.answer);
        }
        self.port.answered();
        self.unsettled = false;
        Ok(data)
    }

    /// Later fragments do not identify their request; the mailbox was empty before the first one.
    fn is_answer(
        &self,
        asked: InfoRequest,
        expected: Option<u16>,
        fragment: &Fragment<'_>,
    ) -> bool {
        fragment.opcode == asked.opcode() + 1 && (expected.is_some() || asked.begins(fragment.data))
    }

    fn aborted(&mut self, asked: InfoRequest, code: u32) -> InfoError {
        self.port.answered();
        self.unsettled = false;
        self.failure(asked, CoeCause::Abort(code))
    }

    fn malformed(&self, asked: InfoRequest, what: impl ToString) -> InfoError {
        self.failure(asked, CoeCause::Malformed(what.to_string()))
    }

    fn error(&self, asked: InfoRequest, trouble: TransportError) -> InfoError {
        self.failure(asked, explain(&self.port, trouble, 0))
    }

    fn failure(&self, asked: InfoRequest, cause: CoeCause) -> InfoError {
        InfoError {
            station: self.port.layout.station,
            asked,
            cause,
        }
    }
}

fn words(bytes: &[u8]) -> impl Iterator<Item = u16> + '_ {
    bytes.chunks_exact(2).map(|word| match word {
        [low, high] => u16::from_le_bytes([*low, *high]),
        _ => 0,
    })
}

/// Decodes a name. Names are not terminated, but some devices terminate them. Invalid UTF-8 is
/// decoded as Latin-1.
fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().rposition(|byte| *byte != 0);
    let bytes = end.and_then(|end| bytes.get(..=end)).unwrap_or_default();
    match std::str::from_utf8(bytes) {
        Ok(text) => text.to_owned(),
        Err(_) => bytes.iter().map(|byte| char::from(*byte)).collect(),
    }
}
