//! The two mailbox SyncManagers of one SubDevice (ETG.1000.4, clause on mailboxes): one message at
//! a time in each direction, with recovery from lost frames.

use std::mem;
use std::time::Duration;

use ecaxis_ecat::mailbox::coe::Message;
use ecaxis_ecat::mailbox::{Encode, MIN_LENGTH, eoe, soe};

use super::emergency::{Emergencies, Emergency};
use super::error::Phase;
use super::{DatagramError, MailboxLayout, MailboxTransport, Timeouts};
use crate::eoe::{EoePort, Turn};
use crate::link::MAX_DATA;
use ecaxis_ecat::registers;

const SM_STATUS: u16 = 5;
const SM_ACTIVATE: u16 = 6;
const SM_PDI_CONTROL: u16 = 7;
const MAILBOX_FULL: u8 = 0x08;
/// In SM_ACTIVATE the repeat request, in SM_PDI_CONTROL its acknowledgement: equal once the message
/// was repeated.
const REPEAT: u8 = 0x02;

/// After this many frames in a row that were lost or came back unprocessed, a device or bus counts
/// as gone.
const MAX_FAILURES: u32 = 5;
/// After this many messages in a row with an incremented counter, a device is known to count. A
/// single one may be chance.
const COUNTED: u32 = 3;
/// How often one answer may be lost.
const REPEATS: u32 = 3;

const POLL_MIN: Duration = Duration::from_micros(200);
const POLL_MAX: Duration = Duration::from_millis(2);

#[derive(Debug)]
pub(super) enum TransportError {
    Timeout(Phase),
    Gone,
    Wire(DatagramError),
    /// The configured mailboxes cannot carry messages.
    Layout,
}

/// Waits with growing pauses until a deadline.
#[derive(Debug)]
pub(super) struct Deadline {
    at: u64,
    pause: Duration,
}

impl Deadline {
    pub(super) fn after<W: MailboxTransport>(w: &W, time: Duration) -> Self {
        Self {
            at: w.now().saturating_add(nanos(time)),
            pause: POLL_MIN,
        }
    }

    pub(super) fn passed<W: MailboxTransport>(&self, w: &W) -> bool {
        w.now() >= self.at
    }

