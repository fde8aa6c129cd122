//! Firmware update over FoE in Bootstrap: Init, Bootstrap with its own mailboxes from the EEPROM,
//! the file, and back to Init, where the device starts the new program.

use std::time::Duration;

use super::error::{StepFailure, UpdateCause, UpdateStep};
use super::{DeviceIdentity, INIT_TIMEOUT, ReadBack, UpdateProgress, UpdateRequest, since};
use ecaxis_master::acyclic::al::{self, AlState};
use ecaxis_master::acyclic::{DatagramClient, Registers, StateError, mailbox};
use ecaxis_master::mailbox::foe::FoeProgress;
use ecaxis_master::mailbox::{FoeCause, FoeClient, MailboxTransport};
use ecaxis_master::report;

pub(super) async fn send(
    wire: &DatagramClient,
    before: &DeviceIdentity,
    order: &UpdateRequest,
    report: &mut dyn FnMut(UpdateProgress),
) -> Result<(ReadBack, Duration), StepFailure> {
    let devices = std::slice::from_ref(&before.device);
    report(UpdateProgress::Step(UpdateStep::Prepare));
    al::change_state(wire, devices, AlState::Init, INIT_TIMEOUT)
        .await
        .map_err(|error| UpdateStep::Prepare.failed(error))?;

    report(UpdateProgress::Step(UpdateStep::Bootstrap));
    let registers = Registers {
        wire,
        device: &before.device,
        step: "setting up the mailboxes of Bootstrap",
    };
    let layout = mailbox::configure(&registers, &before.sii, before.sii.bootstrap)
        .await
        .map_err(|error| UpdateStep::Bootstrap.failed(error))?;
    al::change_state(wire, devices, AlState::Bootstrap, mailbox::PRE_OP_TIMEOUT)
        .await
        .map_err(|error| UpdateStep::Bootstrap.failed(error))?;

    report(UpdateProgress::Step(UpdateStep::Send));
    let mut foe = FoeClient::new(layout);
    let of = order.file.len();
    let mut progress = |progress| {
        report(match progress {
            FoeProgress::Bytes(done) => UpdateProgress::Moved { done, of },
            FoeProgress::Busy { done, entire } => UpdateProgress::Busy { done, entire },
        });
    };
    let begin = wire.now();
    let (name, file) = (&order.name, &order.file);
    let sent = foe.write(wire, name, order.password, file, &mut progress);
    let sent = sent.await;
    sent.map_err(|error| UpdateStep::Send.failed(error))?;
    let took = since(wire, begin);

    let read_back = if order.read_back {
        progress(FoeProgress::Bytes(0));
        compare(wire, &mut foe, order, &mut progress)
            .await
            .map_err(|cause| UpdateStep::ReadBack.failed(cause))?
    } else {
        ReadBack::NotAsked
    };

    report(UpdateProgress::Step(UpdateStep::Leave));
    // A device that resets itself cannot confirm Init; a later check detects whether it returns.
    match al::change_state(wire, devices, AlState::Init, al::BACK_TIMEOUT).await {
        Err(error)
            if matches!(
                *error.cause,
                report::Cause::State(StateError::Refused { .. })
            ) =>
        {
            Err(UpdateStep::Leave.failed(error))
        }
        Ok(()) | Err(_) => Ok((read_back, took)),
    }
}

async fn compare(
    wire: &DatagramClient,
    foe: &mut FoeClient,
    order: &UpdateRequest,
    progress: &mut dyn FnMut(FoeProgress),
) -> Result<ReadBack, UpdateCause> {
    // One more byte detects a longer file.
    let most = order.file.len().saturating_add(1);
    let read = foe
        .read(wire, &order.name, order.password, most, progress)
        .await;
    match read {
        Ok(file) if file == order.file => Ok(ReadBack::Same),
        Ok(file) => {
            let same = file.iter().zip(&order.file).take_while(|(a, b)| a == b);
            Err(UpdateCause::Differs { at: same.count() })
        }
        Err(error) => match error.cause {
            FoeCause::TooLarge { .. } => Err(UpdateCause::Differs {
                at: order.file.len(),
            }),
            FoeCause::Refused { .. } | FoeCause::Mailbox(_) => {
                Ok(ReadBack::Refused(error.to_string()))
            }
            _ => Err(error.into()),
        },
    }
}
