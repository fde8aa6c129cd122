//! Bus access without a cycle, for scanning, parameters, EEPROMs and firmware. MAY BLOCK AND
//! ALLOCATE.
//!
//! The segment is used as found. Nothing here resets it, and each operation touches a device only
//! as far as needed: another MainDevice may be driving it.
//!
//! - [`with_bus`], [`run_on_link`]: exchange frames while an operation runs;
//! - [`enumerate`]: the devices of a segment and their addresses;
//! - [`device`]: finds one device by its locator;
//! - [`eeprom`]: the EEPROM interface of one device;
//! - [`image`]: EEPROM images, and how to write them;
//! - [`mailbox`]: the mailboxes of one device, and the state they need;
//! - [`topology`]: how the devices are connected.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::thread;

use ecaxis_esi::sii::SiiError;

use crate::bringup::{DeviceRef, StateError};
use crate::clock::Clock;
use crate::link::Link;
use crate::link::pdu_loop::{drive_pdu_loop, main_device};
use crate::mailbox::{DatagramError, InfoError, MailboxTransport, SdoError};
use crate::report::{RunError, panic_text};

pub use crate::datagram::DatagramClient;

pub mod device;
pub mod eeprom;
pub mod enumerate;
pub mod image;
pub mod mailbox;
#[cfg(test)]
mod tests;
pub mod topology;

/// The stack size in bytes of the thread that exchanges the frames. Its futures hold whole frames
/// by value.
const STACK: usize = 16 * 1024 * 1024;

/// An error of an operation on a device.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    #[error("no SubDevice answers")]
    NoAnswer,
    #[error("the SubDevice at position {position} stopped answering while {step}")]
    Silent { position: u16, step: &'static str },
    #[error("{step}: {source}")]
    Segment {
        step: &'static str,
        source: DatagramError,
    },
    #[error("no SubDevice has {wanted}; {found}")]
    NotFound { wanted: String, found: String },
    #[error("{count} SubDevices have {wanted}: at positions {positions}")]
    Ambiguous {
        wanted: String,
        count: usize,
        positions: String,
    },
    #[error("{device}: {step}: {source}")]
    Wire {
        device: DeviceRef,
        step: &'static str,
        source: DatagramError,
    },
    #[error("{device}: {step}: register 0x{register:04x} is not answered")]
    NotTaken {
        device: DeviceRef,
        step: &'static str,
        register: u16,
    },
    #[error("{device}: {step}: {source}")]
    Eeprom {
        device: DeviceRef,
        step: &'static str,
        source: eeprom::EepromError,
    },
    #[error("{device}: its EEPROM: {source}")]
    Sii { device: DeviceRef, source: SiiError },
    #[error("{device}: the EEPROM says nothing of a mailbox")]
    NoMailbox { device: DeviceRef },
    #[error("{device}: is in {state}, where it has no CoE mailbox")]
    WrongState { device: DeviceRef, state: String },
    /// The user stopped the operation. Changed states have been restored.
    #[error("{device}: {step}: interrupted")]
    Stopped {
        device: DeviceRef,
        step: &'static str,
    },
    #[error("{device}: {source}")]
    Sdo { device: DeviceRef, source: SdoError },
    #[error("{device}: {source}")]
    Information {
        device: DeviceRef,
        source: Box<InfoError>,
    },
    #[error(transparent)]
    State(#[from] StateError),
}

/// Runs `work` on a dedicated link and thread until it completes or is cancelled
/// ([`crate::cancel::CancelToken`]). Blocks.
///
/// # Errors
/// [`RunError::Interrupted`] if `stop` ended the work outside a shielded section; errors that open
/// or use the link.
pub fn with_bus<T, W>(
    open: impl FnOnce() -> Result<Box<dyn Link>, RunError> + Send + 'static,
    clock: Clock,
    stop: Arc<AtomicBool>,
    work: W,
) -> Result<T, RunError>
where
    T: Send + 'static,
    W: AsyncFnOnce(DatagramClient) -> T + Send + 'static,
{
    let owner = thread::Builder::new()
        .name("ecaxis-bus".to_owned())
        .stack_size(STACK)
        .spawn(move || {
            clock.enter();
            let mut link = open()?;
            let done = run_on_link(link.as_mut(), clock, &stop, work);
            let recorded = link
                .finish()
                .map_err(|error| RunError::Record(error.to_string()));
            done.and_then(|done| recorded.map(|_| done))
        })
        .map_err(|error| RunError::Thread(error.to_string()))?;
    owner
        .join()
        .unwrap_or_else(|panic| Err(RunError::Panicked(panic_text(&*panic))))
}

/// Runs `work` on a link, on the calling thread and its clock ([`Clock::enter`]).
///
/// # Errors
/// As [`with_bus`].
pub fn run_on_link<T>(
    link: &mut dyn Link,
    clock: Clock,
    stop: &AtomicBool,
    work: impl AsyncFnOnce(DatagramClient) -> T,
) -> Result<T, RunError> {
    let (main_device, mut port) = main_device(0);
    let run = AssertUnwindSafe(|| {
        let wire = DatagramClient::new(main_device);
        let work = Box::pin(work(wire));
        let ends = wire.stop();
        drive_pdu_loop(
            &mut port,
            link,
            clock,
            ends.cancel_on(stop, ends.run_until_cancelled(work)),
        )
    });
    match catch_unwind(run) {
        Ok(Ok(Some(done))) => Ok(done),
        Ok(Ok(None)) => Err(RunError::Interrupted),
        Ok(Err(error)) => Err(RunError::Link(error)),
        Err(panic) => Err(RunError::Panicked(panic_text(&*panic))),
    }
}

/// The registers of a device. Every error names the device.
#[derive(Debug)]
pub struct Registers<'a, W> {
    pub wire: &'a W,
    pub device: &'a DeviceRef,
    /// The current operation, for errors.
    pub step: &'static str,
}

impl<W: MailboxTransport> Registers<'_, W> {
    /// Reads a register.
    ///
    /// # Errors
    /// [`ServiceError::Wire`], [`ServiceError::NotTaken`].
    pub async fn read<const N: usize>(&self, register: u16) -> Result<[u8; N], ServiceError> {
        let mut bytes = [0; N];
        let answer = self
            .wire
            .read(self.device.station, register, &mut bytes)
            .await;
        self.taken(register, answer).map(|()| bytes)
    }

    /// Writes a register.
    ///
    /// # Errors
    /// As [`Registers::read`].
    pub async fn write(&self, register: u16, bytes: &[u8]) -> Result<(), ServiceError> {
        let answer = self.wire.write(self.device.station, register, bytes).await;
        self.taken(register, answer)
    }

    fn taken(&self, register: u16, answer: Result<u16, DatagramError>) -> Result<(), ServiceError> {
        let (device, step) = (self.device.clone(), self.step);
        match answer {
            Ok(1..) => Ok(()),
            Ok(0) => Err(ServiceError::NotTaken {
                device,
                step,
                register,
            }),
            Err(source) => Err(ServiceError::Wire {
                device,
                step,
                source,
            }),
        }
    }
}
