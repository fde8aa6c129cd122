//! The CoE client of one SubDevice: SDO upload and download, expedited, normal and segmented, with
//! complete access.

use ecaxis_ecat::mailbox::abort_code;
use ecaxis_ecat::mailbox::coe::{Answer, Message, Request, download_room, segment_room};

use super::emergency::{Emergencies, Emergency};
use super::error::{CoeCause, Phase, SdoError};
use super::transfer::{Transfer, TransferFailure, drain_error};
use super::transport::{Deadline, Port, TransportError};
use super::{MailboxLayout, MailboxTransport, Timeouts};

/// The maximum size of an object in bytes; a firmware program may be longer.
pub const MAX_OBJECT: usize = 1 << 20;
/// The maximum number of messages that [`CoeClient::drain`] reads per call.
const DRAIN: usize = 64;

/// The CoE mailbox of one SubDevice, for one transfer at a time. After a transfer that failed or
/// was dropped, the next one never takes an old answer for its own.
#[derive(Debug)]
pub struct CoeClient {
    pub(super) port: Port,
    /// A transfer ended without its last answer, which may still arrive.
    pub(super) unsettled: bool,
    /// True if the answer to an earlier request may still arrive.
    late_answer: bool,
    /// The object of the segmented transfer in progress, as far as known.
    pub(super) in_segments: Option<(u16, u8)>,
    /// Another program may have used the mailbox of a device with SoE alone.
    pub(super) joins_soe: bool,
}

impl CoeClient {
    pub fn new(layout: MailboxLayout) -> Self {
        Self {
            port: Port::new(layout),
            unsettled: true,
            late_answer: true,
            in_segments: None,
            joins_soe: false,
        }
    }

    /// Returns a client for the same mailbox of a device that has restarted. Both share the queue of
    /// emergencies.
    pub fn restarted(&self) -> Self {
        Self {
            port: self.port.restarted(),
            ..Self::new(self.port.layout)
        }
    }

    /// Creates a client for a mailbox that another program may have used since the device was in
    /// Init. The counter (ETG.1000.4) that the device saw last is then unknown. The device would
    /// drop a request with that counter as a repetition.
    ///
    /// Therefore an abort precedes the first request. Devices do not answer an abort, whether they
    /// drop it or end a transfer. The next request has another counter in either case.
    pub fn joining(layout: MailboxLayout) -> Self {
        const DEVICE_TYPE: u16 = 0x1000;
        Self {
            in_segments: Some((DEVICE_TYPE, 0)),
            ..Self::new(layout)
        }
    }

    /// As [`CoeClient::joining`], of a device with SoE and without CoE. A read whose answer is dropped
    /// precedes the first request.
    pub fn joining_soe(layout: MailboxLayout) -> Self {
        Self {
            joins_soe: true,
            ..Self::new(layout)
        }
    }

    /// Returns the client with other timeouts.
    #[must_use]
    pub fn with_timeouts(mut self, timeouts: Timeouts) -> Self {
        self.port.timeouts = timeouts;
        self
    }

    /// Sets other timeouts and returns the previous ones.
    pub fn set_timeouts(&mut self, timeouts: Timeouts) -> Timeouts {
        std::mem::replace(&mut self.port.timeouts, timeouts)
    }

    pub fn layout(&self) -> &MailboxLayout {
        &self.port.layout
    }

