//! The CoE client of one SubDevice: SDO upload and download, expedited, normal and segmented, with complete access.

use super::coe::{Answer, Message, Request, download_room, parse, segment_room};
use super::emergency::{Emergencies, Emergency};
use super::error::{Phase, SdoError};
use super::port::{Deadline, Port, Trouble};
use super::transfer::{Ended, Transfer, emptying};
use super::{MailboxLayout, Timeouts, Wire};

/// Bytes of the largest object that is read or written; a program may be longer.
pub const MAX_OBJECT: usize = 1 << 20;
/// Messages that [`CoeClient::drain`] reads at most in one go.
const DRAIN: usize = 64;

const ABORT_TOGGLE: u32 = 0x0503_0000;
const ABORT_TIMEOUT: u32 = 0x0504_0000;
const ABORT_MEMORY: u32 = 0x0504_0005;
const ABORT_GENERAL: u32 = 0x0800_0000;

/// One SubDevice's CoE mailbox. One transfer at a time. A transfer that failed, or whose future was dropped, leaves
/// nothing behind that the next one would take for its answer.
#[derive(Debug)]
pub struct CoeClient {
    pub(super) port: Port,
    /// A transfer ended without its last answer; it may still come.
    pub(super) unsettled: bool,
    /// The object whose segments are under way, as far as is known.
    in_segments: Option<(u16, u8)>,
}

impl CoeClient {
    pub fn new(layout: MailboxLayout) -> Self {
        Self {
            port: Port::new(layout),
            unsettled: true,
            in_segments: None,
        }
    }

    /// The client of a mailbox that another program may have used since the device was in Init: which counter
    /// (ETG.1000.4) the device saw last is not known, and a request with that counter would be dropped as a repetition.
    /// An abort goes before the first request. No device answers an abort, whether it drops it or ends a transfer by
    /// it, and the counter of the request is another one in either case.
    pub fn joining(layout: MailboxLayout) -> Self {
        const DEVICE_TYPE: u16 = 0x1000;
        Self {
            in_segments: Some((DEVICE_TYPE, 0)),
            ..Self::new(layout)
        }
    }

    /// The same with other timeouts.
    #[must_use]
    pub fn with_timeouts(mut self, timeouts: Timeouts) -> Self {
        self.port.timeouts = timeouts;
        self
    }

    /// For what takes longer or shorter; returns those until now.
    pub fn set_timeouts(&mut self, timeouts: Timeouts) -> Timeouts {
        std::mem::replace(&mut self.port.timeouts, timeouts)
    }

    pub fn layout(&self) -> &MailboxLayout {
        &self.port.layout
    }

