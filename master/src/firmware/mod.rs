//! A device's firmware, by the two ways that drives offer. MAY BLOCK AND ALLOCATE; works on a bus without a cycle ([`crate::service`]).
//!
//! - `examine`: who a device is, what it offers, and what runs in it;
//! - `bootstrap`: a file over FoE in Bootstrap, started on the way back to Init;
//! - `program`: program download by the objects 0x1F50, 0x1F51 and 0x1F56 (CiA 302-3);
//! - `error`: what failed at which step, and in which state the device was left.
//!
//! A file is the maker's; nothing is known of what is in it. What is checked is the device: before, whether it is the one that is meant, and
//! afterwards, whether it is still the same and runs a program. A device whose update broke off keeps its boot loader, which waits in Bootstrap or
//! with its program stopped; an update starts from there as from anywhere else.

use std::cell::Cell;
use std::fmt;
use std::time::Duration;

use ecaxis_esi::sii::Protocols;

use crate::bringup::AlState;
use crate::bringup::al;
use crate::mailbox::{Wire, foe};
use crate::service::Datagrams;
use crate::service::station::{Which, address, census};
use error::Broken;
use examine::look_at;

mod bootstrap;
mod error;
mod examine;
mod program;

pub use error::{Cause, FirmwareError, Left, Step};
pub use examine::{BOOT_LOADER, Examined, Expected, Runs, Spoken, examine};

/// From a reset or a start until the program runs, at most.
pub const START_TIMEOUT: Duration = Duration::from_secs(30);
/// Until a device is in Init: one that a broken update left at erasing its memory does not look after its state meanwhile.
const INIT_TIMEOUT: Duration = Duration::from_secs(30);
/// A device that resets itself may be seen as it was before.
const SETTLE: Duration = Duration::from_millis(500);
const LOOK_AGAIN: Duration = Duration::from_millis(200);

/// How a program gets into a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Via {
    Foe,
    Program,
}

impl fmt::Display for Via {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Foe => "FoE in Bootstrap",
            Self::Program => "program download (CiA 302-3)",
        })
    }
}

/// What is to be done.
#[derive(Debug, Clone)]
pub struct Order {
    pub via: Via,
    pub file: Vec<u8>,
    /// What the file is called over FoE.
    pub name: String,
    /// Over FoE; 0: none.
    pub password: u32,
    /// Read the file back and compare it, over FoE, where the device hands it out.
    pub read_back: bool,
}

/// An update goes on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Told {
    Step(Step),
    /// So many bytes of so many have gone through.
    Moved {
        done: usize,
        of: usize,
    },
    /// The device puts us off; so much of so much is done.
    Busy {
        done: u16,
        entire: u16,
    },
}

/// What came of reading the file back.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ReadBack {
    NotAsked,
    Same,
    /// The device does not hand it out, with the reason.
    Refused(String),
}

/// An update that succeeded.
#[derive(Debug)]
pub struct Done {
    /// As the device was found afterwards; it is in Init.
    pub after: Examined,
    pub read_back: ReadBack,
    /// From the first byte of the file to the last.
    pub took: Duration,
}

impl Examined {
    /// Whether the device offers a way, and why not. What the device keeps from being read it may have.
    ///
    /// # Errors
    /// What it lacks.
    pub fn offers(&self, via: Via) -> Result<(), &'static str> {
        let boot = self.sii.bootstrap;
        match via {
            Via::Foe if self.in_use => Ok(()),
            Via::Foe if !self.sii.protocols.has(Protocols::FOE) => Err("its EEPROM names no FoE"),
            Via::Foe if boot.receive_size == 0 || boot.send_size == 0 => {
                Err("its EEPROM has no mailboxes for Bootstrap")
            }
            Via::Foe => Ok(()),
            Via::Program if !self.in_use && !self.sii.protocols.has(Protocols::COE) => {
                Err("its EEPROM names no CoE")
            }
            Via::Program => match &self.spoken {
                Some(spoken) if spoken.control.is_none() => Err("it has no object 0x1F51"),
                // One that does not speak now may have it.
                Some(_) | None => Ok(()),
            },
        }
    }

    /// The way that is chosen, or where nobody chose, FoE or else program download.
    ///
    /// # Errors
    /// [`FirmwareError::NoWay`].
    pub fn way(&self, chosen: Option<Via>) -> Result<Via, FirmwareError> {
        let (foe, program) = (self.offers(Via::Foe), self.offers(Via::Program));
        match (chosen, foe, program) {
            (Some(via), ..) => Ok(via),
            (None, Ok(()), _) => Ok(Via::Foe),
            (None, Err(_), Ok(())) => Ok(Via::Program),
            (None, Err(foe), Err(program)) => Err(FirmwareError::NoWay {
                device: self.device.clone(),
                foe,
                program,
            }),
        }
    }

    /// Whether an update may begin: the device is the one that is meant, nobody drives it, and it offers the way.
    ///
    /// # Errors
    /// [`FirmwareError::Identity`], [`FirmwareError::Driven`], [`FirmwareError::NotOffered`], [`FirmwareError::Name`], [`FirmwareError::Empty`].
    pub fn ready(&self, order: &Order, expected: Expected) -> Result<(), FirmwareError> {
        self.check(expected)?;
        let device = || self.device.clone();
        if self.state == AlState::Op && !self.error {
            return Err(FirmwareError::Driven { device: device() });
        }
        let via = order.via;
        self.offers(via)
            .map_err(|reason| FirmwareError::NotOffered {
                device: device(),
                via,
                reason,
            })?;
        let room = foe::room(self.sii.bootstrap.receive_size);
        if via == Via::Foe && !self.in_use && !foe::is_name(&order.name, room) {
            return Err(FirmwareError::Name {
                device: device(),
                name: order.name.clone(),
                room,
            });
        }
        if order.file.is_empty() {
            return Err(FirmwareError::Empty);
        }
        Ok(())
    }
}

