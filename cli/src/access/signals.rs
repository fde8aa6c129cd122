//! Signals of the subcommands that send frames: [`session::stop_on_signals`] with terminal
//! messages.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::session::{self, SignalReport};
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};

use crate::failure::FAILED;
use crate::render::note;

/// Cancels `stop` at the first signal that ends the program; the next signal exits at once. An
/// installation failure is only reported, because the program ends without signals, too.
pub(crate) fn stop_on_interrupt(stop: &Arc<CancelToken>) {
    listen(stop, true, || {});
}

/// Like [`stop_on_interrupt`], but prints nothing until the program exits. `restore` runs first.
pub(crate) fn stop_quietly(stop: &Arc<CancelToken>, restore: impl Fn() + Send + 'static) {
    listen(stop, false, restore);
}

fn listen(stop: &Arc<CancelToken>, aloud: bool, restore: impl Fn() + Send + 'static) {
    let listens = session::stop_on_signals(Arc::clone(stop), move |report| {
        if report == SignalReport::StopRepeated {
            restore();
            note(&report.to_string());
            std::process::exit(i32::from(FAILED));
        }
        if aloud {
            note(&report.to_string());
        }
    });
    if let Err(e) = listens {
        note(&format!(
            "warning: Ctrl-C will not stop the machine in order: {e}"
        ));
    }
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
    thread::Builder::new()
        .name("signals".into())
        .spawn(move || runtime.block_on(wait))?;
    Ok(())
}
