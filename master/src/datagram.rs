//! Raw datagrams through ethercrab's PDU loop: the interface under bring-up, mailboxes and
//! recovery.

use std::sync::Arc;
use std::time::Duration;

use ecaxis_ecat::index::DeviceIndex;
use ecaxis_ecat::registers;
use ethercrab::error::Error;
use ethercrab::{Command, MainDevice, WrappedRead, WrappedWrite};

use crate::cancel::CancelToken;
use crate::clock::{self, Nanos};
use crate::link::pdu_loop::{MAX_DATAGRAMS, MAX_JOINED};
use crate::link::redundant::{RingState, RingStatus};
use crate::link::second_end::{self, SecondEnd};
use crate::mailbox::{DatagramError, MailboxStatus, MailboxTransport};
use crate::rt::exchange::BusStatus;
use limiter::InFlightLimiter;

mod limiter;

/// The datagrams in flight during operation. Each cycle sends one frame, and an answer takes at most
/// two cycles: more datagrams would only wait.
const MAX_IN_OPERATION: u64 = 3 * MAX_JOINED;

/// Sends datagrams to configured station addresses, in order of request.
#[derive(Debug, Clone, Copy)]
pub struct DatagramClient {
    device: &'static MainDevice<'static>,
    turns: &'static InFlightLimiter,
    stop: &'static CancelToken,
    ring: Option<&'static RingStatus>,
    /// The interface, outside of a ring and without a cycle.
    nic: Option<&'static str>,
}

impl DatagramClient {
    /// Returns a client for a bus in operation. Copies share one limiter and one cancel token. Both
    /// live as long as the MainDevice, that is, as long as the process.
    #[must_use]
    pub fn new(device: &'static MainDevice<'static>) -> Self {
        Self::with_limit(device, MAX_IN_OPERATION)
    }

    /// Returns a client for a bus without a cycle. Its datagrams share frames.
    #[must_use]
    pub fn without_cycle(device: &'static MainDevice<'static>) -> Self {
        Self::with_limit(device, MAX_DATAGRAMS)
    }

    fn with_limit(device: &'static MainDevice<'static>, max: u64) -> Self {
        Self {
            device,
            turns: Box::leak(Box::new(InFlightLimiter::new(max))),
            stop: Box::leak(Box::default()),
            ring: None,
            nic: None,
        }
    }

    /// Sets the ring that the datagrams take, as the link reports it.
    #[must_use]
    pub fn in_ring(self, ring: Option<&'static RingStatus>) -> Self {
        Self { ring, ..self }
    }

    /// Sets the interface, as the link reports it. For a bus without a cycle.
    #[must_use]
    pub(crate) fn on_interface(self, nic: Option<&str>) -> Self {
        let nic = nic.map(|nic| &*Box::leak(Box::from(nic)));
        Self { nic, ..self }
    }

    /// Searches for another interface at which the frames arrive. Blocks.
    pub(crate) fn find_second_end(&self) -> Option<SecondEnd> {
        self.nic.and_then(second_end::find_second_end)
    }

    /// Returns the state of the ring, with cable redundancy.
    #[must_use]
    pub fn ring(&self) -> Option<RingState> {
        self.ring.map(RingStatus::get)
    }

    /// Returns the status of the ring, with cable redundancy.
    #[must_use]
    pub fn ring_status(&self) -> Option<&'static RingStatus> {
        self.ring
    }

    /// Exchanges both interfaces of a ring.
    pub(crate) fn exchange_ends(&self) {
        if let Some(ring) = self.ring {
            ring.swap();
        }
    }

    /// Returns how often the ring was broken, and behind how many devices the last time.
    #[must_use]
    pub fn breaks(&self) -> (u32, u16) {
        self.ring.map_or((0, 0), RingStatus::breaks)
    }

    /// Returns true if the cables of both interfaces of a ring are exchanged.
    #[must_use]
    pub fn swapped(&self) -> bool {
        self.ring.is_some_and(RingStatus::swapped)
    }

    #[must_use]
    pub fn main_device(&self) -> &'static MainDevice<'static> {
        self.device
    }

    /// Returns how many SubDevices answer a broadcast read.
    pub async fn count(&self) -> Result<u16, DatagramError> {
        let _turn = self.turns.take().await;
        let answer = Command::brd(0)
            .with_wkc(0)
            .receive_slice(self.device, 1)
            .await;
        working_counter(answer.map(|_| ()), 0, 0, 0)
    }

    /// Returns the AL status of all SubDevices, ORed (BRD 0x0130).
    pub(crate) async fn any_status(&self) -> Result<u8, DatagramError> {
        let _turn = self.turns.take().await;
        let answer = Command::brd(registers::AL_STATUS)
            .ignore_wkc()
            .receive_slice(self.device, 1)
            .await;
        let status = answer.map(|pdu| pdu.first().copied().unwrap_or(0));
        status.map_err(|error| failed(error, 0, registers::AL_STATUS))
    }

    /// Reads by position in the segment (APRD), for use before station addresses are verified.
    /// Returns the working counter.
    ///
    /// # Errors
    /// [`DatagramError`], with the position in place of the station.
    pub async fn read_at(
        &self,
        position: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        let command = Command::aprd(position, register);
        self.read_one(command, position, register, buf).await
    }

    /// Writes by position in the segment (APWR). Returns the working counter.
    ///
    /// # Errors
    /// As [`DatagramClient::read_at`].
    pub async fn write_at(
        &self,
        position: u16,
        register: u16,
        data: &[u8],
    ) -> Result<u16, DatagramError> {
        let command = Command::apwr(position, register);
        self.write_one(command, position, register, data).await
    }

    /// Reads from one SubDevice. `address`: its position or station, for errors.
    async fn read_one(
        &self,
        command: WrappedRead,
        address: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        let len = u16::try_from(buf.len()).map_err(|_| {
            DatagramError::Other(format!("a datagram cannot read {} bytes", buf.len()))
        })?;
        let _turn = self.turns.take().await;
        let answer = command.receive_slice(self.device, len).await;
        let answer = answer.map(|pdu| {
            for (to, from) in buf.iter_mut().zip(pdu.iter()) {
                *to = *from;
            }
        });
        working_counter(answer, 1, address, register)
    }

    /// Writes to one SubDevice. `address`: its position or station, for errors.
    async fn write_one(
        &self,
        command: WrappedWrite,
        address: u16,
        register: u16,
        data: &[u8],
    ) -> Result<u16, DatagramError> {
        let _turn = self.turns.take().await;
        let answer = command.send_receive_slice(self.device, data).await;
        working_counter(answer.map(|_| ()), 1, address, register)
    }
}

