//! The two mailbox SyncManagers of one SubDevice (ETG.1000.4 clause on mailboxes): one message at a time each way,
//! with what is needed when frames get lost.

use std::mem;
use std::time::Duration;

use super::coe::{MAILBOX_MIN, Message, parse};
use super::emergency::Emergencies;
use super::error::Phase;
use super::{MailboxLayout, Timeouts, Wire, WireError};
use crate::link::MAX_DATA;

/// SyncManager register block: 8 bytes each from 0x0800.
const SM_BASE: u16 = 0x0800;
const SM_STATUS: u16 = 5;
const SM_ACTIVATE: u16 = 6;
const SM_PDI_CONTROL: u16 = 7;
const MAILBOX_FULL: u8 = 0x08;
/// In SM_ACTIVATE the request, in SM_PDI_CONTROL its acknowledgement: equal once the message has been repeated.
const REPEAT: u8 = 0x02;

/// Consecutive frames that may be lost, or come back untouched, before a device or bus counts as gone.
const PATIENCE: u32 = 5;
/// Messages in a row that are counted up show that a device counts; one alone may be chance.
const COUNTED: u32 = 3;
/// How often one answer may get lost.
const REPEATS: u32 = 3;

const POLL_MIN: Duration = Duration::from_micros(200);
const POLL_MAX: Duration = Duration::from_millis(2);

/// A message for a SubDevice.
pub(super) trait Emit {
    /// Writes the message over `out` and pads it to `mailbox` bytes: a SyncManager hands a mailbox over when its last
    /// byte is written.
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>);
}

#[derive(Debug)]
pub(super) enum Trouble {
    Timeout(Phase),
    Gone,
    Wire(WireError),
    /// The configured mailboxes cannot carry messages.
    Layout,
}

/// Waiting, with pauses that grow, until a moment.
#[derive(Debug)]
pub(super) struct Deadline {
    at: u64,
    pause: Duration,
}

impl Deadline {
    pub(super) fn after<W: Wire>(w: &W, time: Duration) -> Self {
        Self {
            at: w.now().saturating_add(nanos(time)),
            pause: POLL_MIN,
        }
    }

    pub(super) fn passed<W: Wire>(&self, w: &W) -> bool {
        w.now() >= self.at
    }

    pub(super) async fn pause<W: Wire>(&mut self, w: &W) {
        w.delay(self.pause).await;
        self.pause = (self.pause * 2).min(POLL_MAX);
    }
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

#[derive(Debug)]
pub(super) struct Port {
    pub(super) layout: MailboxLayout,
    pub(super) timeouts: Timeouts,
    pub(super) emergencies: Emergencies,
    /// Messages that nothing waited for.
    pub(super) forgotten: u64,
    outgoing: Vec<u8>,
    incoming: Vec<u8>,
    /// The message before it.
    previous: Vec<u8>,
    /// Messages in a row that the SubDevice has counted up.
    in_order: u32,
    /// When the mailbox was last read: what was seen of it before says nothing of what is in it now.
    read_at: u64,
    /// The SubDevice has taken the last request, so what fills its mailbox next is the next one.
    pub(super) free: bool,
    /// 1 to 7; tells the SubDevice a new message from one sent again.
    counter: u8,
}

impl Port {
    pub(super) fn new(layout: MailboxLayout) -> Self {
        Self {
            layout,
            timeouts: Timeouts::default(),
            emergencies: Emergencies::default(),
            forgotten: 0,
            outgoing: Vec::with_capacity(usize::from(layout.out_len)),
            incoming: vec![0; usize::from(layout.in_len)],
            previous: vec![0; usize::from(layout.in_len)],
            in_order: 0,
            read_at: 0,
            free: false,
            counter: 0,
        }
    }

    pub(super) fn check(&self) -> Result<(), Trouble> {
        let fits = |len| (MAILBOX_MIN..=MAX_DATA).contains(&len);
        if fits(self.layout.out_len) && fits(self.layout.in_len) {
            Ok(())
        } else {
            Err(Trouble::Layout)
        }
    }

    /// The message that [`Port::receive`] brought.
    pub(super) fn message(&self) -> &[u8] {
        &self.incoming
    }

