//! Ctrl-C, SIGTERM, and for who holds a terminal its end: the first stops the machine in order, the second leaves at once.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use tokio::runtime::{Builder, Runtime};
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::hints::FAILED;
use super::{jog, note};

/// Sets `stop` at the first signal. Without signals the program still ends by itself, so a failure
/// here is only told.
pub(crate) fn stop_on_interrupt(stop: &Arc<AtomicBool>) {
    told(listen(Arc::clone(stop), true));
}

/// Likewise, at the end of the terminal, too; nothing is written on it.
pub(crate) fn stop_quietly(stop: &Arc<AtomicBool>) {
    told(listen(Arc::clone(stop), false));
}

/// Sets `flag` at every SIGUSR1.
pub(crate) fn raise_on_usr1(flag: &Arc<AtomicBool>) -> io::Result<()> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let guard = runtime.enter();
    let mut user = signal(SignalKind::user_defined1())?;
    drop(guard);
    let flag = Arc::clone(flag);
    let wait = async move {
        while user.recv().await.is_some() {
            flag.store(true, Ordering::Relaxed);
        }
    };
    in_background(runtime, wait)
}

fn in_background(
    runtime: Runtime,
    wait: impl Future<Output = ()> + Send + 'static,
) -> io::Result<()> {
    thread::Builder::new()
        .name("signals".into())
        .spawn(move || runtime.block_on(wait))?;
    Ok(())
}

fn told(listens: io::Result<()>) {
    if let Err(e) = listens {
        note(&format!(
            "warning: Ctrl-C will not stop the machine in order: {e}"
        ));
    }
}

/// `aloud`: there is nobody who draws, and a terminal that ends is `nohup`'s business.
fn listen(stop: Arc<AtomicBool>, aloud: bool) -> io::Result<()> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let guard = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut hang_up = match aloud {
        true => None,
        false => Some(signal(SignalKind::hangup())?),
    };
    drop(guard);
    let wait = async move {
        loop {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
                () = received(&mut hang_up) => {}
            }
            if stop.swap(true, Ordering::Relaxed) {
                jog::terminal::restore();
                note("left without stopping the machine");
                std::process::exit(i32::from(FAILED));
            }
            if aloud {
                note("stopping; once more to leave at once");
            }
        }
    };
    in_background(runtime, wait)
}

/// Never, where nobody listens.
async fn received(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => {
            signal.recv().await;
        }
        None => std::future::pending().await,
    }
}
