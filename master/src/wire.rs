//! Raw datagrams through ethercrab's PDU loop: what bring-up, mailboxes and recovery are written
//! against.

use std::time::Duration;

use ethercrab::error::Error;
use ethercrab::{Command, MainDevice};

use crate::clock;
use crate::mailbox::{Wire, WireError};

/// Datagrams to configured station addresses, each in a frame of its own.
#[derive(Debug, Clone, Copy)]
pub struct Datagrams {
    device: &'static MainDevice<'static>,
}

impl Datagrams {
    #[must_use]
    pub fn new(device: &'static MainDevice<'static>) -> Self {
        Self { device }
    }

    #[must_use]
    pub fn main_device(&self) -> &'static MainDevice<'static> {
        self.device
    }

    /// How many SubDevices answer a broadcast read.
    pub async fn count(&self) -> Result<u16, WireError> {
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
        let answer = Command::fprd(station, register)
            .receive_slice(self.device, len)
            .await;
        working_counter(answer.map(|pdu| copy(&pdu, buf)), 1, station, register)
    }

    async fn write(&self, station: u16, register: u16, data: &[u8]) -> Result<u16, WireError> {
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
