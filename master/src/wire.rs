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

    /// One word by position in the segment, before station addresses are known to be right.
    pub async fn read_position(
        &self,
        position: u16,
        register: u16,
    ) -> Result<Option<u16>, WireError> {
        match Command::aprd(position, register)
            .receive_slice(self.device, 2)
            .await
        {
            Ok(pdu) => Ok(<[u8; 2]>::try_from(&*pdu).ok().map(u16::from_le_bytes)),
            Err(Error::WorkingCounter { .. }) => Ok(None),
            Err(error) => Err(failed(error, position, register)),
        }
    }
}

impl Wire for Datagrams {
    async fn read(&self, station: u16, register: u16, buf: &mut [u8]) -> Result<u16, WireError> {
        let len = u16::try_from(buf.len())
            .map_err(|_| WireError::Other(format!("a datagram cannot read {} bytes", buf.len())))?;
        let answer = Command::fprd(station, register)
            .receive_slice(self.device, len)
            .await;
        working_counter(
            answer.map(|pdu| {
                for (to, from) in buf.iter_mut().zip(pdu.iter()) {
                    *to = *from;
                }
            }),
            1,
            station,
            register,
        )
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