    /// Puts a request into the SubDevice's mailbox. What lies in the other mailbox meanwhile is set aside, because a
    /// SubDevice that cannot get rid of an emergency may not look at its requests.
    pub(super) async fn send<W: Wire>(
        &mut self,
        w: &W,
        request: &impl Emit,
    ) -> Result<(), Trouble> {
        self.counter = self.counter % 7 + 1;
        request.emit(self.counter, self.layout.out_len, &mut self.outgoing);
        let mut deadline = Deadline::after(w, self.timeouts.request);
        let mut patience = Patience::default();
        let mut arrived = mem::take(&mut self.free);
        loop {
            // A write whose frame was lost may have arrived; sent again, the counter tells the SubDevice so. The wire may
            // send again as well, so that a free mailbox is found full.
            let written = w
                .write(self.layout.station, self.layout.out_address, &self.outgoing)
                .await;
            match patience.judge(written)? {
                Touched::Yes => return Ok(()),
                Touched::No => {
                    // Full, or gone? A register answers in either case unless the device is gone.
                    let full = self.status(w, self.layout.out_sm, &mut patience).await?;
                    if arrived && full {
                        // What fills it is this very request, as far as can be known. Its answer may be next; it must not be set aside.
                        return Ok(());
                    }
                    if !arrived && self.fetch(w, &mut patience).await? == Fetched::Message {
                        self.set_aside(w);
                    }
                }
                Touched::Lost => arrived = true,
            }
            if deadline.passed(w) {
                return Err(Trouble::Timeout(Phase::Request));
            }
            deadline.pause(w).await;
        }
    }

    /// Waits for the next message, whatever it is.
    pub(super) async fn receive<W: Wire>(
        &mut self,
        w: &W,
        deadline: &mut Deadline,
    ) -> Result<(), Trouble> {
        let mut patience = Patience::default();
        let mut repeats = 0;
        loop {
            match self.look(w, &mut patience).await? {
                Fetched::Message => return Ok(()),
                Fetched::Lost if repeats < REPEATS => {
                    repeats += 1;
                    self.repeat(w, &mut patience).await?;
                }
                Fetched::Lost => return Err(Trouble::Timeout(Phase::Repeat)),
                Fetched::Nothing | Fetched::Waiting => {}
            }
            if deadline.passed(w) {
                return Err(Trouble::Timeout(Phase::Answer));
            }
            deadline.pause(w).await;
        }
    }

    /// As [`Port::fetch`], without a datagram where the cycle sees that there is nothing.
    async fn look<W: Wire>(&mut self, w: &W, patience: &mut Patience) -> Result<Fetched, Trouble> {
        if self.waits(w) {
            return self.read(w, patience).await;
        }
        match w.seen_lately() {
            Some(_) => Ok(Fetched::Nothing),
            None => self.fetch(w, patience).await,
        }
    }

    /// Whether somebody has seen a message since the mailbox was last read.
    pub(super) fn waits<W: Wire>(&self, w: &W) -> bool {
        w.seen()
            .is_some_and(|seen| seen.full && seen.at > self.read_at)
    }

    /// Reads the mailbox if it is full.
    async fn fetch<W: Wire>(&mut self, w: &W, patience: &mut Patience) -> Result<Fetched, Trouble> {
        if !self.status(w, self.layout.in_sm, patience).await? {
            return Ok(Fetched::Nothing);
        }
        self.read(w, patience).await
    }

    /// Reads the mailbox, which is full.
    async fn read<W: Wire>(&mut self, w: &W, patience: &mut Patience) -> Result<Fetched, Trouble> {
        mem::swap(&mut self.incoming, &mut self.previous);
        let read = w
            .read(
                self.layout.station,
                self.layout.in_address,
                &mut self.incoming,
            )
            .await;
        self.read_at = w.now();
        let touched = patience.judge(read);
        if !matches!(touched, Ok(Touched::Yes)) {
            mem::swap(&mut self.incoming, &mut self.previous);
        }
        match touched? {
            Touched::Yes if self.is_repeated() => {
                self.forgotten += 1;
                Ok(Fetched::Waiting)
            }
            Touched::Yes => Ok(Fetched::Message),
            // The frame was lost on its way there, so the message still waits; or on its way back, and it is gone.
            Touched::No | Touched::Lost if self.status(w, self.layout.in_sm, patience).await? => {
                Ok(Fetched::Waiting)
            }
            Touched::No | Touched::Lost => Ok(Fetched::Lost),
        }
    }

    /// Whether the message is the one before it once more: the same counter and content. Only devices that count are judged, which
    /// shows in the messages before; others send the same counter whatever they say.
    fn is_repeated(&mut self) -> bool {
        let counter = |message: &[u8]| message.get(5).map_or(0, |kind| kind >> 4 & 7);
        let (now, before) = (counter(&self.incoming), counter(&self.previous));
        if self.in_order >= COUNTED && self.incoming == self.previous {
            return true;
        }
        self.in_order = if before != 0 && now == before % 7 + 1 {
            self.in_order.saturating_add(1)
        } else {
            0
        };
        false
    }

