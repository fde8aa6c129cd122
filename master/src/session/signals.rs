//! Signal handling while axes move: which signals stop the machine, and which are ignored.

use std::fmt;
use std::io;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use tokio::runtime::Builder;
use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::cancel::CancelToken;
use crate::sys::rights;
use crate::sys::signal as disposition;

/// Signals that would end or suspend the process by default, ignored while the axes move.
const IGNORED: [libc::c_int; 5] = [
    libc::SIGUSR1,
    libc::SIGUSR2,
    libc::SIGPIPE,
    libc::SIGTTIN,
    libc::SIGTTOU,
];

/// A repeated signal within this time is ignored: timeout(1), for example, signals the process and
/// its group.
const REPEATED: Duration = Duration::from_millis(500);

/// The reaction of [`stop_on_signals`] to a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignalReport {
    /// The token is cancelled: the run stops in order.
    Stopping,
    /// Another SIGINT or SIGTERM arrived. If the process ends now, only the drives' watchdogs stop
    /// the axes.
    StopRepeated,
    /// SIGTSTP (Ctrl-Z) was ignored: a suspended process sends no frames.
    NotSuspended,
}

impl fmt::Display for SignalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Stopping => "stopping; once more to leave at once",
            Self::StopRepeated => "left without stopping the machine",
            Self::NotSuspended => "Ctrl-Z is ignored: frames must not stop; Ctrl-C stops in order",
        })
    }
}

/// Cancels `stop` on SIGINT, SIGTERM or SIGHUP, so that a run with this token stops in order. SIGHUP
/// has no effect if it was ignored before, as by `nohup`.
///
/// The process ignores SIGUSR1, SIGUSR2, SIGPIPE, SIGTTIN and SIGTTOU from now on. SIGTSTP no
/// longer suspends it. A dedicated thread calls `report`. SIGHUP is never reported as
/// [`SignalReport::StopRepeated`]: a closing terminal may send it several times.
///
/// # Errors
/// Fails if a signal cannot be caught or the thread cannot be started.
pub fn stop_on_signals(
    stop: Arc<CancelToken>,
    mut report: impl FnMut(SignalReport) + Send + 'static,
) -> io::Result<()> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let guard = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut hang_up = match disposition::is_ignored(libc::SIGHUP)? {
        true => None,
        false => Some(signal(SignalKind::hangup())?),
    };
    let mut suspend = signal(SignalKind::from_raw(libc::SIGTSTP))?;
    drop(guard);
    IGNORED.into_iter().try_for_each(disposition::ignore)?;
    let serve = async move {
        let mut first: Option<Instant> = None;
        loop {
            let hung_up = tokio::select! {
                biased;
                _ = interrupt.recv() => false,
                _ = terminate.recv() => false,
                () = received(&mut hang_up) => true,
                _ = suspend.recv() => {
                    report(SignalReport::NotSuspended);
                    continue;
                }
            };
            stop.cancel();
            match first {
                None => {
                    first = Some(Instant::now());
                    report(SignalReport::Stopping);
                }
                Some(first) if !hung_up && first.elapsed() >= REPEATED => {
                    report(SignalReport::StopRepeated);
                }
                Some(_) => {}
            }
        }
    };
    thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            rights::drop_capabilities();
            runtime.block_on(serve);
        })?;
    Ok(())
}

/// Waits for the signal; never returns if there is none.
async fn received(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => {
            signal.recv().await;
        }
        None => std::future::pending().await,
    }
}