impl DatagramClient {
    /// Writes to all SubDevices (BWR). Returns the working counter.
    ///
    /// # Errors
    /// [`DatagramError`], without a station.
    pub async fn write_all(&self, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        let answer = Command::bwr(register)
            .with_wkc(0)
            .send_receive_slice(self.device, data)
            .await;
        working_counter(answer.map(|_| ()), 0, 0, register)
    }
}

impl DatagramClient {
    /// Copies the system time of one device to all devices behind it (FRMW 0x0910). Returns the
    /// working counter.
    ///
    /// # Errors
    /// [`DatagramError`].
    pub async fn distribute_time(&self, station: u16) -> Result<u16, DatagramError> {
        let answer = Command::frmw(station, registers::DC_SYSTEM_TIME)
            .with_wkc(1)
            .receive_slice(self.device, 8)
            .await;
        working_counter(answer.map(|_| ()), 1, station, registers::DC_SYSTEM_TIME)
    }
}

impl MailboxTransport for DatagramClient {
    async fn read(
        &self,
        station: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        let command = Command::fprd(station, register);
        self.read_one(command, station, register, buf).await
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        let command = Command::fpwr(station, register);
        self.write_one(command, station, register, data).await
    }

    async fn delay(&self, duration: Duration) {
        clock::delay(duration).await;
    }

    fn now(&self) -> u64 {
        clock::now()
    }

    fn stop(&self) -> &CancelToken {
        self.stop
    }
}

/// The age in cycles beyond which an observed mailbox status is stale. On a bus that polls a
/// mailbox less often, a transfer reads the status itself. An unsolicited message counts at any
/// age.
const MAX_STATUS_AGE_CYCLES: Nanos = 4;

/// The mailbox datagrams of one SubDevice during operation, and the status that the cycle reads.
#[derive(Debug, Clone)]
pub struct CyclicMailboxTransport {
    datagrams: DatagramClient,
    bus_status: Arc<BusStatus>,
    member: DeviceIndex,
    old_ns: Nanos,
}

impl CyclicMailboxTransport {
    /// Returns one transport for each member of the exchange.
    #[must_use]
    pub fn all(
        datagrams: DatagramClient,
        bus_status: &Arc<BusStatus>,
        members: usize,
        cycle_ns: Nanos,
    ) -> Vec<Self> {
        let each = (0..members).map(|member| Self {
            datagrams,
            bus_status: Arc::clone(bus_status),
            member: DeviceIndex(member),
            old_ns: cycle_ns.saturating_mul(MAX_STATUS_AGE_CYCLES),
        });
        each.collect()
    }
}

impl MailboxTransport for CyclicMailboxTransport {
    async fn read(
        &self,
        station: u16,
        register: u16,
        buf: &mut [u8],
    ) -> Result<u16, DatagramError> {
        self.datagrams.read(station, register, buf).await
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, DatagramError> {
        self.datagrams.write(station, register, data).await
    }

    async fn delay(&self, duration: Duration) {
        self.datagrams.delay(duration).await;
    }

    fn now(&self) -> u64 {
        self.datagrams.now()
    }

    fn seen(&self) -> Option<MailboxStatus> {
        self.bus_status.mailbox(self.member)
    }

    fn seen_lately(&self) -> Option<MailboxStatus> {
        let seen = self.seen()?;
        (clock::now().saturating_sub(seen.at) <= self.old_ns).then_some(seen)
    }
}

/// ethercrab compares the working counter but does not return it.
fn working_counter(
    answer: Result<(), Error>,
    expected: u16,
    station: u16,
    register: u16,
) -> Result<u16, DatagramError> {
    match answer {
        Ok(()) => Ok(expected),
        Err(Error::WorkingCounter { received, .. }) => Ok(received),
        Err(error) => Err(failed(error, station, register)),
    }
}

fn failed(error: Error, station: u16, register: u16) -> DatagramError {
    match error {
        Error::Timeout(_) => DatagramError::Timeout { station, register },
        other => DatagramError::Other(other.to_string()),
    }
}
