//! Ctrl-C and SIGTERM: the first stops the machine in order, the second leaves at once.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};

use super::hints::FAILED;
use super::note;

/// Sets `stop` at the first signal. Without signals the program still ends by itself, so a failure
/// here is only told.
pub(crate) fn stop_on_interrupt(stop: &Arc<AtomicBool>) {
    if let Err(e) = listen(Arc::clone(stop)) {
        note(&format!(
            "warning: Ctrl-C will not stop the machine in order: {e}"
        ));
    }
}

fn listen(stop: Arc<AtomicBool>) -> io::Result<()> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let guard = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    drop(guard);
    let wait = async move {
        loop {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
            if stop.swap(true, Ordering::Relaxed) {
                note("left without stopping the machine");
                std::process::exit(i32::from(FAILED));
            }
            note("stopping; once more to leave at once");
        }
    };
    thread::Builder::new()
        .name("signals".into())
        .spawn(move || runtime.block_on(wait))?;
    Ok(())
}
