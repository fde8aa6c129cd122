//! A bus for verbs that turn no cycle: a network interface, or the simulated bus of a machine file.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use ecaxis::clock::Clock;
use ecaxis::config::{Machine, Nic};
use ecaxis::link::{self, BackEnd, Link};
use ecaxis::service::{self, Datagrams};
use ecaxis::session::{self, Options, RunError};

use super::{Failure, hints, note, screen, signals};

#[derive(Debug)]
pub(crate) struct Bus {
    on: On,
    /// Of them the clock, what happens on a simulated bus, and the recording.
    options: Options,
    /// No other program drives the interface meanwhile.
    alone: bool,
}

#[derive(Debug)]
enum On {
    Interface { nic: String, back_end: BackEnd },
    Sim(Box<Machine>),
}

impl Bus {
    /// What the machine's `nic` names.
    pub fn of(machine: &Machine) -> Self {
        let (on, clock) = match &machine.bus.nic {
            Nic::Sim => (On::Sim(Box::new(machine.clone())), Clock::Virtual),
            Nic::Interface(nic) => {
                let (nic, back_end) = (nic.clone(), machine.bus.link);
                (On::Interface { nic, back_end }, Clock::Real)
            }
        };
        let options = Options {
            clock,
            ..Options::default()
        };
        Self {
            on,
            options,
            alone: false,
        }
    }

    pub fn interface(nic: &str) -> Self {
        let (nic, back_end) = (nic.to_owned(), BackEnd::default());
        Self {
            on: On::Interface { nic, back_end },
            options: Options::default(),
            alone: false,
        }
    }

    /// With a clock, faults and a recording of one's own.
    pub fn with(self, options: Options) -> Self {
        Self { options, ..self }
    }

    /// For work that no machine may be driven beside.
    pub fn alone(self) -> Self {
        Self {
            alone: true,
            ..self
        }
    }

    /// Hints depend on it.
    pub fn nic(&self) -> Nic {
        match &self.on {
            On::Interface { nic, .. } => Nic::Interface(nic.clone()),
            On::Sim(_) => Nic::Sim,
        }
    }

    /// Does a piece of work on it; `work` is told how many frames of others came in before anything was sent. Ctrl-C ends it, and
    /// what is in hand comes to its end first.
    pub fn visit<T, W>(self, work: W) -> Result<T, Failure>
    where
        T: Send + 'static,
        W: AsyncFnOnce(Datagrams, u64) -> T + Send + 'static,
    {
        let nic = self.nic();
        let clock = self.options.clock;
        let stop = Arc::new(AtomicBool::new(false));
        signals::stop_on_interrupt(&stop);
        let heard = Arc::new(AtomicU64::new(0));
        let others = Arc::clone(&heard);
        let done = service::visit(
            move || self.open(&others),
            clock,
            stop,
            async move |wire: Datagrams| work(wire, heard.load(Ordering::Relaxed)).await,
        );
        done.map_err(|error| hints::run(&error, &nic))
    }

    fn open(self, heard: &AtomicU64) -> Result<Box<dyn Link>, RunError> {
        let Self { on, options, alone } = self;
        let link: Box<dyn Link> = match on {
            On::Sim(machine) => {
                let faults = options.faults.as_ref();
                let segment = session::simulated_bus(&machine, options.seed, faults, None)?;
                Box::new(link::sim::SimLink::new(segment))
            }
            On::Interface { nic, back_end } => {
                // What only disturbs a cycle is no concern of a bus without one.
                let (mut link, _) = match alone {
                    true => link::open_alone(&nic, back_end)?,
                    false => link::open(&nic, back_end)?,
                };
                let frames = link::heard(link.as_mut()).map_err(RunError::Link)?;
                heard.store(frames, Ordering::Relaxed);
                // It may be a machine of this program's that runs there.
                Box::new(link::apart::Apart::new(link, std::process::id()))
            }
        };
        session::recorded(link, &options)
    }
}

/// Somebody else sent frames before anything was sent.
pub(crate) fn warn_of(others: u64) {
    if others > 0 {
        warn("another MainDevice is at work on this bus; what both do may collide");
    }
}

/// What a piece of work on a bus ended with, as the user sees it.
pub(crate) fn done<T>(result: Result<T, service::ServiceError>, nic: &Nic) -> Result<T, Failure> {
    result.map_err(|error| hints::service(&error, nic))
}

/// A line on stderr where somebody watches.
pub(crate) fn passing(text: &str) {
    screen::pass(text);
}

/// The last of those lines goes.
pub(crate) fn passed() {
    passing("");
}

/// Warnings, one a line.
pub(crate) fn warn(text: impl std::fmt::Display) {
    note(&format!("warning: {text}"));
}