/// Puts a program into a device and starts it. The device ends in Init.
///
/// # Errors
/// As [`Examined::ready`], with nothing touched; [`FirmwareError::Failed`] from then on, also where the user ends it.
pub async fn update(
    wire: &Datagrams,
    before: &Examined,
    expected: Expected,
    order: &Order,
    tell: &mut dyn FnMut(Told),
) -> Result<Done, FirmwareError> {
    before.ready(order, expected)?;
    let seized;
    let before = if before.in_use {
        let which = Which::Position(before.device.position);
        seized = look_at(wire, which, &before.device.name, true).await?;
        seized.ready(order, expected)?;
        &seized
    } else {
        before
    };
    let step = Cell::new(Step::Prepare);
    let mut telling = |told| {
        if let Told::Step(now) = told {
            step.set(now);
        }
        tell(told);
    };
    let whole = async {
        let work = async {
            let (read_back, took) = match order.via {
                Via::Foe => bootstrap::send(wire, before, order, &mut telling).await?,
                Via::Program => program::send(wire, before, order, &mut telling).await?,
            };
            telling(Told::Step(Step::Check));
            let after = running(wire, before).await;
            let after = after.map_err(|cause| Step::Check.failed(cause))?;
            Ok((after, read_back, took))
        };
        let done = match wire.stop().unless(work).await {
            Some(done) => done,
            None => Err(given_up(wire, before, step.get()).await),
        };
        match done {
            Ok(done) => Ok(done),
            Err(failed) => Err(failed.at(wire, &before.device).await),
        }
    };
    let (after, read_back, took) = wire.stop().hold(whole).await?;
    // It may show another product once its program runs than it did without.
    after.check(expected)?;
    after.same_as(before)?;
    Ok(Done {
        after,
        read_back,
        took,
    })
}

/// The device is not left in the middle of a transfer: in Init it starts what it has.
async fn given_up(wire: &Datagrams, before: &Examined, step: Step) -> Broken {
    // It may have another address than it had; how it is left is looked at afterwards in any case.
    if let Ok(mut found) = census(wire).await
        && address(wire, &mut found).await.is_ok()
        && let Ok(found) = Which::Position(before.device.position).among(&found)
    {
        let device = [found.named(before.device.name.clone())];
        let _ = al::change_state(wire, &device, AlState::Init, INIT_TIMEOUT).await;
    }
    step.failed(Cause::Interrupted)
}

/// Waits until the device answers again and runs a program, whatever its address and state are meanwhile.
async fn running(wire: &Datagrams, before: &Examined) -> Result<Examined, Cause> {
    let which = Which::Position(before.device.position);
    let end = after(wire, START_TIMEOUT);
    wire.delay(SETTLE).await;
    loop {
        let cause = match examine(wire, which, &before.device.name).await {
            Ok(found) => match found.runs() {
                Runs::Program => return Ok(found),
                Runs::Unknown if found.state != AlState::Bootstrap => return Ok(found),
                runs => Cause::NotRunning {
                    state: found.state,
                    runs,
                    after: START_TIMEOUT,
                },
            },
            Err(error) => Cause::NotBack {
                error: Box::new(error),
                after: START_TIMEOUT,
            },
        };
        if wire.now() >= end {
            return Err(cause);
        }
        wire.delay(LOOK_AGAIN).await;
    }
}

fn after(wire: &impl Wire, time: Duration) -> u64 {
    let time = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    wire.now().saturating_add(time)
}

fn since(wire: &impl Wire, begin: u64) -> Duration {
    Duration::from_nanos(wire.now().saturating_sub(begin))
}