    pub(super) async fn pause<W: MailboxTransport>(&mut self, w: &W) {
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
    /// The number of unexpected messages.
    pub(super) forgotten: u64,
    outgoing: Vec<u8>,
    incoming: Vec<u8>,
    /// The previous message.
    previous: Vec<u8>,
    /// The number of messages in a row whose counter the SubDevice has incremented.
    in_order: u32,
    /// A device that counts has left out a counter: a message was lost.
    gap: bool,
    /// The time when the mailbox was last read; a status from before this time is obsolete.
    read_at: u64,
    /// The SubDevice has fetched the last request, so the next message fills an empty mailbox.
    free: bool,
    /// 1 to 7; the SubDevice distinguishes a new message from a repetition by it.
    counter: u8,
    /// A fragment of EoE was written since the last answer: a mailbox error may mean it.
    fragment_sent: bool,
    /// The last message written was a fragment. Devices may take it as late as they may answer.
    fragment_last: bool,
    /// The mailbox was full for the last fragment. If the wire has repeated the write, the device has
    /// it nevertheless, and another message needs another counter.
    offered: bool,
    /// The port of the switch that takes EoE messages.
    pub(super) eoe: Option<EoePort>,
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
            gap: false,
            read_at: 0,
            free: false,
            counter: 0,
            fragment_sent: false,
            fragment_last: false,
            offered: false,
            eoe: None,
        }
    }

    /// Returns the port of a device that has restarted.
    pub(super) fn restarted(&self) -> Self {
        if let Some(eoe) = &self.eoe {
            eoe.restart();
        }
        Self {
            timeouts: self.timeouts,
            emergencies: self.emergencies.clone(),
            forgotten: self.forgotten,
            eoe: self.eoe.clone(),
            ..Self::new(self.layout)
        }
    }

    pub(super) fn check(&self) -> Result<(), TransportError> {
        let fits = |len| (MIN_LENGTH..=MAX_DATA).contains(&len);
        if fits(self.layout.out_len) && fits(self.layout.in_len) {
            Ok(())
        } else {
            Err(TransportError::Layout)
        }
    }

    /// Returns the message that [`Port::receive`] has read.
    pub(super) fn message(&self) -> &[u8] {
        &self.incoming
    }

    /// Notes that the answer to the last request has arrived.
    pub(super) fn answered(&mut self) {
        (self.free, self.fragment_sent) = (true, false);
    }

    /// Puts a request into the SubDevice's mailbox. Messages that arrive meanwhile are read and set
    /// aside: a SubDevice with a pending emergency may not fetch requests.
    pub(super) async fn send<W: MailboxTransport>(
        &mut self,
        w: &W,
        request: &impl Encode,
    ) -> Result<(), TransportError> {
        self.withdraw();
        self.counter = self.counter % 7 + 1;
        request.emit(self.counter, self.layout.out_len, &mut self.outgoing);
        let (time, phase) = match mem::take(&mut self.fragment_last) {
            true => (self.timeouts.answer, Phase::Fragment),
            false => (self.timeouts.request, Phase::Request),
        };
        let mut deadline = Deadline::after(w, time);
        let mut budget = RetryBudget::default();
        let mut arrived = mem::take(&mut self.free);
        loop {
            // A write whose frame was lost may have arrived; the counter marks the repeated write
            // as a repetition. The wire may repeat frames as well, so that an empty mailbox appears
            // full.
            let written = w
                .write(self.layout.station, self.layout.out_address, &self.outgoing)
                .await;
            match budget.judge(written)? {
                WriteOutcome::Yes => return Ok(()),
                WriteOutcome::No => {
                    // Full, or gone? Unless the device is gone, a register read answers.
                    let full = self.status(w, self.layout.out_sm, &mut budget).await?;
                    if arrived && full {
                        // The mailbox most likely contains this request. Its answer may be next and
                        // must not be set aside.
                        return Ok(());
                    }
                    if !arrived && self.fetch(w, &mut budget).await? == ReadOutcome::Message {
                        self.set_aside(w);
                    }
                }
                WriteOutcome::Lost => arrived = true,
            }
            if deadline.passed(w) {
                return Err(TransportError::Timeout(phase));
            }
            deadline.pause(w).await;
        }
    }

    /// Waits for the next message that may belong to a request.
    pub(super) async fn receive<W: MailboxTransport>(
        &mut self,
        w: &W,
        deadline: &mut Deadline,
    ) -> Result<(), TransportError> {
        let mut budget = RetryBudget::default();
        let mut repeats = 0;
        loop {
            match self.look(w, &mut budget).await? {
                ReadOutcome::Message if self.take_refusal() || self.take_fragment(w) => {}
                ReadOutcome::Message => return Ok(()),
                ReadOutcome::Lost if repeats < REPEATS => {
                    repeats += 1;
                    self.repeat(w, &mut budget).await?;
                }
                ReadOutcome::Lost => return Err(TransportError::Timeout(Phase::Repeat)),
                ReadOutcome::Nothing | ReadOutcome::Waiting => {}
            }
            if deadline.passed(w) {
                return Err(TransportError::Timeout(Phase::Answer));
            }
            deadline.pause(w).await;
        }
    }

    /// As [`Port::fetch`], but sends no datagram if the cycle sees an empty mailbox.
    async fn look<W: MailboxTransport>(
        &mut self,
        w: &W,
        budget: &mut RetryBudget,
    ) -> Result<ReadOutcome, TransportError> {
        if self.waits(w) {
            return self.read(w, budget).await;
        }
        match w.seen_lately() {
            Some(_) => Ok(ReadOutcome::Nothing),
            None => self.fetch(w, budget).await,
        }
    }

    /// True if the cycle has seen a message since the mailbox was last read.
    pub(super) fn waits<W: MailboxTransport>(&self, w: &W) -> bool {
        w.seen()
            .is_some_and(|seen| seen.full && seen.at > self.read_at)
    }

    /// Reads the mailbox if it is full.
    async fn fetch<W: MailboxTransport>(
        &mut self,
        w: &W,
        budget: &mut RetryBudget,
    ) -> Result<ReadOutcome, TransportError> {
        if !self.status(w, self.layout.in_sm, budget).await? {
            return Ok(ReadOutcome::Nothing);
        }
        self.read(w, budget).await
    }

    /// Reads the full mailbox.
    async fn read<W: MailboxTransport>(
        &mut self,
        w: &W,
        budget: &mut RetryBudget,
    ) -> Result<ReadOutcome, TransportError> {
        mem::swap(&mut self.incoming, &mut self.previous);
        let read = w
            .read(
                self.layout.station,
                self.layout.in_address,
                &mut self.incoming,
            )
            .await;
        self.read_at = w.now();
        let touched = budget.judge(read);
        if !matches!(touched, Ok(WriteOutcome::Yes)) {
            mem::swap(&mut self.incoming, &mut self.previous);
        }
        match touched? {
            WriteOutcome::Yes if self.is_repeated() => {
                self.forgotten += 1;
                Ok(ReadOutcome::Waiting)
            }
            WriteOutcome::Yes => Ok(ReadOutcome::Message),
            // The frame was lost on its way out, so the message still waits. Otherwise it was lost
            // on its way back, and the message is gone.
            WriteOutcome::No | WriteOutcome::Lost
                if self.status(w, self.layout.in_sm, budget).await? =>
            {
                Ok(ReadOutcome::Waiting)
            }
            WriteOutcome::No | WriteOutcome::Lost => Ok(ReadOutcome::Lost),
        }
    }

    /// True if the message repeats the previous one: the same counter and content. This applies
    /// only to devices that count, as seen in earlier messages. Others always send the same
    /// counter.
    fn is_repeated(&mut self) -> bool {
        let counter = |message: &[u8]| message.get(5).map_or(0, |kind| kind >> 4 & 7);
        let (now, before) = (counter(&self.incoming), counter(&self.previous));
        if self.in_order >= COUNTED && self.incoming == self.previous {
            return true;
        }
        let follows = before != 0 && now == before % 7 + 1;
        self.gap |= !follows && self.in_order >= COUNTED;
        self.in_order = if follows {
            self.in_order.saturating_add(1)
        } else {
            0
        };
        false
    }

    /// Returns true if a message was lost since the last call, as far as the counter shows.
    pub(super) fn take_gap(&mut self) -> bool {
        mem::take(&mut self.gap)
    }

    /// Makes the SubDevice put the last message back into its mailbox.
    async fn repeat<W: MailboxTransport>(
        &self,
        w: &W,
        budget: &mut RetryBudget,
    ) -> Result<(), TransportError> {
        let asked = self
            .register(w, self.layout.in_sm, SM_ACTIVATE, budget)
            .await?
            ^ REPEAT;
        let mut deadline = Deadline::after(w, self.timeouts.request);
        let mut written = false;
        loop {
            if written {
                let acknowledged = self
                    .register(w, self.layout.in_sm, SM_PDI_CONTROL, budget)
                    .await?;
                if (acknowledged ^ asked) & REPEAT == 0 {
                    return Ok(());
                }
            } else {
                let register = sm_register(self.layout.in_sm, SM_ACTIVATE);
                written = budget.judge(w.write(self.layout.station, register, &[asked]).await)?
                    == WriteOutcome::Yes;
            }
            if deadline.passed(w) {
                return Err(TransportError::Timeout(Phase::Repeat));
            }
            deadline.pause(w).await;
        }
    }

    /// Reads and sets aside the messages in the mailbox, at most `most`, so that no device blocks
    /// the caller.
    pub(super) async fn drain<W: MailboxTransport>(
        &mut self,
        w: &W,
        most: usize,
    ) -> Result<usize, TransportError> {
        let mut budget = RetryBudget::default();
        let mut count = 0;
        for _ in 0..most {
            match self.fetch(w, &mut budget).await? {
                ReadOutcome::Message => {
                    self.set_aside(w);
                    count += 1;
                }
                ReadOutcome::Waiting => w.delay(POLL_MIN).await,
                ReadOutcome::Lost => match self.repeat(w, &mut budget).await {
                    // A message that cannot be repeated no longer occupies the mailbox.
                    Ok(()) | Err(TransportError::Timeout(_)) => {}
                    Err(trouble) => return Err(trouble),
                },
                ReadOutcome::Nothing => break,
            }
        }
        self.free = !self.status(w, self.layout.out_sm, &mut budget).await?;
        Ok(count)
    }

    /// Reads one message, if there is one, and sets it aside. The turn ends once it is read: a device
    /// that does not repeat a lost message must not delay the others.
    pub(super) async fn take_one<W: MailboxTransport>(
        &mut self,
        w: &W,
        turn: Turn,
    ) -> Result<(), TransportError> {
        let mut budget = RetryBudget::default();
        let read = match self.waits(w) {
            true => self.read(w, &mut budget).await?,
            false => self.fetch(w, &mut budget).await?,
        };
        drop(turn);
        match read {
            ReadOutcome::Message => self.set_aside(w),
            ReadOutcome::Lost => match self.repeat(w, &mut budget).await {
                // A message that cannot be repeated no longer occupies the mailbox.
                Ok(()) | Err(TransportError::Timeout(_)) => {}
                Err(trouble) => return Err(trouble),
            },
            ReadOutcome::Waiting | ReadOutcome::Nothing => {}
        }
        Ok(())
    }

    /// Writes a fragment of EoE once, with a counter of its own. Returns the working counter, 0 if the
    /// mailbox is full.
    pub(super) async fn write_once<W: MailboxTransport>(
        &mut self,
        w: &W,
        message: &impl Encode,
    ) -> Result<u16, DatagramError> {
        let counter = self.counter % 7 + 1;
        message.emit(counter, self.layout.out_len, &mut self.outgoing);
        let written = w
            .write(self.layout.station, self.layout.out_address, &self.outgoing)
            .await;
        // The next request may find the mailbox full.
        (self.free, self.fragment_sent) = (false, true);
        self.offered = written == Ok(0);
        if !self.offered {
            (self.counter, self.fragment_last) = (counter, true);
        }
        written
    }

    /// Passes a fragment on to the switch, or EoE that makes no sense. Returns false for others.
    fn take_fragment<W: MailboxTransport>(&self, w: &W) -> bool {
        let other = matches!(
            eoe::Message::parse(&self.incoming),
            Ok(message) if !matches!(message.service, eoe::Service::Fragment(_))
        );
        let eoe = self.eoe.as_ref().filter(|_| !other);
        eoe.is_some_and(|eoe| eoe.receive(w.now(), &self.incoming))
    }

    /// Gives up the fragment for which the mailbox was full.
    pub(super) fn withdraw(&mut self) {
        if mem::take(&mut self.offered) {
            self.counter = self.counter % 7 + 1;
        }
    }

    /// Counts a mailbox error that may mean a fragment. Returns false for other messages.
    fn take_refusal(&self) -> bool {
        let Some(eoe) = self.eoe.as_ref().filter(|_| self.fragment_sent) else {
            return false;
        };
        match eoe::Message::parse(&self.incoming) {
            Ok(eoe::Message {
                service: eoe::Service::Refused(code),
                ..
            }) => {
                eoe.refuse(code);
                true
            }
            _ => false,
        }
    }

    /// Queues an emergency or a notification, passes EoE on to the switch and drops any other
    /// message.
    pub(super) fn set_aside<W: MailboxTransport>(&mut self, w: &W) {
        if self.take_refusal() {
            return;
        }
        let eoe = self.eoe.as_ref();
        if eoe.is_some_and(|eoe| eoe.receive(w.now(), &self.incoming)) {
            return;
        }
        let emergency = match Message::parse(&self.incoming) {
            Ok(Message::Emergency(bytes)) => Some(Emergency::from_bytes(*bytes)),
            _ => match soe::Message::parse(&self.incoming) {
                Ok(soe::Message::Telegram(telegram)) => Emergency::from_telegram(&telegram),
                _ => None,
            },
        };
        match emergency {
            Some(emergency) => self.emergencies.push(w.now(), emergency),
            None => self.forgotten += 1,
        }
    }

    /// Returns whether a mailbox is full.
    async fn status<W: MailboxTransport>(
        &self,
        w: &W,
        sm: u8,
        budget: &mut RetryBudget,
    ) -> Result<bool, TransportError> {
        Ok(self.register(w, sm, SM_STATUS, budget).await? & MAILBOX_FULL != 0)
    }

    /// Reads one byte of a SyncManager, repeated while frames are lost.
    async fn register<W: MailboxTransport>(
        &self,
        w: &W,
        sm: u8,
        offset: u16,
        budget: &mut RetryBudget,
    ) -> Result<u8, TransportError> {
        loop {
            let mut byte = [0];
            match budget.judge(
                w.read(self.layout.station, sm_register(sm, offset), &mut byte)
                    .await,
            )? {
                WriteOutcome::Yes => {
                    budget.untouched = 0;
                    let [byte] = byte;
                    return Ok(byte);
                }
                WriteOutcome::No => budget.untouched += 1,
                WriteOutcome::Lost => {}
            }
            if budget.untouched >= MAX_FAILURES {
                return Err(TransportError::Gone);
            }
            w.delay(POLL_MIN).await;
        }
    }
}

