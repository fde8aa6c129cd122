//! A bus without a cycle: what scanning, parameters, EEPROMs and firmware work on. MAY BLOCK AND ALLOCATE.
//!
//! A segment is taken as it is found. Nothing here resets it, and a device is touched no further than the work needs: another MainDevice
//! may be driving it.
//!
//! - [`visit`], [`carry`]: frames go back and forth while a piece of work lasts;
//! - [`station`]: who answers, and under which address;
//! - [`device`]: one of them, by what it is found by;
//! - [`eeprom`]: the EEPROM interface of one device;
//! - [`image`]: what is in an EEPROM, and how it gets there;
//! - [`mailbox`]: the mailboxes of one device, and the state in which it has them.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::thread;

use ecaxis_esi::sii::SiiError;

use crate::bringup::{DeviceRef, StateError};
use crate::clock::Clock;
use crate::link::Link;
use crate::link::port::{main_device, pump};
use crate::mailbox::{InfoError, SdoError, Wire, WireError};
use crate::session::{RunError, panic_text};

pub use crate::wire::Datagrams;

pub mod device;
pub mod eeprom;
pub mod image;
pub mod mailbox;
pub mod station;
#[cfg(test)]
mod tests;

/// Stack of the thread that carries the frames; futures here hold whole frames by value.
const STACK: usize = 16 * 1024 * 1024;

/// What went wrong with a device that was taken as it was found.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    #[error("no SubDevice answers")]
    NoAnswer,
    #[error("the SubDevice at position {position} stopped answering while {step}")]
    Silent { position: u16, step: &'static str },
    #[error("{step}: {source}")]
    Segment {
        step: &'static str,
        source: WireError,
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
        source: WireError,
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
    /// By the user, with everything put back that had to be.
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

/// Does a piece of work on a link of its own, on a thread of its own, until it is done or `stop` is set and nothing is in hand
/// ([`crate::stop::Stop`]). Blocks.
///
/// # Errors
/// [`RunError::Interrupted`] where `stop` ended it between one thing and the next; what opens or carries the link.
pub fn visit<T, W>(
    open: impl FnOnce() -> Result<Box<dyn Link>, RunError> + Send + 'static,
    clock: Clock,
    stop: Arc<AtomicBool>,
    work: W,
) -> Result<T, RunError>
where
    T: Send + 'static,
    W: AsyncFnOnce(Datagrams) -> T + Send + 'static,
{
    let owner = thread::Builder::new()
        .name("ecaxis-bus".to_owned())
        .stack_size(STACK)
        .spawn(move || {
            clock.enter();
            let mut link = open()?;
            let done = carry(link.as_mut(), clock, &stop, work);
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

/// Does a piece of work on a link, on the calling thread and its clock ([`Clock::enter`]).
///
/// # Errors
/// As [`visit`].
pub fn carry<T>(
    link: &mut dyn Link,
    clock: Clock,
    stop: &AtomicBool,
    work: impl AsyncFnOnce(Datagrams) -> T,
) -> Result<T, RunError> {
    let (main_device, mut port) = main_device(0);
    let run = AssertUnwindSafe(|| {
        let wire = Datagrams::new(main_device);
        let work = Box::pin(work(wire));
        let ends = wire.stop();
        pump(&mut port, link, clock, ends.once(stop, ends.unless(work)))
    });
    match catch_unwind(run) {
        Ok(Ok(Some(done))) => Ok(done),
        Ok(Ok(None)) => Err(RunError::Interrupted),
        Ok(Err(error)) => Err(RunError::Link(error)),
        Err(panic) => Err(RunError::Panicked(panic_text(&*panic))),
    }
}

/// Registers of a device, with its name in every error.
#[derive(Debug)]
pub struct Registers<'a, W> {
    pub wire: &'a W,
    pub device: &'a DeviceRef,
    /// What is being done, for errors.
    pub step: &'static str,
}

impl<W: Wire> Registers<'_, W> {
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

    /// # Errors
    /// As [`Registers::read`].
    pub async fn write(&self, register: u16, bytes: &[u8]) -> Result<(), ServiceError> {
        let answer = self.wire.write(self.device.station, register, bytes).await;
        self.taken(register, answer)
    }

    fn taken(&self, register: u16, answer: Result<u16, WireError>) -> Result<(), ServiceError> {
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