    /// Reads an object. If `complete`, reads all of it from `sub` (0 or 1) on, in the layout of
    /// ETG.1000.6.
    pub async fn upload<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
        sub: u8,
        complete: bool,
    ) -> Result<Vec<u8>, SdoError> {
        let mut transfer = self.begin(w, index, sub, complete).await?;
        let result = self.upload_in(w, &mut transfer).await;
        self.end(w, &transfer, result).await
    }

    /// Reads an object; `None` if the device does not have it or refuses to send it.
    pub async fn upload_optional<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
        sub: u8,
        complete: bool,
    ) -> Result<Option<Vec<u8>>, SdoError> {
        match self.upload(w, index, sub, complete).await {
            Ok(data) => Ok(Some(data)),
            Err(error) if error.abort_code().is_some() => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Reads an integer of at most 32 bits; `None` if the device refuses the object or returns no
    /// byte.
    pub async fn upload_integer<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
        sub: u8,
    ) -> Result<Option<u32>, SdoError> {
        let data = self.upload_optional(w, index, sub, false).await?;
        Ok(data.filter(|data| !data.is_empty()).map(|data| {
            let bytes = data.iter().take(4).rev();
            bytes.fold(0, |value, byte| value << 8 | u32::from(*byte))
        }))
    }

    /// Reads subindices 1 to n of an array with n in subindex 0; `None` if the device has no such
    /// object, or counts a subindex that it refuses.
    pub async fn upload_list<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
    ) -> Result<Option<Vec<u32>>, SdoError> {
        let Some(count) = self.upload_integer(w, index, 0).await? else {
            return Ok(None);
        };
        let count = u8::try_from(count).unwrap_or(u8::MAX);
        let mut list = Vec::with_capacity(usize::from(count));
        for sub in 1..=count {
            match self.upload_integer(w, index, sub).await? {
                Some(value) => list.push(value),
                None => return Ok(None),
            }
        }
        Ok(Some(list))
    }

    /// Reads a text up to its first NUL, without control characters; `None` if the device refuses
    /// the object or nothing remains.
    pub async fn upload_text<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
    ) -> Result<Option<String>, SdoError> {
        const MAX_CHARACTERS: usize = 80;
        let data = self.upload_optional(w, index, 0, false).await?;
        let data = data.unwrap_or_default();
        let text = data.split(|byte| *byte == 0).next().unwrap_or_default();
        let text = String::from_utf8_lossy(text);
        let shown = text.trim().chars().filter(|c| !c.is_control());
        let text: String = shown.take(MAX_CHARACTERS).collect();
        Ok((!text.is_empty()).then_some(text))
    }

    /// Writes an object. If `complete`, writes all of it from `sub` (0 or 1) on.
    pub async fn download<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
        sub: u8,
        complete: bool,
        data: &[u8],
    ) -> Result<(), SdoError> {
        let mut transfer = self.begin(w, index, sub, complete).await?;
        let result = self
            .download_in(w, &mut transfer, data, MAX_OBJECT, &mut |_| {})
            .await;
        self.end(w, &transfer, result).await
    }

    /// Writes one subindex of any length, such as a firmware program, and reports the bytes
    /// accepted so far.
    pub async fn download_with<W: MailboxTransport>(
        &mut self,
        w: &W,
        (index, sub): (u16, u8),
        data: &[u8],
        progress: &mut dyn FnMut(usize),
    ) -> Result<(), SdoError> {
        let mut transfer = self.begin(w, index, sub, false).await?;
        let result = self
            .download_in(w, &mut transfer, data, usize::MAX, progress)
            .await;
        self.end(w, &transfer, result).await
    }

    /// Empties the SubDevice's mailbox: keeps emergencies and drops all other messages. Returns how
    /// many messages it read.
    pub async fn drain<W: MailboxTransport>(&mut self, w: &W) -> Result<usize, SdoError> {
        let drained = match self.port.check() {
            Ok(()) => self.port.drain(w, DRAIN).await,
            Err(trouble) => Err(trouble),
        };
        drained.map_err(|trouble| drain_error(&self.port, trouble))
    }

    /// Takes the emergencies since the last call, oldest first.
    pub fn take_emergencies(&mut self) -> impl Iterator<Item = Emergency> + '_ {
        let taken = self.port.emergencies.take().into_iter();
        taken.map(|received| received.emergency)
    }

    /// Returns the queue of emergencies; it can be emptied during a transfer.
    pub fn emergencies(&self) -> Emergencies {
        self.port.emergencies.clone()
    }

    /// True if the cycle has seen a message in the mailbox that was not read yet.
    pub fn has_message<W: MailboxTransport>(&self, w: &W) -> bool {
        self.port.waits(w)
    }

    /// Ends a transfer whose future was dropped: sends an abort and empties the mailbox. The next
    /// transfer would do this as well.
    pub async fn abort_transfer<W: MailboxTransport>(&mut self, w: &W) -> Result<(), SdoError> {
        let settled = self.drain_after_failure(w).await;
        settled.map_err(|trouble| drain_error(&self.port, trouble))
    }

    /// Returns how many emergencies were dropped because the queue was full.
    pub fn lost_emergencies(&self) -> u64 {
        self.port.emergencies.lost()
    }

    /// Returns how many unexpected messages arrived, not counting emergencies.
    pub fn set_aside(&self) -> u64 {
        self.port.forgotten
    }

    async fn begin<W: MailboxTransport>(
        &mut self,
        w: &W,
        index: u16,
        sub: u8,
        complete: bool,
    ) -> Result<Transfer, SdoError> {
        let transfer = Transfer {
            station: self.port.layout.station,
            index,
            sub,
            complete,
            deadline: Deadline::after(w, self.port.timeouts.transfer),
            forgotten: self.port.forgotten,
        };
        let ready = self.drain_after_failure(w).await;
        ready.map_err(|trouble| transfer.trouble(&self.port, trouble).error)?;
        Ok(transfer)
    }

    /// Ensures that messages from now on belong to requests from now on.
    pub(super) async fn drain_after_failure<W: MailboxTransport>(
        &mut self,
        w: &W,
    ) -> Result<(), TransportError> {
        self.port.check()?;
        if let Some((index, sub)) = self.in_segments.take() {
            let code = abort_code::GENERAL;
            let farewell = Request::Abort { index, sub, code };
            // The device may not receive it; whether it is present shows in the next step.
            let _ = self.port.send(w, &farewell).await;
        }
        if std::mem::take(&mut self.joins_soe) {
            self.join_soe(w).await?;
        }
        self.late_answer = self.unsettled;
        if self.unsettled {
            self.port.drain(w, DRAIN).await?;
        }
        self.unsettled = true;
        Ok(())
    }

    async fn end<W: MailboxTransport, T>(
        &mut self,
        w: &W,
        transfer: &Transfer,
        result: Result<T, TransferFailure>,
    ) -> Result<T, SdoError> {
        self.in_segments = None;
        match result {
            Ok(value) => {
                self.unsettled = false;
                Ok(value)
            }
            Err(TransferFailure { error, abort }) => {
                if error.abort_code().is_some() {
                    self.unsettled = false;
                }
                if let Some(code) = abort {
                    // The device may not receive it; the caller needs the first error.
                    let farewell = Request::Abort {
                        index: transfer.index,
                        sub: transfer.sub,
                        code,
                    };
                    let _ = self.port.send(w, &farewell).await;
                }
                Err(error)
            }
        }
    }

    async fn upload_in<W: MailboxTransport>(
        &mut self,
        w: &W,
        transfer: &mut Transfer,
    ) -> Result<Vec<u8>, TransferFailure> {
        let Transfer {
            index,
            sub,
            complete,
            ..
        } = *transfer;
        let (size, mut data) = self
            .ask(
                w,
                transfer,
                &Request::Upload {
                    index,
                    sub,
                    complete,
                },
                |answer| match answer {
                    Answer::Upload { size, data, .. } => Some((*size, data.to_vec())),
                    _ => None,
                },
            )
            .await?;
        if size > MAX_OBJECT {
            return Err(transfer
                .failure(CoeCause::TooLarge(size))
                .with_abort_code(abort_code::NO_MEMORY));
        }
        if data.len() >= size {
            return Ok(data);
        }
        self.in_segments = Some((index, sub));
        let mut toggle = false;
        loop {
            let (seen, last, part) = self
                .ask(
                    w,
                    transfer,
                    &Request::UploadSegment { toggle },
                    |answer| match answer {
                        Answer::UploadSegment { toggle, last, data } => {
                            Some((*toggle, *last, data.to_vec()))
                        }
                        _ => None,
                    },
                )
                .await?;
            if seen != toggle {
                return Err(transfer
                    .malformed("the toggle bit of a segment did not alternate")
                    .with_abort_code(abort_code::TOGGLE));
            }
            if part.is_empty() && !last {
                return Err(transfer
                    .malformed("a segment without data")
                    .with_abort_code(abort_code::GENERAL));
            }
            data.extend_from_slice(&part);
            if data.len() > size || last && data.len() < size {
                let what = format!("{size} bytes were announced, {} came", data.len());
                let ended = transfer.malformed(what);
                return Err(if last {
                    ended
                } else {
                    ended.with_abort_code(abort_code::GENERAL)
                });
            }
            if last {
                return Ok(data);
            }
            toggle = !toggle;
        }
    }

    async fn download_in<W: MailboxTransport>(
        &mut self,
        w: &W,
        transfer: &mut Transfer,
        data: &[u8],
        most: usize,
        progress: &mut dyn FnMut(usize),
    ) -> Result<(), TransferFailure> {
        let Transfer {
            index,
            sub,
            complete,
            ..
        } = *transfer;
        let size = match u32::try_from(data.len()) {
            Ok(size) if data.len() <= most => size,
            _ => return Err(transfer.failure(CoeCause::TooLarge(data.len()))),
        };
        let expedited = (1..=4).contains(&data.len()) && !complete;
        let room = download_room(self.port.layout.out_len);
        let (first, mut rest) = if expedited {
            (data, &[][..])
        } else {
            data.split_at(room.min(data.len()))
        };
        let request = if expedited {
            Request::DownloadExpedited {
                index,
                sub,
                data: first,
            }
        } else {
            Request::Download {
                index,
                sub,
                complete,
                size,
                data: first,
            }
        };
        self.ask(w, transfer, &request, |answer| {
            matches!(answer, Answer::Download { .. }).then_some(())
        })
        .await?;
        progress(first.len());

        let room = segment_room(self.port.layout.out_len);
        self.in_segments = (!rest.is_empty()).then_some((index, sub));
        let mut toggle = false;
        while !rest.is_empty() {
            let (part, remaining) = rest.split_at(room.min(rest.len()));
            rest = remaining;
            let request = Request::DownloadSegment {
                toggle,
                last: rest.is_empty(),
                data: part,
            };
            let seen = self
                .ask(w, transfer, &request, |answer| match answer {
                    Answer::DownloadSegment { toggle } => Some(*toggle),
                    _ => None,
                })
                .await?;
            if seen != toggle {
                return Err(transfer
                    .malformed("the toggle bit of a segment did not alternate")
                    .with_abort_code(abort_code::TOGGLE));
            }
            toggle = !toggle;
            progress(data.len() - rest.len());
        }
        Ok(())
    }

    /// Sends a request and waits for its answer. `expected` extracts the result from the answer.
    /// Answers to other requests are discarded.
    async fn ask<W: MailboxTransport, T>(
        &mut self,
        w: &W,
        transfer: &mut Transfer,
        request: &Request<'_>,
        expected: impl Fn(&Answer<'_>) -> Option<T>,
    ) -> Result<T, TransferFailure> {
        let in_segments = matches!(
            request,
            Request::UploadSegment { .. } | Request::DownloadSegment { .. }
        );
        let reported = |ended: TransferFailure, code| {
            if in_segments {
                ended.with_abort_code(code)
            } else {
                ended
            }
        };
        if let Err(trouble) = self.port.send(w, request).await {
            return Err(transfer.trouble(&self.port, trouble));
        }
        let mut deadline = Deadline::after(w, self.port.timeouts.answer);
        loop {
            if transfer.deadline.passed(w) {
                let ended = transfer.trouble(&self.port, TransportError::Timeout(Phase::Transfer));
                return Err(reported(ended, abort_code::TIMEOUT));
            }
            match self.port.receive(w, &mut deadline).await {
                Ok(()) => {}
                Err(trouble @ TransportError::Timeout(_)) => {
                    return Err(reported(
                        transfer.trouble(&self.port, trouble),
                        abort_code::TIMEOUT,
                    ));
                }
                Err(trouble) => return Err(transfer.trouble(&self.port, trouble)),
            }
            match Message::parse(self.port.message()) {
                // Segments carry no address, and in an abort among them some devices leave it empty
                // as well.
                Ok(Message::Sdo(Answer::Abort { index, sub, code }))
                    if in_segments || !self.late_answer || transfer.may_abort_with(index, sub) =>
                {
                    self.port.answered();
                    return Err(transfer.failure(CoeCause::Abort(code)));
                }
                Ok(Message::Sdo(answer)) if transfer.fits(&answer) => {
                    if let Some(value) = expected(&answer) {
                        self.port.answered();
                        return Ok(value);
                    }
                }
                Ok(Message::Refused(code)) => return Err(transfer.failure(CoeCause::Refused(code))),
                Ok(_) => {}
                Err(flaw) => return Err(reported(transfer.malformed(flaw), abort_code::GENERAL)),
            }
            self.port.set_aside(w);
            if deadline.passed(w) {
                let ended = transfer.trouble(&self.port, TransportError::Timeout(Phase::Answer));
                return Err(reported(ended, abort_code::TIMEOUT));
            }
            deadline.pause(w).await;
        }
    }
}
