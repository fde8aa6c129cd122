//! Work on a bus without a cycle: opens a link and exchanges frames while an operation runs.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread;

use super::STACK;
use crate::acyclic::{DatagramClient, StateTimeouts};
use crate::cancel::CancelToken;
use crate::clock::Clock;
use crate::link::Link;
use crate::link::pdu_loop::{drive_pdu_loop, main_device};
use crate::mailbox::MailboxTransport;
use crate::report::{Cause, Error};
use crate::text::panic_text;

/// Runs `work` on a dedicated link and thread until it completes or is cancelled
/// ([`crate::cancel::CancelToken`]). Blocks.
///
/// # Errors
/// [`Cause::Interrupted`] if `stop` ended the work outside a shielded section; errors that open
/// or use the link.
pub fn with_bus<T, W>(
    open: impl FnOnce() -> Result<Box<dyn Link>, Error> + Send + 'static,
    clock: Clock,
    stop: Arc<CancelToken>,
    work: W,
) -> Result<T, Error>
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
                .map_err(|error| Cause::Record(error.to_string()).into());
            done.and_then(|done| recorded.map(|_| done))
        })
        .map_err(|error| Cause::Thread(error.to_string()))?;
    owner
        .join()
        .unwrap_or_else(|panic| Err(Cause::Panicked(panic_text(&*panic)).into()))
}

/// Runs `work` on a link, on the calling thread and its clock ([`Clock::enter`]).
///
/// # Errors
/// As [`with_bus`].
pub fn run_on_link<T>(
    link: &mut dyn Link,
    clock: Clock,
    stop: &CancelToken,
    work: impl AsyncFnOnce(DatagramClient) -> T,
) -> Result<T, Error> {
    let (main_device, mut port) = main_device(0, StateTimeouts::DEFAULT.back_to_init);
    let run = AssertUnwindSafe(|| {
        let wire = DatagramClient::without_cycle(main_device)
            .in_ring(link.ring())
            .on_interface(link.nic());
        let work = Box::pin(work(wire));
        let ends = wire.stop();
        drive_pdu_loop(
            &mut port,
            link,
            clock,
            ends.cancel_with(stop, ends.run_until_cancelled(work)),
        )
    });
    match catch_unwind(run) {
        Ok(Ok(Some(done))) => Ok(done),
        Ok(Ok(None)) => Err(Cause::Interrupted.into()),
        Ok(Err(error)) => Err(Cause::Link(error).into()),
        Err(panic) => Err(Cause::Panicked(panic_text(&*panic)).into()),
    }
}
