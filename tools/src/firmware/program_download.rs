//! Program download (CiA 302-3) with the waits from maxon's application notes: stop, wait, clear,
//! download, start, wait.
//!
//! Stopping or starting a program restarts the device's processor. The command then gets no answer
//! or an abort; only the later value of 0x1F51 counts. Some devices also reset their controller and
//! need a new station address and PreOp.

use std::time::Duration;

use super::error::{StepFailure, UpdateCause, UpdateStep};
use super::{
    DeviceIdentity, INIT_TIMEOUT, LOOK_AGAIN, ReadBack, UpdateProgress, UpdateRequest, after, since,
};
use ecaxis_master::acyclic::DeviceRef;
use ecaxis_master::acyclic::al::{self, AlState};
use ecaxis_master::acyclic::device::locate;
use ecaxis_master::acyclic::{DatagramClient, Registers, mailbox};
use ecaxis_master::config::Locator;
use ecaxis_master::mailbox::{CoeClient, MailboxTransport, SdoError, Timeouts};
use ecaxis_master::report::Error;

const PROGRAM_DATA: u16 = 0x1f50;
const PROGRAM_CONTROL: u16 = 0x1f51;
/// The program number; devices with several programs are not known.
const PROGRAM: u8 = 1;

/// Values of 0x1F51.
const STOP: u8 = 0;
const START: u8 = 1;
const CLEAR: u8 = 3;

/// The time-out of a command, which may stay unanswered.
const ORDER: Duration = Duration::from_millis(10);
/// The time-out until 0x1F51 shows the commanded value.
const OBEYED: Duration = Duration::from_secs(10);
const CLEARED: Duration = Duration::from_secs(20);
/// The time-out of one segment.
const SEGMENT: Duration = Duration::from_secs(10);
/// The time-out per KiB of the whole download.
const KIBIBYTE: Duration = Duration::from_secs(1);
const REQUEST: Duration = Duration::from_millis(500);

fn timeouts(answer: Duration, transfer: Duration) -> Timeouts {
    Timeouts {
        request: REQUEST,
        answer,
        transfer,
    }
}

/// A device in PreOp.
struct Session<'a> {
    wire: &'a DatagramClient,
    examined: &'a DeviceIdentity,
    device: DeviceRef,
    coe: CoeClient,
}

pub(super) async fn send(
    wire: &DatagramClient,
    before: &DeviceIdentity,
    order: &UpdateRequest,
    report: &mut dyn FnMut(UpdateProgress),
) -> Result<(ReadBack, Duration), StepFailure> {
    report(UpdateProgress::Step(UpdateStep::PreOp));
    let coe = pre_op(wire, before, &before.device)
        .await
        .map_err(|error| UpdateStep::PreOp.failed(error))?;
    let mut session = Session {
        wire,
        examined: before,
        device: before.device.clone(),
        coe,
    };

    report(UpdateProgress::Step(UpdateStep::Stop));
    session
        .obeys(STOP)
        .await
        .map_err(|cause| UpdateStep::Stop.failed(cause))?;

    report(UpdateProgress::Step(UpdateStep::Clear));
    session
        .write(CLEAR, timeouts(CLEARED, CLEARED))
        .await
        .map_err(|error| UpdateStep::Clear.failed(error))?;

    report(UpdateProgress::Step(UpdateStep::Download));
    let begin = wire.now();
    session
        .download(&order.file, report)
        .await
        .map_err(|error| UpdateStep::Download.failed(error))?;
    let took = since(wire, begin);

    report(UpdateProgress::Step(UpdateStep::Start));
    session
        .obeys(START)
        .await
        .map_err(|cause| UpdateStep::Start.failed(cause))?;
    let devices = std::slice::from_ref(&session.device);
    al::change_state(wire, devices, AlState::Init, al::BACK_TIMEOUT)
        .await
        .map_err(|error| UpdateStep::Start.failed(error))?;
    let read_back = match order.read_back {
        true => ReadBack::Refused("0x1F50 can only be written".to_owned()),
        false => ReadBack::NotAsked,
    };
    Ok((read_back, took))
}

/// Opens the mailbox in PreOp, from any state.
async fn pre_op(
    wire: &DatagramClient,
    examined: &DeviceIdentity,
    device: &DeviceRef,
) -> Result<CoeClient, Error> {
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

    /// Commands the value unless it is set already, and waits for it.
    async fn obeys(&mut self, wanted: u8) -> Result<(), UpdateCause> {
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
                    self.wait_until_running().await;
                    error.without_station().to_string()
                }
            };
            if self.wire.now() >= end {
                return Err(UpdateCause::Control {
                    wanted,
                    after: OBEYED,
                    last,
                    refused: refused.map(Box::new),
                });
            }
            self.wire.delay(LOOK_AGAIN).await;
        }
    }

    /// Brings a device that lost address or state to PreOp again, if possible now.
    async fn wait_until_running(&mut self) {
        let at = Locator::Position(self.device.position);
        let Ok((found, device)) = locate(self.wire, at, Some(&self.device.name)).await else {
            return;
        };
        if found.station == self.device.station && found.state == AlState::PreOp && !found.error {
            return;
        }
        if let Ok(coe) = pre_op(self.wire, self.examined, &device).await {
            (self.device, self.coe) = (device, coe);
        }
    }

    async fn download(
        &mut self,
        file: &[u8],
        report: &mut dyn FnMut(UpdateProgress),
    ) -> Result<(), SdoError> {
        let of = file.len();
        let kibibytes = u32::try_from(of / 1024).unwrap_or(u32::MAX);
        let all = KIBIBYTE.saturating_mul(kibibytes).saturating_add(SEGMENT);
        self.coe.set_timeouts(timeouts(SEGMENT, all));
        self.coe
            .download_with(self.wire, (PROGRAM_DATA, PROGRAM), file, &mut |done| {
                report(UpdateProgress::Moved { done, of })
            })
            .await
    }
}
