//! Firmware update with the two methods that drives support. MAY BLOCK AND ALLOCATE; works on a bus
//! without a cycle ([`ecaxis_master::acyclic`]).
//!
//! - `identify`: identity, update methods and running program of a device;
//! - `bootstrap`: a file over FoE in Bootstrap, started on the way back to Init;
//! - `program_download`: program download with 0x1F50, 0x1F51 and 0x1F56 (CiA 302-3);
//! - `error`: the failed step and the final state of the device.
//!
//! The content of a file is opaque. Only the device is checked: its identity before the update, and
//! identity and running program afterwards. After a failed update, a device keeps its boot loader,
//! in Bootstrap or with stopped program. A new update can start from there.

use std::cell::Cell;
use std::fmt;
use std::time::Duration;

use ecaxis_esi::sii::Protocols;

use ecaxis_master::acyclic::AlState;
use ecaxis_master::acyclic::DatagramClient;
use ecaxis_master::acyclic::al;
use ecaxis_master::acyclic::device::locate;
use ecaxis_master::acyclic::{Registers, mailbox};
use ecaxis_master::config::Locator;
use ecaxis_master::mailbox::{MailboxTransport, foe};
use error::StepFailure;
use identify::examine_with;

mod bootstrap;
mod error;
mod identify;
mod program_download;

pub use error::{FinalDeviceState, FirmwareError, UpdateCause, UpdateStep};
pub use identify::{BOOT_LOADER, CoeIdentity, DeviceIdentity, Expected, RunningProgram, examine};

/// The maximum time from a reset or start until the program runs.
pub const START_TIMEOUT: Duration = Duration::from_secs(30);
/// The time-out for Init. After a failed update, a device may be busy erasing its memory.
const INIT_TIMEOUT: Duration = Duration::from_secs(30);
/// A device that resets itself may show its old state for this time.
const SETTLE: Duration = Duration::from_millis(500);
const LOOK_AGAIN: Duration = Duration::from_millis(200);

/// The update method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpdateMethod {
    Foe,
    Program,
}

impl fmt::Display for UpdateMethod {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Foe => "FoE in Bootstrap",
            Self::Program => "program download (CiA 302-3)",
        })
    }
}

/// The parameters of an update.
#[derive(Debug, Clone)]
pub struct UpdateRequest {
    pub via: UpdateMethod,
    pub file: Vec<u8>,
    /// The file name for FoE.
    pub name: String,
    /// The password for FoE; 0: none.
    pub password: u32,
    /// Read the file back over FoE and compare it, if the device supports it.
    pub read_back: bool,
}

/// The progress of an update.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum UpdateProgress {
    Step(UpdateStep),
    /// Transferred bytes and total.
    Moved {
        done: usize,
        of: usize,
    },
    /// The device is busy; its progress and total.
    Busy {
        done: u16,
        entire: u16,
    },
}

/// The result of reading the file back.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ReadBack {
    NotAsked,
    Same,
    /// The device refuses to send it, with the reason.
    Refused(String),
}

/// The result of a successful update.
#[derive(Debug)]
pub struct UpdateReport {
    /// The device after the update, in Init.
    pub after: DeviceIdentity,
    pub read_back: ReadBack,
    /// The time from the first byte of the file to the last.
    pub took: Duration,
}

