//! Program download (CiA 302-3) with the waits that maxon's application notes state: stop, wait until the program is stopped, clear, download, start,
//! wait until it runs.
//!
//! Whoever stops or starts a program restarts the device's processor and hears nothing, or an abort; only what 0x1F51 says afterwards
//! counts. Some reset their controller with it and have to be given an address and brought to PreOp again.

use std::time::Duration;

use super::error::{Broken, Cause, Step};
use super::{Examined, INIT_TIMEOUT, LOOK_AGAIN, Order, ReadBack, Told, after, since};
use crate::bringup::DeviceRef;
use crate::bringup::al::{self, AlState};
use crate::mailbox::{CoeClient, SdoError, Timeouts, Wire};
use crate::service::station::{Which, address, census};
use crate::service::{Datagrams, Registers, ServiceError, mailbox};

const PROGRAM_DATA: u16 = 0x1f50;
const PROGRAM_CONTROL: u16 = 0x1f51;
/// Devices with more than one program are not known.
const PROGRAM: u8 = 1;

/// Values of 0x1F51.
const STOP: u8 = 0;
const START: u8 = 1;
const CLEAR: u8 = 3;

/// An order that is not answered is not waited for.
const ORDER: Duration = Duration::from_millis(10);
/// Until 0x1F51 shows what was ordered.
const OBEYED: Duration = Duration::from_secs(10);
const CLEARED: Duration = Duration::from_secs(20);
/// For one segment.
const SEGMENT: Duration = Duration::from_secs(10);
/// For 1 KiB of the whole download.
const KIBIBYTE: Duration = Duration::from_secs(1);
const REQUEST: Duration = Duration::from_millis(500);

fn timeouts(answer: Duration, transfer: Duration) -> Timeouts {
    Timeouts {
        request: REQUEST,
        answer,
        transfer,
    }
}

/// A device in PreOp, as long as it stays there.
struct Session<'a> {
    wire: &'a Datagrams,
    examined: &'a Examined,
    device: DeviceRef,
    coe: CoeClient,
}

pub(super) async fn send(
    wire: &Datagrams,
    before: &Examined,
    order: &Order,
    tell: &mut dyn FnMut(Told),
) -> Result<(ReadBack, Duration), Broken> {
    tell(Told::Step(Step::PreOp));
    let coe = pre_op(wire, before, &before.device)
        .await
        .map_err(|error| Step::PreOp.failed(error))?;
    let mut session = Session {
        wire,
        examined: before,
        device: before.device.clone(),
        coe,
    };

    tell(Told::Step(Step::Stop));
    session
        .obeys(STOP)
        .await
        .map_err(|cause| Step::Stop.failed(cause))?;

    tell(Told::Step(Step::Clear));
    session
        .write(CLEAR, timeouts(CLEARED, CLEARED))
        .await
        .map_err(|error| Step::Clear.failed(error))?;

    tell(Told::Step(Step::Download));
    let begin = wire.now();
    session
        .download(&order.file, tell)
        .await
        .map_err(|error| Step::Download.failed(error))?;
    let took = since(wire, begin);

    tell(Told::Step(Step::Start));
    session
        .obeys(START)
        .await
        .map_err(|cause| Step::Start.failed(cause))?;
    let devices = std::slice::from_ref(&session.device);
    al::change_state(wire, devices, AlState::Init, al::BACK_TIMEOUT)
        .await
        .map_err(|error| Step::Start.failed(error))?;
    let read_back = match order.read_back {
        true => ReadBack::Refused("0x1F50 can only be written".to_owned()),
        false => ReadBack::NotAsked,
    };
    Ok((read_back, took))
}

/// A mailbox in PreOp, whatever state the device is in.
async fn pre_op(
    wire: &Datagrams,
    examined: &Examined,
    device: &DeviceRef,
) -> Result<CoeClient, ServiceError> {
    let devices = std::slice::from_ref(device);
    al::change_state(wire, devices, AlState::Init, INIT_TIMEOUT).await?;
    let registers = Registers {
        wire,
        device,
        step: "setting up the mailboxes",
    };
    let layout = mailbox::configure(&registers, &examined.sii, examined.sii.mailbox).await?;
    al::change_state(wire, devices, AlState::PreOp, mailbox::PRE_OP_TIMEOUT).await?;
    Ok(CoeClient::new(layout))
}

impl Session<'_> {
    async fn write(&mut self, value: u8, timeouts: Timeouts) -> Result<(), SdoError> {
        self.coe.set_timeouts(timeouts);
        self.coe
            .download(self.wire, PROGRAM_CONTROL, PROGRAM, false, &[value])
            .await
    }

    async fn control(&mut self) -> Result<Vec<u8>, SdoError> {
        self.coe.set_timeouts(timeouts(REQUEST, OBEYED));
        self.coe
            .upload(self.wire, PROGRAM_CONTROL, PROGRAM, false)
            .await
    }

    /// Orders, unless it is so already, and waits until it is.
    async fn obeys(&mut self, wanted: u8) -> Result<(), Cause> {
        if matches!(self.control().await.as_deref(), Ok([value]) if *value == wanted) {
            return Ok(());
        }
        let refused = self.write(wanted, timeouts(ORDER, ORDER)).await.err();
        let end = after(self.wire, OBEYED);
        loop {
            let last = match self.control().await {
                Ok(value) if value == [wanted] => return Ok(()),
                Ok(value) => format!("it is {value:?}"),
                Err(error) => {
                    self.come_back().await;
                    error.to_string()
                }
            };
            if self.wire.now() >= end {
                return Err(Cause::Control {
                    wanted,
                    after: OBEYED,
                    last,
                    refused: refused.map(Box::new),
                });
            }
            self.wire.delay(LOOK_AGAIN).await;
        }
    }

    /// Brings a device that has lost address or state to PreOp again, as far as that is possible now.
    async fn come_back(&mut self) {
        let Ok(mut found) = census(self.wire).await else {
            return;
        };
        if address(self.wire, &mut found).await.is_err() {
            return;
        }
        let position = Which::Position(self.device.position);
        let Ok(found) = position.among(&found) else {
            return;
        };
        if found.station == self.device.station && found.state == AlState::PreOp && !found.error {
            return;
        }
        let device = found.named(self.device.name.clone());
        if let Ok(coe) = pre_op(self.wire, self.examined, &device).await {
            (self.device, self.coe) = (device, coe);
        }
    }

    async fn download(&mut self, file: &[u8], tell: &mut dyn FnMut(Told)) -> Result<(), SdoError> {
        let of = file.len();
        let kibibytes = u32::try_from(of / 1024).unwrap_or(u32::MAX);
        let all = KIBIBYTE.saturating_mul(kibibytes).saturating_add(SEGMENT);
        self.coe.set_timeouts(timeouts(SEGMENT, all));
        self.coe
            .download_with(self.wire, (PROGRAM_DATA, PROGRAM), file, &mut |done| {
                tell(Told::Moved { done, of })
            })
            .await
    }
}