    /// Reads an object. With `complete` all of it from `sub` (0 or 1) on, as ETG.1000.6 lays it out.
    pub async fn upload<W: Wire>(
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

    /// Writes an object. With `complete` all of it from `sub` (0 or 1) on.
    pub async fn download<W: Wire>(
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

    /// Writes one subindex, which may be as long as a program, and tells how many bytes have been taken.
    pub async fn download_with<W: Wire>(
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

    /// Empties the SubDevice's mailbox: keeps emergencies, forgets everything else. Returns how many messages it read.
    pub async fn drain<W: Wire>(&mut self, w: &W) -> Result<usize, SdoError> {
        let drained = match self.port.check() {
            Ok(()) => self.port.drain(w, DRAIN).await,
            Err(trouble) => Err(trouble),
        };
        drained.map_err(|trouble| emptying(&self.port, trouble))
    }

    /// What the SubDevice reported unasked since the last call, oldest first.
    pub fn take_emergencies(&mut self) -> impl Iterator<Item = Emergency> + '_ {
        let taken = self.port.emergencies.take().into_iter();
        taken.map(|received| received.emergency)
    }

    /// The queue of what the SubDevice reports unasked; it can be emptied while a transfer goes on.
    pub fn emergencies(&self) -> Emergencies {
        self.port.emergencies.clone()
    }

    /// Whether somebody else has seen a message in the mailbox that nobody has read.
    pub fn waits<W: Wire>(&self, w: &W) -> bool {
        self.port.waits(w)
    }

    /// Ends a transfer whose future was dropped: the SubDevice is told, and its mailbox emptied. The next transfer would do so.
    pub async fn give_up<W: Wire>(&mut self, w: &W) -> Result<(), SdoError> {
        let settled = self.settle(w).await;
        settled.map_err(|trouble| emptying(&self.port, trouble))
    }

    /// How many emergencies found the queue full.
    pub fn lost_emergencies(&self) -> u64 {
        self.port.emergencies.lost()
    }

    /// How many messages came that nothing waited for, emergencies not counted.
    pub fn set_aside(&self) -> u64 {
        self.port.forgotten
    }

    async fn begin<W: Wire>(
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
        let ready = self.settle(w).await;
        ready.map_err(|trouble| transfer.trouble(&self.port, trouble).error)?;
        Ok(transfer)
    }

    /// Makes sure that what arrives from now on belongs to what is sent from now on.
    pub(super) async fn settle<W: Wire>(&mut self, w: &W) -> Result<(), Trouble> {
        self.port.check()?;
        if let Some((index, sub)) = self.in_segments.take() {
            let code = ABORT_GENERAL;
            let farewell = Request::Abort { index, sub, code };
            // The device may not hear it; whether it is there at all shows now.
            let _ = self.port.send(w, &farewell).await;
        }
        if self.unsettled {
            self.port.drain(w, DRAIN).await?;
        }
        self.unsettled = true;
        Ok(())
    }

    async fn end<W: Wire, T>(
        &mut self,
        w: &W,
        transfer: &Transfer,
        result: Result<T, Ended>,
    ) -> Result<T, SdoError> {
        self.in_segments = None;
        match result {
            Ok(value) => {
                self.unsettled = false;
                Ok(value)
            }
            Err(Ended { error, abort }) => {
                if matches!(error, SdoError::Abort { .. }) {
                    self.unsettled = false;
                }
                if let Some(code) = abort {
                    // The device may not hear it; what matters to the caller is the first error.
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

    async fn upload_in<W: Wire>(
        &mut self,
        w: &W,
        transfer: &mut Transfer,
    ) -> Result<Vec<u8>, Ended> {
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
            return Err(transfer.too_large(size).telling(ABORT_MEMORY));
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
                    .telling(ABORT_TOGGLE));
            }
            if part.is_empty() && !last {
                return Err(transfer
                    .malformed("a segment without data")
                    .telling(ABORT_GENERAL));
            }
            data.extend_from_slice(&part);
            if data.len() > size || last && data.len() < size {
                let what = format!("{size} bytes were announced, {} came", data.len());
                let ended = transfer.malformed(what);
                return Err(if last {
                    ended
                } else {
                    ended.telling(ABORT_GENERAL)
                });
            }
            if last {
                return Ok(data);
            }
            toggle = !toggle;
        }
    }

    async fn download_in<W: Wire>(
        &mut self,
        w: &W,
        transfer: &mut Transfer,
        data: &[u8],
        most: usize,
        progress: &mut dyn FnMut(usize),
    ) -> Result<(), Ended> {
        let Transfer {
            index,
            sub,
            complete,
            ..
        } = *transfer;
        let size = match u32::try_from(data.len()) {
            Ok(size) if data.len() <= most => size,
            _ => return Err(transfer.too_large(data.len())),
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
                    .telling(ABORT_TOGGLE));
            }
            toggle = !toggle;
            progress(data.len() - rest.len());
        }
        Ok(())
    }

    /// Sends a request and waits for its answer. `expected` picks what it needs out of the answer; what answers
    /// something else is set aside.
    async fn ask<W: Wire, T>(
        &mut self,
        w: &W,
        transfer: &mut Transfer,
        request: &Request<'_>,
        expected: impl Fn(&Answer<'_>) -> Option<T>,
    ) -> Result<T, Ended> {
        let in_segments = matches!(
            request,
            Request::UploadSegment { .. } | Request::DownloadSegment { .. }
        );
        let told = |ended: Ended, code| {
            if in_segments {
                ended.telling(code)
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
                let ended = transfer.trouble(&self.port, Trouble::Timeout(Phase::Transfer));
                return Err(told(ended, ABORT_TIMEOUT));
            }
            match self.port.receive(w, &mut deadline).await {
                Ok(()) => {}
                Err(trouble @ Trouble::Timeout(_)) => {
                    return Err(told(transfer.trouble(&self.port, trouble), ABORT_TIMEOUT));
                }
                Err(trouble) => return Err(transfer.trouble(&self.port, trouble)),
            }
            match parse(self.port.message()) {
                // Among segments, which carry no address, devices do not fill in that of an abort either.
                Ok(Message::Sdo(Answer::Abort { index, code, .. }))
                    if in_segments || index == transfer.index =>
                {
                    self.port.free = true;
                    return Err(transfer.aborted(code));
                }
                Ok(Message::Sdo(answer)) if transfer.fits(&answer) => {
                    if let Some(value) = expected(&answer) {
                        self.port.free = true;
                        return Ok(value);
                    }
                }
                Ok(Message::Refused(code)) => return Err(transfer.refused(code)),
                Ok(_) => {}
                Err(flaw) => return Err(told(transfer.malformed(flaw), ABORT_GENERAL)),
            }
            self.port.set_aside(w);
            if deadline.passed(w) {
                let ended = transfer.trouble(&self.port, Trouble::Timeout(Phase::Answer));
                return Err(told(ended, ABORT_TIMEOUT));
            }
            deadline.pause(w).await;
        }
    }
}
