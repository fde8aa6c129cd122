//! Raw datagrams through ethercrab's PDU loop: what bring-up, mailboxes and recovery are written
//! against.

use std::sync::Arc;
use std::time::Duration;

use ethercrab::error::Error;
use ethercrab::{Command, MainDevice};

use crate::clock::{self, Nanos};
use crate::mailbox::{Seen, Wire, WireError};
use crate::rt::exchange::Sights;
use crate::stop::Stop;
use turns::Turns;

mod turns;

/// Datagrams to configured station addresses, each in a frame of its own and in its turn.
#[derive(Debug, Clone, Copy)]
pub struct Datagrams {
    device: &'static MainDevice<'static>,
    turns: &'static Turns,
    stop: &'static Stop,
}

impl Datagrams {
    /// To be copied, so that all keep to the same turns and one may end what all of them do. They live as long as the MainDevice: as
    /// the process.
    #[must_use]
    pub fn new(device: &'static MainDevice<'static>) -> Self {
        Self {
            device,
            turns: Box::leak(Box::default()),
            stop: Box::leak(Box::default()),
        }
    }

    #[must_use]
    pub fn main_device(&self) -> &'static MainDevice<'static> {
        self.device
    }

    /// How many SubDevices answer a broadcast read.
    pub async fn count(&self) -> Result<u16, WireError> {
        let _turn = self.turns.take().await;
        let answer = Command::brd(0)
            .with_wkc(0)
            .receive_slice(self.device, 1)
            .await;
        working_counter(answer.map(|_| ()), 0, 0, 0)
    }

    /// By position in the segment (APRD), before station addresses are known to be right. Returns the working counter.
    ///
    /// # Errors
    /// [`WireError`], with the position in the place of the station.
    pub async fn read_at(
        &self,
        position: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, WireError> {
        let len = length(buf)?;
        let _turn = self.turns.take().await;
        let answer = Command::aprd(position, register)
            .receive_slice(self.device, len)
            .await;
        working_counter(answer.map(|pdu| copy(&pdu, buf)), 1, position, register)
    }

    /// By position in the segment (APWR). Returns the working counter.
    ///
    /// # Errors
    /// As [`Datagrams::read_at`].
    pub async fn write_at(
        &self,
        position: u16,
        register: u16,
        data: &[u8],
    ) -> Result<u16, WireError> {
        let _turn = self.turns.take().await;
        let answer = Command::apwr(position, register)
            .send_receive_slice(self.device, data)
            .await;
        working_counter(answer.map(|_| ()), 1, position, register)
    }
}

impl Datagrams {
    /// To everybody (BWR); returns how many took it.
    ///
    /// # Errors
    /// [`WireError`], without a station.
    pub async fn write_all(&self, register: u16, data: &[u8]) -> Result<u16, WireError> {
        let answer = Command::bwr(register)
            .with_wkc(0)
            .send_receive_slice(self.device, data)
            .await;
        working_counter(answer.map(|_| ()), 0, 0, register)
    }
}

impl Datagrams {
    /// The system time of one device to all behind it (FRMW 0x0910); returns the working counter.
    ///
    /// # Errors
    /// [`WireError`].
    pub async fn distribute_time(&self, station: u16) -> Result<u16, WireError> {
        const SYSTEM_TIME: u16 = 0x0910;
        let answer = Command::frmw(station, SYSTEM_TIME)
            .with_wkc(1)
            .receive_slice(self.device, 8)
            .await;
        working_counter(answer.map(|_| ()), 1, station, SYSTEM_TIME)
    }
}

fn length(buf: &[u8]) -> Result<u16, WireError> {
    u16::try_from(buf.len())
        .map_err(|_| WireError::Other(format!("a datagram cannot read {} bytes", buf.len())))
}

fn copy(from: &[u8], to: &mut [u8]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to = *from;
    }
}

impl Wire for Datagrams {
    async fn read(&self, station: u16, register: u16, buf: &mut [u8]) -> Result<u16, WireError> {
        let len = length(buf)?;
        let _turn = self.turns.take().await;
        let answer = Command::fprd(station, register)
            .receive_slice(self.device, len)
            .await;
        working_counter(answer.map(|pdu| copy(&pdu, buf)), 1, station, register)
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, WireError> {
        let _turn = self.turns.take().await;
        let answer = Command::fpwr(station, register)
            .send_receive_slice(self.device, data)
            .await;
        working_counter(answer.map(|_| ()), 1, station, register)
    }

    async fn delay(&self, duration: Duration) {
        clock::delay(duration).await;
    }

    fn now(&self) -> u64 {
        clock::now()
    }

    fn stop(&self) -> &Stop {
        self.stop
    }
}

/// Cycles after which what was seen of a mailbox is old: on a bus where its turn comes less often, a transfer looks for itself. A
/// message that nobody asked for was seen, however long ago.
const SIGHT_CYCLES: Nanos = 4;

/// Datagrams of one SubDevice's mailbox while the cycle runs, and what the cycle sees of it.
#[derive(Debug, Clone)]
pub struct BesideCycle {
    datagrams: Datagrams,
    sights: Arc<Sights>,
    member: usize,
    old_ns: Nanos,
}

impl BesideCycle {
    /// For all members of the exchange.
    #[must_use]
    pub fn all(
        datagrams: Datagrams,
        sights: &Arc<Sights>,
        members: usize,
        cycle_ns: Nanos,
    ) -> Vec<Self> {
        let each = (0..members).map(|member| Self {
            datagrams,
            sights: Arc::clone(sights),
            member,
            old_ns: cycle_ns.saturating_mul(SIGHT_CYCLES),
        });
        each.collect()
    }
}

impl Wire for BesideCycle {
    async fn read(&self, station: u16, register: u16, buf: &mut [u8]) -> Result<u16, WireError> {
        self.datagrams.read(station, register, buf).await
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, WireError> {
        self.datagrams.write(station, register, data).await
    }

    async fn delay(&self, duration: Duration) {
        self.datagrams.delay(duration).await;
    }

    fn now(&self) -> u64 {
        self.datagrams.now()
    }

    fn seen(&self) -> Option<Seen> {
        self.sights.mailbox(self.member)
    }

    fn seen_lately(&self) -> Option<Seen> {
        let seen = self.seen()?;
        (clock::now().saturating_sub(seen.at) <= self.old_ns).then_some(seen)
    }
}

/// ethercrab keeps the working counter to itself and only compares it.
fn working_counter(
    answer: Result<(), Error>,
    expected: u16,
    station: u16,
    register: u16,
) -> Result<u16, WireError> {
    match answer {
        Ok(()) => Ok(expected),
        Err(Error::WorkingCounter { received, .. }) => Ok(received),
        Err(error) => Err(failed(error, station, register)),
    }
}

fn failed(error: Error, station: u16, register: u16) -> WireError {
    match error {
        Error::Timeout(_) => WireError::Timeout { station, register },
        other => WireError::Other(other.to_string()),
    }
}