impl DeviceIdentity {
    /// Checks whether the device supports a method. A property that cannot be read counts as
    /// supported.
    ///
    /// # Errors
    /// Returns the missing property.
    pub fn offers(&self, via: UpdateMethod) -> Result<(), &'static str> {
        let boot = self.sii.bootstrap;
        match via {
            UpdateMethod::Foe if self.in_use => Ok(()),
            UpdateMethod::Foe if !self.sii.protocols.has(Protocols::FOE) => {
                Err("its EEPROM names no FoE")
            }
            UpdateMethod::Foe if boot.receive_size == 0 || boot.send_size == 0 => {
                Err("its EEPROM has no mailboxes for Bootstrap")
            }
            UpdateMethod::Foe => Ok(()),
            UpdateMethod::Program if !self.in_use && !self.sii.protocols.has(Protocols::COE) => {
                Err("its EEPROM names no CoE")
            }
            UpdateMethod::Program => match &self.spoken {
                Some(spoken) if spoken.control.is_none() => Err("it has no object 0x1F51"),
                // The property is unreadable now, but may exist.
                Some(_) | None => Ok(()),
            },
        }
    }

    /// Returns the chosen method, else FoE, else program download.
    ///
    /// # Errors
    /// [`FirmwareError::NoWay`].
    pub fn way(&self, chosen: Option<UpdateMethod>) -> Result<UpdateMethod, FirmwareError> {
        let (foe, program) = (
            self.offers(UpdateMethod::Foe),
            self.offers(UpdateMethod::Program),
        );
        match (chosen, foe, program) {
            (Some(via), ..) => Ok(via),
            (None, Ok(()), _) => Ok(UpdateMethod::Foe),
            (None, Err(_), Ok(())) => Ok(UpdateMethod::Program),
            (None, Err(foe), Err(program)) => Err(FirmwareError::NoWay {
                device: self.device.clone(),
                foe,
                program,
            }),
        }
    }

    /// Checks whether an update may begin: correct device, not driven, method supported.
    ///
    /// # Errors
    /// [`FirmwareError::Identity`], [`FirmwareError::Driven`], [`FirmwareError::NotOffered`],
    /// [`FirmwareError::Name`], [`FirmwareError::Empty`].
    pub fn ready(&self, order: &UpdateRequest, expected: Expected) -> Result<(), FirmwareError> {
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
        if via == UpdateMethod::Foe && !self.in_use && !foe::is_name(&order.name, room) {
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

/// Writes a program to a device and starts it. The device ends in Init.
///
/// # Errors
/// Those of [`DeviceIdentity::ready`], without any change. [`FirmwareError::Failed`] after that,
/// also for a cancellation.
pub async fn update(
    wire: &DatagramClient,
    before: &DeviceIdentity,
    expected: Expected,
    order: &UpdateRequest,
    report: &mut dyn FnMut(UpdateProgress),
) -> Result<UpdateReport, FirmwareError> {
    before.ready(order, expected)?;
    let seized;
    let before = if before.in_use {
        let at = Locator::Position(before.device.position);
        seized = examine_with(wire, at, Some(&before.device.name), true).await?;
        seized.ready(order, expected)?;
        &seized
    } else {
        before
    };
    let step = Cell::new(UpdateStep::Prepare);
    let mut reporting = |reported| {
        if let UpdateProgress::Step(now) = reported {
            step.set(now);
        }
        report(reported);
    };
    let whole = async {
        let work = async {
            let (read_back, took) = match order.via {
                UpdateMethod::Foe => bootstrap::send(wire, before, order, &mut reporting).await?,
                UpdateMethod::Program => {
                    program_download::send(wire, before, order, &mut reporting).await?
                }
            };
            reporting(UpdateProgress::Step(UpdateStep::Check));
            let after = running(wire, before).await;
            let after = after.map_err(|cause| UpdateStep::Check.failed(cause))?;
            Ok((after, read_back, took))
        };
        let done = match wire.stop().run_until_cancelled(work).await {
            Some(done) => done,
            None => Err(given_up(wire, before, step.get()).await),
        };
        match done {
            Ok(done) => Ok(done),
            Err(failed) => {
                if failed.is_refusal() {
                    restore_state(wire, before).await;
                }
                Err(failed.at(wire, &before.device).await)
            }
        }
    };
    let (after, read_back, took) = wire.stop().shield(whole).await?;
    // With a running program, it may show another product than without.
    after.check(expected)?;
    after.same_as(before)?;
    Ok(UpdateReport {
        after,
        read_back,
        took,
    })
}

/// Takes a device that refused the file back to the state in which it was found. The state in which
/// it stays is read afterwards.
async fn restore_state(wire: &DatagramClient, before: &DeviceIdentity) {
    let devices = std::slice::from_ref(&before.device);
    let back = async |state, timeout| al::change_state(wire, devices, state, timeout).await;
    let way: &[AlState] = match before.state {
        AlState::PreOp => &[AlState::PreOp],
        AlState::SafeOp => &[AlState::PreOp, AlState::SafeOp],
        _ => &[],
    };
    if back(AlState::Init, al::BACK_TIMEOUT).await.is_err() || way.is_empty() {
        return;
    }
    let registers = Registers {
        wire,
        device: &before.device,
        step: "setting up the mailboxes",
    };
    let areas = before.sii.mailbox;
    if mailbox::configure(&registers, &before.sii, areas)
        .await
        .is_err()
    {
        return;
    }
    for state in way {
        if back(*state, mailbox::PRE_OP_TIMEOUT).await.is_err() {
            return;
        }
    }
}

/// Ends a transfer by returning to Init, where the device starts its present program.
async fn given_up(wire: &DatagramClient, before: &DeviceIdentity, step: UpdateStep) -> StepFailure {
    // Its address may have changed; the final state is checked afterwards.
    let at = Locator::Position(before.device.position);
    if let Ok((_, device)) = locate(wire, at, Some(&before.device.name)).await {
        let _ = al::change_state(wire, &[device], AlState::Init, INIT_TIMEOUT).await;
    }
    step.failed(UpdateCause::Interrupted)
}

/// Waits until the device answers again and runs a program, independent of address and state.
async fn running(
    wire: &DatagramClient,
    before: &DeviceIdentity,
) -> Result<DeviceIdentity, UpdateCause> {
    let at = Locator::Position(before.device.position);
    let end = after(wire, START_TIMEOUT);
    wire.delay(SETTLE).await;
    loop {
        let cause = match examine(wire, at, Some(&before.device.name)).await {
            Ok(found) => match found.runs() {
                RunningProgram::Program => return Ok(found),
                RunningProgram::Unknown if found.state != AlState::Bootstrap => return Ok(found),
                runs => UpdateCause::NotRunning {
                    state: found.state,
                    runs,
                    after: START_TIMEOUT,
                },
            },
            Err(error) => UpdateCause::NotBack {
                error,
                after: START_TIMEOUT,
            },
        };
        if wire.now() >= end {
            return Err(cause);
        }
        wire.delay(LOOK_AGAIN).await;
    }
}

fn after(wire: &impl MailboxTransport, time: Duration) -> u64 {
    let time = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    wire.now().saturating_add(time)
}

fn since(wire: &impl MailboxTransport, begin: u64) -> Duration {
    Duration::from_nanos(wire.now().saturating_sub(begin))
}
