//! A file over FoE in Bootstrap: Init, the mailboxes that the EEPROM names for Bootstrap, the file, and back to Init, where the device starts
//! what it was given.

use std::time::Duration;

use super::error::{Broken, Cause, Step};
use super::{Examined, INIT_TIMEOUT, Order, ReadBack, Told, since};
use crate::bringup::al::{self, AlState};
use crate::mailbox::foe::FoeProgress;
use crate::mailbox::{FoeClient, FoeError, Wire};
use crate::service::{Datagrams, Registers, mailbox};

pub(super) async fn send(
    wire: &Datagrams,
    before: &Examined,
    order: &Order,
    tell: &mut dyn FnMut(Told),
) -> Result<(ReadBack, Duration), Broken> {
    let devices = std::slice::from_ref(&before.device);
    tell(Told::Step(Step::Prepare));
    al::change_state(wire, devices, AlState::Init, INIT_TIMEOUT)
        .await
        .map_err(|error| Step::Prepare.failed(error))?;

    tell(Told::Step(Step::Bootstrap));
    let registers = Registers {
        wire,
        device: &before.device,
        step: "setting up the mailboxes of Bootstrap",
    };
    let layout = mailbox::configure(&registers, &before.sii, before.sii.bootstrap)
        .await
        .map_err(|error| Step::Bootstrap.failed(error))?;
    al::change_state(wire, devices, AlState::Bootstrap, mailbox::PRE_OP_TIMEOUT)
        .await
        .map_err(|error| Step::Bootstrap.failed(error))?;

    tell(Told::Step(Step::Send));
    let mut foe = FoeClient::new(layout);
    let of = order.file.len();
    let mut progress = |progress| {
        tell(match progress {
            FoeProgress::Bytes(done) => Told::Moved { done, of },
            FoeProgress::Busy { done, entire } => Told::Busy { done, entire },
        });
    };
    let begin = wire.now();
    foe.write(
        wire,
        &order.name,
        order.password,
        &order.file,
        &mut progress,
    )
    .await
    .map_err(|error| Step::Send.failed(error))?;
    let took = since(wire, begin);

    let read_back = if order.read_back {
        progress(FoeProgress::Bytes(0));
        compare(wire, &mut foe, order, &mut progress)
            .await
            .map_err(|cause| Step::ReadBack.failed(cause))?
    } else {
        ReadBack::NotAsked
    };

    tell(Told::Step(Step::Leave));
    // A device that resets itself is not there to say that it has arrived; whether it comes back is seen afterwards.
    match al::change_state(wire, devices, AlState::Init, al::BACK_TIMEOUT).await {
        Err(error @ crate::bringup::StateError::Refused { .. }) => Err(Step::Leave.failed(error)),
        Ok(()) | Err(_) => Ok((read_back, took)),
    }
}

async fn compare(
    wire: &Datagrams,
    foe: &mut FoeClient,
    order: &Order,
    progress: &mut dyn FnMut(FoeProgress),
) -> Result<ReadBack, Cause> {
    // One byte more, so that a longer file shows.
    let most = order.file.len().saturating_add(1);
    let read = foe
        .read(wire, &order.name, order.password, most, progress)
        .await;
    match read {
        Ok(file) if file == order.file => Ok(ReadBack::Same),
        Ok(file) => {
            let same = file.iter().zip(&order.file).take_while(|(a, b)| a == b);
            Err(Cause::Differs { at: same.count() })
        }
        Err(FoeError::TooLarge { .. }) => Err(Cause::Differs {
            at: order.file.len(),
        }),
        Err(error @ (FoeError::Refused { .. } | FoeError::Mailbox { .. })) => {
            Ok(ReadBack::Refused(error.to_string()))
        }
        Err(error) => Err(error.into()),
    }
}