fn sm_register(sm: u8, offset: u16) -> u16 {
    registers::SYNC_MANAGER + u16::from(sm) * 8 + offset
}

#[derive(Debug, PartialEq, Eq)]
enum ReadOutcome {
    Nothing,
    Message,
    /// A message waits but could not be read.
    Waiting,
    /// There was a message, but it was lost.
    Lost,
}

#[derive(Debug, PartialEq, Eq)]
enum WriteOutcome {
    Yes,
    No,
    Lost,
}

/// Distinguishes a lost frame from a lost bus.
#[derive(Debug, Default)]
struct RetryBudget {
    /// Frames lost in a row.
    lost: u32,
    /// Register reads in a row that no device processed.
    untouched: u32,
}

impl RetryBudget {
    fn judge(
        &mut self,
        result: Result<u16, DatagramError>,
    ) -> Result<WriteOutcome, TransportError> {
        match result {
            Ok(working_counter) => {
                self.lost = 0;
                Ok(if working_counter == 0 {
                    WriteOutcome::No
                } else {
                    WriteOutcome::Yes
                })
            }
            Err(DatagramError::Timeout { .. }) if self.lost + 1 < MAX_FAILURES => {
                self.lost += 1;
                Ok(WriteOutcome::Lost)
            }
            Err(error) => Err(TransportError::Wire(error)),
        }
    }
}