    /// Has the SubDevice put the last message back into its mailbox.
    async fn repeat<W: Wire>(&self, w: &W, patience: &mut Patience) -> Result<(), Trouble> {
        let asked = self
            .register(w, self.layout.in_sm, SM_ACTIVATE, patience)
            .await?
            ^ REPEAT;
        let mut deadline = Deadline::after(w, self.timeouts.request);
        let mut written = false;
        loop {
            if written {
                let acknowledged = self
                    .register(w, self.layout.in_sm, SM_PDI_CONTROL, patience)
                    .await?;
                if (acknowledged ^ asked) & REPEAT == 0 {
                    return Ok(());
                }
            } else {
                let register = sm_register(self.layout.in_sm, SM_ACTIVATE);
                written = patience.judge(w.write(self.layout.station, register, &[asked]).await)?
                    == Touched::Yes;
            }
            if deadline.passed(w) {
                return Err(Trouble::Timeout(Phase::Repeat));
            }
            deadline.pause(w).await;
        }
    }

    /// Reads and sets aside what lies in the mailbox; at most `most` messages, so that no device holds us up.
    pub(super) async fn drain<W: Wire>(&mut self, w: &W, most: usize) -> Result<usize, Trouble> {
        let mut patience = Patience::default();
        let mut count = 0;
        for _ in 0..most {
            match self.fetch(w, &mut patience).await? {
                Fetched::Message => {
                    self.set_aside(w);
                    count += 1;
                }
                Fetched::Waiting => w.delay(POLL_MIN).await,
                Fetched::Lost => match self.repeat(w, &mut patience).await {
                    // What cannot be had again is out of the way as well.
                    Ok(()) | Err(Trouble::Timeout(_)) => {}
                    Err(trouble) => return Err(trouble),
                },
                Fetched::Nothing => break,
            }
        }
        self.free = !self.status(w, self.layout.out_sm, &mut patience).await?;
        Ok(count)
    }

    /// Keeps an emergency and forgets everything else.
    pub(super) fn set_aside<W: Wire>(&mut self, w: &W) {
        match parse(&self.incoming) {
            Ok(Message::Emergency(emergency)) => self.emergencies.push(w.now(), emergency),
            _ => self.forgotten += 1,
        }
    }

    /// Whether a mailbox is full.
    async fn status<W: Wire>(
        &self,
        w: &W,
        sm: u8,
        patience: &mut Patience,
    ) -> Result<bool, Trouble> {
        Ok(self.register(w, sm, SM_STATUS, patience).await? & MAILBOX_FULL != 0)
    }

    /// One byte of a SyncManager, read again while frames get lost.
    async fn register<W: Wire>(
        &self,
        w: &W,
        sm: u8,
        offset: u16,
        patience: &mut Patience,
    ) -> Result<u8, Trouble> {
        loop {
            let mut byte = [0];
            match patience.judge(
                w.read(self.layout.station, sm_register(sm, offset), &mut byte)
                    .await,
            )? {
                Touched::Yes => {
                    patience.untouched = 0;
                    let [byte] = byte;
                    return Ok(byte);
                }
                Touched::No => patience.untouched += 1,
                Touched::Lost => {}
            }
            if patience.untouched >= PATIENCE {
                return Err(Trouble::Gone);
            }
            w.delay(POLL_MIN).await;
        }
    }
}

fn sm_register(sm: u8, offset: u16) -> u16 {
    SM_BASE + u16::from(sm) * 8 + offset
}

#[derive(Debug, PartialEq, Eq)]
enum Fetched {
    Nothing,
    Message,
    /// There is one, but it did not come.
    Waiting,
    /// There was one, and it is gone.
    Lost,
}

#[derive(Debug, PartialEq, Eq)]
enum Touched {
    Yes,
    No,
    Lost,
}

/// Tells a lost frame from a lost bus.
#[derive(Debug, Default)]
struct Patience {
    /// Frames lost in a row.
    lost: u32,
    /// Register reads in a row that no device took part in.
    untouched: u32,
}

impl Patience {
    fn judge(&mut self, result: Result<u16, WireError>) -> Result<Touched, Trouble> {
        match result {
            Ok(working_counter) => {
                self.lost = 0;
                Ok(if working_counter == 0 {
                    Touched::No
                } else {
                    Touched::Yes
                })
            }
            Err(WireError::Timeout { .. }) if self.lost + 1 < PATIENCE => {
                self.lost += 1;
                Ok(Touched::Lost)
            }
            Err(error) => Err(Trouble::Wire(error)),
        }
    }
}
