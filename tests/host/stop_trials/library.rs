//! Panics in a program that drives the machine through the library.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::{JoinHandle, sleep};
use std::time::{Duration, Instant};

use ecaxis_axis::Command;
use ecaxis_master::cancel::CancelToken;
use ecaxis_master::config::{self, AxisRef, Machine, Nic};
use ecaxis_master::link::{self, Link, LinkError, LinkStats, MAX_FRAME, capture::RecordStats};
use ecaxis_master::rt::controller::{Controller, CycleContext};
use ecaxis_master::session::{self, Options};

use super::SPEED;
use ecaxis_test_support::Heard;

/// A timeout by which a failed run has ended.
const TIMEOUT: Duration = Duration::from_secs(20);

/// The location of the panic.
#[derive(Debug, Clone, Copy)]
pub(super) enum Injected {
    Controller,
    /// During the transmission of a frame, this number of times.
    Cycle {
        times: usize,
    },
}

pub(super) struct Library {
    stop: Arc<CancelToken>,
    /// The number of remaining panics, once they have started.
    panics: Arc<AtomicUsize>,
    times: usize,
    run: Option<JoinHandle<bool>>,
}

impl Library {
    pub fn start(file: &Path, nic: &str, injected: Injected) -> Self {
        let mut machine = config::load(file).unwrap_or_else(|error| panic!("{error}"));
        machine.bus.nic = Nic::Interface(nic.to_owned());
        let (stop, panics) = (Arc::<CancelToken>::default(), Arc::<AtomicUsize>::default());
        let times = match injected {
            Injected::Controller => 1,
            Injected::Cycle { times } => times,
        };
        let run = {
            let (stop, panics, nic) = (Arc::clone(&stop), Arc::clone(&panics), nic.to_owned());
            move || run(machine, &nic, injected, stop, panics)
        };
        Self {
            stop,
            panics,
            times,
            run: Some(std::thread::spawn(run)),
        }
    }

    pub fn inject(&self) {
        self.panics.store(self.times, Ordering::Relaxed);
    }

    /// Waits for the end. Returns true if the run has failed.
    #[track_caller]
    pub fn end(mut self) -> bool {
        let run = self.run.take().expect("once");
        let began = Instant::now();
        while !run.is_finished() {
            assert!(began.elapsed() < TIMEOUT, "the run does not end");
            sleep(Duration::from_millis(10));
        }
        run.join().expect("panics within a run are its errors")
    }
}

impl Drop for Library {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

fn run(
    machine: Machine,
    nic: &str,
    injected: Injected,
    stop: Arc<CancelToken>,
    panics: Arc<AtomicUsize>,
) -> bool {
    let mut heard = Heard::default();
    let options = Options::default();
    let outcome = match injected {
        Injected::Controller => {
            let axes = ["csp", "csv"].map(|name| machine.axis(name).expect("an axis"));
            let controller = Box::new(Turning {
                axes,
                turns: false,
                panics,
            });
            session::run_with(machine, options, stop, &mut heard, controller)
        }
        Injected::Cycle { .. } => {
            let (link, _) = link::open(nic, machine.bus.link).expect("the interface");
            let link = Box::new(Panicking { link, panics });
            session::run_on(link, machine, options, stop, &mut heard)
        }
    };
    if let Err(error) = &outcome.result {
        println!("{injected:?}: {error}");
    }
    outcome.result.is_err()
}

/// Turns both axes until it panics.
struct Turning {
    axes: [AxisRef; 2],
    turns: bool,
    panics: Arc<AtomicUsize>,
}

impl Controller for Turning {
    fn cycle(&mut self, machine: &mut CycleContext<'_>) {
        let ready = self.axes.iter().all(|axis| machine.axis(*axis).ready);
        if machine.stopping() || !ready {
            return;
        }
        if !self.turns {
            self.turns = true;
            for axis in self.axes {
                let (velocity, ramp) = (SPEED, 1.0);
                let command = Command::Velocity { velocity, ramp };
                machine.command(axis, command).expect("within its limits");
            }
        }
        assert_eq!(self.panics.load(Ordering::Relaxed), 0, "injected");
    }
}

/// Panics instead of sending frames.
#[derive(Debug)]
struct Panicking {
    link: Box<dyn Link>,
    panics: Arc<AtomicUsize>,
}

impl Link for Panicking {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let left = self.panics.load(Ordering::Relaxed);
        if left > 0 {
            self.panics.store(left - 1, Ordering::Relaxed);
            panic!("injected");
        }
        self.link.send(frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        self.link.recv(buf)
    }

    fn stats(&mut self) -> LinkStats {
        self.link.stats()
    }

    fn notices(&mut self) -> Vec<String> {
        self.link.notices()
    }

    fn finish(self: Box<Self>) -> std::io::Result<Option<RecordStats>> {
        self.link.finish()
    }
}
